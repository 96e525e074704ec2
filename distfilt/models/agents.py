"""A model for each agent: robots that move by their own odometry."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from typing import Annotated, ClassVar

import numpy as np

from ..validation import (
    Array,
    ArrayInput,
    InvalidArgumentError,
    NonNegativeFloat,
    NonNegativeInt,
    Rng,
    validated,
)
from ..validation.first_use import mark_checked, needs_check
from .base import Model
from .inputs import InputModel, Inputs, Piece, add_up_noise, move_by_inputs

__all__ = ["AgentModels"]


@dataclass(frozen=True, eq=False)
class AgentModels(Model):
    """A model for each agent, whose states have an axis of agents.

    For robots whose states differ, each with its own odometry, which the others do not know; or
    for agents that assume different motions of one target. Made by :meth:`from_models`. Gaussian,
    ensemble and particle filters move each agent by its own; the other families, whose agents
    need one model of one state, refuse it.

    Parameters
    ----------
    models : sequence of Model, length A
        Their states have the same components, with the same names, units and periods.
    agent_axis : int
        Which axis of states is that of the agents: 0 for (A, d), or members (A, N, d). Filters
        use the axis behind their runs.

    Examples
    --------
    Two robots on a line that measure their speeds; the second one's wheels are worse:

    >>> from distfilt.models import InputModel, Inputs
    >>> def drive(x, u, dt):
    ...     return x + dt * u
    >>> robots = AgentModels.from_models(
    ...     [
    ...         InputModel.from_inputs(1, drive, Inputs([0.0], [[1.0]], [[0.01]])),
    ...         InputModel.from_inputs(1, drive, Inputs([0.0], [[2.0]], [[0.04]])),
    ...     ]
    ... )
    >>> robots.step([[0.0], [10.0]], 0.0, 3.0)
    array([[ 3.],
           [16.]])

    Each knows its own place, and what it measures itself:

    >>> from distfilt.filters import GaussianFilter
    >>> from distfilt.sensors import component
    >>> beacon = component([0], std=1.0)
    >>> f = GaussianFilter(robots, [beacon, beacon], share_observations=False)
    >>> state = f.start([([0.0], [[0.01]]), ([10.0], [[0.01]])])
    >>> state = f.step(state, 3.0, [[3.2], None])
    >>> state.means.ravel().round(3), state.covariances.ravel().round(3)
    (array([ 3.018, 16.   ]), array([0.091, 0.37 ]))
    """

    models: Sequence[Model] = field(kw_only=True)
    agent_axis: NonNegativeInt = field(default=0, kw_only=True)

    has_state_noise: ClassVar[bool] = True

    @classmethod
    def from_models(cls, models: Sequence[Model]) -> AgentModels:
        """Build it from the agents' models, in the order of the agents."""
        models = list(models)
        if not models:
            raise ValueError("models must have one for each agent, got none")
        for model in models:
            if not isinstance(model, Model) or isinstance(model, AgentModels):
                raise InvalidArgumentError(
                    f"models must be a Model for each agent, got a {type(model).__name__}"
                )
        # The states must have the same components.
        first = models[0]
        for name in ("dim", "names", "units", "periods"):
            values = [getattr(model, name) for model in models]
            different = [value for value in values if value != values[0]]
            if different:
                raise ValueError(
                    f"models must have the same {name} for all agents, got {values[0]} and "
                    f"{different[0]}"
                )
        return cls(
            dim=first.dim,
            # There is no transition, and no covariance, of all agents: these raise an error.
            transition=_refuse_one_state,
            noise_cov=_refuse_one_covariance,
            names=first.names,
            units=first.units,
            periods=first.periods,
            models=models,
        )

    @property
    def n_agents(self) -> int:
        """Number A of agents."""
        return len(self.models)

    def at_axis(self, axis: int) -> AgentModels:
        """Return the same models for states whose axis of agents is this one."""
        return self if axis == self.agent_axis else _move_axis(self, axis)

    @cached_property
    def _team(self) -> _Team | None:
        """The agents' inputs side by side, if they move alike at the same times."""
        return _read_team(self.models)

    @validated
    def step(
        self, x: Annotated[ArrayInput, "... self.dim"], t: float, dt: NonNegativeFloat
    ) -> Array:
        """Move states (..., A, ..., d) from `t` to `t` + `dt`, without noise."""
        # Each agent's model and states, and the agents' inputs side by side if they move alike
        pairs = self._pair(x)
        team = self._team
        # The first time each agent moves alone, which checks its model.
        if team is None or needs_check(self, "step"):
            mark_checked(self, "step")
            return self._stack([model.step(states, t, dt) for model, states in pairs])
        agents_first = np.moveaxis(x, self.agent_axis, 0)
        # The parts of the step in which one input of each agent holds
        pieces = team.pieces(t, dt, agents_first.ndim)
        moved = move_by_inputs(team.move, pieces, agents_first)
        return np.moveaxis(moved, 0, self.agent_axis)

    @validated
    def noise_at(
        self, x: Annotated[ArrayInput, "... self.dim"], t: float, dt: NonNegativeFloat
    ) -> Array:
        """Covariance of the noise that a step from states (..., d) adds, (..., d, d)."""
        # Each agent's model and states; agents that move alike are taken in one call.
        pairs = self._pair(x)
        if self._team is not None:
            return self._noise_of_team(self._team, x, t, dt)
        covs = []
        for model, states in pairs:
            cov = model.noise_at(states, t, dt)
            # A noise that does not depend on the state is the same for all.
            covs.append(np.broadcast_to(cov, (*states.shape, self.dim)))
        return self._stack(covs)

    @validated
    def sample_step(
        self,
        x: Annotated[ArrayInput, "... self.dim"],
        t: float,
        dt: NonNegativeFloat,
        *,
        rng: Rng,
    ) -> Array:
        """Move states (..., d) from `t` to `t` + `dt`, each with a draw of its agent's noise."""
        pairs = self._pair(x)
        moved = [model.sample_step(states, t, dt, rng=rng) for model, states in pairs]
        return self._stack(moved)

    @validated
    def jacobian(
        self,
        x: Annotated[ArrayInput, "... self.dim"],
        t: float,
        dt: NonNegativeFloat,
        *,
        std: Annotated[ArrayInput, "... self.dim"] | None = None,
    ) -> Array:
        """Derivative of a step from states (..., d), as (..., d, d)."""
        if self._team is not None:
            # By differences of `step`, which moves all agents at once
            return super().jacobian(x, t, dt, std=std)
        # Each agent's Jacobian, with the deviations of its own states
        slopes = []
        for agent, (model, states) in enumerate(self._pair(x)):
            agent_std = None
            if std is not None:
                stds = np.broadcast_to(std, x.shape)
                agent_std = np.take(stds, agent, self.agent_axis)
            slopes.append(model.jacobian(states, t, dt, std=agent_std))
        return self._stack(slopes)

    def _noise_of_team(self, team: _Team, x: Array, t: float, dt: float) -> Array:
        """Return the covariances of a step's noise for the agents of a team, like `noise_at`."""
        agents_first = np.moveaxis(x, self.agent_axis, 0)
        # Covariances (A, ..., k, k) of the inputs, for states (A, ..., d)
        input_cov = _insert_axes(team.input_covs, agents_first.ndim + 1)
        pieces = team.pieces(t, dt, agents_first.ndim)
        cov = add_up_noise(team.move, pieces, agents_first, input_cov)
        # Each model's noise beyond that of its inputs
        added = np.stack([model.Q(t, dt) for model in self.models])
        cov = cov + _insert_axes(added, cov.ndim)
        return np.moveaxis(cov, 0, self.agent_axis)

    def _pair(self, x: Array) -> list[tuple[Model, Array]]:
        """Return each agent's model with its states, (..., d) without the axis of agents."""
        axis = self.agent_axis
        if x.ndim < axis + 2 or x.shape[axis] != self.n_agents:
            raise ValueError(
                f"x must have an axis {axis} of {self.n_agents} agents for a model of each, got "
                f"shape {x.shape}"
            )
        agents_first = np.moveaxis(x, axis, 0)
        return list(zip(self.models, agents_first, strict=True))

    def _stack(self, values: list[Array]) -> Array:
        """Return the agents' arrays as one, with their axis where the states have it."""
        return np.stack(values, axis=self.agent_axis)


@dataclass(frozen=True, eq=False)
class _Team:
    """Agents whose inputs hold at the same times and move their states by the same function.

    One call of the function then moves them all.
    """

    move: Callable[[Array, Array, float], Array]
    """``move(x, u, dt)`` on states (A, ..., d) and inputs (A, ..., k)."""
    inputs: Inputs
    """Those of all agents side by side, (T, A k)."""
    input_covs: Array
    """The covariance of each, (A, k, k)."""

    def pieces(self, t: float, dt: float, ndim: int) -> list[Piece]:
        """Return the parts of a step, with inputs (A, ..., k) for states (A, ..., d)."""
        n_agents, k = self.input_covs.shape[:2]
        return [
            (begin, length, _insert_axes(u.reshape(n_agents, k), ndim))
            for begin, length, u in self.inputs.pieces(t, dt)
        ]


def _read_team(models: Sequence[Model]) -> _Team | None:
    """Return the models as a team if they differ in the inputs' values and covariances alone.

    Otherwise return None: each agent then has to be moved by itself.
    """
    # A model with a derivative of its own is moved by itself.
    inputs = []
    moves = []
    for model in models:
        if type(model) is not InputModel or model.derivative is not None:
            return None
        inputs.append(model.inputs)
        moves.append(model.driven_transition)
    # All must move by one function, with as many inputs at the same times.
    first = inputs[0]
    for other, move in zip(inputs, moves, strict=True):
        is_alike = move is moves[0] and other.values.shape == first.values.shape
        if not is_alike or not np.array_equal(other.times, first.times):
            return None
    # The agents' inputs side by side, (T, A k)
    values = np.concatenate([one.values for one in inputs], axis=1)
    # The covariance of these joint inputs is never used: each agent has its own, returned beside.
    n_values = values.shape[1]
    side_by_side = Inputs(first.times, values, np.zeros((n_values, n_values)))
    return _Team(
        move=moves[0],
        inputs=side_by_side,
        input_covs=np.stack([one.cov for one in inputs]),
    )


def _insert_axes(values: Array, ndim: int) -> Array:
    """Insert axes of size 1 behind the first, so that values (A, ...) have `ndim` axes."""
    # Broadcasting then fits the axis of agents to the first one of states.
    missing = ndim - values.ndim
    return values.reshape(values.shape[0], *[1] * missing, *values.shape[1:])


@lru_cache(maxsize=64)
def _move_axis(models: AgentModels, axis: int) -> AgentModels:
    """Return the models for another axis, made once, so that it is checked once."""
    return models.replace(agent_axis=axis)


def _refuse_one_state(x: Array, t: float, dt: float) -> Array:
    """Stand in for the transition that agents do not have in common."""
    raise ValueError("model must be one for all agents here, got AgentModels")


def _refuse_one_covariance(t: float, dt: float) -> Array:
    """Stand in for the covariance that agents do not have in common."""
    raise ValueError(
        "model must be one for all agents here, got AgentModels: noise_at has the noise of each"
    )
