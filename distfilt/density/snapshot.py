"""Positions of a swarm's agents at one time, and the kernels and noises that follow from them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike

from ..network import Graph
from ..network.graphs import disk
from ..validation import (
    ALLOW_NAN,
    Array,
    DistinctIndices,
    FrozenModel,
    Mask,
)
from .grid import Grid
from .kernel import AxisWidths, kernel_constant, kernels

__all__ = ["SwarmSnapshot", "remove_absent"]


@dataclass(frozen=True, eq=False)
class SwarmSnapshot(FrozenModel):
    """The agents' positions at one time, and the grid of their estimates.

    Parameters
    ----------
    positions : ndarray, (A, d)
        Of agents inside the box; a row of NaN is an absent agent. At least one is present.
    grid : Grid
        Grid of the estimated density.
    bandwidth : float or ndarray, (1, d)
        Bandwidth of every agent's kernel, for all axes or for each.
    t : float
        The time, in s.
    local : tuple of int, optional
        The agents whose estimates are needed; a protocol may leave the rows of others at zero.

    Examples
    --------
    >>> snapshot = SwarmSnapshot([[0.5, 0.5], [np.nan, np.nan]], Grid((9, 9)), 0.1, 0.0)
    >>> snapshot.present, snapshot.kernels.shape
    (array([ True, False]), (2, 81))
    """

    positions: Annotated[Array, "A grid.dim", ALLOW_NAN]
    grid: Grid
    bandwidth: AxisWidths
    t: float
    local: DistinctIndices | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        # An agent is absent if all its coordinates are NaN; partly NaN is an error.
        absent = np.isnan(self.positions).all(axis=-1)
        present = self.positions[~absent]
        if np.isnan(present).any() or not len(present):
            raise ValueError(
                "positions must have at least one agent that is present, and rows of NaN "
                f"for those that are absent, got {self.positions.tolist()}"
            )
        self.grid._check_inside(present)

    @cached_property
    def present(self) -> Mask:
        """Whether each agent is present, (A,)."""
        return ~np.isnan(self.positions[:, 0])

    def disk_graph(self, radius: float) -> Graph:
        """Graph of agents within radio range, without links to absent agents."""
        # Absent agents need any position here; their links are removed afterwards.
        graph = disk(self._fill_absent(self.grid.low), radius)
        return remove_absent(graph, self.present)

    def select_payloads(self, payloads: Array) -> list[Array | None]:
        """Payload that each agent sends, None for absent agents."""
        return [
            payload if present else None
            for payload, present in zip(payloads, self.present, strict=True)
        ]

    def _fill_absent(self, position: float | Array) -> Array:
        """Positions (A, d), with a given one in place of absent agents."""
        return np.where(self.present[:, None], self.positions, position)

    @property
    def kernels(self) -> Array:
        """Kernel of each agent, zero for absent agents, (A, n)."""
        # Any position inside the box: the kernel is zeroed below.
        positions = self._fill_absent(self.grid.centres[0])
        z = kernels(positions, self.grid, bandwidth=self.bandwidth)
        return z * self.present[:, None]

    def noise_strength(
        self, density: Array, agents: ArrayLike, floor: float | None = None
    ) -> Array:
        r"""Strength R of the noise of the local agents' estimates: :math:`\bar k\max(p,\epsilon)`.

        Parameters
        ----------
        density : ndarray, (F, n)
            The density p for which the strength is computed, in the n cells, for each of the F
            agents of `local`, or for all A without it.
        agents : array_like
            Number of agents whose kernels are averaged in each of all A estimates. Absent agents
            have no estimate: their R is infinite.
        floor : float, optional
            Lower bound ε of the density, positive: no finite sample shows that a cell is empty. By
            default a tenth of the box's mean density.
        """
        if floor is None:
            floor = 0.1 / self.grid.box_volume
        # Every present agent knows at least itself.
        counts = np.where(self.present, np.maximum(agents, 1.0), 0.0)
        if self.local is not None:
            # Numbers of the local agents
            counts = counts[list(self.local)]
        # The constant k̄ is that of one agent, divided by the number of agents, (F,).
        # Absent agents, without a kernel, have an infinite one.
        single = kernel_constant(self.grid, bandwidth=self.bandwidth, agents=1)
        constant = np.full(counts.shape, np.inf)
        np.divide(single, counts, out=constant, where=counts > 0)
        return np.asarray(constant[:, None] * np.maximum(density, floor))

    def initial_gaussians(self, std: float | None = None) -> Array:
        """Gaussians about the agents, truncated at the walls, (A, n).

        Those of absent agents are at the centre of the box. The standard deviation is 0.3 of the
        box's side by default.

        >>> box = Grid((3, 3), high=3.0)
        >>> snapshot = SwarmSnapshot(
        ...     np.array([[2.9, 2.9], [np.nan, np.nan]]), box, 1.0, 0.0
        ... )
        >>> snapshot.initial_gaussians().argmax(axis=1)
        array([8, 4])
        """
        width = 0.3 * self.grid.side if std is None else std
        centre = self._fill_absent(self.grid.low + 0.5 * self.grid.width)
        difference = self.grid.centres - centre[:, None, :]
        # |c - x|² for each agent and cell
        squares = (difference**2).sum(axis=-1)
        return self.grid.normalize(np.exp(-0.5 * squares / width**2))


def remove_absent(graph: Graph, present: Mask) -> Graph:
    """Remove the links of absent agents from a graph.

    Examples
    --------
    >>> from distfilt.network import graphs
    >>> remove_absent(graphs.path(3), np.array([True, True, False])).in_degree
    array([1., 1., 0.])
    """
    if present.all():
        return graph
    # Both ends of a link have to be present.
    active = present[graph.receivers] & present[graph.senders]
    pairs = np.stack([graph.receivers[active], graph.senders[active]], axis=1)
    return Graph.from_edges(graph.n_agents, pairs, directed=True)
