"""What chapter 9b says about its stored runs, and the density of chapter 9's four agents."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest

from bookkit import studies
from distfilt import density
from distfilt.metrics import mean_interval

densities = studies.script("densities")
CASES = list(product(densities.INTERPRETATIONS, densities.STARTS))


def errors(interpretation: str, start: str, name: str) -> np.ndarray:
    """Return the stored values of six runs."""
    runs = studies.stored("zheng", "densities")
    values: np.ndarray = runs.metric(f"{interpretation}_{start}_{name}")
    return values


@pytest.mark.parametrize(("interpretation", "start"), CASES)
def test_law_filter_beats_the_kernel_estimate_but_not_the_open_loop(
    interpretation: str, start: str
) -> None:
    kernel, filtered, open_loop = (
        errors(interpretation, start, name) for name in ("kde", "filter", "open")
    )
    assert (filtered < kernel).all()
    assert (open_loop < kernel).all()
    ratio = filtered.mean() / kernel.mean()
    assert ratio < (0.01 if interpretation == "gibbs" else 0.5)
    # The mean is on the open loop's side; six runs do not exclude zero.
    difference = mean_interval(filtered - open_loop)
    assert difference.low < 0 < difference.estimate
    # In this case nearly all of the interval lies above zero.
    is_nearly_behind = -difference.low < 0.1 * difference.high
    assert is_nearly_behind == ((interpretation, start) == ("slowgibbs", "uniform"))


@pytest.mark.parametrize("start", densities.STARTS)
@pytest.mark.parametrize("name", ["filter", "open"])
def test_one_look_is_beaten_from_the_peaked_start_only(start: str, name: str) -> None:
    difference = errors("slowgibbs", start, name) - errors("slowgibbs", start, "bound")
    assert (difference < 0).sum() == (6 if start == "peaked" else 0)


@pytest.mark.parametrize(("interpretation", "start"), CASES)
def test_only_the_one_look_reports_its_errors(interpretation: str, start: str) -> None:
    look, filtered = (
        np.median(errors(interpretation, start, f"{name}_nees"))
        for name in ("bound", "filter")
    )
    assert look < 1.1
    # Ten to fifty times too little, as a standard deviation
    assert 10 < np.sqrt(filtered) < 51


@pytest.mark.parametrize(("interpretation", "start"), CASES)
@pytest.mark.parametrize("blocks", densities.BLOCKS)
def test_count_the_present_positions_decide(
    interpretation: str, start: str, blocks: int
) -> None:
    kernel, filtered, truth = (
        errors(interpretation, start, f"{name}_count_{blocks}")
        for name in ("kde", "filter", "truth")
    )
    assert (kernel < truth).all()
    assert (kernel < filtered).all()
    # Slow agents are followed by the filter, fast ones are not.
    follows = mean_interval(filtered - truth).high < 0
    assert follows == (interpretation == "slowgibbs")


@pytest.mark.parametrize(
    ("interpretation", "name", "is_better"),
    [
        ("gibbs", "process", True),
        ("gibbs", "filter", False),
        ("slowgibbs", "process", True),
        ("slowgibbs", "filter", True),
    ],
)
def test_wrong_model_is_corrected_where_the_covariance_is_large(
    interpretation: str, name: str, is_better: bool
) -> None:
    found = errors(interpretation, "wrong", name)
    differences = [
        mean_interval(found - errors(interpretation, "wrong", other))
        for other in ("kde", "open")
    ]
    assert all(d.high < 0 for d in differences) == is_better


def test_four_agents_by_hand() -> None:
    # Two cells; half of the difference between them remains after a step.
    phi = np.array([[0.75, 0.25], [0.25, 0.75]])
    histogram = np.array([1.5, 0.5])
    state = density.low_rank_start(np.array([[1.0], [-1.0]]), np.ones((1, 2)))
    state = density.low_rank_step(state, histogram, np.full(2, 0.5), 1.0)
    state = density.low_rank_predict(state, lambda values: values @ phi.T)
    assert np.allclose(state.estimates[0], [1.2, 0.8])
    assert np.isclose(state.covariance(0)[0, 0], 0.05)
    state = density.low_rank_step(state, histogram, np.full(2, 0.5), 1.0)
    assert np.allclose(state.estimates[0], [1.25, 0.75])
    assert np.isclose(state.covariance(0)[0, 0], 0.25 / 6)
