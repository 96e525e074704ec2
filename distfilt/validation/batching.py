"""Calls of a user's function on many states at once, and a check that it can take them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from .checks import Array, refuse_mask
from .decorators import call_user
from .first_use import mark_checked, needs_check

__all__ = ["call_batched"]

# A user's function may raise instead of returning an array; the error is looked at.
Result = Array | Exception


class HasDimension(Protocol):
    """An object that holds a user's function and the length of its result."""

    @property
    def dim(self) -> int:
        """Length of the function's result."""


# Largest difference between batched and single results, relative to the state's change: solvers of
# adaptive step differ by less, wrong rows by as much as the change itself.
_RELATIVE_TOLERANCE = 1e-2


def call_batched(
    owner: HasDimension, name: str, states: Sequence[Array], *args: float
) -> Array:
    """Call a user's function on states (..., d), and return (..., ``owner.dim``).

    A function written for one state may return the right shape with wrong numbers. The first
    time, its result for the last state of a batch is therefore compared with its result for
    that state alone. The function gets copies of the states.

    Parameters
    ----------
    owner, name
        The object that holds the user's function, and the attribute's name.
    states : sequence of ndarray, (..., d)
        The function's first arguments.
    *args
        Its other arguments.

    Examples
    --------
    >>> class Motion:
    ...     dim = 2
    ...
    ...     def __init__(self, flow):
    ...         self.flow = flow
    >>> x = np.array([[1.0, 2.0], [3.0, 4.0]])
    >>> call_batched(Motion(lambda x: x[..., ::-1]), "flow", [x])
    array([[2., 1.],
           [4., 3.]])
    >>> one = Motion(lambda x: np.array([x[1], x[0]]))
    >>> call_batched(one, "flow", [x])
    Traceback (most recent call last):
    ValueError: flow must take many states at once, ...
    >>> two = Motion(lambda x: x + x[:, :1])
    >>> call_batched(two, "flow", [x])
    Traceback (most recent call last):
    ValueError: flow must take many states at once, ...
    >>> unit = Motion(lambda x: x / np.linalg.norm(x))
    >>> call_batched(unit, "flow", [x[1:]])
    array([[0.6, 0.8]])
    >>> call_batched(unit, "flow", [x])
    Traceback (most recent call last):
    ValueError: flow must take many states at once, ...
    """
    function = getattr(owner, name)
    # The first argument is the present state; another may be the previous one.
    x = states[0]
    # An array, or the error that the function raised.
    result = _call_or_catch(name, function, states, args)
    expected = (*x.shape[:-1], owner.dim)
    # The name under which the owner's checks are remembered
    check = name_of_check(name, x)
    # The usual case: it has been checked before, and its result has the right shape.
    is_array = isinstance(result, np.ndarray) and result.shape == expected
    if is_array and not needs_check(owner, check):
        return np.asarray(result)
    has_shape = getattr(result, "shape", None) == expected  # an error has no shape
    if x.ndim > 1 and x.size and (not has_shape or needs_check(owner, check)):
        is_conclusive = _is_conclusive(x)
        # Agents that share all observations have equal states for a whole run.
        weaker = check if is_conclusive else f"{name} of equal states"
        if not has_shape or needs_check(owner, weaker):
            # Raises an error if the function mixes up the states of a batch.
            _compare_with_single_state(owner, name, states, args, result)
            if has_shape and (is_conclusive or _has_different_components(x)):
                mark_checked(owner, weaker)
    if has_shape:
        return np.asarray(result)
    # An index beyond the last component: the state is too short for the function.
    if isinstance(result, IndexError):
        raise ValueError(f"x must have more components, got {x.shape}") from result
    if isinstance(result, Exception):
        raise result
    raise ValueError(
        f"{name} must return shape {expected} for states {x.shape}, got {result.shape}"
    )


def name_of_check(name: str, states: Array) -> str:
    """Return the name of the check that a user's function of states (..., d) has to pass.

    A batch of one state cannot show whether rows are mixed, so it passes a weaker check.
    """
    return name if states.size > states.shape[-1] else f"{name} of a single state"


def _compare_with_single_state(
    owner: HasDimension,
    name: str,
    states: Sequence[Array],
    args: tuple[float, ...],
    result: Result,
) -> None:
    """Raise if a batched result differs from the result for the last state alone.

    The arguments are those of :func:`call_batched`, and `result` is the function's for all states.
    """
    function = getattr(owner, name)
    expected = (*states[0].shape[:-1], owner.dim)
    last_states = [state.reshape(-1, state.shape[-1])[-1] for state in states]
    # The result for the last state alone, or an error. A second call must give the same.
    single = _call_or_catch(name, function, last_states, args)
    _refuse_draws(name, single, _call_or_catch(name, function, last_states, args))
    if isinstance(result, np.ndarray) and result.shape == expected:
        last_row = result.reshape(-1, owner.dim)[-1]
        differs = _is_different(last_row, single, last_states)
    else:
        # An error may belong to some states only. With copies of one state that it can take
        # alone, the function is at fault if the batch still fails.
        copies = []
        for last, state in zip(last_states, states, strict=True):
            copies.append(np.broadcast_to(last, state.shape))
        repeated = _call_or_catch(name, function, copies, args)
        takes_one = _shape_of(single) == expected[-1:]
        differs = takes_one and _shape_of(repeated) != expected
    if differs:
        raise ValueError(
            f"{name} must take many states at once, (..., d), components last "
            "(x[..., 0], not x[0] or x[:, 0]), got one for other axes"
        )


def _refuse_draws(name: str, first: Result, second: Result) -> None:
    """Raise if two calls with the same state differ, as where noise is drawn inside.

    `first` and `second` are the results of the function of that name, or its errors.
    """
    if isinstance(first, Exception) or isinstance(second, Exception):
        return
    if first.shape != second.shape:
        return
    # A parallel sum may round differently each time.
    if not np.allclose(first, second, rtol=1e-9, atol=0.0, equal_nan=True):
        raise ValueError(
            f"{name} must give the same values for the same states, got two results "
            f"{np.abs(first - second).max():.3g} apart: noise that is drawn in it belongs "
            "in noise_cov"
        )


def _is_conclusive(x: Array) -> bool:
    """Whether states x (..., d) differ so that a function that mixes rows would give it away.

    If all states are equal, or all components of a single one, a wrong function passes by chance.
    """
    rows = x.reshape(-1, x.shape[-1])
    if len(rows) > 1:
        return bool((rows[0] != rows[-1]).any())
    return _has_different_components(x)


def _has_different_components(x: Array) -> bool:
    """Whether the components of the first of states x (..., d) differ from each other."""
    first = x.reshape(-1, x.shape[-1])[0]
    return bool((first != first[-1]).any())


def _call_or_catch(
    name: str,
    function: Callable[..., ArrayLike],
    states: Sequence[Array],
    args: tuple[float, ...],
) -> Result:
    """Return a function's result as an array, or the error that it raises.

    It gets copies of the states (..., d), since it might write into them, and the other `args`.
    `name` is the function's, for an error.
    """
    copies: Iterable[Array] = (states[0].copy(),)
    if len(states) > 1:
        copies = [state.copy() for state in states]
    try:
        result = call_user(function, *copies, *args)
        refuse_mask(result, name)
        return np.asarray(result, dtype=np.float64)
    except (TypeError, ValueError, IndexError) as error:
        return error


def _shape_of(result: Result) -> tuple[int, ...] | None:
    """Return the shape of an array; an error has none."""
    return None if isinstance(result, Exception) else result.shape


def _is_different(row: Array, single: Result, states: Sequence[Array]) -> bool:
    """Whether a row of a batch differs from the result for its state alone.

    The row is (m,); `single` is the function's result for `states`, (d,) each, or an error.
    """
    if isinstance(single, Exception) or single.shape != row.shape:
        # A function that indexes two axes, x[:, 0], takes this batch but no single state: it would
        # take the wrong axis of a batch with more axes. Other errors prove nothing.
        return isinstance(single, IndexError)
    # The change of the state, if the function returns a state, or its value. A bound of 1e-9 of the
    # value is added, for rounding where nothing changes.
    change = single
    if single.shape == states[0].shape:
        change = single - states[0]
    scale = np.abs(single).max()
    bound = _RELATIVE_TOLERANCE * np.abs(change).max() + 1e-9 * scale
    differs = (np.isnan(row) != np.isnan(single)) | (np.abs(row - single) > bound)
    return bool(differs.any())
