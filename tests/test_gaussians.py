"""Density, covariance intersection and its weights, matched moments, points, updates."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import multivariate_normal

from distfilt.ensembles import mean, sample_covariance
from distfilt.gaussians import (
    condition,
    intersect_gaussians,
    intersection,
    intersection_weights,
)
from distfilt.gaussians.single import log_density, match_moments, unscented_points
from tests.support import NAN, generator, spd, unit_gap, without_checks

SEEDS = st.integers(0, 10_000)
RULES = ("equal", "trace", "determinant", "min_trace", "min_determinant")
THIRDS = np.full(3, 1 / 3)


# --- density ----------------------------------------------------------------------------------


@given(SEEDS, st.integers(1, 6))
def test_log_density_is_the_definition(seed: int, d: int) -> None:
    rng = generator(seed)
    x = rng.standard_normal((4, 3, d))
    centre = rng.standard_normal((3, d))
    cov = spd(rng, d, (3,))
    logs = log_density(x, centre, cov)
    assert logs.shape == (4, 3)
    for i in range(3):
        exact = multivariate_normal(centre[i], cov[i]).logpdf(x[:, i])
        assert np.allclose(logs[:, i], exact, rtol=1e-9, atol=1e-9)
    assert np.allclose(log_density(x, centre, cov[0])[..., 0], logs[:, 0])


# --- intersection -----------------------------------------------------------------------------


def _intersect_by_inverses(
    m: np.ndarray, p: np.ndarray, w: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """P⁻¹ = Σ ω P_b⁻¹ and P⁻¹ m = Σ ω P_b⁻¹ m_b."""
    information = np.linalg.inv(p)
    cov = np.linalg.inv((w[..., None, None] * information).sum(axis=-3))
    vector = (w[..., None] * (information @ m[..., None])[..., 0]).sum(axis=-2)
    return (cov @ vector[..., None])[..., 0], cov


@given(SEEDS, st.integers(1, 5), st.integers(1, 5))
def test_intersection_is_the_weighted_sum_of_information(
    seed: int, s: int, d: int
) -> None:
    rng = generator(seed)
    m = rng.standard_normal((6, s, d))
    p = spd(rng, d, (6, s))
    w = rng.dirichlet(np.ones(s), 6)
    fused = intersect_gaussians(m, p, w)
    # Rounding grows with the condition of the worst covariance.
    exact = _intersect_by_inverses(m, p, w)
    worst = 1e-13 * np.linalg.cond(p).max()
    assert np.abs(fused[0] - exact[0]).max() < 10 * worst
    assert unit_gap(fused[1], exact[1]) < worst
    assert (fused[1] == fused[1].swapaxes(-1, -2)).all()
    # A batch is the same as its members, and leading axes broadcast.
    one = intersect_gaussians(m[2], p[2], w[2])
    assert np.allclose(one[0], fused[0][2], atol=worst) and np.allclose(
        one[1], fused[1][2]
    )
    several = intersect_gaussians(m[2], np.stack([p[2], 2 * p[2]]), w[2])
    assert np.allclose(several[0], one[0], atol=worst) and np.allclose(
        several[1][1], 2 * one[1]
    )


def test_intersection_of_the_same_or_one_source_changes_nothing() -> None:
    rng = generator(1)
    m = 1e6 + rng.standard_normal(3)
    p = spd(rng, 3)
    mean_, cov = intersect_gaussians([m] * 4, [p] * 4, [0.1, 0.2, 0.3, 0.4])
    assert np.allclose(mean_, m, rtol=1e-15, atol=0) and unit_gap(cov, p) < 1e-14
    mean_, cov = intersect_gaussians([m, 0 * m], [p, np.eye(3)], [1.0, 0.0])
    assert (mean_ == m).all() and unit_gap(cov, p) < 1e-14
    mean_, cov = intersect_gaussians([0 * m, m], [np.eye(3), p], [0.0, 1.0])
    assert np.allclose(mean_, m, rtol=1e-14) and unit_gap(cov, p) < 1e-13


def test_intersection_does_not_depend_on_units_or_order() -> None:
    rng = generator(2)
    m = rng.standard_normal((3, 4))
    p = spd(rng, 4, (3,))
    w = np.array([0.2, 0.5, 0.3])
    # Weights and result belong to the sources, in any units.
    size = np.array([1e-9, 1.0, 1e9, 1e3])
    plain = intersect_gaussians(m, p, w)
    scaled = intersect_gaussians(m * size, p * np.outer(size, size), w)
    assert np.allclose(scaled[0], plain[0] * size, rtol=1e-11)
    assert unit_gap(scaled[1], plain[1] * np.outer(size, size)) < 1e-12
    turned = intersect_gaussians(m[::-1], p[::-1], w[::-1])
    assert np.allclose(turned[0], plain[0]) and unit_gap(turned[1], plain[1]) < 1e-12


def test_extreme_precision_does_not_spoil_the_rest() -> None:
    rng = generator(4)
    sharp = 1e-20 * spd(rng, 3)
    wide = spd(rng, 3)
    for order in (slice(None), slice(None, None, -1)):
        m = np.stack([np.ones(3), np.zeros(3)])[order]
        mean_, cov = intersect_gaussians(m, np.stack([sharp, wide])[order], [0.5, 0.5])
        assert np.allclose(mean_, 1.0) and unit_gap(cov, 2 * sharp) < 1e-9
    # Components equal but for the last bit: along their sum both count, and rounding hides the
    # other directions.
    nearly_equal = (1 + np.eye(2) * 2.0**-52) / 16
    cov = intersect_gaussians(
        np.zeros((2, 2)), [np.eye(2), nearly_equal], [0.75, 0.25]
    )[1]
    assert np.isclose(cov.sum(), 2 / (0.75 + 0.25 / 0.125))


# --- weights ----------------------------------------------------------------------------------


@pytest.mark.parametrize("rule", RULES)
def test_an_absent_source_has_weight_zero_for_any_values(rule: str) -> None:
    rng = generator(5)
    p = spd(rng, 3, (4, 5))
    m = rng.standard_normal((4, 5, 3))
    present = rng.random((4, 5)) < 0.6
    present[:, 2] = True
    present[0] = [False, False, True, False, False]
    present[1, 0] = False
    present[2, 0] = True
    for junk in (NAN, 0.0, -3.0):
        covs = np.where(present[..., None, None], p, junk)
        means = np.where(present[..., None], m, junk)
        w = without_checks(intersection_weights)(covs, rule=rule, present=present)
        assert (w[~present] == 0).all() and np.allclose(w.sum(-1), 1.0, rtol=1e-14)
        assert w[0, 2] == 1.0 and (w >= 0).all()
        fused = without_checks(intersect_gaussians)(means, covs, w)
        for i in range(4):
            single = intersection_weights(p[i][present[i]], rule=rule)
            assert np.allclose(w[i][present[i]], single, atol=1e-6)
            one = intersect_gaussians(
                m[i][present[i]], p[i][present[i]], w[i][present[i]]
            )
            assert np.allclose(fused[0][i], one[0], atol=1e-11)
            assert unit_gap(fused[1][i], one[1]) < 1e-11


def test_closed_forms() -> None:
    p = np.stack([np.diag([1.0, 4.0]), np.diag([9.0, 1.0]), [[2.0, 1.0], [1.0, 2.0]]])
    assert np.allclose(intersection_weights(p), THIRDS, rtol=1e-15)
    # Inverse traces, and inverse d-th roots of the determinants.
    traces = np.array([1 / 5, 1 / 10, 1 / 4])
    assert np.allclose(
        intersection_weights(p, rule="trace"), traces / traces.sum(), rtol=1e-14
    )
    roots = np.array([1 / 2, 1 / 3, 1 / np.sqrt(3)])
    assert np.allclose(
        intersection_weights(p, rule="determinant"), roots / roots.sum(), rtol=1e-14
    )
    for rule in RULES:
        assert intersection_weights(p[:1], rule=rule).tolist() == [1.0]
    present = np.array([True, False, True])
    assert intersection_weights(p, present=[present, ~present]).tolist() == [
        [0.5, 0, 0.5],
        [0, 1, 0],
    ]
    huge = np.stack([1e-200 * np.eye(4), 1e200 * np.eye(4)])
    assert np.allclose(intersection_weights(huge, rule="determinant"), [1.0, 0.0])


def _slopes(w: np.ndarray, p: np.ndarray, rule: str) -> np.ndarray:
    """The derivatives of the documentation, by inverses."""
    information = np.linalg.inv(p)
    cov = np.linalg.inv((w[:, None, None] * information).sum(axis=0))
    right = cov @ information @ cov if rule == "min_trace" else cov @ information
    return np.trace(right, axis1=-2, axis2=-1)


@pytest.mark.parametrize("rule", ["min_trace", "min_determinant"])
@given(
    seed=SEEDS,
    s=st.integers(2, 5),
    d=st.integers(1, 5),
    spread=st.sampled_from([0.1, 1, 3]),
)
def test_optimal_weights_meet_the_conditions_of_the_optimum(
    rule: str, seed: int, s: int, d: int, spread: float
) -> None:
    rng = generator(seed)
    p = spd(rng, d, (s,)) * np.exp(spread * rng.standard_normal((s, 1, 1)))
    w = intersection_weights(p, rule=rule)
    # g_b ≤ Σ ω g, with equality where ω_b > 0 (Karush, Kuhn and Tucker).
    slopes = _slopes(w, p, rule)
    average = float(w @ slopes)
    assert slopes.max() <= (1 + 2e-7) * average
    assert (w * (average - slopes) <= 2e-7 * average).all()
    if rule == "min_determinant":
        assert average == pytest.approx(d, rel=1e-9)


def test_monotone_steps_alone_reach_the_optimum(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A Newton step that increases the objective is not accepted."""
    p = spd(generator(8), 3, (4, 3))
    exact = intersection_weights(p, rule="min_determinant")

    def astray(weights: np.ndarray, *rest: object) -> np.ndarray:
        return np.roll(weights, 1, axis=-1) ** 2 / (weights**2).sum(-1, keepdims=True)

    monkeypatch.setattr(intersection, "_newton_step", astray)
    monkeypatch.setattr(intersection, "_MAX_STEPS", 1500)
    for rule in ("min_determinant", "min_trace"):
        w = intersection_weights(p, rule=rule)
        assert np.allclose(w.sum(-1), 1.0) and (w >= 0).all()
        for i in range(4):
            best = _slopes(w[i], p[i], rule)
            assert best.max() <= 1.001 * float(w[i] @ best)
    assert np.allclose(
        intersection_weights(p, rule="min_determinant"), exact, atol=0.02
    )


def test_optimal_weights_of_crossed_repeated_and_dominated_sources() -> None:
    crossed = [np.diag([1.0, 4.0]), np.diag([4.0, 1.0])]
    for rule in ("min_trace", "min_determinant"):
        better = intersection_weights(
            [np.eye(2), 1.01 * np.eye(2), 9 * np.eye(2)], rule=rule
        )
        assert better[0] > 1 - 1e-4
        twice = intersection_weights([crossed[0], crossed[0], crossed[1]], rule=rule)
        assert np.allclose([twice[:2].sum(), twice[2]], 0.5, atol=1e-6)


@pytest.mark.parametrize("bad", [NAN, np.inf])
def test_covariances_with_nan_are_refused_where_they_have_weight(
    bad: float,
) -> None:
    p = spd(generator(7), 2, (3,))
    p[1, 0, 0] = bad
    for call in (intersection_weights, without_checks(intersection_weights)):
        for rule in RULES:
            with pytest.raises(ValueError, match="^covs must have finite numbers"):
                call(p, rule=rule)
    for fuse in (intersect_gaussians, without_checks(intersect_gaussians)):
        with pytest.raises(ValueError, match="^covs must have finite numbers"):
            fuse(np.zeros((3, 2)), p, THIRDS)
    cov = without_checks(intersect_gaussians)(
        np.zeros((3, 2)), p, np.array([0.5, 0.0, 0.5])
    )[1]
    assert np.isfinite(cov).all()


@given(SEEDS, st.floats(-300, 290))
def test_optimal_weights_are_numbers_for_any_sizes(seed: int, power: float) -> None:
    rng = generator(seed)
    size = 10.0 ** rng.uniform(-8, 8, (4, 3, 4))
    p = spd(rng, 4, (4, 3)) * size[..., :, None] * size[..., None, :]
    p[:, 0] *= 10.0**power
    p = 0.5 * (p + p.swapaxes(-1, -2))
    for rule in RULES:
        w = intersection_weights(p, rule=rule)
        assert (w >= 0).all() and np.allclose(w.sum(-1), 1.0, rtol=1e-12)


# --- matched moments --------------------------------------------------------------------------


def _ensembles(seed: int, n: int, d: int, leading: tuple[int, ...] = ()) -> np.ndarray:
    rng = generator(seed)
    mixing = rng.standard_normal((*leading, d, d))
    shift = 10 * rng.standard_normal((*leading, 1, d))
    return (rng.standard_normal((*leading, n, d)) @ mixing + shift) * np.logspace(
        -3, 3, d
    )


@given(SEEDS, st.integers(1, 13), st.integers(1, 30))
def test_matched_moments_are_exact(seed: int, d: int, more: int) -> None:
    """For any condition of the old and the new covariance, down to d + 1 members."""
    e = _ensembles(seed, d + more, d, (2,))
    other = _ensembles(seed + 1, d + 5, d, (2,))
    centre = mean(other)
    cov = sample_covariance(other)
    try:
        matched = match_moments(e, centre, cov)
    except ValueError as error:  # members or target flat to rounding
        assert "singular" in str(error) or "definite" in str(error)
        return
    std = np.sqrt(np.diagonal(cov, axis1=-2, axis2=-1))
    rounding = 1e-15 * (np.abs(centre) / std).max()
    assert np.abs((mean(matched) - centre) / std).max() < 1e-13 + 10 * rounding
    assert unit_gap(sample_covariance(matched), cov) < 1e-13 + 100 * rounding


def test_moments_are_exact_if_both_covariances_are_ill_conditioned() -> None:
    """A product of inverses and roots once lost nine digits here."""
    rng = generator(31)
    for d in (3, 12):
        flat = (
            np.diag(np.logspace(0, -7, d))
            @ np.linalg.qr(rng.standard_normal((d, d)))[0]
        )
        e = rng.standard_normal((60, d)) @ flat
        target = spd(rng, d, least=1e-10)
        matched = match_moments(e, np.zeros(d), target)
        assert unit_gap(sample_covariance(matched), target) < 1e-13


def test_matching_moments_is_symmetric_and_so_optimal_transport() -> None:
    """A C A = P has one symmetric positive solution in units of the new standard deviations."""
    e = _ensembles(1, 40, 4)
    other = _ensembles(2, 40, 4)
    cov = sample_covariance(other)
    unit = np.sqrt(cov.diagonal())
    # The map A of the anomalies, from their least squares, is symmetric positive definite.
    a = np.linalg.lstsq(
        e - mean(e), match_moments(e, mean(e), cov) - mean(e), rcond=None
    )[0].T
    a *= unit / unit[:, None]
    assert np.abs(a - a.T).max() < 1e-9 * np.abs(a).max()
    assert (np.linalg.eigvalsh(0.5 * (a + a.T)) > 0).all()


def test_leading_axes_of_a_target_broadcast_or_are_refused_by_name() -> None:
    e = _ensembles(4, 9, 2, (3,))
    cov = np.stack([np.eye(2)] * 3)
    many = match_moments(e[0], np.arange(6.0).reshape(3, 2), np.eye(2))
    assert many.shape == (3, 9, 2) and np.allclose(mean(many), [[0, 1], [2, 3], [4, 5]])
    with pytest.raises(ValueError, match="^mean must have leading axes that broadcast"):
        match_moments(e, np.zeros((4, 2)), cov)
    with pytest.raises(ValueError, match="^cov must have leading axes that broadcast"):
        match_moments(e, np.zeros(2), cov[:2])


def test_flat_ensembles_are_refused_wherever_they_lie() -> None:
    rng = generator(12)
    x = rng.standard_normal((20, 3))
    for flat in (
        x @ [[1, 0, 1], [0, 1, 1], [0, 0, 0]],
        x * [1, 0, 1],
        1e9 + x * [1, 1e-9, 1],
    ):
        for shift in (0.0, 1e6):
            with pytest.raises(ValueError, match="^ensemble must .* singular"):
                match_moments(
                    np.stack([x, flat + shift]),
                    np.zeros((2, 3)),
                    np.stack([np.eye(3)] * 2),
                )


# --- unscented points -------------------------------------------------------------------------


@pytest.mark.parametrize("kappa", [-1.0, 0.0, 0.5, 3.0])
@pytest.mark.parametrize("d", [2, 5])
def test_points_have_the_moments(d: int, kappa: float) -> None:
    rng = generator(d)
    mean = rng.standard_normal((4, d))
    cov = spd(rng, d, (4,))
    root = np.linalg.cholesky(cov) @ np.linalg.qr(rng.standard_normal((d, d)))[0]
    points, w = unscented_points(mean, root, kappa=kappa)
    assert points.shape == (4, 2 * d + 1, d) and np.isclose(w.sum(), 1)
    # Σ w x = m and Σ w (x - m)(x - m)ᵀ = P, for any square root.
    assert np.allclose(w @ points, mean)
    innovation = points - mean[:, None]
    assert np.allclose((innovation * w[:, None]).mT @ innovation, cov)
    assert np.allclose(points[:, 0], mean) and np.allclose(
        points[:, 1:].mean(axis=1), mean
    )


def test_fourth_moments_along_an_axis_are_a_gaussians() -> None:
    points, w = unscented_points(np.zeros(4), np.eye(4), kappa=-1.0)
    # E z⁴ = 3 and E z³ = 0 with κ = 3 - d.
    assert np.allclose(w @ points**4, 3.0) and np.allclose(w @ points**3, 0.0)


# --- conditioning -----------------------------------------------------------------------------

D = 4
M = 3


def case(seed: int, lead: tuple[int, ...] = ()) -> tuple[np.ndarray, ...]:
    rng = np.random.default_rng(seed)
    mean = rng.standard_normal((*lead, D))
    innovation = rng.standard_normal((*lead, M))
    return (
        mean,
        spd(rng, D, lead),
        innovation,
        rng.standard_normal((*lead, M, D)),
        spd(rng, M, lead),
    )


@given(seed=st.integers(0, 10**6))
def test_in_information_form_an_update_is_a_sum(seed: int) -> None:
    mean, cov, innovation, h, r = case(seed)
    x, p = condition(mean, cov, innovation, h, r)
    # P⁺⁻¹ = P⁻¹ + Hᵀ R⁻¹ H and m⁺ = m + P⁺ Hᵀ R⁻¹ d
    weight = h.T @ np.linalg.inv(r)
    exact = np.linalg.inv(np.linalg.inv(cov) + weight @ h)
    np.testing.assert_allclose(p, exact, rtol=1e-8, atol=1e-9)
    np.testing.assert_allclose(
        x, mean + exact @ weight @ innovation, rtol=1e-8, atol=1e-8
    )
    assert (p == p.T).all()


def test_a_missing_component_is_a_row_left_out() -> None:
    mean, cov, complete, h, r = case(1)
    for lost, remaining in ((1, [0, 2]), (0, [1, 2])):
        innovation = np.where(np.arange(M) == lost, np.nan, complete)
        ours = [
            both[0]
            for both in condition(mean, cov, innovation, h, np.stack([r, 2 * r]))
        ]
        theirs = condition(
            mean,
            cov,
            innovation[remaining],
            h[remaining],
            r[np.ix_(remaining, remaining)],
        )
        for a, b in zip(ours, theirs, strict=True):
            np.testing.assert_allclose(a, b, rtol=0, atol=1e-13)
    blind = condition(mean, cov, np.full(M, np.nan), h, r)
    assert (blind[0] == mean).all() and (blind[1] == cov).all()


def test_a_batch_is_its_members_one_by_one() -> None:
    mean, cov, innovation, h, r = case(2, (5, 2))
    innovation[np.random.default_rng(3).random(innovation.shape) < 0.3] = np.nan
    x, p = condition(mean, cov, innovation, h, r)
    for k in np.ndindex(5, 2):
        single = condition(mean[k], cov[k], innovation[k], h[k], r[k])
        np.testing.assert_allclose(x[k], single[0], rtol=0, atol=1e-13)
        np.testing.assert_allclose(p[k], single[1], rtol=0, atol=1e-13)


def test_one_covariance_and_one_sensor_serve_any_number_of_means() -> None:
    mean, innovation = np.random.default_rng(4).standard_normal((2, 6, D))
    _, cov, _, h, r = case(5)
    x, p = condition(mean, cov, innovation[:, :M], h, r)
    assert x.shape == (6, D) and p.shape == (D, D)
    full = condition(mean, np.broadcast_to(cov, (6, D, D)), innovation[:, :M], h, r)
    np.testing.assert_allclose(x, full[0], rtol=0, atol=1e-13)
    np.testing.assert_allclose(
        np.broadcast_to(p, full[1].shape), full[1], rtol=0, atol=1e-13
    )


def test_joseph_s_form_is_accurate_for_a_nearly_exact_observation() -> None:
    """The posterior variance of an observed component is R, sixteen digits below P."""
    mean, cov, innovation, _, _ = case(7)
    p = condition(mean, 1e8 * cov, innovation, np.eye(D)[:M], 1e-8 * np.eye(M))[1]
    np.testing.assert_allclose(p[:M, :M], 1e-8 * np.eye(M), rtol=1e-6, atol=1e-13)
