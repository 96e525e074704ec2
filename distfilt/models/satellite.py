r"""Relative motion of a satellite in the Hill frame of a chief on a circular orbit.

The axes are radial (away from the Earth), along the track, and along the orbit's normal. The state
is :math:`\mathbf x = (x, y, z, \dot x, \dot y, \dot z)` in m and m/s.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from ..checks import Array, number
from ..linalg import van_loan
from .base import LinearModel

__all__ = ["clohessy_wiltshire", "clohessy_wiltshire_drift", "clohessy_wiltshire_transition"]


def clohessy_wiltshire_drift(rate: float) -> Array:
    r"""The matrix A, (6, 6), of the Clohessy-Wiltshire equations, (18) of Grange et al.

    Parameters
    ----------
    rate : float
        The chief's orbital rate :math:`\alpha=\sqrt{\mu/a^3}`, in rad/s, positive.

    Examples
    --------
    >>> clohessy_wiltshire_drift(0.1)[3:].round(15)
    array([[ 0.03,  0.  ,  0.  ,  0.  ,  0.2 ,  0.  ],
           [ 0.  ,  0.  ,  0.  , -0.2 ,  0.  ,  0.  ],
           [ 0.  ,  0.  , -0.01,  0.  ,  0.  ,  0.  ]])
    """
    n = number(rate, "rate", above=0)
    a = np.zeros((6, 6))
    a[:3, 3:] = np.eye(3)
    a[3, 0], a[3, 4] = 3 * n * n, 2 * n
    a[4, 3] = -2 * n
    a[5, 2] = -n * n
    return a


def clohessy_wiltshire_transition(rate: float, dt: float) -> Array:
    r"""The exact transition :math:`\mathbf\Phi = e^{\mathbf A\,dt}` in closed form.

    Parameters
    ----------
    rate, dt : float
        Orbital rate of the chief, in rad/s, positive; the step, in s, at least 0.

    Notes
    -----
    W. H. Clohessy and R. S. Wiltshire, Journal of the Aerospace Sciences 27 (1960) 653-658.

    Examples
    --------
    >>> clohessy_wiltshire_transition(0.1, 0.0).tolist() == np.eye(6).tolist()
    True
    """
    n = number(rate, "rate", above=0)
    tau = n * number(dt, "dt", at_least=0)
    s, c = np.sin(tau), np.cos(tau)
    # Columns: x, y, z, and the three velocities; rows: the same after the step.
    return np.array(
        [
            [4 - 3 * c, 0, 0, s / n, 2 * (1 - c) / n, 0],
            [6 * (s - tau), 1, 0, 2 * (c - 1) / n, (4 * s - 3 * tau) / n, 0],
            [0, 0, c, 0, 0, s / n],
            [3 * n * s, 0, 0, c, 2 * s, 0],
            [6 * n * (c - 1), 0, 0, -2 * s, 4 * c - 3, 0],
            [0, 0, -n * s, 0, 0, c],
        ]
    )


def clohessy_wiltshire(*, rate: float, sigma: float) -> LinearModel:
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
    drift = clohessy_wiltshire_drift(rate)
    density = number(sigma, "sigma", at_least=0, at_most=1e150) ** 2 * np.eye(6)

    @lru_cache(maxsize=64)
    def discretised(dt: float) -> tuple[Array, Array]:
        phi, noise = clohessy_wiltshire_transition(rate, dt), van_loan(drift, density, dt)[1]
        phi.setflags(write=False)
        noise.setflags(write=False)
        return phi, noise

    return LinearModel.from_transition(
        6, lambda dt: discretised(dt)[0], lambda t, dt: discretised(dt)[1],
        names=("x", "y", "z", "vx", "vy", "vz"), units=("m", "m", "m", "m/s", "m/s", "m/s"),
    )
