"""Gaussian mixtures: densities, marginals, moments, draws, payloads."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Annotated, NamedTuple, Self, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..linalg import (
    log_det,
    log_sum_exp,
    symmetrise,
    to_unit_variances,
    upper_triangle,
)
from ..validation import (
    Array,
    ArrayInput,
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
E = TypeVar("E", bound=np.generic)
# Numbers in one block of an evaluation: half a megabyte stays in the cache.
_BLOCK_SIZE = 60_000


class _WhiteFrame(NamedTuple):
    """A mixture's mean c (d,), and the matrices and means that whiten points.

    With the Cholesky factors C_l of the L components these are C_l⁻ᵀ side by side, (d, L d), and
    C_l⁻¹ (m_l - c), (L, d). Points and means are relative to c: far from the origin their
    differences would lose digits.
    """

    centre: Array
    columns: Array
    means: Array


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
        The components' means.
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
    GaussianMixture(n_components=2, dim=1)
    >>> two.cov
    array([[2.]])
    """

    weights: Annotated[Array, "L", check_probabilities]
    means: Annotated[Array, "L d"]
    covs: Annotated[Array, "L d d", check_positive_definite]

    if TYPE_CHECKING:
        # The fields are arrays, but the constructor takes anything array_like.
        def __init__(
            self, weights: ArrayLike, means: ArrayLike, covs: ArrayLike
        ) -> None: ...

    @classmethod
    @validated
    def gaussian(
        cls, mean: Annotated[ArrayInput, "d"], cov: Annotated[PositiveDefinite, "d d"]
    ) -> GaussianMixture:
        """Return a single Gaussian as a mixture of one component.

        Parameters
        ----------
        mean : array_like, (d,)
        cov : array_like, (d, d)

        Examples
        --------
        >>> GaussianMixture.gaussian([0.0, 1.0], np.eye(2))
        GaussianMixture(n_components=1, dim=2)
        """
        return cls(np.ones(1), mean[None], cov[None])

    @classmethod
    def construct(cls, *args: object, **options: object) -> Self:
        """Build a mixture of arrays that the library made, unchecked, and freeze them."""
        mixture = super().construct(*args, **options)
        # Factors and densities are cached, so the arrays must not change.
        mixture.weights.setflags(write=False)
        mixture.means.setflags(write=False)
        mixture.covs.setflags(write=False)
        return mixture

    def __repr__(self) -> str:
        return f"GaussianMixture(n_components={self.n_components}, dim={self.dim})"

    @property
    def n_components(self) -> int:
        """Number of components, L."""
        return int(self.weights.size)

    @property
    def dim(self) -> int:
        """Size of the state, d."""
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
            If a covariance is not positive definite: it names the component.
        """
        try:
            return np.asarray(np.linalg.cholesky(self.covs))
        except np.linalg.LinAlgError:
            raise np.linalg.LinAlgError(_describe_collapse(self.covs)) from None

    @cached_property
    def precisions(self) -> Array:
        """Inverses of the covariances, (L, d, d)."""
        return inverse(self.factors)

    @cached_property
    def log_peaks(self) -> Array:
        """Logarithm of each component's largest density, -log sqrt|2 pi P|, (L,)."""
        return np.asarray(-0.5 * (log_det(self.factors) + self.dim * _LOG_2PI))

    @validated
    def component_log_densities(
        self, x: Annotated[ArrayInput, "... self.dim"]
    ) -> Array:
        """Logarithm of each component's density, without its weight, (..., L).

        Parameters
        ----------
        x : array_like, (..., d)
        """
        return self._evaluate(x, (self.n_components,), lambda logs: logs)

    @validated
    def log_density(self, x: Annotated[ArrayInput, "... self.dim"]) -> Array:
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

        # log p(x) = log Σ w_l exp(log N_l(x))
        def add_components(logs: Array) -> Array:
            return log_sum_exp(self.log_weights + logs)[..., 0]

        return self._evaluate(x, (), add_components)

    def _evaluate(
        self, x: Array, shape: tuple[int, ...], function: Callable[[Array], Array]
    ) -> Array:
        """Apply a function to the components' log densities at points x (..., d), (..., *shape).

        It is called with blocks of n points, (n, L), and returns (n, *shape).
        """
        points = x.reshape(-1, self.dim)
        frame = self._white_frame
        result = np.empty((len(points), *shape))
        block = max(1, _BLOCK_SIZE // self.means.size)
        for start in range(0, len(points), block):
            rows = slice(start, start + block)
            # z = C_l⁻¹ (x - c) - C_l⁻¹ (m_l - c) for each component l, with the factors C_l and
            # the centre c: one product for all components. Then log N_l = log peak_l - ½ zᵀz.
            white = (points[rows] - frame.centre) @ frame.columns
            z = white.reshape(-1, *frame.means.shape) - frame.means
            squared_lengths = np.einsum("nld,nld->nl", z, z)
            result[rows] = function(self.log_peaks - 0.5 * squared_lengths)
        return result.reshape((*x.shape[:-1], *shape))

    @cached_property
    def _white_frame(self) -> _WhiteFrame:
        """The coordinates in which each component is a standard normal."""
        # Points count from the mean c, since far from the origin differences would lose digits.
        centre = self.weights @ self.means
        # C_l⁻¹ for the Cholesky factors C_l, and C_l⁻¹ (m_l - c)
        identity = np.broadcast_to(np.eye(self.dim), self.covs.shape)
        inverse_factors = np.linalg.solve(self.factors, identity)
        differences = self.means - centre
        white_means = (inverse_factors @ differences[..., None])[..., 0]
        # The matrices C_l⁻ᵀ side by side, (d, L d), as an array of their own instead of a view
        columns = np.array(inverse_factors.reshape(-1, self.dim).T)
        return _WhiteFrame(centre, columns, white_means)

    @validated
    def marginal(self, indices: DistinctIndices) -> GaussianMixture:
        """Return the density of some components of the state.

        Parameters
        ----------
        indices : sequence of int
            Components of the state, in the order wanted; each once.

        Examples
        --------
        >>> GaussianMixture.gaussian([0.0, 1.0], np.eye(2)).marginal([1]).means
        array([[1.]])
        """
        index = np.array(indices)
        if index.max() >= self.dim:
            raise ValueError(
                f"indices must be integers below {self.dim}, got {index.max()}"
            )
        # Rows and columns of the chosen components, (L, n) and (L, n, n)
        means = self.means[:, index]
        covs = self.covs[:, index[:, None], index]
        return self.construct(self.weights, means, covs)

    @property
    def mean(self) -> Array:
        """Mean of the whole mixture, (d,)."""
        return np.asarray(self.weights @ self.means)

    @property
    def cov(self) -> Array:
        """Covariance of the whole mixture, (d, d)."""
        # P = Σ w_l P_l + Σ w_l (m_l - m)(m_l - m)ᵀ
        differences = self.means - self.mean
        within = np.einsum("l,lij->ij", self.weights, self.covs)
        between = (differences.T * self.weights) @ differences
        return symmetrise(within + between)

    def moments(self) -> tuple[Array, Array]:
        """Return the mean (d,) and the covariance (d, d) of the whole mixture."""
        return self.mean, self.cov

    def moment_match(self) -> GaussianMixture:
        """Return the one Gaussian that has the mixture's mean and covariance, as a mixture."""
        return self.construct(np.ones(1), self.mean[None], self.cov[None])

    @validated
    def rvs(self, size: PositiveInt, *, rng: Rng) -> Array:
        """Draw `size` points, (size, d).

        Parameters
        ----------
        size : int
        rng : numpy.random.Generator
        """
        probabilities = self.weights / self.weights.sum()
        component = rng.choice(self.n_components, size=size, p=probabilities)
        # x = m_l + L_l z with z ~ N(0, I)
        z = rng.standard_normal((size, self.dim))
        deviations = (self.factors[component] @ z[..., None])[..., 0]
        return np.asarray(self.means[component] + deviations)

    def pack(self) -> tuple[Array, Array, Array]:
        """Return the payload of a channel: weights, means, and upper triangles (L, d(d+1)/2)."""
        rows, columns = upper_triangle(self.dim)
        return self.weights, self.means, self.covs[:, rows, columns]

    @classmethod
    @validated
    def unpack(
        cls,
        payload: tuple[
            Annotated[ArrayInput, "L"],
            Annotated[ArrayInput, "L d"],
            Annotated[ArrayInput, "L m"],
        ],
    ) -> GaussianMixture:
        """Rebuild a mixture from the payload that :meth:`pack` made of it.

        Examples
        --------
        >>> one = GaussianMixture.gaussian([0.0, 1.0], np.eye(2))
        >>> sum(part.size for part in one.pack())
        6
        >>> GaussianMixture.unpack(one.pack()).covs.tolist() == one.covs.tolist()
        True
        """
        weights, means, triangles = payload
        dim = means.shape[1]
        rows, columns = upper_triangle(dim)
        covs = np.empty((len(means), dim, dim))
        covs[:, rows, columns] = triangles
        covs[:, columns, rows] = triangles
        # Copies, since a message's arrays may be shared by all that receive it.
        return cls.construct(weights.copy(), means.copy(), covs)


def _describe_collapse(covs: Array) -> str:
    """Name the component whose covariance (L, d, d) has no Cholesky factor, and the usual cause."""
    # Of correlations, which do not depend on units, in ascending order
    eigenvalues = np.linalg.eigvalsh(to_unit_variances(covs).correlation)
    worst = int(eigenvalues[:, 0].argmin())
    return (
        f"component {worst} of {len(covs)} has a covariance that is not positive definite "
        f"(smallest eigenvalue {eigenvalues[worst, 0]:.3g} in units of its variances): a belief "
        "collapses where information is counted more than once, as by fusing beliefs as if they "
        "were independent"
    )


def factor_together(mixtures: Sequence[GaussianMixture]) -> None:
    """Compute the factors of several mixtures, which they keep in their caches.

    One call for all of one dimension takes a fraction of the time of a call for each.

    Raises
    ------
    numpy.linalg.LinAlgError
        If some covariance is not positive definite.

    Examples
    --------
    >>> two = [GaussianMixture.gaussian([0.0], [[p]]) for p in (4.0, 9.0)]
    >>> factor_together(two)
    >>> [float(mixture.factors[0, 0, 0]) for mixture in two]
    [2.0, 3.0]
    """
    # A cached property is stored among the attributes once it has been computed.
    new_by_dim: dict[int, list[GaussianMixture]] = {}
    for mixture in mixtures:
        if "factors" not in vars(mixture):
            new_by_dim.setdefault(mixture.dim, []).append(mixture)
    for new in new_by_dim.values():
        factors = np.linalg.cholesky(np.concatenate([mixture.covs for mixture in new]))
        # Each mixture's part is stored as if its cached property had computed it.
        for mixture, part in zip(new, divide_among(factors, new), strict=True):
            vars(mixture)["factors"] = part


def invert_together(mixtures: Sequence[GaussianMixture]) -> None:
    """Compute the precisions of several mixtures of one dimension, as :func:`factor_together`.

    >>> two = [GaussianMixture.gaussian([0.0], [[p]]) for p in (4.0, 0.25)]
    >>> invert_together(two)
    >>> [float(mixture.precisions[0, 0, 0]) for mixture in two]
    [0.25, 4.0]
    """
    factor_together(mixtures)
    # Cached properties are attributes once they have been computed.
    new = [mixture for mixture in mixtures if "precisions" not in vars(mixture)]
    if not new:
        return
    precisions = inverse(np.concatenate([mixture.factors for mixture in new]))
    # Each mixture's part is stored as if its cached property had computed it.
    for mixture, part in zip(new, divide_among(precisions, new), strict=True):
        vars(mixture)["precisions"] = part


def divide_among(
    values: NDArray[E], mixtures: Sequence[GaussianMixture]
) -> list[NDArray[E]]:
    """Cut values of all components into the parts (L, ...) of each mixture's components, in order.

    >>> two = [GaussianMixture.gaussian([m], [[1.0]]) for m in (0.0, 3.0)]
    >>> divide_among(np.array([5.0, 7.0]), two)
    [array([5.]), array([7.])]
    """
    parts = []
    start = 0
    for mixture in mixtures:
        stop = start + len(mixture.weights)
        parts.append(values[start:stop])
        start = stop
    return parts


def inverse(factors: Array) -> Array:
    """Return the inverses of L Lᵀ, symmetric, for Cholesky factors L (..., d, d)."""
    identity = np.broadcast_to(np.eye(factors.shape[-1]), factors.shape)
    # (L Lᵀ)⁻¹ = L⁻ᵀ L⁻¹
    inverse_factors = np.linalg.solve(factors, identity)
    return np.asarray(inverse_factors.mT @ inverse_factors)


def regression(mixture: GaussianMixture, n: int) -> tuple[Array, Array]:
    """Return each component's gain of e on t, (L, d - n, n), and covariance of e given t.

    The state is [t; e], and t its first n components; the covariances are (L, d - n, d - n).
    """
    target = mixture.covs[:, :n, :n]
    cross = mixture.covs[:, :n, n:]
    # G = P_et P_tt⁻¹ and P_e|t = P_ee - G P_te
    gain = np.asarray(np.linalg.solve(target, cross).mT, dtype=np.float64)
    return gain, symmetrise(mixture.covs[:, n:, n:] - gain @ cross)


def assemble_joint(target: Array, gain: Array, conditional: Array) -> Array:
    """Assemble covariances of [t; e], (..., d, d), from P_tt, the gain G of e on t, and P_e|t.

    :func:`regression` gives G and P_e|t of a prior, of which only P_tt has changed. Shapes are
    (..., n, n) of P_tt, (..., d - n, n) of the gain, and (..., d - n, d - n) of P_e|t.
    """
    # P_et = G P_tt and P_ee = P_e|t + G P_tt Gᵀ
    ego = symmetrise(conditional + gain @ target @ gain.mT)
    n = target.shape[-1]
    dim = n + ego.shape[-1]
    joint = np.empty((*ego.shape[:-2], dim, dim))
    joint[..., :n, :n] = target
    joint[..., n:, n:] = ego
    joint[..., n:, :n] = gain @ target
    joint[..., :n, n:] = joint[..., n:, :n].mT
    return joint
