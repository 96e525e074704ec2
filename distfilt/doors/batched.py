"""A user's functions of many states: what they return, and whether each row is what it is alone."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from .values import Array

__all__ = ["batched"]


def batched(owner: Any, name: str, states: Sequence[Array], *rest: float) -> Array:
    """What a function makes of states (..., d), as (..., ``owner.dim``); it gets copies.

    A function that was written for one state may return the right shape with wrong numbers. So the
    first rows that differ are compared with one of them alone.

    Parameters
    ----------
    owner, name
        Where a user's function is, and as what.
    states : sequence of ndarray, (..., d)
        Its first arguments.
    rest
        Its other arguments.

    Examples
    --------
    >>> from types import SimpleNamespace
    >>> x = np.array([[1.0, 2.0], [3.0, 4.0]])
    >>> batched(SimpleNamespace(dim=2, flow=lambda x: x[..., ::-1]), "flow", [x])
    array([[2., 1.],
           [4., 3.]])
    >>> one = SimpleNamespace(dim=2, flow=lambda x: np.array([x[1], x[0]]))
    >>> batched(one, "flow", [x])
    Traceback (most recent call last):
    ValueError: flow: needs to take many states at once, ...
    """
    function, x = getattr(owner, name), states[0]
    out, wanted = _made(function, states, rest), (*x.shape[:-1], owner.dim)
    fits = np.shape(out) == wanted
    if x.ndim > 1 and x.size and not (fits and "_compared" in vars(owner)):
        last = [s.reshape(-1, s.shape[-1])[-1] for s in states]
        alone, got = _made(function, last, rest), ""
        if fits:
            row = out.reshape(-1, owner.dim)[-1]
            got = "other values than for one" if _differs(row, alone, last) else ""
        elif np.shape(alone) == (owner.dim,):
            copies = [np.broadcast_to(one, s.shape) for one, s in zip(last, states, strict=True)]
            if np.shape(_made(function, copies, rest)) != wanted:
                got = str(out) if isinstance(out, Exception) else f"shape {out.shape}"
        if got:
            raise ValueError(
                f"{name}: needs to take many states at once, (..., d), with the components last "
                f"(x[..., 0], not x[0]); for states {x.shape} it gives {got}"
            )
        if fits and (x.reshape(-1, x.shape[-1])[0] != last[0]).any():
            vars(owner)["_compared"] = True
    if isinstance(out, IndexError):
        raise ValueError(f"x: needs more components, got {x.shape}") from out
    if isinstance(out, Exception):
        raise out
    if not fits:
        raise ValueError(f"{name}: needs to return shape {wanted} for states {x.shape}, "
                         f"got {out.shape}")
    return np.asarray(out)


def _made(function: Callable[..., Any], states: Sequence[Array], rest: tuple[float, ...]) -> Any:
    """What a function returns, or the error that it raises."""
    try:
        return np.asarray(function(*[s.copy() for s in states], *rest), dtype=np.float64)
    except (TypeError, ValueError, IndexError) as error:
        return error


def _differs(row: Array, alone: Any, states: Sequence[Array]) -> bool:
    if np.shape(alone) != row.shape:
        return False
    # Rules of adaptive step differ a little; wrong rows differ as much as the states move.
    moved = alone - states[0] if alone.shape == states[0].shape else alone
    bound = 1e-2 * np.abs(moved).max() + 1e-9 * np.abs(alone).max()
    return bool((np.isnan(row) != np.isnan(alone)).any() or (np.abs(row - alone) > bound).any())
