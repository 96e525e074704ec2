"""What a scenario is made of: parameters with unit and source, and rows of a table."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from difflib import get_close_matches
from typing import Any

import numpy as np

from distfilt.checks import choice, count, nonblank, number

__all__ = ["Parameter", "Row", "UnknownKey"]

_SOURCES = ("given", "inferred", "assumed")
_NAME = re.compile(r"[a-z][a-z0-9_]*")
ORIGIN = ("source", "where", "reason", "note")
"""Columns of a row that say where it comes from; the others are its values."""

_LENGTHS = ("m", "km")
_ANGLES = ("rad", "deg")
_UNITS = {
    "range": _LENGTHS,
    "distance": _LENGTHS,
    "rangefinder": _LENGTHS,
    "angle": _ANGLES,
    "bearing": _ANGLES,
}
"""Units in which a reading of that kind can be; every other kind may have any."""


class UnknownKey(KeyError, ValueError):
    """A scenario or a row has nothing of that name; the message lists the nearest names.

    >>> from bookkit.published import scenario
    >>> try:
    ...     scenario("grange", "table-2")["gian"]
    ... except UnknownKey as error:
    ...     print(error)
    key: scenario grange/table-2 has no parameter 'gian'; nearest: gain
    """

    def __str__(self) -> str:  # KeyError would print the message in quotes
        return str(self.args[0])


def nearest(key: Any, names: list[str]) -> str:
    """The names that are most like a wrong one, for an error."""
    near = get_close_matches(str(key), names, n=3, cutoff=0.4) or names[:3]
    return ", ".join(near) or "none"


def _check_origin(unit: Any, source: Any, where: Any, reason: Any) -> None:
    """What is given says where, and what is not says why."""
    nonblank(unit, "unit")
    choice(source, "source", _SOURCES)
    needed, words = ("where", where) if source == "given" else ("reason", reason)
    nonblank(words, needed)
    for name, value in (("where", where), ("reason", reason)):
        if not isinstance(value, str):
            raise ValueError(f"{name}: needs a text, got {value!r}")


def plain(value: Any, name: str = "value") -> Any:
    """A TOML value as a scalar or as (nested) tuples, checked."""
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if isinstance(value, bool):
        return value
    if isinstance(value, str):
        return nonblank(value, name)
    if isinstance(value, int | float):
        number(value, name)
        return value
    if not isinstance(value, list | tuple) or not value:
        raise ValueError(f"{name}: needs a number, a text or a list of them, got {value!r}")
    inner = tuple(plain(v, name) for v in value)
    if all(isinstance(v, str) for v in inner):
        return inner
    if any(isinstance(v, bool | str) for v in inner):
        raise ValueError(f"{name}: needs a list of numbers or of texts, got {value!r}")
    try:
        np.array(inner, dtype=float)
    except ValueError:
        raise ValueError(f"{name}: needs numbers in rows of one length, got {value!r}") from None
    return inner


@dataclass(frozen=True)
class Parameter:
    """One parameter of a study.

    Parameters
    ----------
    name : str
        In lower case with underscores.
    value : bool, int, float, str or (nested) sequence
        Its value; sequences are kept as tuples.
    unit : str
        ``1`` for a pure number, ``-`` where a unit has no meaning.
    source : {"given", "inferred", "assumed"}
        Whether the paper gives it, it follows from what the paper gives, or we chose it.
    where : str
        The place in the paper; needed if given.
    reason : str
        Why this value; needed if inferred or assumed.
    note : str
        A remark.

    Examples
    --------
    >>> Parameter("gain", 0.05, "1", "assumed", reason="a sweep goes with it").why
    'a sweep goes with it'
    """

    name: str
    value: Any
    unit: str
    source: str
    where: str = ""
    reason: str = ""
    note: str = ""

    def __post_init__(self) -> None:
        if not isinstance(self.name, str) or not _NAME.fullmatch(self.name):
            raise ValueError(f"name: needs a lower-case name, got {self.name!r}")
        object.__setattr__(self, "value", plain(self.value))
        _check_origin(self.unit, self.source, self.where, self.reason)
        if not isinstance(self.note, str):
            raise ValueError(f"note: needs a text, got {self.note!r}")

    @property
    def why(self) -> str:
        """Where it is given, or the reason for it; with the note."""
        return _why(self.where, self.reason, self.note)


def _why(where: str, reason: str, note: str) -> str:
    return " ".join(t for t in (reason or f"{where}.", note) if t)


def _distinct(value: Any, name: str) -> tuple[Any, ...]:
    """A list, possibly empty, without repeats."""
    if not isinstance(value, list | tuple) or len(set(map(str, value))) != len(value):
        raise ValueError(f"{name}: needs a list without repeats, got {value!r}")
    return tuple(value)


def _components(value: Any, name: str) -> tuple[int, ...]:
    """Components of a state, counted from 0."""
    if not _distinct(value, name):
        raise ValueError(f"{name}: needs at least one component, got none")
    return tuple(count(k, name, at_least=0) for k in value)


def _names(value: Any, name: str) -> tuple[str, ...]:
    return tuple(nonblank(other, name) for other in _distinct(value, name))


def _positive(value: Any, name: str) -> Any:
    number(value, name, above=0)
    return value


_COLUMNS: dict[str, Callable[[Any, str], Any]] = {
    "name": nonblank,
    "kind": nonblank,
    "unit": nonblank,
    "dims": _components,
    "neighbours": _names,
    "noise": _positive,
    "std": _positive,
}
"""Columns with one meaning in every scenario; any other column holds what `plain` takes."""


class Row(Mapping[str, Any]):
    """One row of a scenario's table, such as an agent: ``row["kind"]`` or ``row.kind``.

    A row has a ``name``, a ``unit`` and a ``source`` with ``where`` or ``reason``, and any other
    columns. Some of them mean the same in every scenario and are checked: ``dims`` (components of
    the state, counted from 0), ``neighbours`` (whom an agent talks with, by name), ``noise`` and
    ``std`` (standard deviations of a reading, positive), ``kind`` (what an agent sees, in the
    paper's word), whose ``unit`` has to fit: an angle is no length.

    Parameters
    ----------
    cells : mapping from str to value
        The row's columns; lists are kept as tuples.

    Examples
    --------
    >>> row = Row({"name": "B", "kind": "angle", "dims": [1, 2], "noise": 0.2, "unit": "rad",
    ...            "source": "given", "where": "Table II"})
    >>> row.kind, row["dims"], row.why
    ('angle', (1, 2), 'Table II.')
    >>> Row({**row, "kind": "range"})
    Traceback (most recent call last):
    ValueError: unit: needs one of m, km for kind 'range', got 'rad'
    """

    __slots__ = ("_cells",)

    def __init__(self, cells: Mapping[str, Any]) -> None:
        if not isinstance(cells, Mapping):
            raise ValueError(f"cells: needs a mapping, got {type(cells).__name__}")
        kept: dict[str, Any] = {}
        for key, value in cells.items():
            if not isinstance(key, str) or not _NAME.fullmatch(key):
                raise ValueError(f"{key}: needs a lower-case name of a column, got {key!r}")
            if key not in ORIGIN:
                kept[key] = _COLUMNS.get(key, plain)(value, key)
        for key in ("name", "unit"):
            nonblank(cells.get(key), key)
        origin = {key: cells.get(key, "") for key in ORIGIN}
        _check_origin(kept["unit"], origin["source"], origin["where"], origin["reason"])
        if not isinstance(origin["note"], str):
            raise ValueError(f"note: needs a text, got {origin['note']!r}")
        allowed = _UNITS.get(kept.get("kind", ""), (kept["unit"],))
        if kept["unit"] not in allowed:
            raise ValueError(
                f"unit: needs one of {', '.join(allowed)} for kind {kept['kind']!r}, "
                f"got {kept['unit']!r}"
            )
        kept |= {key: value for key, value in origin.items() if value}
        object.__setattr__(self, "_cells", kept)

    def __getitem__(self, key: str) -> Any:
        if key not in self._cells:
            names = list(self._cells)
            raise UnknownKey(f"key: row {self._cells['name']!r} has no column {key!r}; "
                             f"nearest: {nearest(key, names)}")  # fmt: skip
        return self._cells[key]

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):
            raise AttributeError(name)
        try:
            return self[name]
        except UnknownKey as error:
            raise AttributeError(str(error)) from None

    def __setattr__(self, name: str, value: Any) -> None:
        raise AttributeError(f"{name}: a row cannot be changed; Scenario.replace_row makes another")

    def __reduce__(self) -> Any:
        return type(self), (dict(self._cells),)

    def __iter__(self) -> Iterator[str]:
        return iter(self._cells)

    def __len__(self) -> int:
        return len(self._cells)

    def __contains__(self, key: object) -> bool:
        return key in self._cells

    def __hash__(self) -> int:
        return hash(tuple(self._cells.items()))

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self._cells!r})"

    @property
    def why(self) -> str:
        """Where it is given, or the reason for it; with the note."""
        where, reason, note = (self._cells.get(key, "") for key in ("where", "reason", "note"))
        return _why(where, reason, note)

    @property
    def value_columns(self) -> tuple[str, ...]:
        """The columns that hold values, without those that say where they come from."""
        return tuple(key for key in self._cells if key not in ORIGIN)


def link_fault(rows: tuple[Row, ...]) -> tuple[int, str, str] | None:
    """Position, key and message of the first fault in names and neighbours, or None."""
    by_name: dict[str, Row] = {}
    for k, row in enumerate(rows):
        if row.name in by_name:
            return k, "name", f"needs distinct names, got {row.name!r} again"
        by_name[row.name] = row
    for k, row in enumerate(rows):
        for other in row.get("neighbours", ()):
            if other not in by_name:
                return k, "neighbours", f"needs known agents, got {other!r} beside {row.name!r}"
            if row.name not in by_name[other].get("neighbours", ()) and other != row.name:
                words = f"{row.name!r} names {other!r}, which does not name it"
                return k, "neighbours", f"needs mutual neighbours; {words}"
    return None
