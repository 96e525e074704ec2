"""Updates by transport: principal directions, direct sampling, what maps keep, and couplings."""

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
from tests.triangular.samples import rng_of as _rng
from tests.triangular.samples import samples

from .cases import MEAN, H, R, Y, members

_FOUR = (*samples(7)[::-1], np.array([0.4, -0.2]), np.array([[0.3, 0.1], [0.1, 0.2]]))


@given(st.integers(0, 10_000), st.integers(1, 4))
def test_principal_directions_hold_the_largest_variance(seed: int, n: int) -> None:
    e = samples(seed, m=1, d=4)[1]
    w = principal_directions(e, n)
    assert np.allclose(w.T @ w, np.eye(n), atol=1e-12)
    values = np.linalg.eigvalsh(np.cov(e, rowvar=False))[::-1]
    assert np.allclose(
        np.cov(e @ w, rowvar=False).reshape(n, n).diagonal(), values[:n], rtol=1e-8
    )


def test_pca_complement() -> None:
    """Outside the leading directions: kept, or lost with the mean."""
    w = principal_directions(_FOUR[0], 2)
    outside = np.eye(3) - w @ w.T
    keep, literal = (
        principal_components(*_FOUR, rng=_rng(3), n_state=2, n_observed=2, complement=c)
        for c in ("keep", "literal")
    )
    assert np.allclose(keep @ outside, _FOUR[0] @ outside, atol=1e-9)
    assert np.allclose(literal @ outside, 0, atol=1e-9)
    assert np.allclose(keep @ w, literal @ w, atol=1e-8)


@pytest.mark.parametrize("factor", [0.25, 1.0])
def test_noise_factor_scales_the_draw_and_nothing_else(factor: float) -> None:
    """The composed map of predictions and multiplied noise; so is PCA with all directions."""
    x, y, target, noise = _FOUR
    seen = y + factor * _rng(3).standard_normal(y.shape) @ np.linalg.cholesky(noise).T
    map_ = affine.fit(seen, x)
    wanted = map_.inverse(target, map_(seen, x))
    out = transport_map_update(*_FOUR, rng=_rng(3), noise_factor=factor)
    assert np.allclose(out, wanted, atol=1e-10)
    for complement in ("keep", "literal"):
        pca = principal_components(
            *_FOUR,
            rng=_rng(3),
            noise_factor=factor,
            n_state=3,
            n_observed=5,
            complement=complement,
        )
        assert np.allclose(pca, wanted, atol=1e-8)


def test_the_ensemble_transform_by_its_formula() -> None:
    """Weights of a full noise matrix; corrected, also their covariance."""
    x = members(40)
    gap = Y - x @ H.T
    w = np.exp(-0.5 * np.einsum("ni,ij,nj->n", gap, np.linalg.inv(R), gap))
    w /= w.sum()
    out = etpf(x, x @ H.T, Y, R, rng=_rng())
    assert np.allclose(out, coupling.transform_ensemble(x, np.log(w)), atol=1e-10)
    assert np.abs(out.mean(axis=0) - w @ x).max() < 1e-13
    both = etpf(x, x @ H.T, Y, R, rng=_rng(), correct=True)
    assert np.allclose(
        np.cov(both.T, bias=True), np.cov(x.T, aweights=w, bias=True), atol=1e-12
    )


def test_a_reading_far_away_underflows_nothing_and_warns() -> None:
    x = members(40)
    with pytest.warns(ParticleCollapse, match="effective size of 1"):
        out = etpf(x, x @ H.T, Y + 1e4, R, rng=_rng())
    assert np.isfinite(out).all()


def test_a_spread_that_is_lost_warns() -> None:
    """Weights of members that have run together are equal: the reading tells."""
    x = MEAN + 1e-3 * (members(40) - MEAN)
    near = x.mean(axis=0) @ H.T
    etpf(x, x @ H.T, near + 3 * np.sqrt(np.diagonal(R)), R, rng=_rng())
    far = 6 * np.sqrt(np.diagonal(R))
    wanted = rf"squared distance .* is {far @ np.linalg.solve(R, far):.0f}, not 2;"
    with pytest.warns(
        ParticleCollapse, match=wanted
    ):  # of two ensembles that of the second
        etpf([x, x], [x @ H.T] * 2, [near, near + far], R, rng=_rng())


def test_nothing_is_drawn_without_rejuvenation() -> None:
    x = members(30)
    a, b = (etpf(x, x @ H.T, Y, R, rng=_rng(s)) for s in (1, 2))
    assert (a == b).all()
    c, d = (etpf(x, x @ H.T, Y, R, rng=_rng(s), rejuvenation=0.2) for s in (1, 2))
    assert (c != d).any()
    assert np.array_equal(c, coupling.rejuvenate(a, x, bandwidth=0.2, rng=_rng(1)))
