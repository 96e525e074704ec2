"""Filters: a model, sensors, an update and a network, put together on one contract."""

# First, where few calls are nested: from deep within, Python takes and returns memory all the time.
import scipy.linalg  # noqa: F401

from ..updates.particles import ParticleCollapse
from .base import Filter
from .density import DensityFilter, DensityState
from .ensemble import EnsembleFilter, TransportFilter
from .gaussian import GaussianFilter, GaussianState
from .inputs import Observation, prior_moments
from .mixture import MixtureFilter, MixtureState
from .news import InformationIncrementFilter, information_increment
from .particle import ParticleFilter
from .record import Summary, final_state
from .saving import SensorState, State
from .step import FilterError, Step

__all__ = [
    "DensityFilter",
    "DensityState",
    "EnsembleFilter",
    "Filter",
    "FilterError",
    "GaussianFilter",
    "GaussianState",
    "MixtureFilter",
    "MixtureState",
    "InformationIncrementFilter",
    "ParticleCollapse",
    "ParticleFilter",
    "Observation",
    "SensorState",
    "State",
    "Step",
    "Summary",
    "TransportFilter",
    "final_state",
    "information_increment",
    "prior_moments",
]
