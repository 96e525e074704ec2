"""Inversion of increasing functions: it settles, in few evaluations, or says that it cannot."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from distfilt.linalg import SolverError
from distfilt.triangular.newton import invert
from tests.triangular.samples import banana


def test_a_settled_newton_step_ends_the_search() -> None:
    """From a start near the root: Newton's method takes few evaluations, halving would take 40."""
    calls = []

    def function(v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        calls.append(1)
        return v + 0.3 * np.sin(v), 1 + 0.3 * np.cos(v)

    target = np.linspace(-5, 5, 101)
    v = invert(function, target)
    assert np.abs(v + 0.3 * np.sin(v) - target).max() < 1e-13
    assert len(calls) <= 14


def test_a_separable_map_is_inverted_in_few_evaluations(monkeypatch: pytest.MonkeyPatch) -> None:
    from distfilt.triangular.separable import SeparableMap, fit

    y, x, _ = banana(1, 500)
    s = fit(y, x, order=3)
    z, calls, own = s(y, x), [], SeparableMap._own

    def counted(self: SeparableMap, v: np.ndarray, k: int) -> tuple[np.ndarray, np.ndarray]:
        calls.append(k)
        return own(self, v, k)

    monkeypatch.setattr(SeparableMap, "_own", counted)
    assert np.abs(s.inverse(y, z) - x).max() < 1e-12
    assert len(calls) <= 2 * 10


@given(st.floats(-3, 3), st.floats(0.02, 50))
def test_newton_s_method_may_not_go_to_and_fro(target: float, steep: float) -> None:
    """arctan makes Newton's method jump from side to side; a step must halve or is replaced."""

    def bend(v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        u = steep * v
        return np.arctan(u) + 1e-3 * v, steep / (1 + u**2) + 1e-3

    v = invert(bend, np.array([target]))
    assert abs(bend(v)[0][0] - target) < 1e-9


def test_a_flat_root_of_high_order_is_found_by_halving() -> None:
    v = invert(lambda v: (v**41, 41 * v**40), np.array([0.0, 1.0]))
    assert np.abs(v - [0.0, 1.0]).max() < 1e-7 or abs(v[0]) ** 41 < 1e-9


def test_a_value_inside_a_jump_is_refused() -> None:
    with pytest.raises(SolverError, match="settle"):
        invert(lambda v: (v + np.sign(v), np.ones_like(v)), np.array([0.5, 0.3]))


def test_targets_of_their_own_functions() -> None:
    scale = np.array([[0.1], [1.0], [30.0]])
    target = np.array([-2.0, 0.0, 1.5])
    v = invert(lambda v: (np.sinh(scale * v), scale * np.cosh(scale * v)),
               np.broadcast_to(target, (3, 3)))
    assert np.allclose(v, np.arcsinh(target) / scale, rtol=1e-12, atol=1e-13)


def test_the_tolerance_is_relative_to_the_value() -> None:
    """At 1e8 two neighbouring numbers are 1.5e-8 apart: no step is ever below 1e-13."""
    target = np.array([1e24 + 1e8, -1e24 - 1e8])
    v = invert(lambda v: (v**3 + v, 3 * v**2 + 1), target)
    assert np.allclose(v, [1e8, -1e8], rtol=1e-13)
