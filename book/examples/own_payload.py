"""A payload of one's own: a structure crosses the channel as a flat tuple of arrays."""

from dataclasses import dataclass

import numpy as np

from distfilt.network import Channel, graphs


@dataclass(frozen=True)
class Track:
    name: int
    mean: np.ndarray
    cov: np.ndarray

    def pack(self):
        """What is sent: every number once, so that the ledger charges what the radio would."""
        upper = np.triu_indices(self.mean.size)
        return np.array([self.name]), self.mean, self.cov[upper].astype(np.float32)

    @classmethod
    def unpack(cls, payload):
        name, mean, packed = payload
        cov = np.zeros((mean.size, mean.size))
        cov[np.triu_indices(mean.size)] = packed
        return cls(int(name[0]), np.array(mean), cov + np.triu(cov, 1).T)


tracks = [Track(7 + a, np.full(3, float(a)), np.eye(3) + 0.5) for a in range(3)]
channel = Channel(graphs.path(3))
inbox = channel.broadcast([track.pack() for track in tracks])
heard = {sender: Track.unpack(payload) for sender, payload in inbox[1].items()}
print({sender: track.name for sender, track in heard.items()}, channel.ledger)
