"""A user's functions of many states: what they return, and whether each row is what it is alone."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from .values import Array

__all__ = ["batched"]

_UNBATCHED = (
    "{}: needs to take many states at once, (..., d), with the components last "
    "(x[..., 0], not x[0]); for states {} it gives {}"
)


def batched(
    function: Callable[..., Any], name: str, states: tuple[Array, ...], size: int,
    seen: dict[str, bool], *rest: float
) -> Array:
    """What a function makes of states (..., d), as (..., size); it gets copies.

    A function that was written for one state may return the right shape with wrong numbers. So the
    first rows that differ are compared with one of them alone.

    Parameters
    ----------
    function, name
        A user's, and what an error calls it.
    states : tuple of ndarray, (..., d)
        Its first arguments.
    size : int
        How many components it returns.
    seen : dict
        Where it is noted that the function has been compared.
    *rest
        Its other arguments.

    Examples
    --------
    >>> x = np.array([[1.0, 2.0], [3.0, 4.0]])
    >>> batched(lambda x: x[..., ::-1], "flow", (x,), 2, {})
    array([[2., 1.],
           [4., 3.]])
    >>> batched(lambda x: np.array([x[1], x[0]]), "flow", (x,), 2, {})
    Traceback (most recent call last):
    ValueError: flow: needs to take many states at once, (..., d), with the components last \
(x[..., 0], not x[0]); for states (2, 2) it gives other values than for one
    """
    x, wanted = states[0], (*states[0].shape[:-1], size)
    try:
        out = np.asarray(function(*[s.copy() for s in states], *rest), dtype=np.float64)
    except (TypeError, ValueError, IndexError) as error:
        if _takes_one_only(function, states, size, rest):
            raise ValueError(_UNBATCHED.format(name, x.shape, error)) from error
        if isinstance(error, IndexError):
            raise ValueError(f"x: needs more components, got {x.shape}") from error
        raise
    if out.shape != wanted:
        if _takes_one_only(function, states, size, rest):
            raise ValueError(_UNBATCHED.format(name, x.shape, f"shape {out.shape}"))
        raise ValueError(
            f"{name}: needs to return shape {wanted} for states {x.shape}, got {out.shape}"
        )
    if name not in seen and x.ndim > 1 and x.size:
        _compare(function, name, states, out, seen, rest)
    return out


def _made(function: Callable[..., Any], states: tuple[Array, ...], *rest: Any) -> Array | None:
    """What a function returns, if anything."""
    try:
        return np.asarray(function(*[s.copy() for s in states], *rest), dtype=np.float64)
    except (TypeError, ValueError, IndexError):
        return None


def _last(states: tuple[Array, ...]) -> tuple[Array, ...]:
    return tuple(s.reshape(-1, s.shape[-1])[-1] for s in states)


def _takes_one_only(
    function: Callable[..., Any], states: tuple[Array, ...], size: int, rest: tuple[float, ...]
) -> bool:
    """Whether a function that failed takes the last state alone, but not in many copies."""
    if states[0].ndim < 2 or not states[0].size:
        return False
    last = _last(states)
    copies = tuple(np.broadcast_to(s, like.shape) for s, like in zip(last, states, strict=True))
    alone, many = _made(function, last, *rest), _made(function, copies, *rest)
    wanted = (*states[0].shape[:-1], size)
    return alone is not None and alone.shape == (size,) and (many is None or many.shape != wanted)


def _compare(
    function: Callable[..., Any], name: str, states: tuple[Array, ...], out: Array,
    seen: dict[str, bool], rest: tuple[float, ...]
) -> None:
    rows, last = states[0].reshape(-1, states[0].shape[-1]), out.reshape(-1, out.shape[-1])[-1]
    alone = _made(function, _last(states), *rest)
    if alone is not None and alone.shape == last.shape:
        # Rules of adaptive step differ a little; wrong rows differ as much as the states move.
        moved = alone - rows[-1] if alone.shape == rows[-1].shape else alone
        bound = 1e-2 * np.abs(moved).max() + 1e-9 * np.abs(alone).max()
        if not (np.isnan(last) == np.isnan(alone)).all() or (np.abs(last - alone) > bound).any():
            raise ValueError(_UNBATCHED.format(name, states[0].shape, "other values than for one"))
    if (rows[0] != rows[-1]).any():
        seen[name] = True
