"""The smoother of Rauch, Tung and Striebel: what later observations say about earlier states."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from ..checks import Array, array, instance
from ..linalg import _symmetrise
from .linear import GaussianRun, _noise_per_step, _per_step

__all__ = ["rts_smoother"]


def rts_smoother(run: GaussianRun, *, F: ArrayLike, Q: ArrayLike) -> GaussianRun:
    r"""States given all observations, backwards through a Kalman filter's run.

    With the forecast :math:`\mathbf P^-_{k+1} = \mathbf F\mathbf P_k\mathbf F^\top+\mathbf Q` and
    the gain :math:`\mathbf G_k = \mathbf P_k\mathbf F^\top(\mathbf P^-_{k+1})^{-1}`,

    .. math:: \mathbf x^s_k = \mathbf x_k + \mathbf G_k(\mathbf x^s_{k+1}-\mathbf F\mathbf x_k),
        \qquad \mathbf P^s_k = \mathbf P_k
        + \mathbf G_k(\mathbf P^s_{k+1}-\mathbf P^-_{k+1})\mathbf G_k^\top.

    Parameters
    ----------
    run : GaussianRun
        What :func:`kalman_filter` left, with any number of runs and gaps. The result has its
        shapes and its log-likelihoods.
    F, Q : array_like, (d, d) or (T, d, d)
        Those that the filter had: the first of T leads from the prior to the first observation.

    Raises
    ------
    numpy.linalg.LinAlgError
        If a forecast covariance is not positive definite.

    Notes
    -----
    H. E. Rauch, F. Tung and C. T. Striebel, AIAA Journal 3 (1965) 1445-1450. The covariance is
    computed as the sum of squares :math:`(\mathbf I-\mathbf G\mathbf F)\mathbf P
    (\mathbf I-\mathbf G\mathbf F)^\top + \mathbf G(\mathbf P^s+\mathbf Q)\mathbf G^\top`.

    Examples
    --------
    >>> from distfilt.kalman import kalman_filter
    >>> model = {"F": [[1.0]], "Q": [[1.0]]}
    >>> y = np.array([[np.nan], [2.0]])
    >>> run = kalman_filter([0.0], [[1.0]], y, H=[[1.0]], R=[[1.0]], **model)
    >>> rts_smoother(run, **model).means.ravel()
    array([1. , 1.5])
    """
    instance(run, "run", GaussianRun)
    _series(run)
    steps, d = len(run.means), run.means.shape[-1]
    f = _per_step(F, "F", steps, (d, d))
    q = _noise_per_step(Q, "Q", steps, d, semidefinite=True)
    means, covs = run.means.copy(), run.covariances.copy()
    for k in reversed(range(steps - 1)):
        x, p = run.means[k], run.covariances[k]
        gain = _gain(p, f[k + 1], q[k + 1])
        gap = means[k + 1] - x @ f[k + 1].T
        means[k] = x + (gain @ gap[..., None])[..., 0]
        kept = np.eye(d) - gain @ f[k + 1]
        back = np.swapaxes(gain, -1, -2)
        after = kept @ p @ np.swapaxes(kept, -1, -2) + gain @ (covs[k + 1] + q[k + 1]) @ back
        covs[k] = _symmetrise(after)
    return GaussianRun(means, covs, run.log_likelihood.copy())


def _series(run: GaussianRun) -> None:
    """Refuse arrays that are not those of one filter's run."""
    x = array(run.means, "run.means")
    if x.ndim < 2:
        raise ValueError(f"run.means: needs shape (T, ..., d), got {x.shape}")
    p = array(run.covariances, "run.covariances", (..., x.shape[-1], x.shape[-1]))
    axes = zip(p.shape[:-2], x.shape[:-1], strict=False)
    if p.ndim != x.ndim + 1 or len(p) != len(x) or any(n not in (1, m) for n, m in axes):
        needs = (*x.shape, x.shape[-1])
        raise ValueError(f"run.covariances: needs shape {needs}, or runs of 1, got {p.shape}")
    array(run.log_likelihood, "run.log_likelihood", x.shape[:-1], finite=False)


def _gain(p: Array, f: Array, q: Array) -> Array:
    """P F' (F P F' + Q)^-1, (..., d, d), by a Cholesky factor."""
    forward = f @ p
    ahead = forward @ f.T + q
    try:
        lower = np.linalg.cholesky(_symmetrise(ahead))
    except np.linalg.LinAlgError:
        raise np.linalg.LinAlgError("a forecast covariance is not positive definite") from None
    half = np.linalg.solve(lower, forward)
    return np.asarray(np.swapaxes(np.linalg.solve(np.swapaxes(lower, -1, -2), half), -1, -2))
