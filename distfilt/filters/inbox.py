"""What agents know of the readings of one time, gathered so that one update serves many of them."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import numpy as np

from ..sensors import Sensor
from ..validation import Array, all_finite

__all__ = ["Received", "group_agents"]


class Received:
    """The readings that G agents have, equally many numbers each, M.

    `agents` (G,) says who they are, and `rows` the same as an index, a slice where they are all.
    `target` (*runs, G, M) is what they know of the observations, NaN where a component is missing;
    `noise` is its covariance, (M, M) if it is the same for all, else (G, M, M).

    >>> from distfilt.sensors import component
    >>> sensor = component([0], std=0.5)
    >>> (pair,) = group_agents([[sensor]] * 2, [[np.array([1.0])]] * 2)
    >>> pair.agents, pair.target.ravel(), pair.noise
    (array([0, 1]), array([1., 1.]), array([[0.25]]))
    >>> quiet, loud = component([1], std=1.0), component([1], std=2.0)
    >>> (pair,) = group_agents(
    ...     [[sensor, quiet], [sensor, loud]], [[np.ones(1)] * 2] * 2
    ... )
    >>> pair.noise[:, 1, 1]
    array([1., 4.])
    """

    target: Array

    def __init__(
        self, agents: list[int], sensors: Sequence[tuple[Sensor, ...]]
    ) -> None:
        self.agents = np.array(agents, dtype=np.intp)
        self.rows: Any = (
            slice(None) if agents == [*range(len(sensors))] else self.agents
        )
        places: dict[Sensor, list[tuple[int, int]]] = {}
        size = sum(s.dim for s in sensors[agents[0]])
        self.owner = np.zeros((len(agents), size), dtype=np.intp)
        for g, agent in enumerate(agents):
            at = 0
            for k, sensor in enumerate(sensors[agent]):
                places.setdefault(sensor, []).append((g, at))
                self.owner[g, at : at + sensor.dim] = k
                at += sensor.dim
        # Agents with one and the same sensor are predicted together: with which agents of the
        # group a sensor's reading stands, and in which cells.
        self.parts: list[tuple[Sensor, Any, Any]] = []
        noise = np.zeros((len(agents), size, size))
        for sensor, found in places.items():
            rows, starts = (
                np.array(c, dtype=np.intp) for c in zip(*found, strict=True)
            )
            columns = starts[:, None] + np.arange(sensor.dim)
            across = columns[:, :, None]
            down = columns[:, None, :]
            noise[rows[:, None, None], across, down] = sensor.noise_cov
            whole = columns.shape == self.owner.shape  # the only sensor: views will do
            cells: Any = (
                (slice(None), slice(None)) if whole else (rows[:, None], columns)
            )
            self.parts.append((sensor, slice(None) if whole else rows, cells))
        self.noise = noise[0] if (noise == noise[:1]).all() else noise
        self.linear = all(sensor.linear is not None for sensor in places)
        self.changes = any(sensor.uses_previous for sensor in places)
        self.matrices: dict[int, Array] = {}

    def H(self, dim: int) -> Array:
        """The matrices of linear sensors one below the other, (G, M, d), made once."""
        if dim not in self.matrices:
            h = np.zeros((*self.owner.shape, dim))
            for sensor, _, cells in self.parts:
                h[cells] = sensor.H(dim)
            self.matrices[dim] = h
        return self.matrices[dim]

    def collect(self, values: Sequence[Sequence[Array]]) -> Array:
        """The readings of each agent of the group side by side, (*runs, G, M)."""
        rows = [value for agent in self.agents.tolist() for value in values[agent]]
        flat = rows[0] if len(rows) == 1 else np.concatenate(rows, axis=-1)
        return flat.reshape(*flat.shape[:-1], *self.owner.shape)

    def with_target(self, target: Array) -> Received:
        """The same with these values."""
        out = object.__new__(Received)
        vars(out).update(vars(self), target=target)
        return out

    def predict(
        self, states: Array, previous: Array | None = None, alike: bool = False
    ) -> Array:
        """Readings of states (*runs, G, N, d) without noise, (*runs, G, N, M).

        A reading that wraps lies on the branch of the observation; if they are to be `alike`, the
        first one does, and the others lie on its branch. `previous` holds the states at the
        observation time before, for sensors that see changes.
        """
        if self.linear:
            return np.asarray(
                states @ np.ascontiguousarray(self.H(states.shape[-1]).mT)
            )
        out = np.empty((*states.shape[:-2], self.target.shape[-1], states.shape[-2]))
        for sensor, rows, cells in self.parts:
            before = None if previous is None else previous[..., rows, :, :]
            seen = sensor.predict(states[..., rows, :, :], before)
            out[(..., *cells, slice(None))] = seen.swapaxes(-1, -2)
        out = np.ascontiguousarray(out.swapaxes(-1, -2))
        if not all_finite(out) and np.isinf(out).any():
            raise ValueError(
                "predicted must have finite numbers or NaN (missing), got infinity"
            )
        out = self.wrap_near(out, self.target[..., None, :])
        return self.wrap_near(out, out[..., :1, :]) if alike else out

    def wrap_near(self, seen: Array, aim: Array) -> Array:
        """Predictions (*runs, G, N, M), now on the branch of an aim (*runs, G, 1, M); in place."""
        out = seen.swapaxes(-1, -2)
        for sensor, _, cells in self.parts:
            if sensor.residual_function is not None:
                at = (..., *cells, slice(None))
                goal = (aim + 0 * seen).swapaxes(-1, -2)
                here, there = (x[at].swapaxes(-1, -2) for x in (out, goal))
                # y* - wrap(y* - h)
                gap = sensor.residual(there, here)
                out[at] = np.where(np.isnan(gap), here, there - gap).swapaxes(-1, -2)
        return seen

    def jacobian(self, states: Array) -> Array:
        """Derivatives of the readings at states (*runs, G, d), (*runs, G, M, d)."""
        d = states.shape[-1]
        if self.linear:
            return np.full((*self.target.shape, d), self.H(d))
        out = np.empty((*self.target.shape, d))
        for sensor, rows, cells in self.parts:
            out[(..., *cells, slice(None))] = sensor.jacobian(states[..., rows, :])
        return out

    def gate(self, mean: Array, cov: Array, share: float) -> tuple[Received, Array]:
        """The readings that their predictions can explain, and how many they cannot, (*runs, G).

        Each sensor's reading is judged alone, by what a good one's normalised innovation exceeds
        with probability 1 - `share_observations`; `mean` and `cov` are of the predictions without noise.
        """
        from scipy.special import gammaincinv

        gap = self.target - mean
        spread = cov + self.noise
        refused = np.zeros(gap.shape[:-1])
        out = self.target
        for k in range(int(self.owner.max()) + 1):
            here = (self.owner == k) & ~np.isnan(gap)
            some = here.sum(axis=-1)
            inner = np.where(
                here[..., :, None] & here[..., None, :], spread, np.eye(gap.shape[-1])
            )
            part = np.where(here, gap, 0.0)
            length = (part * np.linalg.solve(inner, part[..., None])[..., 0]).sum(
                axis=-1
            )
            bad = (some > 0) & (
                length > 2 * gammaincinv(np.maximum(some, 1) / 2, share)
            )
            out = np.where(here & bad[..., None], np.nan, out)
            refused += bad
        return self.with_target(out), refused


@lru_cache(maxsize=32)
def _planned(pattern: tuple[tuple[Sensor, ...], ...]) -> list[Received]:
    """A group for each number of readings that occurs; agents without any are left out."""
    sizes: dict[int, list[int]] = {}
    for agent, sensors in enumerate(pattern):
        if sensors:
            sizes.setdefault(sum(s.dim for s in sensors), []).append(agent)
    return [Received(agents, pattern) for _, agents in sorted(sizes.items())]


def group_agents(
    sensors: Sequence[Any], values: Sequence[Sequence[Array]]
) -> list[Received]:
    """Agents in groups, from each one's sensors and values (*runs, m) in a list of its own.

    The plan of a pattern is made when it is first needed.

    >>> group_agents([[], []], [[], []])
    []
    """
    plans = _planned(tuple([tuple(own) for own in sensors]))
    return [plan.with_target(plan.collect(values)) for plan in plans]
