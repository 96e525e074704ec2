"""The smoother of Rauch, Tung and Striebel: what later observations say about earlier states."""

from __future__ import annotations

from typing import Annotated

import numpy as np

from ..doors import Array, Semidefinite, door
from ..linalg import symmetrise
from .linear import GaussianRun, per_step

__all__ = ["rts_smoother"]


@door
def rts_smoother(
    run: GaussianRun,
    *,
    F: Annotated[Array, "... run.dim run.dim"],
    Q: Annotated[Semidefinite, "... run.dim run.dim"],
) -> GaussianRun:
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
    f, q = per_step(len(run.means), F=F, Q=Q)
    means, covs = run.means.copy(), run.covariances.copy()
    for k in reversed(range(len(f) - 1)):
        x, p = run.means[k], run.covariances[k]
        gain = _gain(p, f[k + 1], q[k + 1])
        gap = means[k + 1] - x @ f[k + 1].T
        means[k] = x + (gain @ gap[..., None])[..., 0]
        kept = np.eye(run.dim) - gain @ f[k + 1]
        covs[k] = symmetrise(kept @ p @ kept.mT + gain @ (covs[k + 1] + q[k + 1]) @ gain.mT)
    return run.changed(means=means, covariances=covs)


def _gain(p: Array, f: Array, q: Array) -> Array:
    """P F' (F P F' + Q)^-1, (..., d, d), by a Cholesky factor."""
    forward = f @ p
    try:
        lower = np.linalg.cholesky(symmetrise(forward @ f.T + q))
    except np.linalg.LinAlgError:
        raise np.linalg.LinAlgError("a forecast covariance is not positive definite") from None
    half = np.linalg.solve(lower, forward)
    return np.linalg.solve(lower.mT, half).mT
