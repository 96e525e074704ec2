r"""Unit quaternions, scalar part first, with the *active* rotation matrix.

The attitude of a body is a quaternion :math:`\mathbf q`, and its angular velocity
:math:`\boldsymbol\omega`, relative to a frame, obeys equations (19) and (21) of Grange et al.
Equation (21) goes with the active rotation matrix of :math:`\mathbf q`: then, and not for its
transpose, :math:`\dot{\mathbf R} = -[\boldsymbol\omega]_\times\mathbf R`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import numpy as np

from ..validation import (
    Array,
    ArrayInput,
    validated,
)

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

__all__ = [
    "cross_matrix",
    "left_directions",
    "quaternion_rate",
    "rotate",
    "rotation_matrix",
    "rotation_vector_between",
]


def _check_nonzero(value: Array, name: str) -> None:
    """Refuse quaternions (..., 4) whose squared length is zero, or infinite, in floating point."""
    with np.errstate(over="ignore", under="ignore"):
        # Underflow and overflow are refused below, without a warning.
        squares = (value**2).sum(axis=-1)
    # A length whose square underflows or overflows cannot be divided out. Squares below 1e-308 have
    # lost digits; the limit leaves a margin for the sum of four.
    if not (np.isfinite(squares) & (squares > 1e-280)).all():
        largest = np.abs(value).max()
        raise ValueError(
            f"{name} must have quaternions that are not zero or infinite, got {largest:g}"
        )


Quaternion = Annotated[ArrayInput, "... 4", _check_nonzero]
Vector = Annotated[ArrayInput, "... 3"]


@validated
def cross_matrix(vector: Vector) -> Array:
    r"""The matrix :math:`[\boldsymbol\omega]_\times` of a cross product: (19) of Grange et al.

    Parameters
    ----------
    vector : array_like, (..., 3)

    Examples
    --------
    >>> cross_matrix([0.0, 0.0, 1.0]) @ [1.0, 0.0, 0.0]
    array([0., 1., 0.])
    """
    # Row i is e_i × ω.
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
    matrices = _to_rotation(quaternion).as_matrix()
    return np.reshape(matrices, (*quaternion.shape[:-1], 3, 3))


def _to_rotation(quaternion: Array) -> Rotation:
    """Return scipy's rotations of quaternions (..., 4), with all leading axes in one."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_quat(quaternion.reshape(-1, 4), scalar_first=True)


@validated
def left_directions(quaternion: Quaternion) -> Array:
    r"""Derivatives of a quaternion with respect to small rotations about the frame's axes.

    Such a rotation multiplies the quaternion from the left. This is the derivative D of
    :func:`rotate` in its angle, at zero: a small angle :math:`\boldsymbol\theta` leads from
    :math:`\mathbf q` to :math:`\mathbf q+\mathbf D(\mathbf q)\,\boldsymbol\theta`. Equation (21) of
    Grange et al. is :math:`\dot{\mathbf q} = -\mathbf D(\mathbf q)\,\boldsymbol\omega`.

    Parameters
    ----------
    quaternion : array_like, (..., 4)
        Not zero.

    Returns
    -------
    ndarray, (..., 4, 3)
        Its columns are orthogonal to the quaternion and to each other, and half its length.

    Examples
    --------
    >>> left_directions([1.0, 0.0, 0.0, 0.0])[1:]
    array([[0.5, 0. , 0. ],
           [0. , 0.5, 0. ],
           [0. , 0. , 0.5]])
    """
    scalar = quaternion[..., :1, None]
    vector = quaternion[..., 1:]
    # For the quaternion (s, v), D θ is half the product (0, θ)(s, v) = (-θᵀv, s θ + θ × v), so that
    # D = ½ [-vᵀ; s I - [v]×].
    twice = np.empty((*quaternion.shape, 3))
    twice[..., 0, :] = -vector
    twice[..., 1:, :] = -cross_matrix(vector)
    twice[..., 1:, :] += scalar * np.eye(3)
    # Adding zero turns -0.0 into 0.0.
    return 0.5 * twice + 0.0


@validated
def rotate(quaternion: Quaternion, angle: Vector) -> Array:
    r"""Rotate an attitude (..., 4) further, to :math:`e^{\boldsymbol\theta/2}\mathbf q`.

    Parameters
    ----------
    quaternion : array_like, (..., 4)
        Not zero; the result has its length.
    angle : array_like, (..., 3)
        Rotation vector in the frame that R(q) leads to, in rad.

    Examples
    --------
    >>> rotate([1.0, 0.0, 0.0, 0.0], [0.0, 0.0, np.pi / 2]).round(4)
    array([0.7071, 0.    , 0.    , 0.7071])
    """
    # Half the angle of rotation, |θ|/2
    half = 0.5 * np.linalg.norm(angle, axis=-1)[..., None]
    tangent = (left_directions(quaternion) @ angle[..., None])[..., 0]
    # cos(|θ|/2) q + sin(|θ|/2)/(|θ|/2) D(q) θ; numpy's sinc(x) is sin(πx)/(πx).
    return np.asarray(np.cos(half) * quaternion + np.sinc(half / np.pi) * tangent)


@validated
def rotation_vector_between(quaternion: Quaternion, other: Quaternion) -> Array:
    """Rotation vector that takes one attitude to another, the inverse of :func:`rotate`.

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
    start, end = np.broadcast_arrays(quaternion, other)
    # R(end) R(start)⁻¹, whose rotation vector is at most π long
    rotation = _to_rotation(end) * _to_rotation(start).inv()
    return np.reshape(rotation.as_rotvec(), (*start.shape[:-1], 3))


@validated
def quaternion_rate(quaternion: Quaternion, angular_velocity: Vector) -> Array:
    """Derivative of the quaternion in 1/s, (..., 4): (21) of Grange et al. It conserves the length.

    Parameters
    ----------
    quaternion : array_like, (..., 4)
    angular_velocity : array_like, (..., 3)
        Of the body relative to the frame, in rad/s.

    Examples
    --------
    >>> quaternion_rate([1.0, 0.0, 0.0, 0.0], [0.2, 0.0, 0.0]) + 0.0
    array([ 0. , -0.1,  0. ,  0. ])
    """
    # Components first, for `component_rates`.
    q = np.moveaxis(quaternion, -1, 0)
    w = np.moveaxis(angular_velocity, -1, 0)
    return np.stack(component_rates(q, w), axis=-1)


def component_rates(q: Array, w: Array) -> list[Array]:
    """Right-hand side of (21) of Grange et al. with components first, for contiguous memory.

    It is q̇ = -D(q) ω with the matrix D of :func:`left_directions`, for the quaternion (a, b, c, d)
    whose scalar part is a; `q` is (4, ...), `w` the angular velocity (3, ...) in rad/s.
    """
    a, b, c, d = q
    w1, w2, w3 = w
    return [
        0.5 * (b * w1 + c * w2 + d * w3),
        -0.5 * (a * w1 + d * w2 - c * w3),
        -0.5 * (a * w2 + b * w3 - d * w1),
        -0.5 * (c * w1 - b * w2 + a * w3),
    ]
