"""Logs in the published formats: reading inverts writing, and errors name the line."""

from __future__ import annotations

import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from bookkit import datasets
from bookkit.datasets import DataError, Defects

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
    assert np.allclose(poses[0, 0], [0.25, 0.0, (3.1 + 2 * np.pi - 3.1) / 2])
    assert np.isnan(poses[2]).all()
    assert np.allclose(data.true_state(1.0), poses[1, 0])


def test_odometry_is_averaged_over_time(tmp_path: Path) -> None:
    """Between 0.5 and 1.25 s: two thirds of 0.5 m/s, one third of 1 m/s."""
    data = datasets.read_utias(write_utias(tmp_path))
    averages = data.average_odometry(np.array([0.5, 1.25, 3.0]))
    assert np.allclose(averages[0, 0], [(2 * 0.5 + 1.0) / 3, 0.2 / 3])
    # The last input holds on; before the first one the robot stands.
    assert np.allclose(averages[1, 0], [0.75 / 1.75, 0.2 * 0.75 / 1.75])
    earlier = data.average_odometry(np.array([-1.0, 0.0]))
    assert np.array_equal(earlier, np.zeros((1, 1, 2)))


def test_the_truth_has_gaps(tmp_path: Path) -> None:
    text = "100.0 0 0 0\n101.0 1 0 0\n105.0 5 0 0\n106.0 6 0 0\n"
    data = datasets.read_utias(write_utias(tmp_path, Robot1_Groundtruth=text))
    poses = data.true_poses(np.array([0.5, 3.0, 5.5]))
    assert np.isnan(poses[:, 0, 0]).tolist() == [False, True, False]
    filled = data.true_poses(np.array([3.0]), longest_gap=4.0)
    assert filled[0, 0, 0] == 3.0


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
    for k, inputs in enumerate(data.average_odometry(times)):
        middle = pose[:, 2] + 0.05 * inputs[:, 1]
        shift = [np.cos(middle), np.sin(middle)] * inputs[:, 0]
        pose = pose + 0.1 * np.stack([*shift, inputs[:, 1]], axis=-1)
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
    difference = biased.average_odometry(np.array([0.0, 50.0]))
    true_turn = np.diff(biased.true_poses(np.array([0.1, 50.0])), axis=0)[0, :, 2] / 50
    assert np.abs(difference[0, :, 1] - true_turn).max() > 0.1


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
    with pytest.raises(DataError, match="every robot must have one"):
        data.displacement_rates()


@pytest.mark.parametrize(
    "line, message",
    [
        ("EDGE_RANGE 10.5 A1 L0 4.5", r"pyfg:12: expected 3 numbers .* got 2"),
        ("EDGE_RANGE 10.5 A1 L9 4.5 0.1", r"pyfg:12: no VERTEX line declares 'L9'"),
        ("EDGE_SE2 10 A0 B1 0 0 0 1 0 0 1 0 1", r"pyfg:12: .* to the next pose"),
        ("VERTEX_SE2 10.2 A2 0 0 0", r"pyfg:12: times of robot A must increase"),
        ("VERTEX_SE2 11 L2 0 0 0", r"pyfg:12: expected a robot's letter"),
        ("VERTEX_SE3:QUAT 11 A2 0 0 0 0 0 0 1", r"pyfg:12: .* in space"),
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
    begins, rates = data.displacement_rates()
    assert begins[0] == 0.0 and rates.shape == (40, 12)
    pose = data.true_poses(np.array([0.0]))[0]
    for k, rate in enumerate(rates):
        forward, left, turn = 0.5 * rate.reshape(-1, 3).T
        c, s = np.cos(pose[:, 2]), np.sin(pose[:, 2])
        shift = [c * forward - s * left, s * forward + c * left, turn]
        pose = pose + np.stack(shift, axis=-1)
        expected = data.true_poses(np.array([begins[k] + 0.5]))[0]
        assert np.allclose(pose, expected, atol=1e-4)
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
        (
            "/radio",
            types["sensor_msgs/msg/Range"](
                header=header(100.25),
                radiation_type=0,
                field_of_view=0.0,
                min_range=0.0,
                max_range=9.0,
                range=4.5,
            ),
        ),
        (
            "/pose",
            types["geometry_msgs/msg/PoseStamped"](header=header(100.5), pose=pose),
        ),
    ]
    with rosbag2.Writer(path, version=9) as writer:
        for topic, message in messages:
            kind = message.__msgtype__
            connection = writer.add_connection(topic, kind, typestore=store)
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
    measured = data.of_kind("range").iloc[0]
    assert measured[["time", "subject", "range"]].tolist() == [0.25, "anchor", 4.5]
    truth = data.truth.iloc[0]
    assert np.allclose(truth[["time", "x", "y", "heading"]].tolist(), [0.5, 1, 2, 1.2])
    with pytest.raises(DataError, match="no topic /lidar; there are /odometry"):
        datasets.read_bag(tmp_path / "log", {"/lidar": "r"})
    with pytest.raises(DataError, match="no such log"):
        datasets.read_bag(tmp_path / "other", topics)


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
