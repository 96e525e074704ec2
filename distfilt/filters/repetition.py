"""Observations that come twice: found by their agent, time, sensor and value, and counted once."""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..sensors import Sensor
from ..validation import Array, format_number
from .observations import Observation

__all__ = [
    "Assimilated",
    "WithoutRepeats",
    "describe_near_copy",
    "drop_repeated",
    "find_rounded_copy",
    "is_equal_value",
]

Assimilated = tuple[float, int, int | Sensor, Array, tuple[float, ...]]
"""Time, agent, sensor (its number, or itself), value and metadata of an observation."""


class WithoutRepeats(NamedTuple):
    """Observations of which each is there once, and those that were left out."""

    observations: list[list[Observation]]
    """Those of the present time, for each agent."""
    delayed: list[Observation]
    """Those of earlier times."""
    repeated: list[Observation]
    """Those that were left out, of all agents and times."""


def drop_repeated(
    observations: Sequence[Sequence[Observation]],
    delayed: Sequence[Observation],
    assimilated: Iterable[Assimilated],
    dim: int,
) -> WithoutRepeats:
    """Leave out observations that occur twice, or have been assimilated before.

    A copy may have gone through single precision.

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

    Examples
    --------
    >>> one, other = Observation(1.0, 0, [2.0]), Observation(1.0, 0, [2.5])
    >>> result = drop_repeated([[one, other, one]], [], (), dim=1)
    >>> [float(o.value[0]) for o in result.observations[0]], len(result.repeated)
    ([2.0, 2.5], 1)
    """
    # Candidates by time, agent and value; sensors are compared only where these agree. The
    # fingerprint is the value in single precision, through which a copy may have gone.
    known: dict[Hashable, list[tuple[int | Sensor, Array, tuple[float, ...]]]] = {}
    for t, agent, sensor, value, metadata in assimilated:
        key = t, agent, _fingerprint(value)
        known.setdefault(key, []).append((sensor, value, metadata))
    repeated: list[Observation] = []

    def keep_new(entries: Sequence[Observation]) -> list[Observation]:
        """Return the observations that are not known yet; note them, and those that repeat."""
        new = []
        for o in entries:
            # The observations with the same time, agent and value, an empty list at first
            same = known.setdefault((o.t, o.agent, _fingerprint(o.value)), [])
            if any(
                is_equal_value(o.value, value) and _is_same(o, sensor, metadata, dim)
                for sensor, value, metadata in same
            ):
                repeated.append(o)
                continue
            same.append((o.sensor, o.value, o.metadata))
            new.append(o)
        return new

    new_observations = [keep_new(of_agent) for of_agent in observations]
    return WithoutRepeats(new_observations, keep_new(delayed), repeated)


def find_rounded_copy(
    observations: Sequence[Observation],
    assimilated: Iterable[Assimilated],
    dim: int,
) -> str | None:
    """Return a warning of an observation that came before, but for rounding of its time.

    A single step does not know how far apart the times usually are. So one of the two times has to
    be the other to some decimals, or in single precision.

    >>> value = np.array([2.5])
    >>> before = [(1.0, 0, 0, value, ())]
    >>> find_rounded_copy([Observation(1.0004, 0, value)], before, dim=1)
    "observations must have one time to count once, got the same value of agent 0's sensor at ..."
    >>> find_rounded_copy([Observation(1.1, 0, value)], before, dim=1) is None
    True
    """
    for t, agent, sensor, value, metadata in assimilated:
        # Missing values are all alike.
        if np.isnan(value).all():
            continue
        for o in observations:
            if o.agent != agent or not _is_rounded(t, o.t):
                continue
            if not is_equal_value(o.value, value):
                continue
            if _is_same(o, sensor, metadata, dim):
                return describe_near_copy(agent, t, o.t)
    return None


_DECIMALS = range(3, 10)
"""To so many decimals times are rounded, from milliseconds to nanoseconds."""


def _is_rounded(time: float, other: float) -> bool:
    """Whether one of two different times is the other one, rounded.

    >>> _is_rounded(0.1, float(np.float32(0.1))), _is_rounded(1.25, 1.2)
    (True, False)
    """
    if time == other:
        return False
    for exact, rounded in ((time, other), (other, time)):
        if np.float32(exact) == rounded:
            return True
        if any(round(exact, decimals) == rounded for decimals in _DECIMALS):
            return True
    return False


def describe_near_copy(agent: int, t: float, later: float) -> str:
    """Return the warning of two equal values of an agent's sensor at nearly the same time.

    >>> describe_near_copy(2, 1.0, 1.0 + 2**-20)
    "observations must have one time to count once, got the same value of agent 2's sensor at ..."
    """
    return (
        f"observations must have one time to count once, got the same value of agent {agent}'s "
        f"sensor at t = {format_number(t)} s and {later - t:.3g} s later: copies with rounded "
        "times count twice"
    )


def is_equal_value(value: Array, other: Array) -> bool:
    """Whether two values are equal, or one is the other in single precision.

    >>> is_equal_value(np.array([1.1]), np.array([np.float32(1.1)], dtype=float))
    True
    >>> is_equal_value(np.array([1.1]), np.array([1.1 + 1e-8]))
    False
    """
    if np.array_equal(value, other, equal_nan=True):
        return True
    return any(
        np.array_equal(_to_single(a), b, equal_nan=True)
        for a, b in ((value, other), (other, value))
    )


def _to_single(value: Array) -> NDArray[np.float32]:
    """Return a value rounded to single precision, in which it may be infinite."""
    with np.errstate(over="ignore", under="ignore"):
        return value.astype(np.float32)


def _fingerprint(value: Array) -> tuple[tuple[int, ...], bytes]:
    """Return a key that arrays of the same shape and numbers, in single precision, share."""
    return value.shape, _to_single(value).tobytes()


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
    # A copy of the sensor predicts the same for any states: five are drawn, with a fixed seed and
    # far enough from each other.
    states = 10.0 * np.random.default_rng(0).standard_normal((5, dim))
    first, second = [s.predict(states) for s in (sensor, of_observation)]
    is_equal = np.array_equal(first, second, equal_nan=True)
    return is_equal and bool((sensor.noise_cov == of_observation.noise_cov).all())
