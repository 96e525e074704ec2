"""How agents that hold mixtures agree on a target: only beliefs about it travel."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from ..doors import Count, door
from ..network import Channel, fuses
from .fusion import fuse
from .gaussian import GaussianMixture

__all__ = ["target_fusion"]


@fuses("mixtures")
@door
def target_fusion(
    beliefs: Sequence[GaussianMixture],
    channel: Channel,
    *,
    target_dim: Count,
    fuse: Callable[..., GaussianMixture] = fuse,
) -> tuple[GaussianMixture, ...]:
    """Every agent sends what it believes of the target, and fuses its belief with what arrives.

    Who hears nothing changes nothing. With :func:`functools.partial` for the options it is the
    ``agreement=`` of a filter of mixtures.

    Parameters
    ----------
    beliefs : sequence of GaussianMixture, length A
        Each agent's belief about [target; its own state]; own states may differ in size.
    channel : Channel
        The door between agents. A mixand costs 1 + n + n(n+1)/2 scalars a link.
    target_dim : int
        How many components, n, the first of every state, are the target's.
    fuse : callable
        ``fuse(own, heard) -> mixture``, such as :func:`fuse`, :func:`fuse_moments` and
        :func:`fuse_in_turn`.

    Returns
    -------
    tuple of GaussianMixture, length A

    Raises
    ------
    numpy.linalg.LinAlgError
        If a fused belief has a covariance that is not positive definite.

    Examples
    --------
    >>> from distfilt.network import graphs
    >>> pair = [GaussianMixture.gaussian([m], [[1.0]]) for m in (0.0, 3.0)]
    >>> fused = target_fusion(pair, Channel(graphs.path(2)), target_dim=1)
    >>> [m.means.round(6).tolist() for m in fused]
    [[[1.5]], [[1.5]]]
    """
    inbox = channel.exchange([belief.marginal(range(target_dim)).pack() for belief in beliefs])
    return tuple(
        _fused(agent, belief, [GaussianMixture.unpack(part) for part in arrived.values()], fuse)
        for agent, (belief, arrived) in enumerate(zip(beliefs, inbox, strict=True))
    )


def _fused(
    agent: int,
    own: GaussianMixture,
    heard: Sequence[GaussianMixture],
    fuse: Callable[..., GaussianMixture],
) -> GaussianMixture:
    """One agent's belief after what it heard; what fails names the agent."""
    if not heard:
        return own
    try:
        fused = fuse(own, heard)
        fused.factors  # noqa: B018
    except np.linalg.LinAlgError as error:
        raise np.linalg.LinAlgError(f"agent {agent}: {error}") from error
    return fused
