"""What follows from a graph's links, for graphs too large for dense matrices."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from ..checks import Array

__all__: list[str] = []

Indices = NDArray[np.int64]

DENSE = 200
"""Up to this many agents a dense eigenvalue solver is the faster one."""

_FEW_LINKS = 6
"""Up to this mean degree a sparse factor is cheaper than many of Lanczos's iterations."""


_LARGE = 2000
"""From so many agents on a walk is tried before a sparse factor."""

_STEPS = 600
"""So many steps of a walk cost as much as the sparse factor of a graph in the plane."""


def degree_bound(links: sparse.csr_array, degrees: Array) -> float:
    """An upper bound of the Laplacian's largest eigenvalue, exact for stars and even rings.

    The largest sum of an agent's degree and its neighbours' mean degree (R. Merris, Linear Algebra
    and its Applications 285 (1998) 33-35).
    """
    near = (links @ degrees) / np.maximum(degrees, 1)
    return float((degrees + near).max())


def largest_eigenvalue(laplacian: sparse.csr_array, bound: float) -> float:
    """The largest eigenvalue of a symmetric Laplacian that has links, by Lanczos."""
    from scipy.sparse.linalg import ArpackNoConvergence, LinearOperator, eigsh

    size = laplacian.shape[0]
    options: dict[str, Any] = {"k": 1, "which": "LA", "v0": _start(size), "tol": 1e-8,
                               "return_eigenvectors": False}
    few = laplacian.nnz <= (_FEW_LINKS + 1) * size
    try:
        return float(eigsh(laplacian, maxiter=4 if few else 60, **options)[0])
    except ArpackNoConvergence:
        # Eigenvalues crowd below the bound, as on rings and grids: inverted there, they spread.
        shift = bound * (1 + 1e-6)
        solve = _factor(shift * sparse.eye_array(size) - laplacian).solve
        inverse = LinearOperator(laplacian.shape, matvec=solve, dtype=np.float64)
        return float(shift - 1 / eigsh(inverse, **options)[0])


def fiedler_value(laplacian: sparse.csr_array, degrees: Array) -> float:
    """The second smallest eigenvalue of a connected graph's symmetric Laplacian."""
    from scipy.sparse.linalg import eigsh

    # Shifted below zero the matrix is definite.
    shift = -1e-3 * float(degrees.mean())
    values = eigsh(laplacian.tocsc(), k=2, sigma=shift, v0=_start(laplacian.shape[0]),
                   return_eigenvectors=False)
    return float(np.sort(values)[1])


def left_null_vector(laplacian: sparse.csr_array) -> Array:
    """Positive p with p' L = 0 of a strongly connected graph, largest entry 1."""
    size = laplacian.shape[0]
    if size == 1:
        return np.ones(1)
    walked = _walked(laplacian) if size > _LARGE else None
    if walked is not None:
        return walked
    # One entry is set; the rest solves an M-matrix, which needs no pivoting.
    turned = laplacian.T.tocsc()
    factor = _factor(turned[1:, 1:])
    right = -turned[1:, [0]].toarray().ravel()
    rest = factor.solve(right)
    rest += factor.solve(right - turned[1:, 1:] @ rest)
    p = np.abs(np.concatenate([[1.0], rest]))
    return np.asarray(p / p.max())


def _walked(laplacian: sparse.csr_array) -> Array | None:
    """The left null vector by a lazy walk against the links, or None if that settles too late.

    Of a graph that has links across in all directions a sparse factor fills up, but the walk
    mixes in some hundred steps; along a plane it takes thousands, and the factor stays sparse.
    """
    degrees = laplacian.diagonal()
    heard = (sparse.diags_array(degrees) - laplacian).T.tocsr()
    p, before = np.ones(degrees.size), np.inf
    for k in range(1, _STEPS + 1):
        new = 0.5 * (p + (heard @ p) / degrees)
        new /= new.max()
        gap = float(np.abs(new / p - 1).max())
        p = new
        if gap < 1e-14:
            return np.asarray(p)
        if k % 20 == 0:
            # As many steps more as the last twenty foretell.
            pace = np.log(before / gap) / 20
            if k > 20 and (pace <= 0 or k + np.log(gap / 1e-14) / pace > _STEPS):
                return None
            before = gap
    return None


def _factor(matrix: sparse.sparray) -> Any:
    from scipy.sparse.linalg import splu

    return splu(sparse.csc_array(matrix), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0,
                options={"SymmetricMode": True})


def _start(size: int) -> Array:
    """A fixed start makes results repeatable; a random one is orthogonal to no eigenvector."""
    return np.random.default_rng(0).standard_normal(size)


def hops(forward: sparse.csr_array, agent: int) -> Indices:
    """Hops from an agent along ``forward[i, j] = 1``, j after i; -1 where there is no way."""
    order, before = sparse.csgraph.breadth_first_order(forward, agent)
    place = np.empty(forward.shape[0], dtype=np.int64)
    place[order] = np.arange(order.size)
    out = np.full(forward.shape[0], -1, dtype=np.int64)
    # In breadth-first order each level is a block, found by its predecessors' places.
    reached = place[before[order[1:]]]
    start, stop, level = 0, 1, 0
    while start < stop:
        out[order[start:stop]] = level
        start, stop, level = stop, 1 + int(np.searchsorted(reached, stop)), level + 1
    return out


def diameter(links: sparse.csr_array, *, symmetric: bool) -> int:
    """The most hops between two agents of a (strongly) connected graph."""
    forward = sparse.csr_array(links if symmetric else links.T)
    size = links.shape[0]
    if not symmetric:
        return max(int(hops(forward, agent).max()) for agent in range(size))
    # Each search bounds all agents' eccentricities from both sides (F. W. Takes and W. A. Kosters,
    # Algorithms 6 (2013) 100-118); most agents never start one.
    low, high = np.zeros(size, dtype=np.int64), np.full(size, 2 * size, dtype=np.int64)
    open_ = np.ones(size, dtype=bool)
    widest = True
    while open_.any():
        here = np.flatnonzero(open_)
        agent = here[high[here].argmax()] if widest else here[low[here].argmin()]
        widest = not widest
        away = hops(forward, int(agent))
        far = int(away.max())
        np.maximum(low, np.maximum(far - away, away), out=low)
        np.minimum(high, far + away, out=high)
        low[agent] = high[agent] = far
        open_ &= (low < high) & (high > low.max())
    return int(low.max())


def diameter_bound(links: sparse.csr_array, *, symmetric: bool) -> int:
    """At least the diameter and at most twice as much, from a few searches."""
    forward, backward = sparse.csr_array(links.T), sparse.csr_array(links)
    there = hops(forward, 0)
    far = hops(forward, int(there.argmax()))
    # Half way between two agents far apart the hops to all others are fewest.
    total = there + far
    middle = int(np.where(total == total.min(), np.abs(there - far), links.shape[0]).argmin())
    out = hops(forward, middle)
    back = out if symmetric else hops(backward, middle)
    return int(out.max() + back.max())
