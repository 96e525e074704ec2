"""Communication graphs: links, degrees, spectra, distances, and graphs in common shapes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated

import numpy as np
import scipy
from numpy.typing import ArrayLike

from ..validation import (
    Array,
    ArrayInput,
    Bounds,
    FrozenModel,
    Indices,
    InvalidArgumentError,
    Mask,
    NonNegativeInt,
    PositiveFloat,
    PositiveInt,
    validated,
)
from . import _links

__all__ = ["Graph", "complete", "disk", "grid", "path", "ring", "star"]

_FINITE_SQUARE = Bounds(at_least=-1e150, at_most=1e150)
"""The range of coordinates whose squared distances are finite."""

_DENSE = 200
"""Up to this many agents a dense eigenvalue solver is the faster one."""

_FEW_LINKS = 8
"""Sums of up to so many terms for each agent are added term by term."""


@dataclass(frozen=True, eq=False)
class Graph(FrozenModel):
    """A communication graph: links between agents, without self-loops.

    Build it with :meth:`from_adjacency`, :meth:`from_edges`, :meth:`from_networkx` or a
    function of :mod:`distfilt.network.graphs`. A graph that changes in time is a
    function ``t -> Graph``.

    Parameters
    ----------
    links : scipy.sparse.csr_array, (A, A)
        ``links[i, j] = 1`` when agent i receives from agent j.

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
        # Checked and with sorted columns, on which the order of links depends. The dataclass is
        # frozen, so that the field cannot be assigned to.
        links = _links.from_matrix(self.links, "links", directed=True)
        object.__setattr__(self, "links", links)

    @classmethod
    @validated
    def from_adjacency(cls, adjacency: object, *, directed: bool = False) -> Graph:
        """Build a graph from a matrix of zeros and ones, an array or sparse.

        Parameters
        ----------
        adjacency : array_like or scipy.sparse array, (A, A)
            Row i marks the agents that agent i receives from.
        directed : bool
            Accept links that go one way only.
        """
        return cls.construct(
            _links.from_matrix(adjacency, "adjacency", directed=directed)
        )

    @classmethod
    @validated
    def from_edges(
        cls, agents: PositiveInt, edges: ArrayLike, *, directed: bool = False
    ) -> Graph:
        """Build a graph from its links, listed as pairs (receiver, sender).

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
        return cls.construct(
            _links.from_edges(agents, edges, "edges", directed=directed)
        )

    @classmethod
    def from_networkx(cls, graph: object, names: Sequence[str] = ()) -> Graph:
        """Build a graph from a networkx one.

        Parameters
        ----------
        graph : networkx.Graph or networkx.DiGraph
            Of a digraph an edge (u, v) is a pair of :meth:`from_edges`, and an entry of
            the matrix of :meth:`from_adjacency`: node u receives from node v. A digraph
            whose edges run from sender to receiver is ``graph.reverse()``. Names,
            weights and parallel edges are not kept.
        names : sequence of str
            Names of the agents. Nodes that are these names, or numbers written like
            them, are the agents of their label, and so are the numbers 0 to A - 1. A
            graph with other nodes is refused. Without names, nodes that are integers
            (as labels from 1 on), also as text, or tuples of them are numbered in their
            order, others in the graph's.

        Examples
        --------
        >>> import networkx
        >>> Graph.from_networkx(
        ...     networkx.path_graph(["ground", "relay", "probe"])
        ... ).neighbours(1)
        (0, 2)
        """
        if not _links.is_networkx(graph):
            raise InvalidArgumentError(
                f"graph must be a networkx graph, got {type(graph).__name__}"
            )
        nodes = list(graph.nodes)
        if not nodes:
            raise ValueError("graph must have at least one node, got none")
        order = _links.order_nodes(nodes, names)
        number_of = {node: number for number, node in enumerate(order)}
        # An edge (u, v) is a pair (receiver, sender), as in the matrix of networkx, whose
        # row u has the entry v. Edges of a multigraph have a key as third entry.
        edges = [(number_of[edge[0]], number_of[edge[1]]) for edge in graph.edges]
        return cls.from_edges(len(nodes), edges, directed=bool(graph.is_directed()))

    @cached_property
    def n_agents(self) -> int:
        """Number A of agents."""
        return int(self.links.shape[0])

    @cached_property
    def receivers(self) -> Indices:
        """The receiver of each link, (E,), ascending."""
        # Row i of the matrix has one entry for each link that ends at agent i.
        return np.repeat(np.arange(self.n_agents), np.diff(self.links.indptr))

    @cached_property
    def senders(self) -> Indices:
        """The sender of each link, (E,), ascending for each receiver."""
        return np.asarray(self.links.indices, dtype=np.int64)

    @cached_property
    def reverse(self) -> Indices:
        """The number of the opposite link of each link, (E,), of an undirected graph."""
        self._check_undirected()
        # Links are ordered by (receiver, sender). In the order by (sender, receiver) entry e is
        # the number of the link opposite to e.
        return np.lexsort((self.receivers, self.senders))

    @cached_property
    def incidence(self) -> scipy.sparse.csr_array:
        """The matrix that sums over links: ``incidence[i, e] = 1`` if link e ends at agent i."""
        n_links = self.senders.size
        # The rows of this matrix have as many entries as those of the adjacency matrix.
        entries = (np.ones(n_links), np.arange(n_links), self.links.indptr)
        return scipy.sparse.csr_array(entries, (self.n_agents, n_links))

    def _sum_by_receiver(self, per_link: Array, axis: int = -2) -> Array:
        """Return sums over each agent's links: E entries along an axis become A.

        Entry e along this axis belongs to link e of E, entry i of the result to agent i of A.
        """
        if 0 < self._degree <= _FEW_LINKS:
            # On a regular graph, in which the same number of links, the degree, ends at each agent,
            # links are in the order of the receivers: an axis of agents and one of terms, which are
            # added one by one. The axes before and behind that of the links become one each.
            axis %= per_link.ndim
            before = per_link.shape[:axis]
            behind = per_link.shape[axis + 1 :]
            n = self.n_agents
            lead = math.prod(before)
            by_agent = per_link.reshape(lead, n, self._degree, math.prod(behind))
            # A new array, and a sum from zero, as the sparse product's below.
            total = 0.0 + by_agent[:, :, 0]
            for k in range(1, self._degree):
                total += by_agent[:, :, k]
            return np.asarray(total.reshape(*before, n, *behind))
        # One sparse product over all other axes at once.
        links_first = per_link.swapaxes(axis, 0)
        shape = (self.n_agents, *links_first.shape[1:])
        columns = links_first.reshape(len(links_first), math.prod(shape[1:]))
        sums = np.asarray(self.incidence @ columns)
        return sums.reshape(shape).swapaxes(0, axis)

    @validated
    def neighbours(self, agent: NonNegativeInt) -> tuple[int, ...]:
        """Return the agents that `agent` receives from, ascending, without itself."""
        Bounds(below=self.n_agents)(agent, "agent")
        # Row i of the sparse matrix has the senders of the links to agent i.
        start = self.links.indptr[agent]
        stop = self.links.indptr[agent + 1]
        return tuple(self.links.indices[start:stop].tolist())

    @cached_property
    def in_degree(self) -> Array:
        """Number of agents that each agent receives from, (A,)."""
        return np.asarray(np.diff(self.links.indptr), dtype=np.float64)

    @cached_property
    def _degree(self) -> int:
        """Number of agents that each agent receives from, of a regular graph; 0 of others."""
        degrees = self.in_degree
        is_regular = (degrees == degrees[0]).all()
        return int(degrees[0]) if is_regular else 0

    @cached_property
    def _receivers_of(self) -> list[list[int]]:
        """The agents that receive from each agent, ascending."""
        result: list[list[int]] = [[] for _ in range(self.n_agents)]
        pairs = zip(self.receivers.tolist(), self.senders.tolist(), strict=True)
        for receiver, sender in pairs:
            result[sender].append(receiver)
        return result

    @cached_property
    def _every_link(self) -> Mask:
        """True for each link, (E,), read-only."""
        links = np.ones(self.senders.size, dtype=bool)
        # All callers share the cached array.
        links.setflags(write=False)
        return links

    @cached_property
    def _equal_weights(self) -> tuple[Array, Array]:
        """The same weight for an agent itself and each of its links, (1, A) and (1, E)."""
        total = 1.0 + self.in_degree[None]
        return 1.0 / total, 1 / total[:, self.receivers]

    @cached_property
    def out_degree(self) -> Array:
        """Number of agents that receive from each agent, (A,)."""
        return np.bincount(self.senders, minlength=self.n_agents).astype(np.float64)

    @cached_property
    def messages_a_round(self) -> Indices:
        """Number of messages of each agent if it sends on all its links, (A,)."""
        return self.out_degree.astype(np.int64)

    @cached_property
    def is_sender(self) -> Indices:
        """One for an agent from which others receive, zero for others, (A,)."""
        return (self.out_degree > 0).astype(np.int64)

    def _bill_of_floats(self, numbers: int) -> tuple[Indices, ...]:
        """What each agent sends if a round has so many floats on every link.

        Messages, scalars and bytes by link, then transmissions, scalars and bytes by broadcast.
        Each is (A,); a float has eight bytes.
        """
        if numbers not in self._bills:
            bills = []
            for count in (self.messages_a_round, self.is_sender):
                bills += [count, count * numbers, count * (8 * numbers)]
            self._bills[numbers] = tuple(bills)
        return self._bills[numbers]

    @cached_property
    def _bills(self) -> dict[int, tuple[Indices, ...]]:
        """The bills of rounds that have occurred, by their number of floats."""
        return {}

    @cached_property
    def is_directed(self) -> bool:
        """Whether some link goes one way only."""
        # The same structure as the transpose's; both have sorted columns.
        transposed = self.links.T.tocsr()
        if (transposed.indptr != self.links.indptr).any():
            return True
        return bool((transposed.indices != self.senders).any())

    @cached_property
    def laplacian(self) -> scipy.sparse.csr_array:
        """The Laplacian, sparse: in-degrees on the diagonal, -1 for each link."""
        return (scipy.sparse.diags_array(self.in_degree) - self.links).tocsr()

    @cached_property
    def laplacian_spectrum(self) -> Array:
        """Eigenvalues of the Laplacian of an undirected graph, ascending, (A,).

        All of them, by a dense solver: seconds at 2 000 agents. :attr:`max_stable_gain`
        needs only the largest.
        """
        self._check_undirected()
        eigenvalues = np.linalg.eigvalsh(self.laplacian.toarray())
        return np.asarray(eigenvalues, dtype=np.float64)

    @cached_property
    def max_stable_gain(self) -> float:
        r"""The gain below which averaging converges, :math:`2/\lambda_{\max}` with links both ways.

        With one-way links the eigenvalues are complex and it is the least
        :math:`2\operatorname{Re}\lambda/|\lambda|^2`, by a dense solver. Infinite without links.
        It is :attr:`degree_bound_gain` where the largest eigenvalues lie too close
        together for the iterative solver, as on a ring of very many agents.
        """
        if self.senders.size == 0:
            return float("inf")
        if self.is_directed:
            # |1 - γλ| < 1 if and only if γ < 2 Re λ / |λ|². The eigenvalue zero is left out: it
            # belongs to the average, which stays.
            values = np.linalg.eigvals(self.laplacian.toarray())
            sizes = np.abs(values)
            # Rounding leaves about 1e-15 of the largest eigenvalue in place of zero.
            is_nonzero = sizes > 1e-9 * sizes.max()
            bounds = 2 * values.real[is_nonzero] / sizes[is_nonzero] ** 2
            return float(bounds.min(initial=np.inf))
        if self.n_agents <= _DENSE:
            return float(2 / self.laplacian_spectrum[-1])
        return self._max_stable_gain_sparse()

    def _max_stable_gain_sparse(self) -> float:
        """Return 2/λ_max by Lanczos iterations, or the bound if they do not converge."""
        from scipy.sparse.linalg import ArpackNoConvergence, eigsh

        # A fixed seed makes results repeatable; a random vector has a part along every
        # eigenvector.
        start = np.random.default_rng(0).standard_normal(self.n_agents)
        # One eigenvalue, the largest ("LA"), without its vector, to eight digits
        try:
            largest = eigsh(
                self.laplacian,
                1,
                which="LA",
                v0=start,
                tol=1e-8,
                maxiter=100,
                return_eigenvectors=False,
            )
        except ArpackNoConvergence:
            return self.degree_bound_gain
        return float(2 / largest[0])

    @cached_property
    def degree_bound_gain(self) -> float:
        """A gain from the degrees alone, at most :attr:`max_stable_gain`.

        Agents can compute it by a maximum consensus. With links both ways it follows
        from the largest sum of an agent's degree and its neighbours' mean degree (R.
        Merris, Linear Algebra and its Applications 285 (1998) 33-35), exact for stars
        and even rings; else by Gershgorin's discs.
        """
        if self.senders.size == 0:
            return float("inf")
        if self.is_directed:
            # Gershgorin: every eigenvalue lies in a disc around d_i with radius d_i.
            return float(1 / self.in_degree.max())
        # λ_max <= max_i (d_i + m_i), with the mean degree m_i of agent i's neighbours.
        mean_degree = (self.links @ self.in_degree) / np.maximum(self.in_degree, 1)
        return float(2 / (self.in_degree + mean_degree).max())

    @cached_property
    def components(self) -> Indices:
        """For each agent the number of its (strongly) connected component, (A,)."""
        _n_components, labels = scipy.sparse.csgraph.connected_components(
            self.links, connection="strong"
        )
        return np.asarray(labels, dtype=np.int64)

    @property
    def is_connected(self) -> bool:
        """Whether every agent can reach every other along the links."""
        # Components are numbered from 0.
        return int(self.components.max()) == 0

    @validated
    def hops(self, agent: NonNegativeInt) -> Indices:
        """Return the number of rounds from an agent to each other, (A,); -1 if there is no path.

        >>> from distfilt.network import graphs
        >>> graphs.path(4).hops(1)
        array([1, 0, 1, 2])
        """
        Bounds(below=self.n_agents)(agent, "agent")
        # links[i, j] leads from j to i, against the order of scipy's graphs.
        forward = scipy.sparse.csr_array(self.links.T)
        hops = scipy.sparse.csgraph.dijkstra(forward, indices=agent, unweighted=True)
        return np.where(np.isinf(hops), -1, hops).astype(np.int64)

    @cached_property
    def diameter(self) -> int:
        """The largest number of hops between two agents of a connected graph."""
        self._check_connected()
        return max(int(self.hops(agent).max()) for agent in range(self.n_agents))

    def _check_connected(self) -> None:
        """Refuse a graph of several components."""
        if not self.is_connected:
            count = self.components.max() + 1
            raise ValueError(
                f"graph must be (strongly) connected, got {count} components"
            )

    def _check_undirected(self) -> None:
        """Refuse one-way links."""
        if self.is_directed:
            raise ValueError("graph must have links both ways here, got one-way links")


def as_graph(
    value: object, n_agents: int | None = None, names: Sequence[str] = ()
) -> Graph:
    """Return a graph from any description of one.

    Parameters
    ----------
    value : Graph, networkx graph, matrix or edges
        A matrix of zeros and ones, an array or sparse, as in
        :meth:`Graph.from_adjacency`, or edges as in :meth:`Graph.from_edges`, both with
        links both ways.
    n_agents : int, optional
        The number of agents that it must have. Without it, edges have one more agent
        than the largest number in them.
    names : sequence of str
        Names of the agents, for edges between names, and for a networkx graph: see
        :meth:`Graph.from_networkx`.

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
        # Edges between names become edges between numbers; a matrix stays as it is.
        edges = _links.number_edges(value, names, "graph")
        # Checked here, so that the graph is made without another check: a sparse matrix, (A, A).
        links = _links.from_matrix_or_edges(edges, n_agents, "graph")
        graph = Graph.construct(links)
    else:
        raise InvalidArgumentError(
            "graph must be a Graph, a networkx graph, a matrix of zeros and ones, or "
            f"edges, got {type(value).__name__}"
        )
    if n_agents is not None and graph.n_agents != n_agents:
        raise ValueError(f"graph must have {n_agents} agents, got {graph.n_agents}")
    return graph


def _link_both_ways(n_agents: int, first: Indices, second: Indices) -> Graph:
    """Return the graph with a link both ways between the agents of each pair."""
    one_way = np.stack([first.ravel(), second.ravel()], axis=1)
    both_ways = np.concatenate([one_way, one_way[:, ::-1]])
    return Graph.construct(_links.build_links(n_agents, both_ways, "graph"))


@validated
def path(agents: PositiveInt) -> Graph:
    """Return a graph of agents in a row.

    >>> path(3).neighbours(1)
    (0, 2)
    """
    numbers = np.arange(agents)
    return _link_both_ways(agents, numbers[:-1], numbers[1:])


@validated
def ring(agents: Annotated[int, Bounds(at_least=3)]) -> Graph:
    """Return a graph of agents in a circle, at least three.

    >>> ring(4).neighbours(0)
    (1, 3)
    """
    numbers = np.arange(agents)
    return _link_both_ways(agents, numbers, np.roll(numbers, -1))


@validated
def star(agents: PositiveInt) -> Graph:
    """Return a graph in which agent 0 has a link with each other agent, and they with it only.

    The network of Tables II and III of Grange et al.

    >>> star(5).laplacian_spectrum.round(6) + 0.0
    array([0., 1., 1., 1., 5.])
    """
    # Links between agent 0 and each of the others.
    others = np.arange(1, agents)
    return _link_both_ways(agents, np.zeros_like(others), others)


@validated
def grid(rows: PositiveInt, columns: PositiveInt) -> Graph:
    """Return a graph of agents on a rectangular grid, numbered row by row.

    >>> grid(2, 3).neighbours(4)
    (1, 3, 5)
    """
    numbers = np.arange(rows * columns).reshape(rows, columns)
    # Each agent with its right neighbour, then each with the one below.
    first = np.concatenate([numbers[:, :-1].ravel(), numbers[:-1].ravel()])
    second = np.concatenate([numbers[:, 1:].ravel(), numbers[1:].ravel()])
    return _link_both_ways(numbers.size, first, second)


@validated
def complete(agents: PositiveInt) -> Graph:
    """Return the graph in which every agent has a link with every other.

    >>> complete(4).in_degree
    array([3., 3., 3., 3.])
    """
    # Every pair once.
    first, second = np.triu_indices(agents, 1)
    return _link_both_ways(agents, first, second)


@validated
def disk(
    positions: Annotated[ArrayInput, "A p", _FINITE_SQUARE],
    radius: PositiveFloat,
) -> Graph:
    """Return the disk graph: links between agents within a distance, as radios of one range have.

    Parameters
    ----------
    positions : array_like, (A, p)
        Where the agents are.
    radius : float
        The range, in the positions' unit, positive. Agents at exactly this distance
        have a link.

    Notes
    -----
    A k-d tree finds the pairs, so that 10 000 moving agents cost milliseconds a step.

    Examples
    --------
    >>> disk([[0.0, 0.0], [1.0, 0.0], [5.0, 0.0]], 2.0).in_degree
    array([1., 1., 0.])
    """
    from scipy.spatial import cKDTree

    # A k-d tree of no points does not exist.
    if positions.size == 0:
        raise ValueError(
            f"positions must have at least one agent, got shape {positions.shape}"
        )
    tree = cKDTree(positions)
    pairs = tree.query_pairs(radius, output_type="ndarray").astype(np.int64)
    return _link_both_ways(len(positions), pairs[:, 0], pairs[:, 1])
