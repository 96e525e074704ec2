"""A network of particle filters: weigh draws of the forecast by the likelihood, then resample."""

from __future__ import annotations

import copy
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..checks import Array, array, choice, count, generator, instance, number
from ..network import Ledger
from ..updates.particles import (
    RESAMPLING,
    _distinct,
    _effective_size,
    _jittered,
    _levels,
    _picked,
    _weighed,
)
from .driver import Late, Summary
from .failures import guarded, not_finite
from .heard import Heard
from .saving import State
from .wiring import SensorFilter

__all__ = ["ParticleCollapse", "ParticleFilter", "ParticleState"]

Mask = NDArray[np.bool_]


class ParticleCollapse(RuntimeWarning):
    """A filter's belief rests on few particles: the others are copies, or have no weight."""


@dataclass(frozen=True, eq=False)
class ParticleState(State):
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
    >>> state = ParticleState(0.0, Ledger.empty(1), np.random.default_rng(0),
    ...                       np.zeros((1, 5, 3)), np.full((1, 5), -np.log(5)))
    >>> state.runs
    ()
    """

    points: Array
    log_weights: Array
    history: tuple[tuple[float, Array], ...] = ()
    failed: Mask = field(default_factory=lambda: np.zeros((), dtype=bool))

    def __post_init__(self) -> None:
        super().__post_init__()
        points = array(self.points, "points", (..., "A", "N", "d"))
        array(self.log_weights, "log_weights", points.shape[:-1], finite=False)
        generator(self.rng)
        for _, earlier in self.history:
            array(earlier, "history", points.shape)
        object.__setattr__(self, "failed", np.broadcast_to(self.failed, self.runs))

    @property
    def runs(self) -> tuple[int, ...]:
        """Leading axes: independent runs of the network."""
        return tuple(self.points.shape[:-3])


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
        self, prior: ArrayLike | Callable[..., Array] | tuple[ArrayLike, ArrayLike], *,
        rng: np.random.Generator, runs: tuple[int, ...] = (), t: float = 0.0,
    ) -> ParticleState:
        """The state before the first step; arguments as for `EnsembleFilter.start`."""
        points = self.drawn(prior, self.members, runs, rng)
        equal = np.full(points.shape[:-1], -np.log(self.members))
        ledger = Ledger.empty(len(self.sensors))
        return ParticleState(number(t, "t"), ledger, rng.spawn(1)[0], points, equal)

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
        instance(state, "state", ParticleState)
        dt = self.elapsed(state, t)
        seen = self.observed(state, observations)
        rng = copy.deepcopy(generator(state.rng))
        channel = self.channel(state, t)
        kept = (*state.history, (state.t, state.points))[-self.lag :] if self.lag else ()
        times = [time for time, _ in kept]
        earlier = [self.slot(item, times, state) for item in late]
        poor = _effective_size(state.log_weights) < self.threshold * self.members
        stack, weights = self._resampled([e for _, e in kept], state, poor, rng)
        moved = self.model.sample_step(stack[-1], state.t, dt, rng=rng)
        failed = self.settle(not_finite(moved, 2), range(len(self.sensors)), t, state.failed)
        stack[-1] = np.where(failed[..., None, None, None], stack[-1], moved)
        for slot, observed in [*earlier, (len(times), seen)]:
            before = state.points if slot == len(times) else None
            for group in self.gather(observed, channel):
                errors = self._weigh(weights, stack[slot], group, failed, before)
                failed = self.settle(errors, group.agents, t, failed)
        if self.agreement is not None and channel is not None:
            stack, weights = self._agreed(stack, weights, channel, rng)
        ledger = state.ledger if channel is None else channel.ledger
        history = tuple(zip(times, stack[:-1], strict=True))
        self._warn(stack[-1], weights, failed, t)
        return ParticleState(float(t), ledger, rng, stack[-1], weights, history, failed)

    def summary(self, state: ParticleState) -> Summary:
        """Weighted means and covariances, effective sizes and the share of distinct particles."""
        instance(state, "state", ParticleState)
        return _summary(state, state.points)

    def past(self, state: ParticleState) -> tuple[tuple[float, Summary], ...]:
        """Earlier times, oldest first, and what is believed of them by now."""
        return tuple((t, _summary(state, points)) for t, points in state.history)

    def _resampled(
        self, earlier: list[Array], state: ParticleState, poor: Mask, rng: np.random.Generator
    ) -> tuple[list[Array], Array]:
        """Paths, and log-weights, after agents with a poor effective size have resampled."""
        paths = [*earlier, state.points]
        # Everybody draws, needed or not: an agent's luck must not depend on another's weights.
        drawn = _levels(state.log_weights.shape, rng, self.rule)
        noise = rng.standard_normal(state.points.shape) if self.jitter else None
        weights = state.log_weights.copy()
        out = [p.copy() for p in paths]
        if not poor.any():
            return out, weights
        picked = _picked(np.exp(weights[poor]), drawn[poor], self.rule)[..., None]
        for target, path in zip(out, paths, strict=True):
            target[poor] = np.take_along_axis(path[poor], picked, axis=-2)
        if noise is not None:
            around = paths[-1][poor] - paths[-1][poor].mean(axis=-2, keepdims=True)
            # Of all particles, weighted or not: after one weight dominated its copies have none.
            cov = np.swapaxes(around, -1, -2) @ around / self.members
            out[-1][poor] = _jittered(out[-1][poor], cov, self.jitter, noise[poor])
        weights[poor] = -np.log(self.members)
        return out, weights

    def _weigh(
        self, weights: Array, points: Array, group: Heard, failed: Mask, previous: Array | None
    ) -> dict[tuple[int, ...], str]:
        """Multiply a group's weights by the likelihood, in place; the rows that failed."""
        rows = group.agents
        before = None if previous is None else previous[..., rows, :, :]
        predicted = group.predict(points[..., rows, :, :], before)
        target = np.where(failed[..., None, None], np.nan, group.target)
        old = weights[..., rows, :]

        def compute(h: Array, y: Array, w: Array, noise: Array, _: Any) -> tuple[Array, ...]:
            return (_weighed(w, h, y, noise),)

        (new,), errors = guarded(
            compute, (predicted, target, old), (old,), target.ndim - 1, shared=group.noise, rng=None
        )
        weights[..., rows, :] = new
        return errors

    def _agreed(
        self, stack: list[Array], weights: Array, channel: Any, rng: np.random.Generator
    ) -> tuple[list[Array], Array]:
        """Everybody resamples, so that the particles are an ensemble that the agreement moves."""
        picked = _picked(np.exp(weights), _levels(weights.shape, rng, self.rule), self.rule)
        out = [np.take_along_axis(p, picked[..., None], axis=-2) for p in stack]
        assert self.agreement is not None
        out[-1] = array(self.agreement(out[-1], channel), "agreement", out[-1].shape)
        return out, np.full_like(weights, -np.log(self.members))

    def _warn(self, points: Array, weights: Array, failed: Mask, t: float) -> None:
        """Distinct particles may have no weight, and particles of equal weight may be copies."""
        if failed.all():
            return
        distinct, size = _distinct(points[~failed]), _effective_size(weights[~failed])
        if distinct.min() < max(0.01, 2 / self.members):
            what = f"{distinct.min():.2%} of an agent's particles are distinct"
        elif size.min() < 2:
            what = f"an agent's weights have an effective size of {size.min():.1f}"
        else:
            return
        warnings.warn(
            f"t = {t:g} s: {what}; more members, jitter=, or more process noise keep its belief "
            f"alive",
            ParticleCollapse,
            stacklevel=3,
        )


def _summary(state: ParticleState, points: Array) -> Summary:
    w = np.exp(state.log_weights)
    mean = (w[..., None, :] @ points)[..., 0, :]
    around = points - mean[..., None, :]
    cov = np.swapaxes(around, -1, -2) @ (w[..., None] * around)
    if state.failed.any():
        mean[state.failed], cov[state.failed] = np.nan, np.nan
    numbers = {"effective_size": _effective_size(state.log_weights), "distinct": _distinct(points)}
    return Summary(mean, np.diagonal(cov, axis1=-2, axis2=-1), cov, points, w, numbers)
