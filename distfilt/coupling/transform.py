r"""The ensemble transform: a coupling that turns weighted members into equally weighted ones.

With the optimal coupling :math:`\mathbf T` of the weights to equal masses, each new member is an
average of prior members,

.. math:: \mathbf x_j^+ = N\sum_i t_{ij}\,\mathbf x_i,

equation (3) of Das and Bhattacharya after S. Reich, SIAM Journal on Scientific Computing 35 (2013)
A2013-A2024. The mean of the new members is the weighted mean, exactly. Two variants keep the
members on a set: within convex pieces, and along a curved surface.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from functools import lru_cache
from typing import Annotated, Literal

import numpy as np
from numpy.typing import ArrayLike

from ..ensembles import Ensemble
from ..linalg import EPS, factor
from ..validation import (
    Array,
    ArrayInput,
    Indices,
    IndicesInput,
    NonNegativeFloat,
    PositiveFloat,
    Rng,
    call_user,
    check_array,
    validated,
)
from .solvers import (
    FINITE_SQUARE,
    Solve,
    Solver,
    scale_cost,
    solver_of,
    squared_distances,
)

__all__ = [
    "correct_moments",
    "rejuvenate",
    "transform_along",
    "transform_ensemble",
    "transform_within",
    "transport_plans",
]

SquarableEnsemble = Annotated[ArrayInput, "... n d", FINITE_SQUARE]
"""Members whose squared distances are finite."""
Forecast = Annotated[ArrayInput, "*transformed.shape", FINITE_SQUARE]
"""Members before the transform."""
Cost = Literal["squared", "distance"]
"""The squared Euclidean distance of two members, or the distance itself."""

_TIE_BREAK = 1e-7
"""Largest addition to a cost, in units of its range. The weighted mean stays exact, the plan costs
at most this more."""
_FAR = 1e-6
"""Members are far from each other if a quarter of the costs is below this part of the range. Above
it the addition costs at most a tenth of the lower quartile of the costs."""
_ROUNDING = 1e-28
"""Copies of a member are up to this part of the largest squared distance apart."""
_NO_MASS = 1e-15
"""Weights below this are spread evenly where there are far members."""


def normalize_weights(
    log_weights: ArrayLike, shape: tuple[int, ...] | None = None
) -> Array:
    """Return weights (..., N) that sum to one, from their logarithms in any normalisation.

    Minus infinity is a weight of zero.
    """
    logs = check_array(log_weights, "log_weights", shape, finite=False)
    largest = logs.max(axis=-1, keepdims=True)
    if np.isneginf(largest).any():
        raise ValueError(
            "log_weights must have a positive weight in every ensemble, got zeros only"
        )
    if not np.isfinite(largest).all():
        raise ValueError(
            "log_weights must be numbers below infinity, got NaN or infinity"
        )
    # Logarithms of weights, or of likelihoods, are negative as a rule: positive numbers may be the
    # weights themselves, of which a warning is given.
    if logs.size and logs.max() > 0:
        _warn_of_likelihoods(logs)
    # Divided by the largest weight, so that none overflows.
    weights = np.exp(logs - largest)
    return np.asarray(weights / weights.sum(axis=-1, keepdims=True))


def _warn_of_likelihoods(logs: Array) -> None:
    """Warn if log-weights (..., N) look like weights or likelihoods whose logarithm is missing.

    Those are not negative, and either all at most 1, or mostly small beside the largest. Logarithms
    of high densities are positive too, but most of them are near the largest one.

    >>> with warnings.catch_warnings(action="error"):
    ...     _warn_of_likelihoods(np.array([21.0, 17.5, 20.3, 19.9]))
    ...     _warn_of_likelihoods(np.array([0.9, 0.0001, 0.02, 0.03]))
    Traceback (most recent call last):
    RuntimeWarning: log_weights must be logarithms, got numbers from 0.0001 to 0.9, ...
    """
    rows = logs.reshape(-1, logs.shape[-1])
    least = rows.min(axis=-1)
    largest = rows.max(axis=-1)
    # Equal numbers mean equal weights, whether they are logarithms or not.
    is_suspect = (least >= 0) & (largest > least)
    if not is_suspect.any():
        return
    is_suspect &= (largest <= 1) | (np.median(rows, axis=-1) < 0.1 * largest)
    if not is_suspect.any():
        return
    k = int(is_suspect.argmax())
    warnings.warn(
        f"log_weights must be logarithms, got numbers from {least[k]:g} to {largest[k]:g}, as "
        "likelihoods or weights are: take np.log of them",
        RuntimeWarning,
        # The warning points at the call of the rule: above are `normalize_weights`, the rule, and
        # its validation.
        stacklevel=5,
    )


@lru_cache(maxsize=8)
def _tie_breaker(n: int) -> Array:
    """Return a fixed matrix (n, n) between 0 and 1e-7, an addition to costs of range one.

    Where members coincide, as copies do after one weight has dominated, the cheapest coupling is
    not unique, and the last bit of a cost would choose between quite different ensembles. With the
    addition the choice is the same on every machine.
    """
    addition = _TIE_BREAK * np.random.default_rng(0).random((n, n))
    # Read-only, since the cache returns the same array again.
    addition.setflags(write=False)
    return addition


@validated
def transport_plans(
    ensemble: SquarableEnsemble, log_weights: ArrayLike, *, cost: Cost = "squared"
) -> Array:
    """Return optimal couplings of weighted members to the same members with equal weights.

    Parameters
    ----------
    ensemble : array_like, (..., N, d)
        Members.
    log_weights : array_like, (..., N)
        Logarithms of their weights, in any normalisation.
    cost : {"squared", "distance"}
        The cost of a unit of mass: the squared Euclidean distance (Reich), with which the loss of
        spread vanishes as members become many, or the distance itself, which Das and Bhattacharya
        print below (5).

    Returns
    -------
    ndarray, (..., N, N)
        Row i is the distribution of member i's mass. If several plans are optimal, as with copies
        of a member, a fixed addition of at most 1e-7 of the largest cost makes the choice. Where
        members are far from most others it is at most 1e-7 of the lower quartile of the costs.

    Examples
    --------
    >>> transport_plans([[0.0], [1.0]], np.log([0.75, 0.25]))
    array([[0.5 , 0.25],
           [0.  , 0.25]])
    """
    weights = normalize_weights(log_weights, ensemble.shape[:-1])
    # POT's network simplex
    return _solve_plans(ensemble, weights, solver_of("network"), cost)


def _solve_plans(
    ensemble: Array, weights: Array, solve: Solve, cost: Cost = "squared"
) -> Array:
    """Return couplings (..., N, N) of weights (..., N) to equal masses, for members (..., N, d).

    `cost` names the cost of two members, and `solve` solves for one plan.
    """
    n = weights.shape[-1]
    # The squared distances of each ensemble of the batch, one after the other
    flat_ensemble = ensemble.reshape(-1, *ensemble.shape[-2:])
    squares = np.array([squared_distances(members) for members in flat_ensemble])
    costs = squares.reshape(*weights.shape, n)
    if cost == "distance":
        # Squared distances up to the part _ROUNDING of the largest are those of copies of one
        # member. Of distances this part is the root of it.
        return _solve_couplings(np.sqrt(costs), weights, solve, _ROUNDING**0.5)
    return _solve_couplings(costs, weights, solve)


def _solve_couplings(
    costs: Array, weights: Array, solve: Solve, rounding: float = _ROUNDING
) -> Array:
    """Return couplings of the weights to equal masses, for costs (..., N, N).

    Costs up to the part `rounding` of the largest one are those of copies. The weights are
    (..., N), and `solve` solves for one plan.
    """
    n = weights.shape[-1]
    equal = np.full(n, 1 / n)
    # Tiny, so that of several optimal plans the choice is the same on every machine.
    addition = _tie_breaker(n)
    plans = np.empty_like(costs)
    for index in np.ndindex(weights.shape[:-1]):
        scaled_cost = scale_cost(costs[index]).scaled
        # Beside the costs of a few far members those of the others vanish in the solver's rounding.
        if _has_far_members(scaled_cost, rounding):
            plans[index] = _couple_far_members(
                costs[index], weights[index], solve, rounding
            )
            continue
        solution = solve(scaled_cost + addition, weights[index], equal)
        plans[index] = solution.plan
    return plans


def _has_far_members(scaled_cost: Array, rounding: float = _ROUNDING) -> bool:
    """Whether a few large costs set the range, so that over a quarter is small beside it.

    The costs (N, N) are between zero and one; those up to `rounding` are of copies and count not.

    >>> x = np.array([[0.0], [1.0], [2.0], [3.0], [1e4]])
    >>> for members in (x, x[:4]):
    ...     _has_far_members(scale_cost(squared_distances(members)).scaled)
    True
    False
    """
    # Below a millionth of the largest cost
    is_small = scaled_cost < _FAR
    # A quick test for the usual case: of all costs, copies included, at most a fifth is small.
    # Without the copies, which are small, the part of small ones is less still.
    if 5 * np.count_nonzero(is_small) <= is_small.size:
        return False
    # Copies of a member are at no distance, but for rounding.
    is_apart = scaled_cost > rounding
    is_near = is_apart & is_small
    return bool(4 * np.count_nonzero(is_near) > np.count_nonzero(is_apart))


def _couple_far_members(
    costs: Array, weights: Array, solve: Solve, rounding: float
) -> Array:
    """Return the coupling (N, N) of weights to equal masses where some members are far away.

    Costs are (N, N); those up to the part `rounding` of the largest are between copies of a member.
    Ties are broken by a part of the typical cost, the lower quartile of the others, which is not
    above the distances of near members.
    """
    n = weights.size
    equal = np.full(n, 1 / n)
    # The members that have any weight to speak of
    rows = np.flatnonzero(weights > _NO_MASS)
    # A constant that is taken off a column does not change the plan. Without it the cost of a far
    # place is only what it costs more to go there from one member than from another.
    excess_costs = costs[rows] - costs[rows].min(axis=0)
    # The typical cost leaves out copies of a member.
    is_apart = costs > rounding * costs.max()
    typical = float(np.quantile(costs[is_apart], 0.25))
    # A tiny addition that chooses among plans of one cost
    excess_costs = excess_costs + _tie_breaker(n)[rows] * typical
    mass = weights[rows].sum()
    part = _solve_in_stages(excess_costs, weights[rows] / mass, equal, typical, solve)
    # The mass of members with almost no weight is spread evenly over all places. The masses of rows
    # and columns stay exact, and the solver meets no tiny numbers.
    plan = np.outer(weights, equal)
    plan[rows] = mass * part
    return plan


def _solve_in_stages(
    cost: Array, a: Array, b: Array, typical: float, solve: Solve
) -> Array:
    """Return the plan for costs that differ by many powers of ten, the large differences first.

    Costs are (N, M), masses a (N,) and b (M,), and `typical` is a typical cost. The potentials of
    one stage are taken off the cost, which does not change the plan. The reduced cost is small
    where the plan has mass, and is cut above a limit for the next stage: a million, then a thousand
    times the typical cost, so that the solver resolves ever smaller differences.
    """
    scaled_cost = scale_cost(cost)
    solution = solve(scaled_cost.scaled, a, b)
    plan = solution.plan
    # The columns' potentials in units of the cost, (M,)
    g = scaled_cost.potential_of_cost(solution.column_potential)
    for limit in (1e6 * typical, 1e3 * typical):
        # Reduced costs c_ij - f_i - g_j >= 0, with f_i = min_j (c_ij - g_j).
        cost = cost - g
        cost = cost - cost.min(axis=1, keepdims=True)
        scaled_cost = scale_cost(np.minimum(cost, limit))
        trial = solve(scaled_cost.scaled, a, b)
        # Costs were cut at the limit. If the plan needs links above it, it is not the optimal one,
        # and that of the last stage stays. (Some 1e-12 of mass may be there by rounding.)
        if trial.plan[cost > limit].sum() > 1e-12:
            break
        plan = trial.plan
        g = scaled_cost.potential_of_cost(trial.column_potential)
    return plan


@validated
def transform_ensemble(
    ensemble: SquarableEnsemble,
    log_weights: ArrayLike,
    *,
    solver: Solver = "network",
    regularisation: PositiveFloat = 0.01,
    debias: bool = False,
    correct: bool = False,
    cost: Cost = "squared",
) -> Array:
    r"""Replace weighted members by the same number with equal weights.

    .. math:: \mathbf X^+ = \mathbf X\,N\,\mathbf T

    Parameters
    ----------
    ensemble : array_like, (..., N, d)
        Members.
    log_weights : array_like, (..., N)
        Logarithms of their weights, in any normalisation; -inf is a weight of zero.
    solver, regularisation
        As for :func:`~distfilt.coupling.transport_plan`.
    debias : bool
        Subtract the displacement that the solver's plan gives members whose weights are equal
        already. An entropic plan shrinks the ensemble; this undoes most of it. An optimal plan
        does not need it: it only swaps members within the tie-breaker of :func:`transport_plans`.
    correct : bool
        Give the new members the weighted covariance too, by :func:`correct_moments`.
    cost : {"squared", "distance"}
        As for :func:`transport_plans`.

    Returns
    -------
    ndarray, (..., N, d)

    Raises
    ------
    SolverError
        If the solver stops without a solution.

    Examples
    --------
    >>> transform_ensemble([[0.0], [1.0]], np.log([0.75, 0.25]))
    array([[0. ],
           [0.5]])
    >>> bool(transform_ensemble([[0.0], [1.0]], [-1e4, -2e4])[1, 0] == 0.0)
    True
    """
    weights = normalize_weights(log_weights, ensemble.shape[:-1])
    solve = solver_of(solver, regularisation)
    # X⁺ = X N T, with members as columns and a coupling T (N, N) for each ensemble.
    plans = _solve_plans(ensemble, weights, solve, cost)
    transformed = apply_plan(ensemble, weights, plans)
    if debias:
        equal = np.full(weights.shape, 1 / ensemble.shape[-2])
        plans = _solve_plans(ensemble, equal, solve, cost)
        # x_j - N sum_i t_ij x_i for equal weights is the solver's own displacement.
        transformed += ensemble - apply_plan(ensemble, equal, plans)
        # The mean becomes the weighted one again.
        mean = transformed.mean(axis=-2, keepdims=True)
        transformed += weights[..., None, :] @ ensemble - mean
    if not correct:
        return transformed
    return _match_weighted_moments(transformed, ensemble, weights)


def apply_plan(
    ensemble: Array, weights: Array, plan: Array, *, correct: bool = False
) -> Array:
    """Transform members (..., N, d) with weights (..., N) by a coupling (..., N, N).

    Equation (3) of Das and Bhattacharya. With `correct` the moments become the weighted ones. The
    new members are (..., N, d).
    """
    # x_j = m + N sum_i t_ij (x_i - m), since column j of the plan has the mass 1/N. About the
    # weighted mean m, so that members far from the origin lose no digits.
    mean = weights[..., None, :] @ ensemble
    shift = ensemble.shape[-2] * (plan.mT @ (ensemble - mean))
    transformed = np.asarray(mean + shift)
    if not correct:
        return transformed
    return _match_weighted_moments(transformed, ensemble, weights)


@validated
def correct_moments(
    transformed: SquarableEnsemble, ensemble: Forecast, log_weights: ArrayLike
) -> Array:
    r"""Give transformed members the mean and covariance of the weighted ones, exactly.

    Averages vary less than the averaged members, so :math:`\mathbf X^+` has too small a covariance.
    The symmetric matrix

    .. math:: \mathbf B = \mathbf P^{1/2}
        (\mathbf P^{1/2}\mathbf C\mathbf P^{1/2})^{-1/2}\mathbf P^{1/2}

    takes its covariance :math:`\mathbf C` to the weighted covariance :math:`\mathbf P` and is the
    map that moves a Gaussian least.

    Parameters
    ----------
    transformed : array_like, (..., N, d)
        Members from :func:`transform_ensemble`.
    ensemble, log_weights
        The arguments of :func:`transform_ensemble`.

    Returns
    -------
    ndarray, (..., N, d)
        If `transformed` has no spread in a direction in which the weighted members have some, the
        covariance stays zero there. Covariances are about the mean with N, not N - 1, in the
        denominator.

    Notes
    -----
    W. Acevedo, J. de Wiljes, S. Reich, SIAM Journal on Scientific Computing 39 (2017) A1834-A1850
    correct the N x N transform instead; this corrects by a d x d matrix and has the same moments.

    Examples
    --------
    >>> x, logs = [[0.0], [1.0]], np.log([0.75, 0.25])
    >>> transformed = transform_ensemble(x, logs)
    >>> float(correct_moments(transformed, x, logs).var().round(12))
    0.1875
    """
    weights = normalize_weights(log_weights, ensemble.shape[:-1])
    return _match_weighted_moments(transformed, ensemble, weights)


def _match_weighted_moments(
    transformed: Array, ensemble: Array, weights: Array
) -> Array:
    """Give members (..., N, d) the weighted mean and covariance of the ensemble.

    The map is that of :func:`correct_moments`. The members are `transformed`; the ensemble
    (..., N, d) has the weights (..., N).
    """
    n = ensemble.shape[-2]
    mean = weights[..., None, :] @ ensemble
    prior_anomalies = ensemble - mean
    anomalies = transformed - transformed.mean(axis=-2, keepdims=True)
    # P = K Kᵀ is the weighted covariance, with weights that sum to one.
    covariance = prior_anomalies.mT @ (weights[..., None] * prior_anomalies)
    root = _factor_by_size(covariance)
    # With B = K (Kᵀ C K)^(-1/2) Kᵀ for the anomalies A and their covariance C = AᵀA / N, and with
    # A K = U S Vᵀ, the new anomalies are A B = √N U Vᵀ Kᵀ. As the columns of U are orthonormal,
    # their covariance is K Kᵀ to rounding, however small C is.
    product = anomalies @ root
    u, sizes, vt = np.linalg.svd(product, full_matrices=False)
    # Directions without spread get none.
    noise = _singular_value_noise(transformed, product, root, vt.mT, n)
    u = u * (sizes[..., None, :] > noise)
    # The columns of U have mean zero, but for rounding.
    u -= u.mean(axis=-2, keepdims=True)
    return np.asarray(mean + np.sqrt(n) * (u @ vt @ root.mT))


def _singular_value_noise(
    transformed: Array, product: Array, root: Array, axes: Array, n: int
) -> Array:
    """Return the singular values, (..., 1, d), that rounding of an SVD's argument can cause.

    The argument is the `product` (..., N, d) of anomalies of the `transformed` members and the
    `root` (..., d, d), with right singular vectors `axes` (..., d, d). Rounding of the members
    enters through the root, rounding of the product directly.
    """
    member_size = np.abs(transformed).max(axis=-2, keepdims=True)
    column_size = np.abs(product).max(axis=-2, keepdims=True)
    sum_of_errors = member_size @ np.abs(root @ axes) + column_size @ np.abs(axes)
    return np.asarray(n * EPS * sum_of_errors)


def _factor_by_size(covariance: Array) -> Array:
    """Return a factor K of covariances K K', (..., d, d): a Cholesky factor with sorted components.

    They are sorted by their variances, the largest first. The columns of the factor then shrink as
    the components do, and a small unit does not vanish in the rounding of a large one.
    """
    variances = np.diagonal(covariance, axis1=-2, axis2=-1)
    order = np.argsort(-variances, axis=-1, kind="stable")
    # Rows, then columns, in this order
    sorted_rows = np.take_along_axis(covariance, order[..., :, None], axis=-2)
    lower = factor(np.take_along_axis(sorted_rows, order[..., None, :], axis=-1))
    # Back to the given order of components.
    inverse_order = np.argsort(order, axis=-1)
    return np.take_along_axis(lower, inverse_order[..., :, None], axis=-2)


@validated
def rejuvenate(
    transformed: Annotated[Ensemble, FINITE_SQUARE],
    ensemble: Forecast,
    *,
    bandwidth: NonNegativeFloat,
    rng: Rng,
) -> Array:
    r"""Add random combinations of the forecast's anomalies, which keep the mean.

    .. math:: \mathbf x_j' = \mathbf x_j^+ + \frac{h}{\sqrt{N-1}}\sum_i(\mathbf x_i-\bar{\mathbf x})
        \,\xi_{ij},\qquad \sum_j\xi_{ij}=0

    Parameters
    ----------
    transformed : array_like, (..., N, d)
        Members from :func:`transform_ensemble`, at least two.
    ensemble : array_like, (..., N, d)
        The forecast.
    bandwidth : float
        h, at least 0: the covariance grows by about h² times the forecast's.
    rng : numpy.random.Generator

    Returns
    -------
    ndarray, (..., N, d)
        The additions lie in the span of the forecast's anomalies, and their mean is zero.

    Examples
    --------
    >>> x = np.array([[0.0], [1.0], [4.0]])
    >>> after = rejuvenate(
    ...     np.zeros((3, 1)), x, bandwidth=0.1, rng=np.random.default_rng(0)
    ... )
    >>> bool(abs(after.mean()) < 1e-15), len(set(after.ravel()))
    (True, 3)
    """
    n = ensemble.shape[-2]
    normal = rng.standard_normal((*ensemble.shape[:-1], n))
    # Centring costs one part in N of the variance.
    combinations = normal - normal.mean(axis=-2, keepdims=True)
    combinations = combinations * np.sqrt(n / (n - 1))
    anomalies = ensemble - ensemble.mean(axis=-2, keepdims=True)
    noise = bandwidth / np.sqrt(n - 1) * (combinations @ anomalies)
    return np.asarray(transformed + noise)


@validated
def transform_within(
    ensemble: Annotated[ArrayInput, "n d", FINITE_SQUARE],
    log_weights: ArrayLike,
    pieces: Annotated[IndicesInput, "n"],
    *,
    rng: Rng,
) -> Array:
    r"""Transform members on a set cut into pieces, without averages across pieces.

    Each new member chooses a piece p with probability :math:`N\sum_{i\in p}t_{ij}` and is the
    average within it. Convex pieces contain their averages, so no member leaves the set. With one
    piece it is :func:`transform_ensemble`; with a piece for every member, random resampling by the
    plan.

    Parameters
    ----------
    ensemble : array_like, (N, d)
        Members.
    log_weights : array_like, (N,)
        Logarithms of their weights.
    pieces : array_like of int, (N,)
        The number of each member's piece.
    rng : numpy.random.Generator
        Chooses the pieces, systematically: each gets its probability times N members on average,
        and hardly more or fewer (by four or five where many pieces are interleaved).

    Returns
    -------
    ndarray, (N, d)
        The mean is the weighted mean on average over the choice.

    Examples
    --------
    >>> x = [[-1.0], [-0.9], [0.9], [1.0]]
    >>> y = transform_within(
    ...     x, np.log([0.4, 0.1, 0.1, 0.4]), [0, 0, 1, 1], rng=np.random.default_rng(0)
    ... )
    >>> bool((np.abs(y) >= 0.9).all())
    True
    """
    plan = len(ensemble) * transport_plans(ensemble, log_weights)
    # The distinct numbers of pieces, P of them, and which of them each member has
    labels, index = np.unique(pieces, return_inverse=True)
    # Row p marks the members of piece p.
    membership = (index == np.arange(labels.size)[:, None]).astype(np.float64)
    choice = _choose_rows(membership @ plan, rng)
    # New member j is the average of the mass that comes to it from its chosen piece.
    masses = plan * membership[choice].T
    return np.asarray(masses.T @ ensemble / masses.sum(axis=0)[:, None])


def _choose_rows(probabilities: Array, rng: Rng) -> Indices:
    """Choose a row for each column, with the column's probabilities and hardly varying totals.

    Each column of the probabilities (P, N) sums to one; the result is (N,). The rows take their
    turns. The columns that have not chosen yet are laid end to end, each as long as its probability
    of this row, given that it chose none before. The columns that contain one of the levels k + u,
    with integers k and one uniform number u, choose the row.
    """
    n_rows, n_columns = probabilities.shape
    undecided = np.arange(n_columns)
    # A column that chooses no other row gets the last.
    choice = np.full(n_columns, n_rows - 1)
    # Probability of a row or a later one, in every column.
    tail = np.cumsum(probabilities[::-1], axis=0)[::-1]
    for row in range(n_rows - 1):
        remaining = tail[row, undecided]
        conditional = probabilities[row, undecided] / np.where(
            remaining > 0, remaining, 1.0
        )
        # Systematic sampling: a level lies in a column if the floor increases there.
        levels = np.floor(np.cumsum(conditional) + rng.random())
        chosen = np.diff(levels, prepend=0.0) > 0
        choice[undecided[chosen]] = row
        undecided = undecided[~chosen]
    # By rounding a column could get a row of zero probability.
    impossible = probabilities[choice, np.arange(n_columns)] <= 0
    return np.asarray(np.where(impossible, probabilities.argmax(axis=0), choice))


@validated
def transform_along(
    ensemble: SquarableEnsemble,
    log_weights: ArrayLike,
    *,
    difference: Callable[[Array, Array], Array],
    retract: Callable[[Array, Array], Array],
) -> Array:
    r"""Transform members on a curved set by averages of tangent vectors.

    .. math:: \mathbf x_j^+ = \operatorname{retract}\Bigl(\mathbf x_j,\;
        N\sum_it_{ij}\operatorname{difference}(\mathbf x_i,\mathbf x_j)\Bigr)

    with the cost :math:`|\operatorname{difference}(\mathbf x_i,\mathbf x_j)|^2`.

    Parameters
    ----------
    ensemble : array_like, (..., N, d)
        Members on the set.
    log_weights : array_like, (..., N)
        Logarithms of their weights.
    difference : callable
        ``difference(x, base) -> v``, (..., k): the tangent vector at `base` that points to `x`,
        both (..., d). On a circle the angle between them, wrapped.
    retract : callable
        ``retract(base, v) -> x``, (..., d): the point of the set that a tangent vector leads to.

    Returns
    -------
    ndarray, (..., N, d)
        On the set as precisely as the points of `retract` are.

    Examples
    --------
    Angles on both sides of ±π; the plain average of the second pair would be near zero.

    >>> def wrapped(a, b):
    ...     return (a - b + np.pi) % (2 * np.pi) - np.pi
    >>> transform_along(
    ...     [[3.0], [-3.0]],
    ...     np.log([0.75, 0.25]),
    ...     difference=wrapped,
    ...     retract=lambda x, v: wrapped(x + v, 0.0),
    ... ).round(3)
    array([[ 3.   ],
           [-3.142]])
    """
    n = ensemble.shape[-2]
    weights = normalize_weights(log_weights, ensemble.shape[:-1])
    # All pairs (i, j): the tangent vector at member j that points to member i. Copies, since the
    # user's functions might write into their arguments.
    points, bases = np.broadcast_arrays(
        ensemble[..., :, None, :], ensemble[..., None, :, :]
    )
    tangents = check_array(
        call_user(difference, points.copy(), bases.copy()),
        "difference",
        (*ensemble.shape[:-1], n, "k"),
    )
    costs = (tangents * tangents).sum(axis=-1)
    # Optimal couplings (..., N, N) of the weights to equal masses, by POT's network simplex.
    plans = _solve_couplings(costs, weights, solver_of("network"))
    # v_j = N sum_i t_ij difference(x_i, x_j).
    steps = n * np.einsum("...ij,...ijk->...jk", plans, tangents)
    transformed = call_user(retract, ensemble.copy(), steps)
    return check_array(transformed, "retract", ensemble.shape)
