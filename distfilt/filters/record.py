"""What a run leaves behind: estimates, spreads, scores and the ledger, with named axes."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from ..doors import Array, array, unchecked
from ..ensembles import sample_covariance
from ..metrics import crps, gaussian_crps, nees
from ..metrics.scores import ensemble_nees
from .saving import State

if TYPE_CHECKING:
    import xarray

__all__ = ["SCORES", "Recorder", "Score", "Summary", "final_state"]

Score = Literal["squared_error", "nees", "crps"]
SCORES: tuple[Score, ...] = ("squared_error", "nees", "crps")
"""What can be recorded beside a known truth."""

_SENT = ("messages", "scalars", "bytes", "lost")

_MEANING = {
    "mean": ("estimate of the state", "of the component"),
    "variance": ("variance of the estimate", "of the component, squared"),
    "covariance": ("covariance of the estimate", "of both components, multiplied"),
    "spread": ("root of the sum of all variances, whatever their units", "mixed"),
    "squared_error": ("squared error of the estimate", "of the component, squared"),
    "total_squared_error": ("squared errors added over components, whatever their units", "mixed"),
    "crps": ("continuous ranked probability score", "of the component"),
    "nees": ("normalised estimation error squared; its mean is d for a consistent filter", "1"),
    "refused": ("readings that the gate left out in this step", "1"),
    "messages": ("messages sent in this step", "1"),
    "scalars": ("numbers sent in this step", "1"),
    "bytes": ("bytes sent in this step", "B"),
    "lost": ("messages lost in this step, mean over runs", "1"),
    "rounds": ("rounds of communication in this step", "1"),
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
    >>> Summary(np.zeros((2, 3)), np.ones((2, 3))).numbers
    {}
    """

    mean: Array
    variance: Array
    covariance: Array | None = None
    members: Array | None = None
    weights: Array | None = None
    numbers: Mapping[str, Array] = field(default_factory=dict)


class Recorder:
    """Collects summaries and ledgers of a run, and makes one Dataset of them.

    Names and units are the filter's; `start` is the state before the first step, `truth` what the
    scores compare with, as :meth:`distfilt.filters.Filter.run` describes it.
    """

    def __init__(
        self, filter_: Any, times: Array, start: Any, truth: Any, scores: Collection[Score]
    ) -> None:
        self.filter, self.times = filter_, times
        self.runs: tuple[int, ...] = tuple(start.runs)
        self.scores = scores
        self.ledgers = [start.ledger]
        self.columns: dict[str, list[Array]] = {}
        self.chosen: Any = slice(None)
        self.truth = None if truth is None else self._known(truth)

    def _known(self, truth: Any) -> Array:
        """The truth of the chosen components, (T, *runs, 1 or A, d)."""
        names = self.filter.components[0]
        shape, agents = (self.times.size, *self.runs), len(self.filter.agents)
        if not isinstance(truth, Mapping):
            x = array(truth, "truth", None, finite=False)
            if x.shape == (*shape, len(names)):
                return x[..., None, :]
            return array(x, "truth", (*shape, agents, len(names)), finite=False)
        unknown = [name for name in truth if name not in names]
        if unknown or not truth:
            raise ValueError(f"truth: needs components of {', '.join(names)}, got {unknown}")
        self.chosen = [names.index(name) for name in truth]
        parts = []
        for name, given in truth.items():
            x = array(given, f"truth[{name!r}]", None)
            parts.append(x[..., None] if x.shape == shape else array(x, "truth", (*shape, agents)))
        return np.stack(np.broadcast_arrays(*parts), axis=-1)

    def add(self, state: Any, summary: Any) -> None:
        """Record the next state."""
        known = None if self.truth is None else self.truth[len(self.ledgers) - 1]
        self.ledgers.append(state.ledger)
        out = {"mean": summary.mean, "variance": summary.variance}
        out["spread"] = np.sqrt(np.nansum(summary.variance, axis=-1))
        out["spread"][np.isnan(summary.variance).all(axis=-1)] = np.nan
        if summary.covariance is not None:
            out["covariance"] = summary.covariance
        if state.refused is not None:
            out["refused"] = state.refused
        out.update(summary.numbers)
        if known is not None:
            out.update(self._scored(summary, known))
        for name, value in out.items():
            self.columns.setdefault(name, []).append(np.asarray(value))

    def _scored(self, summary: Any, known: Array) -> dict[str, Array]:
        out: dict[str, Array] = {}
        at = self.chosen
        mean = summary.mean[..., at]
        known = np.broadcast_to(known, mean.shape)
        good = np.isfinite(mean).all(axis=-1) & np.isfinite(known).all(axis=-1)
        some = None if summary.members is None else summary.members[..., at]
        cov = None if summary.covariance is None else summary.covariance[..., at, :][..., at]
        if "squared_error" in self.scores:
            squared = (mean - known) ** 2
            out["squared_error"] = self._spread_out(squared, summary.mean.shape)
            out["total_squared_error"] = squared.sum(axis=-1)
        if "crps" in self.scores:
            if some is None:
                found = unchecked(gaussian_crps)(mean, np.sqrt(summary.variance[..., at]), known)
            else:
                found = unchecked(crps)(some, known, weights=summary.weights)
            found = np.where(good[..., None], found, np.nan)
            out["crps"] = self._spread_out(found, summary.mean.shape)
        if "nees" in self.scores and cov is not None:
            out["nees"] = _where(good, _nees_or_infinite, mean, cov, known)
        elif "nees" in self.scores and some is not None and some.shape[-2] > some.shape[-1]:
            out["nees"] = _where(good, _ensemble_nees, some, known)
        return out

    def _spread_out(self, values: Array, shape: tuple[int, ...]) -> Array:
        """Values of the chosen components among all, NaN for the others."""
        out = np.full(shape, np.nan)
        out[..., self.chosen] = values
        return out

    def dataset(self, final: Any) -> xarray.Dataset:
        """Everything recorded."""
        import xarray

        n = len(self.runs)
        runs = ("run",) if n == 1 else tuple(f"run{i}" for i in range(n))
        lead = ("time", *runs, "agent")
        axes = {"covariance": (*lead, "component", "column")}
        axes |= {k: (*lead, "component") for k in ("mean", "variance", "squared_error", "crps")}
        data = {
            name: (axes.get(name, lead), np.array(values), _attributes(name))
            for name, values in self.columns.items()
        }
        for name in _SENT:
            data |= _counted(name, [getattr(ledger, name) for ledger in self.ledgers], "agent")
        data |= _counted("rounds", [ledger.rounds for ledger in self.ledgers])
        names, units = self.filter.components
        out = xarray.Dataset(
            data,
            coords={
                "time": ("time", self.times, {"units": "s"}),
                "agent": list(self.filter.agents),
                "component": list(names),
                "unit": ("component", list(units)),
            },
        )
        # A selection or another run joined to this one inherits the entry: these tell them apart.
        last = np.array(data["mean"][1][-1]) if len(self.times) else None
        out.encoding["final_state"] = final, list(self.filter.agents), last
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
    >>> final_state(xarray.Dataset())
    Traceback (most recent call last):
    ValueError: run: needs the Dataset that a filter's run returned, got one without a state
    """
    kept = getattr(run, "encoding", {}).get("final_state")
    if kept is not None:
        state, agents, last = kept
        same = "mean" in run and list(run["agent"].values) == agents and run["time"].size > 0
        if (
            same and np.array_equal(run["time"].values[-1], state.t)
            and np.array_equal(run["mean"].values[-1], last, equal_nan=True)
        ):
            return state  # type: ignore[no-any-return]
    raise ValueError(
        "run: needs the Dataset that a filter's run returned, got one without a state"
    )


def _attributes(name: str) -> dict[str, str]:
    meaning, unit = _MEANING.get(name, (name.replace("_", " "), "1"))
    return {"long_name": meaning, "units": unit}


def _counted(name: str, values: list[Any], *axes: str) -> dict[str, Any]:
    """What was sent in each step, and in all until then."""
    total = np.array(values)
    meaning, unit = _MEANING[name]
    sums = {"long_name": meaning.replace("in this step", "so far"), "units": unit}
    return {
        name: (("time", *axes), np.diff(total, axis=0), _attributes(name)),
        f"{name}_total": (("time", *axes), total[1:], sums),
    }


def _where(good: Any, score: Any, *parts: Array) -> Array:
    """A score where there is an estimate, NaN elsewhere."""
    out = np.full(good.shape, np.nan)
    if good.any():
        out[good] = score(*(p[good] for p in parts))
    return out


def _nees_or_infinite(mean: Array, cov: Array, known: Array) -> Array:
    """NEES; infinite where a cloud has collapsed, so that its covariance claims certainty."""
    try:
        return nees(mean, cov, known)
    except ValueError:
        values = np.linalg.eigvalsh(cov)
        sure = values[..., 0] <= 1e-12 * np.abs(values[..., -1])
        if not sure.any():
            raise
        some = np.where(sure[..., None, None], np.eye(cov.shape[-1]), cov)
        return np.where(sure, np.inf, nees(mean, some, known))


def _ensemble_nees(members: Array, known: Array) -> Array:
    """The same of members."""
    try:
        return ensemble_nees(members, known)
    except ValueError:
        return _nees_or_infinite(members.mean(axis=-2), sample_covariance(members), known)
