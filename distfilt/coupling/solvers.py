r"""Optimal couplings of two discrete distributions: one problem, several solvers, one certificate.

.. math:: \min_{\mathbf T}\sum_{ij}t_{ij}\,c_{ij}\quad\text{subject to}\quad
    \sum_jt_{ij}=w_i,\quad\sum_it_{ij}=v_j,\quad t_{ij}\ge0,

equation (5) of Das and Bhattacharya, whose columns have equal masses. Rows are sources, columns
are targets.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ..checks import Array, SolverError, array, choice, needed, number, weights

__all__ = ["SOLVERS", "Plan", "distances", "plan", "sorted_plan"]

SOLVERS = ("network", "highs", "clarabel", "linprog", "entropic")
"""POT's network simplex; HiGHS and Clarabel through cvxpy; scipy's HiGHS; POT's Sinkhorn."""

_PIVOTS = 10_000_000
"""More pivots of the network simplex than this mean that it cycles."""
_LOOSE = 1e-5
"""Largest error of the marginals, in units of the total mass, that is rounded away."""


@dataclass(frozen=True, eq=False)
class Plan:
    r"""A coupling, its cost and the dual solution that bounds the cost from below.

    Parameters
    ----------
    matrix : ndarray, (N, M)
        Masses :math:`t_{ij}`; rows and columns sum to the masses that were asked for.
    value : float
        Its cost :math:`\sum_{ij}t_{ij}c_{ij}`.
    potentials : tuple of ndarray, (N,) and (M,)
        Feasible for the dual problem: :math:`f_i+g_j\le c_{ij}` for all pairs.
    bound : float
        The dual value :math:`\sum_if_iw_i+\sum_jg_jv_j`; no coupling costs less.

    Examples
    --------
    >>> swap = plan([[1.0, 0.0], [0.0, 1.0]], [0.5, 0.5])
    >>> swap.matrix
    array([[0. , 0.5],
           [0.5, 0. ]])
    >>> swap.value, swap.gap
    (0.0, 0.0)
    """

    matrix: Array
    value: float
    potentials: tuple[Array, Array]
    bound: float

    @property
    def gap(self) -> float:
        """Cost above the bound: zero, to rounding, for an optimal coupling."""
        return self.value - self.bound


def distances(source: ArrayLike, target: ArrayLike | None = None, *, power: float = 2.0) -> Array:
    r"""Costs :math:`c_{ij}=|\mathbf x_i-\mathbf y_j|^p` of moving mass between two sets of points.

    Parameters
    ----------
    source : array_like, (N, d)
        Where mass is.
    target : array_like, (M, d), optional
        Where it goes; the same points by default.
    power : float
        The power p, positive: 2 makes the plan unique for points in general position, 1 is the
        distance itself.

    Returns
    -------
    ndarray, (N, M)

    Examples
    --------
    >>> distances([[0.0], [3.0]])
    array([[0., 9.],
           [9., 0.]])
    """
    x = array(source, "source", ("N", "d"))
    y = x if target is None else array(target, "target", ("M", x.shape[1]))
    p = number(power, "power", above=0)
    squares = _squares(x, y)
    return squares if p == 2 else np.asarray(squares ** (0.5 * p))


def _squares(x: Array, y: Array) -> Array:
    """Squared distances (N, M), by differences: products would lose what is close."""
    out = np.zeros((x.shape[0], y.shape[0]))
    for k in range(x.shape[1]):
        gap = x[:, k, None] - y[:, k]
        out += gap * gap
    return out


def plan(
    cost: ArrayLike,
    rows: ArrayLike,
    columns: ArrayLike | None = None,
    *,
    solver: str = "network",
    regularisation: float = 0.01,
) -> Plan:
    """The cheapest coupling of two sets of masses.

    Parameters
    ----------
    cost : array_like, (N, M)
        What a unit of mass pays from each row to each column. It is shifted and divided by its
        range before it is solved, since the solvers' tolerances are absolute.
    rows : array_like, (N,)
        Nonnegative masses that sum to one.
    columns : array_like, (M,), optional
        The same; equal masses by default.
    solver : {"network", "highs", "clarabel", "linprog", "entropic"}
        `SOLVERS`. All but the last solve the linear programme.
    regularisation : float
        For ``"entropic"``: the weight of the entropy in units of the cost's range. Its plan is
        spread out and costs more than the optimal one.

    Returns
    -------
    Plan
        The marginals hold to rounding with every solver: what an interior point or an iteration
        leaves of their error, at most 1e-5, is moved along the row and column sums.

    Raises
    ------
    ValueError
        If sizes differ, a mass is negative, a sum is not one or a cost is not finite.
    SolverError
        With the solver's status, if it stops without a solution.

    Notes
    -----
    The rounding of the marginals is that of J. Altschuler, J. Weed, P. Rigollet, Advances in
    Neural Information Processing Systems 30 (2017).

    Examples
    --------
    >>> moved = plan(distances([[0.0], [1.0], [3.0]]), [0.5, 0.5, 0.0])
    >>> (3 * moved.matrix).round(3)
    array([[1. , 0.5, 0. ],
           [0. , 0.5, 1. ],
           [0. , 0. , 0. ]])
    >>> float(round(moved.value, 9)), moved.gap < 1e-12
    (1.5, True)
    """
    c = array(cost, "cost", ("N", "M"))
    if 0 in c.shape:
        raise ValueError(f"cost: needs at least one row and one column, got {c.shape}")
    a = _masses(rows, "rows", c.shape[0])
    b = np.full(c.shape[1], 1 / c.shape[1])
    if columns is not None:
        b = _masses(columns, "columns", c.shape[1])
    solve = _solver(choice(solver, "solver", SOLVERS), regularisation)
    unit, low, scale = _scaled(c)
    matrix, g = solve(unit, a, b)
    return _certified(c, a, b, matrix, low + scale * g)


def _masses(value: ArrayLike, name: str, size: int) -> Array:
    w = weights(value, name, size)
    if w.ndim != 1:
        raise ValueError(f"{name}: needs shape ({size},), got {w.shape}")
    return np.asarray(w / w.sum())


def _scaled(cost: Array) -> tuple[Array, float, float]:
    """The cost between zero and one, its minimum and its range."""
    low = float(cost.min())
    scale = float(cost.max()) - low
    return (cost - low) / (scale if scale > 0 else 1.0), low, scale


def _certified(cost: Array, a: Array, b: Array, matrix: Array, g: Array) -> Plan:
    """The plan with potentials that are feasible whatever the solver says of them."""
    # A solver leaves out columns without mass, and what it says of them is nothing.
    f = (cost - np.where(b > 0, g, -np.inf)).min(axis=1)
    g = (cost - f[:, None]).min(axis=0)
    return Plan(matrix, float((matrix * cost).sum()), (f, g), float(f @ a + g @ b))


Solve = Callable[[Array, Array, Array], tuple[Array, Array]]
"""``solve(cost, rows, columns) -> (matrix, column potential)`` for a cost between zero and one."""


def _solver(name: str, regularisation: float) -> Solve:
    strength = number(regularisation, "regularisation", above=0)
    if name == "network":
        return _network
    if name == "linprog":
        return _linprog
    if name == "entropic":
        return lambda c, a, b: _entropic(c, a, b, strength)
    return lambda c, a, b: _cvxpy(c, a, b, {"highs": "HIGHS", "clarabel": "CLARABEL"}[name])


def _network(cost: Array, a: Array, b: Array) -> tuple[Array, Array]:
    """POT's network simplex; `ot.emd` round it would cost 0.2 ms more, half as much at N = 50."""
    emd = needed("ot.lp.emd_wrap", "maps")
    matrix, _, _, g, status = emd.emd_c(a, b, np.ascontiguousarray(cost), _PIVOTS, 1)
    if status != 1:
        raise SolverError(f"network simplex: stopped with status {status}, {_sizes(cost)}")
    return np.asarray(matrix), np.asarray(g)


def _sizes(cost: Array) -> str:
    return f"{cost.shape[0]} rows and {cost.shape[1]} columns"


def _linprog(cost: Array, a: Array, b: Array) -> tuple[Array, Array]:
    """scipy's dual simplex; masses times N, or small ones are below its absolute tolerances."""
    from scipy.optimize import linprog

    n, m = cost.shape
    size = max(n, m)
    solved = linprog(
        cost.ravel(), A_eq=_equalities(n, m), b_eq=size * np.concatenate([a, b])[:-1],
        method="highs-ds",
    )
    if solved.status != 0:
        raise SolverError(f"linprog: status {solved.status}, {solved.message}")
    g = np.append(solved.eqlin.marginals[n:], 0.0)
    return _rounded(solved.x.reshape(n, m) / size, a, b, "linprog"), g


@lru_cache(maxsize=8)
def _equalities(n: int, m: int) -> Any:
    """Row sums and column sums of a matrix read row by row; the last column's is redundant."""
    from scipy import sparse

    rows = sparse.kron(sparse.eye_array(n), np.ones((1, m)))
    columns = sparse.kron(np.ones((1, n)), sparse.eye_array(m))
    return sparse.vstack([rows, columns]).tocsr()[:-1]


@lru_cache(maxsize=16)
def _problem(n: int, m: int) -> tuple[Any, ...]:
    """The linear programme of one size with cost and masses as parameters: compiled once.

    All entries are one long vector. A matrix of parameters times a matrix of unknowns would make
    cvxpy keep all products of the two, 13 GB at N = 200.
    """
    cp = needed("cvxpy", "maps")
    t = cp.Variable(n * m, nonneg=True)
    cost, masses = cp.Parameter(n * m), cp.Parameter(n + m - 1)
    ends = _equalities(n, m) @ t == masses
    return cp.Problem(cp.Minimize(cost @ t), [ends]), t, cost, masses, ends


def _cvxpy(cost: Array, a: Array, b: Array, solver: str) -> tuple[Array, Array]:
    cp = needed("cvxpy", "maps")
    n, m = cost.shape
    problem, t, c, masses, ends = _problem(n, m)
    size = max(n, m)
    c.value, masses.value = cost.ravel(), size * np.concatenate([a, b])[:-1]
    try:
        problem.solve(solver=solver)
    except cp.error.SolverError as error:
        raise SolverError(f"{solver}: {error}, {_sizes(cost)}") from None
    if problem.status != "optimal" or t.value is None:
        raise SolverError(f"{solver}: status {problem.status}, {_sizes(cost)}")
    matrix = np.asarray(t.value, dtype=np.float64).reshape(n, m) / size
    g = np.append(-np.asarray(ends.dual_value)[n:], 0.0)
    return _rounded(matrix, a, b, solver), g


def _entropic(cost: Array, a: Array, b: Array, strength: float) -> tuple[Array, Array]:
    """Sinkhorn's iteration in logarithms; masses of zero take no part."""
    ot = needed("ot", "maps")
    i, j = np.flatnonzero(a), np.flatnonzero(b)
    matrix, log = ot.sinkhorn(
        a[i], b[j], cost[np.ix_(i, j)], strength, method="sinkhorn_log",
        numItermax=100_000, stopThr=1e-9, log=True, warn=False,
    )
    left = float(log["err"][-1]) if len(log["err"]) else np.inf
    if not left <= 1e-8:
        raise SolverError(f"entropic: marginals off by {left:.3g} after 100000 iterations")
    whole, g = np.zeros(cost.shape), np.zeros(cost.shape[1])
    whole[np.ix_(i, j)] = matrix
    g[j] = strength * log["log_v"]
    return _rounded(whole, a, b, "entropic"), g


def _rounded(matrix: Array, a: Array, b: Array, solver: str) -> Array:
    """The nearest-by matrix with the exact marginals: scale down what is over, spread the rest."""
    t = np.maximum(matrix, 0.0)
    error = max(np.abs(t.sum(axis=1) - a).max(), np.abs(t.sum(axis=0) - b).max())
    if not error <= _LOOSE:
        raise SolverError(f"{solver}: marginals off by {error:.3g}, {_sizes(matrix)}")
    for masses, axis in ((a, 1), (b, 0)):
        total = t.sum(axis=axis)
        share = np.divide(masses, total, out=np.ones_like(total), where=total > masses)
        t *= np.expand_dims(share, axis)
    left, right = np.maximum(a - t.sum(axis=1), 0.0), np.maximum(b - t.sum(axis=0), 0.0)
    missing = left.sum()
    return t if missing <= 0 else t + np.outer(left, right) / max(right.sum(), missing)


def sorted_plan(
    source: ArrayLike,
    target: ArrayLike,
    rows: ArrayLike,
    columns: ArrayLike | None = None,
    *,
    power: float = 2.0,
) -> Plan:
    """The cheapest coupling on a line: smallest with smallest, in sorted order.

    Parameters
    ----------
    source : array_like, (N,)
        Positions of the masses.
    target : array_like, (M,)
        Positions to which they go.
    rows, columns
        As for :func:`plan`.
    power : float
        The cost is the distance to this power, at least 1: below it the order is not the cheapest.

    Returns
    -------
    Plan

    Examples
    --------
    >>> sorted_plan([2.0, 0.0], [1.0, 5.0], [0.75, 0.25]).matrix
    array([[0.25, 0.5 ],
           [0.25, 0.  ]])
    """
    x, y = array(source, "source", ("N",)), array(target, "target", ("M",))
    p = number(power, "power", at_least=1)
    if not x.size or not y.size:
        raise ValueError(f"source, target: needs at least one point each, got {x.size}, {y.size}")
    a = _masses(rows, "rows", x.size)
    b = np.full(y.size, 1 / y.size)
    if columns is not None:
        b = _masses(columns, "columns", y.size)
    i, j = np.argsort(x, kind="stable"), np.argsort(y, kind="stable")
    matrix, g = np.zeros((x.size, y.size)), np.zeros(y.size)
    with np.errstate(over="ignore"):
        cost = np.abs(x[:, None] - y) ** p
    if not np.isfinite(cost).all():
        raise ValueError(f"source, target: needs distances of finite power {p:g}, got infinity")
    rank_i, rank_j, mass = _staircase(a[i], b[j])
    np.add.at(matrix, (i[rank_i], j[rank_j]), mass)
    # Along the staircase f + g = c holds on every cell: a step sideways changes g only.
    path = cost[i[rank_i], j[rank_j]]
    down = cost[i[rank_i[1:]], j[rank_j[:-1]]]
    change = np.where(np.diff(rank_j) > 0, path[1:] - down, 0.0)
    along = np.concatenate([[0.0], np.cumsum(change)])
    g[j[rank_j]] = along
    return _certified(cost, a, b, matrix, g)


def _staircase(a: Array, b: Array) -> tuple[Array, Array, Array]:
    """Cells (row, column) and masses of the coupling in sorted order, at most N + M - 1 of them."""
    ends_a, ends_b = np.cumsum(a), np.cumsum(b)
    ends_a[-1] = ends_b[-1] = 1.0
    inner = np.concatenate([ends_a[:-1], ends_b[:-1]])
    edges = np.concatenate([[0.0], np.sort(np.minimum(inner, 1.0)), [1.0]])
    # A cell's row and column: how many of each kind of edge lie at or before its start.
    order = np.argsort(inner, kind="stable")
    from_rows = order < a.size - 1
    rows = np.concatenate([[0], np.cumsum(from_rows)])
    columns = np.concatenate([[0], np.cumsum(~from_rows)])
    return rows, columns, np.diff(edges)
