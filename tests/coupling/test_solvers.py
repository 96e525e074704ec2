"""The solvers of the coupling problem, against each other and against what is known exactly."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from distfilt.coupling import solvers, monotone_plan, squared_distances, transport_plan
from distfilt.linalg import SolverError


def _case(seed: int, n: int = 24, m: int = 24, d: int = 3) -> tuple[np.ndarray, ...]:
    """Points, a squared cost, masses of very different size with some of zero."""
    rng = np.random.default_rng(seed)
    x = rng.standard_normal((n, d))
    y = rng.standard_normal((m, d)) + 0.3
    a = rng.random(n) ** 6
    b = rng.random(m)
    a[: n // 6] = 0.0
    b[-1] = 0.0
    return squared_distances(x, y), a / a.sum(), b / b.sum()


@given(st.integers(0, 10_000), st.integers(1, 12), st.integers(1, 12))
def test_the_network_simplex_is_certified_by_its_dual(
    seed: int, n: int, m: int
) -> None:
    rng = np.random.default_rng(seed)
    cost = squared_distances(rng.standard_normal((n, 2)), rng.standard_normal((m, 2)))
    a = rng.dirichlet(np.full(n, 0.3))
    b = rng.dirichlet(np.ones(m))
    found = transport_plan(cost, a, b)
    f, g = found.potentials
    assert (f[:, None] + g <= cost + 1e-9).all()
    assert abs(found.bound - (f @ a + g @ b)) < 1e-12
    assert abs(found.value - (found.matrix * cost).sum()) < 1e-12
    assert -1e-12 < found.duality_gap < 1e-9
    assert np.abs(found.matrix.sum(axis=1) - a).max() <= 1e-14
    assert (
        np.abs(found.matrix.sum(axis=0) - b).max() <= 1e-14 and found.matrix.min() >= 0
    )


@given(st.integers(0, 10_000), st.integers(1, 15), st.integers(1, 15))
def test_the_sorted_plan_is_the_cheapest(seed: int, n: int, m: int) -> None:
    rng = np.random.default_rng(seed)
    x = rng.standard_normal(n)
    y = rng.standard_normal(m)
    a = rng.dirichlet(np.full(n, 0.5))
    b = rng.dirichlet(np.ones(m))
    found = monotone_plan(x, y, a, b)
    best = transport_plan(squared_distances(x[:, None], y[:, None]), a, b)
    assert abs(found.value - best.value) < 1e-11
    assert -1e-12 < found.duality_gap < 1e-11
    assert np.abs(found.matrix.sum(axis=1) - a).max() <= 1e-14
    assert np.abs(found.matrix.sum(axis=0) - b).max() <= 1e-14
    assert (found.matrix > 0).sum() <= n + m - 1


def test_the_sorted_plan_with_ties_and_empty_masses() -> None:
    found = monotone_plan([1.0, 1.0, 0.0, 5.0], [1.0, 1.0, 0.0], [0.25, 0.25, 0.5, 0.0])
    assert abs(found.value - 1 / 6) < 1e-15  # a sixth of the mass has to move by one
    assert found.matrix[3].sum() == 0


@pytest.mark.parametrize("scale", [1e-9, 1e-4, 1e6])
def test_neither_scale_nor_offset_of_the_cost_matters(scale: float) -> None:
    cost, a, b = _case(4)
    reference = transport_plan(cost, a, b)
    other = transport_plan(np.asfortranarray(scale * cost + 7 * scale), a, b)
    assert np.abs(other.matrix - reference.matrix).max() < 1e-9
    assert abs(other.value / scale - 7 - reference.value) < 1e-9
    assert abs(reference.duality_gap) < 1e-12 and b.min() == 0


def test_a_constant_cost_and_single_masses() -> None:
    flat = transport_plan(np.full((3, 4), 2.0), [0.2, 0.3, 0.5])
    assert abs(flat.value - 2) < 1e-14
    for solver in ("network", "entropic"):
        one = transport_plan([[3.0]], [1.0], solver=solver)
        assert abs(one.matrix[0, 0] - 1) < 1e-14
        column = transport_plan([[1.0], [2.0]], [0.25, 0.75], solver=solver)
        assert np.abs(column.matrix.ravel() - [0.25, 0.75]).max() < 1e-14


def test_tiny_masses_do_not_make_a_problem_infeasible() -> None:
    """Weights down to 1e-40, as likelihoods are."""
    rng = np.random.default_rng(5)
    x = rng.standard_normal((60, 2))
    w = np.exp(-40 * x[:, 0] ** 2)
    w /= w.sum()
    found = transport_plan(squared_distances(x), w)
    assert np.abs(found.matrix.sum(axis=1) - w).max() <= 1e-14
    assert found.duality_gap < 1e-6


@pytest.mark.parametrize(
    ("limit", "value", "solver", "message"),
    [
        ("_PIVOTS", 1, "network", "status 3"),
        ("_NEWTON", 2, "entropic", "regularisation 0.001 needs to be larger"),
    ],
)
def test_a_solver_that_stops_early_says_so(
    limit: str, value: int, solver: str, message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(solvers, limit, value)
    with pytest.raises(SolverError, match=message):
        transport_plan(*_case(8), solver=solver, regularisation=1e-3)


def test_where_rounding_hides_the_dual_its_gradient_leads_on(monkeypatch: Any) -> None:
    solve = np.linalg.solve
    steps = []
    monkeypatch.setattr(np.linalg, "solve", lambda a, b: steps.append(a) or solve(a, b))
    transport_plan(*_case(8, 15, 3, 2), solver="entropic", regularisation=1e-7)
    assert len(steps) < 100


@given(st.integers(0, 10_000), st.sampled_from([1e-2, 1e-3, 1e-4]))
def test_the_entropic_plan_is_that_of_its_optimality_conditions(
    seed: int, eps: float
) -> None:
    """Also where Sinkhorn's iteration would take more than 100 000 turns."""
    cost, a, b = _case(seed, 6, 7, 2)
    found = transport_plan(cost, a, b, solver="entropic", regularisation=eps)
    assert np.abs(found.matrix.sum(axis=0) - b).max() <= 1e-14
    assert (
        np.abs(found.matrix.sum(axis=1) - a).max() <= 1e-14 and found.matrix.min() >= 0
    )
    best = transport_plan(cost, a, b).value
    # The entropy of a plan is at most that of a product of its marginals.
    most = eps * np.ptp(cost) * np.log(6 * 7)
    assert -1e-9 < found.value - best < most
    # On what is not next to nothing, the logarithm is a sum of potentials.
    log = np.log(np.maximum(found.matrix, 1e-300)) + cost / (eps * np.ptp(cost))
    i, j = (found.matrix > 1e-6).nonzero()
    ends = np.zeros((i.size, 13))
    ends[np.arange(i.size), i] = ends[np.arange(i.size), 6 + j] = 1.0
    sums = ends @ np.linalg.lstsq(ends, log[i, j])[0]
    assert np.abs(log[i, j] - sums).max() < 1e-3
