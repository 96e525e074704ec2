"""Every option of every family of filters does something: it changes some number of a run.

For each field of a family a value other than its default is given, and the run's record, its last
state or its error differ. An option that a constructor takes and drops fails here; so does a new
field without an entry. Source: own.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields
from functools import partial
from typing import Any

import numpy as np
import pytest

from distfilt import density, filters, network
from distfilt.mixtures import split_gaussian, target_fusion
from distfilt.models import Model, Swarm
from distfilt.network import Faults, Graph, graphs
from distfilt.sensors import component, distance
from distfilt.updates import enkf, enkf_exact
from distfilt.updates.gaussian import exact_forecast

TIMES = [0.5, 1.0, 1.5, 2.0]
# An observation far off, which a gate refuses.
SERIES = [[[1.0], [1.2], [30.0], [1.1]], [[2.2], [2.0], [2.1], [2.2]], None]
MEAN = np.array([1.0, 2.0])
COV = np.array([[1.0, 0.2], [0.2, 0.5]])


def bend(x: np.ndarray, t: float, dt: float) -> np.ndarray:
    moved = x[..., 0] + dt * np.sin(x[..., 1])
    return np.stack([moved, x[..., 1]], axis=-1)


MODEL = Model(2, bend, lambda t, dt: 0.05 * dt * np.eye(2))
OTHER_MODEL = Model(2, bend, lambda t, dt: 0.5 * dt * np.eye(2))
NOISY_MODEL = Model(2, bend, lambda t, dt: dt * np.eye(2))
FAILING = Model(
    2,
    lambda x, t, dt: np.where(x > 50, np.nan, x),
    lambda t, dt: np.zeros((2, 2)),
)
SENSORS = [component([0], std=0.5), distance([0, 1], std=0.5), None]
OTHER_SENSORS = [component([0], std=0.5), distance([0, 1], std=0.1), None]


def pull_to_average(beliefs: np.ndarray, channel: network.Channel) -> np.ndarray:
    """Move every agent's members towards the average of all, without messages."""
    return beliefs + 0.1 * (beliefs.mean(axis=-3, keepdims=True) - beliefs)


def fail_in_one_run(beliefs: np.ndarray, channel: network.Channel) -> np.ndarray:
    """Fail if the first agent of some run believes in a first component above 4."""
    # Cells are counted along the second axis first: 36 for each value of the first.
    if (beliefs[..., 0, :].argmax(axis=-1) > 24 * 36).any():
        raise np.linalg.LinAlgError("a rule that fails")
    return beliefs


def outcome(make: Callable[..., Any], options: dict[str, Any]) -> Any:
    """Return all numbers of a run, or its error, as something that can be compared."""
    options = dict(options)
    prior = options.pop("prior", (MEAN, COV))
    series = options.pop("series", SERIES)
    runs = options.pop("runs", ())
    # One run of several starts where its model fails.
    is_split = options.pop("one_run_fails", False)
    f = make(**options)
    start = f.start(prior, rng=np.random.default_rng(3), runs=runs)
    if is_split:
        name, _ = start.belief_field
        name = "joint_means" if name == "joint_covariances" else name
        belief = getattr(start, name).copy()
        belief[0] += 100.0
        start = start.replace(**{name: belief})
    try:
        run = f.run(start, TIMES, series)
    except (filters.FilterError, ValueError) as error:
        return type(error).__name__
    # All variables of the record, and the times that the last state keeps
    last = f.final_state(run)
    result = {name: np.asarray(run[name].values) for name in run.variables}
    result["times"] = np.array(last.times)
    return result


def differ(a: Any, b: Any) -> bool:
    """Whether two outcomes differ in some number."""
    if isinstance(a, str) or isinstance(b, str):
        return type(a) is not type(b) or a != b
    if a.keys() != b.keys():
        return True
    for name in a:
        if a[name].dtype.kind in "fiu":
            same = np.array_equal(a[name], b[name], equal_nan=True)
        else:
            same = np.array_equal(a[name], b[name])
        if not same:
            return True
    return False


SHARED: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
    "model": ({}, {"model": OTHER_MODEL}),
    "sensors": ({}, {"sensors": OTHER_SENSORS}),
    "graph": ({}, {"graph": graphs.complete(3)}),
    "gate_probability": ({}, {"gate_probability": 0.99}),
    "faults": ({}, {"faults": Faults(silent=[0])}),
    "names": ({}, {"names": ["a", "b", "c"]}),
}
"""Of each field: options that both runs have, and those that only the second has."""

BATCHED = {
    "on_error": (
        {"model": FAILING, "runs": (2,), "one_run_fails": True, "fusion": None},
        {"on_error": "keep"},
    ),
    "lag": ({}, {"lag": 2}),
    "record_evidence": ({}, {"record_evidence": True}),
}
BATCHED_ALONE = (
    {"model": FAILING, "runs": (2,), "one_run_fails": True},
    {"on_error": "keep"},
)
SHARING = {
    "share_observations": ({}, {"share_observations": False}),
    "exchange_interval": ({"lag": 3}, {"exchange_interval": 1.0}),
    "hops": ({}, {"hops": "all"}),
}
AVERAGE = partial(network.average_consensus, rounds=2)
MIXED_PRIOR = split_gaussian(MEAN, COV, parts=3, axes=[0])


def quadratic_basis(x: np.ndarray) -> np.ndarray:
    """Polynomials of the first component up to the second degree."""
    return filters.PolynomialBasis([0], degree=2)(x)


# The outlier is nearer, so that the belief stays in the box.
NEAR_SERIES = [[[1.0], [1.2], [7.0], [1.1]], *SERIES[1:]]
# Two runs, of which the first has observations of 6.
SPLIT_SERIES = [np.array([[[6.0], [1.0]]] * 4), None, None]
CELLS = density.Grid((36, 36), low=-8.0, high=10.0)
FINER_CELLS = density.Grid((45, 45), low=-8.0, high=10.0)
SPLIT = {"split_threshold": 0.01, "max_components": 4, "n_components": 2}
MIXTURE = {
    "target_dim": (
        {"fusion": partial(target_fusion, target_dim=1)},
        {"target_dim": 2, "fusion": partial(target_fusion, target_dim=2)},
    ),
    "n_components": (SPLIT, {"n_components": 1}),
    "max_components": (SPLIT, {"max_components": 3}),
    "split_threshold": ({"max_components": 4, "n_components": 2}, SPLIT),
    "split_scale": (SPLIT, {"split_scale": [1e-3, 1e3]}),
}

BASE = {"model": MODEL, "sensors": SENSORS, "graph": graphs.path(3)}
PLACES = np.random.default_rng(0).random((4, 3, 2))
SWARM = density.FokkerPlanck(Swarm(lambda x, t: 0.2 - x, 0.02), density.Grid((6, 6)))
OTHER_SWARM = density.FokkerPlanck(
    Swarm(lambda x, t: 0 * x, 0.02), density.Grid((6, 6))
)
DENSITY_BASE = {
    "model": SWARM,
    "sensors": 3,
    "graph": graphs.path(3),
    "fusion": density.Flooding(),
    "bandwidth": 0.2,
    "rank": 9,
    "prior": PLACES[0],
    "series": [PLACES[:, k] for k in range(3)],
}

CASES: dict[str, tuple[type[Any], dict[str, Any], dict[str, Any]]] = {
    "gaussian": (
        filters.GaussianFilter,
        BASE,
        {
            **SHARED,
            **BATCHED,
            **SHARING,
            "fusion": ({}, {"fusion": network.covariance_intersection}),
            "linearization": ({}, {"linearization": "unscented"}),
            "iterations": ({}, {"iterations": 3}),
            "kappa": ({"linearization": "unscented"}, {"kappa": 3.0}),
            "inflation": ({}, {"inflation": 1.1}),
        },
    ),
    "ensemble": (
        filters.EnsembleFilter,
        {**BASE, "members": 30},
        {
            **SHARED,
            **BATCHED,
            **SHARING,
            "fusion": ({}, {"fusion": pull_to_average}),
            "members": ({}, {"members": 31}),
            "update": ({"update": enkf}, {"update": enkf_exact}),
            "forecast": ({}, {"forecast": exact_forecast}),
        },
    ),
    "particle": (
        filters.ParticleFilter,
        {**BASE, "members": 300},
        {
            **SHARED,
            **BATCHED,
            **SHARING,
            "fusion": ({}, {"fusion": pull_to_average}),
            "members": ({}, {"members": 301}),
            "ess_threshold": ({}, {"ess_threshold": 1.0}),
            "jitter": ({}, {"jitter": 0.2}),
        },
    ),
    "transport": (
        filters.TransportFilter,
        {**BASE, "members": 30},
        {
            **SHARED,
            **BATCHED,
            # Exact averages are the same on every graph, so that one of two rounds is used.
            "graph": (
                {"fusion": partial(network.average_consensus, rounds=2)},
                {"graph": graphs.complete(3)},
            ),
            "faults": (
                {"fusion": partial(network.average_consensus, rounds=2)},
                {"faults": Faults(loss=0.5, seed=1)},
            ),
            "on_error": (
                {"model": FAILING, "runs": (2,), "one_run_fails": True},
                {"on_error": "keep"},
            ),
            "fusion": ({}, {"fusion": partial(network.average_consensus, rounds=2)}),
            "members": ({}, {"members": 31}),
            "correct": ({}, {"correct": True}),
            "rejuvenation": ({}, {"rejuvenation": 0.1}),
        },
    ),
    "mixture": (
        filters.MixtureFilter,
        {**BASE, "target_dim": 1, "fusion": partial(target_fusion, target_dim=1)},
        {
            **SHARED,
            **MIXTURE,
            "fusion": ({}, {"fusion": None}),
            "exchange_interval": ({}, {"exchange_interval": 1.0}),
        },
    ),
    "increments": (
        filters.InformationIncrementFilter,
        {**BASE, "target_dim": 1, "model": MODEL},
        {
            **SHARED,
            **MIXTURE,
            "target_dim": ({}, {"target_dim": 2}),
            "exchange_interval": ({}, {"exchange_interval": 1.0}),
            "shared_components": ({}, {"shared_components": [0]}),
        },
    ),
    "channel": (
        filters.ChannelFilter,
        {**BASE},
        {
            **SHARED,
            "graph": ({}, {"graph": Graph.from_edges(3, [(0, 2), (2, 1)])}),
            "on_error": BATCHED_ALONE,
            "record_evidence": ({}, {"record_evidence": True}),
            "linearization": ({}, {"linearization": "unscented"}),
            "kappa": ({"linearization": "unscented"}, {"kappa": 3.0}),
            "inflation": ({}, {"inflation": 1.1}),
        },
    ),
    "likelihood consensus": (
        filters.LikelihoodConsensusFilter,
        {
            **BASE,
            "members": 300,
            "fusion": AVERAGE,
            "basis": filters.PolynomialBasis([0, 1]),
        },
        {
            **SHARED,
            "faults": ({}, {"faults": Faults(loss=0.5, seed=1)}),
            "on_error": BATCHED_ALONE,
            "record_evidence": ({}, {"record_evidence": True}),
            "lag": ({}, {"lag": 2}),
            "fusion": ({}, {"fusion": network.finite_time_consensus}),
            "members": ({}, {"members": 301}),
            "ess_threshold": ({}, {"ess_threshold": 1.0}),
            "jitter": ({}, {"jitter": 0.2}),
            "basis": ({}, {"basis": quadratic_basis}),
        },
    ),
    "grid": (
        filters.GridFilter,
        {**BASE, "grid": CELLS, "model": OTHER_MODEL, "series": NEAR_SERIES},
        {
            **SHARED,
            "model": ({}, {"model": NOISY_MODEL}),
            "on_error": (
                {"runs": (2,), "series": SPLIT_SERIES, "fusion": fail_in_one_run},
                {"on_error": "keep"},
            ),
            "record_evidence": ({}, {"record_evidence": True}),
            "share_observations": ({}, {"share_observations": False}),
            "hops": ({}, {"hops": "all"}),
            "fusion": ({}, {"fusion": AVERAGE}),
            "fused": (
                {"share_observations": False, "fusion": AVERAGE},
                {"fused": "likelihoods"},
            ),
            "grid": ({}, {"grid": FINER_CELLS}),
        },
    ),
    "information consensus": (
        filters.InformationConsensusFilter,
        {**BASE, "fusion": AVERAGE},
        {
            **SHARED,
            "faults": ({}, {"faults": Faults(loss=0.5, seed=1)}),
            "on_error": BATCHED_ALONE,
            "record_evidence": ({}, {"record_evidence": True}),
            "fusion": ({}, {"fusion": network.finite_time_consensus}),
            "average": ({}, {"average": "hybrid"}),
            "weight": ({"average": "hybrid"}, {"weight": 2.0}),
            "linearization": ({}, {"linearization": "unscented"}),
            "kappa": ({"linearization": "unscented"}, {"kappa": 3.0}),
            "inflation": ({}, {"inflation": 1.1}),
        },
    ),
    "sum": (
        filters.GaussianSumFilter,
        {**BASE, "prior": MIXED_PRIOR},
        {
            **SHARED,
            "on_error": BATCHED_ALONE,
            "record_evidence": ({}, {"record_evidence": True}),
            "share_observations": ({}, {"share_observations": False}),
            "hops": ({}, {"hops": "all"}),
            "linearization": ({}, {"linearization": "unscented"}),
            "kappa": ({"linearization": "unscented"}, {"kappa": 3.0}),
            "inflation": ({}, {"inflation": 1.1}),
        },
    ),
    "density": (
        filters.DensityFilter,
        DENSITY_BASE,
        {
            "model": ({}, {"model": OTHER_SWARM}),
            "sensors": (
                {},
                {
                    "sensors": 4,
                    "graph": graphs.path(4),
                    "prior": np.vstack([PLACES[0], [[0.5, 0.5]]]),
                    "series": [*DENSITY_BASE["series"], None],
                },
            ),
            "graph": ({}, {"graph": graphs.complete(3)}),
            "fusion": ({}, {"fusion": density.Neighbours()}),
            "bandwidth": ({}, {"bandwidth": 0.3}),
            "local": ({}, {"local": [0, 2]}),
            "initial_density": ({}, {"initial_density": "observed"}),
            "initial_std": ({}, {"initial_std": 0.6}),
            "rank": ({}, {"rank": 12}),
            "prior_length": ({}, {"prior_length": 0.7}),
            "prior_std": ({}, {"prior_std": 7.0}),
            "mass_std": ({}, {"mass_std": 0.7}),
            "noise": ({}, {"noise": "observed"}),
            "floor": ({}, {"floor": 0.5}),
            "process": ({}, {"process": 0.5}),
            "exchange_interval": ({}, {"exchange_interval": 1.0}),
            "faults": ({}, {"faults": Faults(silent=[0])}),
            "names": ({}, {"names": ["a", "b", "c"]}),
        },
    ),
}

PAIRS = [(family, name) for family, (_, _, cases) in CASES.items() for name in cases]


@pytest.mark.parametrize("family", CASES)
def test_every_field_has_a_case(family: str) -> None:
    cls, _, cases = CASES[family]
    # A new option without a case fails here.
    names = {field.name for field in fields(cls) if field.init}
    assert names == set(cases)


def test_every_family_of_the_package_has_cases() -> None:
    public = [getattr(filters, name) for name in filters.__all__]
    # Families that can be made, without the bases that they share
    concrete = {
        cls
        for cls in public
        if isinstance(cls, type)
        and issubclass(cls, filters.Filter)
        and cls.__name__.endswith("Filter")
        and cls not in (filters.Filter, filters.SensorFilter)
    }
    assert concrete == {cls for cls, _, _ in CASES.values()}


@pytest.mark.filterwarnings("ignore::distfilt.filters.ParticleCollapse")
@pytest.mark.parametrize(("family", "name"), PAIRS)
def test_another_value_of_an_option_changes_a_run(family: str, name: str) -> None:
    cls, base, cases = CASES[family]
    common, second = cases[name]
    before = outcome(cls, {**base, **common})
    after = outcome(cls, {**base, **common, **second})
    # Only without `on_error` a run fails, and never with the second options.
    assert isinstance(before, str) == (name == "on_error"), before
    assert not isinstance(after, str), after
    assert differ(before, after)
    # The comparison itself sees equal runs as equal.
    assert not differ(after, outcome(cls, {**base, **common, **second}))
