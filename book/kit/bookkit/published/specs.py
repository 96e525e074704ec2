"""A scenario: every parameter of a study, what was changed in it, and what a study read of it."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from distfilt.checks import Array, array, nonblank

from ._files import html_table, markdown_table, text_table
from .parts import ORIGIN, Parameter, Row, UnknownKey, link_fault, nearest, plain
from .tables import accepted

__all__ = ["Reading", "Scenario"]

_AGENTS = "agents"


@dataclass(frozen=True, repr=False)
class Scenario:
    """Every parameter of a study; ``s["gain"]`` is a value. It prints as a table.

    Parameters
    ----------
    paper, name : str
        The paper's key and the scenario's name.
    title : str
        What is studied.
    parameters : tuple of Parameter
        What the study reads, in the file's order.
    notes : tuple of Parameter
        What describes the study but is read by nothing: choices that are built into a method, and
        values of the paper that ours does not need. They print, but ``s["name"]`` refuses them.
    tables : mapping from str to tuple of Row
        The file's arrays of tables, such as ``agents``.

    Examples
    --------
    >>> from bookkit.published import scenario
    >>> s = scenario("grange", "table-2")
    >>> s["gain"], s.unit("dt_observe"), s.source("gain")
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
    parameters: tuple[Parameter, ...]
    notes: tuple[Parameter, ...] = field(default=(), kw_only=True)
    tables: Mapping[str, tuple[Row, ...]] = field(default_factory=dict, kw_only=True)

    def __post_init__(self) -> None:
        for name in ("paper", "name", "title"):
            nonblank(getattr(self, name), name)
        names = [p.name for p in (*self.parameters, *self.notes)]
        if len(set(names)) != len(names):
            raise ValueError("parameters: needs distinct names, those of the notes included")
        for name, rows in self.tables.items():
            found = link_fault(tuple(rows))
            if found is not None:
                raise ValueError(f"{name}: {found[2]}")

    def parameter(self, key: str) -> Parameter:
        """The parameter of that name."""
        named = {p.name: p for p in self.parameters}
        if key in named:
            return named[key]
        here = f"scenario {self.paper}/{self.name}"
        if any(p.name == key for p in self.notes):
            raise UnknownKey(f"key: {here} has {key!r} among its notes, which no study reads")
        raise UnknownKey(
            f"key: {here} has no parameter {key!r}; nearest: {nearest(key, list(named))}"
        )

    def __getitem__(self, key: str) -> Any:
        value = self.parameter(key).value
        if not isinstance(value, tuple) or isinstance(value[0], str):
            return value
        out = np.array(value)
        out.setflags(write=False)
        return out

    def __contains__(self, key: object) -> bool:
        return any(p.name == key for p in self.parameters)

    def __iter__(self) -> Iterator[str]:
        return (p.name for p in self.parameters)

    def unit(self, key: str) -> str:
        """Unit of a parameter."""
        return self.parameter(key).unit

    def source(self, key: str) -> str:
        """Whether a parameter is given, inferred or assumed."""
        return self.parameter(key).source

    def rows(self, table: str = _AGENTS) -> tuple[Row, ...]:
        """The rows of one of its tables, in the file's order."""
        if table not in self.tables:
            raise UnknownKey(
                f"table: scenario {self.paper}/{self.name} has no table {table!r}; nearest: "
                f"{nearest(table, list(self.tables))}"
            )
        return tuple(self.tables[table])

    @property
    def agents(self) -> tuple[Row, ...]:
        """The rows of the table ``agents``; none if it has no such table."""
        return self.rows() if _AGENTS in self.tables else ()

    @property
    def adjacency(self) -> Array:
        """Who talks to whom, (A, A): 1 or 0, without links to oneself; from ``neighbours``."""
        names = [row["name"] for row in self.agents]
        out = np.zeros((len(names), len(names)))
        for i, agent in enumerate(self.agents):
            for other in agent["neighbours"]:
                out[i, names.index(other)] = other != agent["name"]
        return out

    def replace(self, **values: Any) -> Scenario:
        """The scenario with other values of some parameters; units and places stay.

        >>> from bookkit.published import scenario
        >>> scenario("grange", "table-2").replace(members=50)["members"]
        50
        """
        made = {key: replace(self.parameter(key), value=value) for key, value in values.items()}
        kept = tuple(made.get(p.name, p) for p in self.parameters)
        return replace(self, parameters=kept)

    def replace_row(self, name: str, *, table: str = _AGENTS, **cells: Any) -> Scenario:
        """The scenario with other cells in one row.

        >>> from bookkit.published import scenario
        >>> s = scenario("grange", "table-2").replace_row("B", kind="range", unit="m")
        >>> s.changes
        ('agents.B.kind: range, not angle', 'agents.B.unit: m, not rad')
        """
        rows = {row["name"]: row for row in self.rows(table)}
        if name not in rows:
            raise UnknownKey(f"name: table {table} has no row {name!r}; nearest: "
                             f"{nearest(name, list(rows))}")  # fmt: skip
        rows[name] = Row({**rows[name], **cells})
        return replace(self, tables={**self.tables, table: tuple(rows.values())})

    def replace_adjacency(self, adjacency: ArrayLike) -> Scenario:
        """The scenario with other links between its agents.

        Parameters
        ----------
        adjacency : array_like, (A, A)
            Nonzero where two agents talk, symmetric; every agent stays among its own neighbours.

        Examples
        --------
        >>> from bookkit.published import scenario
        >>> s = scenario("grange", "table-2").replace_adjacency([[0, 1, 1], [1, 0, 1], [1, 1, 0]])
        >>> s.changes[0]
        'agents.B.neighbours: [A, B, C], not [A, B]'
        """
        names = [row["name"] for row in self.agents]
        links = array(adjacency, "adjacency", (len(names), len(names)))
        if (links != links.T).any():
            raise ValueError("adjacency: needs a symmetric matrix, got links that go one way")
        heard = links.astype(bool) | np.eye(len(names), dtype=bool)
        rows = tuple(
            Row({**row, "neighbours": [n for n, yes in zip(names, line, strict=True) if yes]})
            for row, line in zip(self.tables[_AGENTS], heard, strict=True)
        )
        return replace(self, tables={**self.tables, _AGENTS: rows})

    def entries(self) -> dict[str, str]:
        """Everything that a study can read, each as JSON: the values, not where they come from."""
        out = {p.name: f"{_json(p.value)} {p.unit}" for p in self.parameters}
        for table, rows in self.tables.items():
            out[table] = _json([row["name"] for row in rows])
            for row in rows:
                cells = {c: row[c] for c in row.value_columns if c != "name"}
                out |= {f"{table}.{row['name']}.{c}": _json(v) for c, v in cells.items()}
        return out

    @property
    def digest(self) -> str:
        """16 digits that change with every value that a study can read, and with no text."""
        return hashlib.sha256(_json(self.entries()).encode()).hexdigest()[:16]

    @property
    def changes(self) -> tuple[str, ...]:
        """What differs from the paper's study as the book accepts it; empty for that study itself.

        A scenario of a reader's own, which the book does not know, is one change.
        """
        known, found = accepted(self.paper, self.name), self.entries()
        if not known:
            return (f"{self.paper}/{self.name} is no scenario of the book",)
        names = [*found, *(name for name in known if name not in found)]
        return tuple(
            f"{name}: {_said(found, name)}, not {_said(known, name)}"
            for name in names
            if found.get(name) != known.get(name)
        )

    @property
    def changed(self) -> bool:
        """Whether it differs from the paper's study as the book accepts it."""
        return bool(self.changes)

    def reading(self) -> Reading:
        """The same scenario, which remembers what was read of it."""
        return Reading(
            self.paper, self.name, self.title, self.parameters, notes=self.notes, tables=self.tables
        )

    def _shown(self) -> list[tuple[Sequence[str], list[Sequence[str]]]]:
        heads = ("unit", "source", "where or why")
        out: list[tuple[Sequence[str], list[Sequence[str]]]] = []
        for head, entries in (("parameter", self.parameters), ("note", self.notes)):
            lines = [(p.name, _plain_text(p.value), p.unit, p.source, p.why) for p in entries]
            if lines:
                out.append(((head, "value", *heads), list(lines)))
        for name, rows in self.tables.items():
            columns = list(dict.fromkeys(c for row in rows for c in row.value_columns))
            columns = [c for c in columns if c not in ("name", "unit")]
            cells = [
                (row["name"], *(_plain_text(row.get(c, "")) for c in columns))
                + (row["unit"], row["source"], row.why)
                for row in map(_still, rows)
            ]
            out.append(((name, *columns, *heads), list(cells)))
        return out

    def __repr__(self) -> str:
        head = f"{self.paper}/{self.name}: {self.title}"
        return "\n".join([head, *(text_table(*t) for t in self._shown())])

    def _repr_html_(self) -> str:
        return "\n".join(html_table(*t) for t in self._shown())

    def _repr_markdown_(self) -> str:
        return "\n\n".join(markdown_table(*t) for t in self._shown())


class _ReadRow(Row):
    """A row that notes which of its columns are read."""

    __slots__ = ("_seen",)

    def __init__(self, cells: Mapping[str, Any], seen: set[str] | None = None) -> None:
        super().__init__(cells)
        object.__setattr__(self, "_seen", set() if seen is None else seen)

    def __getitem__(self, key: str) -> Any:
        value = super().__getitem__(key)
        if key not in ORIGIN:
            self._seen.add(key)
        return value


@dataclass(frozen=True, repr=False)
class Reading(Scenario):
    """A scenario that remembers what was read of it; `Scenario.reading` makes one.

    It is read as a `Scenario` is. `used` and `unread` say which values were taken; printing takes
    none. A copy that travels to a worker process remembers there, not here: take what a trial
    needs before the study starts.

    >>> from bookkit.published import scenario
    >>> s = scenario("grange", "table-2").reading()
    >>> gain, noise = s["gain"], s.agents[1].noise
    >>> s.used
    ('gain', 'agents.B.noise')
    >>> "members" in s.unread
    True
    """

    _seen: dict[str, set[str]] = field(default_factory=dict, kw_only=True, compare=False)

    def __getitem__(self, key: str) -> Any:
        value = super().__getitem__(key)
        self._seen.setdefault("", set()).add(key)
        return value

    def rows(self, table: str = _AGENTS) -> tuple[Row, ...]:
        """The rows of one of its tables; each notes what is read of it."""
        plain_rows = super().rows(table)
        return tuple(
            _ReadRow(row, self._seen.setdefault(f"{table}.{row['name']}", set()))
            for row in map(_still, plain_rows)
        )

    @property
    def used(self) -> tuple[str, ...]:
        """The entries that were read: parameters, then ``table.row.column``."""
        return tuple(name for name in self._names() if self._was_read(name))

    @property
    def unread(self) -> tuple[str, ...]:
        """The entries that were not read."""
        return tuple(name for name in self._names() if not self._was_read(name))

    def cells(self, table: str = _AGENTS) -> tuple[dict[str, Any], ...]:
        """What was read of each row, with its name; reading it here does not count."""
        return tuple(
            {"name": row["name"]}
            | {c: row[c] for c in row.value_columns if self._was_read(f"{table}.{row['name']}.{c}")}
            for row in map(_still, super().rows(table))
        )

    def _names(self) -> list[str]:
        out = [p.name for p in self.parameters]
        for table, rows in self.tables.items():
            for row in map(_still, rows):
                columns = [c for c in row.value_columns if c not in ("name", "unit")]
                out += [f"{table}.{row['name']}.{c}" for c in columns]
        return out

    def _was_read(self, name: str) -> bool:
        place, _, column = name.rpartition(".")
        return column in self._seen.get(place, set())


def _still(row: Row) -> Row:
    """The row without a memory."""
    return Row(row._cells) if isinstance(row, _ReadRow) else row


def _json(value: Any) -> str:
    return json.dumps(value, ensure_ascii=False, sort_keys=isinstance(value, dict))


def _said(entries: Mapping[str, str], name: str) -> str:
    """An entry as a change prints it: without quotes and without the unit 1."""
    value = entries.get(name, "absent")
    return value.removesuffix(" 1").removesuffix(" -").replace('"', "")


def _plain_text(value: Any) -> str:
    value = plain(value) if value != "" else ""
    if isinstance(value, tuple):
        inner = (f"({_plain_text(v)})" if isinstance(v, tuple) else _plain_text(v) for v in value)
        return ", ".join(inner)
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:g}" if isinstance(value, float) else str(value)
