"""A network of particle filters: weigh draws of the forecast by the likelihood, then resample."""

from __future__ import annotations

import math
from dataclasses import KW_ONLY, dataclass
from functools import cached_property
from typing import Any, ClassVar

import numpy as np

from ..updates import particles
from ..validation import Array, Mask, UnitInterval
from .ensemble import MembersFilter, Several, regress_past
from .inbox import Received
from .record import Summary
from .saving import SensorState
from .step import Step, run_isolated

__all__ = ["ParticleFilter", "ParticleState"]


@dataclass(frozen=True, eq=False, repr=False)
class ParticleState(SensorState):
    """What the agents' weighted particles are between two steps.

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
class ParticleFilter(MembersFilter):
    """One bootstrap particle filter per agent, for any model and sensors.

    Parameters
    ----------
    model, sensors, graph, fusion, share_observations, faults, lag, names, on_error, gate_probability,
        exchange_interval
        As for :class:`~distfilt.filters.Filter`. The agreement is one of ensembles; agents
        resample before it.
    members : int
        Number N of particles of each agent.
    threshold : float
        An agent resamples, by :func:`distfilt.updates.resampled`, when its effective sample size
        falls below this share of N, in [0, 1].
    jitter : float, optional
        Bandwidth of the kernel that moves copies apart, in [0, 1], in units of the particles'
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
    members: Several = 1000
    ess_threshold: UnitInterval = 0.5
    jitter: UnitInterval | None = None

    state_class: ClassVar[type[ParticleState]] = ParticleState
    batched_summary: ClassVar[bool] = True

    def initial_state(
        self, prior: Any, runs: tuple[int, ...], rng: Any
    ) -> dict[str, Any]:
        """Particles drawn for each agent, with equal weights."""
        points = self.draw_prior(prior, (*runs, self.n_agents), rng)
        return {
            "particles": points,
            "log_weights": np.full(points.shape[:-1], -np.log(self.members)),
        }

    def next_state(self, step: Step) -> Any:
        """Resample where it is due, forecast, weigh by what was heard, agree.

        Warns
        -----
        ParticleCollapse
            If less than a hundredth of an agent's particles, or only one, differ from the others,
            or if the effective size of its weights is below two.
        """
        state = step.state
        stack = step.stack(state.particles)
        weights = self._resampled(stack, state, step)
        old = stack[
            -1
        ]  # where each particle comes from, which is not where it was in the state
        if step.dt:
            moved = self.model.sample_step(stack[-1], state.t, step.dt, rng=step.rng)
            stack[-1] = step.check_forecast(moved, stack[-1])
        for place, group in step.received():
            rows = group.rows
            before = step.before(place, group, [old] if step.dt else stack[:-1])
            predicted = group.predict(stack[place][..., rows, :, :], before)
            logs = weights[..., rows, :]
            group = step.gate(
                group, lambda x, w: weighted_moments(x, np.exp(w)), predicted, logs
            )
            step.record_failures(_weigh(weights, predicted, group), group.agents)
        if step.has_fusion:
            # The particles have to be an ensemble, which the agreement can move.
            offset = step.rng.random((*weights.shape[:-1], 1))
            self._pick(
                stack,
                weights,
                np.exp(weights),
                np.ones(weights.shape[:-1], bool),
                offset,
            )
        (now,) = step.fuse(stack[-1])
        after = step.end(
            particles=now, log_weights=weights, past=regress_past(stack, now)
        )
        self._warn(after)
        return after

    def summarize(self, state: ParticleState) -> Summary:
        """Weighted means and covariances, effective sizes and the share of distinct particles."""
        w = state.weights
        mean, cov = weighted_moments(state.particles, w)
        cov = state.mask_failed(cov)
        sizes = state.effective_size
        distinct = particles.distinct_fraction(state.particles)
        numbers = {
            "effective_size": state.mask_failed(sizes),
            "distinct": state.mask_failed(distinct),
        }
        variance = np.diagonal(cov, axis1=-2, axis2=-1)
        return Summary(
            state.mask_failed(mean), variance, cov, state.particles, w, numbers
        )

    def _resampled(self, stack: list[Array], state: ParticleState, step: Step) -> Array:
        """Log-weights after agents with a poor effective size have resampled, in place.

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
        >>> fine, poor = state.log_weights[0], np.log([0.7, 0.1, 0.1, 0.1])
        >>> moved = [
        ...     f.step(state.replace(log_weights=np.array([w, poor])), 0.0, [None] * 2)
        ...     for w in (fine, poor)
        ... ]
        >>> (moved[0].particles == moved[1].particles).all(axis=(1, 2))
        array([False,  True])
        """
        weights = state.log_weights.copy()
        before = stack[-1]
        # Everybody draws, needed or not: an agent's luck must not depend on another's weights.
        offset = step.rng.random((*weights.shape[:-1], 1))
        width = self._bandwidth(state.t, step.dt)
        noise = step.rng.standard_normal(before.shape) if width else None
        poor = state.effective_size < self.ess_threshold * self.members
        if not poor.any():
            return weights
        counts = self._pick(stack, weights, state.weights, poor, offset)
        if noise is not None:
            # Where one weight dominates, the spread of all particles: the weighted one is gone.
            lost = state.effective_size[poor][:, None] < 2
            shares = np.where(lost, 1 / self.members, state.weights[poor])
            cov = weighted_moments(before[poor], shares)[1]
            copied = particles.repeat_by_count((counts > 1)[..., None], counts).reshape(
                -1, self.members
            )
            stack[-1][poor] = particles.add_jitter(
                stack[-1][poor], cov, width, noise[poor], copied
            )
        return weights

    def _bandwidth(self, t: float, dt: float) -> float:
        """How far copies are moved apart: by default where the model never does it."""
        if self.jitter is not None:
            return self.jitter
        still = not np.count_nonzero(self.model.noise_cov(t, dt or 1.0))
        return particles.silverman(self.members, self.model.dim) if still else 0.0

    def _pick(
        self,
        stack: list[Array],
        log_weights: Array,
        weights: Array,
        poor: Mask,
        offset: Array,
    ) -> Any:
        """Resample some agents' paths in the stack; the weights are equal then."""
        rows = slice(None) if poor.all() else poor
        counts = particles.systematic_counts(weights[rows], offset[rows])
        for k, path in enumerate(stack):
            stack[k] = moved = particles.repeat_by_count(path[rows], counts)
            if rows is poor:
                stack[k] = path.copy()
                stack[k][rows] = moved
        log_weights[rows] = -np.log(self.members)
        return counts

    def _warn(self, state: ParticleState) -> None:
        """Distinct particles may have no weight, and particles of equal weight may be copies.

        >>> import warnings
        >>> from distfilt.models import constant_velocity
        >>> from distfilt.network import Ledger
        >>> f = ParticleFilter(
        ...     constant_velocity(sigma=1.0),
        ...     [None] * 2,
        ...     share_observations=False,
        ...     members=200,
        ... )
        >>> apart = np.random.default_rng(0).standard_normal((2, 200, 4))
        >>> for moved in ([1.0, 0.0], [1.0, 1.0]):  # the first components are known
        ...     points = apart * np.array(moved)[:, None, None] * [0, 1, 1, 1]
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
        least = max(0.01 * self.members, 2.0)
        # A few whose first components differ are proof enough; all are looked at where they do not.
        few = np.sort(points[..., :: max(1, self.members // (4 * math.ceil(least))), 0])
        apart = (few[..., 1:] > few[..., :-1]).sum(axis=-1)
        distinct = apart.min(initial=self.members) / self.members
        if distinct * self.members < least:
            distinct = particles.distinct_fraction(points).min()
        if distinct * self.members < least:
            what = f"{distinct:.2%} of an agent's particles are distinct"
        elif size.min(initial=np.inf) < 2:
            what = f"an agent's weights have an effective size of {size.min():.1f}"
        else:
            return
        particles.warn_of_collapse(f"t = {state.t:g} s: {what}", "jitter=")


def weighted_moments(points: Array, w: Array) -> tuple[Array, Array]:
    """Mean (..., d) and covariance (..., d, d) of points (..., N, d) with weights (..., N)."""
    mean = (w[..., None, :] @ points)[..., 0, :]
    # Components first: weights then multiply along all particles.
    around = np.subtract(points.mT, mean[..., None], order="C")
    return mean, (w[..., None, :] * around) @ around.mT


def _weigh(
    weights: Array, predicted: Array, group: Received
) -> dict[tuple[int, ...], str]:
    """Multiply a group's weights by the likelihood, in place; the rows that failed."""
    old = weights[..., group.rows, :]
    (new,), errors = run_isolated(
        lambda h, y, w, noise, _: (particles.reweight(w, h, y, noise),),
        (predicted, group.target, old),
        (old,),
        group.target.ndim - 1,
        shared=group.noise,
    )
    weights[..., group.rows, :] = new
    return errors
