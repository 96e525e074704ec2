"""Long studies as files: one row a trial, written to the last digit and read strictly."""

from __future__ import annotations

import json
import os
import re
import uuid
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.random import SeedSequence
from numpy.typing import NDArray

from distfilt.checks import Array, callable_, choice, count, instance

from ..folders import data_root
from ._worker import versions
from .seeds import POOL_SIZE, Recipe
from .sources import fingerprints
from .study import DIED, LATE, Study, column_names, row

__all__ = ["Stored", "load", "store", "stored"]

_FORMAT = "# distfilt study, format 2"
_TRIALS = re.compile(r"# trials ([1-9][0-9]*)")
_FIRST = ("index", "entropy", "spawn_key", "failure")
_HEADER = re.compile(r"# (version|code|parameter) ([^\s:]+): (.+)")


@dataclass(frozen=True, eq=False)
class Stored:
    """A study read from a file.

    Parameters
    ----------
    path : Path
        Where it was read.
    parameters : mapping
        The study's parameters.
    versions, code : mapping from str to str
        Versions of Python, numpy and this library, and `fingerprint` of the functions named.
    recipes : tuple of Recipe
        What makes each trial's seed.
    failures : tuple of str
        For each trial the class of what it raised, or ''.
    columns : mapping from str to array, (n,)
        The metrics of all trials; NaN for a trial that failed (and where the metric is NaN).
    """

    path: Path
    parameters: Mapping[str, Any]
    versions: Mapping[str, str]
    code: Mapping[str, str]
    recipes: tuple[Recipe, ...]
    failures: tuple[str, ...]
    columns: Mapping[str, Array]

    def __len__(self) -> int:
        return len(self.recipes)

    def __repr__(self) -> str:
        failed = len(self) - int(self.done.sum())
        return f"Stored({self.path.name}: {len(self)} trials, {failed} failed)"

    @property
    def done(self) -> NDArray[np.bool_]:
        """Which trials returned a value, (n,)."""
        return np.array([not kind for kind in self.failures], dtype=bool)

    def metric(self, column: str) -> Array:
        """A metric of the trials that are done, (done,)."""
        return self.columns[choice(column, "column", self.columns)][self.done]

    def seed(self, index: int) -> SeedSequence:
        """The seed of a trial, made afresh."""
        if count(index, "index", at_least=0) >= len(self):
            raise ValueError(f"index: needs one of {len(self)} trials, got {index}")
        return self.recipes[index].seed()


def store(
    study: Study, path: str | Path, *, parameters: Mapping[str, Any], columns: Sequence[str],
    code: Iterable[Callable[..., Any]] = (),
) -> Path:
    """Write a study's metrics to a CSV file: the same study gives the same bytes.

    Lines that begin with ``#`` say how many trials follow, with which versions it was made, the
    `fingerprint` of the trial and of the functions in `code`, and the parameters as JSON. Then one
    row a trial: its index,
    the entropy and the spawn key of its seed, the class of what it raised or nothing, and the
    metrics with as many digits as give the same float back.

    Parameters
    ----------
    study : Study
        Every trial has to be run to an end: a value, or something raised.
    path : path
        ``data/studies/KEY/NAME.csv``; missing folders are made, a file that is there is replaced.
    parameters : mapping from str to what JSON holds
        Everything that the trial does not draw. Arrays are written as lists.
    columns : sequence of str
        Names of the metrics, as in `Study.metrics`.
    code : iterable of callable
        Functions, besides the trial, whose source decides what the numbers are.

    Raises
    ------
    ValueError
        If trials are missing, a worker died or a trial took too long (which may say nothing of
        the trial), a metric is not a real number, or a parameter is not JSON.
    """
    instance(study, "study", Study)
    names = column_names(columns)
    if set(names) & set(_FIRST):
        raise ValueError(f"columns: needs names other than {', '.join(_FIRST)}, got {names}")
    if study.missing:
        raise ValueError(f"study: needs every trial run, got {len(study.missing)} not run")
    kinds = {failure.index: failure.kind for failure in study.failures}
    for kind, what in ((DIED, "whose worker died"), (LATE, "that took too long")):
        if kind in kinds.values():
            raise ValueError(f"study: needs trials that raise or return, got one {what}")
    made_by = {**study.code, **fingerprints(_functions(code), strict=True)}
    lines = [
        _FORMAT,
        f"# trials {len(study)}",
        *(f"# version {k}: {json.dumps(v)}" for k, v in versions()),
        *(f"# code {k}: {json.dumps(v)}" for k, v in sorted(made_by.items())),
        *(f"# parameter {k}: {v}" for k, v in jsons(parameters).items()),
        ",".join([*_FIRST, *names]),
    ]
    for i, (recipe, value) in enumerate(zip(study.recipes, study.values, strict=True)):
        cells = [""] * len(names) if i in kinds else [repr(x) for x in row(value, names)]
        lines.append(",".join([str(i), *_seed_cells(recipe), kinds.get(i, ""), *cells]))
    return _write(_path(path), "\n".join(lines) + "\n")


def _functions(code: Any) -> tuple[Callable[..., Any], ...]:
    given = tuple(code) if isinstance(code, Iterable) else (code,)
    return tuple(callable_(function, "code") for function in given)


def _path(path: Any) -> Path:
    if not isinstance(path, str | Path):
        raise ValueError(f"path: needs a path, got {type(path).__name__}")
    if not Path(path).name:
        raise ValueError(f"path: needs a file's name, got {str(path)!r}")
    return Path(path)


def jsons(parameters: Any) -> dict[str, str]:
    """The parameters as they are written: each one's JSON."""
    if not isinstance(parameters, Mapping):
        raise ValueError(f"parameters: needs a mapping, got {type(parameters).__name__}")

    def plain(value: Any) -> Any:
        if isinstance(value, np.ndarray | np.generic):
            return value.tolist()
        raise TypeError(f"{type(value).__name__} is not JSON")

    out = {}
    for key, value in parameters.items():
        if not isinstance(key, str) or not key.isidentifier():
            raise ValueError(f"parameters: needs identifiers as names, got {key!r}")
        try:
            out[key] = json.dumps(value, default=plain, allow_nan=False)
        except (TypeError, ValueError) as error:
            raise ValueError(f"parameters: {key} needs a value that JSON holds: {error}") from None
    return out


def _seed_cells(recipe: Recipe) -> tuple[str, str]:
    if recipe.pool_size != POOL_SIZE:
        raise ValueError(f"study: needs seeds of numpy's pool size, got {recipe}")
    words = recipe.entropy if isinstance(recipe.entropy, tuple) else (recipe.entropy,)
    return " ".join(map(str, words)), " ".join(map(str, recipe.spawn_key))


def _write(path: Path, text: str) -> Path:
    """Write a file whole or not at all: a study that took an hour is not lost to an interrupt.

    The name on the way is this writer's own, so that two writers leave one of two whole files.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    new = path.with_name(f".{path.name}-{uuid.uuid4().hex}.new")
    try:
        with new.open("x", encoding="utf-8", newline="\n") as out:
            out.write(text)
            out.flush()
            os.fsync(out.fileno())
        os.replace(new, path)
    except BaseException:
        new.unlink(missing_ok=True)
        raise
    return path


def stored(paper: str, name: str) -> Stored:
    """The stored study of one item of a paper, from ``data/studies/PAPER/NAME.csv``.

    It is found from any folder, in the working copy or beside the library
    (:func:`bookkit.folders.data_root`).

    Parameters
    ----------
    paper, name : str
        The paper's key and the study's, such as ``figure-2``.
    """
    root = data_root() / "studies"
    there = sorted(p.relative_to(root).with_suffix("").as_posix() for p in root.glob("*/*.csv"))
    if f"{paper}/{name}" not in there:
        known = ", ".join(there) or "none yet"
        raise ValueError(f"name: needs one of {known}, got {paper}/{name}: make studies")
    return load(root / str(paper) / f"{name}.csv")


def load(path: str | Path) -> Stored:
    """Read a stored study strictly.

    Raises
    ------
    ValueError
        If the file is not one that `store` writes; the error names the file and the line.
    """
    source = _path(path)
    if not source.is_file():
        raise ValueError(f"path: needs a file, got {source}")
    reader = _Reader(source)
    for k, line in enumerate(source.read_bytes().split(b"\n"), start=1):
        try:
            reader.take(line.decode("utf-8"))
        except ValueError as error:  # a UnicodeDecodeError is one too
            raise ValueError(f"path: {source}, line {k}: {error}") from None
    return reader.stored()


class _Reader:
    """The lines of a file, one after the other."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.lines = self.trials = 0
        self.heads: dict[str, dict[str, Any]] = {"version": {}, "code": {}, "parameter": {}}
        self.names: tuple[str, ...] = ()
        self.recipes: list[Recipe] = []
        self.failures: list[str] = []
        self.rows: list[list[float]] = []
        self.seen: set[Recipe] = set()
        self.ended = False

    def take(self, line: str) -> None:
        self.lines += 1
        if self.ended:
            raise ValueError("needs a row, got an empty line before it")
        if self.lines == 1:
            if line != _FORMAT:
                raise ValueError(f"needs {_FORMAT!r}, got {line[:60]!r}")
        elif self.lines == 2:
            found = _TRIALS.fullmatch(line)
            if found is None:
                raise ValueError(f"needs '# trials NUMBER', got {line[:60]!r}")
            self.trials = int(found[1])
        elif not line:
            self.ended = True
        elif line.startswith("#") and not self.names:
            self._head(line)
        elif not self.names:
            self._names(line)
        else:
            self._row(line)

    def _head(self, line: str) -> None:
        found = _HEADER.fullmatch(line)
        if found is None:
            raise ValueError(f"needs '# version|code|parameter NAME: JSON', got {line[:60]!r}")
        kind, name, text = found.groups()
        if name in self.heads[kind]:
            raise ValueError(f"{kind} {name} is there already")
        self.heads[kind][name] = json.loads(text)

    def _names(self, line: str) -> None:
        cells = tuple(line.split(","))
        if cells[: len(_FIRST)] != _FIRST:
            raise ValueError(f"needs columns that begin with {','.join(_FIRST)}, got {line[:60]!r}")
        self.names = column_names(cells[len(_FIRST) :])

    def _row(self, line: str) -> None:
        cells = line.split(",")
        if len(cells) != len(_FIRST) + len(self.names):
            raise ValueError(f"needs {len(_FIRST) + len(self.names)} cells, got {len(cells)}")
        index, entropy, key, kind = cells[: len(_FIRST)]
        if index != str(len(self.rows)):
            raise ValueError(f"needs index {len(self.rows)}, got {index!r}")
        words = _integers(entropy, "entropy")
        if not words:
            raise ValueError("needs an entropy, got none")
        whole = words[0] if len(words) == 1 else words
        made = Recipe(whole, _integers(key, "spawn_key"), POOL_SIZE)
        if made in self.seen:
            raise ValueError(f"needs different seeds, got {made} again")
        self.seen.add(made)
        if kind and not kind.isidentifier():
            raise ValueError(f"failure needs the name of a class or nothing, got {kind!r}")
        metrics = cells[len(_FIRST) :]
        if kind and any(metrics):
            raise ValueError("a trial that failed has no metrics")
        self.recipes.append(made)
        self.failures.append(kind)
        self.rows.append(
            [
                float("nan") if kind else _real(cell, name)
                for cell, name in zip(metrics, self.names, strict=True)
            ]
        )

    def stored(self) -> Stored:
        if not self.ended or not self.rows:
            what = "an end of line after the last row" if self.rows else "at least one trial"
            raise ValueError(f"path: {self.path}, line {self.lines}: needs {what}")
        if len(self.rows) != self.trials:
            got = f"needs {self.trials} trials, as its second line says, got {len(self.rows)}"
            raise ValueError(f"path: {self.path}, line {self.lines}: {got}")
        table = np.array(self.rows)
        return Stored(
            self.path, self.heads["parameter"], self.heads["version"], self.heads["code"],
            tuple(self.recipes), tuple(self.failures),
            {name: table[:, k] for k, name in enumerate(self.names)},
        )


def _integers(cell: str, name: str) -> tuple[int, ...]:
    words = cell.split(" ") if cell else []
    if not all(word.isascii() and word.isdigit() for word in words):
        raise ValueError(f"{name} needs nonnegative integers, got {cell!r}")
    return tuple(int(word) for word in words)


def _real(cell: str, name: str) -> float:
    try:
        value = float(cell)
    except ValueError:
        raise ValueError(f"{name} needs a number, got {cell!r}") from None
    if repr(value) != cell:  # a spreadsheet has been here, and may have dropped digits
        raise ValueError(f"{name} needs a number as Python writes it, {value!r}, got {cell!r}")
    return value
