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
from distfilt.sensors import Sensor, bearing, component

from .families import FAMILIES, PRIOR, TIMES, data, make_filter, rules, team, values

EACH = pytest.mark.parametrize("family", FAMILIES)
pytestmark = pytest.mark.filterwarnings("ignore::distfilt.filters.ParticleCollapse")


def same(a: Any, b: Any) -> bool:
    """Whether two states believe the same, to the bit."""
    first = values(a)
    second = values(b)
    return all((first[n] == second[n]).all() for n in first)


def at(observations: list[Any], k: int) -> list[Any]:
    return [None if o is None else o[k] for o in observations]


@pytest.mark.parametrize(
    ("family", "rule"), [(f, rule) for f in FAMILIES for rule in rules(f)]
)
def test_nobody_notices_beyond_the_neighbours(family: str, rule: Any) -> None:
    """On a path 0-1-2-3-4 a step reaches one link: agents 0, 1, 2 know nothing of agent 4."""
    f, start = make_filter(family, fusion=rule)
    _, seen = data(f.sensors)
    start = f.step(start, TIMES[0], at(seen, 0))
    changed = {n: v.copy() for n, v in values(start).items()}
    for name, v in changed.items():
        if name == "joint_covariances":
            v[4] *= 3.0
        elif name == "log_weights":
            v[4] = np.roll(v[4], 1)
        else:
            v[4] = 0.5 + 1.2 * v[4]
    fields = {k: getattr(start, k) for k in start.__dataclass_fields__} | changed
    other = f.step(type(start)(**fields), TIMES[1], at(seen, 1))
    plain = f.step(start, TIMES[1], at(seen, 1))
    pairs = [(v, values(other)[name]) for name, v in values(plain).items()]
    # Products of a smaller batch round differently, and nothing else may.
    assert all(np.allclose(v[:3], w[:3], rtol=0, atol=1e-13) for v, w in pairs)
    assert any((v[4] != w[4]).any() for v, w in pairs)


@EACH
def test_faults_between_two_times(family: str) -> None:
    """Agent 0's radio is off from 1 s to before 2 s: who hears it is blind at 1 s only."""
    off = Faults(silent=[0], during=[(1.0, 2.0)])
    sensors = [component([0], std=0.5), None]
    f, state = make_filter(family, sensors=sensors, fusion=None, faults=off)
    was_sent = []
    for t in (0.5, 1.0, 2.0):
        before = state
        state = f.step(state, t, [[0.3], None])
        was_sent.append(bool((state.ledger.messages - before.ledger.messages)[0]))
    assert was_sent == [True, False, True]


@EACH
def test_recorded_scores_by_their_definitions(family: str) -> None:
    f, start = make_filter(family, runs=(3,), agents=3, names=("A", "B", "C"))
    truth, seen = data(f.sensors, (3,))
    run = f.run(start, TIMES, seen, truth=truth)
    states = list(f.steps(start, TIMES, seen))
    assert list(run["agent"].values) == ["A", "B", "C"]
    assert list(run["component"].values) == ["x", "v"]
    assert list(run["unit"].values) == ["m", "m/s"]
    k = 5
    r = 1
    a = 2
    entry = run.isel(time=k, run=r, agent=a)
    true = truth[k, r]
    mean = entry["mean"].values
    if family.startswith("gaussian"):
        assert np.allclose(mean, states[k].means[r, a])
        cov = states[k].covariances[r, a]
        crps = metrics.gaussian_crps(mean, np.sqrt(np.diag(cov)), true)
    else:
        w = (
            np.exp(states[k].log_weights[r, a])
            if family.startswith("particle")
            else None
        )
        x = (states[k].ensembles if w is None else states[k].particles)[r, a]
        assert np.allclose(mean, np.average(x, axis=0, weights=w), atol=1e-12)
        cov = np.cov(x.T, aweights=w, ddof=1 if w is None else 0)
        crps = metrics.crps(x, true, weights=w)
    wanted = {
        "squared_error": (mean - true) ** 2,
        "nees": metrics.nees(mean, cov, true),
        "total_squared_error": ((mean - true) ** 2).sum(),
        "crps": crps,
        "variance": np.diag(cov),
        "spread": np.sqrt(np.trace(cov)),
    }
    for name, value in wanted.items():
        assert np.allclose(entry[name].values, value, rtol=1e-9, atol=1e-12), name


@EACH
def test_missing_component_is_a_sensor_without_it(family: str) -> None:
    sensors = [team(2)[1]]
    f, start = make_filter(family, sensors=sensors, graph=None)
    y = np.array([0.4, np.nan])
    less = make_filter(family, sensors=[component([0], std=np.sqrt(0.5))], graph=None)[
        0
    ]
    a = f.step(start, 0.5, [y])
    b = less.step(start, 0.5, [[0.4]])
    assert np.allclose(f.summarize(a).mean, less.summarize(b).mean, atol=1e-12)
    assert np.allclose(f.summarize(a).variance, less.summarize(b).variance, atol=1e-12)


@EACH
def test_components_missing_in_some_runs_only(family: str) -> None:
    sensors = [team(2)[1]]
    f, start = make_filter(family, sensors=sensors, graph=None, runs=(3,))
    y = np.array([[0.4, 0.1], [np.nan, 0.1], [np.nan, np.nan]])
    missing = f.summarize(f.step(start, 0.5, [y]))
    blind = f.summarize(f.step(start, 0.5, [None]))
    assert np.allclose(missing.mean[2], blind.mean[2], atol=1e-12)
    assert np.allclose(missing.variance[2], blind.variance[2], atol=1e-12)
    assert (np.abs(missing.mean[:2] - blind.mean[:2]).max(axis=(1, 2)) > 1e-3).all()


@EACH
def test_direction_across_pi(family: str) -> None:
    """A truth near the negative x-axis, whose direction jumps between π and −π."""
    still = Model(2, lambda x, t, dt: x, lambda t, dt: 1e-4 * dt * np.eye(2))
    sensors: list[Sensor | None] = [
        bearing([0, 1], std=0.05),
        component([0], std=0.1),
    ]
    f = make_filter(family, sensors=sensors, model=still)[0]
    prior = (np.array([-2.0, 0.0]), 0.04 * np.eye(2))
    start = f.start(prior, rng=default_rng(0), runs=(20,))
    rng = default_rng(1)
    truth = np.array([-2.0, 0.0]) + 0.02 * rng.standard_normal((20, 2))
    for k in range(10):
        seen = [s.observe(truth, rng=rng) for s in sensors if s is not None]
        start = f.step(start, k + 1.0, seen)
    summary = f.summarize(start)
    error = summary.mean - truth[:, None]
    assert np.sqrt((error**2).mean(axis=(0, 1))).max() < 0.09
    assert np.sqrt(summary.variance).max() < 0.12


@EACH
def test_time_passes_to_model_and_noise(family: str) -> None:
    calls: list[tuple[str, float, float]] = []

    def flow(x: np.ndarray, t: float, dt: float) -> np.ndarray:
        calls.append(("transition", t, dt))
        return x + t * dt

    def noise(t: float, dt: float) -> np.ndarray:
        calls.append(("noise", t, dt))
        return (0.1 + t) * dt * np.eye(2)

    f = make_filter(family, sensors=[None], graph=None, model=Model(2, flow, noise))[0]
    state = f.start(PRIOR, rng=default_rng(0), t=2.0)
    state = f.step(state, 2.5, [None])
    state = f.step(state, 3.5, [None])
    assert {c[1:] for c in calls} == {(2.0, 0.5), (2.5, 1.0)}
    assert {c[0] for c in calls} == {"transition", "noise"}


@EACH
def test_late_reading_is_in_time_after_all(family: str) -> None:
    """For who heard of it too, as near as the members' number allows."""
    two: dict[str, Any] = {"sensors": [component([0], std=0.4), None], "fusion": None}
    f, start = make_filter(family, **two, lag=2, runs=(40,))
    for t in (0.5, 1.0):
        start = f.step(start, t, [None] * 2)
    late = f.step(
        start,
        1.5,
        [[0.1], None],
        delayed=[Observation(0.5, 0, [1.9], arrival_time=1.5)],
    )
    g, begin = make_filter(family, **two, runs=(40,))
    begin = g.step(begin, 0.5, [[1.9], None])
    begin = g.step(g.step(begin, 1.0, [None] * 2), 1.5, [[0.1], None])
    a = f.summarize(late)
    b = g.summarize(begin)
    blind = g.start(PRIOR, rng=default_rng(3), runs=(40,))
    blind = g.step(g.step(blind, 1.0, [None] * 2), 1.5, [[0.1], None])
    gap = np.abs(a.mean.mean(axis=0) - b.mean.mean(axis=0)).max()
    assert (
        gap
        < 0.12
        < np.abs(g.summarize(blind).mean.mean(axis=0) - b.mean.mean(axis=0)).max()
    )


@EACH
def test_a_run_takes_each_late_reading_when_it_arrives(family: str) -> None:
    f, start = make_filter(family, sensors=[component([0], std=0.4)], graph=None, lag=2)
    times = [0.5, 1.0, 1.5, 2.0]
    seen = np.array([[np.nan], [0.3], [np.nan], [0.1]])
    late = [
        Observation(1.5, 0, [1.1], arrival_time=2.0),
        Observation(0.5, 0, [1.9], arrival_time=1.2),
    ]
    run = f.run(start, times, [seen], delayed=late)
    state = start
    for t, y in zip(times, seen, strict=True):
        due = [
            r
            for r in late
            if r.arrival_time is not None and t - 0.5 < r.arrival_time <= t
        ]
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
    """Whatever the clock's zero and its unit; between the times it belongs to none."""
    walk = LinearModel.from_transition(
        1, lambda h: np.eye(1), lambda t, h: h / dt * np.eye(1)
    )
    f = FAMILIES[family](walk, [component([0], std=0.1)], None, lag=3)
    prior = (np.zeros(1), np.eye(1))
    state = f.start(prior, rng=default_rng(0), runs=(20,), t=origin)
    for k in (1, 2, 3):
        state = f.step(state, origin + k * dt, [None])
    times = [then.t for then in state.lagged_states] + [state.t]

    def late(measured: float) -> list[Observation]:
        return [Observation(measured, 0, [0.0], arrival_time=origin + 4 * dt)]

    for k in (1, 2):
        after = f.step(
            state, origin + 4 * dt, [None], delayed=late(np.nextafter(times[k + 1], -1))
        )
        spread = [f.summarize(then).variance.mean() for then in after.lagged_states]
        assert np.argmin(spread) == k
    with pytest.raises(
        ValueError, match="delayed must be of an earlier time that is kept"
    ):
        f.step(state, origin + 4 * dt, [None], delayed=late(origin + 2.4 * dt))


@EACH
def test_smoothing_knows_more(family: str) -> None:
    f, start = make_filter(family, agents=2, lag=4, runs=(30,))
    truth, seen = data(f.sensors, (30,), seed=4)
    run = f.run(start, TIMES, seen, truth=truth)
    smooth = f.smooth(start, TIMES, seen, truth=truth)
    early = slice(0, 4)
    error = [r["total_squared_error"].values[early].mean() for r in (run, smooth)]
    assert error[1] < 0.9 * error[0]
    assert np.array_equal(smooth["mean"].values[-1], run["mean"].values[-1])
    assert np.array_equal(smooth["scalars"].values, run["scalars"].values)


@EACH
def test_bad_run_is_named_and_others_go_on(family: str) -> None:
    """A model that leaves the numbers in one run of three at the second step."""

    def flow(x: np.ndarray, t: float, dt: float) -> np.ndarray:
        moved = x.copy()
        if t > 0.4 and x.ndim > 2 and x.shape[0] == 3:
            moved[1, 0] = np.nan
        return moved

    broken = Model(
        2, flow, lambda t, dt: dt * np.eye(2), derivative=lambda x, t, dt: np.eye(2)
    )
    sensors = [component([0], std=0.5), component([1], std=0.5)]
    f, start = make_filter(family, sensors=sensors, model=broken, runs=(3,))
    start = f.step(start, 0.5, [[0.1], [0.2]])
    with pytest.raises(
        FilterError, match=r"run 1, agent 0, t = 1 s: the forecast is not finite"
    ):
        f.step(start, 1.0, [[0.1], [0.2]])
    g, state = make_filter(
        family, sensors=sensors, model=broken, runs=(3,), on_error="keep"
    )
    run = g.run(
        state,
        [0.5, 1.0, 1.5],
        [np.full((3, 1), 0.1), np.full((3, 1), 0.2)],
        truth=np.zeros((3, 3, 2)),
    )
    assert np.isfinite(run["mean"].values[:, [0, 2]]).all()
    assert np.isfinite(run["mean"].values[0]).all()
    recorded = [value.values for value in run.values() if "run" in value.dims]
    assert len(recorded) >= 6
    assert all(np.isnan(value[1:, 1]).all() for value in recorded)
