"""Who hears whom: a graph of agents, what follows from its links, and graphs in common shapes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Any

import numpy as np
import scipy
from numpy.typing import ArrayLike

from ..validation import (
    Array,
    Bounds,
    FrozenModel,
    Indices,
    NonNegativeInt,
    PositiveFloat,
    PositiveInt,
    validated,
)
from . import _links

__all__ = ["Graph", "complete", "disk", "grid", "path", "ring", "star"]

_DENSE = 200
"""Up to this many agents a dense eigenvalue solver is the faster one."""


@dataclass(frozen=True, eq=False)
class Graph(FrozenModel):
    """Links between agents, without self-loops: an agent always knows what it knows itself.

    Build it with :meth:`from_adjacency`, :meth:`from_edges`, :meth:`from_networkx` or a function of
    :mod:`distfilt.network.graphs`. A graph that changes in time is a function ``t -> Graph``.

    Parameters
    ----------
    links : scipy.sparse.csr_array, (A, A)
        ``links[i, j] = 1`` when agent i hears agent j.

    Examples
    --------
    >>> graph = Graph.from_adjacency([[0, 1, 1], [1, 0, 0], [1, 0, 0]])
    >>> graph.neighbours(0)
    (1, 2)
    >>> graph.laplacian_spectrum.round(6) + 0.0
    array([0., 1., 3.])
    """

    links: scipy.sparse.csr_array

    def __post_init__(self) -> None:
        super().__post_init__()
        links = _links.of_matrix(self.links, "links", directed=True)
        object.__setattr__(self, "links", links)

    @classmethod
    @validated
    def from_adjacency(cls, adjacency: Any, *, directed: bool = False) -> Graph:
        """Build a graph from a matrix of zeros and ones, an array or sparse.

        Parameters
        ----------
        adjacency : array_like or scipy.sparse array, (A, A)
            Row i marks the agents that agent i hears.
        directed : bool
            Accept links that go one way only.
        """
        return cls.construct(
            _links.of_matrix(adjacency, "adjacency", directed=directed)
        )

    @classmethod
    @validated
    def from_edges(
        cls, agents: PositiveInt, edges: ArrayLike, *, directed: bool = False
    ) -> Graph:
        """Build a graph from its links, listed as pairs (listener, speaker).

        Parameters
        ----------
        agents : int
            Number A of agents.
        edges : array_like of int, (E, 2)
            The links; of an undirected graph each may be listed once or both ways.
        directed : bool
            Links go one way only, unless both are listed.

        Examples
        --------
        >>> Graph.from_edges(3, [(0, 1), (1, 2)]).neighbours(1)
        (0, 2)
        """
        return cls.construct(_links.of_edges(agents, edges, "edges", directed=directed))

    @classmethod
    def from_networkx(cls, graph: Any, names: Sequence[str] = ()) -> Graph:
        """Build a graph from a networkx one.

        Parameters
        ----------
        graph : networkx.Graph or networkx.DiGraph
            Of a digraph an edge runs from speaker to listener. Names, weights and parallel edges
            are left behind.
        names : sequence of str
            Of the agents. Nodes that are these, or 0 to A - 1, are agents by their labels; others
            by the order in which the graph has them. If only some of them are these, it is refused.

        Examples
        --------
        >>> import networkx
        >>> Graph.from_networkx(
        ...     networkx.path_graph(["ground", "relay", "probe"])
        ... ).neighbours(1)
        (0, 2)
        """
        if not _links.is_networkx(graph):
            raise ValueError(
                f"graph must be a networkx graph, got {type(graph).__name__}"
            )
        labels = range(len(graph.nodes)), names, graph.nodes
        order = next(some for some in labels if {*some} == {*graph.nodes})
        if order is labels[2] and {*names} & {*order}:
            raise ValueError(f"graph must be the nodes {[*names]}, got {[*order]}")
        number_of = {node: k for k, node in enumerate(order)}
        edges = [(number_of[edge[1]], number_of[edge[0]]) for edge in graph.edges]
        return cls.from_edges(len(number_of), edges, directed=bool(graph.is_directed()))

    @property
    def n_agents(self) -> int:
        """Number A of agents."""
        return int(self.links.shape[0])

    @cached_property
    def receivers(self) -> Indices:
        """The listener of each link, (E,), ascending."""
        return np.repeat(np.arange(self.n_agents), np.diff(self.links.indptr))

    @cached_property
    def senders(self) -> Indices:
        """The speaker of each link, (E,), ascending for each listener."""
        return np.asarray(self.links.indices, dtype=np.int64)

    @cached_property
    def reverse(self) -> Indices:
        """For each link, of links both ways, the number of the one that goes back, (E,)."""
        self._undirected()
        return np.lexsort((self.receivers, self.senders))

    @cached_property
    def incidence(self) -> scipy.sparse.csr_array:
        """Sums what arrives over an agent's links: ``incidence[i, e] = 1`` if link e ends at i."""
        edges = self.senders.size
        parts = np.ones(edges), np.arange(edges), self.links.indptr
        return scipy.sparse.csr_array(parts, (self.n_agents, edges))

    def _summed(self, per_link: Array, axis: int = -2) -> Array:
        """What arrives over each agent's links, added: E entries along an axis become A."""
        front = per_link.swapaxes(axis, 0)
        shape = (self.n_agents, *front.shape[1:])
        out = self.incidence @ front.reshape(len(front), math.prod(shape[1:]))
        return np.asarray(out).reshape(shape).swapaxes(0, axis)

    @validated
    def neighbours(self, agent: NonNegativeInt) -> tuple[int, ...]:
        """The agents that `agent` hears, ascending, without itself."""
        Bounds(below=self.n_agents)(agent, "agent")
        row = self.links.indices[
            self.links.indptr[agent] : self.links.indptr[agent + 1]
        ]
        return tuple(row.tolist())

    @cached_property
    def in_degree(self) -> Array:
        """How many agents each agent hears, (A,)."""
        return np.asarray(np.diff(self.links.indptr), dtype=np.float64)

    @cached_property
    def out_degree(self) -> Array:
        """How many agents hear each agent, (A,)."""
        return np.bincount(self.senders, minlength=self.n_agents).astype(np.float64)

    @cached_property
    def directed(self) -> bool:
        """Whether some link goes one way only."""
        turned = self.links.T.tocsr()
        same = (turned.indptr == self.links.indptr).all() and (
            turned.indices == self.senders
        ).all()
        return not same

    @cached_property
    def laplacian(self) -> scipy.sparse.csr_array:
        """The Laplacian, sparse: degrees on the diagonal, -1 where an agent hears another."""
        return (scipy.sparse.diags_array(self.in_degree) - self.links).tocsr()

    @cached_property
    def laplacian_spectrum(self) -> Array:
        """Eigenvalues of the Laplacian of an undirected graph, ascending, (A,).

        All, by a dense solver, in seconds at 2 000 agents; :attr:`max_stable_gain` needs only an end.
        """
        self._undirected()
        return np.asarray(
            np.linalg.eigvalsh(self.laplacian.toarray()), dtype=np.float64
        )

    @cached_property
    def max_stable_gain(self) -> float:
        r"""The bound below which averaging agrees, :math:`2/\lambda_{\max}` with links both ways.

        With one-way links the eigenvalues are complex and it is the least
        :math:`2\operatorname{Re}\lambda/|\lambda|^2`, by a dense solver. Infinite without links;
        :attr:`degree_bound_gain` where too many eigenvalues crowd at the end to tell them apart, as on a
        ring of very many agents.
        """
        from scipy.sparse.linalg import ArpackNoConvergence, eigsh

        if self.senders.size == 0:
            return float("inf")
        if self.directed:
            values = np.linalg.eigvals(self.laplacian.toarray())
            values = values[np.abs(values) > 1e-9 * np.abs(values).max()]
            return float((2 * values.real / np.abs(values) ** 2).min(initial=np.inf))
        if self.n_agents <= _DENSE:
            return float(2 / self.laplacian_spectrum[-1])
        # A fixed start makes results repeatable; a random one is orthogonal to no eigenvector.
        start = np.random.default_rng(0).standard_normal(self.n_agents)
        how = {"v0": start, "tol": 1e-8, "maxiter": 100, "return_eigenvectors": False}
        try:
            return float(2 / eigsh(self.laplacian, 1, which="LA", **how)[0])
        except ArpackNoConvergence:
            return self.degree_bound_gain

    @cached_property
    def degree_bound_gain(self) -> float:
        """A gain from the degrees alone, at most :attr:`max_stable_gain`; agents can compute it.

        With links both ways by the largest sum of an agent's degree and its neighbours' mean degree
        (R. Merris, Linear Algebra and its Applications 285 (1998) 33-35), exact for stars and even
        rings; else by Gershgorin's discs.
        """
        if self.senders.size == 0:
            return float("inf")
        if self.directed:
            return float(1 / self.in_degree.max())
        near = (self.links @ self.in_degree) / np.maximum(self.in_degree, 1)
        return float(2 / (self.in_degree + near).max())

    @cached_property
    def components(self) -> Indices:
        """For each agent the number of its (strongly) connected component, (A,)."""
        _, labels = scipy.sparse.csgraph.connected_components(
            self.links, connection="strong"
        )
        return np.asarray(labels, dtype=np.int64)

    @property
    def connected(self) -> bool:
        """Whether every agent can reach every other along the links."""
        return int(self.components.max()) == 0

    @validated
    def hops(self, agent: NonNegativeInt) -> Indices:
        """How many rounds news of an agent takes to reach each, (A,); -1 where it never does.

        >>> from distfilt.network import graphs
        >>> graphs.path(4).hops(1)
        array([1, 0, 1, 2])
        """
        Bounds(below=self.n_agents)(agent, "agent")
        forward = scipy.sparse.csr_array(self.links.T)
        away = scipy.sparse.csgraph.dijkstra(forward, indices=agent, unweighted=True)
        return np.where(np.isinf(away), -1, away).astype(np.int64)

    @cached_property
    def diameter(self) -> int:
        """The largest number of hops between two agents of a connected graph."""
        self._joined()
        return max(int(self.hops(agent).max()) for agent in range(self.n_agents))

    def _joined(self) -> None:
        """Refuse a graph in parts."""
        if not self.connected:
            parts = self.components.max() + 1
            raise ValueError(
                f"graph must be a (strongly) connected graph, got {parts} parts"
            )

    def _undirected(self) -> None:
        """Refuse one-way links."""
        if self.directed:
            raise ValueError("graph must have links both ways here, got one-way links")


def as_graph(value: Any, size: int | None = None, names: Sequence[str] = ()) -> Graph:
    """A graph from whatever describes one.

    Parameters
    ----------
    value : Graph, networkx graph, matrix or edges
        A matrix of zeros and ones, an array or sparse, as in :meth:`Graph.from_adjacency`, or edges
        as in :meth:`Graph.from_edges`, both with links both ways.
    size : int, optional
        The number of agents that it needs to have; of edges, one more than the largest in them.

    Examples
    --------
    >>> as_graph([(0, 1), (1, 2)]).in_degree
    array([1., 2., 1.])
    """
    if isinstance(value, Graph):
        graph = value
    elif _links.is_networkx(value):
        graph = Graph.from_networkx(value, names)
    elif scipy.sparse.issparse(value) or isinstance(value, np.ndarray | list | tuple):
        graph = Graph.construct(_links.of_either(value, size, "graph"))
    else:
        needs = "a Graph, a networkx graph, a matrix of zeros and ones, or edges"
        raise ValueError(f"graph must be {needs}, got {type(value).__name__}")
    if size is not None and graph.n_agents != size:
        raise ValueError(
            f"graph must be a graph of {size} agents, got {graph.n_agents}"
        )
    return graph


def _both_ways(size: int, first: Indices, second: Indices) -> Graph:
    one_way = np.stack([first.ravel(), second.ravel()], axis=1)
    both = np.concatenate([one_way, one_way[:, ::-1]])
    return Graph.construct(_links.linked(size, both, "graph"))


@validated
def path(agents: PositiveInt) -> Graph:
    """Agents in a row.

    >>> path(3).neighbours(1)
    (0, 2)
    """
    number_of = np.arange(agents)
    return _both_ways(agents, number_of[:-1], number_of[1:])


@validated
def ring(agents: Annotated[int, Bounds(at_least=3)]) -> Graph:
    """Agents in a circle, at least three.

    >>> ring(4).neighbours(0)
    (1, 3)
    """
    number_of = np.arange(agents)
    return _both_ways(agents, number_of, np.roll(number_of, -1))


@validated
def star(agents: PositiveInt) -> Graph:
    """Agent 0 hears all the others and they hear only it; Tables II and III of Grange et al.

    >>> star(5).laplacian_spectrum.round(6) + 0.0
    array([0., 1., 1., 1., 5.])
    """
    others = np.arange(1, agents)
    return _both_ways(agents, np.zeros_like(others), others)


@validated
def grid(rows: PositiveInt, columns: PositiveInt) -> Graph:
    """Agents on a rectangular grid, numbered row by row.

    >>> grid(2, 3).neighbours(4)
    (1, 3, 5)
    """
    at = np.arange(rows * columns).reshape(rows, columns)
    first = np.concatenate([at[:, :-1].ravel(), at[:-1].ravel()])
    return _both_ways(
        at.size, first, np.concatenate([at[:, 1:].ravel(), at[1:].ravel()])
    )


@validated
def complete(agents: PositiveInt) -> Graph:
    """Everybody hears everybody.

    >>> complete(4).in_degree
    array([3., 3., 3., 3.])
    """
    return _both_ways(agents, *np.triu_indices(agents, 1))


@validated
def disk(
    positions: Annotated[Array, "A p", Bounds(at_least=-1e150, at_most=1e150)],
    radius: PositiveFloat,
) -> Graph:
    """Agents hear each other within a distance: the graph of radios of one range.

    Parameters
    ----------
    positions : array_like, (A, p)
        Where the agents are.
    radius : float
        The range, in the positions' unit, positive; the distance itself still counts as heard.

    Notes
    -----
    A k-d tree finds the pairs, so that 10 000 moving agents cost milliseconds a step.

    Examples
    --------
    >>> disk([[0.0, 0.0], [1.0, 0.0], [5.0, 0.0]], 2.0).in_degree
    array([1., 1., 0.])
    """
    from scipy.spatial import cKDTree

    if positions.size == 0:
        raise ValueError(
            f"positions must have at least one agent, got shape {positions.shape}"
        )
    pairs = (
        cKDTree(positions).query_pairs(radius, output_type="ndarray").astype(np.int64)
    )
    return _both_ways(len(positions), pairs[:, 0], pairs[:, 1])
