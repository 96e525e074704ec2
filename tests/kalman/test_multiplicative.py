"""The filter on a quaternion's errors: its charts, and the plain filter where the chart is flat."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import block_diag

from distfilt.kalman import QuaternionChart, filterpy_ekf, kalman_filter, mekf
from distfilt.linalg import central_difference
from distfilt.models import Model, constant_velocity, satellite_pose, simulate
from distfilt.models.quaternions import rotate
from distfilt.sensors import component, range_bearing, stack
from distfilt.sensors.kinds import increment
from tests.support import spd, turning

POSE = QuaternionChart(13, 9)


class _Flat(QuaternionChart):
    """No quaternion: errors are differences."""

    error_dim = property(lambda self: self.dim)

    def retract(self, x: np.ndarray, e: np.ndarray) -> np.ndarray:
        return x + e

    def tangent_basis(self, x: np.ndarray) -> np.ndarray:
        return np.eye(self.dim)


@pytest.mark.parametrize(("dim", "first"), [(4, 0), (6, 1), (7, 3), (13, 9)])
def test_a_quaternion_s_chart(dim: int, first: int) -> None:
    chart = QuaternionChart(dim, first)
    rng = np.random.default_rng(dim)
    x = rng.standard_normal((5, dim))
    e = 0.5 * rng.standard_normal((5, dim - 1))
    moved = chart.retract(x, e)
    assert np.abs(chart.local(x, moved) - e).max() < 1e-13
    q = slice(first, first + 4)
    assert np.abs(
        np.linalg.norm(moved[:, q], axis=1) - np.linalg.norm(x[:, q], axis=1)
    ).max() < (1e-13)
    assert np.allclose(
        moved[:, q], rotate(x[:, q], e[:, first : first + 3]), atol=1e-15
    )
    others = np.delete(x, range(first, first + 4), 1) + np.delete(
        e, range(first, first + 3), 1
    )
    assert np.allclose(np.delete(moved, range(first, first + 4), 1), others, atol=1e-15)
    for k in range(5):
        numeric = central_difference(
            lambda v, k=k: chart.retract(
                np.broadcast_to(x[k], (*v.shape[:-1], dim)), v
            ),
            np.zeros(dim - 1),
        )
        assert np.abs(chart.tangent_basis(x[k]) - numeric).max() < 1e-9
    # Moves along the directions are errors, and a quaternion's length is none.
    b = chart.tangent_basis(x)
    cov = spd(rng, dim - 1)
    along = np.zeros_like(x)
    assert np.allclose(chart.project(x, b @ cov @ b.mT), cov)
    along[:, q] = x[:, q]
    assert np.abs(chart.project(x, along[..., None] * along[:, None])).max() < 1e-13


def test_a_flat_chart_is_the_extended_filter() -> None:
    rng = np.random.default_rng(2)
    model = turning(sigma=0.1, turn_sigma=0.05)
    start = np.array([0.0, 0.0, 1.0, 0.0, 0.2])
    cov = 0.1 * spd(rng, 5)
    sensors = [range_bearing([0, 1], std=[0.1, 0.05], origin=[3.0, 0.1])]
    y = stack(sensors).observe(start + 0.1 * rng.standard_normal((3, 4, 5)), rng=rng)
    y[1, 2, 0] = np.nan
    options = {"model": model, "sensors": sensors, "times": [0.3, 0.8, 1.8]}
    ours = mekf(start, cov, y, chart=_Flat(5, 0), **options)
    plain = filterpy_ekf(start, cov, y, **options)
    for name, most in (
        ("means", 1e-13),
        ("covariances", 1e-13),
        ("log_likelihood", 1e-10),
    ):
        np.testing.assert_allclose(
            getattr(ours, name), getattr(plain, name), rtol=0, atol=most
        )


def test_a_run_that_is_lost_is_named() -> None:
    burst = Model(
        4, lambda x, t, dt: np.where(x > 5, np.nan, x), lambda t, dt: np.eye(4) * 1e-6
    )
    with pytest.raises(np.linalg.LinAlgError, match=r"at t = 2: run 1"):
        mekf(
            [[0.0] * 4, [4.0] * 4],
            1e-6 * np.eye(4),
            np.full((2, 2, 1), [[0.0], [9.0]]),
            chart=_Flat(4, 0),
            model=burst,
            sensors=[component([0], std=1e-6)],
            times=[1.0, 2.0],
        )


def test_errors_move_by_the_derivative_of_the_flow_in_the_chart() -> None:
    rng = np.random.default_rng(4)
    x = rng.standard_normal(13)
    cov = spd(rng, 12)
    q = spd(rng, 13)
    model = replace(
        satellite_pose(rate=0.3, sigma=0.0), noise_cov=lambda t, dt: (1 + t) * q
    )
    seen = mekf(
        x,
        cov,
        [[0.1, 0.2]],
        chart=POSE,
        model=model,
        times=[0.8],
        sensors=[increment([9, 11], std=0.3)],
    )

    def before(e: np.ndarray) -> np.ndarray:
        return POSE.retract(np.broadcast_to(x, (*e.shape[:-1], 13)), e)

    def after(e: np.ndarray) -> np.ndarray:
        return model.step(before(e), 0.0, 0.8)

    slope = central_difference(lambda e: POSE.local(after(0 * e), after(e)), np.zeros(12))
    change = central_difference(lambda e: (after(e) - before(e))[..., [9, 11]], np.zeros(12))
    there = after(np.zeros(12))
    both = block_diag(cov, POSE.project(after(np.zeros(12)), q))
    slope = np.hstack([slope, np.eye(12)])
    change = np.hstack([change, POSE.tangent_basis(there)[[9, 11]]])
    gain = np.linalg.solve(
        change @ both @ change.T + 0.09 * np.eye(2), change @ both @ slope.T
    ).T
    wanted = (slope - gain @ change) @ both @ slope.T
    assert np.allclose(seen.covariances[0], wanted, atol=1e-6)


def test_changes_are_readings_of_two_states() -> None:
    """A differential sensor: equal to the Kalman filter of the doubled state (x, x before)."""
    rng = np.random.default_rng(5)
    model = constant_velocity(sigma=0.3)
    d = 4
    sensors = [increment([0, 3], std=0.2), component([1], std=0.3)]
    mean = rng.standard_normal(d)
    cov = spd(rng, d)
    y = rng.standard_normal((4, 3, 3))
    y[1, 0, 0] = y[2, 1] = np.nan
    run = mekf(
        mean,
        cov,
        y,
        chart=_Flat(d, 0),
        model=model,
        sensors=sensors,
        times=[0.5, 1.0, 1.5, 2.0],
    )
    phi = model.F(0.5)
    q = model.Q(0.0, 0.5)
    double = np.zeros((2 * d, 2 * d))
    noise = np.zeros((2 * d, 2 * d))
    double[:d, :d] = phi
    double[d:, :d] = np.eye(d)
    noise[:d, :d] = q
    h = np.zeros((3, 2 * d))
    h[0, 0] = h[1, 3] = h[2, 1] = 1.0
    h[0, d] = h[1, d + 3] = -1.0
    wide = np.kron(np.eye(2), cov)  # what was before the prior is never seen
    exact = kalman_filter(
        np.r_[mean, mean],
        wide,
        y,
        F=double,
        Q=noise,
        H=h,
        R=np.diag([0.04, 0.04, 0.09]),
    )
    np.testing.assert_allclose(run.means, exact.means[..., :d], rtol=0, atol=1e-8)
    wanted = np.broadcast_to(exact.covariances[..., :d, :d], run.covariances.shape)
    np.testing.assert_allclose(run.covariances, wanted, rtol=0, atol=1e-8)
    np.testing.assert_allclose(
        run.log_likelihood, exact.log_likelihood, rtol=0, atol=1e-7
    )


def test_an_attitude_s_uncertainty_is_honest_and_its_length_kept() -> None:
    """200 runs of a tumbling pose: NEES/d of the last step in its 99.9% band, |q| unchanged."""
    from scipy.stats import chi2

    rng = np.random.default_rng(3)
    runs = 200
    model = satellite_pose(rate=0.1, sigma=0.2, step=0.1)
    x0 = np.r_[1.0, 0.0, 0.3, 0.0, -0.2, 0.0, 0.3, 0.2, 0.1, 1.0, 0.0, 0.0, 0.0]
    cov = 0.01 * np.eye(12)
    truth = POSE.retract(
        np.broadcast_to(x0, (runs, 13)), 0.1 * rng.standard_normal((runs, 12))
    )
    times = 0.1 * np.arange(1, 21)
    path = simulate(model, truth, times, rng=rng)
    sensors = [component([0, 1, 2], std=0.2), component([9, 10, 11, 12], std=0.1)]
    y = stack(sensors).observe(path, rng=rng)
    run = mekf(x0, cov, y, chart=POSE, model=model, sensors=sensors, times=times)
    error = POSE.local(run.means[-1], path[-1])
    nees = np.einsum(
        "ri,ri->r",
        error,
        np.linalg.solve(run.covariances[-1], error[..., None])[..., 0],
    )
    low, high = chi2.ppf([5e-4, 1 - 5e-4], 12 * runs)
    assert low < nees.sum() < high
    assert np.abs(np.linalg.norm(run.means[..., 9:], axis=-1) - 1).max() < 1e-6
