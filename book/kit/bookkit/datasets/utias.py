"""The multi-robot cooperative localization and mapping sets of UTIAS, as the files come.

K. Y. K. Leung, Y. Halpern, T. D. Barfoot and H. H. T. Liu, International Journal of Robotics
Research 30 (2011) 969-974. A set is a folder with ``Barcodes.dat``, ``Landmark_Groundtruth.dat``
and, for each robot N, ``RobotN_Groundtruth.dat``, ``RobotN_Odometry.dat`` and
``RobotN_Measurement.dat``: columns of text, with comments behind ``#``. The head of a file of
measurements calls its second column a subject; it holds barcodes.
"""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import numpy as np
import pandas as pd

from .table import (
    POSE,
    Array,
    DataError,
    Dataset,
    LineReader,
    check_clocks,
    stack_events,
)

__all__ = ["read_utias"]

_FASTEST_TURN = 4 * np.pi
"""In rad/s; a log in which robots often turn faster is in degrees."""


def read_utias(
    folder: str | Path, *, unknown: Literal["raise", "drop"] = "raise"
) -> Dataset:
    """Read a set of UTIAS: odometry, ranges with bearings, and the truth of a camera system.

    Parameters
    ----------
    folder : path
        The folder with the files.
    unknown : {"raise", "drop"}
        Whether an observation whose barcode is in no list is an error, or is left out and
        counted in ``dropped``. A camera misreads barcodes now and then.

    Returns
    -------
    Dataset
        Times count from the first event; subjects are the numbers in ``Barcodes.dat``. The files
        of ground truth may be missing: then the truth is empty and the landmarks' places are NaN,
        and so is the place of a landmark that only ``Barcodes.dat`` lists.

    Raises
    ------
    DataError
        With file and, where it is one, line: a missing file or robot, a short line, a word that is
        no number, a time before the one above it, an unknown barcode, a range that is not
        positive, angles in degrees, files whose clocks differ, no line where some are needed.
    """
    root = Path(folder)
    barcodes = _read_barcodes(root / "Barcodes.dat")
    robots = _find_robots(root)
    landmarks = _read_landmarks(
        root / "Landmark_Groundtruth.dat",
        [subject for subject in barcodes.values() if subject not in robots],
    )
    # Lines "time v w" in s, m/s and rad/s.
    odometry = {}
    times = {}
    for robot in robots:
        reader = LineReader(root / f"Robot{robot}_Odometry.dat")
        odometry[robot] = reader.table("time speed turn_rate")
        times[f"{reader.path}"] = odometry[robot][:, 0]
        if not odometry[robot].size:
            raise DataError(f"{reader.path}: no line of odometry")
        _check_turn_rates(reader.path, odometry[robot][:, 2])
    events = []
    truths = []
    dropped = 0
    for robot in robots:
        events.append(stack_events(odometry[robot], robot, "odometry"))
        path = root / f"Robot{robot}_Measurement.dat"
        observed, n_unknown = _read_measurements(path, robot, barcodes, unknown)
        times[f"{path}"] = observed["time"].to_numpy(dtype=float)
        events.append(observed)
        dropped += n_unknown
        path = root / f"Robot{robot}_Groundtruth.dat"
        table = _read_truth(path)
        times[f"{path}"] = table[:, 0]
        frame = pd.DataFrame(table, columns=["time", *POSE])
        frame.insert(1, "robot", robot)
        truths.append(frame)
    check_clocks(times)
    table_of_events = pd.concat(events)
    # A stable sort, so that events of one time keep their order.
    table_of_events = table_of_events.sort_values(
        "time", kind="stable", ignore_index=True
    )
    # All clocks are set to one server's, which counts seconds since 1970.
    origin = float(table_of_events["time"].iloc[0])
    table_of_events["time"] -= origin
    truth = pd.concat(truths, ignore_index=True)
    truth["time"] -= origin
    return Dataset(
        table_of_events,
        truth,
        landmarks,
        tuple(robots),
        origin=origin,
        dropped=dropped,
    )


def _read_barcodes(path: Path) -> dict[int, str]:
    """Return the subject of each barcode."""
    reader = LineReader(path)
    # Lines "subject barcode", both whole numbers.
    subjects: dict[int, str] = {}
    table = reader.table("subject barcode")
    if not table.size:
        raise DataError(f"{path}: no line of barcodes")
    for (number, _), (subject, barcode) in zip(
        reader.lines, table.tolist(), strict=True
    ):
        if int(barcode) in subjects:
            raise reader.error(number, f"barcode {int(barcode)} comes twice")
        subjects[int(barcode)] = str(int(subject))
    return subjects


def _read_landmarks(path: Path, subjects: list[str]) -> pd.DataFrame:
    """Return the places of the landmarks, by subject; NaN of those that no file has."""
    table = np.zeros((0, 5))
    if path.is_file():
        # The standard deviations of the survey, below a millimetre, are left out.
        table = LineReader(path).table("subject x y x_std y_std")
    index = pd.Index([str(int(subject)) for subject in table[:, 0]], name="subject")
    places = pd.DataFrame(table[:, 1:3], index=index, columns=["x", "y"])
    unsurveyed = [subject for subject in subjects if subject not in places.index]
    # In the order of the file, and behind them the landmarks that it leaves out.
    return places.reindex([*places.index, *unsurveyed]).rename_axis("subject")


def _read_truth(path: Path) -> Array:
    """Return a robot's true poses, (N, 4); none without a file."""
    if not path.is_file():
        return np.zeros((0, 4))
    # Lines "time x y theta" in s, m and rad, up to a hundred a second in the real files.
    table = LineReader(path).table("time x y heading")
    _check_turn_rates(path, _turn_rates(table))
    return table


def _turn_rates(poses: Array) -> Array:
    """Return the turn rates between rows (time, x, y, heading), by the shorter way round."""
    seconds = np.diff(poses[:, 0])
    turns = (np.diff(poses[:, 3]) + np.pi) % (2 * np.pi) - np.pi
    return turns[seconds > 0] / seconds[seconds > 0]


def _check_turn_rates(path: Path, rates: Array) -> None:
    """Refuse angles in degrees: few robots turn twice a second, and none all the time."""
    if rates.size and np.mean(np.abs(rates) > _FASTEST_TURN) > 0.1:
        raise DataError(
            f"{path}: angles must be in rad, got turn rates up to {np.abs(rates).max():.3g} rad/s: "
            "are they in degrees?"
        )


def _find_robots(root: Path) -> list[str]:
    """Return the robots' numbers; each must have odometry and measurements."""
    kinds_by_robot: dict[str, set[str]] = {}
    for path in sorted(root.glob("Robot*_*.dat")):
        # Robot3_Odometry: robot 3, kind Odometry.
        robot, _, kind = path.stem.removeprefix("Robot").partition("_")
        kinds_by_robot.setdefault(robot, set()).add(kind)
    if not kinds_by_robot:
        raise DataError(
            f"{root}: no file Robot1_Odometry.dat, so that no robot is found"
        )
    for robot, kinds in kinds_by_robot.items():
        for kind in ("Odometry", "Measurement"):
            if kind not in kinds:
                raise DataError(f"{root / f'Robot{robot}_{kind}.dat'}: no such file")
    # Robot 10 comes after robot 9: shorter names first.
    return sorted(kinds_by_robot, key=lambda robot: (len(robot), robot))


def _read_measurements(
    path: Path, robot: str, barcodes: dict[int, str], unknown: str
) -> tuple[pd.DataFrame, int]:
    """Return a robot's observations, and how many were left out."""
    reader = LineReader(path)
    # Lines "time barcode r b" in s, m and rad, the bearing counterclockwise from straight ahead.
    table = reader.table("time barcode range bearing")
    reader.refuse_rows(table[:, 2] <= 0, "a range must be positive")
    reader.refuse_rows(
        np.abs(table[:, 3]) > 2 * np.pi, "a bearing must be in rad, up to a whole turn"
    )
    barcode_numbers = table[:, 1].astype(int).tolist()
    is_known = np.array([barcode in barcodes for barcode in barcode_numbers], bool)
    if unknown == "raise" and not is_known.all():
        first = int(np.argmin(is_known))
        number, _ = reader.lines[first]
        raise reader.error(
            number,
            f"barcode {barcode_numbers[first]} is not in Barcodes.dat (unknown='drop' leaves "
            "such observations out)",
        )
    subjects = [barcodes[b] for b in barcode_numbers if b in barcodes]
    # Without the column of barcodes
    rows = table[is_known][:, [0, 2, 3]]
    events = stack_events(rows, robot, "range_bearing", subjects)
    return events, int((~is_known).sum())
