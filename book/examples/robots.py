"""Five robots with odometry track a sixth: sightings at any time, contact every ten seconds."""

import tempfile
from functools import partial
from pathlib import Path

import numpy as np

from distfilt import filters
from distfilt.mixtures import target_fusion
from distfilt.models import constant_velocity
from distfilt.network import graphs
from distfilt.sensors import range_bearing

STD = (0.3, 0.04)
RATE = 0.4
END = 120.0
ROBOTS = 5


def target(t):
    """Where the sixth robot is, with its velocity: a wide arc."""
    angle = np.asarray(t) / 40
    turn = np.stack(
        [np.sin(angle), 1 - np.cos(angle), np.cos(angle), np.sin(angle)], axis=-1
    )
    return turn * [20, 20, 0.5, 0.5]


def rolled(pose, speed, turn, dt):
    x, y, heading = pose
    return (
        x + dt * speed * np.cos(heading),
        y + dt * speed * np.sin(heading),
        heading + dt * turn,
    )


def simulate(path, rng):
    """Write each robot's log: its odometry, and what it sees; one sighting in twenty is wild."""
    rows = []
    for robot in range(ROBOTS):
        pose = (8.0 * robot - 16, -5.0, 0.3 * robot)
        t = 0.0
        while (dt := rng.exponential(1 / RATE)) + t < END:
            speed = 0.4
            turn = 0.05 * np.sin(t / 10 + robot)
            pose = rolled(pose, speed, turn, dt)
            t = t + dt
            drive = rng.normal([speed, turn], [0.005, 0.0005])
            eye = range_bearing([0, 1], std=STD, origin=pose[:2], heading=pose[2])
            sight = eye.observe(target(t), rng=rng) + 8.0 * (rng.random() < 0.05)
            rows.append([t, robot, dt, *drive, *sight])
    np.savetxt(path, sorted(rows), delimiter=",")


def events(path):
    """A log's sightings, each by a sensor that stands where its odometry says."""
    poses = {robot: (8.0 * robot - 16, -5.0, 0.3 * robot) for robot in range(ROBOTS)}
    for t, robot, dt, speed, turn, *sight in np.loadtxt(path, delimiter=",").tolist():
        pose = poses[robot] = rolled(poses[robot], speed, turn, dt)
        eye = range_bearing([0, 1], std=STD, origin=pose[:2], heading=pose[2])
        yield filters.Observation(t, int(robot), sight, eye, metadata=pose)


log = Path(tempfile.mkdtemp()) / "log.csv"
simulate(log, np.random.default_rng(0))
seen = list(events(log))
model = constant_velocity(sigma=0.03)
now = np.unique([event.t for event in seen])
team = ([None] * ROBOTS, graphs.ring(ROBOTS))
options = {"gate_probability": 0.999, "exchange_interval": 10.0}
fuse = partial(target_fusion, target_dim=4)
families = {
    "mixture": filters.MixtureFilter(
        model, *team, fusion=fuse, target_dim=4, **options
    ),
    "gaussian": filters.GaussianFilter(model, *team, lag=40, **options),
    "ensemble": filters.EnsembleFilter(model, *team, lag=40, members=100, **options),
    "news": filters.InformationIncrementFilter(model, *team, target_dim=4, **options),
}
print("filter    error/m  NEES/d  refused  floats")
for name, f in families.items():
    begin = f.start(
        (target(0.0), np.diag([4, 4, 0.1, 0.1])), rng=np.random.default_rng(1)
    )
    run = f.run(
        begin, None, seen, truth=dict(zip(model.names, target(now).T, strict=True))
    )
    late = run.sel(time=slice(20, None))
    error = np.sqrt(late["squared_error"][..., :2].sum("component").mean())
    refused, floats = (int(run[key].sum()) for key in ("rejected", "scalars"))
    print(
        f"{name:9s} {error:7.2f} {late['nees'].mean() / 4:7.2f} {refused:8d} {floats:7d}"
    )
