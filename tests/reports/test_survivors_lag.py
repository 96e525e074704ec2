"""Wrong results of pasts, gates, tapers and ties that the tests once let pass.

All of them are of our own making (source: own): they are found by changing one line of the code
and looking whether a test fails. Each test has a value of its own, by hand or from theory.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
import pytest

from distfilt import density, network
from distfilt.filters import (
    EnsembleFilter,
    GaussianFilter,
    GaussianSumFilter,
    InformationConsensusFilter,
    ParticleFilter,
)
from distfilt.mixtures import GaussianMixture
from distfilt.models import Model
from distfilt.network import graphs
from distfilt.sensors import Sensor, component, wrap
from distfilt.updates import etkf, update, with_localization
from distfilt.updates.wrappers import gaspari_cohn
from tests.filters.families import still_model

TURN = 2 * np.pi
STILL = still_model(1)
PAST_FILTERS = {
    "gaussian": partial(
        GaussianFilter, fusion=partial(network.covariance_intersection, rule="equal")
    ),
    "ensemble": partial(
        EnsembleFilter,
        members=4000,
        fusion=partial(network.intersect_ensembles, rule="equal"),
    ),
}


@pytest.mark.parametrize("family", PAST_FILTERS)
def test_the_past_of_fused_headings_turns_with_them(family: str) -> None:
    """Agents at θ ± 0.1 fuse to θ, and their past follows halfway, also where θ is at the cut."""
    walk = Model(
        1, lambda x, t, dt: x, lambda t, dt: 0.04 * dt * np.eye(1), periods=(TURN,)
    )
    f: Any = PAST_FILTERS[family](walk, [None, None], graphs.path(2), lag=1)
    pasts = []
    for centre in (0.5, np.pi):
        means = [wrap([centre - 0.1]), wrap([centre + 0.1])]
        prior = [(mean, [[0.04]]) for mean in means]
        start = f.start(prior, rng=np.random.default_rng(0))
        state = f.step(start, 1.0, [None, None])
        (past,) = state.lagged_states
        pasts.append(wrap(f.summarize(past).mean[:, 0] - centre))
    # m_past⁺ = m_past + G Δm with G = P / (P + Q) = 1/2 and Δm = ± 0.1
    error = 1e-12 if family == "gaussian" else 0.02
    assert np.allclose(pasts[0], [-0.05, 0.05], rtol=0, atol=error)
    # The same draws, turned: m_past⁺ - θ does not depend on θ.
    assert np.allclose(pasts[1], pasts[0], rtol=0, atol=1e-9)


@pytest.mark.parametrize("family", PAST_FILTERS)
def test_two_headings_fuse_the_shorter_way_whatever_the_others_are(family: str) -> None:
    """At ±2.5 rad they are 1.28 rad apart about π, though all agents together look to zero."""
    rest = Model(1, lambda x, t, dt: x, lambda t, dt: np.zeros((1, 1)), periods=(TURN,))
    f: Any = PAST_FILTERS[family](rest, [None] * 5, graphs.path(5))
    prior = [([mean], [[0.04]]) for mean in (0.0, 0.0, 0.0, 2.5, -2.5)]
    start = f.start(prior, rng=np.random.default_rng(0))
    state = f.step(start, 1.0, [None] * 5)
    after = f.summarize(state)
    # The last agent has one neighbour: with equal covariances they meet halfway.
    # The mean of 4000 members errs by σ/√n with σ = 0.2.
    standard_error = 0.2 / np.sqrt(4000)
    close = 1e-9 if family == "gaussian" else 4 * standard_error
    assert abs(wrap(after.mean[4, 0] - np.pi)) < close
    assert np.isclose(after.mean[0, 0], 0.0, atol=close)


def test_a_step_of_no_length_separates_no_copies_of_a_model_with_noise() -> None:
    """Q = dt is zero there, but the next step has noise: the copies remain copies."""
    walk = still_model(1, rate=1.0)
    f = ParticleFilter(walk, [component([0], std=0.5)], members=200, ess_threshold=0.9)
    rng = np.random.default_rng(0)
    start = f.start(([0.0], [[1.0]]), rng=rng)
    weighted = f.step(start, 0.0, [[1.0]])
    assert weighted.effective_size[0] < 0.9 * 200
    after = f.step(weighted, 0.0, [None])
    old, new = (s.particles[0, :, 0] for s in (weighted, after))
    # Systematic resampling takes a particle ⌊N w⌋ times or once more.
    assert np.isin(new, old).all()
    copies = (new[:, None] == old).sum(axis=0)
    assert (np.abs(copies - 200 * weighted.weights[0]) < 1).all()
    assert len(np.unique(new)) < 160


def test_cross_validation_leaves_out_whole_places() -> None:
    """∫p̂² - (2/N) Σᵢ p̂₋ᵢ(Xᵢ), where p̂₋ᵢ is the mean over the agents in other places than i."""
    rng = np.random.default_rng(2)
    grid = density.Grid((400,))
    places = 0.2 + 0.6 * rng.random((6, 1))
    x = np.repeat(places, [12, 12, 1, 1, 1, 1], axis=0)
    n = len(x)
    silverman = x.std() * (4 / (3 * n)) ** 0.2
    widths = silverman * np.geomspace(0.15, 1.5, 20)
    scores = []
    for h in widths:
        z = density.kernels(x, grid, bandwidth=h)
        score = float(grid.integral(z.mean(axis=0) ** 2))
        for i, cell in enumerate(grid.cell_index(x)):
            is_elsewhere = x[:, 0] != x[i, 0]
            score -= 2 / n * z[is_elsewhere, cell].mean()
        scores.append(score)
    # Means over N - 1 instead would choose a wider kernel.
    chosen = density.bandwidth(x, grid, rule="least_squares")
    assert np.isclose(chosen, widths[np.argmin(scores)], rtol=1e-12)


def test_the_taper_between_correlated_observations_is_theirs() -> None:
    """Observations at 3 and 4, components at 0 and 2.5: whitened, each is used in turn by hand."""
    places = np.array([[0.0], [2.5]])
    seen_at = np.array([[3.0], [4.0]])
    rng = np.random.default_rng(0)
    x = rng.standard_normal((12, 2))
    linear = x @ [[0.5, 1.0], [1.0, -0.5]]
    h = linear + 0.3 * rng.standard_normal((12, 2))
    y = np.array([1.0, -2.0])
    noise = np.array([[0.5, 0.3], [0.3, 0.8]])
    local = with_localization(
        partial(etkf, rotation="none"),
        places=places,
        observation_places=seen_at,
        radius=2.0,
    )
    all_places = np.concatenate([places, seen_at])
    distances = np.abs(all_places - seen_at.T)
    rho = gaspari_cohn(distances / 2.0)
    joint = np.concatenate([x, h], axis=1)
    # W R Wᵀ = I: the observations W y are independent.
    whitening = np.linalg.inv(np.linalg.cholesky(noise))
    for w, target in zip(whitening, whitening @ y, strict=True):
        deviations = joint - joint.mean(axis=0)
        # c = (ρ ∘ C) w and the mixture's variance s = wᵀ (ρ ∘ C)_hh w, of components (x, h)
        cov = deviations.T @ deviations[:, 2:] / 11
        c = rho * cov @ w
        s = w @ c[2:]
        z = deviations[:, 2:] @ w
        z *= np.sqrt(s / z.var(ddof=1))
        # m⁺ = m + c (y - wᵀ h) / (s + 1), and z⁺ = z / √(s + 1) about it
        innovation = target - w @ joint[:, 2:].mean(axis=0)
        shift = innovation / (s + 1)
        shrinkage = (1 / np.sqrt(s + 1) - 1) * z / s
        moves = shift + shrinkage
        joint = joint + moves[:, None] * c
    after = local(x, h, y, noise, rng=rng)
    assert np.allclose(after, joint[:, :2], rtol=0, atol=1e-10)


def test_a_change_that_is_no_gain_is_tapered_by_squared_weights() -> None:
    """An update that moves all members alike: by Σ_j w_j² ρ_kj / Σ_j w_j² for each mixture w.

    A mixture Σ_j w_j y_j has the shares w_j² of its variance from its parts, whose noise is alike.
    """
    places = np.array([[0.0], [2.5]])
    seen_at = np.array([[1.0], [4.0]])
    x = np.random.default_rng(0).standard_normal((12, 2))
    noise = np.array([[0.5, 0.3], [0.3, 0.8]])

    def move_first_two(
        ensemble: np.ndarray,
        predicted: np.ndarray,
        observed: np.ndarray,
        noise: np.ndarray,
        *,
        rng: np.random.Generator,
    ) -> np.ndarray:
        # Behind the state stand the predictions, which stay.
        change = np.zeros(ensemble.shape[-1])
        change[:2] = [1.0, -3.0]
        return ensemble + change

    local = with_localization(
        update(move_first_two),
        places=places,
        observation_places=seen_at,
        radius=2.0,
    )
    after = local(x, x, [0.3, -0.4], noise, rng=np.random.default_rng(0))
    rho = gaspari_cohn(np.abs(places - seen_at.T) / 2.0)
    # Two mixtures, the rows of W with W R Wᵀ = I
    squares = np.linalg.inv(np.linalg.cholesky(noise)) ** 2
    shares = squares @ rho.T / squares.sum(axis=1, keepdims=True)
    expected = shares.sum(axis=0) * [1.0, -3.0]
    assert np.allclose(after - x, expected, rtol=0, atol=1e-12)


def test_the_gate_of_a_sum_of_one_component_is_that_of_a_gaussian() -> None:
    """x² of N(½, 1) has the mean 1.25 and the variance 4 m² P + 2 P² = 3: slope alone, 1."""
    square = Sensor(1, lambda x: x**2, [[0.1]])
    options: dict[str, Any] = {
        "linearization": "unscented",
        "kappa": 2.0,
        "gate_probability": 0.99,
    }
    one = GaussianSumFilter(STILL, [square], **options)
    plain = GaussianFilter(STILL, [square], **options)
    # The chi-squared quantile 6.635 bounds r² / (3 + 0.1): |r| < 4.535, and 2.70 by slope alone.
    for r, rejected in ((4.5, 0), (4.57, 1), (3.0, 0)):
        seen = [[1.25 + r]]
        prior = GaussianMixture.gaussian([0.5], [[1.0]])
        mixture = one.step(one.start(prior), 0.0, seen)
        gaussian = plain.step(plain.start(([0.5], [[1.0]])), 0.0, seen)
        assert mixture.rejected[0] == gaussian.rejected[0] == rejected
        assert np.allclose(mixture.means, gaussian.means, rtol=1e-12)


@pytest.mark.parametrize("average", ["weighted", "hybrid", "measurements"])
def test_the_consensus_on_headings_is_the_central_filter(average: Any) -> None:
    """Agents at 3.1 and -3.1 with exact averages: the information of both, about π."""
    still = Model(
        1, lambda x, t, dt: x, lambda t, dt: np.zeros((1, 1)), periods=(TURN,)
    )
    compass = Sensor(1, lambda x: x, [[0.25]], periods=(TURN,))
    f = InformationConsensusFilter(
        still,
        [compass, compass],
        graphs.path(2),
        fusion=network.finite_time_consensus,
        average=average,
    )
    p = 0.5
    r = 0.25
    y = np.array([3.0, 0.2 - np.pi])
    start = f.start([([m], [[p]]) for m in (3.1, -3.1)])
    state = f.step(start, 0.0, y[:, None])
    # From π, the first prior is at -0.0416 and the second at 0.0416; the averages have 0.
    priors = np.array([3.1 - np.pi, np.pi - 3.1])
    priors = priors if average == "measurements" else np.zeros(2)
    # m⁺ = (m / P + Σ y / R) / (1 / P + 2 / R)
    information = 1 / p + 2 / r
    observed = wrap(y - np.pi).sum()
    expected = (priors / p + observed / r) / information
    found = wrap(state.means[:, 0] - np.pi)
    assert np.allclose(found, expected, rtol=0, atol=1e-9)
    assert np.allclose(state.covariances, 1 / information, rtol=1e-9)
