"""Consensus on the information of Gaussians, and diffusion of their means, as fusion rules."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ..linalg import symmetrise
from ..periods import fold
from ..validation import Array, PositiveInt, call_user, check_array, validated
from .channel import Channel, LossRule, fusion_rule
from .consensus import _warn_if_disconnected, average_consensus
from .fusion import Gaussians, Pair, _invert, _mix_circular, find_known
from .graphs import Graph
from .weights import (
    ConsensusWeights,
    _check_same_links,
    _check_sums_to_one,
    metropolis,
)

__all__ = ["diffuse_means", "information_consensus"]

Consensus = Callable[[Array, Channel], Array]


@fusion_rule("gaussians")
@validated
def information_consensus(
    belief: Gaussians, channel: Channel, *, consensus: Consensus = average_consensus
) -> Pair:
    r"""Average the agents' information matrices and vectors by a consensus rule.

    .. math:: \mathbf P_i^{-1}\leftarrow\sum_jw_{ij}\mathbf P_j^{-1},\qquad
        \mathbf P_i^{-1}\mathbf m_i\leftarrow\sum_jw_{ij}\mathbf P_j^{-1}\mathbf m_j

    Consensus on information: as the weights of all rounds together sum to one it is covariance
    intersection of the agents within reach, and consistent for any correlation. In the limit the
    agents reach the Kullback-Leibler average, which counts each agent's information with weight
    1/A.

    Parameters
    ----------
    belief
        As for :func:`covariance_intersection`, without known constants.
    channel : Channel
        d + d(d+1)/2 scalars for each vector that the rule sends.
    consensus : callable
        ``consensus(values, channel) -> values``, a rule for the average of vectors, such as
        ``partial(average_consensus, rounds=5)``. Its weights have to be nonnegative, or the
        result need not be positive definite.

    Notes
    -----
    G. Battistelli and L. Chisci, Automatica 50 (2014) 707-718.

    Examples
    --------
    >>> from distfilt.network import Channel, graphs
    >>> two = information_consensus(
    ...     ([[0.0], [3.0]], [[[1.0]], [[2.0]]]), Channel(graphs.path(2))
    ... )
    >>> two[0].ravel().round(6), two[1].ravel().round(6)
    (array([1., 1.]), array([1.333333, 1.333333]))
    """
    means, covs = belief
    # All agents' angles on one branch
    means = fold(means, channel.periods)
    # P⁻¹ and P⁻¹ m, packed in vectors of d(d+1)/2 + d numbers, which the user's rule averages
    numbers = pack_information(*to_information(means, covs))
    averaged = call_user(consensus, numbers, channel)
    averaged = check_array(averaged, "consensus", numbers.shape)
    return from_information(*unpack_information(averaged, means.shape[-1]))


@fusion_rule("gaussians")
@validated
def diffuse_means(
    belief: Gaussians,
    channel: Channel,
    *,
    weights: ConsensusWeights | None = None,
    on_loss: LossRule = "keep",
    rounds: PositiveInt = 1,
) -> Pair:
    r"""Replace each mean by a convex combination of it and the neighbours' means.

    .. math:: \mathbf m_i\leftarrow\sum_jc_{ij}\mathbf m_j,\qquad
        \sum_jc_{ij}=1,\quad c_{ij}\ge0

    The diffusion step. A :class:`~distfilt.filters.GaussianFilter` that shares its observations
    with the neighbours and fuses by this rule is the diffusion Kalman filter. The covariances are
    not changed: they are not those of the errors any more.

    Parameters
    ----------
    belief
        As for :func:`covariance_intersection`.
    channel : Channel
        Only means are sent on each link, d scalars.
    weights : ConsensusWeights, optional
        The weights c, nonnegative with rows that sum to one; Metropolis by default.
    on_loss : str
        Where the weight of a lost mean goes: see :meth:`Channel.mix`; with circular components
        it is kept.
    rounds : int
        Number of rounds.

    Notes
    -----
    F. S. Cattivelli and A. H. Sayed, IEEE Transactions on Automatic Control 55 (2010) 2069-2084,
    algorithm 2.

    Examples
    --------
    >>> from distfilt.network import Channel, graphs
    >>> two = [[0.0], [4.0]], [[[1.0]], [[2.0]]]
    >>> diffuse_means(two, Channel(graphs.path(2)))[0].ravel()
    array([2., 2.])
    """
    if weights is None:
        weights = metropolis(channel.graph)
    else:
        _check_convex(weights, channel.graph)
    if rounds > 1:
        _warn_if_disconnected(channel)
    means, covs = belief
    # Refuses constants that differ: mixed, they would lose what every agent is certain of.
    find_known(means, covs, channel.periods, "belief")
    # Means on a line are mixed by the weights. Covariances are copied, since the result is the
    # caller's to change.
    if not channel.periods:
        means = channel.mix(means, weights, on_loss=on_loss, rounds=rounds)
        return means, covs.copy()
    if on_loss != "keep":
        raise ValueError(
            f"on_loss must be 'keep' for circular components, got {on_loss!r}"
        )
    # Angles move by weighted differences, the shorter way round.
    for _ in range(rounds):
        means, _self_weights = _mix_circular(means, channel, weights)
    return means, covs.copy()


def _check_convex(weights: ConsensusWeights, graph: Graph) -> None:
    """Refuse weights of another graph, negative ones, and rows that do not sum to one."""
    _check_same_links(weights, graph)
    # The smallest weight of all, at most zero.
    least = min(weights.self_weights.min(), weights.link_weights.min(initial=0.0))
    if least < 0:
        raise ValueError(f"weights must be nonnegative, got {least:g}")
    purpose = "keep agents that agree as they are"
    _check_sums_to_one(weights, graph.receivers, "rows", purpose)


def to_information(means: Array, covs: Array) -> tuple[Array, Array]:
    """Return information matrices P⁻¹ and vectors P⁻¹ m of Gaussians."""
    matrix = _invert(covs)
    return matrix, (matrix @ means[..., None])[..., 0]


def from_information(matrix: Array, vector: Array) -> Pair:
    """Return means and covariances of information matrices and vectors."""
    # P = Ω⁻¹ and m = P q
    cov = symmetrise(_invert(matrix))
    return (cov @ vector[..., None])[..., 0], cov


def pack_information(matrix: Array, vector: Array) -> Array:
    """Return the upper triangle and the vector side by side, (..., d(d+1)/2 + d).

    >>> pack_information(np.array([[1.0, 2.0], [2.0, 5.0]]), np.array([7.0, 8.0]))
    array([1., 2., 5., 7., 8.])
    """
    # The matrices are symmetric.
    rows, columns = np.triu_indices(matrix.shape[-1])
    return np.concatenate([matrix[..., rows, columns], vector], axis=-1)


def unpack_information(numbers: Array, d: int) -> tuple[Array, Array]:
    """Return the matrices and vectors of packed information."""
    rows, columns = np.triu_indices(d)
    # The same numbers in both triangles
    matrix = np.empty((*numbers.shape[:-1], d, d))
    matrix[..., rows, columns] = numbers[..., : rows.size]
    matrix[..., columns, rows] = numbers[..., : rows.size]
    return matrix, numbers[..., rows.size :]
