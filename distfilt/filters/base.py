"""The contract of all filters: a family supplies `begin`, `advance`, `summary`; the rest is here.

One order of the constructor's arguments, one `start`, `step`, `run` and `smooth`, one meaning of
each option. An option that means nothing to a family is refused by its name, with the reason.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, fields
from functools import cached_property
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

import numpy as np

from ..doors import Array, Bounds, Index, Positive, Record, Rng, door
from ..models import Model
from ..network import Channel, Faults, Ledger
from ..network.channel import fused_kind
from ..network.graphs import as_graph
from ..sensors import Sensor
from .inputs import Reading, belated, planned, said_by_all
from .record import SCORES, Score, Summary, recorded
from .saving import State
from .step import RECOVERABLE, FilterError, Step, of_the_call

if TYPE_CHECKING:
    import xarray

__all__ = ["Filter"]


@dataclass(frozen=True, eq=False)
class Filter(Record, ABC):
    """What every family of filters is made of.

    Parameters
    ----------
    model : Model
        How the state moves; known to all agents.
    sensors : sequence of length A
        What each agent sees: a Sensor, several in a list, or None. Neighbours know each other's.
        One that moves comes with each :class:`Reading`, and of several each reading is one.
    graph : Graph, networkx graph, matrix or edges, or callable t -> one of them, optional
        Who hears whom; needed where anybody speaks. At a time without any link nobody does.
    agreement : callable, optional
        ``agreement(belief, channel) -> belief``: what agents do after the update to agree, if they
        do; the belief is the family's. A rule of this package that fuses something else is refused.
    share : bool
        Whether agents send their readings to those that hear them, who use them too.
    faults : Faults, optional
        Messages lost and agents silenced; a lost observation is a missing one. A delay is not
        accepted: an observation that comes late has its own time, pass it as `late`.
    lag : int
        How many earlier times are kept, for late observations and for smoothing.
    names : sequence of str
        Names of the agents; their numbers by default.
    failures : {"raise", "keep"}
        What happens when one run of a batch fails: a :class:`FilterError` that names it, or the
        other runs go on and the failed one is recorded as NaN. Where an `agreement` raises, each
        run is asked alone.
    gate : float, optional
        How likely a good reading passes, in (0, 1). Each sensor's reading is tested against what
        was predicted; those that fail are left out and counted as ``refused`` in the record.
    every : float, optional
        Agents exchange something every so many seconds only. Readings wait for it and are told as
        late ones, so that a `lag` has to reach back.

    Notes
    -----
    A family of one's own is a dataclass that derives from this, names the kind of its `state`, and
    has three methods: `begin` gives the fields of the first state, `advance` makes the next one of
    a :class:`Step`, `summary` tells what is believed. `draws` says that steps need a generator,
    `joins`, beside a `summary`, that this takes several states as one with an axis more in front,
    `fuses` what its agreements fuse, and `unused` why options that it cannot have are refused.

    Examples
    --------
    >>> import networkx as nx
    >>> from distfilt.filters import GaussianFilter
    >>> from distfilt.models import constant_velocity
    >>> from distfilt.network import intersection
    >>> from distfilt.sensors import direct
    >>> walk, two = constant_velocity(sigma=1.0), [direct([0], std=1.0), None]
    >>> for graph in (nx.path_graph(2), lambda t: [(0, 1)]):
    ...     f = GaussianFilter(walk, two, graph)
    ...     print(f.step(f.start((np.zeros(4), np.eye(4))), 0.0, [[1.0], None]).means[:, 0])
    [0.5 0.5]
    [0.5 0.5]
    >>> GaussianFilter(walk, two, graph, agreement=intersection)
    Traceback (most recent call last):
    ValueError: agreement: needs a rule that fuses gaussians, got one of ensembles
    """

    model: Model
    sensors: Sequence[Sensor | Sequence[Sensor] | None]
    graph: Any = None
    _: KW_ONLY
    agreement: Callable[..., Any] | None = None
    share: bool = True
    faults: Faults | None = None
    lag: Index = 0
    names: Sequence[str] = ()
    failures: Literal["raise", "keep"] = "raise"
    gate: Annotated[float, Bounds(above=0, below=1)] | None = None
    every: Positive | None = None

    state: ClassVar[type[Any]] = State
    draws: ClassVar[bool] = False
    batched: ClassVar[bool] = True
    joins: ClassVar[bool] = False
    changes: ClassVar[bool] = False
    fuses: ClassVar[str | None] = None
    unused: ClassVar[Mapping[str, str]] = {}

    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        # A summary of one's own may be right for single states only.
        if "summary" in vars(cls) and "joins" not in vars(cls):
            cls.joins = False

    def __post_init__(self) -> None:
        super().__post_init__()
        for option in fields(self):
            if option.name in self.unused and getattr(self, option.name) != option.default:
                raise ValueError(f"{option.name}: {self.unused[option.name]}")
        self.check_parts()
        if self.faults is not None and self.faults.late:
            raise ValueError(f"faults: needs Faults without a delay, got {self.faults!r}")
        if self.names and not len(self.names) == len({*self.names}) == self.count:
            raise ValueError(f"names: needs {self.count} different names, got {[*self.names]}")
        kind = None if self.agreement is None else fused_kind(self.agreement)
        if kind is not None and kind != self.fuses:
            raise ValueError(f"agreement: needs a rule that fuses {self.fuses}, got one of {kind}")
        if self.every is not None and self.share and self.graph is not None and not self.lag:
            raise ValueError("lag: needs at least 1 for readings that wait for a contact, got 0")

    def check_parts(self) -> None:
        """Refuse sensors or a graph that this family cannot have."""
        if not self.changes and any(s.uses_previous for own in self.team for s in own):
            raise ValueError("sensors: needs sensors of the present state, got a differential")
        speak = self.share or self.agreement is not None
        if self.graph is None and self.count > 1 and speak:
            raise ValueError(f"graph: needs a Graph of {self.count} agents, got None")
        if self.graph is not None and not callable(self.graph):
            object.__setattr__(self, "graph", as_graph(self.graph, self.count, self.names))

    @cached_property
    def team(self) -> tuple[tuple[Sensor, ...], ...]:
        """Each agent's sensors."""
        several = [() if own is None else own for own in self.sensors]
        return tuple(own if isinstance(own, tuple) else (own,) for own in several)

    @cached_property
    def count(self) -> int:
        """Number A of agents."""
        return len(self.sensors)

    @property
    def components(self) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """Names and units of the state's components; numbers where it has no names."""
        model = self.model
        names = tuple(model.names) or tuple(str(k) for k in range(model.dim))
        return names, tuple(model.units) or ("",) * model.dim

    @property
    def agents(self) -> tuple[str, ...]:
        """Names of the agents; their numbers by default."""
        return tuple(self.names) or tuple(str(k) for k in range(self.count))

    def channel(self, state: State, t: float) -> Channel | None:
        """The door of this step; none where nobody can speak, or it is not yet time."""
        if self.graph is None or not self._contact(state.t, t):
            return None
        graph = self.graph(t) if callable(self.graph) else self.graph
        graph = as_graph(graph, self.count, self.names)
        if not graph.senders.size:
            return None
        return Channel.unchecked(graph, ledger=state.ledger, runs=state.runs,
                                 faults=self.faults, t=t)

    def _contact(self, before: float, t: float) -> bool:
        if self.every is None:
            return True
        # Whether one of the multiples lies after the step's start, and up to its end, to rounding.
        near = 1e-9 + 1e-15 * abs(t / self.every)
        return math.floor(t / self.every + near) > math.floor(before / self.every + near)

    @abstractmethod
    def begin(self, prior: Any, runs: tuple[int, ...], rng: Any) -> dict[str, Any]:
        """The fields of the first state that are the family's own."""

    @abstractmethod
    def advance(self, step: Step) -> Any:
        """The state at the end of a step."""

    @abstractmethod
    def summary(self, state: Any) -> Summary:
        """Estimates and spreads of a state."""

    @door
    def start(
        self, prior: Any, *, rng: Rng | None = None, runs: tuple[int, ...] = (), t: float = 0.0
    ) -> Any:
        """The state before the first step.

        Parameters
        ----------
        prior : tuple, distribution, GaussianMixture, array_like or callable
            A Gaussian's ``(mean, cov)``, (d,) and (d, d); a frozen distribution of scipy; a
            mixture; members (N, d), or (*runs, A, N, d); or a function
            ``prior(members, rng=rng, leading=leading)`` that draws (*leading, N, d). What a family
            cannot make of these it refuses. A family whose agents' states differ takes a list, one
            for each agent.
        rng : numpy.random.Generator, optional
            Draws the prior; a child stream of it, independent of whatever else is drawn from it,
            serves all later steps. Filters that draw nothing need none.
        runs : tuple of int
            Leading axes: independent runs.
        t : float
            The time of the prior, in s.
        """
        if self.draws and rng is None:
            raise ValueError("rng: needs a numpy.random.Generator, got None")
        if runs and (not self.batched or min(runs) < 1):
            needs = "sizes of at least 1" if self.batched else "(), one run at a time"
            raise ValueError(f"runs: needs {needs}, got {runs!r}")
        own = self.begin(prior, runs, rng)
        child = rng.spawn(1)[0] if self.draws and rng is not None else None
        return self.state(t, Ledger.empty(self.count), child, **own)

    @door
    def step(
        self, state: State, t: float, observations: Any, *, late: Sequence[Reading] = ()
    ) -> Any:
        """Move to time `t` and take in what was observed there.

        Parameters
        ----------
        state : State
            Not changed.
        t : float
            The new time, in s; at the state's own nothing is forecast.
        observations : sequence of length A
            Per agent (*runs, m) or (m,), or None; or one :class:`Reading`, or a list of them. NaN
            marks a missing component, run by run.
        late : sequence of Reading
            Those of earlier times that arrive now; needs a `lag` that reaches back to them.

        Raises
        ------
        ValueError
            If `t` is earlier, or an observation does not fit its sensor or no earlier state is
            kept for a late one.
        FilterError
            If an agent's computation fails; see `failures`.
        """
        if t < state.t:
            Bounds(at_least=state.t)(t, "t")
        self.fits(state)
        return self._advanced(state, t, observations, late, own=False)

    def _advanced(
        self, state: Any, t: float, observations: Any, late: Sequence[Reading], *, own: bool
    ) -> Any:
        said = self.read(observations, state.runs, t)
        old = belated(self, late, state, t) if late else ()
        step = Step(self, state, t, said, old, own=own)
        try:
            return self.advance(step)
        except RECOVERABLE as error:
            if of_the_call(error):
                raise
            raise FilterError((), None, t, error) from error

    def fits(self, state: Any) -> None:
        """Refuse a state that is not this filter's."""
        if not isinstance(state, self.state):
            needs = self.state.__name__
            raise ValueError(f"state: needs a {needs}, got a {type(state).__name__}")
        if (got := state.ledger.messages.size) != self.count:
            raise ValueError(f"state: needs {self.count} agents, got {got}")
        if (own := getattr(self, "sizes", None)) is not None and state.sizes != own:
            raise ValueError(f"state: needs sizes {own} an agent, got {state.sizes}")

    def read(self, observations: Any, runs: tuple[int, ...], t: float) -> Any:
        """What is observed at one time, checked; as a rule each agent's readings."""
        return said_by_all(self, observations, runs, t)

    def _walk(
        self, state: Any, grid: Array, entries: Iterable[Any], late: Sequence[Reading], *, own: bool
    ) -> Iterator[Any]:
        last = grid[-1] if grid.size else -np.inf
        for item in late:
            if item.arrived is None or item.arrived > last:
                raise ValueError(f"late: needs arrivals up to {last:g}, got {item.arrived}")
        waiting: list[Any] = sorted(late, key=lambda item: item.arrived or 0.0)
        for k, (t, observed) in enumerate(zip(grid.tolist(), entries, strict=True)):
            due = [item for item in waiting if item.arrived <= t] if waiting else waiting
            waiting = waiting[len(due) :]
            # The first state is the caller's.
            state = self._advanced(state, t, observed, due, own=own and k > 0)
            yield state

    def _recorded(
        self, state: Any, times: Any, observations: Any, truth: Any, scores: Collection[Score],
        late: Sequence[Reading], lag: int,
    ) -> xarray.Dataset:  # fmt: skip
        """A run's record, each time as it is believed when `lag` more have been observed."""
        self.fits(state)
        grid, entries = planned(self, state, times, observations)
        walk = self._walk(state, grid, entries, late, own=True)
        return recorded(self, grid, state, self._believed(walk, lag), truth, scores)

    def _believed(self, walk: Iterable[Any], lag: int) -> Iterator[tuple[Any, Any]]:
        """Each state of a walk, and as what it is believed when `lag` more have followed."""
        waiting: list[Any] = []
        for last in walk:
            waiting.append(last)
            if len(waiting) > lag:
                yield waiting.pop(0), last.earlier[-lag] if lag else last
        if waiting:
            yield from zip(waiting, [*last.earlier, last][-len(waiting) :], strict=True)

    @door
    def steps(
        self, state: State, times: Any, observations: Any, *, late: Sequence[Reading] = ()
    ) -> Iterator[Any]:
        """The states at `times`, one after the other; arguments as in :meth:`run`."""
        self.fits(state)
        grid, entries = planned(self, state, times, observations)
        return self._walk(state, grid, entries, late, own=False)

    @door
    def run(
        self, state: State, times: Any, observations: Any, *, truth: Any = None,
        scores: Collection[Score] = SCORES, late: Sequence[Reading] = (),
    ) -> xarray.Dataset:  # fmt: skip
        """Step through a series, or through events, and record it.

        Parameters
        ----------
        state : State
            Where to begin.
        times : array_like, (T,), or None
            Strictly increasing, in s, from the state's on; steps may differ in length. With events
            there is a step at each of theirs too, and None is enough if none is late.
        observations : sequence of length A, or of Reading
            Per agent (T, *runs, m) or (T, m), or None; NaN marks what is missing. Or events of any
            order, several of which may have one time.
        truth : array_like, (T, *runs, d) or (T, *runs, A, d), or mapping, optional
            If given, the scores are recorded too: of all agents alike, of each agent's own, or of
            some components only, by their names, (T, *runs) or (T, *runs, A) each.
        scores : collection of {"squared_error", "nees", "crps"}
            Which of them; CRPS costs about as much as an ensemble filter.
        late : sequence of Reading
            Each is taken in at the first of `times` that is not before it `arrived`, and has to be
            of one of them: with events let `times` hold those of the late ones.

        Returns
        -------
        xarray.Dataset
            Axes ``time``, ``run`` (``run0``, ``run1``, … where there are several), ``agent``,
            ``component``; units and meaning stand in the attributes. ``mean``, ``variance`` and,
            with `truth`, ``squared_error`` and ``crps`` for each component; ``spread`` and
            ``total_squared_error`` add components up, whatever their units, and say so; ``nees``
            is d on average for a consistent filter. ``messages``, ``scalars``, ``bytes``, ``lost``
            and ``rounds`` are those of each step, the same names with ``_total`` their sums;
            ``refused`` counts what the `gate` left out;
            :func:`distfilt.filters.final_state` gives the state at the end.
        """
        return self._recorded(state, times, observations, truth, scores, late, 0)

    @door
    def smooth(
        self, state: State, times: Any, observations: Any, *, truth: Any = None,
        scores: Collection[Score] = SCORES, late: Sequence[Reading] = (),
    ) -> xarray.Dataset:  # fmt: skip
        """Fixed-lag smoothing: of each time what is believed when `lag` more have been observed.

        Parameters and result are those of :meth:`run`. The filter needs a `lag`; near the end
        fewer times follow, and the last estimate is the filter's.
        """
        if not self.lag:
            why = self.unused.get("lag", "needs at least 1 for smoothing, got 0")
            raise ValueError(f"lag: {why}")
        return self._recorded(state, times, observations, truth, scores, late, self.lag)
