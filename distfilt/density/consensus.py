"""Consensus on kernel estimates: the protocol, and two rules that average densities or modes."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

import numpy as np

from ..network import Channel, Faults, Graph, PIState, pi_step
from ..network import weights as weighting
from ..network.channel import LossRule
from ..validation import (
    Array,
    FrozenModel,
    NonNegativeFloat,
    PositiveFloat,
    PositiveInt,
    call_user,
)
from ..validation.first_use import mark_checked, needs_check
from .snapshot import SwarmSnapshot

__all__ = [
    "BiasedAverage",
    "ConsensusProtocol",
    "DynamicAverage",
    "PIConsensus",
    "estimate_without_messages",
]

Memory = tuple[Array, ...]
"""The agents' memory between steps: arrays whose first axis is the agents."""
Update = tuple[Memory, Array, Array]
"""The new memory, each agent's estimate (A, n), and its number of agents, (A,)."""


@runtime_checkable
class ConsensusProtocol(Protocol):
    """A protocol by which agents estimate the swarm's density: the `fusion` of a density filter.

    `initial_state` returns the agents' memory before the first step. `update` takes their memory
    and their present positions, exchanges messages over the channel, and returns the new memory,
    each agent's estimate (A, n), and the number of agents that each believes there are, (A,).

    Examples
    --------
    >>> from distfilt.density import Centralised, Flooding
    >>> Centralised().reference, Flooding().belief_kind
    (True, 'densities')
    """

    belief_kind: str = "densities"
    reference: bool = False
    """Whether this is a reference for comparison, which needs no network."""

    def initial_state(self, snapshot: SwarmSnapshot) -> Memory:
        """The agents' memory before the first step: empty by default."""
        return ()

    def update(
        self, memory: Memory, snapshot: SwarmSnapshot, channel: Channel, dt: float
    ) -> Update:
        """Exchange messages in one step of length `dt`, and estimate the density."""
        ...


def estimate_without_messages(
    protocol: ConsensusProtocol, snapshot: SwarmSnapshot
) -> Array:
    """Each agent's estimate before any message has been sent, (A, n).

    It is the agent's own kernel; only a reference needs no messages to know the positions of all.

    Examples
    --------
    >>> from distfilt.density import Grid
    >>> snapshot = SwarmSnapshot(np.full((2, 2), 0.5), Grid((9, 9)), 0.1, 0.0)
    >>> estimates = estimate_without_messages(PIConsensus(), snapshot)
    >>> np.array_equal(estimates, snapshot.kernels)
    True
    """
    if not protocol.reference:
        return snapshot.kernels
    # Without edges the channel transmits nothing.
    no_edges = np.zeros((0, 2))
    channel = Channel(Graph.from_edges(len(snapshot.positions), no_edges))
    memory = call_user(protocol.initial_state, snapshot)
    # Without messages the length of the step does not matter.
    dt = 1.0
    _memory, estimates, _counts = call_user(
        protocol.update, memory, snapshot, channel, dt
    )
    return np.asarray(estimates)


def _encode(snapshot: SwarmSnapshot, modes: int | None, densities: Array) -> Array:
    """Return the numbers that the agents average, (A, k + 1).

    They are densities (A, n), of k = n cells, or as many of their cosine coefficients as there are
    `modes`, and behind them the indicator of the first present agent. The snapshot has the grid,
    and says which agents are present.
    """
    values = densities
    if modes is not None:
        # The coefficients in an orthonormal basis are integrals over the box.
        values = densities @ snapshot.grid.cosines(modes) * snapshot.grid.volume
    # One agent has the input 1, all others 0: its average counts the agents.
    leader = np.arange(len(values)) == np.argmax(snapshot.present)
    return np.concatenate([values, leader[:, None]], axis=1)


def _decode(
    values: Array, snapshot: SwarmSnapshot, modes: int | None
) -> tuple[Array, Array]:
    """Return densities (A, n) and numbers of agents (A,) from averages: `_encode` inverted."""
    densities = values[:, :-1]
    if modes is not None:
        densities = densities @ snapshot.grid.cosines(modes).T
    # The last value is 1 for the leader and 0 for all others, so its average is 1/N. Before the
    # consensus has converged it may be zero or negative: 1 to a million agents are believed.
    n_agents = 1 / np.clip(values[:, -1], 1e-6, 1.0)
    return densities, n_agents


@dataclass(frozen=True)
class PIConsensus(FrozenModel, ConsensusProtocol):
    """The proportional-integral estimator of equation (16) of Zheng and Lin.

    Parameters
    ----------
    alpha, a, b : float
        Gains, in 1/s, of :func:`distfilt.network.pi_step`.
    modes : int, optional
        Number of cosine coefficients on which the agents agree, instead of on all cells.
    rate : bool
        Add the derivative of the inputs, which (16) lacks, so that the estimates follow the average
        without a lag.
    initial_std : float, optional
        Start from a Gaussian of this width about the agent instead of from its own kernel.

    Examples
    --------
    >>> PIConsensus(modes=64).modes
    64
    """

    alpha: NonNegativeFloat = field(default=0.2, kw_only=True)
    a: NonNegativeFloat = field(default=0.4, kw_only=True)
    b: NonNegativeFloat = field(default=0.04, kw_only=True)
    modes: PositiveInt | None = field(default=None, kw_only=True)
    rate: bool = field(default=False, kw_only=True)
    initial_std: PositiveFloat | None = field(default=None, kw_only=True)

    def initial_state(self, snapshot: SwarmSnapshot) -> Memory:
        """Return estimates, integrals and inputs of the estimator, each (A, k + 1).

        k is the number of cells or of cosine coefficients; the last column counts the agents. The
        integrals are zero, and the inputs those of the present positions.
        """
        # Each agent's kernel on the cells, or its cosine coefficients, and last the indicator
        inputs = _encode(snapshot, self.modes, snapshot.kernels)
        # Before any exchange an agent's estimate is its own kernel, or a Gaussian about itself.
        estimates = inputs
        if self.initial_std is not None:
            gaussians = snapshot.initial_gaussians(self.initial_std)
            estimates = _encode(snapshot, self.modes, gaussians)
        return estimates, np.zeros_like(inputs), inputs

    def update(
        self, memory: Memory, snapshot: SwarmSnapshot, channel: Channel, dt: float
    ) -> Update:
        """Integrate (16) of Zheng and Lin over `dt`, in as many substeps as stability needs.

        Each agent's input is its kernel, on all cells or as `modes` cosine coefficients, and an
        indicator whose average counts the agents. The memory holds the estimates, the integrals and
        the inputs, see :meth:`initial_state`.
        """
        estimates, integrals, previous = memory
        inputs = _encode(snapshot, self.modes, snapshot.kernels)
        # Explicit Euler steps take the inputs of their beginning: those of the previous positions.
        # The new inputs, of the end of the step, enter by the rate, if at all.
        state = pi_step(
            PIState(estimates, integrals),
            previous,
            channel,
            dt=dt,
            alpha=self.alpha,
            a=self.a,
            b=self.b,
            rate=(inputs - previous) / dt if self.rate else None,
        )
        # The memory holds encoded values; the estimates are decoded from them.
        densities, n_agents = _decode(state.estimate, snapshot, self.modes)
        return (state.estimate, state.integral, inputs), densities, n_agents


class BiasedAverage(RuntimeWarning):
    """An average whose sum lost messages change, so that it is another one than asked for.

    >>> issubclass(BiasedAverage, RuntimeWarning)
    True
    """


@dataclass(frozen=True)
class DynamicAverage(FrozenModel, ConsensusProtocol):
    """First-order dynamic average consensus on cosine coefficients of the density.

    Metropolis weights if all links are bidirectional, otherwise weights that balance the graph
    (M. Zhu and S. Martinez, Automatica 46 (2010) 322-329). On one-way links lost messages move
    the average for good, of which :class:`BiasedAverage` warns once; :class:`Flooding` is not
    moved by losses.

    Parameters
    ----------
    modes : int, optional
        Number of coefficients; with None the agents agree on all cells.

    Examples
    --------
    >>> DynamicAverage().modes
    100
    """

    modes: PositiveInt | None = field(default=100, kw_only=True)

    def initial_state(self, snapshot: SwarmSnapshot) -> Memory:
        """Initial estimates equal to the inputs, without which the average would be biased."""
        inputs = _encode(snapshot, self.modes, snapshot.kernels)
        return inputs, inputs

    def update(
        self, memory: Memory, snapshot: SwarmSnapshot, channel: Channel, dt: float
    ) -> Update:
        """Mix the estimates, and add the change of each agent's input, its encoded kernel.

        Memory and messages hold encoded densities, (A, k + 1): the k cosine coefficients or cells
        of each agent's density, and a number whose average counts the agents.
        """
        # The estimates, and the inputs at the last step
        estimates, previous = memory
        inputs = _encode(snapshot, self.modes, snapshot.kernels)
        graph = channel.graph
        if graph.is_directed:
            weights = weighting.doubly_stochastic(graph)
        else:
            weights = weighting.metropolis(graph)
        # With links both ways a lost message cancels its answer too, which keeps the sum of the
        # estimates. One-way links cannot: the receiver keeps its own value, and the sum moves.
        on_loss: LossRule = "keep" if graph.is_directed else "mutual"
        if graph.is_directed:
            self._warn_of_bias(channel.faults)
        # x ← W x + (u - u_previous) conserves mean(x) = mean(u), as the columns of W sum to one.
        mixed = channel.mix(estimates, weights, on_loss=on_loss)
        estimates = mixed + (inputs - previous)
        # Back to densities on the grid, (A, n), and to numbers of agents, (A,)
        densities, n_agents = _decode(estimates, snapshot, self.modes)
        return (estimates, inputs), densities, n_agents

    def _warn_of_bias(self, faults: Faults) -> None:
        """Warn, once for each rule, that lost messages move the sum of the estimates.

        The faults are those of the channel.
        """
        if faults.is_perfect or not needs_check(self, "losses"):
            return
        # Remembered, so that the next loss gives no warning.
        mark_checked(self, "losses")
        warnings.warn(
            "faults must not lose messages on one-way links for a DynamicAverage, whose estimates "
            "drift away from the average with each loss: use links both ways, or Flooding",
            BiasedAverage,
            stacklevel=4,
        )
