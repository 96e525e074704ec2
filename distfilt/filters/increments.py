"""Localisation and tracking by information increments: agents send the information they gain."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import KW_ONLY, dataclass
from functools import lru_cache
from itertools import product
from typing import cast

import numpy as np

from ..linalg import cholesky, quadratic_form
from ..mixtures import GaussianMixture
from ..mixtures.conditioning import update_mixture, update_together
from ..mixtures.fusion import align_mixture
from ..periods import Periods
from ..validation import (
    Array,
    Bounds,
    Indices,
    NonNegativeInt,
    PositiveInt,
    validated,
)
from .failures import RECOVERABLE
from .mixture import MixtureState, TargetMixtureFilter
from .observations import Observation, sensor_of
from .step import Step

__all__ = ["InformationIncrementFilter", "information_increment"]

_MIN_GAIN = 1e-6
"""A gain in information, relative to the information before, below which it counts as none."""


@validated
def information_increment(before: GaussianMixture, after: GaussianMixture) -> Array:
    r"""Return the information that a belief has gained, as observations of unit noise.

    For Gaussians the gain in information :math:`\mathbf P_+^{-1}-\mathbf P_-^{-1}` is
    :math:`\mathbf H^\top\mathbf H` with as many rows as it has rank, and
    :math:`\mathbf P_+^{-1}\mathbf m_+-\mathbf P_-^{-1}\mathbf m_-` is
    :math:`\mathbf H^\top\mathbf z`. Whoever assimilates the observations
    :math:`\mathbf z=\mathbf H\mathbf t` plus unit noise gains exactly that. Directions in which
    information was lost are left out.

    Parameters
    ----------
    before, after : GaussianMixture
        Beliefs about the target before and after the information to be sent; of several
        components the moments are compared.

    Returns
    -------
    ndarray, (r, n + 1)
        Rows of H, zero below its diagonal, with z as the last column.

    Examples
    --------
    >>> old = GaussianMixture.gaussian([0.0, 0.0], [[1.0, 0.0], [0.0, 1.0]])
    >>> new = GaussianMixture.gaussian([1.0, 0.0], [[0.5, 0.0], [0.0, 1.0]])
    >>> np.abs(information_increment(old, new))
    array([[1., 0., 2.]])
    """
    prior = before.moment_match()
    posterior = after.moment_match()
    if prior.dim != posterior.dim:
        raise ValueError(f"after must have dimension {prior.dim}, got {posterior.dim}")
    prior_root = prior.factors[0]
    posterior_root = posterior.factors[0]
    # In the frame in which the prior covariance L Lᵀ is the identity, the information is
    # (L₊⁻¹ L)ᵀ (L₊⁻¹ L) = V diag(s²) Vᵀ. The axes are the rows of Vᵀ.
    _u, s, axes = np.linalg.svd(np.linalg.solve(posterior_root, prior_root))
    # Beyond the prior's information, the identity; only directions with a gain are sent.
    gain = s**2 - 1
    is_gained = gain > _MIN_GAIN
    root_gain = np.sqrt(gain[is_gained])
    axes = axes[is_gained]
    # H = √(s² - 1) Vᵀ L⁻¹, row by row.
    rows = root_gain[:, None] * np.linalg.solve(prior_root.T, axes.T).T
    # From Hᵀ z = P₊⁻¹ m₊ - P₋⁻¹ m₋: z = H m₋ + s² / √(s² - 1) Vᵀ L⁻¹ (m₊ - m₋).
    difference = posterior.means[0] - prior.means[0]
    shift = axes @ np.linalg.solve(prior_root, difference)
    values = rows @ prior.means[0] + s[is_gained] ** 2 / root_gain * shift
    # Rotated, z and H are the same information, since the noise is that of the identity. Then H is
    # upper triangular, with zeros that need not be sent.
    rotation, rows = np.linalg.qr(rows)
    return np.concatenate([rows, (values @ rotation)[:, None]], axis=1)


@dataclass(frozen=True, eq=False)
class InformationIncrementFilter(TargetMixtureFilter):
    """Every agent sends the information about the target that its own observations added.

    An observation is sent once, by its own agent, so that nothing is counted twice and nothing has
    to be discounted. For linear models and Gaussians the result equals one filter of all
    observations if every agent is a neighbour of every other one, nothing is lost, the agents' own
    states are independent given the target's *present* state, and either every increment is sent
    at once or the target has no process noise: increments that wait (`exchange_interval`) are
    counted as if it had none. The origin of observations has to be known: components that all
    agents receive alike are named in `shared_components`, and each agent assimilates them for
    itself.

    Parameters
    ----------
    model, sensors, target_dim, split_threshold, split_scale, gate_probability, faults, names
        As of :class:`MixtureFilter`.
    graph
        As there, and required. Increments that could not be sent, without links or before the
        `exchange_interval` is over, are sent at the next contact.
    exchange_interval
        As in :mod:`distfilt.filters.options`.
    n_components, max_components : int
        As there. With more than one component the moments' increments are sent, which is an
        approximation.
    shared_components : sequence of int
        Components of the observations that all agents receive alike, with the same error, which
        has to be independent of the other components'; the gate tests and counts them separately.

    Notes
    -----
    The agents' own states stay independent given the target if the target has no process noise, or
    if every agent knows its own state. Otherwise observations correlate them through the target's
    past, which no belief about [target; ego] can hold, and beliefs become overconfident. Then let
    each agent filter [target; all agents] while neighbours share their observations: a
    :class:`GaussianFilter` with one sensor per agent. It sends m numbers an observation, and for
    linear models it is exact given the observations received, with any noise and any losses.

    Examples
    --------
    Two agents, and the Kalman filter of both observations:

    >>> from distfilt.models import Model
    >>> from distfilt.network import graphs
    >>> from distfilt.sensors import component
    >>> still = Model(1, lambda x, t, dt: x, lambda t, dt: np.zeros((1, 1)))
    >>> f = InformationIncrementFilter(
    ...     still, [component([0], std=1.0)] * 2, graphs.path(2), target_dim=1
    ... )
    >>> prior = GaussianMixture.gaussian([0.0], [[1.0]])
    >>> after = f.step(f.start([prior, prior]), 1.0, [[3.0], [0.0]])
    >>> [float(m.means[0, 0].round(9)) for m in after.mixtures], after.ledger.scalars
    ([1.0, 1.0], array([2, 2]))
    """

    _: KW_ONLY
    n_components: PositiveInt = 1
    max_components: PositiveInt = 1
    shared_components: Sequence[NonNegativeInt] = ()

    def check_parts(self) -> None:
        """Refuse a filter without a graph, and shared components that no observation has."""
        super().check_parts()
        if self.graph is None:
            raise ValueError("graph must be a Graph, got None")
        # Every sensor must have the shared components: the last index is below the smallest size.
        dims = [sensor.dim for sensors in self.agent_sensors for sensor in sensors]
        last = max(self.shared_components, default=-1)
        Bounds(below=min(dims, default=0))(last, "shared_components")

    def _assimilate(
        self, beliefs: list[GaussianMixture], step: Step[MixtureState]
    ) -> tuple[Sequence[GaussianMixture], Sequence[GaussianMixture | None]]:
        """Assimilate an agent's observations, the others' increments, then shared components.

        A shared component that the gate rejects is no increment either, although it comes while
        increments wait:

        >>> from distfilt.models import Model
        >>> from distfilt.network import graphs
        >>> from distfilt.sensors import component, stack
        >>> still = Model(1, lambda x, t, dt: x, lambda t, dt: np.zeros((1, 1)))
        >>> f = InformationIncrementFilter(
        ...     still,
        ...     [stack([component([0], std=1.0)] * 2)] * 2,
        ...     graphs.path(2),
        ...     target_dim=1,
        ...     shared_components=[1],
        ...     gate_probability=0.99,
        ...     exchange_interval=2.0,
        ... )
        >>> state = f.step(
        ...     f.start(([0.0], [[1.0]])), 1.0, [[1.0, 99.0], [np.nan, 99.0]]
        ... )
        >>> [m.means[0] for m in f.step(state, 2.0, [None, None]).mixtures]
        [array([0.5]), array([0.5])]
        """
        split = [self._split_shared(of_agent) for of_agent in step.observations]
        after = []
        for agent, belief in enumerate(beliefs):
            # The agent's own components; the shared ones follow after the exchange.
            private, _shared = split[agent]
            updated, _second = self._condition(belief, agent, private, step)
            after.append(updated)
        # Each agent's belief without the information it has not sent: from before the present
        # observations, or from before those that wait.
        unsent: list[GaussianMixture | None] = []
        waiting = step.state.unsent or (None,) * len(beliefs)
        # `old` is the belief after the forecast, `new` that after the agent's own observations.
        for agent, (old, new) in enumerate(zip(beliefs, after, strict=True)):
            before: GaussianMixture | None = waiting[agent]
            if before is not None:
                unsent.append(self._forecast(before, agent, step))
            else:
                # Without an observation the belief is the same object, and nothing has to be sent.
                unsent.append(old if new is not old else None)
        if step.channel is not None:
            outgoing = self._choose_increments(after, unsent, step)
            self._exchange(outgoing, after, unsent, step)
        for agent, (_private, shared) in enumerate(split):
            after[agent], unsent[agent] = self._condition(
                after[agent], agent, shared, step, unsent[agent]
            )
        return after, unsent if any(belief is not None for belief in unsent) else ()

    def _choose_increments(
        self,
        after: list[GaussianMixture],
        unsent: list[GaussianMixture | None],
        step: Step[MixtureState],
    ) -> list[Array | None]:
        """Return each agent's increment as numbers; its `unsent` belief becomes None, in place."""
        channel = step.channel
        target = range(self.target_dim)
        outgoing: list[Array | None] = [None] * len(after)
        # An agent that is silent, or has no listener, sends later: the links that work now are
        # counted for each sender.
        is_active = channel.faults.active_links(
            channel.graph, channel.ledger.rounds, channel.t
        )
        listeners = np.bincount(channel.graph.senders[is_active], minlength=len(after))
        for agent, before in enumerate(unsent):
            if before is None or not listeners[agent]:
                continue
            with step.failing_as(agent):
                # Of the target's components. The old mean's angles are brought near the new mean's.
                periods = self.periods[: self.target_dim]
                new = after[agent].marginal(target)
                old = align_mixture(before.marginal(target), new.mean, periods)
                increment = information_increment(old, new)
            # An increment below the threshold is sent with the next one.
            if increment.size:
                # Without the zeros below the diagonal: 13 numbers for two rows of six.
                outgoing[agent] = increment[_index_upper(*increment.shape)]
                unsent[agent] = None
        return outgoing

    def _exchange(
        self,
        outgoing: list[Array | None],
        after: list[GaussianMixture],
        unsent: list[GaussianMixture | None],
        step: Step[MixtureState],
    ) -> None:
        """Send the increments, and assimilate those that are received, in place.

        Parameters
        ----------
        outgoing : list of (ndarray or None)
            Each agent's increment as numbers, if it sends one.
        after : list of GaussianMixture
            Each agent's belief after its own observations.
        unsent : list of (GaussianMixture or None)
            Its belief without the information that it still has to send; None if it has sent all.
            What it receives counts for both beliefs: the next increment, which is their difference,
            must hold its own information only.
        step : Step
        """
        inbox = step.channel.broadcast(outgoing)
        # Each agent assimilates the increments in the order of their senders.
        for sender in range(len(after)):
            receivers = [a for a, messages in enumerate(inbox) if sender in messages]
            if receivers:
                # A broadcast is the same message for all of its receivers. It holds H and z, an
                # observation z = H x + e of the target's state x, with e ~ N(0, I).
                message = inbox[receivers[0]][sender]
                increment = _unpack(message, self.target_dim)
                self._add_to_all(increment, receivers, after, unsent, step)

    def _add_to_all(
        self,
        increment: Array,
        receivers: list[int],
        after: list[GaussianMixture],
        unsent: list[GaussianMixture | None],
        step: Step[MixtureState],
    ) -> None:
        """Assimilate an increment by its receivers, in place: by all in one call if possible."""
        periods = self.periods[: self.target_dim]
        if not any(period is not None for period in periods):
            # After an error the agents assimilate it one by one below, where it names its agent.
            with suppress(*RECOVERABLE):
                # It counts for the unsent beliefs too: their difference from the others, the next
                # increment, must not hold received information.
                waiting = [a for a in receivers if unsent[a] is not None]
                beliefs = [after[a] for a in receivers]
                beliefs += [cast(GaussianMixture, unsent[a]) for a in waiting]
                updated = update_together(beliefs, *_as_observation(increment))
                # First the receivers' beliefs, then the unsent ones
                for agent, belief in zip(receivers, updated, strict=False):
                    after[agent] = belief
                for agent, belief in zip(
                    waiting, updated[len(receivers) :], strict=True
                ):
                    unsent[agent] = belief
                return
        for agent in receivers:
            before = unsent[agent]
            with step.failing_as(agent):
                after[agent] = _add_increment(after[agent], increment, periods)
                if before is not None:
                    unsent[agent] = _add_increment(before, increment, periods)

    def _split_shared(
        self, observations: Sequence[Observation]
    ) -> tuple[list[Observation], list[Observation]]:
        """Split observations into the agent's own components and the shared ones."""
        if not self.shared_components:
            return list(observations), []
        private: list[Observation] = []
        shared: list[Observation] = []
        for observation in observations:
            value = observation.value
            # Correlated noise would let shared components carry information about the others.
            is_shared = np.isin(np.arange(value.size), self.shared_components)
            noise_cov = sensor_of(self, observation).noise_cov
            if noise_cov[np.ix_(is_shared, ~is_shared)].any():
                raise ValueError(
                    "shared_components must have noise that is independent of the other "
                    "components', got a sensor with correlated noise"
                )
            for part, is_missing in ((private, is_shared), (shared, ~is_shared)):
                # The gate and the update see the other components as missing.
                masked = np.where(is_missing, np.nan, value)
                if not np.isnan(masked).all():
                    part.append(observation.replace(value=masked))
        return private, shared


def _choose_branch(
    belief: GaussianMixture, rows: Array, values: Array, periods: Periods
) -> Array:
    """Return an increment's values z = H t for the receiver's branch of circular components.

    The sender's target t may be a period away in each angle. Of all such shifts the one under which
    the values are most probable is taken.

    >>> receiver = GaussianMixture.gaussian([-3.1], [[0.1]])
    >>> _choose_branch(receiver, np.eye(1), np.array([3.1]), (2 * np.pi,)).round(4)
    array([-3.1832])
    """
    n = len(periods)
    mean, cov = belief.marginal(range(n)).moments()
    # Shifts by one period back, none or one ahead in each angle, (S, n)
    turns = [(-1, 0, 1) if period else (0,) for period in periods]
    shifts = np.array(list(product(*turns))) * [period or 0.0 for period in periods]
    # All candidates z + H s, compared by the length of S^(-1/2) (z + H s - H m) with the innovation
    # covariance S = H P Hᵀ + I.
    candidates = values + shifts @ rows.T
    root = cholesky(rows @ cov @ rows.T + np.eye(len(values)))
    distances = quadratic_form(root, candidates - rows @ mean)
    return np.asarray(candidates[distances.argmin()])


def _unpack(numbers: Array, n: int) -> Array:
    """Return the increment of n components, whose number of rows follows from its length."""
    # r rows of an upper trapezoid with n + 1 columns have n + 1, n, … numbers: their sums for
    # r = 1, …, n
    sizes = [r * (n + 1) - r * (r - 1) // 2 for r in range(1, n + 1)]
    n_rows = sizes.index(numbers.size) + 1
    increment = np.zeros((n_rows, n + 1))
    increment[_index_upper(n_rows, n + 1)] = numbers
    return increment


@lru_cache(maxsize=16)
def _index_upper(n_rows: int, n_columns: int) -> tuple[Indices, ...]:
    """Return the index of a matrix's entries on and above the diagonal, made once."""
    return np.triu_indices(n_rows, 0, n_columns)


def _add_increment(
    belief: GaussianMixture, increment: Array, periods: Periods
) -> GaussianMixture:
    """Condition a belief on an increment's observations of its first components."""
    values, predict, noise = _as_observation(increment)
    if any(period is not None for period in periods):
        values = _choose_branch(belief, increment[:, :-1], values, periods)
    return update_mixture(belief, values, predict, noise)


def _as_observation(
    increment: Array,
) -> tuple[Array, Callable[[Array], Array], Array]:
    """Return an increment as values z, the function that predicts them, H x, and their noise, I.

    Its rows (r, n + 1) are those of H, of the first n components of a state, with z behind them.
    """
    rows = increment[:, :-1]
    values = increment[:, -1]

    def predict(x: Array) -> Array:
        return x[..., : rows.shape[1]] @ rows.T

    return values, predict, np.eye(values.size)
