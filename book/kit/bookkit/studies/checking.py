"""Run stored trials again and compare them; load the scripts that made them."""

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
from .running import Study, Trial, pickle_by_value, plain, row, run, versions

__all__ = ["check", "example", "script"]


def script(name: str, *, folder: Path | None = None) -> ModuleType:
    """Return the module of a stored study, from ``book/studies`` beside the data.

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
    scripts = folder or data_root().parent / "book" / "studies"
    path = inside(scripts, "", name.replace("-", "_"), ".py")
    spec = importlib.util.spec_from_file_location(f"stored_study_{path.stem}", path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    # inspect finds the source of a class through sys.modules; scripts import modules beside them.
    sys.modules[spec.name] = module
    if str(path.parent) not in sys.path:
        sys.path.insert(0, str(path.parent))
    spec.loader.exec_module(module)
    # Move it to the end, as after an import: a ufunc is pickled by the first module that has it.
    sys.modules[spec.name] = sys.modules.pop(spec.name)
    pickle_by_value(path.parent)
    return module


def example(name: str) -> ModuleType:
    """Return the module of a program of ``book/examples``, beside the data, without running it.

    Parameters
    ----------
    name : str
        The program's name, such as ``radios``. What it does stands below its test of
        ``__name__``, and is left out.

    Examples
    --------
    >>> example("radios").RANGE_STD > 0
    True
    """
    return script(name, folder=data_root().parent / "book" / "examples")


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
    """Run stored trials again and compare the results with the stored ones.

    Parameters
    ----------
    path : path or Stored
        The stored study, or its file.
    trial : callable
        The trial that made it.
    indices : iterable of int, optional
        Indices of the trials; all by default.
    rtol : float
        Largest relative difference. 0 requires the same bits, as on the kind of machine that stored
        the study. On another processor, linear algebra, exponentials and logarithms differ in the
        last bits, and a trial amplifies that.
    atol : float
        Largest absolute difference that is always accepted, for a metric that is zero up to
        rounding.
    ill_conditioned : collection of str
        Metrics that depend on the last bit (which of two couplings is chosen, how an unstable
        filter diverges). Such a metric may differ from its stored value by as much as the stored
        trials differ from each other.
    max_outliers : int
        Number of trials that may differ in any metric: an unstable filter overflows on one
        processor and not on another.
    workers, executor
        As in `run`; by default in this process.

    Raises
    ------
    AssertionError
        If a metric, or the kind of a failure, is not the stored one.
    """
    stored = path if isinstance(path, Stored) else load(path)
    chosen = list(range(len(stored)) if indices is None else indices)
    if max_outliers >= len(chosen):
        raise ValueError(
            f"max_outliers must be below the number of trials, {len(chosen)}, "
            f"got {max_outliers}"
        )
    # Tolerance of each metric; an ill-conditioned one may vary as the trials do.
    allowed = dict.fromkeys(stored.columns, atol)
    for name in ill_conditioned:
        finite = stored.columns[name][np.isfinite(stored.columns[name])]
        allowed[name] = max(atol, float(np.ptp(finite)) if finite.size else 0.0)
    study = run(
        trial,
        # The stored seeds, not the script's: a file can be checked on its own.
        [stored.seed(i) for i in chosen],
        errors="collect",
        workers=workers,
        executor=executor,
    )
    kinds = {failure.which: failure.kind for failure in study.failures}
    n_outliers = 0
    differences: list[str] = []
    for k, i in enumerate(chosen):
        kind = kinds.get(k, "")
        texts = _differences(stored, i, study, k, kind, rtol, allowed)
        n_outliers += bool(texts)
        differences += texts
    if n_outliers > max_outliers:
        raise AssertionError(_report(stored, trial, differences))
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
    """Describe the differences of trial i, the k-th that ran again, from the stored one."""
    # A failed trial has no metrics: compare the kinds of failure.
    if kind or stored.failures[i]:
        was = stored.failures[i] or "a value"
        now = kind or "a value"
        return [f"trial {i}: stored {was}, now {now}"] if was != now else []
    texts = []
    names = tuple(stored.columns)
    for name, value in zip(names, row(study.values[k], names), strict=True):
        reference = float(stored.columns[name][i])
        if not _same(reference, value, rtol, allowed[name]):
            texts.append(f"trial {i}: {name} stored {reference!r}, now {value!r}")
    return texts


def _same(was: float, now: float, rtol: float, atol: float) -> bool:
    """Return whether two numbers agree to the tolerances; NaN agrees with NaN."""
    if np.isnan(was) or np.isnan(now):
        return bool(np.isnan(was) and np.isnan(now))
    # Exactly equal, with the sign of a zero
    if rtol == atol == 0 or np.isinf(was) or np.isinf(now):
        return was == now and bool(np.signbit(was) == np.signbit(now))
    return abs(was - now) <= max(rtol * abs(was), atol)


def _report(stored: Stored, trial: Trial, differences: list[str]) -> str:
    """Return the first differences, and whether the code or the versions changed."""
    lines = differences[:5]
    if len(differences) > 5:
        lines.append(f"and {len(differences) - 5} more")
    # Changed code explains a difference better than changed versions.
    was = stored.metadata["code"].get(plain(trial).__qualname__)
    now = fingerprint(trial) if was else ""
    if was and was != now:
        lines.append(f"the source of the trial differs: stored {was}, now {now}")
    elif stored.metadata["version"] != versions():
        lines.append(f"the versions differ: stored {dict(stored.metadata['version'])}")
    head = f"{stored.path.name}: another run does not give the stored results"
    return "\n".join([head, *lines])
