"""Who hears whom: a graph of agents, and what follows from its links alone."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import sparse

from ..checks import Array, array, count, instance
from . import _spectral

__all__ = ["Graph"]

Indices = NDArray[np.int64]

@dataclass(frozen=True, eq=False)
class Graph:
    """Links between agents, without self-loops: an agent always knows what it knows itself.

    Build it with :meth:`from_adjacency`, :meth:`from_edges`, :meth:`from_networkx` or a function of
    :mod:`distfilt.network.graphs`. A graph that changes in time is a function ``t -> Graph``.

    Parameters
    ----------
    links : scipy.sparse.csr_array, (A, A)
        ``links[i, j] = 1`` when agent i hears agent j; indices ascending in each row.

    Examples
    --------
    >>> graph = Graph.from_adjacency([[0, 1, 1], [1, 0, 0], [1, 0, 0]])
    >>> graph.neighbours(0)
    (1, 2)
    >>> graph.spectrum.round(6) + 0.0
    array([0., 1., 3.])
    """

    links: sparse.csr_array

    def __post_init__(self) -> None:
        a = self.links
        if not isinstance(a, sparse.csr_array) or a.shape[0] != a.shape[1] or a.shape[0] == 0:
            raise ValueError(
                f"links: needs a square scipy.sparse.csr_array (see Graph.from_adjacency), "
                f"got {type(a).__name__}"
            )
        if not a.has_canonical_format or (a.data != 1).any() or a.diagonal().any():
            raise ValueError("links: needs ones off the diagonal, sorted and listed once")

    @classmethod
    def from_adjacency(cls, adjacency: ArrayLike, *, directed: bool = False) -> Graph:
        """Build a graph from a matrix of zeros and ones.

        Parameters
        ----------
        adjacency : array_like, (A, A)
            Row i marks the agents that agent i hears.
        directed : bool
            Accept links that go one way only.
        """
        a = array(adjacency, "adjacency", ("A", "A"))
        if a.shape[0] != a.shape[1] or a.shape[0] == 0:
            raise ValueError(f"adjacency: needs a square matrix, got shape {a.shape}")
        if not np.isin(a, (0, 1)).all():
            raise ValueError(f"adjacency: needs zeros and ones, got {a[~np.isin(a, (0, 1))][0]:g}")
        return cls.from_edges(a.shape[0], np.argwhere(a), directed=directed, name="adjacency")

    @classmethod
    def from_edges(
        cls, agents: int, edges: ArrayLike, *, directed: bool = False, name: str = "edges"
    ) -> Graph:
        """Build a graph from its links, listed as pairs (listener, speaker).

        Parameters
        ----------
        agents : int
            Number A of agents.
        edges : array_like of int, (E, 2)
            The links; of an undirected graph each has to be listed both ways.
        directed : bool
            Accept links that go one way only.
        name : str
            What an error calls the links.
        """
        size = count(agents, "agents")
        instance(directed, "directed", bool)
        pairs = array(edges, name)
        pairs = pairs.reshape(-1, 2) if pairs.size == 0 else array(pairs, name, ("E", 2))
        listed = pairs.astype(np.int64)
        inside = not listed.size or 0 <= listed.min() <= listed.max() < size
        if (listed != pairs).any() or not inside:
            raise ValueError(f"{name}: needs agents from 0 to {size - 1}, got {pairs.tolist()[:3]}")
        loops = listed[listed[:, 0] == listed[:, 1], 0]
        if loops.size:
            raise ValueError(f"{name}: needs no self-loops, got one at agent {loops[0]}")
        graph = cls(linked(size, listed))
        if not directed and graph.directed:
            alone = int(np.argmax(graph.reverse < 0))
            i, j = sorted((int(graph.receivers[alone]), int(graph.senders[alone])))
            raise ValueError(
                f"{name}: needs every link both ways in an undirected graph, got one way only "
                f"between agents {i} and {j}"
            )
        return graph

    @classmethod
    def from_networkx(cls, graph: Any) -> Graph:
        """Build a graph from a networkx one, agents in the order of its nodes.

        Parameters
        ----------
        graph : networkx.Graph or networkx.DiGraph
            Of a digraph an edge runs from speaker to listener, as in :meth:`to_networkx`. Names,
            weights and parallel edges are left behind.

        Examples
        --------
        >>> import networkx
        >>> Graph.from_networkx(networkx.path_graph(["ground", "relay", "probe"])).neighbours(1)
        (0, 2)
        """
        if not all(hasattr(graph, name) for name in ("nodes", "edges", "is_directed")):
            raise ValueError(f"graph: needs a networkx graph, got {type(graph).__name__}")
        number_of = {node: k for k, node in enumerate(graph.nodes)}
        listed = [(number_of[edge[1]], number_of[edge[0]]) for edge in graph.edges]
        pairs = np.array(listed, dtype=np.int64).reshape(-1, 2)
        directed = bool(graph.is_directed())
        if not directed:
            pairs = np.concatenate([pairs, pairs[:, ::-1]])
        return cls.from_edges(len(number_of), pairs, directed=directed, name="graph")

    @property
    def size(self) -> int:
        """Number A of agents."""
        return int(self.links.shape[0])

    @cached_property
    def receivers(self) -> Indices:
        """The listener of each link, (E,), ascending."""
        return np.repeat(np.arange(self.size), np.diff(self.links.indptr))

    @cached_property
    def senders(self) -> Indices:
        """The speaker of each link, (E,), ascending for each listener."""
        return np.asarray(self.links.indices, dtype=np.int64)

    @cached_property
    def reverse(self) -> Indices:
        """For each link the number of the one that goes the other way, (E,); -1 for none."""
        edges = self.senders.size
        numbered = sparse.csr_array(
            (np.arange(edges), self.links.indices, self.links.indptr), self.links.shape
        )
        turned = numbered.T.tocsr()
        if (turned.indptr == self.links.indptr).all() and (turned.indices == self.senders).all():
            return np.asarray(turned.data, dtype=np.int64)
        key = self.receivers * self.size + self.senders
        other = self.senders * self.size + self.receivers
        found = np.searchsorted(key, other).clip(max=edges - 1)
        return np.where(key[found] == other, found, -1)

    @cached_property
    def incidence(self) -> sparse.csr_array:
        """Sums what arrives over an agent's links: ``incidence[i, e] = 1`` if link e ends at i."""
        edges = self.senders.size
        return sparse.csr_array(
            (np.ones(edges), np.arange(edges), self.links.indptr), (self.size, edges)
        )

    def neighbours(self, agent: int) -> tuple[int, ...]:
        """The agents that `agent` hears, ascending, without itself."""
        i = count(agent, "agent", at_least=0)
        if i >= self.size:
            raise ValueError(f"agent: needs an agent below {self.size}, got {i}")
        row = self.links.indices[self.links.indptr[i] : self.links.indptr[i + 1]]
        return tuple(row.tolist())

    @cached_property
    def degrees(self) -> Array:
        """How many agents each agent hears, (A,)."""
        return np.asarray(np.diff(self.links.indptr), dtype=np.float64)

    @cached_property
    def listeners(self) -> Array:
        """How many agents hear each agent, (A,)."""
        return np.bincount(self.senders, minlength=self.size).astype(np.float64)

    @cached_property
    def directed(self) -> bool:
        """Whether some link goes one way only."""
        turned = self.links.T.tocsr()
        same = (turned.indptr == self.links.indptr).all() and (turned.indices == self.senders).all()
        return not same

    @cached_property
    def laplacian(self) -> sparse.csr_array:
        """The Laplacian, sparse: degrees on the diagonal, -1 where an agent hears another."""
        return (sparse.diags_array(self.degrees) - self.links).tocsr()

    @cached_property
    def spectrum(self) -> Array:
        """Eigenvalues of the Laplacian of an undirected graph, ascending, (A,).

        All of them, by a dense solver: seconds at 2 000 agents, and eight times that at twice as
        many. :attr:`largest_gain` and :attr:`fiedler_value` need only the ends.
        """
        self._undirected()
        return np.asarray(np.linalg.eigvalsh(self.laplacian.toarray()), dtype=np.float64)

    @cached_property
    def fiedler_value(self) -> float:
        """The second smallest eigenvalue of the Laplacian; 0 where the graph is not connected."""
        self._undirected()
        if self.size == 1 or not self.connected:
            return 0.0
        if self.size <= _spectral.DENSE:
            return float(self.spectrum[1])
        return _spectral.fiedler_value(self.laplacian, self.degrees)

    @cached_property
    def largest_gain(self) -> float:
        r"""The bound below which averaging agrees, :math:`2/\lambda_{\max}` with links both ways.

        With one-way links the eigenvalues are complex and it is the least
        :math:`2\operatorname{Re}\lambda/|\lambda|^2`, by a dense solver. Infinite without links.
        """
        if self.senders.size == 0:
            return float("inf")
        if self.directed:
            values = np.linalg.eigvals(self.laplacian.toarray())
            values = values[np.abs(values) > 1e-9 * np.abs(values).max()]
            return float((2 * values.real / np.abs(values) ** 2).min(initial=np.inf))
        if self.size <= _spectral.DENSE:
            return float(2 / self.spectrum[-1])
        bound = _spectral.degree_bound(self.links, self.degrees)
        return 2 / _spectral.largest_eigenvalue(self.laplacian, bound)

    @cached_property
    def safe_gain(self) -> float:
        """A gain from the degrees alone, at most :attr:`largest_gain`; agents can compute it."""
        if self.senders.size == 0:
            return float("inf")
        if self.directed:
            return float(1 / self.degrees.max())  # Gershgorin's discs
        return 2 / _spectral.degree_bound(self.links, self.degrees)

    @cached_property
    def components(self) -> Indices:
        """For each agent the number of its (strongly) connected component, (A,)."""
        _, labels = sparse.csgraph.connected_components(self.links, connection="strong")
        return np.asarray(labels, dtype=np.int64)

    @property
    def connected(self) -> bool:
        """Whether every agent can reach every other along the links."""
        return int(self.components.max()) == 0

    def hops(self, agent: int) -> Indices:
        """How many rounds news of an agent takes to reach each, (A,); -1 where it never does.

        >>> from distfilt.network import graphs
        >>> graphs.path(4).hops(1)
        array([1, 0, 1, 2])
        """
        i = count(agent, "agent", at_least=0)
        if i >= self.size:
            raise ValueError(f"agent: needs an agent below {self.size}, got {i}")
        return _spectral.hops(sparse.csr_array(self.links.T), i)

    @cached_property
    def diameter(self) -> int:
        """The largest number of hops between two agents of a connected graph."""
        self._in_one_piece()
        return _spectral.diameter(self.links, symmetric=not self.directed)

    @cached_property
    def diameter_bound(self) -> int:
        """At least the diameter, at most twice it, from four searches however large the graph."""
        self._in_one_piece()
        return _spectral.diameter_bound(self.links, symmetric=not self.directed)

    def _in_one_piece(self) -> None:
        if not self.connected:
            parts = self.components.max() + 1
            raise ValueError(f"graph: needs a connected graph, got {parts} parts")

    def _undirected(self) -> None:
        if self.directed:
            raise ValueError("graph: needs links both ways for a real spectrum, got one-way links")

    def to_networkx(self) -> Any:
        """The same graph as a networkx DiGraph whose edges run from speaker to listener."""
        import networkx as nx

        return nx.from_scipy_sparse_array(self.links.T, create_using=nx.DiGraph)


def linked(size: int, pairs: Indices) -> sparse.csr_array:
    """The matrix of a graph's links from pairs (listener, speaker), which may repeat."""
    links = sparse.csr_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), (size, size))
    links.sum_duplicates()
    links.data[:] = 1.0
    links.sort_indices()
    return links
