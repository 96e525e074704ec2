"""A network of ensemble filters: forecast, assimilate what was heard, agree with the neighbours.

Algorithm 1 of Grange et al., for any model, sensors, graph, update and rule of agreement; and
transport filters, whose agents have one set of members in common and agree on its weights.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import KW_ONLY, dataclass
from functools import partial
from inspect import signature
from typing import Annotated, Any, ClassVar

import numpy as np

from .. import ensembles as moments
from ..coupling import plans, rejuvenated
from ..coupling.transform import carried, normalised
from ..doors import Array, Bounds, NonNegative, array, unchecked
from ..linalg import in_units
from ..models import Model
from ..network import Graph, finite_time, intersection
from ..sensors import Sensor
from ..updates import exact_draws, known_noise, sampled_forecast, with_missing
from ..updates.door import says
from ..updates.gaussian import exact_forecast
from ..updates.particles import log_likelihood, size_of, warn_of_collapse, warn_of_weights
from .base import Filter
from .inbox import Heard
from .inputs import members_of
from .record import Summary
from .saving import SensorState
from .step import Step, copied, guarded

__all__ = ["EnsembleFilter", "EnsembleState", "TransportFilter"]

Several = Annotated[int, Bounds(at_least=2)]


@dataclass(frozen=True, eq=False, repr=False)
class EnsembleState(SensorState):
    """What the agents' ensembles are between two steps.

    Parameters
    ----------
    t, ledger, rng, refused, failed, waiting
        As for :class:`~distfilt.filters.SensorState`.
    ensembles : ndarray, (*runs, A, N, d)
        Every agent's members.
    history : tuple of (float, ndarray)
        Earlier times and their ensembles, oldest first, conditioned on all that came since.

    Examples
    --------
    >>> from distfilt.network import Ledger
    >>> state = EnsembleState(0.0, Ledger.empty(2), np.random.default_rng(0), np.zeros((2, 5, 3)))
    >>> state.runs
    ()
    """

    ensembles: Array

    _belief = "ensembles", (..., "A", "N", "d")


@dataclass(frozen=True, eq=False)
class MembersFilter(Filter):
    """What all families have in common whose agents hold members."""

    _: KW_ONLY
    members: Several = 100

    state: ClassVar[type[SensorState]] = EnsembleState
    draws: ClassVar[bool] = True
    joins: ClassVar[bool] = True
    changes: ClassVar[bool] = True
    fuses: ClassVar[str] = "ensembles"

    @property
    def sizes(self) -> tuple[int, ...]:
        """Members, and their components."""
        return self.members, self.model.dim

    def drawn(self, prior: Any, leading: tuple[int, ...], rng: Any) -> Array:
        """Members (*leading, N, d) of a prior."""
        return members_of(prior, self.members, leading, self.model.dim, rng)

    def summary(self, state: Any) -> Summary:
        """Means and variances of the agents' ensembles, and the members for the scores."""
        centre, a = moments.about_mean(x := state.ensembles)
        a *= a
        variance = unchecked(moments.mean)(a) * (self.members / (self.members - 1))
        return Summary(state.shown(centre[..., 0, :]), state.shown(variance), members=x)


@dataclass(frozen=True, eq=False)
class EnsembleFilter(MembersFilter):
    """One ensemble per agent; agents share observations and agree with each other.

    In every step each agent moves its members with the model, sends its observation to those that
    hear it, updates its members with what it knows, and applies the rule of agreement. All that
    passes between agents passes through one :class:`~distfilt.network.Channel`.

    Parameters
    ----------
    model, sensors, graph, agreement, share, faults, lag, names, failures, gate, every
        As for :class:`~distfilt.filters.Filter`. The agreement is a function
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

    _: KW_ONLY
    update: Callable[..., Array] = known_noise
    forecast: Callable[..., Array] = sampled_forecast

    def check_parts(self) -> None:
        """Refuse what cannot be called as an update, such as a wrapper without one."""
        super().check_parts()
        try:
            signature(self.update).bind(*range(4), rng=None)
        except TypeError as error:
            raise ValueError(f"update: needs four arrays and rng, got one with {error}") from None

    @classmethod
    def exact(
        cls, model: Model, sensors: Sequence[Sensor | None],
        graph: Graph | Callable[[float], Graph] | None = None, **options: Any,
    ) -> EnsembleFilter:
        """Second-order exact draws and covariance intersection of least determinant.

        For a linear model and linear sensors every agent's sample moments are those of the Kalman
        filters that fuse by the same rule; the book's chapter 4 measures it on others. With process
        noise, members and their past are tied by chance too: smoothing and late readings are then
        exact to sampling errors only.

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

    def begin(self, prior: Any, runs: tuple[int, ...], rng: Any) -> dict[str, Any]:
        """Members drawn for each agent."""
        return {"ensembles": self.drawn(prior, (*runs, self.count), rng)}

    def advance(self, step: Step) -> Any:
        """Forecast, condition on what was heard, agree."""
        state, now = step.state, step.state.ensembles
        if step.dt:
            now = unchecked(self.forecast)(now, self.model, state.t, step.dt, rng=step.rng)
            now = array(now, "forecast", state.ensembles.shape, finite=False)
        stack = step.stack(step.moved(now, state.ensembles))
        for place, group in step.heard():
            step.settle(self._condition(stack, place, group, step), group.agents)
        (now,) = step.agreed(stack[-1])
        return step.end(ensembles=now, past=recalled(stack, now))

    def _condition(
        self, stack: list[Array], place: int, group: Heard, step: Step
    ) -> dict[tuple[int, ...], str]:
        """Condition every time's ensembles of a group's agents, in place; the rows that failed."""
        rows = group.rows
        members = tuple([e[..., rows, :, :] for e in stack])
        # What a late reading tells of the time before is in the stack.
        before = step.before(place, group, stack[:-1])
        predicted = group.predict(members[place], before)
        group = step.gated(group, sample_moments, predicted)
        redone = says(self.update, "repredicts")

        def compute(h: Array, y: Array, *rest: Any) -> tuple[Array, ...]:
            *earlier, last, noise, source = rest
            # Every time's members meet the same draw of the noise, so that all the separate
            # updates are one joint update; the last one advances the generator.
            past = [self._updated(x, h, y, noise, copied(source), None) for x in earlier]
            whole = redone and not earlier and h.shape == predicted.shape
            predict = partial(group.predict, previous=before) if whole else None
            return (*past, self._updated(last, h, y, noise, source, predict))

        result, errors = guarded(
            compute, (predicted, group.target, *members), members, group.target.ndim - 1,
            shared=group.noise, rng=step.rng,
        )
        for e, new in zip(stack, result, strict=True):
            e[..., rows, :, :] = new
        return errors

    def _updated(self, x: Array, h: Array, y: Array, noise: Array, rng: Any, predict: Any) -> Array:
        """One time's ensembles after the update; a plain function gets one agent's at a time."""
        if says(self.update, "repredicts"):
            return unchecked(self.update)(x, h, y, noise, rng=rng, predict=predict)
        stacks = says(self.update, "stacks")

        def one(*given: Array) -> Array:
            # A function of one's own may work in place.
            own = given if stacks else [x.copy() for x in given]
            new = with_missing(self.update, *own, rng=rng)
            return array(new, "update", given[0].shape, finite=False)

        if stacks or x.ndim == 2:
            return one(x, h, y, noise)
        noises = noise if noise.ndim > 2 else [noise] * x.shape[-3]
        agents = [(x[..., g, :, :], h[..., g, :, :], y[..., g, :], r) for g, r in enumerate(noises)]
        return np.stack([one(*own) for own in agents], axis=-3)


@dataclass(frozen=True, eq=False)
class TransportFilter(MembersFilter):
    r"""Agents that hold the same members, agree on their log-likelihoods, and transport alone.

    Readings of different agents are independent, so the log-likelihood of all of them is A times
    the agents' average, :math:`\log w_i=\sum_a\log p(\mathbf y^a|\mathbf x_i)`. The agreement finds
    it; then every agent computes the same ensemble transform. All agents draw the prior, process
    noise and rejuvenation from one seed, so that the members stay in common.

    Parameters
    ----------
    model, sensors, graph, faults, lag, names, failures, gate
        As for :class:`~distfilt.filters.Filter`. Members in common need an agreement in every step,
        so that `every` is refused, and so are readings at a time when a moving graph has no link.
    agreement : callable
        ``agreement(log_likelihoods, channel) -> averages``, both (\*runs, A, N): exact finite-time
        averaging by default, or ``partial(average, rounds=20)``. It takes the place of telling
        readings, which stay with their agents.
    members : int
        Number N of members of the common set.
    correct : bool
        Give the members the weighted covariance too.
    rejuvenation : float
        h of :func:`distfilt.coupling.rejuvenated`; 0 draws nothing.

    Examples
    --------
    >>> from distfilt.models import Model
    >>> from distfilt.network import graphs
    >>> from distfilt.sensors import direct
    >>> walk = Model(2, lambda x, t, dt: x, lambda t, dt: 0.1 * dt * np.eye(2))
    >>> f = TransportFilter(walk, [direct([0], std=0.5), direct([1], std=0.5)], graphs.path(2))
    >>> state = f.start((np.zeros(2), np.eye(2)), rng=np.random.default_rng(0))
    >>> state = f.step(state, 1.0, [[0.8], [-0.8]])
    >>> bool(np.allclose(*state.ensembles)), state.ledger.scalars
    (True, array([100, 100]))
    """

    _: KW_ONLY
    agreement: Callable[..., Any] = finite_time
    share: bool = False
    correct: bool = False
    rejuvenation: NonNegative = 0.0

    fuses: ClassVar[str] = "vectors"
    unused: ClassVar[dict[str, str]] = {
        "share": "agents agree on what their readings say, so that these stay with them",
        "every": "a transport filter's agents have their members in common, so that they have to "
        "agree in every step"
    }

    def begin(self, prior: Any, runs: tuple[int, ...], rng: Any) -> dict[str, Any]:
        """One set of members, (N, d) or (*runs, 1, N, d), for all agents."""
        return {"ensembles": np.repeat(self.drawn(prior, (*runs, 1), rng), self.count, axis=-3)}

    def advance(self, step: Step) -> Any:
        """Forecast, weigh by what was seen, agree on the weights, transport.

        Warns
        -----
        ParticleCollapse
            If one member has nearly all the weight that is carried over, or a reading is beyond
            what the members believe.
        """
        state, now = step.state, step.state.ensembles
        apart = self.count > 1 and callable(self.graph) and step.channel is None
        if apart and any((*step.said, step.late)):
            raise ValueError(f"graph: needs links for the readings of t = {step.t:g}, got none")
        if step.dt:
            draw = partial(unchecked(self.model.sample_step), t=state.t, dt=step.dt)
            now = self._for_all(draw, (now,), step.rng)
        stack = step.stack(step.moved(now, state.ensembles))
        (logs,) = step.agreed(self._log_likelihoods(stack, step))
        logs = self.count * logs if step.agrees else logs
        stack, errors = self._transported(stack, logs, step.rng)
        step.settle(errors, range(self.count))
        self._warn(logs, step)
        return step.end(ensembles=stack[-1], past=stack[:-1])

    def _for_all(
        self, draw: Callable[..., Array], arrays: tuple[Array, ...], rng: np.random.Generator
    ) -> Array:
        """Apply `draw` agent by agent, each with the same draws; the generator advances once."""
        sources = [copied(rng) for _ in range(self.count - 1)] + [rng]
        parts = [
            draw(*(x[..., a, :, :] for x in arrays), rng=source) for a, source in enumerate(sources)
        ]
        return np.stack(parts, axis=-3)

    def _log_likelihoods(self, stack: list[Array], step: Step) -> Array:
        """What each agent makes of the readings it has, (*runs, A, N)."""
        logs = np.zeros(stack[-1].shape[:-1])
        for place, group in step.heard():
            rows = group.rows
            before = step.before(place, group, stack[:-1])
            predicted = group.predict(stack[place][..., rows, :, :], before)
            group = step.gated(group, sample_moments, predicted)
            logs[..., rows, :] += log_likelihood(predicted, group.target, group.noise)
            warn_of_weights(0 * predicted[..., 0], predicted, group.target, group.noise)
        return logs

    def _transported(
        self, stack: list[Array], logs: Array, rng: np.random.Generator
    ) -> tuple[list[Array], dict[tuple[int, ...], str]]:
        """All times' members, carried by the coupling of the last time's; the rows that failed."""

        def compute(here: Array, *rest: Any) -> tuple[Array, ...]:
            times, w = rest[:-2], normalised(here)
            matrix = unchecked(plans)(times[-1], here)
            return tuple(carried(x, w, matrix, correct=self.correct) for x in times)

        out, errors = guarded(compute, (logs, *stack), tuple(stack), logs.ndim - 1)
        if self.rejuvenation:
            draw = partial(unchecked(rejuvenated), bandwidth=self.rejuvenation)
            # Every time's members meet the same draws; the generator advances once.
            sources = [copied(rng) for _ in out[1:]] + [rng]
            both = zip(out, stack, sources, strict=True)
            out = tuple(self._for_all(draw, (y, x), source) for y, x, source in both)
        # Where nothing was said of the members they stay as they were.
        told = (np.ptp(logs, axis=-1) > 0)[..., None, None]
        return [np.where(told, y, x) for y, x in zip(out, stack, strict=True)], errors

    def _warn(self, logs: Array, step: Step) -> None:
        """A coupling that carries all to one member leaves nothing to go on from.

        >>> import warnings
        >>> from types import SimpleNamespace
        >>> step = SimpleNamespace(t=1.0, failed=np.array([False, False, True]))
        >>> logs = np.array([[[0.0, 0.0]], [[0.0, 0.0]], [[0.0, -99.0]]])  # runs, agents, members
        >>> TransportFilter._warn(None, logs, step)
        >>> with warnings.catch_warnings(action="error"):
        ...     TransportFilter._warn(None, logs[::-1], step)
        Traceback (most recent call last):
        distfilt.updates.particles.ParticleCollapse: t = 1 s: an agent's weights have an ...
        """
        if (size := size_of(normalised(logs[~step.failed])).min(initial=np.inf)) < 1.1:
            what = f"t = {step.t:g} s: an agent's weights have an effective size of {size:.1f}"
            warn_of_collapse(what, "rejuvenation=")


def recalled(stack: list[Array], now: Array) -> list[Array]:
    """Members of the earlier times of a stack whose last have become those of `now` by agreement.

    What agents agree on tells of the past too: by its regression on the members as they were.
    """
    *past, old = stack
    if now is old or not past:
        return past
    shape, unit = in_units(unchecked(moments.sample_covariance)(old))
    inverse = np.linalg.pinv(shape, rcond=1e-10, hermitian=True) / (old.shape[-2] - 1)
    around, moved = (x / unit[..., None, :] for x in (moments.about_mean(old)[1], now - old))
    return [x + moved @ (inverse @ (around.mT @ x)) for x in past]


def sample_moments(members: Array) -> tuple[Array, Array]:
    """Mean and covariance of predictions (..., N, M); NaN where some member cannot be seen."""
    return members.mean(axis=-2), unchecked(moments.sample_covariance)(members)
