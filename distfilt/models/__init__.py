"""Models of motion: the transition of a state from one time to the next, and its noise."""

from . import orbit
from .agents import AgentModels
from .base import LinearModel, Model, simulate
from .inputs import InputModel, Inputs
from .motion import constant_velocity, lorenz63, rk4
from .orbit import occulted, orbits, rsw_frame
from .pendulum import (
    pendulum,
    pendulum_angle,
    pendulum_chart,
    pendulum_rate,
    pendulum_states,
)
from .planar import drive_poses, planar_odometry
from .quaternions import cross_matrix, quaternion_rate, rotation_matrix
from .satellite import clohessy_wiltshire, satellite_pose
from .swarm import RotatingMixture, Swarm, rotating_swarm

__all__ = [
    "AgentModels",
    "InputModel",
    "Inputs",
    "LinearModel",
    "Model",
    "RotatingMixture",
    "Swarm",
    "clohessy_wiltshire",
    "constant_velocity",
    "cross_matrix",
    "drive_poses",
    "lorenz63",
    "occulted",
    "orbit",
    "orbits",
    "pendulum",
    "pendulum_angle",
    "pendulum_chart",
    "pendulum_rate",
    "pendulum_states",
    "planar_odometry",
    "quaternion_rate",
    "rk4",
    "rotating_swarm",
    "rotation_matrix",
    "rsw_frame",
    "satellite_pose",
    "simulate",
]
