"""Event-triggered averaging: agents send a value only after it has changed."""

from __future__ import annotations

from typing import Annotated

import numpy as np

from ..validation import Array, Bounds, NonNegativeFloat, PositiveInt, validated
from .channel import Channel, PerAgent, fusion_rule
from .consensus import _check_single_run, _warn_if_disconnected
from .weights import metropolis

__all__ = ["event_triggered"]


@fusion_rule("vectors")
@validated
def event_triggered(
    values: PerAgent,
    channel: Channel,
    *,
    rounds: PositiveInt,
    threshold: NonNegativeFloat,
    decay: Annotated[float, Bounds(above=0, at_most=1)] = 1.0,
) -> Array:
    r"""Average, but send a value only if it has changed by more than a threshold since it was sent.

    .. math:: \mathbf x_i\leftarrow\mathbf x_i
        +\sum_j w_{ij}(\hat{\mathbf x}_j-\hat{\mathbf x}_i)

    with the values :math:`\hat{\mathbf x}` that each link delivered last, which both
    its ends know. The Metropolis weights are symmetric: they keep the average exactly,
    also when messages are lost.

    Parameters
    ----------
    values : array_like, (A, k)
        One vector per agent.
    channel : Channel
        Links both ways, a single run, no delay. Acknowledgements tell which messages
        were lost; these are sent again. A graph of several components gives a
        :class:`Disconnected` warning.
    rounds : int
        Number of rounds.
    threshold : float
        An agent sends its value if a component has changed by more than this; at least
        0.
    decay : float
        Factor of the threshold from round to round, in (0, 1]. Below 1 the values
        converge to the average. With 1 their Euclidean distance from it is in the end
        at most
        :math:`\sqrt{Ak}\,\|\mathbf I-\mathbf W\|\,c/(1-\rho)`, where c is the threshold and ρ the
        second largest modulus of the weights' eigenvalues.

    Notes
    -----
    D. V. Dimarogonas, E. Frazzoli and K. H. Johansson, IEEE Transactions on Automatic
    Control 57 (2012) 1291-1297, in discrete time.

    Examples
    --------
    >>> from distfilt.network import Channel, graphs
    >>> channel = Channel(graphs.ring(6))
    >>> x = event_triggered(np.arange(6.0)[:, None], channel, rounds=40, threshold=0.05)
    >>> bool(np.abs(x - 2.5).max() < 0.1)
    True
    >>> bool(channel.ledger.messages.sum() < 40 * 12)
    True
    """
    _check_single_run(channel)
    graph = channel.graph
    graph._check_undirected()
    _warn_if_disconnected(channel, rounds)
    x = values
    link_weights = metropolis(graph).link_weights[:, None]
    faulty = not channel.faults.is_perfect
    # The value that each link delivered last. Its sender knows it too, by acknowledgements.
    delivered = np.full((graph.senders.size, x.shape[1]), np.nan)
    for _ in range(rounds):
        present = x[graph.senders]
        # NaN compares as False, so that values never delivered are sent.
        unchanged = np.abs(present - delivered).max(axis=1) <= threshold
        arrived = channel.send_on_links(
            present, links=~unchanged, acknowledged=faulty, is_broadcast=True
        )
        delivered = np.where(np.isnan(arrived), delivered, arrived)
        # w_ij (x̂_j - x̂_i) over each link; zero as long as one of the two is missing. The incidence
        # matrix sums them over the links of each agent.
        change = link_weights * (delivered - delivered[graph.reverse])
        x = x + graph.incidence @ np.where(np.isnan(change), 0.0, change)
        # A smaller threshold in the next round, for convergence in the limit.
        threshold *= decay
    return np.asarray(x)
