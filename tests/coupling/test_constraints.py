"""Constraints: the four readings of (12), their guard, retraction."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from distfilt.coupling import Constraint, norm, project, retract
from distfilt.linalg import SolverError

READINGS = ("printed", "reversed", "particle", "shift")


def _members(seed: int, n: int = 30, d: int = 4) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return rng.standard_normal(d) + rng.standard_normal((n, d)) @ rng.standard_normal((d, d))


def _linear(seed: int, s: int = 2, d: int = 4) -> Constraint:
    rng = np.random.default_rng(seed + 1000)
    matrix = rng.standard_normal((s, d))
    return Constraint(lambda x: x @ matrix.T, rng.standard_normal(s))


def _std(g: Constraint, x: np.ndarray) -> np.ndarray:
    return g.residual(x).std(axis=0)


@given(st.integers(0, 10_000))
def test_linear_constraints_tell_the_readings_apart(seed: int) -> None:
    """Printed: same mean, twice the spread. Reversed: mean D. Particle: exact. Shift: mean d."""
    x, g = _members(seed), _linear(seed)
    out = {r: project(x, g, reading=r, regularisation=0.0, guarded=False) for r in READINGS}
    scale = 1 + np.abs(x).max()
    size = 1e-9 * scale * max(1.0, 1 / _std(g, x).min())
    assert np.abs(out["printed"].mean(axis=0) - x.mean(axis=0)).max() < size
    assert np.abs(_std(g, out["printed"]) / _std(g, x) - 2).max() < 1e-8
    assert np.abs(g.residual(out["reversed"]) - g.residual(x).mean(axis=0)).max() < size
    assert np.abs(g.residual(out["particle"])).max() < size
    assert np.abs(g.residual(out["shift"]).mean(axis=0)).max() < size
    assert np.abs(_std(g, out["shift"]) - _std(g, x)).max() < size


def test_the_projection_by_its_formula_in_a_batch() -> None:
    x, g = _members(3, 25, 3), norm([0, 2], length=1.3)
    eps = 0.3
    d = (x[:, [0, 2]] ** 2).sum(axis=1)
    gain = np.cov(x.T, d, bias=True)[:3, 3] / (d.var() + eps)
    shift = x + np.outer(1.69 - np.full(25, d.mean()), gain)
    particle, printed = (x + np.outer(aim, gain) for aim in (1.69 - d, d - d.mean()))
    options = {"regularisation": eps, "guarded": False}
    stack = np.stack([x, 0.5 * x])
    assert np.allclose(project(stack, g, **options)[0], shift, atol=1e-12)
    assert np.allclose(project(x, g, reading="particle", **options), particle, atol=1e-12)
    assert np.allclose(project(x, g, reading="printed", **options), printed, atol=1e-12)
    assert np.allclose(project(stack, g, **options)[1], project(0.5 * x, g, **options))


def test_a_projection_that_makes_it_worse_is_refused() -> None:
    """On the manifold the covariance of g is rounding, and the gain a million million."""
    angle = np.linspace(0, 1, 40)
    x = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    g = norm([0, 1])
    wild = project(x, g, reading="particle", regularisation=1e-40, guarded=False)
    calm = project(x, g, reading="particle", regularisation=1e-40)
    assert np.abs(g.residual(calm)).mean() <= np.abs(g.residual(x)).mean()
    assert np.abs(calm - x).max() < 1e-9 or np.abs(wild - x).max() < 1e-9
    far = np.random.default_rng(4).standard_normal((40, 2)) * [3.0, 0.01]
    both = project(np.stack([far, x + 0.1]), g, reading="printed")
    assert (both[0] == far).all()


def test_the_guard_judges_what_the_reading_moves() -> None:
    """The shift takes the mean of g to d; where g is curved the members' own misses may grow."""
    g = norm([0, 1])
    rng = np.random.default_rng(16)
    miss, own = [], []
    for _ in range(40):
        centre = np.array([0.5, 0.87]) + 0.02 * rng.standard_normal(2)
        x = centre + 0.1 * rng.standard_normal((50, 2))
        out = project(x, g)
        free = project(x, g, guarded=False)
        before, after = g.residual(x), g.residual(free)
        miss.append(abs(after.mean()) <= abs(before.mean()))
        own.append(np.abs(after).mean() <= np.abs(before).mean())
        assert (out == (free if miss[-1] else x)).all()
    assert sum(miss) > 30 and sum(own) < sum(miss) - 5


def test_a_shift_that_overshoots_is_refused() -> None:
    """At the bottom of g = x² the regression's slope is small, and the step to d far too long."""
    g = Constraint(lambda x: x**2, [1.0])
    x = np.array([[-0.3], [0.31]])
    assert (project(x, g) == x).all() and (project(x, g, guarded=False) != x).all()


def test_a_singular_covariance_without_regularisation_raises() -> None:
    x = np.array([[1.0, 0.0], [1.0, 1.0], [1.0, 2.0]])
    with pytest.raises(np.linalg.LinAlgError):
        project(x, Constraint(lambda v: v[..., :1], [1.0]), regularisation=0.0)


@given(st.integers(0, 10_000), st.floats(0.2, 5.0))
def test_a_length_is_retracted_to_the_closest_point(seed: int, length: float) -> None:
    x = 0.3 + np.random.default_rng(seed).uniform(0, 3, (2, 20, 3))
    out = retract(x, norm([0, 1, 2], length=length))
    r = np.linalg.norm(x, axis=-1, keepdims=True)
    assert np.abs(out - length * x / r).max() < 1e-12 * length
    assert np.abs(np.linalg.norm(out, axis=-1) - length).max() <= 1e-14 * max(1.0, length)


def test_two_constraints_and_numerical_derivatives() -> None:
    """A circle in a tilted plane, without a Jacobian."""
    g = Constraint(
        lambda x: np.stack([(x**2).sum(axis=-1), x[..., 0] + x[..., 2]], axis=-1), [4.0, 0.5]
    )
    x = np.random.default_rng(5).standard_normal((50, 3)) + [1.0, 1.0, 0.0]
    out = retract(x, g)
    assert np.abs(g.residual(out)).max() < 1e-13
    again = retract(out, g)
    assert np.abs(again - out).max() < 1e-13


def test_velocities_become_tangent_and_keep_their_tangent_part() -> None:
    rng = np.random.default_rng(6)
    x = rng.standard_normal((40, 6))
    out = retract(x, norm([3, 0]), motion=([0, 3], [1, 5]))
    radial = out[:, 0] * out[:, 1] + out[:, 3] * out[:, 5]
    assert np.abs(radial).max() < 1e-14
    before = x[:, 0] * x[:, 5] - x[:, 3] * x[:, 1]
    after = out[:, 0] * out[:, 5] - out[:, 3] * out[:, 1]
    assert np.allclose(after, before / np.hypot(x[:, 0], x[:, 3]), atol=1e-12)
    assert (out[:, [2, 4]] == x[:, [2, 4]]).all()


def test_a_rank_that_is_lost_at_one_state_is_named() -> None:
    x = np.ones((5, 2))
    x[3] = 0.0
    with pytest.raises(ValueError, match=r"rank at state 3 \(1 of 5\)"):
        retract(x, norm([0, 1]))


def test_a_constraint_without_a_solution_does_not_converge() -> None:
    impossible = Constraint(lambda x: (x**2).sum(axis=-1, keepdims=True) + 1, [0.5])
    with pytest.raises((SolverError, ValueError), match=r"did not reach|loses rank"):
        retract([[0.7, 0.4]], impossible)
    with pytest.raises(SolverError, match="1 of 2 states"):
        retract([[100.0, 3.0], [0.6, 0.8]], norm([0, 1]), iterations=2)


def test_steps_are_shortened_where_newton_overshoots() -> None:
    """g = arctan: from 3 a full Newton step goes to -9.5, and the next one far away."""
    g = Constraint(np.arctan, [0.0], derivative=lambda x: 1 / (1 + x[..., None] ** 2))
    assert np.abs(retract([[3.0], [-20.0]], g)).max() < 1e-14


def test_inputs_stay_as_they_were() -> None:
    x, value = _members(13, 10, 4), np.array([1.0])
    kept = x.copy()
    g = Constraint(lambda v: np.multiply(v, v, out=v).sum(axis=-1, keepdims=True), value)
    project(x, g)
    assert (retract(retract(x, g), g) == retract(x, g)).all()
    value[0] = 5.0
    assert (x == kept).all() and g.value[0] == 1.0


def test_a_jacobian_is_each_member_s_by_formula_and_by_differences() -> None:
    x, g = np.random.default_rng(3).standard_normal((2, 5, 4)), norm([0, 2])
    slope = g.jacobian(x)
    assert np.array_equal(slope[..., 0, [0, 2]], 2 * x[..., [0, 2]])
    assert slope.shape == (2, 5, 1, 4) and not slope[..., 0, [1, 3]].any()
    assert np.abs(slope - Constraint(g.function, g.value).jacobian(x)).max() < 1e-8


@pytest.mark.parametrize("unit", [1e-12, 1e-7, 1e7])
def test_retraction_in_any_unit_of_length(unit: float) -> None:
    """A tolerance of 1e-15 is relative: a circle of a ten-millionth is met as closely as one."""
    x = 1 + np.random.default_rng(17).random((30, 2))
    plain = retract(x, norm([0, 1]))
    other = retract(unit * x, norm([0, 1], length=unit))
    assert np.abs(other / unit - plain).max() < 4e-15
    tilted = Constraint(lambda v: v[..., :1] - 3 * v[..., 1:], [0.0])
    assert np.abs(tilted.residual(retract(unit * x, tilted))).max() < 1e-14 * unit


def test_units_that_differ_between_two_constraints_lose_no_rank() -> None:
    g = Constraint(lambda v: np.stack([1e9 * (v[..., 0] - 1), 1e-9 * v[..., 1]], -1), [0.0, 0.0])
    assert np.abs(retract([[3.0, 5.0]], g) - [1.0, 0.0]).max() < 1e-7


@pytest.mark.parametrize("value", [np.nan, np.inf, 1j])
def test_a_constraint_that_has_no_real_value_is_refused(value: complex) -> None:
    x = np.array([[0.5, 1.0], [2.0, 1.0]])
    g = Constraint(lambda v: np.where(v[..., :1] > 1, value, v[..., :1]), [0.0])
    for call in (retract, project):
        with pytest.raises(ValueError, match="function: needs"):
            call(x, g)


def test_a_trial_step_may_leave_the_domain() -> None:
    """log x = -1 from 5: the full Newton step leads to x = -8, where there is no logarithm."""
    g = Constraint(lambda v: np.log(np.where(v > 0, v, np.nan)), [-1.0])
    assert np.abs(retract([[5.0], [0.1]], g) - np.exp(-1)).max() < 1e-15


def test_a_projection_out_of_the_domain_is_guarded() -> None:
    g = Constraint(lambda v: np.log(np.where(v > 0, v, np.nan)), [-20.0])
    x = np.array([[0.5], [1.0], [1.5]])
    assert (project(x, g) == x).all()
    assert (project(x, g, guarded=False) < 0).any()
