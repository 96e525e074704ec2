"""The mergers of Runnalls' algorithm, compiled where numba is installed.

Imported when a mixture is first reduced, since numba takes long to import. Without numba the same
loop runs on numpy, with the costs of a row of pairs in one vectorised call.
"""

from __future__ import annotations

import importlib
import importlib.util
from collections.abc import Callable
from typing import TypeVar

import numpy as np

from ..validation import Array, Indices, Mask
from .reduction import pair_costs

F = TypeVar("F", bound=Callable[..., object])

__all__ = ["merge_pairs"]


def has_numba() -> bool:
    """Whether numba is installed."""
    return importlib.util.find_spec("numba") is not None


def compile_function(function: F) -> F:
    """Compile a function by numba, which stores the compiled code between processes."""
    compiled: F = importlib.import_module("numba").njit(cache=True)(function)
    return compiled


def loop_costs(
    w: Array, m: Array, p: Array, log_dets: Array, i: int, others: Indices
) -> Array:
    """As :func:`pair_costs`, for numba: form and factor each merged covariance in one pass.

    With loops over its entries, which numba compiles, no intermediate arrays are made. Weights w
    (L,), means m (L, d) and covariances p (L, d, d) are those of all components.
    """
    d = m.shape[1]
    # The Cholesky factor of the merged covariance, and the costs; a pair without weight costs 0.
    lower = np.empty((d, d))
    costs = np.zeros(others.size)
    for k, j in enumerate(others):
        total = w[i] + w[j]
        if total <= 0.0 or i == j:
            continue
        a = w[i] / total
        b = w[j] / total
        first = p[i]
        second = p[j]
        # P_ij = a P_i + b P_j + v vᵀ with v = √(a b) (m_i - m_j), factored row by row.
        v = np.sqrt(a * b) * (m[i] - m[j])
        log_det = 0.0
        for r in range(d):
            for c in range(r):
                s = a * first[r, c] + b * second[r, c] + v[r] * v[c]
                for e in range(c):
                    s -= lower[r, e] * lower[c, e]
                lower[r, c] = s * lower[c, c]
            s = a * first[r, r] + b * second[r, r] + v[r] ** 2
            for e in range(r):
                s -= lower[r, e] ** 2
            # The diagonal holds reciprocals, so that the columns need no division. The squares of
            # the factor's diagonal multiply to the determinant.
            lower[r, r] = 1.0 / np.sqrt(s)
            log_det += np.log(s)
        # 2 B_ij = (w_i + w_j) log|P_ij| - w_i log|P_i| - w_j log|P_j|
        separate = total * log_det - w[i] * log_dets[i]
        costs[k] = 0.5 * (separate - w[j] * log_dets[j])
    return costs


def merge_pairs(w: Array, m: Array, p: Array, n_components: int) -> Mask:
    """Merge the cheapest pair, in place, until `n_components` are left.

    Parameters
    ----------
    w, m, p : ndarray, (L,), (L, d) and (L, d, d)
        Weights, means and covariances; they are overwritten.
    n_components : int
        Number of components of the result.

    Returns
    -------
    ndarray of bool, (L,)
        Which components are left: a merger has the place of the first of its pair.
    """
    n = w.size
    index = np.arange(n)
    remaining = np.full(n, True)
    log_dets = np.array([np.linalg.slogdet(p[i])[1] for i in range(n)])
    # Costs of the pairs i < j, infinite elsewhere; of each row the least, and its column.
    table = np.full((n, n), np.inf)
    best = np.full(n, np.inf)
    nearest = np.zeros(n, np.int64)
    for k in range(n - 1):
        table[k, k + 1 :] = row_costs(w, m, p, log_dets, k, index[k + 1 :])
    changed_rows = index[:-1]
    for _ in range(n - n_components):
        for k in changed_rows:
            nearest[k] = np.argmin(table[k])
            best[k] = table[k, nearest[k]]
        # The first of the pairs that cost the same, so that rounding does not choose.
        limit = best.min() + 1e-12 + 1e-9 * abs(best.min())
        i = int(np.argmax(best <= limit))
        j = int(np.argmax(table[i] <= limit))
        # Component i becomes the merger of i and j with the moments of both.
        total = w[i] + w[j]
        a = w[i] / total if total > 0 else 0.5
        difference = m[i] - m[j]
        spread = a * (1 - a) * np.outer(difference, difference)
        p[i] = a * p[i] + (1 - a) * p[j] + spread
        m[i] = a * m[i] + (1 - a) * m[j]
        w[i] = total
        # Component j is gone, and its costs are infinite.
        w[j] = 0.0
        remaining[j] = False
        best[j] = np.inf
        table[j, :] = np.inf
        table[:, j] = np.inf
        # Costs of the merger with all others, above and below the diagonal.
        log_dets[i] = np.linalg.slogdet(p[i])[1]
        others = index[remaining & (index != i)]
        costs = row_costs(w, m, p, log_dets, i, others)
        is_before = others < i
        table[others[is_before], i] = costs[is_before]
        table[i, others[~is_before]] = costs[~is_before]
        # Only rows that lost their cheapest pair, and the merger's, are searched again.
        lost_nearest = (nearest == i) | (nearest == j) | (index == i)
        changed_rows = np.flatnonzero(remaining & lost_nearest)
        # In the other rows the merger may be the new cheapest.
        nearest = np.where(table[:, i] < best, i, nearest)
        best = np.minimum(table[:, i], best)
    return remaining


row_costs: Callable[[Array, Array, Array, Array, int, Indices], Array] = pair_costs

if has_numba():
    # Compiled code calls only compiled functions.
    row_costs = compile_function(loop_costs)
    merge_pairs = compile_function(merge_pairs)
