"""Exchange of the agents' positions: flooded, to neighbours only, or known to all."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ..network import Channel
from ..validation import Array, FrozenModel, PositiveFloat
from .consensus import ConsensusProtocol, Memory, Update
from .kernel import kernel_density, kernels
from .snapshot import SwarmSnapshot

__all__ = ["Centralised", "Flooding", "Neighbours"]

_NEVER = -1e30
"""Time of an entry that an agent has never received."""


@dataclass(frozen=True)
class Flooding(FrozenModel, ConsensusProtocol):
    """Every agent forwards the latest known position of each agent, with its time.

    Parameters
    ----------
    forget : float, optional
        Age in s from which an entry is ignored in the estimate. Agents that have disappeared are
        then forgotten, and so are those in another component of a disconnected network.

    Examples
    --------
    >>> Flooding(forget=5.0).forget
    5.0
    """

    forget: PositiveFloat | None = field(default=None, kw_only=True)

    def initial_state(self, snapshot: SwarmSnapshot) -> Memory:
        """Tables (A, A, d + 1) of positions and times, without any entry."""
        return (_empty_table(snapshot),)

    def update(
        self, memory: Memory, snapshot: SwarmSnapshot, channel: Channel, dt: float
    ) -> Update:
        """Send each agent's table to its neighbours, and retain the latest of each entry."""
        (table_before,) = memory
        # Row (i, j) is agent j's position as agent i knows it, and, last, the time of it.
        table = _insert_positions(snapshot, table_before)
        received = channel.broadcast(snapshot.select_payloads(table))
        latest = table.copy()
        agents = np.arange(len(table))
        for i in np.flatnonzero(snapshot.present):
            # An agent's own table, and those of its neighbours
            tables = np.stack([table[i], *received[i].values()])
            # For each agent the entry with the latest time.
            newest = tables[..., -1].argmax(axis=0)
            latest[i] = tables[newest, agents]
        # A missing entry has the time _NEVER, which is below this limit; all real times are above.
        oldest = _NEVER / 2 if self.forget is None else snapshot.t - self.forget
        densities, counts = _average_kernels(latest, oldest, snapshot)
        return (latest,), densities, counts


def _empty_table(snapshot: SwarmSnapshot) -> Array:
    """Return tables (A, A, d + 1) without entries: row (i, j) is agent i's knowledge of j.

    A row has the position and, last, its time, which is `_NEVER`.
    """
    agents, d = snapshot.positions.shape
    entry = [0.0] * d + [_NEVER]
    return np.full((agents, agents, d + 1), entry)


def _insert_positions(snapshot: SwarmSnapshot, table: Array) -> Array:
    """Copy tables (A, A, d + 1), and insert each agent's present position and time in its own."""
    result = table.copy()
    i = np.flatnonzero(snapshot.present)
    result[i, i, :-1] = snapshot.positions[i]
    result[i, i, -1] = snapshot.t
    return result


def _average_kernels(
    table: Array, oldest: float, snapshot: SwarmSnapshot
) -> tuple[Array, Array]:
    """Average the kernels at the entries of each agent's table that are later than `oldest`.

    Many tables have the same entry, whose kernel is computed once.

    Parameters
    ----------
    table : ndarray, (A, A, d + 1)
        Row (i, j) is agent j's position as agent i knows it, and, last, the time of it.
    oldest : float
        Entries of this time or before are left out, in s.
    snapshot : SwarmSnapshot

    Returns
    -------
    densities : ndarray, (A, n)
        Zero for a table without entries, and for agents that are not local.
    counts : ndarray, (A,)
        Number of entries in each average.
    """
    recent = table[..., -1] > oldest
    counts = recent.sum(axis=1).astype(np.float64)
    if snapshot.local is not None:
        others = np.delete(np.arange(len(recent)), snapshot.local)
        # The kernels of others are not needed, but their counts are.
        recent[others] = False
    owner, agent = np.nonzero(recent)
    # An entry is identified by its agent and its time.
    entries = np.stack([agent, table[owner, agent, -1]], axis=1)
    # Different entries: where each occurs first, and which of them every entry is.
    _distinct, first, number = np.unique(
        entries, axis=0, return_index=True, return_inverse=True
    )
    positions = table[owner[first], agent[first], :-1]
    z = kernels(positions, snapshot.grid, bandwidth=snapshot.bandwidth)
    weights = np.zeros((len(table), len(positions)))
    # Row i averages the kernels of the entries in table i.
    weights[owner, number] = 1.0
    # A table without entries gives zero.
    totals = np.maximum(weights.sum(axis=1, keepdims=True), 1.0)
    return np.asarray(weights @ z / totals), counts


@dataclass(frozen=True)
class Neighbours(FrozenModel, ConsensusProtocol):
    """Remark 4 of Zheng and Lin, taken literally: positions are sent to neighbours only.

    Each agent's estimate is the kernel estimate of itself and of those from which it receives.

    Examples
    --------
    >>> Neighbours().reference
    False
    """

    def update(
        self, memory: Memory, snapshot: SwarmSnapshot, channel: Channel, dt: float
    ) -> Update:
        """Send each agent's position, and average the kernels at all received positions."""
        # Row (i, j) is agent j's position as agent i knows it, and, last, the time of it.
        table = _insert_positions(snapshot, _empty_table(snapshot))
        payloads = snapshot.select_payloads(snapshot.positions)
        for i, inbox in enumerate(channel.broadcast(payloads)):
            for j, position in inbox.items():
                table[i, j, :-1] = position
                table[i, j, -1] = snapshot.t
        # All entries count but those never received, whose time is _NEVER.
        densities, counts = _average_kernels(table, _NEVER / 2, snapshot)
        return (), densities, counts


@dataclass(frozen=True)
class Centralised(FrozenModel, ConsensusProtocol):
    """The reference: all positions known to all agents, at no cost.

    Examples
    --------
    >>> Centralised().reference
    True
    """

    reference = True

    def update(
        self, memory: Memory, snapshot: SwarmSnapshot, channel: Channel, dt: float
    ) -> Update:
        """The kernel estimate of all present agents, for each agent."""
        agents = len(snapshot.positions)
        positions = snapshot.positions[snapshot.present]
        density = kernel_density(positions, snapshot.grid, bandwidth=snapshot.bandwidth)
        counts = np.full(agents, float(len(positions)))
        # All agents have the same estimate.
        return (), np.tile(density, (agents, 1)), counts
