"""Rules by which agents agree on an average or a maximum: ``(values, channel, *, …) -> values``."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from ..checks import Array, array, count, number
from ..ensembles import mean
from . import weights as weighting
from .channel import Channel
from .weights import Weights

__all__ = ["average", "finite_time", "maximum", "mean_pull", "push_sum"]


def _values(values: ArrayLike, channel: Channel) -> Array:
    if not isinstance(channel, Channel):
        raise ValueError(f"channel: needs a Channel, got {type(channel).__name__}")
    return array(values, "values", (*channel.runs, channel.graph.size, "k"))


def _connected(channel: Channel) -> None:
    if not channel.graph.connected:
        parts = channel.graph.components.max() + 1
        raise ValueError(f"channel: needs a connected graph to agree, got {parts} components")


def average(
    values: ArrayLike,
    channel: Channel,
    *,
    rounds: int = 1,
    gain: float | None = None,
    weights: Weights | None = None,
    lost: str = "mutual",
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
        How many times.
    gain : float, optional
        The gain γ, positive. The values agree if and only if the graph is connected and
        γ < 2/λ_max of its Laplacian.
    weights : Weights, optional
        Other weights instead; Metropolis by default. They have to keep the average on their own
        account: symmetric, or :func:`distfilt.network.weights.balanced` on a digraph.
    lost : str
        What to do about lost messages: see :meth:`Channel.combine`.

    Returns
    -------
    ndarray, (*runs, A, k)

    Raises
    ------
    ValueError
        If the values do not fit the channel, `gain` is not positive or given beside `weights`, or
        the columns of the weights do not sum to one, so that the average would move.

    Examples
    --------
    >>> from distfilt.network import Channel, graphs
    >>> average([[0.0], [3.0], [-1.5]], Channel(graphs.star(3)), gain=0.5, rounds=40).round(4)
    array([[0.5],
           [0.5],
           [0.5]])
    """
    out = _values(values, channel)
    if gain is not None and weights is not None:
        raise ValueError("gain: needs to stand alone, got weights too")
    if gain is not None:
        weights = weighting.laplacian(channel.graph, number(gain, "gain", above=0))
    elif weights is None:
        weights = weighting.metropolis(channel.graph)
    weighting.keeping(weights)
    return channel.combine(out, weights, lost=lost, rounds=rounds)


def finite_time(values: ArrayLike, channel: Channel) -> Array:
    r"""The exact average in as many rounds as the Laplacian has distinct nonzero eigenvalues.

    .. math:: \prod_{k}\Bigl(\mathbf I-\tfrac1{\lambda_k}\mathbf L\Bigr)\mathbf x
        = \bar x\,\mathbf 1

    Each factor removes one eigenspace and leaves the average alone.

    Parameters
    ----------
    values : array_like, (*runs, A, k)
        One vector per agent.
    channel : Channel
        Connected, with links both ways, and without faults: one lost message spoils the product.

    Returns
    -------
    ndarray, (*runs, A, k)

    Notes
    -----
    Large factors come between small ones (Leja's order), or rounding grows with the number of
    eigenvalues.

    Examples
    --------
    >>> from distfilt.network import Channel, graphs
    >>> channel = Channel(graphs.star(5))
    >>> finite_time(np.arange(5.0)[:, None], channel).ravel().round(12)
    array([2., 2., 2., 2., 2.])
    >>> channel.ledger.rounds
    2
    """
    out = _values(values, channel)
    _connected(channel)
    if not channel.faults.none:
        raise ValueError("channel: needs no faults for a finite-time rule, got a faulty channel")
    for eigenvalue in _leja(_distinct(channel.graph.spectrum[1:])):
        out = channel.combine(out, weighting.laplacian(channel.graph, 1 / eigenvalue))
    return out


def _distinct(values: Array) -> Array:
    gaps = np.diff(values, prepend=-np.inf) > 1e-9 * max(1.0, float(values.max(initial=0)))
    return values[gaps]


def _leja(points: Array) -> list[float]:
    """The points in an order in which every partial product stays small."""
    left: list[float] = points.tolist()
    chosen: list[float] = []
    while left:
        scores = [
            sum(np.log(abs(p - c)) for c in chosen) if chosen else abs(p) for p in left
        ]
        chosen.append(left.pop(int(np.argmax(scores))))
    return chosen


def push_sum(values: ArrayLike, channel: Channel, *, rounds: int) -> Array:
    r"""Averages on any strongly connected digraph, also when messages are lost, without answers.

    Each agent pushes shares of its value and of a weight that began at one, and the ratio tends to
    the average. On each link it sends the *running sum* of all it ever pushed there; the receiver
    takes the increase since what it heard last, so that a lost message is made good by the next.

    Parameters
    ----------
    values : array_like, (*runs, A, k)
        One vector per agent.
    channel : Channel
        Strongly connected; messages may be lost.
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
    v = _values(values, channel)
    _connected(channel)
    graph = channel.graph
    mass = np.concatenate([v, np.ones((*v.shape[:-1], 1))], axis=-1)
    share = 1 / (1 + graph.listeners)[:, None]
    pushed = np.zeros_like(mass)
    heard = np.zeros((*channel.runs, graph.senders.size, mass.shape[-1]))
    for _ in range(count(rounds, "rounds")):
        pushed = pushed + share * mass
        arrived = channel.carry(pushed[..., graph.senders, :])
        latest = np.where(np.isnan(arrived), heard, arrived)
        mass = share * mass + _summed(latest - heard, channel)
        heard = latest
    return np.asarray(mass[..., :-1] / mass[..., -1:])


def _summed(per_link: Array, channel: Channel) -> Array:
    """Sum of what each agent received over its links, (*runs, A, k)."""
    front = np.moveaxis(per_link, -2, 0)
    out = channel.graph.incidence @ front.reshape(front.shape[0], -1)
    return np.moveaxis(out.reshape(channel.graph.size, *front.shape[1:]), 0, -2)


def maximum(values: ArrayLike, channel: Channel, *, rounds: int | None = None) -> Array:
    """The largest value, component by component; exact after as many rounds as the diameter.

    Parameters
    ----------
    values : array_like, (*runs, A, k)
        One vector per agent.
    channel : Channel
        Connected. A lost message only costs time.
    rounds : int, optional
        The graph's diameter by default.

    Returns
    -------
    ndarray, (*runs, A, k)

    Examples
    --------
    >>> from distfilt.network import Channel, graphs
    >>> maximum([[1.0], [5.0], [2.0]], Channel(graphs.path(3))).ravel()
    array([5., 5., 5.])
    """
    out = _values(values, channel)
    _connected(channel)
    graph = channel.graph
    needed = graph.diameter if rounds is None else count(rounds, "rounds")
    for _ in range(needed):
        arrived = channel.carry(out[..., graph.senders, :])
        if graph.senders.size:
            hears = graph.degrees > 0
            best = np.fmax.reduceat(arrived, graph.links.indptr[:-1][hears], axis=-2)
            out = out.copy()
            out[..., hears, :] = np.fmax(out[..., hears, :], best)
    return out.copy()


def mean_pull(
    ensembles: ArrayLike,
    channel: Channel,
    *,
    gain: float,
    rounds: int = 1,
    include_self: bool = True,
) -> Array:
    r"""Pull every member towards the neighbours' ensemble means, equation (16) of Grange et al.

    .. math:: \mathbf x_i^l \leftarrow \mathbf x_i^l
        + \gamma\sum_{l'\in\mathrm{Nbs}(l)}(\hat{\mathbf x}^{l'}-\mathbf x_i^l)

    Parameters
    ----------
    ensembles : array_like, (*runs, A, N, d)
        One ensemble per agent.
    channel : Channel
        The door between agents; only means pass through it, d scalars a link and round. A mean
        that is lost does not pull.
    gain : float
        The gain γ, at least 0; 0 sends nothing and changes nothing.
    rounds : int
        How many times.
    include_self : bool
        Whether Nbs(l) holds l itself, as the paper's tables print. The means do not notice, but
        the spread shrinks by 1 - γ|Nbs(l)| either way, one neighbour more with it.

    Returns
    -------
    ndarray, (*runs, A, N, d)

    Raises
    ------
    ValueError
        If the ensembles do not fit the channel, or `gain` is negative.

    Examples
    --------
    >>> from distfilt.network import Channel, graphs
    >>> two = [[[0.0], [2.0]], [[4.0], [6.0]]]
    >>> mean_pull(two, Channel(graphs.path(2)), gain=0.25, include_self=False)[0].ravel()
    array([1.25, 2.75])
    """
    g = number(gain, "gain", at_least=0)
    out = array(ensembles, "ensembles", (*channel.runs, channel.graph.size, "N", "d"))
    needed = count(rounds, "rounds")
    if g == 0:
        return out.copy()
    weights = weighting.laplacian(channel.graph, g)
    for _ in range(needed):
        centre = mean(out)
        moved, own = channel.combine_with_own(centre, weights, lost="keep")
        kept = (own - g * include_self)[..., None, None]
        out = moved[..., None, :] + kept * (out - centre[..., None, :])
    return out
