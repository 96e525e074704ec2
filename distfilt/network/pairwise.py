"""Fusion rules for two Gaussians at a time: an agent fuses the received ones one by one.

The result depends on the order, which is that of the senders.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import Annotated

import numpy as np

from ..gaussians import (
    intersect_ellipsoids,
    intersect_inverses,
    intersect_split,
    unite_gaussians,
)
from ..gaussians.pairwise import Size
from ..linalg import symmetrise
from ..periods import align
from ..validation import (
    Array,
    ArrayInput,
    Indices,
    Mask,
    PositiveInt,
    PositiveSemidefinite,
    validated,
)
from .channel import Channel, fusion_rule
from .consensus import _warn_if_disconnected
from .fusion import Gaussians, Pair, _Received, _repeat
from .graphs import Graph

__all__ = [
    "covariance_union",
    "ellipsoidal_intersection",
    "inverse_covariance_intersection",
    "split_covariance_intersection",
]

PairRule = Callable[[Array, Array, Array, Array], Pair]
"""``rule(mean_a, cov_a, mean_b, cov_b) -> (mean, cov)``, batched."""

SplitGaussians = tuple[
    Annotated[ArrayInput, "*channel.runs channel.graph.n_agents d"],
    Annotated[PositiveSemidefinite, "*channel.runs channel.graph.n_agents d d"],
    Annotated[PositiveSemidefinite, "*channel.runs channel.graph.n_agents d d"],
]


@fusion_rule("gaussians")
@validated
def inverse_covariance_intersection(
    belief: Gaussians,
    channel: Channel,
    *,
    rule: Size = "min_determinant",
    rounds: PositiveInt = 1,
) -> Pair:
    """Fuse each Gaussian with the neighbours', one by one, by inverse covariance intersection.

    Two covariances give P with P⁻¹ = P_a⁻¹ + P_b⁻¹ - (ω P_a + (1 - ω) P_b)⁻¹ and the weight ω of
    the smallest P. Less conservative than :func:`covariance_intersection`, and consistent if two
    agents' errors are correlated by a common estimate to which each has added information of its
    own. See :func:`distfilt.gaussians.intersect_inverses`.

    Parameters
    ----------
    belief : tuple (means, covs)
        As for :func:`covariance_intersection`.
    channel : Channel
        Mean and covariance are sent on each link, d + d(d+1)/2 scalars. A lost message is left
        out.
    rule : {"min_trace", "min_determinant"}
        The size that the weight makes smallest.
    rounds : int
        Number of rounds.

    Notes
    -----
    B. Noack, J. Sijs, M. Reinhardt and U. D. Hanebeck, Automatica 79 (2017) 35-41. The condition
    is theirs for two estimates; a third one is fused with the result of the first two.

    Examples
    --------
    >>> from distfilt.network import Channel, graphs
    >>> two = [[0.0], [3.0]], [[[1.0]], [[2.0]]]
    >>> fused = inverse_covariance_intersection(two, Channel(graphs.path(2)))
    >>> fused[1].ravel().round(4)
    array([1., 1.])
    """
    _warn_if_disconnected(channel, rounds)
    return _repeat_in_turn(
        belief, channel, rounds, partial(intersect_inverses, rule=rule)
    )


@fusion_rule("gaussians")
@validated
def ellipsoidal_intersection(
    belief: Gaussians, channel: Channel, *, rounds: PositiveInt = 1
) -> Pair:
    """Fuse each Gaussian with the neighbours', one by one, by ellipsoidal intersection.

    Two covariances give P with P⁻¹ = P_a⁻¹ + P_b⁻¹ - Γ⁻¹, where Γ⁻¹ is all information that both
    could have in common, so that it counts once. The result is the least conservative of the
    intersections, and no bound of the error for every correlation. Parameters as for
    :func:`covariance_intersection`, without its rules; see
    :func:`distfilt.gaussians.intersect_ellipsoids`.

    >>> from distfilt.network import Channel, graphs
    >>> two = [[0.0], [3.0]], [[[1.0]], [[2.0]]]
    >>> ellipsoidal_intersection(two, Channel(graphs.path(2)))[0].ravel()
    array([0., 0.])
    """
    _warn_if_disconnected(channel, rounds)
    return _repeat_in_turn(belief, channel, rounds, intersect_ellipsoids)


@fusion_rule("gaussians")
@validated
def covariance_union(
    belief: Gaussians,
    channel: Channel,
    *,
    rule: Size = "min_determinant",
    rounds: PositiveInt = 1,
) -> Pair:
    """Cover each Gaussian and the neighbours', one by one, by covariance union.

    For agents of which some may be wrong without anyone knowing which: if at least one of the
    beliefs is consistent, the result is. Parameters as for
    :func:`inverse_covariance_intersection`; see :func:`distfilt.gaussians.unite_gaussians`.

    >>> from distfilt.network import Channel, graphs
    >>> two = [[0.0], [4.0]], [[[1.0]], [[1.0]]]
    >>> covariance_union(two, Channel(graphs.path(2)))[1].ravel().round(6)
    array([5., 5.])
    """
    _warn_if_disconnected(channel, rounds)
    return _repeat_in_turn(belief, channel, rounds, partial(unite_gaussians, rule=rule))


@validated
def split_covariance_intersection(
    belief: SplitGaussians,
    channel: Channel,
    *,
    rule: Size = "min_determinant",
    rounds: PositiveInt = 1,
) -> tuple[Array, Array, Array]:
    """Fuse means whose errors have a correlated and an independent part with the neighbours'.

    No filter of this package keeps the two parts, so that this is no ``fusion=``. See
    :func:`distfilt.gaussians.intersect_split`.

    Parameters
    ----------
    belief : tuple (means, dependent, independent)
        Each agent's mean, (*runs, A, d), and the covariances (*runs, A, d, d) of the part of its
        error that may be correlated with others', and of the part that is independent.
    channel : Channel
        All three are sent on each link, d + d(d+1) scalars. A lost message is left out. Parts
        that have been sent are no longer independent: before another exchange the caller moves
        them to the dependent part, and so do further `rounds`.
    rule, rounds
        As for :func:`inverse_covariance_intersection`.

    Returns
    -------
    means, dependent, independent : ndarray

    Notes
    -----
    S. J. Julier and J. K. Uhlmann, in D. L. Hall and J. Llinas (eds.), Handbook of Multisensor
    Data Fusion (2001), chapter 12.

    Examples
    --------
    >>> from distfilt.network import Channel, graphs
    >>> zero, one = np.zeros((2, 1, 1)), np.ones((2, 1, 1))
    >>> parts = split_covariance_intersection(
    ...     ([[0.0], [2.0]], zero, one), Channel(graphs.path(2))
    ... )
    >>> parts[0].ravel().round(6), parts[2].ravel().round(6)
    (array([1., 1.]), array([0.5, 0.5]))
    """
    _warn_if_disconnected(channel, rounds)
    graph = channel.graph
    means, dependent, independent = belief
    d = means.shape[-1]
    # All runs in one axis
    shape = (-1, graph.n_agents, d)
    parts = [
        means.reshape(shape),
        dependent.reshape(*shape, d),
        independent.reshape(*shape, d),
    ]
    for round_ in range(rounds):
        if round_ > 0:
            # A part that has been sent is no longer independent.
            parts = [parts[0], parts[1] + parts[2], 0 * parts[2]]
        # Which messages arrive, (R, E): a mean, and the upper triangles of two covariances each
        arrived = channel._transmit_numbers(d + d * (d + 1))
        parts = _fuse_parts(parts, channel, arrived, rule)
    x, dependent_part, independent_part = parts
    return (
        x.reshape(means.shape),
        dependent_part.reshape(dependent.shape),
        independent_part.reshape(independent.shape),
    )


def _fuse_parts(
    parts: list[Array], channel: Channel, arrived: Mask, rule: Size
) -> list[Array]:
    """Fuse each agent's Gaussian with those that have arrived, (R, E), one by one.

    `parts` and the result are the means (R, A, d), and the dependent and the independent parts of
    the covariances, (R, A, d, d). The rule says which size of a fused covariance is made smallest.
    """
    graph = channel.graph
    fused = [part.copy() for part in parts]
    for agents, links in _iterate_neighbours(graph):
        # The agents' result so far, and their next neighbour's message
        own = [part[:, agents] for part in fused]
        other = [part[:, graph.senders[links]] for part in parts]
        # The sender's mean on the receiver's branch of circular components
        other[0] = align(other[0], own[0], channel.periods)
        new = intersect_split(*own, *other, rule=rule)
        # A lost message changes nothing.
        for part, value in zip(fused, new, strict=True):
            # Flags (R, agents) with as many axes as the part
            has_arrived = arrived[:, links].reshape(
                len(part), -1, *[1] * (part.ndim - 2)
            )
            part[:, agents] = np.where(has_arrived, value, part[:, agents])
    return fused


def _iterate_neighbours(graph: Graph) -> Iterator[tuple[Indices, Indices]]:
    """Yield in turn n the agents that have an n-th neighbour, and their links from it.

    Neighbours are ordered by number, from n = 0. All agents fuse their n-th one at once.
    """
    for turn in range(int(graph.in_degree.max(initial=0))):
        # The links to agent i begin at indptr[i], in the order of the senders.
        agents = np.flatnonzero(graph.in_degree > turn)
        yield agents, graph.links.indptr[agents] + turn


def _repeat_in_turn(
    belief: Pair, channel: Channel, rounds: int, pair_rule: PairRule
) -> Pair:
    """Exchange Gaussians in so many rounds, and fuse them two at a time by `pair_rule`."""

    def fuse(received: _Received) -> Pair:
        return _fuse_in_turn(received, pair_rule)

    return _repeat(belief, channel, rounds, fuse)


def _fuse_in_turn(received: _Received, pair_rule: PairRule) -> Pair:
    """Fuse each agent's Gaussian with the received ones, in the order of their senders.

    `pair_rule` fuses two Gaussians.
    """
    graph = received.graph
    means = received.means.copy()
    covs = received.covs.copy()
    # In turn n each agent that has an n-th neighbour receives from it, over one link.
    for agents, links in _iterate_neighbours(graph):
        senders = graph.senders[links]
        # The agents' results so far
        own_mean = means[:, agents]
        own_cov = covs[:, agents]
        # On the receiver's branch of circular components
        other_mean = align(received.means[:, senders], own_mean, received.periods)
        new_mean, new_cov = pair_rule(
            own_mean, own_cov, other_mean, received.covs[:, senders]
        )
        # A lost message changes nothing.
        arrived = received.arrived[:, links, None]
        means[:, agents] = np.where(arrived, new_mean, own_mean)
        covs[:, agents] = np.where(arrived[..., None], new_cov, own_cov)
    return means, symmetrise(covs)
