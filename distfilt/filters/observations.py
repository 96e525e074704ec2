"""What every filter asks of observations: one per agent, fitting its sensor, gaps marked by NaN."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from ..checks import Array, array, increasing, same_length
from ..sensors import Sensor

__all__ = ["at_one_time", "over_times"]


def at_one_time(
    observations: Sequence[ArrayLike | None],
    sensors: Sequence[Sensor | None],
    runs: tuple[int, ...],
) -> list[Array | None]:
    """Observations of one time, per agent (*runs, m) with NaN where a component is missing.

    Each may be given as (m,) for all runs, or None; None comes back where nothing was observed in
    any run.

    >>> from distfilt.sensors import direct
    >>> at_one_time([[1.0], None], [direct([0], std=1.0), None], (2,))
    [array([[1.],
           [1.]]), None]
    """
    same_length(observations, sensors, "observations", "sensors")
    out: list[Array | None] = []
    for agent, (value, sensor) in enumerate(zip(observations, sensors, strict=True)):
        if value is None:
            out.append(None)
            continue
        if sensor is None:
            raise ValueError(f"observations: needs None for agent {agent}, which has no sensor")
        seen = array(value, f"observations[{agent}]", (..., sensor.dim), finite=False)
        whole = bool(np.isfinite(seen).all())
        if not whole and np.isinf(seen).any():
            raise ValueError(f"observations[{agent}]: needs numbers or NaN, got infinity")
        if seen.shape[:-1] != runs:
            if seen.ndim > 1:
                raise ValueError(
                    f"observations[{agent}]: needs shape {(*runs, sensor.dim)}, got {seen.shape}"
                )
            seen = np.broadcast_to(seen, (*runs, sensor.dim))
        out.append(seen if whole or not np.isnan(seen).all() else None)
    return out


def over_times(
    observations: Sequence[ArrayLike | None], sensors: Sequence[Sensor | None], times: ArrayLike
) -> tuple[Array, list[Array | None]]:
    """The times (T,), increasing, and the series of observations, per agent (T, ..., m) or None.

    >>> times, series = over_times([[[1.0], [2.0]], None], [None, None], [0.1, 0.2])
    >>> series[0].shape
    (2, 1)
    """
    grid = increasing(times, "times")
    same_length(observations, sensors, "observations", "sensors")
    series = [
        None if o is None else array(o, "observations", None, finite=False) for o in observations
    ]
    for agent, o in enumerate(series):
        if o is not None and (o.ndim < 2 or o.shape[0] != grid.size):
            raise ValueError(
                f"observations: needs ({grid.size}, ..., m) for agent {agent}, got {o.shape}"
            )
    return grid, series
