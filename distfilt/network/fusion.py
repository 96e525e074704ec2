"""Fusion rules for Gaussians and ensembles with errors of unknown correlation.

A filter takes one as its ``fusion=``, with :func:`functools.partial` for the options.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Annotated, Literal

import numpy as np
from scipy.linalg.lapack import dposv

from ..ensembles import match_moments, mean, sample_covariance
from ..gaussians import intersection_weights
from ..linalg import EPS, cholesky, identity, solve_lower, symmetrise
from ..periods import Periods, wrap_differences
from ..validation import (
    Array,
    ArrayInput,
    Bounds,
    Mask,
    NonNegativeFloat,
    PositiveFloat,
    PositiveInt,
    check_positive_definite,
    validated,
)
from .channel import Channel, fusion_rule
from .consensus import _warn_if_disconnected
from .graphs import Graph
from .weights import ConsensusWeights, _laplacian_weights, _warn_if_unstable

__all__ = [
    "arithmetic_average",
    "consensus_pull",
    "covariance_intersection",
    "intersect_ensembles",
    "naive_fusion",
    "mean_pull",
]


def _find_uncertain(covs: Array) -> Mask:
    """Return which components have a variance, (d,); the others are constants known to all."""
    # The usual case: all variances are positive.
    variances = covs.diagonal(axis1=-2, axis2=-1)
    if np.count_nonzero(variances) == variances.size:
        return np.ones(covs.shape[-1], dtype=bool)
    # A component with a covariance but no variance is left to the check of definiteness.
    rows = (covs != 0).reshape(-1, covs.shape[-1])
    return np.asarray(rows.any(axis=0))


def _check_definite_or_known(value: Array, name: str) -> None:
    """Refuse covariances that are not positive definite in the components that are not known."""
    is_uncertain = _find_uncertain(value)
    if not is_uncertain.all():
        value = value[..., is_uncertain, :][..., is_uncertain]
    if value.size:
        check_positive_definite(value, name)


Gaussians = tuple[
    Annotated[ArrayInput, "*channel.runs channel.graph.n_agents d"],
    Annotated[
        ArrayInput,
        "*channel.runs channel.graph.n_agents d d",
        _check_definite_or_known,
    ],
]
Ensembles = Annotated[ArrayInput, "*channel.runs channel.graph.n_agents N d"]
Pair = tuple[Array, Array]
"""Means (*runs, A, d) and covariances; or self-weights (R, A) and link weights (R, E)."""

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
    r"""Fuse each Gaussian with the neighbours' by covariance intersection.

    .. math:: \mathbf P^{-1}=\sum_j\omega_j\mathbf P_j^{-1},\qquad
        \mathbf P^{-1}\mathbf m=\sum_j\omega_j\mathbf P_j^{-1}\mathbf m_j,\qquad
        \sum_j\omega_j=1

    The result is the weighted geometric mean of the densities. As the weights sum to
    one, no information is counted twice. If every input's covariance is an upper bound
    of the covariance of its error, so is the result's, for any correlation of the
    errors.

    Parameters
    ----------
    belief : tuple (means, covs)
        Each agent's mean, (*runs, A, d), and covariance, (*runs, A, d, d), positive
        definite. A component that has no variance at any agent is a constant known to
        all: it needs equal means, and is not sent.
    channel : Channel
        Mean and covariance are sent on each link, d + d(d+1)/2 scalars. A lost message
        is left out.
    rule : {"equal", "trace", "determinant", "min_trace", "min_determinant"}
        The weights ω: see :func:`distfilt.gaussians.intersection_weights`.
    rounds : int
        Number of rounds.

    Notes
    -----
    S. J. Julier and J. K. Uhlmann, American Control Conference (1997) 2369-2373. The
    weights in closed form: W. Niehsen, FUSION (2002) 110-113.

    Examples
    --------
    >>> from distfilt.network import Channel, graphs
    >>> two = covariance_intersection(
    ...     ([[0.0], [3.0]], [[[1.0]], [[2.0]]]), Channel(graphs.path(2)), rule="trace"
    ... )
    >>> two[0].ravel().round(6), two[1].ravel().round(6)
    (array([0.6, 0.6]), array([1.2, 1.2]))
    """
    if rounds > 1:
        _warn_if_disconnected(channel)
    return _intersect(belief, channel, rule, rounds, channel.periods)


def _intersect(
    belief: Pair, channel: Channel, rule: Rule, rounds: int, periods: Periods
) -> Pair:
    """Fuse Gaussians by covariance intersection, without checks.

    `periods` has an entry for each component of the belief; () if none is circular. The rule names
    the weights; an exchange takes place in each of the rounds.
    """

    def fuse(received: _Received) -> Pair:
        # Where known constants are left out of the exchange, `received` has the periods of the
        # other components already.
        if len(periods) == received.means.shape[-1]:
            received.periods = periods
        self_weights, link_weights = _intersection_weights(received, rule)
        return _sum_information(received, self_weights, link_weights)

    # An exchange of Gaussians in each round, and then their fusion
    return _repeat(belief, channel, rounds, fuse)


@fusion_rule("gaussians")
@validated
def naive_fusion(
    belief: Gaussians, channel: Channel, *, rounds: PositiveInt = 1
) -> Pair:
    """Multiply the densities as if their errors were independent, which counts shared data twice.

    Right for a single fusion of independent estimates. Wrong as soon as agents exchange
    fused estimates: the covariance shrinks in every round, the error does not. A
    baseline that shows it. Parameters, returns and errors as for
    :func:`covariance_intersection`.

    >>> from distfilt.network import Channel, graphs
    >>> two = naive_fusion(
    ...     ([[0.0], [3.0]], [[[1.0]], [[2.0]]]), Channel(graphs.path(2))
    ... )
    >>> two[1].ravel().round(6)
    array([0.666667, 0.666667])
    """
    if rounds > 1:
        _warn_if_disconnected(channel)

    def fuse(received: _Received) -> Pair:
        # All weights are one: the product of the densities.
        self_weights = np.ones(received.means.shape[:2])
        link_weights = received.arrived.astype(np.float64)
        return _sum_information(received, self_weights, link_weights)

    return _repeat(belief, channel, rounds, fuse)


@fusion_rule("gaussians")
@validated
def arithmetic_average(
    belief: Gaussians, channel: Channel, *, rounds: PositiveInt = 1
) -> Pair:
    r"""Replace each Gaussian by mean and covariance of the mixture of it and the received ones.

    .. math:: \mathbf m=\sum_j\omega_j\mathbf m_j,\qquad
        \mathbf P=\sum_j\omega_j\bigl(\mathbf P_j
        +(\mathbf m_j-\mathbf m)(\mathbf m_j-\mathbf m)^\top\bigr)

    With equal weights. Differences between the means add to the covariance, so that an
    outlier widens it. Parameters, returns and errors as for
    :func:`covariance_intersection`.

    >>> from distfilt.network import Channel, graphs
    >>> two = arithmetic_average(
    ...     ([[0.0], [3.0]], [[[1.0]], [[2.0]]]), Channel(graphs.path(2))
    ... )
    >>> two[0].ravel(), two[1].ravel()
    (array([1.5, 1.5]), array([3.75, 3.75]))
    """
    if rounds > 1:
        _warn_if_disconnected(channel)

    def fuse(received: _Received) -> Pair:
        graph = received.graph
        # Equal weights of the own Gaussian and of those received, (R, A) and (R, E), and the
        # differences m_j - m_i, (R, E, d), which are summed over each agent's links
        self_weights, link_weights = _intersection_weights(received, "equal")
        difference = received.mean_differences()
        shift = graph._sum_by_receiver(link_weights[..., None] * difference, axis=1)
        # The new mean is m = m_i + s with the shift s = Σ_j ω_j (m_j - m_i). The own mean lies at
        # -s from it, a received one at (m_j - m_i) - s.
        deviation = difference - shift[:, graph.receivers]
        weighted = link_weights[..., None, None] * deviation[..., :, None]
        squares = weighted * deviation[..., None, :]
        spread = graph._sum_by_receiver(squares, axis=1)
        # The own mean's part, s sᵀ
        weighted = self_weights[..., None, None] * shift[..., :, None]
        spread += weighted * shift[..., None, :]
        covs = received.sum_matrices(self_weights, link_weights, received.covs)
        return received.means + shift, symmetrise(covs + spread)

    return _repeat(belief, channel, rounds, fuse)


@fusion_rule("gaussians")
@validated
def consensus_pull(
    belief: Gaussians, channel: Channel, *, gain: PositiveFloat, rounds: PositiveInt = 1
) -> Pair:
    r"""Pull each mean towards the neighbours' means, as the Kalman consensus filter does.

    .. math:: \mathbf m_i\leftarrow\mathbf m_i
        +\gamma\sum_j(\mathbf m_j-\mathbf m_i)

    The covariances are not changed. That is cheap, but they do not account for the
    pull, and are wrong as soon as neighbours' errors are correlated.

    Parameters
    ----------
    belief
        As for :func:`covariance_intersection`.
    channel : Channel
        Only means are sent on each link, d scalars. A mean that is lost does not pull.
    gain : float
        The gain γ, positive.
    rounds : int
        Number of rounds.

    Warns
    -----
    UnstableGain
        If the gain is above 2/λ_max, with which the means diverge.

    Notes
    -----
    R. Olfati-Saber, IEEE Conference on Decision and Control (2007) 5492-5498, algorithm
    3, where the gain is a multiple of the covariance.

    Examples
    --------
    >>> from distfilt.network import Channel, graphs
    >>> two = [[0.0], [4.0]], [[[1.0]], [[2.0]]]
    >>> consensus_pull(two, Channel(graphs.path(2)), gain=0.25)[0]
    array([[1.],
           [3.]])
    """
    _warn_if_unstable(channel.graph, gain)
    if rounds > 1:
        _warn_if_disconnected(channel)
    means, covs = belief
    # The weights of the matrix I - γ L; means of angles are mixed by their differences, which wrap.
    weights = _laplacian_weights(channel.graph, gain)
    if channel.periods:
        for _ in range(rounds):
            means, _self_weights = _mix_circular(means, channel, weights)
        return means, covs.copy()
    # m <- (I - γ L) m; the weight of a lost mean stays with the own one.
    means = channel.mix(means, weights, on_loss="keep", rounds=rounds)
    return means, covs.copy()


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
        Only means are sent on each link, d scalars a round. A mean that is lost does
        not pull.
    gain : float
        The gain γ, at least 0; 0 sends nothing and changes nothing.
    rounds : int
        Number of rounds.
    include_self : bool
        Whether Nbs(l) holds l itself, as the paper's tables print. It does not change
        the means. The spread shrinks by the factor 1 - γ|Nbs(l)|, in which l itself
        then counts.

    Warns
    -----
    UnstableGain
        If the gain is above 2/λ_max, with which the means diverge.

    Examples
    --------
    >>> from distfilt.network import Channel, graphs
    >>> two = [[[0.0], [2.0]], [[4.0], [6.0]]]
    >>> mean_pull(two, Channel(graphs.path(2)), gain=0.25, include_self=False)[
    ...     0
    ... ].ravel()
    array([1.25, 2.75])
    """
    pulled = ensembles.copy()
    if gain == 0:
        return np.asarray(pulled)
    _warn_if_unstable(channel.graph, gain)
    if rounds > 1:
        _warn_if_disconnected(channel)
    # The weights of the matrix I - γ L; means of angles are mixed by their differences, which wrap.
    weights = _laplacian_weights(channel.graph, gain)
    for _ in range(rounds):
        means = pulled.mean(axis=-2)
        if channel.periods:
            new_means, self_weights = _mix_circular(means, channel, weights)
        else:
            new_means, self_weights = channel._mix_once(means, weights, "keep")
        # x_i + γ Σ (m_j - x_i) is the mixed mean plus (1 - γ |Nbs|) times the member's deviation
        # from the own mean. The self-weight is 1 - γ times the number of means that arrived.
        factor = (self_weights - gain * include_self)[..., None, None]
        deviations = pulled - means[..., None, :]
        pulled = new_means[..., None, :] + factor * deviations
    return np.asarray(pulled)


@fusion_rule("ensembles")
@validated
def intersect_ensembles(
    ensembles: Ensembles,
    channel: Channel,
    *,
    rule: Rule = "min_determinant",
    scale: Annotated[ArrayInput, "d", Bounds(above=0)] | None = None,
    rounds: PositiveInt = 1,
) -> Array:
    """Fuse sample means and covariances by covariance intersection, and move ensembles to them.

    Consistent for any correlation of the agents' errors, which is strong in a network
    that exchanges observations. The rule is :func:`covariance_intersection`; an affine
    map then gives each ensemble the fused moments.

    Parameters
    ----------
    ensembles : array_like, (*runs, A, N, d)
        One ensemble per agent, N > d.
    channel : Channel
        d + d(d+1)/2 scalars a link and round. A lost message is left out.
    rule : {"equal", "trace", "determinant", "min_trace", "min_determinant"}
        As for :func:`covariance_intersection`.
    scale : array_like, (d,), optional
        A scale of each component. Components are divided by it, so that a trace does
        not add variances of different units.
    rounds : int
        Number of rounds.

    Examples
    --------
    >>> from distfilt.network import Channel, graphs
    >>> two = [[[-1.0], [1.0]], [[2.0], [4.0]]]
    >>> intersect_ensembles(two, Channel(graphs.path(2)), rule="equal")[..., 0]
    array([[0.5, 2.5],
           [0.5, 2.5]])
    """
    if rounds > 1:
        _warn_if_disconnected(channel)
    # Two members or more, before the sample covariances are made of them
    _check_members(ensembles.shape[-2], 1)
    unit = 1.0 if scale is None else scale
    x = ensembles / unit
    means = mean(x)
    covs = sample_covariance(x)
    periods = channel.periods
    if scale is not None:
        periods = _scale_periods(periods, scale)
    # Components that are the same constant for all members of all agents, (d,)
    is_known = find_known(means, covs, periods, "ensembles")
    _check_members(ensembles.shape[-2], int((~is_known).sum()))
    if not np.count_nonzero(is_known):
        fuse = partial(_intersect, rule=rule, rounds=rounds, periods=periods)
        # The affine map of each ensemble to the fused mean and covariance
        return _move_members(x, (means, covs), channel, fuse) * unit
    # A constant that all agents know stays, and is not sent.
    rest = ~is_known
    if rest.any():
        belief = means[..., rest], covs[..., rest, :][..., rest]
        periods = _select_periods(periods, rest)
        fuse = partial(_intersect, rule=rule, rounds=rounds, periods=periods)
        x[..., rest] = _move_members(x[..., rest], belief, channel, fuse)
    return np.asarray(x * unit)


def _move_members(
    x: Array, belief: Pair, channel: Channel, fuse: Callable[[Pair, Channel], Pair]
) -> Array:
    """Move ensembles by the affine map from their sample moments to the fused ones.

    Ensembles x are (..., A, N, d), `belief` has their sample means and covariances, and `fuse`
    fuses those over the channel.
    """
    # Each ensemble gets the fused mean and covariance of its agent.
    try:
        return match_moments(x, *fuse(belief, channel))
    except ValueError:
        # Singular if an ensemble has no more members than components.
        check_positive_definite(belief[1], "ensembles")
        raise


def _check_members(n_members: int, n_components: int) -> None:
    """Refuse ensembles whose sample covariances are singular because they are small."""
    if n_members <= n_components:
        raise ValueError(
            "ensembles must have more members than components that vary, to be fused by their "
            f"covariances, got {n_members} members of {n_components} components"
        )


def find_known(means: Array, covs: Array, periods: Periods, name: str) -> Mask:
    """Return which components are constants that all agents agree on, (d,).

    Means are (..., A, d), covariances (..., A, d, d); `name` is that of the argument.

    >>> means = np.ones((2, 2))
    >>> find_known(means, np.array([np.diag([1.0, 0.0])] * 2), (), "belief")
    array([False,  True])
    >>> find_known(means + [[0.0], [1.0]], np.zeros((2, 2, 2)), (), "belief")
    Traceback (most recent call last):
    ValueError: belief must have equal means where no agent has a variance, got means that ...
    """
    # Members that are all equal vary by rounding alone: by a few units of it, from the sum.
    rounding = 16 * EPS * np.abs(means)
    is_known = np.diagonal(covs, axis1=-2, axis2=-1) <= rounding**2
    by_component = np.asarray(is_known.reshape(-1, means.shape[-1]).all(axis=0))
    if not np.count_nonzero(by_component):
        return by_component
    # Angles may differ by whole turns.
    differences = np.abs(wrap_differences(means - means[..., :1, :], periods))
    differs = differences > rounding.max(axis=-2, keepdims=True)
    if (differs & by_component).any():
        raise ValueError(
            f"{name} must have equal means where no agent has a variance, got means that "
            f"differ by up to {differences[..., by_component].max():g}"
        )
    return by_component


def _scale_periods(periods: Periods, scale: Array) -> Periods:
    """Return periods of components that are divided by a scale."""
    pairs = zip(periods, scale.tolist(), strict=True) if periods else ()
    return tuple([None if p is None else p / s for p, s in pairs])


def _mix_circular(
    means: Array, channel: Channel, weights: ConsensusWeights
) -> tuple[Array, Array]:
    """Mix means (*runs, A, d) by their differences, which wrap, and return the self-weights too.

    m_i + Σ_j w_ij (m_j - m_i); the weight of a lost mean stays with the own one.
    """
    graph = channel.graph
    d = means.shape[-1]
    # All runs in one axis, (R, A, d); then which messages of d numbers arrive, (R, E).
    flat = means.reshape(-1, graph.n_agents, d)
    arrived = channel._transmit_numbers(d)
    difference = flat[:, graph.senders] - flat[:, graph.receivers]
    difference = wrap_differences(difference, channel.periods)
    link_weights = weights.link_weights * arrived
    # Sums over the links to each agent
    shift = graph._sum_by_receiver(link_weights[..., None] * difference, axis=1)
    self_weights = 1.0 - graph._sum_by_receiver(link_weights, axis=1)
    runs = means.shape[:-2]
    mixed = (flat + shift).reshape(means.shape)
    return mixed, self_weights.reshape(*runs, -1)


@dataclass(eq=False)
class _Received:
    """Gaussians of all agents in one round, and which of them have arrived. Runs are one axis."""

    graph: Graph
    means: Array
    """Each agent's mean, (R, A, d)."""
    covs: Array
    """Each agent's covariance, (R, A, d, d)."""
    arrived: Mask
    """Whether the sender's Gaussian has arrived on each link, (R, E)."""
    periods: Periods = ()

    def sum_matrices(
        self, self_weights: Array, link_weights: Array, matrices: Array
    ) -> Array:
        """Return weighted sums of each agent's matrix, of (R, A, d, d), and the received ones."""
        # Weights (R, A) and (R, E) broadcast over the matrices' own axes.
        sent = link_weights[..., None, None] * matrices[:, self.graph.senders]
        own_part = self_weights[..., None, None] * matrices
        return own_part + self.graph._sum_by_receiver(sent, axis=1)

    def mean_differences(self) -> Array:
        """Return the received mean minus the receiver's, for each link, (R, E, d).

        Angles differ by the shorter way round.
        """
        of_sender = self.means.take(self.graph.senders, axis=1)
        difference = of_sender - self.means.take(self.graph.receivers, axis=1)
        if self.periods:
            difference = wrap_differences(difference, self.periods)
        return difference


def _repeat(
    belief: Pair, channel: Channel, rounds: int, fuse: Callable[[_Received], Pair]
) -> Pair:
    """Exchange means and upper triangles of covariances, and fuse them, in so many rounds.

    `fuse` takes the Gaussians of an exchange, and returns the new means and covariances of all
    agents with runs in one axis, (R, A, d) and (R, A, d, d).
    """
    means, covs = belief
    is_uncertain = _find_uncertain(covs)
    if np.count_nonzero(is_uncertain) < is_uncertain.size:
        return _repeat_uncertain(belief, channel, rounds, fuse, is_uncertain)
    return _repeat_all(belief, channel, rounds, fuse, channel.periods)


def _repeat_uncertain(
    belief: Pair,
    channel: Channel,
    rounds: int,
    fuse: Callable[[_Received], Pair],
    is_uncertain: Mask,
) -> Pair:
    """Do as `_repeat` with the components that have a variance; the others are known constants.

    `is_uncertain` (d,) says which components those are. The other arguments are those of `_repeat`.
    """
    means, covs = belief
    known = means[..., ~is_uncertain]
    if (known != known[..., :1, :]).any():
        raise ValueError(
            "belief must have equal means where no agent has a variance, got means that differ by "
            f"up to {np.ptp(known, axis=-2).max():g}"
        )
    new_means = means.copy()
    new_covs = covs.copy()
    if is_uncertain.any():
        # The rows and columns of these components in the covariances
        rows, columns = np.ix_(is_uncertain, is_uncertain)
        # The same exchange and fusion, of these components alone
        periods = _select_periods(channel.periods, is_uncertain)
        part = (means[..., is_uncertain], covs[..., rows, columns])
        part = _repeat_all(part, channel, rounds, fuse, periods)
        new_means[..., is_uncertain], new_covs[..., rows, columns] = part
    return new_means, new_covs


def _select_periods(periods: Periods, is_chosen: Mask) -> Periods:
    """Return the periods of the chosen components, of (d,) in all; () stays ()."""
    pairs = zip(periods, is_chosen.tolist(), strict=True) if periods else ()
    return tuple([period for period, chosen in pairs if chosen])


def _repeat_all(
    belief: Pair,
    channel: Channel,
    rounds: int,
    fuse: Callable[[_Received], Pair],
    periods: Periods,
) -> Pair:
    """Do as `_repeat` with Gaussians all of whose components have a variance.

    The periods are those of these components.
    """
    means, covs = belief
    graph = channel.graph
    d = means.shape[-1]
    # A mean and the upper triangle of a covariance
    numbers = d + d * (d + 1) // 2
    # All runs in one axis.
    flat_means = means.reshape(-1, graph.n_agents, d)
    flat_covs = covs.reshape(-1, graph.n_agents, d, d)
    for _ in range(rounds):
        # Which messages arrive, (R, E)
        arrived = channel._transmit_numbers(numbers)
        received = _Received(graph, flat_means, flat_covs, arrived, periods)
        flat_means, flat_covs = fuse(received)
    return flat_means.reshape(means.shape), flat_covs.reshape(covs.shape)


def _intersection_weights(received: _Received, rule: Rule) -> Pair:
    """Return self-weights (R, A) and link weights (R, E) that sum to one for each agent.

    The runs are R, the agents A and the links E; a message that has not arrived has no weight.
    """
    if rule.startswith("min"):
        return _optimal_weights(received, rule)
    graph = received.graph
    arrived = received.arrived
    if rule == "equal" and np.count_nonzero(arrived) == arrived.size:
        # Each agent's number of messages belongs to the graph.
        return graph._equal_weights
    size = np.ones(received.means.shape[:2])
    if rule != "equal":
        # Weights are proportional to a size of each covariance, such as 1 / trace: its weight
        # against a unit covariance, divided by that one's. Computed against the unit and not
        # against the other agents' covariances, it has the same digits at every agent.
        unit = np.eye(received.means.shape[-1])
        units = np.broadcast_to(unit, received.covs.shape)
        pairs = np.stack([received.covs, units], axis=-3)
        pair_weights = intersection_weights(pairs, rule=rule)
        size = pair_weights[..., 0] / pair_weights[..., 1]
    link_sizes = size[:, graph.senders] * received.arrived
    total = size + graph._sum_by_receiver(link_sizes, axis=1)
    # Normalise each agent's sizes to weights.
    return size / total, link_sizes / total[:, graph.receivers]


def _optimal_weights(received: _Received, rule: Rule) -> Pair:
    """Return the weights of the smallest result, for all agents of equal degree at once.

    They are self-weights (R, A) and link weights (R, E), of R runs, A agents and E links.
    """
    graph = received.graph
    unit = np.eye(received.means.shape[-1])
    self_weights = np.ones(received.means.shape[:2])
    link_weights = np.zeros(received.arrived.shape)
    # Agents with as many neighbours have as many covariances to weight.
    for degree in np.unique(graph.in_degree):
        agents = np.flatnonzero(graph.in_degree == degree)
        # The links of these agents, (agents, degree): those to agent i begin at indptr[i].
        links = graph.links.indptr[agents, None] + np.arange(int(degree))
        arrived = received.arrived[:, links]
        sent = received.covs[:, graph.senders[links]]
        # A unit matrix stands for a lost covariance, which gets no weight.
        sent = np.where(arrived[..., None, None], sent, unit)
        # The agent's own covariance comes first, and is always present.
        covs = np.concatenate([received.covs[:, agents, None], sent], axis=2)
        present = np.insert(arrived, 0, True, axis=2)
        omega = intersection_weights(covs, rule=rule, present=present)
        self_weights[:, agents] = omega[..., 0]
        link_weights[:, links] = omega[..., 1:]
    return self_weights, link_weights


def _sum_information(
    received: _Received, self_weights: Array, link_weights: Array
) -> Pair:
    """Return mean and covariance of weighted sums of information matrices and vectors.

    For R runs, A agents and E links the weights are (R, A) and (R, E). An information matrix is an
    inverse covariance, P⁻¹, and its vector P⁻¹ m.
    """
    graph = received.graph
    d = received.means.shape[-1]
    # P_j⁻¹ of each agent, (R, A, d, d)
    information = _invert(received.covs)
    # P⁻¹ = Σ_j ω_j P_j⁻¹ and m = m_i + P Σ_j ω_j P_j⁻¹ (m_j - m_i): about the own mean, so that
    # equal means stay and large ones lose no digits. First for each link, by its sender.
    of_sender = information.take(graph.senders, axis=1)
    pull = of_sender @ received.mean_differences()[..., None]
    # One sum over the links for ω_j P_j⁻¹ and, as a further column, for the pull.
    terms = np.concatenate([of_sender, pull], axis=-1)
    terms *= link_weights[..., None, None]
    total = graph._sum_by_receiver(terms, axis=1)
    own_part = self_weights[..., None, None] * information
    covs = _invert(own_part + total[..., :d])
    shift = (covs @ total[..., d:])[..., 0]
    return received.means + shift, symmetrise(covs)


def _invert(spd: Array) -> Array:
    """Return inverses of positive definite matrices, symmetric up to rounding.

    The matrices are (..., d, d).
    """
    d = spd.shape[-1]
    n = math.prod(spd.shape[:-2])
    if n > 2 * d:
        # P = L Lᵀ has the inverse L⁻ᵀ L⁻¹; many matrices are solved row after row.
        unit = np.broadcast_to(identity(d), spd.shape)
        inverse = solve_lower(cholesky(spd), unit)
        return np.asarray(inverse.swapaxes(-1, -2) @ inverse)
    # A few matrices are solved faster one by one, P X = I by Cholesky.
    unit = identity(d)
    solutions = np.empty((n, d, d))
    for k, matrix in enumerate(spd.reshape(n, d, d)):
        _factor, solutions[k], failed = dposv(matrix, unit, lower=1)
        if failed:
            raise np.linalg.LinAlgError("Matrix is not positive definite")
    return solutions.reshape(spd.shape)
