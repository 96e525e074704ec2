"""Checks of a user's functions that are made once, when their owner is first used.

A model's derivative can only be compared with the model at a state, so the comparison waits until
there is one. Which comparisons have been made is recorded here, so that the owner stays unchanged.
"""

from __future__ import annotations

import weakref
from typing import Protocol

__all__ = ["is_first_use", "mark_checked", "needs_check"]


class HasValidation(Protocol):
    """An object that knows whether its constructor checked it, such as a frozen dataclass."""

    @property
    def is_validated(self) -> bool: ...


# Names of the checks that have been made, by the owner's id, as long as the owner lives.
_CHECKED: dict[int, set[str]] = {}


def needs_check(owner: object, check: str) -> bool:
    """Whether a check of an owner's functions has not been made yet.

    Parameters
    ----------
    owner : object
        A frozen dataclass, such as a model or a sensor.
    check : str
        Name of the check.

    Examples
    --------
    >>> from distfilt.models import constant_velocity
    >>> model = constant_velocity(sigma=0.1)
    >>> needs_check(model, "example")
    True
    >>> mark_checked(model, "example")
    >>> needs_check(model, "example")
    False
    """
    return check not in _CHECKED.get(id(owner), ())


def mark_checked(owner: object, check: str) -> None:
    """Record that a check of an owner's functions has been made.

    The arguments are those of :func:`needs_check`.
    """
    key = id(owner)
    if key not in _CHECKED:
        _CHECKED[key] = set()
        # When the owner is deleted, so is its entry: its id may become that of another object.
        finalizer = weakref.finalize(owner, _CHECKED.pop, key, None)
        # At the interpreter's end there is nothing to tidy up.
        finalizer.atexit = False
    _CHECKED[key].add(check)


def is_first_use(owner: HasValidation, function: str) -> bool:
    """Whether one of an owner's functions is used for the first time; true once.

    Never of an owner that the library constructed without validation: its functions are trusted.

    Examples
    --------
    >>> from distfilt.models import constant_velocity
    >>> model = constant_velocity(sigma=0.1)
    >>> is_first_use(model, "example"), is_first_use(model, "example")
    (True, False)
    >>> is_first_use(model.replace(), "example")
    False
    """
    if not owner.is_validated or not needs_check(owner, function):
        return False
    mark_checked(owner, function)
    return True
