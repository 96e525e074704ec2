r"""The Kalman filter of a density on a grid: dense, in one basis shared by all, and of low rank.

The state is the density p with :math:`\dot p=\mathbf A p` (+ noise of strength Q), the measurement
a kernel estimate :math:`y=p+w` with w white of strength R: equations (8) and (9) of Zheng and Lin.
A step of length Δ moves mean and covariance by the finite-volume step Φ and then takes in one
measurement of variance R/Δ. That is stable for any Δ, where explicit steps of the Riccati equation
are not, and the three forms below do the same step.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..checks import Array, array, callable_, count, number

__all__ = [  # fmt: skip
    "Dense", "LowRank", "Shared", "dense_step", "low_rank_start", "low_rank_step", "shared_moved",
    "shared_start", "shared_step",
]

Move = Callable[[Array], Array]
Indices = NDArray[np.int64]


def _variance(noise: ArrayLike, shape: tuple[int, ...]) -> Array:
    r = array(noise, "noise", shape, finite=False)
    if r.size and not r.min() > 0:
        raise ValueError(f"noise: needs variances above 0, got {r.min():g}")
    return r


@dataclass(frozen=True, eq=False)
class Dense:
    """A density and its whole covariance matrix: the reference.

    Parameters
    ----------
    mean : ndarray, (n,)
    covariance : ndarray, (n, n)

    Examples
    --------
    >>> Dense(np.ones(4), np.eye(4)).mean.sum()
    np.float64(4.0)
    """

    mean: Array
    covariance: Array

    def __post_init__(self) -> None:
        mean = array(self.mean, "mean", ("n",))
        object.__setattr__(self, "mean", mean)
        covariance = array(self.covariance, "covariance", (mean.size, mean.size))
        object.__setattr__(self, "covariance", covariance)


def dense_step(
    state: Dense,
    move: Move,
    observed: ArrayLike,
    noise: ArrayLike,
    dt: float,
    *,
    process: ArrayLike | None = None,
) -> Dense:
    r"""One step with the whole covariance: O(n³), the reference for the other two.

    .. math::
        \mathbf P^-=\boldsymbol\Phi\mathbf P\boldsymbol\Phi^\top+\mathbf Q\Delta,\quad
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
    process : array_like, (n, q), optional
        A factor of Q, per root second.

    Examples
    --------
    >>> after = dense_step(Dense(np.zeros(2), np.eye(2)), lambda p: p, [1.0, 1.0], [1.0, 3.0], 1.0)
    >>> after.mean
    array([0.5 , 0.25])
    """
    if not isinstance(state, Dense):
        raise ValueError(f"state: needs a Dense state, got {type(state).__name__}")
    n, length = state.mean.size, number(dt, "dt", above=0)
    y, r = array(observed, "observed", (n,)), _variance(noise, (n,))
    mean = callable_(move, "move")(state.mean)
    p = move(move(state.covariance).T)
    if process is not None:
        q = array(process, "process", (n, "q"))
        p = p + length * q @ q.T
    p = 0.5 * (p + p.T)
    gain = np.linalg.solve(p + np.diag(r / length), p).T
    left = p - gain @ p
    return Dense(mean + gain @ (y - mean), 0.5 * (left + left.T))


@dataclass(frozen=True, eq=False)
class Shared:
    r"""Any number of filters of one density, without process noise, in one basis.

    With Q = 0 the covariance keeps the form :math:`\mathbf P_i=\mathbf S\mathbf M_i^{-1}\mathbf
    S^\top`, where S = Φ(t, 0) S₀ is common to all and knows nothing of the data. Filter i holds an
    r × r information matrix and a vector:
    :math:`\hat p_i=\text{base}_i+\mathbf S\mathbf M_i^{-1}\mathbf b_i`.

    Parameters
    ----------
    basis : ndarray, (n, r)
        S now.
    base : ndarray, (F, n)
        Each filter's density at the start, moved without data.
    information : ndarray, (F, r, r)
        M_i, at least the identity.
    vector : ndarray, (F, r)
        b_i.

    Examples
    --------
    >>> state = shared_start(np.eye(3)[:, :2], np.zeros((5, 3)))
    >>> state.estimates.shape, state.variances[0]
    ((5, 3), array([1., 1., 0.]))
    """

    basis: Array
    base: Array
    information: Array
    vector: Array

    def __post_init__(self) -> None:
        basis = array(self.basis, "basis", ("n", "r"))
        base = array(self.base, "base", ("F", len(basis)))
        filters, r = len(base), basis.shape[1]
        for name, value in (
            ("basis", basis), ("base", base),
            ("information", array(self.information, "information", (filters, r, r))),
            ("vector", array(self.vector, "vector", (filters, r))),
        ):
            object.__setattr__(self, name, value)

    @property
    def estimates(self) -> Array:
        """Every filter's density, (F, n)."""
        weights = np.linalg.solve(self.information, self.vector[..., None])[..., 0]
        return np.asarray(self.base + weights @ self.basis.T)

    @property
    def variances(self) -> Array:
        """Diagonal of every filter's covariance, (F, n)."""
        root = np.linalg.cholesky(self.information)
        half = np.linalg.solve(root, np.broadcast_to(self.basis.T, (
            len(root), *self.basis.T.shape)))
        return np.asarray((half**2).sum(axis=1))

    def covariance(self, k: int) -> Array:
        """Covariance of filter `k`, (n, n)."""
        if count(k, "k", at_least=0) >= len(self.information):
            raise ValueError(f"k: needs a filter below {len(self.information)}, got {k}")
        return np.asarray(self.basis @ np.linalg.solve(self.information[k], self.basis.T))


def shared_start(basis: ArrayLike, base: ArrayLike) -> Shared:
    """Filters before their first step: prior means `base` (F, n), prior covariance S Sᵀ.

    Examples
    --------
    >>> shared_start(np.ones((4, 1)), np.zeros((2, 4))).information.shape
    (2, 1, 1)
    """
    s = array(basis, "basis", ("n", "r"))
    m = array(base, "base", ("F", s.shape[0]))
    eye = np.broadcast_to(np.eye(s.shape[1]), (len(m), s.shape[1], s.shape[1]))
    return Shared(s.copy(), m.copy(), eye.copy(), np.zeros((len(m), s.shape[1])))


def shared_moved(state: Shared, move: Move) -> Shared:
    """The filters after the model's step and before the measurement; `move` is Φ on rows.

    Examples
    --------
    >>> state = shared_start(np.eye(2), np.ones((1, 2)))
    >>> shared_moved(state, lambda p: p / 2).estimates
    array([[0.5, 0.5]])
    """
    if not isinstance(state, Shared):
        raise ValueError(f"state: needs a Shared state, got {type(state).__name__}")
    r = state.basis.shape[1]
    moved = callable_(move, "move")(np.concatenate([state.basis.T, state.base]))
    basis = np.ascontiguousarray(moved[:r].T)
    return Shared(basis, moved[r:], state.information, state.vector)


def shared_step(
    state: Shared, observed: ArrayLike, noise: ArrayLike, dt: float
) -> Shared:
    r"""All filters take in a measurement each: one matrix product.

    .. math::
        \mathbf M_i \leftarrow \mathbf M_i+\Delta\,\mathbf S^\top\mathbf R_i^{-1}\mathbf S,\qquad
        \mathbf b_i \leftarrow \mathbf b_i
        +\Delta\,\mathbf S^\top\mathbf R_i^{-1}(y_i-\text{base}_i)

    By Woodbury's identity this is :func:`dense_step` with Q = 0. Each pair of columns of S is
    multiplied once for all filters.

    Parameters
    ----------
    state : Shared
        As :func:`shared_moved` left it.
    observed : array_like, (F, n) or (n,)
    noise : array_like, (F, n) or (n,)
        Strength R of the noise, positive; infinite where a filter measures nothing.
    dt : float
        In s.

    Examples
    --------
    >>> state = shared_start(np.eye(2), np.zeros((1, 2)))
    >>> shared_step(state, [1.0, 1.0], [1.0, 3.0], 1.0).estimates
    array([[0.5 , 0.25]])
    """
    if not isinstance(state, Shared):
        raise ValueError(f"state: needs a Shared state, got {type(state).__name__}")
    shape, length = state.base.shape, number(dt, "dt", above=0)
    y, r = array(observed, "observed"), array(noise, "noise", finite=False)
    for name, value in (("observed", y), ("noise", r)):
        if value.shape not in (shape, shape[1:]):
            raise ValueError(f"{name}: needs shape {shape} or {shape[1:]}, got {value.shape}")
    precision = length / _variance(np.broadcast_to(r, shape), shape)
    s = state.basis
    vector = state.vector + (precision * (y - state.base)) @ s
    informed = precision.any(axis=-1)
    if informed.all():
        information = state.information + _weighted_products(s, precision)
    else:
        information = state.information.copy()
        information[informed] += _weighted_products(s, precision[informed])
    return Shared(s, state.base, information, vector)


def _weighted_products(s: Array, weights: Array) -> Array:
    """Sᵀ diag(w) S for each row w of the weights, (F, r, r)."""
    r = s.shape[1]
    if len(weights) < 16:
        return np.stack([(s.T * w) @ s for w in weights])
    place, turned = _places(r), np.ascontiguousarray(s.T)
    half = np.empty((len(weights), r * (r + 1) // 2))
    # Products of two columns, about a hundred at a time: they stay in the processor's cache.
    block = np.empty((96 + r, s.shape[0]))
    done = held = 0
    for i in range(r):
        np.multiply(turned[i], turned[i:], out=block[held : held + r - i])
        held += r - i
        if held >= 96 or i == r - 1:
            half[:, done : done + held] = weights @ block[:held].T
            done, held = done + held, 0
    return np.asarray(np.take(half, place, axis=1).reshape(len(weights), r, r))


@lru_cache(maxsize=8)
def _places(r: int) -> Indices:
    """Where each entry of a symmetric matrix is in the list of its upper triangle's rows."""
    rows, columns = np.triu_indices(r)
    place = np.empty((r, r), dtype=np.int64)
    place[rows, columns] = place[columns, rows] = np.arange(rows.size)
    return place.ravel()


@dataclass(frozen=True, eq=False)
class LowRank:
    """A density and a factor of its covariance, P = L Lᵀ, for a model that is not exact (Q > 0).

    Parameters
    ----------
    mean : ndarray, (n,)
    factor : ndarray, (n, r)
    lost : float
        Largest share of the variance that one step's compression has dropped so far.

    Examples
    --------
    >>> LowRank(np.ones(4), np.ones((4, 2))).lost
    0.0
    """

    mean: Array
    factor: Array
    lost: float = 0.0

    def __post_init__(self) -> None:
        mean = array(self.mean, "mean", ("n",))
        object.__setattr__(self, "mean", mean)
        object.__setattr__(self, "factor", array(self.factor, "factor", (mean.size, "r")))
        number(self.lost, "lost", at_least=0)


def low_rank_start(mean: ArrayLike, factor: ArrayLike) -> LowRank:
    """The state before the first step: a mean (n,) and a factor (n, r) of its covariance.

    Examples
    --------
    >>> low_rank_start([1.0, 1.0], np.eye(2)).factor.shape
    (2, 2)
    """
    m = array(mean, "mean", ("n",))
    return LowRank(m.copy(), array(factor, "factor", (m.size, "r")).copy())


def low_rank_step(
    state: LowRank,
    move: Move,
    observed: ArrayLike,
    noise: ArrayLike,
    dt: float,
    *,
    process: ArrayLike | None = None,
) -> LowRank:
    r"""One step with a factor of the covariance, which keeps its number of columns.

    The factor of the forecast is :math:`[\boldsymbol\Phi\mathbf L,\ \sqrt\Delta\,\mathbf L_Q]`.
    Its leading left singular vectors are kept, the rest is dropped and reported. Then the
    measurement turns :math:`\mathbf L` into :math:`\mathbf L\mathbf V
    (\mathbf I+\boldsymbol\Lambda)^{-1/2}` with
    :math:`\Delta\mathbf L^\top\mathbf R^{-1}\mathbf L=\mathbf V\boldsymbol\Lambda\mathbf V^\top`.
    Without process noise nothing is dropped, and this is :func:`dense_step`.

    Parameters are those of :func:`dense_step`.

    Examples
    --------
    >>> start = low_rank_start(np.zeros(2), np.eye(2))
    >>> low_rank_step(start, lambda p: p, [1.0, 1.0], [1.0, 3.0], 1.0).mean
    array([0.5 , 0.25])
    """
    if not isinstance(state, LowRank):
        raise ValueError(f"state: needs a LowRank state, got {type(state).__name__}")
    n, r = state.factor.shape
    length = number(dt, "dt", above=0)
    y, variance = array(observed, "observed", (n,)), _variance(noise, (n,))
    callable_(move, "move")
    mean, factor, lost = move(state.mean), move(state.factor.T).T, state.lost
    if process is not None:
        q = array(process, "process", (n, "q"))
        factor, dropped = _compressed(np.concatenate([factor, np.sqrt(length) * q], axis=1), r)
        lost = max(lost, dropped)
    weighed = factor.T * (length / variance)
    values, vectors = np.linalg.eigh(weighed @ factor)
    turned = factor @ (vectors / np.sqrt(1 + np.maximum(values, 0.0)))
    mean = mean + turned @ (turned.T @ ((y - mean) * (length / variance)))
    return LowRank(mean, turned, lost)


def _compressed(factor: Array, rank: int) -> tuple[Array, float]:
    """A factor of `rank` columns with the largest part of the variance, and the share lost."""
    values, vectors = np.linalg.eigh(factor.T @ factor)
    total = float(values.sum())
    lost = float(np.maximum(values[:-rank], 0.0).sum()) / total if total > 0 else 0.0
    return np.asarray(factor @ vectors[:, -rank:]), max(lost, 0.0)
