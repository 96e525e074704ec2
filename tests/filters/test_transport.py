"""Agents with one set of members in common: as good as one agent that reads every sensor."""

from __future__ import annotations

from dataclasses import replace
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

from .families import NOISE, PRIOR, TIMES, data, model

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
    t = state.t
    assert rng is not None
    stacked = stack([s for s in FOUR if s is not None])
    weight = np.linalg.inv(stacked.noise_cov)
    for k in range(steps):
        x = model().sample_step(x, t, TIMES[k] - t, rng=rng)
        t = TIMES[k]
        gap = np.concatenate([o[k] for o in seen]) - stacked.predict(x, None)
        x = transform_ensemble(x, -0.5 * np.einsum("ni,ij,nj->n", gap, weight, gap))
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
    state = list(f.steps(_start(f), TIMES, seen))[-1]
    assert np.abs(state.ensembles - _central(_start(f), seen, len(TIMES))).max() < bound


def test_only_log_likelihoods_are_sent() -> None:
    """Two rounds on a ring of four, thirty numbers to each of two neighbours, and no reading."""
    f = _filter()
    _, seen = data(FOUR)
    ledger = f.step(_start(f), TIMES[0], [o[0] for o in seen]).ledger
    assert ledger.rounds == 2
    assert (ledger.scalars == 2 * 2 * 30).all()


def test_an_agent_whom_nobody_hears_counts_its_own_reading_once() -> None:
    f = _filter(graph=Graph.from_edges(4, []))
    y = [[0.3], [1.0], [0.5, 0.2], [-0.4]]
    separate = f.step(_start(f), 0.5, y).ensembles
    for k in range(4):
        one = _filter(sensors=FOUR[k : k + 1], graph=None)
        single = one.step(_start(one), 0.5, [y[k]]).ensembles[0]
        assert np.allclose(single, separate[k], atol=1e-13)
    f = _filter(graph=lambda t: graphs.ring(4) if t > 0.7 else Graph.from_edges(4, []))
    for now, late in ((y, []), ([None] * 4, [Observation(0.5, 0, [0.3])])):
        with pytest.raises(
            ValueError, match="graph must have links for the observations of t = 0.6"
        ):
            replace(f, lag=1).step(_start(f).replace(t=0.5), 0.6, now, delayed=late)


def test_sets_stay_in_common_with_noise_and_rejuvenation_over_runs() -> None:
    f = _filter(rejuvenation=0.2, correct=True)
    _, seen = data(FOUR, (3,))
    state = _start(f, (3,))
    assert (state.ensembles == state.ensembles[:, :1]).all()
    last = list(f.steps(state, TIMES, seen))[-1].ensembles
    assert np.abs(last - last[:, :1]).max() < 1e-11
    assert np.abs(last[0] - last[1]).max() > 0.1


def test_a_late_reading_weighs_all_times_with_one_coupling() -> None:
    """Its likelihood multiplies today's, and every kept time gets the exact weighted mean."""
    f = _filter(sensors=FOUR, lag=2)
    state = _start(f)
    state = f.step(state, 0.5, [None] * 4)
    before = state.ensembles[0]
    plain = f.step(state, 1.0, [None] * 4).ensembles[0]
    after = f.step(
        state, 1.0, [None, None, None, [0.4]], delayed=[Observation(0.5, 0, [1.3])]
    )
    logs = (
        -0.5 * ((1.3 - before[:, 0]) / 0.6) ** 2
        - 0.5 * ((0.4 - plain[:, 0]) / 0.8) ** 2
    )
    w = np.exp(logs - logs.max())
    w /= w.sum()
    assert np.allclose(after.ensembles[2], transform_ensemble(plain, logs), atol=1e-11)
    assert np.allclose(after.history[-1][1][1].mean(axis=0), w @ before, atol=1e-12)


def test_weights_of_a_run_that_failed_are_no_collapse(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def wary(x: np.ndarray, logs: np.ndarray) -> np.ndarray:
        if np.ptp(logs, axis=-1).max() > 1e4:
            raise SolverError("too far")
        return transport_plans(x, logs)

    monkeypatch.setattr("distfilt.filters.ensemble.transport_plans", wary)
    f = TransportFilter(
        model(), [component([0], std=0.6)], None, members=30, on_error="keep"
    )
    start = f.start(PRIOR, rng=default_rng(0), runs=(2,))
    with pytest.warns(
        ParticleCollapse, match="squared distance from an ensemble's predictions"
    ):
        assert f.step(start, 0.5, [[[0.3], [3e4]]]).failed.tolist() == [False, True]


def test_a_step_without_any_reading_moves_nothing() -> None:
    f = _filter(rejuvenation=0.3)
    state = _start(f)
    after = f.step(state, 0.5, [None] * 4)
    rng = _start(f).rng
    assert rng is not None
    assert (
        after.ensembles[0] == model().sample_step(state.ensembles[0], 0.0, 0.5, rng=rng)
    ).all()
