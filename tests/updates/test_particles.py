"""Weights, resampling, and jitter."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from distfilt.updates import effective_size, jitter, resample
from distfilt.updates.particles import (
    add_jitter,
    distinct_fraction,
    repeat_by_count,
    reweight,
    silverman,
)

from .cases import rng


@given(st.integers(0, 10**6), st.integers(1, 60))
def test_systematic_is_the_inverse_of_the_distribution_function(
    seed: int, n: int
) -> None:
    w = rng(seed).dirichlet(np.full(n, 0.2), size=4)
    levels = (np.arange(n) + rng(6).random((4, 1))) / n
    wanted = [
        np.searchsorted(np.cumsum(v) / v.sum(), u, side="right")
        for v, u in zip(w, levels, strict=True)
    ]
    assert np.array_equal(resample(w, rng=rng(6)), wanted)


def test_effective_size_between_one_and_n() -> None:
    assert effective_size([0.0, -np.inf, -np.inf]) == pytest.approx(1.0)
    assert effective_size(np.full(8, -1e6)) == pytest.approx(8.0)
    assert effective_size(np.log([0.5, 0.5])) == pytest.approx(2.0)
    with pytest.warns(RuntimeWarning, match="log_weights must be logarithms"):
        effective_size([0.5, 0.3, 0.2])


def test_weights_by_bayes_rule_with_a_missing_component() -> None:
    """Log-weights plus a Gaussian's exponent, normalised; a full noise matrix, a part of it."""
    h = rng(1).standard_normal((6, 2))
    before = np.log(rng(2).dirichlet(np.ones(6)))
    noise = np.array([[0.5, 0.3], [0.3, 0.9]])
    y = np.array([0.4, -0.2])
    both = before - 0.5 * np.einsum("ni,ij,nj->n", y - h, np.linalg.inv(noise), y - h)
    one, other = (before - 0.5 * (y[k] - h[:, k]) ** 2 / noise[k, k] for k in range(2))
    gaps = np.array([y, [np.nan, y[1]], [y[0], np.nan]])
    for seen, wanted in zip(gaps, (both, other, one), strict=True):
        w = np.exp(wanted) / np.exp(wanted).sum()
        assert np.allclose(np.exp(reweight(before, h, seen, noise)), w)
    # What one particle cannot predict says nothing of any.
    h[3, 1] = np.nan
    assert np.allclose(np.exp(reweight(before, h, y, noise)), w)


def test_jitter_keeps_mean_and_covariance_on_average() -> None:
    x = rng(0).standard_normal((2000, 50, 2)) @ np.array([[1.0, 0.6], [0.0, 0.4]])
    out = jitter(x, rng=rng(1), bandwidth=0.5)
    gap = out.mean(axis=1) - x.mean(axis=1)
    assert np.abs(gap.mean(axis=0)).max() < 0.01

    def cov(e: np.ndarray) -> np.ndarray:
        a = e - e.mean(axis=1, keepdims=True)
        return (np.swapaxes(a, -1, -2) @ a / e.shape[1]).mean(axis=0)

    # The kernel's own mean takes a share h²/N of its variance.
    assert np.allclose(cov(out), (1 - 0.25 / 50) * cov(x), atol=0.01)
    own = [np.cov(e.T, ddof=0) for e in x]
    assert np.allclose(out, jitter(x, rng=rng(1), bandwidth=0.5, cov=own))
    assert (
        silverman(40, 3) == pytest.approx((4 / (40 * 5)) ** (1 / 7))
        and silverman(1, 1) == 1
    )


def test_jitter_of_copies_moves_them_only_and_from_the_covariance_given() -> None:
    counts = np.tile([2, 1, 3, 1, 0, 0, 0], (4000, 1))
    each = np.tile(np.arange(7.0), (4000, 1))
    x = repeat_by_count(each[..., None] * [1.0, -2.0], counts)
    copied = repeat_by_count(counts[..., None] > 1, counts)
    assert np.array_equal(x[5, :, 0], [0, 0, 1, 2, 2, 2, 3])
    cov = np.array([[2.0, 0.6], [0.6, 0.5]])
    drawn = rng().standard_normal(x.shape)
    out = add_jitter(x, cov, 0.5, drawn, copied[..., 0])
    assert (out[:, [2, 6]] == x[:, [2, 6]]).all() and (
        distinct_fraction(out) == 1
    ).all()
    moved = (out - x)[:, [0, 1, 3, 4, 5]].reshape(-1, 2)
    assert np.abs(moved.mean(axis=0)).max() < 4 * 0.5 * np.sqrt(2 / len(moved))
    assert np.allclose(
        np.cov(moved.T), 0.25 * cov, atol=4 * 0.25 * 2 * np.sqrt(2 / len(moved))
    )
