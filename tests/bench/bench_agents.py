"""What grows with the number of agents: a step of the filters, averaging, spectra, weights.

A step of an ensemble filter on a row of agents, where each hears two others whatever the number,
should grow in proportion: fails above a slope of 1.3 in logarithms. A thousand agents with about
six neighbours each and a dozen kinds of sensors, d = 6, with covariance intersection by every rule:
at most 0.12 s a step for the rules in closed form. A hundred thousand agents: `combine`,
`largest_gain` and `balanced`, at most 1 s and 500 MB each, in a process of its own. Writes
data/bench/agents.csv and data/bench/scale.csv.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context
from typing import Any

import numpy as np
from _bench import peak_mb, timed, write

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
            limit = None if rule.startswith("min") else STEP_S
            missed += limit is not None and spent.cpu > limit
            rows.append({
                "what": f"a step, {name}, {rule}", "agents": MANY, "seconds": f"{spent.cpu:.3f}",
                "limit_s": limit or "", "peak_mb": f"{spent.peak_mb:.0f}", "limit_mb": "",
            })
    return rows, missed


def large(what: str) -> tuple[float, float]:
    """Seconds, and MB beyond those of the graph, of one operation on very many agents."""
    places = np.random.default_rng(3).random((VERY_MANY, 2))
    graph = graphs.disk(places, float(np.sqrt(10 / np.pi / VERY_MANY)))
    if what == "balanced":  # one way only: a ring with chords
        ring = np.arange(VERY_MANY)
        chords = np.stack([ring, (7919 * ring + 13) % VERY_MANY], axis=1)
        edges = np.concatenate([np.stack([ring, np.roll(ring, -1)], axis=1), chords])
        graph = Graph.from_edges(VERY_MANY, edges[edges[:, 0] != edges[:, 1]], directed=True)
    averaging = weights.push(graph) if graph.directed else weights.metropolis(graph)
    values = np.random.default_rng(4).standard_normal((VERY_MANY, 6))
    before = peak_mb()
    calls: dict[str, Callable[[], Any]] = {
        "combine": lambda: Channel(graph).combine(values, averaging),
        "largest_gain": lambda: graph.largest_gain,
        "balanced": lambda: weights.balanced(graph),
    }
    spent = timed(calls[what], 1)
    return spent.cpu, spent.peak_mb - before


def large_rows() -> tuple[list[dict[str, Any]], int]:
    rows, missed = [], 0
    for what in ("combine", "largest_gain", "balanced"):
        with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
            seconds, megabytes = pool.submit(large, what).result()
        missed += seconds > SECONDS or megabytes > MEGABYTES
        rows.append({
            "what": what, "agents": VERY_MANY, "seconds": f"{seconds:.3f}", "limit_s": SECONDS,
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
