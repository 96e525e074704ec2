"""Simple rules for members that break a constraint: clip, refuse, or read the constraint."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from ..checks import Array, array, number
from .constraints import Constraint, _constraint, _retract

__all__ = ["accepted", "augmented_readings", "clip"]


def clip(states: ArrayLike, constraint: Constraint) -> Array:
    r"""Put states that violate :math:`\mathbf g(\mathbf x)\le\mathbf d` on its boundary.

    Parameters
    ----------
    states : array_like, (..., d)
        Those inside stay as they are.
    constraint : Constraint
        One inequality, s = 1.

    Returns
    -------
    ndarray, (..., d)

    Raises
    ------
    ValueError, SolverError
        As :func:`retract`.

    Examples
    --------
    >>> from distfilt.coupling import norm
    >>> clip([[3.0, 4.0], [0.1, 0.0]], norm([0, 1])).round(12)
    array([[0.6, 0.8],
           [0.1, 0. ]])
    """
    x = array(states, "states", (..., "d"))
    if _constraint(constraint).value.size != 1:
        raise ValueError(f"constraint: needs one inequality, got {constraint.value.size}")
    out = x.copy()
    outside = constraint._residual(x)[..., 0] > 0
    if outside.any():
        out[outside] = _retract(out[outside], constraint, None, 1e-15, 50)
    return out


def accepted(
    log_weights: ArrayLike, ensemble: ArrayLike, constraint: Constraint, *, tolerance: float = 0.0
) -> Array:
    r"""Give members that violate :math:`\mathbf g(\mathbf x)\le\mathbf d` no weight.

    Accept or reject, the paper's baseline for particle filters. Averages of accepted members stay
    in a convex set. For an equality, pass the distance to it and a tolerance.

    Parameters
    ----------
    log_weights : array_like, (..., N)
        Logarithms of weights.
    ensemble : array_like, (..., N, d)
    constraint : Constraint
    tolerance : float
        By how much a component of g may exceed d, at least 0.

    Returns
    -------
    ndarray, (..., N)

    Raises
    ------
    ValueError
        If no member of an ensemble is left: with every member outside the filter has failed.

    Examples
    --------
    >>> from distfilt.coupling import norm
    >>> accepted([0.0, 0.0], [[2.0], [0.5]], norm([0]))
    array([-inf,   0.])
    """
    x = array(ensemble, "ensemble", (..., "N", "d"))
    w = array(log_weights, "log_weights", x.shape[:-1], finite=False)
    if not (w < np.inf).all():
        raise ValueError("log_weights: needs numbers or minus infinity, got NaN or infinity")
    least = number(tolerance, "tolerance", at_least=0)
    inside = (_constraint(constraint)._residual(x) <= least).all(axis=-1)
    if not inside.any(axis=-1).all():
        raise ValueError(f"ensemble: needs a member inside the constraint, got none of {w.shape}")
    return np.asarray(np.where(inside, w, -np.inf))


def augmented_readings(
    ensemble: ArrayLike,
    predicted: ArrayLike,
    observed: ArrayLike,
    noise: ArrayLike,
    constraint: Constraint,
    *,
    std: float,
) -> tuple[Array, Array, Array]:
    """The constraint as one more reading, nearly without noise, equation (13).

    Parameters
    ----------
    ensemble : array_like, (..., N, d)
    predicted : array_like, (..., N, m)
    observed : array_like, (..., m)
    noise : array_like, (m, m) or (..., m, m)
    constraint : Constraint
    std : float
        Standard deviation of the pretended noise in the units of g, positive. Small values weigh
        the members by the constraint alone and leave few of them.

    Returns
    -------
    predicted : ndarray, (..., N, m + s)
    observed : ndarray, (..., m + s)
    noise : ndarray, (..., m + s, m + s)

    Examples
    --------
    >>> from distfilt.coupling import norm
    >>> _, y, r = augmented_readings([[1.0]], [[1.0]], [2.0], [[4.0]], norm([0]), std=0.1)
    >>> y, np.diag(r)
    (array([2., 1.]), array([4.  , 0.01]))
    """
    x = array(ensemble, "ensemble", (..., "N", "d"))
    h = array(predicted, "predicted", (*x.shape[:-1], "m"))
    y = array(observed, "observed", (*x.shape[:-2], h.shape[-1]), finite=False)
    r = array(noise, "noise", (..., h.shape[-1], h.shape[-1]))
    spread = number(std, "std", above=0, at_most=1e150)
    return _augmented(x, h, y, r, _constraint(constraint), spread)


def _augmented(
    x: Array, h: Array, y: Array, r: Array, constraint: Constraint, std: float
) -> tuple[Array, Array, Array]:
    m, s = h.shape[-1], constraint.value.size
    seen = constraint._residual(x) + constraint.value
    target = np.broadcast_to(constraint.value, (*y.shape[:-1], s))
    noise = np.zeros((*r.shape[:-2], m + s, m + s))
    noise[..., :m, :m], noise[..., m:, m:] = r, std**2 * np.eye(s)
    return np.concatenate([h, seen], axis=-1), np.concatenate([y, target], axis=-1), noise
