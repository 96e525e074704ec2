"""The solvers of the coupling problem, against each other and against exact solutions."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from distfilt.coupling import (
    TransportPlan,
    monotone_plan,
    solvers,
    squared_distances,
    transport_plan,
)
from distfilt.linalg import SolverError


def _case(seed: int, n: int = 24, m: int = 24, d: int = 3) -> tuple[np.ndarray, ...]:
    """Return a squared cost, and masses of very different sizes with some of zero."""
    rng = np.random.default_rng(seed)
    x = rng.standard_normal((n, d))
    y = rng.standard_normal((m, d)) + 0.3
    rows = rng.random(n) ** 6
    columns = rng.random(m)
    rows[: n // 6] = 0.0
    columns[-1] = 0.0
    cost = squared_distances(x, y)
    return cost, rows / rows.sum(), columns / columns.sum()


def _assert_marginals(plan: TransportPlan, a: np.ndarray, b: np.ndarray) -> None:
    row_error = plan.matrix.sum(axis=1) - a
    column_error = plan.matrix.sum(axis=0) - b
    assert np.abs(row_error).max() <= 1e-14
    assert np.abs(column_error).max() <= 1e-14
    assert plan.matrix.min() >= 0


@given(st.integers(0, 10_000), st.integers(1, 12), st.integers(1, 12))
def test_the_network_simplex_is_certified_by_its_dual(
    seed: int, n: int, m: int
) -> None:
    """Feasible potentials bound the cost from below; without a duality gap both are optimal."""
    rng = np.random.default_rng(seed)
    x = rng.standard_normal((n, 2))
    y = rng.standard_normal((m, 2))
    cost = squared_distances(x, y)
    a = rng.dirichlet(np.full(n, 0.3))
    b = rng.dirichlet(np.ones(m))
    plan = transport_plan(cost, a, b)
    f, g = plan.potentials
    # f_i + g_j <= c_ij
    assert (f[:, None] + g <= cost + 1e-9).all()
    dual_value = f @ a + g @ b
    primal_value = (plan.matrix * cost).sum()
    assert abs(plan.bound - dual_value) < 1e-12
    assert abs(plan.value - primal_value) < 1e-12
    assert -1e-12 < plan.duality_gap < 1e-9
    _assert_marginals(plan, a, b)


@given(st.integers(0, 10_000), st.integers(1, 15), st.integers(1, 15))
def test_the_monotone_plan_is_the_cheapest(seed: int, n: int, m: int) -> None:
    """As cheap as the linear programme's solution, with a vertex's number of cells."""
    rng = np.random.default_rng(seed)
    x = rng.standard_normal(n)
    y = rng.standard_normal(m)
    a = rng.dirichlet(np.full(n, 0.5))
    b = rng.dirichlet(np.ones(m))
    plan = monotone_plan(x, y, a, b)
    cost = squared_distances(x[:, None], y[:, None])
    optimal = transport_plan(cost, a, b)
    assert abs(plan.value - optimal.value) < 1e-11
    assert -1e-12 < plan.duality_gap < 1e-11
    _assert_marginals(plan, a, b)
    # A vertex of the transport polytope has at most n + m - 1 positive entries.
    assert (plan.matrix > 0).sum() <= n + m - 1


def test_the_monotone_plan_with_ties_and_empty_masses() -> None:
    """A sixth of the mass has to move by one; a row without mass is empty."""
    x = [1.0, 1.0, 0.0, 5.0]
    weights = [0.25, 0.25, 0.5, 0.0]
    plan = monotone_plan(x, [1.0, 1.0, 0.0], weights)
    # The mass at zero is 1/2 before and 1/3 after.
    assert abs(plan.value - 1 / 6) < 1e-15
    assert plan.matrix[3].sum() == 0


@pytest.mark.parametrize("scale", [1e-9, 1e-4, 1e6])
def test_scale_and_offset_of_the_cost_do_not_matter(scale: float) -> None:
    """The plan is the same, and the value follows."""
    cost, a, b = _case(4)
    reference = transport_plan(cost, a, b)
    scaled_cost = np.asfortranarray(scale * cost + 7 * scale)
    scaled = transport_plan(scaled_cost, a, b)
    assert np.abs(scaled.matrix - reference.matrix).max() < 1e-9
    # c' = s (c + 7), for a plan of total mass one: value' = s (value + 7).
    unscaled_value = scaled.value / scale - 7
    assert abs(unscaled_value - reference.value) < 1e-9
    # The potential of a column without mass is feasible too.
    assert b.min() == 0
    assert abs(reference.duality_gap) < 1e-12


def test_a_constant_cost_and_single_masses() -> None:
    """Problems with one feasible value or one feasible plan."""
    constant = transport_plan(np.full((3, 4), 2.0), [0.2, 0.3, 0.5])
    assert abs(constant.value - 2) < 1e-14
    for solver in ("network", "entropic"):
        single = transport_plan([[3.0]], [1.0], solver=solver)
        assert abs(single.matrix[0, 0] - 1) < 1e-14
        column = transport_plan([[1.0], [2.0]], [0.25, 0.75], solver=solver)
        assert np.abs(column.matrix.ravel() - [0.25, 0.75]).max() < 1e-14


def test_tiny_masses_do_not_make_a_problem_infeasible() -> None:
    """Weights down to 1e-40, as likelihoods are."""
    rng = np.random.default_rng(5)
    x = rng.standard_normal((60, 2))
    weights = np.exp(-40 * x[:, 0] ** 2)
    weights /= weights.sum()
    plan = transport_plan(squared_distances(x), weights)
    # Default masses of the columns are equal.
    _assert_marginals(plan, weights, np.full(60, 1 / 60))
    assert plan.duality_gap < 1e-6


@pytest.mark.parametrize("forbidden", [1e13, 1e17])
def test_a_dear_link_that_is_needed_is_used_beside_forbidden_ones(
    forbidden: float,
) -> None:
    """A mass of 1e-9 has to travel to 1e4, at a cost of 1e8, and others by about one.

    On a line the monotone plan is optimal; links that it does not use may cost anything.
    """
    rng = np.random.default_rng(0)
    x = rng.standard_normal(30)
    y = rng.standard_normal(30)
    x[0] = 1e4
    a = np.full(30, (1 - 1e-9) / 29)
    a[0] = 1e-9
    exact = monotone_plan(x, y, a)
    cost = squared_distances(x[:, None], y[:, None])
    is_unused = exact.matrix == 0
    cost[is_unused & (rng.random(cost.shape) < 0.1)] = forbidden
    plan = transport_plan(cost, a)
    # The gap that is documented, relative to the cost
    assert abs(plan.value - exact.value) < 1e-6 * exact.value


@pytest.mark.parametrize(
    ("limit", "value", "solver", "message"),
    [
        ("_PIVOTS", 1, "network", "status 3"),
        ("_NEWTON", 2, "entropic", "regularisation 0.001 needs to be larger"),
    ],
)
def test_a_solver_that_stops_early_raises_an_error(
    limit: str, value: int, solver: str, message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With its status, or with the option to change."""
    monkeypatch.setattr(solvers, limit, value)
    with pytest.raises(SolverError, match=message):
        transport_plan(*_case(8), solver=solver, regularisation=1e-3)


def test_the_entropic_solver_uses_the_gradient_near_the_optimum(
    monkeypatch: Any,
) -> None:
    """If only decreases of the dual were accepted, rounding would stop the iteration."""
    solve = np.linalg.solve
    systems = []

    def count(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        systems.append(a)
        return solve(a, b)

    monkeypatch.setattr(np.linalg, "solve", count)
    transport_plan(*_case(8, 15, 3, 2), solver="entropic", regularisation=1e-7)
    assert len(systems) < 100


@given(st.integers(0, 10_000), st.sampled_from([1e-2, 1e-3, 1e-4]))
def test_the_entropic_plan_satisfies_its_optimality_conditions(
    seed: int, eps: float
) -> None:
    """log t_ij + c_ij / eps = f_i + g_j, also where Sinkhorn would need 100 000 iterations."""
    n = 6
    m = 7
    cost, a, b = _case(seed, n, m, 2)
    plan = transport_plan(cost, a, b, solver="entropic", regularisation=eps)
    _assert_marginals(plan, a, b)
    # The entropy of a plan is at most that of the uniform one, log(n m).
    # The range is that of the links between rows and columns with mass.
    weight = eps * np.ptp(cost[np.ix_(a > 0, b > 0)])
    excess = plan.value - transport_plan(cost, a, b).value
    assert -1e-9 < excess < weight * np.log(n * m)
    # On all but negligible entries the logarithm is a sum of potentials.
    i, j = (plan.matrix > 1e-6).nonzero()
    scaled_costs = cost[i, j] / weight
    logs = np.log(plan.matrix[i, j]) + scaled_costs
    design = np.zeros((i.size, n + m))
    entries = np.arange(i.size)
    design[entries, i] = 1.0
    design[entries, n + j] = 1.0
    potentials = np.linalg.lstsq(design, logs)[0]
    residual = logs - design @ potentials
    assert np.abs(residual).max() < 1e-3
