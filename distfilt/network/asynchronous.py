"""Agreement with fewer messages: pairs that wake at random, and news only when there is some."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from ..checks import Array, count, generator, number
from . import weights as weighting
from .channel import Channel
from .consensus import _values, fuses
from .weights import Weights

__all__ = ["event_triggered", "flood", "gossip"]


@fuses("vectors")
def gossip(values: ArrayLike, channel: Channel, *, rounds: int, rng: np.random.Generator) -> Array:
    r"""Average in pairs: in each round one agent wakes and meets one neighbour, both drawn evenly.

    .. math:: \mathbf x_i,\mathbf x_j\leftarrow\tfrac12(\mathbf x_i+\mathbf x_j)

    Nobody keeps a clock, and the average is kept exactly. The mean squared disagreement shrinks in
    each round by at least the second largest eigenvalue of the mean matrix,
    :func:`distfilt.network.weights.gossip`.

    Parameters
    ----------
    values : array_like, (*runs, A, k)
        One vector per agent.
    channel : Channel
        Links both ways, no delay. Where one of a pair's two messages is lost, which
        acknowledgements tell, the pair stays as it is.
    rounds : int
        How many meetings; 2 messages of k scalars each.
    rng : numpy.random.Generator
        Draws the pairs. All runs of a batch meet in the same order.

    Notes
    -----
    S. Boyd, A. Ghosh, B. Prabhakar and D. Shah, IEEE Transactions on Information Theory 52 (2006)
    2508-2530.

    Examples
    --------
    >>> from distfilt.network import Channel, graphs
    >>> channel = Channel(graphs.ring(4))
    >>> gossip([[0.0], [2.0], [4.0], [6.0]], channel, rounds=200,
    ...        rng=np.random.default_rng(1)).round(6).ravel()
    array([3., 3., 3., 3.])
    >>> channel.ledger.messages.sum()
    np.int64(400)
    """
    out = _values(values, channel).copy()
    _pairwise(channel)
    graph, source = channel.graph, generator(rng)
    meetings = count(rounds, "rounds")
    awake = source.integers(graph.size, size=meetings)
    chosen = (source.random(meetings) * graph.degrees[awake]).astype(np.int64)
    faulty = not channel.faults.none
    packet = np.zeros((*channel.runs, graph.senders.size, out.shape[-1]))
    links = np.zeros(graph.senders.size, dtype=bool)
    for i, nth in zip(awake.tolist(), chosen.tolist(), strict=True):
        if graph.degrees[i] == 0:
            continue
        link = int(graph.links.indptr[i]) + nth
        pair = [link, int(graph.reverse[link])]
        links[pair] = True
        packet[..., pair, :] = out[..., graph.senders[pair], :]
        heard = channel.carry(packet, links=links, acknowledged=faulty)[..., pair, :]
        links[pair] = False
        met = ~np.isnan(heard).any(axis=(-2, -1), keepdims=True)
        ends = graph.receivers[pair]
        out[..., ends, :] = np.where(met, 0.5 * (out[..., ends, :] + heard), out[..., ends, :])
    return out


@fuses("vectors")
def event_triggered(
    values: ArrayLike, channel: Channel, *, rounds: int, threshold: float, decay: float = 1.0,
    weights: Weights | None = None,
) -> Array:
    r"""Average, but send only what has moved by more than a threshold since it was sent last.

    .. math:: \mathbf x_i\leftarrow\mathbf x_i
        +\sum_j w_{ij}(\hat{\mathbf x}_j-\hat{\mathbf x}_i)

    with the values :math:`\hat{\mathbf x}` that went over the link last; both its ends know both.
    Symmetric weights keep the average exactly, also when messages are lost.

    Parameters
    ----------
    values : array_like, (A, k)
        One vector per agent.
    channel : Channel
        Links both ways, a single run, no delay. Acknowledgements tell what was lost, and it is sent
        again.
    rounds : int
        How many rounds.
    threshold : float
        An agent sends its value if some component has moved by more than this; at least 0.
    decay : float
        Factor of the threshold from round to round, in (0, 1]. Below 1 the agents agree in the
        limit. With 1 their Euclidean distance from the average is in the end at most
        :math:`\sqrt{Ak}\,\|\mathbf I-\mathbf W\|\,c/(1-\rho)`, where c is the threshold and ρ the
        second largest modulus of the weights' eigenvalues.
    weights : Weights, optional
        Symmetric; Metropolis by default.

    Notes
    -----
    D. V. Dimarogonas, E. Frazzoli and K. H. Johansson, IEEE Transactions on Automatic Control 57
    (2012) 1291-1297, in discrete time.

    Examples
    --------
    >>> from distfilt.network import Channel, graphs
    >>> channel = Channel(graphs.ring(6))
    >>> out = event_triggered(np.arange(6.0)[:, None], channel, rounds=40, threshold=0.05)
    >>> bool(np.abs(out - 2.5).max() < 0.1), bool(channel.ledger.messages.sum() < 40 * 12)
    (True, True)
    """
    x = _values(values, channel)
    if channel.runs:
        raise ValueError("channel: needs a single run, as runs send at different times")
    graph = channel.graph
    w = _symmetric(channel, weights)
    limit = number(threshold, "threshold", at_least=0)
    factor = number(decay, "decay", above=0, at_most=1)
    faulty = not channel.faults.none
    # What link e delivered last; its sender knows by the acknowledgement.
    known = np.full((graph.senders.size, x.shape[1]), np.nan)
    for _ in range(count(rounds, "rounds")):
        now = x[graph.senders]
        moved = ~(np.abs(now - known).max(axis=1) <= limit)
        heard = channel.carry(now, links=moved, acknowledged=faulty)
        known = np.where(np.isnan(heard), known, heard)
        gap = w.links[:, None] * (known - known[graph.reverse])
        x = x + graph.incidence @ np.where(np.isnan(gap), 0.0, gap)
        limit *= factor
    return x


def flood(values: ArrayLike, channel: Channel, *, rounds: int | None = None) -> tuple[Array, Array]:
    """Every agent passes on each value when it first hears of it, with its owner's number.

    The rival of every averaging rule: after as many rounds as the diameter all know everything.

    Parameters
    ----------
    values : array_like, (A, k)
        One vector per agent.
    channel : Channel
        A single run. k + 1 scalars for each value passed on; a loss is not made good.
    rounds : int, optional
        By default until nobody has anything new to say, and so nobody speaks.

    Returns
    -------
    average : ndarray, (A, k)
        Of all that each agent knows.
    known : ndarray of bool, (A, A)
        Whose values agent i knows, ``known[i]``.

    Examples
    --------
    >>> from distfilt.network import Channel, graphs
    >>> channel = Channel(graphs.path(3))
    >>> flood([[0.0], [3.0], [6.0]], channel)[0].ravel()
    array([3., 3., 3.])
    >>> channel.ledger.scalars
    array([ 6, 12,  6])
    """
    x = _values(values, channel)
    if channel.runs:
        raise ValueError("channel: needs a single run, as runs send at different times")
    if channel.faults.late:
        raise ValueError(f"channel: needs no delay, got {channel.faults.late} rounds")
    size = channel.graph.size
    most = 2 * size if rounds is None else count(rounds, "rounds")
    owners = np.arange(size, dtype=np.float64)[:, None]
    table = np.concatenate([owners, x], axis=1)
    known: list[dict[int, Array]] = [{a: table[a]} for a in range(size)]
    news = [list(k.values()) for k in known]
    while any(news) and most:
        most -= 1
        inbox = channel.exchange([np.array(n) if n else None for n in news])
        news = []
        for mine, box in zip(known, inbox, strict=True):
            fresh = {int(row[0]): row for sent in box.values() for row in sent}
            new = {owner: row for owner, row in fresh.items() if owner not in mine}
            mine.update(new)
            news.append([new[owner] for owner in sorted(new)])
    average = np.array([np.mean([k[a][1:] for a in sorted(k)], axis=0) for k in known])
    return average, np.array([[a in k for a in range(size)] for k in known])


def _symmetric(channel: Channel, weights: Weights | None) -> Weights:
    _pairwise(channel)
    graph = channel.graph
    if weights is None:
        return weighting.metropolis(graph)
    w = Weights.from_matrix(graph, weighting.keeping(weights), name="weights")
    gap = np.abs(w.links - w.links[graph.reverse]).max(initial=0.0)
    if gap > 1e-12:
        raise ValueError(f"weights: needs symmetric weights, got a difference of {gap:.3g}")
    return w


def _pairwise(channel: Channel) -> None:
    if channel.graph.directed:
        raise ValueError("channel: needs links both ways, got one-way links")
    if channel.faults.late:
        raise ValueError(f"channel: needs no delay, got {channel.faults.late} rounds")
