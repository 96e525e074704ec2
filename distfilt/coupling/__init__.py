"""Couplings of weighted and equally weighted members, and members that satisfy constraints."""

from .constraints import Constraint, norm_constraint, project, retract
from .solvers import TransportPlan, monotone_plan, squared_distances, transport_plan
from .transform import (
    correct_moments,
    rejuvenate,
    transform_along,
    transform_ensemble,
    transform_within,
    transport_plans,
)

__all__ = [
    "Constraint",
    "TransportPlan",
    "squared_distances",
    "transform_ensemble",
    "norm_constraint",
    "transport_plan",
    "transport_plans",
    "project",
    "rejuvenate",
    "retract",
    "correct_moments",
    "monotone_plan",
    "transform_along",
    "transform_within",
]
