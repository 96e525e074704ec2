"""What the agents of a swarm see of themselves, and who of them is within reach."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..checks import Array, array, instance
from ..network import Graph
from ..network.graphs import disk
from .grid import Grid
from .kernel import _kernels, kernel_noise

__all__ = ["Seen", "present_graph"]

Mask = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Seen:
    """What the agents themselves see at one time, and on which grid they think.

    Parameters
    ----------
    positions : ndarray, (A, d)
        Of agents that are present; rows of the others mean nothing.
    present : ndarray of bool, (A,)
    grid : Grid
    bandwidth : float
        Of every agent's kernel.
    t : float
        In s.
    wanted : tuple of int, optional
        The agents whose estimate is used; a rule may leave the rows of others at zero.

    Examples
    --------
    >>> seen = Seen(np.full((1, 2), 0.5), np.ones(1, bool), Grid((9, 9)), 0.1, 0.0)
    >>> seen.kernels.shape
    (1, 81)
    """

    positions: Array
    present: Mask
    grid: Grid
    bandwidth: float
    t: float
    wanted: tuple[int, ...] | None = None

    @classmethod
    def checked(
        cls, positions: ArrayLike, name: str, size: int, grid: Grid, bandwidth: float, t: float,
        wanted: tuple[int, ...] | None = None,
    ) -> Seen:
        """What is seen of `size` agents, of whom a row of NaN is one that has gone.

        >>> Seen.checked([[0.5, 0.5], [np.nan, np.nan]], "x", 2, Grid((9, 9)), 0.1, 0.0).present
        array([ True, False])
        """
        x = array(positions, name, (size, grid.dim), finite=False)
        gone = np.asarray(np.isnan(x).all(axis=-1), dtype=bool)
        if not np.isfinite(x[~gone]).all():
            raise ValueError(f"{name}: needs finite positions, or NaN in a whole row for an agent "
                             f"that has gone, got {x[~gone][~np.isfinite(x[~gone]).all(-1)][0]}")
        if gone.all():
            raise ValueError(f"{name}: needs at least one agent, got none")
        grid.inside(x[~gone], name)
        return cls(np.where(gone[:, None], 0.0, x), ~gone, grid, bandwidth, t, wanted)

    @property
    def places(self) -> Array:
        """The positions, NaN for agents that are gone, (A, d)."""
        return np.where(self.present[:, None], self.positions, np.nan)

    def near(self, radius: float) -> Graph:
        """The graph of a radio's range, without links to agents that are gone."""
        here = np.flatnonzero(self.present)
        found = disk(self.positions[here], radius)
        if self.present.all():
            return found
        pairs = np.stack([here[found.receivers], here[found.senders]], axis=1)
        return Graph.from_edges(len(self.present), pairs)

    @property
    def kernels(self) -> Array:
        """Each agent's own kernel, zero for those that are gone, (A, n)."""
        x = np.where(self.present[:, None], self.positions, self.grid.centres[0])
        z = _kernels(x, self.grid, np.full(len(x), self.bandwidth))
        return np.asarray(z * self.present[:, None])

    def noise(self, density: Array, agents: ArrayLike, floor: float) -> Array:
        """Strength R of what the wanted agents have learnt, about their rows of `density`.

        `agents` is how many each of all A agents heard of; it is infinite for those that are gone.
        """
        heard = np.where(self.present, np.maximum(agents, 1.0), 0.0)
        if self.wanted is not None:
            heard = heard[list(self.wanted)]
        return kernel_noise(
            density, self.grid, bandwidth=self.bandwidth, agents=heard, floor=floor)

    def flat(self, std: float) -> Array:
        """A Gaussian about each agent, cut off at the walls; in the middle for the gone, (A, n)."""
        middle = self.grid.corner + 0.5 * self.grid.width
        centre = np.where(self.present[:, None], self.positions, middle)
        gap = ((self.grid.centres - centre[:, None, :]) ** 2).sum(axis=-1)
        return self.grid.normalised(np.exp(-0.5 * gap / std**2))


def present_graph(graph: Graph, present: Mask) -> Graph:
    """The graph without the links of agents that are gone.

    Examples
    --------
    >>> from distfilt.network import graphs
    >>> present_graph(graphs.path(3), np.array([True, True, False])).degrees
    array([1., 1., 0.])
    """
    instance(graph, "graph", Graph)
    if present.all():
        return graph
    keep = present[graph.receivers] & present[graph.senders]
    pairs = np.stack([graph.receivers[keep], graph.senders[keep]], axis=1)
    return Graph.from_edges(graph.size, pairs, directed=True)

