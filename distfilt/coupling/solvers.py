r"""Optimal couplings of two discrete distributions: one problem, several solvers, one certificate.

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
from typing import Annotated, Literal

import numpy as np

from ..linalg import SolverError
from ..validation import (
    Array,
    Bounds,
    FrozenModel,
    PositiveFloat,
    Probabilities,
    import_optional,
    validated,
)

__all__ = ["TransportPlan", "squared_distances", "transport_plan", "sorted_plan"]

Solver = Literal["network", "entropic"]
"""POT's network simplex; Newton's method on the entropic problem."""

SQUARED = Bounds(at_least=-1e150, at_most=1e150)
"""The range of numbers whose squares are finite."""
_PIVOTS = 10_000_000
"""More pivots of the network simplex than this mean that it cycles."""
_NEWTON = 1000
"""Steps of Newton's method; twenty are enough as a rule."""


@dataclass(frozen=True, eq=False)
class TransportPlan(FrozenModel):
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
    >>> swap = transport_plan([[1.0, 0.0], [0.0, 1.0]], [0.5, 0.5])
    >>> swap.matrix
    array([[0. , 0.5],
           [0.5, 0. ]])
    >>> swap.value, swap.gap
    (0.0, 0.0)
    """

    matrix: Annotated[Array, "n m"]
    value: float
    potentials: tuple[Array, Array]
    bound: float

    @property
    def gap(self) -> float:
        """Cost above the bound: zero, to rounding, for an optimal coupling."""
        return self.value - self.bound


@validated
def squared_distances(
    source: Annotated[Array, "n d"], target: Annotated[Array, "m d"] | None = None
) -> Array:
    r"""Costs :math:`c_{ij}=|\mathbf x_i-\mathbf y_j|^2` of moving mass between two sets of points.

    Parameters
    ----------
    source : array_like, (N, d)
        Where mass is.
    target : array_like, (M, d), optional
        Where it goes; the same points by default.

    Returns
    -------
    ndarray, (N, M)

    Examples
    --------
    >>> squared_distances([[0.0], [3.0]])
    array([[0., 9.],
           [9., 0.]])
    """
    y = source if target is None else target
    squares = np.zeros((len(source), len(y)))
    # By differences: products would lose what is close.
    for k in range(source.shape[1]):
        gap = source[:, k, None] - y[:, k]
        squares += gap * gap
    return squares


@validated
def transport_plan(
    cost: Annotated[Array, "n m"],
    rows: Annotated[Probabilities, "n"],
    columns: Annotated[Probabilities, "m"] | None = None,
    *,
    solver: Solver = "network",
    regularisation: PositiveFloat = 0.01,
) -> TransportPlan:
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
    solver : {"network", "entropic"}
        POT's network simplex, which needs the extra ``maps``, solves the linear programme. The
        other adds the plan's entropy to the cost.
    regularisation : float
        For ``"entropic"``: the weight of the entropy in units of the cost's range. Its plan is
        spread out and costs more than the optimal one.

    Returns
    -------
    Plan
        The marginals hold to rounding with every solver: what an iteration leaves of their
        error, at most 1e-8, is moved along the row and column sums.

    Raises
    ------
    ValueError
        If sizes differ, a mass is negative, a sum is not one or a cost is not finite.
    SolverError
        With the solver's status, if it stops without a solution.
    ModuleNotFoundError
        If the solver's package is not installed; the message names the extra that brings it.

    Notes
    -----
    The rounding of the marginals is that of J. Altschuler, J. Weed, P. Rigollet, Advances in
    Neural Information Processing Systems 30 (2017).

    Examples
    --------
    >>> moved = transport_plan(
    ...     squared_distances([[0.0], [1.0], [3.0]]), [0.5, 0.5, 0.0]
    ... )
    >>> (3 * moved.matrix).round(3)
    array([[1. , 0.5, 0. ],
           [0. , 0.5, 1. ],
           [0. , 0. , 0. ]])
    >>> float(round(moved.value, 9)), moved.gap < 1e-12
    (1.5, True)
    """
    a, b = _masses(rows, columns, cost.shape[1])
    unit, low, scale = scale_cost(cost)
    matrix, g = solver_of(solver, regularisation)(unit, a, b)
    return _certified(cost, a, b, matrix, low + scale * g)


def _masses(rows: Array, columns: Array | None, size: int) -> tuple[Array, Array]:
    """Masses that sum to one, equal ones by default."""
    b = np.full(size, 1 / size) if columns is None else columns / columns.sum()
    return rows / rows.sum(), b


def scale_cost(cost: Array) -> tuple[Array, float, float]:
    """The cost between zero and one, its minimum and its range."""
    low = float(cost.min())
    scale = float(cost.max()) - low
    return (cost - low) / (scale if scale > 0 else 1.0), low, scale


def _certified(
    cost: Array, a: Array, b: Array, matrix: Array, g: Array
) -> TransportPlan:
    """The plan with potentials that are feasible whatever the solver says of them."""
    # A solver leaves out columns without mass, and what it says of them is nothing.
    f = (cost - np.where(b > 0, g, -np.inf)).min(axis=1)
    g = (cost - f[:, None]).min(axis=0)
    return TransportPlan.construct(
        matrix, float((matrix * cost).sum()), (f, g), float(f @ a + g @ b)
    )


Solve = Callable[[Array, Array, Array], tuple[Array, Array]]
"""``solve(cost, rows, columns) -> (matrix, column potential)`` for a cost between zero and one."""


def solver_of(name: Solver, regularisation: float = 0.01) -> Solve:
    """The solver of that name, for a cost between zero and one."""
    if name == "entropic":
        return partial(_entropic, strength=regularisation)
    return _network


def _network(cost: Array, a: Array, b: Array) -> tuple[Array, Array]:
    """POT's network simplex; `ot.emd` round it would cost 0.2 ms more, half as much at N = 50."""
    emd = import_optional("ot.lp.emd_wrap", "maps")
    matrix, _, _, g, status = emd.emd_c(a, b, np.ascontiguousarray(cost), _PIVOTS, 1)
    if status != 1:
        raise SolverError(f"network simplex: stopped with status {status}")
    return np.asarray(matrix), np.asarray(g)


def _entropic(cost: Array, a: Array, b: Array, strength: float) -> tuple[Array, Array]:
    """Newton's method under an entropy that is halved down to `strength`.

    Sinkhorn's iteration creeps along plateaus where the entropy is small. Masses of zero take no
    part.
    """
    i = np.flatnonzero(a)
    j = np.flatnonzero(b)
    part = cost[np.ix_(i, j)]
    g = np.zeros(len(j))
    for k in range(max(0, math.ceil(math.log2(0.1 / strength))), -1, -1):
        eps = strength * 2.0**k
        matrix, g, off = _newton(part / eps, a[i], b[j], g / eps, 1e-3 if k else 1e-10)
        g = eps * g
    if not off < 1e-8:
        raise SolverError(
            f"entropic: marginals off by {off:.3g} after {_NEWTON} Newton steps: "
            f"regularisation {strength:g} needs to be larger, or another solver"
        )
    whole = np.zeros(cost.shape)
    potential = np.zeros(cost.shape[1])
    whole[np.ix_(i, j)] = matrix
    potential[j] = g
    return _rounded(whole, a, b), potential


def _newton(
    cost: Array, rows: Array, columns: Array, g: Array, close: float
) -> tuple[Array, Array, float]:
    """Plan of unit entropy, column potentials, and the error of its column sums.

    The step is damped as by Levenberg and Marquardt.
    """

    from scipy.special import logsumexp

    def at(g: Array) -> tuple[Array, float]:
        """The plan with these potentials, whose row sums are right, and the dual to be least."""
        exponents = g - cost
        total = logsumexp(exponents, axis=1)
        return rows[:, None] * np.exp(exponents - total[:, None]), float(
            rows @ total - columns @ g
        )

    damping = 1e-2
    (matrix, value) = at(g)
    for _ in range(_NEWTON):
        sums = matrix.sum(axis=0)
        off = float(np.abs(sums - columns).sum())
        if off < close or damping > 1e9:
            break
        slope = np.diag(sums + damping * columns) - matrix.T @ (matrix / rows[:, None])
        trial = g - np.linalg.solve(slope, sums - columns)
        moved, after = at(trial)
        # Near the solution the dual falls by less than rounding; its gradient still shrinks.
        flat = abs(after - value) < 1e-9 * abs(value)
        if after < value or (
            flat and np.abs(moved.sum(axis=0) - columns).sum() < 0.5 * off
        ):
            g = trial - trial.mean()
            matrix = moved
            value = after
            damping = max(damping / 10, 1e-14)
        else:
            damping *= 10
    return matrix, g, off


def _rounded(t: Array, a: Array, b: Array) -> Array:
    """Exact marginals for a matrix, in place: scale down what is over, spread the rest."""
    for masses, axis in ((a, 1), (b, 0)):
        total = t.sum(axis=axis)
        share = np.divide(masses, total, out=np.ones_like(total), where=total > masses)
        t *= np.expand_dims(share, axis)
    left = np.maximum(a - t.sum(axis=1), 0.0)
    right = np.maximum(b - t.sum(axis=0), 0.0)
    most = max(right.sum(), left.sum(), np.finfo(float).tiny)
    return np.asarray(t + np.outer(left, right) / most)


@validated
def sorted_plan(
    source: Annotated[Array, "n", SQUARED],
    target: Annotated[Array, "m", SQUARED],
    rows: Annotated[Probabilities, "n"],
    columns: Annotated[Probabilities, "m"] | None = None,
) -> TransportPlan:
    """The cheapest coupling on a line, for squared distances: smallest with smallest, in order.

    Parameters
    ----------
    source : array_like, (N,)
        Positions of the masses.
    target : array_like, (M,)
        Positions to which they go.
    rows, columns
        As for :func:`plan`.

    Returns
    -------
    Plan

    Examples
    --------
    >>> sorted_plan([2.0, 0.0], [1.0, 5.0], [0.75, 0.25]).matrix
    array([[0.25, 0.5 ],
           [0.25, 0.  ]])
    """
    x = source
    y = target
    a, b = _masses(rows, columns, y.size)
    i = np.argsort(x, kind="stable")
    j = np.argsort(y, kind="stable")
    matrix = np.zeros((x.size, y.size))
    g = np.zeros(y.size)
    cost = (x[:, None] - y) ** 2
    rank_i, rank_j, mass = _staircase(a[i], b[j])
    np.add.at(matrix, (i[rank_i], j[rank_j]), mass)
    # Along the staircase f + g = c holds on every cell: a step sideways changes g only.
    path = cost[i[rank_i], j[rank_j]]
    down = cost[i[rank_i[1:]], j[rank_j[:-1]]]
    change = np.where(np.diff(rank_j) > 0, path[1:] - down, 0.0)
    g[j[rank_j]] = np.concatenate([[0.0], np.cumsum(change)])
    return _certified(cost, a, b, matrix, g)


def _staircase(a: Array, b: Array) -> tuple[Array, Array, Array]:
    """Cells (row, column) and masses of the coupling in sorted order, at most N + M - 1 of them."""
    inner = np.concatenate([np.cumsum(a)[:-1], np.cumsum(b)[:-1]])
    edges = np.concatenate([[0.0], np.sort(np.minimum(inner, 1.0)), [1.0]])
    # A cell's row and column: how many of each kind of edge lie at or before its start.
    order = np.argsort(inner, kind="stable")
    from_rows = order < a.size - 1
    rows = np.concatenate([[0], np.cumsum(from_rows)])
    columns = np.concatenate([[0], np.cumsum(~from_rows)])
    return rows, columns, np.diff(edges)
