"""Partial-state fusion: identities, information form, definiteness, weights, a channel."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from distfilt.mixtures import (
    ComponentShapes,
    GaussianMixture,
    PartialFusion,
    average_mixtures,
    fuse_mixtures,
    fuse_moments,
    fuse_sequentially,
    nonnegative_least_squares,
    target_fusion,
    tikhonov,
)
from distfilt.network import Channel, Graph, graphs
from distfilt.network.channel import kind_of_rule

from .examples import (
    TARGET,
    assert_same,
    random_frame,
    random_mixture,
    shuffle,
    transform,
)

PRIOR = random_mixture(3, 4, 1)
OTHER = random_mixture(2, 2, 2)
EVERY_RULE = pytest.mark.parametrize("rule", ["C1", "C2", "C3", "points"])


@EVERY_RULE
def test_a_single_component_has_all_the_weight(rule: str) -> None:
    """The fusion of Gaussians is one, whatever the rule of the weights."""
    exact = PartialFusion(random_mixture(1, 4, 5), random_mixture(1, 2, 6))
    shapes = exact.component_shapes()
    fused = exact.assign_weights(shapes, rule=rule)
    assert fused.weights.tolist() == [1.0]
    np.testing.assert_array_equal(fused.means, shapes.means)
    np.testing.assert_array_equal(fused.covs, shapes.covs)
    # The exact density is the Gaussian's, up to its constant.
    points = fused.means + np.random.default_rng(7).standard_normal((5, 4))
    difference = exact.log_value(points) - fused.log_density(points)
    assert np.ptp(difference) < 1e-9


def fuse_by_information(
    prior: GaussianMixture,
    q: int,
    p: int,
    others: list[tuple[GaussianMixture, int]],
    w: list[float],
) -> tuple[np.ndarray, np.ndarray]:
    """One fused component by information matrices, (22)-(27).

    Component q of the prior, divided by its component p, times one of each other mixture.
    """
    inv = np.linalg.inv
    n = others[0][0].dim
    # Y = P_q⁻¹ + (ω_0 - 1) P_p⁻¹ + Σ ω_b P_b⁻¹ on the target block, and Y m alike.
    info = inv(prior.covs[q])
    vector = info @ prior.means[q]
    marginal_mean = prior.means[p, :n]
    marginal_cov = prior.covs[p, :n, :n]
    divisor = (w[0] - 1, marginal_mean, marginal_cov)
    factors = [divisor]
    for a, (other, r) in zip(w[1:], others, strict=True):
        factors.append((a, other.means[r], other.covs[r]))
    for a, mean, cov in factors:
        factor_info = a * inv(cov)
        info[:n, :n] += factor_info
        vector[:n] += factor_info @ mean
    fused_cov = inv(info)
    return fused_cov @ vector, fused_cov


@given(st.integers(0, 200), st.floats(0.05, 0.95), st.integers(1, 4), st.integers(0, 3))
def test_gaussians_are_fused_exactly(seed: int, omega: float, n: int, e: int) -> None:
    prior = random_mixture(1, n + e, seed)
    other = random_mixture(1, n, seed + 1)
    mean, cov = fuse_by_information(prior, 0, 0, [(other, 0)], [omega, 1 - omega])
    # With one component each both methods have nothing to approximate.
    for fused in (
        fuse_mixtures(prior, other, omega=omega),
        fuse_moments(prior, other, omega=omega),
    ):
        assert np.allclose(fused.means[0], mean, rtol=1e-8, atol=1e-8)
        assert np.allclose(fused.covs[0], cov, rtol=1e-8, atol=1e-8)


def test_matched_terms_are_always_definite_and_others_may_not_be() -> None:
    dropped = 0
    for seed in range(40):
        prior = random_mixture(3, 4, seed, 1.0)
        other = random_mixture(3, 2, 500 + seed, 1.0)
        f = PartialFusion(prior, other)
        matched = f.component_shapes()
        every = f.component_shapes(terms="all")
        # With p = q the divisor (1 - ω_0) P_q⁻¹ leaves a definite rest; p ≠ q may not.
        assert matched.dropped == 0
        assert matched.n_components == 9
        assert every.n_components + every.dropped == 27
        for shapes in (matched, every):
            assert np.linalg.eigvalsh(shapes.covs).min() > 0
        dropped += every.dropped
    assert dropped > 0


def test_the_target_marginal_of_the_exact_density_by_quadrature() -> None:
    prior = random_mixture(2, 3, 5, 1.0)
    other = random_mixture(2, 2, 6, 1.0)
    f = PartialFusion(prior, other)
    e = np.linspace(-40, 40, 8001)
    for t in ([0.0, 0.5], [1.0, -1.0]):
        x = np.column_stack([np.broadcast_to(t, (e.size, 2)), e])
        # ∫ p(t, e) de
        mass = np.trapezoid(np.exp(f.log_value(x)), e)
        log_target = f.log_target(np.array(t))
        assert np.isclose(np.log(mass), log_target, atol=1e-9)


def test_omega_at_its_ends() -> None:
    # With ω = 1 all received beliefs have the exponent zero.
    assert fuse_mixtures(PRIOR, OTHER, omega=1.0) is PRIOR
    other = random_mixture(1, 2, 8)
    # With ω = 0 the target marginal is the other belief.
    fused = fuse_mixtures(random_mixture(1, 4, 4), other, omega=0.0)
    assert_same(fused.marginal(TARGET), other)
    logs = PartialFusion(PRIOR, OTHER, omega=1.0).log_value(np.zeros((1, 4)))
    assert np.isfinite(logs).all()


def test_exponents_are_equal_by_default() -> None:
    others = [OTHER, random_mixture(2, 2, 3), random_mixture(1, 2, 4)]
    assert PartialFusion(PRIOR, others).exponents.tolist() == [0.25] * 4
    # The received beliefs share the remainder 1 - ω equally.
    exponents = PartialFusion(PRIOR, others, omega=0.4).exponents
    assert np.allclose(exponents, [0.4, 0.2, 0.2, 0.2])
    fused = fuse_moments(PRIOR, others, omega=[0.25] * 4)
    assert_same(fuse_moments(PRIOR, others), fused)
    with pytest.raises(ValueError, match="^omega must be 4 exponents, got 2"):
        PartialFusion(PRIOR, others, omega=[0.5, 0.5])
    with pytest.raises(ValueError, match="^received must have target beliefs"):
        PartialFusion(OTHER, PRIOR)


def test_many_agents_in_one_pass_and_one_after_the_other() -> None:
    prior = random_mixture(1, 5, 30)
    others = [random_mixture(1, 2, 31 + k) for k in range(3)]
    # Gaussians are fused exactly, so that the order does not matter with equal
    # exponents.
    expected = fuse_mixtures(prior, others)
    for order in (others, others[::-1]):
        assert_same(fuse_sequentially(prior, order), expected)
    halves = fuse_sequentially(prior, others, omega=0.5, pair=fuse_moments)
    # Each fusion halves the exponents of all beliefs that came before.
    omega = [1 / 8, 1 / 8, 1 / 4, 1 / 2]
    assert_same(halves, fuse_mixtures(prior, others, omega=omega))
    # With halves the order matters.
    reverse = fuse_sequentially(prior, others[::-1], omega=0.5)
    assert not np.allclose(halves.means, reverse.means)


@pytest.mark.parametrize("terms", ["matched", "all"])
def test_three_mixtures_by_information(terms: str) -> None:
    third = random_mixture(3, 2, 9)
    f = PartialFusion(PRIOR, [OTHER, third], omega=[0.5, 0.2, 0.3])
    x = np.random.default_rng(0).standard_normal((5, 4))
    # log p(x) + (ω - 1) log p(t) + Σ ω_b log p_b(t)
    t = x[:, :2]
    target_log = PRIOR.marginal(TARGET).log_density(t)
    expected = PRIOR.log_density(x) - 0.5 * target_log
    expected += 0.2 * OTHER.log_density(t)
    expected += 0.3 * third.log_density(t)
    assert np.allclose(f.log_value(x), expected, rtol=1e-12)
    shapes = f.component_shapes(terms=terms)
    source = []
    means = []
    covs = []
    for q, p, r, s in np.ndindex(3, 3, 2, 3):
        others = [(OTHER, r), (third, s)]
        mean, cov = fuse_by_information(PRIOR, q, p, others, [0.5, 0.2, 0.3])
        is_definite = np.linalg.eigvalsh(cov)[0] > 0
        if (terms == "all" or p == q) and is_definite:
            source.append(q)
            means.append(mean)
            covs.append(cov)
    # A term is a choice of q, r and s, and of the divisor p unless p = q.
    n_terms = 3 * 2 * 3 * (3 if terms == "all" else 1)
    assert shapes.n_components + shapes.dropped == n_terms
    assert np.array_equal(shapes.source, source)
    assert np.allclose(shapes.means, means, rtol=1e-9, atol=1e-9)
    assert np.allclose(shapes.covs, covs, rtol=1e-9, atol=1e-9)


@EVERY_RULE
@pytest.mark.parametrize("terms", ["matched", "all"])
def test_fusion_in_other_coordinates_and_in_another_order(
    rule: str, terms: str
) -> None:
    others = [random_mixture(1, 2, 51), random_mixture(2, 2, 52)]
    fused = fuse_mixtures(PRIOR, others, rule=rule, terms=terms)
    reverse = fuse_mixtures(PRIOR, others[::-1], rule=rule, terms=terms)
    assert_same(reverse, fused, 1e-6)
    shuffled_others = [shuffle(m) for m in others]
    shuffled = fuse_mixtures(shuffle(PRIOR), shuffled_others, rule=rule, terms=terms)
    assert_same(shuffled, fused, 1e-6)
    # Sigma points depend on the square root, which other coordinates rotate unless they
    # only scale.
    matrix, shift = random_frame(4, target_dim=2)
    if rule == "points":
        matrix = np.diag(np.geomspace(1e-3, 1e5, 4))
    prior = transform(PRIOR, matrix, shift)
    target_matrix = matrix[:2, :2]
    received = [transform(m, target_matrix, shift[:2]) for m in others]
    transformed = fuse_mixtures(prior, received, rule=rule, terms=terms)
    inverse = np.linalg.inv(matrix)
    assert_same(transform(transformed, inverse, -inverse @ shift), fused, 1e-5)


@EVERY_RULE
def test_weights_are_the_printed_formulas(rule: str) -> None:
    """C1 and C2 at the means; least squares meet the density at means or sigma points."""
    f = PartialFusion(PRIOR, OTHER, omega=0.6)
    shapes = f.component_shapes()
    if rule in ("C1", "C2"):
        coefficients = density_coefficients(f, shapes, rule)
    else:
        coefficients = collocation_coefficients(f, shapes, rule)
    # The weight of a term is its coefficient times the integral of exp(-½ xᵀ P⁻¹ x).
    determinants = np.linalg.det(2 * np.pi * shapes.covs)
    w = coefficients * np.sqrt(determinants)
    weights = f.assign_weights(shapes, rule=rule).weights
    # Terms of negative or zero weight are left out.
    assert np.allclose(weights, w[w > 0] / w.sum(), rtol=1e-6)


def density_coefficients(
    f: PartialFusion, shapes: ComponentShapes, rule: str
) -> np.ndarray:
    """Density at the means: of the source component alone for C1, of the mixture for C2."""
    means = shapes.means
    densities = np.exp(PRIOR.component_log_densities(means))
    parts = densities * PRIOR.weights
    if rule == "C1":
        density = parts[np.arange(len(means)), shapes.source]
    else:
        density = parts.sum(axis=1)
    # log of the factor by which fusion multiplies the prior
    update = f.log_value(means) - PRIOR.log_density(means)
    return density * np.exp(update)


def collocation_coefficients(
    f: PartialFusion, shapes: ComponentShapes, rule: str
) -> np.ndarray:
    """Least squares at the means for C3, at the sigma points with row weights for "points"."""
    points = shapes.means
    if rule == "points":
        # m ± √d L e_i with √d = 2
        root = 2 * np.linalg.cholesky(shapes.covs).mT
        offsets = np.concatenate([0 * root[:, :1], root, -root], axis=1)
        points = (shapes.means[:, None] + offsets).reshape(-1, 4)
    logs = f.log_value(points)
    p = np.exp(logs - logs.max())
    differences = points[:, None] - shapes.means
    columns = differences[..., None]
    white = np.linalg.solve(shapes.covs, columns)[..., 0]
    # Column l is the term exp(-½ (x - m_l)ᵀ P_l⁻¹ (x - m_l)) at all points x.
    squares = (differences * white).sum(axis=-1)
    matrix = np.exp(-0.5 * squares)
    scale = np.ones(p.size)
    if rule != "C3":
        scale = 1 / np.sqrt(p + 1e-3)
    return nonnegative_least_squares(matrix * scale[:, None], p * scale)


@pytest.mark.parametrize("condition", [15.0, 1.5])
def test_condition_of_least_squares(
    condition: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    uniform = np.random.default_rng(0).uniform(size=(9, 4))
    # Columns that are nearly equal
    a = uniform @ np.diag([1.0, 1.0, 1.0, 1e-6]) + 1.0
    s = np.linalg.svd(a, compute_uv=False)
    alpha = tikhonov(s[0], s[-1], condition=condition)
    # The singular values of the padded matrix are √(s² + α²), of the required ratio.
    largest = np.hypot(s[0], alpha)
    smallest = np.hypot(s[-1], alpha)
    assert np.isclose(largest / smallest, condition, rtol=1e-9)
    padded = np.concatenate([a, alpha * np.eye(4)])
    # min |A w - b|² + α² |w|² is least squares with α I below A.
    exact = a @ [1.0, 2.0, 0.5, 1.0]
    b = np.r_[exact, np.zeros(4)]
    w = nonnegative_least_squares(a, b[:9], condition=condition)
    slope = padded.T @ (padded @ w - b)
    # The conditions of Karush, Kuhn and Tucker.
    assert np.abs(slope[w > 0]).max() < 1e-9
    assert (slope[w == 0] > -1e-9).all()
    # Of the many solutions of fewer equations than unknowns the shortest.
    shortest = nonnegative_least_squares([[1.0, 2.0]], [5.0])
    assert np.allclose(shortest, [1.0, 2.0])
    # A solver that stops short on either side is noticed, and another one is used.
    for factor in (0.99, 1.01):
        result = (factor * w, 0.0)
        monkeypatch.setattr("scipy.optimize.nnls", lambda *_, maxiter, r=result: r)
        solution = nonnegative_least_squares(a, b[:9], condition=condition)
        assert np.allclose(solution, w, rtol=1e-6)


def test_least_squares_have_a_limit() -> None:
    """Beyond it the components with the largest weights by C2 take part."""
    prior = random_mixture(5, 3, 1, 1.0)
    other = random_mixture(5, 2, 2, 1.0)
    f = PartialFusion(prior, other)
    shapes = f.component_shapes()
    c2 = f.assign_weights(f.component_shapes(), rule="C2")
    few = f.assign_weights(shapes, at_most=6).means
    heaviest = np.argsort(-c2.weights)[:6]
    best = {tuple(m) for m in c2.means[heaviest]}
    assert {tuple(m) for m in few} <= best


@EVERY_RULE
@pytest.mark.parametrize("terms", ["matched", "all"])
def test_components_far_apart_leave_no_nan(rule: str, terms: str) -> None:
    prior_means = [[0.0, 0.0], [1e3, 0.0]]
    prior = GaussianMixture([0.5, 0.5], prior_means, [np.eye(2), np.eye(2)])
    other = GaussianMixture([0.5, 0.5], [[0.0], [-1e3]], [[[1.0]], [[0.5]]])
    fused = fuse_mixtures(prior, other, rule=rule, terms=terms)
    # Densities of the distant pairs underflow: only their logarithms are finite.
    assert np.isfinite(fused.weights).all()
    assert np.isclose(fused.weights.sum(), 1)
    assert np.isfinite(fused.log_density([0.0, 0.0]))
    # The components at zero agree and get the weight.
    is_near_zero = np.abs(fused.means[:, 0]) < 1
    assert fused.weights[is_near_zero].sum() > 0.99


def test_average_keeps_the_conditional_and_averages_the_target() -> None:
    prior = random_mixture(1, 4, 40)
    other = random_mixture(3, 2, 41)
    mixed = average_mixtures(prior, other, omega=0.3)
    x = 2 * np.random.default_rng(0).standard_normal((20, 4))
    t = x[:, :2]
    # log(ω p(t) + (1 - ω) p_b(t))
    prior_target = prior.marginal(TARGET).log_density(t)
    first = np.log(0.3) + prior_target
    second = np.log(0.7) + other.log_density(t)
    target = mixed.marginal(TARGET).log_density(t)
    assert np.allclose(target, np.logaddexp(first, second), rtol=1e-10)
    # p(e | t) is the prior's.
    given_t = prior.log_density(x) - prior_target
    mixed_given_t = mixed.log_density(x) - target
    assert np.allclose(mixed_given_t, given_t, rtol=1e-9)
    several = random_mixture(3, 4, 42)
    mixed = average_mixtures(several, other)
    # A received component is shared by the prior's in proportion to their densities at
    # its mean.
    logs = several.marginal(TARGET).component_log_densities(other.means)
    shares = several.weights * np.exp(logs)
    scale = other.weights / shares.sum(axis=1)
    shares *= 0.5 * scale[:, None]
    weights = np.concatenate([0.5 * several.weights, shares.ravel()])
    assert np.allclose(mixed.weights, weights)
    # t ~ N(m_b, P_b) and e = m_e + G (t - m_t) + noise, for each pair of b and a component
    pairs = zip(mixed.means[3:], mixed.covs[3:], strict=True)
    for b, k in np.ndindex(3, 3):
        mean, cov = next(pairs)
        p = several.covs[k]
        # G = P_et P_tt⁻¹, and the noise has the covariance P_ee - G P_te.
        gain = p[2:, :2] @ np.linalg.inv(p[:2, :2])
        residual_cov = p[2:, 2:] - gain @ p[:2, 2:]
        shift = other.means[b] - several.means[k, :2]
        ego_mean = several.means[k, 2:] + gain @ shift
        assert np.allclose(mean[:2], other.means[b])
        assert np.allclose(mean[2:], ego_mean)
        cross_cov = gain @ other.covs[b]
        ego_cov = residual_cov + cross_cov @ gain.T
        assert np.allclose(cov[2:, 2:], ego_cov)
        assert np.allclose(cov[2:, :2], cross_cov)
    matrix, shift = random_frame(4, target_dim=2)
    received = transform(other, matrix[:2, :2], shift[:2])
    transformed = average_mixtures(transform(several, matrix, shift), received)
    assert_same(transformed, transform(mixed, matrix, shift), 1e-7)


# ------------------------------------------------------------------------ over a channel

BELIEFS = [random_mixture(2, 3 + k, 80 + k) for k in range(3)]


def test_agents_fuse_the_marginals_that_they_receive() -> None:
    channel = Channel(graphs.path(3))
    fused = target_fusion(BELIEFS, channel, target_dim=2)
    marginals = [m.marginal(TARGET) for m in BELIEFS]
    received = marginals[1], [marginals[0], marginals[2]], marginals[1]
    for belief, others, result in zip(BELIEFS, received, fused, strict=True):
        expected = fuse_mixtures(belief, others)
        assert np.array_equal(result.means, expected.means)
        assert np.array_equal(result.weights, expected.weights)
    # A component is a weight, two means and three entries of a covariance; 1 has two
    # receivers.
    assert channel.ledger.scalars.tolist() == [12, 24, 12]


def test_the_fusion_of_beliefs_is_an_option() -> None:
    fuse = partial(fuse_sequentially, pair=fuse_moments)
    rule = partial(target_fusion, target_dim=2, fuse=fuse)
    assert kind_of_rule(rule) == "mixtures"
    fused = rule(BELIEFS, Channel(graphs.complete(3)))
    # With equal exponents the order does not matter: all have the same Gaussian target.
    expected = fused[0].marginal(TARGET)
    for m in fused[1:]:
        target = m.marginal(TARGET)
        assert np.allclose(target.means[0], expected.means[0])
        assert np.allclose(target.covs[0], expected.covs[0])


def test_an_agent_that_receives_nothing_keeps_its_belief() -> None:
    channel = Channel(Graph.from_adjacency(np.zeros((3, 3))))
    fused = target_fusion(BELIEFS, channel, target_dim=2)
    assert all(a is b for a, b in zip(fused, BELIEFS, strict=True))


def test_a_collapse_names_the_agent_the_component_and_the_cause() -> None:
    def naive(
        prior: GaussianMixture, received: list[GaussianMixture]
    ) -> GaussianMixture:
        # λ_min - 2 λ_min < 0: the second covariance becomes indefinite.
        covs = prior.covs.copy()
        least = np.linalg.eigvalsh(covs[1])[0]
        covs[1] -= 2 * least * np.eye(prior.dim)
        return GaussianMixture.construct(prior.weights, prior.means, covs)

    with pytest.raises(
        np.linalg.LinAlgError, match="^agent 0: component 1 of 2 .*independent"
    ):
        target_fusion(BELIEFS, Channel(graphs.path(3)), target_dim=2, fuse=naive)


def test_agents_that_are_fused_together_are_each_fused_alone() -> None:
    """Bit by bit, for states and messages of several sizes, and an agent that receives nothing."""
    links = [(1, 0), (2, 0), (0, 1), (2, 1), (1, 2), (4, 3)]
    graph = Graph.from_edges(6, links, directed=True)
    sizes = [(1, 4), (1, 4), (3, 4), (2, 3), (2, 3), (1, 5)]
    beliefs = [random_mixture(n, dim, k) for k, (n, dim) in enumerate(sizes)]

    def fuse_alone(prior: GaussianMixture, others: object) -> GaussianMixture:
        return fuse_mixtures(prior, others)

    together = target_fusion(beliefs, Channel(graph), target_dim=2)
    alone = target_fusion(beliefs, Channel(graph), target_dim=2, fuse=fuse_alone)
    for one, other in zip(together, alone, strict=True):
        np.testing.assert_array_equal(one.weights, other.weights)
        np.testing.assert_array_equal(one.means, other.means)
        np.testing.assert_array_equal(one.covs, other.covs)
