"""What a model is: a step without noise, and the covariance of the noise that the step adds."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from functools import lru_cache, partial
from typing import Annotated

import numpy as np

from ..linalg import as_derivative, central, factor
from ..validation import (
    Array,
    Bounds,
    FrozenModel,
    NonNegativeFloat,
    PositiveInt,
    Rng,
    Times,
    check_array,
    validated,
)
from ..validation.checks import call_batched, check_positive_semidefinite

__all__ = ["LinearModel", "Model", "simulate"]


Strength = Annotated[float, Bounds(at_least=0, at_most=1e150)]
"""Of white noise, per root second: its square is finite."""


@dataclass(frozen=True, eq=False)
class Model(FrozenModel):
    """A stochastic model of motion, x(t + dt) = f(x(t), t, dt) + w, w ~ N(0, Q(t, dt)).

    Parameters
    ----------
    dim : int
        Size d of the state.
    flow : callable
        ``flow(x, t, dt) -> x`` on arrays (..., d), without noise; times in s. It gets a copy of
        the states, which it may change. One that takes a single state only is refused when it
        first gets several.
    noise_cov : callable
        ``noise_cov(t, dt) -> Q``, (d, d), positive semidefinite.
    derivative : callable, optional
        ``derivative(x, t, dt)``, the Jacobian of `flow`, (..., d, d). Central differences stand in
        for it; a first time they are compared, and a warning tells of another function's.
    names : tuple of str, optional
        Name of each component, for labels.
    units : tuple of str, optional
        Unit of each component.

    Examples
    --------
    >>> walk = Model(1, lambda x, t, dt: x, lambda t, dt: np.array([[dt]]))
    >>> walk.Q(0.0, 0.5)
    array([[0.5]])
    """

    dim: PositiveInt
    transition: Callable[[Array, float, float], Array]
    noise_cov: Callable[[float, float], Array]
    derivative: Callable[[Array, float, float], Array] | None = field(
        default=None, kw_only=True
    )
    names: tuple[str, ...] = field(default=(), kw_only=True)
    units: tuple[str, ...] = field(default=(), kw_only=True)

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, labels in (("names", self.names), ("units", self.units)):
            if labels and len(labels) != self.dim:
                raise ValueError(
                    f"{name} must have {self.dim} entries, got {len(labels)}"
                )

    @validated
    def step(
        self, x: Annotated[Array, "... self.dim"], t: float, dt: NonNegativeFloat
    ) -> Array:
        """Move states (..., d) from `t` to `t` + `dt`, without noise."""
        return call_batched(self, "transition", (x,), t, dt)

    @validated
    def Q(self, t: float, dt: NonNegativeFloat) -> Array:
        """Covariance of the noise that a step from `t` to `t` + `dt` adds, (d, d), read-only."""
        return self._noise(t, dt)[0]

    @validated
    def noise_sqrt(self, t: float, dt: NonNegativeFloat) -> Array:
        """A factor of the noise's covariance, (d, d), read-only."""
        return self._noise(t, dt)[1]

    def _noise(self, t: float, dt: float) -> tuple[Array, Array]:
        q = check_array(
            self.noise_cov(t, dt), "noise_cov", (self.dim, self.dim), finite=False
        )
        return _with_factor(q.tobytes(), self.dim)

    @validated
    def sample_step(
        self,
        x: Annotated[Array, "... self.dim"],
        t: float,
        dt: NonNegativeFloat,
        *,
        rng: Rng,
    ) -> Array:
        """Move states (..., d) from `t` to `t` + `dt` and add a draw of the noise to each."""
        moved = self.step(x, t, dt)
        noise = rng.standard_normal(moved.shape) @ np.ascontiguousarray(
            self._noise(t, dt)[1].T
        )
        noise += moved
        return noise

    @validated
    def jacobian(
        self, x: Annotated[Array, "... self.dim"], t: float, dt: NonNegativeFloat
    ) -> Array:
        """Derivative of a step from states (..., d), as (..., d, d).

        `derivative` where the model has it, central differences of `flow` otherwise.
        """
        near = partial(central, lambda state: self.step(state, t, dt), x)
        return as_derivative(
            self, (x, t, dt), (*x.shape, self.dim), near, np.eye(self.dim)
        )


@lru_cache(maxsize=64)
def _with_factor(data: bytes, dim: int) -> tuple[Array, Array]:
    """A covariance and its factor; the same few come in every step of a run."""
    cov = check_array(np.frombuffer(data).reshape(dim, dim), "noise_cov")
    check_positive_semidefinite(cov, "noise_cov")
    root = factor(cov)
    root.setflags(write=False)
    return cov, root


@dataclass(frozen=True, eq=False)
class LinearModel(Model):
    """A model whose step is a matrix: x(t + dt) = Φ(dt) x(t) + w.

    Parameters
    ----------
    transition_matrix : callable
        ``transition_matrix(dt) -> Φ``, (d, d). `flow` has to be the product with it; build the
        model with :meth:`from_transition`, which sees to that. A warning tells if it is the
        transpose that fits `noise_cov`.

    Examples
    --------
    >>> still = LinearModel.from_transition(
    ...     2, lambda dt: np.eye(2), lambda t, dt: dt * np.eye(2)
    ... )
    >>> still.step([1.0, 2.0], 0.0, 0.1)
    array([1., 2.])
    """

    transition_matrix: Callable[[float], Array] = field(kw_only=True)

    @classmethod
    def from_transition(
        cls,
        dim: int,
        transition_matrix: Callable[[float], Array],
        noise_cov: Callable[[float, float], Array],
        *,
        names: tuple[str, ...] = (),
        units: tuple[str, ...] = (),
    ) -> LinearModel:
        """Build the model from its transition matrix, ``transition_matrix(dt) -> (d, d)``."""
        flow = partial(_product, transition_matrix, dim)
        return cls(
            dim,
            flow,
            noise_cov,
            names=names,
            units=units,
            transition_matrix=transition_matrix,
        )

    def _noise(self, t: float, dt: float) -> tuple[Array, Array]:
        whole = super()._noise(t, dt)
        half = dt / 2
        if dt and vars(self).pop("_doubted", False):
            # Two half steps add the noise of a whole one. A user's table may have no halves.
            with suppress(
                AssertionError, LookupError, RuntimeError, TypeError, ValueError
            ):
                phi = self.F(half)
                first = self.noise_cov(t, half)
                last = self.noise_cov(t + half, half) - whole[0]
                own, other = (
                    np.abs(p @ first @ p.T + last).max() for p in (phi, phi.T)
                )
                if other < 1e-11 * np.abs(whole[0]).max() < 1e-2 * own:
                    warnings.warn(
                        "transition_matrix: transposed for noise_cov", RuntimeWarning, 4
                    )
        return whole

    @validated
    def F(self, dt: NonNegativeFloat) -> Array:
        """The matrix Φ of a step of `dt` seconds, (d, d)."""
        return check_array(
            self.transition_matrix(dt), "transition_matrix", (self.dim, self.dim)
        )

    @validated
    def jacobian(
        self, x: Annotated[Array, "... self.dim"], t: float, dt: NonNegativeFloat
    ) -> Array:
        """Derivative of a step, the same matrix for all states, as (..., d, d)."""
        return np.full((*x.shape, self.dim), self.F(dt))


def _product(
    transition_matrix: Callable[[float], Array], dim: int, x: Array, t: float, dt: float
) -> Array:
    """The flow of a linear model; with a copy of the transpose in half the time of its view."""
    matrix = check_array(transition_matrix(dt), "transition_matrix", (dim, dim))
    return np.asarray(x @ np.ascontiguousarray(matrix.T))


@validated
def simulate(
    model: Model,
    x0: Annotated[Array, "... model.dim"],
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
    return path(partial(model.sample_step, rng=rng), x0, times, t0)


def path(
    move: Callable[[Array, float, float], Array], x: Array, times: Array, t0: float
) -> Array:
    """Where ``move(x, t, dt)`` takes states from `t0`, at the times."""
    if times.size and times[0] <= t0:
        raise ValueError(f"times must be times after t0 = {t0:g}, got {times[0]:g}")
    states = np.empty((times.size, *x.shape))
    for k, t in enumerate(times.tolist()):
        x = states[k] = move(x, t0, t - t0)
        t0 = t
    return states
