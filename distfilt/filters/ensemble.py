"""A network of ensemble filters: forecast, assimilate what was heard, agree with the neighbours.

Algorithm 1 of Grange et al., for any model, sensors, graph, update and consensus rule.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from ..checks import Array, array, callable_, count, generator, number
from ..models import Model
from ..network import Channel, Faults, Graph, Ledger
from ..progress import track
from ..sensors import Sensor
from .assimilation import Update, assimilate
from .observations import at_one_time, over_times
from .record import SCORES, as_dataset
from .state import EnsembleState

if TYPE_CHECKING:
    import xarray

__all__ = ["EnsembleFilter", "EnsembleState", "Late"]

Consensus = Callable[[Array, Channel], Array]


@dataclass(frozen=True)
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
        When it became known, in s; used by :meth:`EnsembleFilter.run`.

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
        array(self.value, "value", (..., "m"), finite=False)


@dataclass(frozen=True)
class EnsembleFilter:
    """One ensemble per agent; agents share observations and pull each other towards agreement.

    In every step each agent moves its members with the model, sends its observation to those that
    hear it, updates its members with what it knows, and applies the consensus rule. All that
    passes between agents passes through one :class:`~distfilt.network.Channel`.

    Parameters
    ----------
    model : Model
        How the state moves; known to all agents.
    sensors : sequence of Sensor or None, length A
        What each agent sees; None for an agent without a sensor. Neighbours know each other's
        sensors.
    graph : Graph, or callable t -> Graph
        Who hears whom.
    update : callable
        ``update(ensemble, predicted, observed, noise, *, rng) -> ensemble``, such as
        :func:`distfilt.triangular.conditioning.affine_update`.
    consensus : callable, optional
        ``consensus(ensembles, channel) -> ensembles``, such as
        ``partial(mean_pull, gain=0.05)``; none by default.
    members : int
        Number N of members of each agent.
    faults : Faults, optional
        Messages lost and agents silenced; a lost observation is a missing one. A delay is not
        accepted: an observation that comes late has its own time, pass it as :class:`Late`.
    lag : int
        How many earlier times are kept for late observations. Each of them is conditioned on
        every observation too, so a step costs 1 + `lag` updates.

    Examples
    --------
    >>> from distfilt.sensors import direct
    >>> from distfilt.triangular.conditioning import affine_update
    >>> walk = Model(1, lambda x, t, dt: x, lambda t, dt: np.array([[dt]]))
    >>> pair = Graph.from_adjacency([[0, 1], [1, 0]])
    >>> f = EnsembleFilter(walk, [direct([0], noise=0.5), None], pair, affine_update, members=50)
    >>> state = f.start(np.zeros((50, 1)) + np.linspace(-2, 2, 50)[:, None],
    ...                 rng=np.random.default_rng(0))
    >>> state = f.step(state, 1.0, [[0.8], None])
    >>> state.ensembles.mean(axis=1).round(1).ravel()
    array([0.8, 0.6])
    """

    model: Model
    sensors: Sequence[Sensor | None]
    graph: Graph | Callable[[float], Graph]
    update: Update
    consensus: Consensus | None = None
    members: int = 100
    faults: Faults | None = None
    lag: int = 0

    def __post_init__(self) -> None:
        if not isinstance(self.model, Model):
            raise ValueError(f"model: needs a Model, got {type(self.model).__name__}")
        for sensor in self.sensors:
            if sensor is not None and not isinstance(sensor, Sensor):
                raise ValueError(f"sensors: needs Sensor or None, got {type(sensor).__name__}")
        if isinstance(self.graph, Graph):
            self._check_graph(self.graph)
        else:
            callable_(self.graph, "graph")
        callable_(self.update, "update")
        if self.consensus is not None:
            callable_(self.consensus, "consensus")
        if self.faults is not None and (not isinstance(self.faults, Faults) or self.faults.delay):
            raise ValueError(f"faults: needs Faults without a delay, got {self.faults!r}")
        count(self.members, "members", at_least=2)
        count(self.lag, "lag", at_least=0)

    def _check_graph(self, graph: Graph) -> Graph:
        if not isinstance(graph, Graph):
            raise ValueError(f"graph: needs a Graph, got {type(graph).__name__}")
        if graph.size != len(self.sensors):
            raise ValueError(
                f"graph: needs {len(self.sensors)} agents like sensors, got {graph.size}"
            )
        return graph

    def _graph_at(self, t: float) -> Graph:
        return self.graph if isinstance(self.graph, Graph) else self._check_graph(self.graph(t))

    def start(
        self,
        prior: ArrayLike | Callable[..., Array],
        *,
        rng: np.random.Generator,
        runs: tuple[int, ...] = (),
        t: float = 0.0,
    ) -> EnsembleState:
        """The state before the first step.

        Parameters
        ----------
        prior : array_like or callable
            Members (N, d) for every agent and run, or (*runs, A, N, d); or a function
            ``prior(members, rng=rng, leading=leading)`` that draws (*leading, N, d), such as
            ``partial(ensembles.draw, mean, cov)``.
        rng : numpy.random.Generator
            Draws the prior; a child stream of it, independent of whatever else is drawn from it,
            serves all later steps.
        runs : tuple of int
            Leading axes: independent runs.
        t : float
            The time of the prior, in s.
        """
        shape = (*(count(n, "runs") for n in runs), len(self.sensors), self.members, self.model.dim)
        generator(rng)
        drawn = prior(self.members, rng=rng, leading=shape[:-2]) if callable(prior) else prior
        members = array(np.asarray(drawn), "prior", (..., self.members, self.model.dim))
        if members.shape != shape and members.shape != shape[-2:]:
            raise ValueError(f"prior: needs shape {shape} or {shape[-2:]}, got {members.shape}")
        ensembles = np.broadcast_to(members, shape).copy()
        ledger = Ledger.empty(len(self.sensors))
        return EnsembleState(number(t, "t"), ensembles, rng.spawn(1)[0], ledger)

    def step(
        self,
        state: EnsembleState,
        t: float,
        observations: Sequence[ArrayLike | None],
        *,
        late: Sequence[Late] = (),
    ) -> EnsembleState:
        """Move to time `t` and take in what was observed there.

        Parameters
        ----------
        state : EnsembleState
            Not changed.
        t : float
            The new time, after the state's.
        observations : sequence of length A
            Per agent (*runs, m) or (m,), or None. NaN marks a missing component, run by run.
        late : sequence of Late
            Observations of earlier times that arrive now; needs a `lag` that reaches back to them.

        Raises
        ------
        ValueError
            If `t` is not later, or an observation does not fit its sensor or no earlier state is
            kept for a late one.
        """
        self._check_state(state)
        dt = number(t, "t", above=state.t) - state.t
        seen = at_one_time(observations, self.sensors, state.runs)
        earlier = [self._checked_late(item, state) for item in late]
        rng = copy.deepcopy(state.rng)
        channel = Channel(
            self._graph_at(t), ledger=state.ledger, runs=state.runs, faults=self.faults
        )
        ensembles = self.model.sample_step(state.ensembles, state.t, dt, rng=rng)
        kept = (*state.history, (state.t, state.ensembles)) if self.lag else ()
        stack = [*(e.copy() for _, e in kept), ensembles]
        for slot, observed in earlier:
            assimilate(stack, slot, observed, self.sensors, self.update, channel, rng)
        here = len(stack) - 1
        assimilate(
            stack, here, seen, self.sensors, self.update, channel, rng, previous=state.ensembles
        )
        moved = stack[-1]
        if self.consensus is not None:
            moved = array(self.consensus(moved, channel), "consensus", ensembles.shape)
        times = [time for time, _ in kept]
        history = tuple(zip(times, stack[:-1], strict=True))[-self.lag :] if self.lag else ()
        return EnsembleState(float(t), moved, rng, channel.ledger, history)

    def steps(
        self,
        state: EnsembleState,
        times: ArrayLike,
        observations: Sequence[ArrayLike | None],
        *,
        late: Sequence[Late] = (),
        progress: bool = False,
    ) -> Iterator[EnsembleState]:
        """The states at `times`, one after the other; arguments as in :meth:`run`."""
        self._check_state(state)
        grid, series = over_times(observations, self.sensors, times)
        waiting = sorted(late, key=lambda item: item.arrived)
        if waiting and grid.size and waiting[-1].arrived > grid[-1]:
            raise ValueError(
                f"late: needs arrivals up to {grid[-1]:g}, got one at {waiting[-1].arrived:g}"
            )
        for k, t in enumerate(track(grid, show=progress)):
            due = [item for item in waiting if item.arrived <= t]
            waiting = waiting[len(due) :]
            now = [None if o is None else o[k] for o in series]
            state = self.step(state, float(t), now, late=due)
            yield state

    def run(
        self,
        state: EnsembleState,
        times: ArrayLike,
        observations: Sequence[ArrayLike | None],
        *,
        truth: ArrayLike | None = None,
        scores: Collection[str] = SCORES,
        late: Sequence[Late] = (),
        progress: bool = False,
    ) -> xarray.Dataset:
        """Step through a series and record it.

        Parameters
        ----------
        state : EnsembleState
            Where to begin.
        times : array_like, (T,)
            Strictly increasing; steps may differ in length.
        observations : sequence of length A
            Per agent (T, *runs, m) or (T, m), or None. NaN marks what is missing.
        truth : array_like, (T, *runs, d), optional
            If given, the scores are recorded too.
        scores : collection of {"squared_error", "nees", "crps"}
            Which of them; CRPS costs about as much as the filter.
        late : sequence of Late
            Each is taken in at the first of `times` that is not before its arrival.
        progress : bool
            Show a progress bar when a person watches.

        Returns
        -------
        xarray.Dataset
            ``mean``, ``variance``, ``spread`` and the ledger's ``messages``, ``scalars``,
            ``bytes`` over time, run, agent and component; with `truth` also ``squared_error``,
            ``nees`` and ``crps``.
        """
        known = None
        if truth is not None:
            known = array(truth, "truth", (np.size(times), *state.runs, self.model.dim))
        states = self.steps(state, times, observations, late=late, progress=progress)
        return as_dataset(states, times, self.model, state, known, scores=scores)

    def _check_state(self, state: Any) -> None:
        if not isinstance(state, EnsembleState):
            raise ValueError(f"state: needs an EnsembleState, got {type(state).__name__}")
        needed = (len(self.sensors), self.members, self.model.dim)
        if state.ensembles.shape[-3:] != needed:
            raise ValueError(f"state: needs ensembles (..., {needed}), got {state.ensembles.shape}")

    def _checked_late(self, item: Late, state: EnsembleState) -> tuple[int, list[Array | None]]:
        """Where in the history a late observation belongs, and the observations of that time."""
        times = [t for t, _ in state.history] + ([state.t] if self.lag else [])
        match = [k for k, t in enumerate(times) if abs(t - item.measured) <= 1e-9 * max(1, abs(t))]
        if not match:
            kept = ", ".join(f"{t:g}" for t in times) or "none (lag = 0)"
            raise ValueError(f"late: needs an earlier time that is kept ({kept}), "
                             f"got {item.measured:g}")
        if item.agent >= len(self.sensors):
            raise ValueError(f"late: needs an agent below {len(self.sensors)}, got {item.agent}")
        sensor = self.sensors[item.agent]
        if sensor is not None and sensor.uses_previous:
            raise ValueError(f"late: a {sensor.kind} sensor cannot be late, it compares two times")
        observations: list[ArrayLike | None] = [None] * len(self.sensors)
        observations[item.agent] = item.value
        return match[0], at_one_time(observations, self.sensors, state.runs)
