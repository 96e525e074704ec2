r"""Satellites about the Earth: two bodies and the Earth's oblateness, frames, lines of sight.

States are (x, y, z, vx, vy, vz) in an inertial frame, in **km and m/s**: in these units the doubts
about positions and velocities have sizes that one covariance can hold. Equation (47) of Semeraro,
LeGrand and Kulik, with the factor :math:`r^{-5}` and the term :math:`3\mathbf r` it misprints.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
from numpy.typing import ArrayLike

from ..checks import Array, array, choice, count, number
from .base import Model
from .integrators import _steps, rk4

__all__ = [
    "J2", "MU", "RADIUS", "acceleration", "occulted", "orbits", "potential", "propagate",
    "rsw_frame",
]

MU = 398600.4418
"""Gravitational parameter of the Earth, km³/s²."""

RADIUS = 6378.1363
"""Equatorial radius of the Earth, km."""

J2 = 1.08262668e-3
"""Coefficient of the Earth's oblateness."""

_LARGEST = 1e75
"""Positions and velocities up to this have products whose squares are finite."""


def potential(position: ArrayLike) -> Array:
    r"""Potential whose gradient is the acceleration, in km²/s².

    .. math:: U=\frac\mu r\Bigl[1-\frac{J_2R^2}{2r^2}\Bigl(3\frac{z^2}{r^2}-1\Bigr)\Bigr]

    Parameters
    ----------
    position : array_like, (..., 3)
        In km, outside the Earth.

    Examples
    --------
    >>> float(potential([42164.0, 0.0, 0.0]).round(4))
    9.4537
    """
    r = _outside(position)
    size = np.linalg.norm(r, axis=-1)
    shape = 3 * (r[..., 2] / size) ** 2 - 1
    return np.asarray(MU / size * (1 - 0.5 * J2 * (RADIUS / size) ** 2 * shape))


def acceleration(position: ArrayLike) -> Array:
    r"""Acceleration of a satellite, in km/s²: the mended (47).

    .. math:: \mathbf a=-\frac{\mu\mathbf r}{r^3}+\frac{J_2\mu R^2}{2r^5}
        \Bigl[15\mathbf r\frac{z^2}{r^2}-3\mathbf r-6z\,\hat{\mathbf k}\Bigr]

    Parameters
    ----------
    position : array_like, (..., 3)
        In km, outside the Earth.

    Examples
    --------
    >>> acceleration([7000.0, 0.0, 0.0]).round(8) + 0.0
    array([-0.00814567,  0.        ,  0.        ])
    """
    return _acceleration(_outside(position))


def _outside(position: ArrayLike, name: str = "position") -> Array:
    r = array(position, name, (..., 3))
    _bounded(r, name)
    least = float(np.linalg.norm(r, axis=-1).min(initial=np.inf))
    if least < RADIUS:
        raise ValueError(f"{name}: needs a distance above {RADIUS:g} km, got {least:g}")
    return r


def _bounded(x: Array, name: str) -> None:
    largest = float(np.abs(x).max(initial=0.0))
    if largest > _LARGEST:
        raise ValueError(f"{name}: needs components up to {_LARGEST:g}, got {largest:g}")


def _acceleration(r: Array) -> Array:
    square = np.einsum("...i,...i->...", r, r)
    inverse = 1 / square
    pull = MU * inverse * np.sqrt(inverse)
    flat = 0.5 * J2 * RADIUS**2 * inverse * pull
    tilt = 15 * r[..., 2] ** 2 * inverse - 3
    out = r * (flat * tilt - pull)[..., None]
    out[..., 2] -= 6 * flat * r[..., 2]
    return np.asarray(out)


def _rate(x: Array, t: float = 0.0) -> Array:
    """Time derivative of states (..., 6) in km and m/s."""
    out = np.empty_like(x)
    out[..., :3] = 1e-3 * x[..., 3:]
    out[..., 3:] = 1e3 * _acceleration(x[..., :3])
    return out


def propagate(
    x: ArrayLike, dt: float, *, rule: str = "dop853", longest: float = 900.0
) -> Array:
    """Move satellites by a fixed number of equal steps.

    Parameters
    ----------
    x : array_like, (..., 6)
        States in km and m/s.
    dt : float
        How far, in s; negative for back in time.
    rule : {"dop853", "rk4"}
        Dormand and Prince's rule of order 8, twelve evaluations a step, or the classical rule of
        order 4.
    longest : float
        Longest step, in s; ten million steps at most. Over a day and for orbits above 20 000 km,
        900 s of order 8 leave less than a millimetre, 40 s of order 4 less than a centimetre.

    Returns
    -------
    ndarray, (..., 6)

    Raises
    ------
    ValueError
        If an orbit comes below the surface.

    Examples
    --------
    >>> start = [7000.0, 0, 0, 0, 7546.05, 0]
    >>> back = propagate(propagate(start, 3000.0, longest=60.0), -3000.0, longest=60.0)
    >>> bool(np.abs(back - start).max() < 1e-6)
    True
    """
    states = array(x, "x", (..., 6)).copy()
    length = number(dt, "dt")
    choice(rule, "rule", ("dop853", "rk4"))
    step = number(longest, "longest", above=0)
    _above(states)
    with np.errstate(all="ignore"):
        return _moved(states, length, rule, _steps(abs(length), step))


def _above(x: Array) -> None:
    size = np.linalg.norm(x[..., :3], axis=-1)
    if not (size >= RADIUS).all():
        least = float(np.nanmin(size, initial=np.inf))
        raise ValueError(f"x: needs orbits above {RADIUS:g} km, got a distance of {least:g} km")


def _moved(x: Array, dt: float, rule: str, steps: int) -> Array:
    if dt == 0:
        return x
    turned: Callable[[Array, float], Array] = _rate if dt > 0 else lambda x, t: -_rate(x)
    for _ in range(steps):
        # A body that dives through the Earth and comes out again is found on its way.
        x = rk4(turned, x, 0.0, abs(dt) / steps) if rule == "rk4" else _dop853(x, dt / steps)
        _above(x)
    return x


def _dop853(x: Array, h: float) -> Array:
    """E. Hairer, S. Norsett and G. Wanner, Solving Ordinary Differential Equations I (1993)."""
    from scipy.integrate import DOP853

    a, b = h * DOP853.A[:12, :12], h * DOP853.B
    stages = np.empty((12, *x.shape))
    flat = stages.reshape(12, -1)
    stages[0] = _rate(x)
    for k in range(1, 12):
        stages[k] = _rate(x + (a[k, :k] @ flat[:k]).reshape(x.shape))
    return np.asarray(x + (b @ flat).reshape(x.shape))


def orbits(
    bodies: int = 1,
    *,
    position_std: float = 0.0,
    velocity_std: float = 0.0,
    rule: str = "dop853",
    longest: float = 900.0,
) -> Model:
    """Several satellites as one model; the state is theirs one after the other.

    Parameters
    ----------
    bodies : int
        How many; the state has 6 components for each.
    position_std, velocity_std : float
        Standard deviations of the noise that a step adds to each component, in km and m/s, whatever
        the step's length, (50)-(51).
    rule, longest
        As of :func:`propagate`.

    Examples
    --------
    >>> pair = orbits(2, velocity_std=1e-6)
    >>> pair.dim, pair.names[6], pair.units[3]
    (12, 'x2', 'm/s')
    """
    n = count(bodies, "bodies")
    r = number(position_std, "position_std", at_least=0, at_most=1e150)
    v = number(velocity_std, "velocity_std", at_least=0, at_most=1e150)
    choice(rule, "rule", ("dop853", "rk4"))
    step = number(longest, "longest", above=0)
    noise = np.diag(np.tile([r**2] * 3 + [v**2] * 3, n))
    flow = partial(_flow, bodies=n, rule=rule, longest=step)
    return Model(
        6 * n, flow, lambda t, dt: noise, derivative=partial(_slope, bodies=n, flow=flow),
        names=tuple(f"{c}{k + 1}" for k in range(n) for c in ("x", "y", "z", "vx", "vy", "vz")),
        units=("km", "km", "km", "m/s", "m/s", "m/s") * n,
    )


def _flow(x: Array, t: float, dt: float, *, bodies: int, rule: str, longest: float) -> Array:
    states = x.reshape(*x.shape[:-1], -1, 6)
    return propagate(states, dt, rule=rule, longest=longest).reshape(x.shape)


def _slope(
    x: Array, t: float, dt: float, *, bodies: int, flow: Callable[[Array, float, float], Array]
) -> Array:
    """Central differences, body by body: a body's motion depends on its own state only."""
    size = np.array([1e-2] * 3 + [1e-2] * 3)
    states = x.reshape(*x.shape[:-1], bodies, 6)
    moved = np.stack([states[..., None, :] + np.diag(size), states[..., None, :] - np.diag(size)])
    ends = flow(moved, t, dt)
    blocks = np.swapaxes((ends[0] - ends[1]) / (2 * size[:, None]), -1, -2)
    out = np.zeros((*x.shape, x.shape[-1]))
    for k in range(bodies):
        here = slice(6 * k, 6 * k + 6)
        out[..., here, here] = blocks[..., k, :, :]
    return out


def rsw_frame(x: ArrayLike) -> Array:
    """Axes along the radius, across it along the motion, and along the orbit's normal, (58).

    Parameters
    ----------
    x : array_like, (..., 6)
        States.

    Returns
    -------
    ndarray, (..., 3, 3)
        Columns R, S, W: the rotation from that frame to the inertial one.

    Examples
    --------
    >>> rsw_frame([7000.0, 0, 0, 0, 7546.0, 0])
    array([[1., 0., 0.],
           [0., 1., 0.],
           [0., 0., 1.]])
    """
    state = array(x, "x", (..., 6))
    _bounded(state, "x")
    radial = state[..., :3] / np.linalg.norm(state[..., :3], axis=-1, keepdims=True)
    normal = np.cross(state[..., :3], state[..., 3:])
    size = np.linalg.norm(normal, axis=-1, keepdims=True)
    if (size == 0).any() or not np.isfinite(radial).all():
        raise ValueError("x: needs positions and velocities that span a plane, got others")
    normal = normal / size
    return np.stack([radial, np.cross(normal, radial), normal], axis=-1)


def occulted(a: ArrayLike, b: ArrayLike) -> Array:
    """Whether the Earth's equatorial sphere hides two positions from each other, (...).

    Parameters
    ----------
    a, b : array_like, (..., 3)
        In km, outside the Earth.

    Examples
    --------
    >>> bool(occulted([42164.0, 0, 0], [-42164.0, 0, 0]))
    True
    >>> bool(occulted([42164.0, 0, 0], [0, 42164.0, 0]))
    False
    """
    p, q = _outside(a, "a"), _outside(b, "b")
    way = q - p
    size = np.einsum("...i,...i->...", way, way)
    along = -np.einsum("...i,...i->...", p, way) / np.where(size > 0, size, 1.0)
    nearest = p + np.clip(along, 0, 1)[..., None] * way
    return np.asarray(np.linalg.norm(nearest, axis=-1) < RADIUS)
