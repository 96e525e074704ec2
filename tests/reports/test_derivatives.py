"""Derivatives by differences: single precision, large constants, fast phases.

Situations from public reports, with values made independently (closed forms, double precision).

==========================  ==============================================================
Report                      Situation here
==========================  ==============================================================
review d03                  ranges computed in single precision, a filter without derivative
review d04                  pseudorange of 22 361 km with an unknown clock
scipy issue 17636           x² in single precision at 1: the slope was 0
scipy pull request 12998    a fit of an exponential in single precision
FiniteDifferences.jl 98     accuracy with Float32 over many sizes of the argument
stan-dev/math issue 1265    arguments of very different sizes
g2o issue 541               a right derivative, doubted because of a fixed short step
JuliaDiff/FiniteDifferences
.jl issue 204               a step that suits some elements and not others (a fast phase)
own                         a phase that turns 600 times within the usual step
own                         noise within the function: no step serves
==========================  ==============================================================
"""

from __future__ import annotations

import warnings

import numpy as np
import pytest

from distfilt.coupling import Constraint
from distfilt.derivatives import central_difference
from distfilt.filters import GaussianFilter
from distfilt.kalman import filterpy_ekf
from distfilt.models import Model, constant_velocity, simulate
from distfilt.sensors import Sensor, stack, wrap
from tests.filters.families import still_model

ANCHORS = np.array([(0.0, 0.0), (100.0, 0.0), (0.0, 100.0)])
SATELLITE = np.array([2.0e7, 1.0e7])


def _ranges(x: np.ndarray, dtype: type = np.float32) -> np.ndarray:
    places = np.asarray(x, dtype)[..., None, :2]
    offset = places - ANCHORS.astype(dtype)
    return np.sqrt((offset**2).sum(axis=-1))


def _range_slopes(x: np.ndarray) -> np.ndarray:
    """Unit vectors from the anchors, in double precision."""
    offset = x[..., None, :2] - ANCHORS
    unit = offset / np.linalg.norm(offset, axis=-1, keepdims=True)
    return np.concatenate([unit, np.zeros_like(unit)], axis=-1)


def _pseudorange(x: np.ndarray) -> np.ndarray:
    offset = x[..., :2] - SATELLITE
    distance = np.linalg.norm(offset, axis=-1, keepdims=True)
    return distance + x[..., 2:]


@pytest.mark.parametrize("deviation", [None, 3.0, 0.05, 1e-3])
@pytest.mark.parametrize("factor", [1.0, 0.3048])
def test_slopes_in_single_precision(deviation: float | None, factor: float) -> None:
    """Also where the values come in double precision after a change of units."""
    rng = np.random.default_rng(1)
    positions = rng.uniform(-90, 90, (200, 2))
    velocities = rng.standard_normal((200, 2))
    x = np.concatenate([positions, velocities], axis=1)
    scale = None if deviation is None else np.full(4, deviation)
    slope = central_difference(lambda s: factor * _ranges(s), x, scale=scale)
    # A float32 near 100 is rounded by up to 4e-6, and a step has to balance that with the bend.
    error = np.abs(slope - factor * _range_slopes(x))
    assert error.max() < 2e-3
    assert np.median(error.max(axis=(-2, -1))) < 2e-4


@pytest.mark.parametrize("size", [1e-2, 1.0, 30.0, 4e3, 1e6])
def test_single_precision_at_every_size_of_the_argument(size: float) -> None:
    x = np.array([size])

    def square(states: np.ndarray) -> np.ndarray:
        return states.astype(np.float32) ** 2

    # d x² / dx = 2 x
    assert central_difference(square, x)[0, 0] == pytest.approx(2 * size, rel=2e-3)


def test_an_exponential_in_single_precision() -> None:
    """The slopes of a exp(-b t) in a and b."""
    t = np.linspace(0.1, 3.0, 7)

    def decay(x: np.ndarray) -> np.ndarray:
        single = x.astype(np.float32)
        a = single[..., 0, None]
        b = single[..., 1, None]
        return a * np.exp(-b * t.astype(np.float32))

    a = 2.5
    b = 1.3
    # ∂/∂a = exp(-b t) and ∂/∂b = -a t exp(-b t)
    decayed = np.exp(-b * t)
    expected = np.stack([decayed, -a * t * decayed], axis=-1)
    scale = np.array([0.1, 0.1])
    slope = central_difference(decay, np.array([a, b]), scale=scale)
    assert np.abs(slope - expected).max() < 5e-4


@pytest.mark.parametrize("constant", [2e5, 2e7, 2e9])
@pytest.mark.parametrize("deviation", [1e6, 30.0, 0.1])
def test_a_large_constant_in_the_values(constant: float, deviation: float) -> None:
    """The slope is 1 whatever is added; its error times the deviation is far below σ = 3."""
    sensor = Sensor(1, lambda x: constant + x, [[9.0]])
    slope = sensor.jacobian([0.0], std=[deviation])[0, 0]
    assert abs(slope - 1) * deviation < 1e-2


def test_pseudorange_in_every_way_it_is_linearised() -> None:
    """One observation of range and clock, d04; the posterior of a linear model in closed form."""
    sensor = Sensor(1, _pseudorange, [[9.0]])
    truth = np.array([0.0, 0.0, 3e5])
    y = _pseudorange(truth)
    prior = np.diag([1.0, 1.0, 1e12])
    # At the origin the range has the slope of the unit vector from the satellite; the clock has 1.
    unit = -SATELLITE / np.linalg.norm(SATELLITE)
    h = np.array([*unit, 1.0])
    # m = P Hᵀ y / S and P₃₃ = P₀ - P₀² / S with S = H P Hᵀ + R
    innovation_var = h @ prior @ h + 9.0
    mean = prior @ h * (3e5 / innovation_var)
    std = np.sqrt(1e12 - 1e24 / innovation_var)
    for linearization in ("extended", "unscented"):
        f = GaussianFilter(still_model(3), [sensor], linearization=linearization)
        start = f.start((np.zeros(3), prior))
        state = f.step(start, 0.0, [y])
        assert abs(state.means[0, 2] - mean[2]) < 0.1 * std
        assert state.covariances[0, 2, 2] ** 0.5 == pytest.approx(std, rel=1e-2)
    run = filterpy_ekf(
        np.zeros(3), prior, y[None], model=still_model(3), sensors=[sensor], times=[1.0]
    )
    assert abs(run.means[0, 2] - mean[2]) < 0.1 * std
    # Also within a stack, which has no standard deviations for its parts.
    slope = stack([sensor, sensor]).jacobian(np.zeros(3))
    assert np.abs(slope - h).max() < 1e-6


def test_a_gate_lets_good_pseudoranges_pass() -> None:
    rng = np.random.default_rng(4)
    sensor = Sensor(1, _pseudorange, [[9.0]])
    f = GaussianFilter(still_model(3), [sensor], gate_probability=0.999)
    state = f.start((np.zeros(3), np.diag([1.0, 1.0, 1e12])))
    for _ in range(100):
        y = _pseudorange(np.array([0.0, 0.0, 3e5])) + 3 * rng.standard_normal(1)
        state = f.step(state, 0.0, [y])
    # One in a thousand is expected to be rejected, of a hundred.
    assert state.rejected is not None
    assert state.rejected.sum() < 3
    # σ/√n of the mean of a hundred observations
    assert abs(state.means[0, 2] - 3e5) < 4 * 3 / 10 + 1


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_a_filter_whose_sensor_and_model_have_either_precision(dtype: type) -> None:
    """d03: rms and NEES are the same, and nobody is warned."""
    model = constant_velocity(sigma=0.1)
    times = np.arange(1.0, 41.0)
    truth = simulate(
        model, [30.0, 40.0, 1.0, -1.0], times, rng=np.random.default_rng(0)
    )
    noise = 0.1 * np.random.default_rng(1).standard_normal((40, 3))
    y = _ranges(truth, dtype) + noise

    def transition(x: np.ndarray, t: float, dt: float) -> np.ndarray:
        return np.asarray(x, dtype) @ model.F(dt).T.astype(dtype)

    same = Model(4, transition, model.noise_cov)
    sensor = Sensor(3, lambda x: _ranges(x, dtype), 0.01 * np.eye(3))
    f = GaussianFilter(same, [sensor])
    prior = [29.0, 41.0, 1.0, -1.0], np.diag([4, 4, 0.1, 0.1])
    with warnings.catch_warnings(action="error"):
        run = f.run(f.start(prior), times, [y], truth=truth)
    # Once the prior is forgotten: below the noise of 0.1 and its geometry, and consistent
    squared_errors = run["squared_error"].values[5:, 0, :2]
    root_mean_square = np.sqrt(squared_errors.mean())
    assert root_mean_square < 0.15
    nees_per_component = run["nees"].values[5:].mean() / 4
    assert nees_per_component < 1.5


def test_arguments_of_very_different_sizes() -> None:
    """f = x₀ x₁ + x₂ with sizes 1e8, 1e-6 and 1: each slope in closed form."""
    x = np.array([1e8, 1e-6, 1.0])

    def function(s: np.ndarray) -> np.ndarray:
        return s[..., :1] * s[..., 1:2] + s[..., 2:]

    scale = np.array([1e3, 1e-8, 1e-3])
    slope = central_difference(function, x, scale=scale)[0]
    # The slopes are (x₁, x₀, 1).
    # What counts is the change over a standard deviation, of which 1.4 is the largest.
    assert np.abs((slope - [1e-6, 1e8, 1.0]) * scale).max() < 1e-6


def test_a_fast_phase_beside_a_steep_value_and_a_constant() -> None:
    """The bend of sin(k x) is hidden beside a slope of 1e6; a constant of 1000 is no noise."""
    for k in (1e2, 1e4, 1e6):
        for constant in (0.0, 1e3):

            def function(
                x: np.ndarray, k: float = k, c: float = constant
            ) -> np.ndarray:
                return np.stack([c + np.sin(k * x[..., 0]), 1e6 * x[..., 0]], axis=-1)

            x = np.array([[0.3], [5.3], [77.0]])
            slope = central_difference(function, x)
            # d sin(k x) / dx = k cos(k x)
            exact = k * np.cos(k * x[:, 0])
            assert np.abs(slope[:, 0, 0] - exact).max() < 1e-3 * k
            assert np.abs(slope[:, 1, 0] - 1e6).max() < 1e-2


def test_a_phase_that_turns_many_times_within_the_usual_step() -> None:
    """A carrier of 19 cm at 20 000 km: only the standard deviation tells the scale."""
    rng = np.random.default_rng(2)
    x = 2e7 + rng.uniform(0, 100, (400, 1))
    k = 2 * np.pi / 0.19

    def phase(s: np.ndarray) -> np.ndarray:
        return wrap(k * (s - 2e7))

    slope = central_difference(
        phase, x, lambda a, b: wrap(a - b), scale=np.array([0.01])
    )
    # The phase grows by k = 2 π / 19 cm everywhere, but for its jumps.
    assert np.abs(slope - k).max() < 1e-3 * k
    # A filter hands its standard deviations over: 1/σ² = 1/P + k²/R.
    sensor = Sensor(1, phase, [[0.01]], residual_function=lambda a, b: wrap(a - b))
    f = GaussianFilter(still_model(1), [sensor])
    for place in x[:100]:
        start = f.start((place, [[1e-4]]))
        state = f.step(start, 0.0, [phase(place)])
        expected = 1 / (1e4 + k**2 / 0.01)
        assert state.covariances[0, 0, 0] == pytest.approx(expected, rel=5e-3)


def test_a_right_derivative_is_never_doubted() -> None:
    """At 200 places, in single precision, with large constants and with fast phases."""
    rng = np.random.default_rng(3)
    cases = [
        (3, _ranges, _range_slopes),
        (3, lambda x: 2e7 + _ranges(x, np.float64), _range_slopes),
        (
            1,
            lambda x: wrap(33.0 * x[..., :1]),
            lambda x: np.broadcast_to([33.0, 0, 0, 0], (*x.shape[:-1], 1, 4)),
        ),
    ]
    with warnings.catch_warnings(action="error"):
        for place in range(200):
            # Near the anchors, and so far away that single precision has a digit after the point
            far = 1e6 if place % 2 else 90.0
            for dim, h, derivative in cases:
                x = rng.uniform(-far, far, 4)
                residual = (lambda a, b: wrap(a - b)) if dim == 1 else None
                sensor = Sensor(
                    dim,
                    h,
                    np.eye(dim),
                    derivative=derivative,
                    residual_function=residual,
                )
                sensor.jacobian(x)
        # Values that change by steps of 2 m: differences say nothing about the slope.
        for _ in range(50):
            coarse = Sensor(
                3,
                lambda x: np.float32(2e7) + _ranges(x),
                np.eye(3),
                derivative=_range_slopes,
            )
            coarse.jacobian(rng.uniform(-2, 2, 4))


def test_a_wrong_derivative_is_doubted_in_single_precision_too() -> None:
    # The opposite sign, and exchanged columns
    sensor = Sensor(3, _ranges, np.eye(3), derivative=lambda x: -_range_slopes(x))
    with pytest.warns(RuntimeWarning, match="derivative does not match"):
        sensor.jacobian([30.0, 40.0, 1.0, -1.0])
    model = Model(
        2,
        lambda x, t, dt: x.astype(np.float32) * np.float32(2),
        lambda t, dt: np.eye(2),
        derivative=lambda x, t, dt: np.array([[0.0, 2.0], [2.0, 0.0]]),
    )
    with pytest.warns(RuntimeWarning, match="derivative does not match"):
        model.jacobian([3.0, 5.0], 0.0, 1.0)


def test_where_no_step_serves_one_warning_names_the_function() -> None:
    """A value that jumps up and down wherever one looks: ±0.2 beside a deviation of 0.1."""

    def noisy(x: np.ndarray) -> np.ndarray:
        return x[..., :1] + 0.2 * np.sin(1e13 * x[..., :1])

    sensor = Sensor(1, noisy, [[0.01]])
    with pytest.warns(RuntimeWarning, match="^h has no usable differences") as caught:
        for _ in range(3):
            slope = sensor.jacobian([1.0], std=[0.1])
    assert len(caught) == 1
    # At least the longest step was taken, and not the shortest, which gives 1e10.
    assert abs(slope[0, 0]) < 50
    model = Model(1, lambda x, t, dt: noisy(x), lambda t, dt: np.eye(1))
    with pytest.warns(RuntimeWarning, match="^transition has no usable differences"):
        model.jacobian([1.0], 0.0, 1.0, std=[0.1])


def test_smooth_functions_keep_every_digit() -> None:
    """The usual step stays, to the bit, whatever standard deviations are handed over."""
    rng = np.random.default_rng(6)
    x = rng.uniform(-20, 20, (50, 3))

    def lorenz(s: np.ndarray) -> np.ndarray:
        a = s[..., 0]
        b = s[..., 1]
        c = s[..., 2]
        rates = [10 * (b - a), a * (28 - c) - b, a * b - 8 / 3 * c]
        return np.stack(rates, axis=-1)

    # (f(x + h e_j) - f(x - h e_j)) / 2 h, with the h that is left after rounding of x ± h
    h = 6e-6 * np.maximum(1.0, np.abs(x))
    step = h[..., None] * np.eye(3)
    ahead = x[:, None] + step
    behind = x[:, None] - step
    true = np.diagonal(ahead - behind, axis1=-2, axis2=-1)
    difference = lorenz(ahead) - lorenz(behind)
    plain = (difference / true[..., None]).mT
    for deviation in (1e-3, 1.0, 20.0):
        slope = central_difference(lorenz, x, scale=np.full(3, deviation))
        assert (slope == plain).all()


def test_a_step_beyond_the_domain_is_not_taken() -> None:
    """Near 0 with a large deviation longer steps give errors or NaN, and are left out."""

    def positive(x: np.ndarray) -> np.ndarray:
        if (x < 0).any():
            raise ValueError("negative")
        return 2e9 + 2.5 * x

    x = np.array([0.04])
    with warnings.catch_warnings(action="error"):
        slope = central_difference(positive, x, scale=np.array([5.0]))[0, 0]
        nan = central_difference(lambda s: 1e6 + np.sqrt(s), x, scale=np.array([5.0]))
    assert slope == pytest.approx(2.5, rel=1e-4)
    assert nan[0, 0] == pytest.approx(2.5, rel=1e-4)


def test_a_constraint_in_single_precision() -> None:
    circle = Constraint(
        lambda x: (x.astype(np.float32) ** 2).sum(axis=-1, keepdims=True), [25.0]
    )
    # d |x|² / dx = 2 x
    slope = circle.jacobian([[3.0, 4.0]])
    assert np.abs(slope - [6.0, 8.0]).max() < 2e-3
