"""Trials and studies that several of these tests run."""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.random import SeedSequence

from bookkit import studies
from bookkit.studies import Failure, Stored, Study


class Scores(NamedTuple):
    rmse: float
    nees: float


def draw(seed: SeedSequence) -> Any:
    """A trial with linear algebra and child streams, whose bits show any difference."""
    first, second = (np.random.default_rng(child) for child in seed.spawn(2))
    x = first.normal(size=(40, 40))
    return np.linalg.eigvalsh(x @ x.T)[[0, -1]], second.normal()


def number(seed: SeedSequence) -> int:
    return int(seed.spawn_key[0])


def scores(seed: SeedSequence) -> Scores:
    a, b = np.random.default_rng(seed).normal(size=2)
    return Scores(float(abs(a)), float(b * b))


def fails_at(bad: tuple[int, ...], seed: SeedSequence) -> float:
    if seed.spawn_key[0] in bad:
        raise ArithmeticError(f"trial {seed.spawn_key[0]} diverged")
    return float(seed.spawn_key[0])


def dies_at(bad: tuple[int, ...], seed: SeedSequence) -> int:
    if seed.spawn_key[0] in bad:
        os._exit(3)
    time.sleep(0.002)
    return int(seed.spawn_key[0])


def small_study(**options: Any) -> Study:
    return studies.run(scores, studies.spawn(5, 6), workers=1, **options)


def partial_study() -> Study:
    recipes = small_study().recipes
    return Study((1.0,) * 6, np.arange(6) < 4, (), 0.0, recipes)


def with_failure(kind: str) -> Study:
    recipes = small_study().recipes
    failure = Failure(5, recipes[5], kind, "")
    return Study((Scores(1.0, 2.0),) * 6, np.arange(6) < 5, (failure,), 0.0, recipes)


def example() -> Stored:
    recipes = tuple(small_study().recipes[:2])
    return Stored(Path("a.csv"), {}, {}, {}, recipes, ("", ""), {"rmse": np.ones(2)})
