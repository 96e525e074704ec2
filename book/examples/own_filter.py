"""A filter family of your own: beliefs on a grid of positions, for walkers on a line."""

from dataclasses import dataclass

import numpy as np

from distfilt.filters import Filter, SensorState, Summary, prior_moments

X = np.linspace(-6, 6, 241)[:, None]  # positions of the cells, in m


def normalize(weights):
    """Scale weights so that they sum to one over the cells."""
    return weights / weights.sum(axis=-1, keepdims=True)


@dataclass(frozen=True, eq=False, repr=False)
class GridState(SensorState):
    probabilities: np.ndarray
    belief_field = "probabilities", (..., "A", len(X))


class GridFilter(Filter):
    state_class = GridState
    unsupported = {"fusion": "grids are not fused", "lag": "a grid keeps no past"}

    def initial_state(self, prior, runs, rng):
        mean, cov = prior_moments(prior, 1)
        density = np.exp(-((X.T - mean) ** 2) / (2 * cov))
        shape = (*runs, self.n_agents, len(X))
        return {"probabilities": np.broadcast_to(normalize(density), shape)}

    def next_state(self, step):
        t, dt = step.state.t, step.dt
        # Forecast: every cell spreads over the others by the transition density.
        distance = X.T - self.model.step(X, t, dt)
        kernel = np.exp(-(distance**2) / (2 * self.model.Q(t, dt)))
        belief = step.state.probabilities @ normalize(kernel)
        # Update: multiply by the likelihood of all observations that an agent has.
        for _, group in step.received():
            agents = group.agents
            cells = np.broadcast_to(X, (*belief[..., agents, :].shape, 1))
            innovation = group.target[..., None, :] - group.predict(cells)
            innovation = np.nan_to_num(innovation)  # NaN: a missing observation
            variance = np.diagonal(group.noise, axis1=-2, axis2=-1)[..., None, :]
            squares = (innovation**2 / variance).sum(-1)
            belief[..., agents, :] *= np.exp(-squares / 2)
        return step.end(probabilities=normalize(belief))

    def summarize(self, state):
        mean = state.probabilities @ X
        variance = state.probabilities @ X**2 - mean**2
        return Summary(mean, variance)
