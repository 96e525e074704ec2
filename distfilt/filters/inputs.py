"""What comes in: priors of any kind, readings at one time, late ones, and events of any order."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import KW_ONLY, dataclass
from itertools import pairwise
from typing import Annotated, Any

import numpy as np

from ..ensembles import draw, sample_covariance
from ..mixtures import GaussianMixture
from ..sensors import Sensor
from ..validation import (
    ALLOW_NAN,
    Array,
    FrozenModel,
    NonNegativeInt,
    check_array,
    check_increasing,
    check_positive_definite,
)
from ..validation.checks import all_finite

__all__ = [
    "Observation",
    "match_delayed",
    "draw_members",
    "prior_mixtures",
    "prior_moments",
    "plan_steps",
    "read_observations",
    "sensor_of",
]

_LISTED = list, Sequence, np.ndarray


@dataclass(frozen=True, eq=False)
class Observation(FrozenModel):
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
        When it became known, in s, if that was later: for the `delayed` of :meth:`Filter.run`.

    Examples
    --------
    >>> Observation(2.0, 0, [1.5]).sensor
    0
    """

    t: float
    agent: NonNegativeInt
    value: Annotated[Array, "... m", ALLOW_NAN]
    sensor: NonNegativeInt | Sensor = 0
    _: KW_ONLY
    metadata: tuple[float, ...] = ()
    arrival_time: float | None = None


def sensor_of(f: Any, reading: Observation) -> Sensor:
    """The sensor that made a reading: its own, or one of the agent's."""
    if isinstance(reading.sensor, Sensor):
        return reading.sensor
    own: tuple[Sensor, ...] = f.agent_sensors[reading.agent]
    if reading.sensor >= len(own):
        raise ValueError(
            f"observations must be one of the {len(own)} sensors of agent "
            f"{reading.agent}, got {reading.sensor}"
        )
    return own[reading.sensor]


def read_observations(
    f: Any, observations: Any, runs: tuple[int, ...], t: float
) -> list[list[Observation]]:
    """What each agent of a filter observed at one time, checked.

    >>> from distfilt.filters import GaussianFilter
    >>> from distfilt.models import constant_velocity
    >>> from distfilt.sensors import component
    >>> f = GaussianFilter(constant_velocity(sigma=0.1), [component([0], std=1.0)])
    >>> [[said.value for said in own] for own in read_observations(f, [[1.5]], (), 0.0)]
    [[array([1.5])]]
    """
    out: list[list[Observation]] = []
    for agent, given in enumerate(one_each(observations, f.n_agents)):
        own = f.agent_sensors[agent]
        plain = (
            type(given) is np.ndarray and given.dtype == np.float64 and len(own) == 1
        )
        if (
            plain and given.shape == (*runs, own[0].dim) and all_finite(given)
        ):  # as nearly all are
            out.append([Observation.construct(t, agent, given)])
            continue
        name = f"observations[{agent}]"
        several = given if _are_readings(given) else () if given is None else (given,)
        found = [
            _complete(f, _read(f, one, agent, t, name), runs, name) for one in several
        ]
        out.append([said for said in found if said is not None])
    return out


def one_each(observations: Any, agents: int) -> Any:
    """Observations in a list, one entry for each agent.

    >>> one_each([1.0, 2.0], 3)
    Traceback (most recent call last):
    ValueError: observations must be a list, one for each of 3 agents, got 2
    """
    observations = (
        observations.to_numpy() if hasattr(observations, "to_numpy") else observations
    )
    listed = isinstance(observations, _LISTED)
    if not listed or len(observations) != agents:
        got = len(observations) if listed else type(observations).__name__
        raise ValueError(
            f"observations must be a list, one for each of {agents} agents, got {got}"
        )
    return observations


def _read(f: Any, given: Any, agent: int, t: float, name: str) -> Observation:
    """A reading of this agent and time, or what its only sensor read."""
    if isinstance(given, Observation):
        if (given.agent, given.t) != (agent, t):
            got = f"one of agent {given.agent} at t = {given.t:g}"
            raise ValueError(
                f"{name} must be a Reading of agent {agent} at t = {t:g}, got {got}"
            )
        if given.arrival_time is not None and given.arrival_time > t:
            raise ValueError(
                f"{name} must be what has arrived, got a Reading of {given.arrival_time:g}"
            )
        return given
    own = f.agent_sensors[agent]
    if len(own) != 1:
        needs = (
            "a Reading of each sensor" if own else "None for an agent without a sensor"
        )
        raise ValueError(f"{name} must be {needs}, got an array")
    return Observation.construct(
        t, agent, check_array(given, name, (..., own[0].dim), finite=False)
    )


def _complete(
    f: Any, said: Observation, runs: tuple[int, ...], name: str
) -> Observation | None:
    """A reading with a value for each run; None if nothing of it is there."""
    value = said.value
    dim = sensor_of(f, said).dim
    if np.isinf(value).any():
        raise ValueError(f"{name} must be numbers or NaN, got infinity")
    if np.isnan(value).all():
        return None
    if value.shape == (*runs, dim):
        return said
    if value.shape != (dim,):
        raise ValueError(f"{name} must have shape {(*runs, dim)}, got {value.shape}")
    return said.replace(value=np.broadcast_to(value, (*runs, dim)))


def match_delayed(
    f: Any, late: Sequence[Observation], state: Any, t: float
) -> list[Observation]:
    """Late readings, each at that one of the kept times to which it belongs.

    A sum of steps may differ by rounding, but by far less than the shortest of them.
    """
    times = state.lagged_times(f.lag, t)
    shortest = min((b - a for a, b in pairwise((*times, t))), default=0.0)
    out = []
    for item in late:
        near = min(times, key=lambda known: abs(known - item.t), default=np.inf)
        if abs(near - item.t) > min(1e-9 * max(1.0, abs(item.t)), 1e-3 * shortest):
            known = ", ".join(f"{t:g}" for t in times) or "none (lag = 0)"
            raise ValueError(
                f"delayed must be an earlier time that is kept ({known}), got {item.t:g}"
            )
        if item.agent >= f.n_agents:
            raise ValueError(
                f"delayed must be an agent below {f.n_agents}, got {item.agent}"
            )
        if (sensor := sensor_of(f, item)).uses_previous:
            raise ValueError(
                f"delayed: a {sensor.kind} sensor cannot be late, it compares two times"
            )
        said = _complete(f, item, state.runs, "delayed")
        if said is not None:
            out.append(said.replace(t=near))
    return out


def plan_steps(
    f: Any, state: Any, times: Any, observations: Any
) -> tuple[Array, Iterator[Any]]:
    """The times of a run's steps, and an iterator over what is observed at each of them.

    >>> from distfilt.filters import GaussianFilter
    >>> from distfilt.models import constant_velocity
    >>> from distfilt.sensors import component
    >>> f = GaussianFilter(
    ...     constant_velocity(sigma=1.0), [[component([0], std=1.0)] * 2]
    ... )
    >>> seen = [
    ...     Observation(1.0, 0, [2.0], 1),
    ...     Observation(0.5, 0, [3.0]),
    ...     Observation(1.0, 0, [1.0]),
    ... ]
    >>> times, entries = plan_steps(f, f.start((np.zeros(4), np.eye(4))), None, seen)
    >>> times, [[float(said.value[0]) for said in own] for (own,) in entries]
    (array([0.5, 1. ]), [[3.0], [2.0, 1.0]])
    """
    grid = np.zeros(0) if times is None else check_array(times, "times", ("T",))
    check_increasing(grid, "times")
    entries: Iterator[Any]
    if _are_readings(observations) and (times is None or observations):
        at: dict[float, list[list[Observation]]] = {
            t: [[] for _ in range(f.n_agents)] for t in grid
        }
        for event in observations:
            if event.agent >= f.n_agents:
                raise ValueError(
                    f"observations must have agents below {f.n_agents}, got {event.agent}"
                )
            at.setdefault(event.t, [[] for _ in range(f.n_agents)])[event.agent].append(
                event
            )
        grid = np.array(sorted(at))
        entries = iter([at[t] for t in grid])
    elif times is None:
        raise ValueError(
            "times must be them, unless all observations are Readings, got None"
        )
    else:
        # A table whose columns have names would give a column where a row is asked for.
        each = [
            o if o is None or isinstance(o, list | tuple) else np.atleast_1d(o)
            for o in one_each(observations, f.n_agents)
        ]
        for agent, series in enumerate(each):
            if series is not None and (got := len(series)) != grid.size:
                raise ValueError(
                    f"observations: needs ({grid.size}, ..., m) for agent {agent}, got {got}"
                )
            if isinstance(series, np.ndarray) and not isinstance(f.sensors, int):
                _warn_of_degrees(f.agent_sensors[agent], series, agent)
        entries = (
            [None if o is None else o[k] for o in each] for k in range(grid.size)
        )
    if grid.size and grid[0] < state.t:
        raise ValueError(
            f"times must be times from the state's {state.t:g} on, got {grid[0]:g}"
        )
    return grid, entries


def _warn_of_degrees(own: Sequence[Sensor], series: Array, agent: int) -> None:
    """Warn of angles that are more than four turns from what they are wrapped to."""
    wraps = len(own) == 1 and own[0].residual_function
    if not wraps or series.shape[-1:] != (own[0].dim,):
        return
    y = np.nan_to_num(series.astype(np.float64))
    if (most := np.abs(y - wraps(y, 0 * y)).max(initial=0.0) / (2 * np.pi)) > 4:
        text = f"observations[{agent}] must be angles in rad, got some {most:.0f} turns off"
        warnings.warn(text, RuntimeWarning, stacklevel=4)


def _are_readings(given: Any) -> bool:
    """Whether these are events: Readings in a list, and nothing else."""
    return isinstance(given, list | tuple) and all(
        isinstance(item, Observation) for item in given
    )


def _is_pair(prior: Any) -> bool:
    """Whether this is (mean, cov), and no list of two members."""
    if type(prior) is list and any(
        type(p) is tuple and np.ndim(p[-1]) > 1 for p in prior
    ):
        raise ValueError("prior must be one for all agents, got a list of (mean, cov)")
    pair = isinstance(prior, tuple | list) and len(prior) == 2
    return pair and (isinstance(prior, tuple) or np.ndim(prior[0]) < np.ndim(prior[1]))


def prior_moments(
    prior: Any, dim: int, word: str = "semidefinite"
) -> tuple[Array, Array]:
    """Mean (d,) and covariance (d, d), definite or semidefinite, of a prior that has them.

    >>> from scipy.stats import multivariate_normal
    >>> prior_moments(multivariate_normal([1.0], [[4.0]]), 1)
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
        raise ValueError(
            f"prior must be (mean, cov), or have a mean and a covariance, got {got}"
        )
    else:
        members = check_array(prior, "prior", ("N", dim))
        if len(members) <= dim:
            raise ValueError(
                f"prior must have more than {dim} members, got {len(members)}"
            )
        mean = members.mean(axis=0)
        cov = sample_covariance(members)
    mean = check_array(np.atleast_1d(mean), "prior", (dim,))
    cov = check_array(cov, "prior")
    if cov.shape != (dim, dim) and not dim == cov.size == 1:
        raise ValueError(
            f"prior must be a covariance of shape {(dim, dim)}, got {cov.shape}"
        )
    check_positive_definite(cov := cov.reshape(dim, dim), "prior", word)
    return mean, cov


def draw_members(
    prior: Any,
    members: int,
    leading: tuple[int, ...],
    dim: int,
    rng: np.random.Generator,
) -> Array:
    """Members (*leading, N, d) of a prior of any kind that :meth:`Filter.start` lists.

    >>> draw_members(([0.0], [[1.0]]), 5, (2,), 1, np.random.default_rng(0)).shape
    (2, 5, 1)
    """
    shape = (*leading, members, dim)
    if _is_pair(prior):
        mean, cov = prior_moments(prior, dim)
        return draw(mean, cov, members, rng=rng, leading=leading)
    if hasattr(prior, "rvs"):
        word = "rng" if isinstance(prior, GaussianMixture) else "random_state"
        found = prior.rvs(math.prod(shape[:-1]), **{word: rng})
        return check_array(found.reshape(*shape[:-1], -1), "prior", shape)
    found = prior(members, rng=rng, leading=leading) if callable(prior) else prior
    out = check_array(found, "prior", (..., members, dim))
    if out.shape != shape and out.shape != shape[-2:]:
        raise ValueError(
            f"prior must have shape {shape} or {shape[-2:]}, got {out.shape}"
        )
    return np.broadcast_to(out, shape).copy()


def prior_mixtures(prior: Any, dim: int, count: int) -> tuple[GaussianMixture, ...]:
    """A mixture for each agent, of one prior for all or of a list with one each.

    >>> [mixture.n_components for mixture in prior_mixtures(([0.0], [[1.0]]), 1, 2)]
    [1, 1]
    """
    given = prior if isinstance(prior, list) else [prior] * count
    if len(given) != count:
        raise ValueError(
            f"prior must be one for all or for each of {count}, got {len(given)}"
        )
    out = []
    for one in given:
        mixed = isinstance(one, GaussianMixture)
        out.append(
            one
            if mixed
            else GaussianMixture.gaussian(*prior_moments(one, dim, "definite"))
        )
        if out[-1].dim != dim:
            raise ValueError(f"prior must have dimension {dim}, got {out[-1].dim}")
    return tuple(out)
