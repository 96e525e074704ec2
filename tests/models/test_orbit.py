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
    """By central differences, in random directions at distances from LEO to GEO."""
    rng = np.random.default_rng(1)
    directions = rng.standard_normal((50, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    r = directions * rng.uniform(6500, 45000, (50, 1))
    h = 1e-2
    gradient = np.empty_like(r)
    for axis, shift in enumerate(h * np.eye(3)):
        difference = potential(r + shift) - potential(r - shift)
        gradient[:, axis] = difference / (2 * h)
    error = np.abs(gradient - acceleration(r)).max()
    assert error < 1e-7 * np.abs(gradient).max()


@pytest.mark.parametrize("start", [MEO, GEO])
@pytest.mark.parametrize(
    ("rule", "longest", "bound"), [("rk4", 40.0, 2e-5), ("dop853", 900.0, 1e-6)]
)
def test_a_day_against_an_adaptive_integrator(
    start: np.ndarray, rule: str, longest: float, bound: float
) -> None:
    """The docstring's accuracy: a centimetre of order 4, a millimetre of order 8, in km."""
    day = 86400.0
    solution = solve_ivp(
        lambda t, x: orbit._rate(x),
        (0, day),
        start,
        method="DOP853",
        rtol=1e-13,
        atol=1e-9,
    )
    result = propagate(start, day, rule=rule, longest=longest)
    position_error = np.abs(result - solution.y[:, -1])[:3]
    assert position_error.max() < bound


def test_rows_of_a_batch_are_propagated_independently() -> None:
    starts = np.stack([MEO, GEO])
    result = propagate(starts, 7200.0)
    single = propagate(MEO, 7200.0)
    assert np.abs(result[0] - single).max() < 1e-8
    # No time, no motion.
    assert (propagate(starts, 0.0) == starts).all()


@pytest.mark.parametrize(("rule", "dt"), [("dop853", 7200.0), ("rk4", 60.0)])
def test_backwards_in_time_returns_to_the_start(rule: str, dt: float) -> None:
    # The equations are autonomous and reversible: both errors are those of the rule.
    end = propagate(GEO, dt, rule=rule)
    start = propagate(end, -dt, rule=rule)
    assert np.abs(start - GEO).max() < 1e-6


def test_states_in_metres_are_refused() -> None:
    with pytest.raises(
        ValueError, match=r"km must be at most 1500000, got 42241100\.0"
    ):
        propagate(1e3 * GEO, 60.0)


def test_satellites_of_a_model_are_independent() -> None:
    model = orbits(2)
    x = np.concatenate([MEO, GEO])
    result = model.step(x, 0.0, 3600.0)
    assert np.allclose(result[6:], propagate(GEO, 3600.0))
    jacobian = model.jacobian(x, 0.0, 3600.0)
    # Blocks off the diagonal vanish exactly.
    assert (jacobian[:6, 6:] == 0).all()
    assert (jacobian[6:, :6] == 0).all()
    # The derivative along a direction, by central differences of another step.
    direction = np.array([0.1, -0.2, 0.3, 0.5, 0.2, -0.1])
    h = 1e-2
    forward = propagate(MEO + h * direction, 3600.0)
    backward = propagate(MEO - h * direction, 3600.0)
    slope = (forward - backward) / (2 * h)
    assert np.allclose(jacobian[:6, :6] @ direction, slope, rtol=1e-5, atol=1e-6)


def test_noise_of_satellites_has_the_given_standard_deviations() -> None:
    """Of a position, a velocity, and the second satellite's velocity."""
    model = orbits(2, position_std=1e-11, velocity_std=1e-6)
    std = np.sqrt(np.diag(model.Q(0, 10.0)))
    assert np.allclose(std[[0, 3, 11]], [1e-11, 1e-6, 1e-6], rtol=1e-12, atol=0)


def test_frames_are_rotations_along_the_motion() -> None:
    frame = rsw_frame(np.stack([MEO, GEO]))
    # R Rᵀ = I and det R = 1
    assert np.allclose(frame @ np.swapaxes(frame, -1, -2), np.eye(3))
    assert np.allclose(np.linalg.det(frame), 1)
    radial, along, normal = frame[0].T
    position = MEO[:3]
    velocity = MEO[3:]
    assert np.allclose(radial, position / np.linalg.norm(position))
    # The motion lies in the plane, and forwards.
    assert abs(normal @ velocity) < 1e-9
    assert along @ velocity > 0


def test_the_earth_hides_satellites_on_opposite_sides_only() -> None:
    """With the sign as printed, the two agents of the paper would not see each other."""
    geo = GEO[:3]
    meo = MEO[:3]
    second_agent = np.array([36581.86, -21120.55, 0.0])
    assert not occulted(geo, second_agent)
    assert not occulted(geo, meo)
    assert occulted(-geo, meo)
    # A line of sight that ends before the Earth is free.
    assert not occulted([42000.0, 0, 0], [8000.0, 0, 0])


def test_the_earth_hides_what_points_between_two_satellites_are_inside_it() -> None:
    """Of random pairs near and far from each other, and in either order."""
    rng = np.random.default_rng(2)
    directions = rng.standard_normal((2, 400, 3))
    # Half of the pairs are almost above each other.
    directions[1, ::2] = directions[0, ::2] + 0.3 * directions[1, ::2]
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    a, b = directions * rng.uniform(6500, 15000, (2, 400, 1))
    part = np.linspace(0.0, 1.0, 2001)[:, None, None]
    points = a + part * (b - a)
    least = np.linalg.norm(points, axis=-1).min(axis=0)
    # Steps of up to 15 km along a line miss its nearest point by far less than a tenth of a km.
    is_clear = np.abs(least - orbit.RADIUS) > 0.1
    expected = least[is_clear] < orbit.RADIUS
    assert 50 < expected.sum() < is_clear.sum() - 50
    assert np.array_equal(occulted(a, b)[is_clear], expected)
    assert np.array_equal(occulted(b, a)[is_clear], expected)
