"""Fusing Gaussian estimates whose errors may share information nobody kept track of."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from ..checks import Array, array, choice, count, covariance, instance, number
from ..gaussians import _intersection_weights
from ..linalg import _solve_lower, _symmetrise
from . import weights as weighting
from ._neighbourhood import Heard, in_rounds
from .channel import Channel
from .consensus import fuses, warn_if_unstable
from .links import Graph
from .weights import Weights

__all__ = [  # fmt: skip
    "arithmetic_average", "consensus_pull", "covariance_intersection", "naive_fusion",
]

Belief = tuple[ArrayLike, ArrayLike]

RULES = ("equal", "trace", "determinant", "min_trace", "min_determinant")


@fuses("gaussians")
def covariance_intersection(
    belief: Belief, channel: Channel, *, rule: str = "equal",
    weights: Weights | ArrayLike | None = None, rounds: int = 1,
) -> tuple[Array, Array]:
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
        How an agent weights what it has: see
        :func:`distfilt.gaussians.intersection_weights`.
    weights : Weights or array_like, (A, A), optional
        Given weights instead of a rule, nonnegative, each row's sum one. Where messages are lost,
        those of what arrived are scaled up to one again.
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
    ...     ([[0.0], [3.0]], [[[1.0]], [[2.0]]]), Channel(graphs.path(2)), rule="trace")
    >>> two[0].ravel().round(6), two[1].ravel().round(6)
    (array([0.6, 0.6]), array([1.2, 1.2]))
    """
    return _intersected(*_checked(belief, channel), channel, rule, weights, rounds)


def _intersected(
    means: Array, covs: Array, channel: Channel, rule: str, weights: Weights | ArrayLike | None,
    rounds: int,
) -> tuple[Array, Array]:
    """The same of arrays that were checked."""
    choice(rule, "rule", RULES)
    given = None if weights is None else _given(channel.graph, weights)

    def step(heard: Heard) -> tuple[Array, Array]:
        if given is None:
            own, links = _by_rule(heard, rule)
        else:
            own, links = _shared(np.broadcast_to(given.own, heard.means.shape[:2]),
                                 given.links * heard.arrived, heard)
        return _information_sum(heard, own, links)

    return in_rounds(means, covs, channel, rounds, step)


def _given(graph: Graph, weights: Weights | ArrayLike) -> Weights:
    w = Weights.from_matrix(graph, weights, name="weights")
    least = min(w.own.min(), w.links.min(initial=0.0))
    if least < 0 or w.own.min() <= 0:
        raise ValueError(f"weights: needs positive own weights and no negative ones, got {least:g}")
    rows = w.own + graph.incidence @ w.links
    worst = int(np.abs(rows - 1).argmax())
    if abs(rows[worst] - 1) > 1e-8:
        raise ValueError(
            f"weights: needs rows that sum to 1, got {rows[worst]:.6g} for agent {worst}"
        )
    return w


def _by_rule(heard: Heard, rule: str) -> tuple[Array, Array]:
    """Own weights (R, A) and those of links (R, E); each agent's sum to one."""
    graph = heard.graph
    if rule == "equal":
        ones = np.ones(heard.means.shape[:2])
        return _shared(ones, heard.arrived.astype(np.float64), heard)
    if rule in ("trace", "determinant"):
        mine = _size_weights(heard.covs, rule)
        sent = mine if heard.sent_covs is heard.covs else _size_weights(heard.sent_covs, rule)
        return _shared(mine, sent[:, graph.senders] * heard.arrived, heard)
    own, links = np.empty(heard.means.shape[:2]), np.zeros(heard.arrived.shape)
    for agents, at in heard.groups():
        _, covs, here = heard.collected(agents, at)
        omega = _intersection_weights(covs, rule, here)
        own[:, agents], links[:, at] = omega[..., 0], omega[..., 1:]
    return own, links


def _size_weights(covs: Array, rule: str) -> Array:
    """Weights in closed form up to a factor: a number of each source alone, (R, A).

    The odds against a unit covariance: no agent's number depends on another's, not even in its
    last digit.
    """
    unit = np.broadcast_to(np.eye(covs.shape[-1]), covs.shape)
    both = np.stack([covs, unit], axis=-3)
    share = _intersection_weights(both, rule, np.ones(both.shape[:-2], dtype=bool))
    return np.asarray(share[..., 0] / share[..., 1])


def _shared(own: Array, links: Array, heard: Heard) -> tuple[Array, Array]:
    total = own + heard.sums(links)
    return own / total, links / total[:, heard.graph.receivers]


@fuses("gaussians")
def naive_fusion(belief: Belief, channel: Channel, *, rounds: int = 1) -> tuple[Array, Array]:
    """Multiply the densities as if their errors were independent: counts shared data twice.

    Right for a single fusion of independent estimates, wrong as soon as agents exchange what they
    fused before: the covariance shrinks in every round, the error does not. Kept to show that.
    Parameters, returns and errors as for :func:`covariance_intersection`.

    >>> from distfilt.network import Channel, graphs
    >>> two = naive_fusion(([[0.0], [3.0]], [[[1.0]], [[2.0]]]), Channel(graphs.path(2)))
    >>> two[1].ravel().round(6)
    array([0.666667, 0.666667])
    """

    def step(heard: Heard) -> tuple[Array, Array]:
        ones = np.ones(heard.means.shape[:2])
        return _information_sum(heard, ones, heard.arrived.astype(np.float64))

    return in_rounds(*_checked(belief, channel), channel, rounds, step)


@fuses("gaussians")
def arithmetic_average(belief: Belief, channel: Channel, *, rounds: int = 1) -> tuple[Array, Array]:
    r"""Each agent takes mean and covariance of the mixture of its own and the heard densities.

    .. math:: \mathbf m=\sum_j\omega_j\mathbf m_j,\qquad
        \mathbf P=\sum_j\omega_j\bigl(\mathbf P_j
        +(\mathbf m_j-\mathbf m)(\mathbf m_j-\mathbf m)^\top\bigr)

    With equal weights. Disagreement adds to the covariance, so an outlier does not go unnoticed.
    Parameters, returns and errors as for :func:`covariance_intersection`.

    >>> from distfilt.network import Channel, graphs
    >>> two = arithmetic_average(([[0.0], [3.0]], [[[1.0]], [[2.0]]]), Channel(graphs.path(2)))
    >>> two[0].ravel(), two[1].ravel()
    (array([1.5, 1.5]), array([3.75, 3.75]))
    """

    def step(heard: Heard) -> tuple[Array, Array]:
        own, links = _by_rule(heard, "equal")
        gap = heard.gaps()
        moved = heard.sums(links[..., None] * gap)
        # From the new mean: the own one lies -moved away, a heard one gap - moved.
        left = gap - moved[:, heard.graph.receivers]
        spread = heard.sums(links[..., None, None] * left[..., :, None] * left[..., None, :])
        spread += own[..., None, None] * moved[..., :, None] * moved[..., None, :]
        covs = heard.mixed(own, links, heard.covs, heard.sent_covs)
        return heard.means + moved, _symmetrise(covs + spread)

    return in_rounds(*_checked(belief, channel), channel, rounds, step)


@fuses("gaussians")
def consensus_pull(
    belief: Belief, channel: Channel, *, gain: float, rule: str = "scalar", rounds: int = 1
) -> tuple[Array, Array]:
    r"""Pull each mean towards the neighbours': the consensus Kalman filter's step.

    .. math:: \mathbf m_i\leftarrow\mathbf m_i
        +\boldsymbol\Gamma_i\sum_j(\mathbf m_j-\mathbf m_i),\qquad
        \boldsymbol\Gamma_i=\gamma\mathbf I\ \text{ or }\
        \gamma\frac{\mathbf P_i}{1+\|\mathbf P_i\|_F}

    The covariances stay as they are: the pull is not in them, which is cheap, and wrong as soon as
    neighbours' errors are correlated.

    Parameters
    ----------
    belief
        As for :func:`covariance_intersection`.
    channel : Channel
        Only means go over each link, d scalars. A mean that is lost does not pull.
    gain : float
        The gain γ, at least 0; 0 sends nothing and changes nothing.
    rule : {"scalar", "covariance"}
        The same gain for all components, or more where an agent is less sure.
    rounds : int
        How many times.

    Warns
    -----
    UnstableGain
        If the gain is above 2/λ_max, so that the means drift apart.

    Notes
    -----
    R. Olfati-Saber, IEEE Conference on Decision and Control (2007) 5492-5498, algorithm 3.

    Examples
    --------
    >>> from distfilt.network import Channel, graphs
    >>> two = [[0.0], [4.0]], [[[1.0]], [[2.0]]]
    >>> consensus_pull(two, Channel(graphs.path(2)), gain=0.25)[0]
    array([[1.],
           [3.]])
    """
    m, p = _checked(belief, channel)
    g = number(gain, "gain", at_least=0)
    choice(rule, "rule", ("scalar", "covariance"))
    needed = count(rounds, "rounds")
    if g == 0:
        return m.copy(), p.copy()
    trust = np.broadcast_to(np.eye(m.shape[-1]), p.shape)
    largest = 1.0
    if rule == "covariance":
        norm = np.sqrt((p**2).sum(axis=(-2, -1), keepdims=True))
        trust = p / (1 + norm)
        largest = float((norm / (1 + norm)).max())
    warn_if_unstable(channel.graph, g * largest)
    weights = weighting.laplacian(channel.graph, g)
    for _ in range(needed):
        change = channel.combine(m, weights, lost="keep") - m
        m = m + (trust @ change[..., None])[..., 0]
    return m, p.copy()


def _checked(belief: Belief, channel: Channel) -> tuple[Array, Array]:
    instance(channel, "channel", Channel)
    if not isinstance(belief, tuple | list) or len(belief) != 2:
        raise ValueError(f"belief: needs a pair (means, covs), got {type(belief).__name__}")
    m = array(belief[0], "belief", (*channel.runs, channel.graph.size, "d"))
    return m, covariance(array(belief[1], "belief", (*m.shape, m.shape[-1])), "belief")


def _information_sum(heard: Heard, own: Array, links: Array) -> tuple[Array, Array]:
    """Weighted sum of information matrices and vectors, turned back into mean and covariance.

    The same as :func:`distfilt.gaussians.intersection`, for all neighbourhoods at once.
    """
    mine = _inverse(heard.covs)
    sent = mine if heard.sent_covs is heard.covs else _inverse(heard.sent_covs)
    total = _inverse(heard.mixed(own, links, mine, sent))
    # About the own mean, so that equal means stay and large ones lose no digits.
    turned = (sent[:, heard.graph.senders] @ heard.gaps()[..., None])[..., 0]
    moved = (total @ heard.sums(links[..., None] * turned)[..., None])[..., 0]
    return heard.means + moved, _symmetrise(total)


def _inverse(spd: Array) -> Array:
    """Inverse of positive definite matrices by the inverse of their Cholesky factors."""
    lower: Array = np.asarray(np.linalg.cholesky(spd), dtype=np.float64)
    half = _solve_lower(lower, np.broadcast_to(np.eye(spd.shape[-1]), spd.shape))
    return np.asarray(half.swapaxes(-1, -2) @ half)
