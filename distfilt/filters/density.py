"""Density filters: agents that observe their own positions and estimate the density of all."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import KW_ONLY, dataclass, field
from functools import cached_property
from typing import Annotated, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from ..density import (
    ConsensusProtocol,
    FokkerPlanck,
    LowRank,
    low_rank_predict,
    low_rank_start,
    low_rank_step,
    zero_mean_prior,
)
from ..density.consensus import estimate_without_messages
from ..density.kernel import AxisWidths, check_resolution
from ..density.snapshot import SwarmSnapshot, remove_absent
from ..network import Channel, Graph
from ..network.graphs import as_graph
from ..validation import (
    ALLOW_NAN,
    Array,
    Bounds,
    DistinctIndices,
    NonNegativeFloat,
    PositiveFloat,
    PositiveInt,
    Rng,
    call_user,
    check_array,
    format_number,
)
from .observations import list_by_agent
from .options import ExchangesAtIntervals
from .priors import Prior
from .record import Summary
from .states import State
from .step import Step

__all__ = ["DensityFilter", "DensityState"]


@dataclass(frozen=True, eq=False, repr=False)
class DensityState(State):
    """The agents' density estimates between two steps.

    Parameters
    ----------
    t, ledger, rng
        As for :class:`~distfilt.filters.State`; `rng` is None, as nothing is drawn.
    positions : ndarray, (A, d)
        The agents' positions; NaN for those that have gone.
    carried : tuple of ndarray
        The memory of the consensus protocol.
    observed : ndarray, (F, n)
        The swarm's kernel estimate, as each agent with a filter estimates it.
    positions_sent : ndarray, (A,)
        The number of agents whose kernels are in an agent's density, as it counts or estimates
        them.
    parts : int
        Number of connected components of the present agents' graph in the last step.
    filters : LowRank
        The filters of the agents that have one.

    Examples
    --------
    >>> from distfilt.network import Ledger
    >>> filters = low_rank_start(np.ones((4, 1)), np.ones((1, 4)))
    >>> DensityState(
    ...     0.0,
    ...     Ledger.empty(1),
    ...     None,
    ...     np.zeros((1, 2)),
    ...     (),
    ...     np.ones((1, 4)),
    ...     np.ones(1),
    ...     1,
    ...     filters,
    ... ).estimates.shape
    (1, 4)
    """

    positions: Annotated[Array, "A d", ALLOW_NAN]
    carried: tuple[Array, ...]
    observed: Array
    positions_sent: Array
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
class DensityFilter(ExchangesAtIntervals[DensityState]):
    r"""Local filters of a swarm's density, equations (14) to (16) of Zheng and Lin.

    In each step every agent observes its own position, obtains by the `fusion` protocol an
    estimate y_i of the kernel estimate of all, and assimilates it in a Kalman filter of the density
    whose model is the Fokker-Planck equation. If the network falls apart, agents go on with the
    messages they receive, and the record has the number of parts. The noise of a step's estimate
    follows from the true number of present agents, which is taken as known: an agent that has
    received the positions of few is then overconfident.

    Parameters
    ----------
    model : FokkerPlanck
        The filters' model of the swarm, and their grid.
    sensors : int
        Largest number A of agents: each observes its own position.
    graph : float, Graph or callable
        A radio's range; a graph that does not move; or ``graph(t, positions) -> Graph``.
    fusion : ConsensusProtocol
        The protocol by which agents estimate the swarm's kernel estimate, such as
        :class:`~distfilt.density.PIConsensus` or :class:`~distfilt.density.Flooding`.
    exchange_interval, faults, names
        As in :mod:`distfilt.filters.options` and for :class:`~distfilt.filters.Filter`.
    bandwidth : float
        Of the kernels, at least half a cell.
    local : tuple of int, optional
        The agents that run a filter; all by default. All agents share their positions.
    initial_density : {"flat", "observed"} or array_like (n,)
        Prior mean: a flat Gaussian about the agent, its own kernel, or a density for all.
    initial_std : float
        Width of the flat Gaussian.
    rank, prior_length, prior_std, mass_std
        Of :func:`~distfilt.density.zero_mean_prior`. With a `mass_std` of 0, the default, no
        measurement can change the mass; above 0 it can, as in the paper.
    noise : {"forecast", "observed"}
        Whether R is k̄ times the filter's own density, or times the observed one as printed; the
        second correlates the weights with the noise and is biased.
    floor : float
        Least density in R, positive.
    process : float, optional
        For a model that is not exact: Q is this times the prior's factor, per root second.

    Examples
    --------
    >>> from distfilt.density import Flooding, Grid
    >>> from distfilt.models import rotating_swarm
    >>> swarm, rng = rotating_swarm(), np.random.default_rng(1)
    >>> f = DensityFilter(
    ...     FokkerPlanck(swarm, Grid((15, 15))),
    ...     20,
    ...     0.4,
    ...     fusion=Flooding(),
    ...     bandwidth=0.12,
    ...     rank=40,
    ... )
    >>> x = rng.random((20, 2))
    >>> state = f.step(f.start(x), 0.1, swarm.step(x, 0.0, 0.1, rng=rng))
    >>> state.estimates.shape, state.ledger.rounds
    ((20, 225), 1)
    """

    model: FokkerPlanck
    sensors: PositiveInt
    graph: PositiveFloat | Graph | Callable[[float, Array], Graph]
    _: KW_ONLY
    fusion: ConsensusProtocol = field()
    bandwidth: AxisWidths
    local: DistinctIndices | None = None
    initial_density: (
        Literal["flat", "observed"] | Annotated[Array, "model.grid.size"]
    ) = "flat"
    initial_std: PositiveFloat | None = None
    rank: PositiveInt = 48
    prior_length: PositiveFloat | None = None
    prior_std: PositiveFloat | None = None
    mass_std: NonNegativeFloat = 0.0
    noise: Literal["forecast", "observed"] = "forecast"
    floor: PositiveFloat | None = None
    process: PositiveFloat | None = None

    state_class: ClassVar[type[State]] = DensityState
    supports_runs: ClassVar[bool] = False
    belief_kind: ClassVar[str | None] = "densities"

    def check_parts(self) -> None:
        """Refuse a bandwidth below the grid's cells, and agents that do not exist."""
        super().check_parts()
        check_resolution(self.model.grid, self.bandwidth)
        Bounds(below=self.n_agents)(max(self.local or (0,)), "local")

    @cached_property
    def n_agents(self) -> int:
        """Number A of agents."""
        return int(self.sensors)

    @property
    def components(self) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """The grid's cells and the density's unit."""
        n = self.model.grid.size
        unit = "1/area" if self.model.grid.dim == 2 else "1/volume"
        return tuple(f"cell {k}" for k in range(n)), (unit,) * n

    @property
    def filtering(self) -> NDArray[np.int64]:
        """Numbers of the agents that run a filter, (F,)."""
        return np.array(range(self.n_agents) if self.local is None else self.local)

    def read_observations(
        self, observations: object, runs: tuple[int, ...], t: float
    ) -> SwarmSnapshot:
        """Check the agents' positions (A, d); None and NaN are agents that have gone."""
        # An agent that has gone has a position of NaN.
        missing = np.full(self.model.grid.dim, np.nan)
        entries = list_by_agent(observations, self.n_agents)
        positions = [missing if entry is None else entry for entry in entries]
        return self._snapshot(positions, "observations", t)

    def initial_state(
        self, prior: Prior, runs: tuple[int, ...], rng: Rng | None
    ) -> dict[str, object]:
        """Return the estimates at the agents' first positions (A, d), NaN for absent agents."""
        snapshot = self._snapshot(prior, "prior", t=0.0)
        # Only these agents have a filter. At the start all are taken to be connected.
        agents = self.filtering
        filters = low_rank_start(self._prior_factor, self._prior_mean(snapshot)[agents])
        return {
            "positions": snapshot.positions,
            "carried": self.fusion.initial_state(snapshot),
            "observed": snapshot.kernels[agents],
            "positions_sent": np.full(self.n_agents, float(self.n_agents)),
            "parts": 1,
            "filters": filters,
        }

    @cached_property
    def _prior_factor(self) -> Array:
        """A factor of the prior covariance, (n, r)."""
        return zero_mean_prior(
            self.model.grid,
            rank=self.rank,
            length=self.prior_length,
            std=self.prior_std,
            mass_std=self.mass_std,
        )

    def _prior_mean(self, snapshot: SwarmSnapshot) -> Array:
        """Return the prior means of all agents, (A, n)."""
        if not isinstance(self.initial_density, str):
            return np.tile(self.initial_density, (self.n_agents, 1))
        flat = snapshot.initial_gaussians(self.initial_std)
        if self.initial_density == "observed":
            # An absent agent has no kernel of its own.
            kernels = estimate_without_messages(self.fusion, snapshot)
            return np.where(snapshot.present[:, None], kernels, flat)
        return flat

    def _snapshot(self, positions: object, name: str, t: float) -> SwarmSnapshot:
        """Check positions (A, d) and return them with their kernels."""
        shape = (self.n_agents, self.model.grid.dim)
        x = check_array(positions, name, shape, finite=False)
        return SwarmSnapshot(x, self.model.grid, self.bandwidth, t, self.local)

    def _graph_at(self, snapshot: SwarmSnapshot, t_before: float, t: float) -> Graph:
        """Return the graph of the present agents in a step from `t_before` to `t`.

        It has no links if no exchange is due.
        """
        if not self.is_exchange_time(t_before, t):
            return Graph.from_edges(self.n_agents, np.zeros((0, 2)))
        if isinstance(self.graph, float):
            # The range of the agents' radios
            return snapshot.disk_graph(self.graph)
        graph = self.graph
        # A moving graph may depend on where the agents are.
        if not isinstance(graph, Graph):
            graph = call_user(graph, t, snapshot.positions)
        return remove_absent(as_graph(graph, self.n_agents), snapshot.present)

    def next_state(self, step: Step[DensityState]) -> DensityState:
        """Share the agents' positions, and assimilate the density that each agent derives.

        >>> from distfilt.density import Flooding, Grid
        >>> from distfilt.models import rotating_swarm
        >>> from distfilt.network import Faults
        >>> parts = FokkerPlanck(rotating_swarm(), Grid((9, 9))), 4, 2.0
        >>> options = {"fusion": Flooding(), "bandwidth": 0.2, "rank": 9}
        >>> x = np.random.default_rng(1).random((4, 2))
        >>> for option in ({"faults": Faults(silent=[0])}, {"exchange_interval": 1.0}):
        ...     f = DensityFilter(*parts, **options, **option)
        ...     print(f.step(f.start(x), 0.5, x).ledger.messages)
        [0 2 2 2]
        [0 0 0 0]
        """
        state = step.state
        # The agents' positions, and the kernels about them
        snapshot: SwarmSnapshot = step.observations
        t = step.t
        dt = step.dt
        if not dt:
            raise ValueError(
                f"t must be above {format_number(state.t)}, got {format_number(t)}"
            )
        # The graph depends on the positions, so the channel is made here.
        graph = self._graph_at(snapshot, state.t, t)
        channel = Channel(graph, ledger=state.ledger, faults=self.faults, t=t)
        # Agents move, drop out and wait for an exchange: a network in several parts is no reason
        # for the channel's warning, since the record has their number.
        channel.expects_parts = True
        step.channel = channel
        # The protocol's new memory, each agent's estimate of the kernel density, (A, n), and of how
        # many agents' kernels it is made, (A,)
        memory, densities, counts = self.fusion.update(
            state.carried, snapshot, channel, dt
        )
        # The protocol runs at all agents, the filter at some of them.
        observed = densities[self.filtering]

        # The forecast is one step of the Fokker-Planck equation. The factor of Q is in proportion
        # to that of the prior covariance.
        solver = self.model.solver(state.t, dt)
        noise_factor = None
        if self.process is not None:
            noise_factor = self.process * self._prior_factor
        forecast = low_rank_predict(state.filters, solver, process=noise_factor, dt=dt)
        # R = k̄ diag(density), equation (15), where k̄ follows from the kernels and their number.
        density = forecast.estimates if self.noise == "forecast" else observed
        noise = snapshot.noise_strength(density, snapshot.present.sum(), self.floor)
        filters = low_rank_step(forecast, observed, noise, dt)
        # Connected components of the agents that are present.
        parts = np.unique(graph.components[snapshot.present]).size
        return step.end(
            positions=snapshot.positions,
            carried=memory,
            observed=observed,
            positions_sent=counts,
            parts=int(parts),
            filters=filters,
        )

    def summarize(self, state: DensityState) -> Summary:
        """Return densities and variances of all agents, NaN for those without a filter.

        ``parts`` is the number of parts of the network, ``positions_sent`` the number of
        agents whose kernels are in an agent's density, as it counts or estimates them, ``mass``
        the density's integral.
        """
        shape = (self.n_agents, self.model.grid.size)
        mean = np.full(shape, np.nan)
        variance = np.full(shape, np.nan)
        # Agents without a filter are NaN in the record.
        mean[self.filtering] = state.estimates
        variance[self.filtering] = state.variances
        numbers = {
            "parts": np.full(self.n_agents, float(state.parts)),
            "positions_sent": state.positions_sent,
            "mass": mean.sum(axis=-1) * self.model.grid.volume,
        }
        return Summary(mean, variance, numbers=numbers)
