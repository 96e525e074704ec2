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


# ---------------------------------------------------------------------------- affine cases


@given(st.integers(0, 10_000), st.integers(0, 3), st.integers(1, 4))
def test_order_zero_is_the_affine_map(seed: int, m: int, d: int) -> None:
    """Without bumps: its values, log-determinants and composed map."""
    rng = rng_of(seed)
    size = m + d
    perturbation = rng.standard_normal((size, size))
    mixing = np.eye(size) + 0.3 * perturbation
    units = np.logspace(-1, 1, size)
    z = 5 + rng.standard_normal((60, size)) @ mixing * units
    y = z[:, :m]
    x = z[:, m:]
    s = fit(y, x, order=0)
    expected = affine.fit(y, x)
    value_error = s(y, x) - expected(y, x)
    assert np.abs(value_error).max() < 1e-8
    log_det_error = s.log_det(y, x) - expected.log_det(y, x)
    assert np.abs(log_det_error).max() < 1e-8
    expected_members = compose(expected, y, x, y[0])
    difference = compose(s, y, x, y[0]) - expected_members
    assert np.abs(difference).max() < 1e-8


def test_a_large_penalty_gives_the_affine_map() -> None:
    """The penalty is on the bumps only."""
    s = fit(_Y, _X, order=2, regularisation=1e9)
    expected = affine.fit(_Y, _X)
    error = s(_Y, _X) - expected(_Y, _X)
    assert np.abs(error).max() < 1e-6


# ------------------------------------------------------------------------------ properties


@given(st.integers(0, 10_000), st.integers(1, 4), st.integers(0, 4))
def test_a_map_increases_inverts_and_is_triangular(seed: int, p: int, q: int) -> None:
    """The second component increases in x_2, and the first does not depend on it."""
    y, x, _ = banana(seed)
    s = fit(y, x, order=(p, q))
    z = s(y, x)
    inverse_error = s.inverse(y, z) - x
    assert np.abs(inverse_error).max() < 1e-9
    for slopes in s.slopes:
        # Nonnegative steps and a line of slope 0.1 or more: each component increases.
        assert (slopes >= 0).all()
        assert slopes[0] >= 0.1
    shifted = x.copy()
    shifted[:, 1] += 1.0
    shifted_z = s(y, shifted)
    assert (shifted_z[:, 0] == z[:, 0]).all()
    assert (shifted_z[:, 1] > z[:, 1]).all()


def test_a_batched_fit_is_each_ensemble_s() -> None:
    """Values and inverses, also of one observation for all members."""
    y, x, _ = banana(4, 100, (2, 3))
    batch = fit(y, x, order=2)
    single = fit(y[1, 2], x[1, 2], order=2)
    z = batch(y, x)
    expected = single(y[1, 2], x[1, 2])
    assert np.abs(z[1, 2] - expected).max() < 1e-7
    inverse_error = batch.inverse(y, z) - x
    assert np.abs(inverse_error).max() < 1e-9
    # One observation for all members of an ensemble
    observed = y[..., 0, :]
    inverse = batch.inverse(observed, z)[1, 2]
    expected = single.inverse(observed[1, 2], z[1, 2])
    assert np.abs(inverse - expected).max() < 1e-6


def test_sparse_components_do_not_depend_on_other_variables() -> None:
    """Components that use no observation are those of a fit without observations."""
    y, x, _ = banana(7)
    s = fit(y, x, order=2, uses=[[], [1]])
    without_y = fit(y[:, :0], x, order=2)
    # A constant; and a constant, a line and two bumps of x_1.
    assert s.weights[0].shape == (1,)
    assert s.weights[1].shape == (4,)
    expected = without_y(y[:, :0], x)
    assert np.allclose(s(y, x), expected, atol=1e-12)
    assert (s(y + 1, x) == s(y, x)).all()
    # The full map has the sparse one as a special case.
    full = fit(y, x, order=2)
    full_value = affine.objective(full, y, x)
    assert full_value <= affine.objective(s, y, x)


def test_sparse_components_need_few_members() -> None:
    """Fewer members than variables are enough if each component uses few of them."""
    y, x, _ = banana(7)
    few = fit(y[:8], x[:8], order=2, uses=[[], [0]])
    assert few(y, x).shape == x.shape
    wide = rng_of(1).standard_normal((20, 30))
    chain = [[], *([k] for k in range(29))]
    s = fit(wide[:, :0], wide, order=1, uses=chain)
    assert np.isfinite(s(wide[:, :0], wide)).all()


def test_the_inverse_extends_far_beyond_the_samples() -> None:
    """A line's coefficient of 0.1 or more gives every component the whole line as its range."""
    y, x, _ = banana(8)
    s = fit(y, x, order=3)
    z = 50 * rng_of(1).standard_normal((100, 2))
    members = s.inverse([30.0], z)
    observed = np.full((100, 1), 30.0)
    error = s(observed, members) - z
    assert np.abs(error).max() < 1e-8


# ------------------------------------------------------------------------- the formula


def _features(s: SeparableMap, v: np.ndarray, k: int) -> tuple[np.ndarray, ...]:
    """Return component k's features by the formula, of standardised variables (N, m + d).

    Those of earlier variables, those of its own variable, and the derivatives of the latter.
    """
    used = s.uses[k]
    # The state's variables are the last ones.
    n_observed = v.shape[1] - len(s.uses)
    own_values = v[:, n_observed + k]
    bumps = []
    for variable in used:
        for centre, width in s.bumps[:, variable].T:
            # exp(-½ u²)
            u = (v[:, variable] - centre) / width
            bumps.append(np.exp(-0.5 * u**2))
    integrals = []
    derivatives = []
    for centre, width in s.steps[:, k].T:
        u = (own_values - centre) / width
        # ∫ exp(-½ u²) = √(2 π) σ Φ(u)
        scale = np.sqrt(2 * np.pi) * width
        integrals.append(scale * norm.cdf(u))
        derivatives.append(np.exp(-0.5 * u**2))
    ones = np.ones(len(v))
    earlier = np.column_stack([ones, *v[:, used].T, *bumps])
    increasing = np.column_stack([own_values, *integrals])
    rates = np.column_stack([ones, *derivatives])
    return earlier, increasing, rates


def _map_by_hand() -> tuple[SeparableMap, np.ndarray]:
    """Return a map and three points: m = 1, d = 2, two bumps and steps each, all different."""
    # Centres and widths, for each variable
    bump_centres = [[-0.5, 0.6], [-0.4, 0.3], [0.1, 0.9]]
    bump_widths = [[0.7, 0.5], [0.8, 1.1], [0.6, 0.9]]
    bumps = np.array([bump_centres, bump_widths])
    step_centres = [[-0.7, 0.2], [0.4, 1.3]]
    step_widths = [[0.5, 0.9], [0.8, 0.6]]
    steps = np.array([step_centres, step_widths])
    weights = [
        np.array([0.3, -0.8, 0.5, -0.2]),
        np.array([-0.1, 0.7, 0.4, 0.6, -0.5, 0.25, 0.9]),
    ]
    slopes = [np.array([0.9, 0.3, 0.2]), np.array([0.4, 0.0, 1.1])]
    centre = np.array([0.5, -1.0, 2.0])
    std = np.array([2.0, 0.5, 1.5])
    uses = [[0], [0, 1]]
    s = SeparableMap(1, centre, std, bumps, steps, uses, weights, slopes)
    points = np.array(
        [
            [1.2, -0.7, 2.6],
            [-3.0, -1.4, 0.5],
            [0.5, -1.0, 5.0],
        ]
    )
    return s, points


def test_coefficients_set_by_hand_against_the_formula() -> None:
    """Constant, lines and bumps of earlier variables, line and integrated bumps of the own."""
    s, points = _map_by_hand()
    y = points[:, :1]
    x = points[:, 1:]
    z = s(y, x)
    log_det = np.zeros(3)
    for k in range(2):
        standard = (points - s.centre) / s.std
        earlier, increasing, rates = _features(s, standard, k)
        offset = earlier @ s.weights[k]
        component = offset + increasing @ s.slopes[k]
        assert np.abs(z[:, k] - component).max() < 1e-12
        # A triangular map's determinant is the product of its diagonal derivatives.
        derivative = rates @ s.slopes[k] / s.std[1 + k]
        log_det += np.log(derivative)
    assert np.abs(s.log_det(y, x) - log_det).max() < 1e-12
    assert np.abs(s.inverse(y, z) - x).max() < 1e-12


@pytest.mark.parametrize("penalty", [0.0, 0.05])
def test_a_fit_minimises_a_program_built_by_hand(penalty: float) -> None:
    """The loss (12) at the coefficients is below that of all feasible neighbours."""
    y, x, _ = banana(32, 150)
    s = fit(y, x, order=2, regularisation=penalty)
    standard = (np.hstack([y, x]) - s.centre) / s.std
    earlier, increasing, rates = _features(s, standard, 1)
    n_weights = earlier.shape[1]

    def loss(c: np.ndarray) -> float:
        weights = c[:n_weights]
        slopes = c[n_weights:]
        value = earlier @ weights + increasing @ slopes
        # ½ S² - log ∂S
        terms = 0.5 * value**2 - np.log(rates @ slopes)
        # The constant, two lines, and the own line have no penalty.
        penalised = np.concatenate([weights[3:], slopes[1:]])
        squares = (penalised**2).sum()
        return float(terms.mean() + 0.5 * penalty * squares)

    solution = np.concatenate([s.weights[1], s.slopes[1]])
    lower = np.full(solution.size, -np.inf)
    lower[n_weights] = 0.1
    lower[n_weights + 1 :] = 0.0
    # The program is convex: a minimum among the neighbours is the minimum.
    identity = np.eye(solution.size)
    for step in 1e-4 * np.vstack([identity, -identity]):
        neighbour = solution + step
        is_feasible = (neighbour >= lower).all()
        assert not is_feasible or loss(neighbour) > loss(solution)


def test_bumps_are_placed_at_quantiles() -> None:
    """Centres at n quantiles of each standardised variable, widths between the half steps."""
    y, x, _ = banana(31, 200)
    s = fit(y, x, order=(2, 3))
    joint = np.hstack([y, x])
    joint = (joint - joint.mean(axis=0)) / joint.std(axis=0)
    for variable in range(3):
        # Two bumps: centres at 2/6 and 4/6, widths from 1/6 to 3/6 and from 3/6 to 5/6.
        levels = np.arange(1, 6) / 6
        quantile = np.quantile(joint[:, variable], levels)
        centres, widths = s.bumps[:, variable]
        assert np.allclose(centres, quantile[[1, 3]])
        assert np.allclose(widths, quantile[[2, 4]] - quantile[[0, 2]])
    for k in range(2):
        # Three steps at 2/8, 4/8 and 6/8 of the state's variables
        levels = np.arange(1, 8) / 8
        quantile = np.quantile(joint[:, 1 + k], levels)
        centres, widths = s.steps[:, k]
        assert np.allclose(centres, quantile[[1, 3, 5]])
        assert np.allclose(widths, quantile[[2, 4, 6]] - quantile[[0, 2, 4]])


# ------------------------------------------------------------------------------- inversion


def test_the_inverse_of_a_map_that_is_almost_flat() -> None:
    """A line so flat that the ends of its bracket are far away."""
    x = np.array([[-1.0], [0.3], [1.5]])
    unit_step = np.array([[[0.0]], [[1.0]]])
    for slope in (1e-9, 1e-3):
        s = SeparableMap(
            0,
            np.zeros(1),
            np.ones(1),
            np.empty((2, 1, 0)),
            unit_step,
            [[]],
            [np.zeros(1)],
            [np.array([slope, 1.0])],
        )
        z = s(np.empty((3, 0)), x)
        assert np.abs(s.inverse([], z) - x).max() < 1e-9


def _bracket(
    target: np.ndarray, distance: float = 64.0
) -> tuple[np.ndarray, np.ndarray]:
    return np.full(target.shape, -distance), np.full(target.shape, distance)


def test_a_separable_map_is_inverted_in_few_evaluations(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Ten at most for each of two components."""
    y, x, _ = banana(1, 500)
    s = fit(y, x, order=3)
    z = s(y, x)
    evaluations = []
    increasing_part = SeparableMap._increasing_part

    def count(
        self: SeparableMap, v: np.ndarray, k: int
    ) -> tuple[np.ndarray, np.ndarray]:
        evaluations.append(k)
        return increasing_part(self, v, k)

    monkeypatch.setattr(SeparableMap, "_increasing_part", count)
    assert np.abs(s.inverse(y, z) - x).max() < 1e-12
    assert len(evaluations) <= 2 * 10


@given(st.floats(-3, 3), st.floats(0.02, 50))
def test_newton_s_method_does_not_alternate(target: float, steep: float) -> None:
    """For arctan it would jump from side to side; a step must halve or is replaced."""

    def bend(v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        u = steep * v
        value = np.arctan(u) + 1e-3 * v
        slope = steep / (1 + u**2) + 1e-3
        return value, slope

    low, high = _bracket(np.zeros(1), 1e4)
    v = invert(bend, np.array([target]), low, high)
    value, _ = bend(v)
    assert abs(value[0] - target) < 1e-9


def test_the_tolerance_is_relative_to_the_value() -> None:
    """At 1e8 two neighbouring numbers are 1.5e-8 apart: no step is ever below 1e-13."""

    def cubic(v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return v**3 + v, 3 * v**2 + 1

    # v³ + v at ±1e8
    target = np.array([1e24 + 1e8, -1e24 - 1e8])
    low, high = _bracket(target, 1e9)
    v = invert(cubic, target, low, high)
    assert np.allclose(v, [1e8, -1e8], rtol=1e-13)
