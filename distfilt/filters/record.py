"""The record of a run: estimates, spreads, scores and the ledger, with named axes."""

from __future__ import annotations

import math
from collections.abc import (
    Callable,
    Collection,
    Iterable,
    Iterator,
    Mapping,
    Sequence,
)
from dataclasses import dataclass, field
from itertools import groupby, islice
from typing import TYPE_CHECKING, Literal, NamedTuple, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..ensembles import sample_covariance
from ..linalg import cholesky, quadratic_form, to_unit_variances
from ..metrics import crps, gaussian_crps
from ..network import Ledger
from ..periods import align, warn_of_wrapped_truth
from ..validation import Array, InvalidArgumentError, call_user, check_array
from .states import AnyState, SensorState, State, stack_states

if TYPE_CHECKING:
    import xarray

    from .base import Filter, SensorFilter

    TruthOfTime = Callable[[float], ArrayLike]
    TruthSeries = ArrayLike | TruthOfTime
    Truth = TruthSeries | Mapping[str, TruthSeries] | None
    Scored = Sequence[str] | Sequence[Sequence[str]] | None
else:
    # Checked by `_read_truth`, which converts it; a table of pandas serves as a mapping.
    Truth = object
    # Checked by `_read_scored`.
    Scored = object

__all__ = [
    "SCORES",
    "Recording",
    "Score",
    "Scored",
    "Summary",
    "Truth",
    "final_state",
    "record_run",
]

Score = Literal["squared_error", "nees", "crps"]
SCORES: tuple[Score, ...] = ("squared_error", "nees", "crps")
"""The scores that can be recorded with a known truth."""

_BLOCK_SIZE = 32768
"""Up to how many numbers small states have together whose summaries are made at once."""

_STEP_FIELDS = ("rejected", "log_likelihood", "nis", "n_observed")

_LEDGER_FIELDS = (
    "messages",
    "scalars",
    "bytes",
    "lost",
    "transmissions",
    "broadcast_scalars",
    "broadcast_bytes",
    "rounds",
)

_MEANING = {
    "mean": ("estimate of the state", "of the component"),
    "variance": ("variance of the estimate", "of the component, squared"),
    "covariance": ("covariance of the estimate", "of both components, multiplied"),
    "spread": ("root of the sum of all variances, whatever their units", "mixed"),
    "squared_error": ("squared error of the estimate", "of the component, squared"),
    "total_squared_error": (
        "squared errors added over components, whatever their units",
        "mixed",
    ),
    "crps": ("continuous ranked probability score", "of the component"),
    "nees": (
        "normalised estimation error squared of the components scored together; its mean is "
        "their number for a consistent filter",
        "1",
    ),
    "unseen": (
        "observations left out in this step, since a sensor cannot see from the belief",
        "1",
    ),
    "rejected": ("observations that the gate rejected in this step", "1"),
    "log_likelihood": (
        "logarithm of the density of this step's observations given all earlier ones",
        "1",
    ),
    "nis": (
        "normalised innovation squared; its mean is n_observed for a consistent filter",
        "1",
    ),
    "n_observed": ("numbers that were observed and assimilated in this step", "1"),
}
"""Long name and unit of each recorded variable."""

Believed = tuple[AnyState, AnyState]
"""A state, and the belief about its time that is recorded: with a lag, a later one."""


@dataclass(frozen=True, eq=False)
class Summary:
    """Estimates of a state, for the record.

    Parameters
    ----------
    mean, variance : ndarray, (*runs, A, d)
        Estimates and their variances. Where agents' states differ in size, NaN fills the rest.
    covariance : ndarray, (*runs, A, d, d), optional
        For NEES.
    members : ndarray, (*runs, A, N, d), optional
        For CRPS, and for NEES if there is no covariance; without members CRPS is a Gaussian's.
    weights : ndarray, (*runs, A, N), optional
        The members' weights, if they differ.
    numbers : mapping of str to ndarray, (*runs, A)
        Further numbers to record, such as an effective sample size.

    Examples
    --------
    A filter that records for all agents the belief of the most certain one:

    >>> from distfilt.filters import GaussianFilter
    >>> from distfilt.models import Model
    >>> from distfilt.sensors import component
    >>> walk = Model(1, lambda x, t, dt: x, lambda t, dt: dt * np.eye(1))
    >>> class Best(GaussianFilter):
    ...     def summarize(self, state):
    ...         best = [state.covariances[:, 0, 0].argmin()] * self.n_agents
    ...         return Summary(state.means[best], state.covariances[best, 0])
    >>> best = Best(walk, [None, component([0], std=1.0)], share_observations=False)
    >>> run = best.run(best.start(([0.0], [[4.0]])), [1.0, 2.0], [None, [[2.0], [2.0]]])
    >>> run["mean"].values[..., 0].round(3)
    array([[1.667, 1.667],
           [1.882, 1.882]])
    """

    mean: Array
    variance: Array
    covariance: Array | None = None
    members: Array | None = None
    weights: Array | None = None
    numbers: Mapping[str, Array] = field(default_factory=dict)


Components = NDArray[np.intp] | slice
"""Index of components: of all agents, (k,), of each, (A, k), or a slice of all."""


@dataclass(frozen=True, eq=False)
class Recording:
    """What a run records beside its estimates; the options of :meth:`Filter.run`."""

    truth: Truth = None
    scores: Collection[Score] = SCORES
    scored: Scored = None
    keep: Collection[str] | None = None


@dataclass(frozen=True, eq=False)
class _KnownTruth:
    """The truth, (T, *runs, 1 or A, d), and the index of the components scored together."""

    values: Array
    components: Components
    scores: Collection[Score]


def record_run(
    f: Filter[AnyState],
    times: Array,
    start: AnyState,
    believed: Iterable[Believed[AnyState]],
    recording: Recording,
) -> xarray.Dataset:
    """Record the states of a run in one Dataset.

    Parameters
    ----------
    f : Filter
        Names and units are the filter's.
    times : ndarray, (T,)
    start : State
        The state before the run.
    believed : iterable of (state, state)
        The state at each time, and the belief about that time.
    recording : Recording
    """
    import xarray

    names, units = f.components
    agents = list(f.agents)
    runs = start.runs
    # The truth is checked before the first step.
    known_truth = _read_truth(recording, names, (times.size, *runs), len(agents), times)
    keep = _read_keep(recording.keep, f, start, known_truth)
    collected = _collect_series(f, times.size, start, believed, known_truth, keep)
    series = collected.series

    # Axes: time first, then the runs, then the agents.
    run_axes = ["run"] if len(runs) == 1 else [f"run{i}" for i in range(len(runs))]
    lead = ("time", *run_axes, "agent")
    axes = {"covariance": (*lead, "component", "column")}
    for name in ("mean", "variance", "squared_error", "crps"):
        axes[name] = (*lead, "component")
    variables: dict[str, object] = {}
    for name, values in series.items():
        meaning, unit = _MEANING.get(name, (name.replace("_", " "), "1"))
        attributes = {"long_name": meaning, "units": unit}
        variables[name] = axes.get(name, lead), values, attributes
    for name in _LEDGER_FIELDS:
        variables |= _count_messages(name, collected.counts[name])
    if keep is not None:
        variables = {name: variables[name] for name in variables if name in keep}
    coords = {
        "time": ("time", times, {"units": "s"}),
        "agent": agents,
        "component": list(names),
        "unit": ("component", list(units)),
    }
    run = xarray.Dataset(variables, coords=coords)
    # `encoding` is the only place that xarray hands on to copies and selections, and leaves out
    # of tables and files. By the agents and the last mean `final_state` distinguishes a selection,
    # which has no final state, from the whole run.
    mean = np.array(series["mean"][-1]) if times.size else None
    run.encoding["final_state"] = collected.last, agents, mean
    return run


class _Collected(NamedTuple):
    """The recorded arrays, (T, ...) each, the ledgers' counts, and the last state.

    The counts, (T + 1, ...) each, begin with those of the state before the run.
    """

    series: dict[str, Array]
    counts: dict[str, Array]
    last: State


def _collect_series(
    f: Filter[AnyState],
    n_times: int,
    start: AnyState,
    believed: Iterable[Believed[AnyState]],
    known: _KnownTruth | None,
    keep: Collection[str] | None,
) -> _Collected:
    """Collect the numbers of a run's states and beliefs.

    Only variables to `keep` are collected, and the variance, which the spread needs. Small states
    are summarized in blocks of several times.
    """
    series: dict[str, Array] = {}
    counts = [_read_ledgers([start.ledger])]
    first = 0
    last = start
    for block in _gather_blocks(believed, f.batched_summary):
        # The ledgers are those of the states, the estimates those of the (smoothed) beliefs.
        states = [state for state, _belief in block]
        counts.append(_read_ledgers([state.ledger for state in states]))
        last = states[-1]
        # A single state is summarized as it is, without an axis of times in front.
        is_single = len(block) == 1
        beliefs = [belief for _state, belief in block]
        summary = f.summarize(beliefs[0] if is_single else stack_states(beliefs))
        row = _read_summary(summary)
        # Numbers of the steps themselves, where the filter has a gate or scores observations.
        for name in _STEP_FIELDS:
            if getattr(last, name) is not None:
                numbers = [getattr(state, name) for state in states]
                row[name] = np.array(numbers[0] if is_single else numbers)
        if isinstance(last, SensorState):
            unseen = _read_unseen(cast(Sequence[SensorState], states), f.n_agents)
            row["unseen"] = unseen[0] if is_single else unseen
        if known is not None:
            index = first if is_single else slice(first, first + len(block))
            row |= _score_block(f, summary, known, index)
        if keep is not None:
            row = {name: row[name] for name in row if name in (*keep, "variance")}
        # The block's values into the arrays of all times
        times = slice(first, first + len(block))
        for name, value in row.items():
            _write_block(
                series, name, value[None] if is_single else value, times, n_times
            )
        first += len(block)
    # The counts from before the run to its end, (T + 1, ...)
    totals = {name: np.concatenate([c[name] for c in counts]) for name in counts[0]}
    if not series:
        return _Collected(_read_nothing(f, start, known), totals, last)
    # `lacks_periods`: angles are observed, and none is declared circular in the model. Then a truth
    # that wraps beside an estimate that does not gives wrong scores.
    if known is not None and getattr(f, "lacks_periods", False):
        model = cast("SensorFilter[State]", f).model
        warn_of_wrapped_truth(model, series["mean"], known.values)
    # √(tr P). A component that an agent lacks is NaN and counts as zero; failed runs are NaN.
    variance = series["variance"]
    spread = np.sqrt(np.nansum(variance, axis=-1))
    is_missing = np.isnan(variance).all(axis=-1)
    series["spread"] = np.where(is_missing, np.nan, spread)
    return _Collected(series, totals, last)


def _write_block(
    series: dict[str, Array], name: str, values: Array, times: slice, n_times: int
) -> None:
    """Write the values of some times, (B, ...), into the array of all times, (T, ...).

    The array is made with the first block, which shows its shape, and then filled in place: a long
    record is not copied.
    """
    if name not in series:
        series[name] = np.empty((n_times, *values.shape[1:]), values.dtype)
    elif values.dtype != series[name].dtype:
        # The type that holds both, for instance if there were whole numbers so far, and fractions
        # from now on
        common = np.result_type(values, series[name])
        series[name] = series[name].astype(common)
    series[name][times] = values


def _read_ledgers(ledgers: list[Ledger]) -> dict[str, Array]:
    """Return the counts of ledgers, one after the other, by field."""
    # Where nobody sends, the ledger stays the same object: it is read once, and repeated.
    repeats = 1
    if len(ledgers) > 1 and all(ledger is ledgers[0] for ledger in ledgers):
        repeats = len(ledgers)
        ledgers = ledgers[:1]
    counts = {}
    for name in _LEDGER_FIELDS:
        column = np.array([getattr(ledger, name) for ledger in ledgers])
        counts[name] = np.repeat(column, repeats, axis=0)
    return counts


def _score_block(
    f: Filter[AnyState], summary: Summary, known: _KnownTruth, index: int | slice
) -> dict[str, Array]:
    """Return the scores of a summary of the times with this index in the run."""
    values = known.values[index]
    if f.periods:
        # Angles that differ by whole periods are the same: each is brought within half a period of
        # its estimate.
        values = np.broadcast_to(values, summary.mean.shape)
        values = align(values, summary.mean, f.periods)
    return _score(summary, values, known)


def _read_unseen(states: Sequence[SensorState], n_agents: int) -> Array:
    """Return how many observations each agent could not use in each step, (T, *runs, A).

    They are those that its sensor cannot see from its belief; a state has None if there were none.
    """
    # Which runs had failed, (T, *runs)
    failed = np.array([state.failed for state in states])
    result = np.zeros((*failed.shape, n_agents))
    for of_time, state in zip(result, states, strict=True):
        if state.unseen is not None:
            # A view of the result
            of_time[...] = state.unseen
    # A failed run has no numbers.
    result[failed] = np.nan
    return result


def _read_nothing(
    f: Filter[AnyState],
    start: AnyState,
    known: _KnownTruth | None,
) -> dict[str, Array]:
    """Return the arrays of a record without a single time, (0, ...) each.

    They have the names, shapes and types that a run would have: those of the state at its start,
    with a first axis of times from which nothing is taken.
    """
    summary = f.summarize(start)
    row = _read_summary(summary)
    row["spread"] = np.sqrt(np.nansum(summary.variance, axis=-1))
    lead = row["spread"].shape
    if isinstance(start, SensorState):
        row["unseen"] = np.zeros(lead)
    if f.gate_probability is not None:
        row["rejected"] = np.zeros(lead)
    if f.record_evidence:
        # The fields but the first, `rejected`
        for name in _STEP_FIELDS[1:]:
            row[name] = np.zeros(lead)
    if known is not None:
        # Scores with a truth of zeros, for their names and shapes alone
        row |= _score(summary, 0 * summary.mean, known)
    return {name: np.asarray(value)[None][:0] for name, value in row.items()}


def _read_summary(summary: Summary) -> dict[str, Array]:
    """Return the arrays of a summary that are recorded, by name."""
    row = {"mean": summary.mean, "variance": summary.variance, **summary.numbers}
    if summary.covariance is not None:
        row["covariance"] = summary.covariance
    return row


def _gather_blocks(
    believed: Iterable[Believed[AnyState]], batched: bool
) -> Iterator[list[Believed[AnyState]]]:
    """Yield small states of one shape together, so that one call summarizes them."""

    def shape_of(pair: Believed[AnyState]) -> tuple[int, ...]:
        # The shape of the belief, the second of the pair. States that cannot be stacked get a block
        # each: a size that fills it.
        return cast(SensorState, pair[1]).belief.shape if batched else (_BLOCK_SIZE,)

    for shape, same_shape in groupby(believed, shape_of):
        # How many states fill a block; a state that is large by itself is one.
        size = max(1, _BLOCK_SIZE // math.prod(shape))
        block = list(islice(same_shape, size))
        while block:
            yield block
            block = list(islice(same_shape, size))  # noqa: B031


def _read_keep(
    keep: Collection[str] | None,
    f: Filter[AnyState],
    start: AnyState,
    known: _KnownTruth | None,
) -> Collection[str] | None:
    """Check the names of the variables to keep, and return them with that of the mean."""
    if keep is None:
        return None
    ledger = [(name, f"{name}_total") for name in _LEDGER_FIELDS]
    # The names of all variables; the sum joins the pairs.
    recorded = {*_read_nothing(f, start, known), *sum(ledger, ())}
    unknown = [name for name in keep if name not in recorded]
    if unknown:
        raise ValueError(
            f"keep must have names among {', '.join(sorted(recorded))}, got {unknown}"
        )
    # Without the mean a record has no final state.
    return {"mean", *keep}


def _read_truth(
    recording: Recording,
    names: Sequence[str],
    shape: tuple[int, ...],
    n_agents: int,
    times: Array,
) -> _KnownTruth | None:
    """Check the truth and what is scored with it; `shape` is (T, *runs).

    The values of the result are (T, *runs, 1, d), or (T, *runs, A, d) for a truth of each agent.
    """
    truth = recording.truth
    if truth is None:
        if recording.scored is not None:
            raise ValueError("scored must be None without a truth, got components")
        return None
    # A table of pandas whose columns are named as components are
    columns = getattr(truth, "columns", None)
    if columns is not None and set(columns) <= set(names):
        # It is read like a mapping.
        table = cast("Mapping[str, TruthSeries]", truth)
        truth = {name: table[name] for name in columns}
    if isinstance(truth, Mapping):
        values, components = _read_components(truth, names, shape, n_agents, times)
    else:
        values = _read_series(truth, "truth", times)
        components = slice(None)
        if values.shape == (*shape, len(names)):
            # One for all agents
            values = values[..., None, :]
        elif values.shape != (*shape, n_agents, len(names)):
            raise ValueError(
                f"truth must be shape {(*shape, len(names))}, one for each of {n_agents} "
                f"agents, or a dict of those components that are known, got {values.shape}"
            )
    if recording.scored is not None:
        components = _read_scored(recording.scored, names, n_agents)
    return _KnownTruth(values, components, recording.scores)


def _read_series(entry: TruthSeries, name: str, times: Array) -> Array:
    """Return a series, or the values of a function at the times; NaN where nothing is known.

    Any shape is accepted here: the caller compares it with those that it can use.
    """
    if callable(entry):
        values = [
            check_array(call_user(entry, t), name, finite=False) for t in times.tolist()
        ]
        shapes = {value.shape for value in values}
        if len(shapes) > 1:
            raise ValueError(
                f"{name} must return one shape at all times, got {sorted(shapes)}"
            )
        # A series (T, ...), as if it had been given instead of the function
        entry = np.stack(values) if values else np.zeros(0)
    return check_array(entry, name, finite=False)


def _read_components(
    truth: Mapping[str, TruthSeries],
    names: Sequence[str],
    shape: tuple[int, ...],
    n_agents: int,
    times: Array,
) -> tuple[Array, Components]:
    """Check a truth of some components, by their names; the others are NaN."""
    unknown = [name for name in truth if name not in names]
    if unknown or not truth:
        raise ValueError(
            f"truth must have components of {', '.join(names)}, got {unknown}"
        )
    # NaN where nothing is known, so that no score is computed there.
    values = np.full((*shape, n_agents, len(names)), np.nan)
    for name, entry in truth.items():
        series = _read_series(entry, f"truth[{name!r}]", times)
        if series.shape == shape:
            # One for all agents
            series = series[..., None]
        else:
            series = check_array(series, "truth", (*shape, n_agents), finite=False)
        values[..., names.index(name)] = series
    return values, np.array([names.index(name) for name in truth], dtype=np.intp)


def _read_scored(
    scored: Sequence[str] | Sequence[Sequence[str]],
    names: Sequence[str],
    n_agents: int,
) -> Components:
    """Return the index of the components that are scored together, (k,) or (A, k)."""
    if isinstance(scored, str):
        raise InvalidArgumentError(
            f"scored must be a sequence of names of components, got {scored!r}"
        )
    # A list of names for each agent, or one list for all
    rows: list[Sequence[str]] = list(scored)
    is_common = all(isinstance(name, str) for name in rows)
    if is_common:
        rows = [cast(list[str], rows)]
    elif len(rows) != n_agents:
        raise ValueError(
            f"scored must have one list for each of {n_agents} agents, got {len(rows)}"
        )
    sizes = {len(row) for row in rows}
    if len(sizes) != 1 or 0 in sizes:
        raise ValueError(
            f"scored must name as many components, one or more, for each agent, got "
            f"{sorted(sizes)}"
        )
    unknown = [name for row in rows for name in row if name not in names]
    if unknown or any(len(set(row)) < len(row) for row in rows):
        raise ValueError(
            f"scored must have different names among {', '.join(names)}, got {rows}"
        )
    index = np.array([[names.index(name) for name in row] for row in rows])
    return index[0] if is_common else index


def _select(values: Array, components: Components, *, behind: int = 0) -> Array:
    """Return the components (..., A, [N,] k) of values (..., A, [N,] d).

    `behind` is the number of axes between the agents and the components.
    """
    if isinstance(components, slice) or components.ndim == 1:
        return values[..., components]
    # Each agent's own: the index (A, k) gets axes of length 1, to broadcast against the values.
    n_agents, size = components.shape
    index = components.reshape(n_agents, *[1] * behind, size)
    lead = (1,) * (values.ndim - index.ndim)
    return np.take_along_axis(values, index.reshape(*lead, *index.shape), axis=-1)


def _score(summary: Summary, truth: Array, known: _KnownTruth) -> dict[str, Array]:
    """Return the scores of a summary.

    Components are scored one by one where their truth is given. Those that are scored together
    have a nees and a total where their estimates and their truth are all finite, NaN elsewhere. An
    overflowing covariance has no nees either.
    """
    result: dict[str, Array] = {}
    scores = known.scores
    mean = summary.mean
    truth = np.broadcast_to(truth, mean.shape)
    # The errors of the components that are scored together, (..., A, k)
    together = _select(mean - truth, known.components)
    is_scored = np.asarray(np.isfinite(together).all(axis=-1))
    if "squared_error" in scores:
        result["squared_error"] = (mean - truth) ** 2
        result["total_squared_error"] = (together**2).sum(axis=-1)
    if "crps" in scores:
        # In closed form for a Gaussian, from the sorted members for an ensemble.
        if summary.members is None:
            value = gaussian_crps(mean, np.sqrt(summary.variance), truth)
        else:
            value = crps(summary.members, truth, weights=summary.weights)
        result["crps"] = np.where(np.isfinite(mean - truth), value, np.nan)
    cov = _covariance_of(summary, known.components) if "nees" in scores else None
    if cov is not None:
        # A spread that overflows beside a finite mean has no inverse.
        has_nees = is_scored & np.isfinite(cov).all(axis=(-2, -1))
        nees = np.full(is_scored.shape, np.nan)
        nees[has_nees] = _nees(together[has_nees], cov[has_nees])
        result["nees"] = nees
    return result


def _covariance_of(summary: Summary, components: Components) -> Array | None:
    """Return the covariance of the known components; None if the summary has none."""
    if summary.covariance is not None:
        # The columns of the components, and of the transpose their rows
        columns = _select(summary.covariance, components, behind=1)
        return _select(columns.mT, components, behind=1)
    if summary.members is None:
        return None
    members = _select(summary.members, components, behind=1)
    if members.shape[-2] <= members.shape[-1]:
        # A sample covariance of so few members is singular.
        return None
    return sample_covariance(members)


def final_state(run: xarray.Dataset) -> State:
    """Return the state in which a run ended, to save it or to go on from it.

    Parameters
    ----------
    run : xarray.Dataset
        The result of :meth:`Filter.run`, or a copy. A part of a run that ends earlier, or that
        lacks runs or agents, has no state.

    Returns
    -------
    State
        Of the filter's family; :meth:`Filter.final_state` is typed as that.

    Examples
    --------
    >>> import xarray
    >>> from distfilt.filters import GaussianFilter
    >>> from distfilt.models import constant_velocity
    >>> f = GaussianFilter(constant_velocity(sigma=1.0), [None])
    >>> run = f.run(f.start((np.zeros(4), np.eye(4))), [1.0, 2.0], [None])
    >>> final_state(run).t
    2.0
    >>> final_state(run.isel(time=[0]))
    Traceback (most recent call last):
    ValueError: run must be the Dataset that a filter's run returned, got one without a state
    >>> final_state(xarray.Dataset())
    Traceback (most recent call last):
    ValueError: run must be the Dataset that a filter's run returned, got one without a state
    """
    encoding = getattr(run, "encoding", {})
    if "final_state" in encoding and "mean" in run and not run["time"].size:
        state, _agents, last_mean = encoding["final_state"]
        # A run without a time ends where it starts; a selection of none does not.
        if last_mean is None:
            return cast(State, state)
    if "final_state" in encoding and "mean" in run and run["time"].size:
        state, agents, last_mean = encoding["final_state"]
        # A selection inherits the entry, but not all agents and times.
        has_agents = list(run["agent"].values) == agents
        has_end = np.array_equal(run["time"].values[-1], state.t)
        if has_agents and has_end:
            mean = run["mean"].values[-1]
            if np.array_equal(mean, last_mean, equal_nan=True):
                return cast(State, state)
    raise ValueError(
        "run must be the Dataset that a filter's run returned, got one without a state"
    )


def _count_messages(name: str, total: Array) -> dict[str, object]:
    """Return one field of the ledgers as variables: in each step, and up to then."""
    # Counts (T + 1,) of the network, or (T + 1, A) of each agent
    axes = ("time", "agent")[: total.ndim]
    unit = "B" if name.endswith("bytes") else "1"
    in_step = {"long_name": f"{name} in this step", "units": unit}
    so_far = {"long_name": f"{name} so far", "units": unit}
    return {
        name: (axes, np.diff(total, axis=0), in_step),
        f"{name}_total": (axes, total[1:], so_far),
    }


def _nees(error: Array, cov: Array) -> Array:
    """Return e' P^-1 e; infinite where an ensemble has collapsed, so that P is singular."""
    # In units of the standard deviations, so that units do not matter.
    correlation, unit = to_unit_variances(cov)
    # The smallest eigenvalue of a correlation is zero up to rounding, some 1e-16 times d.
    is_singular = np.linalg.eigvalsh(correlation)[..., 0] <= 1e-12
    # Every definite matrix serves there, since the result is replaced.
    correlation[is_singular] = np.eye(correlation.shape[-1])
    nees = quadratic_form(cholesky(correlation), error / unit)
    return np.where(is_singular, np.inf, nees)
