"""Checks of arrays and numbers, with errors that name the argument."""

from __future__ import annotations

import contextlib
import math
import operator
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import date, timedelta
from types import EllipsisType
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dpotrf

__all__ = [
    "InvalidArgumentError",
    "Array",
    "Indices",
    "Mask",
    "Shape",
    "Bounds",
    "all_finite",
    "check_array",
    "check_positive_definite",
    "check_distinct",
    "check_increasing",
    "check_positive_semidefinite",
    "check_probabilities",
    "format_number",
    "format_shape",
    "is_nonnegative_diagonal",
    "match_shape",
    "type_name",
]

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Indices = NDArray[np.intp]
# Sizes of axes, names of free ones, and a leading "..." for any further axes.
Shape: TypeAlias = tuple[int | str | EllipsisType, ...]


class InvalidArgumentError(ValueError, TypeError):
    """An argument of a wrong type: both a ValueError and a TypeError.

    Examples
    --------
    >>> check_array("abc", "x")
    Traceback (most recent call last):
    distfilt.validation.InvalidArgumentError: x must be an array of real numbers, got str
    """


InvalidArgumentError.__module__ = "distfilt.validation"

# Largest asymmetry or negative eigenvalue that counts as rounding, relative to the variances.
_ROUNDING = 1e-9

# Types that numpy would convert to numbers inside a list or an array of objects.
_NOT_REAL = (
    bool,
    np.bool_,
    complex,
    np.complexfloating,
    str,
    bytes,
    np.datetime64,
    np.timedelta64,
    type(None),
    np.ma.MaskedArray,
)


def type_name(value: object) -> str:
    """Return the name of a value's type, ``np.bool`` for numpy's own scalars.

    >>> type_name(True), type_name(np.True_)
    ('bool', 'np.bool')
    """
    name = type(value).__name__
    return f"np.{name}" if isinstance(value, np.generic) else name


def check_array(
    value: object,
    name: str,
    shape: Shape | None = None,
    *,
    finite: bool = True,
) -> Array:
    """Return `value` as a float64 array of the expected shape, such as a user function's result.

    Parameters
    ----------
    value, name
        The value, and its name in the error.
    shape : tuple, optional
        Dimensions from left to right: an integer is exact, a string is a free dimension with a
        name for the error, and a leading ``...`` allows any leading axes.
    finite : bool
        Refuse NaN and infinity.

    Raises
    ------
    ValueError
        If the value is not made of real numbers (masked arrays, dates, complex numbers, booleans
        and text are refused, not converted), has another shape, or holds NaN or infinity.

    Examples
    --------
    >>> check_array([[1, 2], [3, 4]], "ensemble", (..., "N", 2)).shape
    (2, 2)
    >>> check_array([1.0, np.nan, 2.0], "mean", (3,))
    Traceback (most recent call last):
    ValueError: mean must have finite numbers, got 1 NaN or infinite of 3
    """
    if type(value) is np.ndarray and value.dtype == np.float64:
        array: Array = value
    else:
        array = _convert_to_float64(value, name)
    # Equal tuples are the rule for shapes without free dimensions.
    fits = shape is None or array.shape == shape or match_shape(array.shape, shape, {})
    if not fits and shape is not None:
        raise ValueError(
            f"{name} must have shape {format_shape(shape)}, got {array.shape}"
            f"{describe_misshape(array.shape, shape)}"
        )
    if finite and not all_finite(array):
        count = int((~np.isfinite(array)).sum())
        raise ValueError(
            f"{name} must have finite numbers, "
            f"got {count} NaN or infinite of {array.size}"
        )
    return array


def all_finite(value: Array) -> bool:
    """Whether no number is NaN or infinite.

    >>> all_finite(np.array([1.0, -np.inf])), all_finite(np.array([1e200]))
    (False, True)
    """
    # A finite sum of squares proves it in a fifth of the time; it may overflow.
    if math.isfinite(np.vdot(value, value)):
        return True
    return bool(np.isfinite(value).all())


def _convert_to_float64(value: object, name: str) -> Array:
    """Convert a value that holds real numbers and nothing else.

    Refuse any other by its type; the name is the argument's, for the error.
    """
    wrong_type = type_name(value)
    culprit = value
    try:
        # The entries of a list are checked before numpy converts them to a common type.
        parts = value if isinstance(value, list | tuple) else (value,)
        array = np.asarray(value)
        # An array of objects, numpy's letter "O", may hold numbers, and anything else. "f", "i" and
        # "u" are floats and integers with and without a sign, "U" is text.
        entries = list(array.ravel()) if array.dtype.kind == "O" else []
        if entries:
            culprit = entries[0]
            wrong_type = type_name(culprit)
        # Booleans, text and dates would be converted to numbers without an error.
        refused = [v for v in (*parts, *entries) if isinstance(v, _NOT_REAL)]
        if refused:
            culprit = refused[0]
            wrong_type = type_name(culprit)
        elif array.dtype.kind in "fiuO":
            return np.asarray(array, dtype=np.float64)
        else:
            culprit = array
            # numpy calls a text of four letters str128.
            is_text = array.dtype.kind == "U"
            wrong_type = "str" if is_text else array.dtype.name
    except (TypeError, ValueError, OverflowError):
        pass  # numpy could not convert it: refused below by its type
    raise InvalidArgumentError(
        f"{name} must be an array of real numbers, got {wrong_type}"
        f"{'' if value is None else describe_conversion(culprit)}"
    ) from None


def describe_conversion(value: object) -> str:
    """Return how to turn a value of a wrong type into numbers; nothing where that is not known.

    >>> describe_conversion(None), describe_conversion("1")
    (': a missing number is NaN', '')
    >>> describe_conversion(np.datetime64("2024-03-10"))
    ': give seconds since the start, (x - start) / np.timedelta64(1, "s")'
    """
    if value is None:
        return ": a missing number is NaN"
    if isinstance(value, np.ma.MaskedArray):
        return ": give x.filled(np.nan), a missing number is NaN"
    # numpy's letters of types: "m" is a length of time, "M" a date.
    kind = value.dtype.kind if isinstance(value, np.ndarray | np.generic) else ""
    if kind == "m" or isinstance(value, timedelta):
        return ': give seconds, x / np.timedelta64(1, "s")'
    if kind == "M" or isinstance(value, date):
        return ': give seconds since the start, (x - start) / np.timedelta64(1, "s")'
    return ""


def refuse_mask(value: object, name: str) -> None:
    """Refuse a masked array that a user's function returns; as an array it would lose its mask.

    >>> refuse_mask(np.ma.masked_array([1.0]), "h")
    Traceback (most recent call last):
    distfilt.validation.InvalidArgumentError: h must return numbers, got MaskedArray: ...
    """
    # A plain array, the usual case, has no mask.
    if type(value) is not np.ndarray and isinstance(value, np.ma.MaskedArray):
        raise InvalidArgumentError(
            f"{name} must return numbers, got {type_name(value)}{describe_conversion(value)}"
        )


def match_shape(
    shape: tuple[int, ...], expected: Shape, dimensions: dict[str, int]
) -> bool:
    """Whether a shape is as expected; if so its named dimensions are added to `dimensions`.

    >>> dimensions = {}
    >>> match_shape((3, 5, 2), (..., "N", 2), dimensions), dimensions
    (True, {'N': 5})
    """
    remaining = list(shape)
    # From the right, since leading axes may be free.
    for dimension in reversed(expected):
        if dimension is ...:
            return True
        # An axis that is missing has the size -1, which fits nothing.
        size = remaining.pop() if remaining else -1
        if isinstance(dimension, str):
            # Numbers of components, in lower case, are at least 1.
            may_be_empty = dimension[0].isupper()
            if size > 0 or (size == 0 and may_be_empty):
                dimension = dimensions.setdefault(dimension, size)
        if dimension != size:
            return False
    return not remaining


def format_shape(shape: Shape) -> str:
    """Write a shape as numpy does, ``(..., N, 2)``."""
    names = ["..." if size is ... else str(size) for size in shape]
    text = ", ".join(names)
    return f"({text},)" if len(shape) == 1 else f"({text})"


def describe_misshape(shape: tuple[int, ...], expected: Shape) -> str:
    """Return what to change about a column vector, or a number without an axis; mostly nothing.

    >>> describe_misshape((2, 1), (2,)), describe_misshape((), (..., 1))
    (': a column, give x[:, 0]', ': give [x], an array of one number')
    >>> describe_misshape((), (1, 1)), describe_misshape((1,), (1, 1))
    (': give [[x]], a matrix of one number', ': give [x], a matrix of one number')
    """
    # The number of entries that the last axis should have
    size = expected[-1] if expected else None
    if shape[-1:] == (1,) and len(shape) > 1 and shape[-2] == size != 1:
        return ": a column, give x[:, 0]"
    if expected[-2:] == (1, 1) and shape in ((), (1,)):
        given = "[x]" if shape else "[[x]]"
        return f": give {given}, a matrix of one number"
    if shape == () and size == 1:
        return ": give [x], an array of one number"
    return ""


def format_number(value: float) -> str:
    """Write a number in six digits, or so that a large time keeps its microseconds.

    >>> format_number(0.1 + 0.2), format_number(1.7e9 + 0.25), format_number(1e300)
    ('0.3', '1700000000.25', '1e+300')
    """
    # Six digits serve below 1e5; from 1e14 on a float has no decimals worth writing.
    if not 1e5 <= abs(value) < 1e14:
        return f"{value:g}"
    return f"{value:.6f}".rstrip("0").rstrip(".")


def check_positive_definite(value: Array, name: str) -> None:
    """Refuse a matrix, or a stack with one, that is not symmetric positive definite.

    The value is (..., d, d); the name is the argument's, for the error.

    Examples
    --------
    >>> check_positive_definite(np.array([[1.0, 2.0], [2.0, 1.0]]), "noise")
    Traceback (most recent call last):
    ValueError: noise must be a positive definite matrix, got smallest eigenvalue -1
    """
    _check_symmetric(value, name)
    if not _has_cholesky(value):
        smallest = _smallest_eigenvalues(value)
        _raise_not_positive(value, name, smallest, "definite")


def check_positive_semidefinite(value: Array, name: str) -> None:
    """Refuse a matrix, or a stack with one, that is not symmetric positive semidefinite.

    The value is (..., d, d); the name is the argument's, for the error.

    Examples
    --------
    >>> check_positive_semidefinite(np.zeros((2, 2)), "noise")
    """
    # A variance of zero is that of a constant; in a stack, which is not searched, some may be. A
    # diagonal matrix of nonnegative numbers is semidefinite.
    has_constants = value.ndim != 2 or np.count_nonzero(value.diagonal()) < len(value)
    if has_constants and is_nonnegative_diagonal(value):
        return
    _check_symmetric(value, name)
    # A noise that leaves some components alone has zeros there, which need no look.
    if _has_cholesky(_drop_constants(value) if has_constants else value):
        return
    # Rounding alone may have made an eigenvalue negative, by 1e-9 of the variances at most.
    smallest = _smallest_eigenvalues(value)
    if smallest.min() < -_ROUNDING:
        _raise_not_positive(value, name, smallest, "semidefinite")


def is_nonnegative_diagonal(value: Array) -> bool:
    """Whether a single square matrix is diagonal, without a negative number or NaN.

    >>> (
    ...     is_nonnegative_diagonal(np.diag([1.0, 0.0])),
    ...     is_nonnegative_diagonal(-np.eye(2)),
    ... )
    (True, False)
    """
    if value.ndim != 2 or value.shape[0] != value.shape[1]:
        return False
    diagonal = value.diagonal()
    if np.count_nonzero(value) > np.count_nonzero(diagonal):
        return False
    return bool(np.count_nonzero(diagonal >= 0) == diagonal.size)


def _check_symmetric(value: Array, name: str) -> None:
    """Refuse matrices that are not square or not symmetric up to rounding.

    They are (..., d, d); the name is the argument's, for the error.
    """
    if value.ndim < 2 or value.shape[-1] != value.shape[-2]:
        raise ValueError(f"{name} must be a square matrix, got shape {value.shape}")
    # Equal bytes are the rule, and compared in a fifth of a difference's time.
    if value.tobytes() == value.mT.tobytes():
        return
    scaled = _to_unit_variances(value)
    too_large = np.abs(scaled - scaled.mT) > _ROUNDING
    asymmetry = np.abs(value - value.mT)[too_large].max(initial=0.0)
    if asymmetry > 0:
        raise ValueError(
            f"{name} must be a symmetric matrix, got an asymmetry of {asymmetry:.3g}"
        )


def _has_cholesky(value: Array) -> bool:
    """Whether all matrices of a stack have a Cholesky factor.

    They are (..., d, d).
    """
    if value.ndim == 2 and value.size:
        # LAPACK itself takes a fifth of numpy's time for one matrix.
        _factor, failed = dpotrf(value, lower=1)
        if not failed:
            return True
    with contextlib.suppress(np.linalg.LinAlgError):
        np.linalg.cholesky(value)
        return True
    return False


def _drop_constants(value: Array) -> Array:
    """Return a single matrix without the rows and columns that are zero; a stack as it is.

    >>> _drop_constants(np.diag([2.0, 0.0]))
    array([[2.]])
    """
    if value.ndim > 2:
        return value
    # The components that have a variance
    not_constant = np.flatnonzero(value.diagonal())
    if not_constant.size == len(value):
        return value
    part = value[not_constant][:, not_constant]
    # Beside a zero on the diagonal, anything but zeros makes the matrix indefinite.
    return part if np.count_nonzero(part) == np.count_nonzero(value) else value


def _smallest_eigenvalues(value: Array) -> Array:
    """Smallest eigenvalues of covariances that are scaled to unit variances."""
    eigenvalues = np.linalg.eigvalsh(_to_unit_variances(value))
    return np.asarray(eigenvalues[..., 0], dtype=np.float64)


def _raise_not_positive(value: Array, name: str, smallest: Array, kind: str) -> None:
    """Raise the error that gives the worst matrix's smallest eigenvalue and its index.

    The smallest eigenvalues (...) are those of matrices scaled to unit variances; `kind` is
    definite or semidefinite.
    """
    # The first matrix of the stack with the smallest eigenvalue, which is given in its own units.
    index = tuple(np.argwhere(smallest == smallest.min())[0].tolist())
    eigenvalue = np.linalg.eigvalsh(value[index])[0]
    place = f" at {list(index)}" if index else ""
    raise ValueError(
        f"{name} must be a positive {kind} matrix, "
        f"got smallest eigenvalue {eigenvalue:.6g}{place}"
    )


def _to_unit_variances(cov: Array) -> Array:
    """Scale covariances to unit variances; entries are clipped to [-2, 2]."""
    std = np.sqrt(np.abs(np.diagonal(cov, axis1=-2, axis2=-1)))
    unit = np.where(std > 0, std, 1.0)
    # Correlations lie in [-1, 1]: beyond 2 an entry is wrong by any measure.
    with np.errstate(over="ignore"):
        scaled = cov / unit[..., :, None] / unit[..., None, :]
    return np.clip(scaled, -2.0, 2.0)


def check_probabilities(value: Array, name: str) -> None:
    """Refuse weights that are negative or do not sum to one along the last axis.

    The value is (..., N); the name is the argument's, for the error.

    Examples
    --------
    >>> check_probabilities(np.array([0.5, 0.6]), "weights")
    Traceback (most recent call last):
    ValueError: weights must sum to 1, got 1.1
    """
    # An empty array has no minimum.
    if value.size and value.min() < 0:
        raise ValueError(f"{name} must be nonnegative weights, got {value.min():.6g}")
    total = np.ravel(value.sum(axis=-1))
    error = np.abs(total - 1)
    # Strict, since for states far from zero a small missing weight moves the mean.
    largest = error.max(initial=0.0)
    # Beyond 1e-4 the weights are wrong; below it they have been rounded, as to single precision.
    if largest > 1e-9:
        got = total[error.argmax()]
        if largest > 1e-4:
            raise ValueError(f"{name} must sum to 1, got {got:.9g}")
        raise ValueError(
            f"{name} must sum to 1 up to 1e-9, got a sum that is {largest:.1e} off: divide "
            "weights of single precision, or rounded ones, by their sum as float64"
        )


def check_increasing(value: Array, name: str) -> None:
    """Refuse numbers that do not strictly increase.

    The value is (T,); the name is the argument's, for the error.

    Examples
    --------
    >>> check_increasing(np.array([0.0, 0.2, 0.2]), "times")
    Traceback (most recent call last):
    ValueError: times must be strictly increasing, got 0.2 after 0.2
    """
    not_above = value[1:] <= value[:-1]
    if not_above.any():
        k = int(not_above.argmax())
        raise ValueError(
            f"{name} must be strictly increasing, got {format_number(value[k + 1])} after "
            f"{format_number(value[k])}"
        )


def check_distinct(value: Sequence[int], name: str) -> None:
    """Refuse an empty list of indices, and one that holds an index twice.

    Examples
    --------
    >>> check_distinct((2, 2), "local")
    Traceback (most recent call last):
    ValueError: local must have distinct integers, one or more, got [2, 2]
    """
    if not len(value) or len(set(value)) < len(value):
        raise ValueError(
            f"{name} must have distinct integers, one or more, got {list(value)}"
        )


@dataclass(frozen=True, kw_only=True)
class Bounds:
    """A rule for a number, or for each entry of an array.

    Examples
    --------
    >>> Bounds(at_least=0)(-0.2, "sigma")
    Traceback (most recent call last):
    ValueError: sigma must be nonnegative, got -0.2
    """

    above: float | None = None
    at_least: float | None = None
    below: float | None = None
    at_most: float | None = None

    def __call__(self, value: float | Array, name: str) -> None:
        """Refuse a number, or an array with an entry, that is out of bounds."""
        for side, compare in _COMPARISONS.items():
            bound = getattr(self, side)
            if bound is None:
                continue
            inside = compare(value, bound)
            # A single number is compared without numpy, which is faster.
            if inside is True or np.all(inside):
                continue
            # The number itself, not its type: 2.0, not np.float64(2.0).
            outside = value
            if isinstance(value, np.ndarray) and value.ndim:
                outside = value[~inside].flat[0].item()
            raise ValueError(
                f"{name} must be {_describe_bound(side, bound)}, got {outside!r}"
            )


def _describe_bound(side: str, bound: float) -> str:
    """Write a bound as "positive" or "at least 1"."""
    if bound == 0 and side == "above":
        return "positive"
    if bound == 0 and side == "at_least":
        return "nonnegative"
    return f"{side.replace('_', ' ')} {format_number(bound)}"


_COMPARISONS = {
    "above": operator.gt,
    "at_least": operator.ge,
    "below": operator.lt,
    "at_most": operator.le,
}
