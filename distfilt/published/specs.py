"""What a scenario holds: parameters with unit and source, agents, and the table it prints as."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from typing import Any

import numpy as np

from ..checks import Array, choice, count, number
from ._files import html_table, markdown_table, text_table

__all__ = ["AgentSpec", "Parameter", "Scenario", "UnknownKey"]

_SOURCES = ("given", "inferred", "assumed")
_KINDS = ("direct", "angle", "range", "differential")
_NAME = re.compile(r"[a-z][a-z0-9_]*")


class UnknownKey(KeyError, ValueError):
    """A scenario has no parameter of that name; the message lists the nearest names.

    Examples
    --------
    >>> from distfilt.published import scenario
    >>> try:
    ...     scenario("grange", "table-2")["gian"]
    ... except UnknownKey as error:
    ...     print(error)
    key: scenario grange/table-2 has no parameter 'gian'; nearest: gain, angle
    """

    def __str__(self) -> str:  # KeyError would print the message in quotes
        return str(self.args[0])


def _text(value: Any, name: str) -> str:
    if not isinstance(value, str) or not value.strip():
        raise ValueError(f"{name}: needs a text, got {value!r}")
    return value


def _check_origin(unit: Any, source: Any, where: Any, reason: Any) -> None:
    """What is given says where, and what is not says why."""
    _text(unit, "unit")
    choice(source, "source", _SOURCES)
    needed, text = ("where", where) if source == "given" else ("reason", reason)
    _text(text, needed)
    for name, value in (("where", where), ("reason", reason)):
        if not isinstance(value, str):
            raise ValueError(f"{name}: needs a text, got {value!r}")


def _plain(value: Any) -> Any:
    """A TOML value as a scalar or as (nested) tuples, checked."""
    if isinstance(value, bool):
        return value
    if isinstance(value, str):
        return _text(value, "value")
    if isinstance(value, int | float):
        number(value, "value")
        return value
    if not isinstance(value, list | tuple) or not value:
        raise ValueError(f"value: needs a number, a text or a list of them, got {value!r}")
    inner = tuple(_plain(v) for v in value)
    if all(isinstance(v, str) for v in inner):
        return inner
    if any(isinstance(v, bool | str) for v in inner):
        raise ValueError(f"value: needs a list of numbers or of texts, got {value!r}")
    try:
        np.array(inner, dtype=float)
    except ValueError:
        raise ValueError(f"value: needs numbers in rows of one length, got {value!r}") from None
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
        object.__setattr__(self, "value", _plain(self.value))
        _check_origin(self.unit, self.source, self.where, self.reason)
        if not isinstance(self.note, str):
            raise ValueError(f"note: needs a text, got {self.note!r}")

    @property
    def why(self) -> str:
        """Where it is given, or the reason for it; with the note."""
        return " ".join(t for t in (self.reason or f"{self.where}.", self.note) if t)


@dataclass(frozen=True)
class AgentSpec:
    """One agent of a study, as a row of the paper's table.

    Parameters
    ----------
    name : str
        Its name.
    dims : tuple of int
        The state's components that it sees, counted from 0.
    kind : {"direct", "angle", "range", "differential"}
        What it sees of them.
    noise : float
        Standard deviation of a reading, in `unit`, positive.
    neighbours : tuple of str
        Whom it hears, as printed: usually itself too.
    unit, source, where, reason : str
        As of a `Parameter`.

    Examples
    --------
    >>> AgentSpec("B", (1, 2), "angle", 0.2, ("A", "B"), "rad", "given", "Table II").kind
    'angle'
    """

    name: str
    dims: tuple[int, ...]
    kind: str
    noise: float
    neighbours: tuple[str, ...]
    unit: str
    source: str
    where: str = ""
    reason: str = ""

    def __post_init__(self) -> None:
        _text(self.name, "name")
        for name in ("dims", "neighbours"):
            value = getattr(self, name)
            if not isinstance(value, list | tuple) or len(set(map(str, value))) != len(value):
                raise ValueError(f"{name}: needs a list without repeats, got {value!r}")
            object.__setattr__(self, name, tuple(value))
        for k in self.dims:
            count(k, "dims", at_least=0)
        if not self.dims:
            raise ValueError("dims: needs at least one component, got none")
        for other in self.neighbours:
            _text(other, "neighbours")
        choice(self.kind, "kind", _KINDS)
        number(self.noise, "noise", above=0)
        _check_origin(self.unit, self.source, self.where, self.reason)


def link_fault(agents: tuple[AgentSpec, ...]) -> tuple[int, str, str] | None:
    """Position, key and message of the first fault in names and neighbours, or None."""
    by_name: dict[str, AgentSpec] = {}
    for k, agent in enumerate(agents):
        if agent.name in by_name:
            return k, "name", f"needs distinct agents, got {agent.name!r} again"
        by_name[agent.name] = agent
    for k, agent in enumerate(agents):
        for other in agent.neighbours:
            if other not in by_name:
                return k, "neighbours", f"needs known agents, got {other!r} beside {agent.name!r}"
            if agent.name not in by_name[other].neighbours and other != agent.name:
                text = f"{agent.name!r} names {other!r}, which does not name it"
                return k, "neighbours", f"needs mutual neighbours; {text}"
    return None


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
        In the file's order.
    agents : tuple of AgentSpec
        In the file's order; may be empty.

    Examples
    --------
    >>> from distfilt.published import scenario
    >>> s = scenario("grange", "table-2")
    >>> s["gain"], s.unit("dt_observe"), s.source("gain")
    (0.05, 's', 'assumed')
    >>> s["initial_state"]
    array([100. ,   0. ,   0. ,  10. ,   0.1,   0. ])
    >>> s.adjacency
    array([[0., 1., 1.],
           [1., 0., 0.],
           [1., 0., 0.]])
    """

    paper: str
    name: str
    title: str
    parameters: tuple[Parameter, ...]
    agents: tuple[AgentSpec, ...] = ()

    def __post_init__(self) -> None:
        for field in ("paper", "name", "title"):
            _text(getattr(self, field), field)
        names = [p.name for p in self.parameters]
        if len(set(names)) != len(names):
            raise ValueError("parameters: needs distinct names")
        found = link_fault(self.agents)
        if found is not None:
            raise ValueError(f"agents: {found[2]}")

    def parameter(self, key: str) -> Parameter:
        """The parameter of that name."""
        names = [p.name for p in self.parameters]
        if key in names:
            return self.parameters[names.index(key)]
        near = get_close_matches(str(key), names, n=3, cutoff=0.4) or names[:3]
        raise UnknownKey(
            f"key: scenario {self.paper}/{self.name} has no parameter {key!r}; "
            f"nearest: {', '.join(near) or 'none'}"
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

    def reason(self, key: str) -> str:
        """Why a parameter has its value, or where the paper gives it."""
        return self.parameter(key).why

    @property
    def adjacency(self) -> Array:
        """Who talks to whom, (A, A): 1 or 0, without links to oneself."""
        names = [a.name for a in self.agents]
        out = np.zeros((len(names), len(names)))
        for i, agent in enumerate(self.agents):
            for other in agent.neighbours:
                out[i, names.index(other)] = other != agent.name
        return out

    def _tables(self) -> list[tuple[Sequence[str], list[Sequence[str]]]]:
        why = "where or why"
        heads = ("agent", "sees", "components", "noise", "unit", "hears", "source", why)
        rows: list[Sequence[str]] = [
            (p.name, _shown(p.value), p.unit, p.source, p.why) for p in self.parameters
        ]
        agents: list[Sequence[str]] = [
            (a.name, a.kind, _shown(a.dims), _shown(a.noise), a.unit, " ".join(a.neighbours))
            + (a.source, a.reason or a.where)
            for a in self.agents
        ]
        first: tuple[Sequence[str], list[Sequence[str]]]
        first = ("parameter", "value", "unit", "source", why), rows
        return [first, (heads, agents)] if agents else [first]

    def __repr__(self) -> str:
        head = f"{self.paper}/{self.name}: {self.title}"
        return "\n".join([head, *(text_table(*t) for t in self._tables())])

    def _repr_html_(self) -> str:
        return "\n".join(html_table(*t) for t in self._tables())

    def _repr_markdown_(self) -> str:
        return "\n\n".join(markdown_table(*t) for t in self._tables())


def _shown(value: Any) -> str:
    if isinstance(value, tuple):
        return ", ".join(f"({_shown(v)})" if isinstance(v, tuple) else _shown(v) for v in value)
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:g}" if isinstance(value, float) else str(value)
