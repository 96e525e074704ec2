"""The stored study of the constrained pendulum, against an independent computation of it.

That one had other seeds, so a median has to agree within its 95% interval: the interval meets the
band in which the other study's medians lie.
"""

from __future__ import annotations

import numpy as np
import pytest

from bookkit import studies
from distfilt.metrics import median_interval, proportion_interval

STORED = studies.stored("das", "pendulum")


def _of(name: str) -> np.ndarray:
    value = STORED.metric(name)
    return value[np.isfinite(value)]


def _share(hits: np.ndarray) -> tuple[float, float]:
    found = proportion_interval(int(hits.sum()), hits.size)
    return found.low, found.high


def _meets(interval: tuple[float, float], band: tuple[float, float]) -> bool:
    return interval[0] <= band[1] and interval[1] >= band[0]


@pytest.mark.parametrize(
    ("algorithm", "low", "high"),
    [
        ("OTF", 0.16, 0.24),
        ("OTMA", 0.09, 0.19),
        ("OTNLeq", 3e-4, 8e-4),
        ("OTNLeqMA", 2.5e-4, 6e-4),
    ],
)
def test_median_constraint_errors(algorithm: str, low: float, high: float) -> None:
    found = median_interval(_of(f"{algorithm}_constraint"))
    assert low <= found.estimate <= high and _meets((found.low, found.high), (low, high))


def test_projecting_the_report_helps_little() -> None:
    found = median_interval(
        STORED.metric("OTProj_constraint") / STORED.metric("OTF_constraint")
    )
    assert found.low > 0.6 and found.high < 1.0


def test_the_filter_without_a_constraint_diverges() -> None:
    assert _meets(_share(STORED.metric("OTF_diverged") > 0), (0.80, 0.95))
    onset = median_interval(_of("OTF_onset"))
    assert onset.low >= 3.0 and onset.high <= 5.0


def test_feedback_beats_augmentation_in_nearly_every_run() -> None:
    better = STORED.metric("OTNLeq_constraint") < STORED.metric("OTMA_constraint")
    assert _share(better)[1] >= 0.95


def test_retraction_keeps_the_constraint_and_the_swing() -> None:
    assert STORED.metric("retraction_constraint").max() <= 1e-14
    assert np.median(STORED.metric("retraction_position")) <= 0.025
    ratio = STORED.metric("retraction_position") / STORED.metric("OTNLeq_position")
    assert median_interval(ratio[np.isfinite(ratio)]).high < 0.5
    # None of the other study's hundred runs diverged: at most 3.6% do, with 95% confidence.
    assert _share(STORED.metric("retraction_diverged") > 0)[0] < 0.036
    assert STORED.metric("rejuvenated_diverged").sum() == 0


def test_runs_that_leave_the_finite_numbers_are_few() -> None:
    for name in ("OTF", "OTProj", "OTMA", "OTNLeq", "OTNLeqMA", "retraction", "rejuvenated"):
        assert (STORED.metric(f"{name}_finite") == 0).sum() <= 2
