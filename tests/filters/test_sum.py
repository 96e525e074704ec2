"""Gaussian sums: against one Kalman filter, the mixture filter and Bayes' rule by quadrature."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.random import default_rng
from scipy.stats import norm

from distfilt.filters import (
    GaussianFilter,
    GaussianSumFilter,
    MixtureFilter,
    Observation,
)
from distfilt.mixtures import GaussianMixture, split_gaussian
from distfilt.models import Model
from distfilt.network import Faults, graphs
from distfilt.sensors import Sensor, bearing, component, distance
from tests.filters.families import PRIOR, TIMES, data, model, still_model, team

NET = graphs.path(5)


def mixture(seed: int = 1, components: int = 4, d: int = 2) -> GaussianMixture:
    rng = default_rng(seed)
    roots = rng.standard_normal((components, d, d))
    weights = rng.random(components) + 0.2
    return GaussianMixture(
        weights / weights.sum(),
        2 * rng.standard_normal((components, d)),
        roots @ roots.mT + 0.3 * np.eye(d),
    )


def last_of(f: Any, prior: Any, seen: Any, runs: tuple[int, ...] = ()) -> Any:
    start = f.start(prior, runs=runs)
    *_, last = f.steps(start, TIMES, seen)
    return last


# The split prior.


@pytest.mark.parametrize("parts", [2, 3, 4, 5, 8, 9, 25])
def test_a_split_is_close_to_its_gaussian_and_keeps_the_moments(parts: int) -> None:
    split = split_gaussian([1.0], [[4.0]], parts=parts)
    mean, cov = split.moments()
    assert np.allclose(mean, 1.0)
    assert np.allclose(cov, 4.0)
    x = np.linspace(-11.0, 13.0, 2001)
    density = np.exp(split.log_density(x[:, None]))
    difference = np.abs(density - norm(1.0, 2.0).pdf(x))
    # Half the integrated absolute difference: the largest error of a probability
    assert 0.5 * np.trapezoid(difference, x) < 0.02
    # Components become narrow as their number grows.
    reach = 2.5 if parts <= 8 else 3.0
    std = reach / np.sqrt(reach**2 + 0.5625 * (parts - 1) ** 2)
    assert np.allclose(split.covs, 4 * std**2)


@pytest.mark.parametrize("axes", [None, [2], [2, 0]])
def test_a_split_of_some_components_keeps_full_moments(axes: Any) -> None:
    root = default_rng(0).standard_normal((3, 3))
    cov = root @ root.T + 0.1 * np.eye(3)
    # A full covariance, so that a wrong order of components would show.
    split = split_gaussian([1.0, 2.0, 3.0], cov, parts=3, axes=axes)
    assert split.n_components == 3 ** len(axes or range(3))
    mean, whole = split.moments()
    assert np.allclose(mean, [1.0, 2.0, 3.0])
    assert np.allclose(whole, cov)
    # The other components follow by regression: their conditional law is kept.
    first = [0, 1, 2] if axes is None else axes
    rest = [k for k in range(3) if k not in first]
    cross = cov[np.ix_(rest, first)]
    gain = cross @ np.linalg.inv(cov[np.ix_(first, first)])
    piece = split.covs[0]
    inner = np.linalg.inv(piece[np.ix_(first, first)])
    gain_of_piece = piece[np.ix_(rest, first)] @ inner
    assert np.allclose(gain_of_piece, gain)


def test_what_a_split_refuses() -> None:
    with pytest.raises(ValueError, match="^axes must be below 2, got"):
        split_gaussian([0.0, 0.0], np.eye(2), parts=3, axes=[2])
    with pytest.raises(ValueError, match="^parts must be at least 2"):
        split_gaussian([0.0], [[1.0]], parts=1)


# Identities.


@pytest.mark.parametrize("linearization", ["extended", "unscented"])
@pytest.mark.parametrize("hops", [1, "all"])
def test_one_component_is_a_kalman_filter(linearization: Any, hops: Any) -> None:
    _, seen = data(team(), (3,))
    options: dict[str, Any] = {
        "linearization": linearization,
        "hops": hops,
        "inflation": 1.1,
        "faults": Faults(loss=0.3, seed=2),
        "gate_probability": 0.9,
    }
    one = GaussianSumFilter(model(), team(), NET, **options)
    other = GaussianFilter(model(), team(), NET, **options)
    a = last_of(one, PRIOR, seen, (3,))
    b = last_of(other, PRIOR, seen, (3,))
    assert np.allclose(a.means, b.means, rtol=0, atol=1e-12)
    assert np.allclose(a.covariances, b.covariances, rtol=0, atol=1e-12)
    assert np.array_equal(a.rejected, b.rejected)
    assert (a.ledger.scalars == b.ledger.scalars).all()


def test_linear_components_are_those_of_the_mixture_filter() -> None:
    """Exact mixtures, one run after the other there, all at once here."""
    _, seen = data(team(3))
    f = GaussianSumFilter(model(), team(3), share_observations=False)
    g = MixtureFilter(model(), team(3), target_dim=2)
    prior = mixture()
    # Step by step, since one of them follows single runs only.
    a = f.start(prior)
    b = g.start(prior)
    for k, t in enumerate(TIMES):
        now = [None if y is None else y[k] for y in seen]
        a = f.step(a, float(t), now)
        b = g.step(b, float(t), now)
    for agent, belief in enumerate(b.mixtures):
        # Components of negligible weight are dropped there.
        for weight, m, p in zip(belief.weights, belief.means, belief.covs, strict=True):
            distances = np.abs(a.component_means[agent] - m).max(axis=-1)
            nearest = distances.argmin()
            assert distances[nearest] < 1e-9
            assert abs(a.weights[agent, nearest] - weight) < 1e-7
            assert np.allclose(a.component_covariances[agent, nearest], p)
        assert np.allclose(a.means[agent], belief.mean)
        assert np.allclose(a.covariances[agent], belief.cov)


def test_the_evidence_is_the_density_of_the_mixture() -> None:
    prior = mixture(d=1)
    f = GaussianSumFilter(
        still_model(1), [component([0], std=0.5)], record_evidence=True
    )
    state = f.step(f.start(prior), 1.0, [[0.7]])
    # Σ w_l N(y; m_l, P_l + R)
    std = np.sqrt(prior.covs[:, 0, 0] + 0.25)
    densities = norm(prior.means[:, 0], std).pdf(0.7)
    density = (prior.weights * densities).sum()
    assert np.allclose(state.log_likelihood, np.log(density))
    # r² / S with the moments of the whole mixture
    mean, cov = prior.moments()
    innovation_var = cov[0, 0] + 0.25
    expected_nis = (0.7 - mean) ** 2 / innovation_var
    assert np.allclose(state.nis, expected_nis)


# Against Bayes' rule.


def test_two_peaks_by_quadrature() -> None:
    """A square is observed: the belief has two peaks, which a Kalman filter cannot have."""
    sensor = Sensor(
        1,
        lambda x: x**2,
        [[0.04]],
        derivative=lambda x: 2 * x[..., None],
    )
    x = np.linspace(-5.0, 5.0, 20001)
    # Prior times likelihood, on a fine grid
    density = norm(0.3, 1.0).pdf(x)
    posterior = density * norm(x**2, 0.2).pdf(1.0)
    posterior /= np.trapezoid(posterior, x)
    mean = np.trapezoid(posterior * x, x)
    variance = np.trapezoid(posterior * (x - mean) ** 2, x)
    prior = split_gaussian([0.3], [[1.0]], parts=25)
    f = GaussianSumFilter(still_model(1), [sensor])
    state = f.step(f.start(prior), 0.0, [[1.0]])
    assert abs(state.means.item() - mean) < 0.01
    assert abs(state.covariances.item() - variance) < 0.03
    # Control: one component takes the side on which its mean is.
    g = GaussianFilter(still_model(1), [sensor])
    start = g.start(([0.3], [[1.0]]))
    one = g.step(start, 0.0, [[1.0]])
    assert abs(one.means.item() - mean) > 0.3


def test_a_bearing_behind_the_cut_and_two_distances() -> None:
    """Angles of each component are compared the shorter way round."""
    eye = bearing([0, 1], std=0.05)
    prior = GaussianMixture(
        [0.5, 0.5], [[-1.0, 0.1], [-1.0, -0.1]], [0.01 * np.eye(2)] * 2
    )
    f = GaussianSumFilter(still_model(2), [[eye, distance([0, 1], std=0.1)]])
    seen = [[Observation(0.0, 0, [3.12]), Observation(0.0, 0, [1.0], 1)]]
    state = f.step(f.start(prior), 0.0, seen)
    shifts = np.abs(state.component_means[0] - prior.means)
    assert shifts.max() < 0.2
    assert np.allclose(state.weights.sum(), 1.0)


def test_a_component_that_cannot_see_loses_its_weight() -> None:
    def root(x: Any) -> Any:
        with np.errstate(invalid="ignore"):
            return np.sqrt(x)

    sensor = Sensor(1, root, [[0.01]])
    prior = GaussianMixture([0.5, 0.5], [[-4.0], [4.0]], [[[0.01]]] * 2)
    f = GaussianSumFilter(still_model(1), [sensor])
    state = f.step(f.start(prior), 0.0, [[2.0]])
    assert np.allclose(state.weights, [[0.0, 1.0]])
    # If none can see, the observation is left out and counted.
    blind = GaussianMixture([0.5, 0.5], [[-4.0], [-2.0]], [[[0.01]]] * 2)
    with pytest.warns(RuntimeWarning, match="no component can see"):
        state = f.step(f.start(blind), 0.0, [[2.0]])
    assert np.allclose(state.weights, 0.5)
    assert state.unseen.tolist() == [1.0]


def test_what_no_component_can_see_leaves_the_belief_as_it_was() -> None:
    """Unequal weights stay, the evidence is that of the other sensor alone."""
    sees = component([0], std=0.5)
    blind = Sensor(1, lambda x: np.full_like(x, np.nan), [[0.01]])
    prior = mixture(d=1)
    options: dict[str, Any] = {"record_evidence": True}
    alone = GaussianSumFilter(still_model(1), [sees], **options)
    both = GaussianSumFilter(still_model(1), [[sees, blind]], **options)
    expected = alone.step(alone.start(prior), 1.0, [[0.7]])
    observed = [Observation(1.0, 0, [0.7], 0), Observation(1.0, 0, [2.0], 1)]
    with pytest.warns(RuntimeWarning, match="no component can see"):
        state = both.step(both.start(prior), 1.0, [observed])
    assert np.ptp(expected.weights) > 0.1
    assert np.allclose(state.weights, expected.weights, rtol=1e-12)
    assert np.allclose(state.component_means, expected.component_means, rtol=1e-12)
    assert np.allclose(state.log_likelihood, expected.log_likelihood, rtol=1e-12)


# The contract.


def test_runs_failures_and_files(tmp_path: Any) -> None:
    sensors = team(3)
    _, seen = data(sensors, (3,))
    bad = [None if y is None else y.copy() for y in seen]
    assert bad[0] is not None
    bad[0][2, 1] = 1e308
    f = GaussianSumFilter(model(), sensors, graphs.path(3), on_error="keep")
    with np.errstate(all="ignore"):
        state = last_of(f, mixture(), bad, (3,))
    assert state.failed.tolist() == [False, True, False]
    of_run = [None if y is None else y[:, 2] for y in seen]
    alone = last_of(f, mixture(), of_run)
    assert np.allclose(state.means[2], alone.means, rtol=0, atol=1e-12)
    state.save(tmp_path / "state.npz")
    loaded = f.state_class.load(tmp_path / "state.npz")
    assert (loaded.log_weights == state.log_weights).all()
    run = f.run(f.start(mixture(), runs=(3,)), TIMES, seen)
    assert run["effective_size"].shape == (len(TIMES), 3, 3)
    assert np.allclose(run["mean"][-1, 2], state.means[2])


def test_noise_that_depends_on_time_and_state_reaches_all_components() -> None:
    """The same transition for each component as for a Kalman filter that starts there."""
    wave = Model(
        2, lambda x, t, dt: np.sin(x) * (1 + t * dt), lambda t, dt: dt * np.eye(2)
    )
    prior = mixture()
    f = GaussianSumFilter(wave, [None])
    state = f.step(f.start(prior, t=1.0), 1.5, [None])
    for k in range(prior.n_components):
        g = GaussianFilter(wave, [None])
        start = g.start((prior.means[k], prior.covs[k]), t=1.0)
        one = g.step(start, 1.5, [None])
        assert np.allclose(state.component_means[0, k], one.means[0])
        assert np.allclose(state.component_covariances[0, k], one.covariances[0])
    assert np.allclose(state.weights[0], prior.weights)


def test_what_is_refused() -> None:
    f = GaussianSumFilter(still_model(2), [None] * 2, share_observations=False)
    with pytest.raises(ValueError, match="^prior must have equally many components"):
        f.start([mixture(), mixture(components=3)])
    with pytest.raises(ValueError, match="to be reset"):
        f.reset(f.start(mixture()), [0], [0.0], [[1.0]])
