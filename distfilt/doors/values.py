"""What arrays and numbers must be: each rule refuses by an error that names the argument."""

from __future__ import annotations

import contextlib
import importlib
import operator
from collections.abc import Sequence
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg.lapack import dpotrf

__all__ = [  # fmt: skip
    "Array", "Bounds", "array", "definite", "distinct", "increasing", "needed", "semidefinite",
    "summing_to_one",
]

Array = NDArray[np.float64]

_ROUNDING = 1e-9
"""Largest asymmetry and negative eigenvalue, in units of the variances, that count as rounding."""

_NOT_REAL = (bool, np.bool_, complex, np.complexfloating, str, bytes, np.datetime64, np.timedelta64,
             type(None), np.ma.MaskedArray)  # fmt: skip
"""What would turn into numbers inside a list or an array of objects."""


def array(
    value: ArrayLike, name: str, shape: tuple[Any, ...] | None = None, *, finite: bool = True
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
    >>> array([[1, 2], [3, 4]], "ensemble", (..., "N", 2)).shape
    (2, 2)
    >>> array([1.0, np.nan], "mean", (2,))
    Traceback (most recent call last):
    ValueError: mean: needs finite numbers, got 1 NaN or infinite of 2
    """
    plain = type(value) is np.ndarray and value.dtype == np.float64
    out: Array = value if plain else _real(value, name)  # type: ignore[assignment]
    if shape is not None and not _fits(out.shape, shape, {}):
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
        if not odd and found.dtype.kind in "fiuO":
            return np.asarray(found, dtype=np.float64)
        got = type(odd[0]).__name__ if odd else found.dtype.name
    except (TypeError, ValueError, OverflowError):
        pass
    raise ValueError(f"{name}: needs an array of real numbers, got {got}") from None


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


def definite(value: Array, name: str) -> None:
    """Refuse what is not a symmetric positive definite matrix, or a stack of them.

    Examples
    --------
    >>> definite(np.array([[1.0, 2.0], [2.0, 1.0]]), "noise")
    Traceback (most recent call last):
    ValueError: noise: needs a positive definite matrix, got smallest eigenvalue -1
    """
    _symmetric(value, name)
    _need(value, name, "definite")


def semidefinite(value: Array, name: str) -> None:
    """Refuse what is not a symmetric matrix without negative eigenvalues, or a stack of them.

    Examples
    --------
    >>> semidefinite(np.zeros((2, 2)), "noise")
    """
    _symmetric(value, name)
    _need(value, name, "semidefinite")


def _symmetric(value: Array, name: str) -> None:
    if value.ndim < 2 or value.shape[-1] != value.shape[-2]:
        raise ValueError(f"{name}: needs a square matrix, got shape {value.shape}")
    gap = np.abs(value - value.mT)
    if gap.any():
        worst = np.where(gap > _ROUNDING * _units(value), gap, 0.0).max()
        if worst > 0:
            raise ValueError(f"{name}: needs a symmetric matrix, got an asymmetry of {worst:.3g}")


def _has_factor(cov: Array) -> bool:
    if cov.ndim == 2 and cov.size:
        return bool(dpotrf(cov, lower=1, clean=0)[1] == 0)  # a fifth of numpy's time
    with contextlib.suppress(np.linalg.LinAlgError):
        return np.linalg.cholesky(cov) is not None
    return False


def _units(cov: Array) -> Array:
    """Products of the components' standard deviations, the scale of each entry."""
    std = np.sqrt(np.maximum(np.diagonal(cov, axis1=-2, axis2=-1), 0.0))
    return np.asarray(std[..., :, None] * std[..., None, :])


def _need(cov: Array, name: str, word: str) -> None:
    """Refuse what has no Cholesky factor, unless only rounding keeps it from being semidefinite."""
    if _has_factor(cov):
        return
    scale = _units(cov)
    scaled = np.divide(cov, scale, out=np.where(cov == 0, 0.0, -np.inf), where=scale > 0)
    # Not so where a variance is negative, or 0 beside a covariance that is not 0.
    finite = np.asarray(np.isfinite(scaled).all(axis=(-2, -1)))
    values = np.linalg.eigvalsh(np.where(finite[..., None, None], scaled, 0.0))[..., 0]
    values = np.where(finite, values, -np.inf)
    if word == "semidefinite" and values.min() >= -_ROUNDING:
        return
    at = np.argwhere(values == values.min())[0].tolist()
    smallest = float(np.linalg.eigvalsh(cov[tuple(at)])[0])
    raise ValueError(f"{name}: needs a positive {word} matrix, got smallest eigenvalue "
                     f"{smallest:.6g}{f' at {at}' * bool(at)}")


def summing_to_one(value: Array, name: str) -> None:
    """Refuse what is not nonnegative weights that sum to one along the last axis.

    Examples
    --------
    >>> summing_to_one(np.array([0.5, 0.6]), "weights")
    Traceback (most recent call last):
    ValueError: weights: needs a sum of 1, got 1.1
    """
    if value.size and value.min() < 0:
        raise ValueError(f"{name}: needs nonnegative weights, got {value.min():.6g}")
    total = np.ravel(value.sum(axis=-1))
    off = np.abs(total - 1)
    if off.max(initial=0.0) > 1e-6:  # weights in single precision pass
        raise ValueError(f"{name}: needs a sum of 1, got {total[off.argmax()]:.9g}")


def increasing(value: Array, name: str) -> None:
    """Refuse what does not strictly increase.

    Examples
    --------
    >>> increasing(np.array([0.0, 0.2, 0.2]), "times")
    Traceback (most recent call last):
    ValueError: times: needs strictly increasing values, got 0.2 after 0.2
    """
    late = value[1:] <= value[:-1]
    if late.any():
        k = int(late.argmax())
        got = f"{value[k + 1]:g} after {value[k]:g}"
        raise ValueError(f"{name}: needs strictly increasing values, got {got}")


def distinct(value: Sequence[int], name: str) -> None:
    """Refuse an empty list of places, and one that names a place twice.

    Examples
    --------
    >>> distinct((2, 2), "local")
    Traceback (most recent call last):
    ValueError: local: needs distinct integers, one or more, got [2, 2]
    """
    if not len(value) or len({*value}) < len(value):
        raise ValueError(f"{name}: needs distinct integers, one or more, got {[*value]}")


@dataclass(frozen=True, kw_only=True)
class Bounds:
    """A rule for a number, or for each entry of an array.

    Examples
    --------
    >>> Bounds(at_least=0)(-0.2, "sigma")
    Traceback (most recent call last):
    ValueError: sigma: needs a number at least 0, got -0.2
    """

    above: float | None = None
    at_least: float | None = None
    below: float | None = None
    at_most: float | None = None

    def __call__(self, value: Any, name: str) -> None:
        """Refuse what is out of bounds."""
        for bound, word, holds in (
            (self.above, "above", operator.gt),
            (self.at_least, "at least", operator.ge),
            (self.below, "below", operator.lt),
            (self.at_most, "at most", operator.le),
        ):
            if bound is None or np.all(holds(value, bound)):
                continue
            needs = "an integer of" if isinstance(value, int) and word == "at least" else "a number"
            worst = value if np.ndim(value) == 0 else value[~holds(value, bound)].flat[0]
            raise ValueError(f"{name}: needs {needs} {word} {bound:g}, got {worst!r}")


def needed(module: str, extra: str) -> ModuleType:
    """Import an optional package, or say which extra brings it.

    Raises
    ------
    ModuleNotFoundError
        If the package `module` is not installed. An error inside an installed one is passed on.

    Examples
    --------
    >>> needed("no_such_package", "maps")
    Traceback (most recent call last):
    ModuleNotFoundError: no_such_package: needs the extra maps: pip install 'distfilt[maps]'
    """
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        if error.name != module.partition(".")[0]:
            raise
        raise ModuleNotFoundError(
            f"{module}: needs the extra {extra}: pip install 'distfilt[{extra}]'", name=module
        ) from None
