"""Swarms: agents in a box that drift, diffuse and are reflected by its walls."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ..checks import Array, array, callable_, choice, count, generator, increasing, instance, number

__all__ = [  # fmt: skip
    "READINGS", "RotatingMixture", "Swarm", "mobility_and_diffusion", "reflected", "rotating_swarm",
]

READINGS = ("literal", "gibbs", "slowgibbs")
"""Readings of equation (23) of Zheng and Lin, see :func:`mobility_and_diffusion`."""


def mobility_and_diffusion(reading: str, strength: float = 0.03) -> tuple[float, float]:
    """Mobility c and diffusion D of a drift c ∇f/f, in one of the `READINGS` of equation (23).

    Parameters
    ----------
    reading : {"literal", "gibbs", "slowgibbs"}
        As printed, the one number s is the mobility and the noise's strength, so that D = s²/2; the
        density then follows the power 2/s of f. With both s ("gibbs"), or both s²/2 ("slowgibbs"),
        it follows f itself, fast or slowly.
    strength : float
        The number s, positive.

    Returns
    -------
    mobility, diffusion : float
        Both in 1/s for a box of width 1.

    Examples
    --------
    >>> mobility_and_diffusion("literal")
    (0.03, 0.00045)
    """
    s = number(strength, "strength", above=0, at_most=1e150)
    small = s**2 / 2
    choice(reading, "reading", READINGS)
    return (small if reading == "slowgibbs" else s), (s if reading == "gibbs" else small)


def reflected(positions: ArrayLike, low: ArrayLike, high: ArrayLike) -> Array:
    """Fold positions back into a box, as walls do that reflect.

    Parameters
    ----------
    positions : array_like, (..., d)
        Anywhere.
    low, high : array_like, (d,)
        The box's corners.

    Returns
    -------
    ndarray, (..., d)
        Inside the box.

    Examples
    --------
    >>> reflected([-0.2, 1.3], [0.0, 0.0], [1.0, 1.0]).round(12)
    array([0.2, 0.7])
    """
    x = array(positions, "positions", (..., "d"))
    a, b = _box(low, high)
    if x.shape[-1] != a.size:
        raise ValueError(f"positions: needs shape (..., {a.size}), got {x.shape}")
    return _reflected(x, a, b)


def _reflected(x: Array, low: Array, high: Array) -> Array:
    width = high - low
    fold = np.abs((x - low + width) % (2 * width) - width)
    # The sum of low and a rounded width may lie one bit beyond the wall.
    return np.clip(low + fold, low, high)


def _box(low: Any, high: Any) -> tuple[Array, Array]:
    a = array(low, "low", ("d",))
    b = array(high, "high", (a.size,))
    if not a.size or (a >= b).any():
        raise ValueError(f"high: needs corners above low = {a.tolist()}, got {b.tolist()}")
    return a, b


def _diagonal(value: Any, points: tuple[int, ...], dim: int) -> Array:
    """A diffusion, isotropic, per axis or a tensor, as (*points, d), positive."""
    d = array(value, "diffusion")
    lead = points if d.shape[: len(points)] == points and d.ndim else ()
    rest = d.shape[len(lead) :]
    if rest == (dim, dim):
        off = np.abs(d * (1 - np.eye(dim))).max(initial=0.0)
        if off > 0:
            raise ValueError(
                "diffusion: needs a diagonal tensor (finite volumes along the axes cannot "
                f"carry mixed derivatives), got an entry {off:g} beside the diagonal"
            )
        d = np.diagonal(d, axis1=-2, axis2=-1)
    elif rest == ():
        d = d[..., None]
    elif rest != (dim,):
        raise ValueError(
            f"diffusion: needs a number, one for each axis or a tensor at each of {points} "
            f"points, got shape {d.shape}"
        )
    least = float(d.min(initial=np.inf))
    if not least > 0:
        raise ValueError(f"diffusion: needs numbers above 0, got {least:g}")
    return np.broadcast_to(d, (*points, dim))


@dataclass(frozen=True, eq=False)
class Swarm:
    r"""Independent agents of one law in a box with reflecting walls.

    .. math:: d\mathbf X = \mathbf v(\mathbf X, t)\,dt + \sqrt{2\mathbf D(\mathbf X,t)}\,d\mathbf B

    in the sense of Itô, equation (1) of Zheng and Lin with
    :math:`\mathbf D=\tfrac12\boldsymbol\sigma\boldsymbol\sigma^\top` diagonal.

    Parameters
    ----------
    drift : callable
        ``drift(x, t) -> v`` on positions (..., d), in 1/s times the positions' unit.
    diffusion : float, array_like (d,) or (d, d), or callable
        D, positive; a callable ``diffusion(x, t)`` returns (...), (..., d) or (..., d, d).
    low, high : array_like, (d,)
        The box's corners; the unit square by default.

    Raises
    ------
    ValueError
        If the diffusion is not positive, or a tensor that is not diagonal.

    Examples
    --------
    >>> still = Swarm(lambda x, t: 0 * x, 0.01)
    >>> start = np.full((3, 2), 0.5)
    >>> still.step(start, 0.0, 0.1, rng=np.random.default_rng(1)).shape
    (3, 2)
    """

    drift: Callable[[Array, float], Array]
    diffusion: Any
    low: ArrayLike = field(default=(0.0, 0.0), kw_only=True)
    high: ArrayLike = field(default=(1.0, 1.0), kw_only=True)

    def __post_init__(self) -> None:
        callable_(self.drift, "drift")
        low, high = _box(self.low, self.high)
        object.__setattr__(self, "low", low)
        object.__setattr__(self, "high", high)
        if not callable(self.diffusion):
            object.__setattr__(self, "diffusion", _diagonal(self.diffusion, (), low.size).copy())

    @property
    def dim(self) -> int:
        """Number d of coordinates."""
        return int(np.size(self.low))

    def drift_at(self, x: Array, t: float) -> Array:
        """The drift at positions (..., d), checked for its shape."""
        v = np.asarray(self.drift(x, t), dtype=np.float64)
        if v.shape != x.shape:
            raise ValueError(f"drift: needs to return the positions' shape {x.shape}, "
                             f"got {v.shape}")
        return v

    def diffusion_at(self, x: Array, t: float) -> Array:
        """The diffusion along each axis at positions (..., d), as (..., d)."""
        value = self.diffusion(x, t) if callable(self.diffusion) else self.diffusion
        points = x.shape[:-1] if callable(self.diffusion) else ()
        return np.broadcast_to(_diagonal(value, points, self.dim), x.shape)

    def check(self, positions: ArrayLike, name: str = "positions") -> Array:
        """Positions (..., d) as an array; those outside the box, or NaN, are refused."""
        x = array(positions, name, (..., self.dim))
        outside = ((x < np.asarray(self.low)) | (x > np.asarray(self.high))).any(axis=-1)
        if outside.any():
            raise ValueError(
                f"{name}: needs agents inside the box, got {int(outside.sum())} outside, one at "
                f"{x[outside][0].tolist()}"
            )
        return x

    def step(
        self,
        positions: ArrayLike,
        t: float,
        dt: float,
        *,
        rng: np.random.Generator,
        substeps: int = 10,
    ) -> Array:
        """Move agents from `t` to `t` + `dt` by Euler and Maruyama's scheme.

        Parameters
        ----------
        positions : array_like, (..., d)
            Inside the box.
        t, dt : float
            Time and step, in s.
        rng : numpy.random.Generator
            Source of the noise.
        substeps : int
            Steps of the scheme in `dt`. For a linear drift of rate k a step h inflates the
            stationary variance by 1/(1 - kh/2).

        Returns
        -------
        ndarray, (..., d)
        """
        x = self.check(positions)
        now, length = number(t, "t"), number(dt, "dt", above=0)
        return self._step(x, now, length, generator(rng), count(substeps, "substeps"))

    def _step(self, x: Array, t: float, dt: float, rng: np.random.Generator, n: int) -> Array:
        h = dt / n
        low, high = np.asarray(self.low), np.asarray(self.high)
        for k in range(n):
            now = t + k * h
            kick = np.sqrt(2 * h * self.diffusion_at(x, now)) * rng.standard_normal(x.shape)
            x = _reflected(x + h * self.drift_at(x, now) + kick, low, high)
        return x

    def simulate(
        self,
        positions: ArrayLike,
        times: ArrayLike,
        *,
        rng: np.random.Generator,
        t0: float = 0.0,
        substeps: int = 10,
    ) -> Array:
        """Positions at `times`, (T, ..., d), of agents that are at `positions` at `t0`.

        Parameters are those of :meth:`step`; `times` increase strictly from `t0`.
        """
        x = self.check(positions)
        grid = increasing(times, "times")
        now = number(t0, "t0")
        if grid.size and grid[0] <= now:
            raise ValueError(f"times: needs times after t0 = {now:g}, got {grid[0]:g}")
        source, n = generator(rng), count(substeps, "substeps")
        path = np.empty((grid.size, *x.shape))
        for k, t in enumerate(grid):
            x = path[k] = self._step(x, now, float(t) - now, source, n)
            now = float(t)
        return path


@dataclass(frozen=True, eq=False)
class RotatingMixture:
    """Gaussians of equal weight and variance that go round a circle: f(x, t) of Zheng and Lin.

    Parameters
    ----------
    centre : array_like, (2,)
        Of the circle.
    radius, rate : float
        Of the circle, and in rad/s.
    variance : float
        Of each component along each axis, positive.
    components : int
        How many, evenly spaced.
    phase : float
        Angle of the first at t = 0, in rad.

    Examples
    --------
    >>> RotatingMixture().means(0.0).round(12)
    array([[0.8, 0.5],
           [0.2, 0.5]])
    """

    centre: ArrayLike = field(default=(0.5, 0.5), kw_only=True)
    radius: float = field(default=0.3, kw_only=True)
    rate: float = field(default=0.04, kw_only=True)
    variance: float = field(default=0.02, kw_only=True)
    components: int = field(default=2, kw_only=True)
    phase: float = field(default=0.0, kw_only=True)

    def __post_init__(self) -> None:
        object.__setattr__(self, "centre", tuple(array(self.centre, "centre", (2,)).tolist()))
        number(self.radius, "radius", at_least=0)
        number(self.rate, "rate")
        number(self.variance, "variance", above=0)
        count(self.components, "components")
        number(self.phase, "phase")

    def means(self, t: float) -> Array:
        """Where the components are at time `t`, (K, 2)."""
        return self._means(number(t, "t"))

    def _means(self, t: float) -> Array:
        k = np.arange(self.components)
        angle = self.rate * t + self.phase + 2 * np.pi * k / self.components
        circle = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        return np.asarray(np.asarray(self.centre) + self.radius * circle)

    def _logs(self, x: Array, t: float) -> tuple[Array, Array]:
        means = self._means(t)
        gap = x[..., None, :] - means
        return -0.5 * (gap**2).sum(axis=-1) / self.variance, means

    def density(self, x: ArrayLike, t: float) -> Array:
        """f at positions (..., 2), normalised over the plane."""
        logs, _ = self._logs(array(x, "x", (..., 2)), number(t, "t"))
        out = np.exp(logs).mean(axis=-1) / (2 * np.pi * self.variance)
        return np.asarray(out)

    def score(self, x: ArrayLike, t: float) -> Array:
        """∇f/f at positions (..., 2); finite wherever f itself would underflow."""
        return self._score(array(x, "x", (..., 2)), number(t, "t"))

    def _score(self, x: Array, t: float) -> Array:
        logs, means = self._logs(x, t)
        w = np.exp(logs - logs.max(axis=-1, keepdims=True))
        w /= w.sum(axis=-1, keepdims=True)
        return np.asarray((w @ means - x) / self.variance)


def rotating_swarm(
    reading: str = "slowgibbs",
    *,
    strength: float = 0.03,
    mixture: RotatingMixture | None = None,
) -> Swarm:
    """The swarm of Zheng and Lin's study, equation (23), in one of its `READINGS`.

    Parameters
    ----------
    reading, strength
        As for :func:`mobility_and_diffusion`.
    mixture : RotatingMixture, optional
        What the agents are drawn to.

    Returns
    -------
    Swarm

    Examples
    --------
    >>> swarm = rotating_swarm("gibbs")
    >>> swarm.drift_at(np.array([[0.8, 0.6]]), 0.0).round(3)
    array([[-0.  , -0.15]])
    """
    mobility, diffusion = mobility_and_diffusion(reading, strength)
    f = RotatingMixture() if mixture is None else mixture
    instance(f, "mixture", RotatingMixture)
    return Swarm(lambda x, t: mobility * f._score(x, t), diffusion)
