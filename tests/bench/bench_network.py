"""The channel against the bare sparse product, graphs of moving agents, and what grows with them.

A hundred lossless rounds through the channel are held against a hundred products of the same matrix
with the same values, and miss above 1.3 times their time. A single round checks its values first,
which costs a few microseconds; it is shown too.

A step of an ensemble filter on a row of agents, where each hears two others whatever the number,
should grow in proportion: misses above a slope of 1.3 in logarithms. A thousand agents with about
six neighbours each and a dozen kinds of sensors, d = 6, with covariance intersection by every rule:
at most 0.12 s a step. A hundred thousand agents: `combine`, `largest_gain` and `balanced` with
links one way, at most 1 s each in a process of its own that never needs more than 500 MB, graph and
packages included.
"""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from multiprocessing import get_context
from typing import Any

import numpy as np
from _bench import Row, interleaved, main, table, timed
from scipy.spatial import cKDTree

from distfilt.filters import EnsembleFilter, GaussianFilter
from distfilt.models import clohessy_wiltshire
from distfilt.network import (
    Channel,
    Faults,
    Graph,
    covariance_intersection,
    graphs,
    intersection,
    pull,
    weights,
)
from distfilt.sensors import direct
from distfilt.updates import known_noise, transport

LIMIT, ROUNDS = 1.3, 100
SIZES = (100, 1000, 10_000)
AGENTS, RUNS, MEMBERS = (4, 8, 16, 32, 64), 10, 200
FILTERS: dict[str, dict[str, Any]] = {
    "affine map, pull": {"update": transport, "agreement": partial(pull, gain=0.05)},
    "known noise, intersection": {
        "update": known_noise, "agreement": partial(intersection, rule="equal")},
}  # fmt: skip
MODEL, PRIOR = clohessy_wiltshire(rate=0.1, sigma=0.2), (np.zeros(6), 25 * np.eye(6))
MANY, RULES, STEP_S = 1000, ("equal", "trace", "determinant", "min_trace", "min_determinant"), 0.12
VERY_MANY, SECONDS, MEGABYTES = 100_000, 1.0, 500.0


def spread(agents: int, neighbours: float = 10) -> tuple[np.ndarray, float]:
    """Places in the unit square, and a range that gives about so many neighbours."""
    places = np.random.default_rng(agents).random((agents, 2))
    return places, float(np.sqrt(neighbours / np.pi / agents))


@table("channel")
def channels() -> Iterator[Row]:
    """The channel's combine against ``matrix @ values``, without loss and with 10%."""
    for agents, k in ((5, 100), (5, 10_000), *((n, 128) for n in SIZES)):
        graph = graphs.star(5) if agents == 5 else graphs.disk(*spread(agents))
        w = weights.metropolis(graph)
        values = np.random.default_rng(1).standard_normal((agents, k))
        whole, lossy = Channel(graph), Channel(graph, faults=Faults(loss=0.1, seed=1))
        rounds = ROUNDS if agents * k < 1e5 else 10

        def products(m: Any = w.matrix, v: Any = values, n: int = rounds) -> Any:
            for _ in range(n):
                v = m @ v
            return v

        through = partial(whole.combine, values, w)
        many, ratios = interleaved({"bare": products, "channel": partial(through, rounds=rounds)})
        one = interleaved({"bare": partial(products, n=1), "channel": through})[1]["channel"]
        ours, bare = (many[name] / rounds * 1e6 for name in ("channel", "bare"))
        yield {
            "agents": agents, "values": k, "product_us": f"{bare:.1f}", "channel_us": f"{ours:.1f}",
            "ratio": f"{ratios['channel']:.2f}", "limit": LIMIT,
            "ratio_of_one_checked_round": f"{one:.2f}",
            "ten_percent_loss_us": f"{timed(partial(lossy.combine, values, w), 5).cpu * 1e6:.0f}",
            "missed": ratios["channel"] > LIMIT,
        }


@table("graphs", "numpy", "scipy", "networkx")
def moving() -> Iterator[Row]:
    """Building a disk graph, and what follows from it, against networkx."""
    import networkx as nx

    for agents in SIZES:
        p, r = spread(agents)
        build = timed(partial(graphs.disk, p, r), 5)
        theirs = partial(nx.random_geometric_graph, agents, r, pos=dict(enumerate(p)))
        parts = timed(lambda p=p, r=r: graphs.disk(p, r).components, 5).cpu - build.cpu
        found = {
            "disk_ms": build.cpu, "networkx_disk_ms": timed(theirs, 3).cpu, "components_ms": parts,
            "metropolis_ms": timed(partial(weights.metropolis, build.result), 5).cpu,
            "fiedler_ms": timed(lambda p=p, r=2 * r: graphs.disk(p, r).fiedler_value, 3).cpu,
        }
        links = build.result.senders.size // 2
        yield {"agents": agents, "links": links} | {k: f"{1e3 * s:.2f}" for k, s in found.items()}


@table("agents")
def steps() -> Iterator[Row]:
    """A step of a batch of runs."""
    for name, options in FILTERS.items():
        spent = []
        for agents in AGENTS:
            sensors = [direct([k % 6], std=0.2) for k in range(agents)]
            f = EnsembleFilter(MODEL, sensors, graphs.path(agents), members=MEMBERS, **options)
            state = f.start(PRIOR, rng=np.random.default_rng(1), runs=(RUNS,))
            spent.append(timed(partial(f.step, state, 0.1, [np.zeros(1)] * agents), 5).cpu)
        slope = np.polyfit(np.log(AGENTS), np.log(spent), 1)[0]
        for a, s in zip(AGENTS, spent, strict=True):
            yield {"filter": name, "agents": a, "runs": RUNS, "step_ms": f"{1e3 * s:.1f}",
                   "slope": f"{slope:.2f}", "limit": LIMIT,
                   "missed": a == AGENTS[-1] and slope > LIMIT}  # fmt: skip


def scaled(what: str, agents: int, spent: Any, seconds: float, memory: float = np.inf) -> Row:
    """One line of the table of many agents."""
    return {
        "what": what, "agents": agents, "seconds": f"{spent.cpu:.3f}", "limit_s": seconds,
        "peak_mb": f"{spent.peak_mb:.0f}", "limit_mb": f"{memory:g}" if memory < np.inf else "",
        "missed": spent.cpu > seconds or spent.peak_mb > memory,
    }  # fmt: skip


@table("scale")
def many() -> Iterator[Row]:
    """A step of a thousand agents, and operations on very many."""
    kinds = [direct([k], std=0.2) for k in range(6)]
    kinds += [direct([k, (k + 1) % 6], std=0.2) for k in range(6)]
    sensors, graph = [kinds[k % 12] for k in range(MANY)], graphs.disk(*spread(MANY, 6))
    seen = [np.zeros(s.dim) for s in sensors]
    for rule in RULES:
        ours = partial(covariance_intersection, rule=rule), partial(intersection, rule=rule)
        for name, f in (
            ("Gaussian", GaussianFilter(MODEL, sensors, graph, agreement=ours[0])),
            ("ensemble, 50 members", EnsembleFilter(
                MODEL, sensors, graph, update=known_noise, members=50, agreement=ours[1])),
        ):  # fmt: skip
            state = f.step(f.start(PRIOR, rng=np.random.default_rng(2)), 0.1, seen)
            spent = timed(partial(f.step, state, 0.2, seen), 5)
            yield scaled(f"a step, {name}, {rule}", MANY, spent, STEP_S)
    for what in ("combine", "largest_gain", "balanced, chords", "balanced, ranges"):
        with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
            agents, spent = pool.submit(large, what).result()
        yield scaled(what, agents, spent, SECONDS, MEGABYTES)


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


def large(what: str) -> tuple[int, Any]:
    """Agents, and what one operation on very many of them takes."""
    kind = what.partition(", ")[2]
    graph = one_way(kind) if kind else graphs.disk(*spread(VERY_MANY))
    averaging = weights.push(graph) if graph.directed else weights.metropolis(graph)
    values = np.random.default_rng(4).standard_normal((VERY_MANY, 6))
    calls = {
        "combine": lambda: Channel(graph).combine(values, averaging),
        "largest_gain": lambda: graph.largest_gain,
        "balanced": lambda: weights.balanced(graph),
    }
    return graph.size, replace(timed(calls[what.split(",")[0]], 1), result=None)


if __name__ == "__main__":
    main()
