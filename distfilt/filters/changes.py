"""Sensors of changes: the earlier time with which each of them compares the present state.

A sensor of changes compares the present state with that at its own last observation, whatever
other sensors have observed in between. A state keeps these times, and the beliefs about those of
them that its lag does not keep. They are conditioned on all later observations, as the past of a
lag is.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ..sensors import Sensor
from ..validation import Array, Mask, format_number
from .observations import Observation

if TYPE_CHECKING:
    from .states import SensorState
    from .step import Received

__all__ = ["Previous", "References", "Source"]

Source = tuple[int, int]
"""An agent, and the number of its sensor."""

Times = float | Array
"""One time for all runs and components, or one for each, (*runs, m)."""


class Previous(NamedTuple):
    """Earlier states, and the numbers of the observations that are compared with them."""

    members: Array
    """The states, (*runs, G, N, d)."""
    is_compared: Mask
    """Which numbers of a group, (G, M) or (*runs, G, M)."""


class References:
    """The times with which sensors of changes compare in one step.

    Attributes
    ----------
    last, after : dict of Source to (float or ndarray)
        The time of each sensor's last observation before the step, and after it: one for all
        runs and components, or (*runs, m).
    times : tuple of float
        The earlier times whose beliefs the step has to keep, besides those of the lag.
    sources : dict of int to list
        The sources of the present observations that each agent has, with their sizes, in order.

    Examples
    --------
    >>> from distfilt.filters import EnsembleFilter
    >>> from distfilt.models import constant_velocity
    >>> from distfilt.sensors import component, increment
    >>> walk = constant_velocity(sigma=0.1, axes=1)
    >>> sensors = [increment([0], std=0.1), component([0], std=1.0)]
    >>> f = EnsembleFilter(walk, [sensors], members=5)
    >>> state = f.start(([0.0, 1.0], np.eye(2)), rng=np.random.default_rng(0))
    >>> state = f.step(state, 1.0, [Observation(1.0, 0, [1.0], 1)])
    >>> References(state, 2.0, [[Observation(2.0, 0, [2.0])]], {(0, 0)}).last
    {(0, 0): 0.0}
    """

    def __init__(
        self,
        state: SensorState,
        t: float,
        observations: Iterable[Sequence[Observation]],
        sources: Iterable[Source],
    ) -> None:
        self.t = t
        # Before its first observation a sensor compares with the start.
        self.last: dict[Source, Times] = dict.fromkeys(sources, state.t)
        for agent, number, times in state.last_changes:
            self.last[agent, number] = times
        self.after = self.last.copy()
        for of_agent in observations:
            for observation in of_agent:
                self._add(observation)
        # The earlier times that sensors compare with after the step, and those in this step too
        self.kept = _list_times(self.after.values()) - {t}
        needed = (_list_times(self.last.values()) | self.kept) - {t}
        if state.t not in self.kept:
            # Of the state's own time no copy is needed: the members with which the step begins.
            needed -= {state.t}
        # The times about which the state has beliefs. A step of no length keeps its past only.
        held = {time for time, _ in state.references}
        held |= {state.t, *state.times} if t > state.t else set(state.times)
        self.times = tuple(sorted(needed & held))
        self.sources: dict[int, list[tuple[Source | None, int]]] = {}

    def _add(self, observation: Observation) -> None:
        """Note that a sensor of changes observes now, in the runs and components not missing."""
        number = observation.sensor
        # A sensor that comes with its observation measures no change, nor do most others.
        if isinstance(number, Sensor) or (observation.agent, number) not in self.after:
            return
        source = observation.agent, number
        # Where a number is missing, the time of the last one stays, (*runs, m).
        present = ~np.isnan(observation.value)
        if present.all():
            self.after[source] = self.t
        else:
            self.after[source] = np.where(present, self.t, self.after[source])

    def receive(self, agent: int, observation: Observation) -> None:
        """Note that an agent has a present observation, after those noted before.

        Its source is None if its sensor measures no change.
        """
        number = observation.sensor
        source = None
        if not isinstance(number, Sensor) and (observation.agent, number) in self.last:
            source = observation.agent, number
        size = observation.value.shape[-1]
        self.sources.setdefault(agent, []).append((source, size))

    def find(
        self,
        group: Received,
        past: Sequence[Array],
        times: Sequence[float],
        origin: tuple[float, Array] | None,
    ) -> list[Previous]:
        """Return the earlier members with which a group's present observations are compared.

        Parameters
        ----------
        group : Received
        past, times : sequence of ndarray, and of float
            The members of the earlier times that the step keeps, and these times.
        origin : (float, ndarray) or None
            The time and the members with which the step begins, if it has a length.
        """
        agents = group.agents.tolist()
        # The time with which each number of the group is compared, (G, M) or (*runs, G, M)
        of_agents = [self._times_of(agent) for agent in agents]
        runs = np.broadcast_shapes(*[row.shape[:-1] for row in of_agents])
        shape = (*runs, group.target.shape[-1])
        compared = np.stack([np.broadcast_to(r, shape) for r in of_agents], axis=-2)
        result = []
        # For each time the members about it: of the past, or those with which the step begins
        sources = [source for agent in agents for source, _ in self.sources[agent]]
        last_times = [self.last[source] for source in sources if source is not None]
        for time in sorted(_list_times(last_times)):
            if time in times:
                members = past[times.index(time)]
            elif origin is not None and time == origin[0]:
                members = origin[1]
            else:
                raise ValueError(
                    "previous must be the states at the previous observation time, with which "
                    "a sensor of changes compares; there is none at t = "
                    f"{format_number(self.t)}"
                )
            result.append(Previous(members[..., group.rows, :, :], compared == time))
        return result

    def _times_of(self, agent: int) -> Array:
        """Return the times with which an agent's present numbers compare, NaN without one.

        They are (M,), or (*runs, M) where they differ between runs.
        """
        numbers: list[float] = []
        for source, size in self.sources[agent]:
            # One time for the observation's numbers, or an array (*runs, size)
            time = np.nan if source is None else self.last[source]
            if isinstance(time, np.ndarray):
                return self._times_by_run(agent)
            numbers += [time] * size
        return np.array(numbers)

    def _times_by_run(self, agent: int) -> Array:
        """Return the times of `_times_of` where components or runs have times of their own."""
        # For each of the agent's observations its times, (size,) or (*runs, size)
        parts = []
        for source, size in self.sources[agent]:
            times = np.nan if source is None else self.last[source]
            shape = (*np.shape(times)[:-1], size)
            parts.append(np.broadcast_to(times, shape))
        # All for the same runs, and one behind the other, (*runs, M)
        runs = np.broadcast_shapes(*[part.shape[:-1] for part in parts])
        parts = [np.broadcast_to(part, (*runs, part.shape[-1])) for part in parts]
        return np.concatenate(parts, axis=-1)

    @property
    def last_changes(self) -> tuple[tuple[int, int, Times], ...]:
        """The times after the step, as a state keeps them."""
        return tuple([(*source, times) for source, times in self.after.items()])


def _list_times(values: Iterable[Times]) -> set[float]:
    """Return the different numbers in arrays and numbers, without NaN."""
    times: set[float] = set()
    for value in values:
        if isinstance(value, np.ndarray):
            times.update(np.unique(value[~np.isnan(value)]).tolist())
        else:
            times.add(value)
    return times
