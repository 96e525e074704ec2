"""The built-in sensors: what they see, from where, how angles wrap, exact derivatives."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from distfilt import sensors
from distfilt.linalg import central
from distfilt.sensors import (
    Sensor,
    angle,
    differential,
    direct,
    distance,
    distance_and_angle,
    stack,
)

NAN = float("nan")
PLACE = [0.7, -0.4]


def _rng(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


@given(st.floats(-10, 10), st.floats(-10, 10))
def test_angle_is_arctan_up_to_its_branch(a: float, b: float) -> None:
    if abs(a) < 1e-6:
        return
    seen = angle([0, 1], std=0.1).predict([a, b])[0]
    assert abs(np.arctan(b / a) - seen) < 1e-9 or abs(abs(seen) - np.pi / 2) < 1e-9


@given(st.floats(-3, 3), st.floats(-3, 3))
def test_full_angle_residual_is_the_short_way(y: float, p: float) -> None:
    gap = angle([0, 1], std=0.1, full=True).residual([y], [p])[0]
    assert abs(gap) <= np.pi and abs(np.exp(1j * (y - p)) - np.exp(1j * gap)) < 1e-9


@given(st.floats(-1.5, 1.5), st.floats(-1.5, 1.5))
def test_the_angle_of_a_line_repeats_after_half_a_turn(y: float, p: float) -> None:
    gap = angle([0, 1], std=0.1).residual([y], [p])[0]
    assert abs(gap) <= np.pi / 2 and abs(np.exp(2j * (y - p)) - np.exp(2j * gap)) < 1e-9


def test_the_angle_at_its_origin_is_missing() -> None:
    """NaN in prediction, residual and derivative, for that state only."""
    x = np.array([[*PLACE, 1.0], [1.0, 1.0, 1.0]])
    for sensor in (angle([0, 1], std=0.1, origin=PLACE),
                   angle([0, 1], std=0.1, full=True, origin=PLACE)):
        seen, slope = sensor.predict(x), sensor.jacobian(x)
        assert np.isnan(seen[0]).all() and np.isfinite(seen[1]).all()
        assert np.isnan(sensor.residual([0.3], seen)[0]).all()
        assert np.isnan(slope[0, 0, :2]).all() and np.isfinite(slope[1]).all()
    both = distance_and_angle([0, 1], std=[0.1, 0.1], origin=PLACE)
    assert both.predict(x)[0, 0] == 0.0 and np.isnan(both.predict(x)[0, 1])
    assert not both.jacobian(x)[0, 0].any() and np.isfinite(both.jacobian(x)[1]).all()


def test_what_the_sensors_see() -> None:
    x = np.array([[1.0, 2.0, 3.0], [-1.0, 0.5, 2.0]])
    gap = x[:, [2, 0]] - PLACE
    assert np.array_equal(direct([2, 0], std=0.1).predict(x), x[:, [2, 0]])
    far = distance([2, 0], std=0.1, origin=PLACE).predict(x)
    assert np.allclose(far[:, 0], np.hypot(*gap.T), rtol=1e-15)
    turned = angle([2, 0], std=0.1, full=True, origin=PLACE).predict(x)
    assert np.allclose(turned[:, 0], np.arctan2(gap[:, 1], gap[:, 0]), rtol=1e-15)
    both = distance_and_angle([2, 0], std=[0.3, 0.1], origin=PLACE)
    assert np.array_equal(both.predict(x), np.concatenate([far, turned], axis=-1))
    assert np.allclose(both.cov, np.diag([0.09, 0.01]))
    assert both.units == ("", "rad") and both.kind == "distance and angle"


def test_each_kind_has_its_standard_deviation() -> None:
    for sensor in (direct([0, 1], std=0.3), differential([0, 1], std=0.3), distance([0], std=0.3),
                   angle([0, 1], std=0.3)):
        assert np.allclose(sensor.cov, 0.09 * np.eye(sensor.dim), rtol=1e-15)
    names = {"direct": "direct", "differential": "differential", "range": "distance",
             "angle": "angle"}
    for kind, ours in names.items():
        made = sensors.of_kind(kind, [0, 1], std=0.3)
        assert made.kind == ours and made.cov[0, 0] == pytest.approx(0.09)


@pytest.mark.parametrize(
    "sensor",
    [
        direct([2, 0], std=0.1),
        distance([0, 1, 2], std=0.1),
        distance([2, 0], std=0.1, origin=PLACE),
        angle([1, 2], std=0.1),
        angle([2, 0], std=0.1, full=True, origin=PLACE),
        distance_and_angle([2, 1], std=[0.1, 0.2], origin=PLACE),
        stack([distance([2, 0], std=0.1), direct([1], std=0.2), angle([0, 1], std=0.1)]),
    ],
    ids=lambda s: s.kind,
)
def test_jacobians_are_the_derivatives(sensor: Sensor) -> None:
    x = _rng(1).standard_normal((3, 4, 3))
    slope = sensor.jacobian(x)
    numeric = central(sensor.predict, x, difference=sensor.residual)
    assert slope.shape == (3, 4, sensor.dim, 3) and np.abs(slope - numeric).max() < 1e-7


def test_linear_sensor_is_its_matrix() -> None:
    sensor = direct([3, 1], std=0.1)
    x = _rng().standard_normal((4, 5))
    assert (sensor.predict(x) == x @ sensor.matrix(5).T).all()
    assert (sensor.jacobian(x) == sensor.matrix(5)).all()


def test_differential_sees_changes_only() -> None:
    sensor = differential([2, 0], std=0.1)
    before, after = _rng().standard_normal((2, 7, 3))
    assert np.array_equal(sensor.predict(after, before), (after - before)[:, [2, 0]])
    assert np.abs(sensor.predict(after + 5, before + 5) - sensor.predict(after, before)).max() < (
        1e-12)
    assert (sensor.jacobian(after, before) == np.eye(3)[[2, 0]]).all()


def test_a_stacked_sensor_is_its_parts() -> None:
    parts = [direct([0, 2], std=0.1), angle([0, 1], std=0.2), distance([0, 1], std=0.3)]
    both, x = stack(parts), np.array([[1.0, 2.0, 3.0], [-1.0, 0.5, 2.0]])
    apart = np.concatenate([s.predict(x) for s in parts], axis=-1)
    assert (both.predict(x) == apart).all()
    assert np.allclose(both.cov, np.diag([0.01, 0.01, 0.04, 0.09]))
    far = apart + np.array([0.0, 0.0, np.pi, 0.0])  # a line's angle repeats after pi
    assert np.abs(both.residual(far, apart)).max() < 1e-12
    assert both.linear is None and both.units == ("", "", "rad", "")
    assert np.abs(both.jacobian(x) - np.concatenate([s.jacobian(x) for s in parts], -2)).max() == 0


def test_a_stack_keeps_full_noise_matrices_and_what_is_linear() -> None:
    full = np.array([[2.0, 0.5], [0.5, 1.0]])
    own = Sensor(2, lambda x: x[..., 1:], full, linear=lambda d: np.eye(d)[1:])
    both = stack([direct([0], std=0.5), own])
    assert np.allclose(both.cov, [[0.25, 0, 0], [0, 2.0, 0.5], [0, 0.5, 1.0]])
    assert (both.matrix(3) == np.eye(3)).all() and both.units == ()
    changes = stack([direct([0], std=0.5), differential([1], std=0.5)])
    assert changes.uses_previous
    assert np.allclose(changes.predict([1.0, 5.0], [0.0, 2.0]), [1.0, 3.0])
    assert np.allclose(changes.jacobian([1.0, 5.0], [0.0, 2.0]), np.eye(2))


def test_predictions_leave_their_inputs() -> None:
    x = _rng().standard_normal((3, 3))
    before = x.copy()
    for sensor in (direct([0], std=1.0), distance([0, 1], std=0.1, origin=PLACE),
                   angle([0, 1], std=0.1)):
        sensor.predict(x)
        sensor.jacobian(x)
    assert (x == before).all()
