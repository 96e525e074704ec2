"""What an annotation declares: how a value is converted, by which rules, and what is refused."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, partial
from itertools import chain
from types import UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

import numpy as np
from numpy.typing import ArrayLike

from .checks import InvalidArgumentError, _fits, _shape_text, check_array

__all__ = ["ALLOW_NAN", "Kind", "Scope", "kind_of"]

ALLOW_NAN = "missing allowed"
"""Beside an array's shape: NaN may stand for what is missing; infinity may not."""


@dataclass(slots=True)
class Scope:
    """The arguments of one call by name, and the sizes that their shapes have bound."""

    values: dict[str, Any]
    sizes: dict[str, int] = field(default_factory=dict)

    def fits(
        self, got: tuple[int, ...], words: tuple[Any, ...], heads: frozenset[str]
    ) -> bool:
        """Whether a shape is what its words say; if so it binds those that were free."""
        wanted = words if heads.isdisjoint(self.values) else self.shape(words)
        if fits := _fits(got, wanted, sizes := self.sizes.copy()):
            self.sizes = sizes
        return fits

    def shape(self, words: Sequence[Any]) -> tuple[Any, ...]:
        """A shape as far as it is known."""
        known = [self._size(word) if isinstance(word, str) else word for word in words]
        return tuple(
            chain.from_iterable(n if type(n) is tuple else (n,) for n in known)
        )

    def _size(self, word: str) -> Any:
        """What a word stands for: a size, sizes, or itself while it is free."""
        if word in self.sizes:
            return self.sizes[word]
        head, *path = word.lstrip("*").split(".")
        found = self.values.get(head)
        for part in path:
            found = getattr(found, part, None)
        return found if isinstance(found, (int, np.integer, tuple)) else word


@cache
@dataclass(frozen=True)
class Kind:
    """What an argument may be: what it needs in words, its conversion, and rules for the result."""

    needs: str
    convert: Callable[[Any, str, Scope], Any]
    rules: tuple[Callable[[Any, str], None], ...] = ()

    def check(self, value: Any, name: str, scope: Scope) -> Any:
        """The value as the function gets it, or an error that names it."""
        try:
            out = self.convert(value, name, scope)
        except InvalidArgumentError:
            raise  # an entry of it has named the argument already
        except TypeError:
            got = (
                repr(value)
                if isinstance(value, str | int | float)
                else type(value).__name__
            )
            raise InvalidArgumentError(
                f"{name} must be {self.needs}, got {got}"
            ) from None
        for rule in self.rules:
            rule(out, name)
        return out


def _number(value: Any, name: str, scope: Scope) -> float:
    try:  # a TypeError for an array
        out = float(
            value
            if type(value) in (float, int, np.float64)
            else check_array(value, name, ())
        )
    except ValueError:
        raise TypeError from None
    if not math.isfinite(out):
        raise TypeError
    return out


def _integer(value: Any, name: str, scope: Scope) -> int:
    if not isinstance(value, int | np.integer) or isinstance(
        value, bool | np.timedelta64
    ):
        raise TypeError
    return int(value)


def _instance(cls: Any, value: Any, name: str, scope: Scope) -> Any:
    if not isinstance(value, cls) or (cls is str and not value.strip()):
        raise TypeError
    return value


def _callable(value: Any, name: str, scope: Scope) -> Any:
    if not callable(value):
        raise TypeError
    plan = getattr(value.func, "plan", None) if isinstance(value, partial) else None
    if plan is None:
        return value
    # Inner calls are not checked, so the options that a partial holds are looked at here.
    return partial(value.func, *value.args, **plan.validate((), value.keywords))


def _one_of(options: tuple[Any, ...], value: Any, name: str, scope: Scope) -> Any:
    if not any(type(value) is type(option) and value == option for option in options):
        raise TypeError
    return value


def _numbers(
    dtype: type,
    words: tuple[Any, ...] | None,
    heads: frozenset[str],
    missing: bool,
    value: Any,
    name: str,
    scope: Scope,
) -> Any:
    if dtype is np.float64:
        out: Any = check_array(value, name, finite=not missing)
        if missing and np.isinf(out).any():
            raise ValueError(
                f"{name} must have finite numbers or NaN (missing), got infinity"
            )
    else:
        out = np.asarray(value)
        kinds = "b" if dtype is np.bool_ else "iu"
        if out.dtype.kind not in kinds or isinstance(value, np.ma.MaskedArray):
            raise TypeError
    if words is not None and not scope.fits(out.shape, words, heads):
        raise ValueError(
            f"{name} must have shape {_shape_text(scope.shape(words))}, got {out.shape}"
        )
    return out


def _many(
    kinds: tuple[Kind | None, ...], fixed: bool, value: Any, name: str, scope: Scope
) -> tuple[Any, ...]:
    if isinstance(value, str | bytes | Mapping) or not np.iterable(value):
        raise TypeError
    items = tuple(value)
    each = kinds if fixed else kinds * len(items)
    if len(each) != len(items):
        raise ValueError(f"{name} must have {len(each)} entries, got {len(items)}")
    pairs = zip(each, items, strict=True)
    return tuple(
        [kind.check(item, name, scope) if kind else item for kind, item in pairs]
    )


def _either(
    kinds: tuple[Any, ...], optional: bool, value: Any, name: str, scope: Scope
) -> Any:
    if value is None and optional:
        return None
    for kind in kinds:
        try:
            return kind.check(value, name, scope)
        except ValueError as error:
            # A number that is out of bounds is nothing else.
            plain = type(value) in (int, float) and kind.convert in (_number, _integer)
            if len(kinds) == 1 or (plain and kind.needs not in str(error)):
                raise
    raise TypeError


_PLAIN = {
    float: Kind("a finite number", _number),
    int: Kind("an integer", _integer),
    str: Kind("a text", partial(_instance, str)),
    bool: Kind("a bool, True or False", partial(_instance, bool)),
    Callable: Kind("a function", _callable),
    np.random.Generator: Kind(
        "a numpy.random.Generator (np.random.default_rng(seed))",
        partial(_instance, np.random.Generator),
    ),
}
_SEQUENCES = (Sequence, Collection, Iterable, tuple, list)


@cache
def kind_of(annotation: Any) -> Kind | None:
    """The kind that an annotation declares; None lets everything pass.

    Examples
    --------
    >>> from distfilt.validation import PositiveInt
    >>> kind_of(PositiveInt).check(0, "members", Scope({}))
    Traceback (most recent call last):
    ValueError: members must be at least 1, got 0
    """
    if annotation is Any or annotation == ArrayLike:
        return None
    annotation = _meant(annotation)
    origin = get_origin(annotation)
    args = get_args(annotation)
    if origin is Annotated:
        return _noted(args[0], args[1:])
    if origin in (Union, UnionType):
        return _union(args)
    if origin is Literal:
        return Kind(f"one of {', '.join(map(str, args))}", partial(_one_of, args))
    if origin is np.ndarray:
        return _array_of(annotation)
    if origin is tuple and args[-1] is not ...:
        kinds = tuple(kind_of(a) for a in args)
        return Kind(_words(kinds, ", "), partial(_many, kinds, True))
    if origin in _SEQUENCES:
        kinds = (kind_of(args[0]),)
        return Kind(
            f"a list, of {_words(kinds, '')} each", partial(_many, kinds, False)
        )
    found = origin or annotation
    if found in _PLAIN or not isinstance(found, type):
        return _PLAIN.get(found)
    article = "an" if found.__name__[0] in "AEIOU" else "a"
    return Kind(f"{article} {found.__name__}", partial(_instance, found))


def _words(kinds: tuple[Kind | None, ...], between: str) -> str:
    return between.join(kind.needs if kind else "anything" for kind in kinds)


def _union(args: tuple[Any, ...]) -> Kind | None:
    """What fits one of several annotations, the first that does."""
    kinds = tuple(kind_of(a) for a in args if a is not type(None))
    if None in kinds:
        return None
    return Kind(_words(kinds, " or "), partial(_either, kinds, type(None) in args))


def _meant(annotation: Any) -> Any:
    """What a ``type`` alias stands for, as numpy's NDArray is one since 2.5; others as they are."""
    args = get_args(annotation)
    value = getattr(get_origin(annotation) or annotation, "__value__", None)
    return annotation if value is None else _meant(value[args] if args else value)


def _noted(base: Any, notes: tuple[Any, ...]) -> Kind | None:
    """A type with a shape and rules beside it; the last shape counts, so that aliases can vary."""
    shapes = [
        note.split() for note in notes if isinstance(note, str) and note != ALLOW_NAN
    ]
    base = _meant(base)
    if get_origin(base) is np.ndarray:
        kind: Kind | None = _array_of(
            base, shapes[-1] if shapes else None, ALLOW_NAN in notes
        )
    else:
        kind = kind_of(base)
    rules: Any = filter(callable, notes)
    return kind and replace(kind, rules=(*kind.rules, *rules))


def _array_of(
    base: Any, words: Sequence[str] | None = None, missing: bool = False
) -> Kind:
    dtype = get_args(get_args(base)[1])[0]
    what = {np.float64: "real numbers", np.bool_: "True and False"}.get(
        dtype, "integers"
    )
    shape = "" if words is None else f" of shape ({', '.join(words)})"
    known: Any = words and tuple(
        [int(w) if w.isdigit() else {"...": ...}.get(w, w) for w in words]
    )
    # What a word may stand for: an argument, or what one has.
    heads = frozenset(word.lstrip("*").split(".")[0] for word in words or ())
    return Kind(
        f"an array of {what}{shape}", partial(_numbers, dtype, known, heads, missing)
    )
