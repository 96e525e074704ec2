"""A network of particle filters: weigh draws of the forecast by the likelihood, then resample."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..checks import Array, array, choice, count, generator, instance, number
from ..updates.particles import (
    RESAMPLING,
    ParticleCollapse,
    _distinct,
    _jittered,
    _levels,
    _picked,
    _size_of,
    _taken,
    _weighed,
)
from .driver import Late, Summary
from .failures import guarded
from .heard import Heard
from .stepping import SensorState, Step
from .wiring import Prior, SensorFilter

__all__ = ["ParticleCollapse", "ParticleFilter", "ParticleState"]

Mask = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class ParticleState(SensorState):
    """What the agents' weighted particles are between two steps.

    Parameters
    ----------
    t, ledger, rng
        As for :class:`~distfilt.filters.State`.
    points : ndarray, (*runs, A, N, d)
    log_weights : ndarray, (*runs, A, N)
        Normalised. They are those after the last observation: a step resamples first.
    history : tuple of (float, ndarray)
        Earlier times and where each particle was then.
    failed : ndarray of bool, (*runs)
        Runs that failed and are no longer updated.

    Examples
    --------
    >>> from distfilt.network import Ledger
    >>> state = ParticleState(0.0, Ledger.empty(1), np.random.default_rng(0),
    ...                       np.zeros((1, 5, 3)), np.full((1, 5), -np.log(5)))
    >>> state.runs
    ()
    """

    points: Array
    log_weights: Array

    _belief = "points", (..., "A", "N", "d")

    def __post_init__(self) -> None:
        super().__post_init__()
        generator(self.rng)
        array(self.log_weights, "log_weights", self.points.shape[:-1], finite=False)
        for _, earlier in self.history:
            array(earlier, "history", self.points.shape)

    @cached_property
    def weights(self) -> Array:
        """The normalised weights, (*runs, A, N)."""
        return np.exp(self.log_weights)

    @cached_property
    def effective_size(self) -> Array:
        """Effective sample size of each agent's weights, (*runs, A)."""
        return _size_of(self.weights)


@dataclass(frozen=True, eq=False)
class ParticleFilter(SensorFilter):
    """One bootstrap particle filter per agent, for any model and sensors.

    Parameters
    ----------
    model, sensors, graph, agreement, share, faults, lag, names, failures
        As for :class:`~distfilt.filters.SensorFilter`. The agreement is one of ensembles; agents
        resample before it.
    members : int
        Number N of particles of each agent.
    threshold : float
        An agent resamples when its effective sample size falls below this share of N, in [0, 1].
    rule : {"systematic", "stratified", "residual", "multinomial"}
        How; see :func:`distfilt.updates.resampled`.
    jitter : float, optional
        Bandwidth of the kernel that moves copies apart, in [0, 1]; 0 for none. With a model
        without noise copies never part by themselves.

    Notes
    -----
    N. J. Gordon, D. J. Salmond, A. F. M. Smith, IEE Proceedings F 140 (1993) 107-113.

    Examples
    --------
    >>> from distfilt.models import Model
    >>> from distfilt.sensors import direct
    >>> walk = Model(1, lambda x, t, dt: x, lambda t, dt: np.array([[dt]]))
    >>> f = ParticleFilter(walk, [direct([0], std=1.0)], members=500)
    >>> state = f.start(([0.0], [[1.0]]), rng=np.random.default_rng(1))
    >>> f.summary(f.step(state, 1.0, [[3.0]])).mean.round(1)
    array([[1.9]])
    """

    members: int = field(default=1000, kw_only=True)
    threshold: float = field(default=0.5, kw_only=True)
    rule: str = field(default="systematic", kw_only=True)
    jitter: float = field(default=0.0, kw_only=True)

    def __post_init__(self) -> None:
        super().__post_init__()
        count(self.members, "members", at_least=2)
        number(self.threshold, "threshold", at_least=0, at_most=1)
        choice(self.rule, "rule", RESAMPLING)
        number(self.jitter, "jitter", at_least=0, at_most=1)

    def start(
        self, prior: Prior, *, rng: np.random.Generator, runs: tuple[int, ...] = (), t: float = 0.0
    ) -> ParticleState:
        """The state before the first step; arguments as for `EnsembleFilter.start`."""
        points = self.drawn(prior, self.members, runs, rng)
        equal = np.full(points.shape[:-1], -np.log(self.members))
        return self.first(ParticleState, t, rng, points, equal)

    def step(
        self, state: ParticleState, t: float, observations: Sequence[ArrayLike | None], *,
        late: Sequence[Late] = (),
    ) -> ParticleState:
        """Move to time `t` and weigh the particles by what was observed there.

        Parameters
        ----------
        state, t, observations, late
            As for :meth:`distfilt.filters.EnsembleFilter.step`.

        Warns
        -----
        ParticleCollapse
            If less than a hundredth of an agent's particles, or only one, differ from the others,
            or if the effective size of its weights is below two.
        """
        sizes = self.members, self.model.dim
        step = self.begin(state, ParticleState, t, observations, late, sizes)
        stack = step.stack(state.points)
        weights = self._resampled(stack, state, step)
        moved = self.model._sample_step(stack[-1], state.t, step.dt, step.rng)
        stack[-1] = step.moved(moved, stack[-1], 2)
        for place, group in step.heard():
            predicted = group.predict(
                stack[place][..., group.agents, :, :], step.before(place, group.agents)
            )
            step.settle(_weigh(weights, predicted, group), group.agents)
        if step.agrees:
            # The particles have to be an ensemble, which the agreement can move.
            levels = _levels(weights.shape, step.rng, self.rule)
            self._pick(stack, weights, np.exp(weights), np.ones(weights.shape[:-1], bool), levels)
        (now,) = step.agreed(stack[-1])
        past = zip(step.times, stack[:-1], strict=True)
        after = step.end(ParticleState, now, weights, history=past)
        self._warn(after)
        return after

    def summary(self, state: ParticleState) -> Summary:
        """Weighted means and covariances, effective sizes and the share of distinct particles."""
        instance(state, "state", ParticleState)
        w = state.weights
        mean = (w[..., None, :] @ state.points)[..., 0, :]
        # Components first: weights then multiply along all particles.
        around = np.subtract(np.swapaxes(state.points, -1, -2), mean[..., None], order="C")
        cov = state.shown((w[..., None, :] * around) @ np.swapaxes(around, -1, -2))
        sizes, distinct = state.effective_size, _distinct(state.points)
        numbers = {"effective_size": state.shown(sizes), "distinct": state.shown(distinct)}
        variance = np.diagonal(cov, axis1=-2, axis2=-1)
        return Summary(state.shown(mean), variance, cov, state.points, w, numbers)

    def _resampled(self, stack: list[Array], state: ParticleState, step: Step) -> Array:
        """Log-weights after agents with a poor effective size have resampled, in place."""
        weights, before = state.log_weights.copy(), stack[-1]
        # Everybody draws, needed or not: an agent's luck must not depend on another's weights.
        levels = _levels(weights.shape, step.rng, self.rule)
        noise = step.rng.standard_normal(before.shape) if self.jitter else None
        poor = state.effective_size < self.threshold * self.members
        if not poor.any():
            return weights
        self._pick(stack, weights, state.weights, poor, levels)
        if noise is not None:
            around = before[poor] - before[poor].mean(axis=-2, keepdims=True)
            # Of all particles, weighted or not: after one weight dominated its copies have none.
            cov = np.swapaxes(around, -1, -2) @ around / self.members
            stack[-1][poor] = _jittered(stack[-1][poor], cov, self.jitter, noise[poor])
        return weights

    def _pick(
        self, stack: list[Array], log_weights: Array, weights: Array, poor: Mask, levels: Array
    ) -> None:
        """Resample some agents' paths in the stack; their weights are equal then."""
        rows = slice(None) if poor.all() else poor
        picked = _picked(weights[rows], levels[rows], self.rule)
        for k, path in enumerate(stack):
            taken = _taken(path[rows], picked)
            stack[k] = path.copy() if rows is poor else taken
            stack[k][rows] = taken
        log_weights[rows] = -np.log(self.members)

    def _warn(self, state: ParticleState) -> None:
        """Distinct particles may have no weight, and particles of equal weight may be copies."""
        if state.failed.all():
            return
        points, size = state.points, state.effective_size
        if state.failed.any():
            points, size = points[~state.failed], size[~state.failed]
        least = max(0.01 * self.members, 2.0)
        # A few that differ are proof enough; all are looked at only where they do not.
        few = points[..., :: max(1, self.members // (4 * math.ceil(least))), :]
        distinct = _distinct(few).min() * few.shape[-2] / self.members
        if distinct * self.members < least:
            distinct = _distinct(points).min()
        if distinct * self.members < least:
            what = f"{distinct:.2%} of an agent's particles are distinct"
        elif size.min() < 2:
            what = f"an agent's weights have an effective size of {size.min():.1f}"
        else:
            return
        warnings.warn(
            f"t = {state.t:g} s: {what}; more members, jitter=, or more process noise keep its "
            f"belief alive",
            ParticleCollapse,
            stacklevel=3,
        )


def _weigh(weights: Array, predicted: Array, group: Heard) -> dict[tuple[int, ...], str]:
    """Multiply a group's weights by the likelihood, in place; the rows that failed."""
    old = weights[..., group.agents, :]
    (new,), errors = guarded(
        lambda h, y, w, noise, _: (_weighed(w, h, y, noise),),
        (predicted, group.target, old), (old,), group.target.ndim - 1, shared=group.noise, rng=None,
    )
    weights[..., group.agents, :] = new
    return errors
