"""A network of transport filters: agents with one set of members in common agree on its weights."""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import KW_ONLY, dataclass
from functools import partial
from typing import Any, ClassVar

import numpy as np

from ..coupling import plans, rejuvenated
from ..coupling.transform import carried, normalised
from ..doors import Array, NonNegative, unchecked
from ..network import finite_time
from ..updates.particles import log_likelihood
from .ensemble import MembersFilter, sample_moments
from .particle import warn_of_collapse
from .step import Step, guarded

__all__ = ["TransportFilter"]


@dataclass(frozen=True, eq=False)
class TransportFilter(MembersFilter):
    r"""Agents that hold the same members, agree on their log-likelihoods, and transport alone.

    Readings of different agents are independent, so the log-likelihood of all of them is A times
    the agents' average, :math:`\log w_i=\sum_a\log p(\mathbf y^a|\mathbf x_i)`. The agreement finds
    it; then every agent computes the same ensemble transform. All agents draw the prior, process
    noise and rejuvenation from one seed, so that the members stay in common.

    Parameters
    ----------
    model, sensors, graph, faults, lag, names, failures, gate
        As for :class:`~distfilt.filters.Filter`. Members in common need an agreement in every step,
        so that `every` is refused.
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

    See Also
    --------
    distfilt.updates.transform_by_agreement : the same step without a filter round it.

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

    _: KW_ONLY
    agreement: Callable[..., Any] | None = finite_time
    correct: bool = False
    rejuvenation: NonNegative = 0.0

    fuses: ClassVar[str] = "vectors"
    unused: ClassVar[dict[str, str]] = {
        "every": "a transport filter's agents have their members in common, so that they have to "
        "agree in every step"
    }

    @property
    def shares(self) -> bool:
        """Readings are told only where nobody agrees on what they say."""
        return self.share and self.agreement is None

    def begin(self, prior: Any, runs: tuple[int, ...], rng: Any) -> dict[str, Any]:
        """One set of members, (N, d) or (*runs, 1, N, d), for all agents."""
        return {"ensembles": np.repeat(self.drawn(prior, (*runs, 1), rng), self.count, axis=-3)}

    def advance(self, step: Step) -> Any:
        """Forecast, weigh by what was seen, agree on the weights, transport.

        Warns
        -----
        ParticleCollapse
            If the weights that are carried over have an effective size below two.
        """
        state, now = step.state, step.state.ensembles
        if step.dt:
            draw = partial(unchecked(self.model.sample_step), t=state.t, dt=step.dt)
            now = self._for_all(draw, (now,), step.rng)
        stack = step.stack(step.moved(now, state.ensembles, 2))
        (logs,) = step.agreed(self._log_likelihoods(stack, step))
        if step.agrees:
            logs = self.count * logs
        stack, errors = self._transported(stack, logs, step.rng)
        step.settle(errors, range(self.count))
        self._warn(logs, step)
        return step.end(ensembles=stack[-1], past=stack[:-1])

    def _for_all(
        self, draw: Callable[..., Array], arrays: tuple[Array, ...], rng: np.random.Generator
    ) -> Array:
        """Apply `draw` agent by agent, each with the same draws; the generator advances once."""
        sources = [copy.deepcopy(rng) for _ in range(self.count - 1)] + [rng]
        parts = [
            draw(*(x[..., a, :, :] for x in arrays), rng=source) for a, source in enumerate(sources)
        ]
        return np.stack(parts, axis=-3)

    def _log_likelihoods(self, stack: list[Array], step: Step) -> Array:
        """What each agent makes of the readings it has, (*runs, A, N)."""
        logs = np.zeros(stack[-1].shape[:-1])
        for place, group in step.heard():
            rows = group.rows
            predicted = group.predict(stack[place][..., rows, :, :], step.before(place, rows))
            group = step.gated(group, partial(sample_moments, predicted))
            logs[..., rows, :] += log_likelihood(predicted, group.target, group.noise)
        return logs

    def _transported(
        self, stack: list[Array], logs: Array, rng: np.random.Generator
    ) -> tuple[list[Array], dict[tuple[int, ...], str]]:
        """All times' members, carried by the coupling of the last time's; the rows that failed."""

        def compute(here: Array, *rest: Any) -> tuple[Array, ...]:
            times, w = rest[:-2], normalised(here)
            matrix = unchecked(plans)(times[-1], here)
            return tuple(carried(x, w, matrix, correct=self.correct) for x in times)

        out, errors = guarded(
            compute, (logs, *stack), tuple(stack), logs.ndim - 1, shared=np.eye(1)
        )
        if self.rejuvenation:
            draw = partial(unchecked(rejuvenated), bandwidth=self.rejuvenation)
            # Every time's members meet the same draws; the generator advances once.
            sources = [copy.deepcopy(rng) for _ in out[1:]] + [rng]
            both = zip(out, stack, sources, strict=True)
            out = tuple(self._for_all(draw, (y, x), source) for y, x, source in both)
        # Where nothing was said of the members they stay as they were.
        told = (np.ptp(logs, axis=-1) > 0)[..., None, None]
        return [np.where(told, y, x) for y, x in zip(out, stack, strict=True)], errors

    def _warn(self, logs: Array, step: Step) -> None:
        """A coupling that carries all to one or two members leaves nothing to go on from."""
        if step.failed.all():
            return
        w = normalised(logs[~step.failed] if step.failed.any() else logs)
        size = float((1 / (w * w).sum(axis=-1)).min())
        if size < 1.1:
            what = f"an agent's weights have an effective size of {size:.1f}"
            warn_of_collapse(step.t, what, "rejuvenation=")
