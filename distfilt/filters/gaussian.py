"""A network of Kalman filters, extended or unscented: forecast, assimilate, fuse the Gaussians."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..checks import Array, array, choice, count, covariance, instance, number
from ..linalg import _symmetrise
from ..network import Ledger
from .driver import Late, Summary
from .failures import guarded, not_finite
from .heard import Heard
from .saving import State
from .wiring import SensorFilter

__all__ = ["GaussianFilter", "GaussianState"]

Mask = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class GaussianState(State):
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
    >>> state = GaussianState(0.0, Ledger.empty(2), None, np.zeros((2, 1)), np.ones((2, 1, 1)), 1)
    >>> state.means.shape, state.runs
    ((2, 1), ())
    """

    joint_means: Array
    joint_covariances: Array
    dim: int
    history: tuple[float, ...] = ()
    failed: Mask = field(default_factory=lambda: np.zeros((), dtype=bool))

    def __post_init__(self) -> None:
        super().__post_init__()
        d = count(self.dim, "dim")
        m = array(self.joint_means, "joint_means", (..., "A", d * (1 + len(self.history))))
        wanted = (*m.shape, m.shape[-1])
        covariance(
            array(self.joint_covariances, "joint_covariances", wanted), "joint_covariances",
            semidefinite=True,
        )
        if self.ledger.messages.size != m.shape[-2]:
            raise ValueError(f"ledger: needs {m.shape[-2]} agents, got {self.ledger.messages.size}")
        object.__setattr__(self, "failed", np.broadcast_to(self.failed, self.runs))

    @property
    def runs(self) -> tuple[int, ...]:
        """Leading axes: independent runs of the network."""
        return tuple(self.joint_means.shape[:-2])

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
        ``agreement(means, covs, channel) -> means, covs``, such as
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
        rng : numpy.random.Generator, optional
            Not used: nothing is drawn. It is accepted so that all filters start alike.
        runs : tuple of int
            Leading axes: independent runs.
        t : float
            The time of the prior, in s.
        """
        if not isinstance(prior, tuple) or len(prior) != 2:
            raise ValueError(f"prior: needs a tuple (mean, cov), got {type(prior).__name__}")
        d, agents = self.model.dim, len(self.sensors)
        lead = (*(count(n, "runs") for n in runs), agents)
        m = np.broadcast_to(array(prior[0], "prior", (d,)), (*lead, d))
        p = np.broadcast_to(covariance(prior[1], "prior", d), (*lead, d, d))
        return GaussianState(number(t, "t"), Ledger.empty(agents), None, m.copy(), p.copy(), d)

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
        instance(state, "state", GaussianState)
        dt = self.elapsed(state, t)
        seen = self.observed(state, observations)
        channel = self.channel(state, t)
        times = (state.t, *state.history)[: self.lag]
        earlier = [self.slot(item, times, state) for item in late]
        means, covs = self._forecast(state, dt, len(times))
        agents = range(len(self.sensors))
        failed = self.settle(not_finite(means, 1), agents, t, state.failed)
        if failed.any():
            means = np.where(failed[..., None, None], 0.0, means)
            covs = np.where(failed[..., None, None, None], np.eye(means.shape[-1]), covs)
        for slot, observed in [*((k + 1, o) for k, o in earlier), (0, seen)]:
            for group in self.gather(observed, channel):
                errors = self._condition(means, covs, slot, group, failed)
                failed = self.settle(errors, group.agents, t, failed)
        if self.agreement is not None and channel is not None:
            means, covs = self._agreed(means, covs, channel)
        ledger = state.ledger if channel is None else channel.ledger
        return GaussianState(
            float(t), ledger, None, means, _symmetrise(covs), state.dim, times, failed
        )

    def summary(self, state: GaussianState) -> Summary:
        """Means and covariances of the present state."""
        return _summary(state, 0)

    def past(self, state: GaussianState) -> tuple[tuple[float, Summary], ...]:
        """Earlier times, oldest first, and what is believed of them by now."""
        return tuple(
            (t, _summary(state, k + 1)) for k, t in reversed(list(enumerate(state.history)))
        )

    def _forecast(self, state: GaussianState, dt: float, kept: int) -> tuple[Array, Array]:
        """Joint mean and covariance of the moved state and of `kept` earlier ones."""
        d, model = state.dim, self.model

        def flow(x: Array) -> Array:
            return model.step(x, state.t, dt)

        moved, slope, extra = self._linearised(
            flow, lambda x: model.jacobian(x, state.t, dt), state.means, state.covariances
        )
        old = state.joint_means[..., : kept * d]
        size = state.joint_means.shape[-1]
        shift = np.zeros((*slope.shape[:-2], (1 + kept) * d, size))
        shift[..., :d, :d] = slope
        shift[..., d:, : kept * d] = np.eye(kept * d)
        covs = shift @ state.joint_covariances @ np.swapaxes(shift, -1, -2)
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
        moves = np.swapaxes(np.concatenate([root, -root], axis=-1), -1, -2)
        points = mean[..., None, :] + np.concatenate([0 * moves[..., :1, :], moves], axis=-2)
        w = np.full(2 * d + 1, 0.5 / (d + self.kappa))
        w[0] = self.kappa / (d + self.kappa)
        values = function(points)
        at = w @ values
        gap = values - at[..., None, :]
        around = points - mean[..., None, :]
        weighed = np.swapaxes(w[:, None] * gap, -1, -2)
        slope = np.swapaxes(np.linalg.solve(cov, np.swapaxes(weighed @ around, -1, -2)), -1, -2)
        return at, slope, weighed @ gap - slope @ cov @ np.swapaxes(slope, -1, -2)

    def _condition(
        self, means: Array, covs: Array, slot: int, group: Heard, failed: Mask
    ) -> dict[tuple[int, ...], str]:
        """Condition a group's joint Gaussians in place; the rows that failed."""
        d, rows = self.model.dim, group.agents
        here = slice(slot * d, (slot + 1) * d)
        m, p = means[..., rows, :], covs[..., rows, :, :]
        at, slope, extra = self._linearised(
            group.predict, group.jacobian, m[..., here], p[..., here, here]
        )
        target = np.where(failed[..., None, None], np.nan, group.target)
        big = np.zeros((*slope.shape[:-1], m.shape[-1]))
        big[..., here] = slope

        def compute(m: Array, p: Array, *rest: Array) -> tuple[Array, ...]:
            at, big, extra, target, noise, _ = rest
            return _updated(m, p, target - at, big, noise + extra)

        (m, p), errors = guarded(
            compute, (m, p, at, big, extra, target), (m, p), target.ndim - 1,
            shared=group.noise, rng=None,
        )
        means[..., rows, :], covs[..., rows, :, :] = m, p
        return errors

    def _agreed(self, means: Array, covs: Array, channel: Any) -> tuple[Array, Array]:
        """Fuse the present states; what is believed of the past follows by its regression."""
        d = self.model.dim
        old, now = means[..., :d], _symmetrise(covs[..., :d, :d])
        assert self.agreement is not None
        m, p = self.agreement(old, now, channel)
        m, p = array(m, "agreement", old.shape), array(p, "agreement", now.shape)
        if means.shape[-1] == d:
            return m, p
        gain = np.swapaxes(np.linalg.solve(now, covs[..., :d, :]), -1, -2)
        moved = means + (gain @ (m - old)[..., None])[..., 0]
        return moved, covs + gain @ (p - now) @ np.swapaxes(gain, -1, -2)


def _updated(m: Array, p: Array, gap: Array, h: Array, r: Array) -> tuple[Array, Array]:
    """One linear update in Joseph's form; NaN in the innovation leaves its reading out."""
    missing = np.isnan(gap)
    if missing.any():
        h = np.where(missing[..., None], 0.0, h)
        here = ~missing[..., :, None] & ~missing[..., None, :]
        r = np.where(here, r, np.eye(r.shape[-1]))
        gap = np.where(missing, 0.0, gap)
    turned = np.swapaxes(h, -1, -2)
    cross = p @ turned
    gain = np.swapaxes(np.linalg.solve(h @ cross + r, np.swapaxes(cross, -1, -2)), -1, -2)
    rest = np.eye(p.shape[-1]) - gain @ h
    new = rest @ p @ np.swapaxes(rest, -1, -2) + gain @ r @ np.swapaxes(gain, -1, -2)
    return m + (gain @ gap[..., None])[..., 0], _symmetrise(new)


def _summary(state: GaussianState, slot: int) -> Summary:
    here = slice(slot * state.dim, (slot + 1) * state.dim)
    mean, cov = state.joint_means[..., here], state.joint_covariances[..., here, here]
    if state.failed.any():
        gone = state.failed[..., None, None]
        mean, cov = np.where(gone, np.nan, mean), np.where(gone[..., None], np.nan, cov)
    return Summary(mean, np.diagonal(cov, axis1=-2, axis2=-1), cov)
