"""A gate that keeps rejecting: how often in a row, and the warning that follows.

A gate leaves out what a belief cannot explain. If the belief itself is wrong, it leaves out
everything that could mend it, and the estimate runs away with a small covariance.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from ..validation import Array, Indices, Mask

if TYPE_CHECKING:
    from .base import SensorFilter
    from .observations import Observation
    from .states import AnyState, State
    from .step import Received

__all__ = ["LIMIT", "RejectionStreaks"]

LIMIT = 10
"""A warning is given if a gate has rejected so many of a sensor's observations in a row."""


class RejectionStreaks:
    """How many observations in a row the gates of all agents have rejected, in one step.

    An agent counts the observations of each source apart: those of others that its belief explains
    would hide that it rejects every one of a neighbour's.

    Attributes
    ----------
    counts : ndarray, (*runs, A, B, S + 1)
        For each agent, each source, and each of the source's sensors. Sensors that come with their
        observations are counted together, in the last column. Of A agents that share their
        observations all are sources, B = A; otherwise an agent has its own alone, B = 1.

    Examples
    --------
    >>> from distfilt.filters import GaussianFilter, Observation
    >>> from distfilt.models import constant_velocity
    >>> from distfilt.sensors import component
    >>> f = GaussianFilter(
    ...     constant_velocity(sigma=1.0),
    ...     [component([0], std=1.0)],
    ...     gate_probability=0.99,
    ... )
    >>> streaks = RejectionStreaks(f, f.start((np.zeros(4), np.eye(4))), ())
    >>> number = streaks.number_of(0, Observation(0.0, 0, [9.0]))
    >>> for is_rejected in (True, True, False, True):
    ...     rejected = np.array([is_rejected])
    ...     _ = streaks.count(np.array([number]), rejected, ~rejected)
    ...     print(streaks.counts[0, 0])
    [1. 0.]
    [2. 0.]
    [0. 0.]
    [1. 0.]
    """

    def __init__(
        self, filter_: SensorFilter[AnyState], state: State, runs: tuple[int, ...]
    ) -> None:
        self.has_sources = filter_.sends_observations
        self.n_agents = filter_.n_agents
        self.n_sources = self.n_agents if self.has_sources else 1
        # S + 1: a column for each of an agent's sensors, as many as one agent has at most, and the
        # last one for those that come with their observations
        self.n_columns = 1 + max(len(sensors) for sensors in filter_.agent_sensors)
        shape = (*runs, self.n_agents, self.n_sources, self.n_columns)
        before = state.rejection_streaks
        if before is None or before.shape != shape:
            # The first step, or one of a filter with other sensors.
            before = np.zeros(shape)
        self.counts: Array = before
        # Whether the counts are still the array of the state before, which must not change
        self._is_shared = True
        # By time and agent: the streak that each of the agent's observations belongs to.
        self._numbers: dict[float, list[list[int]]] = {}

    def number_of(self, agent: int, observation: Observation) -> int:
        """Return which of all streaks, counted row by row, an agent's observation belongs to."""
        # The index of a streak in `counts` is (agent, source, column), in row-major order.
        source = observation.agent if self.has_sources else 0
        sensor = observation.sensor
        column = sensor if isinstance(sensor, int) else self.n_columns - 1
        return (agent * self.n_sources + source) * self.n_columns + column

    def note(self, t: float, agent: int, observation: Observation) -> None:
        """Note that an agent has one more observation of time `t`."""
        if t not in self._numbers:
            self._numbers[t] = [[] for _ in range(self.n_agents)]
        self._numbers[t][agent].append(self.number_of(agent, observation))

    def list_numbers(self, t: float, agents: Indices) -> list[list[int]]:
        """Return the streaks of the agents' observations of time `t`, in the order they came."""
        return [self._numbers[t][agent] for agent in agents.tolist()]

    def count(self, numbers: Indices, rejected: Array, kept: Array) -> Mask:
        """Count K observations, and return whether each one's streak reaches the limit, (*runs, K).

        Parameters
        ----------
        numbers : ndarray of int, (K,)
            The streak that each observation belongs to.
        rejected, kept : ndarray of bool, (*runs, K)
            Whether it was rejected, and whether it was not; neither if it was missing.
        """
        if self._is_shared:
            # The counts are still the array of the state before the step.
            self.counts = self.counts.copy()
            self._is_shared = False
        # Several observations of one sensor in a step belong to one streak: `used` are the
        # different streaks, `inverse` (K,) the position of each observation's streak among them.
        used, inverse = np.unique(numbers, return_inverse=True)
        # Any: numpy's types of `at` have no index of several axes.
        index: Any = (..., inverse)
        runs = self.counts.shape[:-3]
        n_rejected = np.zeros((*runs, used.size))
        n_kept = np.zeros_like(n_rejected)
        np.add.at(n_rejected, index, rejected)
        np.add.at(n_kept, index, kept)
        # A view (*runs, all streaks), so that the assignment changes the counts
        row = self.counts.reshape(*runs, -1)
        # An observation that passes ends the streak.
        after = np.where(n_kept > 0, 0.0, row[..., used] + n_rejected)
        row[..., used] = after
        has_reached = (after >= LIMIT) & (n_rejected > 0)
        return np.asarray(has_reached[..., inverse])

    def count_group(self, before: Received, after: Received, mean: Array) -> str | None:
        """Count a group's observations before and after the gate, and return a warning, if any.

        Observations that cannot be predicted, of which the `mean` (*runs, G, M) is NaN, are none.
        """
        # The gate has put NaN in place of the numbers that it rejects.
        is_present = ~np.isnan(before.target - mean)
        is_kept = is_present & ~np.isnan(after.target)
        # Without a rejection, now or before, nothing changes.
        if (is_present == is_kept).all() and not self.counts.any():
            return None
        # Of the group's K observations: the streak of each, and which observation of which agent it
        # is, counted in the group and in the agent.
        numbers: list[int] = []
        owners: list[tuple[int, int]] = []
        for g, of_agent in enumerate(before.streaks):
            numbers += of_agent
            owners += [(g, k) for k in range(len(of_agent))]
        rows, ranks = np.array(owners).T
        # Which of its agent's M numbers each observation has, (K, M)
        has = before.sensor_index[rows] == ranks[:, None]
        present = (is_present[..., rows, :] & has).any(axis=-1)
        kept = (is_kept[..., rows, :] & has).any(axis=-1)
        has_reached = self.count(np.array(numbers), present & ~kept, kept)
        if not has_reached.any():
            return None
        # The first observation whose streak has reached the limit, in any run
        *_run, first = np.argwhere(has_reached)[0].tolist()
        kind = before.kind_of(int(rows[first]), int(has[first].argmax()))
        return self.describe(numbers[first], kind)

    def describe(self, number: int, kind: str) -> str:
        """Return the warning of a gate that keeps rejecting observations of one streak."""
        # As :meth:`number_of` counts: number = (agent n_sources + source) n_columns + column.
        agent, source = divmod(number // self.n_columns, self.n_sources)
        origin = ""
        if self.has_sources and source != agent:
            origin = f" from agent {source}"
        return (
            f"observations must pass the gate to be used, but agent {agent}'s has rejected the "
            f"last {LIMIT} of kind {kind!r}{origin}: the belief may have lost its target, with a "
            "covariance that is too small, or the sensor's noise is larger than its covariance says"
        )
