"""Models: steps, noise with the stated covariance, Jacobians, trajectories."""

from __future__ import annotations

import pickle
import warnings
from functools import partial
from typing import Any

import numpy as np
import pytest

from distfilt import models
from distfilt.models import LinearModel, Model, constant_velocity, simulate
from distfilt.models.satellite import clohessy_wiltshire
from tests.support import generator

# Full, of several components, and with no symmetry that a transposed factor could hide behind.
FULL = np.array([[4.0, 1.2, -0.6], [1.2, 1.0, 0.3], [-0.6, 0.3, 0.5]])


def _in_place(x: np.ndarray, t: float, dt: float) -> np.ndarray:
    x += dt
    return x


def test_a_flow_that_works_in_place_leaves_the_caller_s_states() -> None:
    model = Model(2, _in_place, lambda t, dt: np.zeros((2, 2)))
    x = np.ones((3, 2))
    assert (model.step(x, 0.0, 0.5) == 1.5).all() and (x == 1.0).all()
    assert (model.sample_step(x, 0.0, 0.5, rng=generator()) == 1.5).all() and (
        x == 1.0
    ).all()
    assert (
        np.abs(model.jacobian(x, 0.0, 0.5) - np.eye(2)).max() < 1e-9
        and (x == 1.0).all()
    )
    path = simulate(model, x, [1.0, 2.0], rng=generator())
    assert (path[0] == 2.0).all() and (path[1] == 3.0).all() and (x == 1.0).all()


def test_noise_cannot_be_changed_through_what_it_returns_and_its_root_is_a_factor() -> (
    None
):
    q = FULL.copy()
    model = Model(3, lambda x, t, dt: x, lambda t, dt: q)
    found = model.Q(0.0, 1.0)
    root = model.noise_sqrt(0.0, 1.0)
    assert not found.flags.writeable and not np.shares_memory(found, q)
    assert np.allclose(root @ root.T, FULL, rtol=1e-14)


@pytest.mark.parametrize("door", ["sample_step", "simulate"])
def test_drawn_noise_has_the_full_covariance(door: str) -> None:
    """Each entry lies in its 99.99% band, which a transposed factor misses; steps add up."""
    model = Model(3, lambda x, t, dt: x, lambda t, dt: dt * FULL)
    n = 40_000
    if door == "simulate":
        draws = simulate(model, np.zeros((n, 3)), [0.2, 0.5], rng=generator(1))[1]
    else:
        draws = model.sample_step(np.zeros((n, 3)), 0.0, 0.5, rng=generator(1))
    truth = 0.5 * FULL
    error = np.sqrt((truth**2 + np.outer(truth.diagonal(), truth.diagonal())) / n)
    assert (np.abs(draws.T @ draws / n - truth) < 3.9 * error).all()


@pytest.mark.parametrize(("turned", "dt"), [(False, 1e-4), (True, 0.5), (True, 1e-4)])
def test_a_transposed_derivative_or_transition_is_told_once(
    turned: bool, dt: float
) -> None:
    straight = constant_velocity(sigma=0.3, axes=1)
    phi = (lambda dt: straight.F(dt).T) if turned else straight.F
    model = Model(
        2, straight.transition, straight.noise_cov, derivative=lambda x, t, dt: phi(dt)
    )
    linear = LinearModel.from_transition(2, phi, straight.noise_cov)
    with warnings.catch_warnings(record=True, action="always") as told:
        for _ in range(2):
            model.jacobian(np.ones((3, 2)), 0.0, dt)
            linear.sample_step(np.ones(2), 0.0, dt, rng=generator())
    words = [str(one.message).split(":")[0] for one in told]
    assert words == ["derivative", "transition_matrix"] * turned
    LinearModel.from_transition(2, phi, lambda t, dt: {1.0: np.eye(2)}[dt]).Q(0.0, 1.0)


def test_simulation_passes_the_times_on() -> None:
    seen = []

    def flow(x: np.ndarray, t: float, dt: float) -> np.ndarray:
        seen.append((t, dt))
        return x

    model = Model(1, flow, lambda t, dt: seen.append((t, dt)) or np.zeros((1, 1)))
    simulate(model, [0.0], [1.5, 4.0], rng=generator(), t0=1.0)
    assert seen == [(1.0, 0.5)] * 2 + [(1.5, 2.5)] * 2


def test_jacobian_by_differences_given_and_of_a_matrix() -> None:
    def flow(x: np.ndarray, t: float, dt: float) -> np.ndarray:
        return np.stack([x[..., 0] * x[..., 1], np.sin(x[..., 0]) + t + dt], axis=-1)

    def exact(x: np.ndarray, t: float, dt: float) -> np.ndarray:
        out = np.zeros((*x.shape, 2))
        out[..., 0, 0] = x[..., 1]
        out[..., 0, 1] = x[..., 0]
        out[..., 1, 0] = np.cos(x[..., 0])
        return out

    x = generator().standard_normal((4, 3, 2))
    model = Model(2, flow, lambda t, dt: np.eye(2))
    slope = model.jacobian(x, 0.3, 0.1)
    assert (
        slope.shape == (4, 3, 2, 2) and np.abs(slope - exact(x, 0.3, 0.1)).max() < 1e-9
    )
    given = Model(2, flow, lambda t, dt: np.eye(2), derivative=exact)
    assert (given.jacobian(x, 0.3, 0.1) == exact(x, 0.3, 0.1)).all()
    orbit = clohessy_wiltshire(rate=0.1, sigma=0.2)
    for state in (np.ones(6), np.ones((2, 6))):
        slope = orbit.jacobian(state, 0.0, 0.7)
        assert slope.shape == (*state.shape, 6) and (slope == orbit.F(0.7)).all()


def _column_in_place(x: np.ndarray, t: float, dt: float) -> np.ndarray:
    x[0] += x[1] * dt
    return x


@pytest.mark.parametrize(
    "flow",
    [
        lambda x, t, dt: np.array([x[1], -x[0], x[2], x[3]]),
        lambda x, t, dt: np.triu(np.ones((4, 4))) @ x,
        _column_in_place,
    ],
)
@pytest.mark.parametrize("shape", [(4, 4), (4, 7, 4), (3, 4)])
def test_a_flow_for_one_state_is_refused(flow: Any, shape: tuple[int, ...]) -> None:
    """Also where there are as many agents or members as components and the shape is right."""
    model = Model(4, flow, lambda t, dt: np.zeros((4, 4)))
    assert model.step(np.arange(4.0), 0.0, 0.1).shape == (4,)
    x = generator().standard_normal(shape)
    for step in (model.step, partial(model.sample_step, rng=generator())) * 2:
        with pytest.raises(
            ValueError, match="transition must take many states at once"
        ):
            step(x, 0.0, 0.1)


def test_a_flow_of_many_states_is_asked_once() -> None:
    """Equal states say nothing yet; each agent's own input has no single state to compare with."""
    shapes = []

    def flow(x: np.ndarray, t: float, dt: float) -> np.ndarray:
        shapes.append(x.shape)
        return 2 * x

    model = Model(2, flow, lambda t, dt: np.zeros((2, 2)))
    for k, n in enumerate((1, 3)):
        for x in (
            np.ones((n, 2)),
            np.ones((n, 2)),
            generator().standard_normal((n, 2)),
        ):
            model.step(x, 0.0, 0.1)
        model.step(generator(1).standard_normal((n, 2)), 0.0, 0.1)
        assert shapes.count((2,)) == 3 + 3 * k
    moves = np.arange(6.0).reshape(3, 2)
    given = Model(2, lambda x, t, dt: x + moves, lambda t, dt: np.zeros((2, 2)))
    assert (given.step(np.zeros((3, 2)), 0.0, 0.1) == moves).all()


SHIPPED = {
    "constant_velocity": {"sigma": 0.1},
    "clohessy_wiltshire": {"rate": 0.1, "sigma": 0.2},
    "satellite_pose": {"rate": 0.1, "sigma": 0.2},
    "lorenz63": {"sigma": 0.1},
    "pendulum": {},
    "pendulum_angle": {},
    "orbits": {"velocity_std": 1e-6},
}


@pytest.mark.parametrize("name", SHIPPED)
def test_shipped_models_can_be_pickled(name: str) -> None:
    model = getattr(models, name)(**SHIPPED[name])
    again = pickle.loads(pickle.dumps(model))
    high = np.array([42164.0, 1, 2, 0.1, 3074.0, 0.2])
    x = high if name == "orbits" else generator().random(model.dim)
    assert (again.step(x, 0.0, 0.2) == model.step(x, 0.0, 0.2)).all()
    assert (again.jacobian(x, 0.0, 0.2) == model.jacobian(x, 0.0, 0.2)).all()
    assert (again.Q(0.0, 0.2) == model.Q(0.0, 0.2)).all()
