"""Filters: a model, sensors, an update and a network, put together."""

from .ensemble import EnsembleFilter, EnsembleState, Late
from .gaussian import GaussianFilter, GaussianState

__all__ = ["EnsembleFilter", "EnsembleState", "GaussianFilter", "GaussianState", "Late"]
