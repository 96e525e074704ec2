"""The account of what agents sent, and what may be sent: numeric arrays, or flat tuples of them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

from ..doors import Array, Count, Index, Record, door

__all__ = ["Ledger"]

Counts = NDArray[np.int64]
Part = NDArray[Any]
Payload = Part | tuple[Part, ...]
Mask = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Ledger(Record):
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

    rounds: Index
    messages: Annotated[Counts, "A"]
    scalars: Annotated[Counts, "A"]
    bytes: Annotated[Counts, "A"]
    lost: Annotated[Array, "A"]

    @classmethod
    @door
    def empty(cls, agents: Count) -> Ledger:
        """A ledger of `agents` agents that have not spoken."""
        zero = np.zeros(agents, dtype=np.int64)
        return cls.unchecked(0, zero, zero, zero, np.zeros(agents))

    def __repr__(self) -> str:
        names = ("messages", "scalars", "bytes", "lost")
        totals = ", ".join(f"{name}={getattr(self, name).sum():g}" for name in names)
        return f"Ledger(rounds={self.rounds}, {totals})"


def taken(
    payloads: Any, agents: int, runs: tuple[int, ...], *, copy: bool
) -> list[tuple[Part, ...] | Part | None]:
    """Each agent's payload as read-only arrays; None where it is silent.

    A payload that holds nothing but NaN says nothing, and is silence too. With `copy` the arrays
    are the channel's own, for messages that arrive later.
    """
    if not isinstance(payloads, Sequence | np.ndarray) or len(payloads) != agents:
        got = len(payloads) if hasattr(payloads, "__len__") else type(payloads).__name__
        raise ValueError(f"payloads: needs a list, one for each agent ({agents}), got {got}")
    out: list[Payload | None] = []
    for agent, payload in enumerate(payloads):
        if payload is None:
            out.append(None)
            continue
        flat = payload if type(payload) is tuple else (payload,)
        parts = tuple([_part(p, f"payloads[{agent}]", runs, copy) for p in flat])
        if not parts:
            raise ValueError(f"payloads[{agent}]: needs arrays, or None to stay silent, got ()")
        silent = all([p.size > 0 and _missing(p, 1) == p.size for p in parts])
        out.append(None if silent else parts if type(payload) is tuple else parts[0])
    return out


def _part(part: Any, name: str, runs: tuple[int, ...], copy: bool) -> Part:
    if not isinstance(part, np.ndarray) or isinstance(part, np.ma.MaskedArray):
        raise ValueError(
            f"{name}: needs a numeric array, a flat tuple of them or None, "
            f"got {type(part).__name__}"
        )
    if part.dtype.kind not in "biuf":
        raise ValueError(
            f"{name}: needs booleans, integers or real numbers, got dtype {part.dtype}"
        )
    if part.shape[: len(runs)] != runs:
        raise ValueError(f"{name}: needs leading axes {runs}, got shape {part.shape}")
    out = np.array(part) if copy else part.view(np.ndarray)
    out.flags.writeable = False
    return out


def _missing(part: Part, copies: int) -> int:
    """How many of a payload's entries are NaN in all of so many copies, and so not sent."""
    if part.dtype.kind != "f":
        return 0
    gone = np.isnan(part)
    return int(gone.reshape(copies, -1).all(axis=0).sum()) if gone.any() else 0


def sizes(sent: list[Payload | None], runs: tuple[int, ...]) -> tuple[Any, Any]:
    """Scalars and bytes of each agent's payload in one run; what is missing in all is not sent."""
    copies = math.prod(runs)
    parts = [() if p is None else p if isinstance(p, tuple) else (p,) for p in sent]
    counts = [[(a.size // copies - _missing(a, copies), a.itemsize) for a in p] for p in parts]
    scalars = [sum([n for n, _ in c]) for c in counts]
    return np.array(scalars), np.array([sum([n * size for n, size in c]) for c in counts])


def thinned(payload: Payload, arrived: Mask) -> Payload:
    """Read-only copies with NaN in the runs that lost the message."""
    if isinstance(payload, tuple):
        return tuple(_thinned(part, arrived) for part in payload)
    return _thinned(payload, arrived)


def _thinned(part: Part, arrived: Mask) -> Part:
    gone = ~arrived.reshape(arrived.shape + (1,) * (part.ndim - arrived.ndim))
    out = np.where(gone, np.nan, part)
    out.flags.writeable = False
    return out
