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

# Full, of several components, and without a symmetry that would hide a transposed
# factor.
FULL = np.array([[4.0, 1.2, -0.6], [1.2, 1.0, 0.3], [-0.6, 0.3, 0.5]])


def _no_noise(t: float, dt: float) -> np.ndarray:
    return np.zeros((2, 2))


def _add_dt_in_place(x: np.ndarray, t: float, dt: float) -> np.ndarray:
    x += dt
    return x


def test_a_transition_that_works_in_place_does_not_change_the_caller_s_states() -> None:
    """It gets copies, in all methods that call it."""
    model = Model(2, _add_dt_in_place, _no_noise)
    x = np.ones((3, 2))
    # x + dt, without noise
    assert (model.step(x, 0.0, 0.5) == 1.5).all()
    assert (model.sample_step(x, 0.0, 0.5, rng=generator()) == 1.5).all()
    # d(x + dt)/dx = I
    jacobian = model.jacobian(x, 0.0, 0.5)
    assert np.abs(jacobian - np.eye(2)).max() < 1e-9
    # Two steps of 1 from the same start
    states = simulate(model, x, [1.0, 2.0], rng=generator())
    assert (states[0] == 2.0).all()
    assert (states[1] == 3.0).all()
    assert (x == 1.0).all()


def test_the_noise_covariance_is_a_read_only_copy_and_its_root_a_factor() -> None:
    q = FULL.copy()
    model = Model(3, lambda x, t, dt: x, lambda t, dt: q)
    cov = model.Q(0.0, 1.0)
    assert not cov.flags.writeable
    assert not np.shares_memory(cov, q)
    # L Lᵀ = Q
    lower = model.noise_sqrt(0.0, 1.0)
    assert np.allclose(lower @ lower.T, FULL, rtol=1e-14)


@pytest.mark.parametrize("method", ["sample_step", "simulate"])
def test_sampled_noise_has_the_full_covariance(method: str) -> None:
    """Each entry lies in its 99.99% interval, which a transposed factor misses."""
    model = Model(3, lambda x, t, dt: x, lambda t, dt: dt * FULL)
    n = 40_000
    start = np.zeros((n, 3))
    # Two steps of 0.2 and 0.3 add as much noise as one of 0.5.
    if method == "simulate":
        samples = simulate(model, start, [0.2, 0.5], rng=generator(1))[1]
    else:
        samples = model.sample_step(start, 0.0, 0.5, rng=generator(1))
    cov = 0.5 * FULL
    # Var of an entry of the sample covariance: (P_ij² + P_ii P_jj)/n
    variances = cov.diagonal()
    entry_variances = (cov**2 + np.outer(variances, variances)) / n
    standard_error = np.sqrt(entry_variances)
    sample_cov = samples.T @ samples / n
    error = np.abs(sample_cov - cov)
    assert (error < 3.9 * standard_error).all()


@pytest.mark.parametrize(
    ("transposed", "dt"), [(False, 1e-4), (True, 0.5), (True, 1e-4)]
)
def test_a_transposed_derivative_or_transition_matrix_is_warned_of_once(
    transposed: bool, dt: float
) -> None:
    """Of two uses only the first warns, and none if the matrices are right."""
    exact = constant_velocity(sigma=0.3, axes=1)

    def phi(dt: float) -> np.ndarray:
        return exact.F(dt).T if transposed else exact.F(dt)

    model = Model(
        2, exact.transition, exact.noise_cov, derivative=lambda x, t, dt: phi(dt)
    )
    # Differences show a transposed derivative, and a transposed Φ violates
    # Q(dt) = Φ(dt/2) Q(dt/2) Φ(dt/2)ᵀ + Q(dt/2).
    linear = LinearModel.from_transition(2, phi, exact.noise_cov)
    with warnings.catch_warnings(record=True, action="always") as messages:
        for _ in range(2):
            model.jacobian(np.ones((3, 2)), 0.0, dt)
            linear.sample_step(np.ones(2), 0.0, dt, rng=generator())
    # A message begins with the name of the argument.
    arguments = [str(message.message).split()[0] for message in messages]
    assert arguments == ["derivative", "transition_matrix"] * transposed


def test_noise_that_is_tabulated_at_whole_steps_only_is_not_compared() -> None:
    """The comparison needs half steps: without them it is skipped."""
    table = {1.0: np.eye(2)}
    model = LinearModel.from_transition(
        2, lambda dt: np.eye(2), lambda t, dt: table[dt]
    )
    assert (model.Q(0.0, 1.0) == np.eye(2)).all()


def test_simulation_passes_times_and_steps_to_transition_and_noise() -> None:
    calls = []

    def transition(x: np.ndarray, t: float, dt: float) -> np.ndarray:
        calls.append((t, dt))
        return x

    def noise_cov(t: float, dt: float) -> np.ndarray:
        calls.append((t, dt))
        return np.zeros((1, 1))

    model = Model(1, transition, noise_cov)
    simulate(model, [0.0], [1.5, 4.0], rng=generator(), t0=1.0)
    # Steps from 1 to 1.5 and from 1.5 to 4, for both functions.
    assert calls == [(1.0, 0.5)] * 2 + [(1.5, 2.5)] * 2


def _bend(x: np.ndarray, t: float, dt: float) -> np.ndarray:
    first = x[..., 0] * x[..., 1]
    second = np.sin(x[..., 0]) + t + dt
    return np.stack([first, second], axis=-1)


def _bend_derivative(x: np.ndarray, t: float, dt: float) -> np.ndarray:
    # (x_1, x_0; cos x_0, 0)
    jacobian = np.zeros((*x.shape, 2))
    jacobian[..., 0, 0] = x[..., 1]
    jacobian[..., 0, 1] = x[..., 0]
    jacobian[..., 1, 0] = np.cos(x[..., 0])
    return jacobian


def test_jacobian_by_differences_and_by_a_derivative() -> None:
    x = generator().standard_normal((4, 3, 2))
    exact = _bend_derivative(x, 0.3, 0.1)
    # Central differences are accurate to about 1e-10.
    jacobian = Model(2, _bend, _no_noise).jacobian(x, 0.3, 0.1)
    assert jacobian.shape == (4, 3, 2, 2)
    assert np.abs(jacobian - exact).max() < 1e-9
    # A user's derivative is returned as it is.
    model = Model(2, _bend, _no_noise, derivative=_bend_derivative)
    assert (model.jacobian(x, 0.3, 0.1) == exact).all()


@pytest.mark.parametrize("shape", [(6,), (2, 6)])
def test_jacobian_of_a_linear_model_is_its_matrix(shape: tuple[int, ...]) -> None:
    model = clohessy_wiltshire(rate=0.1, sigma=0.2)
    jacobian = model.jacobian(np.ones(shape), 0.0, 0.7)
    assert jacobian.shape == (*shape, 6)
    assert (jacobian == model.F(0.7)).all()


def _first_axis_in_place(x: np.ndarray, t: float, dt: float) -> np.ndarray:
    x[0] += x[1] * dt
    return x


@pytest.mark.parametrize(
    "transition",
    [
        lambda x, t, dt: np.array([x[1], -x[0], x[2], x[3]]),
        lambda x, t, dt: np.triu(np.ones((4, 4))) @ x,
        _first_axis_in_place,
    ],
)
@pytest.mark.parametrize("shape", [(4, 4), (4, 7, 4), (3, 4)])
def test_a_transition_of_a_single_state_is_refused_for_many(
    transition: Any, shape: tuple[int, ...]
) -> None:
    """Also if there are as many states as components, so that the shape is right."""
    # Each row of the result has to be the transition of that row alone.
    model = Model(4, transition, lambda t, dt: np.zeros((4, 4)))
    # A single state is fine.
    assert model.step(np.arange(4.0), 0.0, 0.1).shape == (4,)
    x = generator().standard_normal(shape)
    sample_step = partial(model.sample_step, rng=generator())
    # Refused every time, not only at the first call.
    for step in (model.step, sample_step, model.step, sample_step):
        with pytest.raises(
            ValueError, match="transition must take many states at once"
        ):
            step(x, 0.0, 0.1)


def test_a_transition_of_many_states_is_compared_with_one_of_a_single_state_once() -> (
    None
):
    """Equal states show nothing yet: the comparison ends with the first that differ."""
    shapes = []

    def transition(x: np.ndarray, t: float, dt: float) -> np.ndarray:
        shapes.append(x.shape)
        return 2 * x

    model = Model(2, transition, _no_noise)
    for k, n in enumerate((1, 3)):
        equal = np.ones((n, 2))
        different = generator().standard_normal((n, 2))
        later = generator(1).standard_normal((n, 2))
        for x in (equal, equal, different, later):
            model.step(x, 0.0, 0.1)
        # Three comparisons for a single row, and three more for several. Each moves the single
        # state twice: a function that draws noise gives two results.
        assert shapes.count((2,)) == 2 * (3 + 3 * k)


def test_a_transition_with_an_input_for_each_agent_is_accepted() -> None:
    """It cannot be called with a single state, so there is nothing to compare."""
    inputs = np.arange(6.0).reshape(3, 2)
    model = Model(2, lambda x, t, dt: x + inputs, _no_noise)
    assert (model.step(np.zeros((3, 2)), 0.0, 0.1) == inputs).all()


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
    """Processes of a study send them to each other."""
    model = getattr(models, name)(**SHIPPED[name])
    copy = pickle.loads(pickle.dumps(model))
    x = generator().random(model.dim)
    if name == "orbits":
        # A state outside the Earth.
        x = np.array([42164.0, 1, 2, 0.1, 3074.0, 0.2])
    # The copy computes the same, to the last bit.
    assert (copy.step(x, 0.0, 0.2) == model.step(x, 0.0, 0.2)).all()
    assert (copy.jacobian(x, 0.0, 0.2) == model.jacobian(x, 0.0, 0.2)).all()
    assert (copy.Q(0.0, 0.2) == model.Q(0.0, 0.2)).all()


def test_names_are_different() -> None:
    """Two of one name could not be told apart in a record, a reset or a truth."""
    with pytest.raises(ValueError, match=r"names must be different, got \['x', 'x'\]"):
        Model(2, lambda x, t, dt: x, lambda t, dt: np.eye(2), names=("x", "x"))
