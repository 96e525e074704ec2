"""Swarms: agents in a box that drift, diffuse and are reflected by its walls."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Annotated, Any, Literal

import numpy as np

from ..validation import (
    Array,
    Bounds,
    FrozenModel,
    NonNegativeFloat,
    PositiveFloat,
    PositiveInt,
    Rng,
    Times,
    validated,
)
from ..validation.checks import check_array
from .base import path

__all__ = ["RotatingMixture", "Swarm", "rotating_swarm"]

Positions = Annotated[Array, "... self.dim"]


def _reflected(x: Array, low: Array, high: Array) -> Array:
    """Fold positions back into a box, as walls do that reflect."""
    width = high - low
    fold = np.abs((x - low + width) % (2 * width) - width)
    # The sum of low and a rounded width may lie one bit beyond the wall.
    return np.clip(low + fold, low, high)


def inside(positions: Array, low: Array, high: Array) -> Array:
    """Positions (..., d); those outside the box are refused."""
    outside = ((positions < low) | (positions > high)).any(axis=-1)
    if outside.any():
        raise ValueError(
            "positions must have agents inside the box, got "
            f"{outside.sum()} outside, one at {positions[outside][0].tolist()}"
        )
    return positions


def _diagonal(value: Any, points: tuple[int, ...], dim: int) -> Array:
    """A diffusion, isotropic or per axis, as (*points, d), positive."""
    d = check_array(value, "diffusion")
    if d.shape in ((), points):
        d = d[..., None]
    elif d.shape not in ((dim,), (*points, dim)):
        raise ValueError(
            f"diffusion must be a number or one for each axis at {points} points, got {d.shape}"
        )
    least = float(d.min(initial=np.inf))
    if not least > 0:
        raise ValueError(f"diffusion must be numbers above 0, got {least:g}")
    return np.broadcast_to(d, (*points, dim))


@dataclass(frozen=True, eq=False)
class Swarm(FrozenModel):
    r"""Independent agents of one law in a box with reflecting walls.

    .. math:: d\mathbf X = \mathbf v(\mathbf X, t)\,dt + \sqrt{2\mathbf D(\mathbf X,t)}\,d\mathbf B

    in the sense of Itô, equation (1) of Zheng and Lin with
    :math:`\mathbf D=\tfrac12\boldsymbol\sigma\boldsymbol\sigma^\top` diagonal.

    Parameters
    ----------
    drift : callable
        ``drift(x, t) -> v`` on positions (..., d), in 1/s times the positions' unit.
    diffusion : float, array_like (d,), or callable
        The diagonal of D, positive; a callable ``diffusion(x, t)`` returns (...) or (..., d).
    low, high : array_like, (d,)
        The box's corners; the unit square by default.

    Raises
    ------
    ValueError
        If the diffusion is not positive.

    Examples
    --------
    >>> still = Swarm(lambda x, t: 0 * x, 0.01)
    >>> start = np.full((3, 2), 0.5)
    >>> still.step(start, 0.0, 0.1, rng=np.random.default_rng(1)).shape
    (3, 2)
    """

    drift: Callable[[Array, float], Array]
    diffusion: Any
    low: Annotated[Array, "d"] = field(
        default_factory=partial(np.zeros, 2), kw_only=True
    )
    high: Annotated[Array, "d"] = field(
        default_factory=partial(np.ones, 2), kw_only=True
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if (self.low >= self.high).any():
            low = self.low.tolist()
            high = self.high.tolist()
            raise ValueError(f"high must have corners above low = {low}, got {high}")
        if not callable(self.diffusion):
            object.__setattr__(
                self, "diffusion", _diagonal(self.diffusion, (), self.dim).copy()
            )

    @property
    def dim(self) -> int:
        """Number d of coordinates."""
        return self.low.size

    def drift_at(self, x: Array, t: float) -> Array:
        """The drift at positions (..., d), checked for its shape."""
        return check_array(self.drift(x, t), "drift", x.shape)

    def diffusion_at(self, x: Array, t: float) -> Array:
        """The diffusion along each axis at positions (..., d), as (..., d)."""
        value = self.diffusion(x, t) if callable(self.diffusion) else self.diffusion
        points = x.shape[:-1] if callable(self.diffusion) else ()
        return np.broadcast_to(_diagonal(value, points, self.dim), x.shape)

    @validated
    def step(
        self,
        positions: Positions,
        t: float,
        dt: PositiveFloat,
        *,
        rng: Rng,
        substeps: PositiveInt = 10,
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
        return self._step(inside(positions, self.low, self.high), t, dt, rng, substeps)

    def _step(
        self, x: Array, t: float, dt: float, rng: np.random.Generator, n: int
    ) -> Array:
        h = dt / n
        for k in range(n):
            now = t + k * h
            kick = np.sqrt(2 * h * self.diffusion_at(x, now)) * rng.standard_normal(
                x.shape
            )
            x = _reflected(x + h * self.drift_at(x, now) + kick, self.low, self.high)
        return x

    @validated
    def simulate(
        self,
        positions: Positions,
        times: Times,
        *,
        rng: Rng,
        t0: float = 0.0,
        substeps: PositiveInt = 10,
    ) -> Array:
        """Positions at `times`, (T, ..., d), of agents that are at `positions` at `t0`.

        Parameters are those of :meth:`step`; `times` increase strictly from `t0`.
        """
        move = partial(self._step, rng=rng, n=substeps)
        return path(move, inside(positions, self.low, self.high), times, t0)


@dataclass(frozen=True, eq=False)
class RotatingMixture(FrozenModel):
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

    centre: Annotated[Array, "2"] = field(
        default_factory=partial(np.full, 2, 0.5), kw_only=True
    )
    radius: NonNegativeFloat = field(default=0.3, kw_only=True)
    rate: float = field(default=0.04, kw_only=True)
    variance: PositiveFloat = field(default=0.02, kw_only=True)
    components: PositiveInt = field(default=2, kw_only=True)
    phase: float = field(default=0.0, kw_only=True)

    @validated
    def means(self, t: float) -> Array:
        """Where the components are at time `t`, (K, 2)."""
        k = np.arange(self.components)
        angle = self.rate * t + self.phase + 2 * np.pi * k / self.components
        circle = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        return np.asarray(self.centre + self.radius * circle)

    def _logs(self, x: Array, t: float) -> tuple[Array, Array]:
        means = self.means(t)
        gap = x[..., None, :] - means
        return -0.5 * (gap**2).sum(axis=-1) / self.variance, means

    @validated
    def density(self, x: Annotated[Array, "... 2"], t: float) -> Array:
        """f at positions (..., 2), normalised over the plane."""
        logs, _ = self._logs(x, t)
        out = np.exp(logs).mean(axis=-1) / (2 * np.pi * self.variance)
        return np.asarray(out)

    @validated
    def score(self, x: Annotated[Array, "... 2"], t: float) -> Array:
        """∇f/f at positions (..., 2); finite wherever f itself would underflow."""
        logs, means = self._logs(x, t)
        w = np.exp(logs - logs.max(axis=-1, keepdims=True))
        w /= w.sum(axis=-1, keepdims=True)
        return np.asarray((w @ means - x) / self.variance)


@validated
def rotating_swarm(
    reading: Literal["literal", "gibbs", "slowgibbs"] = "slowgibbs",
    *,
    strength: Annotated[float, Bounds(above=0, at_most=1e150)] = 0.03,
    mixture: RotatingMixture | None = None,
) -> Swarm:
    """The swarm of Zheng and Lin's study, equation (23), in one of three readings.

    Parameters
    ----------
    reading : {"literal", "gibbs", "slowgibbs"}
        The drift is c ∇f/f with a mobility c and a diffusion D. As printed, the one number s is the
        mobility and the noise's strength, so that D = s²/2; the density then follows the power 2/s
        of f. With both s ("gibbs"), or both s²/2 ("slowgibbs"), it follows f itself, fast or
        slowly. All are in 1/s for a box of width 1.
    strength : float
        The number s, positive.
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
    small = strength**2 / 2
    mobility = small if reading == "slowgibbs" else strength
    f = RotatingMixture() if mixture is None else mixture
    drift = partial(_drawn, mobility=mobility, mixture=f)
    return Swarm(drift, strength if reading == "gibbs" else small)


def _drawn(x: Array, t: float, mobility: float, mixture: RotatingMixture) -> Array:
    return np.asarray(mobility * mixture.score(x, t))
