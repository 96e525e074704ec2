"""Range-aided mapping problems in the text form ``.pyfg`` of PyFactorGraph.

Each line begins with the word of its kind. In the plane these are

| Line | Meaning |
|---|---|
| ``VERTEX_SE2 t A0 x y heading`` | true pose 0 of robot A |
| ``VERTEX_XY L0 x y`` | true place of landmark L0 |
| ``VERTEX_SE2:PRIOR t A0 x y heading cov`` | a pose that is known beforehand |
| ``VERTEX_XY:PRIOR t L0 x y cov`` | a landmark that has been surveyed |
| ``EDGE_SE2 t A0 A1 forward left turn cov`` | odometry between successive poses |
| ``EDGE_SE2_XY t A0 L0 forward left cov`` | a landmark in the robot's frame |
| ``EDGE_RANGE t A0 L0 range variance`` | a distance to a landmark or to another robot's pose |

with the upper triangle of each covariance row by row. Landmarks' names begin with L.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd

from .table import POSE, Array, DataError, Dataset, Event, LineReader, make_events

__all__ = ["read_pyfg"]

_FIELDS = {
    "VERTEX_SE2": (1, "time x y heading"),
    "VERTEX_XY": (1, "x y"),
    "VERTEX_SE2:PRIOR": (1, "time x y heading c11 c12 c13 c22 c23 c33"),
    "VERTEX_XY:PRIOR": (1, "time x y c11 c12 c22"),
    "EDGE_SE2": (2, "time forward left turn c11 c12 c13 c22 c23 c33"),
    "EDGE_SE2_XY": (2, "time forward left c11 c12 c22"),
    "EDGE_RANGE": (2, "time range variance"),
}
"""Of each kind of line: how many names it has, and its numbers."""

_KINDS = {
    "VERTEX_SE2:PRIOR": "prior",
    "VERTEX_XY:PRIOR": "survey",
    "EDGE_SE2": "displacement",
    "EDGE_SE2_XY": "offset",
    "EDGE_RANGE": "range",
}


def read_pyfg(path: str | Path) -> Dataset:
    """Read a planar problem with ranges from a ``.pyfg`` file.

    Parameters
    ----------
    path : path

    Returns
    -------
    Dataset
        Events ``prior``, ``survey``, ``displacement`` (whose time is the end of the movement),
        ``offset`` and ``range``, each with its covariance. Subjects are landmarks or robots.
        Times count from the first pose.

    Raises
    ------
    DataError
        With file and line: an unknown kind of line, one of a problem in space, a short line, a
        pose that no ``VERTEX_SE2`` declares, odometry between poses that are not successive,
        times of one robot's poses that do not increase.
    """
    reader = LineReader(Path(path))
    lines = [_read_line(reader, number, words) for number, words in reader.lines]
    poses = _read_poses(reader, lines)
    if not poses:
        raise DataError(f"{reader.path}: no VERTEX_SE2, so that no robot is found")
    # Landmarks may be declared behind the edges that refer to them, so all lines are read first.
    landmarks = {
        names[0]: values for _, word, names, values in lines if word == "VERTEX_XY"
    }
    # The first number of a pose is its time.
    origin = min(values[0] for values in poses.values())
    events: list[Event] = []
    for number, word, names, values in lines:
        if word in _KINDS:
            _check_names(reader, number, names, {**poses, **landmarks})
            event = _make_event(reader, number, word, names, values, poses)
            events.append((event[0] - origin, *event[1:]))
    # A1 is pose 1 of robot A: the letter names the robot.
    truth = [(v[0] - origin, name[0], *v[1:]) for name, v in poses.items()]
    index = pd.Index(list(landmarks), name="subject")
    places = np.array(list(landmarks.values())).reshape(-1, 2)
    return Dataset(
        make_events(events),
        pd.DataFrame(truth, columns=["time", "robot", *POSE]),
        pd.DataFrame(places, index=index, columns=["x", "y"]),
        tuple(sorted({name[0] for name in poses})),
        origin=origin,
    )


Line = tuple[int, str, list[str], list[float]]
"""A line's number, its first word, its names and its numbers, the time first if it has one."""


def _read_line(reader: LineReader, number: int, words: list[str]) -> Line:
    """Split a line into its parts."""
    word = words[0]
    if word not in _FIELDS:
        # SE3 and XYZ are the plane's words SE2 and XY in space.
        hint = (
            ", which is of a problem in space" if "3" in word or "XYZ" in word else ""
        )
        raise reader.error(
            number, f"expected one of {', '.join(_FIELDS)}, got {word!r}{hint}"
        )
    n_names, fields = _FIELDS[word]
    rest = words[1:]
    # The time stands before the names; landmarks have none.
    first = 1 if fields.startswith("time") else 0
    names = rest[first : first + n_names]
    numbers = rest[:first] + rest[first + n_names :]
    return number, word, names, reader.numbers(number, numbers, fields)


def _read_poses(reader: LineReader, lines: list[Line]) -> dict[str, list[float]]:
    """Return time and true pose by name; the times of each robot must increase."""
    poses: dict[str, list[float]] = {}
    latest: dict[str, float] = {}
    for number, word, names, values in lines:
        if word != "VERTEX_SE2":
            continue
        name = names[0]
        if name.startswith("L") or not name[1:].isdigit():
            raise reader.error(
                number, f"expected a robot's letter and a number, got {name!r}"
            )
        # Two poses at one time would leave no time for the odometry between them.
        if values[0] <= latest.get(name[0], -np.inf):
            raise reader.error(number, f"times of robot {name[0]} must increase")
        latest[name[0]] = values[0]
        poses[name] = values
    return poses


def _check_names(
    reader: LineReader, number: int, names: list[str], known: dict[str, list[float]]
) -> None:
    """Refuse a line about something that was not declared."""
    for name in names:
        if name not in known:
            raise reader.error(number, f"no VERTEX line declares {name!r}")


def _make_event(
    reader: LineReader,
    number: int,
    word: str,
    names: list[str],
    values: list[float],
    poses: dict[str, list[float]],
) -> Event:
    """Return a line's event, at its time in the file."""
    kind = _KINDS[word]
    n_values = {"EDGE_RANGE": 1, "VERTEX_XY:PRIOR": 2, "EDGE_SE2_XY": 2}.get(word, 3)
    # Behind the time the n values, then n (n + 1) / 2 numbers of their covariance.
    measured = tuple(values[1 : 1 + n_values])
    cov = _unpack_triangle(values[1 + n_values :], n_values)
    time = values[0]
    if word == "VERTEX_XY:PRIOR":
        # Surveyors know the landmark, no robot does.
        return time, "", kind, names[0], measured, cov
    robot = names[0][0]
    if word == "VERTEX_SE2:PRIOR":
        return time, robot, kind, "", measured, cov
    if word == "EDGE_SE2":
        # A filter needs one edge for each step; a loop closure would skip some.
        is_next = names[1] == f"{robot}{int(names[0][1:]) + 1}"
        if not is_next:
            raise reader.error(
                number, f"expected odometry to the next pose, got {' '.join(names)}"
            )
        # It is known when the movement has ended.
        return poses[names[1]][0], robot, kind, "", measured, cov
    # A landmark keeps its whole name, another robot's pose gives its letter.
    subject = names[1] if names[1].startswith("L") else names[1][0]
    return time, robot, kind, subject, measured, cov


def _unpack_triangle(numbers: list[float], n: int) -> Array:
    """Return the symmetric matrix with these numbers in its upper triangle."""
    matrix = np.zeros((n, n))
    # c11, c12, ..., c22, ...: numpy lists the triangle in the same order.
    rows, columns = np.triu_indices(n)
    matrix[rows, columns] = numbers
    matrix[columns, rows] = numbers
    return matrix
