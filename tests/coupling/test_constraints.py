"""Constraints: the four readings of (12), their guard, retraction."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from distfilt.coupling import Constraint, constraints, norm_constraint, project, retract
from distfilt.linalg import SolverError


def _members(seed: int, n: int = 30, d: int = 4) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return rng.standard_normal(d) + rng.standard_normal((n, d)) @ rng.standard_normal(
        (d, d)
    )


@pytest.mark.parametrize("eps", [0.0, 0.3])
def test_the_readings_by_their_formulas_in_a_batch(eps: float) -> None:
    """(12) for a circle and a plane at once: the sign and the point that each reading means."""
    x = _members(3, 25, 3)
    d = np.array([1.69, -0.4])
    g = Constraint(
        lambda v: np.stack([v[..., 0] ** 2 + v[..., 2] ** 2, v.sum(-1)], -1), d
    )
    values = np.stack([x[:, 0] ** 2 + x[:, 2] ** 2, x.sum(axis=1)], axis=1)
    joint = np.cov(np.hstack([x, values]).T, bias=True)
    gain = joint[:3, 3:] @ np.linalg.inv(joint[3:, 3:] + eps * np.eye(2))
    mean = values.mean(axis=0)
    aims = {
        "printed": values - mean,
        "reversed": mean - values,
        "particle": d - values,
        "shift": np.tile(d - mean, (25, 1)),
    }
    for variant, aim in aims.items():
        options = {"variant": variant, "regularisation": eps, "safeguard": False}
        out = project(np.stack([0.5 * x, x]), g, **options)
        assert np.allclose(out[1], x + aim @ gain.T, atol=1e-10)
        assert np.allclose(out[0], project(0.5 * x, g, **options), atol=1e-10)


def test_a_projection_that_makes_it_worse_is_refused() -> None:
    far = np.random.default_rng(4).standard_normal((40, 2)) * [3.0, 0.01]
    both = project(
        np.stack([far, 0.1 * far + 0.7]), norm_constraint([0, 1]), variant="particle"
    )
    assert (both[0] == far).all() and (both[1] != 0.1 * far + 0.7).all()


def test_the_guard_judges_what_the_reading_moves() -> None:
    """The shift takes the mean of g to d; where g is curved the members' own misses may grow."""
    g = norm_constraint([0, 1])
    rng = np.random.default_rng(16)
    miss = []
    own = []
    for _ in range(40):
        centre = np.array([0.5, 0.87]) + 0.02 * rng.standard_normal(2)
        x = centre + 0.1 * rng.standard_normal((50, 2))
        out = project(x, g)
        free = project(x, g, safeguard=False)
        before = g.residual(x)
        after = g.residual(free)
        miss.append(abs(after.mean()) <= abs(before.mean()))
        own.append(np.abs(after).mean() <= np.abs(before).mean())
        assert (out == (free if miss[-1] else x)).all()
    assert sum(miss) > 30 and sum(own) < sum(miss) - 5


@pytest.mark.parametrize(
    ("function", "value", "x"),
    [
        (lambda v: v**2, 1.0, [[-0.3], [0.31]]),
        (lambda v: np.log(np.where(v > 0, v, np.nan)), -20.0, [[0.5], [1.0], [1.5]]),
    ],
)
def test_a_shift_too_far_or_out_of_the_domain_is_refused(
    function: Callable[[np.ndarray], np.ndarray], value: float, x: list[list[float]]
) -> None:
    """At the bottom of g = x² the regression's slope is small, and the step to d far too long."""
    g = Constraint(function, [value])
    assert (project(x, g) == x).all() and (project(x, g, safeguard=False) != x).all()


@given(st.integers(0, 10_000), st.floats(0.2, 5.0))
def test_a_length_is_retracted_to_the_closest_point(seed: int, length: float) -> None:
    x = 0.3 + np.random.default_rng(seed).uniform(0, 3, (2, 20, 3))
    out = retract(x, norm_constraint([0, 1, 2], length=length))
    r = np.linalg.norm(x, axis=-1, keepdims=True)
    assert np.abs(out - length * x / r).max() < 1e-12 * length
    assert np.abs(np.linalg.norm(out, axis=-1) - length).max() <= 1e-14 * max(
        1.0, length
    )


def test_two_constraints_and_numerical_derivatives() -> None:
    """A circle in a tilted plane, without a Jacobian; what is there already stays."""
    g = Constraint(
        lambda x: np.stack([(x**2).sum(axis=-1), x[..., 0] + x[..., 2]], axis=-1),
        [4.0, 0.5],
    )
    x = np.random.default_rng(5).standard_normal((50, 3)) + [1.0, 1.0, 0.0]
    out = retract(x, g)
    assert np.abs(g.residual(out)).max() < 1e-13
    assert np.abs(retract(out, g) - out).max() < 1e-13


def test_velocities_become_tangent_and_keep_their_tangent_part() -> None:
    rng = np.random.default_rng(6)
    x = rng.standard_normal((40, 6))
    out = retract(x, norm_constraint([3, 0]), motion=([0, 3], [1, 5]))
    radial = out[:, 0] * out[:, 1] + out[:, 3] * out[:, 5]
    assert np.abs(radial).max() < 1e-14
    before = x[:, 0] * x[:, 5] - x[:, 3] * x[:, 1]
    after = out[:, 0] * out[:, 5] - out[:, 3] * out[:, 1]
    assert np.allclose(after, before / np.hypot(x[:, 0], x[:, 3]), atol=1e-12)
    assert (out[:, [2, 4]] == x[:, [2, 4]]).all()
    curve = Constraint(lambda v: v[..., :1] ** 2 + v[..., 1:2], [0.0])
    out = retract(x, curve, motion=([0, 1], [2, 3]))
    assert np.abs(2 * out[:, 0] * out[:, 2] + out[:, 3]).max() < 1e-8


def test_a_rank_that_is_lost_at_one_state_is_named() -> None:
    x = np.ones((5, 2))
    x[3] = 0.0
    with pytest.raises(ValueError, match=r"rank at state 3 \(1 of 5\)"):
        retract(x, norm_constraint([0, 1]))


def test_a_constraint_without_a_solution_does_not_converge(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    impossible = Constraint(lambda x: (x**2).sum(axis=-1, keepdims=True) + 1, [0.5])
    with pytest.raises((SolverError, ValueError), match=r"did not reach|loses rank"):
        retract([[0.7, 0.4]], impossible)
    monkeypatch.setattr(constraints, "_STEPS", 2)
    with pytest.raises(SolverError, match="1 of 2 states"):
        retract([[100.0, 3.0], [0.6, 0.8]], norm_constraint([0, 1]))


def test_steps_are_shortened_where_newton_overshoots_or_leaves_the_domain() -> None:
    """From 3 a full step for arctan goes to -9.5; from 5 one for log x = -1 goes to -8."""
    g = Constraint(np.arctan, [0.0], derivative=lambda x: 1 / (1 + x[..., None] ** 2))
    assert np.abs(retract([[3.0], [-20.0]], g)).max() < 1e-14
    g = Constraint(lambda v: np.log(np.where(v > 0, v, np.nan)), [-1.0])
    assert np.abs(retract([[5.0], [0.1]], g) - np.exp(-1)).max() < 1e-15


def test_inputs_stay_as_they_were() -> None:
    x = _members(13, 10, 4)
    value = np.array([1.0])
    kept = x.copy()
    g = Constraint(
        lambda v: np.multiply(v, v, out=v).sum(axis=-1, keepdims=True), value
    )
    project(x, g)
    assert (retract(retract(x, g), g) == retract(x, g)).all()
    value[0] = 5.0
    assert (x == kept).all() and g.value[0] == 1.0


def test_a_jacobian_is_each_member_s_by_formula_and_by_differences() -> None:
    x = np.random.default_rng(3).standard_normal((2, 5, 4))
    g = norm_constraint([0, 2])
    slope = g.jacobian(x)
    assert np.array_equal(slope[..., 0, [0, 2]], 2 * x[..., [0, 2]])
    assert slope.shape == (2, 5, 1, 4) and not slope[..., 0, [1, 3]].any()
    assert np.abs(slope - Constraint(g.function, g.value).jacobian(x)).max() < 1e-8


@pytest.mark.parametrize("unit", [1e-12, 1e-7, 1e7])
def test_retraction_in_any_unit_of_length(unit: float) -> None:
    """A tolerance of 1e-15 is relative: a circle of a ten-millionth is met as closely as one."""
    x = 1 + np.random.default_rng(17).random((30, 2))
    plain = retract(x, norm_constraint([0, 1]))
    other = retract(unit * x, norm_constraint([0, 1], length=unit))
    assert np.abs(other / unit - plain).max() < 4e-15
    tilted = Constraint(lambda v: v[..., :1] - 3 * v[..., 1:], [0.0])
    assert np.abs(tilted.residual(retract(unit * x, tilted))).max() < 1e-14 * unit


def test_units_that_differ_between_two_constraints_lose_no_rank() -> None:
    g = Constraint(
        lambda v: np.stack([1e9 * (v[..., 0] - 1), 1e-9 * v[..., 1]], -1), [0.0, 0.0]
    )
    assert np.abs(retract([[3.0, 5.0]], g) - [1.0, 0.0]).max() < 1e-7


@pytest.mark.parametrize("value", [np.nan, np.inf, 1j])
def test_a_constraint_that_has_no_real_value_is_refused(value: complex) -> None:
    x = np.array([[0.5, 1.0], [2.0, 1.0]])
    g = Constraint(lambda v: np.where(v[..., :1] > 1, value, v[..., :1]), [0.0])
    for call in (retract, project):
        with pytest.raises(ValueError, match="function must"):
            call(x, g)
        with pytest.raises(
            ValueError, match="^constraint must be .* of more than 1"
        ):
            call(x[..., None], norm_constraint([0, 1]))
