"""The record of a run: truth with gaps, truth as a function, named components, kept variables.

| Report | Situation |
|---|---|
| review L 8 | ground truth with gaps, and at other times than the steps |
| review L 8 | NEES of a robot's own pose in a joint state |
| review L | 3.6 GB of covariances for 100 000 times, which nobody needs |

A filter without sensors has known moments, so that each score follows by hand.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
import pandas
import pytest
import xarray

from distfilt import filters
from distfilt.models import Model
from distfilt.network import graphs
from distfilt.sensors import component

NAMES = ("x", "y", "v")
STILL = Model(
    3, lambda x, t, dt: x, lambda t, dt: np.zeros((3, 3)), names=NAMES, units=("m",) * 3
)
MEANS = np.array([[0.0, 1.0, 2.0], [5.0, -1.0, 0.5]])
COVS = np.array(
    [
        [[1.0, 0.3, 0.1], [0.3, 0.5, 0.0], [0.1, 0.0, 2.0]],
        [[0.4, -0.1, 0.0], [-0.1, 0.9, 0.2], [0.0, 0.2, 0.7]],
    ]
)
TIMES = np.array([1.0, 2.5, 4.0])
TRUTH = np.array([[0.3, 0.9, 1.0], [0.5, 1.4, 2.5], [-1.0, 0.0, 3.0]])


def run(**options: Any) -> xarray.Dataset:
    """Run two agents that observe nothing, so that means and covariances stay."""
    f = filters.GaussianFilter(STILL, [None, None], share_observations=False)
    start = f.start(list(zip(MEANS, COVS, strict=True)))
    return f.run(start, TIMES, [None, None], **options)


def nees(agent: int, error: np.ndarray, index: list[int]) -> float:
    # eᵀ P⁻¹ e of the components in the index, whose covariance is their block
    cov = COVS[agent][np.ix_(index, index)]
    return float(error @ np.linalg.inv(cov) @ error)


@pytest.mark.parametrize("form", ["array", "function", "names", "table", "functions"])
def test_truth_with_gaps_in_every_form(form: str) -> None:
    """Scores are NaN where nothing is known, component by component, and right elsewhere."""
    gaps = TRUTH.copy()
    gaps[1] = np.nan
    gaps[2, 1] = np.nan
    forms = {
        "array": gaps,
        "function": lambda t: gaps[np.flatnonzero(t == TIMES)[0]],
        "names": {name: gaps[:, k] for k, name in enumerate(NAMES)},
        "table": pandas.DataFrame(gaps, columns=NAMES),
        "functions": {
            name: partial(lambda k, t: gaps[np.flatnonzero(t == TIMES)[0], k], k)
            for k, name in enumerate(NAMES)
        },
    }
    record = run(truth=forms[form])
    squared = (MEANS - gaps[:, None]) ** 2
    assert np.allclose(record["squared_error"], squared, equal_nan=True)
    for agent in range(2):
        expected = nees(agent, MEANS[agent] - TRUTH[0], [0, 1, 2])
        scores = record["nees"].values[:, agent]
        # Scores of the whole state need all of it.
        assert np.isclose(scores[0], expected)
        assert np.isnan(scores[1:]).all()
    total = record["total_squared_error"].values
    assert np.allclose(total[0], squared[0].sum(axis=-1))
    assert np.isnan(total[1:]).all()
    # CRPS of a known component is that of a run in which all are known.
    complete = run(truth=TRUTH)["crps"].values
    is_known = ~np.isnan(squared)
    crps = record["crps"].values
    assert np.array_equal(np.isnan(crps), ~is_known)
    assert np.allclose(crps[is_known], complete[is_known])


def test_a_function_of_time_between_rare_truths() -> None:
    """The user interpolates ground truth of another clock; each agent has a truth of its own."""
    grid = np.array([0.0, 2.0, 5.0])
    path = np.array([0.0, 4.0, 1.0])
    record = run(
        truth={"x": lambda t: np.interp(t, grid, path), "y": lambda t: [t, -t]}
    )
    # At 1, 2.5 and 4 s between (0, 0), (2, 4) and (5, 1)
    x = np.array([2.0, 3.5, 2.0])
    error = record["squared_error"].values
    # By time and agent; the second component is t for one agent, and -t for the other.
    y = TIMES[:, None] * [1, -1]
    assert np.allclose(error[..., 0], (MEANS[:, 0] - x[:, None]) ** 2)
    assert np.allclose(error[..., 1], (MEANS[:, 1] - y) ** 2)
    assert np.isnan(error[..., 2]).all()
    for agent, sign in enumerate((1, -1)):
        expected = nees(agent, MEANS[agent, :2] - [x[1], sign * 2.5], [0, 1])
        assert np.isclose(record["nees"].values[1, agent], expected)


@pytest.mark.parametrize("family", ["gaussian", "ensemble"])
def test_nees_of_named_components_and_of_each_agents_own(family: str) -> None:
    scored: dict[str, Any] = {
        "common": ["v", "x"],
        "own": [["x", "y"], ["y", "v"]],
    }
    index = {"common": [[2, 0], [2, 0]], "own": [[0, 1], [1, 2]]}
    for form, components in scored.items():
        if family == "gaussian":
            record = run(truth=TRUTH, scored=components)
            means = MEANS
            covs = COVS
        else:
            members = np.random.default_rng(0).standard_normal((2, 9, 3))
            f = filters.EnsembleFilter(
                STILL, [None, None], share_observations=False, members=9
            )
            start = f.start(members, rng=np.random.default_rng(0))
            record = f.run(start, TIMES, [None, None], truth=TRUTH, scored=components)
            means = members.mean(axis=1)
            covs = np.array([np.cov(x.T) for x in members])
        for agent, columns in enumerate(index[form]):
            error = (means[agent] - TRUTH)[:, columns]
            inverse = np.linalg.inv(covs[agent][np.ix_(columns, columns)])
            # eᵀ P⁻¹ e at each time
            expected = np.einsum("ti,ij,tj->t", error, inverse, error)
            assert np.allclose(record["nees"].values[:, agent], expected)
            total = record["total_squared_error"].values[:, agent]
            assert np.allclose(total, (error**2).sum(axis=-1))
        # Other components still have scores of their own.
        assert np.isfinite(record["squared_error"]).all()


def test_a_failed_run_of_members_has_no_score_and_gaps_have_none() -> None:
    """Members of two runs; the second one fails at 2.5 s, and keeps its members from then on."""
    failing = Model(
        1,
        lambda x, t, dt: np.where((x > 50) & (t > 0.5), np.nan, x),
        lambda t, dt: np.zeros((1, 1)),
    )
    f = filters.EnsembleFilter(failing, [None], members=4, on_error="keep")
    # By run and agent, four members with one component
    offsets = np.array([0.0, 60.0])[:, None, None, None]
    members = np.arange(4.0)[:, None] + offsets
    start = f.start(members, rng=np.random.default_rng(0), runs=(2,))
    truth = np.array([1.0, np.nan, 2.0])
    by_run = np.stack([truth, truth + 60.0], axis=1)[..., None]
    record = f.run(start, TIMES, [None], truth=by_run)
    # E|X - y| - E|X - X'| / 2 of four equal steps: 1 - 0.625 at both known truths
    expected = np.array([[0.375, 0.375], [np.nan, np.nan], [0.375, np.nan]])
    assert np.allclose(record["crps"].values[..., 0, 0], expected, equal_nan=True)
    is_missing = np.isnan(record["squared_error"].values[..., 0, 0])
    assert np.array_equal(is_missing, np.isnan(expected))
    # Nothing was left out in the first run; of the failed one nobody knows.
    unseen = np.array([[0.0, 0.0], [0.0, np.nan], [0.0, np.nan]])
    assert np.array_equal(record["unseen"].values[..., 0], unseen, equal_nan=True)


def test_scored_components_bridge_gaps_of_the_others() -> None:
    gaps = TRUTH.copy()
    # The second component is never known, and is not scored.
    gaps[:, 1] = np.nan
    record = run(truth=gaps, scored=["x", "v"])
    expected = nees(1, MEANS[1][[0, 2]] - TRUTH[2, [0, 2]], [0, 2])
    assert np.isclose(record["nees"].values[2, 1], expected)


@pytest.mark.parametrize("lag", [0, 2])
def test_what_is_kept_is_the_same_and_the_rest_is_not_there(lag: int) -> None:
    sensors = [component([0], std=0.5), None]
    f = filters.GaussianFilter(
        STILL,
        sensors,
        graphs.path(2),
        lag=2,
        gate_probability=0.9,
        record_evidence=True,
    )
    start = f.start(list(zip(MEANS, COVS, strict=True)))
    call = f.smooth if lag else f.run
    args = (start, TIMES, [TRUTH[:, :1], None])
    complete = call(*args, truth=TRUTH)
    for keep in (["nees", "spread", "rejected"], ("bytes_total", "crps"), []):
        part = call(*args, truth=TRUTH, keep=keep)
        assert set(part.data_vars) == {"mean", *keep}
        names = list(part.data_vars)
        xarray.testing.assert_identical(part, complete[["mean", *keep]][names])
        # The last state is kept whatever the record has.
        last = f.final_state(part)
        expected = f.final_state(complete)
        assert np.array_equal(last.joint_means, expected.joint_means)
    # Without a single time, the same variables.
    empty = f.run(start, [], [np.zeros((0, 1)), None], truth=TRUTH[:0], keep=["nees"])
    assert set(empty.data_vars) == {"mean", "nees"}
    assert empty["nees"].shape == (0, 2)


def test_a_long_run_without_covariances_holds_none() -> None:
    """Of 20 numbers, 400 of a covariance are left out: a twentieth of the memory."""
    still = Model(20, lambda x, t, dt: x, lambda t, dt: np.zeros((20, 20)))
    f = filters.GaussianFilter(still, [None])
    start = f.start((np.zeros(20), np.eye(20)))
    times = np.arange(1.0, 301.0)
    complete = f.run(start, times, [None])
    part = f.run(start, times, [None], keep=["variance"])
    # 300 times, numbers of 8 bytes: 20² of a covariance; 20 + 20 of moments and a few more
    assert complete.nbytes > 300 * 400 * 8
    assert part.nbytes < 300 * 45 * 8


@pytest.mark.parametrize(
    ("options", "text"),
    [
        (
            {"keep": ["covar"]},
            r"keep must have names among .*covariance.*got \['covar'\]",
        ),
        ({"keep": ["nees"]}, r"keep must have names among"),
        ({"keep": "mean"}, "keep must be a sequence, .* got 'mean'"),
        ({"scored": ["x"]}, "scored must be None without a truth"),
        (
            {"truth": TRUTH, "scored": ["z"]},
            "scored must have different names among x, y, v",
        ),
        ({"truth": TRUTH, "scored": ["x", "x"]}, "scored must have different names"),
        ({"truth": TRUTH, "scored": [["x"]]}, "one list for each of 2 agents, got 1"),
        ({"truth": TRUTH, "scored": [["x"], ["x", "y"]]}, "as many components"),
        ({"truth": TRUTH, "scored": []}, "as many components, one or more"),
        ({"truth": TRUTH, "scored": "xy"}, "scored must be a sequence of names"),
        ({"truth": lambda t: np.zeros(2)}, r"truth must be shape \(3, 3\)"),
        ({"truth": {"x": lambda t: np.zeros(3)}}, "truth must have shape"),
        ({"truth": lambda t: np.zeros(2 if t < 2 else 3)}, "one shape at all times"),
    ],
)
def test_wrong_options_are_refused_by_name(options: dict[str, Any], text: str) -> None:
    with pytest.raises(ValueError, match=text):
        run(**options)
