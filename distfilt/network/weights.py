"""Weights for combining values: what an agent makes of its own and of each that it hears."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated

import numpy as np
import scipy

from ..validation import Array, FrozenModel, Indices, validated
from .graphs import Graph

__all__ = [
    "UnstableGain",
    "ConsensusWeights",
    "doubly_stochastic",
    "best_constant_edge",
    "fastest_mixing",
    "expected_gossip",
    "metropolis",
    "column_stochastic",
]


class UnstableGain(RuntimeWarning):
    """A gain above 2/λ_max: what the agents exchange drives them apart instead of together.

    Turn it into an error, or off, by ``warnings.filterwarnings("error", category=UnstableGain)``.

    >>> issubclass(UnstableGain, RuntimeWarning)
    True
    """


@dataclass(frozen=True, eq=False)
class ConsensusWeights(FrozenModel):
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
    own: Annotated[Array, "graph.n_agents"]
    links: Annotated[Array, "graph.senders.size"]

    @cached_property
    def matrix(self) -> scipy.sparse.csr_array:
        """The matrix W of x <- W x, (A, A), each row's own entry stored first."""
        return stack_weights(self.graph, self.own[None], self.links[None], heard_at=0)


def stack_weights(
    graph: Graph, own: Array, links: Array, *, heard_at: int
) -> scipy.sparse.csr_array:
    """Matrices of R runs as one block-diagonal matrix, each row's own entry first.

    `own` is (R, A) and `links` (R, E). With `heard_at` = 0 both multiply the same stacked values;
    otherwise what is heard stands `heard_at` rows further on.
    """
    (runs, size) = own.shape
    at = graph.links.indptr[:-1]
    run = np.arange(runs)[:, None]
    data = np.insert(links, at, own, axis=1)
    heard = graph.senders + size * run + heard_at
    columns = np.insert(heard, at, np.arange(size) + size * run, axis=1)
    ends = graph.links.indptr[1:] + np.arange(1, size + 1) + data.shape[1] * run
    pointers = np.concatenate([[0], ends.ravel()])
    shape = (runs * size, runs * size + heard_at)
    return scipy.sparse.csr_array((data.ravel(), columns.ravel(), pointers), shape)


def _matching(graph: Graph, weights: ConsensusWeights) -> ConsensusWeights:
    """The weights themselves, or a ValueError if they are those of other links."""
    ours = graph.links
    theirs = weights.graph.links
    same = np.array_equal(ours.indptr, theirs.indptr)
    if not (same and np.array_equal(ours.indices, theirs.indices)):
        raise ValueError(
            "weights must be weights of the channel's graph, got those of other links"
        )
    return weights


def _by_links(graph: Graph, links: Array) -> ConsensusWeights:
    """Weights of links, and what is left of one for the own value."""
    return ConsensusWeights.construct(
        graph, 1 - np.asarray(graph.incidence @ links), links
    )


@validated
def metropolis(graph: Graph) -> ConsensusWeights:
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
    graph._undirected()
    d = graph.in_degree
    links = 1 / (1 + np.maximum(d[graph.receivers], d[graph.senders]))
    return _by_links(graph, links)


def _laplacian(graph: Graph, gain: float) -> ConsensusWeights:
    """The weights of one averaging step, I - gain L."""
    own = 1 - gain * graph.in_degree
    return ConsensusWeights.construct(graph, own, np.full(graph.senders.size, gain))


def _warn_if_unstable(graph: Graph, gain: float) -> None:
    """Warn the caller's caller of a gain at which averaging on the graph diverges.

    A bound from the degrees clears most gains; eigenvalues are computed, once for a graph, only
    beyond it.
    """
    if gain <= graph.degree_bound_gain:
        return
    limit = graph.max_stable_gain
    if gain > limit * (1 + 1e-9):
        warnings.warn(
            f"gain: {gain:.6g} is above 2/λ_max = {limit:.6g} of this graph, so the agents drift "
            f"apart",
            UnstableGain,
            stacklevel=4,  # the rule, its door, its caller
        )


@validated
def best_constant_edge(graph: Graph) -> ConsensusWeights:
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
    >>> float(best_constant_edge(graphs.star(3)).links[0])
    0.5
    """
    graph._joined()
    if graph.n_agents == 1:
        return _laplacian(graph, 0.0)
    return _laplacian(
        graph, 2 / float(graph.laplacian_spectrum[1] + graph.laplacian_spectrum[-1])
    )


@validated
def fastest_mixing(graph: Graph) -> ConsensusWeights:
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

    Notes
    -----
    L. Xiao and S. Boyd, Systems & Control Letters 53 (2004) 65-78.

    Examples
    --------
    A bridge between two groups is the bottleneck, and gets more than its share:

    >>> from distfilt.network import Graph
    >>> edges = [(0, 1), (0, 2), (1, 2), (2, 3), (3, 4), (3, 5), (4, 5)]
    >>> pair = Graph.from_edges(6, edges)
    >>> w = fastest_mixing(pair).matrix.toarray()
    >>> bool(w[2, 3] > 1.4 * w[0, 2])
    True
    """
    from scipy.optimize import minimize

    start = best_constant_edge(graph)
    at = np.flatnonzero(graph.receivers < graph.senders)
    if at.size < 2:
        return start
    found = [start.links[at]]
    for mu in (1e-1, 1e-2, 1e-3, 1e-4):
        how = {"method": "L-BFGS-B", "jac": True, "options": {"maxiter": 200}}
        found.append(minimize(_smoothed, found[-1], (graph, at, mu), **how).x)
    return _from_pairs(
        graph, at, min(found, key=lambda x: np.abs(_modes(graph, at, x)[0]).max())
    )


def _from_pairs(graph: Graph, at: Indices, pairs: Array) -> ConsensusWeights:
    links = np.empty(graph.senders.size)
    links[at] = links[graph.reverse[at]] = pairs
    return _by_links(graph, links)


def _modes(graph: Graph, at: Indices, pairs: Array) -> tuple[Array, Array]:
    dense = _from_pairs(graph, at, pairs).matrix.toarray() - 1 / graph.n_agents
    return np.linalg.eigh(dense)


def _smoothed(
    pairs: Array, graph: Graph, at: Indices, mu: float
) -> tuple[float, Array]:
    """The smoothed modulus and its gradient: a link's weight pulls both its ends together."""
    values, vectors = _modes(graph, at, pairs)
    top = np.abs(values).max()
    up = np.exp((values - top) / mu)
    down = np.exp((-values - top) / mu)
    total = up.sum() + down.sum()
    mean = (vectors * ((up - down) / total)) @ vectors.T
    i = graph.receivers[at]
    j = graph.senders[at]
    return float(top + mu * np.log(total)), 2 * mean[i, j] - mean[i, i] - mean[j, j]


@validated
def expected_gossip(graph: Graph) -> ConsensusWeights:
    """The mean of one meeting's averaging matrix in :func:`distfilt.network.gossip`.

    An agent wakes with probability 1 / A and meets one of its neighbours. The second largest
    eigenvalue bounds the factor by which the mean squared disagreement shrinks in each meeting.

    >>> from distfilt.network import graphs
    >>> expected_gossip(graphs.path(2)).own
    array([0.5, 0.5])
    """
    graph._undirected()
    d = np.maximum(graph.in_degree, 1)
    links = (1 / d[graph.receivers] + 1 / d[graph.senders]) / (2 * graph.n_agents)
    return _by_links(graph, links)


@validated
def column_stochastic(graph: Graph) -> ConsensusWeights:
    """Each agent splits its value evenly between itself and its listeners: columns sum to one.

    An agent needs to know only how many hear it.

    >>> from distfilt.network import Graph
    >>> circle = Graph.from_edges(3, [(0, 2), (1, 0), (2, 1)], directed=True)
    >>> column_stochastic(circle).own
    array([0.5, 0.5, 0.5])
    """
    share = 1 / (1 + graph.out_degree)
    return ConsensusWeights.construct(graph, share, share[graph.senders])


@validated
def doubly_stochastic(graph: Graph) -> ConsensusWeights:
    r"""Weights of a strongly connected digraph whose rows and columns sum to one.

    Scaling agent i's links by the left null vector p of the Laplacian makes what it hears as heavy
    as what others make of it, :math:`\mathbf 1^\top\operatorname{diag}(\mathbf p)\mathbf L
    =\mathbf p^\top\mathbf L=\mathbf 0`. Averaging then keeps the average on a digraph too. The
    vector is global knowledge: agents compute it together once, or are told.

    >>> from distfilt.network import Graph
    >>> circle = Graph.from_edges(3, [(0, 2), (1, 0), (2, 1)], directed=True)
    >>> doubly_stochastic(circle).matrix.toarray().sum(axis=0)
    array([1., 1., 1.])
    """
    graph._joined()
    p = (
        _left_null_vector(graph.laplacian)
        if graph.directed
        else np.ones(graph.n_agents)
    )
    links = p[graph.receivers] / (2 * (p * graph.in_degree).max())
    return _by_links(graph, links)


def _left_null_vector(laplacian: scipy.sparse.csr_array) -> Array:
    """Positive p with p' L = 0 of a strongly connected graph, largest entry 1."""
    from scipy.sparse.linalg import splu

    # One entry is set; the rest solves an M-matrix, which needs no pivoting.
    turned = laplacian.T.tocsc()
    inner = turned[1:, 1:]
    right = -turned[1:, [0]].toarray().ravel()
    factor = splu(
        inner,
        permc_spec="MMD_AT_PLUS_A",
        diag_pivot_thresh=0.0,
        options={"SymmetricMode": True},
    )
    rest = factor.solve(right)
    rest += factor.solve(right - inner @ rest)
    p = np.abs(np.concatenate([[1.0], rest]))
    return np.asarray(p / p.max())


def _keeping(weights: ConsensusWeights) -> ConsensusWeights:
    """The weights themselves, or a ValueError if their columns do not sum to one."""
    graph = weights.graph
    own = weights.own
    links = weights.links
    # Not by the matrix: scipy's sums sort its entries in place, which changes how sums round.
    columns = own + np.bincount(graph.senders, links, graph.n_agents)
    # Rounding grows with the weights that cancel in a sum.
    size = np.abs(own) + np.bincount(graph.senders, np.abs(links), graph.n_agents)
    off = np.abs(columns - 1) / np.maximum(1.0, size)
    worst = int(off.argmax())
    if off[worst] <= 1e-9:
        return weights
    got = f"{columns[worst]:.6g} for agent {worst}"
    raise ValueError(
        f"weights must have columns that sum to 1 to keep the average, got {got}"
    )
