"""Partial-state fusion: identities, the two forms, definiteness, Table 1 and Table 2's pairs."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from distfilt.mixtures import (
    GaussianMixture,
    PartialFusion,
    Shapes,
    arc,
    average,
    fuse,
    fuse_in_turn,
    fuse_moments,
    jeffreys_by_sampling,
    jeffreys_of_many,
    kept_by_relevance,
    nonnegative_least_squares,
    pivoted_qr,
    runnalls,
    tikhonov,
)
from distfilt.mixtures.collocation import collocation_weights

from .examples import TARGET, pair, random_mixture, wide

OWN = random_mixture(3, 4, 1)
OTHER = random_mixture(2, 2, 2)
EXACT = PartialFusion(OWN, OTHER)
SHAPES = EXACT.shapes()

BAD_INPUT = {
    "distfilt.mixtures.fusion.PartialFusion": [
        ("own", lambda: PartialFusion(3, OTHER)),  # type: ignore[arg-type]
        ("heard", lambda: PartialFusion(OWN, [])),
        ("heard", lambda: PartialFusion(OWN, [OTHER, 3])),  # type: ignore[list-item]
        ("heard", lambda: PartialFusion(OWN, [OTHER, OTHER.marginal([0])])),
        ("heard", lambda: PartialFusion(OTHER, OWN)),
        ("omega", lambda: PartialFusion(OWN, OTHER, omega=1.1)),
        ("omega", lambda: PartialFusion(OWN, OTHER, omega=-0.1)),
        ("omega", lambda: PartialFusion(OWN, OTHER, omega=np.nan)),
        ("omega", lambda: PartialFusion(OWN, OTHER, omega="half")),
        ("omega", lambda: PartialFusion(OWN, OTHER, omega=[0.5, 0.4])),
        ("omega", lambda: PartialFusion(OWN, OTHER, omega=[[0.5, 0.4], [1.0]])),
        ("omega", lambda: PartialFusion(OWN, OTHER, omega=[0.5, 0.25, 0.25])),
    ],
    "distfilt.mixtures.fusion.PartialFusion.shapes": [
        ("terms", lambda: EXACT.shapes(terms="some")),
        ("form", lambda: EXACT.shapes(form="other")),
        ("marginal", lambda: EXACT.shapes(marginal=OTHER)),
        ("marginal", lambda: EXACT.shapes(terms="all", marginal=OWN)),
        ("received", lambda: EXACT.shapes(received=[OTHER, OTHER])),
        ("received", lambda: EXACT.shapes(received=[OWN])),
        ("received", lambda: EXACT.shapes(received=[None])),
        ("received", lambda: EXACT.shapes(received=3.5)),
    ],
    "distfilt.mixtures.fusion.PartialFusion.weigh": [
        ("shapes", lambda: EXACT.weigh(OWN)),  # type: ignore[arg-type]
        ("rule", lambda: EXACT.weigh(SHAPES, rule="C4")),
        ("at_most", lambda: EXACT.weigh(SHAPES, at_most=0)),
    ],
    "distfilt.mixtures.fusion.PartialFusion.log_value": [
        ("x", lambda: EXACT.log_value([1.0])),
        ("x", lambda: EXACT.log_value(np.full(4, 1e300))),
    ],
    "distfilt.mixtures.fusion.PartialFusion.log_update": [
        ("t", lambda: EXACT.log_update(np.full(2, 1e300))),
    ],
    "distfilt.mixtures.fusion.PartialFusion.log_target": [
        ("t", lambda: EXACT.log_target(np.full((5, 2), 1e300))),
    ],
    "distfilt.mixtures.fusion.PartialFusion.approximation": [
        ("size", lambda: EXACT.approximation(size="two")),
        ("size", lambda: EXACT.approximation(size=10**6 + 0.5)),
        ("terms", lambda: PartialFusion(OWN, OTHER, omega=1.0).approximation(terms="some")),
        ("rule", lambda: PartialFusion(OWN, OTHER, omega=1.0).approximation(rule="C9")),
    ],
    "distfilt.mixtures.fusion.fuse": [
        ("heard", lambda: fuse(OTHER, OWN)),
        ("size", lambda: fuse(OWN, OTHER, size=0)),
    ],
    "distfilt.mixtures.fusion.fuse_in_turn": [
        ("heard", lambda: fuse_in_turn(OWN, [])),
        ("heard", lambda: fuse_in_turn(OWN, 3)),  # type: ignore[arg-type]
        ("heard", lambda: fuse_in_turn(OTHER, OWN)),
        ("omega", lambda: fuse_in_turn(OWN, OTHER, omega="half")),
        ("omega", lambda: fuse_in_turn(OWN, OTHER, omega=1.5)),
        ("pair", lambda: fuse_in_turn(OWN, OTHER, pair=3)),  # type: ignore[arg-type]
    ],
    "distfilt.mixtures.fusion.fuse_moments": [("heard", lambda: fuse_moments(OTHER, OWN))],
    "distfilt.mixtures.fusion.average": [
        ("heard", lambda: average(OTHER, OWN)),
        ("omega", lambda: average(OWN, OTHER, omega=2.0)),
    ],
    "distfilt.mixtures.shapes.Shapes": [
        ("means", lambda: Shapes(np.empty((0, 1)), np.empty((0, 1, 1)), [])),
        ("covs", lambda: Shapes([[0.0]], [[[-1.0]]], [0])),
        ("source", lambda: Shapes([[0.0]], [[[1.0]]], [0, 1])),
        ("source", lambda: Shapes([[0.0]], [[[1.0]]], [-1])),
        ("source", lambda: Shapes([[0.0]], [[[1.0]]], [0.5])),
        ("source", lambda: Shapes([[0.0]], [[[1.0]]], [[0, 1], [0]])),
        ("source", lambda: Shapes([[0.0]], [[[1.0]]], [True])),
        ("dropped", lambda: Shapes([[0.0]], [[[1.0]]], [0], -1)),
    ],
    "distfilt.mixtures.shapes.Shapes.select": [
        ("keep", lambda: SHAPES.select([0.5])),
        ("keep", lambda: SHAPES.select([True])),
        ("keep", lambda: SHAPES.select([SHAPES.size])),
        ("keep", lambda: SHAPES.select([[0, 1], [0]])),
        ("keep", lambda: SHAPES.select(np.ma.masked_array([0], [True]))),
    ],
    "distfilt.mixtures.collocation.tikhonov": [
        ("largest", lambda: tikhonov(-1.0, 0.0)),
        ("smallest", lambda: tikhonov(1.0, 2.0)),
        ("condition", lambda: tikhonov(1.0, 0.0, condition=1.0)),
    ],
    "distfilt.mixtures.collocation.nonnegative_least_squares": [
        ("matrix", lambda: nonnegative_least_squares([1.0], [1.0])),
        ("right", lambda: nonnegative_least_squares([[1.0]], [1.0, 2.0])),
        ("condition", lambda: nonnegative_least_squares([[1.0]], [1.0], condition=0.5)),
    ],
    "distfilt.mixtures.collocation.collocation_weights": [
        ("rule", lambda: collocation_weights(
            SHAPES, OWN, EXACT.log_value, EXACT.log_update, 2, rule="C0")),
        ("at_most", lambda: collocation_weights(
            SHAPES, OWN, EXACT.log_value, EXACT.log_update, 2, at_most=1.5)),  # type: ignore[arg-type]
    ],
    "distfilt.mixtures.arcs.arc": [
        ("mixands", lambda: arc(1, [1, 0], angle_std=1, range_std=1, ego_std=1)),
        ("agent", lambda: arc(3, [0, 0], angle_std=1, range_std=1, ego_std=1)),
        ("angle_std", lambda: arc(3, [1, 0], angle_std=0, range_std=1, ego_std=1)),
        ("range_std", lambda: arc(3, [1, 0], angle_std=1, range_std=-1, ego_std=1)),
        ("ego_std", lambda: arc(3, [1, 0], angle_std=1, range_std=1, ego_std=0)),
        ("width", lambda: arc(3, [1, 0], angle_std=1, range_std=1, ego_std=1, width=0)),
        ("span", lambda: arc(3, [1, 0], angle_std=1, range_std=1, ego_std=1, span=0)),
    ],
}
EXEMPT = {"distfilt.mixtures.collocation.RULES": "a constant"}


def by_information(own: GaussianMixture, other: GaussianMixture, omega: float) -> Shapes:
    """The fused Gaussian of two Gaussians, from information matrices written out."""
    n, d = other.dim, own.dim
    info = np.linalg.inv(own.covs[0])
    vector = info @ own.means[0]
    target = np.linalg.inv(own.covs[0][:n, :n])
    there = np.linalg.inv(other.covs[0])
    info[:n, :n] += (omega - 1) * target + (1 - omega) * there
    vector[:n] += (omega - 1) * target @ own.means[0][:n] + (1 - omega) * there @ other.means[0]
    cov = np.linalg.inv(info)
    return Shapes((cov @ vector)[None], 0.5 * (cov + cov.T)[None].reshape(1, d, d), [0])


@given(st.integers(0, 200), st.floats(0.05, 0.95), st.integers(1, 4), st.integers(0, 3))
def test_gaussians_are_fused_exactly(seed: int, omega: float, n: int, e: int) -> None:
    own, other = random_mixture(1, n + e, seed), random_mixture(1, n, seed + 1)
    wanted = by_information(own, other, omega)
    got = fuse(own, other, omega=omega)
    assert np.allclose(got.means, wanted.means, rtol=1e-8, atol=1e-8)
    assert np.allclose(got.covs, wanted.covs, rtol=1e-8, atol=1e-8)
    moments = fuse_moments(own, other, omega=omega)
    assert np.allclose(moments.means, wanted.means, rtol=1e-8, atol=1e-8)


@pytest.mark.parametrize("terms", ["matched", "all"])
@pytest.mark.parametrize("omega", [0.2, 0.5, 0.9])
def test_conditional_form_is_the_literal_form(terms: str, omega: float) -> None:
    worst = 0.0
    for seed in range(8):
        f = PartialFusion(
            random_mixture(3, 5, seed), random_mixture(4, 2, 100 + seed), omega=omega
        )
        a, b = f.shapes(terms=terms), f.shapes(terms=terms, form="literal")
        if a.size != b.size:  # a term at the very edge of definiteness
            continue
        assert (a.source == b.source).all()
        scale = np.abs(b.covs).max(axis=(1, 2))
        well = np.linalg.cond(b.covs) < 1e4
        worst = max(worst, (np.abs(a.covs - b.covs).max(axis=(1, 2)) / scale)[well].max())
        gap = np.abs(a.means - b.means).max(axis=1) / (1 + np.abs(b.means).max(axis=1))
        worst = max(worst, gap[well].max())
    assert worst < 1e-12


def test_matched_terms_are_always_definite_and_others_may_fail() -> None:
    dropped = 0
    for seed in range(40):
        f = PartialFusion(random_mixture(3, 4, seed, 1.0), random_mixture(3, 2, 500 + seed, 1.0))
        matched = f.shapes()
        assert matched.dropped == 0 and matched.size == 9
        assert np.linalg.eigvalsh(matched.covs).min() > 0
        every = f.shapes(terms="all")
        assert every.size + every.dropped == 27
        assert np.linalg.eigvalsh(every.covs).min() > 0
        dropped += every.dropped
    assert dropped > 0


def test_the_counterexample_to_26() -> None:
    # q = 1 with P = 1, q' with P = 10, heard P = 100: 1/10 - 1/2 + 1/200 = -.395.
    own = GaussianMixture([0.5, 0.5], [[0.0], [0.0]], [[[1.0]], [[10.0]]])
    f = PartialFusion(own, GaussianMixture.gaussian([0.0], [[100.0]]))
    every = f.shapes(terms="all")
    assert every.dropped == 1 and f.shapes().dropped == 0
    # Information 1 + .5 (.01 - .1), 1 - .5 + .005, and 0.1 - .05 + .005.
    assert np.allclose(np.sort(1 / every.covs.ravel()), [0.055, 0.505, 0.955])


def test_order_of_the_terms_and_their_sources() -> None:
    every = EXACT.shapes(terms="all")
    if every.dropped == 0:
        assert every.source.tolist() == np.repeat(np.arange(3), 6).tolist()
    assert EXACT.shapes().source.tolist() == [0, 0, 1, 1, 2, 2]


def test_target_marginals_agree_when_the_weights_sum_to_one() -> None:
    one, two = pair("A")
    t = np.random.default_rng(0).standard_normal((200, 2)) * 2
    for omega in (0.3, 0.5):
        first = PartialFusion(one, two.marginal(TARGET), omega=omega)
        second = PartialFusion(two, one.marginal(TARGET), omega=1 - omega)
        gap = first.log_target(t) - second.log_target(t)
        assert np.ptp(gap) < 1e-10
        assert np.abs(gap).max() < 1e-10


def test_the_target_marginal_of_the_exact_density_by_quadrature() -> None:
    f = PartialFusion(random_mixture(2, 3, 5, 1.0), random_mixture(2, 2, 6, 1.0))
    e = np.linspace(-40, 40, 8001)
    for t in ([0.0, 0.5], [1.0, -1.0]):
        x = np.column_stack([np.broadcast_to(t, (e.size, 2)), e])
        mass = np.trapezoid(np.exp(f.log_value(x)), e)
        assert np.isclose(np.log(mass), f.log_target(np.array(t)), atol=1e-9)


def test_identical_beliefs_change_nothing() -> None:
    own = random_mixture(3, 4, 11)
    f = PartialFusion(own, own.marginal(TARGET), omega=0.4)
    x = np.random.default_rng(1).standard_normal((50, 4)) * 3
    assert np.abs(f.log_value(x) - own.log_density(x)).max() < 1e-10
    fused = f.approximation()
    d = jeffreys_by_sampling(
        fused.log_density, own.log_density, own, members=4000, rng=np.random.default_rng(2)
    )
    assert d.value < 1e-4
    single = random_mixture(1, 3, 3)
    again = fuse(single, single.marginal([0]))
    assert np.allclose(again.means, single.means) and np.allclose(again.covs, single.covs)


def test_omega_at_its_ends() -> None:
    assert fuse(OWN, OTHER, omega=1.0) is OWN
    other = GaussianMixture.gaussian([1.0, -1.0], [[1.0, 0.3], [0.3, 2.0]])
    own = random_mixture(1, 4, 4)
    alone = fuse(own, other, omega=0.0)
    assert np.allclose(alone.marginal(TARGET).means, other.means)
    assert np.allclose(alone.marginal(TARGET).covs, other.covs)
    x = np.zeros((1, 4))
    assert np.isfinite(PartialFusion(OWN, OTHER, omega=1.0).log_value(x)).all()


def test_ego_states_of_different_size_and_no_ego_state_at_all() -> None:
    t1, t2 = random_mixture(2, 2, 20, 1.0), random_mixture(2, 3, 21, 1.0)
    fused = fuse(t2, t1)
    assert fused.dim == 3
    bare = fuse(t1, t2.marginal(TARGET))
    x = np.random.default_rng(4).standard_normal((30, 2))
    f = PartialFusion(t1, t2.marginal(TARGET))
    exact = f.log_value(x)
    assert bare.dim == 2 and np.std(bare.log_density(x) - exact) < 1.0


def test_many_agents_in_one_pass_and_one_after_the_other() -> None:
    own = random_mixture(1, 5, 30)
    others = [random_mixture(1, 2, 31 + k) for k in range(3)]
    once = fuse(own, others, omega="equal")
    for order in (others, others[::-1]):
        folded = fuse_in_turn(own, order)
        assert np.allclose(once.means, folded.means, rtol=1e-9)
        assert np.allclose(once.covs, folded.covs, rtol=1e-9)
    exact = fuse(own, others, omega=[0.25] * 4)
    assert np.array_equal(once.means, exact.means)
    halves = fuse_in_turn(own, others, omega=0.5, pair=fuse_moments)
    uneven = fuse(own, others, omega=[1 / 8, 1 / 8, 1 / 4, 1 / 2])
    assert np.allclose(halves.means, uneven.means) and np.allclose(halves.covs, uneven.covs)
    # With halves the order matters.
    back = fuse_in_turn(own, others[::-1], omega=0.5)
    assert not np.allclose(halves.means, back.means)


def test_equal_exponents_give_all_agents_one_target() -> None:
    beliefs = [random_mixture(1, 4 + k, 60 + k) for k in range(3)]
    said = [m.marginal(TARGET) for m in beliefs]
    fused = [
        fuse(m, said[:k] + said[k + 1 :], omega="equal").marginal(TARGET)
        for k, m in enumerate(beliefs)
    ]
    for other in fused[1:]:
        assert np.allclose(other.means, fused[0].means) and np.allclose(other.covs, fused[0].covs)


def test_mixtures_in_turn_are_near_the_one_pass() -> None:
    own, others = random_mixture(2, 3, 70, 1.0), [random_mixture(2, 2, 71 + k, 1.0) for k in (0, 1)]
    exact = PartialFusion(own, others, omega="equal")
    turn = fuse_in_turn(own, others)
    found = jeffreys_by_sampling(
        turn.log_density, exact.log_value, wide(turn, own), members=4000,
        rng=np.random.default_rng(0),
    )
    assert found.value < 0.1


def test_three_mixtures_have_all_combinations() -> None:
    f = PartialFusion(OWN, [OTHER, random_mixture(3, 2, 9)], omega=[0.5, 0.2, 0.3])
    assert f.shapes().size == 3 * 2 * 3
    x = np.random.default_rng(0).standard_normal((5, 4))
    wanted = (
        OWN.log_density(x) - 0.5 * OWN.marginal(TARGET).log_density(x[:, :2])
        + 0.2 * OTHER.log_density(x[:, :2]) + 0.3 * f.heard[1].log_density(x[:, :2])
    )
    assert np.allclose(f.log_value(x), wanted, rtol=1e-12)
    literal = f.shapes(form="literal")
    assert np.allclose(literal.means, f.shapes().means, rtol=1e-6, atol=1e-6)


def test_c1_and_c2_are_the_printed_formulas() -> None:
    f = PartialFusion(OWN, OTHER, omega=0.6)
    shapes = f.shapes()
    g = np.exp(f.log_update(shapes.means[:, :2]))
    size = np.sqrt(np.linalg.det(2 * np.pi * shapes.covs))
    parts = np.exp(OWN.component_log_densities(shapes.means)) * OWN.weights
    c1 = parts[np.arange(shapes.size), shapes.source] * g * size
    c2 = parts.sum(axis=1) * g * size
    assert np.allclose(f.weigh(shapes, rule="C1").weights, c1 / c1.sum(), rtol=1e-9)
    assert np.allclose(f.weigh(shapes, rule="C2").weights, c2 / c2.sum(), rtol=1e-9)


def test_c3_meets_the_density_at_the_means_where_it_can() -> None:
    # Mixands well apart: (32) has a positive solution, and the mixture the density at each mean.
    own = GaussianMixture([0.3, 0.7], [[0.0, 1.0], [9.0, 2.0]], [np.eye(2), 2 * np.eye(2)])
    f = PartialFusion(own, GaussianMixture([0.5, 0.5], [[0.5], [8.0]], [[[1.0]], [[1.5]]]))
    shapes = f.shapes()
    fused = f.weigh(shapes, rule="C3")
    gap = fused.log_density(fused.means) - f.log_value(fused.means)
    heavy = fused.weights > 1e-3
    assert heavy.sum() == 2 and np.ptp(gap[heavy]) < 1e-5


def test_least_squares_have_a_limit() -> None:
    f = PartialFusion(random_mixture(5, 3, 1, 1.0), random_mixture(5, 2, 2, 1.0))
    few = f.weigh(f.shapes(), at_most=6)
    assert few.size <= 6 and np.isclose(few.weights.sum(), 1)


def test_mixands_far_apart_leave_no_nan() -> None:
    own = GaussianMixture([0.5, 0.5], [[0.0, 0.0], [1e3, 0.0]], [np.eye(2), np.eye(2)])
    other = GaussianMixture([0.5, 0.5], [[0.0], [-1e3]], [[[1.0]], [[0.5]]])
    for rule in ("C1", "C2", "C3", "points"):
        for terms in ("matched", "all"):
            fused = fuse(own, other, rule=rule, terms=terms)
            assert np.isfinite(fused.weights).all() and np.isclose(fused.weights.sum(), 1)
            assert np.isfinite(fused.log_density([0.0, 0.0]))
            assert fused.weights[np.abs(fused.means[:, 0]) < 1].sum() > 0.99


def test_average_keeps_the_conditional_and_averages_the_target() -> None:
    own, other = random_mixture(1, 4, 40), random_mixture(3, 2, 41)
    mixed = average(own, other, omega=0.3)
    t = np.random.default_rng(0).standard_normal((20, 2)) * 2
    wanted = np.logaddexp(
        np.log(0.3) + own.marginal(TARGET).log_density(t), np.log(0.7) + other.log_density(t)
    )
    assert np.allclose(mixed.marginal(TARGET).log_density(t), wanted, rtol=1e-10)
    x = np.random.default_rng(1).standard_normal(4)
    given_t = own.conditional(TARGET, x[:2]).log_density(x[2:])
    assert np.isclose(
        mixed.log_density(x) - mixed.marginal(TARGET).log_density(x[:2]), given_t, rtol=1e-9
    )
    several = average(random_mixture(3, 4, 42), other)
    assert np.isclose(several.weights.sum(), 1)
    assert several.moments()[0].shape == (4,)


def test_conditional_form_holds_in_units_where_the_literal_one_fails() -> None:
    # The same beliefs in metres and in gigametres: the conditional form scales with them.
    f = PartialFusion(random_mixture(2, 4, 50), random_mixture(2, 2, 51))
    unit = np.array([1e3, 1e-6, 1e3, 1e-6])

    def scaled(p: GaussianMixture, by: np.ndarray) -> GaussianMixture:
        return GaussianMixture(p.weights, p.means * by, p.covs * by[:, None] * by)

    other = PartialFusion(scaled(f.own, unit), scaled(f.heard[0], unit[:2]))
    a, b = f.shapes(), other.shapes()
    assert np.allclose(a.means * unit, b.means, rtol=1e-9)
    assert np.allclose(a.covs * unit[:, None] * unit, b.covs, rtol=1e-8)


def both(which: str, terms: str, rule: str) -> tuple[list[PartialFusion], list[GaussianMixture]]:
    one, two = pair(which)
    exact = [PartialFusion(one, two.marginal(TARGET)), PartialFusion(two, one.marginal(TARGET))]
    return exact, [f.weigh(f.shapes(terms=terms), rule=rule) for f in exact]


def divergences(
    exact: list[PartialFusion], fused: list[GaussianMixture], members: int = 20_000
) -> np.ndarray:
    """d1, d2 and the target's disagreement, with their errors, (2, 3)."""
    rng = np.random.default_rng(7)
    found = [
        jeffreys_by_sampling(m.log_density, f.log_value, wide(m, f.own), members=members, rng=rng)
        for f, m in zip(exact, fused, strict=True)
    ]
    a, b = (m.marginal(TARGET) for m in fused)
    apart = wide(a, b, 0.5)
    found.append(
        jeffreys_by_sampling(a.log_density, b.log_density, apart, members=members, rng=rng)
    )
    return np.array([[d.value for d in found], [d.error for d in found]])


TABLE_1 = {
    ("all", "C1"): (0.10262, 0.06793, 0.05014),
    ("all", "C2"): (0.09904, 0.06116, 0.04700),
    ("all", "C3"): (0.02173, 0.01357, 0.01505),
    ("matched", "C3"): (0.01385, 0.01127, 0.00199),
}
BOX = {
    0: ([-3.5, -3.5, -12.5, -3], [4, 2.5, -8, 3]),
    1: ([-3, -3, -3.5, -10], [4, 3.5, 2.5, -5.5]),
}


@pytest.mark.parametrize(("terms", "rule"), TABLE_1)
def test_pair_a_by_sampling(terms: str, rule: str) -> None:
    values, errors = divergences(*both("A", terms, rule))
    wanted = np.array(TABLE_1[terms, rule])
    assert (np.abs(values - wanted) < 0.05 * wanted + 3 * errors).all()


def test_sigma_points_beat_c3_on_pair_a() -> None:
    points, _ = divergences(*both("A", "matched", "points"))
    plain, _ = divergences(*both("A", "matched", "C3"))
    assert (points < plain).all()


@pytest.mark.slow
def test_pair_a_by_quadrature() -> None:
    exact, _ = both("A", "matched", "C2")
    fused = {key: both("A", *key)[1] for key in TABLE_1}
    got = {}
    for n in (30, 50):
        # The exact density is evaluated once a slice for all four approximations.
        found = [
            jeffreys_of_many(
                exact[k].log_value, [m[k].log_density for m in fused.values()], *BOX[k], nodes=n
            )
            for k in (0, 1)
        ]
        targets = [[m.marginal(TARGET).log_density for m in pair] for pair in fused.values()]
        found.append([
            jeffreys_of_many(a, [b], [-4, -4], [5, 4], nodes=4 * n)[0] for a, b in targets
        ])
        got[n] = np.array([[d.value for d in column] for column in found]).T
    wanted = np.array(list(TABLE_1.values()))
    assert np.allclose(got[50], wanted, rtol=0.03)
    assert np.allclose(got[30], got[50], rtol=2e-3)
    sampled = [divergences(exact, pair, 100_000)[0] for pair in fused.values()]
    assert np.allclose(sampled, got[50], rtol=0.05)


def test_pair_b_orders_the_reductions() -> None:
    one, two = pair("B")
    exact, _ = both("B", "matched", "C2")
    marginals = [one.marginal(TARGET), two.marginal(TARGET)]
    kept = [kept_by_relevance(marginals[k], marginals[1 - k], threshold=2.0) for k in (0, 1)]
    cheap = [runnalls(marginals[k], kept[k].size) for k in (0, 1)]
    assert [m.size for m in kept] == [2, 3]

    def through(reduced: list[GaussianMixture]) -> tuple[np.ndarray, np.ndarray]:
        shapes = [
            f.shapes(terms="all", marginal=reduced[k], received=[reduced[1 - k]])
            for k, f in enumerate(exact)
        ]
        fused = [f.weigh(s) for f, s in zip(exact, shapes, strict=True)]
        return divergences(exact, fused)

    by_kld, by_runnalls = through(kept)[0], through(cheap)[0]
    pivoted = [
        f.weigh(pivoted_qr(f.shapes(terms="all"), size=n))
        for f, n in zip(exact, (40, 48), strict=True)
    ]
    by_qr = divergences(exact, pivoted)[0]
    assert (by_kld <= by_runnalls).all()
    assert (by_qr[:2] >= 2 * by_runnalls[:2]).all() and (by_qr[:2] >= 2 * by_kld[:2]).all()


def test_the_literal_form_says_where_it_has_no_inverse() -> None:
    # The own target marginal is what is heard, so that the update's information is zero.
    own = GaussianMixture.gaussian([0.5, 1.0], [[4.0, 1.0], [1.0, 2.0]])
    fused = PartialFusion(own, own.marginal([0]), omega=0.5)
    assert np.allclose(fused.shapes().means, own.means)
    with pytest.raises(np.linalg.LinAlgError, match="^form: .*'conditional'"):
        fused.shapes(form="literal")
