"""Doors of functions and of frozen dataclasses, made from their annotations."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import MISSING as _NO_DEFAULT
from dataclasses import fields
from functools import cache, cached_property, partial, wraps
from inspect import Parameter, signature
from types import MethodType
from typing import Any, Self, TypeVar, cast

import numpy as np

from .annotations import Kind, Scope, kind_of

__all__ = ["FrozenModel", "validated", "unchecked"]

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

    def taken(self, args: tuple[Any, ...], options: dict[str, Any]) -> dict[str, Any]:
        """The arguments by name, converted, or the error for the first that does not fit."""
        given = dict(zip(self.row, args, strict=False)) | options
        if len(given) < len(args) + len(options):  # too many, or one of them twice
            signature(self.function).bind(*args, **options)
        scope = Scope(self.defaults | given)
        for name, kind in self.kinds.items():
            if name in given:
                given[name] = scope.values[name] = kind.take(given[name], name, scope)
        return given


def validated(function: F) -> F:
    """Let a function's annotations check what it is given.

    Parameters
    ----------
    function : callable
        Its annotations are kinds as in the table of :mod:`distfilt.validation`. Defaults are not
        checked.

    Returns
    -------
    callable
        The same with a door; :func:`unchecked` gives the function back.

    Examples
    --------
    >>> from typing import Annotated
    >>> from distfilt.validation import Array, PositiveFloat
    >>> @validated
    ... def scaled(x: Annotated[Array, "... d"], factor: PositiveFloat = 2.0) -> Array:
    ...     return factor * x
    >>> scaled([1.0, 2.0])
    array([2., 4.])
    >>> scaled([1.0, 2.0], factor=-1.0)
    Traceback (most recent call last):
    ValueError: factor: needs a number above 0, got -1.0
    """
    plan = _Plan(function)

    @wraps(function)
    def checked(*args: Any, **options: Any) -> Any:
        return function(**plan.taken(args, options))

    checked.unchecked = function  # type: ignore[attr-defined]
    checked.plan = plan  # type: ignore[attr-defined]
    return cast(F, checked)


def unchecked(function: F) -> F:
    """The function, or the bound method, without its door; options of a partial stay.

    Examples
    --------
    >>> unchecked(print) is print
    True
    """
    given: Any = function
    inner = getattr(given, "unchecked", None)  # a method has what its function has
    if inner is not None:
        given = (
            MethodType(inner, given.__self__) if type(given) is MethodType else inner
        )
    elif isinstance(given, partial):
        given = partial(unchecked(given.func), *given.args, **given.keywords)
    return given  # type: ignore[no-any-return]


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
    ValueError: size: needs an integer, got 1.5
    """

    def __post_init__(self) -> None:
        cls: Any = type(self)
        scope = Scope(dict(vars(self)))
        for name, kind in _of_fields(cls).items():
            scope.values[name] = _kept(kind.take(scope.values[name], name, scope))
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
