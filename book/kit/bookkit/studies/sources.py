"""Which code made a study: a digest of a function's source that a reader can compute again."""

from __future__ import annotations

import hashlib
import inspect
import textwrap
from collections.abc import Callable, Iterable
from functools import partial
from typing import Any

from distfilt.checks import callable_

__all__ = ["fingerprint"]


def _plain(function: Any) -> Any:
    """The function or class whose source says what a callable does."""
    while isinstance(function, partial):
        function = function.func
    function = inspect.unwrap(function)
    has_source = inspect.isfunction(function) or inspect.ismethod(function)
    return function if has_source or inspect.isclass(function) else type(function)


def fingerprint(function: Callable[..., Any]) -> str:
    """A digest of a function's source: the first 16 digits of its SHA-256.

    The text is that of ``inspect.getsource`` without its indentation. It changes with any edit of
    the function, comments included, and not with an edit of what the function calls: it tells a
    reader whether a stored study was made by the function that is printed, and running trials
    again (`check`) tells whether everything below still gives the same numbers.

    Parameters
    ----------
    function : callable
        A function, a method, a class, a partial (its function) or an object that can be called
        (its class), with its source at hand.

    Examples
    --------
    >>> from distfilt.sensors import wrap
    >>> len(fingerprint(wrap)), fingerprint(wrap) == fingerprint(wrap)
    (16, True)
    """
    plain = _plain(callable_(function, "function"))
    try:
        source = textwrap.dedent(inspect.getsource(plain)).strip()
    except (OSError, TypeError):
        raise ValueError(
            f"function: needs one whose source is at hand, got {name_of(function)}"
        ) from None
    return hashlib.sha256(source.encode()).hexdigest()[:16]


def name_of(function: Any) -> str:
    """The name under which a function's fingerprint is kept."""
    return str(getattr(_plain(function), "__qualname__", type(function).__name__))


def fingerprints(functions: Iterable[Callable[..., Any]], *, strict: bool) -> dict[str, str]:
    """The fingerprints by name; without `strict` a function without a source is left out."""
    out = {}
    for function in functions:
        try:
            out[name_of(function)] = fingerprint(function)
        except ValueError:
            if strict:
                raise
    return out
