"""A network of Kalman filters, extended or unscented: forecast, assimilate, fuse the Gaussians."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import KW_ONLY, dataclass
from functools import partial
from typing import Annotated, Any, ClassVar, Literal, Self

import numpy as np

from ..gaussians.single import condition, unscented_points
from ..linalg import EPS, cholesky, solve_upper, symmetrise
from ..models import LinearModel
from ..validation import Array, Bounds, NonNegativeFloat, PositiveInt
from .base import Filter
from .inbox import Received
from .inputs import prior_moments
from .record import Summary
from .saving import SensorState
from .step import Step, run_isolated

__all__ = ["GaussianFilter", "GaussianState"]


@dataclass(frozen=True, eq=False, repr=False)
class GaussianState(SensorState):
    """What the agents believe between two steps.

    Parameters
    ----------
    t, ledger, rng, rejected, failed, pending
        As for :class:`~distfilt.filters.SensorState`; `rng` is None, as nothing is drawn.
    joint_means : ndarray, (*runs, A, D)
        Means of the present state and of the kept earlier ones, latest first: D = d (1 + kept).
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
        """The earlier times that are kept, oldest first."""
        return self.history[::-1]

    @property
    def lagged_states(self) -> tuple[Self, ...]:
        """A state for each of these times, as what is believed of it by now."""
        m = self.joint_means
        p = self.joint_covariances
        d = self.dim
        own = [slice(k * d, (k + 1) * d) for k in range(len(self.history), 0, -1)]
        return tuple(
            self.replace(
                t=t, history=(), joint_means=m[..., k], joint_covariances=p[..., k, k]
            )
            for t, k in zip(self.times, own, strict=True)
        )

    @property
    def sizes(self) -> tuple[int, ...]:
        """The components of one state."""
        return (self.dim,)

    @property
    def means(self) -> Array:
        """Means of the present state, (*runs, A, d)."""
        return self.joint_means[..., : self.dim]

    @property
    def covariances(self) -> Array:
        """Covariances of the present state, (*runs, A, d, d)."""
        return self.joint_covariances[..., : self.dim, : self.dim]


@dataclass(frozen=True, eq=False)
class GaussianFilter(Filter):
    """One Kalman filter per agent; for a linear model and linear sensors it is exact.

    Parameters
    ----------
    model, sensors, graph, fusion, share_observations, faults, lag, names, on_error, gate_probability,
        exchange_interval
        As for :class:`~distfilt.filters.Filter`. The agreement is a function
        ``agreement((means, covs), channel) -> (means, covs)``, such as
        :func:`distfilt.network.covariance_intersection`.
    rule : {"extended", "unscented"}
        How a curved model or sensor is made linear: by its derivative at the mean, or by 2d + 1
        points about it.
    kappa : float
        The unscented points lie :math:`\\sqrt{d+\\kappa}` standard deviations from the mean, at
        least 0, so that no weight is negative.
    inflation : float
        What the forecast's standard deviations are multiplied by; at least 0.5, for 5% is 1.05.

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

    state_class: ClassVar[type[GaussianState]] = GaussianState
    batched_summary: ClassVar[bool] = True
    belief_kind: ClassVar[str] = "gaussians"

    def initial_state(
        self, prior: Any, runs: tuple[int, ...], rng: Any
    ) -> dict[str, Any]:
        """The prior's mean and covariance, the same for all agents and runs."""
        d = self.model.dim
        both = prior_moments(
            prior, d, "semi" * (self.linearization == "extended") + "definite"
        )
        m, p = (
            np.broadcast_to(x, (*runs, self.n_agents, *x.shape)).copy() for x in both
        )
        return {"joint_means": m, "joint_covariances": p, "dim": d}

    @property
    def sizes(self) -> tuple[int, ...]:
        """The state's components."""
        return (self.model.dim,)

    def next_state(self, step: Step) -> Any:
        """Forecast, condition on what was heard, fuse.

        Warns
        -----
        RuntimeWarning
            If a deviation after the agreement is below the rounding of its mean.
        """
        means, covs = self._forecast(step)
        means, one = step.check_forecast(means, 0.0), np.eye(means.shape[-1])
        covs = step.check_forecast(covs, one)
        for place, group in step.received():
            slot = len(step.times) - place
            step.record_failures(
                self._condition(means, covs, slot, group, step), group.agents
            )
        covs = step.keep_failed(
            covs, one
        )  # what failed here has to have a root in what follows
        if step.has_fusion:
            means, covs = self._agreed(means, covs, step)
        covs = symmetrise(covs)
        past = step.times[::-1]
        return step.end(
            joint_means=means, joint_covariances=covs, dim=step.state.dim, history=past
        )

    def summarize(self, state: GaussianState) -> Summary:
        """Means and covariances of the present state."""
        cov = state.mask_failed(state.covariances)
        return Summary(
            state.mask_failed(state.means), np.diagonal(cov, axis1=-2, axis2=-1), cov
        )

    def _forecast(self, step: Step) -> tuple[Array, Array]:
        """Joint mean and covariance of the moved state and of the earlier ones that are kept."""
        state = step.state
        model = self.model
        dt = step.dt
        if not dt:
            return state.joint_means.copy(), state.joint_covariances.copy()
        d = state.dim
        kept = len(step.times)
        flow = partial(model.step, t=state.t, dt=dt)
        jacobian = partial(model.jacobian, t=state.t, dt=dt)
        now = (state.means, state.covariances)
        linear = isinstance(model, LinearModel)
        moved, slope, extra = self._linearised(flow, jacobian, *now, linear)
        shift = np.ascontiguousarray(slope)
        old = state.joint_covariances
        covs = shift @ old[..., :d, :d] @ shift.mT + (model.Q(state.t, dt) + extra)
        if kept:  # the past stays as it is, and only its products with the present move
            moved = np.concatenate([moved, state.joint_means[..., : kept * d]], axis=-1)
            across = shift @ old[..., :d, : kept * d]
            covs = np.block(
                [[covs, across], [across.mT, old[..., : kept * d, : kept * d]]]
            )
        if self.inflation != 1.0:
            covs[..., :d, :] *= self.inflation
            covs[..., :, :d] *= self.inflation
        return moved, covs

    def _linearised(
        self,
        function: Callable[[Array], Array],
        jacobian: Callable[[Array], Array],
        mean: Array,
        cov: Array,
        linear: bool,
    ) -> tuple[Array, Array, Array | float]:
        """Value, slope and extra covariance of a function of a Gaussian (..., d)."""
        if (
            linear or self.linearization == "extended"
        ):  # points would find the same of what is linear
            return function(mean[..., None, :])[..., 0, :], jacobian(mean), 0.0
        root = cholesky(cov)
        d = mean.shape[-1]
        points, w = unscented_points(mean, root, kappa=self.kappa)
        values = function(points)
        at = w @ values
        gap = values - at[..., None, :]
        # By opposite points: the slope times each column of the root, and what is beyond them.
        half = (values[..., 1 : d + 1, :] - values[..., d + 1 :, :]) / (
            2 * np.sqrt(d + self.kappa)
        )
        slope = solve_upper(root, half).mT
        return at, slope, (w[:, None] * gap).mT @ gap - half.mT @ half

    def _condition(
        self, means: Array, covs: Array, slot: int, group: Received, step: Step
    ) -> Any:
        """Condition a group's joint Gaussians in place; the rows that failed."""
        d = self.model.dim
        rows = group.rows
        here = slice(slot * d, (slot + 1) * d)
        m = means[..., rows, :]
        p = covs[..., rows, :, :]
        x = m[..., here]
        own = p[..., here, here]
        predict = group.predict
        jacobian = group.jacobian
        at, slope, extra = self._linearised(predict, jacobian, x, own, group.linear)

        def alike(_: Array) -> tuple[Array, Array]:
            near = partial(predict, alike=True)
            mean, h, rest = self._linearised(near, jacobian, x, own, group.linear)
            return mean, h @ own @ h.mT + rest

        group = step.gate(group, alike, at[..., None, :])
        noise = np.full((*slope.shape[:-1], slope.shape[-2]), group.noise) + extra
        if m.shape[-1] > d:
            part = slope
            slope = np.zeros((*slope.shape[:-1], m.shape[-1]))
            slope[..., here] = part
        (m, p), errors = run_isolated(
            lambda m, p, gap, h, noise, *_: condition(m, p, gap, h, noise),
            (m, p, group.target - at, slope, noise),
            (m, p),
            group.target.ndim - 1,
        )
        means[..., rows, :] = m
        covs[..., rows, :, :] = p
        return errors

    def _agreed(self, means: Array, covs: Array, step: Step) -> tuple[Array, Array]:
        """Fuse the present states; what is believed of the past follows by its regression.

        >>> from types import SimpleNamespace
        >>> from distfilt.models import constant_velocity
        >>> f = GaussianFilter(constant_velocity(sigma=1.0), [None])
        >>> sure = SimpleNamespace(t=1.0, fuse=lambda m, p: (m, 1e-40 * p))
        >>> with warnings.catch_warnings(action="error"):
        ...     f._agreed(np.ones((1, 4)), np.eye(4)[None], sure)
        Traceback (most recent call last):
        RuntimeWarning: fusion: counts twice, at t = 1 s
        >>> wrong = SimpleNamespace(t=1.0, fuse=lambda m, p: (m, p - 2 * np.eye(4)))
        >>> f._agreed(np.ones((1, 4)), np.eye(4)[None], wrong)
        Traceback (most recent call last):
        ValueError: fusion must be a covariance, got a variance of -1
        """
        d = self.model.dim
        old = means[..., :d]
        now = symmetrise(covs[..., :d, :d])
        m, p = step.fuse(old, now)
        variance = np.diagonal(p, axis1=-2, axis2=-1)
        if (variance < -1e-9 * np.abs(variance).max()).any():  # not by rounding
            raise ValueError(
                f"fusion must be a covariance, got a variance of {variance.min():g}"
            )
        if ((variance > 0) & (variance < (EPS * m) ** 2)).any():
            warnings.warn(
                f"fusion: counts twice, at t = {step.t:g} s", RuntimeWarning, 4
            )
        if means.shape[-1] == d:
            return m, p
        gain = np.linalg.solve(now, covs[..., :d, :]).mT
        moved = means + (gain @ (m - old)[..., None])[..., 0]
        return moved, covs + gain @ (p - now) @ gain.mT
