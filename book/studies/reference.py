"""Bayes estimates for Table II of Grange et al., by a Rao-Blackwellised particle filter.

Only the angle is not linear, and the motion along the orbit's normal does not couple to
the rest. So particles hold (z, vz), drawn given the velocity that is read; each carries
a Gaussian of the plane (x, y, vx, vy) of its own, which takes positions and velocities
as a Kalman filter does, and the angle's likelihood of y by quadrature. All particles
share the plane's covariance, the mean of theirs: that is all that is approximated. Two
filters run with draws of their own; half the distance of their means tells how much
chance is left.

On the data of Fig. 1 this is a reference: there every truth starts at one state, which
no belief knows. Where truths are drawn from the prior no estimate has a smaller mean
squared error: a bound. The repaired filter runs on these truths as well, and the
iterated extended filter, damped, on those of Fig. 1.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
import _satellites as satellites

from distfilt.gaussians import condition
from distfilt.linalg import factor
from distfilt.metrics import nees
from distfilt.models import simulate
from distfilt.sensors import stack
from distfilt.updates import resample

NAME = "reference"
PAPER = "grange"
BATCH = 5
SETUP = satellites.setup("table-2")
PLANE = [0, 1, 3, 4]
NORMAL = [2, 5]
STEPS = 20
HALVINGS = 12
ENOUGH = 1e-6
APPLIES = [(a.kind, list(a.dims)) for a in SETUP.scenario.agents] == [
    ("component", [0, 1]),
    ("line_angle", [1, 2]),
    ("component", [3, 4, 5]),
]
columns = [
    *(
        f"{name}_{quantity}_{r}"
        for name in ("reference", "bound")
        for quantity in ("mse", "nees", "chance", "share")
        for r in range(BATCH)
    ),
    *(f"damped_{quantity}_{r}" for quantity in ("mse", "nees") for r in range(BATCH)),
    *satellites.score_columns(SETUP, "exact", BATCH, each_agent=False),
    *satellites.time_columns(SETUP, "reference"),
]
parameters = {"batch": BATCH, "seed": 2024, "particles": 2400, "nodes": 7}
seeds = np.random.SeedSequence(satellites.SEED).spawn(SETUP.runs // BATCH)
scenarios = (SETUP.scenario,)
rtol = 1e-4


def run_particles(
    seen: list[np.ndarray], rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Run two filters; return means (T, 2, R, 6), covariances (T, R, 6, 6), effective shares."""
    # Two filters with half of the particles each
    n = parameters["particles"] // 2
    lead = (2, seen[0].shape[1])
    dt = float(SETUP.times[0])
    stds = [s.noise_cov[0, 0] for s in SETUP.sensors]
    f = SETUP.model.F(dt)
    q = SETUP.model.Q(0.0, dt)
    flat = np.ix_(PLANE, PLANE)
    up = np.ix_(NORMAL, NORMAL)
    # Positions of A and the plane's velocities of C are linear in the plane.
    in_plane = np.concatenate([seen[0], seen[2][..., :2]], axis=-1)
    noise = np.diag([stds[0]] * 2 + [stds[2]] * 2)
    m = np.broadcast_to(SETUP.prior[0][PLANE], (*lead, n, 4))
    p = np.broadcast_to(SETUP.prior[1][flat], (*lead, 4, 4))
    z = np.broadcast_to(SETUP.prior[0][NORMAL], (*lead, n, 2))
    # The prior of (z, vz) after the first step
    wide = f[up] @ SETUP.prior[1][up] @ f[up].T
    log = np.zeros((*lead, n))
    means = []
    covs = []
    shares = []
    for k in range(SETUP.times.size):
        # The plane: a Kalman step with the gain that all particles share.
        m = m @ f[flat].T
        p = f[flat] @ p @ f[flat].T + q[flat]
        gap = in_plane[k][:, None] - m
        s = p + noise
        log = log - 0.5 * (gap * np.linalg.solve(s, gap.mT).mT).sum(axis=-1)
        # K = P S⁻¹, by a solve, and P⁺ = P - K P
        gain = np.linalg.solve(s, p).mT
        m = m + gap @ gain.mT
        p = p - gain @ p
        # Along the normal: drawn given the velocity; at first the prior is part of the noise.
        spread = q[up] + (wide if k == 0 else 0.0)
        z = z @ f[up].T
        s = spread[1, 1] + stds[2]
        gap = seen[2][k, :, 2, None] - z[..., 1]
        log = log - 0.5 * gap**2 / s
        z = z + gap[..., None] * spread[:, 1] / s
        # Cov(z, vz | velocity) = C - c cᵀ / s
        root = factor(spread - np.outer(spread[:, 1], spread[1]) / s)
        m, z, log = resample_poor(m, z, log, rng)
        z = z + rng.standard_normal(z.shape) @ root.T
        m, p, log = update_angle(m, p, z, log, seen[1][k][..., None], stds[1])
        # Moments of both filters' particles, and of the plane's Gaussians
        w = normalize_logs(log)
        x = np.concatenate([m, z], axis=-1)
        means.append(np.einsum("hrn,hrnj->hrj", w, x))
        anomalies = x - means[-1].mean(axis=0)[:, None]
        cov = np.einsum("hrni,hrnj->rij", 0.5 * w[..., None] * anomalies, anomalies)
        cov[:, :4, :4] += p.mean(axis=0)
        covs.append(cov)
        # Effective sample size 1 / Σw² as a share of the particles
        shares.append(1 / (w**2).sum(axis=-1).max(axis=0) / n)
    # Components in the order of the state again
    back = np.argsort(PLANE + NORMAL)
    return (
        np.array(means)[..., back],
        np.array(covs)[..., back, :][..., back],
        np.array(shares),
    )


def resample_poor(
    m: np.ndarray, z: np.ndarray, log: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Resample where the effective sample size is below one half."""
    w = normalize_logs(log)
    n = log.shape[-1]
    # Effective sample size 1 / Σw² below n / 2
    poor = (w**2).sum(axis=-1) > 2 / n
    if poor.any():
        index = resample(w[poor].reshape(-1, n), rng=rng)
        m = m.copy()
        z = z.copy()
        log = log.copy()
        m[poor] = np.take_along_axis(m[poor], index[..., None], axis=-2)
        z[poor] = np.take_along_axis(z[poor], index[..., None], axis=-2)
        log[poor] = 0.0
    return m, z, log


def update_angle(
    m: np.ndarray,
    p: np.ndarray,
    z: np.ndarray,
    log: np.ndarray,
    angle: np.ndarray,
    noise: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Update by the angle arctan(z/y): weights, and mean and variance of y."""
    nodes, shares = np.polynomial.hermite_e.hermegauss(parameters["nodes"])
    # Nodes of Gauss-Hermite quadrature over y
    variance = p[..., 1, 1]
    steps = np.sqrt(variance)[..., None, None] * nodes
    gap = angle - np.arctan2(z[..., :1], m[..., 1:2] + steps)
    # The angle of a line has period π.
    gap = (gap + np.pi / 2) % np.pi - np.pi / 2
    # Posterior shares of the nodes, their sum and their moments
    parts = np.exp(-0.5 * gap**2 / noise) * (shares / shares.sum())
    total = np.maximum(parts.sum(axis=-1), 1e-300)
    shift = (parts * steps).sum(axis=-1) / total
    variance_left = (parts * steps**2).sum(axis=-1) / total - shift**2
    # The likelihood of the angle is the integral over y.
    log = log + np.log(total)
    # The other components follow y by regression.
    slope = p[..., 1] / variance[..., None]
    # All particles share the mean of their variances that are left.
    less = (normalize_logs(log) * variance_left).sum(axis=-1) - variance
    p = p + less[..., None, None] * slope[..., None] * slope[..., None, :]
    return m + shift[..., None] * slope[..., None, :], p, log


def cost(
    gap: np.ndarray, prior: np.ndarray, residual: np.ndarray, noise: np.ndarray
) -> np.ndarray:
    """Return minus the log-posterior, (R,): misfit to the forecast and to the observations."""
    return squared_distances(gap, prior) + squared_distances(
        residual, np.broadcast_to(noise, (len(gap), *noise.shape))
    )


def squared_distances(gap: np.ndarray, cov: np.ndarray) -> np.ndarray:
    """Squared lengths (R,) in units of covariances (R, d, d)."""
    return np.einsum("ri,ri->r", gap, np.linalg.solve(cov, gap[..., None])[..., 0])


def run_damped(means: np.ndarray, observations: np.ndarray) -> list[np.ndarray]:
    """Run the iterated extended filter; a step that does not lower `cost` is halved."""
    sensor = stack(SETUP.sensors)
    s = SETUP
    cov = np.broadcast_to(s.prior[1], (*means.shape, means.shape[-1]))
    errors = []
    covs = []
    t0 = 0.0
    for t, y in zip(s.times, observations, strict=True):
        # Forecast by the model's Jacobian
        slope = s.model.jacobian(means, t0, t - t0)
        cov = slope @ cov @ slope.mT + s.model.Q(t0, t - t0)
        means = x = s.model.step(means, t0, t - t0)
        t0 = t

        def value(x: np.ndarray, y: np.ndarray = y, means=means, cov=cov) -> np.ndarray:
            return cost(
                x - means, cov, sensor.residual(y, sensor.predict(x)), sensor.noise_cov
            )

        # Gauss-Newton steps, halved until the cost falls
        lowest_cost = value(x)
        for _ in range(STEPS):
            h = sensor.jacobian(x)
            # Innovation of the sensor linearized at x: y - h(x) - H (m - x)
            expected = np.einsum("...ij,...j->...i", h, means - x)
            gap = sensor.residual(y, sensor.predict(x)) - expected
            full_step = condition(means, cov, gap, h, sensor.noise_cov)[0] - x
            for _ in range(HALVINGS):
                after = value(x + full_step)
                worse = after > lowest_cost
                if not worse.any():
                    break
                full_step[worse] /= 2
            # A step that never lowers the cost is not made.
            full_step[worse] = 0.0
            after[worse] = lowest_cost[worse]
            x = x + full_step
            decrease = lowest_cost - after
            lowest_cost = after
            if decrease.max() < ENOUGH:
                break
        # The covariance of the sensor linearized at the last x
        h = sensor.jacobian(x)
        cov = condition(means, cov, np.zeros_like(y), h, sensor.noise_cov)[1]
        means = x
        errors.append(means)
        covs.append(cov)
    return [np.array(errors), np.array(covs)]


def normalize_logs(log: np.ndarray) -> np.ndarray:
    """Weights that sum to one over the last axis."""
    w = np.exp(log - log.max(axis=-1, keepdims=True))
    return np.asarray(w / w.sum(axis=-1, keepdims=True))


def score_means(
    name: str, truth: np.ndarray, estimates: tuple[np.ndarray, np.ndarray, np.ndarray]
) -> dict[str, float]:
    """Return error, NEES/d, the error's share by chance, effective sample size; over time."""
    means, covs, shares = estimates
    late = SETUP.settled
    # The estimate is the mean of both filters.
    gap = means.mean(axis=1) - truth
    error = (gap**2).sum(axis=-1)
    score = nees(means.mean(axis=1), covs, truth) / gap.shape[-1]
    # Half the distance of two independent filters' means estimates the Monte Carlo error.
    chance = ((means[:, 0] - means[:, 1]) ** 2).sum(axis=-1) / 4
    values = satellites.time_series(name, error, score) if name == "reference" else {}
    for r in range(BATCH):
        values[f"{name}_mse_{r}"] = float(error[late, r].mean())
        values[f"{name}_nees_{r}"] = float(score[late, r].mean())
        values[f"{name}_chance_{r}"] = float(chance[late, r].mean())
        values[f"{name}_share_{r}"] = float(shares[late, r].min())
    return values


def simulate_from_prior(
    rng: np.random.Generator,
) -> tuple[np.ndarray, list[np.ndarray]]:
    """Draw a batch of truths (T, R, 6) that start from the prior, and observations."""
    start = rng.multivariate_normal(*SETUP.prior, size=BATCH)
    truth = simulate(SETUP.model, start, SETUP.times, rng=rng)
    return truth, [q.observe(truth, rng=rng) for q in SETUP.sensors]


def trial(seed: np.random.SeedSequence) -> dict[str, float]:
    """A batch of runs on the data of Fig. 1, and one whose truths are drawn from the prior."""
    if not APPLIES:  # a reader's sensors: there is no such split of the observations
        return dict.fromkeys(columns, float("nan"))
    for_data, _ = seed.spawn(2)
    for_particles, for_prior, for_filters = seed.spawn(3)
    rng = np.random.default_rng(for_particles)
    truth, seen = satellites.draw_data(SETUP, np.random.default_rng(for_data), (BATCH,))
    values = score_means("reference", truth, run_particles(seen, rng))
    # The damped iterated filter on the same data
    first = np.broadcast_to(SETUP.prior[0], truth.shape[1:])
    estimates = run_damped(first, np.concatenate(seen, axis=-1))
    late = SETUP.settled
    for r in range(BATCH):
        values[f"damped_mse_{r}"] = float(
            ((estimates[0] - truth) ** 2).sum(axis=-1)[late, r].mean()
        )
        score = nees(estimates[0][:, r], estimates[1][:, r], truth[:, r])[late].mean()
        values[f"damped_nees_{r}"] = float(score) / truth.shape[-1]
    # Truths from the prior: the posterior mean is a bound here.
    truth, seen = simulate_from_prior(np.random.default_rng(for_prior))
    values |= score_means("bound", truth, run_particles(seen, rng))
    result = satellites.run_filter(
        SETUP, satellites.better_filter(SETUP, "exact"), for_filters, truth, seen
    )
    return values | satellites.score_runs(SETUP, "exact", result, each_agent=False)


def part(seed: np.random.SeedSequence) -> dict[str, float]:
    """The reference alone, as in the trial, for chapter 4 to run again."""
    for_data, _ = seed.spawn(2)
    rng = np.random.default_rng(seed.spawn(3)[0])
    truth, seen = satellites.draw_data(SETUP, np.random.default_rng(for_data), (BATCH,))
    return score_means("reference", truth, run_particles(seen, rng))


code = (
    run_particles,
    resample_poor,
    update_angle,
    cost,
    squared_distances,
    run_damped,
    normalize_logs,
    score_means,
    simulate_from_prior,
    satellites.draw_data,
    satellites.better_filter,
)
