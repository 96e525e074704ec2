"""The door: what passes, what it costs, who can change it, and what arrives when it fails."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import sparse

from distfilt.network import Channel, Faults, Graph, Ledger, graphs, weights
from tests.network.helpers import (
    APART,
    NAN,
    REFERENCE,
    STAR,
    lossy,
    of_matrix,
    random_graph,
    rng,
    star,
)

named = pytest.mark.parametrize("graph", REFERENCE.values(), ids=REFERENCE.keys())


REFUSED = {
    "object": object(),
    "dict": {"mean": np.zeros(2)},
    "list": [np.zeros(2)],
    "number": 3.0,
    "text array": np.array(["a", "b"]),
    "object array": np.array([{"a": 1}, None], dtype=object),
    "structured array": np.zeros(2, dtype=[("a", float)]),
    "complex": np.array([1j]),
    "masked": np.ma.masked_array([1.0, 2.0], [True, False]),
    "sparse": sparse.csr_array(np.eye(2)),
    "nested tuple": (np.zeros(1), (np.zeros(1),)),
    "empty tuple": (),
}
_ZERO = np.zeros((3, 1))


def test_what_is_no_array_is_refused_by_name_and_costs_nothing() -> None:
    """An object could carry any number of numbers past the account."""
    channel = star()
    for payload in REFUSED.values():
        with pytest.raises(ValueError, match=r"payloads\[2\]: needs"):
            channel.exchange([np.zeros(1), None, payload])
    with pytest.raises(ValueError, match=r"payloads\[0\]: needs leading axes \(4,\)"):
        star(runs=(4,)).exchange([(np.zeros((4, 3)), np.zeros(3))] * 3)
    assert channel.ledger.rounds == 0 and channel.ledger.messages.sum() == 0


def test_a_ledger_is_replaced_never_changed() -> None:
    before = Ledger.empty(3)
    channel = star(ledger=before)
    channel.exchange([np.zeros(1)] * 3)
    channel.combine(_ZERO, weights.metropolis(STAR))
    assert before.rounds == 0 and (before.messages == 0).all()
    assert repr(channel.ledger) == "Ledger(rounds=2, messages=8, scalars=8, bytes=64, lost=0)"


def test_a_mixture_as_a_flat_tuple_is_charged_for_every_number() -> None:
    channel = star()
    inbox = channel.exchange([(np.zeros(3), np.zeros((3, 4)), np.zeros((3, 4, 4))), None, None])
    assert [part.shape for part in inbox[1][0]] == [(3,), (3, 4), (3, 4, 4)]
    assert isinstance(inbox[1][0], tuple)
    assert (channel.ledger.messages == [2, 0, 0]).all()
    assert (channel.ledger.scalars == [2 * 63, 0, 0]).all()
    assert (channel.ledger.bytes == [2 * 63 * 8, 0, 0]).all()


def test_bytes_are_those_of_the_item_size() -> None:
    channel = star()
    channel.exchange([
        (np.zeros(5, dtype=np.float32), np.zeros((2, 3), dtype=np.int16)),
        np.zeros(7, dtype=bool),
        np.zeros((), dtype=np.int64),
    ])
    assert (channel.ledger.scalars == [2 * 11, 7, 1]).all()
    assert (channel.ledger.bytes == [2 * (5 * 4 + 6 * 2), 7, 8]).all()


def test_types_arrive_as_they_were_sent() -> None:
    sent = np.array([1, 2], dtype=np.int16), np.array([True]), np.array([0.5], dtype=np.float32)
    got = star().exchange([sent, None, None])[2][0]
    assert [part.dtype for part in got] == [part.dtype for part in sent]
    own_kind = np.eye(2).view(type("OwnKind", (np.ndarray,), {}))
    assert type(star().exchange([own_kind, None, None])[1][0]) is np.ndarray


def test_messages_follow_the_links_and_cannot_be_changed() -> None:
    own = [np.array([float(i)]) for i in range(3)]
    inbox = star().exchange(own)
    assert [list(box) for box in inbox] == [[1, 2], [0], [0]]
    assert [float(inbox[0][j][0]) for j in (1, 2)] == [1.0, 2.0]
    with pytest.raises(ValueError, match="read-only"):
        inbox[1][0][0] = 9.0
    assert own[0][0] == 0.0 and own[0].flags.writeable
    both = star().exchange([(own[0], own[1]), None, None])[1][0]
    with pytest.raises(ValueError, match="read-only"):
        both[1][0] = 9.0
    heard, arrived = star().broadcast(_ZERO)
    with pytest.raises(ValueError, match="read-only"):
        heard[0, 0] = 9.0
    assert arrived.all() and arrived.shape == (4,)
    copies = lossy(0.5, runs=(20,)).exchange([np.ones((20, 2))] * 3)
    with pytest.raises(ValueError, match="read-only"):
        copies[0][1][0] = 9.0


@pytest.mark.parametrize("delay", [1, 2])
def test_a_late_message_is_what_was_sent(delay: int) -> None:
    """The sender goes on computing in its own array; what is on the way stays as it was."""
    channel = Channel(graphs.path(2), faults=Faults(delay=delay))
    crossed = of_matrix(channel.graph, [[0.0, 1.0], [1.0, 0.0]])
    by_message, by_link, by_sum, by_cast = (np.zeros((2, 1)) for _ in range(4))
    got = []
    for k in range(delay + 2):
        for own in (by_message, by_link, by_sum, by_cast):
            own[:] = k + 1
        box = channel.exchange(list(by_message))[0]
        got.append([
            float(box[1][0]) if box else 0.0,
            float(np.nan_to_num(channel.carry(by_link)[0, 0])),
            float(channel.combine(by_sum, crossed, lost="zero")[0, 0]),
            float(channel.broadcast(by_cast)[0][1, 0]),
        ])
    expected = [[float(max(k + 1 - delay, 0))] * 4 for k in range(delay + 2)]
    assert got == expected


def test_what_is_lost_is_lost_when_it_is_sent() -> None:
    """With a delay the same messages get through, a round later."""
    faults = {"loss": 0.5, "seed": 3}
    graph = REFERENCE["ring"]
    prompt, late = Channel(graph, faults=Faults(**faults)), Channel(
        graph, faults=Faults(**faults, delay=1))
    sent = [[np.array([float(10 * k + a)]) for a in range(7)] for k in range(6)]
    first = [prompt.exchange(s) for s in sent]
    second = [late.exchange(s) for s in sent]
    assert all(box == {} for box in second[0])
    assert second[1:] == first[:-1]


def test_silence_costs_nothing_and_a_round_is_counted() -> None:
    channel = star()
    inbox = channel.exchange([None, (np.zeros(2), np.zeros((2, 2))), None])
    assert inbox[0].keys() == {1} and not inbox[1] and not inbox[2]
    assert (channel.ledger.messages == [0, 1, 0]).all()
    assert (channel.ledger.scalars == [0, 6, 0]).all()
    assert (channel.ledger.bytes == [0, 48, 0]).all()
    assert channel.ledger.rounds == 1


def test_nothing_but_nan_is_silence() -> None:
    channel = star()
    gone = np.full(2, NAN)
    inbox = channel.exchange([gone, (gone, gone), (gone, np.array([NAN, 1.0]))])
    assert [sorted(box) for box in inbox] == [[2], [], []]
    assert (channel.ledger.scalars == [0, 0, 1]).all()
    empty = star()
    assert [sorted(b) for b in empty.exchange([np.zeros(0), None, None])] == [[], [0], [0]]
    assert empty.ledger.messages.sum() == 2 and empty.ledger.scalars.sum() == 0


def test_what_is_missing_is_not_sent() -> None:
    """NaN costs nothing, in arrays of any item size; in a batch if it is missing in all runs."""
    one = star()
    half = np.array([1.0, NAN, 3.0], dtype=np.float32)
    inbox = one.exchange([(half, np.array([NAN, 5.0])), None, None])
    assert np.array_equal(inbox[1][0][0], half, equal_nan=True)
    assert (one.ledger.scalars == [2 * 3, 0, 0]).all()
    assert (one.ledger.bytes == [2 * (2 * 4 + 8), 0, 0]).all()
    many, gone = star(runs=(2,)), np.array([[NAN, 1.0, NAN], [NAN, NAN, NAN]])
    many.exchange([gone, None, None])
    assert (many.ledger.scalars == [2, 0, 0]).all()


def test_without_links_there_is_no_round() -> None:
    for channel in (Channel(APART), Channel(APART, faults=Faults(loss=0.5))):
        assert channel.exchange([np.zeros(1)] * 3) == [{}, {}, {}]
        channel.combine(_ZERO, weights.metropolis(APART), rounds=4)
        channel.broadcast(_ZERO)
        channel.carry(np.zeros((0, 1)))
        assert channel.ledger.rounds == 0 and channel.ledger.messages.sum() == 0


def test_runs_are_not_charged_twice() -> None:
    one, many = star(), star(runs=(4, 5))
    one.exchange([np.zeros(3)] * 3)
    many.exchange([np.zeros((4, 5, 3))] * 3)
    for name in ("messages", "scalars", "bytes"):
        assert (getattr(one.ledger, name) == getattr(many.ledger, name)).all()


@given(st.integers(0, 1000), st.integers(1, 7), st.integers(1, 3), st.integers(1, 3))
def test_combine_is_the_matrix_product(seed: int, agents: int, k: int, rounds: int) -> None:
    draw, graph = rng(seed), random_graph(seed, agents, directed=True)
    w = draw.standard_normal((agents, agents)) * (graph.links.toarray() + np.eye(agents))
    values = draw.standard_normal((2, agents, k))
    before = values.copy()
    channel = Channel(graph, runs=(2,))
    out = channel.combine(values, of_matrix(graph, w), rounds=rounds)
    exact = np.linalg.matrix_power(w, rounds) @ values
    assert np.allclose(out, exact, rtol=1e-12, atol=1e-10)
    assert (values == before).all() and channel.ledger.rounds == rounds * (graph.senders.size > 0)


def test_combine_charges_every_link_once() -> None:
    channel = star()
    for _ in range(3):
        channel.combine(np.zeros((3, 4)), weights.metropolis(STAR))
    assert (channel.ledger.messages == [6, 3, 3]).all()
    assert (channel.ledger.scalars == [24, 12, 12]).all()
    assert (channel.ledger.bytes == 8 * channel.ledger.scalars).all()
    assert channel.ledger.rounds == 3


@named
@pytest.mark.parametrize(("runs", "loss"), [((), 0.3), ((3,), 0.0), ((2, 2), 0.3)])
def test_combine_equals_exchange_to_the_bit(
    graph: Graph, runs: tuple[int, ...], loss: float
) -> None:
    """The same sum by messages: own value first, then the senders in ascending order."""
    w = weights.metropolis(graph)
    values = rng(1).standard_normal((*runs, graph.size, 3))
    faults = Faults(loss=loss, seed=9)
    by_product, by_message = (Channel(graph, runs=runs, faults=faults) for _ in range(2))
    for _ in range(2):
        whole = by_product.combine(values, w, lost="zero")
        inbox = by_message.exchange([values[..., a, :] for a in range(graph.size)])
        dense = w.matrix.toarray()
        for a in range(graph.size):
            total = dense[a, a] * values[..., a, :]
            for sender, payload in inbox[a].items():
                weighted = dense[a, sender] * payload
                total = total + np.where(np.isnan(weighted), 0.0, weighted)
            assert (total == whole[..., a, :]).all()
        values = whole
    for name in ("messages", "scalars", "bytes", "lost"):
        assert (getattr(by_product.ledger, name) == getattr(by_message.ledger, name)).all()
    assert by_product.ledger.rounds == by_message.ledger.rounds == 2


@named
@pytest.mark.parametrize("runs", [(), (3,)])
def test_carry_and_broadcast_lose_what_exchange_loses(
    graph: Graph, runs: tuple[int, ...]
) -> None:
    faults = Faults(loss=0.4, seed=3)
    values = rng(1).standard_normal((*runs, graph.size, 2))
    channels = [Channel(graph, runs=runs, faults=faults) for _ in range(3)]
    inbox = channels[0].exchange([values[..., a, :] for a in range(graph.size)])
    carried = channels[1].carry(values[..., graph.senders, :])
    heard, arrived = channels[2].broadcast(values)
    assert (heard == values).all()
    for link, (i, j) in enumerate(zip(graph.receivers, graph.senders, strict=True)):
        got = inbox[i].get(int(j), np.full((*runs, 2), NAN))
        assert np.array_equal(carried[..., link, :], got, equal_nan=True)
        assert (arrived[..., link] == ~np.isnan(got[..., 0])).all()
    for other in channels[1:]:
        for name in ("messages", "scalars", "bytes", "lost"):
            assert (getattr(other.ledger, name) == getattr(channels[0].ledger, name)).all()


def test_only_the_links_in_use_are_charged() -> None:
    channel = star()
    used = np.array([True, False, False, True])
    got = channel.carry(np.arange(4.0)[:, None], links=used)
    assert np.array_equal(got.ravel(), [0.0, NAN, NAN, 3.0], equal_nan=True)
    wanted = np.bincount(STAR.senders[used], minlength=3)
    assert (channel.ledger.messages == wanted).all()
    assert channel.ledger.rounds == 1


@pytest.mark.parametrize("lost", ["mutual", "metropolis", "keep", "renormalise", "zero"])
def test_rules_for_losses_by_their_definition(lost: str) -> None:
    """Values after one round from the links that arrived, written out agent by agent."""
    graph = REFERENCE["grid"]
    faults = Faults(loss=0.4, seed=2)
    values = rng(1).standard_normal((graph.size, 2))
    w = weights.metropolis(graph)
    dense = w.matrix.toarray()
    gone = faults.lost(graph, 0, 1)[0]
    got = np.zeros((graph.size, graph.size), dtype=bool)
    got[graph.receivers[~gone], graph.senders[~gone]] = True
    both = got & got.T
    degree = both.sum(axis=1)
    expected = np.empty_like(values)
    for i in range(graph.size):
        share = {
            "mutual": dense[i] * both[i],
            "metropolis": both[i] / (1 + np.maximum(degree[i], degree)),
            "keep": dense[i] * got[i],
            "zero": dense[i] * got[i],
            "renormalise": dense[i] * got[i] / (dense[i, i] + (dense[i] * got[i]).sum()),
        }[lost]
        own = dense[i, i] if lost == "zero" else 1 - share.sum()
        expected[i] = own * values[i] + share @ values
    out = Channel(graph, faults=faults).combine(values, w, lost=lost)
    assert np.abs(out - expected).max() < 1e-14


def test_losses_in_a_batch_are_counted_on_average() -> None:
    channel = lossy(0.5, runs=(8,))
    inbox = channel.exchange([np.ones((8, 1))] * 3)
    missed = [np.isnan(inbox[0].get(j, np.full((8, 1), NAN))).mean() for j in (1, 2)]
    assert (channel.ledger.lost[1:] == missed).all() and 0 < channel.ledger.lost.sum() < 4


def test_acknowledgements_are_charged() -> None:
    plain, told = lossy(0.3), lossy(0.3)
    plain.combine(np.zeros((3, 4)), weights.metropolis(STAR), lost="keep")
    told.combine(np.zeros((3, 4)), weights.metropolis(STAR), lost="mutual")
    assert (told.ledger.messages == 2 * plain.ledger.messages).all()
    assert (told.ledger.bytes - plain.ledger.bytes == plain.ledger.messages).all()
    assert (told.ledger.scalars == plain.ledger.scalars).all()
    degrees = lossy(0.3)
    degrees.combine(np.zeros((3, 4)), weights.metropolis(STAR), lost="metropolis")
    assert degrees.ledger.scalars.sum() == 5 * plain.ledger.messages.sum()


def test_an_acknowledgement_is_charged_to_who_sends_it() -> None:
    """The receiver of the message, who need not have a link of its own."""
    graph = Graph.from_edges(3, [(1, 0), (2, 0), (2, 1)], directed=True)  # 2 is heard by nobody
    channel = Channel(graph)
    channel.carry(np.zeros((3, 2)), acknowledged=True)
    assert (channel.ledger.messages == [2 + 0, 1 + 1, 0 + 2]).all()
    assert (channel.ledger.scalars == [4, 2, 0]).all()
    assert (channel.ledger.bytes == [32, 16 + 1, 2]).all()


def test_combine_with_delay_uses_old_neighbours_and_the_new_own_value() -> None:
    graph = graphs.path(2)
    half = of_matrix(graph, np.full((2, 2), 0.5))
    channel = Channel(graph, faults=Faults(delay=1))
    first = channel.combine([[1.0], [3.0]], half, lost="keep")
    assert (first == [[1.0], [3.0]]).all()
    second = channel.combine([[10.0], [30.0]], half, lost="keep")
    assert (second == [[0.5 * 10 + 0.5 * 3], [0.5 * 30 + 0.5 * 1]]).all()


def test_delayed_averaging_still_agrees_but_on_another_value() -> None:
    values = rng(3).standard_normal((6, 1))
    channel = Channel(graphs.star(6), faults=Faults(delay=1))
    out = channel.combine(values, weights.metropolis(graphs.star(6)), lost="keep", rounds=400)
    own = weights.metropolis(graphs.star(6)).own
    count = 1 + (1 - own)
    assert np.ptp(out) < 1e-9
    assert abs(out[0, 0] - count @ values[:, 0] / count.sum()) < 1e-9
    assert abs(out[0, 0] - values.mean()) > 1e-3


def test_silent_agents_neither_send_nor_hear() -> None:
    channel = star(faults=Faults(silent=[1]))
    inbox = channel.exchange([np.zeros(1)] * 3)
    assert [sorted(box) for box in inbox] == [[2], [], [0]]
    assert (channel.ledger.messages == [1, 0, 1]).all()
    assert channel.ledger.lost.sum() == 0


def test_a_graph_may_come_as_anything_that_names_links() -> None:
    import networkx as nx

    for links in (nx.star_graph(2), STAR.links, STAR.links.toarray(), [(0, 1), (2, 0)]):
        channel = Channel(links)
        channel.exchange([np.zeros(1)] * 3)
        assert (channel.ledger.messages == [2, 1, 1]).all()
    assert Channel([(0, 1)], ledger=Ledger.empty(5)).graph.size == 5
    with pytest.raises(ValueError, match="graph: needs a graph of 5 agents, got 3"):
        Channel(STAR, ledger=Ledger.empty(5))


def test_windows_in_time_follow_the_channel_s_time() -> None:
    faults = Faults(silent=[0], during=[(10.0, 20.0)], clock="time")
    sent = [np.zeros(1)] * 3
    heard = [len(star(faults=faults, t=t).exchange(sent)[0]) for t in (9.9, 10.0, 19.0, 20.0)]
    assert heard == [2, 0, 0, 2]
    with pytest.raises(ValueError, match="t: needs the time"):
        star(faults=faults)


def test_windows_in_rounds_follow_the_ledger() -> None:
    channel = star(faults=Faults(loss=1.0, during=[(1, 3), (4, 5)]))
    heard = [len(channel.exchange([np.zeros(1)] * 3)[0]) for _ in range(6)]
    assert heard == [2, 0, 0, 2, 0, 2]
    later = star(faults=Faults(loss=1.0, during=[(1, 3)]), ledger=channel.ledger)
    assert len(later.exchange([np.zeros(1)] * 3)[0]) == 2
