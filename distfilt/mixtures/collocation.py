"""Weights for fused mixands, so that the mixture meets the exact density at chosen points."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import svdvals
from scipy.optimize import nnls
from scipy.special import logsumexp

from ..checks import Array, SolverError, array, choice, count, number
from .gaussian import GaussianMixture, trusted
from .shapes import Shapes

__all__ = ["RULES", "collocation_weights", "nonnegative_least_squares", "tikhonov"]

RULES = ("C1", "C2", "C3", "points")
"""How fused mixands can be weighed."""

_CONDITION = 1e10
_FLOOR = 1e-3
"""Relative density below which the rows of "points" stop gaining weight."""


def tikhonov(largest: float, smallest: float, *, condition: float = _CONDITION) -> float:
    r"""The smallest factor that brings a matrix's condition number down to `condition`, (66).

    .. math:: \alpha^2=\frac{\sigma_1^2-\kappa^2\sigma_n^2}{\kappa^2-1}

    and 0 where the matrix is well conditioned already. The printed (66) has an index i where the
    largest singular value is meant.

    Parameters
    ----------
    largest, smallest : float
        Singular values, at least 0.
    condition : float
        Above 1.

    Examples
    --------
    >>> alpha = tikhonov(1.0, 0.0, condition=10.0)
    >>> round(float(np.sqrt(1 + alpha**2) / alpha), 9)
    10.0
    >>> tikhonov(1.0, 0.5, condition=10.0)
    0.0
    """
    top = number(largest, "largest", at_least=0, at_most=1e150)
    low = number(smallest, "smallest", at_least=0, at_most=top)
    k = number(condition, "condition", above=1, at_most=1e150)
    return float(np.sqrt(max(top**2 - (k * low) ** 2, 0.0) / (k**2 - 1)))


def nonnegative_least_squares(
    matrix: ArrayLike, right: ArrayLike, *, condition: float = _CONDITION
) -> Array:
    """Nonnegative weights that solve ``matrix @ w = right`` best, regularised by (60) and (66).

    Parameters
    ----------
    matrix : array_like, (n, S)
    right : array_like, (n,)
    condition : float
        The largest condition number allowed.

    Returns
    -------
    ndarray, (S,)

    Raises
    ------
    SolverError
        If the iteration does not end.

    Examples
    --------
    >>> nonnegative_least_squares([[1.0, 0.0], [0.0, 1.0]], [2.0, -1.0])
    array([2., 0.])
    """
    a = array(matrix, "matrix", ("n", "S"))
    b = array(right, "right", (a.shape[0],))
    if not a.size or np.abs(a).max() > 1e150:
        raise ValueError(f"matrix: needs entries of finite square, got shape {a.shape}")
    values = svdvals(a)
    small = float(values[-1]) if a.shape[0] >= a.shape[1] else 0.0
    alpha = tikhonov(float(values[0]), min(small, float(values[0])), condition=condition)
    if alpha > 0:
        a = np.concatenate([a, alpha * np.eye(a.shape[1])])
        b = np.concatenate([b, np.zeros(a.shape[1])])
    try:
        return np.asarray(nnls(a, b, maxiter=20 * a.shape[1])[0], dtype=np.float64)
    except RuntimeError as error:
        raise SolverError(
            f"nonnegative least squares stopped: {error} ({a.shape[1]} unknowns)"
        ) from None


def collocation_weights(
    shapes: Shapes,
    own: GaussianMixture,
    log_value: Callable[[Array], Array],
    log_update: Callable[[Array], Array],
    target_dim: int,
    *,
    rule: str = "C3",
    at_most: int = 500,
) -> GaussianMixture:
    """The mixture of given shapes whose weights come from the exact density at their means.

    Parameters
    ----------
    shapes : Shapes
        The mixands.
    own : GaussianMixture
        The prior, for C1.
    log_value, log_update : callable
        Logarithms of the exact fused density (..., d) -> (...) and of its update factor
        (..., n_t) -> (...), not normalised.
    target_dim : int
        How many components the target has.
    rule : {"C1", "C2", "C3", "points"}
        See :meth:`~distfilt.mixtures.PartialFusion.weigh`.
    at_most : int
        How many mixands may enter a least-squares problem.

    Returns
    -------
    GaussianMixture
        Mixands whose weight is zero are left out.
    """
    choice(rule, "rule", RULES)
    limit = count(at_most, "at_most")
    mixture = trusted(np.full(shapes.size, 1 / shapes.size), shapes.means, shapes.covs)
    if rule == "C1":
        gap = shapes.means - own.means[shapes.source]
        white = np.linalg.solve(own.factors[shapes.source], gap[..., None])[..., 0]
        logs = (own.log_weights + own.log_peaks)[shapes.source] - 0.5 * (white**2).sum(axis=-1)
        return _normalised(mixture, logs + log_update(shapes.means[:, :target_dim]))
    at_means = np.asarray(log_value(shapes.means))
    if rule == "C2":
        return _normalised(mixture, at_means)
    if shapes.size > limit:
        mass = at_means - mixture.log_peaks
        keep = np.sort(np.argsort(-mass, kind="stable")[:limit])
        return collocation_weights(
            shapes.select(keep), own, log_value, log_update, target_dim, rule=rule, at_most=limit
        )
    points = shapes.means if rule == "C3" else _sigma_points(mixture)
    logs = at_means if rule == "C3" else np.asarray(log_value(points))
    top = logs.max()
    matrix = np.exp(mixture._components(points) - mixture.log_peaks)
    right = np.exp(logs - top)
    if rule == "points":
        rows = 1 / np.sqrt(right + _FLOOR)
        matrix, right = matrix * rows[:, None], right * rows
    found = nonnegative_least_squares(matrix, right)
    with np.errstate(divide="ignore"):
        return _normalised(mixture, np.log(found))


def _normalised(mixture: GaussianMixture, logs: Array) -> GaussianMixture:
    """Weights from the logarithms of EQ coefficients, by (18); what vanishes is left out."""
    mass = logs - mixture.log_peaks
    total = logsumexp(mass)
    if not np.isfinite(total):
        raise SolverError("no fused mixand has a weight: the exact density is zero at every point")
    w = np.exp(mass - total)
    keep = w > 0
    return trusted(w[keep] / w[keep].sum(), mixture.means[keep], mixture.covs[keep])


def _sigma_points(mixture: GaussianMixture) -> Array:
    """Means and means ± sqrt(d) columns of the factors, (S (2d + 1), d)."""
    moves = np.sqrt(mixture.dim) * np.swapaxes(mixture.factors, -1, -2)
    around = np.concatenate([0 * moves[:, :1], moves, -moves], axis=1)
    return np.asarray((mixture.means[:, None] + around).reshape(-1, mixture.dim))
