"""Filters: a model, sensors, an update and a network, put together on one contract."""

from .base import Filter
from .density import DensityFilter, DensityState
from .ensemble import EnsembleFilter, EnsembleState, TransportFilter
from .gaussian import GaussianFilter, GaussianState
from .inputs import Late, Reading, moments_of
from .mixture import MixtureFilter, MixtureState
from .news import NewsFilter, increment
from .particle import ParticleCollapse, ParticleFilter
from .record import Summary
from .saving import SensorState, State
from .step import FilterError, Step

__all__ = [  # fmt: skip
    "DensityFilter", "DensityState", "EnsembleFilter", "EnsembleState", "Filter", "FilterError",
    "GaussianFilter", "GaussianState", "Late", "MixtureFilter", "MixtureState", "NewsFilter",
    "ParticleCollapse", "ParticleFilter", "Reading", "SensorState", "State", "Step", "Summary",
    "TransportFilter", "increment", "moments_of",
]
