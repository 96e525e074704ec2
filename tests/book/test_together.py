"""The comparison of chapter 11: bills counted by hand, and filters that it adds to the library."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from bookkit import studies
from distfilt.filters import GaussianFilter
from distfilt.network import Channel, graphs

together: Any = studies.script("_together")
read: Any = studies.script("_together_read")


def bills(name: str, cell: str) -> tuple[float, float]:
    """Return what the ledger counts of a cell on two steps of one run, by link and broadcast."""
    problem = together.problem(name)
    short = replace(problem, times=problem.times[:2], burn_in=0)
    truth, observations = problem.simulate(1, np.random.default_rng(0))
    data = truth[:2], [values[:2] for values in observations]
    f = together.CELLS[cell].make(problem, 1.0)
    scores = together.score_filter(short, f, data, np.random.default_rng(1))
    return scores["floats"], scores["cast"]


# A belief of four components, with a mean and the upper triangle of a covariance.
BELIEF = 4 + 10


@pytest.mark.parametrize(
    ("cell", "by_link", "by_broadcast"),
    [
        ("ekf_alone", 0, 0),
        # One number to two neighbours
        ("ekf_near", 2, 1),
        # Own value and number both ways, and each neighbour's on to the other side
        ("ekf_hops", 2 * (2 + 2), 2 * (1 + 2)),
        # Eight messages for each of eight observations; the maker's two are one transmission.
        ("ekf_flood", 2 * 8, 2 * 7),
        ("ekf_ci", 2 * (1 + BELIEF), 1 + BELIEF),
        ("ekf_naive", 2 * BELIEF, BELIEF),
        # A mean, and the upper triangles of both parts
        ("ekf_split", 2 * (4 + 2 * 10), 4 + 2 * 10),
        # An observation, then a mean
        ("ekf_diffuse", 2 * (1 + 4), 1 + 4),
        # Seven links, two messages each; by broadcast the root reaches two at once.
        ("ekf_tree", 14 * BELIEF / 8, 13 * BELIEF / 8),
        ("ekf_channel", 14 * BELIEF / 8, 14 * BELIEF / 8),
        ("ekf_icf", 4 * 2 * BELIEF, 4 * BELIEF),
        ("ekf_hcmci", 8 * 2 * BELIEF, 8 * BELIEF),
        ("ekf_two", 2 * 2 * BELIEF, 2 * BELIEF),
    ],
)
def test_bills_on_a_ring_of_eight_are_those_counted_by_hand(
    cell: str, by_link: float, by_broadcast: float
) -> None:
    if cell == "ekf_channel":
        # The channel filter's graph is the tree, where every message goes to all neighbours.
        by_broadcast = BELIEF
    assert bills("linear", cell) == pytest.approx((by_link, by_broadcast))


def test_a_centre_is_billed_for_observations_in_and_the_estimate_back() -> None:
    # On a path of three the ends send a value and a number each; a belief of three
    # components comes back, to both at once by broadcast.
    by_link = (2 * 2 + 2 * 9) / 3
    by_broadcast = (2 * 2 + 9) / 3
    centre = read.centre_bills(together.problem("lorenz"))
    assert centre == pytest.approx((by_link, by_broadcast))
    # On a ring of eight the hops to the centre are 1, 1, 2, 2, 3, 3 and 4.
    by_link, _ = read.centre_bills(together.problem("linear"))
    assert by_link == pytest.approx((2 * 16 + 7 * BELIEF) / 8)


def test_sums_along_a_tree_are_those_of_all_agents() -> None:
    rng = np.random.default_rng(3)
    for graph in (graphs.ring(7), graphs.star(5), graphs.complete(4), graphs.path(3)):
        n = graph.n_agents
        tree = together.spanning_tree(graph)
        assert len(tree) == n - 1
        assert len({agent for agent, _ in tree}) == n - 1
        values = rng.normal(size=(2, n, 3))
        channel = Channel(graph, runs=(2,))
        mean = together.average_on_tree(values, channel)
        expected = values.mean(axis=1, keepdims=True)
        np.testing.assert_allclose(mean, np.broadcast_to(expected, mean.shape))
        assert channel.ledger.scalars.sum() == 2 * (n - 1) * 3


def test_split_intersection_lies_between_the_own_and_the_joint_filter() -> None:
    problem = together.problem("linear")
    _, observations = problem.simulate(3, np.random.default_rng(5))
    args = problem.model, problem.sensors, problem.graph
    kalman = GaussianFilter(*args, share_observations=False)
    split = together.SplitIntersection(*args)
    first = [values[0] for values in observations]
    states = []
    for f in (kalman, split):
        start = f.start(problem.prior, runs=(3,))
        states.append(f.step(start, problem.times[0], first))
    # Fusing reduces the determinant, but no variance falls below the joint filter's.
    joint = GaussianFilter(problem.model, [problem.all_sensors])
    start = joint.start(problem.prior, runs=(3,))
    bound = joint.step(start, problem.times[0], [np.concatenate(first, axis=-1)])
    log_dets = [np.linalg.slogdet(state.covariances)[1] for state in states]
    assert (log_dets[1] < log_dets[0] - 0.1).all()
    excess = states[1].covariances - bound.covariances
    assert np.linalg.eigvalsh(excess).min() > -1e-9


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_a_failed_run_has_no_error() -> None:
    """Neither zero nor a number: NaN in every score."""
    problem = together.problem("lorenz")
    data = problem.simulate(2, np.random.default_rng(0))
    data[1][0][3, 1] = 1e200
    f = together.CELLS["ekf_flood"].make(problem, 1.0)
    scores = together.score_filter(problem, f, data, None)
    assert np.isfinite(scores["error"][0])
    assert np.isnan(scores["error"][1])
    assert np.isnan(scores["nees"][1])


def test_tuning_takes_the_least_error_of_consistent_values() -> None:
    errors = np.array([1.0, 2.0, 1.5, np.nan])
    nees = np.array([4.0, 1.1, 0.9, np.nan])
    assert together.best_value(errors, nees) == 2
    # Where none is consistent, the least error; the value nearest to one counts too.
    assert together.best_value(errors, nees + 3) == 0
    assert together.values_that_count(errors[:3], nees[:3] + 3) == {0, 2}


def test_held_out_problems_have_tuned_values_of_their_own() -> None:
    rows = {row["name"] for row in together.TUNED.tables["tuned"]}
    for name in (*together.FOUR, *together.THREE):
        for cell in together.cell_names(name):
            has_row = f"{name}_{cell}" in rows
            assert has_row == bool(together.CELLS[cell].grid)
