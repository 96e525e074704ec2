"""Covariance intersection of several Gaussians, and rules for its weights.

Sources (such as the agents that sent a belief) lie on the axis before the components: means
(..., S, d), covariances (..., S, d, d), weights (..., S). NaN may stand at a source that is absent.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np

from ..linalg import (
    broadcast_leading,
    cholesky,
    log_det,
    lower_root,
    solve_lower,
    symmetrise,
)
from ..validation import (
    ALLOW_NAN,
    Array,
    ArrayInput,
    Mask,
    MaskInput,
    Probabilities,
    check_positive_definite,
    validated,
)

__all__ = ["intersect_gaussians", "intersection_weights"]


def _check_definite_or_missing(value: Array, name: str) -> None:
    """Refuse a covariance that is not positive definite; one with NaN is missing."""
    is_missing = np.isnan(value).any(axis=(-2, -1))
    check_positive_definite(value[~is_missing], name)


Covs = Annotated[ArrayInput, "... S d d", ALLOW_NAN, _check_definite_or_missing]
# Duality gap at which the weights count as optimal, relative to the mean derivative.
_GAP_TOLERANCE = 1e-7
_MAX_STEPS = 60
# A Newton step is accepted if it attains this fraction of the decrease that its slope predicts.
_SUFFICIENT_DECREASE = 1e-3
# Lower bound of a vanishing weight: zero could not grow again.
_SMALLEST_WEIGHT = 1e-30


@validated
def intersect_gaussians(
    means: Annotated[ArrayInput, "... S d", ALLOW_NAN],
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

    No unit enters, and nothing is inverted: there are only triangular solves.

    Examples
    --------
    >>> mean, cov = intersect_gaussians([[0.0], [3.0]], [[[1.0]], [[2.0]]], [0.5, 0.5])
    >>> mean.round(6), cov.round(6)
    (array([1.]), array([[1.333333]]))
    """
    leading = broadcast_leading(weights.shape[:-1], means.shape[:-2], "means")
    leading = broadcast_leading(leading, covs.shape[:-3], "covs")
    n_sources, d = means.shape[-2:]
    means = np.broadcast_to(means, (*leading, n_sources, d))
    # A source without weight may be NaN: it is absent, and the numbers of another stand there.
    present = np.broadcast_to(weights > 0, (*leading, n_sources))
    means = _fill_absent(means, present, "means", component_axes=1)
    covs = _fill_absent(covs, present, "covs", component_axes=2)
    lower = cholesky(covs)
    first_lower = lower[..., 0, :, :]
    first_mean = means[..., 0, :]
    first_weight = weights[..., :1, None]

    # √ω_b [G_b, z_b] with G_b = L_b⁻¹ L₁ and z_b = L_b⁻¹ (m_b - m₁), for b > 1.
    differences = means[..., 1:, :, None] - first_mean[..., None, :, None]
    right = _join_columns(first_lower[..., None, :, :], differences)
    root_weights = np.sqrt(weights[..., 1:, None, None])
    scaled = root_weights * solve_lower(lower[..., 1:, :, :], right)

    # [Σ ω_b G_bᵀ G_b, Σ ω_b G_bᵀ z_b] in one product over sources and components.
    stacked = scaled.reshape(*scaled.shape[:-3], -1, d + 1)
    total = stacked[..., :d].mT @ stacked
    total[..., :d] += first_weight * np.eye(d)  # G₁ = I
    # The Cholesky factor C of Σ ω_b G_bᵀ G_b. Weights but the first are in `scaled` already.
    unit_weights = np.ones(scaled.shape[:-2])
    information_root = _factor_sum(
        total[..., :d], first_weight, unit_weights, scaled[..., :d]
    )

    # P = R Rᵀ with R = L₁ C⁻ᵀ for the sum C Cᵀ, and m = m₁ + R C⁻¹ Σ ω_b G_bᵀ z_b.
    right = _join_columns(first_lower.swapaxes(-1, -2), total[..., d:])
    solution = solve_lower(information_root, right)
    fused = solution[..., :d].mT @ solution
    return first_mean + fused[..., d], symmetrise(fused[..., :d])


def _fill_absent(
    value: Array, present: Mask, name: str, *, component_axes: int
) -> Array:
    """Put the first present source in the place of those that are absent.

    Their weight is zero, so that any finite numbers do; NaN times zero would be NaN. `present`
    (..., S) marks the sources that are present. `value` has one more axis for means (..., S, d),
    and two for covariances (..., S, d, d). `name` is that of the argument, for the error.
    """
    if not present.all():
        source_axis = present.ndim - 1
        components = value.shape[-component_axes:]
        value = np.broadcast_to(value, present.shape + components)
        # The flags (..., S, 1) or (..., S, 1, 1), for broadcasting with the value.
        expanded = present.reshape(present.shape + (1,) * component_axes)
        # The largest of flags is the first that is set.
        first = expanded.argmax(axis=source_axis, keepdims=True)
        substitute = np.take_along_axis(value, first, axis=source_axis)
        value = np.where(expanded, value, substitute)
    if not np.isfinite(value).all():
        raise ValueError(
            f"{name} must have finite numbers where a source has weight or is present, "
            "got NaN or infinity"
        )
    return value


def _join_columns(left: Array, right: Array) -> Array:
    """Concatenate columns; the left one's leading axes may be 1."""
    shape = (*right.shape[:-1], left.shape[-1])
    return np.concatenate([np.broadcast_to(left, shape), right], axis=-1)


@validated
def intersection_weights(
    covs: Covs,
    *,
    rule: Literal[
        "equal", "trace", "determinant", "min_trace", "min_determinant"
    ] = "equal",
    present: Annotated[MaskInput, "... S"] | None = None,
) -> Array:
    r"""Weights (..., S) for :func:`intersect_gaussians`, nonnegative with sum 1.

    Parameters
    ----------
    covs : array_like, (..., S, d, d)
        The sources' covariances, positive definite.
    rule : {"equal", "trace", "determinant", "min_trace", "min_determinant"}
        Equal; inversely proportional to the trace; or to the d-th root of the determinant; or such
        that trace or determinant of the result is least. Traces add the components' units; the
        rules with determinants do not depend on them.
    present : array_like of bool, (..., S), optional
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

    These steps are monotone but converge slowly. So each is preceded by a Newton step on the
    simplex, which stays positive. It is accepted where it attains a fraction of the decrease that
    its slope predicts; else the monotone step is taken. The iteration ends where the duality gap
    :math:`\max_bg_b/\bar g-1` is below :math:`10^{-7}`: by convexity the log-determinant is then
    within :math:`10^{-7}d` of the least, the trace within a fraction of :math:`10^{-7}`. After 60
    steps, where rounding hides the gap, the weights with the smallest gap are returned.

    *Two sources.* In the coordinates in which :math:`\mathbf P_1` is the identity and
    :math:`\mathbf P_2^{-1}` diagonal with the entries :math:`\lambda_i`, the determinant is
    :math:`\prod_iu_i^{-1}` and the trace :math:`\sum_ic_iu_i^{-1}` with
    :math:`u_i=1-\omega+\omega\lambda_i`. So matrices are decomposed once, and the search for
    :math:`\omega=\omega_2` needs numbers only.

    Examples
    --------
    >>> intersection_weights([[[1.0]], [[3.0]]], rule="trace")
    array([0.75, 0.25])
    >>> crossed = [np.diag([1.0, 4.0]), np.diag([4.0, 1.0])]
    >>> intersection_weights(crossed, rule="min_determinant")
    array([0.5, 0.5])
    """
    if present is None:
        present = np.ones(covs.shape[-3], dtype=bool)
    if not present.any(axis=-1).all():
        raise ValueError("present must have at least one source, got none")
    leading = broadcast_leading(present.shape[:-1], covs.shape[:-3], "covs")
    present = np.broadcast_to(present, (*leading, covs.shape[-3]))
    covs = np.broadcast_to(covs, (*leading, *covs.shape[-3:]))
    covs = _fill_absent(covs, present, "covs", component_axes=2)
    if rule in ("min_trace", "min_determinant") and present.shape[-1] > 1:
        return _search_weights(covs, present, determinant=rule == "min_determinant")
    # ω_b ∝ 1 / size_b, by logarithms.
    log_sizes = np.zeros(present.shape)
    if rule == "trace":
        log_sizes = np.log(np.trace(covs, axis1=-2, axis2=-1))
    elif rule == "determinant":
        log_sizes = log_det(cholesky(covs)) / covs.shape[-1]
    # An absent source has the weight exp(-inf) = 0.
    log_sizes = np.where(present, log_sizes, np.inf)
    weights = np.exp(log_sizes.min(axis=-1, keepdims=True) - log_sizes)
    return np.asarray(weights / weights.sum(axis=-1, keepdims=True))


def _search_weights(covs: Array, present: Mask, *, determinant: bool) -> Array:
    """Weights (..., S) of least determinant or trace: of two present sources by their eigenvalues.

    Covariances are (..., S, d, d), and `present` (..., S) marks the sources that are present.
    """
    s, d = covs.shape[-3:-1]
    flat_covs = covs.reshape(-1, s, d, d)
    flat_present = present.reshape(-1, s)
    is_pair = np.count_nonzero(flat_present, axis=-1) == 2
    weights = np.zeros(flat_present.shape)
    if is_pair.any():
        # Which two they are, (pairs, 2)
        sources = np.nonzero(flat_present[is_pair])[1].reshape(-1, 2)
        rows = np.flatnonzero(is_pair)[:, None]
        pair = flat_covs[rows, sources]
        weights[rows, sources] = _minimize_pair(pair, determinant=determinant)
    if not is_pair.all():
        weights[~is_pair] = _minimize(
            flat_covs[~is_pair], flat_present[~is_pair], determinant=determinant
        )
    return weights.reshape(present.shape)


@dataclass
class _Problem:
    """Fusions whose weights are to be optimised, along the first axis n."""

    roots: Array
    """G_b = L_b⁻¹ L₁ of each source, with P_b = L_b L_bᵀ, (n, S, d, d); zero if it is absent."""
    information: Array
    """P_b⁻¹ in the first source's coordinates L₁⁻¹ x, G_bᵀ G_b, (n, S, d, d)."""
    first_lower: Array
    """L₁, (n, d, d): traces are taken in the state's own coordinates."""
    present: Array
    """1 where a source is present, (n, S)."""
    determinant: bool

    @classmethod
    def build(cls, covs: Array, present: Array, determinant: bool) -> _Problem:
        """Transform covariances (n, S, d, d) to the first source's coordinates."""
        # L_b⁻¹ L₁, and P_b⁻¹ = (L_b⁻¹ L₁)ᵀ (L_b⁻¹ L₁) in the first source's coordinates
        lower = cholesky(covs)
        roots = solve_lower(lower, np.broadcast_to(lower[:, :1], lower.shape))
        roots *= present[..., None, None]
        information = _times_transpose(roots.mT)
        return cls(roots, information, lower[:, 0], present, determinant)

    def select(self, mask: Mask) -> _Problem:
        """Keep some of the fusions.

        The mask is (n,).
        """
        return _Problem(
            self.roots[mask],
            self.information[mask],
            self.first_lower[mask],
            self.present[mask],
            self.determinant,
        )

    def derivatives(self, weights: Array) -> tuple[Array, Array, Array]:
        """The objective (n,), minus its gradient g (n, S), its second derivatives (n, S, S)."""
        n, s, d = self.roots.shape[:3]
        # All in the first source's coordinates: M = Σ ω_b P_b⁻¹ = C Cᵀ with the factor C, `lower`,
        # and P_b⁻¹ = G_bᵀ G_b with the roots G_b. Each P_b⁻¹ is a row, and the sum a product.
        flat_information = self.information.reshape(n, s, d * d)
        total = weights[:, None, :] @ flat_information
        # The sum c I + Σ ω_b G_bᵀ G_b with c = 0
        identity_weight = np.zeros((1, 1))
        lower = _factor_sum(
            total.reshape(n, d, d), identity_weight, weights, self.roots
        )
        # C⁻¹ G_bᵀ for all sources side by side, (n, d, S d)
        half = solve_lower(lower, self.roots.reshape(n, s * d, d).mT)
        # C⁻¹ P_b⁻¹ C⁻ᵀ, (n, S, d, d): each source's information where that of the result is I.
        relative = _times_transpose(half.reshape(n, d, s, d).swapaxes(1, 2))
        if self.determinant:
            # -log det M, with g_b = tr(M⁻¹ P_b⁻¹) and the Hessian tr(M⁻¹ P_b⁻¹ M⁻¹ P_c⁻¹), the
            # sum of products of the entries of `relative`.
            flat = relative.reshape(n, s, d * d)
            slope = np.einsum("nsii->ns", relative)
            return -log_det(lower), slope, flat @ flat.mT
        # In the state's own coordinates the result is L₁ M⁻¹ L₁ᵀ, with the factor L₁ of the first
        # source's covariance. Its trace is |C⁻¹ L₁ᵀ|², with g_b = tr(L₁ M⁻¹ P_b⁻¹ M⁻¹ L₁ᵀ).
        root = solve_lower(lower, self.first_lower.mT)
        flat = (relative @ root[:, None]).reshape(n, s, d * d)
        slope = (flat @ root.reshape(n, d * d, 1))[..., 0]
        trace = (root**2).sum(axis=(-2, -1))
        return trace, slope, 2 * flat @ flat.mT

    def monotone_step(self, weights: Array, slope: Array, mean: Array) -> Array:
        """The multiplicative step, which never increases the objective."""
        ratio = slope / mean
        scaled = weights * (ratio if self.determinant else np.sqrt(ratio))
        return np.asarray(scaled / scaled.sum(axis=-1, keepdims=True))


# Where ratios of covariances overflow, the duality gap is NaN and no step is taken.
@np.errstate(over="ignore", divide="ignore", invalid="ignore")
def _minimize(covs: Array, present: Mask, *, determinant: bool) -> Array:
    """Weights (..., S) of least determinant or trace; :func:`.intersection_weights` has the method.

    Covariances are (..., S, d, d), and `present` (..., S) marks the sources that are present.
    """
    # All leading axes become one, n fusions, which are optimised together.
    s, d = covs.shape[-3:-1]
    is_present = present.reshape(-1, s).astype(np.float64)
    problem = _Problem.build(covs.reshape(-1, s, d, d), is_present, determinant)
    n = len(is_present)
    # The current weights, the monotone step from the last accepted ones, and the best so far.
    weights = is_present / is_present.sum(axis=-1, keepdims=True)
    monotone = weights
    best = weights.copy()
    smallest_gap = np.full(n, np.inf)
    # The objective must be below the bound for a Newton step of this size to be accepted.
    bound = np.full(n, np.inf)
    step_size = np.ones((n, 1))
    index = np.arange(n)
    for _ in range(_MAX_STEPS):
        # The objective (n,), minus its gradient (n, S), and the Hessian (n, S, S)
        value, slope, curvature = problem.derivatives(weights)
        mean = (weights * slope).sum(axis=-1, keepdims=True)
        duality_gap = slope.max(axis=-1) / mean[:, 0] - 1
        # A converged fusion stays: that others need more steps must not change it.
        improved = (duality_gap < smallest_gap) & (smallest_gap > _GAP_TOLERANCE)
        best[index[improved]] = weights[improved]
        smallest_gap = np.where(improved, duality_gap, smallest_gap)
        is_open = smallest_gap > _GAP_TOLERANCE
        if not is_open.any():
            break
        # An accepted point takes the next Newton step. A rejected one goes back to the monotone
        # step, whatever the value there, and its next Newton step is shorter.
        accepted = (value <= bound)[:, None]
        step_size = np.where(accepted, np.minimum(2 * step_size, 1.0), 0.25 * step_size)
        newton = _newton_step(weights, slope, mean, curvature, problem.present)
        step = step_size * (newton - weights)
        next_monotone = problem.monotone_step(weights, slope, mean)
        next_bound = _decrease_bound(value, (slope * step).sum(axis=-1))
        bound = np.where(accepted[:, 0], next_bound, np.inf)
        weights = np.where(accepted, weights + step, monotone)
        monotone = np.where(accepted, next_monotone, monotone)
        # Drop converged fusions once they are a tenth of all.
        if 10 * np.count_nonzero(is_open) <= 9 * len(is_open):
            problem = problem.select(is_open)
            index = index[is_open]
            smallest_gap = smallest_gap[is_open]
            bound = bound[is_open]
            weights = weights[is_open]
            monotone = monotone[is_open]
            step_size = step_size[is_open]
    return np.asarray(best.reshape(present.shape))


# Where ratios of covariances overflow, the duality gap is NaN and no step is taken.
@np.errstate(over="ignore", divide="ignore", invalid="ignore")
def _minimize_pair(covs: Array, *, determinant: bool) -> Array:
    """Weights (n, 2) of least determinant or trace for pairs of covariances, (n, 2, d, d)."""
    lower = cholesky(covs)
    first_lower = lower[:, 0]
    # L₂⁻¹ L₁ = U diag(√λ) Vᵀ: in the coordinates Vᵀ L₁⁻¹ x the information is I and diag(λ).
    _, root, axes = np.linalg.svd(solve_lower(lower[:, 1], first_lower))
    eigenvalues = root * root
    # The objective is Σ c_i / u_i for the trace, with c_i = |L₁ v_i|², and -Σ log u_i for the
    # determinant. Its slope in ω has the sign of 1 - g with the mean g = Σ s_i λ_i of weights
    # s_i ∝ c_i / u_i², and s_i ∝ 1 / u_i: c_i is the `size`, and the exponent of u_i the `power`.
    size = np.ones_like(eigenvalues)
    power = 1
    if not determinant:
        size = ((first_lower @ axes.mT) ** 2).sum(axis=-2)
        power = 2
    # log(ω₂ / ω₁), and an interval that holds it: its ends are weights of rounding.
    log_odds = np.zeros(len(covs))
    low = np.full(len(covs), -40.0)
    high = np.full(len(covs), 40.0)
    # The slope at ω = 0 and at ω = 1: one that points outwards is the optimum.
    weight = np.full(len(covs), np.nan)
    weight[_average(eigenvalues, size) <= 1] = 0.0
    weight[_average(eigenvalues, size / eigenvalues**power) >= 1] = 1.0
    is_inside = np.isnan(weight)
    for _ in range(_MAX_STEPS):
        odds = np.exp(log_odds)
        current = odds / (1 + odds)
        # u_i / ω₁, and the second source's part of u_i
        information = 1 + odds[:, None] * eigenvalues
        part = 1 - 1 / information
        shares = size / information**power
        mean = _average(eigenvalues, shares)
        duality_gap = np.maximum(1.0, mean) / (1 - current + current * mean) - 1
        is_open = duality_gap > _GAP_TOLERANCE
        if not (is_open & is_inside).any():
            break
        # Newton's method for log g = 0, which falls as the odds rise.
        error = np.log(mean)
        low = np.where(error > 0, log_odds, low)
        high = np.where(error < 0, log_odds, high)
        # With the odds o the derivative is -d log g / d log o = power Σ s_i (λ_i - g) part_i / g.
        centred = (eigenvalues - mean[:, None]) * part
        slope = power * _average(centred, shares) / mean
        newton = log_odds + error / slope
        is_between = (low < newton) & (newton < high)
        step = np.where(is_between, newton, 0.5 * (low + high))
        log_odds = np.where(is_open & is_inside, step, log_odds)
    # Equal covariances, up to rounding, have equal weights.
    is_equal = log_odds == 0
    weight = np.where(is_inside | (is_equal & ~is_open), current, weight)
    return np.stack([1 - weight, weight], axis=-1)


def _average(values: Array, shares: Array) -> Array:
    """Average of values (..., d), weighted by shares that need not sum to one, (...)."""
    return np.asarray((shares * values).sum(axis=-1) / shares.sum(axis=-1))


def _decrease_bound(value: Array, predicted: Array) -> Array:
    """Largest objective after a Newton step, given the decrease that the slope predicts."""
    rounding = 1e-13 * (1 + np.abs(value))
    bound = value - _SUFFICIENT_DECREASE * predicted + rounding
    # A step uphill is never accepted.
    return np.where(predicted > 0, bound, -np.inf)


def _times_transpose(root: Array) -> Array:
    """A Aᵀ of small matrices; with a copy of Aᵀ in half the time of its view."""
    return np.asarray(root @ np.ascontiguousarray(root.swapaxes(-1, -2)))


def _newton_step(
    weights: Array, slope: Array, mean: Array, curvature: Array, present: Array
) -> Array:
    """Weights after a Newton step on the simplex; a vanishing weight shrinks a thousandfold.

    For n fusions of S sources the weights, minus the gradient `slope`, and `present`, 1 or 0, are
    (n, S); `mean` (n, 1) is the slopes' weighted mean, and `curvature` (n, S, S) the Hessian.
    """
    # The Hessian with a multiplier for weights that vanish, and a ridge where it is singular: 1e-12
    # of its largest entry. An absent source has a row of its own, apart from the others.
    size = curvature.max(axis=(-2, -1))[:, None]
    excess = np.maximum(mean - slope, 0.0)
    multiplier = excess / np.maximum(weights, _SMALLEST_WEIGHT)
    ridge = present * (multiplier + 1e-12 * size) + (1 - present) * size
    matrix = curvature + ridge[..., None] * np.eye(weights.shape[-1])
    # In units in which its diagonal is one.
    scale = np.sqrt(np.diagonal(matrix, axis1=-2, axis2=-1))[..., None]
    matrix /= scale * scale.swapaxes(-1, -2)
    right = np.stack([slope, present], axis=-1) / scale
    try:
        solution = np.linalg.solve(matrix, right) / scale
    except np.linalg.LinAlgError:
        return weights  # no better than before: the monotone step follows
    # x = H⁻¹ g - λ H⁻¹ 1, with λ such that the sum stays one.
    direction = solution[..., 0]
    constraint = solution[..., 1]
    sum_multiplier = direction.sum(axis=1)[:, None] / constraint.sum(axis=1)[:, None]
    moved = weights + direction - sum_multiplier * constraint
    # No weight shrinks to less than a thousandth, or to zero.
    floor = np.maximum(1e-3 * weights, _SMALLEST_WEIGHT * present)
    moved = np.maximum(moved, floor)
    return np.asarray(moved / moved.sum(axis=-1, keepdims=True))


def _factor_sum(
    total: Array, identity_weight: Array, weights: Array, roots: Array
) -> Array:
    """Cholesky factor of c I + Σ ω_b G_bᵀ G_b, which is `total` (..., d, d).

    c is the `identity_weight` (..., 1, 1), ω_b are the `weights` (..., S) and G_b the `roots`
    (..., S, d, d). The factor comes from the G_b themselves where rounding has spoilt their
    squares.
    """
    try:
        return cholesky(total)
    except np.linalg.LinAlgError:
        # The sum is Aᵀ A for the rows √c I and √ω_b G_b of A.
        d = roots.shape[-1]
        stacked = np.sqrt(weights)[..., None, None] * roots
        stacked = stacked.reshape(*stacked.shape[:-3], -1, d)
        identity = np.sqrt(identity_weight) * np.eye(d)
        identity = np.broadcast_to(identity, (*stacked.shape[:-2], d, d))
        return lower_root(np.concatenate([identity, stacked], axis=-2).mT)
