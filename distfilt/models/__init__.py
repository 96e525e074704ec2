"""Models of motion: how a state moves from one time to the next, and how uncertain that is."""

from . import orbit
from .attitude import angular_acceleration, attitude, satellite_pose
from .base import LinearModel, Model, simulate
from .integrators import rk4, rk4_jacobian
from .lorenz import lorenz63, lorenz63_rate
from .motion import constant_velocity, coordinated_turn
from .orbit import occulted, orbits, propagate, rsw_frame
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
    "lorenz63_rate", "mobility_and_diffusion", "occulted", "orbit", "orbits", "pendulum",
    "pendulum_angle", "pendulum_chart", "pendulum_energy", "pendulum_rate", "pendulum_states",
    "propagate", "quaternion_rate", "reflected", "rk4", "rk4_jacobian", "rotating_swarm",
    "rotation_matrix", "rsw_frame", "satellite_pose", "simulate", "turn_between", "turned",
]
