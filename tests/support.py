"""Random covariances, their comparison, wrong values and a model, for several tests."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from distfilt.models import Model, constant_velocity
from distfilt.validation import skip_validation

NAN = float("nan")
INDEFINITE = [[1.0, 2.0], [2.0, 1.0]]
ASYMMETRIC = [[1.0, 0.5], [0.0, 1.0]]


def generator(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def spd(
    rng: np.random.Generator,
    d: int,
    leading: tuple[int, ...] = (),
    *,
    least: float = 0.1,
) -> np.ndarray:
    """Random full covariances with eigenvalues above `least`."""
    a = rng.standard_normal((*leading, d, d))
    # A Aᵀ + λ I has no eigenvalue below λ.
    square = a @ np.swapaxes(a, -1, -2)
    return square + least * np.eye(d)


def singular(
    rng: np.random.Generator, d: int, rank: int, leading: tuple[int, ...] = ()
) -> np.ndarray:
    """Random full covariances of the given rank."""
    a = rng.standard_normal((*leading, d, rank))
    cov = a @ np.swapaxes(a, -1, -2)
    # Exactly symmetric, though products are rounded
    return 0.5 * (cov + np.swapaxes(cov, -1, -2))


def relative_difference(actual: np.ndarray, expected: np.ndarray) -> float:
    """Largest difference of two covariances, in units of the expected deviations."""
    variances = np.diagonal(expected, axis1=-2, axis2=-1)
    std = np.where(variances > 0, np.sqrt(variances), 1.0)
    scale = std[..., :, None] * std[..., None, :]
    return float((np.abs(actual - expected) / scale).max())


def turning(*, sigma: float, turn_sigma: float) -> Model:
    """Position, velocity and turn rate in the plane: a turn at constant speed, not linear."""
    straight = constant_velocity(sigma=sigma)

    def transition(x: np.ndarray, t: float, dt: float) -> np.ndarray:
        p = x[..., :2]
        v = x[..., 2:4]
        tau = x[..., 4:] * dt
        normal = np.stack([-v[..., 1], v[..., 0]], axis=-1)
        # p' = p + ∫ R(ω s) v ds, with integrals of cosine and sine smooth at ω = 0.
        along = np.sinc(tau / np.pi)
        across = 0.5 * tau * np.sinc(0.5 * tau / np.pi) ** 2
        position = p + dt * (along * v + across * normal)
        velocity = np.cos(tau) * v + np.sin(tau) * normal
        return np.concatenate([position, velocity, x[..., 4:]], axis=-1)

    def derivative(x: np.ndarray, t: float, dt: float) -> np.ndarray:
        # For turns that are not tiny
        tau = x[..., 4, None, None] * dt
        v = x[..., 2:4, None]
        one = np.eye(2)
        normal = np.array([[0.0, -1.0], [1.0, 0.0]])
        sine = np.sin(tau) / tau
        cosine = (1 - np.cos(tau)) / tau
        jacobian = np.zeros((*x.shape, 5))
        jacobian[..., :2, :2] = one
        jacobian[..., 4, 4] = 1.0
        # ∫ R(ω s) ds = dt (sin τ/τ I + (1 - cos τ)/τ N), with N a quarter turn and τ = ω dt
        jacobian[..., :2, 2:4] = dt * (sine * one + cosine * normal)
        # R(τ) = cos τ I + sin τ N
        jacobian[..., 2:4, 2:4] = np.cos(tau) * one + np.sin(tau) * normal
        # Derivatives in the turn rate: of the position, and of the velocity
        bent = (np.cos(tau) - sine) * one + (np.sin(tau) - cosine) * normal
        jacobian[..., :2, 4:] = dt**2 / tau * (bent @ v)
        rotation_rate = -np.sin(tau) * one + np.cos(tau) * normal
        jacobian[..., 2:4, 4:] = dt * rotation_rate @ v
        return jacobian

    def noise(t: float, dt: float) -> np.ndarray:
        cov = np.zeros((5, 5))
        cov[:4, :4] = straight.Q(t, dt)
        cov[4, 4] = turn_sigma**2 * dt
        return cov

    return Model(5, transition, noise, derivative=derivative)


def without_checks(function: Callable[..., Any]) -> Callable[..., Any]:
    """The function as the library's own loops call it, without checks of its arguments."""

    def call(*args: Any, **options: Any) -> Any:
        with skip_validation():
            return function(*args, **options)

    return call
