"""One linear update: against the joint Gaussian, rows left out, and batches run by run."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from distfilt.gaussians import conditioned
from tests.support import spd

D, M = 4, 3


def case(seed: int, lead: tuple[int, ...] = ()) -> tuple[np.ndarray, ...]:
    rng = np.random.default_rng(seed)
    mean, gap = rng.standard_normal((*lead, D)), rng.standard_normal((*lead, M))
    return mean, spd(rng, D, lead), gap, rng.standard_normal((*lead, M, D)), spd(rng, M, lead)


@given(seed=st.integers(0, 10**6))
def test_in_information_form_an_update_is_a_sum(seed: int) -> None:
    mean, cov, gap, h, r = case(seed)
    x, p = conditioned(mean, cov, gap, h, r)
    weight = h.T @ np.linalg.inv(r)
    exact = np.linalg.inv(np.linalg.inv(cov) + weight @ h)
    np.testing.assert_allclose(p, exact, rtol=1e-8, atol=1e-9)
    np.testing.assert_allclose(x, mean + exact @ weight @ gap, rtol=1e-8, atol=1e-8)
    assert (p == p.T).all()


def test_a_missing_component_is_a_row_left_out() -> None:
    mean, cov, gap, h, r = case(1)
    gap[1] = np.nan
    kept = [0, 2]
    ours = conditioned(mean, cov, gap, h, r)
    theirs = conditioned(mean, cov, gap[kept], h[kept], r[np.ix_(kept, kept)])
    for a, b in zip(ours, theirs, strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-13)
    blind = conditioned(mean, cov, np.full(M, np.nan), h, r)
    assert (blind[0] == mean).all() and (blind[1] == cov).all()


def test_a_batch_is_its_members_one_by_one() -> None:
    mean, cov, gap, h, r = case(2, (5, 2))
    gap[np.random.default_rng(3).random(gap.shape) < 0.3] = np.nan
    x, p = conditioned(mean, cov, gap, h, r)
    for k in np.ndindex(5, 2):
        alone = conditioned(mean[k], cov[k], gap[k], h[k], r[k])
        np.testing.assert_allclose(x[k], alone[0], rtol=0, atol=1e-13)
        np.testing.assert_allclose(p[k], alone[1], rtol=0, atol=1e-13)


def test_one_covariance_and_one_sensor_serve_any_number_of_means() -> None:
    mean, gap = np.random.default_rng(4).standard_normal((2, 6, D))
    _, cov, _, h, r = case(5)
    x, p = conditioned(mean, cov, gap[:, :M], h, r)
    assert x.shape == (6, D) and p.shape == (D, D)
    full = conditioned(mean, np.broadcast_to(cov, (6, D, D)), gap[:, :M], h, r)
    np.testing.assert_allclose(x, full[0], rtol=0, atol=1e-13)
    np.testing.assert_allclose(np.broadcast_to(p, full[1].shape), full[1], rtol=0, atol=1e-13)


def test_joseph_s_form_stays_positive_where_a_reading_is_nearly_exact() -> None:
    mean, cov, gap, h, _ = case(7)
    p = conditioned(mean, 1e8 * cov, gap, h, 1e-8 * np.eye(M))[1]
    assert np.linalg.eigvalsh(p).min() > 0
