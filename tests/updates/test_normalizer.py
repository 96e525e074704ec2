"""Constants and draws with full covariances, of which a transpose or a count would be wrong."""

from __future__ import annotations

import numpy as np
from scipy.stats import multivariate_normal

from distfilt.models import Model
from distfilt.updates import stochastic_forecast
from distfilt.updates.particles import log_likelihood, log_normalizer

from .cases import R, Y, rng

Q = np.array([[4.0, 1.8], [1.8, 1.0]])


def test_a_density_of_the_numbers_that_are_there() -> None:
    """Likelihood and constant are N(y; h, R) of the components that are observed."""
    h = np.array([[0.3, -0.4], [1.5, 0.2]])
    for present in ([0, 1], [0], [1]):
        y = np.full(2, np.nan)
        y[present] = Y[present]
        logs = log_likelihood(h, y, R) + log_normalizer(y, R)
        noise = R[np.ix_(present, present)]
        expected = [
            multivariate_normal(m[present], noise).logpdf(Y[present]) for m in h
        ]
        assert np.allclose(logs, expected)
    assert log_normalizer(np.full(2, np.nan), R) == 0.0


def test_a_forecast_draws_correlated_noise() -> None:
    """Within four standard errors: Var S_ij = (Q_ii Q_jj + Q_ij²) / N."""
    model = Model(2, lambda x, t, dt: x, lambda t, dt: dt * Q)
    n = 20_000
    x = stochastic_forecast(np.zeros((n, 2)), model, 0.0, 0.5, rng=rng())
    cov = 0.5 * Q
    variances = cov.diagonal()
    error = np.sqrt((np.outer(variances, variances) + cov**2) / n)
    assert (np.abs(np.cov(x.T) - cov) < 4 * error).all()
