"""Random pairs of bent beliefs: how often the paper's orderings hold, behind chapter 7's shares.

Each trial draws two agents that see one target from different sides, and fuses by each rule. All
divergences of one trial are taken on the same points, by importance sampling.
"""

from __future__ import annotations

import numpy as np

from distfilt.mixtures import (
    GaussianMixture,
    PartialFusion,
    arc,
    fuse_moments,
    jeffreys_by_sampling,
)

NAME = "arcs"
PAPER = "semeraro"

MEMBERS = 4000
RULES = {
    "c1": ("all", "C1"), "c2": ("all", "C2"), "c3": ("all", "C3"),
    "matched": ("matched", "C3"), "points": ("matched", "points"),
}
BOUNDS = {
    "mixands": (3, 6), "distance": (6.0, 12.0), "turn": (0.5, 2.6), "angle_std": (0.2, 0.6),
    "range_std": (0.25, 0.5), "ego_std": (0.25, 0.5), "width": (0.2, 0.5),
}


def belief(bearing: float, rng: np.random.Generator) -> GaussianMixture:
    """One agent's belief, drawn within the bounds; its arc misses the origin a little."""
    draws = {
        name: rng.uniform(*BOUNDS[name])
        for name in ("distance", "angle_std", "range_std", "ego_std", "width")
    }
    r = draws.pop("distance")
    place = r * np.array([np.cos(bearing), np.sin(bearing)])
    bent = arc(int(rng.integers(BOUNDS["mixands"][0], BOUNDS["mixands"][1] + 1)), place, **draws)
    shift = np.tile(rng.normal(scale=0.3, size=2), 2)
    return GaussianMixture(bent.weights, bent.means + shift, bent.covs)


def both(a: GaussianMixture, b: GaussianMixture, share: float) -> GaussianMixture:
    """A proposal that covers both."""
    return GaussianMixture(
        np.concatenate([share * a.weights, (1 - share) * b.weights]),
        np.concatenate([a.means, b.means]),
        np.concatenate([a.covs, b.covs]),
    )


def trial(seed: np.random.SeedSequence) -> dict[str, float]:
    """Jeffreys' divergences of both agents and of the targets, for each rule and for CI."""
    for_pair, for_points = (np.random.default_rng(s) for s in seed.spawn(2))
    one = belief(np.pi, for_pair)
    two = belief(np.pi + for_pair.uniform(*BOUNDS["turn"]), for_pair)
    exact = [PartialFusion(one, two.marginal([0, 1])), PartialFusion(two, one.marginal([0, 1]))]
    fused = {
        name: [f.weigh(f.shapes(terms=terms), rule=rule) for f in exact]
        for name, (terms, rule) in RULES.items()
    }
    fused["moments"] = [fuse_moments(f.own, f.heard) for f in exact]
    first = int(for_points.integers(2**31))
    out = {}
    for name, pair in fused.items():
        for k, (f, m) in enumerate(zip(exact, pair, strict=True)):
            found = jeffreys_by_sampling(
                m.log_density, f.log_value, both(fused["points"][k], f.own, 0.8),
                members=MEMBERS, rng=np.random.default_rng(first + k),
            )
            out[f"{name}_{k + 1}"] = found.value
        a, b = (m.marginal([0, 1]) for m in pair)
        found = jeffreys_by_sampling(
            a.log_density, b.log_density, both(a, b, 0.5), members=MEMBERS,
            rng=np.random.default_rng(first + 2),
        )
        out[f"{name}_target"] = found.value
    return out


parameters = {"members": MEMBERS, "bounds": BOUNDS, "rules": RULES}
columns = tuple(f"{m}_{k}" for m in (*RULES, "moments") for k in (1, 2, "target"))
code = (belief, both)
seeds = np.random.SeedSequence(20260).spawn(300)
rtol = 1e-4
atol = 1e-12
