"""A filter family of your own: beliefs on a grid of positions, for walkers on a line."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from distfilt import filters
from distfilt.filters import SensorState, Step, Summary

X = np.linspace(-6, 6, 241)[:, None]  # positions of the cells, in m


def normalize(weights: np.ndarray) -> np.ndarray:
    """Scale weights so that they sum to one over the cells."""
    return np.asarray(weights / weights.sum(axis=-1, keepdims=True))


@dataclass(frozen=True, eq=False, repr=False)
class GridState(SensorState):
    probabilities: np.ndarray
    belief_field = "probabilities", (..., "A", len(X))


class GridFilter(
    filters.SensorFilter[GridState], filters.SharesObservations[GridState]
):
    """Agents with a model and sensors, which can share observations; no fusion, no lag."""

    state_class = GridState

    def initial_state(
        self, prior: Any, runs: tuple[int, ...], rng: Any
    ) -> dict[str, Any]:
        mean, cov = filters.prior_moments(prior, 1)
        density = np.exp(-((X.T - mean) ** 2) / (2 * cov))
        shape = (*runs, self.n_agents, len(X))
        return {"probabilities": np.broadcast_to(normalize(density), shape)}

    def next_state(self, step: Step[GridState]) -> GridState:
        t = step.state.t
        dt = step.dt
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

    def summarize(self, state: GridState) -> Summary:
        mean = state.probabilities @ X
        variance = state.probabilities @ X**2 - mean**2
        return Summary(mean, variance)
