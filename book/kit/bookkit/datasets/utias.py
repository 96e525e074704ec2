"""The multi-robot cooperative localization and mapping sets of UTIAS, as the files come.

K. Y. K. Leung, Y. Halpern, T. D. Barfoot and H. H. T. Liu, International Journal of Robotics
Research 30 (2011) 969-974. A set is a folder with ``Barcodes.dat``, ``Landmark_Groundtruth.dat``
and, for each robot N, ``RobotN_Groundtruth.dat``, ``RobotN_Odometry.dat`` and
``RobotN_Measurement.dat``: columns of text, with comments behind ``#``.
"""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import pandas as pd

from .table import POSE, DataError, Dataset, Event, LineReader, make_events

__all__ = ["read_utias"]


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
        Times count from the first event; subjects are the numbers in ``Barcodes.dat``.

    Raises
    ------
    DataError
        With file and line: a missing file or robot, a short line, a word that is no number, a
        time before the one above it, an unknown barcode.
    """
    root = Path(folder)
    barcodes = _read_barcodes(root / "Barcodes.dat")
    landmarks = _read_landmarks(root / "Landmark_Groundtruth.dat")
    robots = _find_robots(root)
    # Lines "time v w" in s, m/s and rad/s.
    odometry = {}
    for robot in robots:
        reader = LineReader(root / f"Robot{robot}_Odometry.dat")
        odometry[robot] = reader.table("time speed turn_rate")
        if not odometry[robot].size:
            raise DataError(f"{reader.path}: no line of odometry")
    events: list[Event] = []
    truths = []
    dropped = 0
    for robot in robots:
        for time, speed, turn_rate in odometry[robot].tolist():
            values = (speed, turn_rate)
            events.append((time, robot, "odometry", "", values, None))
        path = root / f"Robot{robot}_Measurement.dat"
        observed, n_unknown = _read_measurements(path, robot, barcodes, unknown)
        events += observed
        dropped += n_unknown
        reader = LineReader(root / f"Robot{robot}_Groundtruth.dat")
        # Lines "time x y theta" in s, m and rad, at a hundred a second in the real files.
        table = reader.table("time x y heading")
        frame = pd.DataFrame(table, columns=["time", *POSE])
        frame.insert(1, "robot", robot)
        truths.append(frame)
    table_of_events = make_events(events)
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
    for (number, _), (subject, barcode) in zip(
        reader.lines, table.tolist(), strict=True
    ):
        if int(barcode) in subjects:
            raise reader.error(number, f"barcode {int(barcode)} comes twice")
        subjects[int(barcode)] = str(int(subject))
    return subjects


def _read_landmarks(path: Path) -> pd.DataFrame:
    """Return the places of the landmarks, by subject."""
    # The standard deviations of the survey, below a millimetre, are left out.
    table = LineReader(path).table("subject x y x_std y_std")
    index = pd.Index([str(int(subject)) for subject in table[:, 0]], name="subject")
    return pd.DataFrame(table[:, 1:3], index=index, columns=["x", "y"])


def _find_robots(root: Path) -> list[str]:
    """Return the robots' numbers; each must have all three files."""
    found: dict[str, set[str]] = {}
    for path in sorted(root.glob("Robot*_*.dat")):
        # Robot3_Odometry: robot 3, kind Odometry.
        robot, _, kind = path.stem.removeprefix("Robot").partition("_")
        found.setdefault(robot, set()).add(kind)
    if not found:
        raise DataError(
            f"{root}: no file Robot1_Odometry.dat, so that no robot is found"
        )
    for robot, kinds in found.items():
        for kind in ("Odometry", "Measurement", "Groundtruth"):
            if kind not in kinds:
                raise DataError(f"{root / f'Robot{robot}_{kind}.dat'}: no such file")
    # Robot 10 comes after robot 9: shorter names first.
    return sorted(found, key=lambda robot: (len(robot), robot))


def _read_measurements(
    path: Path, robot: str, barcodes: dict[int, str], unknown: str
) -> tuple[list[Event], int]:
    """Return a robot's observations, and how many were left out."""
    reader = LineReader(path)
    # Lines "time barcode r b" in s, m and rad, the bearing counterclockwise from straight ahead.
    table = reader.table("time barcode range bearing")
    events: list[Event] = []
    dropped = 0
    for (number, _), (time, barcode, distance, bearing) in zip(
        reader.lines, table.tolist(), strict=True
    ):
        subject = barcodes.get(int(barcode))
        if subject is None:
            if unknown == "raise":
                raise reader.error(
                    number,
                    f"barcode {int(barcode)} is not in Barcodes.dat (unknown='drop' leaves "
                    "such observations out)",
                )
            dropped += 1
            continue
        values = (distance, bearing)
        events.append((time, robot, "range_bearing", subject, values, None))
    return events, dropped
