"""Density filters: agents that see their own position, talk, and estimate the density of all."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import KW_ONLY, dataclass
from functools import cached_property
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

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
from ..density.kernel import check_resolution
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
    check_array,
)
from .base import Filter
from .inputs import one_each
from .record import Summary
from .saving import State
from .step import Step

__all__ = ["DensityFilter", "DensityState"]


@dataclass(frozen=True, eq=False, repr=False)
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
    positions_sent : ndarray, (A,)
        How many agents each believes there are.
    parts : int
        Into how many parts the network of the present agents fell in the last step.
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
class DensityFilter(Filter):
    r"""Local filters of a swarm's density, equations (14) to (16) of Zheng and Lin.

    In each step every agent sees its own position, learns by the `fusion` an estimate y_i of the
    kernel estimate of all, and takes it into a Kalman filter of the density whose model is the
    Fokker-Planck equation. Where the network falls apart, agents go on with what they hear, and
    the record says into how many parts. How sure a step's estimate is follows from the true number
    of those present, which is taken as known: who has heard of few is then too sure.

    Parameters
    ----------
    model : FokkerPlanck
        What the filters believe of the swarm, and their grid.
    sensors : int
        Number A of agents that there may be: each sees its own position.
    graph : float, Graph or callable
        A radio's range; a graph that does not move; or ``graph(t, positions) -> Graph``.
    fusion : Sharing
        The rule by which agents learn of the others, such as
        :class:`~distfilt.density.PIConsensus` or :class:`~distfilt.density.Flooding`.
    faults, names, every
        As for :class:`~distfilt.filters.Filter`.
    bandwidth : float
        Of the kernels, at least half a cell.
    local : tuple of int, optional
        The agents that run a filter; all by default. All agents share.
    first : {"flat", "observed"} or array_like (n,)
        Prior mean: a flat Gaussian about the agent, its own kernel, or a density for all.
    initial_std : float
        Width of the flat Gaussian.
    rank, prior_length, prior_std, mass_std
        Of :func:`~distfilt.density.zero_mean_prior`. With a `mass_std` of 0, the default, no
        measurement can change the mass; above 0 it can, as in the paper.
    noise : {"forecast", "observed"}
        Whether R is k̄ times the filter's own density, or times what it observes as printed; the
        second weighs by the noise itself and is biased.
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

    model: FokkerPlanck  # type: ignore[assignment]
    sensors: PositiveInt  # type: ignore[assignment]
    graph: PositiveFloat | Graph | Callable[[float, Array], Graph]
    _: KW_ONLY
    fusion: ConsensusProtocol  # type: ignore[assignment]
    share_observations: bool = False
    bandwidth: PositiveFloat
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

    state_class: ClassVar[type[DensityState]] = DensityState
    supports_runs: ClassVar[bool] = False
    belief_kind: ClassVar[str] = "densities"
    unsupported: ClassVar[dict[str, str]] = {
        "share_observations": "what agents tell of their positions is the agreement's",
        "lag": "a density filter keeps no past",
        "on_error": "one run at a time: the graph moves with the run",
        "gate_probability": "a position is the agent's own, and nothing predicts it",
    }

    def check_parts(self) -> None:
        """Refuse places and densities that are not of the grid."""
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
        self, observations: Any, runs: tuple[int, ...], t: float
    ) -> Any:
        """The agents' positions (A, d); None and NaN are agents that have gone."""
        gone = np.full(self.model.grid.dim, np.nan)
        given = one_each(observations, self.n_agents)
        return self._seen([gone if x is None else x for x in given], "observations", t)

    def channel(self, state: State, t: float) -> None:
        """None yet: who hears whom depends on where the agents are."""

    def initial_state(
        self, prior: Any, runs: tuple[int, ...], rng: Any
    ) -> dict[str, Any]:
        """What is believed at the agents' first positions (A, d), NaN for those not here."""
        seen = self._seen(prior, "prior", 0.0)
        here = self.filtering
        filters = low_rank_start(self._basis, self._base(seen)[here])
        return {
            "positions": seen.positions,
            "carried": self.fusion.initial_state(seen),
            "observed": seen.kernels[here],
            "positions_sent": np.full(self.n_agents, float(self.n_agents)),
            "parts": 1,
            "filters": filters,
        }

    @cached_property
    def _basis(self) -> Array:
        """A factor of the prior covariance, (n, r)."""
        return zero_mean_prior(
            self.model.grid,
            rank=self.rank,
            length=self.prior_length,
            std=self.prior_std,
            mass_std=self.mass_std,
        )

    def _base(self, seen: SwarmSnapshot) -> Array:
        """Prior means of all agents, (A, n)."""
        if not isinstance(self.initial_density, str):
            return np.tile(self.initial_density, (self.n_agents, 1))
        if self.initial_density == "observed":
            own = estimate_without_messages(self.fusion, seen)
            here = seen.present[:, None]
            return np.where(here, own, seen.initial_gaussians(self.initial_std))
        return seen.initial_gaussians(self.initial_std)

    def _seen(self, positions: ArrayLike, name: str, t: float) -> SwarmSnapshot:
        x = check_array(
            positions, name, (self.n_agents, self.model.grid.dim), finite=False
        )
        return SwarmSnapshot(x, self.model.grid, self.bandwidth, t, self.local)

    def next_state(self, step: Step) -> Any:
        """Share what the agents see of themselves, and take it into their filters.

        >>> from distfilt.density import Flooding, Grid
        >>> from distfilt.models import rotating_swarm
        >>> from distfilt.network import Faults
        >>> given = FokkerPlanck(rotating_swarm(), Grid((9, 9))), 4, 2.0
        >>> more = {"fusion": Flooding(), "bandwidth": 0.2, "rank": 9}
        >>> x = np.random.default_rng(1).random((4, 2))
        >>> for option in ({"faults": Faults(silent=[0])}, {"exchange_interval": 1.0}):
        ...     f = DensityFilter(*given, **more, **option)
        ...     print(f.step(f.start(x), 0.5, x).ledger.messages)
        [0 2 2 2]
        [0 0 0 0]
        """
        state = step.state
        seen = step.observations
        t = step.t
        dt = step.dt
        if not dt:
            raise ValueError(f"t must be above {state.t:g}, got {t:g}")
        if isinstance(self.graph, float):
            graph = seen.disk_graph(self.graph)
        else:
            here = self.graph(t, seen.positions) if callable(self.graph) else self.graph
            graph = remove_absent(as_graph(here, self.n_agents), seen.present)
        if not self._contact(state.t, t):
            graph = Graph.from_edges(self.n_agents, np.zeros((0, 2)))
        step.channel = channel = Channel(
            graph, ledger=state.ledger, faults=self.faults, t=t
        )
        carried, y, counted = self.fusion.update(state.carried, seen, channel, dt)
        y = y[self.filtering]

        move = self.model.solver(state.t, dt)
        q = None if self.process is None else self.process * self._basis
        moved = low_rank_predict(state.filters, move, process=q, dt=dt)
        level = moved.estimates if self.noise == "forecast" else y
        noise = seen.noise_strength(level, seen.present.sum(), self.floor)
        filters = low_rank_step(moved, y, noise, dt)
        parts = np.unique(graph.components[seen.present]).size
        return step.end(
            positions=seen.positions,
            carried=carried,
            observed=y,
            positions_sent=counted,
            parts=int(parts),
            filters=filters,
        )

    def summarize(self, state: DensityState) -> Summary:
        """Densities and their variances of all agents, NaN for those without a filter.

        ``parts`` is the number of parts of the network, ``positions_sent`` how many agents each believes
        in, ``mass`` the estimate's integral.
        """
        n = self.model.grid.size
        here = self.filtering
        mean, variance = (np.full((self.n_agents, n), np.nan) for _ in range(2))
        mean[here] = state.estimates
        variance[here] = state.variances
        return Summary(
            mean,
            variance,
            numbers={
                "parts": np.full(self.n_agents, float(state.parts)),
                "positions_sent": state.positions_sent,
                "mass": mean.sum(axis=-1) * self.model.grid.volume,
            },
        )
