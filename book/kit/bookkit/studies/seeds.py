"""Seeds of trials: how they are made, and what is kept of one so that it can be made again."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.random import SeedSequence

from distfilt.checks import count

__all__ = ["spawn"]

POOL_SIZE = 4
"""numpy's default size of a seed's entropy pool, in words."""


class Recipe(NamedTuple):
    """What makes a seed. A SeedSequence itself changes whenever ``spawn`` is called on it."""

    entropy: int | tuple[int, ...]
    spawn_key: tuple[int, ...]
    pool_size: int

    def seed(self) -> SeedSequence:
        """A seed that nobody has spawned from."""
        return SeedSequence(self.entropy, spawn_key=self.spawn_key, pool_size=self.pool_size)

    def __str__(self) -> str:
        key = f", spawn_key={self.spawn_key}" if self.spawn_key else ""
        size = f", pool_size={self.pool_size}" if self.pool_size != POOL_SIZE else ""
        return f"SeedSequence({self.entropy}{key}{size})"


def spawn(root: int, n: int) -> list[SeedSequence]:
    """The seeds of n independent trials.

    Parameters
    ----------
    root : int
        The study's seed, not negative.
    n : int
        How many, at least 1. Seed i is ``SeedSequence(root, spawn_key=(i,))``, whatever n is: a
        study that is continued later keeps the trials that it has.

    Examples
    --------
    >>> [seed.spawn_key for seed in spawn(2023, 3)]
    [(0,), (1,), (2,)]
    """
    entropy = count(root, "root", at_least=0)
    return [SeedSequence(entropy, spawn_key=(i,)) for i in range(count(n, "n"))]


def _is_count(value: Any) -> bool:
    integral = isinstance(value, int | np.integer) and not isinstance(value, bool | np.timedelta64)
    return integral and value >= 0


def recipe(seed: Any, name: str = "seeds") -> Recipe:
    """What makes a seed, which is a SeedSequence or a nonnegative integer."""
    if type(seed) is SeedSequence and type(seed.entropy) is int and seed.entropy >= 0:
        return Recipe(seed.entropy, tuple(map(int, seed.spawn_key)), seed.pool_size)
    if _is_count(seed):
        return Recipe(int(seed), (), POOL_SIZE)
    if not isinstance(seed, SeedSequence):
        raise ValueError(
            f"{name}: needs a SeedSequence or a nonnegative integer for each trial "
            f"(studies.spawn makes them), got {seed!r}"
        )
    entropy: Any = seed.entropy
    if isinstance(entropy, Sequence | np.ndarray) and not isinstance(entropy, str):
        words = tuple(int(word) for word in entropy if _is_count(word))
        if not words or len(words) != len(entropy):
            raise ValueError(f"{name}: needs integers as entropy, got {entropy!r}")
        # numpy draws the same from [5] as from 5.
        entropy = words[0] if len(words) == 1 else words
    elif not _is_count(entropy):
        raise ValueError(f"{name}: needs integers as entropy, got {entropy!r}")
    key = tuple(int(k) for k in seed.spawn_key)
    return Recipe(entropy if isinstance(entropy, tuple) else int(entropy), key, seed.pool_size)


def recipes(seeds: Any) -> tuple[Recipe, ...]:
    """What makes the seeds of a study; the same seed twice would be the same trial twice."""
    if isinstance(seeds, str | bytes) or not isinstance(seeds, Iterable):
        raise ValueError(
            f"seeds: needs a sequence of SeedSequence or integers (studies.spawn makes one), "
            f"got {type(seeds).__name__}"
        )
    out = tuple(recipe(seed) for seed in seeds)
    if not out:
        raise ValueError("seeds: needs at least one, got none")
    first: dict[Recipe, int] = {}
    for i, made in enumerate(out):
        if made in first:
            raise ValueError(f"seeds: needs different seeds, got {made} as {first[made]} and {i}")
        first[made] = i
    return out
