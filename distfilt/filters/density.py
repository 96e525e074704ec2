"""Density filters: agents that see their own position, talk, and estimate the density of all."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..checks import Array, array, choice, count, instance, number
from ..density import (
    FokkerPlanck,
    LowRank,
    Shared,
    kernel_information,
    low_rank_step,
    shared_moved,
    shared_start,
    shared_step,
    zero_mean_prior,
)
from ..density.kernel import _width
from ..density.seen import Seen, present_graph
from ..density.sharing import Sharing
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
    filters : Shared or None
        The filters of the agents that have one, if the model is taken as exact.
    low : tuple of LowRank
        The same, if it is not.

    Examples
    --------
    >>> DensityState(0.0, Ledger.empty(1), None, np.zeros((1, 2)), (), np.ones((1, 4)),
    ...              np.ones(1), 1, shared_start(np.ones((4, 1)), np.ones((1, 4)))).estimates.shape
    (1, 4)
    """

    positions: Array
    carried: tuple[Array, ...]
    observed: Array
    counted: Array
    parts: int
    filters: Shared | None
    low: tuple[LowRank, ...] = ()

    @property
    def estimates(self) -> Array:
        """The estimated densities of the agents that have a filter, (F, n)."""
        if self.filters is not None:
            return self.filters.estimates
        return np.stack([state.mean for state in self.low])

    @property
    def variances(self) -> Array:
        """Their variances, cell by cell, (F, n)."""
        if self.filters is not None:
            return self.filters.variances
        return np.stack([(state.factor**2).sum(axis=-1) for state in self.low])


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
    first_std : float
        Width of the flat Gaussian.
    rank, prior_length, prior_std
        Of :func:`~distfilt.density.zero_mean_prior`.
    mass_std : float
        Standard deviation of the prior's total mass. With 0, the default, no measurement can change
        the mass; above 0 it can, as in the paper.
    noise : {"forecast", "observed"}
        Whether R is k̄ times the filter's own density, or times what it observes as printed; the
        second weighs by the noise itself and is biased.
    floor : float
        Least density in R, positive.
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
    bandwidth: float = field(kw_only=True)
    local: tuple[int, ...] | None = field(default=None, kw_only=True)
    first: str | ArrayLike = field(default="flat", kw_only=True)
    first_std: float = field(default=0.3, kw_only=True)
    rank: int = field(default=48, kw_only=True)
    prior_length: float = field(default=0.1, kw_only=True)
    prior_std: float = field(default=1.0, kw_only=True)
    mass_std: float = field(default=0.0, kw_only=True)
    noise: str = field(default="forecast", kw_only=True)
    floor: float = field(default=0.1, kw_only=True)
    number_known: bool = field(default=True, kw_only=True)
    process: float | None = field(default=None, kw_only=True)
    faults: Faults | None = field(default=None, kw_only=True)
    names: tuple[str, ...] = field(default=(), kw_only=True)

    def __post_init__(self) -> None:
        instance(self.model, "model", FokkerPlanck)
        size = count(self.size, "size")
        count(self.rank, "rank")
        if not callable(self.graph) and not isinstance(self.graph, Graph):
            number(self.graph, "graph", above=0)
        for name in ("begin", "learn"):
            if not callable(getattr(self.sharing, name, None)):
                raise ValueError(f"sharing: needs {name}, got {type(self.sharing).__name__}")
        for name in ("bandwidth", "first_std", "floor"):
            number(getattr(self, name), name, above=0)
        _width(self.bandwidth, self.model.grid, 1)
        if self.local is not None:
            found = [count(i, "local", at_least=0) for i in self.local]
            if not found or max(found) >= size or len(set(found)) < len(found):
                raise ValueError(f"local: needs distinct agents below {size}, got {self.local}")
        if isinstance(self.first, str):
            choice(self.first, "first", ("flat", "observed"))
        else:
            array(self.first, "first", (self.model.grid.size,))
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
        x = array(observations, "observations",
                  (times.size, self.size, self.model.grid.dim), finite=False)
        return list(x)

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
        if runs:
            raise ValueError(f"runs: needs (), as every run has a graph of its own, got {runs}")
        seen = self._seen(prior, "prior", number(t, "t"))
        here, basis = self.filtering, self._basis
        base = self._base(seen)[here]
        exact = self.process is None
        return DensityState(
            float(t), Ledger.empty(self.size), None, seen.places, self.sharing.begin(seen),
            seen.kernels[here], np.full(self.size, float(self.size)), 1,
            shared_start(basis, base) if exact else None,
            () if exact else tuple(LowRank(m, basis) for m in base),
        )

    @cached_property
    def _basis(self) -> Array:
        """A factor of the prior covariance, (n, r)."""
        grid = self.model.grid
        basis = zero_mean_prior(
            grid, rank=self.rank, length=self.prior_length, std=self.prior_std)
        if self.mass_std == 0:
            return basis
        even = np.full((grid.size, 1), self.mass_std / (grid.size * grid.volume))
        return np.concatenate([even, basis], axis=1)

    def _base(self, seen: Seen) -> Array:
        grid = self.model.grid
        if not isinstance(self.first, str):
            return np.tile(array(self.first, "first", (grid.size,)), (self.size, 1))
        if self.first == "observed":
            if self.sharing.reference:
                door = Channel(Graph.from_edges(self.size, np.zeros((0, 2))))
                return self.sharing.learn((), seen, door, 1.0)[1]
            return seen.kernels
        return seen.flat(self.first_std)

    def _seen(self, positions: ArrayLike, name: str, t: float) -> Seen:
        return Seen.checked(
            positions, name, self.size, self.model.grid, self.bandwidth, t, self.local
        )

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
        if late:
            raise ValueError(f"late: needs none, as positions are of now, got {len(late)}")
        dt = number(t, "t", above=state.t) - state.t
        seen = self._seen(observations, "observations", float(t))
        if isinstance(self.graph, Graph) or callable(self.graph):
            graph = present_graph(self.graph_at(float(t), seen.places), seen.present)
        else:
            graph = seen.near(self.graph)
        channel = Channel(graph, ledger=state.ledger, faults=self.faults, t=float(t))
        carried, y, counted = self.sharing.learn(state.carried, seen, channel, dt)
        y = y[self.filtering]
        filters, low = self._filtered(state, y, counted, seen, dt)
        parts = np.unique(graph.components[seen.present]).size
        return DensityState(
            float(t), channel.ledger, None, seen.places, carried, y, counted, parts, filters, low
        )

    def _filtered(
        self, state: DensityState, y: Array, counted: Array, seen: Seen, dt: float
    ) -> tuple[Shared | None, tuple[LowRank, ...]]:
        """The filters after they have moved and taken in what their agents learned."""
        here, move = self.filtering, self.model.solver(state.t, dt)
        known = self.number_known
        size = np.full(here.size, float(seen.present.sum())) if known else counted[here]
        unit = kernel_information(self.model.grid, bandwidth=self.bandwidth, agents=1)
        shared = None if state.filters is None else shared_moved(state.filters, move)
        moved = move(state.estimates) if shared is None else shared.estimates
        level = moved if self.noise == "forecast" else y
        noise = (unit / np.maximum(size, 1.0))[:, None] * np.maximum(level, self.floor)
        noise[~seen.present[here]] = np.inf
        if shared is not None:
            return shared_step(shared, y, noise, dt), ()
        q = (self.process or 0.0) * self._basis
        return None, tuple(
            low_rank_step(s, move, y[i], noise[i], dt, process=q) for i, s in enumerate(state.low)
        )

    def summary(self, state: DensityState) -> Summary:
        """Densities and their variances of all agents, NaN for those without a filter.

        ``parts`` is the number of parts of the network, ``counted`` how many agents each believes
        in, ``mass`` the estimate's integral.
        """
        n, here = self.model.grid.size, self.filtering
        mean, variance = (np.full((self.size, n), np.nan) for _ in range(2))
        mean[here], variance[here] = state.estimates, state.variances
        numbers = {
            "parts": np.full(self.size, float(state.parts)),
            "counted": state.counted,
            "mass": mean.sum(axis=-1) * self.model.grid.volume,
        }
        return Summary(mean, variance, numbers=numbers)
