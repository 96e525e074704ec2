"""Who hears whom, what a message costs, and how neighbours agree."""

from . import graphs, weights
from .admm import AdmmRun, admm
from .agreement import barycentre, intersection, pull
from .asynchronous import event_triggered, flood, gossip
from .channel import Channel
from .consensus import (
    UnstableGain,
    average,
    finite_time,
    fused_kind,
    fuses,
    maximum,
    push_sum,
)
from .faults import Faults
from .fusion import (
    arithmetic_average,
    consensus_pull,
    covariance_intersection,
    naive_fusion,
)
from .ledger import Ledger
from .links import Graph
from .tracking import PIState, first_order, pi_start, pi_step, stable_substeps
from .weights import Weights

__all__ = [  # fmt: skip
    "AdmmRun", "Channel", "Faults", "Graph", "Ledger", "PIState", "UnstableGain", "Weights", "admm",
    "arithmetic_average", "average", "barycentre", "consensus_pull", "covariance_intersection",
    "event_triggered", "finite_time", "first_order", "flood", "fused_kind", "fuses", "gossip",
    "graphs", "intersection", "maximum", "naive_fusion", "pi_start", "pi_step", "pull", "push_sum",
    "stable_substeps", "weights",
]
