"""The door: what passes, what it costs, who can change it, and what arrives when it fails."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from distfilt.network import Channel, Faults, Graph, Ledger, graphs, weights
from tests.network.helpers import (
    APART,
    GRID,
    NAN,
    REFERENCE,
    STAR,
    heard,
    lossy,
    named,
    of_matrix,
    random_graph,
    rng,
    star,
)

_ZERO = np.zeros((3, 1))
_ONES = [np.zeros(1)] * 3
REFUSED = {
    "object": object(),
    "list": [np.zeros(2)],
    "object array": np.array([{"a": 1}, None], dtype=object),
    "complex": np.array([1j]),
    "masked": np.ma.masked_array([1.0, 2.0], [True, False]),
    "nested tuple": (np.zeros(1), (np.zeros(1),)),
    "empty tuple": (),
}


def charged(channel: Channel, **wanted: object) -> bool:
    """Whether the account of a channel has these numbers."""
    return all(
        (getattr(channel.ledger, name) == value).all() for name, value in wanted.items()
    )


def same_account(one: Channel, other: Channel) -> bool:
    names = ("messages", "scalars", "bytes", "lost")
    return charged(one, **{name: getattr(other.ledger, name) for name in names})


def test_what_is_no_array_is_refused_by_name_and_costs_nothing() -> None:
    """An object could carry any number of numbers past the account."""
    channel = star()
    for payload in REFUSED.values():
        with pytest.raises(ValueError, match=r"payloads\[2\] must"):
            channel.broadcast([np.zeros(1), None, payload])
    with pytest.raises(
        ValueError, match=r"payloads\[0\] must have leading axes \(4,\)"
    ):
        star(runs=(4,)).broadcast([(np.zeros((4, 3)), np.zeros(3))] * 3)
    assert channel.ledger.rounds == 0 and charged(channel, messages=0)


def test_a_ledger_is_replaced_never_changed() -> None:
    before = Ledger.empty(3)
    channel = star(ledger=before)
    channel.broadcast(_ONES)
    channel.mix(_ZERO, weights.metropolis(STAR))
    assert before.rounds == 0 and (before.messages == 0).all()
    assert (
        repr(channel.ledger)
        == "Ledger(rounds=2, messages=8, scalars=8, bytes=64, lost=0)"
    )


def _full(*shape: int) -> np.ndarray:
    return np.full(shape, NAN)


ACCOUNTS = {
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


@pytest.mark.parametrize("name", ACCOUNTS)
def test_every_number_is_charged_and_what_is_missing_is_not_sent(name: str) -> None:
    runs, sent, messages, scalars, bytes_ = ACCOUNTS[name]
    channel = star(runs=runs)
    inbox = channel.broadcast(sent)
    assert charged(channel, messages=messages, scalars=scalars, bytes=bytes_, lost=0)
    assert channel.ledger.rounds == 1
    for i, box in enumerate(inbox):
        assert list(box) == [j for j in STAR.neighbours(i) if messages[j]]
        for j, got in box.items():
            pairs = (
                zip(got, sent[j], strict=True)
                if isinstance(got, tuple)
                else [(got, sent[j])]
            )
            for part, wanted in pairs:
                assert part.dtype == wanted.dtype
                assert np.array_equal(part, wanted, equal_nan=part.dtype.kind == "f")


def test_what_arrives_cannot_be_changed_and_is_a_plain_array() -> None:
    own = [np.array([float(i)]) for i in range(3)]
    received = [
        star().broadcast(own)[1][0],
        star().broadcast([(own[0], own[1]), None, None])[1][0][1],
        lossy(0.5, runs=(20,)).broadcast([np.ones((20, 2))] * 3)[0][1],
    ]
    for array in received:
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 9.0
    assert own[0][0] == 0.0 and own[0].flags.writeable
    own_kind = np.eye(2).view(type("OwnKind", (np.ndarray,), {}))
    assert type(star().broadcast([own_kind, None, None])[1][0]) is np.ndarray


def test_without_links_there_is_no_round() -> None:
    for channel in (Channel(APART), lossy(0.5, APART)):
        assert channel.broadcast(_ONES) == [{}, {}, {}]
        channel.mix(_ZERO, weights.metropolis(APART), rounds=4)
        channel.send_on_links(np.zeros((0, 1)))
        assert channel.ledger.rounds == 0 and charged(channel, messages=0)


@given(st.integers(0, 1000), st.integers(1, 7), st.integers(1, 3), st.integers(1, 3))
def test_combine_is_the_matrix_product(
    seed: int, agents: int, k: int, rounds: int
) -> None:
    """Every link is charged once a round."""
    draw = rng(seed)
    graph = random_graph(seed, agents, directed=True)
    w = draw.standard_normal((agents, agents)) * (
        graph.links.toarray() + np.eye(agents)
    )
    values = draw.standard_normal((2, agents, k))
    channel = Channel(graph, runs=(2,))
    out = channel.mix(values, of_matrix(graph, w), rounds=rounds)
    exact = np.linalg.matrix_power(w, rounds) @ values
    assert np.allclose(out, exact, rtol=1e-12, atol=1e-10)
    assert channel.ledger.rounds == rounds * (graph.senders.size > 0)
    sent = rounds * graph.out_degree
    assert charged(channel, messages=sent, scalars=k * sent, bytes=8 * k * sent)


@named
@pytest.mark.parametrize(("runs", "loss"), [((), 0.3), ((3,), 0.0), ((2, 2), 0.3)])
def test_combine_and_carry_are_exchange_to_the_bit(
    graph: Graph, runs: tuple[int, ...], loss: float
) -> None:
    """The same sum by messages: own value first, then the senders in ascending order."""
    w = weights.metropolis(graph)
    dense = w.matrix.toarray()
    values = rng(1).standard_normal((*runs, graph.n_agents, 3))
    channels = [
        Channel(graph, runs=runs, faults=Faults(loss=loss, seed=9)) for _ in range(3)
    ]
    for _ in range(2):
        inbox = channels[0].broadcast(
            [values[..., a, :] for a in range(graph.n_agents)]
        )
        whole = channels[1].mix(values, w, lost="zero")
        carried = channels[2].send_on_links(values[..., graph.senders, :])
        for link, (i, j) in enumerate(zip(graph.receivers, graph.senders, strict=True)):
            got = inbox[i].get(int(j), np.full((*runs, 3), NAN))
            assert np.array_equal(carried[..., link, :], got, equal_nan=True)
        for a in range(graph.n_agents):
            total = dense[a, a] * values[..., a, :]
            for sender, payload in inbox[a].items():
                weighted = dense[a, sender] * payload
                total = total + np.where(np.isnan(weighted), 0.0, weighted)
            assert (total == whole[..., a, :]).all()
        values = whole
    for other in channels[1:]:
        assert same_account(channels[0], other) and other.ledger.rounds == 2


def test_only_the_links_in_use_are_charged() -> None:
    channel = star()
    used = np.array([True, False, False, True])
    got = channel.send_on_links(np.arange(4.0)[:, None], links=used)
    assert np.array_equal(got.ravel(), [0.0, NAN, NAN, 3.0], equal_nan=True)
    assert charged(channel, messages=np.bincount(STAR.senders[used], minlength=3))
    assert channel.ledger.rounds == 1


@pytest.mark.parametrize(
    "lost", ["mutual", "metropolis", "keep", "renormalise", "zero"]
)
def test_rules_for_losses_by_their_definition(lost: str) -> None:
    """Values after one round from the links that arrived, written out agent by agent."""
    faults = Faults(loss=0.4, seed=2)
    values = rng(1).standard_normal((GRID.n_agents, 2))
    w = weights.metropolis(GRID)
    dense = w.matrix.toarray()
    got = heard(faults, GRID)[0]
    both = got & got.T
    degree = both.sum(axis=1)
    expected = np.empty_like(values)
    for i in range(GRID.n_agents):
        came = dense[i] * got[i]
        share = {
            "mutual": dense[i] * both[i],
            "keep": came,
            "zero": came,
            "metropolis": both[i] / (1 + np.maximum(degree[i], degree)),
            "renormalise": came / (dense[i, i] + came.sum()),
        }[lost]
        own = dense[i, i] if lost == "zero" else 1 - share.sum()
        expected[i] = own * values[i] + share @ values
    out = Channel(GRID, faults=faults).mix(values, w, lost=lost)
    assert np.abs(out - expected).max() < 1e-14


def test_losses_in_a_batch_are_counted_on_average() -> None:
    channel = lossy(0.5, runs=(8,))
    inbox = channel.broadcast([np.ones((8, 1))] * 3)
    missed = [np.isnan(inbox[0].get(j, np.full((8, 1), NAN))).mean() for j in (1, 2)]
    assert (
        channel.ledger.lost[1:] == missed
    ).all() and 0 < channel.ledger.lost.sum() < 4


def test_acknowledgements_are_charged() -> None:
    """A byte for each, to the receiver of the message, who need not have a link of its own."""
    plain = lossy()
    told = lossy()
    degrees = lossy()
    for channel, lost in ((plain, "keep"), (told, "mutual"), (degrees, "metropolis")):
        channel.mix(np.zeros((3, 4)), weights.metropolis(STAR), lost=lost)
    sent = plain.ledger.messages
    assert charged(plain, scalars=4 * sent, bytes=32 * sent)
    assert charged(told, messages=2 * sent, scalars=4 * sent, bytes=33 * sent)
    assert charged(degrees, messages=2 * sent, scalars=5 * sent, bytes=41 * sent)
    graph = Graph.from_edges(
        3, [(1, 0), (2, 0), (2, 1)], directed=True
    )  # 2 is heard by nobody
    one_way = Channel(graph)
    one_way.send_on_links(np.zeros((3, 2)), acknowledged=True)
    assert charged(
        one_way, messages=[2, 1 + 1, 2], scalars=[4, 2, 0], bytes=[32, 16 + 1, 2]
    )


@pytest.mark.parametrize("delay", [1, 2])
def test_late_values_are_those_that_were_sent_and_not_lost_then(delay: int) -> None:
    """Own values are new; what is on the way stays as it was, and is lost when it is sent."""
    graph = REFERENCE["ring"]
    w = of_matrix(graph, np.eye(7) + graph.links.toarray())
    prompt, late = (
        Channel(graph, faults=Faults(loss=0.5, seed=3, delay=d)) for d in (0, delay)
    )
    values = np.zeros((7, 1))
    news = []
    for k in range(delay + 4):
        values[:] = (10.0 * k + np.arange(7))[
            :, None
        ]  # goes on computing in its own array
        news.append(prompt.mix(values, w, lost="zero") - values)
        wanted = values + (news[k - delay] if k >= delay else 0.0)
        assert np.allclose(late.mix(values, w, lost="zero"), wanted, atol=1e-12)
    assert same_account(prompt, late)
    for call in (
        lambda: late.broadcast([np.zeros(1)] * 7),
        lambda: late.send_on_links(np.zeros((14, 1))),
    ):
        with pytest.raises(
            ValueError, match=f"channel must have no delay here, got {delay} rounds"
        ):
            call()


def test_delayed_averaging_still_agrees_but_on_another_value() -> None:
    values = rng(3).standard_normal((6, 1))
    w = weights.metropolis(graphs.star(6))
    channel = Channel(w.graph, faults=Faults(delay=1))
    out = channel.mix(values, w, lost="keep", rounds=400)
    count = 1 + (1 - w.own)
    assert np.ptp(out) < 1e-9
    assert abs(out[0, 0] - count @ values[:, 0] / count.sum()) < 1e-9
    assert abs(out[0, 0] - values.mean()) > 1e-3


def test_silent_agents_neither_send_nor_hear() -> None:
    channel = star(faults=Faults(silent=[1]))
    assert [sorted(box) for box in channel.broadcast(_ONES)] == [[2], [], [0]]
    assert charged(channel, messages=[1, 0, 1], lost=0)


def test_windows_follow_the_channel_s_time_or_the_ledger_s_rounds() -> None:
    timed = Faults(silent=[0], during=[(10.0, 20.0)])
    for make in (Channel, Channel.construct):
        got = [
            len(make(STAR, faults=timed, t=t).broadcast(_ONES)[0])
            for t in (9.9, 10, 19, 20)
        ]
        assert got == [2, 0, 0, 2]
    channel = star(faults=Faults(loss=1.0, during=[(1, 3), (4, 5)]))
    assert [len(channel.broadcast(_ONES)[0]) for _ in range(6)] == [2, 0, 0, 2, 0, 2]
    later = star(faults=Faults(loss=1.0, during=[(1, 3)]), ledger=channel.ledger)
    assert len(later.broadcast(_ONES)[0]) == 2
