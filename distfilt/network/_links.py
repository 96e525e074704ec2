"""Links as sparse matrices, from matrices of zeros and ones or from edges."""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy

from ..validation import Indices, check_array

__all__: list[str] = []


def of_matrix(value: Any, name: str, *, directed: bool) -> scipy.sparse.csr_array:
    """The links that a matrix of zeros and ones marks, an array or sparse."""
    if not scipy.sparse.issparse(value):
        flags = isinstance(value, np.ndarray) and value.dtype == bool
        value = check_array(value * 1.0 if flags else value, name, ("A", "A"))
    a = scipy.sparse.csr_array(value)
    if a.shape[0] != a.shape[1] or a.shape[0] == 0:
        raise ValueError(f"{name} must be a square matrix, got shape {a.shape}")
    odd = (a.data != 0) & (a.data != 1)
    if odd.any():
        raise ValueError(f"{name} must be zeros and ones, got {a.data[odd][0]:g}")
    links = linked(a.shape[0], np.stack(a.nonzero(), axis=1), name)
    i, j = (links - links.T).nonzero()
    if i.size and not directed:
        needs = "every link both ways (Graph.from_adjacency(..., directed=True) takes others)"
        raise ValueError(
            f"{name} must be {needs}, got one way only between {i[0]} and {j[0]}"
        )
    return links


def of_edges(
    size: int, edges: Any, name: str, *, directed: bool
) -> scipy.sparse.csr_array:
    """The links of pairs (listener, speaker), both ways unless the graph is directed.

    >>> of_edges(3, [(0, -1)], "edges", directed=False)
    Traceback (most recent call last):
    ValueError: edges must have agents from 0 to 2, got [[0.0, -1.0]]
    """
    pairs = check_array(edges, name)
    pairs = (
        pairs.reshape(-1, 2) if pairs.size == 0 else check_array(pairs, name, ("E", 2))
    )
    listed = pairs.astype(np.int64)
    inside = not listed.size or 0 <= listed.min() <= listed.max() < size
    if (listed != pairs).any() or not inside:
        raise ValueError(
            f"{name} must have agents from 0 to {size - 1}, got {pairs.tolist()[:3]}"
        )
    both = listed if directed else np.concatenate([listed, listed[:, ::-1]])
    return linked(size, both, name)


def of_either(value: Any, size: int | None, name: str) -> scipy.sparse.csr_array:
    """The links of a matrix or of a list of edges, both ways."""
    if scipy.sparse.issparse(value) or getattr(value, "dtype", None) == np.dtype(bool):
        return of_matrix(value, name, directed=False)
    a = check_array(value, name)
    square = a.ndim == 2 and 0 < a.shape[0] == a.shape[1] and size in (None, a.shape[0])
    # Two edges look like a matrix of two agents.
    if square and not (a.shape[0] == 2 and (a.diagonal().any() or (a > 1).any())):
        return of_matrix(a, name, directed=False)
    most = int(a.max()) + 1 if min(a.shape) else 0
    return of_edges(most if size is None else size, a, name, directed=False)


def is_networkx(value: Any) -> bool:
    """Whether a value has what networkx's graphs have."""
    return all(hasattr(value, name) for name in ("nodes", "edges", "is_directed"))


def linked(size: int, pairs: Indices, name: str) -> scipy.sparse.csr_array:
    """The matrix of a graph's links from pairs (listener, speaker), which may repeat.

    >>> linked(3, np.array([[1, 1], [2, 2]]), "edges")
    Traceback (most recent call last):
    ValueError: edges must have no self-loops, got one at agent 1
    """
    loops = pairs[pairs[:, 0] == pairs[:, 1], 0]
    if loops.size:
        raise ValueError(f"{name} must have no self-loops, got one at agent {loops[0]}")
    links = scipy.sparse.csr_array(
        (np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), (size, size)
    )
    links.sum_duplicates()
    links.data[:] = 1.0
    links.sort_indices()
    return links
