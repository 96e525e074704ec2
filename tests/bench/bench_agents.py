"""What grows with the number of agents: a step of the filters, averaging, spectra, weights.

A step of an ensemble filter on a row of agents, where each hears two others whatever the number,
should grow in proportion: fails above a slope of 1.3 in logarithms. A thousand agents with about
six neighbours each and a dozen kinds of sensors, d = 6, with covariance intersection by every rule:
at most 0.12 s a step. A hundred thousand agents: `combine`, `largest_gain` and `balanced` with
links one way, at most 1 s each in a process of its own that never needs more than 500 MB, graph and
packages included. Writes data/bench/agents.csv and data/bench/scale.csv.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context
from typing import Any

import numpy as np
from _bench import timed, write
from scipy.spatial import cKDTree

from distfilt.filters import EnsembleFilter, GaussianFilter
from distfilt.models import clohessy_wiltshire
from distfilt.network import (
    Channel,
    Graph,
    covariance_intersection,
    graphs,
    intersection,
    pull,
    weights,
)
from distfilt.sensors import direct
from distfilt.updates import known_noise, transport

AGENTS, RUNS, MEMBERS, LIMIT = (4, 8, 16, 32, 64), 10, 200, 1.3
FILTERS: dict[str, tuple[Any, Any]] = {
    "affine map, pull": (transport, partial(pull, gain=0.05)),
    "known noise, intersection": (known_noise, partial(intersection, rule="equal")),
}
MANY, RULES, STEP_S = 1000, ("equal", "trace", "determinant", "min_trace", "min_determinant"), 0.12
VERY_MANY, SECONDS, MEGABYTES = 100_000, 1.0, 500.0


def step_ms(agents: int, update: Any, agreement: Any) -> float:
    """Milliseconds of one step of a batch of runs."""
    sensors = [direct([k % 6], std=0.2) for k in range(agents)]
    model = clohessy_wiltshire(rate=0.1, sigma=0.2)
    f = EnsembleFilter(
        model, sensors, graphs.path(agents), update=update, agreement=agreement, members=MEMBERS
    )
    state = f.start((np.zeros(6), 25 * np.eye(6)), rng=np.random.default_rng(1), runs=(RUNS,))
    seen = [np.zeros(1)] * agents
    return 1e3 * timed(lambda: f.step(state, 0.1, seen), 5).cpu


def many_rows() -> tuple[list[dict[str, Any]], int]:
    """A step of a thousand agents, seconds of processor time."""
    places = np.random.default_rng(1).random((MANY, 2))
    graph = graphs.disk(places, float(np.sqrt(6 / np.pi / MANY)))
    kinds = [direct([k], std=0.2) for k in range(6)]
    kinds += [direct([k, (k + 1) % 6], std=0.2) for k in range(6)]
    sensors = [kinds[k % 12] for k in range(MANY)]
    model = clohessy_wiltshire(rate=0.1, sigma=0.2)
    seen = [np.zeros(s.dim) for s in sensors]
    rows, missed = [], 0
    for name in ("Gaussian", "ensemble, 50 members"):
        for rule in RULES:
            if name == "Gaussian":
                f: Any = GaussianFilter(
                    model, sensors, graph, agreement=partial(covariance_intersection, rule=rule)
                )
            else:
                f = EnsembleFilter(
                    model, sensors, graph, update=known_noise, members=50,
                    agreement=partial(intersection, rule=rule),
                )  # fmt: skip
            state = f.start((np.zeros(6), 25 * np.eye(6)), rng=np.random.default_rng(2))
            state = f.step(state, 0.1, seen)
            spent = timed(lambda f=f, s=state: f.step(s, 0.2, seen), 5)
            missed += spent.cpu > STEP_S
            rows.append({
                "what": f"a step, {name}, {rule}", "agents": MANY, "seconds": f"{spent.cpu:.3f}",
                "limit_s": STEP_S, "peak_mb": f"{spent.peak_mb:.0f}", "limit_mb": "",
            })
    return rows, missed


def one_way(kind: str) -> Graph:
    """Very many agents that need not hear who hears them.

    A ring with chords and a link to anybody; or agents in the plane with a range of their own.
    """
    rng, ring = np.random.default_rng(3), np.arange(VERY_MANY)
    if kind == "chords":
        anybody = rng.integers(VERY_MANY, size=VERY_MANY)
        heard = [np.roll(ring, -1), (7919 * ring + 13) % VERY_MANY, anybody]
        edges = np.concatenate([np.stack([ring, who], axis=1) for who in heard])
        return Graph.from_edges(VERY_MANY, edges[edges[:, 0] != edges[:, 1]], directed=True)
    places = rng.random((VERY_MANY, 2))
    reach = np.sqrt(rng.uniform(8, 16, VERY_MANY) / np.pi / VERY_MANY)
    found = cKDTree(places).query_ball_point(places, reach)
    edges = np.stack([np.repeat(ring, [len(f) for f in found]), np.concatenate(found)], axis=1)
    graph = Graph.from_edges(VERY_MANY, edges[edges[:, 0] != edges[:, 1]], directed=True)
    here = graph.components == np.bincount(graph.components).argmax()
    part = np.cumsum(here) - 1
    kept = edges[here[edges].all(axis=1) & (edges[:, 0] != edges[:, 1])]
    return Graph.from_edges(int(here.sum()), part[kept], directed=True)


def large(what: str) -> tuple[int, float, float]:
    """Agents, seconds, and peak MB of the process, of one operation on very many of them."""
    if what.startswith("balanced"):
        graph = one_way(what.split(", ")[1])
    else:
        places = np.random.default_rng(3).random((VERY_MANY, 2))
        graph = graphs.disk(places, float(np.sqrt(10 / np.pi / VERY_MANY)))
    averaging = weights.push(graph) if graph.directed else weights.metropolis(graph)
    values = np.random.default_rng(4).standard_normal((VERY_MANY, 6))
    calls: dict[str, Callable[[], Any]] = {
        "combine": lambda: Channel(graph).combine(values, averaging),
        "largest_gain": lambda: graph.largest_gain,
        "balanced": lambda: weights.balanced(graph),
    }
    spent = timed(calls[what.split(",")[0]], 1)
    return graph.size, spent.cpu, spent.peak_mb


def large_rows() -> tuple[list[dict[str, Any]], int]:
    rows, missed = [], 0
    for what in ("combine", "largest_gain", "balanced, chords", "balanced, ranges"):
        with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
            agents, seconds, megabytes = pool.submit(large, what).result()
        missed += seconds > SECONDS or megabytes > MEGABYTES
        rows.append({
            "what": what, "agents": agents, "seconds": f"{seconds:.3f}", "limit_s": SECONDS,
            "peak_mb": f"{megabytes:.0f}", "limit_mb": f"{MEGABYTES:g}",
        })
    return rows, missed


def main() -> int:
    """Measure, write the tables, and count what is missed."""
    rows, missed = [], 0
    for name, (update, agreement) in FILTERS.items():
        spent = [step_ms(a, update, agreement) for a in AGENTS]
        slope = np.polyfit(np.log(AGENTS), np.log(spent), 1)[0]
        missed += slope > LIMIT
        rows += [
            {"filter": name, "agents": a, "runs": RUNS, "step_ms": f"{ms:.1f}",
             "slope": f"{slope:.2f}", "limit": LIMIT}
            for a, ms in zip(AGENTS, spent, strict=True)
        ]
    write("agents", rows, ("numpy", "scipy"))
    many, large_ones = many_rows(), large_rows()
    write("scale", [*many[0], *large_ones[0]], ("numpy", "scipy"))
    return int(missed) + many[1] + large_ones[1]


if __name__ == "__main__":
    sys.exit(main())
