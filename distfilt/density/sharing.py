"""How agents of a swarm learn the kernel estimate of all: consensus on densities, or flooding."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Annotated, Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike

from ..network import Channel, Graph, PIState, pi_step
from ..network import weights as weighting
from ..network.channel import Lost
from ..network.graphs import disk
from ..validation import (
    ALLOW_NAN,
    Array,
    DistinctIndices,
    FrozenModel,
    Mask,
    NonNegativeFloat,
    PositiveFloat,
    PositiveInt,
)
from .grid import Grid
from .kernel import kernel_constant, kernel_density, kernels

__all__ = [
    "Centralised",
    "DynamicAverage",
    "Flooding",
    "Neighbours",
    "PIConsensus",
    "SwarmSnapshot",
    "ConsensusProtocol",
    "alone",
    "present_graph",
]

Carried = tuple[Array, ...]
Learnt = tuple[Carried, Array, Array]

_NEVER = -1e30
"""Time stamp of what an agent has not heard of."""


@dataclass(frozen=True, eq=False)
class SwarmSnapshot(FrozenModel):
    """What the agents themselves see at one time, and on which grid they think.

    Parameters
    ----------
    positions : ndarray, (A, d)
        Of agents inside the box; a row of NaN is an agent that has gone. One at least is here.
    grid : Grid
    bandwidth : float
        Of every agent's kernel.
    t : float
        In s.
    wanted : tuple of int, optional
        The agents whose estimate is used; a rule may leave the rows of others at zero.

    Examples
    --------
    >>> seen = SwarmSnapshot([[0.5, 0.5], [np.nan, np.nan]], Grid((9, 9)), 0.1, 0.0)
    >>> seen.present, seen.kernels.shape
    (array([ True, False]), (2, 81))
    """

    positions: Annotated[Array, "A grid.dim", ALLOW_NAN]
    grid: Grid
    bandwidth: PositiveFloat
    t: float
    wanted: DistinctIndices | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        here = self.positions[~np.isnan(self.positions).all(axis=-1)]
        if np.isnan(here).any() or not len(here):
            raise ValueError(
                "positions must be one agent at least, and NaN in a whole row for one "
                f"that has gone, got {self.positions.tolist()}"
            )
        self.grid._inside(here)

    @cached_property
    def present(self) -> Mask:
        """Which agents are here, (A,)."""
        return ~np.isnan(self.positions[:, 0])

    def near(self, radius: float) -> Graph:
        """The graph of a radio's range, without links to agents that are gone."""
        return present_graph(disk(self._or(self.grid.low), radius), self.present)

    def only_here(self, payloads: Array) -> list[Array | None]:
        """What each agent sends, None for those that are gone."""
        return [
            x if here else None for x, here in zip(payloads, self.present, strict=True)
        ]

    def _or(self, place: float | Array) -> Array:
        """The positions, with a place for agents that are gone."""
        return np.where(self.present[:, None], self.positions, place)

    @property
    def kernels(self) -> Array:
        """Each agent's own kernel, zero for those that are gone, (A, n)."""
        x = self._or(self.grid.centres[0])
        return kernels(x, self.grid, bandwidth=self.bandwidth) * self.present[:, None]

    def noise(
        self, density: Array, agents: ArrayLike, floor: float | None = None
    ) -> Array:
        r"""Strength R of what the wanted agents have learnt: :math:`\bar k\max(p,\epsilon)`.

        Parameters
        ----------
        density : ndarray, (F, n)
            The density p about which each wanted agent's estimate is made.
        agents : array_like
            How many each of all A agents heard of. Those that are gone heard nothing: their R is
            infinite.
        floor : float, optional
            The least density ε, positive: no finite sample shows that a cell is empty. By default
            a tenth of the box's mean density.
        """
        least = 0.1 / self.grid.box if floor is None else floor
        heard = np.where(self.present, np.maximum(agents, 1.0), 0.0)
        chosen = heard if self.wanted is None else heard[list(self.wanted)]
        unit = kernel_constant(self.grid, bandwidth=self.bandwidth, agents=1)
        k = np.divide(unit, chosen, out=np.full(chosen.shape, np.inf), where=chosen > 0)
        return np.asarray(k[:, None] * np.maximum(density, least))

    def flat(self, std: float | None = None) -> Array:
        """A Gaussian about each agent, cut off at the walls; in the middle for the gone, (A, n).

        Its standard deviation is .3 of the box's side, unless it is given.

        >>> box = Grid((3, 3), high=3.0)
        >>> seen = SwarmSnapshot(
        ...     np.array([[2.9, 2.9], [np.nan, np.nan]]), box, 1.0, 0.0
        ... )
        >>> seen.flat().argmax(axis=1)
        array([8, 4])
        """
        width = 0.3 * self.grid.side if std is None else std
        centre = self._or(self.grid.low + 0.5 * self.grid.width)
        gap = ((self.grid.centres - centre[:, None, :]) ** 2).sum(axis=-1)
        return self.grid.normalize(np.exp(-0.5 * gap / width**2))


def present_graph(graph: Graph, present: Mask) -> Graph:
    """The graph without the links of agents that are gone.

    Examples
    --------
    >>> from distfilt.network import graphs
    >>> present_graph(graphs.path(3), np.array([True, True, False])).in_degree
    array([1., 1., 0.])
    """
    if present.all():
        return graph
    keep = present[graph.receivers] & present[graph.senders]
    pairs = np.stack([graph.receivers[keep], graph.senders[keep]], axis=1)
    return Graph.from_edges(graph.n_agents, pairs, directed=True)


@runtime_checkable
class ConsensusProtocol(Protocol):
    """A rule by which agents learn the swarm's kernel estimate: what a density filter agrees by.

    `begin` gives what the agents remember before their first step. `learn` takes what they see
    and what they remember, lets them talk, and returns what they remember then, each agent's
    estimate (A, n), and how many agents each believes there are, (A,).

    Examples
    --------
    >>> Centralised().reference, Flooding().belief_kind
    (True, 'densities')
    """

    belief_kind: str = "densities"
    reference: bool = False
    """Whether this is no network's rule, but what it is compared with."""

    def initial_state(self, seen: SwarmSnapshot) -> Carried:
        """What the agents remember before the first step: nothing, unless a rule says."""
        return ()

    def update(
        self, carried: Carried, seen: SwarmSnapshot, channel: Channel, dt: float
    ) -> Learnt:
        """One step of talking."""
        ...


def alone(sharing: ConsensusProtocol, seen: SwarmSnapshot) -> Array:
    """What each agent believes of the swarm before anybody has spoken, (A, n).

    Its own kernel, whatever it will say; only a reference knows of all without a word.

    Examples
    --------
    >>> seen = SwarmSnapshot(np.full((2, 2), 0.5), Grid((9, 9)), 0.1, 0.0)
    >>> np.array_equal(alone(Flooding(), seen), seen.kernels)
    True
    """
    if not sharing.reference:
        return seen.kernels
    silent = Channel(Graph.from_edges(len(seen.positions), np.zeros((0, 2))))
    return sharing.update(sharing.initial_state(seen), seen, silent, 1.0)[1]


def _coordinates(seen: SwarmSnapshot, modes: int | None, values: Array) -> Array:
    """Densities, whole or as cosine coefficients, and a 1 of the first agent that is here."""
    z = (
        values
        if modes is None
        else values @ seen.grid.cosines(modes) * seen.grid.volume
    )
    leader = np.arange(len(z)) == np.argmax(seen.present)
    return np.concatenate([z, leader[:, None]], axis=1)


def _read(values: Array, seen: SwarmSnapshot, modes: int | None) -> tuple[Array, Array]:
    """Densities and numbers of agents that the coordinates stand for."""
    y = values[:, :-1]
    if modes is not None:
        y = y @ seen.grid.cosines(modes).T
    # The average of one 1 among zeros is 1/N; a transient may be zero or negative.
    return y, 1 / np.clip(values[:, -1], 1e-6, 1.0)


@dataclass(frozen=True)
class PIConsensus(FrozenModel, ConsensusProtocol):
    """The proportional-integral estimator of equation (16) of Zheng and Lin.

    Parameters
    ----------
    alpha, a, b : float
        Gains, in 1/s, of :func:`distfilt.network.pi_step`.
    modes : int, optional
        Agree on so many cosine coefficients of the density instead of on all cells.
    rate : bool
        Add the inputs' derivative, which (16) lacks, so that the average is followed without a lag.
    initial_std : float, optional
        Start at a Gaussian of this width about the agent instead of at the own kernel.

    Examples
    --------
    >>> PIConsensus(modes=64).modes
    64
    """

    alpha: NonNegativeFloat = field(default=0.2, kw_only=True)
    a: NonNegativeFloat = field(default=0.4, kw_only=True)
    b: NonNegativeFloat = field(default=0.04, kw_only=True)
    modes: PositiveInt | None = field(default=None, kw_only=True)
    rate: bool = field(default=False, kw_only=True)
    initial_std: PositiveFloat | None = field(default=None, kw_only=True)

    def initial_state(self, seen: SwarmSnapshot) -> Carried:
        """First estimates, no integral, and the inputs of now."""
        u = _coordinates(seen, self.modes, seen.kernels)
        if self.initial_std is None:
            return u, np.zeros_like(u), u
        return (
            _coordinates(seen, self.modes, seen.flat(self.initial_std)),
            np.zeros_like(u),
            u,
        )

    def update(
        self, carried: Carried, seen: SwarmSnapshot, channel: Channel, dt: float
    ) -> Learnt:
        """One step of (16), in as many substeps as stability asks for."""
        u = _coordinates(seen, self.modes, seen.kernels)
        estimate, integral, before = carried
        after = pi_step(
            PIState(estimate, integral),
            before,
            channel,
            dt=dt,
            alpha=self.alpha,
            a=self.a,
            b=self.b,
            rate=(u - before) / dt if self.rate else None,
        )
        return (after.estimate, after.integral, u), *_read(
            after.estimate, seen, self.modes
        )


@dataclass(frozen=True)
class DynamicAverage(FrozenModel, ConsensusProtocol):
    """First-order dynamic average consensus on cosine coefficients of the density.

    Metropolis weights where all links go both ways, else weights that balance the graph (M. Zhu and
    S. Martinez, Automatica 46 (2010) 322-329).

    Parameters
    ----------
    modes : int, optional
        How many coefficients; None agrees on all cells.

    Examples
    --------
    >>> DynamicAverage().modes
    100
    """

    modes: PositiveInt | None = field(default=100, kw_only=True)

    def initial_state(self, seen: SwarmSnapshot) -> Carried:
        """Estimates that are the own kernels, which the rule needs for an exact average."""
        u = _coordinates(seen, self.modes, seen.kernels)
        return u, u

    def update(
        self, carried: Carried, seen: SwarmSnapshot, channel: Channel, dt: float
    ) -> Learnt:
        """Average, and add what the own input has changed by."""
        u = _coordinates(seen, self.modes, seen.kernels)
        (x, before) = carried
        graph = channel.graph
        weights = (
            weighting.doubly_stochastic(graph)
            if graph.directed
            else weighting.metropolis(graph)
        )
        lost: Lost = "keep" if graph.directed else "mutual"
        x = channel.mix(x, weights, lost=lost) + (u - before)
        return (x, u), *_read(x, seen, self.modes)


@dataclass(frozen=True)
class Flooding(FrozenModel, ConsensusProtocol):
    """Every agent passes on where it last knew each agent, with the time, and keeps the newest.

    Parameters
    ----------
    forget : float, optional
        Age in s from which an entry is left out of the estimate: agents that have gone are
        forgotten then, and parts of a broken network stop believing in each other.

    Examples
    --------
    >>> Flooding(forget=5.0).forget
    5.0
    """

    forget: PositiveFloat | None = field(default=None, kw_only=True)

    def initial_state(self, seen: SwarmSnapshot) -> Carried:
        """Tables (A, A, d + 1) of positions and times, without any entry."""
        return (_empty(seen),)

    def update(
        self, carried: Carried, seen: SwarmSnapshot, channel: Channel, dt: float
    ) -> Learnt:
        """Note the own position, send the table, keep the newest of each entry."""
        table = _noted(seen, carried[0])
        heard = channel.broadcast(seen.only_here(table))
        new = table.copy()
        owners = np.arange(len(table))
        for i in np.flatnonzero(seen.present):
            rows = np.stack([table[i], *heard[i].values()])
            new[i] = rows[rows[..., -1].argmax(axis=0), owners]
        oldest = _NEVER / 2 if self.forget is None else seen.t - self.forget
        return (new,), *_mean_kernels(new, oldest, seen)


def _empty(seen: SwarmSnapshot) -> Array:
    size, d = seen.positions.shape
    return np.full((size, size, d + 1), [0.0] * d + [_NEVER])


def _noted(seen: SwarmSnapshot, table: Array) -> Array:
    """Each agent's table of all agents' positions and times, with the own entry of now."""
    out = table.copy()
    here = np.flatnonzero(seen.present)
    out[here, here, :-1] = seen.positions[here]
    out[here, here, -1] = seen.t
    return out


def _mean_kernels(
    table: Array, oldest: float, seen: SwarmSnapshot
) -> tuple[Array, Array]:
    """Kernel estimates of each table's newer entries, and their numbers.

    Equal entries are computed once.
    """
    known = table[..., -1] > oldest
    counted = known.sum(axis=1).astype(np.float64)
    if seen.wanted is not None:
        known[np.delete(np.arange(len(known)), seen.wanted)] = False
    row, owner = np.nonzero(known)
    both = np.stack([owner, table[row, owner, -1]], axis=1)
    _, first, at = np.unique(both, axis=0, return_index=True, return_inverse=True)
    x = table[row[first], owner[first], :-1]
    z = kernels(x, seen.grid, bandwidth=seen.bandwidth)
    weights = np.zeros((len(table), len(x)))
    weights[row, at] = 1.0
    return np.asarray(
        weights @ z / np.maximum(weights.sum(axis=1, keepdims=True), 1.0)
    ), counted


@dataclass(frozen=True)
class Neighbours(FrozenModel, ConsensusProtocol):
    """Remark 4 of Zheng and Lin as it stands: positions go to neighbours, and that is all.

    Each agent's estimate is the kernel estimate of itself and of those that it hears.

    Examples
    --------
    >>> Neighbours().reference
    False
    """

    def update(
        self, carried: Carried, seen: SwarmSnapshot, channel: Channel, dt: float
    ) -> Learnt:
        """Send the own position; the mean of the kernels at all positions that arrive."""
        table = _noted(seen, _empty(seen))
        for i, box in enumerate(channel.broadcast(seen.only_here(seen.positions))):
            for j, x in box.items():
                table[i, j] = *x, seen.t
        return (), *_mean_kernels(table, _NEVER / 2, seen)


@dataclass(frozen=True)
class Centralised(FrozenModel, ConsensusProtocol):
    """All positions known to all at no cost: the reference that no network is.

    Examples
    --------
    >>> Centralised().reference
    True
    """

    reference = True

    def update(
        self, carried: Carried, seen: SwarmSnapshot, channel: Channel, dt: float
    ) -> Learnt:
        """The kernel estimate of all that are here."""
        x = seen.positions[seen.present]
        size = len(seen.positions)
        y = kernel_density(x, seen.grid, bandwidth=seen.bandwidth)
        return (), np.tile(y, (size, 1)), np.full(size, float(len(x)))
