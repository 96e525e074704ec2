"""The plan of a run: the times of its steps, and the observations of each."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from itertools import product
from typing import TYPE_CHECKING, NamedTuple, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..sensors import Sensor
from ..sensors.base import count_turns
from ..validation import (
    Array,
    InvalidArgumentError,
    check_array,
    check_increasing,
    format_number,
)
from ..validation.clocks import warn_of_clock
from .observations import Observation, are_observations, list_by_agent
from .repetition import describe_near_copy, is_equal_value

if TYPE_CHECKING:
    from .base import Filter
    from .states import AnyState

    TimesArgument = ArrayLike | None
else:
    # Checked by `plan_steps`, which converts it.
    TimesArgument = object

__all__ = ["StepObservations", "TimesArgument", "find_degrees", "plan_steps"]


SensorLists = Sequence[Sequence[Sensor]]
"""The sensors of each agent."""
Series = Sequence[object] | NDArray[np.generic]
"""The observations of an agent, one entry for each time."""


class StepObservations(NamedTuple):
    """The observations of one time of a run, an entry for each agent.

    Attributes
    ----------
    observations : sequence
        Observations of each agent.
    are_read : bool
        Whether each agent has a list of Observations that fit its sensors, with finite values.
        Then a step need not look at them again.

    Examples
    --------
    >>> StepObservations([[Observation(1.0, 0, [2.0])], []], are_read=True).are_read
    True
    """

    observations: Sequence[object]
    are_read: bool


def plan_steps(
    f: Filter[AnyState], state: AnyState, times: TimesArgument, observations: object
) -> tuple[Array, Iterator[StepObservations]]:
    """Return the times of a run's steps, and an iterator over the observations of each.

    >>> from distfilt.filters import GaussianFilter
    >>> from distfilt.models import constant_velocity
    >>> from distfilt.sensors import component
    >>> f = GaussianFilter(
    ...     constant_velocity(sigma=1.0), [[component([0], std=1.0)] * 2]
    ... )
    >>> events = [
    ...     Observation(1.0, 0, [2.0], 1),
    ...     Observation(0.5, 0, [3.0]),
    ...     Observation(1.0, 0, [1.0]),
    ... ]
    >>> times, entries = plan_steps(f, f.start((np.zeros(4), np.eye(4))), None, events)
    >>> times, [[float(o.value[0]) for o in e.observations[0]] for e in entries]
    (array([0.5, 1. ]), [[3.0], [2.0, 1.0]])
    """
    # With events no other times are needed: each of them is a step.
    step_times = np.zeros(0) if times is None else check_array(times, "times", ("T",))
    check_increasing(step_times, "times")
    # An empty list has no entry for any agent, so it can only be a list without events.
    if are_observations(observations):
        step_times, entries = _plan_events(f, state, step_times, observations)
    elif times is None:
        raise ValueError(
            "times must be an array unless all observations are Observations, got None"
        )
    else:
        entries = _plan_series(f, state, step_times, observations)
    if step_times.size and step_times[0] < state.t:
        raise ValueError(
            f"times must start at the state's time {format_number(state.t)} or later, got "
            f"{format_number(step_times[0])}"
        )
    warn_of_clock(state.t, step_times, "times")
    return step_times, entries


def _plan_events(
    f: Filter[AnyState],
    state: AnyState,
    step_times: Array,
    events: Sequence[Observation],
) -> tuple[Array, Iterator[StepObservations]]:
    """Sort events by time; there is a step at each of the user's times and at each event's."""
    # For each time a list of each agent's events
    by_time: dict[float, list[list[Observation]]] = {}
    for t in step_times:
        by_time[t] = [[] for _ in range(f.n_agents)]
    for event in events:
        if event.agent >= f.n_agents:
            raise ValueError(
                f"observations must be of agents below {f.n_agents}, got {event.agent}"
            )
        # Times of events alone become steps too.
        if event.t not in by_time:
            by_time[event.t] = [[] for _ in range(f.n_agents)]
        by_time[event.t][event.agent].append(event)
    degrees = find_degrees(_sensors_of(f), events)
    if degrees is not None:
        # The warning names a line five frames up, near the user's call.
        warnings.warn(degrees, RuntimeWarning, stacklevel=5)
    times = sorted(by_time)
    near = _find_near_copies(state.t, times, by_time)
    if near is not None:
        warnings.warn(near, RuntimeWarning, stacklevel=5)
    # The times with an event that does not fit its sensor: it is refused or completed in its step.
    # A family that reads observations in its own way does so in each step.
    unread = {*times}
    if f.reads_by_default:
        unread = {e.t for e in _find_unfit(_sensors_of(f), _runs_of(state), events)}
    entries = [StepObservations(by_time[t], are_read=t not in unread) for t in times]
    return np.array(times), iter(entries)


_NEAR_FRACTION = 1e-3
"""Copies of an event have times that differ by less than this part of the usual step."""


def _find_near_copies(
    start: float, times: list[float], by_time: dict[float, list[list[Observation]]]
) -> str | None:
    """Return a warning of events that are the same but for rounding of their time.

    >>> events = {t: [[Observation(t, 0, [2.5])]] for t in (1.0, 1.0 + 1e-9, 2.0, 3.0)}
    >>> _find_near_copies(0.0, sorted(events), events)
    "observations must have one time to count once, got the same value of agent 0's sensor ..."
    """
    for k in _find_near_times(start, np.array(times)):
        # Each agent's events at this time and at the next
        pairs = zip(by_time[times[k]], by_time[times[k + 1]], strict=True)
        for before, after in pairs:
            for one, other in product(before, after):
                # Numbers are compared, and sensors that come with their observations
                if one.sensor is not other.sensor and one.sensor != other.sensor:
                    continue
                if is_equal_value(one.value, other.value):
                    return describe_near_copy(one.agent, one.t, other.t)
    return None


def _find_near_times(start: float, times: Array) -> list[int]:
    """Return the indices of times after which the next one follows much sooner than usual.

    >>> _find_near_times(0.0, np.array([1.0, 1.0 + 1e-9, 2.0, 3.0]))
    [0]
    """
    if len(times) < 2:
        return []
    # The lengths of the steps, from the state's time on
    gaps = np.diff(times, prepend=start)
    usual = float(np.median(gaps))
    # The first gap is that from the state to times[0]; gaps[1:] follow times[0], times[1], …
    indices: list[int] = np.flatnonzero(gaps[1:] < _NEAR_FRACTION * usual).tolist()
    return indices


def _find_unfit(
    agent_sensors: SensorLists, runs: tuple[int, ...], events: Sequence[Observation]
) -> list[Observation]:
    """Return the events that are not complete observations by one of their agent's sensors."""
    unfit: list[Observation] = []
    fitting: dict[int, list[Observation]] = {}
    for event in events:
        number = event.sensor
        sensors = agent_sensors[event.agent]
        expected: tuple[int, ...] | None = None
        # One that arrives later fits no step of a plan, so that no shape is expected of it.
        is_punctual = event.arrival_time is None
        if is_punctual and isinstance(number, int) and number < len(sensors):
            expected = (*runs, sensors[number].dim)
        if event.value.shape != expected:
            unfit.append(event)
        else:
            fitting.setdefault(event.value.size, []).append(event)
    for same_size in fitting.values():
        # All values of one size at once, a row for each event
        values = np.array([event.value.ravel() for event in same_size])
        is_finite = np.isfinite(values).all(axis=1).tolist()
        pairs = zip(same_size, is_finite, strict=True)
        unfit += [event for event, is_good in pairs if not is_good]
    return unfit


def _runs_of(state: AnyState) -> tuple[int, ...]:
    """Return the runs of a state; of agents with sensors those that may fail one by one."""
    failed = getattr(state, "failed", None)
    return state.runs if failed is None else failed.shape


def _plan_series(
    f: Filter[AnyState], state: AnyState, step_times: Array, observations: object
) -> Iterator[StepObservations]:
    """Take each agent's series (T, ...) apart into times."""
    series_by_agent: list[Series | None] = []
    _refuse_ambiguous(observations, f.n_agents, step_times.size)
    for series in list_by_agent(observations, f.n_agents):
        if series is None or isinstance(series, list | tuple):
            series_by_agent.append(series)
        elif isinstance(series, np.ma.MaskedArray):
            # As an array it would lose its mask.
            raise InvalidArgumentError(
                f"observations must be an array of real numbers for agent "
                f"{len(series_by_agent)}, got MaskedArray: give y.filled(np.nan), a missing "
                "number is NaN"
            )
        else:
            # A table with named columns would give a column where a row is asked for.
            series_by_agent.append(np.atleast_1d(np.asarray(series)))
    sensors = _sensors_of(f)
    for agent, series in enumerate(series_by_agent):
        if series is not None and len(series) != step_times.size:
            raise ValueError(
                f"observations must have shape ({step_times.size}, ..., m) for agent {agent}, "
                f"got length {len(series)}"
            )
        if isinstance(series, np.ndarray) and sensors:
            _check_series(sensors[agent], series, agent)
        if series is not None and sensors:
            _warn_of_degrees(sensors, series, agent)
    near = _find_near_rows(
        _find_near_times(state.t, step_times), step_times, series_by_agent
    )
    if near is not None:
        warnings.warn(near, RuntimeWarning, stacklevel=5)
    shapes: list[tuple[int, ...] | None] = []
    if f.reads_by_default:
        lead = (step_times.size, *_runs_of(state))
        # Each agent's array of values, if it has one sensor
        shapes = [(*lead, s[0].dim) if len(s) == 1 else None for s in sensors]
    return _list_rows(step_times, series_by_agent, shapes)


def _find_near_rows(
    indices: list[int], step_times: Array, series_by_agent: list[Series | None]
) -> str | None:
    """Return a warning of rows that are the same as the next but for rounding of their time.

    `indices` are those of times that the next one follows much sooner than usual.
    """
    for agent, series in enumerate(series_by_agent):
        # A list of Observations is left to the single steps, which compare sensors too.
        if not isinstance(series, np.ndarray) or series.dtype.kind != "f":
            continue
        for k in indices:
            is_seen = not np.isnan(series[k]).all()
            if is_seen and is_equal_value(series[k], series[k + 1]):
                return describe_near_copy(agent, step_times[k], step_times[k + 1])
    return None


def _refuse_ambiguous(observations: object, n_agents: int, n_times: int) -> None:
    """Refuse an array whose first two axes may be agents and times, or times and agents."""
    shape = getattr(observations, "shape", ())
    if (
        n_agents > 1
        and len(shape) > 2
        # The first two axes, and the same in reverse order
        and shape[:2] == (n_agents, n_times) == shape[1::-1]
    ):
        raise ValueError(
            f"observations must be a list of the agents' series where there are as many times as "
            f"agents, {n_times}, got an array of shape {shape}: give list(y), agents first"
        )


def _list_rows(
    step_times: Array,
    series_by_agent: list[Series | None],
    shapes: list[tuple[int, ...] | None],
) -> Iterator[StepObservations]:
    """Yield the observations of all agents, taken from their series, time by time.

    Where every series is a float array of the expected shape, (T, *runs, m), the times at which all
    numbers are finite need no further check: their rows become Observations here. The others are
    checked in their step.

    Parameters
    ----------
    step_times : ndarray, (T,)
    series_by_agent : list of (sequence or None)
        Each agent's observations, with one entry for each time.
    shapes : list of (tuple or None)
        The shape expected of each agent's series; None for an agent that has not one sensor. Empty
        if the family reads observations in its own way.
    """
    # Whether the observations of a time are read, if the series fit
    is_read = np.ones(step_times.size, dtype=bool)
    fits = bool(shapes)
    for series, shape in zip(series_by_agent, shapes, strict=bool(shapes)):
        if series is None:
            continue
        fits = fits and isinstance(series, np.ndarray) and series.shape == shape
        if not fits or cast(Array, series).dtype != np.float64:
            fits = False
            break
        # Whether all numbers of a time are finite; the axes are named, as there may be no time
        finite = np.isfinite(np.asarray(series))
        is_read &= finite.all(axis=tuple(range(1, finite.ndim)))
    for k, t in enumerate(step_times.tolist()):
        rows = [None if series is None else series[k] for series in series_by_agent]
        if not fits or not is_read[k]:
            yield StepObservations(rows, are_read=False)
            continue
        # One Observation of each agent's only sensor
        read = [
            [] if row is None else [Observation.construct(t, agent, row)]
            for agent, row in enumerate(rows)
        ]
        yield StepObservations(read, are_read=True)


def _sensors_of(f: Filter[AnyState]) -> SensorLists:
    """Return the agents' sensors; a filter of positions has a number of agents in their place."""
    sensors: SensorLists = getattr(f, "agent_sensors", ())
    return sensors


def _check_series(sensors: Sequence[Sensor], series: Array, agent: int) -> None:
    """Refuse a series of numbers without an axis for the components, (T,) for (T, 1)."""
    # Kinds of numpy's types: float, int, unsigned int; not objects, such as Observations
    if series.ndim == 1 and series.dtype.kind in "fiu" and len(sensors) == 1:
        size = series.size
        raise ValueError(
            f"observations must have shape ({size}, ..., {sensors[0].dim}) for agent {agent}, "
            f"got ({size},): a series of single numbers has one component, give y[:, None]"
        )


def _warn_of_degrees(agent_sensors: SensorLists, series: Series, agent: int) -> None:
    """Warn if a series of arrays, or of Observations, has angles in degrees."""
    sensors = agent_sensors[agent]
    entries: list[Observation] = []
    if isinstance(series, np.ndarray) and series.dtype.kind in "fiu":
        # All values of the only sensor at once.
        if len(sensors) == 1 and series.shape[-1:] == (sensors[0].dim,):
            values = series.reshape(-1, sensors[0].dim)
            entries = [Observation.construct(t=0.0, agent=agent, value=values)]
    elif any(sensor.wraps for sensor in sensors):
        entries = _list_entries(sensors, series, agent)
    text = find_degrees(agent_sensors, entries)
    if text is not None:
        # The warning names a line five frames up, near the user's call.
        warnings.warn(text, RuntimeWarning, stacklevel=5)


def _list_entries(
    sensors: Sequence[Sensor], series: Series, agent: int
) -> list[Observation]:
    """Return the entries of a list of times as Observations; what fits no sensor is left out.

    They serve to look for degrees only, so that their time is of no importance.
    """
    result: list[Observation] = []
    for entry in series:
        for one in entry if are_observations(entry) else (entry,):
            if isinstance(one, Observation):
                result.append(one)
            # An array of floats or integers by the only sensor
            elif one is not None and len(sensors) == 1:
                value = np.asarray(one)
                if value.dtype.kind in "fiu" and value.shape[-1:] == (sensors[0].dim,):
                    result.append(
                        Observation.construct(t=0.0, agent=agent, value=value)
                    )
    return result


def find_degrees(
    agent_sensors: SensorLists, observations: Sequence[Observation]
) -> str | None:
    """Return a warning if angles are more than four turns away from their wrapped values.

    Observations are looked at together for each agent and sensor.

    >>> from distfilt.filters import GaussianFilter
    >>> from distfilt.models import constant_velocity
    >>> from distfilt.sensors import bearing
    >>> f = GaussianFilter(constant_velocity(sigma=1.0), [bearing([0, 1], std=0.1)])
    >>> find_degrees(f.agent_sensors, [Observation(0.0, 0, [53.13])])
    "observations[0] must be angles in rad, got some 8 turns off by a sensor of kind ..."
    >>> find_degrees(f.agent_sensors, [Observation(0.0, 0, [-3.1])])
    """
    values: dict[tuple[int, Sensor], list[Array]] = {}
    for observation in observations:
        if observation.agent >= len(agent_sensors):
            continue  # refused later, by its name
        sensor = observation.sensor
        if not isinstance(sensor, Sensor):
            sensors = agent_sensors[observation.agent]
            if sensor >= len(sensors):
                continue
            sensor = sensors[sensor]
        if not sensor.wraps:
            continue
        value = observation.value
        if value.shape[-1:] == (sensor.dim,):
            values.setdefault((observation.agent, sensor), []).append(value)
    for (agent, sensor), parts in values.items():
        observed = np.concatenate([v.reshape(-1, sensor.dim) for v in parts])
        observed = np.nan_to_num(observed)
        # Angles of less than four turns, 8π = 25 rad, need no closer look.
        large = observed[(np.abs(observed) > 25).any(axis=-1)]
        turns = count_turns(sensor, large) if large.size else 0.0
        if turns > 4:
            return (
                f"observations[{agent}] must be angles in rad, got some {turns:.0f} turns off "
                f"by a sensor of kind {sensor.kind!r}: are they in degrees?"
            )
    return None
