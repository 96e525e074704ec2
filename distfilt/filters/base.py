"""The contract of all filters, and the driver that steps, runs and records any of them.

A family supplies three methods: `initial_state`, `next_state` and `summarize`. It derives from
:class:`SensorFilter`, if its agents have sensors, and from the classes in
:mod:`distfilt.filters.options`, one for each thing it can do.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import (
    Callable,
    Collection,
    Iterable,
    Iterator,
    Sequence,
)
from dataclasses import KW_ONLY, dataclass
from functools import cached_property
from typing import (
    TYPE_CHECKING,
    Annotated,
    Any,
    ClassVar,
    Generic,
    Literal,
    TypeVar,
    cast,
)

import numpy as np

from ..models import AgentModels, LinearModel, Model
from ..network import Channel, Faults, Ledger
from ..network.channel import kind_of_rule
from ..network.graphs import Graph, as_graph
from ..periods import Periods
from ..sensors import LikelihoodSensor, Sensor
from ..validation import (
    Array,
    Bounds,
    FrozenModel,
    InvalidArgumentError,
    Rng,
    all_finite,
    format_number,
    skip_validation,
    validated,
)
from ..validation.clocks import warn_of_clock, warn_of_unit
from .bridge import insert_times
from .failures import RECOVERABLE, FilterError, is_argument_error
from .observations import Observation, match_delayed, read_observations
from .plans import StepObservations, TimesArgument, find_degrees, plan_steps
from .priors import Prior
from .record import (
    SCORES,
    Recording,
    Score,
    Scored,
    Summary,
    Truth,
    final_state,
    record_run,
)
from .repetition import drop_repeated, find_rounded_copy
from .resets import Reset, read_reset
from .states import SensorState, State
from .step import Step

if TYPE_CHECKING:
    import xarray

__all__ = ["Filter", "SensorFilter"]

S = TypeVar("S", bound=State)

_FLOAT64 = np.dtype(np.float64)


@dataclass(frozen=True, eq=False)
class Filter(FrozenModel, ABC, Generic[S]):
    """The base of every family of filters; generic in the family's state.

    Parameters
    ----------
    faults : Faults, optional
        Lost messages and silenced agents; a lost observation is a missing one. A delay is not
        accepted: a delayed observation has its own time, pass it as `delayed`.
    names : sequence of str
        Names of the agents; their numbers by default.

    Notes
    -----
    A family of one's own is a class that derives from
    :class:`~distfilt.filters.SensorFilter` and from the options it offers, names its
    `state_class`, and has three methods: `initial_state` returns the family's fields of the first
    state, `next_state` makes the next state of a :class:`~distfilt.filters.Step`, and `summarize`
    returns estimates of a state. With `requires_rng` steps draw from a generator; with
    `batched_summary` `summarize` accepts states stacked along a first axis; `belief_kind` names
    the kind of belief that its fusion rules fuse.
    """

    _: KW_ONLY
    faults: Faults | None = None
    names: Sequence[str] = ()

    state_class: ClassVar[type[State]] = State
    has_sensors: ClassVar[bool] = False
    requires_rng: ClassVar[bool] = False
    supports_runs: ClassVar[bool] = True
    batched_summary: ClassVar[bool] = False
    belief_kind: ClassVar[str | None] = None

    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        # The `summarize` of a subclass may be written for single states only, unless the subclass
        # sets the flag too.
        if "summarize" in vars(cls) and "batched_summary" not in vars(cls):
            cls.batched_summary = False

    def __post_init__(self) -> None:
        super().__post_init__()
        self.check_parts()
        # Delays belong to the observations, which have times of their own.
        if self.faults is not None and self.faults.total_delay:
            raise ValueError(
                f"faults must be Faults without a delay, got {self.faults!r}"
            )
        n = self.n_agents
        if self.names and not len(self.names) == len(set(self.names)) == n:
            raise ValueError(
                f"names must have {n} different names, got {list(self.names)}"
            )
        # A rule of the library is tagged with the kind of belief that it fuses; a user's has none.
        kind = kind_of_rule(self.fusion) if callable(self.fusion) else None
        if kind is not None and kind != self.belief_kind:
            raise ValueError(
                f"fusion must be a rule that fuses {self.belief_kind}, got one of {kind}"
            )

    def check_parts(self) -> None:
        """Refuse options that do not fit each other; families extend it."""

    def insert_time(self, state: S, t: float) -> S:
        """Return the state with a belief about a time between two that it keeps."""
        raise ValueError(
            f"delayed must be of a time that a {type(self).__name__} has stepped to, got "
            f"{format_number(t)}"
        )

    # The behaviour of a family without the option. A class of `options` makes a field of it.

    @cached_property
    def fusion(self) -> object:
        """The fusion rule; none by default."""
        return None

    @cached_property
    def share_observations(self) -> bool:
        """Whether agents send their observations to their neighbours."""
        return False

    @cached_property
    def hops(self) -> int | Literal["all"]:
        """Over how many links observations travel."""
        return 1

    @cached_property
    def lag(self) -> int:
        """How many earlier times a state keeps."""
        return 0

    @cached_property
    def on_error(self) -> Literal["raise", "keep"]:
        """Whether a failed run raises an error, or is recorded as NaN."""
        return "raise"

    @cached_property
    def gate_probability(self) -> float | None:
        """How likely a good observation passes the gate; None without a gate."""
        return None

    @cached_property
    def record_evidence(self) -> bool:
        """Whether states have the log-likelihood and the NIS of their observations."""
        return False

    @cached_property
    def exchange_interval(self) -> float | None:
        """Seconds between two exchanges; None if agents exchange in every step."""
        return None

    def is_exchange_time(self, t_before: float, t: float) -> bool:
        """Whether a multiple of the interval lies after `t_before` and not after `t`."""
        if self.exchange_interval is None:
            return True
        # To rounding, in units of the interval: a sum of steps may fall short of the multiple.
        tolerance = 1e-9 + 1e-15 * abs(t / self.exchange_interval)
        number = math.floor(t / self.exchange_interval + tolerance)
        return number > math.floor(t_before / self.exchange_interval + tolerance)

    # The parts that a family supplies.

    @property
    def periods(self) -> Periods:
        """The period of each component of the state, None for those not circular; () if none."""
        return ()

    @property
    @abstractmethod
    def n_agents(self) -> int:
        """Number A of agents."""

    @property
    @abstractmethod
    def components(self) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """Names and units of the state's components."""

    # Any: the form of the observations is the family's own.
    @abstractmethod
    def read_observations(
        self, observations: object, runs: tuple[int, ...], t: float
    ) -> Any:
        """Check the observations of one time, and return them as `next_state` needs them."""

    @abstractmethod
    def initial_state(
        self, prior: Prior, runs: tuple[int, ...], rng: np.random.Generator | None
    ) -> dict[str, object]:
        """Return the family's own fields of the first state."""

    @abstractmethod
    def next_state(self, step: Step[S]) -> S:
        """Return the state at the end of a step."""

    @abstractmethod
    def summarize(self, state: S) -> Summary:
        """Return estimates and variances of a state."""

    @cached_property
    def reads_by_default(self) -> bool:
        """Whether observations are read as those of sensors are, so that a run can plan it."""
        return False

    def channel(self, state: S, t: float) -> Channel | None:
        """Return the channel of the step to `t`; None where nobody can send."""
        return None

    # The driver.

    @property
    def agents(self) -> tuple[str, ...]:
        """Names of the agents; their numbers by default."""
        return tuple(self.names) or tuple(str(k) for k in range(self.n_agents))

    @validated
    def start(
        self,
        prior: Prior,
        *,
        rng: Rng | None = None,
        runs: tuple[int, ...] = (),
        t: float = 0.0,
    ) -> S:
        """Return the state before the first step.

        Parameters
        ----------
        prior : tuple, distribution, GaussianMixture, array_like or callable
            A Gaussian's ``(mean, cov)``, (d,) and (d, d); a frozen distribution of scipy; a
            mixture; members (N, d), or (*runs, A, N, d); or a function
            ``prior(members, rng=rng, leading=leading)`` that draws (*leading, N, d). A family
            refuses kinds that it cannot use. A list of any of these has a prior for each agent,
            in families whose agents have beliefs of their own: all but
            :class:`~distfilt.filters.TransportFilter`.
        rng : numpy.random.Generator, optional
            Draws the prior. All later steps draw from a child stream of it, which is independent
            of whatever else is drawn from it. Filters that draw nothing need none.
        runs : tuple of int
            Leading axes: independent runs.
        t : float
            The time of the prior, in s.
        """
        if self.requires_rng:
            require_rng(rng)
        if runs and not self.supports_runs:
            raise ValueError(
                f"runs must be () for a filter of one run at a time, got {runs!r}"
            )
        if runs and min(runs) < 1:
            raise ValueError(f"runs must be sizes of at least 1, got {runs!r}")
        # A time in milliseconds or nanoseconds is probably a mistake.
        warn_of_unit(t, "t")
        fields = self.initial_state(prior, runs, rng)
        # The steps have a stream of their own, a child of `rng`, whatever else the user draws.
        child = None
        if self.requires_rng and rng is not None:
            (child,) = rng.spawn(1)
        ledger = Ledger.empty(self.n_agents)
        # A cast, since the fields are those of the family's class, and not known here.
        make = cast(Callable[..., S], self.state_class)
        return make(t, ledger, child, **fields)

    @validated
    def step(
        self,
        state: S,
        t: float,
        observations: object,
        *,
        delayed: Sequence[Observation] = (),
    ) -> S:
        """Move to time `t` and assimilate the observations of that time.

        Parameters
        ----------
        state : State
            The state before; it is not changed.
        t : float
            The new time, in s; at the state's own time nothing is forecast.
        observations : sequence of length A
            Per agent (*runs, m) or (m,), or None; or one :class:`Observation`, or a list of them.
            Or a list of Observations alone, in any order. NaN marks a missing component, run by
            run.
        delayed : sequence of Observation
            Observations of earlier times that arrive now; the filter needs a `lag` that reaches
            back to them. A time between two steps is inserted among those that the state keeps,
            and counts as one of them: exactly for a linear model, to first order for others.

        Raises
        ------
        ValueError
            If `t` is earlier than the state, an observation does not fit its sensor, or the time
            of a delayed one is not kept.
        FilterError
            If an agent's computation fails; see `on_error`.
        """
        self.check_state(state)
        if t < state.t:
            Bounds(at_least=state.t)(t, "t")
        if state.t == 0:
            # From 0 to the seconds of a clock since 1970 would be a single step of decades.
            warn_of_clock(0.0, np.array([t]), "t")
        return self._advance(state, t, observations, delayed, is_single=True)

    def _advance(
        self,
        state: S,
        t: float,
        observations: object,
        delayed: Sequence[Observation],
        *,
        reuse_rng: bool = False,
        is_single: bool = False,
        are_read: bool = False,
    ) -> S:
        """Take one step from checked arguments.

        Parameters
        ----------
        state, t, observations, delayed
            As for :meth:`step`.
        reuse_rng : bool
            Whether the step may draw from the state's own generator, or needs a copy, since the
            state is the user's.
        is_single : bool
            Whether the step is not part of a run, whose plan has looked for copies and degrees.
        are_read : bool
            Whether each agent has a list of Observations that have been checked.
        """
        read: Any = observations
        if not are_read:
            # `failed` of a SensorState has one entry for each run.
            runs = state.failed.shape if isinstance(state, SensorState) else state.runs
            read = self.read_observations(observations, runs, t)
        sensor_filter = cast("SensorFilter[S]", self) if self.has_sensors else None
        matched: Sequence[Observation] = ()
        if delayed:
            # Beliefs about the times of delayed observations between two kept ones
            extended = insert_times(self, delayed, state, t, reuse_rng=reuse_rng)
            # The generator of a state that was made here is not the user's.
            reuse_rng = reuse_rng or extended is not state
            state = extended
            if sensor_filter is not None:
                matched = match_delayed(sensor_filter, delayed, state, t)
        repeated: list[Observation] = []
        # Mostly each agent has one observation, of a new time: then none has come before.
        is_plain = not matched and t > state.t
        if sensor_filter is not None and (not is_plain or max(map(len, read)) > 1):
            read, matched, repeated = drop_repeated(
                read, matched, state.assimilated, sensor_filter.model.dim
            )
        # From here on all inputs are checked, and the family's own method does the rest.
        step = Step(self, state, t, read, matched, reuse_rng=reuse_rng)
        if repeated:
            step.warn_once("repeated", _describe_repetition(repeated[0]))
        if sensor_filter is not None and (is_single or matched):
            # Of a run the delayed ones only: its plan has looked at all others.
            parts = [*read, matched] if is_single else [matched]
            self._warn_of_unplanned(step, [o for part in parts for o in part])
        try:
            return self.next_state(step)
        except RECOVERABLE as error:
            # A wrong argument is the caller's error; anything else is a failure of the step.
            if is_argument_error(error):
                raise
            raise FilterError((), None, t, error) from error

    def _warn_of_unplanned(
        self, step: Step[S], observations: Sequence[Observation]
    ) -> None:
        """Warn once of angles in degrees and of copies, in observations outside a plan."""
        # Angles of less than four turns, 8π = 25 rad, need no closer look.
        large = [o for o in observations if (abs(o.value) > 25).any()]
        if large:
            sensors: Sequence[Sequence[Sensor]] = getattr(self, "agent_sensors", ())
            text = find_degrees(sensors, large)
            if text is not None:
                step.warn_once("degrees", text)
        assimilated = step.state.assimilated
        # The times of a copy differ by rounding: to milliseconds, or in single precision, which has
        # seven digits.
        is_near = step.dt < max(1e-3, 1e-6 * abs(step.t))
        if assimilated and (is_near or step.delayed):
            text = find_rounded_copy(observations, assimilated, step.model.dim)
            if text is not None:
                step.warn_once("rounded times", text)

    def check_state(self, state: S) -> None:
        """Refuse a state that is not of this filter."""
        if not isinstance(state, self.state_class):
            raise InvalidArgumentError(
                f"state must be a {self.state_class.__name__}, got a {type(state).__name__}"
            )
        n = state.ledger.messages.size
        if n != self.n_agents:
            raise ValueError(f"state must be of {self.n_agents} agents, got {n}")

    @validated
    def steps(
        self,
        state: S,
        times: TimesArgument,
        observations: object,
        *,
        delayed: Sequence[Observation] = (),
    ) -> Iterator[S]:
        """Yield the states at `times`, one after the other; arguments as in :meth:`run`."""
        self.check_state(state)
        # The times of the steps, and an iterator over the observations of each
        step_times, entries = plan_steps(self, state, times, observations)
        # The user gets each state, so that no step may change the generator of the one before.
        return self._iterate(state, step_times, entries, delayed, reuse_rng=False)

    def _iterate(
        self,
        state: S,
        step_times: Array,
        entries: Iterable[StepObservations],
        delayed: Sequence[Observation],
        *,
        reuse_rng: bool,
    ) -> Iterator[S]:
        """Yield the states of a run; delayed observations are assimilated when they have arrived.

        Parameters
        ----------
        state : State
            The user's state before the run.
        step_times, entries : ndarray, (T,), and iterable
            The times of the steps, and the observations of each.
        delayed : sequence of Observation
        reuse_rng : bool
            Whether all states share one generator; otherwise each step copies it.
        """
        # An observation that arrives after the last step would be lost without a word.
        last = step_times[-1] if step_times.size else -np.inf
        for observation in delayed:
            arrival = observation.arrival_time
            if arrival is None or arrival > last:
                raise ValueError(
                    f"delayed must have an arrival_time up to {format_number(last)}, "
                    f"got {arrival}"
                )
        # In order of arrival; those with the same arrival keep the user's order.
        waiting = sorted(delayed, key=_arrival_time)
        # Whether the state's generator is the run's own, which a step may use without a copy
        is_own = False
        for t, (observed, are_read) in zip(step_times.tolist(), entries, strict=True):
            arrived: list[Observation] = []
            while waiting and _arrival_time(waiting[0]) <= t:
                arrived.append(waiting.pop(0))
            # This generator function runs after the validated call that made it has returned, so
            # that the steps inside it have to skip the validation again.
            with skip_validation():
                state = self._advance(
                    state,
                    t,
                    observed,
                    arrived,
                    reuse_rng=is_own,
                    are_read=are_read,
                )
            # The first state is the user's; the others, and their generator, are the run's.
            is_own = reuse_rng
            yield state

    @validated
    def run(
        self,
        state: S,
        times: TimesArgument,
        observations: object,
        *,
        truth: Truth = None,
        scores: Collection[Score] = SCORES,
        scored: Scored = None,
        keep: Collection[str] | None = None,
        delayed: Sequence[Observation] = (),
    ) -> xarray.Dataset:
        """Step through a series, or through events, and record it.

        Parameters
        ----------
        state : State
            The state before the run.
        times : array_like, (T,), or None
            Strictly increasing, in s, from the state's on; steps may differ in length. With events
            there is a step at each of their times too, and None is enough if none is delayed.
        observations : sequence of length A, or of Observation
            Per agent (T, *runs, m) or (T, m), or None; NaN marks a missing component. Or events in
            any order, several of which may have the same time; an empty list is a run without any.
        truth : array_like, (T, *runs, d) or (T, *runs, A, d), callable or mapping, optional
            If given, the scores are recorded too. The truth is the same for all agents, or each
            agent's own, or it has some components only, by their names, (T, *runs) or
            (T, *runs, A) each. NaN where it is unknown, as are the scores. A function of the time
            in s, ``truth(t)``, serves as such a series.
        scores : collection of {"squared_error", "nees", "crps"}
            Which of them; CRPS costs about as much as an ensemble filter.
        scored : sequence of str, or a sequence of them for each agent, optional
            The components that ``nees`` and ``total_squared_error`` take together, such as those
            of a robot's own pose; all whose truth is given by default.
        keep : collection of str, optional
            The variables that are recorded, and the mean; all by default. Without the covariances
            long runs need far less memory.
        delayed : sequence of Observation
            Each is assimilated at the first of `times` not before its `arrival_time`. Its own time
            may lie between two of them.

        Returns
        -------
        xarray.Dataset
            Axes ``time``, ``run`` (``run0``, ``run1``, … where there are several), ``agent``,
            ``component``; units and meaning are in the attributes. ``mean``, ``variance`` and,
            with `truth`, ``squared_error`` and ``crps`` for each component; ``spread`` and
            ``total_squared_error`` add components up, whatever their units, and say so; ``nees``
            is the number of its components on average for a consistent filter. ``messages``,
            ``scalars``, ``bytes``, ``lost`` and ``rounds`` are those of each step, the same names
            with ``_total`` their sums; ``unseen`` counts the observations that an agent cannot
            use, since its sensor cannot see from its belief; ``rejected`` counts those that the
            gate rejects; with `record_evidence` ``log_likelihood``, ``nis`` and ``n_observed``
            score the others.
            :func:`distfilt.filters.final_state` returns the state at the end.
        """
        recording = Recording(truth, scores, scored, keep)
        return self._record(state, times, observations, recording, delayed, 0)

    def final_state(self, run: xarray.Dataset) -> S:
        """Return the state in which a run of this filter ended."""
        # The run may be another filter's, which the check finds.
        state = cast(S, final_state(run))
        self.check_state(state)
        return state

    def _record(
        self,
        state: S,
        times: TimesArgument,
        observations: object,
        recording: Recording,
        delayed: Sequence[Observation],
        lag: int,
    ) -> xarray.Dataset:
        """Record a run: of each time the belief when `lag` more have been observed."""
        self.check_state(state)
        # The times of the steps, and an iterator over the observations of each
        step_times, entries = plan_steps(self, state, times, observations)
        states = self._iterate(state, step_times, entries, delayed, reuse_rng=True)
        # Pairs of a state and the later belief about its time; without a lag the state itself
        smoothed = _smooth_states(states, lag)
        return record_run(self, step_times, state, smoothed, recording)


@dataclass(frozen=True, eq=False)
class SensorFilter(Filter[S]):
    """A filter of agents that observe one state, or states of one model, with sensors.

    Parameters
    ----------
    model : Model
        The motion of the state, known to all agents; or
        :class:`~distfilt.models.AgentModels`, one for each.
    sensors : sequence of length A
        Each agent's Sensor, or several of them in a list, or None. Neighbours know each other's.
        Of several sensors, each observation is an :class:`Observation` that names its sensor; one
        that moves comes with each Observation.
    graph : Graph, networkx graph, matrix or edges, or callable t -> one of them, optional
        Communication graph; required if agents exchange anything. Where it has no links at time
        t, nothing is sent.
    gate_probability : float, optional
        How likely a good observation passes the gate, in (0, 1); no gate by default. Each
        sensor's observation is tested against its prediction; the record counts the ``rejected``
        ones, and a warning is given once if the last ten of a sensor are rejected.
    faults, names
        As for :class:`~distfilt.filters.Filter`.

    Examples
    --------
    >>> import networkx as nx
    >>> from distfilt.filters import GaussianFilter
    >>> from distfilt.models import constant_velocity
    >>> from distfilt.network import intersect_ensembles
    >>> from distfilt.sensors import component
    >>> walk, two = constant_velocity(sigma=1.0), [component([0], std=1.0), None]
    >>> prior = (np.zeros(4), np.eye(4))
    >>> for graph in (nx.path_graph(2), lambda t: [(0, 1)]):
    ...     f = GaussianFilter(walk, two, graph)
    ...     print(f.step(f.start(prior), 0.0, [[1.0], None]).means[:, 0])
    [0.5 0.5]
    [0.5 0.5]
    >>> GaussianFilter(walk, two, graph, fusion=intersect_ensembles)
    Traceback (most recent call last):
    ValueError: fusion must be a rule that fuses gaussians, got one of ensembles
    """

    model: Model
    sensors: Sequence[Sensor | Sequence[Sensor] | None]
    # Any: whatever networkx or numpy accepts as a graph.
    graph: Any = None
    _: KW_ONLY
    gate_probability: Annotated[float, Bounds(above=0, below=1)] | None = None

    has_sensors: ClassVar[bool] = True
    supports_increments: ClassVar[bool] = False
    supports_likelihoods: ClassVar[bool] = False
    supports_agent_models: ClassVar[bool] = False

    def check_parts(self) -> None:
        """Refuse sensors or a graph that this family cannot use."""
        super().check_parts()
        self._check_agent_models()
        # A sensor of changes compares with the state at its last observation.
        if not self.supports_increments and self.change_sources:
            raise ValueError(
                "sensors must not be increments here: this filter keeps no previous state"
            )
        for sensors in self.agent_sensors:
            for sensor in sensors:
                self.check_likelihood(sensor)
        if self.graph is None:
            exchanges = self.share_observations or self.fusion is not None
            if exchanges and self.n_agents > 1:
                raise ValueError(
                    f"graph must be a Graph of {self.n_agents} agents, got None: agents "
                    "without one need share_observations=False, and no fusion"
                )
        elif not callable(self.graph):
            # A fixed graph is converted once. The dataclass is frozen, so the field is set past it.
            graph = as_graph(self.graph, self.n_agents, self.names)
            object.__setattr__(self, "graph", graph)
        # Between two exchanges observations wait.
        if self.exchange_interval is not None and self.sends_observations:
            self._check_waiting()

    def _check_agent_models(self) -> None:
        """Refuse models of the agents where all need one, or that are not as many."""
        model = self.model
        if not isinstance(model, AgentModels):
            return
        if not self.supports_agent_models:
            raise ValueError(
                f"model must be one for all agents of a {type(self).__name__}, got AgentModels: "
                "use GaussianFilter, EnsembleFilter or ParticleFilter"
            )
        if model.n_agents != self.n_agents:
            raise ValueError(
                f"model must have one for each of {self.n_agents} agents, got {model.n_agents}"
            )

    def model_of_states(self, runs: tuple[int, ...]) -> Model:
        """Return the model of states (*runs, A, ..., d)."""
        model = self.model
        return model.at_axis(len(runs)) if isinstance(model, AgentModels) else model

    def check_likelihood(self, sensor: Sensor) -> None:
        """Refuse a sensor that is a likelihood, where the noise is taken as Gaussian."""
        if not isinstance(sensor, LikelihoodSensor):
            return
        if not self.supports_likelihoods:
            raise ValueError(
                f"sensors must have Gaussian noise in {type(self).__name__}, got a "
                "LikelihoodSensor: use ParticleFilter, TransportFilter, GridFilter or "
                "LikelihoodConsensusFilter"
            )
        # The gate compares an observation with the mean and covariance of its prediction.
        if self.gate_probability is not None and sensor.moments is None:
            raise ValueError(
                "sensors must be LikelihoodSensors with moments for a gate, got moments of None"
            )

    def _check_waiting(self) -> None:
        """Refuse a filter whose observations wait for an exchange and cannot be used then."""
        # An observation that has waited is assimilated at its own time, as a delayed one.
        if not self.lag:
            raise ValueError(
                "lag must be at least 1 for observations that wait for an exchange, got 0"
            )
        if self.change_sources:
            raise ValueError(
                "sensors must not be increments where observations wait for an exchange: "
                "use share_observations=False or no exchange_interval"
            )

    @cached_property
    def periods(self) -> Periods:
        """The model's periods."""
        return cast(Periods, self.model.periods)

    @cached_property
    def lacks_periods(self) -> bool:
        """Whether angles are observed, but no component is declared circular."""
        observes = any(s.wraps for sensors in self.agent_sensors for s in sensors)
        return observes and not self.periods

    @cached_property
    def notices_wrapping(self) -> bool:
        """Whether the steps look for a transition that wraps angles; a linear one cannot."""
        return self.lacks_periods and not isinstance(self.model, LinearModel)

    @cached_property
    def n_agents(self) -> int:
        """Number A of agents."""
        return len(self.sensors)

    @cached_property
    def agent_sensors(self) -> tuple[tuple[Sensor, ...], ...]:
        """Each agent's sensors."""
        # None, one sensor, or several: always a tuple.
        result: list[tuple[Sensor, ...]] = []
        for sensors in self.sensors:
            if sensors is None:
                result.append(())
            elif isinstance(sensors, Sensor):
                result.append((sensors,))
            else:
                result.append(tuple(sensors))
        return tuple(result)

    @cached_property
    def change_sources(self) -> tuple[tuple[int, int], ...]:
        """All sensors of changes, as pairs of an agent and the number of its sensor."""
        sources = []
        for agent, sensors in enumerate(self.agent_sensors):
            for number, sensor in enumerate(sensors):
                if sensor.uses_previous:
                    sources.append((agent, number))
        return tuple(sources)

    @cached_property
    def observation_sizes(self) -> tuple[int | None, ...]:
        """Size m of each agent's observation; None without a sensor, and with several."""
        return tuple([s[0].dim if len(s) == 1 else None for s in self.agent_sensors])

    @cached_property
    def reads_by_default(self) -> bool:
        """Whether no subclass reads observations in its own way."""
        return type(self).read_observations is SensorFilter.read_observations

    @cached_property
    def sends_observations(self) -> bool:
        """Whether agents send their observations to their neighbours."""
        return self.graph is not None and self.share_observations

    @property
    def components(self) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """Names and units of the state's components; numbers if the model has no names."""
        model = self.model
        # A model without names or units has numbers and blanks.
        names = tuple(model.names) or tuple(str(k) for k in range(model.dim))
        return names, tuple(model.units) or ("",) * model.dim

    @validated
    def reset(
        self,
        state: S,
        components: Sequence[int | str],
        value: object,
        cov: object,
        *,
        agents: Sequence[int] | None = None,
    ) -> S:
        """Return the state with a new belief about some components, and all others as they are.

        For a landmark that is seen for the first time, a bias that begins, or a sensor that has
        been restarted: the components become ``value(x) + e`` with e ~ N(0, `cov`). Beliefs about
        earlier times keep the former components. Exact for linear functions; a Gaussian filter
        uses the derivative at its mean.

        Parameters
        ----------
        state : State
            The state; it is not changed.
        components : sequence of int or str
            The k components, by index or by the model's names.
        value : array_like, (k,), or callable
            Their new mean; or a function of the whole state, (..., d) to (..., k), such as the
            place of a landmark, from the robot's pose and what it observed.
        cov : array_like, (k, k)
            Covariance of e, positive semidefinite.
        agents : sequence of int, optional
            The agents whose beliefs change; all by default.

        Examples
        --------
        A robot at x on a line, which it knows to 2, sees a landmark 5 ahead, to 0.1:

        >>> import numpy as np
        >>> from distfilt.filters import GaussianFilter
        >>> from distfilt.models import Model
        >>> from distfilt.sensors import component
        >>> still = Model(
        ...     2,
        ...     lambda x, t, dt: x,
        ...     lambda t, dt: np.zeros((2, 2)),
        ...     names=("robot", "landmark"),
        ... )
        >>> f = GaussianFilter(still, [component([0], std=1.0)])
        >>> state = f.start(([3.0, 0.0], np.diag([4.0, 1e6])))
        >>> state = f.reset(state, ["landmark"], lambda x: x[..., :1] + 5.0, [[0.01]])
        >>> state.means[0], state.covariances[0].round(2)
        (array([3., 8.]), array([[4.  , 4.  ],
               [4.  , 4.01]]))

        The landmark has been moved, nobody knows where to:

        >>> f.reset(state, ["landmark"], [0.0], [[1e6]]).covariances[0].round(2)
        array([[4.e+00, 0.e+00],
               [0.e+00, 1.e+06]])
        """
        self.check_state(state)
        names, _ = self.components
        reset = read_reset(components, value, cov, agents, names, self.n_agents)
        if state.rejection_streaks is not None:
            # The former belief's rejections do not count for the new one. The counts have the axes
            # (*runs, A, source, sensor).
            streaks = state.rejection_streaks.copy()
            streaks[..., reset.agents, :, :] = 0.0
            state = state.replace(rejection_streaks=streaks)
        return self.reset_belief(state, reset)

    def reset_belief(self, state: S, reset: Reset) -> S:
        """Return the state with the new belief; a family that can do so extends it."""
        raise ValueError(
            f"state must be Gaussians or members to be reset, got a {type(state).__name__}"
        )

    def channel(self, state: S, t: float) -> Channel | None:
        """Return the channel of the step to `t`; None where nobody can send."""
        graph = self.graph
        if graph is None:
            return None
        if not self.is_exchange_time(state.t, t):
            return None
        # A moving graph is asked for its links at this time.
        if not isinstance(graph, Graph):
            graph = as_graph(graph(t), self.n_agents, self.names)
        # Without a link nothing can be sent, and no round is counted.
        if not graph.senders.size:
            return None
        runs = state.failed.shape if isinstance(state, SensorState) else state.runs
        channel = Channel.construct(
            graph, ledger=state.ledger, runs=runs, faults=self.faults, t=t
        )
        channel.periods = self.periods
        return channel

    def read_observations(
        self, observations: object, runs: tuple[int, ...], t: float
    ) -> list[list[Observation]]:
        """Check the observations of one time, and return a list of them for each agent."""
        # The number of components that each agent observes; None for an agent without a sensor or
        # with several, which no shape of an array fits.
        sizes = self.observation_sizes
        if type(observations) is not list or len(observations) != len(sizes):
            return read_observations(self, observations, runs, t)
        # Nearly always every agent has one finite float64 array of the right shape, or
        # events that fit their sensors.
        result: list[list[Observation]] = []
        for agent, (entry, size) in enumerate(zip(observations, sizes, strict=True)):
            if entry is None:
                result.append([])
                continue
            if type(entry) is list:
                for o in entry:
                    if not self._fits(o, agent, runs, t):
                        return read_observations(self, observations, runs, t)
                result.append(entry.copy())
                continue
            # Anything else, or a missing number, takes the general way, which checks and completes.
            if (
                type(entry) is not np.ndarray
                or entry.dtype != _FLOAT64
                or entry.shape != (*runs, size)
                or np.count_nonzero(np.isfinite(entry)) < entry.size
            ):
                return read_observations(self, observations, runs, t)
            result.append([Observation.construct(t, agent, entry)])
        return result

    def _fits(
        self, observation: object, agent: int, runs: tuple[int, ...], t: float
    ) -> bool:
        """Whether an Observation is complete, of this time, and by a sensor of the agent.

        A sensor that comes with it is checked elsewhere.
        """
        if type(observation) is not Observation:
            return False
        number = observation.sensor
        sensors = self.agent_sensors[agent]
        if type(number) is not int or number >= len(sensors):
            return False
        if observation.agent != agent or observation.t != t:
            return False
        # One that arrives later must come as a delayed one.
        if observation.arrival_time is not None and observation.arrival_time > t:
            return False
        value = observation.value
        return value.shape == (*runs, sensors[number].dim) and all_finite(value)


def require_rng(rng: Rng | None) -> Rng:
    """Return a generator, or refuse to do without one."""
    if rng is None:
        raise InvalidArgumentError(
            "rng must be a numpy.random.Generator, got None: use np.random.default_rng(seed)"
        )
    return rng


def _describe_repetition(observation: Observation) -> str:
    """Return the warning of an observation that has come twice."""
    sensor = observation.sensor
    name = f"{sensor.kind} sensor" if isinstance(sensor, Sensor) else f"sensor {sensor}"
    return (
        f"observations must differ to count each, got the same value of agent "
        f"{observation.agent}'s {name} at t = {format_number(observation.t)} s twice: it "
        "counts once; a second sensor has a number of its own"
    )


def _arrival_time(observation: Observation) -> float:
    """Return when an observation arrives; one without a time has always been there."""
    return -np.inf if observation.arrival_time is None else observation.arrival_time


def _smooth_states(states: Iterable[S], lag: int) -> Iterator[tuple[S, S]]:
    """Yield each state, and the belief about its time when `lag` more have been observed.

    A state's `lagged_states` are its beliefs about the `lag` times before it, oldest first.
    """
    if not lag:
        for state in states:
            yield state, state
        return
    recent: list[S] = []
    for state in states:
        recent.append(state)
        steps = [one.t for one in recent]
        # A time between two steps would shift the others among the lagged states.
        if any(time not in steps for time in state.times if time > steps[0]):
            raise ValueError(
                "delayed must be of one of the times for smoothing, got one between two of them"
            )
        if len(recent) > lag:
            # The oldest of these, and the last state's belief about its time, `lag` steps back
            yield recent.pop(0), state.lagged_states[-lag]
    # The last states have fewer times after them: the final state's beliefs serve for all.
    if recent:
        beliefs = [*recent[-1].lagged_states, recent[-1]]
        yield from zip(recent, beliefs[-len(recent) :], strict=True)
