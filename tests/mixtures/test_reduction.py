"""Reductions against brute force, and the guards of the relevance rule."""

from __future__ import annotations

import importlib.util
from itertools import product

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from distfilt.mixtures import ComponentShapes, GaussianMixture, reduction, runnalls
from distfilt.mixtures.reduction import (
    cross_relevance,
    gaussian_divergences,
    merge_irrelevant,
    pivoted_qr,
)

from .examples import affine, random_mixture, same, scales, shuffled

ENGINES = ["numpy", "loops", *(["numba"] if importlib.util.find_spec("numba") else [])]


@pytest.fixture(params=ENGINES)
def engine(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """What merges: plain numpy, numba's kernel uncompiled, and compiled where there is numba."""
    if request.param != "numba":
        monkeypatch.setattr(reduction, "_merging", lambda: reduction._merged)
    if request.param == "loops":
        monkeypatch.setattr(reduction, "_costs", reduction._costs_in_loops)


ENGINE = pytest.mark.usefixtures("engine")


def brute(p: GaussianMixture, size: int) -> GaussianMixture:
    """Runnalls' algorithm written out: all pairs in every step."""
    w = list(p.weights)
    m = list(p.means)
    c = list(p.covs)

    def merged(i: int, j: int) -> tuple[float, np.ndarray, np.ndarray]:
        total = w[i] + w[j]
        mean = (w[i] * m[i] + w[j] * m[j]) / total
        cov = sum(
            w[k] / total * (c[k] + np.outer(m[k] - mean, m[k] - mean)) for k in (i, j)
        )
        return total, mean, np.asarray(cov)

    def loss(i: int, j: int) -> float:
        total, _, cov = merged(i, j)
        own = w[i] * np.linalg.slogdet(c[i])[1] + w[j] * np.linalg.slogdet(c[j])[1]
        return 0.5 * float(total * np.linalg.slogdet(cov)[1] - own)

    while len(w) > size:
        pairs = ((i, j) for i in range(len(w)) for j in range(i + 1, len(w)))
        i, j = min(pairs, key=lambda ij: loss(*ij))
        w[i], m[i], c[i] = merged(i, j)
        del w[j], m[j], c[j]
    return GaussianMixture(np.array(w), np.array(m), np.array(c))


@ENGINE
@pytest.mark.parametrize(
    ("size", "dim", "left"), [(7, 1, 2), (12, 3, 4), (9, 9, 1), (20, 4, 19), (30, 2, 5)]
)
def test_runnalls_is_the_algorithm(size: int, dim: int, left: int) -> None:
    p = random_mixture(size, dim, size)
    same(runnalls(p, left), brute(p, left))


@given(st.integers(2, 30), st.integers(1, 5), st.integers(0, 1000))
def test_reduction_keeps_the_moments_in_any_coordinates(
    size: int, dim: int, seed: int
) -> None:
    p = random_mixture(size, dim, seed)
    left = 1 + seed % size
    a = runnalls(p, left)
    assert a.n_components == min(left, size)
    assert np.allclose(a.mean, p.mean) and np.allclose(a.cov, p.cov)
    matrix, shift = scales(dim)
    same(runnalls(affine(p, matrix, shift), left), affine(a, matrix, shift), 1e-7)
    same(runnalls(shuffled(p), left), a)


@ENGINE
def test_ties_do_not_depend_on_rounding() -> None:
    # Mirror images cost the same; the first pair goes, whatever the last bit says.
    m = np.array([[-3.0], [-2.0], [2.0], [3.0]])
    for shift in (0.0, 0.1, 1e-9):
        p = GaussianMixture(np.full(4, 0.25), m + shift, np.ones((4, 1, 1)))
        left = runnalls(p, 3).means.ravel()
        assert np.allclose(left, [-2.5 + shift, 2 + shift, 3 + shift])


@ENGINE
def test_a_mixand_without_weight_goes_first() -> None:
    p = GaussianMixture([0.5, 0.0, 0.5], [[0.0], [5.0], [9.0]], np.ones((3, 1, 1)))
    left = runnalls(p, 2)
    assert np.allclose(left.means.ravel(), [0.0, 9.0]) and np.allclose(
        left.weights, 0.5
    )


def test_the_heaviest_absorb_the_others_first() -> None:
    p = random_mixture(300, 3, 12)
    for n in (1, 5):
        q = runnalls(p, n, heaviest=40)
        assert (
            q.n_components == n
            and np.allclose(q.mean, p.mean)
            and np.allclose(q.cov, p.cov)
        )
    same(runnalls(p, 5, heaviest=300), runnalls(p, 5))
    # A light mixand joins the heavy one that is near; one without weight changes nothing.
    means = [[0.0], [9.0], [1.0], [2.0]]
    q = GaussianMixture([0.45, 0.45, 0.1, 0.0], means, np.ones((4, 1, 1)))
    assert np.allclose(runnalls(q, 2, heaviest=2).weights, [0.55, 0.45])
    # Near is what costs little: a wide one takes in what a narrow one stands closer to.
    q = GaussianMixture(
        [0.45, 0.45, 0.1], [[0.0], [4.0], [1.5]], [[[0.01]], [[9.0]], [[1.0]]]
    )
    assert np.allclose(runnalls(q, 2, heaviest=2).weights, [0.45, 0.55])


def test_the_relevance_rule_is_41_without_its_guards(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(reduction, "_GATE", 0.0)
    monkeypatch.setattr(reduction, "_FLOOR", 0.0)
    one = random_mixture(7, 2, 1)
    two = random_mixture(8, 2, 2)
    relevance = cross_relevance(one, two)
    assert np.allclose(relevance, one.weights[:, None] * gaussian_divergences(one, two))
    delta = relevance.min(axis=1)
    out = delta > 3.0 * delta.min()
    kept = merge_irrelevant(one, two, threshold=3.0)
    assert kept.n_components == 1 + (~out).sum()
    assert np.isclose(kept.weights[-1], one.weights[out].sum())
    share = one.weights[out] / one.weights[out].sum()
    inside = GaussianMixture(share, one.means[out], one.covs[out])
    assert np.allclose(kept.means[-1], inside.mean) and np.allclose(
        kept.covs[-1], inside.cov
    )
    assert np.allclose(kept.cov, one.cov)
    there = (affine(m, *scales(2)) for m in (one, two))
    same(merge_irrelevant(*there, threshold=3.0), affine(kept, *scales(2)))


@given(st.integers(0, 500), st.integers(2, 8))
def test_a_shared_mixand_does_not_collapse_the_mixture(seed: int, size: int) -> None:
    # As printed, δ_min = 0 puts every mixand but the shared one into the merger.
    p = random_mixture(size, 2, seed, spread=0.3)
    moved = p.means + 0.01
    moved[0] = p.means[0]
    q = GaussianMixture(p.weights, moved, p.covs)
    # All lie within the gate of a mixand of the other.
    assert merge_irrelevant(p, q, threshold=1.5).n_components == size
    far = random_mixture(size, 2, seed, spread=30.0)
    shared = GaussianMixture.gaussian(far.means[0], far.covs[0])
    left = merge_irrelevant(far, shared, threshold=1.5)
    assert (
        left.n_components >= 2
        and np.abs(left.means - far.means[0]).sum(axis=1).min() < 1e-12
    )


def test_a_light_mixand_far_away_does_not_set_the_scale() -> None:
    one = GaussianMixture(
        [0.5, 0.5 - 1e-9, 1e-9], [[0.0], [1.0], [40.0]], np.ones((3, 1, 1))
    )
    two = GaussianMixture([0.5, 0.5], [[0.2], [1.3]], np.ones((2, 1, 1)))
    assert merge_irrelevant(one, two, threshold=1.5).n_components == 3


def test_pivoted_qr() -> None:
    means = np.array([[0.0, 0.0], [0.0, 1e-7], [5.0, 0.0], [5.0, 1e-7], [0.0, 9.0]])
    shapes = ComponentShapes(means, np.stack([np.eye(2)] * 5), [0, 1, 2, 3, 4], 7)
    dropped = pivoted_qr(shapes, n_components=3, rest="drop")
    assert dropped.n_components == 3 and dropped.dropped == 7 and 4 in dropped.source
    merged = pivoted_qr(shapes, n_components=4)
    # Two copies, one of each pair, with equal weights.
    assert merged.n_components == 4 and np.allclose(
        merged.means[-1], [2.5, 0.0], atol=1e-6
    )
    assert np.allclose(merged.covs[-1], [[1 + 6.25, 0], [0, 1]], atol=1e-5)
    assert (
        set(merged.source[:3]) == set(dropped.source)
        and merged.source[3] not in dropped.source
    )
    for n, rest in product((1, 2, 3, 5, 9), ("merge", "drop")):
        assert pivoted_qr(shapes, n_components=n, rest=rest).n_components == min(n, 5)
