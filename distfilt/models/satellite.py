r"""Motion of a satellite in the Hill frame of a chief on a circular orbit: position and attitude.

The axes are radial (away from the Earth), along the track, and along the orbit's normal. The
translation is :math:`(x, y, z, \dot x, \dot y, \dot z)` in m and m/s, equation (18) of Grange
et al. The attitude, (19)-(21), is :math:`(\boldsymbol\omega, \mathbf q)`: the angular velocity of
the body relative to the Hill frame in rad/s, then a quaternion with its scalar part first, in the
order of Table III.
"""

from __future__ import annotations

from functools import lru_cache, partial

import numpy as np
from scipy.linalg import expm

from ..linalg import symmetrise
from ..validation import Array, PositiveFloat, validated
from .base import LinearModel, Model, NoiseStrength
from .motion import runge_kutta
from .quaternions import component_rates

__all__ = ["clohessy_wiltshire", "satellite_pose"]


def _drift(rate: float) -> Array:
    """The matrix A, (6, 6), of the Clohessy-Wiltshire equations dx/dt = A x.

    `rate` is the orbital rate n of the chief, in rad/s.
    """
    a = np.zeros((6, 6))
    # Positions change by the velocities.
    a[:3, 3:] = np.eye(3)
    # x'' = 3 n² x + 2 n y', y'' = -2 n x', z'' = -n² z
    a[3, 0] = 3 * rate * rate
    a[3, 4] = 2 * rate
    a[4, 3] = -2 * rate
    a[5, 2] = -rate * rate
    return a


@lru_cache(maxsize=64)
def _transition_matrix(dt: float, rate: float) -> Array:
    """The exact matrix exp(A dt), (6, 6), of the Clohessy-Wiltshire equations.

    W. H. Clohessy and R. S. Wiltshire, Journal of the Aerospace Sciences 27 (1960) 653-658. `rate`
    is the orbital rate n of the chief, in rad/s.
    """
    n = rate
    # The angle, in rad, that the chief moves on its orbit
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
    # Read-only, since all callers share the cached array.
    phi.setflags(write=False)
    return phi


@lru_cache(maxsize=64)
def _noise_integral(rate: float, sigma: float, dt: float) -> Array:
    """The covariance Q = ∫ exp(A s) σ² exp(A s)ᵀ ds over a step, (6, 6), by one matrix exponential.

    `rate` is that of the orbit, in rad/s, and `sigma` the noise's σ of `clohessy_wiltshire`.
    C. F. Van Loan, IEEE Transactions on Automatic Control 23 (1978) 395-404.
    """
    # The matrix A of the equations of motion
    a = _drift(rate)
    # White noise on all six rows of the equations
    density = sigma**2 * np.eye(6)
    # exp of [[-A, σ² I], [0, Aᵀ]] dt is [[Φ⁻¹, Φ⁻¹ Q], [0, Φᵀ]], with Φ = exp(A dt).
    blocks = expm(dt * np.block([[-a, density], [np.zeros((6, 6)), a.T]]))
    phi = blocks[6:, 6:].T
    cov = symmetrise(phi @ blocks[:6, 6:])
    # Read-only, since all callers share the cached array.
    cov.setflags(write=False)
    return cov


def _noise(t: float, dt: float, rate: float, sigma: float) -> Array:
    """Return the covariance (6, 6) of a step's noise, which does not depend on the time."""
    return _noise_integral(rate, sigma, dt)


@validated
def clohessy_wiltshire(*, rate: PositiveFloat, sigma: NoiseStrength) -> LinearModel:
    r"""The Clohessy-Wiltshire model, equation (18) of Grange et al., with noise on all six rows.

    Parameters
    ----------
    rate : float
        Orbital rate of the chief, in rad/s, positive.
    sigma : float
        Strength of the noise: each row receives white noise of spectral density sigma² (per s), so
        that a component accumulates a standard deviation of about :math:`\sigma\sqrt{dt}`.

    Examples
    --------
    >>> model = clohessy_wiltshire(rate=0.1, sigma=0.2)
    >>> model.Q(0.0, 0.1).diagonal().round(5)
    array([0.00401, 0.00401, 0.00401, 0.004  , 0.004  , 0.004  ])
    """
    return LinearModel.from_transition(
        dim=6,
        transition_matrix=partial(_transition_matrix, rate=rate),
        noise_cov=partial(_noise, rate=rate, sigma=sigma),
        names=("x", "y", "z", "vx", "vy", "vz"),
        units=("m", "m", "m", "m/s", "m/s", "m/s"),
    )


@validated
def satellite_pose(
    *, rate: PositiveFloat, sigma: NoiseStrength, step: PositiveFloat = 0.01
) -> Model:
    r"""Translation and attitude together: the 13-component model of Table III of Grange et al.

    Translation (18) has its exact transition and exact noise. Attitude (20)-(21) is integrated by
    Runge-Kutta of order 4; equation (21) has no noise. The two are independent. The components
    are :math:`(x, y, z, \dot x, \dot y, \dot z, \boldsymbol\omega, \mathbf q)`.

    Parameters
    ----------
    rate, sigma, step : float
        As for :func:`clohessy_wiltshire`, with the longest step of the integration, in s.
        The noise of strength `sigma` acts on all six components of the translation and on the
        angular velocity.

    Examples
    --------
    >>> satellite_pose(rate=0.1, sigma=0.2).names[6:10]
    ('w1', 'w2', 'w3', 'q1')
    """
    translation = clohessy_wiltshire(rate=rate, sigma=sigma)
    return Model(
        dim=13,
        transition=partial(_pose_transition, rate=rate, step=step),
        noise_cov=partial(_pose_noise, rate=rate, sigma=sigma),
        names=translation.names + ("w1", "w2", "w3", "q1", "q2", "q3", "q4"),
        units=translation.units + ("rad/s",) * 3 + ("1",) * 4,
    )


def _pose_noise(t: float, dt: float, rate: float, sigma: float) -> Array:
    """Return the covariance of a step of relative motion, angular velocity and attitude."""
    cov = np.zeros((13, 13))
    cov[:6, :6] = _noise(t, dt, rate, sigma)
    # No torque but white noise; the quaternion has none.
    cov[6:9, 6:9] = sigma**2 * dt * np.eye(3)
    return cov


def _pose_transition(x: Array, t: float, dt: float, rate: float, step: float) -> Array:
    """Move states (..., 13): the translation exactly, the attitude by Runge-Kutta steps."""
    translation = x[..., :6] @ _transition_matrix(dt, rate).T
    # Components first: each operation then runs over contiguous memory.
    # Angular velocities and quaternions, (7, n).
    rows = np.ascontiguousarray(x.reshape(-1, 13)[:, 6:].T)
    rows = runge_kutta(partial(_attitude_rate, alpha=rate), rows, t, dt, step)
    # Back to states in rows
    attitude = rows.T.reshape(*x.shape[:-1], 7)
    return np.concatenate([translation, attitude], axis=-1)


def _attitude_rate(rows: Array, t: float, alpha: float) -> Array:
    """Right-hand sides of (20) and (21) of Grange et al. together, (7, ...), components first.

    Rows 0 to 2 are the angular velocity in rad/s, 3 to 6 the quaternion; `alpha` is the chief's
    orbital rate, in rad/s.
    """
    w = rows[:3]
    q = rows[3:]
    return np.array(_angular_acceleration(q, w, alpha) + component_rates(q, w))


def _angular_acceleration(q: Array, w: Array, alpha: float) -> list[Array]:
    r"""The angular velocity's derivative, (20) of Grange et al., components first.

    :math:`\dot{\boldsymbol\omega} = [\boldsymbol\omega]_\times\mathbf R(\mathbf q)\,(0, 0,
    \alpha)^\top` with the orbital rate α in rad/s: only the third column of R is needed. The
    paper's (20) has a further term, the body's acceleration in the inertial frame, and leaves it
    open. Here it is zero: no torque acts, and the moments of inertia are equal.
    """
    a, b, c, d = q
    w1, w2, w3 = w
    # Squares of the quaternion's components
    aa = a * a
    bb = b * b
    cc = c * c
    dd = d * d
    # α times the third column of R, for a quaternion of any length
    scale = alpha / (aa + bb + cc + dd)
    v1 = 2 * scale * (b * d + a * c)
    v2 = 2 * scale * (c * d - a * b)
    v3 = scale * (aa - bb - cc + dd)
    # The cross product ω × v
    return [w2 * v3 - w3 * v2, w3 * v1 - w1 * v3, w1 * v2 - w2 * v1]
