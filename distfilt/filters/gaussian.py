"""A network of Kalman filters, extended or unscented: forecast, assimilate, fuse the Gaussians."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from contextlib import suppress
from dataclasses import KW_ONLY, dataclass
from functools import cached_property, partial
from typing import Annotated, ClassVar, Literal, NamedTuple, Self

import numpy as np

from ..derivatives import needs_differences
from ..gaussians.single import condition, unscented_points
from ..linalg import (
    EPS,
    cholesky,
    deviations,
    factor,
    identity,
    solve_lower,
    solve_semidefinite,
    symmetrise,
)
from ..models import LinearModel
from ..periods import fold, step_members, warn_of_wrapping, wrap_differences
from ..validation import (
    Array,
    Bounds,
    NonNegativeFloat,
    PositiveInt,
    Rng,
    all_finite,
    format_number,
)
from .base import SensorFilter
from .bridge import insert_gaussian
from .options import (
    ExchangesAtIntervals,
    FusesBeliefs,
    IsolatesRuns,
    KeepsPast,
    ScoresObservations,
    SharesObservations,
)
from .priors import Prior, moments_by_agent
from .record import Summary
from .resets import Reset, reset_gaussian
from .states import SensorState, State
from .step import Received, Step

__all__ = ["GaussianFamily", "GaussianFilter", "GaussianState"]

_MAX_SHIFT = 1e6
"""The longest step of an iterated update, in standard deviations of the forecast."""


@dataclass(frozen=True, eq=False, repr=False)
class GaussianState(SensorState):
    """The agents' Gaussians between two steps.

    Parameters
    ----------
    t, ledger, rng, rejected, failed, pending
        As for :class:`~distfilt.filters.SensorState`; `rng` is None, as nothing is drawn.
    joint_means : ndarray, (*runs, A, D)
        Means of the present state and of the earlier ones that are kept, latest first:
        D = d (1 + number of earlier times).
    joint_covariances : ndarray, (*runs, A, D, D)
        Their joint covariance.
    dim : int
        Size d of one state.
    history : tuple of float
        The earlier times, latest first.

    Examples
    --------
    >>> from distfilt.network import Ledger
    >>> state = GaussianState(
    ...     0.0, Ledger.empty(2), None, np.zeros((2, 1)), np.ones((2, 1, 1)), 1
    ... )
    >>> state.means.shape, state.runs
    ((2, 1), ())
    """

    joint_means: Annotated[Array, "... A D"]
    joint_covariances: Annotated[Array, "... A D D"]
    dim: PositiveInt

    belief_field = "joint_covariances", (..., "A", "D", "D")

    @property
    def times(self) -> tuple[float, ...]:
        """The earlier times whose beliefs are kept, oldest first."""
        times = [entry for entry in self.history if not isinstance(entry, tuple)]
        return tuple(times[::-1])

    @property
    def lagged_states(self) -> tuple[Self, ...]:
        """A state for each of the earlier `times`, given all observations up to now."""
        states = []
        n = len(self.history)
        # The present state is block 0, the latest earlier one block 1, the oldest block n.
        for k, t in zip(range(n, 0, -1), self.times, strict=True):
            block = slice(k * self.dim, (k + 1) * self.dim)
            mean = self.joint_means[..., block]
            cov = self.joint_covariances[..., block, block]
            states.append(
                self.replace(t=t, history=(), joint_means=mean, joint_covariances=cov)
            )
        return tuple(states)

    @property
    def means(self) -> Array:
        """Means of the present state, (*runs, A, d)."""
        return self.joint_means[..., : self.dim] if self.history else self.joint_means

    @property
    def covariances(self) -> Array:
        """Covariances of the present state, (*runs, A, d, d)."""
        if not self.history:
            return self.joint_covariances
        return self.joint_covariances[..., : self.dim, : self.dim]


class _Linearization(NamedTuple):
    """A function of a Gaussian as value + slope (x - mean), with an error of that covariance.

    The extra covariance is that of the values of unscented points beyond the linear part, or None.
    """

    value: Array
    slope: Array
    extra_cov: Array | None


class _Innovation(NamedTuple):
    """A group's observations beside their predictions.

    The group lacks the observations that the gate rejects. The innovation y - h(m) is NaN where a
    number is missing or the sensor cannot see it. Slope and extra covariance are those of the
    predictions, as in :class:`_Linearization`.
    """

    group: Received
    innovation: Array
    slope: Array
    extra_cov: Array | None


@dataclass(frozen=True, eq=False)
class GaussianFamily(
    SensorFilter[GaussianState],
    IsolatesRuns[GaussianState],
    ScoresObservations[GaussianState],
):
    """The common part of filters whose agents hold Gaussians: forecast and update.

    Families differ in what the agents exchange.
    """

    _: KW_ONLY
    linearization: Literal["extended", "unscented"] = "extended"
    kappa: NonNegativeFloat = 1.0
    inflation: Annotated[float, Bounds(at_least=0.5)] = 1.0

    state_class: ClassVar[type[State]] = GaussianState
    batched_summary: ClassVar[bool] = True

    @cached_property
    def iterations(self) -> int:
        """How often an update linearises its sensors; once in most families."""
        return 1

    def check_state(self, state: GaussianState) -> None:
        """Refuse a state that is not of this filter."""
        super().check_state(state)
        # The joint state may be longer, by the past.
        if state.dim != self.model.dim:
            raise ValueError(
                f"state must have sizes {(self.model.dim,)} an agent, got {(state.dim,)}"
            )

    def initial_state(
        self, prior: Prior, runs: tuple[int, ...], rng: Rng | None
    ) -> dict[str, object]:
        """Return the prior's mean and covariance, the same for all runs."""
        d = self.model.dim
        mean, cov = moments_by_agent(prior, d, self.n_agents, periods=self.periods)
        lead = (*runs, self.n_agents)
        # Angles in [-period/2, period/2)
        mean = wrap_differences(mean, self.periods)
        # Without a past the joint state is the present one.
        return {
            "joint_means": np.broadcast_to(mean, (*lead, d)).copy(),
            "joint_covariances": np.broadcast_to(cov, (*lead, d, d)).copy(),
            "dim": d,
        }

    def reset_belief(self, state: GaussianState, reset: Reset) -> GaussianState:
        """Return the state with a new belief about some components."""
        return reset_gaussian(state, reset)

    def next_state(self, step: Step[GaussianState]) -> GaussianState:
        """Forecast, condition on the received observations, fuse.

        Warns
        -----
        RuntimeWarning
            If a standard deviation after the fusion is below the rounding of its mean.
        """
        means, covs = self._check_forecast(step)
        # A forecast's covariances are symmetric up to rounding. The update, in Joseph's form, makes
        # those of a group's agents exactly symmetric; after a group of all agents all are.
        is_symmetric = False
        # Groups of agents with equally many observations of one time, oldest first; the index is
        # that of this time among those kept, of which the last is now.
        for time_index, group in step.received():
            means, covs = self._condition(means, covs, time_index, group, step)
            is_symmetric = is_symmetric or len(group.agents) == self.n_agents
        # A run that failed here gets the identity, since the fusion factors all covariances.
        covs = step.keep_failed(covs, old=identity(means.shape[-1]))
        if step.has_fusion:
            means, covs = self._fuse(means, covs, step)
            is_symmetric = False
        if not is_symmetric or step.any_failed:
            covs = symmetrise(covs)
        return self._end(step, means, covs)

    def _check_forecast(self, step: Step[GaussianState]) -> tuple[Array, Array]:
        """Return the forecast's joint moments, (*runs, A, D) and (*runs, A, D, D).

        Failed runs get a standard normal, so that the batch can go on.
        """
        means, covs = self._forecast(step)
        if all_finite(means) and all_finite(covs) and not step.any_failed:
            return means, covs
        unit = identity(means.shape[-1])
        means = step.check_forecast(means, old=0.0)
        return means, step.check_forecast(covs, old=unit)

    def _end(
        self, step: Step[GaussianState], means: Array, covs: Array, **fields: Array
    ) -> GaussianState:
        """Return the state after the step with these joint moments, and a family's own fields.

        The covariances are symmetric to the last digit.
        """
        if self.periods:
            # Angles of the means in [-period/2, period/2); covariances do not depend on that. The
            # joint mean has the means of all times one behind the other, with the same periods.
            n_times = means.shape[-1] // self.model.dim
            means = wrap_differences(means, self.periods * n_times)
        # The joint moments begin with the present and go back in time, and so does the history. A
        # step lists its times from the oldest on.
        return step.end(
            joint_means=means,
            joint_covariances=covs,
            dim=step.state.dim,
            history=step.times[::-1],
            **fields,
        )

    def summarize(self, state: GaussianState) -> Summary:
        """Return means and covariances of the present state."""
        mean = state.mask_failed(state.means)
        cov = state.mask_failed(state.covariances)
        return Summary(mean, np.diagonal(cov, axis1=-2, axis2=-1), cov)

    def _forecast(self, step: Step[GaussianState]) -> tuple[Array, Array]:
        """Return the joint mean and covariance of the forecast and the earlier states kept."""
        state = step.state
        model = step.model
        dt = step.dt
        if not dt:
            return state.joint_means.copy(), state.joint_covariances.copy()
        d = state.dim
        # Unscented points may lie on both sides of an angle's cut after the step, where their mean
        # is wrong; a single point cannot.
        has_points = self.linearization == "unscented"
        # `move` maps points (..., N, d) to those after the step.
        if self.periods or (self.notices_wrapping and has_points):
            move = partial(self._step_points, step)
        else:
            move = partial(model.step, t=state.t, dt=dt)
        moved = self._linearize(
            move,
            partial(self._differentiate_step, step),
            state.means,
            state.covariances,
            is_linear=isinstance(model, LinearModel),
        )
        mean = moved.value
        # P = F P Fᵀ + Q, with a contiguous F, which multiplies faster.
        slope = np.ascontiguousarray(moved.slope)
        old = state.joint_covariances
        # Q at each agent's mean, or one matrix for all
        if model.has_state_noise:
            noise = model.noise_at(state.means, state.t, dt)
        else:
            noise = model.Q(state.t, dt)
        if moved.extra_cov is not None:
            noise = noise + moved.extra_cov
        cov = slope @ state.covariances @ slope.mT + noise
        # Of the earlier states those that the step still keeps; they come first in the joint state
        # before the step, which begins with the state's own time.
        size = len(step.times) * d
        if size:
            # The past keeps its covariance; its cross-covariance with the present becomes F P.
            mean = np.concatenate([mean, state.joint_means[..., :size]], axis=-1)
            cross = slope @ old[..., :d, :size]
            joint = np.empty((*mean.shape, d + size))
            joint[..., :d, :d] = cov
            joint[..., :d, d:] = cross
            joint[..., d:, :d] = cross.mT
            joint[..., d:, d:] = old[..., :size, :size]
            cov = joint
        if self.inflation != 1.0:
            # A factor of the present standard deviations: its own block gets the square.
            cov[..., :d, :] *= self.inflation
            cov[..., :, :d] *= self.inflation
        return mean, cov

    def _differentiate_step(
        self, step: Step[GaussianState], means: Array, covs: Array
    ) -> Array:
        """Return the derivative of the model's step at means (..., d)."""
        model = step.model
        std = None
        if not isinstance(model, LinearModel) and needs_differences(model):
            # Differences are scaled by the state's standard deviations.
            std = deviations(covs)
        return model.jacobian(means, step.state.t, step.dt, std=std)

    def _step_points(self, step: Step[GaussianState], points: Array) -> Array:
        """Move points (..., N, d) by the model without noise; angles are near each other then."""
        t = step.state.t
        moved = step_members(step.model, points, t, step.dt)
        # Only of several points some may have wrapped and others not.
        if self.notices_wrapping and points.shape[-2] > 1:
            warn_of_wrapping(step.model, points, moved, t, step.dt)
        return moved

    def _linearize(
        self,
        function: Callable[[Array], Array],
        jacobian: Callable[[Array, Array], Array],
        mean: Array,
        cov: Array,
        *,
        is_linear: bool,
    ) -> _Linearization:
        """Replace a function of a Gaussian by a linear one.

        ``function`` maps points (..., N, d) to values (..., N, m). ``jacobian(mean, cov)`` is the
        derivative at the mean, (..., m, d); finite differences take their step from the covariance.
        """
        if is_linear or self.linearization == "extended":
            # For a linear function unscented points would give the same.
            value = function(mean[..., None, :])[..., 0, :]
            return _Linearization(value, jacobian(mean, cov), extra_cov=None)
        # P = L Lᵀ; the divisor is L, with ones on the diagonal in columns of zeros. These belong to
        # components without variance: their points do not differ, and their slope becomes zero.
        root, divisor = _factor_covariance(cov)
        d = mean.shape[-1]
        points, weights = unscented_points(mean, root, kappa=self.kappa)
        values = function(points)
        value = weights @ values
        anomalies = values - value[..., None, :]
        # Opposite points lie ±√(d+κ) columns of the root L from the mean, so that half their
        # differences are (H L)ᵀ √(d+κ). H follows from Lᵀ Hᵀ = (H L)ᵀ with upper triangular Lᵀ.
        ahead = values[..., 1 : d + 1, :]
        behind = values[..., d + 1 :, :]
        scaled_slope = (ahead - behind) / (2 * np.sqrt(d + self.kappa))
        slope = solve_lower(divisor, scaled_slope, transposed=True).mT
        # The covariance of the values beyond the linear part H P Hᵀ.
        total = (weights[:, None] * anomalies).mT @ anomalies
        extra = total - scaled_slope.mT @ scaled_slope
        if not all_finite(extra):
            # Components of the value that some point cannot see are NaN, and so is their slope: an
            # update leaves them out. NaN would spoil the covariance of the others.
            extra = np.where(np.isnan(extra), 0.0, extra)
        return _Linearization(value, slope, extra)

    def _condition(
        self,
        means: Array,
        covs: Array,
        time_index: int,
        group: Received,
        step: Step[GaussianState],
    ) -> tuple[Array, Array]:
        """Return all joint moments, with those of a group conditioned on its observations.

        The observations are of the time with the index `time_index` among those kept, oldest
        first. They change the beliefs about all times.
        """
        d = self.model.dim
        # The index of the group's agents in arrays (*runs, A, ...)
        rows = group.rows
        is_part = len(group.agents) < means.shape[-2]
        joint_mean = means
        joint_cov = covs
        if is_part:
            joint_mean = means[..., rows, :]
            joint_cov = covs[..., rows, :, :]
        mean = joint_mean
        cov = joint_cov
        if mean.shape[-1] > d:
            # The latest time comes first in the joint state, but has the last index.
            first = (len(step.times) - time_index) * d
            block = slice(first, first + d)
            mean = joint_mean[..., block]
            cov = joint_cov[..., block, block]
        result = self._innovate(mean, cov, group, step)
        group = result.group
        innovation = result.innovation
        slope = result.slope
        if self.iterations > 1 and not group.linear:
            innovation, slope = self._relinearize(
                mean, cov, innovation, slope, group, step
            )
        if joint_mean.shape[-1] > d:
            # Zero slope in the other times' states.
            joint_slope = np.zeros((*slope.shape[:-1], joint_mean.shape[-1]))
            joint_slope[..., block] = slope
            slope = joint_slope
        arrays: tuple[Array, ...] = (joint_mean, joint_cov, innovation, slope)
        if result.extra_cov is not None:
            # S = H P Hᵀ + R, where the extra covariance of the unscented points counts as noise.
            arrays = (*arrays, group.noise + result.extra_cov)
        new_mean, new_cov = step.apply(
            _condition_rows,
            arrays,
            (joint_mean, joint_cov),
            group.agents,
            shared=group.noise,
        )
        if not is_part:
            return new_mean, new_cov
        # The mean may be an array that the model keeps; the covariance is the step's own.
        means = means.copy()
        means[..., rows, :] = new_mean
        covs[..., rows, :, :] = new_cov
        return means, covs

    def _relinearize(
        self,
        mean: Array,
        cov: Array,
        innovation: Array,
        slope: Array,
        group: Received,
        step: Step[GaussianState],
    ) -> tuple[Array, Array]:
        """Return innovations and slopes of sensors linearised about the updated mean, repeatedly.

        Each is a step of Gauss and Newton to the maximum of the posterior density.
        """
        for _ in range(self.iterations - 1):
            x, _cov = step.apply(
                _condition_rows,
                (mean, cov, innovation, slope),
                (mean, cov),
                group.agents,
                shared=group.noise,
            )
            # A step out of the region where the belief has any probability is not taken; the other
            # rows of a batch go on.
            is_near = np.abs(x - mean) <= _MAX_SHIFT * deviations(cov)
            x = np.where(is_near.all(axis=-1, keepdims=True), x, mean)
            predicted = group.predict(x[..., None, :], branch="first")[..., 0, :]
            new_slope = group.jacobian(x, cov)
            # y - h(x) - H (m - x): the innovation of the linearised sensor at the forecast
            shift = (new_slope @ (mean - x)[..., None])[..., 0]
            new = group.target - predicted - shift
            # A sensor that cannot see from there keeps its linearisation.
            is_blind = np.isnan(new)
            innovation = np.where(is_blind, innovation, new)
            slope = np.where(is_blind[..., None], slope, new_slope)
        return innovation, slope

    def _innovate(
        self, mean: Array, cov: Array, group: Received, step: Step[GaussianState]
    ) -> _Innovation:
        """Compare a group's observations with predictions by Gaussians (*runs, G, d).

        With the branch "first" predicted angles are shifted by whole periods, so that the first, or
        only, point's is within half a period of the observed value.
        """
        predicted, slope, extra = self._linearize(
            partial(group.predict, branch="first"),
            group.jacobian,
            mean,
            cov,
            is_linear=group.linear,
        )
        innovation = group.target - predicted
        is_complete = all_finite(innovation)
        if not group.linear:
            # Mostly everything is seen, and each number depends on the state: 0 < Σ H² < ∞.
            steepness = np.vecdot(slope, slope)
            is_steep = np.count_nonzero(steepness) == steepness.size
            if not (is_steep and all_finite(steepness) and is_complete):
                predicted = self._leave_out_unseen(predicted, slope, group, step)
                innovation = group.target - predicted

        if step.tests_innovations:

            def moments(_points: Array) -> tuple[Array, Array]:
                """Return the prediction's mean and covariance; the gate's points are not needed."""
                predicted_cov = slope @ cov @ slope.mT
                if extra is not None:
                    predicted_cov = predicted_cov + extra
                return predicted, predicted_cov

            group = step.gate(group, moments, predicted[..., None, :])
            innovation = group.target - predicted
        return _Innovation(group, innovation, slope, extra)

    def _leave_out_unseen(
        self,
        predicted: Array,
        slope: Array,
        group: Received,
        step: Step[GaussianState],
    ) -> Array:
        """Return predictions that are NaN where the sensor cannot see, and count these."""
        # Of each number (*runs, G, M): whether it has no prediction, or no finite derivative
        is_unseen = np.isnan(predicted)
        reason = "some point of a belief cannot see"
        if not all_finite(slope):
            is_unseen |= np.isnan(slope).any(axis=-1)
            predicted = np.where(is_unseen, np.nan, predicted)
        if self.linearization == "extended":
            reason = (
                "the sensor is at a singular point, where its derivative is zero or NaN"
            )
            # With a derivative of zero the number would not change the belief.
            is_unseen |= ~slope.any(axis=-1)
        if is_unseen.any():
            # Sensors that are likelihoods need no prediction and no derivative.
            for part in group.likelihoods:
                is_unseen[(..., *part.target_index)] = False
            step.note_unseen(group, is_unseen, reason)
        return predicted

    def _fuse(
        self, means: Array, covs: Array, step: Step[GaussianState]
    ) -> tuple[Array, Array]:
        """Fuse the present states; the past follows by its regression on them.

        >>> from types import SimpleNamespace
        >>> from distfilt.models import constant_velocity
        >>> f = GaussianFilter(constant_velocity(sigma=1.0), [None])
        >>> tiny = SimpleNamespace(t=1.0, fuse=lambda m, p: (m, 1e-40 * p))
        >>> with warnings.catch_warnings(action="error"):
        ...     f._fuse(np.ones((1, 4)), np.eye(4)[None], tiny)
        Traceback (most recent call last):
        RuntimeWarning: covariance after fusion is below rounding at t = 1 s: ...
        >>> wrong = SimpleNamespace(t=1.0, fuse=lambda m, p: (m, p - 2 * np.eye(4)))
        >>> f._fuse(np.ones((1, 4)), np.eye(4)[None], wrong)
        Traceback (most recent call last):
        ValueError: fusion must return a covariance, got a variance of -1
        """
        d = self.model.dim
        mean = means[..., :d]
        cov = symmetrise(covs[..., :d, :d])
        # Only the present marginal is fused. For it the agents' angles are brought near each other
        # by whole periods, which are taken back afterwards.
        common = fold(mean, self.periods) if self.periods else mean
        fused_mean, fused_cov = step.fuse(common, cov)
        fused_mean = fused_mean + (mean - common) if self.periods else fused_mean
        variance = fused_cov.diagonal(axis1=-2, axis2=-1)
        # Mostly no variance is negative, or below the rounding of its mean.
        if np.count_nonzero(variance < (EPS * fused_mean) ** 2):
            _check_fused(fused_mean, variance, step.t)
        if means.shape[-1] == d:
            return fused_mean, fused_cov
        # With the gain G = P_joint,now P_now⁻¹ of the regression on the present, and its changes Δm
        # and ΔP by the fusion: m + G Δm and P + G ΔP Gᵀ.
        gain = solve_semidefinite(cov, covs[..., :d, :]).mT
        shift = (gain @ (fused_mean - mean)[..., None])[..., 0]
        return means + shift, covs + gain @ (fused_cov - cov) @ gain.mT


@dataclass(frozen=True, eq=False)
class GaussianFilter(
    GaussianFamily,
    FusesBeliefs[GaussianState],
    SharesObservations[GaussianState],
    ExchangesAtIntervals[GaussianState],
    KeepsPast[GaussianState],
):
    """One Kalman filter per agent; for a linear model and linear sensors it is exact.

    Parameters
    ----------
    model, sensors, graph, gate_probability, faults, names
        As for :class:`~distfilt.filters.SensorFilter`.
    fusion, share_observations, hops, lag, on_error, exchange_interval, record_evidence
        As in :mod:`distfilt.filters.options`. The rule is a function
        ``fusion((means, covs), channel) -> (means, covs)``, such as
        :func:`distfilt.network.covariance_intersection`.
    linearization : {"extended", "unscented"}
        How a nonlinear model or sensor is made linear: by its derivative at the mean, or by
        2d + 1 points about it.
    kappa : float
        The unscented points lie :math:`\\sqrt{d+\\kappa}` standard deviations from the mean, at
        least 0, so that no weight is negative.
    inflation : float
        Factor of the forecast's standard deviations, at least 0.5; for 5 % it is 1.05.
    iterations : int
        How often an extended update linearises its sensors: about the forecast's mean first, then
        about the updated one. More than 1 is the iterated extended filter, for sensors that are
        accurate beside the curvature of their function (B. M. Bell and F. W. Cathey, IEEE
        Transactions on Automatic Control 38 (1993) 294-297).

    Examples
    --------
    >>> from distfilt.models import Model
    >>> from distfilt.network import covariance_intersection, graphs
    >>> from distfilt.sensors import component
    >>> walk = Model(1, lambda x, t, dt: x, lambda t, dt: dt * np.eye(1))
    >>> f = GaussianFilter(
    ...     walk,
    ...     [component([0], std=1.0), None],
    ...     graphs.path(2),
    ...     share_observations=False,
    ...     fusion=covariance_intersection,
    ... )
    >>> f.step(f.start(([0.0], [[4.0]])), 1.0, [[2.0], None]).means.ravel().round(3)
    array([1.429, 1.429])
    """

    _: KW_ONLY
    iterations: PositiveInt = 1

    belief_kind: ClassVar[str | None] = "gaussians"
    supports_agent_models: ClassVar[bool] = True

    def check_parts(self) -> None:
        """Refuse iterations of an update that has no derivative."""
        super().check_parts()
        if self.iterations > 1 and self.linearization == "unscented":
            raise ValueError(
                "iterations must be 1 for the linearization 'unscented', got "
                f"{self.iterations}"
            )

    def insert_time(self, state: GaussianState, t: float) -> GaussianState:
        """Return the state with a belief about a time between two that it keeps."""
        return insert_gaussian(self, state, t)


def _check_fused(mean: Array, variance: Array, t: float) -> None:
    """Refuse negative variances after a fusion, and warn of those below rounding."""
    # A variance that is negative by rounding alone is small beside the largest one.
    smallest = variance.min()
    if smallest < -1e-9 * np.abs(variance).max():
        raise ValueError(
            f"fusion must return a covariance, got a variance of {smallest:g}"
        )
    # A variance below (ε m)² cannot come from independent information.
    if ((variance > 0) & (variance < (EPS * mean) ** 2)).any():
        warnings.warn(
            f"covariance after fusion is below rounding at t = {format_number(t)} s: "
            "information is probably counted twice",
            RuntimeWarning,
            # The warning names a line five frames up, near the user's call.
            stacklevel=5,
        )


def _factor_covariance(cov: Array) -> tuple[Array, Array]:
    """Return the lower factor of covariances, and one with an inverse.

    The first has zero columns where a covariance is singular, the second ones on its diagonal.

    >>> _factor_covariance(np.diag([4.0, 0.0]))[0]
    array([[2., 0.],
           [0., 0.]])
    """
    with suppress(np.linalg.LinAlgError):
        root = cholesky(cov)
        return root, root
    root = factor(cov)
    std = np.sqrt(np.abs(np.diagonal(cov, axis1=-2, axis2=-1)))
    scale = std[..., :, None] * std[..., None, :]
    # The factor leaves out negative eigenvalues: then the product differs from the covariance.
    if not (np.abs(root @ root.mT - cov) <= 1e-9 * scale).all():
        raise np.linalg.LinAlgError("covariance must be positive semidefinite")
    return root, _fill_zero_columns(root)


def _fill_zero_columns(root: Array) -> Array:
    """Return a triangular factor with ones on its diagonal in the columns of zeros.

    Such a column is that of a known constant, or of a component that others determine: its points
    lie at the mean, and its derivative counts as zero.
    """
    is_zero = np.diagonal(root, axis1=-2, axis2=-1) == 0
    if not np.count_nonzero(is_zero):
        return root
    return np.asarray(root + np.where(is_zero[..., None], np.eye(root.shape[-1]), 0.0))


def _condition_rows(
    mean: Array,
    cov: Array,
    innovation: Array,
    slope: Array,
    noise: Array,
    *_others: object,
) -> tuple[Array, Array]:
    """Condition Gaussians, with the arguments that :meth:`Step.apply` passes.

    It passes its arrays, then the noise that all rows share, then a generator. So `noise` is the
    last of the arrays where they end with one for each row, and otherwise the shared one.
    """
    return condition(mean, cov, innovation, slope, noise)
