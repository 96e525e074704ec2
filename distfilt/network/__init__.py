"""Who hears whom, what a message costs, and how neighbours agree."""

from . import graphs, weights
from .channel import Channel, fusion_rule
from .consensus import (
    AdmmResult,
    Disconnected,
    admm,
    average_consensus,
    finite_time_consensus,
    max_consensus,
    push_sum,
)
from .dynamic import (
    PIState,
    event_triggered,
    flooding,
    gossip_consensus,
    pi_start,
    pi_step,
    stable_substeps,
)
from .faults import Faults
from .fusion import (
    arithmetic_average,
    consensus_pull,
    covariance_intersection,
    intersect_ensembles,
    mean_pull,
    naive_fusion,
)
from .graphs import Graph
from .ledger import Ledger
from .weights import ConsensusWeights, UnstableGain

__all__ = [
    "AdmmResult",
    "Channel",
    "Disconnected",
    "Faults",
    "Graph",
    "Ledger",
    "PIState",
    "UnstableGain",
    "ConsensusWeights",
    "admm",
    "arithmetic_average",
    "average_consensus",
    "consensus_pull",
    "covariance_intersection",
    "event_triggered",
    "finite_time_consensus",
    "flooding",
    "fusion_rule",
    "gossip_consensus",
    "graphs",
    "intersect_ensembles",
    "max_consensus",
    "naive_fusion",
    "pi_start",
    "pi_step",
    "mean_pull",
    "push_sum",
    "stable_substeps",
    "weights",
]
