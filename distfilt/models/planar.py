"""Bodies that drive in the plane: poses moved by odometry.

A pose is (x, y, heading), in m and rad; a state holds one pose after the other, and then what does
not move, such as landmarks or the constant errors of sensors.
"""

from __future__ import annotations

from functools import partial
from typing import Annotated

import numpy as np

from ..linalg import broadcast_leading
from ..validation import (
    Array,
    ArrayInput,
    NonNegativeFloat,
    NonNegativeInt,
    Times,
    validated,
)
from .base import Model
from .inputs import InputModel, Inputs

__all__ = ["drive_poses", "planar_odometry"]


@validated
def drive_poses(
    x: Annotated[ArrayInput, "... d"], u: Annotated[ArrayInput, "... k"], dt: float
) -> Array:
    """Move the poses at the front of states (..., d) by inputs (..., 3 A).

    Inputs are forward and leftward speed and turn rate of each body, in its own frame. A body moves
    on an arc, so that two steps of half the length move it as far as one.

    Parameters
    ----------
    x : array_like, (..., d)
        The poses (x, y, heading) of A bodies, and d - 3 A constants behind them.
    u : array_like, (..., 3 A)
        In m/s, m/s and rad/s; broadcast to the states.
    dt : float
        In s.

    Examples
    --------
    A quarter of a circle with radius 1, to the left:

    >>> pose = drive_poses(np.zeros(3), np.array([np.pi / 2, 0, np.pi / 2]), 1.0)
    >>> pose.round(4)
    array([1.    , 1.    , 1.5708])
    """
    n = u.shape[-1]
    if n % 3 or n > x.shape[-1]:
        raise ValueError(
            "u must have three entries for each body, whose poses are the first components of x, "
            f"got {n} for {x.shape[-1]} components"
        )
    if broadcast_leading(x.shape[:-1], u.shape[:-1], "u") != x.shape[:-1]:
        raise ValueError(
            f"u must have no more leading axes than x, {x.shape[:-1]}, got {u.shape[:-1]}"
        )
    # Poses and rates (..., A, 3) of A bodies
    poses = x[..., :n].reshape(*x.shape[:-1], -1, 3)
    rates = np.broadcast_to(u, (*x.shape[:-1], n)).reshape(poses.shape)
    turn = dt * rates[..., 2]
    # The chord of an arc points along the heading halfway, and has sin(a) / a times its length,
    # where a = ω dt / 2 is half the turn. numpy's sinc(x) is sin(πx) / (πx), so that x = a / π.
    middle = poses[..., 2] + turn / 2
    chord = dt * np.sinc(turn / (2 * np.pi))
    c = chord * np.cos(middle)
    s = chord * np.sin(middle)
    forward = rates[..., 0]
    left = rates[..., 1]
    # The speeds, turned from the body's frame, along the chord
    shift = np.stack([c * forward - s * left, s * forward + c * left, turn], axis=-1)
    moved = (poses + shift).reshape(*x.shape[:-1], n)
    return np.concatenate([moved, x[..., n:]], axis=-1)


@validated
def planar_odometry(
    times: Times,
    rates: Annotated[ArrayInput, "T k"],
    *,
    std: tuple[NonNegativeFloat, NonNegativeFloat, NonNegativeFloat] = (0.0, 0.0, 0.0),
    sigma: tuple[NonNegativeFloat, NonNegativeFloat] = (0.0, 0.0),
    n_constants: NonNegativeInt = 0,
) -> Model:
    r"""Poses that measured odometry drives, and constants behind them.

    With `std` it is an :class:`InputModel`, whose noise depends on the headings; some families
    refuse that. With `sigma` alone the noise is the same everywhere. The components have no names:
    records call them ``"0"``, ``"1"`` and so on.

    Parameters
    ----------
    times : array_like, (T,)
        When each input begins to hold, in s; the last one holds on.
    rates : array_like, (T, 3 A)
        Forward and leftward speed and turn rate of each of A bodies, in m/s, m/s and rad/s.
    std : three float
        Standard deviations of the errors of these rates. An error lasts as long as its input, and
        acts in the body's frame. Errors of two inputs are independent, so one input cut in two
        gets half of the variance.
    sigma : (float, float)
        Strengths of a random walk of each place, in m/√s, and of each heading, in rad/√s, beyond
        the errors of the rates.
    n_constants : int
        How many components stand behind the poses.

    Examples
    --------
    A body at 1 m/s turns left for two seconds, and then drives straight on:

    >>> from distfilt.models import planar_odometry
    >>> robot = planar_odometry(
    ...     [0.0, 2.0], [[1.0, 0.0, 0.5], [1.0, 0.0, 0.0]], std=(0.1, 0.0, 0.02)
    ... )
    >>> robot.step([0.0, 0.0, 0.0], 0.0, 3.0).round(3)
    array([2.223, 1.761, 1.   ])
    >>> robot.noise_at([0.0, 0.0, 0.0], 0.0, 1.0).diagonal().round(5)
    array([0.0092 , 0.00069, 0.0004 ])
    """
    k = rates.shape[-1]
    if k % 3 or not k:
        raise ValueError(
            f"rates must have three columns for each body, forward, left and turn, got {k}"
        )
    dim = k + n_constants
    place_variance, heading_variance = np.square(sigma)
    # Variances per second of x, y and heading of each body; constants have none.
    drift = np.zeros(dim)
    drift[:k] = np.tile([place_variance, place_variance, heading_variance], k // 3)
    noise_cov = partial(_random_walk_cov, np.diag(drift))
    # Every third component is a heading.
    periods = {component: 2 * np.pi for component in range(2, k, 3)}
    inputs = Inputs(times, rates, np.diag(np.tile(np.square(std), k // 3)))
    if any(std):
        return InputModel.from_inputs(
            dim, drive_poses, inputs, noise_cov, periods=periods
        )
    return Model(dim, partial(_drive, inputs), noise_cov, periods=periods)


def _drive(inputs: Inputs, x: Array, t: float, dt: float) -> Array:
    """Move states (..., d) by the inputs of a step, which are taken as exact."""
    # The parts of the step in which one input holds, one after the other
    for _begin, length, u in inputs.pieces(t, dt):
        x = drive_poses(x, u, length)
    return x


def _random_walk_cov(drift: Array, t: float, dt: float) -> Array:
    """Covariance (d, d) of a random walk after dt, whose covariance grows by `drift` per second."""
    return dt * drift
