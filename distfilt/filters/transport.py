"""A network of transport filters: agents with one set of members in common agree on its weights."""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ..checks import Array, count, number
from ..coupling.solvers import _solver
from ..coupling.transform import _carried, _normalised, _plans, _rejuvenated
from ..network import finite_time
from ..updates.particles import log_likelihood
from .driver import Late, Summary
from .ensemble import EnsembleState, ensemble_summary
from .failures import guarded
from .stepping import Step
from .wiring import Prior, SensorFilter

__all__ = ["TransportFilter"]


@dataclass(frozen=True, eq=False)
class TransportFilter(SensorFilter):
    r"""Agents that hold the same members, agree on their log-likelihoods, and transport alone.

    Readings of different agents are independent, so the log-likelihood of all of them is A times
    the agents' average, :math:`\log w_i=\sum_a\log p(\mathbf y^a|\mathbf x_i)`. The agreement finds
    it; then every agent computes the same ensemble transform. All agents draw the prior, process
    noise and rejuvenation from one seed, so that the members stay in common.

    Parameters
    ----------
    model, sensors, graph, faults, lag, names, failures
        As for :class:`~distfilt.filters.SensorFilter`.
    agreement : callable, optional
        ``agreement(log_likelihoods, channel) -> averages``, both (\*runs, A, N): exact finite-time
        averaging by default, or ``partial(average, rounds=20)``. With None nobody agrees.
    share : bool
        Without an agreement: whether readings go to the neighbours, who use them too. An agreement
        takes their place, and readings stay with their agents.
    members : int
        Number N of members of the common set.
    correct : bool
        Give the members the weighted covariance too.
    rejuvenation : float
        h of :func:`distfilt.coupling.rejuvenated`; 0 draws nothing.

    Examples
    --------
    >>> from distfilt.models import Model
    >>> from distfilt.network import graphs
    >>> from distfilt.sensors import direct
    >>> walk = Model(2, lambda x, t, dt: x, lambda t, dt: 0.1 * dt * np.eye(2))
    >>> f = TransportFilter(walk, [direct([0], std=0.5), direct([1], std=0.5)], graphs.path(2))
    >>> state = f.start((np.zeros(2), np.eye(2)), rng=np.random.default_rng(0))
    >>> state = f.step(state, 1.0, [[0.8], [-0.8]])
    >>> bool(np.allclose(*state.ensembles)), state.ledger.scalars
    (True, array([100, 100]))
    """

    agreement: Callable[..., Any] | None = field(default=finite_time, kw_only=True)
    members: int = field(default=100, kw_only=True)
    correct: bool = field(default=False, kw_only=True)
    rejuvenation: float = field(default=0.0, kw_only=True)

    def __post_init__(self) -> None:
        super().__post_init__()
        count(self.members, "members", at_least=2)
        number(self.rejuvenation, "rejuvenation", at_least=0)

    def start(
        self, prior: Prior, *, rng: np.random.Generator, runs: tuple[int, ...] = (), t: float = 0.0
    ) -> EnsembleState:
        """The state before the first step; arguments as for `EnsembleFilter.start`.

        Members are (N, d), or (*runs, 1, N, d): one set for all agents.
        """
        drawn = self.drawn(prior, self.members, runs, rng, sets=1)
        everywhere = np.repeat(drawn, len(self.sensors), axis=-3)
        return self.first(EnsembleState, t, rng, everywhere)

    def step(
        self, state: EnsembleState, t: float, observations: Sequence[ArrayLike | None], *,
        late: Sequence[Late] = (),
    ) -> EnsembleState:
        """Move to time `t` and take in what was observed there; as `EnsembleFilter.step`."""
        sizes = self.members, self.model.dim
        step = self.begin(state, EnsembleState, t, observations, late, sizes)
        moved = self._for_all(
            partial(self.model.sample_step, t=state.t, dt=step.dt), (state.ensembles,), step.rng
        )
        stack = step.stack(step.moved(moved, state.ensembles, 2))
        (logs,) = step.agreed(self._log_likelihoods(stack, step))
        if step.agrees:
            logs = state.agents * logs
        stack, errors = self._transported(stack, logs, step.rng)
        step.settle(errors, range(state.agents))
        return step.end(EnsembleState, stack[-1], history=zip(step.times, stack[:-1], strict=True))

    def summary(self, state: EnsembleState) -> Summary:
        """Ensemble means and variances; the members for the scores."""
        return ensemble_summary(state)

    def _for_all(
        self, draw: Callable[..., Array], arrays: tuple[Array, ...], rng: np.random.Generator
    ) -> Array:
        """Apply `draw` agent by agent, each with the same draws; the generator advances once."""
        sources = [copy.deepcopy(rng) for _ in self.sensors[1:]] + [rng]
        parts = [
            draw(*(x[..., a, :, :] for x in arrays), rng=source) for a, source in enumerate(sources)
        ]
        return np.stack(parts, axis=-3)

    def _log_likelihoods(self, stack: list[Array], step: Step) -> Array:
        """What each agent makes of the readings it has, (*runs, A, N)."""
        logs = np.zeros(stack[-1].shape[:-1])
        for place, group in step.heard(shared=self.agreement is None):
            rows = group.agents
            predicted = group.predict(stack[place][..., rows, :, :], step.before(place, rows))
            logs[..., rows, :] += log_likelihood(predicted, group.target, group.noise)
        return logs

    def _transported(
        self, stack: list[Array], logs: Array, rng: np.random.Generator
    ) -> tuple[list[Array], dict[tuple[int, ...], str]]:
        """All times' members, carried by the coupling of the last time's; the rows that failed."""

        def compute(here: Array, *rest: Any) -> tuple[Array, ...]:
            times, w = rest[:-2], _normalised(here)
            matrix = _plans(times[-1], w, _solver("network", 0.01))
            return tuple(_carried(x, w, matrix, correct=self.correct) for x in times)

        out, errors = guarded(
            compute, (logs, *stack), tuple(stack), logs.ndim - 1, shared=np.eye(1), rng=None
        )
        if self.rejuvenation:
            draw = partial(_rejuvenated, h=self.rejuvenation)
            # Every time's members meet the same draws; the generator advances once.
            sources = [copy.deepcopy(rng) for _ in out[1:]] + [rng]
            both = zip(out, stack, sources, strict=True)
            out = tuple(self._for_all(draw, (y, x), source) for y, x, source in both)
        # Where nothing was said of the members they stay as they were.
        told = (np.ptp(logs, axis=-1) > 0)[..., None, None]
        return [np.where(told, y, x) for y, x in zip(out, stack, strict=True)], errors
