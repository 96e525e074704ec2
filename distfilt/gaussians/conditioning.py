"""A Gaussian given a linear reading: the update of every Kalman filter."""

from __future__ import annotations

from typing import Annotated

import numpy as np

from ..doors import MISSING, Array, Cov, Mask, Semidefinite, door

__all__ = ["conditioned"]


@door
def conditioned(
    mean: Annotated[Array, "... d"],
    cov: Semidefinite,
    gap: Annotated[Array, "... m", MISSING],
    H: Annotated[Array, "... m d"],
    R: Annotated[Cov, "... m m"],
) -> tuple[Array, Array]:
    r"""Condition Gaussians on readings :math:`\mathbf y=\mathbf H\mathbf x+\text{noise}`.

    Parameters
    ----------
    mean, cov : array_like, (..., d) and (..., d, d)
        The Gaussians; the covariance may be singular.
    gap : array_like, (..., m)
        The innovation, :math:`\mathbf y` less its prediction: :math:`\mathbf H` times the mean, or
        what a curved sensor makes of it. NaN leaves that component out.
    H, R : array_like, (..., m, d) and (..., m, m)
        How a reading depends on the state, and its noise covariance.

    Returns
    -------
    mean, cov : ndarray, (..., d) and (..., d, d)
        The covariance in Joseph's form. All leading axes broadcast: one covariance serves any
        number of means as long as no single component of theirs is missing.

    Raises
    ------
    numpy.linalg.LinAlgError
        If an innovation covariance is singular in floating point.

    Examples
    --------
    >>> x, p = conditioned([0.0], [[1.0]], [2.0], [[1.0]], [[1.0]])
    >>> x, p
    (array([1.]), array([[0.5]]))
    """
    missing = np.isnan(gap)
    if missing.any():
        H, R = left_out(missing, H, R)
        gap = np.where(missing, 0.0, gap)
    gain, after, _ = analysis(cov, H, R)
    return mean + (gain @ gap[..., None])[..., 0], after


def left_out(missing: Mask, H: Array, R: Array) -> tuple[Array, Array]:
    """H and R where components (..., m) are missing: a zero row, a one on the diagonal.

    That takes them out of every sum exactly.
    """
    here = ~missing[..., :, None] & ~missing[..., None, :]
    return np.where(missing[..., None], 0.0, H), np.where(here, R, np.eye(R.shape[-1]))


def analysis(cov: Array, H: Array, R: Array) -> tuple[Array, Array, Array]:
    """Gain, analysis covariance in Joseph's form, and innovation covariance."""
    cross = cov @ H.mT
    inner = H @ cross + R
    gain = np.linalg.solve(inner, cross.mT).mT
    rest = np.eye(cov.shape[-1]) - gain @ H
    after = rest @ cov @ rest.mT + gain @ R @ gain.mT
    return np.asarray(gain), np.asarray(0.5 * (after + after.mT)), inner
