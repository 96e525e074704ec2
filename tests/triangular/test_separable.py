"""Separable triangular maps: the convex program's minimum, sparsity, and safe inversion."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import norm

from distfilt.triangular import affine, compose
from distfilt.triangular.separable import SeparableMap, fit, invert
from tests.triangular.samples import banana, rng_of

_Y, _X, _ = banana(9, 60)


@given(st.integers(0, 10_000), st.integers(0, 3), st.integers(1, 4))
def test_order_zero_is_the_affine_map(seed: int, m: int, d: int) -> None:
    rng = rng_of(seed)
    mixing = np.eye(m + d) + 0.3 * rng.standard_normal((m + d, m + d))
    z = 5 + rng.standard_normal((60, m + d)) @ mixing * np.logspace(-1, 1, m + d)
    y = z[:, :m]
    x = z[:, m:]
    ours = fit(y, x, order=0)
    theirs = affine.fit(y, x)
    assert np.abs(ours(y, x) - theirs(y, x)).max() < 1e-8
    assert np.abs(ours.log_det(y, x) - theirs.log_det(y, x)).max() < 1e-8
    assert np.abs(compose(ours, y, x, y[0]) - compose(theirs, y, x, y[0])).max() < 1e-8


def test_a_large_penalty_gives_the_affine_map() -> None:
    ours = fit(_Y, _X, order=2, regularisation=1e9)
    theirs = affine.fit(_Y, _X)
    assert np.abs(ours(_Y, _X) - theirs(_Y, _X)).max() < 1e-6


@given(st.integers(0, 10_000), st.integers(1, 4), st.integers(0, 4))
def test_map_increases_inverts_and_is_triangular(seed: int, p: int, q: int) -> None:
    y, x, _ = banana(seed)
    s = fit(y, x, order=(p, q))
    z = s(y, x)
    assert np.abs(s.inverse(y, z) - x).max() < 1e-9
    assert all((a >= 0).all() and a[0] >= 0.1 for a in s.slopes)
    moved = x.copy()
    moved[:, 1] += 1.0
    assert (s(y, moved)[:, 0] == z[:, 0]).all() and (s(y, moved)[:, 1] > z[:, 1]).all()


def test_batched_fit_is_each_run_s() -> None:
    y, x, _ = banana(4, 100, (2, 3))
    whole = fit(y, x, order=2)
    one = fit(y[1, 2], x[1, 2], order=2)
    z = whole(y, x)
    assert np.abs(z[1, 2] - one(y[1, 2], x[1, 2])).max() < 1e-7
    assert np.abs(whole.inverse(y, z) - x).max() < 1e-9
    aim = y[..., 0, :]
    assert (
        np.abs(whole.inverse(aim, z)[1, 2] - one.inverse(aim[1, 2], z[1, 2])).max()
        < 1e-6
    )


def test_sparse_components_do_not_see_what_they_leave_out() -> None:
    y, x, _ = banana(7)
    s = fit(y, x, order=2, uses=[[], [1]])
    alone = fit(y[:, :0], x, order=2)
    assert s.weights[0].shape == (1,) and s.weights[1].shape == (4,)
    assert np.allclose(s(y, x), alone(y[:, :0], x), atol=1e-12)
    assert fit(y[:8], x[:8], order=2, uses=[[], [0]])(y, x).shape == x.shape
    assert (s(y + 1, x) == s(y, x)).all()
    full = fit(y, x, order=2)
    assert affine.objective(full, y, x) <= affine.objective(s, y, x)
    # Fewer members than variables: enough, if each component uses few of them.
    wide = rng_of(1).standard_normal((20, 30))
    chain = fit(wide[:, :0], wide, order=1, uses=[[], *([k] for k in range(29))])
    assert np.isfinite(chain(wide[:, :0], wide)).all()


def test_inverse_reaches_far_beyond_the_samples() -> None:
    y, x, _ = banana(8)
    s = fit(y, x, order=3)
    z = 50 * rng_of(1).standard_normal((100, 2))
    far = s.inverse([30.0], z)
    assert np.abs(s(np.full((100, 1), 30.0), far) - z).max() < 1e-8


def _features(s: SeparableMap, v: np.ndarray, k: int) -> tuple[np.ndarray, ...]:
    """Component k's features of earlier variables, of its own, and the own ones' slopes."""
    used = s.uses[k]
    own = v[:, v.shape[1] - len(s.uses) + k]
    bumps = [
        np.exp(-0.5 * ((v[:, u] - at) / w) ** 2)
        for u in used
        for at, w in s.bumps[:, u].T
    ]
    steps = [
        np.sqrt(2 * np.pi) * w * norm.cdf((own - at) / w) for at, w in s.steps[:, k].T
    ]
    rates = [np.exp(-0.5 * ((own - at) / w) ** 2) for at, w in s.steps[:, k].T]
    one = np.ones(len(v))
    before = np.column_stack([one, *v[:, used].T, *bumps])
    return before, np.column_stack([own, *steps]), np.column_stack([one, *rates])


def _by_hand() -> tuple[SeparableMap, np.ndarray]:
    """m = 1, d = 2, two bumps of each variable and two steps of each component, all different."""
    bumps = np.array(
        [[[-0.5, 0.6], [-0.4, 0.3], [0.1, 0.9]], [[0.7, 0.5], [0.8, 1.1], [0.6, 0.9]]]
    )
    steps = np.array([[[-0.7, 0.2], [0.4, 1.3]], [[0.5, 0.9], [0.8, 0.6]]])
    weights = [
        np.array([0.3, -0.8, 0.5, -0.2]),
        np.array([-0.1, 0.7, 0.4, 0.6, -0.5, 0.25, 0.9]),
    ]
    slopes = [np.array([0.9, 0.3, 0.2]), np.array([0.4, 0.0, 1.1])]
    centre = np.array([0.5, -1.0, 2.0])
    spread = np.array([2.0, 0.5, 1.5])
    made = SeparableMap(1, centre, spread, bumps, steps, [[0], [0, 1]], weights, slopes)
    return made, np.array([[1.2, -0.7, 2.6], [-3.0, -1.4, 0.5], [0.5, -1.0, 5.0]])


def test_hand_set_coefficients_against_the_formula() -> None:
    """Constant, lines, every bump of earlier variables, line and integrated bumps of the own."""
    s, points = _by_hand()
    out = s(points[:, :1], points[:, 1:])
    slope = s.log_det(points[:, :1], points[:, 1:])
    rates = np.zeros(3)
    for k in range(2):
        before, own, rate = _features(s, (points - s.centre) / s.std, k)
        assert (
            np.abs(out[:, k] - before @ s.weights[k] - own @ s.slopes[k]).max() < 1e-12
        )
        rates += np.log(rate @ s.slopes[k] / s.std[1 + k])
    assert np.abs(slope - rates).max() < 1e-12
    assert np.abs(s.inverse(points[:, :1], out) - points[:, 1:]).max() < 1e-12


@pytest.mark.parametrize("penalty", [0.0, 0.05])
def test_fit_minimises_a_program_built_by_hand(penalty: float) -> None:
    """No feature of the library's: the loss at its coefficients is below that of all neighbours."""
    y, x, _ = banana(32, 150)
    s = fit(y, x, order=2, regularisation=penalty)
    before, own, rates = _features(s, (np.hstack([y, x]) - s.centre) / s.std, 1)
    size = before.shape[1]

    def loss(c: np.ndarray) -> float:
        value = before @ c[:size] + own @ c[size:]
        extra = (c[3:size] ** 2).sum() + (c[size + 1 :] ** 2).sum()
        cost = 0.5 * value**2 - np.log(rates @ c[size:])
        return float(cost.mean() + 0.5 * penalty * extra)

    best = np.r_[s.weights[1], s.slopes[1]]
    least = np.r_[np.full(size, -np.inf), 0.1, np.zeros(own.shape[1] - 1)]
    for step in np.concatenate([1e-4 * np.eye(best.size), -1e-4 * np.eye(best.size)]):
        assert (best + step < least).any() or loss(best + step) > loss(best)


def test_fitted_bumps_stand_at_quantiles() -> None:
    """Centres at the n quantiles of each standardised variable, widths between the half steps."""
    y, x, _ = banana(31, 200)
    s = fit(y, x, order=(2, 3))
    joint = np.hstack([y, x])
    joint = (joint - joint.mean(axis=0)) / joint.std(axis=0)
    for v in range(3):
        quantile = np.quantile(joint[:, v], np.arange(1, 6) / 6)
        assert np.allclose(s.bumps[0, v], quantile[[1, 3]])
        assert np.allclose(s.bumps[1, v], quantile[[2, 4]] - quantile[[0, 2]])
    for k in range(2):
        quantile = np.quantile(joint[:, 1 + k], np.arange(1, 8) / 8)
        assert np.allclose(s.steps[0, k], quantile[[1, 3, 5]])
        assert np.allclose(s.steps[1, k], quantile[[2, 4, 6]] - quantile[[0, 2, 4]])


def _one(*slopes: float) -> SeparableMap:
    """A map of one variable, of a line and one step."""
    step = np.array([[[0.0]], [[1.0]]])
    return SeparableMap(
        0,
        np.zeros(1),
        np.ones(1),
        np.empty((2, 1, 0)),
        step,
        [[]],
        [np.zeros(1)],
        [np.array(slopes)],
    )


def test_inverse_of_a_map_that_hardly_has_a_line() -> None:
    """A line so flat that its ends are far away."""
    for flat in (1e-9, 1e-3):
        z = _one(flat, 1.0)(np.empty((3, 0)), [[-1.0], [0.3], [1.5]])
        assert (
            np.abs(_one(flat, 1.0).inverse([], z) - [[-1.0], [0.3], [1.5]]).max() < 1e-9
        )


# ------------------------------------------------------------------------------- inversion


def _ends(target: np.ndarray, far: float = 64.0) -> tuple[np.ndarray, np.ndarray]:
    return np.full(target.shape, -far), np.full(target.shape, far)


def test_a_separable_map_is_inverted_in_few_evaluations(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    y, x, _ = banana(1, 500)
    s = fit(y, x, order=3)
    z = s(y, x)
    calls = []
    own = SeparableMap._increasing_part

    def counted(
        self: SeparableMap, v: np.ndarray, k: int
    ) -> tuple[np.ndarray, np.ndarray]:
        calls.append(k)
        return own(self, v, k)

    monkeypatch.setattr(SeparableMap, "_increasing_part", counted)
    assert np.abs(s.inverse(y, z) - x).max() < 1e-12
    assert len(calls) <= 2 * 10


@given(st.floats(-3, 3), st.floats(0.02, 50))
def test_newton_s_method_may_not_go_to_and_fro(target: float, steep: float) -> None:
    """arctan makes Newton's method jump from side to side; a step must halve or is replaced."""

    def bend(v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        u = steep * v
        return np.arctan(u) + 1e-3 * v, steep / (1 + u**2) + 1e-3

    v = invert(bend, np.array([target]), *_ends(np.zeros(1), 1e4))
    assert abs(bend(v)[0][0] - target) < 1e-9


def test_the_tolerance_is_relative_to_the_value() -> None:
    """At 1e8 two neighbouring numbers are 1.5e-8 apart: no step is ever below 1e-13."""
    target = np.array([1e24 + 1e8, -1e24 - 1e8])
    v = invert(lambda v: (v**3 + v, 3 * v**2 + 1), target, *_ends(target, 1e9))
    assert np.allclose(v, [1e8, -1e8], rtol=1e-13)
