"""The contract of all seven families, through one list: runs, events, gates, contacts, scores."""

from __future__ import annotations

from functools import partial
from itertools import accumulate
from pathlib import Path
from typing import Any

import numpy as np
import pandas
import pytest
import xarray
from numpy.random import default_rng
from scipy.stats import chi2, multivariate_normal, norm

from distfilt import filters
from distfilt.density import Flooding, FokkerPlanck, Grid
from distfilt.filters.record import final_state
from distfilt.mixtures import GaussianMixture, target_fusion
from distfilt.models import LinearModel, lorenz63, rotating_swarm
from distfilt.network import (
    Channel,
    Faults,
    Graph,
    covariance_intersection,
    graphs,
    mean_pull,
)
from distfilt.sensors import Sensor, bearing, component, line_angle

from .families import NOISE, PRIOR, TIMES, Q, data, kalman, model

EYES = [
    component([0], std=0.6),
    Sensor(2, lambda x: x, NOISE, linear=np.eye),
    component([1], std=0.5),
]
NET = graphs.complete(3)
SWARM = rotating_swarm("gibbs")
PLACES = default_rng(1).random((9, 2))
LAW = FokkerPlanck(SWARM, Grid((9, 9)))
SIX = {
    "ensemble": partial(filters.EnsembleFilter.exact, members=30, fusion=None),
    "gaussian": filters.GaussianFilter,
    "particle": partial(filters.ParticleFilter, members=300),
    "transport": partial(filters.TransportFilter, members=30),
    "mixture": partial(
        filters.MixtureFilter, target_dim=2, fusion=partial(target_fusion, target_dim=2)
    ),
    "news": partial(filters.InformationIncrementFilter, target_dim=2),
}
EACH = pytest.mark.parametrize("family", [*SIX, "density"])
OF_SIX = pytest.mark.parametrize("family", SIX)


def make_filter(
    family: str, times: Any = TIMES, **options: Any
) -> tuple[Any, Any, Any, Any]:
    """A filter, its first state, the readings agent by agent, and the truth."""
    if family == "density":
        path = SWARM.simulate(PLACES, times, rng=default_rng(2), substeps=2)
        arguments = {"fusion": Flooding(), "bandwidth": 0.15, "rank": 20} | options
        f: Any = filters.DensityFilter(LAW, 9, arguments.pop("graph", 0.5), **arguments)
        return f, f.start(PLACES), path.swapaxes(0, 1), LAW.evolve(np.ones(81), times)
    truth, seen = data(options.get("sensors", EYES))
    arguments = {"graph": NET, "sensors": EYES} | options
    f = SIX[family](
        model(), arguments.pop("sensors"), arguments.pop("graph"), **arguments
    )
    seen = [None if s is None else s[: len(times)] for s in seen]
    return f, f.start(PRIOR, rng=default_rng(0)), seen, truth[: len(times)]


@EACH
def test_a_run_is_its_steps_whether_saved_or_not(family: str, tmp_path: Path) -> None:
    """With as many times as agents, so that a series cannot be taken for its transpose."""
    times = TIMES[: 9 if family == "density" else 3]
    options: dict[str, Any] = (
        {} if family == "transport" else {"faults": Faults(loss=0.4, seed=5)}
    )
    if family in ("ensemble", "gaussian", "particle"):
        options["lag"] = 1
    f, start, seen, truth = make_filter(family, times, **options)
    run = f.run(start, times, seen, truth=truth)
    state = start
    for k, t in enumerate(times):
        state = f.step(state, t, [s[k] for s in seen])
        state.save(tmp_path / "state.npz")
        state = type(state).load(tmp_path / "state.npz")
        if t < times[-1]:  # a record of several states at once has each one's numbers
            remainder = f.run(
                state, times[k + 1 :], [s[k + 1 :] for s in seen], truth=truth[k + 1 :]
            )
            xarray.testing.assert_allclose(
                remainder, run.isel(time=slice(k + 1, None)), 1e-9, 1e-12
            )
            xarray.testing.assert_equal(remainder["mean"], run["mean"][k + 1 :])
        repeated = f.summarize(state)
        assert np.array_equal(run["mean"].values[k], repeated.mean, equal_nan=True)
        assert np.array_equal(
            run["variance"].values[k], repeated.variance, equal_nan=True
        )
        for name in ("rounds", "messages", "scalars", "bytes", "lost"):
            total = run[f"{name}_total"].values
            assert np.array_equal(total[k], getattr(state.ledger, name))
            assert np.array_equal(total, np.cumsum(run[name].values, axis=0))
    assert (
        run["squared_error"].values == (run["mean"].values - truth[:, None]) ** 2
    ).all()
    assert len(repr(state)) < 200
    assert f"t={times[-1]:g}" in repr(state)


@OF_SIX
def test_events_of_any_order_are_the_series(family: str) -> None:
    f, start, seen, _ = make_filter(family)
    pairs = [
        (a, *pair) for a, s in enumerate(seen) for pair in zip(TIMES, s, strict=True)
    ]
    events = [filters.Observation(t, a, y) for a, t, y in pairs]
    mixed = [events[k] for k in default_rng(0).permutation(len(events))]
    a = f.run(start, TIMES, seen)
    b = f.run(start, None, mixed)
    xarray.testing.assert_equal(a, b)
    xarray.testing.assert_equal(
        a, f.run(start, TIMES, [pandas.DataFrame(s) for s in seen])
    )
    gaps = [[None, *s[1:]] for s in seen]
    subset = [np.concatenate([s[:1] * np.nan, s[1:]]) for s in seen]
    xarray.testing.assert_equal(f.run(start, TIMES, gaps), f.run(start, TIMES, subset))
    more = f.run(start, [0.05, TIMES[-1] + 1], mixed)
    assert more["time"].size == len(TIMES) + 2
    assert (
        more["mean"].isel(time=slice(1, 2)).shape
        == a["mean"].isel(time=slice(0, 1)).shape
    )


@pytest.mark.parametrize("options", [{}, {"fusion": partial(mean_pull, gain=0.0)}])
def test_particles_that_hear_all_are_the_joint_filter(options: Any) -> None:
    """Up to the sampling error of their number, with and without a fusion."""
    f, start, seen, _ = make_filter("particle", **options)
    exact, _ = kalman(seen, EYES)
    for k, state in enumerate(f.steps(start, TIMES, seen)):
        result = f.summarize(state)
        assert np.abs(result.mean - exact.means[k]).max() < 0.3
        assert np.abs(result.covariance - exact.covariances[k]).max() < 0.3


@OF_SIX
def test_units_change_nothing(family: str) -> None:
    """A state in millimetres in place of metres, to the rounding of a long product."""
    big = 1e3
    wide = LinearModel.from_transition(
        2, model().transition_matrix, lambda t, dt: big**2 * dt * Q
    )
    eyes = [
        component([0], std=0.6 * big),
        component([1], std=0.5 * big),
        component([0], std=0.3 * big),
    ]
    f, start, seen, _ = make_filter(
        family,
        sensors=[
            component([0], std=0.6),
            component([1], std=0.5),
            component([0], std=0.3),
        ],
    )
    g = SIX[family](wide, eyes, NET)
    first = (big * PRIOR[0], big**2 * PRIOR[1])
    a = f.run(start, TIMES, seen)
    b = g.run(g.start(first, rng=default_rng(0)), TIMES, [big * s for s in seen])
    assert np.allclose(big * a["mean"], b["mean"], rtol=1e-6, atol=1e-6 * big)
    assert np.allclose(big * a["spread"], b["spread"], rtol=1e-6)


@pytest.mark.parametrize("family", ["gaussian", "mixture", "news", "density"])
def test_the_order_of_agents_changes_nothing(family: str) -> None:
    f, start, seen, _ = make_filter(family)
    order = default_rng(4).permutation(len(seen))
    if family == "density":
        g = f
        begin = f.start(PLACES[order])
    else:
        g = SIX[family](model(), [EYES[k] for k in order], NET)
        begin = g.start(PRIOR)
    a = f.run(start, TIMES, seen)
    b = g.run(begin, TIMES, [seen[k] for k in order])
    assert np.allclose(a["mean"].values[:, order], b["mean"].values, atol=1e-10)
    assert np.allclose(a["variance"].values[:, order], b["variance"].values, atol=1e-10)


@pytest.mark.parametrize("family", SIX)
def test_the_gate_lets_pass_what_its_share_says(family: str) -> None:
    """Just inside the quantile a reading counts, just outside it is left out and counted."""
    f, start, _, _ = make_filter(
        family, sensors=[component([0, 1], std=0.6), None, None], gate_probability=0.95
    )
    start = f.step(
        start, 0.0, [[0.4, np.nan], None, None]
    )  # particles differ in weight since
    blind = f.summarize(f.step(start, 0.1, [None] * 3))
    cov = (
        np.cov(blind.members[0].T) if blind.covariance is None else blind.covariance[0]
    )
    s = cov + 0.36 * np.eye(2)
    way = np.array([1.0, -1.0])
    two = np.sqrt(chi2.ppf(0.95, 2) / (way @ np.linalg.solve(s, way))) * way
    for edge in (np.array([np.sqrt(chi2.ppf(0.95, 1) * s[0, 0]), np.nan]), two):
        for factor, refused in ((0.999, 0), (1.001, 1)):
            after = f.step(start, 0.1, [blind.mean[0] + factor * edge, None, None])
            assert after.rejected[0] == refused
            same = np.allclose(f.summarize(after).mean[0], blind.mean[0], atol=1e-12)
            assert same == bool(refused)
    # Straight behind a direction predictions lie on both sides of where its residuals jump.
    arguments = {
        "sensors": [bearing([0, 1], std=0.05), None, None],
        "gate_probability": 0.99,
    }
    f = make_filter(
        family,
        **arguments | ({"linearization": "unscented"} if family == "gaussian" else {}),
    )[0]
    start = f.start((np.array([9.0, 0.0]), 0.2 * np.eye(2)), rng=default_rng(0))
    assert f.step(start, 0.01, [[np.pi], None, None]).rejected[0] == 1


def test_each_reading_is_judged_alone() -> None:
    """Of two readings that an agent has, its own and a neighbour's, only the wild one goes."""
    f, start, _, _ = make_filter("gaussian", gate_probability=0.999)
    plain = make_filter("gaussian")[0]
    good = [0.9]
    wild = [0.8, 40.0]
    a = f.step(start, 0.1, [good, wild, None])
    b = plain.step(start, 0.1, [good, None, None])
    assert a.rejected.tolist() == [1, 1, 1]
    assert np.array_equal(a.means, b.means)
    run = f.run(start, [0.1], [[good], [wild], None])
    assert run["rejected"].values.tolist() == [[1, 1, 1]]
    f, start, _, _ = make_filter("gaussian", gate_probability=0.999, lag=1)
    blind = f.step(start, 0.1, [None] * 3)
    late = filters.Observation(0.1, 0, [40.0])
    assert f.step(blind, 0.4, [None, wild, None], delayed=[late]).rejected.tolist() == [
        2,
        2,
        2,
    ]
    still = LinearModel.from_transition(
        1, lambda h: np.eye(1), lambda t, h: np.zeros((1, 1))
    )
    bowl = Sensor(
        1, np.square, [[0.5]]
    )  # of N(0, 1): mean 1, variance 1 by the points, slope 0
    f = filters.GaussianFilter(
        still, [bowl], linearization="unscented", gate_probability=0.95
    )
    edge = np.sqrt(1.5 * chi2.ppf(0.95, 1))
    start = f.start((np.zeros(1), np.eye(1)))
    assert f.start(norm(1.0, 3.0)).covariances[0, 0, 0] == 9.0
    refused = [
        f.step(start, 1.0, [[1 + k * edge]]).rejected.tolist() for k in (0.97, 1.03)
    ]
    assert refused == [[0.0], [1.0]]


@pytest.mark.parametrize("t0", [0.0, 1.7e9])
@pytest.mark.parametrize("family", ["gaussian", "news"])
def test_nothing_is_lost_until_the_next_contact(family: str, t0: float) -> None:
    """After it everybody has the belief of one filter of all observations; before, its own."""
    quiet = LinearModel.from_transition(
        2, model().transition_matrix, lambda t, dt: 0 * Q
    )
    lag = {"lag": 8} if family == "gaussian" else {}
    f = SIX[family](quiet, EYES, NET, exchange_interval=0.2, **lag)
    g = filters.GaussianFilter(quiet, EYES, NET)
    private = filters.GaussianFilter(quiet, EYES, NET, share_observations=False)
    seen = [s[:5] for s in data(EYES)[1]]
    # Multiples of .2 lie in the third step and, rounded, in the fourth, which is once.
    times = t0 + np.array([0.1, 0.15, 0.5, 0.6, 0.65])
    contacts = [2, 3]
    walks = (h.steps(h.start(PRIOR, t=t0), times, seen) for h in (f, g, private))
    states, everything, single = map(list, walks)
    for k in range(5):
        spoke = states[k].ledger.rounds - (states[k - 1].ledger.rounds if k else 0)
        assert spoke == (k in contacts)
        wanted = (
            everything[k] if k in contacts else single[k] if k < contacts[0] else None
        )
        if wanted is not None:
            result = f.summarize(states[k])
            assert np.allclose(result.mean, wanted.means, atol=1e-9)
            assert np.allclose(result.covariance, wanted.covariances, atol=1e-9)


def test_what_was_heard_is_not_told_as_one_s_own() -> None:
    """Agent 0 hears agent 1 at first, and is heard by nobody; then all hear all."""
    quiet = LinearModel.from_transition(
        2, model().transition_matrix, lambda t, dt: 0 * Q
    )
    one_way = Graph.from_edges(3, [(0, 1)], directed=True)
    (_, seen) = data(EYES)
    f = filters.InformationIncrementFilter(
        quiet, EYES, lambda t: NET if t > 0.95 else one_way, target_dim=2
    )
    result, expected = (
        h.run(h.start(PRIOR), TIMES[:4], [s[:4] for s in seen])["covariance"][-1, :2]
        for h in (f, filters.GaussianFilter(quiet, EYES, NET))
    )
    assert np.allclose(result, expected, atol=1e-9)


def test_what_waits_survives_on_disk_and_a_lag_has_to_reach_it(tmp_path: Path) -> None:
    f, start, seen, _ = make_filter("gaussian", exchange_interval=1.0, lag=8)
    states = list(f.steps(start, TIMES, seen))
    assert states[0].pending
    assert not states[3].pending
    states[1].save(tmp_path / "s.npz")
    for s in seen:
        s[:2] = 9.0  # a buffer that is filled again does not change the pending values
    for resumed in (states[1], type(start).load(tmp_path / "s.npz")):
        for k in (2, 3):
            resumed = f.step(resumed, TIMES[k], [s[k] for s in seen])
        assert np.array_equal(resumed.joint_means, states[3].joint_means)
    short, start, seen, _ = make_filter("gaussian", exchange_interval=1.0, lag=1)
    with pytest.raises(
        ValueError, match="lag must be at least 1 for observations that wait"
    ):
        make_filter("gaussian", exchange_interval=1.0)
    with pytest.raises(ValueError, match="lag must reach back to t = 0"):
        short.run(start, TIMES, seen)


@EACH
def test_truth_of_each_agent_and_of_named_components(family: str) -> None:
    f, start, seen, truth = make_filter(family)
    common = f.run(start, TIMES, seen, truth=truth)
    each = np.repeat(truth[:, None], len(seen), axis=1)
    xarray.testing.assert_equal(common, f.run(start, TIMES, seen, truth=each))
    table = pandas.DataFrame(truth, columns=f.components[0]).iloc[:, ::-1]
    xarray.testing.assert_allclose(common, f.run(start, TIMES, seen, truth=table))
    name = f.components[0][1]
    partial_truth = f.run(start, TIMES, seen, truth={name: truth[:, 1]})
    one = partial_truth["squared_error"].sel(component=name)
    assert np.array_equal(one, common["squared_error"].sel(component=name))
    assert partial_truth["squared_error"].isel(component=0).isnull().all()
    if "nees" in partial_truth and "covariance" in partial_truth:
        assert np.allclose(
            partial_truth["nees"], one / partial_truth["variance"].sel(component=name)
        )
    for wrong, text in (
        ({"speed": truth[:, 1]}, "have components"),
        (truth[:, :1], "be .*or a dict of"),
    ):
        with pytest.raises(ValueError, match=f"truth must {text}"):
            f.run(start, TIMES, seen, truth=wrong)


@EACH
def test_a_selection_has_no_wrong_state(family: str) -> None:
    f, start, seen, _ = make_filter(family)
    run = f.run(start, TIMES, seen)
    last = final_state(run)
    assert last.t == TIMES[-1]
    assert final_state(run.copy()) is last
    assert final_state(run.assign(x=1)) is last
    assert np.array_equal(
        f.summarize(final_state(run.copy(deep=True))).mean, f.summarize(last).mean
    )
    assert final_state(run.isel(time=slice(3, None))) is last
    for part in (
        run.isel(time=slice(2)),
        run.isel(agent=[0]),
        run[["variance"]],
        run.isel(agent=[1, 0, *range(2, len(seen))]),
    ):
        with pytest.raises(ValueError, match="one without a state"):
            final_state(part)


def test_a_state_and_a_reading_of_another_are_refused() -> None:
    f, start, seen, _ = make_filter("gaussian")
    with pytest.raises(ValueError, match="state must be a GaussianState"):
        f.step(make_filter("particle")[1], 0.1, seen)
    g, other, _, _ = make_filter("ensemble")
    with pytest.raises(ValueError, match="state must have sizes"):
        g.step(
            filters.EnsembleFilter(model(), EYES, NET, members=7).start(
                PRIOR, rng=default_rng(0)
            ),
            0.1,
            [None] * 3,
        )
    for reading in (
        filters.Observation(0.1, 1, [0.3]),
        filters.Observation(0.2, 0, [0.3]),
    ):
        with pytest.raises(
            ValueError, match=r"observations\[0\] must be an Observation of agent 0 at"
        ):
            f.step(start, 0.1, [reading, None, None])


def test_a_prior_of_any_kind() -> None:
    f, _, _, _ = make_filter("gaussian")
    frozen = multivariate_normal(*PRIOR)
    mixture = GaussianMixture.gaussian(*PRIOR)
    members = frozen.rvs(size=50, random_state=default_rng(0))
    for prior in (PRIOR, [*PRIOR], frozen, mixture):
        state = f.start(prior)
        assert np.allclose(state.means, PRIOR[0])
        assert np.allclose(state.covariances, PRIOR[1])
    assert np.allclose(f.start(members).covariances, np.cov(members.T))
    flat = (PRIOR[0], np.diag([1.0, 0.0]))
    unscented = filters.GaussianFilter(model(), EYES, NET, linearization="unscented")
    for g, wrong, text in (
        (f, lambda n, rng, leading: None, "got a function"),
        (f, ([0.0, 0.0], [1.0, 1.0]), r"have a covariance of .*, got \(2,\)"),
        (unscented, flat, "definite"),
        (make_filter("mixture")[0], flat, "definite"),
    ):
        with pytest.raises(ValueError, match=f"prior must .*{text}"):
            g.start(wrong)
    rng = default_rng(1)
    e = filters.EnsembleFilter(model(), EYES, NET, members=4000)
    with pytest.raises(
        ValueError, match=r"prior must have shape \(3, 4000, 2\), got \(3, 4000, 3\)"
    ):
        e.start(multivariate_normal(np.zeros(3)), rng=rng)
    two = GaussianMixture([0.5, 0.5], [[-3.0, 0.0], [3.0, 0.0]], [np.eye(2)] * 2)
    for prior, cov in ((PRIOR, PRIOR[1]), (frozen, PRIOR[1]), (two, two.cov)):
        x = e.start(prior, rng=rng, runs=(2,)).ensembles
        assert x.shape == (2, 3, 4000, 2)
        assert np.allclose(np.cov(x[1, 2].T), cov, atol=0.5)
    m = filters.MixtureFilter(model(), EYES, target_dim=2)
    begun = m.start([PRIOR, frozen, two]).mixtures
    assert [b.n_components for b in begun] == [1, 1, 2]


def test_degrees_are_told() -> None:
    f = filters.GaussianFilter(model(), [line_angle([0, 1], std=0.1), None, None], NET)
    with pytest.warns(
        RuntimeWarning, match=r"^observations\[0\] must .* rad, got some 14 turns"
    ):
        f.run(f.start(PRIOR), [1.0], [np.array([[89.6]]), None, None])


def test_the_extended_filter_bears_its_own_rounding() -> None:
    chaos = lorenz63()
    f = filters.GaussianFilter(chaos, [component([0, 1, 2], std=1.0)])
    times = np.arange(1, 401) * 0.01
    start = [1.0, 1.0, 20.0]
    truth = np.array(
        list(accumulate(times, lambda x, _: chaos.step(x, 0.0, 0.01), initial=start))
    )
    run = f.run(f.start((start, np.eye(3))), times, [truth[1:]], truth=truth[1:])
    assert float(run["total_squared_error"][-1, 0]) < 0.1


def test_inflation_widens_the_forecast_and_goes_with_fusion_and_the_past() -> None:
    wide = filters.GaussianFilter(model(), EYES, NET, inflation=1.3, lag=2)
    plain = filters.GaussianFilter(model(), EYES, NET, lag=2)
    with pytest.raises(ValueError, match="^inflation must be at least 0.5, got 0.05"):
        filters.GaussianFilter(model(), EYES, NET, inflation=0.05)
    a, b = (f.step(f.start(PRIOR), 0.5, [None] * 3) for f in (wide, plain))
    assert np.allclose(a.covariances, 1.69 * b.covariances)
    assert np.allclose(
        a.joint_covariances[..., :2, 2:], 1.3 * b.joint_covariances[..., :2, 2:]
    )
    assert np.allclose(
        a.joint_covariances[..., 2:, 2:], b.joint_covariances[..., 2:, 2:]
    )
    f = filters.GaussianFilter(
        model(), EYES, NET, inflation=1.3, fusion=covariance_intersection
    )
    c = f.step(f.start(PRIOR), 0.5, [None] * 3)
    assert np.allclose(c.covariances, a.covariances)
    # The past follows the fused present by its regression on it: m + G Δm and P + G ΔP Gᵀ.
    c, b = (
        f.step(f.start(PRIOR), 0.5, [[0.3], [0.2, 0.4], [0.9]])
        for f in (
            filters.GaussianFilter(
                model(), EYES, NET, lag=1, share_observations=False, fusion=rule
            )
            for rule in (covariance_intersection, None)
        )
    )
    p = c.joint_covariances
    unfused = b.joint_covariances
    shift = c.joint_means - b.joint_means
    fused = covariance_intersection((b.means, b.covariances), Channel(NET))
    gain = unfused[..., 2:, :2] @ np.linalg.inv(unfused[..., :2, :2])
    assert np.allclose(p[..., 2:, :2], gain @ p[..., :2, :2])
    assert np.allclose(
        (p - unfused)[..., 2:, 2:], gain @ (p - unfused)[..., :2, :2] @ gain.mT
    )
    assert np.allclose(shift[..., 2:, None], gain @ shift[..., :2, None])
    assert np.allclose(c.means, fused[0])
    assert np.allclose(c.covariances, fused[1])
