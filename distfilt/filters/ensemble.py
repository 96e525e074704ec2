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
from numpy.typing import ArrayLike, NDArray

from .. import ensembles as moments
from ..checks import Array, array, callable_, count, generator, instance, number
from ..models import Model
from ..network import Graph, Ledger, intersection
from ..sensors import Sensor
from ..updates import exact_draws, exact_forecast, known_noise, sampled_forecast, with_missing
from ..updates.door import Update, stackable, unchecked
from .driver import Late, Summary
from .failures import guarded, not_finite
from .heard import Heard
from .saving import State
from .wiring import SensorFilter

__all__ = ["EnsembleFilter", "EnsembleState"]

Mask = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class EnsembleState(State):
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
    >>> state = EnsembleState(0.0, Ledger.empty(2), np.random.default_rng(0), np.zeros((2, 5, 3)))
    >>> state.agents, state.members, state.dim
    (2, 5, 3)
    """

    ensembles: Array
    history: tuple[tuple[float, Array], ...] = ()
    failed: Mask = field(default_factory=lambda: np.zeros((), dtype=bool))

    def __post_init__(self) -> None:
        super().__post_init__()
        ensembles = array(self.ensembles, "ensembles", (..., "A", "N", "d"))
        generator(self.rng)
        if self.ledger.messages.size != ensembles.shape[-3]:
            raise ValueError(
                f"ledger: needs {ensembles.shape[-3]} agents, got {self.ledger.messages.size}"
            )
        for _, earlier in self.history:
            array(earlier, "history", ensembles.shape)
        object.__setattr__(self, "failed", np.broadcast_to(self.failed, self.runs))

    @property
    def runs(self) -> tuple[int, ...]:
        """Leading axes: independent runs of the network."""
        return tuple(self.ensembles.shape[:-3])

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
        self, prior: ArrayLike | Callable[..., Array] | tuple[ArrayLike, ArrayLike], *,
        rng: np.random.Generator, runs: tuple[int, ...] = (), t: float = 0.0,
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
        drawn = self.drawn(prior, self.members, runs, rng)
        ledger = Ledger.empty(len(self.sensors))
        return EnsembleState(number(t, "t"), ledger, rng.spawn(1)[0], drawn)

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
        self._check_state(state)
        dt = self.elapsed(state, t)
        seen = self.observed(state, observations)
        kept = (*state.history, (state.t, state.ensembles)) if self.lag else ()
        times = [time for time, _ in kept]
        earlier = [self.slot(item, times, state) for item in late]
        rng = copy.deepcopy(generator(state.rng))
        channel = self.channel(state, t)
        moved = self.forecast(state.ensembles, self.model, state.t, dt, rng=rng)
        moved = array(moved, "forecast", state.ensembles.shape, finite=False)
        failed = self.settle(not_finite(moved, 2), range(state.agents), t, state.failed)
        moved = np.where(failed[..., None, None, None], state.ensembles, moved)
        stack = [*(e.copy() for _, e in kept), moved]
        readings = [*earlier, (len(times), seen)]
        for slot, observed in readings:
            before = state.ensembles if slot == len(times) else None
            for group in self.gather(observed, channel):
                errors = self._condition(stack, slot, group, failed, rng, before)
                failed = self.settle(errors, group.agents, t, failed)
        now = stack[-1]
        if self.agreement is not None and channel is not None:
            now = array(self.agreement(now, channel), "agreement", now.shape)
        history = tuple(zip(times, stack[:-1], strict=True))[-self.lag :] if self.lag else ()
        ledger = state.ledger if channel is None else channel.ledger
        return EnsembleState(float(t), ledger, rng, now, history, failed)

    def summary(self, state: EnsembleState) -> Summary:
        """Ensemble means and variances; the members for the scores."""
        return _summary(state.ensembles, state.failed)

    def past(self, state: EnsembleState) -> tuple[tuple[float, Summary], ...]:
        """Earlier times, oldest first, and what is believed of them by now."""
        return tuple((t, _summary(e, state.failed)) for t, e in state.history)

    def _condition(
        self, stack: list[Array], slot: int, group: Heard, failed: Mask, rng: np.random.Generator,
        previous: Array | None,
    ) -> dict[tuple[int, ...], str]:
        """Condition every time's ensembles of a group's agents, in place; the rows that failed."""
        rows = group.agents
        members = tuple(e[..., rows, :, :] for e in stack)
        before = None if previous is None else previous[..., rows, :, :]
        predicted = group.predict(members[slot], before)
        target = np.where(failed[..., None, None], np.nan, group.target)
        repredicts = bool(getattr(self.update, "repredicts", False)) and len(stack) == 1

        def compute(h: Array, y: Array, *rest: Any) -> tuple[Array, ...]:
            *ensembles, noise, source = rest
            whole = h.shape == predicted.shape
            options: dict[str, Any] = {}
            if repredicts and whole:
                options["predict"] = lambda x: group.predict(x, before)
            out = []
            for k, x in enumerate(ensembles):
                # Every time's members meet the same draw of the noise, so that all the separate
                # updates are one joint update; the last one advances the generator.
                own = source if k == len(ensembles) - 1 else copy.deepcopy(source)
                out.append(self._updated(x, h, y, noise, own, options))
            return tuple(out)

        arrays = (predicted, target, *members)
        result, errors = guarded(
            compute, arrays, members, target.ndim - 1, shared=group.noise, rng=rng
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

    def _check_state(self, state: Any) -> None:
        instance(state, "state", EnsembleState)
        needed = (len(self.sensors), self.members, self.model.dim)
        if state.ensembles.shape[-3:] != needed:
            raise ValueError(f"state: needs ensembles (..., {needed}), got {state.ensembles.shape}")


def _summary(e: Array, failed: Mask) -> Summary:
    mean = moments.mean(e)
    squares = moments.mean(moments.anomalies(e) ** 2)
    variance = squares * e.shape[-2] / (e.shape[-2] - 1)
    if failed.any():
        mean, variance = mean.copy(), variance.copy()
        mean[failed], variance[failed] = np.nan, np.nan
    return Summary(mean, variance, members=e)
