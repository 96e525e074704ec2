"""Draws of an update of one's own: every run has its own, of any distribution.

| Report | Situation |
|---|---|
| binarymatt/pyres 82 | jobs that draw the same integers |
| ray-project/ray 49443 | batches that draw the same numbers |
| Libensemble/libensemble 542 | a stream for each worker |
| Bears-R-Us/arkouda 3322 | draws that depend on how the work is divided |
| cubed-dev/cubed 4 | a stream for each chunk |
| own | parameters for each run, permutations, results in place |
| ICTP/RegCM 10, SciML/DifferentialEquations.jl 1034 | seeds that are drawn, one for a whole group |
| own | generators that are made of the generator: spawned, wrapped, of scipy |
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy.stats import qmc
from scipy.stats import t as student

from distfilt.filters import EnsembleFilter
from distfilt.sensors import Sensor
from distfilt.updates import update, with_missing
from distfilt.updates.decorator import _EVENTS, _PARAMETERS, RowGenerator
from tests.filters.families import still_model

LEAD = (2, 3)
ROWS = np.array([1, 4, 5])
ARGUMENTS: dict[str, tuple[Any, ...]] = {
    "beta": (2.0, 3.0),
    "binomial": (50, 0.3),
    "chisquare": (3.0,),
    "choice": (1000,),
    "dirichlet": ([1.0, 2.0, 3.0],),
    "f": (3.0, 9.0),
    "gamma": (2.0,),
    "geometric": (0.1,),
    "hypergeometric": (50, 50, 30),
    "integers": (10**9,),
    "logseries": (0.9,),
    "multinomial": (99, [0.2, 0.8]),
    "multivariate_hypergeometric": ([50, 60], 30),
    "multivariate_normal": ([0.0, 1.0], np.eye(2)),
    "negative_binomial": (9, 0.1),
    "noncentral_chisquare": (3.0, 1.0),
    "noncentral_f": (3.0, 9.0, 1.0),
    "pareto": (3.0,),
    "poisson": (50.0,),
    "power": (3.0,),
    "standard_gamma": (2.0,),
    "standard_t": (3.0,),
    "triangular": (0.0, 1.0, 3.0),
    "vonmises": (0.0, 1.0),
    "wald": (1.0, 1.0),
    "weibull": (2.0,),
    "zipf": (1.5,),
}


def for_rows(seed: int = 1) -> RowGenerator:
    """Return a generator for some rows of a batch."""
    return RowGenerator(np.random.PCG64(seed), LEAD, ROWS)


@pytest.mark.parametrize("name", [*_PARAMETERS, *_EVENTS])
def test_rows_of_any_distribution_are_those_of_the_whole_batch(name: str) -> None:
    """numpy's own draws for all rows, of which some are selected."""
    arguments = ARGUMENTS.get(name, ())
    draw = getattr(np.random.default_rng(np.random.PCG64(1)), name)
    batch = draw(*arguments, size=(*LEAD, 4, 2))
    # Two by three leading entries are six rows.
    by_row = batch.reshape(6, *batch.shape[2:])
    part = getattr(for_rows(), name)(*arguments, size=(3, 4, 2))
    assert np.array_equal(part, by_row[ROWS])
    # Rows have different draws.
    assert not np.array_equal(part[0], part[1])


def test_every_method_of_numpy_is_covered() -> None:
    """But for those that do not draw by a size."""
    names = {name for name in dir(np.random.Generator) if not name.startswith("_")}
    others = {"bit_generator", "bytes", "permutation", "permuted", "shuffle", "spawn"}
    assert names - others == {*_PARAMETERS, *_EVENTS}


def test_parameters_of_each_row() -> None:
    """Without a size it is the parameters'; numbers for each row stay with their rows."""
    x = np.arange(24.0).reshape(3, 4, 2)
    # loc + scale z, and low + (high - low) u, with the rows' own z and u
    whole = np.random.default_rng(np.random.PCG64(1))
    z = whole.normal(size=(6, 4, 2))[ROWS]
    drawn = for_rows().normal(x, 0.5)
    assert np.allclose(drawn, x + 0.5 * z)
    whole = np.random.default_rng(np.random.PCG64(1))
    u = whole.random((6, 4, 2))[ROWS]
    low = x[:, :1]
    drawn = for_rows().uniform(low, low + 2.0, (3, 4, 2))
    assert np.allclose(drawn, low + 2.0 * u)
    result = np.empty((3, 2))
    assert for_rows().standard_normal(out=result, size=(3, 2)) is result
    # The mean of each row, over nine counts
    counts = for_rows().poisson(np.array([[0.0], [1e3], [1e6]]), (3, 9))
    assert (counts[0] == 0).all()
    # Means of nine have relative errors of 1 / √(9 λ), a hundredth for λ = 1000.
    row_means = counts[1:].mean(axis=1)
    assert np.allclose(row_means, [1e3, 1e6], rtol=0.1)


def test_permutations_of_each_row() -> None:
    """Every row is permuted by itself, and in its own way."""
    x = np.tile(np.arange(50), (3, 1))
    mixed = for_rows().permuted(x, axis=1)
    assert (np.sort(mixed, axis=1) == x).all()
    assert (mixed[0] != mixed[1]).any()
    assert (mixed[1] != mixed[2]).any()


DRAWS = {
    "laplace": lambda rng, shape: rng.laplace(size=shape),
    "uniform": lambda rng, shape: rng.uniform(-1.0, 1.0, shape),
    "integers": lambda rng, shape: rng.integers(1000, size=shape),
    "normal": lambda rng, shape: rng.normal(size=shape),
    "exponential": lambda rng, shape: rng.exponential(2.0, shape),
    "choice": lambda rng, shape: rng.choice([-1.0, 0.5, 2.0], size=shape),
    "means": lambda rng, shape: rng.laplace(np.zeros(shape), 1.0),
}


@pytest.mark.parametrize("name", DRAWS)
def test_runs_that_miss_different_components_have_their_own_draws(name: str) -> None:
    """And a run's draws do not depend on what the others miss."""

    def add_noise(x: Any, h: Any, y: Any, r: Any, *, rng: Any) -> Any:
        return x + DRAWS[name](rng, x.shape)

    x = np.zeros((3, 30, 1))
    h = np.zeros((3, 30, 2))
    y = np.array([[1.0, np.nan], [np.nan, 1.0], [1.0, np.nan]])
    after = with_missing(add_noise, x, h, y, np.eye(2), rng=np.random.default_rng(0))
    for a, b in ((0, 1), (0, 2), (1, 2)):
        assert (after[a] != after[b]).any()
    # All runs miss the same component.
    y_of_all = np.array([[1.0, np.nan]] * 3)
    together = with_missing(
        add_noise, x, h, y_of_all, np.eye(2), rng=np.random.default_rng(0)
    )
    assert np.array_equal(after, together)


@pytest.mark.parametrize("stacks", [False, True])
@pytest.mark.parametrize("name", DRAWS)
def test_runs_of_a_filter_have_their_own_draws(name: str, stacks: bool) -> None:
    """With an update of one's own, decorated or not."""

    def shift(x: Any, h: Any, y: Any, r: Any, *, rng: Any) -> Any:
        return x + DRAWS[name](rng, x.shape)

    still = still_model(1)
    sensor = Sensor(2, lambda x: np.concatenate([x, x], axis=-1), np.eye(2))
    own_update = update(shift) if stacks else shift
    f = EnsembleFilter(still, [sensor], update=own_update, members=20)
    prior = np.linspace(-1.0, 1.0, 20)[:, None]
    state = f.start(prior, runs=(3,), rng=np.random.default_rng(0))
    y = np.array([[1.0, np.nan], [np.nan, 1.0], [1.0, 1.0]])
    after = f.step(state, 0.0, [y])
    changes = after.ensembles[:, 0] - state.ensembles[:, 0]
    # No two runs have the same changes of their members.
    for a, b in ((0, 1), (0, 2), (1, 2)):
        difference = np.abs(changes[a] - changes[b])
        assert (difference > 1e-9).any()


def fill(rng: Any, shape: Any) -> np.ndarray:
    numbers = np.empty(shape)
    rng.standard_normal(out=numbers)
    return numbers


def mix(rng: Any, shape: Any) -> np.ndarray:
    numbers = np.linspace(-1.0, 1.0, math.prod(shape))
    rng.shuffle(numbers)
    return numbers.reshape(shape)


def sobol(rng: Any, shape: Any) -> np.ndarray:
    numbers: np.ndarray = qmc.Sobol(1, rng=rng).random(128)[: math.prod(shape)]
    return numbers.reshape(shape)


def seeded(rng: Any, shape: Any) -> np.ndarray:
    seed = int(rng.integers(2**31))
    return np.random.default_rng(seed).standard_normal(shape)


WAYS: dict[str, Callable[..., Any]] = {
    "in place": fill,
    "shuffled": mix,
    "seed": seeded,
    "spawned": lambda rng, shape: rng.spawn(1)[0].standard_normal(shape),
    "wrapped": lambda rng, shape: np.random.default_rng(rng).standard_normal(shape),
    "same bits": lambda rng, shape: np.random.Generator(rng.bit_generator).random(
        shape
    ),
    "scipy": lambda rng, shape: student.rvs(4, size=shape, random_state=rng),
    "sobol": sobol,
}


@pytest.mark.parametrize("name", WAYS)
def test_generators_that_are_made_of_the_generator(name: str) -> None:
    """Runs that miss different components share no draws, whichever way they are made."""

    def add_noise(x: Any, h: Any, y: Any, r: Any, *, rng: Any) -> Any:
        return x + WAYS[name](rng, x.shape)

    x = np.zeros((2, 30, 1))
    h = np.zeros((2, 30, 2))
    y = np.array([[1.0, np.nan], [np.nan, 1.0]])
    first, second = with_missing(
        add_noise, x, h, y, np.eye(2), rng=np.random.default_rng(0)
    )
    assert first.std() > 0.1 and second.std() > 0.1
    assert (first != second).sum() > 20
    again = with_missing(add_noise, x, h, y, np.eye(2), rng=np.random.default_rng(0))
    assert np.array_equal(again[0], first)


@pytest.mark.parametrize("name", ["in place", "spawned"])
def test_such_draws_do_not_depend_on_what_the_others_miss(name: str) -> None:
    def add_noise(x: Any, h: Any, y: Any, r: Any, *, rng: Any) -> Any:
        return x + WAYS[name](rng, x.shape)

    x = np.zeros((2, 30, 1))
    h = np.zeros((2, 30, 2))
    both = np.array([[1.0, np.nan], [1.0, np.nan]])
    results = [
        with_missing(add_noise, x, h, y, np.eye(2), rng=np.random.default_rng(0))
        for y in (both, np.array([[1.0, np.nan], [np.nan, 1.0]]))
    ]
    assert np.array_equal(results[0][0], results[1][0])
