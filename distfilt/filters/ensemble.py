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
from ..coupling import rejuvenate, transport_plans
from ..coupling.transform import apply_plan, normalize_weights
from ..linalg import to_unit_variances
from ..models import Model
from ..network import Graph, finite_time_consensus, intersect_ensembles
from ..sensors import Sensor
from ..updates import enkf, enkf_exact, stochastic_forecast, with_missing
from ..updates.decorator import has_tag
from ..updates.gaussian import exact_forecast
from ..updates.particles import (
    log_likelihood,
    size_of,
    warn_of_collapse,
    warn_of_weights,
)
from ..validation import Array, Bounds, NonNegativeFloat, check_array
from .base import Filter
from .inbox import Received
from .inputs import draw_members
from .record import Summary
from .saving import SensorState
from .step import Step, copy_rng, run_isolated

__all__ = ["EnsembleFilter", "EnsembleState", "TransportFilter"]

Several = Annotated[int, Bounds(at_least=2)]


@dataclass(frozen=True, eq=False, repr=False)
class EnsembleState(SensorState):
    """What the agents' ensembles are between two steps.

    Parameters
    ----------
    t, ledger, rng, rejected, failed, pending
        As for :class:`~distfilt.filters.SensorState`.
    ensembles : ndarray, (*runs, A, N, d)
        Every agent's members.
    history : tuple of (float, ndarray)
        Earlier times and their ensembles, oldest first, conditioned on all that came since.

    Examples
    --------
    >>> from distfilt.network import Ledger
    >>> state = EnsembleState(
    ...     0.0, Ledger.empty(2), np.random.default_rng(0), np.zeros((2, 5, 3))
    ... )
    >>> state.runs
    ()
    """

    ensembles: Array

    belief_field = "ensembles", (..., "A", "N", "d")


@dataclass(frozen=True, eq=False)
class MembersFilter(Filter):
    """What all families have in common whose agents hold members."""

    _: KW_ONLY
    members: Several = 100

    state_class: ClassVar[type[SensorState]] = EnsembleState
    requires_rng: ClassVar[bool] = True
    batched_summary: ClassVar[bool] = True
    supports_increments: ClassVar[bool] = True
    belief_kind: ClassVar[str] = "ensembles"

    @property
    def sizes(self) -> tuple[int, ...]:
        """Members, and their components."""
        return self.members, self.model.dim

    def draw_prior(self, prior: Any, leading: tuple[int, ...], rng: Any) -> Array:
        """Members (*leading, N, d) of a prior."""
        return draw_members(prior, self.members, leading, self.model.dim, rng)

    def summarize(self, state: Any) -> Summary:
        """Means and variances of the agents' ensembles, and the members for the scores."""
        centre, a = moments.center_ensemble(x := state.ensembles)
        a *= a
        variance = moments.mean(a) * (self.members / (self.members - 1))
        return Summary(
            state.mask_failed(centre[..., 0, :]), state.mask_failed(variance), members=x
        )


@dataclass(frozen=True, eq=False)
class EnsembleFilter(MembersFilter):
    """One ensemble per agent; agents share observations and agree with each other.

    In every step each agent moves its members with the model, sends its observation to those that
    hear it, updates its members with what it knows, and applies the rule of agreement. All that
    passes between agents passes through one :class:`~distfilt.network.Channel`.

    Parameters
    ----------
    model, sensors, graph, fusion, share_observations, faults, lag, names, on_error, gate_probability,
        exchange_interval
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
    >>> from distfilt.sensors import component
    >>> walk = Model(1, lambda x, t, dt: x, lambda t, dt: np.array([[dt]]))
    >>> f = EnsembleFilter(
    ...     walk, [component([0], std=0.5), None], graphs.path(2), members=500
    ... )
    >>> state = f.start(([0.0], [[1.0]]), rng=np.random.default_rng(0))
    >>> state = f.step(state, 1.0, [[0.8], None])
    >>> state.ensembles.mean(axis=1).round(1).ravel()
    array([0.7, 0.7])
    """

    _: KW_ONLY
    update: Callable[..., Array] = enkf
    forecast: Callable[..., Array] = stochastic_forecast

    def check_parts(self) -> None:
        """Refuse what cannot be called as an update, such as a wrapper without one."""
        super().check_parts()
        try:
            signature(self.update).bind(*range(4), rng=None)
        except TypeError as error:
            raise ValueError(
                f"update must have four arrays and rng, got one with {error}"
            ) from None

    @classmethod
    def exact(
        cls,
        model: Model,
        sensors: Sequence[Sensor | None],
        graph: Graph | Callable[[float], Graph] | None = None,
        **options: Any,
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
        >>> from distfilt.sensors import component
        >>> walk = Model(1, lambda x, t, dt: x, lambda t, dt: np.array([[dt]]))
        >>> f = EnsembleFilter.exact(walk, [component([0], std=1.0)], members=10)
        >>> prior = np.linspace(-1, 1, 10)[:, None]
        >>> state = f.step(f.start(prior, rng=np.random.default_rng(0)), 1.0, [[0.8]])
        >>> p = prior.var(ddof=1) + 1.0
        >>> bool(abs(state.ensembles.var(ddof=1) - p / (p + 1.0)) < 1e-12)
        True
        """
        own: dict[str, Any] = {"update": enkf_exact, "forecast": exact_forecast}
        if graph is not None:
            own["fusion"] = partial(intersect_ensembles, rule="min_determinant")
        return cls(model, sensors, graph, **(own | options))

    def initial_state(
        self, prior: Any, runs: tuple[int, ...], rng: Any
    ) -> dict[str, Any]:
        """Members drawn for each agent."""
        return {"ensembles": self.draw_prior(prior, (*runs, self.n_agents), rng)}

    def next_state(self, step: Step) -> Any:
        """Forecast, condition on what was heard, agree."""
        state = step.state
        now = step.state.ensembles
        if step.dt:
            now = self.forecast(now, self.model, state.t, step.dt, rng=step.rng)
            now = check_array(now, "forecast", state.ensembles.shape, finite=False)
        stack = step.stack(step.check_forecast(now, state.ensembles))
        for place, group in step.received():
            step.record_failures(
                self._condition(stack, place, group, step), group.agents
            )
        (now,) = step.fuse(stack[-1])
        return step.end(ensembles=now, past=regress_past(stack, now))

    def _condition(
        self, stack: list[Array], place: int, group: Received, step: Step
    ) -> dict[tuple[int, ...], str]:
        """Condition every time's ensembles of a group's agents, in place; the rows that failed."""
        rows = group.rows
        members = tuple([e[..., rows, :, :] for e in stack])
        # What a late reading tells of the time before is in the stack.
        before = step.before(place, group, stack[:-1])
        predicted = group.predict(members[place], before)
        group = step.gate(group, sample_moments, predicted)
        redone = has_tag(self.update, "repredicts")

        def compute(h: Array, y: Array, *rest: Any) -> tuple[Array, ...]:
            *earlier, last, noise, source = rest
            # Every time's members meet the same draw of the noise, so that all the separate
            # updates are one joint update; the last one advances the generator.
            past = [
                self._updated(x, h, y, noise, copy_rng(source), None) for x in earlier
            ]
            whole = redone and not earlier and h.shape == predicted.shape
            predict = partial(group.predict, previous=before) if whole else None
            return (*past, self._updated(last, h, y, noise, source, predict))

        result, errors = run_isolated(
            compute,
            (predicted, group.target, *members),
            members,
            group.target.ndim - 1,
            shared=group.noise,
            rng=step.rng,
        )
        for e, new in zip(stack, result, strict=True):
            e[..., rows, :, :] = new
        return errors

    def _updated(
        self, x: Array, h: Array, y: Array, noise: Array, rng: Any, predict: Any
    ) -> Array:
        """One time's ensembles after the update; a plain function gets one agent's at a time."""
        if has_tag(self.update, "repredicts"):
            return self.update(x, h, y, noise, rng=rng, predict=predict)
        stacks = has_tag(self.update, "stacks")

        def one(*given: Array) -> Array:
            # A function of one's own may work in place.
            own = given if stacks else [x.copy() for x in given]
            new = with_missing(self.update, *own, rng=rng)
            return check_array(new, "update", given[0].shape, finite=False)

        if stacks or x.ndim == 2:
            return one(x, h, y, noise)
        noises = noise if noise.ndim > 2 else [noise] * x.shape[-3]
        agents = [
            (x[..., g, :, :], h[..., g, :, :], y[..., g, :], r)
            for g, r in enumerate(noises)
        ]
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
        so that `exchange_interval` is refused, and so are readings at a time when a moving graph has no link.
    fusion : callable
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
    >>> from distfilt.sensors import component
    >>> walk = Model(2, lambda x, t, dt: x, lambda t, dt: 0.1 * dt * np.eye(2))
    >>> f = TransportFilter(
    ...     walk, [component([0], std=0.5), component([1], std=0.5)], graphs.path(2)
    ... )
    >>> state = f.start((np.zeros(2), np.eye(2)), rng=np.random.default_rng(0))
    >>> state = f.step(state, 1.0, [[0.8], [-0.8]])
    >>> bool(np.allclose(*state.ensembles)), state.ledger.scalars
    (True, array([100, 100]))
    """

    _: KW_ONLY
    fusion: Callable[..., Any] = finite_time_consensus
    share_observations: bool = False
    correct: bool = False
    rejuvenation: NonNegativeFloat = 0.0

    belief_kind: ClassVar[str] = "vectors"
    unsupported: ClassVar[dict[str, str]] = {
        "share_observations": "agents agree on what their readings say, so that these stay with them",
        "exchange_interval": "a transport filter's agents have their members in common, so that they have to "
        "agree in every step",
    }

    def initial_state(
        self, prior: Any, runs: tuple[int, ...], rng: Any
    ) -> dict[str, Any]:
        """One set of members, (N, d) or (*runs, 1, N, d), for all agents."""
        return {
            "ensembles": np.repeat(
                self.draw_prior(prior, (*runs, 1), rng), self.n_agents, axis=-3
            )
        }

    def next_state(self, step: Step) -> Any:
        """Forecast, weigh by what was seen, agree on the weights, transport.

        Warns
        -----
        ParticleCollapse
            If one member has nearly all the weight that is carried over, or a reading is beyond
            what the members believe.
        """
        state = step.state
        now = step.state.ensembles
        apart = self.n_agents > 1 and callable(self.graph) and step.channel is None
        if apart and any((*step.observations, step.delayed)):
            raise ValueError(
                f"graph must have links for the readings of t = {step.t:g}, got none"
            )
        if step.dt:
            draw = partial(self.model.sample_step, t=state.t, dt=step.dt)
            now = self._for_all(draw, (now,), step.rng)
        stack = step.stack(step.check_forecast(now, state.ensembles))
        (logs,) = step.fuse(self._log_likelihoods(stack, step))
        logs = self.n_agents * logs if step.has_fusion else logs
        stack, errors = self._transported(stack, logs, step.rng)
        step.record_failures(errors, range(self.n_agents))
        self._warn(logs, step)
        return step.end(ensembles=stack[-1], past=stack[:-1])

    def _for_all(
        self,
        draw: Callable[..., Array],
        arrays: tuple[Array, ...],
        rng: np.random.Generator,
    ) -> Array:
        """Apply `draw` agent by agent, each with the same draws; the generator advances once."""
        sources = [copy_rng(rng) for _ in range(self.n_agents - 1)] + [rng]
        parts = [
            draw(*(x[..., a, :, :] for x in arrays), rng=source)
            for a, source in enumerate(sources)
        ]
        return np.stack(parts, axis=-3)

    def _log_likelihoods(self, stack: list[Array], step: Step) -> Array:
        """What each agent makes of the readings it has, (*runs, A, N)."""
        logs = np.zeros(stack[-1].shape[:-1])
        for place, group in step.received():
            rows = group.rows
            before = step.before(place, group, stack[:-1])
            predicted = group.predict(stack[place][..., rows, :, :], before)
            group = step.gate(group, sample_moments, predicted)
            logs[..., rows, :] += log_likelihood(predicted, group.target, group.noise)
            warn_of_weights(0 * predicted[..., 0], predicted, group.target, group.noise)
        return logs

    def _transported(
        self, stack: list[Array], logs: Array, rng: np.random.Generator
    ) -> tuple[list[Array], dict[tuple[int, ...], str]]:
        """All times' members, carried by the coupling of the last time's; the rows that failed."""

        def compute(here: Array, *rest: Any) -> tuple[Array, ...]:
            times = rest[:-2]
            w = normalize_weights(here)
            matrix = transport_plans(times[-1], here)
            return tuple(apply_plan(x, w, matrix, correct=self.correct) for x in times)

        out, errors = run_isolated(compute, (logs, *stack), tuple(stack), logs.ndim - 1)
        if self.rejuvenation:
            draw = partial(rejuvenate, bandwidth=self.rejuvenation)
            # Every time's members meet the same draws; the generator advances once.
            sources = [copy_rng(rng) for _ in out[1:]] + [rng]
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
        >>> logs = np.array(
        ...     [[[0.0, 0.0]], [[0.0, 0.0]], [[0.0, -99.0]]]
        ... )  # runs, agents, members
        >>> TransportFilter._warn(None, logs, step)
        >>> with warnings.catch_warnings(action="error"):
        ...     TransportFilter._warn(None, logs[::-1], step)
        Traceback (most recent call last):
        distfilt.updates.particles.ParticleCollapse: t = 1 s: an agent's weights have an ...
        """
        if (
            size := size_of(normalize_weights(logs[~step.failed])).min(initial=np.inf)
        ) < 1.1:
            what = f"t = {step.t:g} s: an agent's weights have an effective size of {size:.1f}"
            warn_of_collapse(what, "rejuvenation=")


def regress_past(stack: list[Array], now: Array) -> list[Array]:
    """Members of the earlier times of a stack whose last have become those of `now` by agreement.

    What agents agree on tells of the past too: by its regression on the members as they were.
    """
    *past, old = stack
    if now is old or not past:
        return past
    shape, unit = to_unit_variances(moments.sample_covariance(old))
    inverse = np.linalg.pinv(shape, rcond=1e-10, hermitian=True) / (old.shape[-2] - 1)
    around, moved = (
        x / unit[..., None, :] for x in (moments.center_ensemble(old)[1], now - old)
    )
    return [x + moved @ (inverse @ (around.mT @ x)) for x in past]


def sample_moments(members: Array) -> tuple[Array, Array]:
    """Mean and covariance of predictions (..., N, M); NaN where some member cannot be seen."""
    return members.mean(axis=-2), moments.sample_covariance(members)
