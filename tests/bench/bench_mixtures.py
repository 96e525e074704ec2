"""Runnalls' reduction beside pyest's; misses where the ratio or their agreement is missed."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import Any

import numpy as np
from _bench import Row, compare_times, main, peer, table

from distfilt.mixtures import GaussianMixture, runnalls

LEFT = 36
PEERS = ((4, 500, 15), (12, 500, 6))
"""Dimensions, components, and how many times slower pyest has to be."""


def mixture(size: int, dim: int, seed: int = 0) -> GaussianMixture:
    """Uneven weights, means in a cloud, full covariances."""
    rng = np.random.default_rng(seed + 1000 * dim + size)
    deviations = rng.standard_normal((size, dim, dim))
    roots = 0.4 * deviations + 0.6 * np.eye(dim)
    # R Rᵀ + 0.1 I is positive definite.
    squares = roots @ np.swapaxes(roots, -1, -2)
    covs = squares + 0.1 * np.eye(dim)
    w = rng.dirichlet(np.ones(size))
    return GaussianMixture(w, 3 * rng.standard_normal((size, dim)), covs)


def largest_difference(
    ours: GaussianMixture, weights: Any, means: Any, covs: Any
) -> float:
    """Return the largest relative difference of two mixtures, whatever their order."""
    # Weights are all different, so that sorting by them pairs the components.
    order = np.argsort(ours.weights)
    their_order = np.argsort(weights)
    pairs = ((ours.weights, weights), (ours.means, means), (ours.covs, covs))
    return max(
        float(np.abs(a[order] - np.asarray(b)[their_order]).max() / np.abs(a).max())
        for a, b in pairs
    )


@table("mixtures", "numpy", "numba", "pyest")
def rows() -> Iterator[Row]:
    gm = peer("pyest.gm")
    for dim, size, needed in PEERS if gm is not None else ():
        p = mixture(size, dim)
        their_mixture = gm.GaussianMixture(
            p.weights.copy(), p.means.copy(), p.covs.copy()
        )
        calls = {
            "ours": partial(runnalls, p, LEFT),
            "pyest": partial(gm.merge_runnalls, their_mixture, LEFT),
        }
        theirs = calls["pyest"]()
        difference = largest_difference(calls["ours"](), theirs.w, theirs.m, theirs.P)
        times, ratios = compare_times(calls, 3)
        yield {
            "components": dim,
            "mixands": size,
            "ms": f"{1e3 * times['ours']:.1f}",
            "pyest_ms": f"{1e3 * times['pyest']:.1f}",
            "ratio": f"{ratios['pyest']:.1f}",
            "needed": needed,
            "gap": f"{difference:.0e}",
            "missed": ratios["pyest"] < needed or difference > 1e-12,
        }


if __name__ == "__main__":
    main()
