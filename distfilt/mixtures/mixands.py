"""The mixands of a fused density: their shapes by products of Gaussians, their least squares."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import svdvals
from scipy.optimize import nnls

from ..doors import Array, Bounds, Index, Mask, Record, definite, door, unchecked
from ..linalg import SolverError, symmetrise
from .gaussian import GaussianMixture, inverse

__all__ = ["Shapes", "conditional_shapes", "literal_shapes", "nonnegative_least_squares",
           "tikhonov"]  # fmt: skip

_CONDITION = 1e10


@dataclass(frozen=True, eq=False)
class Shapes(Record):
    """Mixands before they are weighed.

    Parameters
    ----------
    means : array_like, (S, d)
    covs : array_like, (S, d, d)
        Positive definite.
    source : array_like of int, (S,)
        The own mixand that each came from.
    dropped : int
        How many others were left out because they had no positive definite covariance.

    Examples
    --------
    >>> Shapes([[0.0]], [[[1.0]]], [0]).size
    1
    """

    means: Annotated[Array, "s d"]
    covs: Annotated[Array, "s d d", definite]
    source: Annotated[NDArray[np.intp], "s", Bounds(at_least=0)]
    dropped: Index = 0

    @property
    def size(self) -> int:
        """Number of mixands, S."""
        return int(self.means.shape[0])

    @door
    def select(self, keep: Mask | NDArray[np.intp]) -> Shapes:
        """Some of the mixands, by a mask or by indices.

        Examples
        --------
        >>> Shapes([[0.0], [1.0]], [[[1.0]], [[2.0]]], [0, 0]).select([1]).means
        array([[1.]])
        """
        return self.unchecked(self.means[keep], self.covs[keep], self.source[keep], self.dropped)

    def equally_weighed(self) -> GaussianMixture:
        """A mixture of these mixands with equal weights."""
        return GaussianMixture.unchecked(np.full(self.size, 1 / self.size), self.means, self.covs)


def _told(sent: Sequence[GaussianMixture], w: Array, about: Array) -> tuple[Array, Array]:
    """Information (Q, T, n, n) and vectors (Q, T, n) of the product of the others' powers.

    One term for each choice of a mixand from each, with vectors relative to points (Q, n).
    """
    q, n = about.shape
    information, pull = np.zeros((q, 1, n, n)), np.zeros((q, 1, n))
    for weight, other in zip(w, sent, strict=True):
        j = weight * inverse(other.factors)
        eta = np.einsum("rij,srj->sri", j, other.means - about[:, None])
        information = (information[:, :, None] + j).reshape(q, -1, n, n)
        pull = (pull[:, :, None] + eta[:, None]).reshape(q, -1, n)
    return information, pull


def conditional_shapes(
    own: GaussianMixture, divided: GaussianMixture, sent: Sequence[GaussianMixture], w: Array,
    pairs: NDArray[np.intp],
) -> Shapes:  # fmt: skip
    """Update the target part by Λ and η in the own mixand's whitened frame; e follows."""
    n = divided.dim
    q, p = pairs
    # Everything about the own mixand's mean: far from the origin products would cancel.
    information, pull = _told(sent, w[1:], own.means[q, :n])
    if w[0] != 1:
        j = (w[0] - 1) * inverse(divided.factors)[p]
        gap = divided.means[p] - own.means[q, :n]
        information = information + j[:, None]
        pull = pull + (j @ gap[..., None])[:, None, :, 0]
    root = np.linalg.cholesky(own.covs[q, :n, :n])[:, None]
    lower, good = _factored(np.eye(n) + root.mT @ symmetrise(information) @ root)
    half = np.linalg.solve(lower, np.broadcast_to(root.mT, lower.shape))
    target = half.mT @ half
    move = (target @ pull[..., None])[..., 0]
    gain, rest = (part[q, None] for part in regression(own, n))
    shift = np.concatenate([move, (gain @ move[..., None])[..., 0]], axis=-1)
    covs = joined(target, gain, rest)
    source = np.broadcast_to(q[:, None], good.shape)
    means = own.means[q, None] + shift
    return Shapes.unchecked(means[good], covs[good], source[good], int((~good).sum()))


def literal_shapes(
    own: GaussianMixture, divided: GaussianMixture, sent: Sequence[GaussianMixture], w: Array,
    pairs: NDArray[np.intp],
) -> Shapes:  # fmt: skip
    """(22)-(27) as printed, with each inverse; for comparison."""
    n, d = divided.dim, own.dim
    q, p = pairs
    inv = np.linalg.inv
    told, pull = _told(sent, w[1:], np.zeros((1, n)))
    j = (w[0] - 1) * inv(divided.covs)
    information = (j[p, None] + told).reshape(-1, n, n)
    vector = ((j @ divided.means[..., None])[p, None, :, 0] + pull).reshape(-1, n)
    try:
        factor_cov = inv(information)
    except np.linalg.LinAlgError:
        raise np.linalg.LinAlgError(
            "form: 'literal' inverts the information of what updates the target, got a singular "
            "one; 'conditional' does not invert it"
        ) from None
    factor_mean = (factor_cov @ vector[..., None])[..., 0]
    source = np.repeat(q, told.shape[1])
    full = np.zeros((source.size, d, d))
    full[:, :n, :n] = inv(factor_cov)
    lift = np.zeros((source.size, d))
    lift[:, :n] = (inv(factor_cov) @ factor_mean[..., None])[..., 0]
    prior = inv(own.covs)[source]
    covs = inv(prior + full)
    means = (covs @ ((prior @ own.means[source][..., None])[..., 0] + lift)[..., None])[..., 0]
    covs = symmetrise(covs)
    good = _factored(covs)[1]
    return Shapes.unchecked(means[good], covs[good], source[good], int((~good).sum()))


def regression(own: GaussianMixture, n: int) -> tuple[Array, Array]:
    """Gain of e on t and covariance of e given t, of each mixand."""
    cross = own.covs[:, :n, n:]
    gain = np.asarray(np.linalg.solve(own.covs[:, :n, :n], cross).mT, dtype=np.float64)
    return gain, symmetrise(own.covs[:, n:, n:] - gain @ cross)


def joined(target: Array, gain: Array, rest: Array) -> Array:
    """Covariances of [t; e] from that of t, the gain of e on t, and the covariance of e given t."""
    below = symmetrise(rest + gain @ target @ gain.mT)
    n = target.shape[-1]
    out = np.empty((*below.shape[:-2], n + below.shape[-1], n + below.shape[-1]))
    out[..., :n, :n], out[..., n:, n:] = target, below
    out[..., n:, :n] = gain @ target
    out[..., :n, n:] = out[..., n:, :n].mT
    return out


def _factored(matrices: Array) -> tuple[Array, Mask]:
    """Cholesky factors of a stack, and which of them exist; the identity where none does."""
    d = matrices.shape[-1]
    lower = np.zeros_like(matrices)
    good = np.ones(matrices.shape[:-2], dtype=bool)
    for k in range(d):
        column = matrices[..., k:, k] - (lower[..., k:, :k] @ lower[..., k, :k, None])[..., 0]
        # A pivot that has lost ten digits to cancellation is rounding.
        good &= column[..., 0] > 1e-10 * np.abs(matrices[..., k, k])
        pivot = np.where(good, column[..., 0], 1.0)
        lower[..., k:, k] = np.where(good[..., None], column, 0.0) / np.sqrt(pivot)[..., None]
    lower[~good] = np.eye(d)
    return lower, good


@door
def tikhonov(
    largest: Annotated[float, Bounds(at_least=0, at_most=1e150)],
    smallest: Annotated[float, Bounds(at_least=0, at_most=1e150)], *,
    condition: Annotated[float, Bounds(above=1, at_most=1e150)] = _CONDITION,
) -> float:
    r"""The smallest factor that brings a matrix's condition number down to `condition`, (66).

    .. math:: \alpha^2=\frac{\sigma_1^2-\kappa^2\sigma_n^2}{\kappa^2-1}

    and 0 where the matrix is well conditioned already. The printed (66) has an index i where the
    largest singular value is meant.

    Parameters
    ----------
    largest, smallest : float
        Singular values, at least 0.
    condition : float
        Above 1.

    Examples
    --------
    >>> alpha = tikhonov(1.0, 0.0, condition=10.0)
    >>> round(float(np.sqrt(1 + alpha**2) / alpha), 9)
    10.0
    >>> tikhonov(1.0, 0.5, condition=10.0)
    0.0
    """
    gap = largest**2 - (condition * smallest) ** 2
    return float(np.sqrt(max(gap, 0.0) / (condition**2 - 1)))


@door
def nonnegative_least_squares(
    matrix: Annotated[Array, "n s", Bounds(at_least=-1e150, at_most=1e150)],
    right: Annotated[Array, "n"], *,
    condition: Annotated[float, Bounds(above=1, at_most=1e150)] = _CONDITION,
) -> Array:
    """Nonnegative weights that solve ``matrix @ w = right`` best, regularised by (60) and (66).

    Parameters
    ----------
    matrix : array_like, (n, S)
    right : array_like, (n,)
    condition : float
        The largest condition number allowed.

    Returns
    -------
    ndarray, (S,)

    Raises
    ------
    SolverError
        If the iteration does not end.

    Examples
    --------
    >>> nonnegative_least_squares([[1.0, 0.0], [0.0, 1.0]], [2.0, -1.0])
    array([2., 0.])
    """
    rows, columns = matrix.shape
    values = svdvals(matrix)
    smallest = float(values[-1]) if rows >= columns else 0.0
    alpha = unchecked(tikhonov)(float(values[0]), smallest, condition=condition)
    if alpha > 0:
        matrix = np.concatenate([matrix, alpha * np.eye(columns)])
        right = np.concatenate([right, np.zeros(columns)])
    try:
        return np.asarray(nnls(matrix, right, maxiter=20 * columns)[0], dtype=np.float64)
    except RuntimeError as error:
        raise SolverError(
            f"nonnegative least squares stopped: {error} ({columns} unknowns)"
        ) from None
