"""What a study gives back: values, failures with their seeds, and errors that keep both."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.random import SeedSequence
from numpy.typing import NDArray

from distfilt.checks import Array, array, count

from .seeds import Recipe

__all__ = ["Failure", "Study", "StudyError", "StudyInterrupted"]

LATE = "timeout"
"""The kind of failure of a trial that took longer than it was given."""

DIED = "died"
"""The kind of failure of a trial whose worker process ended before the trial did."""


@dataclass(frozen=True)
class Failure:
    """A trial that gave no value.

    Parameters
    ----------
    index : int
        Which of the study's trials.
    recipe : Recipe
        What makes its seed.
    kind : str
        The class of what it raised, ``"died"`` if it took its worker process down, or
        ``"timeout"`` if it took longer than it was given.
    traceback : str
        The worker's traceback; for a worker that died, what the pool knows of its end.
    """

    index: int
    recipe: Recipe
    kind: str
    traceback: str

    @property
    def seed(self) -> SeedSequence:
        """The trial's seed, made afresh: ``trial(failure.seed)`` fails again."""
        return self.recipe.seed()

    def __str__(self) -> str:
        lines = self.traceback.strip().splitlines()
        what = lines[-1] if lines and self.kind != DIED else "its worker process died"
        return f"trial {self.index}, {self.recipe}: {what}"


@dataclass(frozen=True, eq=False)
class Study:
    """The values of a study's trials, whole or in part.

    Parameters
    ----------
    values : tuple
        What each trial returned, in the order of the seeds; None where there is no value.
    done : array of bool, (n,)
        Which trials returned.
    failures : tuple of Failure
        Which raised or died, in the order of the seeds.
    seconds : float
        Wall time of the run.
    recipes : tuple of Recipe
        What makes each seed; `seeds` makes them.
    code : mapping from str to str
        The trial's name and the `fingerprint` of its source, empty if the source is not at hand.

    Examples
    --------
    >>> from bookkit import studies
    >>> study = studies.run(lambda seed: seed.spawn_key[0] ** 2, studies.spawn(1, 4), workers=1)
    >>> study.values, study.failures, study.array()
    ((0, 1, 4, 9), (), array([0., 1., 4., 9.]))
    """

    values: tuple[Any, ...]
    done: NDArray[np.bool_]
    failures: tuple[Failure, ...]
    seconds: float
    recipes: tuple[Recipe, ...]
    code: Mapping[str, str] = dataclasses.field(default_factory=dict)

    def __post_init__(self) -> None:
        n = len(self.recipes)
        for name, size in (("values", len(self.values)), ("done", len(self.done))):
            if size != n:
                raise ValueError(f"{name}: needs one for each of {n} seeds, got {size}")
        done = np.array(self.done, dtype=bool)
        done.setflags(write=False)
        object.__setattr__(self, "done", done)
        for failure in self.failures:
            if failure.index >= n or done[failure.index]:
                raise ValueError(f"failures: trial {failure.index} is done, or not of this study")

    def __len__(self) -> int:
        return len(self.values)

    def __repr__(self) -> str:
        return (
            f"Study({len(self)} trials: {int(self.done.sum())} done, "
            f"{len(self.failures)} failed, {len(self.missing)} not run)"
        )

    @property
    def missing(self) -> tuple[int, ...]:
        """The trials that were not run to an end; run their `seed` to complete the study."""
        ended = self.done.copy()
        ended[[failure.index for failure in self.failures]] = True
        return tuple(int(i) for i in np.flatnonzero(~ended))

    def seed(self, index: int) -> SeedSequence:
        """The seed of a trial, made afresh."""
        if count(index, "index", at_least=0) >= len(self):
            raise ValueError(f"index: needs one of {len(self)} trials, got {index}")
        return self.recipes[index].seed()

    @property
    def seeds(self) -> list[SeedSequence]:
        """All seeds, made afresh."""
        return [recipe.seed() for recipe in self.recipes]

    def array(self) -> Array:
        """The values of the trials that are done, stacked: (done, ...)."""
        kept = [v for v, done in zip(self.values, self.done, strict=True) if done]
        try:
            return array(np.array(kept), "values", finite=False)
        except ValueError as error:  # numpy's own, for shapes that differ
            raise ValueError(f"values: needs numbers of one shape to stack: {error}") from None

    def metrics(self, columns: Sequence[str]) -> dict[str, Array]:
        """Named numbers of the trials that are done, each (done,).

        Parameters
        ----------
        columns : sequence of str
            Keys or attributes to take from each value; the names of its entries, all of them and
            in order, if a value is a number or a vector.
        """
        names = column_names(columns)
        kept = [v for v, done in zip(self.values, self.done, strict=True) if done]
        table = np.array([row(v, names) for v in kept]).reshape(len(kept), len(names))
        return {name: table[:, k] for k, name in enumerate(names)}

    def frame(self, columns: Sequence[str]) -> Any:
        """`metrics` as a pandas DataFrame, whose index is the trial."""
        import pandas

        index = pandas.Index(np.flatnonzero(self.done), name="trial")
        return pandas.DataFrame(self.metrics(columns), index=index)


def column_names(columns: Any) -> tuple[str, ...]:
    """The names of metrics: different identifiers, at least one."""
    given = () if isinstance(columns, str) or not isinstance(columns, Sequence) else tuple(columns)
    good = bool(given) and all(isinstance(c, str) and c.isidentifier() for c in given)
    if not good or len(set(given)) != len(given):
        raise ValueError(f"columns: needs a list of different identifiers, got {columns!r}")
    return given


def row(value: Any, columns: Sequence[str]) -> tuple[float, ...]:
    """The metrics of one value; a whole number that a float does not hold is refused."""
    entries: list[Any]
    if isinstance(value, Mapping):
        lost = [c for c in columns if c not in value]
        entries = [value.get(c) for c in columns]
    elif dataclasses.is_dataclass(value) or hasattr(value, "_fields"):
        lost = [c for c in columns if not hasattr(value, c)]
        entries = [getattr(value, c, None) for c in columns]
    else:
        vector = isinstance(value, list | tuple) or (isinstance(value, np.ndarray) and value.ndim)
        lost, entries = [], list(value) if vector else [value]
        if len(entries) != len(columns):
            raise ValueError(
                f"columns: needs as many as a trial's value has numbers, {len(entries)}, "
                f"got {len(columns)}"
            )
    if lost:
        raise ValueError(f"columns: needs names that every trial's value has, got {lost}")
    out = []
    for column, entry in zip(columns, entries, strict=True):
        number = _float(entry)
        if number is None:
            raise ValueError(f"values: needs a real number for {column}, got {entry!r}")
        out.append(number)
    return tuple(out)


def _float(entry: Any) -> float | None:
    real = isinstance(entry, bool | int | float | np.number | np.bool_ | np.ndarray)
    if not real or np.ndim(entry) or np.iscomplexobj(entry):
        return None
    number = float(entry)
    return number if number == entry or number != number else None


class StudyError(RuntimeError):
    """A study that could not be finished; ``study`` holds what was done before."""

    def __init__(self, message: str, study: Study) -> None:
        super().__init__(message)
        self.study = study


class StudyInterrupted(KeyboardInterrupt):
    """Ctrl-C during a study; ``study`` holds what was done before.

    It is a KeyboardInterrupt: who does not catch it sees what Ctrl-C always does. In a notebook,
    ``import sys; sys.last_value.study`` finds the partial study after the cell has stopped.
    """

    def __init__(self, message: str, study: Study) -> None:
        super().__init__(message)
        self.study = study
