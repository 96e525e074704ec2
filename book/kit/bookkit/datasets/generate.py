"""Small sets in the published formats, with the errors that real logs have.

A generated set is not a real one: its errors are those of `Defects`, and nothing else. It lets
chapters and tests run without a download, on the same functions that read the real files.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

__all__ = ["Defects", "write_pyfg", "write_utias"]

Array = NDArray[np.float64]

_EPOCH = 1_300_000_000.0
"""The clock's reading at the start of a generated set, in s."""

_STEP = 0.1
"""Time between two poses of the simulation, in s."""

_RANGE_LIMIT = 5.0
_HALF_VIEW = 0.7
"""A camera sees up to so many metres, and so many rad to each side."""


@dataclass(frozen=True, kw_only=True)
class Defects:
    """The errors of a log beyond Gaussian noise; by default about as in laboratory logs.

    Parameters
    ----------
    clock_offset : float
        Standard deviation of the robots' clocks, in s.
    lag : float
        Time between an observation and its time stamp, in s.
    speed_scale : float
        Standard deviation of the relative error of a robot's speed, constant in a log.
    turn_bias : float
        Standard deviation of the constant error of a robot's turn rate, in rad/s.
    slips : int
        How often a robot's wheels turn for two seconds while it moves at half that speed.
    wrong_barcode : float
        Probability that an observation names another subject.
    unknown_barcode : float
        Probability that an observation has a barcode in no list.
    outliers : float
        Probability that the error of a range or a bearing is five times as wide.
    radio_bias : float
        Standard deviation of a radio's constant error of ranges, in m.
    gap : float
        Longest time without an observation, once for each robot, in s.
    """

    clock_offset: float = 0.03
    lag: float = 0.1
    speed_scale: float = 0.03
    turn_bias: float = 0.004
    slips: int = 2
    wrong_barcode: float = 0.01
    unknown_barcode: float = 0.005
    outliers: float = 0.05
    radio_bias: float = 0.15
    gap: float = 15.0

    @classmethod
    def none(cls) -> Defects:
        """Return a log with Gaussian noise alone."""
        return cls(
            clock_offset=0.0,
            lag=0.0,
            speed_scale=0.0,
            turn_bias=0.0,
            slips=0,
            wrong_barcode=0.0,
            unknown_barcode=0.0,
            outliers=0.0,
            radio_bias=0.0,
            gap=0.0,
        )


@dataclass(frozen=True, eq=False)
class _Drive:
    """How the robots moved: inputs (T, A, 2) of wheels and body, and poses (T + 1, A, 3)."""

    wheels: Array
    poses: Array

    def poses_at(self, t: float) -> Array:
        """Return all robots' poses between two steps, (A, 3)."""
        # The last pose belongs to the last step, so that its end can be asked for.
        k = min(int(t / _STEP), len(self.wheels) - 1)
        fraction = t / _STEP - k
        # Headings run on, so that they can be interpolated like the places.
        start = self.poses[k]
        return np.asarray(start + fraction * (self.poses[k + 1] - start))


def _simulate(
    duration: float,
    starts: Array,
    area: tuple[float, float],
    slips: int,
    rng: np.random.Generator,
) -> _Drive:
    """Drive robots to random places one after the other, at walking pace."""
    n_steps = round(duration / _STEP)
    n = len(starts)
    # True speed over that of the wheels: half while they slip, for 20 steps or 2 s.
    factor = np.ones((n_steps, n))
    for robot in range(n):
        for begin in rng.integers(n_steps, size=slips):
            factor[begin : begin + 20, robot] = 0.5
    poses = np.zeros((n_steps + 1, n, 3))
    poses[0] = starts
    wheels = np.zeros((n_steps, n, 2))
    size = np.array(area)
    # Goals keep a tenth of the area free at each side, so that turns stay inside.
    goals = rng.uniform(0.1, 0.9, (n, 2)) * size
    for k in range(n_steps):
        pose = poses[k]
        offset = goals - pose[:, :2]
        # A new goal where one is reached.
        reached = np.linalg.norm(offset, axis=1) < 0.5
        goals[reached] = rng.uniform(0.1, 0.9, (int(reached.sum()), 2)) * size
        # The turn that is missing towards the goal, in [-π, π).
        error = np.arctan2(offset[:, 1], offset[:, 0]) - pose[:, 2]
        error = (error + np.pi) % (2 * np.pi) - np.pi
        # Up to 0.3 m/s, a tenth of it away from the goal's direction; at most 0.6 rad/s.
        speed = 0.3 * np.clip(np.cos(error), 0.1, None)
        turn_rate = np.clip(1.0 * error, -0.6, 0.6)
        wheels[k, :, 0] = speed
        wheels[k, :, 1] = turn_rate
        # A slip slows the body down, and the wheels do not notice.
        poses[k + 1] = _drive(pose, factor[k] * speed, turn_rate)
    return _Drive(wheels, poses)


def _drive(pose: Array, speed: Array, turn_rate: Array) -> Array:
    """Return the poses (A, 3) after one step."""
    # The midpoint rule: the heading halfway, ψ + ω dt / 2, holds for the whole step.
    middle = pose[:, 2] + _STEP * turn_rate / 2
    shift = [speed * np.cos(middle), speed * np.sin(middle), turn_rate]
    return np.asarray(pose + _STEP * np.stack(shift, axis=-1))


def write_utias(
    folder: str | Path,
    *,
    rng: np.random.Generator,
    duration: float = 120.0,
    robots: int = 5,
    landmarks: int = 7,
    defects: Defects | None = None,
    noise: Sequence[float] = (0.02, 0.02, 0.06, 0.025),
) -> Path:
    """Write a set in the format of UTIAS, and return its folder.

    Robots drive on 12 by 8 metres, log odometry ten times a second, and look for barcodes twice a
    second.

    Parameters
    ----------
    folder : path
        It is made if it does not exist.
    rng : numpy.random.Generator
    duration : float
        In s.
    robots, landmarks : int
        How many.
    defects : Defects, optional
        `Defects()` by default.
    noise : sequence of four float
        Standard deviations of logged speed, turn rate, range and bearing, in m, s and rad.
    """
    defects = defects or Defects()
    # One generator in a fixed order of draws: a seed gives the same files.
    root = Path(folder)
    root.mkdir(parents=True, exist_ok=True)
    area = (12.0, 8.0)
    # Rows (x, y) in m; starts have a heading in rad behind.
    places = rng.uniform(0.05, 0.95, (landmarks, 2)) * area
    starts = np.column_stack(
        [rng.uniform(0.2, 0.8, (robots, 2)) * area, rng.uniform(-3, 3, robots)]
    )
    drive = _simulate(duration, starts, area, defects.slips, rng)
    _write_lists(root, robots, places, rng)
    # Constant over the log, one of each for a robot.
    scales = 1 + defects.speed_scale * rng.standard_normal(robots)
    biases = defects.turn_bias * rng.standard_normal(robots)
    offsets = defects.clock_offset * rng.standard_normal(robots)
    for robot in range(robots):
        # Odometry and sightings have the robot's clock, the truth that of the cameras.
        clock = _EPOCH + offsets[robot]
        rows = []
        for k, (speed, turn_rate) in enumerate(drive.wheels[:, robot].tolist()):
            # The logged speed is v (1 + ε) + noise, the logged turn rate ω + b + noise.
            logged = speed * scales[robot] + noise[0] * rng.standard_normal()
            turned = turn_rate + biases[robot] + noise[1] * rng.standard_normal()
            rows.append(f"{clock + _STEP * k:.3f}\t{logged:.4f}\t{turned:.4f}")
        # Robots count from 1 in the names of the files.
        _write(root / f"Robot{robot + 1}_Odometry.dat", "Time v w", rows)
        # A stamp is the time at which the barcode was found in the picture, late by the lag.
        rows = [
            f"{clock + t + defects.lag:.3f}\t{barcode}\t{r:.4f}\t{b:.4f}"
            for t, barcode, r, b in _look(robot, drive, places, defects, noise, rng)
        ]
        _write(root / f"Robot{robot + 1}_Measurement.dat", "Time barcode r b", rows)
        rows = []
        for k, (x, y, heading) in enumerate(drive.poses[:, robot].tolist()):
            # Published headings are in [-π, π).
            wrapped = (heading + np.pi) % (2 * np.pi) - np.pi
            rows.append(f"{_EPOCH + _STEP * k:.3f}\t{x:.5f}\t{y:.5f}\t{wrapped:.5f}")
        _write(root / f"Robot{robot + 1}_Groundtruth.dat", "Time x y theta", rows)
    return root


def _barcode(subject: int) -> int:
    """Return the barcode of a subject, counted from 0."""
    # Neither successive nor from 1, so that a barcode cannot pass for a subject.
    return 5 + 7 * subject


def _write_lists(
    root: Path, robots: int, places: Array, rng: np.random.Generator
) -> None:
    """Write the lists of barcodes and of landmarks."""
    # Subjects count from 1, first the robots and then the landmarks.
    rows = [f"{k + 1}\t{_barcode(k)}" for k in range(robots + len(places))]
    _write(root / "Barcodes.dat", "Subject barcode", rows)
    rows = []
    for k, (x, y) in enumerate(places.tolist(), start=robots + 1):
        # The last two columns are the survey's standard deviations, in m.
        rows.append(f"{k}\t{x:.5f}\t{y:.5f}\t0.00010\t0.00010")
    _write(root / "Landmark_Groundtruth.dat", "Subject x y x_std y_std", rows)


def _write(path: Path, head: str, rows: list[str]) -> None:
    path.write_text("\n".join([f"# {head}", *rows]) + "\n", encoding="utf-8")


def _look(
    robot: int,
    drive: _Drive,
    places: Array,
    defects: Defects,
    noise: Sequence[float],
    rng: np.random.Generator,
) -> list[tuple[float, int, float, float]]:
    """Return times, barcodes, ranges and bearings of all that a robot sees."""
    n_robots = drive.poses.shape[1]
    n_subjects = n_robots + len(places)
    # Nothing in the last second: a late stamp must not lie behind the odometry.
    end = _STEP * len(drive.wheels) - 1.0
    # The gap begins in the middle of the log, when the filter is on its way.
    blind_from = rng.uniform(0.3, 0.7) * end
    rows = []
    # Cameras look every half second, each in a phase of its own.
    for t in np.arange(0.3 + 0.4 * rng.random(), end, 0.5).tolist():
        if blind_from <= t < blind_from + defects.gap:
            continue
        poses = drive.poses_at(t)
        pose = poses[robot]
        # Robots' centres bear their barcodes, and landmarks come behind them.
        offsets = np.concatenate([poses[:, :2], places]) - pose[:2]
        distances = np.hypot(offsets[:, 0], offsets[:, 1])
        bearings = np.arctan2(offsets[:, 1], offsets[:, 0]) - pose[2]
        bearings = (bearings + np.pi) % (2 * np.pi) - np.pi
        is_seen = (distances <= _RANGE_LIMIT) & (np.abs(bearings) <= _HALF_VIEW)
        is_seen[robot] = False
        for subject in np.flatnonzero(is_seen).tolist():
            distance = float(distances[subject])
            bearing = float(bearings[subject])
            # Contaminated normal errors: some are five times as wide.
            width = np.where(rng.random(2) < defects.outliers, 5.0, 1.0)
            errors = width * np.array(noise[2:]) * rng.standard_normal(2)
            code = _read_barcode(subject, n_subjects, defects, rng)
            # No logged range is negative, or zero, where no bearing is defined.
            rows.append((t, code, max(distance + errors[0], 0.05), bearing + errors[1]))
    return rows


def _read_barcode(
    subject: int, n_subjects: int, defects: Defects, rng: np.random.Generator
) -> int:
    """Return the barcode that a camera reads, which may be wrong."""
    luck = rng.random()
    if luck < defects.unknown_barcode:
        # Not of the form 5 + 7 k.
        return 6
    if luck < defects.unknown_barcode + defects.wrong_barcode:
        # Anybody's, also the right one or the robot's own.
        return _barcode(int(rng.integers(n_subjects)))
    return _barcode(subject)


def write_pyfg(
    path: str | Path,
    *,
    rng: np.random.Generator,
    duration: float = 120.0,
    robots: int = 4,
    landmarks: int = 3,
    dt: float = 0.5,
    defects: Defects | None = None,
    noise: Sequence[float] = (0.02, 0.005, 0.01, 0.1),
) -> Path:
    """Write a range-aided problem: robots with radios measure distances to each other.

    A radio hears landmarks and other robots within 12 metres, one of them in two steps, on 20 by
    16 metres.

    Parameters
    ----------
    path : path
        The file.
    rng : numpy.random.Generator
    duration, dt : float
        Length of the log and of a step, in s.
    robots, landmarks : int
        How many; up to eleven robots, with the letters before L.
    defects : Defects, optional
        `Defects()` by default; of them `speed_scale`, `turn_bias`, `slips`, `outliers`,
        `radio_bias` and `gap` are used. Outliers are ranges that are too long, by an echo.
    noise : sequence of four float
        Standard deviations of a step's forward and left displacement, turn, and of a range.
    """
    defects = defects or Defects()
    area = (20.0, 16.0)
    places = rng.uniform(0.0, 1.0, (landmarks, 2)) * area
    starts = np.column_stack(
        [rng.uniform(0.2, 0.8, (robots, 2)) * area, rng.uniform(-3, 3, robots)]
    )
    drive = _simulate(duration, starts, area, defects.slips, rng)
    # The format has one vertex for each pose that an edge refers to.
    poses = drive.poses[:: round(dt / _STEP)]
    names = "ABCDEFGHIJK"[:robots]
    lines = [
        f"VERTEX_SE2 {dt * k:.9f} {name}{k} {x:.6f} {y:.6f} {heading:.7f}"
        for robot, name in enumerate(names)
        for k, (x, y, heading) in enumerate(poses[:, robot].tolist())
    ]
    for k, (x, y) in enumerate(places.tolist()):
        lines.append(f"VERTEX_XY L{k} {x:.6f} {y:.6f}")
    # The priors: starts and landmarks, surveyed.
    for robot, name in enumerate(names):
        x, y, heading = starts[robot] + [0.1, 0.1, 0.03] * rng.standard_normal(3)
        # Variances 0.1² m², 0.1² m² and 0.03² rad², as the errors above.
        lines.append(
            f"VERTEX_SE2:PRIOR 0.0 {name}0 {x:.6f} {y:.6f} {heading:.7f} "
            "0.01 0.0 0.0 0.01 0.0 0.0009"
        )
    for k, place in enumerate(places):
        x, y = place + 0.05 * rng.standard_normal(2)
        # The variance is 0.05² m² east and north.
        lines.append(f"VERTEX_XY:PRIOR 0.0 L{k} {x:.6f} {y:.6f} 0.0025 0.0 0.0025")
    lines += _list_displacements(drive, names, dt, defects, noise, rng)
    lines += _list_ranges(poses, places, names, dt, defects, noise[3], rng)
    target = Path(path)
    target.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return target


def _list_displacements(
    drive: _Drive,
    names: str,
    dt: float,
    defects: Defects,
    noise: Sequence[float],
    rng: np.random.Generator,
) -> list[str]:
    """Return the lines of odometry, the wheels' measurement of each step."""
    n = len(names)
    scales = 1 + defects.speed_scale * rng.standard_normal(n)
    biases = defects.turn_bias * rng.standard_normal(n)
    length = round(dt / _STEP)
    # The upper triangle of a diagonal covariance, row by row.
    variances = " ".join(
        f"{v:.9f}" for v in (noise[0] ** 2, 0, 0, noise[1] ** 2, 0, noise[2] ** 2)
    )
    lines = []
    for robot, name in enumerate(names):
        for k in range(len(drive.wheels) // length):
            # The displacement in the frame of the pose before it: dead reckoning from zero.
            pose = np.zeros((1, 3))
            for speed, turn_rate in drive.wheels[length * k : length * (k + 1), robot]:
                pose = _drive(
                    pose,
                    np.array([scales[robot] * speed]),
                    np.array([turn_rate + biases[robot]]),
                )
            x, y, turn = pose[0] + np.array(noise[:3]) * rng.standard_normal(3)
            lines.append(
                f"EDGE_SE2 {dt * k:.9f} {name}{k} {name}{k + 1} "
                f"{x:.6f} {y:.6f} {turn:.7f} {variances}"
            )
    return lines


def _list_ranges(
    poses: Array,
    places: Array,
    names: str,
    dt: float,
    defects: Defects,
    std: float,
    rng: np.random.Generator,
) -> list[str]:
    """Return the lines of ranges, each measured by the robot that is named first."""
    n = len(names)
    biases = defects.radio_bias * rng.standard_normal(n)
    end = dt * (len(poses) - 1)
    blind_from = rng.uniform(0.3, 0.7, n) * end
    lines = []
    for k in range(1, len(poses)):
        for robot, name in enumerate(names):
            in_gap = blind_from[robot] <= dt * k < blind_from[robot] + defects.gap
            # Every other robot's pose of this step, then the landmarks.
            subjects = [(f"{other}{k}", j) for j, other in enumerate(names)]
            del subjects[robot]
            subjects += [(f"L{j}", n + j) for j in range(len(places))]
            for subject, j in subjects:
                place = poses[k, j, :2] if j < n else places[j - n]
                distance = float(np.linalg.norm(place - poses[k, robot, :2]))
                # A radio hears 12 m far, and gets an answer in half of the steps.
                if in_gap or distance > 12.0 or rng.random() < 0.5:
                    continue
                error = biases[robot] + std * rng.standard_normal()
                if rng.random() < defects.outliers:
                    # An echo takes a longer way, so that it never shortens a range.
                    error += rng.exponential(5 * std)
                lines.append(
                    f"EDGE_RANGE {dt * k:.9f} {name}{k} {subject} "
                    f"{max(distance + error, 0.05):.6f} {std**2:.6f}"
                )
    return lines
