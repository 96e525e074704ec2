"""What a sensor is: a prediction, its noise, and how two readings are compared.

A reading has no value where NaN stands: a component that is missing in an observation, or that the
sensor cannot see from a state (the angle of a place where the sensor itself stands). A residual of
either is NaN, and a filter leaves that component out of that run's update: a component is used only
where the reading has it and every prediction that it is compared with has it too.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from ..checks import Array, array, callable_, count, covariance, generator, instance, number
from ..differences import _central
from ..linalg import _leading, factor

__all__ = ["Sensor", "wrap"]


def wrap(angles: ArrayLike, *, period: float = 2 * np.pi) -> Array:
    """Bring angles into [-period/2, period/2).

    Parameters
    ----------
    angles : array_like, (...)
        Angles, in rad. One that lies there already is returned as it is.
    period : float
        2π for directions; π for the angle of a line, which `arctan(b/a)` measures.

    Examples
    --------
    >>> float(wrap(3 * np.pi / 2).round(6))
    -1.570796
    """
    return _wrapped(array(angles, "angles"), number(period, "period", above=0))


def _wrapped(a: Array, period: float) -> Array:
    half = 0.5 * period
    moved = (a + half) % period - half
    # Rounding can put an angle just below -half at +half, which stands for the same direction.
    moved = np.where(moved >= half, -half, moved)
    return np.asarray(np.where((a >= -half) & (a < half), a, moved))


@dataclass(frozen=True, eq=False)
class Sensor:
    """A sensor y = h(x) + ζ, ζ ~ N(0, R), possibly of two successive states.

    Parameters
    ----------
    dim : int
        Size m of an observation.
    function : callable
        ``function(x) -> y`` on (..., d) to (..., m), without noise; with `uses_previous`,
        ``function(x, previous) -> y``. It gets copies of the states. NaN where the state cannot be
        seen.
    cov : array_like, (m, m)
        The covariance R, positive definite.
    difference : callable, optional
        ``difference(observed, predicted)``, for readings that wrap; subtraction by default.
    uses_previous : bool
        Whether the sensor sees the change from the previous observation time.
    kind : str
        A name, for tables.
    linear : callable, optional
        ``linear(d) -> H``, (m, d), if h is linear.
    derivative : callable, optional
        ``derivative(x)``, the Jacobian of `function` in the present state, (..., m, d), called
        like it. Central differences stand in for it.
    units : tuple of str, optional
        Unit of each component of a reading.

    Examples
    --------
    >>> total = Sensor(1, lambda x: x.sum(axis=-1, keepdims=True), [[0.04]])
    >>> total.predict([1.0, 2.0])
    array([3.])
    """

    dim: int
    function: Callable[..., Array]
    cov: Array
    difference: Callable[[Array, Array], Array] | None = field(default=None, kw_only=True)
    uses_previous: bool = field(default=False, kw_only=True)
    kind: str = field(default="sensor", kw_only=True)
    linear: Callable[[int], Array] | None = field(default=None, kw_only=True)
    derivative: Callable[..., Array] | None = field(default=None, kw_only=True)
    units: tuple[str, ...] = field(default=(), kw_only=True)

    def __post_init__(self) -> None:
        count(self.dim, "dim")
        callable_(self.function, "function")
        instance(self.uses_previous, "uses_previous", bool)
        instance(self.kind, "kind", str)
        for name in ("difference", "linear", "derivative"):
            if getattr(self, name) is not None:
                callable_(getattr(self, name), name)
        if not isinstance(self.units, tuple) or len(self.units) not in (0, self.dim):
            raise ValueError(f"units: needs a tuple of {self.dim} words, got {self.units!r}")
        cov = array(covariance(self.cov, "cov", self.dim), "cov", (self.dim, self.dim)).copy()
        cov.setflags(write=False)
        object.__setattr__(self, "cov", cov)

    def predict(self, x: ArrayLike, previous: ArrayLike | None = None) -> Array:
        """The observation without noise of states (..., d), as (..., m).

        `previous` holds the states at the previous observation time; only a sensor that sees
        changes needs it.
        """
        return self._seen(*self._states(x, previous))

    def _seen(self, *states: Array) -> Array:
        """`predict` of checked arguments; it tells a function that takes only one state."""
        try:
            seen = self._predict(*states)
        except (TypeError, ValueError, IndexError) as error:
            self._refuse_unbatched(states, error)
            if isinstance(error, IndexError):
                raise ValueError(f"x: needs more components, got {states[0].shape}") from error
            raise
        if seen.size and states[0].ndim > 1 and states[0].shape[0] == self.dim:
            # Here a function that takes components from the first axis returns the right shape.
            alone = self._predict(*(s.reshape(-1, s.shape[-1])[-1] for s in states))
            last = seen.reshape(-1, self.dim)[-1]
            if not np.allclose(last, alone, rtol=1e-6, atol=1e-9, equal_nan=True):
                raise ValueError(_UNBATCHED.format(states[0].shape, "other values than for one"))
        return seen

    def _refuse_unbatched(self, states: tuple[Array, ...], error: Exception) -> None:
        """Say so, if the function takes one state but not many."""
        if states[0].ndim < 2 or not states[0].size:
            return
        try:
            self._predict(*(s.reshape(-1, s.shape[-1])[0] for s in states))
        except (TypeError, ValueError, IndexError):
            return
        raise ValueError(_UNBATCHED.format(states[0].shape, error)) from error

    def _states(self, x: ArrayLike, previous: ArrayLike | None) -> tuple[Array, ...]:
        state = array(x, "x", (..., "d"))
        if not self.uses_previous:
            if previous is not None:
                array(previous, "previous", (..., state.shape[-1]))
            return (state,)
        if previous is None:
            raise ValueError(f"previous: a {self.kind} sensor needs the previous states, got None")
        before = array(previous, "previous", (..., state.shape[-1]))
        _leading(state.shape[:-1], before.shape[:-1], "previous")
        return tuple(np.broadcast_arrays(state, before))

    def _predict(self, state: Array, previous: Array | None = None) -> Array:
        """`predict` of checked arguments. The copies are for functions that work in place."""
        seen = np.asarray(self.function(*self._copies(state, previous)), dtype=np.float64)
        wanted = (*state.shape[:-1], self.dim)
        if seen.shape != wanted:
            raise ValueError(
                f"function: needs to return shape {wanted} for states {state.shape}, "
                f"got {seen.shape}"
            )
        return seen

    def _copies(self, state: Array, previous: Array | None) -> tuple[Array, ...]:
        if previous is None or not self.uses_previous:
            return (state.copy(),)
        return state.copy(), previous.copy()

    def observe(
        self, x: ArrayLike, *, rng: np.random.Generator, previous: ArrayLike | None = None
    ) -> Array:
        """A noisy observation of each of the states (..., d), as (..., m)."""
        seen = self.predict(x, previous)
        root = factor(self.cov, name="cov")
        return seen + generator(rng).standard_normal(seen.shape) @ root.T

    def residual(self, observed: ArrayLike, predicted: ArrayLike) -> Array:
        """How far observations are from predictions, (..., m), wrapped where the sensor wraps.

        NaN, a missing component or one that the sensor cannot see, stays NaN.
        """
        y, p = (_readings(v, n, self.dim) for v, n in
                ((observed, "observed"), (predicted, "predicted")))  # fmt: skip
        try:
            np.broadcast_shapes(y.shape, p.shape)
        except ValueError:
            raise ValueError(
                f"predicted: needs a shape that goes with observed {y.shape}, got {p.shape}"
            ) from None
        return self._residual(y, p)

    def _residual(self, y: Array, p: Array) -> Array:
        """`residual` of checked arguments."""
        if self.difference is None:
            return np.asarray(y - p)
        gap = np.asarray(self.difference(y, p))
        wanted = np.broadcast_shapes(y.shape, p.shape)
        if gap.shape != wanted:
            raise ValueError(f"difference: needs to return shape {wanted}, got {gap.shape}")
        return gap

    def matrix(self, dim: int) -> Array:
        """The matrix H, (m, `dim`), of a linear sensor."""
        if self.linear is None:
            raise ValueError(f"sensor: needs a linear sensor, got a {self.kind} sensor")
        n = count(dim, "dim")
        return array(self.linear(n), "linear", (self.dim, n))

    def jacobian(self, x: ArrayLike, previous: ArrayLike | None = None) -> Array:
        """Derivative of h in the present states (..., d), as (..., m, d).

        `derivative` where the sensor has it, central differences otherwise. NaN where the state
        cannot be seen.
        """
        states = self._states(x, previous)
        slope = self._jacobian(*states)
        return np.broadcast_to(slope, (*states[0].shape[:-1], *slope.shape[-2:])).copy()

    def _jacobian(self, state: Array, previous: Array | None = None) -> Array:
        """`jacobian` of checked arguments; (m, d) where it is the same for all states."""
        if self.linear is not None:
            return self.matrix(state.shape[-1])
        if self.derivative is None:
            return self._differences(state, previous)
        slope = np.asarray(self.derivative(*self._copies(state, previous)))
        each = (self.dim, state.shape[-1])
        if slope.shape not in ((*state.shape[:-1], *each), each):
            wanted = (*state.shape[:-1], *each)
            raise ValueError(f"derivative: needs to return shape {wanted}, got {slope.shape}")
        return slope

    def _differences(self, state: Array, previous: Array | None) -> Array:
        def function(x: Array) -> Array:
            if previous is None:
                return self._predict(x)
            return self._predict(x, np.broadcast_to(previous[..., None, :], x.shape))

        return _central(function, state, self._residual)


_UNBATCHED = (
    "function: needs to take many states at once, (..., d), with the components last "
    "(x[..., 0], not x[0]); for states {} it gives {}"
)


def _readings(value: ArrayLike, name: str, dim: int) -> Array:
    out = array(value, name, (..., dim), finite=False)
    if np.isinf(out).any():
        raise ValueError(f"{name}: needs finite numbers or NaN (missing), got infinity")
    return out
