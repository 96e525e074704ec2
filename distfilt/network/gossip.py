"""Gossip: random pairs of neighbours average their values."""

from __future__ import annotations

import numpy as np

from ..validation import Array, PositiveInt, Rng, validated
from .channel import Channel, PerAgent, fusion_rule
from .consensus import _warn_if_disconnected

__all__ = ["gossip_consensus"]


@fusion_rule("vectors")
@validated
def gossip_consensus(
    values: PerAgent, channel: Channel, *, rounds: PositiveInt, rng: Rng
) -> Array:
    r"""Average in pairs: in each round a random agent averages with a random neighbour.

    .. math:: \mathbf x_i,\mathbf x_j\leftarrow\tfrac12(\mathbf x_i+\mathbf x_j)

    No clock is shared, and the average is kept exactly. The expected squared
    disagreement shrinks in each round at least by the factor of the second largest
    eigenvalue of the expected matrix, :func:`distfilt.network.weights.expected_gossip`.

    Parameters
    ----------
    values : array_like, (*runs, A, k)
        One vector per agent.
    channel : Channel
        Links both ways, no delay. If one of a pair's two messages is lost, which
        acknowledgements tell, the pair keeps its values. A graph of several components
        gives a :class:`Disconnected` warning.
    rounds : int
        Number of pairs; 2 messages of k scalars each.
    rng : numpy.random.Generator
        Draws the pairs, the same ones for all runs of a batch.

    Notes
    -----
    S. Boyd, A. Ghosh, B. Prabhakar and D. Shah, IEEE Transactions on Information Theory
    52 (2006) 2508-2530.

    Examples
    --------
    >>> from distfilt.network import Channel, graphs
    >>> channel = Channel(graphs.ring(4))
    >>> gossip_consensus(
    ...     [[0.0], [2.0], [4.0], [6.0]],
    ...     channel,
    ...     rounds=200,
    ...     rng=np.random.default_rng(1),
    ... ).round(6).ravel()
    array([3., 3., 3., 3.])
    >>> channel.ledger.messages.sum()
    np.int64(400)

    A round in which an agent without neighbours is drawn changes nothing, and a
    :class:`Disconnected` warning says that there is no common average:

    >>> import warnings
    >>> channel = Channel(graphs.Graph.from_edges(3, [(1, 2)]))
    >>> with warnings.catch_warnings(action="ignore"):
    ...     gossip_consensus(
    ...         [[0.0], [2.0], [4.0]], channel, rounds=9, rng=np.random.default_rng(1)
    ...     ).ravel()
    array([0., 3., 3.])
    >>> channel.ledger.messages
    array([0, 6, 6])
    """
    graph = channel.graph
    graph._check_undirected()
    _warn_if_disconnected(channel, rounds)
    averaged = values.copy()
    # All pairs are drawn first: an agent, and the number of one of its neighbours.
    agents = rng.integers(graph.n_agents, size=rounds)
    choices = (rng.random(rounds) * graph.in_degree[agents]).astype(np.int64)
    faulty = not channel.faults.is_perfect
    # These two arrays serve all rounds; in each only the two links of its pair are filled in.
    packet = np.zeros((*channel.runs, graph.senders.size, averaged.shape[-1]))
    in_use = np.zeros(graph.senders.size, dtype=bool)
    for agent, choice in zip(agents.tolist(), choices.tolist(), strict=True):
        # If the agent has no neighbours nothing happens in this round.
        if graph.in_degree[agent] == 0:
            continue
        # Links are ordered by receiver: those to the agent begin at indptr. The pair is the link
        # from the neighbour and its opposite, to the neighbour.
        link = int(graph.links.indptr[agent]) + choice
        pair = [link, int(graph.reverse[link])]
        ends = graph.receivers[pair]
        in_use[pair] = True
        packet[..., pair, :] = averaged[..., graph.senders[pair], :]
        arrived = channel.send_on_links(packet, links=in_use, acknowledged=faulty)
        in_use[pair] = False
        received = arrived[..., pair, :]
        # Both agents move only if both messages have arrived; otherwise the average would change.
        complete = ~np.isnan(received).any(axis=(-2, -1), keepdims=True)
        present = averaged[..., ends, :]
        mean = 0.5 * (present + received)
        averaged[..., ends, :] = np.where(complete, mean, present)
    return np.asarray(averaged)
