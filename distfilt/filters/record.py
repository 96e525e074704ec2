"""What a run leaves behind: estimates, spreads, scores and the ledger, with named axes."""

from __future__ import annotations

from collections.abc import Collection
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from ..checks import Array, array, choice, instance
from ..metrics import crps, ensemble_nees, gaussian_crps, nees

if TYPE_CHECKING:
    import xarray

__all__ = ["SCORES", "Recorder"]

SCORES = ("squared_error", "nees", "crps")
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
    "messages": ("messages sent in this step", "1"),
    "scalars": ("numbers sent in this step", "1"),
    "bytes": ("bytes sent in this step", "B"),
    "lost": ("messages lost in this step, mean over runs", "1"),
    "rounds": ("rounds of communication in this step", "1"),
}


class Recorder:
    """Collects summaries and ledgers of a run, and makes one Dataset of them.

    Names and units are the filter's; `start` is the state before the first step, `truth` (T, *runs,
    d) what the scores compare with.
    """

    def __init__(
        self, filter_: Any, times: Array, start: Any, truth: ArrayLike | None,
        scores: Collection[str],
    ) -> None:
        self.filter, self.times = filter_, times
        self.runs: tuple[int, ...] = tuple(start.runs)
        chosen = instance(scores, "scores", Collection)  # type: ignore[type-abstract]
        self.scores = [choice(s, "scores", SCORES) for s in chosen]
        self.ledgers = [start.ledger]
        self.columns: dict[str, list[Array]] = {}
        self.truth: Array | None = None
        if truth is not None:
            size = len(filter_.components[0])
            self.truth = array(truth, "truth", (times.size, *self.runs, size))

    def add(self, state: Any, summary: Any) -> None:
        """Record the next state."""
        known = None
        if self.truth is not None:
            known = self.truth[len(self.ledgers) - 1][..., None, :]
        self.ledgers.append(state.ledger)
        out = {"mean": summary.mean, "variance": summary.variance}
        out["spread"] = np.sqrt(np.nansum(summary.variance, axis=-1))
        out["spread"][np.isnan(summary.variance).all(axis=-1)] = np.nan
        if summary.covariance is not None:
            out["covariance"] = summary.covariance
        out.update(summary.numbers)
        if known is not None:
            out.update(self._scored(summary, np.broadcast_to(known, summary.mean.shape)))
        for name, value in out.items():
            self.columns.setdefault(name, []).append(np.asarray(value))

    def _scored(self, summary: Any, known: Array) -> dict[str, Array]:
        out: dict[str, Array] = {}
        good = np.isfinite(summary.mean).all(axis=-1)
        if "squared_error" in self.scores:
            out["squared_error"] = (summary.mean - known) ** 2
            out["total_squared_error"] = out["squared_error"].sum(axis=-1)
        if "crps" in self.scores:
            out["crps"] = _where(good, lambda k: _crps(summary, known, k), known.shape[-1:])
        if "nees" in self.scores and _has_nees(summary):
            out["nees"] = _where(good, lambda k: _nees(summary, known, k), ())
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
        out.encoding["final_state"] = final
        return out


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


def _where(good: Any, score: Any, shape: tuple[int, ...]) -> Array:
    """A score where there is an estimate, NaN elsewhere."""
    if good.all():
        return np.asarray(score(...))
    out = np.full((*good.shape, *shape), np.nan)
    if good.any():
        out[good] = score(good)
    return out


def _has_nees(summary: Any) -> bool:
    if summary.covariance is not None:
        return True
    if summary.members is None or summary.weights is not None:
        return False
    members, dim = summary.members.shape[-2:]
    return bool(members > dim)


def _nees(summary: Any, known: Array, keep: Any) -> Array:
    if summary.covariance is not None:
        return _nees_or_infinite(summary.mean[keep], summary.covariance[keep], known[keep])
    return ensemble_nees(summary.members[keep], known[keep])


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


def _crps(summary: Any, known: Array, keep: Any) -> Array:
    if summary.members is None:
        return gaussian_crps(summary.mean[keep], np.sqrt(summary.variance[keep]), known[keep])
    if summary.weights is not None:
        return crps(summary.members[keep], known[keep], weights=summary.weights[keep])
    return crps(summary.members[keep], known[keep])
