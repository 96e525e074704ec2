"""Figs. 1 and 2 of Zheng and Lin with the printed gains, larger ones, and explicit steps, six runs.

Consensus starts where the filters start, at the flat Gaussian; slow interpretation of
(23) from a uniform and from a peaked density, and the fast one from a uniform density.
Gains are as printed, with six and ten times b, and with ten times a. Each is tried with
as many substeps as stability needs (``flat``), and with the explicit step of 0.1 s that
the paper names (``explicit``). Beside them the nulls: agents that do not communicate
(``silent``), filters of zero gain from the flat Gaussian (``zero``) and from the first
kernel estimate (``open``); and filters that start as the local ones and observe all
agents (``central_flat``). The printed gains and that observer run with a smaller and a
larger prior too. All other filters of a case share one basis, so that all of them cost
little more than one; the agents of the uniform case are those of `locals`.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
import _swarm as swarm
import locals as figure

from distfilt import density
from distfilt.network import Channel, Graph, graphs, stable_substeps

NAME = "tenfold"
PAPER = "zheng"
CHOICES = swarm.CHOICES
DT = swarm.SWARM["dt"]
CASES = {
    "uniform": figure.CASE,
    "peaked": replace(figure.CASE, start="peaked"),
    "fast_law": swarm.Case(
        interpretation="gibbs", end=float(swarm.densities.choice("end_times", "gibbs"))
    ),
}
GAINS = {
    "paper": swarm.PAPERS,
    "six": swarm.SIXFOLD,
    "fast": swarm.FAST,
    "stiff": swarm.STIFF,
}
"""Printed gains, six times b, ten times b, ten times a."""
FLAT = tuple(f"{name}_flat" for name in GAINS)
EXPLICIT = tuple(f"{name}_explicit" for name in GAINS)
EIGHT = np.arange(swarm.LOCAL)
ROWS = {
    "central": EIGHT[:1],
    "central_flat": EIGHT,
    **dict.fromkeys((*FLAT, *EXPLICIT), EIGHT),
    "silent": EIGHT,
}
"""By name: the agents whose filters are in it."""
# Factors of the prior's standard deviation, for the observer and for the printed gains
PRIORS = {"small_prior": 0.3, "large_prior": 3.0}
VARIED = tuple(f"{who}_{prior}" for prior in PRIORS for who in ("central", "paper"))
NULLS = ("zero", "open")
KINDS = ("error", "ratio", "falls", "last", "below", "start", "caught")
# An estimate beyond this size has diverged: coefficients of a kernel are below 2.
DIVERGED = 1e6
# Errors at these times, in s, of the observer, of a filter of zero gain, and of agents
MARKS = (0, 1, 2, 5, 10, 20, 30)
CURVES = ("central_flat", "zero", "paper_flat")
EIGENVALUES = ("least", "median", "largest")
columns = [f"{key}_kde" for key in CASES]
columns += [
    f"{key}_{s}_{k}" for key in CASES for s in (*ROWS, *NULLS, *VARIED) for k in KINDS
]
columns += [f"{key}_{s}_at_{t}" for key in CASES for s in CURVES for t in MARKS]
columns += [f"{key}_eigenvalue_{k}" for key in CASES for k in EIGENVALUES]
columns += [
    f"{key}_{s}_{k}"
    for key in CASES
    for s in EXPLICIT
    for k in ("unstable_share", "diverged_after")
]
parameters = {
    "seed": CHOICES["seed"],
    "local": swarm.LOCAL,
    "rank": CHOICES["low_rank"],
}
seeds = figure.seeds
scenarios = swarm.scenarios
rtol = 1e-4


def gains_of(scheme: str) -> dict[str, float]:
    """Return a scheme's gains; the first part of its name chooses them."""
    return GAINS.get(scheme.split("_")[0], swarm.PAPERS)


def consensus(
    nu: np.ndarray, eta: np.ndarray, z: np.ndarray, graph: Graph | None, scheme: str
) -> tuple[np.ndarray, np.ndarray]:
    """One step of (16) on cosine coefficients, (agents, modes), without a graph for the silent.

    The library's `pi_step` in plain numpy: its ledger would take most of the time here.
    """
    gains = gains_of(scheme)
    if graph is None:
        return nu + DT * gains["alpha"] * (z - nu), eta
    laplacian = graph.laplacian.toarray()
    # Substeps keep the explicit scheme stable for large gains.
    steps = 1 if scheme in EXPLICIT else stable_substeps(Channel(graph), DT, **gains)
    h = DT / steps
    for _ in range(steps):
        difference = laplacian @ nu
        integral = gains["b"] * (laplacian @ eta)
        # ν' = α (z - ν) - a L ν + b L η and η' = -b L ν
        rate = gains["alpha"] * (z - nu) - gains["a"] * difference + integral
        nu = nu + h * rate
        eta = eta - h * gains["b"] * difference
    return nu, eta


def amplification(eigenvalue: float, scheme: str) -> float:
    """Return the largest factor of a mode of (16) in one explicit step: above 1 it grows."""
    gains = gains_of(scheme)
    # The matrix of a mode with this eigenvalue of the Laplacian
    coupling = gains["b"] * eigenvalue
    matrix = [[-gains["alpha"] - gains["a"] * eigenvalue, coupling], [-coupling, 0]]
    return float(np.abs(1 + DT * np.linalg.eigvals(matrix)).max())


def exchange(
    memories: dict[str, tuple[np.ndarray, np.ndarray]], z: np.ndarray, graph: Graph
) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Advance the consensus of all schemes by a step; a diverged one stays as it is."""
    advanced = dict(memories)
    for scheme, (nu, eta) in memories.items():
        # The powers of a diverged estimate would overflow.
        if np.abs(nu).max() < DIVERGED:
            links = None if scheme == "silent" else graph
            advanced[scheme] = consensus(nu, eta, z, links, scheme)
    return advanced


def start_filters(
    case: swarm.Case, x: np.ndarray, flat: np.ndarray
) -> dict[str, density.LowRank]:
    """Return all filters before the first step: the main ones, and two with each prior."""
    cells = case.grid
    basis = density.zero_mean_prior(
        cells,
        rank=int(CHOICES["low_rank"]),
        length=CHOICES["prior_length"],
        std=CHOICES["prior_std"],
    )
    # The observer of (8) starts at the kernel estimate, all others at flat Gaussians.
    first = density.kernel_density(x, cells, bandwidth=case.bandwidth)
    means = [first[None] if s == "central" else flat[who] for s, who in ROWS.items()]
    states = {"main": density.low_rank_start(basis, np.concatenate(means))}
    # The observer's filters and then the agents', from the same starts
    both = np.tile(flat[EIGHT], (2, 1))
    for name, factor in PRIORS.items():
        states[name] = density.low_rank_start(factor * basis, both)
    return states


def errors(case: swarm.Case, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Return L2 errors over time, (T + 1, filters), from the start on.

    Further entries are the kernel estimate's error, the largest eigenvalue of the
    Laplacian, and the largest coefficient of each explicit scheme, all (T + 1,). A
    filter of zero gain is its prior mean, propagated.
    """
    cells = case.grid
    h = case.bandwidth
    law = swarm.densities.swarm(case.interpretation)
    model = density.FokkerPlanck(law, cells)
    x, p = swarm.draw_swarm(case, rng)
    waves = cells.cosines(swarm.MODES)
    squares = ((cells.centres - x[:, None]) ** 2).sum(axis=-1)
    # Each agent's flat Gaussian about its own position, cut off at the walls
    flat = cells.normalize(np.exp(-0.5 * squares / swarm.FLAT**2))
    # Consensus works on cosine coefficients of the kernels.
    wide = flat @ waves * cells.volume
    z = density.kernels(x, cells, bandwidth=h) @ waves * cells.volume
    start = wide, np.zeros_like(wide)
    memories = dict.fromkeys((*FLAT, *EXPLICIT, "silent"), start)
    states = start_filters(case, x, flat)
    k = density.kernel_constant(cells, bandwidth=h, agents=case.agents)
    y = density.kernel_density(x, cells, bandwidth=h)
    graph = graphs.disk(x, case.radio_range)
    rows = [measure(cells, states, p, y, graph, memories)]
    for j in range(round(case.end / DT)):
        x = law.step(x, j * DT, DT, rng=rng, substeps=CHOICES["substeps"])
        graph = graphs.disk(x, case.radio_range)
        # Estimates follow the average of the previous kernels.
        memories = exchange(memories, z, graph)
        z = density.kernels(x, cells, bandwidth=h) @ waves * cells.volume
        y = density.kernel_density(x, cells, bandwidth=h)
        observations = observe(memories, waves, y)
        # One Fokker-Planck step serves the truth and all filters.
        move = model.solver(j * DT, DT)
        p = move(p)
        for name, state in states.items():
            predicted = density.low_rank_predict(state, move)
            # R = k max(p̂, floor)
            noise = k * np.maximum(predicted.estimates, CHOICES["floor"])
            states[name] = density.low_rank_step(
                predicted, observations[name], noise, DT
            )
        rows.append(measure(cells, states, p, y, graph, memories))
    return {name: np.array([row[name] for row in rows]) for name in rows[0]}


def observe(
    memories: dict[str, tuple[np.ndarray, np.ndarray]], waves: np.ndarray, y: np.ndarray
) -> dict[str, np.ndarray]:
    """Return the observations of all filters, (filters, n): y, or an estimate of it."""
    main = []
    for scheme, who in ROWS.items():
        if scheme in memories:
            # Agents have their own estimate of y.
            main.append(memories[scheme][0][who] @ waves.T)
        else:
            main.append(np.tile(y, (len(who), 1)))
    observations = {"main": np.concatenate(main)}
    of_observers = np.tile(y, (len(EIGHT), 1))
    of_agents = memories["paper_flat"][0][EIGHT] @ waves.T
    for name in PRIORS:
        observations[name] = np.concatenate([of_observers, of_agents])
    return observations


def measure(
    cells: density.Grid,
    states: dict[str, density.LowRank],
    p: np.ndarray,
    y: np.ndarray,
    graph: Graph,
    memories: dict[str, tuple[np.ndarray, np.ndarray]],
) -> dict[str, np.ndarray | float]:
    """Return the errors of all filters at one time, and the size of explicit estimates."""
    # The filters' rows, split by scheme
    cuts = np.cumsum([len(who) for who in ROWS.values()])[:-1]
    main = states["main"]
    distances = np.split(cells.norm(main.estimates - p), cuts)
    measured = dict(zip(ROWS, distances, strict=True))
    # The prior means alone: filters of zero gain from both starts
    measured["zero"] = cells.norm(main.base[cuts[0] : cuts[1]] - p)
    measured["open"] = cells.norm(main.base[: cuts[0]] - p)
    for name in PRIORS:
        observer, agents = np.split(cells.norm(states[name].estimates - p), 2)
        measured[f"central_{name}"] = observer
        measured[f"paper_{name}"] = agents
    measured["kde"] = cells.norm(y - p)
    measured["eigenvalue"] = graph.laplacian_spectrum[-1]
    for scheme in EXPLICIT:
        measured[f"{scheme}_size"] = np.abs(memories[scheme][0]).max()
    return measured


def summarize(
    case: swarm.Case, error: np.ndarray, central: np.ndarray, level: float
) -> dict[str, float]:
    """Return the captions' quantities of one scheme, means over its filters."""
    # Without the start itself
    after = error[1:]
    k = round(5.0 / DT)
    first = after[:k].mean(axis=0)
    last = after[-k:].mean(axis=0)
    half = swarm.average(after, case, case.end / 2)
    half_central = swarm.average(central[1:], case, case.end / 2)
    start = float(error[0].mean())
    mean = error.mean(axis=1)
    return {
        "error": half.mean(),
        "ratio": (half / half_central).mean(),
        "falls": (last / first).mean(),
        "last": last.mean(),
        "start": start,
        # Below the kernel estimate for good; and besides below half of its own start
        "below": settles(mean, level),
        "caught": settles(mean, min(level, start / 2)),
    }


def settles(error: np.ndarray, level: float) -> float:
    """Return the time from which an error stays below a level; the end if it never does.

    The first error is that of the start, at 0 s.
    """
    above = np.flatnonzero(error > level)
    first_below = above[-1] + 1 if above.size else 0
    return float(min(first_below, len(error) - 1) * DT)


def trial(seed: np.random.SeedSequence) -> dict[str, float]:
    """One run of each case: the quantities of the captions, means over the filters."""
    values: dict[str, float] = {}
    for key, case in CASES.items():
        series = errors(case, np.random.default_rng(seed))
        kde = series["kde"][1:]
        values[f"{key}_kde"] = swarm.average(kde, case, case.end / 2)
        for s in (*ROWS, *NULLS, *VARIED):
            # Another prior is compared with the observer who has it too.
            central = s.replace("paper", "central") if s in VARIED else "central"
            summary = summarize(case, series[s], series[central], kde.mean())
            values |= {f"{key}_{s}_{kind}": summary[kind] for kind in KINDS}
        for s in CURVES:
            curve = series[s].mean(axis=1)
            values |= {f"{key}_{s}_at_{t}": curve[round(t / DT)] for t in MARKS}
        eigenvalues = series["eigenvalue"]
        extremes = np.quantile(eigenvalues, (0, 0.5, 1))
        for name, value in zip(EIGENVALUES, extremes, strict=True):
            values[f"{key}_eigenvalue_{name}"] = value
        for s in EXPLICIT:
            # Share of the steps in which the fastest mode grows
            grows = [amplification(value, s) > 1 for value in eigenvalues[1:]]
            values[f"{key}_{s}_unstable_share"] = np.mean(grows)
            # The first step after which the estimates have diverged, NaN without one
            diverged = np.flatnonzero(series[f"{s}_size"] > DIVERGED)
            first = diverged[0] * DT if diverged.size else np.nan
            values[f"{key}_{s}_diverged_after"] = first
    return {name: float(values[name]) for name in columns}


code = (
    *swarm.code,
    gains_of,
    consensus,
    amplification,
    exchange,
    start_filters,
    errors,
    observe,
    measure,
    summarize,
    settles,
)
