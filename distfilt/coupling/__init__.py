"""Couplings: plans that turn weights into equally weighted members, and members that obey rules."""

from .constraints import Constraint, norm_constraint, project, retract
from .solvers import TransportPlan, squared_distances, transport_plan, sorted_plan
from .transform import (
    transform_ensemble,
    transport_plans,
    rejuvenate,
    second_order,
    transform_along,
    transform_within,
)

__all__ = [  # fmt: skip
    "Constraint", "TransportPlan", "squared_distances", "transform_ensemble", "norm_constraint", "transport_plan", "transport_plans", "project",
    "rejuvenate", "retract", "second_order", "sorted_plan", "transform_along", "transform_within",
]
