"""The state of a filter between two steps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from os import PathLike
from types import EllipsisType
from typing import TYPE_CHECKING, Annotated, Self, TypeVar, cast

import numpy as np

from ..network import Ledger
from ..validation import (
    ALLOW_NAN,
    Array,
    FrozenModel,
    Mask,
    check_array,
    format_number,
)
from .serialization import load_fields, save_state

if TYPE_CHECKING:
    from .changes import Times
    from .observations import Observation
    from .repetition import Assimilated

    Past = tuple[tuple[float, Array], ...]
    History = tuple[tuple[float, Array] | float, ...]
    Changes = tuple[tuple[int, int, Times], ...]
    Assimilations = tuple[Assimilated, ...]
    Pending = tuple[Observation, ...]
    Axes = tuple[str | int | EllipsisType, ...]
else:
    # The library makes these values, so that their entries need no check.
    Past = History = Changes = Assimilations = Pending = Axes = tuple[object, ...]

__all__ = ["SensorState", "State", "stack_states"]

AnyState = TypeVar("AnyState", bound="State")


@dataclass(frozen=True, eq=False, repr=False)
class State(FrozenModel):
    """Everything a filter needs to go on; nothing is kept elsewhere.

    A family of filters adds its own fields. They may be arrays, numbers, texts, None, tuples of
    these, random generators, and frozen dataclasses of this package; all of them are saved.

    Parameters
    ----------
    t : float
        The time, in s.
    ledger : Ledger
        The account of all messages so far.
    rng : numpy.random.Generator or None
        Source of the next draws; None for a filter that draws nothing. A step copies it, so
        that a state can be stepped twice.
    rejected : ndarray, (*runs, A), optional
        How many observations each agent's gate rejected in the last step; None without a gate.
    rejection_streaks : ndarray, (*runs, A, B, S + 1), optional
        How many observations in a row it has rejected, of each of B sources: of each of the
        source's sensors, and of those that came with their observations. Without shared
        observations an agent is its only source, B = 1.
    log_likelihood, nis, n_observed : ndarray, (*runs, A), optional
        Scores of the observations of the last step, see
        :class:`~distfilt.filters.ScoresObservations`; None if they are not recorded.
    assimilated : tuple
        The observations of the times that are kept, by which repeated ones are found.
    warned : tuple of str
        Warnings that are given once, and have been.

    Examples
    --------
    >>> State(0.0, Ledger.empty(2), None)
    State(t=0, 2 agents)
    """

    t: float
    ledger: Ledger
    rng: np.random.Generator | None
    rejected: Annotated[Array, "..."] | None = field(default=None, kw_only=True)
    rejection_streaks: Annotated[Array, "..."] | None = field(
        default=None, kw_only=True
    )
    log_likelihood: Annotated[Array, "...", ALLOW_NAN] | None = field(
        default=None, kw_only=True
    )
    nis: Annotated[Array, "...", ALLOW_NAN] | None = field(default=None, kw_only=True)
    n_observed: Annotated[Array, "...", ALLOW_NAN] | None = field(
        default=None, kw_only=True
    )
    assimilated: Assimilations = field(default=(), kw_only=True)
    warned: tuple[str, ...] = field(default=(), kw_only=True)

    def __repr__(self) -> str:
        """Show time and agents; the arrays are long."""
        n_agents = self.ledger.messages.size
        return f"{type(self).__name__}(t={format_number(self.t)}, {n_agents} agents)"

    @property
    def runs(self) -> tuple[int, ...]:
        """Leading axes: independent runs of the network."""
        return ()

    @property
    def times(self) -> tuple[float, ...]:
        """The earlier times whose beliefs are kept, oldest first; none by default."""
        return ()

    @property
    def lagged_states(self) -> tuple[Self, ...]:
        """A state for each of `times`, given all observations up to now; none by default."""
        return ()

    def lagged_times(self, lag: int, t: float) -> tuple[float, ...]:
        """Return the earlier times that a step to `t` keeps, oldest first.

        >>> from distfilt.filters import GaussianFilter
        >>> from distfilt.models import constant_velocity
        >>> f = GaussianFilter(constant_velocity(sigma=1.0), [None], lag=1)
        >>> state = f.step(f.start((np.zeros(4), np.eye(4))), 1.0, [None])
        >>> (
        ...     state.times,
        ...     [state.lagged_times(lag, t) for t in (1.0, 2.0) for lag in (0, 1, 2)],
        ... )
        ((0.0,), [(0.0,), (0.0,), (0.0,), (), (1.0,), (0.0, 1.0)])
        """
        # A step of no length keeps the past as it is; another one adds the state's own time.
        if t == self.t:
            return self.times
        return (*self.times, self.t)[-lag:] if lag else ()

    def save(self, path: str | PathLike[str]) -> None:
        """Write the state to one .npz file; :meth:`load` gives back the same bits.

        The file appears whole or not at all: a full disk leaves an earlier one as it was. Its last
        32 bytes are the SHA-256 of those before.
        """
        # Sensors that came with an observation cannot be written. The third of an entry is a sensor
        # or its number.
        entries = [entry for entry in self.assimilated if isinstance(entry[2], int)]
        save_state(self.replace(assimilated=tuple(entries)), path)

    @classmethod
    def load(cls, path: str | PathLike[str]) -> Self:
        """Read a state that :meth:`save` wrote.

        Raises
        ------
        OSError
            If there is no such file, or it cannot be read.
        ValueError
            If the file is no saved state of this class, or is damaged.
        """
        return load_fields(cls, path)


@dataclass(frozen=True, eq=False, repr=False)
class SensorState(State):
    """A state of agents with sensors, whose beliefs are one array with axes (*runs, A, ...).

    A family names that array and its axes in `belief_field`, and adds it as a field.

    Parameters
    ----------
    t, ledger, rng, rejected
        As for :class:`~distfilt.filters.State`.
    history : tuple of (float, ndarray)
        Earlier times and the present beliefs about them, oldest first.
    failed : ndarray of bool, (*runs)
        Runs that failed and are no longer updated.
    pending : tuple of Observation
        Observations that have not been sent yet.
    last_changes, references : tuple
        The time of the last observation of each sensor of changes, and the beliefs about those of
        them that are not in the history.
    unseen : ndarray, (*runs, A), optional
        How many observations each agent left out in the last step, since the sensor cannot see
        from its state; None if there were none.

    Examples
    --------
    >>> from distfilt.network import Ledger
    >>> @dataclass(frozen=True, eq=False, repr=False)
    ... class Levels(SensorState):
    ...     levels: Array
    ...     belief_field = "levels", (..., "A")
    >>> Levels(0.0, Ledger.empty(2), None, np.zeros((3, 2))).runs
    (3,)
    """

    history: History = field(default=(), kw_only=True)
    failed: Mask = field(default_factory=lambda: np.zeros((), dtype=bool), kw_only=True)
    pending: Pending = field(default=(), kw_only=True)
    last_changes: Changes = field(default=(), kw_only=True)
    references: Past = field(default=(), kw_only=True)
    unseen: Annotated[Array, "..."] | None = field(default=None, kw_only=True)

    # Without an annotation it is no field of the dataclass.
    belief_field = "belief", Axes()

    def __post_init__(self) -> None:
        super().__post_init__()
        name, axes = self.belief_field
        check_array(self.belief, name, axes)
        object.__setattr__(self, "failed", np.broadcast_to(self.failed, self.runs))

    @property
    def belief(self) -> Array:
        """The agents' beliefs, under one name for all families."""
        return cast(Array, getattr(self, self.belief_field[0]))

    @property
    def runs(self) -> tuple[int, ...]:
        """Leading axes: independent runs of the network."""
        # The axes are (..., "A", ...), of which the first stands for the runs.
        _name, axes = self.belief_field
        return self.belief.shape[: 1 - len(axes)]

    @property
    def times(self) -> tuple[float, ...]:
        """The earlier times whose beliefs are kept, oldest first."""
        return tuple([t for t, _belief in self.past])

    @property
    def past(self) -> Past:
        """The earlier times and their beliefs, oldest first; of a family that keeps pairs."""
        return tuple([entry for entry in self.history if isinstance(entry, tuple)])

    @property
    def lagged_states(self) -> tuple[Self, ...]:
        """A state for each of the earlier `times`, given all observations up to now.

        The joint distribution over the times is kept, by draws too:

        >>> from distfilt.filters import EnsembleFilter, TransportFilter
        >>> from distfilt.models import Model
        >>> from distfilt.sensors import Sensor, component
        >>> from distfilt.updates import enkf, serially
        >>> tenth = Model(1, lambda x, t, dt: x / 10, lambda t, dt: np.zeros((1, 1)))
        >>> cubes = Sensor(
        ...     2, lambda x: np.concatenate([10 * x, x**3], axis=-1), np.eye(2)
        ... )
        >>> for f in (
        ...     TransportFilter(
        ...         tenth, [component([0], std=0.1)], lag=1, members=9, rejuvenation=0.5
        ...     ),
        ...     EnsembleFilter(tenth, [cubes], lag=1, members=9, update=serially(enkf)),
        ... ):
        ...     state = f.start(([0.0], [[1.0]]), rng=np.random.default_rng(0))
        ...     state = f.step(state, 1.0, [[0.1, 0.0][: f.sensors[0].dim]])
        ...     print(
        ...         np.allclose(state.lagged_states[0].ensembles, 10 * state.ensembles)
        ...     )
        True
        True
        """
        name, _axes = self.belief_field
        states = []
        for t, belief in self.past:
            states.append(
                self.replace(
                    t=t, history=(), last_changes=(), references=(), **{name: belief}
                )
            )
        return tuple(states)

    def mask_failed(self, values: Array) -> Array:
        """Return values (*runs, ...) for the record: NaN in runs that have failed."""
        if not np.count_nonzero(self.failed):
            return values
        masked = np.array(values)
        masked[self.failed] = np.nan
        return masked


def stack_states(states: Sequence[AnyState]) -> AnyState:
    """Stack several states of one shape, with a first axis of runs."""
    first = states[0]
    # Everything but arrays, such as the time, is taken from the first state. So are two arrays that
    # no summary needs: the first of them is None in some states.
    arrays = {}
    for name, value in vars(first).items():
        if type(value) is np.ndarray and name not in ("unseen", "rejection_streaks"):
            arrays[name] = np.array([getattr(state, name) for state in states])
    return first.replace(**arrays)
