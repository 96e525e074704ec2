"""Couplings: the network simplex beside a general solver, and beside the entropic one.

Misses where cvxpy is less than thirty times slower, or finds another value. cvxpy runs
as equations (4) and (5) are written down, built anew for every observation as a filter
would. It gets no more than 200 members: its matrices have 2 N^3 entries. The slope is
that of the simplex's time.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import numpy as np
from _bench import Row, compare_times, main, table

from distfilt.coupling import squared_distances, transport_plan

SIZES = (50, 100, 200, 500, 1000, 2000)
MOST = 200
NEEDED = 30


def case(n: int) -> tuple[np.ndarray, np.ndarray]:
    """Costs and likelihood weights of n members in four dimensions."""
    rng = np.random.default_rng(n)
    x = rng.standard_normal((n, 4))
    # A likelihood of the first component alone
    w = np.exp(-1.5 * x[:, 0] ** 2)
    return squared_distances(x), w / w.sum()


def solve_by_cvxpy(cost: np.ndarray, w: np.ndarray) -> float:
    """The linear programme written down in cvxpy and solved by HiGHS; its value."""
    import cvxpy as cp

    n = len(w)
    t = cp.Variable((n, n), nonneg=True)
    scale = cost.max()
    # Marginals of N T: one equation of the columns follows from the others.
    columns = cp.sum(t, axis=0)[:-1] == 1.0
    rows = cp.sum(t, axis=1) == n * w
    total = cp.sum(cp.multiply(cost / scale, t))
    problem = cp.Problem(cp.Minimize(total), [columns, rows])
    problem.solve(solver="HIGHS")
    assert problem.status == "optimal"
    return float(problem.value) * scale / n


@table("coupling", "numpy", "scipy", "POT", "cvxpy", "highspy")
def rows() -> Iterator[Row]:
    spent: dict[int, float] = {}
    for n in SIZES:
        cost, w = case(n)
        calls = {"network simplex": lambda c=cost, w=w: transport_plan(c, w).value}
        if n <= MOST:
            calls["cvxpy, built anew"] = partial(solve_by_cvxpy, cost, w)
            calls["entropic, 0.01"] = lambda c=cost, w=w: (
                transport_plan(c, w, solver="entropic").value
            )
        times, ratios = compare_times(calls, 5)
        best = calls["network simplex"]()
        spent[n] = times["network simplex"]
        # d log(time) / d log(N), from the last two sizes
        slope = np.diff(np.log(list(spent.items())[-2:]), axis=0)
        for solver, call in calls.items():
            gap = abs(call() - best)
            needed = NEEDED if "cvxpy" in solver else 0
            yield {
                "solver": solver,
                "members": n,
                "ms": f"{1e3 * times[solver]:.3f}",
                "ratio": f"{ratios[solver]:.1f}",
                "needed": needed or "",
                "value_gap": f"{gap:.0e}",
                "slope": "".join(
                    f"{y / x:.2f}" for x, y in slope if solver == "network simplex"
                ),
                "missed": ratios[solver] < needed or (needed and gap > 1e-11),
            }


if __name__ == "__main__":
    main()
