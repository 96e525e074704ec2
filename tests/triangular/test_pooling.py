"""One map for all agents: averaged moments are exact, ADMM converges in many rounds."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from distfilt.network import Channel, graphs
from distfilt.triangular import AffineMap, affine, compose
from distfilt.triangular.pooling import pool_by_admm, pool_by_moments


def _samples(
    seed: int,
    agents: int = 3,
    n: int = 50,
    m: int = 2,
    d: int = 3,
    *,
    badly_scaled: bool = False,
) -> tuple[np.ndarray, np.ndarray]:
    """Draw correlated samples of each agent, whose means differ."""
    rng = np.random.default_rng(seed)
    size = m + d
    perturbation = rng.standard_normal((size, size))
    mixing = np.eye(size) + 0.3 * perturbation
    z = rng.standard_normal((agents, n, size)) @ mixing
    z += 0.3 * rng.standard_normal((agents, 1, size))
    if badly_scaled:
        z = 100 + z * np.logspace(-2, 2, size)
    return z[..., :m], z[..., m:]


def _fit_all(y: np.ndarray, x: np.ndarray) -> AffineMap:
    """Return the map of all agents' samples together."""
    flat_y = y.reshape(-1, y.shape[-1])
    flat_x = x.reshape(-1, x.shape[-1])
    return affine.fit(flat_y, flat_x)


_FIELDS = ("observed_mean", "mean", "gain", "scale")
_Y, _X = _samples(0)


@given(
    st.integers(0, 10_000),
    st.sampled_from([graphs.path(3), graphs.star(5), graphs.ring(4)]),
)
def test_averaged_moments_give_the_map_of_all_samples(
    seed: int, graph: graphs.Graph
) -> None:
    """In every field and for every agent."""
    y, x = _samples(seed, graph.n_agents)
    pooled = pool_by_moments(y, x, Channel(graph))
    # Mean and covariance of all samples are averages over agents of equal size, and the
    # affine map depends on nothing else.
    central = _fit_all(y, x)
    for name in _FIELDS:
        expected = getattr(central, name)
        error = np.abs(getattr(pooled, name) - expected).max()
        scale = max(1.0, np.abs(expected).max())
        assert error < 1e-12 * scale


def test_agents_whose_samples_differ_from_each_other_only() -> None:
    """An observation that is one number for each agent, and other numbers for the others.

    Deviations are those about the common mean; about an agent's own they would be zero.
    """
    y, x = _samples(5, agents=4, m=1, d=2)
    y[...] = np.array([-1.0, 0.5, 2.0, 4.0])[:, None, None]
    central = _fit_all(y, x)
    channel = Channel(graphs.complete(4))
    pooled, _ = pool_by_admm(y, x, channel, tolerance=1e-9)
    for name in _FIELDS:
        assert np.allclose(getattr(pooled, name), getattr(central, name), atol=1e-6)
    by_moments = pool_by_moments(y, x, Channel(graphs.complete(4)))
    for name in _FIELDS:
        assert np.allclose(getattr(by_moments, name), getattr(central, name))


def test_averaged_moments_in_several_runs_and_their_cost() -> None:
    """On a complete graph one round each: D + D (D + 1) / 2 = 12 + 78 scalars on every link."""
    first = _samples(1, m=6, d=6)
    second = _samples(2, m=6, d=6)
    y = np.stack([first[0], second[0]])
    x = np.stack([first[1], second[1]])
    channel = Channel(graphs.complete(3), runs=(2,))
    pooled = pool_by_moments(y, x, channel)
    for run in range(2):
        central = _fit_all(y[run], x[run])
        error = pooled.gain[run] - central.gain
        assert np.abs(error).max() < 1e-11
    # Each agent has two neighbours.
    assert channel.ledger.rounds == 2
    assert (channel.ledger.scalars == 2 * 90).all()


@pytest.mark.parametrize("graph", [graphs.path(3), graphs.star(5)])
@pytest.mark.parametrize("badly_scaled", [False, True])
def test_admm_converges_to_the_map_of_all_samples(
    graph: graphs.Graph, badly_scaled: bool
) -> None:
    """Every agent's composed map and reference samples, in at most 250 iterations."""
    y, x = _samples(4, graph.n_agents, 60, 3, 4, badly_scaled=badly_scaled)
    solved, run = pool_by_admm(y, x, Channel(graph))
    assert run.iterations <= 250
    central = _fit_all(y, x)
    flat_y = y.reshape(-1, 3)
    flat_x = x.reshape(-1, 4)
    expected = compose(central, flat_y, flat_x, y[0, 0])
    reference = central(flat_y, flat_x)
    for agent in range(graph.n_agents):
        fields = {name: getattr(solved, name)[agent] for name in _FIELDS}
        map_ = AffineMap(**fields)
        error = compose(map_, flat_y, flat_x, y[0, 0]) - expected
        relative_error = np.abs(error) / flat_x.std(axis=0)
        assert relative_error.max() < 1e-4
        # Reference samples have no unit.
        reference_error = map_(flat_y, flat_x) - reference
        assert np.abs(reference_error).max() < 1e-4


@pytest.mark.parametrize("gain", [2.0, 1000.0])
def test_a_rule_that_diverges_is_named(gain: float) -> None:
    """The error is not about the samples, although their averages have no factor."""

    def diverge(values: np.ndarray, channel: Channel) -> np.ndarray:
        deviation = values - values.mean(axis=0)
        return values + 10 * gain * deviation

    message = "average must be a rule that returns averages"
    for pool in (pool_by_moments, pool_by_admm):
        with pytest.raises(ValueError, match=message):
            pool(_Y, _X, Channel(graphs.path(3)), average=diverge)


def test_a_variable_that_differs_only_between_agents_is_not_constant() -> None:
    """The pooled samples vary in it."""
    y, x = _samples(6)
    x[..., 0] = np.arange(3.0)[:, None]
    pooled = pool_by_moments(y, x, Channel(graphs.path(3)))
    central = _fit_all(y, x)
    error = pooled.scale[0] - central.scale
    assert np.abs(error).max() < 1e-12


def test_rho_changes_the_iterations_and_not_the_solution() -> None:
    """The penalty of ADMM is no part of the problem."""
    y, x = _samples(7)
    graph = graphs.path(3)
    small, small_run = pool_by_admm(y, x, Channel(graph), rho=0.5, tolerance=1e-9)
    large, large_run = pool_by_admm(y, x, Channel(graph), rho=2.0, tolerance=1e-9)
    assert small_run.iterations != large_run.iterations
    assert np.abs(small.gain - large.gain).max() < 1e-6
