"""What arrays, numbers and a user's functions must be: what is not is refused by its name."""

from __future__ import annotations

import contextlib
import importlib
import math
import operator
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg.lapack import dpotrf

__all__ = [
    "InvalidArgumentError",
    "Array",
    "Bounds",
    "all_finite",
    "check_array",
    "call_batched",
    "check_positive_definite",
    "check_distinct",
    "check_increasing",
    "import_optional",
    "check_positive_semidefinite",
    "check_probabilities",
]

Array = NDArray[np.float64]


class InvalidArgumentError(ValueError, TypeError):
    """An argument of a wrong type: both a ValueError and a TypeError.

    Examples
    --------
    >>> check_array("abc", "x")
    Traceback (most recent call last):
    distfilt.validation.InvalidArgumentError: x must be an array of real numbers, got str
    """


InvalidArgumentError.__module__ = "distfilt.validation"

_ROUNDING = 1e-9
"""Largest asymmetry and negative eigenvalue, in units of the variances, that count as rounding."""

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
"""What would turn into numbers inside a list or an array of objects."""


def check_array(
    value: ArrayLike,
    name: str,
    shape: tuple[Any, ...] | None = None,
    *,
    finite: bool = True,
) -> Array:
    """Return `value` as a float64 array of the wanted shape: for what a user's function returned.

    Parameters
    ----------
    value, name
        What came, and what the error calls it.
    shape : tuple, optional
        Sizes from left to right: an integer is exact, a text is a free size with a name for the
        error, and a leading ``...`` allows any leading axes.
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
    plain = type(value) is np.ndarray and value.dtype == np.float64
    out: Array = value if plain else _real(value, name)  # type: ignore[assignment]
    if shape is not None and out.shape != shape and not _fits(out.shape, shape, {}):
        raise ValueError(
            f"{name} must have shape {_shape_text(shape)}, got {out.shape}"
        )
    if finite and not all_finite(out):
        bad = int((~np.isfinite(out)).sum())
        raise ValueError(
            f"{name} must have finite numbers, got {bad} NaN or infinite of {out.size}"
        )
    return out


def all_finite(value: Array) -> bool:
    """Whether no number is NaN or infinite.

    >>> all_finite(np.array([1.0, -np.inf])), all_finite(np.array([1e200]))
    (False, True)
    """
    # A sum of squares says so in a fifth of the time, unless it overflows.
    return math.isfinite(np.vdot(value, value)) or bool(np.isfinite(value).all())


def _real(value: Any, name: str) -> Array:
    """Convert what holds real numbers and nothing else."""
    got = type(value).__name__
    try:
        parts = value if isinstance(value, list | tuple) else (value,)
        found = np.asarray(value)
        entries = found.ravel() if found.dtype.kind == "O" else ()
        got = next((type(v).__name__ for v in entries), got)
        odd = [v for v in (*parts, *entries) if isinstance(v, _NOT_REAL)]
        if not odd and found.dtype.kind in "fiuO":
            return np.asarray(found, dtype=np.float64)
        got = type(odd[0]).__name__ if odd else found.dtype.name
    except (TypeError, ValueError, OverflowError):
        pass
    raise InvalidArgumentError(
        f"{name} must be an array of real numbers, got {got}"
    ) from None


def _fits(got: tuple[int, ...], wanted: tuple[Any, ...], sizes: dict[str, int]) -> bool:
    """Whether a shape is what is wanted; if so the free words of `wanted` are among `sizes`."""
    left = list(got)
    for n in reversed(wanted):
        if n is ...:
            return True
        size = left.pop() if left else -1
        if isinstance(n, str) and (size > 0 or (size == 0 and n[0].isupper())):
            n = sizes.setdefault(n, size)
        if n != size:
            return False
    return not left


def _shape_text(shape: tuple[Any, ...]) -> str:
    sizes = ", ".join("..." if n is ... else str(n) for n in shape)
    return f"({sizes},)" if len(shape) == 1 else f"({sizes})"


def check_positive_definite(value: Array, name: str, word: str = "definite") -> None:
    """Refuse what is not a symmetric positive definite matrix, or a stack of them.

    Examples
    --------
    >>> check_positive_definite(np.array([[1.0, 2.0], [2.0, 1.0]]), "noise")
    Traceback (most recent call last):
    ValueError: noise must be a positive definite matrix, got smallest eigenvalue -1
    """
    if value.ndim < 2 or value.shape[-1] != value.shape[-2]:
        raise ValueError(f"{name} must be a square matrix, got shape {value.shape}")
    # As a rule the same bytes, which takes a fifth of a difference's time.
    if value.tobytes() != value.mT.tobytes():
        unit = _in_units(value)
        gap = np.abs(value - value.mT)
        worst = gap[np.abs(unit - unit.mT) > _ROUNDING].max(initial=0.0)
        if worst > 0:
            raise ValueError(
                f"{name} must be a symmetric matrix, got an asymmetry of {worst:.3g}"
            )
    with contextlib.suppress(np.linalg.LinAlgError):
        # The first takes a fifth of the other's time for one matrix.
        if value.ndim > 2 or not value.size or dpotrf(value, lower=1)[1]:
            np.linalg.cholesky(value)
        return
    # Without a factor; rounding alone may be why, unless it has to be definite.
    values = np.linalg.eigvalsh(_in_units(value))[..., 0]
    if word == "definite" or values.min() < -_ROUNDING:
        at = tuple(np.argwhere(values == values.min())[0].tolist())
        least = f"{np.linalg.eigvalsh(value[at])[0]:.6g}{f' at {[*at]}' * bool(at)}"
        raise ValueError(
            f"{name} must be a positive {word} matrix, got smallest eigenvalue {least}"
        )


def check_positive_semidefinite(value: Array, name: str) -> None:
    """Refuse what is not a symmetric matrix without negative eigenvalues, or a stack of them.

    Examples
    --------
    >>> check_positive_semidefinite(np.zeros((2, 2)), "noise")
    """
    check_positive_definite(value, name, "semidefinite")


def _in_units(cov: Array) -> Array:
    """Covariances in units of the components' standard deviations, as far as that matters."""
    std = np.sqrt(np.abs(np.diagonal(cov, axis1=-2, axis2=-1)))
    unit = np.where(std > 0, std, 1.0)
    with np.errstate(over="ignore"):
        return np.clip(cov / unit[..., :, None] / unit[..., None, :], -2.0, 2.0)


def check_probabilities(value: Array, name: str) -> None:
    """Refuse what is not nonnegative weights that sum to one along the last axis.

    Examples
    --------
    >>> check_probabilities(np.array([0.5, 0.6]), "weights")
    Traceback (most recent call last):
    ValueError: weights must sum to 1, got 1.1
    """
    if value.size and value.min() < 0:
        raise ValueError(f"{name} must be nonnegative weights, got {value.min():.6g}")
    total = np.ravel(value.sum(axis=-1))
    off = np.abs(total - 1)
    if off.max(initial=0.0) > 1e-9:  # far from zero, what is missing would move a mean
        raise ValueError(f"{name} must sum to 1, got {total[off.argmax()]:.9g}")


def check_increasing(value: Array, name: str) -> None:
    """Refuse what does not strictly increase.

    Examples
    --------
    >>> check_increasing(np.array([0.0, 0.2, 0.2]), "times")
    Traceback (most recent call last):
    ValueError: times must be strictly increasing, got 0.2 after 0.2
    """
    late = value[1:] <= value[:-1]
    if late.any():
        k = int(late.argmax())
        got = f"{value[k + 1]:g} after {value[k]:g}"
        raise ValueError(f"{name} must be strictly increasing, got {got}")


def check_distinct(value: Sequence[int], name: str) -> None:
    """Refuse an empty list of places, and one that names a place twice.

    Examples
    --------
    >>> check_distinct((2, 2), "local")
    Traceback (most recent call last):
    ValueError: local must have distinct integers, one or more, got [2, 2]
    """
    if not len(value) or len({*value}) < len(value):
        raise ValueError(
            f"{name} must have distinct integers, one or more, got {[*value]}"
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

    def __call__(self, value: Any, name: str) -> None:
        """Refuse a number, or an array with an entry, that is out of bounds."""
        for side, holds in _HOLDS.items():
            bound = getattr(self, side)
            if bound is None:
                continue
            good = holds(value, bound)
            if good is True or np.all(good):
                continue
            worst = value if np.ndim(value) == 0 else value[~good].flat[0]
            raise ValueError(
                f"{name} must be {_bound_text(side, bound)}, got {worst!r}"
            )


def _bound_text(side: str, bound: float) -> str:
    """A bound in words: "positive", "at least 1"."""
    if bound == 0 and side in ("above", "at_least"):
        return "positive" if side == "above" else "nonnegative"
    return f"{side.replace('_', ' ')} {bound:g}"


_HOLDS = {
    "above": operator.gt,
    "at_least": operator.ge,
    "below": operator.lt,
    "at_most": operator.le,
}


def import_optional(module: str, extra: str) -> ModuleType:
    """Import an optional package, or say which extra brings it.

    Raises
    ------
    ModuleNotFoundError
        If the package `module` is not installed. An error inside an installed one is passed on.

    Examples
    --------
    >>> import_optional("no_such_package", "maps")
    Traceback (most recent call last):
    ModuleNotFoundError: no_such_package is not installed; it comes with the extra maps: pip install 'distfilt[maps]'
    """
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        if error.name != module.partition(".")[0]:
            raise
        raise ModuleNotFoundError(
            f"{module} is not installed; it comes with the extra {extra}: pip install 'distfilt[{extra}]'",
            name=module,
        ) from None


def call_batched(owner: Any, name: str, states: Sequence[Array], *rest: float) -> Array:
    """What a function makes of states (..., d), as (..., ``owner.dim``); it gets copies.

    A function that was written for one state may return the right shape with wrong numbers. So the
    first rows that differ are compared with one of them alone, and so is the first only row.

    Parameters
    ----------
    owner, name
        Where the user's function is, and as what.
    states : sequence of ndarray, (..., d)
        Its first arguments.
    rest
        Its other arguments.

    Examples
    --------
    >>> from types import SimpleNamespace
    >>> x = np.array([[1.0, 2.0], [3.0, 4.0]])
    >>> call_batched(SimpleNamespace(dim=2, flow=lambda x: x[..., ::-1]), "flow", [x])
    array([[2., 1.],
           [4., 3.]])
    >>> one = SimpleNamespace(dim=2, flow=lambda x: np.array([x[1], x[0]]))
    >>> call_batched(one, "flow", [x])
    Traceback (most recent call last):
    ValueError: flow must take many states at once, ...
    >>> two = SimpleNamespace(dim=2, flow=lambda x: x + x[:, :1])
    >>> call_batched(two, "flow", [x])
    Traceback (most recent call last):
    ValueError: flow must take many states at once, ...
    >>> unit = SimpleNamespace(dim=2, flow=lambda x: x / np.linalg.norm(x))
    >>> call_batched(unit, "flow", [x[1:]])
    array([[0.6, 0.8]])
    >>> call_batched(unit, "flow", [x])
    Traceback (most recent call last):
    ValueError: flow must take many states at once, ...
    """
    function = getattr(owner, name)
    x = states[0]
    out = _made(function, states, rest)
    wanted = (*x.shape[:-1], owner.dim)
    fits = getattr(out, "shape", None) == wanted  # an error has none
    done = "_compared" if x.size > x.shape[-1] else "_compared_alone"
    if x.ndim > 1 and x.size and not (fits and done in vars(owner)):
        last = [s.reshape(-1, s.shape[-1])[-1] for s in states]
        alone = _made(function, last, rest)
        if fits:
            wrong = _differs(out.reshape(-1, owner.dim)[-1], alone, last)
        else:  # an error of its own comes from some states only, and not from one of them alone
            copies = [
                np.broadcast_to(one, s.shape)
                for one, s in zip(last, states, strict=True)
            ]
            many = _made(function, copies, rest)
            wrong = np.shape(alone) == wanted[-1:] and np.shape(many) != wanted
        if wrong:
            raise ValueError(
                f"{name} must take many states at once, (..., d), components "
                "last (x[..., 0], not x[0] or x[:, 0]), got one for other axes"
            )
        first = x.reshape(-1, x.shape[-1])[0]
        if fits and (first != (last[0] if done == "_compared" else first[-1])).any():
            vars(owner)[done] = True
    if fits:
        return np.asarray(out)
    if isinstance(out, IndexError):
        raise ValueError(f"x must have more components, got {x.shape}") from out
    if isinstance(out, Exception):
        raise out
    raise ValueError(
        f"{name} must return shape {wanted} for states {x.shape}, got {out.shape}"
    )


def _made(
    function: Callable[..., Any], states: Sequence[Array], rest: tuple[float, ...]
) -> Any:
    """What a function returns, or the error that it raises."""
    try:
        return np.asarray(
            function(*[s.copy() for s in states], *rest), dtype=np.float64
        )
    except (TypeError, ValueError, IndexError) as error:
        return error


def _differs(row: Array, alone: Any, states: Sequence[Array]) -> bool:
    if np.shape(alone) != row.shape:
        return isinstance(alone, IndexError)  # it wants two axes, and may get three
    # Rules of adaptive step differ a little; wrong rows differ as much as the states move.
    moved = alone - states[0] if alone.shape == states[0].shape else alone
    bound = 1e-2 * np.abs(moved).max() + 1e-9 * np.abs(alone).max()
    return bool(
        (np.isnan(row) != np.isnan(alone)).any() or (np.abs(row - alone) > bound).any()
    )
