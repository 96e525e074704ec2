"""Derivatives of a user's functions: by central differences, or given and compared with them.

A difference over a step h has two errors: rounding of the function's values, about ε|f|/h,
and curvature within the step. The usual step, 6e-6 of a component's size, balances them for
functions in double precision whose values are about as large as their changes. Where rounding
counts (values in single precision, a large constant in them), longer steps are tried too.

Shapes and words of this module: for states x (..., d) and values f(x) (..., m) a *slope* is an
entry ∂f_j/∂x_i of an array (..., d, m), the Jacobian transposed. A *row* is a row of the Jacobian,
all slopes of one value: its entries are compared after multiplication by the standard deviation of
each component of the state, which makes them changes of the value, in its own units. Arguments
that all functions share are the user's `function` on (..., d) to (..., m), the states `x`, a
function `difference` that subtracts values, such as angles that wrap, and `deviation`, the standard
deviations (..., d).
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np

from .validation import Array, Mask, call_user
from .validation.checks import refuse_mask
from .validation.first_use import is_first_use, needs_check

__all__: list[str] = []

# Step of central differences: about the cube root of ε, where truncation and rounding balance.
_STEP = 6e-6
# Steps below this are not refined further.
_SMALLEST_STEP = 1e-10
# Each longer step is so many times the last one: the longest is reached in a few, and a second
# difference grows by the square, 256, which tells curvature from noise.
_RATIO = 16
# Largest number of steps that are tried: with this ratio they reach from 6e-6 to 1e14.
_MOST_STEPS = 16
# Error of a slope, relative to its row, that does no harm in a filter.
_NEGLIGIBLE = 1e-7
# Second difference, relative to the row, above which longer steps are tried. A smooth function's
# is of the order of the step, 6e-6; noise makes a larger one.
_VISIBLE = 1e-3
# The difference of two values with noise n is up to 2 n off, and the slope n / h. So many times
# that is taken for a bound, since n is an estimate.
_MARGIN = 4.0


class HasDerivative(Protocol):
    """A model or a sensor: an object whose derivative may be given."""

    @property
    def derivative(self) -> Callable[..., Array] | None: ...

    @property
    def is_validated(self) -> bool: ...


@dataclass(eq=False)
class _Differences:
    """Differences of a function (..., m) over a step h in each of d components of the state."""

    # The step h of each component, (..., d).
    step: Array
    # (f(x + h) - f(x - h)) / (2 h), its numerator, and f(x + h) - 2 f(x) + f(x - h), (..., d, m).
    slope: Array
    change: Array
    bend: Array
    # The function's values f(x) between the two steps, (..., 1, m).
    centre: Array
    # Relative precision of the values, (m,).
    precision: Array
    # Where the function bends within this step but is straight within a shorter one, (..., d, m):
    # there the bend is curvature. Rounding noise looks bent over steps of any length.
    has_curvature: Mask | bool = False

    @property
    def is_bent(self) -> Mask:
        """Whether the function bends within the step, beyond rounding, (..., d, m).

        A bend of one percent of the change over both steps, 2 h, is visible. It is compared with
        the change of all values by this component of the state, and with the change of this value
        by any component: a bend that is small beside both does no harm.
        """
        # A bend may be rounding of values that have lost six digits, or of single precision.
        unit = np.maximum(1e-9, 8 * self.precision)
        rounding = unit * np.abs(self.centre)
        bend = np.abs(self.bend)
        largest_change = np.abs(self.change).max(axis=-1)
        # One percent of the change over 2 h.
        limit = 1e-2 * largest_change + rounding.max(axis=-1)
        component_is_bent = bend.max(axis=-1) > limit
        steepest = np.abs(self.slope).max(axis=-2, keepdims=True)
        # The change over 2 h is 2 h times the slope, so that one percent of it is 0.02 h |slope|.
        entry_is_bent = bend > 2e-2 * steepest * self.step[..., None] + rounding
        return np.asarray(component_is_bent[..., None] | entry_is_bent)


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
    slope, _error = difference_with_error(
        function, x, difference, step=step, scale=scale
    )
    return slope


def difference_with_error(
    function: Callable[[Array], Array],
    x: Array,
    difference: Callable[[Array, Array], Array] = np.subtract,
    *,
    step: float = _STEP,
    scale: Array | None = None,
) -> tuple[Array, Array]:
    """Derivative as :func:`central_difference`, and a bound of its rounding error, (..., m, d).

    The `scale` (..., d) has the standard deviations of the components of states x (..., d).
    """
    # Up to how far the derivative is needed, (..., d): a component's size where nothing is known.
    size = np.maximum(1.0, np.abs(x))
    deviation = size if scale is None else np.broadcast_to(scale, x.shape)
    # Slopes of the given step, or of shorter ones where the function bends within it, (..., d, m)
    refined = _refine_differences(function, x, difference, step)
    # The differences over the given step itself
    first = refined.first
    # The function may turn many times within a step that is longer than the deviation.
    is_long = (first.step > deviation) & (deviation > 0)
    if scale is not None and is_long.any():
        slope = _shorten_steps(function, x, difference, first, refined.slope, deviation)
        refined = refined._replace(slope=slope)
    # Rounding of the function's values counts less over longer steps.
    if _may_be_noisy(first, refined.error, deviation):
        refined = _lengthen_steps(function, x, difference, refined, deviation)
    # Jacobians have the values first.
    return np.asarray(refined.slope.mT), np.asarray(refined.error.mT)


class _RefinedDifferences(NamedTuple):
    """Differences over the first step, and slopes (..., d, m) with their errors.

    The slopes are those of the first step, or, where the function bends within it, of one that is a
    hundred times as short, and so on.
    """

    first: _Differences
    slope: Array
    error: Array


def _refine_differences(
    function: Callable[[Array], Array],
    x: Array,
    difference: Callable[[Array, Array], Array],
    step: float,
) -> _RefinedDifferences:
    """Take differences over a step, and over shorter steps where the function bends within it.

    `step` is relative to a component's size, or to 1 if that is larger.
    """
    size = np.maximum(1.0, np.abs(x))
    # Slopes (..., d, m), a bound of their rounding error, and where the function bends
    first = _take_differences(function, x, difference, step * size)
    error = _rounding_error(first, x)
    is_bent = first.is_bent
    if not is_bent.any():
        return _RefinedDifferences(first, first.slope, error)
    if step <= _SMALLEST_STEP:
        # There is no shorter step that could show whether the bend is curvature or noise, so it
        # counts as an error of the slope.
        bend = np.abs(first.bend) / first.step[..., None]
        error = np.where(is_bent, np.maximum(error, bend), error)
        return _RefinedDifferences(first, first.slope, error)
    # The shorter step is refined in the same way.
    finer = _refine_differences(function, x, difference, 1e-2 * step)
    second = finer.first
    # A bend that vanishes for a shorter step is curvature: noise looks bent over steps of any size.
    # A change f(x + h) - f(x - h) of exactly zero says nothing, since the shorter step may be below
    # the function's resolution.
    is_straight = ~second.is_bent & (second.change != 0)
    # It may also have vanished only for the steps after that one.
    first.has_curvature = is_bent & (is_straight | second.has_curvature)
    return _RefinedDifferences(
        first,
        slope=np.where(is_bent, finer.slope, first.slope),
        error=np.where(is_bent, finer.error, error),
    )


def _shorten_steps(
    function: Callable[[Array], Array],
    x: Array,
    difference: Callable[[Array, Array], Array],
    first: _Differences,
    slope: Array,
    deviation: Array,
) -> Array:
    """Replace slopes of steps longer than a standard deviation that a shorter step contradicts.

    A phase that turns many times within a step may look straight by chance. States x and their
    standard deviations are (..., d), slopes (..., d, m), one row for each component that is
    shifted. `first` has the differences over the first step.
    """
    # Where the first step is longer than a known deviation, half of that is tried.
    is_long = (first.step > deviation) & (deviation > 0)
    h = np.where(is_long, 0.5 * deviation, first.step)
    short = _take_differences(function, x, difference, h)
    # Differences below one percent of the steepest slope are curvature, which does no harm; others
    # must be more than the rounding of the short step.
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
    """Return the differences over steps `h` (..., d) to both sides of states x (..., d)."""
    # Row i moves component i alone: all d states are evaluated in one call.
    steps = h[..., None] * np.eye(x.shape[-1])
    ahead = x[..., None, :] + steps
    behind = x[..., None, :] - steps
    # x + h is rounded: the true step, 2 h, is the difference of the two states.
    true_steps = np.diagonal(ahead - behind, axis1=-2, axis2=-1)
    # Values (..., d, m) on both sides, and (..., 1, m) between them
    f_ahead = np.asarray(call_user(function, ahead))
    f_behind = np.asarray(call_user(function, behind))
    f_centre = np.asarray(call_user(function, x[..., None, :]))
    change = call_user(difference, f_ahead, f_behind)

    # The bend is f(x + h) - 2 f(x) + f(x - h), which is zero where the function is straight.
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

    Numbers that are exact in single precision were computed in it: of double-precision values at
    shifted states, all would be so by a rare chance only.
    """
    is_single = np.ones(values[0].shape[-1], dtype=bool)
    # Numbers outside the range of single precision become infinite or zero, and so differ.
    with np.errstate(over="ignore", invalid="ignore", under="ignore"):
        for value in values:
            rows = value.reshape(-1, value.shape[-1])
            is_exact = (rows.astype(np.float32) == rows) | np.isnan(rows)
            is_single = is_single & is_exact.all(axis=0)
    single = np.finfo(np.float32).eps
    return np.asarray(np.where(is_single, single, np.finfo(np.float64).eps))


def _rounding_noise(differences: _Differences, x: Array, slope: Array) -> Array:
    """Return the noise of the function's values by rounding, (..., 1, m).

    It is the values' own rounding ε |f|, and that of the states x within the function, of which
    the largest ε |∂f/∂x_i| |x_i| counts. `slope` (..., d, m) has the derivatives.
    """
    through_states = (np.abs(slope) * np.abs(x)[..., None]).max(axis=-2, keepdims=True)
    noise = differences.precision * (np.abs(differences.centre) + through_states)
    return np.asarray(noise)


def _rounding_error(differences: _Differences, x: Array) -> Array:
    """Return a bound of the slopes' rounding error, the noise of the values over h, (..., d, m)."""
    noise = _rounding_noise(differences, x, differences.slope)
    return np.asarray(_MARGIN * noise / differences.step[..., None])


def _largest_in_row(slope: Array, deviation: Array) -> Array:
    """Return how far each value changes within a standard deviation of the state, (..., 1, m).

    Of the changes |∂f/∂x_i| s_i by the components, with the deviations s (..., d), the largest.
    """
    return np.asarray(
        (np.abs(slope) * deviation[..., None]).max(axis=-2, keepdims=True)
    )


def _may_be_noisy(first: _Differences, error: Array, deviation: Array) -> bool:
    """Whether noise of the values may spoil a slope, beside the other slopes of its row.

    `error` (..., d, m) is the bound of the slopes' errors by :func:`_rounding_error`. `first` has
    the differences over the first step, and `deviation` (..., d) the state's standard deviations.
    """
    # Slopes times deviations are changes of the values; `row` has the largest of each value.
    weight = deviation[..., None]
    row = _largest_in_row(first.slope, deviation)
    # Such a bound is _MARGIN times the error that noise makes.
    by_rounding = error * weight > _MARGIN * _NEGLIGIBLE * row
    # A smooth function in double precision hardly bends within such a step.
    bend = 0.5 * np.abs(first.bend) / first.step[..., None]
    by_bending = bend * weight > _VISIBLE * row
    return bool((by_rounding | by_bending).any())


def _lengthen_steps(
    function: Callable[[Array], Array],
    x: Array,
    difference: Callable[[Array, Array], Array],
    refined: _RefinedDifferences,
    deviation: Array,
) -> _RefinedDifferences:
    """Return the slopes of the longest steps that agree with all shorter ones, and their errors.

    O. V. Lepski's rule, for each entry: a step is too long as soon as its slope differs from a
    shorter step's by more than the rounding of both. Slopes that rounding does not spoil stay.

    `refined` has the slopes of the first step, or of shorter ones where the function bends.
    """
    first = refined.first
    slope = refined.slope
    error = refined.error
    size = np.maximum(1.0, np.abs(x))
    # The longest step is half a standard deviation. For functions in single precision and small
    # deviations it is a hundredth of the component's size, or rounding would decide. A component
    # without uncertainty needs no slope.
    longest = np.where(deviation > 0, np.maximum(0.5 * deviation, 1e-2 * size), 0.0)
    # Slopes of the steps so far, with bounds of their errors; which entries (..., d, m) agree with
    # all of them; and the noise of the function's values, known once two steps have been taken.
    tried: list[tuple[Array, Array]] = []
    agrees = np.ones(slope.shape, dtype=bool)
    noise: Array = np.zeros(())
    h = first.step
    while (h < longest).any() and len(tried) < _MOST_STEPS:
        # Each step is 16 times the last one, up to the longest.
        next_step = np.minimum(_RATIO * h, np.maximum(longest, first.step))
        h = np.where(h < longest, next_step, h)
        longer = _try_differences(function, x, difference, h)
        # None if the function fails so far away.
        if longer is None:
            break
        if not tried:
            # Noise n of the values is an error of up to n / h of a slope, with a margin.
            noise = _noise_of_two_steps(first, longer, x)
            first_bound = _MARGIN * noise / first.step[..., None]
            tried.append((first.slope, first_bound))
            # Only with two steps is the noise known, and with it the first step's error.
            is_first = slope == first.slope
            error = np.where(is_first, first_bound, error)
            # Longer steps are of use only where the first slope was kept, or where the bend for
            # which a shorter step was taken was noise, far more than rounding, and not curvature.
            agrees = is_first | (noise > 8 * _rounding_noise(first, x, slope))
        bound = _MARGIN * noise / longer.step[..., None]
        for shorter_slope, shorter_bound in tried:
            # NaN, where the function has no value, agrees with nothing.
            distance = np.abs(longer.slope - shorter_slope)
            agrees = agrees & (distance <= bound + shorter_bound)
        tried.append((longer.slope, bound))
        slope = np.where(agrees, longer.slope, slope)
        error = np.where(agrees, bound, error)
        # Longer steps cannot agree any more, or no slope needs them.
        if not agrees.any() or _is_accurate(slope, error, deviation):
            break
    # Of slopes that hardly differ the original ones stay.
    slope = _restore_close(refined.slope, slope, deviation)
    return _RefinedDifferences(first, slope, error)


def _is_accurate(slope: Array, error: Array, deviation: Array) -> bool:
    """Whether the errors of all slopes are at most a hundredth of a negligible one."""
    row = _largest_in_row(slope, deviation)
    # An error times the state's deviation is an error of the value.
    is_accurate = error * deviation[..., None] <= 1e-2 * _NEGLIGIBLE * row
    return bool(is_accurate.all())


def _restore_close(old: Array, new: Array, deviation: Array) -> Array:
    """Return new slopes, but the old ones where the difference is negligible beside the row.

    So the slopes of a function without noise do not depend on the longer steps at all.
    """
    row = _largest_in_row(new, deviation)
    is_close = np.abs(new - old) * deviation[..., None] <= _NEGLIGIBLE * row
    return np.where(is_close, old, new)


def _try_differences(
    function: Callable[[Array], Array],
    x: Array,
    difference: Callable[[Array, Array], Array],
    h: Array,
) -> _Differences | None:
    """Return the differences over steps h (..., d); None if the function does not reach so far."""
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

    `short` and `long` are differences over a step and over one 16 times as long, from states `x`
    (..., d). Curvature makes a second difference 256 times as large over the long step; noise
    leaves it as it is. In between, less than 64 times as large counts as noise.
    """
    steepest = np.maximum(np.abs(short.slope), np.abs(long.slope))
    # The part that the precision of the values explains
    rounding = _rounding_noise(short, x, steepest)
    # The bend is the second difference f(x + h) - 2 f(x) + f(x - h), (..., d, m).
    bend = np.abs(short.bend)
    # It is noise if it hardly grows with the step, and either is below a thousandth of the value
    # f(x), the centre, or is visible beside the change over the step (`is_bent`), so that shorter
    # steps have been taken. Where those showed curvature, it is none.
    hardly_grows = np.abs(long.bend) < 64 * bend
    is_small = bend < 1e-3 * np.abs(short.centre)
    is_noise = hardly_grows & (is_small | short.is_bent)
    is_noise &= ~np.asarray(short.has_curvature)
    # The largest over the components of the state: each shows the noise of the same values.
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
    right shape too, and a warning is given if an entry is off by more than a tenth of the largest
    in its row. Entries that are negligible beside the other rows may be missing. Differences that
    depend on their step prove nothing against a derivative; where such differences have to be used
    in its place, a warning is given, once.

    Parameters
    ----------
    owner : FrozenModel
        The object with the derivative; one that the library constructed is trusted.
    args, shape : tuple
        Arguments of the derivative, whose arrays are copied, and the shape of the result.
    differences : callable
        ``differences(step=step)``, :func:`difference_with_error` of the owner's function, which
        returns slopes and errors (..., m, d). Rows that depend on the step are not compared.
    static : ndarray, optional
        The derivative of a function that changes nothing, I for a transition. A row's size is that
        of its difference from this, so that small changes of the state are compared too.
    name : str
        Name of the function, for the warning.
    scale : ndarray, (..., d), optional
        Standard deviation of each component of the state.
    tolerance : ndarray, (..., m), optional
        Standard deviation of each value's noise. Errors that are small beside it do no harm.
    """
    if owner.derivative is None:
        slope, error = differences()
        # Warns at the first use if errors of the differences are too large to be of no effect.
        if tolerance is not None and scale is not None:
            is_uncertain = _is_uncertain(slope, error, scale, tolerance)
            if is_uncertain and is_first_use(owner, f"differences of {name}"):
                warnings.warn(
                    f"{name} has no usable differences: its derivative over two steps differs, "
                    "by rounding or since it is not smooth; give derivative=",
                    RuntimeWarning,
                    # The warning points at the call of jacobian(), above it and its validation.
                    stacklevel=4,
                )
        return slope
    # The derivative that was given, compared with differences at its first use
    slope = call_derivative(owner.derivative, args, shape)
    if is_first_use(owner, "derivative") and _contradicts(slope, differences, static):
        warnings.warn(
            "derivative does not match finite differences of its function",
            RuntimeWarning,
            # As above: at the call of jacobian()
            stacklevel=4,
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
    # A user's function might write into its arguments.
    copies = [x.copy() if type(x) is np.ndarray else x for x in args]
    result = call_user(derivative, *copies)
    refuse_mask(result, "derivative")
    slope = np.asarray(result)
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
    """Whether errors of a Jacobian matter: a tenth of the change in their row and of the noise.

    Jacobian and errors are (..., m, d). An error times the state's deviation, `scale` (..., d), is
    an error of a prediction. It does no harm if it is small beside the largest change of the
    prediction, or beside the deviation of its noise, `tolerance` (..., m).
    """
    weight = np.broadcast_to(scale, slope.shape[:-2] + slope.shape[-1:])[..., None, :]
    # The largest change of each value within a standard deviation of the state, (..., m, 1)
    row = (np.abs(slope) * weight).max(axis=-1, keepdims=True)
    noise_std = np.asarray(tolerance)[..., None]
    # A value without noise has no deviation with which an error could be compared.
    limit = np.where(noise_std > 0, 0.1 * np.maximum(row, noise_std), np.inf)
    return bool((error * weight > limit).any())


def _contradicts(
    slope: Array,
    differences: Callable[..., tuple[Array, Array]],
    static: Array | float,
) -> bool:
    """Whether a Jacobian (..., m, d) differs from differences that do not depend on their step.

    `differences` and `static` are those of :func:`evaluate_derivative`.
    """
    # Where differences over two steps agree, the Jacobian has to agree with them too.
    reference, error = differences(step=_STEP)
    coarse, _coarse_error = differences(step=4 * _STEP)
    is_wrong = _find_wrong(slope, reference, coarse, error, static)
    if not is_wrong.any():
        return False
    # Two steps may agree by chance, as where a phase turns many times within them: a much shorter
    # step must confirm it.
    fine, fine_error = differences(step=_STEP / 64)
    larger_error = np.maximum(error, fine_error)
    is_confirmed = _find_wrong(slope, reference, fine, larger_error, static)
    return bool((is_wrong & is_confirmed).any())


def _find_wrong(
    slope: Array, reference: Array, other: Array, error: Array, static: Array | float
) -> Mask:
    """Return which entries (..., m, d) differ from reliable differences by more than these may err.

    A row of the reference is reliable if another step's differences, `other`, agree to one percent
    of its largest entry, or to its rounding, `error`. The Jacobian is `slope`; `static` is the
    derivative of a function that changes nothing, from which the size of a row is measured.
    """
    row_size = np.abs(reference - static).max(axis=-1, keepdims=True)
    step_error = np.abs(reference - other).max(axis=-1, keepdims=True)
    rounding = error.max(axis=-1, keepdims=True)
    # Differences of two steps that agree to one percent do not depend on the step.
    is_reliable = step_error <= 1e-2 * row_size + rounding
    # A tenth of the row is allowed, for approximate derivatives, and a small part of the largest
    # row: a derivative may leave out a small effect.
    largest_row = row_size.max(axis=-2, keepdims=True)
    bound = 0.1 * row_size + 1e-4 * largest_row + 2 * rounding
    return np.asarray(is_reliable & (np.abs(slope - reference) > bound))
