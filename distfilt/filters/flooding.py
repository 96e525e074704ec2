"""Flooding of observations: agents forward them over several links, each once, with split horizon.

An agent sends an observation to all neighbours but those from which it has received it. On a ring
of eight that halves the numbers that are sent.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..network import Channel
from ..validation import Array, Mask

__all__ = ["Bundle", "flood_observations"]

Bundle = tuple[Array, ...]
"""The values of one agent's observations, (*runs, m) each; NaN in runs that do not have them."""


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
    while any(flood.fresh) and rounds != hops:
        flood.send_fresh()
        rounds += 1
    # An agent's own observations are not received.
    for agent, box in enumerate(flood.known):
        box.pop(agent, None)
    return flood.known


class _Flood:
    """The observations that each agent knows, and those that it received in the last round.

    Messages are lost in some runs and not in others, so that everything holds run by run.
    """

    def __init__(
        self,
        channel: Channel,
        bundles: Sequence[Bundle | None],
        labels: Sequence[Array],
    ) -> None:
        self.channel = channel
        self.labels = labels
        self.known: list[dict[int, Bundle]] = []
        # By agent and maker: the runs in which the agent has received the bundle just now.
        self.fresh: list[dict[int, Mask]] = []
        # By agent, maker and neighbour: the runs in which it came from that neighbour.
        self.sources: dict[tuple[int, int, int], Mask] = {}
        for agent, bundle in enumerate(bundles):
            self.known.append({} if bundle is None else {agent: bundle})
            self.fresh.append({} if bundle is None else {agent: _find_present(bundle)})

    def send_fresh(self) -> None:
        """Send what is fresh over each link, but not back, and note what arrives."""
        graph = self.channel.graph
        ends = list(zip(graph.receivers.tolist(), graph.senders.tolist(), strict=True))
        # For the bill by broadcast: the runs in which any receiver needs a bundle.
        needed: list[dict[int, Mask]] = [{} for _ in self.fresh]
        makers_by_link: list[list[int]] = []
        payloads: list[Bundle | None] = []
        for receiver, sender in ends:
            wanted: dict[int, Mask] = {}
            for maker, is_fresh in self.fresh[sender].items():
                came_back = self.sources.get((sender, maker, receiver), False)
                mask = np.asarray(is_fresh & ~np.asarray(came_back))
                if mask.any():
                    wanted[maker] = mask
                    before = needed[sender].get(maker, False)
                    needed[sender][maker] = np.asarray(mask | before)
            makers_by_link.append(list(wanted))
            payloads.append(self._pack(sender, wanted))
        common = [self._pack(agent, wanted) for agent, wanted in enumerate(needed)]
        arrived = self.channel.unicast(payloads, common=common)
        self.fresh = [{} for _ in self.fresh]
        for (receiver, sender), makers, payload in zip(
            ends, makers_by_link, arrived, strict=True
        ):
            if payload is not None:
                self._receive(receiver, sender, makers, payload)

    def _pack(self, agent: int, wanted: dict[int, Mask]) -> Bundle | None:
        """Return the payload of some bundles, in the runs that want them."""
        parts: list[Array] = []
        runs = self.channel.runs
        for maker, mask in wanted.items():
            for value in self.known[agent][maker]:
                parts.append(np.where(mask[..., None], value, np.nan))
            label = self.labels[maker]
            parts.append(np.broadcast_to(label, (*runs, label.size)))
        return tuple(parts) if parts else None

    def _receive(
        self, receiver: int, sender: int, makers: list[int], payload: Bundle
    ) -> None:
        """Add the bundles in a message to those that the receiver knows."""
        start = 0
        box = self.known[receiver]
        for maker in makers:
            stop = start + len(self.known[sender][maker])
            bundle = payload[start:stop]
            # The label follows the values.
            start = stop + 1
            arrived = _find_present(bundle)
            key = (receiver, maker, sender)
            before = self.sources.get(key, False)
            self.sources[key] = np.asarray(arrived | before)
            is_new = arrived
            if maker in box:
                is_new = arrived & ~_find_present(box[maker])
                pairs = zip(bundle, box[maker], strict=True)
                bundle = tuple(
                    [np.where(is_new[..., None], new, old) for new, old in pairs]
                )
            if is_new.any():
                box[maker] = bundle
                earlier = self.fresh[receiver].get(maker, False)
                self.fresh[receiver][maker] = np.asarray(is_new | earlier)


def _find_present(bundle: Bundle) -> Mask:
    """Return the runs in which some number of a bundle is not NaN."""
    is_present = [~np.isnan(value).all(axis=-1) for value in bundle]
    return np.asarray(np.any(is_present, axis=0))
