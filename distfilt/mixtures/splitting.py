"""Splitting of components where a map is nonlinear, along the direction that it stretches most."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Annotated, NamedTuple

import numpy as np

from ..linalg import cholesky, symmetrise
from ..validation import (
    Array,
    ArrayInput,
    Bounds,
    DistinctIndices,
    IndicesInput,
    PositiveDefinite,
    PositiveFloat,
    PositiveInt,
    call_user,
    validated,
)
from .gaussian import GaussianMixture

__all__ = [
    "nonlinearity",
    "split_components",
    "split_gaussian",
    "split_library",
    "split_nonlinear",
]

Fraction = Annotated[float, Bounds(above=0, below=1)]

# Components lighter than this are not split: hardly anything in the density would change.
_SMALLEST_WEIGHT = 1e-3
# Rounds of splitting: a component can become 27, along directions that may differ.
_MAX_ROUNDS = 3


@validated
def split_library(*, std: Fraction = 0.7) -> tuple[Array, Array]:
    r"""Weights and means of three Gaussians of deviation `std` that approximate the normal.

    Mean 0 and variance 1 are kept: with weights a, 1 - 2a, a at -m, 0, m that is
    :math:`s^2+2am^2=1`. Of the one freedom left, the smallest integrated squared difference from
    the standard normal density is taken.

    Parameters
    ----------
    std : float
        In (0, 1). Narrower components are closer to linear, and fit the tails worse.

    Returns
    -------
    weights, means : ndarray, (3,)

    Examples
    --------
    >>> w, m = split_library(std=0.7)
    >>> round(float(w @ m**2 + 0.7**2), 12)
    1.0
    """
    weights, means = _optimize_library(std)
    # Copies, since all callers share the cached arrays.
    return weights.copy(), means.copy()


@lru_cache(maxsize=16)
def _optimize_library(std: float) -> tuple[Array, Array]:
    """Return weights and means, (3,) each, of the library for a deviation s.

    They minimise the integrated squared difference from N(0, 1) over the outer weight a.
    """
    from scipy.optimize import minimize_scalar

    def components(a: float) -> tuple[Array, Array]:
        # Weights a, 1 - 2 a, a at -m, 0, m, of which the variance s² + 2 a m² is 1.
        m = np.sqrt((1 - std**2) / (2 * a))
        return np.array([a, 1 - 2 * a, a]), np.array([-m, 0.0, m])

    def overlap(difference: Array, variance: float) -> Array:
        # ∫ N(x; m, u) N(x; n, v) dx = N(m - n; 0, u + v), here without 1/√(2π).
        exponent = -0.5 * np.square(difference) / variance
        return np.asarray(np.exp(exponent) / np.sqrt(variance))

    def loss(a: float) -> float:
        # ∫ (p - n)² dx = ∫ p² - 2 ∫ p n + a constant, with the mixture p and the normal density n
        weights, means = components(a)
        pairs = overlap(means[:, None] - means, 2 * std**2)
        square = weights @ pairs @ weights
        return float(square - 2 * weights @ overlap(means, 1 + std**2))

    # The three weights a, 1 - 2a, a are positive between 0 and 1/2.
    result = minimize_scalar(
        loss, bounds=(0.01, 0.49), method="bounded", options={"xatol": 1e-12}
    )
    return components(float(result.x))


@validated
def split_gaussian(
    mean: Annotated[ArrayInput, "d"],
    cov: Annotated[PositiveDefinite, "d d"],
    *,
    parts: Annotated[int, Bounds(at_least=2)],
    axes: DistinctIndices | None = None,
) -> GaussianMixture:
    r"""Return a mixture on a grid with a Gaussian's mean and covariance, to start a Gaussian sum.

    Along each axis stand n components of standard deviation s at equal distances of 1.5 s, out to
    about a deviations, where a is 2.5 for up to eight components and 3 for more:
    :math:`s=a/\sqrt{a^2+0.5625\,(n-1)^2}` for a standard normal. Of all weights those are taken
    whose mixture has the least integrated squared difference from it.

    Parameters
    ----------
    mean, cov : array_like, (d,) and (d, d)
        The covariance is positive definite.
    parts : int
        Number n of components along each axis, at least 2; there are n to the power of the number
        of axes.
    axes : sequence of int, optional
        The components of the state that are split, such as positions; all by default. The others
        follow by their regression on these.

    Notes
    -----
    D. L. Alspach and H. W. Sorenson, IEEE Transactions on Automatic Control 17 (1972) 439-448.

    Examples
    --------
    >>> nine = split_gaussian([0.0, 1.0], [[1.0, 0.5], [0.5, 2.0]], parts=3)
    >>> nine.n_components, nine.cov.round(12).tolist()
    (9, [[1.0, 0.5], [0.5, 2.0]])
    >>> split_gaussian([0.0, 1.0], np.eye(2), parts=5, axes=[1]).means[:, 0]
    array([0., 0., 0., 0., 0.])
    """
    d = mean.size
    first = np.arange(d) if axes is None else np.array(axes, dtype=np.intp)
    if first.max(initial=0) >= d:
        raise ValueError(f"axes must be below {d}, got {first.tolist()}")
    # A Cholesky factor whose first columns span the marginal of the split axes.
    order = np.concatenate([first, np.setdiff1d(np.arange(d), first)])
    root = np.empty((d, d))
    root[order] = cholesky(cov[np.ix_(order, order)])
    root = root[:, : first.size]
    # A mixture of so many Gaussians of one width, with mean 0 and variance 1
    line = _place_on_line(parts)
    # Every combination of means along the axes, with the product of their weights.
    n_axes = first.size
    grid = np.stack(np.meshgrid(*[line.means] * n_axes, indexing="ij"), axis=-1)
    grid = grid.reshape(-1, n_axes)
    factors = np.stack(np.meshgrid(*[line.weights] * n_axes, indexing="ij"), axis=-1)
    grid_weights = factors.reshape(-1, n_axes).prod(axis=1)
    # P - (1 - s²) A Aᵀ for the columns A: along them a component has the deviation s.
    piece = symmetrise(cov - (1 - line.std**2) * root @ root.T)
    return GaussianMixture.construct(
        grid_weights,
        mean + grid @ root.T,
        np.repeat(piece[None], len(grid), axis=0),
    )


class _NormalMixture(NamedTuple):
    """A mixture that approximates N(0, 1): the deviation of all parts, means and weights."""

    std: float
    means: Array
    weights: Array


def _place_on_line(parts: int) -> _NormalMixture:
    """Return a mixture of so many equally wide Gaussians that approximates N(0, 1).

    It has mean 0 and variance 1; :func:`split_gaussian` has its formula. `parts` is their number.
    """
    # With few means a wider reach would leave gaps between them.
    reach = 2.5 if parts <= 8 else 3.0
    # The outermost of n means 1.5 s apart is at 0.75 s (n - 1). It shall be `reach` times the
    # deviation √(1 - s²) that is left to the means, which gives s; 0.75² = 0.5625.
    std = reach / np.sqrt(reach**2 + 0.5625 * (parts - 1) ** 2)
    places = 1.5 * std * (np.arange(parts) - (parts - 1) / 2)
    # The squared difference from N(0, 1) is wᵀ A w - 2 wᵀ b and a constant, least for A w = b, with
    # A = ∫ N(x; m, s²) N(x; n, s²) dx and b = ∫ N(x; m, s²) N(x; 0, 1) dx, both without 1/√(2π).
    overlaps = np.exp(-(((places[:, None] - places) / (2 * std)) ** 2))
    overlaps /= np.sqrt(2) * std
    overlaps_with_normal = np.exp(-0.5 * places**2 / (1 + std**2)) / np.sqrt(1 + std**2)
    weights = np.linalg.solve(overlaps, overlaps_with_normal)
    weights /= weights.sum()
    # The variance of the places and of a component add up to 1.
    places *= np.sqrt((1 - std**2) / (weights @ places**2))
    return _NormalMixture(std, places, weights)


@validated
def nonlinearity(
    factors: Annotated[ArrayInput, "L d d"],
    jacobians: Annotated[ArrayInput, "L m d"],
    *,
    scale: Annotated[ArrayInput, "m"] | None = None,
) -> tuple[Array, Array]:
    r"""Direction in which a linearised map stretches each component most, and by how much.

    The direction :math:`\mathbf u=\mathbf S\mathbf v_1` of one standard deviation, with the first
    right singular vector of :math:`\mathbf G\mathbf S`, is the one with the largest image:
    it solves :math:`\max\|\mathbf G\mathbf u\|` over
    :math:`\mathbf u^\top\mathbf P^{-1}\mathbf u=1`.

    Parameters
    ----------
    factors : array_like, (L, d, d)
        Square roots S of the components' covariances.
    jacobians : array_like, (L, m, d)
        Jacobians G at their means.
    scale : array_like, (m,), optional
        Factors of the image's components, applied before lengths are compared.

    Returns
    -------
    directions : ndarray, (L, d)
        One standard deviation long.
    lengths : ndarray, (L,)
        The largest singular values.

    Examples
    --------
    >>> direction, length = nonlinearity([np.diag([3.0, 1.0])], [np.diag([1.0, 2.0])])
    >>> np.abs(direction), length
    (array([[3., 0.]]), array([3.]))
    """
    if scale is not None:
        jacobians = scale[:, None] * jacobians
    # G S = U Σ Vᵀ: the largest image of a unit vector v is that of v₁, of length σ₁.
    svd = np.linalg.svd(jacobians @ factors)
    first = svd.Vh[:, 0]
    # A singular vector's sign is arbitrary: its largest entry is made positive.
    largest = np.abs(first).argmax(axis=1)
    sign = np.sign(first[np.arange(len(first)), largest])
    first = sign[:, None] * first
    directions = (factors @ first[..., None])[..., 0]
    return directions, svd.S[:, 0]


@validated
def split_components(
    mixture: GaussianMixture,
    which: Annotated[IndicesInput, "K", Bounds(at_least=0)],
    directions: Annotated[ArrayInput, "K mixture.dim"],
    *,
    std: Fraction = 0.7,
) -> GaussianMixture:
    r"""Replace some components by three along a direction, keeping their mean and covariance.

    With a square root S of P and :math:`\mathbf u=\mathbf S\mathbf v` for a unit vector v, the
    pieces of :math:`\mathcal N(\mathbf m,\mathbf P)` are
    :math:`\mathcal N(\mathbf m+m_k\mathbf u,\ \mathbf P-(1-s^2)\mathbf u\mathbf u^\top)`, where
    :math:`m_k` and s are the means and the deviation of :func:`split_library`.

    Parameters
    ----------
    mixture : GaussianMixture
    which : array_like of int, (K,)
        Indices of the components, each once; the pieces come after those that stay.
    directions : array_like, (K, d)
        One standard deviation long, :math:`\mathbf u^\top\mathbf P^{-1}\mathbf u=1`.
    std : float
        As of :func:`split_library`.

    Examples
    --------
    >>> one = GaussianMixture.gaussian([0.0, 0.0], np.eye(2))
    >>> three = split_components(one, [0], [[1.0, 0.0]])
    >>> three.n_components, three.cov.round(12).tolist()
    (3, [[1.0, 0.0], [0.0, 1.0]])
    """
    # Indices of the components, each once
    is_distinct = np.unique(which).size == which.size
    if not is_distinct or (which >= mixture.n_components).any():
        raise ValueError(
            f"which must have distinct indices below {mixture.n_components}, "
            f"got {which.tolist()}"
        )
    # |L⁻¹ u|² = uᵀ P⁻¹ u must be 1.
    white = np.linalg.solve(mixture.factors[which], directions[..., None])[..., 0]
    squared_lengths = (white**2).sum(axis=1)
    if np.abs(squared_lengths - 1).max(initial=0.0) > 1e-6:
        worst = squared_lengths[np.abs(squared_lengths - 1).argmax()]
        raise ValueError(
            "directions must be one standard deviation long, "
            f"got {np.sqrt(worst):.6g} standard deviations"
        )
    # The library has weights w_k and means m_k, of three pieces with the deviation s. In place of a
    # component come the weights w w_k, means m + m_k u, and covariances P - (1 - s²) u uᵀ.
    piece_weights, piece_means = _optimize_library(std)
    weights = mixture.weights[which][:, None] * piece_weights
    shifts = piece_means[:, None] * directions[:, None]
    means = mixture.means[which][:, None] + shifts
    products = (1 - std**2) * directions[:, :, None] * directions[:, None, :]
    covs = np.repeat(symmetrise(mixture.covs[which] - products), 3, axis=0)
    # The components that stay come first.
    unsplit = np.setdiff1d(np.arange(mixture.n_components), which)
    return GaussianMixture.construct(
        np.concatenate([mixture.weights[unsplit], weights.ravel()]),
        np.concatenate([mixture.means[unsplit], means.reshape(-1, mixture.dim)]),
        np.concatenate([mixture.covs[unsplit], covs]),
    )


@validated
def split_nonlinear(
    mixture: GaussianMixture,
    jacobian: Callable[[Array], Array],
    *,
    max_components: PositiveInt,
    split_threshold: PositiveFloat,
    scale: Annotated[ArrayInput, "m"] | None = None,
) -> GaussianMixture:
    """Split the components that a map stretches most in three, in up to three rounds.

    Parameters
    ----------
    mixture : GaussianMixture
    jacobian : callable
        The map's derivatives (L, m, d), or one (m, d) for all, at means (L, d).
    max_components : int
        Largest number of components of the result.
    split_threshold : float
        A component is split if its weight times its largest stretching is above this, and its
        weight above a thousandth.
    scale : array_like, (m,), optional
        As of :func:`nonlinearity`.

    Examples
    --------
    >>> one = GaussianMixture.gaussian([0.0], [[1.0]])
    >>> split_nonlinear(
    ...     one, lambda x: 2 * np.ones((1, 1)), max_components=4, split_threshold=1.0
    ... ).n_components
    3
    """
    for _ in range(_MAX_ROUNDS):
        # A split adds two components.
        n_splits = (max_components - mixture.n_components) // 2
        if n_splits < 1:
            break
        jacobians = call_user(jacobian, mixture.means)
        shape = (mixture.n_components, *np.shape(jacobians)[-2:])
        jacobians = np.broadcast_to(jacobians, shape)
        directions, lengths = nonlinearity(mixture.factors, jacobians, scale=scale)
        is_heavy = mixture.weights > _SMALLEST_WEIGHT
        costs = np.where(is_heavy, mixture.weights * lengths, 0.0)
        # As many as there is room for, the most stretched first.
        worst = np.argsort(-costs, kind="stable")[:n_splits]
        worst = worst[costs[worst] > split_threshold]
        if not worst.size:
            break
        mixture = split_components(mixture, worst, directions[worst])
    return mixture
