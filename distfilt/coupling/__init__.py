"""Couplings: plans that turn weights into equally weighted members, and members that obey rules."""

from .constraints import READINGS, Constraint, norm, project, retract
from .rules import accepted, augmented_readings, clip
from .sampling import transform_along, transform_within
from .solvers import SOLVERS, Plan, distances, plan, sorted_plan
from .transform import ensemble_transform, plans, rejuvenated, second_order

__all__ = [  # fmt: skip
    "READINGS", "SOLVERS", "Constraint", "Plan", "accepted", "augmented_readings", "clip",
    "distances", "ensemble_transform", "norm", "plan", "plans", "project", "rejuvenated", "retract",
    "second_order", "sorted_plan", "transform_along", "transform_within",
]
