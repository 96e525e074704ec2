"""Models of motion: how a state moves from one time to the next, and how uncertain that is."""

from . import orbit
from .base import LinearModel, Model, simulate
from .integrators import rk4
from .motion import constant_velocity, lorenz63
from .orbit import occulted, orbits, rsw_frame
from .pendulum import (
    pendulum,
    pendulum_angle,
    pendulum_chart,
    pendulum_energy,
    pendulum_rate,
    pendulum_states,
)
from .rotations import cross_matrix, quaternion_rate, rotation_matrix
from .satellite import clohessy_wiltshire, satellite_pose
from .swarm import READINGS, RotatingMixture, Swarm, rotating_swarm

__all__ = [  # fmt: skip
    "READINGS", "LinearModel", "Model", "RotatingMixture", "Swarm", "clohessy_wiltshire",
    "constant_velocity", "cross_matrix", "lorenz63", "occulted", "orbit", "orbits", "pendulum",
    "pendulum_angle", "pendulum_chart", "pendulum_energy", "pendulum_rate", "pendulum_states",
    "quaternion_rate", "rk4", "rotating_swarm", "rotation_matrix", "rsw_frame", "satellite_pose",
    "simulate",
]
