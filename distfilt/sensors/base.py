"""Sensors: the predicted observation, its noise, and the residual of two observations.

An observation is missing where it is NaN: the component was not measured, or the sensor
cannot see it from that state (the bearing of a place at which the sensor itself
stands). A residual with such a component is NaN too, and a filter leaves it out of that
run's update: a component is used only if the observation has it and so has every
prediction that it is compared with. The filter's record counts the observations that
are left out as ``unseen``, and a warning says so once. Only particles and mixtures can
learn from it: a particle, or a component, that cannot see contradicts what was seen.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import Annotated, cast

import numpy as np
from numpy.typing import NDArray

from ..derivatives import (
    call_derivative,
    difference_with_error,
    evaluate_derivative,
    needs_differences,
)
from ..linalg import broadcast_leading, factor
from ..periods import Periods, PeriodsArgument, align, read_periods, wrap_differences
from ..validation import (
    ALLOW_NAN,
    Array,
    ArrayInput,
    FrozenModel,
    PositiveDefinite,
    PositiveFloat,
    PositiveInt,
    Rng,
    call_user,
    check_array,
    check_signature,
    validated,
)
from ..validation.batching import call_batched
from ..validation.checks import refuse_mask
from ..validation.first_use import is_first_use

__all__ = ["Sensor", "wrap"]


@validated
def wrap(
    angles: Annotated[ArrayInput, "...", ALLOW_NAN],
    *,
    period: PositiveFloat = 2 * np.pi,
) -> Array:
    """Bring angles into [-period/2, period/2).

    Parameters
    ----------
    angles : array_like, (...)
        Angles, in rad. Those inside the interval are returned unchanged, and so is NaN
        (missing).
    period : float
        2π for directions; π for the angle of a line, which `arctan(b/a)` measures.

    Examples
    --------
    >>> float(wrap(3 * np.pi / 2).round(6))
    -1.570796
    """
    return wrap_angles(angles, period)


def wrap_angles(angles: Array, period: float) -> Array:
    """Bring angles into [-period/2, period/2), unchecked: see :func:`wrap`.

    Angles are (...), and so is the result; the period is one for all.

    >>> wrap_angles(np.array([-np.pi, np.pi]), 2 * np.pi).round(6)
    array([-3.141593, -3.141593])
    """
    half = 0.5 * period
    # The usual case; a copy, since a caller may change the result in place.
    if np.count_nonzero(np.abs(angles) < half) == angles.size:
        return np.array(angles)
    inside = (angles >= -half) & (angles < half)
    wrapped = (angles + half) % period - half
    # Rounding can turn an angle just below -half into +half: the same direction, but outside the
    # half-open interval.
    wrapped = np.where(wrapped >= half, -half, wrapped)
    # The shift by half a period costs digits: angles inside keep all of theirs.
    return np.asarray(np.where(inside, angles, wrapped))


@dataclass(frozen=True, eq=False)
class Sensor(FrozenModel):
    """A sensor y = h(x) + ζ, ζ ~ N(0, R), possibly of two successive states.

    Parameters
    ----------
    dim : int
        Size m of an observation.
    h : callable
        The observation function, ``h(x) -> y`` on (..., d) to (..., m), without noise;
        with `uses_previous`, ``h(x, previous) -> y``. It gets copies of the states. NaN
        where the state cannot be seen. A function that takes a single state only is
        refused when it first gets several.
    noise_cov : array_like, (m, m)
        The covariance R of the noise, positive definite.
    residual_function : callable, optional
        ``residual_function(observed, predicted)``, for observations that wrap;
        subtraction by default. A function that decreases as the observation increases
        is refused. Angles need none if they have `periods`.
    periods : sequence of (float or None), or mapping, optional
        The period of each component of the observation that is circular, such as 2π for a
        compass in rad, and None for the others; or a mapping of components to periods.
    uses_previous : bool
        Whether the sensor measures a change since its own last observation. One that is
        missing (NaN) is none: the next one has the change since the last that came.
    kind : str
        A name, for tables and messages.
    linear : callable, optional
        ``linear(d) -> H``, (m, d), if h is linear.
    derivative : callable, optional
        ``derivative(x)``, the Jacobian of h in the present state, (..., m, d), called
        like h. Without it central differences are used. With it the two are compared
        once, and a warning is given if they disagree.

    Examples
    --------
    >>> total = Sensor(1, lambda x: x.sum(axis=-1, keepdims=True), [[0.04]])
    >>> total.predict([1.0, 2.0])
    array([3.])

    A compass, which reads the third component, the heading:

    >>> compass = Sensor(1, lambda x: x[..., 2:3], [[0.01]], periods=(2 * np.pi,))
    >>> compass.residual([3.0], [-3.0]).round(4)
    array([-0.2832])
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
    periods: PeriodsArgument = field(default=(), kw_only=True)

    def __post_init__(self) -> None:
        super().__post_init__()
        # One entry for each component, or none at all. The dataclass is frozen, so that the field
        # cannot be assigned to.
        periods = read_periods(self.periods, self.dim)
        object.__setattr__(self, "periods", periods)
        self._check_signatures()
        if self.residual_function is None:
            return
        if periods:
            raise ValueError(
                "residual_function must be None for a sensor with periods, which wrap its "
                "differences"
            )
        # The residual of 1 + 1e-6 and 1 must be 1e-6; it is -1e-6 for predicted minus observed.
        # Halfway to that, -5e-7, rounding cannot decide.
        one = np.ones(self.dim)
        residual = call_user(self.residual_function, one + 1e-6, one)
        if (np.asarray(residual) < -5e-7).any():
            raise ValueError(
                "residual_function must return observed minus predicted, got the opposite sign"
            )

    def _check_signatures(self) -> None:
        """Refuse functions that cannot be called as the class calls them."""
        # The names of the arguments by position
        states = "x, previous" if self.uses_previous else "x"
        check_signature(self.h, "h", states)
        if self.derivative is not None:
            check_signature(self.derivative, "derivative", states)
        if self.linear is not None:
            check_signature(self.linear, "linear", "d")
        if self.residual_function is not None:
            name = "residual_function"
            check_signature(self.residual_function, name, "observed, predicted")

    @cached_property
    def noise_sqrt(self) -> Array:
        """A factor of R, (m, m)."""
        return factor(self.noise_cov)

    @cached_property
    def _noise_std(self) -> Array:
        """Standard deviation of each number's noise, (m,)."""
        return np.asarray(np.sqrt(self.noise_cov.diagonal()))

    @cached_property
    def wraps(self) -> bool:
        """Whether differences of observations wrap: by `periods` or a function of one's own."""
        return bool(self.periods) or self.residual_function is not None

    @cached_property
    def half_periods(self) -> NDArray[np.float64] | None:
        """Half of each component's period, infinity without one; None without `periods`."""
        if not self.periods:
            return None
        periods = cast(Periods, self.periods)
        return np.array([np.inf if p is None else 0.5 * p for p in periods])

    def bring_near(self, values: Array, reference: Array) -> Array:
        """Return values (..., m) on the branch of a reference, unchecked.

        Values that are NaN, or that have no reference, stay as they are.

        >>> compass = Sensor(1, lambda x: x, [[1.0]], periods=(2 * np.pi,))
        >>> compass.bring_near(np.array([3.0]), np.array([-3.0])).round(4)
        array([-3.2832])
        """
        if self.residual_function is None:
            return align(values, reference, cast(Periods, self.periods))
        # The residual r - v of a reference r and a value v wraps into half a period, so that
        # r - residual(r, v) is v on the branch of r.
        reference = np.broadcast_to(reference, values.shape)
        aligned = reference - self.residual(reference, values)
        return np.where(np.isnan(aligned), values, aligned)

    @validated
    def predict(
        self,
        x: Annotated[ArrayInput, "... d"],
        previous: Annotated[ArrayInput, "... d"] | None = None,
    ) -> Array:
        """Return the observation without noise of states (..., d), as (..., m).

        `previous` holds the states at the previous observation time; only a sensor that
        measures changes needs it.
        """
        return call_batched(self, "h", self._arguments(x, previous))

    def _arguments(self, x: Array, previous: Array | None) -> tuple[Array, ...]:
        """Return the states that h takes: the present ones, and the previous ones if needed."""
        if not self.uses_previous:
            return (x,)
        if previous is None:
            raise ValueError(
                f"previous must be the states at the previous observation time for a "
                f"sensor of kind {self.kind!r} (a filter keeps them with lag=), got None"
            )
        if x.shape != previous.shape:
            # Leading axes broadcast; other shapes are refused here.
            broadcast_leading(x.shape[:-1], previous.shape[:-1], "previous")
            x, previous = np.broadcast_arrays(x, previous)
        return x, previous

    @validated
    def observe(
        self,
        x: Annotated[ArrayInput, "... d"],
        *,
        rng: Rng,
        previous: Annotated[ArrayInput, "... d"] | None = None,
    ) -> Array:
        """Draw a noisy observation of each of the states (..., d), as (..., m)."""
        predicted = self.predict(x, previous)
        # With R = C Cᵀ, rows of standard normals times Cᵀ have the covariance R.
        noise = rng.standard_normal(predicted.shape) @ self.noise_sqrt.T
        return predicted + noise

    @validated
    def residual(
        self,
        observed: Annotated[ArrayInput, "... self.dim", ALLOW_NAN],
        predicted: Annotated[ArrayInput, "... self.dim", ALLOW_NAN],
    ) -> Array:
        """Return observed minus predicted, (..., m), wrapped where the sensor wraps.

        NaN, a component that is missing or that the sensor cannot see, stays NaN.

        >>> observed, predicted = np.array([3.0]), np.array([1.0])
        >>> sensor = Sensor(
        ...     1,
        ...     lambda x: x,
        ...     [[1.0]],
        ...     residual_function=lambda a, b: np.subtract(a, b, out=a),
        ... )
        >>> sensor.residual(observed, predicted), observed
        (array([2.]), array([3.]))
        """
        if self.residual_function is None:
            difference = np.asarray(observed - predicted)
            if not self.periods:
                return difference
            return wrap_differences(difference, cast(Periods, self.periods))
        shape = broadcast_leading(observed.shape, predicted.shape, "predicted")
        # Copies, since the user's function may work in place.
        result = call_user(self.residual_function, observed.copy(), predicted.copy())
        refuse_mask(result, "residual_function")
        residual = np.asarray(result)
        # A function written for one observation can lose the leading axes.
        if residual.shape != shape:
            raise ValueError(
                f"residual_function must return shape {shape}, got {residual.shape}"
            )
        return residual

    @validated
    def H(self, dim: PositiveInt) -> Array:
        """Return the matrix H, (m, `dim`), of a linear sensor."""
        if self.linear is None:
            raise ValueError(
                f"sensor must be linear to have a matrix H, got one of kind {self.kind!r}"
            )
        matrix = check_array(call_user(self.linear, dim), "linear", (self.dim, dim))
        # A user's matrix is compared once with h: for a linear h, h(e_i) is column i of H.
        if is_first_use(self, "linear"):
            predicted = self.predict(np.eye(dim))
            # Predictions that wrap may be on another branch. Five digits are enough to tell a wrong
            # matrix from the rounding of h.
            difference = self.residual(predicted, matrix.T)
            if not np.allclose(
                difference, 0.0, atol=1e-9 + 1e-5 * np.abs(matrix).max()
            ):
                raise ValueError(
                    "linear must return the matrix of h, got one that does not match it"
                )
        return matrix

    @validated
    def jacobian(
        self,
        x: Annotated[ArrayInput, "... d"],
        previous: Annotated[ArrayInput, "... d"] | None = None,
        *,
        std: Annotated[ArrayInput, "... d"] | None = None,
    ) -> Array:
        """Return the derivative of h in the present states (..., d), as (..., m, d).

        By `derivative` if the sensor has it, by central differences otherwise. NaN
        where the state cannot be seen. `std` holds the standard deviations of the
        states' components, (..., d), which filters hand over: where differences over
        short steps are spoilt by rounding, longer ones, up to about these, take their
        place. If none serves, a warning is given once.

        >>> offset = Sensor(1, lambda x: 2e7 + x, [[9.0]])
        >>> offset.jacobian([0.0], std=[1e6]).round(9)
        array([[1.]])
        """
        # The arguments of h: the present states, and the previous ones if it takes them
        states = self._arguments(x, previous)
        d = x.shape[-1]
        shape = (*states[0].shape[:-1], self.dim, d)
        # A linear sensor has the same matrix H at every state.
        if self.linear is not None:
            return np.broadcast_to(self.H(d), shape)
        if self.derivative is not None and not needs_differences(self):
            return call_derivative(self.derivative, states, shape)

        # The previous states stay fixed while the present one is varied along a new axis.
        fixed = [state[..., None, :] for state in states[1:]]
        predict = self.predict

        def vary(varied: Array) -> Array:
            return predict(varied, *fixed)

        differences = partial(
            difference_with_error, vary, states[0], self.residual, scale=std
        )
        # A given derivative comes here the first time only, to be compared with differences, whose
        # errors do no harm if they are small beside the noise.
        return evaluate_derivative(
            self,
            states,
            shape,
            differences,
            name="h",
            scale=std,
            tolerance=self._noise_std,
        )


def count_turns(sensor: Sensor, observed: Array) -> float:
    """Return by how many of its turns a sensor's values (N, m) are off, at most.

    Values are observations; turns are 2π, or the period if that is longer.

    >>> compass = Sensor(1, lambda x: x, [[1.0]], periods=(2 * np.pi,))
    >>> round(count_turns(compass, np.array([[90.0]])))
    14
    """
    # y - r(y, 0) is the multiple of the period that wrapping takes off.
    shift = np.abs(observed - sensor.residual(observed, 0 * observed))
    if sensor.periods:
        # A line turns twice while a direction turns once; a period of 360 is in degrees.
        periods = [p or np.inf for p in cast(Periods, sensor.periods)]
        turn = np.maximum(periods, 2 * np.pi)
        return float((shift / turn).max(initial=0.0))
    full = np.full((1, sensor.dim), 360.0)
    # A residual of the user's own that takes 360 for a turn is in degrees.
    if np.abs(sensor.residual(full, 0 * full)).min() < 1e-6:
        return 0.0
    return float(shift.max(initial=0.0) / (2 * np.pi))
