"""Gaussian mixtures: densities, marginals, moments, draws, payloads."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Any, Self

import numpy as np

from ..linalg import in_units, log_det, log_sum, symmetrise
from ..validation import (
    Array,
    DistinctIndices,
    FrozenModel,
    PositiveDefinite,
    PositiveInt,
    Rng,
    check_positive_definite,
    check_probabilities,
    validated,
)

__all__ = ["GaussianMixture"]

_LOG_2PI = float(np.log(2 * np.pi))
# Numbers that one block of an evaluation may hold: half a megabyte stays in the cache.
_CHUNK = 60_000


@dataclass(frozen=True, eq=False, repr=False)
class GaussianMixture(FrozenModel):
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
    >>> two
    GaussianMixture(size=2, dim=1)
    >>> two.cov
    array([[2.]])
    """

    weights: Annotated[Array, "L", check_probabilities]
    means: Annotated[Array, "L d"]
    covs: Annotated[Array, "L d d", check_positive_definite]

    @classmethod
    @validated
    def gaussian(
        cls, mean: Annotated[Array, "d"], cov: Annotated[PositiveDefinite, "d d"]
    ) -> GaussianMixture:
        """A single Gaussian as a mixture of one mixand.

        Parameters
        ----------
        mean : array_like, (d,)
        cov : array_like, (d, d)

        Examples
        --------
        >>> GaussianMixture.gaussian([0.0, 1.0], np.eye(2))
        GaussianMixture(size=1, dim=2)
        """
        return cls(np.ones(1), mean[None], cov[None])

    @classmethod
    def construct(cls, *args: Any, **options: Any) -> Self:
        """Build one from what the library made itself, and freeze its arrays."""
        out = super().construct(*args, **options)
        for part in (out.weights, out.means, out.covs):
            part.setflags(write=False)  # what is cached of them stays right
        return out

    def __repr__(self) -> str:
        return f"GaussianMixture(size={self.n_components}, dim={self.dim})"

    @property
    def n_components(self) -> int:
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
        """Cholesky factors of the covariances, (L, d, d).

        Raises
        ------
        numpy.linalg.LinAlgError
            If the mixture has collapsed: it names the mixand.
        """
        try:
            return np.asarray(np.linalg.cholesky(self.covs))
        except np.linalg.LinAlgError:
            raise np.linalg.LinAlgError(_collapsed(self.covs)) from None

    @cached_property
    def log_peaks(self) -> Array:
        """Logarithm of each mixand's largest density, -log sqrt|2 pi P|, (L,)."""
        return np.asarray(-0.5 * (log_det(self.factors) + self.dim * _LOG_2PI))

    @validated
    def component_log_densities(self, x: Annotated[Array, "... self.dim"]) -> Array:
        """Logarithm of each mixand's density, without its weight, (..., L).

        Parameters
        ----------
        x : array_like, (..., d)
        """
        return self._in_blocks(x, (self.n_components,), lambda logs: logs)

    @validated
    def log_density(self, x: Annotated[Array, "... self.dim"]) -> Array:
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
        return self._in_blocks(
            x, (), lambda logs: log_sum(self.log_weights + logs)[..., 0]
        )

    def _in_blocks(
        self, x: Array, shape: tuple[int, ...], of: Callable[[Array], Array]
    ) -> Array:
        """What is made of the mixands' log densities (n, L) at points, some points at a time."""
        flat = x.reshape(-1, self.dim)
        (centre, white, at) = self._whitening
        out = np.empty((len(flat), *shape))
        step = max(1, _CHUNK // self.means.size)
        for start in range(0, len(flat), step):
            rows = slice(start, start + step)
            gap = ((flat[rows] - centre) @ white).reshape(-1, *at.shape) - at
            out[rows] = of(self.log_peaks - 0.5 * np.einsum("nld,nld->nl", gap, gap))
        return out.reshape((*x.shape[:-1], *shape))

    @cached_property
    def _whitening(self) -> tuple[Array, Array, Array]:
        """Centre (d,), rows (d, L d) that whiten a point for each mixand, and their means."""
        centre = self.weights @ self.means
        white = np.linalg.solve(
            self.factors, np.broadcast_to(np.eye(self.dim), self.covs.shape)
        )
        at = (white @ (self.means - centre)[..., None])[..., 0]
        return centre, np.array(white.reshape(-1, self.dim).T), at

    @validated
    def marginal(self, indices: DistinctIndices) -> GaussianMixture:
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
        at = np.array(indices)
        if at.max() >= self.dim:
            raise ValueError(
                f"indices must be integers below {self.dim}, got {at.max()}"
            )
        return self.construct(
            self.weights, self.means[:, at], self.covs[:, at[:, None], at]
        )

    @property
    def mean(self) -> Array:
        """Mean of the whole mixture, (d,)."""
        return np.asarray(self.weights @ self.means)

    @property
    def cov(self) -> Array:
        """Covariance of the whole mixture, (d, d)."""
        gap = self.means - self.mean
        cov = (
            np.einsum("l,lij->ij", self.weights, self.covs)
            + (gap.T * self.weights) @ gap
        )
        return symmetrise(cov)

    def moments(self) -> tuple[Array, Array]:
        """Mean (d,) and covariance (d, d) of the whole mixture."""
        return self.mean, self.cov

    def moment_match(self) -> GaussianMixture:
        """The one Gaussian that has the mixture's mean and covariance, as a mixture."""
        return self.construct(np.ones(1), self.mean[None], self.cov[None])

    @validated
    def rvs(self, size: PositiveInt, *, rng: Rng) -> Array:
        """Draw `size` points, (size, d).

        Parameters
        ----------
        size : int
        rng : numpy.random.Generator
        """
        which = rng.choice(
            self.n_components, size=size, p=self.weights / self.weights.sum()
        )
        noise = rng.standard_normal((size, self.dim))
        return np.asarray(
            self.means[which] + (self.factors[which] @ noise[..., None])[..., 0]
        )

    def pack(self) -> tuple[Array, Array, Array]:
        """The mixture as a channel's payload: weights, means, and upper triangles (L, d(d+1)/2)."""
        upper = np.triu_indices(self.dim)
        return self.weights, self.means, self.covs[:, upper[0], upper[1]]

    @classmethod
    @validated
    def unpack(
        cls,
        payload: tuple[
            Annotated[Array, "L"], Annotated[Array, "L d"], Annotated[Array, "L m"]
        ],
    ) -> GaussianMixture:
        """The mixture from what :meth:`pack` made of it.

        Examples
        --------
        >>> one = GaussianMixture.gaussian([0.0, 1.0], np.eye(2))
        >>> sum(part.size for part in one.pack())
        6
        >>> GaussianMixture.unpack(one.pack()).covs.tolist() == one.covs.tolist()
        True
        """
        weights, means, triangles = payload
        d = means.shape[1]
        rows, columns = np.triu_indices(d)
        covs = np.empty((len(means), d, d))
        covs[:, rows, columns] = covs[:, columns, rows] = triangles
        return cls.construct(weights.copy(), means.copy(), covs)


def _collapsed(covs: Array) -> str:
    """Which mixand has no square root, and what that comes from."""
    least = np.linalg.eigvalsh(in_units(covs)[0])
    worst = int(least[:, 0].argmin())
    return (
        f"mixand {worst} of {len(covs)} has a covariance that is not positive definite (smallest "
        f"eigenvalue {least[worst, 0]:.3g} in units of its variances): a belief collapses where "
        "information is counted more than once, as by fusing beliefs as if they were independent"
    )


def inverse(factors: Array) -> Array:
    """The inverse of L L', symmetric, for Cholesky factors (..., d, d)."""
    white = np.linalg.solve(
        factors, np.broadcast_to(np.eye(factors.shape[-1]), factors.shape)
    )
    return np.asarray(white.mT @ white)


def regression(own: GaussianMixture, n: int) -> tuple[Array, Array]:
    """Gain of e on t and covariance of e given t, of each mixand."""
    cross = own.covs[:, :n, n:]
    gain = np.asarray(np.linalg.solve(own.covs[:, :n, :n], cross).mT, dtype=np.float64)
    return gain, symmetrise(own.covs[:, n:, n:] - gain @ cross)


def assemble_joint(target: Array, gain: Array, rest: Array) -> Array:
    """Covariances of [t; e] from that of t, the gain of e on t, and the covariance of e given t."""
    below = symmetrise(rest + gain @ target @ gain.mT)
    n = target.shape[-1]
    out = np.empty((*below.shape[:-2], n + below.shape[-1], n + below.shape[-1]))
    out[..., :n, :n] = target
    out[..., n:, n:] = below
    out[..., n:, :n] = gain @ target
    out[..., :n, n:] = out[..., n:, :n].mT
    return out
