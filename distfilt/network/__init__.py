"""Networks of agents: graphs, channels with a ledger of messages, consensus and fusion."""

from . import graphs, weights
from .belief_propagation import gaussian_belief_propagation
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
from .events import event_triggered
from .faults import Faults
from .flood import flooding
from .fusion import (
    arithmetic_average,
    consensus_pull,
    covariance_intersection,
    intersect_ensembles,
    mean_pull,
    naive_fusion,
)
from .gossip import gossip_consensus
from .graphs import Graph
from .information import diffuse_means, information_consensus
from .ledger import Ledger
from .pairwise import (
    covariance_union,
    ellipsoidal_intersection,
    inverse_covariance_intersection,
    split_covariance_intersection,
)
from .pi_estimator import PIState, pi_start, pi_step, stable_substeps
from .trees import fuse_on_tree
from .weights import ConsensusWeights, UnstableGain

__all__ = [
    "AdmmResult",
    "Channel",
    "ConsensusWeights",
    "Disconnected",
    "Faults",
    "Graph",
    "Ledger",
    "PIState",
    "UnstableGain",
    "admm",
    "arithmetic_average",
    "average_consensus",
    "consensus_pull",
    "covariance_intersection",
    "covariance_union",
    "diffuse_means",
    "ellipsoidal_intersection",
    "event_triggered",
    "finite_time_consensus",
    "flooding",
    "fuse_on_tree",
    "fusion_rule",
    "gaussian_belief_propagation",
    "gossip_consensus",
    "graphs",
    "information_consensus",
    "intersect_ensembles",
    "inverse_covariance_intersection",
    "max_consensus",
    "mean_pull",
    "naive_fusion",
    "pi_start",
    "pi_step",
    "push_sum",
    "split_covariance_intersection",
    "stable_substeps",
    "weights",
]
