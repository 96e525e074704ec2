"""What a model is: a step without noise, and the covariance of the noise that the step adds."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike

from ..checks import (
    Array,
    array,
    callable_,
    count,
    covariance,
    generator,
    increasing,
    instance,
    number,
)
from ..differences import _central
from ..linalg import factor

__all__ = ["LinearModel", "Model", "simulate"]


@dataclass(frozen=True)
class Model:
    """A stochastic model of motion, x(t + dt) = f(x(t), t, dt) + w, w ~ N(0, Q(t, dt)).

    Parameters
    ----------
    dim : int
        Size d of the state.
    flow : callable
        ``flow(x, t, dt) -> x`` on arrays (..., d), without noise; times in s. It gets a copy of
        the states, which it may change.
    noise_cov : callable
        ``noise_cov(t, dt) -> Q``, (d, d), positive semidefinite.
    derivative : callable, optional
        ``derivative(x, t, dt)``, the Jacobian of `flow`, (..., d, d). Central differences stand in
        for it.
    names : tuple of str, optional
        Name of each component, for labels.
    units : tuple of str, optional
        Unit of each component.

    Examples
    --------
    >>> walk = Model(1, lambda x, t, dt: x, lambda t, dt: np.array([[dt]]))
    >>> walk.noise(0.0, 0.5)
    array([[0.5]])
    """

    dim: int
    flow: Callable[[Array, float, float], Array]
    noise_cov: Callable[[float, float], Array]
    derivative: Callable[[Array, float, float], Array] | None = field(default=None, kw_only=True)
    names: tuple[str, ...] = field(default=(), kw_only=True)
    units: tuple[str, ...] = field(default=(), kw_only=True)

    def __post_init__(self) -> None:
        count(self.dim, "dim")
        callable_(self.flow, "flow")
        callable_(self.noise_cov, "noise_cov")
        if self.derivative is not None:
            callable_(self.derivative, "derivative")
        for name, labels in (("names", self.names), ("units", self.units)):
            if not isinstance(labels, tuple) or not all(isinstance(v, str) for v in labels):
                raise ValueError(f"{name}: needs a tuple of words, got {labels!r}")
            if labels and len(labels) != self.dim:
                raise ValueError(f"{name}: needs {self.dim} entries, got {len(labels)}")

    def step(self, x: ArrayLike, t: float, dt: float) -> Array:
        """Move states (..., d) from `t` to `t` + `dt`, without noise."""
        state = array(x, "x", (..., self.dim))
        return self._step(state, number(t, "t"), number(dt, "dt", at_least=0))

    def _step(self, state: Array, t: float, dt: float) -> Array:
        """`step` of checked arguments. The copy is for flows that work in place."""
        moved = np.asarray(self.flow(state.copy(), t, dt))
        if moved.shape != state.shape:
            raise ValueError(
                f"flow: needs to return the shape of the states it gets, many at once, "
                f"{state.shape}, got {moved.shape}"
            )
        return moved

    def noise(self, t: float, dt: float) -> Array:
        """Covariance of the noise that a step from `t` to `t` + `dt` adds, (d, d)."""
        q = self.noise_cov(number(t, "t"), number(dt, "dt", at_least=0))
        q = covariance(q, "noise_cov", self.dim, semidefinite=True)
        return array(q, "noise_cov", (self.dim, self.dim)).copy()

    def sample_step(self, x: ArrayLike, t: float, dt: float, *, rng: np.random.Generator) -> Array:
        """Move states (..., d) from `t` to `t` + `dt` and add a draw of the noise to each."""
        state = array(x, "x", (..., self.dim))
        now, length = number(t, "t"), number(dt, "dt", at_least=0)
        return self._sample_step(state, now, length, generator(rng))

    def _sample_step(self, state: Array, t: float, dt: float, rng: np.random.Generator) -> Array:
        """`sample_step` of checked arguments."""
        moved = self._step(state, t, dt)
        noise = rng.standard_normal(moved.shape) @ self._root(t, dt).T
        noise += moved
        return noise

    def _root(self, t: float, dt: float) -> Array:
        """A factor of the noise's covariance, (d, d)."""
        q = array(self.noise_cov(t, dt), "noise_cov", (self.dim, self.dim))
        return _factor_of(q.tobytes(), self.dim)

    def jacobian(self, x: ArrayLike, t: float, dt: float) -> Array:
        """Derivative of a step from states (..., d), as (..., d, d).

        `derivative` where the model has it, central differences of `flow` otherwise.
        """
        state = array(x, "x", (..., self.dim))
        slope = self._jacobian(state, number(t, "t"), number(dt, "dt", at_least=0))
        return np.broadcast_to(slope, (*state.shape, self.dim)).copy()

    def _jacobian(self, state: Array, t: float, dt: float) -> Array:
        """`jacobian` of checked arguments; (d, d) where it is the same for all states."""
        if self.derivative is None:
            return _central(lambda x: self._step(x, t, dt), state, np.subtract)
        slope = np.asarray(self.derivative(state.copy(), t, dt))
        if slope.shape not in ((*state.shape, self.dim), (self.dim, self.dim)):
            raise ValueError(
                f"derivative: needs to return shape {(*state.shape, self.dim)}, got {slope.shape}"
            )
        return slope


@lru_cache(maxsize=64)
def _factor_of(data: bytes, dim: int) -> Array:
    """The factor of a covariance; the same few come in every step of a run."""
    root = factor(np.frombuffer(data).reshape(dim, dim), name="noise_cov")
    root.setflags(write=False)
    return root


@dataclass(frozen=True)
class LinearModel(Model):
    """A model whose step is a matrix: x(t + dt) = Φ(dt) x(t) + w.

    Parameters
    ----------
    transition_matrix : callable
        ``transition_matrix(dt) -> Φ``, (d, d). `flow` has to be the product with it; build the
        model with :meth:`from_transition`, which sees to that.

    Examples
    --------
    >>> still = LinearModel.from_transition(
    ...     2, lambda dt: np.eye(2), lambda t, dt: dt * np.eye(2))
    >>> still.step([1.0, 2.0], 0.0, 0.1)
    array([1., 2.])
    """

    transition_matrix: Callable[[float], Array] = field(kw_only=True)

    def __post_init__(self) -> None:
        super().__post_init__()
        callable_(self.transition_matrix, "transition_matrix")

    @classmethod
    def from_transition(
        cls, dim: int, transition_matrix: Callable[[float], Array],
        noise_cov: Callable[[float, float], Array], *, names: tuple[str, ...] = (),
        units: tuple[str, ...] = (),
    ) -> LinearModel:
        """Build the model from its transition matrix, ``transition_matrix(dt) -> (d, d)``."""
        callable_(transition_matrix, "transition_matrix")

        def flow(x: Array, t: float, dt: float) -> Array:
            phi = array(transition_matrix(dt), "transition_matrix", (dim, dim))
            return x @ phi.T

        return cls(
            dim, flow, noise_cov, names=names, units=units, transition_matrix=transition_matrix
        )

    def transition(self, dt: float) -> Array:
        """The matrix Φ of a step of `dt` seconds, (d, d)."""
        return self._transition(number(dt, "dt", at_least=0)).copy()

    def _transition(self, dt: float) -> Array:
        return array(self.transition_matrix(dt), "transition_matrix", (self.dim, self.dim))

    def _jacobian(self, state: Array, t: float, dt: float) -> Array:
        return self._transition(dt)


def simulate(
    model: Model, x0: ArrayLike, times: ArrayLike, *, rng: np.random.Generator, t0: float = 0.0
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
    instance(model, "model", Model)
    state = array(x0, "x0", (..., model.dim))
    grid = increasing(times, "times")
    now = number(t0, "t0")
    if grid.size and grid[0] <= now:
        raise ValueError(f"times: needs times after t0 = {now:g}, got {grid[0]:g}")
    generator(rng)
    path = np.empty((grid.size, *state.shape))
    for k, t in enumerate(grid):
        state = path[k] = model._sample_step(state, now, float(t) - now, rng)
        now = float(t)
    return path
