"""One map for all agents: averaged moments are exact, ADMM gets there in many rounds."""

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
    raw: bool = False,
) -> tuple[np.ndarray, np.ndarray]:
    """Correlated samples of each agent, whose means differ; badly scaled if `raw`."""
    rng = np.random.default_rng(seed)
    mixing = np.eye(m + d) + 0.3 * rng.standard_normal((m + d, m + d))
    z = rng.standard_normal((agents, n, m + d)) @ mixing
    z += 0.3 * rng.standard_normal((agents, 1, m + d))
    if raw:
        z = 100 + z * np.logspace(-2, 2, m + d)
    return z[..., :m], z[..., m:]


def _centralised(y: np.ndarray, x: np.ndarray) -> AffineMap:
    return affine.fit(y.reshape(-1, y.shape[-1]), x.reshape(-1, x.shape[-1]))


_Y, _X = _samples(0)


@given(
    st.integers(0, 10_000),
    st.sampled_from([graphs.path(3), graphs.star(5), graphs.ring(4)]),
)
def test_averaged_moments_give_the_map_of_all_samples(
    seed: int, graph: graphs.Graph
) -> None:
    y, x = _samples(seed, graph.n_agents)
    pooled = pool_by_moments(y, x, Channel(graph))
    central = _centralised(y, x)
    for name in ("observed_mean", "mean", "gain", "scale"):
        gap = getattr(pooled, name) - getattr(central, name)
        assert np.abs(gap).max() < 1e-12 * max(
            1.0, np.abs(getattr(central, name)).max()
        )


def test_averaged_moments_are_batched_over_runs_and_cost_what_they_say() -> None:
    y, x = (
        np.stack(v)
        for v in zip(_samples(1, m=6, d=6), _samples(2, m=6, d=6), strict=True)
    )
    channel = Channel(graphs.complete(3), runs=(2,))
    pooled = pool_by_moments(y, x, channel)
    for run in range(2):
        gap = pooled.gain[run] - _centralised(y[run], x[run]).gain
        assert np.abs(gap).max() < 1e-11
    # One round each on a complete graph: 12 + 78 scalars on every link.
    assert channel.ledger.rounds == 2
    assert (channel.ledger.scalars == 2 * 90).all()


@pytest.mark.parametrize("graph", [graphs.path(3), graphs.star(5)])
@pytest.mark.parametrize("raw", [False, True])
def test_admm_finds_the_map_of_all_samples(graph: graphs.Graph, raw: bool) -> None:
    y, x = _samples(4, graph.n_agents, 60, 3, 4, raw=raw)
    solved, run = pool_by_admm(y, x, Channel(graph))
    central = _centralised(y, x)
    assert run.iterations <= 250
    scale = x.reshape(-1, 4).std(axis=0)
    flat = y.reshape(-1, 3), x.reshape(-1, 4)
    moved = compose(central, *flat, y[0, 0])
    for agent in range(graph.n_agents):
        one = AffineMap(
            *(
                getattr(solved, n)[agent]
                for n in ("observed_mean", "mean", "gain", "scale")
            )
        )
        assert (np.abs(compose(one, *flat, y[0, 0]) - moved) / scale).max() < 1e-4
        assert np.abs(one(*flat) - central(*flat)).max() < 1e-4


def test_a_rule_that_diverges_is_blamed_itself() -> None:
    """Gains far too large: not the samples are at fault, as they vary."""
    for gain in (2.0, 1000.0):

        def rule(
            values: np.ndarray, channel: Channel, gain: float = gain
        ) -> np.ndarray:
            return values + gain * (values - values.mean(axis=0)) * 10

        for pool in (pool_by_moments, pool_by_admm):
            with pytest.raises(
                ValueError, match="average must be a rule that returns averages"
            ):
                pool(_Y, _X, Channel(graphs.path(3)), average=rule)


def test_a_variable_that_only_differs_between_agents_is_not_constant() -> None:
    y, x = _samples(6)
    x[..., 0] = np.arange(3.0)[:, None]
    pooled = pool_by_moments(y, x, Channel(graphs.path(3)))
    assert np.abs(pooled.scale[0] - _centralised(y, x).scale).max() < 1e-12


def test_rho_changes_the_way_and_not_the_end() -> None:
    y, x = _samples(7)
    few = [
        pool_by_admm(y, x, Channel(graphs.path(3)), rho=rho, tolerance=1e-9)
        for rho in (0.5, 2.0)
    ]
    assert few[0][1].iterations != few[1][1].iterations
    assert np.abs(few[0][0].gain - few[1][0].gain).max() < 1e-6
