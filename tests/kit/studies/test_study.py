"""What a study gives back, and which code made it."""

from __future__ import annotations

import textwrap
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import pytest
from numpy.random import SeedSequence

from bookkit import studies
from bookkit.studies import Failure, Study

from .trials import Scores, draw, fails_at, small_study

_P = "bookkit.studies."
_REFUSED = {
    _P + "Study": [
        ("values", lambda: Study((), np.ones(6), (), 0.0, small_study().recipes)),
        ("done", lambda: Study((None,) * 6, np.ones(5), (), 0.0, small_study().recipes)),
        (
            "failures",
            lambda: Study(
                (1.0,) * 6,
                np.ones(6),
                (Failure(0, small_study().recipes[0], "", ""),),
                0.0,
                small_study().recipes,
            ),
        ),
        ("index", lambda: small_study().seed(6)),
        ("index", lambda: small_study().seed(-1)),
        ("values", lambda: studies.run(draw, [1, 2], workers=1).array()),
        ("columns", lambda: small_study().metrics("rmse")),
        ("columns", lambda: small_study().metrics(["rmse", "rmse"])),
        ("columns", lambda: small_study().metrics(["crps"])),
        ("columns", lambda: studies.run(np.random.default_rng, [1], workers=1).metrics([])),
        ("values", lambda: studies.run(draw, [1], workers=1).metrics(["a", "b"])),
        ("columns", lambda: studies.run(partial(fails_at, ()), studies.spawn(1, 2), workers=1)
            .metrics(["a", "b"])),
    ],
    _P + "fingerprint": [
        ("function", lambda: studies.fingerprint(3)),
        ("function", lambda: studies.fingerprint(len)),
    ],
}
_NONE = {_P + "Failure": "made by run, from what a worker sends"}


def test_metrics_of_mappings_tuples_vectors_and_numbers() -> None:
    @dataclass(frozen=True)
    class Score:
        b: float
        a: int

    seeds = studies.spawn(1, 4)
    trials: list[Callable[[SeedSequence], Any]] = [
        lambda s: {"b": 0.5, "a": s.spawn_key[0]},
        lambda s: Score(0.5, s.spawn_key[0]),
        lambda s: np.array([s.spawn_key[0], 0.5]),
        lambda s: (s.spawn_key[0], np.float32(0.5)),
    ]
    for trial in trials:
        found = studies.run(trial, seeds, workers=1).metrics(["a", "b"])
        assert list(found) == ["a", "b"]
        assert found["a"].tolist() == [0, 1, 2, 3] and found["b"].tolist() == [0.5] * 4
    study = studies.run(partial(fails_at, (1,)), seeds, workers=1, errors="collect")
    assert study.metrics(["x"])["x"].tolist() == [0, 2, 3] == study.array().tolist()
    frame = study.frame(["x"])
    assert frame.index.tolist() == [0, 2, 3] and frame["x"].tolist() == [0, 2, 3]


def test_done_cannot_be_written() -> None:
    with pytest.raises(ValueError, match="read-only"):
        small_study().done[0] = False


def test_fingerprint_follows_the_source() -> None:
    def one() -> int:
        return 1

    def two() -> int:
        return 2

    assert studies.fingerprint(one) != studies.fingerprint(two)
    assert studies.fingerprint(partial(fails_at, (1,))) == studies.fingerprint(fails_at)
    assert studies.fingerprint(Scores) != studies.fingerprint(fails_at)
    # What a reader computes by hand.
    import hashlib
    import inspect

    text = textwrap.dedent(inspect.getsource(one)).strip()
    assert studies.fingerprint(one) == hashlib.sha256(text.encode()).hexdigest()[:16]
