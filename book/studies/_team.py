"""Agents uncertain of their positions track a target: linear, many runs, three ways to cooperate.

An observation is the target's position relative to the agent's, [I 0] t - e plus noise.
Each agent filters [target; ego], or in the joint filter [target; all egos].
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.stats import chi2

from distfilt.filters import GaussianFilter
from distfilt.models import LinearModel
from distfilt.network import Faults
from distfilt.sensors import Sensor

Belief = tuple[np.ndarray, np.ndarray]


@dataclass(frozen=True, eq=False)
class Team:
    """Model, prior and communication graph of a team; only the target has process noise."""

    graph: Any
    move: np.ndarray
    noise: np.ndarray
    target_cov: np.ndarray
    ego_cov: np.ndarray
    observation_cov: np.ndarray
    faults: Faults | None = None
    gate: float | None = None

    @property
    def dims(self) -> tuple[int, int]:
        """Components of the target and of an ego."""
        return len(self.target_cov), len(self.ego_cov)

    def state(self, egos: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return transition, noise and prior covariance of [target; egos]."""
        (n, e) = self.dims
        identity = np.eye(egos)
        blocks = (
            (self.move, np.kron(identity, np.eye(e))),
            (self.noise, np.kron(identity, np.zeros((e, e)))),
        )
        full = [np.zeros((n + egos * e, n + egos * e)) for _ in range(3)]
        for matrix, (a, b) in zip(
            full,
            (*blocks, (self.target_cov, np.kron(identity, self.ego_cov))),
            strict=True,
        ):
            matrix[:n, :n] = a
            matrix[n:, n:] = b
        return full[0], full[1], full[2]

    def sees(self, agent: int, egos: int) -> np.ndarray:
        """Return the matrix H of an agent's observation of [target; egos]."""
        n, e = self.dims
        h = np.zeros((e, n + egos * e))
        h[:, :e] = np.eye(e)
        h[:, n + agent * e : n + (agent + 1) * e] = -np.eye(e)
        return h

    @property
    def size(self) -> int:
        """Number of agents."""
        return int(self.graph.n_agents)

    def data(self, steps: int, runs: int, rng: np.random.Generator) -> tuple:
        """Draw targets (steps, runs, n) and observations (steps, runs, A, e)."""
        (n, e) = self.dims
        (move, noise, first) = self.state(self.size)
        x = rng.multivariate_normal(np.zeros(len(first)), first, size=runs)
        h = np.array([self.sees(a, self.size) for a in range(self.size)])
        truth = []
        seen = []
        for _ in range(steps):
            x = x @ move.T + rng.multivariate_normal(
                np.zeros(len(x.T)), noise, size=runs
            )
            errors = rng.multivariate_normal(
                np.zeros(e), self.observation_cov, size=(runs, self.size)
            )
            truth.append(x[:, :n])
            seen.append((h @ x[:, None, :, None])[..., 0] + errors)
        return np.array(truth), np.array(seen)

    def arrivals(self, k: int, runs: int) -> np.ndarray:
        """Return whether a message of step k from j reaches i, (runs, i, j)."""
        received = np.zeros((runs, self.size, self.size), dtype=bool)
        lost = (
            False
            if self.faults is None
            else self.faults.draw_losses(self.graph, k, runs)
        )
        received[:, self.graph.receivers, self.graph.senders] = ~np.asarray(lost)
        return received

    def run_filters(self, way: str, seen: np.ndarray) -> Belief:
        """Return beliefs about the target after each step, (steps, runs, A, n) and covariances."""
        if way == "joint":
            return self._joint(seen)
        (n, _) = self.dims
        (move, noise, first) = self.state(1)
        steps, runs = seen.shape[:2]
        mean = np.zeros((runs, self.size, len(first)))
        cov = np.broadcast_to(first, (runs, self.size, *first.shape))
        beliefs = []
        for k in range(steps):
            # m⁻ = F m and P⁻ = F P Fᵀ + Q
            before = mean @ move.T, move @ cov @ move.T + noise
            # Each agent conditions on its own observation, then on the messages that arrive.
            after = condition(
                *before, self.sees(0, 1), self.observation_cov, seen[k], self.gate
            )
            mean, cov = after
            if way != "alone":
                exchange = {
                    "increments": exchange_increments,
                    "intersection": intersect_beliefs,
                }[way]
                mean, cov = exchange(before, after, self.arrivals(k, runs), n)
            beliefs.append((mean[..., :n], cov[..., :n, :n]))
        return np.array([m for m, _ in beliefs]), np.array([p for _, p in beliefs])

    def joint(self) -> GaussianFilter:
        """Return the filter of [target; all egos] that every agent runs on shared observations."""
        move, noise, _ = self.state(self.size)
        model = LinearModel.from_transition(
            len(move), lambda dt: move, lambda t, dt: noise
        )
        eyes = []
        for agent in range(self.size):
            h = self.sees(agent, self.size)
            eyes.append(
                Sensor(
                    len(h),
                    lambda x, h=h: x @ h.T,
                    self.observation_cov,
                    linear=lambda d, h=h: h,
                )
            )
        return GaussianFilter(
            model, eyes, self.graph, faults=self.faults, gate_probability=self.gate
        )

    def _joint(self, seen: np.ndarray) -> Belief:
        f = self.joint()
        (n, _) = self.dims
        first = self.state(self.size)[2]
        state = f.start((np.zeros(len(first)), first), runs=seen.shape[1:2])
        beliefs = []
        for k, y in enumerate(seen):
            state = f.step(state, k + 1.0, list(np.moveaxis(y, 1, 0)))
            beliefs.append((state.means[..., :n], state.covariances[..., :n, :n]))
        return np.array([m for m, _ in beliefs]), np.array([p for _, p in beliefs])


def condition(
    mean: np.ndarray,
    cov: np.ndarray,
    h: np.ndarray,
    r: np.ndarray,
    y: np.ndarray,
    gate: float | None = None,
) -> Belief:
    """Return Gaussians after observations y of h; one outside the gate is ignored."""
    gap = (y - mean @ h.T)[..., None]
    spread = h @ cov @ h.T + r
    # K = P Hᵀ S⁻¹, by a solve
    gain = np.linalg.solve(spread, h @ cov).mT
    # The squared normalized innovation has a chi-squared distribution.
    if gate is not None:
        far = (gap.mT @ np.linalg.solve(spread, gap))[..., 0, 0]
        gain = gain * (far <= chi2.ppf(gate, len(h)))[..., None, None]
    return mean + (gain @ gap)[..., 0], cov - gain @ h @ cov


def information(mean: np.ndarray, cov: np.ndarray, n: int) -> Belief:
    """Return information vector and matrix of the first n components."""
    matrix = np.linalg.inv(cov[..., :n, :n])
    return (matrix @ mean[..., :n, None])[..., 0], matrix


def add_information(
    belief: Belief, vector: np.ndarray, matrix: np.ndarray, n: int
) -> Belief:
    """Return Gaussians after information about the first n components."""
    mean, cov = belief
    # G = P[:, :n] (I + J P_nn)⁻¹
    gain = cov[..., :n] @ np.linalg.inv(np.eye(n) + matrix @ cov[..., :n, :n])
    gap = vector - (matrix @ mean[..., :n, None])[..., 0]
    return mean + (gain @ gap[..., None])[..., 0], cov - gain @ matrix @ cov[..., :n, :]


def exchange_increments(
    before: Belief, after: Belief, arrived: np.ndarray, n: int
) -> Belief:
    """Add the information increments of the agents whose messages arrive."""
    (v0, j0), (v1, j1) = (information(*belief, n) for belief in (before, after))
    w = arrived.astype(np.float64)
    vector = np.einsum("rij,rjn->rin", w, v1 - v0)
    return add_information(after, vector, np.einsum("rij,rjmn->rimn", w, j1 - j0), n)


def intersect_beliefs(
    before: Belief, after: Belief, arrived: np.ndarray, n: int
) -> Belief:
    """Intersect the targets' covariances, with equal weights of the beliefs that arrive."""
    vector, matrix = information(*after, n)
    # Row i has equal weights of the beliefs that agent i has.
    w = arrived + np.eye(arrived.shape[-1])
    w = w / w.sum(axis=-1, keepdims=True)
    fused = np.einsum("rij,rjn->rin", w, vector), np.einsum("rij,rjmn->rimn", w, matrix)
    return add_information(after, fused[0] - vector, fused[1] - matrix, n)


def nees(truth: np.ndarray, belief: Belief) -> np.ndarray:
    """NEES per component of the target, (steps, runs, A)."""
    gap = (belief[0] - truth[:, :, None])[..., None]
    return (gap.mT @ np.linalg.solve(belief[1], gap))[..., 0, 0] / gap.shape[-2]


def nees_quantile(share: float, n: int) -> float:
    """Return the NEES per component that a consistent filter exceeds with this probability."""
    return float(chi2.isf(share, n)) / n
