"""Filters: a model, sensors, an update and a network, put together on one contract."""

# First, where few calls are nested: from deep within, Python takes and returns memory all the time.
import scipy.linalg  # noqa: F401

from ..updates.particles import ParticleCollapse
from .base import Filter, SensorFilter
from .consensus import InformationConsensusFilter
from .density import DensityFilter, DensityState
from .ensemble import EnsembleFilter, TransportFilter
from .failures import FilterError
from .gaussian import GaussianFilter, GaussianState
from .grid import GridFilter, GridState
from .increments import InformationIncrementFilter, information_increment
from .likelihood import LikelihoodConsensusFilter, PolynomialBasis
from .mixture import MixtureFilter, MixtureState
from .observations import Observation
from .options import (
    ExchangesAtIntervals,
    FusesBeliefs,
    IsolatesRuns,
    KeepsPast,
    ScoresObservations,
    SharesObservations,
)
from .particle import ParticleFilter
from .priors import prior_moments
from .record import Summary, final_state
from .states import SensorState, State
from .step import Step
from .sum import GaussianSumFilter, GaussianSumState
from .tree import ChannelFilter, ChannelFilterState

__all__ = [
    "ChannelFilter",
    "ChannelFilterState",
    "DensityFilter",
    "DensityState",
    "EnsembleFilter",
    "ExchangesAtIntervals",
    "Filter",
    "FilterError",
    "FusesBeliefs",
    "GaussianFilter",
    "GaussianState",
    "GaussianSumFilter",
    "GaussianSumState",
    "LikelihoodConsensusFilter",
    "MixtureFilter",
    "MixtureState",
    "GridFilter",
    "GridState",
    "InformationConsensusFilter",
    "InformationIncrementFilter",
    "IsolatesRuns",
    "KeepsPast",
    "ParticleCollapse",
    "ParticleFilter",
    "PolynomialBasis",
    "Observation",
    "ScoresObservations",
    "SensorFilter",
    "SensorState",
    "SharesObservations",
    "State",
    "Step",
    "Summary",
    "TransportFilter",
    "final_state",
    "information_increment",
    "prior_moments",
]
