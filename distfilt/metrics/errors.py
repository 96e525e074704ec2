"""Errors against the truth, and the spread that an ensemble says they have."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ..checks import Array, array
from ..linalg import _leading

__all__ = ["rmse", "spread", "squared_error"]


def _ensemble(value: ArrayLike, members: int = 1) -> Array:
    out = array(value, "ensemble", (..., "N", "d"))
    if out.shape[-2] < members:
        raise ValueError(f"ensemble: needs at least {members} members, got {out.shape[-2]}")
    if out.shape[-1] < 1:
        raise ValueError(f"ensemble: needs at least one component, got shape {out.shape}")
    return out


def _truth(value: ArrayLike, like: tuple[int, ...]) -> Array:
    """The truth as (..., d), where `like` is the shape (..., d) that it has to broadcast with."""
    out = array(value, "truth", (..., like[-1]))
    _leading(like[:-1], out.shape[:-1], "truth")
    return out


def squared_error(estimate: ArrayLike, truth: ArrayLike, *, per_component: bool = False) -> Array:
    r"""Squared length of the error, :math:`\lVert\hat{\mathbf x}-\mathbf x\rVert^2`.

    A sum over the components, not a mean, in units of the state squared.

    Parameters
    ----------
    estimate, truth : array_like, (..., d)
        Leading axes broadcast.
    per_component : bool
        Give the squared error of each component instead.

    Examples
    --------
    >>> float(squared_error([1.0, 2.0], [4.0, 6.0]))
    25.0
    >>> squared_error([1.0, 2.0], [4.0, 6.0], per_component=True)
    array([ 9., 16.])
    """
    e = array(estimate, "estimate", (..., "d"))
    square = (e - _truth(truth, e.shape)) ** 2
    return square if _flag(per_component) else np.asarray(square.sum(axis=-1))


def _flag(value: Any) -> bool:
    if not isinstance(value, bool | np.bool_):
        raise ValueError(f"per_component: needs True or False, got {value!r}")
    return bool(value)


def rmse(
    estimate: ArrayLike, truth: ArrayLike, *, axis: int | tuple[int, ...] | None = None,
    per_component: bool = False,
) -> Array:
    r"""Root of the mean squared length of the error.

    :math:`\sqrt{\operatorname{mean}\lVert\hat{\mathbf x}-\mathbf x\rVert^2}`: squared lengths are
    sums over the components; the mean goes over the leading axes in `axis`; the root comes last.

    Parameters
    ----------
    estimate, truth : array_like, (..., d)
        Leading axes broadcast.
    axis : int or tuple of int, optional
        Axes of the *leading* shape (...), so -1 is the one before the components. All of them by
        default, ``()`` for none.
    per_component : bool
        Give one number for each component instead, each in its own unit.

    Returns
    -------
    ndarray
        The leading shape without `axis`, in the state's unit, (..., d) with `per_component`.

    Examples
    --------
    >>> float(rmse([[3.0, 4.0], [0.0, 0.0]], [0.0, 0.0]).round(6))
    3.535534
    >>> rmse([[3.0, 4.0], [0.0, 0.0]], [0.0, 0.0], per_component=True).round(6)
    array([2.12132 , 2.828427])
    """
    square = squared_error(estimate, truth, per_component=True)
    axes = _axes(axis, square.ndim - 1)
    if square.size == 0:
        raise ValueError(f"estimate: needs at least one error to average, got shape {square.shape}")
    if not _flag(per_component):
        square = square.sum(axis=-1)
    return np.asarray(np.sqrt(square.mean(axis=axes)))


def _axes(axis: int | tuple[int, ...] | None, ndim: int) -> tuple[int, ...]:
    if axis is None:
        return tuple(range(ndim))
    given = axis if isinstance(axis, tuple) else (axis,)
    whole = all(
        isinstance(k, int | np.integer) and not isinstance(k, bool | np.timedelta64) for k in given
    )
    if not whole or any(not -ndim <= k < ndim for k in given):
        raise ValueError(f"axis: needs integers among the {ndim} leading axes, got {axis!r}")
    found = tuple(int(k) % ndim for k in given)
    if len(set(found)) != len(found):
        raise ValueError(f"axis: needs distinct axes, got {axis!r}")
    return found


def spread(ensemble: ArrayLike, *, per_component: bool = False) -> Array:
    r"""Root of the trace of the sample covariance: what the ensemble says its `rmse` should be.

    The trace sums the components' variances as `rmse` sums their squared errors, so the two are
    comparable: mean ``spread**2`` times 1 + 1/N matches mean squared error for an honest ensemble.
    Average over runs or times the square, and take the root last.

    Parameters
    ----------
    ensemble : array_like, (..., N, d)
        At least two members.
    per_component : bool
        Give each component's standard deviation instead.

    Returns
    -------
    ndarray, (...) or (..., d)
        In the state's unit.

    Examples
    --------
    >>> float(spread([[0.0, 0.0], [2.0, 0.0], [4.0, 0.0]]))
    2.0
    """
    x = _ensemble(ensemble, 2)
    variance = x.var(axis=-2, ddof=1)
    return np.asarray(np.sqrt(variance if _flag(per_component) else variance.sum(axis=-1)))
