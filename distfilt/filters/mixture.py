"""Localisation and tracking with Gaussian mixtures: agents share what they believe of a target."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass, field
from typing import Annotated, Any, ClassVar

import numpy as np

from ..mixtures import GaussianMixture, runnalls
from ..mixtures.conditioning import propagate_mixture, update_mixture, within_gate
from ..mixtures.splitting import split_nonlinear
from ..validation import Array, Bounds, PositiveInt
from .base import Filter
from .inputs import Observation, prior_mixtures, sensor_of
from .record import Summary
from .saving import State
from .step import Step

__all__ = ["MixtureFilter", "MixtureState"]

_EXACT = 400
"""Up to how many mixands every pair is a candidate for a merger."""

_ALONE = "one run at a time: mixtures of several runs differ in size"


@dataclass(frozen=True, eq=False, repr=False)
class MixtureState(State):
    """What the agents believe between two steps.

    Parameters
    ----------
    t, ledger, rng, refused
        As for :class:`~distfilt.filters.State`; `rng` is None, as nothing is drawn.
    mixtures : tuple of GaussianMixture
        One for each agent, over its own state [target; ego].
    untold : tuple of (GaussianMixture or None)
        What each agent would believe without the readings that it has not told yet; None where
        there are none. For :class:`InformationIncrementFilter`.

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
class MixtureFilter(Filter):
    """Every agent holds a mixture over [target; its own state]; only target marginals travel.

    In a step an agent splits the mixands that its model stretches most, forecasts all of them,
    conditions them on its reading, sends its target marginal, fuses what it hears, and merges down
    to `size` mixands. A mixand that the sensor cannot see (it predicts NaN for one of its points)
    contradicts a reading and is left out; a reading that all mixands contradict in this way is
    refused by an error.

    Parameters
    ----------
    model : Model
        How an agent's [target; ego] moves.
    sensors, graph, faults, names, gate, every
        As for :class:`~distfilt.filters.Filter`. Agents' states differ, so that readings stay with
        their agents and one run is filtered at a time.
        Several readings of one time are taken one after the other, and the gate tests each against
        what is believed after those before it.
    fusion : callable, optional
        ``agreement(beliefs, channel) -> beliefs`` of the agents' mixtures, such as
        ``partial(target_fusion, target_dim=6)`` of :mod:`distfilt.mixtures`.
    target_dim : int
        How many components, the first of every state, are the target's.
    size : int
        How many mixands an agent keeps after a step.
    most : int
        How many there may be before a forecast; no smaller than `size`.
    stretch : float, optional
        Split where a mixand's weight times its largest stretching is above this; never by default.
    scale : array_like, optional
        What each component is multiplied by before lengths are compared, the same for all agents.

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

    Mixtures differ in size from run to run, so that one run is all that a filter takes:

    >>> f.start(prior, runs=(3,))
    Traceback (most recent call last):
    ValueError: runs: needs (), one run at a time, got (3,)
    >>> MixtureFilter(still, [None], target_dim=1, on_error="keep")
    Traceback (most recent call last):
    ValueError: on_error: one run at a time: mixtures of several runs differ in size
    """

    _: KW_ONLY
    share_observations: bool = False
    target_dim: PositiveInt
    n_components: PositiveInt = 12
    max_components: PositiveInt = 12
    split_threshold: Annotated[float, Bounds(above=0, at_most=1e150)] | None = None
    split_scale: Annotated[Array, "model.dim"] | None = None

    state_class: ClassVar[type[MixtureState]] = MixtureState
    supports_runs: ClassVar[bool] = False
    belief_kind: ClassVar[str | None] = "mixtures"
    unsupported: ClassVar[dict[str, str]] = {
        "share_observations": "agents' own states differ, so that their readings stay with them",
        "lag": "a mixture filter keeps no past",
        "on_error": _ALONE,
    }

    def check_parts(self) -> None:
        """Refuse a model that is smaller than the target."""
        super().check_parts()
        Bounds(at_most=self.model.dim)(self.target_dim, "target_dim")
        Bounds(at_least=self.n_components)(self.max_components, "max_components")

    def initial_state(
        self, prior: Any, runs: tuple[int, ...], rng: Any
    ) -> dict[str, Any]:
        """A mixture for each agent."""
        return {"mixtures": prior_mixtures(prior, self.model.dim, self.n_agents)}

    def next_state(self, step: Step) -> Any:
        """Split and forecast, condition on the own readings, exchange, fuse, reduce."""
        beliefs = [self._moved(b, k, step) for k, b in enumerate(step.state.mixtures)]
        after, untold = self._told(beliefs, step)
        # Without the square roots that they came with: a loaded state has none.
        size = self.n_components
        exact = max(_EXACT, self.n_components)
        agents = len(after)
        plain = [
            None if b is None else runnalls(b, size, heaviest=exact).replace()
            for b in (*after, *untold)
        ]
        return step.end(mixtures=tuple(plain[:agents]), unsent=tuple(plain[agents:]))

    def summarize(self, state: MixtureState) -> Summary:
        """Means, variances and covariances of the whole mixtures, and their sizes."""
        moments = [belief.moments() for belief in state.mixtures]
        mean, cov = (np.array(part) for part in zip(*moments, strict=True))
        sizes = np.array(
            [belief.n_components for belief in state.mixtures], dtype=np.float64
        )
        variance = np.diagonal(cov, axis1=-2, axis2=-1)
        return Summary(mean, variance, cov, numbers={"mixands": sizes})

    def _moved(
        self, belief: GaussianMixture, agent: int, step: Step
    ) -> GaussianMixture:
        """Split where the model stretches, then forecast every mixand.

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
        flow = model.step
        derivative = model.jacobian
        with step.failing_as(agent):
            if self.split_threshold is not None:
                belief = split_nonlinear(
                    belief,
                    lambda x: derivative(x, t, dt),
                    max_components=self.max_components,
                    split_threshold=self.split_threshold,
                    scale=self.split_scale,
                )
            root = model.noise_sqrt(t, dt)
            return propagate_mixture(belief, lambda x: flow(x, t, dt), root)

    def _read(
        self,
        belief: Any,
        agent: int,
        said: Sequence[Observation],
        step: Step,
        beside: Any = None,
    ) -> tuple[Any, Any]:
        """An agent's belief after readings, without those that fail its gate, and one beside it.

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
        from scipy.special import gammaincinv

        for reading in said:
            sensor = sensor_of(self, reading)
            y = reading.value
            about: Any = sensor.predict, sensor.noise_cov
            residual = sensor.residual
            with step.failing_as(agent):
                if self.gate_probability is not None:
                    width = float(
                        np.sqrt(
                            2
                            * gammaincinv(
                                (~np.isnan(y)).sum() / 2, self.gate_probability
                            )
                        )
                    )
                    y = within_gate(belief, y, *about, gate=width, residual=residual)
                belief = update_mixture(belief, y, *about, residual=residual)
                # What passes the gate counts for both, or one would hold it to be news.
                beside = (
                    None
                    if beside is None
                    else update_mixture(beside, y, *about, residual=residual)
                )
            if step.rejected is not None:
                step.rejected[agent] += np.isnan(y).all()
        return belief, beside

    def _told(
        self, beliefs: list[GaussianMixture], step: Step
    ) -> tuple[Sequence[GaussianMixture], Sequence[GaussianMixture | None]]:
        """The beliefs after the agents' readings and their exchange, and what stays untold.

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
        after = [
            self._read(b, k, step.observations[k], step)[0]
            for k, b in enumerate(beliefs)
        ]
        return (self._agreed(after, step) if step.has_fusion else after), ()

    def _agreed(
        self, beliefs: list[GaussianMixture], step: Step
    ) -> list[GaussianMixture]:
        """What the rule of agreement makes of the beliefs."""
        out = list(step.filter.fusion(beliefs, step.channel))
        for k, (fused, belief) in enumerate(zip(out, beliefs, strict=True)):
            if not isinstance(fused, GaussianMixture) or fused.dim != belief.dim:
                got = (
                    fused.dim
                    if isinstance(fused, GaussianMixture)
                    else type(fused).__name__
                )
                raise ValueError(f"fusion must have dimension {belief.dim}, got {got}")
            with step.failing_as(k):
                fused.factors  # noqa: B018  # a LinAlgError where the fusion has collapsed
        return out
