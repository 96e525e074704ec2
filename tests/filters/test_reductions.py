"""Filters that have to be another filter: without links, with one component, by a linear sensor.

Each case has missing numbers, several sensors of an agent and the options of both filters.
Source: own.
"""

from __future__ import annotations

import warnings
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest
from scipy.stats import multivariate_normal, norm

from distfilt import filters, network
from distfilt.density import Grid
from distfilt.filters import Observation
from distfilt.models import LinearModel, Model
from distfilt.network import graphs
from distfilt.sensors import LikelihoodSensor, Sensor, component, increment, wrap
from distfilt.updates import etkf

from .problems import (
    ALL,
    APART,
    AVERAGE,
    CASES,
    TIMES,
    Case,
    Problem,
    assert_equal,
    change_sensors,
    make_problem,
    record,
)

Array = np.ndarray
UNSCENTED = {"linearization": "unscented", "kappa": 2.3}
LINEARIZATIONS: list[dict[str, Any]] = [{}, UNSCENTED]
Q = np.array([[0.5, 0.2], [0.2, 0.4]])


def with_one_prior(problem: Problem) -> Problem:
    return replace(problem, priors=[problem.priors[1]] * 4)


@pytest.mark.parametrize("runs", [0, 2])
@pytest.mark.parametrize("options", LINEARIZATIONS)
@pytest.mark.parametrize(
    "name", ["sum", "channel", "weighted", "hybrid", "measurements"]
)
def test_one_gaussian_without_links_is_the_gaussian_filter(
    name: str, options: dict[str, Any], runs: int
) -> None:
    options = options | ALL | {"inflation": 1.07}
    problem = with_one_prior(make_problem(runs=runs, graph=APART))
    unshared = options | {"share_observations": False}
    expected = record(Case(filters.GaussianFilter, unshared), problem, runs=runs)
    if name == "sum":
        case = Case(filters.GaussianSumFilter, unshared)
    elif name == "channel":
        case = Case(filters.ChannelFilter, options, prior="one")
    else:
        consensus = {"fusion": AVERAGE, "average": name}
        case = Case(filters.InformationConsensusFilter, options | consensus)
    assert_equal(record(case, problem, runs=runs), expected)
    assert expected["rejected"].sum() > 0


@pytest.mark.parametrize("make", [filters.GaussianFilter, filters.GaussianSumFilter])
def test_sigma_points_of_a_linear_function_are_its_matrix(make: Any) -> None:
    """For any kappa; the sensors and the model are linear, but do not say so."""
    phi = np.array([[1.0, 0.3, 0.1], [-0.2, 0.9, 0.0], [0.1, 0.4, 1.0]])
    h = np.array([[1.0, 0.5, -0.3], [0.2, -1.0, 0.4]])

    def straighten(sensor: Sensor) -> Sensor:
        rows = h[: sensor.dim]
        return Sensor(sensor.dim, lambda x: x @ rows.T, sensor.noise_cov)

    problem = make_problem()
    model = Model(3, lambda x, t, dt: x + dt * x @ phi.T, problem.model.noise_cov)
    problem = replace(
        problem,
        model=model,
        sensors=change_sensors(problem.sensors, straighten),
    )
    # Derivatives by differences in the extended filter are exact to seven digits.
    common = ALL | {"inflation": 1.02}
    unscented = record(Case(make, UNSCENTED | common), problem)
    extended = record(Case(make, {"linearization": "extended"} | common), problem)
    assert_equal(unscented, extended, atol=1e-6)


@pytest.mark.parametrize("weight", [None, 1.5])
@pytest.mark.parametrize("average", ["hybrid", "measurements"])
def test_a_weight_of_measurements_divides_their_noise(
    average: str, weight: Any
) -> None:
    """With exact averages each has the weight ω / A, by default one."""
    problem = with_one_prior(make_problem(graph=graphs.complete(4)))
    options = {
        "fusion": network.finite_time_consensus,
        "average": average,
        "weight": weight,
    }
    case = Case(filters.InformationConsensusFilter, options)
    share = 1.0 if weight is None else weight / 4

    def divide(sensor: Sensor) -> Sensor:
        return replace(sensor, noise_cov=sensor.noise_cov / share)

    # One step, after which the extended filters' points of linearization are equal.
    events = [e for e in problem.events if e.t == TIMES[0]]
    first = replace(problem, events=events)
    divided = replace(first, sensors=change_sensors(problem.sensors, divide))
    central = record(Case(filters.GaussianFilter, {}), divided)
    result = record(case, first)
    assert_equal(result.isel(time=[0]), central.isel(time=[0]))


def test_equal_values_of_two_agents_both_count() -> None:
    """Also in a step that is asked for its observations twice."""
    still = Model(1, lambda x, t, dt: x, lambda t, dt: np.zeros((1, 1)))
    team = [component([0], std=1.0)] * 2
    f = filters.GaussianFilter(still, team, graphs.path(2), lag=1)
    start = f.start(([0.0], [[2.0]]))
    of_both = [[Observation(1.0, 0, [0.5])], [Observation(1.0, 1, [0.5])]]
    state = f.step(start, 1.0, of_both)
    state = f.step(state, 1.0, [[], [Observation(1.0, 1, [0.7])]])
    state = f.step(state, 1.0, [[Observation(1.0, 0, [0.7])], []])
    # Four observations of both agents, with a variance of 1: 1/P = 1/P₀ + 4 and m = P Σ y
    precision = 1 / 2 + 4
    total = 0.5 + 0.5 + 0.7 + 0.7
    assert np.allclose(state.covariances, 1 / precision)
    assert np.allclose(state.means, total / precision)


def bend(x: Array) -> Array:
    return np.stack([x[..., 1] ** 2, x[..., 0] - x[..., 2]], axis=-1)


RESET_COV = np.array([[0.5, 0.2], [0.2, 0.3]])


def test_a_reset_has_the_slope_at_each_agent() -> None:
    """T P Tᵀ + C, where the rows of T are the value's slope at the agent's own mean."""
    problem = make_problem(runs=2)
    f = filters.GaussianFilter(
        problem.model, problem.sensors, problem.graph, share_observations=False, lag=1
    )
    start = f.start(problem.priors, runs=(2,))
    *_, state = f.steps(start, TIMES, problem.events)
    new = f.reset(state, [0, 2], bend, RESET_COV, agents=[3, 0])
    for run, agent in np.ndindex(2, 4):
        mean = state.means[run, agent]
        joint = state.joint_covariances[run, agent]
        if agent in (0, 3):
            # The present's block comes first; the earlier state keeps its own.
            matrix = np.eye(6)
            matrix[0, :3] = [0.0, 2 * mean[1], 0.0]
            matrix[2, :3] = [1.0, 0.0, -1.0]
            joint = matrix @ joint @ matrix.T
            joint[np.ix_([0, 2], [0, 2])] += RESET_COV
            mean = np.array([mean[1] ** 2, mean[1], mean[0] - mean[2]])
        assert np.allclose(new.means[run, agent], mean, atol=1e-9)
        assert np.allclose(new.joint_covariances[run, agent], joint, atol=1e-7)


def test_members_that_are_reset_draw_for_their_own_agent() -> None:
    """The draws of an agent are its own, and the same if others are reset too."""
    problem = make_problem()
    f = filters.EnsembleFilter(
        problem.model, problem.sensors, problem.graph, members=50, fusion=None
    )
    start = f.start(problem.priors, rng=np.random.default_rng(0))
    everybody = f.reset(start, [0, 2], bend, RESET_COV).ensembles
    two_agents = f.reset(start, [0, 2], bend, RESET_COV, agents=[3, 1]).ensembles
    assert np.array_equal(two_agents[[1, 3]], everybody[[1, 3]])
    assert np.array_equal(two_agents[[0, 2]], start.ensembles[[0, 2]])
    # The component between the two that are reset stays, and no two agents draw alike.
    noise = everybody[..., [0, 2]] - bend(start.ensembles)
    assert np.array_equal(everybody[..., 1], start.ensembles[..., 1])
    for a, b in ((0, 1), (1, 3), (2, 3)):
        assert np.abs(noise[a] - noise[b]).max() > 0.1


GRID = Grid((60, 56), low=-6.0, high=6.0)


def drifting_model() -> LinearModel:
    """A model whose matrix and noise change a lot from the begin to the end of a step."""

    def transition(t: float, dt: float) -> Array:
        return np.eye(2) + dt * np.array([[-0.3, 0.8 + t], [-0.2 * t, -0.1]])

    def noise(t: float, dt: float) -> Array:
        return dt * (0.5 + 2 * t) * Q

    return LinearModel.from_transition(2, transition, noise)


@pytest.mark.parametrize("options", [{}, {"fused": "likelihoods"}])
def test_the_grid_of_a_linear_problem_is_the_kalman_filter(
    options: dict[str, Any],
) -> None:
    """Of all observations, whether they are sent or their likelihoods are averaged."""
    h = np.array([[1.0, 0.5], [0.0, 2.0]])
    r = [[0.5, 0.3], [0.3, 0.9]]
    cross = Sensor(2, lambda x: x @ h.T, r, linear=lambda d: h)
    team = [cross, component([1], std=0.7), None]
    times = [0.4, 0.9, 1.3]
    series: list[Any] = [
        np.array([[0.5, np.nan], [0.2, -0.4], [np.nan, np.nan]]),
        np.array([[0.4], [np.nan], [-0.3]]),
        None,
    ]
    prior = ([0.3, -0.2], [[0.6, 0.2], [0.2, 0.5]])
    net = graphs.complete(3)
    if options:
        extra = {
            "fusion": network.finite_time_consensus,
            "share_observations": False,
        }
        f = filters.GridFilter(
            drifting_model(), team, net, grid=GRID, **extra, **options
        )
    else:
        f = filters.GridFilter(drifting_model(), team, net, grid=GRID)
    g = filters.GaussianFilter(drifting_model(), team, net)
    a = f.run(f.start(prior), times, series)
    b = g.run(g.start(prior), times, series)
    # A cell of 0.2 adds Δ²/12 = 0.003 to the variance.
    assert np.allclose(a["mean"], b["mean"], atol=0.01)
    assert np.allclose(a["covariance"], b["covariance"], atol=0.02)


def test_a_belief_in_one_cell_is_as_wide_as_the_cell() -> None:
    f = filters.GridFilter(
        Model(1, lambda x, t, dt: x, lambda t, dt: np.zeros((1, 1))),
        [component([0], std=1e-3)],
        grid=Grid((40,), low=-2.0, high=2.0),
    )
    state = f.step(f.start(([0.0], [[1.0]])), 0.0, [[0.25]])
    # Cells of 0.1: the variance of a uniform density is Δ² / 12.
    assert np.allclose(f.summarize(state).variance, 0.1**2 / 12)


FAMILIES: dict[str, Any] = {
    "ensemble": partial(
        filters.EnsembleFilter,
        members=40,
        update=partial(etkf, rotation="none"),
        fusion=None,
    ),
    "particle": partial(filters.ParticleFilter, members=300, ess_threshold=0.0),
}


@pytest.mark.parametrize("name", FAMILIES)
def test_each_run_measures_changes_from_its_last_observation(name: str) -> None:
    """Where a number of one run is missing, its next change is from before that."""
    team = [
        increment([0, 1], std=0.4),
        [increment([1], std=0.3), component([2], std=0.5)],
        None,
        component([0], std=0.6),
    ]
    problem = make_problem(noise=False)
    rng = np.random.default_rng(7)
    events = []
    for t in TIMES:
        for agent, number, size in ((0, 0, 2), (1, 0, 1), (1, 1, 1), (3, 0, 1)):
            value = 0.3 * rng.standard_normal((2, size))
            is_missing = rng.random(value.shape) < 0.4
            value[is_missing] = np.nan
            events.append(Observation(t, agent, value, number))
    f = FAMILIES[name](problem.model, team, problem.graph)
    prior = list(problem.members[:, : f.members])

    def run(observations: list[Observation], runs: tuple[int, ...]) -> Any:
        start = f.start(prior, rng=np.random.default_rng(0), runs=runs)
        return f.run(start, TIMES, observations)

    batch = run(events, (2,))
    for k in range(2):
        of_run = [replace(e, value=e.value[k]) for e in events]
        single = run(of_run, ())
        assert_equal(batch.isel(run=k), single)


def plain_etkf(x: Array, h: Array, y: Array, noise: Array, *, rng: Any) -> Array:
    """Update one ensemble, without the decorator of updates for stacks."""
    return etkf(x, h, y, noise, rng=rng, rotation="none")


UNLIKE = {
    **FAMILIES,
    "plain": partial(FAMILIES["ensemble"], update=plain_etkf),
    "gaussian": filters.GaussianFilter,
    "sum": filters.GaussianSumFilter,
    "grid": partial(filters.GridFilter, grid=Grid((42, 44), low=-5.0, high=7.0)),
}


@pytest.mark.parametrize("name", UNLIKE)
def test_noise_of_equal_variances_is_still_each_agent_s_own(name: str) -> None:
    """Sensors that differ in the sign of a correlation alone, with and without a missing number."""
    d = 2 if name == "grid" else 3
    problem = make_problem(d, noise=d == 2)
    noises = [[[0.5, c], [c, 0.4]] for c in (0.3, -0.3, 0.0)]
    team = [Sensor(2, lambda x: x[..., :2], noise) for noise in noises]
    y = np.array([[0.3, 1.5], [0.4, -1.0], [1.1, 0.2]])
    series = [np.stack([y[k], [0.7, np.nan]]) for k in range(3)]
    f = UNLIKE[name](problem.model, team, share_observations=False)
    prior: Any = problem.priors[0]
    if hasattr(f, "members"):
        prior = problem.members[0, : f.members]

    def run(one: Any, observations: Any) -> Any:
        start = one.start(prior, rng=np.random.default_rng(0))
        return one.run(start, TIMES[:2], observations)

    together = run(f, series)
    for k in range(3):
        alone = UNLIKE[name](problem.model, [team[k]])
        single = run(alone, [series[k]])
        assert_equal(together.isel(agent=[k]), single)
    assert not np.allclose(together["mean"][0, 0], together["mean"][0, 1])


def as_likelihood(sensor: Sensor) -> Sensor:
    """Give a sensor's density as a function, with the moments of its observations."""
    noise = sensor.noise_cov

    def log_likelihood(x: Array, y: Array) -> Array:
        # log N(y; h(x), R) = -½ (rᵀ R⁻¹ r + log |2 π R|) of the numbers that are there
        missing = np.isnan(y)
        residual = np.where(missing, 0.0, y - sensor.h(x))
        # Missing ones have a variance of 1 / (2 π) of their own, of which nothing depends.
        is_pair = ~missing[..., :, None] & ~missing[..., None, :]
        cov = np.where(is_pair, noise, np.eye(sensor.dim) / (2 * np.pi))
        solved = np.linalg.solve(cov, residual[..., None])[..., 0]
        log_volume = np.linalg.slogdet(2 * np.pi * cov)[1]
        return -0.5 * ((residual * solved).sum(axis=-1) + log_volume)

    def moments(x: Array) -> tuple[Array, Array]:
        mean = sensor.h(x)
        return mean, np.broadcast_to(noise, (*mean.shape, sensor.dim))

    return LikelihoodSensor(sensor.dim, log_likelihood, moments=moments)


def straighten(sensor: Sensor, d: int) -> Sensor:
    """Return the linear sensor with the derivative at zero."""
    H = sensor.jacobian(np.zeros(d))
    return Sensor(sensor.dim, lambda x: x @ H.T, sensor.noise_cov)


@pytest.mark.parametrize("has_gaps", [False, True])
@pytest.mark.parametrize(
    "name", ["particle", "transport", "grid", "likelihood consensus"]
)
def test_a_density_as_a_function_is_the_sensor_with_its_noise(
    name: str, has_gaps: bool
) -> None:
    """Also of several sensors of an agent; its gate and its NIS have the moments."""
    case = CASES[name]
    problem = make_problem(case.d, noise=case.noise, graph=case.graph)
    if not has_gaps:
        present = [e for e in problem.events if not np.isnan(e.value).any()]
        problem = replace(problem, events=present)
    if name == "likelihood consensus":
        # It approximates predictions of one, densities of the other, both exactly if linear.
        team = change_sensors(problem.sensors, partial(straighten, d=case.d))
        problem = replace(problem, sensors=team)
    other = replace(problem, sensors=change_sensors(problem.sensors, as_likelihood))
    a = record(case, problem)
    b = record(case, other)
    if name == "transport":
        # Its evidence has no constants of Gaussian sensors.
        assert_equal(a, b, ("mean", "variance"))
        return
    assert_equal(a, b, ("mean", "variance", "rejected", "log_likelihood"))
    # The first agent has one number, so that no correlation of two sensors counts.
    if name == "likelihood consensus":
        assert_equal(a.isel(agent=[0]), b.isel(agent=[0]), ("nis",))


def test_a_gate_counts_the_numbers_that_are_there() -> None:
    """Of two numbers one is missing: χ² has one degree of freedom, also for mixtures."""
    still = Model(2, lambda x, t, dt: x, lambda t, dt: np.zeros((2, 2)))
    team = [component([0, 1], std=1.0)] * 2
    # S = P + R = 2, and 6.63 is the 0.99 quantile of χ² with one degree.
    edge = np.sqrt(2 * 6.634896601021213)
    for make in (
        filters.GaussianFilter,
        filters.GaussianSumFilter,
        partial(filters.MixtureFilter, target_dim=2),
    ):
        f = make(still, team, graphs.path(2), gate_probability=0.99)
        if not isinstance(f, filters.MixtureFilter):
            f = f.replace(share_observations=False)
        start = f.start(([0.0, 0.0], np.eye(2)))
        for factor, rejected in ((0.999, 0), (1.001, 1)):
            # Of a second agent both numbers are there.
            state = f.step(start, 0.0, [[factor * edge, np.nan], [0.1, -0.2]])
            assert np.asarray(state.rejected).tolist() == [rejected, 0]


def test_inflation_widens_the_present_and_its_correlation_with_the_past() -> None:
    """A state at rest has the joint covariance D (1 ⊗ P) D with D = diag(s, 1)."""
    still = Model(3, lambda x, t, dt: x, lambda t, dt: np.zeros((3, 3)))
    f = filters.GaussianFilter(still, [None], lag=1, inflation=1.3)
    cov = np.array([[1.0, 0.4, 0.1], [0.4, 2.0, -0.3], [0.1, -0.3, 0.5]])
    state = f.step(f.start((np.zeros(3), cov)), 1.0, [None])
    scale = np.array([1.3, 1.0])
    expected = np.kron(np.outer(scale, scale), cov)
    assert np.allclose(state.joint_covariances[0], expected, atol=1e-12)


def test_the_functions_of_a_polynomial_basis() -> None:
    """z = (x - c) / s of the components 2 and 0: z₀, z₀², z₂, z₂ z₀ and z₂² in some order."""
    basis = filters.PolynomialBasis(
        [2, 0], degree=2, centre=np.array([1.0, -2.0]), scale=np.array([2.0, 0.5])
    )
    x = np.array([[3.0, 7.0, 5.0], [-1.0, 8.0, 0.0]])
    first = (x[:, 2] - 1.0) / 2.0
    second = (x[:, 0] + 2.0) / 0.5
    expected = [second, second**2, first, first * second, first**2]
    assert np.allclose(basis(x), np.stack(expected, axis=-1))


def test_a_reset_forgets_the_rejections_of_its_agents_alone() -> None:
    still = Model(1, lambda x, t, dt: x, lambda t, dt: np.zeros((1, 1)))
    team = [component([0], std=1.0) for _ in range(3)]
    f = filters.GaussianFilter(
        still, team, gate_probability=0.99, share_observations=False
    )
    state = f.start(([0.0], [[1.0]]), runs=(2,))
    for t in (1.0, 2.0):
        # The first agent's observation is far off in the first run, the others' in both.
        far = [50.0 + t]
        of_first = [far, [0.0]]
        of_others = [far, far]
        state = f.step(state, t, [of_first, of_others, of_others])
    before = state.rejection_streaks
    assert before is not None
    assert before.sum(axis=(-2, -1)).tolist() == [[2.0, 2.0, 2.0], [0.0, 2.0, 2.0]]
    after = f.reset(state, [0], [0.0], [[1.0]], agents=[2]).rejection_streaks
    assert after is not None
    assert after.sum(axis=(-2, -1)).tolist() == [[2.0, 2.0, 0.0], [0.0, 2.0, 0.0]]


@pytest.mark.parametrize("make", [filters.GaussianFilter, "ensemble"])
def test_scores_of_a_late_and_a_present_observation_add_up(make: Any) -> None:
    """Together they have the density of their joint Gaussian, and both are counted."""
    still = Model(1, lambda x, t, dt: x, lambda t, dt: np.zeros((1, 1)))
    team = [component([0], std=0.5)]
    prior: Any = ([0.0], [[2.0]])
    if make == "ensemble":
        make = partial(filters.EnsembleFilter.exact, members=20)
        # Ten members at each of ±a have the sample variance 20 a² / 19, here the prior's 2.
        a = np.sqrt(2 * 19 / 20)
        prior = np.repeat([-a, a], 10)[:, None]
    late = Observation(1.0, 0, [-0.4])

    def step(y: float, delayed: Observation, **options: Any) -> Any:
        f = make(still, team, lag=1, **options)
        start = f.start(prior, rng=np.random.default_rng(0))
        before = f.step(start, 1.0, [None])
        return f.step(before, 2.0, [[y]], delayed=[delayed])

    state = step(1.3, late, record_evidence=True)
    # One state of variance 2 at rest, observed twice with independent errors of variance 0.25
    joint = np.full((2, 2), 2.0) + 0.25 * np.eye(2)
    values = np.array([-0.4, 1.3])
    expected = multivariate_normal(np.zeros(2), joint).logpdf(values)
    assert np.allclose(state.log_likelihood, expected)
    # yᵀ S⁻¹ y, as the predicted mean is zero
    nis = values @ np.linalg.solve(joint, values)
    assert np.allclose(state.nis, nis)
    assert np.array_equal(state.n_observed, [2])
    # Rejected are the late one and the present one, or the late one alone.
    far = replace(late, value=np.array([60.0]))
    both_far = step(50.0, far, gate_probability=0.99)
    assert np.array_equal(both_far.rejected, [2.0])
    late_far = step(0.1, far, gate_probability=0.99)
    assert np.array_equal(late_far.rejected, [1.0])


@pytest.mark.filterwarnings("ignore:observations must be predicted to be used")
@pytest.mark.parametrize(
    "make",
    [
        partial(filters.GaussianFilter, linearization="unscented"),
        partial(filters.EnsembleFilter, members=20),
        partial(filters.ParticleFilter, members=20),
        partial(filters.TransportFilter, members=20),
    ],
)
def test_unseen_observations_of_a_step_add_up_and_belong_to_it(make: Any) -> None:
    """A late and a present one are two; smoothed beliefs are later ones, but not their counts."""
    walk = Model(1, lambda x, t, dt: x, lambda t, dt: dt * np.eye(1))
    # Beyond all that the prior N(0, 1) and the noise make likely
    blind = Sensor(1, lambda x: np.where(x > 50, x, np.nan), [[1.0]])
    f = make(walk, [blind], lag=1)
    start = f.start(([0.0], [[1.0]]), rng=np.random.default_rng(0))
    present = [Observation(2.0, 0, [1.3])]
    late = [Observation(1.0, 0, [-0.4], arrival_time=2.0)]
    for call in (f.run, f.smooth):
        record_ = call(start, [1.0, 2.0, 3.0], present, delayed=late)
        unseen = record_["unseen"].values[:, 0]
        assert unseen.tolist() == [0.0, 2.0, 0.0]


@pytest.mark.parametrize(
    "make",
    [
        partial(filters.ParticleFilter, members=50, ess_threshold=0.0),
        partial(filters.TransportFilter, members=20),
    ],
)
def test_a_compass_as_a_density_is_tested_the_shorter_way_round(make: Any) -> None:
    """Headings on both sides of ±π: its gate and its NIS are those of a sensor with a period."""
    turn = (2 * np.pi,)
    rest = Model(1, lambda x, t, dt: x, lambda t, dt: np.zeros((1, 1)), periods=turn)
    plain = Sensor(1, lambda x: x, [[0.04]], periods=turn)

    def log_likelihood(x: Array, y: Array) -> Array:
        residual = wrap(y - x)
        return norm.logpdf(residual[..., 0], scale=0.2)

    def moments(x: Array) -> tuple[Array, Array]:
        return x, np.full((*x.shape, 1), 0.04)

    density = LikelihoodSensor(1, log_likelihood, moments=moments, periods=turn)
    runs = []
    for sensor in (plain, density):
        f = make(rest, [sensor], gate_probability=0.99, record_evidence=True)
        start = f.start(([3.1], [[0.04]]), rng=np.random.default_rng(0))
        # 3.1 is near -3.1 the shorter way, and opposite to 3.1 - π, beside which predictions are
        # on both sides of the cut.
        seen = [[-3.1], [3.1 - np.pi], [3.0]]
        runs.append(f.run(start, [1.0, 2.0, 3.0], [seen]))
    a, b = runs
    rejected = a["rejected"].values.ravel()
    assert rejected.tolist() == [0.0, 1.0, 0.0]
    assert_equal(a, b, ("mean", "variance", "rejected", "n_observed"))
    # The variance of 20 members of equal weights is divided by 19 or by 20.
    assert np.allclose(a["nis"], b["nis"], rtol=1 / 19)


@pytest.mark.parametrize("side", [-0.1, 0.1])
def test_an_innovation_is_the_shorter_way_to_the_mean(side: float) -> None:
    """Opposite to the mean, but for 0.1 rad: π - 0.1 on either side, and never π + 0.1."""
    turn = (2 * np.pi,)
    rest = Model(1, lambda x, t, dt: x, lambda t, dt: np.zeros((1, 1)), periods=turn)
    compass = Sensor(1, lambda x: x, [[0.04]], periods=turn)
    f = filters.ParticleFilter(rest, [compass], members=50, record_evidence=True)
    # The first member, beside which the others are put, is on one side of the mean or the other.
    members = 1.0 + np.sign(side) * np.linspace(0.3, -0.3, 50)
    start = f.start(members[:, None], rng=np.random.default_rng(0))
    before = f.summarize(start)
    y = before.mean[0, 0] + np.pi + side
    with warnings.catch_warnings(action="ignore"):
        state = f.step(start, 0.0, [[y]])
    # r² / S with r = π - 0.1 and S = P + R
    innovation_var = before.variance[0, 0] + 0.04
    expected = (np.pi - 0.1) ** 2 / innovation_var
    assert np.isclose(state.nis[0], expected, rtol=1e-9)
