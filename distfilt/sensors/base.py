"""What a sensor is: a prediction, its noise, and how two readings are compared.

A reading has no value where NaN stands: a component that is missing in an observation, or that the
sensor cannot see from a state (the angle of a place where the sensor itself stands). A residual of
either is NaN, and a filter leaves that component out of that run's update: a component is used only
where the reading has it and every prediction that it is compared with has it too.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import Annotated

import numpy as np

from ..linalg import as_derivative, central, factor, leading
from ..validation import (
    ALLOW_NAN,
    Array,
    FrozenModel,
    PositiveDefinite,
    PositiveFloat,
    PositiveInt,
    Rng,
    check_array,
    validated,
)
from ..validation.checks import call_batched

__all__ = ["Sensor", "wrap"]


@validated
def wrap(
    angles: Annotated[Array, "...", ALLOW_NAN], *, period: PositiveFloat = 2 * np.pi
) -> Array:
    """Bring angles into [-period/2, period/2).

    Parameters
    ----------
    angles : array_like, (...)
        Angles, in rad. One that lies there already is returned as it is, and so is NaN (missing).
    period : float
        2π for directions; π for the angle of a line, which `arctan(b/a)` measures.

    Examples
    --------
    >>> float(wrap(3 * np.pi / 2).round(6))
    -1.570796
    """
    half = 0.5 * period
    inside = (angles >= -half) & (angles < half)
    if inside.all():
        return np.array(angles)
    moved = (angles + half) % period - half
    # Rounding can put an angle just below -half at +half, which stands for the same direction.
    moved = np.where(moved >= half, -half, moved)
    return np.asarray(np.where(inside, angles, moved))


@dataclass(frozen=True, eq=False)
class Sensor(FrozenModel):
    """A sensor y = h(x) + ζ, ζ ~ N(0, R), possibly of two successive states.

    Parameters
    ----------
    dim : int
        Size m of an observation.
    function : callable
        ``function(x) -> y`` on (..., d) to (..., m), without noise; with `uses_previous`,
        ``function(x, previous) -> y``. It gets copies of the states. NaN where the state cannot be
        seen. One that takes a single state only is refused when it first gets several.
    cov : array_like, (m, m)
        The covariance R, positive definite.
    difference : callable, optional
        ``difference(observed, predicted)``, for readings that wrap; subtraction by default. One
        that falls where the reading grows is refused.
    uses_previous : bool
        Whether the sensor sees the change from the previous observation time.
    kind : str
        A name, for tables.
    linear : callable, optional
        ``linear(d) -> H``, (m, d), if h is linear.
    derivative : callable, optional
        ``derivative(x)``, the Jacobian of `function` in the present state, (..., m, d), called
        like it. Central differences stand in for it; a first time they are compared, and a
        warning tells of another function's.

    Examples
    --------
    >>> total = Sensor(1, lambda x: x.sum(axis=-1, keepdims=True), [[0.04]])
    >>> total.predict([1.0, 2.0])
    array([3.])
    """

    dim: PositiveInt
    h: Callable[..., Array]
    noise_cov: Annotated[PositiveDefinite, "dim dim"]
    residual_function: Callable[[Array, Array], Array] | None = field(
        default=None, kw_only=True
    )
    uses_previous: bool = field(default=False, kw_only=True)
    kind: str = field(default="sensor", kw_only=True)
    linear: Callable[[int], Array] | None = field(default=None, kw_only=True)
    derivative: Callable[..., Array] | None = field(default=None, kw_only=True)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.residual_function is not None:
            ahead = self.residual_function(
                np.full(self.dim, 1 + 1e-6), np.ones(self.dim)
            )
            if (np.asarray(ahead) < -5e-7).any():
                raise ValueError(
                    "difference must have observed less predicted, got the opposite"
                )

    @cached_property
    def noise_sqrt(self) -> Array:
        """A factor of R, (m, m)."""
        return factor(self.noise_cov)

    @validated
    def predict(
        self,
        x: Annotated[Array, "... d"],
        previous: Annotated[Array, "... d"] | None = None,
    ) -> Array:
        """The observation without noise of states (..., d), as (..., m).

        `previous` holds the states at the previous observation time; only a sensor that sees
        changes needs it.
        """
        return call_batched(self, "h", self._states(x, previous))

    def _states(self, x: Array, previous: Array | None) -> tuple[Array, ...]:
        """What the function gets."""
        if not self.uses_previous:
            return (x,)
        if previous is None:
            raise ValueError(
                f"previous: a {self.kind} sensor needs the states before, which at a "
                "state's own time a filter's lag keeps, got None"
            )
        if x.shape != previous.shape:
            leading(x.shape[:-1], previous.shape[:-1], "previous")
            x, previous = np.broadcast_arrays(x, previous)
        return x, previous

    @validated
    def observe(
        self,
        x: Annotated[Array, "... d"],
        *,
        rng: Rng,
        previous: Annotated[Array, "... d"] | None = None,
    ) -> Array:
        """A noisy observation of each of the states (..., d), as (..., m)."""
        seen = self.predict(x, previous)
        return seen + rng.standard_normal(seen.shape) @ self.noise_sqrt.T

    @validated
    def residual(
        self,
        observed: Annotated[Array, "... self.dim", ALLOW_NAN],
        predicted: Annotated[Array, "... self.dim", ALLOW_NAN],
    ) -> Array:
        """How far observations are from predictions, (..., m), wrapped where the sensor wraps.

        NaN, a missing component or one that the sensor cannot see, stays NaN.

        >>> seen, near = np.array([3.0]), np.array([1.0])
        >>> eye = Sensor(
        ...     1,
        ...     lambda x: x,
        ...     [[1.0]],
        ...     residual_function=lambda a, b: np.subtract(a, b, out=a),
        ... )
        >>> eye.residual(seen, near), seen
        (array([2.]), array([3.]))
        """
        if self.residual_function is None:
            return np.asarray(observed - predicted)
        wanted = leading(observed.shape, predicted.shape, "predicted")
        gap = np.asarray(self.residual_function(observed.copy(), predicted.copy()))
        if gap.shape != wanted:
            raise ValueError(f"difference must return shape {wanted}, got {gap.shape}")
        return gap

    @validated
    def H(self, dim: PositiveInt) -> Array:
        """The matrix H, (m, `dim`), of a linear sensor."""
        if self.linear is None:
            raise ValueError(
                f"sensor must be a linear sensor, got a {self.kind} sensor"
            )
        h = check_array(self.linear(dim), "linear", (self.dim, dim))
        seen = self.predict(np.eye(dim)) if vars(self).pop("_doubted", False) else h.T
        if not np.allclose(seen, h.T, atol=1e-9):
            raise ValueError("linear must be the matrix of its function, got another")
        return h

    @validated
    def jacobian(
        self,
        x: Annotated[Array, "... d"],
        previous: Annotated[Array, "... d"] | None = None,
    ) -> Array:
        """Derivative of h in the present states (..., d), as (..., m, d).

        `derivative` where the sensor has it, central differences otherwise. NaN where the state
        cannot be seen.
        """
        states = self._states(x, previous)
        d = x.shape[-1]
        full = (*states[0].shape[:-1], self.dim, d)
        if self.linear is not None:
            return np.broadcast_to(self.H(d), full)
        before = [b[..., None, :] for b in states[1:]]
        predict = self.predict
        residual = self.residual
        near = partial(
            central, lambda moved: predict(moved, *before), states[0], residual
        )
        return as_derivative(self, states, full, near)
