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
PATH = SWARM.simulate(START, np.arange(1, 9) * 0.1, rng=default_rng(2), substeps=2)


def make(graph: object, rule: object, **options: object) -> DensityFilter:
    return DensityFilter(
        MODEL, SIZE, graph, fusion=rule, bandwidth=H, **{"rank": 20, **options}
    )


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
    state = f.start(start, t=t)
    for k, x in enumerate(path):
        state = f.step(state, t + 0.1 * (k + 1), x)
    return state


@pytest.mark.parametrize("rule", [density.Flooding(), density.Neighbours()])
def test_complete_graph_and_equal_starts_give_the_centralised_filter(
    rule: object,
) -> None:
    """Criterion 7."""
    everyone = last(make(graphs.complete(SIZE), rule, initial_density=np.ones(100)))
    central = last(
        make(graphs.complete(SIZE), density.Centralised(), initial_density=np.ones(100))
    )
    assert np.abs(everyone.estimates - central.estimates).max() < 1e-12
    assert (everyone.positions_sent == SIZE).all()


@pytest.mark.parametrize("name", RULES)
def test_nobody_reads_beyond_its_links(name: str) -> None:
    # On a path, moving agent 11 cannot change the beliefs of agents 0 to 9 after one step.
    f = make(graphs.path(SIZE), RULES[name])
    moved = PATH[0].copy()
    moved[11] = 1 - moved[11]
    substeps = 1 if not name.startswith("pi") else 2
    a, b = (f.step(f.start(START), 0.1, x) for x in (PATH[0], moved))
    assert np.array_equal(
        a.estimates[: SIZE - 1 - substeps], b.estimates[: SIZE - 1 - substeps]
    )


def test_coefficients_are_the_whole_density_to_truncation() -> None:
    full = last(make(0.5, density.PIConsensus()))
    cut = last(make(0.5, density.PIConsensus(modes=100)))
    assert np.abs(full.observed - cut.observed).max() < 1e-10
    assert cut.ledger.scalars.sum() == full.ledger.scalars.sum()
    fewer = last(make(0.5, density.PIConsensus(modes=30)))
    assert fewer.ledger.scalars.sum() * 101 == full.ledger.scalars.sum() * 31


def test_flooding_knows_where_agents_were_as_many_steps_ago_as_hops() -> None:
    state = last(make(graphs.path(SIZE), density.Flooding(), local=(0,)))
    table = state.carried[0][0]
    # Agent 8 is eight hops from agent 0; eight steps were taken, the first with positions of then.
    for j in range(8):
        assert table[j, 2] == pytest.approx(0.8 - 0.1 * max(j - 1, 0))
        assert np.array_equal(table[j, :2], PATH[7 - max(j - 1, 0)][j])
    assert (table[9:, 2] < 0).all()
    assert state.positions_sent[0] == 9
    x = np.stack([PATH[7 - max(j - 1, 0)][j] for j in range(9)])
    assert (
        np.abs(state.observed[0] - density.kernel_density(x, GRID, bandwidth=H)).max()
        < 1e-12
    )


def test_flooding_forgets() -> None:
    path = PATH.copy()
    path[2:, 3] = path[:, 4] = np.nan
    all_ = graphs.complete(SIZE)
    memory = last(make(all_, density.Flooding(), local=(0,)), path)
    gone = last(make(all_, density.Flooding(forget=0.35), local=(0,)), path, t=-9.0)
    assert memory.positions_sent[0] == SIZE - 1
    assert gone.positions_sent[0] == SIZE - 2
    assert gone.positions_sent[4] == 0


def test_ledger_charges_what_each_rule_sends() -> None:
    graph = graphs.ring(SIZE)
    wanted = {"flooding": 3 * SIZE, "neighbours": 2, "average": 31}
    for name, numbers in wanted.items():
        ledger = last(make(graph, RULES[name])).ledger
        assert (ledger.scalars == 8 * 2 * numbers).all(), name
    assert last(make(graph, density.Centralised())).ledger.scalars.sum() == 0


def test_agents_that_go_are_left_out_and_their_filters_go_on() -> None:
    path = PATH.copy()
    path[4:, 5] = np.nan
    state = last(
        make(
            graphs.complete(SIZE), density.Centralised(), initial_density=np.ones(100)
        ),
        path,
    )
    present = [i for i in range(SIZE) if i != 5]
    want = density.kernel_density(path[-1][present], GRID, bandwidth=H)
    assert np.abs(state.observed[0] - want).max() < 1e-13
    assert state.parts == 1
    assert np.isfinite(state.estimates).all()
    assert np.trace(state.filters.information[5]) < np.trace(
        state.filters.information[4]
    )
    gone = np.where(np.arange(SIZE)[:, None] == 0, np.nan, START)
    state = last(
        make(graphs.complete(SIZE), density.DynamicAverage(modes=30)), gone[None], gone
    )
    assert np.allclose(state.positions_sent[1:], SIZE - 1)


def test_a_network_that_falls_apart_is_in_the_ledger() -> None:
    """Nobody receives anything any more: no messages, and each filter goes on with its memory."""

    def graph(t: float, x: np.ndarray) -> Graph:
        return (
            graphs.ring(SIZE) if t < 0.45 else Graph.from_edges(SIZE, np.zeros((0, 2)))
        )

    for rule in (
        density.Flooding(),
        density.PIConsensus(),
        density.DynamicAverage(modes=30),
    ):
        f = make(graph, rule)
        run = f.run(f.start(START), np.arange(1, 9) * 0.1, PATH.swapaxes(0, 1))
        sent = run["messages"].sum("agent").values
        assert (sent[:4] > 0).all()
        assert (sent[4:] == 0).all()
        assert run["parts"].isel(agent=0).values.tolist() == [1] * 4 + [SIZE] * 4
        assert np.isfinite(run["mean"].values).all()
        assert np.allclose(run["mass"].values, 1)


def test_the_sum_forgets_agents_that_drop_out() -> None:
    """Equation (26) and Remark 3: after a dropout Σ(y_i - z_i) over those left decays by
    1 - α h in each step, whatever the integrators of the others held.
    """
    f = make(
        graphs.ring(SIZE), density.PIConsensus(b=0.4), initial_density=np.ones(100)
    )
    state = f.start(START)
    x = START.copy()
    for k in range(10):
        state = f.step(state, 0.1 * (k + 1), x)
    x[[2, 7]] = np.nan
    remaining = ~np.isnan(x).any(axis=-1)
    z = density.kernels(x[remaining], GRID, bandwidth=H)
    before = (state.carried[0][remaining, :100] - z).sum(axis=0)
    for k in range(10, 20):
        state = f.step(state, 0.1 * (k + 1), x)
    after = (state.carried[0][remaining, :100] - z).sum(axis=0)
    assert state.ledger.rounds == 20  # one substep each
    assert np.abs(before).max() > 0.1  # the part of the two that have left
    assert np.abs(after - (1 - 0.2 * 0.1) ** 10 * before).max() < 1e-12


def test_only_the_wanted_estimates_are_made() -> None:
    """Agents without a filter share as before; the others' estimates do not change."""
    for rule in RULES.values():
        everyone = last(make(0.5, rule))
        few = last(make(0.5, rule, local=(7, 2)))
        assert np.array_equal(everyone.ledger.scalars, few.ledger.scalars)
        assert np.array_equal(everyone.positions_sent, few.positions_sent)
        assert np.abs(everyone.observed[[7, 2]] - few.observed).max() < 1e-13
        assert np.abs(everyone.estimates[[7, 2]] - few.estimates).max() < 1e-11


def test_directed_graphs_flood_and_average() -> None:
    one_way = Graph.from_edges(
        SIZE, [[i, (i - 1) % SIZE] for i in range(SIZE)], directed=True
    )
    state = last(make(one_way, density.Flooding(), local=(3,)))
    assert (state.carried[0][3][:, 2] > 0).sum() == 9
    averaged = last(make(one_way, density.DynamicAverage(modes=None)))
    y = density.kernel_density(PATH[-1], GRID, bandwidth=H)
    lossy = make(
        graphs.ring(SIZE), density.DynamicAverage(modes=None), faults=Faults(loss=0.3)
    )
    for rule in (averaged, last(lossy)):
        assert np.abs(rule.observed.mean(axis=0) - y).max() < 1e-12
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

    q = None if process is None else process * density.zero_mean_prior(GRID, rank=20)
    moved = density.low_rank_predict(
        start.filters, MODEL.solver(0.0, 0.1), process=q, dt=0.1
    )
    level = moved.estimates if noise == "forecast" else state.observed
    unit = density.kernel_constant(GRID, bandwidth=H, agents=SIZE)
    wanted = density.low_rank_step(moved, state.observed, unit * level.clip(0.7), 0.1)
    assert np.allclose(state.estimates, wanted.estimates, rtol=1e-12)
    assert np.allclose(state.variances, wanted.variances, rtol=1e-12)


def test_a_run_of_few_filters_records_them() -> None:
    f = make(0.6, density.Flooding(), local=(2, 7))
    run = f.run(f.start(START), np.arange(1, 9) * 0.1, PATH.swapaxes(0, 1))
    state = final_state(run)
    assert np.allclose(run["mean"].values[-1, [2, 7]], state.estimates)
    assert np.isnan(run["mean"].values[:, 0]).all()
    assert np.allclose(state.variances[0], np.diag(state.filters.covariance(0)))


def test_first_estimates() -> None:
    flat = make(0.5, density.Flooding(), initial_std=0.3).start(START)
    gap = ((GRID.centres - START[4]) ** 2).sum(axis=-1)
    assert np.allclose(flat.estimates[4], GRID.normalize(np.exp(-0.5 * gap / 0.09)))
    kernel = make(0.5, density.Flooding(), initial_density="observed").start(START)
    assert np.allclose(kernel.estimates, density.kernels(START, GRID, bandwidth=H))
    central = make(0.5, density.Centralised(), initial_density="observed").start(START)
    assert np.allclose(
        central.estimates[3], density.kernel_density(START, GRID, bandwidth=H)
    )


def test_mass_can_change_where_the_prior_says_so() -> None:
    """The constant wave's variance is mass_std², and R from the observed density leaks mass."""
    f = make(0.5, density.Flooding(), mass_std=0.2, noise="observed")
    state = f.start(START)
    P = state.filters.covariance(0) * GRID.volume**2
    assert P.sum() == pytest.approx(0.04, rel=1e-9)
    assert np.abs(GRID.integral(last(f).estimates) - 1).max() > 1e-4
    mass = last(make(0.5, density.Flooding(), noise="observed"))
    assert np.abs(GRID.integral(mass.estimates) - 1).max() < 1e-12


def test_consensus_may_start_flat() -> None:
    """(14) and Section VI at once: consensus and filter start at one flat Gaussian."""
    f = make(0.5, density.PIConsensus(initial_std=0.3), initial_std=0.3)
    state = f.start(START)
    assert np.abs(state.carried[0][:, :100] - state.estimates).max() < 1e-14
    other = make(0.5, density.PIConsensus()).start(START)
    assert np.array_equal(state.carried[2], other.carried[2])
    assert np.abs(GRID.integral(last(f).observed) - 1).max() < 1e-12
