"""Filterpy's filters behind our shapes, and ours against them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from distfilt.kalman import (
    extended_filter,
    filterpy_ekf,
    filterpy_kf,
    filterpy_ukf,
    kalman_filter,
    unscented_filter,
)
from distfilt.models import Model, clohessy_wiltshire, coordinated_turn, satellite_pose, simulate
from distfilt.sensors import angle, direct, distance, distance_and_angle, stack
from tests.kalman.bad_input import linear_cases, of_changes, series_cases, with_option
from tests.kalman.problems import D, M, problem, spd, walk

BAD_INPUT: dict[str, Any] = {
    "distfilt.kalman.filterpy_kf": [
        *linear_cases(filterpy_kf),
        ("likelihood", lambda: filterpy_kf(
            [0.0], [[1.0]], [[2.0]], F=[[1.0]], H=[[1.0]], Q=[[0.0]], R=[[1.0]],
            likelihood="yes")),
    ],
    "distfilt.kalman.filterpy_ekf": [*series_cases(filterpy_ekf), of_changes(filterpy_ekf)],
    "distfilt.kalman.filterpy_ukf": [
        *series_cases(filterpy_ukf),
        of_changes(filterpy_ukf),
        with_option(filterpy_ukf, alpha=0.0),
        with_option(filterpy_ukf, alpha=1e-9),
        with_option(filterpy_ukf, likelihood=None),
        with_option(filterpy_ukf, beta=-1.0),
        with_option(filterpy_ukf, kappa=-2.0),
    ],
}


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


@pytest.mark.parametrize("filter_", [filterpy_ekf, filterpy_ukf])
def test_linear_case_equals_the_kalman_filter(filter_: Callable[..., Any]) -> None:
    rng = np.random.default_rng(7)
    model = clohessy_wiltshire(rate=0.1, sigma=0.2)
    sensors = [direct([0, 1], std=0.2), direct([1, 2], std=0.2)]
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
        R=stack(sensors).cov,
    )
    np.testing.assert_allclose(run.means, exact.means, rtol=0, atol=1e-10)
    np.testing.assert_allclose(run.covariances, exact.covariances, rtol=0, atol=1e-10)


@pytest.mark.parametrize(
    ("ours", "theirs"), [(extended_filter, filterpy_ekf), (unscented_filter, filterpy_ukf)]
)
def test_angles_of_a_satellite_as_the_library_s_own_filters(
    ours: Callable[..., Any], theirs: Callable[..., Any]
) -> None:
    rng = np.random.default_rng(8)
    model = clohessy_wiltshire(rate=0.1, sigma=0.2)
    sensors = [direct([0, 1], std=0.2), angle([1, 2], std=0.2), direct([3, 4, 5], std=0.1)]
    times, start = 0.1 * np.arange(1, 61), np.array([100.0, 0, 0, 10, 0.1, 0])
    truth = simulate(model, start, times, rng=rng)
    y = stack(sensors).observe(truth, rng=rng)
    args = (start + 3, 25 * np.eye(6), y)
    one, two = (f(*args, model=model, sensors=sensors, times=times) for f in (ours, theirs))
    np.testing.assert_allclose(one.means, two.means, rtol=0, atol=1e-6)
    np.testing.assert_allclose(one.covariances, two.covariances, rtol=0, atol=1e-6)


@pytest.mark.parametrize("filter_", [filterpy_ekf, filterpy_ukf])
def test_an_angle_may_wrap(filter_: Callable[..., Any]) -> None:
    # A bearing just above -pi, seen from a prior whose bearing is just below pi.
    run = filter_(
        [-1.0, 0.02], 0.01 * np.eye(2), [[-np.pi + 0.02]], model=walk(2),
        sensors=[angle([0, 1], std=0.01, full=True)], times=[1e-6],
    )
    np.testing.assert_allclose(run.means[0], [-1.0, -0.02], atol=0.005)


def test_ekf_differences_a_nonlinear_model() -> None:
    bent = Model(1, lambda x, t, dt: np.sin(x), lambda t, dt: np.zeros((1, 1)))
    run = filterpy_ekf([0.3], [[0.5]], [[np.nan]], model=bent,
                       sensors=[direct([0], std=1.0)], times=[1.0])
    np.testing.assert_allclose(run.covariances[0, 0, 0], 0.5 * np.cos(0.3) ** 2, rtol=1e-8)


def _turn() -> dict[str, Any]:
    start, model = np.array([0.0, 0.0, 1.0, 0.0, 0.2]), coordinated_turn(sigma=0.1, turn_sigma=0.05)
    sensors = [distance_and_angle([0, 1], std=[0.1, 0.05], origin=[3.0, 0.1])]
    return {"start": start, "model": model, "sensors": sensors, "spread": 0.1}


def _pose() -> dict[str, Any]:
    start = np.r_[1.0, 0.0, 0.3, 0.0, -0.2, 0.0, 0.3, 0.2, 0.1, 1.0, 0.0, 0.0, 0.0]
    sensors = [direct([0, 1], std=0.2), angle([1, 2], std=0.2), distance([0, 1, 2], std=0.3),
               direct(range(6, 13), std=0.1)]
    return {"start": start, "model": satellite_pose(rate=0.1, sigma=0.2, step=0.1),
            "sensors": sensors, "spread": 0.01}


@pytest.mark.parametrize("make", [_turn, _pose])
@pytest.mark.parametrize(
    ("ours", "theirs", "options"),
    [
        (extended_filter, filterpy_ekf, {}),
        (unscented_filter, filterpy_ukf, {}),
        (unscented_filter, filterpy_ukf, {"alpha": 0.5, "beta": 2.0, "kappa": 0.5}),
    ],
)
def test_nonlinear_filters_agree_with_filterpy(
    ours: Callable[..., Any], theirs: Callable[..., Any], options: dict[str, float],
    make: Callable[[], dict[str, Any]],
) -> None:
    """Runs with gaps of their own, angles that wrap, irregular times: to 1e-12."""
    case, rng = make(), np.random.default_rng(19)
    sensor, times = stack(case["sensors"]), np.array([0.1, 0.3, 0.4, 0.8])
    truth = case["start"] + np.sqrt(case["spread"]) * rng.standard_normal((3, case["start"].size))
    y = sensor.observe(np.stack([case["model"].step(truth, 0.0, t) for t in times]), rng=rng)
    y[1, 0], y[2, 1, 0], y[3, 2, 1] = np.nan, np.nan, np.nan
    cov = case["spread"] * spd(rng, case["start"].size)
    setting = {"model": case["model"], "sensors": case["sensors"], "times": times, **options}
    run = ours(case["start"], cov, y, **setting)
    other = theirs(case["start"], cov, y, **setting, likelihood=True)
    np.testing.assert_allclose(run.means, other.means, rtol=0, atol=1e-12)
    np.testing.assert_allclose(run.covariances, other.covariances, rtol=0, atol=1e-12)
    np.testing.assert_allclose(run.log_likelihood, other.log_likelihood, rtol=0, atol=1e-9)
