"""Kalman filters whose agents average the information of their observations over the network."""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass
from typing import ClassVar, Literal

import numpy as np

from ..linalg import solve_definite, symmetrise
from ..network.information import (
    from_information,
    pack_information,
    to_information,
    unpack_information,
)
from ..periods import fold
from ..validation import Array, PositiveFloat, Rng
from .gaussian import GaussianFamily, GaussianState
from .options import FusesBeliefs
from .priors import Prior, moments_by_agent
from .step import Received, Step

__all__ = ["InformationConsensusFilter"]


@dataclass(frozen=True, eq=False)
class InformationConsensusFilter(GaussianFamily, FusesBeliefs[GaussianState]):
    r"""Kalman filters that average information matrices and vectors by a consensus rule.

    Agent i forecasts :math:`\boldsymbol\Omega_i=\mathbf P_i^{-1}` and has of its own observations
    the information :math:`\delta\boldsymbol\Omega_i=\mathbf H_i^\top\mathbf R_i^{-1}\mathbf H_i`.
    With averages :math:`\langle\cdot\rangle` by the consensus rule, and a weight ω,

    .. math:: \boldsymbol\Omega_i^+ =
        \begin{cases}
        \boldsymbol\Omega_i+\omega\langle\delta\boldsymbol\Omega\rangle & \text{"measurements"}\\
        \langle\boldsymbol\Omega\rangle+\omega\langle\delta\boldsymbol\Omega\rangle
        & \text{"hybrid"}\\
        A\,\langle\boldsymbol\Omega/A+\delta\boldsymbol\Omega\rangle & \text{"weighted"}
        \end{cases}

    and the same for the vectors. As an average times A is a sum, all of them with ω = A are the
    Kalman filter of all observations if the averages are exact, whatever model and noise. They
    differ after few rounds: "measurements" leaves forecasts apart, so that an agent may learn
    little of components that its own sensors do not observe; "hybrid" with ω = 1 never counts
    information twice (consensus on information); "weighted" is "hybrid" with ω = A for half of the
    numbers.

    Parameters
    ----------
    model, sensors, graph, gate_probability, faults, names
        As for :class:`~distfilt.filters.SensorFilter`. Where nobody can send, each agent uses its
        own observations only. Known constants, components without variance, have no information
        matrix: they need "measurements".
    fusion : callable
        The consensus rule, ``fusion(values, channel) -> values`` for vectors, such as
        ``partial(average_consensus, rounds=5)`` or ``finite_time_consensus``; required.
    average : {"weighted", "hybrid", "measurements"}
        Which information is averaged: d(d+3)/2 numbers, twice as many for "hybrid".
    weight : float, optional
        The weight ω for "hybrid" and "measurements"; the number A of agents by default.
    on_error, record_evidence
        As in :mod:`distfilt.filters.options`.
    linearization, kappa, inflation
        As for :class:`GaussianFilter`.

    Notes
    -----
    "hybrid" and "measurements": G. Battistelli, L. Chisci, G. Mugnai, A. Farina and A. Graziano,
    IEEE Transactions on Automatic Control 60 (2015) 1410-1415. "weighted": A. T. Kamal, J. A.
    Farrell and A. K. Roy-Chowdhury, IEEE Transactions on Automatic Control 58 (2013) 3112-3125.

    Examples
    --------
    >>> from distfilt.models import Model
    >>> from distfilt.network import finite_time_consensus, graphs
    >>> from distfilt.sensors import component
    >>> still = Model(1, lambda x, t, dt: x, lambda t, dt: np.zeros((1, 1)))
    >>> f = InformationConsensusFilter(
    ...     still,
    ...     [component([0], std=1.0)] * 4,
    ...     graphs.ring(4),
    ...     fusion=finite_time_consensus,
    ... )
    >>> state = f.step(f.start(([0.0], [[1.0]])), 0.0, [[1.0], [2.0], [3.0], [4.0]])
    >>> state.means.ravel().round(6), (1 / state.covariances).ravel().round(6)
    (array([2., 2., 2., 2.]), array([5., 5., 5., 5.]))
    """

    _: KW_ONLY
    average: Literal["weighted", "hybrid", "measurements"] = "weighted"
    weight: PositiveFloat | None = None

    belief_kind: ClassVar[str | None] = "vectors"

    def check_parts(self) -> None:
        """Refuse a filter without a consensus rule, or with a weight that is not used."""
        super().check_parts()
        if self.fusion is None:
            raise ValueError(
                "fusion must be a consensus rule, such as partial(average_consensus, "
                "rounds=5), got None"
            )
        if self.weight is not None and self.average == "weighted":
            raise ValueError(
                "weight must be None for the average 'weighted', which has none, got "
                f"{self.weight:g}"
            )

    def initial_state(
        self, prior: Prior, runs: tuple[int, ...], rng: Rng | None
    ) -> dict[str, object]:
        """Return the prior for the agents; where all information is averaged, it is definite."""
        if self.average != "measurements":
            # Raises an error if a covariance has no inverse.
            moments_by_agent(prior, self.model.dim, self.n_agents, "definite")
        return super().initial_state(prior, runs, rng)

    def next_state(self, step: Step[GaussianState]) -> GaussianState:
        """Forecast, average the information, add it."""
        means, covs = self._check_forecast(step)
        # The agents' angles near each other, within half a period of their circular mean, so that
        # vectors can be averaged
        branch = fold(means, self.periods)
        # Information that each agent gains by its observations: matrix and vector, side by side,
        # (*runs, A, d, d + 1)
        gained = np.zeros((*branch.shape, branch.shape[-1] + 1))
        for _time_index, group in step.received():
            self._add_information(gained, means, branch, covs, group, step)
        # δΩ and δq of each agent's own observations as one vector: the matrix is symmetric, so that
        # d(d+3)/2 numbers are enough
        own = pack_information(gained[..., :-1], gained[..., -1])
        if not step.has_fusion:
            new = self._add_to_forecast(step, branch, covs, own)
        elif self.average == "measurements":
            # Ω + ω ⟨δΩ⟩
            (averaged,) = step.fuse(own)
            new = self._add_to_forecast(step, branch, covs, self._omega * averaged)
        else:
            total = self._average_information(step, branch, covs, own)
            new = self._find_gaussians(step, branch, covs, total)
        means, covs = new
        return self._end(step, means, symmetrise(covs))

    @property
    def _omega(self) -> float:
        """The weight ω of averaged information; the average times A is the sum."""
        return float(self.n_agents) if self.weight is None else self.weight

    def _average_information(
        self, step: Step[GaussianState], means: Array, covs: Array, own: Array
    ) -> Array:
        """Return the packed information of forecasts and observations after the consensus.

        `own` (*runs, A, n) is δΩ, the information of each agent's own observations, packed as n
        numbers; Ω is that of its forecast.
        """

        # `apply` also passes an array that all rows share and a generator, not needed here.
        def compute(m: Array, p: Array, *_: object) -> tuple[Array]:
            return (pack_information(*to_information(m, p)),)

        agents = range(self.n_agents)
        (prior,) = step.apply(compute, (means, covs), (own,), agents)
        if self.average == "weighted":
            # A ⟨Ω / A + δΩ⟩
            (averaged,) = step.fuse(prior / self.n_agents + own)
            return self.n_agents * averaged
        # Both are averaged in the same messages, side by side: ⟨Ω⟩ + ω ⟨δΩ⟩.
        (averaged,) = step.fuse(np.concatenate([prior, own], axis=-1))
        half = own.shape[-1]
        return np.asarray(averaged[..., :half] + self._omega * averaged[..., half:])

    def _find_gaussians(
        self, step: Step[GaussianState], means: Array, covs: Array, total: Array
    ) -> tuple[Array, ...]:
        """Return the Gaussians that have this packed information (*runs, A, n).

        An agent whose information matrix is not definite fails, and keeps the given moments.
        """
        d = means.shape[-1]

        def compute(numbers: Array, *_: object) -> tuple[Array, Array]:
            return from_information(*unpack_information(numbers, d))

        return step.apply(compute, (total,), (means, covs), range(self.n_agents))

    def _add_to_forecast(
        self, step: Step[GaussianState], means: Array, covs: Array, gained: Array
    ) -> tuple[Array, ...]:
        """Return the Gaussians with packed information (*runs, A, n) added.

        Components may be known constants, whose variance is zero: no covariance is inverted.
        """
        d = means.shape[-1]

        def compute(
            m: Array, p: Array, numbers: Array, *_: object
        ) -> tuple[Array, Array]:
            # The information matrix J and vector v that are added: P⁺ = (I + P J)⁻¹ P and
            # m⁺ = m + P⁺ (v - J m).
            j, v = unpack_information(numbers, d)
            new = symmetrise(np.asarray(np.linalg.solve(np.eye(d) + p @ j, p)))
            change = new @ (v[..., None] - j @ m[..., None])
            return m + change[..., 0], new

        return step.apply(
            compute, (means, covs, gained), (means, covs), range(self.n_agents)
        )

    def _add_information(
        self,
        gained: Array,
        means: Array,
        branch: Array,
        covs: Array,
        group: Received,
        step: Step[GaussianState],
    ) -> None:
        """Write Hᵀ R⁻¹ [H, y - h(m) + H m] of a group's own observations into `gained`.

        The mean m is that of `branch` in the linear term: `means` with angles shifted by whole
        periods.
        """
        # The index of the group's agents in arrays (*runs, A, ...)
        rows = group.rows
        mean = means[..., rows, :]
        cov = covs[..., rows, :, :]
        result = self._innovate(mean, cov, group, step)
        missing = np.isnan(result.innovation)
        # A missing number has a row of zeros in H, and row and column of the identity in R.
        slope = np.where(missing[..., None], 0.0, result.slope)
        innovation = np.where(missing, 0.0, result.innovation)
        noise = result.group.noise
        if result.extra_cov is not None:
            noise = noise + result.extra_cov
        is_pair = ~missing[..., :, None] & ~missing[..., None, :]
        noise = np.where(is_pair, noise, np.eye(noise.shape[-1]))
        # z = y - h(m) + H m is linear in the state.
        z = innovation[..., None] + slope @ branch[..., rows, :, None]
        right = np.concatenate([slope, z], axis=-1)
        gained[..., rows, :, :] = slope.mT @ solve_definite(noise, right)
