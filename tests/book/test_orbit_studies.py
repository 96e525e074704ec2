"""Intervals of the pages on orbits, and statements of their text about the stored studies."""

from __future__ import annotations

from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pytest

from bookkit import studies
from distfilt import mixtures
from distfilt.metrics import Interval, mean_interval, proportion_interval

intervals: Any = studies.script("_orbit_intervals")
study: Any = studies.script("orbit")
STORED = studies.stored("semeraro", "orbit")
RING = studies.stored("semeraro", "ring")


def mean_metric(row: str, metric: str) -> np.ndarray:
    """Return a metric of the paper's scene, mean over the epochs before the ephemeris."""
    epochs = [study.HOURS[k] for k in study.EARLY]
    values = [STORED.metric(f"{row}_{metric}_{hour}") for hour in epochs]
    return np.asarray(np.mean(values, axis=0))


def ratio(row: str, other: str, part: str = "tp", scene: str = "") -> Interval:
    """Return the ratio of two rows' RMSE from 2 to 20 h."""
    errors = [
        STORED.metric(f"{scene}_{name}_error_{part}")
        if scene
        else mean_metric(name, f"error_{part}")
        for name in (row, other)
    ]
    interval: Interval = intervals.rmse_ratio(*errors)
    return interval


def test_ratio_of_proportional_errors_has_no_width() -> None:
    errors = np.random.default_rng(1).chisquare(3, size=30)
    v = intervals.rmse_ratio(4 * errors, errors)
    assert np.allclose([v.low, v.estimate, v.high], 2)
    assert np.isclose(v.error, 0)


def test_ratio_is_that_of_sums_and_its_interval_holds_it() -> None:
    rng = np.random.default_rng(2)
    a, b = rng.chisquare(3, size=(2, 40))
    v = intervals.rmse_ratio(a, b)
    assert np.isclose(v.estimate, np.sqrt(a.sum() / b.sum()))
    assert v.low < v.estimate < v.high
    # A ratio of other labels is the reciprocal, on the same resampled seeds.
    draws = intervals.resample_ratios(a, b)
    assert np.allclose(draws, 1 / intervals.resample_ratios(b, a))


def test_interval_covers_the_true_ratio() -> None:
    rng = np.random.default_rng(3)
    # Both errors have the same law, so the ratio is one; 200 studies of 48 seeds
    covered = [
        1 in intervals.rmse_ratio(*rng.chisquare(3, size=(2, 48))) for _ in range(200)
    ]
    assert 0.88 < np.mean(covered) < 0.99


def test_rows_are_drawn_from_the_top_with_their_intervals() -> None:
    rows = {"first": Interval(1.0, 0.8, 1.1, 0.1), "second": Interval(2, 1, 4, 0.5)}
    _, ax = plt.subplots()
    intervals.draw_intervals(ax, rows, shift=0.25)
    (line,) = ax.containers
    assert np.allclose(line[0].get_xdata(), [1, 2])
    assert np.allclose(line[0].get_ydata(), [-0.25, -1.25])
    (ends,) = line[2]
    spans = [segment[:, 0] for segment in ends.get_segments()]
    assert np.allclose(spans, [[0.8, 1.1], [1, 4]])
    assert [text.get_text() for text in ax.get_yticklabels()] == ["first", "second"]
    plt.close("all")


def test_scenes_are_those_of_the_text() -> None:
    assert study.LATE["widen"] == 3
    assert study.SCALE[3:] == [6.8] * 3
    # Filters of the page have the study's parameters as plain numbers.
    assert (study.TABLE["mixands"], study.TABLE["stretch"]) == (12, 5.0)
    assert study.ROWS["late"]["none"]["n_components"] == 30
    # The late scene has no ephemeris, and no angle before 20 h.
    assert study.LATE["first_angle"] == 20
    assert study.LATE["fix_at"] == 0


def test_three_pieces_stand_for_a_normal_to_a_hundredth() -> None:
    weights, means = mixtures.split_library(std=0.7)
    x = np.linspace(-4, 4, 401)
    pieces = np.exp(-0.5 * ((x - means[:, None]) / 0.7) ** 2) / 0.7
    gap = weights @ pieces - np.exp(-0.5 * x**2)
    assert np.abs(gap).max() / np.sqrt(2 * np.pi) < 0.01


def test_rules_for_weights_differ_as_the_text_says() -> None:
    assert ratio("c2", "c3").low > 1
    assert ratio("average", "c3").low > 1
    assert abs(ratio("all", "c3").estimate - 1) < 2e-3


@pytest.mark.parametrize("scene", ["", "arctan", "sign", "fixes", "three", "five"])
def test_increments_give_the_joint_filter(scene: str) -> None:
    v = ratio("increments", "bound", scene=scene)
    assert 1 - 2e-3 < v.low < v.high < 1 + 2e-3


def test_an_ephemeris_that_is_sent_counts_twice() -> None:
    once = mean_interval(STORED.metric("increments_nees_t_22"))
    twice = mean_interval(STORED.metric("twice_nees_t_22"))
    assert 1 in once
    assert 2 in twice
    assert 1 not in twice


def test_fusion_adds_nothing_after_the_ephemeris() -> None:
    v = intervals.rmse_ratio(
        *(STORED.metric(f"{r}_error_ep_24") for r in ("c3", "none"))
    )
    assert 0.99 < v.low < 1 < v.high < 1.01


def lost(name: str) -> Interval:
    """Return the share of runs on the ring that a method loses."""
    runs = len(RING) * studies.script("ring").RUNS
    return proportion_interval(int(RING.metric(f"{name}_lost").sum()), runs)


def test_who_loses_the_target_on_the_ring() -> None:
    assert lost("joint").estimate == 0
    assert lost("sight_100_extended").estimate == 0
    assert lost("sight_20_converted").estimate == 0
    assert lost("increments").low > 0.05
    assert lost("sight_100_increments").low > 0.5
    # On the small circle extended filters lose runs, together or alone.
    assert min(lost(f"sight_20_{way}").low for way in ("extended", "alone")) > 0


def test_consistency_on_the_ring() -> None:
    nees = {
        name: mean_interval(RING.metric(f"{name}_nees"))
        for name in ("increments", "intersection", "joint")
    }
    assert nees["intersection"].high < 0.9 < nees["joint"].low
    assert nees["joint"].high < 1.1 < nees["increments"].low
    errors = [RING.metric(f"{name}_error").mean() for name in ("increments", "joint")]
    assert abs(errors[0] / errors[1] - 1) < 0.05


def test_pair_of_walking_targets_has_the_variances_of_the_text() -> None:
    # Increments of two agents, and all measurements in one filter, ten steps on a line
    reported = {}
    for q in (0.1, 0.5):
        increments = np.diag([4.0, 1.0])
        joint = np.diag([4.0, 1.0, 1.0])
        h = np.array([1.0, -1.0])
        both = np.array([[1.0, -1.0, 0.0], [1.0, 0.0, -1.0]])
        for _ in range(10):
            increments = increments + np.diag([q, 0.0])
            before = increments[0, 0]
            gain = increments @ h / (h @ increments @ h + 0.3)
            increments = increments - np.outer(gain, h @ increments)
            # The other agent's gain in information, added to the target
            added = 1 / increments[0, 0] - 1 / before
            first = increments[:, 0]
            increments = increments - added * np.outer(first, first) / (
                1 + added * first[0]
            )
            joint = joint + np.diag([q, 0.0, 0.0])
            joint = np.linalg.inv(np.linalg.inv(joint) + both.T @ both / 0.3)
        reported[q] = (round(increments[0, 0], 3), round(joint[0, 0], 3))
    assert reported == {0.1: (0.297, 0.529), 0.5: (0.191, 0.572)}
