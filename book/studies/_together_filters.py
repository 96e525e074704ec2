"""Filters of chapter 11 that the library does not have: flooding, consensus on information,
exchange of target beliefs, likelihood consensus, and beliefs on a grid.

All are families of the library's `Filter`: they differ in `next_state` alone.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import KW_ONLY, dataclass
from functools import cache
from typing import Any

import numpy as np

from distfilt import filters, network
from distfilt.filters import (
    EnsembleFilter,
    GaussianFilter,
    Observation,
    ParticleFilter,
    Summary,
)
from distfilt.updates import resample
from distfilt.updates.particles import log_likelihood

Array = np.ndarray
Information = tuple[Array, Array]
"""Information matrix (..., n, n) and information vector (..., n)."""

# ------------------------------------------------------------------------------------- flooding


class FloodingMixin:
    """Flood the observations of a time before any agent filters.

    An observation crosses a link at most once in each direction, with the
    number of the agent that made it, until all agents have all observations.
    """

    def next_state(self, step: Any) -> Any:
        """Flood, then go on as the family does."""
        if step.channel is not None:
            step.observations = flood_observations(
                step.observations, step.channel, step.t
            )
        return super().next_state(step)  # type: ignore[misc]


Box = dict[int, Observation]
"""Observations by the number of the agent that made each."""


def flood_observations(
    observations: Sequence[Sequence[Observation]], channel: Any, t: float
) -> list[list[Observation]]:
    """Return all observations for every agent; each agent makes at most one."""
    collected: list[Box] = [{r.agent: r for r in mine} for mine in observations]
    fresh = [dict(box) for box in collected]
    while any(fresh):
        inbox = channel.broadcast([pack_observations(box) for box in fresh])
        # Only observations that an agent did not have are sent on.
        fresh = [
            unpack_observations(payloads.values(), box, t)
            for payloads, box in zip(inbox, collected, strict=True)
        ]
        for box, new in zip(collected, fresh, strict=True):
            box.update(new)
    return [[box[agent] for agent in sorted(box)] for box in collected]


def pack_observations(box: Box) -> tuple[Array, ...] | None:
    """Return the payload of some observations: values, then the makers' numbers."""
    if not box:
        return None
    values = [observation.value for observation in box.values()]
    makers = [
        np.full((*value.shape[:-1], 1), agent)
        for agent, value in zip(box, values, strict=True)
    ]
    return tuple(values + makers)


def unpack_observations(payloads: Any, collected: Box, t: float) -> Box:
    """Return the observations in some payloads that are not yet collected."""
    fresh: Box = {}
    for payload in payloads:
        half = len(payload) // 2
        for value, maker in zip(payload[:half], payload[half:], strict=True):
            agent = int(maker.flat[0])
            if agent not in collected:
                fresh[agent] = Observation.construct(t, agent, value)
    return fresh


class FloodedGaussian(FloodingMixin, GaussianFilter):
    """Kalman filters with the observations of all agents."""


class FloodedEnsemble(FloodingMixin, EnsembleFilter):
    """Ensemble filters with the observations of all agents."""


class FloodedParticles(FloodingMixin, ParticleFilter):
    """Particle filters with the observations of all agents."""


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


@dataclass(frozen=True, eq=False)
class MeasurementConsensus(GaussianFilter):
    """Kalman filters that average HᵀR⁻¹H and HᵀR⁻¹z over the network and add A times the mean."""

    _: KW_ONLY
    agree: Callable[..., Array] = network.finite_time_consensus
    share_observations: bool = False

    def next_state(self, step: Any) -> Any:
        """Forecast, linearize, average the information, add it."""
        t = step.state.t
        d = self.model.dim
        F = self.model.jacobian(step.state.means, t, step.dt)
        m = self.model.step(step.state.means, t, step.dt)
        P = F @ step.state.covariances @ F.mT + self.model.Q(t, step.dt)
        P = self.inflation**2 * P
        # [HᵀR⁻¹H, HᵀR⁻¹z] of each agent, side by side
        information = np.zeros((*m.shape[:-1], d, d + 1))
        for _, group in step.received():
            a = group.agents
            H = group.jacobian(m[..., a, :])
            predicted = group.predict(m[..., a, None, :])[..., 0, :]
            innovation = group.target - predicted
            # z = y - h(m) + H m is linear in the state.
            z = innovation[..., None] + H @ m[..., a, :, None]
            W = H.mT @ np.linalg.inv(group.noise)
            information[..., a, :, :] = W @ np.concatenate([H, z], axis=-1)
        # A symmetric matrix is sent by its upper triangle.
        rows, columns = np.triu_indices(d, 0, d + 1)
        numbers = np.ascontiguousarray(information[..., rows, columns])
        total = self.n_agents * self.agree(numbers, step.channel)
        information[..., rows, columns] = total
        square = information[..., :d]
        J = np.triu(square) + np.triu(square, 1).mT
        m, P = add_information(m, P, J, information[..., d])
        return step.end(joint_means=m, joint_covariances=P, dim=d, history=())


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
        m, P = self._forecast_moments(step)
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

    def _forecast_moments(self, step: Any) -> tuple[Array, Array]:
        t = step.state.t
        F = self.model.jacobian(step.state.means, t, step.dt)
        m = self.model.step(step.state.means, t, step.dt)
        P = F @ step.state.covariances @ F.mT + self.model.Q(t, step.dt)
        return m, self.inflation**2 * P

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
        H = group.jacobian(m)
        gain = P @ H.mT @ np.linalg.inv(H @ P @ H.mT + group.noise)
        innovation = group.target - group.predict(m[..., None, :])[..., 0, :]
        m = m + (gain @ innovation[..., None])[..., 0]
        P = P - gain @ H @ P
    return m, P


def target_information(mean: Array, cov: Array, n: int) -> Information:
    """Return information matrix and vector of the first n components."""
    matrix = np.linalg.inv(cov[..., :n, :n])
    return matrix, (matrix @ mean[..., :n, None])[..., 0]


def upper_triangle(belief: Information) -> Array:
    """Return the upper triangle of a symmetric matrix, then a vector."""
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


class FloodedGrid(FloodingMixin, GridFilter):
    """Grid filters with the observations of all agents."""


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
    line = (np.arange(cells) + 0.5) * (2 * half / cells) - half
    return np.stack(np.meshgrid(line, line, indexing="ij"), axis=-1).reshape(-1, 2)
