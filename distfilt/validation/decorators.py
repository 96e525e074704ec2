"""Doors of functions and of frozen dataclasses, made from their annotations."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from dataclasses import MISSING as _NO_DEFAULT
from dataclasses import fields
from functools import cache, cached_property, partial, wraps
from inspect import Parameter, signature
from typing import Any, Self, TypeVar, cast

import numpy as np

from .annotations import Kind, Scope, kind_of

__all__ = ["FrozenModel", "call_user", "skip_validation", "validated"]

F = TypeVar("F", bound=Callable[..., Any])


def _declared(
    annotations: Mapping[str, Any], names: Mapping[str, Any]
) -> dict[str, Kind]:
    """The kinds of named annotations, arrays last: their shapes may speak of the others."""
    found: dict[str, Kind | None] = {}
    for name, annotation in annotations.items():
        with suppress(NameError):  # a name that only the type checker imports
            meant = (
                eval(annotation, dict(names))
                if isinstance(annotation, str)
                else annotation
            )
            found[name] = None if name == "return" else kind_of(meant)
    return _arrays_last(
        {name: kind for name, kind in found.items() if kind is not None}
    )


def _arrays_last(kinds: dict[str, Kind]) -> dict[str, Kind]:
    return dict(sorted(kinds.items(), key=lambda item: "an array" in item[1].needs))


class _Plan:
    """The kinds of a function's arguments, read when it is first called."""

    def __init__(self, function: Any) -> None:
        self.function = function

    @cached_property
    def kinds(self) -> dict[str, Kind]:
        """Of each argument that has one."""
        return _declared(self.function.__annotations__, self.function.__globals__)

    @cached_property
    def row(self) -> tuple[str, ...]:
        """The names of the arguments that may stand in a row."""
        known = signature(self.function).parameters.values()
        return tuple(p.name for p in known if p.kind <= Parameter.POSITIONAL_OR_KEYWORD)

    @cached_property
    def defaults(self) -> dict[str, Any]:
        """What stands for the arguments that are left out."""
        known = signature(self.function).parameters.values()
        return {p.name: p.default for p in known if p.default is not Parameter.empty}

    def validate(
        self, args: tuple[Any, ...], options: dict[str, Any]
    ) -> dict[str, Any]:
        """The arguments by name, converted, or the error for the first that does not fit."""
        given = dict(zip(self.row, args, strict=False)) | options
        if len(given) < len(args) + len(options):  # too many, or one of them twice
            signature(self.function).bind(*args, **options)
        scope = Scope(self.defaults | given)
        for name, kind in self.kinds.items():
            if name in given:
                given[name] = scope.values[name] = kind.check(given[name], name, scope)
        return given


_NESTED: ContextVar[bool] = ContextVar("nested", default=False)
"""Whether a validated function is running, so that those which it calls need no checks."""


def validated(function: F, *, call: Callable[..., Any] | None = None) -> F:
    """Let a function's annotations check its arguments.

    The checks are made once, at the outermost call: functions that a validated function calls get
    arguments that the library made. A function of the user's is called by :func:`call_user`, inside
    which arguments are checked again.

    Parameters
    ----------
    function : callable
        Its annotations are kinds as in the table of :mod:`distfilt.validation`. Defaults are not
        checked.
    call : callable, optional
        Called with the checked arguments in place of the function, by their names.

    Returns
    -------
    callable
        The same function with checks.

    Examples
    --------
    >>> from typing import Annotated
    >>> from distfilt.validation import Array, PositiveFloat
    >>> @validated
    ... def scale(x: Annotated[Array, "... d"], factor: PositiveFloat = 2.0) -> Array:
    ...     return factor * x
    >>> scale([1.0, 2.0])
    array([2., 4.])
    >>> scale([1.0, 2.0], factor=-1.0)
    Traceback (most recent call last):
    ValueError: factor must be positive, got -1.0
    """
    plan = _Plan(function)
    outermost = function if call is None else call

    @wraps(function)
    def wrapper(*args: Any, **options: Any) -> Any:
        if _NESTED.get():
            return function(*args, **options)
        given = plan.validate(args, options)
        token = _NESTED.set(True)
        try:
            return outermost(**given)
        finally:
            _NESTED.reset(token)

    wrapper.plan = plan  # type: ignore[attr-defined]
    return cast(F, wrapper)


@contextmanager
def skip_validation() -> Iterator[None]:
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
    token = _NESTED.set(True)
    try:
        yield
    finally:
        _NESTED.reset(token)


def call_user(function: Callable[..., Any], *args: Any, **options: Any) -> Any:
    """Call a function that the user may have written, inside which arguments are checked again.

    A function of the library's own is trusted and keeps its checks off.

    Examples
    --------
    >>> call_user(max, 1, 2)
    2
    """
    inner = function
    while isinstance(inner, partial):
        inner = inner.func
    if (getattr(inner, "__module__", None) or "").startswith("distfilt."):
        return function(*args, **options)
    token = _NESTED.set(False)
    try:
        return function(*args, **options)
    finally:
        _NESTED.reset(token)


class FrozenModel:
    """A base of frozen dataclasses: their fields' annotations are the door of the constructor.

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

    def __post_init__(self) -> None:
        cls: Any = type(self)
        scope = Scope(dict(vars(self)))
        for name, kind in _of_fields(cls).items():
            scope.values[name] = _kept(kind.check(scope.values[name], name, scope))
        # What its functions say of each other is compared when they first speak.
        vars(self).update(scope.values, _doubted=True)

    @classmethod
    def construct(cls, *args: Any, **options: Any) -> Self:
        """Build one from what the library made itself: nothing is checked or copied."""
        out, (names, factories) = object.__new__(cls), _names(cls)  # type: ignore[arg-type]
        (own := vars(out)).update(zip(names, args, strict=False), **options)
        for name, factory in factories:
            if name not in own:
                own[name] = factory()
        return out

    def replace(self, **changes: Any) -> Self:
        """The same with other values in some fields, unchecked."""
        known = {name: getattr(self, name) for name in _names(cast(Any, type(self)))[0]}
        return self.construct(**known | changes)


@cache
def _names(cls: Any) -> tuple[tuple[str, ...], tuple[tuple[str, Any], ...]]:
    """The fields, and what makes defaults; a plain default is an attribute of the class."""
    made = {f.name: f.default_factory for f in fields(cls)}
    factories = [(name, make) for name, make in made.items() if make is not _NO_DEFAULT]
    return tuple(made), tuple(factories)


@cache
def _of_fields(cls: Any) -> dict[str, Kind]:
    found: dict[str, Kind] = {}
    for base in reversed(cls.__mro__):
        own = vars(base).get("__annotations__", {}).items()
        own = {name: a for name, a in own if name in _names(cls)[0]}
        found |= _declared(own, vars(sys.modules.get(base.__module__, sys)))
    return _arrays_last(found)


def _kept(value: Any) -> Any:
    """Arrays as the record's own."""
    if isinstance(value, tuple) and type(value) is tuple:
        return tuple(_kept(v) for v in value)
    if not isinstance(value, np.ndarray):
        return value
    own = value.copy()
    own.setflags(write=False)
    return own
