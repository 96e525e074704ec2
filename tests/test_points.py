"""Unscented points have the moments of their Gaussian."""

from __future__ import annotations

import numpy as np
import pytest

from distfilt.gaussians.single import unscented_points

from .support import generator, spd


@pytest.mark.parametrize("kappa", [-1.0, 0.0, 0.5, 3.0])
@pytest.mark.parametrize("d", [2, 5])
def test_points_have_the_moments(d: int, kappa: float) -> None:
    rng = generator(d)
    mean, cov = rng.standard_normal((4, d)), spd(rng, d, (4,))
    root = np.linalg.cholesky(cov) @ np.linalg.qr(rng.standard_normal((d, d)))[0]
    points, w = unscented_points(mean, root, kappa=kappa)
    assert points.shape == (4, 2 * d + 1, d) and np.isclose(w.sum(), 1)
    assert np.allclose(w @ points, mean)
    gap = points - mean[:, None]
    assert np.allclose((gap * w[:, None]).mT @ gap, cov)
    assert np.allclose(points[:, 0], mean) and np.allclose(points[:, 1:].mean(axis=1), mean)


def test_fourth_moments_along_an_axis_are_a_gaussians() -> None:
    points, w = unscented_points(np.zeros(4), np.eye(4), kappa=-1.0)
    assert np.allclose(w @ points**4, 3.0) and np.allclose(w @ points**3, 0.0)


def test_no_points_without_a_distance() -> None:
    with pytest.raises(ValueError, match="^kappa: needs a number above -2"):
        unscented_points([0.0, 0.0], np.eye(2), kappa=-2.0)
