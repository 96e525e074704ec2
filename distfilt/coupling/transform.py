r"""The ensemble transform: a coupling that turns weighted members into equally weighted ones.

With the optimal coupling :math:`\mathbf T` of the weights to equal masses, each new member is an
average of old ones,

.. math:: \mathbf x_j^+ = N\sum_i t_{ij}\,\mathbf x_i,

equation (3) of Das and Bhattacharya after S. Reich, SIAM Journal on Scientific Computing 35 (2013)
A2013-A2024. The mean of the new members is the weighted mean, exactly.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike

from ..checks import Array, array, choice, generator, number
from ..linalg import _EPS, _factor
from .solvers import SOLVERS, Solve, _scaled, _solver, _squares

__all__ = [
    "ensemble_transform",
    "plans",
    "rejuvenated",
    "second_order",
]


_TIE = 1e-7
"""In units of the largest cost. The weighted mean stays exact, the plan costs at most this more."""


def _weights(log_weights: ArrayLike, shape: tuple[int, ...]) -> Array:
    """Weights (..., N) that sum to one, from logarithms of any size; -inf is a weight of zero."""
    w = array(log_weights, "log_weights", shape, finite=False)
    if np.isnan(w).any() or np.isposinf(w).any():
        raise ValueError("log_weights: needs numbers below infinity, got NaN or infinity")
    if np.isneginf(w.max(axis=-1)).any():
        raise ValueError("log_weights: needs a positive weight in every ensemble, got only zeros")
    return _normalised(w)


def _normalised(log_weights: Array) -> Array:
    w = np.exp(log_weights - log_weights.max(axis=-1, keepdims=True))
    return np.asarray(w / w.sum(axis=-1, keepdims=True))


def _members(value: ArrayLike, name: str = "ensemble") -> Array:
    x = array(value, name, (..., "N", "d"))
    if 0 in x.shape:
        raise ValueError(f"{name}: needs at least one member and one component, got {x.shape}")
    return x


def _plans(x: Array, w: Array, solve: Solve) -> Array:
    """Couplings (..., N, N) of the weights to equal masses, for the squared distance."""
    n, d = x.shape[-2:]
    equal = np.full(n, 1 / n)
    out = np.empty((*x.shape[:-1], n))
    rows = zip(x.reshape(-1, n, d), w.reshape(-1, n), out.reshape(-1, n, n), strict=True)
    ties = _ties(n)
    for points, masses, target in rows:
        cost, _, _ = _scaled(_squares(points, points))
        target[...], _ = solve(cost + ties, masses, equal)
    return out


@lru_cache(maxsize=8)
def _ties(n: int) -> Array:
    """A fixed matrix between 0 and 1e-7, added to costs of range one.

    Where members coincide, as copies do after one weight has dominated, the cheapest coupling is
    not unique and the last bit of a cost decides between quite different ensembles. This decides
    instead, on every machine alike.
    """
    fixed = _TIE * np.random.default_rng(0).random((n, n))
    fixed.setflags(write=False)
    return fixed


def plans(
    ensemble: ArrayLike,
    log_weights: ArrayLike,
    *,
    solver: str = "network",
    regularisation: float = 0.01,
) -> Array:
    """Optimal couplings of weighted members to the same members with equal weights.

    Parameters
    ----------
    ensemble : array_like, (..., N, d)
        Members.
    log_weights : array_like, (..., N)
        Logarithms of their weights, in any normalisation.
    solver, regularisation
        As for :func:`~distfilt.coupling.plan`.

    Returns
    -------
    ndarray, (..., N, N)
        Row i is where the mass of member i goes; the cost is the squared distance. Where it leaves
        a choice, as between copies of a member, a fixed addition of at most 1e-7 of the largest
        cost decides.

    Examples
    --------
    >>> plans([[0.0], [1.0]], np.log([0.75, 0.25]))
    array([[0.5 , 0.25],
           [0.  , 0.25]])
    """
    x = _members(ensemble)
    w = _weights(log_weights, x.shape[:-1])
    return _plans(x, w, _solver(choice(solver, "solver", SOLVERS), regularisation))


def ensemble_transform(
    ensemble: ArrayLike,
    log_weights: ArrayLike,
    *,
    solver: str = "network",
    regularisation: float = 0.01,
    debias: bool = False,
    correct: bool = False,
) -> Array:
    r"""Replace weighted members by as many with equal weights.

    .. math:: \mathbf X^+ = \mathbf X\,N\,\mathbf T

    Parameters
    ----------
    ensemble : array_like, (..., N, d)
        Members.
    log_weights : array_like, (..., N)
        Logarithms of their weights, in any normalisation; -inf is a weight of zero.
    solver, regularisation
        As for :func:`~distfilt.coupling.plan`.
    debias : bool
        Take off the displacement that the solver's plan gives members whose weights are equal
        already. An entropic plan shrinks the ensemble; this undoes most of it, and does nothing to
        an optimal plan.
    correct : bool
        Give the new members the weighted covariance too, by :func:`second_order`.

    Returns
    -------
    ndarray, (..., N, d)

    Raises
    ------
    ValueError
        If shapes do not fit, a number is not finite or all weights of an ensemble are zero.
    SolverError
        If a linear programme is not solved.

    Examples
    --------
    >>> ensemble_transform([[0.0], [1.0]], np.log([0.75, 0.25]))
    array([[0. ],
           [0.5]])
    >>> bool(ensemble_transform([[0.0], [1.0]], [-1e4, -2e4])[1, 0] == 0.0)
    True
    """
    x = _members(ensemble)
    w = _weights(log_weights, x.shape[:-1])
    solve = _solver(choice(solver, "solver", SOLVERS), regularisation)
    for name, value in (("debias", debias), ("correct", correct)):
        if not isinstance(value, bool):
            raise ValueError(f"{name}: needs True or False, got {value!r}")
    return _transform(x, w, solve, debias=debias, correct=correct)


def _transform(
    x: Array, w: Array, solve: Solve, *, debias: bool = False, correct: bool = False
) -> Array:
    """`ensemble_transform` of checked arguments."""
    out = _carried(x, w, _plans(x, w, solve))
    if debias:
        equal = np.full(w.shape, 1 / x.shape[-2])
        out += x - _carried(x, equal, _plans(x, equal, solve))
        out += w[..., None, :] @ x - out.mean(axis=-2, keepdims=True)
    return _second_order(out, x, w) if correct else out


def _carried(x: Array, w: Array, matrix: Array, *, correct: bool = False) -> Array:
    """Members with weights w after a coupling `matrix` of w to equal masses, (3)."""
    centre = w[..., None, :] @ x
    out = np.asarray(centre + x.shape[-2] * (np.swapaxes(matrix, -1, -2) @ (x - centre)))
    return _second_order(out, x, w) if correct else out


def second_order(moved: ArrayLike, ensemble: ArrayLike, log_weights: ArrayLike) -> Array:
    r"""Give transformed members the mean and covariance of the weighted ones, exactly.

    Averages vary less than what they average, so :math:`\mathbf X^+` has too small a covariance.
    The symmetric matrix

    .. math:: \mathbf B = \mathbf P^{1/2}
        (\mathbf P^{1/2}\mathbf C\mathbf P^{1/2})^{-1/2}\mathbf P^{1/2}

    takes its covariance :math:`\mathbf C` to the weighted covariance :math:`\mathbf P` and is the
    map that moves a Gaussian least.

    Parameters
    ----------
    moved : array_like, (..., N, d)
        What :func:`ensemble_transform` returned.
    ensemble, log_weights
        What it was given.

    Returns
    -------
    ndarray, (..., N, d)
        Where `moved` has no spread in a direction in which the weighted members have one, nothing
        can be stretched, and the covariance falls short there. Covariances are about the mean with
        N, not N - 1, in the denominator.

    Notes
    -----
    W. Acevedo, J. de Wiljes, S. Reich, SIAM Journal on Scientific Computing 39 (2017) A1834-A1850
    correct the N x N transform instead; this corrects d x d and keeps the same moments.

    Examples
    --------
    >>> x, logs = [[0.0], [1.0]], np.log([0.75, 0.25])
    >>> float(second_order(ensemble_transform(x, logs), x, logs).var().round(12))
    0.1875
    """
    x = _members(ensemble)
    y = array(moved, "moved", x.shape)
    return _second_order(y, x, _weights(log_weights, x.shape[:-1]))


def _second_order(y: Array, x: Array, w: Array) -> Array:
    n = x.shape[-2]
    centre = w[..., None, :] @ x
    around, spread = x - centre, y - y.mean(axis=-2, keepdims=True)
    with np.errstate(over="ignore", invalid="ignore"):
        target = np.swapaxes(around, -1, -2) @ (w[..., None] * around)
    if not np.isfinite(target).all():
        raise ValueError("ensemble: needs members with a finite covariance, got an overflow")
    root = _graded(target)
    # With P = K K' the anomalies times B are the nearest orthonormal columns to those times K,
    # times K': P comes out to rounding, however little C has left of it in some direction.
    turned = spread @ root
    u, sizes, v = np.linalg.svd(turned, full_matrices=False)
    # What rounding leaves in a direction where there is nothing: of the members, of the columns.
    axes = np.swapaxes(v, -1, -2)
    members, columns = (np.abs(z).max(axis=-2, keepdims=True) for z in (y, turned))
    lost = n * _EPS * (members @ np.abs(root @ axes) + columns @ np.abs(axes))
    u = u * (sizes[..., None, :] > lost)
    u -= u.mean(axis=-2, keepdims=True)
    return np.asarray(centre + np.sqrt(n) * (u @ v @ np.swapaxes(root, -1, -2)))


def _graded(cov: Array) -> Array:
    """A factor K of covariances K K', triangular from the widest component to the narrowest.

    Its columns then shrink as the components do, and no unit drowns in the rounding of another.
    """
    order = np.argsort(-np.diagonal(cov, axis1=-2, axis2=-1), axis=-1, kind="stable")
    rows = np.take_along_axis(cov, order[..., :, None], axis=-2)
    lower = _factor(np.take_along_axis(rows, order[..., None, :], axis=-1))
    return np.take_along_axis(lower, np.argsort(order, axis=-1)[..., :, None], axis=-2)


def rejuvenated(
    moved: ArrayLike, ensemble: ArrayLike, *, bandwidth: float, rng: np.random.Generator
) -> Array:
    r"""Add combinations of the forecast's anomalies: new places, and the same mean.

    .. math:: \mathbf x_j' = \mathbf x_j^+ + \frac{h}{\sqrt{N-1}}\sum_i(\mathbf x_i-\bar{\mathbf x})
        \,\xi_{ij},\qquad \sum_j\xi_{ij}=0

    Parameters
    ----------
    moved : array_like, (..., N, d)
        What :func:`ensemble_transform` returned; N is at least two.
    ensemble : array_like, (..., N, d)
        The forecast.
    bandwidth : float
        h, at least 0: the covariance grows by about h² times the forecast's.
    rng : numpy.random.Generator

    Returns
    -------
    ndarray, (..., N, d)
        The added members lie in the forecast's span, and their mean is zero.

    Examples
    --------
    >>> x = np.array([[0.0], [1.0], [4.0]])
    >>> after = rejuvenated(np.zeros((3, 1)), x, bandwidth=0.1, rng=np.random.default_rng(0))
    >>> bool(abs(after.mean()) < 1e-15), len(set(after.ravel()))
    (True, 3)
    """
    x = _members(ensemble)
    y = array(moved, "moved", x.shape)
    if x.shape[-2] < 2:
        raise ValueError(f"ensemble: needs at least 2 members, got {x.shape[-2]}")
    h = number(bandwidth, "bandwidth", at_least=0)
    return _rejuvenated(y, x, h, generator(rng))


def _rejuvenated(y: Array, x: Array, h: float, rng: np.random.Generator) -> Array:
    n = x.shape[-2]
    drawn = rng.standard_normal((*x.shape[:-1], n))
    # Centring costs one part in N of the variance.
    drawn = (drawn - drawn.mean(axis=-2, keepdims=True)) * np.sqrt(n / (n - 1))
    around = x - x.mean(axis=-2, keepdims=True)
    return np.asarray(y + h / np.sqrt(n - 1) * (drawn @ around))
