"""Couplings: the network simplex beside general solvers, alone up to N = 2000, and a whole study.

Misses where scipy's linprog or cvxpy is less than thirty times slower, or the solvers disagree.
cvxpy runs as equations (4) and (5) are written down, built anew for every reading as a filter
would. No general solver gets more than 200 members: its matrices have 2 N^3 entries. The study is
the one of book/studies/pendulum.py, the paper's five algorithms without retraction, 100 runs.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import numpy as np
from _bench import Row, main, peak_mb, table, timed

from bookkit import studies
from distfilt.coupling import distances, plan, project, sorted_plan

SIZES = (50, 100, 200)
RUNS, SECONDS = 100, 30
GROWTH = (50, 100, 200, 500, 1000, 2000)
NEEDED = {"linprog": 30, "cvxpy, built anew": 30}
BOUNDS = {"entropic, 0.01": np.inf}
"""Largest difference of the value from the network simplex's; 1e-11 for the others."""
PACKAGES = ("numpy", "scipy", "POT", "cvxpy", "highspy")


def case(n: int) -> tuple[np.ndarray, np.ndarray]:
    """Costs and likelihood weights of n members in four dimensions."""
    rng = np.random.default_rng(n)
    x = rng.standard_normal((n, 4))
    w = np.exp(-1.5 * x[:, 0] ** 2)
    return distances(x), w / w.sum()


def built_anew(cost: np.ndarray, w: np.ndarray) -> float:
    """The linear programme written down in cvxpy and solved by HiGHS; its value."""
    import cvxpy as cp

    n = len(w)
    t = cp.Variable((n, n), nonneg=True)
    scale = cost.max()
    ends = [cp.sum(t, axis=0)[:-1] == 1.0, cp.sum(t, axis=1) == n * w]
    problem = cp.Problem(cp.Minimize(cp.sum(cp.multiply(cost / scale, t))), ends)
    problem.solve(solver="HIGHS")
    assert problem.status == "optimal"
    return float(problem.value) * scale / n


def value(solver: str, cost: np.ndarray, w: np.ndarray) -> float:
    """The cost of the library's plan by one solver."""
    return plan(cost, w, solver=solver).value


def repeated(function: Callable[[], Any], calls: int) -> Any:
    """The result of the last of many calls; the others are not kept."""
    for _ in range(calls - 1):
        function()
    return function()


@table("coupling-growth", *PACKAGES)
def growth() -> Iterator[Row]:
    """The network simplex alone; first of all, so that the peak of memory is its own."""
    before = None
    for n in GROWTH:
        calls = max(1, 400 // n)
        found = timed(partial(repeated, partial(plan, *case(n)), calls), 3)
        each = found.cpu / calls
        slope = "" if before is None else f"{np.log(each / before[1]) / np.log(n / before[0]):.2f}"
        yield {
            "members": n, "ms": f"{1e3 * each:.3f}", "slope": slope,
            "peak_mb": f"{peak_mb():.0f}", "gap": f"{abs(found.result.gap):.0e}",
        }  # fmt: skip
        before = n, each


def against(n: int, ms: float, solver: str, theirs: float, digits: int, **more: Any) -> Row:
    """One line: the network simplex's time and another solver's."""
    empty = {"needed": "", "value_gap": ""}
    return {
        "members": n, "solver": solver, "network_ms": f"{ms:.3f}",
        "solver_ms": f"{theirs:.{digits}f}", "ratio": f"{theirs / ms:.{digits - 1}f}",
        **empty, "peak_mb": f"{peak_mb():.0f}", **more,
    }  # fmt: skip


@table("coupling", *PACKAGES)
def ratios() -> Iterator[Row]:
    """The network simplex against the others, on the same problem in the same run."""
    for n in SIZES:
        cost, w = case(n)
        calls = max(3, 4000 // n)
        fast = timed(partial(repeated, partial(plan, cost, w), calls), 5)
        ms = 1e3 * fast.cpu / calls
        others = {
            "linprog": partial(value, "linprog", cost, w),
            "cvxpy, built anew": partial(built_anew, cost, w),
            "entropic, 0.01": partial(value, "entropic", cost, w),
        }
        for solver, call in others.items():
            call()  # compiled and imported
            slow = timed(call, 5)
            gap, needed = abs(slow.result - fast.result.value), NEEDED.get(solver, 0)
            missed = 1e3 * slow.cpu / ms < needed or gap > BOUNDS.get(solver, 1e-11)
            yield against(n, ms, solver, 1e3 * slow.cpu, 1, needed=needed or "",
                          value_gap=f"{gap:.0e}", missed=missed)
        u = np.random.default_rng(n).standard_normal(n)
        line = timed(partial(repeated, partial(sorted_plan, u, u, w), calls), 5)
        yield against(n, ms, "sorted, d = 1", 1e3 * line.cpu / calls, 3)


def one(seed: np.random.SeedSequence) -> float:
    """The paper's five algorithms on one run; OTProj reuses OTF's."""
    paper = studies.script("pendulum")
    _, readings, members = paper.data(np.random.default_rng(seed))
    found = paper.run(readings, members, ("OTF", "OTMA", "OTNLeq", "OTNLeqMA"))
    alive = np.isfinite(found[:, 0]).all(axis=(1, 2))
    with np.errstate(all="ignore"):
        project(found[alive, 0], paper.rod, **paper.how)
    return 0.0


@table("coupling-study", *PACKAGES)
def study() -> Iterator[Row]:
    """The five algorithms on all cores."""
    began = time.perf_counter()
    found = studies.run(one, np.random.SeedSequence(2024).spawn(RUNS))
    wall, failed = time.perf_counter() - began, len(found.failures)
    each = 100 * wall / RUNS
    yield {
        "runs": RUNS, "wall_s": f"{wall:.1f}", "failed": failed, "wall_s_for_100": f"{each:.1f}",
        "needed": SECONDS, "missed": failed + (each > SECONDS),
    }  # fmt: skip


if __name__ == "__main__":
    main()
