"""What may pass between agents: numeric arrays, or flat tuples of them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__: list[str] = []

Part = NDArray[Any]
Payload = Part | tuple[Part, ...]
Mask = NDArray[np.bool_]

_NUMERIC = "biuf"


def checked(
    payloads: Any, agents: int, runs: tuple[int, ...], *, copy: bool
) -> list[Payload | None]:
    """Each agent's payload as read-only arrays; None where it is silent.

    A payload that holds nothing but NaN says nothing, and is silence too. With `copy` the arrays
    are the channel's own, for messages that arrive later.
    """
    if not isinstance(payloads, Sequence | np.ndarray):
        raise ValueError(
            f"payloads: needs a sequence with one for each agent, got {type(payloads).__name__}"
        )
    if len(payloads) != agents:
        raise ValueError(f"payloads: needs one for each agent ({agents}), got {len(payloads)}")
    out: list[Payload | None] = []
    for agent, payload in enumerate(payloads):
        if payload is None:
            out.append(None)
            continue
        if type(payload) is not tuple:
            part = _part(payload, agent, runs, copy)
            out.append(None if _says_nothing(part) else part)
            continue
        parts = tuple(_part(p, agent, runs, copy) for p in payload)
        if not parts:
            raise ValueError(f"payloads[{agent}]: needs arrays, or None to stay silent, got ()")
        out.append(None if all(_says_nothing(p) for p in parts) else parts)
    return out


def _part(part: Any, agent: int, runs: tuple[int, ...], copy: bool) -> Part:
    if not isinstance(part, np.ndarray) or isinstance(part, np.ma.MaskedArray):
        raise ValueError(
            f"payloads[{agent}]: needs a numeric array, a flat tuple of them or None, "
            f"got {type(part).__name__}"
        )
    if part.dtype.kind not in _NUMERIC:
        raise ValueError(
            f"payloads[{agent}]: needs booleans, integers or real numbers, got dtype {part.dtype}"
        )
    if part.shape[: len(runs)] != runs:
        raise ValueError(f"payloads[{agent}]: needs leading axes {runs}, got shape {part.shape}")
    out = np.array(part) if copy else part.view(np.ndarray)
    out.flags.writeable = False
    return out


def _says_nothing(part: Part) -> bool:
    if part.dtype.kind != "f" or part.size == 0:
        return False
    first = part.item(0)
    return first != first and bool(np.isnan(part).all())


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


def sizes(sent: list[Payload | None], runs: tuple[int, ...]) -> tuple[Any, Any]:
    """Scalars and bytes of each agent's payload in one run."""
    copies = math.prod(runs)
    parts = [() if p is None else p if isinstance(p, tuple) else (p,) for p in sent]
    scalars = [sum([a.size for a in p]) // copies for p in parts]
    return np.array(scalars), np.array([sum([a.nbytes for a in p]) // copies for p in parts])
