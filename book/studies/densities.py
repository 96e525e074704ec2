"""Centralised density filters of Zheng and Lin beside a kernel estimate, open loops and a bound.

One trial runs both interpretations of (23), from a uniform and from a peaked density,
with the exact model and with one whose f is out of phase, and averages L2 errors from
20 s on. All filters of a case see the same agents.
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
READINGS = tuple(CHOICES["readings"])
STARTS = ("uniform", "peaked")
EXACT = ("kde", "filter", "observed_r", "open", "open_flat", "bound")
WRONG = ("kde", "filter", "process", "open")
columns = [
    *(f"{r}_{s}_{e}" for r, s, e in product(READINGS, STARTS, EXACT)),
    *(
        f"{r}_{s}_{e}"
        for r, s, e in product(
            READINGS, STARTS, ("filter_nees", "bound_nees", "filter_crps", "bound_crps")
        )
    ),
    *(f"{r}_wrong_{e}" for r, e in product(READINGS, WRONG)),
]


def grid() -> density.Grid:
    """The paper's grid."""
    return density.Grid(tuple(int(n) for n in SWARM["cells"]))


def swarm(reading: str, phase: float = 0.0) -> Any:
    """Return the swarm of (23) in one interpretation, its f turned by `phase`."""
    phases = SWARM["target_phases"]
    mixture = RotatingMixture(
        centre=SWARM["target_centre"],
        radius=SWARM["target_radius"],
        rate=SWARM["target_rate"],
        variance=SWARM["target_variance"],
        components=len(phases),
        phase=phases[0] + phase,
    )
    return rotating_swarm(reading, strength=SWARM["diffusion"], mixture=mixture)


def first_density(start: str) -> np.ndarray:
    """Return the density from which agents are drawn, uniform or peaked, (n,)."""
    cells = grid()
    if start == "uniform":
        return np.ones(cells.size)
    gap = ((cells.centres - CHOICES["peak_centre"]) ** 2).sum(axis=-1)
    peak = np.exp(-0.5 * gap / CHOICES["peak_variance"])
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
    level = np.ones(grid().size)
    for _ in range(2):
        state = density.low_rank_start(basis, np.ones((1, cells.size)))
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


def choice(key: str, reading: str) -> Any:
    """Return a choice of the scenario that depends on the interpretation of (23)."""
    return dict(zip(READINGS, CHOICES[key], strict=True))[reading]


def run_case(
    reading: str,
    start: str,
    rng: np.random.Generator,
    *,
    phase: float = 0.0,
    agents: int | None = None,
    end: float | None = None,
) -> dict[str, np.ndarray]:
    """Return L2 errors over time by method, (T,), and NEES and CRPS per cell of two of them."""
    cells = grid()
    dt = SWARM["dt"]
    n = int(SWARM["agents"]) if agents is None else agents
    h = CHOICES["bandwidth"]
    floor = CHOICES["floor"]
    end = choice("end_times", reading) if end is None else end
    true = swarm(reading)
    truth = density.FokkerPlanck(true, cells)
    model = density.FokkerPlanck(swarm(reading, phase), cells)
    k = density.kernel_constant(cells, bandwidth=h, agents=n)
    basis = prior_basis()
    x = first_agents(start, n, rng)
    p = first_density(start)
    y = density.kernel_density(x, cells, bandwidth=h)
    base = np.stack([y, y, y, flat_gaussian(x[0])])
    filters = initial_filters(basis, base, x)
    # One more filter of lower rank, with process noise where the model is wrong
    few = basis[:, : CHOICES["low_rank"]]
    low = density.low_rank_start(few, y[None])
    process = choice("process_scale", reading) * few
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
        # R from the forecast, and R from the observed density; the others stay open (R = ∞).
        noise[0] = k * np.maximum(filters.estimates[0], floor)
        noise[1] = k * np.maximum(y, floor)
        filters = density.low_rank_step(filters, y, noise, dt)
        if phase:
            low = density.low_rank_predict(low, move, process=process, dt=dt)
            low_noise = k * np.maximum(low.estimates, floor)
            low = density.low_rank_step(low, y, low_noise, dt)
        estimates = np.stack([y, *filters.estimates, *low.estimates])
        errors = cells.norm(estimates - p)
        rows.append(np.concatenate([errors, filter_scores(filters, p, j)]))
    scores = ("filter_nees", "bound_nees", "filter_crps", "bound_crps")
    names = (*EXACT, "process", *scores)
    return dict(zip(names, np.array(rows).T, strict=True))


def initial_filters(basis: np.ndarray, base: np.ndarray, positions: np.ndarray) -> Any:
    """Return filters that start from the rows of `base`; the last one, the bound, is informed."""
    informed = estimate_from_positions(basis, positions)
    state = density.low_rank_start(basis, base)
    return density.LowRank(
        basis,
        np.concatenate([base, informed.base]),
        np.concatenate([state.information, informed.information]),
        np.concatenate([state.vector, informed.vector]),
    )


def filter_scores(filters: Any, p: np.ndarray, step: int) -> np.ndarray:
    """Return NEES and CRPS per cell of the filter and the bound, every two seconds; else NaN."""
    if step % 20 != 19:
        return np.full(4, np.nan)
    from distfilt.metrics import gaussian_crps

    gap = (filters.estimates - p)[[0, -1]]
    variance = np.maximum(filters.variances[[0, -1]], 1e-12)
    nees = (gap**2 / variance).mean(axis=-1)
    crps = gaussian_crps(0 * gap, np.sqrt(variance), gap).mean(axis=-1)
    return np.concatenate([nees, crps])


def late_mean(values: np.ndarray) -> float:
    """Return the mean from the scenario's time on."""
    return float(np.nanmean(values[round(CHOICES["average_from"] / SWARM["dt"]) :]))


def trial(seed: np.random.SeedSequence) -> list[float]:
    """One run of all cases: time-averaged errors in the order of `columns`."""
    means: dict[str, float] = {}
    cases = [(r, s) for r in READINGS for s in (*STARTS, "wrong")]
    for (reading, start), part in zip(cases, seed.spawn(len(cases)), strict=True):
        wrong = start == "wrong"
        result = run_case(
            reading,
            "peaked" if wrong else start,
            np.random.default_rng(part),
            phase=CHOICES["wrong_phase"] if wrong else 0.0,
            end=CHOICES["wrong_end"] if wrong else None,
        )
        means |= {
            f"{reading}_{start}_{name}": late_mean(v) for name, v in result.items()
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
    late_mean,
)
