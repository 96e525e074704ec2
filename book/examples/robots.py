"""Five robots with odometry track a sixth: sightings at any time, contact every ten seconds."""

import tempfile
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from distfilt import filters
from distfilt.mixtures import target_fusion
from distfilt.models import constant_velocity
from distfilt.network import graphs
from distfilt.sensors import Sensor, range_bearing

STD = (0.3, 0.04)  # of range, in m, and bearing, in rad
RATE = 0.4  # sightings of a robot a second
END = 120.0
ROBOTS = 5
Pose = tuple[float, float, float]


def target(t: Any) -> np.ndarray:
    """Position and velocity of the sixth robot: a wide arc."""
    angle = np.asarray(t) / 40
    c = np.cos(angle)
    s = np.sin(angle)
    arc: np.ndarray = np.stack([s, 1 - c, c, s], axis=-1)
    return arc * [20, 20, 0.5, 0.5]


def first_pose(robot: int) -> Pose:
    """Where a robot starts: x, y and heading."""
    return 8.0 * robot - 16, -5.0, 0.3 * robot


def drive(pose: Pose, speed: float, turn: float, dt: float) -> Pose:
    """The pose after a straight drive, then a turn."""
    x, y, heading = pose
    x = x + dt * speed * np.cos(heading)
    y = y + dt * speed * np.sin(heading)
    return x, y, heading + dt * turn


def sensor_at(pose: Pose) -> Sensor:
    """The range-bearing sensor of a robot at a pose."""
    x, y, heading = pose
    return range_bearing((0, 1), std=STD, origin=(x, y), heading=heading)


def simulate(path: Path, rng: np.random.Generator) -> None:
    """Write each robot's log: odometry and sightings, of which one in twenty is an outlier."""
    rows = []
    for robot in range(ROBOTS):
        pose = first_pose(robot)
        t = 0.0
        while True:
            dt = rng.exponential(1 / RATE)
            if t + dt >= END:
                break
            speed = 0.4
            turn = 0.05 * np.sin(t / 10 + robot)
            pose = drive(pose, speed, turn, dt)
            t = t + dt
            odometry = rng.normal([speed, turn], [0.005, 0.0005])
            sighting = sensor_at(pose).observe(target(t), rng=rng)
            outlier = 8.0 * (rng.random() < 0.05)
            rows.append([t, robot, dt, *odometry, *(sighting + outlier)])
    np.savetxt(path, sorted(rows), delimiter=",")


def read_log(path: Path) -> Iterator[filters.Observation]:
    """Yield a log's sightings, each by a sensor where the robot's odometry puts it."""
    poses = {robot: first_pose(robot) for robot in range(ROBOTS)}
    rows = np.loadtxt(path, delimiter=",").tolist()
    for t, robot, dt, speed, turn, *sighting in rows:
        pose = drive(poses[robot], speed, turn, dt)
        poses[robot] = pose
        yield filters.Observation(
            t, int(robot), sighting, sensor_at(pose), metadata=pose
        )


log = Path(tempfile.mkdtemp()) / "log.csv"
simulate(log, np.random.default_rng(0))
observations = list(read_log(log))
times = np.unique([observation.t for observation in observations])
model = constant_velocity(sigma=0.03)
truth = dict(zip(model.names, target(times).T, strict=True))

# Outliers are gated; messages are exchanged every ten seconds only.
sensors = [None] * ROBOTS  # each observation brings its own
ring = graphs.ring(ROBOTS)
options: dict[str, Any] = {"gate_probability": 0.999, "exchange_interval": 10.0}
fuse = partial(target_fusion, target_dim=4)
families: dict[str, Any] = {
    "mixture": filters.MixtureFilter(
        model, sensors, ring, fusion=fuse, target_dim=4, **options
    ),
    "gaussian": filters.GaussianFilter(model, sensors, ring, lag=40, **options),
    "ensemble": filters.EnsembleFilter(
        model, sensors, ring, lag=40, members=100, **options
    ),
    "increment": filters.InformationIncrementFilter(
        model, sensors, ring, target_dim=4, **options
    ),
}
print("filter    error/m  NEES/d  rejected  floats")
for name, f in families.items():
    prior = (target(0.0), np.diag([4, 4, 0.1, 0.1]))
    state = f.start(prior, rng=np.random.default_rng(1))
    run = f.run(state, None, observations, truth=truth)
    late = run.sel(time=slice(20, None))
    error = np.sqrt(late["squared_error"][..., :2].sum("component").mean())
    nees = late["nees"].mean() / 4
    rejected = int(run["rejected"].sum())
    floats = int(run["scalars"].sum())
    print(f"{name:9s} {error:7.2f} {nees:7.2f} {rejected:9d} {floats:7d}")
