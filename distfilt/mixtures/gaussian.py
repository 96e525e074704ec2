"""Gaussian mixtures: densities, marginals, conditionals, moments, draws, products."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import logsumexp

from ..checks import array, count, generator, instance, places
from ..doors import Array, Record, definite, summing_to_one
from .quadratics import ExponentialQuadratics, inverse, log_sum

__all__ = ["GaussianMixture"]

_LOG_2PI = float(np.log(2 * np.pi))
_CHUNK = 60_000
"""Numbers that one block of an evaluation may hold: half a megabyte stays in the cache."""


@dataclass(frozen=True, eq=False)
class GaussianMixture(Record):
    r"""A weighted sum of Gaussian densities.

    .. math:: p(\mathbf x)=\sum_{\ell=1}^L w_\ell\,
        \mathcal N(\mathbf x;\mathbf m_\ell,\mathbf P_\ell)

    Equation (4) of Semeraro et al. A weight may be zero; a covariance must be positive definite.

    Parameters
    ----------
    weights : array_like, (L,)
        Nonnegative, with sum 1.
    means : array_like, (L, d)
        The mixands' means.
    covs : array_like, (L, d, d)
        Their covariances.

    Raises
    ------
    ValueError
        If sizes differ, weights are negative or do not sum to 1, or a covariance is not symmetric
        positive definite.

    Examples
    --------
    >>> two = GaussianMixture([0.5, 0.5], [[-1.0], [1.0]], [[[1.0]], [[1.0]]])
    >>> two.size, two.dim
    (2, 1)
    >>> two.moments()[1]
    array([[2.]])
    """

    weights: Annotated[Array, "L", summing_to_one]
    means: Annotated[Array, "L d"]
    covs: Annotated[Array, "L d d", definite]

    @classmethod
    def gaussian(cls, mean: ArrayLike, cov: ArrayLike) -> GaussianMixture:
        """A single Gaussian as a mixture of one mixand.

        Parameters
        ----------
        mean : array_like, (d,)
        cov : array_like, (d, d)

        Examples
        --------
        >>> GaussianMixture.gaussian([0.0, 1.0], np.eye(2)).size
        1
        """
        m = array(mean, "mean", ("d",))
        return cls(np.ones(1), m[None], array(cov, "cov", (m.size, m.size))[None])

    @property
    def size(self) -> int:
        """Number of mixands, L."""
        return int(self.weights.size)

    @property
    def dim(self) -> int:
        """Number of components of the state, d."""
        return int(self.means.shape[1])

    @cached_property
    def log_weights(self) -> Array:
        """Logarithms of the weights, (L,); -inf for a weight of zero."""
        with np.errstate(divide="ignore"):
            return np.asarray(np.log(self.weights))

    @cached_property
    def factors(self) -> Array:
        """Cholesky factors of the covariances, (L, d, d)."""
        try:
            return np.asarray(np.linalg.cholesky(self.covs))
        except np.linalg.LinAlgError:
            raise np.linalg.LinAlgError(_collapsed(self.covs)) from None

    @cached_property
    def log_peaks(self) -> Array:
        """Logarithm of each mixand's largest density, -log sqrt|2 pi P|, (L,)."""
        half = np.log(np.diagonal(self.factors, axis1=-2, axis2=-1)).sum(axis=-1)
        return np.asarray(-half - 0.5 * self.dim * _LOG_2PI)

    def component_log_densities(self, x: ArrayLike) -> Array:
        """Logarithm of each mixand's density, without its weight, (..., L).

        Parameters
        ----------
        x : array_like, (..., d)
        """
        return self._components(array(x, "x", (..., self.dim)))

    def log_density(self, x: ArrayLike) -> Array:
        """Logarithm of the density, (...).

        Parameters
        ----------
        x : array_like, (..., d)

        Examples
        --------
        >>> one = GaussianMixture.gaussian([0.0], [[1.0]])
        >>> one.log_density([[0.0], [60.0]]).round(2).tolist()
        [-0.92, -1800.92]
        """
        return self._log_density(array(x, "x", (..., self.dim)))

    def _components(self, x: Array) -> Array:
        flat = x.reshape(-1, self.dim)
        out = np.empty((flat.shape[0], self.size))
        for rows in _blocks(flat.shape[0], self.size * self.dim):
            out[rows] = self.log_peaks - 0.5 * _distances(flat[rows], *self._whitening)
        return out.reshape(*x.shape[:-1], self.size)

    def _log_density(self, x: Array) -> Array:
        flat = x.reshape(-1, self.dim)
        out = np.empty(flat.shape[0])
        constant = self.log_weights + self.log_peaks
        for rows in _blocks(flat.shape[0], self.size * self.dim):
            out[rows] = log_sum(constant - 0.5 * _distances(flat[rows], *self._whitening))
        return out.reshape(x.shape[:-1])

    @cached_property
    def _whitening(self) -> tuple[Array, Array, Array]:
        """Centre (d,), rows (d, L d) that whiten a point for each mixand, and their means."""
        centre = self.weights @ self.means
        white = np.linalg.solve(self.factors, np.broadcast_to(np.eye(self.dim), self.covs.shape))
        at = (white @ (self.means - centre)[..., None])[..., 0]
        return centre, np.array(white.reshape(-1, self.dim).T), at

    def marginal(self, indices: Sequence[int]) -> GaussianMixture:
        """The density of some components.

        Parameters
        ----------
        indices : sequence of int
            Which components, in the order wanted; each once.

        Examples
        --------
        >>> GaussianMixture.gaussian([0.0, 1.0], np.eye(2)).marginal([1]).means
        array([[1.]])
        """
        at = np.array(places(indices, "indices", self.dim))
        return trusted(self.weights, self.means[:, at], self.covs[:, at[:, None], at])

    def conditional(self, indices: Sequence[int], values: ArrayLike) -> GaussianMixture:
        r"""The density of the other components, given some.

        The mixands' weights become :math:`w_\ell\,\mathcal N(\mathbf t;\mathbf m_{t,\ell},
        \mathbf P_{t,\ell})`, normalised in logarithms, so that values far in the tails are fine.

        Parameters
        ----------
        indices : sequence of int
            The components that are known; at least one must remain.
        values : array_like, (len(indices),)
            Their values.

        Examples
        --------
        >>> pair = GaussianMixture.gaussian([0.0, 0.0], [[1.0, 0.5], [0.5, 1.0]])
        >>> rest = pair.conditional([0], [2.0])
        >>> rest.means, rest.covs
        (array([[1.]]), array([[[0.75]]]))
        """
        known = np.array(places(indices, "indices", self.dim))
        rest = np.setdiff1d(np.arange(self.dim), known)
        if not rest.size:
            raise ValueError("indices: needs a component that is left, got all of them")
        t = array(values, "values", (known.size,))
        part = self.marginal(known.tolist())
        logs = self.log_weights + part._components(t)
        if not np.isfinite(logs.max()):
            raise ValueError(f"values: needs some whose density is a number, got {t.tolist()}")
        cross = self.covs[:, known[:, None], rest]
        gain = np.swapaxes(np.linalg.solve(part.covs, cross), -1, -2)
        means = self.means[:, rest] + (gain @ (t - part.means)[..., None])[..., 0]
        covs = self.covs[:, rest[:, None], rest] - gain @ cross
        return trusted(np.exp(logs - logsumexp(logs)), means, symmetric(covs))

    def moments(self) -> tuple[Array, Array]:
        """Mean (d,) and covariance (d, d) of the whole mixture."""
        mean = self.weights @ self.means
        gap = self.means - mean
        cov = np.einsum("l,lij->ij", self.weights, self.covs) + (gap.T * self.weights) @ gap
        return mean, symmetric(cov)

    def collapsed(self) -> GaussianMixture:
        """The one Gaussian that has the mixture's mean and covariance, as a mixture."""
        mean, cov = self.moments()
        return trusted(np.ones(1), mean[None], cov[None])

    def sample(self, n: int, *, rng: np.random.Generator) -> Array:
        """Draw `n` points, (n, d).

        Parameters
        ----------
        n : int
        rng : numpy.random.Generator
        """
        random = generator(rng)
        which = random.choice(self.size, size=count(n, "n"), p=self.weights / self.weights.sum())
        noise = random.standard_normal((which.size, self.dim))
        return np.asarray(
            self.means[which] + (self.factors[which] @ noise[..., None])[..., 0]
        )

    def product(self, other: GaussianMixture) -> tuple[GaussianMixture, float]:
        r"""The normalised product with another mixture, and the logarithm of its integral.

        Parameters
        ----------
        other : GaussianMixture
            Of the same dimension.

        Returns
        -------
        mixture : GaussianMixture
            Of L L' mixands, those of `other` running fastest.
        log_integral : float
            :math:`\log\int p\,p'\,d\mathbf x`.

        Examples
        --------
        >>> one = GaussianMixture.gaussian([0.0], [[1.0]])
        >>> both, _ = one.product(GaussianMixture.gaussian([2.0], [[1.0]]))
        >>> both.means, both.covs
        (array([[1.]]), array([[[0.5]]]))
        """
        instance(other, "other", GaussianMixture)
        if other.dim != self.dim:
            raise ValueError(f"other: needs dimension {self.dim}, got {other.dim}")
        return self.from_quadratics(self.quadratics().times(other.quadratics()))

    def quadratics(self) -> ExponentialQuadratics:
        r"""The mixture as a sum of exponential quadratics, equation (18)."""
        precision = inverse(self.factors)
        vector = (precision @ self.means[..., None])[..., 0]
        top = self.log_weights + self.log_peaks - 0.5 * np.einsum("li,li->l", vector, self.means)
        return ExponentialQuadratics(precision, vector, top)

    @classmethod
    def from_quadratics(cls, terms: ExponentialQuadratics) -> tuple[GaussianMixture, float]:
        """The density proportional to a sum of exponential quadratics, and its log integral.

        Raises
        ------
        ValueError
            If a term has no integral: its precision is not positive definite.

        Examples
        --------
        >>> terms = ExponentialQuadratics([[[2.0]]], [[2.0]], [0.0])
        >>> GaussianMixture.from_quadratics(terms)[0].means
        array([[1.]])
        """
        instance(terms, "terms", ExponentialQuadratics)
        try:
            factors = np.linalg.cholesky(terms.precisions)
        except np.linalg.LinAlgError:
            least = float(np.linalg.eigvalsh(terms.precisions).min())
            raise ValueError(
                f"terms: needs positive definite precisions, got smallest eigenvalue {least:.6g}"
            ) from None
        covs = inverse(np.asarray(factors))
        means = (covs @ terms.vectors[..., None])[..., 0]
        half = np.log(np.diagonal(factors, axis1=-2, axis2=-1)).sum(axis=-1)
        logs = terms.log_coefficients + 0.5 * np.einsum("li,li->l", terms.vectors, means)
        logs = logs - half + 0.5 * means.shape[1] * _LOG_2PI
        total = float(logsumexp(logs))
        if not np.isfinite(total):
            raise ValueError("terms: needs a term that is there, got none")
        return trusted(np.exp(logs - total), means, covs), total

    def pack(self) -> tuple[Array, Array, Array]:
        """The mixture as a channel's payload: weights, means, and upper triangles (L, d(d+1)/2)."""
        upper = np.triu_indices(self.dim)
        return self.weights, self.means, self.covs[:, upper[0], upper[1]]

    @classmethod
    def unpack(cls, payload: Sequence[ArrayLike]) -> GaussianMixture:
        """The mixture from what :meth:`pack` made of it.

        Examples
        --------
        >>> one = GaussianMixture.gaussian([0.0, 1.0], np.eye(2))
        >>> sum(part.size for part in one.pack())
        6
        >>> GaussianMixture.unpack(one.pack()).covs.tolist() == one.covs.tolist()
        True
        """
        if not isinstance(payload, list | tuple) or len(payload) != 3:
            raise ValueError(f"payload: needs weights, means and triangles, got {payload!r}")
        m = array(payload[1], "payload", ("L", "d"))
        d = m.shape[1]
        flat = array(payload[2], "payload", (m.shape[0], d * (d + 1) // 2))
        upper = np.triu_indices(d)
        covs = np.empty((m.shape[0], d, d))
        covs[:, upper[0], upper[1]] = flat
        covs[:, upper[1], upper[0]] = flat
        return cls(array(payload[0], "payload", (m.shape[0],)), m, covs)


trusted = GaussianMixture.unchecked


def _collapsed(covs: Array) -> str:
    """Which mixand has no square root, and what that comes from."""
    std = np.sqrt(np.abs(np.diagonal(covs, axis1=-2, axis2=-1)))
    unit = np.where(std > 0, std, 1.0)
    least = np.linalg.eigvalsh(covs / (unit[:, :, None] * unit[:, None, :]))
    worst = int(least[:, 0].argmin())
    return (
        f"mixand {worst} of {len(covs)} has a covariance that is not positive definite (smallest "
        f"eigenvalue {least[worst, 0]:.3g} in units of its variances): a belief collapses where "
        "information is counted more than once, as by fusing beliefs as if they were independent"
    )


def symmetric(covs: Array) -> Array:
    return np.asarray(0.5 * (covs + np.swapaxes(covs, -1, -2)))


def _blocks(rows: int, width: int) -> Iterator[slice]:
    step = max(1, _CHUNK // max(width, 1))
    for start in range(0, rows, step):
        yield slice(start, start + step)


def _distances(x: Array, centre: Array, white: Array, at: Array) -> Array:
    """Squared Mahalanobis distances of points (n, d) to L mixands, (n, L)."""
    gap = ((x - centre) @ white).reshape(x.shape[0], *at.shape) - at
    return np.asarray(np.einsum("nld,nld->nl", gap, gap))
