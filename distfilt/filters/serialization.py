"""States on disk: one .npz file with a header in JSON, written whole, with a check sum."""

from __future__ import annotations

import hashlib
import io
import json
import os
from dataclasses import fields, is_dataclass
from importlib import import_module
from os import PathLike
from pathlib import Path
from typing import Any, TypeAlias, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

__all__ = ["load_fields", "save_state"]

T = TypeVar("T")
NumpyArray: TypeAlias = NDArray[np.generic]
Json: TypeAlias = "None | bool | int | float | str | list[Json] | dict[str, Json]"

_FORMAT = 7
"""Raised when the names or the meaning of saved fields change."""

_DIGEST_SIZE = 32


def save_state(state: object, path: str | PathLike[str]) -> None:
    """Write a state to one file, which appears whole or not at all.

    >>> import tempfile
    >>> from distfilt.filters import State
    >>> from distfilt.network import Ledger
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     save_state(State(1.0, Ledger.empty(2), None), f"{folder}/state.npz")
    ...     load_fields(State, f"{folder}/state.npz")
    State(t=1, 2 agents)
    """
    arrays: list[NumpyArray] = []
    header = {
        "format": _FORMAT,
        "kind": _class_name(type(state)),
        "state": _encode(state, arrays),
    }
    buffer = io.BytesIO()
    named = {f"a{k}": array for k, array in enumerate(arrays)}
    named["header"] = np.array(json.dumps(header))
    np.savez(buffer, allow_pickle=False, **named)
    # The check sum comes last, so that a file whose end is missing is found too.
    content = buffer.getvalue()
    # Written beside the file and then renamed, which a file system does at once.
    unfinished = Path(path).with_name(f".{Path(path).name}.part")
    try:
        with unfinished.open("wb") as file:
            file.write(content + hashlib.sha256(content).digest())
            file.flush()
            os.fsync(file.fileno())
        unfinished.replace(path)
    except OSError as error:
        # An error of a write does not name the file.
        reason = error.strerror or str(error)
        raise OSError(error.errno, reason, str(path)) from error
    finally:
        unfinished.unlink(missing_ok=True)


def load_fields(cls: type[T], path: str | PathLike[str]) -> T:
    """Read a state of a class from a file that :func:`save_state` wrote."""
    data = Path(path).read_bytes()
    content = data[:-_DIGEST_SIZE]
    try:
        if hashlib.sha256(content).digest() != data[-_DIGEST_SIZE:]:
            raise ValueError("it is damaged, or no state that was saved")
        with np.load(io.BytesIO(content), allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        header = json.loads(str(arrays["header"]))
        if header["format"] != _FORMAT or header["kind"] != _class_name(cls):
            raise ValueError(f"format {header['format']}, a {header['kind']}")
        # The fields alone: the class is known, and its name in the file is not looked up.
        return cls(**_decode({"dict": header["state"]["dict"]}, arrays))
    # zip, JSON and numpy each raise their own errors for damaged data.
    except Exception as error:
        raise ValueError(
            f"path must be a saved {cls.__name__}, got {path}: {error}"
        ) from None


def _class_name(cls: type) -> str:
    """Return module and name of a class, as the header of a file has them."""
    return f"{cls.__module__}:{cls.__qualname__}"


def _encode(value: object, arrays: list[NumpyArray]) -> Json:
    """Return a value as JSON; arrays are appended to `arrays`, replaced by their index there."""
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, np.ndarray | np.generic):
        if np.asarray(value).dtype.hasobject:
            raise ValueError("state must be numeric arrays to be saved, got objects")
        arrays.append(np.asarray(value))
        return {"array": len(arrays) - 1}
    # A list is loaded as a tuple.
    if isinstance(value, tuple | list):
        return {"tuple": [_encode(item, arrays) for item in value]}
    if isinstance(value, np.random.Generator):
        bits = value.bit_generator
        seeds = cast(np.random.SeedSequence, bits.seed_seq)
        # The state of its seed sequence too, so that generators spawned from it later are the same
        parts = (bits.state, seeds.state)
        return {"rng": [_encode(part, arrays) for part in parts]}
    if isinstance(value, dict):
        return {"dict": {name: _encode(item, arrays) for name, item in value.items()}}
    # The fields of a dataclass, with its name beside them
    if is_dataclass(value) and not isinstance(value, type):
        items = {f.name: getattr(value, f.name) for f in fields(value)}
        encoded = {name: _encode(item, arrays) for name, item in items.items()}
        return {"dict": encoded, "of": _class_name(type(value))}
    raise ValueError(
        f"state must have fields that can be saved, got {type(value).__name__}"
    )


def _decode(encoded: Any, arrays: dict[str, NumpyArray]) -> Any:
    """Return the value that :func:`_encode` turned into JSON and arrays."""
    if not isinstance(encoded, dict):
        return encoded
    if "array" in encoded:
        return arrays[f"a{encoded['array']}"]
    if "tuple" in encoded:
        return tuple(_decode(item, arrays) for item in encoded["tuple"])
    if "rng" in encoded:
        return _decode_rng(*[_decode(part, arrays) for part in encoded["rng"]])
    items = {name: _decode(item, arrays) for name, item in encoded["dict"].items()}
    # A plain dictionary, or the fields of a dataclass.
    if "of" not in encoded:
        return items
    return _find_class(encoded["of"])(**items)


def _decode_rng(state: Any, seed: Any) -> np.random.Generator:
    """Return a generator from the state of its bit generator and that of its seed sequence."""
    # A file can name classes of bit generators only.
    bit_generator = getattr(np.random, state["bit_generator"])
    if not issubclass(bit_generator, np.random.BitGenerator):
        raise ValueError(f"bit generator {bit_generator}")
    bits = bit_generator(np.random.SeedSequence(**seed))
    bits.state = state
    return np.random.Generator(bits)


def _find_class(name: str) -> type:
    """Find a dataclass of this package; a file cannot name anything else to be imported."""
    module, _colon, qualname = name.partition(":")
    cls: object = None
    if module.startswith("distfilt."):
        cls = getattr(import_module(module), qualname)
    if not (isinstance(cls, type) and is_dataclass(cls)):
        raise ValueError(f"structure {name!r}")
    return cls
