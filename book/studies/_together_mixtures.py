"""Mixtures of a few Gaussians for many runs at once: chapter 7's fusion, C1 to C3, for chapter 11.

A `MixtureFilter` of the library follows one run. `Mixtures` does the same for all runs, with arrays
(*runs, agents, mixands, ...) in which a mixand of no weight fills an empty place; chapter 11 checks
that both agree.
"""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass
from typing import Any

import numpy as np

from distfilt import filters
from distfilt.gaussians.single import unscented_points
from distfilt.mixtures.fusion import nonnegative_least_squares
from distfilt.mixtures.splitting import split_library

Array = np.ndarray
# Mixands lighter than this are left out after a reading.
LEAST = 1e-9
STEP = np.sqrt(3.0)


@dataclass(frozen=True, eq=False, repr=False)
class MixturesState(filters.SensorState):
    """Weights (*runs, A, L), means (..., L, d) and covariances (..., L, d, d) of mixands."""

    means: Array
    weights: Array
    covs: Array
    belief_field = "means", (..., "A", "L", "d")


@dataclass(frozen=True, eq=False)
class Mixtures(filters.Filter):
    """Agents that hold mixtures over [target; own place], and tell of the target's `size` parts.

    There are at most `mixands`, which is no less than three: one is split in three where the flow
    stretches it beyond `stretch`, if it is alone. After an exchange, by `rule`, all are widened.
    """

    _: KW_ONLY
    size: int
    mixands: int = 3
    rule: str = "C3"
    stretch: float | None = None
    inflation: float = 1.0
    share_observations: bool = False

    state_class = MixturesState
    unsupported = {"lag": "a mixture filter keeps no past"}

    def initial_state(
        self, prior: Any, runs: tuple[int, ...], rng: Any
    ) -> dict[str, Any]:
        """One mixand, and places for more."""
        mean, cov = prior
        lead = (*runs, self.n_agents, self.mixands)
        d = len(mean)
        weights = np.broadcast_to(np.eye(self.mixands)[0], lead)
        covs = np.broadcast_to(cov, (*lead, d, d))
        return {
            "means": np.broadcast_to(mean, (*lead, d)),
            "weights": weights,
            "covs": covs,
        }

    def next_state(self, step: Any) -> Any:
        """Split, forecast, read, tell, fuse, widen."""
        belief = step.state.weights, step.state.means, step.state.covs
        t = step.state.t
        dt = step.dt
        if self.stretch is not None:
            jacobian = self.model.jacobian(belief[1], t, dt)
            belief = split(belief, jacobian, self.stretch)
        w, m, P = moved(
            belief, lambda x: self.model.step(x, t, dt), self.model.Q(t, dt)
        )
        for agent, said in enumerate(step.observations):
            for reading in (r for r in said if not np.isnan(r.value).all()):
                part = w[..., agent, :], m[..., agent, :, :], P[..., agent, :, :, :]
                part = updated(part, reading.value, self.sensors[agent])
                w[..., agent, :], m[..., agent, :, :], P[..., agent, :, :, :] = part
        w, m, P = self.told((w, m, P), step.channel)
        return step.end(weights=w, means=m, covs=self.inflation**2 * P)

    def told(self, belief: Any, channel: Any) -> Any:
        """Every agent fuses what it hears, one belief after another."""
        n = self.size
        few = self.mixands
        (w, m, P) = belief
        rows, columns = np.triu_indices(n)
        flat = (*w.shape[:-1], -1)
        said = np.concatenate(
            [w, m[..., :n].reshape(flat), P[..., rows, columns].reshape(flat)], -1
        )
        inbox = [
            list(box.values())
            for box in channel.broadcast(
                [said[..., k, :] for k in range(self.n_agents)]
            )
        ]
        for turn in range(max(map(len, inbox))):
            here = [k for k, box in enumerate(inbox) if len(box) > turn]
            x = np.stack([inbox[k][turn] for k in here], axis=-2)
            other_w, other_m, entries = np.split(x, [few, few + few * n], axis=-1)
            other_m = other_m.reshape(*x.shape[:-1], few, n)
            entries = entries.reshape(*x.shape[:-1], few, -1)
            other_P = np.zeros((*other_m.shape, n))
            other_P[..., rows, columns] = other_P[..., columns, rows] = entries
            own = w[..., here, :], m[..., here, :, :], P[..., here, :, :, :]
            fused = fuse(
                own, (other_w, other_m, other_P), (turn + 1) / (turn + 2), self.rule
            )
            w[..., here, :], m[..., here, :, :], P[..., here, :, :, :] = fused
        return w, m, P

    def summarize(self, state: Any) -> Any:
        """Means and covariances of whole mixtures."""
        w = state.weights
        m = state.means
        mean = (w[..., None] * m).sum(axis=-2)
        gap = m - mean[..., None, :]
        each = state.covs + gap[..., :, None] * gap[..., None, :]
        cov = (w[..., None, None] * each).sum(axis=-3)
        return filters.Summary(mean, np.diagonal(cov, axis1=-2, axis2=-1), cov)


def split(belief: Any, jacobian: Array, stretch: float) -> Any:
    """Three mixands in place of a single one, along the direction that is stretched most."""
    w, m, P = (np.array(x) for x in belief)
    some = (w > 0).sum(axis=-1) == 1
    first = w[some].argmax(axis=-1)[:, None]
    mean = np.take_along_axis(m[some], first[..., None], axis=1)[:, 0]
    cov = np.take_along_axis(P[some], first[..., None, None], axis=1)[:, 0]
    slope = np.broadcast_to(jacobian, P.shape)[some]
    slope = np.take_along_axis(slope, first[..., None, None], axis=1)[:, 0]
    root = np.linalg.cholesky(cov)
    _, values, right = np.linalg.svd(slope @ root)
    far = values[:, 0] > stretch
    u = (root @ right[:, 0, :, None])[..., 0][far]
    # A singular vector's sign is arbitrary.
    top = right[far, 0]
    u = u * np.sign(
        np.take_along_axis(top, np.abs(top).argmax(axis=-1)[:, None], axis=-1)
    )
    weights, places = split_library()
    new_w = w[some]
    new_m = m[some]
    new_P = P[some]
    rows = np.flatnonzero(far)[:, None]
    new_w[far] = 0.0
    new_w[rows, np.arange(3)] = weights
    new_m[rows, np.arange(3)] = mean[far][:, None] + places[:, None] * u[:, None]
    less = cov[far] - (1 - 0.7**2) * u[:, :, None] * u[:, None, :]
    new_P[far] = less[:, None]
    w[some] = new_w
    m[some] = new_m
    P[some] = new_P
    return w, m, P


def differences(values: Array) -> tuple[Array, Array, Array]:
    """Mean, and first and second differences as columns, of a function's values at points."""
    d = values.shape[-2] // 2
    centre = values[..., :1, :]
    plus = values[..., 1 : d + 1, :]
    minus = values[..., d + 1 :, :]
    even = plus + minus - 2 * centre
    mean = centre[..., 0, :] + even.sum(axis=-2) / 6
    return mean, (plus - minus).mT / (2 * STEP), even.mT * np.sqrt(2.0) / 6


def points(m: Array, root: Array) -> Array:
    """Those of divided differences, with a step of the root of three."""
    return unscented_points(m, root, kappa=3.0 - m.shape[-1])[0]


def moved(belief: Any, flow: Any, noise: Array) -> Any:
    """Every mixand after a flow and noise."""
    w, m, P = belief
    m, first, second = differences(np.asarray(flow(points(m, np.linalg.cholesky(P)))))
    return w.copy(), m, first @ first.mT + second @ second.mT + noise


def updated(belief: Any, y: Array, sensor: Any) -> Any:
    """Every mixand after a reading (*runs, m), and weights by how likely it was."""
    w, m, P = belief
    root = np.linalg.cholesky(P)
    seen = sensor.predict(points(m, root))
    centre = seen[..., 0, :]
    about = sensor.residual(seen, np.broadcast_to(centre[..., None, :], seen.shape))
    mean, first, second = differences(about)
    gap = sensor.residual(np.broadcast_to(y[..., None, :], centre.shape), centre) - mean
    S = first @ first.mT + second @ second.mT + sensor.noise_cov
    gain = root @ first.mT @ np.linalg.inv(S)
    far = (gap[..., None, :] @ np.linalg.solve(S, gap[..., None]))[..., 0, 0]
    logs = logarithm(w) - 0.5 * (far + np.linalg.slogdet(2 * np.pi * S)[1])
    P = P - gain @ S @ gain.mT
    return (
        weights_of(logs, LEAST),
        m + (gain @ gap[..., None])[..., 0],
        0.5 * (P + P.mT),
    )


def logarithm(w: Array) -> Array:
    """Logarithms of weights, -inf for none."""
    with np.errstate(divide="ignore"):
        return np.log(w)


def weights_of(logs: Array, least: float = 0.0) -> Array:
    """Weights that sum to one, none as small as `least`."""
    w = np.exp(logs - logs.max(axis=-1, keepdims=True))
    w = w / w.sum(axis=-1, keepdims=True)
    w = np.where(w > least, w, 0.0)
    return w / w.sum(axis=-1, keepdims=True)


def peaks(P: Array) -> Array:
    """Logarithms of Gaussians' largest densities."""
    return -0.5 * np.linalg.slogdet(2 * np.pi * P)[1]


def log_parts(x: Array, m: Array, P: Array) -> Array:
    """Logarithms of the densities of mixands (..., L, n) at points (..., S, n), (..., S, L)."""
    gap = x[..., :, None, :] - m[..., None, :, :]
    white = (np.linalg.inv(P)[..., None, :, :, :] @ gap[..., None])[..., 0]
    return peaks(P)[..., None, :] - 0.5 * (gap * white).sum(axis=-1)


def log_density(x: Array, w: Array, m: Array, P: Array) -> Array:
    """Logarithms of mixtures' densities at points (..., S, n), (..., S)."""
    return np.logaddexp.reduce(logarithm(w)[..., None, :] + log_parts(x, m, P), axis=-1)


def fuse(own: Any, other: Any, omega: float, rule: str) -> Any:
    """An own belief about [t; e] and another's about t, with exponents omega and its rest."""
    (w, m, P) = own
    (w_b, m_b, P_b) = other
    n = m_b.shape[-1]
    d = m.shape[-1]
    A, A_b = (np.linalg.inv(x) for x in (P[..., :n, :n], P_b))
    # Every pair of mixands, the own ones first.
    J = omega * A[..., :, None, :, :] + (1 - omega) * A_b[..., None, :, :, :]
    gap = m_b[..., None, :, :] - m[..., :, None, :n]
    move = np.linalg.solve(J, (1 - omega) * A_b[..., None, :, :, :] @ gap[..., None])
    target = np.broadcast_to(np.linalg.inv(J), J.shape)
    gain = (P[..., n:, :n] @ A)[..., :, None, :, :]
    rest = (P[..., n:, n:] - P[..., n:, :n] @ A @ P[..., :n, n:])[..., :, None, :, :]
    means = np.concatenate([move, gain @ move], axis=-2)[..., 0] + m[..., :, None, :]
    covs = np.empty((*J.shape[:-2], d, d))
    covs[..., :n, :n] = target
    covs[..., n:, :n] = gain @ target
    covs[..., :n, n:] = covs[..., n:, :n].mT
    covs[..., n:, n:] = rest + gain @ target @ gain.mT
    covs = 0.5 * (covs + covs.mT)
    alive = (w[..., :, None] > 0) & (w_b[..., None, :] > 0)
    few = w.shape[-1]
    few_b = w_b.shape[-1]
    pairs = (*w.shape[:-1], few * few_b)
    means = means.reshape(*pairs, d)
    covs = covs.reshape(*pairs, d, d)
    alive = alive.reshape(pairs)
    source = np.repeat(np.arange(few), few_b)
    x = means[..., :n]
    logs = (omega - 1) * log_density(x, w, m[..., :n], P[..., :n, :n])
    logs = logs + (1 - omega) * log_density(x, w_b, m_b, P_b)
    if rule == "C1":
        alone = log_parts(means, m, P)[..., np.arange(few * few_b), source]
        logs = logs + logarithm(w)[..., source] + alone
    else:
        logs = logs + log_density(means, w, m, P)
    logs = np.where(alive, logs, -np.inf)
    tops = peaks(covs)
    if rule == "C3":
        right = np.exp(logs - logs.max(axis=-1, keepdims=True))
        matrix = np.exp(log_parts(means, means, covs) - tops[..., None, :])
        found = np.zeros(pairs)
        for row in np.ndindex(pairs[:-1]):
            some = np.flatnonzero(alive[row])
            part = matrix[row][np.ix_(some, some)]
            found[(*row, some)] = nonnegative_least_squares(part, right[row][some])
        logs = logarithm(found)
    new = weights_of(np.where(alive, logs - tops, -np.inf))
    return merged(new, means, covs, few)


def costs(w: Array, m: Array, P: Array, dets: Array, i: Any, j: Any) -> Array:
    """Runnalls' bound on what the merger of mixands i and j loses, of batches (B, ...)."""
    at = np.arange(len(w))[:, None]
    total = w[at, i] + w[at, j]
    a = np.divide(w[at, i], total, out=np.full(total.shape, 0.5), where=total > 0)
    both = joined(a, m[at, i], m[at, j], P[at, i], P[at, j])
    return 0.5 * (
        total * np.linalg.slogdet(both)[1]
        - w[at, i] * dets[at, i]
        - w[at, j] * dets[at, j]
    )


def joined(a: Array, m_i: Array, m_j: Array, P_i: Array, P_j: Array) -> Array:
    """The covariance of two mixands that are merged, the first of which has the share a."""
    gap = m_j - m_i
    a = a[..., None, None]
    return a * P_i + (1 - a) * P_j + a * (1 - a) * gap[..., :, None] * gap[..., None, :]


def merged(w: Array, m: Array, P: Array, size: int) -> Any:
    """Merge the pair that costs least until so many mixands are left."""
    lead = w.shape[:-1]
    (n, d) = m.shape[-2:]
    w = w.reshape(-1, n).copy()
    m = m.reshape(-1, n, d).copy()
    P = P.reshape(-1, n, d, d).copy()
    dets = np.linalg.slogdet(P)[1]
    rows, columns = (
        np.broadcast_to(x, (len(w), x.size)) for x in np.triu_indices(n, 1)
    )
    table = np.full((len(w), n, n), np.inf)
    at = np.arange(len(w))[:, None]
    table[at, rows, columns] = costs(w, m, P, dets, rows, columns)
    none = w == 0
    table[none[:, :, None] | none[:, None, :]] = np.inf
    while (more := np.flatnonzero((w > 0).sum(axis=-1) > size)).size:
        part = table[more].reshape(more.size, -1)
        least = part.min(axis=-1, keepdims=True)
        # The first of the pairs that cost the same, so that rounding does not choose.
        i, j = np.divmod(
            (part <= least + 1e-12 + 1e-9 * np.abs(least)).argmax(axis=-1), n
        )
        total = w[more, i] + w[more, j]
        a = w[more, i] / total
        P[more, i] = joined(a, m[more, i], m[more, j], P[more, i], P[more, j])
        m[more, i] += (1 - a)[:, None] * (m[more, j] - m[more, i])
        w[more, i] = total
        w[more, j] = 0.0
        dets[more, i] = np.linalg.slogdet(P[more, i])[1]
        others = np.broadcast_to(np.arange(n), (more.size, n))
        row = costs(w[more], m[more], P[more], dets[more], i[:, None], others)
        row[(w[more] == 0) | (others == i[:, None])] = np.inf
        below = others < i[:, None]
        table[more, j, :] = table[more, :, j] = np.inf
        table[more, i, :] = np.where(below, np.inf, row)
        up = table[more, :, i]
        table[more, :, i] = np.where(below, row, up)
    order = np.argsort(w == 0, axis=-1, kind="stable")[:, :size]
    w = w[at, order]
    m = m[at, order]
    P = P[at, order]
    return (
        (w / w.sum(axis=-1, keepdims=True)).reshape(*lead, size),
        m.reshape(*lead, size, d),
        P.reshape(*lead, size, d, d),
    )
