"""Who hears whom, what a message costs, and how neighbours agree."""

from .channel import Channel
from .faults import Faults
from .graphs import Graph
from .ledger import Ledger
from .weights import Weights

__all__ = ["Channel", "Faults", "Graph", "Ledger", "Weights"]
