"""Filters: a model, sensors, an update and a network, put together on one contract."""

from .density import DensityFilter, DensityState
from .driver import Filter, Late, Summary, final_state
from .ensemble import EnsembleFilter, EnsembleState
from .failures import FilterError
from .gaussian import GaussianFilter, GaussianState
from .mixture import MixtureFilter, MixtureState
from .news import NewsFilter, increment
from .particle import ParticleCollapse, ParticleFilter, ParticleState
from .saving import State
from .stepping import SensorState, Step
from .transport import TransportFilter
from .wiring import SensorFilter

__all__ = [  # fmt: skip
    "DensityFilter", "DensityState", "EnsembleFilter", "EnsembleState", "Filter", "FilterError",
    "GaussianFilter", "GaussianState", "Late", "MixtureFilter", "MixtureState", "NewsFilter",
    "ParticleCollapse", "ParticleFilter", "ParticleState", "SensorFilter", "SensorState", "State",
    "Step", "Summary", "TransportFilter", "final_state", "increment",
]
