"""Derivatives of a user's functions: by central differences, or given and compared with them.

A difference over a step h has two errors: rounding of the function's values, about ε|f|/h,
and curvature within the step. The usual step, 6e-6 of a component's size, balances them for
functions in double precision whose values are about as large as their changes. Where rounding
counts (values in single precision, a large constant in them), longer steps are tried too.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from .validation import Array, Mask, call_user
from .validation.first_use import is_first_use, needs_check

__all__: list[str] = []

# Step of central differences: about the cube root of ε, where truncation and rounding balance.
_STEP = 6e-6
# Steps below this are not refined further.
_SMALLEST_STEP = 1e-10
# Factor between the steps of a ladder.
_RATIO = 16
# Rounding error of a slope, relative to its row, above which longer steps are tried.
_NEGLIGIBLE = 1e-7
# The same for a second difference, the visible sign of noise.
_VISIBLE = 1e-3
# A step's rounding error is at most so many units of the values' precision, over the step.
_MARGIN = 4.0


class HasDerivative(Protocol):
    """A model or a sensor: an object whose derivative may be given."""

    @property
    def derivative(self) -> Callable[..., Array] | None: ...

    @property
    def is_validated(self) -> bool: ...


@dataclass(eq=False)
class _Differences:
    """Differences of a function (..., m) over one step in each of d components, (..., d, m)."""

    step: Array
    slope: Array
    change: Array
    bend: Array
    centre: Array
    # Relative precision of the values, (m,).
    precision: Array
    # Where the function bends within the step but not within a shorter one, (..., d, m): that
    # is curvature. Noise looks bent over any step.
    has_curvature: Mask | bool = False

    @property
    def is_bent(self) -> Mask:
        """Whether the function bends within the step, beyond rounding, (..., d, m)."""
        # In single precision the bend may be rounding alone.
        unit = np.maximum(1e-9, 8 * self.precision)
        rounding = unit * np.abs(self.centre)
        bend = np.abs(self.bend)
        # Beside the largest change of all values by this component's step,
        largest_change = np.abs(self.change).max(axis=-1)
        limit = 1e-2 * largest_change + rounding.max(axis=-1)
        column_is_bent = bend.max(axis=-1) > limit
        # and of one value, beside its steepest slope in any component.
        steepest = np.abs(self.slope).max(axis=-2, keepdims=True)
        entry_is_bent = bend > 2e-2 * steepest * self.step[..., None] + rounding
        return np.asarray(column_is_bent[..., None] | entry_is_bent)


def central_difference(
    function: Callable[[Array], Array],
    x: Array,
    difference: Callable[[Array, Array], Array] = np.subtract,
    *,
    step: float = _STEP,
    scale: Array | None = None,
) -> Array:
    """Derivative (..., m, d) by central differences, all 2 d shifted states in two calls.

    Its error is about 1e-10 of the function's scale. Where the function bends within a step, the
    derivative is taken again with steps a hundred times as small. Where the rounding of the
    values spoils it, longer steps are compared, and the longest is taken that agrees with all
    shorter ones up to their rounding.

    Parameters
    ----------
    function : callable
        ``function(x) -> y`` on (..., d) to (..., m).
    x : ndarray, (..., d)
        States at which the derivative is taken.
    difference : callable
        ``difference(ahead, behind)``, for values that wrap; subtraction by default.
    step : float
        Step of each component, relative to its size where that is above 1.
    scale : ndarray, (..., d), optional
        Standard deviation of each component: up to about how far the derivative is needed. The
        larger of its size and 1 by default.

    Examples
    --------
    >>> central_difference(lambda x: x**2, np.array([1.0, 3.0])).round(8)
    array([[2., 0.],
           [0., 6.]])

    In single precision the usual step is too short by far:

    >>> def single(x):
    ...     return np.sqrt(x.astype(np.float32))
    >>> central_difference(single, np.array([100.0])).round(5)
    array([[0.05]])
    """
    slope, _ = difference_with_error(function, x, difference, step=step, scale=scale)
    return slope


def difference_with_error(
    function: Callable[[Array], Array],
    x: Array,
    difference: Callable[[Array, Array], Array] = np.subtract,
    *,
    step: float = _STEP,
    scale: Array | None = None,
) -> tuple[Array, Array]:
    """Derivative as :func:`central_difference`, and a bound of its rounding error, (..., m, d)."""
    size = np.maximum(1.0, np.abs(x))
    deviation = size if scale is None else np.broadcast_to(scale, x.shape)
    first, slope, error = _refine(function, x, difference, step)
    if scale is not None and ((first.step > deviation) & (deviation > 0)).any():
        slope = _shorten(function, x, difference, first, slope, deviation)
    if _is_rough(first, error, deviation):
        slope, error = _climb(function, x, difference, first, (slope, error), deviation)
    return np.asarray(slope.mT), np.asarray(error.mT)


def _refine(
    function: Callable[[Array], Array],
    x: Array,
    difference: Callable[[Array, Array], Array],
    step: float,
) -> tuple[_Differences, Array, Array]:
    """Return the differences of a step, and slopes and errors, refined where they bend."""
    first = _take_differences(
        function, x, difference, step * np.maximum(1.0, np.abs(x))
    )
    error = _rounding_error(first, x)
    is_bent = first.is_bent
    if not is_bent.any():
        return first, first.slope, error
    if step <= _SMALLEST_STEP:
        # Nothing is left to compare with: what bends here may be noise.
        bend = np.abs(first.bend) / first.step[..., None]
        return first, first.slope, np.where(is_bent, np.maximum(error, bend), error)
    second, finer, finer_error = _refine(function, x, difference, 1e-2 * step)
    is_straight = ~second.is_bent & (second.change != 0)
    first.has_curvature = is_bent & (is_straight | second.has_curvature)
    slope = np.where(is_bent, finer, first.slope)
    return first, slope, np.where(is_bent, finer_error, error)


def _shorten(
    function: Callable[[Array], Array],
    x: Array,
    difference: Callable[[Array, Array], Array],
    first: _Differences,
    slope: Array,
    deviation: Array,
) -> Array:
    """Return slopes within the standard deviations, where longer steps contradict them.

    A phase that turns many times within a step may look straight by chance.
    """
    is_long = (first.step > deviation) & (deviation > 0)
    h = np.where(is_long, 0.5 * deviation, first.step)
    short = _take_differences(function, x, difference, h)
    steepest = np.abs(short.slope).max(axis=-2, keepdims=True)
    limit = 1e-2 * steepest + _rounding_error(short, x)
    differs = is_long[..., None] & (np.abs(short.slope - slope) > limit)
    return np.where(differs, short.slope, slope)


def _take_differences(
    function: Callable[[Array], Array],
    x: Array,
    difference: Callable[[Array, Array], Array],
    h: Array,
) -> _Differences:
    """Return the differences over steps `h` (..., d) to both sides."""
    steps = h[..., None] * np.eye(x.shape[-1])
    ahead = x[..., None, :] + steps
    behind = x[..., None, :] - steps
    # After rounding the true step is the difference of the two states.
    true_steps = np.diagonal(ahead - behind, axis1=-2, axis2=-1)
    f_ahead = np.asarray(call_user(function, ahead))
    f_behind = np.asarray(call_user(function, behind))
    f_centre = np.asarray(call_user(function, x[..., None, :]))
    change = call_user(difference, f_ahead, f_behind)

    # Second differences f(x + h) - 2 f(x) + f(x - h) vanish where the function is straight.
    upper_half = call_user(difference, f_ahead, f_centre)
    lower_half = call_user(difference, f_behind, f_centre)
    return _Differences(
        step=0.5 * true_steps,
        slope=change / true_steps[..., None],
        change=change,
        bend=upper_half + lower_half,
        centre=f_centre,
        precision=_precision(f_ahead, f_behind),
    )


def _precision(*values: Array) -> Array:
    """Return the relative precision ε in which values (..., m) were computed, (m,).

    Numbers that are exact in single precision were computed in it: after a step of 6e-6 in
    double precision none would be.
    """
    is_single = np.ones(values[0].shape[-1], dtype=bool)
    with np.errstate(over="ignore", invalid="ignore", under="ignore"):
        for value in values:
            rows = value.reshape(-1, value.shape[-1])
            is_exact = (rows.astype(np.float32) == rows) | np.isnan(rows)
            is_single = is_single & is_exact.all(axis=0)
    single = np.finfo(np.float32).eps
    return np.asarray(np.where(is_single, single, np.finfo(np.float64).eps))


def _noise(differences: _Differences, x: Array, slope: Array) -> Array:
    """Return the noise of the function's values by rounding, (..., 1, m)."""
    # The values' own rounding ε|f|, and that of the states within the function, ε|J x|.
    through_states = (np.abs(slope) * np.abs(x)[..., None]).max(axis=-2, keepdims=True)
    noise = differences.precision * (np.abs(differences.centre) + through_states)
    return np.asarray(noise)


def _rounding_error(differences: _Differences, x: Array) -> Array:
    """Return a bound of the slopes' rounding error, (..., d, m)."""
    noise = _noise(differences, x, differences.slope)
    return np.asarray(_MARGIN * noise / differences.step[..., None])


def _is_rough(first: _Differences, error: Array, deviation: Array) -> bool:
    """Whether rounding may spoil a slope, as far as the row's change over a deviation shows."""
    weight = deviation[..., None]
    # How far the function changes within a standard deviation of the state.
    row = (np.abs(first.slope) * weight).max(axis=-2, keepdims=True)
    by_rounding = error * weight > _MARGIN * _NEGLIGIBLE * row
    # A smooth function in double precision hardly bends within such a step.
    bend = 0.5 * np.abs(first.bend) / first.step[..., None]
    return bool((by_rounding | (bend * weight > _VISIBLE * row)).any())


def _climb(
    function: Callable[[Array], Array],
    x: Array,
    difference: Callable[[Array, Array], Array],
    first: _Differences,
    result: tuple[Array, Array],
    deviation: Array,
) -> tuple[Array, Array]:
    """Return the slopes of the longest steps that agree with all shorter ones, and their errors.

    O. V. Lepski's rule, for each entry: a step is too long as soon as its slope differs from a
    shorter step's by more than the rounding of both. Slopes that rounding does not spoil stay.
    """
    slope, error = result
    size = np.maximum(1.0, np.abs(x))
    # Half a standard deviation; at least a hundredth of the size, for functions in single
    # precision whose states are known well. A component without uncertainty needs no slope.
    top = np.where(deviation > 0, np.maximum(0.5 * deviation, 1e-2 * size), 0.0)
    tried: list[tuple[Array, Array]] = []
    agrees = np.ones(slope.shape, dtype=bool)
    noise: Array = np.zeros(())
    h = first.step
    while (h < top).any() and len(tried) < 16:
        h = np.where(h < top, np.minimum(_RATIO * h, np.maximum(top, first.step)), h)
        longer = _try_differences(function, x, difference, h)
        if longer is None:
            break
        if not tried:
            noise = _noise_of_two_steps(first, longer, x)
            tried.append((first.slope, _MARGIN * noise / first.step[..., None]))
            # Where refining has followed a bend, and no noise, longer steps are no use.
            agrees = (slope == first.slope) | (noise > 8 * _noise(first, x, slope))
        bound = _MARGIN * noise / longer.step[..., None]
        for shorter, its_bound in tried:
            # NaN, where the function has no value, agrees with nothing.
            agrees = agrees & (np.abs(longer.slope - shorter) <= bound + its_bound)
        tried.append((longer.slope, bound))
        chosen = agrees
        if len(tried) == 2:
            # The first step's error is now known better.
            error = np.where(slope == first.slope, tried[0][1], error)
        slope = np.where(chosen, longer.slope, slope)
        error = np.where(chosen, bound, error)
        if not agrees.any() or _is_accurate(slope, error, deviation):
            break
    return _keep_close(result[0], slope, deviation), error


def _is_accurate(slope: Array, error: Array, deviation: Array) -> bool:
    """Whether the rounding of all slopes is negligible beside their rows."""
    weight = deviation[..., None]
    row = (np.abs(slope) * weight).max(axis=-2, keepdims=True)
    return bool((error * weight <= 1e-2 * _NEGLIGIBLE * row).all())


def _keep_close(old: Array, new: Array, deviation: Array) -> Array:
    """Return new slopes, but the old ones where the difference is negligible beside the row."""
    weight = deviation[..., None]
    row = (np.abs(new) * weight).max(axis=-2, keepdims=True)
    is_close = np.abs(new - old) * weight <= _NEGLIGIBLE * row
    return np.where(is_close, old, new)


def _try_differences(
    function: Callable[[Array], Array],
    x: Array,
    difference: Callable[[Array, Array], Array],
    h: Array,
) -> _Differences | None:
    """Return the differences over longer steps; None where the function does not reach so far."""
    # Beyond its domain a function may warn, return NaN, or raise.
    with (
        suppress(ArithmeticError, LookupError, RuntimeError, ValueError),
        np.errstate(all="ignore"),
        warnings.catch_warnings(action="ignore"),
    ):
        return _take_differences(function, x, difference, h)
    return None


def _noise_of_two_steps(short: _Differences, long: _Differences, x: Array) -> Array:
    """Return the noise of the values (..., 1, m), from precision and from second differences.

    Curvature makes a second difference 256 times as large over 16 times the step; noise leaves
    it as it is.
    """
    steepest = np.maximum(np.abs(short.slope), np.abs(long.slope))
    rounding = _noise(short, x, steepest)
    bend = np.abs(short.bend)
    # What bends over every step, however short, is noise too.
    is_small = bend < 1e-3 * np.abs(short.centre)
    is_noise = (np.abs(long.bend) < 64 * bend) & (is_small | short.is_bent)
    is_noise &= ~np.asarray(short.has_curvature)
    # Slopes of the shortest step include the noise that is to be found.
    visible = np.where(is_noise, bend, 0.0).max(axis=-2, keepdims=True)
    return np.asarray(np.maximum(rounding, visible))


def evaluate_derivative(
    owner: HasDerivative,
    args: tuple[Array | float, ...],
    shape: tuple[int, ...],
    differences: Callable[..., tuple[Array, Array]],
    static: Array | float = 0.0,
    *,
    name: str = "function",
    scale: Array | None = None,
    tolerance: Array | None = None,
) -> Array:
    """Call an owner's `derivative`, or take differences if it has none; return (..., m, d).

    The first time the derivative is compared with differences, since a transposed one may have the
    right shape too. Rows may be a tenth of their largest entry off, and may lack entries that are
    negligible beside the other rows. Differences that cannot be trusted doubt no derivative, and
    a warning is given, once, where one of them has to be used.

    Parameters
    ----------
    owner : FrozenModel
        The object with the derivative; one that the library constructed is trusted.
    args, shape : tuple
        Arguments of the derivative, whose arrays are copied, and the shape of the result.
    differences : callable
        ``differences(step=step)`` by :func:`difference_with_error`. Rows that depend on the step
        are not compared.
    static : ndarray, optional
        The derivative of a state that does not change; it is subtracted before comparing.
    name : str
        Name of the function, for the warning.
    scale : ndarray, (..., d), optional
        Standard deviation of each component of the state.
    tolerance : ndarray, (..., m), optional
        Standard deviation of each value's noise. Errors that are small beside it do no harm.
    """
    if owner.derivative is None:
        slope, error = differences()
        if tolerance is not None and scale is not None:
            is_uncertain = _is_uncertain(slope, error, scale, tolerance)
            if is_uncertain and is_first_use(owner, f"differences of {name}"):
                warnings.warn(
                    f"{name} has no usable differences: its derivative over two steps differs, "
                    "by rounding or since it is not smooth; give derivative=",
                    RuntimeWarning,
                    4,
                )
        return slope
    slope = call_derivative(owner.derivative, args, shape)
    if is_first_use(owner, "derivative") and _contradicts(slope, differences, static):
        warnings.warn(
            "derivative does not match finite differences of its function",
            RuntimeWarning,
            4,
        )
    return slope


def call_derivative(
    derivative: Callable[..., Array],
    args: tuple[Array | float, ...],
    shape: tuple[int, ...],
) -> Array:
    """Call a given derivative with copies of its arrays, and check its shape.

    >>> call_derivative(lambda x: np.eye(2), (np.zeros((3, 2)),), (3, 2, 2)).shape
    (3, 2, 2)
    """
    copies = [x.copy() if type(x) is np.ndarray else x for x in args]
    slope = np.asarray(call_user(derivative, *copies))
    if slope.shape == shape:
        return slope
    # One matrix for all states.
    if slope.shape != shape[-2:]:
        raise ValueError(f"derivative must return shape {shape}, got {slope.shape}")
    return np.broadcast_to(slope, shape)


def needs_differences(owner: HasDerivative) -> bool:
    """Whether differences are taken for an owner's derivative: in its place, or to check it."""
    if owner.derivative is None:
        return True
    return owner.is_validated and needs_check(owner, "derivative")


def _is_uncertain(slope: Array, error: Array, scale: Array, tolerance: Array) -> bool:
    """Whether errors of slopes change predictions by a tenth of their row and of the noise."""
    weight = np.broadcast_to(scale, slope.shape[:-2] + slope.shape[-1:])[..., None, :]
    row = (np.abs(slope) * weight).max(axis=-1, keepdims=True)
    allowed = np.asarray(tolerance)[..., None]
    # A known constant has no deviation with which an error could be compared.
    limit = np.where(allowed > 0, 0.1 * np.maximum(row, allowed), np.inf)
    return bool((error * weight > limit).any())


def _contradicts(
    slope: Array,
    differences: Callable[..., tuple[Array, Array]],
    static: Array | float,
) -> bool:
    """Whether a derivative differs from differences that do not depend on their step."""
    reference, error = differences(step=_STEP)
    coarse, _ = differences(step=4 * _STEP)
    is_off = _is_off(slope, reference, coarse, error, static)
    if not is_off.any():
        return False
    # Two steps may agree by chance, as where a phase turns many times within them.
    fine, fine_error = differences(step=_STEP / 64)
    still_off = _is_off(slope, reference, fine, np.maximum(error, fine_error), static)
    return bool((is_off & still_off).any())


def _is_off(
    slope: Array, reference: Array, other: Array, error: Array, static: Array | float
) -> Mask:
    """Whether entries differ from reliable differences by more than these may err."""
    row_size = np.abs(reference - static).max(axis=-1, keepdims=True)
    step_error = np.abs(reference - other).max(axis=-1, keepdims=True)
    rounding = error.max(axis=-1, keepdims=True)
    is_reliable = step_error <= 1e-2 * row_size + rounding
    bound = 0.1 * row_size + 1e-4 * row_size.max(axis=-2, keepdims=True) + 2 * rounding
    return np.asarray(is_reliable & (np.abs(slope - reference) > bound))
