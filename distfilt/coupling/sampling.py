"""Sampling on a set: the transform within convex pieces, and along a curved surface."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from ..checks import Array, array, callable_, choice, generator
from .solvers import SOLVERS, _scaled, _solver
from .transform import _members, _plans, _ties, _weights

__all__ = ["transform_along", "transform_within"]


def transform_within(
    ensemble: ArrayLike,
    log_weights: ArrayLike,
    pieces: ArrayLike,
    *,
    rng: np.random.Generator,
    solver: str = "network",
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
        Chooses the pieces, systematically: each gets its share of the members to within one or
        two.
    solver : str
        As for :func:`~distfilt.coupling.plan`.

    Returns
    -------
    ndarray, (N, d)
        The mean is the weighted mean on average over the choice.

    Examples
    --------
    >>> x = [[-1.0], [-0.9], [0.9], [1.0]]
    >>> y = transform_within(x, np.log([0.4, 0.1, 0.1, 0.4]), [0, 0, 1, 1],
    ...                      rng=np.random.default_rng(0))
    >>> bool((np.abs(y) >= 0.9).all())
    True
    """
    x = array(ensemble, "ensemble", ("N", "d"))
    w = _weights(log_weights, x.shape[:-1])
    labels = np.asarray(pieces)
    if labels.shape != w.shape or labels.dtype.kind not in "iu":
        raise ValueError(f"pieces: needs {w.size} integers, got shape {labels.shape}")
    generator(rng)
    solve = _solver(choice(solver, "solver", SOLVERS), 0.01)
    matrix = x.shape[0] * _plans(x, w, solve)
    names, index = np.unique(labels, return_inverse=True)
    belongs = (index == np.arange(names.size)[:, None]).astype(np.float64)
    share = belongs @ matrix
    chosen = _chosen(share, rng)
    kept = matrix * belongs[chosen].T
    return np.asarray(kept.T @ x / kept.sum(axis=0)[:, None])


def _chosen(share: Array, rng: np.random.Generator) -> Array:
    """For each column one row, as probable as its share; each row's total hardly varies.

    Row by row, the columns that are still free are laid end to end, each as long as its chance,
    and those that hold a level k + u are taken.
    """
    left, order = np.arange(share.shape[1]), np.full(share.shape[1], share.shape[0] - 1)
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


def transform_along(
    ensemble: ArrayLike,
    log_weights: ArrayLike,
    *,
    difference: Callable[[Array, Array], Array],
    retract: Callable[[Array, Array], Array],
    solver: str = "network",
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
    solver : str
        As for :func:`~distfilt.coupling.plan`.

    Returns
    -------
    ndarray, (..., N, d)
        On the set as nearly as `retract` leads there.

    Examples
    --------
    Angles on both sides of ±π; the plain average of the second pair would be near zero.

    >>> def wrapped(a, b):
    ...     return (a - b + np.pi) % (2 * np.pi) - np.pi
    >>> transform_along([[3.0], [-3.0]], np.log([0.75, 0.25]), difference=wrapped,
    ...                 retract=lambda x, v: wrapped(x + v, 0.0)).round(3)
    array([[ 3.   ],
           [-3.142]])
    """
    x = _members(ensemble)
    w = _weights(log_weights, x.shape[:-1])
    callable_(difference, "difference")
    callable_(retract, "retract")
    solve = _solver(choice(solver, "solver", SOLVERS), 0.01)
    n = x.shape[-2]
    equal = np.full(n, 1 / n)
    there, here = np.broadcast_arrays(x[..., :, None, :], x[..., None, :, :])
    v = array(difference(there.copy(), here.copy()), "difference", (*x.shape[:-1], n, "k"))
    costs = (v * v).sum(axis=-1)
    steps = np.empty((*x.shape[:-1], v.shape[-1]))
    for row in np.ndindex(x.shape[:-2]):
        matrix, _ = solve(_scaled(costs[row])[0] + _ties(n), w[row], equal)
        steps[row] = n * np.einsum("ij,ijk->jk", matrix, v[row])
    return array(retract(x.copy(), steps), "retract", x.shape)
