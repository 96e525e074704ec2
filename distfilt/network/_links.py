"""Links as sparse matrices, from matrices of zeros and ones or from edges."""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Sequence
from numbers import Integral
from typing import Any, Protocol, TypeGuard

import numpy as np
import scipy

from ..validation import Indices, check_array

__all__: list[str] = []


def from_matrix(value: object, name: str, *, directed: bool) -> scipy.sparse.csr_array:
    """Return the links that a matrix of zeros and ones marks, an array or sparse.

    Entry (i, j) marks a link from agent j to agent i. Unless `directed`, every link must go both
    ways.
    """
    if not scipy.sparse.issparse(value):
        # Booleans are no numbers to `check_array`, but here they are zeros and ones.
        if isinstance(value, np.ndarray) and value.dtype == bool:
            value = value.astype(np.float64)
        value = check_array(value, name, ("A", "A"))
    matrix = scipy.sparse.csr_array(value)
    if matrix.shape[0] != matrix.shape[1] or matrix.shape[0] == 0:
        raise ValueError(f"{name} must be a square matrix, got shape {matrix.shape}")
    wrong = (matrix.data != 0) & (matrix.data != 1)
    if wrong.any():
        first = matrix.data[wrong][0]
        raise ValueError(f"{name} must be zeros and ones, got {first:g}")
    # Sorted, without explicit zeros, and without self-loops.
    pairs = np.stack(matrix.nonzero(), axis=1)
    links = build_links(matrix.shape[0], pairs, name)
    if not directed:
        _check_symmetric(links, name)
    return links


def _check_symmetric(links: scipy.sparse.csr_array, name: str) -> None:
    """Refuse links (A, A) that lead one way only."""
    # A link without its opposite leaves an entry of 1 or -1 in A - Aᵀ.
    i, j = (links - links.T).nonzero()
    if i.size:
        raise ValueError(
            f"{name} must have every link both ways (Graph.from_adjacency(..., "
            f"directed=True) takes others), got one way only between {i[0]} and {j[0]}"
        )


def from_edges(
    n_agents: int, edges: object, name: str, *, directed: bool
) -> scipy.sparse.csr_array:
    """Return the links of pairs (receiver, sender), both ways unless the graph is directed.

    >>> from_edges(3, [(0, -1)], "edges", directed=False)
    Traceback (most recent call last):
    ValueError: edges must have agents from 0 to 2, got [[0.0, -1.0]]
    """
    numbers = check_array(edges, name)
    # No edges at all come in any shape: [], or an array (0, 2).
    if numbers.size == 0:
        numbers = numbers.reshape(-1, 2)
    numbers = check_array(numbers, name, ("E", 2))
    pairs = numbers.astype(np.int64)
    # Fractions are refused, not truncated.
    is_integer = (pairs == numbers).all()
    if not is_integer or pairs.min(initial=0) < 0 or pairs.max(initial=-1) >= n_agents:
        raise ValueError(
            f"{name} must have agents from 0 to {n_agents - 1}, "
            f"got {numbers.tolist()[:3]}"
        )
    if not directed:
        pairs = np.concatenate([pairs, pairs[:, ::-1]])
    return build_links(n_agents, pairs, name)


def from_matrix_or_edges(
    value: object, n_agents: int | None, name: str
) -> scipy.sparse.csr_array:
    """Return the links of a matrix or of a list of edges, both ways, as a matrix (A, A)."""
    if scipy.sparse.issparse(value) or getattr(value, "dtype", None) == np.dtype(bool):
        return from_matrix(value, name, directed=False)
    numbers = check_array(value, name)
    if _is_adjacency(numbers, n_agents):
        return from_matrix(numbers, name, directed=False)
    if n_agents is None:
        # One more than the largest number; an empty list has no agents.
        n_agents = int(numbers.max()) + 1 if min(numbers.shape) else 0
    return from_edges(n_agents, numbers, name, directed=False)


def _is_adjacency(numbers: np.ndarray, n_agents: int | None) -> bool:
    """Return whether numbers are a matrix of links rather than a list of edges."""
    if numbers.ndim != 2 or numbers.shape[0] != numbers.shape[1]:
        return False
    size = numbers.shape[0]
    if size == 0 or n_agents not in (None, size):
        return False
    # A list of two edges is a 2 x 2 array too. A matrix of two agents has a zero diagonal and no
    # number above 1; any other array is taken for edges.
    looks_like_edges = numbers.diagonal().any() or (numbers > 1).any()
    return not (size == 2 and looks_like_edges)


class NetworkxGraph(Protocol):
    """What is used of a graph of networkx."""

    @property
    def nodes(self) -> Iterable[Hashable]: ...

    @property
    def edges(self) -> Iterable[tuple[Hashable, ...]]: ...

    def is_directed(self) -> bool: ...


def is_networkx(value: object) -> TypeGuard[NetworkxGraph]:
    """Return whether a value has the attributes of networkx's graphs."""
    return all(hasattr(value, name) for name in ("nodes", "edges", "is_directed"))


def order_nodes(
    nodes: Sequence[Hashable], names: Sequence[Hashable]
) -> Sequence[Hashable]:
    """Return the nodes of a networkx graph in the order of the agents.

    >>> order_nodes([3, 1, 2], [])
    [1, 2, 3]
    >>> order_nodes(["10", "9", "1"], [])  # as files have them
    ['1', '9', '10']
    >>> order_nodes([3, 1, 2], ["a", "b", "c"])
    Traceback (most recent call last):
    ValueError: graph must have the nodes ['a', 'b', 'c'], got [3, 1, 2]
    """
    labels = set(nodes)
    # Labels 0, 1, ... are the agents' numbers.
    if labels == set(range(len(nodes))):
        return range(len(nodes))
    if names:
        # A node is the agent of its label, also of a number that is written like a name.
        node_of = {str(node): node for node in nodes} | {node: node for node in nodes}
        order = [node_of[name] for name in names if name in node_of]
        if len(order) != len(nodes) or set(order) != labels or len(names) != len(nodes):
            raise ValueError(f"graph must have the nodes {list(names)}, got {nodes}")
        return order
    # Integers, also as text, and tuples of them are sorted; others keep the graph's order.
    return sorted(nodes, key=_integers) if _are_integers(nodes) else nodes


def _are_integers(nodes: Sequence[Hashable]) -> bool:
    """Whether labels are all integers, or all tuples of integers of one length."""
    # Whether each label is a tuple, and of how many entries.
    kinds = set()
    for node in nodes:
        entries = node if isinstance(node, tuple) else (node,)
        if not all(_is_integer(entry) for entry in entries):
            return False
        kinds.add((type(node) is tuple, len(entries)))
    return len(kinds) <= 1


def _is_integer(entry: object) -> bool:
    """Whether a label, or a part of one, is an integer or text that is one."""
    is_text = isinstance(entry, str) and entry.isascii() and entry.isdecimal()
    return is_text or isinstance(entry, Integral)


def number_edges(value: object, names: Sequence[str], name: str) -> object:
    """Return edges between agents' names as edges between their numbers; others as they are.

    >>> number_edges([("a", "c")], ["a", "b", "c"], "graph")
    [(0, 2)]
    >>> number_edges([("a", "d")], ["a", "b", "c"], "graph")
    Traceback (most recent call last):
    ValueError: graph must have edges between the agents ['a', 'b', 'c'], got 'd'
    """
    # Anything else than a list of pairs of names is returned as it is.
    if not isinstance(value, list | tuple) or not value:
        return value
    for pair in value:
        is_pair = isinstance(pair, list | tuple) and len(pair) == 2
        if not is_pair or not all(isinstance(end, str) for end in pair):
            return value
    number_of = {label: number for number, label in enumerate(names)}
    # An end that is no agent's name is refused.
    edges = []
    for pair in value:
        for end in pair:
            if end not in number_of:
                raise ValueError(
                    f"{name} must have edges between the agents {list(names)}, got {end!r}"
                )
        edges.append((number_of[pair[0]], number_of[pair[1]]))
    return edges


def _integers(node: Hashable) -> tuple[int, ...]:
    """Return the integers of a label that is one, or a tuple of them."""
    entries: tuple[Any, ...] = node if isinstance(node, tuple) else (node,)
    return tuple([int(entry) for entry in entries])


def build_links(n_agents: int, pairs: Indices, name: str) -> scipy.sparse.csr_array:
    """Return the matrix of links from pairs (receiver, sender), which may repeat.

    >>> build_links(3, np.array([[1, 1], [2, 2]]), "edges")
    Traceback (most recent call last):
    ValueError: edges must have no self-loops, got one at agent 1
    """
    loops = pairs[pairs[:, 0] == pairs[:, 1], 0]
    if loops.size:
        raise ValueError(f"{name} must have no self-loops, got one at agent {loops[0]}")
    ones = np.ones(len(pairs))
    coordinates = (pairs[:, 0], pairs[:, 1])
    links = scipy.sparse.csr_array((ones, coordinates), (n_agents, n_agents))
    # Repeated pairs add up, but each link counts once. Sorted, links are in the order of
    # (receiver, sender).
    links.sum_duplicates()
    links.data[:] = 1.0
    links.sort_indices()
    return links
