"""Agents with doubtful places track a target: linear, many runs at once, three ways to cooperate.

A reading is the target's position as seen from the agent's own, [I 0] t - e plus noise. Each agent
keeps [target; ego], except in joint bookkeeping, where it keeps [target; all egos].
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
    """What moves, what is doubtful at first, who hears whom; noise is the target's alone."""

    graph: Any
    move: np.ndarray
    noise: np.ndarray
    target_cov: np.ndarray
    ego_cov: np.ndarray
    reading_cov: np.ndarray
    faults: Faults | None = None
    gate: float | None = None

    @property
    def dims(self) -> tuple[int, int]:
        """Components of the target and of an ego."""
        return len(self.target_cov), len(self.ego_cov)

    def state(self, egos: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Transition, noise and first covariance of [target; egos]."""
        (n, e) = self.dims
        own = np.eye(egos)
        blocks = (
            (self.move, np.kron(own, np.eye(e))),
            (self.noise, np.kron(own, np.zeros((e, e)))),
        )
        full = [np.zeros((n + egos * e, n + egos * e)) for _ in range(3)]
        for out, (a, b) in zip(
            full, (*blocks, (self.target_cov, np.kron(own, self.ego_cov))), strict=True
        ):
            out[:n, :n] = a
            out[n:, n:] = b
        return full[0], full[1], full[2]

    def sees(self, agent: int, egos: int) -> np.ndarray:
        """The matrix H of an agent's reading of [target; egos]."""
        n, e = self.dims
        h = np.zeros((e, n + egos * e))
        h[:, :e] = np.eye(e)
        h[:, n + agent * e : n + (agent + 1) * e] = -np.eye(e)
        return h

    @property
    def size(self) -> int:
        """How many agents."""
        return int(self.graph.n_agents)

    def data(self, steps: int, runs: int, rng: np.random.Generator) -> tuple:
        """Targets (steps, runs, n) and readings (steps, runs, A, e)."""
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
                np.zeros(e), self.reading_cov, size=(runs, self.size)
            )
            truth.append(x[:, :n])
            seen.append((h @ x[:, None, :, None])[..., 0] + errors)
        return np.array(truth), np.array(seen)

    def arrived(self, k: int, runs: int) -> np.ndarray:
        """Whether a message of step k from j reaches i, (runs, i, j)."""
        out = np.zeros((runs, self.size, self.size), dtype=bool)
        lost = False if self.faults is None else self.faults.lost(self.graph, k, runs)
        out[:, self.graph.receivers, self.graph.senders] = ~np.asarray(lost)
        return out

    def filtered(self, way: str, seen: np.ndarray) -> Belief:
        """Beliefs about the target after each step, (steps, runs, A, n) and (steps, ..., n, n)."""
        if way == "joint":
            return self._joint(seen)
        (n, _) = self.dims
        (move, noise, first) = self.state(1)
        steps, runs = seen.shape[:2]
        mean = np.zeros((runs, self.size, len(first)))
        cov = np.broadcast_to(first, (runs, self.size, *first.shape))
        out = []
        for k in range(steps):
            before = mean @ move.T, move @ cov @ move.T + noise
            after = known(
                *before, self.sees(0, 1), self.reading_cov, seen[k], self.gate
            )
            mean, cov = after
            if way != "alone":
                exchange = {"news": _news, "intersection": _intersected}[way]
                mean, cov = exchange(before, after, self.arrived(k, runs), n)
            out.append((mean[..., :n], cov[..., :n, :n]))
        return np.array([m for m, _ in out]), np.array([p for _, p in out])

    def joint(self) -> GaussianFilter:
        """The filter of [target; all egos] that every agent runs, readings being told."""
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
                    self.reading_cov,
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
        out = []
        for k, y in enumerate(seen):
            state = f.step(state, k + 1.0, list(np.moveaxis(y, 1, 0)))
            out.append((state.means[..., :n], state.covariances[..., :n, :n]))
        return np.array([m for m, _ in out]), np.array([p for _, p in out])


def known(
    mean: np.ndarray,
    cov: np.ndarray,
    h: np.ndarray,
    r: np.ndarray,
    y: np.ndarray,
    gate: float | None = None,
) -> Belief:
    """Gaussians after readings y of h; one that fails the gate changes nothing."""
    gap = (y - mean @ h.T)[..., None]
    spread = h @ cov @ h.T + r
    gain = np.linalg.solve(spread, h @ cov).mT
    if gate is not None:
        far = (gap.mT @ np.linalg.solve(spread, gap))[..., 0, 0]
        gain = gain * (far <= chi2.ppf(gate, len(h)))[..., None, None]
    return mean + (gain @ gap)[..., 0], cov - gain @ h @ cov


def information(mean: np.ndarray, cov: np.ndarray, n: int) -> Belief:
    """Information vector and matrix of the first n components."""
    matrix = np.linalg.inv(cov[..., :n, :n])
    return (matrix @ mean[..., :n, None])[..., 0], matrix


def added(belief: Belief, vector: np.ndarray, matrix: np.ndarray, n: int) -> Belief:
    """Gaussians after information about the first n components."""
    mean, cov = belief
    gain = cov[..., :n] @ np.linalg.inv(np.eye(n) + matrix @ cov[..., :n, :n])
    gap = vector - (matrix @ mean[..., :n, None])[..., 0]
    return mean + (gain @ gap[..., None])[..., 0], cov - gain @ matrix @ cov[..., :n, :]


def _news(before: Belief, after: Belief, arrived: np.ndarray, n: int) -> Belief:
    """Everybody's gain in information is added by who hears it."""
    (v0, j0), (v1, j1) = (information(*belief, n) for belief in (before, after))
    w = arrived.astype(np.float64)
    vector = np.einsum("rij,rjn->rin", w, v1 - v0)
    return added(after, vector, np.einsum("rij,rjmn->rimn", w, j1 - j0), n)


def _intersected(before: Belief, after: Belief, arrived: np.ndarray, n: int) -> Belief:
    """Covariance intersection of targets with equal exponents."""
    vector, matrix = information(*after, n)
    w = arrived + np.eye(arrived.shape[-1])
    w = w / w.sum(axis=-1, keepdims=True)
    fused = np.einsum("rij,rjn->rin", w, vector), np.einsum("rij,rjmn->rimn", w, matrix)
    return added(after, fused[0] - vector, fused[1] - matrix, n)


def nees(truth: np.ndarray, belief: Belief) -> np.ndarray:
    """NEES per component of the target, (steps, runs, A)."""
    gap = (belief[0] - truth[:, :, None])[..., None]
    return (gap.mT @ np.linalg.solve(belief[1], gap))[..., 0, 0] / gap.shape[-2]


def rare(share: float, n: int) -> float:
    """The NEES per component that a right claim about n components exceeds so seldom."""
    return float(chi2.isf(share, n)) / n
