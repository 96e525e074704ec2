"""How agents that hold mixtures agree on a target: rules of fusion, and one over a channel."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Literal

import numpy as np

from ..linalg import log_sum
from ..network import Channel, fusion_rule
from ..validation import PositiveInt, UnitInterval, validated
from .fusion import Exponents, Others, PartialFusion, Rule, Terms
from .gaussian import GaussianMixture, assemble_joint, regression
from .reduction import runnalls

__all__ = [
    "average_mixtures",
    "fuse_mixtures",
    "fuse_sequentially",
    "fuse_moments",
    "target_fusion",
]


@validated
def fuse_mixtures(
    own: GaussianMixture,
    received: Others,
    *,
    omega: Exponents = "equal",
    terms: Terms = "matched",
    rule: Rule = "C3",
    n_components: PositiveInt | None = None,
) -> GaussianMixture:
    """Fuse a belief about [target; ego] with others' beliefs about the target.

    Parameters
    ----------
    own, heard, omega
        As of :class:`PartialFusion`.
    terms : {"matched", "all"}
        As of :meth:`PartialFusion.shapes`.
    rule : {"C1", "C2", "C3", "points"}
        As of :meth:`PartialFusion.weigh`.
    size : int, optional
        Reduce the result to so many mixands by Runnalls' algorithm.

    Examples
    --------
    >>> own = GaussianMixture.gaussian([0.0, 0.0], [[2.0, 1.0], [1.0, 1.0]])
    >>> fuse_mixtures(own, own.marginal([0])).covs.round(6).tolist()
    [[[2.0, 1.0], [1.0, 1.0]]]
    """
    exact = PartialFusion(own, received, omega=omega)
    fused = own
    if exact.exponents[0] != 1:
        fused = exact.assign_weights(exact.component_shapes(terms=terms), rule=rule)
    return fused if n_components is None else runnalls(fused, n_components)


@validated
def fuse_moments(
    own: GaussianMixture, received: Others, *, omega: Exponents = "equal"
) -> GaussianMixture:
    """Factorised covariance intersection: fuse the Gaussians that have the mixtures' moments.

    Parameters
    ----------
    own, heard, omega
        As of :class:`PartialFusion`.

    Returns
    -------
    GaussianMixture
        Of one mixand.

    Examples
    --------
    >>> own = GaussianMixture.gaussian([0.0], [[2.0]])
    >>> fuse_moments(own, GaussianMixture.gaussian([3.0], [[1.0]])).means.round(6)
    array([[2.]])
    """
    others = PartialFusion(own, received, omega=omega).others
    alone = PartialFusion(
        own.moment_match(), [m.moment_match() for m in others], omega=omega
    )
    return alone.component_shapes().with_equal_weights()


@validated
def fuse_sequentially(
    own: GaussianMixture,
    received: Others,
    *,
    omega: UnitInterval | Literal["equal"] = "equal",
    pair: Callable[..., GaussianMixture] = fuse_mixtures,
) -> GaussianMixture:
    """Fuse what is heard one belief after another: fewer mixands at a time than in one pass.

    With the own exponent m / (m + 1) at the m-th belief all exponents end up equal, in whatever
    order, up to what the approximations lose. With a fixed one the last belief counts most.

    Parameters
    ----------
    own, heard
        As of :class:`PartialFusion`.
    omega : "equal" or float
        m / (m + 1), or the own exponent each time.
    pair : callable
        ``pair(own, heard, omega=...) -> mixture``, such as :func:`fuse` and :func:`fuse_moments`.

    Examples
    --------
    >>> ends = [GaussianMixture.gaussian([m], [[1.0]]) for m in (3.0, 6.0)]
    >>> own = GaussianMixture.gaussian([0.0], [[1.0]])
    >>> fuse_sequentially(own, ends).means.round(9)
    array([[3.]])
    >>> fuse_sequentially(own, ends, omega=0.5).means.round(9)
    array([[3.75]])
    """
    for m, other in enumerate(PartialFusion(own, received).others, start=1):
        own = pair(own, other, omega=m / (m + 1) if isinstance(omega, str) else omega)
    return own


@validated
def average_mixtures(
    own: GaussianMixture, received: GaussianMixture, *, omega: UnitInterval = 0.5
) -> GaussianMixture:
    r"""Arithmetic average of the target beliefs, with the own conditional belief about the rest.

    :math:`p(\mathbf e|\mathbf t)\,[\omega\,p(\mathbf t)+(1-\omega)\,p_b(\mathbf t)]`. The weights
    of the own mixands given t are taken at the means of the heard mixands; with one own mixand the
    result is exact.

    Parameters
    ----------
    own, heard : GaussianMixture
        As of :class:`PartialFusion`.
    omega : float
        The own share, in [0, 1].

    Examples
    --------
    >>> own = GaussianMixture.gaussian([0.0, 0.0], [[1.0, 0.5], [0.5, 1.0]])
    >>> average_mixtures(own, GaussianMixture.gaussian([2.0], [[1.0]])).mean
    array([1. , 0.5])
    """
    target = PartialFusion(own, received).target
    n = received.dim
    logs = target.log_weights + target.component_log_densities(received.means)
    share = np.exp(logs - log_sum(logs))
    gain, rest = regression(own, n)
    gap = received.means[:, None] - own.means[:, :n]
    ego = own.means[:, n:] + (gain @ gap[..., None])[..., 0]
    told = np.broadcast_to(received.means[:, None], gap.shape)
    means = np.concatenate([told, ego], axis=-1)
    covs = assemble_joint(received.covs[:, None], gain, rest)
    new = (received.weights[:, None] * share).ravel() * (1 - omega)
    d = own.dim
    keep = new > 0
    return GaussianMixture.construct(
        np.concatenate([omega * own.weights, new[keep]]),
        np.concatenate([own.means, means.reshape(-1, d)[keep]]),
        np.concatenate([own.covs, covs.reshape(-1, d, d)[keep]]),
    )


@fusion_rule("mixtures")
@validated
def target_fusion(
    beliefs: Sequence[GaussianMixture],
    channel: Channel,
    *,
    target_dim: PositiveInt,
    fuse: Callable[..., GaussianMixture] = fuse_mixtures,
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
        :func:`fuse_sequentially`.

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
    said = [belief.marginal(range(target_dim)).pack() for belief in beliefs]
    unpack = GaussianMixture.unpack
    out = list(beliefs)
    for agent, told in enumerate(channel.broadcast(said)):
        try:
            if told:
                out[agent] = fuse(out[agent], [unpack(part) for part in told.values()])
            out[agent].factors  # noqa: B018
        except np.linalg.LinAlgError as error:
            raise np.linalg.LinAlgError(f"agent {agent}: {error}") from error
    return tuple(out)
