"""Localisation and tracking by news: agents tell what their readings taught them of the target."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass
from typing import ClassVar

import numpy as np

from ..mixtures import GaussianMixture
from ..mixtures.conditioning import update_mixture
from ..validation import Array, Bounds, NonNegativeInt, PositiveInt, validated
from .inputs import Observation, sensor_of
from .mixture import MixtureFilter
from .step import Step

__all__ = ["InformationIncrementFilter", "information_increment"]

_NOTHING = 1e-6
"""A gain in information, as a share of what was there before, below which nothing was learned."""


@validated
def information_increment(before: GaussianMixture, after: GaussianMixture) -> Array:
    r"""What a belief has gained, as readings of unit noise that would have taught the same.

    For Gaussians the gain in information :math:`\mathbf P_+^{-1}-\mathbf P_-^{-1}` is
    :math:`\mathbf H^\top\mathbf H` with as many rows as it has rank, and
    :math:`\mathbf P_+^{-1}\mathbf m_+-\mathbf P_-^{-1}\mathbf m_-` is
    :math:`\mathbf H^\top\mathbf z`. Whoever takes the readings :math:`\mathbf z=\mathbf H\mathbf t`
    plus unit noise learns exactly that. Directions in which information was lost are left out.

    Parameters
    ----------
    before, after : GaussianMixture
        Beliefs about the target before and after what is to be told; of several mixands the
        moments are compared.

    Returns
    -------
    ndarray, (r, n + 1)
        Rows of H, zero below its diagonal, with z as the last column.

    Examples
    --------
    >>> old = GaussianMixture.gaussian([0.0, 0.0], [[1.0, 0.0], [0.0, 1.0]])
    >>> new = GaussianMixture.gaussian([1.0, 0.0], [[0.5, 0.0], [0.0, 1.0]])
    >>> np.abs(information_increment(old, new))
    array([[1., 0., 2.]])
    """
    one = before.moment_match()
    two = after.moment_match()
    if one.dim != two.dim:
        raise ValueError(f"after must have dimension {one.dim}, got {two.dim}")
    # In the frame in which the old covariance is the identity.
    narrower = np.linalg.solve(two.factors[0], one.factors[0])
    _, size, axes = np.linalg.svd(narrower)
    gain = size**2 - 1
    learned = gain > _NOTHING
    root = np.sqrt(gain[learned])
    axes = axes[learned]
    moved = axes @ np.linalg.solve(one.factors[0], two.means[0] - one.means[0])
    rows = root[:, None] * np.linalg.solve(one.factors[0].T, axes.T).T
    values = rows @ one.means[0] + size[learned] ** 2 / root * moved
    # Another orthogonal basis of the same readings, with zeros that need not be sent.
    turn, rows = np.linalg.qr(rows)
    return np.concatenate([rows, (values @ turn)[:, None]], axis=1)


@dataclass(frozen=True, eq=False)
class InformationIncrementFilter(MixtureFilter):
    """Every agent tells the others what its own reading taught it of the target, and no more.

    A reading is told once, by whom it belongs to, so that nothing is counted twice and nothing has
    to be discounted. For linear models and Gaussians that equals one filter with everybody's
    readings, if everybody hears everybody, nothing is lost, the agents' own states are independent
    of each other given the target's *present* state, and what is learned is told at once or nothing
    disturbs the target: what waits (`exchange_interval`) is counted as if it were. It needs to know where
    readings come from: what all receive alike has to be named in `common`, and is taken by each for
    itself.

    Parameters
    ----------
    model, sensors, graph, target_dim, stretch, scale, gate, every, faults, names
        As of :class:`MixtureFilter`; a `graph` is needed and an `fusion` is not taken. What was
        learned while nobody could be told, for want of links or because it was not time (`exchange_interval`),
        is told at the next contact.
    size, most : int
        As there. With more than one mixand the moments' news are told, which is an approximation.
    common : sequence of int
        Components of the readings that all agents receive alike, with the same error, which has to
        be independent of the other components'; the gate judges and counts them for themselves.

    Notes
    -----
    Own states stay independent given the target if nothing disturbs the target's motion, or if no
    agent doubts its own state. Otherwise readings tie them together through the target's past,
    which no belief about [target; own state] can hold, and beliefs become too sure of themselves.
    Then let each agent filter [target; all agents] while neighbours tell their readings: a
    :class:`GaussianFilter` with one sensor per agent. It sends m numbers a reading, and for linear
    models it is exact for what an agent has heard, with any noise and whatever is lost.

    Examples
    --------
    Two agents, and the Kalman filter of both readings:

    >>> from distfilt.models import Model
    >>> from distfilt.network import graphs
    >>> from distfilt.sensors import component
    >>> still = Model(1, lambda x, t, dt: x, lambda t, dt: np.zeros((1, 1)))
    >>> f = InformationIncrementFilter(
    ...     still, [component([0], std=1.0)] * 2, graphs.path(2), target_dim=1
    ... )
    >>> prior = GaussianMixture.gaussian([0.0], [[1.0]])
    >>> after = f.step(f.start([prior, prior]), 1.0, [[3.0], [0.0]])
    >>> [float(m.means[0, 0].round(9)) for m in after.mixtures], after.ledger.scalars
    ([1.0, 1.0], array([2, 2]))
    """

    _: KW_ONLY
    n_components: PositiveInt = 1
    max_components: PositiveInt = 1
    shared_components: Sequence[NonNegativeInt] = ()

    belief_kind: ClassVar[None] = None
    unsupported: ClassVar[dict[str, str]] = {
        **MixtureFilter.unsupported,
        "fusion": "news are added, so that there is nothing to agree on",
    }

    def check_parts(self) -> None:
        """Refuse what there is no news of."""
        super().check_parts()
        if self.graph is None:
            raise ValueError("graph must be a Graph, got None")
        least = min((s.dim for own in self.agent_sensors for s in own), default=0)
        Bounds(below=least)(
            max(self.shared_components, default=-1), "shared_components"
        )

    def _told(
        self, beliefs: list[GaussianMixture], step: Step
    ) -> tuple[Sequence[GaussianMixture], Sequence[GaussianMixture | None]]:
        """Own readings, then others' news, then what all received alike.

        What all receive and the gate refuses is no news either, though it comes while news wait:

        >>> from distfilt.models import Model
        >>> from distfilt.network import graphs
        >>> from distfilt.sensors import component, stack
        >>> still = Model(1, lambda x, t, dt: x, lambda t, dt: np.zeros((1, 1)))
        >>> f = InformationIncrementFilter(
        ...     still,
        ...     [stack([component([0], std=1.0)] * 2)] * 2,
        ...     graphs.path(2),
        ...     target_dim=1,
        ...     shared_components=[1],
        ...     gate_probability=0.99,
        ...     exchange_interval=2.0,
        ... )
        >>> state = f.step(
        ...     f.start(([0.0], [[1.0]])), 1.0, [[1.0, 99.0], [np.nan, 99.0]]
        ... )
        >>> [m.means[0] for m in f.step(state, 2.0, [None, None]).mixtures]
        [array([0.5]), array([0.5])]
        """
        own, alike = zip(
            *(self._parted(said) for said in step.observations), strict=True
        )
        after = [self._read(b, k, own[k], step)[0] for k, b in enumerate(beliefs)]
        # What an agent would believe without what it has not told: from before the readings of now,
        # or from before those that wait.
        waiting = step.state.unsent or (None,) * len(beliefs)
        untold = [
            (old if new is not old else None)
            if kept is None
            else self._moved(kept, k, step)
            for k, (old, new, kept) in enumerate(
                zip(beliefs, after, waiting, strict=True)
            )
        ]
        if step.channel is not None:
            self._exchanged(after, untold, step)
        for k, said in enumerate(alike):
            after[k], untold[k] = self._read(after[k], k, said, step, untold[k])
        return after, untold if any(before is not None for before in untold) else ()

    def _exchanged(
        self,
        after: list[GaussianMixture],
        untold: list[GaussianMixture | None],
        step: Step,
    ) -> None:
        """Tell what was learned to those who listen, and learn from them, in place."""
        channel = step.channel
        part = range(self.target_dim)
        said: list[Array | None] = [None] * len(after)
        # Whose radio is off tells later, and so does one whom nobody could hear.
        on = channel.faults.speaking(channel.graph, channel.ledger.rounds, channel.t)
        for k, listeners in enumerate(
            np.bincount(channel.graph.senders[on], minlength=len(said))
        ):
            before = untold[k]
            if before is not None and listeners:
                with step.failing_as(k):
                    news = information_increment(
                        before.marginal(part), after[k].marginal(part)
                    )
                # Numbers that are not zero by construction, 13 for two rows of six.
                if news.size:  # too little is told with what is learned next
                    said[k] = news[np.triu_indices(len(news), 0, news.shape[1])]
                    untold[k] = None
        for k, heard in enumerate(channel.broadcast(said)):
            for payload in heard.values():
                news = _unpacked(payload, self.target_dim)
                before = untold[k]
                with step.failing_as(k):
                    after[k] = _learned(after[k], news)
                    untold[k] = None if before is None else _learned(before, news)

    def _parted(
        self, said: Sequence[Observation]
    ) -> tuple[list[Observation], list[Observation]]:
        """Readings without and with nothing but the common components; none where none is left."""
        own: list[Observation] = []
        alike: list[Observation] = []
        for reading in said:
            everybody = np.isin(np.arange(reading.value.size), self.shared_components)
            if sensor_of(self, reading).noise_cov[np.ix_(everybody, ~everybody)].any():
                raise ValueError(
                    "common must be noise of its own, got some that others share"
                )
            for part, gone in ((own, everybody), (alike, ~everybody)):
                left = np.where(gone, np.nan, reading.value)
                if not np.isnan(left).all():
                    part.append(reading.replace(value=left))
        return own, alike


def _unpacked(numbers: Array, n: int) -> Array:
    """The increment of n components, whose number of rows follows from its length."""
    sizes = [np.triu_indices(r, 0, n + 1)[0].size for r in range(1, n + 1)]
    out = np.zeros((sizes.index(numbers.size) + 1, n + 1))
    out[np.triu_indices(len(out), 0, n + 1)] = numbers
    return out


def _learned(belief: GaussianMixture, news: Array) -> GaussianMixture:
    """A belief after news of its first components."""
    rows = news[:, :-1]
    values = news[:, -1]
    return update_mixture(
        belief, values, lambda x: x[..., : rows.shape[1]] @ rows.T, np.eye(values.size)
    )
