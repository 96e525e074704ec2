"""Scores of a predicted distribution: error and claimed uncertainty in one number."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from ..checks import Array, array, instance
from ..checks import weights as unit_weights
from ..gaussians import _log_density
from ..linalg import _cholesky, _leading
from .consistency import _spread
from .errors import _ensemble, _truth

__all__ = ["crps", "gaussian_crps", "log_score"]


def crps(
    ensemble: ArrayLike, truth: ArrayLike, *, fair: bool = False, weights: ArrayLike | None = None
) -> Array:
    r"""Continuous ranked probability score (..., d) of an ensemble by component; smaller is better.

    :math:`\operatorname{mean}_i|x_i-y|-\tfrac12\operatorname{mean}_{i,j}|x_i-x_j|`, the integral of
    the squared difference between the members' distribution function and the truth's step. It
    rewards a small error and a spread that fits, in the state's unit. O(N log N) by sorting.

    Parameters
    ----------
    ensemble : array_like, (..., N, d)
        Members.
    truth : array_like, (..., d)
    fair : bool
        Average the pairs over i ≠ j, N (N - 1) of them: unbiased for the score of the distribution
        that the members are drawn from. Needs N >= 2.
    weights : array_like, (..., N), optional
        Of the members, with sum one; equal by default. Not together with `fair`.

    Notes
    -----
    T. Gneiting and A. E. Raftery, Journal of the American Statistical Association 102 (2007)
    359-378, equation (21); C. A. T. Ferro, Quarterly Journal of the Royal Meteorological Society
    140 (2014) 1917-1923, for the fair version.

    Examples
    --------
    >>> crps([[0.0], [2.0]], [1.0])
    array([0.5])
    >>> crps([[0.0], [2.0]], [1.0], fair=True)
    array([0.])
    """
    x = _ensemble(ensemble, 2 if instance(fair, "fair", bool) else 1)
    n = x.shape[-2]
    t = _truth(truth, (*x.shape[:-2], x.shape[-1]))
    if weights is not None:
        return _weighted_crps(x - t[..., None, :], weights, fair)
    # Distances from the truth are as good as the members, and lose fewer digits far from zero.
    gap = np.sort(x - t[..., None, :], axis=-2)
    rank = 2.0 * np.arange(1, n + 1) - n - 1
    pairs = (rank[:, None] * gap).sum(axis=-2) / (n * (n - 1 if fair else n))
    return np.asarray(np.abs(gap).mean(axis=-2) - pairs)


def _weighted_crps(gap: Array, weights: ArrayLike, fair: bool) -> Array:
    if fair:
        raise ValueError("fair: needs members of equal weight, got weights")
    w = unit_weights(array(weights, "weights", gap.shape[:-1]), "weights")
    order = np.argsort(gap, axis=-2)
    gap = np.take_along_axis(gap, order, axis=-2)
    share = np.take_along_axis(np.broadcast_to(w[..., None], gap.shape), order, axis=-2)
    above = 2 * np.cumsum(share, axis=-2) - share - 1
    return np.asarray((share * (np.abs(gap) - above * gap)).sum(axis=-2))


def gaussian_crps(mean: ArrayLike, std: ArrayLike, truth: ArrayLike) -> Array:
    r"""Continuous ranked probability score of Gaussians, componentwise, (...).

    :math:`\sigma\,[z(2\Phi(z)-1)+2\varphi(z)-1/\sqrt\pi]` with :math:`z=(y-\mu)/\sigma`.

    Parameters
    ----------
    mean, truth : array_like, (...)
    std : array_like, (...)
        Standard deviations, positive. The three arrays broadcast.

    Notes
    -----
    T. Gneiting and A. E. Raftery, Journal of the American Statistical Association 102 (2007)
    359-378, section 4.2.

    Examples
    --------
    >>> float(gaussian_crps(0.0, 1.0, 0.0).round(6))
    0.233695
    """
    from scipy.special import ndtr

    m, s, t = array(mean, "mean"), array(std, "std"), array(truth, "truth")
    if s.size and s.min() <= 0:
        raise ValueError(f"std: needs positive standard deviations, got {s.min():.6g}")
    _leading(_leading(m.shape, s.shape, "std"), t.shape, "truth")
    z = (t - m) / s
    density = np.exp(-0.5 * z**2) / np.sqrt(2 * np.pi)
    return np.asarray(s * (z * (2 * ndtr(z) - 1) + 2 * density - 1 / np.sqrt(np.pi)))


def log_score(estimate: ArrayLike, cov: ArrayLike, truth: ArrayLike) -> Array:
    r"""Minus the log-density of a Gaussian estimate at the truth, (...); smaller is better.

    It rewards a small error and a covariance that fits, of all components together. The score of
    an honest Gaussian is :math:`\tfrac12\log\det(2\pi e\mathbf P)` on average, and every other
    covariance scores worse.

    Parameters
    ----------
    estimate, truth : array_like, (..., d)
        Leading axes broadcast.
    cov : array_like, (..., d, d)
        The estimate's covariance, positive definite.

    Examples
    --------
    >>> float(log_score([0.0], [[1.0]], [1.0]).round(6))
    1.418939
    """
    e = array(estimate, "estimate", (..., "d"))
    gap = e - _truth(truth, e.shape)
    return -_log_density(gap, _cholesky(_spread(cov, gap.shape)))
