"""What comes in: priors of any kind, readings at one time, late ones, and events of any order."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Annotated, Any, NamedTuple

import numpy as np

from ..doors import (
    MISSING,
    Array,
    Bounds,
    Index,
    Record,
    array,
    definite,
    increasing,
    semidefinite,
    unchecked,
)
from ..ensembles import draw, sample_covariance
from ..mixtures import GaussianMixture
from ..sensors import Sensor

__all__ = [
    "Late", "Reading", "Said", "Team", "belated", "members_of", "mixture_of", "moments_of",
    "planned", "priors_of", "said_by_all", "sensor_of", "team_of",
]  # fmt: skip


class Said(NamedTuple):
    """A reading on its way: its value (*runs, m), and what tells others how it was made."""

    sensor: Sensor
    value: Array
    place: Any = 0  # among the agent's sensors, or a sensor of its own
    about: tuple[float, ...] = ()


@dataclass(frozen=True, eq=False)
class Reading(Record):
    """What one sensor of one agent read at one time.

    Parameters
    ----------
    t : float
        In s.
    agent : int
    value : array_like, (*runs, m) or (m,)
        NaN marks a missing component.
    sensor : int or Sensor
        Which of the agent's sensors; or a sensor of its own, such as one whose pose was known then.
    about : sequence of float
        Numbers that a neighbour needs to know the sensor, such as that pose: they are sent with the
        reading and charged.

    Examples
    --------
    >>> Reading(2.0, 0, [1.5]).sensor
    0
    """

    t: float
    agent: Index
    value: Annotated[Array, "... m", MISSING]
    sensor: Index | Sensor = 0
    about: tuple[float, ...] = field(default=(), kw_only=True)


@dataclass(frozen=True, eq=False)
class Late(Record):
    """An observation that arrives after the time at which it was made.

    Parameters
    ----------
    agent : int
        Who observed, with its first sensor.
    measured : float
        When, in s: a time at which the filter was stepped before.
    value : array_like, (*runs, m) or (m,)
        What was observed; NaN marks a missing component.
    arrived : float
        When it became known, in s; used by :meth:`Filter.run`.

    Examples
    --------
    >>> Late(0, 1.0, [2.0], arrived=3.0).measured
    1.0
    """

    agent: Index
    measured: float
    value: Annotated[Array, "... m", MISSING]
    arrived: float

    def __post_init__(self) -> None:
        super().__post_init__()
        Bounds(above=self.measured)(self.arrived, "arrived")


Team = tuple[tuple[Sensor, ...], ...]
"""Each agent's sensors."""


def team_of(sensors: Any) -> Team:
    """Each agent's sensors, of a Sensor, several in a list, or None for each.

    >>> team_of([None, None])
    ((), ())
    """
    if isinstance(sensors, Sensor) or not isinstance(sensors, Sequence) or not len(sensors):
        got = "none" if isinstance(sensors, Sequence) else type(sensors).__name__
        raise ValueError(f"sensors: needs one Sensor or None for each agent, in a list, got {got}")
    out = tuple(
        () if own is None else tuple(own) if isinstance(own, list | tuple) else (own,)
        for own in sensors
    )
    for sensor in (s for own in out for s in own):
        if not isinstance(sensor, Sensor):
            raise ValueError(f"sensors: needs Sensor or None, got {type(sensor).__name__}")
    return out


def sensor_of(f: Any, agent: int, place: int | Sensor, t: float) -> Sensor:
    """One of an agent's sensors, by its place; a sensor is itself."""
    if isinstance(place, Sensor):
        return place
    own: tuple[Sensor, ...] = f.team(t)[agent]
    if place >= len(own):
        raise ValueError(
            f"observations: needs one of the {len(own)} sensors of agent {agent}, got {place}"
        )
    return own[place]


def said_by_all(f: Any, observations: Any, runs: tuple[int, ...], t: float) -> list[list[Said]]:
    """What each agent of a filter observed at one time, checked.

    >>> from distfilt.filters import GaussianFilter
    >>> from distfilt.models import constant_velocity
    >>> from distfilt.sensors import direct
    >>> f = GaussianFilter(constant_velocity(sigma=0.1), [direct([0], std=1.0)])
    >>> [[said.value for said in own] for own in said_by_all(f, [[1.5]], (), 0.0)]
    [[array([1.5])]]
    """
    out: list[list[Said]] = []
    for agent, given in enumerate(one_each(observations, f.count)):
        several = _is_readings(given) or (isinstance(given, list) and not given)
        found = (_said(f, one, agent, runs, t) for one in (given if several else (given,)))
        out.append([said for said in found if said is not None])
    return out


def one_each(observations: Any, agents: int) -> Any:
    """Observations in a list, one entry for each agent."""
    if not isinstance(observations, Sequence | np.ndarray) or len(observations) != agents:
        got = len(observations) if hasattr(observations, "__len__") else repr(observations)
        raise ValueError(f"observations: needs one for each of {agents} agents, got {got}")
    return observations


def _said(f: Any, given: Any, agent: int, runs: tuple[int, ...], t: float) -> Said | None:
    """One reading; None if nothing of it is there."""
    name = f"observations[{agent}]"
    place: int | Sensor = 0
    about: tuple[float, ...] = ()
    if given is None:
        return None
    if isinstance(given, Reading):
        if (given.agent, given.t) != (agent, t):
            got = f"one of agent {given.agent} at t = {given.t:g}"
            raise ValueError(f"{name}: needs a Reading of agent {agent} at t = {t:g}, got {got}")
        value, place, about = given.value, given.sensor, given.about
    elif len(own := f.team(t)[agent]) == 1:
        value = array(given, name, (..., own[0].dim), finite=False)
    else:
        needs = "a Reading of each sensor" if own else "None for an agent without a sensor"
        raise ValueError(f"{name}: needs {needs}, got an array")
    sensor = sensor_of(f, agent, place, t)
    if not np.isfinite(value).all():
        if np.isinf(value).any():
            raise ValueError(f"{name}: needs numbers or NaN, got infinity")
        if np.isnan(value).all():
            return None
    if value.shape != (*runs, sensor.dim):
        if value.shape != (sensor.dim,):
            raise ValueError(f"{name}: needs shape {(*runs, sensor.dim)}, got {value.shape}")
        value = np.broadcast_to(value, (*runs, sensor.dim))
    return Said(sensor, value, place, about)


def belated(f: Any, late: Sequence[Late], state: Any, t: float) -> list[tuple[int, int, Said]]:
    """Where among the kept times each late observation belongs, who made it, and what it says.

    A sum of steps may differ by rounding, but by far less than the shortest of them.
    """
    times = state.kept(f.lag, t)
    shortest = min((b - a for a, b in pairwise((*times, t))), default=0.0)
    out = []
    for item in late:
        away = [abs(known - item.measured) for known in times]
        slack = min(1e-9 * max(1.0, abs(item.measured)), 1e-3 * shortest)
        if not away or min(away) > slack:
            known = ", ".join(f"{t:g}" for t in times) or "none (lag = 0)"
            raise ValueError(
                f"late: needs an earlier time that is kept ({known}), got {item.measured:g}"
            )
        if item.agent >= f.count:
            raise ValueError(f"late: needs an agent below {f.count}, got {item.agent}")
        said = _said(f, item.value, item.agent, state.runs, item.measured)
        if said is not None and said.sensor.uses_previous:
            kind = said.sensor.kind
            raise ValueError(f"late: a {kind} sensor cannot be late, it compares two times")
        if said is not None:
            out.append((away.index(min(away)), item.agent, said))
    return out


def planned(f: Any, state: Any, times: Any, observations: Any) -> tuple[Array, Iterator[Any]]:
    """The times of a run's steps, and an iterator over what is observed at each of them."""
    grid = np.zeros(0) if times is None else array(times, "times", ("T",))
    entries: Iterator[Any]
    if _is_readings(observations) or (times is None and observations == []):
        at: dict[float, list[list[Reading]]] = {t: [[] for _ in range(f.count)] for t in grid}
        for event in observations:
            if event.agent >= f.count:
                raise ValueError(f"observations: needs agents below {f.count}, got {event.agent}")
            at.setdefault(event.t, [[] for _ in range(f.count)])[event.agent].append(event)
        increasing(grid, "times")
        grid = np.array(sorted(at))
        entries = iter([at[t] for t in grid])
    elif times is None:
        raise ValueError("times: needs them, unless all observations are Readings, got None")
    else:
        size = grid.size
        for agent, series in enumerate(one_each(observations, f.count)):
            if series is not None and (got := len(np.atleast_1d(series))) != size:
                raise ValueError(
                    f"observations: needs ({size}, ..., m) for agent {agent}, got {got}"
                )
        entries = ([None if o is None else o[k] for o in observations] for k in range(size))
    increasing(grid, "times")
    if grid.size and grid[0] < state.t:
        raise ValueError(f"times: needs times from the state's {state.t:g} on, got {grid[0]:g}")
    return grid, entries


def _is_readings(given: Any) -> bool:
    """Whether these are events: one or more Readings, and nothing else."""
    if isinstance(given, Reading) or not isinstance(given, list | tuple):
        return False
    return all(isinstance(item, Reading) for item in given) and len(given) > 0


def moments_of(prior: Any, dim: int, *, singular: bool = False) -> tuple[Array, Array]:
    """Mean (d,) and covariance (d, d) of a prior of any kind that has them.

    >>> from scipy.stats import multivariate_normal
    >>> moments_of(multivariate_normal([1.0], [[4.0]]), 1)
    (array([1.]), array([[4.]]))
    """
    if isinstance(prior, GaussianMixture):
        mean, cov = prior.moments()
    elif hasattr(prior, "rvs"):
        mean, cov = (v() if callable(v) else v for v in (prior.mean, _covariance(prior)))
    elif isinstance(prior, tuple) and len(prior) == 2:
        mean, cov = prior
    elif callable(prior) or np.ndim(prior) != 2:
        got = "a function" if callable(prior) else type(prior).__name__
        raise ValueError(f"prior: needs (mean, cov) or what has a mean and a covariance, got {got}")
    else:
        members = array(prior, "prior", ("N", dim))
        mean, cov = members.mean(axis=0), sample_covariance(members)
    mean = array(np.atleast_1d(mean), "prior", (dim,))
    cov = array(np.atleast_2d(cov), "prior", (dim, dim))
    (semidefinite if singular else definite)(cov, "prior")
    return mean, cov


def _covariance(prior: Any) -> Any:
    """A frozen distribution's covariance, under the name that it has there."""
    for name in ("cov", "cov_object", "var"):
        if hasattr(prior, name):
            found = getattr(prior, name)
            return getattr(found, "covariance", found)
    raise ValueError(f"prior: needs a distribution with a covariance, got {type(prior).__name__}")


def members_of(
    prior: Any, members: int, leading: tuple[int, ...], dim: int, rng: np.random.Generator
) -> Array:
    """Members (*leading, N, d) of a prior of any kind that :meth:`Filter.start` lists.

    >>> members_of(([0.0], [[1.0]]), 5, (2,), 1, np.random.default_rng(0)).shape
    (2, 5, 1)
    """
    shape = (*leading, members, dim)
    if isinstance(prior, tuple) and len(prior) == 2:
        mean, cov = moments_of(prior, dim, singular=True)
        return unchecked(draw)(mean, cov, members, rng=rng, leading=leading)
    if isinstance(prior, GaussianMixture):
        return prior.rvs(math.prod(shape[:-1]), rng=rng).reshape(shape)
    if hasattr(prior, "rvs"):
        found = prior.rvs(size=math.prod(shape[:-1]), random_state=rng)
        return np.asarray(found, dtype=np.float64).reshape(shape)
    found = prior(members, rng=rng, leading=leading) if callable(prior) else prior
    out = array(found, "prior", (..., members, dim))
    if out.shape != shape and out.shape != shape[-2:]:
        raise ValueError(f"prior: needs shape {shape} or {shape[-2:]}, got {out.shape}")
    return np.broadcast_to(out, shape).copy()


def mixture_of(prior: Any, dim: int) -> GaussianMixture:
    """A prior of any kind that has moments, as a mixture.

    >>> mixture_of(([0.0], [[1.0]]), 1).size
    1
    """
    if not isinstance(prior, GaussianMixture):
        return GaussianMixture.gaussian(*moments_of(prior, dim))
    if prior.dim != dim:
        raise ValueError(f"prior: needs dimension {dim}, got {prior.dim}")
    return prior


def priors_of(prior: Any, count: int) -> list[Any]:
    """One prior for each agent, of one for all or a sequence.

    >>> len(priors_of(([0.0], [[1.0]]), 3)), len(priors_of([([0.0], [[1.0]])] * 2, 2))
    (3, 2)
    """
    pair = isinstance(prior, tuple) and len(prior) == 2
    one = isinstance(prior, GaussianMixture | np.ndarray) or hasattr(prior, "rvs")
    if one or (pair and _is_vector(prior[0])):
        return [prior] * count
    if not isinstance(prior, Sequence) or len(prior) != count:
        got = len(prior) if isinstance(prior, Sequence) else type(prior).__name__
        raise ValueError(f"prior: needs one for all or for each of {count} agents, got {got}")
    return list(prior)


def _is_vector(value: Any) -> bool:
    if isinstance(value, tuple | GaussianMixture) or hasattr(value, "rvs"):
        return False
    return all(np.ndim(v) == 0 for v in value)
