"""The Gaussian log-density, the only one of the package."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from ..checks import Array, array, covariance
from ..linalg import _cholesky, _leading, _log_det, _quadratic_form

__all__ = ["log_density"]


def log_density(x: ArrayLike, mean: ArrayLike, cov: ArrayLike) -> Array:
    r"""Logarithm of the Gaussian density, (...), relative to the volume in the state's units.

    .. math:: \log N(\mathbf x;\mathbf m,\mathbf P)=-\tfrac12\bigl(
        (\mathbf x-\mathbf m)^\top\mathbf P^{-1}(\mathbf x-\mathbf m)
        +\log\det\mathbf P+d\log2\pi\bigr)

    Parameters
    ----------
    x, mean : array_like, (..., d)
        Points and means.
    cov : array_like, (..., d, d)
        Covariances, positive definite. Leading axes of the three broadcast.

    Examples
    --------
    >>> log_density([[0.0], [2.0]], [0.0], [[4.0]]).round(6)
    array([-1.612086, -2.112086])
    """
    at = array(x, "x", (..., "d"))
    centre = array(mean, "mean", (..., at.shape[-1]))
    lead = _leading(at.shape[:-1], centre.shape[:-1], "mean")
    spread = covariance(cov, "cov", at.shape[-1])
    _leading(lead, spread.shape[:-2], "cov")
    return _log_density(at - centre, _cholesky(spread))


def _log_density(gap: Array, lower: Array) -> Array:
    """Of differences (..., d) from the mean, with the covariance's Cholesky factor."""
    constant = gap.shape[-1] * np.log(2 * np.pi)
    return np.asarray(-0.5 * (_quadratic_form(lower, gap) + _log_det(lower) + constant))
