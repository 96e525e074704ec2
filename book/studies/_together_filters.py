"""Filters of chapter 11 that the library does not have: sums along a tree, split intersection,
likelihood consensus on common particles.

The filters are families of the library's `Filter`: they differ in `next_state` alone.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import KW_ONLY, dataclass
from typing import Any

import numpy as np

from distfilt import filters, network
from distfilt.filters import GaussianFilter, ParticleFilter
from distfilt.updates import resample
from distfilt.updates.particles import log_likelihood

Array = np.ndarray

# ------------------------------------------------------------------------------- sums on a tree


def spanning_tree(graph: Any) -> list[tuple[int, int]]:
    """Return (agent, parent), nearest to the root first; the root has the fewest hops to all."""
    # The root is the agent with the fewest links to all others.
    hops = np.array([graph.hops(k) for k in range(graph.n_agents)])
    root = int(hops.sum(axis=1).argmin())
    depth = hops[root]
    links = set(zip(graph.senders.tolist(), graph.receivers.tolist(), strict=True))
    tree = []
    for agent in np.argsort(depth, kind="stable").tolist():
        if agent == root:
            continue
        # The first neighbour that is one link nearer
        nearer = np.flatnonzero(depth == depth[agent] - 1).tolist()
        parent = next(k for k in nearer if (agent, k) in links)
        tree.append((agent, parent))
    return tree


def tree_graph(graph: Any) -> Any:
    """Return the graph of the spanning tree's links alone."""
    return network.Graph.from_edges(graph.n_agents, spanning_tree(graph))


def average_on_tree(values: Array, channel: Any) -> Array:
    """Return the average of vectors (*runs, A, k), summed up and down a spanning tree.

    Belief propagation on a tree: each of its links carries two messages, for any number
    of agents.
    """
    return sum_on_tree(values, channel) / channel.graph.n_agents


def sum_on_tree(values: Array, channel: Any) -> Array:
    """Return the sum of the agents' vectors (*runs, A, k), sent up and down a spanning tree."""
    tree = spanning_tree(channel.graph)
    # The own vector counts once.
    total = values.copy()
    # Leaves first: each agent adds up what came from below and sends it to its parent.
    for agent, parent in reversed(tree):
        sent = send_down(total[..., agent, :], channel, agent, [parent])
        total[..., parent, :] += sent[..., 0, :]
    # The root has the whole sum; each parent sends it to its children at once.
    for parent in dict.fromkeys(parent for _, parent in tree):
        children = [agent for agent, above in tree if above == parent]
        total[..., children, :] = send_down(
            total[..., parent, :], channel, parent, children
        )
    return total


def send_down(value: Array, channel: Any, sender: int, receivers: list[int]) -> Array:
    """Return a vector (*runs, k) as some neighbours receive it, (*runs, receivers, k).

    By broadcast it is one transmission.
    """
    graph = channel.graph
    payloads: list[Array | None] = [None] * graph.senders.size
    links = []
    for receiver in receivers:
        is_link = (graph.senders == sender) & (graph.receivers == receiver)
        links.append(int(np.flatnonzero(is_link)[0]))
        payloads[links[-1]] = value
    common: list[Array | None] = [None] * graph.n_agents
    common[sender] = value
    arrived = channel.unicast(payloads, common=common)
    return np.stack([arrived[link] for link in links], axis=-2)


# ---------------------------------------------------------------------------- split intersection


@dataclass(frozen=True, eq=False)
class SplitIntersection(GaussianFilter):
    """Kalman filters whose agents fuse beliefs by split covariance intersection.

    The error of a forecast may be correlated with that of any other agent in any way.
    The error that an agent's own observation brings is independent of all others, until
    it has been sent once.
    """

    _: KW_ONLY
    share_observations: bool = False

    def next_state(self, step: Any) -> Any:
        """Forecast, update with the own observation, fuse, join both parts."""
        mean, cov = forecast_gaussians(self, step)
        parts = split_update(mean, cov, step)
        mean, dependent, independent = network.split_covariance_intersection(
            parts, step.channel
        )
        return step.end(
            joint_means=mean,
            joint_covariances=dependent + independent,
            dim=self.model.dim,
            history=(),
        )


def forecast_gaussians(f: GaussianFilter, step: Any) -> tuple[Array, Array]:
    """Return the forecast means and inflated covariances of all agents."""
    t = step.state.t
    means = step.state.means
    F = f.model.jacobian(means, t, step.dt)
    # P = F P Fᵀ + Q, times the square of the inflation
    P = F @ step.state.covariances @ F.mT + f.model.Q(t, step.dt)
    return f.model.step(means, t, step.dt), f.inflation**2 * P


def split_update(mean: Array, cov: Array, step: Any) -> tuple[Array, Array, Array]:
    """Return means, and the dependent and independent parts, after an extended update."""
    new = mean.copy()
    dependent = cov.copy()
    independent = np.zeros_like(cov)
    identity = np.eye(mean.shape[-1])
    for _, group in step.received():
        agents = group.agents
        m = mean[..., agents, :]
        P = cov[..., agents, :, :]
        H = group.jacobian(m, P)
        S = H @ P @ H.mT + group.noise
        gain = np.linalg.solve(S, H @ P).mT
        innovation = group.target - group.predict(m[..., None, :])[..., 0, :]
        new[..., agents, :] = m + (gain @ innovation[..., None])[..., 0]
        # P+ = (I - K H) P (I - K H)ᵀ + K R Kᵀ: the forecast's part and the observation's
        remainder = identity - gain @ H
        dependent[..., agents, :, :] = remainder @ P @ remainder.mT
        independent[..., agents, :, :] = gain @ group.noise @ gain.mT
    return new, dependent, independent


# ----------------------------------------------------------------------- particles and transport


class SharedPlanFilter(filters.TransportFilter):
    """A transport filter that solves one plan where all agents hold the same members."""

    def _transport(self, stack: Any, logs: Array, step: Any) -> Any:
        """Return the coupling of the first agent, for all."""
        first = [x[..., :1, :, :] for x in stack]
        same = all(
            np.array_equal(x, np.broadcast_to(y, x.shape))
            for x, y in zip(stack, first, strict=True)
        )
        if not same or not np.allclose(logs, logs[..., :1, :], rtol=1e-9, atol=1e-9):
            return super()._transport(stack, logs, step)
        one_agent = filters.TransportFilter(
            self.model,
            self.sensors[:1],
            members=self.members,
            correct=self.correct,
            rejuvenation=self.rejuvenation,
        )
        members = one_agent._transport(first, logs[..., :1, :], step)
        return [np.repeat(x, self.n_agents, axis=-3) for x in members]


@dataclass(frozen=True, eq=False)
class LikelihoodConsensus(ParticleFilter):
    """Agents hold the same particles and agree on polynomials that approximate log-likelihoods.

    All draw from one seed. Each agent fits its own log-likelihood by polynomials that
    are orthonormal on the common particles, and the coefficients are averaged over the
    network.
    """

    _: KW_ONLY
    agree: Callable[..., Array] = network.finite_time_consensus
    degree: int = 2
    observed: tuple[int, ...] = (0, 1)
    share_observations: bool = False

    def initial_state(
        self, prior: Any, runs: tuple[int, ...], rng: Any
    ) -> dict[str, Any]:
        """Draw the same particles for all agents."""
        # One cloud for all agents, from one generator
        points = self.draw_prior(prior, (*runs, 1), rng)
        points = np.repeat(points, self.n_agents, axis=-3)
        log_weights = np.full(points.shape[:-1], -np.log(self.members))
        return {"particles": points, "log_weights": log_weights}

    def next_state(self, step: Any) -> Any:
        """Resample and forecast in common, agree on likelihoods, weight."""
        x = self._forecast_particles(step)
        points = np.repeat(x[..., None, :, :], self.n_agents, axis=-3)
        logs = np.zeros(points.shape[:-1])
        for _, group in step.received():
            a = group.agents
            predicted = group.predict(points[..., a, :, :])
            logs[..., a, :] = log_likelihood(predicted, group.target, group.noise)
        basis = orthonormal_polynomials(x[..., list(self.observed)], self.degree)
        # Coefficients c = Bᵀ log p of each agent; A times their mean is the sum.
        coefficients = (logs[..., None, :] @ basis[..., None, :, :])[..., 0, :]
        total = self.n_agents * self.agree(coefficients, step.channel)
        logs = (basis[..., None, :, :] @ total[..., None])[..., 0]
        logs = logs - logs.max(axis=-1, keepdims=True)
        normalizer = np.log(np.exp(logs).sum(axis=-1, keepdims=True))
        logs = np.maximum(logs - normalizer, -1e300)
        return step.end(particles=points, log_weights=logs, past=())

    def _forecast_particles(self, step: Any) -> Array:
        """Resample by the mean weights, jitter, and move by the model."""
        x = step.state.particles[..., 0, :, :]
        weights = step.state.weights.mean(axis=-2)
        indices = resample(weights, rng=step.rng)
        x = np.take_along_axis(x, indices[..., None], axis=-2)
        if self.jitter:
            spread = x.std(axis=-2, keepdims=True)
            x = x + self.jitter * spread * step.rng.standard_normal(x.shape)
        return self.model.sample_step(x, step.state.t, step.dt, rng=step.rng)


def orthonormal_polynomials(x: Array, degree: int) -> Array:
    """Return polynomials orthonormal on points (..., N, k), without the constant."""
    # Standardized, so that powers stay of the size of one
    u = (x - x.mean(axis=-2, keepdims=True)) / x.std(axis=-2, keepdims=True)
    dims = x.shape[-1]
    exponents = [p for p in np.ndindex(*[degree + 1] * dims) if sum(p) <= degree]
    monomials = []
    for powers in exponents:
        factors = [u[..., k] ** power for k, power in enumerate(powers)]
        monomials.append(np.prod(factors, axis=0))
    # The first exponents are all zero: the constant, which normalization removes.
    return np.linalg.qr(np.stack(monomials, axis=-1))[0][..., 1:]
