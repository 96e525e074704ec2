"""Couplings: the network simplex beside general solvers, alone up to N = 2000, and a whole study.

Writes data/bench/coupling.csv, coupling-growth.csv and coupling-study.csv. Fails where scipy's
linprog or cvxpy is less than thirty times slower, or the solvers disagree. cvxpy runs as equations
(4) and (5) are written down, built anew for every reading as a filter would. No general solver
gets more than 200 members: its matrices have 2 N^3 entries. The study is the one of
book/studies/pendulum.py, the paper's five algorithms without retraction; give the number of its
runs as an argument, 100 by default.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from _bench import peak_mb, timed, write

from distfilt.coupling import Plan, distances, plan, sorted_plan

SIZES = (50, 100, 200)
GROWTH = (50, 100, 200, 500, 1000, 2000)
NEEDED = {"linprog": 30, "cvxpy, built anew": 30}
BOUNDS = {"entropic": np.inf}
"""Largest difference of the value from the network simplex's; 1e-11 for the others."""


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


def ratios() -> tuple[list[dict[str, object]], int]:
    """The network simplex against the others, on the same problem in the same run."""
    rows, missed = [], 0
    for n in SIZES:
        cost, w = case(n)
        calls = max(3, 4000 // n)
        fast = timed(partial(repeated, partial(plan, cost, w), calls), 5)
        each, found = fast.cpu / calls, fast.result
        assert isinstance(found, Plan)
        others = {
            "linprog": partial(value, "linprog", cost, w),
            "cvxpy, built anew": partial(built_anew, cost, w),
            "entropic, 0.01": partial(value, "entropic", cost, w),
        }
        for solver, call in others.items():
            call()  # compiled and imported
            slow = timed(call, 5)
            gap = abs(slow.result - found.value)
            bound = next((b for name, b in BOUNDS.items() if name in solver.lower()), 1e-11)
            needed = NEEDED.get(solver, 0)
            missed += slow.cpu / each < needed or gap > bound
            rows.append({
                "members": n, "solver": solver, "network_ms": f"{1e3 * each:.3f}",
                "solver_ms": f"{1e3 * slow.cpu:.1f}", "ratio": f"{slow.cpu / each:.0f}",
                "needed": needed or "", "value_gap": f"{gap:.0e}", "peak_mb": f"{peak_mb():.0f}",
            })  # fmt: skip
        u = np.random.default_rng(n).standard_normal(n)
        line = timed(partial(repeated, partial(sorted_plan, u, u, w), calls), 5)
        rows.append({
            "members": n, "solver": "sorted, d = 1", "network_ms": f"{1e3 * each:.3f}",
            "solver_ms": f"{1e3 * line.cpu / calls:.3f}", "ratio": f"{line.cpu / calls / each:.2f}",
            "needed": "", "value_gap": "", "peak_mb": f"{peak_mb():.0f}",
        })  # fmt: skip
    return rows, missed


def growth() -> list[dict[str, object]]:
    """The network simplex alone; first of all, so that the peak of memory is its own."""
    rows, before = [], None
    for n in GROWTH:
        cost, w = case(n)
        calls = max(1, 400 // n)
        found = timed(partial(repeated, partial(plan, cost, w), calls), 3)
        each = found.cpu / calls
        slope = "" if before is None else f"{np.log(each / before[1]) / np.log(n / before[0]):.2f}"
        rows.append({
            "members": n, "ms": f"{1e3 * each:.3f}", "slope": slope,
            "peak_mb": f"{peak_mb():.0f}", "gap": f"{abs(found.result.gap):.0e}",
        })  # fmt: skip
        before = n, each
    return rows


def one(seed: np.random.SeedSequence) -> float:
    """The paper's five algorithms on one run; OTProj reuses OTF's."""
    from bookkit import studies
    from distfilt.coupling import project

    paper = studies.script("pendulum")
    _, readings, members = paper.data(np.random.default_rng(seed))
    found = paper.run(readings, members, ("OTF", "OTMA", "OTNLeq", "OTNLeqMA"))
    alive = np.isfinite(found[:, 0]).all(axis=(1, 2))
    with np.errstate(all="ignore"):
        project(found[alive, 0], paper.rod, **paper.how)
    return 0.0


def study(runs: int) -> list[dict[str, object]]:
    """The five algorithms over `runs` runs on all cores."""
    from bookkit import studies

    seeds = np.random.SeedSequence(2024).spawn(runs)
    began = time.perf_counter()
    found = studies.run(one, seeds)
    wall = time.perf_counter() - began
    return [{
        "runs": runs, "wall_s": f"{wall:.1f}", "failed": len(found.failures),
        "wall_s_for_100": f"{100 * wall / runs:.1f}", "needed": 30,
    }]  # fmt: skip


def main() -> int:
    """Measure, write the tables, and count what is missed."""
    packages = ("numpy", "scipy", "POT", "cvxpy", "highspy")
    write("coupling-growth", growth(), packages)
    rows, missed = ratios()
    write("coupling", rows, packages)
    whole = study(100)
    write("coupling-study", whole, packages)
    slow = float(str(whole[0]["wall_s_for_100"])) > 30
    return int(missed + slow + int(str(whole[0]["failed"])))


if __name__ == "__main__":
    sys.exit(main())
