"""The closed-form affine map against the printed program (12), component by component in cvxpy.

Times the fit of the x-block at three sizes, on the same samples in the same run, and compares the
composed maps: once with each component's program compiled before, as the library keeps it, and
once compiled in every call, as a newcomer writes it. Writes data/bench/triangular.csv; fails where
a ratio, against the compiled program, or an agreement is missed.
"""

from __future__ import annotations

import sys

import numpy as np
from _bench import timed, write

from distfilt.triangular import affine, compose
from distfilt.triangular.affine import fit, fit_convex

SIZES = ((1, 6, 80), (3, 13, 150), (10, 40, 500))
"""Observations m, state d, and the ratio that ECOS has to lose by."""

MEMBERS = 200
CALLS = 200


def samples(m: int, d: int) -> tuple[np.ndarray, np.ndarray]:
    """Correlated members of unit scale and noisy observations of them."""
    rng = np.random.default_rng(100 * m + d)
    mixing = np.eye(d) + 0.3 * rng.standard_normal((d, d)) / np.sqrt(d)
    x = rng.standard_normal((MEMBERS, d)) @ mixing
    return x[:, :m] + 0.5 * rng.standard_normal((MEMBERS, m)), x


def main() -> int:
    """Measure, write the table, and count what is missed."""
    rows, missed = [], 0
    for m, d, needed in SIZES:
        y, x = samples(m, d)
        closed = timed(lambda y=y, x=x: [fit(y, x) for _ in range(CALLS)][0], 5)
        exact = compose(closed.result, y, x, y[0])
        for solver in ("ECOS", "CLARABEL"):
            def newcomer(y: np.ndarray = y, x: np.ndarray = x, s: str = solver) -> object:
                affine._program.cache_clear()
                return fit_convex(y, x, solver=s)

            compiled_each_time = timed(newcomer, 3)
            solved = timed(lambda y=y, x=x, s=solver: fit_convex(y, x, solver=s), 3)
            ratio = solved.cpu / (closed.cpu / CALLS)
            gap = np.abs(compose(solved.result, y, x, y[0]) - exact).max()
            wanted = needed if solver == "ECOS" else None
            missed += gap >= 1e-8 or (wanted is not None and ratio < wanted)
            rows.append({
                "variables": m + d,
                "solver": solver,
                "closed_form_us": f"{closed.cpu / CALLS * 1e6:.1f}",
                "solver_ms": f"{solved.cpu * 1e3:.1f}",
                "ratio": f"{ratio:.0f}",
                "compiled_each_time_ms": f"{compiled_each_time.cpu * 1e3:.1f}",
                "ratio_each_time": f"{compiled_each_time.cpu / (closed.cpu / CALLS):.0f}",
                "needed": wanted or "",
                "composed_map_gap": f"{gap:.1e}",
                "coefficient_gap": f"{np.abs(closed.result.scale - solved.result.scale).max():.1e}",
            })
    write("triangular", rows, ("numpy", "cvxpy", "ecos", "clarabel"))
    return int(missed)


if __name__ == "__main__":
    sys.exit(main())
