r"""Satellites about the Earth: two bodies and the Earth's oblateness, frames, lines of sight.

States are (x, y, z, vx, vy, vz) in an inertial frame, in **km and m/s**: in these units the doubts
about positions and velocities have sizes that one covariance can hold. Equation (47) of Semeraro,
LeGrand and Kulik, with the factor :math:`r^{-5}` and the term :math:`3\mathbf r` it misprints.
"""

from __future__ import annotations

from functools import partial
from typing import Annotated, Literal

import numpy as np

from ..validation import Array, Bounds, PositiveFloat, PositiveInt, validated
from .base import Model, Strength
from .motion import equal_steps, rk4

__all__ = [
    "J2",
    "MU",
    "RADIUS",
    "acceleration",
    "occulted",
    "orbits",
    "potential",
    "propagate",
    "rsw_frame",
]

MU = 398600.4418
"""Gravitational parameter of the Earth, km³/s²."""

RADIUS = 6378.1363
"""Equatorial radius of the Earth, km."""

J2 = 1.08262668e-3
"""Coefficient of the Earth's oblateness."""


def _outside(value: Array, name: str) -> None:
    least = float(np.linalg.norm(value, axis=-1).min(initial=np.inf))
    if not least >= RADIUS:
        raise ValueError(
            f"{name} must be a distance above {RADIUS:g} km, got {least:g}"
        )


_BOUNDED = Bounds(at_least=-1e75, at_most=1e75)
"""Positions and velocities up to this have products whose squares are finite."""
Place = Annotated[Array, "... 3", _BOUNDED, _outside]
Orbits = Annotated[Array, "... 6", _BOUNDED]


@validated
def potential(position: Place) -> Array:
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
    r = position
    size = np.linalg.norm(r, axis=-1)
    shape = 3 * (r[..., 2] / size) ** 2 - 1
    return np.asarray(MU / size * (1 - 0.5 * J2 * (RADIUS / size) ** 2 * shape))


@validated
def acceleration(position: Place) -> Array:
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
    r = position
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
    out[..., 3:] = 1e3 * acceleration(x[..., :3])
    return out


@validated
def propagate(
    x: Annotated[Array, "... 6"],
    dt: float,
    *,
    rule: Literal["dop853", "rk4"] = "dop853",
    longest: PositiveFloat = 900.0,
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
    _outside(x[..., :3], "x")
    # The Earth holds nothing that is farther away, and orbits in metres are.
    Bounds(at_most=1.5e6)(np.abs(x[..., :3]), "x, in km")
    steps = equal_steps(abs(dt), longest)
    with np.errstate(all="ignore"):
        for _ in range(steps):
            # A body that dives through the Earth and comes out again is found on its way.
            if rule == "rk4":
                x = rk4(_rate, x, 0.0, dt / steps)
            else:
                x = _dop853(x, dt / steps)
            _outside(x[..., :3], "x")
    return x


def _dop853(x: Array, h: float) -> Array:
    """E. Hairer, S. Norsett and G. Wanner, Solving Ordinary Differential Equations I (1993)."""
    from scipy.integrate import DOP853

    a = h * DOP853.A[:12, :12]
    b = h * DOP853.B
    stages = np.empty((12, *x.shape))
    flat = stages.reshape(12, -1)
    stages[0] = _rate(x)
    for k in range(1, 12):
        stages[k] = _rate(x + (a[k, :k] @ flat[:k]).reshape(x.shape))
    return np.asarray(x + (b @ flat).reshape(x.shape))


@validated
def orbits(
    bodies: PositiveInt = 1,
    *,
    position_std: Strength = 0.0,
    velocity_std: Strength = 0.0,
) -> Model:
    """Several satellites as one model; the state is theirs one after the other.

    Parameters
    ----------
    bodies : int
        How many; the state has 6 components for each.
    position_std, velocity_std : float
        Standard deviations of the noise that a step adds to each component, in km and m/s, whatever
        the step's length, (50)-(51).

    Examples
    --------
    >>> pair = orbits(2, velocity_std=1e-6)
    >>> pair.dim, pair.names[6], pair.units[3]
    (12, 'x2', 'm/s')
    """
    noise = np.diag(np.tile([position_std**2] * 3 + [velocity_std**2] * 3, bodies))
    axes = ("x", "y", "z", "vx", "vy", "vz")
    return Model(
        6 * bodies,
        _flow,
        partial(_noise, noise),
        derivative=partial(_slope, bodies=bodies),
        names=tuple(f"{c}{k + 1}" for k in range(bodies) for c in axes),
        units=("km", "km", "km", "m/s", "m/s", "m/s") * bodies,
    )


def _noise(noise: Array, t: float, dt: float) -> Array:
    return noise


def _flow(x: Array, t: float, dt: float) -> Array:
    states = x.reshape(*x.shape[:-1], -1, 6)
    return propagate(states, dt).reshape(x.shape)


def _slope(x: Array, t: float, dt: float, bodies: int) -> Array:
    """Central differences, body by body: a body's motion depends on its own state only."""
    size = np.full(6, 1e-2)
    states = x.reshape(*x.shape[:-1], bodies, 6)
    moved = np.stack(
        [states[..., None, :] + np.diag(size), states[..., None, :] - np.diag(size)]
    )
    ends = _flow(moved, t, dt)
    blocks = np.swapaxes((ends[0] - ends[1]) / (2 * size[:, None]), -1, -2)
    out = np.zeros((*x.shape, x.shape[-1]))
    for k in range(bodies):
        here = slice(6 * k, 6 * k + 6)
        out[..., here, here] = blocks[..., k, :, :]
    return out


@validated
def rsw_frame(x: Orbits) -> Array:
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
    radial = x[..., :3] / np.linalg.norm(x[..., :3], axis=-1, keepdims=True)
    normal = np.cross(x[..., :3], x[..., 3:])
    size = np.linalg.norm(normal, axis=-1, keepdims=True)
    if (size == 0).any() or not np.isfinite(radial).all():
        raise ValueError(
            "x must have positions and velocities that span a plane, got others"
        )
    normal = normal / size
    return np.stack([radial, np.cross(normal, radial), normal], axis=-1)


@validated
def occulted(a: Place, b: Place) -> Array:
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
    way = b - a
    size = np.einsum("...i,...i->...", way, way)
    along = -np.einsum("...i,...i->...", a, way) / np.where(size > 0, size, 1.0)
    nearest = a + np.clip(along, 0, 1)[..., None] * way
    return np.asarray(np.linalg.norm(nearest, axis=-1) < RADIUS)
