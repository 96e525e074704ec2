"""Long studies as files: every finished trial is on disk before its worker gets the next one."""

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
"""Shortest time between two calls of fsync."""


@dataclass(frozen=True, eq=False)
class Stored:
    """A study that was read from a file.

    Parameters
    ----------
    path : Path
        Its file.
    metadata : mapping
        The study's parameters under ``"parameter"``, the versions of its packages under
        ``"version"``, and the `fingerprint` of its functions under ``"code"``.
    seeds : tuple of str
        Entropy and spawn key of each trial, in the form of the file.
    failures : tuple of str
        The class of each trial's exception, or ''.
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
        """Return a metric of the trials that did not fail, (n,)."""
        return self.columns[column][[not kind for kind in self.failures]]

    def seed(self, index: int) -> SeedSequence:
        """Return a new seed sequence of a trial."""
        entropy, key = (
            tuple(map(int, t.split())) for t in self.seeds[index].split(",")
        )
        return SeedSequence(entropy if len(entropy) > 1 else entropy[0], spawn_key=key)


def seed_text(seed: SeedSequence | int) -> str:
    """Return a seed's entropy and spawn key, in the form of a file."""
    sequence: Any = fresh(seed)
    # An entropy may be one integer or a list of them.
    words = (
        sequence.entropy
        if isinstance(sequence.entropy, Sequence)
        else [sequence.entropy]
    )
    return f"{' '.join(map(str, words))},{' '.join(map(str, sequence.spawn_key))}"


def fingerprint(function: Callable[..., Any]) -> str:
    """Return a digest of a function's source: the first 16 digits of its SHA-256.

    The text is that of ``inspect.getsource`` without its indentation. It changes with any edit of
    the function, comments included, but not with an edit of the functions that it calls. It shows
    whether a stored study was made by this version of the function. Running trials again (`check`)
    shows whether all code below still gives the same numbers.

    Examples
    --------
    >>> len(fingerprint(fingerprint))
    16
    """
    source = textwrap.dedent(inspect.getsource(plain(function))).strip()
    return hashlib.sha256(source.encode()).hexdigest()[:16]


def plain_json(parameters: Mapping[str, Any]) -> dict[str, str]:
    """Return each parameter as the JSON that is written; arrays are lists."""

    def to_list(value: Any) -> Any:
        if isinstance(value, np.ndarray | np.generic):
            return value.tolist()
        raise TypeError(f"{type(value).__name__} is not JSON")

    return {
        k: json.dumps(v, default=to_list, allow_nan=False)
        for k, v in parameters.items()
    }


def _head(
    trial: Trial,
    columns: Sequence[str],
    parameters: Mapping[str, Any],
    code: Iterable[Any],
) -> str:
    """Return the head of a study's file: versions, code, parameters and names of columns."""
    if not all(name.isidentifier() for name in columns) or len(set(columns)) != len(
        columns
    ):
        raise ValueError(f"columns must be different identifiers, got {columns}")
    fingerprints = {plain(f).__qualname__: fingerprint(f) for f in (trial, *code)}
    lines = [f"# version {k}: {json.dumps(v)}" for k, v in running.versions().items()]
    lines += [f"# code {k}: {json.dumps(v)}" for k, v in sorted(fingerprints.items())]
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

    Each finished trial is written to ``PATH.part`` before its worker gets the next one. If this
    process is killed, the executor dies or the disk is full, the same call continues: only the
    unfinished trials run, and the file is the same in the end.

    Parameters
    ----------
    path : path
        ``data/studies/KEY/NAME.csv``; missing folders are made, an existing file is replaced.
    trial, seeds, executor, workers, progress
        As in `run`. A trial that raises is a row with the class of the exception.
    columns : sequence of str
        Names of the metrics: keys of the mapping that a trial returns, or names of its numbers in
        order.
    parameters : mapping from str to values that JSON can hold
        Everything that determines a trial besides its seed.
    code : iterable of callable
        Further functions whose source determines the numbers.
    indices : iterable of int, optional
        Run only these trials, as one machine of several; `merge` joins their parts.

    Returns
    -------
    Path
        The file, or ``PATH.part`` if `indices` leaves out trials that have not run yet.

    Raises
    ------
    ValueError
        If ``PATH.part`` has other code, parameters, seeds or versions.
    StudyError
        If the executor failed, or the worker of a trial died.
    OSError
        If the disk is full; the message names the file.
    """
    target = Path(path)
    seed_sequences = [fresh(seed) for seed in seeds]
    # Rows of an earlier, unfinished call
    part = _Part(target, _head(trial, columns, parameters, code))
    n_head = len(_FIRST)
    rows = part.rows()
    texts = [seed_text(seed) for seed in seed_sequences]
    # A row belongs to this study only if its seed is the same.
    for i, text in rows.items():
        if (
            i >= len(seed_sequences)
            or ",".join(text.split(",")[1 : n_head - 1]) != texts[i]
        ):
            raise ValueError(f"{part.path}: its trial {i} has another seed: remove it")
    # Trials that are done, by an earlier call or another machine, do not run again.
    chosen = range(len(seed_sequences)) if indices is None else indices
    items = [(i, seed_sequences[i]) for i in chosen if i not in rows]
    # Deaths of workers are not stored: they may be the fault of the machine.
    deaths = []
    try:
        outcomes = running.outcomes(trial, items, executor, workers, one_by_one=True)
        for outcome in running.track(outcomes, len(items), progress):
            if outcome.kind == running.DIED:
                deaths.append(
                    Failure(outcome.which, seed_sequences[outcome.which], *outcome[2:])
                )
            else:
                rows[outcome.which] = _row(outcome, texts[outcome.which], columns)
                part.append(rows[outcome.which])
    except running.ExecutorError as error:
        raise StudyError(f"{error}; finished trials are in {part.path}") from error
    if deaths:
        raise StudyError(f"{deaths[0]}\nthe other trials are in {part.path}")
    return part.finish(rows) if len(rows) == len(seed_sequences) else part.path


def _row(outcome: Outcome, seed: str, columns: Sequence[str]) -> str:
    value = None if outcome.kind else pickle.loads(outcome.value)
    numbers = (
        [""] * len(columns) if outcome.kind else map(repr, running.row(value, columns))
    )
    return ",".join([str(outcome.which), seed, outcome.kind, *numbers])


class _Part:
    """An unfinished study: its head, then a row with a checksum for each finished trial."""

    def __init__(self, target: Path, head: str) -> None:
        self.target = target
        self.head = head
        self.path = target.with_name(f"{target.name}.part")
        self.synced = 0.0

    def rows(self) -> dict[int, str]:
        """Return the rows by their index; a truncated or damaged row is left out and runs again."""
        if not self.path.is_file():
            return {}
        text = self.path.read_text(encoding="utf-8", errors="replace")
        # The process ended while it wrote the head: nothing is lost.
        if self.head.startswith(text):  # truncated before its first row
            self.path.unlink()
        elif not text.startswith(f"{self.head}\n"):
            raise ValueError(
                f"{self.path}: must have the same code, parameters and versions: remove "
                "it to start again"
            )
        rows = {}
        for line in text[len(self.head) :].split("\n"):
            row, _, checksum = line.rpartition(",")
            # The checksum tells a complete row from one that a full disk or a crash cut
            # off.
            if row and checksum == _checksum(row):
                rows[int(row.split(",")[0])] = row
        return rows

    def append(self, row: str) -> None:
        """Write a row to the disk."""
        self.path.parent.mkdir(parents=True, exist_ok=True)
        text = "" if self.path.is_file() else self.head
        # The line break comes first, since the row before may be truncated.
        text += f"\n{row},{_checksum(row)}"
        with _name_file(self.path), self.path.open("ab") as file:
            file.write(text.encode())
            file.flush()
            # fsync is slow on a shared disk, so it is called for many rows at once.
            if time.monotonic() - self.synced > _SYNC_SECONDS:
                os.fsync(file.fileno())
                self.synced = time.monotonic()

    def finish(self, rows: Mapping[int, str]) -> Path:
        """Write the complete file in one step, and remove the part."""
        body = "\n".join([self.head, *(rows[i] for i in sorted(rows)), ""]).encode()
        # A unique name, so that two writers cannot mix their files.
        new = self.target.with_name(f".{self.target.name}-{uuid.uuid4().hex}.new")
        try:
            with _name_file(self.target), new.open("xb") as file:
                file.write(_FORMAT + b"\n" + _seal(body) + b"\n" + body)
                file.flush()
                os.fsync(file.fileno())
            # Readers see the old file or the new one, never a part.
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
def _name_file(path: Path) -> Iterator[None]:
    """Add the file's name to an error of the disk."""
    try:
        yield
    except OSError as error:
        raise OSError(error.errno, os.strerror(error.errno or 0), str(path)) from error


def merge(path: str | Path, *parts: str | Path) -> Path:
    """Add the trials of other machines' parts to a study's part; `store` then continues.

    Parameters
    ----------
    path : path
        The study's file, as passed to `store`; its part need not exist yet.
    *parts : path
        Parts of the same study, made with the same code, parameters and versions.
    """
    first = Path(parts[0]).read_text(encoding="utf-8", errors="replace")
    head = re.match(r"(#.*\n)*index,.*", first)
    if head is None:
        raise ValueError(f"{parts[0]} is damaged, or was not written by store")
    merged = _Part(Path(path), head[0])
    rows = merged.rows()
    for source in parts:
        other = _Part(Path(path), head[0])
        other.path = Path(source)
        for i, row in other.rows().items():
            # Machines may have run the same trial; their rows must be equal.
            if rows.setdefault(i, row) != row:
                raise ValueError(f"{source}: its trial {i} differs from another part's")
            merged.append(row)
    return merged.path


def stored(paper: str, name: str) -> Stored:
    """Load the stored study of a paper's item, from ``data/studies/PAPER/NAME.csv``.

    Parameters
    ----------
    paper, name : str
        The paper's key and the study's, such as ``figure-2``.
    """
    return load(inside(data_root() / "studies", paper, name, ".csv"))


def load(path: str | Path) -> Stored:
    """Read a stored study; the seal detects a file that is damaged or was edited."""
    import pandas

    source = Path(path)
    # Three parts: format, checksum of the rest, and the rest
    form, seal, body = (source.read_bytes().split(b"\n", 2) + [b"", b""])[:3]
    if form != _FORMAT or seal != _seal(body):
        raise ValueError(f"path: {source} is damaged, or was not written by store")
    metadata: dict[str, dict[str, Any]] = {"version": {}, "code": {}, "parameter": {}}
    # The head: one line "# kind name: JSON" for each version, function and parameter
    lines = body.decode().split("\n")
    for match in filter(None, map(_HEADER.fullmatch, lines)):
        metadata[match[1]][match[2]] = json.loads(match[3])
    skipped = sum(line.startswith("#") for line in lines)
    table = pandas.read_csv(
        io.BytesIO(body), skiprows=skipped, dtype=str, keep_default_na=False
    )
    metrics = table.columns[len(_FIRST) :]
    # `float` restores every bit that `repr` wrote; pandas' parser need not.
    columns = {
        str(c): np.array([float(text or "nan") for text in table[c]]) for c in metrics
    }
    seeds = tuple(table["entropy"] + "," + table["spawn_key"])
    return Stored(source, metadata, seeds, tuple(table["failure"]), columns)
