"""Flooding of observations: agents forward them over several links, each once, with split horizon.

An agent sends an observation to all neighbours but those from which it has received it. On a ring
of eight that halves the numbers that are sent.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..network import Channel
from ..network.flood import find_opposite
from ..validation import Array, Mask

__all__ = ["Bundle", "flood_observations"]

Bundle = tuple[Array, ...]
"""The values of one agent's observations, with the axes of the runs first.

They are NaN in runs that do not have them.
"""


def flood_observations(
    channel: Channel,
    bundles: Sequence[Bundle | None],
    labels: Sequence[Array],
    hops: int | None,
) -> list[dict[int, Bundle]]:
    """Send each agent's observations over several links, and return those that each receives.

    Parameters
    ----------
    channel : Channel
        Without delay; a lost message is not sent again, but may come by another way.
    bundles : sequence of length A
        Each agent's values, or None.
    labels : sequence of length A
        Numbers that travel with them, such as the agent's own.
    hops : int or None
        How many links observations travel; None for as many as it takes.

    Examples
    --------
    >>> from distfilt.network import graphs
    >>> channel = Channel(graphs.ring(8))
    >>> bundles = [(np.array([float(k)]),) for k in range(8)]
    >>> received = flood_observations(
    ...     channel, bundles, [np.array([k]) for k in range(8)], None
    ... )
    >>> sorted(received[0]), channel.ledger.scalars
    ([1, 2, 3, 4, 5, 6, 7], array([16, 16, 16, 16, 16, 16, 16, 16]))
    """
    flood = _Flood(channel, bundles, labels)
    rounds = 0
    while flood.fresh.any() and rounds != hops:
        flood.send_fresh()
        rounds += 1
    # An agent's own observations are not received.
    for agent, box in enumerate(flood.known):
        box.pop(agent, None)
    return flood.known


class _Flood:
    """The observations that each agent has, and those that it received in the last round.

    Messages are lost in some runs and not in others, so that every flag has the axes of the runs.
    """

    def __init__(
        self,
        channel: Channel,
        bundles: Sequence[Bundle | None],
        labels: Sequence[Array],
    ) -> None:
        self.channel = channel
        self.labels = labels
        graph = channel.graph
        n_agents = graph.n_agents
        self.opposite = find_opposite(graph)
        self.known: list[dict[int, Bundle]] = [{} for _ in bundles]
        # A bundle's maker is the agent whose observations it holds. By agent and maker: whether the
        # agent has the maker's bundle.
        self.present = np.zeros((n_agents, n_agents, *channel.runs), dtype=bool)
        for agent, bundle in enumerate(bundles):
            if bundle is not None:
                self.known[agent][agent] = bundle
                self.present[agent, agent] = _find_present(bundle)
        # Whether it has received the bundle in the last round.
        self.fresh = self.present.copy()
        # By link and maker: whether the bundle has come over the link. The last row is that of the
        # opposite of a link that goes one way: nothing comes over it.
        n_links = graph.senders.size
        self.came = np.zeros((n_links + 1, n_agents, *channel.runs), dtype=bool)

    def send_fresh(self) -> None:
        """Send the bundles received last over each link, but not back to where they came from."""
        senders = self.channel.graph.senders
        # Split horizon: what came over the opposite link is known at the other end. By link, maker
        # and run, (L, A, *runs).
        wanted = self.fresh[senders] & ~self.came[self.opposite]
        payloads = []
        for link, sender in enumerate(senders.tolist()):
            payloads.append(self._pack(sender, wanted[link]))
        # One transmission for all receivers holds the bundles that any of them needs.
        # By sender, maker and run: whether one of the sender's links wants the bundle
        needed = np.zeros_like(self.fresh)
        np.logical_or.at(needed, senders, wanted)
        common = [self._pack(agent, rows) for agent, rows in enumerate(needed)]
        arrived = self.channel.unicast(payloads, common=common)
        self.fresh = np.zeros_like(self.fresh)
        for link, payload in enumerate(arrived):
            if payload is not None:
                self._receive(link, wanted[link], payload)

    def _pack(self, agent: int, wanted: Mask) -> Bundle | None:
        """Return the payload of an agent's bundles; None if none is wanted.

        `wanted` (A, *runs) says by maker in which runs; in the others the values are NaN. Each
        bundle is followed by its label.
        """
        parts: list[Array] = []
        runs = self.channel.runs
        for maker in _list_makers(wanted):
            mask = wanted[maker, ..., None]
            for value in self.known[agent][maker]:
                parts.append(np.where(mask, value, np.nan))
            # The same label in all runs
            label = self.labels[maker]
            parts.append(np.broadcast_to(label, (*runs, label.size)))
        return tuple(parts) if parts else None

    def _receive(self, link: int, wanted: Mask, payload: Bundle) -> None:
        """Add the bundles in a message to those that the receiver has."""
        receiver = int(self.channel.graph.receivers[link])
        sender = int(self.channel.graph.senders[link])
        # The payload is taken apart as `_pack` has put it together.
        start = 0
        for maker in _list_makers(wanted):
            stop = start + len(self.known[sender][maker])
            bundle = payload[start:stop]
            # The label follows the values.
            start = stop + 1
            arrived = _find_present(bundle)
            self.came[link, maker] |= arrived
            is_new = arrived & ~self.present[receiver, maker]
            if is_new.any():
                self._keep(receiver, maker, bundle, is_new)

    def _keep(self, agent: int, maker: int, bundle: Bundle, is_new: Mask) -> None:
        """Take the values of a bundle in the runs in which it is new to an agent."""
        box = self.known[agent]
        # If the agent had none in any run, the new one fills all runs: where it is not `present`
        # nobody reads it.
        old = box.get(maker, bundle)
        mask = is_new[..., None]
        values = [np.where(mask, new, v) for new, v in zip(bundle, old, strict=True)]
        box[maker] = tuple(values)
        self.present[agent, maker] |= is_new
        self.fresh[agent, maker] |= is_new


def _list_makers(wanted: Mask) -> list[int]:
    """Return the makers whose bundles some run wants, from flags (A, *runs)."""
    by_maker = wanted.reshape(len(wanted), -1)
    return [int(maker) for maker in np.flatnonzero(by_maker.any(axis=1))]


def _find_present(bundle: Bundle) -> Mask:
    """Return the runs in which some number of a bundle is not NaN."""
    is_present = [~np.isnan(value).all(axis=-1) for value in bundle]
    return np.asarray(np.any(is_present, axis=0))
