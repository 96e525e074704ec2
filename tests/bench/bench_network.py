"""Filters on many agents, and operations on very many.

A thousand agents with about six neighbours each and a dozen kinds of sensors, d = 6,
with covariance intersection by every rule: at most 0.12 s a step; ten thousand, by the
most expensive rule: at most 1 s. A hundred thousand agents: `Channel.mix`,
`max_stable_gain` and `doubly_stochastic` on a directed graph, at most 1 s each in a
process of its own that needs at most 500 MB, graph and packages included. Importing the
filters takes at most 1.3 times as long as importing scipy.linalg.
"""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from multiprocessing import get_context
from typing import Any

import numpy as np
from _bench import Row, Timing, main, measure_time, table
from scipy.spatial import cKDTree

from distfilt.filters import EnsembleFilter, GaussianFilter
from distfilt.models import clohessy_wiltshire
from distfilt.network import (
    Channel,
    Graph,
    covariance_intersection,
    graphs,
    intersect_ensembles,
    weights,
)
from distfilt.sensors import component
from distfilt.updates import enkf

MODEL = clohessy_wiltshire(rate=0.1, sigma=0.2)
PRIOR = (np.zeros(6), 25 * np.eye(6))
MANY = 1000
RULES = ("equal", "trace", "determinant", "min_trace", "min_determinant")
STEP_S = 0.12
VERY_MANY = 100_000
SECONDS = 1.0
MEGABYTES = 500.0


def spread(agents: int, neighbours: float = 10) -> tuple[np.ndarray, float]:
    """Return positions in the unit square, and a range that gives about that many neighbours."""
    places = np.random.default_rng(agents).random((agents, 2))
    # A disk of radius r holds about π r² A of A agents in the unit square.
    return places, float(np.sqrt(neighbours / np.pi / agents))


def scale_row(
    operation: str, agents: int, spent: Any, seconds: float, memory: float = np.inf
) -> Row:
    """One line of the table of many agents."""
    return {
        "what": operation,
        "agents": agents,
        "seconds": f"{spent.cpu:.3f}",
        "limit_s": f"{seconds:.3g}",
        "peak_mb": f"{spent.peak_mb:.0f}",
        "limit_mb": f"{memory:g}" if memory < np.inf else "",
        "missed": spent.cpu > seconds or spent.peak_mb > memory,
    }


@table("scale")
def many() -> Iterator[Row]:
    """A step of a thousand agents, and operations on very many."""
    kinds = [component([k], std=0.2) for k in range(6)]
    kinds += [component([k, (k + 1) % 6], std=0.2) for k in range(6)]
    for agents, rule in [
        *((MANY, rule) for rule in RULES),
        (10 * MANY, "min_determinant"),
    ]:
        sensors = [kinds[k % 12] for k in range(agents)]
        graph = graphs.disk(*spread(agents, 6))
        seen = [np.zeros(s.dim) for s in sensors]
        limit = STEP_S if agents == MANY else SECONDS
        ours = partial(covariance_intersection, rule=rule)
        options = {
            "update": enkf,
            "members": 50,
            "fusion": partial(intersect_ensembles, rule=rule),
        }
        for name, f in (
            ("Gaussian", GaussianFilter(MODEL, sensors, graph, fusion=ours)),
            ("ensemble, 50 members", EnsembleFilter(MODEL, sensors, graph, **options)),
        ):
            # The first step fills caches: the second one is timed.
            state = f.step(f.start(PRIOR, rng=np.random.default_rng(2)), 0.1, seen)
            spent = measure_time(partial(f.step, state, 0.2, seen), 5)
            yield scale_row(f"a step, {name}, {rule}", agents, spent, limit)
    # A process of its own, so that its peak memory is that of one operation
    for operation in ("combine", "max_stable_gain", "balanced"):
        with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
            agents, spent = pool.submit(measure_operation, operation).result()
        yield scale_row(operation, agents, spent, SECONDS, MEGABYTES)
    theirs, ours = import_times("scipy.linalg", "distfilt.filters")
    yield scale_row(
        "import of distfilt.filters", 0, Timing(ours, np.nan, None), 1.3 * theirs
    )


def import_times(*names: str) -> list[float]:
    """Return the time of a process that imports each module, in s: medians of fifteen, in turns."""
    # In turns, so that a disturbance of the machine meets both imports.
    taken: dict[str, list[float]] = {name: [] for name in names}
    for name in names * 15:
        began = time.perf_counter()
        subprocess.run([sys.executable, "-c", f"import {name}"], check=True)
        taken[name].append(time.perf_counter() - began)
    return [float(np.median(times)) for times in taken.values()]


def one_way() -> Graph:
    """Return a directed graph of very many agents in the plane, each with a range of its own."""
    rng = np.random.default_rng(3)
    places = rng.random((VERY_MANY, 2))
    reach = np.sqrt(rng.uniform(8, 16, VERY_MANY) / np.pi / VERY_MANY)
    neighbours = cKDTree(places).query_ball_point(places, reach)
    receivers = np.repeat(np.arange(VERY_MANY), [len(f) for f in neighbours])
    edges = np.stack([receivers, np.concatenate(neighbours)], axis=1)
    edges = edges[edges[:, 0] != edges[:, 1]]
    # Balanced weights need a strongly connected graph: the largest component is kept.
    parts = Graph.from_edges(VERY_MANY, edges, directed=True).components
    in_largest = parts == np.bincount(parts).argmax()
    renumbered = (np.cumsum(in_largest) - 1)[edges[in_largest[edges].all(axis=1)]]
    return Graph.from_edges(int(in_largest.sum()), renumbered, directed=True)


def measure_operation(operation: str) -> tuple[int, Any]:
    """Return the number of agents, and the time and memory of one operation on them."""
    graph = one_way() if operation == "balanced" else graphs.disk(*spread(VERY_MANY))
    averaging = (
        weights.column_stochastic(graph)
        if graph.is_directed
        else weights.metropolis(graph)
    )
    values = np.random.default_rng(4).standard_normal((VERY_MANY, 6))
    calls = {
        "combine": lambda: Channel(graph).mix(values, averaging),
        "max_stable_gain": lambda: graph.max_stable_gain,
        "balanced": lambda: weights.doubly_stochastic(graph),
    }
    return graph.n_agents, replace(measure_time(calls[operation], 1), result=None)


if __name__ == "__main__":
    main()
