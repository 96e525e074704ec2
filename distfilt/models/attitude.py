r"""Attitude of a satellite in the Hill frame, equations (19)-(21) of Grange et al.

The attitude's state is :math:`(\boldsymbol\omega, \mathbf q)`: the angular velocity of the body
relative to the Hill frame in rad/s, then a quaternion with its scalar part first, in the order that
Table III uses. Equation (21) goes with the *active* rotation matrix of :math:`\mathbf q`: then, and
not for its transpose, :math:`\dot{\mathbf R} = -[\boldsymbol\omega]_\times\mathbf R`.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike

from ..checks import Array, array, number
from .base import Model
from .integrators import rk4, rk4_jacobian
from .rotations import _quaternion, _quaternion_rate, cross_matrix, left_directions, rotation_matrix
from .satellite import clohessy_wiltshire

__all__ = ["angular_acceleration", "attitude", "satellite_pose"]


def angular_acceleration(
    quaternion: ArrayLike, angular_velocity: ArrayLike, *, rate: float
) -> Array:
    r"""The angular velocity's derivative without noise in rad/s², (..., 3), equation (20).

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
    moved = rk4(rates, rows, t, dt, longest=step)
    return np.ascontiguousarray(np.moveaxis(moved, 0, -1))


def _rates(x: Array, alpha: float) -> Array:
    """Right-hand sides of (20) and (21) together, (..., 7)."""
    rows = np.moveaxis(x, -1, 0)
    w, q = rows[:3], rows[3:]
    return np.stack([*_angular_acceleration(q, w, alpha), *_quaternion_rate(q, w)], axis=-1)


def _slopes(x: Array, alpha: float) -> Array:
    r"""Derivative of (20) and (21), (..., 7, 7).

    With v = R(q) (0, 0, α), the rate [ω]v has the slopes -[v] in ω and [ω] dv/dq in q.
    """
    w, q = x[..., :3], x[..., 3:]
    a, b, c, d = (q[..., k] for k in range(4))
    squared = (q**2).sum(axis=-1)[..., None, None]
    third = rotation_matrix(q)[..., 2]
    rows = [[c, d, a, b], [-b, -a, d, c], [a, -b, -c, d]]
    bent = np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
    turn = 2 * alpha * (bent - third[..., None] * q[..., None, :]) / squared
    out = np.zeros((*x.shape, 7))
    out[..., :3, :3] = -cross_matrix(alpha * third)
    out[..., :3, 3:] = cross_matrix(w) @ turn
    out[..., 3:, :3] = -left_directions(q)
    out[..., 3, 4:], out[..., 4:, 3] = 0.5 * w, -0.5 * w
    out[..., 4:, 4:] = -0.5 * cross_matrix(w)
    return out


def _slope_of_flow(x: Array, t: float, dt: float, alpha: float, step: float) -> Array:
    """Derivative of `_flow`, (..., 7, 7)."""
    return rk4_jacobian(
        lambda v, _: _rates(v, alpha), lambda v, _: _slopes(v, alpha), x, t, dt, longest=step
    )


def attitude(*, rate: float, sigma: float, step: float = 0.01) -> Model:
    r"""The attitude model (20)-(21) of Grange et al., integrated by Runge-Kutta of order 4.

    Its seven components are :math:`(\boldsymbol\omega, \mathbf q)`.

    Parameters
    ----------
    rate : float
        Orbital rate of the chief, in rad/s, positive.
    sigma : float
        Strength of the white noise on the angular velocity's three components, which gather a
        standard deviation of :math:`\sigma\sqrt{dt}`. Equation (21) has no noise.
    step : float
        Longest integration step, in s, positive.

    Examples
    --------
    >>> model = attitude(rate=0.1, sigma=0.2)
    >>> x = model.step([0.3, 0.2, 0.1, 1.0, 0.0, 0.0, 0.0], 0.0, 1.0)
    >>> round(float((x[3:] ** 2).sum()), 9)
    1.0
    """
    alpha = number(rate, "rate", above=0)
    strength = number(sigma, "sigma", at_least=0, at_most=1e150)
    density = strength**2 * np.diag([1.0] * 3 + [0.0] * 4)
    longest = number(step, "step", above=0)
    return Model(
        7, lambda x, t, dt: _flow(x, t, dt, alpha, longest), lambda t, dt: density * dt,
        derivative=lambda x, t, dt: _slope_of_flow(x, t, dt, alpha, longest),
        names=("w1", "w2", "w3", "q1", "q2", "q3", "q4"), units=("rad/s",) * 3 + ("1",) * 4,
    )


def satellite_pose(*, rate: float, sigma: float, step: float = 0.01) -> Model:
    r"""Translation and attitude together: the 13-component model of Table III of Grange et al.

    Translation (18) moves by its exact transition and exact noise, attitude (20)-(21) as in
    :func:`attitude`; the two do not act on each other. The components are
    :math:`(x, y, z, \dot x, \dot y, \dot z, \boldsymbol\omega, \mathbf q)`.

    Parameters
    ----------
    rate, sigma, step : float
        As for :func:`attitude`; `sigma` drives all six components of the translation and the
        angular velocity.

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

    def derivative(x: Array, t: float, dt: float) -> Array:
        out = np.zeros((*x.shape, 13))
        out[..., :6, :6] = orbit.transition_matrix(dt)
        out[..., 6:, 6:] = body._jacobian(x[..., 6:], t, dt)
        return out

    @lru_cache(maxsize=64)
    def noise(dt: float) -> Array:
        cov = np.zeros((13, 13))
        cov[:6, :6] = orbit.noise_cov(0.0, dt)
        cov[6:, 6:] = body.noise_cov(0.0, dt)
        cov.setflags(write=False)
        return cov

    return Model(
        13, flow, lambda t, dt: noise(dt), derivative=derivative, names=orbit.names + body.names,
        units=orbit.units + body.units,
    )
