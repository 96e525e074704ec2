"""Runnalls' reduction beside pyest's, and one seed in orbit.

Both get the same mixtures in one run. Misses where a ratio, an agreement or the memory is missed.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import Any

import numpy as np
from _bench import Row, interleaved, main, peak_mb, table, timed

from bookkit import studies
from distfilt.mixtures import GaussianMixture, runnalls

LEFT = 36
PEERS = ((4, 500, 15), (12, 500, 6))
"""Components, mixands, and the ratio that pyest has to lose by."""
LIMIT_MB = 2000


def mixture(size: int, dim: int, seed: int = 0) -> GaussianMixture:
    """Uneven weights, means in a cloud, full covariances."""
    rng = np.random.default_rng(seed + 1000 * dim + size)
    roots = 0.4 * rng.standard_normal((size, dim, dim)) + 0.6 * np.eye(dim)
    covs = roots @ np.swapaxes(roots, -1, -2) + 0.1 * np.eye(dim)
    w = rng.dirichlet(np.ones(size))
    return GaussianMixture(w, 3 * rng.standard_normal((size, dim)), covs)


def row(task: str, dim: int, size: int, seconds: float, **more: Any) -> Row:
    """One line of the table."""
    empty = {"ratio": "", "needed": "", "gap": ""}
    return {
        "task": task, "components": dim, "mixands": size, "ms": f"{1e3 * seconds:.1f}",
        **{**empty, **more}, "peak_mb": f"{peak_mb():.0f}",
        "missed": more.get("missed", False) or peak_mb() > LIMIT_MB,
    }


def gap(ours: GaussianMixture, weights: Any, means: Any, covs: Any) -> float:
    """Largest relative difference of two mixtures whose mixands stand in another order."""
    mine, theirs = np.argsort(ours.weights), np.argsort(weights)
    pairs = ((ours.weights, weights), (ours.means, means), (ours.covs, covs))
    return max(
        float(np.abs(a[mine] - np.asarray(b)[theirs]).max() / np.abs(a).max()) for a, b in pairs
    )


def beside_pyest() -> Iterator[Row]:
    """Our reduction and pyest's."""
    from pyest.gm import GaussianMixture as TheirMixture
    from pyest.gm import merge_runnalls

    for dim, size, needed in PEERS:
        p = mixture(size, dim)
        ours = partial(runnalls, p, LEFT)
        there = TheirMixture(p.weights.copy(), p.means.copy(), p.covs.copy())
        found = merge_runnalls(there, LEFT)
        apart = gap(ours(), found.w, found.m, found.P)
        calls = {"reduce": ours, "reduce, pyest": partial(merge_runnalls, there, LEFT)}
        times, ratios = interleaved(calls, 3)
        for name, spent in times.items():
            mine = {"needed": needed, "gap": f"{apart:.0e}"} if "pyest" in name else {}
            missed = bool(mine) and (ratios[name] < needed or apart > 1e-12)
            yield row(name, dim, size, spent, ratio=f"{ratios[name]:.1f}", missed=missed, **mine)


def in_orbit() -> Iterator[Row]:
    """One seed of chapter 8's rows."""
    study = studies.script("orbit")
    truth = study.data(study.SETTING, np.random.default_rng(7))[1:]
    for name in ("none", "c2", "c3", "one_ci", "news"):
        took = timed(partial(study.run, study.SETTING, study.ROWS[""][name], *truth), 3)
        size = took.result[-1].mixtures[0].size
        yield row(f"track, {name}", 12, size, took.cpu, needed=2000, missed=took.cpu > 2)


@table("mixtures", "numpy", "numba", "pyest")
def rows() -> Iterator[Row]:
    yield from beside_pyest()
    yield from in_orbit()


if __name__ == "__main__":
    main()
