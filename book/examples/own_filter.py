"""A filter family of one's own: the belief on a grid of places, for walkers on a line."""

from dataclasses import dataclass

import numpy as np

from distfilt.filters import SensorFilter, State, Summary
from distfilt.network import Ledger

X = np.linspace(-6, 6, 241)[:, None]  # places, in m


@dataclass(frozen=True, eq=False)
class GridState(State):
    belief: np.ndarray  # (A, places)


class GridFilter(SensorFilter):
    def start(self, prior, *, rng=None, runs=(), t=0.0):
        belief = np.exp(-((X.T - prior[0]) ** 2) / (2 * np.asarray(prior[1])))
        belief = np.repeat(belief / belief.sum(), len(self.sensors), axis=0)
        return GridState(t, Ledger.empty(len(belief)), None, belief)

    def step(self, state, t, observations):
        dt, channel = self.elapsed(state, t), self.channel(state, t)
        gap = X.T - self.model.step(X, state.t, dt)
        kernel = np.exp(-(gap**2) / (2 * self.model.noise(state.t, dt)))
        belief = state.belief @ (kernel / kernel.sum(axis=1, keepdims=True))
        for heard in self.gather(self.observed(state, observations), channel):
            gap = heard.target[:, None] - heard.predict(np.repeat(X[None], len(heard.agents), 0))
            belief[heard.agents] *= np.exp(-(gap**2 / np.diag(heard.covariance(0))).sum(-1) / 2)
        return GridState(t, channel.ledger, None, belief / belief.sum(axis=1, keepdims=True))

    def summary(self, state):
        mean = state.belief @ X
        return Summary(mean, state.belief @ X**2 - mean**2)
