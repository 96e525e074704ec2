"""Scenario files: TOML in, a `Scenario` out, and every fault with its line."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Callable
from dataclasses import MISSING, fields
from pathlib import Path
from typing import Any, TypeVar

from distfilt.checks import choice

from ..folders import data_root
from ._files import fault, named_file, read_text
from .parts import Parameter, Row, link_fault
from .specs import Scenario
from .tables import PAPERS

__all__ = ["read_scenario", "scenario"]

_GROUPS = ("parameters", "notes")
_T = TypeVar("_T")


def _line(text: str, header: str, nth: int, key: str) -> int:
    """Line of a key under the nth header of that name; the header's, else 1, if it is not there."""
    lines = text.splitlines()
    heads = [
        k for k, line in enumerate(lines) if re.match(rf"\s*{re.escape(header)}\s*(#|$)", line)
    ]
    if nth >= len(heads):
        return 1
    for k in range(heads[nth] + 1, len(lines)):
        if lines[k].lstrip().startswith("["):
            break
        if re.match(rf"\s*{re.escape(key)}\s*=", lines[k]):
            return k + 1
    return heads[nth] + 1


def _parameter(path: Path, text: str, header: str, name: str, given: Any) -> Parameter:
    """A `Parameter` from its table in the file; faults name file and line."""
    known = {f.name: f.default is MISSING for f in fields(Parameter)}
    for key in given:
        if key not in known:
            line = _line(text, header, 0, key)
            raise fault(path, line, f"{header} has an unknown key {key!r}")
    missing = [k for k, needed in known.items() if needed and k not in given and k != "name"]
    if missing:
        raise fault(path, _line(text, header, 0, ""), f"{header} needs {', '.join(missing)}")
    return _made(path, text, header, 0, lambda: Parameter(name, **given))


def _made(path: Path, text: str, header: str, nth: int, make: Callable[[], _T]) -> _T:
    try:
        return make()
    except ValueError as error:
        line = _line(text, header, nth, str(error).split(":")[0])
        raise fault(path, line, f"{header} {error}") from None


def read_scenario(path: str | Path) -> Scenario:
    """Read a scenario from a TOML file.

    The file has a ``title``, one table ``[parameters.NAME]`` for each parameter that the study
    reads with ``value``, ``unit``, ``source`` and ``where`` (if given) or ``reason``, one table
    ``[notes.NAME]`` of the same form for what no study can read, and any arrays of tables, such as
    one ``[[agents]]`` for each agent (see `Row`). The folder's name becomes the paper, the file's
    the name.

    Parameters
    ----------
    path : str or Path
        A UTF-8 file.

    Raises
    ------
    ValueError
        With file and line, if the TOML is malformed, a key is missing, unknown or wrong, a unit
        does not fit its kind, or an agent's neighbours are unknown or not mutual.

    Examples
    --------
    >>> from bookkit.published import root
    >>> read_scenario(root() / "scenarios" / "grange" / "table-3.toml")["members"]
    200
    """
    source, text = read_text(path)
    data = _load(source, text)
    groups = {
        group: tuple(
            _parameter(source, text, f"[{group}.{name}]", name, entries)
            for name, entries in data.get(group, {}).items()
        )
        for group in _GROUPS
    }
    twice = {p.name for p in groups["parameters"]} & {p.name for p in groups["notes"]}
    for name in sorted(twice):
        header = f"[notes.{name}]"
        raise fault(source, _line(text, header, 0, ""), f"{header} is a parameter already")
    tables = {
        name: _rows(source, text, name, data[name])
        for name in data
        if name not in ("title", *_GROUPS)
    }
    title, named = data["title"], (source.parent.name, source.stem)
    return Scenario(*named, title, groups["parameters"], notes=groups["notes"], tables=tables)


def _rows(path: Path, text: str, name: str, blocks: list[Any]) -> tuple[Row, ...]:
    """One table's rows, which name each other rightly."""
    header = f"[[{name}]]"
    rows = tuple(
        _made(path, text, header, k, lambda block=block: Row(block))  # type: ignore[misc]
        for k, block in enumerate(blocks)
    )
    found = link_fault(rows)
    if found is not None:
        raise fault(path, _line(text, header, found[0], found[1]), found[2])
    return rows


def _load(source: Path, text: str) -> dict[str, Any]:
    """The file as TOML of the right outline."""
    try:
        data = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        at = re.search(r"at line (\d+)", str(error))
        line = int(at[1]) if at else text.rstrip().count("\n") + 1
        raise fault(source, line, f"needs well-formed TOML: {error}") from None
    if not isinstance(data.get("title"), str) or not data["title"].strip():
        raise fault(source, 1, "needs a title")
    if "parameters" not in data:
        raise fault(source, 1, "needs parameters, each as [parameters.NAME]")
    for key in (key for key in data if key != "title"):
        start = re.compile(rf"\s*\[*\s*{re.escape(key)}\b")
        near = next((k for k, t in enumerate(text.splitlines(), 1) if start.match(t)), 1)
        if key in _GROUPS:
            tables = data[key]
            if not isinstance(tables, dict) or not all(map(_is_table, tables.values())):
                raise fault(source, near, f"needs {key}, each as [{key}.NAME]")
            for name, entries in tables.items():
                header = f"[{key}.{name}]"
                if "name" in entries:
                    line = _line(text, header, 0, "name")
                    raise fault(source, line, f"{header} has a name already in its header")
        elif not isinstance(data[key], list) or not all(map(_is_table, data[key])):
            raise fault(source, near, f"has {key!r}, needs title, [parameters.NAME], "
                        f"[notes.NAME] or rows, each as [[{key}]]")  # fmt: skip
    return data


def _is_table(value: Any) -> bool:
    return isinstance(value, dict)


def scenario(paper: str, name: str) -> Scenario:
    """The scenario of a paper's study, from ``scenarios/KEY/NAME.toml``.

    Parameters
    ----------
    paper, name : str
        One of `PAPERS` and the scenario's, such as ``table-2``.

    Examples
    --------
    >>> [agent.kind for agent in scenario("grange", "table-2").agents]
    ['direct', 'angle', 'direct']
    """
    folder = data_root() / "scenarios" / choice(paper, "paper", PAPERS)
    return read_scenario(named_file(folder, name, ".toml"))
