"""Stored trials run again, and compared."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Executor
from pathlib import Path
from typing import Any

import numpy as np
from numpy.random import SeedSequence

from ..checks import callable_, count, number
from ._worker import versions
from .files import Stored, load
from .running import run
from .sources import fingerprints, name_of
from .study import Study, row

__all__ = ["check"]


def check(
    path: str | Path | Stored, trial: Callable[[SeedSequence], Any], *,
    indices: Iterable[int] | None = None, rtol: float = 0.0, workers: int | None = 1,
    executor: Executor | None = None,
) -> Stored:
    """Run stored trials again and compare what they give now with what is stored.

    Parameters
    ----------
    path : path or Stored
        The stored study, or its file.
    trial : callable
        The trial that made it.
    indices : iterable of int, optional
        Which trials, all by default.
    rtol : float
        Largest relative difference. 0 asks for the same bits, which is right on the kind of
        machine that stored the study; another processor's linear algebra, exponentials and
        logarithms differ in the last bits, and a trial carries that along.
    workers, executor
        As in `run`; by default in this process.

    Raises
    ------
    AssertionError
        If a metric, or the kind of a failure, is not the stored one.
    ValueError
        If the file is malformed, or an index is not in it.
    """
    stored = path if isinstance(path, Stored) else load(path)
    limit = number(rtol, "rtol", at_least=0)
    chosen = _indices(range(len(stored)) if indices is None else indices, len(stored))
    study = run(
        callable_(trial, "trial"), [stored.seed(i) for i in chosen], errors="collect",
        workers=workers, executor=executor,
    )
    wrong = _differences(stored, chosen, study, limit)
    if wrong:
        raise AssertionError(_report(stored, trial, wrong))
    return stored


def _differences(stored: Stored, chosen: Sequence[int], study: Study, rtol: float) -> list[str]:
    """What the new study of the chosen trials does not give as it is stored."""
    names = tuple(stored.columns)
    kinds = {failure.index: failure.kind for failure in study.failures}
    wrong = []
    for k, i in enumerate(chosen):
        if kinds.get(k, "") != stored.failures[i]:
            was, now = stored.failures[i] or "a value", kinds.get(k) or "a value"
            wrong.append(f"trial {i}: stored {was}, now {now}")
        elif k not in kinds:
            for name, value in zip(names, row(study.values[k], names), strict=True):
                kept = float(stored.columns[name][i])
                if not _same(kept, value, rtol):
                    wrong.append(f"trial {i}: {name} stored {kept!r}, now {value!r}")
    return wrong


def _indices(indices: Any, n: int) -> tuple[int, ...]:
    given = tuple(indices) if isinstance(indices, Iterable) else ()
    if not given:
        raise ValueError(f"indices: needs at least one trial, got {indices!r}")
    out = tuple(count(i, "indices", at_least=0) for i in given)
    if max(out) >= n or len(set(out)) != len(out):
        raise ValueError(f"indices: needs different trials of {n}, got {list(out)}")
    return out


def _same(was: float, now: float, rtol: float) -> bool:
    if was != was or now != now:
        return was != was and now != now
    if rtol == 0 or np.isinf(was) or np.isinf(now):
        return was == now and np.signbit(was) == np.signbit(now)
    return abs(was - now) <= rtol * abs(was)


def _report(stored: Stored, trial: Any, wrong: list[str]) -> str:
    kept = [*wrong[:5], *([f"and {len(wrong) - 5} more"] if len(wrong) > 5 else [])]
    name = name_of(trial)
    was, now = stored.code.get(name), fingerprints([trial], strict=False).get(name)
    if was != now:
        kept.append(f"the source of {name} is another one: stored {was}, now {now}")
    elif dict(stored.versions) != dict(versions()):
        kept.append(f"the versions are others: stored {dict(stored.versions)}")
    return f"{stored.path.name}: another run does not give what is stored\n" + "\n".join(kept)
