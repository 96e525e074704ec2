r"""The ensemble transform: a coupling that turns weighted members into equally weighted ones.

With the optimal coupling :math:`\mathbf T` of the weights to equal masses, each new member is an
average of old ones,

.. math:: \mathbf x_j^+ = N\sum_i t_{ij}\,\mathbf x_i,

equation (3) of Das and Bhattacharya after S. Reich, SIAM Journal on Scientific Computing 35 (2013)
A2013-A2024. The mean of the new members is the weighted mean, exactly. Within convex pieces and
along a curved surface it samples sets.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from functools import lru_cache
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike

from ..ensembles import Ensemble
from ..linalg import EPS, factor
from ..validation import (
    Array,
    Indices,
    NonNegativeFloat,
    PositiveFloat,
    Rng,
    check_array,
    validated,
)
from .solvers import SQUARED, Solve, Solver, scale_cost, solver_of, squared_distances

__all__ = [
    "transform_ensemble",
    "transport_plans",
    "rejuvenate",
    "second_order",
    "transform_along",
    "transform_within",
]

Members = Annotated[Array, "... n d", SQUARED]
AsMoved = Annotated[Array, "*moved.shape", SQUARED]

_TIE = 1e-7
"""In units of the largest cost. The weighted mean stays exact, the plan costs at most this more."""


def normalize_weights(
    log_weights: ArrayLike, shape: tuple[int, ...] | None = None
) -> Array:
    """Weights (..., N) that sum to one, from logarithms of any size; -inf is a weight of zero."""
    w = check_array(log_weights, "log_weights", shape, finite=False)
    top = w.max(axis=-1, keepdims=True)
    if np.isneginf(top).any():
        raise ValueError(
            "log_weights must be a positive weight in every ensemble, got only zeros"
        )
    if not np.isfinite(top).all():
        raise ValueError(
            "log_weights must be numbers below infinity, got NaN or infinity"
        )
    if w.shape[-1] > 2 and w.min() >= 0 and np.allclose(w.sum(axis=-1), 1):
        warnings.warn(
            "log_weights must have logarithms, got a sum of 1",
            RuntimeWarning,
            stacklevel=4,
        )
    w = np.exp(w - top)
    return np.asarray(w / w.sum(axis=-1, keepdims=True))


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


@validated
def transport_plans(ensemble: Members, log_weights: ArrayLike) -> Array:
    """Optimal couplings of weighted members to the same members with equal weights.

    Parameters
    ----------
    ensemble : array_like, (..., N, d)
        Members.
    log_weights : array_like, (..., N)
        Logarithms of their weights, in any normalisation.

    Returns
    -------
    ndarray, (..., N, N)
        Row i is where the mass of member i goes; the cost is the squared distance. Where it leaves
        a choice, as between copies of a member, a fixed addition of at most 1e-7 of the largest
        cost decides.

    Examples
    --------
    >>> transport_plans([[0.0], [1.0]], np.log([0.75, 0.25]))
    array([[0.5 , 0.25],
           [0.  , 0.25]])
    """
    w = normalize_weights(log_weights, ensemble.shape[:-1])
    return _plans(ensemble, w, solver_of("network"))


def _plans(x: Array, w: Array, solve: Solve) -> Array:
    """Couplings (..., N, N) of the weights to equal masses, for the squared distance."""
    points = x.reshape(-1, *x.shape[-2:])
    costs = np.array([squared_distances(p) for p in points])
    return _coupled(costs.reshape(*w.shape, w.shape[-1]), w, solve)


def _coupled(costs: Array, w: Array, solve: Solve) -> Array:
    """Couplings for costs (..., N, N)."""
    n = w.shape[-1]
    equal = np.full(n, 1 / n)
    ties = _ties(n)
    out = np.empty_like(costs)
    for row in np.ndindex(w.shape[:-1]):
        out[row], _ = solve(scale_cost(costs[row])[0] + ties, w[row], equal)
    return out


@validated
def transform_ensemble(
    ensemble: Members,
    log_weights: ArrayLike,
    *,
    solver: Solver = "network",
    regularisation: PositiveFloat = 0.01,
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
        already. An entropic plan shrinks the ensemble; this undoes most of it. An optimal plan
        needs none: it only swaps what lies within the tie-breaker of :func:`plans`.
    correct : bool
        Give the new members the weighted covariance too, by :func:`second_order`.

    Returns
    -------
    ndarray, (..., N, d)

    Raises
    ------
    SolverError
        If the solver stops without a solution.

    Examples
    --------
    >>> transform_ensemble([[0.0], [1.0]], np.log([0.75, 0.25]))
    array([[0. ],
           [0.5]])
    >>> bool(transform_ensemble([[0.0], [1.0]], [-1e4, -2e4])[1, 0] == 0.0)
    True
    """
    x = ensemble
    w = normalize_weights(log_weights, ensemble.shape[:-1])
    solve = solver_of(solver, regularisation)
    out = apply_plan(x, w, _plans(x, w, solve))
    if debias:
        equal = np.full(w.shape, 1 / x.shape[-2])
        out += x - apply_plan(x, equal, _plans(x, equal, solve))
        out += w[..., None, :] @ x - out.mean(axis=-2, keepdims=True)
    return _second_order(out, x, w) if correct else out


def apply_plan(x: Array, w: Array, matrix: Array, *, correct: bool = False) -> Array:
    """Members with weights w after a coupling `matrix` of w to equal masses, (3)."""
    centre = w[..., None, :] @ x
    out = np.asarray(centre + x.shape[-2] * (matrix.mT @ (x - centre)))
    return _second_order(out, x, w) if correct else out


@validated
def second_order(moved: Members, ensemble: AsMoved, log_weights: ArrayLike) -> Array:
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
    >>> float(second_order(transform_ensemble(x, logs), x, logs).var().round(12))
    0.1875
    """
    return _second_order(
        moved, ensemble, normalize_weights(log_weights, ensemble.shape[:-1])
    )


def _second_order(y: Array, x: Array, w: Array) -> Array:
    n = x.shape[-2]
    centre = w[..., None, :] @ x
    around = x - centre
    spread = y - y.mean(axis=-2, keepdims=True)
    root = _graded(around.mT @ (w[..., None] * around))
    # With P = K K' the anomalies times B are the nearest orthonormal columns to those times K,
    # times K': P comes out to rounding, however little C has left of it in some direction.
    turned = spread @ root
    u, sizes, v = np.linalg.svd(turned, full_matrices=False)
    # What rounding leaves in a direction where there is nothing: of the members, of the columns.
    axes = v.mT
    members, columns = (np.abs(z).max(axis=-2, keepdims=True) for z in (y, turned))
    lost = n * EPS * (members @ np.abs(root @ axes) + columns @ np.abs(axes))
    u = u * (sizes[..., None, :] > lost)
    u -= u.mean(axis=-2, keepdims=True)
    return np.asarray(centre + np.sqrt(n) * (u @ v @ root.mT))


def _graded(cov: Array) -> Array:
    """A factor K of covariances K K', triangular from the widest component to the narrowest.

    Its columns then shrink as the components do, and no unit drowns in the rounding of another.
    """
    order = np.argsort(-np.diagonal(cov, axis1=-2, axis2=-1), axis=-1, kind="stable")
    rows = np.take_along_axis(cov, order[..., :, None], axis=-2)
    lower = factor(np.take_along_axis(rows, order[..., None, :], axis=-1))
    return np.take_along_axis(lower, np.argsort(order, axis=-1)[..., :, None], axis=-2)


@validated
def rejuvenate(
    moved: Annotated[Ensemble, SQUARED],
    ensemble: AsMoved,
    *,
    bandwidth: NonNegativeFloat,
    rng: Rng,
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
    >>> after = rejuvenate(
    ...     np.zeros((3, 1)), x, bandwidth=0.1, rng=np.random.default_rng(0)
    ... )
    >>> bool(abs(after.mean()) < 1e-15), len(set(after.ravel()))
    (True, 3)
    """
    x = ensemble
    n = ensemble.shape[-2]
    drawn = rng.standard_normal((*x.shape[:-1], n))
    # Centring costs one part in N of the variance.
    drawn = (drawn - drawn.mean(axis=-2, keepdims=True)) * np.sqrt(n / (n - 1))
    around = x - x.mean(axis=-2, keepdims=True)
    return np.asarray(moved + bandwidth / np.sqrt(n - 1) * (drawn @ around))


@validated
def transform_within(
    ensemble: Annotated[Array, "n d"],
    log_weights: ArrayLike,
    pieces: Annotated[Indices, "n"],
    *,
    rng: Rng,
) -> Array:
    r"""The transform on a set cut into pieces: no average crosses from one piece to another.

    Each new member chooses a piece p with probability :math:`N\sum_{i\in p}t_{ij}` and is the
    average within it. Convex pieces hold their averages, so no member leaves the set. One piece is
    :func:`ensemble_transform`; a piece for every member is random resampling by the plan.

    Parameters
    ----------
    ensemble : array_like, (N, d)
        Members.
    log_weights : array_like, (N,)
        Logarithms of their weights.
    pieces : array_like of int, (N,)
        The number of each member's piece.
    rng : numpy.random.Generator
        Chooses the pieces, systematically: each gets its share of the members on average, and
        hardly more or less of them (by four or five where many pieces are interleaved).

    Returns
    -------
    ndarray, (N, d)
        The mean is the weighted mean on average over the choice.

    Examples
    --------
    >>> x = [[-1.0], [-0.9], [0.9], [1.0]]
    >>> y = transform_within(
    ...     x, np.log([0.4, 0.1, 0.1, 0.4]), [0, 0, 1, 1], rng=np.random.default_rng(0)
    ... )
    >>> bool((np.abs(y) >= 0.9).all())
    True
    """
    matrix = len(ensemble) * transport_plans(ensemble, log_weights)
    names, index = np.unique(pieces, return_inverse=True)
    belongs = (index == np.arange(names.size)[:, None]).astype(np.float64)
    chosen = _chosen(belongs @ matrix, rng)
    kept = matrix * belongs[chosen].T
    return np.asarray(kept.T @ ensemble / kept.sum(axis=0)[:, None])


def _chosen(share: Array, rng: np.random.Generator) -> Array:
    """For each column one row, as probable as its share; each row's total hardly varies.

    Row by row, the columns that are still free are laid end to end, each as long as its chance,
    and those that hold a level k + u are taken.
    """
    left = np.arange(share.shape[1])
    order = np.full(share.shape[1], share.shape[0] - 1)
    rest = np.cumsum(share[::-1], axis=0)[::-1]
    for row in range(share.shape[0] - 1):
        chance = share[row, left] / np.where(rest[row, left] > 0, rest[row, left], 1.0)
        levels = np.floor(np.cumsum(chance) + rng.random())
        taken = np.diff(levels, prepend=0.0) > 0
        order[left[taken]] = row
        left = left[~taken]
    # By rounding a column could be left with a row of zero share.
    bare = share[order, np.arange(order.size)] <= 0
    return np.asarray(np.where(bare, share.argmax(axis=0), order))


@validated
def transform_along(
    ensemble: Members,
    log_weights: ArrayLike,
    *,
    difference: Callable[[Array, Array], Array],
    retract: Callable[[Array, Array], Array],
) -> Array:
    r"""The transform on a curved set: averages of tangent vectors, moved back onto the set.

    .. math:: \mathbf x_j^+ = \operatorname{retract}\Bigl(\mathbf x_j,\;
        N\sum_it_{ij}\operatorname{difference}(\mathbf x_i,\mathbf x_j)\Bigr)

    with the cost :math:`|\operatorname{difference}(\mathbf x_i,\mathbf x_j)|^2`.

    Parameters
    ----------
    ensemble : array_like, (..., N, d)
        Members on the set.
    log_weights : array_like, (..., N)
        Logarithms of their weights.
    difference : callable
        ``difference(to, here) -> v``, (..., k): the tangent vector at `here` that points to `to`,
        both (..., d). On a circle the angle between them, wrapped.
    retract : callable
        ``retract(here, v) -> x``, (..., d): where it leads.

    Returns
    -------
    ndarray, (..., N, d)
        On the set as nearly as `retract` leads there.

    Examples
    --------
    Angles on both sides of ±π; the plain average of the second pair would be near zero.

    >>> def wrapped(a, b):
    ...     return (a - b + np.pi) % (2 * np.pi) - np.pi
    >>> transform_along(
    ...     [[3.0], [-3.0]],
    ...     np.log([0.75, 0.25]),
    ...     difference=wrapped,
    ...     retract=lambda x, v: wrapped(x + v, 0.0),
    ... ).round(3)
    array([[ 3.   ],
           [-3.142]])
    """
    x = ensemble
    n = ensemble.shape[-2]
    w = normalize_weights(log_weights, x.shape[:-1])
    there, here = np.broadcast_arrays(x[..., :, None, :], x[..., None, :, :])
    v = check_array(
        difference(there.copy(), here.copy()), "difference", (*x.shape[:-1], n, "k")
    )
    matrix = _coupled((v * v).sum(axis=-1), w, solver_of("network"))
    steps = n * np.einsum("...ij,...ijk->...jk", matrix, v)
    return check_array(retract(x.copy(), steps), "retract", x.shape)
