"""A network of ensemble filters: forecast, assimilate what was heard, agree with the neighbours.

Algorithm 1 of Grange et al., for any model, sensors, graph, update and rule of agreement.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from .. import ensembles as moments
from ..checks import Array, array, callable_, count, generator, instance
from ..doors import unchecked
from ..models import Model
from ..network import Graph, intersection
from ..sensors import Sensor
from ..updates import exact_draws, exact_forecast, known_noise, sampled_forecast, with_missing
from ..updates.door import Update, stackable
from .driver import Late, Summary
from .failures import guarded
from .heard import Heard
from .stepping import SensorState, Step
from .wiring import Prior, SensorFilter

__all__ = ["EnsembleFilter", "EnsembleState"]


@dataclass(frozen=True, eq=False)
class EnsembleState(SensorState):
    """What the agents' ensembles are between two steps.

    Parameters
    ----------
    t, ledger, rng
        As for :class:`~distfilt.filters.State`.
    ensembles : ndarray, (*runs, A, N, d)
        Every agent's members.
    history : tuple of (float, ndarray)
        Earlier times and their ensembles, oldest first, conditioned on all that came since.
    failed : ndarray of bool, (*runs)
        Runs that failed and are no longer updated.

    Examples
    --------
    >>> from distfilt.network import Ledger
    >>> state = EnsembleState(0.0, Ledger.empty(2), np.random.default_rng(0), np.zeros((2, 5, 3)))
    >>> state.agents, state.members, state.dim
    (2, 5, 3)
    """

    ensembles: Array

    _belief = "ensembles", (..., "A", "N", "d")

    def __post_init__(self) -> None:
        super().__post_init__()
        generator(self.rng)
        for _, earlier in self.history:
            array(earlier, "history", self.ensembles.shape)

    @property
    def agents(self) -> int:
        """Number A of agents."""
        return int(self.ensembles.shape[-3])

    @property
    def members(self) -> int:
        """Number N of members of each agent."""
        return int(self.ensembles.shape[-2])

    @property
    def dim(self) -> int:
        """Size d of the state vector."""
        return int(self.ensembles.shape[-1])


@dataclass(frozen=True, eq=False)
class EnsembleFilter(SensorFilter):
    """One ensemble per agent; agents share observations and agree with each other.

    In every step each agent moves its members with the model, sends its observation to those that
    hear it, updates its members with what it knows, and applies the rule of agreement. All that
    passes between agents passes through one :class:`~distfilt.network.Channel`.

    Parameters
    ----------
    model, sensors, graph, agreement, share, faults, lag, names, failures
        As for :class:`~distfilt.filters.SensorFilter`. The agreement is a function
        ``agreement(ensembles, channel) -> ensembles``, such as ``partial(pull, gain=0.05)``.
    update : callable
        ``update(ensemble, predicted, observed, noise, *, rng) -> ensemble``; one of
        :mod:`distfilt.updates`, or a function of one's own for a single agent's ensembles.
    forecast : callable
        ``forecast(ensemble, model, t, dt, *, rng) -> ensemble``.
    members : int
        Number N of members of each agent.

    Examples
    --------
    >>> from distfilt.network import graphs
    >>> from distfilt.sensors import direct
    >>> walk = Model(1, lambda x, t, dt: x, lambda t, dt: np.array([[dt]]))
    >>> f = EnsembleFilter(walk, [direct([0], std=0.5), None], graphs.path(2), members=500)
    >>> state = f.start(([0.0], [[1.0]]), rng=np.random.default_rng(0))
    >>> state = f.step(state, 1.0, [[0.8], None])
    >>> state.ensembles.mean(axis=1).round(1).ravel()
    array([0.7, 0.7])
    """

    update: Update = field(default=known_noise, kw_only=True)
    forecast: Callable[..., Array] = field(default=sampled_forecast, kw_only=True)
    members: int = field(default=100, kw_only=True)

    def __post_init__(self) -> None:
        super().__post_init__()
        callable_(self.update, "update")
        callable_(self.forecast, "forecast")
        count(self.members, "members", at_least=2)

    @classmethod
    def exact(
        cls, model: Model, sensors: Sequence[Sensor | None],
        graph: Graph | Callable[[float], Graph] | None = None, **options: Any,
    ) -> EnsembleFilter:
        """Second-order exact draws and covariance intersection of least determinant.

        For a linear model and linear sensors every agent's sample moments are those of the Kalman
        filters that fuse by the same rule; the book's chapter 4 measures it on others.

        Parameters
        ----------
        model, sensors, graph
            As for the class.
        **options
            Any other option of the class; needs more `members` than d + twice the readings heard.

        Examples
        --------
        >>> from distfilt.sensors import direct
        >>> walk = Model(1, lambda x, t, dt: x, lambda t, dt: np.array([[dt]]))
        >>> f = EnsembleFilter.exact(walk, [direct([0], std=1.0)], members=10)
        >>> prior = np.linspace(-1, 1, 10)[:, None]
        >>> state = f.step(f.start(prior, rng=np.random.default_rng(0)), 1.0, [[0.8]])
        >>> p = prior.var(ddof=1) + 1.0
        >>> bool(abs(state.ensembles.var(ddof=1) - p / (p + 1.0)) < 1e-12)
        True
        """
        own: dict[str, Any] = {"update": exact_draws, "forecast": exact_forecast}
        if graph is not None:
            own["agreement"] = partial(intersection, rule="min_determinant")
        return cls(model, sensors, graph, **(own | options))

    def start(
        self, prior: Prior, *, rng: np.random.Generator, runs: tuple[int, ...] = (), t: float = 0.0
    ) -> EnsembleState:
        """The state before the first step.

        Parameters
        ----------
        prior : tuple, array_like or callable
            A Gaussian's ``(mean, cov)``, (d,) and (d, d); members (N, d) for every agent and run,
            or (*runs, A, N, d); or a function ``prior(members, rng=rng, leading=leading)`` that
            draws (*leading, N, d).
        rng : numpy.random.Generator
            Draws the prior; a child stream of it, independent of whatever else is drawn from it,
            serves all later steps.
        runs : tuple of int
            Leading axes: independent runs.
        t : float
            The time of the prior, in s.
        """
        return self.first(EnsembleState, t, rng, self.drawn(prior, self.members, runs, rng))

    def step(
        self, state: EnsembleState, t: float, observations: Sequence[ArrayLike | None], *,
        late: Sequence[Late] = (),
    ) -> EnsembleState:
        """Move to time `t` and take in what was observed there.

        Parameters
        ----------
        state : EnsembleState
            Not changed.
        t : float
            The new time, after the state's.
        observations : sequence of length A
            Per agent (*runs, m) or (m,), or None. NaN marks a missing component, run by run.
        late : sequence of Late
            Observations of earlier times that arrive now; needs a `lag` that reaches back to them.

        Raises
        ------
        ValueError
            If `t` is not later, or an observation does not fit its sensor or no earlier state is
            kept for a late one.
        FilterError
            If a run fails; see `failures`.
        """
        sizes = self.members, self.model.dim
        step = self.begin(state, EnsembleState, t, observations, late, sizes)
        moved = self.forecast(state.ensembles, self.model, state.t, step.dt, rng=step.rng)
        moved = array(moved, "forecast", state.ensembles.shape, finite=False)
        stack = step.stack(step.moved(moved, state.ensembles, 2))
        for place, group in step.heard():
            step.settle(self._condition(stack, place, group, step), group.agents)
        (now,) = step.agreed(stack[-1])
        return step.end(EnsembleState, now, history=zip(step.times, stack[:-1], strict=True))

    def summary(self, state: EnsembleState) -> Summary:
        """Ensemble means and variances; the members for the scores."""
        return ensemble_summary(state)

    def _condition(
        self, stack: list[Array], place: int, group: Heard, step: Step
    ) -> dict[tuple[int, ...], str]:
        """Condition every time's ensembles of a group's agents, in place; the rows that failed."""
        rows = group.agents
        members = tuple(e[..., rows, :, :] for e in stack)
        before = step.before(place, rows)
        predicted = group.predict(members[place], before)
        repredicts = getattr(self.update, "repredicts", False) and len(stack) == 1

        def compute(h: Array, y: Array, *rest: Any) -> tuple[Array, ...]:
            *ensembles, noise, source = rest
            options: dict[str, Any] = {}
            if repredicts and h.shape == predicted.shape:
                options["predict"] = lambda x: group.predict(x, before)
            # Every time's members meet the same draw of the noise, so that all the separate
            # updates are one joint update; the last one advances the generator.
            sources = [copy.deepcopy(source) for _ in ensembles[1:]] + [source]
            both = zip(ensembles, sources, strict=True)
            return tuple(self._updated(x, h, y, noise, own, options) for x, own in both)

        result, errors = guarded(
            compute, (predicted, group.target, *members), members, group.target.ndim - 1,
            shared=group.noise, rng=step.rng,
        )
        for e, new in zip(stack, result, strict=True):
            e[..., rows, :, :] = new
        return errors

    def _updated(
        self, x: Array, h: Array, y: Array, noise: Array, rng: Any, options: dict[str, Any]
    ) -> Array:
        """One time's ensembles after the update; a plain function gets one agent's at a time."""
        if options or getattr(self.update, "repredicts", False):
            return unchecked(self.update)(x, h, y, noise, rng=rng, **options)
        if stackable(self.update) or x.ndim == 2:
            new = with_missing(self.update, x, h, y, noise, rng=rng)
            return array(new, "update", x.shape, finite=False)
        out = np.empty_like(x)
        for g in range(x.shape[-3]):
            r = noise[g] if noise.ndim > 2 else noise
            new = with_missing(
                self.update, x[..., g, :, :], h[..., g, :, :], y[..., g, :], r, rng=rng
            )
            out[..., g, :, :] = array(new, "update", x[..., g, :, :].shape, finite=False)
        return out


def ensemble_summary(state: EnsembleState) -> Summary:
    """Means and variances of the agents' ensembles, and the members for the scores."""
    x = instance(state, "state", EnsembleState).ensembles
    squares = moments.mean(moments.anomalies(x) ** 2)
    variance = squares * state.members / (state.members - 1)
    return Summary(state.shown(moments.mean(x)), state.shown(variance), members=x)
