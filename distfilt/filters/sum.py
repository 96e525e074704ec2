"""Gaussian sum filters: a bank of Kalman filters, weighted by how well they predict."""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Annotated, Any, ClassVar, NamedTuple

import numpy as np

from ..gaussians.single import condition
from ..linalg import cholesky, log_det, log_sum_exp, quadratic_form, symmetrise
from ..periods import fold, settle
from ..validation import Array, Rng
from .base import SensorFilter
from .gaussian import GaussianFamily, GaussianState
from .options import SharesObservations
from .particle import select_visible
from .priors import Prior, prior_mixtures
from .record import Summary
from .resets import Reset
from .states import SensorState, State
from .step import Received, Step

__all__ = ["GaussianSumFilter", "GaussianSumState"]

_MIN_LOG = -700.0
"""The smallest logarithm of a weight; its exponential is still above zero."""


@dataclass(frozen=True, eq=False, repr=False)
class GaussianSumState(SensorState):
    """The agents' Gaussian mixtures between two steps, of equally many components.

    Parameters
    ----------
    t, ledger, rng, rejected, failed, pending
        As for :class:`~distfilt.filters.SensorState`; `rng` is None, as nothing is drawn.
    component_means : ndarray, (*runs, A, L, d)
    component_covariances : ndarray, (*runs, A, L, d, d)
    log_weights : ndarray, (*runs, A, L)

    Examples
    --------
    >>> from distfilt.network import Ledger
    >>> state = GaussianSumState(
    ...     0.0,
    ...     Ledger.empty(1),
    ...     None,
    ...     np.array([[[0.0], [2.0]]]),
    ...     np.ones((1, 2, 1, 1)),
    ...     np.log([[0.5, 0.5]]),
    ... )
    >>> state.means, state.covariances
    (array([[1.]]), array([[[2.]]]))
    """

    component_means: Annotated[Array, "... A L d"]
    component_covariances: Annotated[Array, "... A L d d"]
    log_weights: Annotated[Array, "... A L"]

    belief_field = "component_means", (..., "A", "L", "d")

    @property
    def dim(self) -> int:
        """Size d of one state."""
        return int(self.component_means.shape[-1])

    @cached_property
    def weights(self) -> Array:
        """The weights of the components, (*runs, A, L)."""
        return np.asarray(np.exp(self.log_weights))

    @property
    def means(self) -> Array:
        """Means of the whole mixtures, (*runs, A, d)."""
        return self._moments.mean

    @property
    def covariances(self) -> Array:
        """Covariances of the whole mixtures, (*runs, A, d, d)."""
        return self._moments.cov

    @property
    def _moments(self) -> _Moments:
        return _mix(self.weights, self.component_means, self.component_covariances)


@dataclass(frozen=True, eq=False)
class GaussianSumFilter(GaussianFamily, SharesObservations[Any]):
    r"""A bank of Kalman filters for each agent, for a belief with several peaks or curvature.

    The prior is a mixture. Every component is forecast and updated as by a
    :class:`GaussianFilter`, and its weight multiplied by the density of the observations under
    its own prediction,

    .. math:: w_l^+\propto w_l\,N(\mathbf y;\mathbf h(\mathbf m_l),
        \mathbf H_l\mathbf P_l\mathbf H_l^\top+\mathbf R)

    For linear models and sensors the mixture is exact. The narrower the components, the closer to
    exact it is for others. Their number stays the same.

    Parameters
    ----------
    model, sensors, graph, gate_probability, faults, names
        As for :class:`~distfilt.filters.SensorFilter`. The gate tests an observation against the
        whole mixture's prediction.
    share_observations, hops, on_error, record_evidence
        As in :mod:`distfilt.filters.options`.
    linearization, kappa, inflation
        As for :class:`GaussianFilter`.

    Notes
    -----
    D. L. Alspach and H. W. Sorenson, IEEE Transactions on Automatic Control 17 (1972) 439-448. A
    prior of several components comes from :func:`distfilt.mixtures.split_gaussian`. A component
    whose prediction of an observation does not exist (NaN) loses its weight, unless none can
    predict it. Agents that fuse mixtures: :class:`MixtureFilter`.

    Examples
    --------
    Is it left or right of a sensor that measures the distance?

    >>> from distfilt.mixtures import split_gaussian
    >>> from distfilt.models import Model
    >>> from distfilt.sensors import Sensor
    >>> still = Model(1, lambda x, t, dt: x, lambda t, dt: np.zeros((1, 1)))
    >>> f = GaussianSumFilter(still, [Sensor(1, np.abs, [[0.01]])])
    >>> prior = split_gaussian([0.2], [[1.0]], parts=20)
    >>> state = f.step(f.start(prior), 0.0, [[1.0]])
    >>> is_left = state.component_means[0, :, 0] < 0
    >>> # By Bayes' rule 1 / (1 + exp(0.4)) = 0.40
    >>> round(float(state.weights[0, is_left].sum()), 2)
    0.4
    """

    state_class: ClassVar[type[State]] = GaussianSumState

    def initial_state(
        self, prior: Prior, runs: tuple[int, ...], rng: Rng | None
    ) -> dict[str, object]:
        """Return the components of the prior, the same for all runs."""
        mixtures = prior_mixtures(
            prior, self.model.dim, self.n_agents, periods=self.periods
        )
        counts = {mixture.n_components for mixture in mixtures}
        if len(counts) > 1:
            raise ValueError(
                "prior must have equally many components for all agents, got "
                f"{sorted(counts)}"
            )
        # One row of components for each agent; a weight of zero gets a finite logarithm.
        means = np.array([mixture.means for mixture in mixtures])
        weights = np.array([mixture.weights for mixture in mixtures])
        arrays = {
            "component_means": self._settle(means, weights),
            "component_covariances": np.array([mixture.covs for mixture in mixtures]),
            "log_weights": np.log([np.exp(_MIN_LOG) + m.weights for m in mixtures]),
        }
        return {
            name: np.broadcast_to(value, (*runs, *value.shape)).copy()
            for name, value in arrays.items()
        }

    def reset_belief(self, state: Any, reset: Reset) -> Any:
        """Refuse a reset, for which mixtures have no rule."""
        return SensorFilter.reset_belief(self, state, reset)

    def next_state(self, step: Step[Any]) -> Any:
        """Forecast all components, condition and weight them by the observations."""
        means, covs = self._forecast_components(step)
        # Equal weights in failed runs; a copy, since groups of agents are weighted in place
        log_weights = step.keep_failed(step.state.log_weights, old=0.0).copy()
        for _time_index, group in step.received():
            self._condition_components(means, covs, log_weights, group, step)
        # Angles of a mixture's components near each other, with their mean in [-period/2, period/2)
        return step.end(
            component_means=self._settle(means, np.exp(log_weights)),
            component_covariances=symmetrise(covs),
            log_weights=log_weights,
        )

    def _settle(self, means: Array, weights: Array) -> Array:
        """Shift angles of means (..., L, d) of mixtures by whole periods.

        Each comes within half a period of the mixture's circular mean; then all are shifted alike,
        so that their weighted mean is in [-period/2, period/2).
        """
        if not self.periods:
            return means
        return settle(fold(means, self.periods, weights), self.periods, weights)

    def summarize(self, state: Any) -> Summary:
        """Return moments of the mixtures, and the effective numbers of their components."""
        mean, cov = _mix(
            state.weights, state.component_means, state.component_covariances
        )
        mean = state.mask_failed(mean)
        cov = state.mask_failed(cov)
        # N_eff = 1 / Σ w²
        size = state.mask_failed(1 / (state.weights**2).sum(axis=-1))
        variance = np.diagonal(cov, axis1=-2, axis2=-1)
        return Summary(mean, variance, cov, numbers={"effective_size": size})

    def _forecast_components(self, step: Step[Any]) -> tuple[Array, Array]:
        """Return the components' forecasts, (*runs, A, L, ...)."""
        state = step.state
        # A bank of Gaussian filters: the L components count as runs, with axes (*runs, L, A, ...).
        # The bank's state needs no generator, and its joint moments are the present ones alone.
        bank = copy(step)
        bank.state = GaussianState.construct(
            state.t,
            state.ledger,
            rng=None,
            joint_means=state.component_means.swapaxes(-3, -2),
            joint_covariances=state.component_covariances.swapaxes(-4, -3),
            dim=state.dim,
        )
        means, covs = self._forecast(bank)
        # The axis of components behind that of agents again, in arrays that may be changed in place
        means = np.array(means.swapaxes(-3, -2))
        covs = np.array(covs.swapaxes(-4, -3))
        # Failed runs get harmless Gaussians, so that the batch can go on.
        means = step.check_forecast(means, old=0.0)
        return means, step.check_forecast(covs, old=np.eye(state.dim))

    def _condition_components(
        self,
        means: Array,
        covs: Array,
        log_weights: Array,
        group: Received,
        step: Step[GaussianSumState],
    ) -> None:
        """Condition and weight the components of a group's agents, in place.

        The arrays are those of all agents, (*runs, A, L, ...).
        """
        # The index of the group's agents in these
        rows = group.rows
        mean = means[..., rows, :, :]
        cov = covs[..., rows, :, :, :]
        logs = log_weights[..., rows, :]
        predictions = self._predict_components(mean, cov, group)
        predicted = predictions.values
        slope = predictions.slopes
        # Which numbers a component cannot predict, (*runs, G, L, M), and which none can
        is_blind = np.isnan(predicted)
        is_unseen = np.asarray(is_blind.all(axis=-2))
        reason = "no component can see"
        if self.linearization == "extended":
            # Where all derivatives are zero no component moves, and if all predict the same, their
            # weights stay too: the observation has no effect.
            is_flat = ~slope.any(axis=(-3, -1)) & (np.ptp(predicted, axis=-2) == 0)
            if is_flat.any():
                reason = "the sensor's derivative is zero at every component"
            is_unseen |= is_flat
        step.note_unseen(group, is_unseen, reason)
        # The gate tests the whole mixture's prediction: Σ w_l N(y; h(m_l), H_l P_l H_lᵀ).
        predicted_cov = slope @ cov @ slope.mT + predictions.extra_covs
        group = step.gate(
            group,
            _predict_moments,
            predicted,
            np.exp(logs),
            predicted_cov,
            near_observed=True,
            is_gaussian=False,
        )
        target = group.target[..., None, :]
        innovation = target - predicted
        # A component that cannot see an observation contradicts it, if others can see it.
        is_seen = ~is_blind.all(axis=-2, keepdims=True) & ~np.isnan(target)
        contradicts = (is_blind & is_seen).any(axis=-1)
        # A covariance for each agent serves all of the agent's components.
        noise = group.noise[:, None] if group.noise.ndim == 3 else group.noise
        noise = noise + predictions.extra_covs
        prior = np.where(contradicts, _MIN_LOG, logs)
        # All components of all agents and runs at once, or run by run if one fails.
        new_means, new_covs, new_logs, log_likelihoods = step.apply(
            _condition_bank,
            (mean, cov, prior, innovation, slope, noise),
            (mean, cov, logs, np.zeros(logs.shape[:-1])),
            group.agents,
        )
        means[..., rows, :, :] = new_means
        covs[..., rows, :, :, :] = new_covs
        log_weights[..., rows, :] = new_logs
        if step.scores:
            step.add_log_likelihood(log_likelihoods, group.agents)

    def _predict_components(
        self, mean: Array, cov: Array, group: Received
    ) -> _Predictions:
        """Predict a group's observations by every component."""
        # Components count as runs, with axes (*runs, L, G, ...), so that a group predicts for each.
        mean = np.ascontiguousarray(mean.swapaxes(-3, -2))
        cov = np.ascontiguousarray(cov.swapaxes(-4, -3))
        # The group's target for each component.
        shape = (*mean.shape[:-1], group.target.shape[-1])
        wide = group.with_target(np.broadcast_to(group.target[..., None, :, :], shape))
        predicted, slope, extra = self._linearize(
            partial(wide.predict, branch="first"),
            wide.jacobian,
            mean,
            cov,
            is_linear=group.linear,
        )
        # Where the derivative does not exist the sensor cannot be used either.
        is_blind = np.asarray(np.isnan(slope).any(axis=-1))
        predicted = np.where(is_blind, np.nan, predicted)
        slope = np.where(is_blind[..., None], 0.0, slope)
        if extra is None:
            extra = np.zeros((*shape, shape[-1]))
        # The axis of components behind that of agents again
        return _Predictions(
            values=predicted.swapaxes(-3, -2),
            slopes=slope.swapaxes(-4, -3),
            extra_covs=extra.swapaxes(-4, -3),
        )


class _Predictions(NamedTuple):
    """Predictions (*runs, G, L, M) by the components of G agents, slopes and extra covariances.

    The latter are the covariances beyond the linear part: zero for the extended filter.
    """

    values: Array
    slopes: Array
    extra_covs: Array


class _Moments(NamedTuple):
    """Mean (..., d) and covariance (..., d, d) of mixtures."""

    mean: Array
    cov: Array


def _condition_bank(
    mean: Array,
    cov: Array,
    logs: Array,
    innovation: Array,
    slope: Array,
    noise: Array,
    *_others: object,
) -> tuple[Array, ...]:
    """Condition components (..., L, d) on their innovations.

    Returns the new means and covariances, the normalised log-weights, and log p(y), (...). The
    shared array and the generator that :meth:`Step.apply` adds are not needed.
    """
    missing = np.asarray(np.isnan(innovation))
    is_pair = ~missing[..., :, None] & ~missing[..., None, :]
    # Missing numbers get a zero innovation and rows of the identity in S, which add nothing to
    # log p(y).
    innovation_cov = slope @ cov @ slope.mT + noise
    unit = np.eye(innovation.shape[-1])
    lower = cholesky(np.where(is_pair, innovation_cov, unit))
    # log N(r; 0, S) of each component
    squares = quadratic_form(lower, np.where(missing, 0.0, innovation))
    count = (~missing).sum(axis=-1)
    log_density = -0.5 * (squares + log_det(lower) + count * np.log(2 * np.pi))
    # w_l N(r; 0, S_l), and its sum: the density of the observations
    joint = logs + log_density
    total = log_sum_exp(joint)
    new_mean, new_cov = condition(mean, cov, innovation, slope, noise)
    return new_mean, new_cov, np.maximum(joint - total, _MIN_LOG), total[..., 0]


def _mix(weights: Array, means: Array, covs: Array) -> _Moments:
    """Return moments of mixtures: m̄ = Σ w m, and Σ w (P + (m - m̄)(m - m̄)ᵀ).

    Weights are (..., L), means (..., L, d), and covariances P (..., L, d, d).
    """
    mean = (weights[..., None, :] @ means)[..., 0, :]
    anomalies = means - mean[..., None, :]
    # The sums over the L components, of the means' spread and of the covariances
    spread = (weights[..., None, :] * anomalies.mT) @ anomalies
    within = (weights[..., None, None] * covs).sum(axis=-3)
    return _Moments(mean, within + spread)


def _predict_moments(predicted: Array, weights: Array, covs: Array) -> _Moments:
    """Return moments of the predictions of the components that can see; NaN if none can."""
    predicted, weights = select_visible(predicted, weights)
    return _mix(weights, predicted, covs)
