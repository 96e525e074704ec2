"""What a model is: a step without noise, and the covariance of the noise that the step adds."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ..checks import Array, array, callable_, count, covariance, generator, increasing, number
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
        ``flow(x, t, dt) -> x`` on arrays (..., d), without noise; times in s.
    noise_covariance : callable
        ``noise_covariance(t, dt) -> Q``, (d, d), positive semidefinite.
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
    noise_covariance: Callable[[float, float], Array]
    names: tuple[str, ...] = ()
    units: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        count(self.dim, "dim")
        callable_(self.flow, "flow")
        callable_(self.noise_covariance, "noise_covariance")
        for name, labels in (("names", self.names), ("units", self.units)):
            if labels and len(labels) != self.dim:
                raise ValueError(f"{name}: needs {self.dim} entries, got {len(labels)}")

    def step(self, x: ArrayLike, t: float, dt: float) -> Array:
        """Move states (..., d) from `t` to `t` + `dt`, without noise."""
        state = array(x, "x", (..., self.dim))
        moved = np.asarray(self.flow(state, number(t, "t"), number(dt, "dt", at_least=0)))
        if moved.shape != state.shape:
            raise ValueError(f"flow: needs to return shape {state.shape}, got {moved.shape}")
        return moved

    def noise(self, t: float, dt: float) -> Array:
        """Covariance of the noise that a step from `t` to `t` + `dt` adds, (d, d)."""
        q = self.noise_covariance(number(t, "t"), number(dt, "dt", at_least=0))
        return covariance(q, "noise_covariance", self.dim, semidefinite=True)

    def sample_step(
        self, x: ArrayLike, t: float, dt: float, *, rng: np.random.Generator
    ) -> Array:
        """Move states (..., d) from `t` to `t` + `dt` and add a draw of the noise to each."""
        moved = self.step(x, t, dt)
        root = factor(self.noise(t, dt), name="noise_covariance")
        return moved + generator(rng).standard_normal(moved.shape) @ root.T


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

    transition_matrix: Callable[[float], Array] | None = None

    @classmethod
    def from_transition(
        cls,
        dim: int,
        transition_matrix: Callable[[float], Array],
        noise_covariance: Callable[[float, float], Array],
        *,
        names: tuple[str, ...] = (),
        units: tuple[str, ...] = (),
    ) -> LinearModel:
        """Build the model from its transition matrix, ``transition_matrix(dt) -> (d, d)``."""
        callable_(transition_matrix, "transition_matrix")

        def flow(x: Array, t: float, dt: float) -> Array:
            return x @ transition_matrix(dt).T

        return cls(dim, flow, noise_covariance, names, units, transition_matrix)

    def transition(self, dt: float) -> Array:
        """The matrix Φ of a step of `dt` seconds, (d, d)."""
        if self.transition_matrix is None:
            raise ValueError("transition_matrix: needs a function of dt, got None")
        phi = self.transition_matrix(number(dt, "dt", at_least=0))
        return array(phi, "transition_matrix", (self.dim, self.dim))


def simulate(
    model: Model,
    x0: ArrayLike,
    times: ArrayLike,
    *,
    rng: np.random.Generator,
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

    Raises
    ------
    ValueError
        If `x0` does not fit the model, or `times` do not increase from `t0`.

    Examples
    --------
    >>> walk = Model(1, lambda x, t, dt: x, lambda t, dt: np.array([[dt]]))
    >>> simulate(walk, [0.0], [1.0, 2.0], rng=np.random.default_rng(1)).shape
    (2, 1)
    """
    state = array(x0, "x0", (..., model.dim))
    grid = increasing(times, "times")
    now = number(t0, "t0")
    if grid.size and grid[0] <= now:
        raise ValueError(f"times: needs times after t0 = {now:g}, got {grid[0]:g}")
    generator(rng)
    path = np.empty((grid.size, *state.shape))
    for k, t in enumerate(grid):
        state = path[k] = model.sample_step(state, now, float(t) - now, rng=rng)
        now = float(t)
    return path
