"""Five robots estimate their poses and track a sixth, with contact every ten seconds."""

import tempfile
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from distfilt import filters
from distfilt.mixtures import target_fusion
from distfilt.models import Inputs, Model, constant_velocity
from distfilt.network import graphs
from distfilt.sensors import range_bearing

STD = (0.3, 0.04)  # of range, in m, and bearing, in rad
ODOMETRY_STD = (0.05, 0.01)  # of speed, in m/s, and turn rate, in rad/s, for a second
START_STD = (0.1, 0.1, 0.02)  # of the first poses
RATE = 0.4  # sightings of a robot a second
END = 60.0
ROBOTS = 5
TARGET = constant_velocity(sigma=0.03)


def target(t: Any) -> np.ndarray:
    """Position and velocity of the sixth robot: a wide arc."""
    angle = np.asarray(t) / 40
    c = np.cos(angle)
    s = np.sin(angle)
    arc: np.ndarray = np.stack([s, 1 - c, c, s], axis=-1)
    return arc * [20, 20, 0.5, 0.5]


def first_poses() -> np.ndarray:
    """Where the robots start: x, y and heading, (5, 3)."""
    robot = np.arange(ROBOTS)
    return np.stack([8.0 * robot - 16, np.full(ROBOTS, -5.0), 0.3 * robot], axis=-1)


def drive(poses: np.ndarray, inputs: np.ndarray, dt: float) -> np.ndarray:
    """Move poses (..., 5, 3) by speeds and turn rates (5, 2)."""
    speed, turn = inputs.T
    heading = poses[..., 2] + dt * turn / 2
    shift = [
        speed * np.cos(heading),
        speed * np.sin(heading),
        np.broadcast_to(turn, heading.shape),
    ]
    return np.asarray(poses + dt * np.stack(shift, axis=-1))


def simulate(folder: Path, rng: np.random.Generator) -> np.ndarray:
    """Write odometry and sightings, of which one in twenty is an outlier; return the poses.

    The poses, (61, 5, 3), are for scores.
    """
    sensors = [sensor_of(robot) for robot in range(ROBOTS)]
    poses = [first_poses() + START_STD * rng.standard_normal((ROBOTS, 3))]
    odometry = []
    sightings = []
    for t in np.arange(END):
        turn = 0.05 * np.sin(t / 10 + np.arange(ROBOTS))
        inputs = np.stack([np.full(ROBOTS, 0.4), turn], axis=-1)
        errors = ODOMETRY_STD * rng.standard_normal((ROBOTS, 2))
        odometry.append([t, *(inputs + errors).ravel()])
        for robot in range(ROBOTS):
            for after in rng.random(rng.poisson(RATE)):
                now = drive(poses[-1], inputs, after)
                state = np.append(target(t + after), now)
                seen = sensors[robot].observe(state, rng=rng)
                outlier = 8.0 * (rng.random() < 0.05)
                sightings.append([t + after, robot, *(seen + outlier)])
        poses.append(drive(poses[-1], inputs, 1.0))
    np.savetxt(folder / "odometry.csv", odometry, delimiter=",")
    np.savetxt(folder / "sightings.csv", sorted(sightings), delimiter=",")
    return np.array(poses)


def sensor_of(robot: int) -> Any:
    """The range-bearing sensor of a robot, whose pose is a part of the state."""
    first = 4 + 3 * robot
    return range_bearing((0, 1), std=STD, observer=range(first, first + 3))


def move(x: np.ndarray, t: float, dt: float, odometry: Inputs) -> np.ndarray:
    """Move states (..., 19): the target, then the poses by their odometry."""
    poses = x[..., 4:].reshape(*x.shape[:-1], ROBOTS, 3)
    for _, length, inputs in odometry.pieces(t, dt):
        poses = drive(poses, inputs.reshape(ROBOTS, 2), length)
    moved = x[..., :4] @ TARGET.F(dt).T
    return np.concatenate([moved, poses.reshape(*x.shape[:-1], -1)], axis=-1)


def noise_cov(t: float, dt: float) -> np.ndarray:
    """Process noise: of the target's velocity, and of the odometry."""
    cov = np.zeros((4 + 3 * ROBOTS, 4 + 3 * ROBOTS))
    cov[:4, :4] = TARGET.Q(t, dt)
    speed, turn = np.square(ODOMETRY_STD)
    cov[4:, 4:] = dt * np.diag([speed, speed, turn] * ROBOTS)
    return cov


log = Path(tempfile.mkdtemp())
true_poses = simulate(log, np.random.default_rng(0))
odometry = np.loadtxt(log / "odometry.csv", delimiter=",")
inputs = Inputs(odometry[:, 0], odometry[:, 1:], np.zeros((10, 10)))
names = [*TARGET.names]
names += [f"{part}{robot}" for robot in range(ROBOTS) for part in ("x", "y", "heading")]
model = Model(
    len(names),
    partial(move, odometry=inputs),
    noise_cov,
    names=tuple(names),
    periods={name: 2 * np.pi for name in names if "heading" in name},
)
observations = [
    filters.Observation(t, int(robot), seen)
    for t, robot, *seen in np.loadtxt(log / "sightings.csv", delimiter=",").tolist()
]
times = np.unique([observation.t for observation in observations])
truth = dict(zip(TARGET.names, target(times).T, strict=True))
mean = np.append(target(0.0), first_poses())
cov = np.diag([4, 4, 0.1, 0.1, *np.tile(np.square(START_STD), ROBOTS)])

# Outliers are gated; messages are exchanged every ten seconds only.
sensors = [sensor_of(robot) for robot in range(ROBOTS)]
ring = graphs.ring(ROBOTS)
options: dict[str, Any] = {"gate_probability": 0.999, "exchange_interval": 10.0}
fuse = partial(target_fusion, target_dim=4)
families: dict[str, Any] = {
    "mixture": filters.MixtureFilter(
        model, sensors, ring, fusion=fuse, target_dim=4, n_components=1, **options
    ),
    "gaussian": filters.GaussianFilter(model, sensors, ring, lag=30, **options),
    "ensemble": filters.EnsembleFilter(
        model, sensors, ring, lag=30, members=200, **options
    ),
    "increment": filters.InformationIncrementFilter(
        model, sensors, ring, target_dim=4, **options
    ),
}
print("filter    error/m  NEES/d  rejected  floats")
for name, f in families.items():
    state = f.start((mean, cov), rng=np.random.default_rng(1))
    run = f.run(state, None, observations, truth=truth)
    late = run.sel(time=slice(10, None))
    squared = late["squared_error"].sel(component=list(TARGET.names[:2]))
    error = np.sqrt(squared.sum("component", skipna=False).mean())
    nees = late["nees"].mean() / 4
    rejected = int(run["rejected"].sum())
    floats = int(run["scalars"].sum())
    print(f"{name:9s} {error:7.2f} {nees:7.2f} {rejected:9d} {floats:7d}")
