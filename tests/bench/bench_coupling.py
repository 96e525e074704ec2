"""Couplings: the network simplex beside general solvers, alone up to N = 2000, and a whole study.

Misses where cvxpy is less than thirty times slower, or the solvers disagree.
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
from distfilt.coupling import distances, plan, project

SIZES = (50, 100, 200)
RUNS, SECONDS = 100, 30
GROWTH = (50, 100, 200, 500, 1000, 2000)
NEEDED = {"cvxpy, built anew": 30}
PACKAGES = ("numpy", "scipy", "POT", "cvxpy", "highspy")
BOUNDS = {"entropic, 0.01": np.inf}
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


def simplex(n: int, calls: int) -> tuple[float, float]:
    """The network simplex's time in ms, and its value."""
    found = timed(partial(repeated, partial(plan, *case(n)), calls), 5)
    return 1e3 * found.cpu / calls, found.result.value


def row(solver: str, n: int, ms: float, **more: Any) -> Row:
    """One line of the table."""
    empty = {"ratio": "", "needed": "", "value_gap": "", "slope": ""}
    return {
        "solver": solver, "members": n, "ms": f"{ms:.3f}", **empty, "peak_mb": f"{peak_mb():.0f}",
        **more,
    }  # fmt: skip


def growth() -> Iterator[Row]:
    """The network simplex alone; first of all, so that the peak of memory is its own."""
    before = None
    for n in GROWTH:
        ms, _ = simplex(n, max(1, 400 // n))
        slope = "" if before is None else f"{np.log(ms / before[1]) / np.log(n / before[0]):.2f}"
        yield row("network simplex", n, ms, slope=slope)
        before = n, ms


def ratios() -> Iterator[Row]:
    """The network simplex against the others, on the same problem in the same run."""
    for n in SIZES:
        cost, w = case(n)
        ms, best = simplex(n, max(3, 4000 // n))
        others = {
            "cvxpy, built anew": partial(built_anew, cost, w),
            "entropic, 0.01": partial(value, "entropic", cost, w),
        }
        for solver, call in others.items():
            call()  # compiled and imported
            slow = timed(call, 5)
            gap, needed = abs(slow.result - best), NEEDED.get(solver, 0)
            ratio = 1e3 * slow.cpu / ms
            yield row(
                solver, n, 1e3 * slow.cpu, ratio=f"{ratio:.0f}", needed=needed or "",
                value_gap=f"{gap:.0e}",
                missed=ratio < needed or gap > BOUNDS.get(solver, 1e-11),
            )  # fmt: skip


@table("coupling", *PACKAGES)
def rows() -> Iterator[Row]:
    yield from growth()
    yield from ratios()


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
    studies.run(one, studies.spawn(2024, RUNS))
    wall = time.perf_counter() - began
    yield {"runs": RUNS, "wall_s": f"{wall:.1f}", "needed": SECONDS, "missed": wall > SECONDS}


if __name__ == "__main__":
    main()
