"""Reductions against brute force, and the guards of the relevance rule."""

from __future__ import annotations

import importlib.util
from itertools import combinations, product

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from distfilt.mixtures import (
    ComponentShapes,
    GaussianMixture,
    merging,
    reduction,
    runnalls,
)
from distfilt.mixtures.reduction import (
    cross_relevance,
    gaussian_divergences,
    merge_irrelevant,
    pivoted_qr,
)

from .examples import assert_same, random_frame, random_mixture, shuffle, transform

ENGINES = ["numpy", "loops", *(["numba"] if importlib.util.find_spec("numba") else [])]


@pytest.fixture(params=ENGINES)
def engine(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Merge by plain numpy, by numba's kernel uncompiled, and compiled where there is numba."""
    plain = getattr(merging.merge_pairs, "py_func", merging.merge_pairs)
    if request.param == "numpy":
        monkeypatch.setattr(merging, "merge_pairs", plain)
        monkeypatch.setattr(merging, "row_costs", reduction.pair_costs)
    if request.param == "loops":
        monkeypatch.setattr(merging, "merge_pairs", plain)
        monkeypatch.setattr(merging, "row_costs", merging.loop_costs)


ENGINE = pytest.mark.usefixtures("engine")


def merge_by_brute_force(p: GaussianMixture, size: int) -> GaussianMixture:
    """Runnalls' algorithm written out: all pairs in every step."""
    w = list(p.weights)
    m = list(p.means)
    c = list(p.covs)

    def merge(i: int, j: int) -> tuple[float, np.ndarray, np.ndarray]:
        # Weight, mean and covariance of both are kept: P = Σ w_k (P_k + (m_k - m)(m_k - m)ᵀ) / w.
        total = w[i] + w[j]
        weighted_sum = w[i] * m[i] + w[j] * m[j]
        mean = weighted_sum / total
        cov = np.zeros_like(c[i])
        for k in (i, j):
            difference = m[k] - mean
            share = w[k] / total
            cov += share * (c[k] + np.outer(difference, difference))
        return total, mean, cov

    def cost(i: int, j: int) -> float:
        # B_ij = ½ [(w_i + w_j) log|P_ij| - w_i log|P_i| - w_j log|P_j|]
        total, _, cov = merge(i, j)
        first = w[i] * np.linalg.slogdet(c[i])[1]
        second = w[j] * np.linalg.slogdet(c[j])[1]
        merged = total * np.linalg.slogdet(cov)[1]
        return 0.5 * float(merged - (first + second))

    while len(w) > size:
        pairs = combinations(range(len(w)), 2)
        i, j = min(pairs, key=lambda pair: cost(*pair))
        w[i], m[i], c[i] = merge(i, j)
        del w[j], m[j], c[j]
    return GaussianMixture(np.array(w), np.array(m), np.array(c))


@ENGINE
@pytest.mark.parametrize(
    ("size", "dim", "n_components"),
    [(7, 1, 2), (12, 3, 4), (9, 9, 1), (20, 4, 19), (30, 2, 5)],
)
def test_runnalls_is_the_algorithm(size: int, dim: int, n_components: int) -> None:
    p = random_mixture(size, dim, size)
    expected = merge_by_brute_force(p, n_components)
    assert_same(runnalls(p, n_components), expected)


@ENGINE
def test_a_merger_may_be_the_new_nearest_of_another_component() -> None:
    """Two narrow components whose merger is nearer to a third one than either of them was.

    Costs seldom fall by a merger: it took 5000 random mixtures to find one where that decides.
    """
    rng = np.random.default_rng(4979)
    angles = rng.random(8) * np.pi
    c = np.cos(angles)
    s = np.sin(angles)
    first_rows = np.stack([c, -s], axis=-1)
    second_rows = np.stack([s, c], axis=-1)
    rotations = np.stack([first_rows, second_rows], axis=-2)
    # Variances along the rotated axes: 1, and between 1e-4 and 1
    lengths = np.zeros((8, 2, 2))
    lengths[:, 0, 0] = 1.0
    lengths[:, 1, 1] = 10.0 ** rng.uniform(-4, 0, 8)
    covs = rotations @ lengths @ rotations.mT
    weights = rng.dirichlet(np.full(8, 0.7))
    p = GaussianMixture(weights, 0.3 * rng.standard_normal((8, 2)), covs)
    assert_same(runnalls(p, 3), merge_by_brute_force(p, 3))


@given(st.integers(2, 30), st.integers(1, 5), st.integers(0, 1000))
def test_reduction_keeps_the_moments_in_any_coordinates(
    size: int, dim: int, seed: int
) -> None:
    p = random_mixture(size, dim, seed)
    n_components = 1 + seed % size
    reduced = runnalls(p, n_components)
    assert reduced.n_components == min(n_components, size)
    # Every merger keeps the moments of its pair, so that the mixture keeps its own.
    assert np.allclose(reduced.mean, p.mean)
    assert np.allclose(reduced.cov, p.cov)
    # Costs are differences of log determinants, which coordinates do not change.
    matrix, shift = random_frame(dim)
    transformed = runnalls(transform(p, matrix, shift), n_components)
    assert_same(transformed, transform(reduced, matrix, shift), 1e-7)
    assert_same(runnalls(shuffle(p), n_components), reduced)


@ENGINE
def test_ties_do_not_depend_on_rounding() -> None:
    # Mirror images cost the same; the first pair goes, whatever the last bit says.
    m = np.array([[-3.0], [-2.0], [2.0], [3.0]])
    for shift in (0.0, 0.1, 1e-9):
        p = GaussianMixture(np.full(4, 0.25), m + shift, np.ones((4, 1, 1)))
        means = runnalls(p, 3).means.ravel()
        assert np.allclose(means, [-2.5 + shift, 2 + shift, 3 + shift])


@ENGINE
def test_a_component_without_weight_goes_first() -> None:
    p = GaussianMixture([0.5, 0.0, 0.5], [[0.0], [5.0], [9.0]], np.ones((3, 1, 1)))
    reduced = runnalls(p, 2)
    # Its merger costs nothing and moves nothing.
    assert np.allclose(reduced.means.ravel(), [0.0, 9.0])
    assert np.allclose(reduced.weights, 0.5)


def test_the_heaviest_absorb_the_others_first() -> None:
    p = random_mixture(300, 3, 12)
    for n in (1, 5):
        q = runnalls(p, n, heaviest=40)
        assert q.n_components == n
        assert np.allclose(q.mean, p.mean)
        assert np.allclose(q.cov, p.cov)
    # With a limit as large as the mixture nothing is absorbed in advance.
    assert_same(runnalls(p, 5, heaviest=300), runnalls(p, 5))
    # A light component joins the near heavy one; one without weight changes nothing.
    means = [[0.0], [9.0], [1.0], [2.0]]
    q = GaussianMixture([0.45, 0.45, 0.1, 0.0], means, np.ones((4, 1, 1)))
    assert np.allclose(runnalls(q, 2, heaviest=2).weights, [0.55, 0.45])
    # Near means a low cost: the wide component absorbs one that lies closer to the
    # narrow one.
    means = [[0.0], [4.0], [1.5]]
    covs = [[[0.01]], [[9.0]], [[1.0]]]
    q = GaussianMixture([0.45, 0.45, 0.1], means, covs)
    assert np.allclose(runnalls(q, 2, heaviest=2).weights, [0.45, 0.55])


def test_the_relevance_rule_is_41_without_its_guards(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(reduction, "_NEAR", 0.0)
    monkeypatch.setattr(reduction, "_RELEVANCE_FLOOR", 0.0)
    one = random_mixture(7, 2, 1)
    two = random_mixture(8, 2, 2)
    relevance = cross_relevance(one, two)
    # w_i KL(p_i‖q_j); a component is irrelevant if its least value exceeds 3 δ_min.
    divergences = gaussian_divergences(one, two)
    assert np.allclose(relevance, one.weights[:, None] * divergences)
    delta = relevance.min(axis=1)
    irrelevant = delta > 3.0 * delta.min()
    reduced = merge_irrelevant(one, two, threshold=3.0)
    assert reduced.n_components == 1 + (~irrelevant).sum()
    # The last component has the moments of all irrelevant ones.
    weights = one.weights[irrelevant]
    assert np.isclose(reduced.weights[-1], weights.sum())
    means = one.means[irrelevant]
    covs = one.covs[irrelevant]
    group = GaussianMixture(weights / weights.sum(), means, covs)
    assert np.allclose(reduced.means[-1], group.mean)
    assert np.allclose(reduced.covs[-1], group.cov)
    assert np.allclose(reduced.cov, one.cov)
    # The same in other coordinates.
    matrix, shift = random_frame(2)
    moved_one = transform(one, matrix, shift)
    moved_two = transform(two, matrix, shift)
    transformed = merge_irrelevant(moved_one, moved_two, threshold=3.0)
    assert_same(transformed, transform(reduced, matrix, shift))


@given(st.integers(0, 500), st.integers(2, 8))
def test_a_shared_component_does_not_collapse_the_mixture(seed: int, size: int) -> None:
    # As printed, δ_min = 0 puts every component but the shared one into the merger.
    p = random_mixture(size, 2, seed, spread=0.3)
    means = p.means + 0.01
    means[0] = p.means[0]
    q = GaussianMixture(p.weights, means, p.covs)
    # All are near a component of the other.
    assert merge_irrelevant(p, q, threshold=1.5).n_components == size
    far = random_mixture(size, 2, seed, spread=30.0)
    shared = GaussianMixture.gaussian(far.means[0], far.covs[0])
    reduced = merge_irrelevant(far, shared, threshold=1.5)
    distances = np.abs(reduced.means - far.means[0]).sum(axis=1)
    # The shared component is still one of the mixture's.
    assert reduced.n_components >= 2
    assert distances.min() < 1e-12


def test_a_light_component_far_away_does_not_set_the_scale() -> None:
    weights = [0.5, 0.5 - 1e-9, 1e-9]
    one = GaussianMixture(weights, [[0.0], [1.0], [40.0]], np.ones((3, 1, 1)))
    two = GaussianMixture([0.5, 0.5], [[0.2], [1.3]], np.ones((2, 1, 1)))
    # δ = 1e-9 · 760 is the least one, but the guards keep the others.
    assert merge_irrelevant(one, two, threshold=1.5).n_components == 3


def test_pivoted_qr() -> None:
    means = np.array([[0.0, 0.0], [0.0, 1e-7], [5.0, 0.0], [5.0, 1e-7], [0.0, 9.0]])
    # Two pairs of nearly equal columns and a column of its own: rank three.
    covs = np.stack([np.eye(2)] * 5)
    shapes = ComponentShapes(means, covs, [0, 1, 2, 3, 4], 7)
    dropped = pivoted_qr(shapes, n_components=3, rest="drop")
    assert dropped.n_components == 3
    assert dropped.dropped == 7
    assert 4 in dropped.source
    merged = pivoted_qr(shapes, n_components=4)
    # Two copies, one of each pair, with equal weights.
    assert merged.n_components == 4
    assert np.allclose(merged.means[-1], [2.5, 0.0], atol=1e-6)
    assert np.allclose(merged.covs[-1], [[1 + 6.25, 0], [0, 1]], atol=1e-5)
    assert set(merged.source[:3]) == set(dropped.source)
    assert merged.source[3] not in dropped.source
    for n, treatment in product((1, 2, 3, 5, 9), ("merge", "drop")):
        selected = pivoted_qr(shapes, n_components=n, rest=treatment)
        assert selected.n_components == min(n, 5)
