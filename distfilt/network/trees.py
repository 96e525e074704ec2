"""Fusion on a tree: each link keeps the information that its two ends have in common."""

from __future__ import annotations

from typing import Annotated

import numpy as np

from ..linalg import symmetrise
from ..periods import wrap_differences
from ..validation import Array, ArrayInput, PositiveDefinite, validated
from .channel import Channel
from .fusion import Gaussians, Pair, _invert
from .graphs import Graph

__all__ = ["fuse_on_tree"]

LinkGaussians = tuple[
    Annotated[ArrayInput, "*channel.runs channel.graph.senders.size d"],
    Annotated[PositiveDefinite, "*channel.runs channel.graph.senders.size d d"],
]


@validated
def fuse_on_tree(
    belief: Gaussians, common: LinkGaussians, channel: Channel
) -> tuple[Pair, Pair]:
    r"""Fuse each Gaussian with the neighbours' without their common information: a channel filter.

    .. math:: \mathbf Y_i^+=\mathbf Y_i+\sum_j(\mathbf Y_j-\mathbf Y_{ij}),\qquad
        \mathbf Y_{ij}^+=\mathbf Y_i+\mathbf Y_j-\mathbf Y_{ij}

    with the information matrices :math:`\mathbf Y=\mathbf P^{-1}`, and the same for the vectors
    :math:`\mathbf P^{-1}\mathbf m`. On a tree the neighbours' increments have nothing in common,
    so that nothing is counted twice: for a state without process noise every agent has, after as
    many rounds as the diameter, the estimate from all data.

    Parameters
    ----------
    belief : tuple (means, covs)
        Each agent's mean, (*runs, A, d), and covariance, (*runs, A, d, d), positive definite.
    common : tuple (means, covs)
        The Gaussian that both ends of each link know, (*runs, E, d) and (*runs, E, d, d), in the
        order of the graph's links: at first the common prior.
    channel : Channel
        A tree, or several. Mean and covariance are sent on each link, d + d(d+1)/2 scalars. A link
        counts only if both its messages arrive, which acknowledgements show; otherwise its
        information comes with the next exchange.

    Returns
    -------
    belief, common : tuple (means, covs)

    Notes
    -----
    S. Grime and H. F. Durrant-Whyte, Control Engineering Practice 2 (1994) 849-863. With process
    noise, forecasts of agents and links are correlated in a way that no link can know, and the
    result is an approximation.

    Examples
    --------
    Two agents with a common prior N(0, 1) observed 3 and 0 with unit noise:

    >>> from distfilt.network import Channel, graphs
    >>> belief = [[1.5], [0.0]], [[[0.5]], [[0.5]]]
    >>> common = [[0.0], [0.0]], [[[1.0]], [[1.0]]]
    >>> fused, link = fuse_on_tree(belief, common, Channel(graphs.path(2)))
    >>> fused[0].ravel().round(6), (1 / fused[1]).ravel().round(6)
    (array([1., 1.]), array([3., 3.]))
    """
    graph = channel.graph
    _check_tree(graph)
    means, covs = belief
    common_means, common_covs = common
    d = means.shape[-1]
    n_links = graph.senders.size
    m = means.reshape(-1, graph.n_agents, d)
    link_mean = common_means.reshape(-1, n_links, d)
    # Information matrices of agents, (R, A, d, d), and of links, (R, E, d, d), for R runs
    y = _invert(covs.reshape(-1, graph.n_agents, d, d))
    link_y = _invert(common_covs.reshape(-1, n_links, d, d))
    faulty = not channel.faults.is_perfect
    # Which messages arrive, (R, E): a mean and the upper triangle of a covariance each
    arrived = channel._transmit_numbers(d + d * (d + 1) // 2, acknowledged=faulty)
    # Both ends add the other one's information, or neither does.
    is_mutual = (arrived & arrived[:, graph.reverse])[..., None, None]

    # Y_i⁺ = Y_i + Σ (Y_j - Y_ij), and the mean as a shift of the own one:
    # m_i⁺ = m_i + P_i⁺ Σ [Y_j (m_j - m_i) - Y_ij (m_ij - m_i)].
    y_j = y[:, graph.senders]
    y_i = y[:, graph.receivers]
    own = m[:, graph.receivers]
    # Differences m_j - m_i and m_ij - m_i of means, of angles the shorter way round
    other = _subtract(m[:, graph.senders], own, channel)
    shared = _subtract(link_mean, own, channel)
    gained = np.where(is_mutual, y_j - link_y, 0.0)
    pull = np.where(is_mutual, y_j @ other[..., None] - link_y @ shared[..., None], 0.0)
    # The sums run over each agent's links.
    new_cov = _invert(y + graph._sum_by_receiver(gained, axis=1))
    shift = new_cov @ graph._sum_by_receiver(pull, axis=1)
    fused_mean = (m + shift[..., 0]).reshape(means.shape)
    fused_cov = symmetrise(new_cov).reshape(covs.shape)

    # Y_ij⁺ = Y_ij + (Y_i - Y_ij) + (Y_j - Y_ij), and the mean as a shift of the link's:
    # m_ij⁺ = m_ij + P_ij⁺ [Y_j (m_j - m_ij) + Y_i (m_i - m_ij)]. The variables `other` and `shared`
    # are m_j - m_i and m_ij - m_i.
    link_cov = _invert(np.where(is_mutual, y_i + y_j - link_y, link_y))
    pull = y_j @ (other - shared)[..., None] - y_i @ shared[..., None]
    shift = link_cov @ np.where(is_mutual, pull, 0.0)
    new_link = (link_mean + shift[..., 0]).reshape(common_means.shape)
    new_link_cov = symmetrise(link_cov).reshape(common_covs.shape)
    return (fused_mean, fused_cov), (new_link, new_link_cov)


def _subtract(first: Array, second: Array, channel: Channel) -> Array:
    """Return a difference of means, of angles the shorter way round.

    The channel has the periods of the means' components, if any is circular.
    """
    difference = first - second
    if channel.periods:
        return wrap_differences(difference, channel.periods)
    return difference


def _check_tree(graph: Graph) -> None:
    """Refuse a graph with a circle, around which information would come back as new."""
    graph._check_undirected()
    n_parts = int(graph.components.max()) + 1
    # An edge is a link both ways. A forest of n trees has n edges fewer than agents.
    n_edges = graph.senders.size // 2
    if n_edges != graph.n_agents - n_parts:
        raise ValueError(
            "channel must have a graph without circles, got "
            f"{n_edges} links between {graph.n_agents} agents in {n_parts} parts"
        )
