"""From a log to a filter and back: where each body stands in the state, its sensors, its errors.

A state holds the poses (x, y, heading) of all robots, and behind them the places of the landmarks
that are to be estimated.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import Any

import numpy as np
import pandas as pd

from distfilt.filters import GaussianFilter, GaussianState, Observation
from distfilt.sensors import (
    Sensor,
    distance,
    locate_sighting,
    range_bearing,
    sighting_cov,
    wrap,
)

from .table import Array, Dataset

__all__ = [
    "follow_sightings",
    "list_observations",
    "list_places",
    "make_sensors",
    "score_landmarks",
    "score_poses",
]


def list_places(
    data: Dataset, *, anchors: pd.DataFrame | None = None
) -> dict[str, list[int]]:
    """Return the components x and y of each robot and of each landmark that is no anchor.

    Parameters
    ----------
    data : Dataset
    anchors : DataFrame, optional
        Landmarks, by subject, whose places are known; they are no part of the state.
    """
    surveyed = [] if anchors is None else list(anchors.index)
    places = {robot: [3 * k, 3 * k + 1] for k, robot in enumerate(data.robots)}
    first = 3 * len(data.robots)
    for subject in data.landmarks.index:
        if subject not in surveyed:
            places[subject] = [first, first + 1]
            first += 2
    return places


def make_sensors(
    data: Dataset, kind: str, std: Any, *, anchors: pd.DataFrame | None = None
) -> dict[tuple[str, str], Sensor]:
    """Return a sensor for each robot and each other body.

    Parameters
    ----------
    data : Dataset
    kind : {"range", "range_bearing"}
    std : float, or two float
        Standard deviation of a range, in m; or of a range and a bearing, in m and rad.
    anchors : DataFrame, optional
        Places ``x``, ``y`` in m, by subject, that are known. Only of ranges: a landmark that is
        seen stands in the state, with a small variance if it is known.

    Raises
    ------
    ValueError
        If the kind is another one, or has anchors and cannot use them.
    """
    if kind not in ("range", "range_bearing"):
        raise ValueError(f"kind must be range or range_bearing, got {kind!r}")
    if kind == "range_bearing" and anchors is not None:
        raise ValueError(
            "anchors must be None for range_bearing: put them into the state, with a small "
            "variance"
        )
    places = list_places(data, anchors=anchors)
    sensors = {}
    for robot in data.robots:
        position = places[robot]
        for subject, place in places.items():
            if subject == robot:
                continue
            if kind == "range":
                sensor = distance(position, std=std, observer=place)
            else:
                pose = [*position, position[1] + 1]
                pair = (place[0], place[1])
                sensor = range_bearing(pair, std=std, observer=pose)
            sensors[robot, subject] = sensor
        if anchors is not None:
            for subject, place in anchors[["x", "y"]].iterrows():
                sensors[robot, str(subject)] = distance(position, std=std, origin=place)
    return sensors


def list_observations(
    data: Dataset, kind: str, std: Any, *, anchors: pd.DataFrame | None = None
) -> list[Observation]:
    """Return all observations of one kind, each with its sensor, for the robot that made it.

    Parameters
    ----------
    data, kind, std, anchors
        As for `make_sensors`.

    Raises
    ------
    ValueError
        If the log has an observation of something that is neither in the state nor an anchor.
    """
    sensors = make_sensors(data, kind, std, anchors=anchors)
    rows = data.of_kind(kind)
    values = rows[kind.split("_")].to_numpy(dtype=float)
    agents = {robot: k for k, robot in enumerate(data.robots)}
    observations = []
    for row, value in zip(rows.itertuples(), values, strict=True):
        sensor = sensors.get((row.robot, row.subject))
        if sensor is None:
            raise ValueError(
                f"data must observe robots and landmarks, got robot {row.robot} observing "
                f"{row.subject!r} at {row.time:g} s"
            )
        observations.append(Observation(row.time, agents[row.robot], value, sensor))
    return observations


def follow_sightings(
    f: GaussianFilter,
    state: GaussianState,
    data: Dataset,
    *,
    std: tuple[float, float],
    dt: float,
    nearest: float = 1.0,
) -> Iterator[tuple[int, GaussianState]]:
    """Step a filter through all sightings of a log, and begin landmarks when they are seen.

    Parameters
    ----------
    f : GaussianFilter
        With one agent, which hears all robots; its state holds all poses and landmarks.
    state : GaussianState
    data : Dataset
    std : (float, float)
        Standard deviations of range and bearing, in m and rad.
    dt : float
        Times are rounded to multiples of it, in s.
    nearest : float
        A landmark begins where two successive sightings put it, at most so many metres apart;
        infinity lets it begin at the first one. A wrong barcode would begin it elsewhere, with a
        small covariance.

    Yields
    ------
    step : int
        The time in multiples of `dt`.
    state : GaussianState
        After this step's sightings.
    """
    places = list_places(data)
    sensors = make_sensors(data, "range_bearing", std)
    # The last place at which an unknown landmark was seen; nowhere at first.
    candidates = {subject: np.full(2, np.inf) for subject in data.landmarks.index}
    last = len(data.grid(dt)) - 1
    for step, sightings in data.by_step("range_bearing", dt).items():
        t = dt * step
        if not state.t < t or step > last:
            continue
        observations = [
            Observation(t, 0, value, sensors[robot, subject])
            for robot, subject, value in sightings
            if subject not in candidates
        ]
        state = f.step(state, t, [observations])
        for robot, subject, value in sightings:
            if subject not in candidates:
                continue
            pose = [*places[robot], places[robot][1] + 1]
            locate = partial(locate_sighting, value=value, observer=pose)
            place = locate(state.means[0])
            if np.linalg.norm(place - candidates[subject]) > nearest:
                candidates[subject] = place
                continue
            del candidates[subject]
            noise_cov = sensors[robot, subject].noise_cov
            cov = sighting_cov(state.means[0], value, noise_cov, observer=pose)
            state = f.reset(state, places[subject], locate, cov)
        yield step, state


def score_poses(data: Dataset, times: Array, means: Array, covs: Array) -> pd.DataFrame:
    """Return the errors of the poses at each time: ``position``, ``heading`` and ``nees``.

    Parameters
    ----------
    data : Dataset
        With the truth.
    times : array, (T,)
    means : array, (T, ..., d)
        Of one filter, or of each agent: ``run["mean"].values``.
    covs : array, (T, ..., d, d)

    Returns
    -------
    DataFrame
        By time, the mean over agents: the squared error of a robot's position, in m², and of its
        heading, in rad², means over robots; and the squared error of all poses in units of the
        covariance, for each component: 1 for a consistent filter. Poses whose truth has a gap are
        left out; a time without any is NaN.
    """
    n = 3 * len(data.robots)
    truth = data.true_poses(np.asarray(times)).reshape(len(times), n)
    rows = np.full((len(times), 3), np.nan)
    # All times at once whose truth has the same gaps.
    patterns, group = np.unique(~np.isnan(truth), axis=0, return_inverse=True)
    for k, is_known in enumerate(patterns):
        scored = np.flatnonzero(is_known)
        if not scored.size:
            continue
        chosen = np.flatnonzero(group == k)
        mean = means[chosen][..., scored]
        pose = truth[chosen][:, scored]
        # The same truth for each agent, (T, 1, ..., d)
        error = mean - pose.reshape(len(chosen), *[1] * (mean.ndim - 2), -1)
        is_heading = scored % 3 == 2
        error[..., is_heading] = wrap(error[..., is_heading])
        cov = covs[chosen][..., scored[:, None], scored]
        weighted = np.linalg.solve(cov, error[..., None])[..., 0]
        square = (error**2).reshape(len(chosen), -1, len(scored))
        rows[chosen, 0] = 2 * square[..., ~is_heading].mean(axis=(1, 2))
        rows[chosen, 1] = square[..., is_heading].mean(axis=(1, 2))
        products = (error * weighted).reshape(len(chosen), -1)
        rows[chosen, 2] = products.mean(axis=1)
    names = ["position", "heading", "nees"]
    return pd.DataFrame(rows, index=pd.Index(times, name="time"), columns=names)


def score_landmarks(data: Dataset, mean: Array, cov: Array) -> pd.DataFrame:
    """Return the errors of the landmarks behind the poses: ``place`` and ``place_nees``.

    Parameters
    ----------
    data : Dataset
        With the landmarks' true places.
    mean : array, (d,)
    cov : array, (d, d)

    Returns
    -------
    DataFrame
        By subject: the squared error, in m², and the squared error in units of the covariance for
        each component. A landmark that has never been seen has the prior's.
    """
    first = 3 * len(data.robots)
    error = np.reshape(mean[first:], (-1, 2)) - data.landmarks.to_numpy()
    squares = {}
    for k, (subject, gap) in enumerate(zip(data.landmarks.index, error, strict=True)):
        place = slice(first + 2 * k, first + 2 * k + 2)
        squares[subject] = {
            "place": gap @ gap,
            "place_nees": gap @ np.linalg.solve(cov[place, place], gap) / 2,
        }
    return pd.DataFrame(squares).T.rename_axis("subject")
