r"""Optimal couplings of two discrete distributions, by several solvers and with a certificate.

.. math:: \min_{\mathbf T}\sum_{ij}t_{ij}\,c_{ij}\quad\text{subject to}\quad
    \sum_jt_{ij}=w_i,\quad\sum_it_{ij}=v_j,\quad t_{ij}\ge0,

equation (5) of Das and Bhattacharya, whose columns have equal masses. Rows are sources, columns
are targets.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Annotated, Literal, NamedTuple

import numpy as np

from ..linalg import SolverError
from ..validation import (
    Array,
    ArrayInput,
    Bounds,
    FrozenModel,
    Indices,
    PositiveFloat,
    Probabilities,
    import_optional,
    validated,
)

__all__ = ["TransportPlan", "monotone_plan", "squared_distances", "transport_plan"]

Solver = Literal["network", "entropic"]
"""POT's network simplex, or Newton's method on the entropic problem."""

FINITE_SQUARE = Bounds(at_least=-1e150, at_most=1e150)
"""The range of numbers whose squares are finite."""
_PIVOTS = 10_000_000
"""Largest number of pivots of the network simplex; more mean that it cycles."""
_NEWTON = 1000
"""Largest number of Newton steps; twenty are enough as a rule."""
_OPTIMAL = 1e-9
"""A plan is solved again if its duality gap is a larger part of its cost."""
_RESOLVED = 1e6
"""Costs are cut at so many times the mean cost of a plan: beside larger ones the network simplex,
whose tolerances are relative to the largest, does not resolve the others."""
_FORBIDDEN = 1e4
"""Costs that exceed all others by this factor are those of forbidden links."""


@dataclass(frozen=True, eq=False)
class TransportPlan(FrozenModel):
    r"""A coupling, its cost and the dual solution that bounds the cost from below.

    Parameters
    ----------
    matrix : ndarray, (N, M)
        Masses :math:`t_{ij}`; rows and columns sum to the requested masses.
    value : float
        Its cost :math:`\sum_{ij}t_{ij}c_{ij}`.
    potentials : tuple of ndarray, (N,) and (M,)
        Feasible for the dual problem: :math:`f_i+g_j\le c_{ij}` for all pairs.
    bound : float
        The dual value :math:`\sum_if_iw_i+\sum_jg_jv_j`; no coupling costs less.

    Examples
    --------
    >>> swap = transport_plan([[1.0, 0.0], [0.0, 1.0]], [0.5, 0.5])
    >>> swap.matrix
    array([[0. , 0.5],
           [0.5, 0. ]])
    >>> swap.value, swap.duality_gap
    (0.0, 0.0)
    """

    matrix: Annotated[Array, "n m"]
    value: float
    potentials: tuple[Array, Array]
    bound: float

    @property
    def duality_gap(self) -> float:
        """Cost above the bound: zero, to rounding, for an optimal coupling."""
        return self.value - self.bound


@validated
def squared_distances(
    source: Annotated[ArrayInput, "n d"],
    target: Annotated[ArrayInput, "m d"] | None = None,
) -> Array:
    r"""Return the costs :math:`c_{ij}=|\mathbf x_i-\mathbf y_j|^2` between two sets of points.

    Parameters
    ----------
    source : array_like, (N, d)
        Points that have mass.
    target : array_like, (M, d), optional
        Points that receive it; the same points by default.

    Returns
    -------
    ndarray, (N, M)

    Examples
    --------
    >>> squared_distances([[0.0], [3.0]])
    array([[0., 9.],
           [9., 0.]])
    """
    if target is None:
        target = source
    squares = np.zeros((len(source), len(target)))
    # |x|² - 2 x'y + |y|² would lose small distances in rounding.
    for k in range(source.shape[1]):
        difference = source[:, k, None] - target[:, k]
        squares += difference * difference
    return squares


@validated
def transport_plan(
    cost: Annotated[ArrayInput, "n m"],
    rows: Annotated[Probabilities, "n"],
    columns: Annotated[Probabilities, "m"] | None = None,
    *,
    solver: Solver = "network",
    regularisation: PositiveFloat = 0.01,
) -> TransportPlan:
    """Return the cheapest coupling of two sets of masses.

    Parameters
    ----------
    cost : array_like, (N, M)
        Cost of a unit of mass from each row to each column. It is shifted and divided by its range
        before the solution, since the solvers' tolerances are absolute. The range is that of the
        links that can carry mass: rows and columns without mass do not count, and a very large
        cost forbids a link without an effect on the others.
    rows : array_like, (N,)
        Nonnegative masses that sum to one.
    columns : array_like, (M,), optional
        The same; equal masses by default.
    solver : {"network", "entropic"}
        POT's network simplex, which needs the extra ``maps``, solves the linear programme. The
        other adds the plan's entropy to the cost.
    regularisation : float
        For ``"entropic"``: the weight of the entropy in units of the cost's range. Its plan is
        spread out and costs more than the optimal one. Costs ten thousand times larger than
        all others do not count in the range, unless the plan needs these links.

    Returns
    -------
    TransportPlan
        The marginals hold to rounding with every solver: an iteration's error in them, at most
        1e-8, is corrected by the row and column sums.

    Raises
    ------
    ValueError
        If sizes differ, a mass is negative, a sum is not one or a cost is not finite.
    SolverError
        With the solver's status, if it stops without a solution, or if the duality gap of the
        network simplex shows that its plan is not optimal.
    ModuleNotFoundError
        If the solver's package is not installed; the message names the extra that brings it.

    Notes
    -----
    The rounding of the marginals is that of J. Altschuler, J. Weed, P. Rigollet, Advances in
    Neural Information Processing Systems 30 (2017).

    Examples
    --------
    >>> plan = transport_plan(squared_distances([[0.0], [1.0], [3.0]]), [0.5, 0.5, 0.0])
    >>> (3 * plan.matrix).round(3)
    array([[1. , 0.5, 0. ],
           [0. , 0.5, 1. ],
           [0. , 0. , 0. ]])
    >>> float(round(plan.value, 9)), plan.duality_gap < 1e-12
    (1.5, True)
    """
    # Masses a of the rows and b of the columns.
    a, b = _normalize_masses(rows, columns, cost.shape[1])
    solve = solver_of(solver, regularisation)
    # To certify a plan is to add potentials that bound its cost from below. The solver gets rows
    # and columns with mass only, the entropic one the range of the links that are not forbidden.
    if solver == "entropic":
        return _certify(cost, a, b, _solve_allowed(cost, a, b, solve))
    plan = _certify(cost, a, b, _solve_on_support(cost, a, b, solve))
    # Solved again if the bound shows that the plan is not optimal.
    return _improve(plan, cost, a, b, solve)


def _normalize_masses(
    rows: Array, columns: Array | None, n_columns: int
) -> tuple[Array, Array]:
    """Return masses (N,) and (M,) that sum to one; those of the columns are equal by default."""
    if columns is None:
        column_masses = np.full(n_columns, 1 / n_columns)
    else:
        column_masses = columns / columns.sum()
    return rows / rows.sum(), column_masses


class Solution(NamedTuple):
    """A solver's plan (N, M), and the potentials (M,) of the columns in units of the cost."""

    plan: Array
    column_potential: Array


class ScaledCost(NamedTuple):
    """A cost (N, M) scaled to lie between zero and one: cost = minimum + scale * scaled."""

    scaled: Array
    minimum: float
    scale: float

    def potential_of_cost(self, potential: Array) -> Array:
        """Return potentials (M,) of the cost itself, given those of the scaled cost."""
        # If f_i + g_j <= c'_ij for the scaled costs c', then c = minimum + scale c' has the
        # potentials scale f and minimum + scale g.
        return self.minimum + self.scale * potential


def scale_cost(cost: Array, limit: float | None = None) -> ScaledCost:
    """Scale the cost (N, M) to lie between zero and one.

    With a limit the range is up to there, and larger costs remain larger than one.
    """
    minimum = float(cost.min())
    largest = float(cost.max()) if limit is None else limit
    scale = largest - minimum
    # A constant cost has no range, and any coupling is optimal.
    divisor = scale if scale > 0 else 1.0
    return ScaledCost((cost - minimum) / divisor, minimum, scale)


def _cost_on_support(cost: Array, a: Array, b: Array) -> Array:
    """Return the costs between the rows and columns whose masses a (N,), b (M,) are positive."""
    return np.asarray(cost[np.ix_(np.flatnonzero(a), np.flatnonzero(b))])


def _solve_on_support(
    cost: Array, a: Array, b: Array, solve: Solve, limit: float | None = None
) -> Solution:
    """Solve for the rows and columns with mass, with their costs scaled for the solver.

    The unit of the scaled costs is their range: up to the limit, if there is one, above which costs
    are larger than one. The potentials of columns without mass are zero. Costs are (N, M), and a
    (N,), b (M,) are the masses of rows and columns.
    """
    rows = np.flatnonzero(a)
    columns = np.flatnonzero(b)
    # The costs between rows and columns with mass, scaled to lie between zero and one
    supported = scale_cost(_cost_on_support(cost, a, b), limit)
    part = solve(supported.scaled, a[rows], b[columns])
    # Back to all rows and columns, and to potentials of the cost itself
    plan = np.zeros(cost.shape)
    plan[np.ix_(rows, columns)] = part.plan
    potential = np.zeros(cost.shape[1])
    potential[columns] = supported.potential_of_cost(part.column_potential)
    return Solution(plan, potential)


def _solve_allowed(cost: Array, a: Array, b: Array, solve: Solve) -> Solution:
    """Solve the entropic problem with the range of the links that are not forbidden.

    Costs are (N, M), and a (N,), b (M,) are the masses of rows and columns. Forbidden links have
    costs far above all others.
    """
    # The largest cost of a link that is not forbidden; None if there is no forbidden one.
    limit = _largest_allowed(_cost_on_support(cost, a, b))
    if limit is not None:
        try:
            solution = _solve_on_support(cost, a, b, solve, limit)
        except SolverError:
            # There is no plan without the forbidden links.
            limit = None
        else:
            if not solution.plan[cost > limit].any():
                return solution
    # All links count if there are no forbidden ones, or if the plan cannot do without.
    return _solve_on_support(cost, a, b, solve)


def _largest_allowed(cost: Array) -> float | None:
    """Return the largest of costs (N, M) below a wide gap, if there is one.

    Costs above the gap are huge, as a user gives them to links that the plan must not use.

    >>> _largest_allowed(np.array([[0.0, 1.0], [3.0, 1e9]]))
    3.0
    >>> _largest_allowed(np.array([[0.0, 1.0], [3.0, 9.0]]))
    >>> _largest_allowed(np.array([[0.0, 1.0], [1e9, 0.0]]))
    1.0

    A plan has N + M - 1 links, so fewer cheap ones are no reason to forbid the others:

    >>> _largest_allowed(squared_distances([[0.0], [1e-9], [1.0], [2.0]]))
    """
    shifted = cost - cost.min()
    # A limit below the cheapest link of some row or column would leave its mass no way.
    dearest_minimum = max(shifted.min(axis=1).max(), shifted.min(axis=0).max())
    values = np.sort(shifted[(shifted > 0) & (shifted >= dearest_minimum)])
    # Costs after which the next one is ten thousand times as large.
    gaps = np.flatnonzero(values[1:] > _FORBIDDEN * values[:-1])
    # A vertex of the N x M transport polytope has mass on N + M - 1 links.
    n_links = sum(cost.shape) - 1
    for limit in values[gaps].tolist():
        if np.count_nonzero(shifted <= limit) >= n_links:
            return float(limit + cost.min())
    return None


def _improve(
    plan: TransportPlan, cost: Array, a: Array, b: Array, solve: Solve
) -> TransportPlan:
    """Solve again with costs cut at a limit while the duality gap is too wide.

    The plan is that of `solve` for costs (N, M) and masses a (N,) and b (M,); returned is the best
    one found. Beside a very large cost the others vanish in the solver's rounding. An optimal plan
    for the cut costs that uses no link above the limit is optimal for the costs themselves.
    """
    # The costs between rows and columns with mass
    supported = _cost_on_support(cost, a, b)
    minimum = float(supported.min())
    # Above this part of the plan's mean cost the solver would not resolve the others.
    limit = minimum + _RESOLVED * (plan.value - minimum)
    # Each round either makes the plan better or the limit a thousand times larger: few are needed.
    for _ in range(20):
        excess = plan.value - minimum
        is_optimal = plan.duality_gap <= _OPTIMAL * excess
        if is_optimal or limit >= supported.max():
            break
        cut_cost = np.minimum(cost, limit)
        solution = _solve_on_support(cut_cost, a, b, solve)
        if solution.plan[cost > limit].any():
            # The plan needs dearer links.
            limit = minimum + 1e3 * (limit - minimum)
            continue
        # With a lower bound of the cost, from which the duality gap follows
        trial = _certify(cost, a, b, solution)
        if not trial.duality_gap < plan.duality_gap:
            break
        plan = trial
        limit = minimum + _RESOLVED * (plan.value - minimum)
    # An error if the gap is still too wide.
    _check_gap(plan, minimum, a, b)
    return plan


def _check_gap(plan: TransportPlan, minimum: float, a: Array, b: Array) -> None:
    """Raise an error if the duality gap is above a millionth of the cost, and above rounding.

    The cost counts from its minimum, since a constant that is added to it changes nothing. The
    plan's potentials are (N,) and (M,), and so are the masses a of its rows and b of its columns.
    """
    f, g = plan.potentials
    # Rounding of the two sums of the bound, and of the cost, is proportional to their terms.
    sizes = np.abs(f) @ a + np.abs(g) @ b + abs(plan.value)
    allowed = 1e-6 * (plan.value - minimum) + 1e-12 * float(sizes)
    if not plan.duality_gap <= allowed:
        raise SolverError(
            f"network simplex: the plan's cost {plan.value:.6g} is not optimal, its bound "
            f"is {plan.bound:.6g}: cost must have entries less far apart"
        )


def _certify(cost: Array, a: Array, b: Array, solution: Solution) -> TransportPlan:
    """Return the plan with potentials that are feasible whatever the solver's were.

    Given the columns' potentials g (M,), the largest feasible f and then the largest feasible g are
    taken: the best bound that can be had from them. The cost is (N, M), the masses are a (N,) and b
    (M,), and the solution is a solver's.
    """
    # A solver leaves out columns without mass; their potentials have no meaning.
    g = np.where(b > 0, solution.column_potential, -np.inf)
    # f_i = min_j (c_ij - g_j), then g_j = min_i (c_ij - f_i): f_i + g_j <= c_ij.
    f = (cost - g).min(axis=1)
    g = (cost - f[:, None]).min(axis=0)
    value = float((solution.plan * cost).sum())
    bound = float(f @ a + g @ b)
    return TransportPlan.construct(solution.plan, value, (f, g), bound)


Solve = Callable[[Array, Array, Array], Solution]
"""``solve(cost, row_masses, column_masses)`` for a cost between zero and one."""


def solver_of(name: Solver, regularisation: float = 0.01) -> Solve:
    """Return the solver of a name, with its option, for a cost between zero and one."""
    if name == "entropic":
        return partial(_solve_entropic, strength=regularisation)
    return _solve_network


def _solve_network(cost: Array, a: Array, b: Array) -> Solution:
    """Solve by POT's network simplex.

    It is called directly: `ot.emd` around it would take 0.2 ms more, half as much as the solution
    at N = 50. The cost is (N, M), the masses are a (N,) and b (M,).
    """
    emd = import_optional("ot.lp.emd_wrap", "maps")
    plan, _value, _row_potential, column_potential, status = emd.emd_c(
        a, b, np.ascontiguousarray(cost), max_iter=_PIVOTS, numThreads=1
    )
    # In POT's solver 1 means optimal.
    if status != 1:
        raise SolverError(f"network simplex: stopped with status {status}")
    return Solution(np.asarray(plan), np.asarray(column_potential))


def _solve_entropic(cost: Array, a: Array, b: Array, strength: float) -> Solution:
    """Solve by Newton's method, with an entropy whose weight is halved down to `strength`.

    Sinkhorn's iteration is slow on the plateaus of a dual with little entropy. Masses of zero are
    left out. The cost is (N, M), the masses are a (N,) of the rows and b (M,) of the columns.
    """
    # The costs between rows and columns with mass
    rows = np.flatnonzero(a)
    columns = np.flatnonzero(b)
    supported = cost[np.ix_(rows, columns)]
    g = np.zeros(len(columns))
    # The first weight is a tenth of the cost's range or more, which makes the dual smooth.
    halvings = max(0, math.ceil(math.log2(0.1 / strength)))
    for k in range(halvings, -1, -1):
        # Only the last weight counts; the potentials of a larger one are a start for the next, for
        # which few digits are enough.
        weight = strength * 2.0**k
        tolerance = 1e-3 if k else 1e-10
        solution = _solve_unit_entropy(
            supported / weight, a[rows], b[columns], g / weight, tolerance
        )
        g = weight * solution.column_potential
    # Written so that NaN is an error too.
    if not solution.error < 1e-8:
        raise SolverError(
            f"entropic: marginals off by {solution.error:.3g} after {_NEWTON} Newton steps: "
            f"regularisation {strength:g} needs to be larger, or another solver"
        )
    # Rows and columns without mass are empty.
    plan = np.zeros(cost.shape)
    plan[np.ix_(rows, columns)] = solution.plan
    potential = np.zeros(cost.shape[1])
    potential[columns] = g
    # A corrected plan must not use forbidden links, whose costs are beyond the range.
    if cost.max() > 1:
        return Solution(_correct_in_proportion(plan, a, b), potential)
    return Solution(_correct_marginals(plan, a, b), potential)


def _correct_in_proportion(matrix: Array, a: Array, b: Array) -> Array:
    """Give a matrix its marginals by factors 1 + u_i + v_j, which keep empty links empty.

    The matrix (N, M) has sums of rows and columns near the masses a and b. They are linear in u and
    v, so that one round would do, but for rounding and for negative factors, which are cut at zero.
    """
    for _ in range(3):
        row_sums = matrix.sum(axis=1)
        column_sums = matrix.sum(axis=0)
        # diag(T1) u + T v = a - T1 and Tᵀu + diag(Tᵀ1) v = b - Tᵀ1. Adding a constant to u and
        # taking it off v changes nothing: the system is singular, and the least solution is taken.
        # Singular values below 1e-13 of the largest are rounding.
        system = np.block(
            [[np.diag(row_sums), matrix], [matrix.T, np.diag(column_sums)]]
        )
        errors = np.concatenate([a - row_sums, b - column_sums])
        # The least-squares solution of least length; the other results are not needed.
        factors = np.linalg.lstsq(system, errors, rcond=1e-13)[0]
        u, v = np.split(factors, [a.size])
        matrix = matrix * np.maximum(1 + u[:, None] + v, 0.0)
    return matrix


class _DualPoint(NamedTuple):
    """The plan (N, M) that belongs to a column potential, and the negative dual value there."""

    plan: Array
    negative_dual: float


class _EntropicSolution(NamedTuple):
    """A plan (N, M), its column potential (M,), and the total error of its column sums."""

    plan: Array
    column_potential: Array
    error: float


def _evaluate_dual(g: Array, cost: Array, rows: Array, columns: Array) -> _DualPoint:
    """Return the plan of a column potential, with exact row sums, and the negative dual value.

    The potential g is (M,), the cost (N, M), with an entropy of unit weight; `rows` are the masses
    a (N,), `columns` the masses b (M,).
    """
    from scipy.special import logsumexp

    # t_ij = a_i exp(g_j - c_ij) / sum_j exp(g_j - c_ij).
    exponents = g - cost
    log_sums = logsumexp(exponents, axis=1)
    plan = rows[:, None] * np.exp(exponents - log_sums[:, None])
    # sum_i a_i log sum_j exp(g_j - c_ij) - sum_j b_j g_j.
    return _DualPoint(plan, float(rows @ log_sums - columns @ g))


def _solve_unit_entropy(
    cost: Array, rows: Array, columns: Array, g: Array, tolerance: float
) -> _EntropicSolution:
    """Minimise the negative dual with unit entropy by damped Newton steps from g.

    Arguments are as of :func:`_evaluate_dual`; `tolerance` is for the error of the column sums,
    that of all columns together. The step is damped as by Levenberg and Marquardt: ten times less
    after a success, ten times more after a failure. The error that remains is returned with the
    solution.
    """
    # A start of one percent of the masses: far from the solution a full step could diverge.
    damping = 1e-2
    point = _evaluate_dual(g, cost, rows, columns)
    for _ in range(_NEWTON):
        sums = point.plan.sum(axis=0)
        # The gradient is sums - columns.
        error = float(np.abs(sums - columns).sum())
        # With more damping than 1e9 the steps vanish: nothing is left to gain.
        if error < tolerance or damping > 1e9:
            break
        # Hessian diag(Tᵀ1) - Tᵀ diag(a)⁻¹ T, damped in units of the masses.
        curvature = np.diag(sums + damping * columns)
        hessian = curvature - point.plan.T @ (point.plan / rows[:, None])
        trial_g = g - np.linalg.solve(hessian, sums - columns)
        trial = _evaluate_dual(trial_g, cost, rows, columns)
        change = trial.negative_dual - point.negative_dual
        accepted = change < 0
        # Near the solution the dual falls by less than rounding; its gradient still shrinks.
        if not accepted and abs(change) < 1e-9 * abs(point.negative_dual):
            trial_error = np.abs(trial.plan.sum(axis=0) - columns).sum()
            accepted = bool(trial_error < 0.5 * error)
        if accepted:
            # The dual does not change with a constant added to g. Without any damping the Hessian
            # would be singular in that direction.
            g = trial_g - trial_g.mean()
            point = trial
            damping = max(damping / 10, 1e-14)
        else:
            damping *= 10
    return _EntropicSolution(point.plan, g, error)


def _correct_marginals(matrix: Array, a: Array, b: Array) -> Array:
    """Return the matrix (N, M) with exact marginals a and b; the argument is overwritten.

    Rows and columns with too much mass are scaled down, then the mass that is missing is spread
    over those with too little: the rounding of J. Altschuler, J. Weed, P. Rigollet (2017).
    """
    for masses, axis in ((a, 1), (b, 0)):
        total = matrix.sum(axis=axis)
        # Each factor is masses / total, at most 1.
        excess = total > masses
        factor = np.divide(masses, total, out=np.ones_like(total), where=excess)
        matrix *= np.expand_dims(factor, axis)
    row_deficit = np.maximum(a - matrix.sum(axis=1), 0.0)
    column_deficit = np.maximum(b - matrix.sum(axis=0), 0.0)
    # Both sum to the same, but for rounding. If nothing is missing, both are zero.
    total_deficit = max(column_deficit.sum(), row_deficit.sum(), np.finfo(float).tiny)
    return np.asarray(matrix + np.outer(row_deficit, column_deficit) / total_deficit)


@validated
def monotone_plan(
    source: Annotated[ArrayInput, "n", FINITE_SQUARE],
    target: Annotated[ArrayInput, "m", FINITE_SQUARE],
    rows: Annotated[Probabilities, "n"],
    columns: Annotated[Probabilities, "m"] | None = None,
) -> TransportPlan:
    """Return the cheapest coupling on a line for squared distances, which keeps the order.

    Parameters
    ----------
    source : array_like, (N,)
        Positions of the masses.
    target : array_like, (M,)
        Positions to which they go.
    rows, columns
        As for :func:`transport_plan`.

    Returns
    -------
    TransportPlan

    Examples
    --------
    >>> monotone_plan([2.0, 0.0], [1.0, 5.0], [0.75, 0.25]).matrix
    array([[0.25, 0.5 ],
           [0.25, 0.  ]])
    """
    # Masses a of the sources and b of the targets, each in the order of their positions
    a, b = _normalize_masses(rows, columns, target.size)
    row_order = np.argsort(source, kind="stable")
    column_order = np.argsort(target, kind="stable")
    # Rows, columns and masses of the N + M - 1 cells of the plan, in ranks
    staircase = _couple_in_order(a[row_order], b[column_order])
    # From ranks back to the given order.
    i = row_order[staircase.rows]
    j = column_order[staircase.columns]
    plan = np.zeros((source.size, target.size))
    np.add.at(plan, (i, j), staircase.masses)
    # Potentials with f_i + g_j = c_ij on every cell of the staircase. A step to the next column in
    # the same row leaves f_i, so that g changes by the difference of the two costs. A step down
    # leaves g_j. The staircase never moves both ways at once.
    cost = (source[:, None] - target) ** 2
    cell_cost = cost[i, j]
    previous_column_cost = cost[i[1:], j[:-1]]
    sideways = np.diff(staircase.columns) > 0
    change = np.where(sideways, cell_cost[1:] - previous_column_cost, 0.0)
    g = np.zeros(target.size)
    g[j] = np.concatenate([[0.0], np.cumsum(change)])
    return _certify(cost, a, b, Solution(plan, g))


class _Staircase(NamedTuple):
    """Rows, columns and masses of the N + M - 1 cells of a coupling that keeps the order."""

    rows: Indices
    columns: Indices
    masses: Array


def _couple_in_order(a: Array, b: Array) -> _Staircase:
    """Return the coupling of masses a (N,) and b (M,) that keeps their order.

    Its cells go down and right like a staircase. Some may have a mass of zero.
    """
    # The unit interval is cut at both cumulative sums, but for the last, its end; each interval is
    # a cell.
    cuts = np.concatenate([np.cumsum(a)[:-1], np.cumsum(b)[:-1]])
    edges = np.concatenate([[0.0], np.sort(np.minimum(cuts, 1.0)), [1.0]])
    # A cell's row and column: the number of cuts of each kind at or before its start.
    order = np.argsort(cuts, kind="stable")
    is_row_cut = order < a.size - 1
    rows = np.concatenate([[0], np.cumsum(is_row_cut)])
    columns = np.concatenate([[0], np.cumsum(~is_row_cut)])
    return _Staircase(rows, columns, np.diff(edges))
