"""Sensors that cannot see: NaN where the state cannot be observed.

==================================  ==========================================================
Report                              Situation
==================================  ==========================================================
POMDPPlanners pull 238              a field of view: NaN beyond the range, unscented filter
edpl-ompl issue 54                  on top of a landmark the likelihood is NaN
dust issue 178                      an observation that no particle can explain
Gen.jl issue 117                    weights of minus infinity, time after time
multicalc-rust issue 205            a weight that falls to zero, and evidence for it later
particles issue 42                  either of two components is missing at each time
ardupilot issue 19825               a direction divided by a range of zero
pykalman issue 58, filterpy         masked arrays: observations, truths, results of functions
pull 263, dynamax issue 430
own                                 a radar whose prior mean is its own place, extended filter
own                                 a target at the edge of the range, in every family
own                                 one of two components cannot be seen by some particles
==================================  ==========================================================
"""

from __future__ import annotations

import warnings
from functools import partial
from typing import Any

import numpy as np
import pytest

from distfilt import density, filters, network
from distfilt.filters import (
    EnsembleFilter,
    FilterError,
    GaussianFilter,
    MixtureFilter,
    Observation,
    ParticleFilter,
    TransportFilter,
)
from distfilt.kalman import QuaternionChart, mekf
from distfilt.mixtures import GaussianMixture
from distfilt.models import Model, constant_velocity, satellite_pose
from distfilt.network import graphs
from distfilt.sensors import (
    LikelihoodSensor,
    Sensor,
    bearing,
    component,
    distance,
    range_bearing,
)
from distfilt.updates.particles import ParticleCollapse, log_likelihood, reweight
from tests.filters.families import still_model

WALK = still_model(1, rate=0.01)
RADAR = Sensor(1, lambda x: np.where(np.abs(x) < 5, x, np.nan), [[0.04]])
PRIOR = ([4.0], [[4.0]])
MESSAGE = "observations must be predicted to be used"
Y = np.array([3.1, 2.9, 3.0, 3.2, 2.8])[:, None]
TIMES = np.arange(1.0, 6.0)


def truncated() -> tuple[float, float]:
    """The posterior on a grid: states out of range contradict each observation."""
    x = np.linspace(-12.0, 20.0, 6401)
    # The prior N(4, 4)
    density = np.exp(-0.5 * (x - 4) ** 2 / 4)
    # Process noise of variance 0.01 in each step, on the grid's spacing
    offsets = np.arange(-200, 201) * 0.005
    step = np.exp(-0.5 * offsets**2 / 0.01)
    for y in Y[:, 0]:
        density = np.convolve(density, step / step.sum(), mode="same")
        likelihood = np.exp(-0.5 * (y - x) ** 2 / 0.04)
        is_in_range = np.abs(x) < 5
        density = density * likelihood * is_in_range
        density /= density.sum()
    mean = density @ x
    return mean, density @ (x - mean) ** 2


def test_particles_that_cannot_see_contradict() -> None:
    f = ParticleFilter(WALK, [RADAR], members=20_000)
    with warnings.catch_warnings(action="error"):
        run = f.run(f.start(PRIOR, rng=np.random.default_rng(0)), TIMES, [Y])
    mean, variance = truncated()
    # Of 20 000 particles the mean errs by a thousandth or so: σ / sqrt(N) with σ of about 0.12.
    last_mean = run["mean"].values[-1, 0, 0]
    last_variance = run["variance"].values[-1, 0, 0]
    assert last_mean == pytest.approx(mean, abs=0.01)
    assert last_variance == pytest.approx(variance, rel=0.1)
    assert not run["unseen"].values.any()


@pytest.mark.parametrize(
    "make",
    [EnsembleFilter, TransportFilter, GaussianFilter],
)
def test_the_others_leave_out_count_and_say_so_once(make: Any) -> None:
    """Nothing is learned, the record counts each, and one warning comes in the whole run."""
    option = {"linearization": "unscented"} if make is GaussianFilter else {}
    f = make(WALK, [RADAR], **option)
    rng = np.random.default_rng(0)
    with pytest.warns(RuntimeWarning, match=MESSAGE) as caught:
        run = f.run(f.start(PRIOR, rng=rng), TIMES, [Y])
    assert sum(MESSAGE in str(w.message) for w in caught) == 1
    assert (run["unseen"].values == 1).all()
    # The mean stays at the prior's, but for the draws of the members.
    assert run["mean"].values[-1, 0, 0] == pytest.approx(4.0, abs=0.7)
    # A second step of the same filter does not warn again.
    with pytest.warns(RuntimeWarning, match="agent 0 left out one of kind 'sensor'"):
        state = f.step(f.start(PRIOR, rng=rng), 1.0, [Y[0]])
    with warnings.catch_warnings(action="error"):
        second = f.step(state, 2.0, [Y[1]])
    assert second.unseen.tolist() == [1.0]


def test_unscented_leaves_out_the_component_alone() -> None:
    """The other component acts as if it came alone."""

    def observe_both(x: np.ndarray) -> np.ndarray:
        near = np.where(np.abs(x) < 5, x, np.nan)
        return np.concatenate([near, x**2], axis=-1)

    pair = Sensor(2, observe_both, np.diag([0.04, 0.5]))
    square = Sensor(1, lambda x: x**2, [[0.5]])
    states = []
    for sensor, y in ((pair, [3.1, 9.0]), (square, [9.0])):
        f = GaussianFilter(WALK, [sensor], linearization="unscented")
        with warnings.catch_warnings(action="ignore"):
            states.append(f.step(f.start(PRIOR), 1.0, [y]))
    # One sigma point at 4 + 2 sqrt(2) > 5 cannot see the first component.
    of_pair, of_square = states
    assert np.allclose(of_pair.means, of_square.means, rtol=1e-12)
    assert np.allclose(of_pair.covariances, of_square.covariances, rtol=1e-12)


@pytest.mark.parametrize("linearization", ["extended", "unscented"])
@pytest.mark.parametrize(
    "sensor",
    [
        bearing([0, 1], std=0.05),
        range_bearing([0, 1], std=[0.1, 0.05]),
        distance([0, 1], std=0.1),
    ],
)
def test_a_sensor_on_its_target(sensor: Sensor, linearization: Any) -> None:
    """The extended filter says that it cannot move; the other learns of a distance."""
    model = constant_velocity(sigma=0.3)
    f = GaussianFilter(model, [sensor], linearization=linearization)
    start = f.start((np.zeros(4), np.diag([9.0, 9.0, 0.01, 0.01])))
    y = sensor.observe([3.0, 4.0, 0.0, 0.0], rng=np.random.default_rng(0))
    # |v| has a value at v = 0, so that the points around it show how far the target is.
    if sensor.kind == "distance" and linearization == "unscented":
        with warnings.catch_warnings(action="error"):
            assert f.step(start, 1.0, [y]).unseen is None
        return
    with pytest.warns(RuntimeWarning, match=MESSAGE):
        state = f.step(start, 1.0, [y])
    assert state.unseen.tolist() == [1.0]
    assert np.isfinite(state.covariances).all()


def test_a_radar_that_starts_on_its_target_counts_thirty() -> None:
    radar = range_bearing([0, 1], std=(0.1, 0.05))
    times = np.arange(1.0, 31.0)
    truth = np.tile([3.0, 4.0, 0.0, 0.0], (30, 1))
    y = radar.observe(truth, rng=np.random.default_rng(0))
    f = GaussianFilter(constant_velocity(sigma=0.3), [radar])
    cov = np.diag([9.0, 9.0, 0.01, 0.01])
    with pytest.warns(RuntimeWarning, match="singular point") as caught:
        run = f.run(f.start((np.zeros(4), cov)), times, [y])
    assert len(caught) == 1
    # At the sensor's own place the mean cannot move, so that no step uses its observation.
    assert run["unseen"].values.sum() == 30
    # One centimetre beside it, there is a derivative.
    with warnings.catch_warnings(action="error"):
        run = f.run(f.start(([0.01, 0, 0, 0], cov)), times, [y])
    error = run["mean"].values[-1, 0, :2] - [3, 4]
    assert np.abs(error).max() < 0.5


def test_particles_of_two_components_and_none_that_sees() -> None:
    """A particle contradicts by one component; a component that nobody sees is left out."""
    predicted = np.array([[0.0, np.nan], [0.5, 0.2], [1.0, 0.4]])
    logs = np.log(np.full(3, 1 / 3))
    y = np.array([0.4, 0.3])
    weights = np.exp(reweight(logs, predicted, y, np.eye(2)))
    # w ∝ exp(-½ |y - h(x)|²) of the two particles that see both components
    squares = (y - predicted[1:]) ** 2
    exact = np.exp(-0.5 * squares.sum(axis=-1))
    assert weights[0] == 0
    assert np.allclose(weights[1:], exact / exact.sum())
    # Where no particle sees the second component, the first one is used as if it came alone.
    one_seen = predicted * [1, np.nan]
    of_both = reweight(logs, one_seen, y, np.eye(2))
    of_first = reweight(logs, predicted[:, :1], y[:1], np.eye(1))
    assert np.allclose(of_both, of_first)
    # Updates of ensembles leave it out for all, as documented.
    assert np.isfinite(log_likelihood(predicted, y, np.eye(2))).all()
    f = ParticleFilter(WALK, [Sensor(1, lambda x: x * np.nan, [[1.0]])], members=100)
    with pytest.warns(RuntimeWarning, match="no particle can see"):
        state = f.step(f.start(PRIOR, rng=np.random.default_rng(0)), 1.0, [[1.0]])
    assert state.unseen.tolist() == [1.0]


def test_the_gate_of_particles_looks_through_those_that_see() -> None:
    f = ParticleFilter(WALK, [RADAR], members=4000, gate_probability=0.99)
    start = f.start(PRIOR, rng=np.random.default_rng(0))
    # Predictions of those that see are below 5: 3.1 is among them, -30 far off.
    assert f.step(start, 1.0, [[3.1]]).rejected.tolist() == [0.0]
    assert f.step(start, 1.0, [[-30.0]]).rejected.tolist() == [1.0]


def test_a_mixture_contradicts_by_component() -> None:
    f = MixtureFilter(WALK, [RADAR], target_dim=1)
    start = f.start(([0.0], [[0.1]]))
    state = f.step(start, 1.0, [[0.3]])
    # P = 0.1 + 0.01 and R = 0.04, so that the gain is P / (P + R)
    gain = 0.11 / 0.15
    mean = state.mixtures[0].means[0, 0]
    assert mean == pytest.approx(gain * 0.3)


def test_the_multiplicative_filter_says_so() -> None:
    x = np.r_[np.zeros(6), [0.3, 0.2, 0.1], [1.0, 0.0, 0.0, 0.0]]
    # The body is at the origin, the place of the sensor.
    sensor = bearing([0, 1], std=0.1)
    with pytest.warns(RuntimeWarning, match=MESSAGE):
        mekf(
            x,
            0.01 * np.eye(12),
            np.full((1, 1), 0.5),
            chart=QuaternionChart(13, 9),
            model=satellite_pose(rate=0.1, sigma=0.2, step=0.1),
            sensors=[sensor],
            times=[0.1],
        )


def test_a_correct_run_is_not_bothered() -> None:
    f = GaussianFilter(WALK, [[component([0], std=0.1), RADAR]])
    with warnings.catch_warnings(action="error"):
        run = f.run(f.start(([1.0], [[0.1]])), None, [Observation(1.0, 0, [1.0], 1)])
    assert run["unseen"].values.tolist() == [[0.0]]


def log_within(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """A uniform error of at most 1: minus infinity outside."""
    with np.errstate(divide="ignore"):
        return np.log(0.5 * (np.abs(y - x)[..., 0] <= 1))


def test_weights_of_minus_infinity_time_after_time() -> None:
    """Gen.jl issue 117: states that one observation excludes stay excluded, and no weight is NaN.

    Uniform errors leave the interval that all observations have in common. One that excludes all
    that is left contradicts the model, which is an error that says so.
    """
    x = np.linspace(0.0, 5.0, 501)[:, None]
    still = Model(1, lambda x, t, dt: x, lambda t, dt: np.zeros((1, 1)))
    ruler = LikelihoodSensor(1, log_within)
    f = ParticleFilter(still, [ruler], members=501, ess_threshold=0.0, jitter=0.0)
    state = f.start(x, rng=np.random.default_rng(0))
    for t, y in enumerate((2.0, 2.8, 1.5), start=1):
        state = f.step(state, float(t), [[y]])
    # Within 1 of 2.0, 2.8 and 1.5: from 2.8 - 1 to 1.5 + 1
    is_possible = (x[:, 0] >= 1.8 - 1e-9) & (x[:, 0] <= 2.5 + 1e-9)
    expected = is_possible / is_possible.sum()
    assert np.allclose(state.weights[0], expected, atol=1e-12)
    with pytest.raises(FilterError, match="every particle has a likelihood of zero"):
        f.step(state, 4.0, [[9.0]])


def test_a_weight_that_falls_to_zero_comes_back() -> None:
    """multicalc-rust issue 205: after 4 000 in the exponent, and as much evidence for it."""
    still = Model(1, lambda x, t, dt: x, lambda t, dt: np.zeros((1, 1)))
    x = np.array([[0.0], [1.0], [40.0]])
    f = ParticleFilter(
        still, [component([0], std=0.5)], members=3, ess_threshold=0.0, jitter=0.0
    )
    state = f.start(x, rng=np.random.default_rng(0))
    seen = [0.2, 0.4, 40.1, 39.0, 30.0]
    for t, y in enumerate(seen, start=1):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ParticleCollapse)
            state = f.step(state, float(t), [[y]])
        # log w = -½ Σ (y - x)² / 0.5² over all observations so far
        residuals = np.array(seen[:t]) - x
        logs = -2 * (residuals**2).sum(axis=1)
        weights = np.exp(logs - logs.max())
        assert np.allclose(state.weights[0], weights / weights.sum(), atol=1e-12)
        # The third particle has lost 6 300 in the exponent: its weight is zero as a number.
        if t == 2:
            assert state.weights[0, 2] == 0.0
    assert state.weights[0, 2] > 0.999


def test_either_component_is_missing_at_each_time() -> None:
    """particles issue 42: weights are products of the densities of those that are there."""
    still = Model(2, lambda x, t, dt: x, lambda t, dt: np.zeros((2, 2)))
    noise = np.array([[0.5, 0.3], [0.3, 0.4]])
    pair = Sensor(2, lambda x: x, noise)
    x = np.random.default_rng(0).standard_normal((50, 2))
    f = ParticleFilter(still, [pair], members=50, ess_threshold=0.0, jitter=0.0)
    state = f.start(x, rng=np.random.default_rng(0))
    logs = np.zeros(50)
    series = [[0.3, np.nan], [np.nan, -0.2], [0.1, 0.4], [np.nan, np.nan]]
    for t, y in enumerate(series, start=1):
        state = f.step(state, float(t), [y])
        present = np.flatnonzero(~np.isnan(y))
        if len(present):
            # The marginal density of the present components has their block of R.
            r = np.array(y)[present] - x[:, present]
            block = noise[np.ix_(present, present)]
            # rᵀ R⁻¹ r of each particle
            squares = np.einsum("ni,ij,nj->n", r, np.linalg.inv(block), r)
            logs = logs - 0.5 * squares
        weights = np.exp(logs - logs.max())
        assert np.allclose(state.weights[0], weights / weights.sum(), atol=1e-12)


@pytest.mark.parametrize("linearization", ["extended", "unscented"])
def test_a_direction_at_a_range_of_zero(linearization: Any) -> None:
    """ardupilot issue 19825: x / r at r = 0 is NaN, and the covariance stays as it was."""

    def look(x: np.ndarray) -> np.ndarray:
        r = np.linalg.norm(x, axis=-1, keepdims=True)
        with np.errstate(invalid="ignore", divide="ignore"):
            return x[..., :1] / r

    flow = Sensor(1, look, [[0.01]])
    still = Model(2, lambda x, t, dt: x, lambda t, dt: np.zeros((2, 2)))
    f = GaussianFilter(still, [flow], linearization=linearization)
    cov = np.diag([0.5, 0.3])
    with pytest.warns(RuntimeWarning, match=MESSAGE):
        start = f.start(([0.0, 0.0], cov))
        state = f.step(start, 0.0, [[0.4]])
    assert state.unseen.tolist() == [1.0]
    assert np.allclose(state.covariances[0], cov)
    assert np.allclose(state.means[0], 0.0)
    # Away from there it is used: H = (y², -x y) / r³.
    mean = np.array([3.0, 4.0])
    small_cov = 1e-4 * cov
    start = f.start((mean, small_cov))
    used = f.step(start, 1.0, [[0.7]])
    h = np.array([16.0, -12.0]) / 125
    innovation_var = h @ small_cov @ h + 0.01
    gain = small_cov @ h / innovation_var
    # K (y - x / r) at (3, 4), where x / r is 0.6
    assert np.allclose(used.means[0], mean + gain * (0.7 - 0.6), atol=1e-7)


HALF_MASKED = np.ma.masked_array([[9.0, 1.0]], mask=[[True, False]])
MASKS: dict[str, Any] = {
    "gaussian": GaussianFilter,
    "ensemble": EnsembleFilter,
    "particle": ParticleFilter,
    "transport": TransportFilter,
    "mixture": partial(MixtureFilter, target_dim=2),
    "increments": partial(
        filters.InformationIncrementFilter, graph=graphs.complete(1), target_dim=2
    ),
    "sum": filters.GaussianSumFilter,
    "grid": partial(
        filters.GridFilter, grid=density.Grid((20, 20), low=(-9, -9), high=(9, 9))
    ),
    "likelihood": partial(
        filters.LikelihoodConsensusFilter,
        graph=graphs.complete(1),
        basis=filters.PolynomialBasis([0, 1]),
        fusion=network.average_consensus,
    ),
    "information": partial(
        filters.InformationConsensusFilter,
        graph=graphs.complete(1),
        fusion=network.average_consensus,
    ),
    "channel": partial(filters.ChannelFilter, graph=graphs.path(1)),
}


@pytest.mark.parametrize("family", MASKS)
def test_a_mask_is_never_dropped(family: str) -> None:
    """Not in a series, which is taken apart at once, nor in any other place."""
    f = MASKS[family](still_model(2), [component([0, 1], std=0.5)])
    prior = (np.zeros(2), np.eye(2))
    state = f.start(prior, rng=np.random.default_rng(0))
    text = r"give [xy].filled\(np.nan\), a missing number is NaN"
    calls = [
        lambda: f.run(state, [1.0], [HALF_MASKED]),
        lambda: f.run(state, [1.0], HALF_MASKED[None]),
        lambda: f.step(state, 1.0, [HALF_MASKED[0]]),
        lambda: f.step(state, 1.0, [Observation(1.0, 0, HALF_MASKED[0])]),
        lambda: f.run(state, [1.0], [None], truth=HALF_MASKED),
        lambda: f.run(state, [1.0], [None], truth=lambda t: HALF_MASKED[0]),
    ]
    for call in calls:
        with pytest.raises(ValueError, match=text):
            call()
    filled = f.run(state, [1.0], [HALF_MASKED.filled(np.nan)])
    # Of the second component alone: mean 1 / 1.25
    assert np.allclose(filled["mean"][0, 0, 1], 0.8, atol=0.15)
    assert np.allclose(filled["mean"][0, 0, 0], 0.0, atol=0.2)


def test_functions_that_return_masks_are_refused() -> None:
    def masked(x: np.ndarray, *_: Any) -> Any:
        return np.ma.masked_greater(x, 1.0)

    text = r"must return numbers, got MaskedArray: give x.filled"
    with pytest.raises(ValueError, match="h " + text):
        Sensor(2, masked, np.eye(2)).predict([0.0, 2.0])
    with pytest.raises(ValueError, match="transition " + text):
        Model(2, masked, lambda t, dt: np.eye(2)).step([0.0, 2.0], 0.0, 1.0)
    slope = Sensor(
        2, lambda x: x, np.eye(2), derivative=lambda x: masked(2 * np.eye(2))
    )
    with pytest.raises(ValueError, match="derivative " + text):
        slope.jacobian([0.0, 2.0])
    wrapped = Sensor(
        2, lambda x: x, np.eye(2), residual_function=lambda a, b: masked(a - b)
    )
    with pytest.raises(ValueError, match="residual_function " + text):
        wrapped.residual([0.0, 2.0], [0.0, 0.0])
    sensor = LikelihoodSensor(2, lambda x, y: masked(x)[..., 0])
    with pytest.raises(ValueError, match="log_likelihood " + text):
        sensor.evaluate([0.0, 2.0], [0.0, 0.0])


def test_a_sum_at_a_singular_point_says_so() -> None:
    """A rounded value has the slope zero: nothing is used, as in an extended filter."""
    rounded = Sensor(1, lambda x: np.round(x, 1), [[0.01]])
    f = filters.GaussianSumFilter(still_model(1), [rounded])
    with pytest.warns(RuntimeWarning, match="derivative is zero at every component"):
        start = f.start(([1.23], [[0.04]]))
        run = f.run(start, [1.0], [[[1.5]]])
    assert run["unseen"][0, 0] == 1
    assert np.allclose(run["mean"], 1.23)
    # Points of an unscented filter see the slope, and components that differ are weighted.
    g = filters.GaussianSumFilter(still_model(1), [rounded], linearization="unscented")
    start = g.start(([1.23], [[0.04]]))
    unscented = g.step(start, 1.0, [[1.5]])
    assert unscented.component_means[0, 0] > 1.4
    two = GaussianMixture([0.5, 0.5], [[1.02], [1.48]], [[[1e-4]], [[1e-4]]])
    weighted = f.step(f.start(two), 1.0, [[1.5]])
    assert weighted.weights[0, 1] > 0.99
