"""One step of a filter on its way: who hears which readings, what fails, what becomes of it."""

from __future__ import annotations

import copy
import math
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import Any

import numpy as np

from ..linalg import SolverError
from ..sensors import Sensor
from ..validation import Array, all_finite, check_array
from .inbox import Received, group_agents
from .inputs import Observation, sensor_of
from .saving import SensorState

__all__ = [
    "RECOVERABLE",
    "FilterError",
    "Step",
    "copy_rng",
    "run_isolated",
    "is_argument_error",
]

RECOVERABLE = (np.linalg.LinAlgError, ArithmeticError, SolverError, ValueError)
"""What one row of a batch, or one agent, may fail with while the filter is right."""

Row = tuple[int, ...]
Compute = Callable[..., tuple[Array, ...]]
"""``compute(*arrays, shared, rng) -> arrays`` for any leading axes."""


class FilterError(RuntimeError):
    """One agent's step failed: the message names run, agent and time, and why.

    Parameters
    ----------
    run : tuple of int
        Which of the independent runs.
    agent : int or None
        None where it failed for all of them at once.
    t : float
        The time of the step, in s.
    why : object
        The cause.

    Examples
    --------
    >>> FilterError((3,), 1, 2.5, "singular matrix")
    FilterError('run 3, agent 1, t = 2.5 s: singular matrix')
    """

    def __init__(
        self, run: tuple[int, ...], agent: int | None, t: float, why: object
    ) -> None:
        self.run = run
        self.agent = agent
        self.t = t
        self.why = str(why)
        where = f"run {', '.join(map(str, run))}, " if run else ""
        who = "" if agent is None else f"agent {agent}, "
        super().__init__(f"{where}{who}t = {t:g} s: {why}")

    def __reduce__(self) -> tuple[Any, ...]:
        return FilterError, (self.run, self.agent, self.t, self.why)


class Step:
    """A step from a state to time `t`, with its inputs checked; :meth:`end` makes a state of it.

    `dt` is its length, `channel` its door (None where nobody speaks) and `rng` its own generator;
    `times` are the earlier times that will be kept, oldest first. `said` are the agents' readings
    of now, `delayed` those of earlier times.

    Examples
    --------
    >>> from distfilt.filters import Filter, GaussianFilter
    >>> from distfilt.models import constant_velocity
    >>> from distfilt.sensors import component
    >>> class Telling(GaussianFilter):
    ...     def next_state(self, step):
    ...         print(step.dt, [group.agents.tolist() for _, group in step.received()])
    ...         return super().next_state(step)
    >>> f = Telling(constant_velocity(sigma=0.1), [component([0], std=1.0)])
    >>> f.step(f.start((np.zeros(4), np.eye(4))), 0.5, [[1.0]]).t
    0.5 [[0]]
    0.5

    What one agent hears in every run another may miss in some:

    >>> from distfilt.network import Faults, Graph
    >>> heard = Graph.from_edges(3, [(0, 1), (0, 2)])
    >>> loss = np.zeros((3, 3))
    >>> loss[2, 0] = 0.5
    >>> f = GaussianFilter(
    ...     constant_velocity(sigma=0.1),
    ...     [component([0], std=1.0), None, None],
    ...     heard,
    ...     faults=Faults(loss=loss),
    ... )
    >>> state = f.step(
    ...     f.start((np.zeros(4), np.eye(4)), runs=(4,)), 0.0, [[1.0], None, None]
    ... )
    >>> state.means[..., 0].T
    array([[0.5, 0.5, 0.5, 0.5],
           [0.5, 0.5, 0.5, 0.5],
           [0. , 0. , 0. , 0.5]])
    """

    def __init__(
        self,
        filter_: Any,
        state: Any,
        t: float,
        said: Any,
        late: Sequence[Observation] = (),
        *,
        own: bool = False,
    ) -> None:
        self.filter = filter_
        self.state = state
        self.t = t
        self.dt = t - state.t
        self.observations = said
        self.delayed = late
        self.times = state.lagged_times(filter_.lag, t)
        self.channel: Any = filter_.channel(state, t)
        # A run's own generator need not be copied: nobody else draws from it.
        self.rng: Any = state.rng if own or state.rng is None else copy_rng(state.rng)
        self.failed = getattr(state, "failed", _NOBODY)
        self.lost = bool(np.count_nonzero(self.failed))
        self.pending: tuple[Any, ...] = ()
        self.rejected: Any = (
            None
            if filter_.gate_probability is None
            else np.zeros((*state.runs, filter_.n_agents))
        )

    def record_failures(self, errors: dict[Row, str], agents: Any = None) -> None:
        """Take the runs of these errors as failed, or raise the error that names the first.

        Their keys are runs, and where there are `agents` a place among these.
        """
        if not errors:
            return
        size = len(self.state.runs)
        (row, why) = next(iter(errors.items()))
        if self.filter.on_error == "raise" or not self.failed.shape:
            agent = None if agents is None else int(agents[row[-1]])
            raise FilterError(row[:size], agent, self.t, why)
        self.failed = self.failed.copy()
        for row in errors:
            self.failed[row[:size]] = self.lost = True

    @contextmanager
    def failing_as(self, agent: int) -> Iterator[None]:
        """What fails here is this agent's failure."""
        try:
            yield
        except RECOVERABLE as error:
            raise FilterError((), agent, self.t, error) from error

    def check_forecast(self, values: Array, old: Any) -> Array:
        """A forecast (*runs, A, ...); `old` in failed runs."""
        if bad := _not_finite(values, self.failed.ndim + 1, "forecast"):
            self.record_failures(bad, range(self.filter.n_agents))
        # Groups of agents are updated in place, which a state must not notice.
        apart = not np.may_share_memory(values, self.state.belief)
        return self.keep_failed(values if apart else values.copy(), old)

    def keep_failed(self, values: Array, old: Any) -> Array:
        """The values, but `old` in failed runs."""
        if not self.lost:
            return values
        failed = self.failed.reshape(
            *self.failed.shape, *(1,) * (values.ndim - self.failed.ndim)
        )
        return np.asarray(np.where(failed, old, values))

    def stack(self, now: Array) -> list[Array]:
        """Copies of what is believed of the earlier times, then what is believed of now."""
        before = [x for _, x in self.state.history] + [self.state.belief] * (
            self.dt > 0
        )
        return [x.copy() for x in before[len(before) - len(self.times) :]] + [now]

    def received(self) -> Iterator[tuple[int, Received]]:
        """Who heard what: a place among the times, and a group of agents with their readings.

        The last place is now. A target is NaN in failed runs, so that they are left alone.
        """
        known = self._known()
        for place, t in enumerate((*self.times, self.t)):
            for group in group_agents(*known[t]) if t in known else ():
                if self.lost:
                    group = group.with_target(self.keep_failed(group.target, np.nan))
                yield place, group

    def _known(self) -> dict[float, tuple[list[list[Sensor]], list[list[Array]]]]:
        """For each time the readings that each agent has, its own and what it heard, by sender."""
        f = self.filter
        if not self.delayed and (f.graph is None or not f.share_observations):
            sensors = [
                [sensor_of(f, said) for said in mine] for mine in self.observations
            ]
            return {
                self.t: (
                    sensors,
                    [[said.value for said in mine] for mine in self.observations],
                )
            }
        own = (
            [list(mine) for mine in self.observations]
            if self.delayed
            else self.observations
        )
        for late in self.delayed:
            own[late.agent].append(late)
        told = self._told(own)
        inbox = [dict[int, Any]()] * len(own)
        if self.channel is not None and told:
            inbox = self.channel.broadcast([self._payload(mine) for mine in told])
        kinds = [[(said.t, sensor_of(f, said)) for said in mine] for mine in told]
        known: dict[float, Any] = defaultdict(
            lambda: ([[] for _ in own], [[] for _ in own])
        )
        for agent, (mine, box) in enumerate(zip(own, inbox, strict=True)):
            for sender in sorted((agent, *box)):
                if sender == agent:
                    for said in mine:
                        known[said.t][0][agent].append(sensor_of(f, said))
                        known[said.t][1][agent].append(said.value)
                elif type(got := box[sender]) is tuple:
                    for (t, sensor), value in zip(kinds[sender], got, strict=False):
                        known[t][0][agent].append(sensor)
                        known[t][1][agent].append(value)
                else:
                    t, sensor = kinds[sender][0]
                    known[t][0][agent].append(sensor)
                    known[t][1][agent].append(got)
        return known

    def _told(self, own: list[list[Observation]]) -> list[list[Observation]]:
        """What each agent tells now; none if nobody does. What is not told waits for a contact."""
        f = self.filter
        if not f.share_observations or f.graph is None:
            return []
        if self.channel is None:
            if f.lag:
                kept = [
                    said.replace(value=said.value.copy())
                    for mine in own
                    for said in mine
                ]
                self.pending = (*self.state.pending, *kept)
            return []
        if not self.state.pending:
            return own
        out: list[list[Observation]] = [[] for _ in own]
        for said in self.state.pending:
            if said.t not in self.times:
                raise ValueError(
                    f"lag must reach back to t = {said.t:g}, from when a reading waited for "
                    f"this contact at t = {self.t:g}, got {f.lag}"
                )
            out[said.agent].append(said)
        return [waited + mine for waited, mine in zip(out, own, strict=True)]

    def _payload(self, told: list[Observation]) -> Any:
        """Values, and when and of which sensor each is, but for an only one: now, of the first."""
        if not told:
            return None
        which = [said.sensor if isinstance(said.sensor, int) else -1 for said in told]
        if (
            len(told) == 1
            and told[0].t == self.t
            and which[0] < 1
            and not told[0].metadata
        ):
            return told[0].value
        pairs = zip(told, which, strict=True)
        about = [x for said, sensor in pairs for x in (said.t, sensor, *said.metadata)]
        numbers = np.broadcast_to(np.array(about), (*self.state.runs, len(about)))
        return (*(said.value for said in told), numbers)

    def gate(
        self, group: Received, moments: Any, seen: Array, *rest: Array
    ) -> Received:
        """A group without the readings that the gate refuses.

        `moments` gives mean (*runs, G, M) and covariance of predictions (*runs, G, N, M) and what
        belongs to them, without the noise.
        """
        if self.rejected is None:
            return group
        # Opposite to a wild angle the branch of the observation would tear them apart.
        mean, cov = moments(group.wrap_near(seen.copy(), seen[..., :1, :]), *rest)
        group, refused = group.gate(mean, cov, self.filter.gate_probability)
        self.rejected[..., group.agents] += refused
        return group

    def before(self, place: int, group: Received, past: list[Array]) -> Array | None:
        """A group's members at the time before now, where a sensor sees changes.

        They are the last of the `past`, or those with which the step begins, if it has a length.
        """
        if not group.changes or place < len(self.times) or not (past or self.dt):
            return None
        return (past or [self.state.belief])[-1][..., group.rows, :, :]

    @property
    def has_fusion(self) -> bool:
        """Whether there is an agreement, and somebody to agree with."""
        return self.filter.fusion is not None and self.channel is not None

    def fuse(self, *values: Array) -> tuple[Array, ...]:
        """Values (*runs, A, ...) after the agreement, if any; as they were in failed runs.

        >>> from distfilt.filters import EnsembleFilter
        >>> from distfilt.models import Model
        >>> from distfilt.network import graphs
        >>> still = Model(1, lambda x, t, dt: x, lambda t, dt: np.zeros((1, 1)))
        >>> f = EnsembleFilter(
        ...     still,
        ...     [None] * 2,
        ...     graphs.path(2),
        ...     members=4,
        ...     lag=1,
        ...     fusion=lambda x, channel: np.multiply(x, 2.0, out=x),
        ... )
        >>> state = f.step(
        ...     f.start(([0.0], [[1.0]]), rng=np.random.default_rng(0)), 1.0, [None] * 2
        ... )
        >>> bool(np.allclose(state.history[0][1], state.ensembles))
        True
        """
        if not self.has_fusion or self.failed.all():
            return values
        good = tuple(np.argwhere(~self.failed)[0])
        door = self.channel
        # What a run failed with may fail again: a good one stands in.
        given = tuple([self.keep_failed(v, v[good]).copy() for v in values])
        whole = np.arange(int(np.prod(self.state.runs))).reshape(self.state.runs)
        ledger = door.ledger
        alone = list[Array]()

        def compute(*arrays: Any) -> tuple[Array, ...]:
            *belief, run, _, _ = arrays
            channel = door.for_run(run, ledger)
            out = self.filter.fusion(
                belief[0] if len(belief) == 1 else tuple(belief), channel
            )
            out = (out,) if len(belief) == 1 else tuple(out)
            if len(out) != len(belief):
                raise ValueError(
                    f"fusion must return {len(belief)} arrays, got {len(out)}"
                )
            self.channel = channel
            alone.append(channel.ledger.lost)
            return tuple(
                check_array(x, "fusion", v.shape)
                for x, v in zip(out, belief, strict=True)
            )

        out, errors = run_isolated(compute, (*given, whole), values, whole.ndim)
        if (
            self.channel.runs != whole.shape
        ):  # asked alone, each lost messages of its own
            self.channel = door.for_run(
                whole, self.channel.ledger.replace(lost=np.mean(alone, axis=0))
            )
        self.record_failures(errors)
        return tuple([self.keep_failed(x, v) for x, v in zip(out, values, strict=True)])

    def end(self, *, past: Iterable[Array] = (), **belief: Any) -> Any:
        """The state after the step; `past` has one entry for each of the earlier times."""
        state = self.state
        if isinstance(state, SensorState):
            if "history" not in belief:
                belief["history"] = tuple(zip(self.times, past, strict=True))
            belief |= {"failed": self.failed, "pending": self.pending}
        ledger = state.ledger if self.channel is None else self.channel.ledger
        return type(state).construct(
            self.t, ledger, self.rng, rejected=self.rejected, **belief
        )


_NOBODY = np.zeros((), dtype=bool)
_NOTHING = np.zeros((0, 0))


def run_isolated(
    compute: Compute,
    arrays: tuple[Array, ...],
    fallback: tuple[Array, ...],
    lead: int,
    *,
    shared: Array = _NOTHING,
    rng: np.random.Generator | None = None,
) -> tuple[tuple[Array, ...], dict[Row, str]]:
    """A computation on a batch (*lead, …), whose rows may fail without the others' notice.

    `compute` gets the arrays, `shared`, (m, m) for all rows or (G, m, m) for each entry of the last
    leading axis, and `rng`; `lead` axes count rows, and a row that fails keeps its `fallback`. The
    results come with the reason for each failure, by the row's index. Where every row fails with a
    ValueError the call is wrong, not a row, and the error is passed on.

    >>> def root(x, shared, rng):
    ...     return (np.linalg.cholesky(x),)
    >>> x = np.array([[[4.0]], [[-1.0]], [[9.0]]])
    >>> out, errors = run_isolated(root, (x,), (x,), 1, shared=np.eye(1))
    >>> out[0].ravel(), errors
    (array([ 2., -1.,  3.]), {(1,): 'Matrix is not positive definite'})
    """
    several = math.prod(arrays[0].shape[:lead]) > 1
    at: Any = rng.bit_generator.state if rng is not None and several else None
    errors: dict[Row, str] = {}
    try:
        out = compute(*arrays, shared, rng)
    except RECOVERABLE as error:
        out = tuple(f.copy() for f in fallback)
        rows = list(np.ndindex(arrays[0].shape[:lead]))
        for row in rows:
            part = shared[row[-1]] if shared.ndim > 2 else shared
            try:
                results = compute(*(a[row] for a in arrays), part, rng)
            except RECOVERABLE as own:
                errors[row] = str(own)
                continue
            for target, result in zip(out, results, strict=True):
                target[row] = result
        if 0 < len(errors) < len(rows):
            # No row may draw otherwise because another fails: a good one stands in for that.
            good = next(row for row in rows if row not in errors)
            where: Any = tuple(
                np.transpose([good if row in errors else row for row in rows])
            )
            if rng is not None:
                rng.bit_generator.state = at
            with suppress(*RECOVERABLE):
                out = compute(*(a[where].reshape(a.shape) for a in arrays), shared, rng)
        if is_argument_error(error) and len(errors) == len(rows):
            raise
    for got in out:
        errors |= _not_finite(got, lead, "result")
    if errors:
        out = tuple(o.copy() for o in out)
    for row in errors:
        for target, stands in zip(out, fallback, strict=True):
            target[row] = stands[row]
    return out, errors


class _Unseeded(
    np.random.bit_generator.ISeedSequence
):  # whose state comes from another
    def generate_state(self, n_words: int, dtype: Any = np.uint32) -> Any:
        return np.zeros(n_words, dtype)


_UNSEEDED = _Unseeded()


def copy_rng(rng: Any) -> Any:
    """A generator at the same place, in a seventh of the time that a deep copy takes."""
    if type(rng) is not np.random.Generator:
        return copy.deepcopy(rng)
    old: Any = rng.bit_generator
    bits = type(old)(_UNSEEDED)
    bits.__setstate__((old.state, copy.copy(old.seed_seq)))
    return np.random.Generator(bits)


def is_argument_error(error: Exception) -> bool:
    """Whether an error tells of wrong arguments; numpy's LinAlgError is a ValueError too."""
    return isinstance(error, ValueError) and not isinstance(
        error, np.linalg.LinAlgError
    )


def _not_finite(values: Array, lead: int, what: str) -> dict[Row, str]:
    """Errors of the rows (*lead, ...) that are not finite."""
    if all_finite(values):
        return {}
    bad = ~np.isfinite(values).reshape(*values.shape[:lead], -1).all(axis=-1)
    return {
        tuple(map(int, row)): f"the {what} is not finite" for row in np.argwhere(bad)
    }
