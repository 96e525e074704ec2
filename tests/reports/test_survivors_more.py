"""More wrong results that the tests once let pass, each with the value that tells it apart.

All of them are of our own making (source: own): a term that vanished in every case tested, and
options that were tested only where they make no difference.
"""

from __future__ import annotations

import warnings

import numpy as np
from scipy.stats import norm

from distfilt.filters import EnsembleFilter, GaussianFilter, Observation
from distfilt.models import InputModel, Inputs, Model
from distfilt.sensors import LikelihoodSensor, Sensor, component, wrap

CORRELATED = np.array([[4.0, 1.8], [1.8, 1.0]])


def still(d: int) -> Model:
    return Model(d, lambda x, t, dt: x, lambda t, dt: np.zeros((d, d)))


def assert_covariance(x: np.ndarray, cov: np.ndarray) -> None:
    """Within four standard errors: Var S_ij = (C_ii C_jj + C_ij²) / N for N Gaussian draws."""
    variances = np.diagonal(cov)
    products = np.outer(variances, variances)
    error = np.sqrt((products + cov**2) / len(x))
    assert (np.abs(np.cov(x.T) - cov) < 4 * error).all()


def test_a_wide_belief_that_turns_by_half_a_period_stays_whole() -> None:
    """Members of a wrapped model are those of the unwrapped one, up to one shift by whole turns."""

    # Displacements 3.1 + 0.3 sin x, of which some are below half a period and some above.
    def run_on(x: np.ndarray) -> np.ndarray:
        return x + 3.1 + 0.3 * np.sin(x)

    model = Model(
        1,
        lambda x, t, dt: wrap(run_on(x)),
        lambda t, dt: np.zeros((1, 1)),
        periods=(2 * np.pi,),
    )
    x = np.linspace(-2.5, 2.5, 41)[:, None]
    f = EnsembleFilter(model, [component([0], std=1.0)], members=41)
    start = f.start(x, rng=np.random.default_rng(0))
    after = f.step(start, 1.0, [None]).belief[0]
    turns = (after - run_on(x)) / (2 * np.pi)
    assert np.allclose(turns, np.round(turns[0]), atol=1e-9)


def test_differences_that_err_by_less_than_the_noise_give_no_warning() -> None:
    """Jumps of ±0.2 spoil an observation with a deviation of 0.1, and not one with 100."""

    def noisy(x: np.ndarray) -> np.ndarray:
        return x[..., :1] + 0.2 * np.sin(1e13 * x[..., :1])

    # A slope's error E changes the prediction by E σ, of some units: above 0.1 √R = 0.01, below 10.
    for std, is_warned in ((0.1, True), (100.0, False)):
        sensor = Sensor(1, noisy, [[std**2]])
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            sensor.jacobian([1.0], std=[0.1])
        texts = [str(w.message) for w in caught]
        assert [t.startswith("h has no usable differences") for t in texts] == (
            [True] if is_warned else []
        )


def test_equal_values_of_two_sensors_with_other_noise_both_count() -> None:
    """The posterior is the product: 1/P = 1/P₀ + 1/R₁ + 1/R₂ and m = P y (1/R₁ + 1/R₂)."""
    f = GaussianFilter(still(1), [component([0], std=1.0)])
    start = f.start(([0.0], [[2.0]]))
    entries = [
        Observation(1.0, 0, [0.5], component([0], std=std)) for std in (1.0, 0.5)
    ]
    after = f.step(start, 1.0, [entries])
    precision = 1 / 2.0 + 1 / 1.0 + 1 / 0.25
    assert np.isclose(after.covariances[0, 0, 0], 1 / precision, rtol=1e-9)
    assert np.isclose(after.means[0, 0], 0.5 * 5.0 / precision, rtol=1e-9)


def test_members_are_reset_with_a_correlated_covariance() -> None:
    """Their new values are N(value, C), and not of LᵀL, where C = LLᵀ."""
    f = EnsembleFilter(still(3), [component([0], std=1.0)], members=20_000)
    start = f.start((np.zeros(3), np.eye(3)), rng=np.random.default_rng(0))
    x = f.reset(start, [1, 2], [5.0, -3.0], CORRELATED).belief[0]
    assert_covariance(x[:, 1:], CORRELATED)
    error = np.sqrt(np.diagonal(CORRELATED) / len(x))
    difference = x[:, 1:].mean(axis=0) - [5.0, -3.0]
    assert (np.abs(difference) < 4 * error).all()


def test_a_scalar_distribution_is_a_prior_with_its_variance() -> None:
    """N(1, 3²) of scipy has the mean 1 and the variance 9."""
    f = GaussianFilter(still(1), [component([0], std=1.0)])
    state = f.start(norm(1.0, 3.0))
    assert np.allclose(state.means, 1.0)
    assert np.allclose(state.covariances, 9.0)


def test_a_likelihood_is_asked_for_observations_with_one_component() -> None:
    """Of two components one is missing: log p is that of the other; zero if both are missing."""

    def log_normal(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        # Σ_k -(y_k - x_k)²/2 - log(2π)/2 over the components that are there.
        terms = -0.5 * (y - x) ** 2 - 0.5 * np.log(2 * np.pi)
        return np.nansum(terms, axis=-1)

    sensor = LikelihoodSensor(2, log_normal)
    observed = [
        [1.0, 2.0],
        [np.nan, 2.0],
        [1.0, np.nan],
        [np.nan, np.nan],
    ]
    logs = sensor.evaluate(np.tile([0.5, -1.0], (4, 1)), observed)
    first = norm.logpdf(1.0, 0.5)
    second = norm.logpdf(2.0, -1.0)
    assert np.allclose(logs, [first + second, second, first, 0.0])


def test_draws_of_correlated_inputs_have_the_covariance_of_the_step() -> None:
    """x + dt u with u ~ N(ū, Σ) has the covariance dt² Σ, in draws as in `noise_at`."""
    inputs = Inputs([0.0], [[1.0, -2.0]], CORRELATED)
    model = InputModel.from_inputs(2, lambda x, u, dt: x + dt * u, inputs)
    assert np.allclose(model.noise_at([0.0, 0.0], 0.0, 0.5), 0.25 * CORRELATED)
    x = model.sample_step(np.zeros((20_000, 2)), 0.0, 0.5, rng=np.random.default_rng(0))
    assert_covariance(x, 0.25 * CORRELATED)
