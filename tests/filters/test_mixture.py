"""The mixture filter on the contract: split, through the channel only, at its edges."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
from numpy.random import default_rng

from distfilt.filters import FilterError, MixtureFilter
from distfilt.mixtures import GaussianMixture, target_fusion
from distfilt.models import Model, occulted, orbits
from distfilt.network import graphs
from distfilt.sensors import angles_only, component, ephemeris, stack

WIDE_NOISE = 0.1 * np.eye(2)
SMALL_NOISE = 0.01 * np.eye(2)
SMALL = Model(2, lambda x, t, dt: x, lambda t, dt: WIDE_NOISE)
BENT = Model(2, lambda x, t, dt: x + 0.3 * x**2, lambda t, dt: SMALL_NOISE)
OTHER = GaussianMixture.gaussian([1.2, 0.4], [[1.0, 0.4], [0.4, 1.0]])
AGREE = partial(target_fusion, target_dim=1)
TWO = MixtureFilter(
    SMALL, [component([0], std=0.5), None], graphs.path(2), target_dim=1, fusion=AGREE
)


def test_splitting_improves_a_bent_forecast() -> None:
    prior = GaussianMixture.gaussian([0.5, 0.2], [[0.8, 0.1], [0.1, 0.3]])
    x = prior.rvs(4000, rng=default_rng(1))
    moved = BENT.sample_step(x, 0.0, 1.0, rng=default_rng(2))
    # The mean log density of forecast draws is the score: larger is better.
    scores = []
    for options in (
        {},
        {"split_threshold": 0.05},
        # Seen at this scale the forecast is straight, so that nothing is split.
        {"split_threshold": 0.05, "split_scale": [1e-9, 1e-9]},
    ):
        f = MixtureFilter(
            BENT, [None], target_dim=1, n_components=15, max_components=15, **options
        )
        after = f.step(f.start([prior]), 1.0, [None])
        log_density = after.mixtures[0].log_density(moved)
        scores.append(log_density.mean())
    assert scores[1] > scores[0] + 0.05
    assert scores[2] == scores[0]


def test_only_the_target_marginal_is_heard() -> None:
    # Agent 2's belief about itself, and its correlation with the target, change nothing for 1.
    odd = GaussianMixture.gaussian([1.2, 77.0], [[1.0, -0.9], [-0.9, 5.0]])
    seen = [[1.0], None]
    a = TWO.step(TWO.start([OTHER, OTHER]), 1.0, seen)
    b = TWO.step(TWO.start([OTHER, odd]), 1.0, seen)
    # Weight, mean and variance of one component
    assert a.ledger.scalars.tolist() == [3, 3]
    assert np.array_equal(a.mixtures[0].means, b.mixtures[0].means)
    # An agent receives from its neighbours alone.
    three = MixtureFilter(SMALL, [None] * 3, graphs.path(3), target_dim=1, fusion=AGREE)
    far = GaussianMixture.gaussian([9.0, 0.0], np.eye(2))
    nothing = [None] * 3
    usual = three.start([OTHER, OTHER, OTHER])
    unusual = three.start([OTHER, OTHER, far])
    a = three.step(usual, 1.0, nothing).mixtures
    b = three.step(unusual, 1.0, nothing).mixtures
    assert np.array_equal(a[0].means, b[0].means)
    assert not np.array_equal(a[1].means, b[1].means)


MEO = np.array([26491.58, 2980.266, -357.1760, -173.028, 2191.596, 3178.45])
GEO = np.array([42241.10, 0.0, 0.0, 0.0, 3071.859, 0.0])


def in_orbit(target: np.ndarray, observer: np.ndarray, **options: object) -> tuple:
    """A filter with an eye that the Earth blinds and a fix, and its belief."""
    fix = ephemeris(position_std=1e-3, velocity_std=1e-5)
    see = stack([angles_only(std=1e-4, hidden=occulted), fix])
    f = MixtureFilter(orbits(2), [see], target_dim=6, **options)  # type: ignore[arg-type]
    # Positions in kilometres and velocities in metres a second, of target and observer
    variances = np.tile([1.0, 1, 1, 0.1, 0.1, 0.1], 2)
    mean = np.concatenate([target, observer])
    prior = GaussianMixture.gaussian(mean, np.diag(variances))
    return f, f.start([prior])


def test_a_reading_of_an_occulted_target_is_refused_and_a_missing_one_is_not() -> None:
    f, state = in_orbit(-MEO, GEO)
    nothing = np.full(8, np.nan)
    angles = nothing.copy()
    angles[:2] = 0.1
    # The target is behind the Earth: no prediction of its direction exists.
    message = "agent 0, t = .*: observed must be predicted by at least one"
    with pytest.raises(FilterError, match=message):
        f.step(state, 0.0, [angles])
    after = f.step(state, 0.0, [nothing]).mixtures[0]
    assert np.array_equal(after.means, state.mixtures[0].means)
    # A fix of the target needs no line of sight.
    fix = nothing.copy()
    fix[2:] = -MEO
    after = f.step(state, 0.0, [fix]).mixtures[0]
    assert np.sqrt(after.covs[0, 0, 0]) < 2e-3


def test_an_agreement_that_loses_definiteness_is_refused() -> None:
    def broken(beliefs: list, channel: object) -> list:
        # `construct` checks nothing, as a user's own rule may.
        fused = []
        for b in beliefs:
            covs = b.covs - 10 * np.eye(2)
            fused.append(GaussianMixture.construct(b.weights, b.means, covs))
        return fused

    f = MixtureFilter(SMALL, [None] * 2, graphs.path(2), target_dim=1, fusion=broken)
    with pytest.raises(FilterError, match="agent 0, t = 1 s: .*component 0 of 1 "):
        f.step(f.start([OTHER, OTHER]), 1.0, [None, None])
