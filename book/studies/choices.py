"""The paper's pendulum under other choices: cost, tie rule, (12), pseudo-noise, release angle.

The runs are those of the study `starts`, from both of its starts. The cost of
the coupling is the printed distance or its square. Copies of a member make the cheapest
coupling ambiguous, and a fixed addition to the costs chooses, or the solver alone. (12)
is K(d - D_i) or K(d - d^). With the printed cost augmentation also runs with four
deviations of the pseudo-measurement, and OTF from 30 degrees in place of 60. Filters of
the printed input with the fixed addition are those of `starts`; only those without
augmentation run again here, for the spread of their members' lengths.
"""

from __future__ import annotations

import numpy as np

from bookkit import studies
from distfilt.coupling import squared_distances, transport_plan
from distfilt.updates import etpf, with_augmentation, with_projection

starts = studies.script("starts")
pendulum = starts.pendulum
setting = starts.setting

NAME = "choices"
PAPER = "das"
scenarios = starts.scenarios

COSTS = ("distance", "squared")
TIES = ("fixed", "solver")
"""The library's addition of at most 1e-7 of the largest cost, or none."""
VARIANTS = ("particle", "shift")
STDS = (0.02, 0.05, 0.1, 0.2)
"""Deviations of the pseudo-measurement, in m²; columns have thousandths."""


def make_update(cost: str, ties: str):
    """Return the transport update with a cost and a rule for ties."""
    if ties == "fixed":
        return lambda x, h, y, r, *, rng: etpf(x, h, y, r, rng=rng, cost=cost)
    return lambda x, h, y, r, *, rng: transport(x, h, y, r, cost)


def transport(
    members: np.ndarray,
    predicted: np.ndarray,
    observed: np.ndarray,
    noise: np.ndarray,
    cost: str,
) -> np.ndarray:
    """Weight the members and transport them, (3) to (5), without a rule for ties."""
    # w_i ∝ p(y | x_i)
    residual = observed - predicted
    solved = np.linalg.solve(noise, residual.T).T
    log_weights = -0.5 * (residual * solved).sum(axis=1)
    weights = np.exp(log_weights - log_weights.max())
    weights /= weights.sum()
    # The printed cost is the square root of the library's.
    costs = squared_distances(members)
    if cost == "distance":
        costs = np.sqrt(costs)
    plan = transport_plan(costs, weights).matrix
    # X+ = X N T, about the mean so that no digits are lost
    mean = weights @ members
    return mean + len(members) * (plan.T @ (members - mean))


def make_filters(cost: str, ties: str) -> dict:
    """Return OTF, OTMA and the four filters with feedback, by name."""
    update = make_update(cost, ties)
    augmented = with_augmentation(update, pendulum.rod, std=setting["constraint_std"])
    # These two have no projection, so (12) does not matter.
    filters = {"OTF": update, "OTMA": augmented}
    for variant in VARIANTS:
        options = {**pendulum.projection, "variant": variant}
        plain = with_projection(update, pendulum.rod, **options)
        both = with_projection(augmented, pendulum.rod, **options)
        filters |= {f"OTNLeq_{variant}": plain, f"OTNLeqMA_{variant}": both}
    return {f"{cost}_{ties}_{name}": f for name, f in filters.items()}


UPDATES = {}
for _cost in COSTS:
    for _ties in TIES:
        UPDATES |= make_filters(_cost, _ties)
# Those of `starts`
for _name in ("OTF", "OTMA", "OTNLeqMA_particle", "OTNLeqMA_shift"):
    del UPDATES[f"distance_fixed_{_name}"]
# (13) with other deviations
for _std in STDS:
    UPDATES[f"OTMA_{round(1000 * _std)}"] = with_augmentation(
        pendulum.printed_etpf, pendulum.rod, std=_std
    )
SCORES = ("constraint", "farthest", "onset", "normal")


def score(members: np.ndarray, truth: np.ndarray) -> tuple[float, ...]:
    """Return those of `starts`, the onset, and the spread of lengths in the first second."""
    with np.errstate(all="ignore"):
        constraint, _, farthest = starts.score(members, truth)
        error = members.mean(axis=-2) - truth
        onset = pendulum.find_onset(np.hypot(error[:, 0], error[:, 1]))
        # Twenty steps of 0.05 s
        lengths = np.hypot(members[:20, :, 0], members[:20, :, 1])
    return constraint, farthest, onset, lengths.std(axis=1).mean()


def run_start(start: str, seed: np.random.SeedSequence) -> dict[str, float]:
    """Run all updates on one run, from one of the starts."""
    truth, observations, members = starts.draw_start(start, seed)
    analysis = pendulum.run_filters(observations, members, tuple(UPDATES), UPDATES)
    metrics = {}
    # All filters have the same observations and first members.
    for k, name in enumerate(UPDATES):
        values = zip(SCORES, score(analysis[:, k], truth), strict=True)
        metrics |= {f"{start}_{name}_{key}": float(value) for key, value in values}
    return metrics


def run_low(seed: np.random.SeedSequence) -> dict[str, float]:
    """Run OTF on a swing that is released from 30 degrees."""
    rng = np.random.default_rng(pendulum_seed(seed))
    truth, observations, members = pendulum.draw_data(rng, 30.0)
    # At this amplitude the printed equations keep the length's error bounded.
    analysis = pendulum.run_filters(observations, members, ("OTF",))[:, 0]
    values = zip(SCORES, score(analysis, truth), strict=True)
    return {f"low_OTF_{key}": float(value) for key, value in values}


def pendulum_seed(seed: np.random.SeedSequence) -> np.random.SeedSequence:
    """Return the seed of the start off the circle."""
    fresh_seed = np.random.SeedSequence(seed.entropy, spawn_key=seed.spawn_key)
    return fresh_seed.spawn(2)[0]


def trial(seed: np.random.SeedSequence) -> dict[str, float]:
    """Run both starts, and OTF released from 30 degrees."""
    return run_low(seed) | run_start("off", seed) | run_start("on", seed)


parameters = {name: np.asarray(setting[name]).tolist() for name in setting}
parameters |= {
    "costs": list(COSTS),
    "ties": list(TIES),
    "stds": list(STDS),
    "variants": list(VARIANTS),
}
CASES = (
    "low_OTF",
    *(f"{start}_{name}" for start in ("off", "on") for name in UPDATES),
)
columns = tuple(f"{case}_{key}" for case in CASES for key in SCORES)
code = (
    make_update,
    transport,
    make_filters,
    score,
    run_start,
    run_low,
    starts.score,
    starts.draw_start,
    starts.draw_on_circle,
    pendulum.draw_data,
    pendulum.run_filters,
)
seeds = starts.seeds
rtol = 1e-4
# A run that has lost the swing multiplies the last bit until it decides.
max_outliers = 14
