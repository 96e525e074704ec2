"""Batched extended and unscented filters: the linear case exactly, gaps, angles, covariances."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from distfilt.kalman import (
    extended_filter,
    extended_predict,
    extended_update,
    kalman_filter,
    predict,
    unscented_filter,
    unscented_predict,
    unscented_update,
    update,
)
from distfilt.models import LinearModel, Model, clohessy_wiltshire
from distfilt.sensors import Sensor, angle, differential, direct, distance_and_angle, stack
from tests.kalman.bad_input import INDEFINITE, LOPSIDED, of_changes, series_cases, with_option
from tests.kalman.problems import D, M, problem, spd, walk

PREDICTS, UPDATES = (extended_predict, unscented_predict), (extended_update, unscented_update)
FILTERS = (extended_filter, unscented_filter)
FULL = np.array([[4.0, 1.2], [1.2, 1.0]])


def _matrix(h: np.ndarray, r: np.ndarray) -> Sensor:
    return Sensor(len(h), lambda x: x @ h.T, r, linear=lambda d: h)


def _forecast(f: Callable[..., Any], **change: Any) -> Any:
    given: dict[str, Any] = {"mean": [0.0, 0.0], "cov": np.eye(2), "model": walk(2), "t": 0.0,
                             "dt": 1.0}
    options = {k: change.pop(k) for k in ("alpha", "beta", "kappa") if k in change}
    return f(*{**given, **change}.values(), **options)


def _analysis(f: Callable[..., Any], **change: Any) -> Any:
    given: dict[str, Any] = {"mean": [0.0, 0.0], "cov": np.eye(2), "observed": [1.0],
                             "sensor": direct([0], std=1.0)}
    options = {k: change.pop(k) for k in ("alpha", "beta", "kappa") if k in change}
    return f(*{**given, **change}.values(), **options)


def _predict_cases(f: Callable[..., Any]) -> list[tuple[str, Callable[[], Any]]]:
    return [
        ("mean", lambda: _forecast(f, mean=[np.nan, 0.0])),
        ("mean", lambda: _forecast(f, mean=[0.0], cov=[[1.0]])),
        ("cov", lambda: _forecast(f, cov=LOPSIDED)),
        ("cov", lambda: _forecast(f, cov=np.ones((3, 2, 2)) * np.eye(2), mean=np.zeros((4, 2)))),
        ("model", lambda: _forecast(f, model=3)),
        ("t", lambda: _forecast(f, t=np.nan)),
        ("dt", lambda: _forecast(f, dt=-1.0)),
    ]


def _update_cases(f: Callable[..., Any]) -> list[tuple[str, Callable[[], Any]]]:
    return [
        ("mean", lambda: _analysis(f, mean=[np.inf, 0.0])),
        ("mean", lambda: _analysis(f, mean=np.zeros((4, 2)), observed=np.zeros((3, 1)))),
        ("cov", lambda: _analysis(f, cov=INDEFINITE)),
        ("observed", lambda: _analysis(f, observed=[1.0, 2.0])),
        ("observed", lambda: _analysis(f, observed=[np.inf])),
        ("sensor", lambda: _analysis(f, sensor=3)),
        ("sensor", lambda: _analysis(f, sensor=differential([0], std=1.0))),
        ("x", lambda: _analysis(f, sensor=direct([5], std=1.0))),
    ]


def _weights(call: Callable[..., Any], f: Callable[..., Any]) -> list[tuple[str, Any]]:
    return [
        ("alpha", lambda: call(f, alpha=0.0)),
        ("alpha", lambda: call(f, alpha=1e-8)),
        ("alpha", lambda: call(f, alpha=1e300)),
        ("kappa", lambda: call(f, kappa=-2.0 + 1e-12)),
        ("beta", lambda: call(f, beta=1e300)),
        ("beta", lambda: call(f, beta=-1.0)),
        ("kappa", lambda: call(f, kappa=-2.0)),
    ]


BAD_INPUT: dict[str, Any] = {
    "distfilt.kalman.extended_predict": _predict_cases(extended_predict),
    "distfilt.kalman.unscented_predict": [
        *_predict_cases(unscented_predict), *_weights(_forecast, unscented_predict)],
    "distfilt.kalman.extended_update": [
        *_update_cases(extended_update),
        ("sensor", lambda: extended_update([1.0], [[1.0]], [1.0], Sensor(
            1, lambda x: x, np.eye(1), derivative=lambda x: np.nan * np.eye(1)))),
    ],
    "distfilt.kalman.unscented_update": [
        *_update_cases(unscented_update), *_weights(_analysis, unscented_update)],
    "distfilt.kalman.extended_filter": [
        *series_cases(extended_filter), of_changes(extended_filter)],
    "distfilt.kalman.unscented_filter": [
        *series_cases(unscented_filter),
        of_changes(unscented_filter),
        with_option(unscented_filter, alpha=0.0),
        with_option(unscented_filter, beta=-1.0),
        with_option(unscented_filter, kappa=-2.0),
    ],
}


@pytest.mark.parametrize("step", PREDICTS)
def test_linear_forecasts_are_exact(step: Callable[..., Any]) -> None:
    rng = np.random.default_rng(0)
    f, q = rng.standard_normal((D, D)), spd(rng, D)
    model = LinearModel.from_transition(D, lambda dt: f, lambda t, dt: q)
    mean, cov = rng.standard_normal((4, 1, D)), spd(rng, D, (5,))
    x, p = step(mean, cov, model, 0.0, 1.0)
    assert x.shape == (4, 5, D) and p.shape == (4, 5, D, D)
    for i in range(4):
        for j in range(5):
            exact = predict(mean[i, 0], cov[j], F=f, Q=q)
            np.testing.assert_allclose(x[i, j], exact[0], rtol=0, atol=1e-13)
            np.testing.assert_allclose(p[i, j], exact[1], rtol=0, atol=1e-13)
    assert (p == np.swapaxes(p, -1, -2)).all()


@pytest.mark.parametrize("step", UPDATES)
@given(seed=st.integers(0, 10**6))
def test_linear_updates_are_exact_with_any_gaps(step: Callable[..., Any], seed: int) -> None:
    """A full noise matrix, single components missing in single runs."""
    rng = np.random.default_rng(seed)
    h, r = rng.standard_normal((3, D)), spd(rng, 3)
    mean, cov, y = rng.standard_normal((6, D)), spd(rng, D, (6,)), rng.standard_normal((6, 3))
    y[rng.random(y.shape) < 0.4] = np.nan
    y[0] = np.nan
    ours, exact = step(mean, cov, y, _matrix(h, r)), update(mean, cov, y, H=h, R=r)
    for a, b in zip(ours, exact, strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-11)
    assert ours[2][0] == 0.0


@pytest.mark.parametrize("filter_", FILTERS)
@pytest.mark.parametrize("runs", [(), (1,), (2, 3)])
def test_linear_series_are_the_kalman_filter_s(
    filter_: Callable[..., Any], runs: tuple[int, ...]
) -> None:
    rng = np.random.default_rng(7)
    model = clohessy_wiltshire(rate=0.1, sigma=0.2)
    sensors = [direct([0, 1], std=0.2), direct([1, 2], std=0.2)]
    times = np.array([0.6, 0.7, 0.9])
    y = rng.standard_normal((3, *runs, 4))
    y[1, ..., 2], y[2] = np.nan, np.nan
    args = (rng.standard_normal(6), spd(rng, 6), y)
    run = filter_(*args, model=model, sensors=sensors, times=times, t0=0.5)
    steps = np.diff(times, prepend=0.5)
    both = stack(sensors)
    exact = kalman_filter(
        *args, F=np.array([model.transition(dt) for dt in steps]), H=both.matrix(6), R=both.cov,
        Q=np.array([model.noise(0.0, dt) for dt in steps]),
    )
    np.testing.assert_allclose(run.means, exact.means, rtol=0, atol=1e-12)
    full = np.broadcast_to(exact.covariances, run.covariances.shape)
    np.testing.assert_allclose(run.covariances, full, rtol=0, atol=1e-12)
    np.testing.assert_allclose(run.log_likelihood, exact.log_likelihood, rtol=0, atol=1e-10)
    assert run.covariances.shape == (3, *runs, 6, 6)


@pytest.mark.parametrize("step", UPDATES)
def test_an_angle_may_wrap(step: Callable[..., Any]) -> None:
    """Bearings on either side of the cut: turned by half a turn, nothing but the signs changes."""
    sensor = angle([0, 1], std=0.01, full=True)
    mean, cov = np.array([-1.0, 0.02]), 0.01 * FULL / 4
    x, p, density = step(mean, cov, [-np.pi + 0.02], sensor)
    assert x[1] < -0.01 < 0.0
    other = step(-mean, cov, [0.02], sensor)
    np.testing.assert_allclose(x, -other[0], atol=1e-12)
    np.testing.assert_allclose(p, other[1], atol=1e-12)
    np.testing.assert_allclose(density, other[2], atol=1e-9)
    turned = step(mean, cov, [np.pi + 0.02], sensor)
    np.testing.assert_allclose(turned[0], x, atol=1e-12)


@pytest.mark.parametrize("step", UPDATES)
def test_what_the_sensor_cannot_see_is_missing(step: Callable[..., Any]) -> None:
    """A mean at the sensor's place has no angle; its distance, and the other run, are used."""
    sensor = distance_and_angle([0, 1], std=[0.3, 0.1])
    mean, y = np.array([[0.0, 0.0], [2.0, 1.0]]), np.array([[0.5, 0.1], [2.0, 0.5]])
    x, p, density = step(mean, FULL, y, sensor)
    blind = step(mean[0], FULL, [0.5, np.nan], sensor)
    alone = step(mean[1], FULL, y[1], sensor)
    for k, other in enumerate((blind, alone)):
        np.testing.assert_allclose(x[k], other[0], atol=1e-14)
        np.testing.assert_allclose(p[k], other[1], atol=1e-14)
        np.testing.assert_allclose(density[k], other[2], atol=1e-12)


def test_extended_steps_are_the_linearised_formulas() -> None:
    def flow(x: np.ndarray, t: float, dt: float) -> np.ndarray:
        return np.stack([np.sin(x[..., 0]) + t, x[..., 0] * x[..., 1] * dt], axis=-1)

    model = Model(2, flow, lambda t, dt: (1 + t) * dt * FULL)
    mean = np.array([0.3, -0.7])
    x, p = extended_predict(mean, FULL, model, 2.0, 0.5)
    slope = np.array([[np.cos(0.3), 0.0], [-0.35, 0.15]])
    np.testing.assert_allclose(x, [np.sin(0.3) + 2, -0.105])
    np.testing.assert_allclose(p, slope @ FULL @ slope.T + 1.5 * FULL, atol=1e-8)
    sensor = Sensor(2, lambda x: np.stack([x[..., 0] ** 2, x.sum(-1)], -1), FULL)
    y = np.array([1.0, -1.0])
    x, p, density = extended_update(mean, FULL, y, sensor)
    h = np.array([[0.6, 0.0], [1.0, 1.0]])
    gap = y - [0.09, -0.4]
    exact = update(mean, FULL, gap + h @ mean, H=h, R=FULL)
    for ours, theirs in zip((x, p, density), exact, strict=True):
        np.testing.assert_allclose(ours, theirs, atol=1e-8)


@pytest.mark.parametrize("options", [{}, {"alpha": 0.6, "beta": 2.0, "kappa": 0.5}])
def test_unscented_moments_of_a_square(options: dict[str, float]) -> None:
    """Of x² + x y the points know the mean exactly: E = m² + P11 + m n + P12, in any scaling."""
    def flow(x: np.ndarray, t: float, dt: float) -> np.ndarray:
        return np.stack([x[..., 0] ** 2 + x[..., 0] * x[..., 1], x[..., 1]], axis=-1)

    model = Model(2, flow, lambda t, dt: np.zeros((2, 2)))
    x, p = unscented_predict([0.5, -1.0], FULL, model, 0.0, 1.0, **options)
    np.testing.assert_allclose(x, [0.25 + 4.0 - 0.5 + 1.2, -1.0], atol=1e-12)
    # Cov(x² + x y, y) = 2 m P12 + m P22 + n P12 for a Gaussian, and for any symmetric points.
    np.testing.assert_allclose(p[0, 1], 2 * 0.5 * 1.2 + 0.5 * 1.0 - 1.2, atol=1e-12)


@given(seed=st.integers(0, 10**6))
def test_covariances_stay_symmetric_and_positive(seed: int) -> None:
    rng = np.random.default_rng(seed)
    sensor = distance_and_angle([0, 1], std=[1e-4, 1e-4])
    mean, cov = rng.standard_normal((5, 3)), 10.0 ** rng.uniform(-6, 6) * spd(rng, 3, (5,))
    y = sensor.observe(mean + rng.standard_normal((5, 3)), rng=rng)
    for step in UPDATES:
        p = step(mean, cov, y, sensor)[1]
        assert (p == np.swapaxes(p, -1, -2)).all()
        scale = np.sqrt(np.diagonal(p, axis1=1, axis2=2))
        assert np.linalg.eigvalsh(p / scale[:, :, None] / scale[:, None, :]).min() > 0


@pytest.mark.parametrize("filter_", FILTERS)
def test_a_run_that_is_lost_is_named(filter_: Callable[..., Any]) -> None:
    burst = Model(1, lambda x, t, dt: np.where(x > 5, np.nan, x), lambda t, dt: np.eye(1) * 1e-6)
    with pytest.raises(np.linalg.LinAlgError, match=r"at t = 2: run \(1,\)|at t = 2:"):
        filter_([[0.0], [4.0]], [[1e-6]], np.full((2, 2, 1), [[0.0], [9.0]]), model=burst,
                sensors=[direct([0], std=1e-6)], times=[1.0, 2.0])


def test_nothing_is_mutated() -> None:
    rng = np.random.default_rng(6)
    mean, cov, y = rng.standard_normal((2, D)), spd(rng, D), rng.standard_normal((2, M))
    y[1, 0] = np.nan
    p = problem(rng, varying=False)
    kept = [a.copy() for a in (mean, cov, y)]
    for step in UPDATES:
        step(mean, cov, y, _matrix(p["H"], p["R"]))
    for step in PREDICTS:
        step(mean, cov, walk(D), 0.0, 1.0)
    for a, b in zip((mean, cov, y), kept, strict=True):
        np.testing.assert_array_equal(a, b)
