"""Agents with one set of members in common: as good as one agent that reads every sensor."""

from __future__ import annotations

import warnings
from functools import partial
from typing import Any

import numpy as np
import pytest
from numpy.random import default_rng

from distfilt.coupling import transform_ensemble
from distfilt.coupling.transform import transport_plans
from distfilt.filters import Observation, ParticleCollapse, TransportFilter
from distfilt.filters.ensemble import EnsembleState
from distfilt.linalg import SolverError
from distfilt.network import Graph, average_consensus, graphs
from distfilt.sensors import Sensor, component, stack

from .families import NOISE, PRIOR, TIMES, data, model, still_model

FOUR: list[Sensor | None] = [
    component([0], std=0.6),
    component([1], std=0.5),
    Sensor(2, lambda x: x, NOISE),
    component([0], std=0.8),
]


def _filter(**options: Any) -> TransportFilter:
    options = {"members": 30} | options
    sensors = options.pop("sensors", FOUR)
    graph = options.pop("graph", graphs.ring(4))
    return TransportFilter(model(), sensors, graph, **options)


def _start(f: TransportFilter, runs: tuple[int, ...] = ()) -> EnsembleState:
    return f.start(PRIOR, rng=default_rng(2), runs=runs)


def _central(state: EnsembleState, seen: list[Any], steps: int) -> np.ndarray:
    """One agent with all sensors, written out; it draws the agents' common numbers."""
    x = state.ensembles[0]
    rng = state.rng
    assert rng is not None
    stacked = stack([s for s in FOUR if s is not None])
    weight = np.linalg.inv(stacked.noise_cov)
    t = state.t
    for k, now in enumerate(TIMES[:steps]):
        x = model().sample_step(x, t, now - t, rng=rng)
        t = now
        y = np.concatenate([o[k] for o in seen])
        innovation = y - stacked.predict(x, None)
        # log p(y | x) = -½ νᵀ R⁻¹ ν, the sum of the agents' log-likelihoods
        squared = np.einsum("ni,ij,nj->n", innovation, weight, innovation)
        x = transform_ensemble(x, -0.5 * squared)
    return x


@pytest.mark.parametrize(
    ("options", "bound"),
    [
        ({}, 1e-12),
        ({"fusion": partial(average_consensus, rounds=20)}, 1e-7),
        ({"fusion": partial(average_consensus, rounds=30)}, 1e-11),
    ],
)
def test_agents_with_different_sensors_are_one_central_filter(
    options: dict[str, Any], bound: float
) -> None:
    f = _filter(**options)
    _, seen = data(FOUR)
    *_, state = f.steps(_start(f), TIMES, seen)
    central = _central(_start(f), seen, len(TIMES))
    # Each agent has the sum of all log-likelihoods: exactly, or as far as rounds have converged.
    assert np.abs(state.ensembles - central).max() < bound


def test_only_log_likelihoods_are_sent() -> None:
    """Two rounds on a ring of four, thirty numbers to each of two neighbours, nothing else."""
    f = _filter()
    _, seen = data(FOUR)
    now = [o[0] for o in seen]
    ledger = f.step(_start(f), TIMES[0], now).ledger
    assert ledger.rounds == 2
    assert (ledger.scalars == 2 * 2 * 30).all()


def test_an_agent_whom_nobody_hears_counts_its_own_reading_once() -> None:
    no_links = Graph.from_edges(4, [])
    ring = graphs.ring(4)
    f = _filter(graph=no_links)
    y = [[0.3], [1.0], [0.5, 0.2], [-0.4]]
    separate = f.step(_start(f), 0.5, y).ensembles
    # Each agent is the filter of its own sensor, with the common draws.
    for k, sensor in enumerate(FOUR):
        one = _filter(sensors=[sensor], graph=None)
        single = one.step(_start(one), 0.5, [y[k]])
        assert np.allclose(single.ensembles[0], separate[k], atol=1e-13)
    # With links at some times, agents that observe apart would no longer have one set.
    f = _filter(graph=lambda t: ring if t > 0.7 else no_links, lag=1)
    state = _start(f).replace(t=0.5)
    delayed = [Observation(0.5, 0, [0.3])]
    message = "graph must have links for the observations of t = 0.6"
    for now, late in ((y, []), ([None] * 4, delayed)):
        with pytest.raises(ValueError, match=message):
            f.step(state, 0.6, now, delayed=late)


def test_sets_stay_in_common_with_noise_and_rejuvenation_over_runs() -> None:
    f = _filter(rejuvenation=0.2, correct=True)
    _, seen = data(FOUR, (3,))
    state = _start(f, (3,))
    assert (state.ensembles == state.ensembles[:, :1]).all()
    *_, last = f.steps(state, TIMES, seen)
    x = last.ensembles
    # Agents of one run have the same set, to rounding; runs differ.
    assert np.abs(x - x[:, :1]).max() < 1e-11
    assert np.abs(x[0] - x[1]).max() > 0.1


def test_a_late_reading_weighs_all_times_with_one_coupling() -> None:
    """Its likelihood multiplies today's, and every kept time gets the exact weighted mean."""
    f = _filter(sensors=FOUR, lag=2)
    state = _start(f)
    state = f.step(state, 0.5, [None] * 4)
    before = state.ensembles[0]
    plain = f.step(state, 1.0, [None] * 4).ensembles[0]
    delayed = [Observation(0.5, 0, [1.3])]
    after = f.step(state, 1.0, [None, None, None, [0.4]], delayed=delayed)
    # The sum of both log-likelihoods, each at the member's state of its time
    first = (1.3 - before[:, 0]) / 0.6
    second = (0.4 - plain[:, 0]) / 0.8
    logs = -0.5 * (first**2 + second**2)
    w = np.exp(logs - logs.max())
    w /= w.sum()
    expected = transform_ensemble(plain, logs)
    assert np.allclose(after.ensembles[2], expected, atol=1e-11)
    past = after.history[-1][1][1]
    assert np.allclose(past.mean(axis=0), w @ before, atol=1e-12)


def test_weights_of_a_run_that_failed_are_no_collapse(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    # A solver that gives up on the weights of a distant observation
    def wary(x: np.ndarray, logs: np.ndarray) -> np.ndarray:
        if np.ptp(logs, axis=-1).max() > 1e4:
            raise SolverError("too far")
        return transport_plans(x, logs)

    monkeypatch.setattr("distfilt.filters.ensemble.transport_plans", wary)
    f = TransportFilter(
        model(), [component([0], std=0.6)], None, members=30, on_error="keep"
    )
    start = f.start(PRIOR, rng=default_rng(0), runs=(2,))
    # Only the distance is warned of; a failed run has no weights that could collapse.
    message = "squared distance from an ensemble's predictions"
    with pytest.warns(ParticleCollapse, match=message):
        state = f.step(start, 0.5, [[[0.3], [3e4]]])
    assert state.failed.tolist() == [False, True]


@pytest.mark.parametrize(("size", "warns"), [(1.3, True), (1.9, True), (2.1, False)])
def test_a_warning_below_an_effective_size_of_two(size: float, warns: bool) -> None:
    # One member has the weight w and three have (1 - w) / 3: 1 / N_eff = w² + (1 - w)² / 3.
    w = np.roots([4.0, -2.0, 1.0 - 3.0 / size]).max()
    # The observed value is that of the first; the others have the likelihood exp(-v²/2).
    v = np.sqrt(2 * np.log(3 * w / (1 - w)))
    members = np.array([[0.0], [v], [v], [v]])
    f = TransportFilter(still_model(1), [component([0], std=1.0)], members=4)
    state = f.start(([0.0], [[1.0]]), rng=default_rng(0))
    state = state.replace(ensembles=members[None])
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", ParticleCollapse)
        f.step(state, 0.0, [[0.0]])
    collapses = [one for one in caught if one.category is ParticleCollapse]
    assert bool(collapses) == warns
    assert all("effective size" in str(one.message) for one in collapses)


def test_a_step_without_any_reading_moves_nothing() -> None:
    f = _filter(rejuvenation=0.3)
    state = _start(f)
    after = f.step(state, 0.5, [None] * 4)
    # Neither a transformation nor rejuvenation: only the model's step, with the same draws.
    rng = _start(f).rng
    assert rng is not None
    moved = model().sample_step(state.ensembles[0], 0.0, 0.5, rng=rng)
    assert (after.ensembles[0] == moved).all()
