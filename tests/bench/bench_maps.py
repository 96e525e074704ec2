"""Separable maps against the affine one, and how the fit grows with members and with dimension.

Times fit and composed update on the same samples in the same run. Writes data/bench/maps.csv;
fails where a separable map costs more than its limit times the affine one, or grows too fast.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from _bench import timed, write

from distfilt.triangular import affine, compose, separable

BASE_MEMBERS, BASE_DIM = 400, 6
MEMBERS, DIMS = (400, 800, 1600, 3200), (4, 8, 16, 32)
RUNS = 8
LIMITS = {"separable 1": 400, "separable 2": 800}
"""How many times the affine update's time a separable one may take."""

SLOPES = {"members": 1.3, "dimension": 3.2}
"""Time over members is linear; over dimension the features of each component grow, and their count
and the normal equations with them: between 2 and 3."""

FITS: dict[str, Callable[..., Any]] = {
    "affine": affine.fit,
    "separable 1": partial(separable.fit, order=1, regularisation=0.01),
    "separable 2": partial(separable.fit, order=2, regularisation=0.01),
}


def samples(members: int, dim: int) -> tuple[np.ndarray, np.ndarray]:
    """Curved members, and noisy observations of half of their components."""
    rng = np.random.default_rng(1000 * dim + members)
    x = rng.standard_normal((RUNS, members, dim))
    x[..., 1:] += 0.3 * x[..., :-1] ** 2
    seen = x[..., : dim // 2]
    return seen + 0.5 * rng.standard_normal(seen.shape), x


def measured(name: str, members: int, dim: int) -> tuple[float, float]:
    """Processor time in ms of a fit and of the whole update, all runs together."""
    y, x = samples(members, dim)
    fit = timed(lambda: FITS[name](y, x), 3)
    update = timed(lambda: compose(FITS[name](y, x), y, x, y[:, 0]), 3)
    return 1e3 * fit.cpu, 1e3 * update.cpu


def rows_of(name: str) -> tuple[list[dict[str, Any]], dict[str, float]]:
    """The table's rows of one map, and the slopes of its fit in log-log coordinates."""
    rows, slopes = [], {}
    for along, sizes in (("members", MEMBERS), ("dimension", DIMS)):
        times = []
        for size in sizes:
            n, d = (size, BASE_DIM) if along == "members" else (BASE_MEMBERS, size)
            fit, update = measured(name, n, d)
            times.append(fit)
            rows.append({"map": name, "along": along, "members": n, "dimension": d,
                         "fit_ms": fit, "update_ms": update})
        slopes[along] = float(np.polyfit(np.log(sizes), np.log(times), 1)[0])
    return rows, slopes


def main() -> int:
    """Measure, write the table, and count what is missed."""
    table, missed = [], 0
    affine_time: dict[tuple[int, int], float] = {}
    for name in FITS:
        rows, slopes = rows_of(name)
        for row in rows:
            size = (row["members"], row["dimension"])
            if name == "affine":
                affine_time[size] = row["update_ms"]
            ratio = row["update_ms"] / affine_time[size]
            missed += name != "affine" and ratio > LIMITS[name]
            slope = slopes[row["along"]]
            table.append({
                **row,
                "fit_ms": f"{row['fit_ms']:.2f}",
                "update_ms": f"{row['update_ms']:.2f}",
                "update_ratio": f"{ratio:.1f}",
                "fit_slope": f"{slope:.2f}",
                "slope_limit": SLOPES[row["along"]],
            })
        missed += sum(slopes[along] > limit for along, limit in SLOPES.items())
    write("maps", table, ("numpy", "scipy"))
    return int(missed)


if __name__ == "__main__":
    sys.exit(main())
