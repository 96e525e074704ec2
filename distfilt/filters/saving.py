"""The state of a filter between two steps, and how it is kept on disk."""

from __future__ import annotations

import json
import os
import tempfile
import zipfile
from dataclasses import dataclass, field, fields, is_dataclass
from importlib import import_module
from os import PathLike
from pathlib import Path
from typing import Annotated, Any, Self

import numpy as np

from ..doors import Array, Mask, Record, array
from ..network import Ledger

__all__ = ["SensorState", "State"]

_FORMAT = 3
_BITS = ("PCG64", "PCG64DXSM", "MT19937", "Philox", "SFC64")


@dataclass(frozen=True, eq=False, repr=False)
class State(Record):
    """All that a filter needs to go on: nothing is hidden elsewhere.

    A family of filters adds its own fields. They may be arrays, numbers, texts, None, tuples of
    these, random generators, and frozen dataclasses of this package; all of them are saved.

    Parameters
    ----------
    t : float
        The time, in s.
    ledger : Ledger
        What has been sent so far.
    rng : numpy.random.Generator or None
        Where the next draw comes from; none for a filter that draws nothing. A step copies it, so
        a state can be stepped twice.
    refused : ndarray, (*runs, A), optional
        How many readings each agent's gate left out in the last step; none without a gate.

    Examples
    --------
    >>> State(0.0, Ledger.empty(2), None)
    State(t=0, 2 agents)
    """

    t: float
    ledger: Ledger
    rng: np.random.Generator | None
    refused: Annotated[Array, "..."] | None = field(default=None, kw_only=True)

    def __repr__(self) -> str:
        """Time, agents, and the shapes of what is believed: the numbers themselves are many."""
        own = ((f.name, getattr(self, f.name)) for f in fields(self)[4:])
        shapes = [f"{name} {v.shape}" for name, v in own if isinstance(v, np.ndarray) and v.ndim]
        parts = [f"t={self.t:g}", f"{self.ledger.messages.size} agents", *shapes]
        return f"{type(self).__name__}({', '.join(parts)})"

    @property
    def runs(self) -> tuple[int, ...]:
        """Leading axes: independent runs of the network."""
        return ()

    @property
    def times(self) -> tuple[float, ...]:
        """Earlier times that are kept; none, unless a family says otherwise."""
        return ()

    def kept(self, lag: int, t: float) -> tuple[float, ...]:
        """The earlier times that a step to `t` keeps, oldest first."""
        if not lag or t == self.t:
            return self.times
        return (*self.times, self.t)[-lag:]

    def save(self, path: str | PathLike[str]) -> None:
        """Write the state to one .npz file; :meth:`load` gives back the same bits.

        The file appears whole or not at all: a full disk leaves an earlier one as it was.
        """
        target = _path(path)
        arrays: list[Any] = []
        header = {"format": _FORMAT, "kind": _name(type(self)), "state": _encoded(self, arrays)}
        parts = {f"a{k}": a for k, a in enumerate(arrays)}
        handle, temporary = tempfile.mkstemp(dir=target.parent, prefix=f".{target.name}.")
        try:
            with os.fdopen(handle, "wb") as file:
                np.savez(file, header=np.array(json.dumps(header)), **parts)
                file.flush()
                os.fsync(file.fileno())
            os.replace(temporary, target)
        except BaseException:
            Path(temporary).unlink(missing_ok=True)
            raise

    @classmethod
    def load(cls, path: str | PathLike[str]) -> Self:
        """Read a state that :meth:`save` wrote.

        Raises
        ------
        FileNotFoundError
            If there is no such file.
        ValueError
            If the file is no saved state of this kind, or is damaged.
        """
        source = _path(path)
        try:
            with np.load(source, allow_pickle=False) as file:
                parts = {name: file[name] for name in file.files}
            header = json.loads(str(parts["header"]))
            if header["format"] != _FORMAT or header["kind"] != _name(cls):
                raise ValueError(f"format {header['format']}, a {header['kind']}")
            return cls(**_fields(header["state"], parts))
        except FileNotFoundError:
            raise
        except (
            OSError, ValueError, KeyError, TypeError, EOFError, AttributeError, ImportError,
            IndexError, NotImplementedError, zipfile.BadZipFile,
        ) as error:
            raise ValueError(f"path: needs a saved {cls.__name__}, got {path}: {error}") from None


@dataclass(frozen=True, eq=False, repr=False)
class SensorState(State):
    """A state of agents with sensors: what they believe is an array with axes (*runs, A, ...).

    A family names that array and its axes in `_belief`, and adds it as a field.

    Parameters
    ----------
    t, ledger, rng, refused
        As for :class:`~distfilt.filters.State`.
    history : tuple of (float, ndarray)
        Earlier times and what is believed of them by now, oldest first.
    failed : ndarray of bool, (*runs)
        Runs that failed and are no longer updated.
    waiting : tuple
        Readings that have not been told to anybody yet: when, by whom, of which sensor, and what.

    Examples
    --------
    >>> from distfilt.network import Ledger
    >>> @dataclass(frozen=True, eq=False, repr=False)
    ... class Levels(SensorState):
    ...     levels: Array
    ...     _belief = "levels", (..., "A")
    >>> Levels(0.0, Ledger.empty(2), None, np.zeros((3, 2))).runs
    (3,)
    """

    history: tuple[Any, ...] = field(default=(), kw_only=True)
    failed: Mask = field(default_factory=lambda: np.zeros((), dtype=bool), kw_only=True)
    waiting: tuple[Any, ...] = field(default=(), kw_only=True)

    _belief = "belief", tuple[Any, ...]()

    def __post_init__(self) -> None:
        super().__post_init__()
        name, axes = self._belief
        shape = array(self.belief, name, axes).shape
        agents = shape[len(self.runs)]
        if self.ledger.messages.size != agents:
            raise ValueError(f"ledger: needs {agents} agents, got {self.ledger.messages.size}")
        object.__setattr__(self, "failed", np.broadcast_to(self.failed, self.runs))

    @property
    def belief(self) -> Array:
        """What the agents believe, under the family's own name for it."""
        return np.asarray(getattr(self, self._belief[0]))

    @property
    def runs(self) -> tuple[int, ...]:
        """Leading axes: independent runs of the network."""
        return tuple(self.belief.shape[: 1 - len(self._belief[1])])

    @property
    def sizes(self) -> tuple[int, ...]:
        """Sizes of one agent's belief."""
        return self.belief.shape[len(self.runs) + 1 :]

    @property
    def times(self) -> tuple[float, ...]:
        """The earlier times that are kept, oldest first."""
        return tuple([t for t, _ in self.history])

    @property
    def earlier(self) -> tuple[Self, ...]:
        """A state for each of these times, as what is believed of it by now."""
        name = self._belief[0]
        return tuple(self.changed(t=t, history=(), **{name: x}) for t, x in self.history)

    def shown(self, values: Array) -> Array:
        """Values (*runs, ...) for the record: NaN in runs that have failed."""
        if not self.failed.any():
            return values
        out = np.array(values)
        out[self.failed] = np.nan
        return out


def _path(path: Any) -> Path:
    """A path that names a file."""
    if not isinstance(path, str | PathLike) or not isinstance(os.fspath(path), str):
        raise ValueError(f"path: needs a path, got {type(path).__name__}")
    if not Path(path).name or Path(path).is_dir():
        raise ValueError(f"path: needs a file's name, got {str(path)!r}")
    return Path(path)


def _name(kind: type) -> str:
    return f"{kind.__module__}:{kind.__qualname__}"


def _encoded(value: Any, arrays: list[Any]) -> Any:
    """`value` as JSON, with arrays put aside."""
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, np.ndarray | np.generic):
        if np.asarray(value).dtype.hasobject:
            raise ValueError("state: needs numeric arrays to be saved, got objects")
        arrays.append(np.asarray(value))
        return {"array": len(arrays) - 1}
    if isinstance(value, tuple):
        return {"tuple": [_encoded(v, arrays) for v in value]}
    if isinstance(value, np.random.Generator):
        return {"rng": _listed(value.bit_generator.state), "seed": _seed(value)}
    if is_dataclass(value) and not isinstance(value, type):
        parts = {f.name: _encoded(getattr(value, f.name), arrays) for f in fields(value)}
        return {"fields": parts, "of": _name(type(value))}
    raise ValueError(f"state: needs fields that can be saved, got {type(value).__name__}")


def _fields(coded: dict[str, Any], parts: dict[str, Any]) -> dict[str, Any]:
    return {name: _decoded(v, parts) for name, v in coded["fields"].items()}


def _decoded(coded: Any, parts: dict[str, Any]) -> Any:
    if not isinstance(coded, dict):
        return coded
    if "array" in coded:
        return parts[f"a{coded['array']}"]
    if "tuple" in coded:
        return tuple(_decoded(v, parts) for v in coded["tuple"])
    if "rng" in coded:
        return _restored(coded["rng"], coded["seed"])
    module, _, name = coded["of"].partition(":")
    # Nothing is imported that a file names, unless it is one of this package's own structures.
    if not module.startswith("distfilt."):
        raise ValueError(f"structure {coded['of']!r}")
    kind = getattr(import_module(module), name)
    if not (isinstance(kind, type) and is_dataclass(kind)):
        raise ValueError(f"structure {coded['of']!r}")
    return kind(**_fields(coded, parts))


def _seed(rng: np.random.Generator) -> dict[str, Any] | None:
    """What :meth:`numpy.random.Generator.spawn` needs, so that children are the same too."""
    sequence = rng.bit_generator.seed_seq
    if not isinstance(sequence, np.random.SeedSequence):
        return None
    entropy: Any = sequence.entropy
    return {
        "entropy": np.asarray(entropy).tolist() if np.ndim(entropy) else entropy,
        "spawn_key": [int(k) for k in sequence.spawn_key],
        "pool_size": int(sequence.pool_size),
        "n_children_spawned": int(sequence.n_children_spawned),
    }


def _listed(value: Any) -> Any:
    """The generator's state with arrays as lists, for JSON."""
    if isinstance(value, dict):
        return {key: _listed(item) for key, item in value.items()}
    if isinstance(value, np.ndarray):
        return {"dtype": str(value.dtype), "values": value.tolist()}
    return value.item() if isinstance(value, np.generic) else value


def _arrays(value: Any) -> Any:
    if isinstance(value, dict):
        if set(value) == {"dtype", "values"}:
            return np.array(value["values"], dtype=value["dtype"])
        return {key: _arrays(item) for key, item in value.items()}
    return value


def _restored(listed: dict[str, Any], seed: dict[str, Any] | None) -> np.random.Generator:
    kind = listed["bit_generator"]
    if kind not in _BITS:
        raise ValueError(f"bit generator {kind!r}")
    if seed is None:
        bits = getattr(np.random, kind)()
    else:
        bits = getattr(np.random, kind)(np.random.SeedSequence(**seed))
    bits.state = _arrays(listed)
    return np.random.Generator(bits)
