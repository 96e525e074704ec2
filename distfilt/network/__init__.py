"""Who hears whom, what a message costs, and how neighbours agree."""

from .channel import Channel, Ledger
from .graphs import Graph

__all__ = ["Channel", "Graph", "Ledger"]
