"""Links as sparse matrices: how they are built and what follows from them, for large graphs too."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from ..doors import Array, array

__all__: list[str] = []

Indices = NDArray[np.int64]

DENSE = 200
"""Up to this many agents a dense eigenvalue solver is the faster one."""

def of_matrix(value: Any, name: str, *, directed: bool) -> sparse.csr_array:
    """The links that a matrix of zeros and ones marks, an array or sparse."""
    if not sparse.issparse(value):
        flags = isinstance(value, np.ndarray) and value.dtype == bool
        value = array(value * 1.0 if flags else value, name, ("A", "A"))
    a = sparse.csr_array(value)
    a.sum_duplicates()
    if a.shape[0] != a.shape[1] or a.shape[0] == 0:
        raise ValueError(f"{name}: needs a square matrix, got shape {a.shape}")
    odd = (a.data != 0) & (a.data != 1)
    if odd.any():
        raise ValueError(f"{name}: needs zeros and ones, got {a.data[odd][0]:g}")
    links = _without_loops(a.shape[0], np.stack(a.nonzero(), axis=1), name)
    row, column = (links - links.T).nonzero()
    if row.size and not directed:
        i, j = sorted((int(row[0]), int(column[0])))
        raise ValueError(
            f"{name}: needs every link both ways in an undirected graph, got one way only between "
            f"agents {i} and {j} (Graph.from_adjacency(..., directed=True) takes it)"
        )
    return links


def of_edges(size: int, edges: Any, name: str, *, directed: bool) -> sparse.csr_array:
    """The links of pairs (listener, speaker), both ways unless the graph is directed."""
    pairs = array(edges, name)
    pairs = pairs.reshape(-1, 2) if pairs.size == 0 else array(pairs, name, ("E", 2))
    listed = pairs.astype(np.int64)
    inside = not listed.size or 0 <= listed.min() <= listed.max() < size
    if (listed != pairs).any() or not inside:
        raise ValueError(f"{name}: needs agents from 0 to {size - 1}, got {pairs.tolist()[:3]}")
    both = listed if directed else np.concatenate([listed, listed[:, ::-1]])
    return _without_loops(size, both, name)


def of_either(value: Any, size: int | None, name: str) -> sparse.csr_array:
    """The links of a matrix or of a list of edges, both ways."""
    if sparse.issparse(value) or getattr(value, "dtype", None) == np.dtype(bool):
        return of_matrix(value, name, directed=False)
    a = array(value, name)
    square = a.ndim == 2 and 0 < a.shape[0] == a.shape[1] and size in (None, a.shape[0])
    # Two edges look like a matrix of two agents.
    if square and not (a.shape[0] == 2 and (a.diagonal().any() or (a > 1).any())):
        return of_matrix(a, name, directed=False)
    most = int(a.max()) + 1 if min(a.shape) else 0
    return of_edges(most if size is None else size, a, name, directed=False)


def is_networkx(value: Any) -> bool:
    """Whether a value has what networkx's graphs have."""
    return all(hasattr(value, name) for name in ("nodes", "edges", "is_directed"))


def of_networkx(graph: Any, name: str) -> sparse.csr_array:
    """The links of a networkx graph, agents in the order of its nodes."""
    number_of = {node: k for k, node in enumerate(graph.nodes)}
    listed = [(number_of[edge[1]], number_of[edge[0]]) for edge in graph.edges]
    return of_edges(len(number_of), listed, name, directed=bool(graph.is_directed()))


def _without_loops(size: int, pairs: Indices, name: str) -> sparse.csr_array:
    loops = pairs[pairs[:, 0] == pairs[:, 1], 0]
    if loops.size:
        raise ValueError(f"{name}: needs no self-loops, got one at agent {loops[0]}")
    return linked(size, pairs)


def linked(size: int, pairs: Indices) -> sparse.csr_array:
    """The matrix of a graph's links from pairs (listener, speaker), which may repeat."""
    links = sparse.csr_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), (size, size))
    links.sum_duplicates()
    links.data[:] = 1.0
    links.sort_indices()
    return links


def reverse(links: sparse.csr_array, receivers: Indices, senders: Indices) -> Indices:
    """For each link the number of the one that goes the other way; -1 for none."""
    edges, size = senders.size, links.shape[0]
    numbered = sparse.csr_array((np.arange(edges), links.indices, links.indptr), links.shape)
    turned = numbered.T.tocsr()
    if (turned.indptr == links.indptr).all() and (turned.indices == senders).all():
        return np.asarray(turned.data, dtype=np.int64)
    key, other = receivers * size + senders, senders * size + receivers
    found = np.searchsorted(key, other).clip(max=edges - 1)
    return np.where(key[found] == other, found, -1)


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
    try:
        return float(eigsh(laplacian, maxiter=60, **options)[0])
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
    # One entry is set; the rest solves an M-matrix, which needs no pivoting.
    turned = laplacian.T.tocsc()
    factor = _factor(turned[1:, 1:])
    right = -turned[1:, [0]].toarray().ravel()
    rest = factor.solve(right)
    rest += factor.solve(right - turned[1:, 1:] @ rest)
    p = np.abs(np.concatenate([[1.0], rest]))
    return np.asarray(p / p.max())


def _factor(matrix: sparse.sparray) -> Any:
    from scipy.sparse.linalg import splu

    return splu(sparse.csc_array(matrix), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0,
                options={"SymmetricMode": True})


def _start(size: int) -> Array:
    """A fixed start makes results repeatable; a random one is orthogonal to no eigenvector."""
    return np.random.default_rng(0).standard_normal(size)


def hops(forward: sparse.csr_array, agent: int) -> Indices:
    """Hops from an agent along ``forward[i, j] = 1``, j after i; -1 where there is no way."""
    away = sparse.csgraph.dijkstra(forward, indices=agent, unweighted=True)
    return np.where(np.isinf(away), -1, away).astype(np.int64)


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


def diameter_bound(links: sparse.csr_array) -> int:
    """At least the diameter and at most twice as much, from two searches."""
    there, back = (hops(sparse.csr_array(a), 0) for a in (links.T, links))
    return int(there.max() + back.max())
