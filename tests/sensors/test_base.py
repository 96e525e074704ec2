"""Properties of every sensor: shapes, noise, residuals, Jacobians, and refused arguments."""

from __future__ import annotations

import warnings
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from distfilt.sensors import Sensor, bearing, wrap
from tests.support import NAN, generator

# A full matrix without symmetry, so that a transposed factor would have another
# covariance.
FULL = np.array([[4.0, 1.2, -0.6], [1.2, 1.0, 0.3], [-0.6, 0.3, 0.5]])


@given(st.floats(-50, 50), st.integers(-5, 5))
def test_wrap_forgets_whole_turns(value: float, turns: int) -> None:
    once = wrap([value])
    # Equal on the circle: near its ends rounding may put one at π and the other at -π.
    turned = wrap([value + turns * 2 * np.pi])
    assert abs(wrap(once - turned)[0]) < 1e-9
    assert -np.pi <= once[0] < np.pi


@pytest.mark.parametrize("period", [2 * np.pi, np.pi, 1.0])
def test_wrap_at_its_ends(period: float) -> None:
    """Rounding must not put an angle just below one end beyond the other."""
    half = period / 2
    inside = np.nextafter(half, -9)
    ends = np.array(
        [
            -half,
            np.nextafter(-half, -9),
            inside,
            half,
            np.nextafter(half, 9),
            3 * half,
            -3 * half,
            np.nextafter(-3 * half, -9),
        ]
    )
    wrapped = wrap(ends, period=period)
    assert (wrapped >= -half).all()
    assert (wrapped < half).all()
    # Both ends are the same angle, -half; the largest angle below half stays.
    assert wrapped[0] == -half
    assert wrapped[3] == -half
    assert wrapped[2] == inside
    # Idempotent, exact for tiny angles, NaN stays.
    assert (wrap(wrapped, period=period) == wrapped).all()
    assert wrap(1e-300, period=period) == 1e-300
    with_nan = wrap([NAN, 0.1], period=period)
    assert np.array_equal(with_nan, [NAN, 0.1], equal_nan=True)


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
    # One state is no evidence; several are, also where shapes fit by accident.
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
    assert not sensor.predict(x).any()
    assert (x == 1).all()
    sensor.jacobian(x)
    assert (x == 1).all()


def test_observations_have_the_full_covariance() -> None:
    """A transposed factor has another covariance: each entry lies in its 99.99% band."""
    n = 40_000
    sensor = Sensor(3, lambda x: x, FULL)
    noise = sensor.observe(np.full((n, 3), 7.0), rng=generator(1)) - 7.0
    # The variance of a sample covariance's entry is (R_ij² + R_ii R_jj) / n.
    variances = FULL.diagonal()
    entry_variances = (FULL**2 + np.outer(variances, variances)) / n
    error = np.sqrt(entry_variances)
    sample_cov = noise.T @ noise / n
    assert (np.abs(sample_cov - FULL) < 3.9 * error).all()
    # The variance of a mean is R_ii / n.
    mean_error = np.sqrt(variances / n)
    assert (np.abs(noise.mean(axis=0)) < 3.9 * mean_error).all()


def test_residual_keeps_nan_of_either_argument() -> None:
    sensor = Sensor(3, lambda x: x, np.eye(3))
    residual = sensor.residual([NAN, 2.0, 3.0], [[1.0, NAN, 1.0]])
    assert np.isnan(residual[0, :2]).all()
    assert residual[0, 2] == 2.0
    # Also of a residual that wraps.
    angle = bearing([0, 1], std=0.1)
    wrapped = angle.residual([[NAN], [1.0]], [[1.0], [NAN]])
    assert np.isnan(wrapped).all()


def test_jacobian_without_a_formula() -> None:
    """Differences go through the sensor's own residual, where observations wrap."""
    sensor = Sensor(
        1,
        lambda x: wrap(x.sum(axis=-1, keepdims=True)),
        np.eye(1),
        residual_function=lambda y, p: wrap(y - p),
    )
    # At π the prediction jumps by 2π, the residual does not: every derivative is 1.
    x = np.array([[np.pi, 0.0], [1.0, 2.0]])
    assert np.abs(sensor.jacobian(x) - 1.0).max() < 1e-9
    # Predicted minus observed has the opposite sign and is refused.
    with pytest.raises(ValueError, match="^residual_function must return observed"):
        Sensor(1, sensor.h, np.eye(1), residual_function=lambda y, p: wrap(p - y))


def test_a_transposed_derivative_warns_and_a_rough_one_does_not() -> None:
    """h(x) = Q |x| has the derivative Q for positive x.

    Five percent off is close enough. So is any slope at 1e-9 from the bend of |x|,
    where the differences themselves depend on their step.
    """
    turn = np.array([[0.8, 0.6], [-0.6, 0.8]])
    cases = ((1.0, 1.05 * turn, 0), (1.0, turn.T, 1), (1e-9, turn, 0))
    for value, slope, count in cases:
        sensor = Sensor(
            2,
            lambda x: np.abs(x) @ turn.T,
            np.eye(2),
            derivative=lambda x, s=slope: s,
        )
        with warnings.catch_warnings(record=True, action="always") as caught:
            sensor.jacobian(np.full((3, 2), value))
        assert [str(one.message)[:10] for one in caught] == count * ["derivative"]


def test_jacobian_of_changes_is_in_the_present_state() -> None:
    """h(x, p) = x₀² p₁ has the derivative (2 x₀ p₁, 0) in x."""
    sensor = Sensor(
        1,
        lambda x, previous: x[..., :1] ** 2 * previous[..., 1:2],
        np.eye(1),
        uses_previous=True,
    )
    x, previous = generator(0).standard_normal((2, 4, 2))
    slope = sensor.jacobian(x, previous)
    assert slope.shape == (4, 1, 2)
    expected = 2 * x[:, 0] * previous[:, 1]
    assert np.abs(slope[:, 0, 0] - expected).max() < 1e-9
    assert np.abs(slope[:, 0, 1]).max() < 1e-9
