"""Scenarios: every parameter of a study with its source, and changes of them."""

from __future__ import annotations

import hashlib
import json
import tomllib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from difflib import get_close_matches
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .folders import data_root, inside
from .rows import html_table, markdown_table, read_rows

__all__ = ["Parameter", "Row", "Scenario", "read_scenario", "scenario"]

_SOURCES = ("given", "inferred", "assumed")
_ORIGIN = ("source", "where", "reason", "note")
"""Columns of a row that give its origin; the others are its values."""

_UNITS = {
    "distance": ("m", "km"),
    "bearing": ("rad", "deg"),
    "line_angle": ("rad", "deg"),
}
"""Units of each kind of sensor; other kinds may have any unit."""


@dataclass(frozen=True)
class Parameter:
    """One parameter of a study.

    Parameters
    ----------
    name : str
    value : bool, int, float, str or (nested) tuple
    unit : str
        ``1`` for a pure number, ``-`` where a unit has no meaning.
    source : {"given", "inferred", "assumed"}
        Whether the paper gives it, it follows from given values, or we chose it.
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
        # The dataclass is frozen: its own check may set a field only in this way.
        object.__setattr__(self, "value", _plain(self.value))
        _check_origin(vars(self))

    @property
    def why(self) -> str:
        """The place where it is given, or the reason for it, with the note."""
        return _why(vars(self))


def _plain(value: Any) -> Any:
    """Return a value of TOML or numpy as a scalar or as (nested) tuples."""
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    return tuple(map(_plain, value)) if isinstance(value, list | tuple) else value


def _check_origin(cells: Mapping[str, Any]) -> None:
    """Check that a given value has its place in the paper, and any other a reason."""
    if cells.get("source") not in _SOURCES:
        raise ValueError(
            f"source must be one of {', '.join(_SOURCES)}, got {cells.get('source')!r}"
        )
    # A given value needs its place in the paper, any other one a reason.
    needed = "where" if cells["source"] == "given" else "reason"
    for key in ("name", "unit", needed):
        if not str(cells.get(key) or "").strip():
            raise ValueError(f"{key} must be a text, got {cells.get(key)!r}")


def _why(cells: Mapping[str, Any]) -> str:
    text = cells.get("reason") or f"{cells.get('where')}."
    return " ".join(t for t in (text, cells.get("note")) if t)


class UnknownKey(KeyError, ValueError):
    """A scenario or a row has no such name; the message lists the nearest names."""

    def __init__(self, text: str, key: Any, names: list[str]) -> None:
        # A misspelt name is answered with the names that look like it.
        nearest = get_close_matches(str(key), names, n=3, cutoff=0.4) or names[:3]
        super().__init__(f"{text} {key!r}; nearest: {', '.join(nearest) or 'none'}")

    def __str__(self) -> str:  # KeyError would print the message in quotes
        return str(self.args[0])


class Row(Mapping[str, Any]):
    """One row of a scenario's table, such as an agent: ``row["kind"]`` or ``row.kind``.

    A row has a ``name``, a ``unit``, a ``source`` with ``where`` or ``reason``, and its own
    columns. The unit must fit the sensor's ``kind``: an angle is not a length.

    Examples
    --------
    >>> row = Row(
    ...     {
    ...         "name": "B",
    ...         "kind": "line_angle",
    ...         "dims": [1, 2],
    ...         "noise": 0.2,
    ...         "unit": "rad",
    ...         "source": "given",
    ...         "where": "Table II",
    ...     }
    ... )
    >>> row.kind, row["dims"], row.why
    ('line_angle', (1, 2), 'Table II.')
    >>> Row({**row, "kind": "distance"})
    Traceback (most recent call last):
    ValueError: unit must be m or km for 'distance', got 'rad'
    """

    def __init__(
        self, cells: Mapping[str, Any], on_access: Callable[[str], Any] = len
    ) -> None:
        self._cells = {key: _plain(value) for key, value in cells.items()}
        self._on_access = on_access
        _check_origin(cells)
        kind = cells.get("kind", "")
        unit = cells["unit"]
        # A kind that is not listed may have any unit, also this one.
        allowed = _UNITS.get(kind, (unit,))
        if unit not in allowed:
            raise ValueError(
                f"unit must be {' or '.join(allowed)} for {kind!r}, got {unit!r}"
            )

    def __getitem__(self, key: str) -> Any:
        if key not in self._cells:
            raise UnknownKey(
                f"row {self._cells['name']!r} has no column", key, list(self._cells)
            )
        self._on_access(key)
        return self._cells[key]

    def __getattr__(self, name: str) -> Any:
        # Private names must fail at once, or copying and pickling would recurse.
        if name.startswith("_") or name not in self._cells:
            raise AttributeError(name)
        return self[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._cells)

    def __len__(self) -> int:
        return len(self._cells)

    @property
    def why(self) -> str:
        """The place where it is given, or the reason for it, with the note."""
        return _why(self._cells)

    @property
    def value_columns(self) -> tuple[str, ...]:
        """The columns that hold values, without those of their origin."""
        return tuple(key for key in self._cells if key not in _ORIGIN)


@dataclass(frozen=True, eq=False, repr=False)
class Scenario:
    """Every parameter of a study; ``s["gain"]`` is a value. It is shown as a table.

    Parameters
    ----------
    paper, name : str
        The paper's key and the scenario's name.
    title : str
        Title of the study.
    parameters, notes : mapping from str to Parameter
        Values that the study reads, and values that only describe it: choices that are part of a
        method, and values of the paper that the study does not need.
    tables : mapping from str to tuple of Row
        The file's arrays of tables, such as ``agents``.
    accessed : set of str, optional
        Names of the cells that were read, recorded after `track_reads`.

    Examples
    --------
    >>> s = scenario("grange", "table-2")
    >>> s["gain"], s.parameter("dt_observe").unit, s.parameter("gain").source
    (0.05, 's', 'assumed')
    >>> s["initial_state"]
    array([100. ,   0. ,   0. ,  10. ,   0.1,   0. ])
    >>> s.adjacency
    array([[0., 1., 1.],
           [1., 0., 0.],
           [1., 0., 0.]])
    >>> s.replace(gain=0.1).changes
    ('gain: 0.1, not 0.05',)
    """

    paper: str
    name: str
    title: str
    parameters: Mapping[str, Parameter]
    notes: Mapping[str, Parameter]
    tables: Mapping[str, tuple[Row, ...]]
    accessed: set[str] | None = None

    def parameter(self, key: str) -> Parameter:
        """Return the parameter of that name."""
        if key not in self.parameters:
            lacks = (
                "keeps among its notes, which no study reads,"
                if key in self.notes
                else "lacks"
            )
            raise UnknownKey(
                f"scenario {self.paper}/{self.name} {lacks}", key, list(self)
            )
        return self.parameters[key]

    def __getitem__(self, key: str) -> Any:
        value = self.parameter(key).value
        # A list of texts stays a tuple.
        if not isinstance(value, tuple) or isinstance(value[0], str):
            return value
        # Numbers become an array that a study cannot change.
        array = np.array(value)
        array.setflags(write=False)
        return array

    def __iter__(self) -> Iterator[str]:
        return iter(self.parameters)

    @property
    def agents(self) -> tuple[Row, ...]:
        """The rows of the table ``agents``; none if it has no such table."""
        rows = self.tables.get("agents", ())
        if self.accessed is None:
            return rows
        # Reading a column of such a row adds it to the set.
        recording = []
        for row in rows:
            record = partial(_record_access, self.accessed, row._cells["name"])
            recording.append(Row(row._cells, record))
        return tuple(recording)

    @property
    def adjacency(self) -> NDArray[np.float64]:
        """The communication graph, (A, A): 1 for a link of ``neighbours``; no links to oneself."""
        # A paper may list an agent among its own neighbours: no link to itself.
        names = [row["name"] for row in self.agents]
        links = [[float(a in row["neighbours"]) for a in names] for row in self.agents]
        return np.array(links) * (1 - np.eye(len(names)))

    def replace(self, **values: Any) -> Scenario:
        """Return the scenario with other values of some parameters; their origins stay."""
        # `parameter` refuses a name that the scenario does not have.
        changed = {
            key: replace(self.parameter(key), value=value)
            for key, value in values.items()
        }
        return replace(self, parameters={**self.parameters, **changed})

    def track_reads(self) -> Scenario:
        """Return the same scenario, which records the cells of its agents that are read."""
        return replace(self, accessed=set())

    def cells(self) -> list[dict[str, Any]]:
        """Return the cells of each agent that were read, with its name."""
        accessed = self.accessed or set()
        rows = []
        for row in self.tables["agents"]:
            name = row["name"]
            cells = {"name": name}
            for column in row.value_columns:
                if f"{name}.{column}" in accessed:
                    cells[column] = row[column]
            rows.append(cells)
        return rows

    def entries(self) -> dict[str, str]:
        """Return every value that a study can read as JSON, without its origin."""
        entries = {}
        for parameter in self.parameters.values():
            entries[parameter.name] = f"{_json(parameter.value)} {parameter.unit}"
        for table, rows in self.tables.items():
            # The names, in order: adding or removing an agent is a change.
            entries[table] = _json([row["name"] for row in rows])
            for row in rows:
                for column in row.value_columns:
                    if column != "name":
                        entries[f"{table}.{row['name']}.{column}"] = _json(row[column])
        return entries

    @property
    def digest(self) -> str:
        """16 digits that depend on every value that a study can read, and on no text."""
        return hashlib.sha256(_json(self.entries()).encode()).hexdigest()[:16]

    @property
    def changes(self) -> tuple[str, ...]:
        """Differences from the accepted scenario; empty for the accepted one itself.

        ``scenarios/accepted.csv`` has a line for every entry of every accepted scenario. A scenario
        without lines there is one change.
        """
        accepted = {}
        for row in read_rows(data_root() / "scenarios" / "accepted.csv"):
            if (row["paper"], row["scenario"]) == (self.paper, self.name):
                accepted[row["entry"]] = row["value"]
        if not accepted:
            return (f"{self.paper}/{self.name} is no scenario of the book",)
        entries = self.entries()
        changes = []
        # Every name once, those of this scenario first.
        for name in entries | accepted:
            if entries.get(name) != accepted.get(name):
                value = _format_entry(entries, name)
                changes.append(f"{name}: {value}, not {_format_entry(accepted, name)}")
        return tuple(changes)

    def _table_data(self) -> list[tuple[list[str], list[list[str]]]]:
        origin = ["unit", "source", "where or why"]
        tables = []
        for head, entries in (("parameter", self.parameters), ("note", self.notes)):
            texts = [
                [p.name, _text(p.value), p.unit, p.source, p.why]
                for p in entries.values()
            ]
            tables += [([head, "value", *origin], texts)] if texts else []
        for name, rows in self.tables.items():
            # The union of all rows' columns, in the order in which they appear.
            columns = list(dict.fromkeys(c for row in rows for c in row.value_columns))
            # Name and unit have columns of their own, at fixed places.
            columns = [c for c in columns if c not in ("name", "unit")]
            texts = [
                [
                    row["name"],
                    *(_text(row.get(c, "")) for c in columns),
                    row["unit"],
                    row["source"],
                    row.why,
                ]
                for row in rows
            ]
            tables.append(([name, *columns, *origin], texts))
        return tables

    def __repr__(self) -> str:
        return f"{self.paper}/{self.name}: {self.title}\n\n{self._repr_markdown_()}"

    def _repr_html_(self) -> str:
        return "\n".join(html_table(*t) for t in self._table_data())

    def _repr_markdown_(self) -> str:
        return "\n\n".join(markdown_table(*t) for t in self._table_data())


def _record_access(accessed: set[str], name: str, column: str) -> None:
    accessed.add(f"{name}.{column}")


def _json(value: Any) -> str:
    return json.dumps(value, ensure_ascii=False, sort_keys=isinstance(value, dict))


def _format_entry(entries: Mapping[str, str], name: str) -> str:
    """Return an entry without quotes and without the unit 1."""
    value = entries.get(name, "absent")
    return value.removesuffix(" 1").removesuffix(" -").replace('"', "")


def _text(value: Any) -> str:
    if isinstance(value, tuple):
        return ", ".join(
            f"({_text(v)})" if isinstance(v, tuple) else _text(v) for v in value
        )
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:g}" if isinstance(value, float) else str(value)


def read_scenario(path: Path) -> Scenario:
    """Read a scenario from a TOML file; an error names the file and the entry.

    The file has a ``title``, one table ``[parameters.NAME]`` for each parameter that the study
    reads, one table ``[notes.NAME]`` of the same form for each value that no study reads, and any
    arrays of tables, such as one ``[[agents]]`` for each agent (see `Row`). Folder and file have
    the names of paper and scenario.
    """
    folder = path.parent
    # The entry that an error names; before the first one, the form of the file
    entry = "its form"
    try:
        # Every error below is raised again with the file's and the entry's name.
        data = tomllib.loads(path.read_text(encoding="utf-8"))
        title = data.pop("title")
        groups: dict[str, dict[str, Parameter]] = {"parameters": {}, "notes": {}}
        for group in groups:
            # Arrays of tables remain in `data`.
            for name, cells in data.pop(group, {}).items():
                entry = f"[{group}.{name}]"
                groups[group][name] = Parameter(name, **cells)
        tables: dict[str, tuple[Row, ...]] = {}
        for entry, rows in data.items():
            tables[entry] = tuple(Row(cells) for cells in rows)
            # Equal names would leave fewer keys than rows.
            _check_links({row["name"]: row for row in tables[entry]}, len(rows))
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise ValueError(f"{folder.name}/{path.name}: {entry}: {error}") from error
    return Scenario(
        folder.name, path.stem, title, groups["parameters"], groups["notes"], tables
    )


def _check_links(rows: Mapping[str, Row], count: int) -> None:
    if len(rows) != count:
        raise ValueError("names must be distinct")
    for name, row in rows.items():
        for other in row.get("neighbours", ()):
            if other not in rows or name not in rows[other]["neighbours"]:
                raise ValueError(
                    f"neighbours must be mutual, got {other!r} for {name!r} only"
                )


def scenario(paper: str, name: str) -> Scenario:
    """Return the scenario of a paper's study, from ``scenarios/PAPER/NAME.toml``.

    Examples
    --------
    >>> [agent.kind for agent in scenario("grange", "table-2").agents]
    ['component', 'line_angle', 'component']
    """
    return read_scenario(inside(data_root() / "scenarios", paper, name, ".toml"))
