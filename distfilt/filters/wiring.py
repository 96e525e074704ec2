"""What filters that read sensors have in common: a model, agents with sensors, and a network."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import KW_ONLY, dataclass
from itertools import pairwise
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from ..checks import (
    Array,
    array,
    choice,
    count,
    covariance,
    generator,
    instance,
    number,
)
from ..ensembles import draw
from ..models import Model
from ..network import Channel, Faults, Graph, Ledger
from ..sensors import Sensor
from .driver import Late, Summary, TeamFilter, described
from .heard import Heard, gather
from .observations import at_one_time, over_times
from .saving import State
from .stepping import SensorState, Step

__all__ = ["SensorFilter"]

Prior = ArrayLike | Callable[..., Array] | tuple[ArrayLike, ArrayLike]
S = TypeVar("S", bound=SensorState)


@dataclass(frozen=True, eq=False)
class SensorFilter(TeamFilter):
    """The part of a filter that knows the agents, and what every family asks of it.

    Parameters
    ----------
    model : Model
        How the state moves; known to all agents.
    sensors : sequence of Sensor or None, length A
        What each agent sees; None for an agent without a sensor. Neighbours know each other's.
    graph : Graph, or callable t -> Graph, optional
        Who hears whom; a single agent needs none.
    agreement : callable, optional
        What agents do after the update to agree; none by default.
    share : bool
        Whether agents send their observations to those that hear them, who use them too.
    faults : Faults, optional
        Messages lost and agents silenced; a lost observation is a missing one. A delay is not
        accepted: an observation that comes late has its own time, pass it as :class:`Late`.
    lag : int
        How many earlier times are kept, for late observations and for smoothing.
    names : sequence of str
        Names of the agents; their numbers by default.
    failures : {"raise", "keep"}
        What happens when one run of a batch fails: a :class:`FilterError` that names it, or the
        other runs go on and the failed one is recorded as NaN.
    """

    model: Model
    sensors: Sequence[Sensor | None]
    graph: Graph | Callable[[float], Graph] | None = None
    _: KW_ONLY
    agreement: Callable[..., Any] | None = None
    share: bool = True
    faults: Faults | None = None
    lag: int = 0
    names: Sequence[str] = ()
    failures: str = "raise"

    def __post_init__(self) -> None:
        instance(self.model, "model", Model)
        if isinstance(self.sensors, Sensor) or not isinstance(self.sensors, Sequence):
            raise ValueError(
                f"sensors: needs one Sensor or None for each agent, in a list, "
                f"got {type(self.sensors).__name__}"
            )
        object.__setattr__(self, "sensors", tuple(self.sensors))
        for sensor in self.sensors:
            if sensor is not None and not isinstance(sensor, Sensor):
                raise ValueError(f"sensors: needs Sensor or None, got {type(sensor).__name__}")
        count(len(self.sensors), "sensors")
        if self.graph is None and len(self.sensors) > 1:
            raise ValueError(f"graph: needs a Graph of {len(self.sensors)} agents, got None")
        self.check_network()
        count(self.lag, "lag", at_least=0)
        choice(self.failures, "failures", ("raise", "keep"))

    @property
    def count(self) -> int:
        """Number A of agents."""
        return len(self.sensors)

    @property
    def components(self) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """Names and units of the state's components."""
        return described(self.model)

    def past(self, state: SensorState) -> tuple[tuple[float, Summary], ...]:
        """Earlier times that the state keeps, oldest first, and what is believed of them by now."""
        earlier = instance(state, "state", SensorState).earlier
        return tuple((then.t, self.summary(then)) for then in earlier)

    def series(self, observations: Any, times: Array) -> Sequence[Any]:
        """Per time the agents' observations, from per agent their series (T, *runs, m)."""
        grid, series = over_times(observations, self.sensors, times)
        return [[None if o is None else o[k] for o in series] for k in range(grid.size)]

    def leading(self, runs: tuple[int, ...], sets: int | None = None) -> tuple[int, ...]:
        """Leading axes (*runs, A); with `sets` there are so many of them in the agents' place."""
        instance(runs, "runs", Collection)  # type: ignore[type-abstract]
        agents = len(self.sensors) if sets is None else count(sets, "sets")
        return (*(count(n, "runs") for n in runs), agents)

    def first(
        self, kind: type[S], t: float, rng: np.random.Generator | None, *belief: Any,
        draws: bool = True,
    ) -> S:  # fmt: skip
        """The state at the start; what steps draw comes from a child of the generator."""
        source = None if rng is None else generator(rng)
        child = source.spawn(1)[0] if source and instance(draws, "draws", bool) else None
        instance(kind, "kind", type)
        return kind(number(t, "t"), Ledger.empty(len(self.sensors)), child, *belief)

    def moments(self, prior: Any, *, semidefinite: bool = False) -> tuple[Array, Array]:
        """The mean and the covariance that a Gaussian prior is given by, checked."""
        if not isinstance(prior, tuple) or len(prior) != 2:
            raise ValueError(f"prior: needs a tuple (mean, cov), got {type(prior).__name__}")
        d, singular = self.model.dim, instance(semidefinite, "semidefinite", bool)
        cov = covariance(prior[1], "prior", d, semidefinite=singular)
        return array(prior[0], "prior", (d,)), cov

    def drawn(
        self, prior: Prior, members: int, runs: tuple[int, ...], rng: np.random.Generator,
        sets: int | None = None,
    ) -> Array:  # fmt: skip
        """Members (*runs, A, N, d) of a Gaussian (mean, cov), of a function, or as they are given.

        The function is called as ``prior(members, rng=rng, leading=(*runs, A))``. With `sets` there
        are so many of them in place of one for each agent.
        """
        lead, dim = self.leading(runs, sets), self.model.dim
        generator(rng)
        if isinstance(prior, tuple) and len(prior) == 2:
            mean, cov = self.moments(prior, semidefinite=True)
            return draw(mean, cov, members, rng=rng, leading=lead)
        found = prior(members, rng=rng, leading=lead) if callable(prior) else prior
        shape = (*lead, members, dim)
        out = array(found, "prior", (..., members, dim))
        if out.shape != shape and out.shape != shape[-2:]:
            raise ValueError(f"prior: needs shape {shape} or {shape[-2:]}, got {out.shape}")
        return np.broadcast_to(out, shape).copy()

    def elapsed(self, state: State, t: float) -> float:
        """Seconds from the state's time to `t`, which has to be later."""
        return number(t, "t", above=instance(state, "state", State).t) - state.t

    def observed(
        self, state: State, observations: Sequence[ArrayLike | None]
    ) -> list[Array | None]:
        """Observations of one time, checked, per agent (*runs, m) or None."""
        return at_one_time(observations, self.sensors, instance(state, "state", State).runs)

    def gather(self, observed: Sequence[Array | None], channel: Channel | None) -> list[Heard]:
        """What every agent knows of the observations once they are shared.

        Examples
        --------
        >>> from distfilt.filters import GaussianFilter
        >>> from distfilt.models import constant_velocity
        >>> from distfilt.sensors import direct
        >>> f = GaussianFilter(constant_velocity(sigma=0.1), [direct([0], std=1.0)])
        >>> [group.target.tolist() for group in f.gather([np.array([1.5])], None)]
        [[[1.5]]]
        """
        return gather(observed, self.sensors, channel if self.share else None)

    def begin(
        self, state: SensorState, kind: type[SensorState], t: float,
        observations: Sequence[ArrayLike | None], late: Sequence[Late], sizes: tuple[int, ...] = (),
    ) -> Step:  # fmt: skip
        """The step from a state of this kind to `t`, with its inputs checked.

        `sizes` are those of an agent's belief, where the filter says them.
        """
        instance(state, "state", instance(kind, "kind", type))
        instance(late, "late", Sequence)  # type: ignore[type-abstract]
        needed = (len(self.sensors), *instance(sizes, "sizes", tuple))
        got = state.belief.shape[len(state.runs) :]
        if got[: len(needed)] != needed:
            raise ValueError(f"state: needs {needed} for each run, got {got}")
        dt, seen = self.elapsed(state, t), self.observed(state, observations)
        times = (*state.times, state.t)[-self.lag :] if self.lag else ()
        shortest = min((b - a for a, b in pairwise((*times, float(t)))), default=0.0)
        old = [self._late(item, times, shortest, state) for item in late]
        readings = [*old, (len(times), seen)]
        return Step(self, state, float(t), dt, self.channel(state, t), times, readings)

    def _late(
        self, item: Late, times: Sequence[float], shortest: float, state: State
    ) -> tuple[int, list[Array | None]]:
        """Where among the kept times a late observation belongs, and the observations of then.

        A sum of steps may differ by rounding, but by far less than the `shortest` of them.
        """
        instance(item, "late", Late)
        away = [abs(t - item.measured) for t in times]
        slack = min(1e-9 * max(1.0, abs(item.measured)), 1e-3 * shortest)
        if not away or min(away) > slack:
            known = ", ".join(f"{t:g}" for t in times) or "none (lag = 0)"
            raise ValueError(
                f"late: needs an earlier time that is kept ({known}), got {item.measured:g}"
            )
        if item.agent >= len(self.sensors):
            raise ValueError(f"late: needs an agent below {len(self.sensors)}, got {item.agent}")
        sensor = self.sensors[item.agent]
        if sensor is not None and sensor.uses_previous:
            raise ValueError(f"late: a {sensor.kind} sensor cannot be late, it compares two times")
        observations: list[ArrayLike | None] = [None] * len(self.sensors)
        observations[item.agent] = item.value
        return away.index(min(away)), self.observed(state, observations)
