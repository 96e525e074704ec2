"""Filters of filterpy with the library's interface, and the library's filters against them."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import pytest

from distfilt.filters import GaussianFilter
from distfilt.gaussians import condition
from distfilt.kalman import (
    FilterResult,
    filterpy_ekf,
    filterpy_kf,
    filterpy_ukf,
    kalman_filter,
)
from distfilt.models import Model
from distfilt.sensors import (
    Sensor,
    bearing,
    component,
    distance,
    line_angle,
    range_bearing,
    stack,
)
from tests.kalman.problems import D, M, problem, walk
from tests.support import spd, turning

FULL = np.array([[4.0, 1.2], [1.2, 1.0]])


def one_agent(
    mean: Any,
    cov: Any,
    y: Any,
    *,
    model: Model,
    sensors: Any,
    times: Any,
    **options: Any,
) -> FilterResult:
    """Run the Gaussian filter of one agent that has all sensors."""
    y = np.asarray(y)
    f = GaussianFilter(model, [stack(sensors)], **options)
    # The runs are the axes between time and component; the agents' axis has length one.
    start = f.start((mean, cov), runs=y.shape[1:-1])
    states = list(f.steps(start, times, [y]))
    means = np.array([state.means[..., 0, :] for state in states])
    covs = np.array([state.covariances[..., 0, :, :] for state in states])
    return FilterResult(means, covs, np.zeros(means.shape[:-1]))


extended = one_agent
unscented = partial(one_agent, linearization="unscented")
FILTERS = (filterpy_ekf, filterpy_ukf, extended, unscented)


@pytest.mark.parametrize("varying", [False, True])
@pytest.mark.parametrize("priors", [(), (6,)])
@pytest.mark.parametrize("missing", ["none", "common", "individual"])
def test_the_kalman_filter_equals_filterpy_s(
    varying: bool, missing: str, priors: tuple[int, ...]
) -> None:
    """With missing data and priors per run; equal covariances are shared between runs."""
    rng = np.random.default_rng(4)
    model = problem(rng, steps=30, varying=varying)
    runs = 6
    mean = rng.standard_normal((*priors, D))
    cov = spd(rng, D, priors)
    y = rng.standard_normal((30, runs, M))
    if missing != "none":
        # The same pattern for all runs, or one for each
        patterns = 1 if missing == "common" else runs
        is_missing = rng.random((30, patterns, M)) < 0.3
        y = np.where(is_missing, np.nan, y)
    result = kalman_filter(mean, cov, y, **model)
    expected = filterpy_kf(mean, cov, y, **model)
    covs = np.broadcast_to(result.covariances, expected.covariances.shape)
    np.testing.assert_allclose(result.means, expected.means, rtol=0, atol=1e-12)
    np.testing.assert_allclose(covs, expected.covariances, rtol=0, atol=1e-12)
    np.testing.assert_allclose(
        result.log_likelihood, expected.log_likelihood, rtol=0, atol=1e-11
    )
    # One covariance for all runs, if prior and pattern are common
    is_shared = missing != "individual" and not priors
    assert result.covariances.shape == (30, 1 if is_shared else runs, D, D)
    assert (covs == covs.mT).all()
    # Thirty steps of rounding leave covariances symmetric and positive definite.
    assert np.linalg.eigvalsh(covs).min() > 0


NONLINEAR = (
    (
        [0.0, 0.0, 1.0, 0.0, 0.2],
        turning(sigma=0.1, turn_sigma=0.05),
        [range_bearing([0, 1], std=[0.1, 0.05], origin=[3.0, 0.1])],
    ),
    (
        [1.0, 2.0, 0.3],
        walk(3),
        [
            component([0, 1], std=0.2),
            line_angle([1, 2], std=0.2),
            distance([0, 1, 2], std=0.3),
        ],
    ),
)


@pytest.mark.parametrize(("start", "model", "sensors"), NONLINEAR, ids=["turn", "many"])
@pytest.mark.parametrize(
    ("filter_", "reference"), [(extended, filterpy_ekf), (unscented, filterpy_ukf)]
)
def test_nonlinear_filters_equal_filterpy_s(
    filter_: Callable[..., Any],
    reference: Callable[..., Any],
    start: Any,
    model: Model,
    sensors: Any,
) -> None:
    """With missing data per run, angles that wrap, irregular times."""
    rng = np.random.default_rng(19)
    d = len(start)
    times = np.array([0.1, 0.3, 0.4, 0.8])
    truth = start + 0.1 * rng.standard_normal((3, d))
    states = np.stack([model.step(truth, 0.0, t) for t in times])
    y = stack(sensors).observe(states, rng=rng)
    # A whole observation of run 0, and single components of the others
    y[1, 0] = np.nan
    y[2, 1, 0] = np.nan
    y[3, 2, 1] = np.nan
    cov = 0.01 * spd(rng, d)
    options = {"model": model, "sensors": sensors, "times": times}
    run = filter_(start, cov, y, **options)
    expected = reference(start, cov, y, **options)
    np.testing.assert_allclose(run.means, expected.means, rtol=0, atol=1e-12)
    np.testing.assert_allclose(
        run.covariances, expected.covariances, rtol=0, atol=1e-12
    )


@pytest.mark.parametrize("filter_", FILTERS)
def test_an_angle_may_wrap(filter_: Callable[..., Any]) -> None:
    """Bearings on either side of ±π: rotated by half a turn, only the signs change."""
    options = {
        "model": walk(2),
        "sensors": [bearing([0, 1], std=0.01)],
        "times": [1e-9],
    }
    # The mean's bearing is just below π, the observed one just above -π.
    mean = np.array([-1.0, 0.02])
    cov = 0.01 * FULL / 4
    run = filter_(mean, cov, [[-np.pi + 0.02]], **options)
    # The analysis crosses the negative axis.
    assert run.means[0, 1] < -0.01
    opposite = filter_(-mean, cov, [[0.02]], **options)
    np.testing.assert_allclose(run.means, -opposite.means, atol=1e-12)
    np.testing.assert_allclose(run.covariances, opposite.covariances, atol=1e-12)
    # A full turn more is the same observation.
    wrapped = filter_(mean, cov, [[np.pi + 0.02]], **options)
    np.testing.assert_allclose(wrapped.means, run.means, atol=1e-12)


def test_an_undefined_bearing_is_missing() -> None:
    """A mean at the sensor's position has no bearing; the distance is used nevertheless."""
    options = {
        "model": walk(2),
        "times": [1e-9],
        "sensors": [range_bearing([0, 1], std=[0.3, 0.1])],
    }
    # With a bearing that cannot be compared, and without any; the distance has no derivative.
    with pytest.warns(RuntimeWarning, match="observations must be predicted"):
        run = extended([0.0, 0.0], FULL, [[0.5, 0.1]], **options)
    with pytest.warns(RuntimeWarning, match="singular point"):
        expected = extended([0.0, 0.0], FULL, [[0.5, np.nan]], **options)
    np.testing.assert_allclose(run.means, expected.means, atol=1e-14)
    np.testing.assert_allclose(run.covariances, expected.covariances, atol=1e-14)


@pytest.mark.parametrize("filter_", [extended, filterpy_ekf])
def test_extended_steps_are_the_linearised_formulas(
    filter_: Callable[..., Any],
) -> None:
    """Two forecasts with derivatives by hand, and one analysis."""

    def transition(x: np.ndarray, t: float, dt: float) -> np.ndarray:
        first = np.sin(x[..., 0]) + t
        second = x[..., 0] * x[..., 1] * dt
        return np.stack([first, second], axis=-1)

    def observe(x: np.ndarray) -> np.ndarray:
        return np.stack([x[..., 0] ** 2, x.sum(axis=-1)], axis=-1)

    options = {
        "model": Model(2, transition, lambda t, dt: (1 + t) * dt * FULL),
        "sensors": [Sensor(2, observe, FULL)],
        "times": [2.0, 2.5],
    }
    start = np.array([0.3, -0.7])
    x = start
    p = FULL
    for t, dt in ((0.0, 2.0), (2.0, 0.5)):
        # P ← J P Jᵀ + Q(t, dt), with the Jacobian at the last mean
        first_row = [np.cos(x[0]), 0.0]
        second_row = [x[1] * dt, x[0] * dt]
        jacobian = np.array([first_row, second_row])
        noise_cov = (1 + t) * dt * FULL
        p = jacobian @ p @ jacobian.T + noise_cov
        x = transition(x, t, dt)
    missing = [np.nan, np.nan]
    forecast = filter_(start, FULL, [missing, missing], **options)
    np.testing.assert_allclose(forecast.means[1], x)
    np.testing.assert_allclose(forecast.covariances[1], p, atol=1e-8)
    # The analysis is that of the linearised sensor.
    observed = np.array([1.0, -1.0])
    run = filter_(start, FULL, [missing, observed], **options)
    innovation = observed - observe(x)
    h = np.array([[2 * x[0], 0.0], [1.0, 1.0]])
    mean, cov = condition(x, p, innovation, h, FULL)
    np.testing.assert_allclose(run.means[1], mean, atol=1e-7)
    np.testing.assert_allclose(run.covariances[1], cov, atol=1e-7)


@pytest.mark.parametrize("run", [filterpy_ekf, filterpy_ukf])
def test_degrees_are_told_and_what_cannot_be_seen_is_named(run: Any) -> None:
    still = Model(2, lambda x, t, dt: x, lambda t, dt: np.zeros((2, 2)))
    prior = ([10.0, 10.0], 0.1 * np.eye(2))
    compass = bearing([0, 1], std=0.1)
    with pytest.warns(
        RuntimeWarning, match="must be angles in rad, got some 7 turns off"
    ):
        run(*prior, [[45.3]], model=still, sensors=[compass], times=[1.0])

    def see_near(x: np.ndarray) -> np.ndarray:
        first = x[..., :1]
        return np.where(first < 5, first, np.nan)

    near = Sensor(1, see_near, [[0.1]])
    with pytest.raises(ValueError, match="but a sensor cannot see at t = 1 s"):
        run(*prior, [[4.0]], model=still, sensors=[near], times=[1.0])
    # Of two sensors the other one is enough, if nothing comes from the blind one.
    both = run(
        *prior,
        [[np.nan, 10.5]],
        model=still,
        sensors=[near, component([0], std=0.1)],
        times=[1.0],
    )
    # K = P / (P + R) with P = 0.1 and R = 0.1², and an innovation of 0.5
    gain = 0.1 / 0.11
    assert np.isclose(both.means[0, 0], 10 + 0.5 * gain)
