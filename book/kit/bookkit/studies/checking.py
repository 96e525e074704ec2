"""Stored trials run again and compared, and the scripts that made them."""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Collection, Iterable, Mapping
from concurrent.futures import Executor
from pathlib import Path
from types import ModuleType

import numpy as np

from ..folders import data_root, inside
from .files import Stored, fingerprint, load
from .running import Study, Trial, plain, row, run, sent_by_value, versions

__all__ = ["check", "script"]


def script(name: str, *, folder: Path | None = None) -> ModuleType:
    """The module of a stored study, from ``book/studies`` beside the data.

    It has the study's ``trial``, ``parameters``, ``columns`` and ``seeds``.

    Parameters
    ----------
    name : str
        The study's name, such as ``lorenz-63`` for ``lorenz_63.py``.
    folder : Path, optional
        Another folder of scripts.

    Examples
    --------
    >>> script("../studies/lorenz-63")
    Traceback (most recent call last):
    ValueError: name must be one of ... got '../studies/lorenz_63'
    """
    there = folder or data_root().parent / "book" / "studies"
    path = inside(there, "", name.replace("-", "_"), ".py")
    spec = importlib.util.spec_from_file_location(f"stored_study_{path.stem}", path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    # inspect finds a class's source through sys.modules, and scripts share modules of their folder.
    sys.modules[spec.name] = module
    if str(path.parent) not in sys.path:
        sys.path.insert(0, str(path.parent))
    spec.loader.exec_module(module)
    # Last, as an import leaves it: a ufunc is sent by the name of the first module that has it.
    sys.modules[spec.name] = sys.modules.pop(spec.name)
    sent_by_value(path.parent)
    return module


def check(
    path: str | Path | Stored,
    trial: Trial,
    *,
    indices: Iterable[int] | None = None,
    rtol: float = 0.0,
    atol: float = 0.0,
    ill_conditioned: Collection[str] = (),
    max_outliers: int = 0,
    workers: int | None = 1,
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
        As of `run`; by default in this process.

    Raises
    ------
    AssertionError
        If a metric, or the kind of a failure, is not the stored one.
    """
    stored = path if isinstance(path, Stored) else load(path)
    chosen = list(range(len(stored)) if indices is None else indices)
    if max_outliers >= len(chosen):
        raise ValueError(
            f"odd must have fewer than the {len(chosen)} trials that run, got {max_outliers}"
        )
    allowed = dict.fromkeys(stored.columns, atol)
    for name in ill_conditioned:
        finite = stored.columns[name][np.isfinite(stored.columns[name])]
        allowed[name] = max(atol, float(np.ptp(finite)) if finite.size else 0.0)
    study = run(
        trial,
        [stored.seed(i) for i in chosen],
        errors="collect",
        workers=workers,
        executor=executor,
    )
    kinds = {failure.which: failure.kind for failure in study.failures}
    wrong = [
        found
        for k, i in enumerate(chosen)
        if (found := _differences(stored, i, study, k, kinds.get(k, ""), rtol, allowed))
    ]
    if len(wrong) > max_outliers:
        raise AssertionError(
            _report(stored, trial, [text for each in wrong for text in each])
        )
    return stored


def _differences(
    stored: Stored,
    i: int,
    study: Study,
    k: int,
    kind: str,
    rtol: float,
    allowed: Mapping[str, float],
) -> list[str]:
    """What one trial does not give as it is stored."""
    if kind or stored.failures[i]:
        was = stored.failures[i] or "a value"
        now = kind or "a value"
        return [f"trial {i}: stored {was}, now {now}"] if was != now else []
    names = tuple(stored.columns)
    pairs = [
        (c, float(stored.columns[c][i]), v)
        for c, v in zip(names, row(study.values[k], names), strict=True)
    ]
    return [
        f"trial {i}: {c} stored {was!r}, now {now!r}"
        for c, was, now in pairs
        if not _same(was, now, rtol, allowed[c])
    ]


def _same(was: float, now: float, rtol: float, atol: float) -> bool:
    if was != was or now != now:
        return was != was and now != now
    if rtol == atol == 0 or np.isinf(was) or np.isinf(now):
        return was == now and bool(np.signbit(was) == np.signbit(now))
    return abs(was - now) <= max(rtol * abs(was), atol)


def _report(stored: Stored, trial: Trial, wrong: list[str]) -> str:
    kept = [*wrong[:5], *([f"and {len(wrong) - 5} more"] if len(wrong) > 5 else [])]
    was = stored.metadata["code"].get(plain(trial).__qualname__)
    if was and was != (now := fingerprint(trial)):
        kept.append(f"the source of the trial is another one: stored {was}, now {now}")
    elif stored.metadata["version"] != versions():
        kept.append(
            f"the versions are others: stored {dict(stored.metadata['version'])}"
        )
    return (
        f"{stored.path.name}: another run does not give what is stored\n"
        + "\n".join(kept)
    )
