"""Consensus on information and measurements, and diffusion: against the central filter."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
import pytest

from distfilt.filters import GaussianFilter, InformationConsensusFilter
from distfilt.models import Model
from distfilt.network import (
    Channel,
    Faults,
    average_consensus,
    diffuse_means,
    event_triggered,
    finite_time_consensus,
    graphs,
    information_consensus,
    naive_fusion,
    push_sum,
    weights,
)
from distfilt.periods import wrap_differences
from distfilt.sensors import Sensor, bearing, component
from tests.filters.families import (
    PRIOR,
    TIMES,
    Q,
    data,
    kalman,
    model,
    still_model,
    team,
)
from tests.network.helpers import gaussians, rng

AVERAGES = ("weighted", "hybrid", "measurements")
each_average = pytest.mark.parametrize("average", AVERAGES)
NET = graphs.grid(2, 3)
OPTIONS: dict[str, Any] = {"linearization": "extended"}


def observing(agents: int = 6) -> list[Any]:
    """Sensors of which every agent has one, so that stacking them is simple."""
    cov = np.array([[0.5, 0.2], [0.2, 0.4]])
    both = Sensor(2, lambda x: x, cov, linear=np.eye)
    kinds = [component([0], std=0.6), both, component([1], std=0.9)]
    return [kinds[k % 3] for k in range(agents)]


def last_of(f: Any, seen: Any, runs: tuple[int, ...] = ()) -> Any:
    start = f.start(PRIOR, runs=runs)
    *_, last = f.steps(start, TIMES, seen)
    return last


def consensus_filter(fusion: Any, **options: Any) -> InformationConsensusFilter:
    return InformationConsensusFilter(
        model(), observing(), options.pop("graph", NET), fusion=fusion, **options
    )


# The limits.


@each_average
@pytest.mark.parametrize("graph", [NET, graphs.ring(6), graphs.star(6)])
def test_exact_averages_give_the_filter_of_all_observations(
    average: str, graph: Any
) -> None:
    """In every step, with process noise and steps of any length."""
    _, seen = data(observing())
    expected, _ = kalman(seen, observing())
    f = consensus_filter(finite_time_consensus, average=average, graph=graph)
    # The Kalman filter of all agents' observations, step by step
    states = list(f.steps(f.start(PRIOR), TIMES, seen))
    for k, state in enumerate(states):
        assert np.allclose(state.means, expected.means[k], rtol=0, atol=1e-9)
        assert np.allclose(state.covariances, expected.covariances[k], atol=1e-9)


@each_average
def test_more_rounds_come_closer_to_it(average: str) -> None:
    _, seen = data(observing())
    expected, _ = kalman(seen, observing())
    errors = []
    for rounds in (1, 5, 25, 125):
        rule = partial(average_consensus, rounds=rounds)
        state = last_of(consensus_filter(rule, average=average), seen)
        errors.append(np.abs(state.means - expected.means[-1]).max())
    # Smaller from each number of rounds to the next
    assert errors == sorted(errors, reverse=True)
    assert errors[0] > 1e-2
    assert errors[-1] < 1e-9


def test_push_sum_on_a_digraph_serves_too() -> None:
    circle = graphs.Graph.from_edges(
        6, [(k, k - 1) for k in range(1, 6)] + [(0, 5)], directed=True
    )
    _, seen = data(observing())
    expected, _ = kalman(seen, observing())
    rule = partial(push_sum, rounds=300)
    state = last_of(consensus_filter(rule, graph=circle), seen)
    assert np.allclose(state.means, expected.means[-1], atol=1e-6)


def test_agents_may_send_only_what_has_changed() -> None:
    """An event-triggered average as the consensus rule: fewer numbers, a small error."""
    _, seen = data(observing())
    expected, _ = kalman(seen, observing())
    results = []
    for threshold in (0.0, 0.01):
        rule = partial(event_triggered, rounds=60, threshold=threshold)
        results.append(last_of(consensus_filter(rule), seen))
    always, seldom = results
    assert seldom.ledger.scalars.sum() < 0.6 * always.ledger.scalars.sum()
    assert np.abs(seldom.means - expected.means[-1]).max() < 0.1


# Equalities between the forms.


@pytest.mark.parametrize("rounds", [1, 3])
def test_weighted_is_hybrid_with_the_number_of_agents_for_half_the_numbers(
    rounds: int,
) -> None:
    """The sum of two averages is the average of the sum."""
    _, seen = data(observing())
    rule = partial(average_consensus, rounds=rounds)
    weighted = last_of(consensus_filter(rule), seen)
    hybrid = last_of(consensus_filter(rule, average="hybrid"), seen)
    # A ⟨Ω / A + δΩ⟩ = ⟨Ω⟩ + A ⟨δΩ⟩
    assert np.allclose(weighted.means, hybrid.means, rtol=0, atol=1e-12)
    assert np.allclose(weighted.covariances, hybrid.covariances, atol=1e-12)
    assert (hybrid.ledger.scalars == 2 * weighted.ledger.scalars).all()
    # Two components: 3 + 2 numbers on each link and round.
    sent = 5 * rounds * len(TIMES) * NET.out_degree
    assert (weighted.ledger.scalars == sent).all()


@pytest.mark.parametrize("rounds", [1, 3])
def test_hybrid_of_weight_one_is_consensus_on_information(rounds: int) -> None:
    _, seen = data(observing())
    rule = partial(average_consensus, rounds=rounds)
    hybrid = last_of(consensus_filter(rule, average="hybrid", weight=1.0), seen)
    f = GaussianFilter(
        model(),
        observing(),
        NET,
        share_observations=False,
        fusion=partial(information_consensus, consensus=rule),
    )
    fused = last_of(f, seen)
    assert np.allclose(hybrid.means, fused.means, rtol=0, atol=1e-12)
    assert np.allclose(hybrid.covariances, fused.covariances, atol=1e-12)


def test_consensus_on_information_is_intersection_by_the_weights_of_all_rounds() -> (
    None
):
    """P_i⁻¹ = Σ (W^L)_ij P_j⁻¹, and the same for the vectors."""
    m, p = gaussians(1, 6, d=3)
    rule = partial(average_consensus, rounds=4)
    means, covs = information_consensus((m, p), Channel(NET), consensus=rule)
    # Four rounds of mixing are one by the fourth power.
    w = np.linalg.matrix_power(weights.metropolis(NET).matrix.toarray(), 4)
    information = np.linalg.inv(p)
    expected = np.linalg.inv(np.einsum("ij,jkl->ikl", w, information))
    vectors = (information @ m[..., None])[..., 0]
    assert np.allclose(covs, expected, rtol=1e-7)
    expected_means = (expected @ (w @ vectors)[..., None])[..., 0]
    assert np.allclose(means, expected_means, rtol=1e-6, atol=1e-8)


def test_consensus_on_information_is_consistent_for_any_correlation() -> None:
    """The covariance of the fused errors is below the one that is reported."""
    d, agents = 2, 6
    rule = partial(average_consensus, rounds=2)
    w = np.linalg.matrix_power(weights.metropolis(NET).matrix.toarray(), 2)
    broken = 0
    for seed in range(50):
        # Errors of all agents with a random joint covariance
        root = rng(seed).standard_normal((d * agents, 4))
        joint = root @ root.T + 0.1 * np.eye(d * agents)
        blocks = joint.reshape(agents, d, agents, d)
        p = np.array([blocks[k, :, k] for k in range(agents)])
        _, covs = information_consensus(
            (np.zeros((agents, d)), p), Channel(NET), consensus=rule
        )
        information = np.linalg.inv(p)
        _, naive = naive_fusion((np.zeros((agents, d)), p), Channel(NET))
        for i in range(agents):
            gains = np.array(
                [covs[i] @ information[j] * w[i, j] for j in range(agents)]
            )
            # Σ_jk K_j C_jk K_kᵀ
            error = np.einsum("iab,ibjc,jdc->ad", gains, blocks, gains)
            smallest = np.linalg.eigvalsh(covs[i] - error)[0]
            assert smallest > -1e-9 * np.trace(error)
            # Control: the product of the neighbours' densities is not.
            near = [i, *NET.neighbours(i)]
            gains = np.array(
                [naive[i] @ information[j] * (j in near) for j in range(agents)]
            )
            error = np.einsum("iab,ibjc,jdc->ad", gains, blocks, gains)
            broken += np.linalg.eigvalsh(naive[i] - error)[0] < 0
    assert broken > 100


# Diffusion.


@pytest.mark.parametrize("rounds", [1, 2])
def test_the_diffusion_kalman_filter_by_its_algorithm(rounds: int) -> None:
    """Algorithm 2 of Cattivelli and Sayed, agent by agent, in information form."""
    _, seen = data(observing())
    f = GaussianFilter(
        model(), observing(), NET, fusion=partial(diffuse_means, rounds=rounds)
    )
    state = f.start(PRIOR)
    c = np.linalg.matrix_power(weights.metropolis(NET).matrix.toarray(), rounds)
    x = np.tile(PRIOR[0], (6, 1))
    p = np.tile(PRIOR[1], (6, 1, 1))
    for k, t in enumerate(TIMES):
        state = f.step(state, float(t), [y[k] for y in seen])
        dt = float(np.diff(TIMES, prepend=0.0)[k])
        move = model().F(dt)
        x = x @ move.T
        p = move @ p @ move.T + dt * Q
        psi = np.empty_like(x)
        for agent in range(6):
            # The incremental update: own and neighbours' observations, in information form
            information = np.linalg.inv(p[agent])
            total = information.copy()
            vector = np.zeros(2)
            for j in (agent, *NET.neighbours(agent)):
                sensor = observing()[j]
                h = sensor.H(2)
                gain = h.T @ np.linalg.inv(sensor.noise_cov)
                total += gain @ h
                vector += gain @ (seen[j][k] - h @ x[agent])
            p[agent] = np.linalg.inv(total)
            psi[agent] = x[agent] + p[agent] @ vector
        # The diffusion update
        x = c @ psi
        assert np.allclose(state.means, x, rtol=0, atol=1e-10)
        assert np.allclose(state.covariances, p, rtol=0, atol=1e-10)


def test_diffusion_on_a_complete_graph_is_the_filter_of_all_observations() -> None:
    _, seen = data(observing())
    expected, _ = kalman(seen, observing())
    f = GaussianFilter(model(), observing(), graphs.complete(6), fusion=diffuse_means)
    assert np.allclose(last_of(f, seen).means, expected.means[-1])


def test_a_negative_weight_is_refused() -> None:
    matrix = weights.ConsensusWeights(
        graphs.path(2), np.array([-0.5, -0.5]), np.array([1.5, 1.5])
    )
    text = r"^weights must be nonnegative, got -0\.5"
    with pytest.raises(ValueError, match=text):
        diffuse_means(gaussians(1, 2), Channel(graphs.path(2)), weights=matrix)


# All else that a filter meets.


@each_average
def test_missing_components_agents_without_sensors_and_known_constants(
    average: str,
) -> None:
    sensors = team(6)
    _, seen = data(sensors)
    values = [None if y is None else y.copy() for y in seen]
    assert values[1] is not None
    # Every other time the first of two components is missing.
    values[1][::2, 0] = np.nan
    f = InformationConsensusFilter(
        model(), sensors, NET, fusion=finite_time_consensus, average=average
    )
    g = GaussianFilter(model(), sensors, NET, hops="all")
    assert np.allclose(last_of(f, values).means, last_of(g, values).means, atol=1e-9)


def test_a_constant_that_all_know_in_consensus_on_measurements() -> None:
    f = InformationConsensusFilter(
        still_model(2),
        [component([0], std=1.0)] * 6,
        NET,
        fusion=finite_time_consensus,
        average="measurements",
    )
    start = f.start(([0.0, 5.0], np.diag([1.0, 0.0])))
    state = f.step(start, 1.0, [[2.0]] * 6)
    # Six observations of 2 and a prior of 0 with equal weights
    assert np.allclose(state.means, [12 / 7, 5.0])
    assert np.allclose(state.covariances[:, 0, 0], 1 / 7)


def test_without_links_agents_filter_alone() -> None:
    _, seen = data(observing())
    # No rule is applied, and a sum needs no average.
    f = consensus_filter(average_consensus, graph=lambda t: np.zeros((6, 6)))
    g = GaussianFilter(model(), observing(), share_observations=False)
    assert np.allclose(last_of(f, seen).means, last_of(g, seen).means)


@pytest.mark.parametrize("linearization", ["extended", "unscented"])
def test_angles_and_nonlinear_sensors(linearization: Any) -> None:
    """As Kalman filters that flood their bearings, as long as their means are equal."""
    places = [
        [-2.0, 0.0],
        [0.0, -2.0],
        [2.0, 0.0],
        [0.0, 2.0],
        [2.0, 2.0],
        [-2.0, 2.0],
    ]
    sensors = [bearing([0, 1], std=0.05, origin=p) for p in places]
    options: dict[str, Any] = {"linearization": linearization}
    f = InformationConsensusFilter(
        still_model(2), sensors, NET, fusion=finite_time_consensus, **options
    )
    g = GaussianFilter(still_model(2), sensors, NET, hops="all", **options)
    prior = ([0.5, 0.3], 0.01 * np.eye(2))
    # Observations without noise of a place within the prior's spread
    seen = [s.predict(np.array([0.45, 0.35])) for s in sensors]
    one = f.step(f.start(prior), 1.0, seen)
    other = g.step(g.start(prior), 1.0, seen)
    assert np.allclose(one.means, other.means, atol=1e-3)
    assert np.ptp(one.means, axis=0).max() < 1e-12


@each_average
@pytest.mark.parametrize("linearization", ["extended", "unscented"])
def test_a_turn_of_everything_turns_the_estimates(
    average: str, linearization: Any
) -> None:
    """The cut of an angle is nowhere: agents on both sides of it fuse as any others do."""
    turn = 2 * np.pi
    still = Model(
        2, lambda x, t, dt: x, lambda t, dt: 0.01 * np.eye(2), periods={0: turn}
    )
    compass = component([0, 1], std=0.3, periods=(turn, None))
    f = InformationConsensusFilter(
        still,
        [compass] * 6,
        NET,
        fusion=partial(average_consensus, rounds=2),
        average=average,
        linearization=linearization,
    )
    draw = rng(4)
    headings = 0.2 * draw.standard_normal((6, 2))
    observed = headings + 0.3 * draw.standard_normal((2, 6, 2))
    cov = np.array([[0.04, 0.01], [0.01, 0.05]])

    def run_turned(angle: float) -> Any:
        by = np.array([angle, 0.0])
        state = f.start([(m, cov) for m in headings + by])
        for k, y in enumerate(observed + by, start=1):
            wrapped = wrap_differences(y, still.periods)
            state = f.step(state, float(k), list(wrapped))
        return state

    reference = run_turned(0.0)
    for angle in np.linspace(0.5, turn, 7):
        state = run_turned(angle)
        change = state.means - reference.means - [angle, 0.0]
        assert np.allclose(wrap_differences(change, still.periods), 0.0, atol=1e-9)
        assert np.allclose(state.covariances, reference.covariances, atol=1e-12)


def test_runs_of_a_batch_lose_their_own_messages() -> None:
    _, seen = data(observing(), (8,))
    rule = partial(average_consensus, rounds=6)
    f = consensus_filter(rule, faults=Faults(loss=0.2, seed=3))
    exact = consensus_filter(rule)
    state = last_of(f, seen, (8,))
    assert np.isfinite(state.means).all()
    # Lost messages change every run, and spoil none.
    expected = last_of(exact, seen, (8,))
    difference = np.abs(state.means - expected.means).max(axis=(1, 2))
    assert (difference > 1e-6).all()
    assert (np.linalg.eigvalsh(state.covariances) > 0).all()


def test_a_failed_run_leaves_the_others_alone() -> None:
    _, seen = data(observing(), (3,))
    rule = partial(average_consensus, rounds=2)
    f = consensus_filter(rule, on_error="keep")
    bad = [y.copy() for y in seen]
    bad[0][2, 1] = 1e308
    with np.errstate(all="ignore"):
        state = last_of(f, bad, (3,))
    good = last_of(f, seen, (3,))
    assert state.failed.tolist() == [False, True, False]
    assert np.allclose(state.means[[0, 2]], good.means[[0, 2]])


def test_what_is_refused() -> None:
    with pytest.raises(ValueError, match=r"^fusion must be a consensus rule, such as"):
        consensus_filter(None)
    with pytest.raises(ValueError, match="^fusion must be a rule that fuses vectors"):
        consensus_filter(naive_fusion)
    with pytest.raises(ValueError, match="^weight must be None for the average"):
        consensus_filter(average_consensus, weight=2.0)


def test_a_known_constant_is_refused_where_all_information_is_averaged() -> None:
    rest = still_model(2)
    prior = (np.zeros(2), np.diag([1.0, 0.0]))
    sensors = [component([0], std=1.0)] * 2
    options: dict[str, Any] = {"fusion": finite_time_consensus}
    for average in ("weighted", "hybrid"):
        f = InformationConsensusFilter(
            rest, sensors, graphs.path(2), average=average, **options
        )
        with pytest.raises(ValueError, match="got the variance 0 of component 1"):
            f.start(prior)
    # Both observations: P = 1 / (1 + 2), and the constant stays what it is.
    f = InformationConsensusFilter(
        rest, sensors, graphs.path(2), average="measurements", **options
    )
    state = f.step(f.start(prior), 0.0, [[3.0], [3.0]])
    assert np.allclose(state.means, [2.0, 0.0])
    assert np.allclose(state.covariances[:, 0, 0], 1 / 3)
    assert (state.covariances[:, 1] == 0).all()
