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


LEADS = STORED.metric("OTNLeq_constraint") < STORED.metric("OTMA_constraint")


@pytest.mark.parametrize(("name", "over", "low", "high"), [
    ("OTF_constraint", "", 0.16, 0.24),
    ("OTMA_constraint", "", 0.09, 0.19),
    ("OTNLeq_constraint", "", 3e-4, 8e-4),
    ("OTNLeqMA_constraint", "", 2.5e-4, 6e-4),
    ("OTF_onset", "", 3.0, 5.0),
    ("OTProj_constraint", "OTF_constraint", 0.6, 1.0),
    ("retraction_position", "OTNLeq_position", 0.0, 0.5),
])
def test_medians_of_errors_and_of_their_ratios(
    name: str, over: str, low: float, high: float
) -> None:
    value = STORED.metric(name) / (STORED.metric(over) if over else 1.0)
    found = median_interval(value[np.isfinite(value)])
    # The paper's methods' errors by the estimate, what is said of a difference by the interval.
    ends = (found.low, found.high) if over or name == "OTF_onset" else (found.estimate,)
    assert all(low <= end <= high for end in ends)


@pytest.mark.parametrize(("hits", "low", "high"), [
    (STORED.metric("OTF_diverged") > 0, 0.80, 0.95),
    (LEADS, 0.95, 1.0),
    # None of the other study's hundred runs diverged: at most 3.6% do, with 95% confidence.
    (STORED.metric("retraction_diverged") > 0, 0.0, 0.036),
])
def test_shares_of_runs(hits: np.ndarray, low: float, high: float) -> None:
    found = proportion_interval(int(hits.sum()), hits.size)
    assert low <= found.high and found.low <= high


def test_runs_that_leave_the_finite_numbers_are_few() -> None:
    for name in ("OTF", "OTProj", "OTMA", "OTNLeq", "OTNLeqMA", "retraction", "rejuvenated"):
        assert (STORED.metric(f"{name}_finite") == 0).sum() <= 2
