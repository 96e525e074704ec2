r"""Fusion of two Gaussians whose errors are correlated, each by another bound of the correlation.

All functions work in the coordinates :math:`\mathbf z=\mathbf T^{-1}\mathbf x` in which both
covariances are diagonal: with :math:`\mathbf P_a=\mathbf L\mathbf L^\top` and
:math:`\mathbf L^{-1}\mathbf P_b\mathbf L^{-\top}=\mathbf V\mathbf D\mathbf V^\top` let
:math:`\mathbf T=\mathbf L\mathbf V`, so that :math:`\mathbf P_a=\mathbf T\mathbf T^\top` and
:math:`\mathbf P_b=\mathbf T\mathbf D\mathbf T^\top`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Literal, NamedTuple

import numpy as np

from ..linalg import (
    broadcast_leading,
    cholesky,
    log_det,
    solve_definite,
    solve_lower,
    symmetrise,
)
from ..validation import (
    Array,
    ArrayInput,
    PositiveDefinite,
    PositiveSemidefinite,
    UnitInterval,
    validated,
)

__all__ = [
    "intersect_ellipsoids",
    "intersect_inverses",
    "intersect_split",
    "unite_gaussians",
]

Mean = Annotated[ArrayInput, "... d"]
Cov = Annotated[PositiveDefinite, "... d d"]
Part = Annotated[PositiveSemidefinite, "... d d"]
Size = Literal["min_trace", "min_determinant"]
"""The size of a covariance that a weight makes smallest."""

_POINTS = 17
"""Points of a search along the unit interval."""
_STAGES = 5
"""Each stage of a search leaves an eighth of the interval: the weight is known to 1e-5.

More would let rounding decide which of two points is the better one."""
_MARGIN = 1e-6
"""Smallest distance of a weight that is searched for from 0 and 1."""
_TIE = 1e-9
"""Relative difference of variances that count as equal: rounding makes smaller ones."""


@validated
def intersect_inverses(
    mean_a: Mean,
    cov_a: Cov,
    mean_b: Mean,
    cov_b: Cov,
    *,
    omega: UnitInterval | None = None,
    rule: Size = "min_determinant",
) -> tuple[Array, Array]:
    r"""Fuse two Gaussians by inverse covariance intersection.

    .. math:: \mathbf P^{-1}=\mathbf P_a^{-1}+\mathbf P_b^{-1}
        -\bigl(\omega\mathbf P_a+(1-\omega)\mathbf P_b\bigr)^{-1}

    The last term bounds the information that both may have in common. If the two were made by
    adding independent information to one common estimate, whichever it is, the covariance of the
    error is at most P. As :math:`\omega\mathbf P_a^{-1}+(1-\omega)\mathbf P_b^{-1}` is at least
    the last term, P is never larger than that of covariance intersection with 1 - ω for ω.

    Parameters
    ----------
    mean_a, mean_b : array_like, (..., d)
    cov_a, cov_b : array_like, (..., d, d)
        Positive definite. Leading axes of all four broadcast.
    omega : float, optional
        The weight ω in [0, 1]; by default the one of the smallest result.
    rule : {"min_trace", "min_determinant"}
        The size that is made smallest.

    Notes
    -----
    B. Noack, J. Sijs, M. Reinhardt and U. D. Hanebeck, Automatica 79 (2017) 35-41.

    Examples
    --------
    >>> mean, cov = intersect_inverses([0.0], [[1.0]], [3.0], [[2.0]], omega=0.5)
    >>> mean.round(6), cov.round(6)
    (array([0.6]), array([[1.2]]))
    """
    # P_a = T Tᵀ, P_b = T D Tᵀ and z = T⁻¹ (m_b - m_a)
    common = _diagonalise(mean_a, cov_a, mean_b, cov_b)
    d = common.variances_b
    # tr T diag(p) Tᵀ = Σ_k p_k |t_k|² with the columns t_k
    scale = (common.transform**2).sum(axis=-2)

    def variances(weight: Array) -> Array:
        """Return the variances in the common coordinates, (..., d), for weights (...)."""
        # P_a, P_b and their mixture are I, D and ω + (1 - ω) D.
        w = weight[..., None]
        return np.asarray(1 / (1 + 1 / d - 1 / (w + (1 - w) * d)))

    def size(weights: Array) -> Array:
        """Return tr P or log det P but for a constant, for weights, both (..., points)."""
        # The variances in the common coordinates, (..., points, d)
        p = np.stack([variances(w) for w in np.moveaxis(weights, -1, 0)], axis=-2)
        if rule == "min_trace":
            return np.asarray((scale[..., None, :] * p).sum(axis=-1))
        # log det P = Σ log p_k + 2 log |det T|
        return np.asarray(np.log(p).sum(axis=-1))

    # The given ω, or the one whose result has the least size
    weight = _choose_weight(omega, size, d.shape[:-1])
    p = variances(weight)
    w = weight[..., None]
    # The gain of b: P (P_b⁻¹ - (1 - ω) (ω P_a + (1 - ω) P_b)⁻¹)
    gain = p * (1 / d - (1 - w) / (w + (1 - w) * d))
    # m = m_a + T (gain z) and P = T diag(p) Tᵀ
    return _transform_back(common.transform, mean_a, gain * common.difference, p)


@validated
def intersect_ellipsoids(
    mean_a: Mean, cov_a: Cov, mean_b: Mean, cov_b: Cov
) -> tuple[Array, Array]:
    r"""Fuse two Gaussians by ellipsoidal intersection.

    .. math:: \mathbf P^{-1}=\mathbf P_a^{-1}+\mathbf P_b^{-1}-\boldsymbol\Gamma^{-1},\qquad
        \boldsymbol\Gamma=\mathbf T\max(\mathbf I,\mathbf D)\mathbf T^\top

    in the coordinates common to both, :math:`\mathbf P_a=\mathbf T\mathbf T^\top` and
    :math:`\mathbf P_b=\mathbf T\mathbf D\mathbf T^\top`. All information that both could have in
    common, :math:`\boldsymbol\Gamma^{-1}`, is counted once: along each axis of these coordinates
    the more accurate of the two is taken, and where both are equally accurate the mean of them. P
    is the largest covariance that is below both; it is no bound of the error for every correlation.

    Parameters
    ----------
    mean_a, cov_a, mean_b, cov_b
        As of :func:`intersect_inverses`.

    Notes
    -----
    J. Sijs and M. Lazar, Automatica 48 (2012) 1874-1878, (8) to (16).

    Examples
    --------
    >>> mean, cov = intersect_ellipsoids(
    ...     [0.0, 0.0], np.diag([1.0, 4.0]), [1.0, 1.0], np.diag([2.0, 3.0])
    ... )
    >>> mean, cov
    (array([0., 1.]), array([[1., 0.],
           [0., 3.]]))
    """
    # P_a = T Tᵀ, P_b = T D Tᵀ and z = T⁻¹ (m_b - m_a)
    common = _diagonalise(mean_a, cov_a, mean_b, cov_b)
    d = common.variances_b
    # The limit of the paper's (16) for η to zero: all weight is on the smaller variance, so that
    # the gain of b is 1 where D < I, and 0 where D > I.
    gain = np.where(np.abs(d - 1) < _TIE, 0.5, (d < 1).astype(np.float64))
    shift = gain * common.difference
    # m = m_a + T (shift) and P = T min(I, D) Tᵀ
    return _transform_back(common.transform, mean_a, shift, np.minimum(1.0, d))


@validated
def intersect_split(
    mean_a: Mean,
    dependent_a: Part,
    independent_a: Part,
    mean_b: Mean,
    dependent_b: Part,
    independent_b: Part,
    *,
    omega: UnitInterval | None = None,
    rule: Size = "min_determinant",
) -> tuple[Array, Array, Array]:
    r"""Fuse two estimates whose errors have a correlated and an independent part.

    .. math:: \mathbf A=\mathbf D_a/\omega+\mathbf I_a,\qquad
        \mathbf B=\mathbf D_b/(1-\omega)+\mathbf I_b,\qquad
        \mathbf P^{-1}=\mathbf A^{-1}+\mathbf B^{-1}

    Split covariance intersection: only the dependent parts D are enlarged. The result bounds the
    error for any correlation of the dependent parts. Without independent parts it is covariance
    intersection, without dependent ones the product of the densities.

    Parameters
    ----------
    mean_a, mean_b : array_like, (..., d)
    dependent_a, dependent_b : array_like, (..., d, d)
        Covariances of the parts that may be correlated in any way, positive semidefinite.
    independent_a, independent_b : array_like, (..., d, d)
        Covariances of the parts that are independent of everything else. The sum of both parts
        is positive definite.
    omega, rule
        As of :func:`intersect_inverses`.

    Returns
    -------
    mean, dependent, independent : ndarray
        The fused estimate, and the two parts of its covariance.

    Notes
    -----
    S. J. Julier and J. K. Uhlmann, in D. L. Hall and J. Llinas (eds.), Handbook of Multisensor
    Data Fusion (2001), chapter 12.

    Examples
    --------
    >>> parts = intersect_split(
    ...     [0.0], [[1.0]], [[1.0]], [4.0], [[1.0]], [[1.0]], omega=0.5
    ... )
    >>> [part.round(6).tolist() for part in parts]
    [[2.0], [[1.0]], [[0.5]]]
    """
    d = mean_a.shape[-1]
    leading = np.broadcast_shapes(
        mean_a.shape[:-1],
        mean_b.shape[:-1],
        *[m.shape[:-2] for m in (dependent_a, dependent_b)],
        *[m.shape[:-2] for m in (independent_a, independent_b)],
    )

    def informations(weight: Array) -> tuple[Array, Array]:
        """Return A⁻¹ = ω (D_a + ω I_a)⁻¹ and B⁻¹ likewise with 1 - ω, (..., d, d).

        So nothing is divided by a weight, which may be zero.
        """
        w = weight[..., None, None]
        unit = np.broadcast_to(np.eye(d), (*weight.shape, d, d))
        a = w * solve_definite(dependent_a + w * independent_a, unit)
        b = (1 - w) * solve_definite(dependent_b + (1 - w) * independent_b, unit)
        return a, b

    def size(weights: Array) -> Array:
        """Return log det P or tr P, (..., points), for weights (..., points)."""
        values = []
        for weight in np.moveaxis(weights, -1, 0):
            a, b = informations(weight)
            # P⁻¹ = A⁻¹ + B⁻¹ = C Cᵀ
            lower = cholesky(symmetrise(a + b))
            if rule == "min_determinant":
                values.append(-log_det(lower))
            else:
                # tr P = |C⁻¹|²
                root = solve_lower(lower, np.broadcast_to(np.eye(d), lower.shape))
                values.append((root**2).sum(axis=(-2, -1)))
        return np.stack(values, axis=-1)

    # The given ω, or the one whose result has the least size
    weight = _choose_weight(omega, size, leading)
    # The gains K = P A⁻¹ and L = P B⁻¹, which add up to I
    a, b = informations(weight)
    total = symmetrise(a + b)
    gain_a = solve_definite(total, a)
    gain_b = solve_definite(total, b)
    mean = mean_a + (gain_b @ (mean_b - mean_a)[..., None])[..., 0]
    # P = K A Kᵀ + L B Lᵀ = (A⁻¹ + B⁻¹)⁻¹, of which K I_a Kᵀ + L I_b Lᵀ is independent.
    independent = (
        gain_a @ independent_a @ gain_a.mT + gain_b @ independent_b @ gain_b.mT
    )
    unit = np.broadcast_to(np.eye(d), total.shape)
    cov = solve_definite(total, unit)
    return mean, symmetrise(cov - independent), symmetrise(independent)


@validated
def unite_gaussians(
    mean_a: Mean,
    cov_a: Cov,
    mean_b: Mean,
    cov_b: Cov,
    *,
    omega: UnitInterval | None = None,
    rule: Size = "min_determinant",
) -> tuple[Array, Array]:
    r"""Cover two Gaussians, of which one may be wrong, by covariance union.

    .. math:: \mathbf P\succeq\mathbf P_a+(\mathbf m-\mathbf m_a)(\mathbf m-\mathbf m_a)^\top,
        \qquad
        \mathbf P\succeq\mathbf P_b+(\mathbf m-\mathbf m_b)(\mathbf m-\mathbf m_b)^\top

    If one of the two is consistent, whichever it is, the result is. The mean is
    :math:`\mathbf m=(1-\omega)\mathbf m_a+\omega\mathbf m_b`, and P the smallest covariance, in
    the common coordinates of the two on the right, that is above both.

    Parameters
    ----------
    mean_a, cov_a, mean_b, cov_b, rule
        As of :func:`intersect_inverses`.
    omega : float, optional
        The place of the mean between the two, in [0, 1]; by default that of the smallest result.

    Notes
    -----
    J. K. Uhlmann, Information Fusion 4 (2003) 201-215; S. Reece and S. Roberts, IEEE Transactions
    on Aerospace and Electronic Systems 46 (2010) 207-221.

    Examples
    --------
    >>> mean, cov = unite_gaussians([0.0], [[1.0]], [4.0], [[1.0]])
    >>> mean.round(6), cov.round(6)
    (array([2.]), array([[5.]]))
    """
    leading = _broadcast_pair(mean_a, cov_a, mean_b, cov_b)
    difference = np.broadcast_to(mean_b - mean_a, (*leading, mean_a.shape[-1]))
    # (m_b - m_a)(m_b - m_a)ᵀ, of which the mean at ω takes ω² and (1 - ω)².
    square = difference[..., :, None] * difference[..., None, :]

    def cover(weight: Array) -> Array:
        """Return a factor of the smallest covariance above both, (..., d, d), for weights (...)."""
        # P_a + (m - m_a)(m - m_a)ᵀ and P_b + (m - m_b)(m - m_b)ᵀ for the mean m at ω, the weight;
        # `square` is (m_b - m_a)(m_b - m_a)ᵀ.
        w = weight[..., None, None]
        first = cov_a + w**2 * square
        second = cov_b + (1 - w) ** 2 * square
        # In the coordinates z = T⁻¹ x they are I and D. Means do not matter here: any will do.
        common = _diagonalise(difference, first, difference, second)
        # P = T max(I, D) Tᵀ
        std = np.sqrt(np.maximum(1.0, common.variances_b))
        return np.asarray(common.transform * std[..., None, :])

    def size(weights: Array) -> Array:
        """Return tr P or half of log det P, (..., points), for weights (..., points)."""
        # A factor F of P for each point, (..., points, d, d)
        factors = np.stack([cover(w) for w in np.moveaxis(weights, -1, 0)], axis=-3)
        if rule == "min_trace":
            # tr F Fᵀ = |F|²
            return np.asarray((factors**2).sum(axis=(-2, -1)))
        return np.asarray(np.linalg.slogdet(factors).logabsdet)

    # The given ω, or the one whose result has the least size
    weight = _choose_weight(omega, size, leading)
    factor = cover(weight)
    return mean_a + weight[..., None] * difference, symmetrise(factor @ factor.mT)


def _broadcast_pair(
    mean_a: Array, cov_a: Array, mean_b: Array, cov_b: Array
) -> tuple[int, ...]:
    """Return the leading axes to which means (..., d) and covariances (..., d, d) broadcast."""
    leading = broadcast_leading(mean_a.shape[:-1], mean_b.shape[:-1], "mean_b")
    leading = broadcast_leading(leading, cov_a.shape[:-2], "cov_a")
    return broadcast_leading(leading, cov_b.shape[:-2], "cov_b")


class _CommonCoordinates(NamedTuple):
    """Coordinates in which two covariances are diagonal: P_a = T Tᵀ and P_b = T D Tᵀ.

    T is (..., d, d); the diagonal of D and the difference z = T⁻¹ (m_b - m_a) are (..., d).
    """

    transform: Array
    variances_b: Array
    difference: Array


def _diagonalise(
    mean_a: Array, cov_a: Array, mean_b: Array, cov_b: Array
) -> _CommonCoordinates:
    """Return the coordinates in which both covariances are diagonal, that of a the identity.

    Means are (..., d) and covariances (..., d, d); leading axes broadcast.
    """
    leading = _broadcast_pair(mean_a, cov_a, mean_b, cov_b)
    size = cov_a.shape[-1]
    lower = np.broadcast_to(cholesky(cov_a), (*leading, size, size))
    # P_a = L Lᵀ and L⁻¹ P_b L⁻ᵀ = V D Vᵀ, so that T = L V.
    half = solve_lower(lower, np.broadcast_to(cov_b, lower.shape))
    white = solve_lower(lower, np.ascontiguousarray(half.mT))
    d, axes = np.linalg.eigh(symmetrise(white))
    difference = np.broadcast_to(mean_b - mean_a, (*leading, size))
    z = axes.mT @ solve_lower(lower, difference[..., None])
    return _CommonCoordinates(lower @ axes, variances_b=d, difference=z[..., 0])


def _transform_back(
    transform: Array, mean_a: Array, shift: Array, variances: Array
) -> tuple[Array, Array]:
    """Return mean and covariance, in the given coordinates, of a Gaussian in the common ones.

    There its mean is T⁻¹ m_a plus a shift (..., d), and its covariance diagonal, (..., d).
    """
    # m = m_a + T shift and P = T diag(p) Tᵀ
    mean = mean_a + (transform @ shift[..., None])[..., 0]
    cov = (transform * variances[..., None, :]) @ transform.mT
    return mean, symmetrise(cov)


def _choose_weight(
    omega: float | None, size: Callable[[Array], Array], leading: tuple[int, ...]
) -> Array:
    """Return weights (*leading): the given one, or those in [0, 1] with the smallest result.

    ``size(weights) -> sizes`` gives the result's size at weights (*leading, points). It is
    evaluated on a grid, and then on a finer one between the neighbours of the best point.
    """
    if omega is not None:
        return np.full(leading, omega)
    fractions = np.linspace(0.0, 1.0, _POINTS)
    # Away from the ends, where a part may be infinite.
    low = np.full(leading, _MARGIN)
    high = 1 - low
    for _ in range(_STAGES):
        points = low[..., None] + (high - low)[..., None] * fractions
        # The best of the points, for each pair of Gaussians
        best = size(points).argmin(axis=-1)
        centre = np.take_along_axis(points, best[..., None], axis=-1)[..., 0]
        # The next interval reaches from the neighbour on the left to that on the right.
        step = (high - low) / (_POINTS - 1)
        low = np.maximum(centre - step, _MARGIN)
        high = np.minimum(centre + step, 1 - _MARGIN)
    return np.asarray(centre)
