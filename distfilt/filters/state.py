"""The state of an ensemble filter between two steps, and how to keep it on disk."""

from __future__ import annotations

import json
import zipfile
from dataclasses import dataclass
from os import PathLike
from typing import Any

import numpy as np

from ..checks import Array, array, generator, number
from ..network import Ledger

__all__ = ["EnsembleState"]

_FORMAT = 1


@dataclass(frozen=True, eq=False)
class EnsembleState:
    """All that a filter needs to go on: nothing is hidden elsewhere.

    Parameters
    ----------
    t : float
        The time, in s.
    ensembles : ndarray, (*runs, A, N, d)
        Every agent's members.
    rng : numpy.random.Generator
        Where the next draw comes from. A step copies it, so a state can be stepped twice.
    ledger : Ledger
        What has been sent so far.
    history : tuple of (float, ndarray)
        Earlier times and their ensembles, oldest first, conditioned on all that came since; kept
        only for late observations.

    Examples
    --------
    >>> state = EnsembleState(0.0, np.zeros((2, 5, 3)), np.random.default_rng(0), Ledger.empty(2))
    >>> state.agents, state.members, state.dim
    (2, 5, 3)
    """

    t: float
    ensembles: Array
    rng: np.random.Generator
    ledger: Ledger
    history: tuple[tuple[float, Array], ...] = ()

    def __post_init__(self) -> None:
        number(self.t, "t")
        ensembles = array(self.ensembles, "ensembles", (..., "A", "N", "d"))
        generator(self.rng)
        if self.ledger.messages.size != ensembles.shape[-3]:
            raise ValueError(
                f"ledger: needs {ensembles.shape[-3]} agents, got {self.ledger.messages.size}"
            )
        for _, earlier in self.history:
            array(earlier, "history", ensembles.shape)

    @property
    def runs(self) -> tuple[int, ...]:
        """Leading axes: independent runs of the network."""
        return tuple(self.ensembles.shape[:-3])

    @property
    def agents(self) -> int:
        """Number A of agents."""
        return int(self.ensembles.shape[-3])

    @property
    def members(self) -> int:
        """Number N of members of each agent."""
        return int(self.ensembles.shape[-2])

    @property
    def dim(self) -> int:
        """Size d of the state vector."""
        return int(self.ensembles.shape[-1])

    def save(self, path: str | PathLike[str]) -> None:
        """Write the state to one .npz file; :meth:`load` gives back the same bits."""
        header = {"format": _FORMAT, "t": self.t, "rng": _listed(self.rng.bit_generator.state)}
        header["rounds"] = self.ledger.rounds
        header["history"] = [t for t, _ in self.history]
        earlier = np.array([e for _, e in self.history]).reshape(-1, *self.ensembles.shape)
        with open(path, "wb") as file:
            np.savez(
                file,
                header=np.array(json.dumps(header)),
                ensembles=self.ensembles,
                history=earlier,
                messages=self.ledger.messages,
                scalars=self.ledger.scalars,
                bytes=self.ledger.bytes,
                lost=self.ledger.lost,
            )

    @classmethod
    def load(cls, path: str | PathLike[str]) -> EnsembleState:
        """Read a state that :meth:`save` wrote.

        Raises
        ------
        FileNotFoundError
            If there is no such file.
        ValueError
            If the file is not a saved state, or is damaged.
        """
        try:
            with np.load(path, allow_pickle=False) as file:
                parts = {name: file[name] for name in file.files}
            header = json.loads(str(parts["header"]))
            if header["format"] != _FORMAT:
                raise ValueError(f"format {header['format']}")
            counts = (parts[name] for name in ("messages", "scalars", "bytes", "lost"))
            ledger = Ledger(int(header["rounds"]), *counts)
            history = tuple(zip(header["history"], parts["history"], strict=True))
            rng = _restored(header["rng"])
            return cls(float(header["t"]), parts["ensembles"], rng, ledger, history)
        except FileNotFoundError:
            raise
        except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile) as error:
            raise ValueError(f"path: needs a saved filter state, got {path}: {error}") from None


def _listed(value: Any) -> Any:
    """The generator's state with arrays as lists, for JSON."""
    if isinstance(value, dict):
        return {key: _listed(item) for key, item in value.items()}
    if isinstance(value, np.ndarray):
        return {"dtype": str(value.dtype), "values": value.tolist()}
    return value.item() if isinstance(value, np.generic) else value


def _restored(listed: dict[str, Any]) -> np.random.Generator:
    def arrays(value: Any) -> Any:
        if isinstance(value, dict):
            if set(value) == {"dtype", "values"}:
                return np.array(value["values"], dtype=value["dtype"])
            return {key: arrays(item) for key, item in value.items()}
        return value

    kind = listed["bit_generator"]
    if kind not in ("PCG64", "PCG64DXSM", "MT19937", "Philox", "SFC64"):
        raise ValueError(f"bit generator {kind!r}")
    bits = getattr(np.random, kind)()
    bits.state = arrays(listed)
    return np.random.Generator(bits)
