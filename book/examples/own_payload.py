"""A payload of your own: a structure crosses the channel as a flat tuple of arrays."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from distfilt.network import Channel, graphs


@dataclass(frozen=True)
class Track:
    name: int
    mean: np.ndarray
    cov: np.ndarray

    def pack(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the payload: each number once, so that the ledger counts the radio's load."""
        upper = np.triu_indices(self.mean.size)
        return np.array([self.name]), self.mean, self.cov[upper].astype(np.float32)

    @classmethod
    def unpack(cls, payload: Sequence[np.ndarray]) -> "Track":
        """Return the track of a message."""
        name, mean, entries = payload
        # The covariance is symmetric: fill the upper triangle, then mirror it.
        upper = np.zeros((mean.size, mean.size))
        upper[np.triu_indices(mean.size)] = entries
        return cls(int(name[0]), np.array(mean), upper + np.triu(upper, 1).T)


tracks = [Track(7 + a, np.full(3, float(a)), np.eye(3) + 0.5) for a in range(3)]
channel = Channel(graphs.path(3))
inbox = channel.broadcast([track.pack() for track in tracks])
# The middle agent receives a track from either end.
received = {sender: Track.unpack(payload) for sender, payload in inbox[1].items()}
print({sender: track.name for sender, track in received.items()}, channel.ledger)
