"""Updates by transport: principal directions, composed maps, and couplings."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from distfilt import coupling
from distfilt.triangular import affine
from distfilt.updates import (
    etpf,
    principal_components,
    principal_directions,
    transport_map_update,
)
from distfilt.updates.particles import ParticleCollapse
from tests.triangular.samples import rng_of, samples

from .cases import MEAN, H, R, Y, members

_PREDICTED, _ENSEMBLE = samples(7)
_DATA = (
    _ENSEMBLE,
    _PREDICTED,
    np.array([0.4, -0.2]),
    np.array([[0.3, 0.1], [0.1, 0.2]]),
)


@given(st.integers(0, 10_000), st.integers(1, 4))
def test_principal_directions_have_the_largest_variance(seed: int, n: int) -> None:
    """Orthonormal, and the variances along them are the leading eigenvalues."""
    ensemble = samples(seed, m=1, d=4)[1]
    directions = principal_directions(ensemble, n)
    assert np.allclose(directions.T @ directions, np.eye(n), atol=1e-12)
    cov = np.cov(ensemble, rowvar=False)
    eigenvalues = np.linalg.eigvalsh(cov)[::-1]
    scores = ensemble @ directions
    latent = np.cov(scores, rowvar=False).reshape(n, n)
    assert np.allclose(latent.diagonal(), eigenvalues[:n], rtol=1e-8)


def test_the_complement_of_the_principal_directions() -> None:
    """Outside the leading directions the state stays, or is zero, by the option."""
    ensemble = _DATA[0]
    directions = principal_directions(ensemble, 2)
    # I - V Vᵀ projects on the orthogonal complement.
    complement = np.eye(3) - directions @ directions.T
    options = {"n_state": 2, "n_observed": 2}
    keep = principal_components(*_DATA, rng=rng_of(3), **options)
    literal = principal_components(
        *_DATA, rng=rng_of(3), complement="literal", **options
    )
    assert np.allclose(keep @ complement, ensemble @ complement, atol=1e-9)
    assert np.allclose(literal @ complement, 0, atol=1e-9)
    # Inside they are the same update.
    assert np.allclose(keep @ directions, literal @ directions, atol=1e-8)


@pytest.mark.parametrize("factor", [0.25, 1.0])
def test_the_noise_factor_scales_the_draw_and_nothing_else(factor: float) -> None:
    """The composed map of predictions and scaled noise; PCA with all directions is the same."""
    x, h, y, noise = _DATA
    normal = rng_of(3).standard_normal(h.shape)
    perturbed = h + factor * normal @ np.linalg.cholesky(noise).T
    map_ = affine.fit(perturbed, x)
    # S(y*, ·)⁻¹ ∘ S(y_i, x_i)
    reference = map_(perturbed, x)
    expected = map_.inverse(y, reference)
    analysis = transport_map_update(*_DATA, rng=rng_of(3), noise_factor=factor)
    assert np.allclose(analysis, expected, atol=1e-10)
    for complement in ("keep", "literal"):
        by_directions = principal_components(
            *_DATA,
            rng=rng_of(3),
            noise_factor=factor,
            n_state=3,
            n_observed=5,
            complement=complement,
        )
        assert np.allclose(by_directions, expected, atol=1e-8)


def test_etpf_by_its_formula() -> None:
    """The transform by Gaussian likelihoods with a full R; corrected, also their covariance."""
    x = members(40)
    innovation = Y - x @ H.T
    precision = np.linalg.inv(R)
    squares = np.einsum("ni,ij,nj->n", innovation, precision, innovation)
    weights = np.exp(-0.5 * squares)
    weights /= weights.sum()
    analysis = etpf(x, x @ H.T, Y, R, rng=rng_of())
    transformed = coupling.transform_ensemble(x, np.log(weights))
    assert np.allclose(analysis, transformed, atol=1e-10)
    mean_error = analysis.mean(axis=0) - weights @ x
    assert np.abs(mean_error).max() < 1e-13
    corrected = etpf(x, x @ H.T, Y, R, rng=rng_of(), correct=True)
    weighted_covariance = np.cov(x.T, aweights=weights, bias=True)
    covariance = np.cov(corrected.T, bias=True)
    assert np.allclose(covariance, weighted_covariance, atol=1e-12)


def test_a_far_observation_does_not_underflow_and_warns() -> None:
    """Log-likelihoods of -1e8 are normalised first; one member has all the weight."""
    x = members(40)
    with pytest.warns(ParticleCollapse, match="effective size of 1"):
        analysis = etpf(x, x @ H.T, Y + 1e4, R, rng=rng_of())
    assert np.isfinite(analysis).all()


def test_a_lost_spread_warns() -> None:
    """Members that coincide have equal weights: only the observation shows that they are wrong."""
    x = MEAN + 1e-3 * (members(40) - MEAN)
    h = x @ H.T
    predicted_mean = x.mean(axis=0) @ H.T
    std = np.sqrt(np.diagonal(R))
    # Three deviations are no reason to warn.
    etpf(x, h, predicted_mean + 3 * std, R, rng=rng_of())
    far = 6 * std
    # dᵀ R⁻¹ d is χ² distributed with two degrees of freedom: its mean is 2.
    distance = far @ np.linalg.solve(R, far)
    message = rf"squared distance .* is {distance:.0f}, not 2;"
    # Of two ensembles the second one is far from its observation.
    y = [predicted_mean, predicted_mean + far]
    with pytest.warns(ParticleCollapse, match=message):
        etpf([x, x], [h, h], y, R, rng=rng_of())


def test_nothing_is_drawn_without_rejuvenation() -> None:
    """Two seeds give the same members; with rejuvenation they are those of `rejuvenate`."""
    x = members(30)
    data = (x, x @ H.T, Y, R)
    transformed = etpf(*data, rng=rng_of(1))
    assert (transformed == etpf(*data, rng=rng_of(2))).all()
    first = etpf(*data, rng=rng_of(1), rejuvenation=0.2)
    second = etpf(*data, rng=rng_of(2), rejuvenation=0.2)
    assert (first != second).any()
    # Rejuvenation follows the transform, with the same generator.
    expected = coupling.rejuvenate(transformed, x, bandwidth=0.2, rng=rng_of(1))
    assert np.array_equal(first, expected)


def test_the_distance_is_handed_on_as_the_cost() -> None:
    """The members are those of the transform with this cost, and not those of the square."""
    x = members(30)
    h = x @ H.T
    transformed = etpf(x, h, Y, R, rng=rng_of(), cost="distance")
    residual = Y - h
    solved = np.linalg.solve(R, residual.T).T
    logs = -0.5 * (residual * solved).sum(axis=1)
    expected = coupling.transform_ensemble(x, logs, cost="distance")
    assert np.abs(transformed - expected).max() < 1e-12
    plain = etpf(x, h, Y, R, rng=rng_of())
    assert np.abs(transformed - plain).max() > 1e-3
