"""Derivatives by central differences, for whoever has no formula."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from .checks import Array, array, callable_

__all__ = ["central"]

_STEP = 6e-6
"""About the cube root of the rounding unit, where truncation and rounding balance."""


def central(
    function: Callable[[Array], Array],
    x: ArrayLike,
    *,
    difference: Callable[[Array, Array], Array] = np.subtract,
) -> Array:
    """Derivative (..., m, d) by central differences, all 2 d moves in two calls.

    Its error is about 1e-10 of the function's scale.

    Parameters
    ----------
    function : callable
        ``function(x) -> y`` on (..., d) to (..., m).
    x : array_like, (..., d)
        Where.
    difference : callable
        ``difference(ahead, behind)``, for values that wrap; subtraction by default.

    Examples
    --------
    >>> central(lambda x: x**2, [1.0, 3.0]).round(8)
    array([[2., 0.],
           [0., 6.]])
    """
    callable_(function, "function")
    callable_(difference, "difference")
    place = array(x, "x", (..., "d"))
    value = np.asarray(function(place.copy()))
    if value.dtype.kind not in "fiub" or value.shape[:-1] != place.shape[:-1] or not value.ndim:
        raise ValueError(
            f"function: needs to return numbers (..., m) for {place.shape}, "
            f"got {value.dtype} of shape {value.shape}"
        )
    return _central(function, place, difference)


def _central(
    function: Callable[[Array], Array], x: Array, difference: Callable[[Array, Array], Array]
) -> Array:
    h = _STEP * np.maximum(1.0, np.abs(x))
    ahead = x[..., None, :] + h[..., None] * np.eye(x.shape[-1])
    behind = x[..., None, :] - h[..., None] * np.eye(x.shape[-1])
    # What was moved by, after rounding, is the difference of the two states.
    moved = np.diagonal(ahead - behind, axis1=-2, axis2=-1)
    slope = difference(function(ahead), function(behind)) / moved[..., None]
    return np.asarray(np.swapaxes(slope, -1, -2))
