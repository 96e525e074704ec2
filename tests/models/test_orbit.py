"""Orbits: the potential's gradient, an integrator of another kind, invariants, frames, shadows."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from distfilt.models import orbit
from distfilt.models.orbit import (
    acceleration,
    occulted,
    orbits,
    potential,
    propagate,
    rsw_frame,
)

MEO = np.array([26491.58, 2980.266, -357.1760, -173.028, 2191.596, 3178.45])
GEO = np.array([42241.10, 0.0, 0.0, 0.0, 3071.859, 0.0])


def test_acceleration_is_the_gradient_of_the_potential() -> None:
    rng = np.random.default_rng(1)
    way = rng.standard_normal((50, 3))
    r = (
        way
        / np.linalg.norm(way, axis=1, keepdims=True)
        * rng.uniform(6500, 45000, (50, 1))
    )
    h = 1e-2 * np.eye(3)
    slope = np.stack([(potential(r + e) - potential(r - e)) / 2e-2 for e in h], axis=-1)
    assert np.abs(slope - acceleration(r)).max() < 1e-7 * np.abs(slope).max()


@pytest.mark.parametrize("start", [MEO, GEO])
def test_a_day_against_scipys_integrator(start: np.ndarray) -> None:
    exact = solve_ivp(
        lambda t, y: orbit._rate(y),
        (0, 86400),
        start,
        method="DOP853",
        rtol=1e-13,
        atol=1e-9,
    ).y[:, -1]
    for rule, longest, allowed in (("rk4", 40.0, 2e-5), ("dop853", 900.0, 1e-6)):
        found = propagate(start, 86400.0, rule=rule, longest=longest)
        assert np.abs(found - exact)[:3].max() < allowed  # km


def test_time_can_run_back_and_batches_are_rows() -> None:
    both = np.stack([MEO, GEO])
    there = propagate(both, 7200.0)
    assert np.abs(there[0] - propagate(MEO, 7200.0)).max() < 1e-8
    assert np.abs(propagate(there, -7200.0) - both).max() < 1e-6
    assert (
        np.abs(
            propagate(propagate(GEO, 60.0, rule="rk4"), -60.0, rule="rk4") - GEO
        ).max()
        < 1e-6
    )
    assert (propagate(both, 0.0) == both).all()
    with pytest.raises(ValueError, match=r"x, in km must be at most 1\.5e\+06"):
        propagate(1e3 * GEO, 60.0)


def test_the_model_is_block_by_block() -> None:
    model = orbits(2, position_std=1e-11, velocity_std=1e-6)
    x = np.concatenate([MEO, GEO])
    assert np.allclose(model.step(x, 0.0, 3600.0)[6:], propagate(GEO, 3600.0))
    slope = model.jacobian(x, 0.0, 3600.0)
    assert (slope[:6, 6:] == 0).all() and (slope[6:, :6] == 0).all()
    move = np.array([0.1, -0.2, 0.3, 0.5, 0.2, -0.1])
    gap = propagate(MEO + 1e-2 * move, 3600.0) - propagate(MEO - 1e-2 * move, 3600.0)
    assert np.allclose(slope[:6, :6] @ move, gap / 2e-2, rtol=1e-5, atol=1e-6)
    assert np.allclose(
        np.sqrt(np.diag(model.Q(0, 10.0)))[[0, 3, 11]], [1e-11, 1e-6, 1e-6]
    )


def test_frames_are_rotations_along_the_motion() -> None:
    frame = rsw_frame(np.stack([MEO, GEO]))
    assert np.allclose(frame @ np.swapaxes(frame, -1, -2), np.eye(3))
    assert np.allclose(np.linalg.det(frame), 1)
    assert np.allclose(frame[0, :, 0], MEO[:3] / np.linalg.norm(MEO[:3]))
    assert abs(frame[0, :, 2] @ MEO[3:]) < 1e-9 and frame[0, :, 1] @ MEO[3:] > 0


def test_the_printed_sign_hides_the_agents_from_each_other() -> None:
    other = np.array([36581.86, -21120.55, 0.0])
    assert not occulted(GEO[:3], other)
    assert occulted(-GEO[:3], MEO[:3]) and not occulted(GEO[:3], MEO[:3])
    # A line that ends before the Earth is free.
    assert not occulted([42000.0, 0, 0], [8000.0, 0, 0])
