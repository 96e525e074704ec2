"""Streams from public reports: late, missing and irregular data, resets, evidence.

| Report | Situation |
|---|---|
| cra-ros-pkg/robot_localization 263 | a late measurement is used at its own time |
| cra-ros-pkg/robot_localization pull 266 | one of 3 s ago, and then one of 2 s ago |
| locusrobotics/fuse pull 136 | a late measurement at the edge of the window, and beyond it |
| MOLAorg/mola_state_estimation pull 44 | a late measurement moves no clock backwards |
| rlabbe/filterpy 15 | fixed-lag smoothing is the conditional mean, given so many more |
| rlabbe/filterpy 37 | smoothing with a matrix of each step, one step beside |
| baggepinnen/LowLevelParticleFilters.jl pull 275 | a matrix of the time, in smoothing |
| pykalman/pykalman 44 | a noise of each step, of which the first was used for all |
| pykalman/pykalman 24 | whether the first observation is of the prior's time or of the next |
| baggepinnen/LowLevelParticleFilters.jl 134 | evidence where particles resample now and then |
| TuringLang/Turing.jl pull 1266 | the same, with weights that are carried on |
| robjhyndman/forecast pull 1121 | missing observations that count in the likelihood |
| pymc-devs/pymc-extras pull 682 | missing components beside correlated noise |
| PX4/PX4-Autopilot pull 23644 | a velocity that is reset, and the position's covariance |
| cra-ros-pkg/robot_localization pull 304 | a reset, and then an observation of before it |

Right values are those of the joint Gaussian of all states and observations, at once, in numpy.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
import pytest
from scipy.stats import multivariate_normal, norm

from distfilt import filters
from distfilt.filters import Observation
from distfilt.kalman import kalman_filter, rts_smoother
from distfilt.models import LinearModel, constant_velocity
from distfilt.sensors import Sensor, component

MOTION = constant_velocity(sigma=0.5, axes=1)
PLACE = component([0], std=0.4)
SPEED = component([1], std=0.3)
PRIOR = (np.array([0.0, 1.0]), np.array([[1.0, 0.2], [0.2, 0.5]]))


def spread(t: float) -> np.ndarray:
    """Return Q of a step of length t: white acceleration of 0.5 per root second."""
    return 0.25 * np.array([[t**3 / 3, t**2 / 2], [t**2 / 2, t]])


def drift(t: float) -> np.ndarray:
    return np.array([[1.0, t], [0.0, 1.0]])


def joint(
    observed: list[tuple[float, int, float]], t: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return mean and covariance of x(t) given events (time, component, value), all at once.

    cov(x(r), x(s)) = P(r) Φ(s - r)ᵀ for r ≤ s, with P(r) = Φ(r) P₀ Φ(r)ᵀ + Q(r).
    """
    m0, p0 = PRIOR

    def cross(r: float, s: float) -> np.ndarray:
        if r > s:
            return cross(s, r).T
        cov = drift(r) @ p0 @ drift(r).T + spread(r)
        return cov @ drift(s - r).T

    n = len(observed)
    y = np.empty(n)
    mean_y = np.empty(n)
    cov_y = np.empty((n, n))
    cov_xy = np.empty((2, n))
    for a, (s, k, value) in enumerate(observed):
        y[a] = value
        mean_y[a] = (drift(s) @ m0)[k]
        cov_xy[:, a] = cross(t, s)[:, k]
        for b, (r, j, _) in enumerate(observed):
            cov_y[a, b] = cross(s, r)[k, j]
        # The noise of a place or of a speed
        cov_y[a, a] += (0.16, 0.09)[k]
    # E[x | y] = E x + C_xy C_yy⁻¹ (y - E y)
    gain = np.linalg.solve(cov_y, cov_xy.T).T
    mean = drift(t) @ m0 + gain @ (y - mean_y)
    cov = cross(t, t) - gain @ cov_xy.T
    return mean, cov


FAMILIES: dict[str, tuple[Any, float]] = {
    "extended": (filters.GaussianFilter, 1e-9),
    "unscented": (partial(filters.GaussianFilter, linearization="unscented"), 1e-9),
    "ensemble": (partial(filters.EnsembleFilter, members=20_000), 0.05),
    "particle": (partial(filters.ParticleFilter, members=40_000), 0.05),
}
EACH = pytest.mark.parametrize("family", FAMILIES)
SERIES = [0.7, 2.2, 2.9, 4.4, 5.2]
TIMES = np.arange(1.0, 6.0)
ON_TIME = [(t, 0, y) for t, y in zip(TIMES.tolist(), SERIES, strict=True)]


def check(state: Any, f: Any, events: list[Any], tolerance: float) -> None:
    mean, cov = joint(events, state.t)
    # Errors are in units of the right standard deviations.
    std = np.sqrt(np.diag(cov))
    summary = f.summarize(state)
    mean_error = (summary.mean[0] - mean) / std
    std_error = np.sqrt(summary.variance[0]) / std - 1
    assert np.abs(mean_error).max() < tolerance
    assert np.abs(std_error).max() < tolerance


# Late measurements.


@EACH
def test_one_of_three_seconds_ago_and_then_one_of_two(family: str) -> None:
    """robot_localization 263 and pull 266: at their own times, in whatever order they come."""
    make, tolerance = FAMILIES[family]
    f = make(MOTION, [[PLACE, SPEED]], lag=6)
    state = f.start(PRIOR, rng=np.random.default_rng(0))
    for t, _, y in ON_TIME:
        state = f.step(state, t, [[Observation(t, 0, [y])]])
    # The one of 2.5 s is of no step's time.
    late = [(2.0, 1, 1.4), (2.5, 1, 0.6), (3.0, 1, 1.1)]
    for t, number, y in late:
        delayed = [Observation(t, 0, [y], number)]
        state = f.step(state, 5.0, [None], delayed=delayed)
    check(state, f, [*ON_TIME, *late], tolerance)


def test_a_late_one_at_the_edge_of_the_window_and_beyond() -> None:
    """fuse pull 136: the oldest time that is kept is used, an older one is refused by name."""
    f = filters.GaussianFilter(MOTION, [[PLACE, SPEED]], lag=2)
    state = f.start(PRIOR)
    for t, _, y in ON_TIME:
        state = f.step(state, t, [[Observation(t, 0, [y])]])
    assert state.times == (3.0, 4.0)
    edge = f.step(state, 5.0, [None], delayed=[Observation(3.0, 0, [0.6], 1)])
    check(edge, f, [*ON_TIME, (3.0, 1, 0.6)], 1e-9)
    # With the next step the window moves on.
    edge = f.step(state, 6.0, [None], delayed=[Observation(4.0, 0, [0.6], 1)])
    check(edge, f, [*ON_TIME, (4.0, 1, 0.6)], 1e-9)
    with pytest.raises(
        ValueError, match="an earlier time that is kept .3, 4., got 2.9"
    ):
        f.step(state, 5.0, [None], delayed=[Observation(2.9, 0, [0.6], 1)])


def test_a_late_one_moves_no_clock_backwards() -> None:
    """mola_state_estimation pull 44: the state stays at its time, and so does the record."""
    f = filters.GaussianFilter(MOTION, [[PLACE, SPEED]], lag=4)
    late = [Observation(1.5, 0, [0.4], 1, arrival_time=4.0)]
    events = [Observation(t, 0, [y]) for t, _, y in ON_TIME]
    run = f.run(f.start(PRIOR), TIMES, events, delayed=late)
    assert run["time"].values.tolist() == TIMES.tolist()
    check(f.final_state(run), f, [*ON_TIME, (1.5, 1, 0.4)], 1e-9)
    # Records from before it came do not know it.
    mean, _ = joint(ON_TIME[:3], 3.0)
    assert np.allclose(run["mean"].values[2, 0], mean, atol=1e-9)


# Smoothing, and matrices of each step.


@pytest.mark.parametrize("lag", [1, 2, 4])
def test_fixed_lag_smoothing_is_a_conditional_mean(lag: int) -> None:
    """filterpy 15: E[x(t_k) | y up to t_{k + lag}], from the joint Gaussian."""
    f = filters.GaussianFilter(MOTION, [PLACE], lag=lag)
    smoothed = f.smooth(f.start(PRIOR), TIMES, [np.array(SERIES)[:, None]])
    for k, t in enumerate(TIMES):
        mean, cov = joint(ON_TIME[: k + lag + 1], t)
        smoothed_mean = smoothed["mean"].values[k, 0]
        smoothed_cov = smoothed["covariance"].values[k, 0]
        assert np.allclose(smoothed_mean, mean, atol=1e-9)
        assert np.allclose(smoothed_cov, cov, atol=1e-9)


RNG = np.random.default_rng(3)
MATRICES = np.eye(2) + 0.4 * RNG.standard_normal((5, 2, 2))
ROOTS = RNG.standard_normal((5, 2, 2))
NOISES = ROOTS @ ROOTS.mT + 0.1 * np.eye(2)
VARIANCES = np.array([0.1, 3.0, 0.5, 0.05, 1.0])


def joint_of_matrices() -> tuple[np.ndarray, np.ndarray]:
    """Return means (5, 2) and covariances of five states given five first components.

    All states are a linear function of x₀ and of the noises, (x₀, w₁, ..., w₅).
    """
    m0, p0 = PRIOR
    maps = np.zeros((5, 2, 12))
    before = np.hstack([np.eye(2), np.zeros((2, 10))])
    prior_mean = np.concatenate([m0, np.zeros(10)])
    prior_cov = np.zeros((12, 12))
    prior_cov[:2, :2] = p0
    for k in range(5):
        # x_k = F_k x_{k-1} + w_k, as a matrix that acts on (x₀, w₁, ..., w₅)
        block = slice(2 + 2 * k, 4 + 2 * k)
        before = MATRICES[k] @ before
        before[:, block] += np.eye(2)
        maps[k] = before
        prior_cov[block, block] = NOISES[k]
    # The five observations y = H (x₀, w₁, ..., w₅) + v at once
    h = maps[:, 0]
    s = h @ prior_cov @ h.T + np.diag(VARIANCES)
    gain = np.linalg.solve(s, h @ prior_cov).T
    innovation = np.array(SERIES) - h @ prior_mean
    mean = prior_mean + gain @ innovation
    cov = prior_cov - gain @ h @ prior_cov
    return maps @ mean, maps @ cov @ maps.mT


def matrices_by_time() -> LinearModel:
    """Return the same as a model whose matrix and noise depend on the time of a step."""

    def matrix(t: float, dt: float) -> np.ndarray:
        return MATRICES[round(t)]

    def noise(t: float, dt: float) -> np.ndarray:
        return NOISES[round(t)]

    return LinearModel.from_transition(2, matrix, noise)


def test_matrices_and_noises_of_each_step_in_a_smoother() -> None:
    """filterpy 37 and pykalman 44: F, Q and R of the right step, forward and backward."""
    y = np.array(SERIES)[:, None]
    h = np.array([[1.0, 0.0]])
    run = kalman_filter(
        *PRIOR, y, F=MATRICES, H=h, Q=NOISES, R=VARIANCES[:, None, None]
    )
    smooth = rts_smoother(run, F=MATRICES, Q=NOISES)
    means, covs = joint_of_matrices()
    assert np.allclose(smooth.means, means, atol=1e-9)
    assert np.allclose(smooth.covariances, covs, atol=1e-9)
    # With the matrices of the step before or after, it is something else.
    wrong = rts_smoother(run, F=np.roll(MATRICES, 1, axis=0), Q=NOISES)
    assert np.abs(wrong.means - means).max() > 0.1


@pytest.mark.parametrize("linearization", ["extended", "unscented"])
def test_a_model_that_depends_on_the_time_in_a_smoother(linearization: Any) -> None:
    """LowLevelParticleFilters pull 275: of the steps' own times, with a lag for all."""
    sensors = [component([0], std=float(np.sqrt(v))) for v in VARIANCES]
    f = filters.GaussianFilter(
        matrices_by_time(), [sensors], lag=5, linearization=linearization
    )
    events = [
        Observation(t, 0, [y], k)
        for k, (t, y) in enumerate(zip(TIMES.tolist(), SERIES, strict=True))
    ]
    smooth = f.smooth(f.start(PRIOR), None, events)
    means, covs = joint_of_matrices()
    assert np.allclose(smooth["mean"].values[:, 0], means, atol=1e-8)
    assert np.allclose(smooth["covariance"].values[:, 0], covs, atol=1e-8)


@EACH
@pytest.mark.parametrize("first", [0.0, 1.0])
def test_an_observation_of_the_priors_own_time(family: str, first: float) -> None:
    """pykalman 24: without a forecast at the prior's time, and after one a second later."""
    make, tolerance = FAMILIES[family]
    f = make(MOTION, [PLACE])
    start = f.start(PRIOR, rng=np.random.default_rng(0))
    run = f.run(start, [first], [[[0.8]]])
    check(f.final_state(run), f, [(first, 0, 0.8)], tolerance)


# Evidence.


@pytest.mark.parametrize("threshold", [0.0, 0.3, 0.5, 1.0])
def test_evidence_where_particles_resample_now_and_then(threshold: float) -> None:
    """LowLevelParticleFilters 134 and Turing pull 1266: the same for each threshold.

    The density of five observations is that of a Gaussian of five; the error of its logarithm is
    below 0.01 with so many particles.
    """
    f = filters.ParticleFilter(
        MOTION,
        [PLACE],
        members=100_000,
        ess_threshold=threshold,
        record_evidence=True,
    )
    start = f.start(PRIOR, rng=np.random.default_rng(5))
    run = f.run(start, TIMES, [np.array(SERIES)[:, None]])
    # log p(y₁, …, y₅) = Σ log p(y_k | y₁, …, y_{k-1}); without observations `joint` is the prior.
    expected = 0.0
    for k, (t, _, y) in enumerate(ON_TIME):
        mean, cov = joint(ON_TIME[:k], t)
        innovation_var = cov[0, 0] + 0.16
        expected += norm.logpdf(y, mean[0], np.sqrt(innovation_var))
    log_likelihood = float(run["log_likelihood"].sum())
    assert abs(log_likelihood - expected) < 0.05
    # Each way of resampling occurs: never, at some steps, at all of them.
    sizes = run["effective_size"].values[:-1, 0]
    n_due = int((sizes < threshold * 100_000).sum())
    possible = {0.0: (0,), 1.0: (4,)}.get(threshold, (1, 2, 3))
    assert n_due in possible


@pytest.mark.parametrize("linearization", ["extended", "unscented"])
def test_missing_numbers_are_no_evidence(linearization: Any) -> None:
    """forecast pull 1121 and pymc-extras pull 682: rows and columns of R are left out."""
    noise = np.array([[0.5, 0.3], [0.3, 0.4]])
    pair = Sensor(2, lambda x: 2.0 * x + 1.0, noise)
    f = filters.GaussianFilter(
        MOTION, [pair], record_evidence=True, linearization=linearization
    )
    start = f.start(PRIOR, t=1.0)
    # Mean and covariance of y = 2 x + 1 + noise
    mean = 2 * PRIOR[0] + 1
    cov = 4 * PRIOR[1] + noise
    value = np.array([0.4, 2.0])
    for missing in ([], [0], [1], [0, 1]):
        y = value.copy()
        y[missing] = np.nan
        state = f.step(start, 1.0, [y])
        present = np.flatnonzero(~np.isnan(y))
        assert state.n_observed.tolist() == [len(present)]
        if not len(present):
            assert state.log_likelihood.tolist() == [0.0]
            assert state.nis.tolist() == [0.0]
            continue
        # The marginal density of the present components
        block = cov[np.ix_(present, present)]
        law = multivariate_normal(mean[present], block)
        assert np.isclose(state.log_likelihood[0], law.logpdf(y[present]))
        # rᵀ S⁻¹ r with the innovation r
        r = y[present] - mean[present]
        nis = r @ np.linalg.solve(block, r)
        assert np.isclose(state.nis[0], nis)


# Resets.


@EACH
def test_a_velocity_that_is_reset_has_no_share_in_the_position(family: str) -> None:
    """PX4-Autopilot pull 23644: the rest is right for both, by the same joint Gaussian."""
    make, tolerance = FAMILIES[family]
    f = make(MOTION, [PLACE])
    state = f.start(PRIOR, rng=np.random.default_rng(0))
    for t, _, y in ON_TIME:
        state = f.step(state, t, [[y]])
    before_mean, before_cov = joint(ON_TIME, 5.0)
    state = f.reset(state, [1], [-2.0], [[0.04]])
    m = np.array([before_mean[0], -2.0])
    p = np.diag([before_cov[0, 0], 0.04])
    # The next step, F m and F P Fᵀ + Q, and the observation of its position
    f_half = drift(0.5)
    m = f_half @ m
    p = f_half @ p @ f_half.T + spread(0.5)
    gain = p[:, 0] / (p[0, 0] + 0.16)
    m = m + gain * (3.9 - m[0])
    p = p - np.outer(gain, p[0])
    state = f.step(state, 5.5, [[3.9]])
    after = f.summarize(state)
    std = np.sqrt(np.diag(p))
    mean_error = (after.mean[0] - m) / std
    std_error = np.sqrt(after.variance[0]) / std - 1
    assert np.abs(mean_error).max() < tolerance
    assert np.abs(std_error).max() < tolerance


@EACH
def test_an_observation_of_before_a_reset_does_not_undo_it(family: str) -> None:
    """robot_localization pull 304: the position learns from it, the new velocity does not."""
    make, tolerance = FAMILIES[family]
    f = make(MOTION, [PLACE], lag=4)
    state = f.start(PRIOR, rng=np.random.default_rng(0))
    for t, _, y in ON_TIME:
        state = f.step(state, t, [[y]])
    state = f.reset(state, [1], [-2.0], [[0.04]])
    state = f.step(state, 5.0, [None], delayed=[Observation(3.5, 0, [2.0])])
    # The position of all observations without a reset, and the velocity of the reset
    mean, cov = joint([*ON_TIME, (3.5, 0, 2.0)], 5.0)
    after = f.summarize(state)
    std = np.sqrt([cov[0, 0], 0.04])
    mean_error = (after.mean[0] - [mean[0], -2.0]) / std
    std_error = np.sqrt(after.variance[0]) / std - 1
    assert np.abs(mean_error).max() < tolerance
    assert np.abs(std_error).max() < tolerance
