"""What a run leaves behind: estimates, spreads, scores and the ledger, with named axes."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import groupby, islice
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from ..ensembles import sample_covariance
from ..linalg import cholesky, to_unit_variances, quadratic_form
from ..metrics import crps, gaussian_crps
from ..validation import Array, check_array
from .saving import State, stack_states

if TYPE_CHECKING:
    import xarray

__all__ = ["SCORES", "Score", "Summary", "final_state", "record_run"]

Score = Literal["squared_error", "nees", "crps"]
SCORES: tuple[Score, ...] = ("squared_error", "nees", "crps")
"""What can be recorded beside a known truth."""

_BLOCK = 32768
"""Up to how many numbers the states have whose summaries are made together."""

_SENT = ("messages", "scalars", "bytes", "lost", "rounds")
_WHEN = ("in this step", "so far")

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
        "normalised estimation error squared; its mean is d for a consistent filter",
        "1",
    ),
    "rejected": ("readings that the gate left out in this step", "1"),
}


@dataclass(frozen=True, eq=False)
class Summary:
    """What a filter says of its state, for the record.

    Parameters
    ----------
    mean, variance : ndarray, (*runs, A, d)
        Estimates and their variances. Where agents' states differ in size, NaN fills the rest.
    covariance : ndarray, (*runs, A, d, d), optional
        For NEES.
    members : ndarray, (*runs, A, N, d), optional
        For CRPS, and for NEES where there is no covariance; without members CRPS is a Gaussian's.
    weights : ndarray, (*runs, A, N), optional
        The members' weights, if they differ.
    numbers : mapping of str to ndarray, (*runs, A)
        What else is worth a record, such as an effective sample size.

    Examples
    --------
    One that tells for all what the agent believes who knows most:

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


def record_run(
    filter_: Any,
    times: Array,
    start: Any,
    said: Iterable[tuple[Any, Any]],
    truth: Any,
    scores: Collection[Score],
) -> xarray.Dataset:
    """One Dataset of states, each with what it is believed as; `start` is the one before.

    Names and units are the filter's; the scores compare with the `truth`, as
    :meth:`distfilt.filters.Filter.run` describes it.
    """
    import xarray

    names, units = filter_.components
    agents = list(filter_.agents)
    known, chosen = _known(truth, names, (times.size, *start.runs), len(agents))
    series, ledgers, last = _followed(filter_, start, said, known, chosen, scores)
    n = len(start.runs)
    lead = ("time", *(("run",) if n == 1 else [f"run{i}" for i in range(n)]), "agent")
    axes = {"covariance": (*lead, "component", "column")}
    axes |= {
        k: (*lead, "component") for k in ("mean", "variance", "squared_error", "crps")
    }
    data = {}
    for name, values in series.items():
        meaning, unit = _MEANING.get(name, (name.replace("_", " "), "1"))
        data[name] = axes.get(name, lead), values, {"long_name": meaning, "units": unit}
    for name in _SENT:
        data |= _counted(name, [getattr(ledger, name) for ledger in ledgers])
    coords = {
        "time": ("time", times, {"units": "s"}),
        "agent": agents,
        "component": list(names),
        "unit": ("component", list(units)),
    }
    out = xarray.Dataset(data, coords=coords)
    # A selection or another run joined to this one inherits the entry: these tell them apart.
    mean = np.array(series["mean"][-1]) if series else None
    out.encoding["final_state"] = last, agents, mean
    return out


def _followed(
    filter_: Any,
    last: Any,
    said: Iterable[tuple[Any, Any]],
    known: Array | None,
    at: Any,
    scores: Collection[Score],
) -> tuple[dict[str, Array], list[Any], Any]:
    """What is recorded of all states, along a first axis, their ledgers, and the last one."""
    rows: list[dict[str, Array]] = []
    ledgers = [last.ledger]
    for block in _blocks(said, filter_.batched_summary):
        states, believed = zip(*block, strict=True)
        done = len(ledgers) - 1
        several = len(block) > 1
        last = states[-1]
        ledgers += [state.ledger for state in states]
        summary = filter_.summarize(stack_states(believed) if several else believed[0])
        row = {"mean": summary.mean, "variance": summary.variance, **summary.numbers}
        if summary.covariance is not None:
            row["covariance"] = summary.covariance
        if last.rejected is not None:
            row["rejected"] = (
                np.array([s.rejected for s in states]) if several else last.rejected
            )
        if known is not None:
            true = known[done : len(ledgers) - 1] if several else known[done]
            row |= _scored(summary, true, at, scores)
        rows.append(
            row if several else {name: value[None] for name, value in row.items()}
        )
    series = {
        name: np.concatenate([row[name] for row in rows]) for name in (rows or [{}])[0]
    }
    if series:
        spread = np.sqrt(np.nansum(variance := series["variance"], axis=-1))
        series["spread"] = np.where(np.isnan(variance).all(axis=-1), np.nan, spread)
    return series, ledgers, last


def _blocks(
    said: Iterable[tuple[Any, Any]], joins: bool
) -> Iterator[list[tuple[Any, Any]]]:
    """Small states of one shape together: what is recorded of them takes one call."""
    for shape, alike in groupby(
        said, lambda pair: pair[1].belief.shape if joins else (_BLOCK,)
    ):
        while block := [*islice(alike, max(1, _BLOCK // math.prod(shape)))]:
            yield block


def _known(
    truth: Any, names: Sequence[str], shape: tuple[int, ...], agents: int
) -> tuple[Array | None, Any]:
    """The truth, (T, *runs, 1 or A, d), and which components of it are known."""
    if truth is None:
        return None, slice(None)
    if hasattr(truth, "columns") and {*truth.columns} <= {*names}:
        truth = dict(truth)  # a table says itself which component is which
    if not isinstance(truth, Mapping):
        x = check_array(truth, "truth", None, finite=False)
        if x.shape == (*shape, len(names)):
            return x[..., None, :], slice(None)
        if x.shape != (*shape, agents, len(names)):
            needs = f"shape {(*shape, len(names))}, one for each of {agents} agents, or a dict of "
            raise ValueError(
                f"truth must be {needs}those components that are known, got {x.shape}"
            )
        return x, slice(None)
    unknown = [name for name in truth if name not in names]
    if unknown or not truth:
        raise ValueError(
            f"truth must have components of {', '.join(names)}, got {unknown}"
        )
    whole = np.full((*shape, agents, len(names)), np.nan)
    for name, given in truth.items():
        x = check_array(given, f"truth[{name!r}]", None)
        x = (
            x[..., None]
            if x.shape == shape
            else check_array(x, "truth", (*shape, agents))
        )
        whole[..., names.index(name)] = x
    return whole, [names.index(name) for name in truth]


def _scored(
    summary: Summary, known: Array, at: Any, scores: Collection[Score]
) -> dict[str, Array]:
    out: dict[str, Array] = {}
    mean = summary.mean
    some = summary.members
    known = np.broadcast_to(known, mean.shape)
    good: Any = np.isfinite(mean[..., at]).all(axis=-1) & np.isfinite(
        known[..., at]
    ).all(axis=-1)
    if "squared_error" in scores:
        squared = (mean - known) ** 2
        out["squared_error"] = squared
        out["total_squared_error"] = squared[..., at].sum(axis=-1)
    if "crps" in scores:
        if some is None:
            found = gaussian_crps(mean, np.sqrt(summary.variance), known)
        else:
            found = crps(some, known, weights=summary.weights)
        out["crps"] = np.where(good[..., None] & ~np.isnan(known), found, np.nan)
    mean = mean[..., at]
    known = known[..., at]
    cov = (
        None if summary.covariance is None else summary.covariance[..., at, :][..., at]
    )
    if (
        "nees" in scores
        and cov is None
        and some is not None
        and some.shape[-2] > mean.shape[-1]
    ):
        cov = sample_covariance(some[..., at])
    if "nees" in scores and cov is not None:
        out["nees"] = np.full(good.shape, np.nan)
        out["nees"][good] = _nees(mean[good], cov[good], known[good])
    return out


def final_state(run: xarray.Dataset) -> State:
    """The state in which a run ended, to be saved or gone on from.

    Parameters
    ----------
    run : xarray.Dataset
        As :meth:`Filter.run` returned it. A part of a run that ends earlier, or that lacks runs or
        agents, has no state.

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
    state, agents, last = getattr(run, "encoding", {}).get(
        "final_state", (None, (), None)
    )
    if "mean" in run and run["time"].size and list(run["agent"].values) == agents:
        ends = np.array_equal(run["time"].values[-1], state.t)
        if ends and np.array_equal(run["mean"].values[-1], last, equal_nan=True):
            return state  # type: ignore[no-any-return]
    raise ValueError(
        "run must be the Dataset that a filter's run returned, got one without a state"
    )


def _counted(name: str, values: list[Any]) -> dict[str, Any]:
    """What was sent in each step, and in all until then."""
    total = np.array(values)
    axes = ("time", "agent")[: total.ndim]
    unit = "B" if name == "bytes" else "1"
    now, sums = ({"long_name": f"{name} {when}", "units": unit} for when in _WHEN)
    return {
        name: (axes, np.diff(total, axis=0), now),
        f"{name}_total": (axes, total[1:], sums),
    }


def _nees(mean: Array, cov: Array, known: Array) -> Array:
    """NEES, whatever the units; infinite where a cloud has collapsed, which claims certainty."""
    shape, unit = to_unit_variances(cov)
    sure = np.linalg.eigvalsh(shape)[..., 0] <= 1e-12
    shape[sure] = np.eye(shape.shape[-1])
    return np.where(
        sure, np.inf, quadratic_form(cholesky(shape), (mean - known) / unit)
    )
