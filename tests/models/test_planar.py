"""Bodies that drive in the plane: arcs in closed form, noise by draws, parts of a step."""

from __future__ import annotations

import numpy as np
import pytest

from distfilt.models import drive_poses, planar_odometry


def test_an_arc_in_closed_form() -> None:
    """A body at speed v that turns at ω moves on a circle of radius v / ω about its left."""
    v, w, heading = 0.7, 0.4, 0.9
    for dt in (0.1, 1.0, 5.0):
        end = drive_poses(np.array([1.0, 2.0, heading]), np.array([v, 0.0, w]), dt)
        turned = heading + w * dt
        x = 1.0 + v / w * (np.sin(turned) - np.sin(heading))
        y = 2.0 - v / w * (np.cos(turned) - np.cos(heading))
        assert np.allclose(end, [x, y, turned], atol=1e-12)


def test_parts_of_a_step_lead_to_the_same_pose() -> None:
    """Also for sideways motion, several bodies, batches, and constants that stay."""
    rng = np.random.default_rng(0)
    x = rng.standard_normal((5, 8))
    u = rng.standard_normal(6)
    whole = drive_poses(x, u, 1.5)
    parts = x
    for length in (0.2, 1.0, 0.3):
        parts = drive_poses(parts, u, length)
    assert np.allclose(whole, parts, atol=1e-12)
    assert np.array_equal(whole[:, 6:], x[:, 6:])
    # Rigid motion commutes with a turn of the whole plane.
    c, s = np.cos(0.7), np.sin(0.7)
    turn = np.array([[c, -s], [s, c]])
    turned = x.copy()
    for k in (0, 3):
        place = slice(k, k + 2)
        turned[:, place] = x[:, place] @ turn.T
        turned[:, k + 2] += 0.7
    moved = drive_poses(turned, u, 1.5)
    for k in (0, 3):
        place = slice(k, k + 2)
        expected = whole[:, place] @ turn.T
        assert np.allclose(moved[:, place], expected)


def test_the_noise_is_that_of_draws() -> None:
    model = planar_odometry(
        [0.0, 0.5],
        [[1.0, 0.0, 0.3], [0.5, 0.1, -0.2]],
        std=(0.05, 0.02, 0.04),
        sigma=(0.03, 0.01),
        n_constants=1,
    )
    start = np.array([0.0, 0.0, 0.4, 7.0])
    states = np.tile(start, (40_000, 1))
    ends = model.sample_step(states, 0.0, 1.0, rng=np.random.default_rng(1))
    cov = model.noise_at(start, 0.0, 1.0)
    assert np.allclose(np.cov(ends.T), cov, atol=0.03 * cov.max())
    assert not cov[3].any() and (ends[:, 3] == 7.0).all()
    assert model.periods[2] == pytest.approx(2 * np.pi)


def test_what_is_refused() -> None:
    with pytest.raises(ValueError, match="rates must have three columns for each body"):
        planar_odometry([0.0], [[1.0, 0.0]])
    with pytest.raises(ValueError, match="std"):
        planar_odometry([0.0], [[1.0, 0.0, 0.0]], std=(0.1, 0.1, -0.1))
    with pytest.raises(ValueError, match="times"):
        planar_odometry([0.0, 0.0], np.zeros((2, 3)))
    with pytest.raises(ValueError, match="u must have three entries for each body"):
        drive_poses(np.zeros(5), np.zeros(2), 1.0)
    with pytest.raises(ValueError, match="u must have three entries for each body"):
        drive_poses(np.zeros(5), np.zeros(6), 1.0)
    with pytest.raises(ValueError, match="u must have no more leading axes than x"):
        drive_poses(np.zeros(3), np.zeros((2, 3)), 1.0)


def test_noises_of_two_bodies_by_hand() -> None:
    """σ² dt of the walk, and dt² R diag(std²) Rᵀ of rates whose error lasts for a short input."""
    rates = [[0.6, 0.1, 0.4, 1.1, -0.2, -0.3]]
    sigma = (0.3, 0.05)
    walk = planar_odometry([0.0], rates, sigma=sigma, n_constants=2)
    variances = [0.09, 0.09, 0.0025, 0.09, 0.09, 0.0025, 0.0, 0.0]
    assert np.allclose(walk.Q(1.0, 0.5), 0.5 * np.diag(variances))
    noisy_walk = planar_odometry(
        [0.0], rates, std=(0.2, 0.1, 0.03), sigma=sigma, n_constants=2
    )
    headings = [0.7, -2.0]
    x = np.array([1.0, 2.0, headings[0], -3.0, 0.5, headings[1], 4.0, 5.0])
    dt = 1e-4
    expected = np.zeros((8, 8))
    for body, heading in enumerate(headings):
        c = np.cos(heading)
        s = np.sin(heading)
        rotation = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        block = slice(3 * body, 3 * body + 3)
        in_frame = np.diag([0.04, 0.01, 0.0009])
        expected[block, block] = dt**2 * rotation @ in_frame @ rotation.T
    # The turn within so short a step changes the directions by 1e-5.
    from_rates = noisy_walk.noise_at(x, 0.0, dt) - noisy_walk.Q(0.0, dt)
    assert np.allclose(from_rates, expected, rtol=0, atol=1e-4 * expected.max())
    # Rates with and without errors move a body alike, also across the begin of an input.
    times = [0.0, 0.4]
    two_inputs = np.vstack([rates, np.flip(rates)])
    exact = planar_odometry(times, two_inputs, n_constants=2)
    noisy = planar_odometry(times, two_inputs, std=(0.2, 0.1, 0.03), n_constants=2)
    half = drive_poses(x, two_inputs[0], 0.4)
    end = drive_poses(half, two_inputs[1], 0.6)
    assert np.allclose(exact.step(x, 0.0, 1.0), end, atol=1e-12)
    assert np.allclose(noisy.step(x, 0.0, 1.0), end, atol=1e-12)
    assert list(np.flatnonzero([p is not None for p in exact.periods])) == [2, 5]
