"""What agents hear in one step, gathered so that one update serves many of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..checks import Array
from ..network import Channel
from ..sensors import Sensor

__all__ = ["Heard", "gather"]

Indices = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class _Part:
    """One sensor, and where its reading stands with each agent of a group that has it."""

    sensor: Sensor
    rows: Indices
    starts: Indices

    @property
    def columns(self) -> Indices:
        """Where each reading's components stand, (K, m)."""
        return np.asarray(self.starts[:, None] + np.arange(self.sensor.dim))


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
        out = np.empty((*states.shape[:-2], self.target.shape[-1], states.shape[-2]))
        for part in self.parts:
            before = None if previous is None else previous[..., part.rows, :, :]
            seen = part.sensor.predict(states[..., part.rows, :, :], before)
            # On the branch of the observation: y* - wrap(y* - h).
            cells = part.rows[:, None], part.columns
            aim = self.target[..., *cells][..., None, :]
            gap = part.sensor.residual(np.broadcast_to(aim, seen.shape), seen)
            seen = np.where(np.isnan(gap), seen, aim - gap)
            out[..., *cells, :] = seen.swapaxes(-1, -2)
        return np.ascontiguousarray(out.swapaxes(-1, -2))

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
    inbox = channel.exchange(observed) if channel is not None else [{} for _ in observed]
    groups: dict[int, list[tuple[int, dict[int, Array]]]] = {}
    for agent, own in enumerate(observed):
        heard = dict(inbox[agent])
        if own is not None:
            heard[agent] = own
        if heard:
            size = sum(value.shape[-1] for value in heard.values())
            groups.setdefault(size, []).append((agent, dict(sorted(heard.items()))))
    return [_group(groups[size], size, sensors) for size in sorted(groups)]


def _group(
    members: list[tuple[int, dict[int, Array]]], size: int, sensors: Sequence[Sensor | None]
) -> Heard:
    target = np.stack(
        [np.concatenate(list(heard.values()), axis=-1) for _, heard in members], axis=-2
    )
    # Agents with one and the same sensor are predicted together.
    places: dict[int, tuple[Sensor, list[tuple[int, int]]]] = {}
    for g, (_, heard) in enumerate(members):
        start = 0
        for sender, value in heard.items():
            sensor = sensors[sender]
            if sensor is None:
                raise ValueError(f"sensors: needs a sensor for agent {sender}, which observed")
            places.setdefault(id(sensor), (sensor, []))[1].append((g, start))
            start += value.shape[-1]
    parts, noise = [], np.zeros((len(members), size, size))
    for sensor, cells in places.values():
        rows, starts = (np.array(c, dtype=np.intp) for c in zip(*cells, strict=True))
        part = _Part(sensor, rows, starts)
        parts.append(part)
        at = part.columns
        noise[rows[:, None, None], at[:, :, None], at[:, None, :]] = sensor.cov
    same = bool((noise == noise[:1]).all())
    agents = np.array([agent for agent, _ in members], dtype=np.intp)
    return Heard(agents, target, noise[0] if same else noise, tuple(parts))
