"""Consensus weights: of an agent's own value and of each value that it receives."""

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


_MAX_DENSE_AGENTS = 400
"""Up to this many agents, weights are checked by the eigenvalues of their dense matrix."""

_POWER_ROUNDS = 100
"""For more agents: rounds of the power method before growth is measured, and while it is."""


class UnstableGain(RuntimeWarning):
    """A gain above 2/λ_max, or weights, with which averaging does not converge.

    Turn it into an error, or off, by ``warnings.filterwarnings("error",
    category=UnstableGain)``.

    >>> issubclass(UnstableGain, RuntimeWarning)
    True
    """


@dataclass(frozen=True, eq=False)
class ConsensusWeights(FrozenModel):
    """Weights of a linear consensus step: one for each agent's own value, one for each link.

    Parameters
    ----------
    graph : Graph
        The links.
    self_weights : ndarray, (A,)
        Weight of each agent's own value.
    link_weights : ndarray, (E,)
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
    self_weights: Annotated[Array, "graph.n_agents"]
    link_weights: Annotated[Array, "graph.senders.size"]

    @cached_property
    def matrix(self) -> scipy.sparse.csr_array:
        """The matrix W of x <- W x, (A, A), each row's diagonal entry stored first."""
        return stack_weights(
            self.graph, self.self_weights[None], self.link_weights[None]
        )

    @cached_property
    def convergence_factor(self) -> float:
        r"""The factor by which a round shrinks the slowest mode of differences.

        The largest modulus of the eigenvalues of
        :math:`\mathbf W-\mathbf 1\mathbf 1^\top\!/A`. Weights whose rows and columns sum to one
        lead every agent to the average if and only if it is below 1. A dense solver finds it,
        for up to some thousand agents.

        >>> from distfilt.network import graphs
        >>> round(metropolis(graphs.path(3)).convergence_factor, 4)
        0.6667
        """
        deviation = self.matrix.toarray() - 1 / self.graph.n_agents
        if (deviation == deviation.T).all():
            eigenvalues = np.linalg.eigvalsh(deviation)
        else:
            eigenvalues = np.linalg.eigvals(deviation)
        return float(np.abs(eigenvalues).max())


def stack_weights(
    graph: Graph, self_weights: Array, link_weights: Array, *, received_offset: int = 0
) -> scipy.sparse.csr_array:
    """Return the matrices of R runs as one block-diagonal matrix, in each row the diagonal first.

    One sparse product then mixes the values of all runs.

    Parameters
    ----------
    graph : Graph
    self_weights, link_weights : ndarray, (R, A) and (R, E)
    received_offset : int
        The matrix multiplies a column of all runs' values, one run below the other. With 0 an
        agent receives its neighbours' values from there. Other values to receive, such as delayed
        ones, are appended to the column; they begin this many rows further down.
    """
    data = interleave_weights(graph, self_weights, link_weights)
    n_runs, n_agents = self_weights.shape
    run = np.arange(n_runs)[:, None]
    # The columns of the entries: agent i of run r has row and column i + A r.
    diagonal = np.arange(n_agents) + n_agents * run
    received = graph.senders + n_agents * run + received_offset
    # The diagonal entry comes before the links of its row, which begin at indptr[i].
    columns = np.insert(received, graph.links.indptr[:-1], diagonal, axis=1)
    # Each row has one entry more than links, the diagonal's; the runs' rows follow each other.
    row_ends = graph.links.indptr[1:] + np.arange(1, n_agents + 1)
    row_ends = row_ends + data.shape[1] * run
    pointers = np.concatenate([[0], row_ends.ravel()])
    shape = (n_runs * n_agents, n_runs * n_agents + received_offset)
    return scipy.sparse.csr_array((data.ravel(), columns.ravel(), pointers), shape)


def interleave_weights(graph: Graph, self_weights: Array, link_weights: Array) -> Array:
    """Return the entries of a matrix of weights in their order, (R, A + E).

    Every row has the diagonal entry first, then those of the links, ascending by sender. A
    product adds in this order, so that it equals a loop over the messages to the last bit.
    """
    n_agents = graph.n_agents
    # Row i begins behind the indptr[i] links and the i diagonal entries of the rows above it, with
    # its diagonal entry. Link e, of row i, comes behind e links and i + 1 diagonal entries.
    diagonal = graph.links.indptr[:-1] + np.arange(n_agents)
    entries = np.empty((len(self_weights), n_agents + graph.senders.size))
    entries[:, diagonal] = self_weights
    entries[:, np.arange(graph.senders.size) + graph.receivers + 1] = link_weights
    return entries


def _check_same_links(weights: ConsensusWeights, graph: Graph) -> None:
    """Refuse weights of another graph's links."""
    # Two sparse matrices (A, A) have the same entries if their row starts and columns are equal.
    links = graph.links
    of_weights = weights.graph.links
    if np.array_equal(links.indptr, of_weights.indptr) and np.array_equal(
        links.indices, of_weights.indices
    ):
        return
    raise ValueError(
        "weights must be weights of the channel's graph, got those of other links"
    )


def _add_self_weights(graph: Graph, link_weights: Array) -> ConsensusWeights:
    """Return weights of link weights (E,) and of self-weights that make each row sum to one."""
    self_weights = 1 - np.asarray(graph.incidence @ link_weights)
    return ConsensusWeights.construct(graph, self_weights, link_weights)


@validated
def metropolis(graph: Graph) -> ConsensusWeights:
    r"""Metropolis weights :math:`w_{ij}=1/(1+\max(d_i,d_j))`: symmetric, rows sum to one.

    Each agent needs only its neighbours' degrees. An agent without neighbours keeps its
    value.

    Notes
    -----
    L. Xiao, S. Boyd and S. Lall, Information Processing in Sensor Networks (2005)
    63-70.

    Examples
    --------
    >>> from distfilt.network import graphs
    >>> metropolis(graphs.star(3)).self_weights.round(3)
    array([0.333, 0.667, 0.667])
    """
    graph._check_undirected()
    degree = graph.in_degree
    larger = np.maximum(degree[graph.receivers], degree[graph.senders])
    # With self-weights that make each row sum to one
    return _add_self_weights(graph, 1 / (1 + larger))


def _laplacian_weights(graph: Graph, gain: float) -> ConsensusWeights:
    """Return the weights of one averaging step, I - gain L."""
    self_weights = 1 - gain * graph.in_degree
    link_weights = np.full(graph.senders.size, gain)
    return ConsensusWeights.construct(graph, self_weights, link_weights)


def _warn_if_unstable(graph: Graph, gain: float) -> None:
    """Warn the user of a gain at which averaging on the graph diverges.

    Most gains are below a bound from the degrees. Only above it eigenvalues are
    computed, once for a graph.
    """
    # The cheap sufficient condition first.
    if gain <= graph.degree_bound_gain:
        return
    limit = graph.max_stable_gain
    # An eigenvalue solver's error is far below 1e-9: a gain of exactly 2/λ_max gives no warning.
    if gain > limit * (1 + 1e-9):
        warnings.warn(
            f"gain must be at most 2/λ_max = {limit:.6g} of this graph for the agents to agree, "
            f"got {gain:.6g}",
            UnstableGain,
            # The warning points at the call of the consensus rule: above this function are
            # the rule, its validation, and then the caller.
            stacklevel=4,
        )


@validated
def best_constant_edge(graph: Graph) -> ConsensusWeights:
    r"""Return the best weights that are equal on all links, :math:`2/(\lambda_2+\lambda_{\max})`.

    The slowest and the fastest mode then shrink by the same factor,
    :math:`(\lambda_{\max}-\lambda_2)/(\lambda_{\max}+\lambda_2)` a round. Both eigenvalues are
    global knowledge.

    Notes
    -----
    L. Xiao and S. Boyd, Systems & Control Letters 53 (2004) 65-78, section 4.1.

    Examples
    --------
    >>> from distfilt.network import graphs
    >>> float(best_constant_edge(graphs.star(3)).link_weights[0])
    0.5
    """
    graph._check_connected()
    if graph.n_agents == 1:
        # Without links any gain will do.
        return _laplacian_weights(graph, gain=0.0)
    # 1 - γ λ_2 = -(1 - γ λ_max): both ends of the spectrum have the same modulus.
    eigenvalues = graph.laplacian_spectrum
    gain = 2 / float(eigenvalues[1] + eigenvalues[-1])
    return _laplacian_weights(graph, gain)


@validated
def fastest_mixing(graph: Graph) -> ConsensusWeights:
    r"""Return symmetric weights with the (nearly) smallest second largest eigenvalue modulus.

    Fastest linear averaging on the graph: a convex problem, here smoothed by
    :math:`\mu\log\sum_k(e^{\lambda_k/\mu}+e^{-\lambda_k/\mu})` of the eigenvalues of
    :math:`\mathbf W-\mathbf 1\mathbf 1^\top\!/A` and solved by a quasi-Newton method for smaller
    and smaller μ. Some weights may be negative. The matrices are dense: for up to a few
    hundred agents, and somebody has to know the whole graph.

    Parameters
    ----------
    graph : Graph
        Connected, links both ways.

    Notes
    -----
    L. Xiao and S. Boyd, Systems & Control Letters 53 (2004) 65-78.

    Examples
    --------
    A bridge between two groups is the bottleneck and gets a larger weight:

    >>> from distfilt.network import Graph
    >>> edges = [(0, 1), (0, 2), (1, 2), (2, 3), (3, 4), (3, 5), (4, 5)]
    >>> pair = Graph.from_edges(6, edges)
    >>> w = fastest_mixing(pair).matrix.toarray()
    >>> bool(w[2, 3] > 1.4 * w[0, 2])
    True
    """
    from scipy.optimize import minimize

    start = best_constant_edge(graph)
    # One variable for each pair of opposite links.
    forward = np.flatnonzero(graph.receivers < graph.senders)
    # A single link leaves nothing to balance.
    if forward.size < 2:
        return start
    solutions = [start.link_weights[forward]]
    # Each solution starts the next, less smooth problem. The smooth function exceeds the largest
    # modulus by at most μ log 2A, which the last μ makes less than 1e-3.
    for mu in (1e-1, 1e-2, 1e-3, 1e-4):
        # `jac=True`: the function returns its gradient too.
        solution = minimize(
            _smooth_modulus,
            solutions[-1],
            (graph, forward, mu),
            method="L-BFGS-B",
            jac=True,
            options={"maxiter": 200},
        )
        solutions.append(solution.x)

    def second_modulus(pair_weights: Array) -> float:
        eigenvalues, _vectors = _decompose(graph, forward, pair_weights)
        return float(np.abs(eigenvalues).max())

    # The last need not be the best, where rounding stops the optimiser early.
    return _symmetric_weights(graph, forward, min(solutions, key=second_modulus))


def _symmetric_weights(
    graph: Graph, forward: Indices, pair_weights: Array
) -> ConsensusWeights:
    """Return weights that are equal on opposite links.

    `forward` are one link of each pair of opposite ones, `pair_weights` the weights of the pairs.
    """
    link_weights = np.empty(graph.senders.size)
    link_weights[forward] = pair_weights
    link_weights[graph.reverse[forward]] = pair_weights
    # With self-weights that make each row sum to one
    return _add_self_weights(graph, link_weights)


def _decompose(
    graph: Graph, forward: Indices, pair_weights: Array
) -> tuple[Array, Array]:
    """Return eigenvalues and eigenvectors of W - 11ᵀ/A, which has no eigenvalue of the average.

    `forward` are the links of which one of each pair of opposite ones is taken, `pair_weights` the
    weights of these pairs.
    """
    weights = _symmetric_weights(graph, forward, pair_weights)
    return np.linalg.eigh(weights.matrix.toarray() - 1 / graph.n_agents)


def _smooth_modulus(
    pair_weights: Array, graph: Graph, forward: Indices, mu: float
) -> tuple[float, Array]:
    """Return the smoothed largest modulus of the eigenvalues, and its gradient.

    The arguments are those of :func:`_decompose`; μ is the width of the smoothing.
    """
    values, vectors = _decompose(graph, forward, pair_weights)
    # μ log Σ_k (exp(λ_k/μ) + exp(-λ_k/μ)), scaled by the largest term.
    largest = np.abs(values).max()
    positive = np.exp((values - largest) / mu)
    negative = np.exp((-values - largest) / mu)
    total = positive.sum() + negative.sum()
    modulus = float(largest + mu * np.log(total))
    # The derivative in the matrix is G = Σ_k g_k v_k v_kᵀ, with g_k that in the eigenvalue λ_k.
    derivative = (vectors * ((positive - negative) / total)) @ vectors.T
    # The weight of a pair (i, j) enters W as -(e_i - e_j)(e_i - e_j)ᵀ.
    i = graph.receivers[forward]
    j = graph.senders[forward]
    gradient = 2 * derivative[i, j] - derivative[i, i] - derivative[j, j]
    return modulus, gradient


@validated
def expected_gossip(graph: Graph) -> ConsensusWeights:
    """Return the expected weights of one round of :func:`distfilt.network.gossip_consensus`.

    An agent wakes with probability 1 / A and averages with one of its neighbours. The
    second largest eigenvalue bounds the factor by which the mean squared disagreement
    shrinks in a round.

    >>> from distfilt.network import graphs
    >>> expected_gossip(graphs.path(2)).self_weights
    array([0.5, 0.5])
    """
    graph._check_undirected()
    # Agent i wakes and chooses j, or j wakes and chooses i. Both then take their mean: each moves
    # by half of the difference.
    degree = np.maximum(graph.in_degree, 1)
    either = 1 / degree[graph.receivers] + 1 / degree[graph.senders]
    return _add_self_weights(graph, either / (2 * graph.n_agents))


@validated
def column_stochastic(graph: Graph) -> ConsensusWeights:
    """Return weights with which each agent splits its value evenly: columns sum to one.

    The parts go to itself and to all that receive from it. An agent needs to know only
    its out-degree.

    >>> from distfilt.network import Graph
    >>> circle = Graph.from_edges(3, [(0, 2), (1, 0), (2, 1)], directed=True)
    >>> column_stochastic(circle).self_weights
    array([0.5, 0.5, 0.5])
    """
    # A sender's part is the same on all its links.
    part = 1 / (1 + graph.out_degree)
    return ConsensusWeights.construct(graph, part, part[graph.senders])


@validated
def doubly_stochastic(graph: Graph) -> ConsensusWeights:
    r"""Return weights of a strongly connected digraph whose rows and columns sum to one.

    The links of agent i are scaled by entry i of the left null vector p of the
    Laplacian. The columns of the scaled Laplacian then sum to zero as well,
    :math:`\mathbf 1^\top\operatorname{diag}(\mathbf p)\mathbf L=\mathbf p^\top\mathbf L
    =\mathbf 0`, so that averaging keeps the average on a digraph too. The vector
    depends on the whole graph: agents compute it together once, or it is given to them.

    >>> from distfilt.network import Graph
    >>> circle = Graph.from_edges(3, [(0, 2), (1, 0), (2, 1)], directed=True)
    >>> doubly_stochastic(circle).matrix.toarray().sum(axis=0)
    array([1., 1., 1.])
    """
    graph._check_connected()
    # The vector p with pᵀ L = 0
    if graph.is_directed:
        p = _left_null_vector(graph.laplacian)
    else:
        p = np.ones(graph.n_agents)
    # With self-weights that make each row sum to one. With this scale the smallest of them is 1/2,
    # that of the largest scaled degree.
    link_weights = p[graph.receivers] / (2 * (p * graph.in_degree).max())
    return _add_self_weights(graph, link_weights)


def _left_null_vector(laplacian: scipy.sparse.csr_array) -> Array:
    """Return the positive p with pᵀ L = 0 of a strongly connected graph, largest entry 1.

    The Laplacian L is (A, A), and p is (A,).
    """
    from scipy.sparse.linalg import splu

    # With p_0 = 1, the other rows of Lᵀ p = 0 are a system whose matrix is an M-matrix: its LU
    # factorisation is stable without pivoting.
    transposed = laplacian.T.tocsc()
    matrix = transposed[1:, 1:]
    right = -transposed[1:, [0]].toarray().ravel()
    # An order of columns for symmetric patterns, and the diagonal as pivots
    factor = splu(
        matrix,
        permc_spec="MMD_AT_PLUS_A",
        diag_pivot_thresh=0.0,
        options={"SymmetricMode": True},
    )
    others = factor.solve(right)
    # One step of iterative refinement, for long rings.
    others += factor.solve(right - matrix @ others)
    # All entries are positive (Perron and Frobenius); rounding may leave a tiny negative one.
    p = np.abs(np.concatenate([[1.0], others]))
    return np.asarray(p / p.max())


def _check_keeps_average(weights: ConsensusWeights) -> None:
    """Refuse weights of which a column or a row does not sum to one."""
    graph = weights.graph
    # Not by sums of the matrix: scipy sorts its entries in place for them, and later products
    # would round in another order.
    _check_sums_to_one(weights, graph.senders, "columns", "keep the average")
    _check_sums_to_one(
        weights,
        graph.receivers,
        "rows",
        "keep agents that agree as they are (those of column_stochastic are for push_sum)",
    )


def _warn_if_not_converging(weights: ConsensusWeights, rounds: int) -> None:
    """Warn the user of weights with which the agents' differences grow, or do not shrink."""
    graph = weights.graph
    # With positive weights averaging converges.
    if _has_positive_weights(weights):
        return
    # The factor by which a round multiplies the slowest mode of differences.
    if graph.n_agents <= _MAX_DENSE_AGENTS:
        factor = weights.convergence_factor
    elif _is_periodic(weights):
        factor = 1.0
    else:
        factor = _measure_growth(weights)
    # Margins for rounding: a factor of 1 does not diverge, and one just below it does not stall.
    diverges = factor > 1 + 1e-9
    # A factor of 1 is no mistake in a single round, since the weights of the next round may be
    # others. Nor is it one on a graph of several components, which never agree: the warning for
    # that is Disconnected.
    stalls = rounds > 1 and graph.is_connected and factor > 1 - 1e-12
    if diverges or stalls:
        warnings.warn(
            "weights must have eigenvalues below 1 in modulus, but for the average's, for the "
            f"agents to agree, got {factor:.6g}",
            UnstableGain,
            # The warning points at the call of the rule, as in _warn_if_unstable.
            stacklevel=4,
        )


def _is_periodic(weights: ConsensusWeights) -> bool:
    """Whether nonnegative weights keep groups of agents apart, so that they never agree.

    Two rounds are one step with W². If its graph is not strongly connected, some differences
    remain: where all agents swap their values with a neighbour, W has the eigenvalue -1; where a
    bridge has a weight of zero, it has the eigenvalue 1 twice.
    """
    if (weights.self_weights < 0).any() or (weights.link_weights < 0).any():
        return False
    # Entries that are zero are no links.
    twice = weights.matrix @ weights.matrix
    twice.eliminate_zeros()
    n_components, _labels = scipy.sparse.csgraph.connected_components(
        twice, connection="strong"
    )
    return int(n_components) > 1


def _measure_growth(weights: ConsensusWeights) -> float:
    """Return the factor by which differences grow in a round after many rounds: power method.

    It tends to the largest modulus of the eigenvalues of W, that of the average left out.
    """
    # A random start has a part of every mode; a fixed seed makes the result repeatable.
    x = np.random.default_rng(0).standard_normal(weights.graph.n_agents)
    sizes = []
    for _ in range(2):
        for _ in range(_POWER_ROUNDS):
            x = weights.matrix @ x
            # Only the differences from the average.
            x = x - x.mean()
        sizes.append(float(np.linalg.norm(x)))
        # Scaled to length one, as it may have become very large or very small; zero stays zero.
        x = x / max(sizes[-1], 1e-300)
    # The second size is the growth over _POWER_ROUNDS rounds from a length of one.
    return float(sizes[-1] ** (1 / _POWER_ROUNDS))


def _check_sums_to_one(
    weights: ConsensusWeights, agents: Indices, name: str, purpose: str
) -> None:
    """Refuse weights of which a row or a column does not sum to one.

    Parameters
    ----------
    weights : ConsensusWeights
    agents : ndarray of int, (E,)
        The agent in whose sum each link's weight is: its receiver for rows, its sender for columns.
    name, purpose : str
        Rows or columns, and the purpose of sums of one, for the error.
    """
    n_agents = weights.graph.n_agents
    link_weights = weights.link_weights
    sums = weights.self_weights + np.bincount(agents, link_weights, n_agents)
    # Rounding grows with the weights that cancel in a sum; 1e-9 of them is far more than it, and
    # far less than a mistake.
    scale = np.abs(weights.self_weights)
    scale = scale + np.bincount(agents, np.abs(link_weights), n_agents)
    error = np.abs(sums - 1) / np.maximum(1.0, scale)
    worst = int(error.argmax())
    if error[worst] > 1e-9:
        # A small error is shown by its size: six digits of the sum would read 1.
        got = f"{sums[worst]:.6g}"
        if error[worst] < 1e-6:
            got = f"one that is {error[worst]:.1e} off, as after single precision,"
        raise ValueError(
            f"weights must have {name} that sum to 1 to {purpose}, got {got} for agent {worst}"
        )


def _has_positive_weights(weights: ConsensusWeights) -> bool:
    """Whether all weights are positive, so that averaging converges on a connected graph.

    By the theorem of Perron and Frobenius: a nonnegative matrix whose rows sum to one and whose
    diagonal is positive has no other eigenvalue of modulus 1 than 1 itself. That one is simple if
    every link of the connected graph has a positive weight.
    """
    return bool((weights.self_weights > 0).all() and (weights.link_weights > 0).all())
