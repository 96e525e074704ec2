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

with the upper triangle of each covariance row by row. Landmarks' names begin with L. An edge ties
poses, so its time is that of its poses: the ``t`` of an edge is zero in some published files, and
off by seconds in others. A displacement is in the frame of the pose before it.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd

from .table import (
    LATEST,
    POSE,
    Array,
    DataError,
    Dataset,
    Event,
    LineReader,
    make_events,
)

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


def read_pyfg(path: str | Path, *, time_unit: float = 1.0) -> Dataset:
    """Read a planar problem with ranges from a ``.pyfg`` file.

    Parameters
    ----------
    path : path
    time_unit : float
        The file's unit of time, in s: 1e-9 for nanoseconds.

    Returns
    -------
    Dataset
        Events ``prior``, ``survey``, ``displacement`` (whose time is the end of the movement),
        ``offset`` and ``range``, each with its covariance. Subjects are landmarks or robots.
        Times count from the first pose. Poses of one robot at one time are joined, and so are
        the displacements between them.

    Raises
    ------
    DataError
        With file and line: an unknown kind of line, one of a problem in space, a short line, a
        pose that no ``VERTEX_SE2`` declares, odometry between poses that are not successive,
        times of one robot's poses that decrease, or that are no seconds, a turn by more than a
        whole one, a range that is not positive.
    """
    reader = LineReader(Path(path))
    lines = [_read_line(reader, number, words) for number, words in reader.lines]
    poses = _read_poses(reader, lines, time_unit)
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
            # A prior of a landmark has no pose, and counts from the beginning.
            owner = poses.get(names[0])
            values[0] = origin if owner is None else owner[0]
            event = _make_event(reader, number, word, names, values, poses)
            events.append((event[0] - origin, *event[1:]))
    events = _join_displacements(events)
    # A1 is pose 1 of robot A: the letter names the robot.
    truth = [(v[0] - origin, name[0], *v[1:]) for name, v in poses.items()]
    truth_frame = pd.DataFrame(truth, columns=["time", "robot", *POSE])
    index = pd.Index(list(landmarks), name="subject")
    places = np.array(list(landmarks.values())).reshape(-1, 2)
    return Dataset(
        make_events(events),
        truth_frame.drop_duplicates(["time", "robot"], ignore_index=True),
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
    values = words[1:]
    # The time stands before the names; landmarks have none.
    first = 1 if fields.startswith("time") else 0
    names = values[first : first + n_names]
    texts = values[:first] + values[first + n_names :]
    numbers = reader.numbers(number, texts, fields)
    by_name = dict(zip(fields.split(), numbers, strict=True))
    if by_name.get("range", 1.0) <= 0:
        raise reader.error(
            number, f"a range must be positive, got {by_name['range']:g}"
        )
    # The logarithm of a pose has no more than half a turn; some writers let it run on.
    if abs(by_name.get("turn", 0.0)) > 2 * np.pi:
        raise reader.error(
            number, f"a turn must be in rad, up to a whole one, got {by_name['turn']:g}"
        )
    return number, word, names, numbers


def _read_poses(
    reader: LineReader, lines: list[Line], time_unit: float
) -> dict[str, list[float]]:
    """Return time, in s, and true pose by name; the times of a robot must not decrease."""
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
        time = time_unit * values[0]
        if abs(time) > LATEST:
            raise reader.error(
                number,
                f"expected a time in seconds, got {values[0]:.3g}: time_unit=1e-9 reads "
                "nanoseconds",
            )
        # Poses at one time are allowed: the truth may have a lower rate than the odometry.
        if time < latest.get(name[0], -np.inf):
            raise reader.error(number, f"times of robot {name[0]} must not decrease")
        latest[name[0]] = time
        poses[name] = [time, *values[1:]]
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
        end = poses[names[1]][0]
        return end, robot, kind, "", (*measured, end - time), cov
    # A landmark keeps its whole name, another robot's pose gives its letter.
    subject = names[1] if names[1].startswith("L") else names[1][0]
    return time, robot, kind, subject, measured, cov


def _join_displacements(events: list[Event]) -> list[Event]:
    """Join each displacement without a duration with the one after it, or before it at the end."""
    joined: list[Event] = []
    # By robot: the place in `joined` of its last displacement.
    last: dict[str, int] = {}
    for event in sorted(events, key=lambda event: event[0]):
        time, robot, kind, subject, values, cov = event
        before = last.get(robot)
        if kind != "displacement":
            joined.append(event)
        elif before is None or 0 not in (joined[before][4][3], values[3]):
            last[robot] = len(joined)
            joined.append(event)
        else:
            former = joined[before]
            displacement = (*_compose(former[4], values), former[4][3] + values[3])
            total = None if cov is None or former[5] is None else former[5] + cov
            joined[before] = (time, robot, kind, subject, displacement, total)
    return joined


def _compose(first: tuple[float, ...], second: tuple[float, ...]) -> tuple[float, ...]:
    """Return one displacement after another: p1 + R(turn 1) p2, and the sum of the turns."""
    c = np.cos(first[2])
    s = np.sin(first[2])
    forward = first[0] + c * second[0] - s * second[1]
    left = first[1] + s * second[0] + c * second[1]
    return float(forward), float(left), first[2] + second[2]


def _unpack_triangle(numbers: list[float], n: int) -> Array:
    """Return the symmetric matrix with these numbers in its upper triangle."""
    matrix = np.zeros((n, n))
    # c11, c12, ..., c22, ...: numpy lists the triangle in the same order.
    rows, columns = np.triu_indices(n)
    matrix[rows, columns] = numbers
    matrix[columns, rows] = numbers
    return matrix
