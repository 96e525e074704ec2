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
        parts = tuple([_part(p, agent, runs, copy) for p in flat])
        if not parts:
            raise ValueError(f"payloads[{agent}]: needs arrays, or None to stay silent, got ()")
        silent = all([p.size and p.item(0) != p.item(0) and _missing(p) == p.size for p in parts])
        out.append(None if silent else parts if type(payload) is tuple else parts[0])
    return out


def _part(part: Any, agent: int, runs: tuple[int, ...], copy: bool) -> Part:
    plain = isinstance(part, np.ndarray) and not isinstance(part, np.ma.MaskedArray)
    if not plain or part.dtype.kind not in "biuf":
        got = f"dtype {part.dtype}" if plain else type(part).__name__
        needs = "an array of real numbers, a flat tuple of them or None"
        raise ValueError(f"payloads[{agent}]: needs {needs}, got {got}")
    if part.shape[: len(runs)] != runs:
        raise ValueError(f"payloads[{agent}]: needs leading axes {runs}, got shape {part.shape}")
    out = np.array(part) if copy else part.view(np.ndarray)
    out.flags.writeable = False
    return out


def _missing(part: Part, copies: int = 1) -> int:
    """How many of a payload's entries are NaN in all of so many copies, and so not sent."""
    if part.dtype.kind != "f" or not part.size:
        return 0
    least = np.minimum.reduce(part, axis=None)  # NaN if one is
    return 0 if least == least else int(np.isnan(part).reshape(copies, -1).all(axis=0).sum())


def sizes(sent: list[Payload | None], runs: tuple[int, ...]) -> tuple[Any, Any]:
    """Scalars and bytes of each agent's payload in one run; what is missing in all is not sent."""
    copies = math.prod(runs)
    counts = []
    for payload in sent:
        parts = payload if isinstance(payload, tuple) else () if payload is None else (payload,)
        here = [(p.size // copies - _missing(p, copies), p.itemsize) for p in parts]
        counts.append((sum([n for n, _ in here]), sum([n * size for n, size in here])))
    scalars, bytes_ = np.array(counts).T
    return scalars, bytes_


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
