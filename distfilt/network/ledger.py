"""The communication ledger, and payloads: numeric arrays, or flat tuples of them."""

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
    InvalidArgumentError,
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
    """Counts of all that the agents sent: the cost of a distributed method.

    A message is one payload on one link, also if it is lost. A batch of independent
    runs counts once: each run is a network of its own.

    Parameters
    ----------
    rounds : int
        Rounds of communication; a graph without links has none.
    messages, scalars, bytes : ndarray of int, (A,)
        Sent by each agent, acknowledgements included.
    lost : ndarray, (A,)
        Number of each agent's messages that did not arrive; the mean over a batch's
        runs.

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
        """Return a ledger of `agents` agents that have sent nothing.

        >>> Ledger.empty(0)
        Traceback (most recent call last):
        ValueError: agents must be at least 1, got 0
        """
        zeros = np.zeros(agents, dtype=np.int64)
        return cls.construct(0, zeros, zeros, zeros, np.zeros(agents))

    def __repr__(self) -> str:
        names = ("messages", "scalars", "bytes", "lost")
        totals = ", ".join(f"{name}={getattr(self, name).sum():g}" for name in names)
        return f"Ledger(rounds={self.rounds}, {totals})"


def count_payload(
    payloads: Any, agents: int, runs: tuple[int, ...]
) -> tuple[list[Payload | None], Counts, Counts]:
    """Return read-only copies of the agents' payloads, and their scalars and bytes.

    Entries that are NaN in all runs are not sent. A payload without any other entry is
    silence, like None, and comes back as None.
    """
    if not isinstance(payloads, Sequence | np.ndarray) or len(payloads) != agents:
        size = len(payloads) if hasattr(payloads, "__len__") else None
        received = type(payloads).__name__ if size is None else size
        raise InvalidArgumentError(
            f"payloads must be a list with one entry for each of {agents} agents, got {received}"
        )
    n_runs = math.prod(runs)
    sent: list[Payload | None] = [None] * agents
    scalars = [0] * agents
    bytes_ = [0] * agents
    for agent, payload in enumerate(payloads):
        # None is silence, which costs nothing.
        if payload is None:
            continue
        is_tuple = type(payload) is tuple
        parts = payload if is_tuple else (payload,)
        if not parts:
            raise ValueError(
                f"payloads[{agent}] must have arrays, or None to stay silent, got ()"
            )
        # Copied even if the payload turns out to be silence: the checks come with it.
        copies = [_copy_part(part, agent, runs) for part in parts]
        silent = True
        for part in copies:
            count = _count_present(part, n_runs)
            scalars[agent] += count
            bytes_[agent] += count * part.itemsize
            # An empty array is a message without content, not silence.
            silent = silent and count == 0 and part.size > 0
        if not silent:
            sent[agent] = tuple(copies) if is_tuple else copies[0]
    return sent, np.array(scalars), np.array(bytes_)


def _copy_part(part: Any, agent: int, runs: tuple[int, ...]) -> Part:
    """Return a read-only copy of an array, or refuse anything else."""
    # A masked array's mask, or an object, could carry numbers that are not counted.
    plain = isinstance(part, np.ndarray) and not isinstance(part, np.ma.MaskedArray)
    if not plain or part.dtype.kind not in "biuf":
        name = f"dtype {part.dtype}" if plain else type(part).__name__
        raise InvalidArgumentError(
            f"payloads[{agent}] must be an array of real numbers, a flat tuple of them "
            f"or None, got {name}"
        )
    if part.shape[: len(runs)] != runs:
        raise ValueError(
            f"payloads[{agent}] must have leading axes {runs}, got shape {part.shape}"
        )
    # The sender may go on computing in its own array.
    copy: Part = np.array(part)
    copy.flags.writeable = False
    return copy


def _count_present(part: Part, n_runs: int) -> int:
    """Return how many entries of one run are not NaN in all runs."""
    # A sum of squares is NaN only if an entry is, and takes half as long as np.isnan.
    if part.dtype.kind != "f" or not math.isnan(np.vdot(part, part)):
        return part.size // n_runs
    present = ~np.isnan(part).reshape(n_runs, -1)
    return int(present.any(axis=0).sum())


def mask_lost(payload: Any, arrived: Mask) -> Any:
    """Return read-only copies of a payload with NaN in the runs that lost the message."""
    if isinstance(payload, tuple):
        return tuple([mask_lost(part, arrived) for part in payload])
    # One flag for each run, for all of the payload's other axes.
    axes = (1,) * (payload.ndim - arrived.ndim)
    masked = np.where(arrived.reshape(arrived.shape + axes), payload, np.nan)
    masked.flags.writeable = False
    return masked
