"""A base class of frozen dataclasses whose constructor checks its arguments."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import MISSING, fields
from functools import cache
from inspect import get_annotations
from typing import Any, ClassVar, Self

import numpy as np

from .annotations import ArgumentConstraint, CallContext
from .resolving import make_constraints, sort_arrays_last

__all__ = ["FrozenModel", "field_constraints"]


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

    is_validated: ClassVar[bool] = False
    """Whether the constructor checked this instance; not if the library constructed it."""

    def __post_init__(self) -> None:
        cls: Any = type(self)
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
        dataclass: Any = cls
        names, factories = _fields(dataclass)
        values = vars(instance)
        values.update(zip(names, args, strict=False), **options)
        for name, factory in factories:
            if name not in values:
                values[name] = factory()
        return instance

    def replace(self, **changes: object) -> Self:
        """Return a copy with other values in some fields, unchecked."""
        cls: Any = type(self)
        names, _ = _fields(cls)
        values = {name: getattr(self, name) for name in names}
        return self.construct(**values | changes)


@cache
def _fields(
    cls: Any,
) -> tuple[tuple[str, ...], tuple[tuple[str, Callable[[], object]], ...]]:
    """Return the names of a dataclass's fields, and the factories of defaults by name.

    A default that is no factory is an attribute of the class, so that instances need none.
    """
    names = []
    factories = []
    for item in fields(cls):
        names.append(item.name)
        if item.default_factory is not MISSING:
            factories.append((item.name, item.default_factory))
    return tuple(names), tuple(factories)


@cache
def field_constraints(cls: Any) -> dict[str, ArgumentConstraint]:
    """Return the constraints of a dataclass's fields, inherited ones included, arrays last."""
    names, _ = _fields(cls)
    constraints: dict[str, ArgumentConstraint] = {}
    # Base classes first, so that a subclass may narrow the annotation of a field.
    for base in reversed(cls.__mro__):
        annotations = get_annotations(base)
        declared = {name: annotations[name] for name in annotations if name in names}
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
