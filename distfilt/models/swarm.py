"""Swarms: agents that drift and diffuse in a box with reflecting walls."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Annotated, Literal

import numpy as np

from ..validation import (
    Array,
    ArrayInput,
    Bounds,
    FrozenModel,
    NonNegativeFloat,
    PositiveFloat,
    PositiveInt,
    Rng,
    Times,
    call_user,
    validated,
)
from ..validation.checks import check_array
from .base import trajectory

__all__ = ["RotatingMixture", "Swarm", "rotating_swarm"]

_Strength = Annotated[float, Bounds(above=0, at_most=1e150)]
"""A strength of noise whose square is finite."""

Positions = Annotated[ArrayInput, "... self.dim"]


def _reflect(x: Array, low: Array, high: Array) -> Array:
    """Fold positions (..., d) back into a box with reflecting walls, from `low` to `high`, (d,)."""
    width = high - low
    # A path on between mirrors: a triangular wave of period 2 width, which is 0 at the lower wall
    # and `width` at the upper one.
    folded = np.abs((x - low + width) % (2 * width) - width)
    # The sum of low and a rounded width may lie one bit beyond the wall.
    return np.clip(low + folded, low, high)


def check_inside(positions: Array, low: Array, high: Array) -> None:
    """Refuse positions (..., d) outside the box.

    The lower corner is `low`, the upper one `high`, (d,) each.
    """
    # Walls belong to the box; NaN passes this comparison, and was refused before.
    outside = ((positions < low) | (positions > high)).any(axis=-1)
    if outside.any():
        raise ValueError(
            "positions must be inside the box, got "
            f"{outside.sum()} outside, the first at {positions[outside][0].tolist()}"
        )


def _expand_diffusion(value: object, points: tuple[int, ...], dim: int) -> Array:
    """Validate a diffusion, isotropic or per axis, and broadcast it to (*points, d).

    The points are all axes of the positions but the last, which has d = `dim` coordinates.
    """
    diffusion = check_array(value, "diffusion")
    # Isotropic: one number, or one at each point.
    if diffusion.shape in ((), points):
        diffusion = diffusion[..., None]
    elif diffusion.shape not in ((dim,), (*points, dim)):
        raise ValueError(
            "diffusion must be a number, or one number for each axis, "
            f"at points of shape {points}, got shape {diffusion.shape}"
        )
    least = float(diffusion.min(initial=np.inf))
    # Written so that NaN is refused too.
    if not least > 0:
        raise ValueError(f"diffusion must be positive, got {least:g}")
    return np.broadcast_to(diffusion, (*points, dim))


@dataclass(frozen=True, eq=False)
class Swarm(FrozenModel):
    r"""Independent, identical agents in a box with reflecting walls.

    .. math:: d\mathbf X = \mathbf v(\mathbf X, t)\,dt + \sqrt{2\mathbf D(\mathbf X,t)}\,d\mathbf B

    in the sense of Itô: equation (1) of Zheng and Lin, with
    :math:`\mathbf D=\tfrac12\boldsymbol\sigma\boldsymbol\sigma^\top` diagonal.

    Parameters
    ----------
    drift : callable
        ``drift(x, t) -> v`` on positions (..., d), in the positions' unit per second.
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
    # A number, one for each axis, or a function: checked below.
    diffusion: object
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
            raise ValueError(f"high must be above low = {low}, got {high}")
        if not callable(self.diffusion):
            # A copy of the caller's array; functions are checked when they are called. The
            # dataclass is frozen, so that the field cannot be assigned to.
            diffusion = _expand_diffusion(self.diffusion, (), self.dim).copy()
            object.__setattr__(self, "diffusion", diffusion)

    @property
    def dim(self) -> int:
        """Number d of coordinates."""
        return self.low.size

    def drift_at(self, x: Array, t: float) -> Array:
        """The drift at positions (..., d), checked for its shape."""
        return check_array(call_user(self.drift, x, t), "drift", x.shape)

    def diffusion_at(self, x: Array, t: float) -> Array:
        """The diffusion along each axis at positions (..., d), as (..., d)."""
        if callable(self.diffusion):
            value = call_user(self.diffusion, x, t)
            return _expand_diffusion(value, x.shape[:-1], self.dim)
        diffusion = _expand_diffusion(self.diffusion, (), self.dim)
        return np.broadcast_to(diffusion, x.shape)

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
        """Move agents from `t` to `t` + `dt` by the Euler-Maruyama scheme.

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
        check_inside(positions, self.low, self.high)
        return self._step(positions, t, dt, rng, substeps)

    def _step(
        self, x: Array, t: float, dt: float, rng: np.random.Generator, substeps: int
    ) -> Array:
        """Move positions (..., d) from `t` to `t` + `dt`, reflected at the walls."""
        # Equal substeps of the Euler-Maruyama scheme
        h = dt / substeps
        for k in range(substeps):
            now = t + k * h
            # x + h v(x) + sqrt(2 h D(x)) z, then the walls
            std = np.sqrt(2 * h * self.diffusion_at(x, now))
            noise = std * rng.standard_normal(x.shape)
            proposal = x + h * self.drift_at(x, now) + noise
            x = _reflect(proposal, self.low, self.high)
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
        """Simulate agents that start from `positions` at `t0`; positions at `times`, (T, ..., d).

        Parameters are those of :meth:`step`; `times` increase strictly from `t0`.
        """
        check_inside(positions, self.low, self.high)
        step = partial(self._step, rng=rng, substeps=substeps)
        return trajectory(step, positions, times, t0)


@dataclass(frozen=True, eq=False)
class RotatingMixture(FrozenModel):
    """Gaussians of equal weight and variance that move on a circle: f(x, t) of Zheng and Lin.

    Parameters
    ----------
    centre : array_like, (2,)
        Centre of the circle.
    radius, rate : float
        Radius of the circle, and angular velocity in rad/s.
    variance : float
        Variance of each component along each axis, positive.
    components : int
        Number of components, evenly spaced.
    phase : float
        Angle of the first component at t = 0, in rad.

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
        """Means of the components at time `t`, (K, 2)."""
        k = np.arange(self.components)
        # Evenly spaced on the circle, at a common angular velocity
        angle = self.rate * t + self.phase + 2 * np.pi * k / self.components
        circle = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        return np.asarray(self.centre + self.radius * circle)

    def _log_kernels(self, x: Array, means: Array) -> Array:
        """Log densities of the components at x, (..., K), without their common constant."""
        difference = x[..., None, :] - means
        return np.asarray(-0.5 * (difference**2).sum(axis=-1) / self.variance)

    @validated
    def density(self, x: Annotated[ArrayInput, "... 2"], t: float) -> Array:
        """Density f at positions (..., 2), normalised over the plane."""
        logs = self._log_kernels(x, self.means(t))
        normalisation = 2 * np.pi * self.variance
        return np.asarray(np.exp(logs).mean(axis=-1) / normalisation)

    @validated
    def score(self, x: Annotated[ArrayInput, "... 2"], t: float) -> Array:
        """Score ∇f/f at positions (..., 2); finite even where f itself underflows."""
        means = self.means(t)
        logs = self._log_kernels(x, means)
        # Weights of the components at x; the largest exponent is 0, so that one weight remains.
        weights = np.exp(logs - logs.max(axis=-1, keepdims=True))
        weights /= weights.sum(axis=-1, keepdims=True)
        # ∇f/f = Σ w_k (m_k - x)/σ²
        return np.asarray((weights @ means - x) / self.variance)


@validated
def rotating_swarm(
    interpretation: Literal["literal", "gibbs", "slowgibbs"] = "slowgibbs",
    *,
    strength: _Strength = 0.03,
    mixture: RotatingMixture | None = None,
) -> Swarm:
    """The swarm of Zheng and Lin's study, equation (23), in one of three interpretations.

    Parameters
    ----------
    interpretation : {"literal", "gibbs", "slowgibbs"}
        The drift is c ∇f/f with a mobility c and a diffusion D. As printed ("literal"), the number
        s is both the mobility and the strength of the noise, so that D = s²/2; the density then
        approaches the power 2/s of f. With c = D = s ("gibbs") or c = D = s²/2 ("slowgibbs") it
        approaches f itself, fast or slowly. All are in 1/s for a box of width 1.
    strength : float
        The number s, positive.
    mixture : RotatingMixture, optional
        The density f that attracts the agents.

    Returns
    -------
    Swarm

    Examples
    --------
    >>> swarm = rotating_swarm("gibbs")
    >>> swarm.drift_at(np.array([[0.8, 0.6]]), 0.0).round(3)
    array([[-0.  , -0.15]])
    """
    # Of a noise of strength s the diffusion is D = s²/2.
    half_square = strength**2 / 2
    mobility = half_square if interpretation == "slowgibbs" else strength
    diffusion = strength if interpretation == "gibbs" else half_square
    f = RotatingMixture() if mixture is None else mixture
    return Swarm(partial(_score_drift, mobility=mobility, mixture=f), diffusion)


def _score_drift(
    x: Array, t: float, mobility: float, mixture: RotatingMixture
) -> Array:
    """Return the drift c ∇f/f at positions (..., 2), with the mobility c."""
    return np.asarray(mobility * mixture.score(x, t))
