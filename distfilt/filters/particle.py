"""A network of particle filters: weight draws of the forecast by the likelihood, then resample."""

from __future__ import annotations

import math
from dataclasses import KW_ONLY, dataclass, field
from functools import cached_property
from typing import ClassVar, NamedTuple

import numpy as np

from ..linalg import log_sum_exp
from ..periods import check_transition, fold, settle, warn_of_wrapping
from ..updates import particles
from ..validation import (
    Array,
    Indices,
    Mask,
    Rng,
    UnitInterval,
    all_finite,
    format_number,
)
from .ensemble import AtLeastTwo, MembersFilter, fuse_members, regress_past
from .options import ExchangesAtIntervals, SharesObservations
from .priors import Prior
from .record import Summary
from .states import SensorState, State
from .step import Received, Step, copy_rng

__all__ = ["ParticleFamily", "ParticleFilter", "ParticleState"]


@dataclass(frozen=True, eq=False, repr=False)
class ParticleState(SensorState):
    """The agents' weighted particles between two steps.

    Parameters
    ----------
    t, ledger, rng, rejected, failed, pending
        As for :class:`~distfilt.filters.SensorState`.
    particles : ndarray, (*runs, A, N, d)
    log_weights : ndarray, (*runs, A, N)
        Normalised. They are those after the last observation: a step resamples first.
    history : tuple of (float, ndarray)
        Earlier times and where each particle was then.
    ancestors : ndarray of int, (*runs, A, N), optional
        From which particle each descends, since the process noise last separated the families of
        one ancestor; every particle is its own ancestor by default.

    Examples
    --------
    >>> from distfilt.network import Ledger
    >>> state = ParticleState(
    ...     0.0,
    ...     Ledger.empty(1),
    ...     np.random.default_rng(0),
    ...     np.zeros((1, 5, 3)),
    ...     np.full((1, 5), -np.log(5)),
    ... )
    >>> state.runs
    ()
    """

    particles: Array
    log_weights: Array
    ancestors: Indices | None = field(default=None, kw_only=True)

    belief_field = "particles", (..., "A", "N", "d")

    @cached_property
    def weights(self) -> Array:
        """The normalised weights, (*runs, A, N)."""
        return np.exp(self.log_weights)

    @cached_property
    def effective_size(self) -> Array:
        """Effective sample size of each agent's weights, (*runs, A)."""
        return particles.effective_size_of(self.weights)


@dataclass(frozen=True, eq=False)
class ParticleFamily(MembersFilter[ParticleState]):
    """The common part of filters whose agents hold particles: forecast, weights, resampling.

    Families differ in what the agents exchange.
    """

    _: KW_ONLY
    members: AtLeastTwo = 1000
    ess_threshold: UnitInterval = 0.5
    jitter: UnitInterval | None = None

    state_class: ClassVar[type[State]] = ParticleState
    batched_summary: ClassVar[bool] = True
    supports_likelihoods: ClassVar[bool] = True

    def initial_state(
        self, prior: Prior, runs: tuple[int, ...], rng: Rng | None
    ) -> dict[str, object]:
        """Draw particles for each agent, with equal weights."""
        drawn = self.draw_prior(prior, (*runs, self.n_agents), rng)
        # Angles are shifted by whole periods: each agent's mean is then in [-period/2, period/2).
        drawn = settle(drawn, self.periods)
        # log(1/N)
        log_weights = np.full(drawn.shape[:-1], -np.log(self.members))
        return {"particles": drawn, "log_weights": log_weights}

    def next_state(self, step: Step[ParticleState]) -> ParticleState:
        """Resample where it is due, forecast, weight by the likelihood, fuse.

        Warns
        -----
        ParticleCollapse
            If less than a hundredth of an agent's particles, or only one, are distinct, if the
            effective size of its weights is below two, or if its particles descend from few, whom
            the process noise has not separated, so that they are worth fewer than five: each
            once in a run.
        """
        state = step.state
        # Whole paths are resampled: the stack holds each particle's states at the times that are
        # kept too, the present ones last.
        stack = step.stack(state.particles)
        resampling = self._resample(stack, state, step)
        log_weights = resampling.log_weights
        ancestors = resampling.ancestors
        # The particles before the forecast; they are not in the state's order after resampling.
        origin = stack[-1]
        if step.dt:
            if self.periods:
                # A full turn of an angle before the step has to be a full turn after it.
                check_transition(step.model, origin.mean(axis=-2), state.t, step.dt)
            moved = step.model.sample_step(origin, state.t, step.dt, rng=step.rng)
            stack[-1] = step.check_forecast(moved, origin)
            if self.notices_wrapping:
                warn_of_wrapping(step.model, origin, moved, state.t, step.dt)
        self._assimilate(log_weights, stack, origin, step)
        if self.periods:
            # Moments and fusion need angles near each other: within half a period of their
            # weighted circular mean.
            weights = np.exp(log_weights)
            stack = [fold(paths, self.periods, weights) for paths in stack]
        past, fused = self._fuse(log_weights, stack, ancestors, step)
        if self.periods:
            # An agent's particles are shifted alike, by whole periods, so that their mean is in
            # [-period/2, period/2).
            weights = np.exp(log_weights)
            fused = settle(fused, self.periods, weights)
            past = [settle(paths, self.periods, weights) for paths in past]
        self._warn_of_collapse(fused, log_weights, resampling.worth, step)
        return step.end(
            particles=fused, log_weights=log_weights, past=past, ancestors=ancestors
        )

    def _assimilate(
        self,
        log_weights: Array,
        stack: list[Array],
        origin: Array,
        step: Step[ParticleState],
    ) -> None:
        """Multiply the weights by the likelihoods of the observations, in place.

        The stack has the particles (*runs, A, N, d) of the times that are kept, oldest first, and
        of now; `origin` has those with which the step began, after resampling.
        """
        # An observation of a kept time is compared with the particles of that time.
        for time_index, group in step.received():
            self._weight(log_weights, stack, time_index, group, origin, step)

    def _fuse(
        self,
        log_weights: Array,
        stack: list[Array],
        ancestors: Indices,
        step: Step[ParticleState],
    ) -> tuple[list[Array], Array]:
        """Return the earlier and the present members after the fusion rule, if any."""
        if not step.has_fusion:
            return stack[:-1], stack[-1]
        # A fusion rule moves an ensemble, so the particles need equal weights: all agents resample,
        # each with one uniform number.
        offset = step.rng.random((*log_weights.shape[:-1], 1))
        all_agents = np.ones(log_weights.shape[:-1], bool)
        weights = np.exp(log_weights)
        # The stack, log-weights and ancestors are changed in place.
        self._select(stack, log_weights, weights, all_agents, offset, ancestors)
        fused = fuse_members(step, stack[-1])
        # The fusion moves the present particles; the earlier ones follow by regression.
        return regress_past(stack, fused), fused

    def summarize(self, state: ParticleState) -> Summary:
        """Return weighted moments, effective sizes and the fraction of distinct particles."""
        weights = state.weights
        # A failed run is NaN in the record.
        mean, cov = compute_moments(state.particles, weights)
        cov = state.mask_failed(cov)
        distinct = particles.distinct_fraction(state.particles)
        numbers = {
            "effective_size": state.mask_failed(state.effective_size),
            "distinct": state.mask_failed(distinct),
        }
        variance = np.diagonal(cov, axis1=-2, axis2=-1)
        mean = state.mask_failed(mean)
        return Summary(mean, variance, cov, state.particles, weights, numbers)

    def _weight(
        self,
        log_weights: Array,
        stack: list[Array],
        time_index: int,
        group: Received,
        origin: Array,
        step: Step[ParticleState],
    ) -> None:
        """Multiply a group's weights by the likelihood of its observations, in place.

        The observations are of the time with the index `time_index` in the stack.
        """
        # The index of the group's agents in arrays (*runs, A, ...)
        rows = group.rows
        # The earlier particles with which a sensor of changes compares
        previous = None
        if group.changes:
            previous = step.find_previous(time_index, group, stack[:-1], origin)
        members = stack[time_index][..., rows, :, :]
        predicted = group.predict(members, previous, branch="each")
        if not all_finite(predicted):
            # A particle that cannot see contradicts what was seen, unless none can.
            is_unseen = np.asarray(np.isnan(predicted).all(axis=-2))
            step.note_unseen(group, is_unseen, "no particle can see")
        # log w' = log w + log p(y | x), normalised. The gate predicts with the old weights.
        old = log_weights[..., rows, :]
        group = step.gate(
            group,
            _moments_by_logs,
            predicted,
            old,
            near_observed=True,
            is_gaussian=False,
            weighted=(members, np.exp(old)) if group.likelihoods else None,
        )
        # Sensors that are likelihoods change the weights before the Gaussian ones.
        group, likelihoods = group.log_likelihood(members)
        prior = old + likelihoods
        if step.scores:
            # log Σ wᵢ p(y | xᵢ); a particle without a prediction counts as one that contradicts.
            # The normaliser is what the log-likelihood leaves out, as it is the same for all.
            joint = prior + particles.log_likelihood(
                predicted, group.target, group.noise, contradict=True
            )
            normalizer = particles.log_normalizer(group.target, group.noise)
            total = log_sum_exp(joint)[..., 0] + normalizer
            step.add_log_likelihood(total, group.agents)

        # Predictions h, observations y and log-weights, then what `apply` adds: the noise that all
        # rows share, and a generator.
        def compute(
            h: Array, y: Array, logs: Array, noise: Array, _rng: object
        ) -> tuple[Array]:
            return (particles.reweight(logs, h, y, noise),)

        (new,) = step.apply(
            compute,
            (predicted, group.target, prior),
            (old,),
            group.agents,
            shared=group.noise,
        )
        log_weights[..., rows, :] = new

    def _resample(
        self, stack: list[Array], state: ParticleState, step: Step[ParticleState]
    ) -> _Resampling:
        """Resample agents with a small effective size: the stack in place.

        Resampling leaves copies of particles, which count as one until noise separates them. That
        is the noise of the jitter, if it has a bandwidth. Otherwise it is the process noise, and
        where few ancestors are left, it is tested whether that is enough: a *family* are the
        particles that descend from one ancestor, and families that the noise has not spread are
        worth few independent particles, see :func:`measure_families`. Then noise is added for what
        is missing, unless the user has chosen the jitter.

        >>> from distfilt.models import constant_velocity
        >>> f = ParticleFilter(
        ...     constant_velocity(sigma=1.0),
        ...     [None] * 2,
        ...     share_observations=False,
        ...     members=4,
        ...     ess_threshold=0.9,
        ...     jitter=0.5,
        ... )
        >>> state = f.start((np.zeros(4), np.eye(4)), rng=np.random.default_rng(0))
        >>> equal, unequal = state.log_weights[0], np.log([0.7, 0.1, 0.1, 0.1])
        >>> after = [
        ...     f.step(
        ...         state.replace(log_weights=np.array([w, unequal])), 0.0, [None] * 2
        ...     )
        ...     for w in (equal, unequal)
        ... ]
        >>> (after[0].particles == after[1].particles).all(axis=(1, 2))
        array([False,  True])
        """
        log_weights = state.log_weights.copy()
        ancestors = find_ancestors(state)
        # The present particles; before them the stack holds those of earlier times.
        before = stack[-1]
        # Every agent draws, also if it does not resample: its numbers must not depend on
        # another's weights. A systematic resampling needs one uniform number.
        offset = step.rng.random((*log_weights.shape[:-1], 1))
        bandwidth = self._bandwidth(state.t, step.dt)
        noise = step.rng.standard_normal(before.shape) if bandwidth else None
        # N_eff = 1 / Σ w²
        is_due = state.effective_size < self.ess_threshold * self.members
        if not np.count_nonzero(is_due):
            return _Resampling(log_weights, ancestors)
        is_tested = is_due & self._has_few_ancestors(ancestors)
        # Weights of failed runs mean nothing.
        is_tested[state.failed] = False
        if noise is None and not np.count_nonzero(is_tested):
            # The usual case: no copies to separate, no families to look into.
            self._select(stack, log_weights, state.weights, is_due, offset, ancestors)
            return _Resampling(log_weights, ancestors)
        # An agent's particles have to be worth so many independent ones: a fiftieth of them, within
        # the bounds `_MIN_WORTH` and `_SUFFICIENT_WORTH`.
        least = min(max(_MIN_WORTH, 0.02 * self.members), _SUFFICIENT_WORTH)
        # How many they are worth, and which share of their variance lies within families; infinity
        # and one for agents that are not tested.
        worths, shares_within = measure_families(
            before, state.weights, ancestors, is_tested, least
        )
        # Where half of the variance lies within families, these are as wide as they lie apart, and
        # no clones of one particle any more.
        is_renewed = is_tested & (shares_within > 0.5)
        is_collapsed = worths < least
        counts = self._select(
            stack, log_weights, state.weights, is_due, offset, ancestors
        )
        if noise is None and self.jitter is None and is_collapsed.any():
            # The process noise is too small to separate copies. The variance of the noise that is
            # added is in proportion to what is missing, (least - n) / least.
            missing = np.where(is_collapsed, 1 - worths / least, 0.0)
            noise = _draw_separately(step.rng, before.shape)
            noise *= np.sqrt(missing)[..., None, None]
            bandwidth = particles.silverman(self.members, self.model.dim)
        if noise is not None:
            stack[-1][is_due] = self._separate_copies(
                stack[-1][is_due],
                before[is_due],
                state.weights[is_due],
                counts,
                noise[is_due],
                bandwidth,
            )
        # Families begin anew once the noise has separated their members: every particle is its own
        # ancestor.
        ancestors[is_renewed] = np.arange(self.members)
        # The agent that is worst off decides about a warning.
        worth = float(worths.min(initial=np.inf))
        return _Resampling(log_weights, ancestors, worth)

    def _separate_copies(
        self,
        resampled: Array,
        before: Array,
        weights: Array,
        counts: Indices,
        noise: Array,
        bandwidth: float,
    ) -> Array:
        """Add noise to copies in units of the weighted spread before the resampling.

        The arrays are those of the K agents that have resampled: the particles after and `before`
        it, (K, N, d), their former weights, (K, N), and how often each was taken, which has K N
        numbers too.
        """
        # Where one weight dominates, the weighted spread is gone; all particles' is used.
        is_degenerate = particles.effective_size_of(weights)[:, None] < 2
        weights = np.where(is_degenerate, 1 / self.members, weights)
        _mean, cov = compute_moments(before, weights)
        # Of each particle after the resampling: whether it is one of several copies
        is_copied = (counts > 1)[..., None]
        copied = particles.repeat_by_count(is_copied, counts)
        return particles.add_jitter(
            resampled, cov, bandwidth, noise, copied.reshape(-1, self.members)
        )

    def _has_few_ancestors(self, ancestors: Indices) -> Mask:
        """Whether all particles of an agent descend from less than a tenth of their number."""
        # Resampling keeps the order, so descendants of one ancestor are neighbours, and a family
        # begins where the ancestor changes.
        n_families = 1 + (ancestors[..., 1:] != ancestors[..., :-1]).sum(axis=-1)
        return np.asarray(n_families < 0.1 * self.members)

    def _bandwidth(self, t: float, dt: float) -> float:
        """Return the bandwidth of the jitter; by default none if the model has noise."""
        if self.jitter is not None:
            return self.jitter
        if self.model.has_state_noise:
            return 0.0
        # A step of no length adds no noise, so a unit step shows whether the model has any.
        if np.count_nonzero(self.model.Q(t, dt or 1.0)):
            return 0.0
        return particles.silverman(self.members, self.model.dim)

    def _select(
        self,
        stack: list[Array],
        log_weights: Array,
        weights: Array,
        agents: Mask,
        offset: Array,
        ancestors: Indices,
    ) -> Indices:
        """Resample some agents' paths in the stack and their ancestors; weights are equal then.

        `agents` (*runs, A) is true for those that resample, and `offset` (*runs, A, 1) is each
        one's uniform number. The stack, the log-weights and the ancestors are changed in place.
        Returns how often each particle was taken.
        """
        # All agents as a slice, which need not be copied
        rows: slice | Mask = slice(None) if agents.all() else agents
        counts = particles.systematic_counts(weights[rows], offset[rows])
        for k, path in enumerate(stack):
            taken = particles.repeat_by_count(path[rows], counts)
            if rows is agents:
                stack[k] = path.copy()
                stack[k][rows] = taken
            else:
                stack[k] = taken
        # A copy has the ancestor of its original. An agent's counts add up to N, so that the flat
        # list falls back into rows.
        descents = np.repeat(ancestors[rows].reshape(-1), counts.reshape(-1))
        ancestors[rows] = descents.reshape(counts.shape)
        # After resampling every particle has the weight 1/N.
        log_weights[rows] = -np.log(self.members)
        return counts

    def _warn_of_collapse(
        self,
        points: Array,
        log_weights: Array,
        worth: float,
        step: Step[ParticleState],
    ) -> None:
        """Warn if few particles are distinct, have any weight, or have ancestors of their own.

        `worth` is the least number of independent particles that an agent's are worth.
        """
        # The effective sample sizes 1 / Σ w², of the runs that have not failed
        size = particles.effective_size_of(np.exp(log_weights))
        if np.count_nonzero(step.failed):
            points = points[~step.failed]
            size = size[~step.failed]
        smallest_size = size.min(initial=np.inf)
        # A hundredth of all, or two: fewer distinct ones are a collapse.
        fewest = max(0.01 * self.members, 2.0)
        n_distinct = self._count_distinct(points, fewest)
        if n_distinct < fewest:
            kind = "distinct"
            share = n_distinct / self.members
            problem = f"{share:.2%} of an agent's particles are distinct"
        elif smallest_size < 2:
            kind = "weights"
            problem = (
                f"an agent's weights have an effective size of {smallest_size:.1f}"
            )
        # Fewer than five independent particles, half of those below which copies are jittered
        elif worth < 0.5 * _MIN_WORTH:
            kind = "ancestors"
            problem = (
                f"an agent's particles are worth {worth:.1f}: they descend from few, and "
                "the process noise has not separated them"
            )
        else:
            return
        text = particles.describe_collapse(
            f"t = {format_number(step.t)} s: {problem}", "jitter="
        )
        step.warn_once(f"collapse of {kind}", text, particles.ParticleCollapse)

    def _count_distinct(self, points: Array, fewest: float) -> float:
        """Return a lower bound of the smallest number of distinct particles of an agent.

        It is exact if it is below `fewest`.
        """
        # A sample of about four times `fewest` particles whose first components differ is enough.
        # Only if they do not, e.g. because a component is known, all particles are compared.
        stride = max(1, self.members // (4 * math.ceil(fewest)))
        first = np.sort(points[..., ::stride, 0])
        differs = first[..., 1:] > first[..., :-1]
        n_differences = differs.shape[-1]
        if n_differences >= fewest and np.count_nonzero(differs) == differs.size:
            return float(n_differences)
        n_distinct = differs.sum(axis=-1)
        bound = float(n_distinct.min(initial=self.members))
        if bound < fewest:
            bound = particles.distinct_fraction(points).min() * self.members
        return bound


@dataclass(frozen=True, eq=False)
class ParticleFilter(
    ParticleFamily,
    SharesObservations[ParticleState],
    ExchangesAtIntervals[ParticleState],
):
    """One bootstrap particle filter per agent, for any model and sensors.

    Parameters
    ----------
    model, sensors, graph, gate_probability, faults, names
        As for :class:`~distfilt.filters.SensorFilter`.
    fusion, share_observations, hops, lag, on_error, exchange_interval, record_evidence
        As in :mod:`distfilt.filters.options`. The rule is one of ensembles; agents resample
        before it.
    members : int
        Number N of particles of each agent.
    ess_threshold : float
        An agent resamples, by :func:`distfilt.updates.resample`, when its effective sample size
        falls below this fraction of N, in [0, 1].
    jitter : float, optional
        Bandwidth of the kernel that separates copies, in [0, 1], in units of the particles'
        weighted spread; 0 for none. Particles that were not copied stay. By default Silverman's
        for a model without noise, whose copies never part by themselves. For others it is used
        only where few ancestors are left, whose descendants the noise has not separated, and the
        more the fewer they are worth. Where the noise is as large as the spread of the particles
        0 is better still: in a random walk whose thousand particles are resampled at every step,
        the mean is off by 0.21 standard deviations in the median run, and by 0.18 without jitter.

    Notes
    -----
    N. J. Gordon, D. J. Salmond, A. F. M. Smith, IEE Proceedings F 140 (1993) 107-113.

    Examples
    --------
    >>> from distfilt.models import Model
    >>> from distfilt.sensors import component
    >>> walk = Model(1, lambda x, t, dt: x, lambda t, dt: np.array([[dt]]))
    >>> f = ParticleFilter(walk, [component([0], std=1.0)], members=500)
    >>> state = f.start(([0.0], [[1.0]]), rng=np.random.default_rng(1))
    >>> f.summarize(f.step(state, 1.0, [[3.0]])).mean.round(1)
    array([[1.9]])
    """

    supports_agent_models: ClassVar[bool] = True


_TINY = np.finfo(float).tiny
_MIN_WORTH = 10.0
"""Copies are jittered if the particles are worth fewer independent ones, or less than a fiftieth of
their number; below half of `_MIN_WORTH`, a warning is given."""
_SUFFICIENT_WORTH = 40.0
"""No jitter if the particles are worth so many: the mean's error then adds 1/40 to its variance."""


class _Resampling(NamedTuple):
    """Log-weights after a resampling, and each particle's ancestor, (*runs, A, N).

    `worth` is the smallest number of independent particles that the families of a tested agent
    were worth; infinite if none had to be tested.
    """

    log_weights: Array
    ancestors: Indices
    worth: float = np.inf


def _draw_separately(rng: Rng, shape: tuple[int, ...]) -> Array:
    """Draw standard normal numbers by a generator seeded from `rng`, which does not advance.

    Draws that only some steps need do not change those of the other agents and steps.
    """
    # Four words of 64 bits as a seed
    words = copy_rng(rng).bit_generator.random_raw(4).tolist()
    return np.random.default_rng(words).standard_normal(shape)


def find_ancestors(state: ParticleState) -> Indices:
    """Return the ancestors of a state's particles, a copy; by default each is its own."""
    shape = state.log_weights.shape
    ancestors = state.ancestors
    if ancestors is not None and ancestors.shape == shape:
        return ancestors.copy()
    return np.broadcast_to(np.arange(shape[-1]), shape).copy()


def measure_families(
    points: Array,
    weights: Array,
    ancestors: Indices,
    agents: Mask,
    least: float = np.inf,
) -> tuple[Array, Array]:
    """Return what the particles of some agents are worth, and how far families are separated.

    Families of weights W_a and of the share s of the variance within them have a weighted mean
    with the error of 1 / (Σ W_a² (1 - s)) independent particles. The first result is this number
    and the second s, each the least over the components; infinity and one for other agents. From
    `least` families on they are not looked into: their number bounds the first, and s is zero.

    >>> x = np.array([[[0.0], [0.1], [1.0], [1.1]], [[0.0], [1.0], [0.0], [1.0]]])
    >>> families = np.array([[0, 0, 3, 3]] * 2)
    >>> agents = np.array([True, True])
    >>> sizes, shares = measure_families(x, np.full((2, 4), 0.25), families, agents)
    >>> sizes.round(2), shares.round(2)
    (array([2.02, inf]), array([0.01, 1.  ]))
    """
    sizes = np.full(agents.shape, np.inf)
    shares = np.ones(agents.shape)
    for index in zip(*np.nonzero(agents), strict=True):
        # Components first, so that sums run along all particles.
        x = np.ascontiguousarray(points[index].T)
        w = weights[index]
        labels = ancestors[index]
        # Descendants of one ancestor are neighbours: a family starts where the ancestor changes.
        is_start = np.ones(labels.size, dtype=bool)
        np.not_equal(labels[1:], labels[:-1], out=is_start[1:])
        starts = np.flatnonzero(is_start)
        # The weights of the families, and their effective number
        mass = np.add.reduceat(w, starts)
        n_families = 1 / (mass**2).sum()
        if n_families >= least:
            sizes[index] = n_families
            shares[index] = 0.0
            continue
        # Means of the families, at each of their members.
        weighted = w * x
        positive = np.maximum(mass, _TINY)
        means = np.add.reduceat(weighted, starts, axis=-1) / positive
        mean = weighted.sum(axis=-1)
        # The number of families that have begun is the number of each member's family, from 1.
        within = (x - means[:, is_start.cumsum() - 1]) ** 2 @ w
        total = (x - mean[:, None]) ** 2 @ w
        # A component that is known has no variance but rounding.
        is_spread = np.asarray(total > (1e-12 * np.abs(mean)) ** 2)
        if not is_spread.any():
            continue
        shares[index] = min((within[is_spread] / total[is_spread]).min(), 1.0)
        if shares[index] < 1:
            sizes[index] = n_families / (1 - shares[index])
    return sizes, shares


def _moments_by_logs(predicted: Array, log_weights: Array) -> tuple[Array, Array]:
    """Return moments of the predictions of the particles that can see; NaN if none can."""
    weights = np.exp(log_weights)
    if not all_finite(predicted):
        predicted, weights = select_visible(predicted, weights)
    return compute_moments(predicted, weights)


def select_visible(predicted: Array, weights: Array) -> tuple[Array, Array]:
    """Return predictions (..., N, m) and weights (..., N) of the points that can see.

    The others' predictions and weights are zero, and the weights are normalised again: NaN if
    no point can see.
    """
    is_visible = np.asarray(~np.isnan(predicted).any(axis=-1))
    weights = np.where(is_visible, weights, 0.0)
    total = weights.sum(axis=-1, keepdims=True)
    # Divided by NaN in place of zero where no point can see
    weights = weights / np.where(total > 0, total, np.nan)
    return np.where(is_visible[..., None], predicted, 0.0), weights


def compute_moments(points: Array, weights: Array) -> tuple[Array, Array]:
    """Mean (..., d) and covariance (..., d, d) of points (..., N, d) with weights (..., N)."""
    # m = Σ wᵢ xᵢ and P = Σ wᵢ (xᵢ - m)(xᵢ - m)ᵀ
    mean = (weights[..., None, :] @ points)[..., 0, :]
    # Components first, so that the weights multiply along contiguous particles.
    anomalies = np.subtract(points.mT, mean[..., None], order="C")
    return mean, (weights[..., None, :] * anomalies) @ anomalies.mT
