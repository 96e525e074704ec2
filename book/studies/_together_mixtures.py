"""Gaussian mixtures of many runs at once: partial-state fusion of chapter 7, rules C1 to C3.

A `MixtureFilter` of the library follows one run. `BatchedMixtures` does the same for
all runs, with arrays (*runs, agents, components, ...) in which a component of weight
zero fills an empty place; chapter 11 checks that both agree.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import KW_ONLY, dataclass
from typing import Any

import numpy as np

from distfilt import filters
from distfilt.gaussians.single import unscented_points
from distfilt.mixtures import nonnegative_least_squares, split_library
from distfilt.sensors import Sensor

Array = np.ndarray
Mixtures = tuple[Array, Array, Array]
"""Weights (..., L), means (..., L, d) and covariances (..., L, d, d)."""

SMALLEST_WEIGHT = 1e-9
"""Lighter components are dropped after an observation."""
STEP = np.sqrt(3.0)
"""Step of the divided differences, in standard deviations."""


@dataclass(frozen=True, eq=False, repr=False)
class BatchedMixturesState(filters.SensorState):
    """Weights (*runs, A, L), means (..., L, d) and covariances (..., L, d, d)."""

    means: Array
    weights: Array
    covs: Array
    belief_field = "means", (..., "A", "L", "d")


@dataclass(frozen=True, eq=False)
class BatchedMixtures(
    filters.SensorFilter[Any],
    filters.FusesBeliefs[Any],
    filters.SharesObservations[Any],
    filters.ExchangesAtIntervals[Any],
    filters.IsolatesRuns[Any],
):
    """Agents hold mixtures over [target; own position] and send the target's marginal.

    There are at most `n_components`, no fewer than three. A single component is split
    in three where the transition stretches it by more than `split_threshold`. Received
    mixtures are fused by `rule`, and all covariances are inflated afterwards.
    """

    _: KW_ONLY
    target_dim: int
    n_components: int = 3
    rule: str = "C3"
    split_threshold: float | None = None
    inflation: float = 1.0
    share_observations: bool = False

    state_class = BatchedMixturesState

    def initial_state(
        self, prior: Any, runs: tuple[int, ...], rng: Any
    ) -> dict[str, Any]:
        """Return one component, and places for more."""
        # The first place has the whole weight.
        mean, cov = prior
        leading = (*runs, self.n_agents, self.n_components)
        d = len(mean)
        one = np.eye(self.n_components)[0]
        return {
            "means": np.broadcast_to(mean, (*leading, d)),
            "weights": np.broadcast_to(one, leading),
            "covs": np.broadcast_to(cov, (*leading, d, d)),
        }

    def next_state(self, step: Any) -> Any:
        """Split, forecast, update, fuse, inflate."""
        t = step.state.t
        dt = step.dt
        belief = step.state.weights, step.state.means, step.state.covs
        if self.split_threshold is not None:
            jacobian = self.model.jacobian(belief[1], t, dt)
            belief = split_single(belief, jacobian, self.split_threshold)
        w, m, P = forecast(
            belief, lambda x: self.model.step(x, t, dt), self.model.Q(t, dt)
        )
        for agent, observations in enumerate(step.observations):
            sensor = self.sensors[agent]
            for observation in observations:
                if np.isnan(observation.value).all():
                    continue
                part = w[..., agent, :], m[..., agent, :, :], P[..., agent, :, :, :]
                part = update(part, observation.value, sensor)
                w[..., agent, :], m[..., agent, :, :], P[..., agent, :, :, :] = part
        w, m, P = self._fuse((w, m, P), step.channel)
        return step.end(weights=w, means=m, covs=self.inflation**2 * P)

    def _fuse(self, belief: Mixtures, channel: Any) -> Mixtures:
        """Send every agent's marginal; each agent fuses its inbox one mixture after another."""
        n = self.target_dim
        w, m, P = belief
        payloads = pack(w, m[..., :n], P[..., :n, :n])
        boxes = channel.broadcast([payloads[..., k, :] for k in range(self.n_agents)])
        inbox = [list(box.values()) for box in boxes]
        for turn in range(max(map(len, inbox))):
            # The agents that received at least turn + 1 mixtures fuse their next one together.
            agents = [k for k, box in enumerate(inbox) if len(box) > turn]
            x = np.stack([inbox[k][turn] for k in agents], axis=-2)
            other = unpack(x, self.n_components, n)
            own = w[..., agents, :], m[..., agents, :, :], P[..., agents, :, :, :]
            # After k mixtures each has the exponent 1 / (k + 1).
            fused = fuse(own, other, (turn + 1) / (turn + 2), self.rule)
            w[..., agents, :], m[..., agents, :, :], P[..., agents, :, :, :] = fused
        return w, m, P

    def summarize(self, state: Any) -> filters.Summary:
        """Return means and covariances of whole mixtures."""
        w = state.weights
        m = state.means
        mean = (w[..., None] * m).sum(axis=-2)
        x = m - mean[..., None, :]
        terms = state.covs + x[..., :, None] * x[..., None, :]
        cov = (w[..., None, None] * terms).sum(axis=-3)
        return filters.Summary(mean, np.diagonal(cov, axis1=-2, axis2=-1), cov)


def pack(w: Array, m: Array, P: Array) -> Array:
    """Return payloads (*runs, A, numbers): weights, means, upper triangles of covariances."""
    rows, columns = np.triu_indices(m.shape[-1])
    flat = (*w.shape[:-1], -1)
    parts = [w, m.reshape(flat), P[..., rows, columns].reshape(flat)]
    return np.concatenate(parts, -1)


def unpack(x: Array, components: int, n: int) -> Mixtures:
    """Return the mixtures of n variables in payloads."""
    w, m, entries = np.split(x, [components, components + components * n], axis=-1)
    m = m.reshape(*x.shape[:-1], components, n)
    entries = entries.reshape(*x.shape[:-1], components, -1)
    rows, columns = np.triu_indices(n)
    P = np.zeros((*m.shape, n))
    P[..., rows, columns] = entries
    P[..., columns, rows] = entries
    return w, m, P


# ------------------------------------------------------------------------- forecast and update


def split_single(belief: Mixtures, jacobian: Array, threshold: float) -> Mixtures:
    """Split single components in three, along the direction that the Jacobian stretches most."""
    w, m, P = (np.array(x) for x in belief)
    single = (w > 0).sum(axis=-1) == 1
    first = w[single].argmax(axis=-1)[:, None]
    mean = np.take_along_axis(m[single], first[..., None], axis=1)[:, 0]
    cov = np.take_along_axis(P[single], first[..., None, None], axis=1)[:, 0]
    slope = np.broadcast_to(jacobian, P.shape)[single]
    slope = np.take_along_axis(slope, first[..., None, None], axis=1)[:, 0]
    # Singular values of F L, with P = L Lᵀ: growth of standard deviations
    root = np.linalg.cholesky(cov)
    _, values, right = np.linalg.svd(slope @ root)
    stretched = values[:, 0] > threshold
    u = (root @ right[:, 0, :, None])[..., 0][stretched]
    # A singular vector's sign is arbitrary: its largest entry becomes positive.
    top = right[stretched, 0]
    largest = np.abs(top).argmax(axis=-1)[:, None]
    u = u * np.sign(np.take_along_axis(top, largest, axis=-1))
    weights, offsets = split_library()
    new_w = w[single]
    new_m = m[single]
    new_P = P[single]
    rows = np.flatnonzero(stretched)[:, None]
    new_w[stretched] = 0.0
    new_w[rows, np.arange(3)] = weights
    shifts = offsets[:, None] * u[:, None]
    new_m[rows, np.arange(3)] = mean[stretched][:, None] + shifts
    # Along u each of the three has 0.7 times the standard deviation.
    narrowed = cov[stretched] - (1 - 0.7**2) * u[:, :, None] * u[:, None, :]
    new_P[stretched] = narrowed[:, None]
    w[single] = new_w
    m[single] = new_m
    P[single] = new_P
    return w, m, P


def divided_differences(values: Array) -> tuple[Array, Array, Array]:
    """Return mean, and first and second differences as columns, of values at the points."""
    d = values.shape[-2] // 2
    centre = values[..., :1, :]
    plus = values[..., 1 : d + 1, :]
    minus = values[..., d + 1 :, :]
    even = plus + minus - 2 * centre
    # Mean by Stirling's interpolation of second order
    mean = centre[..., 0, :] + even.sum(axis=-2) / 6
    return mean, (plus - minus).mT / (2 * STEP), even.mT * np.sqrt(2.0) / 6


def difference_points(m: Array, root: Array) -> Array:
    """Return the points of divided differences: the mean, and a STEP along each root column."""
    return unscented_points(m, root, kappa=3.0 - m.shape[-1])[0]


def forecast(
    belief: Mixtures, transition: Callable[[Array], Array], noise: Array
) -> Mixtures:
    """Return the components after a transition with additive noise."""
    w, m, P = belief
    points = difference_points(m, np.linalg.cholesky(P))
    m, first, second = divided_differences(np.asarray(transition(points)))
    return w.copy(), m, first @ first.mT + second @ second.mT + noise


def update(belief: Mixtures, y: Array, sensor: Sensor) -> Mixtures:
    """Return the components after an observation (*runs, m), weighted by its likelihood."""
    w, m, P = belief
    root = np.linalg.cholesky(P)
    predicted = sensor.predict(difference_points(m, root))
    centre = predicted[..., 0, :]
    # Differences are taken from the first prediction, so that angles do not wrap.
    base = np.broadcast_to(centre[..., None, :], predicted.shape)
    mean, first, second = divided_differences(sensor.residual(predicted, base))
    observed = np.broadcast_to(y[..., None, :], centre.shape)
    innovation = sensor.residual(observed, centre) - mean
    S = first @ first.mT + second @ second.mT + sensor.noise_cov
    gain = root @ first.mT @ np.linalg.inv(S)
    # log N(y; h(m), S) of each component
    solved = np.linalg.solve(S, innovation[..., None])
    squares = (innovation[..., None, :] @ solved)[..., 0, 0]
    log_det = np.linalg.slogdet(2 * np.pi * S)[1]
    logs = log_weights(w) - 0.5 * (squares + log_det)
    m = m + (gain @ innovation[..., None])[..., 0]
    P = P - gain @ S @ gain.mT
    return normalize_logs(logs, SMALLEST_WEIGHT), m, 0.5 * (P + P.mT)


def log_weights(w: Array) -> Array:
    """Return the logarithms of weights, -inf for zero."""
    with np.errstate(divide="ignore"):
        return np.log(w)


def normalize_logs(logs: Array, smallest: float = 0.0) -> Array:
    """Return weights that sum to one; weights up to `smallest` become zero."""
    w = np.exp(logs - logs.max(axis=-1, keepdims=True))
    w = w / w.sum(axis=-1, keepdims=True)
    w = np.where(w > smallest, w, 0.0)
    return w / w.sum(axis=-1, keepdims=True)


def log_peaks(P: Array) -> Array:
    """Return the logarithms of the largest densities of Gaussians."""
    return -0.5 * np.linalg.slogdet(2 * np.pi * P)[1]


def component_log_densities(x: Array, m: Array, P: Array) -> Array:
    """Return the log-densities of components (..., L, n) at points (..., S, n), (..., S, L)."""
    difference = x[..., :, None, :] - m[..., None, :, :]
    precision = np.linalg.inv(P)[..., None, :, :, :]
    scaled = (precision @ difference[..., None])[..., 0]
    squares = (difference * scaled).sum(axis=-1)
    return log_peaks(P)[..., None, :] - 0.5 * squares


def log_density(x: Array, w: Array, m: Array, P: Array) -> Array:
    """Return the log-densities of mixtures at points (..., S, n), (..., S)."""
    terms = log_weights(w)[..., None, :] + component_log_densities(x, m, P)
    return np.logaddexp.reduce(terms, axis=-1)


# ---------------------------------------------------------------------------------------- fusion


def fuse(own: Mixtures, other: Mixtures, omega: float, rule: str) -> Mixtures:
    """Fuse a belief about [t; e], exponent omega, with another about t, exponent 1 - omega."""
    w, m, P = own
    w_b, m_b, P_b = other
    n = m_b.shape[-1]
    components = w.shape[-1]
    components_b = w_b.shape[-1]
    shape = (*w.shape[:-1], components * components_b)
    means, covs = fuse_pairs(own, other, omega)
    means = means.reshape(*shape, m.shape[-1])
    covs = covs.reshape(*shape, *P.shape[-2:])
    alive = (w[..., :, None] > 0) & (w_b[..., None, :] > 0)
    alive = alive.reshape(shape)
    # The exact density at the fused means: p(t)^(ω-1) q(t)^(1-ω) p(t, e)
    x = means[..., :n]
    logs = (omega - 1) * log_density(x, w, m[..., :n], P[..., :n, :n])
    logs = logs + (1 - omega) * log_density(x, w_b, m_b, P_b)
    if rule == "C1":
        # Only the component that a pair comes from counts in p(t, e).
        source = np.repeat(np.arange(components), components_b)
        densities = component_log_densities(means, m, P)
        own_density = densities[..., np.arange(source.size), source]
        logs = logs + log_weights(w)[..., source] + own_density
    else:
        logs = logs + log_density(means, w, m, P)
    logs = np.where(alive, logs, -np.inf)
    peaks = log_peaks(covs)
    if rule == "C3":
        logs = interpolate_heights(logs, means, covs, peaks, alive)
    weights = normalize_logs(np.where(alive, logs - peaks, -np.inf))
    return merge(weights, means, covs, components)


def fuse_pairs(own: Mixtures, other: Mixtures, omega: float) -> tuple[Array, Array]:
    """Return means and covariances of all pairs of components, the own ones first."""
    _, m, P = own
    _, m_b, P_b = other
    n = m_b.shape[-1]
    d = m.shape[-1]
    # Information of the target in both beliefs
    A = np.linalg.inv(P[..., :n, :n])
    A_b = np.linalg.inv(P_b)
    # J = ω A + (1 - ω) B of each pair
    other_term = (1 - omega) * A_b[..., None, :, :, :]
    J = omega * A[..., :, None, :, :] + other_term
    difference = m_b[..., None, :, :] - m[..., :, None, :n]
    shift = np.linalg.solve(J, other_term @ difference[..., None])
    target = np.broadcast_to(np.linalg.inv(J), J.shape)
    # The ego follows the target by regression: e = G t + remainder, G = P_et P_tt⁻¹.
    gain = (P[..., n:, :n] @ A)[..., :, None, :, :]
    remainder = P[..., n:, n:] - P[..., n:, :n] @ A @ P[..., :n, n:]
    shift = np.concatenate([shift, gain @ shift], axis=-2)[..., 0]
    covs = np.empty((*J.shape[:-2], d, d))
    covs[..., :n, :n] = target
    covs[..., n:, :n] = gain @ target
    covs[..., :n, n:] = covs[..., n:, :n].mT
    covs[..., n:, n:] = remainder[..., :, None, :, :] + gain @ target @ gain.mT
    return shift + m[..., :, None, :], 0.5 * (covs + covs.mT)


def interpolate_heights(
    logs: Array, means: Array, covs: Array, peaks: Array, alive: Array
) -> Array:
    """Return log-heights for which the mixture takes given values at its means (rule C3)."""
    # Heights h with Σ h_j exp(-½ d²ᵢⱼ) = value at the mean of i
    values = np.exp(logs - logs.max(axis=-1, keepdims=True))
    densities = component_log_densities(means, means, covs)
    matrix = np.exp(densities - peaks[..., None, :])
    heights = np.zeros(logs.shape)
    for row in np.ndindex(logs.shape[:-1]):
        indices = np.flatnonzero(alive[row])
        part = matrix[row][np.ix_(indices, indices)]
        solution = nonnegative_least_squares(part, values[row][indices])
        heights[(*row, indices)] = solution
    return log_weights(heights)


# ------------------------------------------------------------------------------------- reduction


def merge_costs(w: Array, m: Array, P: Array, dets: Array, i: Any, j: Any) -> Array:
    """Return Runnalls' bound on the divergence of merging components i and j, in batches."""
    batch = np.arange(len(w))[:, None]
    w_i = w[batch, i]
    w_j = w[batch, j]
    total = w_i + w_j
    share = np.divide(w_i, total, out=np.full(total.shape, 0.5), where=total > 0)
    cov = merge_covariances(share, m[batch, i], m[batch, j], P[batch, i], P[batch, j])
    # 2 B = (w_i + w_j) log|P_ij| - w_i log|P_i| - w_j log|P_j|
    bound = total * np.linalg.slogdet(cov)[1]
    return 0.5 * (bound - w_i * dets[batch, i] - w_j * dets[batch, j])


def merge_covariances(
    share: Array, m_i: Array, m_j: Array, P_i: Array, P_j: Array
) -> Array:
    """Return the covariance of two merged components, the first with a share of the weight."""
    # Within both, and between their means
    x = m_j - m_i
    a = share[..., None, None]
    between = a * (1 - a) * x[..., :, None] * x[..., None, :]
    return a * P_i + (1 - a) * P_j + between


def cost_table(w: Array, m: Array, P: Array, dets: Array) -> Array:
    """Return the costs of all pairs i < j, (B, n, n); infinite elsewhere."""
    batches, n = w.shape
    # Every pair once
    rows, columns = np.triu_indices(n, 1)
    i = np.broadcast_to(rows, (batches, rows.size))
    j = np.broadcast_to(columns, (batches, rows.size))
    table = np.full((batches, n, n), np.inf)
    table[np.arange(batches)[:, None], i, j] = merge_costs(w, m, P, dets, i, j)
    empty = w == 0
    table[empty[:, :, None] | empty[:, None, :]] = np.inf
    return table


def merge(w: Array, m: Array, P: Array, size: int) -> Mixtures:
    """Merge the cheapest pair of each mixture until `size` components are left."""
    leading = w.shape[:-1]
    n, d = m.shape[-2:]
    w = w.reshape(-1, n).copy()
    m = m.reshape(-1, n, d).copy()
    P = P.reshape(-1, n, d, d).copy()
    dets = np.linalg.slogdet(P)[1]
    table = cost_table(w, m, P, dets)
    while True:
        rows = np.flatnonzero((w > 0).sum(axis=-1) > size)
        if not rows.size:
            break
        i, j = cheapest_pairs(table[rows])
        total = w[rows, i] + w[rows, j]
        share = w[rows, i] / total
        P[rows, i] = merge_covariances(
            share, m[rows, i], m[rows, j], P[rows, i], P[rows, j]
        )
        m[rows, i] += (1 - share)[:, None] * (m[rows, j] - m[rows, i])
        w[rows, i] = total
        w[rows, j] = 0.0
        dets[rows, i] = np.linalg.slogdet(P[rows, i])[1]
        renew_costs(table, rows, i, j, (w, m, P, dets))
    batch = np.arange(len(w))[:, None]
    # Components with a weight come first.
    order = np.argsort(w == 0, axis=-1, kind="stable")[:, :size]
    w = w[batch, order]
    w = w / w.sum(axis=-1, keepdims=True)
    m = m[batch, order]
    P = P[batch, order]
    return (
        w.reshape(*leading, size),
        m.reshape(*leading, size, d),
        P.reshape(*leading, size, d, d),
    )


def cheapest_pairs(table: Array) -> tuple[Array, Array]:
    """Return the pair (i, j) of least cost in each row of a table."""
    flat = table.reshape(len(table), -1)
    least = flat.min(axis=-1, keepdims=True)
    # The first of the pairs that cost the same, so that rounding does not choose.
    equal = flat <= least + 1e-12 + 1e-9 * np.abs(least)
    i, j = np.divmod(equal.argmax(axis=-1), table.shape[-1])
    return i, j


def renew_costs(
    table: Array, rows: Array, i: Array, j: Array, parts: tuple[Array, ...]
) -> None:
    """Update a table in place after j was merged into i."""
    w, m, P, dets = (x[rows] for x in parts)
    n = table.shape[-1]
    others = np.broadcast_to(np.arange(n), (rows.size, n))
    costs = merge_costs(w, m, P, dets, i[:, None], others)
    costs[(w == 0) | (others == i[:, None])] = np.inf
    below = others < i[:, None]
    table[rows, j, :] = np.inf
    table[rows, :, j] = np.inf
    # Pairs stand above the diagonal: (i, k) for k > i, and (k, i) for k < i.
    table[rows, i, :] = np.where(below, np.inf, costs)
    column = table[rows, :, i]
    table[rows, :, i] = np.where(below, costs, column)
