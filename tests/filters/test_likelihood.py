"""Likelihood consensus: exact where the basis holds the likelihoods, close to it elsewhere."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
import pytest
from numpy.random import default_rng

from distfilt.filters import (
    LikelihoodConsensusFilter,
    Observation,
    ParticleFilter,
    PolynomialBasis,
)
from distfilt.filters.likelihood import _Products
from distfilt.network import (
    Faults,
    average_consensus,
    finite_time_consensus,
    graphs,
    naive_fusion,
)
from distfilt.sensors import Sensor, bearing, distance, increment
from tests.filters.families import PRIOR, TIMES, data, model, still_model, team

NET = graphs.path(5)
QUADRATIC = PolynomialBasis([0, 1])
LINEAR = PolynomialBasis([0, 1], degree=1)


def make(cls: Any, **options: Any) -> Any:
    sensors = options.pop("sensors", team())
    options = {"members": 400} | options
    if cls is LikelihoodConsensusFilter:
        options = {"basis": QUADRATIC, "fusion": finite_time_consensus} | options
    else:
        options = {"hops": "all"} | options
    return cls(options.pop("model", model()), sensors, NET, **options)


def last_of(f: Any, seen: Any, runs: tuple[int, ...] = ()) -> Any:
    start = f.start(PRIOR, rng=default_rng(3), runs=runs)
    *_, last = f.steps(start, TIMES, seen)
    return last


@pytest.mark.parametrize(("basis", "n_numbers"), [(LINEAR, 5), (QUADRATIC, 14)])
def test_linear_sensors_are_exact(basis: PolynomialBasis, n_numbers: int) -> None:
    """With an exact average the same weights as those of a filter of all observations.

    Both draw the same numbers, so that the particles are the same too.
    """
    sensors = team()
    _, seen = data(sensors, (2,))
    a = last_of(make(LikelihoodConsensusFilter, basis=basis), seen, (2,))
    b = last_of(make(ParticleFilter), seen, (2,))
    # The same ancestors and the same noise
    assert np.allclose(a.particles, b.particles, atol=1e-9)
    assert np.allclose(a.weights, b.weights, atol=1e-9)
    # The monomials up to twice the degree, on each link and round
    assert (a.ledger.scalars == n_numbers * a.ledger.messages).all()


def range_team() -> tuple[list[Any], np.ndarray, list[np.ndarray]]:
    """Return eight sensors of distance on a ring, a track, and 20 runs of their observations.

    For the first four steps only two opposite sensors are active, which cannot tell the target
    from its mirror image; then all are.
    """
    angles = 2 * np.pi * np.arange(8) / 8
    places = 5 * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    sensors = [distance([0, 1], std=0.5, origin=place) for place in places]
    times = np.arange(8)
    track = np.stack([1.0 + 0.1 * times, 2.0 - 0.1 * times], axis=-1)
    rng = default_rng(7)
    observations = []
    for k, sensor in enumerate(sensors):
        y = sensor.observe(np.broadcast_to(track[:, None], (8, 20, 2)), rng=rng)
        if k not in (0, 4):
            y[:4] = np.nan
        observations.append(y)
    return sensors, track, observations


def test_a_mirror_image_costs_no_more_than_at_a_centre() -> None:
    """The agents' particles differ, and the last ones of a cloud lie outside another's.

    A polynomial that is fitted to the log-likelihood rises there without bound, and gave one
    particle all the weight: at degree four the error was seven times the centre's.
    """
    sensors, track, observations = range_team()
    prior = ([0.0, 0.0], 9 * np.eye(2))
    options: dict[str, Any] = {"members": 500, "jitter": 0.05}
    walk = still_model(2, 0.3)
    ring = graphs.ring(8)
    centre = ParticleFilter(walk, sensors, ring, hops="all", **options)
    consensus = LikelihoodConsensusFilter(
        walk, sensors, ring, basis=QUADRATIC, fusion=finite_time_consensus, **options
    )
    scores = {}
    for name, f in (("centre", centre), ("consensus", consensus)):
        start = f.start(prior, rng=default_rng(1), runs=(20,))
        truth = np.broadcast_to(track[:, None], (8, 20, 2))
        run = f.run(start, 1.0 + np.arange(8), observations, truth=truth)
        late = run.isel(time=slice(5, None))
        error = late["total_squared_error"].values.mean()
        scores[name] = np.sqrt(error), late["nees"].values.mean() / 2
    assert scores["consensus"][0] < 1.15 * scores["centre"][0]
    assert scores["consensus"][1] < 1.3


def test_an_approximated_residual_never_rewards_a_particle() -> None:
    """Wherever it is evaluated: -½ Σ (c' φ)² is at most zero, up to the dropped constant."""
    rng = default_rng(0)
    basis = PolynomialBasis([0, 1], degree=2)
    products = _Products(basis, 5)
    coefficients = rng.standard_normal((6, 3))
    far = 20 * rng.standard_normal((1000, 2))
    functions = basis(far)
    ones = np.ones((1000, 1))
    residuals = np.concatenate([ones, functions], axis=-1) @ coefficients
    values = products.evaluate(functions) @ products.expand_squares(coefficients)
    constant = -0.5 * (coefficients[0] ** 2).sum()
    assert products.size == 14
    assert np.allclose(values + constant, -0.5 * (residuals**2).sum(axis=-1))


def test_few_rounds_are_close_and_more_are_closer() -> None:
    _, seen = data(team())
    exact = make(ParticleFilter)
    expected = exact.summarize(last_of(exact, seen)).mean
    # With many particles, whose sampling error is below that of one round.
    errors = []
    for rounds in (1, 10, 80):
        rule = partial(average_consensus, rounds=rounds)
        f = make(LikelihoodConsensusFilter, fusion=rule, members=3000)
        summary = f.summarize(last_of(f, seen))
        errors.append(np.abs(summary.mean - expected).max())
    assert errors[0] > 2 * errors[2]
    assert errors[2] < 0.15


def test_higher_degrees_follow_curved_sensors() -> None:
    """Distances and bearings: each two degrees more divide the error by four or more."""
    places = [[-3.0, 0.0], [0.0, -3.0], [3.0, 0.0], [0.0, 3.0]]
    sensors: list[Any] = []
    for k, place in enumerate(places):
        kind = distance if k % 2 else bearing
        sensors.append(kind([0, 1], std=0.4 if k % 2 else 0.2, origin=place))
    sensors.append(None)
    # Observations without noise of one place
    truth = np.array([0.9, 0.4])
    seen = [None if s is None else s.predict(truth) for s in sensors]
    prior = ([0.0, 0.0], 0.25 * np.eye(2))
    options: dict[str, Any] = {"sensors": sensors, "model": still_model(2, 0.01)}
    exact = make(ParticleFilter, members=2000, **options)
    state = exact.step(exact.start(prior, rng=default_rng(0)), 1.0, seen)
    expected = exact.summarize(state)
    errors = []
    for degree in (2, 4, 6):
        f = make(
            LikelihoodConsensusFilter,
            members=2000,
            basis=PolynomialBasis([0, 1], degree=degree, scale=3.0),
            **options,
        )
        state = f.step(f.start(prior, rng=default_rng(0)), 1.0, seen)
        errors.append(np.abs(f.summarize(state).mean - expected.mean).max())
    assert errors[0] > 4 * errors[1] > 16 * errors[2]
    assert errors[2] < 1e-3


def test_ranges_have_the_weights_of_all_observations() -> None:
    """Particles that do not move, with weights ∝ exp(-½ Σ (y - |x - p|)² / σ²) by hand.

    A range r = |x - p| has a Taylor series in x / |p|, here of up to a third: two degrees more
    divide the error of each weight by about nine. A wrong factor or shift of the sum would stay.
    """
    places = [[-6.0, 1.0], [0.5, -7.0], [8.0, 2.0], [-1.0, 6.0], [5.0, 5.0]]
    stds = [0.5, 0.7, 0.6, 0.9, 0.8]
    observed = [6.4, 7.1, 7.9, 5.6, 6.3]
    sensors: list[Any] = []
    for place, std in zip(places, stds, strict=True):
        sensors.append(distance([0, 1], std=std, origin=place))
    errors = []
    for degree in (2, 4, 6):
        f = make(
            LikelihoodConsensusFilter,
            sensors=sensors,
            members=500,
            basis=PolynomialBasis([0, 1], degree=degree),
            model=still_model(2),
            jitter=0.0,
        )
        start = f.start(([0.0, 0.0], 0.3 * np.eye(2)), rng=default_rng(1))
        state = f.step(start, 1.0, [[y] for y in observed])
        # Each agent has particles of its own, and the observations of all.
        logs = np.zeros((5, 500))
        for y, place, std in zip(observed, places, stds, strict=True):
            ranges = np.linalg.norm(state.particles - place, axis=-1)
            logs -= 0.5 * ((y - ranges) / std) ** 2
        weights = np.exp(logs) / np.exp(logs).sum(axis=-1, keepdims=True)
        # For particles that matter
        is_relevant = weights > 1e-3 * weights.max(axis=-1, keepdims=True)
        ratio = state.weights[is_relevant] / weights[is_relevant]
        errors.append(np.abs(ratio - 1).max())
    assert errors[0] > 4 * errors[1] > 16 * errors[2]
    assert errors[2] < 0.01


def test_the_centre_and_scale_of_the_basis_do_not_matter_to_a_fit() -> None:
    """Polynomials of other coordinates are the same functions."""
    _, seen = data(team())
    # Another origin, and another unit for each component
    far = PolynomialBasis(
        [0, 1], centre=np.array([5.0, -3.0]), scale=np.array([2.0, 9.0])
    )
    a = last_of(make(LikelihoodConsensusFilter), seen)
    b = last_of(make(LikelihoodConsensusFilter, basis=far), seen)
    assert np.allclose(a.weights, b.weights, atol=1e-8)


def test_a_basis_of_the_users_own() -> None:
    """The only function that a sensor of |x| with unit noise needs beside x²."""

    def basis(x: np.ndarray) -> np.ndarray:
        return np.concatenate([np.abs(x), x**2], axis=-1)

    # (y - |x|)² / 2 = x² / 2 - y |x| + a constant
    sensors = [Sensor(1, np.abs, [[1.0]])] * 5
    f = make(
        LikelihoodConsensusFilter,
        sensors=sensors,
        basis=basis,
        model=still_model(1, 0.1),
    )
    g = make(ParticleFilter, sensors=sensors, model=still_model(1, 0.1))
    prior = ([0.5], [[1.0]])
    a = f.step(
        f.start(prior, rng=default_rng(0)), 1.0, [[0.5 + 0.1 * k] for k in range(5)]
    )
    b = g.step(
        g.start(prior, rng=default_rng(0)), 1.0, [[0.5 + 0.1 * k] for k in range(5)]
    )
    assert np.allclose(a.weights, b.weights, atol=1e-10)


def test_particles_that_contradict_an_observation_have_little_weight() -> None:
    """A likelihood of zero counts as the least of all others, and leaves the fit finite."""
    root = Sensor(1, lambda x: np.where(x > 0, x, np.nan), [[0.5]])
    sensors = [root] + [None] * 4
    f = make(
        LikelihoodConsensusFilter,
        sensors=sensors,
        basis=PolynomialBasis([0]),
        model=still_model(1, 0.1),
    )
    state = f.start(([0.5], [[1.0]]), rng=default_rng(0))
    state = f.step(state, 1.0, [[1.0], None, None, None, None])
    assert np.isfinite(state.log_weights).all()
    assert np.allclose(state.weights.sum(axis=-1), 1.0)
    # The mean moves towards what was seen, at all agents.
    assert (f.summarize(state).mean > 0.7).all()


def test_particles_without_weight_do_not_matter_wherever_they_are() -> None:
    """Five of them are put among the others or far away: no fit and no weight depends on it."""
    sensors = [distance([0], std=0.5, origin=[-3.0])] + [None] * 4
    options = {"sensors": sensors, "model": still_model(1), "ess_threshold": 0.0}
    f = make(
        LikelihoodConsensusFilter,
        basis=PolynomialBasis([0]),
        jitter=0.0,
        **options,
    )
    start = f.start(([0.5], [[1.0]]), rng=default_rng(0))
    logs = start.log_weights.copy()
    logs[:, :5] = -1e300
    logs[:, 5:] = -np.log(395)
    after = []
    for place in (0.0, 40.0):
        x = start.particles.copy()
        x[:, :5] = place
        state = start.replace(particles=x, log_weights=logs)
        after.append(f.step(state, 1.0, [[4.1], None, None, None, None]))
    assert (after[0].weights[:, :5] == 0).all()
    assert np.allclose(after[0].weights, after[1].weights, rtol=1e-9, atol=0)
    assert not np.allclose(after[0].weights, start.weights, rtol=0.1)


def test_gate_losses_runs_and_failures() -> None:
    _, seen = data(team(), (3,))
    # One observation of one run is far off.
    seen[0][2, 1] += 80.0
    rule = partial(average_consensus, rounds=20)
    f = make(
        LikelihoodConsensusFilter,
        fusion=rule,
        gate_probability=0.9999,
        faults=Faults(loss=0.1, seed=2),
    )
    state = f.start(PRIOR, rng=default_rng(3), runs=(3,))
    rejected = 0.0
    for k, t in enumerate(TIMES):
        observed = [None if y is None else y[k] for y in seen]
        state = f.step(state, float(t), observed)
        rejected += state.rejected
    assert rejected[1, 0] >= 1
    assert np.isfinite(f.summarize(state).mean).all()


def test_without_links_agents_use_their_own() -> None:
    _, seen = data(team())
    f = LikelihoodConsensusFilter(
        model(),
        team(),
        lambda t: np.zeros((5, 5)),
        basis=QUADRATIC,
        fusion=finite_time_consensus,
        members=400,
    )
    g = make(ParticleFilter, hops=1, share_observations=False)
    assert (last_of(f, seen).log_weights == last_of(g, seen).log_weights).all()


def test_what_is_refused() -> None:
    with pytest.raises(ValueError, match="^fusion must be a consensus rule"):
        make(LikelihoodConsensusFilter, fusion=None)
    with pytest.raises(ValueError, match="^fusion must be a rule that fuses vectors"):
        make(LikelihoodConsensusFilter, fusion=naive_fusion)
    with pytest.raises(ValueError, match="^sensors must not be increments here"):
        make(LikelihoodConsensusFilter, sensors=[increment([0], std=1.0)] * 5)
    seen = [[0.1], [0.1, 0.2], None, [0.1], [0.1, 0.2]]
    f = make(LikelihoodConsensusFilter, members=5)
    with pytest.raises(ValueError, match="^basis must have fewer functions than the 5"):
        f.step(f.start(PRIOR, rng=default_rng(0)), 0.1, seen)
    f = make(LikelihoodConsensusFilter, basis=lambda x: x[..., 0])
    with pytest.raises(ValueError, match="^basis must have"):
        f.step(f.start(PRIOR, rng=default_rng(0)), 0.1, seen)
    f = make(LikelihoodConsensusFilter, lag=1)
    # A kept time would be there for a delayed observation.
    state = f.step(f.start(PRIOR, rng=default_rng(0)), 0.1, seen)
    state = f.step(state, 0.2, seen)
    with pytest.raises(ValueError, match="^delayed must be empty here"):
        f.step(state, 0.3, seen, delayed=[Observation(0.2, 0, [0.3])])
