"""Who hears whom, what a message costs, and how neighbours agree."""

from . import graphs, weights
from .channel import Channel, fuses
from .consensus import AdmmRun, Disconnected, admm, average, finite_time, maximum, push_sum
from .dynamic import PIState, event_triggered, flood, gossip, pi_start, pi_step, stable_substeps
from .faults import Faults
from .fusion import (
    arithmetic_average,
    consensus_pull,
    covariance_intersection,
    intersection,
    naive_fusion,
    pull,
)
from .graphs import Graph
from .ledger import Ledger
from .weights import UnstableGain, Weights

__all__ = [  # fmt: skip
    "AdmmRun", "Channel", "Disconnected", "Faults", "Graph", "Ledger", "PIState", "UnstableGain",
    "Weights", "admm", "arithmetic_average", "average", "consensus_pull", "covariance_intersection",
    "event_triggered", "finite_time", "flood", "fuses", "gossip", "graphs",
    "intersection", "maximum", "naive_fusion", "pi_start", "pi_step", "pull", "push_sum",
    "stable_substeps", "weights",
]
