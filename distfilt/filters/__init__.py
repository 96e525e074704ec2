"""Filters: a model, sensors, an update and a network, put together."""

from .ensemble import EnsembleFilter, EnsembleState, Late

__all__ = ["EnsembleFilter", "EnsembleState", "Late"]
