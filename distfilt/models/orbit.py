r"""Satellites about the Earth: two bodies and the Earth's oblateness, frames, lines of sight.

States are (x, y, z, vx, vy, vz) in an inertial frame, in **km and m/s**: in these units the
uncertainties of positions and velocities have magnitudes that fit in one covariance matrix. The
equation of motion is (47) of Semeraro, LeGrand and Kulik, with the factor :math:`r^{-5}` and the
term :math:`3\mathbf r`, which are misprinted there.
"""

from __future__ import annotations

from functools import partial
from typing import Annotated, Literal

import numpy as np

from ..validation import (
    Array,
    ArrayInput,
    Bounds,
    PositiveFloat,
    PositiveInt,
    validated,
)
from .base import Model, NoiseStrength
from .motion import count_steps, runge_kutta

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


def _check_outside(value: Array, name: str) -> None:
    """Refuse positions (..., 3) inside the Earth."""
    least = float(np.linalg.norm(value, axis=-1).min(initial=np.inf))
    # Written so that NaN is refused too.
    if not least >= RADIUS:
        raise ValueError(
            f"{name} must be outside the Earth, at least {RADIUS:g} km from its centre, "
            f"got {least:g} km"
        )


_BOUNDED = Bounds(at_least=-1e75, at_most=1e75)
"""Up to this bound, squares of products of positions and velocities are finite."""
Position = Annotated[ArrayInput, "... 3", _BOUNDED, _check_outside]
Orbits = Annotated[ArrayInput, "... 6", _BOUNDED]


@validated
def potential(position: Position) -> Array:
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
    distance = np.linalg.norm(position, axis=-1)
    # 3 z²/r² - 1, twice the Legendre polynomial P₂ of the latitude's sine
    legendre = 3 * (position[..., 2] / distance) ** 2 - 1
    oblateness = 0.5 * J2 * (RADIUS / distance) ** 2 * legendre
    return np.asarray(MU / distance * (1 - oblateness))


@validated
def acceleration(position: Position) -> Array:
    r"""Acceleration of a satellite, in km/s²: (47) of Semeraro et al., corrected.

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
    # 1 / r²
    z = position[..., 2]
    inverse_square = 1 / np.einsum("...i,...i->...", position, position)
    # μ/r³ of the central force, and J₂ μ R²/(2 r⁵) of the oblateness
    central = MU * inverse_square * np.sqrt(inverse_square)
    oblate = 0.5 * J2 * RADIUS**2 * inverse_square * central
    # 15 z²/r² - 3, along r, and -6 z along the Earth's axis
    radial = 15 * z**2 * inverse_square - 3
    result = position * (oblate * radial - central)[..., None]
    result[..., 2] -= 6 * oblate * z
    return np.asarray(result)


def _rate(x: Array, t: float = 0.0) -> Array:
    """Time derivative of states (..., 6) in km and m/s."""
    rate = np.empty_like(x)
    # Velocities are in m/s, and positions in km: factors of 1000 both ways.
    rate[..., :3] = 1e-3 * x[..., 3:]
    rate[..., 3:] = 1e3 * acceleration(x[..., :3])
    return rate


@validated
def propagate(
    x: Annotated[ArrayInput, "... 6"],
    dt: float,
    *,
    rule: Literal["dop853", "rk4"] = "dop853",
    longest: PositiveFloat = 900.0,
) -> Array:
    """Propagate satellites by a fixed number of equal steps.

    Parameters
    ----------
    x : array_like, (..., 6)
        States in km and m/s.
    dt : float
        Length of the interval, in s; negative for backwards in time.
    rule : {"dop853", "rk4"}
        Dormand and Prince's rule of order 8, with twelve evaluations a step, or the classical
        Runge-Kutta rule of order 4.
    longest : float
        Longest step, in s; ten million steps at most. Over a day and for orbits above 20 000 km,
        900 s of order 8 leave less than a millimetre, 40 s of order 4 less than a centimetre.

    Returns
    -------
    ndarray, (..., 6)

    Raises
    ------
    ValueError
        If an orbit passes below the surface.

    Examples
    --------
    >>> start = [7000.0, 0, 0, 0, 7546.05, 0]
    >>> back = propagate(propagate(start, 3000.0, longest=60.0), -3000.0, longest=60.0)
    >>> bool(np.abs(back - start).max() < 1e-6)
    True
    """
    _check_outside(x[..., :3], "x")
    # Beyond 1.5 million km nothing orbits the Earth: such a position is probably in metres.
    Bounds(at_most=1.5e6)(np.abs(x[..., :3]), "x, in km")
    steps = count_steps(abs(dt), longest)
    h = dt / steps
    # An overflow ends in NaN, which the check after the step refuses.
    with np.errstate(all="ignore"):
        for _ in range(steps):
            # The rate does not depend on the time.
            x = runge_kutta(_rate, x, t=0.0, dt=h) if rule == "rk4" else _dop853(x, h)
            # Checked in each step: an orbit through the Earth may end outside it again.
            _check_outside(x[..., :3], "x")
    return np.asarray(x)


def _dop853(x: Array, h: float) -> Array:
    """Move states (..., 6) by one step of `h` seconds of Dormand and Prince's rule of order 8.

    E. Hairer, S. Norsett and G. Wanner, Solving Ordinary Differential Equations I (1993).
    """
    from scipy.integrate import DOP853

    # The rule's coefficients a and b: slopes k_i = f(x + h Σ_j a_ij k_j) and the result
    # x + h Σ_i b_i k_i. Its times are not needed, as the equations do not depend on time.
    a = h * DOP853.A[:12, :12]
    b = h * DOP853.B
    slopes = np.empty((12, *x.shape))
    # A view of the slopes with one row each, for sums over them.
    flat = slopes.reshape(12, -1)
    slopes[0] = _rate(x)
    for k in range(1, 12):
        increment = a[k, :k] @ flat[:k]
        slopes[k] = _rate(x + increment.reshape(x.shape))
    increment = b @ flat
    return np.asarray(x + increment.reshape(x.shape))


@validated
def orbits(
    bodies: PositiveInt = 1,
    *,
    position_std: NoiseStrength = 0.0,
    velocity_std: NoiseStrength = 0.0,
) -> Model:
    """Model several satellites at once; their states are concatenated.

    Parameters
    ----------
    bodies : int
        Number of satellites; each has 6 components of the state.
    position_std, velocity_std : float
        Standard deviations of the noise that a step adds to each component, in km and m/s,
        independent of the step's length: (50)-(51) of Semeraro et al.

    Examples
    --------
    >>> pair = orbits(2, velocity_std=1e-6)
    >>> pair.dim, pair.names[6], pair.units[3]
    (12, 'x2', 'm/s')
    """
    # The same for each satellite, one after the other.
    variances = [position_std**2] * 3 + [velocity_std**2] * 3
    noise_cov = np.diag(np.tile(variances, bodies))
    components = ("x", "y", "z", "vx", "vy", "vz")
    return Model(
        6 * bodies,
        _transition,
        partial(_constant_noise, noise_cov),
        derivative=partial(_derivative, bodies=bodies),
        names=tuple(f"{name}{k + 1}" for k in range(bodies) for name in components),
        units=("km", "km", "km", "m/s", "m/s", "m/s") * bodies,
    )


def _constant_noise(noise_cov: Array, t: float, dt: float) -> Array:
    """Return the covariance (d, d) that every step adds, whatever its length."""
    return noise_cov


def _transition(x: Array, t: float, dt: float) -> Array:
    """Move states (..., 6 bodies) by `dt` seconds: each satellite independently of the others."""
    # One satellite a row
    states = x.reshape(*x.shape[:-1], -1, 6)
    return propagate(states, dt).reshape(x.shape)


def _derivative(x: Array, t: float, dt: float, bodies: int) -> Array:
    """Jacobian (..., d, d) of `_transition` by central differences, body by body.

    The motion of a body depends on its own state only, so that the Jacobian is block diagonal.
    """
    # 10 m or 1 cm/s: small beside an orbit, so that curvature does not count, and large beside the
    # rounding of positions, below 1e-11 km.
    step = 1e-2
    states = x.reshape(*x.shape[:-1], bodies, 1, 6)
    shifts = step * np.eye(6)
    # Each shifted state moves like a satellite by itself. Axes: bodies, the component that is
    # shifted, and the components where the orbit ends.
    forward, backward = _transition(np.stack([states + shifts, states - shifts]), t, dt)
    blocks = np.swapaxes((forward - backward) / (2 * step), -1, -2)
    # One block for each body on the diagonal
    jacobian = np.zeros((*x.shape, x.shape[-1]))
    for k in range(bodies):
        body = slice(6 * k, 6 * k + 6)
        jacobian[..., body, body] = blocks[..., k, :, :]
    return jacobian


@validated
def rsw_frame(x: Orbits) -> Array:
    """Axes of the RSW frame: radial, across it in the direction of motion, and normal to both.

    Equation (58) of Semeraro et al.

    Parameters
    ----------
    x : array_like, (..., 6)
        States whose position and velocity are not parallel.

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
    position = x[..., :3]
    velocity = x[..., 3:]
    radial = position / np.linalg.norm(position, axis=-1, keepdims=True)
    normal = np.cross(position, velocity)
    length = np.linalg.norm(normal, axis=-1, keepdims=True)
    if (length == 0).any() or not np.isfinite(radial).all():
        raise ValueError(
            "x must have positions and velocities that span a plane, got parallel ones"
        )
    normal = normal / length
    # Right-handed: S = W × R
    along = np.cross(normal, radial)
    return np.stack([radial, along, normal], axis=-1)


@validated
def occulted(a: Position, b: Position) -> Array:
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
    # The line of sight and its squared length, which is zero if both are in one place.
    line = b - a
    square = np.einsum("...i,...i->...", line, line)
    # a + s (b - a) is nearest to the Earth's centre at s = -a·(b - a)/|b - a|², within [0, 1].
    fraction = -np.einsum("...i,...i->...", a, line) / np.where(square > 0, square, 1.0)
    nearest = a + np.clip(fraction, 0, 1)[..., None] * line
    # Hidden if the nearest point of the line is inside the sphere.
    return np.asarray(np.linalg.norm(nearest, axis=-1) < RADIUS)
