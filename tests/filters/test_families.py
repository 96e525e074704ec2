"""Properties of single families: exactness, collapse, linearisation, failures of updates."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest
from numpy.random import default_rng

from distfilt import filters
from distfilt.kalman import rts_smoother
from distfilt.models import Model, constant_velocity
from distfilt.network import Faults, covariance_intersection, graphs, mean_pull
from distfilt.sensors import Sensor, component, from_name, stack
from distfilt.updates import enkf_exact, enkf_sampled_covariance

from .families import (
    NOISE,
    PRIOR,
    TIMES,
    Q,
    data,
    kalman,
    make_filter,
    model,
    still_model,
    team,
)

STILL = still_model(1)
STANDARD = ([0.0], [[1.0]])
WIDE = ([0.0], [[4.0]])
"""Priors of one component, with variances 1 and 4."""
EYE = component([0], std=0.5)
BOTH = Sensor(2, lambda x: x, NOISE, linear=np.eye)


@pytest.mark.parametrize("lag", [0, 3])
def test_network_of_exact_ensembles_is_the_network_of_kalman_filters(lag: int) -> None:
    """With the same rule of intersection, agent by agent, with loss and a full noise matrix.

    The fusion informs the past too, whose moments are exact for a model without noise.
    """
    sensors = team(4)
    _, seen = data(sensors, (3,))
    options = {"graph": graphs.ring(4), "runs": (3,), "sensors": sensors, "lag": lag}
    if lag:
        options["model"] = replace(model(), noise_cov=lambda t, dt: 0 * Q)
    # One seed of the faults: both networks lose the same messages.
    faults = Faults(loss=0.3, seed=1)
    f, start = make_filter("ensemble, exact", faults=faults, **options)
    rule = partial(covariance_intersection, rule="min_determinant")
    g, begin = make_filter("gaussian", fusion=rule, faults=faults, **options)
    # The Gaussian network starts from the sample moments of the members.
    e = start.ensembles
    mean = e.mean(axis=-2)
    anomalies = e - mean[..., None, :]
    cov = anomalies.mT @ anomalies / (e.shape[-2] - 1)
    state = filters.GaussianState(0.0, begin.ledger, None, mean, cov, 2)
    late = []
    if lag:
        # Observations of agent 2, which has no sensor of its own, two times late
        ones = np.ones((3, 1))
        for t, arrival in zip(TIMES[:6], TIMES[2:], strict=True):
            late.append(
                filters.Observation(t, 2, ones, sensors[0], arrival_time=arrival)
            )
    for how in ("run", "smooth") if lag else ("run",):
        a = getattr(f, how)(start, TIMES, seen, delayed=late)
        b = getattr(g, how)(state, TIMES, seen, delayed=late)
        assert np.allclose(a["mean"], b["mean"], atol=1e-8)
        assert np.allclose(a["variance"], b["variance"], atol=1e-8)
        for name in ("messages", "scalars", "lost", "rounds"):
            assert np.array_equal(a[name], b[name])


@pytest.mark.parametrize("rule", ["extended", "unscented"])
def test_gaussian_smoothing_is_the_smoother(rule: str) -> None:
    _, (seen,) = data([BOTH], (4,))
    f = filters.GaussianFilter(model(), [BOTH], linearization=rule, lag=len(TIMES))
    smoothed = f.smooth(f.start(PRIOR, runs=(4,)), TIMES, [seen])
    # A lag of all times is the Rauch-Tung-Striebel smoother.
    filtered, moves = kalman([seen], [BOTH])
    exact = rts_smoother(filtered, **moves)
    agent = smoothed.isel(agent=0)
    assert np.allclose(agent["mean"], exact.means, atol=1e-11)
    assert np.allclose(agent["covariance"], exact.covariances, atol=1e-11)


def test_unscented_points_see_a_curve() -> None:
    """E[x²] of N(m, P) is m² + P: exact with points, not with the derivative at the mean.

    With κ = 1 the points lie √2 deviations out, so that they see a variance of 4m²P + P².
    """
    square = Model(1, lambda x, t, dt: x**2, STILL.noise_cov)
    sensor = Sensor(1, lambda x: x**2, [[0.5]])
    prior = ([1.0], [[0.25]])
    for rule, mean, cov in (("unscented", 1.25, 1.0625), ("extended", 1.0, 1.0)):
        f = filters.GaussianFilter(square, [None], linearization=rule)
        state = f.step(f.start(prior), 1.0, [None])
        assert np.allclose(state.means, mean, rtol=0, atol=1e-9)
        assert np.allclose(state.covariances, cov, rtol=0, atol=1e-9)
        g = filters.GaussianFilter(STILL, [sensor], linearization=rule)
        after = g.step(g.start(prior), 1.0, [[2.0]])
        # K = 2mP / (cov + R): the covariance of x and x² is 2mP = 0.5.
        gain = 0.5 / (cov + 0.5)
        mean_after = 1.0 + gain * (2.0 - mean)
        cov_after = 0.25 - gain * 0.5
        assert np.allclose(after.means, mean_after, rtol=0, atol=1e-9)
        assert np.allclose(after.covariances, cov_after, rtol=0, atol=1e-9)


def test_jitter_moves_copies_by_a_share_of_what_is_believed() -> None:
    f = filters.ParticleFilter(
        STILL, [EYE], members=4000, ess_threshold=1.0, jitter=0.3
    )
    start = f.start(WIDE, rng=default_rng(0))
    before = f.step(start, 1.0, [[1.0]])
    after = f.step(before, 2.0, [None]).particles[0, :, 0]
    # A particle that was picked once stays where it is, copies are moved.
    old = before.particles[0, :, 0]
    stayed = np.isin(after, old)
    assert 0.02 < stayed.mean() < 0.5
    # Without jitter the same draws pick the same particles.
    plain = replace(f, jitter=0.0)
    picked = plain.step(before, 2.0, [None]).particles[0, :, 0]
    moves = after - picked
    std = np.sqrt(f.summarize(before).variance[0, 0])
    ratio = moves[~stayed].std() / (0.3 * std)
    assert abs(ratio - 1) < 0.05
    assert not moves[stayed].any()


def test_a_member_that_was_picked_or_moved_sees_changes_from_where_it_comes() -> None:
    """Nothing moves, and an increment of 0 is observed: no particle explains it better."""
    eyes = [[EYE, from_name("increment", [0], std=0.1)]]
    f = filters.ParticleFilter(
        STILL,
        eyes * 2,
        members=50,
        ess_threshold=1.0,
        jitter=0.0,
        share_observations=False,
    )
    first = filters.Observation(1.0, 0, [0.5])
    second = filters.Observation(1.0, 1, [0.5])
    still = filters.Observation(2.0, 0, [0.0], 1)
    places = np.linspace(-1, 1, 50)
    start = f.start(places[:, None], rng=default_rng(0))
    state = f.step(start, 1.0, [first, second])
    after = f.step(state, 2.0, [still, None])
    # Weights differ after the first step; resampling makes them equal, and so they stay.
    assert np.ptp(state.weights[0]) > 0.01
    assert np.ptp(after.weights) < 1e-15
    assert (state.particles[0] == state.particles[1]).all()
    assert (after.particles[0] != after.particles[1]).any()
    # Below the threshold nothing is resampled.
    lagged = replace(f, ess_threshold=0.2).step(state, 2.0, [None] * 2)
    assert (lagged.particles == state.particles).all()
    assert (lagged.weights == state.weights).all()
    subset = f.step(start, 1.0, [first, None])
    # Only agent 0, whose weights differ, is resampled; a step leaves its state as it was.
    few = replace(f, ess_threshold=0.9)
    once = few.step(subset, 2.0, [None] * 2).particles
    twice = few.step(subset, 2.0, [None] * 2).particles
    assert (once == twice).all()
    differs = (once != start.particles).any(axis=(1, 2))
    assert differs.tolist() == [True, False]
    # Members that a delayed observation moves are moved at both times: no increment.
    g = filters.EnsembleFilter(STILL, eyes, members=50, lag=1)
    state = g.step(g.start(STANDARD, rng=default_rng(0)), 1.0, [None])
    with_increment = g.step(state, 2.0, [[still]], delayed=[first])
    without = g.step(state, 2.0, [None], delayed=[first])
    assert np.allclose(with_increment.ensembles, without.ensembles)


@pytest.mark.parametrize("family", ["ensemble", "particle", "ensemble, common"])
def test_a_change_that_is_read_after_its_step_is_one_from_the_step_s_begin(
    family: str,
) -> None:
    """A delayed observation acts as in its own step; one of a time that is not kept is refused."""
    eyes = [[from_name("increment", [0], std=0.5), component([1], std=0.8)]]
    f, start = make_filter(family, sensors=eyes, graph=None, lag=2)
    increment = filters.Observation(1.0, 0, [0.4])
    position = filters.Observation(1.0, 0, [-0.7], 1)
    now = [[increment, position]]
    moved = f.step(start, 0.5, [None])
    # In one step to the time, for each lag, or in a second step to the same time
    expected = f.summarize(replace(f, lag=0).step(moved, 1.0, now))
    later = f.step(f.step(moved, 1.0, [None]), 1.0, now)
    states = [later]
    for lag in (1, 2):
        states.append(replace(f, lag=lag).step(moved, 1.0, now))
    for state in states:
        assert np.allclose(f.summarize(state).mean, expected.mean, atol=1e-9)
    # At the start there is no earlier state from which to measure a change.
    first = filters.Observation(0.0, 0, [0.4])
    message = "previous must be the states at the previous observation time"
    with pytest.raises(ValueError, match=message):
        replace(f, lag=0).step(start, 0.0, [first])


def test_particles_tend_to_the_kalman_filter_with_a_full_noise() -> None:
    _, (seen,) = data([BOTH])
    seen[3, 0] = np.nan
    f = filters.ParticleFilter(model(), [BOTH], members=40_000)
    start = f.start(PRIOR, rng=default_rng(0))
    run = f.run(start, TIMES, [seen])
    exact, _ = kalman([seen], [BOTH])
    # The sampling error of 40 000 particles is below 0.03.
    agent = run.isel(agent=0)
    assert np.allclose(agent["mean"], exact.means, atol=0.03)
    assert np.allclose(agent["covariance"], exact.covariances, atol=0.03)
    assert (run["effective_size"].values > 1000).all()
    assert (run["distinct"].values > 0.03).all()


def test_copies_are_regularised_by_default_where_the_model_never_parts_them() -> None:
    """Of a constant the posterior is known; the kernel widens it by less than a tenth or so."""
    f = filters.ParticleFilter(STILL, [EYE], members=4000)
    seen = [np.full((6, 1), 0.8)]
    times = np.arange(1.0, 7.0)
    run = f.run(f.start(WIDE, rng=default_rng(0)), times, seen)
    # After n equal observations 1/P = 1/4 + n/R and m = P n y/R, with R = 0.25.
    information = times / 0.25
    variance = 1 / (1 / 4 + information)
    mean = variance * 0.8 * information
    assert run["distinct"].values.min() > 0.5
    component_ = run.isel(agent=0, component=0)
    assert np.abs(component_["mean"].values - mean).max() < 0.02
    assert np.allclose(component_["variance"], variance, rtol=0.15)
    # The model's noise parts the copies in its first component: nothing is jittered.
    unit = np.diag([1.0, 0.0])
    half = Model(2, lambda x, t, dt: x, lambda t, dt: dt * unit)
    f = filters.ParticleFilter(half, [EYE], members=60, ess_threshold=1.0)
    start = f.start(PRIOR, rng=default_rng(0))
    first = f.step(start, 1.0, [[0.8]])
    after = f.step(first, 2.0, [None])
    old = first.particles[..., 1]
    assert np.isin(after.particles[..., 1], old).all()


@pytest.mark.parametrize("jitter", [0.0, 0.3])
def test_one_weight_for_all_warns_although_the_particles_are_distinct(
    jitter: float,
) -> None:
    """Jitter of the former spread separates its copies; otherwise they stay equal."""
    # The sensor is 20 000 times sharper than the prior: one particle is nearest.
    sharp = component([0], std=1e-4)
    f = filters.ParticleFilter(STILL, [sharp], members=800, jitter=jitter)
    start = f.start(WIDE, rng=default_rng(0))
    message = r"t = 1 s: an agent's .* size of 1\.\d;"
    with pytest.warns(filters.ParticleCollapse, match=message):
        state = f.step(start, 1.0, [[0.5]])
    summary = f.summarize(state)
    assert summary.numbers["distinct"] == 1.0
    assert summary.numbers["effective_size"] < 2
    message = r"t = 2 s: 0\.\d+% of an agent's particles"
    caught = pytest.warns(filters.ParticleCollapse, match=message)
    with nullcontext() if jitter else caught:
        after = f.step(state, 2.0, [None])
    # All are copies of one particle, spread by the jitter.
    width = jitter * state.particles.std()
    assert np.allclose(after.particles.std(), width, rtol=0.1, atol=1e-4)


def test_copies_of_one_particle_warn_at_any_number_and_two_do_not() -> None:
    f = filters.ParticleFilter(STILL, [None], members=50, jitter=0.0)
    # A prior without variance: 1 of 50 is distinct.
    start = f.start(([0.0], [[0.0]]), rng=default_rng(0))
    message = "2.00% of an agent's particles are distinct"
    with pytest.warns(filters.ParticleCollapse, match=message):
        f.step(start, 1.0, [None])
    # 25 particles at 0 and 25 at 1; a warning here would be an error.
    halves = np.arange(50.0) // 25
    start = f.start(halves[:, None], rng=default_rng(0))
    f.step(start, 1.0, [None])


def test_what_an_agreement_moves_was_there_before_too() -> None:
    """Where nothing moves and nothing is jittered, the past is the present, fused or not."""
    f = filters.ParticleFilter(
        STILL,
        [EYE, None],
        graphs.path(2),
        members=30,
        lag=1,
        jitter=0.0,
        share_observations=False,
        fusion=partial(mean_pull, gain=0.3),
    )
    start = f.start(STANDARD, rng=default_rng(0))
    state = f.step(start, 1.0, [[0.5], None])
    after = f.step(state, 2.0, [[0.7], None])
    _, past = after.history[0][:2]
    assert np.allclose(past, after.particles)
    assert (after.particles != start.particles).any()


def test_a_run_whose_covariance_overflows_leaves_the_others_to_agree() -> None:
    # Factors of the two runs; the square of 1e200 is no float.
    factors = np.array([1.0, 1e200])
    eye = np.eye(1)
    wild = Model(1, lambda x, t, dt: (x.T * factors).T, lambda t, dt: eye)
    f = filters.GaussianFilter(
        wild,
        [None] * 2,
        graphs.path(2),
        fusion=covariance_intersection,
        on_error="keep",
    )
    with np.errstate(over="ignore", invalid="ignore"):
        state = f.step(f.start(STANDARD, runs=(2,)), 1.0, [None, None])
    # 1 + 1 of the prior and the step; fusing two equal beliefs changes nothing.
    assert state.failed.tolist() == [False, True]
    assert np.allclose(state.covariances[0], 2.0)


def test_an_agreement_for_one_run_is_asked_for_each() -> None:
    """They lose the same messages as with the rule for all; the ledger has their mean."""

    # A rule of a user that does not know the axis of runs
    def one(ensembles: np.ndarray, channel: Any) -> np.ndarray:
        if channel.runs:
            raise ValueError("channel must be a single run")
        return mean_pull(ensembles, channel, gain=0.3)

    f, start = make_filter(
        "ensemble",
        fusion=partial(mean_pull, gain=0.3),
        runs=(2, 3),
        share_observations=False,
        faults=Faults(loss=0.5, seed=3),
    )
    nothing = [None] * 5
    all_ = f.step(start, 0.1, nothing)
    each = replace(f, fusion=one).step(start, 0.1, nothing)
    np.testing.assert_array_equal(each.ensembles, all_.ensembles)
    for name in ("rounds", "messages", "scalars", "bytes", "lost"):
        assert np.allclose(getattr(each.ledger, name), getattr(all_.ledger, name))


def test_a_run_whose_agreement_fails_leaves_the_others_as_they_are() -> None:
    """With losses of their own, and charged as if all had gone well."""

    def fragile(ensembles: np.ndarray, channel: Any) -> np.ndarray:
        result = mean_pull(ensembles, channel, gain=0.3)
        if (result > 50).any():
            raise np.linalg.LinAlgError("it is far off")
        return result

    f = filters.EnsembleFilter(
        model(),
        team(4),
        graphs.ring(4),
        fusion=fragile,
        members=5,
        on_error="keep",
        faults=Faults(loss=0.5, seed=3),
    )
    nothing = [None] * 4
    start = f.start(PRIOR, rng=default_rng(0), runs=(3,))
    # The same members, those of run 1 far off
    far = start.ensembles.copy()
    far[1] += 99
    wild = start.replace(ensembles=far)
    strict = replace(f, on_error="raise")
    with pytest.raises(filters.FilterError, match=r"run 1, t = 0.1 s: it is far off"):
        strict.step(wild, 0.1, nothing)
    for t in (0.1, 0.2):
        start = f.step(start, t, nothing)
        wild = f.step(wild, t, nothing)
        assert wild.failed.tolist() == [False, True, False]
        others = [0, 2]
        np.testing.assert_array_equal(wild.ensembles[others], start.ensembles[others])
        assert (wild.ledger.lost == start.ledger.lost).all()
        assert start.ledger.lost.any()


@pytest.mark.filterwarnings("ignore:overflow")
def test_a_reading_that_no_particle_explains_ends_its_run_alone() -> None:
    f = filters.ParticleFilter(
        model(),
        [EYE] * 2,
        graphs.path(2),
        members=30,
        share_observations=False,
        on_error="keep",
    )
    start = f.start(PRIOR, rng=default_rng(0), runs=(3,))
    good = np.zeros((3, 1))
    # The squared distance overflows: every particle of agent 1 in run 2 has the weight 0.
    wild = good.copy()
    wild[2] = 1e200
    a = f.step(start, 0.5, [good, good])
    b = f.step(start, 0.5, [good, wild])
    assert b.failed.tolist() == [False, False, True]
    assert (a.weights[:2] == b.weights[:2]).all()
    with pytest.raises(filters.FilterError, match="run 2, agent 1, t = 0.5 s"):
        replace(f, on_error="raise").step(start, 0.5, [good, wild])


@pytest.mark.parametrize("raises", [False, True])
def test_a_run_whose_update_fails_is_named_and_leaves_the_others_their_draws(
    raises: bool,
) -> None:
    # It fails for observed values above 5, by an error or by members that are NaN.
    def fragile(
        x: np.ndarray, h: np.ndarray, y: np.ndarray, r: np.ndarray, *, rng: Any
    ):
        if raises and (y > 5).any():
            raise ArithmeticError("it is not finite")
        after = enkf_sampled_covariance(x, h, y, r, rng=rng)
        return np.where(y[..., None, :] > 5, np.nan, after)

    f = filters.EnsembleFilter(
        model(),
        [component([0], std=s) for s in (1.0, 0.2)],
        graphs.path(2),
        update=fragile,
        share_observations=False,
        members=5,
        on_error="keep",
    )
    start = f.start(PRIOR, rng=default_rng(0), runs=(3,))
    zeros = np.zeros((3, 1))
    high = zeros.copy()
    high[1] = 9.0
    good = f.step(start, 0.5, [zeros, zeros])
    failing = f.step(start, 0.5, [zeros, high])
    assert failing.failed.tolist() == [False, True, False]
    # The other runs have the draws that they would have had.
    others = [0, 2]
    np.testing.assert_array_equal(failing.ensembles[others], good.ensembles[others])
    assert np.isnan(f.summarize(failing).mean[1]).all()
    strict = replace(f, on_error="raise")
    message = "run 1, agent 1, t = 0.5 s: .*ite"
    with pytest.raises(filters.FilterError, match=message) as caught:
        strict.step(start, 0.5, [zeros, high])
    error = caught.value
    assert (error.run, error.agent, error.t) == ((1,), 1, 0.5)


def test_groups_of_readings_give_each_agent_its_own_noise() -> None:
    """Agents with one observation each but different noise: less noise, more certainty."""
    eyes = [component([0], std=s) for s in (0.1, 2.0)]
    r = np.array([0.01, 4.0])
    for update in (enkf_exact, lambda *four, rng: enkf_exact(*four, rng=rng)):
        f = filters.EnsembleFilter(
            model(), eyes, share_observations=False, members=10, update=update
        )
        start = f.start(PRIOR, rng=default_rng(0))
        after = f.step(start, 0.0, [[1.0], [1.0]])
        p = f.summarize(start).variance[:, 0]
        q = f.summarize(after).variance[:, 0]
        # 1/q = 1/p + 1/r, agent by agent
        assert np.allclose(q, p * r / (p + r), rtol=1e-9)


@pytest.mark.filterwarnings("ignore::distfilt.filters.ParticleCollapse")
def test_nees_of_a_collapsed_cloud_is_infinite() -> None:
    # The first observation is 1e6 times sharper than the prior: one particle keeps all the weight.
    walk = still_model(2, rate=1.0)
    sharp = component([0, 1], std=1e-6)
    f = filters.ParticleFilter(walk, [sharp], members=20)
    prior = (np.zeros(2), np.eye(2))
    state = f.start(prior, rng=default_rng(0), runs=(3,))
    truth = np.full((2, 3, 2), 0.3)
    seen = truth.copy()
    # A run without observations stays consistent.
    seen[:, 1] = np.nan
    run = f.run(state, [1.0, 2.0], [seen], truth=truth)
    recorded = run["nees"].values[:, :, 0]
    assert np.isinf(recorded[:, [0, 2]]).all()
    # NEES = eᵀ P⁻¹ e
    entry = run.isel(time=0, run=1, agent=0)
    error = entry["mean"].values - truth[0, 1]
    nees = error @ np.linalg.solve(entry["covariance"].values, error)
    assert abs(recorded[0, 1] - nees) < 1e-9


def test_a_spread_that_overflows_leaves_other_runs_their_nees() -> None:
    # The second run's members are finite with mean zero; their squares are not finite.
    walk = still_model(2, rate=1.0)
    f = filters.EnsembleFilter(walk, [None], members=4, on_error="keep")
    members = default_rng(1).standard_normal((2, 4, 2))
    members[1] = 1e200 * np.array([[1.0, 1.0], [-1.0, -1.0], [1.0, -1.0], [-1.0, 1.0]])
    state = f.start(members[:, None], rng=default_rng(0), runs=(2,))
    with np.errstate(over="ignore", invalid="ignore"):
        run = f.run(state, [1.0], [None], truth=np.zeros((1, 2, 2)))
    assert np.isfinite(run["mean"].values).all()
    assert np.isnan(run["nees"].values[0, 1]).all()
    # NEES = eᵀ P⁻¹ e with the sample covariance of the first run's members
    last_members = f.final_state(run).ensembles[0, 0]
    error = last_members.mean(axis=0)
    nees = error @ np.linalg.solve(np.cov(last_members.T), error)
    assert np.allclose(run["nees"].values[0, 0], nees, rtol=1e-9, atol=0)


class EverythingKnown(filters.GaussianFilter):
    """Gaussian filters whose agents get the observations of all of them."""

    def next_state(self, step: Any) -> Any:
        """Hand every observation to every agent, then go on as the family does."""
        everything = [entry for entries in step.observations for entry in entries]
        step.observations = [everything for _ in step.observations]
        return super().next_state(step)


def test_an_observation_is_read_by_the_sensor_of_its_own_agent() -> None:
    # The agents' sensors differ in component and accuracy: the wrong one gives another mean.
    walk = constant_velocity(sigma=0.3, axes=1)
    sensors = [component([0], std=0.5), component([1], std=2.0)]
    prior = (np.zeros(2), np.diag([4.0, 1.0]))
    agents = EverythingKnown(walk, sensors, share_observations=False)
    state = agents.step(agents.start(prior), 1.0, [[1.2], [-0.4]])
    # One agent with both sensors is the filter that each of them should be.
    central = filters.GaussianFilter(walk, [stack(sensors)])
    expected = central.step(central.start(prior), 1.0, [[1.2, -0.4]])
    for agent in range(2):
        assert np.allclose(state.means[agent], expected.means[0], atol=1e-12)
        assert np.allclose(
            state.covariances[agent], expected.covariances[0], atol=1e-12
        )
