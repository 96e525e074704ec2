"""The account of what agents sent, and what may be sent: numeric arrays, or flat tuples of them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

from ..validation import (
    Array,
    FrozenModel,
    Mask,
    NonNegativeInt,
    PositiveInt,
    validated,
)

__all__ = ["Ledger"]

Counts = NDArray[np.int64]
Part = NDArray[Any]
Payload = Part | tuple[Part, ...]


@dataclass(frozen=True, eq=False)
class Ledger(FrozenModel):
    """What the agents sent: the cost of a distributed method.

    A message is one payload on one link, also when it is lost. A batch of independent runs counts
    once: each run is a network of its own.

    Parameters
    ----------
    rounds : int
        Rounds of communication; without any link there is none.
    messages, scalars, bytes : ndarray of int, (A,)
        Sent by each agent, acknowledgements included.
    lost : ndarray, (A,)
        How many of each agent's messages did not arrive; the mean over a batch's runs.

    Examples
    --------
    >>> Ledger.empty(2)
    Ledger(rounds=0, messages=0, scalars=0, bytes=0, lost=0)
    """

    rounds: NonNegativeInt
    messages: Annotated[Counts, "A"]
    scalars: Annotated[Counts, "A"]
    bytes: Annotated[Counts, "A"]
    lost: Annotated[Array, "A"]

    @classmethod
    @validated
    def empty(cls, agents: PositiveInt) -> Ledger:
        """A ledger of `agents` agents that have not spoken.

        >>> Ledger.empty(0)
        Traceback (most recent call last):
        ValueError: agents must be at least 1, got 0
        """
        zero = np.zeros(agents, dtype=np.int64)
        return cls.construct(0, zero, zero, zero, np.zeros(agents))

    def __repr__(self) -> str:
        names = ("messages", "scalars", "bytes", "lost")
        totals = ", ".join(f"{name}={getattr(self, name).sum():g}" for name in names)
        return f"Ledger(rounds={self.rounds}, {totals})"


def count_payload(
    payloads: Any, agents: int, runs: tuple[int, ...]
) -> tuple[list[Payload | None], Counts, Counts]:
    """Each agent's payload as read-only copies, None where it is silent, its scalars and bytes.

    What is NaN in all runs is not sent, and a payload that holds nothing else is silence too.
    """
    if not isinstance(payloads, Sequence | np.ndarray) or len(payloads) != agents:
        got = len(payloads) if hasattr(payloads, "__len__") else type(payloads).__name__
        raise ValueError(
            f"payloads must be a list, one for each agent ({agents}), got {got}"
        )
    copies = math.prod(runs)
    sent: list[Payload | None] = [None] * agents
    scalars = [0] * agents
    bytes_ = [0] * agents
    for agent, payload in enumerate(payloads):
        if payload is None:
            continue
        several = type(payload) is tuple
        parts = [_part(p, agent, runs) for p in (payload if several else (payload,))]
        if not parts:
            raise ValueError(
                f"payloads[{agent}] must have arrays, or None to stay silent, got ()"
            )
        silent = True
        for part in parts:
            here = _present(part, copies)
            scalars[agent] += here
            bytes_[agent] += here * part.itemsize
            silent = silent and here == 0 and part.size > 0
        if not silent:
            sent[agent] = tuple(parts) if several else parts[0]
    return sent, np.array(scalars), np.array(bytes_)


def _part(part: Any, agent: int, runs: tuple[int, ...]) -> Part:
    plain = isinstance(part, np.ndarray) and not isinstance(part, np.ma.MaskedArray)
    if not plain or part.dtype.kind not in "biuf":
        got = f"dtype {part.dtype}" if plain else type(part).__name__
        needs = "an array of real numbers, a flat tuple of them or None"
        raise ValueError(f"payloads[{agent}] must be {needs}, got {got}")
    if part.shape[: len(runs)] != runs:
        raise ValueError(
            f"payloads[{agent}] must have leading axes {runs}, got shape {part.shape}"
        )
    out: Part = np.array(part)  # what was sent does not change any more
    out.flags.writeable = False
    return out


def _present(part: Part, copies: int) -> int:
    """How many entries of one copy are not NaN in all copies."""
    # A sum of squares is NaN only if an entry is, and takes half as long as looking for the least.
    if part.dtype.kind != "f" or not math.isnan(np.vdot(part, part)):
        return part.size // copies
    return int((~np.isnan(part)).reshape(copies, -1).any(axis=0).sum())


def drop_lost(payload: Any, arrived: Mask) -> Any:
    """Read-only copies with NaN in the runs that lost the message."""
    if isinstance(payload, tuple):
        return tuple([drop_lost(part, arrived) for part in payload])
    gone = ~arrived.reshape(arrived.shape + (1,) * (payload.ndim - arrived.ndim))
    out = np.where(gone, np.nan, payload)
    out.flags.writeable = False
    return out
