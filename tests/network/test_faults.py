"""Losses, alone and in bursts, by seed, run, round and link; silence; windows; combinations."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import binom

from distfilt.network import Channel, Faults, Graph, graphs
from tests.network.helpers import DISK, STAR


def _series(faults: Faults, graph: Graph, rounds: int, runs: int) -> np.ndarray:
    """Return the losses of many rounds, (rounds, runs, E)."""
    return np.stack([faults.draw_losses(graph, k, runs) for k in range(rounds)])


def _is_plausible(events: np.ndarray, cases: np.ndarray, probability: float) -> bool:
    """Return whether a count of events among cases lies in its 99.9% binomial band."""
    n_cases = int(cases.sum())
    n_events = (events & cases).sum()
    low, high = binom.ppf([5e-4, 1 - 5e-4], n_cases, probability)
    return bool(low <= n_events <= high)


@pytest.mark.parametrize("burst_length", [None, 6.0, 30.0])
def test_losses_depend_on_seed_run_round_and_link_alone(
    burst_length: float | None,
) -> None:
    faults = Faults(loss=0.5, seed=11, burst_length=burst_length)
    lost = faults.draw_losses(DISK, 20, 10)
    # Neither on the rounds that were asked for before nor on the number of runs.
    assert (_series(faults, DISK, 21, 10)[-1] == lost).all()
    assert (faults.draw_losses(DISK, 20, 4) == lost[:4]).all()
    # On round, run and seed.
    assert (faults.draw_losses(DISK, 21, 10) != lost).any()
    assert (lost[0] != lost[1]).any()
    other = Faults(loss=0.5, seed=12, burst_length=burst_length)
    assert (other.draw_losses(DISK, 20, 10) != lost).any()


def test_stored_losses_stay() -> None:
    """The first losses of a seed, by the formula written out with plain integers."""
    golden = 0x9E3779B97F4A7C15
    mask = 2**64 - 1

    def mix(z: int) -> int:
        # The finaliser of splitmix64.
        z = ((z ^ (z >> 30)) * 0xBF58476D1CE4E5B9) & mask
        z = ((z ^ (z >> 27)) * 0x94D049BB133111EB) & mask
        return z ^ (z >> 31)

    seed = 5
    round_ = 2
    lost = Faults(loss=0.4, seed=seed).draw_losses(STAR, round_, 3)
    for run in range(3):
        key = mix((seed + golden * (round_ + 1)) & mask)
        run_bits = mix(key ^ (run * golden & mask))
        for link in range(4):
            # The number of a link is that of its entry in the adjacency matrix.
            receiver = int(STAR.receivers[link])
            sender = int(STAR.senders[link])
            number = receiver * 3 + sender
            bits = mix(run_bits ^ mix(number + golden))
            # The upper 53 bits are a float in [0, 1).
            uniform = (bits >> 11) * 2.0**-53
            assert lost[run, link] == (uniform < 0.4)


@pytest.mark.parametrize(
    ("loss", "burst_length"), [(0.2, 5.0), (0.5, 3.0), (0.05, 20.0)]
)
def test_bursts_have_their_rate_and_their_length(
    loss: float, burst_length: float
) -> None:
    """Transitions of the chain, over independent links and runs, from the first round on."""
    faults = Faults(loss=loss, burst_length=burst_length, seed=3)
    first, second, third = _series(faults, graphs.ring(40), 3, 500)
    every = np.ones_like(first)
    assert _is_plausible(first, every, loss)
    # A burst ends with probability 1 / burst_length, and begins so that the rate stays.
    assert _is_plausible(~second, first, 1 / burst_length)
    enter = loss / (1 - loss) / burst_length
    assert _is_plausible(second, ~first, enter)
    # Markov: given the second round, the first does not matter for the third.
    assert _is_plausible(~third, second & first, 1 / burst_length)


def test_each_round_of_a_burst_follows_from_the_one_before() -> None:
    """The numbers drawn are those of independent losses.

    A link fails if its number is below p, and as in the round before if it is below p +
    q.
    """
    loss = 0.2
    burst_length = 8.0
    # P(lost | lost before) = p + q = 1 - 1/b and P(lost | arrived before) = p; the rate
    # r is stationary: r = p + q r.
    stay = 1 - 1 / (burst_length * (1 - loss))
    enter = loss * (1 - stay)
    bursts = Faults(loss=loss, burst_length=burst_length, seed=6)
    lost = _series(bursts, DISK, 12, 5)
    below_p = _series(Faults(loss=enter, seed=6), DISK, 12, 5)
    below_p_plus_q = _series(Faults(loss=enter + stay, seed=6), DISK, 12, 5)
    expected = below_p[1:] | (below_p_plus_q[1:] & lost[:-1])
    assert (lost[1:] == expected).all()
    # The first round lies between the two.
    # p <= r <= p + q, as r is the stationary rate.
    assert (lost[0] >= below_p[0]).all()
    assert (lost[0] <= below_p_plus_q[0]).all()
    assert lost[0].any()


@given(st.integers(0, 1000), st.floats(0, 1), st.floats(1, 50))
def test_bursts_of_any_rate_end(seed: int, loss: float, burst_length: float) -> None:
    """The search for the round that decides always stops, also near rates 0 and 1."""
    # Independent losses of rate r have bursts of mean length 1 / (1 - r).
    shortest = 1 / (1 - loss) if 0 < loss < 1 else 1.0
    if burst_length < shortest * (1 - 1e-8):
        with pytest.raises(ValueError, match="^burst_length must be at least"):
            Faults(loss=loss, burst_length=burst_length)
        return
    faults = Faults(loss=loss, burst_length=max(burst_length, shortest), seed=seed)
    lost = faults.draw_losses(STAR, 0, 5)
    assert lost.shape == (5, 4)
    if loss in (0.0, 1.0):
        assert (lost == bool(loss)).all()


def test_loss_by_receiver_and_by_link() -> None:
    by_receiver = [1.0, 0.0, 0.0]
    by_link = np.zeros((3, 3))
    by_link[0, 2] = 1.0
    by_link[1, 0] = 1.0
    # Agent 0 receives from 1 and 2, they from it.
    cases = (
        (by_receiver, [[], [0], [0]]),
        (by_link, [[1], [], [0]]),
    )
    for loss, senders in cases:
        channel = Channel(STAR, faults=Faults(loss=loss, seed=1))
        inboxes = channel.broadcast([np.zeros(1)] * 3)
        assert [sorted(inbox) for inbox in inboxes] == senders


def test_windows_hold_losses_and_silence() -> None:
    faults = Faults(loss=1.0, silent=[1], during=[(2, 4), (6, np.inf)])
    active = [False, False, True, True, False, False, True, True]
    lost = [bool(faults.draw_losses(STAR, k, 1).all()) for k in range(8)]
    assert lost == active
    # The silent agent has two links, there and back.
    off = [int((~faults.active_links(STAR, k)).sum()) for k in range(8)]
    assert off == [2 * flag for flag in active]
    # With a time the windows are in seconds: closed on the left, open on the right.
    timed = Faults(loss=1.0, during=[(0.5, 1.0)])
    times = (0.4, 0.5, 1.0)
    lost = [bool(timed.draw_losses(STAR, 9, 1, t).all()) for t in times]
    assert lost == [False, True, False]


def test_faults_together_fail_in_every_way() -> None:
    a = Faults(loss=0.3, seed=1)
    b = Faults(loss=0.4, seed=2, during=[(0, 5)], delay=1)
    c = Faults(silent=[2], delay=2)
    by_a = a.draw_losses(STAR, 3, 9)
    by_b = b.draw_losses(STAR, 3, 9)
    # In any grouping.
    for faults in (a | b | c, a | (b | c)):
        assert (faults.draw_losses(STAR, 3, 9) == (by_a | by_b)).all()
        # Outside the window of b only a loses messages; delays add up.
        later = a.draw_losses(STAR, 6, 9)
        assert (faults.draw_losses(STAR, 6, 9) == later).all()
        assert (faults.active_links(STAR) == c.active_links(STAR)).all()
        assert faults.total_delay == 3
        assert not faults.is_perfect


def test_only_faults_without_any_failure_are_perfect() -> None:
    assert (Faults() | Faults()).is_perfect
    assert not Faults(silent=[2]).is_perfect
    assert not Faults(delay=1).is_perfect


def test_impossible_faults_are_refused() -> None:
    """Bursts shorter than those of independent losses, one seed twice, another network's size."""
    wrong = {
        "burst_length must be at least": lambda: Faults(
            loss=[0.1, 0.8], burst_length=4.0
        ),
        "seed must differ": lambda: Faults(loss=0.1, seed=3) | Faults(loss=0.2, seed=3),
        "loss must be a number for each": lambda: Channel(
            STAR, faults=Faults(loss=[0.1, 0.2])
        ),
    }
    for text, call in wrong.items():
        with pytest.raises(ValueError, match=f"^{text}"):
            call()
