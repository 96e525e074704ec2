"""Runnalls' reduction beside pyest and Stone Soup, its growth, one fusion, one seed in orbit.

Every library gets the same mixtures in one run. Stone Soup's reducer merges within a gate, which
is another algorithm: its time is told, its result not compared. Misses where a ratio, an agreement
or the memory is missed.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import numpy as np
from _bench import Row, interleaved, main, peak_mb, table, timed

from bookkit import studies
from distfilt.mixtures import (
    GaussianMixture,
    PartialFusion,
    runnalls,
    split,
)
from distfilt.models.orbit import propagate

LEFT = 36
PEERS = ((4, 500, 15), (12, 500, 6))
"""Components, mixands, and the ratio that pyest has to lose by."""
GROWTH = ((4, (500, 1000, 2000, 5000)), (12, (500, 1000, 2000)))
FUSED = (5, 10, 20, 40)
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
    empty = {"ratio": "", "needed": "", "gap": "", "slope": ""}
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


def stone_soup(p: GaussianMixture) -> Callable[[], Any]:
    """Its reducer on the same mixture."""
    from stonesoup.mixturereducer.gaussianmixture import GaussianMixtureReducer
    from stonesoup.types.numeric import Probability
    from stonesoup.types.state import WeightedGaussianState

    states = [
        WeightedGaussianState(m[:, None], c, weight=Probability(w))
        for w, m, c in zip(p.weights, p.means, p.covs, strict=True)
    ]
    reducer = GaussianMixtureReducer(
        prune_threshold=1e-12, merge_threshold=4 * p.dim, max_number_components=LEFT
    )
    return lambda: reducer.reduce(list(states))


def theirs_of(p: GaussianMixture) -> Any:
    """The same mixture as pyest's."""
    from pyest.gm import GaussianMixture as TheirMixture

    return TheirMixture(p.weights.copy(), p.means.copy(), p.covs.copy())


def beside_peers() -> Iterator[Row]:
    """Our reduction, pyest's and Stone Soup's."""
    from pyest.gm import merge_runnalls

    for dim, size, needed in PEERS:
        p = mixture(size, dim)
        ours, there = partial(runnalls, p, LEFT), theirs_of(p)
        found = merge_runnalls(there, LEFT)
        apart = gap(ours(), found.w, found.m, found.P)
        times, ratios = interleaved({
            "reduce": ours, "reduce, pyest": partial(merge_runnalls, there, LEFT),
            "merge in a gate, Stone Soup": stone_soup(p),
        }, 3)  # fmt: skip
        for name, spent in times.items():
            mine = {"needed": needed, "gap": f"{apart:.0e}"} if "pyest" in name else {}
            missed = bool(mine) and (ratios[name] < needed or apart > 1e-12)
            yield row(name, dim, size, spent, ratio=f"{ratios[name]:.1f}", missed=missed, **mine)


def growth() -> Iterator[Row]:
    """Time against the number of mixands, with the slope between neighbours."""
    two_stage = partial(runnalls, heaviest=400)
    for reduce, name in ((runnalls, "reduce"), (two_stage, "reduce in two stages")):
        for dim, sizes in GROWTH:
            before: tuple[int, float] | None = None
            for size in sizes:
                took = timed(partial(reduce, mixture(size, dim), LEFT), 1 if size > 1000 else 3).cpu
                slope = "" if before is None else (
                    f"{np.log(took / before[1]) / np.log(size / before[0]):.2f}"
                )
                yield row(name, dim, size, took, slope=slope)
                before = size, took


def fusion() -> Iterator[Row]:
    """Shapes and C2 weights of a 12-component fusion, and C3 weights where they are few."""
    for size in FUSED:
        f = PartialFusion(mixture(size, 12, 1), mixture(size, 12, 2).marginal(range(6)))
        mine, heard = (runnalls(m, min(6, size)) for m in (f.target, f.others[0]))
        few = {"marginal": mine, "received": [heard]}
        for name, rule, repeats, options in (
            ("all terms", "C2", 1, {"terms": "all"}),
            ("matched terms", "C2", 1, {"terms": "matched"}),
            ("marginals reduced to 6", "C2", 3, {"terms": "all", **few}),
            ("matched, heard reduced to 6, C3", "C3", 3, {"received": [heard]}),
        ):
            took = timed(lambda f=f, o=options, r=rule: f.weigh(f.shapes(**o), rule=r), repeats)
            yield row(f"fuse, {name}", 12, size, took.cpu)


def in_orbit() -> Iterator[Row]:
    """One seed of chapter 8's rows, and a day of 10 000 states."""
    study = studies.script("orbit")
    truth = study.data(study.SETTING, np.random.default_rng(7))[1:]
    for name in ("none", "c2", "c3", "one_ci", "news"):
        took = timed(partial(study.run, study.SETTING, study.ROWS[""][name], *truth), 3)
        size = took.result[-1].mixtures[0].size
        yield row(f"track, {name}", 12, size, took.cpu, needed=2000, missed=took.cpu > 2)
    many = np.tile(study.SETTING["target"], (10_000, 1))
    yield row("propagate 24 h", 6, 10_000, timed(lambda: propagate(many, 86400.0), 1).cpu)


def splits() -> Iterator[Row]:
    """A split of a mixture, beside pyest's."""
    from pyest.gm import GaussSplitOptions, split_gaussian

    p = mixture(1, 12)
    u = p.factors[:, :, 0]
    options = GaussSplitOptions(L=3, lam=1e-3)
    calls = {
        "split": partial(split, p, [0], u),
        "split, pyest": partial(
            split_gaussian, 1.0, p.means[0], p.covs[0], options, direction=u[0]
        ),
    }
    times, ratios = interleaved(calls)
    for name, spent in times.items():
        yield row(name, 12, 1, spent, ratio=f"{ratios[name]:.1f}")


@table("mixtures", "numpy", "numba", "pyest", "stonesoup")
def rows() -> Iterator[Row]:
    for part in (beside_peers, growth, fusion, in_orbit, splits):
        yield from part()


if __name__ == "__main__":
    main()
