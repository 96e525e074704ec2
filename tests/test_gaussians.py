"""Density, covariance intersection and its weights, matched moments, points, updates."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import multivariate_normal

from distfilt.ensembles import match_moments, mean, sample_covariance
from distfilt.gaussians import (
    condition,
    intersect_gaussians,
    intersection,
    intersection_weights,
)
from distfilt.gaussians.single import joseph, log_density, unscented_points
from tests.support import NAN, generator, relative_difference, spd, without_checks

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
    # One covariance serves all centres.
    shared = log_density(x, centre, cov[0])
    assert np.allclose(shared[..., 0], logs[:, 0])


# --- intersection -----------------------------------------------------------------------------


def _intersect_by_inverses(
    m: np.ndarray, p: np.ndarray, w: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """P⁻¹ = Σ ω P_b⁻¹ and P⁻¹ m = Σ ω P_b⁻¹ m_b."""
    information = np.linalg.inv(p)
    total = (w[..., None, None] * information).sum(axis=-3)
    cov = np.linalg.inv(total)
    vectors = (information @ m[..., None])[..., 0]
    vector = (w[..., None] * vectors).sum(axis=-2)
    mean_ = cov @ vector[..., None]
    return mean_[..., 0], cov


@given(SEEDS, st.integers(1, 5), st.integers(1, 5))
def test_intersection_is_the_weighted_sum_of_information(
    seed: int, s: int, d: int
) -> None:
    rng = generator(seed)
    m = rng.standard_normal((6, s, d))
    p = spd(rng, d, (6, s))
    w = rng.dirichlet(np.ones(s), 6)
    means, covs = intersect_gaussians(m, p, w)
    # Rounding grows with the condition of the worst covariance.
    exact_means, exact_covs = _intersect_by_inverses(m, p, w)
    worst = 1e-13 * np.linalg.cond(p).max()
    assert np.abs(means - exact_means).max() < 10 * worst
    assert relative_difference(covs, exact_covs) < worst
    assert (covs == covs.swapaxes(-1, -2)).all()
    # A batch is the same as its members.
    single_mean, single_cov = intersect_gaussians(m[2], p[2], w[2])
    assert np.allclose(single_mean, means[2], atol=worst)
    assert np.allclose(single_cov, covs[2])
    # Leading axes broadcast; twice all covariances give the same mean.
    pair = np.stack([p[2], 2 * p[2]])
    pair_means, pair_covs = intersect_gaussians(m[2], pair, w[2])
    assert np.allclose(pair_means, single_mean, atol=worst)
    assert np.allclose(pair_covs[1], 2 * single_cov)


def test_intersection_of_the_same_or_one_source_changes_nothing() -> None:
    rng = generator(1)
    m = 1e6 + rng.standard_normal(3)
    p = spd(rng, 3)
    mean_, cov = intersect_gaussians([m] * 4, [p] * 4, [0.1, 0.2, 0.3, 0.4])
    # Σ ω P⁻¹ = P⁻¹ for weights that sum to one
    assert np.allclose(mean_, m, rtol=1e-15, atol=0)
    assert relative_difference(cov, p) < 1e-14
    # A single weight of one, on the first source and on the second
    mean_, cov = intersect_gaussians([m, 0 * m], [p, np.eye(3)], [1.0, 0.0])
    assert (mean_ == m).all()
    assert relative_difference(cov, p) < 1e-14
    mean_, cov = intersect_gaussians([0 * m, m], [np.eye(3), p], [0.0, 1.0])
    assert np.allclose(mean_, m, rtol=1e-14)
    assert relative_difference(cov, p) < 1e-13


def test_intersection_does_not_depend_on_units_or_order() -> None:
    rng = generator(2)
    m = rng.standard_normal((3, 4))
    p = spd(rng, 4, (3,))
    w = np.array([0.2, 0.5, 0.3])
    # Weights and result belong to the sources, in any units.
    size = np.array([1e-9, 1.0, 1e9, 1e3])
    squares = np.outer(size, size)
    mean_, cov = intersect_gaussians(m, p, w)
    scaled_mean, scaled_cov = intersect_gaussians(m * size, p * squares, w)
    assert np.allclose(scaled_mean, mean_ * size, rtol=1e-11)
    assert relative_difference(scaled_cov, cov * squares) < 1e-12
    reverse_mean, reverse_cov = intersect_gaussians(m[::-1], p[::-1], w[::-1])
    assert np.allclose(reverse_mean, mean_)
    assert relative_difference(reverse_cov, cov) < 1e-12


def test_extreme_precision_does_not_spoil_the_rest() -> None:
    rng = generator(4)
    sharp = 1e-20 * spd(rng, 3)
    wide = spd(rng, 3)
    for order in (slice(None), slice(None, None, -1)):
        m = np.stack([np.ones(3), np.zeros(3)])[order]
        p = np.stack([sharp, wide])[order]
        # The precise source decides: mean 1, covariance sharp / ω.
        mean_, cov = intersect_gaussians(m, p, [0.5, 0.5])
        assert np.allclose(mean_, 1.0)
        assert relative_difference(cov, 2 * sharp) < 1e-9
    # Components equal but for the last bit: along their sum both count, and rounding
    # hides the other directions.
    nearly_equal = (1 + np.eye(2) * 2.0**-52) / 16
    p = [np.eye(2), nearly_equal]
    _, cov = intersect_gaussians(np.zeros((2, 2)), p, [0.75, 0.25])
    # Along (1, 1)/√2 the variances are 1 and 2/16, and 1ᵀ P 1 is twice the fused one.
    information = 0.75 + 0.25 / 0.125
    assert np.isclose(cov.sum(), 2 / information)


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
        assert (w[~present] == 0).all()
        assert (w >= 0).all()
        assert np.allclose(w.sum(-1), 1.0, rtol=1e-14)
        # The only source of the first row has all the weight.
        assert w[0, 2] == 1.0
        fused_means, fused_covs = without_checks(intersect_gaussians)(means, covs, w)
        for i in range(4):
            # As if the absent sources were not in the list
            k = present[i]
            weights = intersection_weights(p[i][k], rule=rule)
            assert np.allclose(w[i][k], weights, atol=1e-6)
            mean_, cov = intersect_gaussians(m[i][k], p[i][k], w[i][k])
            assert np.allclose(fused_means[i], mean_, atol=1e-11)
            assert relative_difference(fused_covs[i], cov) < 1e-11


def test_closed_forms() -> None:
    first = np.diag([1.0, 4.0])
    second = np.diag([9.0, 1.0])
    p = np.stack([first, second, [[2.0, 1.0], [1.0, 2.0]]])
    assert np.allclose(intersection_weights(p), THIRDS, rtol=1e-15)
    # Inverse traces, and inverse d-th roots of the determinants.
    traces = np.array([1 / 5, 1 / 10, 1 / 4])
    w = intersection_weights(p, rule="trace")
    assert np.allclose(w, traces / traces.sum(), rtol=1e-14)
    roots = np.array([1 / 2, 1 / 3, 1 / np.sqrt(3)])
    w = intersection_weights(p, rule="determinant")
    assert np.allclose(w, roots / roots.sum(), rtol=1e-14)
    for rule in RULES:
        assert intersection_weights(p[:1], rule=rule).tolist() == [1.0]
    # Equal weights of the present sources
    present = np.array([True, False, True])
    w = intersection_weights(p, present=[present, ~present])
    assert w.tolist() == [[0.5, 0, 0.5], [0, 1, 0]]
    # The determinants 1e-800 and 1e800 are no floats, their logarithms are.
    huge = np.stack([1e-200 * np.eye(4), 1e200 * np.eye(4)])
    w = intersection_weights(huge, rule="determinant")
    assert np.allclose(w, [1.0, 0.0])


def _slopes(w: np.ndarray, p: np.ndarray, rule: str) -> np.ndarray:
    """The derivatives of the documentation, by inverses."""
    information = np.linalg.inv(p)
    total = (w[:, None, None] * information).sum(axis=0)
    cov = np.linalg.inv(total)
    # -∂ log|P| / ∂ω_b = Tr(P P_b⁻¹), -∂ Tr P / ∂ω_b = Tr(P P_b⁻¹ P)
    product = cov @ information
    if rule == "min_trace":
        product = product @ cov
    return np.trace(product, axis1=-2, axis2=-1)


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
    scales = np.exp(spread * rng.standard_normal((s, 1, 1)))
    p = spd(rng, d, (s,)) * scales
    w = intersection_weights(p, rule=rule)
    # g_b ≤ Σ ω g, with equality where ω_b > 0 (Karush, Kuhn and Tucker).
    slopes = _slopes(w, p, rule)
    average = float(w @ slopes)
    assert slopes.max() <= (1 + 2e-7) * average
    assert (w * (average - slopes) <= 2e-7 * average).all()
    # Σ ω_b Tr(P P_b⁻¹) = Tr(P P⁻¹) = d
    if rule == "min_determinant":
        assert average == pytest.approx(d, rel=1e-9)


def test_monotone_steps_alone_reach_the_optimum(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A Newton step that increases the objective is not accepted."""
    p = spd(generator(8), 3, (4, 3))
    exact = intersection_weights(p, rule="min_determinant")

    def step_astray(weights: np.ndarray, *_: object) -> np.ndarray:
        squares = np.roll(weights, 1, axis=-1) ** 2
        return squares / squares.sum(-1, keepdims=True)

    monkeypatch.setattr(intersection, "_newton_step", step_astray)
    monkeypatch.setattr(intersection, "_MAX_STEPS", 1500)
    for rule in ("min_determinant", "min_trace"):
        w = intersection_weights(p, rule=rule)
        assert np.allclose(w.sum(-1), 1.0)
        assert (w >= 0).all()
        for i in range(4):
            slopes = _slopes(w[i], p[i], rule)
            average = float(w[i] @ slopes)
            assert slopes.max() <= 1.001 * average
    w = intersection_weights(p, rule="min_determinant")
    assert np.allclose(w, exact, atol=0.02)


@pytest.mark.parametrize("rule", ["min_trace", "min_determinant"])
def test_a_monotone_step_never_increases_the_objective(rule: str) -> None:
    """tr M⁻¹ or det M⁻¹ of M = Σ ω_b P_b⁻¹, before and after; of scales that differ by e³."""
    rng = generator(4)
    scales = np.exp(3 * rng.standard_normal((2000, 3, 1, 1)))
    covs = spd(rng, 2, (2000, 3)) * scales
    weights = rng.dirichlet(np.ones(3), 2000)
    is_determinant = rule == "min_determinant"
    present = np.ones((2000, 3))
    problem = intersection._Problem.build(covs, present, is_determinant)
    _, slope, _ = problem.derivatives(weights)
    mean = (weights * slope).sum(axis=-1, keepdims=True)
    after = problem.monotone_step(weights, slope, mean)
    sizes = []
    for w in (weights, after):
        information = (w[..., None, None] * np.linalg.inv(covs)).sum(axis=1)
        fused = np.linalg.inv(information)
        trace = np.trace(fused, axis1=-2, axis2=-1)
        sizes.append(np.linalg.det(fused) if is_determinant else trace)
    assert (sizes[1] <= sizes[0] * (1 + 1e-9)).all()
    # Almost all of them decrease it.
    assert (sizes[1] < sizes[0]).mean() > 0.99


def test_optimal_weights_of_crossed_repeated_and_dominated_sources() -> None:
    first = np.diag([1.0, 4.0])
    second = np.diag([4.0, 1.0])
    dominated = [np.eye(2), 1.01 * np.eye(2), 9 * np.eye(2)]
    for rule in ("min_trace", "min_determinant"):
        # The smallest covariance takes all the weight.
        w = intersection_weights(dominated, rule=rule)
        assert w[0] > 1 - 1e-4
        # By symmetry one half each; two copies share theirs.
        w = intersection_weights([first, first, second], rule=rule)
        of_copies = w[:2].sum()
        assert np.allclose([of_copies, w[2]], 0.5, atol=1e-6)


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
    without_second = np.array([0.5, 0.0, 0.5])
    fuse = without_checks(intersect_gaussians)
    _, cov = fuse(np.zeros((3, 2)), p, without_second)
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
        assert (w >= 0).all()
        assert np.allclose(w.sum(-1), 1.0, rtol=1e-12)


# --- matched moments --------------------------------------------------------------------------


def _ensembles(seed: int, n: int, d: int, leading: tuple[int, ...] = ()) -> np.ndarray:
    rng = generator(seed)
    mixing = rng.standard_normal((*leading, d, d))
    shift = 10 * rng.standard_normal((*leading, 1, d))
    normal = rng.standard_normal((*leading, n, d))
    units = np.logspace(-3, 3, d)
    return (normal @ mixing + shift) * units


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
    # Members far from zero are rounded to 1e-16 of their distance.
    rounding = 1e-15 * (np.abs(centre) / std).max()
    mean_error = (mean(matched) - centre) / std
    assert np.abs(mean_error).max() < 1e-13 + 10 * rounding
    cov_error = relative_difference(sample_covariance(matched), cov)
    assert cov_error < 1e-13 + 100 * rounding


def test_moments_are_exact_if_both_covariances_are_ill_conditioned() -> None:
    """A product of inverses and roots once lost nine digits here."""
    rng = generator(31)
    for d in (3, 12):
        rotation, _ = np.linalg.qr(rng.standard_normal((d, d)))
        flat = np.diag(np.logspace(0, -7, d)) @ rotation
        e = rng.standard_normal((60, d)) @ flat
        target = spd(rng, d, least=1e-10)
        matched = match_moments(e, np.zeros(d), target)
        assert relative_difference(sample_covariance(matched), target) < 1e-13


def test_matching_moments_is_symmetric_and_so_optimal_transport() -> None:
    """A C A = P has one symmetric positive solution in units of the new standard deviations."""
    e = _ensembles(1, 40, 4)
    other = _ensembles(2, 40, 4)
    cov = sample_covariance(other)
    unit = np.sqrt(cov.diagonal())
    # The map A of the anomalies, from their least squares, is symmetric positive
    # definite.
    centre = mean(e)
    matched = match_moments(e, centre, cov)
    solution = np.linalg.lstsq(e - centre, matched - centre, rcond=None)
    a = solution[0].T
    a *= unit / unit[:, None]
    assert np.abs(a - a.T).max() < 1e-9 * np.abs(a).max()
    symmetric = 0.5 * (a + a.T)
    assert (np.linalg.eigvalsh(symmetric) > 0).all()


def test_leading_axes_of_a_target_broadcast_or_are_refused_by_name() -> None:
    e = _ensembles(4, 9, 2, (3,))
    cov = np.stack([np.eye(2)] * 3)
    centres = np.arange(6.0).reshape(3, 2)
    many = match_moments(e[0], centres, np.eye(2))
    assert many.shape == (3, 9, 2)
    assert np.allclose(mean(many), centres)
    with pytest.raises(ValueError, match="^mean must have leading axes that broadcast"):
        match_moments(e, np.zeros((4, 2)), cov)
    with pytest.raises(ValueError, match="^cov must have leading axes that broadcast"):
        match_moments(e, np.zeros(2), cov[:2])


def test_flat_ensembles_are_refused_wherever_they_lie() -> None:
    rng = generator(12)
    x = rng.standard_normal((20, 3))
    means = np.zeros((2, 3))
    covs = np.stack([np.eye(3)] * 2)
    # A component that is a sum, a constant one, and one of rounding
    combined = x @ [[1, 0, 1], [0, 1, 1], [0, 0, 0]]
    for flat in (combined, x * [1, 0, 1], 1e9 + x * [1, 1e-9, 1]):
        for shift in (0.0, 1e6):
            ensembles = np.stack([x, flat + shift])
            with pytest.raises(ValueError, match="^ensemble must .* singular"):
                match_moments(ensembles, means, covs)


# --- unscented points -------------------------------------------------------------------------


@pytest.mark.parametrize("kappa", [-1.0, 0.0, 0.5, 3.0])
@pytest.mark.parametrize("d", [2, 5])
def test_points_have_the_moments(d: int, kappa: float) -> None:
    rng = generator(d)
    mean = rng.standard_normal((4, d))
    cov = spd(rng, d, (4,))
    rotation, _ = np.linalg.qr(rng.standard_normal((d, d)))
    root = np.linalg.cholesky(cov) @ rotation
    points, w = unscented_points(mean, root, kappa=kappa)
    assert points.shape == (4, 2 * d + 1, d)
    assert np.isclose(w.sum(), 1)
    # Σ w x = m and Σ w (x - m)(x - m)ᵀ = P, for any square root.
    assert np.allclose(w @ points, mean)
    deviation = points - mean[:, None]
    second_moment = (deviation * w[:, None]).mT @ deviation
    assert np.allclose(second_moment, cov)
    # The mean itself comes first, the other points lie symmetrically around it.
    assert np.allclose(points[:, 0], mean)
    assert np.allclose(points[:, 1:].mean(axis=1), mean)


def test_fourth_moments_along_an_axis_are_a_gaussians() -> None:
    points, w = unscented_points(np.zeros(4), np.eye(4), kappa=-1.0)
    # E z⁴ = 3 and E z³ = 0 with κ = 3 - d.
    assert np.allclose(w @ points**4, 3.0)
    assert np.allclose(w @ points**3, 0.0)


# --- conditioning -----------------------------------------------------------------------------

D = 4
M = 3


def case(seed: int, lead: tuple[int, ...] = ()) -> tuple[np.ndarray, ...]:
    """Return mean, covariance, innovation, observation matrix and noise covariance."""
    rng = np.random.default_rng(seed)
    mean = rng.standard_normal((*lead, D))
    innovation = rng.standard_normal((*lead, M))
    cov = spd(rng, D, lead)
    h = rng.standard_normal((*lead, M, D))
    r = spd(rng, M, lead)
    return mean, cov, innovation, h, r


@given(seed=st.integers(0, 10**6))
def test_in_information_form_an_update_is_a_sum(seed: int) -> None:
    mean, cov, innovation, h, r = case(seed)
    x, p = condition(mean, cov, innovation, h, r)
    # P⁺⁻¹ = P⁻¹ + Hᵀ R⁻¹ H and m⁺ = m + P⁺ Hᵀ R⁻¹ d
    weight = h.T @ np.linalg.inv(r)
    information = np.linalg.inv(cov) + weight @ h
    exact = np.linalg.inv(information)
    np.testing.assert_allclose(p, exact, rtol=1e-8, atol=1e-9)
    expected = mean + exact @ weight @ innovation
    np.testing.assert_allclose(x, expected, rtol=1e-8, atol=1e-8)
    assert (p == p.T).all()


def test_a_missing_component_is_a_row_left_out() -> None:
    mean, cov, complete, h, r = case(1)
    for lost, remaining in ((1, [0, 2]), (0, [1, 2])):
        innovation = np.where(np.arange(M) == lost, np.nan, complete)
        # In a batch of two noises, of which the first is r
        means, covs = condition(mean, cov, innovation, h, np.stack([r, 2 * r]))
        block = r[np.ix_(remaining, remaining)]
        x, p = condition(mean, cov, innovation[remaining], h[remaining], block)
        np.testing.assert_allclose(means[0], x, rtol=0, atol=1e-13)
        np.testing.assert_allclose(covs[0], p, rtol=0, atol=1e-13)
    # Without any observation the prior stays, to the bit.
    x, p = condition(mean, cov, np.full(M, np.nan), h, r)
    assert (x == mean).all()
    assert (p == cov).all()


def test_a_batch_is_its_members_one_by_one() -> None:
    mean, cov, innovation, h, r = case(2, (5, 2))
    uniform = np.random.default_rng(3).random(innovation.shape)
    innovation[uniform < 0.3] = np.nan
    x, p = condition(mean, cov, innovation, h, r)
    for k in np.ndindex(5, 2):
        single = condition(mean[k], cov[k], innovation[k], h[k], r[k])
        np.testing.assert_allclose(x[k], single[0], rtol=0, atol=1e-13)
        np.testing.assert_allclose(p[k], single[1], rtol=0, atol=1e-13)


def test_one_covariance_and_one_sensor_serve_any_number_of_means() -> None:
    mean, innovation = np.random.default_rng(4).standard_normal((2, 6, D))
    _, cov, _, h, r = case(5)
    x, p = condition(mean, cov, innovation[:, :M], h, r)
    assert x.shape == (6, D)
    # P⁺ does not depend on the means: one is computed for all.
    assert p.shape == (D, D)
    covs = np.broadcast_to(cov, (6, D, D))
    full_x, full_p = condition(mean, covs, innovation[:, :M], h, r)
    np.testing.assert_allclose(x, full_x, rtol=0, atol=1e-13)
    shared = np.broadcast_to(p, full_p.shape)
    np.testing.assert_allclose(shared, full_p, rtol=0, atol=1e-13)


def test_joseph_s_form_is_accurate_for_a_nearly_exact_observation() -> None:
    """The posterior variance of an observed component is R, sixteen digits below P."""
    mean, cov, innovation, _, _ = case(7)
    h = np.eye(D)[:M]
    r = 1e-8 * np.eye(M)
    # P - K S Kᵀ would subtract numbers of 1e8 to leave 1e-8.
    _, p = condition(mean, 1e8 * cov, innovation, h, r)
    np.testing.assert_allclose(p[:M, :M], r, rtol=1e-6, atol=1e-13)


@pytest.mark.parametrize("d", [5, 40])
def test_joseph_s_form_is_its_product_with_any_gain(d: int) -> None:
    """Small and large states, whose products are ordered differently; also far from the optimum."""
    rng = np.random.default_rng(d)
    units = np.geomspace(1e-3, 1e3, d)
    root = rng.standard_normal((3, d, d)) * units[:, None]
    cov = root @ root.mT
    slope = rng.standard_normal((2, d))
    noise = np.diag([0.5, 2.0])
    innovation_cov = slope @ cov @ slope.T + noise
    optimal = np.linalg.solve(innovation_cov, slope @ cov).mT
    for gain in (optimal, 0.3 * optimal):
        # (I - K H) P (I - K H)ᵀ + K R Kᵀ
        factor = np.eye(d) - gain @ slope
        expected = factor @ cov @ factor.mT + gain @ noise @ gain.mT
        result = joseph(cov, gain, slope, noise)
        std = np.sqrt(np.diagonal(cov, axis1=-2, axis2=-1))
        scale = std[..., :, None] * std[..., None, :]
        relative_error = np.abs(result - expected) / scale
        assert relative_error.max() < 1e-11
        np.testing.assert_array_equal(result, result.mT)


@pytest.mark.parametrize("rule", ["min_trace", "min_determinant"])
def test_a_pair_s_weight_is_that_of_a_search_over_matrices(rule: str) -> None:
    """Random pairs, some with the optimum at an end; a third source that is absent is no source."""
    rng = np.random.default_rng(5)
    normal = rng.standard_normal((20, 2, 3, 3))
    lengths = rng.uniform(0.2, 5.0, (20, 2, 3, 1))
    roots = normal * lengths
    covs = roots @ roots.mT
    covs[:4, 1] = 1.5 * covs[:4, 0]
    covs[4] = covs[4, 0]
    weights = intersection_weights(covs, rule=rule)
    absent = np.full((20, 1, 3, 3), np.nan)
    third = np.concatenate([covs[:, :1], absent, covs[:, 1:]], axis=1)
    present = np.array([True, False, True])
    with_absent = intersection_weights(third, rule=rule, present=present)
    np.testing.assert_array_equal(with_absent[:, ::2], weights)
    np.testing.assert_array_equal(with_absent[:, 1], 0.0)
    # Of P and 1.5 P the smaller one has all the weight; two equal ones share it.
    np.testing.assert_array_equal(weights[:4], [[1.0, 0.0]] * 4)
    np.testing.assert_array_equal(weights[4], [0.5, 0.5])
    # Each result is as small as the best on a fine grid.
    grid = np.linspace(0.0, 1.0, 2001)
    for pair, weight in zip(np.linalg.inv(covs), weights, strict=True):
        # P(ω) = ((1 - ω) P₁⁻¹ + ω P₂⁻¹)⁻¹ for all ω of the grid, and for the result at last
        omega = np.append(grid, weight[1])[:, None, None]
        information = (1 - omega) * pair[0] + omega * pair[1]
        fused = np.linalg.inv(information)
        sizes = np.linalg.slogdet(fused)[1]
        if rule == "min_trace":
            traces = np.trace(fused, axis1=-2, axis2=-1)
            sizes = np.log(traces)
        least = sizes[:-1].min()
        assert sizes[-1] <= least + 1e-7
