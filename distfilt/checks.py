"""Checks of what callers pass in: each error names the argument, what came and what is needed.

Every function returns its input as a plain float64 array (or the plain Python value) and never
changes it. Nothing is repaired: a covariance that is not symmetric is refused, not symmetrised.
"""

from __future__ import annotations

import contextlib
import importlib
import operator
from collections.abc import Callable, Collection
from types import ModuleType
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg.lapack import dpotrf

from .linalg import SolverError

__all__ = [  # fmt: skip
    "Array", "SolverError", "array", "callable_", "choice", "count", "covariance", "flags",
    "generator", "increasing", "instance", "needed", "nonblank", "number", "places", "same_length",
    "weights",
]

Array = NDArray[np.float64]
_T = TypeVar("_T")

_ROUNDING = 1e-9
"""Largest asymmetry and negative eigenvalue, in units of the variances, that count as rounding."""

_FLOAT = np.dtype(np.float64)
_KINDS = {"b": "booleans", "c": "complex numbers", "M": "dates", "m": "time differences"}
_KINDS |= {"S": "text", "U": "text", "V": "records"}
"""What an array holds that is not real numbers, by the letter of its type."""
_NOT_REAL = (bool, np.bool_, complex, np.complexfloating, str, bytes, np.datetime64, np.timedelta64,
             type(None), np.ma.MaskedArray)  # fmt: skip
"""What would turn into numbers inside a list or an array of objects."""


def array(
    value: ArrayLike, name: str, shape: tuple[Any, ...] | None = None, *, finite: bool = True
) -> Array:
    """Return `value` as a float64 array of the wanted shape.

    Parameters
    ----------
    value, name
        What the caller passed, and the argument's name for the error.
    shape : tuple, optional
        Sizes from left to right: an integer is exact, a string is a free size with a name for
        the error, and a leading ``...`` allows any leading axes.
    finite : bool
        Refuse NaN and infinity.

    Raises
    ------
    ValueError
        If the value is not made of real numbers (masked arrays, dates, complex numbers, booleans
        and text are refused, not converted), has another shape, or holds NaN or infinity.

    >>> array([[1, 2], [3, 4]], "ensemble", (..., "N", 2)).shape
    (2, 2)
    >>> array([1.0, np.nan], "mean", (2,))
    Traceback (most recent call last):
    ValueError: mean: needs finite numbers, got 1 NaN or infinite of 2
    >>> array(["1.0"], "mean", (1,))
    Traceback (most recent call last):
    ValueError: mean: needs an array of real numbers, got text
    """
    plain = type(value) is np.ndarray and value.dtype is _FLOAT
    out: Array = value if plain else _real(value, name)  # type: ignore[assignment]
    if shape is not None and not _fits(out.shape, shape):
        raise ValueError(f"{name}: needs shape {_shape_text(shape)}, got {out.shape}")
    if finite and not np.isfinite(out).all():
        bad = int((~np.isfinite(out)).sum())
        raise ValueError(f"{name}: needs finite numbers, got {bad} NaN or infinite of {out.size}")
    return out


def _real(value: Any, name: str) -> Array:
    """Convert what holds real numbers and nothing else."""
    got = type(value).__name__
    try:
        parts = value if isinstance(value, list | tuple) else (value,)
        found = np.asarray(value)
        entries = found.ravel() if found.dtype.kind == "O" else ()
        odd = [v for v in (*parts, *entries) if isinstance(v, _NOT_REAL)]
        kind = np.asarray(odd[0]).dtype.kind if odd else found.dtype.kind
        if not odd and kind not in _KINDS:
            return np.asarray(found, dtype=np.float64)
        masked = odd and isinstance(odd[0], np.ma.MaskedArray)
        got = "a masked array" if masked else _KINDS.get(kind, "None")
    except (TypeError, ValueError, OverflowError):
        pass
    raise ValueError(f"{name}: needs an array of real numbers, got {got}") from None


def _fits(got: tuple[int, ...], needed: tuple[Any, ...]) -> bool:
    free = bool(needed) and needed[0] is ...
    tail = needed[1:] if free else needed
    if len(got) < len(tail) if free else len(got) != len(tail):
        return False
    pairs = zip(reversed(tail), reversed(got), strict=False)
    return all([n == g or isinstance(n, str) for n, g in pairs])


def _shape_text(shape: tuple[Any, ...]) -> str:
    sizes = ", ".join("..." if n is ... else str(n) for n in shape)
    return f"({sizes},)" if len(shape) == 1 else f"({sizes})"


def covariance(
    value: ArrayLike, name: str, dim: int | None = None, *, semidefinite: bool = False
) -> Array:
    """Return `value` as a symmetric positive definite matrix, or a stack of them.

    Parameters
    ----------
    value, name : array_like, (..., d, d)
        What the caller passed, and the argument's name for the error.
    dim : int, optional
        The size d that is needed.
    semidefinite : bool
        Also accept singular matrices (a process noise that drives only some components).

    >>> covariance([[1.0, 2.0], [2.0, 1.0]], "noise")
    Traceback (most recent call last):
    ValueError: noise: needs a positive definite matrix, got smallest eigenvalue -1
    """
    size: Any = "d" if dim is None else dim
    out = array(value, name, (..., size, size))
    if out.shape[-1] != out.shape[-2]:
        raise ValueError(f"{name}: needs a square matrix, got shape {out.shape}")
    turned = out.swapaxes(-1, -2)
    if not (out == turned).all():
        gap = np.abs(out - turned)
        worst = np.where(gap > _ROUNDING * _units(out), gap, 0.0).max()
        if worst > 0:
            raise ValueError(f"{name}: needs a symmetric matrix, got an asymmetry of {worst:.3g}")
    if not _definite(out):
        _why_not_definite(out, name, semidefinite)
    return out


def _definite(out: Array) -> bool:
    if out.ndim == 2 and out.size:
        return bool(dpotrf(out, lower=1, clean=0)[1] == 0)  # a fifth of numpy's time
    with contextlib.suppress(np.linalg.LinAlgError):
        return np.linalg.cholesky(out) is not None
    return False


def _units(cov: Array) -> Array:
    """Products of the components' standard deviations, the scale of each entry."""
    std = np.sqrt(np.maximum(np.diagonal(cov, axis1=-2, axis2=-1), 0.0))
    return np.asarray(std[..., :, None] * std[..., None, :])


def _why_not_definite(cov: Array, name: str, semidefinite: bool) -> None:
    """Refuse a matrix, of those of which one has no Cholesky factor, that is not a covariance."""
    needs = f"{name}: needs a positive {'semi' if semidefinite else ''}definite matrix, got"
    variances = np.diagonal(cov, axis1=-2, axis2=-1)
    if variances.min() < 0:
        at = np.argwhere(variances == variances.min())[0, :-1].tolist()
        raise ValueError(f"{needs} a variance of {variances.min():.6g}{f' at {at}' * bool(at)}")
    scale = _units(cov)
    scaled = np.divide(cov, scale, out=np.where(cov == 0, 0.0, np.inf), where=scale > 0)
    if np.isinf(scaled).any():
        raise ValueError(f"{needs} a covariance with a component of variance 0")
    least = np.linalg.eigvalsh(scaled)[..., 0]
    if semidefinite and least.min() >= -_ROUNDING:
        return
    at = np.argwhere(least == least.min())[0].tolist()
    smallest = float(np.linalg.eigvalsh(cov[tuple(at)])[0])
    raise ValueError(f"{needs} smallest eigenvalue {smallest:.6g}{f' at {at}' * bool(at)}")


def flags(value: Any, name: str, shape: tuple[Any, ...] | None = None) -> NDArray[np.bool_]:
    """Return `value` as an array of booleans of the wanted shape; numbers are refused.

    >>> flags([True, False], "here", ("S",))
    array([ True, False])
    >>> flags([1, 0], "here")
    Traceback (most recent call last):
    ValueError: here: needs an array of True and False, got int64
    """
    out = np.asarray(value)
    if out.dtype != np.bool_ or isinstance(value, np.ma.MaskedArray):
        got = type(value).__name__ if out.dtype == np.bool_ else out.dtype
        raise ValueError(f"{name}: needs an array of True and False, got {got}")
    if shape is not None and not _fits(out.shape, shape):
        raise ValueError(f"{name}: needs shape {_shape_text(shape)}, got {out.shape}")
    return out


def weights(value: ArrayLike, name: str, size: int | None = None) -> Array:
    """Return `value` as nonnegative weights that sum to one along the last axis.

    >>> weights([0.5, 0.6], "weights")
    Traceback (most recent call last):
    ValueError: weights: needs a sum of 1, got 1.1
    """
    out = array(value, name, (..., "N" if size is None else size))
    if out.size and out.min() < 0:
        raise ValueError(f"{name}: needs nonnegative weights, got {out.min():.6g}")
    total = np.ravel(out.sum(axis=-1))
    off = np.abs(total - 1)
    if off.max(initial=0.0) > 1e-8:
        raise ValueError(f"{name}: needs a sum of 1, got {total[off.argmax()]:.6g}")
    return out


def number(
    value: Any, name: str, *, above: float | None = None, at_least: float | None = None,
    below: float | None = None, at_most: float | None = None,
) -> float:
    """Return `value` as a finite float inside the given bounds.

    >>> number(-0.2, "sigma", at_least=0)
    Traceback (most recent call last):
    ValueError: sigma: needs a number at least 0, got -0.2
    """
    needs = "a finite number"
    try:
        out = float(value if type(value) in (float, int) else _real(value, name)[()])
    except (TypeError, ValueError, OverflowError):
        raise ValueError(f"{name}: needs {needs}, got {value!r}") from None
    good = bool(np.isfinite(out)) and np.ndim(value) == 0
    for bound, word, holds in (
        (above, "above", operator.gt),
        (at_least, "at least", operator.ge),
        (below, "below", operator.lt),
        (at_most, "at most", operator.le),
    ):
        if bound is not None and not holds(out, bound):
            needs, good = f"a number {word} {bound:g}", False
    if not good:
        raise ValueError(f"{name}: needs {needs}, got {value!r}")
    return out


def count(value: Any, name: str, *, at_least: int = 1) -> int:
    """Return `value` as an integer of at least `at_least`.

    >>> count(1.5, "members")
    Traceback (most recent call last):
    ValueError: members: needs an integer of at least 1, got 1.5
    """
    integral = isinstance(value, int | np.integer)
    if not integral or isinstance(value, bool | np.timedelta64) or value < at_least:
        raise ValueError(f"{name}: needs an integer of at least {at_least}, got {value!r}")
    return int(value)


def places(value: Any, name: str, size: int | None = None) -> tuple[int, ...]:
    """Return `value` as distinct integers, one or more, from 0 on and below `size`.

    >>> places([2, 0], "local", size=3)
    (2, 0)
    >>> places([2, 3], "local", size=3)
    Traceback (most recent call last):
    ValueError: local: needs distinct integers below 3, got [2, 3]
    """
    if not np.iterable(value):
        raise ValueError(f"{name}: needs a list of integers, got {value!r}")
    found = [count(i, name, at_least=0) for i in value]
    if not found or len(set(found)) < len(found) or (size is not None and max(found) >= size):
        below = "" if size is None else f" below {size}"
        raise ValueError(f"{name}: needs distinct integers{below}, got {found}")
    return tuple(found)


def choice(value: Any, name: str, options: Collection[str]) -> str:
    """Return `value` if it is one of the options.

    >>> choice("svd", "solver", ("ECOS", "CLARABEL"))
    Traceback (most recent call last):
    ValueError: solver: needs one of ECOS, CLARABEL, got 'svd'
    """
    if not isinstance(value, str) or value not in options:
        raise ValueError(f"{name}: needs one of {', '.join(options)}, got {value!r}")
    return str(value)


def generator(value: Any, name: str = "rng") -> np.random.Generator:
    """Return `value` if it is a numpy random generator; integers and None are refused.

    >>> generator(7)
    Traceback (most recent call last):
    ValueError: rng: needs a numpy.random.Generator (np.random.default_rng(seed)), got int
    """
    if not isinstance(value, np.random.Generator):
        needs = "a numpy.random.Generator (np.random.default_rng(seed))"
        raise ValueError(f"{name}: needs {needs}, got {type(value).__name__}")
    return value


def callable_(value: Any, name: str) -> Callable[..., Any]:
    """Return `value` if it can be called.

    >>> callable_(3, "step")
    Traceback (most recent call last):
    ValueError: step: needs a function, got int
    """
    if not callable(value):
        raise ValueError(f"{name}: needs a function, got {type(value).__name__}")
    return value  # type: ignore[no-any-return]


def nonblank(value: Any, name: str) -> str:
    """Return `value` if it is a text that is not blank.

    >>> nonblank(" ", "label")
    Traceback (most recent call last):
    ValueError: label: needs a text, got ' '
    """
    if not isinstance(value, str) or not value.strip():
        raise ValueError(f"{name}: needs a text, got {value!r}")
    return value


def increasing(value: ArrayLike, name: str) -> Array:
    """Return `value` as a strictly increasing vector of times.

    >>> increasing([0.0, 0.2, 0.2], "times")
    Traceback (most recent call last):
    ValueError: times: needs strictly increasing values, got 0.2 after 0.2
    """
    out = array(value, name, ("T",))
    late = out[1:] <= out[:-1]
    if late.any():
        k = int(late.argmax())
        got = f"{out[k + 1]:g} after {out[k]:g}"
        raise ValueError(f"{name}: needs strictly increasing values, got {got}")
    return out


def same_length(a: Collection[Any], b: Collection[Any], name_a: str, name_b: str) -> None:
    """Refuse two collections of different length.

    >>> same_length([1, 2], [1], "sensors", "agents")
    Traceback (most recent call last):
    ValueError: sensors: needs as many entries as agents (1), got 2
    """
    instance(a, name_a, Collection)  # type: ignore[type-abstract]
    instance(b, name_b, Collection)  # type: ignore[type-abstract]
    if len(a) != len(b):
        raise ValueError(f"{name_a}: needs as many entries as {name_b} ({len(b)}), got {len(a)}")


def instance(value: Any, name: str, kind: type[_T]) -> _T:
    """Return `value` if it is of the wanted class.

    >>> instance(3, "rng", np.random.Generator)
    Traceback (most recent call last):
    ValueError: rng: needs a Generator, got int
    """
    if not isinstance(value, kind):
        article = "an" if kind.__name__[0] in "AEIOU" else "a"
        raise ValueError(f"{name}: needs {article} {kind.__name__}, got {type(value).__name__}")
    return value


def needed(module: str, extra: str) -> ModuleType:
    """Import an optional package, or say which extra brings it.

    Raises
    ------
    ModuleNotFoundError
        If the package `module` is not installed. An error inside an installed one is passed on.

    >>> needed("math", "maps").sqrt(4.0)
    2.0
    >>> needed("no_such_solver", "maps")
    Traceback (most recent call last):
    ModuleNotFoundError: no_such_solver: needs the extra maps: pip install 'distfilt[maps]'
    """
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        if error.name is None or not f"{module}.".startswith(f"{error.name}."):
            raise
        raise ModuleNotFoundError(
            f"{module}: needs the extra {extra}: pip install 'distfilt[{extra}]'", name=module
        ) from None
