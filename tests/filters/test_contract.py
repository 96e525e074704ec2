"""The contract of every family, whatever the update and the fusion rule: one test for all."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.random import default_rng

from distfilt import metrics
from distfilt.filters import FilterError, Observation, final_state
from distfilt.models import LinearModel, Model
from distfilt.network import Faults
from distfilt.sensors import bearing, component

from .families import (
    FAMILIES,
    PRIOR,
    TIMES,
    data,
    make_filter,
    rules,
    still_model,
    team,
    values,
)

EACH = pytest.mark.parametrize("family", FAMILIES)
pytestmark = pytest.mark.filterwarnings("ignore::distfilt.filters.ParticleCollapse")


def same(a: Any, b: Any) -> bool:
    """Whether two states have the same beliefs, to the bit."""
    first = values(a)
    second = values(b)
    return all(np.array_equal(first[n], second[n]) for n in first)


def at(observations: list[Any], k: int) -> list[Any]:
    """Each agent's observation at the k-th time."""
    return [None if o is None else o[k] for o in observations]


@pytest.mark.parametrize(
    ("family", "rule"), [(f, rule) for f in FAMILIES for rule in rules(f)]
)
def test_nobody_notices_beyond_the_neighbours(family: str, rule: Any) -> None:
    """On a path 0-1-2-3-4 a step reaches one link: agents 0, 1, 2 know nothing of agent 4."""
    f, start = make_filter(family, fusion=rule)
    _, seen = data(f.sensors)
    start = f.step(start, TIMES[0], at(seen, 0))
    # Change all of agent 4's belief: covariances stay definite, weights keep their sum.
    changed = {n: v.copy() for n, v in values(start).items()}
    for name, v in changed.items():
        if name == "joint_covariances":
            v[4] *= 3.0
        elif name == "log_weights":
            v[4] = np.roll(v[4], 1)
        else:
            v[4] = 0.5 + 1.2 * v[4]
    fields = {k: getattr(start, k) for k in start.__dataclass_fields__}
    altered = type(start)(**fields | changed)
    now = at(seen, 1)
    other = values(f.step(altered, TIMES[1], now))
    plain = values(f.step(start, TIMES[1], now))
    # Products of a smaller batch round differently, and nothing else may.
    differs = []
    for name, v in plain.items():
        w = other[name]
        assert np.allclose(v[:3], w[:3], rtol=0, atol=1e-13)
        differs.append((v[4] != w[4]).any())
    # The change itself has an effect, so that the test could fail.
    assert any(differs)


@EACH
def test_faults_between_two_times(family: str) -> None:
    """Agent 0's radio is off from 1 s to before 2 s: its neighbour receives nothing at 1 s only."""
    off = Faults(silent=[0], during=[(1.0, 2.0)])
    sensors = [component([0], std=0.5), None]
    f, state = make_filter(family, sensors=sensors, fusion=None, faults=off)
    was_sent = []
    for t in (0.5, 1.0, 2.0):
        before = state.ledger.messages
        state = f.step(state, t, [[0.3], None])
        # The ledger counts messages that were sent; a silent agent sends none.
        n_sent = state.ledger.messages - before
        was_sent.append(bool(n_sent[0]))
    assert was_sent == [True, False, True]


@EACH
@pytest.mark.parametrize("agents", [1, 3])
def test_an_empty_list_is_a_time_without_observations(family: str, agents: int) -> None:
    f, start = make_filter(family, agents=agents)
    expected = f.step(start, TIMES[0], [None] * agents)
    assert same(f.step(start, TIMES[0], []), expected)


@EACH
def test_recorded_scores_by_their_definitions(family: str) -> None:
    f, start = make_filter(family, runs=(3,), agents=3, names=("A", "B", "C"))
    truth, seen = data(f.sensors, (3,))
    run = f.run(start, TIMES, seen, truth=truth)
    states = list(f.steps(start, TIMES, seen))
    assert list(run["agent"].values) == ["A", "B", "C"]
    assert list(run["component"].values) == ["x", "v"]
    assert list(run["unit"].values) == ["m", "m/s"]
    # One entry of the record is computed again from the state, by each score's definition.
    k = 5
    r = 1
    a = 2
    entry = run.isel(time=k, run=r, agent=a)
    true = truth[k, r]
    mean = entry["mean"].values
    state = states[k]
    if family.startswith("gaussian"):
        assert np.allclose(mean, state.means[r, a])
        cov = state.covariances[r, a]
        std = np.sqrt(np.diag(cov))
        crps = metrics.gaussian_crps(mean, std, true)
    else:
        # Members have one weight and the divisor N - 1, weighted particles have none.
        is_weighted = family.startswith("particle")
        w = np.exp(state.log_weights[r, a]) if is_weighted else None
        clouds = state.particles if is_weighted else state.ensembles
        x = clouds[r, a]
        average = np.average(x, axis=0, weights=w)
        assert np.allclose(mean, average, atol=1e-12)
        cov = np.cov(x.T, aweights=w, ddof=0 if is_weighted else 1)
        crps = metrics.crps(x, true, weights=w)
    squared_error = (mean - true) ** 2
    wanted = {
        "squared_error": squared_error,
        "nees": metrics.nees(mean, cov, true),
        "total_squared_error": squared_error.sum(),
        "crps": crps,
        "variance": np.diag(cov),
        "spread": np.sqrt(np.trace(cov)),
    }
    for name, value in wanted.items():
        recorded = entry[name].values
        assert np.allclose(recorded, value, rtol=1e-9, atol=1e-12), name


@EACH
def test_missing_component_is_a_sensor_without_it(family: str) -> None:
    sensors = [team(2)[1]]
    f, start = make_filter(family, sensors=sensors, graph=None)
    y = np.array([0.4, np.nan])
    # NOISE has the variance 0.5 in its first component.
    first = component([0], std=np.sqrt(0.5))
    less, _ = make_filter(family, sensors=[first], graph=None)
    a = f.summarize(f.step(start, 0.5, [y]))
    b = less.summarize(less.step(start, 0.5, [[0.4]]))
    assert np.allclose(a.mean, b.mean, atol=1e-12)
    assert np.allclose(a.variance, b.variance, atol=1e-12)


@EACH
def test_components_missing_in_some_runs_only(family: str) -> None:
    sensors = [team(2)[1]]
    f, start = make_filter(family, sensors=sensors, graph=None, runs=(3,))
    # Run 0 has both components, run 1 one of them, run 2 none.
    y = np.full((3, 2), 0.1)
    y[0, 0] = 0.4
    y[1, 0] = np.nan
    y[2] = np.nan
    missing = f.summarize(f.step(start, 0.5, [y]))
    blind = f.summarize(f.step(start, 0.5, [None]))
    # A run without a number is forecast only; the others learn from theirs.
    assert np.allclose(missing.mean[2], blind.mean[2], atol=1e-12)
    assert np.allclose(missing.variance[2], blind.variance[2], atol=1e-12)
    changes = np.abs(missing.mean - blind.mean)
    largest = changes.max(axis=(1, 2))
    assert (largest[:2] > 1e-3).all()


@EACH
def test_direction_across_pi(family: str) -> None:
    """A truth near the negative x-axis, whose direction jumps between π and −π."""
    still = still_model(2, rate=1e-4)
    direction = bearing([0, 1], std=0.05)
    position = component([0], std=0.1)
    sensors = [direction, position]
    f = make_filter(family, sensors=sensors, model=still)[0]
    centre = np.array([-2.0, 0.0])
    prior = (centre, 0.04 * np.eye(2))
    start = f.start(prior, rng=default_rng(0), runs=(20,))
    rng = default_rng(1)
    truth = centre + 0.02 * rng.standard_normal((20, 2))
    for k in range(10):
        seen = [s.observe(truth, rng=rng) for s in sensors]
        start = f.step(start, k + 1.0, seen)
    summary = f.summarize(start)
    error = summary.mean - truth[:, None]
    # An innovation of nearly 2π in place of nearly 0 would move the mean by metres.
    rms = np.sqrt((error**2).mean(axis=(0, 1)))
    assert rms.max() < 0.09
    assert np.sqrt(summary.variance).max() < 0.12


@EACH
def test_time_passes_to_model_and_noise(family: str) -> None:
    calls: list[tuple[str, float, float]] = []

    # Model and noise depend on t and dt; each step passes its start and its length.
    def transition(x: np.ndarray, t: float, dt: float) -> np.ndarray:
        calls.append(("transition", t, dt))
        return x + t * dt

    def noise(t: float, dt: float) -> np.ndarray:
        calls.append(("noise", t, dt))
        return (0.1 + t) * dt * np.eye(2)

    timed = Model(2, transition, noise)
    f = make_filter(family, sensors=[None], graph=None, model=timed)[0]
    state = f.start(PRIOR, rng=default_rng(0), t=2.0)
    state = f.step(state, 2.5, [None])
    state = f.step(state, 3.5, [None])
    assert {c[1:] for c in calls} == {(2.0, 0.5), (2.5, 1.0)}
    assert {c[0] for c in calls} == {"transition", "noise"}


@EACH
def test_late_reading_is_in_time_after_all(family: str) -> None:
    """Also for the agent that receives it, as near as the number of members allows."""
    nothing = [None] * 2
    last = [[0.1], None]
    sensors = [component([0], std=0.4), None]
    two: dict[str, Any] = {"sensors": sensors, "fusion": None, "runs": (40,)}
    # The first observation arrives after two steps ...
    f, start = make_filter(family, **two, lag=2)
    for t in (0.5, 1.0):
        start = f.step(start, t, nothing)
    delayed = [Observation(0.5, 0, [1.9], arrival_time=1.5)]
    late = f.step(start, 1.5, last, delayed=delayed)
    # ... in its own step ...
    g, begin = make_filter(family, **two)
    begin = g.step(begin, 0.5, [[1.9], None])
    begin = g.step(begin, 1.0, nothing)
    begin = g.step(begin, 1.5, last)
    # ... and never.
    blind = g.start(PRIOR, rng=default_rng(3), runs=(40,))
    blind = g.step(blind, 1.0, nothing)
    blind = g.step(blind, 1.5, last)
    # The average over 40 runs has little sampling error.
    expected = g.summarize(begin).mean.mean(axis=0)
    delayed_mean = f.summarize(late).mean.mean(axis=0)
    blind_mean = g.summarize(blind).mean.mean(axis=0)
    delayed_error = np.abs(delayed_mean - expected)
    blind_error = np.abs(blind_mean - expected)
    assert delayed_error.max() < 0.12 < blind_error.max()


@EACH
def test_a_run_takes_each_late_reading_when_it_arrives(family: str) -> None:
    f, start = make_filter(family, sensors=[component([0], std=0.4)], graph=None, lag=2)
    times = [0.5, 1.0, 1.5, 2.0]
    seen = np.full((4, 1), np.nan)
    seen[1] = 0.3
    seen[3] = 0.1
    # Not in the order of arrival; one arrives between two times.
    arrivals = [2.0, 1.2]
    late = [
        Observation(1.5, 0, [1.1], arrival_time=arrivals[0]),
        Observation(0.5, 0, [1.9], arrival_time=arrivals[1]),
    ]
    run = f.run(start, times, [seen], delayed=late)
    state = start
    for t, y in zip(times, seen, strict=True):
        # A step takes the observations that arrived since the step before.
        due = []
        for observation, arrival in zip(late, arrivals, strict=True):
            if t - 0.5 < arrival <= t:
                due.append(observation)
        state = f.step(state, t, [y], delayed=due)
    assert same(final_state(run), state)
    with pytest.raises(
        ValueError, match="delayed must have an arrival_time up to 1.5, got 2.0"
    ):
        f.run(start, times[:3], [seen[:3]], delayed=late)


@EACH
@pytest.mark.parametrize(("origin", "dt"), [(0.0, 1.0), (1.7e9, 1.0), (0.0, 1e-10)])
def test_a_late_reading_belongs_to_its_own_time(
    family: str, origin: float, dt: float
) -> None:
    """Whatever the clock's zero and its unit; between the times to one that is inserted."""
    # A random walk with unit variance a step, whatever the unit of time
    one = np.eye(1)
    walk = LinearModel.from_transition(1, lambda h: one, lambda t, h: h / dt * one)
    f = FAMILIES[family](walk, [component([0], std=0.1)], None, lag=3)
    prior = (np.zeros(1), one)
    state = f.start(prior, rng=default_rng(0), runs=(20,), t=origin)
    now = origin + 4 * dt
    for k in (1, 2, 3):
        state = f.step(state, origin + k * dt, [None])
    times = [then.t for then in state.lagged_states] + [state.t]

    def late(measured: float) -> list[Observation]:
        return [Observation(measured, 0, [0.0], arrival_time=now)]

    for k in (1, 2):
        # One rounding error beside a time still means that time.
        measured = np.nextafter(times[k + 1], -1)
        after = f.step(state, now, [None], delayed=late(measured))
        # The time of a sharp observation has the smallest variance.
        variances = []
        for then in after.lagged_states:
            variances.append(f.summarize(then).variance.mean())
        assert np.argmin(variances) == k
    between = origin + 2.4 * dt
    after = f.step(state, now, [None], delayed=late(between))
    variances = [f.summarize(then).variance.mean() for then in after.lagged_states]
    assert after.times[np.argmin(variances)] == between
    assert len(after.times) == 3
    # A run that stepped to that time has the same, up to the sampling error of the 20 runs.
    stepped = f.start(prior, rng=default_rng(1), runs=(20,), t=origin)
    for t in (*times[1:3], between, times[3]):
        stepped = f.step(stepped, t, [None])
    expected = f.step(stepped, now, [None], delayed=late(between))
    assert expected.times == after.times
    for then, other in zip(after.lagged_states, expected.lagged_states, strict=True):
        variance = f.summarize(then).variance
        wanted = f.summarize(other).variance
        # Gaussian filters have none.
        sampling_error = np.sqrt((variance.var() + wanted.var()) / 20)
        difference = abs(variance.mean() - wanted.mean())
        assert difference < 4 * sampling_error + 1e-6 * wanted.mean()
    refused = "delayed must be of an earlier time that is kept"
    with pytest.raises(ValueError, match=refused):
        f.step(state, now, [None], delayed=late(origin - 2.4 * dt))


@EACH
def test_smoothing_knows_more(family: str) -> None:
    f, start = make_filter(family, agents=2, lag=4, runs=(30,))
    truth, seen = data(f.sensors, (30,), seed=4)
    run = f.run(start, TIMES, seen, truth=truth)
    smooth = f.smooth(start, TIMES, seen, truth=truth)
    # Early times gain most from later observations.
    filtered_error = run["total_squared_error"].values[:4]
    smoothed_error = smooth["total_squared_error"].values[:4]
    assert smoothed_error.mean() < 0.9 * filtered_error.mean()
    # At the last time nothing is later, and smoothing sends nothing.
    smoothed_mean = smooth["mean"].values
    assert np.array_equal(smoothed_mean[-1], run["mean"].values[-1])
    assert np.array_equal(smooth["scalars"].values, run["scalars"].values)


@EACH
def test_bad_run_is_named_and_others_go_on(family: str) -> None:
    """A model that leaves the numbers in one run of three at the second step."""

    def transition(x: np.ndarray, t: float, dt: float) -> np.ndarray:
        moved = x.copy()
        if t > 0.4 and x.ndim > 2 and x.shape[0] == 3:
            moved[1, 0] = np.nan
        return moved

    eye = np.eye(2)
    broken = Model(
        2, transition, lambda t, dt: dt * eye, derivative=lambda x, t, dt: eye
    )
    sensors = [component([0], std=0.5), component([1], std=0.5)]
    options = {"sensors": sensors, "model": broken, "runs": (3,)}
    f, start = make_filter(family, **options)
    start = f.step(start, 0.5, [[0.1], [0.2]])
    message = r"run 1, agent 0, t = 1 s: the forecast is not finite"
    with pytest.raises(FilterError, match=message):
        f.step(start, 1.0, [[0.1], [0.2]])
    # With on_error="keep" the record has NaN for the failed run from then on, and nothing else.
    g, state = make_filter(family, **options, on_error="keep")
    seen = [np.full((3, 1), 0.1), np.full((3, 1), 0.2)]
    truth = np.zeros((3, 3, 2))
    run = g.run(state, [0.5, 1.0, 1.5], seen, truth=truth)
    means = run["mean"].values
    assert np.isfinite(means[:, [0, 2]]).all()
    assert np.isfinite(means[0]).all()
    recorded = [value.values for value in run.values() if "run" in value.dims]
    assert len(recorded) >= 6
    assert all(np.isnan(value[1:, 1]).all() for value in recorded)
