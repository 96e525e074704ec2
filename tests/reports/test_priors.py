"""Priors that differ from agent to agent: a list with one for each.

| Project | Report | Here |
|---|---|---|
| own | robots that know their own starting place best | Kalman filters one by one |
| own | one agent that starts from a file of members, the others from Gaussians | each its own |
| own | pairs in a tuple, or as lists of lists, as a file has them | as a list of tuples |

Each agent is compared with a filter of one agent, started from that agent's prior.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from distfilt import filters
from distfilt.mixtures import GaussianMixture
from distfilt.models import constant_velocity
from distfilt.network import average_consensus, graphs
from distfilt.sensors import component

MOTION = constant_velocity(sigma=0.3)
GAUSSIANS = [
    (np.array([0.0, 0.0, 1.0, 0.0]), np.diag([1.0, 1.0, 0.1, 0.1])),
    (np.array([5.0, 2.0, 0.0, 0.0]), 4.0 * np.eye(4)),
    (np.array([-1.0, 1.0, 0.5, 0.5]), np.diag([0.2, 3.0, 1.0, 1.0])),
]
EYES = [component([0, 1], std=0.5)] * 3
SEEN = [np.array([[0.5, 0.1], [1.0, 0.2]]) + k for k in range(3)]


@pytest.mark.parametrize("linearization", ["extended", "unscented"])
@pytest.mark.parametrize("runs", [(), (2,)])
def test_agents_start_from_their_own_gaussians(
    linearization: Any, runs: tuple[int, ...]
) -> None:
    make = partial(filters.GaussianFilter, linearization=linearization)
    f = make(MOTION, EYES, graphs.path(3), share_observations=False)
    run = f.run(f.start(GAUSSIANS, runs=runs), [1.0, 2.0], SEEN)
    for k, prior in enumerate(GAUSSIANS):
        one = make(MOTION, EYES[:1])
        start = one.start(prior, runs=runs)
        alone = one.run(start, [1.0, 2.0], [SEEN[k]])
        for name in ("mean", "variance"):
            in_team = run[name].isel(agent=k)
            by_itself = alone[name].isel(agent=0)
            assert np.allclose(in_team, by_itself)


@pytest.mark.parametrize("cls", [filters.EnsembleFilter, filters.ParticleFilter])
@pytest.mark.parametrize("runs", [(), (2,)])
def test_agents_start_from_their_own_members(cls: Any, runs: tuple[int, ...]) -> None:
    """A Gaussian, a distribution of scipy, and an array of members, for one agent each."""
    members = np.random.default_rng(5).standard_normal((4000, 4)) + 9.0
    priors = [GAUSSIANS[0], multivariate_normal(*GAUSSIANS[1]), members]
    f = cls(MOTION, EYES, graphs.path(3), members=4000)
    state = f.start(priors, rng=np.random.default_rng(0), runs=runs)
    summary = f.summarize(state)
    # By run (one or two), agent and component
    mean = summary.mean.reshape(-1, 3, 4)
    variance = summary.variance.reshape(-1, 3, 4)
    for k, (prior_mean, prior_cov) in enumerate(GAUSSIANS[:2]):
        assert np.allclose(mean[:, k], prior_mean, atol=0.15)
        assert np.allclose(variance[:, k], np.diag(prior_cov), rtol=0.15)
    assert np.allclose(mean[:, 2], members.mean(axis=0))
    # Draws of the agents differ also where their priors are equal.
    equal = f.start([GAUSSIANS[0]] * 3, rng=np.random.default_rng(0))
    assert (equal.belief[0] != equal.belief[1]).any()


def test_mixtures_too() -> None:
    f = filters.MixtureFilter(MOTION, EYES, target_dim=4)
    two = GaussianMixture([0.5, 0.5], np.eye(2, 4), [np.eye(4)] * 2)
    state = f.start([GAUSSIANS[0], two, GAUSSIANS[2]])
    assert [m.n_components for m in state.mixtures] == [1, 2, 1]


def test_lists_that_are_one_prior_stay_one() -> None:
    """[mean, cov] in a list, members as lists, and members as tuples."""
    f = filters.GaussianFilter(MOTION, EYES, graphs.path(3))
    mean, cov = GAUSSIANS[0]
    assert np.allclose(f.start([mean, cov]).means, mean)
    members = np.random.default_rng(0).standard_normal((6, 4))
    for prior in (members.tolist(), [tuple(row) for row in members.tolist()]):
        assert np.allclose(f.start(prior).means, members.mean(axis=0))


def test_wrong_lists_are_refused_by_name() -> None:
    f = filters.GaussianFilter(MOTION, EYES, graphs.path(3))
    with pytest.raises(ValueError, match="one for each of 3 agents, got 2"):
        f.start(GAUSSIANS[:2])
    with pytest.raises(ValueError, match=r"prior\[1\] must be a prior .* got NoneType"):
        f.start([GAUSSIANS[0], None, GAUSSIANS[2]])
    g = filters.TransportFilter(MOTION, EYES, graphs.path(3), members=10)
    with pytest.raises(ValueError, match="one for all agents of a TransportFilter"):
        g.start(GAUSSIANS, rng=np.random.default_rng(0))


FAMILIES: dict[str, Any] = {
    "gaussian": filters.GaussianFilter,
    "ensemble": partial(filters.EnsembleFilter, members=20),
    "particle": partial(filters.ParticleFilter, members=20),
    "mixture": partial(filters.MixtureFilter, target_dim=4),
    "increments": partial(filters.InformationIncrementFilter, target_dim=4),
    "sum": filters.GaussianSumFilter,
    "information": partial(
        filters.InformationConsensusFilter, fusion=average_consensus
    ),
}


@pytest.mark.parametrize("family", FAMILIES)
def test_pairs_in_a_tuple_and_as_lists_of_lists(family: str) -> None:
    f = FAMILIES[family](MOTION, EYES, graphs.path(3))
    lists = [[mean.tolist(), cov.tolist()] for mean, cov in GAUSSIANS]
    rng = partial(np.random.default_rng, 0)
    expected = f.summarize(f.start(GAUSSIANS, rng=rng())).mean
    for given in (tuple(GAUSSIANS), lists, tuple(map(tuple, lists))):
        got = f.summarize(f.start(given, rng=rng())).mean
        assert np.array_equal(got, expected)
    # One pair as a list is one prior for all.
    one = f.summarize(f.start(lists[0], rng=rng())).mean
    assert np.array_equal(one, f.summarize(f.start(GAUSSIANS[0], rng=rng())).mean)
