"""Partial-state fusion: identities, the two forms, definiteness, weights, a channel."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from distfilt.mixtures import (
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

from .examples import TARGET, affine, random_mixture, same, scales, shuffled

OWN = random_mixture(3, 4, 1)
OTHER = random_mixture(2, 2, 2)
ROWS = pytest.mark.parametrize("rule", ["C1", "C2", "C3", "points"])


def by_information(
    own: GaussianMixture,
    q: int,
    p: int,
    others: list[tuple[GaussianMixture, int]],
    w: list[float],
) -> tuple[np.ndarray, np.ndarray]:
    """One fused mixand by information matrices, (22)-(27): own q, divided by p, times others'."""
    inv = np.linalg.inv
    n = others[0][0].dim
    info = inv(own.covs[q])
    vector = inv(own.covs[q]) @ own.means[q]
    parts = [(w[0] - 1, own.means[p, :n], own.covs[p, :n, :n])]
    parts += [
        (a, m.means[r], m.covs[r]) for a, (m, r) in zip(w[1:], others, strict=True)
    ]
    for a, mean, cov in parts:
        info[:n, :n] += a * inv(cov)
        vector[:n] += a * inv(cov) @ mean
    return inv(info) @ vector, inv(info)


@given(st.integers(0, 200), st.floats(0.05, 0.95), st.integers(1, 4), st.integers(0, 3))
def test_gaussians_are_fused_exactly(seed: int, omega: float, n: int, e: int) -> None:
    own = random_mixture(1, n + e, seed)
    other = random_mixture(1, n, seed + 1)
    mean, cov = by_information(own, 0, 0, [(other, 0)], [omega, 1 - omega])
    for fused in (
        fuse_mixtures(own, other, omega=omega),
        fuse_moments(own, other, omega=omega),
    ):
        assert np.allclose(fused.means[0], mean, rtol=1e-8, atol=1e-8)
        assert np.allclose(fused.covs[0], cov, rtol=1e-8, atol=1e-8)


def test_matched_terms_are_always_definite_and_others_may_fail() -> None:
    dropped = 0
    for seed in range(40):
        f = PartialFusion(
            random_mixture(3, 4, seed, 1.0), random_mixture(3, 2, 500 + seed, 1.0)
        )
        matched = f.component_shapes()
        every = f.component_shapes(terms="all")
        assert (
            matched.dropped == 0
            and matched.n_components == 9
            and every.n_components + every.dropped == 27
        )
        assert min(np.linalg.eigvalsh(s.covs).min() for s in (matched, every)) > 0
        dropped += every.dropped
    assert dropped > 0


def test_the_target_marginal_of_the_exact_density_by_quadrature() -> None:
    f = PartialFusion(random_mixture(2, 3, 5, 1.0), random_mixture(2, 2, 6, 1.0))
    e = np.linspace(-40, 40, 8001)
    for t in ([0.0, 0.5], [1.0, -1.0]):
        x = np.column_stack([np.broadcast_to(t, (e.size, 2)), e])
        mass = np.trapezoid(np.exp(f.log_value(x)), e)
        assert np.isclose(np.log(mass), f.log_target(np.array(t)), atol=1e-9)


def test_omega_at_its_ends() -> None:
    assert fuse_mixtures(OWN, OTHER, omega=1.0) is OWN
    other = random_mixture(1, 2, 8)
    same(
        fuse_mixtures(random_mixture(1, 4, 4), other, omega=0.0).marginal(TARGET), other
    )
    assert np.isfinite(
        PartialFusion(OWN, OTHER, omega=1.0).log_value(np.zeros((1, 4)))
    ).all()


def test_exponents_are_equal_by_default() -> None:
    others = [OTHER, random_mixture(2, 2, 3), random_mixture(1, 2, 4)]
    assert PartialFusion(OWN, others).exponents.tolist() == [0.25] * 4
    assert np.allclose(
        PartialFusion(OWN, others, omega=0.4).exponents, [0.4] + [0.2] * 3
    )
    same(fuse_moments(OWN, others), fuse_moments(OWN, others, omega=[0.25] * 4))
    with pytest.raises(ValueError, match="^omega must be 4 exponents, got 2"):
        PartialFusion(OWN, others, omega=[0.5, 0.5])
    with pytest.raises(ValueError, match="^heard must have target beliefs"):
        PartialFusion(OTHER, OWN)


def test_many_agents_in_one_pass_and_one_after_the_other() -> None:
    own = random_mixture(1, 5, 30)
    others = [random_mixture(1, 2, 31 + k) for k in range(3)]
    once = fuse_mixtures(own, others)
    for order in (others, others[::-1]):
        same(fuse_sequentially(own, order), once)
    halves = fuse_sequentially(own, others, omega=0.5, pair=fuse_moments)
    same(halves, fuse_mixtures(own, others, omega=[1 / 8, 1 / 8, 1 / 4, 1 / 2]))
    # With halves the order matters.
    assert not np.allclose(
        halves.means, fuse_sequentially(own, others[::-1], omega=0.5).means
    )


@pytest.mark.parametrize("terms", ["matched", "all"])
def test_three_mixtures_by_information(terms: str) -> None:
    third = random_mixture(3, 2, 9)
    f = PartialFusion(OWN, [OTHER, third], omega=[0.5, 0.2, 0.3])
    x = np.random.default_rng(0).standard_normal((5, 4))
    wanted = (
        OWN.log_density(x)
        - 0.5 * OWN.marginal(TARGET).log_density(x[:, :2])
        + 0.2 * OTHER.log_density(x[:, :2])
        + 0.3 * third.log_density(x[:, :2])
    )
    assert np.allclose(f.log_value(x), wanted, rtol=1e-12)
    shapes = f.component_shapes(terms=terms)
    wanted = []
    for q, p, r, s in np.ndindex(3, 3, 2, 3):
        mean, cov = by_information(OWN, q, p, [(OTHER, r), (third, s)], [0.5, 0.2, 0.3])
        if (terms == "all" or p == q) and np.linalg.eigvalsh(cov)[0] > 0:
            wanted.append((q, mean, cov))
    source, means, covs = (np.array(part) for part in zip(*wanted, strict=True))
    assert shapes.n_components + shapes.dropped == 3 * 2 * 3 * (
        3 if terms == "all" else 1
    )
    assert np.array_equal(shapes.source, source)
    assert np.allclose(shapes.means, means, rtol=1e-9, atol=1e-9)
    assert np.allclose(shapes.covs, covs, rtol=1e-9, atol=1e-9)


@ROWS
@pytest.mark.parametrize("terms", ["matched", "all"])
def test_fusion_in_other_coordinates_and_in_another_order(
    rule: str, terms: str
) -> None:
    others = [random_mixture(1, 2, 51), random_mixture(2, 2, 52)]
    fused = fuse_mixtures(OWN, others, rule=rule, terms=terms)
    same(fuse_mixtures(OWN, others[::-1], rule=rule, terms=terms), fused, 1e-6)
    same(
        fuse_mixtures(
            shuffled(OWN), [shuffled(m) for m in others], rule=rule, terms=terms
        ),
        fused,
        1e-6,
    )
    # Sigma points hang on the square root, which other coordinates turn unless they are scaled.
    matrix, shift = scales(4, target_dim=2)
    if rule == "points":
        matrix = np.diag(np.geomspace(1e-3, 1e5, 4))
    there = fuse_mixtures(
        affine(OWN, matrix, shift),
        [affine(m, matrix[:2, :2], shift[:2]) for m in others],
        rule=rule,
        terms=terms,
    )
    back = np.linalg.inv(matrix)
    same(affine(there, back, -back @ shift), fused, 1e-5)


@ROWS
def test_weights_are_the_printed_formulas(rule: str) -> None:
    """C1 and C2 at the means; least squares meet the density at means or sigma points."""
    f = PartialFusion(OWN, OTHER, omega=0.6)
    shapes = f.component_shapes()
    size = np.sqrt(np.linalg.det(2 * np.pi * shapes.covs))
    if rule in ("C1", "C2"):
        parts = np.exp(OWN.component_log_densities(shapes.means)) * OWN.weights
        own = (
            parts[np.arange(shapes.n_components), shapes.source]
            if rule == "C1"
            else parts.sum(axis=1)
        )
        update = f.log_value(shapes.means) - OWN.log_density(shapes.means)
        w = own * np.exp(update) * size
    else:
        root = 2 * np.linalg.cholesky(shapes.covs).mT
        at = np.concatenate([0 * root[:, :1], root, -root], axis=1)
        at = (
            shapes.means
            if rule == "C3"
            else (shapes.means[:, None] + at).reshape(-1, 4)
        )
        p = np.exp(f.log_value(at) - f.log_value(at).max())
        gap = at[:, None] - shapes.means
        square = (gap * np.linalg.solve(shapes.covs, gap[..., None])[..., 0]).sum(
            axis=-1
        )
        scale = np.ones(p.size) if rule == "C3" else 1 / np.sqrt(p + 1e-3)
        w = (
            nonnegative_least_squares(np.exp(-0.5 * square) * scale[:, None], p * scale)
            * size
        )
    assert np.allclose(
        f.assign_weights(shapes, rule=rule).weights, w[w > 0] / w.sum(), rtol=1e-6
    )


@pytest.mark.parametrize("condition", [15.0, 1.5])
def test_condition_of_least_squares(
    condition: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    a = (
        np.random.default_rng(0).uniform(size=(9, 4)) @ np.diag([1.0, 1.0, 1.0, 1e-6])
        + 1.0
    )
    s = np.linalg.svd(a, compute_uv=False)
    padded = np.concatenate([a, tikhonov(s[0], s[-1], condition=condition) * np.eye(4)])
    b = np.r_[a @ [1.0, 2.0, 0.5, 1.0], np.zeros(4)]
    w = nonnegative_least_squares(a, b[:9], condition=condition)
    slope = padded.T @ (padded @ w - b)
    # The conditions of Karush, Kuhn and Tucker.
    assert np.abs(slope[w > 0]).max() < 1e-9 and (slope[w == 0] > -1e-9).all()
    # Of the many solutions of fewer equations than unknowns the shortest.
    assert np.allclose(nonnegative_least_squares([[1.0, 2.0]], [5.0]), [1.0, 2.0])
    for part in (0.99, 1.01):  # a solver that stops short on either side
        monkeypatch.setattr(
            "scipy.optimize.nnls", lambda *_, maxiter, part=part: (part * w, 0.0)
        )
        assert np.allclose(
            nonnegative_least_squares(a, b[:9], condition=condition), w, rtol=1e-6
        )


def test_least_squares_have_a_limit() -> None:
    f = PartialFusion(random_mixture(5, 3, 1, 1.0), random_mixture(5, 2, 2, 1.0))
    shapes = f.component_shapes()
    c2 = f.assign_weights(f.component_shapes(), rule="C2")
    few = f.assign_weights(shapes, at_most=6).means
    best = c2.means[np.argsort(-c2.weights)[:6]]
    assert {tuple(m) for m in few} <= {tuple(m) for m in best}


@ROWS
@pytest.mark.parametrize("terms", ["matched", "all"])
def test_mixands_far_apart_leave_no_nan(rule: str, terms: str) -> None:
    own = GaussianMixture([0.5, 0.5], [[0.0, 0.0], [1e3, 0.0]], [np.eye(2), np.eye(2)])
    other = GaussianMixture([0.5, 0.5], [[0.0], [-1e3]], [[[1.0]], [[0.5]]])
    fused = fuse_mixtures(own, other, rule=rule, terms=terms)
    assert np.isfinite(fused.weights).all() and np.isclose(fused.weights.sum(), 1)
    assert np.isfinite(fused.log_density([0.0, 0.0]))
    assert fused.weights[np.abs(fused.means[:, 0]) < 1].sum() > 0.99


def test_average_keeps_the_conditional_and_averages_the_target() -> None:
    own = random_mixture(1, 4, 40)
    other = random_mixture(3, 2, 41)
    mixed = average_mixtures(own, other, omega=0.3)
    x = np.random.default_rng(0).standard_normal((20, 4)) * 2
    t = x[:, :2]
    wanted = np.logaddexp(
        np.log(0.3) + own.marginal(TARGET).log_density(t),
        np.log(0.7) + other.log_density(t),
    )
    target = mixed.marginal(TARGET).log_density(t)
    assert np.allclose(target, wanted, rtol=1e-10)
    given_t = own.log_density(x) - own.marginal(TARGET).log_density(t)
    assert np.allclose(mixed.log_density(x) - target, given_t, rtol=1e-9)
    several = random_mixture(3, 4, 42)
    mixed = average_mixtures(several, other)
    (matrix, shift) = scales(4, target_dim=2)
    # Own mixands take the heard ones by what each says of the heard mean, weight and density.
    near = several.weights * np.exp(
        several.marginal(TARGET).component_log_densities(other.means)
    )
    near *= 0.5 * (other.weights / near.sum(axis=1))[:, None]
    assert np.allclose(mixed.weights, [*(0.5 * several.weights), *near.ravel()])
    there = average_mixtures(
        affine(several, matrix, shift), affine(other, matrix[:2, :2], shift[:2])
    )
    same(there, affine(mixed, matrix, shift), 1e-7)


# ------------------------------------------------------------------------ over a channel

BELIEFS = [random_mixture(2, 3 + k, 80 + k) for k in range(3)]


def test_agents_fuse_the_marginals_of_whom_they_hear() -> None:
    channel = Channel(graphs.path(3))
    after = target_fusion(BELIEFS, channel, target_dim=2)
    said = [m.marginal(TARGET) for m in BELIEFS]
    heard = said[1], [said[0], said[2]], said[1]
    wanted = [
        fuse_mixtures(own, others) for own, others in zip(BELIEFS, heard, strict=True)
    ]
    for a, b in zip(after, wanted, strict=True):
        assert np.array_equal(a.means, b.means) and np.array_equal(a.weights, b.weights)
    # A mixand is a weight, two means and three entries of a covariance; 1 has two listeners.
    assert channel.ledger.scalars.tolist() == [12, 24, 12]


def test_what_is_fused_and_how_can_be_chosen() -> None:
    rule = partial(
        target_fusion, target_dim=2, fuse=partial(fuse_sequentially, pair=fuse_moments)
    )
    assert kind_of_rule(rule) == "mixtures"
    after = rule(BELIEFS, Channel(graphs.complete(3)))
    # Equal exponents in whatever order: everybody has the same Gaussian target.
    for m in after[1:]:
        assert np.allclose(m.means[0, :2], after[0].means[0, :2])
        assert np.allclose(m.covs[0, :2, :2], after[0].covs[0, :2, :2])


def test_who_hears_nothing_changes_nothing() -> None:
    after = target_fusion(
        BELIEFS, Channel(Graph.from_adjacency(np.zeros((3, 3)))), target_dim=2
    )
    assert all(a is b for a, b in zip(after, BELIEFS, strict=True))


def test_a_collapse_names_the_agent_the_mixand_and_the_cause() -> None:
    def naive(own: GaussianMixture, heard: list[GaussianMixture]) -> GaussianMixture:
        covs = own.covs.copy()
        covs[1] -= 2 * np.linalg.eigvalsh(covs[1])[0] * np.eye(own.dim)
        return GaussianMixture.construct(own.weights, own.means, covs)

    with pytest.raises(
        np.linalg.LinAlgError, match="^agent 0: mixand 1 of 2 .*independent"
    ):
        target_fusion(BELIEFS, Channel(graphs.path(3)), target_dim=2, fuse=naive)
