"""Identities behind the studies of partial-state fusion: arcs, products, increments."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from bookkit import studies
from distfilt.mixtures import GaussianMixture
from distfilt.network import Faults, graphs

arcs = studies.script("arcs")
choices = studies.script("orbit-choices")
separation = studies.script("separation")
team = studies.script("_team")

NUMBERS: dict[str, Any] = {"angle_std": 0.4, "range_std": 0.3, "ego_std": 0.2}


@pytest.mark.parametrize("width", [0.2, 0.5, 1.25])
def test_neighbours_on_an_arc_lie_one_over_the_width_apart(width: float) -> None:
    # Steps of the angle: σ_θ times that of the offsets
    angle = NUMBERS["angle_std"] * 2 * 1.46 / 4
    bent = arcs.arc(5, np.array([-8.0, 0.0]), **NUMBERS, width=width)
    along = bent.covs[0][:2, :2]
    chords = np.linalg.norm(np.diff(bent.means[:, :2], axis=0), axis=1)
    assert np.allclose(chords, 2 * 8.0 * np.sin(angle / 2))
    # The eigenvalues are the variances along and across the sight.
    across = 8.0 * width * angle
    variances = np.sort([NUMBERS["range_std"] ** 2, across**2])
    assert np.allclose(np.linalg.eigvalsh(along), variances)
    ratio = np.sinc(angle / 2 / np.pi) / width
    assert np.isclose(chords[0] / across, ratio)


def test_ego_errors_are_minus_half_of_those_across() -> None:
    bent = arcs.arc(3, np.array([-8.0, 0.0]), **NUMBERS)
    middle = bent.covs[1]
    # The middle component looks along the first axis: across is the second.
    assert np.isclose(middle[1, 3], -0.5 * middle[1, 1])
    assert middle[0, 2] == 0
    ego_variance = NUMBERS["ego_std"] ** 2
    assert np.isclose(middle[3, 3], 0.25 * middle[1, 1] + ego_variance)


def test_only_the_width_changes_in_the_family_of_pairs(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    pairs = []

    def keep(first: Any, second: Any, seed: int) -> dict[str, float]:
        pairs.append((first, second, seed))
        return {}

    monkeypatch.setattr(separation.arcs, "score_rules", keep)
    separation.trial(np.random.SeedSequence(1))
    assert len(pairs) == len(separation.SEPARATIONS)
    first, second, seed = pairs[0]
    for a, b, points in pairs[1:]:
        # Means and weights stay, covariances do not, and points are of one seed.
        for one, other in ((first, a), (second, b)):
            assert np.array_equal(one.means, other.means)
            assert np.array_equal(one.weights, other.weights)
            assert not np.allclose(one.covs, other.covs)
        assert points == seed


def test_multiplied_beliefs_add_their_information() -> None:
    rng = np.random.default_rng(3)
    roots = rng.standard_normal((2, 12, 12))
    own, other = (root @ root.T for root in roots)
    received = GaussianMixture.gaussian(np.ones(6), other[:6, :6])
    fused = choices.multiply_beliefs(
        GaussianMixture.gaussian(np.zeros(12), own), [received]
    )
    mean, cov = fused.moments()
    J = np.zeros((12, 12))
    J[:6, :6] = np.linalg.inv(other[:6, :6])
    expected = np.linalg.inv(np.linalg.inv(own) + J)
    assert np.allclose(cov, expected, rtol=1e-6, atol=1e-9)
    ones_then_zeros = np.concatenate([np.ones(6), np.zeros(6)])
    assert np.allclose(mean, expected @ J @ ones_then_zeros)


@pytest.mark.parametrize(("noise", "exact"), [(0.0, True), (0.5, False)])
def test_increments_are_exact_without_noise_on_the_target(
    noise: float, exact: bool
) -> None:
    case = team.Team(
        graphs.complete(3),
        np.eye(1),
        noise * np.eye(1),
        4 * np.eye(1),
        np.eye(1),
        0.3 * np.eye(1),
    )
    _, seen = case.data(5, 4, np.random.default_rng(2))
    increments, joint = (case.run_filters(way, seen) for way in ("increments", "joint"))
    # After the first step nothing ties the agents yet.
    for a, b in zip(increments, joint, strict=True):
        assert np.allclose(a[0], b[0])
        assert np.allclose(a, b) == exact


def test_a_lost_message_leaves_the_own_belief() -> None:
    case = team.Team(
        graphs.path(2),
        np.eye(1),
        np.zeros((1, 1)),
        4 * np.eye(1),
        np.eye(1),
        0.3 * np.eye(1),
        Faults(loss=1.0, seed=1),
    )
    _, seen = case.data(3, 2, np.random.default_rng(2))
    alone = case.run_filters("alone", seen)
    for way in ("increments", "intersection"):
        for a, b in zip(case.run_filters(way, seen), alone, strict=True):
            assert np.allclose(a, b)
