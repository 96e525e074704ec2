"""A network of particle filters: weight draws of the forecast by the likelihood, then resample."""

from __future__ import annotations

import math
from dataclasses import KW_ONLY, dataclass
from functools import cached_property
from typing import Any, ClassVar

import numpy as np

from ..updates import particles
from ..validation import Array, Mask, UnitInterval
from .ensemble import AtLeastTwo, MembersFilter, regress_past
from .options import ExchangesAtIntervals, SharesObservations
from .priors import Prior
from .record import Summary
from .states import SensorState
from .step import Received, Step

__all__ = ["ParticleFilter", "ParticleState"]


@dataclass(frozen=True, eq=False, repr=False)
class ParticleState(SensorState):
    """The agents' weighted particles between two steps.

    Parameters
    ----------
    t, ledger, rng, rejected, failed, pending
        As for :class:`~distfilt.filters.SensorState`.
    particles : ndarray, (*runs, A, N, d)
    log_weights : ndarray, (*runs, A, N)
        Normalised. They are those after the last observation: a step resamples first.
    history : tuple of (float, ndarray)
        Earlier times and where each particle was then.

    Examples
    --------
    >>> from distfilt.network import Ledger
    >>> state = ParticleState(
    ...     0.0,
    ...     Ledger.empty(1),
    ...     np.random.default_rng(0),
    ...     np.zeros((1, 5, 3)),
    ...     np.full((1, 5), -np.log(5)),
    ... )
    >>> state.runs
    ()
    """

    particles: Array
    log_weights: Array

    belief_field = "particles", (..., "A", "N", "d")

    @cached_property
    def weights(self) -> Array:
        """The normalised weights, (*runs, A, N)."""
        return np.exp(self.log_weights)

    @cached_property
    def effective_size(self) -> Array:
        """Effective sample size of each agent's weights, (*runs, A)."""
        return particles.size_of(self.weights)


@dataclass(frozen=True, eq=False)
class ParticleFilter(
    MembersFilter[ParticleState],
    SharesObservations[ParticleState],
    ExchangesAtIntervals[ParticleState],
):
    """One bootstrap particle filter per agent, for any model and sensors.

    Parameters
    ----------
    model, sensors, graph, gate_probability, faults, names
        As for :class:`~distfilt.filters.SensorFilter`.
    fusion, share_observations, lag, on_error, exchange_interval
        As in :mod:`distfilt.filters.options`. The rule is one of ensembles; agents resample
        before it.
    members : int
        Number N of particles of each agent.
    ess_threshold : float
        An agent resamples, by :func:`distfilt.updates.resample`, when its effective sample size
        falls below this fraction of N, in [0, 1].
    jitter : float, optional
        Bandwidth of the kernel that separates copies, in [0, 1], in units of the particles'
        weighted spread; 0 for none. Particles that were not copied stay. By default Silverman's
        for a model without noise, whose copies never part by themselves, and none for others.

    Notes
    -----
    N. J. Gordon, D. J. Salmond, A. F. M. Smith, IEE Proceedings F 140 (1993) 107-113.

    Examples
    --------
    >>> from distfilt.models import Model
    >>> from distfilt.sensors import component
    >>> walk = Model(1, lambda x, t, dt: x, lambda t, dt: np.array([[dt]]))
    >>> f = ParticleFilter(walk, [component([0], std=1.0)], members=500)
    >>> state = f.start(([0.0], [[1.0]]), rng=np.random.default_rng(1))
    >>> f.summarize(f.step(state, 1.0, [[3.0]])).mean.round(1)
    array([[1.9]])
    """

    _: KW_ONLY
    members: AtLeastTwo = 1000
    ess_threshold: UnitInterval = 0.5
    jitter: UnitInterval | None = None

    state_class: ClassVar[type[Any]] = ParticleState
    batched_summary: ClassVar[bool] = True

    def initial_state(
        self, prior: Prior, runs: tuple[int, ...], rng: Any
    ) -> dict[str, Any]:
        """Draw particles for each agent, with equal weights."""
        drawn = self.draw_prior(prior, (*runs, self.n_agents), rng)
        # log(1/N)
        log_weights = np.full(drawn.shape[:-1], -np.log(self.members))
        return {"particles": drawn, "log_weights": log_weights}

    def next_state(self, step: Step[ParticleState]) -> ParticleState:
        """Resample where it is due, forecast, weight by the likelihood, fuse.

        Warns
        -----
        ParticleCollapse
            If less than a hundredth of an agent's particles, or only one, are distinct, or if the
            effective size of its weights is below two.
        """
        state = step.state
        # Whole paths are resampled: the stack holds each particle's earlier states too.
        stack = step.stack(state.particles)
        log_weights = self._resample(stack, state, step)
        # Where each particle comes from: resampling has moved it from its place in the state.
        origin = stack[-1]
        if step.dt:
            moved = self.model.sample_step(origin, state.t, step.dt, rng=step.rng)
            stack[-1] = step.check_forecast(moved, origin)
        for place, group in step.received():
            past = [origin] if step.dt else stack[:-1]
            self._weight(log_weights, stack[place], place, group, past, step)
        if step.has_fusion:
            # A fusion rule moves an ensemble, so the particles need equal weights.
            offset = step.rng.random((*log_weights.shape[:-1], 1))
            everybody = np.ones(log_weights.shape[:-1], bool)
            weights = np.exp(log_weights)
            self._select(stack, log_weights, weights, everybody, offset)
        (fused,) = step.fuse(stack[-1])
        # The fusion moves the present particles; the earlier ones follow by regression.
        past = regress_past(stack, fused)
        after = step.end(particles=fused, log_weights=log_weights, past=past)
        self._warn(after)
        return after

    def summarize(self, state: ParticleState) -> Summary:
        """Return weighted moments, effective sizes and the fraction of distinct particles."""
        weights = state.weights
        # A failed run is NaN in the record.
        mean, cov = compute_moments(state.particles, weights)
        cov = state.mask_failed(cov)
        distinct = particles.distinct_fraction(state.particles)
        numbers = {
            "effective_size": state.mask_failed(state.effective_size),
            "distinct": state.mask_failed(distinct),
        }
        variance = np.diagonal(cov, axis1=-2, axis2=-1)
        mean = state.mask_failed(mean)
        return Summary(mean, variance, cov, state.particles, weights, numbers)

    def _weight(
        self,
        log_weights: Array,
        members: Array,
        place: int,
        group: Received,
        past: list[Array],
        step: Step[ParticleState],
    ) -> None:
        """Multiply a group's weights by the likelihood of its observations, in place."""
        rows = group.rows
        previous = step.before(place, group, past)
        predicted = group.predict(members[..., rows, :, :], previous)
        # log w' = log w + log p(y | x), normalised; the gate weighs by the old weights.
        old = log_weights[..., rows, :]
        group = step.gate(group, _moments_by_logs, predicted, old)

        def compute(h: Array, y: Array, logs: Array, noise: Array, _: Any) -> Any:
            return (particles.reweight(logs, h, y, noise),)

        (new,) = step.apply(
            compute,
            (predicted, group.target, old),
            (old,),
            group.agents,
            shared=group.noise,
        )
        log_weights[..., rows, :] = new

    def _resample(
        self, stack: list[Array], state: ParticleState, step: Step[ParticleState]
    ) -> Array:
        """Resample agents with a small effective size, in place; return the log-weights.

        >>> from distfilt.models import constant_velocity
        >>> f = ParticleFilter(
        ...     constant_velocity(sigma=1.0),
        ...     [None] * 2,
        ...     share_observations=False,
        ...     members=4,
        ...     ess_threshold=0.9,
        ...     jitter=0.5,
        ... )
        >>> state = f.start((np.zeros(4), np.eye(4)), rng=np.random.default_rng(0))
        >>> equal, unequal = state.log_weights[0], np.log([0.7, 0.1, 0.1, 0.1])
        >>> after = [
        ...     f.step(
        ...         state.replace(log_weights=np.array([w, unequal])), 0.0, [None] * 2
        ...     )
        ...     for w in (equal, unequal)
        ... ]
        >>> (after[0].particles == after[1].particles).all(axis=(1, 2))
        array([False,  True])
        """
        log_weights = state.log_weights.copy()
        before = stack[-1]
        # Every agent draws, also if it does not resample: its numbers must not depend on
        # another's weights.
        offset = step.rng.random((*log_weights.shape[:-1], 1))
        bandwidth = self._bandwidth(state.t, step.dt)
        noise = step.rng.standard_normal(before.shape) if bandwidth else None
        # N_eff = 1 / Σ w²
        is_due = state.effective_size < self.ess_threshold * self.members
        if not is_due.any():
            return log_weights
        counts = self._select(stack, log_weights, state.weights, is_due, offset)
        if noise is not None:
            # Where one weight dominates, the weighted spread is gone; all particles' is used.
            is_degenerate = state.effective_size[is_due][:, None] < 2
            equal = 1 / self.members
            weights = np.where(is_degenerate, equal, state.weights[is_due])
            _, cov = compute_moments(before[is_due], weights)
            is_copied = (counts > 1)[..., None]
            copied = particles.repeat_by_count(is_copied, counts)
            stack[-1][is_due] = particles.add_jitter(
                stack[-1][is_due],
                cov,
                bandwidth,
                noise[is_due],
                copied.reshape(-1, self.members),
            )
        return log_weights

    def _bandwidth(self, t: float, dt: float) -> float:
        """Return the bandwidth of the jitter; by default none if the model has noise."""
        if self.jitter is not None:
            return self.jitter
        # A step of no length adds no noise, so a unit step shows whether the model has any.
        if np.count_nonzero(self.model.Q(t, dt or 1.0)):
            return 0.0
        return particles.silverman(self.members, self.model.dim)

    def _select(
        self,
        stack: list[Array],
        log_weights: Array,
        weights: Array,
        agents: Mask,
        offset: Array,
    ) -> Any:
        """Resample some agents' paths in the stack; their weights are equal then.

        Returns how often each particle was taken.
        """
        rows: Any = slice(None) if agents.all() else agents
        counts = particles.systematic_counts(weights[rows], offset[rows])
        for k, path in enumerate(stack):
            taken = particles.repeat_by_count(path[rows], counts)
            if rows is agents:
                stack[k] = path.copy()
                stack[k][rows] = taken
            else:
                stack[k] = taken
        # After resampling every particle has the weight 1/N.
        log_weights[rows] = -np.log(self.members)
        return counts

    def _warn(self, state: ParticleState) -> None:
        """Warn if few particles are distinct, or if few of them have any weight.

        >>> import warnings
        >>> from distfilt.models import constant_velocity
        >>> from distfilt.network import Ledger
        >>> f = ParticleFilter(
        ...     constant_velocity(sigma=1.0),
        ...     [None] * 2,
        ...     share_observations=False,
        ...     members=200,
        ... )
        >>> drawn = np.random.default_rng(0).standard_normal((2, 200, 4))
        >>> for scale in ([1.0, 0.0], [1.0, 1.0]):  # the first components are known
        ...     points = drawn * np.array(scale)[:, None, None] * [0, 1, 1, 1]
        ...     with warnings.catch_warnings(record=True) as caught:
        ...         warnings.simplefilter("always")
        ...         f._warn(
        ...             ParticleState(
        ...                 1.0,
        ...                 Ledger.empty(2),
        ...                 None,
        ...                 points,
        ...                 np.full((2, 200), -np.log(200)),
        ...             )
        ...         )
        ...     [str(w.message)[:47] for w in caught]
        ["t = 1 s: 0.50% of an agent's particles are dist"]
        []
        """
        points = state.particles
        size = state.effective_size
        if np.count_nonzero(state.failed):
            points = points[~state.failed]
            size = size[~state.failed]
        fewest = max(0.01 * self.members, 2.0)
        distinct = self._count_distinct(points, fewest) / self.members
        if distinct * self.members < fewest:
            problem = f"{distinct:.2%} of an agent's particles are distinct"
        elif size.min(initial=np.inf) < 2:
            problem = f"an agent's weights have an effective size of {size.min():.1f}"
        else:
            return
        particles.warn_of_collapse(f"t = {state.t:g} s: {problem}", "jitter=")

    def _count_distinct(self, points: Array, fewest: float) -> float:
        """Return a lower bound of each agent's number of distinct particles, above `fewest`."""
        # A sample whose first components differ is enough. Only if they do not, e.g. because a
        # component is known, all particles are compared.
        stride = max(1, self.members // (4 * math.ceil(fewest)))
        first = np.sort(points[..., ::stride, 0])
        n_distinct = (first[..., 1:] > first[..., :-1]).sum(axis=-1)
        bound = float(n_distinct.min(initial=self.members))
        if bound < fewest:
            bound = particles.distinct_fraction(points).min() * self.members
        return bound


def _moments_by_logs(predicted: Array, log_weights: Array) -> tuple[Array, Array]:
    return compute_moments(predicted, np.exp(log_weights))


def compute_moments(points: Array, weights: Array) -> tuple[Array, Array]:
    """Mean (..., d) and covariance (..., d, d) of points (..., N, d) with weights (..., N)."""
    # m = Σ wᵢ xᵢ and P = Σ wᵢ (xᵢ - m)(xᵢ - m)ᵀ
    mean = (weights[..., None, :] @ points)[..., 0, :]
    # Components first, so that the weights multiply along contiguous particles.
    anomalies = np.subtract(points.mT, mean[..., None], order="C")
    return mean, (weights[..., None, :] * anomalies) @ anomalies.mT
