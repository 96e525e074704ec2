"""Couplings: marginals, optimality by duality and by agreement of solvers, failures that speak."""

from __future__ import annotations

import tracemalloc
from collections.abc import Callable
from itertools import permutations

import numpy as np
import ot  # here, since its import takes seconds and an example should not
import pytest
from hypothesis import given
from hypothesis import strategies as st

from distfilt.checks import SolverError
from distfilt.coupling import SOLVERS, Plan, distances, plan, solvers, sorted_plan

NAN = float("nan")
EXACT = ("network", "highs", "clarabel", "linprog")
_S = "distfilt.coupling.solvers."
_SQUARE = [[0.0, 1.0], [1.0, 0.0]]

BAD_INPUT: dict[str, list[tuple[str, Callable[[], object]]]] = {
    _S + "distances": [
        ("source", lambda: distances([1.0, 2.0])),
        ("source", lambda: distances([[NAN]])),
        ("target", lambda: distances([[1.0]], [[1.0, 2.0]])),
        ("power", lambda: distances([[1.0]], power=0.0)),
    ],
    _S + "plan": [
        ("cost", lambda: plan([[0.0, NAN]], [1.0])),
        ("cost", lambda: plan(np.zeros((0, 2)), [])),
        ("cost", lambda: plan(np.zeros((2, 0)), [0.5, 0.5])),
        ("rows", lambda: plan(_SQUARE, [0.5, 0.6])),
        ("rows", lambda: plan(_SQUARE, [0.0, 0.0])),
        ("rows", lambda: plan(_SQUARE, [1.5, -0.5])),
        ("rows", lambda: plan(_SQUARE, [0.5, NAN])),
        ("rows", lambda: plan(_SQUARE, [1.0])),
        ("columns", lambda: plan(_SQUARE, [0.5, 0.5], [0.2, 0.2])),
        ("columns", lambda: plan(_SQUARE, [0.5, 0.5], [[0.5, 0.5]])),
        ("solver", lambda: plan(_SQUARE, [0.5, 0.5], solver="simplex")),
        ("regularisation", lambda: plan(
            _SQUARE, [0.5, 0.5], solver="entropic", regularisation=0.0)),
        ("regularisation", lambda: plan(_SQUARE, [0.5, 0.5], regularisation=None)),
    ],
    _S + "sorted_plan": [
        ("source", lambda: sorted_plan([[1.0]], [1.0], [1.0])),
        ("source", lambda: sorted_plan([], [1.0], [])),
        ("target", lambda: sorted_plan([1.0], [NAN], [1.0])),
        ("rows", lambda: sorted_plan([1.0], [1.0], [2.0])),
        ("columns", lambda: sorted_plan([1.0], [1.0], [1.0], [0.5])),
        ("power", lambda: sorted_plan([1.0], [1.0], [1.0], power=0.5)),
    ],
}
EXEMPT = {
    _S + "SOLVERS": "a tuple of names",
    _S + "Plan": "holds what `plan` computed",
}


def _case(seed: int, n: int = 24, m: int = 24, d: int = 3) -> tuple[np.ndarray, ...]:
    """Points, a squared cost, masses of very different size with some of zero."""
    rng = np.random.default_rng(seed)
    x, y = rng.standard_normal((n, d)), rng.standard_normal((m, d)) + 0.3
    a, b = rng.random(n) ** 6, rng.random(m)
    a[: n // 6], b[-1] = 0.0, 0.0
    return distances(x, y), a / a.sum(), b / b.sum()


@pytest.mark.parametrize("solver", SOLVERS)
def test_marginals_to_rounding(solver: str) -> None:
    cost, a, b = _case(1, 20, 27)
    matrix = plan(cost, a, b, solver=solver, regularisation=0.05).matrix
    assert matrix.min() >= 0
    assert np.abs(matrix.sum(axis=1) - a).max() <= 1e-14
    assert np.abs(matrix.sum(axis=0) - b).max() <= 1e-14


@given(st.integers(0, 10_000), st.integers(1, 12), st.integers(1, 12))
def test_the_network_simplex_is_certified_by_its_dual(seed: int, n: int, m: int) -> None:
    rng = np.random.default_rng(seed)
    cost = distances(rng.standard_normal((n, 2)), rng.standard_normal((m, 2)))
    a, b = rng.dirichlet(np.full(n, 0.3)), rng.dirichlet(np.ones(m))
    found = plan(cost, a, b)
    f, g = found.potentials
    assert (f[:, None] + g <= cost + 1e-9).all()
    assert abs(found.bound - (f @ a + g @ b)) < 1e-12
    assert abs(found.value - (found.matrix * cost).sum()) < 1e-12
    assert -1e-12 < found.gap < 1e-9
    assert np.abs(found.matrix.sum(axis=1) - a).max() <= 1e-14
    assert np.abs(found.matrix.sum(axis=0) - b).max() <= 1e-14


@pytest.mark.parametrize("solver", EXACT)
@pytest.mark.parametrize("power", [1.0, 2.0])
def test_solvers_agree_on_the_value(solver: str, power: float) -> None:
    rng = np.random.default_rng(2)
    x = rng.standard_normal((30, 3))
    cost = distances(x, power=power)
    w = rng.dirichlet(np.full(30, 0.3))
    best = plan(cost, w)
    other = plan(cost, w, solver=solver)
    bound = 1e-6 if solver == "clarabel" else 1e-12
    assert abs(other.value - best.value) < bound * max(1.0, best.value)
    assert other.gap < bound * max(1.0, best.value)
    if power == 2.0:  # unique for points in general position
        assert np.abs(other.matrix - best.matrix).max() < (1e-4 if solver == "clarabel" else 1e-9)


def test_equal_masses_give_the_best_permutation() -> None:
    """The plan of equal masses is a permutation; of 5! = 120 it is the cheapest."""
    rng = np.random.default_rng(3)
    cost = distances(rng.standard_normal((5, 2)), rng.standard_normal((5, 2)))
    found = plan(cost, np.full(5, 0.2))
    costs = {p: cost[np.arange(5), p].mean() for p in permutations(range(5))}
    best = min(costs, key=costs.__getitem__)
    assert np.allclose(found.matrix[np.arange(5), best], 0.2)
    assert abs(found.value - costs[best]) < 1e-12


@given(st.integers(0, 10_000), st.integers(1, 15), st.integers(1, 15), st.sampled_from([1.0, 2.0]))
def test_the_sorted_plan_is_the_cheapest(seed: int, n: int, m: int, power: float) -> None:
    rng = np.random.default_rng(seed)
    x, y = rng.standard_normal(n), rng.standard_normal(m)
    a, b = rng.dirichlet(np.full(n, 0.5)), rng.dirichlet(np.ones(m))
    found = sorted_plan(x, y, a, b, power=power)
    best = plan(distances(x[:, None], y[:, None], power=power), a, b)
    assert abs(found.value - best.value) < 1e-11
    assert -1e-12 < found.gap < 1e-11
    assert np.abs(found.matrix.sum(axis=1) - a).max() <= 1e-14
    assert np.abs(found.matrix.sum(axis=0) - b).max() <= 1e-14
    assert (found.matrix > 0).sum() <= n + m - 1


def test_the_sorted_plan_with_ties_and_empty_masses() -> None:
    found = sorted_plan([1.0, 1.0, 0.0, 5.0], [1.0, 1.0, 0.0], [0.25, 0.25, 0.5, 0.0])
    assert abs(found.value - 1 / 6) < 1e-15  # a sixth of the mass has to move by one
    assert found.matrix[3].sum() == 0


@pytest.mark.parametrize("scale", [1e-9, 1e-4, 1e6])
def test_neither_scale_nor_offset_of_the_cost_matters(scale: float) -> None:
    cost, a, b = _case(4)
    reference = plan(cost, a, b)
    for solver in ("network", "highs", "linprog"):
        other = plan(scale * cost + 7 * scale, a, b, solver=solver)
        assert np.abs(other.matrix - reference.matrix).max() < 1e-9
        assert abs(other.value / scale - 7 - reference.value) < 1e-9


def test_a_constant_cost_and_single_masses() -> None:
    flat = plan(np.full((3, 4), 2.0), [0.2, 0.3, 0.5])
    assert abs(flat.value - 2) < 1e-14
    assert flat.gap < 1e-12
    assert np.abs(flat.matrix.sum(axis=1) - [0.2, 0.3, 0.5]).max() <= 1e-14
    for solver in SOLVERS:
        one = plan([[3.0]], [1.0], solver=solver)
        assert abs(one.matrix[0, 0] - 1) < 1e-14
        column = plan([[1.0], [2.0]], [0.25, 0.75], solver=solver)
        assert np.abs(column.matrix.ravel() - [0.25, 0.75]).max() < 1e-14


@pytest.mark.parametrize("solver", EXACT)
def test_tiny_masses_do_not_make_a_problem_infeasible(solver: str) -> None:
    """Weights down to 1e-40, as likelihoods are."""
    rng = np.random.default_rng(5)
    x = rng.standard_normal((60, 2))
    w = np.exp(-40 * x[:, 0] ** 2)
    w /= w.sum()
    found = plan(distances(x), w, solver=solver)
    assert np.abs(found.matrix.sum(axis=1) - w).max() <= 1e-14
    assert found.gap < 1e-6


def test_entropy_spreads_the_plan_and_costs_more() -> None:
    cost, a, b = _case(6)
    best = plan(cost, a, b)
    values = [plan(cost, a, b, solver="entropic", regularisation=r).value
              for r in (0.003, 0.01, 0.1)]
    assert best.value < values[0] < values[1] < values[2]
    strong = plan(cost, a, b, solver="entropic", regularisation=1e4)
    assert np.abs(strong.matrix - np.outer(a, b)).max() < 1e-5


def test_powers_of_the_distance() -> None:
    x, y = np.array([[0.0, 0.0], [3.0, 4.0]]), np.array([[0.0, 0.0]])
    assert np.allclose(distances(x, y), [[0.0], [25.0]])
    assert np.allclose(distances(x, y, power=1.0), [[0.0], [5.0]])
    assert np.allclose(distances(x), [[0.0, 25.0], [25.0, 0.0]])


@pytest.mark.parametrize("status", ["infeasible", "unbounded", "user_limit"])
def test_a_status_that_is_not_optimal_raises(
    status: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = solvers._problem(2, 2)

    class Stopped:
        def __init__(self) -> None:
            self.status = status

        def solve(self, **options: object) -> None:
            pass

    monkeypatch.setattr(solvers, "_problem", lambda n, m: (Stopped(), *real[1:]))
    with pytest.raises(SolverError, match=status):
        plan(_SQUARE, [0.5, 0.5], solver="highs")


def test_a_network_simplex_that_stops_early_raises(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(solvers, "_PIVOTS", 1)
    cost, a, b = _case(7)
    with pytest.raises(SolverError, match="status 3"):
        plan(cost, a, b)


def test_marginals_far_off_raise_instead_of_being_rounded_away() -> None:
    with pytest.raises(SolverError, match="marginals off by 0.1"):
        solvers._rounded(np.array([[0.6, 0.0], [0.0, 0.4]]), np.array([0.5, 0.5]),
                         np.array([0.6, 0.4]), "some solver")


def test_sinkhorn_that_does_not_converge_raises(monkeypatch: pytest.MonkeyPatch) -> None:
    import ot

    real = ot.sinkhorn
    monkeypatch.setattr(ot, "sinkhorn", lambda *a, **k: real(*a, **{**k, "numItermax": 20}))
    cost, a, b = _case(8)
    with pytest.raises(SolverError, match="entropic"):
        plan(cost, a, b, solver="entropic", regularisation=1e-3)


def test_a_programme_is_compiled_once_for_each_size() -> None:
    solvers._problem.cache_clear()
    for seed in (1, 2, 3):
        cost, a, b = _case(seed, 6, 7)
        plan(cost, a, b, solver="highs")
        plan(cost, a, b, solver="clarabel")
    assert solvers._problem.cache_info().misses == 1


def test_inputs_stay_as_they_were() -> None:
    cost, a, b = _case(9)
    kept = cost.copy(), a.copy(), b.copy()
    for solver in SOLVERS:
        plan(cost, a, b, solver=solver)
    sorted_plan(cost[0], cost[1], a, b)
    for now, then in zip((cost, a, b), kept, strict=True):
        assert (now == then).all()


def test_a_plan_knows_its_gap() -> None:
    assert Plan(np.eye(1), 3.0, (np.zeros(1), np.zeros(1)), 2.5).gap == 0.5


@pytest.mark.parametrize("solver", ["network", "linprog", "highs"])
def test_a_cost_in_any_order_of_memory(solver: str) -> None:
    cost = np.random.default_rng(4).random((4, 3))
    plain = plan(cost, np.full(4, 0.25), solver=solver)
    for same in (np.asfortranarray(cost), np.repeat(cost, 2, axis=1)[:, ::2], cost.tolist()):
        found = plan(same, np.full(4, 0.25), solver=solver)
        np.testing.assert_allclose(found.matrix, plain.matrix, atol=1e-12)


def test_the_network_simplex_is_pot_s_own() -> None:
    """What `ot.emd` returns, whose layers the library leaves out."""
    x = np.random.default_rng(14).standard_normal((40, 3))
    w = np.exp(-x[:, 0] ** 2)
    w /= w.sum()
    cost = distances(x)
    cost /= cost.max()
    matrix, log = ot.emd(w, np.full(40, 1 / 40), cost, log=True)
    ours = plan(cost, w)
    assert np.abs(ours.matrix - matrix).max() < 1e-15
    assert abs(ours.value - log["cost"]) < 1e-14


def test_the_compiled_programme_keeps_no_products_of_parameters_and_unknowns() -> None:
    """At N = 80 they would be 330 MB, at N = 200 13 GB."""
    tracemalloc.start()
    try:
        solvers._problem.cache_clear()
        x = np.random.default_rng(15).standard_normal((80, 2))
        plan(distances(x), np.full(80, 1 / 80), solver="highs")
        assert tracemalloc.get_traced_memory()[1] < 60e6
    finally:
        tracemalloc.stop()


def test_rounding_drops_what_is_below_zero() -> None:
    half = np.array([0.5, 0.5])
    off = np.array([[0.5 + 1e-9, -1e-9], [-1e-9, 0.5 + 1e-9]])
    found = solvers._rounded(off, half, half, "any")
    assert found.min() == 0 and np.allclose(found, np.diag(half), atol=1e-15)


def test_a_solver_that_raises_is_named_with_the_size(monkeypatch: pytest.MonkeyPatch) -> None:
    import cvxpy as cp

    def fails(*_: object, **__: object) -> None:
        raise cp.error.SolverError("out of luck")

    monkeypatch.setattr(cp.Problem, "solve", fails)
    with pytest.raises(SolverError, match="out of luck"):
        plan(np.ones((2, 2)) - np.eye(2), [0.5, 0.5], solver="clarabel")
