"""Angles and circles: declared periods, or sensors that wrap, in every family.

| Report | Situation |
|---|---|
| usdot-fhwa-stol/multiple_object_tracking 143 | headings on both sides of the cut, fused |
| cra-ros-pkg/robot_localization 237 | the gate refuses an angle on the other side of the cut |
| rlabbe/filterpy 197 | the angle is a state too, also in smoothing |
| ApolloAuto/apollo 5304 | 359° predicted, 1° measured: a period of 360 |
| manankharwar/fusioncore 92 | points of the prediction straddle the cut |
| PointCloudLibrary/pcl 5538 | the mean of particles whose rotations straddle the cut |
| mathnet/mathnet-filtering pull 27 | members and mixtures of a prior on both sides of the cut |
| rlabbe/Kalman-and-Bayesian-Filters-in-Python 407 | components that part and meet |
| PX4/PX4-Autopilot pull 21287 | a likelihood of a heading, and a gate beside it |
| own | a prior wider than the circle; increments; delayed observations; truth with a cut |

Right values are those of the same problem turned away from the cut, or of scalar formulas.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from distfilt import filters, network
from distfilt.filters import (
    EnsembleFilter,
    GaussianFilter,
    InformationIncrementFilter,
    MixtureFilter,
    Observation,
    ParticleFilter,
    TransportFilter,
)
from distfilt.filters.step import predict_points
from distfilt.mixtures import GaussianMixture, target_fusion
from distfilt.models import LinearModel, Model, pendulum_angle
from distfilt.network import Channel, graphs
from distfilt.sensors import (
    LikelihoodSensor,
    Sensor,
    bearing,
    component,
    increment,
    line_angle,
    stack,
    wrap,
)
from distfilt.updates import (
    enkf_exact,
    etkf,
    etpf,
    serially,
    transport_map_update,
)
from distfilt.validation import InvalidArgumentError

TURN = 2 * np.pi
PAGE = Path(__file__).parents[2] / "book" / "angles.md"

FAMILIES: dict[str, Callable[..., Any]] = {
    "extended": GaussianFilter,
    "unscented": partial(GaussianFilter, linearization="unscented"),
    "ensemble": partial(EnsembleFilter, members=500),
    "exact": partial(EnsembleFilter.exact, members=200),
    "square root": partial(EnsembleFilter, update=etkf, members=500),
    "maps": partial(EnsembleFilter, update=transport_map_update, members=500),
    "serial": partial(EnsembleFilter, update=serially(enkf_exact), members=200),
    "coupling": partial(EnsembleFilter, update=etpf, members=300),
    "particle": partial(ParticleFilter, members=3000),
    "transport": partial(TransportFilter, members=300),
    "mixture": partial(MixtureFilter, target_dim=1),
    "increments": partial(
        InformationIncrementFilter, target_dim=1, graph=graphs.path(1)
    ),
}
HAS_LAG = [name for name in FAMILIES if name not in ("mixture", "increments")]
GAUSSIAN = ("extended", "unscented", "mixture", "increments")
"""Families whose result is exact here but for rounding."""


def still(dim: int = 1, periods: Any = (TURN,), noise: float = 0.0) -> Model:
    return Model(
        dim,
        lambda x, t, dt: x,
        lambda t, dt: noise * dt * np.eye(dim),
        periods=periods,
    )


def compass(std: float = 0.1, *, place: int = 0, cut: bool = False) -> Sensor:
    """A compass as users write it: a plain component, or an angle in [-π, π)."""

    def read(x: np.ndarray) -> np.ndarray:
        angle = x[..., place : place + 1]
        return wrap(angle) if cut else angle

    return Sensor(1, read, [[std**2]], periods=(TURN,))


def start(f: Any, mean: Any, cov: Any, **options: Any) -> Any:
    return f.start((mean, cov), rng=np.random.default_rng(1), **options)


def tolerance(family: str) -> float:
    return 1e-6 if family in GAUSSIAN else 0.03


def quietly(function: Callable[..., Any], *args: Any, **options: Any) -> Any:
    """Weights of few members may collapse, which is not the matter here."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return function(*args, **options)


# The observation ------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["plain", "linear", "cut", "residual"])
@pytest.mark.parametrize("family", FAMILIES)
def test_an_observation_beyond_the_cut(family: str, kind: str) -> None:
    """3.1 ± 0.1 and -3.1 ± 0.1: halfway, at ±π, by scalar arithmetic (case d01)."""
    sensor = compass(cut=kind == "cut")
    periods: Any = (TURN,)
    if kind == "linear":
        sensor = component([0], std=0.1, periods=(TURN,))
    elif kind == "residual":
        sensor = Sensor(
            1,
            lambda x: x[..., :1],
            [[0.01]],
            residual_function=lambda a, b: wrap(a - b),
            linear=lambda d: np.eye(d)[:1],
        )
        periods = ()
    f = FAMILIES[family](still(periods=periods), [sensor], gate_probability=0.999)
    state = quietly(f.step, start(f, [3.1], [[0.01]]), 0.0, [[-3.1]])
    summary = f.summarize(state)
    # Equal variances of 0.01 give the mean of both angles, and 1 / (1/0.01 + 1/0.01) = 0.005.
    assert abs(wrap(summary.mean[0, 0] - np.pi)) < tolerance(family)
    assert abs(summary.variance[0, 0] - 0.005) < max(tolerance(family) / 20, 1e-6)
    # cra-ros-pkg/robot_localization 237: the gate takes the shorter way.
    assert not state.rejected.any()
    if periods:
        assert -np.pi <= summary.mean[0, 0] < np.pi


@pytest.mark.parametrize("std", [1.0, 2.0])
@pytest.mark.parametrize("kind", ["plain", "linear", "cut", "residual"])
@pytest.mark.parametrize("family", FAMILIES)
def test_a_vague_heading(family: str, kind: str, std: float) -> None:
    """0 ± 1 rad (or 2, wider than the circle), and a compass of 1.5 ± 0.1 (case d05)."""
    more: dict[str, Any] = {"periods": (TURN,)}
    if kind == "linear":
        more["linear"] = lambda d: np.eye(d)[2:]
    elif kind == "residual":
        more = {"residual_function": lambda a, b: wrap(a - b)}

    def point(x: np.ndarray) -> np.ndarray:
        heading = x[..., 2:]
        return wrap(heading) if kind == "cut" else heading

    sensor = Sensor(1, point, [[0.01]], **more)
    model = still(3, periods=() if kind == "residual" else {2: TURN})
    on_circle = family in ("particle", "transport", "coupling")
    if kind == "residual" and on_circle and std > 1:
        pytest.skip("without a declared period such members are whole turns apart")
    f = FAMILIES[family](model, [sensor])
    state = start(f, np.zeros(3), np.diag([1.0, 1.0, std**2]))
    after = quietly(f.step, state, 0.0, [[1.5]])
    summary = f.summarize(after)
    # The scalar Kalman filter on the line: m = K y and P = K R with K = P₀ / (P₀ + R)
    gain = std**2 / (std**2 + 0.01)
    expected_std = np.sqrt(gain * 0.01)
    allowed = 1e-6 if family in GAUSSIAN else 0.05
    assert abs(summary.mean[0, 2] - gain * 1.5) < allowed
    std_error = abs(np.sqrt(summary.variance[0, 2]) - expected_std)
    assert std_error < max(allowed / 2, 1e-6)


@pytest.mark.parametrize("family", FAMILIES)
def test_points_that_straddle_the_cut_of_a_bearing(family: str) -> None:
    """manankharwar/fusioncore 92: the same as with the scene turned by a right angle."""
    turned = []
    rotations = (np.eye(2), np.array([[0.0, -1.0], [1.0, 0.0]]))
    for rotation in rotations:
        f = FAMILIES[family](
            still(2, periods=()), [bearing([0, 1], std=0.05)], gate_probability=0.999
        )
        # The observation is 0.02 beyond the negative x axis, the state 0.05 / 3 before it.
        state = start(f, rotation @ [-3.0, 0.05], 0.01 * np.eye(2))
        angle = np.pi + 0.02 + np.arctan2(rotation[1, 0], rotation[0, 0])
        state = quietly(f.step, state, 0.0, [wrap([angle])])
        turned.append(rotation.T @ f.summarize(state).mean[0])
        assert not state.rejected.any()
    assert np.abs(turned[0] - turned[1]).max() < max(1e-9, tolerance(family))


@pytest.mark.parametrize("family", FAMILIES)
def test_a_period_of_360(family: str) -> None:
    """ApolloAuto/apollo 5304: 359° predicted, 1° measured, equal weights: 0°."""
    sensor = component([0], std=2.0, periods=(360.0,))
    f = FAMILIES[family](still(periods=(360.0,)), [sensor])
    state = quietly(f.step, start(f, [359.0], [[4.0]]), 0.0, [[1.0]])
    # In degrees all numbers are some thirty times larger than in the other tests.
    assert abs(f.summarize(state).mean[0, 0]) < 30 * tolerance(family)


def test_sensors_of_angles_keep_their_periods_in_a_stack() -> None:
    """The residual wraps in its own parts only, whatever the lengths of the parts are."""
    sensor = stack(
        [
            bearing([0, 1], std=0.1),
            component([0, 1], std=0.1),
            increment([1], std=0.1, periods=(TURN,)),
        ]
    )
    residual = sensor.residual([3.0, 9.0, 9.0, 6.0], [-3.0, 0.0, 0.0, 0.0])
    # The first and the last number are angles, and the two between them lengths.
    assert np.allclose(residual, [6 - TURN, 9.0, 9.0, 6.0 - TURN])


@pytest.mark.parametrize(
    "family", ["ensemble", "exact", "particle", "transport", "square root"]
)
def test_an_increment_over_the_cut(family: str) -> None:
    """From 3.1 ± 0.3 by a measured 0.2: 3.3 - 2π, whether the number is 0.2 or 0.2 - 2π."""
    model = Model(
        1,
        lambda x, t, dt: wrap(x),
        lambda t, dt: 0.04 * dt * np.eye(1),
        periods=(TURN,),
    )
    for value in (0.2, 0.2 - TURN):
        f = FAMILIES[family](model, [increment([0], std=0.01, periods=(TURN,))])
        state = quietly(f.step, start(f, [3.1], [[0.09]]), 1.0, [[value]])
        # The process noise of 0.2 is all explained by the increment; the start is not observed.
        mean = f.summarize(state).mean[0, 0]
        assert abs(wrap(mean - 3.3)) < 0.06


# The transition -------------------------------------------------------------------------


@pytest.mark.parametrize("cut", [False, True])
@pytest.mark.parametrize("family", FAMILIES)
def test_a_transition_that_wraps_is_one_that_runs_on(family: str, cut: bool) -> None:
    """A turn through π, also with a truth that wraps (cases d06 and d07)."""
    times = np.arange(1.0, 21.0)
    truth = 2.9 + 0.1 * times[:, None]
    noise = 0.1 * np.random.default_rng(3).standard_normal(truth.shape)

    def turn(x: np.ndarray, t: float, dt: float) -> np.ndarray:
        moved = x + 0.1 * dt
        return wrap(moved) if cut else moved

    model = Model(1, turn, lambda t, dt: 1e-3 * dt * np.eye(1), periods=(TURN,))
    f = FAMILIES[family](model, [compass(cut=cut)], gate_probability=0.99999)
    state = start(f, [2.9], [[0.04]])
    runs = [
        quietly(f.run, state, times, [wrap(truth + noise)], truth=truth),
        quietly(f.run, state, times, [truth + noise], truth=wrap(truth)),
    ]
    # The Kalman filter, on the line: P + q, K = P / (P + R), and (1 - K) P.
    allowed = max(tolerance(family), 1e-6) * 1.5
    mean = 2.9
    p = 0.04
    for k, y in enumerate((truth + noise)[:, 0]):
        p += 1e-3
        gain = p / (p + 0.01)
        predicted = mean + 0.1
        mean = predicted + gain * (y - predicted)
        p *= 1 - gain
        estimate = runs[0]["mean"].values[k, 0, 0]
        assert -np.pi <= estimate < np.pi
        assert abs(wrap(estimate - mean)) < allowed
    # Whether the truth or the observations wrap, the scores are those of the shorter way.
    for name in ("squared_error", "nees", "crps"):
        first = runs[0][name].values
        second = runs[1][name].values
        assert np.allclose(first, second, atol=1e-9)
    assert runs[0]["squared_error"].values.max() < 0.1
    assert runs[0]["crps"].values.max() < 0.3


@pytest.mark.parametrize("family", HAS_LAG)
def test_smoothing_and_delayed_observations_over_the_cut(family: str) -> None:
    """rlabbe/filterpy 197: as the same turn far from the cut."""
    times = np.arange(1.0, 9.0)
    results = []
    # From 2.9 the turn crosses the cut at 3.14, from 0.9 it does not.
    for offset in (0.0, 2.0):
        truth = 2.9 - offset + 0.1 * times[:, None]
        model = Model(
            1,
            lambda x, t, dt: wrap(x + 0.1 * dt),
            lambda t, dt: 1e-2 * dt * np.eye(1),
            periods=(TURN,),
        )
        f = FAMILIES[family](model, [compass()], lag=3)
        state = start(f, [2.9 - offset], [[0.04]])
        observed = truth.copy()
        observed[3] = np.nan
        late = Observation(4.0, 0, wrap(truth[3] + 0.1), arrival_time=6.0)
        run = quietly(
            f.smooth, state, times, [wrap(observed)], truth=truth, delayed=[late]
        )
        results.append(wrap(run["mean"].values[:, 0, 0] + offset))
        assert run["squared_error"].values.max() < 0.05
    allowed = 1e-9 if family in GAUSSIAN else 1e-2
    assert np.abs(wrap(results[0] - results[1])).max() < allowed


@pytest.mark.parametrize("family", FAMILIES)
def test_a_position_and_a_heading_that_wraps(family: str) -> None:
    """A robot drives along the negative x axis, its heading at the cut: no mean of ±π is 0."""

    def drive(x: np.ndarray, t: float, dt: float) -> np.ndarray:
        p = x[..., :2]
        heading = x[..., 2:]
        step = np.concatenate([np.cos(heading), np.sin(heading)], axis=-1)
        turned = wrap(heading + 0.01 * dt)
        return np.concatenate([p + dt * step, turned], axis=-1)

    model = Model(
        3,
        drive,
        lambda t, dt: 1e-4 * dt * np.eye(3),
        names=("x", "y", "heading"),
        periods={"heading": TURN},
    )
    sensors = [[component([0, 1], std=0.1), compass(0.05, place=2, cut=True)]]
    more = {"target_dim": 3} if family in ("mixture", "increments") else {}
    f = FAMILIES[family](model, sensors, **more)
    rng = np.random.default_rng(5)
    x = np.array([0.0, 0.0, 3.1])
    state = start(f, x, np.diag([0.01, 0.01, 0.04]))
    worst = 0.0
    for k in range(1, 11):
        x = drive(x, 0.0, 1.0)
        place = x[:2] + 0.1 * rng.standard_normal(2)
        heading = wrap(x[2:] + 0.05 * rng.standard_normal(1))
        seen = [Observation(k, 0, place, 0), Observation(k, 0, heading, 1)]
        state = quietly(f.step, state, float(k), [seen])
        error = f.summarize(state).mean[0] - x
        place_error = np.abs(error[:2]).max()
        heading_error = abs(wrap(error[2]))
        worst = max(worst, place_error, heading_error)
    assert worst < 0.25


def test_a_derivative_by_differences_is_the_shorter_way_round() -> None:
    """Just before the cut the two differences lie on both sides of it."""
    model = Model(
        1,
        lambda x, t, dt: wrap(x),
        lambda t, dt: np.zeros((1, 1)),
        periods=(TURN,),
    )
    slope = model.jacobian([np.pi], 0.0, 1.0)
    # A difference of nearly 2 π over a small step would give a huge slope.
    assert np.allclose(slope, [[1.0]])


@pytest.mark.parametrize("family", ["unscented", "ensemble", "exact", "square root"])
def test_a_wide_prior_is_moved_on_the_line(family: str) -> None:
    """A Gaussian of 3 rad, moved by a transition with a cut: its variance stays."""
    model = Model(
        1,
        lambda x, t, dt: wrap(x + 1.0),
        lambda t, dt: 1e-6 * np.eye(1),
        periods=(TURN,),
    )
    f = FAMILIES[family](model, [None])
    state = start(f, [0.0], [[9.0]])
    before = f.summarize(state)
    state = f.step(state, 1.0, [None])
    after = f.summarize(state)
    # A turn by 1 rad moves the mean and keeps the variance of 9, of which a circle has at most π².
    turn_error = wrap(after.mean - before.mean - 1.0)
    assert np.allclose(turn_error, 0.0, atol=1e-2)
    assert np.allclose(after.variance, before.variance, rtol=1e-2)


# Particles and members ------------------------------------------------------------------


@pytest.mark.parametrize("family", ["particle", "transport", "coupling"])
def test_the_mean_of_particles_on_both_sides(family: str) -> None:
    """PointCloudLibrary/pcl 5538: uniform headings, and a compass that points to π."""
    f = FAMILIES[family](still(noise=1e-4), [compass(0.2, cut=True)])
    members = f.members
    uniform = wrap(np.linspace(-np.pi, np.pi, members, endpoint=False))[:, None]
    state = f.start(uniform, rng=np.random.default_rng(1))
    for k, t in enumerate((0.0, 1.0)):
        state = quietly(f.step, state, t, [[np.pi]])
        summary = f.summarize(state)
        assert abs(wrap(summary.mean[0, 0] - np.pi)) < 0.06
        # One and two observations of 0.2.
        expected_std = 0.2 / np.sqrt(k + 1)
        std = np.sqrt(summary.variance[0, 0])
        assert abs(std - expected_std) < 0.04


@pytest.mark.parametrize("family", ["ensemble", "particle", "transport", "exact"])
def test_members_that_are_given_with_a_cut(family: str) -> None:
    """Headings about π as a log has them: the prior's mean is π, its deviation 0.2."""
    f = FAMILIES[family](still(), [compass()])
    z = np.random.default_rng(0).standard_normal(f.members)
    members = wrap(np.pi + 0.2 * z)
    state = f.start(members[:, None], rng=np.random.default_rng(1))
    summary = f.summarize(state)
    assert abs(wrap(summary.mean[0, 0] - np.pi)) < 0.03
    std = np.sqrt(summary.variance[0, 0])
    assert abs(std - 0.2) < 0.02


def test_jitter_about_the_cut() -> None:
    """Copies are separated by the spread about π, not by that between the sides."""
    f = ParticleFilter(still(), [compass(0.1)], members=500, jitter=0.3)
    state = start(f, [np.pi], [[0.04]])
    for t in (0.0, 1.0, 2.0):
        state = quietly(f.step, state, t, [[-np.pi]])
    # 1 / (1/0.04 + 3/0.01) = 0.055², widened by the kernel; a spread across the cut is about 3.
    summary = f.summarize(state)
    assert abs(wrap(summary.mean[0, 0] - np.pi)) < 0.05
    assert summary.variance[0, 0] ** 0.5 < 0.12


# Fusion ---------------------------------------------------------------------------------

RULES: dict[str, tuple[str, Callable[..., Any]]] = {
    "intersection": ("extended", network.covariance_intersection),
    "intersection, min": (
        "unscented",
        partial(network.covariance_intersection, rule="min_trace"),
    ),
    "naive": ("extended", network.naive_fusion),
    "average": ("extended", network.arithmetic_average),
    "pull": ("extended", partial(network.consensus_pull, gain=0.3)),
    "user's": ("extended", lambda belief, channel: (belief[0][::-1], belief[1])),
    "ensembles": ("exact", network.intersect_ensembles),
    "ensembles, scaled": ("exact", partial(network.intersect_ensembles, scale=[10.0])),
    "mean pull": ("ensemble", partial(network.mean_pull, gain=0.3)),
    "particles": ("particle", network.intersect_ensembles),
    "mixtures": ("mixture", partial(target_fusion, target_dim=1)),
}


@pytest.mark.parametrize("rule", RULES)
def test_fusion_of_headings_on_both_sides(rule: str) -> None:
    """usdot-fhwa-stol/multiple_object_tracking 143: as the same headings far from the cut."""
    family, fusion = RULES[rule]
    results = []
    for centre in (np.pi, 0.5):
        more = {} if family == "mixture" else {"share_observations": False}
        sensors = [compass(0.1), compass(0.2)]
        f = FAMILIES[family](still(), sensors, graphs.path(2), fusion=fusion, **more)
        state = start(f, [centre], [[0.04]])
        seen = [wrap([centre - 0.2]), wrap([centre + 0.2])]
        after = quietly(f.step, state, 0.0, seen)
        summary = f.summarize(after)
        assert np.all(np.abs(summary.mean) <= np.pi)
        results.append((wrap(summary.mean - centre), summary.variance))
    # Relative to their centre the beliefs about π are those about 0.5.
    (mean_at_cut, variance_at_cut), (mean, variance) = results
    assert np.allclose(mean_at_cut, mean, atol=1e-9)
    assert np.allclose(variance_at_cut, variance, atol=1e-9)


def test_neighbours_are_brought_next_to_each_receiver() -> None:
    """Three headings around the circle: every pair differs by the shorter way."""
    means = np.array([[-2.0], [0.0], [2.5]])
    channel = Channel(graphs.complete(3))
    channel.periods = (TURN,)
    pulled, _ = network.consensus_pull((means, np.ones((3, 1, 1))), channel, gain=0.1)
    # m_i + γ Σ_j wrap(m_j - m_i)
    differences = wrap(means[:, 0] - means)
    expected = means[:, 0] + 0.1 * differences.sum(axis=1)
    assert np.allclose(pulled[:, 0], expected)


PAIRWISE = {
    "intersection": network.covariance_intersection,
    "naive": network.naive_fusion,
    "average": network.arithmetic_average,
    "pull": partial(network.consensus_pull, gain=0.1),
}


@pytest.mark.parametrize("rule", PAIRWISE)
def test_every_rule_takes_the_shorter_way(rule: str) -> None:
    """Of 3.1 and -3.1, as of the same two headings with the second one past π."""
    covs = np.array([[[1.0]], [[2.0]]])
    channel = Channel(graphs.path(2))
    straight, p = PAIRWISE[rule](([[3.1], [TURN - 3.1]], covs), channel)
    channel.periods = (TURN,)
    wrapped, q = PAIRWISE[rule](([[3.1], [-3.1]], covs), channel)
    assert np.allclose(wrap(wrapped - straight), 0.0)
    assert np.allclose(p, q)


def test_ensembles_and_mixtures_take_the_shorter_way() -> None:
    """The same for the rules of ensembles, and for marginals of mixtures."""
    channel = Channel(graphs.path(2))
    channel.periods = (TURN,)
    deviations = np.array([[-0.2], [0.0], [0.2]])
    members = np.stack([3.1 + deviations, -3.1 + deviations])
    for rule in (
        network.intersect_ensembles,
        partial(network.intersect_ensembles, scale=[3.0]),
        partial(network.mean_pull, gain=0.5, include_self=False),
    ):
        means = rule(members, channel).mean(axis=1)
        # Halfway between 3.1 and -3.1 + 2 π
        assert np.allclose(wrap(means - np.pi), 0.0)
    beliefs = [GaussianMixture.gaussian([m], [[1.0]]) for m in (3.1, -3.1)]
    for fused in target_fusion(beliefs, channel, target_dim=1):
        assert abs(wrap(fused.mean[0] - np.pi)) < 1e-9


def test_increments_of_information_on_the_receivers_branch() -> None:
    """Two agents at π: the Kalman filter of both observations, whatever the branches are."""
    sensors = [compass(0.1), compass(0.1)]
    f = InformationIncrementFilter(still(), sensors, graphs.path(2), target_dim=1)
    priors = [GaussianMixture.gaussian([m], [[0.04]]) for m in (3.12, -3.12)]
    state = f.step(f.start(priors), 0.0, [[3.1], [-3.1]])
    # Each agent has its prior and both observations, 3.1 and 2 π - 3.1 in one branch.
    information = 1 / 0.04 + 2 / 0.01
    for belief, prior in zip(state.mixtures, (3.12, -3.12 + TURN), strict=True):
        # m = (m₀/P₀ + Σ y/R) / (1/P₀ + 2/R)
        total = prior / 0.04 + (3.1 + TURN - 3.1) / 0.01
        mean = total / information
        assert abs(wrap(belief.mean[0] - mean)) < 1e-9
        assert np.allclose(belief.cov, 1 / information)


# Warnings and refusals ------------------------------------------------------------------


@pytest.mark.parametrize(
    "family", [name for name in FAMILIES if name not in ("extended",)]
)
def test_a_transition_that_wraps_undeclared_warns_once(family: str) -> None:
    """Case d_circle_flow; with a period the answer is the scalar filter's, without a warning."""

    def make(periods: Any) -> Any:
        model = Model(
            1,
            lambda x, t, dt: wrap(x),
            lambda t, dt: [[1e-4 * dt]],
            periods=periods,
        )
        return FAMILIES[family](model, [compass(0.05, cut=True)])

    f = make(())
    state = start(f, [3.1], [[0.04]])
    with pytest.warns(RuntimeWarning, match="periods="):
        quiet = f.step(state, 1.0, [[-3.1]])
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message=".*periods=.*")
        f.step(quiet, 2.0, [None])
    f = make((TURN,))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        if family in ("coupling", "transport"):
            warnings.filterwarnings("ignore", message=".*effective size.*")
        state = f.step(start(f, [3.1], [[0.04]]), 1.0, [[-3.1]])
    # The innovation from 3.1 to -3.1 by the shorter way is 2 π - 6.2.
    p = 0.04 + 1e-4
    gain = p / (p + 0.05**2)
    expected = 3.1 + gain * (TURN - 6.2)
    mean = f.summarize(state).mean[0, 0]
    assert abs(wrap(mean - expected)) < tolerance(family)


def test_predictions_lie_within_half_a_period_of_the_mean_s() -> None:
    """By hand: the point (-1, 2) is seen at arctan(-2) = -1.11, and not half a turn farther.

    The tangent at the mean, (1, 0), leads to 2 there, next to -1.11 + π. Most points lie at the
    mean, so that the tangent's values have a standard deviation of only 0.31.
    """
    others = np.array([[-1.0, 2.0], [3.0, -2.0], [1.0, 1.0], [1.0, -1.0]])
    points = np.concatenate([np.tile([1.0, 0.0], (98, 1)), others])
    predicted = predict_points(line_angle((0, 1), std=0.1), points)[:, 0]
    assert np.allclose(predicted[:98], 0.0, atol=1e-12)
    by_hand = [-np.arctan(2.0), -np.arctan(2 / 3), np.pi / 4, -np.pi / 4]
    assert np.allclose(predicted[98:], by_hand)


def test_predictions_of_a_compass_continue_the_line() -> None:
    """Headings up to five turns away; the mean is in the middle."""
    headings = np.linspace(-30.0, 31.0, 62)[:, None]
    predicted = predict_points(compass(cut=True), headings)
    steps = np.diff(predicted[:, 0])
    # Ten jumps of 2 π, at the odd multiples of π, are undone.
    assert np.allclose(steps, 1.0)


WIDE_PRIOR = np.full(2, 3.0), 25.0 * np.eye(2)
WIDE_FILTERS: dict[str, Callable[..., Any]] = {
    "unscented": partial(GaussianFilter, linearization="unscented"),
    "ensemble": partial(EnsembleFilter, members=200),
}


def line_angle_along_the_tangent() -> Sensor:
    """An angle of a line continued along its tangent at (3, 3), for a comparison."""
    sensor = line_angle((0, 1), std=0.2)

    def h(x: np.ndarray) -> np.ndarray:
        tangent = np.pi / 4 + (x[..., 1:] - x[..., :1]) / 6
        return sensor.bring_near(sensor.predict(x), tangent)

    return Sensor(1, h, sensor.noise_cov)


@pytest.mark.parametrize("family", WIDE_FILTERS)
def test_the_page_s_wide_prior(family: str) -> None:
    """A point at (3, 3) ± 5, one angle of a line, truths from the prior: the page's table.

    A branch along the tangent turns predictions to where no observed value is taken: the
    reported covariance is then half the squared error or less, and one run in thirty is lost.
    """
    still_point = Model(2, lambda x, t, dt: x, lambda t, dt: 1e-9 * np.eye(2))
    rng = np.random.default_rng(4)
    truth = rng.multivariate_normal(*WIDE_PRIOR, size=2000)[None]
    wrapped = line_angle((0, 1), std=0.2)
    # A number without a period is compared as it is: next to the prediction of the mean.
    observed = wrapped.observe(truth, rng=rng)
    y = wrapped.bring_near(observed, np.full(1, np.pi / 4))
    values = []
    for sensor in (wrapped, line_angle_along_the_tangent()):
        f = WIDE_FILTERS[family](still_point, [sensor])
        state = f.start(WIDE_PRIOR, rng=np.random.default_rng(3), runs=(2000,))
        run = f.run(state, [1.0], [y], truth=truth, scores=("nees", "crps"))
        # A component, the fraction of runs that are lost, and the CRPS: three cells of the table
        nees = run["nees"].values / 2
        percent_lost = 100 * (nees > 10).mean()
        crps = run["crps"].values.mean()
        values += [nees.mean(), percent_lost, crps]
    page = PAGE.read_text("utf-8")
    (row,) = re.findall(rf"^\| {family} \|(.*)\|$", page, re.MULTILINE)
    printed = [float(cell.strip().removesuffix("%")) for cell in row.split("|")]
    # Two digits, rounded
    assert np.allclose(values, printed, rtol=0.0, atol=0.0055), values
    # That of the prior N(m, σ²) on average: σ / √π
    prior_crps = 5 / np.sqrt(np.pi)
    assert f"CRPS of {prior_crps:.2f} m" in page
    assert values[0] < 1.4 < 1.8 < values[3]
    assert values[1] < 0.5 < 3.0 < values[4]


def test_near_a_singularity_the_branch_is_that_of_the_mean() -> None:
    """There the tangent turns many times among the points, and the update must not collapse."""
    still_point = Model(2, lambda x, t, dt: x, lambda t, dt: np.zeros((2, 2)))
    f = EnsembleFilter(still_point, [line_angle((0, 1), std=0.2)], members=2000)
    state = f.step(start(f, [0.3, 0.3], 25.0 * np.eye(2)), 1.0, [[1.2]])
    # Along (-1, 1) the tangent has a slope of 2.4 rad a metre, the angle itself hardly any.
    across = state.ensembles[0] @ [-1.0, 1.0] / np.sqrt(2)
    assert across.std() > 3.0


def test_a_truth_that_wraps_undeclared_warns() -> None:
    """Case d06 without periods."""
    times = np.arange(1.0, 21.0)
    truth = 3.0 + 0.1 * times[:, None]
    turn = Model(1, lambda x, t, dt: x + 0.1 * dt, lambda t, dt: 1e-4 * dt * np.eye(1))
    f = GaussianFilter(turn, [compass(0.01)])
    state = f.start(([3.0], [[0.01]]))
    # A truth that runs on, as the filter does, is right.
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        f.run(state, times, [wrap(truth)], truth=truth)
    with pytest.warns(RuntimeWarning, match="whole turns.*periods="):
        f.run(state, times, [wrap(truth)], truth=wrap(truth))


def test_a_large_first_error_is_no_wrap() -> None:
    """A position that is 9 m wrong falls by 2π m in one step, as a filter finds its place."""
    still_point = Model(1, lambda x, t, dt: x, lambda t, dt: np.zeros((1, 1)))
    f = GaussianFilter(still_point, [stack([component([0], std=1.0), compass()])])
    truth = np.zeros((120, 1))
    # Nothing at the first time, then the position 0 with a gain of 0.698 = 2π / 9.
    observed = np.full((120, 2), np.nan)
    observed[1:, 0] = 0.0
    variance = TURN / (9.0 - TURN)
    state = f.start(([9.0], [[variance]]))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        run = f.run(state, np.arange(1.0, 121.0), [observed], truth=truth)
    # K = P / (P + 1) with P = 2 π / (9 - 2 π), so that the mean falls by 9 K = 2 π.
    assert abs(run["mean"].values[1].item() - (9.0 - TURN)) < 1e-12


def test_what_does_not_wrap_is_not_warned_of() -> None:
    """A jump of one member that is no wrap, and a heading that is spread widely."""

    def jump(x: np.ndarray, t: float, dt: float) -> np.ndarray:
        return np.where(x > 0.0, x + TURN, x)

    model = Model(1, jump, lambda t, dt: [[1e-4 * dt]])
    f = EnsembleFilter(model, [compass()], members=100)
    # Members near zero on both sides: some jump and some do not.
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        f.step(start(f, [0.0], [[0.01]]), 1.0, [None])
    f = EnsembleFilter(still(periods=()), [compass()], members=100)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        f.step(start(f, [0.0], [[9.0]]), 1.0, [[0.3]])


@pytest.mark.parametrize("family", FAMILIES)
def test_a_sensor_without_a_period_is_refused(family: str) -> None:
    f = FAMILIES[family](still(), [component([0], std=0.1)])
    with pytest.raises(Exception, match="sensors must have periods=.*component 0"):
        f.step(start(f, [3.1], [[0.01]]), 0.0, [[3.1]])


@pytest.mark.parametrize("family", FAMILIES)
def test_periods_that_do_not_fit_the_model_are_refused(family: str) -> None:
    # 0.9 (x + 2 π) is not 0.9 x and whole turns.
    pulled = Model(
        1,
        lambda x, t, dt: 0.9 * x,
        lambda t, dt: 0.01 * dt * np.eye(1),
        periods=(TURN,),
    )
    f = FAMILIES[family](pulled, [compass()])
    with pytest.raises(Exception, match="periods must fit transition"):
        f.step(start(f, [1.0], [[0.01]]), 1.0, [[1.0]])


@pytest.mark.parametrize(
    ("periods", "problem"),
    [
        ((TURN,), "must have 2 entries"),
        ((None, -1.0), "must be positive"),
        ((None, np.nan), "must be positive"),
        ((None, "2π"), "must have numbers"),
        ((None, True), "must have numbers"),
        (TURN, "must be a tuple"),
        ({"height": TURN}, "must have keys among"),
        ({2: TURN}, "must have keys among"),
    ],
)
def test_wrong_periods_are_refused(periods: Any, problem: str) -> None:
    with pytest.raises(ValueError, match=f"^periods {problem}"):
        Model(
            2,
            lambda x, t, dt: x,
            lambda t, dt: np.eye(2),
            names=("x", "heading"),
            periods=periods,
        )
    if not isinstance(periods, dict) or 2 in periods:
        with pytest.raises(ValueError, match=f"^periods {problem}"):
            Sensor(2, lambda x: x, np.eye(2), periods=periods)


def test_a_period_and_a_residual_function_are_refused() -> None:
    with pytest.raises(ValueError, match="^residual_function must be None"):
        Sensor(
            1,
            lambda x: x,
            [[1.0]],
            periods=(TURN,),
            residual_function=lambda a, b: wrap(a - b),
        )
    assert issubclass(InvalidArgumentError, ValueError)


def test_declarations_by_name_by_index_and_by_entry_are_the_same() -> None:
    names = ("theta", "omega")
    for periods in ({"theta": TURN}, {0: TURN}, [TURN, None]):
        assert pendulum_angle(periods=periods).periods == (TURN, None)
        model = LinearModel.from_transition(
            2,
            lambda dt: np.array([[1.0, dt], [0.0, 1.0]]),
            lambda t, dt: dt * np.eye(2),
            names=names,
            periods=periods,
        )
        assert model.periods == (TURN, None)
    assert pendulum_angle().periods == ()


def test_the_page_s_example() -> None:
    """It prints what the page says."""
    (code,) = re.findall(r"```python\n(.*?)```", PAGE.read_text("utf-8"), re.DOTALL)
    printed: list[tuple[Any, ...]] = []
    exec(code, {"print": lambda *values: printed.append(values)})
    assert [bool(value) for value in printed[0]] == [True, True]


def start_and_look(make: Any, prior: Any) -> tuple[float, float]:
    """Return mean and variance of a heading after a compass shows 6.2 ± 0.2 rad."""
    compass = component([0], std=0.2, periods=(TURN,))
    resting = Model(
        1, lambda x, t, dt: x, lambda t, dt: np.zeros((1, 1)), periods=(TURN,)
    )
    f = make(resting, [compass])
    state = f.step(f.start(prior, rng=np.random.default_rng(0)), 0.0, [[6.2]])
    summary = f.summarize(state)
    return float(summary.mean[0, 0]), float(summary.variance[0, 0])


PRIOR_FAMILIES: dict[str, Any] = {
    "gaussian": GaussianFilter,
    "unscented": partial(GaussianFilter, linearization="unscented"),
    "sum": filters.GaussianSumFilter,
    "mixture": partial(MixtureFilter, target_dim=1),
    "information": partial(
        filters.InformationConsensusFilter,
        graph=graphs.complete(1),
        fusion=network.average_consensus,
    ),
    "channel": partial(filters.ChannelFilter, graph=graphs.path(1)),
    "ensemble": partial(EnsembleFilter, members=4000),
    "particle": partial(ParticleFilter, members=4000),
    "transport": partial(TransportFilter, graph=graphs.complete(1), members=300),
    "increments": partial(
        filters.InformationIncrementFilter, graph=graphs.complete(1), target_dim=1
    ),
}


@pytest.mark.parametrize("family", PRIOR_FAMILIES)
def test_members_of_a_prior_between_zero_and_two_pi(family: str) -> None:
    """Headings 0 ± 0.3 rad, as a file in [0, 2π) has them: about 0, not about π."""
    make = PRIOR_FAMILIES[family]
    count = make.keywords.get("members", 2000) if isinstance(make, partial) else 2000
    members = np.random.default_rng(1).normal(0.0, 0.3, (count, 1)) % TURN
    # 1/P = 1/.09 + 1/.04, and the mean is P (6.2 - 2π) / .04
    variance = 1 / (1 / 0.09 + 1 / 0.04)
    mean = variance * (6.2 - TURN) / 0.04
    got = start_and_look(make, members)
    tolerance = 0.04 if family == "transport" else 0.015
    assert np.allclose(got, (mean, variance), atol=tolerance)


@pytest.mark.parametrize("family", PRIOR_FAMILIES)
def test_a_mixture_of_a_prior_on_both_sides(family: str) -> None:
    """Two components at 6.1 and 0.1 rad, as at -0.18 and 0.1 on one branch."""
    components = [[6.1], [0.1]]
    covs = [[[0.01]], [[0.01]]]
    torn = GaussianMixture([0.5, 0.5], components, covs)
    whole = GaussianMixture([0.5, 0.5], [[6.1 - TURN], [0.1]], covs)
    make = PRIOR_FAMILIES[family]
    tolerance = 1e-9 if "members" not in getattr(make, "keywords", {}) else 0.02
    expected = start_and_look(make, whole)
    assert np.allclose(start_and_look(make, torn), expected, atol=tolerance)


def test_components_of_a_sum_that_part_lie_on_one_branch() -> None:
    """One turns left, the other right: they meet at π, and the variance is small again."""
    turning = Model(
        2,
        lambda x, t, dt: np.stack([x[..., 0] + x[..., 1] * dt, x[..., 1]], axis=-1),
        lambda t, dt: np.zeros((2, 2)),
        periods={0: TURN},
    )
    f = filters.GaussianSumFilter(turning, [None])
    covs = np.array([np.diag([0.01, 1e-6])] * 2)
    prior = GaussianMixture([0.5, 0.5], [[0.0, 1.0], [0.0, -1.0]], covs)
    state = f.step(f.start(prior), np.pi, [None])
    variance = f.summarize(state).variance[0, 0]
    assert np.isclose(variance, 0.01 + 1e-6 * np.pi**2, atol=1e-9)


def log_von_mises(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return 25 * np.cos(y - x)[..., 0]


def von_mises_moments(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return x, np.full((*x.shape, 1), 0.04)


LIKELIHOOD_FAMILIES: dict[str, Any] = {
    "particle": partial(ParticleFilter, members=20_000),
    "transport": partial(TransportFilter, graph=graphs.complete(1), members=400),
    "likelihood": partial(
        filters.LikelihoodConsensusFilter,
        graph=graphs.complete(1),
        members=20_000,
        basis=filters.PolynomialBasis([0]),
        fusion=network.average_consensus,
    ),
}


@pytest.mark.parametrize("gate", [None, 0.999])
@pytest.mark.parametrize("with_moments", [True, False])
@pytest.mark.parametrize("family", LIKELIHOOD_FAMILIES)
def test_a_likelihood_of_a_heading(family: str, with_moments: bool, gate: Any) -> None:
    """A von Mises compass on the other side of the cut, against a sum on a grid."""
    if gate is not None and not with_moments:
        pytest.skip("a gate needs moments")
    compass = LikelihoodSensor(
        1,
        log_von_mises,
        moments=von_mises_moments if with_moments else None,
        periods=(TURN,),
    )
    resting = Model(
        1, lambda x, t, dt: x, lambda t, dt: np.zeros((1, 1)), periods=(TURN,)
    )
    f = LIKELIHOOD_FAMILIES[family](resting, [compass], gate_probability=gate)
    start = f.start(([3.0], [[0.09]]), rng=np.random.default_rng(1))
    after = f.step(start, 0.0, [[-3.0]])
    summary = f.summarize(after)
    # The prior N(3, 0.09) times the von Mises density exp(κ cos(x - y)) with κ = 25
    grid = np.linspace(0.0, TURN, 20_001)
    density = np.exp(-((grid - 3.0) ** 2) / 0.18 + 25 * np.cos(grid + 3.0))
    density /= density.sum()
    mean = density @ grid
    variance = density @ (grid - mean) ** 2
    atol = 0.04 if family == "transport" else 0.01
    assert np.isclose(summary.mean[0, 0] % TURN, mean, atol=atol)
    assert np.isclose(summary.variance[0, 0], variance, atol=atol)


@pytest.mark.parametrize("family", LIKELIHOOD_FAMILIES)
def test_a_likelihood_that_does_not_wrap_is_refused(family: str) -> None:
    straight = LikelihoodSensor(1, lambda x, y: -50 * (y - x)[..., 0] ** 2)
    resting = Model(
        1, lambda x, t, dt: x, lambda t, dt: np.zeros((1, 1)), periods=(TURN,)
    )
    f = LIKELIHOOD_FAMILIES[family](resting, [straight])
    start = f.start(([3.0], [[0.09]]), rng=np.random.default_rng(1))
    with pytest.raises(
        ValueError, match="must have the same log_likelihood for the same"
    ):
        f.step(start, 0.0, [[-3.0]])
