"""Constraints: the four variants of (12), their safeguard, and retraction."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from distfilt.coupling import Constraint, constraints, norm_constraint, project, retract
from distfilt.linalg import SolverError

# ---------------------------------------------------------------------------- projection


@pytest.mark.parametrize("eps", [0.0, 0.3])
def test_the_variants_by_their_formulas_in_a_batch(eps: float) -> None:
    """(12) for a circle and a plane at once: each variant's sign and target."""
    rng = np.random.default_rng(3)
    centre = rng.standard_normal(3)
    normal = rng.standard_normal((25, 3))
    x = centre + normal @ rng.standard_normal((3, 3))
    d = np.array([1.69, -0.4])

    def function(v: np.ndarray) -> np.ndarray:
        circle = v[..., 0] ** 2 + v[..., 2] ** 2
        plane = v.sum(axis=-1)
        return np.stack([circle, plane], axis=-1)

    g = Constraint(function, d)
    values = function(x)
    mean = values.mean(axis=0)
    # K = Sigma_xd (Sigma_dd + eps I)^-1, with N in the denominators.
    joint = np.cov(np.hstack([x, values]).T, bias=True)
    regularised = joint[3:, 3:] + eps * np.eye(2)
    gain = joint[:3, 3:] @ np.linalg.inv(regularised)
    innovations = {
        "printed": values - mean,
        "reversed": mean - values,
        "particle": d - values,
        "shift": np.tile(d - mean, (25, 1)),
    }
    for variant, innovation in innovations.items():
        options: Any = {"variant": variant, "regularisation": eps, "safeguard": False}
        batch = np.stack([0.5 * x, x])
        first, second = project(batch, g, **options)
        expected = x + innovation @ gain.T
        assert np.allclose(second, expected, atol=1e-10)
        # The other ensemble of the batch has a gain of its own.
        single = project(0.5 * x, g, **options)
        assert np.allclose(first, single, atol=1e-10)


def test_a_projection_that_increases_the_residual_is_rejected() -> None:
    """A wide ensemble far from linear stays as it is, a narrow one beside it is projected."""
    wide = np.random.default_rng(4).standard_normal((40, 2)) * [3.0, 0.01]
    narrow = 0.1 * wide + 0.7
    batch = np.stack([wide, narrow])
    projected = project(batch, norm_constraint([0, 1]), variant="particle")
    assert (projected[0] == wide).all()
    assert (projected[1] != narrow).all()


def test_the_safeguard_of_the_shift_uses_the_mean_residual() -> None:
    """The shift takes the mean of g to d; the members' own residuals may grow if g is curved."""
    g = norm_constraint([0, 1])
    rng = np.random.default_rng(16)
    mean_decreased = []
    members_decreased = []
    for _ in range(40):
        centre = np.array([0.5, 0.87]) + 0.02 * rng.standard_normal(2)
        x = centre + 0.1 * rng.standard_normal((50, 2))
        projected = project(x, g, safeguard=False)
        before = g.residual(x)
        after = g.residual(projected)
        accepted = abs(after.mean()) <= abs(before.mean())
        expected = projected if accepted else x
        assert (project(x, g) == expected).all()
        mean_decreased.append(accepted)
        members_before = np.abs(before).mean()
        members_after = np.abs(after).mean()
        members_decreased.append(members_after <= members_before)
    # The two criteria differ often enough to tell which one is used.
    assert sum(mean_decreased) > 30
    assert sum(members_decreased) < sum(mean_decreased) - 5


@pytest.mark.parametrize(
    ("function", "value", "x"),
    [
        # At the bottom of x² the regression's slope is small, and the step to d far too
        # long.
        (lambda v: v**2, 1.0, [[-0.3], [0.31]]),
        # A long step leaves the domain of the logarithm.
        (lambda v: np.log(np.where(v > 0, v, np.nan)), -20.0, [[0.5], [1.0], [1.5]]),
    ],
)
def test_a_shift_too_far_or_out_of_the_domain_is_rejected(
    function: Callable[[np.ndarray], np.ndarray], value: float, x: list[list[float]]
) -> None:
    """With the safeguard the ensemble stays as it is."""
    g = Constraint(function, [value])
    assert (project(x, g) == x).all()
    assert (project(x, g, safeguard=False) != x).all()


# ---------------------------------------------------------------------------- retraction


@given(st.integers(0, 10_000), st.floats(0.2, 5.0))
def test_a_length_is_retracted_to_the_closest_point(seed: int, length: float) -> None:
    """The normals of a sphere are radial: x L / |x|, and the length holds to rounding."""
    uniform = np.random.default_rng(seed).uniform(0, 3, (2, 20, 3))
    x = 0.3 + uniform
    retracted = retract(x, norm_constraint([0, 1, 2], length=length))
    closest = length * x / np.linalg.norm(x, axis=-1, keepdims=True)
    assert np.abs(retracted - closest).max() < 1e-12 * length
    lengths = np.linalg.norm(retracted, axis=-1)
    error = np.abs(lengths - length).max()
    assert error <= 1e-14 * max(1.0, length)


def test_two_constraints_and_numerical_derivatives() -> None:
    """A circle in a tilted plane, without a Jacobian; states on it stay."""

    def function(x: np.ndarray) -> np.ndarray:
        sphere = (x**2).sum(axis=-1)
        plane = x[..., 0] + x[..., 2]
        return np.stack([sphere, plane], axis=-1)

    g = Constraint(function, [4.0, 0.5])
    normal = np.random.default_rng(5).standard_normal((50, 3))
    x = normal + [1.0, 1.0, 0.0]
    retracted = retract(x, g)
    assert np.abs(g.residual(retracted)).max() < 1e-13
    # A retraction is idempotent.
    repeated = retract(retracted, g)
    assert np.abs(repeated - retracted).max() < 1e-13


def test_velocities_become_tangent_and_keep_their_tangent_part() -> None:
    """q'v = 0 after the retraction, and the angular momentum per length is the same."""
    x = np.random.default_rng(6).standard_normal((40, 6))
    retracted = retract(x, norm_constraint([3, 0]), motion=([0, 3], [1, 5]))
    # States hold q in components 0 and 3, v in components 1 and 5.
    first = retracted[:, 0] * retracted[:, 1]
    second = retracted[:, 3] * retracted[:, 5]
    assert np.abs(first + second).max() < 1e-14

    def momentum(states: np.ndarray) -> np.ndarray:
        # q_0 v_1 - q_1 v_0
        first = states[:, 0] * states[:, 5]
        second = states[:, 3] * states[:, 1]
        return first - second

    radius = np.hypot(x[:, 0], x[:, 3])
    # q' = q / |q| and v' = v - (q'ᵀv) q': q' × v' = q × v / |q|.
    assert np.allclose(momentum(retracted), momentum(x) / radius, atol=1e-12)
    # Other components stay.
    assert (retracted[:, [2, 4]] == x[:, [2, 4]]).all()

    # The parabola q_0² + q_1 = 0 has the tangents 2 q_0 v_0 + v_1 = 0.
    def bend(v: np.ndarray) -> np.ndarray:
        return v[..., :1] ** 2 + v[..., 1:2]

    parabola = Constraint(bend, [0.0])
    retracted = retract(x, parabola, motion=([0, 1], [2, 3]))
    # Its derivative is numerical: 1e-8 in place of rounding.
    place, _, speed, climb = retracted[:, :4].T
    normal_velocity = 2 * place * speed + climb
    assert np.abs(normal_velocity).max() < 1e-8


def test_a_state_that_loses_rank_is_named() -> None:
    """At the centre of a circle there is no normal."""
    x = np.ones((5, 2))
    x[3] = 0.0
    with pytest.raises(ValueError, match=r"rank at state 3 \(1 of 5\)"):
        retract(x, norm_constraint([0, 1]))


def test_a_constraint_without_a_solution_does_not_converge(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """|x|² + 1 = 0.5 has none; and two steps are too few for a state far away."""
    impossible = Constraint(lambda x: (x**2).sum(axis=-1, keepdims=True) + 1, [0.5])
    with pytest.raises((SolverError, ValueError), match=r"did not reach|loses rank"):
        retract([[0.7, 0.4]], impossible)
    monkeypatch.setattr(constraints, "_STEPS", 2)
    with pytest.raises(SolverError, match="1 of 2 states"):
        retract([[100.0, 3.0], [0.6, 0.8]], norm_constraint([0, 1]))


def test_steps_are_halved_where_newton_overshoots_or_leaves_the_domain() -> None:
    """From 3 a full step for arctan goes to -9.5; from 5 one for log x = -1 goes to -8."""

    def slope(x: np.ndarray) -> np.ndarray:
        return 1 / (1 + x[..., None] ** 2)

    def log(x: np.ndarray) -> np.ndarray:
        return np.log(np.where(x > 0, x, np.nan))

    g = Constraint(np.arctan, [0.0], derivative=slope)
    # arctan x = 0 at 0, log x = -1 at 1/e
    assert np.abs(retract([[3.0], [-20.0]], g)).max() < 1e-14
    g = Constraint(log, [-1.0])
    retracted = retract([[5.0], [0.1]], g)
    assert np.abs(retracted - np.exp(-1)).max() < 1e-15


@pytest.mark.parametrize("unit", [1e-12, 1e-7, 1e7])
def test_retraction_in_any_unit_of_length(unit: float) -> None:
    """The tolerance of 1e-15 is relative: small circles are met as closely as large ones."""
    x = 1 + np.random.default_rng(17).random((30, 2))
    reference = retract(x, norm_constraint([0, 1]))
    scaled = retract(unit * x, norm_constraint([0, 1], length=unit))
    assert np.abs(scaled / unit - reference).max() < 4e-15
    # Here d = 0 has no unit, so that of the states counts.
    tilted = Constraint(lambda v: v[..., :1] - 3 * v[..., 1:], [0.0])
    residual = tilted.residual(retract(unit * x, tilted))
    assert np.abs(residual).max() < 1e-14 * unit


def test_constraints_in_different_units_lose_no_rank() -> None:
    """Normals are compared by their directions."""

    def function(v: np.ndarray) -> np.ndarray:
        large = 1e9 * (v[..., 0] - 1)
        small = 1e-9 * v[..., 1]
        return np.stack([large, small], axis=-1)

    g = Constraint(function, [0.0, 0.0])
    error = retract([[3.0, 5.0]], g) - [1.0, 0.0]
    assert np.abs(error).max() < 1e-7


# ----------------------------------------------------------------------- user functions


def test_inputs_are_not_changed() -> None:
    """Not even by a function that works in place; and the constraint has its own copy of d."""
    x = np.random.default_rng(13).standard_normal((10, 4))
    original = x.copy()
    value = np.array([1.0])

    def function(v: np.ndarray) -> np.ndarray:
        return np.multiply(v, v, out=v).sum(axis=-1, keepdims=True)

    g = Constraint(function, value)
    project(x, g)
    retracted = retract(x, g)
    assert (retract(retracted, g) == retracted).all()
    # Projection and retraction are over: only the caller's array changes.
    value[0] = 5.0
    assert (x == original).all()
    assert g.value[0] == 1.0


def test_a_jacobian_by_formula_and_by_differences() -> None:
    """2 x for the components of the norm and zero for others, member by member."""
    x = np.random.default_rng(3).standard_normal((2, 5, 4))
    g = norm_constraint([0, 2])
    slope = g.jacobian(x)
    assert slope.shape == (2, 5, 1, 4)
    expected = 2 * x[..., [0, 2]]
    assert np.array_equal(slope[..., 0, [0, 2]], expected)
    assert not slope[..., 0, [1, 3]].any()
    by_differences = Constraint(g.function, g.value).jacobian(x)
    assert np.abs(slope - by_differences).max() < 1e-8


@pytest.mark.parametrize("value", [np.nan, np.inf, 1j])
def test_a_function_without_a_real_value_is_refused(value: complex) -> None:
    """The error names the function."""
    x = np.array([[0.5, 1.0], [2.0, 1.0]])

    def function(v: np.ndarray) -> np.ndarray:
        # Only the second state has no real value.
        first = v[..., :1]
        return np.where(first > 1, value, first)

    g = Constraint(function, [0.0])
    for call in (retract, project):
        with pytest.raises(ValueError, match="function must"):
            call(x, g)


def test_a_constraint_of_more_components_than_states_have_is_refused() -> None:
    """The error says how many there are."""
    for call in (retract, project):
        with pytest.raises(ValueError, match="^constraint must be .* of more than 1"):
            call(np.ones((2, 2, 1)), norm_constraint([0, 1]))
