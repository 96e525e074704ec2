"""Gaussian belief propagation: marginals of a joint Gaussian whose agents each hold one part."""

from __future__ import annotations

import warnings
from typing import Annotated

import numpy as np

from ..linalg import solve_definite, symmetrise
from ..validation import Array, ArrayInput, PositiveInt, validated
from .channel import Channel
from .consensus import _warn_if_disconnected
from .fusion import Pair, _invert
from .information import pack_information, unpack_information

__all__ = ["gaussian_belief_propagation"]

_MOVED = 0.01
"""How far a mean may move in the last round, in its deviations, without a warning."""


@validated
def gaussian_belief_propagation(
    matrices: Annotated[ArrayInput, "*channel.runs channel.graph.n_agents d d"],
    vectors: Annotated[ArrayInput, "*channel.runs channel.graph.n_agents d"],
    couplings: Annotated[ArrayInput, "channel.graph.senders.size d d"],
    channel: Channel,
    *,
    rounds: PositiveInt | None = None,
) -> Pair:
    r"""Return every agent's marginal of a joint Gaussian, by messages between neighbours.

    The density of all agents' states is proportional to
    :math:`\exp(-\tfrac12\mathbf x^\top\mathbf J\mathbf x+\mathbf h^\top\mathbf x)`, and agents i
    and j are coupled by :math:`\mathbf J_{ij}` only if they are neighbours. Agent j sends to i

    .. math::
        \boldsymbol\Lambda_{j\to i} &= -\mathbf J_{ij}\mathbf M^{-1}\mathbf J_{ji}
        \\ \boldsymbol\eta_{j\to i} &= -\mathbf J_{ij}\mathbf M^{-1}
        \Bigl(\mathbf h_j+\sum_{k\ne i}\boldsymbol\eta_{k\to j}\Bigr)
        \\ \mathbf M &= \mathbf J_{jj}+\sum_{k\ne i}\boldsymbol\Lambda_{k\to j}

    On a tree means and covariances are exact after as many rounds as the diameter. On a graph with
    circles the means are exact if the rounds converge, as they do where every row of J is
    diagonally dominant; the covariances are approximations.

    Parameters
    ----------
    matrices : array_like, (*runs, A, d, d)
        The blocks :math:`\mathbf J_{ii}`, symmetric positive definite.
    vectors : array_like, (*runs, A, d)
        The parts :math:`\mathbf h_i`.
    couplings : array_like, (E, d, d)
        The block :math:`\mathbf J_{ij}` of each link, from sender j to receiver i; that of the
        opposite link is its transpose.
    channel : Channel
        Links both ways. d + d(d+1)/2 scalars on each link and round. Of a lost message the last
        one that arrived counts.
    rounds : int, optional
        By default the graph's diameter. On a graph with circles a warning is given if the last
        round still moves a mean by a hundredth of its deviation.

    Returns
    -------
    means, covs : ndarray, (*runs, A, d) and (*runs, A, d, d)

    Notes
    -----
    Y. Weiss and W. T. Freeman, Neural Computation 13 (2001) 2173-2200.

    Examples
    --------
    Three agents on a line: the first knows its place, and each pair its distance, all to 1.

    >>> from distfilt.network import Channel, graphs
    >>> means, covs = gaussian_belief_propagation(
    ...     [[[2.0]], [[2.0]], [[1.0]]],
    ...     [[0.0 - 10.0], [10.0 - 5.0], [5.0]],
    ...     -np.ones((4, 1, 1)),
    ...     Channel(graphs.path(3)),
    ... )
    >>> means.ravel().round(6), covs.ravel().round(6)
    (array([ 0., 10., 15.]), array([1., 2., 3.]))
    """
    graph = channel.graph
    graph._check_undirected()
    reverse = graph.reverse
    # Up to rounding, in units of each entry.
    if not np.allclose(couplings[reverse], couplings.mT, rtol=1e-9, atol=0.0):
        raise ValueError(
            "couplings must be transposed on opposite links, got others on those between "
            f"agents {_find_asymmetric(couplings, channel)}"
        )
    _warn_if_disconnected(channel, rounds)
    d = vectors.shape[-1]
    # The last message that has arrived on each link; none adds nothing.
    shape = (*channel.runs, graph.senders.size, d + d * (d + 1) // 2)
    received = np.zeros(shape)
    if rounds is None:
        rounds = max(graph.diameter, 1) if graph.is_connected else graph.n_agents
    before = received
    for _ in range(rounds):
        before = received
        # J_ii + Σ Λ and h_i + Σ η of what has arrived
        matrix, vector = _add_received(matrices, vectors, received, channel)
        # M and h: all that the sender knows without the receiver's own message
        last_lambda, last_eta = unpack_information(received, d)
        m = matrix[..., graph.senders, :, :] - last_lambda[..., reverse, :, :]
        h = vector[..., graph.senders, :] - last_eta[..., reverse, :]
        # Λ = -J_ij M⁻¹ J_ji and η = -J_ij M⁻¹ h in one solve
        right = np.concatenate(
            [np.broadcast_to(couplings.mT, m.shape), h[..., None]], axis=-1
        )
        message = -couplings @ solve_definite(m, right)
        packed = pack_information(symmetrise(message[..., :d]), message[..., d])
        # A lost message leaves the last one in place.
        arrived = channel.send_on_links(packed)
        received = np.where(np.isnan(arrived), received, arrived)
    # The marginal: P_i⁻¹ = J_ii + Σ Λ and P_i⁻¹ m_i = h_i + Σ η
    matrix, vector = _add_received(matrices, vectors, received, channel)
    covs = symmetrise(_invert(matrix))
    means = (covs @ vector[..., None])[..., 0]
    # A forest of C trees has A - C edges, each a link both ways; components are numbered from 0.
    n_forest_edges = graph.n_agents - (1 + int(graph.components.max()))
    if graph.senders.size // 2 > n_forest_edges:
        # On a graph with circles the last round shows whether the messages have converged.
        last = _add_received(matrices, vectors, before, channel)
        _warn_of_changes(means, covs, *last, rounds)
    return means, covs


def _warn_of_changes(
    means: Array, covs: Array, matrix: Array, vector: Array, rounds: int
) -> None:
    """Warn if the means still moved in the last round, before which they were M⁻¹ h.

    Here M and h are `matrix` and `vector`, and means and covariances those of the last round.
    Shapes are (*runs, A, d) and (*runs, A, d, d).
    """
    previous = (_invert(matrix) @ vector[..., None])[..., 0]
    # Changes in units of each component's standard deviation
    std = np.sqrt(np.diagonal(covs, axis1=-2, axis2=-1))
    change = (np.abs(means - previous) / std).max(initial=0.0)
    if change > _MOVED:
        warnings.warn(
            f"rounds must be enough for the means to converge on a graph with circles, got "
            f"{rounds}, of which the last moved a mean by {change:.2g} of its deviation: they "
            "may need more, or not converge",
            RuntimeWarning,
            # The warning points at the call of the rule, above it and its validation.
            stacklevel=4,
        )


def _add_received(
    matrices: Array, vectors: Array, received: Array, channel: Channel
) -> tuple[Array, Array]:
    """Return J_ii + Σ Λ, (*runs, A, d, d), and h_i + Σ η, (*runs, A, d), of all that has arrived.

    `received` has the last message of each link, packed by `pack_information`.
    """
    graph = channel.graph
    d = vectors.shape[-1]
    total = graph._sum_by_receiver(received, received.ndim - 2)
    matrix, vector = unpack_information(total, d)
    return matrices + matrix, vectors + vector


def _find_asymmetric(couplings: Array, channel: Channel) -> tuple[int, int]:
    """Return the ends of a link whose coupling is not the opposite one's transpose."""
    graph = channel.graph
    difference = np.abs(couplings[graph.reverse] - couplings.mT).max(axis=(-2, -1))
    link = int(difference.argmax())
    return int(graph.receivers[link]), int(graph.senders[link])
