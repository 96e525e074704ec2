"""Couplings: plans that turn weights into equally weighted members, and members that obey rules."""

from .constraints import Constraint, norm, project, retract
from .solvers import Plan, distances, plan, sorted_plan
from .transform import (
    ensemble_transform,
    plans,
    rejuvenated,
    second_order,
    transform_along,
    transform_within,
)

__all__ = [  # fmt: skip
    "Constraint", "Plan", "distances", "ensemble_transform", "norm", "plan", "plans", "project",
    "rejuvenated", "retract", "second_order", "sorted_plan", "transform_along", "transform_within",
]
