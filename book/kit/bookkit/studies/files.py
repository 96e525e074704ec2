"""Long studies as files: every finished trial is on disk before the next begins."""

from __future__ import annotations

import hashlib
import inspect
import io
import json
import os
import pickle
import re
import textwrap
import time
import uuid
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.random import SeedSequence
from numpy.typing import NDArray

from ..folders import data_root, inside
from . import running
from .running import Failure, Outcome, StudyError, Trial, fresh, plain

__all__ = ["Stored", "fingerprint", "load", "merge", "store", "stored"]

_FORMAT = b"# distfilt study, format 3"
_FIRST = ("index", "entropy", "spawn_key", "failure")
_HEADER = re.compile(r"# (version|code|parameter) (\S+): (.+)")
_SYNC_SECONDS = 0.2
"""The disk is asked to keep what it was given no more often than this."""


@dataclass(frozen=True, eq=False)
class Stored:
    """A study read from a file.

    Parameters
    ----------
    path : Path
        Where it was read.
    heads : mapping
        Under ``"parameter"``, ``"version"`` and ``"code"`` the study's parameters, the versions it
        was made with, and the `fingerprint` of the functions that made it.
    seeds : tuple of str
        What makes each trial's seed, as the file has it.
    failures : tuple of str
        For each trial the class of what it raised, or ''.
    columns : mapping from str to array, (n,)
        The metrics of all trials; NaN for a trial that failed (and where the metric is NaN).
    """

    path: Path
    metadata: Mapping[str, Mapping[str, Any]]
    seeds: tuple[str, ...]
    failures: tuple[str, ...]
    columns: Mapping[str, NDArray[np.float64]]

    def __len__(self) -> int:
        return len(self.seeds)

    @property
    def parameters(self) -> Mapping[str, Any]:
        """The study's parameters."""
        return self.metadata["parameter"]

    def metric(self, column: str) -> NDArray[np.float64]:
        """A metric of the trials that are done, (done,)."""
        return self.columns[column][[not kind for kind in self.failures]]

    def seed(self, index: int) -> SeedSequence:
        """The seed of a trial, made afresh."""
        entropy, key = (
            tuple(map(int, t.split())) for t in self.seeds[index].split(",")
        )
        return SeedSequence(entropy if len(entropy) > 1 else entropy[0], spawn_key=key)


def seed_text(seed: SeedSequence | int) -> str:
    """What makes a seed, as a file has it: its entropy and its spawn key."""
    made: Any = fresh(seed)
    words = made.entropy if isinstance(made.entropy, Sequence) else [made.entropy]
    return f"{' '.join(map(str, words))},{' '.join(map(str, made.spawn_key))}"


def fingerprint(function: Callable[..., Any]) -> str:
    """A digest of a function's source: the first 16 digits of its SHA-256.

    The text is that of ``inspect.getsource`` without its indentation. It changes with any edit of
    the function, comments included, and not with an edit of what the function calls: it tells a
    reader whether a stored study was made by the function that is printed, and running trials
    again (`check`) tells whether everything below still gives the same numbers.

    Examples
    --------
    >>> len(fingerprint(fingerprint))
    16
    """
    source = textwrap.dedent(inspect.getsource(plain(function))).strip()
    return hashlib.sha256(source.encode()).hexdigest()[:16]


def plain_json(parameters: Mapping[str, Any]) -> dict[str, str]:
    """The parameters as they are written: each one's JSON, arrays as lists."""

    def listed(value: Any) -> Any:
        if isinstance(value, np.ndarray | np.generic):
            return value.tolist()
        raise TypeError(f"{type(value).__name__} is not JSON")

    return {
        k: json.dumps(v, default=listed, allow_nan=False) for k, v in parameters.items()
    }


def _head(
    trial: Trial,
    columns: Sequence[str],
    parameters: Mapping[str, Any],
    code: Iterable[Any],
) -> str:
    """What a study's file says of its making, and the names of its columns."""
    if not all(name.isidentifier() for name in columns) or len(set(columns)) != len(
        columns
    ):
        raise ValueError(f"columns must be different identifiers, got {columns}")
    made_by = {plain(f).__qualname__: fingerprint(f) for f in (trial, *code)}
    lines = [f"# version {k}: {json.dumps(v)}" for k, v in running.versions().items()]
    lines += [f"# code {k}: {json.dumps(v)}" for k, v in sorted(made_by.items())]
    lines += [f"# parameter {k}: {v}" for k, v in plain_json(parameters).items()]
    return "\n".join([*lines, ",".join([*_FIRST, *columns])])


def store(
    path: str | Path,
    trial: Trial,
    seeds: Iterable[SeedSequence | int],
    *,
    columns: Sequence[str],
    parameters: Mapping[str, Any],
    code: Iterable[Callable[..., Any]] = (),
    indices: Iterable[int] | None = None,
    executor: Executor | None = None,
    workers: int | None = None,
    progress: bool = True,
) -> Path:
    """Run a study and write its metrics to a CSV file: the same study gives the same bytes.

    Each trial that is finished goes to ``PATH.part`` before its worker gets the next one. Where
    this process is killed, the executor dies or the disk is full, the same call goes on: what was
    in flight runs again, nothing else, and the file comes out the same.

    Parameters
    ----------
    path : path
        ``data/studies/KEY/NAME.csv``; missing folders are made, a file that is there is replaced.
    trial, seeds, executor, workers, progress
        As of `run`. A trial that raises is a row with the class of what it raised.
    columns : sequence of str
        Names of the metrics: keys of what a trial returns, or of its numbers in their order.
    parameters : mapping from str to what JSON holds
        Everything that the trial does not draw.
    code : iterable of callable
        Functions, besides the trial, whose source decides what the numbers are.
    indices : iterable of int, optional
        Run these trials alone, as one machine of several; `merge` brings their parts together.

    Returns
    -------
    Path
        The file, or ``PATH.part`` where `indices` leaves trials to be run.

    Raises
    ------
    ValueError
        If ``PATH.part`` is of another study: other code, parameters, seeds or versions.
    StudyError
        If the executor failed, or a trial took its worker down, which may say nothing of it.
    OSError
        If the disk is full; the message names the file.
    """
    target = Path(path)
    given = [fresh(seed) for seed in seeds]
    part = _Part(target, _head(trial, columns, parameters, code))
    head = len(_FIRST)
    rows = part.rows()
    texts = [seed_text(seed) for seed in given]
    for i, text in rows.items():
        if i >= len(given) or ",".join(text.split(",")[1 : head - 1]) != texts[i]:
            raise ValueError(f"{part.path}: its trial {i} has another seed: remove it")
    wanted = range(len(given)) if indices is None else indices
    items = [(i, given[i]) for i in wanted if i not in rows]
    died = []
    try:
        flight = running.outcomes(trial, items, executor, workers, one_by_one=True)
        for outcome in running.track(flight, len(items), progress):
            if outcome.kind == running.DIED:
                died.append(Failure(outcome.which, given[outcome.which], *outcome[2:]))
            else:
                rows[outcome.which] = _row(outcome, texts[outcome.which], columns)
                part.append(rows[outcome.which])
    except running.ExecutorError as error:
        raise StudyError(
            f"{error}; the trials that are done are in {part.path}"
        ) from error
    if died:
        raise StudyError(f"{died[0]}\nthe other trials are in {part.path}")
    return part.finished(rows) if len(rows) == len(given) else part.path


def _row(outcome: Outcome, seed: str, columns: Sequence[str]) -> str:
    value = None if outcome.kind else pickle.loads(outcome.value)
    numbers = (
        [""] * len(columns) if outcome.kind else map(repr, running.row(value, columns))
    )
    return ",".join([str(outcome.which), seed, outcome.kind, *numbers])


class _Part:
    """What is done of a study: its head, then a row a trial as they come, each with a checksum."""

    def __init__(self, target: Path, head: str) -> None:
        self.target = target
        self.head = head
        self.path = target.with_name(f"{target.name}.part")
        self.synced = 0.0

    def rows(self) -> dict[int, str]:
        """The rows by their index; one that was cut off or damaged counts as not done."""
        if not self.path.is_file():
            return {}
        text = self.path.read_text(encoding="utf-8", errors="replace")
        if self.head.startswith(text):  # it was cut off before its first row
            self.path.unlink()
        elif not text.startswith(f"{self.head}\n"):
            raise ValueError(
                f"{self.path}: begun with other code, parameters or versions: remove "
                "it to begin again"
            )
        out = {}
        for line in text[len(self.head) :].split("\n"):
            made, _, checksum = line.rpartition(",")
            if made and checksum == _checksum(made):
                out[int(made.split(",")[0])] = made
        return out

    def append(self, made: str) -> None:
        """Put a row on the disk."""
        self.path.parent.mkdir(parents=True, exist_ok=True)
        text = "" if self.path.is_file() else self.head
        # Each begins its own line: the one before it may have been cut off.
        text += f"\n{made},{_checksum(made)}"
        with _named(self.path), self.path.open("ab") as out:
            out.write(text.encode())
            out.flush()
            if time.monotonic() - self.synced > _SYNC_SECONDS:
                os.fsync(out.fileno())
                self.synced = time.monotonic()

    def finished(self, rows: Mapping[int, str]) -> Path:
        """Write the whole file, or none of it, and remove the part."""
        body = "\n".join([self.head, *(rows[i] for i in sorted(rows)), ""]).encode()
        # A name of this writer's own, so that two writers leave one of two whole files.
        new = self.target.with_name(f".{self.target.name}-{uuid.uuid4().hex}.new")
        try:
            with _named(self.target), new.open("xb") as out:
                out.write(_FORMAT + b"\n" + _seal(body) + b"\n" + body)
                out.flush()
                os.fsync(out.fileno())
            os.replace(new, self.target)
        finally:
            new.unlink(missing_ok=True)
        self.path.unlink(missing_ok=True)
        return self.target


def _checksum(text: str) -> str:
    return f"{zlib.crc32(text.encode()):08x}"


def _seal(body: bytes) -> bytes:
    return b"# sha256 " + hashlib.sha256(body).hexdigest().encode()


@contextmanager
def _named(path: Path) -> Iterator[None]:
    """Errors of the disk with the file in them, which a write does not tell."""
    try:
        yield
    except OSError as error:
        raise OSError(error.errno, os.strerror(error.errno or 0), str(path)) from error


def merge(path: str | Path, *parts: str | Path) -> Path:
    """Add the trials of other machines' parts to a study's own part; `store` then goes on.

    Parameters
    ----------
    path : path
        The study's file, as given to `store`; its part need not be there yet.
    *parts : path
        Parts of the same study, made with the same code, parameters and versions.
    """
    first = Path(parts[0]).read_text(encoding="utf-8", errors="replace")
    if (head := re.match(r"(#.*\n)*index,.*", first)) is None:
        raise ValueError(f"{parts[0]} is damaged, or no part that store wrote")
    own = _Part(Path(path), head[0])
    known = own.rows()
    for part in parts:
        other = _Part(Path(path), head[0])
        other.path = Path(part)
        for i, made in other.rows().items():
            if known.setdefault(i, made) != made:
                raise ValueError(f"{part}: its trial {i} differs from another part's")
            own.append(made)
    return own.path


def stored(paper: str, name: str) -> Stored:
    """The stored study of one item of a paper, from ``data/studies/PAPER/NAME.csv``.

    Parameters
    ----------
    paper, name : str
        The paper's key and the study's, such as ``figure-2``.
    """
    return load(inside(data_root() / "studies", paper, name, ".csv"))


def load(path: str | Path) -> Stored:
    """Read a stored study; a file that is damaged, or another one, is refused by its name."""
    import pandas

    source = Path(path)
    form, seal, body = (source.read_bytes().split(b"\n", 2) + [b"", b""])[:3]
    if form != _FORMAT or seal != _seal(body):
        raise ValueError(f"path: {source} is damaged, or no study that store wrote")
    heads: dict[str, dict[str, Any]] = {"version": {}, "code": {}, "parameter": {}}
    lines = body.decode().split("\n")
    for found in filter(None, map(_HEADER.fullmatch, lines)):
        heads[found[1]][found[2]] = json.loads(found[3])
    skipped = sum(line.startswith("#") for line in lines)
    table = pandas.read_csv(
        io.BytesIO(body), skiprows=skipped, dtype=str, keep_default_na=False
    )
    metrics = table.columns[len(_FIRST) :]
    # Python's own reading of a number, which gives back every bit that was written.
    columns = {
        str(c): np.array([float(text or "nan") for text in table[c]]) for c in metrics
    }
    seeds = tuple(table["entropy"] + "," + table["spawn_key"])
    return Stored(source, heads, seeds, tuple(table["failure"]), columns)
