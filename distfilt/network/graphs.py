"""Graphs of agents in common shapes, at random, and by the range of radios."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from ..checks import array, count, generator, instance, number
from .links import Graph, Indices, linked

__all__ = ["Graph", "complete", "disk", "grid", "path", "random", "ring", "star"]

_BLOCK = 4_000_000
"""Numbers that :func:`random` draws at a time."""


def _both_ways(size: int, first: Indices, second: Indices) -> Graph:
    one_way = np.stack([first.ravel(), second.ravel()], axis=1)
    return Graph(linked(size, np.concatenate([one_way, one_way[:, ::-1]])))


def path(agents: int) -> Graph:
    """Agents in a row.

    >>> path(3).neighbours(1)
    (0, 2)
    """
    number_of = np.arange(count(agents, "agents"))
    return _both_ways(number_of.size, number_of[:-1], number_of[1:])


def ring(agents: int) -> Graph:
    """Agents in a circle, at least three.

    >>> ring(4).neighbours(0)
    (1, 3)
    """
    number_of = np.arange(count(agents, "agents", at_least=3))
    return _both_ways(number_of.size, number_of, np.roll(number_of, -1))


def star(agents: int) -> Graph:
    """Agent 0 hears all the others and they hear only it; Tables II and III of Grange et al.

    >>> star(5).spectrum.round(6) + 0.0
    array([0., 1., 1., 1., 5.])
    """
    others = np.arange(1, count(agents, "agents"))
    return _both_ways(others.size + 1, np.zeros_like(others), others)


def grid(rows: int, columns: int) -> Graph:
    """Agents on a rectangular grid, numbered row by row.

    >>> grid(2, 3).neighbours(4)
    (1, 3, 5)
    """
    shape = count(rows, "rows"), count(columns, "columns")
    number_of = np.arange(shape[0] * shape[1]).reshape(shape)
    first = np.concatenate([number_of[:, :-1].ravel(), number_of[:-1].ravel()])
    second = np.concatenate([number_of[:, 1:].ravel(), number_of[1:].ravel()])
    return _both_ways(number_of.size, first, second)


def complete(agents: int) -> Graph:
    """Everybody hears everybody.

    >>> complete(4).degrees
    array([3., 3., 3., 3.])
    """
    size = count(agents, "agents")
    return _both_ways(size, *np.triu_indices(size, 1))


def random(
    agents: int, probability: float, *, rng: np.random.Generator, directed: bool = False
) -> Graph:
    """Each pair of agents is linked with the given probability; it may fall apart.

    Parameters
    ----------
    agents : int
        Number A of agents.
    probability : float
        Of each link, in [0, 1].
    rng : numpy.random.Generator
        Source of the draw.
    directed : bool
        Draw both directions apart.

    Examples
    --------
    >>> random(6, 1.0, rng=np.random.default_rng(0)).connected
    True
    """
    size = count(agents, "agents")
    p = number(probability, "probability", at_least=0, at_most=1)
    source, rows = generator(rng), max(1, _BLOCK // size)
    instance(directed, "directed", bool)
    found = []
    for start in range(0, size, rows):
        block = np.argwhere(source.random((min(rows, size - start), size)) < p)
        found.append(block + [start, 0])
    i, j = np.concatenate(found).T
    if not directed:
        return _both_ways(size, i[i < j], j[i < j])
    return Graph(linked(size, np.stack([i[i != j], j[i != j]], axis=1)))


def disk(positions: ArrayLike, radius: float) -> Graph:
    """Agents hear each other within a distance: the graph of radios of one range.

    Parameters
    ----------
    positions : array_like, (A, p)
        Where the agents are.
    radius : float
        The range, in the positions' unit, positive; the distance itself still counts as heard.

    Notes
    -----
    A k-d tree finds the pairs, so that 10 000 moving agents cost milliseconds a step.

    Examples
    --------
    >>> disk([[0.0, 0.0], [1.0, 0.0], [5.0, 0.0]], 2.0).degrees
    array([1., 1., 0.])
    """
    from scipy.spatial import cKDTree

    places = array(positions, "positions", ("A", "p"))
    if places.size == 0:
        raise ValueError(f"positions: needs at least one agent, got shape {places.shape}")
    if np.abs(places).max() > 1e150:
        raise ValueError(f"positions: needs finite squares, got {np.abs(places).max():g}")
    reach = number(radius, "radius", above=0)
    pairs = cKDTree(places).query_pairs(reach, output_type="ndarray").astype(np.int64)
    return _both_ways(len(places), pairs[:, 0], pairs[:, 1])
