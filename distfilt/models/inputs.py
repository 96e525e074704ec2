"""Models that are driven by measured inputs, such as odometry, whose noise enters with them."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import Annotated, ClassVar

import numpy as np

from ..derivatives import central_difference
from ..linalg import factor, symmetrise
from ..periods import PeriodsArgument
from ..validation import (
    Array,
    ArrayInput,
    FrozenModel,
    NonNegativeFloat,
    PositiveInt,
    PositiveSemidefinite,
    Rng,
    Times,
    call_user,
    check_array,
    format_number,
    validated,
)
from ..validation.first_use import is_first_use
from .base import Model

__all__ = ["InputModel", "Inputs", "Piece", "add_up_noise", "move_by_inputs"]

Piece = tuple[float, float, Array]
"""A part of a step in which one input holds: when it begins, its length, and the input."""


@dataclass(frozen=True, eq=False)
class Inputs(FrozenModel):
    """Inputs u, each of which holds from its time until the next one.

    Parameters
    ----------
    times : array_like, (T,)
        When each begins to hold, in s, increasing; the last one holds on. A warning is given once
        if it has to hold more than ten times as long as any other.
    values : array_like, (T, k)
    cov : array_like, (k, k)
        Covariance of the error of each, which holds as long as the input does; errors of different
        inputs are independent.

    Examples
    --------
    >>> wheels = Inputs([0.0, 1.0], [[0.5, 0.0], [0.5, 0.2]], np.diag([0.01, 0.001]))
    >>> [(t, dt, u.tolist()) for t, dt, u in wheels.pieces(0.5, 1.0)]
    [(0.5, 0.5, [0.5, 0.0]), (1.0, 0.5, [0.5, 0.2])]
    """

    times: Times
    values: Annotated[ArrayInput, "T k"]
    cov: Annotated[PositiveSemidefinite, "k k"]

    def __post_init__(self) -> None:
        super().__post_init__()
        if not len(self.times):
            raise ValueError("times must have at least one entry, got none")

    @cached_property
    def _longest_use(self) -> float:
        """Until when the last input may hold; one alone holds for ever."""
        longest = np.diff(self.times).max(initial=0.0)
        return float(self.times[-1] + 10 * longest) if longest else np.inf

    def pieces(self, t: float, dt: float) -> list[Piece]:
        """Return the parts of a step in which one input holds: (begin, length, input)."""
        if t < self.times[0]:
            raise ValueError(
                f"times must begin at the model's first step at {format_number(t)} or before, "
                f"got {format_number(self.times[0])}"
            )
        end = t + dt
        if end > self._longest_use and is_first_use(self, "end"):
            warnings.warn(
                f"times must reach a step's end at {format_number(end)}, got "
                f"{format_number(self.times[-1])} last: the last input is held since then",
                RuntimeWarning,
                stacklevel=4,
            )
        # A sum of steps may miss the time of an input by rounding. An input that begins within this
        # time of an end of the step begins at that end, so that no piece is that short.
        tolerance = 1e-9 * max(1.0, abs(t))
        first = int(np.searchsorted(self.times, t + tolerance, side="right")) - 1
        last = int(np.searchsorted(self.times, end - tolerance, side="left"))
        # The inputs `first` to `last` - 1 hold within the step; each but the first begins in it.
        edges = [t, *self.times[first + 1 : last].tolist(), end]
        return [
            (begin, stop - begin, self.values[first + k])
            for k, (begin, stop) in enumerate(zip(edges[:-1], edges[1:], strict=True))
        ]


@dataclass(frozen=True, eq=False)
class InputModel(Model):
    r"""A model that is driven by inputs with noise, x(t + dt) = f(x, u + ε, dt) + w.

    The noise ε has the covariance :math:`\boldsymbol\Sigma` of the inputs. It enters where the
    inputs do, in the body's own axes. With
    :math:`\mathbf G(\mathbf x)=\partial\mathbf f/\partial\mathbf u` its covariance in the state is
    :math:`\mathbf G\boldsymbol\Sigma\mathbf G^\top`, which depends on the state. Members of an
    ensemble move with draws of the inputs; Gaussian filters use G at their mean. Made by
    :meth:`from_inputs`.

    Parameters
    ----------
    inputs : Inputs
    driven_transition : callable
        ``driven_transition(x, u, dt) -> x`` on states (..., d) and inputs (..., k).

    Examples
    --------
    Odometry: a speed and a rate of turn. The robot's error across its heading grows with the
    error of the turn, whatever the heading is.

    >>> def drive(x, u, dt):
    ...     heading = x[..., 2] + dt * u[..., 1] / 2
    ...     east = x[..., 0] + dt * u[..., 0] * np.cos(heading)
    ...     north = x[..., 1] + dt * u[..., 0] * np.sin(heading)
    ...     return np.stack([east, north, x[..., 2] + dt * u[..., 1]], axis=-1)
    >>> odometry = Inputs([0.0, 1.0], [[1.0, 0.0], [1.0, 0.0]], np.diag([0.04, 0.0]))
    >>> robot = InputModel.from_inputs(3, drive, odometry)
    >>> robot.noise_at([0.0, 0.0, 0.0], 0.0, 1.0).round(3).diagonal()
    array([0.04, 0.  , 0.  ])
    >>> robot.noise_at([0.0, 0.0, np.pi / 2], 0.0, 1.0).round(3).diagonal()
    array([0.  , 0.04, 0.  ])
    """

    inputs: Inputs = field(kw_only=True)
    driven_transition: Callable[[Array, Array, float], Array] = field(kw_only=True)

    has_state_noise: ClassVar[bool] = True

    @classmethod
    def from_inputs(
        cls,
        dim: PositiveInt,
        driven_transition: Callable[[Array, Array, float], Array],
        inputs: Inputs,
        noise_cov: Callable[[float, float], Array] | None = None,
        *,
        names: tuple[str, ...] = (),
        units: tuple[str, ...] = (),
        periods: PeriodsArgument = (),
    ) -> InputModel:
        """Build the model from ``driven_transition(x, u, dt)``; `noise_cov` adds further noise."""
        return cls(
            dim,
            partial(_drive, driven_transition, inputs),
            partial(_no_noise, dim) if noise_cov is None else noise_cov,
            names=names,
            units=units,
            periods=periods,
            inputs=inputs,
            driven_transition=driven_transition,
        )

    @validated
    def sample_step(
        self,
        x: Annotated[ArrayInput, "... self.dim"],
        t: float,
        dt: NonNegativeFloat,
        *,
        rng: Rng,
    ) -> Array:
        """Move states (..., d) from `t` to `t` + `dt`, each with draws of the inputs' noise."""
        # At the first use a step checks `transition`; its result is not needed.
        self.step(x, t, dt)
        root = factor(self.inputs.cov)
        # The parts of the step in which one input u holds, one after the other. The transition
        # depends on a part's length alone, not on when it begins.
        for _begin, length, u in self.inputs.pieces(t, dt):
            # u + ε with ε = L z and Σ = L Lᵀ; rows are states, so z multiplies Lᵀ.
            normal = rng.standard_normal((*x.shape[:-1], u.size))
            x = _move(self.driven_transition, x, u + normal @ root.T, length)
        # The further noise w of the whole step
        lower = self.noise_sqrt(t, dt)
        return np.asarray(x + rng.standard_normal(x.shape) @ lower.T)

    @validated
    def noise_at(
        self, x: Annotated[ArrayInput, "... self.dim"], t: float, dt: NonNegativeFloat
    ) -> Array:
        """Covariance of the noise that a step from states (..., d) adds, (..., d, d)."""
        pieces = self.inputs.pieces(t, dt)
        cov = add_up_noise(self.driven_transition, pieces, x, self.inputs.cov)
        return cov + self.Q(t, dt)


def _no_noise(dim: int, t: float, dt: float) -> Array:
    """Return the covariance of a model without noise beyond that of its inputs."""
    return np.zeros((dim, dim))


def _drive(
    driven_transition: Callable[[Array, Array, float], Array],
    inputs: Inputs,
    x: Array,
    t: float,
    dt: float,
) -> Array:
    """Move states (..., d) from `t` to `t` + `dt` by the measured inputs, without their noise.

    The inputs that hold in this interval are applied one after the other.
    """
    return move_by_inputs(driven_transition, inputs.pieces(t, dt), x)


def move_by_inputs(
    driven_transition: Callable[[Array, Array, float], Array],
    pieces: Iterable[Piece],
    x: Array,
) -> Array:
    """Move states (..., d) by one input after the other; inputs broadcast to the states."""
    for _begin, length, u in pieces:
        x = _move(driven_transition, x, u, length)
    return x


def add_up_noise(
    driven_transition: Callable[[Array, Array, float], Array],
    pieces: Iterable[Piece],
    x: Array,
    cov: Array,
) -> Array:
    """Return the covariance (..., d, d) that inputs with one of (..., k, k) add to states (..., d).

    The inputs hold in the pieces of a step, one after the other, and enter the states by
    ``driven_transition(x, u, dt)``.

    >>> def move(x, u, dt):
    ...     return x + dt * u
    >>> two = [(0.0, 1.0, np.ones(1)), (1.0, 2.0, np.ones(1))]
    >>> add_up_noise(move, two, np.zeros((1, 1)), np.eye(1)).round(6)
    array([[[5.]]])
    """
    d = x.shape[-1]
    total = np.zeros((*x.shape, d))
    # The parts of a step in which one input u holds, one after the other
    for _begin, length, u in pieces:
        inputs = np.broadcast_to(u, (*x.shape[:-1], u.shape[-1]))

        # The default binds this part's length: a closure would see that of a later one.
        def move(joint: Array, dt: float = length) -> Array:
            return _move(driven_transition, joint[..., :d], joint[..., d:], dt)

        # The derivatives of a piece by the states and by the inputs, at once
        joint = np.concatenate([x, inputs], axis=-1)
        slope = central_difference(move, joint, np.subtract)
        f = slope[..., :d]
        g = slope[..., d:]
        # F P Fᵀ of the earlier inputs' noise, and G Σ Gᵀ of this one's
        total = f @ total @ f.mT + g @ cov @ g.mT
        x = _move(driven_transition, x, inputs, length)
    return symmetrise(total)


def _move(
    driven_transition: Callable[[Array, Array, float], Array],
    x: Array,
    u: Array,
    dt: float,
) -> Array:
    """Move states (..., d) by inputs (..., k) that broadcast to them, and check the result.

    The user's function gets copies, which it may change.
    """
    inputs = np.broadcast_to(u, (*x.shape[:-1], u.shape[-1])).copy()
    moved = call_user(driven_transition, x.copy(), inputs, dt)
    return check_array(moved, "driven_transition", x.shape, finite=False)
