"""Couplings whose costs are scaled by what can be moved.

| Report | Situation |
|---|---|
| ott-jax/ott 100 | points without mass spoil the scale of the cost |
| PythonOT/POT 229 | the optimal plan is missed beside entries of 1e32 |
| PythonOT/POT 54 | masses of zero in the entropic problem |
| ott-jax/ott 578 | a constant added to the cost changes its scale |
| ott-jax/ott 165 | couplings that are impossible: infinite costs |
| Thinklab-SJTU/pygmtools 100 | a soft assignment that is not near the assignment |
| own | one far member outweighs the others' distances in the tie-breaker |
| own | forbidden links at 1e6, 1e15 and 1e30 |
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment, linprog

from distfilt.coupling import (
    monotone_plan,
    solvers,
    squared_distances,
    transform_ensemble,
    transport_plan,
    transport_plans,
)
from distfilt.coupling.solvers import Solver
from distfilt.linalg import SolverError

SOLVERS: tuple[Solver, ...] = ("network", "entropic")


@pytest.mark.parametrize("far", [1.0, 100.0, 1e6])
@pytest.mark.parametrize("solver", SOLVERS)
def test_points_without_mass_do_not_matter(solver: Solver, far: float) -> None:
    """As rows and as columns, wherever they are."""
    rng = np.random.default_rng(0)
    x = rng.normal(size=(20, 2))
    y = rng.normal(size=(15, 2)) + 0.5
    a = rng.dirichlet(np.ones(20))
    b = rng.dirichlet(np.ones(15))
    expected = transport_plan(squared_distances(x, y), a, b, solver=solver)
    padded = np.concatenate([x, np.full((3, 2), far)])
    masses = np.concatenate([a, np.zeros(3)])
    cost = squared_distances(padded, y)
    # Three points more, which send nothing
    by_rows = transport_plan(cost, masses, b, solver=solver)
    assert np.abs(by_rows.matrix[:20] - expected.matrix).max() < 1e-9
    assert not by_rows.matrix[20:].any()
    assert abs(by_rows.value - expected.value) < 1e-9
    by_columns = transport_plan(cost.T, b, masses, solver=solver)
    assert abs(by_columns.value - expected.value) < 1e-9
    # The potentials are feasible for the points without mass too.
    f, g = by_rows.potentials
    assert (f[:, None] + g <= cost + 1e-9 * far**2).all()


@pytest.mark.parametrize("forbidden", [1e6, 1e9, 1e12, 1e15, 1e30])
@pytest.mark.parametrize("seed", range(4))
def test_forbidden_links_do_not_spoil_the_others(seed: int, forbidden: float) -> None:
    """The assignment of the remaining links, by another algorithm with a moderate cost."""
    rng = np.random.default_rng(seed)
    x = rng.normal(size=(12, 2))
    y = x + 0.2 * rng.normal(size=(12, 2))
    cost = squared_distances(x, y)
    is_diagonal = np.eye(12, dtype=bool)
    is_forbidden = (rng.random((12, 12)) < 0.4) & ~is_diagonal
    # With equal masses an optimal plan is an assignment; 1e4 is dear enough to avoid a link.
    i, j = linear_sum_assignment(np.where(is_forbidden, 1e4, cost))
    expected = cost[i, j].mean()
    cost[is_forbidden] = forbidden
    plan = transport_plan(cost, np.full(12, 1 / 12))
    assert plan.value == pytest.approx(expected, rel=1e-9)
    assert plan.duality_gap < 1e-8 * expected
    assert not plan.matrix[is_forbidden].any()
    # The entropic plan is that of links which are just dear enough to be left out.
    entropic = transport_plan(cost, np.full(12, 1 / 12), solver="entropic")
    assert not entropic.matrix[is_forbidden].any()
    assert np.abs(entropic.matrix.sum(axis=0) - 1 / 12).max() < 1e-14
    # It costs at most ε (max c - min c) log(n m) more, with ε of 0.01.
    range_of_costs = np.ptp(cost[~is_forbidden])
    largest_excess = 0.01 * range_of_costs * np.log(144)
    assert expected < entropic.value < expected + largest_excess


def test_a_published_cost_matrix_with_huge_entries() -> None:
    """The better plan of the report costs 57.5 where the solver alone finds 88.5."""
    cost = np.array(
        [
            [2.50275352e02, 3.74653218e02, 2.41352736e03, 1e32, 1.51751540e-03],
            [2.13082030e02, 3.28812836e02, 2.29487946e03, 1e32, 1.37109800e-01],
            [1.97333083e02, 3.09175848e02, 2.24250550e03, 1e32, 2.46506283e00],
            [1e32, 1e32, 1e32, 5.26223432e00, 2.5e31],
            [3.84690152e01, 8.09465684e01, 3.33064175e02, 2.5e31, 0.0],
        ]
    )
    masses = np.array([0.125, 0.125, 0.125, 0.125, 0.5])
    plan = transport_plan(cost, masses, masses)
    # Rows 0 to 2 send all to column 4, and row 4 sends to columns 0 to 2, 0.125 on each link.
    rows = [0, 1, 2, 3, 4, 4, 4]
    columns = [4, 4, 4, 3, 0, 1, 2]
    expected = 0.125 * cost[rows, columns].sum()
    assert plan.value == pytest.approx(expected, rel=1e-9)


def test_links_that_are_needed_are_used() -> None:
    """A row with forbidden links only still sends its mass, by the cheapest."""
    cost = np.array([[0.0, 1.0, 2.0], [1.0, 0.0, 1.0], [3e9, 2e9, 4e9]])
    masses = np.array([0.5, 0.25, 0.25])
    for solver in SOLVERS:
        plan = transport_plan(cost, masses, masses, solver=solver)
        assert np.abs(plan.matrix.sum(axis=1) - masses).max() < 1e-14
    plan = transport_plan(cost, masses, masses)
    # The third row's cheapest link, at 2e9, takes all its mass.
    assert plan.matrix[2, 1] == pytest.approx(0.25)


def test_the_gap_of_a_plan_that_is_not_optimal_is_an_error(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A solver that returns another plan without a word."""

    def solve_badly(cost: np.ndarray, a: np.ndarray, b: np.ndarray) -> solvers.Solution:
        return solvers.Solution(np.outer(a, b), np.zeros(b.size))

    # The product of the masses is a plan, with potentials of zero.
    monkeypatch.setattr(solvers, "_solve_network", solve_badly)
    x = np.random.default_rng(0).normal(size=(6, 2))
    with pytest.raises(SolverError, match="is not optimal"):
        transport_plan(squared_distances(x), np.full(6, 1 / 6))


def test_a_constant_cost_is_no_error() -> None:
    """Whatever its size, and points that all coincide."""
    for cost in (np.zeros((4, 4)), np.full((4, 4), 1e12), np.full((4, 4), 1e-12)):
        plan = transport_plan(cost, [0.1, 0.2, 0.3, 0.4])
        # A total mass of one, at the one cost that there is
        assert plan.value == pytest.approx(float(cost[0, 0]))


def transform_on_a_line(x: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return N T' x by the monotone plan, which needs no scale."""
    matrix = monotone_plan(x, x, weights).matrix
    return np.asarray(x.size * matrix.T @ x)


@pytest.mark.parametrize("weight", [0.0, 1e-200, 1e-17, 1e-3, 1 / 30])
@pytest.mark.parametrize("far", [1e4, 1e6])
def test_a_far_member_does_not_outweigh_the_others(far: float, weight: float) -> None:
    """The near members are those of the monotone plan, and the mean is exact."""
    rng = np.random.default_rng(3)
    x = np.append(rng.normal(size=29), far)
    others = rng.dirichlet(np.ones(29)) * (1 - weight)
    weights = np.append(others, weight)
    with np.errstate(divide="ignore"):
        logs = np.log(weights)
    after = transform_ensemble(x[:, None], logs)[:, 0]
    assert after.mean() == pytest.approx(weights @ x, rel=1e-9, abs=1e-9)
    expected = transform_on_a_line(x, weights)
    # But for the tie-breaker, in units of the distance to the far member
    assert np.abs(after - expected)[:29].max() < 1e-7 * far


@pytest.mark.parametrize("far", [1.0, 30.0, 1e2, 1e3])
def test_a_member_less_far_costs_what_the_tie_breaker_may(far: float) -> None:
    """The plan costs at most 1e-7 of the range more than the monotone one."""
    rng = np.random.default_rng(3)
    x = np.append(rng.normal(size=29), far)
    weights = rng.dirichlet(np.ones(30))
    cost = squared_distances(x[:, None])
    plan = transport_plans(x[:, None], np.log(weights))
    optimal = monotone_plan(x, x, weights).value
    excess = (plan * cost).sum() - optimal
    assert -1e-12 * cost.max() < excess < 1e-7 * cost.max()
    # Up to here this is less than a tenth of the lower quartile of the distances squared.
    is_apart = cost > 0
    typical = np.quantile(cost[is_apart], 0.25)
    assert excess < 0.1 * typical


def test_an_ensemble_without_far_members_is_solved_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The plan is that of one solution with the tie-breaker, to the bit."""
    solutions = []

    def record(
        cost: np.ndarray, a: np.ndarray, b: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        solutions.append(solve(cost, a, b))
        return solutions[-1]

    solve = solvers._solve_network
    monkeypatch.setattr(solvers, "_solve_network", record)
    # A quarter of the squared distances is below a thousandth of the range.
    rng = np.random.default_rng(5)
    cluster = 0.02 * rng.normal(size=(30, 2))
    x = np.concatenate([cluster, rng.normal(size=(10, 2))])
    plan = transport_plans(x, -0.5 * x[:, 0] ** 2)
    assert len(solutions) == 1
    assert (plan == solutions[0][0]).all()


def test_two_far_clusters_are_transformed_alike() -> None:
    """Each by the linear programme of its own, in two dimensions."""
    rng = np.random.default_rng(4)
    cluster = rng.normal(size=(8, 2))
    masses = rng.dirichlet(np.ones(8))
    x = np.concatenate([cluster, cluster + [2e5, 0.0]])
    weights = np.concatenate([masses, masses]) / 2
    after = transform_ensemble(x, np.log(weights))
    # Σ_j t_ij = a_i and Σ_i t_ij = 1/8 for the plan of one cluster, as rows of a matrix
    cost = squared_distances(cluster)
    rows = np.kron(np.eye(8), np.ones(8))
    columns = np.kron(np.ones(8), np.eye(8))
    sums = np.concatenate([masses, np.full(8, 1 / 8)])
    constraints = np.vstack([rows, columns])
    plan = linprog(cost.ravel(), A_eq=constraints, b_eq=sums).x
    expected = 8 * plan.reshape(8, 8).T @ cluster
    assert np.abs(after[:8] - expected).max() < 1e-6
    error = after[8:] - [2e5, 0.0] - expected
    assert np.abs(error).max() < 1e-6


@pytest.mark.parametrize("solver", SOLVERS)
def test_impossible_couplings_are_told_by_a_large_finite_cost(solver: Solver) -> None:
    """ott-jax/ott 165: infinity is refused by name; 1e12 is the linear program without the link."""
    rng = np.random.default_rng(4)
    cost = rng.random((6, 5))
    rows = np.full(6, 1 / 6)
    columns = np.full(5, 1 / 5)
    is_forbidden = np.add.outer(np.arange(6), np.arange(5)) % 4 == 1
    infinite = np.where(is_forbidden, np.inf, cost)
    with pytest.raises(
        ValueError, match="cost must have finite numbers, got .* infinite"
    ):
        transport_plan(infinite, rows, columns, solver=solver)
    # The sums of rows and columns are equations, and forbidden links have the bounds 0 and 0.
    row_sums = np.kron(np.eye(6), np.ones(5))
    column_sums = np.kron(np.ones(6), np.eye(5))
    sums = np.vstack([row_sums, column_sums])
    masses = np.concatenate([rows, columns])
    bounds = [(0, 0) if one else (0, None) for one in is_forbidden.ravel()]
    exact = linprog(cost.ravel(), A_eq=sums, b_eq=masses, bounds=bounds)
    assert exact.status == 0
    large = np.where(is_forbidden, 1e12, cost)
    plan = transport_plan(large, rows, columns, solver=solver, regularisation=1e-3)
    assert not plan.matrix[is_forbidden].any()
    assert np.abs(plan.matrix.sum(axis=1) - rows).max() < 1e-12
    # The entropy costs at most ε log(n m) of costs between zero and one.
    slack = 1e-9 if solver == "network" else 1e-3 * np.log(30)
    assert exact.fun - 1e-9 < plan.value < exact.fun + slack


def test_a_soft_assignment_tends_to_the_assignment() -> None:
    """pygmtools 100: similarities of rank one are far from an assignment, but for small ε.

    The entropic plan costs at most ε (max c - min c) log(n m) more than the assignment.
    """
    features = np.arange(1.0, 26.0).reshape(5, 5)
    order = [1, 0, 3, 2, 4]
    similarity = features @ features[order].T
    i, j = linear_sum_assignment(-similarity)
    assert j.tolist() == order
    best = -similarity[i, j].mean()
    range_of_costs = np.ptp(similarity)
    excess = []
    for regularisation in (0.1, 0.01, 1e-3, 1e-4):
        plan = transport_plan(
            -similarity,
            np.full(5, 0.2),
            solver="entropic",
            regularisation=regularisation,
        )
        assert np.abs(plan.matrix.sum(axis=0) - 0.2).max() < 1e-12
        excess.append(plan.value - best)
        most = regularisation * range_of_costs * np.log(25)
        assert -1e-9 < excess[-1] < most
    assert excess == sorted(excess, reverse=True)
    assert 5 * plan.matrix[i, j].min() > 0.99
    network = transport_plan(-similarity, np.full(5, 0.2))
    assert np.array_equal(network.matrix.argmax(axis=1), j)
    assert network.value == pytest.approx(best)
