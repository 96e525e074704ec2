r"""The Kalman filter of a density on a grid: dense, and of low rank for any number of filters.

The state is the density p with :math:`\dot p=\mathbf A p` (+ noise of strength Q), the measurement
a kernel estimate :math:`y=p+w` with w white of strength R: equations (8) and (9) of Zheng and Lin.
A step of length Δ moves mean and covariance by the finite-volume step Φ and then takes in one
measurement of variance R/Δ. That is stable for any Δ, where explicit steps of the Riccati equation
are not, and the two forms below do the same step.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike

from ..validation import (
    Array,
    FrozenModel,
    PositiveFloat,
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

Move = Callable[[Array], Array]
Observed = Annotated[Array, "*state.base.shape"] | Annotated[Array, "state.size"]


@dataclass(frozen=True, eq=False)
class Dense(FrozenModel):
    """A density and its whole covariance matrix: the reference.

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
    move: Move,
    observed: Annotated[Array, "*state.mean.shape"],
    noise: ArrayLike,
    dt: PositiveFloat,
) -> Dense:
    r"""One step with the whole covariance: O(n³), the reference for the other.

    .. math::
        \mathbf P^-=\boldsymbol\Phi\mathbf P\boldsymbol\Phi^\top,\quad
        \mathbf K=\mathbf P^-(\mathbf P^-+\mathbf R/\Delta)^{-1},\quad
        \mathbf P=(\mathbf I-\mathbf K)\mathbf P^-

    Parameters
    ----------
    state : Dense
    move : callable
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
    variance = _strength(noise, state.mean.shape) / dt
    mean = move(state.mean)
    p = move(move(state.covariance).T)
    p = 0.5 * (p + p.T)
    gain = np.linalg.solve(p + np.diag(variance), p).T
    left = p - gain @ p
    return Dense.construct(mean + gain @ (observed - mean), 0.5 * (left + left.T))


def _strength(noise: ArrayLike, shape: tuple[int, ...]) -> Array:
    """The strength R of each filter's noise, infinite where a filter measures nothing."""
    r = check_array(noise, "noise", (..., shape[-1]), finite=False)
    if not r.min() > 0:
        raise ValueError(f"noise must be variances above 0, got {r.min():g}")
    if r.shape not in (shape, shape[-1:]):
        raise ValueError(
            f"noise must have shape {shape} or {shape[-1:]}, got {r.shape}"
        )
    return np.broadcast_to(r, shape)


_MOST = 1e15
"""Ratio of informations, the greatest to the least, from which on rounding decides."""


@dataclass(frozen=True, eq=False)
class LowRank(FrozenModel):
    r"""Any number F of filters of one density, with covariances of low rank.

    Filter i holds an r × r information matrix and a vector in a basis S:

    .. math:: \hat p_i=\text{base}_i+\mathbf S\mathbf M_i^{-1}\mathbf b_i,\qquad
        \mathbf P_i=\mathbf S\mathbf M_i^{-1}\mathbf S^\top

    Without process noise this form stays as it is, and S = Φ(t, 0) S₀ is common to all and knows
    nothing of the data. Process noise gives each filter a basis of its own.

    Parameters
    ----------
    basis : ndarray, (n, r) or (F, n, r)
        S now.
    base : ndarray, (F, n)
        Each filter's density at the start, moved without data.
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
        weights = np.linalg.solve(self.information, self.vector[..., None])[..., 0]
        return np.asarray(self.base + (self.basis @ weights[..., None])[..., 0])

    @property
    def variances(self) -> Array:
        """Diagonal of every filter's covariance, (F, n)."""
        return np.asarray((self.factors**2).sum(axis=-1))

    @property
    def factors(self) -> Array:
        """Every filter's factor L of the covariance L Lᵀ, (F, n, r)."""
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
    basis: Annotated[Array, "n r"] | Annotated[Array, "f n r"],
    base: Annotated[Array, "f n"],
) -> LowRank:
    """Filters before their first step: prior means `base` (F, n), prior covariances S Sᵀ.

    Examples
    --------
    >>> low_rank_start(np.ones((4, 1)), np.zeros((2, 4))).information.shape
    (2, 1, 1)
    """
    filters = len(base)
    rank = basis.shape[-1]
    nothing = np.tile(np.eye(rank), (filters, 1, 1)), np.zeros((filters, rank))
    return LowRank.construct(basis.copy(), base.copy(), *nothing)


@validated
def low_rank_predict(
    state: LowRank,
    move: Move,
    *,
    process: Annotated[Array, "state.size q"] | None = None,
    dt: PositiveFloat | None = None,
) -> LowRank:
    r"""The filters after the model's step and before the measurement.

    With process noise the factor of the forecast is :math:`[\boldsymbol\Phi\mathbf L,\
    \sqrt\Delta\,\mathbf L_Q]`. As many of its leading left singular vectors as L has columns are
    kept, which drops the least of the variance.

    Parameters
    ----------
    state : LowRank
    move : callable
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
        rows = state.basis.mT
        base = state.base
    else:
        rows = state.factors.mT
        base = state.estimates
    moved = move(np.concatenate([rows.reshape(-1, state.size), base]))
    basis = np.ascontiguousarray(moved[: -len(base)].reshape(rows.shape).mT)
    if process is None:
        return state.replace(basis=basis, base=moved[-len(base) :])
    if dt is None:
        raise ValueError(
            "dt must be the step's length where there is process noise, got None"
        )
    added = np.broadcast_to(np.sqrt(dt) * process, (len(base), *process.shape))
    factor = np.concatenate([basis, added], axis=-1)
    _, vectors = np.linalg.eigh(factor.mT @ factor)
    kept = factor @ vectors[..., -basis.shape[-1] :]
    return low_rank_start(kept, moved[-len(base) :])


@validated
def low_rank_step(
    state: LowRank, observed: Observed, noise: ArrayLike, dt: PositiveFloat
) -> LowRank:
    r"""All filters take in a measurement each: one matrix product.

    .. math::
        \mathbf M_i \leftarrow \mathbf M_i+\Delta\,\mathbf S^\top\mathbf R_i^{-1}\mathbf S,\qquad
        \mathbf b_i \leftarrow \mathbf b_i
        +\Delta\,\mathbf S^\top\mathbf R_i^{-1}(y_i-\text{base}_i)

    By Woodbury's identity this is the update of :func:`dense_step`. In a common basis each pair of
    its columns is multiplied once for all filters.

    Parameters
    ----------
    state : LowRank
        As :func:`low_rank_predict` left it.
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
    precision = dt / _strength(noise, state.base.shape)
    gap = precision * (observed - state.base)
    seen = (gap[:, None, :] @ state.basis)[:, 0]
    information = state.information + _weighted_products(state.basis, precision)
    if not information.max() < _MOST:
        least, most = np.linalg.eigvalsh(information)[:, [0, -1]].T
        if not (most < _MOST * least).all():
            raise np.linalg.LinAlgError(
                "density filter: the step's length, the noise or the prior "
                f"is out of scale, information {most.max():.3g}"
            )
    return state.replace(information=information, vector=state.vector + seen)


def _weighted_products(s: Array, weights: Array) -> Array:
    """Sᵀ diag(w) S for each row w of the weights, (F, r, r)."""
    if s.ndim == 3 or len(weights) < 16:
        return np.asarray((s.mT * weights[:, None, :]) @ s)
    r = s.shape[1]
    turned = np.ascontiguousarray(s.T)
    out = np.empty((len(weights), r, r))
    for i in range(r):
        out[:, i, i:] = out[:, i:, i] = weights @ (turned[i] * turned[i:]).T
    return out
