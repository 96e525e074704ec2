r"""Motion of a satellite in the Hill frame of a chief on a circular orbit: place and attitude.

Rotations are unit quaternions, scalar part first, with the *active* rotation matrix.

The axes are radial (away from the Earth), along the track, and along the orbit's normal. The place
is :math:`(x, y, z, \dot x, \dot y, \dot z)` in m and m/s, equation (18) of Grange et al. The
attitude, (19)-(21), is :math:`(\boldsymbol\omega, \mathbf q)`: the angular velocity of the body
relative to the Hill frame in rad/s, then a quaternion with its scalar part first, in the order that
Table III uses. Equation (21) goes with the *active* rotation matrix of :math:`\mathbf q`: then, and
not for its transpose, :math:`\dot{\mathbf R} = -[\boldsymbol\omega]_\times\mathbf R`.
"""

from __future__ import annotations

from functools import lru_cache, partial
from typing import Annotated, Any

import numpy as np
from scipy.linalg import expm

from ..linalg import symmetrise
from ..validation import Array, PositiveFloat, validated
from .base import LinearModel, Model, Strength
from .motion import rk4

__all__ = [
    "clohessy_wiltshire",
    "cross_matrix",
    "left_directions",
    "quaternion_rate",
    "rotation_matrix",
    "satellite_pose",
    "rotation_vector_between",
    "rotate",
]


def _drift(rate: float) -> Array:
    """The matrix A, (6, 6), of the Clohessy-Wiltshire equations."""
    a = np.zeros((6, 6))
    a[:3, 3:] = np.eye(3)
    a[3, 0] = 3 * rate * rate
    a[3, 4] = 2 * rate
    a[4, 3] = -2 * rate
    a[5, 2] = -rate * rate
    return a


@lru_cache(maxsize=64)
def _transition(dt: float, rate: float) -> Array:
    """The exact transition exp(A dt); Journal of the Aerospace Sciences 27 (1960) 653-658."""
    n = rate
    tau = rate * dt
    s = np.sin(tau)
    c = np.cos(tau)
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
def _exact_noise(rate: float, sigma: float, dt: float) -> Array:
    # C. F. Van Loan, IEEE Transactions on Automatic Control 23 (1978) 395-404.
    a = _drift(rate)
    density = sigma**2 * np.eye(6)
    both = expm(dt * np.block([[-a, density], [np.zeros((6, 6)), a.T]]))
    cov = symmetrise(both[6:, 6:].T @ both[:6, 6:])
    cov.setflags(write=False)
    return cov


def _noise(t: float, dt: float, rate: float, sigma: float) -> Array:
    return _exact_noise(rate, sigma, dt)


@validated
def clohessy_wiltshire(*, rate: PositiveFloat, sigma: Strength) -> LinearModel:
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
    >>> model.Q(0.0, 0.1).diagonal().round(5)
    array([0.00401, 0.00401, 0.00401, 0.004  , 0.004  , 0.004  ])
    """
    return LinearModel.from_transition(
        6,
        partial(_transition, rate=rate),
        partial(_noise, rate=rate, sigma=sigma),
        names=("x", "y", "z", "vx", "vy", "vz"),
        units=("m", "m", "m", "m/s", "m/s", "m/s"),
    )


@validated
def satellite_pose(
    *, rate: PositiveFloat, sigma: Strength, step: PositiveFloat = 0.01
) -> Model:
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
        13,
        partial(_flow, rate=rate, step=step),
        partial(_pose_noise, rate=rate, sigma=sigma),
        names=(*place.names, "w1", "w2", "w3", "q1", "q2", "q3", "q4"),
        units=(*place.units, *["rad/s"] * 3, *["1"] * 4),
    )


def _pose_noise(t: float, dt: float, rate: float, sigma: float) -> Array:
    cov = np.zeros((13, 13))
    cov[:6, :6] = _noise(t, dt, rate, sigma)
    cov[6:9, 6:9] = sigma**2 * dt * np.eye(3)
    return cov


def _flow(x: Array, t: float, dt: float, rate: float, step: float) -> Array:
    moved = x[..., :6] @ _transition(dt, rate).T
    # Components first: each operation then runs over contiguous memory.
    rows = np.ascontiguousarray(x.reshape(-1, 13)[:, 6:].T)
    body = rk4(partial(_rates, alpha=rate), rows, t, dt, longest=step)
    return np.concatenate([moved, body.T.reshape(*x.shape[:-1], 7)], axis=-1)


def _rates(rows: Array, t: float, alpha: float) -> Array:
    """Right-hand sides of (20) and (21) together, components first."""
    w = rows[:3]
    q = rows[3:]
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
    aa = a * a
    bb = b * b
    cc = c * c
    dd = d * d
    scale = alpha / (aa + bb + cc + dd)
    v1 = 2 * scale * (b * d + a * c)
    v2 = 2 * scale * (c * d - a * b)
    v3 = scale * (aa - bb - cc + dd)
    return [w2 * v3 - w3 * v2, w3 * v1 - w1 * v3, w1 * v2 - w2 * v1]


def _far_from_zero(value: Array, name: str) -> None:
    with np.errstate(over="ignore", under="ignore"):
        squares = (value**2).sum(axis=-1)
    if not (np.isfinite(squares) & (squares > 1e-280)).all():
        got = np.abs(value).max()
        raise ValueError(
            f"{name} must have quaternions that are not zero or infinite, got {got:g}"
        )


Quaternion = Annotated[Array, "... 4", _far_from_zero]
Vector = Annotated[Array, "... 3"]


@validated
def cross_matrix(vector: Vector) -> Array:
    r"""The cross product :math:`[\boldsymbol\omega]_\times` as a matrix (..., 3, 3), equation (19).

    Parameters
    ----------
    vector : array_like, (..., 3)

    Examples
    --------
    >>> cross_matrix([0.0, 0.0, 1.0]) @ [1.0, 0.0, 0.0]
    array([0., 1., 0.])
    """
    return np.cross(np.eye(3), vector[..., None, :])


@validated
def rotation_matrix(quaternion: Quaternion) -> Array:
    r"""The active rotation matrix R(q), (..., 3, 3), of a quaternion with its scalar part first.

    Members of an ensemble need not have unit length, so the length is divided out.

    Parameters
    ----------
    quaternion : array_like, (..., 4)
        Not zero.

    Examples
    --------
    A quarter turn about the third axis takes the first axis to the second:

    >>> (rotation_matrix([1.0, 0.0, 0.0, 1.0]) @ [1.0, 0.0, 0.0]).round(12)
    array([0., 1., 0.])
    """
    return np.reshape(
        _rotations(quaternion).as_matrix(), (*quaternion.shape[:-1], 3, 3)
    )


def _rotations(quaternion: Array) -> Any:
    from scipy.spatial.transform import Rotation

    return Rotation.from_quat(quaternion.reshape(-1, 4), scalar_first=True)


@validated
def left_directions(quaternion: Quaternion) -> Array:
    r"""How a quaternion changes as the body turns a little further about the frame's axes.

    The derivative at zero of :func:`turned` in its angle. Equation (21) is
    :math:`\dot{\mathbf q} = -\mathbf D(\mathbf q)\,\boldsymbol\omega`.

    Parameters
    ----------
    quaternion : array_like, (..., 4)
        Not zero.

    Returns
    -------
    ndarray, (..., 4, 3)
        Its columns are orthogonal to the quaternion and to each other, half as long as it.

    Examples
    --------
    >>> left_directions([1.0, 0.0, 0.0, 0.0])[1:]
    array([[0.5, 0. , 0. ],
           [0. , 0.5, 0. ],
           [0. , 0. , 0.5]])
    """
    q = quaternion
    out = np.empty((*q.shape, 3))
    out[..., 0, :] = -q[..., 1:]
    out[..., 1:, :] = -cross_matrix(q[..., 1:])
    out[..., 1:, :] += q[..., :1, None] * np.eye(3)
    return 0.5 * out + 0.0


@validated
def rotate(quaternion: Quaternion, angle: Vector) -> Array:
    r"""The attitude (..., 4) turned further, :math:`e^{\boldsymbol\theta/2}\mathbf q`.

    Parameters
    ----------
    quaternion : array_like, (..., 4)
        Not zero; its length is kept.
    angle : array_like, (..., 3)
        Rotation vector in the frame that R(q) leads to, in rad.

    Examples
    --------
    >>> rotate([1.0, 0.0, 0.0, 0.0], [0.0, 0.0, np.pi / 2]).round(4)
    array([0.7071, 0.    , 0.    , 0.7071])
    """
    half = 0.5 * np.linalg.norm(angle, axis=-1)[..., None]
    move = (left_directions(quaternion) @ angle[..., None])[..., 0]
    return np.asarray(np.cos(half) * quaternion + np.sinc(half / np.pi) * move)


@validated
def rotation_vector_between(quaternion: Quaternion, other: Quaternion) -> Array:
    """The rotation vector that takes one attitude to another, the inverse of :func:`turned`.

    Parameters
    ----------
    quaternion, other : array_like, (..., 4)
        Not zero; their lengths and signs do not matter.

    Returns
    -------
    ndarray, (..., 3)
        In rad, at most π long.

    Examples
    --------
    >>> rotation_vector_between([1.0, 0.0, 0.0, 0.0], [1.0, 0.0, 0.0, -1.0]).round(4)
    array([ 0.    ,  0.    , -1.5708])
    """
    before, after = np.broadcast_arrays(quaternion, other)
    turn = _rotations(after) * _rotations(before).inv()
    return np.reshape(turn.as_rotvec(), (*before.shape[:-1], 3))


@validated
def quaternion_rate(quaternion: Quaternion, angular_velocity: Vector) -> Array:
    """The quaternion's derivative in 1/s, (..., 4), equation (21); it keeps the length.

    Parameters
    ----------
    quaternion : array_like, (..., 4)
    angular_velocity : array_like, (..., 3)
        Of the body relative to the Hill frame, in rad/s.

    Examples
    --------
    >>> quaternion_rate([1.0, 0.0, 0.0, 0.0], [0.2, 0.0, 0.0]) + 0.0
    array([ 0. , -0.1,  0. ,  0. ])
    """
    rows = kinematics(
        np.moveaxis(quaternion, -1, 0), np.moveaxis(angular_velocity, -1, 0)
    )
    return np.stack(rows, axis=-1)


def kinematics(q: Array, w: Array) -> list[Array]:
    """Equation (21), components first."""
    a, b, c, d = q
    w1, w2, w3 = w
    return [
        0.5 * (b * w1 + c * w2 + d * w3),
        -0.5 * (a * w1 + d * w2 - c * w3),
        -0.5 * (a * w2 + b * w3 - d * w1),
        -0.5 * (c * w1 - b * w2 + a * w3),
    ]
