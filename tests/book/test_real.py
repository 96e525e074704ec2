"""The programs of chapter 14 on sets that have the names of published ones."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bookkit import datasets, studies

real: Any = studies.script("_real")


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the folder of the reader's data, with two sets."""
    monkeypatch.setenv("DISTFILT_DATA", str(tmp_path))
    datasets.write_utias(
        tmp_path / "MRCLAM_Dataset6", rng=np.random.default_rng(1), duration=40.0
    )
    datasets.write_pyfg(
        tmp_path / "tiers.pyfg", rng=np.random.default_rng(2), duration=10.0
    )
    return tmp_path


def test_without_the_files_nothing_is_run(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("DISTFILT_DATA", raising=False)
    assert real.read("MRCLAM_Dataset6") is None
    assert real.largest_difference() == 0.0


def test_sightings_are_compared_with_the_truth(folder: Path) -> None:
    """The generator's own lag, and the standard deviations of its sightings, come out."""
    rows = real.compare_with_truth(real.read("MRCLAM_Dataset6"))
    assert [row["robot"] for row in rows] == ["1", "2", "3", "4", "5"]
    lag, bearing, distance = (
        np.mean([row[name] for row in rows]) for name in ("lag", "bearing", "range")
    )
    assert lag == pytest.approx(0.1, abs=0.03)
    assert bearing == pytest.approx(0.025, rel=0.2)
    assert distance == pytest.approx(0.06, rel=0.2)
    # Generated odometry is early by half of its step at most, and has no wrong scale of turns.
    for row in rows:
        assert abs(row["odometry_lead"]) <= 0.1 + 1e-9
        assert row["turn_ratio"] == pytest.approx(1.0, abs=0.05)


def test_each_way_gives_a_row(folder: Path) -> None:
    rows = real.run_landmark_set("MRCLAM_Dataset6", real.read("MRCLAM_Dataset6"))
    assert [row["way"] for row in rows] == list(real.WAYS)
    for row in rows:
        assert 0 < row["position"] < 2 and row["seconds"] > 35
    rows = real.run_radio_set("tiers.pyfg", real.read("tiers.pyfg"))
    assert [row["way"] for row in rows] == list(real.radios.RULES)
    by_way = {row["way"]: row for row in rows}
    assert by_way["naive fusion"]["nees"] > 2 * by_way["intersection"]["nees"]


def test_the_settings_are_those_of_the_stored_tuning() -> None:
    tuning = real.stored("tuning")
    best = tuning.loc[tuning.groupby("parameter")["fit"].idxmax()]
    chosen = best.set_index("parameter")["candidate"]
    assert real.TUNED["lag"] == chosen["lag"]
    for name in ("sight", "odometry"):
        expected = chosen[name] * np.array(real.GUESS[name])
        assert np.allclose(real.TUNED[name], expected)
    sets = set(real.stored("landmarks")["set"])
    assert sets <= set(real.LANDMARK_SETS)
    assert set(real.stored("radios")["set"]) <= set(real.RADIO_SETS)
