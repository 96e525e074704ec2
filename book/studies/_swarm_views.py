"""The first stored run of `locals` again: agents and densities at some times, for two pages."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
import _swarm as swarm
import locals as figure
import tenfold

from distfilt import density
from distfilt.density import kernel_density, kernels
from distfilt.network import graphs

DT = swarm.SWARM["dt"]
WIDTH = swarm.CHOICES["bandwidth"]
View = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]
"""Agents, true density, estimates of the centralised filter and of one agent."""


def start_filters(x: np.ndarray, agent: int) -> density.LowRank:
    """Start the centralised filter at the kernel estimate, and one agent's at a flat Gaussian."""
    room = figure.CASE.grid
    squared_distances = ((room.centres - x[agent]) ** 2).sum(axis=-1)
    flat = room.normalize(np.exp(-0.5 * squared_distances / swarm.FLAT**2))
    basis = density.zero_mean_prior(
        room,
        rank=swarm.CHOICES["rank"],
        length=swarm.CHOICES["prior_length"],
        std=swarm.CHOICES["prior_std"],
    )
    observed = kernel_density(x, room, bandwidth=WIDTH)
    return density.low_rank_start(basis, np.stack([observed, flat]))


def repeat_first_run(
    agent: int, every: int, seconds: float = figure.CASE.end
) -> tuple[dict[str, View], np.ndarray]:
    """Repeat the run; return a view at each `every`-th step, and all L2 errors, (3, steps).

    The errors are those of the kernel estimate, of the centralised filter, and of the
    filter of `agent` with the paper's gains. A shorter run ends after some `seconds`.
    """
    case = figure.CASE
    room = case.grid
    rng = np.random.default_rng(figure.seeds[0])
    law = swarm.densities.swarm(case.interpretation)
    model = density.FokkerPlanck(law, room)
    waves = room.cosines(swarm.MODES)
    x, p = swarm.draw_swarm(case, rng)
    bumps = kernels(x, room, bandwidth=WIDTH) @ waves * room.volume
    consensus = bumps, np.zeros_like(bumps)
    state = start_filters(x, agent)
    constant = density.kernel_constant(room, bandwidth=WIDTH, agents=case.agents)
    views = {"0": (x, p, *state.estimates)}
    errors = []
    for j in range(round(seconds / DT)):
        x = law.step(x, j * DT, DT, rng=rng, substeps=swarm.CHOICES["substeps"])
        graph = graphs.disk(x, case.radio_range)
        consensus = tenfold.consensus(*consensus, bumps, graph, "paper")
        bumps = kernels(x, room, bandwidth=WIDTH) @ waves * room.volume
        y = kernel_density(x, room, bandwidth=WIDTH)
        propagate = model.solver(j * DT, DT)
        p = propagate(p)
        state = density.low_rank_predict(state, propagate)
        noise = constant * np.maximum(state.estimates, swarm.CHOICES["floor"])
        observations = np.stack([y, waves @ consensus[0][agent]])
        state = density.low_rank_step(state, observations, noise, DT)
        errors.append(room.norm(np.stack([y, *state.estimates]) - p))
        if (j + 1) % every == 0:
            views[f"{(j + 1) * DT:.0f}"] = (x, p, *state.estimates)
    return views, np.array(errors).T
