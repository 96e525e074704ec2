"""Updates by transport: principal directions, direct sampling, what maps keep, and couplings."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from distfilt.coupling import ensemble_transform as transform
from distfilt.ensembles import sample_covariance
from distfilt.triangular import affine
from distfilt.updates import (
    ensemble_transform,
    principal_components,
    principal_directions,
    transport,
    transport_sample,
)
from distfilt.updates.particles import ParticleCollapse, log_likelihood

from .cases import COV, MEAN, H, R, Y, kalman, members


def _rng(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def _samples(
    seed: int, n: int = 60, m: int = 2, d: int = 3, leading: tuple[int, ...] = ()
) -> tuple[np.ndarray, np.ndarray]:
    """Correlated, shifted, badly scaled samples (y, x)."""
    rng = _rng(seed)
    mixing = rng.standard_normal((m + d, m + d)) * np.logspace(-1, 1, m + d)
    z = rng.standard_normal((*leading, n, m + d)) @ mixing + 10 * rng.standard_normal(m + d)
    return z[..., :m], z[..., m:]


def test_conditioning_a_gaussian_converges_at_the_monte_carlo_rate() -> None:
    """Mean-square error of the posterior mean falls like 1/N: a slope of -1 within 0.15."""
    sizes, errors = np.array([100, 400, 1600, 6400]), []
    for n in sizes:
        x = _rng(int(n)).standard_normal((300, int(n), 1))
        out = transport(x, x, np.ones((300, 1)), [[1.0]], rng=_rng(1))
        errors.append(((out.mean(axis=1) - 0.5) ** 2).mean())
    slope = np.polyfit(np.log(sizes), np.log(errors), 1)[0]
    assert abs(slope + 1) < 0.15


def test_updates_are_affine_equivariant() -> None:
    """Observing in other units and estimating in other coordinates changes nothing."""
    y, x = _samples(7)
    a, b = _rng(1).standard_normal((3, 3)), np.diag([10.0, 0.1])
    noise, target = np.diag([0.3, 0.2]), np.zeros(2)
    plain = transport(x, y, target, noise, rng=_rng(3))
    other = transport(x @ a.T, y @ b, target, b @ noise @ b, rng=_rng(3))
    assert np.allclose(other, plain @ a.T, rtol=1e-8, atol=1e-8)


@given(st.integers(0, 10_000), st.integers(1, 4))
def test_principal_directions_hold_the_largest_variance(seed: int, n: int) -> None:
    e = _samples(seed, m=1, d=4)[1]
    w = principal_directions(e, n)
    assert np.allclose(w.T @ w, np.eye(n), atol=1e-12)
    values = np.linalg.eigvalsh(np.cov(e, rowvar=False))[::-1]
    assert np.allclose(np.cov(e @ w, rowvar=False).reshape(n, n).diagonal(), values[:n], rtol=1e-8)


def test_pca_with_all_directions_is_the_whole_update() -> None:
    y, x = _samples(7)
    inputs = (x, y, np.zeros(2), np.diag([0.3, 0.2]))
    whole = transport(*inputs, rng=_rng(3))
    for complement in ("keep", "literal"):
        out = principal_components(
            *inputs, rng=_rng(3), n_state=3, n_observed=5, complement=complement
        )
        assert np.allclose(out, whole, atol=1e-8)


def test_pca_complement() -> None:
    """Outside the leading directions: kept, or lost with the mean."""
    y, x = _samples(7)
    inputs = (x, y, np.zeros(2), np.diag([0.3, 0.2]))
    w = principal_directions(x, 2)
    outside = np.eye(3) - w @ w.T
    out = {
        c: principal_components(*inputs, rng=_rng(3), n_state=2, n_observed=2, complement=c)
        for c in ("keep", "literal")
    }
    assert np.allclose(out["keep"] @ outside, x @ outside, atol=1e-9)
    assert np.allclose(out["literal"] @ outside, 0, atol=1e-9)
    assert np.allclose(out["keep"] @ w, out["literal"] @ w, atol=1e-8)


def test_direct_sampling_and_the_composed_map_agree_where_the_map_fits() -> None:
    rng = _rng(15)
    x = rng.standard_normal((60, 2000, 2)) @ np.array([[1.0, 0.5], [0.0, 1.0]])
    inputs = (x, x[..., :1], np.full((60, 1), 1.5), [[0.5]])
    direct, composed = transport_sample(*inputs, rng=_rng(1)), transport(*inputs, rng=_rng(1))
    assert np.abs(direct.mean(axis=(0, 1)) - composed.mean(axis=(0, 1))).max() < 0.01
    gap = sample_covariance(direct).mean(axis=0) - sample_covariance(composed).mean(axis=0)
    assert np.abs(gap).max() < 0.01


def test_composed_map_keeps_what_a_misfitted_map_forgets() -> None:
    """Of a skewed prior and an observation that says nothing, (10) keeps the skewness."""
    x = _rng(16).exponential(size=(20, 2000, 1))
    inputs = (x, _rng(17).standard_normal(x.shape), np.zeros((20, 1)), [[1.0]])

    def skewness(e: np.ndarray) -> float:
        gap = e - e.mean(axis=1, keepdims=True)
        return float(((gap**3).mean(axis=1) / (gap**2).mean(axis=1) ** 1.5).mean())

    assert skewness(transport(*inputs, rng=_rng(1))) > 1.8
    assert abs(skewness(transport_sample(*inputs, rng=_rng(1)))) < 0.1


def test_noise_factor_scales_the_draw_and_nothing_else() -> None:
    """The composed map of predictions whose drawn noise is multiplied by a factor."""
    y, x = _samples(7)
    noise, target = np.array([[0.3, 0.1], [0.1, 0.2]]), np.array([0.4, -0.2])
    drawn = _rng(3).standard_normal(y.shape) @ np.linalg.cholesky(noise).T
    for factor in (0.25, 1.0):
        seen = y + factor * drawn
        map_ = affine.fit(seen, x)
        wanted = map_.inverse(target, map_(seen, x))
        out = transport(x, y, target, noise, rng=_rng(3), noise_factor=factor)
        assert np.allclose(out, wanted, atol=1e-10)
        same = {"n_state": 3, "n_observed": 2}
        pca = principal_components(x, y, target, noise, rng=_rng(3), noise_factor=factor, **same)
        assert np.allclose(pca, wanted, atol=1e-8)


def _weights(x: np.ndarray) -> np.ndarray:
    gap = Y - x @ H.T
    w = np.exp(-0.5 * np.einsum("ni,ij,nj->n", gap, np.linalg.inv(R), gap))
    return np.asarray(w / w.sum())


def test_the_update_by_its_formula() -> None:
    x = members(40)
    out = ensemble_transform(x, x @ H.T, Y, R, rng=_rng())
    assert np.allclose(out, transform(x, np.log(_weights(x))), atol=1e-10)
    assert np.abs(out.mean(axis=0) - _weights(x) @ x).max() < 1e-13


def test_the_moments_tend_to_the_kalman_filter_s() -> None:
    """Mean and covariance within five standard errors at N = 900; the noise matrix is full."""
    means, covs = [], []
    for seed in range(6):
        x = members(900, seed=seed)
        out = ensemble_transform(x, x @ H.T, Y, R, rng=_rng(), correct=True)
        means.append(out.mean(axis=0))
        covs.append(np.cov(out.T))
    mean, cov = kalman(MEAN, COV, H, R, Y)
    assert (np.abs(np.mean(means, axis=0) - mean)
            < 5 * np.std(means, axis=0, ddof=1) / 6**0.5 + 0.01).all()
    assert (np.abs(np.mean(covs, axis=0) - cov)
            < 5 * np.std(covs, axis=0, ddof=1) / 6**0.5 + 0.02).all()


def test_a_reading_far_away_underflows_nothing_and_warns() -> None:
    x = members(40)
    with pytest.warns(ParticleCollapse, match="effective size of 1"):
        out = ensemble_transform(x, x @ H.T, Y + 1e4, R, rng=_rng())
    assert np.isfinite(out).all()


def test_a_spread_that_is_lost_warns() -> None:
    """Weights of members that have run together are equal: the reading tells."""
    x = MEAN + 1e-3 * (members(40) - MEAN)
    near = x.mean(axis=0) @ H.T
    ensemble_transform(x, x @ H.T, near + 3 * np.sqrt(np.diagonal(R)), R, rng=_rng())
    with pytest.warns(ParticleCollapse, match="squared distance"):
        ensemble_transform(x, x @ H.T, near + 6 * np.sqrt(np.diagonal(R)), R, rng=_rng())


def test_nothing_is_drawn_without_rejuvenation() -> None:
    x = members(30)
    a, b = (ensemble_transform(x, x @ H.T, Y, R, rng=_rng(s)) for s in (1, 2))
    assert (a == b).all()
    c, d = (ensemble_transform(x, x @ H.T, Y, R, rng=_rng(s), rejuvenation=0.2) for s in (1, 2))
    assert (c != d).any()
    assert np.abs(c.mean(axis=0) - a.mean(axis=0)).max() < 1e-13


def test_likelihoods_of_a_full_noise_matrix() -> None:
    x = members(9)
    logs = log_likelihood(x @ H.T, Y, R)
    assert np.allclose(np.exp(logs - logs.max()), _weights(x) / _weights(x).max())
