"""Consensus on the average or the maximum of the agents' values, and ADMM for a sum.

A consensus rule is a function ``(values, channel, *, …) -> values``.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Annotated

import numpy as np

from ..linalg import SolverError
from ..validation import (
    Array,
    ArrayInput,
    FrozenModel,
    Indices,
    PositiveFloat,
    PositiveInt,
    call_user,
    check_array,
    validated,
)
from .channel import Channel, LossRule, PerAgent, fusion_rule
from .graphs import Graph
from .weights import (
    ConsensusWeights,
    _check_keeps_average,
    _laplacian_weights,
    _warn_if_not_converging,
    _warn_if_unstable,
    metropolis,
)

__all__ = [
    "AdmmResult",
    "Disconnected",
    "admm",
    "average_consensus",
    "finite_time_consensus",
    "max_consensus",
    "push_sum",
]


class Disconnected(RuntimeWarning):
    """A network in several parts, each of which reaches a result of its own.

    >>> issubclass(Disconnected, RuntimeWarning)
    True
    """


def _warn_if_disconnected(channel: Channel, rounds: int | None = None) -> None:
    """Warn if messages cannot lead from every agent to every other, however many rounds.

    One round says nothing, as a graph that changes may be connected over time. Agents that
    are silent for a while may be heard later; those that are silent always have no links.
    Where a network may fall apart, as that of a swarm, the channel says so.
    """
    if rounds == 1 or channel.expects_parts:
        return
    graph = channel.graph
    silent = channel.faults.always_silent
    components = _components(graph, silent) if silent else graph.components
    count = int(components.max()) + 1
    if count > 1:
        because = f" with agents {sorted(silent)} silent" if silent else ""
        warnings.warn(
            "channel must have a connected graph to reach one average, "
            f"got {count} components{because}, each of which reaches its own",
            Disconnected,
            # Over the rule and its validation to the rule's caller.
            stacklevel=4,
        )


@lru_cache(maxsize=32)
def _components(graph: Graph, silent: frozenset[int]) -> Indices:
    """Return the strongly connected components that remain without some agents' links, (A,)."""
    off = np.isin(np.arange(graph.n_agents), list(silent))
    on_links = ~(off[graph.receivers] | off[graph.senders])
    pairs = np.stack([graph.receivers[on_links], graph.senders[on_links]], axis=1)
    return Graph.from_edges(graph.n_agents, pairs, directed=True).components


def _check_single_run(channel: Channel) -> None:
    if channel.runs:
        raise ValueError(f"channel must be a single run, got runs {channel.runs}")


def _check_faultless(channel: Channel) -> None:
    if not channel.faults.is_perfect:
        raise ValueError("channel must have no faults here, got a channel with faults")


@fusion_rule("vectors")
@validated
def average_consensus(
    values: PerAgent,
    channel: Channel,
    *,
    rounds: PositiveInt = 1,
    gain: PositiveFloat | None = None,
    weights: ConsensusWeights | None = None,
    on_loss: LossRule = "mutual",
) -> Array:
    r"""Average consensus: move each value towards its neighbours', as in (16) of Grange et al.

    .. math:: \mathbf x_i \leftarrow \mathbf x_i
        + \gamma\sum_{j\in\mathcal N_i}(\mathbf x_j-\mathbf x_i)

    Parameters
    ----------
    values : array_like, (*runs, A, k)
        One vector per agent.
    channel : Channel
        On a graph that is not connected each component reaches its own average.
    rounds : int
        Number of rounds. More than one on a graph of several components give a
        :class:`Disconnected` warning; one does not, as a graph that changes may be
        connected over time.
    gain : float, optional
        The gain γ, positive. The values converge to the average if and only if the
        graph is connected and γ < 2/λ_max of its Laplacian; above that an
        :class:`UnstableGain` warns.
    weights : ConsensusWeights, optional
        Weights in place of a gain; Metropolis by default. Their rows and columns must sum
        to one: those of symmetric weights do, and of
        :func:`distfilt.network.weights.doubly_stochastic` on a digraph. An
        :class:`UnstableGain` warns of weights that do not converge.
    on_loss : str
        Where the weight of a lost message goes: see :meth:`Channel.mix`.

    Examples
    --------
    >>> from distfilt.network import Channel, graphs
    >>> average_consensus(
    ...     [[0.0], [3.0], [-1.5]], Channel(graphs.star(3)), gain=0.5, rounds=40
    ... ).round(4)
    array([[0.5],
           [0.5],
           [0.5]])
    """
    graph = channel.graph
    if gain is not None and weights is not None:
        raise ValueError("gain must be None if weights are given, got both")
    if gain is not None:
        _warn_if_unstable(graph, gain)
        weights = _laplacian_weights(graph, gain)
    elif weights is None:
        weights = metropolis(graph)
    else:
        _warn_if_not_converging(weights, rounds)
    _check_keeps_average(weights)
    _warn_if_disconnected(channel, rounds)
    return channel.mix(values, weights, on_loss=on_loss, rounds=rounds)


@fusion_rule("vectors")
@validated
def finite_time_consensus(values: PerAgent, channel: Channel) -> Array:
    r"""Reach the exact average in as many rounds as the Laplacian has distinct nonzero eigenvalues.

    .. math:: \prod_{k}\Bigl(\mathbf I-\tfrac1{\lambda_k}\mathbf L\Bigr)\mathbf x
        = \bar x\,\mathbf 1

    Each factor removes one eigenspace and leaves the average alone.

    Parameters
    ----------
    values, channel
        As for :func:`average_consensus`. Connected, with links both ways, and without
        faults: one lost message spoils the product.

    Raises
    ------
    ValueError
        If rounding would spoil it too, as it does for many, unevenly spaced
        eigenvalues: of twenty agents with a hub, or of a hundred at random. Use
        :func:`average_consensus` there.

    Notes
    -----
    The factors are applied in Leja's order, large ones between small ones, which keeps
    rounding errors small on rings, paths and grids.

    Examples
    --------
    >>> from distfilt.network import Channel, graphs
    >>> channel = Channel(graphs.star(5))
    >>> finite_time_consensus(np.arange(5.0)[:, None], channel).ravel().round(12)
    array([2., 2., 2., 2., 2.])
    >>> channel.ledger.rounds
    2
    """
    graph = channel.graph
    graph._check_connected()
    _check_faultless(channel)
    mixed = values.copy()
    for eigenvalue in _order_eigenvalues(graph):
        # The factor I - L/λ is an averaging step with the gain 1/λ.
        mixed = channel.mix(mixed, _laplacian_weights(graph, 1 / eigenvalue))
    return np.asarray(mixed)


@lru_cache(maxsize=32)
def _order_eigenvalues(graph: Graph) -> list[float]:
    """Return the distinct nonzero eigenvalues in Leja's order, if rounding permits."""
    eigenvalues = _leja_order(_drop_repeated(graph.laplacian_spectrum[1:]))
    # Applied to I - 11ᵀ/A the product is zero, but for rounding.
    remainder = np.eye(graph.n_agents) - 1 / graph.n_agents
    for eigenvalue in eigenvalues:
        remainder -= graph.laplacian @ remainder / eigenvalue
    error = np.abs(remainder).max()
    if error > 1e-9:
        raise ValueError(
            "channel must have a graph whose Laplacian's eigenvalues permit an exact average in "
            f"floating point, got a rounding error of {error:.0e}: use average_consensus"
        )
    return eigenvalues


def _drop_repeated(ascending: Array) -> Array:
    """Return ascending values without those that repeat the one before up to rounding."""
    scale = max(1.0, float(ascending.max(initial=0)))
    is_new = np.diff(ascending, prepend=-np.inf) > 1e-9 * scale
    return ascending[is_new]


def _leja_order(ascending: Array) -> list[float]:
    """Return ascending points in an order in which partial products of their factors stay small.

    The first is the largest; each next one is farthest, in the geometric mean, from all
    before it.
    """
    log_distance = np.zeros(ascending.size)
    order = [float(p) for p in ascending[-1:]]
    while len(order) < ascending.size:
        # Points that are in the order already have the logarithm of zero.
        with np.errstate(divide="ignore"):
            log_distance += np.log(np.abs(ascending - order[-1]))
        order.append(float(ascending[log_distance.argmax()]))
    return order


@fusion_rule("vectors")
@validated
def push_sum(values: PerAgent, channel: Channel, *, rounds: PositiveInt) -> Array:
    r"""Average on any strongly connected digraph, despite lost messages, without acknowledgements.

    Each agent pushes equal parts of its value and of a weight that started at one; the
    ratio of the two tends to the average. On each link it sends the *running sum* of
    all that it has pushed there. The receiver takes the increase since the last sum
    that arrived, so that a lost message is made good by the next.

    Parameters
    ----------
    values, channel
        As for :func:`average_consensus`. Strongly connected; messages may be lost.
    rounds : int
        Number of rounds, with k + 1 scalars a link each.

    Returns
    -------
    ndarray, (*runs, A, k)
        The ratios.

    Notes
    -----
    D. Kempe, A. Dobra and J. Gehrke, Foundations of Computer Science (2003) 482-491;
    running sums: N. H. Vaidya, C. N. Hadjicostis and A. D. Dominguez-Garcia (2011).

    Examples
    --------
    >>> from distfilt.network import Channel, Graph
    >>> circle = Graph.from_edges(3, [(0, 2), (1, 0), (2, 1)], directed=True)
    >>> push_sum([[0.0], [3.0], [6.0]], Channel(circle), rounds=80).ravel().round(9)
    array([3., 3., 3.])
    """
    graph = channel.graph
    graph._check_connected()
    # Value and weight of each agent, which move together.
    ones = np.ones((*values.shape[:-1], 1))
    mass = np.concatenate([values, ones], axis=-1)
    # Equal parts for the agent itself and for each of its receivers.
    part = 1 / (1 + graph.out_degree)[:, None]
    pushed = np.zeros_like(mass)
    # The last running sum that arrived on each link.
    received = np.zeros((*channel.runs, graph.senders.size, mass.shape[-1]))
    for _ in range(rounds):
        pushed = pushed + part * mass
        arrived = channel.send_on_links(
            pushed[..., graph.senders, :], is_broadcast=True
        )
        # Where a message is lost the last sum stays, and the next one brings both
        # increases.
        latest = np.where(np.isnan(arrived), received, arrived)
        mass = part * mass + graph._sum_by_receiver(latest - received)
        received = latest
    # The ratio of value and weight is the estimate of the average.
    return np.asarray(mass[..., :-1] / mass[..., -1:])


@fusion_rule("vectors")
@validated
def max_consensus(
    values: PerAgent, channel: Channel, *, rounds: PositiveInt | None = None
) -> Array:
    """Reach the largest value, component by component, in as many rounds as the diameter.

    Parameters
    ----------
    values, channel
        As for :func:`average_consensus`. Connected; a lost message only costs time.
    rounds : int, optional
        By default the graph's diameter.

    Examples
    --------
    >>> from distfilt.network import Channel, graphs
    >>> max_consensus([[1.0], [5.0], [2.0]], Channel(graphs.path(3))).ravel()
    array([5., 5., 5.])
    """
    graph = channel.graph
    graph._check_connected()
    largest = values.copy()
    if graph.n_agents == 1:
        return np.asarray(largest)
    # Links are ordered by receiver, and each agent of a connected graph has one or
    # more.
    row_starts = graph.links.indptr[:-1]
    for _ in range(rounds or graph.diameter):
        arrived = channel.send_on_links(
            largest[..., graph.senders, :], is_broadcast=True
        )
        # fmax passes over NaN, a lost message.
        received = np.fmax.reduceat(arrived, row_starts, axis=-2)
        largest = np.fmax(largest, received)
    return np.asarray(largest)


@dataclass(frozen=True, eq=False)
class AdmmResult(FrozenModel):
    """Result of consensus ADMM.

    Parameters
    ----------
    common : ndarray, (A, k)
        Each agent's copy of the common variable Z.
    iterations : int
        Number of iterations.
    primal, dual : float
        The last residuals, over all agents: the largest difference of local and common
        variable, and ρ times the largest change of the common variable.

    Examples
    --------
    >>> AdmmResult(np.zeros((2, 1)), 3, 1e-9, 1e-9).iterations
    3
    """

    common: Array
    iterations: int
    primal: float
    dual: float


@validated
def admm(
    local_solve: Callable[[Array, float], Array],
    start: Annotated[ArrayInput, "channel.graph.n_agents k"],
    channel: Channel,
    *,
    rho: PositiveFloat = 1.0,
    tolerance: PositiveFloat = 1e-6,
    iterations: PositiveInt = 1000,
    average: Callable[[Array, Channel], Array] = finite_time_consensus,
) -> AdmmResult:
    r"""Minimise :math:`\sum_l f_l(\mathbf Z)` where only agent l knows :math:`f_l`.

    .. math::
        \mathbf U_l &\leftarrow \arg\min_{\mathbf U} f_l(\mathbf U)
        + \tfrac\rho2\|\mathbf U-(\mathbf Z-\mathbf W_l)\|^2,\\
        \mathbf Z &\leftarrow\tfrac1A\textstyle\sum_l(\mathbf U_l+\mathbf W_l),\\
        \mathbf W_l &\leftarrow\mathbf W_l+\mathbf U_l-\mathbf Z

    Parameters
    ----------
    local_solve : callable
        ``local_solve(target, rho) -> U`` on (A, k): the proximal step of every agent
        for its objective at its row of `target` = Z - W.
    start : array_like, (A, k)
        Each agent's first Z.
    channel : Channel
        A single run, connected, without faults. After every iteration the agents agree
        on their largest residuals, so that all stop at once: :func:`max_consensus` of 2
        scalars, as many rounds as the diameter, charged like everything else.
    rho : float
        Penalty, positive.
    tolerance : float
        Stop when both residuals, of every agent, are below it.
    iterations : int
        At most this many.
    average : callable
        ``average(values, channel) -> values``: a consensus rule for the average. With a
        rule that is only approximate the agents' copies of Z differ.

    Raises
    ------
    SolverError
        If the residuals are not below `tolerance` after `iterations`; the message has
        them.

    Notes
    -----
    S. Boyd et al., Foundations and Trends in Machine Learning 3 (2010) 1-122, section
    7.1; proposed for (22) of Grange et al.

    Examples
    --------
    The average of private numbers, each the minimiser of its agent's
    :math:`(u-c_l)^2/2`:

    >>> from distfilt.network import Channel, graphs
    >>> c = np.array([[1.0], [2.0], [6.0]])
    >>> def local_solve(target, rho):
    ...     return (c + rho * target) / (1 + rho)
    >>> result = admm(local_solve, np.zeros((3, 1)), Channel(graphs.path(3)))
    >>> result.common.round(5).ravel()
    array([3., 3., 3.])
    """
    _check_single_run(channel)
    # With losses agents could stop at different iterations.
    _check_faultless(channel)
    z = start
    w = np.zeros_like(start)
    for iteration in range(1, iterations + 1):
        u = check_array(call_user(local_solve, z - w, rho), "local_solve", z.shape)
        new = check_array(call_user(average, u + w, channel), "average", z.shape)
        # W is the scaled dual variable.
        w = w + u - new
        # Each agent's primal residual |U - Z| and dual residual ρ |Z - Z before|.
        local = np.abs(u - new).max(axis=1)
        change = rho * np.abs(new - z).max(axis=1)
        residuals = np.stack([local, change], axis=1)
        z = new
        # After the maximum all agents hold the same two numbers; any row will do.
        primal, dual = max_consensus(residuals, channel)[0].tolist()
        if primal < tolerance and dual < tolerance:
            return AdmmResult.construct(z, iteration, primal, dual)
    raise SolverError(
        f"iterations must be more for residuals below {tolerance:g}, "
        f"got {primal:.3g} and {dual:.3g} after {iterations} iterations"
    )
