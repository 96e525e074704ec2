"""Updates by the Kalman gain: each against its formula written out."""

from __future__ import annotations

import numpy as np
import pytest

from distfilt.updates import enkf, enkf_exact, enkf_sampled_covariance, etkf
from distfilt.updates.decorator import Update
from distfilt.updates.gaussian import _rotate_members

from .cases import H, R, Y, members


def _gain(x: np.ndarray, y: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """Return the gain C_xy (C_yy + R)^-1 of samples by numpy, for three components."""
    joint = np.cov(np.hstack([x, y]).T)
    innovation_cov = joint[3:, 3:] + noise
    return joint[:3, 3:] @ np.linalg.inv(innovation_cov)


def test_perturbed_observations_by_their_formulas() -> None:
    """x + K (y* - h - zeta), with R sampled or exact in the gain."""
    x = members(40)
    h = x @ H.T
    normal = np.random.default_rng(3).standard_normal((40, 2))
    zeta = normal @ np.linalg.cholesky(R).T
    perturbed = h + zeta
    # C_yy of the perturbed predictions contains a sampled R; below R is exact.
    gain = _gain(x, perturbed, 0 * R)
    analysis = enkf_sampled_covariance(x, h, Y, R, rng=np.random.default_rng(3))
    expected = x + (Y - perturbed) @ gain.T
    assert np.allclose(analysis, expected, atol=1e-12)
    gain = _gain(x, h, R)
    analysis = enkf(x, h, Y, R, rng=np.random.default_rng(3))
    expected = x + (Y - perturbed) @ gain.T
    assert np.allclose(analysis, expected, atol=1e-12)
    # Centred draws: the same gain, and the mean of zeta is subtracted.
    zeta -= zeta.mean(axis=0)
    centred = enkf(x, h, Y, R, rng=np.random.default_rng(3), centred=True)
    expected = x + (Y - h - zeta) @ gain.T
    assert np.allclose(centred, expected, atol=1e-12)


@pytest.mark.parametrize("update", [enkf_exact, etkf])
def test_moments_after_a_nonlinear_observation_are_exact(update: Update) -> None:
    """P+ = P - K S K' for the sample covariances, also where h is not linear."""
    x = members(20)
    square = x[:, 0] ** 2
    product = x[:, 1] * x[:, 2]
    h = np.stack([square, product], axis=1)
    joint = np.cov(np.hstack([x, h]).T)
    # S = C_hh + R, of the sample moments of state and prediction
    s = joint[3:, 3:] + R
    gain = _gain(x, h, R)
    analysis = update(x, h, Y, R, rng=np.random.default_rng(0))
    innovation = Y - h.mean(axis=0)
    mean = x.mean(axis=0) + gain @ innovation
    covariance = joint[:3, :3] - gain @ s @ gain.T
    assert np.allclose(analysis.mean(axis=0), mean, atol=1e-12)
    assert np.allclose(np.cov(analysis.T), covariance, atol=1e-12)


def test_etkf_without_rotation_is_symmetric() -> None:
    """The anomalies are multiplied by the symmetric (I + S S')^(-1/2): it contains no rotation."""
    x = members(9)
    anomalies = x - x.mean(axis=0)
    root = np.linalg.cholesky(R)
    # S = H X' R^(-1/2) / √(N - 1)
    predicted_anomalies = anomalies @ H.T
    whitened = np.linalg.solve(root, predicted_anomalies.T).T / np.sqrt(8)
    precision = np.eye(9) + whitened @ whitened.T
    values, vectors = np.linalg.eigh(precision)
    transform = vectors @ np.diag(values**-0.5) @ vectors.T
    analysis = etkf(x, x @ H.T, Y, R, rng=np.random.default_rng(0), rotation="none")
    new_anomalies = analysis - analysis.mean(axis=0)
    assert np.allclose(new_anomalies, transform @ anomalies, atol=1e-12)


def test_a_rotation_keeps_ones_and_lengths() -> None:
    """Applied to the identity it is the rotation matrix itself: orthogonal, with Q 1 = 1."""
    identity = np.broadcast_to(np.eye(7), (2, 7, 7))
    rotation = _rotate_members(identity, np.random.default_rng(0))
    # Q 1 = 1 keeps the mean, Q Qᵀ = I the covariance.
    assert np.allclose(rotation @ np.ones(7), 1, atol=1e-13)
    product = rotation @ np.swapaxes(rotation, -1, -2)
    assert np.allclose(product, np.eye(7), atol=1e-13)
    # Ensembles of a batch have rotations of their own.
    assert np.abs(rotation[0] - rotation[1]).max() > 0.1


def test_a_rotation_prefers_no_direction() -> None:
    """As for a uniform rotation, the mean is 1 1'/n and the rows' covariance (I - 1 1'/n) / n."""
    n = 6
    draws = 20_000
    identity = np.broadcast_to(np.eye(n), (draws, n, n))
    rotation = _rotate_members(identity, np.random.default_rng(1))
    # Five standard errors of entries whose deviation is below one half.
    five_errors = 5 * 0.5 / np.sqrt(draws)
    assert np.allclose(rotation.mean(axis=0), 1 / n, atol=five_errors)
    centred = rotation - 1 / n
    covariance = np.einsum("rij,rkj->jik", centred, centred) / draws
    expected = (np.eye(n) - 1 / n) / n
    assert np.allclose(covariance, expected, atol=0.012)
