"""One step of a filter: its inputs, the observations of each group of agents, and the new state.

A family's ``next_state`` gets a :class:`Step`. Agents that have equally many numbers are put into
one :class:`Received`, so that one batched update serves all of them.
"""

from __future__ import annotations

import copy
import math
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import lru_cache
from types import EllipsisType
from typing import TYPE_CHECKING, Any, Generic, Literal, NamedTuple, TypeVar, cast

import numpy as np
from numpy.typing import DTypeLike, NDArray

from ..derivatives import call_derivative, needs_differences
from ..linalg import cholesky, deviations, log_det, quadratic_form
from ..models import Model
from ..periods import Periods, check_sensor, fold, gather
from ..sensors import LikelihoodSensor, Sensor
from ..validation import Array, Indices, Mask, call_user, format_number
from ..validation.batching import name_of_check
from ..validation.first_use import needs_check
from . import failures
from .changes import Previous, References
from .exchange import ObservationsByTime, collect_observations, fuse_beliefs
from .failures import RECOVERABLE, FilterError, Row
from .gating import RejectionStreaks
from .observations import Observation, sensor_of
from .repetition import Assimilated
from .states import SensorState, State

if TYPE_CHECKING:
    from .base import Filter, SensorFilter

__all__ = ["Received", "Step", "copy_rng", "group_agents"]

S = TypeVar("S", bound=State)

_NO_RUNS = np.zeros((), dtype=bool)
_NO_SHARED = np.zeros((0, 0))
_LOG_2PI = math.log(2 * math.pi)
_FEW_AGENTS = 64
"""Up to how many agents the large cache of plans is used, see `_plan_few`."""


class Step(Generic[S]):
    """A step from a state to time `t`; a family's ``next_state`` makes the new state of it.

    Attributes
    ----------
    filter, state
        The filter, and the state before the step.
    t, dt : float
        The new time, and the length of the step, in s.
    observations : list of list of Observation
        Each agent's present observations, as ``read_observations`` of the family returned it.
    delayed : sequence of Observation
        Observations of earlier times that arrive now.
    times : tuple of float
        The earlier times that the new state keeps, oldest first.
    channel : Channel or None
        None where nobody can send.
    rng : numpy.random.Generator or None
        The step's own generator.
    failed : ndarray of bool, (*runs)
        Runs that have failed.
    has_fusion : bool
        Whether the filter has a fusion rule, and a channel to use it.
    rejected : ndarray, (*runs, A), or None
        How many observations the gate has rejected; None without a gate.
    streaks : RejectionStreaks or None
        How many observations in a row it has rejected, of each sensor; None without a gate.
    unseen : ndarray, (*runs, A), or None
        How many observations cannot be seen from the belief; None if all can.
    pending : tuple of Observation
        Observations that wait for the next contact, as nobody can send in this step.
    references : References or None
        The beliefs with which sensors of changes compare; None without such sensors.
    warned : tuple of str
        Keys of the warnings that have been given, each of them once.
    scores : dict of str to ndarray, (*runs, A)
        Scores of the observations, see :class:`~distfilt.filters.ScoresObservations`; empty if
        they are not recorded.

    Examples
    --------
    >>> from distfilt.filters import Filter, GaussianFilter
    >>> from distfilt.models import constant_velocity
    >>> from distfilt.sensors import component
    >>> class Verbose(GaussianFilter):
    ...     def next_state(self, step):
    ...         print(step.dt, [group.agents.tolist() for _, group in step.received()])
    ...         return super().next_state(step)
    >>> f = Verbose(constant_velocity(sigma=0.1), [component([0], std=1.0)])
    >>> f.step(f.start((np.zeros(4), np.eye(4))), 0.5, [[1.0]]).t
    0.5 [[0]]
    0.5

    An agent that receives an observation in every run, and one that misses it in three:

    >>> from distfilt.network import Faults, Graph
    >>> star = Graph.from_edges(3, [(0, 1), (0, 2)])
    >>> loss = np.zeros((3, 3))
    >>> loss[2, 0] = 0.5
    >>> f = GaussianFilter(
    ...     constant_velocity(sigma=0.1),
    ...     [component([0], std=1.0), None, None],
    ...     star,
    ...     faults=Faults(loss=loss),
    ... )
    >>> state = f.step(
    ...     f.start((np.zeros(4), np.eye(4)), runs=(4,)), 0.0, [[1.0], None, None]
    ... )
    >>> state.means[..., 0].T
    array([[0.5, 0.5, 0.5, 0.5],
           [0.5, 0.5, 0.5, 0.5],
           [0. , 0. , 0. , 0.5]])
    """

    def __init__(
        self,
        filter_: Filter[S],
        state: S,
        t: float,
        observations: Any,
        delayed: Sequence[Observation] = (),
        *,
        reuse_rng: bool = False,
    ) -> None:
        # Only families with sensors use the parts that need them.
        self.filter = cast("SensorFilter[S]", filter_)
        self.state = state
        self.t = t
        # At the state's own time nothing is forecast: dt = 0.
        self.dt = t - state.t
        self.observations = observations
        self.delayed = delayed
        # A state may keep a past although the filter has no lag; only a forecast drops it.
        has_past = filter_.lag > 0 or self.dt == 0
        self.times = state.lagged_times(filter_.lag, t) if has_past else ()
        # Any, since a family that needs a channel has made sure that there is one.
        self.channel: Any = None
        if self.filter.graph is not None:
            self.channel = filter_.channel(state, t)
        # The state is the user's, so its generator is copied; within a run it is the run's own.
        self.rng: Any = state.rng
        if state.rng is not None and not reuse_rng:
            self.rng = copy_rng(state.rng)
        self.failed: Mask = getattr(state, "failed", _NO_RUNS)
        self.runs: tuple[int, ...] = self.failed.shape
        self.any_failed = bool(np.any(self.failed) if self.runs else self.failed)
        # The model of the agents' states, (*runs, A, ..., d).
        self.has_sensors = filter_.has_sensors
        if self.has_sensors:
            self.model = self.filter.model_of_states(self.runs)
        # Whether there is a fusion rule, and a channel to use it.
        self.has_fusion = filter_.fusion is not None and self.channel is not None
        self.pending: tuple[Observation, ...] = ()
        # How many observations cannot be seen from a belief, if there are any.
        self.unseen: Array | None = None
        self.warned: tuple[str, ...] = state.warned
        # Sensors of changes need the beliefs about the times of their last observations.
        self.lagged = self.times
        self.references: References | None = None
        if isinstance(state, SensorState) and self.filter.change_sources:
            sources = self.filter.change_sources
            self.references = References(state, t, observations, sources)
            times = {*self.lagged, *self.references.times}
            self.times = tuple(sorted(times))
        # Counted only with a gate.
        self.rejected: Array | None = None
        self.streaks: RejectionStreaks | None = None
        # Added up over the observations, if they are recorded.
        self.scores: dict[str, Array] = {}
        # Whether there is a gate, or scores of the observations.
        has_gate = filter_.gate_probability is not None
        self.tests_innovations = has_gate or filter_.record_evidence
        if self.tests_innovations:
            self._begin_tests()

    def _begin_tests(self) -> None:
        """Begin to count what the gate rejects, and to add up scores."""
        f = self.filter
        shape = (*self.runs, f.n_agents)
        if f.gate_probability is not None:
            # How many the gate rejects in this step, and how many in a row up to now
            self.rejected = np.zeros(shape)
            self.streaks = RejectionStreaks(f, self.state, self.runs)
        if f.record_evidence:
            # Log-density of the observations, normalised innovation squared, count of numbers
            for name in ("log_likelihood", "nis", "n_observed"):
                self.scores[name] = np.zeros(shape)

    # The beliefs -----------------------------------------------------------------------

    def check_forecast(self, values: Array, old: Array | float) -> Array:
        """Return a forecast (*runs, A, ...) with `old` in runs that have failed, or fail now.

        A run fails if its forecast is not finite.
        """
        # A finite sum of squares proves that all are finite. It may overflow, so that the rows
        # are looked at if it is not.
        if not math.isfinite(np.vdot(values, values)):
            # One row for each run and agent: the axes (*runs, A).
            lead = len(self.runs) + 1
            errors = failures.find_nonfinite_rows(values, lead, "forecast")
            self.record_failures(errors, range(self.filter.n_agents))
        # Groups of agents are updated in place, which must not change the state.
        before = cast(SensorState, self.state)
        # `belief_field` has the name and the axes of the state's array of beliefs.
        if np.may_share_memory(values, getattr(before, before.belief_field[0])):
            values = values.copy()
        return self.keep_failed(values, old) if self.any_failed else values

    def stack(self, forecast: Array) -> list[Array]:
        """Return copies of the beliefs about the earlier `times`, then the present forecast."""
        if not self.times:
            return [forecast]
        state = cast(SensorState, self.state)
        if self.references is not None:
            # Sensors of changes need beliefs that the lag does not keep: all are looked up by
            # their times, from pairs (time, belief).
            beliefs = dict((*state.references, *state.past))
            if self.dt > 0:
                beliefs[state.t] = state.belief
            return [beliefs[t].copy() for t in self.times] + [forecast]
        # The beliefs before the step: about the earlier times, and about the state's own time,
        # which is one of the earlier ones after a forecast.
        before = [belief for _, belief in state.past]
        if self.dt > 0:
            before.append(state.belief)
        # With a full lag the oldest time is dropped.
        oldest = len(before) - len(self.times)
        return [belief.copy() for belief in before[oldest:]] + [forecast]

    def keep_failed(self, values: Array, old: Array | float) -> Array:
        """Return the values, but `old` in failed runs."""
        if not self.any_failed:
            return values
        # The flags (*runs) get axes of size 1 behind, to broadcast against values (*runs, ...).
        trailing = (1,) * (values.ndim - self.failed.ndim)
        failed = self.failed.reshape(*self.runs, *trailing)
        return np.asarray(np.where(failed, old, values))

    # The observations ------------------------------------------------------------------

    def received(self) -> Iterator[tuple[int, Received]]:
        """Yield groups of agents with the observations that each received, oldest time first.

        An agent's own observations are among them. A group holds observations of one time, and
        comes with the index of this time in ``(*times, t)``, of which the last is now. The
        observed values are NaN in failed runs, so that no update changes these.
        """
        by_time = self._collect_by_time()
        for time_index, t in enumerate((*self.times, self.t)):
            if t not in by_time:
                continue
            # Agents with equally many numbers are one group.
            for group in group_agents(by_time[t]):
                if self.any_failed:
                    group = group.with_target(self.keep_failed(group.target, np.nan))
                # Of a model with angles: the first prediction checks that the sensor gives the same
                # after a full turn, or has a period itself.
                if self.filter.periods:
                    group.circular_model = self.filter.model
                # With a gate: the number of the streak, the rejections in a row, that each
                # observation continues or ends.
                if self.streaks is not None:
                    group.streaks = self.streaks.list_numbers(t, group.agents)
                yield time_index, group

    def _collect_by_time(self) -> ObservationsByTime:
        """Return the observations by time, and then by agent, as pairs of sensor and value.

        They are those that each agent has after the exchange of observations, if there is one.
        """
        f = self.filter
        if self.delayed or (f.graph is not None and f.share_observations):
            return collect_observations(self)
        # Nothing is exchanged here. A subclass may have put other agents' observations
        # into an agent's list, so a sensor is looked up at the agent that observed.
        pairs: list[list[tuple[Sensor, Array]]] = []
        for agent, observations in enumerate(self.observations):
            of_agent: list[tuple[Sensor, Array]] = []
            for o in observations:
                # Sensors of changes, and a gate, need to know later whose observation each is.
                if self.references is not None:
                    self.references.receive(agent, o)
                if self.streaks is not None:
                    self.streaks.note(self.t, agent, o)
                # It comes with an observation, or is one of the agent's, by its number.
                sensor = o.sensor
                if isinstance(sensor, int):
                    sensor = f.agent_sensors[o.agent][sensor]
                of_agent.append((sensor, o.value))
            pairs.append(of_agent)
        return {self.t: pairs}

    def find_previous(
        self,
        time_index: int,
        group: Received,
        past: list[Array],
        origin: Array | None = None,
    ) -> list[Previous] | None:
        """Return the earlier members with which a group's sensors of changes compare, if any.

        They are among the `past`, the members of the earlier `times`, or those with which the step
        begins, if it has a length: the state's, or `origin` if these have been resampled. None for
        a group of an earlier time, since delayed observations of changes are refused.
        """
        is_now = time_index >= len(self.times)
        if not group.changes or self.references is None or not is_now:
            return None
        # Time and members at the beginning of the step
        start = None
        if self.dt > 0:
            start = (
                self.state.t,
                cast(SensorState, self.state).belief if origin is None else origin,
            )
        return self.references.find(group, past, self.times, start)

    def gate(
        self,
        group: Received,
        moments: Callable[..., tuple[Array, Array]],
        predicted: Array,
        *args: Array,
        near_observed: bool = False,
        is_gaussian: bool = True,
        weighted: tuple[Array, Array] | None = None,
    ) -> Received:
        """Return a group without the observations that the gate rejects, and count these.

        The group has G agents with M observed numbers each, and N predictions of them by each
        agent's N members. ``moments(predicted, *args)`` gives mean (*runs, G, M) and covariance
        (*runs, G, M, M) of the predictions (*runs, G, N, M), without the observations' noise. With
        `near_observed` each prediction of an angle was brought within half a period of the observed
        value. The observations that pass are scored, if the filter records that: their
        log-likelihood too, if predictions are taken as Gaussian. `weighted` holds the members
        (*runs, G, N, d) and their weights (*runs, G, N), by which likelihood sensors are predicted.
        """
        if self.rejected is None and not self.scores:
            return group
        if near_observed and group.wraps:
            # Angles near half a turn from the observed value lie on both sides of it, and their
            # mean between them. So all are brought near the first one, then near their mean.
            predicted = group.wrap_near(predicted.copy(), predicted[..., :1, :])
            mean, _ = moments(predicted, *args)
            predicted = group.wrap_near(predicted, mean[..., None, :])
        mean, cov = moments(predicted, *args)
        # The mean within half a period of the observed value: the innovation is then the shorter
        # way round.
        mean = group.wrap_near(mean[..., None, :].copy(), group.target[..., None, :])
        mean = mean[..., 0, :]
        if weighted is not None and group.likelihoods:
            has_gate = self.rejected is not None
            mean, cov = group.insert_moments(mean, cov, *weighted, is_required=has_gate)
        if self.rejected is not None:
            # A filter with a gate has a probability.
            probability = cast(float, self.filter.gate_probability)
            before = group
            group, rejected = group.gate(mean, cov, probability)
            self.rejected[..., group.agents] += rejected
            streaks = cast(RejectionStreaks, self.streaks)
            warning = streaks.count_group(before, group, mean)
            if warning is not None:
                self.warn_once("gate", warning)
        if self.scores:
            self._score(group, mean, cov, is_gaussian)
        return group

    def note_gated(
        self, agent: int, observation: Observation, *, is_rejected: bool
    ) -> None:
        """Count an observation that an agent's gate has tested by itself, in a single run."""
        if self.rejected is None:
            return
        self.rejected[agent] += is_rejected
        streaks = cast(RejectionStreaks, self.streaks)
        # The streak is lengthened by one, or ended; a warning if it has reached the limit.
        number = streaks.number_of(agent, observation)
        rejected = np.array([is_rejected])
        if streaks.count(np.array([number]), rejected, ~rejected).any():
            sensor = sensor_of(self.filter, observation)
            self.warn_once("gate", streaks.describe(number, sensor.kind))

    def _score(
        self, group: Received, mean: Array, cov: Array, is_gaussian: bool
    ) -> None:
        """Add the scores of a group's observations to those of the step.

        `mean` (*runs, G, M) and `cov` (*runs, G, M, M) are those of the predictions without noise.
        """
        innovation = group.target - mean
        missing = np.isnan(innovation)
        n_observed = (~missing).sum(axis=-1)
        # Numbers of likelihood sensors without moments: they count as observed, but have no
        # innovation, so that the agent's sum of squares is unknown (NaN).
        n_unpredicted = group.count_unpredicted()
        # Missing numbers have a zero innovation and a unit covariance.
        is_pair = ~missing[..., :, None] & ~missing[..., None, :]
        unit = np.eye(innovation.shape[-1])
        innovation_cov = np.where(is_pair, cov + group.noise, unit)
        innovation = np.where(missing, 0.0, innovation)

        # `apply` also passes an array that all rows share and a generator, not needed here.
        def compute(r: Array, s: Array, *_: object) -> tuple[Array, ...]:
            # ε = rᵀ S⁻¹ r, and log det S
            lower = cholesky(s)
            return quadratic_form(lower, r), log_det(lower)

        zero = np.zeros(innovation.shape[:-1])
        nis, log_volume = self.apply(
            compute, (innovation, innovation_cov), (zero, zero), group.agents
        )
        nis_or_nan = np.where(n_unpredicted > 0, np.nan, nis)
        self.scores["nis"][..., group.agents] += nis_or_nan
        self.scores["n_observed"][..., group.agents] += n_observed + n_unpredicted
        if is_gaussian:
            # log N(r; 0, S)
            log_density = -0.5 * (nis + log_volume + n_observed * _LOG_2PI)
            self.add_log_likelihood(log_density, group.agents)

    def add_log_likelihood(self, values: Array, agents: Indices | slice) -> None:
        """Add values (*runs, G) to the recorded log-likelihood of these agents' observations."""
        self.scores["log_likelihood"][..., agents] += values

    # Failures --------------------------------------------------------------------------

    def apply(
        self,
        compute: failures.Compute,
        arrays: tuple[Array, ...],
        fallback: tuple[Array, ...],
        agents: Sequence[int] | Indices | None = None,
        *,
        shared: Array = _NO_SHARED,
        rng: np.random.Generator | None = None,
    ) -> tuple[Array, ...]:
        """Compute on a batch (*runs, ...) or (*runs, G, ...) whose rows may fail one by one.

        Parameters
        ----------
        compute : callable
            ``compute(*arrays, shared, rng) -> results`` for any leading axes.
        arrays, fallback : tuple of ndarray
            Its arguments, and the results of rows that fail.
        agents : sequence of int, optional
            Numbers of the G agents, if the rows have an axis of agents.
        shared : ndarray, (m, m) or (G, m, m)
            One argument for all rows, or one for each agent.
        rng : numpy.random.Generator, optional

        Returns
        -------
        tuple of ndarray
            The results; failures are recorded, or raised if the filter says so.
        """
        # How many leading axes count rows: those of the runs, and that of the agents
        lead = len(self.runs) + (agents is not None)
        # The state of the generator, to draw the same numbers in a second attempt.
        rng_state: Mapping[str, object] | None = None
        if rng is not None and math.prod(arrays[0].shape[:lead]) > 1:
            rng_state = rng.bit_generator.state
        errors: dict[Row, str] = {}
        # The plain way: one call for the whole batch.
        try:
            results = compute(*arrays, shared, rng)
        except RECOVERABLE as error:
            results, errors = failures.recompute_rows(
                compute,
                arrays,
                fallback,
                lead,
                shared=shared,
                rng=rng,
                rng_state=rng_state,
                cause=error,
            )
        # A row may also fail without an error, by overflow for instance.
        for values in results:
            if not math.isfinite(np.vdot(values, values)):
                errors |= failures.find_nonfinite_rows(values, lead, "result")
        if errors:
            # Failed rows keep their values from before the computation.
            results = tuple([values.copy() for values in results])
            for row in errors:
                for values, old in zip(results, fallback, strict=True):
                    values[row] = old[row]
            self.record_failures(errors, agents)
        return results

    def record_failures(
        self,
        errors: dict[Row, str],
        agents: Sequence[int] | Indices | None = None,
    ) -> None:
        """Mark the runs of these errors as failed, or raise the first error.

        A key is the index of a run, (*runs); with `agents` the position of an agent in these
        follows as its last entry.
        """
        if not errors:
            return
        # The first error is raised; with "keep" all of them are marked.
        n_axes = len(self.runs)
        row, why = next(iter(errors.items()))
        if self.filter.on_error == "raise" or not self.runs:
            agent = None if agents is None else int(agents[row[-1]])
            raise FilterError(row[:n_axes], agent, self.t, why)
        # The flags of the state before the step stay as they are.
        self.failed = self.failed.copy()
        for row in errors:
            self.failed[row[:n_axes]] = True
        self.any_failed = True

    @contextmanager
    def failing_as(self, agent: int) -> Iterator[None]:
        """Attribute errors in the block to an agent."""
        try:
            yield
        except RECOVERABLE as error:
            raise FilterError((), agent, self.t, error) from error

    # Fusion ----------------------------------------------------------------------------

    def fuse(self, *values: Array) -> tuple[Array, ...]:
        """Return values (*runs, A, ...) after the fusion rule, if any; unchanged in failed runs.

        >>> from distfilt.filters import EnsembleFilter
        >>> from distfilt.models import Model
        >>> from distfilt.network import graphs
        >>> still = Model(1, lambda x, t, dt: x, lambda t, dt: np.zeros((1, 1)))
        >>> f = EnsembleFilter(
        ...     still,
        ...     [None] * 2,
        ...     graphs.path(2),
        ...     members=4,
        ...     lag=1,
        ...     fusion=lambda x, channel: np.multiply(x, 2.0, out=x),
        ... )
        >>> state = f.step(
        ...     f.start(([0.0], [[1.0]]), rng=np.random.default_rng(0)), 1.0, [None] * 2
        ... )
        >>> bool(np.allclose(state.history[0][1], state.ensembles))
        True
        """
        if not self.has_fusion or (self.any_failed and self.failed.all()):
            return values
        return fuse_beliefs(self, values)

    # The new state ---------------------------------------------------------------------

    def end(self, *, past: Iterable[Array] = (), **fields: object) -> S:
        """Return the state after the step: the family's fields, and what all families keep.

        Parameters
        ----------
        past : iterable of ndarray
            The beliefs about the earlier times, in the order of `times`.
        **fields
            The fields of the family's own, such as the means of Gaussians.
        """
        state = self.state
        # A long run keeps many states: fields with their default are left out to save memory.
        if isinstance(state, SensorState):
            # The lag keeps earlier times, and so do sensors of changes, which refer to them.
            if self.times or self.references is not None:
                fields |= self._describe_past(past, fields)
            fields["failed"] = self.failed
            # How many observations each agent's belief could not have predicted
            if self.unseen is not None:
                fields["unseen"] = self.unseen
            # Observations that wait until their agents can send
            if self.pending:
                fields["pending"] = self.pending
        if self.has_sensors:
            # By these the next steps find observations that come a second time.
            fields["assimilated"] = self._note_assimilated()
            # The warnings that have been given, each of them once
            if self.warned:
                fields["warned"] = self.warned
        # What the gate rejected: in a row, over several steps, and in this one
        if self.streaks is not None:
            fields["rejection_streaks"] = self.streaks.counts
        if self.rejected is not None:
            # A failed run has no counts.
            fields["rejected"] = self.keep_failed(self.rejected, np.nan)
        # The messages in the step are in the channel's ledger.
        ledger = state.ledger if self.channel is None else self.channel.ledger
        # A failed run has no score.
        for name, values in self.scores.items():
            self.scores[name] = self.keep_failed(values, np.nan)
        new: S = type(state).construct(
            self.t, ledger, self.rng, **self.scores, **fields
        )
        return new

    def _describe_past(
        self, past: Iterable[Array], given: dict[str, object]
    ) -> dict[str, object]:
        """Return the state's fields about the earlier times that the lag or a sensor keeps.

        `past` has a belief for each of `times`; `given` are the fields that the family returns.
        """
        # Times and beliefs. A family that keeps its past in a form of its own gives none here.
        pairs = list(zip(self.times, past, strict=False))
        fields: dict[str, object] = {}
        if "history" not in given:
            # The times of the lag; `times` has those that sensors of changes need too.
            fields["history"] = tuple(
                [pair for pair in pairs if pair[0] in self.lagged]
            )
        if self.references is not None:
            # Beliefs with which sensors of changes compare, beyond those of the lag.
            kept = self.references.kept.difference(self.lagged)
            fields["references"] = tuple([pair for pair in pairs if pair[0] in kept])
            fields["last_changes"] = self.references.last_changes
        return fields

    def _note_assimilated(self) -> tuple[Assimilated, ...]:
        """Return the observations of the times that are kept, by copies of their values."""
        result = []
        if self.lagged or self.dt == 0:
            kept_times = (*self.lagged, self.t)
            before = self.state.assimilated
            result = [entry for entry in before if entry[0] in kept_times]
        # The present ones agent by agent, then the delayed ones
        for entries in (*self.observations, self.delayed):
            for o in entries:
                # The user may change the array before the next step, unless it is a frozen copy.
                flags = o.value.flags
                is_frozen = flags.owndata and not flags.writeable
                value = o.value if is_frozen else o.value.copy()
                result.append((o.t, o.agent, o.sensor, value, o.metadata))
        return tuple(result)

    # What is said once ----------------------------------------------------------------

    def warn_once(
        self, key: str, text: str, category: type[RuntimeWarning] = RuntimeWarning
    ) -> None:
        """Warn, unless this state or one before it has led to the same warning."""
        if key in self.warned:
            return
        self.warned = (*self.warned, key)
        # The warning names a line four frames up, near the user's call.
        warnings.warn(text, category, stacklevel=4)

    def note_unseen(self, group: Received, is_unseen: Mask, reason: str) -> None:
        """Count observations with numbers (*runs, G, M) that no update can use, and warn once.

        The sensor does not see from the belief: its prediction does not exist.
        """
        is_unseen = is_unseen & ~np.isnan(group.target)
        if not is_unseen.any():
            return
        if self.unseen is None:
            self.unseen = np.zeros((*self.runs, self.filter.n_agents))
        # Numbers of one sensor are one observation.
        for k in range(int(group.sensor_index.max()) + 1):
            of_sensor = is_unseen & (group.sensor_index == k)
            self.unseen[..., group.agents] += of_sensor.any(axis=-1)
        # The warning names the first: agent g of the group, and a column of its M numbers.
        *_run, g, column = np.argwhere(is_unseen)[0].tolist()
        self.warn_once(
            "unseen",
            f"observations must be predicted to be used, but {reason}: agent "
            f"{group.agents[g]} left out one of kind {group.kind_of(g, column)!r} at t = "
            f"{format_number(self.t)} s; the record counts them as unseen",
        )


class _Part(NamedTuple):
    """One sensor of a group of G agents: which of them have it, and which numbers are its own."""

    sensor: Sensor
    agents: Indices | slice
    """Positions of these agents in the group, (K,), or a slice if all have it."""
    target_index: tuple[Indices | slice, Indices | slice]
    """Index of the sensor's m numbers of each agent in arrays (..., G, M), as the targets are.

    Row and column indices (K, 1) and (K, m), or two slices of everything.
    """


def _block_of(part: _Part) -> tuple[Indices | slice | EllipsisType, ...]:
    """Return the index of a sensor's block in covariances (*runs, G, M, M).

    Its numbers' columns (K, m) are both the rows and the columns of the block, (K, m, m).
    """
    rows, columns = part.target_index
    if isinstance(rows, slice) or isinstance(columns, slice):
        return (..., rows, columns, columns)
    return (..., rows[..., None], columns[..., :, None], columns[..., None, :])


class Received:
    """Observations of G agents that have equally many numbers M, for one batched update.

    Attributes
    ----------
    agents : ndarray of int, (G,)
        Their numbers.
    rows : slice or ndarray
        The same as an index of an array of all agents; a slice if none is left out between two.
    target : ndarray, (*runs, G, M)
        The observed values, NaN where a component is missing.
    noise : ndarray, (M, M) or (G, M, M)
        Covariance of their noise, one for all agents if it is the same.
    linear, changes, wraps : bool
        Whether all sensors are linear; whether one of them measures a change; whether one of them
        measures an angle.
    parts : list of _Part
        The different sensors, with the agents and the numbers of each.
    sensor_index : ndarray of int, (G, M)
        Which of its agent's sensors each number belongs to.

    Examples
    --------
    >>> from distfilt.sensors import component
    >>> sensor = component([0], std=0.5)
    >>> (pair,) = group_agents([[(sensor, np.array([1.0]))]] * 2)
    >>> pair.agents, pair.target.ravel(), pair.noise
    (array([0, 1]), array([1., 1.]), array([[0.25]]))
    >>> precise, coarse = component([1], std=1.0), component([1], std=2.0)
    >>> one = np.ones(1)
    >>> (pair,) = group_agents(
    ...     [[(sensor, one), (precise, one)], [(sensor, one), (coarse, one)]]
    ... )
    >>> pair.noise[:, 1, 1]
    array([1., 4.])
    """

    target: Array

    def __init__(
        self, agents: list[int], sensors: Mapping[int, tuple[Sensor, ...]]
    ) -> None:
        self.agents = np.array(agents, dtype=np.intp)
        # A slice gives views, where a list of numbers copies.
        self.rows: Indices | slice = self.agents
        if agents == list(range(agents[0], agents[-1] + 1)):
            self.rows = slice(agents[0], agents[-1] + 1)
        size = sum(sensor.dim for sensor in sensors[agents[0]])
        # Which of its agent's sensors each number belongs to, for the gate.
        self.sensor_index = np.zeros((len(agents), size), dtype=np.intp)
        # Agents with the same sensor are predicted together: where its numbers start.
        starts: dict[Sensor, list[tuple[int, int]]] = {}
        for g, agent in enumerate(agents):
            start = 0
            for k, sensor in enumerate(sensors[agent]):
                starts.setdefault(sensor, []).append((g, start))
                self.sensor_index[g, start : start + sensor.dim] = k
                start += sensor.dim
        self.parts = [self._make_part(*item) for item in starts.items()]
        # Sensors whose derivative is made by differences, or not yet compared with them.
        self._differenced = [part.sensor for part in self.parts]
        self.noise = self._assemble_noise(starts)
        self.linear = all(sensor.linear is not None for sensor in starts)
        self.changes = any(sensor.uses_previous for sensor in starts)
        self.wraps = any(sensor.wraps for sensor in starts)
        self.half_periods = self._collect_half_periods()
        # The sensors that are likelihoods: their numbers are not predicted.
        self.likelihoods = [
            part for part in self.parts if isinstance(part.sensor, LikelihoodSensor)
        ]
        # The model, if it has circular components.
        self.circular_model: Model | None = None
        # Which streak of rejections each observation of each agent belongs to, with a gate.
        self.streaks: list[list[int]] = []
        # All agents have the same only sensor: nothing has to be sorted.
        self.has_one_part = isinstance(self.parts[0].agents, slice)
        self._matrices: dict[int, Array] = {}
        # Sensors whose function has been checked, for a single state or for several.
        self._checked: set[tuple[Sensor, bool]] = set()

    def _make_part(self, sensor: Sensor, starts: list[tuple[int, int]]) -> _Part:
        """Describe where a sensor's numbers are.

        `starts` are pairs of an agent's position in the group and the column of its first number.
        """
        positions, first = np.array(starts, dtype=np.intp).T
        # The columns of the sensor's m numbers, (K, m)
        columns = first[:, None] + np.arange(sensor.dim)
        if columns.shape == self.sensor_index.shape:
            # The only sensor of the group: slices give views instead of copies.
            return _Part(sensor, slice(None), (slice(None), slice(None)))
        return _Part(sensor, positions, (positions[:, None], columns))

    def _assemble_noise(self, starts: dict[Sensor, list[tuple[int, int]]]) -> Array:
        """Put the sensors' noise covariances on the diagonals of the G agents' matrices.

        `starts` has for each sensor the positions of its agents in the group, each with the column
        of its first number. The result is (G, M, M), or (M, M) if all agents agree.
        """
        n_agents, size = self.sensor_index.shape
        noise = np.zeros((n_agents, size, size))
        for sensor, positions in starts.items():
            # It has a likelihood in place of a noise: its block stays zero.
            if isinstance(sensor, LikelihoodSensor):
                continue
            for g, start in positions:
                block = slice(start, start + sensor.dim)
                noise[g, block, block] = sensor.noise_cov
        return noise[0] if (noise == noise[:1]).all() else noise

    def _collect_half_periods(self) -> Array | None:
        """Return half the period of each number, (G, M), infinity without one.

        None if no number wraps, or one wraps by a sensor's own function.
        """
        if not self.wraps:
            return None
        # Numbers that are no angles never wrap.
        result = np.full(self.sensor_index.shape, np.inf)
        for part in self.parts:
            if part.sensor.half_periods is not None:
                result[part.target_index] = part.sensor.half_periods
            elif part.sensor.wraps:
                return None
        return result

    @property
    def has_same_sensors(self) -> bool:
        """Whether all agents of the group have the same sensors, in the same order."""
        n_agents = len(self.agents)
        for part in self.parts:
            _, columns = part.target_index
            if isinstance(part.agents, slice) or isinstance(columns, slice):
                continue
            # Every column at which the sensor's numbers start must be that of all agents. The
            # columns are (K, m), with a row for each time that an agent has the sensor.
            firsts = np.unique(columns[:, 0])
            if len(part.agents) != n_agents * len(firsts):
                return False
        return True

    def collect(self, function: Callable[[Sensor], Array]) -> Array:
        """Evaluate a function of a sensor, (m, k), for all numbers of the group, (G, M, k)."""
        values = [np.asarray(function(part.sensor)) for part in self.parts]
        result = np.empty((*self.sensor_index.shape, values[0].shape[-1]))
        for part, value in zip(self.parts, values, strict=True):
            result[part.target_index] = value
        return result

    def H(self, dim: int) -> Array:
        """Return the matrices of linear sensors one below the other, (G, M, d), made once.

        `dim` is the size d of the state.
        """
        if dim not in self._matrices:
            matrix = np.zeros((*self.sensor_index.shape, dim))
            for part in self.parts:
                matrix[part.target_index] = part.sensor.H(dim)
            self._matrices[dim] = matrix
        return self._matrices[dim]

    def kind_of(self, g: int, column: int) -> str:
        """Return the kind of the sensor that one of the M numbers of the g-th agent belongs to."""
        # The position of each number's sensor in `parts`
        owners = np.zeros(self.sensor_index.shape, dtype=np.intp)
        for k, part in enumerate(self.parts):
            owners[part.target_index] = k
        return str(self.parts[owners[g, column]].sensor.kind)

    def log_likelihood(self, states: Array) -> tuple[Received, Array | float]:
        """Return the log-likelihoods of states (*runs, G, N, d) by sensors that are likelihoods.

        They are (*runs, G, N), the second result. The first is the group without these sensors'
        observations, for the Gaussian ones that remain.
        """
        if not self.likelihoods:
            return self, 0.0
        logs = np.zeros(states.shape[:-1])
        target = self.target.copy()
        for part in self.likelihoods:
            sensor = cast(LikelihoodSensor, part.sensor)
            observed = target[(..., *part.target_index)]
            members = states[..., part.agents, :, :]
            values = sensor.evaluate(members, observed[..., None, :])
            # An agent may have several observations of one sensor.
            # Any: numpy's types of `at` have no index of several axes.
            index: Any = (..., part.agents, slice(None))
            np.add.at(logs, index, values)
        # The rest of the group, in whose target these sensors' numbers become missing below. These
        # get a unit variance, so that R has an inverse.
        rest = self.with_target(target)
        rest.noise = np.array(
            np.broadcast_to(self.noise, (*target.shape[-2:], target.shape[-1]))
        )
        for part in self.likelihoods:
            target[(..., *part.target_index)] = np.nan
            rest.noise[_block_of(part)] = np.eye(part.sensor.dim)
        return rest, logs

    def insert_moments(
        self,
        mean: Array,
        cov: Array,
        states: Array,
        weights: Array,
        *,
        is_required: bool,
    ) -> tuple[Array, Array]:
        """Return moments of the predictions with those of likelihood sensors put in.

        These are sums over the members `states` (*runs, G, N, d) with `weights` (*runs, G, N), in
        the sensors' cells of `mean` (*runs, G, M) and `cov` (*runs, G, M, M). A sensor without
        moments is an error if they are required, as for a gate; otherwise its mean is NaN, and
        :meth:`count_unpredicted` counts its observations.
        """
        mean = mean.copy()
        cov = cov.copy()
        for part in self.likelihoods:
            sensor = cast(LikelihoodSensor, part.sensor)
            if sensor.moments is None and not is_required:
                mean[(..., *part.target_index)] = np.nan
                continue
            means, covs = sensor.predict_moments(states[..., part.agents, :, :])
            # E[y] = Σ wᵢ mᵢ and Cov[y] = Σ wᵢ (Rᵢ + (mᵢ - E[y]) (mᵢ - E[y])ᵀ)
            w = weights[..., part.agents, :]
            # Angles within half a period of their circular mean, and then their mean within half a
            # period of the observed value
            means = fold(means, cast(Periods, sensor.periods), w)
            centre = np.einsum("...n,...nm->...m", w, means)
            anomalies = means - centre[..., None, :]
            covs = covs + anomalies[..., :, None] * anomalies[..., None, :]
            observed = self.target[(..., *part.target_index)]
            mean[(..., *part.target_index)] = sensor.bring_near(centre, observed)
            cov[_block_of(part)] = np.einsum("...n,...nij->...ij", w, covs)
        return mean, cov

    def count_unpredicted(self) -> Array:
        """Return how many numbers agents have of sensors without moments, (*runs, G)."""
        count = np.zeros(self.target.shape[:-1])
        for part in self.likelihoods:
            if cast(LikelihoodSensor, part.sensor).moments is None:
                observed = ~np.isnan(self.target[(..., *part.target_index)])
                self._add_by_agent(count, part, observed.sum(axis=-1))
        return count

    def _add_by_agent(
        self, totals: Array, part: _Part, values: NDArray[np.generic]
    ) -> None:
        """Add values of each of a sensor's observations to those of its agents, in place."""
        # Any: numpy's types of `at` have no index of several axes.
        index: Any = (..., part.agents)
        # An agent may have several observations of one sensor.
        np.add.at(totals, index, values)

    def with_target(self, target: Array) -> Received:
        """Return the same group with these observed values."""
        # The plan is shared: only the values differ from step to step.
        result = object.__new__(Received)
        vars(result).update(vars(self), target=target)
        return result

    def predict(
        self,
        states: Array,
        previous: list[Previous] | Array | None = None,
        *,
        branch: Literal["mean", "first", "each"] = "mean",
    ) -> Array:
        """Predict the observations of states (*runs, G, N, d) without noise, (*runs, G, N, M).

        A branch is a choice of the multiple of the period that is added to an angle. Predicted
        angles are brought onto one branch, about the prediction of the states' mean, and are then
        shifted together by whole periods, until their mean, or with ``"first"`` the prediction of
        the first state, is within half a period of the observed value. With ``"each"`` every
        prediction is brought that near by itself, as likelihoods need it. `previous` holds the
        states at the time that a sensor of changes compares with, or several such times.
        """
        if isinstance(previous, list):
            return self._predict_changes(states, previous, branch)
        if self.circular_model is not None:
            self._check_sensors(self.circular_model, states, previous)
        if self.linear:
            # y = x Hᵀ; a contiguous copy multiplies faster than a transposed view.
            result = np.asarray(
                states @ np.ascontiguousarray(self.H(states.shape[-1]).mT)
            )
            # Linear predictions of states near each other are not wrapped: they are near each other
            # too.
            return self._bring_near_target(result, branch) if self.wraps else result
        if self.has_one_part:
            values = self._predict_part(self.parts[0], states, previous, branch)
            # A copy, since the user's function may keep its result.
            result = np.array(values, order="C")
        else:
            # Numbers before states, so that the cells of a sensor are one index.
            n_states = states.shape[-2]
            rows = np.empty((*states.shape[:-2], self.target.shape[-1], n_states))
            for part in self.parts:
                # Only sensors that measure a change need the previous states.
                before = None if previous is None else previous[..., part.agents, :, :]
                # The states of the K agents that have it, (*runs, K, N, d)
                of_agents = states[..., part.agents, :, :]
                values = self._predict_part(part, of_agents, before, branch)
                rows[(..., *part.target_index, slice(None))] = values.swapaxes(-1, -2)
            result = np.ascontiguousarray(rows.swapaxes(-1, -2))
        if not math.isfinite(np.vdot(result, result)) and np.isinf(result).any():
            raise ValueError(
                "predicted must have finite numbers or NaN (missing), got infinity"
            )
        return self._bring_near_target(result, branch) if self.wraps else result

    def _predict_changes(
        self,
        states: Array,
        previous: list[Previous],
        branch: Literal["mean", "first", "each"],
    ) -> Array:
        """Predict where each number is compared with the earlier states of a time of its own.

        All numbers are predicted with the states of each time, and each takes its own time's.
        """
        result: Array | None = None
        # `is_compared` (*runs, G, M): the numbers that are compared with these members
        for members, is_compared in previous:
            predicted = self.predict(states, members, branch=branch)
            if result is None:
                result = predicted
            else:
                result = np.where(is_compared[..., None, :], predicted, result)
        return cast(Array, result)

    def _bring_near_target(self, predicted: Array, branch: str) -> Array:
        """Bring predictions (*runs, G, N, M) near the observed value, by whole periods.

        With the branch "each" every prediction by itself; otherwise all N by the same shift.
        """
        target = self.target[..., None, :]
        if branch == "each":
            return self.wrap_near(predicted, target)
        # The prediction that decides: the first state's, or the mean of all
        centre = predicted[..., :1, :]
        if branch == "mean" and predicted.shape[-2] > 1:
            centre = predicted.mean(axis=-2, keepdims=True)
        if self.half_periods is not None:
            # The usual case: all numbers are near as they are. NaN, a missing one, is not.
            is_near = np.abs(target - centre) < self.half_periods[:, None, :]
            if np.count_nonzero(is_near) == is_near.size:
                return predicted
        shift = self.wrap_near(centre.copy(), target) - centre
        # Exactly zero where nothing is shifted; NaN where some state has no prediction.
        if not np.count_nonzero(shift):
            return predicted
        return np.asarray(predicted + np.where(np.isnan(shift), 0.0, shift))

    def _check_sensors(
        self, model: Model, states: Array, previous: Array | None
    ) -> None:
        """Refuse a sensor whose prediction changes when an angle of the state turns once.

        A sensor that measures an angle has to have its period.
        """
        for part in self.parts:
            rows = (..., part.agents, slice(None), slice(None))
            before = None if previous is None else previous[rows]
            observed = self.target[(..., *part.target_index)]
            check_sensor(part.sensor, model, states[rows], before, observed)

    def _predict_part(
        self, part: _Part, states: Array, previous: Array | None, branch: str
    ) -> Array:
        """Predict with one sensor, (*runs, K, N, m), the states (*runs, K, N, d) of its agents.

        Its function h is called directly once :meth:`Sensor.predict` has checked it.
        """
        sensor = part.sensor
        shape = (*states.shape[:-1], sensor.dim)
        if isinstance(sensor, LikelihoodSensor):
            # It needs no prediction: `log_likelihood` evaluates it at the states.
            return np.zeros(shape)
        # A function may work for a single state and fail for several: both have to be checked.
        is_single = states.size == states.shape[-1]
        if (sensor, is_single) in self._checked:
            # A copy, since the user's function may work in place.
            values = np.asarray(call_user(sensor.h, states.copy()), dtype=np.float64)
            if values.shape != shape:
                # The checked call raises an error that says which shape is needed.
                values = sensor.predict(states, previous)
        else:
            values = sensor.predict(states, previous)
            # `predict` checks h when it first gets a single state, and when it first gets several.
            # A sensor of changes has two arguments, and is never called directly.
            check = name_of_check("h", states)
            if not sensor.uses_previous and not needs_check(sensor, check):
                self._checked.add((sensor, is_single))
        if sensor.wraps and branch != "each" and states.shape[-2] > 1:
            return _gather_predictions(sensor, values, states, previous)
        return values

    def wrap_near(self, predicted: Array, reference: Array) -> Array:
        """Bring predictions (*runs, G, N, M) within half a period of a reference, in place.

        The reference is (*runs, G, 1 or N, M).
        """
        if not self.wraps:
            return predicted
        # The states last, so that the target's index selects a sensor's numbers.
        values = predicted.swapaxes(-1, -2)
        # The reference for every state, NaN where the prediction is.
        full = (reference + 0 * predicted).swapaxes(-1, -2)
        for part in self.parts:
            # A sensor without angles has nothing to bring near.
            if not part.sensor.wraps:
                continue
            index = (..., *part.target_index, slice(None))
            of_sensor = values[index].swapaxes(-1, -2)
            goal = full[index].swapaxes(-1, -2)
            values[index] = part.sensor.bring_near(of_sensor, goal).swapaxes(-1, -2)
        return predicted

    def jacobian(self, states: Array, cov: Array | None = None) -> Array:
        """Return the derivatives of the observations at states (*runs, G, d), (*runs, G, M, d).

        The states have the covariances `cov`, (*runs, G, d, d). Where a sensor has no derivative,
        or one that has to be checked first, finite differences are taken, with steps in proportion
        to the standard deviations.
        """
        d = states.shape[-1]
        if self.linear:
            # The same for all runs, in an array of its own
            return np.full((*self.target.shape, d), self.H(d))
        std = None
        if self._differenced:
            # The sensors that still need differences: those without a derivative, and those whose
            # derivative has not been checked yet. In place, since the groups of all steps in which
            # the agents have the same sensors share the list.
            remaining = [s for s in self._differenced if needs_differences(s)]
            self._differenced[:] = remaining
            if cov is not None and remaining:
                std = deviations(cov)
        if self.has_one_part:
            sensor = self.parts[0].sensor
            if self._differenced or sensor.derivative is None or self.changes:
                return sensor.jacobian(states, std=std)
            return call_derivative(
                sensor.derivative, (states,), (*self.target.shape, d)
            )
        result = np.empty((*self.target.shape, d))
        for part in self.parts:
            # H of the sensor's K agents, (*runs, K, m, d)
            rows = (..., part.agents, slice(None))
            part_std = None if std is None else std[rows]
            slope = part.sensor.jacobian(states[rows], std=part_std)
            result[(..., *part.target_index, slice(None))] = slope
        return result

    def gate(
        self, mean: Array, cov: Array, probability: float
    ) -> tuple[Received, Array]:
        """Leave out observations that their predictions cannot explain.

        Each sensor's observation is tested alone: it is rejected if its normalised innovation
        squared exceeds the chi-squared quantile of `probability`.

        Parameters
        ----------
        mean, cov : ndarray, (*runs, G, M) and (*runs, G, M, M)
            Moments of the predictions without noise.
        probability : float
            How likely a good observation passes.

        Returns
        -------
        group : Received
            With NaN in place of the rejected observations.
        rejected : ndarray, (*runs, G)
            How many observations of each agent are rejected.
        """
        from scipy.special import gammaincinv

        innovation = self.target - mean
        innovation_cov = cov + self.noise
        target = self.target
        rejected = np.zeros(innovation.shape[:-1])
        unit = np.eye(innovation.shape[-1])
        # First the first sensor of every agent, then the second ones, and so on
        for k in range(int(self.sensor_index.max()) + 1):
            present = (self.sensor_index == k) & ~np.isnan(innovation)
            size = present.sum(axis=-1)
            # Other sensors' numbers have a zero innovation and a unit covariance.
            present_pairs = present[..., :, None] & present[..., None, :]
            part_cov = np.where(present_pairs, innovation_cov, unit)
            part = np.where(present, innovation, 0.0)
            # ε = rᵀ S⁻¹ r ~ χ²(m), whose quantile is 2 P⁻¹(m / 2, probability).
            solved = np.linalg.solve(part_cov, part[..., None])[..., 0]
            distance = (part * solved).sum(axis=-1)
            limit = 2 * gammaincinv(np.maximum(size, 1) / 2, probability)
            is_outlier = (size > 0) & (distance > limit)
            target = np.where(present & is_outlier[..., None], np.nan, target)
            rejected += is_outlier
        return self.with_target(target), rejected


def predict_points(sensor: Sensor, states: Array) -> Array:
    """Predict a sensor's observations of points (..., N, d), (..., N, m).

    Angles are shifted by whole periods, so that all N are near each other.

    >>> from distfilt.sensors import bearing
    >>> points = np.array([[-1.0, 0.1], [-1.0, -0.1]])
    >>> predict_points(bearing([0, 1], std=0.1), points).ravel().round(4)
    array([3.0419, 3.2413])
    """
    return _gather_predictions(sensor, sensor.predict(states), states, None)


def _gather_predictions(
    sensor: Sensor, values: Array, states: Array, previous: Array | None
) -> Array:
    """Shift angles in a sensor's predictions by whole periods, so that all N are near each other.

    The predictions are (*runs, G, N, m), of states (*runs, G, N, d); far ones are brought near the
    prediction of the states' mean.
    """
    if values.shape[-2] == 1:
        return values
    half_periods = sensor.half_periods
    if half_periods is not None:
        # The usual case: all values lie within half a period as they are.
        low = values.min(axis=-2)
        if (values.max(axis=-2) - low < half_periods).all():
            return values
    mean = states.mean(axis=-2, keepdims=True)
    previous_mean = None
    if sensor.uses_previous and previous is not None:
        previous_mean = previous.mean(axis=-2, keepdims=True)

    # References to which far values are brought near: the tangent, if the sensor is linear but for
    # its wraps, and the prediction of the mean otherwise. Both are computed only if needed.
    def fallback() -> Array:
        return sensor.predict(mean, previous_mean)

    def tangent() -> Array | None:
        if sensor.uses_previous:
            return None
        # h(m) + H (x_i - m)
        slope = sensor.jacobian(mean[..., 0, :])
        return np.asarray(fallback() + (states - mean) @ slope.mT)

    return gather(values, sensor.bring_near, tangent, fallback)


_Pattern = tuple[tuple[int, tuple[Sensor, ...]], ...]
"""The agents that have observations, each with the sensors of these."""


@lru_cache(maxsize=1024)
def _plan_few(pattern: _Pattern) -> list[Received]:
    """Plan the groups of a few agents, of whose events many patterns recur."""
    return _plan_groups(pattern)


@lru_cache(maxsize=32)
def _plan_many(pattern: _Pattern) -> list[Received]:
    """Plan the groups of many agents, whose plans are large."""
    return _plan_groups(pattern)


def _plan_groups(pattern: _Pattern) -> list[Received]:
    """Plan a group of the agents that have equally many observed numbers, for each such number.

    The pattern has pairs of an agent and the sensors of its observations.
    """
    agents_by_size: dict[int, list[int]] = {}
    for agent, sensors in pattern:
        size = sum(sensor.dim for sensor in sensors)
        agents_by_size.setdefault(size, []).append(agent)
    sensors_by_agent = dict(pattern)
    # Groups of agents with few numbers first
    return [
        Received(agents, sensors_by_agent)
        for _size, agents in sorted(agents_by_size.items())
    ]


def group_agents(
    observations: Sequence[Sequence[tuple[Sensor, Array]]],
) -> list[Received]:
    """Group agents by how many numbers they have, from each one's sensors and values (*runs, m).

    The plan of a pattern of sensors is made when it first occurs.

    >>> group_agents([[], []])
    []
    """
    # The pattern of sensors is the key of the plan; agents without any are left out.
    pattern = tuple(
        [
            (agent, tuple([sensor for sensor, _ in pairs]))
            for agent, pairs in enumerate(observations)
            if pairs
        ]
    )
    plans = (
        _plan_few(pattern) if len(observations) <= _FEW_AGENTS else _plan_many(pattern)
    )
    groups = []
    # A plan is a group without observed values, which are filled in here.
    for plan in plans:
        values = [v for agent in plan.agents.tolist() for _, v in observations[agent]]
        # All agents' values side by side, then one row for each agent: (*runs, G, M).
        flat = values[0] if len(values) == 1 else np.concatenate(values, axis=-1)
        target = flat.reshape(*flat.shape[:-1], *plan.sensor_index.shape)
        groups.append(plan.with_target(target))
    return groups


class _Unseeded(np.random.bit_generator.ISeedSequence):
    """A seed of a bit generator whose state is set afterwards."""

    def generate_state(
        self, n_words: int, dtype: DTypeLike = np.uint32
    ) -> NDArray[np.uint32 | np.uint64]:
        return np.zeros(n_words, dtype)


_UNSEEDED = _Unseeded()


def copy_rng(rng: np.random.Generator) -> np.random.Generator:
    """Copy a generator, in a seventh of the time that a deep copy takes."""
    if type(rng) is not np.random.Generator:
        return copy.deepcopy(rng)
    old: Any = rng.bit_generator
    # A bit generator with a cheap seed, whose state is then that of the old one
    new = type(old)(_UNSEEDED)
    # The seed sequence counts its children, so that each copy needs one of its own.
    new.__setstate__((old.state, copy.copy(old.seed_seq)))
    return np.random.Generator(new)
