"""What comes in: priors of any kind, readings at one time, late ones, and events of any order."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import KW_ONLY, dataclass
from itertools import pairwise
from typing import Annotated, Any

import numpy as np

from ..doors import MISSING, Array, Index, Record, array, definite, increasing, unchecked
from ..doors.values import all_finite
from ..ensembles import draw, sample_covariance
from ..mixtures import GaussianMixture
from ..sensors import Sensor

__all__ = [
    "Reading", "belated", "members_of", "mixtures_of", "moments_of", "planned", "said_by_all",
    "sensor_of",
]  # fmt: skip

_LISTED = list, Sequence, np.ndarray


@dataclass(frozen=True, eq=False)
class Reading(Record):
    """What one sensor of one agent read at one time.

    Parameters
    ----------
    t : float
        When it was made, in s.
    agent : int
        Who observed.
    value : array_like, (*runs, m) or (m,)
        NaN marks a missing component.
    sensor : int or Sensor
        Which of the agent's sensors; or a sensor of its own, such as one whose pose was known then.
    about : sequence of float
        Numbers that a neighbour needs to know the sensor, such as that pose: they are sent with the
        reading and charged.
    arrived : float, optional
        When it became known, in s, if that was later: for the `late` of :meth:`Filter.run`.

    Examples
    --------
    >>> Reading(2.0, 0, [1.5]).sensor
    0
    """

    t: float
    agent: Index
    value: Annotated[Array, "... m", MISSING]
    sensor: Index | Sensor = 0
    _: KW_ONLY
    about: tuple[float, ...] = ()
    arrived: float | None = None


def sensor_of(f: Any, reading: Reading) -> Sensor:
    """The sensor that made a reading: its own, or one of the agent's."""
    if isinstance(reading.sensor, Sensor):
        return reading.sensor
    own: tuple[Sensor, ...] = f.team[reading.agent]
    if reading.sensor >= len(own):
        raise ValueError(f"observations: needs one of the {len(own)} sensors of agent "
                         f"{reading.agent}, got {reading.sensor}")
    return own[reading.sensor]


def said_by_all(f: Any, observations: Any, runs: tuple[int, ...], t: float) -> list[list[Reading]]:
    """What each agent of a filter observed at one time, checked.

    >>> from distfilt.filters import GaussianFilter
    >>> from distfilt.models import constant_velocity
    >>> from distfilt.sensors import direct
    >>> f = GaussianFilter(constant_velocity(sigma=0.1), [direct([0], std=1.0)])
    >>> [[said.value for said in own] for own in said_by_all(f, [[1.5]], (), 0.0)]
    [[array([1.5])]]
    """
    out: list[list[Reading]] = []
    for agent, given in enumerate(one_each(observations, f.count)):
        own = f.team[agent]
        plain = type(given) is np.ndarray and given.dtype == np.float64 and len(own) == 1
        if plain and given.shape == (*runs, own[0].dim) and all_finite(given):  # as nearly all are
            out.append([Reading.unchecked(t, agent, given)])
            continue
        name = f"observations[{agent}]"
        several = given if _are_readings(given) else () if given is None else (given,)
        found = [_complete(f, _read(f, one, agent, t, name), runs, name) for one in several]
        out.append([said for said in found if said is not None])
    return out


def one_each(observations: Any, agents: int) -> Any:
    """Observations in a list, one entry for each agent.

    >>> one_each([1.0, 2.0], 3)
    Traceback (most recent call last):
    ValueError: observations: needs a list, one for each of 3 agents, got 2
    """
    observations = observations.to_numpy() if hasattr(observations, "to_numpy") else observations
    listed = isinstance(observations, _LISTED)
    if not listed or len(observations) != agents:
        got = len(observations) if listed else type(observations).__name__
        raise ValueError(f"observations: needs a list, one for each of {agents} agents, got {got}")
    return observations


def _read(f: Any, given: Any, agent: int, t: float, name: str) -> Reading:
    """A reading of this agent and time, or what its only sensor read."""
    if isinstance(given, Reading):
        if (given.agent, given.t) != (agent, t):
            got = f"one of agent {given.agent} at t = {given.t:g}"
            raise ValueError(f"{name}: needs a Reading of agent {agent} at t = {t:g}, got {got}")
        if given.arrived is not None and given.arrived > t:
            raise ValueError(f"{name}: needs what has arrived, got a Reading of {given.arrived:g}")
        return given
    own = f.team[agent]
    if len(own) != 1:
        needs = "a Reading of each sensor" if own else "None for an agent without a sensor"
        raise ValueError(f"{name}: needs {needs}, got an array")
    return Reading.unchecked(t, agent, array(given, name, (..., own[0].dim), finite=False))


def _complete(f: Any, said: Reading, runs: tuple[int, ...], name: str) -> Reading | None:
    """A reading with a value for each run; None if nothing of it is there."""
    value, dim = said.value, sensor_of(f, said).dim
    if np.isinf(value).any():
        raise ValueError(f"{name}: needs numbers or NaN, got infinity")
    if np.isnan(value).all():
        return None
    if value.shape == (*runs, dim):
        return said
    if value.shape != (dim,):
        raise ValueError(f"{name}: needs shape {(*runs, dim)}, got {value.shape}")
    return said.changed(value=np.broadcast_to(value, (*runs, dim)))


def belated(f: Any, late: Sequence[Reading], state: Any, t: float) -> list[Reading]:
    """Late readings, each at that one of the kept times to which it belongs.

    A sum of steps may differ by rounding, but by far less than the shortest of them.
    """
    times = state.kept(f.lag, t)
    shortest = min((b - a for a, b in pairwise((*times, t))), default=0.0)
    out = []
    for item in late:
        near = min(times, key=lambda known: abs(known - item.t), default=np.inf)
        if abs(near - item.t) > min(1e-9 * max(1.0, abs(item.t)), 1e-3 * shortest):
            known = ", ".join(f"{t:g}" for t in times) or "none (lag = 0)"
            raise ValueError(f"late: needs an earlier time that is kept ({known}), got {item.t:g}")
        if item.agent >= f.count:
            raise ValueError(f"late: needs an agent below {f.count}, got {item.agent}")
        if (sensor := sensor_of(f, item)).uses_previous:
            raise ValueError(f"late: a {sensor.kind} sensor cannot be late, it compares two times")
        said = _complete(f, item, state.runs, "late")
        if said is not None:
            out.append(said.changed(t=near))
    return out


def planned(f: Any, state: Any, times: Any, observations: Any) -> tuple[Array, Iterator[Any]]:
    """The times of a run's steps, and an iterator over what is observed at each of them.

    >>> from distfilt.filters import GaussianFilter
    >>> from distfilt.models import constant_velocity
    >>> from distfilt.sensors import direct
    >>> f = GaussianFilter(constant_velocity(sigma=1.0), [[direct([0], std=1.0)] * 2])
    >>> seen = [Reading(1.0, 0, [2.0], 1), Reading(0.5, 0, [3.0]), Reading(1.0, 0, [1.0])]
    >>> times, entries = planned(f, f.start((np.zeros(4), np.eye(4))), None, seen)
    >>> times, [[float(said.value[0]) for said in own] for own, in entries]
    (array([0.5, 1. ]), [[3.0], [2.0, 1.0]])
    """
    grid = np.zeros(0) if times is None else array(times, "times", ("T",))
    increasing(grid, "times")
    entries: Iterator[Any]
    if _are_readings(observations) and (times is None or observations):
        at: dict[float, list[list[Reading]]] = {t: [[] for _ in range(f.count)] for t in grid}
        for event in observations:
            if event.agent >= f.count:
                raise ValueError(f"observations: needs agents below {f.count}, got {event.agent}")
            at.setdefault(event.t, [[] for _ in range(f.count)])[event.agent].append(event)
        grid = np.array(sorted(at))
        entries = iter([at[t] for t in grid])
    elif times is None:
        raise ValueError("times: needs them, unless all observations are Readings, got None")
    else:
        # A table whose columns have names would give a column where a row is asked for.
        each = [o if o is None or isinstance(o, list | tuple) else np.atleast_1d(o)
                for o in one_each(observations, f.count)]
        for agent, series in enumerate(each):
            if series is not None and (got := len(series)) != grid.size:
                raise ValueError(
                    f"observations: needs ({grid.size}, ..., m) for agent {agent}, got {got}"
                )
            if isinstance(series, np.ndarray) and not isinstance(f.sensors, int):
                _warn_of_degrees(f.team[agent], series, agent)
        entries = ([None if o is None else o[k] for o in each] for k in range(grid.size))
    if grid.size and grid[0] < state.t:
        raise ValueError(f"times: needs times from the state's {state.t:g} on, got {grid[0]:g}")
    return grid, entries


def _warn_of_degrees(own: Sequence[Sensor], series: Array, agent: int) -> None:
    """Warn of angles that are more than four turns from what they are wrapped to."""
    wraps = len(own) == 1 and own[0].difference
    if not wraps or series.shape[-1:] != (own[0].dim,):
        return
    y = np.nan_to_num(series.astype(np.float64))
    if (most := np.abs(y - wraps(y, 0 * y)).max(initial=0.0) / (2 * np.pi)) > 4:
        text = f"observations[{agent}]: needs angles in rad, got some {most:.0f} turns off"
        warnings.warn(text, RuntimeWarning, stacklevel=4)


def _are_readings(given: Any) -> bool:
    """Whether these are events: Readings in a list, and nothing else."""
    return isinstance(given, list | tuple) and all(isinstance(item, Reading) for item in given)


def _is_pair(prior: Any) -> bool:
    """Whether this is (mean, cov), and no list of two members."""
    if type(prior) is list and any(type(p) is tuple and np.ndim(p[-1]) > 1 for p in prior):
        raise ValueError("prior: needs one for all agents, got a list of (mean, cov)")
    pair = isinstance(prior, tuple | list) and len(prior) == 2
    return pair and (isinstance(prior, tuple) or np.ndim(prior[0]) < np.ndim(prior[1]))


def moments_of(prior: Any, dim: int, word: str = "semidefinite") -> tuple[Array, Array]:
    """Mean (d,) and covariance (d, d), definite or semidefinite, of a prior that has them.

    >>> from scipy.stats import multivariate_normal
    >>> moments_of(multivariate_normal([1.0], [[4.0]]), 1)
    (array([1.]), array([[4.]]))
    """
    if isinstance(prior, GaussianMixture):
        mean, cov = prior.moments()
    elif hasattr(prior, "rvs"):
        spread: Any = getattr(prior, "cov", getattr(prior, "var", None))
        mean, cov = (v() if callable(v) else v for v in (prior.mean, spread))
    elif _is_pair(prior):
        mean, cov = prior
    elif callable(prior) or np.ndim(prior) != 2:
        got = "a function" if callable(prior) else type(prior).__name__
        raise ValueError(f"prior: needs (mean, cov) or what has a mean and a covariance, got {got}")
    else:
        members = array(prior, "prior", ("N", dim))
        if len(members) <= dim:
            raise ValueError(f"prior: needs more than {dim} members, got {len(members)}")
        mean, cov = members.mean(axis=0), sample_covariance(members)
    mean = array(np.atleast_1d(mean), "prior", (dim,))
    cov = array(cov, "prior")
    if cov.shape != (dim, dim) and not dim == cov.size == 1:
        raise ValueError(f"prior: needs a covariance of shape {(dim, dim)}, got {cov.shape}")
    definite(cov := cov.reshape(dim, dim), "prior", word)
    return mean, cov


def members_of(
    prior: Any, members: int, leading: tuple[int, ...], dim: int, rng: np.random.Generator
) -> Array:
    """Members (*leading, N, d) of a prior of any kind that :meth:`Filter.start` lists.

    >>> members_of(([0.0], [[1.0]]), 5, (2,), 1, np.random.default_rng(0)).shape
    (2, 5, 1)
    """
    shape = (*leading, members, dim)
    if _is_pair(prior):
        mean, cov = moments_of(prior, dim)
        return unchecked(draw)(mean, cov, members, rng=rng, leading=leading)
    if hasattr(prior, "rvs"):
        word = "rng" if isinstance(prior, GaussianMixture) else "random_state"
        found = prior.rvs(math.prod(shape[:-1]), **{word: rng})
        return array(found.reshape(*shape[:-1], -1), "prior", shape)
    found = prior(members, rng=rng, leading=leading) if callable(prior) else prior
    out = array(found, "prior", (..., members, dim))
    if out.shape != shape and out.shape != shape[-2:]:
        raise ValueError(f"prior: needs shape {shape} or {shape[-2:]}, got {out.shape}")
    return np.broadcast_to(out, shape).copy()


def mixtures_of(prior: Any, dim: int, count: int) -> tuple[GaussianMixture, ...]:
    """A mixture for each agent, of one prior for all or of a list with one each.

    >>> [mixture.size for mixture in mixtures_of(([0.0], [[1.0]]), 1, 2)]
    [1, 1]
    """
    given = prior if isinstance(prior, list) else [prior] * count
    if len(given) != count:
        raise ValueError(f"prior: needs one for all or for each of {count}, got {len(given)}")
    out = []
    for one in given:
        mixed = isinstance(one, GaussianMixture)
        out.append(one if mixed else GaussianMixture.gaussian(*moments_of(one, dim, "definite")))
        if out[-1].dim != dim:
            raise ValueError(f"prior: needs dimension {dim}, got {out[-1].dim}")
    return tuple(out)
