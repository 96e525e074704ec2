"""Errors, consistency and scores against their definitions, closed forms and exact coverage."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats
from scipy.integrate import quad

from distfilt.metrics import crps, gaussian_crps, nees, nees_band, nis
from tests.support import generator, spd

RNG = np.random.default_rng(0)


def test_leading_axes_broadcast():
    estimates = RNG.standard_normal((7, 3, 6, 2))  # runs, agents, members, components
    truth = RNG.standard_normal((7, 1, 2))
    whole = crps(estimates, truth)
    for r in range(7):
        for a in range(3):
            assert np.allclose(whole[r, a], crps(estimates[r, a], truth[r, 0]), rtol=1e-12)


# --- consistency ------------------------------------------------------------------------------


@pytest.mark.parametrize("leading", [(), (3,), (50, 2)])
def test_nees_and_nis_are_their_definitions(leading):
    rng = generator(5)
    estimate, truth = rng.standard_normal((2, *leading, 4))
    cov = spd(rng, 4, leading)
    gap = estimate - truth
    exact = (gap * np.linalg.solve(cov, gap[..., None])[..., 0]).sum(-1)
    assert nees(estimate, cov, truth).shape == leading
    assert np.allclose(nees(estimate, cov, truth), exact, rtol=1e-10)
    assert np.allclose(nis(gap, cov), exact, rtol=1e-10)
    one = cov[(0,) * len(leading)]
    exact = (gap * np.linalg.solve(one, gap[..., None])[..., 0]).sum(-1)
    assert np.allclose(nees(estimate, one, truth), exact, rtol=1e-10)
    with pytest.raises(ValueError, match="^truth: needs leading axes"):
        nees(np.ones((2, 4)), one, np.ones((3, 4)))



@pytest.mark.parametrize("dim, runs, level", [(1, 1, 0.95), (6, 24, 0.95), (13, 100, 0.99)])
def test_nees_band_has_its_probability(dim, runs, level):
    band = nees_band(dim, runs, level=level)
    law = stats.chi2(dim * runs)
    assert law.cdf(band.high * runs) - law.cdf(band.low * runs) == pytest.approx(level, abs=1e-10)
    unit = nees_band(dim, runs, level=level, normalised=True)
    assert np.allclose([unit.low, unit.high, unit.error],
                       np.array([band.low, band.high, band.error]) / dim, rtol=1e-12)  # fmt: skip
    assert dim in band and 1 in unit
    assert band.error == pytest.approx(np.sqrt(2 * dim / runs), rel=1e-12)


# --- scores -----------------------------------------------------------------------------------


@pytest.mark.parametrize("mean, std, truth", [(0.0, 1.0, 0.0), (2.0, 0.3, 1.1), (-1.0, 5.0, 9.0)])
def test_gaussian_crps_equals_its_integral(mean, std, truth):
    cdf = stats.norm(mean, std).cdf
    below, _ = quad(lambda u: cdf(u) ** 2, mean - 12 * std, truth, epsabs=1e-12)
    above, _ = quad(lambda u: (1 - cdf(u)) ** 2, truth, mean + 12 * std, epsabs=1e-12)
    assert gaussian_crps(mean, std, truth) == pytest.approx(below + above, abs=1e-9)


@pytest.mark.parametrize("n", [1, 2, 50])
def test_crps_is_its_definition(n):
    rng = generator(n)
    x, y, w = rng.standard_normal((3, n, 2)), rng.standard_normal((3, 2)), rng.dirichlet([1] * n, 3)
    found = crps(x, y, weights=w)
    for r in range(3):
        for k in range(2):
            a = x[r, :, k]
            pairs = (w[r] * np.abs(a[:, None] - a) * w[r][:, None]).sum()
            exact = (w[r] * np.abs(a - y[r, k])).sum() - pairs / 2
            assert found[r, k] == pytest.approx(exact, abs=1e-13)
    equal = np.full(n, 1 / n)
    assert np.allclose(crps(x, y, weights=[equal] * 3), crps(x, y), atol=1e-13)
