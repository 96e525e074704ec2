"""Observations that come twice: found by their agent, time, sensor and value, and counted once."""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Sequence

import numpy as np

from ..sensors import Sensor
from ..validation import Array
from .observations import Observation

__all__ = ["Assimilated", "drop_repeated"]

Assimilated = tuple[float, int, int | Sensor, Array, tuple[float, ...]]
"""Time, agent, sensor (its number, or itself), value and metadata of an observation."""


def drop_repeated(
    observations: Sequence[Sequence[Observation]],
    delayed: Sequence[Observation],
    assimilated: Iterable[Assimilated],
    dim: int,
) -> tuple[list[list[Observation]], list[Observation], list[Observation]]:
    """Leave out observations that occur twice, or have been assimilated before.

    Parameters
    ----------
    observations : sequence of sequence of Observation
        Those of the present time, for each agent.
    delayed : sequence of Observation
        Those of earlier times that arrive now.
    assimilated : iterable
        Those of the earlier times that the state keeps.
    dim : int
        Size of the state, to compare sensors that come with an observation.

    Returns
    -------
    observations, delayed, repeated : list
        The two lists without what they repeat, and the observations that were left out.

    Examples
    --------
    >>> one, other = Observation(1.0, 0, [2.0]), Observation(1.0, 0, [2.5])
    >>> kept, _, repeated = drop_repeated([[one, other, one]], [], (), 1)
    >>> [float(o.value[0]) for o in kept[0]], len(repeated)
    ([2.0, 2.5], 1)
    """
    # Candidates by time, agent and value; sensors are compared only where these agree.
    known: dict[Hashable, list[tuple[int | Sensor, tuple[float, ...]]]] = {}
    for t, agent, sensor, value, metadata in assimilated:
        key = t, agent, _fingerprint(value)
        known.setdefault(key, []).append((sensor, metadata))
    repeated: list[Observation] = []

    def keep_new(entries: Sequence[Observation]) -> list[Observation]:
        new = []
        for o in entries:
            same = known.setdefault((o.t, o.agent, _fingerprint(o.value)), [])
            if any(_is_same(o, sensor, metadata, dim) for sensor, metadata in same):
                repeated.append(o)
                continue
            same.append((o.sensor, o.metadata))
            new.append(o)
        return new

    kept = [keep_new(of_agent) for of_agent in observations]
    return kept, keep_new(delayed), repeated


def _fingerprint(value: Array) -> tuple[tuple[int, ...], bytes]:
    return value.shape, value.tobytes()


def _is_same(
    observation: Observation,
    sensor: int | Sensor,
    metadata: tuple[float, ...],
    dim: int,
) -> bool:
    """Whether an observation of an equal value is of the same sensor too."""
    of_observation = observation.sensor
    if not isinstance(sensor, Sensor) or not isinstance(of_observation, Sensor):
        return bool(sensor == of_observation)
    if sensor is of_observation:
        return True
    if observation.metadata != metadata or sensor.dim != of_observation.dim:
        return False
    # A copy of the sensor predicts the same for any states.
    states = 10.0 * np.random.default_rng(0).standard_normal((5, dim))
    first, second = [s.predict(states) for s in (sensor, of_observation)]
    is_equal = np.array_equal(first, second, equal_nan=True)
    return is_equal and bool((sensor.noise_cov == of_observation.noise_cov).all())
