"""Localisation and tracking with Gaussian mixtures: agents share their beliefs about a target."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import KW_ONLY, dataclass, field
from functools import partial
from typing import Annotated, ClassVar, cast

import numpy as np

from ..linalg import deviations
from ..mixtures import GaussianMixture, runnalls
from ..mixtures.conditioning import (
    propagate_mixture,
    propagate_together,
    update_mixture,
    within_gate,
)
from ..mixtures.fusion import align_mixture
from ..mixtures.splitting import split_nonlinear
from ..network import Channel
from ..periods import (
    Periods,
    check_sensor,
    fold,
    settle,
    step_members,
    warn_of_wrapping,
)
from ..validation import (
    Array,
    Bounds,
    InvalidArgumentError,
    PositiveInt,
    Rng,
    call_user,
)
from .base import SensorFilter
from .failures import RECOVERABLE
from .observations import Observation, sensor_of
from .options import ExchangesAtIntervals, FusesBeliefs
from .priors import Prior, prior_mixtures
from .record import Summary
from .states import State
from .step import Step, predict_points

__all__ = ["MixtureFilter", "MixtureState", "TargetMixtureFilter"]

MixtureRule = Callable[[list[GaussianMixture], Channel], Iterable[object]]
"""A fusion rule: it gets all agents' mixtures and the channel, and returns as many."""

_MAX_ALL_PAIRS = 400
"""Up to how many components every pair is a candidate for a merger."""


@dataclass(frozen=True, eq=False, repr=False)
class MixtureState(State):
    """The agents' mixtures between two steps.

    Parameters
    ----------
    t, ledger, rng, rejected
        As for :class:`~distfilt.filters.State`; `rng` is None, as nothing is drawn.
    mixtures : tuple of GaussianMixture
        One for each agent, over its own state [target; ego].
    unsent : tuple of (GaussianMixture or None)
        Each agent's belief without the observations whose information it has not sent yet; None
        if there are none. For :class:`InformationIncrementFilter`.

    Examples
    --------
    >>> from distfilt.network import Ledger
    >>> belief = GaussianMixture.gaussian([0.0], [[1.0]])
    >>> MixtureState(0.0, Ledger.empty(1), None, (belief,)).mixtures[0].n_components
    1
    """

    mixtures: tuple[GaussianMixture, ...] = ()
    unsent: tuple[GaussianMixture | None, ...] = field(default=(), kw_only=True)


@dataclass(frozen=True, eq=False)
class TargetMixtureFilter(
    SensorFilter[MixtureState], ExchangesAtIntervals[MixtureState]
):
    """The common part of filters whose agents hold a mixture over [target; ego].

    The agents' states differ, so the observations stay with their agents and one run is filtered
    at a time. A family supplies `_assimilate`.
    """

    _: KW_ONLY
    target_dim: PositiveInt
    n_components: PositiveInt = 12
    max_components: PositiveInt = 12
    split_threshold: Annotated[float, Bounds(above=0, at_most=1e150)] | None = None
    split_scale: Annotated[Array, "model.dim"] | None = None

    state_class: ClassVar[type[State]] = MixtureState
    supports_runs: ClassVar[bool] = False

    def check_parts(self) -> None:
        """Refuse a model that is smaller than the target, or whose noise depends on the state."""
        super().check_parts()
        if self.model.has_state_noise:
            raise ValueError(
                "model must have a noise that does not depend on the state here, got a "
                f"{type(self.model).__name__}"
            )
        Bounds(at_most=self.model.dim)(self.target_dim, "target_dim")
        Bounds(at_least=self.n_components)(self.max_components, "max_components")

    def initial_state(
        self, prior: Prior, runs: tuple[int, ...], rng: Rng | None
    ) -> dict[str, object]:
        """Return a mixture for each agent."""
        mixtures = prior_mixtures(
            prior, self.model.dim, self.n_agents, periods=self.periods
        )
        # Angles of the components near each other, with their mean in [-period/2, period/2)
        settled = [settle_mixture(mixture, self.periods) for mixture in mixtures]
        return {"mixtures": tuple(settled)}

    def next_state(self, step: Step[MixtureState]) -> MixtureState:
        """Split and forecast, condition on the agent's observations, exchange, reduce."""
        beliefs = self._forecast_all(step.state.mixtures, step)
        # Conditioning and exchange are the family's.
        after, unsent = self._assimilate(beliefs, step)
        return step.end(
            mixtures=tuple([self._reduce(belief) for belief in after]),
            unsent=tuple(
                [None if belief is None else self._reduce(belief) for belief in unsent]
            ),
        )

    def _reduce(self, belief: GaussianMixture) -> GaussianMixture:
        """Merge components until `n_components` are left."""
        # Angles near each other before the merger, with their mean in [-period/2, period/2)
        belief = settle_mixture(belief, self.periods)
        # Of many components only pairs with the heaviest are candidates.
        n_pairs = max(_MAX_ALL_PAIRS, self.n_components)
        reduced = runnalls(belief, self.n_components, heaviest=n_pairs)
        # The mean of merged angles may lie beyond half a period.
        reduced = settle_mixture(reduced, self.periods)
        # A copy without the cached Cholesky factors, which a state loaded from a file does not have
        # either: the next step computes the same from both.
        return reduced.replace()

    def summarize(self, state: MixtureState) -> Summary:
        """Return moments of the whole mixtures, and their numbers of components."""
        mean = np.array([belief.mean for belief in state.mixtures])
        cov = np.array([belief.cov for belief in state.mixtures])
        # Recorded as an array (A,) like the other numbers.
        sizes = [float(belief.n_components) for belief in state.mixtures]
        variance = np.diagonal(cov, axis1=-2, axis2=-1)
        return Summary(mean, variance, cov, numbers={"mixands": np.array(sizes)})

    def _assimilate(
        self, beliefs: list[GaussianMixture], step: Step[MixtureState]
    ) -> tuple[Sequence[GaussianMixture], Sequence[GaussianMixture | None]]:
        """Return the beliefs after observations and exchange, and the `unsent` of the state."""
        raise NotImplementedError

    def _forecast_all(
        self, beliefs: Sequence[GaussianMixture], step: Step[MixtureState]
    ) -> list[GaussianMixture]:
        """Forecast all agents' beliefs: in one call, unless components are split."""
        if self.split_threshold is None and step.dt:
            # After an error the agents are forecast one by one below, where it names its agent.
            with suppress(*RECOVERABLE):
                return propagate_together(beliefs, *self._motion(step))
        return [
            self._forecast(belief, agent, step) for agent, belief in enumerate(beliefs)
        ]

    def _motion(
        self, step: Step[MixtureState]
    ) -> tuple[Callable[[Array], Array], Array]:
        """Return the function that moves points in a step, and the factor of its noise."""
        t = step.state.t
        noise_sqrt = self.model.noise_sqrt(t, step.dt)
        # With angles, points must not be torn apart by a wrap, or a warning must say so.
        if self.periods or self.notices_wrapping:
            return partial(self._step_points, step), noise_sqrt
        return partial(self.model.step, t=t, dt=step.dt), noise_sqrt

    def _forecast(
        self, belief: GaussianMixture, agent: int, step: Step[MixtureState]
    ) -> GaussianMixture:
        """Split where the model is nonlinear, then forecast every component.

        >>> from distfilt.models import Model
        >>> later = Model(
        ...     1, lambda x, t, dt: x + t * dt, lambda t, dt: np.zeros((1, 1))
        ... )
        >>> f = MixtureFilter(later, [None], target_dim=1)
        >>> f.step(f.start(([0.0], [[1.0]]), t=2.0), 3.0, [None]).mixtures[0].means
        array([[2.]])
        """
        t = step.state.t
        dt = step.dt
        model = self.model
        if dt == 0:
            return belief
        # An error in the block names the agent.
        with step.failing_as(agent):
            if self.split_threshold is not None:
                # Components for which the model is most nonlinear are split. Finite differences
                # take their steps from the belief's standard deviations.
                std = deviations(belief.cov)
                belief = split_nonlinear(
                    belief,
                    partial(model.jacobian, t=t, dt=dt, std=std),
                    max_components=self.max_components,
                    split_threshold=self.split_threshold,
                    scale=self.split_scale,
                )
            return propagate_mixture(belief, *self._motion(step))

    def _step_points(self, step: Step[MixtureState], points: Array) -> Array:
        """Move the components' points (L, N, d) by the model without noise.

        The angles of each component's N points are near each other afterwards.
        """
        t = step.state.t
        moved = step_members(self.model, points, t, step.dt)
        if self.notices_wrapping:
            warn_of_wrapping(self.model, points, moved, t, step.dt)
        return moved

    def _condition(
        self,
        belief: GaussianMixture,
        agent: int,
        observations: Sequence[Observation],
        step: Step[MixtureState],
        second: GaussianMixture | None = None,
    ) -> tuple[GaussianMixture, GaussianMixture | None]:
        """Condition an agent's belief, and a second one, on observations that pass its gate.

        The second one is the belief without the information that the agent has still to send.

        >>> from distfilt.models import Model
        >>> from distfilt.sensors import component
        >>> still = Model(2, lambda x, t, dt: x, lambda t, dt: np.zeros((2, 2)))
        >>> eyes = [component([k], std=1.0) for k in range(2)]
        >>> f = MixtureFilter(still, [eyes], target_dim=2, gate_probability=0.99)
        >>> state = f.start((np.zeros(2), np.eye(2)))
        >>> state = f.step(
        ...     state,
        ...     0.0,
        ...     [[Observation(0.0, 0, [9.0]), Observation(0.0, 0, [1.0], 1)]],
        ... )
        >>> state.mixtures[0].means, state.rejected
        (array([[0. , 0.5]]), array([1.]))
        """
        for observation in observations:
            sensor = sensor_of(self, observation)
            value = observation.value
            predict = sensor.predict
            if self.periods:
                check_sensor(sensor, self.model, belief.means)
            if sensor.wraps:
                # Predicts the angles of a component's points without a jump by a period between
                # them, so that plain differences compare them: `on_branch`
                predict = partial(predict_points, sensor)
            with step.failing_as(agent):
                if self.gate_probability is not None:
                    value = within_gate(
                        belief,
                        value,
                        predict,
                        sensor.noise_cov,
                        gate=_gate_width(value, self.gate_probability),
                        residual=sensor.residual,
                        on_branch=True,
                    )
                # p(y | x) = N(y; h(x), R)
                likelihood = (value, predict, sensor.noise_cov)
                residual = sensor.residual
                belief = update_mixture(
                    belief, *likelihood, residual=residual, on_branch=True
                )
                # Both beliefs get the observations, so that the information to be sent, their
                # difference, does not change.
                if second is not None:
                    second = update_mixture(
                        second, *likelihood, residual=residual, on_branch=True
                    )
            # The gate puts NaN in place of a rejected observation.
            is_rejected = bool(np.isnan(value).all())
            step.note_gated(agent, observation, is_rejected=is_rejected)
        return belief, second


def settle_mixture(mixture: GaussianMixture, periods: Periods) -> GaussianMixture:
    """Shift angles of a mixture's means by whole periods, so that they are near each other.

    Each is then within half a period of their circular mean, and the mixture's mean in
    [-period/2, period/2).

    >>> two = GaussianMixture([0.5, 0.5], [[3.1], [-3.1]], [[[0.1]]] * 2)
    >>> settle_mixture(two, (2 * np.pi,)).means.ravel().round(4)
    array([-3.1832, -3.1   ])
    """
    if not periods:
        return mixture
    weights = mixture.weights
    means = settle(fold(mixture.means, periods, weights), periods, weights)
    # The factors of the covariances, which a mixture may have cached, stay valid.
    return mixture if means is mixture.means else _move_means(mixture, means)


def _move_means(mixture: GaussianMixture, means: Array) -> GaussianMixture:
    """Return a mixture with other means, and with the covariances' factors if it has them."""
    # A cached property is in the instance's dictionary once it has been computed.
    cached = {}
    if "factors" in vars(mixture):
        cached["factors"] = mixture.factors
    return GaussianMixture.construct(mixture.weights, means, mixture.covs, **cached)


def _gate_width(value: Array, probability: float) -> float:
    """Return the gate in standard deviations: the root of the chi-squared quantile."""
    from scipy.special import gammaincinv

    # χ²(m) of the m numbers that are not missing, whose quantile is 2 P⁻¹(m / 2, probability)
    size = (~np.isnan(value)).sum()
    return float(np.sqrt(2 * gammaincinv(size / 2, probability)))


@dataclass(frozen=True, eq=False)
class MixtureFilter(TargetMixtureFilter, FusesBeliefs[MixtureState]):
    """Every agent holds a mixture over [target; its own state]; only target marginals are sent.

    In a step an agent splits the components for which its model is most nonlinear, forecasts all
    of them, conditions them on its observation, sends its target marginal, fuses the marginals it
    receives, and merges down to `n_components`. A component that cannot predict an observation (the
    sensor gives NaN for one of its points) contradicts it and is left out; an observation that
    contradicts all components raises an error. Agents that share their observations instead of
    fusing beliefs, all runs at once: :class:`GaussianSumFilter`.

    Parameters
    ----------
    model : Model
        The motion of an agent's [target; ego].
    sensors, graph, gate_probability, faults, names
        As for :class:`~distfilt.filters.SensorFilter`. Several observations of one time are
        assimilated one after the other, and the gate tests each given those before it.
    exchange_interval
        As in :mod:`distfilt.filters.options`.
    fusion : callable, optional
        ``fusion(beliefs, channel) -> beliefs`` of the agents' mixtures, such as
        ``partial(target_fusion, target_dim=6)`` of :mod:`distfilt.mixtures`.
    target_dim : int
        Number of the target's components; they are the first of every state.
    n_components : int
        Number of components that an agent keeps after a step.
    max_components : int
        Their largest number before a forecast; no smaller than `n_components`.
    split_threshold : float, optional
        Split where a component's weight times its nonlinearity is above this; never by default.
    split_scale : array_like, optional
        Factors of the state's components before lengths are compared, the same for all agents.

    Examples
    --------
    >>> from functools import partial
    >>> from distfilt.mixtures import target_fusion
    >>> from distfilt.models import Model
    >>> from distfilt.network import graphs
    >>> from distfilt.sensors import component
    >>> still = Model(2, lambda x, t, dt: x, lambda t, dt: np.zeros((2, 2)))
    >>> f = MixtureFilter(
    ...     still,
    ...     [component([0], std=1.0), None],
    ...     graphs.path(2),
    ...     target_dim=1,
    ...     fusion=partial(target_fusion, target_dim=1),
    ... )
    >>> prior = GaussianMixture.gaussian([0.0, 0.0], [[1.0, 0.5], [0.5, 1.0]])
    >>> after = f.step(f.start([prior, prior]), 1.0, [[2.0], None])
    >>> after.mixtures[1].means.round(4), after.ledger.scalars
    (array([[0.6667, 0.3333]]), array([3, 3]))

    Mixtures differ in size from run to run, so a filter has a single run:

    >>> f.start(prior, runs=(3,))
    Traceback (most recent call last):
    ValueError: runs must be () for a filter of one run at a time, got (3,)
    """

    belief_kind: ClassVar[str | None] = "mixtures"

    def _assimilate(
        self, beliefs: list[GaussianMixture], step: Step[MixtureState]
    ) -> tuple[Sequence[GaussianMixture], Sequence[GaussianMixture | None]]:
        """Return the beliefs after the agents' observations and the fusion; nothing is unsent.

        >>> from functools import partial
        >>> from distfilt.mixtures import target_fusion
        >>> from distfilt.models import Model
        >>> from distfilt.network import Faults, graphs
        >>> still = Model(1, lambda x, t, dt: x, lambda t, dt: np.zeros((1, 1)))
        >>> f = MixtureFilter(
        ...     still,
        ...     [None] * 3,
        ...     graphs.path(3),
        ...     target_dim=1,
        ...     fusion=partial(target_fusion, target_dim=1),
        ...     faults=Faults(silent=[0]),
        ... )
        >>> f.step(f.start(([0.0], [[1.0]])), 1.0, [None] * 3).ledger.messages
        array([0, 1, 1])
        """
        after = []
        for agent, belief in enumerate(beliefs):
            # Observations stay with their agent.
            observations = step.observations[agent]
            updated, _second = self._condition(belief, agent, observations, step)
            after.append(updated)
        if step.has_fusion:
            after = self._fuse(after, step)
        return after, ()

    def _fuse(
        self, beliefs: list[GaussianMixture], step: Step[MixtureState]
    ) -> list[GaussianMixture]:
        """Apply the fusion rule and check its results."""
        # Mixtures have a rule of their own, with a list of them.
        rule = cast(MixtureRule, self.fusion)
        if self.periods:
            # The rule gets agents' means whose angles are near each other, within half a period of
            # the agents' circular mean.
            settled = [settle_mixture(belief, self.periods) for belief in beliefs]
            common = fold(np.array([belief.mean for belief in settled]), self.periods)
            pairs = zip(settled, common, strict=True)
            beliefs = [align_mixture(b, mean, self.periods) for b, mean in pairs]
        fused = list(call_user(rule, beliefs, step.channel))
        checked: list[GaussianMixture] = []
        for agent, (new, old) in enumerate(zip(fused, beliefs, strict=True)):
            if not isinstance(new, GaussianMixture):
                raise InvalidArgumentError(
                    f"fusion must return mixtures of dimension {old.dim}, got a "
                    f"{type(new).__name__}"
                )
            if new.dim != old.dim:
                raise ValueError(
                    f"fusion must return mixtures of dimension {old.dim}, got {new.dim}"
                )
            with step.failing_as(agent):
                # The property factors the covariances: a LinAlgError if one is singular.
                new.factors  # noqa: B018
            checked.append(new)
        return checked
