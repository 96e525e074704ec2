"""Pairwise fusion of Gaussians: the inequalities that the papers prove, and the network's order."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
import pytest

from distfilt import gaussians as pure
from distfilt import network
from distfilt.network import Channel, Faults, Graph, graphs
from distfilt.sensors import wrap
from tests.network.helpers import DISK, STAR, arrivals, gaussians, rng, star

Array = np.ndarray
OMEGAS = (0.02, 0.3, 0.5, 0.9)
each_omega = pytest.mark.parametrize("omega", OMEGAS)
N = 200
"""Random cases of a property."""


def covariances(seed: int, d: int = 3, count: int = N) -> Array:
    return gaussians(seed, count, d=d)[1]


def inverse(p: Array) -> Array:
    return np.linalg.inv(p)


def is_below(small: Array, large: Array, tolerance: float = 1e-7) -> bool:
    """Whether large - small is positive semidefinite, relative to the larger one."""
    # L⁻¹ S L⁻ᵀ has no eigenvalue above 1.
    lower = np.linalg.cholesky(large)
    half = np.linalg.solve(lower, small)
    white = np.linalg.solve(lower, half.mT)
    eigenvalues = np.linalg.eigvalsh(0.5 * (white + white.mT))
    return bool((eigenvalues < 1 + tolerance).all())


def gains(rule: Any, p_a: Array, p_b: Array) -> tuple[Array, Array, Array]:
    """Return the factors of both means in the fused mean, and the covariance.

    The fused mean is linear in the means, so that unit vectors give the columns.
    """
    d = p_a.shape[-1]
    zero = np.zeros(d)
    # Column k is the response to a unit of the second mean along axis k.
    columns = [rule(zero, p_a, axis, p_b)[0] for axis in np.eye(d)]
    gain_b = np.stack(columns, axis=-1)
    _, cov = rule(zero, p_a, zero, p_b)
    return np.eye(d) - gain_b, gain_b, cov


def covariance_of_sum(
    k: Array, g: Array, p_a: Array, p_b: Array, cross: Array
) -> Array:
    """Return the covariance of K e_a + G e_b, with the cross-covariance C = E[e_a e_bᵀ]."""
    # K P_a Kᵀ + G P_b Gᵀ + K C Gᵀ + G Cᵀ Kᵀ
    mixed = k @ cross @ g.mT
    return k @ p_a @ k.mT + g @ p_b @ g.mT + mixed + mixed.mT


def error_covariance(rule: Any, p_a: Array, p_b: Array, cross: Array) -> Array:
    """Return the covariance of the fused error, for a cross-covariance E[e_a e_bᵀ]."""
    k, g, _ = gains(rule, p_a, p_b)
    return covariance_of_sum(k, g, p_a, p_b, cross)


# Inverse covariance intersection.


@each_omega
def test_inverse_intersection_by_its_equation(omega: float) -> None:
    p_a = covariances(1)
    p_b = covariances(2)
    mean_a, mean_b = gaussians(3, 2, N, d=3)[0]
    mean, cov = pure.intersect_inverses(mean_a, p_a, mean_b, p_b, omega=omega)
    # P⁻¹ = P_a⁻¹ + P_b⁻¹ - M with M = (ω P_a + (1 - ω) P_b)⁻¹, and m = K m_a + G m_b with
    # K = P (P_a⁻¹ - ω M) and G = P (P_b⁻¹ - (1 - ω) M)
    common = inverse(omega * p_a + (1 - omega) * p_b)
    expected = inverse(inverse(p_a) + inverse(p_b) - common)
    k = expected @ (inverse(p_a) - omega * common)
    g = expected @ (inverse(p_b) - (1 - omega) * common)
    assert np.allclose(cov, expected, rtol=1e-6)
    expected_mean = k @ mean_a[..., None] + g @ mean_b[..., None]
    std = np.sqrt(np.diagonal(expected, axis1=-2, axis2=-1))
    error = np.abs(mean - expected_mean[..., 0])
    assert (error < 1e-6 * std).all()


@each_omega
def test_inverse_intersection_bounds_the_error_with_common_information(
    omega: float,
) -> None:
    """Theorem of Noack et al.: for every common estimate, whatever its covariance Γ."""
    common = covariances(4)
    # P_a⁻¹ = Γ⁻¹ + own information, and E[e_a e_bᵀ] = P_a Γ⁻¹ P_b.
    p_a = inverse(inverse(common) + inverse(covariances(5)))
    p_b = inverse(inverse(common) + inverse(covariances(6)))
    cross = p_a @ inverse(common) @ p_b
    rule = partial(pure.intersect_inverses, omega=omega)
    _, _, reported = gains(rule, p_a, p_b)
    assert is_below(error_covariance(rule, p_a, p_b, cross), reported)
    # Control: the product of the densities counts the common estimate twice.
    product = inverse(inverse(p_a) + inverse(p_b))
    k = product @ inverse(p_a)
    g = product @ inverse(p_b)
    error = covariance_of_sum(k, g, p_a, p_b, cross)
    assert not is_below(error, product)


@each_omega
def test_inverse_intersection_is_no_larger_than_intersection(omega: float) -> None:
    p_a = covariances(1)
    p_b = covariances(2)
    zero = np.zeros(3)
    _, ici = pure.intersect_inverses(zero, p_a, zero, p_b, omega=omega)
    # The weights change places: (ω P_a + (1 - ω) P_b)⁻¹ <= ω P_a⁻¹ + (1 - ω) P_b⁻¹.
    ci = inverse((1 - omega) * inverse(p_a) + omega * inverse(p_b))
    _, ellipsoids = pure.intersect_ellipsoids(zero, p_a, zero, p_b)
    assert is_below(ici, ci)
    # All possible common information is at least that of any weight.
    assert is_below(ellipsoids, ici)


@pytest.mark.parametrize("rule", ["min_trace", "min_determinant"])
@pytest.mark.parametrize("fuse", [pure.intersect_inverses, pure.unite_gaussians])
def test_the_weight_makes_the_result_smallest(fuse: Any, rule: str) -> None:
    p_a = covariances(1, count=40)
    p_b = covariances(2, count=40)
    mean_a, mean_b = gaussians(3, 2, 40, d=3)[0]

    def size(**options: Any) -> Array:
        _, cov = fuse(mean_a, p_a, mean_b, p_b, rule=rule, **options)
        if rule == "min_trace":
            return np.trace(cov, axis1=-2, axis2=-1)
        return np.linalg.slogdet(cov)[1]

    # No weight of a fine grid gives a smaller one.
    others = [size(omega=w) for w in np.linspace(0.0, 1.0, 201)]
    smallest = np.min(others, axis=0)
    chosen = size()
    assert (chosen < smallest + 1e-4 * np.abs(chosen)).all()


# Ellipsoidal intersection.


def test_ellipsoidal_intersection_by_the_papers_equations() -> None:
    """(8) with Γ and γ of (12) to (16), with inverses and η of 0."""
    p_a = covariances(7)
    p_b = covariances(8)
    mean_a, mean_b = gaussians(9, 2, N, d=3)[0]
    mean, cov = pure.intersect_ellipsoids(mean_a, p_a, mean_b, p_b)
    for k in range(N):
        d_i, s_i = np.linalg.eigh(p_a[k])
        root = s_i * np.sqrt(d_i)
        white = np.linalg.solve(root, np.linalg.solve(root, p_b[k]).T)
        d_j, s_j = np.linalg.eigh(white)
        transform = root @ s_j
        mutual = transform @ np.diag(np.maximum(1.0, d_j)) @ transform.T
        i_a = inverse(p_a[k])
        i_b = inverse(p_b[k])
        i_m = inverse(mutual)
        # The mean γ of the mutual information
        crossed = (i_b - i_m) @ mean_a[k] + (i_a - i_m) @ mean_b[k]
        gamma = np.linalg.solve(i_a + i_b - 2 * i_m, crossed)
        expected = inverse(i_a + i_b - i_m)
        assert np.allclose(cov[k], expected, rtol=1e-6)
        total = i_a @ mean_a[k] + i_b @ mean_b[k] - i_m @ gamma
        std = np.sqrt(np.diagonal(expected))
        error = np.abs(mean[k] - expected @ total)
        assert (error < 1e-5 * std).all()
    assert is_below(cov, p_a)
    assert is_below(cov, p_b)


def test_ellipsoidal_intersection_of_equals_is_their_mean() -> None:
    p = covariances(7, count=5)
    mean, cov = pure.intersect_ellipsoids(np.zeros(3), p, np.ones(3), p)
    assert np.allclose(mean, 0.5)
    assert np.allclose(cov, p)


# Split covariance intersection.


@each_omega
def test_split_intersection_bounds_the_error_for_any_correlation(omega: float) -> None:
    dependent = covariances(10), covariances(11)
    independent = covariances(12), covariances(13)
    total = [d + i for d, i in zip(dependent, independent, strict=True)]

    def rule(mean_a: Array, _: Array, mean_b: Array, __: Array) -> tuple[Array, Array]:
        mean, part, rest = pure.intersect_split(
            mean_a,
            dependent[0],
            independent[0],
            mean_b,
            dependent[1],
            independent[1],
            omega=omega,
        )
        return mean, part + rest

    roots = [np.linalg.cholesky(d) for d in dependent]
    # E[e_a e_bᵀ] = S_a C S_bᵀ with |C| <= 1, here orthogonal: full correlation.
    rotations = np.linalg.qr(rng(14).standard_normal((N, 3, 3)))[0]
    _, _, reported = gains(rule, *total)
    for sign in (1.0, -1.0):
        cross = sign * roots[0] @ rotations @ roots[1].mT
        assert is_below(error_covariance(rule, *total, cross), reported)
    # The independent part is that of the gains.
    k, g, _ = gains(rule, *total)
    *_, rest = pure.intersect_split(
        np.zeros(3),
        dependent[0],
        independent[0],
        np.zeros(3),
        dependent[1],
        independent[1],
        omega=omega,
    )
    expected = k @ independent[0] @ k.mT + g @ independent[1] @ g.mT
    assert np.allclose(rest, expected, rtol=1e-6)


@each_omega
def test_split_intersection_by_its_equation(omega: float) -> None:
    """P⁻¹ = (D_a/ω + I_a)⁻¹ + (D_b/(1 - ω) + I_b)⁻¹, and the mean by these informations."""
    dependent = covariances(10), covariances(11)
    independent = covariances(12), covariances(13)
    mean_a, mean_b = gaussians(14, 2, N, d=3)[0]
    mean, part, rest = pure.intersect_split(
        mean_a,
        dependent[0],
        independent[0],
        mean_b,
        dependent[1],
        independent[1],
        omega=omega,
    )
    information_a = inverse(dependent[0] / omega + independent[0])
    information_b = inverse(dependent[1] / (1 - omega) + independent[1])
    expected = inverse(information_a + information_b)
    assert np.allclose(part + rest, expected, rtol=1e-6)
    vector_a = information_a @ mean_a[..., None]
    vector_b = information_b @ mean_b[..., None]
    expected_mean = (expected @ (vector_a + vector_b))[..., 0]
    std = np.sqrt(np.diagonal(expected, axis1=-2, axis2=-1))
    assert (np.abs(mean - expected_mean) < 1e-6 * std).all()


@pytest.mark.parametrize("rule", ["min_trace", "min_determinant"])
def test_split_intersection_between_its_two_limits(rule: Any) -> None:
    """All dependent: covariance intersection. All independent: the product."""
    p_a = covariances(15)
    p_b = covariances(16)
    mean_a, mean_b = gaussians(17, 2, N, d=3)[0]
    none = np.zeros((3, 3))
    mean, dependent, independent = pure.intersect_split(
        mean_a, p_a, none, mean_b, p_b, none, rule=rule
    )
    means = np.stack([mean_a, mean_b], axis=-2)
    covs = np.stack([p_a, p_b], axis=-3)
    weights = pure.intersection_weights(covs, rule=rule)
    expected_mean, expected = pure.intersect_gaussians(means, covs, weights)
    std = np.sqrt(np.diagonal(expected, axis1=-2, axis2=-1))
    assert (np.abs(mean - expected_mean) < 2e-3 * std).all()
    if rule == "min_determinant":
        _, log_det = np.linalg.slogdet(dependent)
        _, expected_log_det = np.linalg.slogdet(expected)
        assert np.allclose(log_det, expected_log_det, atol=1e-4)
    else:
        trace = np.trace(dependent, axis1=-2, axis2=-1)
        expected_trace = np.trace(expected, axis1=-2, axis2=-1)
        assert np.allclose(trace, expected_trace, rtol=1e-4)
    assert not independent.any()
    mean, dependent, independent = pure.intersect_split(
        mean_a, none, p_a, mean_b, none, p_b, rule=rule
    )
    product = inverse(inverse(p_a) + inverse(p_b))
    assert np.allclose(independent, product, rtol=1e-6)
    assert np.abs(dependent).max() < 1e-9 * np.abs(product).max()


# Covariance union.


@pytest.mark.parametrize("omega", [None, 0.0, 0.3, 1.0])
def test_a_union_covers_both(omega: float | None) -> None:
    p_a = covariances(18)
    p_b = covariances(19)
    mean_a, mean_b = 3 * gaussians(20, 2, N, d=3)[0]
    mean, cov = pure.unite_gaussians(mean_a, p_a, mean_b, p_b, omega=omega)
    for other, p in ((mean_a, p_a), (mean_b, p_b)):
        # P_b + (m - m_b)(m - m_b)ᵀ is the mean squared error of m by one of the two.
        shift = mean - other
        inner = p + shift[..., :, None] * shift[..., None, :]
        assert is_below(inner, cov)
    # It is tight: along each of three axes it touches one of them.
    touched = np.zeros(N, dtype=int)
    for other, p in ((mean_a, p_a), (mean_b, p_b)):
        shift = mean - other
        inner = p + shift[..., :, None] * shift[..., None, :]
        values = np.linalg.eigvals(np.linalg.solve(cov, inner)).real
        touched += (values > 1 - 1e-6).sum(axis=-1)
    assert (touched >= 3).all()


def test_a_union_of_equals_is_one_of_them() -> None:
    mean, p = gaussians(21, 5, d=3)
    fused = pure.unite_gaussians(mean, p, mean, p)
    assert np.allclose(fused[0], mean)
    assert np.allclose(fused[1], p)


# In a network.

RULES = {
    "inverse": (network.inverse_covariance_intersection, pure.intersect_inverses),
    "trace": (
        partial(network.inverse_covariance_intersection, rule="min_trace"),
        partial(pure.intersect_inverses, rule="min_trace"),
    ),
    "ellipsoids": (network.ellipsoidal_intersection, pure.intersect_ellipsoids),
    "union": (network.covariance_union, pure.unite_gaussians),
}


@pytest.mark.parametrize("loss", [0.0, 0.4])
@pytest.mark.parametrize("graph", [STAR, DISK, Graph.from_edges(3, [[0, 1]])])
@pytest.mark.parametrize("name", RULES)
def test_agents_fuse_what_arrives_in_the_order_of_the_senders(
    name: str, graph: Graph, loss: float
) -> None:
    rule, pair_rule = RULES[name]
    m, p = gaussians(3, 2, 1, graph.n_agents, d=3)
    faults = Faults(loss=loss, seed=6)
    channel = Channel(graph, runs=(2, 1), faults=faults)
    means, covs = rule((m, p), channel)
    assert (channel.ledger.scalars == 9 * graph.out_degree).all()
    for run, arrived in enumerate(arrivals(faults, graph, runs=2)):
        for agent in range(graph.n_agents):
            one = m[run, 0, agent], p[run, 0, agent]
            for j in graph.neighbours(agent):
                if arrived[agent, j]:
                    one = pair_rule(*one, m[run, 0, j], p[run, 0, j])
            mean, cov = one
            assert np.allclose(means[run, 0, agent], mean, rtol=1e-6, atol=1e-9)
            assert np.allclose(covs[run, 0, agent], cov, rtol=1e-6)


@pytest.mark.parametrize("loss", [0.0, 0.4])
def test_split_parts_in_a_network(loss: float) -> None:
    graph = graphs.path(4)
    m, dependent = gaussians(3, 2, 4, d=2)
    _, independent = gaussians(4, 2, 4, d=2)
    faults = Faults(loss=loss, seed=6)
    channel = Channel(graph, runs=(2,), faults=faults)
    fused = network.split_covariance_intersection((m, dependent, independent), channel)
    assert (channel.ledger.scalars == 8 * graph.out_degree).all()
    belief = (m, dependent, independent)
    for run, arrived in enumerate(arrivals(faults, graph, runs=2)):
        for agent in range(4):
            parts = [part[run, agent] for part in belief]
            for j in graph.neighbours(agent):
                if arrived[agent, j]:
                    other = [part[run, j] for part in belief]
                    parts = pure.intersect_split(*parts, *other)
            for value, expected in zip(fused, parts, strict=True):
                assert np.allclose(value[run, agent], expected, rtol=1e-6, atol=1e-9)


def test_what_was_sent_is_dependent_in_the_next_round() -> None:
    m, dependent = gaussians(3, 4, d=2)
    _, independent = gaussians(4, 4, d=2)
    rule = network.split_covariance_intersection
    belief = (m, dependent, independent)
    path = graphs.path(4)
    after_two = rule(belief, Channel(path), rounds=2)
    means, still_dependent, sent = rule(belief, Channel(path))
    again = (means, still_dependent + sent, 0 * sent)
    after_again = rule(again, Channel(path))
    for value, expected in zip(after_two, after_again, strict=True):
        assert np.allclose(value, expected)


@pytest.mark.parametrize("name", RULES)
def test_angles_are_fused_the_shorter_way_round(name: str) -> None:
    rule, _ = RULES[name]
    channel = star()
    channel.periods = (2 * np.pi, None)
    m = np.array([[3.1, 0.0], [-3.1, 1.0], [3.0, 2.0]])
    p = np.array(
        [
            [[1.0, 0.0], [0.0, 2.0]],
            [[2.0, 0.0], [0.0, 1.0]],
            [[1.0, 0.0], [0.0, 1.0]],
        ]
    )
    means, covs = rule((m, p), channel)
    # The same places on one branch
    turned = m + [[0, 0], [2 * np.pi, 0], [0, 0]]
    expected, expected_covs = rule((turned, p), star())
    difference = wrap(means[:, 0] - expected[:, 0])
    assert np.abs(difference).max() < 1e-6
    assert np.allclose(covs, expected_covs)
