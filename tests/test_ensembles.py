"""Moments against their definitions, draws against statistics, exact noise against identities."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import chi2, kstest

from distfilt import ensembles
from distfilt.ensembles import (
    center_ensemble,
    draw,
    exact_noise,
    mean,
    sample_covariance,
)
from distfilt.linalg import factor
from tests.support import generator, relative_difference, singular, spd

SEEDS = st.integers(0, 10_000)
FULL = np.array([[4.0, 1.8, -0.6], [1.8, 1.5, 0.1], [-0.6, 0.1, 0.5]])
"""Its Cholesky factor and the factor's transpose give different covariances."""


def test_moments_are_their_definitions() -> None:
    x = generator(1).standard_normal((2, 7, 3)) @ FULL + 5.0
    _, anomalies = center_ensemble(x)
    covariances = sample_covariance(x)
    for k in range(2):
        assert np.allclose(mean(x)[k], x[k].mean(axis=0), rtol=1e-14)
        assert np.allclose(anomalies[k], x[k] - x[k].mean(axis=0), atol=1e-14)
        expected = np.cov(x[k], rowvar=False)
        assert np.allclose(covariances[k], expected, rtol=1e-12, atol=1e-13)
    assert (covariances == covariances.swapaxes(-1, -2)).all()
    # An ensemble of one member is its own mean.
    assert mean(x[:, :1]).shape == (2, 3)
    _, anomalies = center_ensemble(x[:, :1])
    assert (anomalies == 0).all()


# --- draws ------------------------------------------------------------------------------------


def test_draws_have_the_mean_and_the_full_covariance() -> None:
    """Each entry of the sample moments within 5 standard errors; a transposed factor is 50 off."""
    n = 20_000  # along all axes
    centre = np.array([1.0, -2.0, 3.0])
    x = draw(centre, FULL, 100, rng=generator(3), leading=(20, 10))
    x = x.reshape(n, 3)
    # Var P̂_ij = (P_ij² + P_ii P_jj) / n of Gaussian draws.
    variances = FULL.diagonal()
    error = np.sqrt((FULL**2 + np.outer(variances, variances)) / n)
    assert (np.abs(sample_covariance(x) - FULL) < 5 * error).all()
    mean_error = np.sqrt(variances / n)
    assert (np.abs(mean(x) - centre) < 5 * mean_error).all()
    # The squared length is chi-square: the shape is Gaussian too.
    deviation = x - centre
    whitened = np.linalg.solve(FULL, deviation.T).T
    length = (deviation * whitened).sum(-1)
    assert kstest(length, chi2(3).cdf).pvalue > 1e-4


def test_draws_of_a_singular_covariance_stay_in_its_range() -> None:
    # P = a aᵀ: all draws are multiples of a, up to the mean.
    a = np.array([1.0, 0.0, 2.0])
    x = draw([0.0, 5.0, 0.0], np.outer(a, a), 50, rng=generator(5))
    assert (x[:, 1] == 5.0).all()
    assert np.allclose(x[:, 2], 2 * x[:, 0], rtol=1e-12)
    assert (draw([1.0], [[0.0]], 3, rng=generator()) == 1.0).all()


# --- noise with exact second moments ----------------------------------------------------------


def _exact(avoid: np.ndarray, cov: np.ndarray, noise: np.ndarray) -> None:
    """Mean 0, no correlation with `avoid`, covariance `cov`: all to 1e-12."""
    std = np.sqrt(np.diagonal(cov, axis1=-2, axis2=-1))
    # A component without noise is compared in absolute terms.
    std = np.where(std > 0, std, 1.0)
    assert np.abs(mean(noise) / std).max(initial=0) < 1e-12
    covariance = sample_covariance(noise)
    expected = np.broadcast_to(cov, covariance.shape)
    assert relative_difference(covariance, expected) < 1e-12
    if avoid.shape[-1]:
        length = avoid.std(axis=-2, ddof=1)
        length = np.where(length > 0, length, 1.0)
        _, anomalies = center_ensemble(avoid)
        correlation = anomalies.mT @ noise / (avoid.shape[-2] - 1)
        correlation /= length[..., :, None] * std[..., None, :]
        assert np.abs(correlation).max() < 1e-12


@given(SEEDS, st.integers(0, 5), st.integers(1, 4), st.integers(1, 40), st.data())
def test_exact_noise_is_exact_down_to_the_last_member(
    seed: int, p: int, k: int, more: int, data: st.DataObject
) -> None:
    """Any number of members above p + rank, full and singular covariances, steep anomalies."""
    rng = generator(seed)
    rank = data.draw(st.integers(0, k))
    cov = spd(rng, k, (2,)) if rank == k else singular(rng, k, rank, (2,))
    n = max(2, p + rank + more)
    standard = rng.standard_normal((2, n, p))
    scales = 10.0 ** rng.uniform(-6, 6, p)
    avoid = standard * scales + 1.0
    noise = exact_noise(avoid, factor(cov), rng)
    assert noise.shape == (2, n, k)
    _exact(avoid, cov, noise)


@pytest.mark.parametrize("n", [12, 40])
def test_exact_noise_beside_anomalies_that_depend_on_each_other(n: int) -> None:
    """As predictions do on the state: the independent ones count, nearly dependent ones too."""
    rng = generator(6)
    x = rng.standard_normal((3, n, 4))
    for slight in (0.0, 1e-12, 1e-9, 1e-6, 1e-3):
        linear = x @ rng.standard_normal((4, 8))
        h = linear + slight * rng.standard_normal((3, n, 8))
        joint = np.concatenate([x, h], axis=-1)
        if n == 12 and slight:
            # Twelve independent anomalies leave no direction to twelve members.
            text = r"must have more than 1[12] \+ 3 members.* got 12$"
            with pytest.raises(ValueError, match=text):
                exact_noise(joint, factor(FULL), rng)
        else:
            noise = exact_noise(joint, factor(FULL), rng)
            _exact(joint, FULL, noise)
    # Constant components and a copy at 1e6 add no anomaly.
    constant = np.zeros((3, n, 2))
    copy = 1e6 + x[..., :1]
    flat = np.concatenate([x, constant, copy], axis=-1)
    noise = exact_noise(flat, factor(FULL), rng)
    _exact(flat[..., :6], FULL, noise)


def test_exact_noise_beside_combinations_of_close_anomalies() -> None:
    """A difference of correlated components is no anomaly of its own and costs no member."""
    for seed in range(20):
        rng = generator(seed)
        x = rng.standard_normal((3, 7, 3))
        x[..., 1:] = x[..., :1] + 1e-3 * x[..., 1:]
        differences = x @ [[0.0, 1.0], [1.0, -1.0], [-1.0, 0.0]]
        joint = np.concatenate([x, differences], axis=-1)
        # Seven members: three anomalies, three components of noise, and the mean.
        noise = exact_noise(joint, factor(FULL), rng)
        _exact(joint, FULL, noise)


def test_too_few_members_are_refused_with_the_number_needed() -> None:
    x = generator(7).standard_normal((9, 4))
    # p anomalies, noise of rank r and the mean need N > p + r members.
    assert exact_noise(x[:8], factor(FULL), generator()).shape == (8, 3)
    text = r"^ensemble must have more than 4 \+ 3 members"
    with pytest.raises(ValueError, match=text):
        exact_noise(x[:7], factor(FULL), generator())
    rank_one = np.ones((3, 3))
    assert exact_noise(x[:6], factor(rank_one), generator()).shape == (6, 3)
    zero = exact_noise(x[:5], factor(np.zeros((3, 3))), generator())
    assert (zero == 0).all()


def test_both_ways_give_the_same_draw(monkeypatch: pytest.MonkeyPatch) -> None:
    """Normal equations where they are safe, orthogonal bases where not: one projection."""
    units = np.diag([1.0, 1e3, 1e-3, 1.0])
    x = generator(8).standard_normal((5, 30, 4)) @ units
    # The fast way whitens by a Cholesky factor; without one QR takes its place.
    fast = exact_noise(x, factor(FULL), generator(9))

    def fails(gram: np.ndarray) -> None:
        raise np.linalg.LinAlgError

    monkeypatch.setattr(ensembles, "cholesky", fails)
    slow = exact_noise(x, factor(FULL), generator(9))
    assert np.allclose(fast, slow, rtol=0, atol=1e-12)
    other_seed = exact_noise(x, factor(FULL), generator(10))
    assert not np.allclose(fast, other_seed)


def test_exact_noise_is_uniform_over_the_free_directions() -> None:
    """Each member has mean 0 and the variance of the projection."""
    rng = generator(12)
    x = rng.standard_normal((8, 2))
    copies = np.broadcast_to(x, (20_000, 8, 2))
    noise = exact_noise(copies, factor([[4.0]]), rng)[..., 0]
    # The draws lie in the complement of the constant and of both columns of x.
    basis, _ = np.linalg.qr(np.column_stack([np.ones(8), x]))
    projection = np.eye(8) - basis @ basis.T
    covariance = noise.T @ noise / 20_000
    # 7 · 4 is the squared length, spread evenly over 8 - 1 - 2 directions.
    variance = 4.0 * 7 / 5
    expected = variance * projection
    # Six standard errors
    cov_error = variance / np.sqrt(20_000)
    mean_error = np.sqrt(variance / 20_000)
    assert np.abs(covariance - expected).max() < 6 * cov_error
    assert np.abs(noise.mean(axis=0)).max() < 6 * mean_error
