"""Filters of chapter 11 that the library does not have: sums along a tree, iterated updates,
exchange of target beliefs, likelihood consensus, and beliefs on a grid.

The filters are families of the library's `Filter`: they differ in `next_state` alone.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import KW_ONLY, dataclass
from functools import cache
from typing import Any

import numpy as np

from distfilt import filters, network
from distfilt.filters import GaussianFilter, ParticleFilter, Summary
from distfilt.updates import resample
from distfilt.updates.particles import log_likelihood

Array = np.ndarray
Information = tuple[Array, Array]
"""Information matrix (..., n, n) and information vector (..., n)."""

# ------------------------------------------------------------------------------------- Gaussians


def symmetrize(P: Array) -> Array:
    """Return the symmetric part of matrices."""
    return 0.5 * (P + P.mT)


def add_information(m: Array, P: Array, J: Array, v: Array) -> tuple[Array, Array]:
    """Return Gaussians after information (J, v), with J of the covariance's size."""
    # P+ = P (I + J P)⁻¹ and m+ = m + P+ (v - J m)
    P = P @ np.linalg.inv(np.eye(P.shape[-1]) + J @ P)
    m = m + (P @ (v[..., None] - J @ m[..., None]))[..., 0]
    return m, symmetrize(P)


def forecast_gaussians(f: GaussianFilter, step: Any) -> tuple[Array, Array]:
    """Return the forecast means and inflated covariances of all agents."""
    t = step.state.t
    means = step.state.means
    F = f.model.jacobian(means, t, step.dt)
    # P = F P Fᵀ + Q, times the square of the inflation
    P = F @ step.state.covariances @ F.mT + f.model.Q(t, step.dt)
    return f.model.step(means, t, step.dt), f.inflation**2 * P


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


@dataclass(frozen=True, eq=False)
class IteratedGaussian(GaussianFilter):
    """Extended Kalman filters whose update linearizes anew at each estimate, four times."""

    _: KW_ONLY
    iterations: int = 4

    def next_state(self, step: Any) -> Any:
        """Forecast, and iterate the update with all observations of an agent."""
        m, P = forecast_gaussians(self, step)
        for _, group in step.received():
            a = group.agents
            m[..., a, :], P[..., a, :, :] = iterate_update(
                m[..., a, :], P[..., a, :, :], group, self.iterations
            )
        return step.end(
            joint_means=m,
            joint_covariances=symmetrize(P),
            dim=self.model.dim,
            history=(),
        )


def iterate_update(
    m: Array, P: Array, group: Any, iterations: int
) -> tuple[Array, Array]:
    """Return Gaussians after an iterated extended update: Gauss-Newton steps to the mode."""
    x = m
    for _ in range(iterations):
        H = group.jacobian(x, P)
        S = H @ P @ H.mT + group.noise
        gain = np.linalg.solve(S, H @ P).mT
        # x ← m + K (y - h(x) - H (m - x))
        innovation = group.target - group.predict(x[..., None, :])[..., 0, :]
        innovation = innovation - (H @ (m - x)[..., None])[..., 0]
        x = m + (gain @ innovation[..., None])[..., 0]
    return x, P - gain @ S @ gain.mT


@dataclass(frozen=True, eq=False)
class TargetExchangeFilter(GaussianFilter):
    """Agents filter [target; own position] and exchange beliefs of the target's components.

    With `send_increments` an agent sends the information increment of its observation,
    as two observations of unit noise; without, its whole belief of the target, and all
    beliefs are fused with equal weights. The same as an `InformationIncrementFilter`,
    and as a `MixtureFilter` of one component, for many runs at once.
    """

    _: KW_ONLY
    target_dim: int = 4
    send_increments: bool = True
    share_observations: bool = False

    def next_state(self, step: Any) -> Any:
        """Forecast, update with the own observation, exchange, add the received information."""
        n = self.target_dim
        m, P = forecast_gaussians(self, step)
        before = target_information(m, P, n)
        m, P = condition_on_own(m, P, step)
        after = target_information(m, P, n)
        numbers = (
            pack_increment(before, after)
            if self.send_increments
            else upper_triangle(after)
        )
        payloads = [numbers[..., k, :] for k in range(self.n_agents)]
        inbox = step.channel.broadcast(payloads)
        d = self.model.dim
        J = np.zeros((*m.shape[:-1], d, d))
        v = np.zeros_like(m)
        for k, box in enumerate(inbox):
            own = after[0][..., k, :, :], after[1][..., k, :]
            terms = self._terms(list(box.values()), own)
            J[..., k, :n, :n] = sum(matrix for matrix, _ in terms)
            v[..., k, :n] = sum(vector for _, vector in terms)
        m, P = add_information(m, P, J, v)
        return step.end(joint_means=m, joint_covariances=P, dim=d, history=())

    def _terms(self, payloads: list[Array], own: Information) -> list[Information]:
        """Return the information that one agent adds, from its inbox and its own belief."""
        n = self.target_dim
        terms = [unpack_information(x, n, self.send_increments) for x in payloads]
        if self.send_increments:
            return terms
        # Equal weights w of all beliefs; the own one is already there, with weight one.
        w = 1 / (len(terms) + 1)
        terms = [(w * matrix, w * vector) for matrix, vector in terms]
        terms.append(((w - 1) * own[0], (w - 1) * own[1]))
        return terms


def condition_on_own(m: Array, P: Array, step: Any) -> tuple[Array, Array]:
    """Return the Gaussians of all agents after an extended update with their own observations."""
    for _, group in step.received():
        H = group.jacobian(m, P)
        gain = P @ H.mT @ np.linalg.inv(H @ P @ H.mT + group.noise)
        innovation = group.target - group.predict(m[..., None, :])[..., 0, :]
        m = m + (gain @ innovation[..., None])[..., 0]
        P = P - gain @ H @ P
    return m, P


def target_information(mean: Array, cov: Array, n: int) -> Information:
    """Return information matrix and vector of the first n components."""
    # Of a joint Gaussian the marginal of the target is a block.
    matrix = np.linalg.inv(cov[..., :n, :n])
    return matrix, (matrix @ mean[..., :n, None])[..., 0]


def upper_triangle(belief: Information) -> Array:
    """Return the upper triangle of a symmetric matrix, then a vector."""
    # A symmetric matrix has n (n + 1) / 2 different numbers.
    matrix, vector = belief
    rows, columns = np.triu_indices(matrix.shape[-1])
    return np.concatenate([matrix[..., rows, columns], vector], axis=-1)


def pack_increment(before: Information, after: Information, rank: int = 2) -> Array:
    """Return an information increment as `rank` observations of unit noise.

    The increment is J+ - J = HᵀH with H upper triangular, of which the zeros are not
    sent.
    """
    values, axes = np.linalg.eigh(after[0] - before[0])
    H = np.sqrt(values[..., -rank:, None]) * axes[..., -rank:].mT
    # z is determined by Hᵀz = v+ - v.
    z = np.linalg.solve(H @ H.mT, H @ (after[1] - before[1])[..., None])
    turn, H = np.linalg.qr(H)
    rows, columns = np.triu_indices(rank, 0, H.shape[-1])
    return np.concatenate([H[..., rows, columns], (turn.mT @ z)[..., 0]], axis=-1)


def unpack_information(
    numbers: Array, n: int, increment: bool, rank: int = 2
) -> Information:
    """Return information matrix and vector from a payload of either kind."""
    # An increment has as many rows as its observation has components.
    height = rank if increment else n
    rows, columns = np.triu_indices(height, 0, n)
    H = np.zeros((*numbers.shape[:-1], height, n))
    H[..., rows, columns] = numbers[..., : rows.size]
    vector = numbers[..., rows.size :]
    if increment:
        return H.mT @ H, (H.mT @ vector[..., None])[..., 0]
    return H + np.triu(H, 1).mT, vector


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


# ------------------------------------------------------------------------------------------ grid


@dataclass(frozen=True, eq=False, repr=False)
class GridState(filters.SensorState):
    """Logarithms of the cells' probabilities, up to a constant."""

    logs: Array
    belief_field = "logs", (..., "A", "cells")


@dataclass(frozen=True, eq=False)
class GridFilter(
    filters.SensorFilter[Any],
    filters.FusesBeliefs[Any],
    filters.SharesObservations[Any],
    filters.ExchangesAtIntervals[Any],
    filters.IsolatesRuns[Any],
):
    """Beliefs on the cells of a square, exact but for the cells' size; for models in the plane.

    Errors of observations are independent of each other. A fusion rule takes vectors:
    the agents' log-beliefs, whose average is the geometric mean, or with `likelihoods`
    the log-likelihoods of their observations, whose average is then multiplied by A.
    """

    _: KW_ONLY
    cells: int = 40
    half: float = 9.0
    likelihoods: bool = False

    state_class = GridState
    belief_kind = "vectors"

    @property
    def centres(self) -> Array:
        """Centres of the cells, (n, 2)."""
        return cell_centres(self.cells, self.half)

    def initial_state(
        self, prior: Any, runs: tuple[int, ...], rng: Any
    ) -> dict[str, Any]:
        """Return the prior's log-density at the centres."""
        mean, cov = prior
        x = self.centres - mean
        logs = -0.5 * (x * np.linalg.solve(cov, x.T).T).sum(axis=-1)
        return {"logs": np.broadcast_to(logs, (*runs, self.n_agents, logs.size))}

    def next_state(self, step: Any) -> Any:
        """Forecast the probabilities, weight them by likelihoods, fuse."""
        logs = self._forecast_logs(step)
        likelihoods = self._log_likelihoods(step, logs)
        if self.likelihoods:
            (average,) = step.fuse(likelihoods)
            return step.end(logs=logs + self.n_agents * average)
        logs = logs + likelihoods
        logs = logs - logs.max(axis=-1, keepdims=True)
        (logs,) = step.fuse(np.maximum(logs, -700.0))
        return step.end(logs=logs)

    def _forecast_logs(self, step: Any) -> Array:
        old = step.state.logs
        probabilities = np.exp(old - old.max(axis=-1, keepdims=True))
        matrix = transition_matrix(self.cells, self.half, self.model, step.dt)
        forecast = matrix @ probabilities.reshape(-1, old.shape[-1]).T
        with np.errstate(divide="ignore"):
            logs = np.log(forecast.T.reshape(old.shape))
        return np.maximum(logs, -700.0)

    def _log_likelihoods(self, step: Any, like: Array) -> Array:
        """Return the log-likelihoods at the centres, of the shape of `like`."""
        logs = np.zeros_like(like)
        for _, group in step.received():
            a = group.agents
            shape = (*logs[..., a, :].shape, 2)
            predicted = group.predict(np.broadcast_to(self.centres, shape))
            # A missing component, NaN, contributes nothing.
            squares = np.nan_to_num(group.target[..., None, :] - predicted) ** 2
            # (M,), or (G, M) of agents whose sensors have errors of their own
            variance = np.diagonal(group.noise, axis1=-2, axis2=-1)
            if np.count_nonzero(group.noise) > np.count_nonzero(variance):
                raise ValueError(
                    "sensors must have independent errors for a grid, got correlated ones"
                )
            logs[..., a, :] = -0.5 * (squares / variance[..., None, :]).sum(axis=-1)
        return logs

    def summarize(self, state: Any) -> Summary:
        """Return means and covariances of the cells' probabilities."""
        weights = np.exp(state.logs - state.logs.max(axis=-1, keepdims=True))
        weights = weights / weights.sum(axis=-1, keepdims=True)
        x = self.centres
        mean = weights @ x
        products = [weights @ (x[:, i] * x[:, j]) for i in (0, 1) for j in (0, 1)]
        second = np.stack(products, axis=-1).reshape(*mean.shape, 2)
        cov = second - mean[..., :, None] * mean[..., None, :]
        # A belief is no narrower than a cell, whose variance is width² / 12.
        cell_variance = (2 * self.half / self.cells) ** 2 / 12
        i = np.arange(2)
        cov[..., i, i] = np.maximum(cov[..., i, i], cell_variance)
        return Summary(mean, np.diagonal(cov, axis1=-2, axis2=-1), cov)


@cache
def transition_matrix(cells: int, half: float, model: Any, dt: float) -> Any:
    """Return the sparse matrix that moves cell probabilities by one step of a linear model."""
    from scipy.sparse import csr_array
    from scipy.spatial import KDTree

    x = cell_centres(cells, half)
    std = float(np.sqrt(model.Q(0.0, dt)[0, 0]))
    # The Gaussian kernel is cut off at five standard deviations.
    distances = KDTree(x).sparse_distance_matrix(
        KDTree(x @ model.F(dt).T), 5 * std, output_type="coo_matrix"
    )
    kernel = csr_array(
        (np.exp(-0.5 * (distances.data / std) ** 2), (distances.row, distances.col)),
        distances.shape,
    )
    # Columns sum to one: no probability is lost.
    total = np.asarray(kernel.sum(axis=0))
    return csr_array(kernel / np.where(total > 0, total, 1.0))


def cell_centres(cells: int, half: float) -> Array:
    """Return the centres of the cells of a square from -half to half, (n, 2)."""
    # A cell stands for its centre.
    line = (np.arange(cells) + 0.5) * (2 * half / cells) - half
    return np.stack(np.meshgrid(line, line, indexing="ij"), axis=-1).reshape(-1, 2)
