"""The multiplicative filter: its charts, and the extended filter where the chart is flat."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import block_diag
from scipy.stats import chi2

from distfilt.derivatives import central_difference
from distfilt.kalman import QuaternionChart, filterpy_ekf, kalman_filter, mekf
from distfilt.models import Model, constant_velocity, satellite_pose, simulate
from distfilt.models.quaternions import rotate
from distfilt.sensors import component, range_bearing, stack
from distfilt.sensors.kinds import increment
from tests.support import spd, turning

POSE = QuaternionChart(13, 9)


class _FlatChart(QuaternionChart):
    """Chart without a quaternion: errors are differences."""

    error_dim = property(lambda self: self.dim)

    def retract(self, x: np.ndarray, e: np.ndarray) -> np.ndarray:
        return x + e

    def tangent_basis(self, x: np.ndarray) -> np.ndarray:
        return np.eye(self.dim)


CHARTS = pytest.mark.parametrize(("dim", "first"), [(4, 0), (6, 1), (7, 3), (13, 9)])


@CHARTS
def test_local_inverts_retract(dim: int, first: int) -> None:
    chart = QuaternionChart(dim, first)
    rng = np.random.default_rng(dim)
    x = rng.standard_normal((5, dim))
    # Rotations of less than π, for which the error is unique
    e = 0.5 * rng.standard_normal((5, dim - 1))
    result = chart.retract(x, e)
    assert np.abs(chart.local(x, result) - e).max() < 1e-13


@CHARTS
def test_retract_rotates_the_quaternion_and_adds_to_other_components(
    dim: int, first: int
) -> None:
    chart = QuaternionChart(dim, first)
    rng = np.random.default_rng(dim)
    x = rng.standard_normal((5, dim))
    e = 0.5 * rng.standard_normal((5, dim - 1))
    result = chart.retract(x, e)
    # The quaternion, whose length is conserved
    q = slice(first, first + 4)
    rotated = rotate(x[:, q], e[:, first : first + 3])
    assert np.allclose(result[:, q], rotated, atol=1e-15)
    lengths = np.linalg.norm(x[:, q], axis=1)
    new_lengths = np.linalg.norm(result[:, q], axis=1)
    assert np.abs(new_lengths - lengths).max() < 1e-13
    # The other components of state and error
    others = np.delete(np.arange(dim), q)
    other_errors = np.delete(np.arange(dim - 1), slice(first, first + 3))
    expected = x[:, others] + e[:, other_errors]
    assert np.allclose(result[:, others], expected, atol=1e-15)


@CHARTS
def test_the_tangent_basis_is_the_derivative_of_retract(dim: int, first: int) -> None:
    """With respect to the error, at zero."""
    chart = QuaternionChart(dim, first)
    for x in np.random.default_rng(dim).standard_normal((5, dim)):

        def retract(e: np.ndarray, x: np.ndarray = x) -> np.ndarray:
            states = np.broadcast_to(x, (*e.shape[:-1], dim))
            return chart.retract(states, e)

        derivative = central_difference(retract, np.zeros(dim - 1))
        assert np.abs(chart.tangent_basis(x) - derivative).max() < 1e-9


@CHARTS
def test_projection_inverts_the_basis_and_ignores_the_quaternion_s_length(
    dim: int, first: int
) -> None:
    chart = QuaternionChart(dim, first)
    rng = np.random.default_rng(dim)
    x = rng.standard_normal((5, dim))
    cov = spd(rng, dim - 1)
    # B P Bᵀ is the covariance of states whose errors have the covariance P.
    basis = chart.tangent_basis(x)
    state_cov = basis @ cov @ basis.mT
    assert np.allclose(chart.project(x, state_cov), cov)
    # A change of the length along the quaternion is no error.
    along = np.zeros_like(x)
    quaternion = slice(first, first + 4)
    along[:, quaternion] = x[:, quaternion]
    radial = along[..., None] * along[:, None]
    assert np.abs(chart.project(x, radial)).max() < 1e-13


def test_a_flat_chart_gives_the_extended_kalman_filter() -> None:
    """Of filterpy, for a nonlinear model, an angle and a missing component."""
    rng = np.random.default_rng(2)
    model = turning(sigma=0.1, turn_sigma=0.05)
    start = np.array([0.0, 0.0, 1.0, 0.0, 0.2])
    cov = 0.1 * spd(rng, 5)
    sensors = [range_bearing([0, 1], std=[0.1, 0.05], origin=[3.0, 0.1])]
    states = start + 0.1 * rng.standard_normal((3, 4, 5))
    y = stack(sensors).observe(states, rng=rng)
    y[1, 2, 0] = np.nan
    options = {"model": model, "sensors": sensors, "times": [0.3, 0.8, 1.8]}
    # With x + e as retraction the error-state filter is the extended filter.
    result = mekf(start, cov, y, chart=_FlatChart(5, 0), **options)
    expected = filterpy_ekf(start, cov, y, **options)
    np.testing.assert_allclose(result.means, expected.means, rtol=0, atol=1e-13)
    np.testing.assert_allclose(
        result.covariances, expected.covariances, rtol=0, atol=1e-13
    )
    np.testing.assert_allclose(
        result.log_likelihood, expected.log_likelihood, rtol=0, atol=1e-10
    )


def test_a_run_that_is_no_longer_finite_is_named() -> None:
    """Run 1 is drawn beyond 5, from where its transition is NaN, in the second step."""

    def transition(x: np.ndarray, t: float, dt: float) -> np.ndarray:
        return np.where(x > 5, np.nan, x)

    with pytest.raises(np.linalg.LinAlgError, match=r"at t = 2: run 1"):
        mekf(
            [[0.0] * 4, [4.0] * 4],
            1e-6 * np.eye(4),
            np.full((2, 2, 1), [[0.0], [9.0]]),
            chart=_FlatChart(4, 0),
            model=Model(4, transition, lambda t, dt: np.eye(4) * 1e-6),
            sensors=[component([0], std=1e-6)],
            times=[1.0, 2.0],
        )


def test_errors_are_propagated_by_the_derivative_of_the_transition_in_the_chart() -> (
    None
):
    """One step with a sensor of increments, by numerical derivatives of local and retract."""
    rng = np.random.default_rng(4)
    x = rng.standard_normal(13)
    cov = spd(rng, 12)
    q = spd(rng, 13)
    pose = satellite_pose(rate=0.3, sigma=0.0)
    model = replace(pose, noise_cov=lambda t, dt: (1 + t) * q)
    # An increment depends on both ends of the step, whose errors are correlated.
    run = mekf(
        x,
        cov,
        [[0.1, 0.2]],
        chart=POSE,
        model=model,
        times=[0.8],
        sensors=[increment([9, 11], std=0.3)],
    )

    def start(e: np.ndarray) -> np.ndarray:
        return POSE.retract(np.broadcast_to(x, (*e.shape[:-1], 13)), e)

    def end(e: np.ndarray) -> np.ndarray:
        return model.step(start(e), 0.0, 0.8)

    def end_error(e: np.ndarray) -> np.ndarray:
        return POSE.local(end(0 * e), end(e))

    def change(e: np.ndarray) -> np.ndarray:
        return (end(e) - start(e))[..., [9, 11]]

    zero = np.zeros(12)
    forecast = end(zero)
    # Initial errors and noises are independent: (e, w) with a block diagonal
    # covariance.
    joint = block_diag(cov, POSE.project(forecast, q))
    # Final error A e + w, and observed increment C e + H B w
    a = np.hstack([central_difference(end_error, zero), np.eye(12)])
    noise_part = POSE.tangent_basis(forecast)[[9, 11]]
    c = np.hstack([central_difference(change, zero), noise_part])
    innovation_cov = c @ joint @ c.T + 0.09 * np.eye(2)
    # Cov(end error | y) = (A - K C) P Aᵀ with K = A P Cᵀ S⁻¹
    gain = np.linalg.solve(innovation_cov, c @ joint @ a.T).T
    expected = (a - gain @ c) @ joint @ a.T
    assert np.allclose(run.covariances[0], expected, atol=1e-6)


def test_sensors_of_increments_equal_the_kalman_filter_of_earlier_states() -> None:
    """The state (x, earlier x, earlier x), one earlier for each observed increment.

    An earlier state is replaced by the present one when its increment was observed, not when it
    was missing.
    """
    rng = np.random.default_rng(5)
    model = constant_velocity(sigma=0.3)
    d = 4
    mean = rng.standard_normal(d)
    cov = spd(rng, d)
    y = rng.standard_normal((4, 3, 3))
    y[1, 0, 0] = np.nan
    y[2, 1] = np.nan
    run = mekf(
        mean,
        cov,
        y,
        chart=_FlatChart(d, 0),
        model=model,
        sensors=[increment([0, 3], std=0.2), component([1], std=0.3)],
        times=[0.5, 1.0, 1.5, 2.0],
    )
    noise_cov = block_diag(model.Q(0.0, 0.5), np.zeros((2 * d, 2 * d)))
    h = np.zeros((3, 3 * d))
    # Increments of components 0 and 3, and component 1 itself
    h[0, [0, d]] = 1.0, -1.0
    h[1, [3, 2 * d + 3]] = 1.0, -1.0
    h[2, 1] = 1.0
    for r in range(3):
        transitions = []
        for k in range(4):
            transition = block_diag(model.F(0.5), np.eye(d), np.eye(d))
            for j in range(2):
                # At the first step, and after an observation, the present state is copied.
                if k == 0 or not np.isnan(y[k - 1, r, j]):
                    rows = slice((1 + j) * d, (2 + j) * d)
                    transition[rows] = 0.0
                    transition[rows, :d] = np.eye(d)
            transitions.append(transition)
        expected = kalman_filter(
            np.tile(mean, 3),
            # The earlier states are replaced before they are observed.
            block_diag(cov, cov, cov),
            y[:, r],
            F=np.array(transitions),
            Q=noise_cov,
            H=h,
            R=np.diag([0.04, 0.04, 0.09]),
        )
        np.testing.assert_allclose(run.means[:, r], expected.means[:, :d], atol=1e-8)
        covs = expected.covariances[:, :d, :d]
        np.testing.assert_allclose(run.covariances[:, r], covs, atol=1e-8)
        logs = expected.log_likelihood
        np.testing.assert_allclose(run.log_likelihood[:, r], logs, atol=1e-7)


def test_the_uncertainty_of_an_attitude_is_consistent_and_its_length_conserved() -> (
    None
):
    """200 runs of a tumbling pose: NEES of the last step in its 99.9% interval, |q| = 1."""
    rng = np.random.default_rng(3)
    runs = 200
    model = satellite_pose(rate=0.1, sigma=0.2, step=0.1)
    translation = [1.0, 0.0, 0.3, 0.0, -0.2, 0.0]
    x0 = np.array([*translation, 0.3, 0.2, 0.1, 1.0, 0.0, 0.0, 0.0])
    cov = 0.01 * np.eye(12)
    errors = 0.1 * rng.standard_normal((runs, 12))
    # The truth is drawn from the filter's prior.
    truth = POSE.retract(np.broadcast_to(x0, (runs, 13)), errors)
    times = 0.1 * np.arange(1, 21)
    states = simulate(model, truth, times, rng=rng)
    sensors = [component([0, 1, 2], std=0.2), component([9, 10, 11, 12], std=0.1)]
    y = stack(sensors).observe(states, rng=rng)
    run = mekf(x0, cov, y, chart=POSE, model=model, sensors=sensors, times=times)
    # eᵀ P⁻¹ e, summed over the runs, is χ² distributed with 12 degrees of freedom each.
    error = POSE.local(run.means[-1], states[-1])
    whitened = np.linalg.solve(run.covariances[-1], error[..., None])
    nees = (error * whitened[..., 0]).sum()
    low, high = chi2.ppf([5e-4, 1 - 5e-4], 12 * runs)
    assert low < nees < high
    lengths = np.linalg.norm(run.means[..., 9:], axis=-1)
    assert np.abs(lengths - 1).max() < 1e-6
