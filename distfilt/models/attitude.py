r"""Attitude of a satellite in the Hill frame, equations (19)-(21) of Grange et al.

The attitude's state is :math:`(\boldsymbol\omega, \mathbf q)`: the angular velocity of the body
relative to the Hill frame in rad/s, then a quaternion with its scalar part first, in the order that
Table III uses. Equation (21) goes with the *active* rotation matrix of :math:`\mathbf q`: then, and
not for its transpose, :math:`\dot{\mathbf R} = -[\boldsymbol\omega]_\times\mathbf R`.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike

from ..checks import Array, array, number
from .base import Model
from .integrators import rk4
from .satellite import clohessy_wiltshire

__all__ = [
    "angular_acceleration",
    "attitude",
    "cross_matrix",
    "quaternion_rate",
    "rotation_matrix",
    "satellite_pose",
]


def cross_matrix(vector: ArrayLike) -> Array:
    r"""The matrix :math:`[\boldsymbol\omega]_\times` of the cross product, equation (19).

    Parameters
    ----------
    vector : array_like, (..., 3)

    Returns
    -------
    ndarray, (..., 3, 3)

    Examples
    --------
    >>> cross_matrix([0.0, 0.0, 1.0]) @ [1.0, 0.0, 0.0]
    array([0., 1., 0.])
    """
    w = array(vector, "vector", (..., 3))
    out = np.zeros((*w.shape, 3))
    out[..., 2, 1], out[..., 0, 2], out[..., 1, 0] = w[..., 0], w[..., 1], w[..., 2]
    out[..., 1, 2], out[..., 2, 0], out[..., 0, 1] = -w[..., 0], -w[..., 1], -w[..., 2]
    return out


def _quaternion(value: ArrayLike) -> Array:
    q = array(value, "quaternion", (..., 4))
    if not (q != 0).any(axis=-1).all():
        raise ValueError("quaternion: needs quaternions that are not zero, got a zero one")
    return q


def rotation_matrix(quaternion: ArrayLike) -> Array:
    r"""The active rotation matrix R(q) of a quaternion with its scalar part first.

    Members of an ensemble need not have unit length, so the length is divided out.

    Parameters
    ----------
    quaternion : array_like, (..., 4)
        Not zero.

    Returns
    -------
    ndarray, (..., 3, 3)

    Examples
    --------
    A quarter turn about the third axis takes the first axis to the second:

    >>> (rotation_matrix([1.0, 0.0, 0.0, 1.0]) @ [1.0, 0.0, 0.0]).round(12)
    array([0., 1., 0.])
    """
    q = _quaternion(quaternion)
    a, b, c, d = (q[..., k] for k in range(4))
    rows = [
        [a * a + b * b - c * c - d * d, 2 * (b * c - a * d), 2 * (b * d + a * c)],
        [2 * (b * c + a * d), a * a - b * b + c * c - d * d, 2 * (c * d - a * b)],
        [2 * (b * d - a * c), 2 * (c * d + a * b), a * a - b * b - c * c + d * d],
    ]
    stacked = np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
    return np.asarray(stacked / (q**2).sum(axis=-1)[..., None, None])


def quaternion_rate(quaternion: ArrayLike, angular_velocity: ArrayLike) -> Array:
    """The quaternion's derivative, equation (21); it keeps the length.

    Parameters
    ----------
    quaternion : array_like, (..., 4)
    angular_velocity : array_like, (..., 3)
        Of the body relative to the Hill frame, in rad/s.

    Returns
    -------
    ndarray, (..., 4)
        In 1/s.

    Examples
    --------
    >>> quaternion_rate([1.0, 0.0, 0.0, 0.0], [0.2, 0.0, 0.0]) + 0.0
    array([ 0. , -0.1,  0. ,  0. ])
    """
    q = _quaternion(quaternion)
    w = array(angular_velocity, "angular_velocity", (*q.shape[:-1], 3))
    return np.stack(_quaternion_rate(np.moveaxis(q, -1, 0), np.moveaxis(w, -1, 0)), axis=-1)


def _quaternion_rate(q: Array, w: Array) -> list[Array]:
    """Equation (21), components first."""
    a, b, c, d = q
    w1, w2, w3 = w
    return [
        0.5 * (b * w1 + c * w2 + d * w3),
        -0.5 * (a * w1 + d * w2 - c * w3),
        -0.5 * (a * w2 + b * w3 - d * w1),
        -0.5 * (c * w1 - b * w2 + a * w3),
    ]


def angular_acceleration(
    quaternion: ArrayLike, angular_velocity: ArrayLike, *, rate: float
) -> Array:
    r"""The angular velocity's derivative without noise, equation (20).

    .. math:: \dot{\boldsymbol\omega} = [\boldsymbol\omega]_\times\mathbf R(\mathbf q)
        \,(0, 0, \alpha)^\top

    The paper leaves open how the body turns in the inertial frame; no torque acts on it here and
    its moments of inertia are equal, so that term is zero.

    Parameters
    ----------
    quaternion : array_like, (..., 4)
    angular_velocity : array_like, (..., 3)
        In rad/s.
    rate : float
        Orbital rate α of the chief, in rad/s, at least 0.

    Returns
    -------
    ndarray, (..., 3)
        In rad/s².

    Examples
    --------
    >>> angular_acceleration([1.0, 0.0, 0.0, 0.0], [0.3, 0.0, 0.0], rate=0.1)
    array([ 0.  , -0.03,  0.  ])
    """
    q = _quaternion(quaternion)
    w = array(angular_velocity, "angular_velocity", (*q.shape[:-1], 3))
    alpha = number(rate, "rate", at_least=0)
    rows = _angular_acceleration(np.moveaxis(q, -1, 0), np.moveaxis(w, -1, 0), alpha)
    return np.stack(rows, axis=-1) + 0.0


def _angular_acceleration(q: Array, w: Array, alpha: float) -> list[Array]:
    """Equation (20), components first; only the third column of R is needed."""
    a, b, c, d = q
    w1, w2, w3 = w
    aa, bb, cc, dd = a * a, b * b, c * c, d * d
    scale = alpha / (aa + bb + cc + dd)
    v1 = 2 * scale * (b * d + a * c)
    v2 = 2 * scale * (c * d - a * b)
    v3 = scale * (aa - bb - cc + dd)
    return [w2 * v3 - w3 * v2, w3 * v1 - w1 * v3, w1 * v2 - w2 * v1]


def _flow(x: Array, t: float, dt: float, alpha: float, step: float) -> Array:
    """Attitudes (..., 7) moved by `dt` with Runge-Kutta steps no longer than `step`."""

    def rates(rows: Array, _: float) -> Array:
        w, q = rows[:3], rows[3:]
        return np.array([*_angular_acceleration(q, w, alpha), *_quaternion_rate(q, w)])

    # Components first: each operation then runs over contiguous memory.
    rows = np.ascontiguousarray(np.moveaxis(x, -1, 0))
    # A step that divides dt up to rounding is not cut once more.
    moved = rk4(rates, rows, t, dt, substeps=max(1, math.ceil(dt / step - 1e-9)))
    return np.ascontiguousarray(np.moveaxis(moved, 0, -1))


def attitude(*, rate: float, sigma: float, step: float = 0.01) -> Model:
    r"""The attitude model (20)-(21) of Grange et al., integrated by Runge-Kutta of order 4.

    Parameters
    ----------
    rate : float
        Orbital rate of the chief, in rad/s, positive.
    sigma : float
        Strength of the white noise on the angular velocity's three components, which gather a
        standard deviation of :math:`\sigma\sqrt{dt}`. Equation (21) has no noise.
    step : float
        Longest integration step, in s, positive.

    Returns
    -------
    Model
        With the seven components :math:`(\boldsymbol\omega, \mathbf q)`.

    Examples
    --------
    >>> model = attitude(rate=0.1, sigma=0.2)
    >>> x = model.step([0.3, 0.2, 0.1, 1.0, 0.0, 0.0, 0.0], 0.0, 1.0)
    >>> round(float((x[3:] ** 2).sum()), 9)
    1.0
    """
    alpha = number(rate, "rate", above=0)
    density = number(sigma, "sigma", at_least=0) ** 2 * np.diag([1.0] * 3 + [0.0] * 4)
    longest = number(step, "step", above=0)
    return Model(
        7,
        lambda x, t, dt: _flow(x, t, dt, alpha, longest),
        lambda t, dt: density * dt,
        names=("w1", "w2", "w3", "q1", "q2", "q3", "q4"),
        units=("rad/s",) * 3 + ("1",) * 4,
    )


def satellite_pose(*, rate: float, sigma: float, step: float = 0.01) -> Model:
    r"""Translation and attitude together: the 13-component model of Table III of Grange et al.

    Translation (18) moves by its exact transition and exact noise, attitude (20)-(21) as in
    :func:`attitude`; the two do not act on each other.

    Parameters
    ----------
    rate, sigma, step : float
        As for :func:`attitude`; `sigma` drives all six components of the translation and the
        angular velocity.

    Returns
    -------
    Model
        With the components :math:`(x, y, z, \dot x, \dot y, \dot z, \boldsymbol\omega, \mathbf q)`.

    Examples
    --------
    >>> satellite_pose(rate=0.1, sigma=0.2).names[6:10]
    ('w1', 'w2', 'w3', 'q1')
    """
    orbit = clohessy_wiltshire(rate=rate, sigma=sigma)
    body = attitude(rate=rate, sigma=sigma, step=step)

    def flow(x: Array, t: float, dt: float) -> Array:
        moved = orbit.flow(x[..., :6], t, dt)
        return np.concatenate([moved, body.flow(x[..., 6:], t, dt)], axis=-1)

    @lru_cache(maxsize=64)
    def noise(dt: float) -> Array:
        cov = np.zeros((13, 13))
        cov[:6, :6] = orbit.noise_covariance(0.0, dt)
        cov[6:, 6:] = body.noise_covariance(0.0, dt)
        cov.setflags(write=False)
        return cov

    return Model(
        13, flow, lambda t, dt: noise(dt), orbit.names + body.names, orbit.units + body.units
    )
