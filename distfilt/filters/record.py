"""What a run leaves behind: estimates, spreads, scores and the ledger, with named axes."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from .. import ensembles
from ..checks import Array, array, choice, increasing
from ..metrics import crps, ensemble_nees, squared_error
from ..models import Model
from .state import EnsembleState

if TYPE_CHECKING:
    import xarray

__all__ = ["SCORES", "as_dataset"]

_SENT = ("messages", "scalars", "bytes", "lost")


SCORES = ("squared_error", "nees", "crps")
"""What can be recorded beside a known truth."""


def _recorded(
    state: EnsembleState, truth: Array | None, scores: Collection[str]
) -> dict[str, Array]:
    e = state.ensembles
    mean = ensembles.mean(e)
    squares = ensembles.mean(ensembles.anomalies(e) ** 2)
    out = {"mean": mean, "variance": squares * state.members / (state.members - 1)}
    out["spread"] = np.sqrt(out["variance"].sum(axis=-1))
    for name in _SENT:
        out[name] = getattr(state.ledger, name)
    if truth is not None:
        known = np.broadcast_to(truth[..., None, :], mean.shape)
        if "squared_error" in scores:
            out["squared_error"] = squared_error(mean, known)
        if "crps" in scores:
            out["crps"] = crps(e, known)
        if "nees" in scores and state.members > state.dim:
            out["nees"] = ensemble_nees(e, known)
    return out


def as_dataset(
    states: Iterable[EnsembleState],
    times: ArrayLike,
    model: Model,
    start: EnsembleState,
    truth: Array | None = None,
    *,
    scores: Collection[str] = SCORES,
) -> xarray.Dataset:
    """Collect the states of a run in an xarray.Dataset.

    Parameters
    ----------
    states : iterable of EnsembleState
        One per time.
    times : array_like, (T,)
        The times, in s.
    model : Model
        For the components' names.
    start : EnsembleState
        The state before the first step, for the run axes.
    truth : ndarray, (T, *runs, d), optional
        For the scores.
    scores : collection of {"squared_error", "nees", "crps"}
        Which of them to record.

    Returns
    -------
    xarray.Dataset
        Axes ``time``, ``run`` (``run0``, ``run1`` … where there are several), ``agent``,
        ``component``. NEES needs more members than components and is left out otherwise.
    """
    import xarray

    grid = increasing(times, "times")
    for score in scores:
        choice(score, "scores", SCORES)
    if truth is not None:
        array(truth, "truth", (grid.size, *start.runs, model.dim))
    columns: dict[str, list[Array]] = {}
    taken = 0
    for state in states:
        if taken < grid.size:
            known = None if truth is None else truth[taken]
            for name, value in _recorded(state, known, scores).items():
                columns.setdefault(name, []).append(value)
        taken += 1
    if taken != grid.size:
        raise ValueError(f"states: needs one per time ({grid.size}), got {taken}")
    n = len(start.runs)
    runs = ("run",) if n == 1 else tuple(f"run{i}" for i in range(n))
    per_agent = ("time", *runs, "agent")
    axes = {name: per_agent for name in ("spread", "squared_error", "nees")}
    axes |= {name: (*per_agent, "component") for name in ("mean", "variance", "crps")}
    axes |= {name: ("time", "agent") for name in _SENT}
    names = model.names or tuple(str(i) for i in range(model.dim))
    return xarray.Dataset(
        {name: (axes[name], np.array(values)) for name, values in columns.items()},
        coords={"time": grid, "component": list(names)},
    )
