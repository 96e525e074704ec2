"""The channel against the bare sparse product, and graphs of many moving agents.

Writes data/bench/channel.csv and data/bench/graphs.csv. A hundred lossless rounds through the
channel are held against a hundred products of the same matrix with the same values, and fail above
1.3 times their time. A single round checks its values first, which costs a few microseconds; it is
shown too.
"""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
from _bench import interleaved, timed, write

from distfilt.network import Channel, Faults, Graph, graphs, weights

LIMIT, ROUNDS = 1.3, 100
SIZES = (100, 1000, 10_000)


def moving(agents: int, step: int = 0) -> np.ndarray:
    """Places in the unit square, moved a little with each step."""
    rng = np.random.default_rng(agents)
    places, drift = rng.random((agents, 2)), rng.standard_normal((agents, 2))
    return (places + 0.001 * step * drift) % 1.0


def radius(agents: int) -> float:
    """A range that gives about ten neighbours."""
    return float(np.sqrt(10 / (np.pi * agents)))


def channel_rows() -> tuple[list[dict[str, Any]], int]:
    """The channel's combine against ``matrix @ values``, without loss and with 10%."""
    rows, missed = [], 0
    cases = [(5, 100), (5, 10_000), *((n, 128) for n in SIZES)]
    for agents, k in cases:
        graph = graphs.star(5) if agents == 5 else graphs.disk(moving(agents), radius(agents))
        w = weights.metropolis(graph)
        values = np.random.default_rng(1).standard_normal((agents, k))
        whole, lossy = Channel(graph), Channel(graph, faults=Faults(loss=0.1, seed=1))
        matrix = w.matrix
        rounds = ROUNDS if agents * k < 1e5 else 10

        def products(m: Any = matrix, v: Any = values, n: int = rounds) -> Any:
            for _ in range(n):
                v = m @ v
            return v

        many, ratios = interleaved({
            "bare": products, "channel": lambda c=whole, v=values, w=w, n=rounds: c.combine(
                v, w, rounds=n)})  # fmt: skip
        one = interleaved({
            "bare": lambda m=matrix, v=values: m @ v,
            "channel": lambda c=whole, v=values, w=w: c.combine(v, w)})[1]["channel"]  # fmt: skip
        ours, bare, ratio = many["channel"], many["bare"], ratios["channel"]
        lost = timed(lambda c=lossy, v=values, w=w: c.combine(v, w), 5).cpu
        missed += ratio > LIMIT
        rows.append({
            "agents": agents, "values": k, "product_us": f"{bare / rounds * 1e6:.1f}",
            "channel_us": f"{ours / rounds * 1e6:.1f}", "ratio": f"{ratio:.2f}", "limit": LIMIT,
            "ratio_of_one_checked_round": f"{one:.2f}", "ten_percent_loss_us": f"{lost * 1e6:.0f}",
        })
    return rows, missed


def graph_rows() -> list[dict[str, Any]]:
    """Building a disk graph, and what follows from it, against networkx."""
    import networkx as nx

    rows = []
    for agents in SIZES:
        places, reach = moving(agents), radius(agents)
        build = timed(lambda p=places, r=reach: graphs.disk(p, r), 5)
        graph: Graph = build.result
        points = dict(enumerate(places))

        def theirs(n: int = agents, r: float = reach, pos: Any = points) -> Any:
            return nx.random_geometric_graph(n, r, pos=pos)

        parts = timed(lambda p=places, r=reach: graphs.disk(p, r).components, 5)
        metro = timed(lambda g=graph: weights.metropolis(g), 5)
        fiedler = timed(lambda p=places, r=2 * reach: graphs.disk(p, r).fiedler_value, 3)
        rows.append({
            "agents": agents, "links": graph.senders.size // 2,
            "disk_ms": f"{build.cpu * 1e3:.2f}",
            "networkx_disk_ms": f"{timed(theirs, 3).cpu * 1e3:.2f}",
            "components_ms": f"{(parts.cpu - build.cpu) * 1e3:.2f}",
            "metropolis_ms": f"{metro.cpu * 1e3:.2f}",
            "fiedler_ms": f"{fiedler.cpu * 1e3:.1f}",
        })
    return rows


def main() -> int:
    """Measure, write both tables, and count what is missed."""
    rows, missed = channel_rows()
    write("channel", rows, ("numpy", "scipy"))
    write("graphs", graph_rows(), ("numpy", "scipy", "networkx"))
    return int(missed)


if __name__ == "__main__":
    sys.exit(main())
