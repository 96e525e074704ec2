"""Inversion of increasing functions of one variable, many at once, without a step out of bounds."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from ..checks import Array, SolverError, array, callable_, number

__all__ = ["invert"]

_DOUBLINGS = 60
"""Brackets grow to 2^60 before a target counts as out of range."""

_ROUNDING = 1e-13
"""A step settles below this share of one plus the value's size."""

_ITERATIONS = 200

Function = Callable[[Array], tuple[Array, Array]]
"""``function(v) -> (value, slope)``, element by element."""


def invert(
    function: Function, target: ArrayLike, *, start: float = 0.0, name: str = "target"
) -> Array:
    """Solve ``function(v) = target`` by Newton's method inside a shrinking bracket.

    A Newton step that would leave the bracket is replaced by a bisection, so the iteration
    converges wherever the function increases.

    Parameters
    ----------
    function : callable
        ``function(v) -> (value, slope)`` on arrays of the shape of `target`, element by element;
        every element may be a function of its own.
    target : array_like
        The values to reach.
    start : float
        Where the search for a bracket begins.
    name : str
        What an error calls the targets.

    Raises
    ------
    ValueError
        If a target is outside the function's range, or the function decreases somewhere on the
        way.
    SolverError
        If the iteration does not settle, as for a function with jumps.

    Examples
    --------
    >>> invert(lambda v: (np.sinh(v), np.cosh(v)), np.sinh([-2.0, 0.5])).round(9)
    array([-2. ,  0.5])
    """
    f = callable_(function, "function")
    aim = array(target, name, (...,))
    centre = number(start, "start")
    if not aim.size:
        return aim.copy()
    low, high = _bracket(f, aim, centre, name)
    return _newton(f, aim, low, high, 0.5 * (low + high))


def _newton(f: Function, aim: Array, low: Array, high: Array, v: Array) -> Array:
    """Newton's method from `v` between ends where the targets are reached."""
    moved = high - low
    for _ in range(_ITERATIONS):
        value, slope = _evaluated(f, v)
        gap = value - aim
        low, high = np.where(gap <= 0, v, low), np.where(gap >= 0, v, high)
        steep = slope > 0
        newton = v - gap / np.where(steep, slope, 1.0)
        step = np.abs(newton - v)
        enough = _ROUNDING * (1 + np.abs(v))
        # A step that has settled may stand on an end of its bracket; any other has to be inside
        # and half as long as the last, or Newton's method could go to and fro for ever.
        good = (newton > low) & (newton < high) & (step <= 0.5 * moved)
        new = np.where(steep & (good | (step <= enough)), newton, 0.5 * (low + high))
        moved = np.abs(new - v)
        v = new
        done = moved <= enough
        if done.all():
            # Halving settles at a jump as well, where the value is not reached.
            done = (step <= enough) | (np.abs(gap) <= 1e-9 * (1 + np.abs(aim)))
            if done.all():
                return np.asarray(v)
            break
    raise SolverError(f"invert: {int((~done).sum())} of {done.size} targets did not settle")


def _evaluated(f: Function, v: Array) -> tuple[Array, Array]:
    value, slope = (np.asarray(part) for part in f(v))
    if value.shape != v.shape or slope.shape != v.shape:
        raise ValueError(f"function: needs to return a value and a slope of shape {v.shape}")
    if not (slope >= 0).all():
        raise ValueError(
            f"function: needs an increasing function to invert, got slope {slope.min():.6g}"
        )
    return value, slope


def _bracket(f: Function, aim: Array, centre: float, name: str) -> tuple[Array, Array]:
    """Ends between which each target is reached."""
    ends = []
    for sign in (-1.0, 1.0):
        end = np.full(aim.shape, centre + sign)
        size = 1.0
        for _ in range(_DOUBLINGS):
            short = sign * (_evaluated(f, end)[0] - aim) < 0
            if not short.any():
                break
            size *= 2
            end = np.where(short, centre + sign * size, end)
        else:
            raise ValueError(
                f"{name}: needs targets inside the range of the map, got {int(short.sum())} of "
                f"{short.size} outside, such as {aim[short][0]:.6g}"
            )
        ends.append(end)
    return ends[0], ends[1]
