"""Centralised density filters of Zheng and Lin beside a kernel estimate, open loops and a bound.

One trial runs both interpretations of (23), from a uniform and from a peaked density,
with the exact model and with one whose f is out of phase. From 20 s on it averages two
errors: the L2 distance from the density of infinitely many agents, and the RMS error of
the number of agents in the blocks of a chessboard. All filters of a case observe the
same agents.
"""

from __future__ import annotations

from itertools import product
from typing import Any

import numpy as np

from bookkit.published import scenario
from bookkit.studies import spawn
from distfilt import density
from distfilt.models import RotatingMixture, rotating_swarm

NAME = "densities"
PAPER = "zheng"
SWARM = scenario("zheng", "swarm")
CHOICES = scenario("zheng", "figure-1")
parameters = {k: s.parameter(k).value for s in (SWARM, CHOICES) for k in s}
seeds = spawn(CHOICES["seed"], CHOICES["runs"])
rtol = 1e-4
INTERPRETATIONS = tuple(CHOICES["interpretations"])
STARTS = ("uniform", "peaked")
# Estimates with the exact model, and those with a wrong one
EXACT = ("kde", "filter", "observed_r", "open", "open_flat", "bound")
WRONG = ("kde", "filter", "process", "open")
SCORES = ("filter_nees", "bound_nees", "filter_crps", "bound_crps")
# Blocks along a side of the room, in which agents are counted, and who counts them
BLOCKS = (3, 6, 15)
COUNTERS = (*EXACT, "truth")
COUNTS = tuple(f"{e}_count_{b}" for e, b in product(COUNTERS, BLOCKS))
columns = [
    f"{r}_{s}_{e}"
    for kinds in (EXACT, SCORES, COUNTS)
    for r, s, e in product(INTERPRETATIONS, STARTS, kinds)
]
columns += [f"{r}_wrong_{e}" for r, e in product(INTERPRETATIONS, WRONG)]


def grid() -> density.Grid:
    """The paper's grid."""
    return density.Grid(tuple(int(n) for n in SWARM["cells"]))


def swarm(interpretation: str, phase: float = 0.0) -> Any:
    """Return the swarm of (23) in one interpretation, its f turned by `phase`."""
    # The two components are opposite each other; the first one's phase fixes both.
    phases = SWARM["target_phases"]
    mixture = RotatingMixture(
        centre=SWARM["target_centre"],
        radius=SWARM["target_radius"],
        rate=SWARM["target_rate"],
        variance=SWARM["target_variance"],
        components=len(phases),
        phase=phases[0] + phase,
    )
    return rotating_swarm(interpretation, strength=SWARM["diffusion"], mixture=mixture)


def first_density(start: str) -> np.ndarray:
    """Return the density from which agents are drawn, uniform or peaked, (n,)."""
    cells = grid()
    if start == "uniform":
        return np.ones(cells.size)
    squares = ((cells.centres - CHOICES["peak_centre"]) ** 2).sum(axis=-1)
    peak = np.exp(-0.5 * squares / CHOICES["peak_variance"])
    # A floor under the peak, so that some agents start anywhere
    return cells.normalize(peak + CHOICES["peak_floor"])


def first_agents(start: str, agents: int, rng: np.random.Generator) -> np.ndarray:
    """Draw agents from it, (N, 2)."""
    cells = grid()
    # A cell by its probability, then a uniform position in it
    share = first_density(start) * cells.volume
    chosen = cells.centres[rng.choice(cells.size, size=agents, p=share)]
    return chosen + (rng.random((agents, 2)) - 0.5) * cells.spacing


def estimate_from_positions(basis: np.ndarray, positions: np.ndarray) -> Any:
    """Return the linear Bayes estimate of a density from agents alone, a filter of one row.

    A histogram of N independent agents has the variance p / (N cell): first with p = 1,
    then with that estimate.
    """
    cells = grid()
    level = np.ones(cells.size)
    for _ in range(2):
        state = density.low_rank_start(basis, np.ones((1, cells.size)))
        # R = p / (N cell), the variance of a multinomial share over the cell's size
        noise = np.maximum(level, CHOICES["floor"]) / (len(positions) * cells.volume)
        state = density.low_rank_step(state, cells.histogram(positions), noise, 1.0)
        level = state.estimates[0]
    return state


def prior_basis() -> np.ndarray:
    """Return the basis of the prior covariance that all filters share."""
    return density.zero_mean_prior(
        grid(),
        rank=CHOICES["rank"],
        length=CHOICES["prior_length"],
        std=CHOICES["prior_std"],
    )


def flat_gaussian(position: np.ndarray) -> np.ndarray:
    """Return a wide Gaussian about one agent, as a density on the grid."""
    cells = grid()
    squares = ((cells.centres - position) ** 2).sum(axis=-1)
    return cells.normalize(np.exp(-0.5 * squares / CHOICES["local_prior_std"] ** 2))


def choice(key: str, interpretation: str) -> Any:
    """Return a choice of the scenario that depends on the interpretation of (23)."""
    return dict(zip(INTERPRETATIONS, CHOICES[key], strict=True))[interpretation]


def count_errors(
    cells: density.Grid, densities: np.ndarray, positions: np.ndarray, blocks: int
) -> np.ndarray:
    """Return the RMS error of the number of agents in a block, by density, (A,).

    The room has `blocks` blocks along each side. A density predicts N times its mass.
    """
    width = cells.shape[0] // blocks
    differences = np.atleast_2d(densities) - cells.histogram(positions)
    # (A, block, cell in it, block, cell in it): the mass of each block
    split = differences.reshape(-1, blocks, width, blocks, width)
    masses = split.sum(axis=(2, 4)) * cells.volume
    return len(positions) * np.sqrt((masses**2).mean(axis=(1, 2)))


def run_case(
    interpretation: str,
    start: str,
    rng: np.random.Generator,
    *,
    phase: float = 0.0,
    agents: int | None = None,
    end: float | None = None,
) -> dict[str, np.ndarray]:
    """Return L2 errors, scores and errors of counts over time by method, (T,)."""
    cells = grid()
    dt = SWARM["dt"]
    n = int(SWARM["agents"]) if agents is None else agents
    h = CHOICES["bandwidth"]
    floor = CHOICES["floor"]
    end = choice("end_times", interpretation) if end is None else end
    # The agents' law, and the filters' model of it
    true = swarm(interpretation)
    truth = density.FokkerPlanck(true, cells)
    model = density.FokkerPlanck(swarm(interpretation, phase), cells)
    k = density.kernel_constant(cells, bandwidth=h, agents=n)
    basis = prior_basis()
    x = first_agents(start, n, rng)
    p = first_density(start)
    y = density.kernel_density(x, cells, bandwidth=h)
    # Rows: the filter, R as printed, and the open loops from both starts
    base = np.stack([y, y, y, flat_gaussian(x[0])])
    filters = initial_filters(basis, base, x)
    # One more filter of lower rank, with process noise where the model is wrong
    few = basis[:, : CHOICES["low_rank"]]
    low = density.low_rank_start(few, y[None])
    process = choice("process_scale", interpretation) * few
    rows = []
    noise = np.full(filters.base.shape, np.inf)
    for j in range(round(end / dt)):
        t = j * dt
        # One step of the Fokker-Planck equation serves all filters.
        move = model.solver(t, dt)
        x = true.step(x, t, dt, rng=rng, substeps=CHOICES["substeps"])
        p = truth.step(p, t, dt)
        y = density.kernel_density(x, cells, bandwidth=h)
        filters = density.low_rank_predict(filters, move)
        # R from the forecast, and R from the kernel estimate; the others stay open (R = ∞).
        noise[0] = k * np.maximum(filters.estimates[0], floor)
        noise[1] = k * np.maximum(y, floor)
        filters = density.low_rank_step(filters, y, noise, dt)
        if phase:
            low = density.low_rank_predict(low, move, process=process, dt=dt)
            low_noise = k * np.maximum(low.estimates, floor)
            low = density.low_rank_step(low, y, low_noise, dt)
        estimates = np.stack([y, *filters.estimates, *low.estimates])
        errors = cells.norm(estimates - p)
        # Counts by all estimates with the exact model, and by the true density
        counters = np.concatenate([estimates[: len(EXACT)], p[None]])
        counts = [count_errors(cells, counters, x, b) for b in BLOCKS]
        rows.append(
            np.concatenate(
                [errors, filter_scores(filters, p, j), np.transpose(counts).ravel()]
            )
        )
    names = (*EXACT, "process", *SCORES, *COUNTS)
    return dict(zip(names, np.array(rows).T, strict=True))


def initial_filters(basis: np.ndarray, base: np.ndarray, positions: np.ndarray) -> Any:
    """Return filters that start from the rows of `base`; the last one is the one look."""
    one_look = estimate_from_positions(basis, positions)
    state = density.low_rank_start(basis, base)
    # One more row of the same basis
    return density.LowRank(
        basis,
        np.concatenate([base, one_look.base]),
        np.concatenate([state.information, one_look.information]),
        np.concatenate([state.vector, one_look.vector]),
    )


def filter_scores(filters: Any, p: np.ndarray, step: int) -> np.ndarray:
    """Return NEES and CRPS per cell of the filter and the bound, every two seconds; else NaN."""
    if step % 20 != 19:
        return np.full(4, np.nan)
    from distfilt.metrics import gaussian_crps

    # The filter is the first row, the one look the last.
    gap = (filters.estimates - p)[[0, -1]]
    variance = np.maximum(filters.variances[[0, -1]], 1e-12)
    # Means over the cells
    nees = (gap**2 / variance).mean(axis=-1)
    crps = gaussian_crps(0 * gap, np.sqrt(variance), gap).mean(axis=-1)
    return np.concatenate([nees, crps])


def late_mean(values: np.ndarray) -> float:
    """Return the mean from the scenario's time on."""
    return float(np.nanmean(values[round(CHOICES["average_from"] / SWARM["dt"]) :]))


def trial(seed: np.random.SeedSequence) -> list[float]:
    """One run of all cases: time-averaged errors in the order of `columns`."""
    means: dict[str, float] = {}
    cases = list(product(INTERPRETATIONS, (*STARTS, "wrong")))
    for (interpretation, start), part in zip(
        cases, seed.spawn(len(cases)), strict=True
    ):
        # A wrong model is tried from the peaked start.
        wrong = start == "wrong"
        result = run_case(
            interpretation,
            "peaked" if wrong else start,
            np.random.default_rng(part),
            phase=CHOICES["wrong_phase"] if wrong else 0.0,
            end=CHOICES["wrong_end"] if wrong else None,
        )
        means |= {
            f"{interpretation}_{start}_{name}": late_mean(v)
            for name, v in result.items()
        }
    return [means[c] for c in columns]


code: tuple[Any, ...] = (
    run_case,
    prior_basis,
    flat_gaussian,
    initial_filters,
    estimate_from_positions,
    filter_scores,
    first_agents,
    first_density,
    count_errors,
    late_mean,
)
