"""Graphs of agents: who hears whom, and the matrices that follow from it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy import sparse

from ..checks import Array, array, count

__all__ = ["Graph"]


@dataclass(frozen=True, eq=False)
class Graph:
    """Links between agents, without self-loops: an agent always knows what it knows itself.

    Build it with :meth:`from_adjacency`.

    Parameters
    ----------
    links : scipy.sparse.csr_array, (A, A)
        ``links[i, j] = 1`` when agent i hears agent j.

    Examples
    --------
    >>> star = Graph.from_adjacency([[0, 1, 1], [1, 0, 0], [1, 0, 0]])
    >>> star.neighbours(0)
    (1, 2)
    >>> star.spectrum.round(6) + 0.0
    array([0., 1., 3.])
    """

    links: sparse.csr_array

    @classmethod
    def from_adjacency(cls, adjacency: ArrayLike, *, directed: bool = False) -> Graph:
        """Build a graph from a matrix of zeros and ones.

        Parameters
        ----------
        adjacency : array_like, (A, A)
            Row i marks the agents that agent i hears.
        directed : bool
            Accept links that go one way only.

        Raises
        ------
        ValueError
            If the matrix is not square, has entries other than 0 and 1 or a self-loop, or is not
            symmetric although the graph is undirected.
        """
        a = array(adjacency, "adjacency", ("A", "A"))
        if a.shape[0] != a.shape[1] or a.shape[0] == 0:
            raise ValueError(f"adjacency: needs a square matrix, got shape {a.shape}")
        if not np.isin(a, (0, 1)).all():
            raise ValueError(f"adjacency: needs zeros and ones, got {a[~np.isin(a, (0, 1))][0]:g}")
        if a.diagonal().any():
            agent = int(np.argmax(a.diagonal()))
            raise ValueError(f"adjacency: needs a zero diagonal, got a self-loop at agent {agent}")
        if not directed and (a != a.T).any():
            i, j = np.argwhere(a != a.T)[0]
            raise ValueError(
                f"adjacency: needs a symmetric matrix for an undirected graph, got a one-way link "
                f"between agents {i} and {j}"
            )
        return cls(sparse.csr_array(a))

    @property
    def size(self) -> int:
        """Number A of agents."""
        return int(self.links.shape[0])

    def neighbours(self, agent: int) -> tuple[int, ...]:
        """The agents that `agent` hears, ascending, without itself."""
        i = count(agent, "agent", at_least=0)
        if i >= self.size:
            raise ValueError(f"agent: needs an agent below {self.size}, got {i}")
        row = self.links.indices[self.links.indptr[i] : self.links.indptr[i + 1]]
        return tuple(int(j) for j in np.sort(row))

    @cached_property
    def degrees(self) -> Array:
        """How many agents each agent hears, (A,)."""
        return np.asarray(np.diff(self.links.indptr), dtype=np.float64)

    @cached_property
    def listeners(self) -> Array:
        """How many agents hear each agent, (A,)."""
        return np.asarray(self.links.sum(axis=0), dtype=np.float64)

    @cached_property
    def laplacian(self) -> Array:
        """The Laplacian: degrees on the diagonal, -1 where an agent hears another, (A, A)."""
        return np.asarray(np.diag(self.degrees) - self.links.toarray(), dtype=np.float64)

    @cached_property
    def spectrum(self) -> Array:
        """Eigenvalues of the Laplacian of an undirected graph, ascending, (A,)."""
        lap = self.laplacian
        if (lap != lap.T).any():
            raise ValueError("graph: needs links both ways for a real spectrum, got one-way links")
        return np.asarray(np.linalg.eigvalsh(lap), dtype=np.float64)

    @property
    def connected(self) -> bool:
        """Whether every agent can reach every other along the links."""
        parts, _ = sparse.csgraph.connected_components(self.links, connection="strong")
        return bool(parts == 1)

    @property
    def largest_gain(self) -> float:
        r"""The bound :math:`2/\lambda_{\max}` below which averaging agrees."""
        if self.size == 1:
            return float("inf")
        return float(2 / self.spectrum[-1]) if self.spectrum[-1] > 0 else float("inf")

    def to_networkx(self) -> Any:
        """The same graph as a networkx DiGraph whose edges run from speaker to listener."""
        import networkx as nx

        return nx.from_scipy_sparse_array(self.links.T, create_using=nx.DiGraph)
