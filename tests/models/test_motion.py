"""The Runge-Kutta rule, straight motion and Lorenz's model against closed forms and other rules."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from distfilt.models import constant_velocity, lorenz63, rk4


@pytest.mark.parametrize("longest", [None, 0.5, 0.34])
def test_rk4_is_batched_and_exact_for_cubics_in_time(longest: float | None) -> None:
    x = np.zeros((3, 2))
    out = rk4(lambda x, t: np.full_like(x, 4 * t**3), x, 1.0, 1.0, longest=longest)
    assert np.allclose(out, 15.0, atol=1e-12) and not x.any()


@pytest.mark.parametrize(
    ("dt", "longest", "steps"),
    [
        (1.0, None, 1),
        (1.0, 2.0, 1),
        (1.0, 0.5, 2),
        (1.0, 0.4, 3),
        (0.1, 0.01, 10),
        (0.0, 0.1, 1),
    ],
)
def test_a_step_is_cut_into_the_fewest(
    dt: float, longest: float | None, steps: int
) -> None:
    times = []

    def rate(x: np.ndarray, t: float) -> np.ndarray:
        times.append(t)
        return -x

    moved = rk4(rate, [1.0], 3.0, dt, longest=longest)
    assert len(times) == 4 * steps
    assert np.allclose(times[::4], 3.0 + dt / steps * np.arange(steps))
    h = dt / steps
    assert np.allclose(
        moved, (1 - h + h**2 / 2 - h**3 / 6 + h**4 / 24) ** steps, rtol=1e-14
    )


def test_a_rate_may_work_in_place() -> None:
    """It may return one array of its own each time, or change and return the states it gets."""
    x = np.array([1.0, -2.0])
    buffer = np.empty(2)
    wanted = rk4(lambda x, t: -x * np.cos(t), x, 0.0, 1.0, longest=0.5)
    for rate in (
        lambda x, t: np.multiply(x, -np.cos(t), out=buffer),
        lambda x, t: np.multiply(x, -np.cos(t), out=x),
        lambda x, t: np.multiply(x, -np.cos(t), out=x).copy(),
    ):
        assert (rk4(rate, x, 0.0, 1.0, longest=0.5) == wanted).all()
        assert (x == [1.0, -2.0]).all()


@pytest.mark.parametrize(
    "rate", [np.int64(1), np.float32(0.5)], ids=["integers", "half"]
)
def test_a_rate_in_another_type_keeps_the_states_digits(rate: np.generic) -> None:
    start = np.array([1.0 + 1e-12, 2.0])
    moved = rk4(lambda x, t: np.full(x.shape, rate), start, 0.0, 1.0, longest=0.25)
    assert np.allclose(moved, start + float(rate), rtol=0, atol=1e-15)


@pytest.mark.parametrize("axes", [1, 2, 3])
def test_straight_motion(axes: int) -> None:
    model = constant_velocity(sigma=0.3, axes=axes)
    p = np.arange(1.0, 1 + axes)
    v = np.arange(axes) - 0.5
    assert np.allclose(model.step([*p, *v], 0.0, 2.0), [*(p + 2 * v), *v])
    # The integral of the noise's response, by components: 0.09 (8/3, 4/2; 4/2, 2).
    exact = np.kron([[8 / 3, 2.0], [2.0, 2.0]], 0.09 * np.eye(axes))
    assert np.allclose(model.Q(0.0, 2.0), exact)
    assert model.names == (*"xyz"[:axes], *(f"v{k}" for k in "xyz"[:axes]))
    assert model.units == ("m",) * axes + ("m/s",) * axes


def test_lorenz_agrees_with_an_adaptive_rule() -> None:
    """From twenty states near the attractor: closer with the step's fourth power; and its noise."""
    starts = np.array([1.5, -1.5, 25.5]) + np.random.default_rng(0).standard_normal(
        (20, 3)
    )

    def rate(t: float, v: np.ndarray) -> np.ndarray:
        x, y, z = v.reshape(20, 3).T
        return np.stack(
            [10 * (y - x), x * (28 - z) - y, x * y - 8 / 3 * z], axis=-1
        ).ravel()

    run = solve_ivp(
        rate, (0, 1), starts.ravel(), method="DOP853", rtol=1e-13, atol=1e-13
    )
    exact = run.y[:, -1].reshape(20, 3)
    steps = np.array([0.01, 0.005, 0.0025, 0.00125])
    gaps = [lorenz63(step=h).step(starts, 0.0, 1.0) - exact for h in steps]
    error = [np.sqrt((gap**2).mean()) for gap in gaps]
    assert error[-1] < 1e-7
    assert abs(np.polyfit(np.log(steps), np.log(error), 1)[0] - 4) < 0.3
    assert np.allclose(lorenz63(sigma=0.5).Q(0.0, 0.1), 0.025 * np.eye(3))
    assert not lorenz63().Q(0.0, 0.1).any()
