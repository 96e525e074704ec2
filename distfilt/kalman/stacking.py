"""Several sensors read at once, as one sensor: what a centralised filter sees."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from ..checks import Array, array, increasing, number
from ..sensors import Sensor

__all__ = ["stack"]


def stack(sensors: Sequence[Sensor]) -> Sensor:
    """One sensor whose observation is the observations of `sensors`, one after the other.

    Parameters
    ----------
    sensors : sequence of Sensor
        At least one. The noise of different sensors is independent.

    Returns
    -------
    Sensor
        It wraps the components that the given sensors wrap, it is linear if all of them are, and
        it needs the previous state if one of them does.

    Raises
    ------
    ValueError
        If there is no sensor or an entry is none.

    Examples
    --------
    >>> from distfilt.sensors import angle, direct
    >>> both = stack([direct([0], noise=0.1), angle([0, 1], noise=0.2)])
    >>> both.predict([1.0, 1.0]).round(4), both.noise.diagonal().round(4)
    (array([1.    , 0.7854]), array([0.01, 0.04]))
    """
    parts = tuple(sensors) if isinstance(sensors, Sequence) else ()
    if not parts or not all(isinstance(s, Sensor) for s in parts):
        raise ValueError(f"sensors: needs a sequence of at least one Sensor, got {sensors!r}")
    ends = np.cumsum([s.dim for s in parts])
    noise = np.zeros((ends[-1], ends[-1]))
    for s, end in zip(parts, ends, strict=True):
        noise[end - s.dim : end, end - s.dim : end] = s.noise

    def function(x: Array, previous: Array | None = None) -> Array:
        return np.concatenate([s.predict(x, previous) for s in parts], axis=-1)

    def difference(observed: Array, predicted: Array) -> Array:
        pairs = zip(
            parts,
            np.split(observed, ends[:-1], axis=-1),
            np.split(predicted, ends[:-1], axis=-1),
            strict=True,
        )
        return np.concatenate([s.residual(y, p) for s, y, p in pairs], axis=-1)

    return Sensor(
        int(ends[-1]),
        function,
        noise,
        difference=difference,
        uses_previous=any(s.uses_previous for s in parts),
        kind="stacked",
        linear=(
            None
            if any(s.linear is None for s in parts)
            else lambda d: np.concatenate([s.matrix(d) for s in parts])
        ),
    )


def _instantaneous(sensors: Sequence[Sensor]) -> Sensor:
    """The stacked sensor, if none of the sensors needs the previous state."""
    out = stack(sensors)
    if out.uses_previous:
        raise ValueError("sensors: needs sensors of the present state, got a differential sensor")
    return out


def _series(observations: ArrayLike, times: ArrayLike, t0: float, dim: int) -> tuple[Array, Array]:
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
