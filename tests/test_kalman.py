"""The Kalman floor: exact identities first, then agreement with filterpy, then bad input."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import multivariate_normal

from distfilt.ensembles import draw, sample_covariance
from distfilt.kalman import (
    Particles,
    effective_size,
    enkf,
    enkf_filter,
    filterpy_ekf,
    filterpy_kf,
    filterpy_ukf,
    kalman_filter,
    particle_filter,
    predict,
    resample,
    systematic,
    update,
)
from distfilt.models import LinearModel, Model, simulate
from distfilt.models.satellite import clohessy_wiltshire
from distfilt.sensors import angle, differential, direct, stack

STEPS, RUNS, D, M = 7, 4, 3, 2


def spd(rng: np.random.Generator, n: int, leading: tuple[int, ...] = ()) -> np.ndarray:
    """Random symmetric positive definite matrices with eigenvalues of order one."""
    a = rng.standard_normal((*leading, n, n))
    return a @ np.swapaxes(a, -1, -2) / n + 0.3 * np.eye(n)


def problem(
    rng: np.random.Generator, steps: int = STEPS, d: int = D, m: int = M, varying: bool = True
) -> dict[str, np.ndarray]:
    lead = (steps,) if varying else ()
    return {
        "F": rng.standard_normal((*lead, d, d)) / np.sqrt(d),
        "H": rng.standard_normal((*lead, m, d)),
        "Q": spd(rng, d, lead),
        "R": spd(rng, m, lead),
    }


def walk(d: int = 1) -> LinearModel:
    return LinearModel.from_transition(d, lambda dt: np.eye(d), lambda t, dt: dt * np.eye(d))


def joint_of_series(
    mean: np.ndarray, cov: np.ndarray, p: dict[str, np.ndarray]
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Mean and covariance of (last state), of (all observations), and their cross covariance.

    Built from the definition, without any recursion of the filter: the state at k is a linear
    function of the prior and of all noises.
    """
    steps, d = p["F"].shape[:2]
    m = p["H"].shape[1]
    blocks = np.zeros((steps, d, d * (steps + 1)))
    now = np.zeros((d, d * (steps + 1)))
    now[:, :d] = np.eye(d)
    for k in range(steps):
        now = p["F"][k] @ now
        now[:, d * (k + 1) : d * (k + 2)] += np.eye(d)
        blocks[k] = now
    noise = np.zeros((d * (steps + 1),) * 2)
    noise[:d, :d] = cov
    for k in range(steps):
        noise[d * (k + 1) : d * (k + 2), d * (k + 1) : d * (k + 2)] = p["Q"][k]
    seen = np.concatenate([p["H"][k] @ blocks[k] for k in range(steps)])
    r = np.zeros((steps * m, steps * m))
    for k in range(steps):
        r[k * m : (k + 1) * m, k * m : (k + 1) * m] = p["R"][k]
    start = np.concatenate([mean, np.zeros(d * steps)])
    last = blocks[-1]
    return (
        last @ start,
        seen @ start,
        np.block(
            [
                [last @ noise @ last.T, last @ noise @ seen.T],
                [seen @ noise @ last.T, seen @ noise @ seen.T + r],
            ]
        ),
        last,
    )


# --- the linear filter: identities ------------------------------------------------------------


def test_filter_is_conditioning_of_the_joint_gaussian() -> None:
    rng = np.random.default_rng(1)
    p, mean, cov = problem(rng), rng.standard_normal(D), spd(rng, D)
    y = rng.standard_normal((STEPS, M))
    run = kalman_filter(mean, cov, y, **p)
    mx, my, joint, _ = joint_of_series(mean, cov, p)
    xx, xy, yy = joint[:D, :D], joint[:D, D:], joint[D:, D:]
    gain = np.linalg.solve(yy, xy.T).T
    np.testing.assert_allclose(run.means[-1], mx + gain @ (y.ravel() - my), rtol=0, atol=1e-11)
    np.testing.assert_allclose(run.covariances[-1], xx - gain @ xy.T, rtol=0, atol=1e-11)
    expected = multivariate_normal(my, yy).logpdf(y.ravel())
    np.testing.assert_allclose(run.log_likelihood.sum(), expected, rtol=1e-11)


def test_static_state_is_least_squares() -> None:
    rng = np.random.default_rng(2)
    h, r = rng.standard_normal((STEPS, M, D)), spd(rng, M, (STEPS,))
    y, mean, cov = rng.standard_normal((STEPS, M)), rng.standard_normal(D), spd(rng, D)
    run = kalman_filter(mean, cov, y, F=np.eye(D), H=h, Q=np.zeros((D, D)), R=r)
    # Stack the prior as D more rows and solve one whitened least-squares problem.
    roots = [np.linalg.cholesky(cov), *np.linalg.cholesky(r)]
    systems, values = (np.eye(D), *h), (mean, *y)
    rows = np.concatenate([np.linalg.solve(c, a) for c, a in zip(roots, systems, strict=True)])
    right = np.concatenate([np.linalg.solve(c, b) for c, b in zip(roots, values, strict=True)])
    np.testing.assert_allclose(run.means[-1], np.linalg.lstsq(rows, right)[0], atol=1e-11)


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 10**6), d=st.integers(1, 5), m=st.integers(1, 5))
def test_update_in_information_form(seed: int, d: int, m: int) -> None:
    rng = np.random.default_rng(seed)
    mean, cov, h, r = rng.standard_normal(d), spd(rng, d), rng.standard_normal((m, d)), spd(rng, m)
    y = rng.standard_normal(m)
    x, p, density = update(mean, cov, y, H=h, R=r)
    information = np.linalg.solve(cov, np.eye(d)) + h.T @ np.linalg.solve(r, h)
    vector = np.linalg.solve(cov, mean) + h.T @ np.linalg.solve(r, y)
    np.testing.assert_allclose(information @ p, np.eye(d), atol=1e-9)
    np.testing.assert_allclose(information @ x, vector, atol=1e-9)
    assert np.isclose(density, multivariate_normal(h @ mean, h @ cov @ h.T + r).logpdf(y))


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 10**6), hidden=st.integers(0, 6))
def test_missing_component_is_a_deleted_row(seed: int, hidden: int) -> None:
    rng = np.random.default_rng(seed)
    mean, cov, h, r = rng.standard_normal(D), spd(rng, D), rng.standard_normal((3, D)), spd(rng, 3)
    y = rng.standard_normal(3)
    keep = np.array([not hidden >> k & 1 for k in range(3)])
    x, p, density = update(mean, cov, np.where(keep, y, np.nan), H=h, R=r)
    other = update(mean, cov, y[keep], H=h[keep], R=r[np.ix_(keep, keep)])
    for ours, theirs in zip((x, p, density), other, strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-12)


def test_nothing_observed_is_a_forecast() -> None:
    rng = np.random.default_rng(3)
    p, mean, cov = problem(rng, varying=False), rng.standard_normal(D), spd(rng, D)
    run = kalman_filter(mean, cov, np.full((1, M), np.nan), **p)
    x, c = predict(mean, cov, F=p["F"], Q=p["Q"])
    np.testing.assert_allclose(run.means[0], x, atol=1e-14)
    np.testing.assert_allclose(run.covariances[0], c, atol=1e-14)
    assert run.log_likelihood[0] == 0.0


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 10**6), share=st.floats(0, 0.9))
def test_covariances_stay_symmetric_and_positive(seed: int, share: float) -> None:
    rng = np.random.default_rng(seed)
    p = problem(rng)
    y = rng.standard_normal((STEPS, RUNS, M))
    y[rng.random(y.shape) < share] = np.nan
    run = kalman_filter(np.zeros(D), spd(rng, D), y, **p)
    assert (run.covariances == np.swapaxes(run.covariances, -1, -2)).all()
    assert np.linalg.eigvalsh(run.covariances).min() > 0


def test_a_diffuse_prior_does_not_break_the_update() -> None:
    cov = update(np.zeros(2), 1e10 * np.eye(2), [1.0], H=[[1.0, 1.0]], R=[[1e-4]])[1]
    assert (np.linalg.eigvalsh(cov) > 0).all()
    np.testing.assert_allclose(np.ones(2) @ cov @ np.ones(2), 1e-4, rtol=1e-2)


def test_stationary_variance_of_a_random_walk() -> None:
    # The stationary analysis variance of a random walk solves p^2 + q p = q r.
    q, r = 0.5, 2.0
    run = kalman_filter([0.0], [[5.0]], np.zeros((200, 1)), F=[[1.0]], H=[[1.0]], Q=[[q]], R=[[r]])
    expected = (-q + np.sqrt(q * q + 4 * q * r)) / 2
    np.testing.assert_allclose(run.covariances[-1, 0, 0], expected, rtol=1e-12)


# --- the linear filter: shapes and agreement ---------------------------------------------------


@pytest.mark.parametrize("varying", [False, True])
@pytest.mark.parametrize("pattern", ["whole", "common", "own", "few"])
def test_equal_to_filterpy(varying: bool, pattern: str) -> None:
    rng = np.random.default_rng(4)
    p, runs = problem(rng, steps=30, varying=varying), 6
    mean, cov, y = rng.standard_normal(D), spd(rng, D), rng.standard_normal((30, runs, M))
    if pattern == "common":
        y = np.where(rng.random((30, 1, M)) < 0.3, np.nan, y)
    elif pattern == "own":
        y = np.where(rng.random(y.shape) < 0.3, np.nan, y)
    elif pattern == "few":  # three groups of two runs each, in mixed order
        gaps = rng.random((30, 3, M)) < 0.3
        y = np.where(gaps[:, [2, 0, 1, 0, 2, 1]], np.nan, y)
    ours, theirs = kalman_filter(mean, cov, y, **p), filterpy_kf(mean, cov, y, **p)
    full = np.broadcast_to(ours.covariances, theirs.covariances.shape)
    np.testing.assert_allclose(ours.means, theirs.means, rtol=0, atol=1e-12)
    np.testing.assert_allclose(full, theirs.covariances, rtol=0, atol=1e-12)
    np.testing.assert_allclose(ours.log_likelihood, theirs.log_likelihood, rtol=0, atol=1e-11)
    shared = pattern in ("whole", "common")
    assert ours.covariances.shape == (30, 1 if shared else runs, D, D)


def test_run_axes_broadcast() -> None:
    rng = np.random.default_rng(5)
    p = problem(rng)
    y, means = rng.standard_normal((STEPS, 2, 3, M)), rng.standard_normal((3, D))
    covs = spd(rng, D, (2, 1))
    run = kalman_filter(means, covs, y, **p)
    assert run.means.shape == (STEPS, 2, 3, D) and run.log_likelihood.shape == (STEPS, 2, 3)
    one = kalman_filter(means[2], covs[1, 0], y[:, 1, 2], **p)
    np.testing.assert_allclose(run.means[:, 1, 2], one.means, rtol=0, atol=1e-12)
    np.testing.assert_allclose(run.covariances[:, 1, 2], one.covariances, rtol=0, atol=1e-12)
    series = kalman_filter(means, spd(rng, D), y[:, 0, 0], **p)  # many priors, one series
    assert series.means.shape == (STEPS, 3, D)


def test_nothing_is_mutated() -> None:
    rng = np.random.default_rng(6)
    p, mean, cov = problem(rng), rng.standard_normal(D), spd(rng, D)
    y = rng.standard_normal((STEPS, RUNS, M))
    y[2, 1, 0] = np.nan
    before = [a.copy() for a in (mean, cov, y, *p.values())]
    kalman_filter(mean, cov, y, **p)
    for a, b in zip((mean, cov, y, *p.values()), before, strict=True):
        np.testing.assert_array_equal(a, b)


# --- EKF and UKF -------------------------------------------------------------------------------


@pytest.mark.parametrize("filter_", [filterpy_ekf, filterpy_ukf])
def test_linear_case_equals_the_kalman_filter(filter_: Callable[..., Any]) -> None:
    rng = np.random.default_rng(7)
    model = clohessy_wiltshire(rate=0.1, sigma=0.2)
    sensors = [direct([0, 1], noise=0.2), direct([1, 2], noise=0.2)]
    times = np.array([0.1, 0.2, 0.4])
    y = rng.standard_normal((3, 2, 4))
    y[1, 0, 2], y[2, 1] = np.nan, np.nan
    args = (rng.standard_normal(6), spd(rng, 6), y)
    run = filter_(*args, model=model, sensors=sensors, times=times)
    steps = np.diff(times, prepend=0.0)
    exact = kalman_filter(
        *args,
        F=np.array([model.transition(dt) for dt in steps]),
        Q=np.array([model.noise(0.0, dt) for dt in steps]),
        H=stack(sensors).matrix(6),
        R=stack(sensors).noise,
    )
    np.testing.assert_allclose(run.means, exact.means, rtol=0, atol=1e-10)
    np.testing.assert_allclose(run.covariances, exact.covariances, rtol=0, atol=1e-10)


@pytest.mark.parametrize("filter_", [filterpy_ekf, filterpy_ukf])
def test_an_angle_may_wrap(filter_: Callable[..., Any]) -> None:
    # A bearing just above -pi, seen from a prior whose bearing is just below pi.
    run = filter_(
        [-1.0, 0.02], 0.01 * np.eye(2), [[-np.pi + 0.02]], model=walk(2),
        sensors=[angle([0, 1], noise=0.01, full=True)], times=[1e-6],
    )
    np.testing.assert_allclose(run.means[0], [-1.0, -0.02], atol=0.005)


def test_ekf_differences_a_nonlinear_model() -> None:
    bent = Model(1, lambda x, t, dt: np.sin(x), lambda t, dt: np.zeros((1, 1)))
    run = filterpy_ekf([0.3], [[0.5]], [[np.nan]], model=bent,
                       sensors=[direct([0], noise=1.0)], times=[1.0])
    np.testing.assert_allclose(run.covariances[0, 0, 0], 0.5 * np.cos(0.3) ** 2, rtol=1e-8)


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
    model, sensors, times = walk(2), [direct([0], noise=0.5)], np.array([1.0, 2.0, 3.0])
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
    sensor, times = direct([0], noise=0.5), [1.0, 2.0, 3.0, 4.0]
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
    run = particle_filter(np.ones((1, 1)), [[0.3]], model=walk(), sensors=[direct([0], noise=1.0)],
                          times=[1.0], rng=np.random.default_rng(0))
    assert run.effective[0] == pytest.approx(1.0)


def test_same_seed_same_bits() -> None:
    def once() -> np.ndarray:
        rng = np.random.default_rng(15)
        x = draw([0.0], [[1.0]], 50, rng=rng)
        y = simulate(walk(), [0.0], [1.0, 2.0], rng=rng)
        return particle_filter(x, y, model=walk(), sensors=[direct([0], noise=1.0)],
                               times=[1.0, 2.0], rng=rng).means

    assert (once() == once()).all()


# --- bad input ---------------------------------------------------------------------------------

_KF: dict[str, Any] = {"F": np.eye(2), "H": [[1.0, 0.0]], "Q": np.eye(2), "R": [[1.0]]}
_Y = np.zeros((3, 5, 1))
_COV = np.eye(2)
_LOPSIDED = [[1.0, 0.5], [0.0, 1.0]]
_INDEFINITE = [[1.0, 2.0], [2.0, 1.0]]


def _kf(filter_: Callable[..., Any] = kalman_filter, mean: Any = (0.0, 0.0), cov: Any = _COV,
        y: Any = _Y, **changed: Any) -> Any:
    return filter_(mean, cov, y, **{**_KF, **changed})


def _series(filter_: Callable[..., Any], first: Any = None, y: Any = _Y, **changed: Any) -> Any:
    """A call of a filter with model and sensors; one argument of it is made wrong."""
    options: dict[str, Any] = {
        "model": walk(2), "sensors": [direct([0], noise=1.0)], "times": [1.0, 2.0, 3.0],
    }
    options.update(changed)
    if filter_ in (filterpy_ekf, filterpy_ukf):
        cov = options.pop("cov", np.eye(2))
        return filter_([0.0, 0.0] if first is None else first, cov, y, **options)
    options.setdefault("rng", np.random.default_rng(0))
    return filter_(np.zeros((5, 9, 2)) if first is None else first, y, **options)


def _linear_cases(f: Callable[..., Any]) -> list[tuple[str, Callable[[], Any]]]:
    return [
        ("mean", lambda: _kf(f, mean=[0.0, np.nan])),
        ("mean", lambda: _kf(f, mean=np.zeros((4, 2)))),
        ("cov", lambda: _kf(f, cov=np.eye(3))),
        ("cov", lambda: _kf(f, cov=_LOPSIDED)),
        ("cov", lambda: _kf(f, cov=_INDEFINITE)),
        ("observations", lambda: _kf(f, y=np.zeros(3))),
        ("observations", lambda: _kf(f, y=np.full((3, 1), np.inf))),
        ("F", lambda: _kf(f, F=np.ones((4, 2, 2)))),
        ("F", lambda: _kf(f, F=np.full((2, 2), np.nan))),
        ("H", lambda: _kf(f, H=np.eye(2))),
        ("Q", lambda: _kf(f, Q=-np.eye(2))),
        ("Q", lambda: _kf(f, Q=_LOPSIDED)),
        ("R", lambda: _kf(f, R=[[0.0]])),
        ("R", lambda: _kf(f, R=[[-1.0]])),
    ]


def _series_cases(f: Callable[..., Any], first: str) -> list[tuple[str, Callable[[], Any]]]:
    wrong = np.full((5, 9, 2), np.nan) if first != "mean" else [np.nan, 0.0]
    short = np.zeros((5, 9, 3)) if first != "mean" else np.zeros(3)
    cases: list[tuple[str, Callable[[], Any]]] = [
        (first, lambda: _series(f, wrong)),
        (first if first != "mean" else "cov", lambda: _series(f, short)),
        ("observations", lambda: _series(f, y=np.zeros((3, 5, 2)))),
        ("observations", lambda: _series(f, y=np.full((3, 5, 1), np.inf))),
        ("sensors", lambda: _series(f, sensors=[])),
        ("sensors", lambda: _series(f, sensors=[differential([0], noise=1.0)])),
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
    "distfilt.kalman.kalman_filter": _linear_cases(kalman_filter),
    "distfilt.kalman.filterpy_kf": _linear_cases(filterpy_kf),
    "distfilt.kalman.predict": [
        ("mean", lambda: predict([np.nan], [[1.0]], F=[[1.0]], Q=[[1.0]])),
        ("cov", lambda: predict([0.0, 0.0], _INDEFINITE, F=np.eye(2), Q=np.eye(2))),
        ("F", lambda: predict([0.0], [[1.0]], F=np.eye(2), Q=[[1.0]])),
        ("Q", lambda: predict([0.0], [[1.0]], F=[[1.0]], Q=[[-1.0]])),
    ],
    "distfilt.kalman.update": [
        ("mean", lambda: update([np.inf], [[1.0]], [0.0], H=[[1.0]], R=[[1.0]])),
        ("cov", lambda: update([0.0, 0.0], _LOPSIDED, [0.0], H=[[1.0, 0.0]], R=[[1.0]])),
        ("observed", lambda: update([0.0], [[1.0]], [0.0, 1.0], H=[[1.0]], R=[[1.0]])),
        ("observed", lambda: update([0.0], [[1.0]], [np.inf], H=[[1.0]], R=[[1.0]])),
        ("H", lambda: update([0.0], [[1.0]], [0.0], H=[[1.0, 0.0]], R=[[1.0]])),
        ("R", lambda: update([0.0], [[1.0]], [0.0], H=[[1.0]], R=[[-1.0]])),
    ],
    "distfilt.kalman.filterpy_ekf": [
        *_series_cases(filterpy_ekf, "mean"),
        ("mean", lambda: _series(filterpy_ekf, np.zeros(3), cov=np.eye(3))),
    ],
    "distfilt.kalman.filterpy_ukf": [
        *_series_cases(filterpy_ukf, "mean"),
        ("alpha", lambda: _series(filterpy_ukf, alpha=0.0)),
        ("beta", lambda: _series(filterpy_ukf, beta=-1.0)),
        ("kappa", lambda: _series(filterpy_ukf, kappa=-2.0)),
    ],
    "distfilt.kalman.enkf": [
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
    "distfilt.kalman.enkf_filter": [
        *_series_cases(enkf_filter, "ensemble"),
        ("every", lambda: _series(enkf_filter, every=0)),
        ("observations", lambda: _series(enkf_filter, y=np.where(
            np.arange(5)[:, None] == 2, np.nan, np.zeros((3, 5, 1))))),
    ],
    "distfilt.kalman.particle_filter": [
        *_series_cases(particle_filter, "points"),
        ("threshold", lambda: _series(particle_filter, threshold=1.5)),
        ("method", lambda: _series(particle_filter, method="stratified")),
    ],
    "distfilt.kalman.Particles": [
        ("points", lambda: Particles([1.0, 2.0], [0.0, 0.0])),
        ("points", lambda: Particles([[np.nan]], [0.0])),
        ("log_weights", lambda: Particles([[1.0]], [0.0, 0.0])),
        ("log_weights", lambda: Particles([[1.0]], [np.nan])),
        ("log_weights", lambda: Particles([[1.0]], [-np.inf])),
    ],
    "distfilt.kalman.effective_size": [
        ("log_weights", lambda: effective_size(0.0)),
        ("log_weights", lambda: effective_size([np.nan, 0.0])),
    ],
    "distfilt.kalman.systematic": [
        ("probabilities", lambda: systematic([0.5, 0.4], rng=_RNG)),
        ("probabilities", lambda: systematic([1.5, -0.5], rng=_RNG)),
        ("rng", lambda: systematic([1.0], rng=1)),  # type: ignore[arg-type]
    ],
    "distfilt.kalman.resample": [
        ("particles", lambda: resample(_X, rng=_RNG)),  # type: ignore[arg-type]
        ("method", lambda: resample(Particles(_X, np.zeros(9)), rng=_RNG, method="best")),
        ("rng", lambda: resample(Particles(_X, np.zeros(9)), rng=0)),  # type: ignore[arg-type]
    ],
}

EXEMPT = {
    "distfilt.kalman.GaussianRun": "a result that only the library builds",
    "distfilt.kalman.EnsembleRun": "a result that only the library builds",
    "distfilt.kalman.ParticleRun": "a result that only the library builds",
}
