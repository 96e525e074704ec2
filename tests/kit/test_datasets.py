"""Logs in the published formats: reading inverts writing, and errors name the line."""

from __future__ import annotations

import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest

from bookkit import datasets
from bookkit.datasets import DataError, Defects
from distfilt.models import planar_odometry

CLEAN = Defects.none()
NOISELESS = (0.0, 0.0, 0.0, 0.0)

# One robot and one landmark, by hand; the robot drives for two seconds.
UTIAS = {
    "Barcodes.dat": "# Subject barcode\n1 5\n6 14\n",
    "Landmark_Groundtruth.dat": "# Subject x y\n6 3.0 4.0 0.001 0.001\n",
    "Robot1_Odometry.dat": "# Time v w\n100.0 0.5 0.0\n101.0 1.0 0.2\n102.0 0.0 0.0\n",
    "Robot1_Measurement.dat": "100.5 14 2.5 0.1 # a landmark\n\n101.5 14 2.0 -0.1\n",
    "Robot1_Groundtruth.dat": "100.0 0 0 3.1\n101.0 0.5 0 -3.1\n102.0 1.5 0 -3.0\n",
}

PYFG = """\
VERTEX_SE2 10.0 A0 0.0 0.0 0.5
VERTEX_SE2 10.5 A1 1.0 0.0 0.6
VERTEX_SE2 10.0 B0 5.0 5.0 0.0
VERTEX_SE2 10.5 B1 5.0 5.0 0.0
VERTEX_XY L0 3.0 4.0
VERTEX_SE2:PRIOR 10.0 A0 0.1 0.2 0.3 4 1 2 5 3 6
VERTEX_XY:PRIOR 10.0 L0 3.1 4.1 0.01 0.002 0.04
EDGE_SE2 10.0 A0 A1 1.0 0.1 0.2 0.1 0.0 0.0 0.2 0.0 0.3
EDGE_SE2_XY 10.5 A1 L0 2.0 3.0 0.5 0.0 0.6
EDGE_RANGE 10.5 A1 L0 4.5 0.09
EDGE_RANGE 10.5 A1 B1 6.4 0.09
"""


def write_utias(folder: Path, **changes: str) -> Path:
    """Write the set by hand, with the texts of some files changed."""
    for name, text in UTIAS.items():
        (folder / name).write_text(changes.get(name.removesuffix(".dat"), text))
    return folder


def test_a_set_of_utias_by_hand(tmp_path: Path) -> None:
    data = datasets.read_utias(write_utias(tmp_path))
    assert data.robots == ("1",) and data.origin == 100.0 and data.dropped == 0
    assert data.events["time"].tolist() == [0.0, 0.5, 1.0, 1.5, 2.0]
    seen = data.of_kind("range_bearing")
    assert seen[["time", "range", "bearing"]].to_numpy().tolist() == [
        [0.5, 2.5, 0.1],
        [1.5, 2.0, -0.1],
    ]
    assert (
        seen["subject"].tolist() == ["6", "6"] and seen["robot"].tolist() == ["1"] * 2
    )
    assert data.landmarks.loc["6"].tolist() == [3.0, 4.0]
    # The heading goes on through π; between poses it is interpolated.
    poses = data.true_poses(np.array([0.5, 1.0, 2.5]))
    halfway = (3.1 + 2 * np.pi - 3.1) / 2
    assert np.allclose(poses[0, 0], [0.25, 0.0, halfway])
    assert np.isnan(poses[2]).all()
    assert np.allclose(data.true_state(1.0), poses[1, 0])


def test_odometry_is_averaged_over_time(tmp_path: Path) -> None:
    """Between 0.5 and 1.25 s: two thirds of 0.5 m/s, one third of 1 m/s."""
    data = datasets.read_utias(write_utias(tmp_path))
    times, rates = data.body_rates(0.75)
    assert times.tolist() == [0.0, 0.75, 1.5]
    assert np.allclose(rates[0], [0.5, 0.0, 0.0])
    assert np.allclose(rates[1], [(0.5 + 2 * 1.0) / 3, 0.0, 2 * 0.2 / 3])
    # The last input holds on.
    assert np.allclose(rates[2], [2 * 1.0 / 3, 0.0, 2 * 0.2 / 3])
    times, rates = data.body_rates()
    assert times.tolist() == [0.0, 1.0, 2.0]
    assert rates.tolist() == [[0.5, 0, 0], [1.0, 0, 0.2], [0, 0, 0]]


def test_observations_are_shifted_and_grouped(tmp_path: Path) -> None:
    text = "100.5 14 2.5 0.1\n100.5 5 1.0 0.0\n101.5 14 2.0 -0.1\n"
    folder = write_utias(tmp_path, Robot1_Measurement=text)
    data = datasets.read_utias(folder)
    groups = data.shifted("range_bearing", -0.3).by_step("range_bearing", 0.2)
    # The robot that reads its own barcode is left out.
    assert {k: len(group) for k, group in groups.items()} == {1: 1, 6: 1}
    robot, subject, value = groups[6][0]
    assert (robot, subject, value.tolist()) == ("1", "6", [2.0, -0.1])
    # The order of time holds for the odometry in between, and the log itself is not changed.
    later = data.shifted("range_bearing", 5.0).events
    assert later["kind"].tolist()[:3] == ["odometry"] * 3
    assert data.events["kind"].tolist()[1] == "range_bearing"


# The form of the published files, with numbers of our own: four lines of comment, of which one
# calls barcodes subjects, tabs and spaces, line ends of another system, several sightings at once.
HEAD = "# A collection\r\n# made by somebody 2009\r\n"
PUBLISHED = {
    "Barcodes.dat": "# Barcode Data Format:\r\n# Subject #    Barcode #\r\n"
    "  1 \t   5 \r\n  2 \t  14 \r\n  6 \t  72 \r\n",
    "Landmark_Groundtruth.dat": "# Format:\r\n"
    "# Subject #    x [m]    y [m]    x std-dev [m]    y std-dev [m] \r\n"
    "  6 \t 1.25000000 \t -3.50000000 \t 0.00010000 \t 0.00030000 \r\n",
    "Robot1_Odometry.dat": "# Format:\r\n"
    "# Time [s]    forward velocity [m/s]    angular velocity[rad/s] \r\n"
    "1248000000.100 \t  0.100 \t -0.250 \r\n1248000000.115 \t  0.000 \t  0.000 \r\n",
    "Robot1_Measurement.dat": "# Format:\r\n"
    "# Time [s]    Subject #    range [m]    bearing [rad] \r\n"
    "1248000000.900 \t  14 \t  3.000 \t -0.250 \r\n"
    "1248000000.900 \t  72 \t  6.500 \t  0.125 \r\n"
    "1248000001.150 \t  43 \t  1.000 \t  0.000 \r\n",
    "Robot1_Groundtruth.dat": "# Format:\r\n"
    "# Time [s]    x [m]    y [m]    orientation [rad] \r\n"
    "1247999990.000 \t 1.00000000 \t -3.00000000 \t 2.25000000 \r\n"
    "1248000000.900 \t 1.00000000 \t -3.00000000 \t 2.25000000 \r\n",
    "Robot2_Odometry.dat": "1248000000.050 \t  0.000 \t  0.000 \r\n",
    "Robot2_Measurement.dat": "# nothing seen\r\n",
}


def write_published(folder: Path) -> Path:
    """Write the set; the second robot has no truth."""
    folder.mkdir(exist_ok=True)
    for name, text in PUBLISHED.items():
        (folder / name).write_bytes((HEAD + text).encode())
    return folder


def test_a_set_in_the_published_form(tmp_path: Path) -> None:
    folder = write_published(tmp_path)
    with pytest.raises(DataError, match=r"Measurement.dat:7: barcode 43 is not in"):
        datasets.read_utias(folder)
    data = datasets.read_utias(folder, unknown="drop")
    assert data.robots == ("1", "2") and data.dropped == 1
    # Barcode 14 is robot 2, and 72 is landmark 6, whatever the head says.
    seen = data.of_kind("range_bearing")
    assert seen["subject"].tolist() == ["2", "6"]
    assert seen[["range", "bearing"]].to_numpy().tolist() == [
        [3.0, -0.25],
        [6.5, 0.125],
    ]
    # Seconds since 1970 keep their milliseconds.
    assert np.allclose(seen["time"], 0.85, atol=1e-6)
    assert np.allclose(data.truth["time"], [-10.05, 0.85], atol=1e-6)
    assert data.origin == pytest.approx(1248000000.05, abs=1e-6)
    times, rates = data.body_rates()
    assert np.allclose(times, [0.0, 0.05, 0.065], atol=1e-6)
    assert rates[1].tolist() == [0.1, 0.0, -0.25, 0.0, 0.0, 0.0]


def test_the_truth_is_not_needed(tmp_path: Path) -> None:
    """Without the files of truth the log is the same, and only scores are missing."""
    folder = write_published(tmp_path)
    with_truth = datasets.read_utias(folder, unknown="drop")
    for path in folder.glob("*Groundtruth.dat"):
        path.unlink()
    data = datasets.read_utias(folder, unknown="drop")
    assert data.events.equals(with_truth.events)
    assert data.truth.empty and data.begin == np.inf
    assert data.landmarks.index.tolist() == ["6"]
    assert data.landmarks.isna().all(axis=None)
    rng = np.random.default_rng(0)
    with pytest.raises(
        DataError, match=r"at t = 0.5 s: robot 1 has none, robot 2 has none"
    ):
        data.start_poses(0.5, std=(0.1, 0.1, 0.1), rng=rng)


def test_first_poses_are_the_truth_with_errors(tmp_path: Path) -> None:
    data = datasets.read_utias(write_utias(tmp_path))
    std = (0.3, 0.2, 0.1)
    draws = [
        data.start_poses(1.0, std=std, rng=np.random.default_rng(seed))
        for seed in range(400)
    ]
    means = np.array([mean for mean, _ in draws])
    errors = means - data.true_poses(np.array([1.0])).ravel()
    assert np.allclose(errors.std(axis=0), std, rtol=0.15)
    assert np.allclose(draws[0][1], np.diag(np.square(std)))
    with pytest.raises(DataError, match=r"t = 9 s: robot 1 has 0.0 to 2.0 s"):
        data.start_poses(9.0, std=std, rng=np.random.default_rng(0))


def test_the_truth_has_gaps(tmp_path: Path) -> None:
    text = "100.0 0 0 0\n101.0 1 0 0\n105.0 5 0 0\n106.0 6 0 0\n"
    data = datasets.read_utias(write_utias(tmp_path, Robot1_Groundtruth=text))
    poses = data.true_poses(np.array([0.5, 3.0, 5.5]))
    assert np.isnan(poses[:, 0, 0]).tolist() == [False, True, False]
    # At both ends of the gap a pose has been logged.
    assert data.true_poses(np.array([1.0, 5.0]))[:, 0, 0].tolist() == [1.0, 5.0]
    filled = data.true_poses(np.array([3.0]), longest_gap=4.0)
    assert filled[0, 0, 0] == 3.0
    with pytest.raises(DataError, match=r"robot 1 has a gap from 1.0 to 5.0 s"):
        data.start_poses(3.0, std=(0.1, 0.1, 0.1), rng=np.random.default_rng(0))


def test_a_gap_of_the_odometry_warns(tmp_path: Path) -> None:
    """Ten inputs a second, then nothing for five seconds, in which the last one is held."""
    times = [*np.arange(100.0, 103.0, 0.1), *np.arange(108.0, 110.0, 0.1)]
    text = "".join(f"{t:.1f} 1.0 0.0\n" for t in times)
    data = datasets.read_utias(write_utias(tmp_path, Robot1_Odometry=text))
    with pytest.warns(RuntimeWarning, match=r"robot 1 has a gap from 2.9 to 8.0 s"):
        _, rates = data.body_rates(0.5)
    assert np.allclose(rates[:, 0], 1.0)


def test_shorter_inputs_add_less_noise() -> None:
    """Two clocks cut each input in two, with errors of their own: half of the variance."""
    event = ("odometry", "", (1.0, 0.0), None)
    events = [(t, "A", *event) for t in (0.0, 1.0)]
    clocks = datasets.table.make_events([*events, (0.5, "B", *event)])
    truth = pd.DataFrame(columns=["time", "robot", "x", "y", "heading"])
    places = pd.DataFrame(columns=["x", "y"])
    data = datasets.Dataset(clocks, truth, places, ("A", "B"))
    variances = []
    for times, rates in (data.body_rates(), data.body_rates(1.0)):
        model = planar_odometry(times, rates, std=(0.1, 0.0, 0.0))
        variances.append(model.noise_at(np.zeros(6), 0.0, 1.0)[0, 0])
    assert np.allclose(variances, [0.1**2 / 2, 0.1**2])


def test_a_repeated_line_is_one_observation(tmp_path: Path) -> None:
    text = "100.5 14 2.5 0.1\n100.5 14 2.5 0.1\n100.5 14 2.5 0.2\n"
    data = datasets.read_utias(write_utias(tmp_path, Robot1_Measurement=text))
    ((_, group),) = data.by_step("range_bearing", 0.5).items()
    assert [value.tolist() for _, _, value in group] == [[2.5, 0.1], [2.5, 0.2]]


def test_a_landmark_without_a_surveyed_place(tmp_path: Path) -> None:
    """It is in the state, and has no score."""
    text = "1 5\n6 14\n7 15\n"
    data = datasets.read_utias(write_utias(tmp_path, Barcodes=text))
    assert data.landmarks.index.tolist() == ["6", "7"]
    assert data.landmarks.loc["6"].tolist() == [3.0, 4.0]
    assert data.landmarks.loc["7"].isna().all()
    errors = datasets.score_landmarks(data, np.zeros(7), np.eye(7))
    assert errors["place"].tolist()[0] == 25.0 and np.isnan(errors["place"].iloc[1])


@pytest.mark.parametrize(
    "name, text, message",
    [
        ("Robot1_Odometry", "100.0 0.5\n", r"Odometry.dat:1: expected 3 .* got 2"),
        ("Robot1_Odometry", "# a\n100.0 x 0\n", r"Odometry.dat:2: .* got 'x'"),
        ("Robot1_Odometry", "100.0 nan 0\n", r"Odometry.dat:1: .* finite"),
        ("Robot1_Odometry", "# nothing\n", r"Odometry.dat: no line of odometry"),
        ("Robot1_Odometry", "2 0 0\n1 0 0\n", r"Odometry.dat:2: times must not"),
        ("Robot1_Measurement", "100 14 1 0\n100 9 1 0\n", r"dat:2: barcode 9 is not"),
        ("Barcodes", "1 5\n6 5\n", r"Barcodes.dat:2: barcode 5 comes twice"),
        ("Landmark_Groundtruth", "6 3 4\n", r"Groundtruth.dat:1: expected 5"),
        ("Barcodes", "# nothing\n", r"Barcodes.dat: no line of barcodes"),
        ("Robot1_Measurement", "100 14 -1 0\n", r"dat:1: a range must be positive"),
        ("Robot1_Measurement", "100 14 1 0\n101 14 1 9\n", r"dat:2: .* in rad"),
        # A turn of 30 degrees a second, and headings that turn by it
        ("Robot1_Odometry", "100 0 30\n101 0 30\n", r"Odometry.dat: .* degrees"),
        (
            "Robot1_Groundtruth",
            "100.0 0 0 0\n100.1 0 0 3\n100.2 0 0 6\n",
            r"Groundtruth.dat: .* degrees",
        ),
        # Nanoseconds, and a clock that begins when the robot is switched on
        ("Robot1_Odometry", "1e17 0 0\n", r"Odometry.dat: expected times in seconds"),
        (
            "Robot1_Odometry",
            "1e6 0 0\n",
            r"Odometry.dat: begins .* after .*Groundtruth.dat",
        ),
    ],
)
def test_a_line_that_is_wrong_is_named(
    tmp_path: Path, name: str, text: str, message: str
) -> None:
    folder = write_utias(tmp_path, **{name: text})
    with pytest.raises(DataError, match=message):
        datasets.read_utias(folder)


def test_a_robot_that_is_missing_is_named(tmp_path: Path) -> None:
    folder = write_utias(tmp_path)
    (folder / "Robot2_Odometry.dat").write_text("100 0 0\n")
    with pytest.raises(DataError, match=r"Robot2_Measurement.dat: no such file"):
        datasets.read_utias(folder)
    (folder / "Barcodes.dat").unlink()
    with pytest.raises(DataError, match=r"Barcodes.dat: no such file"):
        datasets.read_utias(folder)
    empty = tmp_path / "empty"
    empty.mkdir()
    for file in ("Barcodes", "Landmark_Groundtruth"):
        (empty / f"{file}.dat").write_text(UTIAS[f"{file}.dat"])
    with pytest.raises(DataError, match="no robot is found"):
        datasets.read_utias(empty)


def test_an_unknown_barcode_can_be_left_out(tmp_path: Path) -> None:
    text = "100 14 1 0\n100 9 1 0\n"
    folder = write_utias(tmp_path, Robot1_Measurement=text)
    data = datasets.read_utias(folder, unknown="drop")
    assert data.dropped == 1 and len(data.of_kind("range_bearing")) == 1
    with pytest.raises(
        ValueError, match="kind must be one of odometry, .* got 'radar'"
    ):
        data.of_kind("radar")


def test_a_generated_set_without_noise_is_exact(tmp_path: Path) -> None:
    """Dead reckoning is the truth, and each observation is that of the true poses."""
    folder = datasets.write_utias(
        tmp_path / "set",
        rng=np.random.default_rng(3),
        duration=20.0,
        defects=CLEAN,
        noise=NOISELESS,
    )
    data = datasets.read_utias(folder)
    times = 0.1 * np.arange(190)
    truth = data.true_poses(times)
    pose = truth[0]
    _, rates = data.body_rates(0.1)
    for k, inputs in enumerate(rates[:189].reshape(189, -1, 3)):
        middle = pose[:, 2] + 0.05 * inputs[:, 2]
        shift = [np.cos(middle), np.sin(middle)] * inputs[:, 0]
        pose = pose + 0.1 * np.stack([*shift, inputs[:, 2]], axis=-1)
        assert np.allclose(pose, truth[k + 1], atol=2e-3)
    seen = data.of_kind("range_bearing")
    assert len(seen) > 50
    places = {robot: None for robot in data.robots}
    for row in seen.itertuples():
        poses = data.true_poses(np.array([row.time]))[0]
        own = poses[data.robots.index(row.robot)]
        if row.subject in places:
            place = poses[data.robots.index(row.subject), :2]
        else:
            place = data.landmarks.loc[row.subject].to_numpy()
        offset = place - own[:2]
        # Poses are in a file with times to the millisecond.
        assert abs(np.hypot(*offset) - row.range) < 2e-3
        error = np.arctan2(offset[1], offset[0]) - own[2] - row.bearing
        assert abs(np.angle(np.exp(1j * error))) < 2e-3


def test_a_generated_set_has_its_defects(tmp_path: Path) -> None:
    """Each of them changes the file, and the seed decides everything."""
    options: dict[str, Any] = {"duration": 60.0, "robots": 2}

    def make(name: str, defects: Defects, seed: int = 5) -> datasets.Dataset:
        rng = np.random.default_rng(seed)
        folder = datasets.write_utias(
            tmp_path / name, rng=rng, defects=defects, **options
        )
        return datasets.read_utias(folder, unknown="drop")

    plain = make("plain", CLEAN)
    again = make("again", CLEAN)
    assert plain.events.drop(columns="cov").equals(again.events.drop(columns="cov"))
    assert plain.dropped == 0
    gap = make("gap", Defects(gap=20.0))
    seen = gap.of_kind("range_bearing")
    for robot in gap.robots:
        assert np.diff(seen[seen["robot"] == robot]["time"]).max() >= 19.0
    assert make("unknown", Defects(unknown_barcode=0.5)).dropped > 10
    late = make("late", Defects(lag=0.3, gap=0.0, slips=0, clock_offset=0.0))
    first = plain.of_kind("range_bearing")["time"].min()
    assert late.of_kind("range_bearing")["time"].min() == pytest.approx(first + 0.3)
    biased = make("bias", Defects(turn_bias=0.5))
    _, difference = biased.body_rates(50.0)
    true_turn = np.diff(biased.true_poses(np.array([0.1, 50.0])), axis=0)[0, :, 2] / 50
    assert np.abs(difference[0, 2::3] - true_turn).max() > 0.1


def test_a_problem_with_ranges_by_hand(tmp_path: Path) -> None:
    path = tmp_path / "a.pyfg"
    path.write_text(PYFG)
    data = datasets.read_pyfg(path)
    assert data.robots == ("A", "B") and data.origin == 10.0
    prior = data.of_kind("prior").iloc[0]
    assert prior[["time", "x", "y", "heading"]].tolist() == [0.0, 0.1, 0.2, 0.3]
    assert prior["cov"].tolist() == [[4, 1, 2], [1, 5, 3], [2, 3, 6]]
    step = data.of_kind("displacement").iloc[0]
    # Known when the movement has ended.
    assert step[["time", "robot", "forward", "left", "turn"]].tolist() == [
        *(0.5, "A", 1.0, 0.1, 0.2)
    ]
    assert data.of_kind("offset").iloc[0]["cov"].tolist() == [[0.5, 0.0], [0.0, 0.6]]
    ranges = data.of_kind("range")
    assert ranges["subject"].tolist() == ["L0", "B"]
    assert ranges["range"].tolist() == [4.5, 6.4]
    assert data.of_kind("survey").iloc[0]["cov"].tolist() == [
        [0.01, 0.002],
        [0.002, 0.04],
    ]
    assert data.true_state(0.25).tolist() == [0.5, 0.0, 0.55, 5.0, 5.0, 0.0]
    with pytest.raises(DataError, match="none for robot B"):
        data.prior_poses()
    times, rates = data.body_rates()
    assert times.tolist() == [0.0, 0.5]
    assert np.allclose(rates[0, 2], 0.2 / 0.5) and not rates[:, 3:].any()


@pytest.mark.parametrize(
    "line, message",
    [
        ("EDGE_RANGE 10.5 A1 L0 4.5", r"pyfg:12: expected 3 numbers .* got 2"),
        ("EDGE_RANGE 10.5 A1 L9 4.5 0.1", r"pyfg:12: no VERTEX line declares 'L9'"),
        ("EDGE_SE2 10 A0 B1 0 0 0 1 0 0 1 0 1", r"pyfg:12: .* to the next pose"),
        ("VERTEX_SE2 10.2 A2 0 0 0", r"pyfg:12: times of robot A must not"),
        ("VERTEX_SE2 11 L2 0 0 0", r"pyfg:12: expected a robot's letter"),
        ("VERTEX_SE3:QUAT 11 A2 0 0 0 0 0 0 1", r"pyfg:12: .* in space"),
        ("VERTEX_SE2 1.7e18 A2 0 0 0", r"pyfg:12: .* in seconds, .* nanoseconds"),
        ("EDGE_RANGE 10.5 A1 L0 0 0.1", r"pyfg:12: a range must be positive"),
        ("EDGE_SE2 10 A0 A1 0 0 9 1 0 0 1 0 1", r"pyfg:12: a turn must be in rad"),
        ("EDGE_FOO 1", r"pyfg:12: expected one of VERTEX_SE2, "),
    ],
)
def test_a_line_of_a_problem_that_is_wrong_is_named(
    tmp_path: Path, line: str, message: str
) -> None:
    path = tmp_path / "a.pyfg"
    path.write_text(PYFG + line + "\n")
    with pytest.raises(DataError, match=message):
        datasets.read_pyfg(path)


def test_a_generated_problem_without_noise_is_exact(tmp_path: Path) -> None:
    path = datasets.write_pyfg(
        tmp_path / "b.pyfg",
        rng=np.random.default_rng(2),
        duration=20.0,
        defects=CLEAN,
        noise=NOISELESS,
    )
    data = datasets.read_pyfg(path)
    begins, rates = data.body_rates()
    assert begins[0] == 0.0 and rates.shape == (41, 12)
    model = planar_odometry(begins, rates)
    state = data.true_state(0.0)
    for k in range(40):
        # In two parts, as by an observation in between
        state = model.step(state, begins[k], 0.2)
        state = model.step(state, begins[k] + 0.2, 0.3)
        assert np.allclose(state, data.true_state(begins[k] + 0.5), atol=2e-4)
    for row in data.of_kind("range").itertuples():
        poses = data.true_poses(np.array([row.time]))[0]
        own = poses[data.robots.index(row.robot), :2]
        if row.subject in data.robots:
            other = poses[data.robots.index(row.subject), :2]
        else:
            other = data.landmarks.loc[row.subject].to_numpy()
        assert abs(np.linalg.norm(own - other) - row.range) < 1e-5
    mean, cov = data.prior_poses()
    error = mean - data.true_state(0.0)
    assert (np.abs(error) < 4 * np.sqrt(cov.diagonal())).all() and error.any()


# Two robots with rates of their own and a pause; poses at one time; an edge's own time is wrong.
UNEVEN = """\
VERTEX_SE2 1248000000.100000000 A7 0.0 0.0 1.5
VERTEX_SE2 1248000000.500000000 A8 0.0 1.0 1.5
VERTEX_SE2 1248000000.500000000 A9 0.0 1.0 1.5
VERTEX_SE2 1248000000.900000000 A10 0.0 2.0 1.5
VERTEX_SE2 1248000000.100000000 B0 5.0 5.0 0.0
VERTEX_SE2 1248000052.100000000 B1 5.0 5.0 0.0
VERTEX_XY L6 3.0 4.0
EDGE_SE2 0.0 A7 A8 1.0 0.0 1.5707963267948966 1 0 0 1 0 1
EDGE_SE2 0.0 A8 A9 1.0 0.0 0.0 1 0 0 1 0 1
EDGE_SE2 0.0 A9 A10 0.5 0.25 0.0 1 0 0 1 0 1
EDGE_SE2 0.0 B0 B1 0.0 0.0 6.283185307179586 1 0 0 1 0 1
EDGE_RANGE 0.0 A8 L6 4.0 0.09
EDGE_RANGE 1248000077.0 A10 B0 5.5 0.09
"""


def test_uneven_steps_and_repeated_times(tmp_path: Path) -> None:
    path = tmp_path / "uneven.pyfg"
    path.write_text(UNEVEN)
    data = datasets.read_pyfg(path)
    steps = data.of_kind("displacement")
    # A7 to A9, after the quarter turn to the left: one metre ahead and one to the left.
    first = steps[steps["robot"] == "A"].iloc[0]
    assert np.allclose(
        first[["forward", "left", "turn", "duration"]].tolist(),
        [1.0, 1.0, np.pi / 2, 0.4],
        atol=1e-6,
    )
    assert len(data.truth) == 5 and data.begin == 0.0
    # Edges have the time of their pose.
    ranges = data.of_kind("range")
    assert np.allclose(ranges["time"], [0.4, 0.8], atol=1e-6)
    assert ranges["subject"].tolist() == ["L6", "B"]
    # The rates lead from pose to pose, over any pieces; a whole turn leaves no trace.
    model = planar_odometry(*data.body_rates())
    state = np.array([0.0, 0.0, 0.0, 5.0, 5.0, 0.0])
    for t, dt in ((0.0, 0.15), (0.15, 0.25), (0.4, 0.4), (0.8, 51.2)):
        state = model.step(state, t, dt)
    # Turned to the left, 0.5 ahead is up, and 0.25 to the left is backwards.
    expected = [1.0 - 0.25, 1.0 + 0.5, np.pi / 2, 5.0, 5.0, 0.0]
    assert np.allclose(state, expected, atol=1e-5)


def test_a_clock_in_nanoseconds(tmp_path: Path) -> None:
    path = tmp_path / "nano.pyfg"
    path.write_text(
        "VERTEX_SE2 1730000000000000000 A0 0 0 0\n"
        "VERTEX_SE2 1730000001500000000 A1 1 0 0\n"
        "EDGE_SE2 0 A0 A1 1.5 0 0 1 0 0 1 0 1\n"
    )
    with pytest.raises(DataError, match="nano.pyfg:1: expected a time in seconds"):
        datasets.read_pyfg(path)
    data = datasets.read_pyfg(path, time_unit=1e-9)
    times, rates = data.body_rates()
    assert np.allclose(times, [0.0, 1.5]) and np.allclose(rates[0], [1.0, 0.0, 0.0])


def test_files_are_found_in_the_reader_s_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("DISTFILT_DATA", raising=False)
    assert datasets.locate("set") is None
    monkeypatch.setenv("DISTFILT_DATA", str(tmp_path))
    assert datasets.locate("set") is None
    (tmp_path / "set").mkdir()
    assert datasets.locate("set") == tmp_path / "set"
    monkeypatch.setenv("DISTFILT_DATA", str(tmp_path / "nowhere"))
    with pytest.raises(DataError, match="DISTFILT_DATA must be a folder"):
        datasets.locate("set")


def write_bag(path: Path) -> None:
    """Write a log of ROS 2 with odometry, a range and a pose, stored later than measured."""
    rosbag2 = pytest.importorskip("rosbags.rosbag2")
    typesys = pytest.importorskip("rosbags.typesys")
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    types = store.types

    def header(seconds: float) -> Any:
        whole = int(seconds)
        stamp = types["builtin_interfaces/msg/Time"](
            sec=whole, nanosec=round(1e9 * (seconds - whole))
        )
        return types["std_msgs/msg/Header"](stamp=stamp, frame_id="map")

    def vector(x: float, y: float, z: float) -> Any:
        return types["geometry_msgs/msg/Vector3"](x=x, y=y, z=z)

    twist = types["geometry_msgs/msg/Twist"](
        linear=vector(0.5, 0.0, 0.0), angular=vector(0.0, 0.0, 0.2)
    )
    half = 0.5 * 1.2
    pose = types["geometry_msgs/msg/Pose"](
        position=types["geometry_msgs/msg/Point"](x=1.0, y=2.0, z=0.0),
        orientation=types["geometry_msgs/msg/Quaternion"](
            x=0.0, y=0.0, z=np.sin(half), w=np.cos(half)
        ),
    )
    messages = [
        (
            "/odometry",
            types["geometry_msgs/msg/TwistStamped"](header=header(100.0), twist=twist),
        ),
        *(
            (
                "/radio",
                types["sensor_msgs/msg/Range"](
                    header=header(100.25),
                    radiation_type=0,
                    field_of_view=0.0,
                    min_range=0.0,
                    max_range=9.0,
                    range=measured,
                ),
            )
            # A radio that hears nobody, and one that hears an echo from too far
            for measured in (4.5, np.inf, 9.5)
        ),
        (
            "/pose",
            types["geometry_msgs/msg/PoseStamped"](header=header(100.5), pose=pose),
        ),
    ]
    with rosbag2.Writer(path, version=9) as writer:
        connections: dict[str, Any] = {}
        for topic, message in messages:
            kind = message.__msgtype__
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=store)
            connection = connections[topic]
            raw = store.serialize_cdr(message, kind)
            writer.write(connection, 200_000_000_000, raw)


def test_a_log_of_the_robot_operating_system(tmp_path: Path) -> None:
    write_bag(tmp_path / "log")
    topics: dict[str, Any] = {
        "/odometry": "r",
        "/radio": ("r", "anchor"),
        "/pose": "r",
    }
    data = datasets.read_bag(tmp_path / "log", topics)
    assert data.robots == ("r",) and data.origin == 100.0
    odometry = data.of_kind("odometry").iloc[0]
    assert odometry[["time", "speed", "turn_rate"]].tolist() == [0.0, 0.5, 0.2]
    assert len(data.of_kind("range")) == 1 and data.dropped == 2
    measured = data.of_kind("range").iloc[0]
    assert measured[["time", "subject", "range"]].tolist() == [0.25, "anchor", 4.5]
    truth = data.truth.iloc[0]
    assert np.allclose(truth[["time", "x", "y", "heading"]].tolist(), [0.5, 1, 2, 1.2])
    with pytest.raises(DataError, match="no topic /lidar; there are /odometry"):
        datasets.read_bag(tmp_path / "log", {"/lidar": "r"})
    for wrong, message in (
        ({"/radio": "r"}, "/radio has ranges: name the robot and whom it ranges"),
        ({"/pose": ("r", "s")}, "/pose is of one robot: give its name alone"),
        ({}, "topics must name at least one topic"),
    ):
        with pytest.raises(DataError, match=message):
            datasets.read_bag(tmp_path / "log", wrong)
    with pytest.raises(DataError, match="no such log"):
        datasets.read_bag(tmp_path / "other", topics)


def test_a_log_of_ros_1_with_two_publishers_of_a_topic(tmp_path: Path) -> None:
    """A driver that was restarted in between: both of its connections are read."""
    rosbag1 = pytest.importorskip("rosbags.rosbag1")
    typesys = pytest.importorskip("rosbags.typesys")
    store = typesys.get_typestore(typesys.Stores.ROS1_NOETIC)
    types = store.types
    kind = "geometry_msgs/msg/TwistStamped"
    path = tmp_path / "log.bag"
    with rosbag1.Writer(path) as writer:
        for k, caller in enumerate(("/driver_1", "/driver_2")):
            connection = writer.add_connection(
                "/wheels", kind, typestore=store, callerid=caller
            )
            stamp = types["builtin_interfaces/msg/Time"](sec=100 + k, nanosec=0)
            vector = types["geometry_msgs/msg/Vector3"]
            message = types[kind](
                header=types["std_msgs/msg/Header"](seq=k, stamp=stamp, frame_id=""),
                twist=types["geometry_msgs/msg/Twist"](
                    linear=vector(x=1.0 + k, y=0.0, z=0.0),
                    angular=vector(x=0.0, y=0.0, z=0.0),
                ),
            )
            raw = store.serialize_ros1(message, kind)
            writer.write(connection, 100_000_000_000, raw)
    data = datasets.read_bag(path, {"/wheels": "r"})
    odometry = data.of_kind("odometry")
    assert odometry[["time", "speed"]].to_numpy().tolist() == [[0.0, 1.0], [1.0, 2.0]]


def test_without_rosbags_the_error_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in [name for name in sys.modules if name.split(".")[0] == "rosbags"]:
        monkeypatch.delitem(sys.modules, name)
    blocked = SimpleNamespace(find_spec=lambda name, *rest: refuse(name))
    monkeypatch.setattr(sys, "meta_path", [blocked, *sys.meta_path])
    with pytest.raises(ModuleNotFoundError, match="pip install rosbags"):
        datasets.read_bag(tmp_path, {"/odometry": "r"})


def refuse(name: str) -> None:
    """Pretend that a package is not installed."""
    if name.split(".")[0] == "rosbags":
        raise ModuleNotFoundError(f"No module named {name!r}", name="rosbags")
