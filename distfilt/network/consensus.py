"""Rules by which agents agree, ``(values, channel, *, …) -> values``, and minimise a sum."""

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
    FrozenModel,
    PositiveFloat,
    PositiveInt,
    check_array,
    validated,
)
from .channel import Channel, Lost, PerAgent, fusion_rule
from .graphs import Graph
from .weights import (
    ConsensusWeights,
    _keeping,
    _laplacian,
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
    """A graph in several parts, each of which agrees on an average of its own.

    >>> issubclass(Disconnected, RuntimeWarning)
    True
    """


def _alone(channel: Channel) -> None:
    if channel.runs:
        raise ValueError(f"channel must be a single run, got runs {channel.runs}")


def _faultless(channel: Channel) -> None:
    if not channel.faults.none:
        raise ValueError("channel must have no faults here, got a faulty channel")


@fusion_rule("vectors")
@validated
def average_consensus(
    values: PerAgent,
    channel: Channel,
    *,
    rounds: PositiveInt = 1,
    gain: PositiveFloat | None = None,
    weights: ConsensusWeights | None = None,
    lost: Lost = "mutual",
) -> Array:
    r"""Move every agent's value towards its neighbours', the averaging behind equation (16).

    .. math:: \mathbf x_i \leftarrow \mathbf x_i
        + \gamma\sum_{j\in\mathcal N_i}(\mathbf x_j-\mathbf x_i)

    Parameters
    ----------
    values : array_like, (*runs, A, k)
        One vector per agent.
    channel : Channel
        The door between agents. On a graph that is not connected each component agrees for itself.
    rounds : int
        How many times. More than one on a graph in several parts raise a :class:`Disconnected`
        warning; one does not, as graphs that change may be connected over time.
    gain : float, optional
        The gain γ, positive. The values agree if and only if the graph is connected and
        γ < 2/λ_max of its Laplacian; above it an :class:`UnstableGain` warns.
    weights : Weights, optional
        Other weights instead; Metropolis by default. They have to keep the average on their own
        account: symmetric, or :func:`distfilt.network.weights.balanced` on a digraph.
    lost : str
        What to do about lost messages: see :meth:`Channel.combine`.

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
        raise ValueError("gain must stand alone, got weights too")
    if gain is not None:
        _warn_if_unstable(graph, gain)
        weights = _laplacian(graph, gain)
    elif weights is None:
        weights = metropolis(graph)
    _keeping(weights)
    if rounds > 1 and not graph.connected:
        parts = graph.components.max() + 1
        text = f"channel: the graph has {parts} parts, and each agrees on an average of its own"
        warnings.warn(text, Disconnected, stacklevel=3)
    return channel.mix(values, weights, lost=lost, rounds=rounds)


@fusion_rule("vectors")
@validated
def finite_time_consensus(values: PerAgent, channel: Channel) -> Array:
    r"""The exact average in as many rounds as the Laplacian has distinct nonzero eigenvalues.

    .. math:: \prod_{k}\Bigl(\mathbf I-\tfrac1{\lambda_k}\mathbf L\Bigr)\mathbf x
        = \bar x\,\mathbf 1

    Each factor removes one eigenspace and leaves the average alone.

    Parameters
    ----------
    values, channel
        As for :func:`average`. Connected, with links both ways, and without faults: one lost
        message spoils the product.

    Raises
    ------
    ValueError
        If rounding would spoil it too, as it does where eigenvalues are many and uneven: of twenty
        agents with a hub, or of a hundred at random. There :func:`average` is the way.

    Notes
    -----
    Large factors come between small ones (Leja's order), which keeps rounding small on rings,
    paths and grids.

    Examples
    --------
    >>> from distfilt.network import Channel, graphs
    >>> channel = Channel(graphs.star(5))
    >>> finite_time_consensus(np.arange(5.0)[:, None], channel).ravel().round(12)
    array([2., 2., 2., 2., 2.])
    >>> channel.ledger.rounds
    2
    """
    channel.graph._joined()
    _faultless(channel)
    combine = channel.mix
    out = values.copy()
    for eigenvalue in _factors(channel.graph):
        out = combine(out, _laplacian(channel.graph, 1 / eigenvalue))
    return out


@lru_cache(maxsize=32)
def _factors(graph: Graph) -> list[float]:
    """The eigenvalues in their order, refused where their product is not what it is on paper."""
    found = _leja(_distinct(graph.laplacian_spectrum[1:]))
    left = np.eye(graph.n_agents) - 1 / graph.n_agents
    for eigenvalue in found:
        left -= graph.laplacian @ left / eigenvalue
    if (lost := np.abs(left).max()) > 1e-9:
        raise ValueError(
            f"channel must be a graph that rounding spares, got an error of {lost:.0e}"
        )
    return found


def _distinct(values: Array) -> Array:
    gaps = np.diff(values, prepend=-np.inf) > 1e-9 * max(
        1.0, float(values.max(initial=0))
    )
    return values[gaps]


def _leja(points: Array) -> list[float]:
    """Ascending points in an order in which partial products of their factors stay small.

    Each next one is farthest, in the geometric mean, from all before it.
    """
    score = np.zeros(points.size)
    order = [float(p) for p in points[-1:]]
    while len(order) < points.size:
        with np.errstate(divide="ignore"):
            score += np.log(np.abs(points - order[-1]))
        order.append(float(points[score.argmax()]))
    return order


@fusion_rule("vectors")
@validated
def push_sum(values: PerAgent, channel: Channel, *, rounds: PositiveInt) -> Array:
    r"""Averages on any strongly connected digraph, also when messages are lost, without answers.

    Each agent pushes shares of its value and of a weight that began at one, and the ratio tends to
    the average. On each link it sends the *running sum* of all it ever pushed there; the receiver
    takes the increase since what it heard last, so that a lost message is made good by the next.

    Parameters
    ----------
    values, channel
        As for :func:`average`. Strongly connected; messages may be lost.
    rounds : int
        How many rounds; k + 1 scalars a link and round.

    Returns
    -------
    ndarray, (*runs, A, k)
        The ratios.

    Notes
    -----
    D. Kempe, A. Dobra and J. Gehrke, Foundations of Computer Science (2003) 482-491; running sums:
    N. H. Vaidya, C. N. Hadjicostis and A. D. Dominguez-Garcia (2011).

    Examples
    --------
    >>> from distfilt.network import Channel, Graph
    >>> circle = Graph.from_edges(3, [(0, 2), (1, 0), (2, 1)], directed=True)
    >>> push_sum([[0.0], [3.0], [6.0]], Channel(circle), rounds=80).ravel().round(9)
    array([3., 3., 3.])
    """
    channel.graph._joined()
    graph = channel.graph
    carry = channel.send_on_links
    mass = np.concatenate([values, np.ones((*values.shape[:-1], 1))], axis=-1)
    share = 1 / (1 + graph.out_degree)[:, None]
    pushed = np.zeros_like(mass)
    heard = np.zeros((*channel.runs, graph.senders.size, mass.shape[-1]))
    for _ in range(rounds):
        pushed = pushed + share * mass
        arrived = carry(pushed[..., graph.senders, :])
        latest = np.where(np.isnan(arrived), heard, arrived)
        mass = share * mass + graph._summed(latest - heard)
        heard = latest
    return np.asarray(mass[..., :-1] / mass[..., -1:])


@fusion_rule("vectors")
@validated
def max_consensus(
    values: PerAgent, channel: Channel, *, rounds: PositiveInt | None = None
) -> Array:
    """The largest value, component by component; exact after as many rounds as the diameter.

    Parameters
    ----------
    values, channel
        As for :func:`average`. Connected; a lost message only costs time.
    rounds : int, optional
        By default the graph's diameter.

    Examples
    --------
    >>> from distfilt.network import Channel, graphs
    >>> max_consensus([[1.0], [5.0], [2.0]], Channel(graphs.path(3))).ravel()
    array([5., 5., 5.])
    """
    channel.graph._joined()
    graph = channel.graph
    carry = channel.send_on_links
    out = values.copy()
    if graph.n_agents == 1:
        return out
    for _ in range(rounds or graph.diameter):
        arrived = carry(out[..., graph.senders, :])
        out = np.fmax(out, np.fmax.reduceat(arrived, graph.links.indptr[:-1], axis=-2))
    return out


@dataclass(frozen=True, eq=False)
class AdmmResult(FrozenModel):
    """What consensus ADMM found.

    Parameters
    ----------
    common : ndarray, (A, k)
        Each agent's copy of the common variable Z.
    iterations : int
        How many.
    primal, dual : float
        The residuals at the end, over all agents: the largest distance of local from common, and ρ
        times the largest change of the common variable.

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
    start: Annotated[Array, "channel.graph.n_agents k"],
    channel: Channel,
    *,
    rho: PositiveFloat = 1.0,
    tolerance: PositiveFloat = 1e-6,
    iterations: PositiveInt = 1000,
    average: Callable[[Array, Channel], Array] = finite_time_consensus,
) -> AdmmResult:
    r"""Minimise :math:`\sum_l f_l(\mathbf Z)` when agent l knows only its own :math:`f_l`.

    .. math::
        \mathbf U_l &\leftarrow \arg\min_{\mathbf U} f_l(\mathbf U)
        + \tfrac\rho2\|\mathbf U-(\mathbf Z-\mathbf W_l)\|^2,\\
        \mathbf Z &\leftarrow\tfrac1A\textstyle\sum_l(\mathbf U_l+\mathbf W_l),\\
        \mathbf W_l &\leftarrow\mathbf W_l+\mathbf U_l-\mathbf Z

    Parameters
    ----------
    local_solve : callable
        ``local_solve(target, rho) -> U`` on (A, k): the proximal step of every agent for its own
        objective at its own row of `target` = Z - W.
    start : array_like, (A, k)
        Each agent's first Z.
    channel : Channel
        The door between agents; a single run, connected, without faults. After every iteration the
        agents agree on their largest residuals, so that all stop at once: :func:`maximum` of 2
        scalars, as many rounds as the diameter, charged like everything else.
    rho : float
        Penalty, positive.
    tolerance : float
        Stop when both residuals, of every agent, are below it.
    iterations : int
        At most this many.
    agree : callable
        ``agree(values, channel) -> values``: how the average is found. With a rule that is only
        approximate the agents' copies of Z differ.

    Raises
    ------
    SolverError
        If the residuals are not below `tolerance` after `iterations`; the message has them.

    Notes
    -----
    S. Boyd et al., Foundations and Trends in Machine Learning 3 (2010) 1-122, section 7.1; proposed
    for (22) of Grange et al.

    Examples
    --------
    The average of private numbers, each the minimiser of its agent's :math:`(u-c_l)^2/2`:

    >>> from distfilt.network import Channel, graphs
    >>> own = np.array([[1.0], [2.0], [6.0]])
    >>> run = admm(lambda v, rho: (own + rho * v) / (1 + rho), np.zeros((3, 1)),
    ...            Channel(graphs.path(3)))
    >>> run.common.round(5).ravel()
    array([3., 3., 3.])
    """
    _alone(channel)
    _faultless(channel)  # or agents would stop apart
    z = start
    w = np.zeros_like(start)
    for n in range(1, iterations + 1):
        u = check_array(local_solve(z - w, rho), "local_solve", z.shape)
        new = check_array(average(u + w, channel), "agree", z.shape)
        w = w + u - new
        gaps = np.stack(
            [np.abs(u - new).max(axis=1), np.abs(new - z).max(axis=1)], axis=1
        )
        residuals = gaps * [1.0, rho]
        z = new
        # After the maximum all agents hold the same two numbers; any row will do.
        primal, dual = max_consensus(residuals, channel)[0].tolist()
        if primal < tolerance and dual < tolerance:
            return AdmmResult.construct(z, n, primal, dual)
    raise SolverError(
        f"admm: residuals {primal:.3g} and {dual:.3g} after {iterations} iterations, "
        f"needs both below {tolerance:g}"
    )
