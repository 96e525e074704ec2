"""Stored trials run again, and compared."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Sequence
from concurrent.futures import Executor
from pathlib import Path
from typing import Any

import numpy as np
from numpy.random import SeedSequence

from distfilt.checks import callable_, count, number, places

from ._worker import versions
from .files import Stored, load
from .running import run
from .sources import fingerprints, name_of
from .study import Study, row

__all__ = ["check"]


def check(
    path: str | Path | Stored, trial: Callable[[SeedSequence], Any], *,
    indices: Iterable[int] | None = None, rtol: float = 0.0, atol: float = 0.0,
    rough: Collection[str] = (), odd: int = 0,
    workers: int | None = 1, executor: Executor | None = None,
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
    atol : float
        Largest absolute difference that passes whatever `rtol` is, for a metric that is zero to
        rounding.
    rough : collection of str
        Metrics that another processor need not repeat, because the last bit decides in the trial
        (which of two couplings, which way an unstable filter goes). Such a metric may differ from
        its stored value by as much as the stored trials differ from each other.
    odd : int
        How many of the trials may go another way altogether, in any metric: an unstable filter
        overflows on one processor and not on the next.
    workers, executor
        As in `run`; by default in this process.

    Raises
    ------
    AssertionError
        If a metric, or the kind of a failure, is not the stored one.
    ValueError
        If the file is malformed, or an index or a name of `rough` is not in it.
    """
    stored = path if isinstance(path, Stored) else load(path)
    number(rtol, "rtol", at_least=0)
    allowed = _allowed(stored, number(atol, "atol", at_least=0), rough)
    spared = count(odd, "odd", at_least=0)
    chosen = places(range(len(stored)) if indices is None else indices, "indices", len(stored))
    if spared >= len(chosen):
        raise ValueError(f"odd: needs fewer than the {len(chosen)} trials that run, got {spared}")
    study = run(
        callable_(trial, "trial"), [stored.seed(i) for i in chosen], errors="collect",
        workers=workers, executor=executor,
    )
    wrong = _differences(stored, chosen, study, rtol, allowed)
    if len(wrong) > spared:
        raise AssertionError(_report(stored, trial, [text for each in wrong for text in each]))
    return stored


def _allowed(stored: Stored, atol: float, rough: Collection[str]) -> dict[str, float]:
    """The absolute difference that passes, for each metric."""
    named = isinstance(rough, Collection) and not isinstance(rough, str)
    if not named or not set(rough) <= set(stored.columns):
        raise ValueError(f"rough: needs names of metrics that are stored, got {rough!r}")
    allowed = dict.fromkeys(stored.columns, atol)
    for name in rough:
        values = np.asarray(stored.columns[name])
        finite = values[np.isfinite(values)]
        allowed[name] = max(atol, float(np.ptp(finite)) if finite.size else 0.0)
    return allowed


def _differences(
    stored: Stored, chosen: Sequence[int], study: Study, rtol: float, allowed: dict[str, float]
) -> list[list[str]]:
    """What the new study does not give as it is stored, for each trial that differs."""
    names = tuple(stored.columns)
    kinds = {failure.index: failure.kind for failure in study.failures}
    wrong = []
    for k, i in enumerate(chosen):
        found = []
        if kinds.get(k, "") != stored.failures[i]:
            was, now = stored.failures[i] or "a value", kinds.get(k) or "a value"
            found.append(f"trial {i}: stored {was}, now {now}")
        elif k not in kinds:
            for name, value in zip(names, row(study.values[k], names), strict=True):
                kept = float(stored.columns[name][i])
                if not _same(kept, value, rtol, allowed[name]):
                    found.append(f"trial {i}: {name} stored {kept!r}, now {value!r}")
        wrong += [found] if found else []
    return wrong


def _same(was: float, now: float, rtol: float, atol: float) -> bool:
    if was != was or now != now:
        return was != was and now != now
    if rtol == atol == 0 or np.isinf(was) or np.isinf(now):
        return was == now and np.signbit(was) == np.signbit(now)
    return abs(was - now) <= max(rtol * abs(was), atol)


def _report(stored: Stored, trial: Any, wrong: list[str]) -> str:
    kept = [*wrong[:5], *([f"and {len(wrong) - 5} more"] if len(wrong) > 5 else [])]
    name = name_of(trial)
    was, now = stored.code.get(name), fingerprints([trial], strict=False).get(name)
    if was != now:
        kept.append(f"the source of {name} is another one: stored {was}, now {now}")
    elif dict(stored.versions) != dict(versions()):
        kept.append(f"the versions are others: stored {dict(stored.versions)}")
    return f"{stored.path.name}: another run does not give what is stored\n" + "\n".join(kept)
