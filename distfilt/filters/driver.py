"""What all filters share: a filter supplies `start`, `step`, `summary`; this runs and records it.

Nothing here assumes one array for all agents, equal states, or readings of sensors.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Collection, Iterator, Mapping, Sequence, Sized
from dataclasses import dataclass, field, fields
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from ..checks import Array, array, callable_, count, generator, increasing, instance, number
from ..models import Model
from ..network import Channel, Faults, Graph
from ..progress import track
from .record import SCORES, Recorder
from .saving import State

if TYPE_CHECKING:
    import xarray

__all__ = ["Filter", "Late", "Summary", "TeamFilter", "final_state"]


@dataclass(frozen=True, eq=False)
class Late:
    """An observation that arrives after the time at which it was made.

    Parameters
    ----------
    agent : int
        Who observed.
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

    agent: int
    measured: float
    value: ArrayLike
    arrived: float

    def __post_init__(self) -> None:
        count(self.agent, "agent", at_least=0)
        number(self.measured, "measured")
        number(self.arrived, "arrived", above=self.measured)
        value = array(self.value, "value", (..., "m"), finite=False).copy()
        object.__setattr__(self, "value", value)


@dataclass(frozen=True, eq=False)
class Summary:
    """What a filter says of its state, for the record.

    Parameters
    ----------
    mean, variance : ndarray, (*runs, A, d)
        Estimates and their variances. Where agents' states differ in size, NaN fills the rest.
    covariance : ndarray, (*runs, A, d, d), optional
        For NEES.
    members : ndarray, (*runs, A, N, d), optional
        For CRPS, and for NEES where there is no covariance; without members CRPS is a Gaussian's.
    weights : ndarray, (*runs, A, N), optional
        The members' weights, if they differ.
    numbers : mapping of str to ndarray, (*runs, A)
        What else is worth a record, such as an effective sample size.

    Examples
    --------
    >>> import numpy as np
    >>> Summary(np.zeros((2, 3)), np.ones((2, 3))).numbers
    {}
    """

    mean: Array
    variance: Array
    covariance: Array | None = None
    members: Array | None = None
    weights: Array | None = None
    numbers: Mapping[str, Array] = field(default_factory=dict)


class Filter(ABC):
    """The contract of every filter: `start`, `step`, `summary`; then `steps` and `run` are here.

    A subclass also tells who takes part: `components` with their `units`, and `agents`.
    """

    @abstractmethod
    def start(self, prior: Any, *, rng: Any, runs: tuple[int, ...] = (), t: float = 0.0) -> Any:
        """The state before the first step."""

    @abstractmethod
    def step(self, state: Any, t: float, observations: Any) -> Any:
        """The state at time `t`, after what was observed there."""

    @abstractmethod
    def summary(self, state: Any) -> Summary:
        """Estimates and spreads of a state."""

    def past(self, state: Any) -> tuple[tuple[float, Summary], ...]:
        """Earlier times that the state keeps, oldest first, and what is believed of them by now."""
        instance(state, "state", State)
        return ()

    @property
    @abstractmethod
    def components(self) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """Names and units of the state's components."""

    @property
    @abstractmethod
    def agents(self) -> tuple[str, ...]:
        """Names of the agents."""

    def series(self, observations: Any, times: Array) -> Sequence[Any]:
        """What is observed at each of `times`, one entry for :meth:`step` each.

        Here `observations` has one entry for each time; filters that read sensors take one series
        for each agent instead.
        """
        size = increasing(times, "times").size
        if not isinstance(observations, Sequence | np.ndarray) or len(observations) != size:
            got = len(observations) if isinstance(observations, Sized) else repr(observations)
            raise ValueError(f"observations: needs one for each time ({size}), got {got}")
        return list(observations)

    def steps(
        self, state: Any, times: ArrayLike, observations: Any, *, late: Sequence[Late] = (),
        progress: bool = False,
    ) -> Iterator[Any]:
        """The states at `times`, one after the other; arguments as in :meth:`run`."""
        instance(state, "state", State)
        grid = increasing(times, "times")
        series = self.series(observations, grid)
        waiting = _waiting(late)
        instance(progress, "progress", bool)
        if waiting and (not grid.size or waiting[-1].arrived > grid[-1]):
            end = f"{grid[-1]:g}" if grid.size else "no time at all"
            raise ValueError(f"late: needs arrivals up to {end}, got {waiting[-1].arrived:g}")
        for k, t in enumerate(track(grid, show=progress)):
            due = [item for item in waiting if item.arrived <= t]
            waiting = waiting[len(due) :]
            options = {"late": due} if due else {}
            state = self.step(state, float(t), series[k], **options)
            yield state

    def run(
        self, state: Any, times: ArrayLike, observations: Any, *, truth: ArrayLike | None = None,
        scores: Collection[str] = SCORES, late: Sequence[Late] = (), progress: bool = False,
    ) -> xarray.Dataset:
        """Step through a series and record it.

        Parameters
        ----------
        state : State
            Where to begin.
        times : array_like, (T,)
            Strictly increasing, in s; steps may differ in length.
        observations : sequence of length A
            Per agent (T, *runs, m) or (T, m), or None. NaN marks what is missing.
        truth : array_like, (T, *runs, d), optional
            If given, the scores are recorded too.
        scores : collection of {"squared_error", "nees", "crps"}
            Which of them; CRPS costs about as much as an ensemble filter.
        late : sequence of Late
            Each is taken in at the first of `times` that is not before its arrival.
        progress : bool
            Show a progress bar when a person watches.

        Returns
        -------
        xarray.Dataset
            Axes ``time``, ``run`` (``run0``, ``run1``, … where there are several), ``agent``,
            ``component``; units and meaning stand in the attributes. ``mean``, ``variance`` and,
            with `truth`, ``squared_error`` and ``crps`` for each component; ``spread`` and
            ``total_squared_error`` add components up, whatever their units, and say so; ``nees``
            is d on average for a consistent filter. ``messages``, ``scalars``, ``bytes``, ``lost``
            and ``rounds`` are those of each step, the same names with ``_total`` their sums.
            :func:`final_state` gives the state at the end.
        """
        instance(state, "state", State)
        grid = increasing(times, "times")
        recorder = Recorder(self, grid, state, truth, scores)
        last = state
        for last in self.steps(state, grid, observations, late=late, progress=progress):
            recorder.add(last, self.summary(last))
        return recorder.dataset(last)

    def smooth(
        self, state: Any, times: ArrayLike, observations: Any, *, truth: ArrayLike | None = None,
        scores: Collection[str] = SCORES, late: Sequence[Late] = (), progress: bool = False,
    ) -> xarray.Dataset:
        """Fixed-lag smoothing: of each time what is believed when `lag` more have been observed.

        Parameters and result are those of :meth:`run`. The filter needs a `lag`; near the end
        fewer times follow, and the last estimate is the filter's.
        """
        instance(state, "state", State)
        grid = increasing(times, "times")
        recorder = Recorder(self, grid, state, truth, scores)
        waiting: list[tuple[Any, Summary]] = []
        last = state
        for last in self.steps(state, grid, observations, late=late, progress=progress):
            earlier = self.past(last)
            if not earlier:
                raise ValueError("lag: needs at least 1 for smoothing, got 0")
            believed = [summary for t, summary in earlier if t > state.t]
            first = len(waiting) - len(believed)
            renewed = zip((s for s, _ in waiting[first:]), believed, strict=True)
            waiting = [*waiting[:first], *renewed, (last, self.summary(last))]
        for then, summary in waiting:
            recorder.add(then, summary)
        return recorder.dataset(last)


def _waiting(late: Any) -> list[Late]:
    """Late observations by their arrival."""
    instance(late, "late", Sequence)  # type: ignore[type-abstract]
    return sorted((instance(item, "late", Late) for item in late), key=lambda item: item.arrived)


class TeamFilter(Filter):
    """What filters of several agents share: names, and faults of the channel between them.

    A subclass is a dataclass with these fields; one whose agents do not agree has no `agreement`.

    Examples
    --------
    >>> from distfilt.filters import GaussianFilter
    >>> issubclass(GaussianFilter, TeamFilter)
    True
    """

    names: Any
    faults: Any
    graph: Any
    agreement: Any = None

    @property
    @abstractmethod
    def count(self) -> int:
        """Number A of agents."""

    @property
    def agents(self) -> tuple[str, ...]:
        """Names of the agents; their numbers by default."""
        return tuple(self.names) or tuple(str(k) for k in range(self.count))

    def check_team(self) -> None:
        """Refuse names that are not one for each agent, faults with a delay, and no flags.

        A step's messages arrive within it or never. A family's flags are its fields that are True
        or False by default.
        """
        for option in fields(self):  # type: ignore[arg-type]
            if isinstance(option.default, bool):
                instance(getattr(self, option.name), option.name, bool)
        faults = self.faults
        if faults is not None and (not isinstance(faults, Faults) or faults.late):
            raise ValueError(f"faults: needs Faults without a delay, got {faults!r}")
        names = instance(self.names, "names", Collection)  # type: ignore[type-abstract]
        if isinstance(names, str) or not all(isinstance(name, str) for name in names):
            raise ValueError(f"names: needs a list of texts, got {names!r}")
        if len(names) not in (0, self.count):
            raise ValueError(f"names: needs {self.count} names, got {len(names)}")

    @staticmethod
    def check_alone(rng: Any, runs: Any) -> None:
        """Refuse runs, for a filter that takes one at a time and draws nothing."""
        if rng is not None:
            generator(rng)
        if runs != ():
            raise ValueError(f"runs: needs (), one run at a time, got {runs!r}")

    def check_network(self) -> None:
        """The same, for a filter whose agents talk and agree on a graph, which may move."""
        self.check_team()
        if isinstance(self.graph, Graph):
            self.graph_at()
        elif self.graph is not None:
            callable_(self.graph, "graph")
        if self.agreement is not None:
            callable_(self.agreement, "agreement")

    def graph_at(self, *now: Any) -> Graph:
        """The graph, or what the function that stands for it returns: one of all the agents."""
        found = self.graph if isinstance(self.graph, Graph) else self.graph(*now)
        if instance(found, "graph", Graph).size != self.count:
            raise ValueError(f"graph: needs {self.count} agents, got {found.size}")
        return found

    def channel(self, state: State, t: float) -> Channel | None:
        """The door of this step; without a graph there is none."""
        if self.graph is None:
            return None
        return Channel(
            self.graph_at(t), ledger=state.ledger, runs=state.runs, faults=self.faults, t=t
        )


def described(model: Model) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Names and units of a model's components; their numbers where it has no names."""
    names = tuple(model.names) or tuple(str(k) for k in range(model.dim))
    return names, tuple(model.units) or ("",) * model.dim


def final_state(run: xarray.Dataset) -> State:
    """The state in which a run ended, to be saved or gone on from.

    Parameters
    ----------
    run : xarray.Dataset
        As :meth:`Filter.run` returned it; a selection or a copy has no state.

    Examples
    --------
    >>> import xarray
    >>> final_state(xarray.Dataset())
    Traceback (most recent call last):
    ValueError: run: needs the Dataset that a filter's run returned, got one without a state
    """
    state = getattr(run, "encoding", {}).get("final_state")
    if not isinstance(state, State):
        raise ValueError(
            "run: needs the Dataset that a filter's run returned, got one without a state"
        )
    return state
