"""The Runge-Kutta rule: exactness, order, substeps, and its derivative."""

from __future__ import annotations

import numpy as np
import pytest

from distfilt.linalg import central
from distfilt.models import rk4, rk4_jacobian

NAN = float("nan")


def _decay(x: np.ndarray, t: float) -> np.ndarray:
    return -x


def _minus(x: np.ndarray, t: float) -> np.ndarray:
    return -np.ones((*x.shape, x.shape[-1]))


_I = "distfilt.models.integrators."
BAD_INPUT = {
    _I + "rk4": [
        ("rate", lambda: rk4(3, [1.0], 0.0, 0.1)),
        ("rate", lambda: rk4(lambda x, t: x[:1], [1.0, 2.0], 0.0, 0.1)),
        ("x", lambda: rk4(_decay, [NAN], 0.0, 0.1)),
        ("t", lambda: rk4(_decay, [1.0], NAN, 0.1)),
        ("dt", lambda: rk4(_decay, [1.0], 0.0, -0.1)),
        ("longest", lambda: rk4(_decay, [1.0], 0.0, 0.1, longest=0.0)),
        ("longest", lambda: rk4(_decay, [1.0], 0.0, 0.1, longest=1e-12)),
        ("longest", lambda: rk4(_decay, [1.0], 0.0, 0.1, longest=5e-324)),
    ],
    _I + "rk4_jacobian": [
        ("rate", lambda: rk4_jacobian(3, _minus, [1.0], 0.0, 0.1)),
        ("slope", lambda: rk4_jacobian(_decay, 3, [1.0], 0.0, 0.1)),
        ("slope", lambda: rk4_jacobian(_decay, _decay, [1.0, 2.0], 0.0, 0.1)),
        ("x", lambda: rk4_jacobian(_decay, _minus, 1.0, 0.0, 0.1)),
        ("t", lambda: rk4_jacobian(_decay, _minus, [1.0], NAN, 0.1)),
        ("dt", lambda: rk4_jacobian(_decay, _minus, [1.0], 0.0, -0.1)),
        ("longest", lambda: rk4_jacobian(_decay, _minus, [1.0], 0.0, 0.1, longest=-1.0)),
    ],
}


@pytest.mark.parametrize("longest", [None, 0.5, 0.34])
def test_rk4_is_batched_and_exact_for_cubics_in_time(longest: float | None) -> None:
    x = np.zeros((3, 2))
    out = rk4(lambda x, t: np.full_like(x, 4 * t**3), x, 1.0, 1.0, longest=longest)
    assert np.allclose(out, 15.0, atol=1e-12) and not x.any()


@pytest.mark.parametrize(
    ("dt", "longest", "steps"),
    [(1.0, None, 1), (1.0, 2.0, 1), (1.0, 0.5, 2), (1.0, 0.4, 3), (0.1, 0.01, 10), (0.0, 0.1, 1)],
)
def test_a_step_is_cut_into_the_fewest(dt: float, longest: float | None, steps: int) -> None:
    times = []

    def rate(x: np.ndarray, t: float) -> np.ndarray:
        times.append(t)
        return -x

    moved = rk4(rate, [1.0], 3.0, dt, longest=longest)
    assert len(times) == 4 * steps
    assert np.allclose(times[::4], 3.0 + dt / steps * np.arange(steps))
    h = dt / steps
    assert np.allclose(moved, (1 - h + h**2 / 2 - h**3 / 6 + h**4 / 24) ** steps, rtol=1e-14)


def test_the_error_falls_with_the_fourth_power() -> None:
    steps = np.array([0.2, 0.1, 0.05])
    gaps = [abs(rk4(lambda x, t: x * np.cos(t), [1.0], 0.0, 2.0, longest=h)[0]
                - np.exp(np.sin(2.0))) for h in steps]
    assert abs(np.polyfit(np.log(steps), np.log(gaps), 1)[0] - 4) < 0.2


def test_a_rate_that_works_in_place_leaves_the_caller_s_states() -> None:
    def rate(x: np.ndarray, t: float) -> np.ndarray:
        x *= -1
        return x.copy()

    x = np.ones(2)
    rk4(rate, x, 0.0, 0.1)
    assert (x == 1).all()


def test_jacobian_of_a_bent_flow_in_time() -> None:
    def rate(x: np.ndarray, t: float) -> np.ndarray:
        return np.stack([x[..., 1], -np.sin(x[..., 0]) * (1 + t)], axis=-1)

    def slope(x: np.ndarray, t: float) -> np.ndarray:
        out = np.zeros((*x.shape, 2))
        out[..., 0, 1], out[..., 1, 0] = 1.0, -np.cos(x[..., 0]) * (1 + t)
        return out

    x = np.random.default_rng(0).standard_normal((4, 2))
    ours = rk4_jacobian(rate, slope, x, 0.5, 1.0, longest=0.3)
    numeric = central(lambda v: rk4(rate, v, 0.5, 1.0, longest=0.3), x)
    assert np.abs(ours - numeric).max() < 1e-8


def test_a_rate_in_integers_or_in_half_the_digits_keeps_the_states_type() -> None:
    def slow(x: np.ndarray, t: float) -> np.ndarray:
        return np.ones(x.shape, dtype=np.int64)

    def coarse(x: np.ndarray, t: float) -> np.ndarray:
        return np.full(x.shape, 0.5, dtype=np.float32)

    start = np.array([1.0 + 1e-12, 2.0])
    assert np.allclose(rk4(slow, start, 0.0, 1.0, longest=0.25), start + 1, rtol=0, atol=1e-15)
    assert np.allclose(rk4(coarse, start, 0.0, 1.0, longest=0.25), start + 0.5, rtol=0, atol=1e-15)
