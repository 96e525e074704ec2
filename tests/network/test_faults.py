"""Losses alone and in bursts, by seed, run, round and link; silence; windows; combinations."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import binom

from distfilt.network import Channel, Faults, Graph, graphs
from tests.network.helpers import DISK, STAR


def _series(faults: Faults, graph: Graph, rounds: int, runs: int) -> np.ndarray:
    """Losses, (rounds, runs, E)."""
    return np.stack([faults.lost(graph, k, runs) for k in range(rounds)])


def _within(hits: int, trials: int, share: float) -> bool:
    """Inside the 99.9% band of a binomial."""
    low, high = binom.ppf([5e-4, 1 - 5e-4], trials, share)
    return bool(low <= hits <= high)


@pytest.mark.parametrize("burst", [None, 6.0, 30.0])
def test_losses_depend_on_seed_run_round_and_link_alone(burst: float | None) -> None:
    faults = Faults(loss=0.5, seed=11, burst=burst)
    whole = faults.lost(DISK, 20, 10)
    assert (_series(faults, DISK, 21, 10)[-1] == whole).all()
    assert (whole[:4] == faults.lost(DISK, 20, 4)).all()
    assert (whole != faults.lost(DISK, 21, 10)).any() and (whole[0] != whole[1]).any()
    assert (whole != Faults(loss=0.5, seed=12, burst=burst).lost(DISK, 20, 10)).any()


def test_stored_losses_stay() -> None:
    """The first losses of a seed, by the formula written out with plain integers."""
    golden = 0x9E3779B97F4A7C15
    mask = 2**64 - 1

    def mixed(z: int) -> int:
        z = ((z ^ (z >> 30)) * 0xBF58476D1CE4E5B9) & mask
        z = ((z ^ (z >> 27)) * 0x94D049BB133111EB) & mask
        return z ^ (z >> 31)

    for run in range(3):
        for link, (i, j) in enumerate(zip(STAR.receivers, STAR.senders, strict=True)):
            key = mixed((5 + golden * 3) & mask)
            bits = mixed(
                mixed(key ^ (run * golden & mask)) ^ mixed(int(i) * 3 + int(j) + golden)
            )
            lost = (bits >> 11) * 2.0**-53 < 0.4
            assert Faults(loss=0.4, seed=5).lost(STAR, 2, 3)[run, link] == lost


@pytest.mark.parametrize(("loss", "burst"), [(0.2, 5.0), (0.5, 3.0), (0.05, 20.0)])
def test_bursts_have_their_rate_and_their_length(loss: float, burst: float) -> None:
    """Transitions of the chain, over independent links and runs and from the first round on."""
    graph = graphs.ring(40)
    faults = Faults(loss=loss, burst=burst, seed=3)
    first, second, third = _series(faults, graph, 3, 500)
    assert _within(first.sum(), first.size, loss)
    assert _within((~second & first).sum(), int(first.sum()), 1 / burst)
    enter = loss / (1 - loss) / burst
    assert _within((second & ~first).sum(), int((~first).sum()), enter)
    # Markov: given the second round, the first tells nothing of the third.
    assert _within(
        (~third & second & first).sum(), int((second & first).sum()), 1 / burst
    )


def test_each_round_of_a_burst_follows_from_the_one_before() -> None:
    """The numbers drawn are those of independent losses: below p lost, below p + q as before."""
    loss = 0.2
    burst = 8.0
    stay = 1 - 1 / (burst * (1 - loss))
    enter = loss * (1 - stay)
    lost = _series(Faults(loss=loss, burst=burst, seed=6), DISK, 12, 5)
    surely = _series(Faults(loss=enter, seed=6), DISK, 12, 5)
    maybe = _series(Faults(loss=enter + stay, seed=6), DISK, 12, 5)
    assert (lost[1:] == (surely[1:] | (maybe[1:] & lost[:-1]))).all()
    assert (
        (lost[0] >= surely[0]).all() and (lost[0] <= maybe[0]).all() and lost[0].any()
    )


@given(st.integers(0, 1000), st.floats(0, 1), st.floats(1, 50))
def test_bursts_of_any_rate_end(seed: int, loss: float, burst: float) -> None:
    shortest = 1 / (1 - loss) if 0 < loss < 1 else 1.0
    if burst < shortest * (1 - 1e-8):
        with pytest.raises(ValueError, match="burst must have at least"):
            Faults(loss=loss, burst=burst)
        return
    lost = Faults(loss=loss, burst=max(burst, shortest), seed=seed).lost(STAR, 0, 5)
    assert lost.shape == (5, 4)
    assert loss not in (0.0, 1.0) or (lost == bool(loss)).all()


def test_loss_by_receiver_and_by_link() -> None:
    by_link = np.zeros((3, 3))
    by_link[0, 2] = by_link[1, 0] = 1.0
    for loss, arrive in (([1.0, 0.0, 0.0], [[], [0], [0]]), (by_link, [[1], [], [0]])):
        inbox = Channel(STAR, faults=Faults(loss=loss, seed=1)).broadcast(
            [np.zeros(1)] * 3
        )
        assert [sorted(box) for box in inbox] == arrive


def test_windows_hold_losses_and_silence() -> None:
    faults = Faults(loss=1.0, silent=[1], during=[(2, 4), (6, np.inf)])
    lost = [bool(faults.lost(STAR, k, 1).all()) for k in range(8)]
    assert lost == [False, False, True, True, False, False, True, True]
    off = [int((~faults.speaking(STAR, k)).sum()) for k in range(8)]
    assert off == [0, 0, 2, 2, 0, 0, 2, 2]
    timed = Faults(loss=1.0, during=[(0.5, 1.0)])
    assert [bool(timed.lost(STAR, 9, 1, t).all()) for t in (0.4, 0.5, 1.0)] == [
        False,
        True,
        False,
    ]


def test_faults_together_fail_in_every_way() -> None:
    a = Faults(loss=0.3, seed=1)
    b = Faults(loss=0.4, seed=2, during=[(0, 5)], delay=1)
    c = Faults(silent=[2], delay=2)
    for whole in (a | b | c, a | (b | c)):
        assert (
            whole.lost(STAR, 3, 9) == (a.lost(STAR, 3, 9) | b.lost(STAR, 3, 9))
        ).all()
        assert (whole.lost(STAR, 6, 9) == a.lost(STAR, 6, 9)).all()
        assert (whole.speaking(STAR) == c.speaking(STAR)).all() and whole.has_delay == 3
        assert not whole.none
    assert (Faults() | Faults()).none and not c.none and not Faults(delay=1).none


def test_what_cannot_be_said_of_a_network_is_refused() -> None:
    """Bursts shorter than independence, one seed twice, rates and agents of other networks."""
    refused = {
        "burst must have at least": lambda: Faults(loss=[0.1, 0.8], burst=4.0),
        "seed must be other seeds": lambda: (
            Faults(loss=0.1, seed=3) | Faults(loss=0.2, seed=3)
        ),
        "loss must be a number for each": lambda: Channel(
            STAR, faults=Faults(loss=[0.1, 0.2])
        ),
    }
    for text, call in refused.items():
        with pytest.raises(ValueError, match=text):
            call()
