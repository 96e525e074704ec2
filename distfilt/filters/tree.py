"""Kalman filters on a tree of agents, with a channel filter on each link."""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass, field
from typing import Annotated, ClassVar, cast

import numpy as np

from ..linalg import symmetrise
from ..network import Graph, fuse_on_tree
from ..validation import Array, Rng
from .gaussian import GaussianFamily, GaussianState
from .priors import Prior, moments_by_agent
from .resets import Reset, reset_gaussian
from .states import State
from .step import Step

__all__ = ["ChannelFilter", "ChannelFilterState"]


@dataclass(frozen=True, eq=False, repr=False)
class ChannelFilterState(GaussianState):
    """The Gaussians of agents and of links between two steps.

    Parameters
    ----------
    t, ledger, rng, rejected, failed, pending, joint_means, joint_covariances, dim, history
        As for :class:`~distfilt.filters.GaussianState`.
    link_means : ndarray, (*runs, E, d)
        The mean that both ends of each link know, in the order of the graph's links.
    link_covariances : ndarray, (*runs, E, d, d)

    Examples
    --------
    >>> from distfilt.network import Ledger
    >>> m, p = np.zeros((2, 1)), np.ones((2, 1, 1))
    >>> state = ChannelFilterState(
    ...     0.0, Ledger.empty(2), None, m, p, 1, link_means=m, link_covariances=p
    ... )
    >>> state.link_means.shape
    (2, 1)
    """

    link_means: Annotated[Array, "... E d"] = field(kw_only=True)
    link_covariances: Annotated[Array, "... E d d"] = field(kw_only=True)


@dataclass(frozen=True, eq=False)
class ChannelFilter(GaussianFamily):
    """Kalman filters of agents on a tree, which send neighbours only new information.

    Each agent assimilates its own observations and sends its belief. On each link both ends keep
    the belief that they have in common, forecast it as their own, and subtract it from the
    received one: see :func:`distfilt.network.fuse_on_tree`. For linear models without process noise
    every agent's belief is exactly that from all observations that have reached it, one link a
    step. With process noise it is an approximation.

    Parameters
    ----------
    model, sensors, gate_probability, faults, names
        As for :class:`~distfilt.filters.SensorFilter`.
    graph
        A tree that does not change. A lost message costs nothing but time.
    on_error, record_evidence
        As in :mod:`distfilt.filters.options`.
    linearization, kappa, inflation
        As for :class:`GaussianFilter`.

    Notes
    -----
    S. Grime and H. F. Durrant-Whyte, Control Engineering Practice 2 (1994) 849-863.

    Examples
    --------
    >>> from distfilt.models import Model
    >>> from distfilt.network import graphs
    >>> from distfilt.sensors import component
    >>> still = Model(1, lambda x, t, dt: x, lambda t, dt: np.zeros((1, 1)))
    >>> f = ChannelFilter(still, [component([0], std=1.0)] * 3, graphs.path(3))
    >>> state = f.step(f.start(([0.0], [[1.0]])), 1.0, [[4.0], [4.0], [4.0]])
    >>> (1 / state.covariances).ravel().round(6)
    array([3., 4., 3.])
    >>> state = f.step(state, 2.0, [None] * 3)
    >>> state.means.ravel().round(6), state.ledger.scalars
    (array([3., 3., 3.]), array([4, 8, 4]))
    """

    state_class: ClassVar[type[State]] = ChannelFilterState

    def check_parts(self) -> None:
        """Refuse a graph that changes."""
        super().check_parts()
        if not isinstance(self.graph, Graph):
            raise ValueError(
                "graph must be a Graph that does not change, got "
                f"{type(self.graph).__name__}"
            )

    def initial_state(
        self, prior: Prior, runs: tuple[int, ...], rng: Rng | None
    ) -> dict[str, object]:
        """Return the prior for the agents, and for the links as their common belief."""
        fields = super().initial_state(prior, runs, rng)
        means = np.asarray(fields["joint_means"])
        covs = np.asarray(fields["joint_covariances"])
        if np.ptp(means, axis=-2).any() or np.ptp(covs, axis=-3).any():
            raise ValueError(
                "prior must be one for all agents, of which the links begin, got a list"
            )
        # Raises an error if the covariance has no inverse, as that of a known constant.
        moments_by_agent(prior, self.model.dim, self.n_agents, "definite")
        # Both ends of each link begin with the common prior.
        n_links = self.graph.senders.size
        fields["link_means"] = np.repeat(means[..., :1, :], n_links, axis=-2)
        fields["link_covariances"] = np.repeat(covs[..., :1, :, :], n_links, axis=-3)
        return fields

    def reset_belief(self, state: GaussianState, reset: Reset) -> GaussianState:
        """Return the state with a new belief about some components, which all agents learn."""
        if len(reset.agents) != self.n_agents:
            raise ValueError(
                "agents must be all of them, whose neighbours have to know of it, got "
                f"{len(reset.agents)} of {self.n_agents}"
            )
        # The beliefs of the links, which both ends know, are reset like those of agents, or they
        # would no longer be common.
        links = self._join_links(state, only_links=True)
        of_links = reset._replace(agents=list(range(self.graph.senders.size)))
        changed = reset_gaussian(links, of_links)
        return reset_gaussian(state, reset).replace(
            link_means=changed.joint_means, link_covariances=changed.joint_covariances
        )

    def next_state(self, step: Step[GaussianState]) -> GaussianState:
        """Forecast agents and links, assimilate the agents' own observations, exchange."""
        n = self.n_agents
        # Agents and links are forecast in one call, the E links behind the A agents.
        together = copy(step)
        together.state = self._join_links(step.state)
        all_means, all_covs = self._forecast(together)
        unit = np.eye(self.model.dim)
        means = step.check_forecast(all_means[..., :n, :], old=0.0)
        covs = step.check_forecast(all_covs[..., :n, :, :], old=unit)
        for time_index, group in step.received():
            means, covs = self._condition(means, covs, time_index, group, step)
        # A run that has failed gets standard normals, so that the batch can go on.
        covs = step.keep_failed(covs, old=unit)
        link_means = step.keep_failed(all_means[..., n:, :], old=0.0)
        link_covs = step.keep_failed(all_covs[..., n:, :, :], old=unit)
        if step.channel is not None:
            # Agent i's information Y_i + Σ (Y_j - Y_ij), that of its neighbours j without what the
            # link knows; and the links' new common beliefs
            belief, common = fuse_on_tree(
                (means, covs), (link_means, link_covs), step.channel
            )
            means, covs = belief
            link_means, link_covs = common
        return self._end(
            step,
            means,
            symmetrise(covs),
            link_means=link_means,
            link_covariances=link_covs,
        )

    def _join_links(
        self, state: GaussianState, *, only_links: bool = False
    ) -> GaussianState:
        """Return a state whose agents are followed by the links, or the links alone."""
        # A state of this filter has links, which are treated as further agents.
        with_links = cast(ChannelFilterState, state)
        means = with_links.link_means
        covs = with_links.link_covariances
        if not only_links:
            means = np.concatenate([state.joint_means, means], axis=-2)
            covs = np.concatenate([state.joint_covariances, covs], axis=-3)
        return GaussianState.construct(
            state.t,
            state.ledger,
            rng=None,
            joint_means=means,
            joint_covariances=covs,
            dim=state.dim,
            failed=state.failed,
        )
