"""Flooding: agents forward values until all of them are known everywhere."""

from __future__ import annotations

import numpy as np

from ..validation import Array, Indices, Mask, PositiveInt, validated
from .channel import Channel, PerAgent
from .consensus import _check_single_run, _warn_if_disconnected
from .graphs import Graph

__all__ = ["flooding"]


@validated
def flooding(
    values: PerAgent,
    channel: Channel,
    *,
    rounds: PositiveInt | None = None,
    split_horizon: bool = False,
) -> tuple[Array, Mask]:
    """Flood values: every agent forwards each value once, when it first receives it.

    The exact alternative to averaging.

    Parameters
    ----------
    values : array_like, (A, k)
        One vector per agent.
    channel : Channel
        A single run. k + 1 scalars for each value that is forwarded; a lost one is not
        sent again. A graph of several components gives a :class:`Disconnected` warning.
    rounds : int, optional
        Number of rounds; by default until no agent has a new value to forward.
    split_horizon : bool
        Whether a value is never sent back over a link by which it came. Nothing else
        changes: on a ring half of the messages are saved, on a tree each value crosses
        each link once.

    Returns
    -------
    average : ndarray, (A, k)
        The average of the values that each agent knows.
    known : ndarray of bool, (A, A)
        ``known[i, j]`` if agent i knows the value of agent j.

    Examples
    --------
    >>> from distfilt.network import Channel, graphs
    >>> channel = Channel(graphs.path(3))
    >>> flooding([[0.0], [3.0], [6.0]], channel)[0].ravel()
    array([3., 3., 3.])
    >>> channel.ledger.scalars
    array([ 6, 12,  6])
    >>> channel = Channel(graphs.path(3))
    >>> _ = flooding([[0.0], [3.0], [6.0]], channel, split_horizon=True)
    >>> channel.ledger.scalars
    array([2, 8, 2])
    """
    _check_single_run(channel)
    _warn_if_disconnected(channel, rounds)
    graph = channel.graph
    n_agents = graph.n_agents
    # A row to send: the number of the agent and its value.
    numbers = np.arange(n_agents)[:, None]
    table = np.concatenate([numbers, values], axis=1)
    known = np.eye(n_agents, dtype=bool)
    new = known
    # The number of each link's opposite link, or of the last row below where there is none.
    opposite = find_opposite(graph)
    # Which values (columns) have come over which link (rows). The additional last row, always
    # false, serves links without an opposite.
    came_over = np.zeros((graph.senders.size + 1, n_agents), dtype=bool)
    # A value travels over at most A - 1 links, so that the default is never reached.
    rounds_left = rounds or 2 * n_agents
    while new.any() and rounds_left:
        rounds_left -= 1
        outgoing = new[graph.senders]
        if split_horizon:
            outgoing = outgoing & ~came_over[opposite]
        # By broadcast an agent sends each value once that it sends on any of its links.
        on_any_link = np.zeros_like(known)
        np.logical_or.at(on_any_link, graph.senders, outgoing)
        # Each link's values to send, and, for the bill, each agent's on all its links. None is no
        # message.
        payloads = [table[sent] if sent.any() else None for sent in outgoing]
        common = [table[sent] if sent.any() else None for sent in on_any_link]
        received = np.zeros_like(known)
        for link, rows in enumerate(channel.unicast(payloads, common=common)):
            # The rows of the table that have arrived: numbers of agents, and their values, which
            # `values` has anyway.
            if rows is not None:
                came_over[link, rows[:, 0].astype(int)] = True
                received[graph.receivers[link]] |= came_over[link]
        # Only first receptions are forwarded in the next round.
        new = received & ~known
        known = known | new
    average = [values[row].mean(axis=0) for row in known]
    return np.array(average), known


def find_opposite(graph: Graph) -> Indices:
    """Return the number of each link's opposite link; the number of links where there is none."""
    ends = list(zip(graph.receivers.tolist(), graph.senders.tolist(), strict=True))
    numbers = {pair: link for link, pair in enumerate(ends)}
    opposite = [numbers.get((sender, agent), len(ends)) for agent, sender in ends]
    return np.array(opposite, dtype=np.int64)
