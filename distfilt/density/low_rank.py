r"""The Kalman filter of a density on a grid: dense, and of low rank for any number of filters.

The state is the density p with :math:`\dot p=\mathbf A p` (+ noise of strength Q), the measurement
a kernel estimate :math:`y=p+w` with w white of strength R: equations (8) and (9) of Zheng and Lin.
A step of length Δ predicts mean and covariance by the finite-volume step Φ and then assimilates one
measurement of variance R/Δ. This is stable for any Δ, unlike explicit steps of the Riccati
equation. The two forms below compute the same step.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike

from ..validation import (
    Array,
    ArrayInput,
    FrozenModel,
    PositiveFloat,
    call_user,
    check_array,
    check_positive_semidefinite,
    validated,
)

__all__ = [
    "Dense",
    "LowRank",
    "dense_step",
    "low_rank_predict",
    "low_rank_start",
    "low_rank_step",
]

Transition = Callable[[Array], Array]
Observed = (
    Annotated[ArrayInput, "*state.base.shape"] | Annotated[ArrayInput, "state.size"]
)


@dataclass(frozen=True, eq=False)
class Dense(FrozenModel):
    """A density and its full covariance matrix: the reference.

    Parameters
    ----------
    mean : ndarray, (n,)
    covariance : ndarray, (n, n)

    Examples
    --------
    >>> Dense(np.ones(4), np.eye(4)).mean.sum()
    np.float64(4.0)
    >>> Dense(np.ones(2), [[1.0, 2.0], [2.0, 1.0]])
    Traceback (most recent call last):
    ValueError: covariance must be a positive semidefinite matrix, got smallest eigenvalue -1
    """

    mean: Annotated[Array, "n"]
    covariance: Annotated[Array, "n n", check_positive_semidefinite]


@validated
def dense_step(
    state: Dense,
    transition: Transition,
    observed: Annotated[ArrayInput, "*state.mean.shape"],
    noise: ArrayLike,
    dt: PositiveFloat,
) -> Dense:
    r"""One step with the full covariance, in O(n³): the reference for :func:`low_rank_step`.

    .. math::
        \mathbf P^-=\boldsymbol\Phi\mathbf P\boldsymbol\Phi^\top,\quad
        \mathbf K=\mathbf P^-(\mathbf P^-+\mathbf R/\Delta)^{-1},\quad
        \mathbf P=(\mathbf I-\mathbf K)\mathbf P^-

    Parameters
    ----------
    state : Dense
    transition : callable
        Φ on rows (..., n), as :meth:`FokkerPlanck.solver` gives it.
    observed : array_like, (n,)
        The measurement y.
    noise : array_like, (n,)
        Strength R of its white noise: a variance times seconds, positive.
    dt : float
        The step Δ, in s.

    Examples
    --------
    >>> after = dense_step(
    ...     Dense(np.zeros(2), np.eye(2)), lambda p: p, [1.0, 1.0], [1.0, 3.0], 1.0
    ... )
    >>> after.mean
    array([0.5 , 0.25])
    """
    variance = _noise_strength(noise, state.mean.shape) / dt
    mean = call_user(transition, state.mean)
    # The transition acts on rows: Φ (Φ P)ᵀ = Φ P Φᵀ, since P is symmetric.
    p = call_user(transition, call_user(transition, state.covariance).T)
    p = 0.5 * (p + p.T)
    # K = P (P + R/Δ)⁻¹, by a solve instead of an inverse
    gain = np.linalg.solve(p + np.diag(variance), p).T
    analysis = mean + gain @ (observed - mean)
    # (I - K) P, symmetrised below against rounding
    covariance = p - gain @ p
    return Dense.construct(analysis, 0.5 * (covariance + covariance.T))


def _noise_strength(noise: ArrayLike, shape: tuple[int, ...]) -> Array:
    """Validate the strength R of each filter's noise; infinite where nothing is measured.

    The shape is that of the result, (F, n) for F filters on n cells, or (n,).
    """
    strength = check_array(noise, "noise", (..., shape[-1]), finite=False)
    # Written so that NaN is refused too.
    if not strength.min() > 0:
        raise ValueError(f"noise must be positive, got {strength.min():g}")
    if strength.shape not in (shape, shape[-1:]):
        raise ValueError(
            f"noise must have shape {shape} or {shape[-1:]}, got {strength.shape}"
        )
    return np.broadcast_to(strength, shape)


_MAX_CONDITION = 1e15
"""Condition number of the information from which on rounding errors, of 1e-16, dominate."""


@dataclass(frozen=True, eq=False)
class LowRank(FrozenModel):
    r"""Any number F of filters of one density, with covariances of low rank.

    Filter i has an r × r information matrix and an information vector in a basis S:

    .. math:: \hat p_i=\text{base}_i+\mathbf S\mathbf M_i^{-1}\mathbf b_i,\qquad
        \mathbf P_i=\mathbf S\mathbf M_i^{-1}\mathbf S^\top

    Without process noise S = Φ(t, 0) S₀ is common to all filters and independent of the data.
    With process noise each filter has its own basis.

    Parameters
    ----------
    basis : ndarray, (n, r) or (F, n, r)
        The present basis S.
    base : ndarray, (F, n)
        Each filter's prior density, predicted without data.
    information : ndarray, (F, r, r)
        M_i, at least the identity.
    vector : ndarray, (F, r)
        b_i.

    Examples
    --------
    >>> state = low_rank_start(np.eye(3)[:, :2], np.zeros((5, 3)))
    >>> state.estimates.shape, state.variances[0]
    ((5, 3), array([1., 1., 0.]))
    """

    basis: Annotated[Array, "n r"] | Annotated[Array, "f n r"]
    base: Annotated[Array, "f n"]
    information: Annotated[Array, "f r r"]
    vector: Annotated[Array, "f r"]

    @property
    def size(self) -> int:
        """Number n of cells."""
        return int(self.base.shape[-1])

    @property
    def estimates(self) -> Array:
        """Every filter's density, (F, n)."""
        # p = base + S M⁻¹ b, solved for all filters at once
        weights = np.linalg.solve(self.information, self.vector[..., None])
        return np.asarray(self.base + (self.basis @ weights)[..., 0])

    @property
    def variances(self) -> Array:
        """Diagonal of every filter's covariance, (F, n)."""
        return np.asarray((self.factors**2).sum(axis=-1))

    @property
    def factors(self) -> Array:
        """Every filter's factor L of the covariance L Lᵀ, (F, n, r)."""
        # P = S M⁻¹ Sᵀ. With the Cholesky factor of M = C Cᵀ it is L Lᵀ for Lᵀ = C⁻¹ Sᵀ.
        root = np.linalg.cholesky(self.information)
        rows = np.broadcast_to(self.basis.mT, (len(root), *self.basis.mT.shape[-2:]))
        return np.linalg.solve(root, rows).mT

    @validated
    def covariance(self, k: int) -> Array:
        """Covariance of filter `k`, (n, n)."""
        factor = self.factors[k]
        return np.asarray(factor @ factor.T)


@validated
def low_rank_start(
    basis: Annotated[ArrayInput, "n r"] | Annotated[ArrayInput, "f n r"],
    base: Annotated[ArrayInput, "f n"],
) -> LowRank:
    """Start filters from prior means `base` (F, n) and the prior covariance S Sᵀ.

    Examples
    --------
    >>> low_rank_start(np.ones((4, 1)), np.zeros((2, 4))).information.shape
    (2, 1, 1)
    """
    filters = len(base)
    rank = basis.shape[-1]
    # M = I and b = 0: no data yet.
    information = np.tile(np.eye(rank), (filters, 1, 1))
    vector = np.zeros((filters, rank))
    # Copies, since the arguments may be the user's arrays.
    return LowRank.construct(basis.copy(), base.copy(), information, vector)


@validated
def low_rank_predict(
    state: LowRank,
    transition: Transition,
    *,
    process: Annotated[ArrayInput, "state.size q"] | None = None,
    dt: PositiveFloat | None = None,
) -> LowRank:
    r"""Predict the filters to the time of the next measurement.

    With process noise the factor of the forecast is :math:`[\boldsymbol\Phi\mathbf L,\
    \sqrt\Delta\,\mathbf L_Q]`. It is truncated to its leading left singular vectors, as many as L
    has columns, which loses the least variance.

    Parameters
    ----------
    state : LowRank
    transition : callable
        Φ on rows (..., n), as :meth:`FokkerPlanck.solver` gives it.
    process : array_like, (n, q), optional
        A factor of Q, per root second, for filters of a model that is not exact.
    dt : float, optional
        The step Δ, in s; needed with process noise.

    Examples
    --------
    >>> state = low_rank_start(np.eye(2), np.ones((1, 2)))
    >>> low_rank_predict(state, lambda p: p / 2).estimates
    array([[0.5, 0.5]])
    """
    if process is None:
        # The measurements are in M and b of LowRank, which stay. Φ is applied to the basis S and
        # to `base`, the density without measurements.
        basis, base = _transition_columns(transition, state.basis, state.base)
        return state.replace(basis=basis, base=base)
    if dt is None:
        raise ValueError(
            "dt must be the length of the step if there is process noise, got None"
        )
    # L and the estimate contain the measurements. They become the new S and `base`, with M = I and
    # b = 0.
    factors, base = _transition_columns(transition, state.factors, state.estimates)
    # √Δ L_Q, the same for all filters
    noise = np.broadcast_to(np.sqrt(dt) * process, (len(base), *process.shape))
    forecast = np.concatenate([factors, noise], axis=-1)
    # Right singular vectors of the forecast's factor, by increasing singular value. Its products
    # with the last of them, the leading ones, are the truncated factor.
    vectors = np.linalg.eigh(forecast.mT @ forecast).eigenvectors
    leading = vectors[..., -factors.shape[-1] :]
    return low_rank_start(forecast @ leading, base)


def _transition_columns(
    transition: Transition, columns: Array, base: Array
) -> tuple[Array, Array]:
    """Apply the transition to columns (..., n, r) and to densities (F, n), in one call.

    The densities are `base`; the result has both parts apart again.
    """
    rows = columns.mT
    # Densities and basis columns are all rows for the transition.
    stacked = np.concatenate([rows.reshape(-1, base.shape[-1]), base])
    result = call_user(transition, stacked)
    filters = len(base)
    columns = np.ascontiguousarray(result[:-filters].reshape(rows.shape).mT)
    return columns, result[-filters:]


@validated
def low_rank_step(
    state: LowRank, observed: Observed, noise: ArrayLike, dt: PositiveFloat
) -> LowRank:
    r"""Assimilate one measurement in each filter, by one matrix product for all.

    .. math::
        \mathbf M_i \leftarrow \mathbf M_i+\Delta\,\mathbf S^\top\mathbf R_i^{-1}\mathbf S,\qquad
        \mathbf b_i \leftarrow \mathbf b_i
        +\Delta\,\mathbf S^\top\mathbf R_i^{-1}(y_i-\text{base}_i)

    By Woodbury's identity this is the update of :func:`dense_step`. In a common basis the product
    of each pair of columns serves all filters.

    Parameters
    ----------
    state : LowRank
        The forecast of :func:`low_rank_predict`.
    observed : array_like, (F, n) or (n,)
    noise : array_like, (F, n) or (n,)
        Strength R of the noise, positive; infinite where a filter measures nothing.
    dt : float
        In s.

    Examples
    --------
    >>> state = low_rank_start(np.eye(2), np.zeros((1, 2)))
    >>> low_rank_step(state, [1.0, 1.0], [1.0, 3.0], 1.0).estimates
    array([[0.5 , 0.25]])
    """
    # Δ/R of each cell, zero where nothing is measured
    precision = dt / _noise_strength(noise, state.base.shape)
    # Δ R⁻¹ (y - base), (F, n): the difference from the base, not from the estimate
    weighted = precision * (observed - state.base)
    # Δ Sᵀ R⁻¹ (y - base), (F, r), in a common basis or in one for each filter
    increment = (weighted[:, None, :] @ state.basis)[:, 0]
    # Δ Sᵀ R⁻¹ S, (F, r, r)
    information = state.information + _gram_matrices(state.basis, precision)
    # The least eigenvalue is 1 or more: without large entries no matrix is ill-conditioned.
    if not information.max() < _MAX_CONDITION:
        _check_condition(information)
    return state.replace(information=information, vector=state.vector + increment)


def _check_condition(information: Array) -> None:
    """Refuse information matrices (F, r, r) that are too close to singular."""
    eigenvalues = np.linalg.eigvalsh(information)
    least = eigenvalues[:, 0]
    greatest = eigenvalues[:, -1]
    # Written so that NaN is refused too.
    if not (greatest < _MAX_CONDITION * least).all():
        raise np.linalg.LinAlgError(
            "density filter: the step's length, the noise or the prior "
            f"is out of scale, information {greatest.max():.3g}"
        )


_MANY_FILTERS = 16
"""From so many filters on, forming each product of two columns once is faster."""


def _gram_matrices(s: Array, weights: Array) -> Array:
    """Sᵀ diag(w) S, (F, r, r), for each row w of the weights (F, n).

    The basis s is common to all filters, (n, r), or has an axis of filters, (F, n, r).
    """
    if s.ndim == 3 or len(weights) < _MANY_FILTERS:
        return np.asarray((s.mT * weights[:, None, :]) @ s)
    # Entry (i, j) is Σ_c w_c S_ci S_cj over the cells c: one product of the weights with S_ci S_cj
    # serves all filters. By symmetry only j >= i is computed.
    columns = np.ascontiguousarray(s.T)
    rank = len(columns)
    products = np.empty((len(weights), rank, rank))
    for i in range(rank):
        row = weights @ (columns[i] * columns[i:]).T
        products[:, i, i:] = row
        products[:, i:, i] = row
    return products
