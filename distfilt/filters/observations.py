"""Observations: one of them, those of one time, and delayed ones."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Annotated, TypeGuard

import numpy as np
from numpy.typing import NDArray

from ..sensors import Sensor
from ..validation import (
    ALLOW_NAN,
    ArrayInput,
    FrozenModel,
    InvalidArgumentError,
    NonNegativeInt,
    check_array,
    format_number,
)

if TYPE_CHECKING:
    from .base import SensorFilter
    from .states import AnyState, State

__all__ = [
    "Observation",
    "list_by_agent",
    "match_delayed",
    "read_observations",
    "sensor_of",
]


@dataclass(frozen=True, eq=False)
class Observation(FrozenModel):
    """An observation of one sensor of one agent at one time.

    Parameters
    ----------
    t : float
        The time of the observation, in s.
    agent : int
        The agent's number.
    value : array_like, (*runs, m) or (m,)
        NaN marks a missing component.
    sensor : int or Sensor
        The number of the agent's sensor; or a sensor for this observation alone, such as one on
        a moving platform.
    metadata : sequence of float
        Numbers that a neighbour needs to know the sensor, such as the platform's pose: they are
        sent with the observation and charged.
    arrival_time : float, optional
        When it becomes known, in s, if that is later: for the `delayed` of :meth:`Filter.run`.

    Examples
    --------
    >>> Observation(2.0, 0, [1.5]).sensor
    0
    """

    t: float
    agent: NonNegativeInt
    value: Annotated[ArrayInput, "... m", ALLOW_NAN]
    sensor: NonNegativeInt | Sensor = 0
    _: KW_ONLY
    metadata: tuple[float, ...] = ()
    arrival_time: float | None = None


def sensor_of(f: SensorFilter[AnyState], observation: Observation) -> Sensor:
    """Return the sensor of an observation: its own, or one of the agent's."""
    if isinstance(observation.sensor, Sensor):
        # The filter's own sensors have been checked before: a likelihood may not be supported.
        f.check_likelihood(observation.sensor)
        if observation.sensor.uses_previous:
            raise ValueError(
                "observations must name one of the agent's sensors to measure a change, got "
                f"a {observation.sensor.kind} sensor of their own, whose last observation is "
                "not known"
            )
        return observation.sensor
    sensors = f.agent_sensors[observation.agent]
    if observation.sensor >= len(sensors):
        raise ValueError(
            f"observations must be of one of the {len(sensors)} sensors of agent "
            f"{observation.agent}, got sensor {observation.sensor}"
        )
    return sensors[observation.sensor]


def read_observations(
    f: SensorFilter[AnyState], observations: object, runs: tuple[int, ...], t: float
) -> list[list[Observation]]:
    """Check the observations of one time, and return a list of them for each agent.

    >>> from distfilt.filters import GaussianFilter
    >>> from distfilt.models import constant_velocity
    >>> from distfilt.sensors import component
    >>> f = GaussianFilter(constant_velocity(sigma=0.1), [component([0], std=1.0)])
    >>> [[o.value for o in agent] for agent in read_observations(f, [[1.5]], (), 0.0)]
    [[array([1.5])]]
    """
    # Observations of any agents; an empty list is a time without any.
    if are_observations(observations):
        observations = _sort_by_agent(observations, f.n_agents)
    result: list[list[Observation]] = []
    for agent, entry in enumerate(list_by_agent(observations, f.n_agents)):
        name = f"observations[{agent}]"
        # None, one value, one Observation, or a list of Observations.
        if entry is None:
            entries: Sequence[object] = ()
        else:
            entries = entry if are_observations(entry) else (entry,)
        checked = []
        for one in entries:
            observation = _check_entry(f, one, agent, t, name)
            complete = _complete(f, observation, runs, name)
            if complete is not None:
                checked.append(complete)
        result.append(checked)
    return result


def _sort_by_agent(
    observations: Sequence[Observation], n_agents: int
) -> list[list[Observation]]:
    """Return Observations in any order as a list for each agent."""
    result: list[list[Observation]] = [[] for _ in range(n_agents)]
    for observation in observations:
        if observation.agent >= n_agents:
            raise ValueError(
                f"observations must be of agents below {n_agents}, got {observation.agent}"
            )
        result[observation.agent].append(observation)
    return result


def list_by_agent(
    observations: object, n_agents: int
) -> Sequence[object] | NDArray[np.generic]:
    """Return observations as a list or an array with one entry for each agent.

    >>> list_by_agent([1.0, 2.0], 3)
    Traceback (most recent call last):
    ValueError: observations must be a list with an entry for each of 3 agents, got 2 entries
    """
    # A table of pandas has this method.
    to_numpy = getattr(observations, "to_numpy", None)
    if to_numpy is not None:
        observations = to_numpy()
    if not isinstance(observations, Sequence | np.ndarray):
        raise InvalidArgumentError(
            f"observations must be a list with an entry for each of {n_agents} agents, "
            f"got {type(observations).__name__}"
        )
    if len(observations) != n_agents:
        raise ValueError(
            f"observations must be a list with an entry for each of {n_agents} agents, "
            f"got {len(observations)} entries"
        )
    return observations


def are_observations(entries: object) -> TypeGuard[Sequence[Observation]]:
    """Whether the entries of a list are Observations, and nothing else."""
    if not isinstance(entries, list | tuple):
        return False
    return all(isinstance(entry, Observation) for entry in entries)


def _check_entry(
    f: SensorFilter[AnyState], entry: object, agent: int, t: float, name: str
) -> Observation:
    """Return an Observation of this agent and time, or make one of its only sensor's value."""
    # A value without a time, an agent and a sensor can only be of the agent's only sensor.
    if not isinstance(entry, Observation):
        sensors = f.agent_sensors[agent]
        if len(sensors) != 1:
            expected = "None for an agent without a sensor"
            if sensors:
                expected = "an Observation of each sensor"
            raise ValueError(f"{name} must be {expected}, got an array")
        value = check_array(entry, name, (..., sensors[0].dim), finite=False)
        return Observation.construct(t, agent, value)
    if (entry.agent, entry.t) != (agent, t):
        raise ValueError(
            f"{name} must be an Observation of agent {agent} at t = {format_number(t)}, got "
            f"one of agent {entry.agent} at t = {format_number(entry.t)}"
        )
    if entry.arrival_time is not None and entry.arrival_time > t:
        raise ValueError(
            f"{name} must have arrived by t = {format_number(t)}, got an Observation that "
            f"arrives at {format_number(entry.arrival_time)}: pass it as delayed"
        )
    return entry


def _complete(
    f: SensorFilter[AnyState],
    observation: Observation,
    runs: tuple[int, ...],
    name: str,
) -> Observation | None:
    """Return an observation with a value for each run, or None if all of it is missing."""
    value = observation.value
    dim = sensor_of(f, observation).dim
    if np.isinf(value).any():
        raise ValueError(f"{name} must be finite numbers or NaN, got infinity")
    # Nothing was observed.
    if np.isnan(value).all():
        return None
    if value.shape == (*runs, dim):
        return observation
    # One value for all runs is allowed.
    if value.shape != (dim,):
        raise ValueError(f"{name} must have shape {(*runs, dim)}, got {value.shape}")
    return observation.replace(value=np.broadcast_to(value, (*runs, dim)))


def match_delayed(
    f: SensorFilter[AnyState], delayed: Sequence[Observation], state: State, t: float
) -> list[Observation]:
    """Match delayed observations to the stored time that each belongs to.

    A sum of steps may differ by rounding, but by far less than the shortest of them.
    """
    # The earlier times that the step keeps, and the shortest distance of two of them
    times = state.lagged_times(f.lag, t)
    shortest = min((b - a for a, b in pairwise((*times, t))), default=0.0)
    matched = []
    for observation in delayed:
        t_obs = observation.t
        nearest = min(times, key=lambda time: abs(time - t_obs), default=np.inf)
        # A billionth of the time is far more than rounding; a thousandth of the shortest step keeps
        # two times apart.
        tolerance = min(1e-9 * max(1.0, abs(t_obs)), 1e-3 * shortest)
        if abs(nearest - t_obs) > tolerance:
            stored = ", ".join(map(format_number, times)) or "none with lag = 0"
            raise ValueError(
                f"delayed must be of an earlier time that is kept ({stored}), got "
                f"{format_number(t_obs)}"
            )
        if observation.agent >= f.n_agents:
            raise ValueError(
                f"delayed must be of agents below {f.n_agents}, got {observation.agent}"
            )
        sensor = sensor_of(f, observation)
        if sensor.uses_previous:
            raise ValueError(
                f"delayed must not be of a sensor that compares two times, got a "
                f"{sensor.kind} sensor"
            )
        complete = _complete(f, observation, state.runs, "delayed")
        # NaN alone is no observation.
        if complete is not None:
            matched.append(complete.replace(t=nearest))
    return matched
