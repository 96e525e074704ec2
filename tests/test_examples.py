"""The reader's examples of the API page: each is short, and each does what it says."""

from __future__ import annotations

import runpy
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from distfilt.filters import GaussianFilter
from distfilt.models import Model
from distfilt.network import graphs
from distfilt.sensors import component

FOLDER = Path(__file__).parents[1] / "book" / "examples"


def run(name: str) -> dict[str, Any]:
    return runpy.run_path(str(FOLDER / f"{name}.py"))


LIMITS = {"robots": 100, "seven_filters": 60}
"""Lines that are not blank; longer examples are not read."""


@pytest.mark.parametrize("path", sorted(FOLDER.glob("*.py")), ids=lambda p: p.stem)
def test_an_example_is_short(path: Path) -> None:
    code = [
        line for line in path.read_text(encoding="utf-8").splitlines() if line.strip()
    ]
    assert len(code) <= LIMITS.get(path.stem, 50)


def test_the_spill_is_found() -> None:
    names = run("spill")
    truth = names["truth"]
    late = names["run"]["total_squared_error"].values[-20:].mean()
    lost = ((truth[-20:] - np.array([0.5, 0.5])) ** 2).sum(axis=-1).mean()
    assert late < 0.05 * lost
    assert names["run"]["scalars"].values[-1].sum() > 0


def test_own_filter_is_the_kalman_filter_on_its_grid(tmp_path: Path) -> None:
    names = run("own_filter")
    walk = Model(1, lambda x, t, dt: x, lambda t, dt: 0.3 * dt * np.eye(1))
    sensors = [component([0], std=0.5), None]
    line = graphs.path(2)
    own = names["GridFilter"](walk, sensors, line)
    exact = GaussianFilter(walk, sensors, line)
    times = [0.5, 1.0, 2.0]
    seen = [np.array([[0.4], [1.0], [0.2]]), None]
    prior = ([0.0], [[1.0]])
    a = own.run(own.start(prior), times, seen, truth=np.zeros((3, 1)))
    b = exact.run(exact.start(prior), times, seen, truth=np.zeros((3, 1)))
    assert np.allclose(a["mean"], b["mean"], atol=2e-3)
    assert np.allclose(a["variance"], b["variance"], atol=2e-3)
    assert np.array_equal(a["scalars_total"], b["scalars_total"])
    many = own.run(own.start(prior, runs=(2,)), times, seen)
    assert np.array_equal(many["mean"].values[:, 1], a["mean"].values)
    state = own.start(prior)
    state.save(tmp_path / "grid.npz")
    assert np.array_equal(
        names["GridState"].load(tmp_path / "grid.npz").probabilities,
        state.probabilities,
    )


def test_own_update_is_not_pulled_far() -> None:
    before, wild, after = run("own_update")["run"]["mean"].values[[19, 20, 29], 0, 0]
    assert abs(before - 0.3) < 0.3 and abs(wild - 0.3) < 1.5 and abs(after - 0.3) < 0.4


def test_own_rule_outvotes_the_broken_sensor() -> None:
    out = run("own_rule")["run"]
    assert np.abs(out["mean"].values[-1, :4] - 1.0).max() < 0.5
    assert out["scalars"].values[-1].tolist() == [4] * 5


def test_own_payload_arrives_and_is_charged() -> None:
    names = run("own_payload")
    for sender, track in names["received"].items():
        sent = names["tracks"][sender]
        assert track.name == sent.name and np.array_equal(track.cov, sent.cov)
    ledger = names["channel"].ledger
    # One name, three means, six entries of the covariance; four messages on a path of three.
    assert ledger.scalars.sum() == 4 * 10 and ledger.bytes.sum() == 4 * (
        8 + 3 * 8 + 6 * 4
    )


def table(text: str) -> dict[str, list[float]]:
    rows = [line.split() for line in text.splitlines()[1:]]
    return {row[0]: [float(x) for x in row[1:]] for row in rows}


def test_seven_filters_in_one_loop(capsys: pytest.CaptureFixture[str]) -> None:
    run("seven_filters")
    rows = table(capsys.readouterr().out)
    assert len(rows) == 7
    for name, (error, nees, floats) in rows.items():
        assert error < 0.3 and floats > 0, name
        assert name == "density" or nees < 4, name
    assert (
        rows["ensemble"][2] == 240
    )  # a reading to two neighbours each, for thirty steps


def test_robots_are_tracked_from_a_log_of_events(
    capsys: pytest.CaptureFixture[str],
) -> None:
    run("robots")
    rows = table(capsys.readouterr().out)
    assert set(rows) == {"mixture", "gaussian", "ensemble", "news"}
    for name, (error, nees, refused, floats) in rows.items():
        assert error < 1.0 and nees < 4 and refused > 3 and floats > 0, name
    # What waits for a contact is not lost: as good as readings that are all told.
    assert (
        rows["news"][0] < 1.25 * rows["gaussian"][0]
        and rows["news"][3] < rows["gaussian"][3]
    )
