"""What every sensor does: shapes, noise, residuals, Jacobians, and what it refuses."""

from __future__ import annotations

import warnings
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from distfilt.sensors import Sensor, line_angle, wrap
from tests.support import NAN, generator

# Full, of several components, and with no symmetry that a transposed factor could hide behind.
FULL = np.array([[4.0, 1.2, -0.6], [1.2, 1.0, 0.3], [-0.6, 0.3, 0.5]])


@given(st.floats(-50, 50), st.integers(-5, 5))
def test_wrap_forgets_whole_turns(value: float, turns: int) -> None:
    once = wrap([value])
    again = wrap([value + turns * 2 * np.pi])
    assert abs(wrap(once - again)[0]) < 1e-9
    assert -np.pi <= once[0] < np.pi


@pytest.mark.parametrize("period", [2 * np.pi, np.pi, 1.0])
def test_wrap_at_its_ends(period: float) -> None:
    """Rounding must not put an angle just below an end beyond the other."""
    half = period / 2
    ends = np.array(
        [
            -half,
            np.nextafter(-half, -9),
            np.nextafter(half, -9),
            half,
            np.nextafter(half, 9),
            3 * half,
            -3 * half,
            np.nextafter(-3 * half, -9),
        ]
    )
    out = wrap(ends, period=period)
    assert (out >= -half).all() and (out < half).all()
    assert out[0] == -half and out[3] == -half and out[2] == ends[2]
    assert (wrap(out, period=period) == out).all()
    assert wrap(1e-300, period=period) == 1e-300
    assert np.array_equal(wrap([NAN, 0.1], period=period), [NAN, 0.1], equal_nan=True)


@pytest.mark.parametrize(
    "function",
    [
        lambda x: np.array([x[0] * x[1], x[2]]),
        lambda x: [x[0] + x[1], x[2] ** 2],
        lambda x: x[:2] ** 2,
    ],
)
@pytest.mark.parametrize("shape", [(5, 3), (2, 3), (2, 2, 3), (3, 3)])
def test_a_function_that_takes_one_state_only_is_refused(
    function: Callable[..., np.ndarray], shape: tuple[int, ...]
) -> None:
    sensor = Sensor(2, function, np.eye(2))
    assert sensor.predict([1.0, 2.0, 3.0]).shape == (2,)
    x = 2.0 + np.arange(np.prod(shape)).reshape(shape)
    with pytest.raises(ValueError, match=r"h must take many states at once"):
        sensor.predict(x)


def test_a_function_that_works_in_place_leaves_the_caller_s_states() -> None:
    def shift(x: np.ndarray) -> np.ndarray:
        x -= 1.0
        return x[..., :1]

    x = np.ones((3, 2))
    sensor = Sensor(1, shift, np.eye(1))
    assert not sensor.predict(x).any() and (x == 1).all()
    sensor.jacobian(x)
    assert (x == 1).all()


def test_observations_have_the_full_covariance() -> None:
    """A transposed factor has another covariance: each entry lies in its 99.99% band."""
    n = 40_000
    sensor = Sensor(3, lambda x: x, FULL)
    draws = sensor.observe(np.full((n, 3), 7.0), rng=generator(1)) - 7.0
    error = np.sqrt((FULL**2 + np.outer(FULL.diagonal(), FULL.diagonal())) / n)
    assert (np.abs(draws.T @ draws / n - FULL) < 3.9 * error).all()
    assert (np.abs(draws.mean(axis=0)) < 3.9 * np.sqrt(FULL.diagonal() / n)).all()


def test_residual_keeps_what_is_missing_on_either_side() -> None:
    sensor = Sensor(3, lambda x: x, np.eye(3))
    gap = sensor.residual([NAN, 2.0, 3.0], [[1.0, NAN, 1.0]])
    assert np.isnan(gap[0, :2]).all() and gap[0, 2] == 2.0
    turned = line_angle([0, 1], std=0.1, full=True)
    assert np.isnan(turned.residual([[NAN], [1.0]], [[1.0], [NAN]])).all()


def test_jacobian_without_a_formula() -> None:
    """Differences, through the sensor's own residual where readings wrap."""
    sensor = Sensor(
        1,
        lambda x: wrap(x.sum(axis=-1, keepdims=True)),
        np.eye(1),
        residual_function=lambda y, p: wrap(y - p),
    )
    x = np.array([[np.pi, 0.0], [1.0, 2.0]])
    assert np.abs(sensor.jacobian(x) - 1.0).max() < 1e-9
    with pytest.raises(
        ValueError, match="^difference must have observed less predicted"
    ):
        Sensor(1, sensor.h, np.eye(1), residual_function=lambda y, p: wrap(p - y))


def test_a_transposed_derivative_is_told_and_a_rough_one_is_not() -> None:
    """Nor one that differences cannot see, so near to a bend."""
    turn = np.array([[0.8, 0.6], [-0.6, 0.8]])
    for x, slope, told in ((1.0, 1.05 * turn, 0), (1.0, turn.T, 1), (1e-9, turn, 0)):
        sensor = Sensor(
            2, lambda x: np.abs(x) @ turn.T, np.eye(2), derivative=lambda x, s=slope: s
        )
        with warnings.catch_warnings(record=True, action="always") as caught:
            sensor.jacobian(np.full((3, 2), x))
        assert [str(one.message)[:10] for one in caught] == told * ["derivative"]


def test_jacobian_of_changes_is_in_the_present_state() -> None:
    bent = Sensor(
        1,
        lambda x, before: x[..., :1] ** 2 * before[..., 1:2],
        np.eye(1),
        uses_previous=True,
    )
    x, before = generator(0).standard_normal((2, 4, 2))
    slope = bent.jacobian(x, before)
    assert slope.shape == (4, 1, 2)
    assert np.abs(slope[:, 0, 0] - 2 * x[:, 0] * before[:, 1]).max() < 1e-9
    assert np.abs(slope[:, 0, 1]).max() < 1e-9
