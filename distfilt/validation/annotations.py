"""Constraints that annotations declare: an argument's conversion, its shape and its rules."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import date, timedelta
from functools import cache, partial
from types import EllipsisType, UnionType
from typing import Annotated, Any, Literal, TypeAlias, Union, get_args, get_origin

import numpy as np
from numpy.typing import ArrayLike

from .checks import (
    Array,
    Indices,
    InvalidArgumentError,
    Mask,
    Shape,
    check_array,
    describe_conversion,
    describe_misshape,
    format_shape,
    match_shape,
    type_name,
)

__all__ = ["ALLOW_NAN", "CallContext", "ArgumentConstraint", "make_constraint"]

# Beside an array's shape: NaN may stand for a missing number; infinity may not.
ALLOW_NAN = "missing allowed"


@dataclass(slots=True)
class CallContext:
    """The arguments of one call by name, and the dimensions that their shapes have bound."""

    arguments: dict[str, object]
    dimensions: dict[str, int] = field(default_factory=dict)

    def bind_shape(self, shape: tuple[int, ...], expected: ShapeNames) -> bool:
        """Whether a shape is as declared; if so the free names are bound to its sizes."""
        names = expected.names
        # As a rule no name refers to an argument, and all are free.
        if not expected.references.isdisjoint(self.arguments):
            names = self.resolve(names)
        # A copy, since a shape that does not match must bind nothing.
        dimensions = self.dimensions.copy()
        matches = match_shape(shape, names, dimensions)
        if matches:
            self.dimensions = dimensions
        return matches

    def resolve(self, names: Shape) -> Shape:
        """Replace the names of dimensions that are known by their sizes."""
        shape: list[int | str | EllipsisType] = []
        for name in names:
            size = self._size(name) if isinstance(name, str) else name
            # A tuple stands for several axes, such as the axes of runs.
            if isinstance(size, tuple):
                shape.extend(size)
            else:
                shape.append(size)
        return tuple(shape)

    def _size(self, name: str) -> int | str | tuple[int, ...]:
        """Return a dimension's size, sizes of several axes, or the name while it is free."""
        if name in self.dimensions:
            return self.dimensions[name]
        # A path such as model.dim starts at an argument; a star before it says that it stands for
        # several axes.
        argument, *attributes = name.lstrip("*").split(".")
        value = self.arguments.get(argument)
        for attribute in attributes:
            if value is None:
                return name  # an optional argument that is absent binds nothing
            value = getattr(value, attribute)
        if isinstance(value, np.integer):
            return int(value)
        return value if isinstance(value, int | tuple) else name


@dataclass(frozen=True)
class ShapeNames:
    """The dimensions of a declared shape."""

    names: Shape
    # The first part of each name, which may be an argument of the call.
    references: frozenset[str]

    @classmethod
    def parse(cls, words: Sequence[str]) -> ShapeNames:
        """Read the words of a shape such as ``"... N model.dim"``."""
        # A number is a size, "..." stands for any leading axes, other words are names.
        names: list[int | str | EllipsisType] = []
        for word in words:
            if word.isdigit():
                names.append(int(word))
            else:
                names.append(... if word == "..." else word)
        references = [word.lstrip("*").split(".")[0] for word in words]
        return cls(tuple(names), frozenset(references))


Converter: TypeAlias = Callable[[object, str, CallContext], object]
Rule: TypeAlias = Callable[[object, str], None]


@dataclass(frozen=True)
class ArgumentConstraint:
    """The values that an argument may have: a description, a conversion, and further rules."""

    description: str
    convert: Converter
    rules: tuple[Rule, ...] = ()
    has_shape: bool = False

    def validate(self, value: object, name: str, context: CallContext) -> object:
        """Return the value as the function gets it, or raise an error that names it.

        A conversion raises TypeError for a value of a wrong type. The context has the other
        arguments of the call and the sizes of axes so far.
        """
        try:
            result = self.convert(value, name, context)
        except InvalidArgumentError:
            raise  # the conversion has named the argument already
        except TypeError:
            is_short = isinstance(value, str | int | float)
            text = repr(value) if is_short else type_name(value)
            raise InvalidArgumentError(
                f"{name} must be {self.description}, got {text}{_describe_time(value)}"
            ) from None
        for rule in self.rules:
            rule(result, name)
        return result


def _describe_time(value: object) -> str:
    """Return how to turn a time of a calendar, or a duration, into seconds; otherwise nothing.

    >>> _describe_time(np.timedelta64(5, "ms"))
    ': give seconds, x / np.timedelta64(1, "s")'
    """
    is_time = isinstance(value, date | timedelta | np.datetime64 | np.timedelta64)
    return describe_conversion(value) if is_time else ""


def _convert_float(value: object, name: str, context: CallContext) -> float:
    """Return a finite real number as a float; TypeError for anything else."""
    # These types need no array; all others go through its conversion, which refuses most.
    try:
        if isinstance(value, float | int) and not isinstance(value, bool):
            result = float(value)
        else:
            result = float(check_array(value, name, ()))
    except (ValueError, OverflowError):  # an integer may have hundreds of digits
        raise TypeError from None
    if not math.isfinite(result):
        raise TypeError
    return result


def _convert_int(value: object, name: str, context: CallContext) -> int:
    """Return an integer of Python or numpy as an int; TypeError for anything else."""
    # A bool is an int in Python, and a timedelta an integer in numpy.
    if isinstance(value, bool | np.timedelta64):
        raise TypeError
    if not isinstance(value, int | np.integer):
        raise TypeError
    return int(value)


def _convert_bool(value: object, name: str, context: CallContext) -> bool:
    """Return True or False, of Python or numpy, as a bool; TypeError for anything else."""
    if not isinstance(value, bool | np.bool_):
        raise TypeError
    return bool(value)


def _check_text(value: object, name: str, context: CallContext) -> str:
    """Return a string that is not blank; TypeError for anything else."""
    if not isinstance(value, str) or not value.strip():
        raise TypeError
    return value


def _check_instance(
    cls: type, value: object, name: str, context: CallContext
) -> object:
    """Return an instance of a class; TypeError for anything else."""
    if not isinstance(value, cls):
        raise TypeError
    return value


def _check_callable(value: object, name: str, context: CallContext) -> object:
    """Return a function; the options of a partial of a validated function are checked here."""
    if not callable(value):
        # The message is written where this is caught.
        raise TypeError
    if not isinstance(value, partial):
        return value
    # A function that is decorated by @validated carries its constraints.
    constraints = getattr(value.func, "signature_constraints", None)
    if constraints is None:
        return value
    # The library will call the function, and does not check calls from within: so a partial's
    # options are checked here.
    options = constraints.validate((), value.keywords)
    return partial(value.func, *value.args, **options)


def _check_option(
    options: tuple[object, ...], value: object, name: str, context: CallContext
) -> object:
    """Return a value that equals one of the options; TypeError for any other."""
    for option in options:
        # Types are compared first: 1 == True, and an array compares entry by entry.
        if type(value) is type(option) and value == option:
            return value
    raise TypeError


def _convert_array(
    dtype: type,
    shape: ShapeNames | None,
    allow_nan: bool,
    value: object,
    name: str,
    context: CallContext,
) -> Array | Mask | Indices:
    """Return an array of real numbers, booleans or integers, by its dtype, of a declared shape.

    A wrong type raises a TypeError without a message, which :meth:`ArgumentConstraint.validate`
    writes. `allow_nan` says whether NaN may stand for missing numbers; the context has the call's
    sizes of axes so far.
    """
    if dtype is np.float64:
        array: Array | Mask | Indices = check_array(value, name, finite=not allow_nan)
        if allow_nan and np.isinf(array).any():
            raise ValueError(
                f"{name} must have finite numbers or NaN (missing), got infinity"
            )
    else:
        array = np.asarray(value)
        # numpy's letters: "b" are booleans, "iu" integers with and without a sign. A float array of
        # whole numbers is none of them.
        dtype_kinds = "b" if dtype is np.bool_ else "iu"
        is_masked = isinstance(value, np.ma.MaskedArray)
        if array.dtype.kind not in dtype_kinds or is_masked:
            raise TypeError
    # Names of axes stand for the sizes that earlier arguments have given them.
    if shape is not None and not context.bind_shape(array.shape, shape):
        names = context.resolve(shape.names)
        raise ValueError(
            f"{name} must have shape {format_shape(names)}, got {array.shape}"
            f"{describe_misshape(array.shape, names) or _hint_at_column(array.shape, context)}"
        )
    return array


def _hint_at_column(shape: tuple[int, ...], context: CallContext) -> str:
    """Return a hint at an earlier argument whose column of numbers made this shape look wrong.

    A column (n, 1) has bound the size of an axis to 1, where n was meant. Without one return "".
    The context has the arguments of the call.
    """
    for name, value in context.arguments.items():
        column = np.shape(value) if isinstance(value, np.ndarray | list) else ()
        # A vector of n numbers as (n, 1), beside an array with axes of n.
        if column[1:] == (1,) and column[0] > 1 and column[0] == shape[-1]:
            return f": {name} has shape {column}, a column; give {name}[:, 0]"
    return ""


def _convert_sequence(
    entry: ArgumentConstraint | None, value: object, name: str, context: CallContext
) -> tuple[object, ...]:
    """Return a sequence of any length as a tuple, each entry as its constraint converts it."""
    entries = _to_tuple(value)
    if entry is None:
        return entries
    return tuple([entry.validate(item, name, context) for item in entries])


def _convert_tuple(
    constraints: tuple[ArgumentConstraint | None, ...],
    value: object,
    name: str,
    context: CallContext,
) -> tuple[object, ...]:
    """Return a sequence as a tuple that has one entry for each constraint, converted by it."""
    entries = _to_tuple(value)
    if len(entries) != len(constraints):
        raise ValueError(
            f"{name} must have {len(constraints)} entries, got {len(entries)}"
        )
    result = []
    for constraint, item in zip(constraints, entries, strict=True):
        # None allows any value.
        if constraint is not None:
            item = constraint.validate(item, name, context)
        result.append(item)
    return tuple(result)


def _to_tuple(value: object) -> tuple[object, ...]:
    """Return the entries of a sequence; a string or a mapping is none."""
    if isinstance(value, str | bytes | Mapping) or not np.iterable(value):
        raise TypeError
    return tuple(value)


def _convert_union(
    alternatives: tuple[ArgumentConstraint, ...],
    optional: bool,
    value: object,
    name: str,
    context: CallContext,
) -> object:
    """Return the value as the first alternative converts it that takes it; None if `optional`."""
    if value is None and optional:
        return None
    for constraint in alternatives:
        try:
            return constraint.validate(value, name, context)
        except ValueError as error:
            # The next alternative may take the value, unless there is none, or the value is a
            # number of the right type out of bounds.
            if len(alternatives) == 1 or _is_out_of_bounds(value, constraint, error):
                raise
    # The message is written where this is caught.
    raise TypeError


def _is_out_of_bounds(
    value: object, constraint: ArgumentConstraint, error: ValueError
) -> bool:
    """Whether a number has the right type for a constraint, and breaks one of its rules.

    No other alternative will take it, and this error says more than a list of alternatives.
    """
    is_number = type(value) in (int, float)
    takes_numbers = constraint.convert in (_convert_float, _convert_int)
    return is_number and takes_numbers and constraint.description not in str(error)


FINITE_FLOAT = ArgumentConstraint("a finite number", _convert_float)
"""The constraint of `float`."""

_PLAIN_TYPES = {
    float: FINITE_FLOAT,
    int: ArgumentConstraint("an integer", _convert_int),
    str: ArgumentConstraint("a string that is not blank", _check_text),
    bool: ArgumentConstraint("a bool, True or False", _convert_bool),
    Callable: ArgumentConstraint("a function", _check_callable),
    np.random.Generator: ArgumentConstraint(
        "a numpy.random.Generator (np.random.default_rng(seed))",
        partial(_check_instance, np.random.Generator),
    ),
}
_SEQUENCES = (Sequence, Collection, Iterable, tuple, list)


@cache
def make_constraint(annotation: object) -> ArgumentConstraint | None:
    """Return the constraint that an annotation declares, or None if any value is allowed.

    Examples
    --------
    >>> from distfilt.validation import PositiveInt
    >>> make_constraint(PositiveInt).validate(0, "members", CallContext({}))
    Traceback (most recent call last):
    ValueError: members must be at least 1, got 0
    """
    if annotation in (Any, object, ArrayLike):
        return None
    annotation = _resolve_alias(annotation)
    # Annotated[X, ...] has the origin Annotated, Sequence[X] the origin Sequence.
    origin = get_origin(annotation)
    args = get_args(annotation)
    if origin is Annotated:
        return _make_annotated(args[0], args[1:])
    if origin in (Union, UnionType):
        return _make_union(args)
    if origin is Literal:
        options = ", ".join(map(str, args))
        return ArgumentConstraint(f"one of {options}", partial(_check_option, args))
    # Annotations of numpy's arrays are those of ndarray with a dtype.
    if origin is np.ndarray:
        return _make_array(annotation)
    if origin in _SEQUENCES:
        return _make_sequence(origin, args)
    # Of a generic class only instances are checked, not its parameters.
    cls = origin or annotation
    if cls in _PLAIN_TYPES or not isinstance(cls, type):
        return _PLAIN_TYPES.get(cls)
    article = "an" if cls.__name__[0] in "AEIOU" else "a"
    return ArgumentConstraint(
        f"{article} {cls.__name__}", partial(_check_instance, cls)
    )


def _make_sequence(origin: object, args: tuple[object, ...]) -> ArgumentConstraint:
    """Return the constraint of a sequence of any length, or of a tuple of a fixed one.

    The annotation is ``origin[args]``.
    """
    # tuple[X, Y] has a fixed length, tuple[X, ...] any.
    if origin is tuple and args[-1] is not ...:
        constraints = tuple([make_constraint(arg) for arg in args])
        description = f"a tuple of {_describe(constraints, ', ')}"
        convert: Converter = partial(_convert_tuple, constraints)
    else:
        constraints = (make_constraint(args[0]),)
        description = f"a sequence, each entry {_describe(constraints, '')}"
        convert = partial(_convert_sequence, constraints[0])
    return ArgumentConstraint(description, convert, has_shape=_have_shape(constraints))


def _make_union(args: tuple[object, ...]) -> ArgumentConstraint | None:
    """Return the constraint of a union, whose alternatives are tried in order."""
    alternatives = []
    for arg in args:
        if arg is type(None):
            continue
        constraint = make_constraint(arg)
        # If one alternative allows any value, so does the union.
        if constraint is None:
            return None
        alternatives.append(constraint)
    optional = type(None) in args
    return ArgumentConstraint(
        _describe(alternatives, " or "),
        partial(_convert_union, tuple(alternatives), optional),
        has_shape=_have_shape(alternatives),
    )


def _make_annotated(
    base: object, metadata: tuple[object, ...]
) -> ArgumentConstraint | None:
    """Return the constraint of a type with a shape and rules beside it.

    Of several shapes the last one counts, so that an alias with a shape can be narrowed. Of
    ``Annotated[base, *metadata]`` the metadata has shapes, ALLOW_NAN and rules.
    """
    # Strings among the metadata are shapes, functions are rules.
    base = _resolve_alias(base)
    shapes = [note for note in metadata if isinstance(note, str) and note != ALLOW_NAN]
    if get_origin(base) is np.ndarray:
        shape = shapes[-1].split() if shapes else None
        constraint: ArgumentConstraint | None = _make_array(
            base, shape, ALLOW_NAN in metadata
        )
    else:
        constraint = make_constraint(base)
    if constraint is None:
        return None
    # Rules come after those of the alias that is annotated further.
    rules: tuple[Rule, ...] = tuple([note for note in metadata if callable(note)])
    return replace(constraint, rules=constraint.rules + rules)


def _make_array(
    base: object, words: Sequence[str] | None = None, allow_nan: bool = False
) -> ArgumentConstraint:
    """Return the constraint of an array, of any shape if there are no words for it.

    `base` is the array type of an annotation, and the words name its axes. NaN is allowed or not.
    """
    # NDArray[X] is ndarray[shape, dtype[X]].
    dtype = get_args(get_args(base)[1])[0]
    entries = {np.float64: "real numbers", np.bool_: "True and False"}
    description = f"an array of {entries.get(dtype, 'integers')}"
    # The names of the axes, if the array must have a certain shape.
    shape = None
    if words is not None:
        description += f" of shape ({', '.join(words)})"
        shape = ShapeNames.parse(words)
    convert = partial(_convert_array, dtype, shape, allow_nan)
    return ArgumentConstraint(description, convert, has_shape=True)


def _resolve_alias(annotation: object) -> object:
    """Return the type that a ``type`` alias stands for; numpy's NDArray is one since 2.5."""
    args = get_args(annotation)
    value = getattr(get_origin(annotation) or annotation, "__value__", None)
    if value is None:
        return annotation
    return _resolve_alias(value[args] if args else value)


def _describe(constraints: Iterable[ArgumentConstraint | None], separator: str) -> str:
    """Join the descriptions of several constraints."""
    texts = [c.description if c else "anything" for c in constraints]
    return separator.join(texts)


def _have_shape(constraints: Iterable[ArgumentConstraint | None]) -> bool:
    """Whether any of the constraints declares the shape of an array."""
    return any(c is not None and c.has_shape for c in constraints)
