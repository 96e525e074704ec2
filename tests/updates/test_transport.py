"""Updates by transport: principal and informed directions, direct sampling, and what maps keep."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from distfilt.ensembles import sample_covariance
from distfilt.triangular import affine
from distfilt.updates import (
    informed_directions,
    known_noise,
    principal_components,
    principal_directions,
    transport,
    transport_sample,
)


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
    for complement in ("keep", "drop", "literal"):
        out = principal_components(
            *inputs, rng=_rng(3), n_state=3, n_observed=5, complement=complement
        )
        assert np.allclose(out, whole, atol=1e-8)


def test_pca_complement() -> None:
    """Outside the leading directions: kept, set to the mean, or lost with the mean."""
    y, x = _samples(7)
    inputs = (x, y, np.zeros(2), np.diag([0.3, 0.2]))
    w = principal_directions(x, 2)
    outside = np.eye(3) - w @ w.T
    out = {
        c: principal_components(*inputs, rng=_rng(3), n_state=2, n_observed=2, complement=c)
        for c in ("keep", "drop", "literal")
    }
    assert np.allclose(out["keep"] @ outside, x @ outside, atol=1e-9)
    assert np.allclose(out["drop"] @ outside, (x @ outside).mean(axis=0), atol=1e-9)
    assert np.allclose(out["literal"] @ outside, 0, atol=1e-9)
    assert np.allclose(out["keep"] @ w, out["literal"] @ w, atol=1e-8)


def test_another_fit_can_be_handed_in() -> None:
    y, x = _samples(9, n=40, m=1, d=2)
    x, y = x / x.std(axis=0), y / y.std(axis=0)
    inputs = (x, y, np.zeros(1), np.eye(1))
    closed = transport(*inputs, rng=_rng(3))
    solved = transport(*inputs, rng=_rng(3), fit=affine.fit_convex)
    assert np.abs(closed - solved).max() < 1e-6


def test_known_noise_has_the_smaller_error_in_small_ensembles() -> None:
    """Posterior means of 4000 ensembles of 8 members, four components, all observed."""
    rng = _rng(5)
    x = rng.standard_normal((4000, 10, 4))
    inputs = (x, x, np.ones((4000, 4)), np.eye(4))
    error = {
        name: ((update(*inputs, rng=_rng(6)).mean(axis=1) - 0.5) ** 2).mean()
        for name, update in (("sampled", transport), ("known", known_noise))
    }
    assert error["known"] < 0.8 * error["sampled"]


def test_shrinkage_and_ridge_have_their_limits() -> None:
    y, x = _samples(11)
    inputs = (x, y, np.zeros(2), np.diag([0.3, 0.2]))
    plain = known_noise(*inputs, rng=_rng(3))
    none = known_noise(*inputs, rng=_rng(3), shrinkage=1.0)
    assert np.array_equal(none, x)
    assert np.abs(known_noise(*inputs, rng=_rng(3), ridge=1e12) - x).max() < 1e-6
    little = known_noise(*inputs, rng=_rng(3), shrinkage=1e-9, ridge=1e-9)
    assert np.abs(little - plain).max() < 1e-5


def test_informed_directions_without_a_threshold_leaves_nothing_out() -> None:
    y, x = _samples(13, leading=(4,))
    inputs = (x, y, np.zeros((4, 2)), np.array([[0.3, 0.1], [0.1, 0.2]]))
    whole = known_noise(*inputs, rng=_rng(3))
    assert np.abs(informed_directions(*inputs, rng=_rng(3), threshold=0.0) - whole).max() < 1e-8
    assert np.array_equal(informed_directions(*inputs, rng=_rng(3), threshold=1e12), x)


def test_informed_directions_do_not_depend_on_units() -> None:
    y, x = _samples(14)
    units, noise, target = np.diag([1e3, 1e-2]), np.diag([0.3, 0.2]), np.zeros(2)
    level = np.linalg.eigvalsh(sample_covariance(y) / np.sqrt(np.outer([0.3, 0.2], [0.3, 0.2])))
    for threshold in (0.0, level.mean()):
        plain = informed_directions(x, y, target, noise, rng=_rng(3), threshold=threshold)
        other = informed_directions(
            x, y @ units, target, units @ noise @ units, rng=_rng(3), threshold=threshold
        )
        assert np.allclose(plain, other, atol=1e-8)


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


BAD_INPUT = {
    "distfilt.updates.transport.transport": [
        ("noise_factor", lambda: transport(np.ones((3, 1)), np.ones((3, 1)), [0.0], [[1.0]],
                                           rng=_rng(), noise_factor=-1)),
        ("ensemble", lambda: transport(np.ones(3), np.ones((3, 1)), [0.0], [[1.0]], rng=_rng())),
    ],
    "distfilt.updates.transport.transport_sample": [
        ("observed", lambda: transport_sample(np.eye(3), np.eye(3), [0.0], np.eye(3), rng=_rng())),
    ],
    "distfilt.updates.transport.principal_components": [
        ("n_state", lambda: principal_components(np.eye(3), np.eye(3), np.zeros(3), np.eye(3),
                                                 rng=_rng(), n_state=4, n_observed=1)),
        ("n_observed", lambda: principal_components(np.eye(3), np.eye(3), np.zeros(3), np.eye(3),
                                                    rng=_rng(), n_state=1, n_observed=0)),
        ("complement", lambda: principal_components(np.eye(3), np.eye(3), np.zeros(3), np.eye(3),
                                                    rng=_rng(), n_state=1, n_observed=1,
                                                    complement="lose")),
    ],
    "distfilt.updates.transport.principal_directions": [
        ("n", lambda: principal_directions(np.eye(3), 4)),
    ],
    "distfilt.updates.transport.informed_directions": [
        ("threshold", lambda: informed_directions(np.eye(3), np.eye(3), np.zeros(3), np.eye(3),
                                                  rng=_rng(), threshold=-1)),
    ],
}
