"""Filterpy's filters behind our shapes; ours, and one agent's Gaussian filter, against them."""

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
    component,
    distance,
    bearing,
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
    """The Gaussian filter of one agent that holds all sensors."""
    y = np.asarray(y)
    f = GaussianFilter(model, [stack(sensors)], **options)
    states = list(f.steps(f.start((mean, cov), runs=y.shape[1:-1]), times, [y]))
    means = np.array([s.means[..., 0, :] for s in states])
    covs = np.array([s.covariances[..., 0, :, :] for s in states])
    return FilterResult(means, covs, np.zeros(means.shape[:-1]))


extended = one_agent
unscented = partial(one_agent, linearization="unscented")
FILTERS = (filterpy_ekf, filterpy_ukf, extended, unscented)


@pytest.mark.parametrize("varying", [False, True])
@pytest.mark.parametrize("priors", [(), (6,)])
@pytest.mark.parametrize("pattern", ["whole", "common", "own"])
def test_equal_to_filterpy(
    varying: bool, pattern: str, priors: tuple[int, ...]
) -> None:
    """Runs with gaps and priors of their own; covariances are shared where they are the same."""
    rng = np.random.default_rng(4)
    p = problem(rng, steps=30, varying=varying)
    runs = 6
    mean = rng.standard_normal((*priors, D))
    cov = spd(rng, D, priors)
    y = rng.standard_normal((30, runs, M))
    if pattern != "whole":
        y = np.where(
            rng.random((30, 1 if pattern == "common" else runs, M)) < 0.3, np.nan, y
        )
    ours = kalman_filter(mean, cov, y, **p)
    theirs = filterpy_kf(mean, cov, y, **p)
    full = np.broadcast_to(ours.covariances, theirs.covariances.shape)
    np.testing.assert_allclose(ours.means, theirs.means, rtol=0, atol=1e-12)
    np.testing.assert_allclose(full, theirs.covariances, rtol=0, atol=1e-12)
    np.testing.assert_allclose(
        ours.log_likelihood, theirs.log_likelihood, rtol=0, atol=1e-11
    )
    shared = pattern in ("whole", "common") and not priors
    assert ours.covariances.shape == (30, 1 if shared else runs, D, D)
    assert (full == full.mT).all() and np.linalg.eigvalsh(full).min() > 0


BENT = (
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


@pytest.mark.parametrize(("start", "model", "sensors"), BENT, ids=["turn", "many"])
@pytest.mark.parametrize(
    ("ours", "theirs"), [(extended, filterpy_ekf), (unscented, filterpy_ukf)]
)
def test_nonlinear_filters_agree_with_filterpy(
    ours: Callable[..., Any],
    theirs: Callable[..., Any],
    start: Any,
    model: Model,
    sensors: Any,
) -> None:
    """Runs with gaps of their own, angles that wrap, irregular times."""
    rng = np.random.default_rng(19)
    d = len(start)
    times = np.array([0.1, 0.3, 0.4, 0.8])
    truth = start + 0.1 * rng.standard_normal((3, d))
    path = np.stack([model.step(truth, 0.0, t) for t in times])
    y = stack(sensors).observe(path, rng=rng)
    y[1, 0] = np.nan
    y[2, 1, 0] = np.nan
    y[3, 2, 1] = np.nan
    cov = 0.01 * spd(rng, d)
    both = ours, theirs
    run, other = (
        f(start, cov, y, model=model, sensors=sensors, times=times) for f in both
    )
    np.testing.assert_allclose(run.means, other.means, rtol=0, atol=1e-12)
    np.testing.assert_allclose(run.covariances, other.covariances, rtol=0, atol=1e-12)


@pytest.mark.parametrize("filter_", FILTERS)
def test_an_angle_may_wrap(filter_: Callable[..., Any]) -> None:
    """Bearings on either side of the cut: turned by half a turn, nothing but the signs changes."""
    options = {
        "model": walk(2),
        "sensors": [bearing([0, 1], std=0.01)],
        "times": [1e-9],
    }
    mean = np.array([-1.0, 0.02])
    cov = 0.01 * FULL / 4
    run = filter_(mean, cov, [[-np.pi + 0.02]], **options)
    assert run.means[0, 1] < -0.01
    other = filter_(-mean, cov, [[0.02]], **options)
    np.testing.assert_allclose(run.means, -other.means, atol=1e-12)
    np.testing.assert_allclose(run.covariances, other.covariances, atol=1e-12)
    turned = filter_(mean, cov, [[np.pi + 0.02]], **options)
    np.testing.assert_allclose(turned.means, run.means, atol=1e-12)


def test_what_the_sensor_cannot_see_is_missing() -> None:
    """A mean at the sensor's place has no angle; its distance is used all the same."""
    options = {
        "model": walk(2),
        "times": [1e-9],
        "sensors": [range_bearing([0, 1], std=[0.3, 0.1])],
    }
    here, blind = (
        extended([0.0, 0.0], FULL, [[0.5, z]], **options) for z in (0.1, np.nan)
    )
    np.testing.assert_allclose(here.means, blind.means, atol=1e-14)
    np.testing.assert_allclose(here.covariances, blind.covariances, atol=1e-14)


@pytest.mark.parametrize("filter_", [extended, filterpy_ekf])
def test_extended_steps_are_the_linearised_formulas(
    filter_: Callable[..., Any],
) -> None:
    def flow(x: np.ndarray, t: float, dt: float) -> np.ndarray:
        return np.stack([np.sin(x[..., 0]) + t, x[..., 0] * x[..., 1] * dt], axis=-1)

    model = Model(2, flow, lambda t, dt: (1 + t) * dt * FULL)
    sensor = Sensor(2, lambda x: np.stack([x[..., 0] ** 2, x.sum(-1)], -1), FULL)
    options = {"model": model, "sensors": [sensor], "times": [2.0, 2.5]}
    x = np.array([0.3, -0.7])
    p = FULL
    for t, dt in ((0.0, 2.0), (2.0, 0.5)):
        slope = np.array([[np.cos(x[0]), 0.0], [x[1] * dt, x[0] * dt]])
        x = flow(x, t, dt)
        p = slope @ p @ slope.T + (1 + t) * dt * FULL
    gone = [np.nan, np.nan]
    ahead = filter_([0.3, -0.7], FULL, [gone, gone], **options)
    np.testing.assert_allclose(ahead.means[1], x)
    np.testing.assert_allclose(ahead.covariances[1], p, atol=1e-8)
    run = filter_([0.3, -0.7], FULL, [gone, [1.0, -1.0]], **options)
    gap = [1.0 - x[0] ** 2, -1.0 - x.sum()]
    h = np.array([[2 * x[0], 0.0], [1.0, 1.0]])
    for ours, exact in zip(
        (run.means, run.covariances), condition(x, p, gap, h, FULL), strict=True
    ):
        np.testing.assert_allclose(ours[1], exact, atol=1e-7)
