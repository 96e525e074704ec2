"""Covariance intersection of several Gaussians, and the weights that it takes.

Sources (agents that sent theirs, say) lie on the axis before the components: means (..., S, d),
covariances (..., S, d, d), weights (..., S). NaN may stand at a source that did not come.
"""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np

from ..linalg import (
    cholesky,
    broadcast_leading,
    log_det,
    lower_root,
    solve_lower,
    symmetrise,
)
from ..validation import (
    ALLOW_NAN,
    Array,
    Mask,
    Probabilities,
    check_positive_definite,
    validated,
)

__all__ = ["intersect_gaussians", "intersection_weights"]


def _definite_or_missing(value: Array, name: str) -> None:
    check_positive_definite(value[~np.isnan(value).any(axis=(-2, -1))], name)


Covs = Annotated[Array, "... S d d", ALLOW_NAN, _definite_or_missing]
# How far the derivatives may be from the conditions of the optimum, relative to their mean.
_GAP = 1e-7
_STEPS = 60
# A weight that vanishes stays above it: zero could not grow again.
_LEAST = 1e-30


@validated
def intersect_gaussians(
    means: Annotated[Array, "... S d", ALLOW_NAN],
    covs: Covs,
    weights: Annotated[Probabilities, "... S"],
) -> tuple[Array, Array]:
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
        Nonnegative with sum 1. NaN may stand at a source of weight 0.

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
    >>> mean, cov = intersect_gaussians([[0.0], [3.0]], [[[1.0]], [[2.0]]], [0.5, 0.5])
    >>> mean.round(6), cov.round(6)
    (array([1.]), array([[1.333333]]))
    """
    lead = broadcast_leading(weights.shape[:-1], means.shape[:-2], "means")
    lead = broadcast_leading(lead, covs.shape[:-3], "covs")
    size, d = means.shape[-2:]
    means = np.broadcast_to(means, (*lead, size, d))
    here = np.broadcast_to(weights > 0, (*lead, size))
    m = _counted(means, here, 1, "means")
    lower = cholesky(_counted(covs, here, 2, "covs"))
    first = lower[..., 0, :, :]
    centre = m[..., 0, :]
    own = weights[..., :1, None]
    others = np.sqrt(weights[..., 1:, None, None])
    gap = m[..., 1:, :, None] - centre[..., None, :, None]
    wide = others * solve_lower(
        lower[..., 1:, :, :], _beside(first[..., None, :, :], gap)
    )
    tall = wide.reshape(*wide.shape[:-3], -1, d + 1)
    turned = np.ascontiguousarray(tall[..., :d].swapaxes(-1, -2))
    total = turned @ tall
    total[..., :d] += own * np.eye(d)
    inner = _cholesky_or_qr(
        total[..., :d], own, np.ones(wide.shape[:-2]), wide[..., :d]
    )
    both = solve_lower(inner, _beside(first.swapaxes(-1, -2), total[..., d:]))
    root = np.ascontiguousarray(both[..., :d].swapaxes(-1, -2))
    fused = root @ both
    return centre + fused[..., d], symmetrise(fused[..., :d])


def _counted(value: Array, here: Mask, axes: int, name: str) -> Array:
    """What the sources that count hold; the first of them stands in for those that do not."""
    if not here.all():
        value = np.broadcast_to(value, (*here.shape, *value.shape[value.ndim - axes :]))
        wide = here.reshape(*here.shape, *(1,) * axes)
        first = wide.argmax(axis=here.ndim - 1, keepdims=True)
        value = np.where(
            wide, value, np.take_along_axis(value, first, axis=here.ndim - 1)
        )
    if not np.isfinite(value).all():
        raise ValueError(
            f"{name} must have finite numbers where a source counts, got NaN or infinity"
        )
    return value


def _beside(left: Array, right: Array) -> Array:
    """The columns of both; the left one's leading axes may be 1."""
    left = np.broadcast_to(left, (*right.shape[:-1], left.shape[-1]))
    return np.concatenate([left, right], axis=-1)


@validated
def intersection_weights(
    covs: Covs,
    *,
    rule: Literal[
        "equal", "trace", "determinant", "min_trace", "min_determinant"
    ] = "equal",
    here: Annotated[Mask, "... S"] | None = None,
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
        covariances may be NaN.

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
    there = np.ones(covs.shape[-3], dtype=bool) if here is None else here
    if not there.any(axis=-1).all():
        raise ValueError("here must have at least one source that arrived, got none")
    lead = broadcast_leading(there.shape[:-1], covs.shape[:-3], "covs")
    here = np.broadcast_to(there, (*lead, *covs.shape[-3:-2]))
    covs = np.broadcast_to(covs, (*lead, *covs.shape[-3:]))
    covs = _counted(covs, here, 2, "covs")
    if rule in ("min_trace", "min_determinant") and here.shape[-1] > 1:
        return _least(covs, here, rule == "min_determinant")
    logs = np.zeros(here.shape)
    if rule == "trace":
        logs = np.log(np.trace(covs, axis1=-2, axis2=-1))
    elif rule == "determinant":
        logs = log_det(cholesky(covs)) / covs.shape[-1]
    logs = np.where(here, logs, np.inf)
    weights = np.exp(logs.min(axis=-1, keepdims=True) - logs)
    return np.asarray(weights / weights.sum(axis=-1, keepdims=True))


# Where ratios of covariances leave the range of numbers, no gap is found, and none is taken.
@np.errstate(over="ignore", divide="ignore", invalid="ignore")
def _least(covs: Array, here: Mask, determinant: bool) -> Array:
    """Weights of least determinant or trace; :func:`.intersection_weights` says how and why."""
    leading = here.shape[:-1]
    (s, d) = covs.shape[-3:-1]
    there = here.reshape(-1, s).astype(np.float64)
    lower = cholesky(covs).reshape(-1, s, d, d)
    # In the first one's coordinates, as in an intersection; traces are taken in the state's own.
    roots = solve_lower(lower, np.broadcast_to(lower[:, :1], lower.shape))
    roots *= there[..., None, None]
    fixed = [roots, _square(roots.mT), lower[:, 0], there]
    point = there / there.sum(axis=-1, keepdims=True)
    best = point.copy()
    sure = point
    left = np.arange(len(point))
    share = np.ones((len(point), 1))
    lowest = bound = np.full(len(point), np.inf)
    for _ in range(_STEPS):
        value, slope, curvature = _derivatives(point, fixed, determinant)
        mean = (point * slope).sum(axis=-1, keepdims=True)
        gap = slope.max(axis=-1) / mean[:, 0] - 1
        # What is settled stays: the others' need for more steps must not move it.
        lower_gap = (gap < lowest) & (lowest > _GAP)
        best[left[lower_gap]] = point[lower_gap]
        lowest = np.where(lower_gap, gap, lowest)
        open_ = lowest > _GAP
        if not open_.any():
            break
        # A Newton step counts if it gains a share of what its slope promised; else its start's
        # sure step does, whatever the value there, and the next Newton step is cut.
        at = (value <= bound)[:, None]
        share = np.where(at, np.minimum(2 * share, 1.0), 0.25 * share)
        step = share * (_newton(point, slope, mean, curvature, fixed[3]) - point)
        scaled = point * (slope / mean if determinant else np.sqrt(slope / mean))
        scaled /= scaled.sum(axis=-1, keepdims=True)
        gain = (slope * step).sum(axis=-1)
        aim = np.where(
            gain > 0, value - 1e-3 * gain + 1e-13 * (1 + np.abs(value)), -np.inf
        )
        bound = np.where(at[:, 0], aim, np.inf)
        point = np.where(at, point + step, sure)
        sure = np.where(at, scaled, sure)
        if 10 * np.count_nonzero(open_) <= 9 * len(open_):
            fixed = [part[open_] for part in fixed]
            left = left[open_]
            lowest = lowest[open_]
            bound = bound[open_]
            point = point[open_]
            sure = sure[open_]
            share = share[open_]
    return np.asarray(best.reshape(*leading, s))


def _derivatives(
    w: Array, fixed: list[Array], determinant: bool
) -> tuple[Array, Array, Array]:
    """What is made least (n,), minus its gradient (n, S), its second derivatives (n, S, S)."""
    roots, information, first, _ = fixed
    n, s, d = roots.shape[:3]
    total = w[:, None, :] @ information.reshape(n, s, d * d)
    lower = _cholesky_or_qr(total.reshape(n, d, d), np.zeros((1, 1)), w, roots)
    half = solve_lower(lower, roots.reshape(n, s * d, d).mT)
    # Each source's information where that of the result is the identity, (n, S, d, d).
    shares = _square(half.reshape(n, d, s, d).swapaxes(1, 2))
    if determinant:
        flat = shares.reshape(n, s, d * d)
        return -log_det(lower), np.einsum("nsii->ns", shares), flat @ flat.mT
    spread = solve_lower(lower, first.mT)
    flat = (shares @ spread[:, None]).reshape(n, s, d * d)
    slope = (flat @ spread.reshape(n, d * d, 1))[..., 0]
    return (spread**2).sum(axis=(-2, -1)), slope, 2 * flat @ flat.mT


def _square(root: Array) -> Array:
    """A A' of small matrices; with a copy of A' in half the time of its view."""
    return np.asarray(root @ np.ascontiguousarray(root.swapaxes(-1, -2)))


def _newton(
    weights: Array, slope: Array, mean: Array, curvature: Array, there: Array
) -> Array:
    """A Newton step on the simplex; a weight that wants to vanish shrinks a thousandfold."""
    size = curvature.max(axis=(-2, -1))[:, None]
    held = np.maximum(mean - slope, 0.0) / np.maximum(weights, _LEAST)
    ridge = there * (held + 1e-12 * size) + (1 - there) * size
    matrix = curvature + ridge[..., None] * np.eye(weights.shape[-1])
    scale = np.sqrt(np.diagonal(matrix, axis1=-2, axis2=-1))[..., None]
    matrix /= scale * scale.swapaxes(-1, -2)
    try:
        solved = (
            np.linalg.solve(matrix, np.stack([slope, there], axis=-1) / scale) / scale
        )
    except np.linalg.LinAlgError:
        return weights  # which is not better: the sure step follows
    pull, ones = solved.sum(axis=1).T[..., None]
    out = weights + solved[..., 0] - pull / ones * solved[..., 1]
    out = np.maximum(out, np.maximum(1e-3 * weights, _LEAST * there))
    return np.asarray(out / out.sum(axis=-1, keepdims=True))


def _cholesky_or_qr(total: Array, own: Array, weights: Array, roots: Array) -> Array:
    """Cholesky factor of own I + sum of w G' G; from the G where rounding spoils their squares."""
    try:
        return cholesky(total)
    except np.linalg.LinAlgError:
        d = roots.shape[-1]
        tall = np.sqrt(weights)[..., None, None] * roots
        tall = tall.reshape(*tall.shape[:-3], -1, d)
        first = np.broadcast_to(np.sqrt(own) * np.eye(d), (*tall.shape[:-2], d, d))
        return lower_root(np.concatenate([first, tall], axis=-2).mT)
