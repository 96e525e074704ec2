"""Localisation and tracking with Gaussian mixtures: agents share what they believe of a target."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import KW_ONLY, dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from ..checks import Array, array, choice, count, instance, number, same_length
from ..doors import unchecked
from ..mixtures import (
    GaussianMixture,
    conditioned,
    moved,
    split_stretched,
    two_stage,
    within_gate,
)
from ..models import Model
from ..network import Channel, Faults, Graph, Ledger
from ..sensors import Sensor
from .driver import Summary, TeamFilter, described
from .observations import at_one_time
from .saving import State

__all__ = ["MixtureFilter", "MixtureState"]

Agreement = Callable[[GaussianMixture, Sequence[GaussianMixture]], GaussianMixture]
_EXACT = 400
"""Up to how many mixands every pair is a candidate for a merger."""


@dataclass(frozen=True, eq=False)
class MixtureState(State):
    """What the agents believe between two steps.

    Parameters
    ----------
    t, ledger, rng
        As for :class:`~distfilt.filters.State`; `rng` is None, as nothing is drawn.
    mixtures : tuple of GaussianMixture
        One for each agent, over its own state [target; ego].

    Examples
    --------
    >>> belief = GaussianMixture.gaussian([0.0], [[1.0]])
    >>> MixtureState(0.0, Ledger.empty(1), None, (belief,)).mixtures[0].size
    1
    """

    mixtures: tuple[GaussianMixture, ...] = ()

    def __post_init__(self) -> None:
        super().__post_init__()
        for belief in self.mixtures:
            instance(belief, "mixtures", GaussianMixture)
        if len(self.mixtures) != self.ledger.messages.size:
            raise ValueError(
                f"mixtures: needs {self.ledger.messages.size} like the ledger, "
                f"got {len(self.mixtures)}"
            )


@dataclass(frozen=True, eq=False)
class MixtureFilter(TeamFilter):
    """Every agent holds a mixture over [target; its own state]; only target marginals travel.

    In a step an agent splits the mixands that its model stretches most, forecasts all of them,
    conditions them on its reading, sends its target marginal, fuses what it hears, and merges down
    to `size` mixands. Agents' states may differ in size. A mixand that the sensor cannot see (it
    predicts NaN for one of its points) contradicts a reading and is left out; a reading that all
    mixands contradict in this way is refused by an error.

    Parameters
    ----------
    models : sequence of Model, length A
        How each agent's [target; ego] moves.
    sensors : sequence of Sensor or None, length A
        What each agent sees of its own state. NaN marks a missing component of a reading.
    graph : Graph, or callable t -> Graph, optional
        Who hears whom; without one nobody speaks.
    target_dim : int
        How many components, the first of every state, are the target's.
    agreement : callable, optional
        ``agreement(own, heard) -> mixture``, such as :func:`distfilt.mixtures.fuse`.
    size : int
        How many mixands an agent keeps after a step.
    most : int
        How many there may be before a forecast; no smaller than `size`.
    stretch : float, optional
        Split where a mixand's weight times its largest stretching is above this; never by default.
    scale : array_like, optional
        What each component is multiplied by before lengths are compared, the same for all agents.
    rule : {"dd2", "unscented"}
        How points stand for a mixand.
    gate : float, optional
        Leave a reading out if it is farther than so many standard deviations from every mixand.
    faults : Faults, optional
        How the channel fails.
    names : sequence of str
        Names of the agents.

    Examples
    --------
    >>> from distfilt.mixtures import fuse
    >>> from distfilt.network import graphs
    >>> from distfilt.sensors import direct
    >>> still = Model(2, lambda x, t, dt: x, lambda t, dt: np.zeros((2, 2)))
    >>> f = MixtureFilter([still, still], [direct([0], std=1.0), None], graphs.path(2),
    ...                   target_dim=1, agreement=fuse)
    >>> prior = GaussianMixture.gaussian([0.0, 0.0], [[1.0, 0.5], [0.5, 1.0]])
    >>> after = f.step(f.start([prior, prior]), 1.0, [[2.0], None])
    >>> after.mixtures[1].means.round(4), after.ledger.scalars
    (array([[0.6667, 0.3333]]), array([3, 3]))
    """

    models: Sequence[Model]
    sensors: Sequence[Sensor | None]
    graph: Graph | Callable[[float], Graph] | None = None
    _: KW_ONLY
    target_dim: int
    agreement: Agreement | None = None
    size: int = 12
    most: int = 12
    stretch: float | None = None
    scale: Any = None
    rule: Literal["dd2", "unscented"] = "dd2"
    gate: float | None = None
    faults: Faults | None = None
    names: Sequence[str] = ()

    def __post_init__(self) -> None:
        same_length(self.sensors, self.models, "sensors", "models")
        object.__setattr__(self, "models", tuple(self.models))
        object.__setattr__(self, "sensors", tuple(self.sensors))
        count(len(self.models), "models")
        n = count(self.target_dim, "target_dim")
        for model in self.models:
            if instance(model, "models", Model).dim < n:
                raise ValueError(f"models: needs at least {n} components, got {model.dim}")
            if self.scale is not None:
                scale = array(self.scale, "scale", (model.dim,)).copy()
                object.__setattr__(self, "scale", scale)
        for sensor in self.sensors:
            if sensor is not None and instance(sensor, "sensors", Sensor).uses_previous:
                raise ValueError("sensors: needs sensors of the present state, got a differential")
        self.check_network()
        if self.agreement is not None and self.graph is None:
            raise ValueError("graph: needs a Graph for the agreement, got None")
        count(self.most, "most", at_least=count(self.size, "size"))
        choice(self.rule, "rule", ("dd2", "unscented"))
        for name in ("stretch", "gate"):
            if getattr(self, name) is not None:
                number(getattr(self, name), name, above=0, at_most=1e150)

    @property
    def count(self) -> int:
        """Number A of agents."""
        return len(self.models)

    @property
    def components(self) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """Names and units of the components, those of the largest state."""
        return described(max(self.models, key=lambda m: m.dim))

    def start(
        self, prior: Sequence[GaussianMixture], *, rng: np.random.Generator | None = None,
        runs: tuple[int, ...] = (), t: float = 0.0,
    ) -> MixtureState:
        """The state before the first step.

        Parameters
        ----------
        prior : sequence of GaussianMixture, length A
            What each agent believes of its own state.
        rng : numpy.random.Generator, optional
            Not used: nothing is drawn.
        runs : tuple of int
            Must be empty: mixtures of several runs differ in size; use `studies.run`.
        t : float
            The time of the prior, in s.
        """
        self.check_alone(rng, runs)
        beliefs = (prior,) if isinstance(prior, GaussianMixture) else prior
        same_length(beliefs, self.models, "prior", "models")
        for belief, model in zip(beliefs, self.models, strict=True):
            if instance(belief, "prior", GaussianMixture).dim != model.dim:
                raise ValueError(f"prior: needs dimension {model.dim}, got {belief.dim}")
        return MixtureState(number(t, "t"), Ledger.empty(len(beliefs)), None, tuple(beliefs))

    def step(
        self, state: MixtureState, t: float, observations: Sequence[ArrayLike | None]
    ) -> MixtureState:
        """The state at time `t`: forecast, update, exchange, fuse, reduce.

        Parameters
        ----------
        state : MixtureState
        t : float
            In s, not before the state's; at the state's time nothing is forecast.
        observations : sequence of length A
            Per agent (m,) with NaN where a component is missing, or None.
        """
        now = number(t, "t", at_least=instance(state, "state", MixtureState).t)
        seen = at_one_time(observations, self.sensors, ())
        beliefs = [
            self._moved(belief, model, state.t, now - state.t)
            for belief, model in zip(state.mixtures, self.models, strict=True)
        ]
        channel = self.channel(state, now)
        beliefs = self._told(beliefs, seen, channel)
        most = max(_EXACT, self.size)
        kept = [two_stage(belief, self.size, heaviest=most) for belief in beliefs]
        # Without the square roots that they came with: a loaded state has to go on alike.
        plain = tuple(m.changed() for m in kept)
        return MixtureState(now, state.ledger if channel is None else channel.ledger, None, plain)

    def summary(self, state: MixtureState) -> Summary:
        """Means, variances and covariances of the whole mixtures, and their sizes.

        NaN fills the rows of agents whose states are smaller.
        """
        d = max(model.dim for model in self.models)
        mean = np.full((len(self.models), d), np.nan)
        cov = np.full((len(self.models), d, d), np.nan)
        for k, belief in enumerate(instance(state, "state", MixtureState).mixtures):
            n = belief.dim
            mean[k, :n], cov[k, :n, :n] = belief.moments()
        sizes = np.array([belief.size for belief in state.mixtures], dtype=np.float64)
        variance = np.diagonal(cov, axis1=-2, axis2=-1)
        return Summary(mean, variance, cov, numbers={"mixands": sizes})

    def _moved(self, belief: GaussianMixture, model: Model, t: float, dt: float) -> GaussianMixture:
        """Split where the model stretches, then forecast every mixand."""
        if dt == 0:
            return belief
        if self.stretch is not None:
            belief = split_stretched(
                belief, lambda x: model._jacobian(x, t, dt), most=self.most,
                stretch=self.stretch, scale=self.scale,
            )
        return moved(belief, lambda x: model._step(x, t, dt), model._root(t, dt), rule=self.rule)

    def _read(
        self, beliefs: Sequence[GaussianMixture], seen: Sequence[Array | None]
    ) -> list[GaussianMixture]:
        """Each agent's belief after its own reading; one out of every gate changes nothing."""
        out = list(beliefs)
        for k, (belief, sensor, y) in enumerate(zip(beliefs, self.sensors, seen, strict=True)):
            if y is not None and sensor is not None:
                known: Any = {"residual": sensor._residual, "rule": self.rule}
                reading = (sensor._predict, sensor.cov)
                if self.gate is not None:
                    y = unchecked(within_gate)(belief, y, *reading, gate=self.gate, **known)
                out[k] = unchecked(conditioned)(belief, y, *reading, **known)
        return out

    def _told(
        self, beliefs: list[GaussianMixture], seen: Sequence[Array | None], channel: Channel | None
    ) -> list[GaussianMixture]:
        """The beliefs after the agents' readings and their exchange."""
        after = self._read(beliefs, seen)
        return after if self.agreement is None or channel is None else self._agreed(after, channel)

    def _agreed(self, beliefs: list[GaussianMixture], channel: Channel) -> list[GaussianMixture]:
        """Send target marginals, and fuse what arrived; who hears nothing changes nothing."""
        part = range(self.target_dim)
        inbox = channel.exchange([belief.marginal(part).pack() for belief in beliefs])
        out = []
        for belief, heard in zip(beliefs, inbox, strict=True):
            others = [GaussianMixture.unpack(payload) for payload in heard.values()]
            assert self.agreement is not None
            fused: Any = self.agreement(belief, others) if others else belief
            if instance(fused, "agreement", GaussianMixture).dim != belief.dim:
                raise ValueError(f"agreement: needs dimension {belief.dim}, got {fused.dim}")
            fused.factors  # a LinAlgError where the fusion has collapsed
            out.append(fused)
        return out
