"""Lorenz-63 with maps of three orders and a nearly exact particle filter, for chapter 3.

All three components are observed through noise of variance 4, every 0.1 units of time.
Each trial has one truth, one series of observations and one set of first members for
all filters. The particle filter is nearly exact. It shows how small an error can be.
"""

from __future__ import annotations

from functools import partial

import numpy as np

from distfilt.models import lorenz63, simulate
from distfilt.triangular import affine, separable
from distfilt.updates import transport_map_update

NAME = "lorenz-63"
PAPER = "grange"

MEMBERS = (100, 400, 1000)
DT = 0.1
STEPS = 150
BURN = 30
VARIANCE = 4.0
# The penalty of coefficients, chosen on other seeds.
PENALTY = 0.01
MAPS = {
    "affine": affine.fit,
    "one": partial(separable.fit, order=1, regularisation=PENALTY),
    "two": partial(separable.fit, order=2, regularisation=PENALTY),
}
PARTICLES = 20_000
# The kernel's bandwidth after resampling, in units of the particles' spread.
BANDWIDTH = 0.05


def trial(seed: np.random.SeedSequence) -> dict[str, float]:
    """Errors and spreads of every map and size, and of particles, averaged over time."""
    rng, source = (np.random.default_rng(s) for s in seed.spawn(2))
    model = lorenz63(step=0.02)
    start = rng.standard_normal(3) + [1.5, -1.5, 25.5]
    times = DT * np.arange(1, 101 + STEPS)
    # The first hundred times bring the state onto the attractor.
    path = simulate(model, start, times, rng=rng)
    first = path[99]
    truth = path[100:]
    # y = x + ζ with ζ ~ N(0, 4 I)
    seen = truth + np.sqrt(VARIANCE) * rng.standard_normal(truth.shape)
    cloud = first + np.sqrt(VARIANCE) * rng.standard_normal((MEMBERS[-1], 3))
    draws = source.spawn(len(MEMBERS))
    values = {}
    for n, stream in zip(MEMBERS, draws, strict=True):
        state = stream.bit_generator.state
        for name, fit in MAPS.items():
            # All maps of one size draw the same numbers.
            stream.bit_generator.state = state
            values.update(scores(f"{name}_{n}", fit, cloud[:n], truth, seen, stream))
    # Two particle filters differ by their draws alone.
    means = []
    for name, stream in zip(("particles", "again"), source.spawn(2), strict=True):
        path_of_means, results = particle_scores(name, first, truth, seen, stream)
        values.update(results)
        means.append(path_of_means[BURN:])
    values["particles_difference"] = root_mean_square(means[0] - means[1]).mean()
    return values


def root_mean_square(gaps):
    """Return the root of the mean square over the components, the last axis."""
    return np.sqrt((gaps**2).mean(axis=-1))


def scores(name, fit, members, truth, seen, rng):
    """Return means over time of a filter's error, its spread, and a member's error.

    The last puts a member in the place of the truth: its distance from the mean of the
    others. If truth and members are draws from one distribution, it is the error.
    """
    model = lorenz63(step=0.02)
    errors = []
    spreads = []
    member_errors = []
    noise = VARIANCE * np.eye(3)
    n = len(members)
    for k, y in enumerate(seen):
        members = model.step(members, 0.0, DT)
        members = transport_map_update(members, members, y, noise, rng=rng, fit=fit)
        if k >= BURN:
            mean = members.mean(axis=0)
            errors.append(root_mean_square(mean - truth[k]))
            spreads.append(np.sqrt(members.var(axis=0, ddof=1).mean()))
            # x_j - mean of the others = (x_j - mean) n / (n - 1)
            gaps = (members - mean) * n / (n - 1)
            member_errors.append(root_mean_square(gaps).mean())
    return {
        f"{name}_rmse": np.mean(errors),
        f"{name}_spread": np.mean(spreads),
        f"{name}_member": np.mean(member_errors),
    }


def particle_scores(name, first, truth, seen, rng):
    """Return the means of a bootstrap particle filter over time, and its scores."""
    model = lorenz63(step=0.02)
    particles = first + np.sqrt(VARIANCE) * rng.standard_normal((PARTICLES, 3))
    log_weights = np.zeros(PARTICLES)
    means = []
    spreads = []
    member_errors = []
    for y in seen:
        particles = model.step(particles, 0.0, DT)
        # log w += log N(y; x, 4 I), up to a constant
        log_weights -= 0.5 * ((y - particles) ** 2).sum(axis=-1) / VARIANCE
        weights = np.exp(log_weights - log_weights.max())
        weights /= weights.sum()
        mean = weights @ particles
        gaps = particles - mean
        means.append(mean)
        spreads.append(np.sqrt((weights @ gaps**2).mean()))
        member_errors.append(weights @ root_mean_square(gaps))
        # Resample when the effective size 1 / Σ w² falls below half.
        if (weights**2).sum() * PARTICLES > 2:
            particles = resample_with_kernel(particles, weights, rng)
            log_weights = np.zeros(PARTICLES)
    means = np.array(means)
    errors = root_mean_square(means - truth)
    results = {
        f"{name}_rmse": errors[BURN:].mean(),
        f"{name}_spread": np.mean(spreads[BURN:]),
        f"{name}_member": np.mean(member_errors[BURN:]),
    }
    return means, results


def resample_with_kernel(particles, weights, rng):
    """Resample systematically, then move copies by a kernel that keeps mean and covariance.

    The model has no noise that would separate copies. With bandwidth h, copies are drawn
    to the mean by √(1 - h²) and moved by N(0, h² C), C the particles' covariance.

    J. Liu and M. West, in Sequential Monte Carlo Methods in Practice (2001) 197-223.
    """
    n = len(particles)
    # One uniform number for n strata of the cumulative weights.
    positions = (np.arange(n) + rng.random()) / n
    chosen = np.minimum(np.searchsorted(np.cumsum(weights), positions), n - 1)
    mean = weights @ particles
    gaps = particles - mean
    cov = (gaps * weights[:, None]).T @ gaps
    draws = rng.standard_normal(particles.shape) @ np.linalg.cholesky(cov).T
    return mean + np.sqrt(1 - BANDWIDTH**2) * gaps[chosen] + BANDWIDTH * draws


parameters = {
    "members": list(MEMBERS),
    "dt": DT,
    "steps": STEPS,
    "burn": BURN,
    "variance": VARIANCE,
    "penalty": PENALTY,
    "maps": list(MAPS),
    "particles": PARTICLES,
    "bandwidth": BANDWIDTH,
}
filters = (*(f"{m}_{n}" for n in MEMBERS for m in MAPS), "particles", "again")
columns = (
    *(f"{f}_{score}" for f in filters for score in ("rmse", "spread", "member")),
    "particles_difference",
)
code = (root_mean_square, scores, particle_scores, resample_with_kernel)
seeds = np.random.SeedSequence(363).spawn(60)
rtol = 1e-6
