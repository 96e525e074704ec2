"""The channel: delivery, cost, protection of payloads, losses and delays."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from distfilt.network import Channel, Faults, Graph, Ledger, graphs, weights
from tests.network.helpers import (
    GRID,
    NAN,
    REFERENCE,
    STAR,
    UNLINKED,
    arrivals,
    each_graph,
    lossy,
    random_graph,
    rng,
    star,
    weights_of_matrix,
)

_ZERO = np.zeros((3, 1))
_ONES = [np.zeros(1)] * 3
WRONG = {
    "object": object(),
    "list": [np.zeros(2)],
    "object array": np.array([{"a": 1}, None], dtype=object),
    "complex": np.array([1j]),
    "masked": np.ma.masked_array([1.0, 2.0], [True, False]),
    "nested tuple": (np.zeros(1), (np.zeros(1),)),
    "empty tuple": (),
}


def has_counts(channel: Channel, **expected: object) -> bool:
    """Return whether the ledger of a channel has these counts."""
    for name, value in expected.items():
        if (getattr(channel.ledger, name) != value).any():
            return False
    return True


def have_equal_counts(one: Channel, other: Channel) -> bool:
    names = ("messages", "scalars", "bytes", "lost")
    counts = {name: getattr(other.ledger, name) for name in names}
    return has_counts(one, **counts)


# Payloads and their cost.


@pytest.mark.parametrize("payload", WRONG.values(), ids=WRONG.keys())
def test_only_arrays_are_sent(payload: object) -> None:
    """An object could carry any number of numbers past the ledger."""
    channel = star()
    with pytest.raises(ValueError, match=r"^payloads\[2\] must"):
        channel.broadcast([np.zeros(1), None, payload])
    # A refused round leaves no trace in the ledger, although two payloads are valid.
    assert channel.ledger.rounds == 0
    assert has_counts(channel, messages=0)


def test_payloads_have_the_axes_of_the_runs() -> None:
    channel = star(runs=(4,))
    text = r"^payloads\[0\] must have leading axes \(4,\)"
    payload = (np.zeros((4, 3)), np.zeros(3))
    with pytest.raises(ValueError, match=text):
        channel.broadcast([payload] * 3)
    assert has_counts(channel, messages=0)


def test_a_ledger_is_replaced_and_never_changed() -> None:
    before = Ledger.empty(3)
    channel = star(ledger=before)
    channel.broadcast(_ONES)
    channel.mix(_ZERO, weights.metropolis(STAR))
    assert before.rounds == 0
    assert (before.messages == 0).all()
    # Two rounds of a star with four directed links, one float64 on each.
    expected = "Ledger(rounds=2, messages=8, scalars=8, bytes=64, lost=0)"
    assert repr(channel.ledger) == expected


def _full(*shape: int) -> np.ndarray:
    return np.full(shape, NAN)


# Runs, payloads, and the messages, scalars and bytes of each agent; agent 0 has two
# receivers.
COSTS = {
    "a mixture as a flat tuple": (
        (),
        [(np.zeros(3), np.zeros((3, 4)), np.zeros((3, 4, 4))), None, None],
        [2, 0, 0],
        [2 * 63, 0, 0],
        [2 * 63 * 8, 0, 0],
    ),
    "items of other sizes": (
        (),
        [
            (np.zeros(5, dtype=np.float32), np.zeros((2, 3), dtype=np.int16)),
            np.zeros(7, dtype=bool),
            np.zeros((), dtype=np.int64),
        ],
        [2, 1, 1],
        [2 * 11, 7, 1],
        [2 * (5 * 4 + 6 * 2), 7, 8],
    ),
    "silence": (
        (),
        [None, (np.zeros(2), np.zeros((2, 2))), None],
        [0, 1, 0],
        [0, 6, 0],
        [0, 48, 0],
    ),
    "nothing but NaN": (
        (),
        [_full(2), (_full(2), _full(2)), (_full(2), np.array([NAN, 1.0]))],
        [0, 0, 1],
        [0, 0, 1],
        [0, 0, 8],
    ),
    "an empty array": ((), [np.zeros(0), None, None], [2, 0, 0], [0, 0, 0], [0, 0, 0]),
    "some entries missing": (
        (),
        [
            (np.array([1.0, NAN, 3.0], dtype=np.float32), np.array([NAN, 5.0])),
            None,
            None,
        ],
        [2, 0, 0],
        [2 * 3, 0, 0],
        [2 * (2 * 4 + 8), 0, 0],
    ),
    "missing in all runs": (
        (2,),
        [np.array([[NAN, 1.0, NAN], [NAN, NAN, NAN]]), _full(2, 1), None],
        [2, 0, 0],
        [2, 0, 0],
        [16, 0, 0],
    ),
    "infinite entries and large ones": (
        (),
        [np.array([np.inf, -np.inf, 1e300]), None, None],
        [2, 0, 0],
        [6, 0, 0],
        [48, 0, 0],
    ),
    "runs are not charged twice": (
        (4, 5),
        [np.zeros((4, 5, 3))] * 3,
        [2, 1, 1],
        [6, 3, 3],
        [48, 24, 24],
    ),
}


@pytest.mark.parametrize("name", COSTS)
def test_every_number_is_charged_and_missing_ones_are_not_sent(name: str) -> None:
    runs, sent, messages, scalars, bytes_ = COSTS[name]
    channel = star(runs=runs)
    inboxes = channel.broadcast(sent)
    assert has_counts(channel, messages=messages, scalars=scalars, bytes=bytes_, lost=0)
    assert channel.ledger.rounds == 1
    for agent, inbox in enumerate(inboxes):
        # A payload of NaN alone is no message: its receivers find no entry.
        senders = [j for j in STAR.neighbours(agent) if messages[j]]
        assert list(inbox) == senders
        for sender, received in inbox.items():
            _check_same_payload(received, sent[sender])


def _check_same_payload(received: object, sent: object) -> None:
    """Compare arrays, or tuples of them, in type and value."""
    received_parts = received if isinstance(received, tuple) else (received,)
    sent_parts = sent if isinstance(sent, tuple) else (sent,)
    for part, expected in zip(received_parts, sent_parts, strict=True):
        assert part.dtype == expected.dtype
        is_float = part.dtype.kind == "f"
        assert np.array_equal(part, expected, equal_nan=is_float)


def test_received_arrays_are_read_only_and_plain() -> None:
    values = [np.array([float(agent)]) for agent in range(3)]
    # An array, an item of a tuple, and an array with lost runs.
    inboxes = star().broadcast(values)
    plain = inboxes[1][0]
    inboxes = star().broadcast([(values[0], values[1]), None, None])
    item = inboxes[1][0][1]
    batch = [np.ones((20, 2))] * 3
    inboxes = lossy(0.5, runs=(20,)).broadcast(batch)
    with_losses = inboxes[0][1]
    for array in (plain, item, with_losses):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 9.0
    # The sender can go on with its own array.
    assert values[0][0] == 0.0
    assert values[0].flags.writeable
    # Subclasses of arrays arrive as plain ones.
    subclass = type("Subclass", (np.ndarray,), {})
    inboxes = star().broadcast([np.eye(2).view(subclass), None, None])
    assert type(inboxes[1][0]) is np.ndarray


def test_without_links_there_is_no_round() -> None:
    for channel in (Channel(UNLINKED), lossy(0.5, UNLINKED)):
        assert channel.broadcast(_ONES) == [{}, {}, {}]
        channel.mix(_ZERO, weights.metropolis(UNLINKED), rounds=4)
        channel.send_on_links(np.zeros((0, 1)))
        assert channel.ledger.rounds == 0
        assert has_counts(channel, messages=0)


# The three ways to send agree.


@given(st.integers(0, 1000), st.integers(1, 7), st.integers(1, 3), st.integers(1, 3))
def test_mix_is_the_matrix_product(seed: int, agents: int, k: int, rounds: int) -> None:
    """Every link is charged once a round."""
    draw = rng(seed)
    graph = random_graph(seed, agents, directed=True)
    # Weights are any numbers here, on the links and on the diagonal alone.
    pattern = graph.links.toarray() + np.eye(agents)
    w = draw.standard_normal((agents, agents)) * pattern
    values = draw.standard_normal((2, agents, k))
    channel = Channel(graph, runs=(2,))
    mixed = channel.mix(values, weights_of_matrix(graph, w), rounds=rounds)
    # W^k x for k rounds.
    expected = np.linalg.matrix_power(w, rounds) @ values
    assert np.allclose(mixed, expected, rtol=1e-12, atol=1e-10)
    assert channel.ledger.rounds == rounds * (graph.senders.size > 0)
    sent = rounds * graph.out_degree
    scalars = k * sent
    assert has_counts(channel, messages=sent, scalars=scalars, bytes=8 * scalars)


@each_graph
@pytest.mark.parametrize(("runs", "loss"), [((), 0.3), ((3,), 0.0), ((2, 2), 0.3)])
def test_mix_and_send_on_links_are_broadcast_to_the_bit(
    graph: Graph, runs: tuple[int, ...], loss: float
) -> None:
    """The same sum by messages: own value first, then the senders in ascending order."""
    w = weights.metropolis(graph)
    dense = w.matrix.toarray()
    values = rng(1).standard_normal((*runs, graph.n_agents, 3))
    faults = Faults(loss=loss, seed=9)
    by_broadcast, by_mix, by_links = (
        Channel(graph, runs=runs, faults=faults) for _ in range(3)
    )
    for _ in range(2):
        payloads = [values[..., agent, :] for agent in range(graph.n_agents)]
        inboxes = by_broadcast.broadcast(payloads)
        mixed = by_mix.mix(values, w, on_loss="zero")
        on_links = by_links.send_on_links(values[..., graph.senders, :])
        # A message that no run has received is in no inbox, and NaN on its link.
        nothing = np.full((*runs, 3), NAN)
        for link, receiver in enumerate(graph.receivers):
            sender = int(graph.senders[link])
            received = inboxes[receiver].get(sender, nothing)
            assert np.array_equal(on_links[..., link, :], received, equal_nan=True)
        for agent, inbox in enumerate(inboxes):
            # The order of a sum decides its last bit.
            total = dense[agent, agent] * values[..., agent, :]
            for sender, payload in inbox.items():
                term = dense[agent, sender] * payload
                total = total + np.where(np.isnan(term), 0.0, term)
            assert (total == mixed[..., agent, :]).all()
        values = mixed
    for channel in (by_mix, by_links):
        assert have_equal_counts(by_broadcast, channel)
        assert channel.ledger.rounds == 2


def test_only_the_links_in_use_are_charged() -> None:
    channel = star()
    used = np.array([True, False, False, True])
    received = channel.send_on_links(np.arange(4.0)[:, None], links=used)
    # An unused link delivers NaN, as a lost message does.
    expected = [0.0, NAN, NAN, 3.0]
    assert np.array_equal(received.ravel(), expected, equal_nan=True)
    messages = np.bincount(STAR.senders[used], minlength=3)
    assert has_counts(channel, messages=messages)
    assert channel.ledger.rounds == 1


# Losses.


@pytest.mark.parametrize(
    "on_loss", ["mutual", "metropolis", "keep", "renormalise", "zero"]
)
def test_rules_for_losses_by_their_definition(on_loss: str) -> None:
    """Values after one round from the links that arrived, written out agent by agent."""
    faults = Faults(loss=0.4, seed=2)
    values = rng(1).standard_normal((GRID.n_agents, 2))
    w = weights.metropolis(GRID)
    dense = w.matrix.toarray()
    arrived = arrivals(faults, GRID)[0]
    # A message counts for "mutual" and "metropolis" if its answer arrived, too.
    both_ways = arrived & arrived.T
    degree = both_ways.sum(axis=1)
    expected = np.empty_like(values)
    for i in range(GRID.n_agents):
        received = dense[i] * arrived[i]
        row = {
            "mutual": dense[i] * both_ways[i],
            "keep": received,
            "zero": received,
            "metropolis": both_ways[i] / (1 + np.maximum(degree[i], degree)),
            "renormalise": received / (dense[i, i] + received.sum()),
        }[on_loss]
        # The own value gets the remainder of one, except where lost weights go nowhere.
        self_weight = dense[i, i] if on_loss == "zero" else 1 - row.sum()
        received_sum = row @ values
        expected[i] = self_weight * values[i] + received_sum
    mixed = Channel(GRID, faults=faults).mix(values, w, on_loss=on_loss)
    assert np.abs(mixed - expected).max() < 1e-14


def test_rules_that_need_acknowledgements_refuse_one_way_links() -> None:
    graph = Graph.from_edges(3, [(1, 0), (2, 1), (0, 2)], directed=True)
    channel = lossy(0.3, graph)
    w = weights.column_stochastic(graph)
    for on_loss in ("mutual", "metropolis"):
        with pytest.raises(ValueError, match=f"^on_loss must not be '{on_loss}'"):
            channel.mix(_ZERO, w, on_loss=on_loss)


def test_losses_in_a_batch_are_counted_on_average() -> None:
    channel = lossy(0.5, runs=(8,))
    payloads = [np.ones((8, 1))] * 3
    inbox = channel.broadcast(payloads)[0]
    nothing = np.full((8, 1), NAN)
    lost = []
    for sender in (1, 2):
        received = inbox.get(sender, nothing)
        lost.append(np.isnan(received).mean())
    # Charges are those of one run, so that the count is the fraction of lost runs.
    assert (channel.ledger.lost[1:] == lost).all()
    assert 0 < channel.ledger.lost.sum() < 4


def test_acknowledgements_are_charged() -> None:
    """A message of one byte for each; Metropolis weights need one number more."""
    channels = {}
    for on_loss in ("keep", "mutual", "metropolis"):
        channel = lossy()
        channel.mix(np.zeros((3, 4)), weights.metropolis(STAR), on_loss=on_loss)
        channels[on_loss] = channel
    sent = channels["keep"].ledger.messages
    assert has_counts(channels["keep"], scalars=4 * sent, bytes=32 * sent)
    mutual = channels["mutual"]
    assert has_counts(mutual, messages=2 * sent, scalars=4 * sent, bytes=33 * sent)
    metropolis = channels["metropolis"]
    assert has_counts(metropolis, messages=2 * sent, scalars=5 * sent, bytes=41 * sent)


def test_acknowledgements_are_charged_to_the_receiver() -> None:
    """It need not have a link of its own: nobody receives from agent 2."""
    graph = Graph.from_edges(3, [(1, 0), (2, 0), (2, 1)], directed=True)
    channel = Channel(graph)
    channel.send_on_links(np.zeros((3, 2)), acknowledged=True)
    assert has_counts(
        channel, messages=[2, 1 + 1, 2], scalars=[4, 2, 0], bytes=[32, 16 + 1, 2]
    )


# Delays, silence and windows.


@pytest.mark.parametrize("delay", [1, 2])
def test_late_values_are_those_of_the_round_of_sending(delay: int) -> None:
    """Own values are present. A message on its way does not change, and losses are of its round."""
    graph = REFERENCE["ring"]
    # W = I + adjacency: a mixed value less the own one is the sum of the received ones.
    w = weights_of_matrix(graph, np.eye(7) + graph.links.toarray())
    prompt, late = (
        Channel(graph, faults=Faults(loss=0.5, seed=3, delay=d)) for d in (0, delay)
    )
    values = np.zeros((7, 1))
    sums = []
    for k in range(delay + 4):
        # In the same array, which the channel must have copied.
        values[:, 0] = 10.0 * k + np.arange(7)
        sums.append(prompt.mix(values, w, on_loss="zero") - values)
        received = sums[k - delay] if k >= delay else 0.0
        mixed = late.mix(values, w, on_loss="zero")
        assert np.allclose(mixed, values + received, atol=1e-12)
    # A message is charged when it is sent, not when it arrives.
    assert have_equal_counts(prompt, late)


def test_only_mix_accepts_a_delay() -> None:
    channel = Channel(REFERENCE["ring"], faults=Faults(delay=2))
    text = "^channel must have no delay here, got one of 2 rounds"
    with pytest.raises(ValueError, match=text):
        channel.broadcast([np.zeros(1)] * 7)
    with pytest.raises(ValueError, match=text):
        channel.send_on_links(np.zeros((14, 1)))


def test_delayed_averaging_still_agrees_but_on_another_value() -> None:
    """With a delay of one round each received value counts twice: when sent and when mixed."""
    values = rng(3).standard_normal((6, 1))
    w = weights.metropolis(graphs.star(6))
    channel = Channel(w.graph, faults=Faults(delay=1))
    mixed = channel.mix(values, w, on_loss="keep", rounds=400)
    assert np.ptp(mixed) < 1e-9
    # Σ (1 + 1 - w_ii) x_i is conserved: agent i's value is held once by itself and,
    # with the weight 1 - w_ii, by the messages on their way.
    count = 1 + (1 - w.self_weights)
    limit = count @ values[:, 0] / count.sum()
    assert abs(mixed[0, 0] - limit) < 1e-9
    assert abs(mixed[0, 0] - values.mean()) > 1e-3


def test_silent_agents_neither_send_nor_receive() -> None:
    channel = star(faults=Faults(silent=[1]))
    inboxes = channel.broadcast(_ONES)
    # The star's leaf 1 is silent: the centre and leaf 2 exchange their values.
    assert [sorted(inbox) for inbox in inboxes] == [[2], [], [0]]
    assert has_counts(channel, messages=[1, 0, 1], lost=0)


@pytest.mark.parametrize("make", [Channel, Channel.construct])
def test_windows_follow_the_channel_s_time(make: type[Channel]) -> None:
    """From the start of a window to before its end."""
    faults = Faults(silent=[0], during=[(10.0, 20.0)])
    counts = []
    for t in (9.9, 10, 19, 20):
        channel = make(STAR, faults=faults, t=t)
        counts.append(len(channel.broadcast(_ONES)[0]))
    assert counts == [2, 0, 0, 2]


def test_windows_follow_the_ledger_s_rounds_without_a_time() -> None:
    channel = star(faults=Faults(loss=1.0, during=[(1, 3), (4, 5)]))
    # Rounds 1, 2 and 4 are inside the windows [1, 3) and [4, 5).
    counts = [len(channel.broadcast(_ONES)[0]) for _ in range(6)]
    assert counts == [2, 0, 0, 2, 0, 2]
    # The count goes on with the ledger, in another channel.
    faults = Faults(loss=1.0, during=[(1, 3)])
    later = star(faults=faults, ledger=channel.ledger)
    assert len(later.broadcast(_ONES)[0]) == 2


# The bill by broadcast.


def test_one_transmission_serves_all_receivers() -> None:
    """Payloads for all, mixed vectors, and a silent agent, in both bills."""
    channel = star()
    channel.broadcast([np.zeros(5), None, np.zeros(2)])
    channel.mix(np.zeros((3, 4)), weights.metropolis(STAR), rounds=3)
    assert has_counts(channel, messages=[2 + 3 * 2, 3, 1 + 3])
    assert has_counts(channel, transmissions=[1 + 3, 3, 1 + 3])
    assert has_counts(channel, scalars=[10 + 24, 12, 2 + 12])
    assert has_counts(channel, broadcast_scalars=[5 + 12, 12, 2 + 12])
    assert has_counts(channel, broadcast_bytes=8 * channel.ledger.broadcast_scalars)


@pytest.mark.parametrize("loss", [0.0, 0.3])
def test_losses_and_acknowledgements_in_both_bills(loss: float) -> None:
    """Acknowledgements go to one agent each, by either bill."""
    channel = lossy(loss) if loss else star()
    x = np.zeros((3, 4))
    channel.mix(x, weights.metropolis(STAR), rounds=5)
    replies = np.array([10, 5, 5]) if loss else 0
    assert has_counts(channel, messages=np.array([10, 5, 5]) + replies)
    assert has_counts(channel, transmissions=5 + replies)
    assert has_counts(channel, broadcast_scalars=20)
    assert has_counts(channel, broadcast_bytes=160 + replies)


def test_silent_agents_do_not_transmit() -> None:
    faults = Faults(silent=[0], during=[(1, 3)])
    channel = star(faults=faults)
    channel.mix(np.zeros((3, 2)), weights.metropolis(STAR), rounds=4, on_loss="keep")
    # Nobody sends to an agent that is off either.
    assert has_counts(channel, transmissions=[2, 2, 2])


@pytest.mark.parametrize("runs", [(), (4,)])
def test_a_payload_for_each_link(runs: tuple[int, ...]) -> None:
    """Every payload arrives on its own link, and silence costs nothing."""
    payloads = [np.full((*runs, k + 1), float(k)) for k in range(4)]
    payloads[2] = None
    channel = star(runs=runs)
    arrived = channel.unicast(payloads)
    assert arrived[2] is None
    for k in (0, 1, 3):
        assert (arrived[k] == payloads[k]).all()
    sizes = np.array([1, 2, 0, 4])
    sent = np.bincount(STAR.senders, sizes, minlength=3)
    assert has_counts(channel, scalars=sent, broadcast_scalars=sent)
    assert has_counts(channel, messages=[1, 1, 1])


def test_a_common_payload_in_the_bill_by_broadcast() -> None:
    channel = star()
    common = [np.zeros(3), None, None]
    channel.unicast([None, None, np.zeros(2), np.zeros(1)], common=common)
    assert has_counts(channel, scalars=[3, 0, 0], broadcast_scalars=[3, 0, 0])
    assert has_counts(channel, messages=[2, 0, 0], transmissions=[1, 0, 0])


def test_lost_unicasts_are_nan_in_their_runs() -> None:
    channel = lossy(0.5, runs=(30,))
    arrived = channel.unicast([np.ones((30, 2))] * 4)
    expected = arrivals(channel.faults, STAR, runs=30)
    for link, (i, j) in enumerate(zip(STAR.receivers, STAR.senders, strict=True)):
        assert (~np.isnan(arrived[link][:, 0]) == expected[:, i, j]).all()
    assert has_counts(channel, scalars=[4, 2, 2])
