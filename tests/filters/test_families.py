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
from distfilt.models import Model
from distfilt.network import Faults, covariance_intersection, graphs, mean_pull
from distfilt.sensors import Sensor, component, from_name
from distfilt.updates import enkf_exact, enkf_sampled_covariance

from .families import NOISE, PRIOR, TIMES, Q, data, kalman, make_filter, model, team

STILL = Model(1, lambda x, t, dt: x, lambda t, dt: np.zeros((1, 1)))
BOTH = Sensor(2, lambda x: x, NOISE, linear=lambda d: np.eye(d))


@pytest.mark.parametrize("lag", [0, 3])
def test_network_of_exact_ensembles_is_the_network_of_kalman_filters(lag: int) -> None:
    """With the same rule of intersection, agent by agent, with loss and a full noise matrix.

    The fusion informs the past too, whose moments are exact for a model without noise.
    """
    sensors = team(4)
    _, seen = data(sensors, (3,))
    options = {"graph": graphs.ring(4), "runs": (3,), "sensors": sensors, "lag": lag}
    options |= {"model": replace(model(), noise_cov=lambda t, dt: 0 * Q)} if lag else {}
    faults = Faults(loss=0.3, seed=1)
    f, start = make_filter("ensemble, exact", faults=faults, **options)
    rule = partial(covariance_intersection, rule="min_determinant")
    g, begin = make_filter("gaussian", fusion=rule, faults=faults, **options)
    e = start.ensembles
    cov = np.array([[np.cov(m.T) for m in agents] for agents in e])
    state = filters.GaussianState(0.0, begin.ledger, None, e.mean(axis=-2), cov, 2)
    late = [
        filters.Observation(
            TIMES[k], 2, np.ones((3, 1)), sensors[0], arrival_time=TIMES[k + 2]
        )
        for k in range(6 * (lag > 0))
    ]
    for how in ("run", "smooth")[: 1 + lag]:
        a, b = (
            getattr(h, how)(s, TIMES, seen, delayed=late)
            for h, s in ((f, start), (g, state))
        )
        assert np.allclose(a["mean"], b["mean"], atol=1e-8)
        assert np.allclose(a["variance"], b["variance"], atol=1e-8)
        for name in ("messages", "scalars", "lost", "rounds"):
            assert np.array_equal(a[name], b[name])


@pytest.mark.parametrize("rule", ["extended", "unscented"])
def test_gaussian_smoothing_is_the_smoother(rule: str) -> None:
    _, (seen,) = data([BOTH], (4,))
    f = filters.GaussianFilter(model(), [BOTH], linearization=rule, lag=len(TIMES))
    smoothed = f.smooth(f.start(PRIOR, runs=(4,)), TIMES, [seen])
    filtered, moves = kalman([seen], [BOTH])
    exact = rts_smoother(filtered, **moves)
    assert np.allclose(smoothed["mean"].values[..., 0, :], exact.means, atol=1e-11)
    assert np.allclose(
        smoothed["covariance"].values[..., 0, :, :], exact.covariances, atol=1e-11
    )


def test_unscented_points_see_a_curve() -> None:
    """E[x²] of N(m, P) is m² + P: exact with points, not with the derivative at the mean.

    With κ = 1 the points lie √2 deviations out, so that they see a variance of 4m²P + P².
    """
    square = Model(1, lambda x, t, dt: x**2, lambda t, dt: np.zeros((1, 1)))
    eye = Sensor(1, lambda x: x**2, [[0.5]])
    for rule, mean, cov in (("unscented", 1.25, 1.0625), ("extended", 1.0, 1.0)):
        f = filters.GaussianFilter(square, [None], linearization=rule)
        state = f.step(f.start(([1.0], [[0.25]])), 1.0, [None])
        assert abs(state.means[0, 0] - mean) < 1e-9
        assert abs(state.covariances[0, 0, 0] - cov) < 1e-9
        g = filters.GaussianFilter(
            Model(1, lambda x, t, dt: x, square.noise_cov), [eye], linearization=rule
        )
        after = g.step(g.start(([1.0], [[0.25]])), 1.0, [[2.0]])
        gain = 0.5 / (cov + 0.5)  # the covariance of x and x² is 2mP
        assert abs(after.means[0, 0] - (1.0 + gain * (2.0 - mean))) < 1e-9
        assert abs(after.covariances[0, 0, 0] - (0.25 - gain * 0.5)) < 1e-9


def test_jitter_moves_copies_by_a_share_of_what_is_believed() -> None:
    eye = component([0], std=0.5)
    f = filters.ParticleFilter(
        STILL, [eye], members=4000, ess_threshold=1.0, jitter=0.3
    )
    before = f.step(f.start(([0.0], [[4.0]]), rng=default_rng(0)), 1.0, [[1.0]])
    after = f.step(before, 2.0, [None]).particles[0, :, 0]
    old = before.particles[0, :, 0]
    stayed = np.isin(after, old)
    assert 0.02 < stayed.mean() < 0.5
    plain = filters.ParticleFilter(
        STILL, f.sensors, members=4000, ess_threshold=1.0, jitter=0.0
    )
    picked = plain.step(before, 2.0, [None]).particles[0, :, 0]
    moves = (after - picked)[~stayed]
    width = 0.3 * np.sqrt(f.summarize(before).variance[0, 0])
    assert abs(moves.std() / width - 1) < 0.05
    assert not (after - picked)[stayed].any()


def test_a_member_that_was_picked_or_moved_sees_changes_from_where_it_comes() -> None:
    """Nothing moves, and a reading says so: that tells no particle from another."""
    eyes = [[component([0], std=0.5), from_name("increment", [0], std=0.1)]]
    f = filters.ParticleFilter(
        STILL,
        eyes * 2,
        members=50,
        ess_threshold=1.0,
        jitter=0.0,
        share_observations=False,
    )
    first = filters.Observation(1.0, 0, [0.5])
    still = filters.Observation(2.0, 0, [0.0], 1)
    start = f.start(np.linspace(-1, 1, 50)[:, None], rng=default_rng(0))
    state = f.step(start, 1.0, [first, filters.Observation(1.0, 1, [0.5])])
    after = f.step(state, 2.0, [still, None])
    assert np.ptp(state.weights[0]) > 0.01
    assert np.ptp(after.weights) < 1e-15
    assert (state.particles[0] == state.particles[1]).all()
    assert (after.particles[0] != after.particles[1]).any()
    lagged = replace(f, ess_threshold=0.2).step(state, 2.0, [None] * 2)
    assert (lagged.particles == state.particles).all()
    assert (lagged.weights == state.weights).all()
    subset = f.step(start, 1.0, [first, None])
    few = replace(f, ess_threshold=0.9)
    repeated = [
        few.step(subset, 2.0, [None] * 2).particles for _ in range(2)
    ]  # a state stays as it was
    assert (repeated[0] == repeated[1]).all()
    assert (repeated[0] != start.particles).any(axis=(1, 2)).tolist() == [True, False]
    g = filters.EnsembleFilter(STILL, eyes, members=50, lag=1)
    state = g.step(g.start(([0.0], [[1.0]]), rng=default_rng(0)), 1.0, [None])
    delayed, not_told = (
        g.step(state, 2.0, [y], delayed=[first]).ensembles for y in ([still], None)
    )
    assert np.allclose(delayed, not_told)


@pytest.mark.parametrize("family", ["ensemble", "particle", "ensemble, common"])
def test_a_change_that_is_read_after_its_step_is_one_from_the_step_s_begin(
    family: str,
) -> None:
    """A delayed observation acts as in its own step; one of a time that is not kept is refused."""
    eyes = [[from_name("increment", [0], std=0.5), component([1], std=0.8)]]
    f, start = make_filter(family, sensors=eyes, graph=None, lag=2)
    now = [[filters.Observation(1.0, 0, [0.4]), filters.Observation(1.0, 0, [-0.7], 1)]]
    moved = f.step(start, 0.5, [None])
    at_once = [replace(f, lag=k).step(moved, 1.0, now) for k in range(3)]
    later = f.step(f.step(moved, 1.0, [None]), 1.0, now)
    for state in (later, *at_once[1:]):
        assert np.allclose(
            f.summarize(state).mean, f.summarize(at_once[0]).mean, atol=1e-9
        )
    with pytest.raises(
        ValueError, match="previous must be the states at the previous observation time"
    ):
        replace(f, lag=0).step(start, 0.0, [filters.Observation(0.0, 0, [0.4])])


def test_particles_tend_to_the_kalman_filter_with_a_full_noise() -> None:
    _, (seen,) = data([BOTH])
    seen[3, 0] = np.nan
    f = filters.ParticleFilter(model(), [BOTH], members=40_000)
    run = f.run(f.start(PRIOR, rng=default_rng(0)), TIMES, [seen])
    exact, _ = kalman([seen], [BOTH])
    assert np.allclose(run["mean"].values[:, 0], exact.means, atol=0.03)
    assert np.allclose(run["covariance"].values[:, 0], exact.covariances, atol=0.03)
    assert (run["effective_size"].values > 1000).all()
    assert (run["distinct"].values > 0.03).all()


def test_copies_are_regularised_by_default_where_the_model_never_parts_them() -> None:
    """Of a constant the posterior is known; the kernel widens it by less than a tenth or so."""
    f = filters.ParticleFilter(STILL, [component([0], std=0.5)], members=4000)
    seen = [np.full((6, 1), 0.8)]
    run = f.run(
        f.start(([0.0], [[4.0]]), rng=default_rng(0)),
        np.arange(1.0, 7.0),
        seen,
    )
    variance = 1 / (1 / 4 + np.arange(1, 7) / 0.25)
    mean = variance * 0.8 * np.arange(1, 7) / 0.25
    assert run["distinct"].values.min() > 0.5
    assert np.abs(run["mean"].values[:, 0, 0] - mean).max() < 0.02
    assert np.allclose(run["variance"].values[:, 0, 0], variance, rtol=0.15)
    half = Model(2, lambda x, t, dt: x, lambda t, dt: np.diag([dt, 0.0]))
    f = filters.ParticleFilter(
        half, [component([0], std=0.5)], members=60, ess_threshold=1.0
    )
    first = f.step(f.start(PRIOR, rng=default_rng(0)), 1.0, [[0.8]])
    assert np.isin(
        f.step(first, 2.0, [None]).particles[..., 1], first.particles[..., 1]
    ).all()


@pytest.mark.parametrize("jitter", [0.0, 0.3])
def test_one_weight_for_all_warns_although_the_particles_are_distinct(
    jitter: float,
) -> None:
    """Jitter of the former spread separates its copies; otherwise they stay equal."""
    f = filters.ParticleFilter(
        STILL, [component([0], std=1e-4)], members=800, jitter=jitter
    )
    start = f.start(([0.0], [[4.0]]), rng=default_rng(0))
    with pytest.warns(
        filters.ParticleCollapse, match=r"t = 1 s: an agent's .* size of 1\.\d;"
    ):
        state = f.step(start, 1.0, [[0.5]])
    summary = f.summarize(state)
    assert summary.numbers["distinct"] == 1.0
    assert summary.numbers["effective_size"] < 2
    caught = pytest.warns(
        filters.ParticleCollapse, match=r"t = 2 s: 0\.\d+% of an agent's particles"
    )
    with nullcontext() if jitter else caught:
        after = f.step(state, 2.0, [None])
    assert np.allclose(
        after.particles.std(), jitter * state.particles.std(), rtol=0.1, atol=1e-4
    )


def test_copies_of_one_particle_warn_at_any_number_and_two_do_not() -> None:
    f = filters.ParticleFilter(STILL, [None], members=50, jitter=0.0)
    start = f.start(([0.0], [[0.0]]), rng=default_rng(0))
    with pytest.warns(
        filters.ParticleCollapse, match="2.00% of an agent's particles are distinct"
    ):
        f.step(start, 1.0, [None])
    f.step(
        f.start(np.arange(50.0)[:, None] // 25, rng=default_rng(0)),
        1.0,
        [None],
    )


def test_what_an_agreement_moves_was_there_before_too() -> None:
    """Where nothing moves and nothing is jittered, the past is the present, agreed of or not."""
    f = filters.ParticleFilter(
        STILL,
        [component([0], std=0.5), None],
        graphs.path(2),
        members=30,
        lag=1,
        jitter=0.0,
        share_observations=False,
        fusion=partial(mean_pull, gain=0.3),
    )
    start = f.start(([0.0], [[1.0]]), rng=default_rng(0))
    after = f.step(f.step(start, 1.0, [[0.5], None]), 2.0, [[0.7], None])
    assert np.allclose(after.history[0][1], after.particles)
    assert (after.particles != start.particles).any()


def test_a_run_whose_covariance_overflows_leaves_the_others_to_agree() -> None:
    wild = Model(1, lambda x, t, dt: (x.T * [1.0, 1e200]).T, lambda t, dt: np.eye(1))
    f = filters.GaussianFilter(
        wild,
        [None] * 2,
        graphs.path(2),
        fusion=covariance_intersection,
        on_error="keep",
    )
    with np.errstate(over="ignore", invalid="ignore"):
        state = f.step(f.start(([0.0], [[1.0]]), runs=(2,)), 1.0, [None, None])
    assert state.failed.tolist() == [False, True]
    assert np.allclose(state.covariances[0], 2.0)


def test_an_agreement_for_one_run_is_asked_for_each() -> None:
    """They lose the same messages as with the rule for all; the ledger has their mean."""

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
    all_, each = (g.step(start, 0.1, [None] * 5) for g in (f, replace(f, fusion=one)))
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
    start = f.start(PRIOR, rng=default_rng(0), runs=(3,))
    wild = start.replace(
        ensembles=start.ensembles + 99 * np.eye(3)[1][:, None, None, None]
    )
    with pytest.raises(filters.FilterError, match=r"run 1, t = 0.1 s: it is far off"):
        replace(f, on_error="raise").step(wild, 0.1, [None] * 4)
    for t in (0.1, 0.2):
        start, wild = (f.step(s, t, [None] * 4) for s in (start, wild))
        assert wild.failed.tolist() == [False, True, False]
        np.testing.assert_array_equal(wild.ensembles[[0, 2]], start.ensembles[[0, 2]])
        assert (wild.ledger.lost == start.ledger.lost).all()
        assert start.ledger.lost.any()


@pytest.mark.filterwarnings("ignore:overflow")
def test_a_reading_that_no_particle_explains_ends_its_run_alone() -> None:
    f = filters.ParticleFilter(
        model(),
        [component([0], std=0.5)] * 2,
        graphs.path(2),
        members=30,
        share_observations=False,
        on_error="keep",
    )
    start = f.start(PRIOR, rng=default_rng(0), runs=(3,))
    good = np.zeros((3, 1))
    wild = np.array([[0.0], [0.0], [1e200]])
    a, b = (f.step(start, 0.5, [good, y]) for y in (good, wild))
    assert b.failed.tolist() == [False, False, True]
    assert (a.weights[:2] == b.weights[:2]).all()
    with pytest.raises(filters.FilterError, match="run 2, agent 1, t = 0.5 s"):
        replace(f, on_error="raise").step(start, 0.5, [good, wild])


@pytest.mark.parametrize("raises", [False, True])
def test_a_run_whose_update_fails_is_named_and_leaves_the_others_their_draws(
    raises: bool,
) -> None:
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
    good = f.step(start, 0.5, [np.zeros((3, 1))] * 2)
    failing = f.step(start, 0.5, [np.zeros((3, 1)), np.array([[0.0], [9.0], [0.0]])])
    assert failing.failed.tolist() == [False, True, False]
    np.testing.assert_array_equal(failing.ensembles[[0, 2]], good.ensembles[[0, 2]])
    assert np.isnan(f.summarize(failing).mean[1]).all()
    strict = replace(f, on_error="raise")
    with pytest.raises(
        filters.FilterError, match="run 1, agent 1, t = 0.5 s: .*ite"
    ) as caught:
        strict.step(start, 0.5, [np.zeros((3, 1)), np.array([[0.0], [9.0], [0.0]])])
    assert (caught.value.run, caught.value.agent, caught.value.t) == ((1,), 1, 0.5)


def test_groups_of_readings_give_each_agent_its_own_noise() -> None:
    """Agents with one reading each but different noise: the quieter one is the surer."""
    eyes = [component([0], std=s) for s in (0.1, 2.0)]
    r = np.array([0.01, 4.0])
    for update in (enkf_exact, lambda *four, rng: enkf_exact(*four, rng=rng)):
        f = filters.EnsembleFilter(
            model(), eyes, share_observations=False, members=10, update=update
        )
        start = f.start(PRIOR, rng=default_rng(0))
        p, q = (
            f.summarize(s).variance[:, 0]
            for s in (start, f.step(start, 0.0, [[1.0], [1.0]]))
        )
        assert np.allclose(q, p * r / (p + r), rtol=1e-9)


@pytest.mark.filterwarnings("ignore::distfilt.filters.ParticleCollapse")
def test_nees_of_a_collapsed_cloud_is_infinite() -> None:
    # The first reading is 1e6 times sharper than the prior: one particle keeps all the weight.
    walk = Model(2, lambda x, t, dt: x, lambda t, dt: dt * np.eye(2))
    f = filters.ParticleFilter(walk, [component([0, 1], std=1e-6)], members=20)
    state = f.start((np.zeros(2), np.eye(2)), rng=default_rng(0), runs=(3,))
    truth = np.full((2, 3, 2), 0.3)
    seen = truth.copy()
    seen[:, 1] = np.nan  # a run without readings stays honest
    run = f.run(state, [1.0, 2.0], [seen], truth=truth)
    recorded = run["nees"].values[:, :, 0]
    assert np.isinf(recorded[:, [0, 2]]).all()
    mean = run["mean"].values[0, 1, 0]
    cov = run["covariance"].values[0, 1, 0]
    gap = mean - truth[0, 1]
    assert abs(recorded[0, 1] - gap @ np.linalg.solve(cov, gap)) < 1e-9
