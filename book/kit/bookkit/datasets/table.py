"""The common form of all logs: a table of events, the truth apart, and landmarks."""

from __future__ import annotations

import os
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.linalg import block_diag

__all__ = [
    "POSE",
    "VALUES",
    "DataError",
    "Dataset",
    "LineReader",
    "check_clocks",
    "locate",
    "make_events",
    "stack_events",
]

Array = NDArray[np.float64]

POSE = ("x", "y", "heading")

VALUES = {
    "odometry": ("speed", "turn_rate"),
    "displacement": ("forward", "left", "turn", "duration"),
    "range_bearing": ("range", "bearing"),
    "offset": ("forward", "left"),
    "range": ("range",),
    "prior": POSE,
    "survey": ("x", "y"),
}
"""The values of each kind of event, in m, rad and s."""

_VALUE_COLUMNS = ("value0", "value1", "value2", "value3")
_COLUMNS = ("time", "robot", "kind", "subject", *_VALUE_COLUMNS, "cov")

Event = tuple[float, str, str, str, tuple[float, ...], Array | None]
"""Time, robot, kind, subject, values and their covariance, if the file has one."""

LATEST = 1e11
"""A clock in seconds shows less, for three thousand years to come."""

_DAY = 86400.0
"""In s; streams of one log begin within a day of each other."""


class DataError(ValueError):
    """A file of data that is not as its format says; the message begins with file and line."""


class LineReader:
    """The lines of a text file, split at white space, without comments and blank lines.

    Parameters
    ----------
    path : Path
    comment : str
        The sign with which a comment begins.

    Raises
    ------
    DataError
        If the file does not exist.
    """

    def __init__(self, path: Path, comment: str = "#") -> None:
        self.path = path
        if not path.is_file():
            raise DataError(f"{path}: no such file")
        self.lines: list[tuple[int, list[str]]] = []
        # A stray byte in a comment is no reason to refuse the file.
        text = path.read_text(encoding="utf-8", errors="replace")
        # Lines count from 1, as editors show them.
        for number, line in enumerate(text.splitlines(), start=1):
            words = line.partition(comment)[0].split()
            if words:
                self.lines.append((number, words))

    def error(self, number: int, text: str) -> DataError:
        """Return an error that names the file and the line."""
        return DataError(f"{self.path}:{number}: {text}")

    def numbers(self, number: int, words: Sequence[str], names: str) -> list[float]:
        """Return words as finite numbers, of which there must be one for each name."""
        n_expected = len(names.split())
        if len(words) != n_expected:
            raise self.error(
                number,
                f"expected {n_expected} numbers ({names}) between spaces, got {len(words)}",
            )
        values = []
        for word in words:
            try:
                value = float(word)
            except ValueError:
                raise self.error(number, f"expected a number, got {word!r}") from None
            # float() reads "nan" and "inf" too.
            if not np.isfinite(value):
                raise self.error(number, f"expected a finite number, got {word}")
            values.append(value)
        return values

    def table(self, names: str) -> Array:
        """Return all lines as rows of numbers, one column for each name.

        A column `time` must not decrease.
        """
        n_columns = len(names.split())
        try:
            # All lines at once: a real log has hundreds of thousands of them.
            table = np.array([words for _, words in self.lines], dtype=float)
        except ValueError:
            table = np.zeros((0, 0))
        if table.shape[1:] != (n_columns,) or not np.isfinite(table).all():
            # One by one, to name the line that is wrong. A file without lines gives no rows.
            rows = [self.numbers(number, words, names) for number, words in self.lines]
            table = np.array(rows).reshape(-1, n_columns)
        if "time" in names.split():
            times = table[:, names.split().index("time")]
            # Equal times are allowed: a camera sees several barcodes in one picture.
            late = np.flatnonzero(np.diff(times) < 0)
            if late.size:
                number, words = self.lines[late[0] + 1]
                column = names.split().index("time")
                _, before = self.lines[late[0]]
                raise self.error(
                    number,
                    f"times must not decrease, got {words[column]} after {before[column]}: "
                    "sort the lines by time",
                )
        return table

    def refuse_rows(self, is_wrong: NDArray[np.bool_], text: str) -> None:
        """Raise an error about the first line that is wrong, if one is."""
        if is_wrong.any():
            number, words = self.lines[int(np.argmax(is_wrong))]
            raise self.error(number, f"{text}, got {' '.join(words)}")


@dataclass(frozen=True, eq=False)
class Dataset:
    """The log of several robots, and the truth about it, which a filter must not use.

    Parameters
    ----------
    events : DataFrame
        One row an event, in the order of time: ``time`` in s since `origin`, ``robot``, ``kind``,
        ``subject`` (the robot or landmark that is observed, or an empty text), ``value0`` to
        ``value3`` with the meaning that `of_kind` gives them, and ``cov``, an array or None.
    truth : DataFrame
        Poses ``time``, ``robot``, ``x``, ``y``, ``heading``; empty if the log has none.
    landmarks : DataFrame
        Places ``x``, ``y`` by ``subject``; empty if the log has none.
    robots : tuple of str
    origin : float
        The clock's reading at time 0, in s.
    dropped : int
        How many observations were left out because their subject is not known.
    """

    events: pd.DataFrame
    truth: pd.DataFrame
    landmarks: pd.DataFrame
    robots: tuple[str, ...]
    origin: float = field(default=0.0, kw_only=True)
    dropped: int = field(default=0, kw_only=True)

    def of_kind(self, kind: str) -> pd.DataFrame:
        """Return the events of one kind, with its values under their names.

        Raises
        ------
        ValueError
            If there is no such kind.
        """
        if kind not in VALUES:
            raise ValueError(f"kind must be one of {', '.join(VALUES)}, got {kind!r}")
        chosen = self.events[self.events["kind"] == kind]
        # Columns that the kind does not use are left out.
        names = {f"value{k}": name for k, name in enumerate(VALUES[kind])}
        columns = ["time", "robot", "subject", *names, "cov"]
        return chosen[columns].rename(columns=names).reset_index(drop=True)

    def before(self, end: float) -> Dataset:
        """Return the part of the log before a time, in s."""
        return replace(
            self,
            events=self.events[self.events["time"] < end],
            truth=self.truth[self.truth["time"] < end],
        )

    def grid(self, dt: float) -> Array:
        """Return the multiples of `dt` up to the last event, from 0 on, (T + 1,)."""
        # With a margin, so that 0.3 / 0.1, just below 3, counts as 3.
        last = float(self.events["time"].max())
        return np.arange(int(np.floor(last / dt + 1e-9)) + 1) * np.float64(dt)

    def shifted(self, kind: str, seconds: float) -> Dataset:
        """Return the log with all events of one kind later by so many seconds, as by a lag."""
        times = self.events["time"] + seconds * (self.events["kind"] == kind)
        events = self.events.assign(time=times)
        events = events.sort_values("time", kind="stable", ignore_index=True)
        return replace(self, events=events)

    def polar(self) -> Dataset:
        """Return the log with offsets in a robot's frame as ranges and bearings.

        Their covariances are left out: those of the published files are the same in all
        directions, which no camera has.
        """
        events = self.events.copy()
        is_offset = (events["kind"] == "offset").to_numpy()
        forward = events.loc[is_offset, "value0"].to_numpy(dtype=float)
        left = events.loc[is_offset, "value1"].to_numpy(dtype=float)
        events.loc[is_offset, "value0"] = np.hypot(forward, left)
        events.loc[is_offset, "value1"] = np.arctan2(left, forward)
        events.loc[is_offset, "kind"] = "range_bearing"
        events.loc[is_offset, "cov"] = None
        return replace(self, events=events)

    def by_step(self, kind: str, dt: float) -> dict[int, list[tuple[str, str, Array]]]:
        """Return the observations of one kind by the nearest multiple of `dt`.

        Each is a robot, a subject and the values. A robot that observes itself has read a wrong
        name, and is left out; so is a line that repeats another one.
        """
        rows = self.of_kind(kind)
        rows = rows[rows["robot"] != rows["subject"]]
        # The same line twice is one observation, and does not confirm itself.
        rows = rows.drop_duplicates(["time", "robot", "subject", *VALUES[kind]])
        steps = np.rint(rows["time"] / dt).astype(int)
        values = rows[list(VALUES[kind])].to_numpy(dtype=float)
        groups: dict[int, list[tuple[str, str, Array]]] = {}
        for step, robot, subject, value in zip(
            steps, rows["robot"], rows["subject"], values, strict=True
        ):
            groups.setdefault(int(step), []).append((robot, subject, value))
        return groups

    def body_rates(self, dt: float | None = None) -> tuple[Array, Array]:
        """Return all robots' measured motion as the inputs of `planar_odometry`.

        Parameters
        ----------
        dt : float, optional
            The means over cells of this length, in s. By default an input begins wherever one of
            a robot begins.

        Returns
        -------
        times : (T,)
            When each input begins.
        rates : (T, 3 A)
            Forward and leftward speed and turn rate of each robot, in m/s, m/s and rad/s. An
            input of odometry holds until the next one. A displacement is spread over its
            duration. Without an input a robot stands.

        Raises
        ------
        DataError
            If no robot has odometry or displacements.

        Warns
        -----
        RuntimeWarning
            If an input of odometry has to hold for more than a second, and ten times longer than
            the robot's inputs usually do: the log has a gap.

        Notes
        -----
        The errors of two inputs are independent for `planar_odometry`, so the same `std` adds less
        noise if inputs are shorter. By default they are shorter the more robots have clocks of
        their own. With `dt` a setting means the same for every log.
        """
        pieces = self._inputs
        if not any(len(begins) for begins, _ in pieces):
            raise DataError("events: none of odometry or displacement")
        self._warn_of_gaps()
        if dt is None:
            knots = np.unique(np.concatenate([begins for begins, _ in pieces]))
        else:
            knots = self.grid(dt)
        # The last input holds on, so its cell has any end behind it.
        edges = np.append(knots, knots[-1] + (dt or 1.0))
        rates = np.zeros((len(knots), len(pieces), 3))
        for k, (begins, values) in enumerate(pieces):
            if not len(begins):
                continue
            # The integral up to each input's begin; between them it is linear.
            held = max(edges[-1] - begins[-1], 0.0) + 1.0
            nodes = np.append(begins, begins[-1] + held)
            steps = np.diff(nodes)[:, None] * values
            integral = np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
            for j in range(3):
                # Mean over [a, b]: (F(b) - F(a)) / (b - a) with the integral F.
                at_edges = np.interp(edges, nodes, integral[:, j])
                rates[:, k, j] = np.diff(at_edges) / np.diff(edges)
        return knots, rates.reshape(len(knots), -1)

    @cached_property
    def _inputs(self) -> list[tuple[Array, Array]]:
        """When each input of each robot begins, (N,), and its rates, (N, 3)."""
        return [self._list_inputs(robot) for robot in self.robots]

    def _warn_of_gaps(self) -> None:
        """Warn of odometry that is missing for long."""
        end = float(self.events["time"].max())
        has_odometry = self.events.loc[self.events["kind"] == "odometry", "robot"]
        for robot in has_odometry.unique():
            begins, _ = self._inputs[self.robots.index(robot)]
            held = np.diff(np.append(begins, end))
            longest = int(np.argmax(held))
            if held[longest] > max(1.0, 10 * float(np.median(held))):
                start = begins[longest]
                warnings.warn(
                    f"odometry of robot {robot} has a gap from {start:.1f} to "
                    f"{start + held[longest]:.1f} s, in which its last input is held",
                    RuntimeWarning,
                    stacklevel=3,
                )

    def _list_inputs(self, robot: str) -> tuple[Array, Array]:
        """Return when each input of a robot begins, (N,), and its rates, (N, 3)."""
        of_robot = self.events[self.events["robot"] == robot]
        odometry = of_robot[of_robot["kind"] == "odometry"]
        if len(odometry):
            # Of several inputs at one time the last one holds.
            odometry = odometry.drop_duplicates("time", keep="last")
            values = odometry[["value0", "value1"]].to_numpy(dtype=float)
            # A wheel measures no sideways speed.
            return odometry["time"].to_numpy(dtype=float), np.insert(
                values, 1, 0.0, axis=1
            )
        steps = of_robot[of_robot["kind"] == "displacement"]
        begins: list[float] = []
        inputs: list[list[float]] = []
        rows = steps[["time", *_VALUE_COLUMNS]].to_numpy(dtype=float).tolist()
        for end, forward, left, turn, duration in rows:
            # A step begins where the former one ended, or after a pause.
            begins += [end - duration, end]
            rates = _rates_of_displacement(forward, left, turn, duration)
            inputs += [rates, [0.0, 0.0, 0.0]]
        if not begins:
            return np.zeros(0), np.zeros((0, 3))
        # The pause between two steps is often empty, or rounding alone.
        times = np.array(begins)
        lasts = np.append(np.diff(times) > 1e-6, True)
        return times[lasts], np.array(inputs)[lasts]

    def prior_poses(self) -> tuple[Array, Array]:
        """Return mean (3 A,) and covariance of the poses that are known beforehand.

        Raises
        ------
        DataError
            If a robot has none.
        """
        starts = self.of_kind("prior").drop_duplicates("robot").set_index("robot")
        missing = [robot for robot in self.robots if robot not in starts.index]
        if missing:
            raise DataError(
                f"priors: none for robot {', '.join(missing)} (`start_poses` takes the first "
                "poses from the truth, with errors)"
            )
        starts = starts.loc[list(self.robots)]
        # The robots' starts are independent: a block for each on the diagonal.
        mean = starts[list(POSE)].to_numpy(dtype=float).ravel()
        return mean, np.asarray(block_diag(*starts["cov"]))

    def start_poses(
        self, t: float, *, std: Sequence[float], rng: np.random.Generator
    ) -> tuple[Array, Array]:
        """Return mean (3 A,) and covariance of poses that somebody has measured at one time.

        They are the true poses with Gaussian errors. Most logs have no priors, and a filter has to
        begin somewhere.

        Parameters
        ----------
        t : float
            In s.
        std : three float
            Standard deviations of x, y and heading, in m and rad.
        rng : numpy.random.Generator

        Raises
        ------
        DataError
            If the truth has a gap there.
        """
        poses = self.true_poses(np.array([t]))[0]
        unknown = [
            robot
            for robot, pose in zip(self.robots, poses, strict=True)
            if np.isnan(pose).any()
        ]
        if unknown:
            raise DataError(
                f"truth must have each robot's pose at t = {t:g} s: "
                + ", ".join(self._describe_truth(robot, t) for robot in unknown)
            )
        errors = np.asarray(std) * rng.standard_normal(poses.shape)
        variances = np.tile(np.square(std), len(poses))
        return (poses + errors).ravel(), np.diag(variances)

    def _describe_truth(self, robot: str, t: float) -> str:
        """Say which truth of a robot there is around a time."""
        logged, _ = self._tracks[self.robots.index(robot)]
        if not logged.size:
            return f"robot {robot} has none"
        if not logged[0] <= t <= logged[-1]:
            return f"robot {robot} has {logged[0]:.1f} to {logged[-1]:.1f} s"
        upper = np.searchsorted(logged, t)
        begin, end = logged[upper - 1], logged[upper]
        return f"robot {robot} has a gap from {begin:.1f} to {end:.1f} s"

    def true_poses(self, times: Array, *, longest_gap: float = 1.0) -> Array:
        """Return each robot's true pose at `times`, (T, A, 3), for scores alone.

        Between two logged poses it is interpolated; NaN in gaps longer than `longest_gap`, in s,
        and outside the log. Headings run on beyond π.
        """
        poses = np.full((len(times), len(self.robots), 3), np.nan)
        for k, (logged, values) in enumerate(self._tracks):
            if not logged.size:
                continue
            # The truth is not extrapolated.
            inside = (times >= logged[0]) & (times <= logged[-1])
            # The logged pose at or before each time, and the next one
            lower = np.searchsorted(logged, times, side="right").clip(1) - 1
            upper = np.minimum(lower + 1, len(logged) - 1)
            gap = logged[upper] - logged[lower]
            # A logged pose is known, whatever is around it.
            is_logged = logged[lower] == times
            is_known = inside & ((gap <= longest_gap) | is_logged)
            part = (times - logged[lower]) / np.where(gap > 0, gap, 1.0)
            series = values[lower] + part[:, None] * (values[upper] - values[lower])
            poses[is_known, k] = series[is_known]
        return poses

    def true_state(self, t: float) -> Array:
        """Return the true poses of all robots at one time, one after the other, (3 A,)."""
        return self.true_poses(np.array([t])).ravel()

    @property
    def begin(self) -> float:
        """The first time, in s, at which the true poses of all robots are known; inf if never."""
        starts = [logged[0] if logged.size else np.inf for logged, _ in self._tracks]
        return float(max(starts))

    @cached_property
    def _tracks(self) -> list[tuple[Array, Array]]:
        """Each robot's logged times and true poses, with headings that run on."""
        tracks = []
        for robot in self.robots:
            rows = self.truth[self.truth["robot"] == robot]
            values = rows[list(POSE)].to_numpy(dtype=float).copy()
            # A logged heading jumps from π to -π, between which no mean may be taken.
            values[:, 2] = np.unwrap(values[:, 2])
            tracks.append((rows["time"].to_numpy(dtype=float), values))
        return tracks


def locate(name: str) -> Path | None:
    """Return the path of a file or folder in the folder ``DISTFILT_DATA``; None without it.

    Raises
    ------
    DataError
        If the environment variable names a folder that does not exist.

    Examples
    --------
    >>> locate("no such set") is None
    True
    """
    root = os.environ.get("DISTFILT_DATA")
    if not root:
        return None
    folder = Path(root).expanduser()
    if not folder.is_dir():
        raise DataError(f"{folder}: DISTFILT_DATA must be a folder, and is not there")
    path = folder / name
    return path if path.exists() else None


def check_clocks(times_by_stream: Mapping[str, Array]) -> None:
    """Refuse the times of a log whose streams have no clock in common, or one not in seconds.

    Raises
    ------
    DataError
        That names a stream.

    Examples
    --------
    >>> check_clocks({"wheels": np.array([1.3e9]), "camera": np.array([1.3e18])})
    Traceback (most recent call last):
    bookkit.datasets.table.DataError: camera: expected times in seconds, got 1.3e+18
    """
    begins = {
        name: times.min() for name, times in times_by_stream.items() if times.size
    }
    for name, begin in begins.items():
        if abs(begin) > LATEST:
            raise DataError(f"{name}: expected times in seconds, got {begin:.4g}")
    if not begins:
        return
    first = min(begins, key=begins.__getitem__)
    last = max(begins, key=begins.__getitem__)
    if begins[last] - begins[first] > _DAY:
        raise DataError(
            f"{last}: begins at {begins[last]:.1f} s, more than a day after {first} at "
            f"{begins[first]:.1f} s: bring all times to one clock"
        )


def make_events(events: Sequence[Event]) -> pd.DataFrame:
    """Return events as a table in the order of time; those of one time keep theirs."""
    rows = []
    for time, robot, kind, subject, values, cov in events:
        # As many columns of values for all kinds.
        padded = [*values, *[np.nan] * (len(_VALUE_COLUMNS) - len(values))]
        rows.append((time, robot, kind, subject, *padded, cov))
    frame = pd.DataFrame(rows, columns=list(_COLUMNS))
    # Without rows the columns have no type of their own.
    frame = frame.astype(dict.fromkeys(("time", *_VALUE_COLUMNS), float))
    # A stable sort, so that events of one time keep their order.
    return frame.sort_values("time", kind="stable").reset_index(drop=True)


def stack_events(
    table: Array, robot: str, kind: str, subjects: Sequence[str] | str = ""
) -> pd.DataFrame:
    """Return events of one kind and one robot from rows (time, values ...), without sorting."""
    columns: dict[str, object] = {
        "time": table[:, 0],
        "robot": robot,
        "kind": kind,
        "subject": subjects,
    }
    for k, name in enumerate(_VALUE_COLUMNS, start=1):
        columns[name] = table[:, k] if k < table.shape[1] else np.nan
    # `cov` is an object for each row, and None here.
    frame = pd.DataFrame(columns)
    frame["cov"] = None
    return frame[list(_COLUMNS)]


def _rates_of_displacement(
    forward: float, left: float, turn: float, duration: float
) -> list[float]:
    """Return the constant rates of a body that end in a displacement.

    A displacement is in the frame of the pose before it. On an arc the body moves along its
    heading of each moment, so that the chord d = R(turn / 2) v duration sinc(turn / 2) is turned
    back by half of the turn.
    """
    # Whole turns within one displacement leave no trace in it.
    turn = float((turn + np.pi) % (2 * np.pi) - np.pi)
    scale = duration * np.sinc(turn / (2 * np.pi))
    c = np.cos(turn / 2)
    s = np.sin(turn / 2)
    return [
        float((c * forward + s * left) / scale),
        float((c * left - s * forward) / scale),
        turn / duration,
    ]
