"""The state of a filter between two steps, and how it is kept on disk."""

from __future__ import annotations

import hashlib
import io
import json
import os
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, is_dataclass
from importlib import import_module
from os import PathLike
from pathlib import Path
from typing import Annotated, Any, Self

import numpy as np

from ..network import Ledger
from ..validation import Array, FrozenModel, Mask, check_array

__all__ = ["SensorState", "State", "stack_states"]

_FORMAT = 5


@dataclass(frozen=True, eq=False, repr=False)
class State(FrozenModel):
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
    rejected: Annotated[Array, "..."] | None = field(default=None, kw_only=True)

    def __repr__(self) -> str:
        """Time and agents: the numbers themselves are many."""
        return (
            f"{type(self).__name__}(t={self.t:g}, {self.ledger.messages.size} agents)"
        )

    @property
    def runs(self) -> tuple[int, ...]:
        """Leading axes: independent runs of the network."""
        return ()

    @property
    def times(self) -> tuple[float, ...]:
        """Earlier times that are kept; none, unless a family says otherwise."""
        return ()

    def lagged_times(self, lag: int, t: float) -> tuple[float, ...]:
        """The earlier times that a step to `t` keeps, oldest first.

        >>> from distfilt.filters import GaussianFilter
        >>> from distfilt.models import constant_velocity
        >>> f = GaussianFilter(constant_velocity(sigma=1.0), [None], lag=1)
        >>> state = f.step(f.start((np.zeros(4), np.eye(4))), 1.0, [None])
        >>> (
        ...     state.times,
        ...     [state.lagged_times(lag, t) for t in (1.0, 2.0) for lag in (0, 1, 2)],
        ... )
        ((0.0,), [(0.0,), (0.0,), (0.0,), (), (1.0,), (0.0, 1.0)])
        """
        if t == self.t:
            return self.times
        return (*self.times, self.t)[-lag:] if lag else ()

    def save(self, path: str | PathLike[str]) -> None:
        """Write the state to one .npz file; :meth:`load` gives back the same bits.

        The file appears whole or not at all: a full disk leaves an earlier one as it was. It ends
        with the SHA-256 of all that stands before.
        """
        arrays: list[Any] = []
        header = {
            "format": _FORMAT,
            "kind": _name(type(self)),
            "state": _encoded(self, arrays),
        }
        parts = {f"a{k}": a for k, a in enumerate(arrays)}
        np.savez(made := io.BytesIO(), header=np.array(json.dumps(header)), **parts)
        unfinished = Path(path).with_name(f".{Path(path).name}.part")
        try:
            with unfinished.open("wb") as file:
                file.write(made.getvalue() + hashlib.sha256(made.getvalue()).digest())
                file.flush()
                os.fsync(file.fileno())
            unfinished.replace(path)
        except OSError as error:  # a write does not tell which file
            raise OSError(
                error.errno, error.strerror or str(error), str(path)
            ) from error
        finally:
            unfinished.unlink(missing_ok=True)

    @classmethod
    def load(cls, path: str | PathLike[str]) -> Self:
        """Read a state that :meth:`save` wrote.

        Raises
        ------
        OSError
            If there is no such file, or it cannot be read.
        ValueError
            If the file is no saved state of this kind, or is damaged.
        """
        made = Path(path).read_bytes()
        try:
            if hashlib.sha256(made[:-32]).digest() != made[-32:]:
                raise ValueError("it is damaged, or no state that was saved")
            with np.load(io.BytesIO(made[:-32]), allow_pickle=False) as file:
                parts = {name: file[name] for name in file.files}
            header = json.loads(str(parts["header"]))
            if header["format"] != _FORMAT or header["kind"] != _name(cls):
                raise ValueError(f"format {header['format']}, a {header['kind']}")
            return cls(**_decoded({"dict": header["state"]["dict"]}, parts))
        except (
            Exception
        ) as error:  # zip, JSON and numpy each have their own for what is damaged
            raise ValueError(
                f"path must be a saved {cls.__name__}, got {path}: {error}"
            ) from None


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
    waiting : tuple of Reading
        Those that have not been told to anybody yet.

    Examples
    --------
    >>> from distfilt.network import Ledger
    >>> @dataclass(frozen=True, eq=False, repr=False)
    ... class Levels(SensorState):
    ...     levels: Array
    ...     belief_field = "levels", (..., "A")
    >>> Levels(0.0, Ledger.empty(2), None, np.zeros((3, 2))).runs
    (3,)
    """

    history: tuple[Any, ...] = field(default=(), kw_only=True)
    failed: Mask = field(default_factory=lambda: np.zeros((), dtype=bool), kw_only=True)
    pending: tuple[Any, ...] = field(default=(), kw_only=True)

    belief_field = "belief", tuple[Any, ...]()

    def __post_init__(self) -> None:
        super().__post_init__()
        name, axes = self.belief_field
        check_array(self.belief, name, axes)
        object.__setattr__(self, "failed", np.broadcast_to(self.failed, self.runs))

    @property
    def belief(self) -> Array:
        """What the agents believe, under the family's own name for it."""
        return getattr(self, self.belief_field[0])  # type: ignore[no-any-return]

    @property
    def runs(self) -> tuple[int, ...]:
        """Leading axes: independent runs of the network."""
        return self.belief.shape[: 1 - len(self.belief_field[1])]

    @property
    def sizes(self) -> tuple[int, ...]:
        """Sizes of one agent's belief."""
        return self.belief.shape[len(self.runs) + 1 :]

    @property
    def times(self) -> tuple[float, ...]:
        """The earlier times that are kept, oldest first."""
        return tuple([t for t, _ in self.history])

    @property
    def lagged_states(self) -> tuple[Self, ...]:
        """A state for each of these times, as what is believed of it by now.

        What ties the times together is kept, by draws too:

        >>> from distfilt.filters import EnsembleFilter, TransportFilter
        >>> from distfilt.models import Model
        >>> from distfilt.sensors import Sensor, component
        >>> from distfilt.updates import enkf, serially
        >>> tenth = Model(1, lambda x, t, dt: x / 10, lambda t, dt: np.zeros((1, 1)))
        >>> cubes = Sensor(
        ...     2, lambda x: np.concatenate([10 * x, x**3], axis=-1), np.eye(2)
        ... )
        >>> for f in (
        ...     TransportFilter(
        ...         tenth, [component([0], std=0.1)], lag=1, members=9, rejuvenation=0.5
        ...     ),
        ...     EnsembleFilter(tenth, [cubes], lag=1, members=9, update=serially(enkf)),
        ... ):
        ...     state = f.start(([0.0], [[1.0]]), rng=np.random.default_rng(0))
        ...     state = f.step(state, 1.0, [[0.1, 0.0][: f.sensors[0].dim]])
        ...     print(
        ...         np.allclose(state.lagged_states[0].ensembles, 10 * state.ensembles)
        ...     )
        True
        True
        """
        name = self.belief_field[0]
        return tuple(
            self.replace(t=t, history=(), **{name: x}) for t, x in self.history
        )

    def mask_failed(self, values: Array) -> Array:
        """Values (*runs, ...) for the record: NaN in runs that have failed."""
        if not np.count_nonzero(self.failed):
            return values
        out = np.array(values)
        out[self.failed] = np.nan
        return out


def stack_states(states: Sequence[Any]) -> Any:
    """Several states of one shape as one, along a first axis of runs."""
    own = [name for name, value in vars(states[0]).items() if type(value) is np.ndarray]
    return states[0].replace(
        **{k: np.array([getattr(s, k) for s in states]) for k in own}
    )


def _name(kind: type) -> str:
    return f"{kind.__module__}:{kind.__qualname__}"


def _encoded(value: Any, arrays: list[Any]) -> Any:
    """`value` as JSON, with arrays put aside."""
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, np.ndarray | np.generic):
        if np.asarray(value).dtype.hasobject:
            raise ValueError("state must be numeric arrays to be saved, got objects")
        arrays.append(np.asarray(value))
        return {"array": len(arrays) - 1}
    if isinstance(value, tuple | list):
        return {"tuple": [_encoded(v, arrays) for v in value]}
    if isinstance(value, np.random.Generator):
        bits: Any = value.bit_generator
        # With its seed's state, so that children that it spawns are the same too.
        return {
            "rng": [_encoded(bits.state, arrays), _encoded(bits.seed_seq.state, arrays)]
        }
    if isinstance(value, dict):
        return {"dict": {name: _encoded(v, arrays) for name, v in value.items()}}
    if is_dataclass(value) and not isinstance(value, type):
        own = {f.name: getattr(value, f.name) for f in fields(value)}
        return {**_encoded(own, arrays), "of": _name(type(value))}
    raise ValueError(
        f"state must have fields that can be saved, got {type(value).__name__}"
    )


def _decoded(coded: Any, parts: dict[str, Any]) -> Any:
    if not isinstance(coded, dict):
        return coded
    if "array" in coded:
        return parts[f"a{coded['array']}"]
    if "tuple" in coded:
        return tuple(_decoded(v, parts) for v in coded["tuple"])
    if "rng" in coded:
        state, seed = (_decoded(v, parts) for v in coded["rng"])
        kind = getattr(np.random, state["bit_generator"])
        if not issubclass(kind, np.random.BitGenerator):
            raise ValueError(f"bit generator {kind}")
        bits = kind(np.random.SeedSequence(**seed))
        bits.state = state
        return np.random.Generator(bits)
    known = {name: _decoded(v, parts) for name, v in coded["dict"].items()}
    if "of" not in coded:
        return known
    module, _, name = coded["of"].partition(":")
    # Nothing is imported that a file names, unless it is one of this package's own structures.
    kind = (
        getattr(import_module(module), name) if module.startswith("distfilt.") else None
    )
    if not (isinstance(kind, type) and is_dataclass(kind)):
        raise ValueError(f"structure {coded['of']!r}")
    return kind(**known)
