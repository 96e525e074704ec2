"""Compiled kernel of Runnalls' reduction; imported where it is used, and only if numba is there.

The functions are plain Python that numba compiles; the tests run them uncompiled too.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from typing import Any

import numpy as np

try:
    _numba: Any = import_module("numba")
except ImportError:  # the caller falls back on numpy
    _numba = None

__all__: list[str] = []


def _compiled(function: Callable[..., Any]) -> Any:
    return function if _numba is None else _numba.njit(cache=True)(function)


def _log_det(p: Any, d: int) -> Any:
    """Log determinant of a positive definite matrix, destroyed in place by its factor."""
    total = 0.0
    for j in range(d):
        s = p[j, j]
        for k in range(j):
            s -= p[j, k] * p[j, k]
        if s <= 0.0:
            return np.nan
        total += np.log(s)
        root = np.sqrt(s)
        p[j, j] = root
        for i in range(j + 1, d):
            s = p[i, j]
            for k in range(j):
                s -= p[i, k] * p[j, k]
            p[i, j] = s / root
    return total


log_det = _compiled(_log_det)


def _cost(w: Any, m: Any, p: Any, dets: Any, i: int, j: int, work: Any) -> Any:
    """Runnalls' bound on the loss of merging i and j; `work` (d, d) is overwritten."""
    d = m.shape[1]
    total = w[i] + w[j]
    if total <= 0.0:
        return 0.0
    a, b = w[i] / total, w[j] / total
    for r in range(d):
        gap = a * b * (m[i, r] - m[j, r])
        for c in range(r + 1):
            work[r, c] = a * p[i, r, c] + b * p[j, r, c] + gap * (m[i, c] - m[j, c])
    return 0.5 * (total * log_det(work, d) - w[i] * dets[i] - w[j] * dets[j])


cost = _compiled(_cost)


def _merge(w: Any, m: Any, p: Any, i: int, j: int) -> None:
    """Put j into i, keeping mean and covariance of the pair."""
    d = m.shape[1]
    total = w[i] + w[j]
    a = w[i] / total if total > 0.0 else 0.5
    b = 1.0 - a
    for r in range(d):
        for c in range(r + 1):
            spread = a * b * (m[i, r] - m[j, r]) * (m[i, c] - m[j, c])
            p[i, r, c] = a * p[i, r, c] + b * p[j, r, c] + spread
            p[i, c, r] = p[i, r, c]
    for r in range(d):
        m[i, r] = a * m[i, r] + b * m[j, r]
    w[i], w[j] = total, 0.0


merge = _compiled(_merge)


def _renew(
    w: Any, m: Any, p: Any, dets: Any, alive: Any, table: Any, best: Any, nearest: Any,
    i: int, j: int, work: Any,
) -> None:  # fmt: skip
    """Costs of the pairs with the merged mixand `i`, and cheapest pairs where `j` was in one."""
    n = best.size
    for k in range(n):
        if not alive[k] or k == i:
            continue
        low, high = (k, i) if k < i else (i, k)
        table[low, high] = cost(w, m, p, dets, low, high, work)
    for k in range(n):
        if not alive[k]:
            continue
        # Only rows that lost their neighbour, and the merged one, are searched again.
        if k == i or nearest[k] == i or nearest[k] == j:
            best[k] = np.inf
            for c in range(k + 1, n):
                if alive[c] and table[k, c] < best[k]:
                    best[k], nearest[k] = table[k, c], c
        elif k < i and table[k, i] < best[k]:
            best[k], nearest[k] = table[k, i], i


renew = _compiled(_renew)


def _reduce(w: Any, m: Any, p: Any, alive: Any, size: int) -> None:
    """Merge the cheapest pair until `size` mixands are alive, in place."""
    n, d = m.shape
    work = np.empty((d, d))
    dets = np.empty(n)
    table = np.empty((n, n))
    best = np.full(n, np.inf)
    nearest = np.zeros(n, dtype=np.int64)
    for i in range(n):
        work[:] = p[i]
        dets[i] = log_det(work, d)
    for i in range(n):
        for j in range(i + 1, n):
            table[i, j] = cost(w, m, p, dets, i, j, work)
            if table[i, j] < best[i]:
                best[i], nearest[i] = table[i, j], j
    left = n
    while left > size:
        # The first of the pairs that cost the same, so that rounding does not choose.
        lowest = best.min()
        lowest += 1e-12 + 1e-9 * abs(lowest)
        i = 0
        while best[i] > lowest:
            i += 1
        j = i + 1
        while not alive[j] or table[i, j] > lowest:
            j += 1
        merge(w, m, p, i, j)
        work[:] = p[i]
        dets[i] = log_det(work, d)
        alive[j] = False
        best[j] = np.inf
        left -= 1
        renew(w, m, p, dets, alive, table, best, nearest, i, j, work)


reduce = _compiled(_reduce)
