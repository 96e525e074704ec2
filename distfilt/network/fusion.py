"""Fusing Gaussian estimates whose errors may share information nobody kept track of."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..checks import Array, array, choice, count, covariance
from ..linalg import symmetrise
from .channel import Channel

__all__ = ["arithmetic_average", "covariance_intersection", "exchanged", "naive_fusion"]

_WEIGHTS = ("fixed", "trace", "determinant")

Fuse = Callable[[Array, Array, Array], tuple[Array, Array]]
"""Means (S, *runs, d), covariances and who is there (S, *runs), of S sources, to one Gaussian."""

_Upper = tuple[NDArray[np.intp], NDArray[np.intp]]


def covariance_intersection(
    means: ArrayLike,
    covs: ArrayLike,
    channel: Channel,
    *,
    weights: str = "fixed",
    rounds: int = 1,
) -> tuple[Array, Array]:
    r"""Each agent fuses its Gaussian with its neighbours', safely whatever they share.

    .. math:: \mathbf P^{-1}=\sum_j\omega_j\mathbf P_j^{-1},\qquad
        \mathbf P^{-1}\mathbf m=\sum_j\omega_j\mathbf P_j^{-1}\mathbf m_j,\qquad
        \sum_j\omega_j=1

    Weights that sum to one count nothing twice: the geometric mean of the densities. If every
    input's covariance is an upper bound of its error's, so is the result's, for any correlation.

    Parameters
    ----------
    means : array_like, (*runs, A, d)
        Each agent's mean.
    covs : array_like, (*runs, A, d, d)
        Each agent's covariance, positive definite.
    channel : Channel
        Mean and covariance go over each link, d + d(d+1)/2 scalars. What is lost is left out.
    weights : {"fixed", "trace", "determinant"}
        Equal for all that an agent has; inversely proportional to the covariance's trace; or to
        the d-th root of its determinant, which does not depend on units.
    rounds : int
        How many times.

    Returns
    -------
    means : ndarray, (*runs, A, d)
    covs : ndarray, (*runs, A, d, d)

    Notes
    -----
    S. J. Julier and J. K. Uhlmann, American Control Conference (1997) 2369-2373. The weights in
    closed form: W. Niehsen, FUSION (2002) 110-113.

    Examples
    --------
    >>> from distfilt.network import Channel, graphs
    >>> two = covariance_intersection(
    ...     [[0.0], [3.0]], [[[1.0]], [[2.0]]], Channel(graphs.path(2)), weights="trace")
    >>> two[0].ravel().round(6), two[1].ravel().round(6)
    (array([0.6, 0.6]), array([1.2, 1.2]))
    """
    choice(weights, "weights", _WEIGHTS)

    def fuse(m: Array, p: Array, here: Array) -> tuple[Array, Array]:
        omega = _omegas(p, here, weights)
        return _information_sum(m, p, omega)

    return exchanged(means, covs, channel, rounds, fuse)


def naive_fusion(
    means: ArrayLike, covs: ArrayLike, channel: Channel, *, rounds: int = 1
) -> tuple[Array, Array]:
    """Multiply the densities as if their errors were independent: counts shared data twice.

    Right for a single fusion of independent estimates, wrong as soon as agents exchange what they
    fused before: the covariance shrinks in every round, the error does not. Kept to show that.
    Parameters, returns and errors as for :func:`covariance_intersection`.

    Examples
    --------
    >>> from distfilt.network import Channel, graphs
    >>> two = naive_fusion([[0.0], [3.0]], [[[1.0]], [[2.0]]], Channel(graphs.path(2)))
    >>> two[1].ravel().round(6)
    array([0.666667, 0.666667])
    """

    def fuse(m: Array, p: Array, here: Array) -> tuple[Array, Array]:
        return _information_sum(m, p, here.astype(np.float64))

    return exchanged(means, covs, channel, rounds, fuse)


def arithmetic_average(
    means: ArrayLike, covs: ArrayLike, channel: Channel, *, rounds: int = 1
) -> tuple[Array, Array]:
    r"""Each agent takes mean and covariance of the mixture of its own and the heard densities.

    .. math:: \mathbf m=\sum_j\omega_j\mathbf m_j,\qquad
        \mathbf P=\sum_j\omega_j\bigl(\mathbf P_j
        +(\mathbf m_j-\mathbf m)(\mathbf m_j-\mathbf m)^\top\bigr)

    With equal weights. Disagreement adds to the covariance, so an outlier does not go unnoticed.
    Parameters, returns and errors as for :func:`covariance_intersection`.

    Examples
    --------
    >>> from distfilt.network import Channel, graphs
    >>> two = arithmetic_average([[0.0], [3.0]], [[[1.0]], [[2.0]]], Channel(graphs.path(2)))
    >>> two[0].ravel(), two[1].ravel()
    (array([1.5, 1.5]), array([3.75, 3.75]))
    """

    def fuse(m: Array, p: Array, here: Array) -> tuple[Array, Array]:
        omega = here / here.sum(axis=0)
        centre = (omega[..., None] * m).sum(axis=0)
        gap = m - centre
        spread = p + gap[..., :, None] * gap[..., None, :]
        return centre, symmetrise((omega[..., None, None] * spread).sum(axis=0))

    return exchanged(means, covs, channel, rounds, fuse)


def exchanged(
    means: ArrayLike, covs: ArrayLike, channel: Channel, rounds: int, fuse: Fuse
) -> tuple[Array, Array]:
    """Let agents exchange means and covariances, and fuse all that each has, for some rounds.

    Parameters
    ----------
    means, covs, channel, rounds
        As for :func:`covariance_intersection`.
    fuse : callable
        ``fuse(means, covs, here) -> mean, cov`` of S sources: (S, *runs, d), (S, *runs, d, d), and
        (S, *runs) telling which of them arrived; the agent's own comes first.

    Returns
    -------
    means : ndarray, (*runs, A, d)
    covs : ndarray, (*runs, A, d, d)

    Examples
    --------
    The own estimate, whatever the neighbours say:

    >>> from distfilt.network import Channel, graphs
    >>> own = exchanged([[0.0], [3.0]], [[[1.0]], [[2.0]]], Channel(graphs.path(2)), 1,
    ...                 lambda means, covs, here: (means[0], covs[0]))
    >>> own[0].ravel()
    array([0., 3.])
    """
    if not isinstance(channel, Channel):
        raise ValueError(f"channel: needs a Channel, got {type(channel).__name__}")
    m = array(means, "means", (*channel.runs, channel.graph.size, "d"))
    p = covariance(array(covs, "covs", (*m.shape, m.shape[-1])), "covs")
    upper = np.triu_indices(m.shape[-1])
    for _ in range(count(rounds, "rounds")):
        packed = np.concatenate([m, p[..., upper[0], upper[1]]], axis=-1)
        inbox = channel.exchange([packed[..., a, :] for a in range(channel.graph.size)])
        fused = [
            _with_own(m[..., a, :], p[..., a, :, :], inbox[a], upper, fuse)
            for a in range(channel.graph.size)
        ]
        m = np.stack([f[0] for f in fused], axis=-2)
        p = np.stack([f[1] for f in fused], axis=-3)
    return m, p


def _with_own(
    mean: Array, cov: Array, heard: dict[int, Array], upper: _Upper, fuse: Fuse
) -> tuple[Array, Array]:
    """Unpack what one agent heard, put it behind its own, and fuse; lost runs weigh nothing."""
    d = mean.shape[-1]
    means, covs, here = [mean], [cov], [np.ones(mean.shape[:-1], dtype=bool)]
    for packed in heard.values():
        arrived = ~np.isnan(packed[..., 0])
        full = np.zeros((*packed.shape[:-1], d, d))
        full[..., upper[0], upper[1]] = packed[..., d:]
        full[..., upper[1], upper[0]] = packed[..., d:]
        keep = arrived[..., None]
        means.append(np.where(keep, packed[..., :d], 0.0))
        covs.append(np.where(keep[..., None], full, np.eye(d)))
        here.append(arrived)
    return fuse(np.stack(means), np.stack(covs), np.stack(here))


def _omegas(covs: Array, here: Array, rule: str) -> Array:
    if rule == "fixed":
        sizes = np.ones(here.shape)
    elif rule == "trace":
        sizes = np.trace(covs, axis1=-2, axis2=-1)
    else:
        sizes = np.exp(np.linalg.slogdet(covs)[1] / covs.shape[-1])
    weight = here / sizes
    return np.asarray(weight / weight.sum(axis=0))


def _information_sum(means: Array, covs: Array, omega: Array) -> tuple[Array, Array]:
    """Weighted sum of information matrices and vectors, turned back into mean and covariance."""
    d = means.shape[-1]
    eye = np.broadcast_to(np.eye(d), covs.shape)
    information = np.linalg.solve(covs, eye)
    total = symmetrise((omega[..., None, None] * information).sum(axis=0))
    vector = (omega[..., None] * (information @ means[..., None])[..., 0]).sum(axis=0)
    both = np.concatenate([vector[..., None], np.broadcast_to(np.eye(d), total.shape)], axis=-1)
    solved = np.linalg.solve(total, both)
    return np.asarray(solved[..., 0]), symmetrise(solved[..., 1:])
