"""Logs of the Robot Operating System, ROS 1 and ROS 2, by the package ``rosbags``."""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pandas as pd

from .table import POSE, DataError, Dataset, Event, check_clocks, make_events

__all__ = ["read_bag"]

# The types of messages that are read, by the names that both versions of ROS give them.
_TWIST = ("nav_msgs/msg/Odometry", "geometry_msgs/msg/TwistStamped")
_RANGE = ("sensor_msgs/msg/Range",)
_POSE = ("geometry_msgs/msg/PoseStamped",)


def read_bag(path: str | Path, topics: Mapping[str, str | tuple[str, str]]) -> Dataset:
    """Read odometry, ranges and poses from a log of the Robot Operating System.

    Parameters
    ----------
    path : path
        A file of ROS 1, or a folder of ROS 2.
    topics : mapping
        For each topic its robot, or for ranges the pair of robot and subject, such as
        ``{"/r0/odom": "r0", "/r0/uwb": ("r0", "r1")}``. The meaning of a message follows from its
        type: ``Odometry`` and ``TwistStamped`` are speed and turn rate, ``Range`` is a range,
        ``PoseStamped`` the true pose.

    Returns
    -------
    Dataset
        Times are those of the messages' headers, when they were measured, not when they were
        stored; they count from the first one. A range that is infinite or outside the limits in
        its message is no measurement: it is left out, and counted in ``dropped``.

    Raises
    ------
    DataError
        If the log or a topic is not there, a topic has another type or not the names that it
        needs, or the stamps of two topics are from different clocks.
    ModuleNotFoundError
        If ``rosbags`` is not installed.
    """
    if not topics:
        raise DataError("topics must name at least one topic, got none")
    reader = _open(Path(path))
    events: list[Event] = []
    truth: list[tuple[float | str, ...]] = []
    stamps: dict[str, list[float]] = {}
    dropped = 0
    with reader:
        # A log lists its topics, each with its type, before the messages.
        known = {connection.topic: connection for connection in reader.connections}
        # Refused before the messages are read, which may take minutes.
        missing = [topic for topic in topics if topic not in known]
        if missing:
            raise DataError(
                f"{path}: no topic {', '.join(missing)}; there are {', '.join(known)}"
            )
        for topic, owner in topics.items():
            _check_topic(f"{path}: topic {topic}", known[topic].msgtype, owner)
        # A topic has a connection for each of its publishers, such as a driver restarted.
        chosen = [c for c in reader.connections if c.topic in topics]
        for connection, _, raw in reader.messages(connections=chosen):
            message = reader.deserialize(raw, connection.msgtype)
            stamp = message.header.stamp
            # Seconds since 1970 are near 1.7e9, where a float64 resolves 0.24 µs.
            time = stamp.sec + 1e-9 * stamp.nanosec
            stamps.setdefault(connection.topic, []).append(time)
            owner = topics[connection.topic]
            # Only a range has a second end.
            robot, subject = (owner, "") if isinstance(owner, str) else owner
            if connection.msgtype in _POSE:
                truth.append((time, robot, *_planar_pose(message.pose)))
            elif connection.msgtype in _RANGE:
                distance = float(message.range)
                if not _is_measured(message):
                    dropped += 1
                    continue
                events.append((time, robot, "range", subject, (distance,), None))
            else:
                twist = message.twist
                # Odometry has a twist with a covariance around it.
                twist = getattr(twist, "twist", twist)
                # In the robot's frame: forwards in m/s, and counterclockwise in rad/s.
                velocity = (float(twist.linear.x), float(twist.angular.z))
                events.append((time, robot, "odometry", "", velocity, None))
    if not events:
        raise DataError(f"{path}: no message of odometry or range in these topics")
    check_clocks(
        {f"{path}: topic {topic}": np.array(times) for topic, times in stamps.items()}
    )
    owners = [
        owner if isinstance(owner, str) else owner[0] for owner in topics.values()
    ]
    return _make_dataset(events, truth, tuple(sorted(set(owners))), dropped)


def _check_topic(name: str, kind: str, owner: str | tuple[str, str]) -> None:
    """Refuse a topic of another type, or without the names that its type needs."""
    if kind not in (*_TWIST, *_RANGE, *_POSE):
        raise DataError(f"{name} must be odometry, twist, range or pose, got {kind}")
    if kind in _RANGE and isinstance(owner, str):
        raise DataError(
            f"{name} has ranges: name the robot and whom it ranges, got {owner!r}"
        )
    if kind not in _RANGE and not isinstance(owner, str):
        raise DataError(f"{name} is of one robot: give its name alone, got {owner!r}")


def _is_measured(message: Any) -> bool:
    """Whether a range is a distance: a sensor that sees nothing reports infinity or a limit."""
    distance = float(message.range)
    if not np.isfinite(distance) or distance <= 0:
        return False
    # Limits that are both zero were not set.
    low, high = float(message.min_range), float(message.max_range)
    return high <= low or low <= distance <= high


def _make_dataset(
    events: list[Event],
    truth: list[tuple[float | str, ...]],
    robots: tuple[str, ...],
    dropped: int,
) -> Dataset:
    """Return the set, with times from its first event on."""
    # A log interleaves its topics by the time of storage, so the first event need not lead.
    origin = min(event[0] for event in events)
    shifted: list[Event] = [(event[0] - origin, *event[1:]) for event in events]
    # Poses count from the same origin, and may begin before it.
    frame = pd.DataFrame(truth, columns=["time", "robot", *POSE])
    frame["time"] = frame["time"].astype(float) - origin
    # A log of ROS holds no list of landmarks.
    places = pd.DataFrame(
        np.zeros((0, 2)), index=pd.Index([], name="subject"), columns=["x", "y"]
    )
    return Dataset(
        make_events(shifted),
        frame.sort_values("time", kind="stable", ignore_index=True),
        places,
        robots,
        origin=origin,
        dropped=dropped,
    )


def _planar_pose(pose: Any) -> tuple[float, float, float]:
    """Return x, y and the rotation about the vertical axis of a pose in space."""
    # ψ = atan2(2 (w z + x y), 1 - 2 (y² + z²)), the yaw of a unit quaternion (w, x, y, z).
    q = pose.orientation
    heading = np.arctan2(2 * (q.w * q.z + q.x * q.y), 1 - 2 * (q.y**2 + q.z**2))
    return float(pose.position.x), float(pose.position.y), float(heading)


def _open(path: Path) -> Any:
    """Return a reader of the log."""
    if not path.exists():
        raise DataError(f"{path}: no such log")
    highlevel = _import("rosbags.highlevel")
    typesys = _import("rosbags.typesys")
    # ROS 2 logs before 2023 do not define their messages, so those of one release stand in.
    types = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    return highlevel.AnyReader([path], default_typestore=types)


def _import(name: str) -> ModuleType:
    """Import a part of rosbags, or say how to install it."""
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        # Another missing package is a fault of the installation, and is reported as such.
        if error.name != "rosbags":
            raise
        raise ModuleNotFoundError(
            "rosbags is not installed; it reads logs of ROS: pip install rosbags",
            name="rosbags",
        ) from None
