"""What agents hear in one step, gathered so that one update serves many of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray

from ..checks import Array, array, instance, same_length
from ..network import Channel
from ..sensors import Sensor

__all__ = ["Heard", "gather"]

Indices = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class _Part:
    """One sensor, and where its reading stands with each agent of a group that has it.

    `everyone` says that `rows` are all agents of the group, once each and in order.
    """

    sensor: Sensor
    rows: Indices
    starts: Indices
    everyone: bool

    @cached_property
    def columns(self) -> Indices:
        """Where each reading's components stand, (K, m)."""
        return np.asarray(self.starts[:, None] + np.arange(self.sensor.dim))

    def of(self, states: Array) -> Array:
        """Of a group's states (*runs, G, N, d) those of the agents with this reading."""
        return states if self.everyone else states[..., self.rows, :, :]


@dataclass(frozen=True, eq=False)
class Heard:
    """The readings of G agents that have equally many numbers, M: those of `parts`, their sensors.

    `agents` (G,) says who they are; `target` (*runs, G, M) is what they know of the observations,
    NaN where a component is missing; `noise` is its covariance, (M, M) if it is the same for all,
    else (G, M, M).

    >>> from distfilt.network import Channel, graphs
    >>> from distfilt.sensors import direct
    >>> sensor = direct([0], std=0.5)
    >>> (pair,) = gather([np.array([1.0]), None], [sensor, None], Channel(graphs.path(2)))
    >>> pair.agents, pair.target.ravel()
    (array([0, 1]), array([1., 1.]))
    """

    agents: Indices
    target: Array
    noise: Array
    parts: tuple[_Part, ...]

    def predict(self, states: Array, previous: Array | None = None) -> Array:
        """Readings of states (*runs, G, N, d) without noise, (*runs, G, N, M).

        A reading that wraps lies on the branch of the observation. `previous` holds the states at
        the observation time before, for sensors that see changes.
        """
        if len(self.parts) == 1 and self.parts[0].everyone:
            out = np.ascontiguousarray(self._seen(self.parts[0], states, previous))
        else:
            out = self._stacked(states, previous)
        if np.isinf(out).any():
            raise ValueError("predicted: needs finite numbers or NaN (missing), got infinity")
        return out

    def _stacked(self, states: Array, previous: Array | None) -> Array:
        """Readings of several sensors, (*runs, G, N, M)."""
        out = np.empty((*states.shape[:-2], self.target.shape[-1], states.shape[-2]))
        for part in self.parts:
            cells = part.rows[:, None], part.columns
            out[..., *cells, :] = self._seen(part, states, previous).swapaxes(-1, -2)
        return np.ascontiguousarray(out.swapaxes(-1, -2))

    def _seen(self, part: _Part, states: Array, previous: Array | None) -> Array:
        """Readings of one sensor, (*runs, K, N, m)."""
        sensor, here = part.sensor, part.of(states)
        if not sensor.uses_previous:
            seen = sensor._seen(here)
        elif previous is None:
            seen = sensor.predict(here)  # which says what is missing
        else:
            seen = sensor._seen(here, part.of(previous))
        if sensor.difference is None:
            return seen
        # On the branch of the observation: y* - wrap(y* - h).
        aim = self.target[..., part.rows[:, None], part.columns][..., None, :]
        gap = sensor._residual(np.broadcast_to(aim, seen.shape), seen)
        return np.where(np.isnan(gap), seen, aim - gap)

    def jacobian(self, states: Array) -> Array:
        """Derivatives of the readings at states (*runs, G, d), (*runs, G, M, d)."""
        out = np.empty((*self.target.shape, states.shape[-1]))
        for part in self.parts:
            slope = part.sensor.jacobian(states[..., part.rows, :])
            out[..., part.rows[:, None], part.columns, :] = slope
        return out

    def covariance(self, row: int) -> Array:
        """The noise covariance of one agent of the group, (M, M)."""
        return self.noise if self.noise.ndim == 2 else self.noise[row]



def gather(
    observed: Sequence[Array | None], sensors: Sequence[Sensor | None], channel: Channel | None
) -> list[Heard]:
    """Let agents send what they observed, (*runs, m) or None, and collect what each then knows.

    Without a channel nobody tells another. There is one entry for each number of readings that
    occurs, ascending; agents without any are left out.
    """
    if channel is not None:
        instance(channel, "channel", Channel)
    return gathered(_checked(observed, sensors), sensors, channel)


def gathered(
    observed: Sequence[Array | None], sensors: Sequence[Sensor | None], channel: Channel | None
) -> list[Heard]:
    """The same without checks, for a step that has made them."""
    inbox = channel.exchange(observed) if channel is not None else [{} for _ in observed]
    known = []
    for agent, (own, heard) in enumerate(zip(observed, inbox, strict=True)):
        told = heard if own is None else {**heard, agent: own}
        known.append(dict(sorted(told.items())))
    return [
        Heard(plan.agents, plan.collected(known), plan.noise, plan.parts)
        for plan in _plans(tuple(tuple(k) for k in known), tuple(sensors))
    ]


def _checked(
    observed: Sequence[Array | None], sensors: Sequence[Sensor | None]
) -> list[Array | None]:
    """The observations, if each fits its sensor and all are of the same runs."""
    same_length(observed, sensors, "observed", "sensors")
    out: list[Array | None] = []
    runs: tuple[int, ...] | None = None
    for value, sensor in zip(observed, sensors, strict=True):
        if value is None:
            out.append(None)
            continue
        size = "m" if sensor is None else sensor.dim
        seen = array(value, "observed", (..., size), finite=False)
        runs = seen.shape[:-1] if runs is None else runs
        if seen.shape[:-1] != runs:
            raise ValueError(f"observed: needs shape {(*runs, size)}, got {seen.shape}")
        if np.isinf(seen).any():
            raise ValueError("observed: needs numbers or NaN, got infinity")
        out.append(seen)
    return out


@dataclass(frozen=True, eq=False)
class _Plan:
    """What a group of agents has of whom, and with what noise."""

    agents: Indices
    noise: Array
    parts: tuple[_Part, ...]

    def collected(self, known: list[dict[int, Array]]) -> Array:
        """The readings of each agent of the group side by side, (*runs, G, M)."""
        rows = [value for agent in self.agents.tolist() for value in known[agent].values()]
        flat = np.concatenate(rows, axis=-1)
        return flat.reshape(*flat.shape[:-1], self.agents.size, self.noise.shape[-1])


# A network without losses hears the same in every step, so that its plan is made once.
@lru_cache(maxsize=4)
def _plans(
    senders: tuple[tuple[int, ...], ...], sensors: tuple[Sensor | None, ...]
) -> tuple[_Plan, ...]:
    """The groups of agents that have equally many numbers, ascending, from whom each has some."""
    sizes = [0 if s is None else s.dim for s in sensors]
    for sender in {j for who in senders for j in who}:
        if sensors[sender] is None:
            raise ValueError(f"sensors: needs a sensor for agent {sender}, which observed")
    groups: dict[int, list[int]] = {}
    for agent, who in enumerate(senders):
        if who:
            groups.setdefault(sum(sizes[j] for j in who), []).append(agent)
    return tuple(
        _plan(agents, size, [senders[a] for a in agents], sensors)
        for size, agents in sorted(groups.items())
    )


def _plan(
    agents: list[int], size: int, senders: list[tuple[int, ...]],
    sensors: tuple[Sensor | None, ...],
) -> _Plan:
    # Agents with one and the same sensor are predicted together.
    places: dict[Sensor, list[tuple[int, int]]] = {}
    for g, who in enumerate(senders):
        start = 0
        for sender in who:
            sensor = sensors[sender]
            assert sensor is not None
            places.setdefault(sensor, []).append((g, start))
            start += sensor.dim
    parts, noise = [], np.zeros((len(agents), size, size))
    for sensor, cells in places.items():
        rows, starts = (np.array(c, dtype=np.intp) for c in zip(*cells, strict=True))
        everyone = rows.tolist() == list(range(len(agents)))
        part = _Part(sensor, rows, starts, everyone)
        parts.append(part)
        at = part.columns
        noise[rows[:, None, None], at[:, :, None], at[:, None, :]] = sensor.cov
    if (noise == noise[:1]).all():
        noise = noise[0].copy()
    noise.flags.writeable = False
    return _Plan(np.array(agents, dtype=np.intp), noise, tuple(parts))
