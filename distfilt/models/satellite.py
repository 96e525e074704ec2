r"""Motion of a satellite in the Hill frame of a chief on a circular orbit: place and attitude.

The axes are radial (away from the Earth), along the track, and along the orbit's normal. The place
is :math:`(x, y, z, \dot x, \dot y, \dot z)` in m and m/s, equation (18) of Grange et al. The
attitude, (19)-(21), is :math:`(\boldsymbol\omega, \mathbf q)`: the angular velocity of the body
relative to the Hill frame in rad/s, then a quaternion with its scalar part first, in the order that
Table III uses. Equation (21) goes with the *active* rotation matrix of :math:`\mathbf q`: then, and
not for its transpose, :math:`\dot{\mathbf R} = -[\boldsymbol\omega]_\times\mathbf R`.
"""

from __future__ import annotations

from functools import lru_cache, partial

import numpy as np

from ..doors import Array, Positive, door, unchecked
from ..linalg import van_loan
from .base import LinearModel, Model, Strength
from .integrators import rk4, rk4_jacobian
from .rotations import cross_matrix, kinematics, left_directions, rotation_matrix

__all__ = ["clohessy_wiltshire", "satellite_pose"]


def _drift(rate: float) -> Array:
    """The matrix A, (6, 6), of the Clohessy-Wiltshire equations."""
    a = np.zeros((6, 6))
    a[:3, 3:] = np.eye(3)
    a[3, 0], a[3, 4] = 3 * rate * rate, 2 * rate
    a[4, 3] = -2 * rate
    a[5, 2] = -rate * rate
    return a


@lru_cache(maxsize=64)
def _transition(dt: float, rate: float) -> Array:
    """The exact transition exp(A dt); Journal of the Aerospace Sciences 27 (1960) 653-658."""
    n, tau = rate, rate * dt
    s, c = np.sin(tau), np.cos(tau)
    # Columns: x, y, z, and the three velocities; rows: the same after the step.
    phi = np.array(
        [
            [4 - 3 * c, 0, 0, s / n, 2 * (1 - c) / n, 0],
            [6 * (s - tau), 1, 0, 2 * (c - 1) / n, (4 * s - 3 * tau) / n, 0],
            [0, 0, c, 0, 0, s / n],
            [3 * n * s, 0, 0, c, 2 * s, 0],
            [6 * n * (c - 1), 0, 0, -2 * s, 4 * c - 3, 0],
            [0, 0, -n * s, 0, 0, c],
        ]
    )
    phi.setflags(write=False)
    return phi


@lru_cache(maxsize=64)
def _noise(rate: float, sigma: float, dt: float) -> Array:
    cov = unchecked(van_loan)(_drift(rate), sigma**2 * np.eye(6), dt)[1]
    cov.setflags(write=False)
    return cov


def _place_noise(t: float, dt: float, rate: float, sigma: float) -> Array:
    return _noise(rate, sigma, dt)


@door
def clohessy_wiltshire(*, rate: Positive, sigma: Strength) -> LinearModel:
    r"""The Clohessy-Wiltshire model, equation (18) of Grange et al., with noise on all six rows.

    Parameters
    ----------
    rate : float
        Orbital rate of the chief, in rad/s, positive.
    sigma : float
        The noise's strength: each row receives white noise of spectral density sigma² (per s), so
        that a component gathers a standard deviation of about :math:`\sigma\sqrt{dt}`.

    Examples
    --------
    >>> model = clohessy_wiltshire(rate=0.1, sigma=0.2)
    >>> model.noise(0.0, 0.1).diagonal().round(5)
    array([0.00401, 0.00401, 0.00401, 0.004  , 0.004  , 0.004  ])
    """
    return LinearModel.from_transition(
        6, partial(_transition, rate=rate), partial(_place_noise, rate=rate, sigma=sigma),
        names=("x", "y", "z", "vx", "vy", "vz"), units=("m", "m", "m", "m/s", "m/s", "m/s"),
    )


@door
def satellite_pose(*, rate: Positive, sigma: Strength, step: Positive = 0.01) -> Model:
    r"""Translation and attitude together: the 13-component model of Table III of Grange et al.

    Translation (18) moves by its exact transition and exact noise, attitude (20)-(21) by
    Runge-Kutta of order 4; equation (21) has no noise. The two do not act on each other. The
    components are :math:`(x, y, z, \dot x, \dot y, \dot z, \boldsymbol\omega, \mathbf q)`.

    Parameters
    ----------
    rate, sigma, step : float
        As for :func:`clohessy_wiltshire`, with the longest step of the integration, in s;
        `sigma` drives all six components of the translation and the
        angular velocity.

    Examples
    --------
    >>> satellite_pose(rate=0.1, sigma=0.2).names[6:10]
    ('w1', 'w2', 'w3', 'q1')
    """
    place = clohessy_wiltshire(rate=rate, sigma=sigma)
    return Model(
        13, partial(_flow, rate=rate, step=step), partial(_pose_noise, rate=rate, sigma=sigma),
        derivative=partial(_derivative, rate=rate, step=step),
        names=(*place.names, "w1", "w2", "w3", "q1", "q2", "q3", "q4"),
        units=(*place.units, *["rad/s"] * 3, *["1"] * 4),
    )


def _pose_noise(t: float, dt: float, rate: float, sigma: float) -> Array:
    cov = np.zeros((13, 13))
    cov[:6, :6] = _noise(rate, sigma, dt)
    cov[6:9, 6:9] = sigma**2 * dt * np.eye(3)
    return cov


def _flow(x: Array, t: float, dt: float, rate: float, step: float) -> Array:
    moved = x[..., :6] @ _transition(dt, rate).T
    # Components first: each operation then runs over contiguous memory.
    rows = np.ascontiguousarray(np.moveaxis(x[..., 6:], -1, 0))
    body = unchecked(rk4)(partial(_rates, alpha=rate), rows, t, dt, longest=step)
    return np.concatenate([moved, np.moveaxis(body, 0, -1)], axis=-1)


def _derivative(x: Array, t: float, dt: float, rate: float, step: float) -> Array:
    def rates(body: Array, _: float) -> Array:
        return np.moveaxis(_rates(np.moveaxis(body, -1, 0), 0.0, rate), 0, -1)

    out = np.zeros((*x.shape, 13))
    out[..., :6, :6] = _transition(dt, rate)
    out[..., 6:, 6:] = rk4_jacobian(rates, partial(_slopes, alpha=rate), x[..., 6:], t, dt, step)
    return out


def _rates(rows: Array, t: float, alpha: float) -> Array:
    """Right-hand sides of (20) and (21) together, components first."""
    w, q = rows[:3], rows[3:]
    return np.array([*_angular_acceleration(q, w, alpha), *kinematics(q, w)])


def _angular_acceleration(q: Array, w: Array, alpha: float) -> list[Array]:
    r"""The angular velocity's derivative, equation (20), components first.

    :math:`\dot{\boldsymbol\omega} = [\boldsymbol\omega]_\times\mathbf R(\mathbf q)\,(0, 0,
    \alpha)^\top`: only the third column of R is needed. The paper leaves open how the body turns in
    the inertial frame; no torque acts on it here and its moments of inertia are equal, so that term
    is zero.
    """
    a, b, c, d = q
    w1, w2, w3 = w
    aa, bb, cc, dd = a * a, b * b, c * c, d * d
    scale = alpha / (aa + bb + cc + dd)
    v1 = 2 * scale * (b * d + a * c)
    v2 = 2 * scale * (c * d - a * b)
    v3 = scale * (aa - bb - cc + dd)
    return [w2 * v3 - w3 * v2, w3 * v1 - w1 * v3, w1 * v2 - w2 * v1]


def _slopes(x: Array, t: float, alpha: float) -> Array:
    r"""Derivative of (20) and (21), (..., 7, 7).

    With v = R(q) (0, 0, α), the rate [ω]v has the slopes -[v] in ω and [ω] dv/dq in q.
    """
    w, q = x[..., :3], x[..., 3:]
    a, b, c, d = (q[..., k] for k in range(4))
    squared = (q**2).sum(axis=-1)[..., None, None]
    third = unchecked(rotation_matrix)(q)[..., 2]
    rows = [[c, d, a, b], [-b, -a, d, c], [a, -b, -c, d]]
    bent = np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
    turn = 2 * alpha * (bent - third[..., None] * q[..., None, :]) / squared
    out = np.zeros((*x.shape, 7))
    out[..., :3, :3] = -unchecked(cross_matrix)(alpha * third)
    out[..., :3, 3:] = unchecked(cross_matrix)(w) @ turn
    out[..., 3:, :3] = -unchecked(left_directions)(q)
    out[..., 3, 4:], out[..., 4:, 3] = 0.5 * w, -0.5 * w
    out[..., 4:, 4:] = -0.5 * unchecked(cross_matrix)(w)
    return out
