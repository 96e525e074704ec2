"""Weights for combining values: what an agent makes of its own and of each that it hears."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike
from scipy import sparse

from ..checks import Array, array, count, instance, number
from ._spectral import left_null_vector
from .links import Graph, Indices

__all__ = [  # fmt: skip
    "Weights", "balanced", "best_constant", "fastest", "gossip", "keeping", "laplacian",
    "maximum_degree", "metropolis", "push",
]


@dataclass(frozen=True, eq=False)
class Weights:
    """One weight for each agent's own value, and one for each link.

    Parameters
    ----------
    graph : Graph
        The links.
    own : ndarray, (A,)
        Weight of an agent's own value.
    links : ndarray, (E,)
        Weight of each link, in the order of ``graph.receivers`` and ``graph.senders``.

    Examples
    --------
    >>> from distfilt.network import graphs
    >>> metropolis(graphs.path(3)).matrix.toarray().round(3)
    array([[0.667, 0.333, 0.   ],
           [0.333, 0.333, 0.333],
           [0.   , 0.333, 0.667]])
    """

    graph: Graph
    own: Array
    links: Array

    def __post_init__(self) -> None:
        instance(self.graph, "graph", Graph)
        size, edges = (self.graph.size,), (self.graph.senders.size,)
        object.__setattr__(self, "own", array(self.own, "own", size))
        object.__setattr__(self, "links", array(self.links, "links", edges))

    @classmethod
    def from_matrix(
        cls, graph: Graph, matrix: Weights | ArrayLike | sparse.sparray, *, name: str = "matrix"
    ) -> Weights:
        """Read the weights from a matrix (A, A); off its diagonal only links may be weighted.

        `name` is what an error calls the matrix.
        """
        if isinstance(matrix, Weights):
            if matrix.graph is graph:
                return matrix
            matrix = matrix.matrix
        instance(graph, "graph", Graph)
        if not sparse.issparse(matrix):
            matrix = array(matrix, name, graph.links.shape, finite=False)
        w = sparse.csr_array(matrix)
        if w.shape != graph.links.shape:
            raise ValueError(f"{name}: needs shape {graph.links.shape}, got {w.shape}")
        if w.dtype.kind not in "fiu":
            raise ValueError(f"{name}: needs real numbers, got {w.dtype}")
        if not np.isfinite(w.data).all():
            raise ValueError(f"{name}: needs finite numbers, got NaN or infinite entries")
        own = w.diagonal()
        entries = w.tocoo()
        row, column = (np.asarray(c, dtype=np.int64) for c in entries.coords)
        used = (entries.data != 0) & (row != column)
        key = graph.receivers * graph.size + graph.senders
        wanted = (row * graph.size + column)[used]
        if not np.isin(wanted, key).all():
            raise ValueError(f"{name}: needs zeros where an agent does not hear another")
        links = np.zeros(key.size)
        links[np.searchsorted(key, wanted)] = entries.data[used]
        return cls(graph, np.asarray(own, dtype=np.float64), links)

    @cached_property
    def matrix(self) -> sparse.csr_array:
        """The matrix W of x <- W x, (A, A), each row's own entry stored first."""
        return stacked(self.graph, self.own[None], self.links[None], heard_at=0)


def stacked(graph: Graph, own: Array, links: Array, *, heard_at: int) -> sparse.csr_array:
    """Matrices of R runs as one block-diagonal matrix, each row's own entry first.

    `own` is (R, A) and `links` (R, E). With `heard_at` = 0 both multiply the same stacked values;
    otherwise what is heard stands `heard_at` rows further on.
    """
    runs, size, edges = own.shape[0], graph.size, graph.senders.size
    starts = graph.links.indptr + np.arange(size + 1)
    data = np.empty((runs, size + edges))
    indices = np.empty((runs, size + edges), dtype=np.int64)
    at_own = starts[:-1]
    at_link = np.arange(edges) + graph.receivers + 1
    offset = size * np.arange(runs)[:, None]
    data[:, at_own], data[:, at_link] = own, links
    indices[:, at_own] = np.arange(size) + offset
    indices[:, at_link] = graph.senders + offset + heard_at
    pointers = np.concatenate(
        [(starts[:-1] + (size + edges) * np.arange(runs)[:, None]).ravel(), [data.size]]
    )
    shape = (runs * size, runs * size + heard_at)
    return sparse.csr_array((data.ravel(), indices.ravel(), pointers), shape)


def _both_ways(graph: Graph) -> None:
    instance(graph, "graph", Graph)
    if graph.directed:
        raise ValueError("graph: needs links both ways for these weights, got one-way links")


def _connected(graph: Graph) -> None:
    instance(graph, "graph", Graph)
    if not graph.connected:
        raise ValueError(
            f"graph: needs a strongly connected graph, got {graph.components.max() + 1} components"
        )


def metropolis(graph: Graph) -> Weights:
    r"""Metropolis weights :math:`w_{ij}=1/(1+\max(d_i,d_j))`: symmetric, rows sum to one.

    Each agent needs only its neighbours' degrees. An agent without neighbours keeps its value.

    Notes
    -----
    L. Xiao, S. Boyd and S. Lall, Information Processing in Sensor Networks (2005) 63-70.

    Examples
    --------
    >>> from distfilt.network import graphs
    >>> metropolis(graphs.star(3)).own.round(3)
    array([0.333, 0.667, 0.667])
    """
    _both_ways(graph)
    d = graph.degrees
    links = 1 / (1 + np.maximum(d[graph.receivers], d[graph.senders]))
    return Weights(graph, 1 - _row_sums(graph, links), links)


def maximum_degree(graph: Graph) -> Weights:
    """Equal weights 1 / (1 + the largest degree) on every link; needs that one global number.

    >>> from distfilt.network import graphs
    >>> maximum_degree(graphs.star(3)).own.round(3)
    array([0.333, 0.667, 0.667])
    """
    _both_ways(graph)
    links = np.full(graph.senders.size, 1 / (1 + graph.degrees.max()))
    return Weights(graph, 1 - _row_sums(graph, links), links)


def laplacian(graph: Graph, gain: float) -> Weights:
    r"""The weights of one averaging step, :math:`\mathbf I-\gamma\mathbf L`.

    Parameters
    ----------
    graph, gain
        The links, one way or both, and the gain γ, at least 0.

    Examples
    --------
    >>> from distfilt.network import graphs
    >>> laplacian(graphs.star(3), 0.5).own
    array([0. , 0.5, 0.5])
    """
    g = number(gain, "gain", at_least=0)
    instance(graph, "graph", Graph)
    return Weights(graph, 1 - g * graph.degrees, np.full(graph.senders.size, g))


def best_constant(graph: Graph) -> Weights:
    r"""The best weights that are equal on all links, :math:`2/(\lambda_2+\lambda_{\max})`.

    The slowest and the fastest mode then shrink by the same factor,
    :math:`(\lambda_{\max}-\lambda_2)/(\lambda_{\max}+\lambda_2)` a round. Both eigenvalues are
    global knowledge.

    Notes
    -----
    L. Xiao and S. Boyd, Systems & Control Letters 53 (2004) 65-78, section 4.1.

    Examples
    --------
    >>> from distfilt.network import graphs
    >>> float(best_constant(graphs.star(3)).links[0])
    0.5
    """
    _connected(graph)
    if graph.size == 1:
        return laplacian(graph, 0.0)
    return laplacian(graph, 2 / (graph.fiedler_value + 2 / graph.largest_gain))


def fastest(graph: Graph, *, iterations: int = 200) -> Weights:
    r"""Symmetric weights with the (nearly) smallest second largest modulus of an eigenvalue.

    Fastest linear averaging on the graph: a convex problem, here smoothed by
    :math:`\mu\log\sum_k(e^{\lambda_k/\mu}+e^{-\lambda_k/\mu})` of the eigenvalues of
    :math:`\mathbf W-\mathbf 1\mathbf 1^\top\!/A` and solved by a quasi-Newton method for smaller
    and smaller μ. Some weights may be negative. Global knowledge, and dense: for up to some hundred
    agents.

    Parameters
    ----------
    graph : Graph
        Connected, links both ways.
    iterations : int
        At most this many for each of the four values of μ.

    Notes
    -----
    L. Xiao and S. Boyd, Systems & Control Letters 53 (2004) 65-78.

    Examples
    --------
    A bridge between two groups is the bottleneck, and gets more than its share:

    >>> from distfilt.network import Graph
    >>> edges = [(0, 1), (0, 2), (1, 2), (2, 3), (3, 4), (3, 5), (4, 5)]
    >>> pair = Graph.from_edges(6, [e for i, j in edges for e in ((i, j), (j, i))])
    >>> w = fastest(pair).matrix.toarray()
    >>> bool(w[2, 3] > 1.4 * w[0, 2])
    True
    """
    from scipy.optimize import minimize

    start = best_constant(graph)
    at = np.flatnonzero(graph.receivers < graph.senders)
    if at.size < 2:
        return start
    most = count(iterations, "iterations")
    best, slowest = start.links[at], _modulus(graph, at, start.links[at])
    x = best
    for mu in (1e-1, 1e-2, 1e-3, 1e-4):
        options = {"maxiter": most}
        x = minimize(_smoothed, x, (graph, at, mu), "L-BFGS-B", jac=True, options=options).x
        now = _modulus(graph, at, x)
        if now < slowest:
            best, slowest = x, now
    return _from_pairs(graph, at, best)


def _from_pairs(graph: Graph, at: Indices, pairs: Array) -> Weights:
    links = np.empty(graph.senders.size)
    links[at] = links[graph.reverse[at]] = pairs
    return Weights(graph, 1 - _row_sums(graph, links), links)


def _modes(graph: Graph, at: Indices, pairs: Array) -> tuple[Array, Array]:
    dense = _from_pairs(graph, at, pairs).matrix.toarray() - 1 / graph.size
    values, vectors = np.linalg.eigh(dense)
    return values, vectors


def _modulus(graph: Graph, at: Indices, pairs: Array) -> float:
    return float(np.abs(_modes(graph, at, pairs)[0]).max())


def _smoothed(pairs: Array, graph: Graph, at: Indices, mu: float) -> tuple[float, Array]:
    """The smoothed modulus and its gradient: a link's weight pulls both its ends together."""
    values, vectors = _modes(graph, at, pairs)
    top = np.abs(values).max()
    up, down = np.exp((values - top) / mu), np.exp((-values - top) / mu)
    total = up.sum() + down.sum()
    mean = (vectors * ((up - down) / total)) @ vectors.T
    i, j = graph.receivers[at], graph.senders[at]
    return float(top + mu * np.log(total)), 2 * mean[i, j] - mean[i, i] - mean[j, j]


def gossip(graph: Graph) -> Weights:
    """The mean of one meeting's averaging matrix in :func:`distfilt.network.gossip`.

    An agent wakes with probability 1 / A and meets one of its neighbours. The second largest
    eigenvalue bounds the factor by which the mean squared disagreement shrinks in each meeting.

    >>> from distfilt.network import graphs
    >>> gossip(graphs.path(2)).own
    array([0.5, 0.5])
    """
    _both_ways(graph)
    d = np.maximum(graph.degrees, 1)
    links = (1 / d[graph.receivers] + 1 / d[graph.senders]) / (2 * graph.size)
    return Weights(graph, 1 - _row_sums(graph, links), links)


def push(graph: Graph) -> Weights:
    """Each agent splits its value evenly between itself and its listeners: columns sum to one.

    An agent needs to know only how many hear it.

    >>> from distfilt.network import Graph
    >>> circle = Graph.from_edges(3, [(0, 2), (1, 0), (2, 1)], directed=True)
    >>> push(circle).own
    array([0.5, 0.5, 0.5])
    """
    instance(graph, "graph", Graph)
    share = 1 / (1 + graph.listeners)
    return Weights(graph, share, share[graph.senders])


def balanced(graph: Graph) -> Weights:
    r"""Weights of a strongly connected digraph whose rows and columns sum to one.

    Scaling agent i's links by the left null vector p of the Laplacian makes what it hears as heavy
    as what others make of it, :math:`\mathbf 1^\top\operatorname{diag}(\mathbf p)\mathbf L
    =\mathbf p^\top\mathbf L=\mathbf 0`. Averaging then keeps the average on a digraph too. The
    vector is global knowledge: agents compute it together once, or are told.

    >>> from distfilt.network import Graph
    >>> circle = Graph.from_edges(3, [(0, 2), (1, 0), (2, 1)], directed=True)
    >>> balanced(circle).matrix.toarray().sum(axis=0)
    array([1., 1., 1.])
    """
    _connected(graph)
    p = left_null_vector(graph.laplacian) if graph.directed else np.ones(graph.size)
    links = p[graph.receivers] / (2 * (p * graph.degrees).max())
    return Weights(graph, 1 - _row_sums(graph, links), links)


def keeping(weights: Weights) -> Weights:
    """The weights themselves, or a ValueError if their columns do not sum to one.

    >>> from distfilt.network import graphs
    >>> keeping(metropolis(graphs.path(3))).own.round(3)
    array([0.667, 0.333, 0.667])
    """
    if not isinstance(weights, Weights):
        raise ValueError(f"weights: needs Weights, got {type(weights).__name__}")
    # Not by the matrix: scipy's sums sort its entries in place, which changes how sums round.
    graph = weights.graph
    columns, sizes = (
        own + np.bincount(graph.senders, weights=links, minlength=graph.size)
        for own, links in (
            (weights.own, weights.links),
            (np.abs(weights.own), np.abs(weights.links)),
        )
    )
    # Rounding grows with the weights that cancel in a sum.
    off = np.abs(columns - 1) / np.maximum(1.0, sizes)
    worst = int(off.argmax())
    if off[worst] > 1e-9:
        raise ValueError(
            f"weights: needs columns that sum to 1 to keep the average, got {columns[worst]:.6g} "
            f"for agent {worst}"
        )
    return weights


def _row_sums(graph: Graph, links: Array) -> Array:
    return np.asarray(graph.incidence @ links)
