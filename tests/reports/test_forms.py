"""The same numbers in every form in which data come, and in any unit, in every family.

| Report | Situation |
|---|---|
| ultralytics/ultralytics pull 25499 | a state of single precision at the first step only |
| dstl/Stone-Soup 195 | integers in a prior or an observation, in an unscented filter |
| oseiskar/simdkalman 10 | tables and series with an index, where arrays are meant |
| pasteurlabs/tesseract-core pull 712 | units eighteen orders of magnitude apart in one state |
| probabilistic-numerics/probnum pull 323 | differences over a fixed step in small units |
| cselab/korali 341, eldarrak/FLightR pull 40 | a run that is resumed from a file |
| ksakmann/Particle-Filter 1 | a step that changes what it was given |

A filter gets the same numbers as plain arrays of float64: its results must be the same to the bit,
or, in other units, to rounding.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from distfilt import density, filters, network
from distfilt.filters import final_state
from distfilt.models import Model
from distfilt.network import graphs
from distfilt.sensors import Sensor, component
from distfilt.updates import etkf, etpf, transport_map_update

PAIR = graphs.complete(2)
BASIS = filters.PolynomialBasis([0, 1])
FAMILIES: dict[str, Callable[..., Any]] = {
    "extended": filters.GaussianFilter,
    "unscented": partial(filters.GaussianFilter, linearization="unscented"),
    "iterated": partial(filters.GaussianFilter, iterations=3),
    "ensemble": partial(filters.EnsembleFilter, members=30),
    "exact": partial(filters.EnsembleFilter.exact, members=30),
    "square root": partial(filters.EnsembleFilter, update=etkf, members=30),
    "coupling": partial(filters.EnsembleFilter, update=etpf, members=30),
    "maps": partial(filters.EnsembleFilter, update=transport_map_update, members=30),
    "particle": partial(filters.ParticleFilter, members=200),
    "transport": partial(filters.TransportFilter, members=30),
    "mixture": partial(filters.MixtureFilter, target_dim=2),
    "increments": partial(filters.InformationIncrementFilter, target_dim=2),
    "sum": filters.GaussianSumFilter,
    "information": partial(
        filters.InformationConsensusFilter, fusion=network.average_consensus
    ),
    "channel": filters.ChannelFilter,
    "likelihood": partial(
        filters.LikelihoodConsensusFilter,
        members=200,
        basis=BASIS,
        fusion=network.finite_time_consensus,
    ),
    "grid": filters.GridFilter,
}
EACH = pytest.mark.parametrize("family", FAMILIES)
# Values that single precision and integers hold without rounding
MEAN = np.array([1.0, -2.0])
COV = np.array([[4.0, 1.0], [1.0, 2.0]])
SEEN = np.array([[[2.0], [1.0], [3.0]], [[-1.0], [-3.0], [-2.0]]])
TIMES = np.array([1.0, 2.0, 4.0])


class Tensor:
    """An array of another library, which numpy can read."""

    def __init__(self, values: Any) -> None:
        self.values = np.asarray(values, dtype=np.float32)

    def __array__(self, dtype: Any = None, copy: Any = None) -> np.ndarray:
        return np.array(self.values, dtype=dtype)


def read_only(values: np.ndarray) -> np.ndarray:
    result = np.asfortranarray(values)
    result.flags.writeable = False
    return result


def as_table(values: np.ndarray) -> Any:
    """A table, or a series, with an index that does not start at zero."""
    index = range(5, 5 + len(values))
    if values.ndim == 1:
        return pd.Series(values, index=index)
    columns = list("yxw")[: values.shape[1]]
    return pd.DataFrame(values, index=index, columns=columns)


FORMS: dict[str, Callable[[np.ndarray], Any]] = {
    "lists of integers": lambda a: a.astype(int).tolist(),
    "integers of eight bits": lambda a: a.astype(np.int8),
    "single precision": lambda a: a.astype(np.float32),
    "another byte order": lambda a: a.astype(">f8"),
    "objects": lambda a: a.astype(object),
    "a view backwards": lambda a: a[::-1].copy()[::-1],
    "read-only": read_only,
    "a tensor": Tensor,
    "a table": as_table,
}


def make(family: str, scales: Any = (1.0, 1.0)) -> Any:
    """A filter of two agents, each of which observes a component, in units of the scales."""
    scales = np.asarray(scales)
    # A covariance has the products of the units.
    unit = np.outer(scales, scales)
    q = np.array([[0.5, 0.1], [0.1, 0.3]])
    motion = Model(2, lambda x, t, dt: x, lambda t, dt: dt * q * unit)
    sensors = [component([k], std=0.5 * scales[k]) for k in range(2)]
    options = {}
    if family == "grid":
        edge = 12 * scales
        options["grid"] = density.Grid((40, 40), low=-edge, high=edge)
    return FAMILIES[family](motion, sensors, PAIR, **options)


def run_of(f: Any, prior: Any, times: Any, seen: Any) -> tuple[np.ndarray, np.ndarray]:
    start = f.start(prior, rng=np.random.default_rng(3))
    run = f.run(start, times, seen)
    return run["mean"].values, run["variance"].values


@EACH
@pytest.mark.parametrize("form", FORMS)
def test_the_same_numbers_in_another_form(family: str, form: str) -> None:
    convert = FORMS[form]
    f = make(family)
    plain = run_of(f, (MEAN, COV), TIMES, list(SEEN))
    prior = (convert(MEAN), convert(COV))
    seen = [convert(y) for y in SEEN]
    other = run_of(f, prior, convert(TIMES), seen)
    assert np.array_equal(plain[0], other[0])
    assert np.array_equal(plain[1], other[1])


@EACH
@pytest.mark.parametrize("scales", [(1e-9, 1e-9), (1e9, 1e9), (1e-9, 1e9)])
def test_other_units(family: str, scales: tuple[float, float]) -> None:
    if family in ("coupling", "transport") and scales[0] != scales[1]:
        pytest.skip(
            "the distance between members adds components, whatever their units"
        )
    mean, variance = run_of(make(family), (MEAN, COV), TIMES, list(SEEN))
    u = np.array(scales)
    seen = [SEEN[k] * u[k] for k in range(2)]
    prior = (MEAN * u, COV * np.outer(u, u))
    scaled = run_of(make(family, scales), prior, TIMES, seen)
    assert np.allclose(scaled[0] / u, mean, atol=1e-6)
    assert np.allclose(scaled[1] / u**2, variance, atol=1e-6)


@pytest.mark.parametrize("unit", [1e-9, 1.0, 1e9])
@pytest.mark.parametrize("family", ["extended", "unscented", "iterated", "sum"])
def test_curved_sensors_in_other_units(family: str, unit: float) -> None:
    """The derivative by differences has steps in units of the state."""

    def bend(x: np.ndarray) -> np.ndarray:
        plain = x / unit
        return plain[..., :1] ** 2 + plain[..., 1:]

    curve = Sensor(1, bend, [[0.04]])
    still = Model(2, lambda x, t, dt: x, lambda t, dt: np.zeros((2, 2)))
    f = FAMILIES[family](still, [curve], graphs.complete(1))
    prior_mean = np.array([3.0, 1.0])
    prior_cov = 0.01 * np.eye(2)
    start = f.start((prior_mean * unit, prior_cov * unit**2))
    state = f.step(start, 0.0, [[10.3]])
    mean = f.summarize(state).mean[0] / unit
    # m + P Hᵀ (y - h(m)) / S with H = [6, 1] and h(m) = 3² + 1, but for the curvature
    slope = np.array([6.0, 1.0])
    innovation = 10.3 - 10.0
    innovation_var = 0.36 + 0.01 + 0.04
    expected = prior_mean + prior_cov @ slope * innovation / innovation_var
    assert np.allclose(mean, expected, atol=3e-3)


@EACH
def test_a_run_that_is_resumed_and_a_state_that_stays(
    family: str, tmp_path: Path
) -> None:
    f = make(family)
    start_of_whole = f.start((MEAN, COV), rng=np.random.default_rng(3))
    whole = f.run(start_of_whole, TIMES, list(SEEN))
    start = f.start((MEAN, COV), rng=np.random.default_rng(3))
    before = f.summarize(start).mean.copy()
    early = [y[:1] for y in SEEN]
    first = f.run(start, TIMES[:1], early)
    assert np.array_equal(f.summarize(start).mean, before)
    final_state(first).save(tmp_path / "state.npz")
    loaded = f.state_class.load(tmp_path / "state.npz")
    # Another filter with the same options goes on.
    late = [y[1:] for y in SEEN]
    rest = make(family).run(loaded, TIMES[1:], late)
    for name in ("mean", "variance", "scalars_total"):
        expected = whole[name].values[1:]
        assert np.array_equal(rest[name].values, expected)
