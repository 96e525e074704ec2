"""Rules by which Gaussians and ensembles agree, whose errors may share what nobody kept track of.

A filter takes one as its ``agreement=``, with :func:`functools.partial` for the options.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np

from ..ensembles import mean, sample_covariance
from ..gaussians import intersection_weights
from ..gaussians.single import match_moments
from ..linalg import cholesky, solve_lower, symmetrise
from ..validation import (
    Array,
    Bounds,
    Mask,
    NonNegativeFloat,
    PositiveFloat,
    PositiveInt,
    check_positive_definite,
    validated,
)
from .channel import Channel, fusion_rule
from .graphs import Graph
from .weights import _laplacian, _warn_if_unstable

__all__ = [
    "arithmetic_average",
    "consensus_pull",
    "covariance_intersection",
    "intersect_ensembles",
    "naive_fusion",
    "mean_pull",
]

Gaussians = tuple[
    Annotated[Array, "*channel.runs channel.graph.n_agents d"],
    Annotated[
        Array, "*channel.runs channel.graph.n_agents d d", check_positive_definite
    ],
]
Ensembles = Annotated[Array, "*channel.runs channel.graph.n_agents N d"]
Pair = tuple[Array, Array]
Rule = Literal["equal", "trace", "determinant", "min_trace", "min_determinant"]


@fusion_rule("gaussians")
@validated
def covariance_intersection(
    belief: Gaussians,
    channel: Channel,
    *,
    rule: Rule = "equal",
    rounds: PositiveInt = 1,
) -> Pair:
    r"""Each agent fuses its Gaussian with its neighbours', safely whatever they share.

    .. math:: \mathbf P^{-1}=\sum_j\omega_j\mathbf P_j^{-1},\qquad
        \mathbf P^{-1}\mathbf m=\sum_j\omega_j\mathbf P_j^{-1}\mathbf m_j,\qquad
        \sum_j\omega_j=1

    Weights that sum to one count nothing twice: the geometric mean of the densities. If every
    input's covariance is an upper bound of its error's, so is the result's, for any correlation.

    Parameters
    ----------
    belief : tuple (means, covs)
        Each agent's mean, (*runs, A, d), and covariance, (*runs, A, d, d), positive definite.
    channel : Channel
        Mean and covariance go over each link, d + d(d+1)/2 scalars. What is lost is left out.
    rule : {"equal", "trace", "determinant", "min_trace", "min_determinant"}
        How an agent weights what it has: see :func:`distfilt.gaussians.intersection_weights`.
    rounds : int
        How many times.

    Notes
    -----
    S. J. Julier and J. K. Uhlmann, American Control Conference (1997) 2369-2373. The weights in
    closed form: W. Niehsen, FUSION (2002) 110-113.

    Examples
    --------
    >>> from distfilt.network import Channel, graphs
    >>> two = covariance_intersection(
    ...     ([[0.0], [3.0]], [[[1.0]], [[2.0]]]), Channel(graphs.path(2)), rule="trace"
    ... )
    >>> two[0].ravel().round(6), two[1].ravel().round(6)
    (array([0.6, 0.6]), array([1.2, 1.2]))
    """

    def step(heard: _Heard) -> Pair:
        return _information_sum(heard, *_by_rule(heard, rule))

    return _in_rounds(belief, channel, rounds, step)


@fusion_rule("gaussians")
@validated
def naive_fusion(
    belief: Gaussians, channel: Channel, *, rounds: PositiveInt = 1
) -> Pair:
    """Multiply the densities as if their errors were independent: counts shared data twice.

    Right for a single fusion of independent estimates, wrong as soon as agents exchange what they
    fused before: the covariance shrinks in every round, the error does not. Kept to show that.
    Parameters, returns and errors as for :func:`covariance_intersection`.

    >>> from distfilt.network import Channel, graphs
    >>> two = naive_fusion(
    ...     ([[0.0], [3.0]], [[[1.0]], [[2.0]]]), Channel(graphs.path(2))
    ... )
    >>> two[1].ravel().round(6)
    array([0.666667, 0.666667])
    """

    def step(heard: _Heard) -> Pair:
        ones = np.ones(heard.means.shape[:2])
        return _information_sum(heard, ones, heard.arrived.astype(np.float64))

    return _in_rounds(belief, channel, rounds, step)


@fusion_rule("gaussians")
@validated
def arithmetic_average(
    belief: Gaussians, channel: Channel, *, rounds: PositiveInt = 1
) -> Pair:
    r"""Each agent takes mean and covariance of the mixture of its own and the heard densities.

    .. math:: \mathbf m=\sum_j\omega_j\mathbf m_j,\qquad
        \mathbf P=\sum_j\omega_j\bigl(\mathbf P_j
        +(\mathbf m_j-\mathbf m)(\mathbf m_j-\mathbf m)^\top\bigr)

    With equal weights. Disagreement adds to the covariance, so an outlier does not go unnoticed.
    Parameters, returns and errors as for :func:`covariance_intersection`.

    >>> from distfilt.network import Channel, graphs
    >>> two = arithmetic_average(
    ...     ([[0.0], [3.0]], [[[1.0]], [[2.0]]]), Channel(graphs.path(2))
    ... )
    >>> two[0].ravel(), two[1].ravel()
    (array([1.5, 1.5]), array([3.75, 3.75]))
    """

    def step(heard: _Heard) -> Pair:
        own, links = _by_rule(heard, "equal")
        gap = heard.gaps()
        moved = heard.graph._summed(links[..., None] * gap, 1)
        # From the new mean: the own one lies -moved away, a heard one gap - moved.
        left = gap - moved[:, heard.graph.receivers]
        spread = links[..., None, None] * left[..., :, None] * left[..., None, :]
        spread = heard.graph._summed(spread, 1)
        spread += own[..., None, None] * moved[..., :, None] * moved[..., None, :]
        covs = heard.mixed(own, links, heard.covs)
        return heard.means + moved, symmetrise(covs + spread)

    return _in_rounds(belief, channel, rounds, step)


@fusion_rule("gaussians")
@validated
def consensus_pull(
    belief: Gaussians, channel: Channel, *, gain: PositiveFloat, rounds: PositiveInt = 1
) -> Pair:
    r"""Pull each mean towards the neighbours': the consensus Kalman filter's step.

    .. math:: \mathbf m_i\leftarrow\mathbf m_i
        +\gamma\sum_j(\mathbf m_j-\mathbf m_i)

    The covariances stay as they are: the pull is not in them, which is cheap, and wrong as soon as
    neighbours' errors are correlated.

    Parameters
    ----------
    belief
        As for :func:`covariance_intersection`.
    channel : Channel
        Only means go over each link, d scalars. A mean that is lost does not pull.
    gain : float
        The gain γ, positive.
    rounds : int
        How many times.

    Warns
    -----
    UnstableGain
        If the gain is above 2/λ_max, so that the means drift apart.

    Notes
    -----
    R. Olfati-Saber, IEEE Conference on Decision and Control (2007) 5492-5498, algorithm 3, where
    the gain is a multiple of the covariance.

    Examples
    --------
    >>> from distfilt.network import Channel, graphs
    >>> two = [[0.0], [4.0]], [[[1.0]], [[2.0]]]
    >>> consensus_pull(two, Channel(graphs.path(2)), gain=0.25)[0]
    array([[1.],
           [3.]])
    """
    _warn_if_unstable(channel.graph, gain)
    weights = _laplacian(channel.graph, gain)
    combine = channel.mix
    return combine(belief[0], weights, lost="keep", rounds=rounds), belief[1].copy()


@fusion_rule("ensembles")
@validated
def mean_pull(
    ensembles: Ensembles,
    channel: Channel,
    *,
    gain: NonNegativeFloat,
    rounds: PositiveInt = 1,
    include_self: bool = True,
) -> Array:
    r"""Pull every member towards the neighbours' ensemble means, equation (16) of Grange et al.

    .. math:: \mathbf x_i^l \leftarrow \mathbf x_i^l
        + \gamma\sum_{l'\in\mathrm{Nbs}(l)}(\hat{\mathbf x}^{l'}-\mathbf x_i^l)

    Parameters
    ----------
    ensembles : array_like, (*runs, A, N, d)
        One ensemble per agent.
    channel : Channel
        Only means go over each link, d scalars a round. A mean that is lost does not pull.
    gain : float
        The gain γ, at least 0; 0 sends nothing and changes nothing.
    rounds : int
        How many times.
    include_self : bool
        Whether Nbs(l) holds l itself, as the paper's tables print. The means do not notice, but
        the spread shrinks by 1 - γ|Nbs(l)| either way, one neighbour more with it.

    Warns
    -----
    UnstableGain
        If the gain is above 2/λ_max, so that the means drift apart.

    Examples
    --------
    >>> from distfilt.network import Channel, graphs
    >>> two = [[[0.0], [2.0]], [[4.0], [6.0]]]
    >>> mean_pull(two, Channel(graphs.path(2)), gain=0.25, include_self=False)[
    ...     0
    ... ].ravel()
    array([1.25, 2.75])
    """
    out = ensembles.copy()
    if gain == 0:
        return out
    _warn_if_unstable(channel.graph, gain)
    weights = _laplacian(channel.graph, gain)
    for _ in range(rounds):
        centre = out.mean(axis=-2)
        moved, own = channel._combine_with_own(centre, weights, "keep")
        kept = (own - gain * include_self)[..., None, None]
        out = moved[..., None, :] + kept * (out - centre[..., None, :])
    return out


@fusion_rule("ensembles")
@validated
def intersect_ensembles(
    ensembles: Ensembles,
    channel: Channel,
    *,
    rule: Rule = "min_determinant",
    scale: Annotated[Array, "d", Bounds(above=0)] | None = None,
    rounds: PositiveInt = 1,
) -> Array:
    """Fuse sample means and covariances by intersection, and move each ensemble to have those.

    Safe whatever the agents' errors share, which in a network that exchanges observations is much.

    Parameters
    ----------
    ensembles : array_like, (*runs, A, N, d)
        One ensemble per agent, N > d.
    channel : Channel
        d + d(d+1)/2 scalars a link and round. Whoever misses a message fuses without it.
    rule : {"equal", "trace", "determinant", "min_trace", "min_determinant"}
        As for :func:`covariance_intersection`.
    scale : array_like, (d,), optional
        A size of each component, by which to divide before traces add variances of unlike units.
    rounds : int
        How many times.

    Examples
    --------
    >>> from distfilt.network import Channel, graphs
    >>> two = [[[-1.0], [1.0]], [[2.0], [4.0]]]
    >>> intersect_ensembles(two, Channel(graphs.path(2)), rule="equal")[..., 0]
    array([[0.5, 2.5],
           [0.5, 2.5]])
    """
    size = 1.0 if scale is None else scale
    x = ensembles / size
    belief = mean(x), sample_covariance(x)
    check_positive_definite(belief[1], "ensembles")
    fused = covariance_intersection(belief, channel, rule=rule, rounds=rounds)
    return match_moments(x, *fused) * size


@dataclass(eq=False)
class _Heard:
    """One round's Gaussians, runs in one axis, and the links (R, E) over which they are heard."""

    graph: Graph
    means: Array
    covs: Array
    arrived: Mask

    def mixed(self, own: Array, links: Array, matrices: Array) -> Array:
        """Weighted sums of matrices (R, A, d, d), the own one and what each sender sent."""
        heard = links[..., None, None] * matrices[:, self.graph.senders]
        return own[..., None, None] * matrices + self.graph._summed(heard, 1)

    def gaps(self) -> Array:
        """The heard mean less the own one, on each link, (R, E, d)."""
        return self.means[:, self.graph.senders] - self.means[:, self.graph.receivers]


def _in_rounds(
    belief: Pair, channel: Channel, rounds: int, step: Callable[[_Heard], Pair]
) -> Pair:
    """Exchange means and upper triangles and take a step, some times."""
    means, covs = belief
    graph = channel.graph
    d = means.shape[-1]
    m = means.reshape(-1, graph.n_agents, d)
    p = covs.reshape(-1, graph.n_agents, d, d)
    for _ in range(rounds):
        m, p = step(_Heard(graph, m, p, channel._sent(d + d * (d + 1) // 2)))
    return m.reshape(means.shape), p.reshape(covs.shape)


def _by_rule(heard: _Heard, rule: Rule) -> Pair:
    """Own weights (R, A) and those of links (R, E); each agent's sum to one."""
    if rule.startswith("min"):
        return _least(heard, rule)
    own = np.ones(heard.means.shape[:2])
    unit = np.eye(heard.means.shape[-1])
    if rule != "equal":
        # The odds against a unit covariance: no agent's number depends on another's in any digit.
        both = np.stack([heard.covs, np.broadcast_to(unit, heard.covs.shape)], axis=-3)
        share = intersection_weights(both, rule=rule)
        own = share[..., 0] / share[..., 1]
    links = own[:, heard.graph.senders] * heard.arrived
    total = own + heard.graph._summed(links, 1)
    return own / total, links / total[:, heard.graph.receivers]


def _least(heard: _Heard, rule: Rule) -> Pair:
    """The weights of least size, for all agents at once that hear equally many."""
    graph = heard.graph
    unit = np.eye(heard.means.shape[-1])
    own = np.ones(heard.means.shape[:2])
    links = np.zeros(heard.arrived.shape)
    for degree in np.unique(graph.in_degree):
        agents = np.flatnonzero(graph.in_degree == degree)
        at = graph.links.indptr[agents, None] + np.arange(int(degree))
        got = heard.arrived[:, at]
        sent = np.where(got[..., None, None], heard.covs[:, graph.senders[at]], unit)
        covs = np.concatenate([heard.covs[:, agents, None], sent], axis=2)
        here = np.insert(got, 0, True, axis=2)
        omega = intersection_weights(covs, rule=rule, here=here)
        own[:, agents] = omega[..., 0]
        links[:, at] = omega[..., 1:]
    return own, links


def _information_sum(heard: _Heard, own: Array, links: Array) -> Pair:
    """Weighted sum of information matrices and vectors, turned back into mean and covariance."""
    information = _inverse(heard.covs)
    total = _inverse(heard.mixed(own, links, information))
    # About the own mean, so that equal means stay and large ones lose no digits.
    turned = (information[:, heard.graph.senders] @ heard.gaps()[..., None])[..., 0]
    pulled = heard.graph._summed(links[..., None] * turned, 1)
    moved = (total @ pulled[..., None])[..., 0]
    return heard.means + moved, symmetrise(total)


def _inverse(spd: Array) -> Array:
    """Inverse of positive definite matrices by the inverse of their Cholesky factors."""
    lower = cholesky(spd)
    half = solve_lower(lower, np.broadcast_to(np.eye(spd.shape[-1]), spd.shape))
    return np.asarray(half.swapaxes(-1, -2) @ half)
