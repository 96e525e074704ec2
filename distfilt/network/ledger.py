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
        lost = np.zeros(agents)
        return cls.construct(0, zeros, zeros, zeros, lost, zeros, zeros, zeros)

    def __repr__(self) -> str:
        names = ("messages", "scalars", "bytes", "lost")
        totals = ", ".join(f"{name}={getattr(self, name).sum():g}" for name in names)
        return f"Ledger(rounds={self.rounds}, {totals})"


def count_payload(
    payloads: object, agents: int, runs: tuple[int, ...]
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


def _copy_part(part: object, agent: int, runs: tuple[int, ...]) -> Part:
    """Return a read-only copy of an array, or refuse anything else."""
    # A masked array's mask, or an object, could carry numbers that are not counted.
    plain = part if isinstance(part, np.ndarray) else None
    if isinstance(part, np.ma.MaskedArray):
        plain = None
    if plain is None or plain.dtype.kind not in "biuf":
        name = type(part).__name__ if plain is None else f"dtype {plain.dtype}"
        raise InvalidArgumentError(
            f"payloads[{agent}] must be an array of real numbers, a flat tuple of them "
            f"or None, got {name}"
        )
    if plain.shape[: len(runs)] != runs:
        raise ValueError(
            f"payloads[{agent}] must have leading axes {runs}, got shape {plain.shape}"
        )
    # The sender may go on computing in its own array.
    copy: Part = np.array(plain)
    copy.flags.writeable = False
    return copy


def _count_present(part: Part, n_runs: int) -> int:
    """Return how many entries of one run are not NaN in all runs."""
    # A sum of squares is NaN only if an entry is, and takes half as long as np.isnan.
    if part.dtype.kind != "f" or not math.isnan(np.vdot(part, part)):
        return part.size // n_runs
    present = ~np.isnan(part).reshape(n_runs, -1)
    return int(present.any(axis=0).sum())


def mask_lost(payload: Payload, arrived: Mask) -> Payload:
    """Return read-only copies of a payload with NaN in the runs that lost the message."""
    if isinstance(payload, tuple):
        return tuple([_mask_part(part, arrived) for part in payload])
    return _mask_part(payload, arrived)


def _mask_part(payload: Part, arrived: Mask) -> Part:
    # One flag for each run, for all of the payload's other axes.
    axes = (1,) * (payload.ndim - arrived.ndim)
    masked = np.where(arrived.reshape(arrived.shape + axes), payload, np.nan)
    masked.flags.writeable = False
    return masked
