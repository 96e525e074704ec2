"""What goes wrong on the way: messages lost or late, agents silent."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..checks import Array, array, count, number
from .graphs import Graph

__all__ = ["Faults"]

_GOLDEN = 0x9E3779B97F4A7C15


@dataclass(frozen=True)
class Faults:
    """How a channel fails.

    Parameters
    ----------
    loss : float or array_like, (A,)
        Probability that a message is lost, in [0, 1]; an array gives one for each receiver.
    seed : int
        Of the losses. Whether a message is lost is a function of seed, run, round and link alone,
        so that every agent, or every process of a real network, can compute it, and no draw
        depends on what was drawn before.
    symmetric : bool
        A link fails both ways at once.
    delay : int
        Rounds that a message takes on top of its own.
    silent : collection of int
        Agents whose radio is off: they neither send nor hear.

    Examples
    --------
    >>> Faults(loss=0.2, seed=7).lost(Graph.from_adjacency([[0, 1], [1, 0]]), 0, 5).shape
    (5, 2)
    """

    loss: float | Array = 0.0
    seed: int = 0
    symmetric: bool = False
    delay: int = 0
    silent: Collection[int] = ()

    def __post_init__(self) -> None:
        if np.ndim(self.loss) == 0:
            number(self.loss, "loss", at_least=0, at_most=1)
        else:
            rates = array(self.loss, "loss", ("A",))
            if rates.min(initial=0) < 0 or rates.max(initial=0) > 1:
                raise ValueError(f"loss: needs probabilities in [0, 1], got {rates.tolist()}")
        count(self.seed, "seed", at_least=0)
        count(self.delay, "delay", at_least=0)
        object.__setattr__(self, "silent", tuple(count(a, "silent", at_least=0)
                                                 for a in self.silent))

    def check(self, graph: Graph) -> None:
        """Refuse a graph whose agents do not fit."""
        if np.ndim(self.loss) == 1 and np.size(self.loss) != graph.size:
            raise ValueError(f"loss: needs one per agent ({graph.size}), got {np.size(self.loss)}")
        if self.silent and max(self.silent) >= graph.size:
            raise ValueError(f"silent: needs agents below {graph.size}, got {max(self.silent)}")

    @property
    def none(self) -> bool:
        """Whether nothing fails."""
        return not np.any(self.loss) and not self.delay and not self.silent

    def speaking(self, graph: Graph) -> NDArray[np.bool_]:
        """Links whose both ends have their radio on, (E,)."""
        off = np.zeros(graph.size, dtype=bool)
        off[list(self.silent)] = True
        return ~(off[graph.receivers] | off[graph.senders])

    def lost(self, graph: Graph, round_: int, runs: int) -> NDArray[np.bool_]:
        """Which links lose the message of round `round_` in each of `runs` runs, (runs, E)."""
        if not np.any(self.loss):
            return np.zeros((runs, graph.senders.size), dtype=bool)
        i, j = graph.receivers, graph.senders
        ends = (np.minimum(i, j), np.maximum(i, j)) if self.symmetric else (i, j)
        link = (ends[0] * graph.size + ends[1]).astype(np.uint64)
        key = (self.seed + _GOLDEN * (round_ + 1)) % 2**64
        run = _mixed(_mixed(key) ^ (np.arange(runs, dtype=np.uint64) * np.uint64(_GOLDEN)))
        bits = _mixed(run[:, None] ^ _mixed(link + np.uint64(_GOLDEN)))
        rate = self.loss if np.ndim(self.loss) == 0 else np.asarray(self.loss)[i]
        return np.asarray((bits >> np.uint64(11)).astype(np.float64) * 2.0**-53 < rate)


def _mixed(bits: NDArray[np.uint64] | int) -> NDArray[np.uint64]:
    """The finaliser of splitmix64: every output bit depends on every input bit."""
    # Arrays, not scalars: their products wrap around silently, as they should here.
    z = np.atleast_1d(np.asarray(bits, dtype=np.uint64))
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return np.asarray(z ^ (z >> np.uint64(31)))
