"""Covariance intersection of several Gaussians, and the weights that it takes.

Sources (agents that sent theirs, say) lie on the axis before the components: means (..., S, d),
covariances (..., S, d, d), weights (..., S). A source of weight 0 may hold anything, NaN included.
Names with an underscore are the same without checks, for loops of this package.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..checks import Array, array, choice, covariance, flags
from ..checks import weights as unit_weights
from ..linalg import _leading, _log_det, _solve_lower, _symmetrise
from .optimal import _cholesky_or_qr, _factors, _least

__all__ = ["intersection", "intersection_weights"]

_RULES = ("equal", "trace", "determinant", "min_trace", "min_determinant")


def intersection(means: ArrayLike, covs: ArrayLike, weights: ArrayLike) -> tuple[Array, Array]:
    r"""Covariance intersection: the normalised weighted geometric mean of Gaussians.

    .. math:: \mathbf P^{-1}=\sum_b\omega_b\mathbf P_b^{-1},\qquad
        \mathbf P^{-1}\mathbf m=\sum_b\omega_b\mathbf P_b^{-1}\mathbf m_b

    With weights that sum to one nothing is counted twice: if each covariance bounds the covariance
    of its mean's error, so does the result, whatever the errors have in common.

    Parameters
    ----------
    means : array_like, (..., S, d)
        The sources' means.
    covs : array_like, (..., S, d, d)
        Their covariances, positive definite.
    weights : array_like, (..., S)
        Nonnegative with sum 1. What stands at a source of weight 0 does not matter.

    Returns
    -------
    mean : ndarray, (..., d)
    cov : ndarray, (..., d, d)

    Notes
    -----
    S. J. Julier and J. K. Uhlmann, American Control Conference (1997) 2369-2373. Solved in the
    coordinates in which the first source's covariance is the identity: with
    :math:`\mathbf P_b=\mathbf L_b\mathbf L_b^\top` and
    :math:`\mathbf G_b=\mathbf L_b^{-1}\mathbf L_1`,

    .. math:: \mathbf P=\mathbf L_1\Bigl(\sum_b\omega_b\mathbf G_b^\top\mathbf G_b\Bigr)^{-1}
        \mathbf L_1^\top.

    No unit enters, and nothing is inverted: there are triangular solves with what is at hand.

    Examples
    --------
    >>> mean, cov = intersection([[0.0], [3.0]], [[[1.0]], [[2.0]]], [0.5, 0.5])
    >>> mean.round(6), cov.round(6)
    (array([1.]), array([[1.333333]]))
    """
    omega = unit_weights(weights, "weights")
    m = array(means, "means", (..., omega.shape[-1], "d"), finite=False)
    p = array(covs, "covs", (..., *m.shape[-2:], m.shape[-1]), finite=False)
    leading = _leading(omega.shape[:-1], m.shape[:-2], "means")
    leading = _leading(leading, p.shape[:-3], "covs")
    here = np.broadcast_to(omega > 0, (*leading, omega.shape[-1]))
    array(np.broadcast_to(m, (*leading, *m.shape[-2:]))[here], "means")
    covariance(np.broadcast_to(p, (*leading, *p.shape[-3:]))[here], "covs")
    return _intersection(m, p, omega)


def _intersection(means: Array, covs: Array, weights: Array) -> tuple[Array, Array]:
    """As the public one, for any nonnegative weights that are not all zero: ones multiply."""
    d = means.shape[-1]
    here = weights > 0
    m = means if here.all() else np.where(here[..., None], means, 0.0)
    lower = _factors(covs, here)
    first, centre = lower[..., 0, :, :], m[..., 0, :]
    own, others = weights[..., :1, None], np.sqrt(weights[..., 1:, None, None])
    gap = m[..., 1:, :, None] - centre[..., None, :, None]
    wide = others * _solve_lower(lower[..., 1:, :, :], _beside(first[..., None, :, :], gap))
    tall = wide.reshape(*wide.shape[:-3], -1, d + 1)
    turned = np.ascontiguousarray(tall[..., :d].swapaxes(-1, -2))
    total = turned @ tall
    total[..., :d] += own * np.eye(d)
    inner = _cholesky_or_qr(total[..., :d], own, np.ones(wide.shape[:-2]), wide[..., :d])
    both = _solve_lower(inner, _beside(first.swapaxes(-1, -2), total[..., d:]))
    root = np.ascontiguousarray(both[..., :d].swapaxes(-1, -2))
    fused = root @ both
    return centre + fused[..., d], _symmetrise(fused[..., :d])


def _beside(left: Array, right: Array) -> Array:
    """The columns of both; the left one's leading axes may be 1."""
    columns = left.shape[-1]
    out = np.empty((*right.shape[:-1], columns + right.shape[-1]))
    out[..., :columns], out[..., columns:] = left, right
    return out


def intersection_weights(
    covs: ArrayLike, *, rule: str = "equal", here: ArrayLike | None = None
) -> Array:
    r"""Weights (..., S) for :func:`intersection`, nonnegative with sum 1.

    Parameters
    ----------
    covs : array_like, (..., S, d, d)
        The sources' covariances, positive definite.
    rule : {"equal", "trace", "determinant", "min_trace", "min_determinant"}
        Equal; inversely proportional to the trace; or to the d-th root of the determinant; or such
        that trace or determinant of the result is least. Traces add the components' units, what
        uses determinants does not depend on them.
    here : array_like of bool, (..., S), optional
        Which sources arrived, at least one; all by default. The others get weight 0, and their
        covariances may be anything, NaN included.

    Notes
    -----
    Closed forms: W. Niehsen, FUSION (2002) 110-113. Let :math:`\mathbf M=\sum_b\omega_b\mathbf
    P_b^{-1}`. :math:`-\log\det\mathbf M` and :math:`\operatorname{tr}\mathbf M^{-1}` are convex
    in the weights, so the conditions of Karush, Kuhn and Tucker single out the optimum. With
    :math:`g_b=\operatorname{tr}(\mathbf P\mathbf P_b^{-1})`, or
    :math:`\operatorname{tr}(\mathbf P\mathbf P_b^{-1}\mathbf P)` for the trace, and
    :math:`\bar g=\sum_b\omega_bg_b` they are: :math:`g_b\le\bar g`, with equality where
    :math:`\omega_b>0`.

    *Determinant.* :math:`\omega_b\leftarrow\omega_bg_b/d` keeps the sum, as :math:`\bar g=d`.
    :math:`\det\mathbf M` is a polynomial of degree d in the weights without a negative coefficient
    and :math:`g_b` its logarithmic derivative, so by the inequality of Baum and Eagon no step
    decreases it. *Trace.* :math:`\omega_b\leftarrow\omega_b\sqrt{g_b}`, divided by the sum: as
    :math:`\operatorname{tr}\mathbf M^{-1}` is the least of :math:`\sum_b\omega_b^{-1}
    \operatorname{tr}(\mathbf K_b^\top\mathbf P_b^{-1}\mathbf K_b)` over all :math:`\sum_b\mathbf
    P_b^{-1}\mathbf K_b=\mathbf I`, attained at :math:`\mathbf K_b=\omega_b\mathbf P`, the step is
    the best choice of weights for these :math:`\mathbf K_b`. A fixed point has :math:`g_b=\bar g`
    wherever :math:`\omega_b>0`; and where weights that started positive vanish, :math:`g_b>\bar g`
    in the limit would have made them grow. So a limit meets the conditions.

    These steps are sure and slow. So each is preceded by a Newton step on the simplex, which stays
    positive, and which counts where it gains a share of what its slope promised; else the sure step
    does. The end is where :math:`\max_bg_b/\bar g-1` is below :math:`10^{-7}`: by convexity the
    log-determinant is then within :math:`10^{-7}d` of the least, the trace within a share of
    :math:`10^{-7}`. After 60 steps, where rounding hides the gap, the weights with the least gap
    are returned.

    Examples
    --------
    >>> intersection_weights([[[1.0]], [[3.0]]], rule="trace")
    array([0.75, 0.25])
    >>> crossed = [np.diag([1.0, 4.0]), np.diag([4.0, 1.0])]
    >>> intersection_weights(crossed, rule="min_determinant")
    array([0.5, 0.5])
    """
    choice(rule, "rule", _RULES)
    p = array(covs, "covs", (..., "S", "d", "d"), finite=False)
    if p.shape[-1] != p.shape[-2]:
        raise ValueError(f"covs: needs square matrices, got shape {p.shape}")
    there = flags([True] * p.shape[-3] if here is None else here, "here", (..., p.shape[-3]))
    if not there.any(axis=-1).all():
        raise ValueError("here: needs at least one source that arrived, got none")
    leading = _leading(there.shape[:-1], p.shape[:-3], "covs")
    there = np.broadcast_to(there, (*leading, p.shape[-3]))
    p = np.broadcast_to(p, (*leading, *p.shape[-3:]))
    covariance(p[there], "covs")
    return _intersection_weights(p, rule, there)


def _intersection_weights(covs: Array, rule: str, here: NDArray[np.bool_]) -> Array:
    if rule in ("min_trace", "min_determinant") and here.shape[-1] > 1:
        return _least(covs, here, rule == "min_determinant")
    logs = np.zeros(here.shape)
    if rule == "trace":
        logs = np.log(np.where(here, np.trace(covs, axis1=-2, axis2=-1), 1.0))
    elif rule == "determinant":
        logs = _log_det(_factors(covs, here)) / covs.shape[-1]
    logs = np.where(here, logs, np.inf)
    weights = np.exp(logs.min(axis=-1, keepdims=True) - logs)
    return np.asarray(weights / weights.sum(axis=-1, keepdims=True))
