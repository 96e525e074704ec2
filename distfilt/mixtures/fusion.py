"""Rules by which agents that hold mixtures fuse their beliefs about a target."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Literal

import numpy as np

from ..linalg import log_sum_exp
from ..network import Channel, fusion_rule
from ..periods import Periods, align
from ..validation import Array, PositiveInt, UnitInterval, call_user, validated
from .gaussian import (
    GaussianMixture,
    assemble_joint,
    factor_together,
    invert_together,
    regression,
)
from .partial_fusion import (
    Exponents,
    Others,
    PartialFusion,
    Rule,
    Terms,
    fuse_by_receiver,
)
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
    prior: GaussianMixture,
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
    prior, received, omega
        As of :class:`PartialFusion`.
    terms : {"matched", "all"}
        As of :meth:`PartialFusion.component_shapes`.
    rule : {"C1", "C2", "C3", "points"}
        As of :meth:`PartialFusion.assign_weights`.
    n_components : int, optional
        Reduce the result to so many components by Runnalls' algorithm.

    Examples
    --------
    >>> prior = GaussianMixture.gaussian([0.0, 0.0], [[2.0, 1.0], [1.0, 1.0]])
    >>> fuse_mixtures(prior, prior.marginal([0])).covs.round(6).tolist()
    [[[2.0, 1.0], [1.0, 1.0]]]
    """
    exact = PartialFusion(prior, received, omega=omega)
    fused = prior
    # With ω = 1 the others' exponents are 0, and the belief stays.
    if exact.exponents[0] != 1:
        shapes = exact.component_shapes(terms=terms)
        fused = exact.assign_weights(shapes, rule=rule)
    if n_components is None:
        return fused
    return runnalls(fused, n_components)


@validated
def fuse_moments(
    prior: GaussianMixture, received: Others, *, omega: Exponents = "equal"
) -> GaussianMixture:
    """Factorised covariance intersection: fuse the Gaussians that have the mixtures' moments.

    Parameters
    ----------
    prior, received, omega
        As of :class:`PartialFusion`.

    Returns
    -------
    GaussianMixture
        Of one component.

    Examples
    --------
    >>> prior = GaussianMixture.gaussian([0.0], [[2.0]])
    >>> fuse_moments(prior, GaussianMixture.gaussian([3.0], [[1.0]])).means.round(6)
    array([[2.]])
    """
    # PartialFusion checks the beliefs, and makes a tuple of a single one too.
    others = PartialFusion(prior, received, omega=omega).others
    gaussians = [other.moment_match() for other in others]
    # Of Gaussians the fused density is one component, without approximation.
    exact = PartialFusion(prior.moment_match(), gaussians, omega=omega)
    return exact.component_shapes().with_equal_weights()


@validated
def fuse_sequentially(
    prior: GaussianMixture,
    received: Others,
    *,
    omega: UnitInterval | Literal["equal"] = "equal",
    pair: Callable[..., GaussianMixture] = fuse_mixtures,
) -> GaussianMixture:
    """Fuse the received beliefs one after another: fewer components at a time than in one pass.

    If the m-th fusion gives the prior the exponent m / (m + 1), all exponents end up equal in any
    order, but for approximation errors. With a fixed exponent the last belief counts most.

    Parameters
    ----------
    prior, received
        As of :class:`PartialFusion`.
    omega : "equal" or float
        m / (m + 1), or the prior's exponent each time.
    pair : callable
        ``pair(prior, received, omega=...) -> mixture``, such as :func:`fuse_mixtures` and
        :func:`fuse_moments`.

    Examples
    --------
    >>> others = [GaussianMixture.gaussian([m], [[1.0]]) for m in (3.0, 6.0)]
    >>> prior = GaussianMixture.gaussian([0.0], [[1.0]])
    >>> fuse_sequentially(prior, others).means.round(9)
    array([[3.]])
    >>> fuse_sequentially(prior, others, omega=0.5).means.round(9)
    array([[3.75]])
    """
    fused = prior
    # PartialFusion checks the beliefs, and makes a tuple of a single one too.
    for m, other in enumerate(PartialFusion(prior, received).others, start=1):
        # The only string is "equal".
        exponent = m / (m + 1) if isinstance(omega, str) else omega
        fused = call_user(pair, fused, other, omega=exponent)
    return fused


@validated
def average_mixtures(
    prior: GaussianMixture, received: GaussianMixture, *, omega: UnitInterval = 0.5
) -> GaussianMixture:
    r"""Average the target beliefs arithmetically; the conditional belief about the ego stays.

    :math:`p(\mathbf e|\mathbf t)\,[\omega\,p(\mathbf t)+(1-\omega)\,p_b(\mathbf t)]`. The weights
    of the prior's components given t are taken at the means of the received components; for a
    prior of one component the result is exact.

    Parameters
    ----------
    prior, received : GaussianMixture
        As of :class:`PartialFusion`.
    omega : float
        Weight of the prior, in [0, 1].

    Examples
    --------
    >>> prior = GaussianMixture.gaussian([0.0, 0.0], [[1.0, 0.5], [0.5, 1.0]])
    >>> average_mixtures(prior, GaussianMixture.gaussian([2.0], [[1.0]])).mean
    array([1. , 0.5])
    """
    # The prior's marginal of the target t, the first n of its d components; the others are e.
    target = PartialFusion(prior, received).target
    n = received.dim
    dim = prior.dim
    # Weights of the prior's components l given t at each received mean: w_l N_l(t) / Σ w N(t).
    logs = target.log_weights + target.component_log_densities(received.means)
    shares = np.exp(logs - log_sum_exp(logs))

    # Each received component meets each component's p(e | t): one joint Gaussian a pair.
    # The gains of e on t, (L, d - n, n), and the covariances of e given t.
    gain, conditional = regression(prior, n)
    # Means (L', L, d) of L' received and L prior components: e moves with t by the gain.
    differences = received.means[:, None] - prior.means[:, :n]
    ego_means = prior.means[:, n:] + (gain @ differences[..., None])[..., 0]
    target_means = np.broadcast_to(received.means[:, None], differences.shape)
    means = np.concatenate([target_means, ego_means], axis=-1).reshape(-1, dim)
    covs = assemble_joint(received.covs[:, None], gain, conditional)
    covs = covs.reshape(-1, dim, dim)

    weights = (received.weights[:, None] * shares).ravel() * (1 - omega)
    # The prior's components with the weight ω, and these with 1 - ω
    positive = weights > 0
    return GaussianMixture.construct(
        np.concatenate([omega * prior.weights, weights[positive]]),
        np.concatenate([prior.means, means[positive]]),
        np.concatenate([prior.covs, covs[positive]]),
    )


def align_mixture(
    mixture: GaussianMixture, reference: Array, periods: Periods
) -> GaussianMixture:
    """Bring the angles of a mixture's means onto the branch of a reference (d,): within a turn."""
    means = align(mixture.means, reference, periods)
    if means is mixture.means:
        return mixture
    return GaussianMixture.construct(mixture.weights, means, mixture.covs)


@fusion_rule("mixtures")
@validated
def target_fusion(
    beliefs: Sequence[GaussianMixture],
    channel: Channel,
    *,
    target_dim: PositiveInt,
    fuse: Callable[..., GaussianMixture] = fuse_mixtures,
) -> tuple[GaussianMixture, ...]:
    """Broadcast every agent's belief about the target, and fuse each belief with those received.

    The belief of an agent that receives nothing stays. With :func:`functools.partial` for the
    options it is the ``fusion=`` of a filter of mixtures.

    Parameters
    ----------
    beliefs : sequence of GaussianMixture, length A
        Each agent's belief about [target; its own state]; own states may differ in size.
    channel : Channel
        Delivers the messages. A component costs 1 + n + n(n+1)/2 scalars a link.
    target_dim : int
        The first n components of every state are the target's.
    fuse : callable
        ``fuse(prior, received) -> mixture``, such as :func:`fuse_mixtures`, :func:`fuse_moments`
        and :func:`fuse_sequentially`.

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
    indices = range(target_dim)
    periods = channel.periods[:target_dim]
    targets = [belief.marginal(indices) for belief in beliefs]
    messages = [target.pack() for target in targets]
    received = _unpack_messages(channel.broadcast(messages))
    for agent, of_agent in enumerate(received):
        # Angles on the branch of the receiver's.
        mean = beliefs[agent].mean[:target_dim]
        received[agent] = [align_mixture(m, mean, periods) for m in of_agent]
    if fuse is fuse_mixtures:
        # All agents in one call. If that fails, the loop below finds out which agent's fusion does.
        with suppress(np.linalg.LinAlgError):
            fused = _fuse_together(beliefs, targets, received)
            # Raises the error if a covariance is not positive definite.
            factor_together(fused)
            return tuple(fused)
    # Agent by agent, so that an error names the agent.
    fused = list(beliefs)
    for agent, of_agent in enumerate(received):
        try:
            if of_agent:
                fused[agent] = call_user(fuse, fused[agent], of_agent)
            # The factors are computed here, so that an error names this agent.
            fused[agent].factors  # noqa: B018
        except np.linalg.LinAlgError as error:
            raise np.linalg.LinAlgError(f"agent {agent}: {error}") from error
    return tuple(fused)


def _unpack_messages(
    inbox: Sequence[dict[int, tuple[Array, Array, Array]]],
) -> list[list[GaussianMixture]]:
    """Return the mixtures that each agent has received, in the order of the senders.

    A message that arrives unchanged at several agents is one mixture, of which all use the caches.
    """
    # The payloads live as long as the inbox, so that their ids belong to one each.
    unpacked: dict[int, GaussianMixture] = {}
    received = []
    for payloads in inbox:
        for payload in payloads.values():
            if id(payload) not in unpacked:
                unpacked[id(payload)] = GaussianMixture.unpack(payload)
        received.append([unpacked[id(payload)] for payload in payloads.values()])
    return received


def _fuse_together(
    beliefs: Sequence[GaussianMixture],
    targets: Sequence[GaussianMixture],
    received: Sequence[list[GaussianMixture]],
) -> list[GaussianMixture]:
    """Fuse each belief with those received as `fuse_mixtures` does, many in one call.

    The `targets` are the beliefs' marginals in the components that the messages are about.
    """
    # Each message once, by its identity. All precisions are computed in one call, and each mixture
    # stores its own.
    messages = {id(m): m for of_agent in received for m in of_agent}
    invert_together(list(messages.values()))
    # Receivers whose dimension, and whose messages, have the same sizes
    alike: dict[tuple[int, ...], list[int]] = {}
    for agent, of_agent in enumerate(received):
        sizes = tuple([m.n_components for m in of_agent])
        if sizes:
            alike.setdefault((beliefs[agent].dim, *sizes), []).append(agent)
    # Agents that have received nothing keep their beliefs.
    fused = list(beliefs)
    for agents in alike.values():
        results = fuse_by_receiver(
            [beliefs[agent] for agent in agents],
            [targets[agent] for agent in agents],
            [received[agent] for agent in agents],
        )
        for agent, new in zip(agents, results, strict=True):
            fused[agent] = new
    return fused
