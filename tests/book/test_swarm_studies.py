"""Quantities of the swarm's studies: counts in blocks, times of settling, explicit consensus."""

from __future__ import annotations

import numpy as np
import pytest

from bookkit import studies
from distfilt.network import Channel, graphs, pi_start, pi_step

densities = studies.script("densities")
tenfold = studies.script("tenfold")
figure = studies.script("locals")
swarm_views = studies.script("_swarm_views")
ROOM = densities.grid()


@pytest.mark.parametrize("blocks", densities.BLOCKS)
def test_histogram_of_the_agents_counts_without_an_error(blocks: int) -> None:
    x = np.random.default_rng(1).random((50, 2))
    errors = densities.count_errors(ROOM, ROOM.histogram(x), x, blocks)
    assert errors.shape == (1,)
    assert errors[0] < 1e-12


def test_uniform_density_for_agents_in_one_block() -> None:
    # 36 blocks, 72 agents in the first: the density predicts 2 in each.
    x = np.full((72, 2), 0.05)
    both = np.stack([np.ones(ROOM.size), np.zeros(ROOM.size)])
    uniform, empty = densities.count_errors(ROOM, both, x, 6)
    assert np.isclose(uniform, np.sqrt((70**2 + 35 * 2**2) / 36))
    assert np.isclose(empty, np.sqrt(72**2 / 36))


def test_blocks_are_squares_of_the_room() -> None:
    # Mass of the lower half in one axis only: agents there are counted in its blocks.
    x = np.array([[0.25, 0.25], [0.25, 0.75]])
    left = np.where(ROOM.centres[:, 0] < 0.5, 2.0, 0.0)
    # Three blocks along a side; the middle ones share the half's last sixth.
    masses = 2 * np.array([2 / 3, 1 / 3, 0]) / 3
    counts = np.zeros((3, 3))
    counts[0, 0] = 1
    counts[0, 2] = 1
    expected = np.sqrt(((masses[:, None] - counts) ** 2).mean())
    assert np.isclose(densities.count_errors(ROOM, left, x, 3)[0], expected)


def test_times_of_settling_count_from_the_start() -> None:
    error = np.array([3.0, 2.0, 0.5, 2.0, 0.5, 0.4])
    # With the start: the last value above 1 is that of the third step.
    assert np.isclose(tenfold.settles(error, 1.0), 4 * tenfold.DT)
    assert tenfold.settles(error, 5.0) == 0.0
    # An error that never settles does so at the end, after five steps.
    assert np.isclose(tenfold.settles(error, 0.1), 5 * tenfold.DT)
    # Without the start the first error is that after one step; the run lasts 60 s.
    step = figure.CASE.end / 5
    assert np.isclose(figure.below(error[1:], 1.0), 4 * step)
    assert np.isclose(figure.below(error[1:], 5.0), step)
    assert np.isclose(figure.below(error[1:], 0.1), figure.CASE.end)


@pytest.mark.parametrize("scheme", ["paper_explicit", "fast_explicit", "stiff_flat"])
def test_consensus_is_the_librarys(scheme: str) -> None:
    rng = np.random.default_rng(2)
    graph = graphs.ring(8)
    z = rng.normal(size=(8, 3))
    nu, eta = tenfold.consensus(z, np.zeros_like(z), z, graph, scheme)
    nu, eta = tenfold.consensus(nu, eta, z, graph, scheme)
    state = pi_start(z)
    for _ in range(2):
        state = pi_step(
            state,
            z,
            Channel(graph),
            dt=tenfold.DT,
            substeps=1 if scheme in tenfold.EXPLICIT else None,
            **tenfold.gains_of(scheme),
        )
    assert np.allclose(nu, state.estimate, rtol=0, atol=1e-13)
    assert np.allclose(eta, state.integral, rtol=0, atol=1e-13)


def test_amplification_has_the_known_limits() -> None:
    # Real roots: 2 = dt (α + a λ) up to the slow root, that is λ near 50 and 5.
    for scheme, edge in (("paper", 50.0), ("stiff", 4.9505), ("fast", 25.4904)):
        assert tenfold.amplification(0.999 * edge, scheme) < 1
        assert tenfold.amplification(1.001 * edge, scheme) > 1
    # The common mode is forgotten at the rate α, its integral never changes.
    assert tenfold.amplification(0.0, "paper") == 1.0
    # On a complete graph one explicit step multiplies every difference by this factor.
    graph = graphs.complete(60)
    difference = np.random.default_rng(3).normal(size=(60, 1))
    difference -= difference.mean()
    nu = difference
    eta = np.zeros_like(nu)
    sizes = []
    for _ in range(40):
        nu, eta = tenfold.consensus(nu, eta, 0 * nu, graph, "paper_explicit")
        sizes.append(np.linalg.norm(nu))
    factor = tenfold.amplification(60.0, "paper")
    assert factor > 1
    assert np.isclose(sizes[-1] / sizes[-2], factor, rtol=1e-6)


def test_diverged_estimates_stay_as_they_are() -> None:
    graph = graphs.complete(4)
    large = np.full((4, 1), 2 * tenfold.DIVERGED)
    small = np.ones((4, 1))
    memories = {"fast_explicit": (large, large), "silent": (small, small)}
    advanced = tenfold.exchange(memories, np.zeros((4, 1)), graph)
    assert advanced["fast_explicit"][0] is large
    # Without messages an estimate decays to its own input at the rate α.
    decay = 1 - tenfold.DT * tenfold.swarm.PAPERS["alpha"]
    assert np.allclose(advanced["silent"][0], decay)


def test_views_are_those_of_the_first_stored_run() -> None:
    stored = studies.stored("zheng", "locals")
    views, errors = swarm_views.repeat_first_run(agent=2, every=20, seconds=4.0)
    assert list(views) == ["0", "2", "4"]
    for name, line in zip(("kde", "central", "paper_2"), errors, strict=True):
        for t in (2, 4):
            expected = stored.metric(f"{name}_at_{t}")[0]
            assert np.isclose(line[round(t / 0.1) - 1], expected, rtol=figure.rtol)
    # The last view is what the last errors were computed from.
    _, density, centralised, local = views["4"]
    distances = ROOM.norm(np.stack([centralised, local]) - density)
    assert np.allclose(distances, errors[1:, -1])
