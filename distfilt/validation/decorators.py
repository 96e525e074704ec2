"""Validation by annotations: of a function's arguments, and of the fields of a frozen dataclass.

Nested calls skip it, and so does a dataclass that the library constructs.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Hashable, Mapping
from contextvars import ContextVar
from dataclasses import Field, fields
from functools import cache, cached_property, partial, wraps
from inspect import Parameter, get_annotations, signature
from math import isfinite
from typing import TYPE_CHECKING, ClassVar, NamedTuple, Self, TypeVar, cast

import numpy as np

from .annotations import FINITE_FLOAT, ArgumentConstraint, CallContext
from .checks import InvalidArgumentError
from .resolving import make_constraints, sort_arrays_last

__all__ = [
    "FrozenModel",
    "SignatureConstraints",
    "call_user",
    "check_signature",
    "field_constraints",
    "skip_validation",
    "validated",
]

R = TypeVar("R")
F = TypeVar("F", bound=Callable[..., object])


class SignatureConstraints:
    """The constraints of a function's parameters, evaluated when it is first called."""

    def __init__(
        self,
        function: Callable[..., object],
        annotations: Mapping[str, object] | None = None,
    ) -> None:
        self.function = function
        self.annotations = annotations

    @cached_property
    def constraints(self) -> dict[str, ArgumentConstraint]:
        """Constraints by parameter, those of arrays last."""
        # The function's own annotations, unless others have been given in their place.
        function = self.function
        annotations = self.annotations
        if annotations is None:
            annotations = function.__annotations__
        return make_constraints(
            annotations,
            function.__module__,
            function.__globals__,
            f"{function.__qualname__}()",
        )

    @cached_property
    def positional_names(self) -> tuple[str, ...]:
        """Names of the parameters that may be given by position."""
        parameters = signature(self.function).parameters.values()
        allowed = (Parameter.POSITIONAL_ONLY, Parameter.POSITIONAL_OR_KEYWORD)
        return tuple([p.name for p in parameters if p.kind in allowed])

    @cached_property
    def defaults(self) -> dict[str, object]:
        """Default values by parameter."""
        parameters = signature(self.function).parameters.values()
        return {
            p.name: p.default for p in parameters if p.default is not Parameter.empty
        }

    def validate(
        self, args: tuple[object, ...], options: dict[str, object]
    ) -> dict[str, object]:
        """Return the converted arguments by name, or raise an error for the first wrong one."""
        arguments = dict(zip(self.positional_names, args, strict=False)) | options
        # Fewer names than arguments: `zip` has dropped some, as there are too many by position, or
        # one is given both by position and by name.
        if len(arguments) < len(args) + len(options):
            self._refuse_positions(args)
            # Python's own error says which argument is given twice.
            signature(self.function).bind(*args, **options)
        # Shapes may refer to defaults too, which are not checked.
        context = CallContext(self.defaults | arguments)
        for name, constraint in self.constraints.items():
            if name in arguments:
                value = arguments[name]
                # The most frequent case, a time, needs no conversion.
                if (
                    constraint is FINITE_FLOAT
                    and type(value) is float
                    and isfinite(value)
                ):
                    continue
                value = constraint.validate(value, name, context)
                # Later shapes refer to the converted value.
                arguments[name] = value
                context.arguments[name] = value
        return arguments

    def _refuse_positions(self, args: tuple[object, ...]) -> None:
        """Refuse more arguments by position than there are, naming those to give by name."""
        n_allowed = len(self.positional_names)
        parameters = signature(self.function).parameters.values()
        names = [p.name for p in parameters if p.kind is Parameter.KEYWORD_ONLY]
        has_more = any(p.kind is Parameter.VAR_POSITIONAL for p in parameters)
        if len(args) <= n_allowed or has_more or not names:
            return
        name = self.function.__name__
        # The error shows how to give the first of them by name, unless its value is long.
        options = ", ".join(f"{option}=" for option in names)
        example = f"{names[0]}={args[n_allowed]!r}"
        hint = f", such as {example}" if len(example) < 40 else ""
        raise InvalidArgumentError(
            f"{name}() must have at most {n_allowed} of its arguments by position, got "
            f"{len(args)}: give {options} by name{hint}"
        )


class _Flag:
    """A context variable that is pickled by its name.

    A wrapper made inside a function is sent to a worker with its globals, and a plain
    `ContextVar` cannot be pickled.
    """

    __slots__ = ("get", "reset", "set")

    def __init__(self) -> None:
        variable = ContextVar("nested", default=False)
        self.get = variable.get
        self.set = variable.set
        self.reset = variable.reset

    def __reduce__(self) -> str:
        return "_NESTED"


_NESTED = _Flag()
"""Whether a validated function is running, so that functions which it calls skip the checks."""


def validated(
    function: F,
    *,
    call: Callable[..., object] | None = None,
    annotations: Mapping[str, object] | None = None,
) -> F:
    """Let a function's annotations check its arguments.

    The checks are made once, at the outermost call: functions that a validated function calls get
    arguments that the library made. A function of the user's is called by :func:`call_user`, inside
    which arguments are checked again.

    Parameters
    ----------
    function : callable
        Its annotations are as in the table of :mod:`distfilt.validation`. Defaults are not checked.
    call : callable, optional
        Called with the checked arguments in place of the function, by their names.
    annotations : mapping of str to annotation, optional
        Annotations by argument, in place of the function's own.

    Returns
    -------
    callable
        The same function with checks.

    Raises
    ------
    NameError
        At the first call, if an annotation cannot be evaluated.

    Examples
    --------
    >>> from typing import Annotated
    >>> from distfilt.validation import Array, ArrayInput, PositiveFloat
    >>> @validated
    ... def scale(
    ...     x: Annotated[ArrayInput, "... d"], factor: PositiveFloat = 2.0
    ... ) -> Array:
    ...     return factor * x
    >>> scale([1.0, 2.0])
    array([2., 4.])
    >>> scale([1.0, 2.0], factor=-1.0)
    Traceback (most recent call last):
    ValueError: factor must be positive, got -1.0
    """
    constraints = SignatureConstraints(function, annotations)
    # The function that a user's call reaches, with checked arguments
    call_checked = function if call is None else call

    @wraps(function)
    def wrapper(*args: object, **options: object) -> object:
        # Within a validated function the library calls, whose arguments need no check. `_NESTED`
        # holds for this thread and task only, and the token restores what it was.
        if _NESTED.get():
            return function(*args, **options)
        arguments = constraints.validate(args, options)
        token = _NESTED.set(True)
        try:
            # The function itself, or `call` in its place
            return call_checked(**arguments)
        finally:
            _NESTED.reset(token)

    wrapper.signature_constraints = constraints  # type: ignore[attr-defined]
    return cast(F, wrapper)


class skip_validation:
    """Skip the checks of all validated functions, in a loop whose arguments are known to fit.

    Arrays must then be float64 arrays of the declared shapes, since nothing is converted either.

    Examples
    --------
    >>> import numpy as np
    >>> from distfilt.sensors import wrap
    >>> with skip_validation():
    ...     wrap(np.array([4.0])).round(3)
    array([-2.283])
    """

    __slots__ = ("_token",)

    def __enter__(self) -> None:
        self._token = _NESTED.set(True)

    def __exit__(self, *_: object) -> None:
        _NESTED.reset(self._token)


def check_signature(
    function: Callable[..., object], name: str, parameters: str
) -> None:
    """Refuse a function that cannot be called with these parameters, such as "x, t, dt".

    Examples
    --------
    >>> check_signature(lambda x: x, "transition", "x, t, dt")
    Traceback (most recent call last):
    distfilt.validation.InvalidArgumentError: transition must be a function of (x, t, dt), got ...
    """
    try:
        declared = signature(function)
    except (TypeError, ValueError):
        return  # some functions in C do not tell
    try:
        declared.bind(*parameters.split(", "))
    except TypeError:
        raise InvalidArgumentError(
            f"{name} must be a function of ({parameters}), got one of {declared}"
        ) from None


def call_user(function: Callable[..., R], *args: object, **options: object) -> R:
    """Call a function that the user may have written, inside which arguments are checked again.

    A function of the library is trusted, and skips its checks.

    Examples
    --------
    >>> call_user(max, 1, 2)
    2
    """
    # As `is_of_library`, without a call for each call.
    unwrapped: Callable[..., object] = function
    while isinstance(unwrapped, partial):
        unwrapped = unwrapped.func
    module = getattr(unwrapped, "__module__", None) or ""
    if module.startswith("distfilt."):
        return function(*args, **options)
    # Inside a user's function validated functions check their arguments.
    token = _NESTED.set(False)
    try:
        return function(*args, **options)
    finally:
        _NESTED.reset(token)


def is_of_library(function: Callable[..., object]) -> bool:
    """Whether a function, or the innermost one of a partial, is one of this package.

    >>> is_of_library(max), is_of_library(partial(is_of_library, max))
    (False, True)
    """
    # A partial has no module; its innermost function does.
    unwrapped = function
    while isinstance(unwrapped, partial):
        unwrapped = unwrapped.func
    module = getattr(unwrapped, "__module__", None) or ""
    return bool(module.startswith("distfilt."))


class FrozenModel:
    """A base of frozen dataclasses whose constructors check the fields by their annotations.

    Arrays are copied and kept read-only. A subclass with relations between its fields extends
    `__post_init__`.

    Examples
    --------
    >>> from dataclasses import dataclass
    >>> @dataclass(frozen=True, eq=False)
    ... class Label(FrozenModel):
    ...     text: str
    ...     size: int
    >>> Label("a", 1.5)
    Traceback (most recent call last):
    distfilt.validation.InvalidArgumentError: size must be an integer, got 1.5
    """

    if TYPE_CHECKING:
        # Subclasses are dataclasses.
        __dataclass_fields__: ClassVar[dict[str, Field[object]]]

    is_validated: ClassVar[bool] = False
    """Whether the constructor checked this instance; not if the library constructed it."""

    def __post_init__(self) -> None:
        # The cast is for mypy: `field_constraints` is cached, so its argument must be hashable.
        cls = cast(Hashable, type(self))
        context = CallContext(dict(vars(self)))
        # Shapes refer to fields by name, as they do to arguments in a call.
        values = context.arguments
        for name, constraint in field_constraints(cls).items():
            value = constraint.validate(values[name], name, context)
            values[name] = _freeze(value)
        # A frozen dataclass has no __setattr__; its dictionary takes the converted values.
        vars(self).update(values, is_validated=True)

    @classmethod
    def construct(cls, *args: object, **options: object) -> Self:
        """Build an instance of values that the library made: nothing is checked or copied."""
        # Past __init__, and so past the checks.
        instance = object.__new__(cls)
        dataclass = cast(Hashable, cls)
        names, factories = _list_fields(dataclass)
        # The dictionary takes the fields, since a frozen dataclass cannot be assigned to.
        values = vars(instance)
        values.update(zip(names, args, strict=False), **options)
        for name, factory in factories:
            if name not in values:
                values[name] = factory()
        return instance

    def replace(self, **changes: object) -> Self:
        """Return a copy with other values in some fields, unchecked."""
        cls = cast(Hashable, type(self))
        values = {name: getattr(self, name) for name in _list_fields(cls).names}
        return self.construct(**values | changes)


class _FieldList(NamedTuple):
    """The names of a dataclass's fields, and (name, factory) of those with a factory.

    A factory makes a field's default, anew for each instance. A default that is no factory is an
    attribute of the class, so that instances need none.
    """

    names: tuple[str, ...]
    factories: tuple[tuple[str, Callable[[], object]], ...]


@cache
def _list_fields(cls: type[FrozenModel]) -> _FieldList:
    """Return the fields of a dataclass, in the order of its constructor."""
    names = []
    factories = []
    for item in fields(cls):
        names.append(item.name)
        # In a class that was sent to another process, "none" is a copy of MISSING.
        if callable(item.default_factory):
            factories.append((item.name, item.default_factory))
    return _FieldList(tuple(names), tuple(factories))


@cache
def field_constraints(cls: type[FrozenModel]) -> dict[str, ArgumentConstraint]:
    """Return the constraints of a dataclass's fields by name, inherited ones included.

    Those of arrays are last, as their shapes may refer to other fields.
    """
    dataclass = cast(Hashable, cls)
    names = _list_fields(dataclass).names
    constraints: dict[str, ArgumentConstraint] = {}
    # Base classes first, so that a subclass may narrow the annotation of a field.
    for base in reversed(cls.__mro__):
        annotations = get_annotations(base)
        declared = {name: annotations[name] for name in annotations if name in names}
        # The names that annotations may use; a class made in a shell may have no module, and any
        # module then serves for the built-in names.
        module_names = vars(sys.modules.get(base.__module__, sys))
        constraints |= make_constraints(
            declared, base.__module__, module_names, base.__qualname__
        )
    return sort_arrays_last(constraints)


def _freeze(value: object) -> object:
    """Return a value with read-only copies of the arrays in it."""
    if type(value) is tuple:
        return tuple([_freeze(entry) for entry in value])
    if not isinstance(value, np.ndarray):
        return value
    # The caller may change its own array later.
    copy = value.copy()
    copy.setflags(write=False)
    return copy
