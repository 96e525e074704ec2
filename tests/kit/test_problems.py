"""From a log to a filter and back: components, sensors, landmarks that begin, errors."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from bookkit import datasets
from bookkit.datasets import Defects
from distfilt.filters import GaussianFilter
from distfilt.models import planar_odometry

# Two robots that stand, and two landmarks: the first robot looks along the first axis.
TRUTH = pd.DataFrame(
    [
        (t, robot, *pose)
        for robot, pose in (("A", (0.0, 0.0, 0.0)), ("B", (4.0, 0.0, np.pi)))
        for t in (0.0, 1.0, 2.0)
    ],
    columns=["time", "robot", "x", "y", "heading"],
)
LANDMARKS = pd.DataFrame(
    {"x": [3.0, 2.0], "y": [4.0, -1.0]}, index=pd.Index(["L0", "L1"], name="subject")
)


def make_log(*rows: tuple[float, str, str, str, tuple[float, ...]]) -> datasets.Dataset:
    """Return a log of these events."""
    events = datasets.table.make_events([(*row, None) for row in rows])
    return datasets.Dataset(events, TRUTH, LANDMARKS, ("A", "B"))


def test_where_bodies_stand_in_the_state() -> None:
    data = make_log((0.0, "A", "range", "B", (4.0,)))
    places = datasets.list_places(data)
    assert places == {"A": [0, 1], "B": [3, 4], "L0": [6, 7], "L1": [8, 9]}
    fewer = datasets.list_places(data, anchors=LANDMARKS.loc[["L0"]])
    assert fewer == {"A": [0, 1], "B": [3, 4], "L1": [6, 7]}


def test_sensors_predict_the_geometry() -> None:
    data = make_log((0.0, "A", "range", "B", (4.0,)))
    state = [*TRUTH.iloc[0, 2:], *TRUTH.iloc[3, 2:], 3.0, 4.0, 2.0, -1.0]
    sensors = datasets.make_sensors(data, "range_bearing", (0.1, 0.02))
    assert len(sensors) == 2 * 3 and ("A", "A") not in sensors
    assert np.allclose(sensors["A", "L0"].predict(state), [5.0, np.arctan2(4, 3)])
    # B looks backwards along the first axis, and has the other robot straight ahead.
    assert np.allclose(sensors["B", "A"].predict(state), [4.0, 0.0])
    ranges = datasets.make_sensors(data, "range", 0.3, anchors=LANDMARKS)
    # From B at (4, 0) to L1 at (2, -1), and between the robots
    assert np.allclose(ranges["B", "L1"].predict(state[:6]), np.sqrt(5))
    assert np.allclose(ranges["A", "B"].predict(state[:6]), 4.0)
    with pytest.raises(ValueError, match="kind must be range or range_bearing"):
        datasets.make_sensors(data, "offset", 0.3)
    with pytest.raises(ValueError, match="anchors must be None for range_bearing"):
        datasets.make_sensors(data, "range_bearing", (0.3, 0.1), anchors=LANDMARKS)


def test_observations_belong_to_the_robot_that_made_them() -> None:
    data = make_log((0.5, "B", "range", "L0", (4.2,)), (0.7, "A", "range", "B", (4.1,)))
    first, second = datasets.list_observations(data, "range", 0.3, anchors=LANDMARKS)
    assert (first.t, first.agent, first.value.tolist()) == (0.5, 1, [4.2])
    assert (second.t, second.agent, second.value.tolist()) == (0.7, 0, [4.1])
    strange = make_log((0.5, "B", "range", "L7", (4.2,)))
    with pytest.raises(ValueError, match="robot B observing 'L7' at 0.5 s"):
        datasets.list_observations(strange, "range", 0.3)


def test_offsets_become_sightings() -> None:
    data = make_log(
        (0.5, "A", "offset", "L0", (0.0, 2.0)), (0.7, "A", "range", "B", (4.1,))
    )
    seen = data.polar().of_kind("range_bearing")
    assert seen[["range", "bearing"]].to_numpy().tolist() == [[2.0, np.pi / 2]]
    assert len(data.polar().of_kind("range")) == 1 and len(data.of_kind("offset")) == 1


def test_errors_by_hand() -> None:
    data = make_log((0.0, "A", "range", "B", (4.0,)))
    means = np.tile(data.true_state(0.0), (2, 1))
    # A is off by 0.3 m and 0.4 m, and B's heading by a whole turn and 0.2 rad.
    means[:, 0] += 0.3
    means[:, 1] += 0.4
    means[:, 5] += 2 * np.pi + 0.2
    covs = np.tile(np.diag([0.09, 0.16, 1, 1, 1, 0.04]), (2, 1, 1))
    errors = datasets.score_poses(data, np.array([1.0, 9.0]), means, covs)
    # 0.3² + 0.4² and 0.2², as means over two robots; the NEES 0.3²/0.09 + 0.4²/0.16 + 0.2²/0.04
    # by its six components
    assert np.allclose(errors.loc[1.0], [0.25 / 2, 0.04 / 2, 3 / 6])
    # Behind the end of the truth
    assert errors.loc[9.0].isna().all()
    # With agents in between: the mean over them
    right = np.tile(data.true_state(0.0), (1, 1))
    means_of_both = np.stack([means[:1], right], axis=1)
    covs_of_both = np.stack([covs[:1], covs[:1]], axis=1)
    both = datasets.score_poses(data, np.array([1.0]), means_of_both, covs_of_both)
    # The second agent errs in nothing.
    assert np.allclose(both.loc[1.0], [0.25 / 4, 0.04 / 4, 3 / 12])
    # A gap of one robot leaves the other's error.
    gap = replace(data, truth=TRUTH[TRUTH["robot"] == "B"])
    errors = datasets.score_poses(gap, np.array([1.0]), means[:1], covs[:1])
    assert np.allclose(errors.loc[1.0], [0.0, 0.04, 1 / 3])


def test_errors_of_landmarks_by_hand() -> None:
    data = make_log((0.0, "A", "range", "B", (4.0,)))
    mean = np.append(data.true_state(0.0), [3.0, 4.5, 2.0, -1.0])
    cov = np.diag([1.0] * 6 + [1.0, 0.25, 1.0, 1.0])
    errors = datasets.score_landmarks(data, mean, cov)
    # L0 is off by 0.5 m in its second coordinate: 0.5², and 0.5²/0.25 by two components.
    assert errors["place"].to_dict() == {"L0": 0.25, "L1": 0.0}
    assert errors["place_nees"].to_dict() == {"L0": 0.5, "L1": 0.0}


@pytest.mark.parametrize("nearest, begins_at", [(1.0, 3), (np.inf, 1)])
def test_a_landmark_begins_where_two_sightings_agree(
    nearest: float, begins_at: int
) -> None:
    """The first sighting names L0 and sees L1; the second and the third agree."""
    right = (5.0, float(np.arctan2(4, 3)))
    wrong = (float(np.sqrt(5)), float(np.arctan2(-1, 2)))
    rows = [(0.0, "A", "odometry", "", (0.0, 0.0))]
    rows += [
        (0.1 * k, "A", "range_bearing", "L0", value)
        for k, value in enumerate([wrong, right, right, right], start=1)
    ]
    data = make_log(*rows)
    model = planar_odometry(*data.body_rates(0.1), n_constants=4)
    f = GaussianFilter(model, [None])
    prior = np.append(data.true_state(0.0), np.zeros(4))
    state = f.start((prior, np.diag([1e-6] * 6 + [100.0] * 4)))
    found = list(
        datasets.follow_sightings(
            f, state, data, std=(0.05, 0.02), dt=0.1, nearest=nearest
        )
    )
    assert [step for step, _ in found] == [1, 2, 3, 4]
    variances = [float(state.covariances[0, 6, 6]) for _, state in found]
    began = 1 + int(np.argmax(np.array(variances) < 1.0))
    assert began == begins_at
    place = found[-1][1].means[0, 6:8]
    error = np.linalg.norm(place - [3.0, 4.0])
    # Without a gate the first sighting's place is averaged with the later ones.
    assert error < 0.01 if nearest == 1.0 else error > 0.5


def test_the_truth_does_not_reach_the_filter(tmp_path: Path) -> None:
    """Estimates are the same bits when the truth is taken out of the folder."""
    folder = datasets.write_utias(
        tmp_path / "set",
        rng=np.random.default_rng(4),
        duration=20.0,
        defects=Defects(gap=0.0),
    )
    data = datasets.read_utias(folder, unknown="drop")
    start = data.start_poses(1.0, std=(0.05,) * 3, rng=np.random.default_rng(0))
    for path in folder.glob("*Groundtruth.dat"):
        path.unlink()
    blind = datasets.read_utias(folder, unknown="drop")
    ends = []
    for log in (data, blind):
        n = 2 * len(log.landmarks)
        model = planar_odometry(
            *log.body_rates(0.1), std=(0.04, 0.0, 0.04), n_constants=n
        )
        f = GaussianFilter(model, [None], gate_probability=0.999)
        cov = np.diag([*start[1].diagonal(), *[100.0] * n])
        state = f.start((np.append(start[0], np.zeros(n)), cov), t=1.0)
        *_, (_, last) = datasets.follow_sightings(
            f, state, log, std=(0.1, 0.04), dt=0.1
        )
        ends.append(last)
    assert np.array_equal(ends[0].means, ends[1].means)
    assert np.array_equal(ends[0].covariances, ends[1].covariances)
