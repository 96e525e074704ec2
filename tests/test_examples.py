"""The reader's examples of the API page: each does what its docstring says."""

from __future__ import annotations

import runpy
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bookkit import datasets
from distfilt.filters import GaussianFilter
from distfilt.kalman import kalman_filter
from distfilt.models import Model
from distfilt.network import graphs
from distfilt.sensors import component

FOLDER = Path(__file__).parents[1] / "book" / "examples"


def run(name: str) -> dict[str, Any]:
    """Run an example; return its global names."""
    return runpy.run_path(str(FOLDER / f"{name}.py"))


def table(text: str) -> dict[str, list[float]]:
    """Return the numbers of a printed table, by the name that begins each row."""
    rows = [line.split() for line in text.splitlines()[1:]]
    numbers = {}
    for name, *cells in rows:
        numbers[name] = [float(cell) for cell in cells]
    return numbers


def test_spill_is_located() -> None:
    names = run("spill")
    truth = names["truth"]
    error = names["run"]["total_squared_error"].values[-20:].mean()
    # Without observations, the estimate would stay at the prior's mean.
    deviation = truth[-20:] - np.array([0.5, 0.5])
    prior_error = (deviation**2).sum(axis=-1).mean()
    assert error < 0.05 * prior_error
    assert names["run"]["scalars"].values[-1].sum() > 0


def test_own_filter_equals_the_kalman_filter_on_a_fine_grid(tmp_path: Path) -> None:
    names = run("own_filter")
    walk = Model(1, lambda x, t, dt: x, lambda t, dt: 0.3 * dt * np.eye(1))
    sensors = [component([0], std=0.5), None]
    line = graphs.path(2)
    on_grid = names["GridFilter"](walk, sensors, line)
    kalman = GaussianFilter(walk, sensors, line)
    times = [0.5, 1.0, 2.0]
    observations = [np.array([[0.4], [1.0], [0.2]]), None]
    prior = ([0.0], [[1.0]])
    truth = np.zeros((3, 1))
    a = on_grid.run(on_grid.start(prior), times, observations, truth=truth)
    b = kalman.run(kalman.start(prior), times, observations, truth=truth)
    assert np.allclose(a["mean"], b["mean"], atol=2e-3)
    assert np.allclose(a["variance"], b["variance"], atol=2e-3)
    assert np.array_equal(a["scalars_total"], b["scalars_total"])
    # The base class supplies runs, and states that can be saved.
    two_runs = on_grid.run(on_grid.start(prior, runs=(2,)), times, observations)
    assert np.array_equal(two_runs["mean"].values[:, 1], a["mean"].values)
    state = on_grid.start(prior)
    state.save(tmp_path / "grid.npz")
    loaded = names["GridState"].load(tmp_path / "grid.npz")
    assert np.array_equal(loaded.probabilities, state.probabilities)


def test_own_update_limits_the_effect_of_an_outlier() -> None:
    means = run("own_update")["run"]["mean"].values[:, 0, 0]
    # All observations are 0.3 but that of step 20, which is 50.
    assert abs(means[19] - 0.3) < 0.3
    assert abs(means[20] - 0.3) < 1.5
    assert abs(means[29] - 0.3) < 0.4


def test_own_rule_outvotes_the_broken_sensor() -> None:
    record = run("own_rule")["run"]
    # The truth is 1; the fifth agent's sensor is broken.
    final_means = record["mean"].values[-1, :4]
    assert np.abs(final_means - 1.0).max() < 0.5
    assert record["scalars"].values[-1].tolist() == [4] * 5


def test_own_payload_arrives_and_is_charged() -> None:
    names = run("own_payload")
    for sender, track in names["received"].items():
        sent = names["tracks"][sender]
        assert track.name == sent.name
        assert np.array_equal(track.cov, sent.cov)
    # One name, three means, six entries of the covariance; four messages on a path of
    # three.
    ledger = names["channel"].ledger
    assert ledger.scalars.sum() == 4 * (1 + 3 + 6)
    assert ledger.bytes.sum() == 4 * (8 + 3 * 8 + 6 * 4)


def test_seven_filters_in_one_loop(capsys: pytest.CaptureFixture[str]) -> None:
    run("seven_filters")
    rows = table(capsys.readouterr().out)
    assert len(rows) == 7
    for name, (error, nees, floats) in rows.items():
        assert error < 0.3, name
        assert floats > 0, name
        # The NEES of a consistent filter is 1 a component; a density has none.
        assert name == "density" or nees < 4, name
    # A scalar to two neighbours by each of four agents, for thirty steps.
    assert rows["ensemble"][2] == 4 * 2 * 30


def test_robots_are_tracked_from_a_log_of_events(
    capsys: pytest.CaptureFixture[str],
) -> None:
    run("robots")
    rows = table(capsys.readouterr().out)
    assert set(rows) == {"mixture", "gaussian", "ensemble", "increment"}
    for name, (error, nees, rejected, floats) in rows.items():
        assert error < 1.2, name
        # The poses are estimated too, so that the reported covariance holds.
        assert 0.3 < nees < 1.5, name
        assert rejected > 3, name
        assert floats > 0, name
    # Increments that wait for an exchange are not lost: about the same error for fewer
    # numbers.
    error, _, _, floats = rows["increment"]
    assert error < 1.25 * rows["gaussian"][0]
    assert floats < rows["gaussian"][3]


def test_radios_lead_from_a_file_to_a_table(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """With Gaussian noise alone, all observations are consistent and the best."""
    path = datasets.write_pyfg(
        tmp_path / "radios.pyfg",
        rng=np.random.default_rng(1),
        duration=20.0,
        defects=datasets.Defects.none(),
    )
    monkeypatch.setattr(sys, "argv", ["radios.py", str(path)])
    runpy.run_path(str(FOLDER / "radios.py"), run_name="__main__")
    # A head, and a row for each rule: position, heading and NEES.
    head, *lines = capsys.readouterr().out.splitlines()
    assert head.split() == ["position", "heading", "nees"]
    rows = {}
    for line in lines:
        name, position, _, nees = line.rsplit(maxsplit=3)
        rows[name.strip()] = (float(position), float(nees))
    assert rows["all observations"][0] == min(rmse for rmse, _ in rows.values())
    assert 0.2 < rows["all observations"][1] < 1.5
    assert rows["naive fusion"][1] > 10
    assert rows["intersection"][1] < 1.5


def test_landmarks_lead_from_folders_to_a_table(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """With Gaussian noise alone, the filter that assumes it is accurate and consistent."""
    for seed in (1, 2):
        datasets.write_utias(
            tmp_path / f"set{seed}",
            rng=np.random.default_rng(seed),
            duration=40.0,
            defects=datasets.Defects.none(),
        )
    folders = [str(tmp_path / "set1"), str(tmp_path / "set2")]
    monkeypatch.setattr(sys, "argv", ["landmarks.py", *folders])
    # The program assumes a lag; the set has none.
    names = runpy.run_path(str(FOLDER / "landmarks.py"))
    assert names["SETTING"]["lag"] == 0.1
    runpy.run_path(str(FOLDER / "landmarks.py"), run_name="__main__")
    head, *lines = capsys.readouterr().out.splitlines()
    assert head.split() == ["position", "heading", "nees", "place", "place_nees"]
    assert [line.split()[0] for line in lines] == folders
    for line in lines:
        position, heading, nees, place, _ = map(float, line.split()[1:])
        assert position < 0.12 and heading < 0.1 and place < 0.2
        assert 0.1 < nees < 3


def test_recipes_agree_with_values_from_elsewhere(
    capsys: pytest.CaptureFixture[str],
) -> None:
    # The script compares each with a value by hand; these come from other methods.
    names = run("streams")
    rows = table("recipe values\n" + capsys.readouterr().out)
    # The delayed observation, assimilated in the order of time.
    f = GaussianFilter(names["WALK"], [component([0], std=1.0)])
    start = f.start(names["PRIOR"])
    in_order = f.run(start, [1.4, 2.0, 3.0], [[[0.5], [1.0], [np.nan]]])
    mean = in_order["mean"].values[-1, 0]
    assert np.allclose(rows["delayed_observation"], mean, atol=5e-4)
    # A robot at 3 ± 2 that is measured at 3.5 ± 1, and a landmark 5 ± 0.1 ahead: with K = 4/5
    # 3 + 0.5 K and 5 more, variances of K and K + 0.1².
    assert rows["first_sight"] == [3.4, 8.4, 0.8, 0.81]
    # Both observations of (place, first bias, second bias), in one linear regression.
    design = np.array([[1.0, 1.0, 0.0], [1.0, 0.0, 1.0]])
    information = np.diag([1.0, 1.0, 4.0]) + design.T @ design
    place, *_ = np.linalg.solve(information, design.T @ np.ones(2))
    assert np.allclose(rows["restart"], place, atol=5e-4)
    # (m/P + 2 + 3) / (1/P + 2) for (m, P) = (0, 1) and (4, 2)
    assert rows["priors_of_agents"] == [1.667, 2.8]
    # The Kalman filter of matrices, with the same three steps.
    ends = np.array([0.0, 0.3, 1.0, 2.0])
    steps = np.exp(-np.diff(ends**2) / 2).reshape(3, 1, 1)
    one = np.eye(1)
    y = np.array([[np.nan], [np.nan], [0.5]])
    exact = kalman_filter([1.0], one, y, F=steps, H=one, Q=0 * one, R=one)
    assert np.allclose(rows["matrix_of_time"], exact.means[-1], atol=5e-4)
    # At 2 m/s, the start is the mean of the prior's 0, of 2.3 - 2 and of 4.6 - 4.
    assert rows["known_constant"] == [4.3, 2.0, 0.333, 0.0]
    # Samples of the robot's drive: the linear covariance is that for small errors.
    rng = np.random.default_rng(0)
    speeds, turns = rng.normal(size=(2, 100_000, 2)) * [[[0.2]], [[0.1]]]
    first, second = turns.T
    headings = np.stack([first / 2, first + second / 2], axis=-1)
    distances = 1 + speeds
    across = (distances * np.sin(headings)).sum(axis=-1).var()
    along = (distances * np.cos(headings)).sum(axis=-1).var()
    sampled = [across, along, turns.sum(axis=-1).var()]
    assert np.allclose(rows["odometry"], sampled, rtol=0.05)
    # The gamma distribution is conjugate to counts; Student's t resists the outlier.
    counts, student, radar = rows["likelihoods"]
    # A count of 9 makes Γ(16, rate 4) to Γ(25, rate 5).
    assert abs(counts - 25 / 5) < 0.02
    assert student < 5 < radar < 6
    # The evidence by the chain rule, one scalar Kalman filter.
    evidence = chain_rule([1, 1, 2], [0.2, 1.1, -0.9])
    assert np.allclose(rows["evidence"], evidence, atol=5e-4)


def chain_rule(steps: list[float], observed: list[float]) -> tuple[float, float]:
    """Return log-evidence and NIS of a random walk from N(0, 1), observed with unit noise."""
    mean = 0.0
    variance = 1.0
    log_evidence = 0.0
    nis = 0.0
    for dt, y in zip(steps, observed, strict=True):
        variance += dt
        s = variance + 1.0
        square = (y - mean) ** 2 / s
        log_evidence -= (square + np.log(2 * np.pi * s)) / 2
        nis += square
        mean += variance / s * (y - mean)
        variance /= s
    return log_evidence, nis
