"""Quantities of the satellites' studies: how an angle wraps, and which data a case has."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from bookkit import studies
from distfilt import sensors, updates
from distfilt.filters import EnsembleFilter
from distfilt.models import Model

satellites = studies.script("_satellites")
figure = studies.script("figure-1")
inputs = studies.script("figure-1-inputs")


def predictions(angle_rule: str, members: np.ndarray, angle: float) -> np.ndarray:
    """Return the predictions that an update gets for members and an observed angle."""
    received: list[np.ndarray] = []

    @updates.update
    def record(
        ensemble: np.ndarray,
        predicted: np.ndarray,
        observed: np.ndarray,
        noise: np.ndarray,
        *,
        rng: np.random.Generator,
    ) -> np.ndarray:
        received.append(predicted[..., 0].ravel())
        return ensemble

    rule = satellites.align_each(record) if angle_rule == "each" else record
    still = Model(2, lambda x, t, dt: x, lambda t, dt: 1e-18 * np.eye(2))
    f = EnsembleFilter(
        still, [sensors.line_angle([0, 1], std=0.2)], update=rule, members=len(members)
    )
    state = f.start((np.zeros(2), np.eye(2)), rng=np.random.default_rng(1))
    f.step(state.replace(ensembles=members[None]), 1.0, [np.array([angle])])
    return received[0]


def test_each_prediction_is_brought_near_the_observation_by_itself() -> None:
    # Lines at angles of 0.1 to 3.0 rad on one side of the origin, observed at 0.2 rad
    angles = np.linspace(0.1, 3.0, 30)
    members = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    each = predictions("each", members, 0.2)
    assert np.abs(each - 0.2).max() <= np.pi / 2
    # They are the members' angles, up to whole periods.
    turns = (each - angles) / np.pi
    assert np.allclose(turns, np.round(turns))
    assert np.ptp(np.round(turns)) == 1
    # On one branch neighbours stay neighbours.
    together = predictions("together", members, 0.2)
    assert np.allclose(np.diff(together), np.diff(angles))


def test_update_of_wrapped_innovations_is_the_affine_map_where_nothing_wraps() -> None:
    rng = np.random.default_rng(2)
    x = rng.standard_normal((50, 3))
    h = x[:, :2] @ rng.standard_normal((2, 2))
    noise = np.diag([0.3, 0.2])
    y = np.array([0.4, -0.1])
    ours = inputs.wrap_innovations(x, h, y, noise, rng=np.random.default_rng(3))
    theirs = updates.enkf_sampled_covariance(
        x, h, y, noise, rng=np.random.default_rng(3)
    )
    assert np.allclose(ours, theirs)


def test_update_of_wrapped_innovations_takes_the_shorter_way() -> None:
    # The third of three numbers is an angle: an observed angle one period away is the same.
    rng = np.random.default_rng(4)
    x = rng.standard_normal((50, 3))
    noise = 0.01 * np.eye(3)
    near, far = (
        inputs.wrap_innovations(
            x, x, np.array([0.1, 0.2, angle]), noise, rng=np.random.default_rng(5)
        )
        for angle in (0.3, 0.3 + np.pi)
    )
    assert np.allclose(near, far)


@pytest.mark.parametrize("batch", [0, 1])
def test_other_inputs_have_the_data_of_the_figure(batch: int) -> None:
    truth, seen = inputs.draw_batches(inputs.SETUP, inputs.seeds[batch])
    # The first of the ten batches of the figure that this one has
    for_data, _ = figure.seeds[inputs.PARTS * batch].spawn(2)
    rng = np.random.default_rng(for_data)
    first, seen_first = satellites.draw_data(figure.SETUP, rng, (figure.BATCH,))
    assert np.array_equal(truth[:, : figure.BATCH], first)
    assert all(
        np.array_equal(a[:, : figure.BATCH], b)
        for a, b in zip(seen, seen_first, strict=True)
    )


def scores_with_a_failure(failed_step: int) -> dict[str, Any]:
    """Return the scores of two runs; the second one fails in a step, if there is such a step."""
    setup = figure.SETUP
    times = setup.times[:8]
    short = replace(setup, times=times, settled=times > times[3], members=20)
    truth, seen = satellites.draw_data(short, np.random.default_rng(0), (2,))

    @updates.update
    def fail_once(
        ensemble: np.ndarray,
        predicted: np.ndarray,
        observed: np.ndarray,
        noise: np.ndarray,
        *,
        rng: np.random.Generator,
    ) -> np.ndarray:
        analysis = updates.enkf(ensemble, predicted, observed, noise, rng=rng)
        is_failed = (observed > 1e100).any(axis=-1)
        return np.where(is_failed[..., None, None], np.nan, analysis)

    if failed_step < len(times):
        seen[0][failed_step, 1] = 1e200
    f = EnsembleFilter(
        short.model,
        short.sensors,
        short.graph,
        update=fail_once,
        members=short.members,
        names=short.names,
        on_error="keep",
    )
    run = satellites.run_filter(short, f, np.random.SeedSequence(1), truth, seen)
    names = satellites.score_columns(short, "case", 2)
    scores = satellites.score_runs(short, "case", run)
    assert set(scores) == set(names)
    return scores | satellites.step_series(short, "case", run)


# Before the settled times, among them, and never
@pytest.mark.parametrize("failed_step", [2, 6, 8])
def test_a_failed_run_has_no_score(failed_step: int) -> None:
    """Neither zero, nor the mean of the times before it failed."""
    scores = scores_with_a_failure(failed_step)
    without = scores_with_a_failure(8)
    first = {name for name in scores if name.endswith("_0")}
    second = {name for name in scores if name.endswith("_1")}
    assert len(first) == len(second) == 5
    for name in first:
        assert scores[name] == pytest.approx(without[name])
    is_failure = failed_step < 8
    assert all(np.isnan(scores[name]) == is_failure for name in second)
    # Means over the runs exist until then.
    for k in range(8):
        assert np.isnan(scores[f"case_A_t{k:03d}"]) == (k >= failed_step)
