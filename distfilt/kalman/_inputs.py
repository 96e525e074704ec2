"""What the filters of this folder ask of sensors and of a series of observations."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from ..checks import Array, array, increasing, number
from ..sensors import Sensor, stack

__all__: list[str] = []


def instantaneous(sensors: Sequence[Sensor]) -> Sensor:
    """The stacked sensor, if none of the sensors needs the previous state."""
    out = stack(sensors)
    if out.uses_previous:
        raise ValueError("sensors: needs sensors of the present state, got a differential sensor")
    return out


def series(observations: ArrayLike, times: ArrayLike, t0: float, dim: int) -> tuple[Array, Array]:
    """Observations (T, ..., m), and the T + 1 times of the prior and of the observations."""
    grid = increasing(times, "times")
    start = number(t0, "t0")
    if not grid.size or grid[0] <= start:
        raise ValueError(f"times: needs times after t0 = {start:g}, got {grid[:1]}")
    y = array(observations, "observations", None, finite=False)
    if y.ndim < 2 or y.shape[0] != grid.size or y.shape[-1] != dim:
        raise ValueError(f"observations: needs shape ({grid.size}, ..., {dim}), got {y.shape}")
    if np.isinf(y).any():
        raise ValueError("observations: needs finite numbers or NaN (missing), got infinity")
    return y, np.concatenate([[start], grid])
