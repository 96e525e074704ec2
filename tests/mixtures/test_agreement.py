"""Agreement on a target over a channel."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest

from distfilt.mixtures import GaussianMixture, fuse, fuse_in_turn, fuse_moments, target_fusion
from distfilt.network import Channel, Graph, fused_kind, graphs

from .examples import TARGET, random_mixture

BELIEFS = [random_mixture(2, 3 + k, 80 + k) for k in range(3)]


def test_agents_fuse_the_marginals_of_whom_they_hear() -> None:
    channel = Channel(graphs.path(3))
    after = target_fusion(BELIEFS, channel, target_dim=2)
    said = [m.marginal(TARGET) for m in BELIEFS]
    wanted = [
        fuse(BELIEFS[0], said[1]), fuse(BELIEFS[1], [said[0], said[2]]), fuse(BELIEFS[2], said[1])
    ]
    for a, b in zip(after, wanted, strict=True):
        assert np.array_equal(a.means, b.means) and np.array_equal(a.weights, b.weights)
    # A mixand is a weight, two means and three entries of a covariance; 1 has two listeners.
    assert channel.ledger.scalars.tolist() == [12, 24, 12]


def test_what_is_fused_and_how_can_be_chosen() -> None:
    rule = partial(target_fusion, target_dim=2, fuse=partial(fuse_in_turn, pair=fuse_moments))
    assert fused_kind(rule) == "mixtures"
    after = rule(BELIEFS, Channel(graphs.complete(3)))
    # Equal exponents in whatever order: everybody has the same Gaussian target.
    for m in after[1:]:
        assert np.allclose(m.means[0, :2], after[0].means[0, :2])
        assert np.allclose(m.covs[0, :2, :2], after[0].covs[0, :2, :2])


def test_who_hears_nothing_changes_nothing() -> None:
    after = target_fusion(BELIEFS, Channel(Graph.from_adjacency(np.zeros((3, 3)))), target_dim=2)
    assert all(a is b for a, b in zip(after, BELIEFS, strict=True))


def test_a_collapse_names_the_agent_the_mixand_and_the_cause() -> None:
    def naive(own: GaussianMixture, heard: list[GaussianMixture]) -> GaussianMixture:
        covs = own.covs.copy()
        covs[1] -= 2 * np.linalg.eigvalsh(covs[1])[0] * np.eye(own.dim)
        return GaussianMixture.unchecked(own.weights, own.means, covs)

    with pytest.raises(np.linalg.LinAlgError, match="^agent 0: mixand 1 of 2 .*independent"):
        target_fusion(BELIEFS, Channel(graphs.path(3)), target_dim=2, fuse=naive)
