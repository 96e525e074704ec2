"""The built-in sensors: predictions, origins, wrapped residuals, exact derivatives."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from distfilt import sensors
from distfilt.derivatives import central_difference
from distfilt.models import occulted
from distfilt.sensors import (
    Sensor,
    angles_only,
    bearing,
    component,
    distance,
    ephemeris,
    increment,
    line_angle,
    range_bearing,
    stack,
)
from tests.support import generator

PLACE = [0.7, -0.4]
X = np.array([[1.0, 2.0, 3.0], [-1.0, 0.5, 2.0]])


@given(st.floats(-3, 3), st.floats(-3, 3))
def test_an_angle_s_residual_is_the_short_way(y: float, p: float) -> None:
    """Of angles y / k and p / k with period 2π / k; k = 2 for a line.

    The residual is at most half a period, and k times it is the angle from p to y.
    """
    for sensor, k in ((bearing, 1), (line_angle, 2)):
        angle = sensor([0, 1], std=0.1)
        residual = angle.residual([y / k], [p / k])[0]
        assert abs(residual) <= np.pi / k
        # Angles are equal on the circle if exp(i a) are.
        difference = np.exp(1j * (y - p))
        assert abs(difference - np.exp(1j * k * residual)) < 1e-9


@pytest.mark.parametrize("sensor", [bearing, line_angle])
def test_the_angle_at_its_origin_is_missing(sensor: Callable[..., Sensor]) -> None:
    """NaN in prediction, residual and derivative, for that state only."""
    # The first state is at the sensor, the second one is not.
    x = np.array([[*PLACE, 1.0], [1.0, 1.0, 1.0]])
    angle = sensor([0, 1], std=0.1, origin=PLACE)
    predicted = angle.predict(x)
    assert np.isnan(predicted[0]).all()
    assert np.isfinite(predicted[1]).all()
    assert np.isnan(angle.residual([0.3], predicted)[0]).all()
    slope = angle.jacobian(x)
    assert np.isnan(slope[0, 0, :2]).all()
    assert np.isfinite(slope[1]).all()


def test_the_distance_at_its_origin_is_zero() -> None:
    """The bearing beside it is NaN there; the distance's derivative is set to zero."""
    x = np.array([[*PLACE, 1.0], [1.0, 1.0, 1.0]])
    radar = range_bearing([0, 1], std=[0.1, 0.1], origin=PLACE)
    predicted = radar.predict(x)
    assert predicted[0, 0] == 0.0
    assert np.isnan(predicted[0, 1])
    slope = radar.jacobian(x)
    assert not slope[0, 0].any()
    assert np.isfinite(slope[1]).all()


def test_components_and_increments_by_their_definition() -> None:
    previous = generator().standard_normal((2, 3))
    plain = component([2, 0], std=0.3)
    assert np.array_equal(plain.predict(X), X[:, [2, 0]])
    # H picks rows of the identity.
    assert np.array_equal(plain.H(3), np.eye(3)[[2, 0]])
    change = increment([2, 0], std=0.3)
    expected = (X - previous)[:, [2, 0]]
    assert np.array_equal(change.predict(X, previous), expected)
    # ∂(x - p)/∂x is H, too.
    slope = change.jacobian(X, previous)
    assert (slope == np.eye(3)[[2, 0]]).all()
    # One previous state for many present ones, or the reverse.
    assert change.jacobian(X[0], previous).shape == (2, 2, 3)


def test_distances_and_bearings_by_their_definition() -> None:
    """The distance is a hypotenuse and the bearing an arctan2; a radar measures both."""
    offset = X[:, [2, 0]] - PLACE
    lengths = distance([2, 0], std=0.1, origin=PLACE).predict(X)
    assert np.allclose(lengths[:, 0], np.hypot(*offset.T), rtol=1e-15, atol=0)
    angles = bearing([2, 0], std=0.1, origin=PLACE).predict(X)
    expected = np.arctan2(offset[:, 1], offset[:, 0])
    assert np.allclose(angles[:, 0], expected, rtol=1e-15, atol=0)
    place = np.array(PLACE)
    radar = range_bearing([2, 0], std=[0.3, 0.1], origin=place)
    # A caller who goes on with the array does not move the sensor.
    place += 9.0
    pairs = np.concatenate([lengths, angles], axis=-1)
    assert np.array_equal(radar.predict(X), pairs)
    assert np.allclose(radar.noise_cov, np.diag([0.09, 0.01]))


@pytest.mark.parametrize(
    "maker",
    [component, increment, distance, line_angle, bearing],
    ids=lambda f: f.__name__,
)
def test_a_sensor_by_its_name(maker: Callable[..., Sensor]) -> None:
    named = sensors.from_name(maker.__name__, [2, 0], std=0.3)
    made = maker([2, 0], std=0.3)
    assert named.kind == made.kind == maker.__name__
    assert np.allclose(named.noise_cov, 0.09 * np.eye(made.dim), rtol=1e-15, atol=0)
    # A residual of 4 tells periods π, 2π and none apart.
    observed = np.full(named.dim, 2.0)
    residual = made.residual(observed, -observed)
    assert np.array_equal(named.residual(observed, -observed), residual)


PARTS = [
    distance([2, 0], std=0.1),
    component([1], std=0.2),
    line_angle([0, 1], std=0.1),
]
SHIPPED = [
    component([2, 0], std=0.1),
    distance([0, 1, 2], std=0.1),
    distance([2, 0], std=0.1, origin=PLACE),
    line_angle([1, 2], std=0.1),
    bearing([2, 0], std=0.1, origin=PLACE),
    range_bearing([2, 1], std=[0.1, 0.2], origin=PLACE, heading=0.4),
    angles_only(std=0.1, observer=3),
    ephemeris(position_std=0.1, velocity_std=0.2),
    stack(PARTS),
]
WITHOUT_JACOBIAN = [
    increment([0, 1], std=0.1),
    angles_only(std=0.1, observer=3, hidden=occulted),
]


@pytest.mark.parametrize("sensor", SHIPPED, ids=lambda s: s.kind)
def test_jacobians_are_the_derivatives(sensor: Sensor) -> None:
    """Against central differences with a step of the test's own."""
    x = generator(1).standard_normal((3, 4, 6))
    slope = sensor.jacobian(x)
    # Differences of predictions are residuals, which wrap.
    numeric = central_difference(sensor.predict, x, sensor.residual, step=2e-5)
    assert slope.shape == (3, 4, sensor.dim, 6)
    assert np.abs(slope - numeric).max() < 1e-7


@pytest.mark.parametrize("sensor", [*SHIPPED, *WITHOUT_JACOBIAN], ids=lambda s: s.kind)
def test_shipped_sensors_can_be_pickled(sensor: Sensor) -> None:
    """The copy predicts, compares and errs alike."""
    copy = pickle.loads(pickle.dumps(sensor))
    x, previous = 1e5 * generator(2).standard_normal((2, 4, 6))
    states = (x, previous) if sensor.uses_previous else (x,)
    predicted = sensor.predict(*states)
    assert np.array_equal(copy.predict(*states), predicted, equal_nan=True)
    assert np.array_equal(copy.noise_cov, sensor.noise_cov)
    residual = sensor.residual(predicted, 0 * predicted)
    copied = copy.residual(predicted, 0 * predicted)
    assert np.array_equal(copied, residual, equal_nan=True)


def test_a_stacked_sensor_is_its_parts() -> None:
    """Predictions and Jacobians one below the other, noise independent."""
    full = np.array([[2.0, 0.5], [0.5, 1.0]])
    linear = Sensor(2, lambda x: x[..., 1:], full, linear=lambda d: np.eye(d)[1:])
    parts = [linear, line_angle([0, 1], std=0.2), distance([0, 1], std=0.3)]
    stacked = stack(parts)
    predictions = np.concatenate([s.predict(X) for s in parts], axis=-1)
    assert (stacked.predict(X) == predictions).all()
    slopes = np.concatenate([s.jacobian(X) for s in parts], axis=-2)
    assert (stacked.jacobian(X) == slopes).all()
    cov = [[2, 0.5, 0, 0], [0.5, 1, 0, 0], [0, 0, 0.04, 0], [0, 0, 0, 0.09]]
    assert np.allclose(stacked.noise_cov, cov)
    # A line's angle has period π, so that π more is no residual.
    turned = predictions + np.array([0.0, 0.0, np.pi, 0.0])
    assert np.abs(stacked.residual(turned, predictions)).max() < 1e-12
    # Linear if all parts are.
    assert stacked.linear is None
    linear_stack = stack([component([0], std=0.5), linear])
    assert (linear_stack.H(3) == np.eye(3)).all()


def test_a_robot_measures_from_its_own_pose() -> None:
    """Distance and bearing, from the robot's place and heading, lead to the target."""
    for state in generator(3).standard_normal((20, 5)):
        target = state[:2]
        place = state[2:4]
        heading = state[4]
        robot = range_bearing([0, 1], std=[0.1, 0.1], origin=place, heading=heading)
        length, angle = robot.predict(state)
        # target = place + length · (cos(angle + heading), sin(angle + heading))
        absolute = angle + heading
        direction = np.array([np.cos(absolute), np.sin(absolute)])
        assert np.allclose(place + length * direction, target, atol=1e-12)


def test_angles_point_at_the_target() -> None:
    """The unit vector of right ascension and declination, times the distance."""
    rng = np.random.default_rng(0)
    x = 1e4 * rng.standard_normal((30, 12))
    sight = x[:, :3] - x[:, 6:9]
    a, d = angles_only(std=1e-4).predict(x).T
    towards_x = np.cos(d) * np.cos(a)
    towards_y = np.cos(d) * np.sin(a)
    unit = np.stack([towards_x, towards_y, np.sin(d)], axis=-1)
    length = np.linalg.norm(sight, axis=1, keepdims=True)
    assert np.allclose(unit * length, sight)


def test_the_printed_form_loses_a_sign_and_the_right_one_wraps() -> None:
    """Targets in front of and behind the observer have the same arcsin(y)."""
    front = np.zeros(12)
    back = np.zeros(12)
    front[:3] = (3, 1, 1)
    back[:3] = (-3, 1, 1)
    printed = angles_only(std=1.0, form="printed")
    assert np.allclose(printed.predict(front), printed.predict(back))
    right = angles_only(std=1.0)
    assert not np.allclose(right.predict(front), right.predict(back))
    # From -π + 0.1 to π - 0.1 the short way is -0.2.
    residual = right.residual([np.pi - 0.1, 0.2], [-np.pi + 0.1, 0.1])
    assert np.allclose(residual, [-0.2, 0.1])


def test_the_observer_s_place_in_the_state_and_the_ephemeris() -> None:
    x = np.arange(18.0) ** 2
    telescope = angles_only(std=1.0, observer=12)
    # The same positions, the observer's where it is by default.
    y = x[:12].copy()
    y[6:9] = x[12:15]
    expected = angles_only(std=1.0).predict(y)
    assert np.allclose(telescope.predict(x), expected)
    # An ephemeris is the position and velocity of the first satellite.
    fix = ephemeris(position_std=1e-3, velocity_std=1e-5)
    assert fix.predict(x).tolist() == x[:6].tolist()
    std = np.sqrt(np.diag(fix.noise_cov))
    assert np.allclose(std, [1e-3] * 3 + [1e-5] * 3)


@pytest.mark.parametrize(
    "make",
    [
        partial(line_angle, [0, 1]),
        partial(bearing, [0, 1]),
        angles_only,
        lambda std: range_bearing([0, 1], std=(9.0, std)),
        lambda std: sensors.from_name("line_angle", [0, 1], std=std),
        lambda std: sensors.from_name("bearing", [0, 1], std=std),
    ],
)
def test_a_standard_deviation_of_an_angle_is_at_most_pi(
    make: Callable[..., Sensor],
) -> None:
    """A Gaussian wider than half a turn is none once it is wrapped."""
    make(std=3.1)
    with pytest.raises(ValueError, match=r"^std.* at most 3.14159, got 5"):
        make(std=5.0)


@pytest.mark.parametrize("kind", ["line_angle", "bearing"])
def test_an_angle_by_its_name_has_two_components(kind: str) -> None:
    with pytest.raises(ValueError, match="^indices must have 2 entries.* got 3"):
        sensors.from_name(kind, [0, 1, 2], std=0.1)


def test_a_hidden_direction_is_nan() -> None:
    """The observer of the first state is behind the Earth, that of the second is not."""
    x = np.zeros((2, 12))
    # Positions of targets and observers in km
    x[:, 0] = 26000.0
    x[0, 6] = -42000.0
    x[1, 7] = 42000.0
    plain = angles_only(std=1e-4).predict(x)
    for hidden in (occulted, lambda target, observer: observer[..., 0] < 0):
        predicted = angles_only(std=1e-4, hidden=hidden).predict(x)
        assert np.isnan(predicted).tolist() == [[True, True], [False, False]]
        assert np.array_equal(predicted[1], plain[1])


# A robot at (1, 2) with heading 0.5, and a landmark at (4, 6): 5 m away.
ROBOT_AND_LANDMARK = np.array([4.0, 6.0, 0.5, 1.0, 2.0])
LANDMARK_BEARING = np.arctan2(4.0, 3.0) - 0.5


@pytest.mark.parametrize(
    "sensor, value",
    [
        (distance([0, 1], std=1.0, observer=[3, 4]), [5.0]),
        (bearing([0, 1], std=1.0, observer=[3, 4]), [np.arctan2(4.0, 3.0)]),
        (bearing([0, 1], std=1.0, observer=[3, 4, 2]), [LANDMARK_BEARING]),
        (
            range_bearing([0, 1], std=(1.0, 1.0), observer=[3, 4, 2]),
            [5.0, LANDMARK_BEARING],
        ),
        (
            range_bearing([0, 1], std=(1.0, 1.0), observer=[3, 4]),
            [5.0, np.arctan2(4.0, 3.0)],
        ),
    ],
)
def test_a_sensor_on_a_body_of_the_state(sensor: Sensor, value: list[float]) -> None:
    """Values by hand; the derivative is that of the prediction, also by the sensor's own pose."""
    # Both are moved by 1 along the first axis, which changes neither distance nor bearing.
    moved = ROBOT_AND_LANDMARK + [1.0, 0, 0, 1.0, 0]
    states = np.stack([ROBOT_AND_LANDMARK, moved])
    assert np.allclose(sensor.predict(states), value, atol=1e-14)
    # Central differences: (h(x + ε e_j) - h(x - ε e_j)) / 2 ε
    size = 1e-6
    shift = size * np.eye(5)
    forward = sensor.predict(states[:, None] + shift)
    backward = sensor.predict(states[:, None] - shift)
    slope = (forward - backward).mT / (2 * size)
    assert np.allclose(sensor.jacobian(states), slope, atol=1e-8)


def test_a_sensor_on_a_body_sees_nothing_at_its_own_place() -> None:
    camera = range_bearing([0, 1], std=(1.0, 1.0), observer=[3, 4, 2])
    x = np.array([1.0, 2.0, 0.5, 1.0, 2.0])
    assert camera.predict(x)[0] == 0.0 and np.isnan(camera.predict(x)[1])
    assert np.isnan(camera.jacobian(x)[1, 2])
    # The bearing wraps with the heading.
    x = np.array([0.0, 2.0, -3.0, 1.0, 2.0])
    assert np.allclose(camera.predict(x), [1.0, np.pi + 3.0 - 2 * np.pi])


@pytest.mark.parametrize(
    "options, message",
    [
        ({"observer": [2], "std": 1.0}, "observer must have 2 components, got 1"),
        ({"observer": [2, 3, 4], "std": 1.0}, "observer must have 2 .* got 3"),
        ({"observer": [1, 2], "std": 1.0}, "other components than indices"),
        ({"observer": [2, 3], "origin": [0.0, 0.0], "std": 1.0}, "origin must be None"),
    ],
)
def test_an_observer_that_does_not_fit_is_refused(
    options: dict[str, Any], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        distance([0, 1], **options)
    with pytest.raises(ValueError, match="heading must be 0"):
        range_bearing([0, 1], std=(1.0, 1.0), heading=1.0, observer=[2, 3])


def test_of_a_range_and_a_bearing_the_bearing_wraps() -> None:
    """Ranges that differ by more than a turn's 2π stay as they are."""
    sensor = sensors.range_bearing([0, 1], std=(0.1, 0.1))
    residual = sensor.residual(np.array([10.0, 3.0]), np.array([1.0, -3.0]))
    assert np.allclose(residual, [9.0, 6.0 - 2 * np.pi])
