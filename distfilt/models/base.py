"""Models of motion: a transition without noise, and the covariance of its process noise."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property, lru_cache, partial
from inspect import Parameter, signature
from typing import Annotated, ClassVar, cast

import numpy as np

from ..derivatives import (
    call_derivative,
    difference_with_error,
    evaluate_derivative,
    needs_differences,
)
from ..linalg import factor
from ..periods import Periods, PeriodsArgument, read_periods, wrap_differences
from ..validation import (
    Array,
    ArrayInput,
    Bounds,
    FrozenModel,
    NonNegativeFloat,
    PositiveInt,
    Rng,
    Times,
    call_batched,
    call_user,
    check_array,
    check_positive_semidefinite,
    check_signature,
    format_number,
    is_first_use,
    validated,
)
from ..validation.checks import all_finite, is_nonnegative_diagonal
from ..validation.clocks import warn_of_clock
from ..validation.decorators import is_of_library

__all__ = ["LinearModel", "Model", "simulate"]


_SMALL = 8
"""Covariances up to this size are looked up among those that have been checked."""

NoiseStrength = Annotated[float, Bounds(at_least=0, at_most=1e150)]
"""Strength of white noise, per root second; bounded, so that its square is finite."""


@dataclass(frozen=True, eq=False)
class Model(FrozenModel):
    """A stochastic model of motion, x(t + dt) = f(x(t), t, dt) + w, w ~ N(0, Q(t, dt)).

    Parameters
    ----------
    dim : int
        Size d of the state.
    transition : callable
        ``transition(x, t, dt) -> x`` on arrays (..., d), without noise; times in s. It gets a
        copy of the states, which it may change. A function that takes a single state only is
        refused when it first gets several.
    noise_cov : callable
        ``noise_cov(t, dt) -> Q``, (d, d), positive semidefinite.
    derivative : callable, optional
        ``derivative(x, t, dt)``, the Jacobian of `transition`, (..., d, d). Central differences
        by default. At its first use it is compared with them, and a warning is given if it does
        not belong to `transition`.
    names : tuple of str, optional
        Name of each component, for labels.
    units : tuple of str, optional
        Unit of each component.
    periods : sequence of (float or None), or mapping, optional
        The period of each circular component, such as 2π for a heading in rad, and None for the
        others; or a mapping of components, by index or name, to periods. Filters then treat
        states that differ by a period as the same: the book's page *Angles, headings,
        attitudes* says how. Whether `transition` wraps or runs on makes no difference.

    Examples
    --------
    >>> walk = Model(1, lambda x, t, dt: x, lambda t, dt: np.array([[dt]]))
    >>> walk.Q(0.0, 0.5)
    array([[0.5]])
    >>> turn = Model(
    ...     2,
    ...     lambda x, t, dt: x + [0.1 * dt, 0.0],
    ...     lambda t, dt: dt * np.eye(2),
    ...     names=("heading", "speed"),
    ...     periods={"heading": 2 * np.pi},
    ... )
    >>> turn.periods == (2 * np.pi, None)
    True
    """

    dim: PositiveInt
    transition: Callable[[Array, float, float], Array]
    noise_cov: Callable[[float, float], Array]
    derivative: Callable[[Array, float, float], Array] | None = field(
        default=None, kw_only=True
    )
    names: tuple[str, ...] = field(default=(), kw_only=True)
    units: tuple[str, ...] = field(default=(), kw_only=True)
    periods: PeriodsArgument = field(default=(), kw_only=True)

    has_state_noise: ClassVar[bool] = False

    def __post_init__(self) -> None:
        super().__post_init__()
        # One entry for each component, or none at all. The dataclass is frozen, so that the field
        # cannot be assigned to.
        periods = read_periods(self.periods, self.dim, self.names)
        object.__setattr__(self, "periods", periods)
        # The functions must take these arguments.
        check_signature(self.transition, "transition", "x, t, dt")
        check_signature(self.noise_cov, "noise_cov", "t, dt")
        if self.derivative is not None:
            check_signature(self.derivative, "derivative", "x, t, dt")
        # Labels are optional, but complete if given.
        for name, labels in (("names", self.names), ("units", self.units)):
            if labels and len(labels) != self.dim:
                raise ValueError(
                    f"{name} must have {self.dim} entries, got {len(labels)}"
                )
        if len(set(self.names)) < len(self.names):
            raise ValueError(f"names must be different, got {list(self.names)}")

    @validated
    def step(
        self, x: Annotated[ArrayInput, "... self.dim"], t: float, dt: NonNegativeFloat
    ) -> Array:
        """Move states (..., d) from `t` to `t` + `dt`, without noise."""
        return call_batched(self, "transition", (x,), t, dt)

    def _subtract(self, ahead: Array, behind: Array) -> Array:
        """Return differences of states, of circular components the shorter way round."""
        return wrap_differences(ahead - behind, cast(Periods, self.periods))

    @validated
    def Q(self, t: float, dt: NonNegativeFloat) -> Array:
        """Covariance of the noise that a step from `t` to `t` + `dt` adds, (d, d), read-only."""
        return self._noise_cov(t, dt)

    @validated
    def noise_at(
        self, x: Annotated[ArrayInput, "... self.dim"], t: float, dt: NonNegativeFloat
    ) -> Array:
        """Covariance of the noise that a step from states (..., d) adds: (d, d), or (..., d, d).

        It is Q unless the model has `has_state_noise`.
        """
        return self.Q(t, dt)

    @validated
    def noise_sqrt(self, t: float, dt: NonNegativeFloat) -> Array:
        """Factor L of the noise covariance Q = L Lᵀ, (d, d), read-only."""
        # The bytes of the covariance are the key by which its factor is cached.
        return _factor_noise(self._noise_cov(t, dt).tobytes(), self.dim)

    def _noise_cov(self, t: float, dt: float) -> Array:
        """Return the noise covariance, checked and read-only.

        The step leads from t to t + dt; the covariance is (d, d).
        """
        q = call_user(self.noise_cov, t, dt)
        # Whether it is finite and a covariance is checked once for each value.
        q = check_array(q, "noise_cov", (self.dim, self.dim), finite=False)
        # What the library computes is a covariance if it is finite; a large diagonal one takes
        # less time to check than to look up.
        is_trusted = is_of_library(self.noise_cov)
        is_plain = is_trusted or (self.dim > _SMALL and is_nonnegative_diagonal(q))
        if is_plain and all_finite(q):
            # A copy, since the array may be the user's; read-only, since callers may keep it.
            q = q.copy()
            q.setflags(write=False)
            return q
        # The bytes are the key under which a covariance that has been checked is cached.
        return _check_noise(q.tobytes(), self.dim)

    @validated
    def sample_step(
        self,
        x: Annotated[ArrayInput, "... self.dim"],
        t: float,
        dt: NonNegativeFloat,
        *,
        rng: Rng,
    ) -> Array:
        """Move states (..., d) from `t` to `t` + `dt` and add a draw of the noise to each."""
        forecast = self.step(x, t, dt)
        lower = self.noise_sqrt(t, dt)
        standard = rng.standard_normal(forecast.shape)
        # w = L z; rows are states, so z multiplies Lᵀ. A contiguous copy of it is faster.
        sample = standard @ np.ascontiguousarray(lower.T)
        sample += forecast
        return sample

    @validated
    def jacobian(
        self,
        x: Annotated[ArrayInput, "... self.dim"],
        t: float,
        dt: NonNegativeFloat,
        *,
        std: Annotated[ArrayInput, "... self.dim"] | None = None,
    ) -> Array:
        """Derivative of a step from states (..., d), as (..., d, d).

        `derivative` where the model has it, central differences of `transition` otherwise.
        `std` holds the standard deviations of the states' components, (..., d), which filters
        hand over: where differences over short steps are spoilt by rounding, longer ones, up
        to about these, take their place.

        >>> still = Model(1, lambda x, t, dt: x, lambda t, dt: np.zeros((1, 1)))
        >>> still.jacobian([1e9], 0.0, 1.0, std=[10.0]).round(6)
        array([[1.]])
        """
        shape = (*x.shape, self.dim)
        if self.derivative is not None and not needs_differences(self):
            return call_derivative(self.derivative, (x, t, dt), shape)

        def move(states: Array) -> Array:
            return self.step(states, t, dt)

        # Differences of angles are the shorter way round.
        difference = self._subtract if self.periods else np.subtract
        differences = partial(difference_with_error, move, x, difference, scale=std)
        # A given derivative comes here the first time only, to be compared with differences. A step
        # that moves nothing has the derivative I, and compared is what a step adds to it. Errors of
        # the differences do no harm if they are small beside the deviations of the states, which
        # are taken for those after the step (`tolerance`) too.
        return evaluate_derivative(
            self,
            (x, t, dt),
            shape,
            differences,
            np.eye(self.dim),
            name="transition",
            scale=std,
            tolerance=std,
        )


@lru_cache(maxsize=64)
def _check_noise(data: bytes, dim: int) -> Array:
    """Return the covariance (dim, dim) that some bytes hold, or refuse it if it is none.

    The bytes, which are its entries, are the key of the cache: few covariances recur in every step
    of a run. The array is read-only, as all callers share it.
    """
    cov = np.frombuffer(data).reshape(dim, dim)
    check_array(cov, "noise_cov")
    check_positive_semidefinite(cov, "noise_cov")
    return cov


@lru_cache(maxsize=64)
def _factor_noise(data: bytes, dim: int) -> Array:
    """Return the factor L of a covariance L Lᵀ that some bytes hold, read-only.

    It is cached as in `_check_noise`, and apart from it, since only draws need the factor.
    """
    lower = factor(np.frombuffer(data).reshape(dim, dim))
    # All callers share the cached array.
    lower.setflags(write=False)
    return lower


@dataclass(frozen=True, eq=False)
class LinearModel(Model):
    """A model whose transition is a matrix: x(t + dt) = Φ(t, dt) x(t) + w.

    Parameters
    ----------
    transition_matrix : callable
        ``transition_matrix(dt) -> Φ``, (d, d); or ``transition_matrix(t, dt)``, with two arguments,
        for a matrix that changes with time, from `t` to `t` + `dt`. `transition` has to be the
        product with it, which :meth:`from_transition` guarantees. A warning is given if only its
        transpose fits `noise_cov`.
    time_invariant : bool
        Whether both matrices depend on dt alone. Then they are made once for each dt.

    Examples
    --------
    >>> still = LinearModel.from_transition(
    ...     2, lambda dt: np.eye(2), lambda t, dt: dt * np.eye(2)
    ... )
    >>> still.step([1.0, 2.0], 0.0, 0.1)
    array([1., 2.])

    A decay that sets in at t = 10, whose matrix changes with time:

    >>> def decay(t, dt):
    ...     return np.array([[np.exp(-max(0.0, t + dt - max(t, 10.0)))]])
    >>> late = LinearModel.from_transition(1, decay, lambda t, dt: np.zeros((1, 1)))
    >>> [late.step([1.0], t, 1.0).round(3) for t in (0.0, 9.5, 10.0)]
    [array([1.]), array([0.607]), array([0.368])]
    """

    transition_matrix: Callable[..., Array] = field(kw_only=True)
    time_invariant: bool = field(default=False, kw_only=True)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.time_invariant and self.varies_with_time:
            raise ValueError(
                "time_invariant must be False for a transition_matrix(t, dt), got True"
            )

    @classmethod
    def from_transition(
        cls,
        dim: int,
        transition_matrix: Callable[..., Array],
        noise_cov: Callable[[float, float], Array],
        *,
        names: tuple[str, ...] = (),
        units: tuple[str, ...] = (),
        periods: PeriodsArgument = (),
        time_invariant: bool = False,
    ) -> LinearModel:
        """Build the model from its matrix, ``transition_matrix(dt)`` or ``(t, dt)``, to (d, d).

        The covariance of a step's noise is ``noise_cov(t, dt)``, (d, d).
        """
        # The transition (x, t, dt) -> Φ x, with the matrix Φ of dt, or of t and dt
        takes_time = _takes_time(transition_matrix)
        transition = partial(_multiply, transition_matrix, dim, takes_time)
        return cls(
            dim,
            transition,
            noise_cov,
            names=names,
            units=units,
            periods=periods,
            transition_matrix=transition_matrix,
            time_invariant=time_invariant,
        )

    @validated
    def step(
        self, x: Annotated[ArrayInput, "... self.dim"], t: float, dt: NonNegativeFloat
    ) -> Array:
        """Move states (..., d) from `t` to `t` + `dt`, without noise."""
        if self.time_invariant:
            # Rows are states: x Φᵀ.
            return np.asarray(x @ _transpose_transition(self, dt))
        return call_batched(self, "transition", (x,), t, dt)

    def _noise_cov(self, t: float, dt: float) -> Array:
        """Return the noise covariance, read-only; made once for each dt if time does not matter."""
        if self.time_invariant:
            return _noise_of_step(self, dt)
        return self._compute_noise_cov(t, dt)

    def _compute_noise_cov(self, t: float, dt: float) -> Array:
        """Return the covariance Q of the noise of a step, (d, d).

        Once, it is compared with the transition matrix Φ, to see whether that is transposed.
        """
        cov = super()._noise_cov(t, dt)
        # A step of no length has Φ = I, which shows nothing.
        if dt and is_first_use(self, "transition_matrix"):
            # The check calls the user's functions for half steps, at which they may fail, as a
            # table without such an entry does: then nothing is checked.
            with suppress(
                AssertionError, LookupError, RuntimeError, TypeError, ValueError
            ):
                if self._is_transposed(t, dt, cov):
                    warnings.warn(
                        "transition_matrix must lead from x(t) to x(t + dt), but only its "
                        "transpose fits noise_cov: return the transposed matrix",
                        RuntimeWarning,
                        stacklevel=4,
                    )
        return cov

    def _is_transposed(self, t: float, dt: float, cov: Array) -> bool:
        """Whether Φᵀ in place of Φ makes two half steps add the noise of a whole step.

        `cov` is the noise covariance Q of the step from t to t + dt.
        """
        # The noise of a whole step is that of the first half, propagated by Φ of the second half,
        # plus that of the second half.
        half = dt / 2
        phi = self.F(half, t + half)
        first = call_user(self.noise_cov, t, half)
        second = call_user(self.noise_cov, t + half, half)
        # Q(t, dt) = Φ Q(t, dt/2) Φᵀ + Q(t + dt/2, dt/2), with Φ from t + dt/2 to t + dt
        remainder = second - cov
        error = np.abs(phi @ first @ phi.T + remainder).max()
        transposed_error = np.abs(phi.T @ first @ phi + remainder).max()
        # A clear case only: Φᵀ fits to rounding, and Φ misses by far.
        rounding = 1e-11 * np.abs(cov).max()
        return bool(transposed_error < rounding < 1e-2 * error)

    @cached_property
    def varies_with_time(self) -> bool:
        """Whether the matrix depends on the time at which a step begins, ``(t, dt)``."""
        return _takes_time(self.transition_matrix)

    @validated
    def F(self, dt: NonNegativeFloat, t: float | None = None) -> Array:
        """The matrix Φ of a step of `dt` seconds from time `t`, (d, d).

        `t` is needed if the matrix changes with time.
        """
        if self.varies_with_time and t is None:
            raise ValueError(
                "t must be the time at which the step begins for a matrix that changes with time, "
                "got None"
            )
        args = (t, dt) if self.varies_with_time else (dt,)
        return _make_matrix(self.transition_matrix, self.dim, *args)

    @validated
    def jacobian(
        self,
        x: Annotated[ArrayInput, "... self.dim"],
        t: float,
        dt: NonNegativeFloat,
        *,
        std: Annotated[ArrayInput, "... self.dim"] | None = None,
    ) -> Array:
        """Derivative of a step, the same matrix Φ for all states, as (..., d, d).

        `std`, by which other models choose the length of their differences, changes nothing here.
        """
        if self.time_invariant:
            # Φ depends on dt alone: its transpose is kept, with which a step multiplies, x Φᵀ.
            phi = _transpose_transition(self, dt).T
        else:
            phi = self.F(dt, t)
        return np.full((*x.shape, self.dim), phi)


def _takes_time(function: Callable[..., Array]) -> bool:
    """Whether a transition matrix is a function of (t, dt), and not of dt alone."""
    try:
        parameters = signature(function).parameters.values()
    except (TypeError, ValueError):
        # Functions of C have no signature.
        return False
    positional = (Parameter.POSITIONAL_ONLY, Parameter.POSITIONAL_OR_KEYWORD)
    needed = [p for p in parameters if p.kind in positional and p.default is p.empty]
    return len(needed) == 2


def _make_matrix(
    transition_matrix: Callable[..., Array], dim: int, *args: float | None
) -> Array:
    """Call a user's ``transition_matrix(*args)`` and check its result, (dim, dim).

    The arguments are dt, or t and dt.
    """
    phi = call_user(transition_matrix, *args)
    return check_array(phi, "transition_matrix", (dim, dim))


def _multiply(
    transition_matrix: Callable[..., Array],
    dim: int,
    varies_with_time: bool,
    x: Array,
    t: float,
    dt: float,
) -> Array:
    """Move states (..., d) by a transition matrix: the transition of a linear model."""
    args = (t, dt) if varies_with_time else (dt,)
    phi = _make_matrix(transition_matrix, dim, *args)
    # Rows are states: x Φᵀ. With a copy of the transpose it takes half the time of a view's.
    return np.asarray(x @ np.ascontiguousarray(phi.T))


@lru_cache(maxsize=64)
def _transpose_transition(model: LinearModel, dt: float) -> Array:
    """Return a contiguous Φᵀ of a time-invariant model, made once for each dt."""
    return np.ascontiguousarray(model.F(dt).T)


@lru_cache(maxsize=64)
def _noise_of_step(model: LinearModel, dt: float) -> Array:
    """Return Q of a time-invariant model, made once for each dt."""
    return model._compute_noise_cov(t=0.0, dt=dt)


@validated
def simulate(
    model: Model,
    x0: Annotated[ArrayInput, "... model.dim"],
    times: Times,
    *,
    rng: Rng,
    t0: float = 0.0,
) -> Array:
    """Draw trajectories of a model at the given times.

    Parameters
    ----------
    model : Model
        The model; its noise is drawn afresh in every step and for every trajectory.
    x0 : array_like, (..., d)
        States at `t0`; leading axes are independent runs.
    times : array_like, (T,)
        Strictly increasing times after `t0`, in s.
    rng : numpy.random.Generator
        Source of the noise.
    t0 : float
        The time of `x0`, in s.

    Returns
    -------
    ndarray, (T, ..., d)
        The states at `times`; `x0` is not repeated.

    Examples
    --------
    >>> walk = Model(1, lambda x, t, dt: x, lambda t, dt: np.array([[dt]]))
    >>> simulate(walk, [0.0], [1.0, 2.0], rng=np.random.default_rng(1)).shape
    (2, 1)
    """
    # Each step draws noise from the same generator.
    return trajectory(partial(model.sample_step, rng=rng), x0, times, t0)


def trajectory(
    step: Callable[[Array, float, float], Array], x: Array, times: Array, t0: float
) -> Array:
    """States at the times, from `x` at `t0` by ``step(x, t, dt)``."""
    if times.size and times[0] <= t0:
        raise ValueError(
            f"times must be after t0 = {format_number(t0)}, got {format_number(times[0])}"
        )
    warn_of_clock(t0, times, "times")
    states = np.empty((times.size, *x.shape))
    for k, t in enumerate(times.tolist()):
        x = step(x, t0, t - t0)
        states[k] = x
        t0 = t
    return states
