"""What agents have of each other's Gaussians: one exchange, all agents at once."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..checks import Array, array, count
from .channel import Channel
from .links import Graph

__all__: list[str] = []

Mask = NDArray[np.bool_]
Indices = NDArray[np.int64]

Fuse = Callable[[Array, Array, Mask], tuple[Array, Array]]
"""Means (..., S, d), covariances and who is there (..., S), of S sources, to one Gaussian."""


@dataclass(frozen=True, eq=False)
class Heard:
    """One round's Gaussians, runs in one axis: own ones, those by sender, and which arrived.

    What a sender sent is kept once, not for each of its links; :attr:`arrived` (R, E) tells who may
    use it.
    """

    graph: Graph
    means: Array
    covs: Array
    sent_means: Array
    sent_covs: Array
    arrived: Mask

    def sums(self, per_link: Array) -> Array:
        """What each agent's links carry, added: (R, E, ...) to (R, A, ...)."""
        runs, edges, *rest = per_link.shape
        size = self.graph.size
        if not edges:
            return np.zeros((runs, size, *rest))
        if runs == 1:
            return np.asarray(
                (self.graph.incidence @ per_link.reshape(edges, -1)).reshape(1, size, *rest)
            )
        flat = per_link.swapaxes(0, 1).reshape(edges, -1)
        return np.asarray((self.graph.incidence @ flat).reshape(size, runs, *rest).swapaxes(0, 1))

    def mixed(self, own: Array, links: Array, mine: Array, sent: Array) -> Array:
        """Weighted sums of matrices (R, A, d, d), the own one and what each sender sent."""
        heard = links[..., None, None] * sent[:, self.graph.senders]
        return own[..., None, None] * mine + self.sums(heard)

    def gaps(self) -> Array:
        """The heard mean less the own one, on each link, (R, E, d)."""
        graph = self.graph
        return np.asarray(self.sent_means[:, graph.senders] - self.means[:, graph.receivers])

    def groups(self) -> Iterator[tuple[Indices, Indices]]:
        """Agents that hear equally many, (n,), and their links, (n, S - 1)."""
        starts, degrees = self.graph.links.indptr, np.diff(self.graph.links.indptr)
        for degree in np.unique(degrees):
            agents = np.flatnonzero(degrees == degree)
            yield agents, starts[agents, None] + np.arange(degree)

    def collected(self, agents: Indices, links: Indices) -> tuple[Array, Array, Mask]:
        """Means (R, n, S, d), covariances and who is there, (R, n, S), the own first."""
        here = self.arrived[:, links]
        who = self.graph.senders[links]
        means = np.where(here[..., None], self.sent_means[:, who], 0.0)
        covs = np.where(here[..., None, None], self.sent_covs[:, who], np.eye(means.shape[-1]))
        return (np.concatenate([self.means[:, agents, None], means], axis=2),
                np.concatenate([self.covs[:, agents, None], covs], axis=2),
                np.concatenate([np.ones((*here.shape[:2], 1), dtype=bool), here], axis=2))


Step = Callable[[Heard], tuple[Array, Array]]


def in_rounds(
    means: Array, covs: Array, channel: Channel, rounds: int, step: Step
) -> tuple[Array, Array]:
    """Exchange means and upper triangles and take a step, some times."""
    graph, d = channel.graph, means.shape[-1]
    row, column = np.triu_indices(d)
    m, p = means.reshape(-1, graph.size, d), covs.reshape(-1, graph.size, d, d)
    for _ in range(count(rounds, "rounds")):
        packed = np.concatenate([m, p[..., row, column]], axis=-1)
        heard, arrived = channel.broadcast(packed.reshape(*channel.runs, graph.size, -1))
        sent_m, sent_p = m, p
        # Before the first late message is there, zeros stand in its place: no covariances.
        if channel.faults.late and heard.any():
            sent_m, sent_p = _unpacked(heard.reshape(packed.shape), d)
        m, p = step(Heard(graph, m, p, sent_m, sent_p, arrived.reshape(len(m), -1)))
    return m.reshape(means.shape), p.reshape(covs.shape)


def _unpacked(packed: Array, d: int) -> tuple[Array, Array]:
    row, column = np.triu_indices(d)
    covs = np.empty((*packed.shape[:-1], d, d))
    covs[..., row, column] = packed[..., d:]
    covs[..., column, row] = packed[..., d:]
    return packed[..., :d], covs


def fused_by(
    means: Array, covs: Array, channel: Channel, fuse: Fuse, rounds: int
) -> tuple[Array, Array]:
    """Let each agent fuse all that it has by a rule for single neighbourhoods, some times."""

    def step(heard: Heard) -> tuple[Array, Array]:
        m, p = np.empty_like(heard.means), np.empty_like(heard.covs)
        for agents, links in heard.groups():
            mean, cov = fuse(*heard.collected(agents, links))
            m[:, agents] = array(mean, "fuse", m[:, agents].shape)
            p[:, agents] = array(cov, "fuse", p[:, agents].shape)
        return m, p

    return in_rounds(means, covs, channel, rounds, step)
