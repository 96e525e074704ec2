"""One step of a filter: its inputs, the observations of each group of agents, and the new state.

A family's ``next_state`` gets a :class:`Step`. Agents that have equally many numbers are put into
one :class:`Received`, so that one batched update serves all of them.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from functools import lru_cache
from typing import TYPE_CHECKING, Any, Generic, NamedTuple, TypeVar, cast

import numpy as np

from ..sensors import Sensor
from ..validation import Array, Mask, call_user
from ..validation.first_use import needs_check
from . import failures
from .exchange import Known, collect_observations, fuse_beliefs
from .failures import RECOVERABLE, FilterError, Row
from .observations import Observation
from .states import SensorState, State

if TYPE_CHECKING:
    from .base import Filter, SensorFilter

__all__ = ["Received", "Step", "copy_rng", "group_agents"]

S = TypeVar("S", bound=State)

_NO_RUNS = np.zeros((), dtype=bool)
_NOTHING = np.zeros((0, 0))


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
        self.filter = cast("SensorFilter[Any]", filter_)
        # A family's next_state knows the fields of its own state.
        self.state: Any = state
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
        self.any_failed = bool(np.count_nonzero(self.failed))
        # Whether there is a fusion rule, and a channel to use it.
        self.has_fusion = filter_.fusion is not None and self.channel is not None
        self.pending: tuple[Observation, ...] = ()
        # Counted only with a gate.
        self.rejected: Array | None = None
        if filter_.gate_probability is not None:
            self.rejected = np.zeros((*self.runs, filter_.n_agents))

    # The beliefs -----------------------------------------------------------------------

    def check_forecast(self, values: Array, old: Array | float) -> Array:
        """Return a finite forecast (*runs, A, ...), and `old` in failed runs."""
        if not np.isfinite(values).all():
            # One row for each run and agent.
            lead = len(self.runs) + 1
            errors = failures.find_nonfinite_rows(values, lead, "forecast")
            self.record_failures(errors, range(self.filter.n_agents))
        # Groups of agents are updated in place, which must not change the state.
        belief = getattr(self.state, self.state.belief_field[0])
        if np.may_share_memory(values, belief):
            values = values.copy()
        return self.keep_failed(values, old) if self.any_failed else values

    def stack(self, forecast: Array) -> list[Array]:
        """Return copies of the beliefs about the earlier times, then the present forecast."""
        if not self.times:
            return [forecast]
        # The beliefs before the step: about the earlier times, and about the state's own time,
        # which is one of the earlier ones after a forecast.
        before = [belief for _, belief in self.state.history]
        if self.dt > 0:
            before.append(self.state.belief)
        # With a full lag the oldest time is dropped.
        oldest = len(before) - len(self.times)
        return [belief.copy() for belief in before[oldest:]] + [forecast]

    def keep_failed(self, values: Array, old: Array | float) -> Array:
        """Return the values, but `old` in failed runs."""
        if not self.any_failed:
            return values
        # The flags (*runs) get axes of size 1 behind, to broadcast against the values.
        trailing = (1,) * (values.ndim - self.failed.ndim)
        failed = self.failed.reshape(*self.runs, *trailing)
        return np.asarray(np.where(failed, old, values))

    # The observations ------------------------------------------------------------------

    def received(self) -> Iterator[tuple[int, Received]]:
        """Yield the groups of agents with their observations, oldest time first.

        Each comes with its place among the times, of which the last is now. The target is NaN in
        failed runs, so that they are left alone.
        """
        by_time = self._known_observations()
        for place, t in enumerate((*self.times, self.t)):
            if t not in by_time:
                continue
            # Agents with equally many numbers are one group.
            for group in group_agents(by_time[t]):
                if self.any_failed:
                    group = group.with_target(self.keep_failed(group.target, np.nan))
                yield place, group

    def _known_observations(self) -> Known:
        """Return by time, and then by agent, the sensors and values that each agent has."""
        f = self.filter
        if self.delayed or (f.graph is not None and f.share_observations):
            return collect_observations(cast(Step[Any], self))
        # Nothing is exchanged here. A subclass may have put other agents' observations
        # into an agent's list, so a sensor is looked up at the agent that observed.
        pairs = []
        for observations in self.observations:
            of_agent = []
            for o in observations:
                sensor = o.sensor
                if isinstance(sensor, int):
                    sensor = f.agent_sensors[o.agent][sensor]
                of_agent.append((sensor, o.value))
            pairs.append(of_agent)
        return {self.t: pairs}

    def before(self, place: int, group: Received, past: list[Array]) -> Array | None:
        """Return a group's members at the time before now, if a sensor measures changes.

        They are the last of the `past`, or those with which the step begins, if it has a length.
        """
        is_present = place == len(self.times)
        if not group.changes or not is_present or not (past or self.dt):
            return None
        members: Array = past[-1] if past else self.state.belief
        return members[..., group.rows, :, :]

    def gate(
        self,
        group: Received,
        moments: Callable[..., tuple[Array, Array]],
        predicted: Array,
        *args: Array,
    ) -> Received:
        """Return a group without the observations that the gate rejects, and count these.

        ``moments(predicted, *args)`` gives mean (*runs, G, M) and covariance (*runs, G, M, M) of
        the predictions (*runs, G, N, M), without the observations' noise.
        """
        if self.rejected is None:
            return group
        # About one prediction: opposite to a wild angle the branch cut would divide them.
        aligned = group.wrap_near(predicted.copy(), predicted[..., :1, :])
        mean, cov = moments(aligned, *args)
        # A filter with a gate has a probability.
        probability = cast(float, self.filter.gate_probability)
        group, rejected = group.gate(mean, cov, probability)
        self.rejected[..., group.agents] += rejected
        return group

    # Failures --------------------------------------------------------------------------

    def apply(
        self,
        compute: failures.Compute,
        arrays: tuple[Array, ...],
        fallback: tuple[Array, ...],
        agents: Any = None,
        *,
        shared: Array = _NOTHING,
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
        lead = len(self.runs) + (agents is not None)
        # The state of the generator, to draw the same numbers in a second attempt.
        is_batch = math.prod(arrays[0].shape[:lead]) > 1
        rng_state: Any = None
        if rng is not None and is_batch:
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
            if not np.isfinite(values).all():
                errors |= failures.find_nonfinite_rows(values, lead, "result")
        if errors:
            # Failed rows keep their values from before the computation.
            results = tuple([values.copy() for values in results])
            for row in errors:
                for values, old in zip(results, fallback, strict=True):
                    values[row] = old[row]
            self.record_failures(errors, agents)
        return results

    def record_failures(self, errors: dict[Row, str], agents: Any = None) -> None:
        """Mark the runs of these errors as failed, or raise the first error.

        The keys are runs, and with `agents` end with a place among these.
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
        if not self.has_fusion or self.failed.all():
            return values
        return fuse_beliefs(self, values)

    # The new state ---------------------------------------------------------------------

    def end(self, *, past: Iterable[Array] = (), **belief: Any) -> S:
        """Return the state after the step.

        Parameters
        ----------
        past : iterable of ndarray
            The beliefs about the earlier times.
        **belief
            The fields of the family's own.
        """
        state = self.state
        if isinstance(state, SensorState):
            # A family may keep its past in its own form; otherwise it is (time, belief) pairs.
            if "history" not in belief:
                belief["history"] = tuple(zip(self.times, past, strict=True))
            belief["failed"] = self.failed
            belief["pending"] = self.pending
        # The messages in the step are in the channel's ledger.
        ledger = state.ledger if self.channel is None else self.channel.ledger
        new: S = type(state).construct(
            self.t, ledger, self.rng, rejected=self.rejected, **belief
        )
        return new


class _Part(NamedTuple):
    """One sensor of a group: which agents have it, and where its numbers stand."""

    sensor: Sensor
    agents: Any
    """Places of these agents in the group, or a slice if all have it."""
    cells: tuple[Any, Any]
    """Index of the sensor's numbers in arrays (G, M)."""


class Received:
    """Observations of G agents that have equally many numbers M, for one batched update.

    Attributes
    ----------
    agents : ndarray of int, (G,)
        Their numbers.
    rows : slice or ndarray
        The same as an index of an array of all agents; a slice if the group is all of them.
    target : ndarray, (*runs, G, M)
        The observed values, NaN where a component is missing.
    noise : ndarray, (M, M) or (G, M, M)
        Covariance of their noise, one for all agents if it is the same.
    linear, changes : bool
        Whether all sensors are linear; whether one of them measures a change.

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
        self, agents: list[int], sensors: Sequence[tuple[Sensor, ...]]
    ) -> None:
        self.agents = np.array(agents, dtype=np.intp)
        # A slice gives views, where a list of numbers copies.
        is_everybody = agents == list(range(len(sensors)))
        self.rows: Any = slice(None) if is_everybody else self.agents
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
        self.noise = self._assemble_noise(starts)
        self.linear = all(sensor.linear is not None for sensor in starts)
        self.changes = any(sensor.uses_previous for sensor in starts)
        self.wraps = any(sensor.residual_function is not None for sensor in starts)
        self._matrices: dict[int, Array] = {}
        self._checked: set[Sensor] = set()

    def _make_part(self, sensor: Sensor, starts: list[tuple[int, int]]) -> _Part:
        places, first = np.array(starts, dtype=np.intp).T
        columns = first[:, None] + np.arange(sensor.dim)
        if columns.shape == self.sensor_index.shape:
            # The only sensor of the group: slices give views instead of copies.
            return _Part(sensor, slice(None), (slice(None), slice(None)))
        return _Part(sensor, places, (places[:, None], columns))

    def _assemble_noise(self, starts: dict[Sensor, list[tuple[int, int]]]) -> Array:
        """Put the sensors' covariances on the diagonal, (G, M, M), or (M, M) if all agree."""
        n, size = self.sensor_index.shape
        noise = np.zeros((n, size, size))
        for sensor, places in starts.items():
            for g, start in places:
                block = slice(start, start + sensor.dim)
                noise[g, block, block] = sensor.noise_cov
        return noise[0] if (noise == noise[:1]).all() else noise

    def H(self, dim: int) -> Array:
        """Return the matrices of linear sensors one below the other, (G, M, d), made once."""
        if dim not in self._matrices:
            matrix = np.zeros((*self.sensor_index.shape, dim))
            for part in self.parts:
                matrix[part.cells] = part.sensor.H(dim)
            self._matrices[dim] = matrix
        return self._matrices[dim]

    def with_target(self, target: Array) -> Received:
        """Return the same group with these observed values."""
        # The plan is shared: only the values differ from step to step.
        result = object.__new__(Received)
        vars(result).update(vars(self), target=target)
        return result

    def predict(
        self, states: Array, previous: Array | None = None, same_branch: bool = False
    ) -> Array:
        """Predict the observations of states (*runs, G, N, d) without noise, (*runs, G, N, M).

        Angles lie on the branch of the observed value; with `same_branch` the first state's do,
        and those of the other states lie on its branch. `previous` holds the states at the
        observation time before, for sensors that measure changes.
        """
        if self.linear:
            # y = x Hᵀ; a contiguous copy multiplies faster than a transposed view.
            return np.asarray(
                states @ np.ascontiguousarray(self.H(states.shape[-1]).mT)
            )
        n_states = states.shape[-2]
        # Numbers before states, so that the cells of a sensor are one index.
        result = np.empty((*states.shape[:-2], self.target.shape[-1], n_states))
        for part in self.parts:
            # Only sensors that measure a change need the previous states.
            before = None if previous is None else previous[..., part.agents, :, :]
            values = self._predict_part(part, states[..., part.agents, :, :], before)
            result[(..., *part.cells, slice(None))] = values.swapaxes(-1, -2)
        result = np.ascontiguousarray(result.swapaxes(-1, -2))
        if np.isinf(result).any():
            raise ValueError(
                "predicted must have finite numbers or NaN (missing), got infinity"
            )
        if not self.wraps:
            return result
        result = self.wrap_near(result, self.target[..., None, :])
        return self.wrap_near(result, result[..., :1, :]) if same_branch else result

    def _predict_part(
        self, part: _Part, states: Array, previous: Array | None
    ) -> Array:
        """Predict with one sensor; its function is called directly once it has been checked."""
        sensor = part.sensor
        if sensor in self._checked:
            # A copy, since the user's function may work in place.
            values = np.asarray(call_user(sensor.h, states.copy()), dtype=np.float64)
            if values.shape == (*states.shape[:-1], sensor.dim):
                return values
        values = sensor.predict(states, previous)
        if not sensor.uses_previous and not needs_check(sensor, "h"):
            self._checked.add(sensor)
        return values

    def wrap_near(self, predicted: Array, reference: Array) -> Array:
        """Bring predictions (*runs, G, N, M) onto the branch of a reference, in place."""
        if not self.wraps:
            return predicted
        values = predicted.swapaxes(-1, -2)
        # The reference for every state, NaN where the prediction is.
        full = (reference + 0 * predicted).swapaxes(-1, -2)
        for part in self.parts:
            # A difference that does not wrap has one branch.
            if part.sensor.residual_function is None:
                continue
            index = (..., *part.cells, slice(None))
            ours = values[index].swapaxes(-1, -2)
            aim = full[index].swapaxes(-1, -2)
            # y* - r(y*, h) is h on the branch of y*, where r wraps the difference.
            residual = part.sensor.residual(aim, ours)
            wrapped = np.where(np.isnan(residual), ours, aim - residual)
            values[index] = wrapped.swapaxes(-1, -2)
        return predicted

    def jacobian(self, states: Array, std: Array | None = None) -> Array:
        """Return the derivatives of the observations at states (*runs, G, d), (*runs, G, M, d).

        `std` holds the standard deviations of the states' components, (*runs, G, d).
        """
        d = states.shape[-1]
        if self.linear:
            return np.full((*self.target.shape, d), self.H(d))
        result = np.empty((*self.target.shape, d))
        for part in self.parts:
            # H of the sensor's agents, (*runs, agents, m, d)
            rows = (..., part.agents, slice(None))
            part_std = None if std is None else std[rows]
            slope = part.sensor.jacobian(states[rows], std=part_std)
            result[(..., *part.cells, slice(None))] = slope
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


@lru_cache(maxsize=32)
def _plan_groups(pattern: tuple[tuple[Sensor, ...], ...]) -> list[Received]:
    """Plan a group for each number of values that occurs; agents without any are left out."""
    agents_by_size: dict[int, list[int]] = {}
    for agent, sensors in enumerate(pattern):
        if sensors:
            size = sum(sensor.dim for sensor in sensors)
            agents_by_size.setdefault(size, []).append(agent)
    return [Received(agents, pattern) for _, agents in sorted(agents_by_size.items())]


def group_agents(
    observations: Sequence[Sequence[tuple[Sensor, Array]]],
) -> list[Received]:
    """Group agents by how many numbers they have, from each one's sensors and values (*runs, m).

    The plan of a pattern of sensors is made when it first occurs.

    >>> group_agents([[], []])
    []
    """
    # The pattern of sensors is the key of the plan.
    pattern = tuple([tuple([s for s, _ in pairs]) for pairs in observations])
    groups = []
    for plan in _plan_groups(pattern):
        values = [v for agent in plan.agents.tolist() for _, v in observations[agent]]
        # All agents' values side by side, then one row for each agent: (*runs, G, M).
        flat = values[0] if len(values) == 1 else np.concatenate(values, axis=-1)
        target = flat.reshape(*flat.shape[:-1], *plan.sensor_index.shape)
        groups.append(plan.with_target(target))
    return groups


class _Unseeded(np.random.bit_generator.ISeedSequence):
    """A seed of a bit generator whose state is set afterwards."""

    def generate_state(self, n_words: int, dtype: Any = np.uint32) -> Any:
        return np.zeros(n_words, dtype)


_UNSEEDED = _Unseeded()


def copy_rng(rng: np.random.Generator) -> np.random.Generator:
    """Copy a generator, in a seventh of the time that a deep copy takes."""
    if type(rng) is not np.random.Generator:
        return copy.deepcopy(rng)
    old: Any = rng.bit_generator
    new = type(old)(_UNSEEDED)
    # The seed sequence counts its children, so that each copy needs one of its own.
    new.__setstate__((old.state, copy.copy(old.seed_seq)))
    return np.random.Generator(new)
