r"""Rotations and unit quaternions, scalar part first, with the *active* rotation matrix.

The attitude's kinematics (19) and (21) of Grange et al. are here; its dynamics in
:mod:`distfilt.models.satellite`.
"""

from __future__ import annotations

from typing import Annotated

import numpy as np

from ..doors import Array, door, unchecked

__all__ = [  # fmt: skip
    "cross_matrix", "left_directions", "quaternion_rate", "rotation_matrix", "turn_between",
    "turned",
]


def _far_from_zero(value: Array, name: str) -> None:
    with np.errstate(over="ignore", under="ignore"):
        squares = (value**2).sum(axis=-1)
    if not (np.isfinite(squares) & (squares > 1e-280)).all():
        got = np.abs(value).max()
        raise ValueError(f"{name}: needs quaternions that are not zero or infinite, got {got:g}")


Quaternion = Annotated[Array, "... 4", _far_from_zero]
Vector = Annotated[Array, "... 3"]


@door
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
    w = vector
    out = np.zeros((*w.shape, 3))
    out[..., 2, 1], out[..., 0, 2], out[..., 1, 0] = w[..., 0], w[..., 1], w[..., 2]
    out[..., 1, 2], out[..., 2, 0], out[..., 0, 1] = -w[..., 0], -w[..., 1], -w[..., 2]
    return out


@door
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
    q = quaternion
    a, b, c, d = (q[..., k] for k in range(4))
    rows = [
        [a * a + b * b - c * c - d * d, 2 * (b * c - a * d), 2 * (b * d + a * c)],
        [2 * (b * c + a * d), a * a - b * b + c * c - d * d, 2 * (c * d - a * b)],
        [2 * (b * d - a * c), 2 * (c * d + a * b), a * a - b * b - c * c + d * d],
    ]
    stacked = np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
    return np.asarray(stacked / (q**2).sum(axis=-1)[..., None, None])


@door
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
    out[..., 1:, :] = -unchecked(cross_matrix)(q[..., 1:])
    out[..., 1:, :] += q[..., :1, None] * np.eye(3)
    return 0.5 * out + 0.0


@door
def turned(quaternion: Quaternion, angle: Vector) -> Array:
    r"""The attitude (..., 4) turned further, :math:`e^{\boldsymbol\theta/2}\mathbf q`.

    Parameters
    ----------
    quaternion : array_like, (..., 4)
        Not zero; its length is kept.
    angle : array_like, (..., 3)
        Rotation vector in the frame that R(q) leads to, in rad.

    Examples
    --------
    >>> turned([1.0, 0.0, 0.0, 0.0], [0.0, 0.0, np.pi / 2]).round(4)
    array([0.7071, 0.    , 0.    , 0.7071])
    """
    half = 0.5 * np.linalg.norm(angle, axis=-1)[..., None]
    move = (unchecked(left_directions)(quaternion) @ angle[..., None])[..., 0]
    return np.asarray(np.cos(half) * quaternion + np.sinc(half / np.pi) * move)


@door
def turn_between(quaternion: Quaternion, other: Quaternion) -> Array:
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
    >>> turn_between([1.0, 0.0, 0.0, 0.0], [1.0, 0.0, 0.0, -1.0]).round(4)
    array([ 0.    ,  0.    , -1.5708])
    """
    cos = (quaternion * other).sum(axis=-1)
    # Twice the directions are |q| long and orthogonal: they read off the sine's vector.
    sin = 2 * (unchecked(left_directions)(quaternion).mT @ other[..., None])[..., 0]
    sin = np.where(cos < 0, -1.0, 1.0)[..., None] * sin
    size = np.linalg.norm(sin, axis=-1)
    half = np.arctan2(size, np.abs(cos))
    scale = np.where(size > 0, half / np.where(size > 0, size, 1.0), 0.0)
    return np.asarray(2 * scale[..., None] * sin)


@door
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
    rows = kinematics(np.moveaxis(quaternion, -1, 0), np.moveaxis(angular_velocity, -1, 0))
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
