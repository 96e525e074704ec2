"""What every filter that reads sensors does in a step, whatever it believes between two of them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from ..checks import Array, array, instance
from ..network import Channel, Ledger
from .failures import FilterError, not_finite
from .heard import Heard, gathered
from .saving import State
from .streams import bookmarked

__all__ = ["SensorState", "Step"]

Mask = NDArray[np.bool_]
S = TypeVar("S", bound="SensorState")


@dataclass(frozen=True, eq=False)
class SensorState(State):
    """A state of agents with sensors: what they believe is an array with axes (*runs, A, ...).

    A family names that array and its axes in `_belief`, and adds it as a field.

    Parameters
    ----------
    t, ledger, rng
        As for :class:`~distfilt.filters.State`.
    history : tuple of (float, ndarray)
        Earlier times and what is believed of them by now, oldest first.
    failed : ndarray of bool, (*runs)
        Runs that failed and are no longer updated.

    Examples
    --------
    >>> @dataclass(frozen=True, eq=False)
    ... class Levels(SensorState):
    ...     levels: Array
    ...     _belief = "levels", (..., "A")
    >>> Levels(0.0, Ledger.empty(2), None, np.zeros((3, 2))).runs
    (3,)
    """

    history: tuple[Any, ...] = field(default=(), kw_only=True)
    failed: Mask = field(default_factory=lambda: np.zeros((), dtype=bool), kw_only=True)

    _belief = "belief", tuple[Any, ...]()

    def __post_init__(self) -> None:
        super().__post_init__()
        name, axes = self._belief
        shape = array(self.belief, name, axes).shape
        agents = shape[len(self.runs)]
        if self.ledger.messages.size != agents:
            raise ValueError(f"ledger: needs {agents} agents, got {self.ledger.messages.size}")
        object.__setattr__(self, "failed", np.broadcast_to(self.failed, self.runs))

    @property
    def belief(self) -> Array:
        """What the agents believe, under the family's own name for it."""
        return np.asarray(getattr(self, self._belief[0]))

    @property
    def runs(self) -> tuple[int, ...]:
        """Leading axes: independent runs of the network."""
        return tuple(self.belief.shape[: 1 - len(self._belief[1])])

    @property
    def times(self) -> tuple[float, ...]:
        """The earlier times that are kept, oldest first."""
        return tuple(t for t, _ in self.history)

    @property
    def earlier(self) -> tuple[Self, ...]:
        """A state for each of these times, as what is believed of it by now."""
        name = self._belief[0]
        return tuple(replace(self, t=t, history=(), **{name: x}) for t, x in self.history)

    def shown(self, values: Array) -> Array:
        """Values (*runs, ...) for the record: NaN in runs that have failed."""
        if not self.failed.any():
            return values
        out = np.array(values)
        out[self.failed] = np.nan
        return out


@dataclass(eq=False)
class Step:
    """A step on its way, from a filter's `begin` until :meth:`end` makes a state of it.

    `dt` is its length, `channel` its door (None for a single agent without a graph) and `rng` its
    own copy of the generator; `times` are the earlier times that will be kept, oldest first, and
    `readings` what was observed at some of them, and at last now: pairs of a place among the times
    and the agents' observations.

    Examples
    --------
    >>> from distfilt.filters import GaussianFilter, GaussianState
    >>> from distfilt.models import constant_velocity
    >>> from distfilt.sensors import direct
    >>> f = GaussianFilter(constant_velocity(sigma=0.1), [direct([0], std=1.0)])
    >>> state = f.start((np.zeros(4), np.eye(4)))
    >>> step = f.begin(state, GaussianState, 0.5, [[1.0]], ())
    >>> step.dt, [group.agents.tolist() for _, group in step.heard()]
    (0.5, [[0]])
    """

    filter: Any
    state: SensorState
    t: float
    dt: float
    channel: Channel | None
    times: tuple[float, ...]
    readings: Sequence[tuple[int, list[Array | None]]]

    def __post_init__(self) -> None:
        self.failed = self.state.failed
        self.rng: Any = bookmarked(self.state.rng)()

    def settle(
        self, errors: dict[tuple[int, ...], str], agents: Sequence[int] | NDArray[np.intp]
    ) -> None:
        """Take the runs of these errors as failed, or raise the error that names the first."""
        if not errors:
            return
        row, why = next(iter(errors.items()))
        if self.filter.failures == "raise" or not self.failed.shape:
            raise FilterError(row[:-1], int(agents[row[-1]]), self.t, why)
        self.failed = self.failed.copy()
        for row in errors:
            self.failed[row[:-1]] = True

    def moved(self, values: Array, old: Any, axes: int) -> Array:
        """A forecast (*runs, A, ...) with so many axes after the agents'; `old` in failed runs."""
        self.settle(not_finite(values, axes), range(values.shape[-axes - 1]))
        return self.kept(values, old)

    def kept(self, values: Array, old: Any) -> Array:
        """A copy of the values, but `old` in failed runs."""
        if not self.failed.any():
            return np.array(values)
        failed = self.failed.reshape(*self.failed.shape, *(1,) * (values.ndim - self.failed.ndim))
        return np.asarray(np.where(failed, old, values))

    def stack(self, now: Array) -> list[Array]:
        """Copies of what is believed of the earlier times, then what is believed of now."""
        before = [x for _, x in self.state.history] + [self.state.belief]
        return [x.copy() for x in before[len(before) - len(self.times) :]] + [now]

    def heard(self, *, shared: bool = True) -> Iterator[tuple[int, Heard]]:
        """Reading by reading who heard what: its place among the times, and a group of agents.

        A target is NaN in failed runs, so that they are left alone. If not `shared`, nobody speaks.
        """
        told = instance(shared, "shared", bool) and self.filter.share
        channel = self.channel if told else None
        for place, observed in self.readings:
            for group in gathered(observed, self.filter.sensors, channel):
                if self.failed.any():
                    group = replace(group, target=self.kept(group.target, np.nan))
                yield place, group

    def before(self, place: int, agents: Any) -> Array | None:
        """The agents' members at the time before now, for sensors that see changes."""
        return self.state.belief[..., agents, :, :] if place == len(self.times) else None

    @property
    def agrees(self) -> bool:
        """Whether there is an agreement, and somebody to agree with."""
        return self.filter.agreement is not None and self.channel is not None

    def agreed(self, *values: Array) -> tuple[Array, ...]:
        """Values (*runs, A, ...) after the agreement, if there is one."""
        if not self.agrees:
            return values
        belief: Any = values[0] if len(values) == 1 else values
        out = self.filter.agreement(belief, self.channel)
        out = (out,) if len(values) == 1 else tuple(out)
        if len(out) != len(values):
            raise ValueError(f"agreement: needs to return {len(values)} arrays, got {len(out)}")
        return tuple(array(x, "agreement", v.shape) for x, v in zip(out, values, strict=True))

    def end(self, kind: type[S], *belief: Any, history: Iterable[Any]) -> S:
        """The state after the step; `history` has one entry for each of the earlier times."""
        ledger: Ledger = self.state.ledger if self.channel is None else self.channel.ledger
        past = tuple(history)
        return kind(self.t, ledger, self.rng, *belief, history=past, failed=self.failed)
