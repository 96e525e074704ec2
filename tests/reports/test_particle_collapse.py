"""Collapse of particles under a small process noise: alarm, and jitter by default.

| Report | Situation |
|---|---|
| nchopin/particles 32 | a velocity that gets stuck on one value |
| BasisResearch/dynestyx 185 | particles that collapse and do not move any more |
| JuliaPOMDP/ParticleFilters.jl 21 | kernels that separate copies |
| ecosme38/Data-Assimilation-Notebooks 3 | how large the noise after resampling should be |
| rlabbe/Kalman-and-Bayesian-Filters-in-Python 336 | few particles, resampled rarely |
| own | a constant parameter beside a state with noise |
"""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
import pytest

from distfilt.filters import GaussianFilter, ParticleFilter
from distfilt.filters.particle import ParticleState, measure_families
from distfilt.kalman import kalman_filter
from distfilt.models import LinearModel, Model
from distfilt.sensors import Sensor, component
from distfilt.updates.particles import ParticleCollapse

STEPS = 200


def wander(variance: float, constant: bool = False) -> Model:
    """Return a position with a velocity, and noise in both, or not in the velocity."""
    phi = np.array([[1.0, 0.1], [0.0, 1.0]])
    q = variance * np.diag([1.0, 0.0 if constant else 1.0])
    return Model(2, lambda x, t, dt: x @ phi.T, lambda t, dt: q)


def track(
    model: Model, seed: int, **options: Any
) -> tuple[float, float, int, ParticleState]:
    """Return the mean NEES of particles and of a Kalman filter, and the number of alarms."""
    rng = np.random.default_rng(seed)
    # Q is diagonal, so that its root is that of its entries.
    root = np.sqrt(model.Q(0.0, 1.0))
    x = rng.normal(size=2)
    sensors = [component([0], std=0.3)]
    f = ParticleFilter(model, sensors, **options)
    kalman = GaussianFilter(model, sensors)
    prior = (np.zeros(2), np.eye(2))
    state = f.start(prior, rng=np.random.default_rng(seed + 100))
    exact = kalman.start(prior)
    nees = np.zeros((STEPS, 2))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        for k in range(STEPS):
            x = model.step(x, 0.0, 1.0) + root @ rng.normal(size=2)
            y = [[x[0] + 0.3 * rng.normal()]]
            state = f.step(state, k + 1.0, y)
            exact = kalman.step(exact, k + 1.0, y)
            summaries = (f.summarize(state), kalman.summarize(exact))
            for column, summary in enumerate(summaries):
                assert summary.covariance is not None
                # eᵀ P⁻¹ e for each of the two components
                error = summary.mean[0] - x
                solved = np.linalg.solve(summary.covariance[0], error)
                nees[k, column] = error @ solved / 2
    alarms = sum(issubclass(w.category, ParticleCollapse) for w in caught)
    by_particles, by_kalman = nees.mean(axis=0)
    return float(by_particles), float(by_kalman), alarms, state


@pytest.mark.parametrize(("constant", "seed"), [(False, 3), (True, 0)])
def test_a_collapse_under_small_noise_is_seen(constant: bool, seed: int) -> None:
    """All particles differ and have weight, yet few ancestors are left."""
    model = wander(1e-6, constant)
    nees, exact, alarms, state = track(model, seed, members=2000, jitter=0.0)
    assert nees > 50 * exact
    assert alarms > 0
    distinct = np.unique(state.particles[0, :, 0]).size
    assert distinct == 2000


@pytest.mark.parametrize("constant", [False, True])
@pytest.mark.parametrize("seed", range(3))
def test_the_default_jitter_follows(seed: int, constant: bool) -> None:
    """It separates copies that the noise cannot: errors as of a Kalman filter, no alarm."""
    model = wander(1e-6, constant)
    nees, exact, alarms, _ = track(model, seed, members=2000)
    assert nees < 1.2 * exact
    assert alarms == 0


def test_jitter_finds_back_from_a_prior_that_hardly_reaches() -> None:
    """The truth is among a few particles only; the error shrinks by a factor of thousands."""
    model = wander(1e-6)
    without, *_ = track(model, 3, members=2000, jitter=0.0)
    nees, _, alarms, _ = track(model, 3, members=2000)
    assert nees < 1e-3 * without
    # What cannot be repaired at once is still said.
    assert alarms > 0


@pytest.mark.parametrize("seed", range(3))
def test_a_healthy_filter_is_not_disturbed(seed: int) -> None:
    """With noise that separates copies: no alarm, and the numbers without jitter."""
    model = wander(1e-2)
    by_default = track(model, seed, members=2000)
    without = track(model, seed, members=2000, jitter=0.0)
    assert by_default[2] == without[2] == 0
    assert np.array_equal(by_default[3].particles, without[3].particles)
    assert by_default[0] < 1.3 * by_default[1]


@pytest.mark.filterwarnings("ignore::distfilt.filters.ParticleCollapse")
def test_jitter_does_not_disturb_where_the_noise_is_large() -> None:
    """A random walk, resampled at every step: the error of the mean from that of a Kalman filter.

    One component of three is not seen alone, so that few ancestors are left in some steps.
    """
    runs, steps = 40, 50
    q = np.array([[0.3, 0.1, 0.0], [0.1, 0.2, 0.05], [0.0, 0.05, 0.4]])
    r = np.array([[0.5, 0.2], [0.2, 0.4]])
    h = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 1.0]])
    model = LinearModel.from_transition(3, lambda dt: np.eye(3), lambda t, dt: dt * q)
    sensor = Sensor(2, lambda x: x @ h.T, r, linear=lambda d: h)
    rng = np.random.default_rng(5)
    increments = rng.multivariate_normal(np.zeros(3), q, (steps, runs))
    truth = increments.cumsum(axis=0)
    noise = rng.multivariate_normal(np.zeros(2), r, (steps, runs))
    seen = truth @ h.T + noise
    exact = kalman_filter(np.zeros(3), np.eye(3), seen, F=np.eye(3), H=h, Q=q, R=r)
    variance = np.diagonal(exact.covariances, axis1=-2, axis2=-1)
    times = np.arange(1.0, steps + 1)

    def measure_error(jitter: float | None) -> float:
        f = ParticleFilter(
            model, [sensor], members=1000, ess_threshold=1.0, jitter=jitter
        )
        rng = np.random.default_rng(1)
        state = f.start((np.zeros(3), np.eye(3)), runs=(runs,), rng=rng)
        means = []
        for after in f.steps(state, times, [seen]):
            # Σ w x of each run, as a product of a row and a matrix
            mean = after.weights[:, 0, None, :] @ after.particles[:, 0]
            means.append(mean[:, 0])
        error = np.stack(means) - exact.means
        relative_square = error**2 / variance
        return float(np.sqrt(relative_square.mean()))

    assert measure_error(None) < 1.1 * measure_error(0.0) < 0.3


def test_a_collapse_is_said_once_in_a_run() -> None:
    """Two hundred steps of a collapse are one warning, not two hundred."""
    *_, alarms, _ = track(wander(1e-6), 3, members=2000, jitter=0.0)
    assert alarms == 1


def test_what_families_are_worth() -> None:
    """Four narrow families of unequal weight, by the variance of a weighted mean."""
    rng = np.random.default_rng(0)
    centres = rng.normal(size=(4, 1))
    x = np.repeat(centres, 25, axis=0)
    mass = np.array([0.4, 0.3, 0.2, 0.1])
    weights = np.repeat(mass / 25, 25)
    ancestors = np.repeat([3, 7, 50, 51], 25)
    arrays = (x[None], weights[None], ancestors[None], np.array([True]))
    sizes, shares = measure_families(*arrays)
    # Var Σ W_j c_j = σ² Σ W_j² is that of 1 / Σ W_j² equal families.
    squares = mass**2
    assert sizes[0] == pytest.approx(1 / squares.sum())
    assert shares[0] == pytest.approx(0.0, abs=1e-12)
    # Members that are spread like all particles are not worth less for their ancestors.
    spread = rng.normal(size=(1, 100, 1))
    sizes, shares = measure_families(spread, *arrays[1:])
    assert sizes[0] > 20
    assert shares[0] > 0.8


def test_a_state_keeps_its_ancestors(tmp_path: Any) -> None:
    """Saved and loaded, and continued to the bit."""
    model = wander(1e-6)
    *_, state = track(model, 1, members=300)
    path = tmp_path / "state.npz"
    state.save(path)
    loaded = ParticleState.load(path)
    assert np.array_equal(loaded.ancestors, state.ancestors)
    f = ParticleFilter(model, [component([0], std=0.3)], members=300)
    after = [f.step(s, state.t + 1.0, [None]) for s in (state, loaded)]
    assert np.array_equal(after[0].particles, after[1].particles)


def test_few_ancestors_of_a_run_that_has_failed_are_no_alarm() -> None:
    """Control: the same particles warn in a run that has not failed."""
    f = ParticleFilter(
        wander(1e-6, constant=True),
        [component([0], std=0.3)],
        members=200,
        on_error="keep",
    )
    prior = (np.zeros(2), np.eye(2))
    start = f.start(prior, rng=np.random.default_rng(0), runs=(2,))
    ancestors = np.tile(np.arange(200), (2, 1, 1))
    particles_ = start.particles.copy()
    log_weights = start.log_weights.copy()
    # In the second run all particles have one of two ancestors, and fifty have all the weight.
    ancestors[1] = np.repeat([0, 100], 100)
    particles_[1] = np.repeat([[0.0, 0.0], [1.0, 1.0]], 100, axis=0)
    particles_[1] += 1e-6 * np.arange(200)[:, None]
    log_weights[1] = -1e300
    log_weights[1, :, ::4] = -np.log(50)
    state = start.replace(
        particles=particles_, log_weights=log_weights, ancestors=ancestors
    )
    with pytest.warns(ParticleCollapse, match="descend from few"):
        f.step(state, 1.0, [None])
    failed = state.replace(failed=np.array([False, True]))
    with warnings.catch_warnings(action="error"):
        f.step(failed, 1.0, [None])
