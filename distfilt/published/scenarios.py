"""Scenario files: TOML in, a `Scenario` out, and every fault with its line."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Mapping
from dataclasses import MISSING, fields
from pathlib import Path
from typing import Any

from ..checks import choice
from ._files import data_root, fault, named_file, read_text
from .specs import AgentSpec, Parameter, Scenario, link_fault
from .tables import PAPERS

__all__ = ["read_scenario", "scenario"]


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


def _build(
    path: Path, text: str, header: str, nth: int, kind: type[Any], given: Mapping[str, Any]
) -> Any:
    """A `Parameter` or `AgentSpec` from its table in the file; faults name file and line."""
    known = {field.name: field.default is MISSING for field in fields(kind)}
    for key in given:
        if key not in known:
            line = _line(text, header, nth, key)
            raise fault(path, line, f"{header} has an unknown key {key!r}")
    missing = [key for key, needed in known.items() if needed and key not in given]
    if missing:
        line = _line(text, header, nth, missing[0])
        raise fault(path, line, f"{header} needs {', '.join(missing)}")
    try:
        return kind(**given)
    except ValueError as error:
        line = _line(text, header, nth, str(error).split(":")[0])
        raise fault(path, line, f"{header} {error}") from None


def read_scenario(path: str | Path) -> Scenario:
    """Read a scenario from a TOML file.

    The file has a ``title``, one table ``[parameters.NAME]`` for each parameter with ``value``,
    ``unit``, ``source`` and ``where`` (if given) or ``reason``, and one ``[[agents]]`` for each
    agent. The folder's name becomes the paper, the file's the name.

    Parameters
    ----------
    path : str or Path
        A UTF-8 file.

    Returns
    -------
    Scenario

    Raises
    ------
    ValueError
        With file and line, if the TOML is malformed, a key is missing, unknown or wrong, or an
        agent's neighbours are unknown or not mutual.

    Examples
    --------
    >>> from distfilt.published import root
    >>> read_scenario(root() / "scenarios" / "grange" / "table-3.toml")["members"]
    200
    """
    source, text = read_text(path)
    data = _load(source, text)
    parameters = tuple(
        _build(source, text, f"[parameters.{name}]", 0, Parameter, {"name": name, **entries})
        for name, entries in data["parameters"].items()
    )
    agents = tuple(
        _build(source, text, "[[agents]]", k, AgentSpec, entries)
        for k, entries in enumerate(data.get("agents", []))
    )
    found = link_fault(agents)
    if found is not None:
        raise fault(source, _line(text, "[[agents]]", found[0], found[1]), found[2])
    return Scenario(source.parent.name, source.stem, data["title"], parameters, agents)


def _load(source: Path, text: str) -> dict[str, Any]:
    """The file as TOML of the right outline."""
    try:
        data = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        at = re.search(r"at line (\d+)", str(error))
        line = int(at[1]) if at else text.rstrip().count("\n") + 1
        raise fault(source, line, f"needs well-formed TOML: {error}") from None
    for key in sorted(data.keys() - {"title", "parameters", "agents"}):
        start = re.compile(rf"\s*\[*\s*{re.escape(key)}\b")
        near = next((k for k, t in enumerate(text.splitlines(), 1) if start.match(t)), 1)
        raise fault(source, near, f"has an unknown entry {key!r}")
    if not isinstance(data.get("title"), str) or not data["title"].strip():
        raise fault(source, 1, "needs a title")
    tables, blocks = data.get("parameters"), data.get("agents", [])
    if not isinstance(tables, dict) or not all(isinstance(t, dict) for t in tables.values()):
        raise fault(source, 1, "needs parameters, each as [parameters.NAME]")
    for name, entries in tables.items():
        if "name" in entries:
            line = _line(text, f"[parameters.{name}]", 0, "name")
            raise fault(source, line, f"[parameters.{name}] has a name already in its header")
    if not isinstance(blocks, list) or not all(isinstance(b, dict) for b in blocks):
        raise fault(source, 1, "needs agents, each as [[agents]]")
    return data


def scenario(paper: str, name: str) -> Scenario:
    """The scenario of a paper's study, from ``scenarios/KEY/NAME.toml``.

    Parameters
    ----------
    paper : {"grange", "das", "semeraro", "zheng"}
        The paper's key.
    name : str
        Such as ``table-2``.

    Returns
    -------
    Scenario

    Examples
    --------
    >>> [agent.kind for agent in scenario("grange", "table-2").agents]
    ['direct', 'angle', 'direct']
    """
    folder = data_root() / "scenarios" / choice(paper, "paper", PAPERS)
    return read_scenario(named_file(folder, name, ".toml"))
