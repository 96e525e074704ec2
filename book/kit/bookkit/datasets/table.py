"""The common form of all logs: a table of events, the truth apart, and landmarks."""

from __future__ import annotations

import os
from collections.abc import Sequence
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
    "locate",
    "make_events",
]

Array = NDArray[np.float64]

POSE = ("x", "y", "heading")

VALUES = {
    "odometry": ("speed", "turn_rate"),
    "displacement": ("forward", "left", "turn"),
    "range_bearing": ("range", "bearing"),
    "offset": ("forward", "left"),
    "range": ("range",),
    "prior": POSE,
    "survey": ("x", "y"),
}
"""The values of each kind of event, in m, rad and s."""

_COLUMNS = ("time", "robot", "kind", "subject", "value0", "value1", "value2", "cov")

Event = tuple[float, str, str, str, tuple[float, ...], Array | None]
"""Time, robot, kind, subject, values and their covariance, if the file has one."""


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
                f"expected {n_expected} numbers ({names}), got {len(words)}",
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
        rows = [self.numbers(number, words, names) for number, words in self.lines]
        # A file without lines gives no rows, and still all columns.
        table = np.array(rows).reshape(-1, len(names.split()))
        if "time" in names.split():
            times = table[:, names.split().index("time")]
            # Equal times are allowed: a camera sees several barcodes in one picture.
            late = np.flatnonzero(np.diff(times) < 0)
            if late.size:
                number, _ = self.lines[late[0] + 1]
                raise self.error(number, "times must not decrease")
        return table


@dataclass(frozen=True, eq=False)
class Dataset:
    """The log of several robots, and the truth about it, which a filter must not use.

    Parameters
    ----------
    events : DataFrame
        One row an event, in the order of time: ``time`` in s since `origin`, ``robot``, ``kind``,
        ``subject`` (the robot or landmark that is observed, or an empty text), ``value0`` to
        ``value2`` with the meaning that `of_kind` gives them, and ``cov``, an array or None.
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

    def average_odometry(self, times: Array) -> Array:
        """Return each robot's mean speed and turn rate between successive times, (T, A, 2).

        An input holds until the robot's next one; before its first one the robot stands.
        """
        odometry = self.of_kind("odometry")
        averages = np.zeros((len(times) - 1, len(self.robots), 2))
        for k, robot in enumerate(self.robots):
            rows = odometry[odometry["robot"] == robot]
            logged = rows["time"].to_numpy()
            if not logged.size:
                continue
            values = rows[["speed", "turn_rate"]].to_numpy()
            # The integral up to each input's time; between them it is linear.
            pieces = np.diff(logged)[:, None] * values[:-1]
            integral = np.concatenate([np.zeros((1, 2)), np.cumsum(pieces, axis=0)])
            # The last input is held to the end of the grid, and a second more.
            held = max(times[-1] - logged[-1], 0.0)
            knots = np.append(logged, logged[-1] + held + 1.0)
            integral = np.append(
                integral, integral[-1:] + (held + 1.0) * values[-1:], axis=0
            )
            for j in range(2):
                # Mean over [a, b]: (F(b) - F(a)) / (b - a) with the integral F.
                at_times = np.interp(times, knots, integral[:, j])
                averages[:, k, j] = np.diff(at_times) / np.diff(times)
        return averages

    def displacement_rates(self) -> tuple[Array, Array]:
        """Return when each step begins, (T,), and all robots' displacements a second, (T, 3 A).

        Raises
        ------
        DataError
            If a robot lacks a step, or the steps differ in length.
        """
        steps = self.of_kind("displacement").sort_values(["time", "robot"])
        ends = steps["time"].unique()
        n_robots = len(self.robots)
        # The length of a step is the time between two ends, so there must be two.
        if len(steps) != len(ends) * n_robots or len(ends) < 2:
            raise DataError("displacements: every robot must have one in each step")
        dt = float(ends[1] - ends[0])
        if not np.allclose(np.diff(ends), dt, rtol=1e-6):
            raise DataError("displacements: steps must have one length")
        # By time and then by robot: one row a step holds all robots, in m/s and rad/s.
        values = steps[list(VALUES["displacement"])].to_numpy(dtype=float)
        return np.asarray(ends - dt), values.reshape(len(ends), -1) / dt

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
            raise DataError(f"priors: none for robot {', '.join(missing)}")
        starts = starts.loc[list(self.robots)]
        # The robots' starts are independent: a block for each on the diagonal.
        mean = starts[list(POSE)].to_numpy(dtype=float).ravel()
        return mean, np.asarray(block_diag(*starts["cov"]))

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
            # The logged pose at or after each time; the one before it is its neighbour.
            upper = np.searchsorted(logged, times).clip(1, max(len(logged) - 1, 1))
            is_known = inside
            if len(logged) > 1:
                gap = logged[upper] - logged[upper - 1]
                is_known = inside & (gap <= longest_gap)
            for j in range(3):
                series = np.interp(times, logged, values[:, j])
                poses[:, k, j] = np.where(is_known, series, np.nan)
        return poses

    def true_state(self, t: float) -> Array:
        """Return the true poses of all robots at one time, one after the other, (3 A,)."""
        return self.true_poses(np.array([t])).ravel()

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


def make_events(events: Sequence[Event]) -> pd.DataFrame:
    """Return events as a table in the order of time; those of one time keep theirs."""
    rows = []
    for time, robot, kind, subject, values, cov in events:
        # Three columns of values for all kinds.
        padded = [*values, np.nan, np.nan, np.nan][:3]
        rows.append((time, robot, kind, subject, *padded, cov))
    frame = pd.DataFrame(rows, columns=list(_COLUMNS))
    # Without rows the columns have no type of their own.
    frame = frame.astype({"time": float, "value0": float, "value1": float})
    frame["value2"] = frame["value2"].astype(float)
    # A stable sort, so that events of one time keep their order.
    return frame.sort_values("time", kind="stable").reset_index(drop=True)
