"""Sensors that are a likelihood: counts, Student's t, noise that depends on the state.

| Project | Report | Here |
|---|---|---|
| own | counts of a Poisson process in particles | posterior of a grid |
| own | Student's t for outliers, with threshold, jitter and lag | posterior of a grid |
| own | noise that grows with the distance | posterior of a grid |
| own | a count beside a Gaussian sensor, sent to a neighbour | weights by hand |
| own | such a sensor in a Kalman filter | refused by name |
| own | the nis of a sensor without moments | unknown (NaN), and its numbers count |
| NAU-CCL/Epymorph 237 | one of two components is missing | weights of the other, or refused |
| mrc-ide/mcstate 75 | the likelihood in place of its logarithm | warned of once |

Posteriors are integrals on a fine grid; weights are products of densities of scipy.
"""

from __future__ import annotations

import warnings
from functools import partial
from typing import Any

import numpy as np
import pytest
from scipy.stats import norm, poisson, t

from distfilt import density, filters, network
from distfilt.filters import Observation, ParticleFilter, TransportFilter
from distfilt.models import LinearModel
from distfilt.network import graphs
from distfilt.sensors import LikelihoodSensor, component, stack

STILL = LinearModel.from_transition(
    1, lambda dt: np.eye(1), lambda t, dt: np.zeros((1, 1))
)
GRID = np.linspace(-8, 8, 4001)


def log_count(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return poisson.logpmf(y[..., 0], np.exp(x[..., 0]))


def count_moments(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return np.exp(x), np.exp(x)[..., None]


def log_student(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    residual = y - x
    return t.logpdf(residual[..., 0], df=3, scale=0.3)


def log_radar(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    scale = 0.2 + 0.3 * np.abs(x[..., 0])
    return norm.logpdf((y - x)[..., 0], scale=scale)


COUNTER = LikelihoodSensor(
    1,
    log_count,
    moments=count_moments,
    sample=lambda x, rng: rng.poisson(np.exp(x)),
    kind="counter",
)
STUDENT = LikelihoodSensor(1, log_student)
RADAR = LikelihoodSensor(1, log_radar)
CASES = {
    "counts": (COUNTER, log_count, [4.0, 6.0, 3.0]),
    "student": (STUDENT, log_student, [1.0, 9.0, 1.2]),
    "radar": (RADAR, log_radar, [1.5, 1.0, 1.8]),
}


def grid_moments(log_density: Any, seen: list[float]) -> tuple[float, float]:
    """Return mean and variance of the posterior with the prior N(1, 1), by a sum on a grid."""
    logs = norm.logpdf(GRID, 1.0, 1.0)
    for y in seen:
        observed = np.full((GRID.size, 1), y)
        logs = logs + log_density(GRID[:, None], observed)
    # p(x | y) ∝ p(x) Π p(y | x), normalised on the grid
    w = np.exp(logs - logs.max())
    w /= w.sum()
    mean = float(w @ GRID)
    variance = float(w @ (GRID - mean) ** 2)
    return mean, variance


FAMILIES = {
    "particle": partial(ParticleFilter, members=20_000),
    "particle, jitter": partial(
        ParticleFilter, members=20_000, jitter=0.05, ess_threshold=0.9
    ),
    "transport": partial(TransportFilter, members=300),
}


@pytest.mark.parametrize("family", FAMILIES)
@pytest.mark.parametrize("case", CASES)
def test_the_posterior_is_that_of_a_grid(family: str, case: str) -> None:
    sensor, log_density, seen = CASES[case]
    f = FAMILIES[family](STILL, [sensor])
    start = f.start(([1.0], [[1.0]]), rng=np.random.default_rng(0))
    run = f.run(start, [1.0, 2.0, 3.0], [np.array(seen)[:, None]])
    mean, variance = grid_moments(log_density, seen)
    # A transport filter has 300 members in place of 20 000.
    slack = 1.0 if family.startswith("particle") else 3.0
    last_mean = run["mean"].values[-1, 0, 0]
    last_variance = run["variance"].values[-1, 0, 0]
    assert abs(last_mean - mean) < 0.03 * slack
    assert abs(last_variance / variance - 1) < 0.1 * slack


@pytest.mark.parametrize("family", FAMILIES)
def test_a_late_count_is_that_of_its_own_time(family: str) -> None:
    """Of a state that doubles, a count of the first time that comes at the second."""
    double = LinearModel.from_transition(
        1, lambda dt: 2 * np.eye(1), lambda t, dt: np.zeros((1, 1))
    )
    f = FAMILIES[family](double, [COUNTER], lag=1)
    state = f.start(([1.0], [[1.0]]), rng=np.random.default_rng(0), t=0.0)
    state = f.step(state, 1.0, [None])
    late = Observation(0.0, 0, [6.0])
    state = f.step(state, 1.0, [None], delayed=[late])
    after = f.summarize(state)
    # The belief about the first time is doubled: twice the mean and four times the variance.
    mean, variance = grid_moments(log_count, [6.0])
    assert abs(after.mean[0, 0] - 2 * mean) < 0.15
    assert abs(after.variance[0, 0] / (4 * variance) - 1) < 0.3


@pytest.mark.parametrize("family", FAMILIES)
def test_the_nis_is_unknown_without_moments_and_its_numbers_count(family: str) -> None:
    """NaN in steps that have such an observation, the Gaussian sensor's where it is alone.

    Two members at -1 and 1 predict 0 ± 1 (transport: a variance of 2, with N - 1), so that an
    observation of 1.5 has r = 1.5 and S = 1 + 0.25.
    """
    position = component([0], std=0.5)
    f = FAMILIES[family](
        STILL,
        [[position, STUDENT], [STUDENT]],
        graphs.path(2),
        members=2,
        record_evidence=True,
    )
    members = np.array([[-1.0], [1.0]])
    start = f.start(members, rng=np.random.default_rng(0))
    pair = [Observation(0.0, 0, [1.5]), Observation(0.0, 0, [0.2], 1)]
    with_likelihoods = [pair, [Observation(0.0, 1, [0.3])]]
    gaussian_only = [pair[:1], None]
    shares = family != "transport"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", filters.ParticleCollapse)
        state = f.step(start, 0.0, with_likelihoods)
        plain = f.step(start, 0.0, gaussian_only)
    # Particle filters share observations, transport filters do not.
    assert state.n_observed.tolist() == ([3, 3] if shares else [2, 1])
    assert np.isnan(state.nis).all()
    assert np.isfinite(state.log_likelihood).all()
    assert plain.n_observed.tolist() == ([1, 1] if shares else [1, 0])
    # r² / S; an agent without an observation has zero.
    variance = 1.0 if shares else 2.0
    expected = 1.5**2 / (variance + 0.25)
    of_neighbour = expected if shares else 0.0
    assert np.allclose(plain.nis, [expected, of_neighbour])
    # A missing observation of such a sensor is none.
    gone = [[pair[0], Observation(0.0, 0, [np.nan], 1)], None]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", filters.ParticleCollapse)
        state = f.step(start, 0.0, gone)
    assert np.allclose(state.nis, plain.nis)
    assert state.n_observed.tolist() == plain.n_observed.tolist()


@pytest.mark.parametrize("family", FAMILIES)
def test_the_nis_of_runs_in_which_different_observations_are_missing(
    family: str,
) -> None:
    f = FAMILIES[family](
        STILL, [[component([0], std=0.5), RADAR]], members=60, record_evidence=True
    )
    y = np.array([[0.1], [0.2], [np.nan]])
    z = np.array([[0.3], [np.nan], [0.4]])
    start = f.start(([0.0], [[1.0]]), rng=np.random.default_rng(0), runs=(3,))
    observed = [Observation(0.0, 0, y), Observation(0.0, 0, z, 1)]
    state = f.step(start, 0.0, [observed])
    # In the second run the likelihood is missing, so that only there the NIS is a number.
    assert state.n_observed[:, 0].tolist() == [2, 1, 1]
    assert np.isnan(state.nis[:, 0]).tolist() == [True, False, True]


def test_weights_are_products_of_densities() -> None:
    """A Gaussian sensor and two counts of one agent, and the neighbour that receives them."""
    x = np.linspace(-1, 3, 9)[:, None]
    position = component([0], std=0.5)
    f = ParticleFilter(
        STILL,
        [[position, COUNTER], None],
        graphs.path(2),
        members=9,
        record_evidence=True,
    )
    observed = [
        [
            Observation(0.0, 0, [0.8]),
            Observation(0.0, 0, [3.0], 1),
            Observation(0.0, 0, [5.0], 1),
        ],
        None,
    ]
    start = f.start(x, rng=np.random.default_rng(0))
    state = f.step(start, 0.0, observed)
    rates = np.exp(x[:, 0])
    counts = poisson.pmf(3, rates) * poisson.pmf(5, rates)
    expected = norm.pdf(0.8, x[:, 0], 0.5) * counts
    assert np.allclose(state.weights, expected / expected.sum(), atol=1e-14)
    # The evidence is the mean of the likelihoods over equally weighted particles.
    assert np.allclose(state.log_likelihood, np.log(expected.mean()), atol=1e-12)
    assert state.n_observed.tolist() == [3, 3]
    assert state.ledger.messages.tolist() == [1, 0]


def test_the_gate_has_the_spread_of_the_rates_and_of_the_counts() -> None:
    """Var y = E rate + Var rate, which is the mean of the variances and the variance of means."""
    x = np.array([[0.0], [1.0], [2.0]])
    # A Poisson count has the variance of its rate.
    rates = np.exp(x[:, 0])
    spread = rates.mean() + rates.var()
    # The chi-squared quantile of 0.95 with one degree is 3.841.
    limit = rates.mean() + np.sqrt(3.841 * spread)
    for y, rejected in ((limit - 0.01, 0), (limit + 0.01, 1)):
        for cls in (ParticleFilter, TransportFilter):
            f = cls(
                STILL,
                [COUNTER.replace(log_likelihood=lambda x, y: 0 * x[..., 0])],
                members=3,
                gate_probability=0.95,
                record_evidence=True,
            )
            start = f.start(x, rng=np.random.default_rng(0))
            after = f.step(start, 0.0, [[y]])
            assert after.rejected.tolist() == [rejected]
            nis = 0.0 if rejected else (y - rates.mean()) ** 2 / spread
            assert np.allclose(after.nis, nis)


def test_runs_that_miss_the_count_keep_their_weights() -> None:
    x = np.linspace(-1, 3, 9)[:, None]
    f = ParticleFilter(STILL, [COUNTER], members=9)
    start = f.start(x, rng=np.random.default_rng(0), runs=(2,))
    state = f.step(start, 0.0, [[[3.0], [np.nan]]])
    # The first run has the weights of the count's density, the second its equal ones.
    w = poisson.pmf(3, np.exp(x[:, 0]))
    assert np.allclose(state.weights[0, 0], w / w.sum())
    assert np.allclose(state.weights[1, 0], 1 / 9)


def test_particles_that_make_a_count_impossible_lose_their_weight() -> None:
    """And a count that all of them make impossible ends the run by name."""

    def log_positive(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return np.where(x[..., 0] > 0, 0.0, -np.inf)

    f = ParticleFilter(STILL, [LikelihoodSensor(1, log_positive)], members=4)
    x = np.array([[-1.0], [1.0], [-2.0], [2.0]])
    start = f.start(x, rng=np.random.default_rng(0))
    state = f.step(start, 0.0, [[1.0]])
    # Positive are the second and the fourth.
    assert np.allclose(state.weights, [[0, 0.5, 0, 0.5]])
    with pytest.raises(filters.FilterError, match="likelihood of zero"):
        f.step(f.start(-abs(x), rng=np.random.default_rng(0)), 0.0, [[1.0]])


@pytest.mark.parametrize(
    "make",
    [
        filters.GaussianFilter,
        partial(filters.GaussianFilter, linearization="unscented"),
        filters.EnsembleFilter,
        partial(filters.MixtureFilter, target_dim=1),
        partial(
            filters.InformationIncrementFilter, target_dim=1, graph=graphs.complete(1)
        ),
    ],
)
def test_families_of_gaussian_noise_refuse_it_by_name(make: Any) -> None:
    with pytest.raises(ValueError, match="sensors must have Gaussian noise in"):
        make(STILL, [COUNTER])
    # Also where it comes with an observation.
    f = make(STILL, [component([0], std=1.0)])
    start = f.start(([0.0], [[1.0]]), rng=np.random.default_rng(0))
    with pytest.raises(ValueError, match="sensors must have Gaussian noise in"):
        f.step(start, 0.0, [[Observation(0.0, 0, [1.0], COUNTER)]])


def test_what_it_cannot_do_is_refused_by_name() -> None:
    with pytest.raises(ValueError, match="moments for a gate"):
        ParticleFilter(STILL, [STUDENT], gate_probability=0.9)
    with pytest.raises(ValueError, match="sensors must have Gaussian noise to be"):
        stack([COUNTER, COUNTER])
    with pytest.raises(ValueError, match="moments must be a function"):
        STUDENT.predict([1.0])
    with pytest.raises(ValueError, match="sample must be a function"):
        STUDENT.observe([1.0], rng=np.random.default_rng(0))
    columns = LikelihoodSensor(1, lambda x, y: y - x)
    with pytest.raises(ValueError, match=r"log_likelihood must return shape \(2,\)"):
        columns.evaluate([[1.0], [2.0]], [1.0])
    lost = LikelihoodSensor(1, lambda x, y: np.sqrt(-1 - x[..., 0] ** 2))
    with (
        np.errstate(invalid="ignore"),
        pytest.raises(ValueError, match="log_likelihood must return numbers"),
    ):
        lost.evaluate([[1.0], [2.0]], [1.0])
    mixed = LikelihoodSensor(1, lambda x, y: (x - x.mean(axis=0))[..., 0])
    with pytest.raises(ValueError, match="log_likelihood must take many states"):
        mixed.evaluate([[1.0], [2.0]], [1.0])


def test_draws_and_predictions_are_its_own() -> None:
    drawn = COUNTER.observe(np.full((20_000, 1), 1.0), rng=np.random.default_rng(0))
    # A Poisson distribution of rate e: standard errors of 0.012 and 0.029
    assert abs(drawn.mean() - np.e) < 0.05
    assert abs(drawn.var() - np.e) < 0.15
    assert np.allclose(COUNTER.predict([[0.0], [1.0]]), [[1.0], [np.e]])


def log_both(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Two components with the deviation 0.5; one that is missing has no share."""
    return norm.logpdf(y, x, 0.5).sum(axis=-1)


def log_either(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return np.nansum(norm.logpdf(y, x, 0.5), axis=-1)


def both_moments(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return x, np.broadcast_to(0.25 * np.eye(2), (*x.shape, 2)).copy()


PLANE = LinearModel.from_transition(
    2, lambda dt: np.eye(2), lambda t, dt: np.zeros((2, 2))
)
WIDE = (np.zeros(2), np.array([[1.0, 0.3], [0.3, 0.8]]))
PARTLY: dict[str, Any] = {
    "particle": partial(ParticleFilter, members=20_000),
    "transport": partial(TransportFilter, members=500),
    "likelihood": partial(
        filters.LikelihoodConsensusFilter,
        members=20_000,
        basis=filters.PolynomialBasis([0, 1]),
        fusion=network.finite_time_consensus,
    ),
    "grid": partial(
        filters.GridFilter, grid=density.Grid((60, 60), low=(-5, -5), high=(5, 5))
    ),
}


@pytest.mark.parametrize("gate", [None, 0.999])
@pytest.mark.parametrize("family", PARTLY)
def test_one_of_two_components_is_missing(family: str, gate: float | None) -> None:
    """As a Gaussian sensor of the second component, of which a neighbour is told too."""
    make = PARTLY[family]
    sensor = LikelihoodSensor(2, log_either, moments=both_moments)
    f = make(
        PLANE,
        [sensor, None],
        graphs.complete(2),
        gate_probability=gate,
        record_evidence=True,
    )
    start = f.start(WIDE, rng=np.random.default_rng(0))
    run = f.run(start, [1.0], [[[np.nan, 1.0]], None])
    # S = .8 + .25, K = [.3, .8] / S; the innovation is 1.
    innovation_var = 0.8 + 0.25
    gain = np.array([0.3, 0.8]) / innovation_var
    mean = run["mean"].values[0]
    # Five hundred members miss moments by some 0.05.
    atol = 0.15 if family == "transport" else 0.03
    assert np.allclose(mean, gain, atol=atol)
    assert np.isclose(run["nis"][0, 0], 1 / innovation_var, atol=atol)
    assert run["n_observed"][0, 0] == 1
    expected = norm.logpdf(1.0, scale=np.sqrt(innovation_var))
    assert np.isclose(run["log_likelihood"][0, 0], expected, atol=0.05)


@pytest.mark.parametrize("family", PARTLY)
def test_a_likelihood_that_does_not_know_missing_numbers(family: str) -> None:
    f = PARTLY[family](PLANE, [LikelihoodSensor(2, log_both)], graphs.complete(1))
    start = f.start(WIDE, rng=np.random.default_rng(0))
    with pytest.raises(
        ValueError, match=r"component of the observation is missing \(NaN\)"
    ):
        f.step(start, 1.0, [[np.nan, 1.0]])


@pytest.mark.parametrize("family", PARTLY)
def test_a_missing_logarithm_is_told_once(family: str) -> None:
    wrong = LikelihoodSensor(2, lambda x, y: np.exp(log_both(x, y)))
    f = PARTLY[family](PLANE, [wrong], graphs.complete(1))
    state = f.start(WIDE, rng=np.random.default_rng(0))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        for t in (1.0, 2.0):
            state = f.step(state, t, [[0.5, 1.0 + 0.1 * t]])
    told = ["log_likelihood must return logarithms" in str(w.message) for w in caught]
    assert sum(told) == 1
    # Logarithms of high densities are positive, but not for all states.
    sharp = LikelihoodSensor(2, lambda x, y: norm.logpdf(y, x, 0.05).sum(axis=-1))
    values = sharp.evaluate(np.random.default_rng(0).normal(size=(500, 2)), [0.0, 0.0])
    assert values.max() > 0
