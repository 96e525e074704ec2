"""Reductions against brute force, and the guards of the relevance rule."""

from __future__ import annotations

import importlib.util
import sys

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from distfilt.mixtures import (
    GaussianMixture,
    Shapes,
    _merging,
    cross_relevance,
    kept_by_relevance,
    merge_costs,
    pivoted_qr,
    prune,
    runnalls,
    two_stage,
)
from distfilt.mixtures.divergence import gaussian_divergences
from distfilt.mixtures.gaussian import symmetric
from distfilt.mixtures.reduction import _whitened

from .examples import TARGET, pair, random_mixture

P = random_mixture(6, 2, 1)
SHAPES = Shapes(P.means, P.covs, np.zeros(6, dtype=int))

BAD_INPUT = {
    "distfilt.mixtures.reduction.runnalls": [
        ("size", lambda: runnalls(P, 0)),
        ("engine", lambda: runnalls(P, 3, engine="fortran")),
        ("mixture", lambda: runnalls(3, 3)),  # type: ignore[arg-type]
    ],
    "distfilt.mixtures.reduction.merge_costs": [
        ("mixture", lambda: merge_costs(3)),  # type: ignore[arg-type]
    ],
    "distfilt.mixtures.reduction.prune": [
        ("least", lambda: prune(P, 1.0)),
        ("mixture", lambda: prune(3, 0.1)),  # type: ignore[arg-type]
    ],
    "distfilt.mixtures.reduction.two_stage": [
        ("size", lambda: two_stage(P, 0)),
        ("heaviest", lambda: two_stage(P, 3, heaviest=2)),
    ],
    "distfilt.mixtures.reduction.cross_relevance": [
        ("other", lambda: cross_relevance(P, P.marginal([0]))),
        ("mixture", lambda: cross_relevance(3, P)),  # type: ignore[arg-type]
    ],
    "distfilt.mixtures.reduction.kept_by_relevance": [
        ("threshold", lambda: kept_by_relevance(P, P, threshold=1.0)),
        ("gate", lambda: kept_by_relevance(P, P, threshold=2.0, gate=-1.0)),
        ("floor", lambda: kept_by_relevance(P, P, threshold=2.0, floor=-1.0)),
        ("other", lambda: kept_by_relevance(P, P.marginal([0]), threshold=2.0)),
    ],
    "distfilt.mixtures.reduction.pivoted_qr": [
        ("shapes", lambda: pivoted_qr(P, size=2)),  # type: ignore[arg-type]
        ("size", lambda: pivoted_qr(SHAPES)),
        ("size", lambda: pivoted_qr(SHAPES, size=2, tolerance=0.1)),
        ("size", lambda: pivoted_qr(SHAPES, size=0)),
        ("tolerance", lambda: pivoted_qr(SHAPES, tolerance=1.0)),
        ("rest", lambda: pivoted_qr(SHAPES, size=2, rest="keep")),
    ],
}


def brute(p: GaussianMixture, size: int) -> GaussianMixture:
    """Runnalls' algorithm written out: all pairs in every step."""
    w, m, c = list(p.weights), list(p.means), list(p.covs)

    def merged(i: int, j: int) -> tuple[float, np.ndarray, np.ndarray]:
        total = w[i] + w[j]
        mean = (w[i] * m[i] + w[j] * m[j]) / total
        cov = sum(
            w[k] / total * (c[k] + np.outer(m[k] - mean, m[k] - mean)) for k in (i, j)
        )
        return total, mean, np.asarray(cov)

    def loss(i: int, j: int) -> float:
        total, _, cov = merged(i, j)
        return 0.5 * float(
            total * np.linalg.slogdet(cov)[1]
            - w[i] * np.linalg.slogdet(c[i])[1] - w[j] * np.linalg.slogdet(c[j])[1]
        )

    while len(w) > size:
        pairs = [(i, j) for i in range(len(w)) for j in range(i + 1, len(w))]
        i, j = min(pairs, key=lambda ij: loss(*ij))
        w[i], m[i], c[i] = merged(i, j)
        del w[j], m[j], c[j]
    return GaussianMixture(np.array(w), np.array(m), np.array(c))


def same(a: GaussianMixture, b: GaussianMixture, tolerance: float = 1e-11) -> None:
    assert a.size == b.size
    for x, y in ((a.weights, b.weights), (a.means, b.means), (a.covs, b.covs)):
        assert np.abs(x - y).max() <= tolerance * (1 + np.abs(y).max())


ENGINES = ["numpy", *(["numba"] if importlib.util.find_spec("numba") else [])]


def by_kernel(p: GaussianMixture, left: int) -> GaussianMixture:
    """As :func:`runnalls` by the kernel, compiled where numba is there and as it stands if not."""
    w, m, c, root = _whitened(p)
    alive = np.ones(w.size, dtype=bool)
    if left < w.size:
        _merging.reduce(w, m, c, alive, left)
    means = p.moments()[0] + m[alive] @ root.T
    return GaussianMixture(w[alive] / w[alive].sum(), means, symmetric(root @ c[alive] @ root.T))


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize(("size", "dim", "left"), [(7, 1, 2), (12, 3, 4), (9, 9, 1), (20, 4, 19)])
def test_runnalls_is_the_algorithm(engine: str, size: int, dim: int, left: int) -> None:
    p = random_mixture(size, dim, size)
    same(runnalls(p, left, engine=engine), brute(p, left))


@given(st.integers(2, 30), st.integers(1, 5), st.integers(0, 1000))
def test_both_engines_agree_and_moments_stay(size: int, dim: int, seed: int) -> None:
    p = random_mixture(size, dim, seed)
    left = 1 + seed % size
    a, b = by_kernel(p, left), runnalls(p, left, engine="numpy")
    same(a, b, 1e-12)
    assert a.size == min(left, size)
    for x, y in zip(a.moments(), p.moments(), strict=True):
        assert np.allclose(x, y, rtol=1e-10, atol=1e-10)


def test_without_numba_its_engine_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    p = random_mixture(4, 2, 1)
    monkeypatch.setitem(sys.modules, "numba", None)
    with pytest.raises(ModuleNotFoundError, match=r"numba.*speed"):
        runnalls(p, 2, engine="numba")


def test_the_kernel_uncompiled() -> None:
    p = random_mixture(8, 2, 3)
    work = np.empty((2, 2))
    dets = np.linalg.slogdet(p.covs)[1]
    got = _merging._cost(p.weights, p.means, p.covs, dets, 2, 5, work)
    assert np.isclose(got, merge_costs(p)[2, 5], rtol=1e-9)
    assert np.isnan(_merging._log_det(np.array([[1.0, 0.0], [2.0, 1.0]]), 2))
    arrays = (p.weights.copy(), p.means.copy(), p.covs.copy())
    _merging._merge(*arrays, 2, 5)
    two = GaussianMixture(
        p.weights[[2, 5]] / p.weights[[2, 5]].sum(), p.means[[2, 5]], p.covs[[2, 5]]
    )
    assert np.allclose(arrays[1][2], two.moments()[0])
    assert np.allclose(arrays[2][2], two.moments()[1])
    alive = np.ones(8, dtype=bool)
    w, m, c = p.weights.copy(), p.means.copy(), p.covs.copy()
    _merging._reduce(w, m, c, alive, 3)
    same(GaussianMixture(w[alive], m[alive], c[alive]), brute(p, 3))


def test_ties_do_not_depend_on_rounding() -> None:
    # Mirror images cost the same; the first pair goes, whatever the last bit says.
    m = np.array([[-3.0], [-2.0], [2.0], [3.0]])
    p = GaussianMixture(np.full(4, 0.25), m, np.ones((4, 1, 1)))
    for shift in (0.0, 0.1, 1e-9):
        moved = GaussianMixture(p.weights, p.means + shift, p.covs)
        for engine in ENGINES:
            left = runnalls(moved, 3, engine=engine).means.ravel()
            assert np.allclose(left, [-2.5 + shift, 2 + shift, 3 + shift])


def test_merge_costs_are_invariant_and_nonnegative() -> None:
    p = random_mixture(6, 3, 8)
    root = np.random.default_rng(0).standard_normal((3, 3)) * 100
    q = GaussianMixture(p.weights, p.means @ root.T, root @ p.covs @ root.T)
    q = GaussianMixture(q.weights, q.means, 0.5 * (q.covs + q.covs.swapaxes(-1, -2)))
    assert np.allclose(merge_costs(p), merge_costs(q), rtol=1e-8, atol=1e-10)
    assert merge_costs(p).min() >= -1e-14 and np.allclose(merge_costs(p), merge_costs(p).T)


def test_a_mixand_without_weight_goes_first() -> None:
    p = GaussianMixture([0.5, 0.0, 0.5], [[0.0], [5.0], [9.0]], np.ones((3, 1, 1)))
    for engine in ENGINES:
        left = runnalls(p, 2, engine=engine)
        assert np.allclose(left.means.ravel(), [0.0, 9.0]) and np.allclose(left.weights, 0.5)


def test_two_stage() -> None:
    p = random_mixture(300, 3, 12)
    for n in (1, 5):
        q = two_stage(p, n, heaviest=40)
        assert q.size == n
        for x, y in zip(q.moments(), p.moments(), strict=True):
            assert np.allclose(x, y, rtol=1e-9, atol=1e-9)
    same(two_stage(p, 5, heaviest=300), runnalls(p, 5))
    # A light mixand joins the heavy one that is near.
    q = GaussianMixture([0.45, 0.45, 0.1], [[0.0], [9.0], [1.0]], np.ones((3, 1, 1)))
    assert np.allclose(two_stage(q, 2, heaviest=2).weights, [0.55, 0.45])


def test_prune() -> None:
    p = GaussianMixture([0.7, 0.2, 0.1], [[0.0], [1.0], [2.0]], np.ones((3, 1, 1)))
    assert np.allclose(prune(p, 0.15).weights, [7 / 9, 2 / 9])
    assert prune(p, 0.99).size == 1 and prune(p, 0.0).size == 3
    assert prune(GaussianMixture([1.0, 0.0], [[0.0], [1.0]], np.ones((2, 1, 1))), 0.0).size == 1


def test_cross_relevance_is_weighted() -> None:
    p, q = random_mixture(3, 2, 5), random_mixture(4, 2, 6)
    wanted = p.weights[:, None] * gaussian_divergences(p.means, p.covs, q.means, q.covs)
    assert np.allclose(cross_relevance(p, q), wanted) and wanted.shape == (3, 4)


def test_the_relevance_rule_is_41_where_no_guard_is_needed() -> None:
    one, two = (m.marginal(TARGET) for m in pair("B"))
    delta = cross_relevance(one, two).min(axis=1)
    out = delta > 3.0 * delta.min()
    kept = kept_by_relevance(one, two, threshold=3.0, gate=0.0, floor=0.0)
    assert kept.size == 1 + (~out).sum()
    assert np.isclose(kept.weights[-1], one.weights[out].sum())
    inside = GaussianMixture(
        one.weights[out] / one.weights[out].sum(), one.means[out], one.covs[out]
    )
    assert np.allclose(kept.means[-1], inside.moments()[0])
    assert np.allclose(kept.covs[-1], inside.moments()[1])
    assert np.allclose(kept.moments()[1], one.moments()[1])


@given(st.integers(0, 500), st.integers(2, 8))
def test_a_shared_mixand_does_not_collapse_the_mixture(seed: int, size: int) -> None:
    # As printed, δ_min = 0 puts every mixand but the shared one into the merger.
    p = random_mixture(size, 2, seed, spread=0.3)
    moved = p.means + 0.01
    moved[0] = p.means[0]
    q = GaussianMixture(p.weights, moved, p.covs)
    kept = kept_by_relevance(p, q, threshold=1.5)
    assert kept.size == size  # all lie within the gate of a mixand of the other
    far = random_mixture(size, 2, seed, spread=30.0)
    shared = GaussianMixture.gaussian(far.means[0], far.covs[0])
    left = kept_by_relevance(far, shared, threshold=1.5)
    assert left.size >= 2 or size == 1
    assert np.abs(left.means - far.means[0]).sum(axis=1).min() < 1e-12


def test_a_light_mixand_far_away_does_not_set_the_scale() -> None:
    one = GaussianMixture(
        [0.5, 0.5 - 1e-9, 1e-9], [[0.0], [1.0], [40.0]], np.ones((3, 1, 1))
    )
    two = GaussianMixture([0.5, 0.5], [[0.2], [1.3]], np.ones((2, 1, 1)))
    assert kept_by_relevance(one, two, threshold=1.5).size == 3


def test_pivoted_qr() -> None:
    means = np.array([[0.0, 0.0], [0.0, 1e-7], [5.0, 0.0], [5.0, 1e-7], [0.0, 9.0]])
    shapes = Shapes(means, np.stack([np.eye(2)] * 5), [0, 1, 2, 3, 4], 7)
    dropped = pivoted_qr(shapes, tolerance=1e-3, rest="drop")
    assert dropped.size == 3 and dropped.dropped == 7 and 4 in dropped.source
    merged = pivoted_qr(shapes, tolerance=1e-3)
    assert merged.size == 4
    # Two copies, one of each pair, with equal weights.
    assert np.allclose(merged.means[-1], [2.5, 0.0], atol=1e-6)
    assert np.allclose(merged.covs[-1], [[1 + 6.25, 0], [0, 1]], atol=1e-5)
    for n in (1, 2, 3, 5, 9):
        assert pivoted_qr(shapes, size=n, rest="drop").size == min(n, 5)
    assert pivoted_qr(shapes, size=4).size == 4
    assert pivoted_qr(shapes, size=5).size == 5
