"""Models of motion: how a state moves from one time to the next, and how uncertain that is."""

from .attitude import angular_acceleration, attitude, satellite_pose
from .base import LinearModel, Model, simulate
from .integrators import rk4, rk4_jacobian
from .lorenz import lorenz63, lorenz63_rate
from .motion import constant_velocity, coordinated_turn
from .pendulum import (
    pendulum,
    pendulum_angle,
    pendulum_chart,
    pendulum_energy,
    pendulum_rate,
    pendulum_states,
)
from .rotations import (
    cross_matrix,
    left_directions,
    quaternion_rate,
    rotation_matrix,
    turn_between,
    turned,
)
from .satellite import clohessy_wiltshire, clohessy_wiltshire_drift, clohessy_wiltshire_transition
from .swarm import (
    READINGS,
    RotatingMixture,
    Swarm,
    mobility_and_diffusion,
    reflected,
    rotating_swarm,
)

__all__ = [  # fmt: skip
    "READINGS", "LinearModel", "Model", "RotatingMixture", "Swarm", "angular_acceleration",
    "attitude", "clohessy_wiltshire", "clohessy_wiltshire_drift", "clohessy_wiltshire_transition",
    "constant_velocity", "coordinated_turn", "cross_matrix", "left_directions", "lorenz63",
    "lorenz63_rate", "pendulum", "pendulum_angle", "pendulum_chart", "pendulum_energy",
    "pendulum_rate", "pendulum_states", "mobility_and_diffusion", "quaternion_rate", "reflected",
    "rk4", "rk4_jacobian", "rotating_swarm", "rotation_matrix", "satellite_pose", "simulate",
    "turn_between", "turned",
]
