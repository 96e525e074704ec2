"""A filter family of one's own: the belief on a grid of places, for walkers on a line."""

from dataclasses import dataclass

import numpy as np

from distfilt.filters import Filter, SensorState, Summary, prior_moments

X = np.linspace(-6, 6, 241)[:, None]  # places, in m


@dataclass(frozen=True, eq=False, repr=False)
class GridState(SensorState):
    chances: np.ndarray
    belief_field = "chances", (..., "A", len(X))


class GridFilter(Filter):
    state_class = GridState
    unsupported = {"fusion": "grids do not agree", "lag": "a grid keeps no past"}

    def initial_state(self, prior, runs, rng):
        mean, cov = prior_moments(prior, 1)
        belief = np.exp(-((X.T - mean) ** 2) / (2 * cov))
        return {
            "chances": np.broadcast_to(
                belief / belief.sum(), (*runs, self.n_agents, len(X))
            )
        }

    def next_state(self, step):
        gap = X.T - self.model.step(X, step.state.t, step.dt)
        kernel = np.exp(-(gap**2) / (2 * self.model.Q(step.state.t, step.dt)))
        belief = step.state.chances @ (kernel / kernel.sum(axis=1, keepdims=True))
        for _, heard in step.received():
            seen = heard.predict(
                np.broadcast_to(X, (*belief[..., heard.agents, :].shape, 1))
            )
            gap = np.nan_to_num(
                heard.target[..., None, :] - seen
            )  # what is missing says nothing
            noise = np.diagonal(heard.noise, axis1=-2, axis2=-1)[..., None, :]
            belief[..., heard.agents, :] *= np.exp(-(gap**2 / noise).sum(-1) / 2)
        return step.end(chances=belief / belief.sum(axis=-1, keepdims=True))

    def summarize(self, state):
        mean = state.chances @ X
        return Summary(mean, state.chances @ X**2 - mean**2)
