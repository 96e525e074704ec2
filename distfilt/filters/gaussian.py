"""A network of Kalman filters, extended or unscented: forecast, assimilate, fuse the Gaussians."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from ..checks import Array, array, choice, count, covariance, instance, number
from ..linalg import _symmetrise
from .driver import Late, Summary
from .failures import guarded
from .heard import Heard
from .stepping import SensorState, Step
from .wiring import SensorFilter

__all__ = ["GaussianFilter", "GaussianState"]


@dataclass(frozen=True, eq=False)
class GaussianState(SensorState):
    """What the agents believe between two steps.

    Parameters
    ----------
    t, ledger, rng
        As for :class:`~distfilt.filters.State`; `rng` is None, as nothing is drawn.
    joint_means : ndarray, (*runs, A, D)
        Means of the present state and of the kept earlier ones, latest first: D = d (1 + kept).
    joint_covariances : ndarray, (*runs, A, D, D)
        Their joint covariance.
    dim : int
        Size d of one state.
    history : tuple of float
        The earlier times, latest first.
    failed : ndarray of bool, (*runs)
        Runs that failed and are no longer updated.

    Examples
    --------
    >>> from distfilt.network import Ledger
    >>> state = GaussianState(0.0, Ledger.empty(2), None, np.zeros((2, 1)), np.ones((2, 1, 1)), 1)
    >>> state.means.shape, state.runs
    ((2, 1), ())
    """

    joint_means: Array
    joint_covariances: Array
    dim: int

    _belief = "joint_means", (..., "A", "D")

    def __post_init__(self) -> None:
        super().__post_init__()
        size = count(self.dim, "dim") * (1 + len(self.history))
        m = array(self.joint_means, "joint_means", (..., "A", size))
        p = array(self.joint_covariances, "joint_covariances", (*m.shape, size))
        covariance(p, "joint_covariances", semidefinite=True)

    @property
    def times(self) -> tuple[float, ...]:
        """The earlier times that are kept, oldest first."""
        return self.history[::-1]

    @property
    def earlier(self) -> tuple[Self, ...]:
        """A state for each of these times, as what is believed of it by now."""
        m, p, d = self.joint_means, self.joint_covariances, self.dim
        own = [slice(k * d, (k + 1) * d) for k in range(len(self.history), 0, -1)]
        return tuple(
            replace(self, t=t, history=(), joint_means=m[..., k], joint_covariances=p[..., k, k])
            for t, k in zip(self.times, own, strict=True)
        )

    @property
    def means(self) -> Array:
        """Means of the present state, (*runs, A, d)."""
        return self.joint_means[..., : self.dim]

    @property
    def covariances(self) -> Array:
        """Covariances of the present state, (*runs, A, d, d)."""
        return self.joint_covariances[..., : self.dim, : self.dim]


@dataclass(frozen=True, eq=False)
class GaussianFilter(SensorFilter):
    """One Kalman filter per agent; for a linear model and linear sensors it is exact.

    Parameters
    ----------
    model, sensors, graph, agreement, share, faults, lag, names, failures
        As for :class:`~distfilt.filters.SensorFilter`. The agreement is a function
        ``agreement((means, covs), channel) -> (means, covs)``, such as
        :func:`distfilt.network.covariance_intersection`.
    rule : {"extended", "unscented"}
        How a curved model or sensor is made linear: by its derivative at the mean, or by 2d + 1
        points about it.
    kappa : float
        The unscented points lie :math:`\\sqrt{d+\\kappa}` standard deviations from the mean, at
        least 0, so that no weight is negative.

    Examples
    --------
    >>> from distfilt.models import Model
    >>> from distfilt.network import covariance_intersection, graphs
    >>> from distfilt.sensors import direct
    >>> walk = Model(1, lambda x, t, dt: x, lambda t, dt: dt * np.eye(1))
    >>> f = GaussianFilter(walk, [direct([0], std=1.0), None], graphs.path(2), share=False,
    ...                    agreement=covariance_intersection)
    >>> f.step(f.start(([0.0], [[4.0]])), 1.0, [[2.0], None]).means.ravel().round(3)
    array([1.429, 1.429])
    """

    rule: str = field(default="extended", kw_only=True)
    kappa: float = field(default=1.0, kw_only=True)

    def __post_init__(self) -> None:
        super().__post_init__()
        choice(self.rule, "rule", ("extended", "unscented"))
        number(self.kappa, "kappa", at_least=0)
        if any(s is not None and s.uses_previous for s in self.sensors):
            raise ValueError("sensors: needs sensors of the present state, got a differential one")

    def start(
        self, prior: tuple[ArrayLike, ArrayLike], *, rng: np.random.Generator | None = None,
        runs: tuple[int, ...] = (), t: float = 0.0,
    ) -> GaussianState:
        """The state before the first step.

        Parameters
        ----------
        prior : tuple
            ``(mean, cov)``, (d,) and (d, d), the same for all agents and runs.
        rng, runs, t
            As for :meth:`distfilt.filters.EnsembleFilter.start`; the generator is not needed, as
            nothing is drawn.
        """
        lead, both = self.leading(runs), self.moments(prior)
        m, p = (np.broadcast_to(x, (*lead, *x.shape)).copy() for x in both)
        return self.first(GaussianState, t, rng, m, p, self.model.dim, draws=False)

    def step(
        self, state: GaussianState, t: float, observations: Sequence[ArrayLike | None], *,
        late: Sequence[Late] = (),
    ) -> GaussianState:
        """Move to time `t` and take in what was observed there.

        Parameters
        ----------
        state, t, observations, late
            As for :meth:`distfilt.filters.EnsembleFilter.step`.
        """
        step = self.begin(state, GaussianState, t, observations, late)
        means, covs = self._forecast(state, step.dt, len(step.times))
        means = step.moved(means, 0.0, 1)
        covs = step.kept(covs, np.eye(means.shape[-1]))
        for place, group in step.heard():
            slot = len(step.times) - place
            step.settle(self._condition(means, covs, slot, group), group.agents)
        if step.agrees:
            means, covs = self._agreed(means, covs, step)
        covs = _symmetrise(covs)
        return step.end(GaussianState, means, covs, state.dim, history=reversed(step.times))

    def summary(self, state: GaussianState) -> Summary:
        """Means and covariances of the present state."""
        cov = instance(state, "state", GaussianState).shown(state.covariances)
        return Summary(state.shown(state.means), np.diagonal(cov, axis1=-2, axis2=-1), cov)

    def _forecast(self, state: GaussianState, dt: float, kept: int) -> tuple[Array, Array]:
        """Joint mean and covariance of the moved state and of `kept` earlier ones."""
        d, model = state.dim, self.model
        moved, slope, extra = self._linearised(
            lambda x: model.step(x, state.t, dt), lambda x: model.jacobian(x, state.t, dt),
            state.means, state.covariances,
        )
        old = state.joint_means[..., : kept * d]
        shift = np.zeros((*slope.shape[:-2], (1 + kept) * d, state.joint_means.shape[-1]))
        shift[..., :d, :d] = slope
        shift[..., d:, : kept * d] = np.eye(kept * d)
        covs = shift @ state.joint_covariances @ shift.mT
        covs[..., :d, :d] += model.noise(state.t, dt) + extra
        return np.concatenate([moved, old], axis=-1), covs

    def _linearised(
        self, function: Callable[[Array], Array], jacobian: Callable[[Array], Array], mean: Array,
        cov: Array,
    ) -> tuple[Array, Array, Array]:
        """Value, slope and extra covariance of a function of a Gaussian (..., d)."""
        if self.rule == "extended":
            slope = jacobian(mean)
            at = function(mean[..., None, :])[..., 0, :]
            return at, slope, np.zeros((*slope.shape[:-1], slope.shape[-2]))
        d = mean.shape[-1]
        root = np.linalg.cholesky((d + self.kappa) * cov)
        moves = np.concatenate([root, -root], axis=-1).mT
        points = mean[..., None, :] + np.concatenate([0 * moves[..., :1, :], moves], axis=-2)
        w = np.full(2 * d + 1, 0.5 / (d + self.kappa))
        w[0] = self.kappa / (d + self.kappa)
        values = function(points)
        at = w @ values
        gap = values - at[..., None, :]
        weighed = (w[:, None] * gap).mT
        slope = np.linalg.solve(cov, (weighed @ (points - mean[..., None, :])).mT).mT
        return at, slope, weighed @ gap - slope @ cov @ slope.mT

    def _condition(
        self, means: Array, covs: Array, slot: int, group: Heard
    ) -> dict[tuple[int, ...], str]:
        """Condition a group's joint Gaussians in place; the rows that failed."""
        d, rows = self.model.dim, group.agents
        here = slice(slot * d, (slot + 1) * d)
        m, p = means[..., rows, :], covs[..., rows, :, :]
        at, slope, extra = self._linearised(
            group.predict, group.jacobian, m[..., here], p[..., here, here]
        )
        big = np.zeros((*slope.shape[:-1], m.shape[-1]))
        big[..., here] = slope
        (m, p), errors = guarded(
            lambda m, p, gap, big, extra, noise, _: _updated(m, p, gap, big, noise + extra),
            (m, p, group.target - at, big, extra), (m, p), group.target.ndim - 1,
            shared=group.noise, rng=None,
        )
        means[..., rows, :], covs[..., rows, :, :] = m, p
        return errors

    def _agreed(self, means: Array, covs: Array, step: Step) -> tuple[Array, Array]:
        """Fuse the present states; what is believed of the past follows by its regression."""
        d = self.model.dim
        old, now = means[..., :d], _symmetrise(covs[..., :d, :d])
        m, p = step.agreed(old, now)
        if means.shape[-1] == d:
            return m, p
        gain = np.linalg.solve(now, covs[..., :d, :]).mT
        moved = means + (gain @ (m - old)[..., None])[..., 0]
        return moved, covs + gain @ (p - now) @ gain.mT


def _updated(m: Array, p: Array, gap: Array, h: Array, r: Array) -> tuple[Array, Array]:
    """One linear update in Joseph's form; NaN in the innovation leaves its reading out."""
    missing = np.isnan(gap)
    if missing.any():
        h = np.where(missing[..., None], 0.0, h)
        here = ~missing[..., :, None] & ~missing[..., None, :]
        r = np.where(here, r, np.eye(r.shape[-1]))
        gap = np.where(missing, 0.0, gap)
    cross = p @ h.mT
    gain = np.linalg.solve(h @ cross + r, cross.mT).mT
    rest = np.eye(p.shape[-1]) - gain @ h
    new = rest @ p @ rest.mT + gain @ r @ gain.mT
    return m + (gain @ gap[..., None])[..., 0], _symmetrise(new)
