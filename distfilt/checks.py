"""Checks of what callers pass in: each error names the argument, what came and what is needed.

Every function returns its input as a plain float64 array (or the plain Python value) and never
changes it. Nothing is repaired: a covariance that is not symmetric is refused, not symmetrised.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Collection
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = [
    "Array",
    "SolverError",
    "array",
    "callable_",
    "choice",
    "count",
    "covariance",
    "generator",
    "increasing",
    "number",
    "same_length",
    "weights",
]

Array = NDArray[np.float64]


class SolverError(RuntimeError):
    """A solver stopped without a solution; the message names it, its status and the problem."""


_SYMMETRY = 1e-9
"""Largest asymmetry, relative to the largest entry, that counts as rounding."""


def array(
    value: ArrayLike, name: str, shape: tuple[Any, ...] | None = None, *, finite: bool = True
) -> Array:
    """Return `value` as a float64 array of the wanted shape.

    Parameters
    ----------
    value : array_like
        What the caller passed.
    name : str
        The argument's name, for the error.
    shape : tuple, optional
        Sizes from left to right: an integer is exact, a string is a free size with a name for
        the error, and a leading ``...`` allows any leading axes.
    finite : bool
        Refuse NaN and infinity.

    Raises
    ------
    ValueError
        If the value is not numeric, has another shape, or holds NaN or infinity.

    Examples
    --------
    >>> array([[1, 2], [3, 4]], "ensemble", (..., "N", 2)).shape
    (2, 2)
    >>> array([1.0, np.nan], "mean", (2,))
    Traceback (most recent call last):
    ValueError: mean: needs finite numbers, got 1 NaN or infinite of 2
    """
    try:
        out = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        raise ValueError(
            f"{name}: needs an array of real numbers, got {type(value).__name__}"
        ) from None
    if shape is not None and not _fits(out.shape, shape):
        raise ValueError(f"{name}: needs shape {_shape_text(shape)}, got {out.shape}")
    if finite and not np.isfinite(out).all():
        bad = int((~np.isfinite(out)).sum())
        raise ValueError(f"{name}: needs finite numbers, got {bad} NaN or infinite of {out.size}")
    return out


def _fits(got: tuple[int, ...], needed: tuple[Any, ...]) -> bool:
    tail = needed[1:] if needed and needed[0] is ... else needed
    if len(got) < len(tail) or (len(got) > len(tail) and tail is needed):
        return False
    sizes = got[len(got) - len(tail) :]
    return all(isinstance(n, str) or n == g for n, g in zip(tail, sizes, strict=True))


def _shape_text(shape: tuple[Any, ...]) -> str:
    sizes = ", ".join("..." if n is ... else str(n) for n in shape)
    return f"({sizes},)" if len(shape) == 1 else f"({sizes})"


def covariance(
    value: ArrayLike, name: str, dim: int | None = None, *, semidefinite: bool = False
) -> Array:
    """Return `value` as a symmetric positive definite matrix, or a stack of them.

    Parameters
    ----------
    value : array_like, (..., d, d)
        The covariance.
    name : str
        The argument's name, for the error.
    dim : int, optional
        The size d that is needed.
    semidefinite : bool
        Also accept singular matrices (a process noise that drives only some components).

    Raises
    ------
    ValueError
        If the matrix is not square of size `dim`, not symmetric, or not positive (semi)definite.

    Examples
    --------
    >>> covariance([[1.0, 2.0], [2.0, 1.0]], "noise")
    Traceback (most recent call last):
    ValueError: noise: needs a positive definite matrix, got smallest eigenvalue -1
    """
    size: Any = "d" if dim is None else dim
    out = array(value, name, (..., size, size))
    if out.shape[-1] != out.shape[-2]:
        raise ValueError(f"{name}: needs a square matrix, got shape {out.shape}")
    scale = np.abs(out).max(initial=0.0)
    gap = np.abs(out - np.swapaxes(out, -1, -2)).max(initial=0.0)
    if gap > _SYMMETRY * scale:
        raise ValueError(f"{name}: needs a symmetric matrix, got an asymmetry of {gap:.3g}")
    if semidefinite:
        least = float(np.linalg.eigvalsh(out).min(initial=0.0))
        if least < -_SYMMETRY * scale:
            raise ValueError(
                f"{name}: needs a positive semidefinite matrix, got smallest eigenvalue {least:.6g}"
            )
        return out
    try:
        np.linalg.cholesky(out)
    except np.linalg.LinAlgError:
        least = float(np.linalg.eigvalsh(out).min())
        raise ValueError(
            f"{name}: needs a positive definite matrix, got smallest eigenvalue {least:.6g}"
        ) from None
    return out


def weights(value: ArrayLike, name: str, size: int | None = None) -> Array:
    """Return `value` as nonnegative weights that sum to one along the last axis.

    Raises
    ------
    ValueError
        If a weight is negative or a sum differs from one by more than 1e-8.

    Examples
    --------
    >>> weights([0.5, 0.6], "weights")
    Traceback (most recent call last):
    ValueError: weights: needs a sum of 1, got 1.1
    """
    out = array(value, name, (..., "N" if size is None else size))
    if out.size and out.min() < 0:
        raise ValueError(f"{name}: needs nonnegative weights, got {out.min():.6g}")
    total = out.sum(axis=-1)
    worst = np.abs(total - 1).max(initial=0.0)
    if worst > 1e-8:
        wrong = np.ravel(total)[np.abs(np.ravel(total) - 1).argmax()]
        raise ValueError(f"{name}: needs a sum of 1, got {wrong:.6g}")
    return out


def number(
    value: Any,
    name: str,
    *,
    above: float | None = None,
    at_least: float | None = None,
    below: float | None = None,
    at_most: float | None = None,
) -> float:
    """Return `value` as a finite float inside the given bounds.

    Examples
    --------
    >>> number(-0.2, "sigma", at_least=0)
    Traceback (most recent call last):
    ValueError: sigma: needs a number at least 0, got -0.2
    """
    needs = "a finite number"
    try:
        out = float(value)
        good = bool(np.isfinite(out)) and np.ndim(value) == 0
    except (TypeError, ValueError):
        raise ValueError(f"{name}: needs {needs}, got {value!r}") from None
    bounds: tuple[tuple[float | None, str, Callable[[float, float], bool]], ...] = (
        (above, "above", operator.gt),
        (at_least, "at least", operator.ge),
        (below, "below", operator.lt),
        (at_most, "at most", operator.le),
    )
    for bound, word, holds in bounds:
        if bound is not None and not holds(out, bound):
            needs, good = f"a number {word} {bound:g}", False
    if not good:
        raise ValueError(f"{name}: needs {needs}, got {value!r}")
    return out


def count(value: Any, name: str, *, at_least: int = 1) -> int:
    """Return `value` as an integer of at least `at_least`.

    Examples
    --------
    >>> count(1.5, "members")
    Traceback (most recent call last):
    ValueError: members: needs an integer of at least 1, got 1.5
    """
    integral = isinstance(value, int | np.integer) and not isinstance(value, bool)
    if not integral or value < at_least:
        raise ValueError(f"{name}: needs an integer of at least {at_least}, got {value!r}")
    return int(value)


def choice(value: Any, name: str, options: Collection[str]) -> str:
    """Return `value` if it is one of the options.

    Examples
    --------
    >>> choice("svd", "solver", ("ECOS", "CLARABEL"))
    Traceback (most recent call last):
    ValueError: solver: needs one of ECOS, CLARABEL, got 'svd'
    """
    if value not in options:
        raise ValueError(f"{name}: needs one of {', '.join(options)}, got {value!r}")
    return str(value)


def generator(value: Any, name: str = "rng") -> np.random.Generator:
    """Return `value` if it is a numpy random generator; integers and None are refused.

    Examples
    --------
    >>> generator(7)
    Traceback (most recent call last):
    ValueError: rng: needs a numpy.random.Generator (np.random.default_rng(seed)), got int
    """
    if not isinstance(value, np.random.Generator):
        raise ValueError(
            f"{name}: needs a numpy.random.Generator (np.random.default_rng(seed)), "
            f"got {type(value).__name__}"
        )
    return value


def callable_(value: Any, name: str) -> Callable[..., Any]:
    """Return `value` if it can be called.

    Examples
    --------
    >>> callable_(3, "step")
    Traceback (most recent call last):
    ValueError: step: needs a function, got int
    """
    if not callable(value):
        raise ValueError(f"{name}: needs a function, got {type(value).__name__}")
    return value  # type: ignore[no-any-return]


def increasing(value: ArrayLike, name: str) -> Array:
    """Return `value` as a strictly increasing vector of times.

    Examples
    --------
    >>> increasing([0.0, 0.2, 0.2], "times")
    Traceback (most recent call last):
    ValueError: times: needs strictly increasing values, got 0.2 after 0.2
    """
    out = array(value, name, ("T",))
    steps = np.diff(out)
    if steps.size and steps.min() <= 0:
        k = int(np.argmax(steps <= 0))
        raise ValueError(
            f"{name}: needs strictly increasing values, got {out[k + 1]:g} after {out[k]:g}"
        )
    return out


def same_length(a: Collection[Any], b: Collection[Any], name_a: str, name_b: str) -> None:
    """Refuse two collections of different length.

    Examples
    --------
    >>> same_length([1, 2], [1], "sensors", "agents")
    Traceback (most recent call last):
    ValueError: sensors: needs as many entries as agents (1), got 2
    """
    if len(a) != len(b):
        raise ValueError(f"{name_a}: needs as many entries as {name_b} ({len(b)}), got {len(a)}")
