"""Ensemble and particle filters on series."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from distfilt.ensembles import draw, sample_covariance
from distfilt.kalman import kalman_filter, update
from distfilt.kalman.ensemble import enkf, enkf_filter
from distfilt.kalman.particle import (
    Particles,
    effective_size,
    particle_filter,
    resample,
    systematic,
)
from distfilt.models import simulate
from distfilt.sensors import differential, direct
from tests.kalman.problems import spd, walk

# --- ensembles ---------------------------------------------------------------------------------


def linear_case(n: int, rng: np.random.Generator) -> tuple[np.ndarray, ...]:
    mean, cov = np.array([1.0, -1.0, 0.5]), spd(np.random.default_rng(8), 3)
    h, r, y = np.array([[1.0, 0.5, 0.0], [0.0, 1.0, -1.0]]), np.diag([0.5, 0.2]), np.array([2.0, 0])
    return draw(mean, cov, n, rng=rng, leading=(40,)), h, r, y, mean, cov


@pytest.mark.parametrize("known", [False, True])
def test_enkf_converges_like_one_over_root_n(known: bool) -> None:
    errors = []
    for n in (100, 1600):
        x, h, r, y, mean, cov = linear_case(n, np.random.default_rng(9))
        after = enkf(x, x @ h.T, y, r, rng=np.random.default_rng(10), known_noise=known)
        exact, spread, _ = update(mean, cov, y, H=h, R=r)
        gap = after.mean(axis=-2) - exact
        errors.append(np.sqrt((gap**2).mean()))
        if n == 1600:
            np.testing.assert_allclose(sample_covariance(after).mean(axis=0), spread, atol=0.02)
    assert 3.0 < errors[0] / errors[1] < 5.3  # sixteen times the members: four times less error


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10**6), known=st.booleans())
def test_enkf_does_not_depend_on_coordinates(seed: int, known: bool) -> None:
    rng = np.random.default_rng(seed)
    x, h, y = rng.standard_normal((2, 9, 3)), rng.standard_normal((2, 9, 2)), np.array([0.4, -1.0])
    noise, a, b = spd(rng, 2), rng.standard_normal((3, 3)) + 3 * np.eye(3), rng.standard_normal(3)
    first = enkf(x, h, y, noise, rng=np.random.default_rng(1), known_noise=known)
    second = enkf(x @ a.T + b, h, y, noise, rng=np.random.default_rng(1), known_noise=known)
    np.testing.assert_allclose(second, first @ a.T + b, rtol=0, atol=1e-8)


def test_enkf_at_the_smallest_ensemble() -> None:
    rng = np.random.default_rng(11)
    x = rng.standard_normal((3, 3))  # N == d == m + 1
    assert enkf(x, x[:, :2], [0.0, 0.0], np.eye(2), rng=rng).shape == (3, 3)
    two = enkf(x[:2], x[:2], np.zeros(3), np.eye(3), rng=rng, known_noise=True)
    assert two.shape == (2, 3)


def test_enkf_filter_approaches_the_kalman_filter() -> None:
    rng = np.random.default_rng(12)
    model, sensors, times = walk(2), [direct([0], std=0.5)], np.array([1.0, 2.0, 3.0])
    y = rng.standard_normal((3, 1, 1))
    y[1] = np.nan
    x = draw([0.0, 0.0], np.eye(2), 40_000, rng=rng, leading=(1,))
    run = enkf_filter(x, y, model=model, sensors=sensors, times=times, rng=rng, every=2)
    exact = kalman_filter([0.0, 0.0], np.eye(2), y, F=np.eye(2), Q=np.eye(2),
                          H=[[1.0, 0.0]], R=[[0.25]])
    np.testing.assert_allclose(run.means, exact.means, atol=0.03)
    np.testing.assert_allclose(run.covariances, exact.covariances, atol=0.06)
    assert run.ensembles.shape == (1, 1, 40_000, 2)


# --- particles ---------------------------------------------------------------------------------


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 10**6), n=st.integers(1, 60))
def test_systematic_counts_are_within_one(seed: int, n: int) -> None:
    rng = np.random.default_rng(seed)
    w = rng.dirichlet(np.full(n, 0.3), size=3)
    picked = systematic(w, rng=rng)
    counts = np.array([np.bincount(row, minlength=n) for row in picked])
    assert np.abs(counts - n * w).max() < 1 + 1e-9
    assert (w[np.arange(3)[:, None], picked] > 0).all()


@pytest.mark.parametrize("method", ["systematic", "multinomial"])
def test_resampling_is_unbiased(method: str) -> None:
    w = np.array([0.5, 0.1, 0.0, 0.4])
    points = np.tile(np.arange(4.0)[:, None], (20_000, 1, 1))
    cloud = Particles(points, np.tile(np.log(w + 1e-300), (20_000, 1)))
    fresh = resample(cloud, rng=np.random.default_rng(13), method=method)
    shares = np.bincount(fresh.points.astype(int).ravel(), minlength=4) / fresh.points.size
    np.testing.assert_allclose(shares, w, atol=0.01)
    assert effective_size(fresh.log_weights) == pytest.approx(4.0)


def test_effective_size_between_one_and_n() -> None:
    assert effective_size([0.0, -np.inf, -np.inf]) == pytest.approx(1.0)
    assert effective_size(np.full(8, -1e6)) == pytest.approx(8.0)


def test_particle_filter_approaches_the_kalman_filter() -> None:
    rng = np.random.default_rng(14)
    sensor, times = direct([0], std=0.5), [1.0, 2.0, 3.0, 4.0]
    y = sensor.observe(simulate(walk(), rng.standard_normal((2, 1)), times, rng=rng), rng=rng)
    y[1, 0, 0] = np.nan  # missing in one run only
    x = draw([0.0], [[1.0]], 40_000, rng=rng, leading=(2,))
    run = particle_filter(x, y, model=walk(), sensors=[sensor], times=times, rng=rng)
    exact = kalman_filter([0.0], [[1.0]], y, F=[[1.0]], Q=[[1.0]], H=[[1.0]], R=[[0.25]])
    error = np.sqrt(exact.covariances[..., 0] / run.effective[..., None])
    assert (np.abs(run.means - exact.means) < 5 * error).all()
    full = np.broadcast_to(exact.covariances, run.covariances.shape)
    np.testing.assert_allclose(run.covariances, full, atol=0.03)
    np.testing.assert_allclose(run.log_likelihood, exact.log_likelihood, atol=0.05)
    assert run.final.points.shape == (2, 40_000, 1)


def test_particles_of_a_single_member() -> None:
    cloud = Particles(np.ones((1, 2)), [-5.0])
    assert cloud.weights == pytest.approx(1.0) and (cloud.covariance == 0).all()
    run = particle_filter(np.ones((1, 1)), [[0.3]], model=walk(), sensors=[direct([0], std=1.0)],
                          times=[1.0], rng=np.random.default_rng(0))
    assert run.effective[0] == pytest.approx(1.0)


def test_same_seed_same_bits() -> None:
    def once() -> np.ndarray:
        rng = np.random.default_rng(15)
        x = draw([0.0], [[1.0]], 50, rng=rng)
        y = simulate(walk(), [0.0], [1.0, 2.0], rng=rng)
        return particle_filter(x, y, model=walk(), sensors=[direct([0], std=1.0)],
                               times=[1.0, 2.0], rng=rng).means

    assert (once() == once()).all()


# --- bad input ---

_Y = np.zeros((3, 5, 1))
_INDEFINITE = [[1.0, 2.0], [2.0, 1.0]]
_LOPSIDED = [[1.0, 0.5], [0.0, 1.0]]


def _series(filter_: Callable[..., Any], first: Any = None, y: Any = _Y, **changed: Any) -> Any:
    """A call of a filter with model and sensors; one argument of it is made wrong."""
    options: dict[str, Any] = {
        "model": walk(2), "sensors": [direct([0], std=1.0)], "times": [1.0, 2.0, 3.0],
    }
    options.update(changed)
    options.setdefault("rng", np.random.default_rng(0))
    return filter_(np.zeros((5, 9, 2)) if first is None else first, y, **options)


def _series_cases(f: Callable[..., Any], first: str) -> list[tuple[str, Callable[[], Any]]]:
    wrong = np.full((5, 9, 2), np.nan) if first != "mean" else [np.nan, 0.0]
    short = np.zeros((5, 9, 3)) if first != "mean" else np.zeros(3)
    cases: list[tuple[str, Callable[[], Any]]] = [
        (first, lambda: _series(f, wrong)),
        (first if first != "mean" else "cov", lambda: _series(f, short)),
        ("observations", lambda: _series(f, y=np.zeros((3, 5, 2)))),
        ("observations", lambda: _series(f, y=np.full((3, 5, 1), np.inf))),
        ("sensors", lambda: _series(f, sensors=[])),
        ("sensors", lambda: _series(f, sensors=[differential([0], std=1.0)])),
        ("times", lambda: _series(f, times=[1.0, 1.0, 2.0])),
        ("times", lambda: _series(f, times=[0.0, 1.0, 2.0])),
        ("t0", lambda: _series(f, t0=np.nan)),
    ]
    if first != "mean":
        cases.append(("rng", lambda: _series(f, rng=3)))
    return cases


_X = np.random.default_rng(0).standard_normal((9, 2))
_RNG = np.random.default_rng(0)

BAD_INPUT: dict[str, list[tuple[str, Callable[[], Any]]]] = {
    "distfilt.kalman.ensemble.enkf": [
        ("ensemble", lambda: enkf(_X[0], _X, [0.0, 0.0], np.eye(2), rng=_RNG)),
        ("ensemble", lambda: enkf(_X[:2], _X[:2], [0.0, 0.0], np.eye(2), rng=_RNG)),
        ("ensemble", lambda: enkf(_X[:1], _X[:1], [0.0, 0.0], np.eye(2), rng=_RNG,
                                  known_noise=True)),
        ("predicted", lambda: enkf(_X, _X[:8], [0.0, 0.0], np.eye(2), rng=_RNG)),
        ("predicted", lambda: enkf(_X, _X * np.nan, [0.0, 0.0], np.eye(2), rng=_RNG)),
        ("observed", lambda: enkf(_X, _X, [0.0], np.eye(2), rng=_RNG)),
        ("observed", lambda: enkf(_X, _X, [0.0, np.nan], np.eye(2), rng=_RNG)),
        ("noise", lambda: enkf(_X, _X, [0.0, 0.0], np.eye(3), rng=_RNG)),
        ("noise", lambda: enkf(_X, _X, [0.0, 0.0], _INDEFINITE, rng=_RNG)),
        ("noise", lambda: enkf(_X, _X, [0.0, 0.0], _LOPSIDED, rng=_RNG)),
        ("rng", lambda: enkf(_X, _X, [0.0, 0.0], np.eye(2), rng=None)),  # type: ignore[arg-type]
    ],
    "distfilt.kalman.ensemble.enkf_filter": [
        *_series_cases(enkf_filter, "ensemble"),
        ("every", lambda: _series(enkf_filter, every=0)),
        ("observations", lambda: _series(enkf_filter, y=np.where(
            np.arange(5)[:, None] == 2, np.nan, np.zeros((3, 5, 1))))),
    ],
    "distfilt.kalman.particle.particle_filter": [
        *_series_cases(particle_filter, "points"),
        ("threshold", lambda: _series(particle_filter, threshold=1.5)),
        ("method", lambda: _series(particle_filter, method="stratified")),
    ],
    "distfilt.kalman.particle.Particles": [
        ("points", lambda: Particles([1.0, 2.0], [0.0, 0.0])),
        ("points", lambda: Particles([[np.nan]], [0.0])),
        ("log_weights", lambda: Particles([[1.0]], [0.0, 0.0])),
        ("log_weights", lambda: Particles([[1.0]], [np.nan])),
        ("log_weights", lambda: Particles([[1.0]], [-np.inf])),
    ],
    "distfilt.kalman.particle.effective_size": [
        ("log_weights", lambda: effective_size(0.0)),
        ("log_weights", lambda: effective_size([np.nan, 0.0])),
    ],
    "distfilt.kalman.particle.systematic": [
        ("probabilities", lambda: systematic([0.5, 0.4], rng=_RNG)),
        ("probabilities", lambda: systematic([1.5, -0.5], rng=_RNG)),
        ("rng", lambda: systematic([1.0], rng=1)),  # type: ignore[arg-type]
    ],
    "distfilt.kalman.particle.resample": [
        ("particles", lambda: resample(_X, rng=_RNG)),  # type: ignore[arg-type]
        ("method", lambda: resample(Particles(_X, np.zeros(9)), rng=_RNG, method="best")),
        ("rng", lambda: resample(Particles(_X, np.zeros(9)), rng=0)),  # type: ignore[arg-type]
    ],
}

EXEMPT = {
    "distfilt.kalman.ensemble.EnsembleRun": "a result that only the library builds",
    "distfilt.kalman.particle.ParticleRun": "a result that only the library builds",
}
