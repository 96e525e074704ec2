"""The optimal-transport update: exact weighted means, options, and agents that agree on weights."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from distfilt.coupling import ensemble_transform as transform
from distfilt.network import Channel, Faults, graphs
from distfilt.updates import ensemble_transform, transform_by_agreement
from distfilt.updates.coupling import log_likelihood

from .cases import COV, MEAN, H, R, Y, kalman, members

_U = "distfilt.updates.coupling."


def _rng(seed: int = 1) -> np.random.Generator:
    return np.random.default_rng(seed)


def _ring(runs: tuple[int, ...] = ()) -> Channel:
    return Channel(graphs.ring(4), runs=runs)


_X = members(10)
_FOUR = np.broadcast_to(_X, (4, 10, 3))
_LOGS = _rng(2).standard_normal((4, 10))

BAD_INPUT: dict[str, list[tuple[str, Callable[[], object]]]] = {
    _U + "ensemble_transform": [
        ("ensemble", lambda: ensemble_transform(_X[:1], _X[:1] @ H.T, Y, R, rng=_rng())),
        ("predicted", lambda: ensemble_transform(_X, _X[:5] @ H.T, Y, R, rng=_rng())),
        ("observed", lambda: ensemble_transform(_X, _X @ H.T, Y[:1], R, rng=_rng())),
        ("noise", lambda: ensemble_transform(_X, _X @ H.T, Y, -R, rng=_rng())),
        ("rng", lambda: ensemble_transform(_X, _X @ H.T, Y, R, rng=3)),
        ("solver", lambda: ensemble_transform(_X, _X @ H.T, Y, R, rng=_rng(), solver="best")),
        ("rejuvenation", lambda: ensemble_transform(
            _X, _X @ H.T, Y, R, rng=_rng(), rejuvenation=-1.0)),
        ("inside", lambda: ensemble_transform(
            _X, _X @ H.T, Y, R, rng=_rng(), inside=lambda x: np.zeros(10, dtype=bool))),
        ("inside", lambda: ensemble_transform(_X, _X @ H.T, Y, R, rng=_rng(), inside=3)),
    ],
    _U + "transform_by_agreement": [
        ("channel", lambda: transform_by_agreement(_FOUR, _LOGS, graphs.ring(4))),
        ("channel", lambda: transform_by_agreement(
            _FOUR, _LOGS, Channel(graphs.ring(4), faults=Faults(loss=0.5)))),
        ("ensembles", lambda: transform_by_agreement(_FOUR[:3], _LOGS, _ring())),
        ("log_likelihoods", lambda: transform_by_agreement(_FOUR, _LOGS[:, :5], _ring())),
        ("rounds", lambda: transform_by_agreement(_FOUR, _LOGS, _ring(), rounds=0)),
        ("solver", lambda: transform_by_agreement(_FOUR, _LOGS, _ring(), solver="best")),
    ],
}


def _weights(x: np.ndarray) -> np.ndarray:
    gap = Y - x @ H.T
    w = np.exp(-0.5 * np.einsum("ni,ij,nj->n", gap, np.linalg.inv(R), gap))
    return np.asarray(w / w.sum())


def test_the_update_by_its_formula() -> None:
    x = members(40)
    out = ensemble_transform(x, x @ H.T, Y, R, rng=_rng())
    assert np.allclose(out, transform(x, np.log(_weights(x))), atol=1e-10)
    assert np.abs(out.mean(axis=0) - _weights(x) @ x).max() < 1e-13


def test_the_moments_tend_to_the_kalman_filter_s() -> None:
    """Mean and covariance within five standard errors at N = 900; the noise matrix is full."""
    means, covs = [], []
    for seed in range(6):
        x = members(900, seed=seed)
        out = ensemble_transform(x, x @ H.T, Y, R, rng=_rng(), correct=True)
        means.append(out.mean(axis=0))
        covs.append(np.cov(out.T))
    mean, cov = kalman(MEAN, COV, H, R, Y)
    assert (np.abs(np.mean(means, axis=0) - mean)
            < 5 * np.std(means, axis=0, ddof=1) / 6**0.5 + 0.01).all()
    assert (np.abs(np.mean(covs, axis=0) - cov)
            < 5 * np.std(covs, axis=0, ddof=1) / 6**0.5 + 0.02).all()


def test_a_reading_far_away_underflows_nothing() -> None:
    x = members(40)
    out = ensemble_transform(x, x @ H.T, Y + 1e4, R, rng=_rng())
    assert np.isfinite(out).all()


def test_nothing_is_drawn_without_rejuvenation() -> None:
    x = members(30)
    a, b = (ensemble_transform(x, x @ H.T, Y, R, rng=_rng(s)) for s in (1, 2))
    assert (a == b).all()
    c, d = (ensemble_transform(x, x @ H.T, Y, R, rng=_rng(s), rejuvenation=0.2) for s in (1, 2))
    assert (c != d).any()
    assert np.abs(c.mean(axis=0) - a.mean(axis=0)).max() < 1e-13


def test_members_outside_get_no_weight() -> None:
    x = members(40)
    out = ensemble_transform(
        x, x @ H.T, Y, R, rng=_rng(), inside=lambda e: e[..., 0] <= MEAN[0]
    )
    assert out[:, 0].max() <= MEAN[0] + 1e-12
    assert ensemble_transform(x, x @ H.T, Y, R, rng=_rng())[:, 0].max() > MEAN[0]


def test_ensembles_with_noise_of_their_own() -> None:
    x = np.stack([members(20, seed=s) for s in (1, 2)])
    y, noise = np.stack([Y, 0.5 * Y]), np.stack([R, 3 * R])
    out = ensemble_transform(x, x @ H.T, y, noise, rng=_rng())
    for k in range(2):
        alone = ensemble_transform(x[k], x[k] @ H.T, y[k], noise[k], rng=_rng())
        assert np.allclose(out[k], alone, atol=1e-12)


# ------------------------------------------------------------------------------ agreement


def _problem(steps: int = 100) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A common set that turns, and four agents' readings of one direction each."""
    rng = _rng(5)
    x = rng.standard_normal((30, 2)) + [2.0, 0.0]
    turn = 0.1
    angle = turn * np.arange(1, steps + 1)
    truth = 2 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    seen = rng.standard_normal((4, 2))
    return x, truth @ seen.T + 0.5 * rng.standard_normal((steps, 4)), seen


def _run(rounds: int | None, steps: int = 100, agents: int = 4) -> tuple[np.ndarray, Channel]:
    """The agents' sets at the end and the worst distance from the centralised set."""
    x, readings, seen = _problem(steps)
    rotation = np.array([[np.cos(0.1), np.sin(0.1)], [-np.sin(0.1), np.cos(0.1)]])
    kick = _rng(6).standard_normal((steps, *x.shape))
    sets, centre, worst = np.broadcast_to(x, (4, *x.shape)), x, 0.0
    channel = _ring()
    for k in range(steps):
        sets, centre = sets @ rotation + 0.1 * kick[k], centre @ rotation + 0.1 * kick[k]
        logs = -0.5 * ((readings[k][:, None] - (sets @ seen.T)[
            np.arange(4), :, np.arange(4)]) / 0.5) ** 2
        whole = -0.5 * (((readings[k] - centre @ seen.T) / 0.5) ** 2).sum(axis=1)
        sets = transform_by_agreement(sets, logs, channel, rounds=rounds)
        centre = transform(centre, whole)
        worst = max(worst, float(np.abs(sets - centre).max()))
    return np.array(worst), channel


@pytest.mark.parametrize(("rounds", "bound"), [(20, 1e-7), (30, 1e-11), (None, 1e-12)])
def test_agents_stay_with_the_centralised_filter(rounds: int | None, bound: float) -> None:
    worst, _ = _run(rounds)
    assert worst < bound


def test_too_few_rounds_let_the_sets_separate() -> None:
    assert _run(3)[0] > 1e-3


def test_finite_time_takes_two_rounds_on_a_ring_of_four_and_is_charged() -> None:
    _, channel = _run(None, steps=5)
    assert channel.ledger.rounds == 10
    assert (channel.ledger.scalars == 5 * 2 * 2 * 30).all()  # steps, rounds, neighbours, members


def test_agreement_over_runs_and_an_agent_that_saw_nothing() -> None:
    x = np.broadcast_to(members(12), (3, 4, 12, 3))
    logs = _rng(7).standard_normal((3, 4, 12))
    logs[:, 2] = 0.0
    out = transform_by_agreement(x, logs, _ring((3,)))
    for run in range(3):
        assert np.allclose(out[run], transform(x[run, 0], logs[run].sum(axis=0)), atol=1e-9)


def test_likelihoods_of_a_full_noise_matrix() -> None:
    x = members(9)
    logs = log_likelihood(x @ H.T, Y, R)
    assert np.allclose(np.exp(logs - logs.max()), _weights(x) / _weights(x).max())
