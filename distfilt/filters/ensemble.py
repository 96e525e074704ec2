"""Networks of ensemble filters: forecast, assimilate, fuse with the neighbours.

:class:`EnsembleFilter` is algorithm 1 of Grange et al. for any model, sensors, graph, update and
fusion rule. The agents of a :class:`TransportFilter` have one set of members in common and agree
on its weights.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import KW_ONLY, dataclass
from functools import cached_property, partial
from inspect import signature
from typing import Annotated, ClassVar, Literal, TypeVar, cast

import numpy as np

from .. import ensembles as moments
from ..coupling import rejuvenate, transport_plans
from ..coupling.transform import apply_plan, normalize_weights
from ..linalg import center_ensemble, log_sum_exp, to_unit_variances
from ..models import Model
from ..network import Graph, finite_time_consensus, intersect_ensembles
from ..periods import check_transition, fold, fold_torn, settle, warn_of_wrapping
from ..sensors import Sensor
from ..updates import enkf, enkf_exact, stochastic_forecast, with_missing
from ..updates.decorator import has_tag
from ..updates.gaussian import exact_forecast
from ..updates.particles import (
    ParticleCollapse,
    describe_collapse,
    effective_size_of,
    log_likelihood,
    log_normalizer,
    warn_of_weights,
)
from ..updates.wrappers import find_locate
from ..validation import (
    Array,
    Bounds,
    InvalidArgumentError,
    NonNegativeFloat,
    Rng,
    all_finite,
    call_user,
    check_array,
    format_number,
)
from .base import SensorFilter, require_rng
from .bridge import insert_members
from .options import (
    ExchangesAtIntervals,
    FusesBeliefs,
    IsolatesRuns,
    KeepsPast,
    ScoresObservations,
    SharesObservations,
)
from .priors import Prior, draw_members, split_by_agent
from .record import Summary
from .resets import Reset, reset_members
from .states import AnyState, SensorState, State
from .step import Received, Step, copy_rng

__all__ = ["EnsembleFilter", "EnsembleState", "TransportFilter"]

AtLeastTwo = Annotated[int, Bounds(at_least=2)]

MemberState = TypeVar("MemberState", bound=SensorState)


@dataclass(frozen=True, eq=False, repr=False)
class EnsembleState(SensorState):
    """The agents' ensembles between two steps.

    Parameters
    ----------
    t, ledger, rng, rejected, failed, pending
        As for :class:`~distfilt.filters.SensorState`.
    ensembles : ndarray, (*runs, A, N, d)
        Every agent's members.
    history : tuple of (float, ndarray)
        Earlier times and their ensembles, oldest first, given all observations up to now.

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
class MembersFilter(
    SensorFilter[MemberState],
    FusesBeliefs[MemberState],
    KeepsPast[MemberState],
    IsolatesRuns[MemberState],
    ScoresObservations[MemberState],
):
    """The common part of all families whose agents hold members."""

    _: KW_ONLY
    members: AtLeastTwo = 100

    requires_rng: ClassVar[bool] = True
    batched_summary: ClassVar[bool] = True
    supports_increments: ClassVar[bool] = True
    belief_kind: ClassVar[str | None] = "ensembles"

    def check_state(self, state: MemberState) -> None:
        """Refuse a state that is not of this filter."""
        super().check_state(state)
        name, _axes = state.belief_field
        sizes = getattr(state, name).shape[-2:]
        if sizes != (self.members, self.model.dim):
            raise ValueError(
                f"state must have sizes {(self.members, self.model.dim)} an agent, "
                f"got {sizes}"
            )

    def reset_belief(self, state: MemberState, reset: Reset) -> MemberState:
        """Return the state with new draws of some components."""
        rng = copy_rng(require_rng(state.rng))
        return reset_members(state, reset, self.draw_normal, rng)

    def insert_time(self, state: MemberState, t: float) -> MemberState:
        """Return the state with draws of a time between two that it keeps, given both."""
        return insert_members(self, state, t)

    def draw_normal(self, shape: tuple[int, ...], rng: Rng) -> Array:
        """Draw standard normal numbers for members (*runs, A, N, d)."""
        return rng.standard_normal(shape)

    def draw_prior(
        self, prior: Prior, leading: tuple[int, ...], rng: Rng | None
    ) -> Array:
        """Draw members (*leading, N, d) of a prior, or of each agent's."""
        rng = require_rng(rng)
        dim = self.model.dim
        priors = split_by_agent(prior, dim, self.n_agents)
        if priors is not None:
            # Without the last of the leading axes, that of the agents, which the stack adds
            drawn = [self.draw_prior(one, leading[:-1], rng) for one in priors]
            return np.stack(drawn, axis=-3)
        members = draw_members(prior, self.members, leading, dim, rng)
        # A prior (mean, cov) is drawn as a Gaussian on the line, whose angles are near each other.
        # Other members may be wrapped, with some of them a period away from the rest.
        if type(prior) is tuple:
            return members
        return fold_torn(members, self.periods)


@dataclass(frozen=True, eq=False)
class _EnsembleSummary(MembersFilter[EnsembleState]):
    """A filter whose state is an ensemble for each agent."""

    state_class: ClassVar[type[State]] = EnsembleState
    batched_summary: ClassVar[bool] = True

    def summarize(self, state: EnsembleState) -> Summary:
        """Return means and variances of the agents' ensembles, and the members for the scores."""
        ensembles = state.ensembles
        mean, anomalies = center_ensemble(ensembles)
        # Σ (xᵢ - m)² / (N - 1), as the mean of N squares times N / (N - 1).
        anomalies *= anomalies
        variance = moments.mean(anomalies) * (self.members / (self.members - 1))
        return Summary(
            state.mask_failed(mean[..., 0, :]),
            state.mask_failed(variance),
            members=ensembles,
        )


@dataclass(frozen=True, eq=False)
class EnsembleFilter(
    _EnsembleSummary,
    SharesObservations[EnsembleState],
    ExchangesAtIntervals[EnsembleState],
):
    """One ensemble per agent; agents share observations and fuse their ensembles.

    In every step each agent moves its members with the model, sends its observation to its
    neighbours, updates its members with the observations it has, and applies the fusion rule.
    Everything that passes between agents passes through one
    :class:`~distfilt.network.Channel`.

    Parameters
    ----------
    model, sensors, graph, gate_probability, faults, names
        As for :class:`~distfilt.filters.SensorFilter`.
    fusion, share_observations, hops, lag, on_error, exchange_interval, record_evidence
        As in :mod:`distfilt.filters.options`. The rule is a function
        ``fusion(ensembles, channel) -> ensembles``, such as ``partial(mean_pull, gain=0.05)``.
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

    supports_agent_models: ClassVar[bool] = True

    def check_parts(self) -> None:
        """Refuse an update of another signature, such as a wrapper without its update."""
        super().check_parts()
        # Whether it can be called with members, predictions, observation and noise
        try:
            signature(self.update).bind(*range(4), rng=None)
        except TypeError as error:
            raise InvalidArgumentError(
                f"update must accept four arrays and rng, got a function with {error}"
            ) from None

    @classmethod
    def exact(
        cls,
        model: Model,
        sensors: Sequence[Sensor | None],
        graph: Graph | Callable[[float], Graph] | None = None,
        **options: object,
    ) -> EnsembleFilter:
        """Second-order exact draws, and covariance intersection of least determinant.

        For a linear model and linear sensors every agent's sample moments are those of the Kalman
        filters that fuse by the same rule; the book's chapter 4 measures it on others. With process
        noise, members and their past are correlated by chance too: smoothing and delayed
        observations are then exact to sampling errors only.

        Parameters
        ----------
        model, sensors, graph
            As for the class.
        **options
            Other options of the class; needs more `members` than d + twice the number of
            received values.

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
        # The user's options come last and win.
        exact: dict[str, object] = {"update": enkf_exact, "forecast": exact_forecast}
        if graph is not None:
            exact["fusion"] = partial(intersect_ensembles, rule="min_determinant")
        # A cast, since the types of the options are not known here: the constructor checks them.
        make = cast(Callable[..., EnsembleFilter], cls)
        return make(model, sensors, graph, **(exact | options))

    @cached_property
    def _repredicts(self) -> bool:
        """Whether the update predicts the observations again for members it has moved."""
        return has_tag(self.update, "repredicts")

    @cached_property
    def _stacks(self) -> bool:
        """Whether the update accepts ensembles with a noise covariance of their own each."""
        return has_tag(self.update, "stacks")

    @cached_property
    def _weights_members(self) -> bool:
        """Whether the update weights members by the likelihoods of their predictions."""
        return has_tag(self.update, "weights_members")

    @cached_property
    def _locates(self) -> bool:
        """Whether the update needs the places of the observations."""
        return has_tag(self.update, "locates")

    def initial_state(
        self, prior: Prior, runs: tuple[int, ...], rng: Rng | None
    ) -> dict[str, object]:
        """Draw members for each agent."""
        members = self.draw_prior(prior, (*runs, self.n_agents), rng)
        # Angles are shifted by whole periods: each agent's mean is then in [-period/2, period/2).
        return {"ensembles": settle(members, self.periods)}

    def next_state(self, step: Step[EnsembleState]) -> EnsembleState:
        """Forecast, condition on the received observations, fuse."""
        state = step.state
        ensembles = state.ensembles
        if step.dt:
            # Every member moves with the model and meets a draw of its noise.
            ensembles = call_user(
                self.forecast, ensembles, step.model, state.t, step.dt, rng=step.rng
            )
            _check_shape(ensembles, "forecast", state.ensembles.shape)
            if self.periods:
                # A forecast of the user's own may wrap angles, so that some members lie a period
                # away from the rest.
                ensembles = fold_torn(ensembles, self.periods)
            if self.notices_wrapping:
                warn_of_wrapping(
                    step.model, state.ensembles, ensembles, state.t, step.dt
                )
        # The ensembles of the earlier times that are kept, oldest first, and the present ones last
        stack = step.stack(step.check_forecast(ensembles, state.ensembles))
        # Groups of agents that have equally many observations of one time of the stack
        for time_index, group in step.received():
            self._condition(stack, time_index, group, step)
        # Agents exchange beliefs after the update, through the same channel.
        fused = stack[-1]
        past = stack[:-1]
        if step.has_fusion:
            fused = fuse_members(step, fused)
            past = regress_past(stack, fused)
        if self.periods:
            # Members are shifted alike by whole periods: their mean lies in [-period/2, period/2).
            fused = settle(fused, self.periods)
            past = [settle(x, self.periods) for x in past]
        return step.end(ensembles=fused, past=past)

    def _condition(
        self,
        stack: list[Array],
        time_index: int,
        group: Received,
        step: Step[EnsembleState],
    ) -> None:
        """Condition every time's ensembles of a group's agents on its observations, in place.

        The stack has the ensembles (*runs, A, N, d) of the times that are kept, the present one
        last. The group's observations are of the time with the index `time_index` among these.
        """
        # The index of the group's agents in arrays (*runs, A, ...)
        rows = group.rows
        members = tuple([ensembles[..., rows, :, :] for ensembles in stack])
        # A sensor of changes compares with earlier members. They come from the stack, since a
        # delayed observation of that time may have changed them.
        previous = None
        if group.changes:
            previous = step.find_previous(time_index, group, stack[:-1])
        # An update by likelihoods compares every member with the observation by itself: each
        # predicted angle is brought near the observed one. Others need all predictions on one
        # branch, whose mean is near it.
        weights_members = self._weights_members
        branch: Literal["mean", "each"] = "each" if weights_members else "mean"
        predicted = group.predict(members[time_index], previous, branch=branch)
        if not math.isfinite(np.vdot(predicted, predicted)):
            is_unseen = np.asarray(np.isnan(predicted).any(axis=-2))
            step.note_unseen(group, is_unseen, "some members cannot see")
        group = step.gate(
            group, sample_moments, predicted, near_observed=weights_members
        )
        if weights_members and self.periods:
            # The update takes weighted means: angles are brought near their weighted mean.
            logs = log_likelihood(predicted, group.target, group.noise)
            weights = normalize_weights(logs)
            members = tuple([fold(x, self.periods, weights) for x in members])
        # An update that moves members in several parts predicts again in between. It can do so if
        # there are no earlier members to be moved along.
        predict = None
        if self._repredicts and len(stack) == 1:
            predict = partial(group.predict, previous=previous, branch=branch)
        # The places of the observations, for an update that is localised: none or one array
        located = self._locate_observations(group) if self._locates else ()
        update_times = partial(
            self._update_times,
            has_places=bool(located),
            predict=predict,
            batch_shape=predicted.shape,
        )
        results = step.apply(
            update_times,
            (predicted, group.target, *members, *located),
            members,
            group.agents,
            shared=group.noise,
            rng=step.rng,
        )
        # Only the members of the group's agents are replaced.
        for ensembles, new in zip(stack, results, strict=True):
            ensembles[..., rows, :, :] = new

    def _update_times(
        self,
        h: Array,
        y: Array,
        *args: Array,
        has_places: bool,
        predict: Callable[[Array], Array] | None,
        batch_shape: tuple[int, ...],
    ) -> tuple[Array, ...]:
        """Update the members of all times by predictions of the observations.

        Parameters
        ----------
        h, y : ndarray, (..., N, M) and (..., M)
            The predictions and the observations.
        *args
            As :meth:`Step.apply` passes them: members (..., N, d) of all times, the present ones
            last; the places of the observations, if there are any; the noise that all rows share;
            a generator. If the whole batch fails, it passes one run of one agent after the other.
        has_places : bool
            Whether the places are among them.
        predict : callable or None
            Predicts the observations of members of the whole batch, for an update that needs it.
        batch_shape : tuple of int
            Shape of the whole batch's predictions.
        """
        *arrays, noise, last = args
        # The only argument that is no array
        rng = cast(np.random.Generator, last)
        places = arrays.pop() if has_places else None
        *past, present = arrays
        # The function predicts for the whole batch, not for a single run and agent.
        predict_again = predict if h.shape == batch_shape else None
        # The updates of all times use copies of one generator, and so the same draws: then they are
        # one joint update. The last of them advances the generator.
        updated = [
            self._update(x, h, y, noise, copy_rng(rng), predict=None, places=places)
            for x in past
        ]
        new = self._update(
            present, h, y, noise, rng, predict=predict_again, places=places
        )
        return (*updated, new)

    def _locate_observations(self, group: Received) -> tuple[Array, ...]:
        """Return the places (*runs, G, M, k) of a group's observations; none if they are common.

        A localised update has a mapping from sensors to places in k dimensions, or one array of
        places. The array fits agents that all receive the same observations, and then nothing is
        passed on.
        """
        # The mapping as a function of a sensor; None for an array
        locate = find_locate(self.update)
        if locate is None:
            self._check_common_places(group)
            return ()
        places = group.collect(locate)
        return (np.broadcast_to(places, (*group.target.shape, places.shape[-1])),)

    def _check_common_places(self, group: Received) -> None:
        """Refuse one array of places where agents, or steps, have different observations."""
        sensors = [part.sensor for part in group.parts]
        of_group = set(sensors)
        is_common = group.has_same_sensors
        for agent in group.agents.tolist():
            of_agent = set(self.agent_sensors[agent])
            # If only some of the agent's sensors are there, another step will have others.
            is_common &= not (of_agent & of_group) or of_agent <= of_group
        if not is_common:
            raise ValueError(
                "observation_places must be a mapping from each sensor to its place where "
                "agents or steps have different observations, got an array"
            )

    def _update(
        self,
        members: Array,
        predicted: Array,
        observed: Array,
        noise: Array,
        rng: Rng,
        *,
        predict: Callable[[Array], Array] | None,
        places: Array | None,
    ) -> Array:
        """Update the ensembles of G agents, together if the update can do that.

        Parameters
        ----------
        members, predicted, observed : ndarray, (..., G, N, d), (..., G, N, m), (..., G, m)
            Members, their predictions and what was observed. Without the axis of agents if one
            ensemble is computed again by itself, after an error in a batch.
        noise : ndarray, (m, m) or (G, m, m)
            The covariance of the observations' noise, one for all agents or each agent's.
        rng : numpy.random.Generator
        predict : callable or None
            Predicts the observations of members (..., N, d), for an update that moves the members
            several times; None if it has to do without.
        places : ndarray or None
            The places of the observations, for an update that is localised by them.
        """
        if self._repredicts:
            # Such an update accepts ensembles of several agents, and missing observations.
            options = {} if places is None else {"observation_places": places}
            new = call_user(
                self.update,
                members,
                predicted,
                observed,
                noise,
                rng=rng,
                predict=predict,
                **options,
            )
            return new
        if self._stacks:
            # The library's updates take all ensembles in one call, each with its own noise.
            new = with_missing(
                self.update, members, predicted, observed, noise, rng=rng
            )
            _check_shape(new, "update", members.shape)
            return new
        # A function of the user's gets one agent's ensemble, and one covariance, at a time.
        # Without leading axes there is only one ensemble (N, d).
        if members.ndim == 2:
            return self._update_one(members, predicted, observed, noise, rng)
        updated = []
        for g in range(members.shape[-3]):
            updated.append(
                self._update_one(
                    members[..., g, :, :],
                    predicted[..., g, :, :],
                    observed[..., g, :],
                    noise[g] if noise.ndim > 2 else noise,
                    rng,
                )
            )
        return np.stack(updated, axis=-3)

    def _update_one(
        self, members: Array, predicted: Array, observed: Array, noise: Array, rng: Rng
    ) -> Array:
        """Update one agent's ensembles by the user's function, which may work in place."""
        # The update gets complete observations only; rows with missing numbers are treated apart.
        new = with_missing(
            self.update,
            members.copy(),
            predicted.copy(),
            observed.copy(),
            noise.copy(),
            rng=rng,
        )
        return check_array(new, "update", members.shape, finite=False)


def _check_shape(values: Array, name: str, shape: tuple[int, ...]) -> None:
    """Refuse a result that is no float64 array of the ensembles' shape."""
    is_array = type(values) is np.ndarray and values.dtype == np.float64
    if not is_array or values.shape != shape:
        check_array(values, name, shape, finite=False)


@dataclass(frozen=True, eq=False)
class TransportFilter(_EnsembleSummary):
    r"""Agents that hold the same members, agree on their log-likelihoods, and transport alone.

    Observations of different agents are independent, so the log-likelihood of all of them is A
    times the agents' average, :math:`\log w_i=\sum_a\log p(\mathbf y^a|\mathbf x_i)`. The fusion
    rule finds it; then every agent computes the same ensemble transform. All agents draw the prior,
    process noise and rejuvenation from one seed, so that the members stay in common. Therefore they
    fuse in every step, and a moving graph must have links whenever there are observations; the
    observations stay with their agents.

    Parameters
    ----------
    model, sensors, graph, gate_probability, faults, names
        As for :class:`~distfilt.filters.SensorFilter`.
    lag, on_error, record_evidence
        As in :mod:`distfilt.filters.options`.
    fusion : callable
        ``fusion(log_likelihoods, channel) -> averages``, both (\*runs, A, N): exact finite-time
        averaging by default, or ``partial(average_consensus, rounds=20)``.
    members : int
        Number N of members of the common set.
    correct : bool
        Give the members the weighted covariance too.
    rejuvenation : float
        h of :func:`distfilt.coupling.rejuvenate`; 0 draws nothing.

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
    fusion: Callable[..., object] | None = finite_time_consensus
    correct: bool = False
    rejuvenation: NonNegativeFloat = 0.0

    belief_kind: ClassVar[str | None] = "vectors"
    supports_likelihoods: ClassVar[bool] = True

    def initial_state(
        self, prior: Prior, runs: tuple[int, ...], rng: Rng | None
    ) -> dict[str, object]:
        """Draw one set of members, (N, d) or (*runs, 1, N, d), for all agents."""
        if split_by_agent(prior, self.model.dim, self.n_agents) is not None:
            raise ValueError(
                "prior must be one for all agents of a TransportFilter, which have the same "
                "members, got a list with one for each"
            )
        # One draw, repeated for every agent; angles are shifted by whole periods, so that the mean
        # is in [-period/2, period/2).
        common = settle(self.draw_prior(prior, (*runs, 1), rng), self.periods)
        return {"ensembles": np.repeat(common, self.n_agents, axis=-3)}

    def next_state(self, step: Step[EnsembleState]) -> EnsembleState:
        """Forecast, weight by the likelihood, agree on the weights, transport.

        Warns
        -----
        ParticleCollapse
            If one member has nearly all the weight, or an observation is far beyond the
            members' predictions.
        """
        state = step.state
        members = state.ensembles
        # Agents that cannot send would weight the common members differently.
        is_cut_off = self.n_agents > 1 and callable(self.graph) and step.channel is None
        if is_cut_off and any((*step.observations, step.delayed)):
            raise ValueError(
                "graph must have links for the observations of t = "
                f"{format_number(step.t)}, got none"
            )
        if step.dt:
            if self.periods:
                # A full turn of an angle before the step has to be a full turn after it.
                check_transition(self.model, members.mean(axis=-2), state.t, step.dt)
            sample_step = partial(self.model.sample_step, t=state.t, dt=step.dt)
            members = self._draw_in_common(sample_step, (members,), step.rng)
            if self.notices_wrapping:
                warn_of_wrapping(self.model, state.ensembles, members, state.t, step.dt)
        # The members of the earlier times that are kept, oldest first, and the present ones last
        stack = step.stack(step.check_forecast(members, state.ensembles))
        (logs,) = step.fuse(self._log_likelihoods(stack, step))
        if step.has_fusion:
            # The rule returns averages over the agents, and the joint likelihood is a sum.
            logs = self.n_agents * logs
        if step.scores:
            # log Σ p(y | xᵢ) / N: that of all agents' observations, if they agree on it.
            total = log_sum_exp(logs)[..., 0] - np.log(self.members)
            step.add_log_likelihood(total, slice(None))
        stack = self._transport(stack, logs, step)
        self._warn_of_collapse(logs, step)
        if self.periods:
            # Angles are shifted alike by whole periods: their mean lies in [-period/2, period/2).
            stack = [settle(members, self.periods) for members in stack]
        return step.end(ensembles=stack[-1], past=stack[:-1])

    def reset_belief(self, state: EnsembleState, reset: Reset) -> EnsembleState:
        """Return the state with new draws of some components, the same for all agents."""
        if len(reset.agents) < self.n_agents:
            raise ValueError(
                "agents must be all of a TransportFilter, which have the same members, got "
                f"{reset.agents}"
            )
        return super().reset_belief(state, reset)

    def draw_normal(self, shape: tuple[int, ...], rng: Rng) -> Array:
        """Draw standard normal numbers, the same for all agents."""
        # An axis of agents of length 1 broadcasts.
        *runs, _n_agents, n, d = shape
        return rng.standard_normal((*runs, 1, n, d))

    def _draw_in_common(
        self, draw: Callable[..., Array], arrays: tuple[Array, ...], rng: Rng
    ) -> Array:
        """Apply a function to the agents' arrays (*runs, A, N, d), with the same draws for all.

        Every agent gets a copy of the generator, and the last one the generator itself, which thus
        advances once.
        """
        generators = [copy_rng(rng) for _ in range(self.n_agents - 1)] + [rng]
        results = []
        for agent, generator in enumerate(generators):
            of_agent = [x[..., agent, :, :] for x in arrays]
            results.append(draw(*of_agent, rng=generator))
        return np.stack(results, axis=-3)

    def _log_likelihoods(self, stack: list[Array], step: Step[EnsembleState]) -> Array:
        """Return the log-likelihoods of each agent's observations, (*runs, A, N)."""
        logs = np.zeros(stack[-1].shape[:-1])
        for time_index, group in step.received():
            # The index of the group's agents in arrays (*runs, A, ...)
            rows = group.rows
            # The earlier members with which a sensor of changes compares
            previous = None
            if group.changes:
                previous = step.find_previous(time_index, group, stack[:-1])
            members = stack[time_index][..., rows, :, :]
            predicted = group.predict(members, previous, branch="each")
            if not all_finite(predicted):
                is_unseen = np.asarray(np.isnan(predicted).any(axis=-2))
                step.note_unseen(group, is_unseen, "some members cannot see")
            # The gate predicts a sensor that is a likelihood by members with equal weights.
            weighted = None
            if group.likelihoods:
                weighted = members, np.full(members.shape[:-1], 1 / self.members)
            group = step.gate(
                group,
                sample_moments,
                predicted,
                near_observed=True,
                is_gaussian=False,
                weighted=weighted,
            )
            group, likelihoods = group.log_likelihood(members)
            logs[..., rows, :] += likelihoods
            # Σ log p(y | xᵢ) over the observations that the agent has.
            logs[..., rows, :] += log_likelihood(predicted, group.target, group.noise)
            if step.scores:
                # The constant that all members have in common, of no influence on their weights
                normalizer = log_normalizer(group.target, group.noise)
                logs[..., rows, :] += normalizer[..., None]
            # With equal weights (logarithms of zero) only an observation far from all predictions
            # gives a warning; unequal ones are looked at after the consensus.
            warn_of_weights(0 * predicted[..., 0], predicted, group.target, group.noise)
        return logs

    def _transport(
        self, stack: list[Array], logs: Array, step: Step[EnsembleState]
    ) -> list[Array]:
        """Move all times' members by the transport plan of the present ones."""
        if self.periods:
            # Costs and means need members whose angles are near each other: within half a period
            # of the weighted circular mean.
            weights = normalize_weights(logs)
            stack = [fold(members, self.periods, weights) for members in stack]

        def compute(logs: Array, *arguments: Array) -> tuple[Array, ...]:
            # The members of all times, the present ones last, come before the two arguments that
            # `step.apply` adds for all rows: a shared array and a generator.
            *times, _shared, _rng = arguments
            # The plan from weighted to equally weighted members is optimal for the present ones,
            # and moves their past along. With `correct` they get the weighted covariance too.
            weights = normalize_weights(logs)
            plan = transport_plans(times[-1], logs)
            return tuple(
                [apply_plan(x, weights, plan, correct=self.correct) for x in times]
            )

        agents = range(self.n_agents)
        moved = step.apply(compute, (logs, *stack), tuple(stack), agents)
        if self.rejuvenation:
            draw = partial(rejuvenate, bandwidth=self.rejuvenation)
            # All times' members meet the same draws; the generator advances once.
            generators = [copy_rng(step.rng) for _ in moved[1:]] + [step.rng]
            jittered = []
            for new, old, generator in zip(moved, stack, generators, strict=True):
                jittered.append(self._draw_in_common(draw, (new, old), generator))
            moved = tuple(jittered)
        # Without an observation all likelihoods of an agent are equal, with a range of zero, and
        # its members stay as they were.
        is_observed = (np.ptp(logs, axis=-1) > 0)[..., None, None]
        return [
            np.where(is_observed, new, old)
            for new, old in zip(moved, stack, strict=True)
        ]

    def _warn_of_collapse(self, logs: Array, step: Step[EnsembleState]) -> None:
        """Warn once if one member has nearly all the weight: its copies replace the others then."""
        weights = normalize_weights(logs[~step.failed])
        size = effective_size_of(weights).min(initial=np.inf)
        # Of fewer than two members the weighted variance is half of the right one or less, and
        # the loss grows from update to update.
        if size < 2:
            time = format_number(step.t)
            problem = (
                f"t = {time} s: an agent's weights have an effective size of {size:.1f}"
            )
            text = describe_collapse(problem, "rejuvenation=")
            step.warn_once("collapse of weights", text, ParticleCollapse)


def fuse_members(step: Step[AnyState], members: Array) -> Array:
    """Return members (*runs, A, N, d) after the fusion rule.

    The rule gets angles of all agents that are near each other: each agent's are shifted by whole
    periods, and shifted back after it.
    """
    periods = step.filter.periods
    if not periods:
        (fused,) = step.fuse(members)
        return fused
    # Every agent's mean within half a period of the agents' circular mean
    means = members.mean(axis=-2)
    shift = (fold(means, periods) - means)[..., None, :]
    (fused,) = step.fuse(members + shift)
    # A rule of the user's may wrap angles, so that some members lie a period away from the rest.
    return np.asarray(fold_torn(fused, periods) - shift)


def regress_past(stack: list[Array], fused: Array) -> list[Array]:
    """Return the members of a stack's earlier times after the fusion has moved the last ones.

    The past follows by its linear regression on the present members before the fusion.
    """
    *past, present = stack
    if fused is present or not past:
        return past
    # In units of the standard deviations, so that the cut of small eigenvalues has no units:
    # C is the correlation of the present members, A their scaled anomalies, Δ the scaled shift.
    correlation, std = to_unit_variances(moments.sample_covariance(present))
    n = present.shape[-2]
    inverse = np.linalg.pinv(correlation, rcond=1e-10, hermitian=True) / (n - 1)
    scaled = center_ensemble(present).anomalies / std[..., None, :]
    shift = (fused - present) / std[..., None, :]
    # x_past + Δ C⁻¹ Aᵀ x_past / (N - 1), with Aᵀ x_past / (N - 1) the cross-covariance
    return [x + shift @ (inverse @ (scaled.mT @ x)) for x in past]


def sample_moments(members: Array) -> tuple[Array, Array]:
    """Mean and covariance of predictions (..., N, M); NaN if some member's does not exist."""
    return members.mean(axis=-2), moments.sample_covariance(members)
