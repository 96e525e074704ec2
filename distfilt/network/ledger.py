"""The account of what agents sent: rounds, messages, scalars and bytes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..checks import Array, count

__all__ = ["Ledger"]

Counts = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Ledger:
    """What the agents sent: the cost of a distributed method.

    A message is one payload on one link, also when it is lost. A batch of independent runs counts
    once: each run is a network of its own.

    Parameters
    ----------
    rounds : int
        Rounds of communication.
    messages, scalars, bytes : ndarray of int, (A,)
        Sent by each agent, acknowledgements included.
    lost : ndarray, (A,)
        How many of each agent's messages did not arrive; the mean over a batch's runs.

    Examples
    --------
    >>> Ledger.empty(2)
    Ledger(rounds=0, messages=0, scalars=0, bytes=0, lost=0)
    """

    rounds: int
    messages: Counts
    scalars: Counts
    bytes: Counts
    lost: Array

    @classmethod
    def empty(cls, agents: int) -> Ledger:
        """A ledger of `agents` agents that have not spoken."""
        zero = np.zeros(count(agents, "agents"), dtype=np.int64)
        return cls(0, zero, zero, zero, np.zeros(zero.size))

    def charge(
        self, messages: Counts, scalars: int | Counts, bytes_: int | Counts, *,
        lost: Array | float = 0.0, rounds: int = 1,
    ) -> Ledger:
        """The ledger after more rounds.

        Parameters
        ----------
        messages : ndarray of int, (A,)
            Sent by each agent.
        scalars, bytes_ : int or ndarray of int, (A,)
            In each of these messages.
        lost : ndarray, (A,)
            How many of them did not arrive.
        rounds : int
            How many rounds this was.
        """
        return Ledger(
            self.rounds + rounds, self.messages + messages, self.scalars + messages * scalars,
            self.bytes + messages * bytes_, self.lost + lost,
        )

    def __repr__(self) -> str:
        names = ("messages", "scalars", "bytes", "lost")
        totals = ", ".join(f"{name}={getattr(self, name).sum():g}" for name in names)
        return f"Ledger(rounds={self.rounds}, {totals})"
