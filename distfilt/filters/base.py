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

from ..models import Model
from ..network import Channel, Faults, Ledger
from ..network.channel import kind_of_rule
from ..network.graphs import as_graph
from ..sensors import Sensor
from ..validation import (
    Array,
    Bounds,
    FrozenModel,
    NonNegativeInt,
    PositiveFloat,
    Rng,
    skip_validation,
    validated,
)
from .inputs import Observation, match_delayed, plan_steps, read_observations
from .record import SCORES, Score, Summary, record_run
from .saving import State
from .step import RECOVERABLE, FilterError, Step, is_argument_error

if TYPE_CHECKING:
    import xarray

__all__ = ["Filter"]


@dataclass(frozen=True, eq=False)
class Filter(FrozenModel, ABC):
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
    fusion : callable, optional
        ``agreement(belief, channel) -> belief``: what agents do after the update to agree, if they
        do; the belief is the family's. A rule of this package that fuses something else is refused.
    share_observations : bool
        Whether agents send their readings to those that hear them, who use them too.
    faults : Faults, optional
        Messages lost and agents silenced; a lost observation is a missing one. A delay is not
        accepted: an observation that comes late has its own time, pass it as `delayed`.
    lag : int
        How many earlier times are kept, for late observations and for smoothing.
    names : sequence of str
        Names of the agents; their numbers by default.
    on_error : {"raise", "keep"}
        What happens when one run of a batch fails: a :class:`FilterError` that names it, or the
        other runs go on and the failed one is recorded as NaN. Where an `fusion` raises, each
        run is asked alone.
    gate_probability : float, optional
        How likely a good reading passes, in (0, 1). Each sensor's reading is tested against what
        was predicted; those that fail are left out and counted as ``rejected`` in the record.
    exchange_interval : float, optional
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
    >>> from distfilt.network import intersect_ensembles
    >>> from distfilt.sensors import component
    >>> walk, two = constant_velocity(sigma=1.0), [component([0], std=1.0), None]
    >>> for graph in (nx.path_graph(2), lambda t: [(0, 1)]):
    ...     f = GaussianFilter(walk, two, graph)
    ...     print(
    ...         f.step(f.start((np.zeros(4), np.eye(4))), 0.0, [[1.0], None]).means[
    ...             :, 0
    ...         ]
    ...     )
    [0.5 0.5]
    [0.5 0.5]
    >>> GaussianFilter(walk, two, graph, fusion=intersect_ensembles)
    Traceback (most recent call last):
    ValueError: fusion must be a rule that fuses gaussians, got one of ensembles
    """

    model: Model
    sensors: Sequence[Sensor | Sequence[Sensor] | None]
    graph: Any = None
    _: KW_ONLY
    fusion: Callable[..., Any] | None = None
    share_observations: bool = True
    faults: Faults | None = None
    lag: NonNegativeInt = 0
    names: Sequence[str] = ()
    on_error: Literal["raise", "keep"] = "raise"
    gate_probability: Annotated[float, Bounds(above=0, below=1)] | None = None
    exchange_interval: PositiveFloat | None = None

    state_class: ClassVar[type[Any]] = State
    requires_rng: ClassVar[bool] = False
    supports_runs: ClassVar[bool] = True
    batched_summary: ClassVar[bool] = False
    supports_increments: ClassVar[bool] = False
    belief_kind: ClassVar[str | None] = None
    unsupported: ClassVar[Mapping[str, str]] = {}

    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        # A summary of one's own may be right for single states only.
        if "summarize" in vars(cls) and "batched_summary" not in vars(cls):
            cls.batched_summary = False

    def __post_init__(self) -> None:
        super().__post_init__()
        for option in fields(self):
            if (
                option.name in self.unsupported
                and getattr(self, option.name) != option.default
            ):
                raise ValueError(f"{option.name}: {self.unsupported[option.name]}")
        self.check_parts()
        if self.faults is not None and self.faults.has_delay:
            raise ValueError(
                f"faults must be Faults without a delay, got {self.faults!r}"
            )
        if self.names and not len(self.names) == len({*self.names}) == self.n_agents:
            raise ValueError(
                f"names must have {self.n_agents} different names, got {[*self.names]}"
            )
        kind = None if self.fusion is None else kind_of_rule(self.fusion)
        if kind is not None and kind != self.belief_kind:
            raise ValueError(
                f"fusion must be a rule that fuses {self.belief_kind}, got one of {kind}"
            )
        if (
            self.exchange_interval is not None
            and self.share_observations
            and self.graph is not None
            and not self.lag
        ):
            raise ValueError(
                "lag must have at least 1 for readings that wait for a contact, got 0"
            )

    def check_parts(self) -> None:
        """Refuse sensors or a graph that this family cannot have."""
        if not self.supports_increments and any(
            s.uses_previous for own in self.agent_sensors for s in own
        ):
            raise ValueError(
                "sensors must be sensors of the present state, got a differential"
            )
        speak = self.share_observations or self.fusion is not None
        if self.graph is None and self.n_agents > 1 and speak:
            raise ValueError(
                f"graph must be a Graph of {self.n_agents} agents, got None"
            )
        if self.graph is not None and not callable(self.graph):
            object.__setattr__(
                self, "graph", as_graph(self.graph, self.n_agents, self.names)
            )

    @cached_property
    def agent_sensors(self) -> tuple[tuple[Sensor, ...], ...]:
        """Each agent's sensors."""
        several = [() if own is None else own for own in self.sensors]
        return tuple(own if isinstance(own, tuple) else (own,) for own in several)

    @cached_property
    def n_agents(self) -> int:
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
        return tuple(self.names) or tuple(str(k) for k in range(self.n_agents))

    def channel(self, state: State, t: float) -> Channel | None:
        """The door of this step; none where nobody can speak, or it is not yet time."""
        if self.graph is None or not self._contact(state.t, t):
            return None
        graph = self.graph(t) if callable(self.graph) else self.graph
        graph = as_graph(graph, self.n_agents, self.names)
        if not graph.senders.size:
            return None
        return Channel.construct(
            graph, ledger=state.ledger, runs=state.runs, faults=self.faults, t=t
        )

    def _contact(self, before: float, t: float) -> bool:
        if self.exchange_interval is None:
            return True
        # Whether one of the multiples lies after the step's start, and up to its end, to rounding.
        near = 1e-9 + 1e-15 * abs(t / self.exchange_interval)
        return math.floor(t / self.exchange_interval + near) > math.floor(
            before / self.exchange_interval + near
        )

    @abstractmethod
    def initial_state(
        self, prior: Any, runs: tuple[int, ...], rng: Any
    ) -> dict[str, Any]:
        """The fields of the first state that are the family's own."""

    @abstractmethod
    def next_state(self, step: Step) -> Any:
        """The state at the end of a step."""

    @abstractmethod
    def summarize(self, state: Any) -> Summary:
        """Estimates and spreads of a state."""

    @validated
    def start(
        self,
        prior: Any,
        *,
        rng: Rng | None = None,
        runs: tuple[int, ...] = (),
        t: float = 0.0,
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
        if self.requires_rng and rng is None:
            raise ValueError("rng must be a numpy.random.Generator, got None")
        if runs and (not self.supports_runs or min(runs) < 1):
            needs = (
                "sizes of at least 1" if self.supports_runs else "(), one run at a time"
            )
            raise ValueError(f"runs must be {needs}, got {runs!r}")
        own = self.initial_state(prior, runs, rng)
        child = rng.spawn(1)[0] if self.requires_rng and rng is not None else None
        return self.state_class(t, Ledger.empty(self.n_agents), child, **own)

    @validated
    def step(
        self,
        state: State,
        t: float,
        observations: Any,
        *,
        delayed: Sequence[Observation] = (),
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
            If an agent's computation fails; see `on_error`.
        """
        if t < state.t:
            Bounds(at_least=state.t)(t, "t")
        self.check_state(state)
        return self._advanced(state, t, observations, delayed, own=False)

    def _advanced(
        self,
        state: Any,
        t: float,
        observations: Any,
        delayed: Sequence[Observation],
        *,
        own: bool,
    ) -> Any:
        said = self.read_observations(observations, state.runs, t)
        old = match_delayed(self, delayed, state, t) if delayed else ()
        step = Step(self, state, t, said, old, own=own)
        try:
            return self.next_state(step)
        except RECOVERABLE as error:
            if is_argument_error(error):
                raise
            raise FilterError((), None, t, error) from error

    def check_state(self, state: Any) -> None:
        """Refuse a state that is not this filter's."""
        if not isinstance(state, self.state_class):
            needs = self.state_class.__name__
            raise ValueError(f"state must be a {needs}, got a {type(state).__name__}")
        if (got := state.ledger.messages.size) != self.n_agents:
            raise ValueError(f"state must be {self.n_agents} agents, got {got}")
        if (own := getattr(self, "sizes", None)) is not None and state.sizes != own:
            raise ValueError(f"state must have sizes {own} an agent, got {state.sizes}")

    def read_observations(
        self, observations: Any, runs: tuple[int, ...], t: float
    ) -> Any:
        """What is observed at one time, checked; as a rule each agent's readings."""
        return read_observations(self, observations, runs, t)

    def _walk(
        self,
        state: Any,
        grid: Array,
        entries: Iterable[Any],
        delayed: Sequence[Observation],
        *,
        own: bool,
    ) -> Iterator[Any]:
        last = grid[-1] if grid.size else -np.inf
        for item in delayed:
            if item.arrival_time is None or item.arrival_time > last:
                raise ValueError(
                    f"delayed must be arrivals up to {last:g}, got {item.arrival_time}"
                )
        waiting: list[Any] = sorted(delayed, key=lambda item: item.arrival_time or 0.0)
        for k, (t, observed) in enumerate(zip(grid.tolist(), entries, strict=True)):
            due = (
                [item for item in waiting if item.arrival_time <= t]
                if waiting
                else waiting
            )
            waiting = waiting[len(due) :]
            # This generator runs after the validated call that made it has returned.
            with skip_validation():
                # The first state is the caller's.
                state = self._advanced(state, t, observed, due, own=own and k > 0)
            yield state

    def _recorded(
        self,
        state: Any,
        times: Any,
        observations: Any,
        truth: Any,
        scores: Collection[Score],
        delayed: Sequence[Observation],
        lag: int,
    ) -> xarray.Dataset:
        """A run's record, each time as it is believed when `lag` more have been observed."""
        self.check_state(state)
        grid, entries = plan_steps(self, state, times, observations)
        walk = self._walk(state, grid, entries, delayed, own=True)
        return record_run(self, grid, state, self._believed(walk, lag), truth, scores)

    def _believed(self, walk: Iterable[Any], lag: int) -> Iterator[tuple[Any, Any]]:
        """Each state of a walk, and as what it is believed when `lag` more have followed."""
        waiting: list[Any] = []
        for last in walk:
            waiting.append(last)
            if len(waiting) > lag:
                yield waiting.pop(0), last.lagged_states[-lag] if lag else last
        if waiting:
            yield from zip(
                waiting, [*last.lagged_states, last][-len(waiting) :], strict=True
            )

    @validated
    def steps(
        self,
        state: State,
        times: Any,
        observations: Any,
        *,
        delayed: Sequence[Observation] = (),
    ) -> Iterator[Any]:
        """The states at `times`, one after the other; arguments as in :meth:`run`."""
        self.check_state(state)
        grid, entries = plan_steps(self, state, times, observations)
        return self._walk(state, grid, entries, delayed, own=False)

    @validated
    def run(
        self,
        state: State,
        times: Any,
        observations: Any,
        *,
        truth: Any = None,
        scores: Collection[Score] = SCORES,
        delayed: Sequence[Observation] = (),
    ) -> xarray.Dataset:
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
            ``rejected`` counts what the `gate_probability` left out;
            :func:`distfilt.filters.final_state` gives the state at the end.
        """
        return self._recorded(state, times, observations, truth, scores, delayed, 0)

    @validated
    def smooth(
        self,
        state: State,
        times: Any,
        observations: Any,
        *,
        truth: Any = None,
        scores: Collection[Score] = SCORES,
        delayed: Sequence[Observation] = (),
    ) -> xarray.Dataset:
        """Fixed-lag smoothing: of each time what is believed when `lag` more have been observed.

        Parameters and result are those of :meth:`run`. The filter needs a `lag`; near the end
        fewer times follow, and the last estimate is the filter's.
        """
        if not self.lag:
            why = self.unsupported.get("lag", "needs at least 1 for smoothing, got 0")
            raise ValueError(f"lag: {why}")
        return self._recorded(
            state, times, observations, truth, scores, delayed, self.lag
        )
