"""When one row of a batch fails: who it was, and how the others go on."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from ..checks import Array, SolverError
from .streams import bookmarked

__all__ = ["FilterError", "guarded", "not_finite"]

_RECOVERABLE = (np.linalg.LinAlgError, ArithmeticError, SolverError, ValueError)

Compute = Callable[..., tuple[Array, ...]]
"""``compute(*arrays, shared, rng) -> arrays`` for any leading axes."""

Row = tuple[int, ...]


class FilterError(RuntimeError):
    """One agent's step failed: the message names run, agent and time, and why.

    Parameters
    ----------
    run : tuple of int
        Which of the independent runs.
    agent : int
    t : float
        The time of the step, in s.
    why : object
        The cause.

    Examples
    --------
    >>> FilterError((3,), 1, 2.5, "singular matrix")
    FilterError('run 3, agent 1, t = 2.5 s: singular matrix')
    """

    def __init__(self, run: tuple[int, ...], agent: int, t: float, why: object) -> None:
        self.run, self.agent, self.t, self.why = run, agent, t, str(why)
        where = f"run {', '.join(map(str, run))}, " if run else ""
        super().__init__(f"{where}agent {agent}, t = {t:g} s: {why}")

    def __reduce__(self) -> tuple[Any, ...]:
        return FilterError, (self.run, self.agent, self.t, self.why)


def guarded(
    compute: Compute, arrays: tuple[Array, ...], fallback: tuple[Array, ...], lead: int, *,
    shared: Array, rng: np.random.Generator | None,
) -> tuple[tuple[Array, ...], dict[Row, str]]:
    """A computation on a batch (*lead, …), and if it fails on each row alone.

    `compute` gets the arrays, `shared`, (m, m) for all rows or (G, m, m) for each entry of the last
    leading axis, and `rng`; `lead` axes count rows, and a row that fails keeps its `fallback`. The
    results come with the reason for each failure, by the row's index. Where every row fails with a
    ValueError the call is wrong, not a row, and the error is passed on.

    >>> def root(x, shared, rng):
    ...     return (np.linalg.cholesky(x),)
    >>> x = np.array([[[4.0]], [[-1.0]]])
    >>> out, errors = guarded(root, (x,), (x,), 1, shared=np.eye(1), rng=None)
    >>> out[0].ravel(), errors
    (array([ 2., -1.]), {(1,): 'Matrix is not positive definite'})
    """
    again = bookmarked(rng)
    try:
        out = compute(*arrays, shared, rng)
    except _RECOVERABLE as error:
        return _row_by_row(compute, arrays, fallback, lead, shared, again, error)
    for got, stands in zip(out, fallback, strict=True):
        if got.shape != stands.shape:
            raise ValueError(f"fallback: needs shape {got.shape}, got {stands.shape}")
    errors: dict[Row, str] = {}
    for got in out:
        if not np.isfinite(got).all():
            bad = ~np.isfinite(got).reshape(*got.shape[:lead], -1).all(axis=-1)
            rows = [tuple(int(i) for i in row) for row in np.argwhere(bad)]
            errors |= {row: "the result is not finite" for row in rows}
    return _replaced(out, fallback, errors), errors


def not_finite(values: Array, axes: int) -> dict[Row, str]:
    """The rows whose last `axes` axes hold NaN or infinity, as errors.

    >>> not_finite(np.array([[1.0], [np.nan]]), 1)
    {(1,): 'the forecast is not finite'}
    """
    if np.isfinite(values).all():
        return {}
    good = np.isfinite(values).all(axis=tuple(range(-axes, 0)))
    return {tuple(map(int, row)): "the forecast is not finite" for row in np.argwhere(~good)}


def _row_by_row(
    compute: Compute, arrays: tuple[Array, ...], fallback: tuple[Array, ...], lead: int,
    shared: Array, again: Callable[[], np.random.Generator | None], first: Exception,
) -> tuple[tuple[Array, ...], dict[Row, str]]:
    out = tuple(f.copy() for f in fallback)
    errors: dict[Row, str] = {}
    own = True
    for row in np.ndindex(arrays[0].shape[:lead]):
        part = shared[row[-1]] if shared.ndim > 2 else shared
        try:
            results = compute(*(a[row] for a in arrays), part, again())
            if not all(np.isfinite(r).all() for r in results):
                raise ArithmeticError("the result is not finite")
        except _RECOVERABLE as error:
            errors[row] = str(error)
            own = own and isinstance(error, ValueError)
            continue
        for target, result in zip(out, results, strict=True):
            target[row] = result
    # numpy's LinAlgError is a ValueError too, and says nothing of the arguments.
    own = own and not isinstance(first, np.linalg.LinAlgError)
    if own and len(errors) == int(np.prod(arrays[0].shape[:lead])):
        raise first
    return out, errors


def _replaced(
    out: tuple[Array, ...], fallback: tuple[Array, ...], errors: dict[Row, str]
) -> tuple[Array, ...]:
    if not errors:
        return out
    fixed = tuple(o.copy() for o in out)
    for row in errors:
        for target, stands in zip(fixed, fallback, strict=True):
            target[row] = stands[row]
    return fixed
