"""A network of Kalman filters, extended or unscented: forecast, assimilate, fuse the Gaussians."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import KW_ONLY, dataclass
from functools import partial
from typing import Annotated, Any, ClassVar, Literal, Self

import numpy as np

from ..gaussians.single import condition, unscented_points
from ..linalg import EPS, cholesky, deviations, solve_upper, symmetrise
from ..models import LinearModel
from ..validation import Array, Bounds, NonNegativeFloat, PositiveInt
from .base import SensorFilter
from .options import (
    ExchangesAtIntervals,
    FusesBeliefs,
    IsolatesRuns,
    KeepsPast,
    SharesObservations,
)
from .priors import Prior, prior_moments
from .record import Summary
from .states import SensorState
from .step import Received, Step

__all__ = ["GaussianFilter", "GaussianState"]


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
        return self.history[::-1]

    @property
    def lagged_states(self) -> tuple[Self, ...]:
        """A state for each of these times, given all observations up to now."""
        states = []
        n = len(self.history)
        for k, t in zip(range(n, 0, -1), self.times, strict=True):
            # The present state is the first block, the latest earlier one the second.
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
        return self.joint_means[..., : self.dim]

    @property
    def covariances(self) -> Array:
        """Covariances of the present state, (*runs, A, d, d)."""
        return self.joint_covariances[..., : self.dim, : self.dim]


@dataclass(frozen=True, eq=False)
class GaussianFilter(
    SensorFilter[GaussianState],
    FusesBeliefs[GaussianState],
    SharesObservations[GaussianState],
    ExchangesAtIntervals[GaussianState],
    KeepsPast[GaussianState],
    IsolatesRuns[GaussianState],
):
    """One Kalman filter per agent; for a linear model and linear sensors it is exact.

    Parameters
    ----------
    model, sensors, graph, gate_probability, faults, names
        As for :class:`~distfilt.filters.SensorFilter`.
    fusion, share_observations, lag, on_error, exchange_interval
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
    linearization: Literal["extended", "unscented"] = "extended"
    kappa: NonNegativeFloat = 1.0
    inflation: Annotated[float, Bounds(at_least=0.5)] = 1.0

    state_class: ClassVar[type[Any]] = GaussianState
    batched_summary: ClassVar[bool] = True
    belief_kind: ClassVar[str | None] = "gaussians"

    def check_state(self, state: GaussianState) -> None:
        """Refuse a state that is not of this filter."""
        super().check_state(state)
        # The joint state may be longer, by the past.
        if state.dim != self.model.dim:
            raise ValueError(
                f"state must have sizes {(self.model.dim,)} an agent, got {(state.dim,)}"
            )

    def initial_state(
        self, prior: Prior, runs: tuple[int, ...], rng: Any
    ) -> dict[str, Any]:
        """Return the prior's mean and covariance, the same for all agents and runs."""
        d = self.model.dim
        # Unscented points need a Cholesky factor.
        is_extended = self.linearization == "extended"
        definiteness = "semidefinite" if is_extended else "definite"
        mean, cov = prior_moments(prior, d, definiteness)
        lead = (*runs, self.n_agents)
        # Without a past the joint state is the present one.
        return {
            "joint_means": np.broadcast_to(mean, (*lead, d)).copy(),
            "joint_covariances": np.broadcast_to(cov, (*lead, d, d)).copy(),
            "dim": d,
        }

    def next_state(self, step: Step[GaussianState]) -> GaussianState:
        """Forecast, condition on the received observations, fuse.

        Warns
        -----
        RuntimeWarning
            If a standard deviation after the fusion is below the rounding of its mean.
        """
        means, covs = self._forecast(step)
        # Failed runs get a harmless Gaussian, so that the batch can go on.
        unit = np.eye(means.shape[-1])
        means = step.check_forecast(means, 0.0)
        covs = step.check_forecast(covs, unit)
        for place, group in step.received():
            self._condition(means, covs, place, group, step)
        # A run that failed here needs a covariance with a Cholesky factor in the fusion.
        covs = step.keep_failed(covs, unit)
        if step.has_fusion:
            means, covs = self._fuse(means, covs, step)
        return step.end(
            joint_means=means,
            joint_covariances=symmetrise(covs),
            dim=step.state.dim,
            history=step.times[::-1],
        )

    def summarize(self, state: GaussianState) -> Summary:
        """Return means and covariances of the present state."""
        mean = state.mask_failed(state.means)
        cov = state.mask_failed(state.covariances)
        return Summary(mean, np.diagonal(cov, axis1=-2, axis2=-1), cov)

    def _forecast(self, step: Step[GaussianState]) -> tuple[Array, Array]:
        """Return the joint mean and covariance of the forecast and the earlier states kept."""
        state = step.state
        model = self.model
        dt = step.dt
        if not dt:
            return state.joint_means.copy(), state.joint_covariances.copy()
        d = state.dim
        mean, slope, extra = self._linearize(
            partial(model.step, t=state.t, dt=dt),
            partial(model.jacobian, t=state.t, dt=dt),
            state.means,
            state.covariances,
            isinstance(model, LinearModel),
        )
        # P = F P Fᵀ + Q, with a contiguous F.
        slope = np.ascontiguousarray(slope)
        old = state.joint_covariances
        noise = model.Q(state.t, dt) + extra
        cov = slope @ old[..., :d, :d] @ slope.mT + noise
        size = len(step.times) * d
        if size:
            # The past keeps its covariance; its cross-covariance with the present becomes F P.
            mean = np.concatenate([mean, state.joint_means[..., :size]], axis=-1)
            cross = slope @ old[..., :d, :size]
            cov = np.block([[cov, cross], [cross.mT, old[..., :size, :size]]])
        if self.inflation != 1.0:
            # Rows and columns of the present, so that its own block gets the square.
            cov[..., :d, :] *= self.inflation
            cov[..., :, :d] *= self.inflation
        return mean, cov

    def _linearize(
        self,
        function: Callable[[Array], Array],
        jacobian: Callable[..., Array],
        mean: Array,
        cov: Array,
        is_linear: bool,
    ) -> tuple[Array, Array, Array | float]:
        """Return value, slope and extra covariance of a function of a Gaussian (..., d)."""
        if is_linear or self.linearization == "extended":
            # For a linear function unscented points would give the same.
            value = function(mean[..., None, :])[..., 0, :]
            # Differences are scaled by the state's standard deviations.
            slope = jacobian(mean) if is_linear else jacobian(mean, std=deviations(cov))
            return value, slope, 0.0
        root = cholesky(cov)
        d = mean.shape[-1]
        points, weights = unscented_points(mean, root, kappa=self.kappa)
        values = function(points)
        value = weights @ values
        anomalies = values - value[..., None, :]
        # Opposite points lie ±√(d+κ) columns of the root L from the mean, so that half their
        # differences are (H L)ᵀ √(d+κ) and H follows by a triangular solve.
        ahead = values[..., 1 : d + 1, :]
        behind = values[..., d + 1 :, :]
        scaled_slope = (ahead - behind) / (2 * np.sqrt(d + self.kappa))
        slope = solve_upper(root, scaled_slope).mT
        # The covariance of the values beyond the linear part H P Hᵀ.
        total = (weights[:, None] * anomalies).mT @ anomalies
        return value, slope, total - scaled_slope.mT @ scaled_slope

    def _condition(
        self,
        means: Array,
        covs: Array,
        place: int,
        group: Received,
        step: Step[GaussianState],
    ) -> None:
        """Condition a group's joint Gaussians on its observations, in place."""
        d = self.model.dim
        rows = group.rows
        # The latest time comes first in the joint state, and last among the places.
        first = (len(step.times) - place) * d
        block = slice(first, first + d)
        joint_mean = means[..., rows, :]
        joint_cov = covs[..., rows, :, :]
        mean = joint_mean[..., block]
        cov = joint_cov[..., block, block]
        linear = group.linear
        predicted, slope, extra = self._linearize(
            group.predict, group.jacobian, mean, cov, linear
        )

        def moments_on_one_branch(_: Array) -> tuple[Array, Array]:
            """Return the moments about one branch, whatever the observed angle is."""
            predict = partial(group.predict, same_branch=True)
            value, h, remainder = self._linearize(
                predict, group.jacobian, mean, cov, linear
            )
            return value, h @ cov @ h.mT + remainder

        group = step.gate(group, moments_on_one_branch, predicted[..., None, :])
        # S = H P Hᵀ + R, where the extra covariance of the unscented points counts as noise.
        noise = np.full((*slope.shape[:-1], slope.shape[-2]), group.noise) + extra
        if joint_mean.shape[-1] > d:
            # Zero slope in the other times' states.
            joint_slope = np.zeros((*slope.shape[:-1], joint_mean.shape[-1]))
            joint_slope[..., block] = slope
            slope = joint_slope
        # r = y* - h(m); NaN where a component is missing, which `condition` leaves out.
        innovation = group.target - predicted
        means[..., rows, :], covs[..., rows, :, :] = step.apply(
            _condition_rows,
            (joint_mean, joint_cov, innovation, slope, noise),
            (joint_mean, joint_cov),
            group.agents,
        )

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
        # Only the present marginal is fused.
        fused_mean, fused_cov = step.fuse(mean, cov)
        variance = np.diagonal(fused_cov, axis1=-2, axis2=-1)
        # A variance that is negative by rounding alone is small beside the largest one.
        if (variance < -1e-9 * np.abs(variance).max()).any():
            raise ValueError(
                f"fusion must return a covariance, got a variance of {variance.min():g}"
            )
        # A variance below (ε m)² cannot come from independent information.
        if ((variance > 0) & (variance < (EPS * fused_mean) ** 2)).any():
            warnings.warn(
                f"covariance after fusion is below rounding at t = {step.t:g} s: "
                "information is probably counted twice",
                RuntimeWarning,
                4,
            )
        if means.shape[-1] == d:
            return fused_mean, fused_cov
        # With the gain G = P_joint,now P_now⁻¹: m + G Δm and P + G ΔP Gᵀ.
        gain = np.linalg.solve(cov, covs[..., :d, :]).mT
        shift = (gain @ (fused_mean - mean)[..., None])[..., 0]
        return means + shift, covs + gain @ (fused_cov - cov) @ gain.mT


def _condition_rows(
    mean: Array,
    cov: Array,
    innovation: Array,
    slope: Array,
    noise: Array,
    *_: Any,
) -> tuple[Array, Array]:
    return condition(mean, cov, innovation, slope, noise)
