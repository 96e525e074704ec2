"""Couplings: the network simplex beside general solvers, alone up to N = 2000, and a whole study.

Writes data/bench/coupling.csv, coupling-growth.csv and coupling-study.csv. Fails where scipy's
linprog or cvxpy is less than thirty times slower, or the solvers disagree. The study is that of
book/studies/pendulum.py, the paper's five algorithms without retraction; give the number of its
runs as an argument, 100 by default.
"""

from __future__ import annotations

import sys
import time
from functools import partial
from pathlib import Path

import numpy as np
from _bench import peak_mb, timed, write

from distfilt.coupling import distances, plan, sorted_plan

SIZES = (50, 100, 200)
GROWTH = (50, 100, 200, 500, 1000, 2000)
NEEDED = 30
SOLVERS = ("linprog", "highs", "clarabel", "entropic")


def case(n: int) -> tuple[np.ndarray, np.ndarray]:
    """Costs and likelihood weights of n members in four dimensions."""
    rng = np.random.default_rng(n)
    x = rng.standard_normal((n, 4))
    w = np.exp(-1.5 * x[:, 0] ** 2)
    return distances(x), w / w.sum()


def ratios() -> tuple[list[dict[str, object]], int]:
    """The network simplex against the others, on the same problem in the same run."""
    rows, missed = [], 0
    for n in SIZES:
        cost, w = case(n)
        calls = max(3, 4000 // n)
        fast = timed(lambda c=cost, w=w, k=calls: [plan(c, w) for _ in range(k)][0], 5)
        each = fast.cpu / calls
        for solver in SOLVERS:
            plan(cost, w, solver=solver)  # compiled
            slow = timed(partial(plan, cost, w, solver=solver), 3)
            gap = abs(slow.result.value - fast.result.value)
            bound = {"clarabel": 1e-5, "entropic": np.inf}.get(solver, 1e-11)
            needed = 0 if solver == "entropic" else NEEDED
            missed += slow.cpu / each < needed or gap > bound
            rows.append({
                "members": n, "solver": solver, "network_ms": f"{1e3 * each:.3f}",
                "solver_ms": f"{1e3 * slow.cpu:.1f}", "ratio": f"{slow.cpu / each:.0f}",
                "needed": needed or "", "value_gap": f"{gap:.0e}",
            })  # fmt: skip
        u = np.random.default_rng(n).standard_normal(n)
        line = timed(lambda u=u, w=w: sorted_plan(u, u, w), 5)
        rows.append({
            "members": n, "solver": "sorted, d = 1", "network_ms": f"{1e3 * each:.3f}",
            "solver_ms": f"{1e3 * line.cpu:.3f}", "ratio": f"{line.cpu / each:.2f}",
            "needed": "", "value_gap": "",
        })  # fmt: skip
    return rows, missed


def growth() -> list[dict[str, object]]:
    """The network simplex alone."""
    rows, before = [], None
    for n in GROWTH:
        cost, w = case(n)
        calls = max(1, 400 // n)
        found = timed(lambda c=cost, w=w, k=calls: [plan(c, w) for _ in range(k)][0], 3)
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
    from distfilt.coupling import project
    from studies import pendulum as paper

    _, readings, members = paper.data(np.random.default_rng(seed))
    found = paper.run(readings, members, ("OTF", "OTMA", "OTNLeq", "OTNLeqMA"))
    alive = np.isfinite(found[:, 0]).all(axis=(1, 2))
    with np.errstate(all="ignore"):
        project(found[alive, 0], paper.rod, **paper.how)
    return 0.0


def study(runs: int) -> list[dict[str, object]]:
    """The five algorithms over `runs` runs on all cores."""
    from distfilt import studies

    sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "book"))
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
    packages = ("numpy", "scipy", "POT", "cvxpy", "highspy", "clarabel")
    rows, missed = ratios()
    write("coupling", rows, packages)
    write("coupling-growth", growth(), packages)
    whole = study(int(sys.argv[1]) if len(sys.argv) > 1 else 100)
    write("coupling-study", whole, packages)
    return int(missed + (float(str(whole[0]["wall_s_for_100"])) > 30))


if __name__ == "__main__":
    sys.exit(main())
