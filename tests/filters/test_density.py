"""Density filters: sharing rules, local filters against the centralised one, faults, states."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.random import default_rng

from distfilt import density
from distfilt.filters import DensityFilter, DensityState
from distfilt.filters.record import final_state
from distfilt.models import rotating_swarm
from distfilt.network import Faults, Graph, graphs

SIZE = 12
H = 0.12
GRID = density.Grid((10, 10))
SWARM = rotating_swarm("gibbs")
MODEL = density.FokkerPlanck(SWARM, GRID)
START = default_rng(1).random((SIZE, 2))
TIMES = np.arange(1, 9) * 0.1
PATH = SWARM.simulate(START, TIMES, rng=default_rng(2), substeps=2)
FLAT = np.ones(100)
COMPLETE = graphs.complete(SIZE)


def make(graph: object, rule: object, **options: object) -> DensityFilter:
    arguments = {"rank": 20, **options}
    return DensityFilter(MODEL, SIZE, graph, fusion=rule, bandwidth=H, **arguments)


RULES = {
    "pi": density.PIConsensus(),
    "pi, coefficients": density.PIConsensus(modes=30),
    "pi, rate": density.PIConsensus(rate=True),
    "average": density.DynamicAverage(modes=30),
    "flooding": density.Flooding(),
    "neighbours": density.Neighbours(),
}


def last(
    f: DensityFilter, path=PATH, start: np.ndarray = START, t: float = 0.0
) -> DensityState:
    """The state after a step for each row of the path."""
    state = f.start(start, t=t)
    for k, x in enumerate(path, start=1):
        state = f.step(state, t + 0.1 * k, x)
    return state


def largest(difference: np.ndarray) -> float:
    """The largest absolute entry."""
    return float(np.abs(difference).max())


@pytest.mark.parametrize("rule", [density.Flooding(), density.Neighbours()])
def test_complete_graph_and_equal_starts_give_the_centralised_filter(
    rule: object,
) -> None:
    """All agents have all positions, so that each one computes the density of a centre."""
    everyone = last(make(COMPLETE, rule, initial_density=FLAT))
    central = last(make(COMPLETE, density.Centralised(), initial_density=FLAT))
    assert largest(everyone.estimates - central.estimates) < 1e-12
    assert (everyone.positions_sent == SIZE).all()


@pytest.mark.parametrize("name", RULES)
def test_nobody_reads_beyond_its_links(name: str) -> None:
    # On a path, moving agent 11 cannot change the beliefs of agents 0 to 9 after one step.
    f = make(graphs.path(SIZE), RULES[name])
    moved = PATH[0].copy()
    moved[11] = 1 - moved[11]
    # Each substep of a rule reaches one link further.
    substeps = 2 if name.startswith("pi") else 1
    n_far = SIZE - 1 - substeps
    start = f.start(START)
    a = f.step(start, 0.1, PATH[0]).estimates
    b = f.step(start, 0.1, moved).estimates
    assert np.array_equal(a[:n_far], b[:n_far])


def test_coefficients_are_the_whole_density_to_truncation() -> None:
    full = last(make(0.5, density.PIConsensus()))
    cut = last(make(0.5, density.PIConsensus(modes=100)))
    # 100 modes on 100 cells are a change of basis: no truncation, and as many numbers.
    assert largest(full.observed - cut.observed) < 1e-10
    sent = full.ledger.scalars.sum()
    assert cut.ledger.scalars.sum() == sent
    # Each message has the modes and one more number.
    fewer = last(make(0.5, density.PIConsensus(modes=30)))
    assert fewer.ledger.scalars.sum() * 101 == sent * 31


def test_flooding_knows_where_agents_were_as_many_steps_ago_as_hops() -> None:
    state = last(make(graphs.path(SIZE), density.Flooding(), local=(0,)))
    table = state.carried[0][0]
    # Agent 8 is eight hops from agent 0; eight steps were taken, the first with positions of then.
    positions = []
    for j in range(9):
        # A neighbour's position is of now, one of j hops is j - 1 steps old.
        age = max(j - 1, 0)
        positions.append(PATH[7 - age][j])
        if j < 8:
            assert table[j, 2] == pytest.approx(0.8 - 0.1 * age)
            assert np.array_equal(table[j, :2], positions[j])
    # A negative time marks an agent of which nothing has come yet.
    assert (table[9:, 2] < 0).all()
    assert state.positions_sent[0] == 9
    expected = density.kernel_density(np.stack(positions), GRID, bandwidth=H)
    assert largest(state.observed[0] - expected) < 1e-12


def test_flooding_forgets() -> None:
    path = PATH.copy()
    # Agent 3 drops out after two steps, agent 4 never appears.
    path[2:, 3] = np.nan
    path[:, 4] = np.nan
    memory = last(make(COMPLETE, density.Flooding(), local=(0,)), path)
    forgetful = make(COMPLETE, density.Flooding(forget=0.35), local=(0,))
    gone = last(forgetful, path, t=-9.0)
    assert memory.positions_sent[0] == SIZE - 1
    assert gone.positions_sent[0] == SIZE - 2
    assert gone.positions_sent[4] == 0


def test_ledger_charges_what_each_rule_sends() -> None:
    graph = graphs.ring(SIZE)
    # Position and time of every agent; one's own position; 30 coefficients and a constant
    wanted = {"flooding": 3 * SIZE, "neighbours": 2, "average": 31}
    for name, numbers in wanted.items():
        scalars = last(make(graph, RULES[name])).ledger.scalars
        # Eight steps, to two neighbours each
        assert (scalars == 8 * 2 * numbers).all(), name
    central = last(make(graph, density.Centralised()))
    assert central.ledger.scalars.sum() == 0


def test_agents_that_go_are_left_out_and_their_filters_go_on() -> None:
    path = PATH.copy()
    path[4:, 5] = np.nan
    state = last(make(COMPLETE, density.Centralised(), initial_density=FLAT), path)
    # The kernel density is that of the agents which are still there.
    present = [i for i in range(SIZE) if i != 5]
    want = density.kernel_density(path[-1][present], GRID, bandwidth=H)
    assert largest(state.observed[0] - want) < 1e-13
    assert state.parts == 1
    assert np.isfinite(state.estimates).all()
    # The filter of agent 5 gets no more information than it had when the agent left.
    information = state.filters.information
    assert np.trace(information[5]) < np.trace(information[4])
    until_then = last(
        make(COMPLETE, density.Centralised(), initial_density=FLAT), path[:4]
    )
    assert np.array_equal(information[5], until_then.filters.information[5])
    # An agent that is missing from the start is in no average either.
    gone = START.copy()
    gone[0] = np.nan
    averaging = make(COMPLETE, density.DynamicAverage(modes=30))
    state = last(averaging, gone[None], gone)
    assert np.allclose(state.positions_sent[1:], SIZE - 1)


def test_a_network_that_falls_apart_is_in_the_ledger() -> None:
    """No agent receives anything any more: no messages, and each filter keeps its memory."""
    no_links = Graph.from_edges(SIZE, np.zeros((0, 2)))

    def graph(t: float, x: np.ndarray) -> Graph:
        return graphs.ring(SIZE) if t < 0.45 else no_links

    for rule in (
        density.Flooding(),
        density.PIConsensus(),
        density.DynamicAverage(modes=30),
    ):
        f = make(graph, rule)
        run = f.run(f.start(START), TIMES, PATH.swapaxes(0, 1))
        sent = run["messages"].sum("agent").values
        assert (sent[:4] > 0).all()
        assert (sent[4:] == 0).all()
        # One connected part at first, then each agent is a part of its own.
        parts = run["parts"].isel(agent=0).values
        assert (parts[:4] == 1).all()
        assert (parts[4:] == SIZE).all()
        assert np.isfinite(run["mean"].values).all()
        assert np.allclose(run["mass"].values, 1)


def test_the_sum_forgets_agents_that_drop_out() -> None:
    """Equation (26) and Remark 3: after a dropout Σ(y_i - z_i) over those left decays by
    1 - α h in each step, whatever the integrators of the others held.
    """
    rule = density.PIConsensus(b=0.4)
    f = make(graphs.ring(SIZE), rule, initial_density=FLAT)
    state = f.start(START)
    x = START.copy()
    for k in range(1, 11):
        state = f.step(state, 0.1 * k, x)
    x[[2, 7]] = np.nan
    remaining = ~np.isnan(x).any(axis=-1)
    z = density.kernels(x[remaining], GRID, bandwidth=H)
    y = state.carried[0][remaining, :100]
    before = (y - z).sum(axis=0)
    for k in range(11, 21):
        state = f.step(state, 0.1 * k, x)
    y = state.carried[0][remaining, :100]
    after = (y - z).sum(axis=0)
    # One substep each
    assert state.ledger.rounds == 20
    # The part of the two that have left
    assert largest(before) > 0.1
    # Ten steps with α = 0.2 and h = 0.1
    decay = (1 - 0.2 * 0.1) ** 10
    assert largest(after - decay * before) < 1e-12


def test_only_the_wanted_estimates_are_made() -> None:
    """Agents without a filter share as before; the others' estimates do not change."""
    for rule in RULES.values():
        everyone = last(make(0.5, rule))
        few = last(make(0.5, rule, local=(7, 2)))
        assert np.array_equal(everyone.ledger.scalars, few.ledger.scalars)
        assert np.array_equal(everyone.positions_sent, few.positions_sent)
        # In the order of `local`, to the rounding of a smaller batch
        local = [7, 2]
        assert largest(everyone.observed[local] - few.observed) < 1e-13
        assert largest(everyone.estimates[local] - few.estimates) < 1e-11


def test_directed_graphs_flood_and_average() -> None:
    edges = [[i, (i - 1) % SIZE] for i in range(SIZE)]
    one_way = Graph.from_edges(SIZE, edges, directed=True)
    state = last(make(one_way, density.Flooding(), local=(3,)))
    # After eight steps an agent has its own position and those of eight others.
    times = state.carried[0][3][:, 2]
    assert (times > 0).sum() == 9
    # Dynamic averaging keeps the mean over agents, also on one-way links and with losses.
    rule = density.DynamicAverage(modes=None)
    averaged = last(make(one_way, rule))
    lossy = last(make(graphs.ring(SIZE), rule, faults=Faults(loss=0.3)))
    y = density.kernel_density(PATH[-1], GRID, bandwidth=H)
    for result in (averaged, lossy):
        assert largest(result.observed.mean(axis=0) - y) < 1e-12
    with pytest.raises(ValueError, match="both ways"):
        last(make(one_way, density.PIConsensus()))


@pytest.mark.parametrize("process", [None, 0.5])
@pytest.mark.parametrize("noise", ["forecast", "observed"])
def test_a_step_is_the_forms_step_with_the_noise_that_was_asked_for(
    process: float | None, noise: str
) -> None:
    options = {"noise": noise, "floor": 0.7, "process": process}
    f = make(graphs.path(SIZE), density.Flooding(), local=(7, 2), **options)
    start = f.start(START)
    state = f.step(start, 0.1, PATH[0])

    # The step written out with the functions of `density`
    unit_noise = density.zero_mean_prior(GRID, rank=20)
    q = None if process is None else process * unit_noise
    solver = MODEL.solver(0.0, 0.1)
    moved = density.low_rank_predict(start.filters, solver, process=q, dt=0.1)
    # The noise is proportional to the density, which is not taken below the floor.
    level = moved.estimates if noise == "forecast" else state.observed
    unit = density.kernel_constant(GRID, bandwidth=H, agents=SIZE)
    variances = unit * level.clip(0.7)
    wanted = density.low_rank_step(moved, state.observed, variances, 0.1)
    assert np.allclose(state.estimates, wanted.estimates, rtol=1e-12)
    assert np.allclose(state.variances, wanted.variances, rtol=1e-12)


def test_a_run_of_few_filters_records_them() -> None:
    f = make(0.6, density.Flooding(), local=(2, 7))
    run = f.run(f.start(START), TIMES, PATH.swapaxes(0, 1))
    state = final_state(run)
    means = run["mean"].values
    assert np.allclose(means[-1, [2, 7]], state.estimates)
    # Agents without a filter have no estimate to record.
    assert np.isnan(means[:, 0]).all()
    covariance = state.filters.covariance(0)
    assert np.allclose(state.variances[0], np.diag(covariance))


def test_first_estimates() -> None:
    # A Gaussian of that standard deviation about the agent's own position
    flat = make(0.5, density.Flooding(), initial_std=0.3).start(START)
    squared_distance = ((GRID.centres - START[4]) ** 2).sum(axis=-1)
    gaussian = np.exp(-0.5 * squared_distance / 0.09)
    assert np.allclose(flat.estimates[4], GRID.normalize(gaussian))
    # The agent's own kernel, or the kernel density of all agents
    kernel = make(0.5, density.Flooding(), initial_density="observed").start(START)
    expected = density.kernels(START, GRID, bandwidth=H)
    assert np.allclose(kernel.estimates, expected)
    central = make(0.5, density.Centralised(), initial_density="observed").start(START)
    expected = density.kernel_density(START, GRID, bandwidth=H)
    assert np.allclose(central.estimates[3], expected)


def test_mass_can_change_where_the_prior_says_so() -> None:
    """The constant wave's variance is mass_std², and R from the observed density leaks mass."""
    f = make(0.5, density.Flooding(), mass_std=0.2, noise="observed")
    state = f.start(START)
    # The mass is the integral of the density; its variance is 1ᵀ P 1 times the volume squared.
    P = state.filters.covariance(0) * GRID.volume**2
    assert P.sum() == pytest.approx(0.04, rel=1e-9)
    leaking = GRID.integral(last(f).estimates)
    assert largest(leaking - 1) > 1e-4
    kept = last(make(0.5, density.Flooding(), noise="observed"))
    mass = GRID.integral(kept.estimates)
    assert largest(mass - 1) < 1e-12


def test_consensus_may_start_flat() -> None:
    """(14) and Section VI at once: consensus and filter start at one flat Gaussian."""
    f = make(0.5, density.PIConsensus(initial_std=0.3), initial_std=0.3)
    state = f.start(START)
    consensus = state.carried[0][:, :100]
    assert largest(consensus - state.estimates) < 1e-14
    # The inputs of the consensus are the kernels, whatever its start.
    other = make(0.5, density.PIConsensus()).start(START)
    assert np.array_equal(state.carried[2], other.carried[2])
    mass = GRID.integral(last(f).observed)
    assert largest(mass - 1) < 1e-12
