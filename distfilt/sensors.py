"""Sensors: what an agent sees of a state, how noisy it is, and how two readings are compared."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from .checks import Array, array, callable_, choice, count, covariance, generator, number
from .linalg import factor

__all__ = ["Sensor", "angle", "differential", "direct", "of_kind", "range_", "stack", "wrap"]

_DIFFERENCE_STEP = 6e-6
"""Step of a central difference, about the cube root of the rounding unit."""


def wrap(angles: ArrayLike, *, period: float = 2 * np.pi) -> Array:
    """Bring angles into [-period/2, period/2).

    Parameters
    ----------
    angles : array_like, (...)
        Angles, in rad.
    period : float
        2π for directions; π for the angle of a line, which `arctan(b/a)` measures.

    Examples
    --------
    >>> float(wrap(3 * np.pi / 2).round(6))
    -1.570796
    """
    a = array(angles, "angles")
    p = number(period, "period", above=0)
    return np.asarray((a + p / 2) % p - p / 2)


@dataclass(frozen=True)
class Sensor:
    """A sensor y = h(x) + ζ, ζ ~ N(0, R), possibly of two successive states.

    Parameters
    ----------
    dim : int
        Size m of an observation.
    function : callable
        ``function(x) -> y`` on (..., d) to (..., m), without noise; with `uses_previous`,
        ``function(x, previous) -> y``.
    noise : array_like, (m, m)
        The covariance R, positive definite.
    difference : callable, optional
        ``difference(observed, predicted)``, for readings that wrap; subtraction by default.
    uses_previous : bool
        Whether the sensor sees the change from the previous observation time.
    kind : str
        A name, for tables.
    linear : callable, optional
        ``linear(d) -> H``, (m, d), if h is linear.

    Examples
    --------
    >>> total = Sensor(1, lambda x: x.sum(axis=-1, keepdims=True), [[0.04]])
    >>> total.predict([1.0, 2.0])
    array([3.])
    """

    dim: int
    function: Callable[..., Array]
    noise: Array
    difference: Callable[[Array, Array], Array] | None = None
    uses_previous: bool = False
    kind: str = "sensor"
    linear: Callable[[int], Array] | None = None

    def __post_init__(self) -> None:
        count(self.dim, "dim")
        callable_(self.function, "function")
        noise = covariance(self.noise, "noise", self.dim).copy()
        noise.setflags(write=False)
        object.__setattr__(self, "noise", noise)

    def predict(self, x: ArrayLike, previous: ArrayLike | None = None) -> Array:
        """The observation without noise of states (..., d), as (..., m).

        `previous` holds the states at the previous observation time; only a sensor that sees
        changes needs it.
        """
        state = array(x, "x", (..., "d"))
        if not self.uses_previous:
            seen = self.function(state)
        elif previous is None:
            raise ValueError(f"previous: a {self.kind} sensor needs the previous states, got None")
        else:
            seen = self.function(state, array(previous, "previous", (..., state.shape[-1])))
        if seen.shape[-1] != self.dim:
            raise ValueError(
                f"function: needs to return (..., {self.dim}), got shape {seen.shape}"
            )
        return seen

    def observe(
        self, x: ArrayLike, *, rng: np.random.Generator, previous: ArrayLike | None = None
    ) -> Array:
        """A noisy observation of each of the states (..., d), as (..., m)."""
        seen = self.predict(x, previous)
        root = factor(self.noise, name="noise")
        return seen + generator(rng).standard_normal(seen.shape) @ root.T

    def residual(self, observed: ArrayLike, predicted: ArrayLike) -> Array:
        """How far observations are from predictions, (..., m), wrapped where the sensor wraps.

        NaN marks a missing component and stays NaN.
        """
        y = array(observed, "observed", (..., self.dim), finite=False)
        p = array(predicted, "predicted", (..., self.dim))
        return y - p if self.difference is None else self.difference(y, p)

    def matrix(self, dim: int) -> Array:
        """The matrix H, (m, `dim`), of a linear sensor."""
        if self.linear is None:
            raise ValueError(f"sensor: needs a linear sensor, got a {self.kind} sensor")
        return self.linear(count(dim, "dim"))

    def jacobian(self, x: ArrayLike) -> Array:
        """Derivative of h at states (..., d) by central differences, as (..., m, d)."""
        state = array(x, "x", (..., "d"))
        if self.linear is not None:
            h = self.linear(state.shape[-1])
            return np.broadcast_to(h, (*state.shape[:-1], *h.shape)).copy()
        steps = _DIFFERENCE_STEP * np.maximum(1.0, np.abs(state))
        moves = steps[..., :, None] * np.eye(state.shape[-1])
        ahead = self.predict(state[..., None, :] + moves)
        behind = self.predict(state[..., None, :] - moves)
        slope = self.residual(ahead, behind) / (2 * steps[..., :, None])
        return np.swapaxes(slope, -1, -2)


def _indices(indices: Sequence[int], needed: int | None = None) -> tuple[int, ...]:
    picked = tuple(count(i, "indices", at_least=0) for i in indices)
    if not picked or len(set(picked)) != len(picked):
        raise ValueError(f"indices: needs distinct components, got {tuple(indices)}")
    if needed is not None and len(picked) != needed:
        raise ValueError(f"indices: needs {needed} components, got {len(picked)}")
    return picked


def _pick(x: Array, indices: tuple[int, ...]) -> Array:
    if max(indices) >= x.shape[-1]:
        raise ValueError(
            f"x: needs more than {max(indices)} components for this sensor, got {x.shape[-1]}"
        )
    return x[..., list(indices)]


def _variance(noise: float, size: int) -> Array:
    return number(noise, "noise", above=0) ** 2 * np.eye(size)


def direct(indices: Sequence[int], *, noise: float) -> Sensor:
    """See some components of the state as they are, ``h(x) = x[indices]``.

    Parameters
    ----------
    indices : sequence of int
        The components, counted from 0.
    noise : float
        Standard deviation of each reading, in the component's unit, positive.

    Examples
    --------
    >>> direct([0, 2], noise=0.1).predict([1.0, 2.0, 3.0])
    array([1., 3.])
    """
    picked = _indices(indices)

    def matrix(dim: int) -> Array:
        return _pick(np.eye(dim), picked).T

    return Sensor(
        len(picked),
        lambda x: _pick(x, picked),
        _variance(noise, len(picked)),
        kind="direct",
        linear=matrix,
    )


def differential(indices: Sequence[int], *, noise: float) -> Sensor:
    """See how much some components changed since the previous observation time.

    Parameters
    ----------
    indices : sequence of int
        The components, counted from 0.
    noise : float
        Standard deviation of each reading, positive.

    Examples
    --------
    >>> differential([1], noise=0.1).predict([1.0, 5.0], previous=[0.0, 3.0])
    array([2.])
    """
    picked = _indices(indices)
    return Sensor(
        len(picked),
        lambda x, previous: _pick(x, picked) - _pick(previous, picked),
        _variance(noise, len(picked)),
        uses_previous=True,
        kind="differential",
    )


def range_(indices: Sequence[int], *, noise: float) -> Sensor:
    """See the distance from the origin in some components, ``h(x) = |x[indices]|``.

    Parameters
    ----------
    indices : sequence of int
        The components, counted from 0.
    noise : float
        Standard deviation of the range, in the components' unit, positive.

    Examples
    --------
    >>> range_([0, 1], noise=0.1).predict([3.0, 4.0, 9.0])
    array([5.])
    """
    picked = _indices(indices)
    return Sensor(
        1,
        lambda x: np.linalg.norm(_pick(x, picked), axis=-1, keepdims=True),
        _variance(noise, 1),
        kind="range",
    )


def angle(indices: Sequence[int], *, noise: float, full: bool = False) -> Sensor:
    """See the angle of two components (a, b), in rad.

    Parameters
    ----------
    indices : sequence of two int
        The components a and b.
    noise : float
        Standard deviation, in rad, positive.
    full : bool
        False: ``arctan(b/a)``, the angle of a line, which repeats after π (Grange et al., Table I).
        True: ``arctan2(b, a)``, a direction, which repeats after 2π.

    Notes
    -----
    At a = b = 0 the angle does not exist: the prediction is NaN, which a filter reads as a missing
    observation.

    Examples
    --------
    >>> sight = angle([0, 1], noise=0.2)
    >>> sight.predict([1.0, 1.0]).round(4)
    array([0.7854])
    >>> sight.residual([1.5], [-1.5]).round(4)
    array([-0.1416])
    """
    picked = _indices(indices, 2)
    period = 2 * np.pi if full else np.pi

    def centred(value: Array) -> Array:
        return (value + period / 2) % period - period / 2

    def function(x: Array) -> Array:
        a, b = np.moveaxis(_pick(x, picked), -1, 0)
        direction = np.where((a == 0) & (b == 0), np.nan, np.arctan2(b, a))
        return np.asarray(centred(direction))[..., None]

    return Sensor(
        1,
        function,
        _variance(noise, 1),
        difference=lambda y, p: centred(y - p),
        kind="angle",
    )


def of_kind(kind: str, indices: Sequence[int], *, noise: float) -> Sensor:
    """The sensor that a table names.

    Parameters
    ----------
    kind : {"direct", "differential", "range", "angle"}
        The types of Grange et al., Table I; ``"angle"`` is ``arctan(b/a)``.
    indices : sequence of int
        The components, counted from 0.
    noise : float
        Standard deviation of each reading, positive.

    Examples
    --------
    >>> of_kind("range", [0, 1], noise=0.1).kind
    'range'
    """
    makers: dict[str, Callable[..., Sensor]] = {
        "direct": direct,
        "differential": differential,
        "range": range_,
        "angle": angle,
    }
    return makers[choice(kind, "kind", makers)](indices, noise=noise)


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
