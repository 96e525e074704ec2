"""The communication ledger: what each agent has sent, by link and by broadcast."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from ..validation import (
    Array,
    FrozenModel,
    NonNegativeInt,
    PositiveInt,
    validated,
)

__all__ = ["Ledger"]

Counts = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Ledger(FrozenModel):
    """Counts of all that the agents sent: the cost of a distributed method.

    There are two bills. By link, a message is one payload on one link, also if it is
    lost, as over cables or directed radio links. By broadcast, one transmission reaches
    all receivers of an agent. A batch of independent runs counts once: each run is a
    network of its own.

    Parameters
    ----------
    rounds : int
        Rounds of communication; a graph without links has none.
    messages, scalars, bytes : ndarray of int, (A,)
        Sent by each agent over its links, acknowledgements included.
    lost : ndarray, (A,)
        Number of each agent's messages that did not arrive; the mean over a batch's
        runs.
    transmissions, broadcast_scalars, broadcast_bytes : ndarray of int, (A,)
        The same bill if one transmission reaches all receivers: only messages that
        differ between an agent's links are transmissions of their own.

    Examples
    --------
    >>> Ledger.empty(2)
    Ledger(rounds=0, messages=0, scalars=0, bytes=0, lost=0)

    Agent 0 of a star has three receivers:

    >>> from distfilt.network import Channel, graphs
    >>> channel = Channel(graphs.star(4))
    >>> _ = channel.broadcast([np.zeros(2), None, None, None])
    >>> channel.ledger.scalars, channel.ledger.broadcast_scalars
    (array([6, 0, 0, 0]), array([2, 0, 0, 0]))
    """

    rounds: NonNegativeInt
    messages: Annotated[Counts, "A"]
    scalars: Annotated[Counts, "A"]
    bytes: Annotated[Counts, "A"]
    lost: Annotated[Array, "A"]
    transmissions: Annotated[Counts, "A"]
    broadcast_scalars: Annotated[Counts, "A"]
    broadcast_bytes: Annotated[Counts, "A"]

    @classmethod
    @validated
    def empty(cls, agents: PositiveInt) -> Ledger:
        """Return a ledger of `agents` agents that have sent nothing.

        >>> Ledger.empty(0)
        Traceback (most recent call last):
        ValueError: agents must be at least 1, got 0
        """
        zeros = np.zeros(agents, dtype=np.int64)
        return cls.construct(
            rounds=0,
            messages=zeros,
            scalars=zeros,
            bytes=zeros,
            lost=np.zeros(agents),
            transmissions=zeros,
            broadcast_scalars=zeros,
            broadcast_bytes=zeros,
        )

    def __repr__(self) -> str:
        names = ("messages", "scalars", "bytes", "lost")
        totals = ", ".join(f"{name}={getattr(self, name).sum():g}" for name in names)
        return f"Ledger(rounds={self.rounds}, {totals})"
