"""Updates by the Kalman gain: each against its formula written out."""

from __future__ import annotations

import numpy as np
import pytest

from distfilt.updates import enkf, enkf_exact, enkf_sampled_covariance, etkf
from distfilt.updates.decorator import Update
from distfilt.updates.gaussian import _turned

from .cases import H, R, Y, members


def test_sampled_and_known_noise_by_their_formulas() -> None:
    x = members(40)
    zeta = np.random.default_rng(3).standard_normal((40, 2)) @ np.linalg.cholesky(R).T
    seen = x @ H.T + zeta
    for update, told, noise in (
        (enkf_sampled_covariance, seen, 0 * R),
        (enkf, x @ H.T, R),
    ):
        joint = np.cov(np.hstack([x, told]).T)
        gain = joint[:3, 3:] @ np.linalg.inv(joint[3:, 3:] + noise)
        out = update(x, x @ H.T, Y, R, rng=np.random.default_rng(3))
        assert np.allclose(out, x + (Y - seen) @ gain.T, atol=1e-12)
    zeta -= zeta.mean(axis=0)
    centred = enkf(x, x @ H.T, Y, R, rng=np.random.default_rng(3), centred=True)
    assert np.allclose(centred, x + (Y - x @ H.T - zeta) @ gain.T, atol=1e-12)


@pytest.mark.parametrize("update", [enkf_exact, etkf])
def test_moments_after_a_curved_reading_are_exact(update: Update) -> None:
    """P+ = P - K S K' for the sample covariances, also where h is not linear."""
    x = members(20)
    h = np.stack([x[:, 0] ** 2, x[:, 1] * x[:, 2]], axis=1)
    joint = np.cov(np.hstack([x, h]).T)
    s = joint[3:, 3:] + R
    gain = joint[:3, 3:] @ np.linalg.inv(s)
    out = update(x, h, Y, R, rng=np.random.default_rng(0))
    assert np.allclose(
        out.mean(axis=0), x.mean(axis=0) + gain @ (Y - h.mean(axis=0)), atol=1e-12
    )
    assert np.allclose(np.cov(out.T), joint[:3, :3] - gain @ s @ gain.T, atol=1e-12)


def test_square_root_without_rotation_is_symmetric() -> None:
    """The transform of the anomalies is the symmetric root: no rotation hides in it."""
    x = members(9)
    a = x - x.mean(axis=0)
    white = np.linalg.solve(np.linalg.cholesky(R), (a @ H.T).T).T / np.sqrt(8)
    values, vectors = np.linalg.eigh(np.eye(9) + white @ white.T)
    root = vectors @ np.diag(values**-0.5) @ vectors.T
    out = etkf(x, x @ H.T, Y, R, rng=np.random.default_rng(0), rotation="none")
    assert np.allclose(out - out.mean(axis=0), root @ a, atol=1e-12)


def test_rotation_keeps_ones_and_lengths_and_differs() -> None:
    eye = np.broadcast_to(np.eye(7), (2, 7, 7))
    turn = _turned(eye, np.random.default_rng(0))
    assert np.allclose(turn @ np.ones(7), 1, atol=1e-13)
    assert np.allclose(turn @ np.swapaxes(turn, -1, -2), np.eye(7), atol=1e-13)
    assert np.abs(turn[0] - turn[1]).max() > 0.1


def test_rotation_prefers_no_direction() -> None:
    """On average nothing is left of the anomalies, and no two members go together."""
    n = 6
    draws = 20_000
    turn = _turned(np.broadcast_to(np.eye(n), (draws, n, n)), np.random.default_rng(1))
    assert np.allclose(turn.mean(axis=0), 1 / n, atol=5 * 0.5 / np.sqrt(draws))
    cov = np.einsum("rij,rkj->jik", turn - 1 / n, turn - 1 / n) / draws
    assert np.allclose(cov, (np.eye(n) - 1 / n) / n, atol=0.012)
