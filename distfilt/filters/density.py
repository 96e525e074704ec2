"""Density filters: agents that see their own position, talk, and estimate the density of all."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import KW_ONLY, dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..checks import Array, array, choice, count, increasing, instance, number, places
from ..density import FokkerPlanck, LowRank, Sharing, low_rank, zero_mean_prior
from ..density.kernel import fine_enough
from ..density.sharing import Seen, alone, present_graph
from ..doors import unchecked
from ..network import Channel, Faults, Graph, Ledger
from .driver import Late, Summary, TeamFilter
from .saving import State

__all__ = ["DensityFilter", "DensityState"]

Graphs = float | Graph | Callable[[float, Array], Graph]


@dataclass(frozen=True, eq=False)
class DensityState(State):
    """What the agents believe between two steps.

    Parameters
    ----------
    t, ledger, rng
        As for :class:`~distfilt.filters.State`; `rng` is None, as nothing is drawn.
    positions : ndarray, (A, d)
        Where the agents are; NaN for those that have gone.
    carried : tuple of ndarray
        What the rule of sharing remembers.
    observed : ndarray, (F, n)
        What the agents with filters believe the swarm's kernel estimate to be.
    counted : ndarray, (A,)
        How many agents each believes there are.
    parts : int
        Into how many parts the network of the present agents fell in the last step.
    filters : LowRank
        The filters of the agents that have one.

    Examples
    --------
    >>> filters = low_rank.low_rank_start(np.ones((4, 1)), np.ones((1, 4)))
    >>> DensityState(0.0, Ledger.empty(1), None, np.zeros((1, 2)), (), np.ones((1, 4)),
    ...              np.ones(1), 1, filters).estimates.shape
    (1, 4)
    """

    positions: Array
    carried: tuple[Array, ...]
    observed: Array
    counted: Array
    parts: int
    filters: LowRank

    @property
    def estimates(self) -> Array:
        """The estimated densities of the agents that have a filter, (F, n)."""
        return self.filters.estimates

    @property
    def variances(self) -> Array:
        """Their variances, cell by cell, (F, n)."""
        return self.filters.variances


@dataclass(frozen=True, eq=False)
class DensityFilter(TeamFilter):
    r"""Local filters of a swarm's density, equations (14) to (16) of Zheng and Lin.

    In each step every agent sees its own position, learns by `sharing` an estimate y_i of the
    kernel estimate of all, and takes it into a Kalman filter of the density whose model is the
    Fokker-Planck equation. Where the network falls apart, agents go on with what they hear, and
    the record says into how many parts.

    Parameters
    ----------
    model : FokkerPlanck
        What the filters believe of the swarm, and their grid.
    size : int
        Number A of agents that there may be.
    graph : float, Graph or callable
        A radio's range; a graph that does not move; or ``graph(t, positions) -> Graph``.
    sharing : Sharing
        Such as :class:`~distfilt.density.PIConsensus`, :class:`~distfilt.density.Flooding`.
    bandwidth : float
        Of the kernels, at least half a cell.
    local : tuple of int, optional
        The agents that run a filter; all by default. All agents share.
    first : {"flat", "observed"} or array_like (n,)
        Prior mean: a flat Gaussian about the agent, its own kernel, or a density for all.
    first_std : float, optional
        Width of the flat Gaussian; by default .3 of the box's side.
    rank, prior_length, prior_std, mass_std
        Of :func:`~distfilt.density.zero_mean_prior`. With a `mass_std` of 0, the default, no
        measurement can change the mass; above 0 it can, as in the paper.
    noise : {"forecast", "observed"}
        Whether R is k̄ times the filter's own density, or times what it observes as printed; the
        second weighs by the noise itself and is biased.
    floor : float, optional
        Least density in R, positive; by default a tenth of the mean density.
    number_known : bool
        Whether agents know A; otherwise k̄ takes the number that their sharing tells.
    process : float, optional
        For a model that is not exact: Q is this times the prior's factor, per root second.
    faults : Faults, optional
        How the channel fails.
    names : tuple of str
        The agents' names.

    Examples
    --------
    >>> from distfilt.density import Flooding, Grid
    >>> from distfilt.models import rotating_swarm
    >>> swarm, rng = rotating_swarm(), np.random.default_rng(1)
    >>> f = DensityFilter(FokkerPlanck(swarm, Grid((15, 15))), 20, 0.4, Flooding(),
    ...                   bandwidth=0.12, rank=40)
    >>> x = rng.random((20, 2))
    >>> state = f.step(f.start(x), 0.1, swarm.step(x, 0.0, 0.1, rng=rng))
    >>> state.estimates.shape, state.ledger.rounds
    ((20, 225), 1)
    """

    model: FokkerPlanck
    size: int
    graph: Graphs
    sharing: Sharing
    _: KW_ONLY
    bandwidth: float
    local: tuple[int, ...] | None = None
    first: str | ArrayLike = "flat"
    first_std: float | None = None
    rank: int = 48
    prior_length: float | None = None
    prior_std: float | None = None
    mass_std: float = 0.0
    noise: str = "forecast"
    floor: float | None = None
    number_known: bool = True
    process: float | None = None
    faults: Faults | None = None
    names: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        instance(self.model, "model", FokkerPlanck)
        sizes = count(self.size, "size"), count(self.rank, "rank")
        if not callable(self.graph) and not isinstance(self.graph, Graph):
            number(self.graph, "graph", above=0)
        instance(self.sharing, "sharing", Sharing)  # type: ignore[type-abstract]
        for name in ("bandwidth", "first_std", "floor", "prior_length", "prior_std"):
            if getattr(self, name) is not None:
                number(getattr(self, name), name, above=0)
        fine_enough(self.model.grid, self.bandwidth)
        if self.local is not None:
            places(self.local, "local", sizes[0])
        if isinstance(self.first, str):
            choice(self.first, "first", ("flat", "observed"))
        else:
            first = array(self.first, "first", (self.model.grid.size,)).copy()
            object.__setattr__(self, "first", first)
        number(self.mass_std, "mass_std", at_least=0)
        choice(self.noise, "noise", ("forecast", "observed"))
        if self.process is not None:
            number(self.process, "process", above=0)
        self.check_team()

    @property
    def count(self) -> int:
        """Number A of agents."""
        return self.size

    @property
    def components(self) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """The grid's cells and the density's unit."""
        n = self.model.grid.size
        unit = "1/area" if self.model.grid.dim == 2 else "1/volume"
        return tuple(f"cell {k}" for k in range(n)), (unit,) * n

    @property
    def filtering(self) -> NDArray[np.int64]:
        """Numbers of the agents that run a filter, (F,)."""
        return np.array(range(self.size) if self.local is None else self.local)

    def series(self, observations: Any, times: Array) -> Sequence[Any]:
        """Per time the agents' positions, from (T, A, d); NaN rows are agents that have gone."""
        shape = increasing(times, "times").size, self.size, self.model.grid.dim
        return list(array(observations, "observations", shape, finite=False))

    def start(
        self, prior: ArrayLike, *, rng: np.random.Generator | None = None,
        runs: tuple[int, ...] = (), t: float = 0.0,
    ) -> DensityState:
        """The state before the first step.

        Parameters
        ----------
        prior : array_like, (A, d)
            The agents' positions; a row of NaN is an agent that is not here.
        rng : numpy.random.Generator, optional
            Not used: nothing is drawn. It is accepted so that all filters start alike.
        runs : tuple of int
            None: the graph moves with the run, so each run is a filter of its own.
        t : float
            In s.
        """
        self.check_alone(rng, runs)
        seen = self._seen(prior, "prior", number(t, "t"))
        here = self.filtering
        filters = unchecked(low_rank.low_rank_start)(self._basis, self._base(seen)[here])
        return DensityState(
            float(t), Ledger.empty(self.size), None, seen.positions, self.sharing.begin(seen),
            seen.kernels[here], np.full(self.size, float(self.size)), 1, filters,
        )

    @cached_property
    def _basis(self) -> Array:
        """A factor of the prior covariance, (n, r)."""
        return zero_mean_prior(
            self.model.grid, rank=self.rank, length=self.prior_length, std=self.prior_std,
            mass_std=self.mass_std,
        )

    def _base(self, seen: Seen) -> Array:
        """Prior means of all agents, (A, n)."""
        if not isinstance(self.first, str):
            return np.tile(np.asarray(self.first, dtype=np.float64), (self.size, 1))
        return alone(self.sharing, seen) if self.first == "observed" else seen.flat(self.first_std)

    def _seen(self, positions: ArrayLike, name: str, t: float) -> Seen:
        x = array(positions, name, (self.size, self.model.grid.dim), finite=False)
        return Seen(x, self.model.grid, self.bandwidth, t, self.local)

    def step(
        self, state: DensityState, t: float, observations: ArrayLike, *, late: Sequence[Late] = ()
    ) -> DensityState:
        """Move to time `t` and take in the agents' positions of then.

        Parameters
        ----------
        state : DensityState
        t : float
            In s, after the state's.
        observations : array_like, (A, d)
            Each agent's own position; a row of NaN is an agent that has gone. Its filter goes on
            without data.
        late : sequence of Late
            Has to be empty: a swarm's positions cannot be taken in afterwards.
        """
        instance(state, "state", DensityState)
        if instance(late, "late", Sequence):  # type: ignore[type-abstract]
            raise ValueError(f"late: needs none, as positions are of now, got {len(late)}")
        dt = number(t, "t", above=state.t) - state.t
        seen = self._seen(observations, "observations", float(t))
        if isinstance(self.graph, Graph) or callable(self.graph):
            graph = present_graph(self.graph_at(float(t), seen.positions), seen.present)
        else:
            graph = seen.near(self.graph)
        channel = Channel(graph, ledger=state.ledger, faults=self.faults, t=float(t))
        carried, y, counted = self.sharing.learn(state.carried, seen, channel, dt)
        y = y[self.filtering]
        agents = seen.present.sum() if self.number_known else counted

        move = self.model.solver(state.t, dt)
        q = None if self.process is None else self.process * self._basis
        moved = unchecked(low_rank.low_rank_moved)(state.filters, move, process=q, dt=dt)
        level = moved.estimates if self.noise == "forecast" else y
        noise = seen.noise(level, agents, self.floor)
        filters = unchecked(low_rank.low_rank_step)(moved, y, noise, dt)
        parts = np.unique(graph.components[seen.present]).size
        return DensityState(
            float(t), channel.ledger, None, seen.positions, carried, y, counted, parts, filters
        )

    def summary(self, state: DensityState) -> Summary:
        """Densities and their variances of all agents, NaN for those without a filter.

        ``parts`` is the number of parts of the network, ``counted`` how many agents each believes
        in, ``mass`` the estimate's integral.
        """
        instance(state, "state", DensityState)
        n, here = self.model.grid.size, self.filtering
        mean, variance = (np.full((self.size, n), np.nan) for _ in range(2))
        mean[here], variance[here] = state.estimates, state.variances
        return Summary(mean, variance, numbers={
            "parts": np.full(self.size, float(state.parts)),
            "counted": state.counted,
            "mass": mean.sum(axis=-1) * self.model.grid.volume,
        })
