"""The built-in sensors: what they see, from where, how angles wrap, exact derivatives."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from functools import partial

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from distfilt import sensors
from distfilt.linalg import central
from distfilt.models import occulted
from distfilt.sensors import Sensor, angles_only, range_bearing, stack
from distfilt.sensors.kinds import component, distance, ephemeris, increment, line_angle
from tests.support import generator

PLACE = [0.7, -0.4]


@given(st.floats(-3, 3), st.floats(-3, 3))
def test_an_angle_s_residual_is_the_short_way(y: float, p: float) -> None:
    """A line's angle repeats after half a turn."""
    for full, k in ((True, 1), (False, 2)):
        gap = line_angle([0, 1], std=0.1, full=full).residual([y / k], [p / k])[0]
        assert (
            abs(gap) <= np.pi / k
            and abs(np.exp(1j * (y - p)) - np.exp(1j * k * gap)) < 1e-9
        )


def test_the_angle_at_its_origin_is_missing() -> None:
    """NaN in prediction, residual and derivative, for that state only."""
    x = np.array([[*PLACE, 1.0], [1.0, 1.0, 1.0]])
    for full in (False, True):
        sensor = line_angle([0, 1], std=0.1, full=full, origin=PLACE)
        seen = sensor.predict(x)
        slope = sensor.jacobian(x)
        assert np.isnan(seen[0]).all() and np.isfinite(seen[1]).all()
        assert np.isnan(sensor.residual([0.3], seen)[0]).all()
        assert np.isnan(slope[0, 0, :2]).all() and np.isfinite(slope[1]).all()
    both = range_bearing([0, 1], std=[0.1, 0.1], origin=PLACE)
    assert both.predict(x)[0, 0] == 0.0 and np.isnan(both.predict(x)[0, 1])
    assert not both.jacobian(x)[0, 0].any() and np.isfinite(both.jacobian(x)[1]).all()


def test_what_the_sensors_see() -> None:
    x = np.array([[1.0, 2.0, 3.0], [-1.0, 0.5, 2.0]])
    before = generator().standard_normal((2, 3))
    plain = component([2, 0], std=0.3)
    change = increment([2, 0], std=0.3)
    assert np.array_equal(plain.predict(x), x[:, [2, 0]])
    assert np.array_equal(plain.H(3), np.eye(3)[[2, 0]])
    assert np.array_equal(change.predict(x, before), (x - before)[:, [2, 0]])
    assert (change.jacobian(x, before) == np.eye(3)[[2, 0]]).all()
    assert change.jacobian(x[0], before).shape == (2, 2, 3)
    gap = x[:, [2, 0]] - PLACE
    far = distance([2, 0], std=0.1, origin=PLACE).predict(x)
    assert np.allclose(far[:, 0], np.hypot(*gap.T), rtol=1e-15)
    turned = line_angle([2, 0], std=0.1, full=True, origin=PLACE).predict(x)
    assert np.allclose(turned[:, 0], np.arctan2(gap[:, 1], gap[:, 0]), rtol=1e-15)
    place = np.array(PLACE)
    both = range_bearing([2, 0], std=[0.3, 0.1], origin=place)
    place += 9.0  # an array that goes on takes no sensor along
    assert np.array_equal(both.predict(x), np.concatenate([far, turned], axis=-1))
    assert np.allclose(both.noise_cov, np.diag([0.09, 0.01]))
    for kind, ours in (
        ("direct", plain),
        ("differential", change),
        ("range", distance([2, 0], std=0.3)),
        ("angle", line_angle([2, 0], std=0.3)),
    ):
        made = sensors.from_name(kind, [2, 0], std=0.3)
        assert made.kind == ours.kind and np.allclose(
            made.noise_cov, 0.09 * np.eye(ours.dim), rtol=1e-15
        )
        far = np.full(made.dim, 2.0)
        assert np.array_equal(made.residual(far, -far), ours.residual(far, -far))


SHIPPED = [
    component([2, 0], std=0.1),
    distance([0, 1, 2], std=0.1),
    distance([2, 0], std=0.1, origin=PLACE),
    line_angle([1, 2], std=0.1),
    line_angle([2, 0], std=0.1, full=True, origin=PLACE),
    range_bearing([2, 1], std=[0.1, 0.2], origin=PLACE, heading=0.4),
    angles_only(std=0.1, observer=3),
    ephemeris(position_std=0.1, velocity_std=0.2),
    stack(
        [
            distance([2, 0], std=0.1),
            component([1], std=0.2),
            line_angle([0, 1], std=0.1),
        ]
    ),
]


@pytest.mark.parametrize("sensor", SHIPPED, ids=lambda s: s.kind)
def test_jacobians_are_the_derivatives(sensor: Sensor) -> None:
    x = generator(1).standard_normal((3, 4, 6))
    slope = sensor.jacobian(x)
    numeric = central(
        sensor.predict, x, difference=sensor.residual, step=2e-5
    )  # of its own
    assert slope.shape == (3, 4, sensor.dim, 6) and np.abs(slope - numeric).max() < 1e-7


@pytest.mark.parametrize(
    "sensor",
    [
        *SHIPPED,
        increment([0, 1], std=0.1),
        angles_only(std=0.1, observer=3, hidden=occulted),
    ],
    ids=lambda s: s.kind,
)
def test_shipped_sensors_can_be_pickled(sensor: Sensor) -> None:
    again = pickle.loads(pickle.dumps(sensor))
    x, before = generator(2).standard_normal((2, 4, 6)) * 1e5
    states = (x, before) if sensor.uses_previous else (x,)
    found = again.predict(*states)
    wanted = sensor.predict(*states)
    assert np.array_equal(found, wanted, equal_nan=True)
    assert np.array_equal(again.noise_cov, sensor.noise_cov)
    gaps = again.residual(found, 0 * found), sensor.residual(found, 0 * found)
    assert np.array_equal(*gaps, equal_nan=True)


def test_a_stacked_sensor_is_its_parts() -> None:
    full = np.array([[2.0, 0.5], [0.5, 1.0]])
    own = Sensor(2, lambda x: x[..., 1:], full, linear=lambda d: np.eye(d)[1:])
    parts = [own, line_angle([0, 1], std=0.2), distance([0, 1], std=0.3)]
    both = stack(parts)
    x = np.array([[1.0, 2.0, 3.0], [-1.0, 0.5, 2.0]])
    apart = np.concatenate([s.predict(x) for s in parts], axis=-1)
    assert (both.predict(x) == apart).all()
    assert np.allclose(
        both.noise_cov,
        [[2, 0.5, 0, 0], [0.5, 1, 0, 0], [0, 0, 0.04, 0], [0, 0, 0, 0.09]],
    )
    far = apart + np.array([0.0, 0.0, np.pi, 0.0])  # a line's angle repeats after pi
    assert np.abs(both.residual(far, apart)).max() < 1e-12
    assert both.linear is None
    assert (
        np.abs(
            both.jacobian(x) - np.concatenate([s.jacobian(x) for s in parts], -2)
        ).max()
        == 0
    )
    assert (stack([component([0], std=0.5), own]).H(3) == np.eye(3)).all()


def test_a_robot_sees_from_its_own_pose() -> None:
    """Distance and angle, from its place and heading, lead back to what it sees."""
    for one in generator(3).standard_normal((20, 5)):
        robot = range_bearing([0, 1], std=[0.1, 0.1], origin=one[2:4], heading=one[4])
        far, turn = robot.predict(one)
        way = far * np.array([np.cos(turn + one[4]), np.sin(turn + one[4])])
        assert np.allclose(one[2:4] + way, one[:2], atol=1e-12)


def test_angles_point_at_the_target() -> None:
    rng = np.random.default_rng(0)
    x = rng.standard_normal((30, 12)) * 1e4
    way = x[:, :3] - x[:, 6:9]
    a, d = angles_only(std=1e-4).predict(x).T
    unit = np.stack([np.cos(d) * np.cos(a), np.cos(d) * np.sin(a), np.sin(d)], axis=-1)
    assert np.allclose(unit * np.linalg.norm(way, axis=1, keepdims=True), way)


def test_the_printed_form_loses_a_sign_and_the_right_one_wraps() -> None:
    front = np.zeros(12)
    back = np.zeros(12)
    front[:3] = (3, 1, 1)
    back[:3] = (-3, 1, 1)
    printed = angles_only(std=1.0, form="printed")
    right = angles_only(std=1.0)
    assert np.allclose(printed.predict(front), printed.predict(back))
    assert not np.allclose(right.predict(front), right.predict(back))
    assert np.allclose(
        right.residual([np.pi - 0.1, 0.2], [-np.pi + 0.1, 0.1]), [-0.2, 0.1]
    )


def test_places_in_the_state_and_the_ephemeris() -> None:
    x = np.arange(18.0) ** 2
    eye = angles_only(std=1.0, observer=12)
    y = x[:12].copy()
    y[6:9] = x[12:15]
    assert np.allclose(eye.predict(x), angles_only(std=1.0).predict(y))
    fix = ephemeris(position_std=1e-3, velocity_std=1e-5)
    assert fix.predict(x).tolist() == x[:6].tolist()
    assert np.allclose(np.sqrt(np.diag(fix.noise_cov)), [1e-3] * 3 + [1e-5] * 3)


@pytest.mark.parametrize(
    "make",
    [
        partial(line_angle, [0, 1]),
        partial(line_angle, [0, 1], full=True),
        angles_only,
        lambda std: range_bearing([0, 1], std=(9.0, std)),
        lambda std: sensors.from_name("angle", [0, 1], std=std),
    ],
)
def test_an_angle_is_known_better_than_not_at_all(make: Callable[..., Sensor]) -> None:
    """A Gaussian wider than half a turn is none once it is wrapped."""
    make(std=3.1)
    with pytest.raises(ValueError, match=r"^std.* at most 3.14159, got 5"):
        make(std=5.0)


def test_a_hidden_direction_is_nan() -> None:
    x = np.zeros((2, 12))
    x[:, 0] = 26000.0
    x[0, 6] = -42000.0
    x[1, 7] = 42000.0
    for hidden in (occulted, lambda target, observer: observer[..., 0] < 0):
        seen = angles_only(std=1e-4, hidden=hidden).predict(x)
        assert np.isnan(seen).tolist() == [[True, True], [False, False]]
        assert np.array_equal(seen[1], angles_only(std=1e-4).predict(x)[1])
