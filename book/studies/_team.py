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
        _, e = self.dims
        # Agents stand still: identity transition, no noise
        egos_move = np.eye(egos * e)
        egos_noise = np.zeros((egos * e, egos * e))
        egos_cov = np.kron(np.eye(egos), self.ego_cov)
        return (
            join_blocks(self.move, egos_move),
            join_blocks(self.noise, egos_noise),
            join_blocks(self.target_cov, egos_cov),
        )

    def sees(self, agent: int, egos: int) -> np.ndarray:
        """Return the matrix H of an agent's observation of [target; egos]."""
        n, e = self.dims
        # y = [I 0] t - e_a: the target's first components, minus the agent's position
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
        n, e = self.dims
        move, noise, first = self.state(self.size)
        zero = np.zeros(len(first))
        # The true state of a run is a draw from the prior.
        x = rng.multivariate_normal(zero, first, size=runs)
        h = np.array([self.sees(a, self.size) for a in range(self.size)])
        truth = []
        seen = []
        for _ in range(steps):
            process_noise = rng.multivariate_normal(zero, noise, size=runs)
            x = x @ move.T + process_noise
            errors = rng.multivariate_normal(
                np.zeros(e), self.observation_cov, size=(runs, self.size)
            )
            # Each agent has a row of H of its own; the batch is over runs.
            exact = (h @ x[:, None, :, None])[..., 0]
            truth.append(x[:, :n])
            seen.append(exact + errors)
        return np.array(truth), np.array(seen)

    def arrivals(self, k: int, runs: int) -> np.ndarray:
        """Return whether a message of step k from j reaches i, (runs, i, j)."""
        received = np.zeros((runs, self.size, self.size), dtype=bool)
        # One draw for each link of the graph, in its order
        lost = np.zeros((runs, len(self.graph.senders)), dtype=bool)
        if self.faults is not None:
            lost = self.faults.draw_losses(self.graph, k, runs)
        received[:, self.graph.receivers, self.graph.senders] = ~np.asarray(lost)
        return received

    def run_filters(self, way: str, seen: np.ndarray) -> Belief:
        """Return beliefs about the target after each step, (steps, runs, A, n) and covariances."""
        if way == "joint":
            return self._joint(seen)
        n, _ = self.dims
        # The state [target; ego] of one agent, the same for all
        move, noise, first = self.state(1)
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
        # One linear sensor for each agent
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
        n, _ = self.dims
        # All agents start with the prior of the whole state.
        first = self.state(self.size)[2]
        state = f.start((np.zeros(len(first)), first), runs=seen.shape[1:2])
        beliefs = []
        for k, y in enumerate(seen):
            state = f.step(state, k + 1.0, list(np.moveaxis(y, 1, 0)))
            beliefs.append((state.means[..., :n], state.covariances[..., :n, :n]))
        return np.array([m for m, _ in beliefs]), np.array([p for _, p in beliefs])


def join_blocks(target: np.ndarray, egos: np.ndarray) -> np.ndarray:
    """Return the block diagonal of a matrix of the target and one of the egos."""
    n = len(target)
    full = np.zeros((n + len(egos), n + len(egos)))
    full[:n, :n] = target
    full[n:, n:] = egos
    return full


def condition(
    mean: np.ndarray,
    cov: np.ndarray,
    h: np.ndarray,
    r: np.ndarray,
    y: np.ndarray,
    gate: float | None = None,
) -> Belief:
    """Return Gaussians after observations y of h; one outside the gate is ignored."""
    # Innovation y - H m, and its covariance S = H P Hᵀ + R
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
    # J = P⁻¹ and η = J m
    matrix = np.linalg.inv(cov[..., :n, :n])
    return (matrix @ mean[..., :n, None])[..., 0], matrix


def add_information(
    belief: Belief, vector: np.ndarray, matrix: np.ndarray, n: int
) -> Belief:
    """Return Gaussians after information about the first n components."""
    mean, cov = belief
    # G = P[:, :n] (I + J P_nn)⁻¹
    gain = cov[..., :n] @ np.linalg.inv(np.eye(n) + matrix @ cov[..., :n, :n])
    # m + G (η - J m) and P - G J P
    gap = vector - (matrix @ mean[..., :n, None])[..., 0]
    return mean + (gain @ gap[..., None])[..., 0], cov - gain @ matrix @ cov[..., :n, :]


def exchange_increments(
    before: Belief, after: Belief, arrived: np.ndarray, n: int
) -> Belief:
    """Add the information increments of the agents whose messages arrive."""
    vector_before, matrix_before = information(*before, n)
    vector_after, matrix_after = information(*after, n)
    # Agent i adds the increments of all j whose messages arrive.
    w = arrived.astype(np.float64)
    vector = np.einsum("rij,rjn->rin", w, vector_after - vector_before)
    matrix = np.einsum("rij,rjmn->rimn", w, matrix_after - matrix_before)
    return add_information(after, vector, matrix, n)


def intersect_beliefs(
    before: Belief, after: Belief, arrived: np.ndarray, n: int
) -> Belief:
    """Intersect the targets' covariances, with equal weights of the beliefs that arrive."""
    vector, matrix = information(*after, n)
    # Row i has equal weights of the beliefs that agent i has.
    w = arrived + np.eye(arrived.shape[-1])
    w = w / w.sum(axis=-1, keepdims=True)
    # Covariance intersection averages the information about the target.
    fused_vector = np.einsum("rij,rjn->rin", w, vector)
    fused_matrix = np.einsum("rij,rjmn->rimn", w, matrix)
    # The ego follows through its correlation with the target.
    return add_information(after, fused_vector - vector, fused_matrix - matrix, n)


def nees(truth: np.ndarray, belief: Belief) -> np.ndarray:
    """NEES per component of the target, (steps, runs, A)."""
    gap = (belief[0] - truth[:, :, None])[..., None]
    # eᵀ P⁻¹ e over the number of components
    squares = (gap.mT @ np.linalg.solve(belief[1], gap))[..., 0, 0]
    return squares / gap.shape[-2]


def nees_quantile(share: float, n: int) -> float:
    """Return the NEES per component that a consistent filter exceeds with this probability."""
    return float(chi2.isf(share, n)) / n
