"""The plan of a run: the times of its steps, and the observations of each."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from ..sensors import Sensor
from ..validation import Array, check_array, check_increasing
from .observations import Observation, are_observations, list_by_agent

if TYPE_CHECKING:
    from .base import Filter
    from .states import State

    TimesArgument = ArrayLike | None
else:
    # Checked by `plan_steps`, which converts it.
    TimesArgument = Any

__all__ = ["TimesArgument", "plan_steps"]


def plan_steps(
    f: Filter[Any], state: State, times: TimesArgument, observations: Any
) -> tuple[Array, Iterator[Any]]:
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
    >>> times, [[float(o.value[0]) for o in agent] for (agent,) in entries]
    (array([0.5, 1. ]), [[3.0], [2.0, 1.0]])
    """
    # With events the grid may be empty: their own times are enough.
    grid = np.zeros(0) if times is None else check_array(times, "times", ("T",))
    check_increasing(grid, "times")
    if are_observations(observations) and (times is None or observations):
        grid, entries = _plan_events(f, grid, observations)
    elif times is None:
        raise ValueError(
            "times must be an array unless all observations are Observations, got None"
        )
    else:
        entries = _plan_series(f, grid, observations)
    if grid.size and grid[0] < state.t:
        raise ValueError(
            f"times must start at the state's time {state.t:g} or later, got {grid[0]:g}"
        )
    return grid, entries


def _plan_events(
    f: Filter[Any], grid: Array, events: Sequence[Observation]
) -> tuple[Array, Iterator[Any]]:
    """Sort events by time; there is a step at each time of the grid and of an event."""
    by_time: dict[float, list[list[Observation]]] = {}
    for t in grid:
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
    times = np.array(sorted(by_time))
    return times, iter([by_time[t] for t in times])


def _plan_series(f: Filter[Any], grid: Array, observations: Any) -> Iterator[Any]:
    """Take each agent's series (T, ...) apart into times."""
    series_by_agent: list[Any] = []
    for series in list_by_agent(observations, f.n_agents):
        if series is None or isinstance(series, list | tuple):
            series_by_agent.append(series)
        else:
            # A table with named columns would give a column where a row is asked for.
            series_by_agent.append(np.atleast_1d(series))
    # A filter of positions has a number of agents in place of sensors.
    sensors: Sequence[Sequence[Sensor]] = getattr(f, "agent_sensors", ())
    for agent, series in enumerate(series_by_agent):
        if series is not None and len(series) != grid.size:
            raise ValueError(
                f"observations must have shape ({grid.size}, ..., m) for agent {agent}, "
                f"got length {len(series)}"
            )
        if isinstance(series, np.ndarray) and sensors:
            _warn_of_degrees(sensors[agent], series, agent)
    return (
        [None if series is None else series[k] for series in series_by_agent]
        for k in range(grid.size)
    )


def _warn_of_degrees(sensors: Sequence[Sensor], series: Array, agent: int) -> None:
    """Warn of angles that are more than four turns away from their wrapped values."""
    if len(sensors) != 1 or sensors[0].residual_function is None:
        return
    sensor = sensors[0]
    if series.shape[-1:] != (sensor.dim,):
        return
    observed = np.nan_to_num(series.astype(np.float64))
    # y - r(y, 0) is the multiple of the period that wrapping takes off.
    residual = sensor.residual(observed, 0 * observed)
    turns = np.abs(observed - residual).max(initial=0.0) / (2 * np.pi)
    if turns > 4:
        warnings.warn(
            f"observations[{agent}] must be angles in rad, got some {turns:.0f} turns off: "
            "are they in degrees?",
            RuntimeWarning,
            stacklevel=4,
        )
