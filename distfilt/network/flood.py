"""Flooding: agents forward values until all of them are known everywhere."""

from __future__ import annotations

import numpy as np

from ..validation import Array, Mask, PositiveInt, validated
from .channel import Channel, PerAgent
from .consensus import _check_single_run, _warn_if_disconnected

__all__ = ["flooding"]


@validated
def flooding(
    values: PerAgent, channel: Channel, *, rounds: PositiveInt | None = None
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
    """
    _check_single_run(channel)
    _warn_if_disconnected(channel, rounds)
    n_agents = channel.graph.n_agents
    # A row to send: the number of the agent and its value.
    numbers = np.arange(n_agents)[:, None]
    table = np.concatenate([numbers, values], axis=1)
    known = np.eye(n_agents, dtype=bool)
    new = known
    # A value travels over at most A - 1 links, so that the default is never reached.
    rounds_left = rounds or 2 * n_agents
    while new.any() and rounds_left:
        rounds_left -= 1
        payloads = [table[rows] if rows.any() else None for rows in new]
        received = np.zeros_like(known)
        for agent, inbox in enumerate(channel.broadcast(payloads)):
            for rows in inbox.values():
                received[agent, rows[:, 0].astype(int)] = True
        # Only first receptions are forwarded in the next round.
        new = received & ~known
        known = known | new
    average = [values[row].mean(axis=0) for row in known]
    return np.array(average), known
