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

from ..linalg import EPS, SolverError
from ..validation import (
    Array,
    ArrayInput,
    FrozenModel,
    Indices,
    Mask,
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
    # Agents that are always silent have no links.
    silent = channel.faults.always_silent
    components = _find_components(graph, silent) if silent else graph.components
    count = int(components.max()) + 1
    if count > 1:
        because = f" with agents {sorted(silent)} silent" if silent else ""
        warnings.warn(
            "channel must have a connected graph to reach one average, "
            f"got {count} components{because}, each of which reaches its own",
            Disconnected,
            # The warning points at the call of the rule, above the rule and its validation.
            stacklevel=4,
        )


@lru_cache(maxsize=32)
def _find_components(graph: Graph, silent: frozenset[int]) -> Indices:
    """Return each agent's strongly connected component, (A,), without the silent agents' links.

    An agent without links is a component by itself.
    """
    is_silent = np.isin(np.arange(graph.n_agents), list(silent))
    # A link works if neither of its ends is silent.
    works = ~(is_silent[graph.receivers] | is_silent[graph.senders])
    pairs = np.stack([graph.receivers[works], graph.senders[works]], axis=1)
    return Graph.from_edges(graph.n_agents, pairs, directed=True).components


def _check_single_run(channel: Channel) -> None:
    """Refuse a batch of runs, in which an agent would send other messages in each run."""
    if channel.runs:
        raise ValueError(f"channel must be a single run, got runs {channel.runs}")


def _check_faultless(channel: Channel) -> None:
    """Refuse a channel that loses or delays messages, or has silent agents."""
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
        # The matrix I - γ L
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
    # The distinct nonzero eigenvalues of the Laplacian
    for eigenvalue in _order_eigenvalues(graph):
        # The factor I - L/λ is an averaging step with the gain 1/λ.
        mixed = channel.mix(mixed, _laplacian_weights(graph, 1 / eigenvalue))
    return np.asarray(mixed)


_EXACT = 1e-9
"""Largest error of an average of numbers of size one that still passes for exact."""

_EQUAL = 1e-9
"""Eigenvalues closer than this, relative to the largest, are one: they differ by rounding."""


@lru_cache(maxsize=32)
def _order_eigenvalues(graph: Graph) -> list[float]:
    """Return the Laplacian's distinct nonzero eigenvalues in Leja's order.

    Refuse a graph for which rounding spoils the product of the factors I - L/λ.
    """
    # The smallest eigenvalue is the zero of the average.
    eigenvalues = _leja_order(_drop_repeated(graph.laplacian_spectrum[1:]))
    # The columns of I - 11ᵀ/A are differences from the average. The product of all factors takes
    # them to zero, and the remainder is the rounding error.
    remainder = np.eye(graph.n_agents) - 1 / graph.n_agents
    for eigenvalue in eigenvalues:
        remainder -= graph.laplacian @ remainder / eigenvalue
    error = np.abs(remainder).max()
    if error > _EXACT:
        raise ValueError(
            "channel must have a graph whose Laplacian's eigenvalues permit an exact average in "
            f"floating point, got a rounding error of {error:.0e}: use average_consensus"
        )
    return eigenvalues


def _drop_repeated(ascending: Array) -> Array:
    """Return ascending values without those that repeat the one before up to rounding."""
    scale = max(1.0, float(ascending.max(initial=0)))
    # The first value has nothing before it, and is new.
    is_new = np.diff(ascending, prepend=-np.inf) > _EQUAL * scale
    return ascending[is_new]


def _leja_order(ascending: Array) -> list[float]:
    """Return ascending points in Leja's order, in which products of factors 1 - x/λ stay small.

    The first point is the largest. The next one p has the largest product of distances
    Π |p - p_k| from the points p_k before it. D. Calvetti and L. Reichel, Journal of Computational
    and Applied Mathematics 71 (1996) 267-286.
    """
    # log Π |p - p_k| of every point p
    log_distance = np.zeros(ascending.size)
    order = [float(p) for p in ascending[-1:]]
    while len(order) < ascending.size:
        # A point that is in the order already has the distance zero, whose logarithm is -inf, and
        # is not chosen again.
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
        As for :func:`average_consensus`. Strongly connected; messages may be lost. If an
        agent is always silent, its neighbours go on pushing to it in vain. The others then
        agree on a weighted mean of their values, and a :class:`Disconnected` warning
        says so.
    rounds : int
        Number of rounds, with k + 1 scalars a link each.

    Returns
    -------
    ndarray, (*runs, A, k)
        The ratios. While agents are cut off, weights shrink in each round. An agent whose
        weight vanishes in rounding keeps its last ratio; if it still does so at the end,
        a :class:`Disconnected` warning names it.

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
    _warn_if_disconnected(channel, rounds)
    # Value and weight of each agent, which move together.
    ones = np.ones((*values.shape[:-1], 1))
    mass = np.concatenate([values, ones], axis=-1)
    # Equal parts for the agent itself and for each of its receivers.
    part = 1 / (1 + graph.out_degree)[:, None]
    pushed = np.zeros_like(mass)
    # The last running sum that arrived on each link.
    received = np.zeros((*channel.runs, graph.senders.size, mass.shape[-1]))
    # All weight that has arrived at each agent, and a bound of its own weight's rounding error.
    total = np.zeros_like(ones)
    rounding = np.zeros_like(ones)
    last_usable = mass
    for _ in range(rounds):
        pushed = pushed + part * mass
        arrived = channel.send_on_links(
            pushed[..., graph.senders, :], is_broadcast=True
        )
        # Where a message is lost the last sum stays; the next one brings both increases.
        latest = np.where(np.isnan(arrived), received, arrived)
        increase = graph._sum_by_receiver(latest - received)
        mass = part * mass + increase
        received = latest
        # An increase is a difference of running sums, with an error of ε times their size.
        weight_increase = increase[..., -1:]
        total = total + weight_increase
        rounding = part * rounding + np.where(weight_increase > 0, EPS * total, 0.0)
        # An agent whose weight is lost in rounding keeps the value and weight that it had before.
        usable = _is_usable(mass[..., -1:], rounding)
        is_usual = np.count_nonzero(usable) == usable.size
        last_usable = mass if is_usual else np.where(usable, mass, last_usable)
    _warn_if_weights_vanish(usable)
    # The ratio of value and weight is the estimate of the average.
    return np.asarray(last_usable[..., :-1] / last_usable[..., -1:])


_RATIO_ERROR = 1e-6
"""Relative error that rounding may cause in a ratio of push-sum: six digits stay right."""

_LEAST_WEIGHT = float(np.sqrt(np.finfo(float).tiny))
"""Weights of push-sum above this, 1e-154, have products with values that do not underflow."""


def _is_usable(weight: Array, rounding: Array) -> Mask:
    """Return which weights of push-sum are more than rounding errors, (*runs, A, 1).

    Weights shrink while agents are cut off. Such an agent has its weight multiplied by
    1 / (1 + its receivers) in every round, until it underflows. Its neighbours' weight drains
    into the links that are down, while the running sums do not shrink, nor do their errors.

    Parameters
    ----------
    weight, rounding : ndarray, (*runs, A, 1)
        The agents' weights after a round, and bounds of their rounding errors.
    """
    is_precise = rounding < _RATIO_ERROR * weight
    return np.asarray(is_precise & (weight > _LEAST_WEIGHT))


def _warn_if_weights_vanish(usable: Mask) -> None:
    """Warn of agents that keep an old ratio of push-sum in any run, from (*runs, A, 1).

    An agent is marked as usable if its weight is more than rounding.
    """
    n_agents = usable.shape[-2]
    # Which agents are usable in every run, (A,)
    in_all_runs = usable.reshape(-1, n_agents).all(axis=0)
    if not in_all_runs.all():
        agents = np.flatnonzero(~in_all_runs).tolist()
        warnings.warn(
            "channel must deliver some messages between all parts of the graph for push_sum, "
            f"got weights of agents {agents} that vanish in rounding: these agents keep "
            "their ratio of an earlier round",
            Disconnected,
            # The warning points at the call of push_sum, above it and its validation.
            stacklevel=4,
        )


@fusion_rule("vectors")
@validated
def max_consensus(
    values: PerAgent, channel: Channel, *, rounds: PositiveInt | None = None
) -> Array:
    """Reach the largest value, component by component, in as many rounds as the diameter.

    In each round an agent keeps the largest of its own value and those that it receives.

    Parameters
    ----------
    values, channel
        As for :func:`average_consensus`. The graph has to be connected. A lost message makes no
        value wrong, it only delays the largest one: pass more rounds then.
    rounds : int, optional
        By default the graph's diameter, which is enough without losses.

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
    # Links are ordered by receiver: those to agent i begin at indptr[i]. In a connected graph
    # every agent has at least one, which `reduceat` needs.
    row_starts = graph.links.indptr[:-1]
    for _ in range(rounds or graph.diameter):
        arrived = channel.send_on_links(
            largest[..., graph.senders, :], is_broadcast=True
        )
        # A lost message is NaN, which fmax ignores.
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
        new_z = check_array(call_user(average, u + w, channel), "average", z.shape)
        # W is the dual variable divided by ρ.
        w = w + u - new_z
        # Each agent's primal residual |U - Z| and dual residual ρ |Z - Z before|, (A,).
        primal_by_agent = np.abs(u - new_z).max(axis=1)
        dual_by_agent = rho * np.abs(new_z - z).max(axis=1)
        residuals = np.stack([primal_by_agent, dual_by_agent], axis=1)
        z = new_z
        # After the maximum all agents hold the same two numbers; any row will do.
        largest = max_consensus(residuals, channel)
        primal, dual = largest[0].tolist()
        if primal < tolerance and dual < tolerance:
            return AdmmResult.construct(z, iteration, primal, dual)
    raise SolverError(
        f"iterations must be more for residuals below {tolerance:g}, "
        f"got {primal:.3g} and {dual:.3g} after {iterations} iterations"
    )
