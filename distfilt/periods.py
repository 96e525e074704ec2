"""Circular components: their periods, and states and observations on one branch.

A component with a period p, such as an angle, is the same after p. Numbers that mean the same
direction may differ by a multiple of it, so a mean or a difference of two numbers makes sense
only on one branch: where all of them lie about a common centre. The functions of this module
move numbers by whole periods and change nothing else; those on the branch keep all their bits.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import lru_cache
from typing import TYPE_CHECKING, cast

import numpy as np
from numpy.typing import NDArray

from .validation import Array, InvalidArgumentError
from .validation.first_use import mark_checked, needs_check

if TYPE_CHECKING:
    from typing import Protocol

    class _Model(Protocol):
        """The parts of a model that are used here, in a layer below the models."""

        @property
        def periods(self) -> object: ...
        @property
        def names(self) -> Sequence[str]: ...
        def step(self, x: Array, t: float, dt: float) -> Array: ...
        def jacobian(self, x: Array, t: float, dt: float) -> Array: ...

    class _Sensor(Protocol):
        """The parts of a sensor that are used here."""

        @property
        def kind(self) -> str: ...
        def predict(self, x: Array, previous: Array | None = None) -> Array: ...
        def residual(self, y: Array, expected: Array) -> Array: ...


__all__: list[str] = []

Periods = tuple[float | None, ...]
"""A period for each component, None for one that is not circular; () if none is."""

if TYPE_CHECKING:
    PeriodsArgument = (
        Sequence[float | None] | Mapping[int, float | None] | Mapping[str, float | None]
    )
else:
    # Checked by `read_periods`, which converts it.
    PeriodsArgument = object

# A function is linear up to wraps if it differs from its tangent by less, relative to its range.
_LINEAR = 1e-5
# How much a function may change when a circular component turns once, relative to 1 + |f|: more
# than the rounding of a turn in single precision, and far less than a missing period.
_SAME = 1e-4


def read_periods(periods: object, dim: int, names: Sequence[str] = ()) -> Periods:
    """Return a period or None for each component, of a sequence or of a mapping.

    Parameters
    ----------
    periods : sequence of (float or None), or mapping
        One entry for each component; or the periods of the circular ones, by index or name.
    dim : int
        Number of components.
    names : sequence of str
        Their names, if they have any.

    Examples
    --------
    >>> read_periods((None, 6.0), 2), read_periods({"b": 6.0}, 2, ("a", "b"))
    ((None, 6.0), (None, 6.0))
    >>> read_periods((None, None), 2), read_periods((), 2)
    ((), ())
    >>> read_periods({2: 6.0}, 2)
    Traceback (most recent call last):
    ValueError: periods must have keys among 0, 1, got 2
    """
    if isinstance(periods, Mapping):
        entries: list[object] = [None] * dim
        # A component's place by its index, and by its name.
        places: dict[object, int] = dict(enumerate(range(dim)))
        places |= {n: k for k, n in enumerate(names)}
        for key, period in periods.items():
            if key not in places:
                raise ValueError(
                    f"periods must have keys among {', '.join(map(str, places))}, got {key}"
                )
            entries[places[key]] = period
    elif isinstance(periods, str) or not isinstance(periods, Iterable):
        raise InvalidArgumentError(
            f"periods must be a tuple with {dim} entries, or a mapping of components to "
            f"periods, got {periods!r}"
        )
    else:
        entries = list(periods)
    if entries and len(entries) != dim:
        raise ValueError(f"periods must have {dim} entries, got {len(entries)}")
    result = tuple([_read_period(period) for period in entries])
    # An empty tuple if no component is circular.
    return result if any(period is not None for period in result) else ()


def _read_period(period: object) -> float | None:
    """Return one entry as a positive, finite float, or None where it is None."""
    if period is None:
        return None
    # A bool is an int in Python.
    if isinstance(period, bool) or not isinstance(
        period, int | float | np.floating | np.integer
    ):
        raise InvalidArgumentError(f"periods must have numbers or None, got {period!r}")
    if not 0 < period < np.inf:
        raise ValueError(f"periods must be positive and finite, got {period}")
    return float(period)


@lru_cache(maxsize=64)
def _find_circular(periods: Periods) -> tuple[NDArray[np.intp], Array]:
    """Return the indices of the circular components and their periods, (c,) each, read-only."""
    circular = [k for k, period in enumerate(periods) if period is not None]
    places = np.array(circular, dtype=np.intp)
    p = np.array([periods[k] for k in circular], dtype=np.float64)
    # All callers share the cached arrays.
    places.setflags(write=False)
    p.setflags(write=False)
    return places, p


def align(values: Array, reference: Array, periods: Periods) -> Array:
    """Bring values (..., d) onto the branch of a reference, up to half a period from it.

    Values that are there already are returned as they are.

    >>> align(np.array([3.0, 3.0]), np.array([-3.0, -3.0]), (2 * np.pi, None)).round(4)
    array([-3.2832,  3.    ])
    """
    if not periods:
        return values
    # Indices of the circular components, and their periods
    places, p = _find_circular(periods)
    difference = values.take(places, axis=-1) - reference.take(places, axis=-1)
    # The usual case: all lie within half a period. NaN, a missing number, does not.
    if np.count_nonzero(np.abs(difference) < 0.5 * p) == difference.size:
        return values
    turns = _count_turns(difference, p)
    if not turns.any():
        return values
    result = np.array(np.broadcast_to(values, (*turns.shape[:-1], len(periods))))
    result[..., places] -= p * turns
    return result


def _count_turns(difference: Array, p: Array) -> Array:
    """Return how many whole periods p (c,) to take off differences (..., c); none off NaN."""
    # A difference d - p k lies in [-p/2, p/2).
    turns: Array = np.floor(difference / p + 0.5)
    return np.where(np.isfinite(turns), turns, 0.0)


def wrap_differences(differences: Array, periods: Periods) -> Array:
    """Return differences (..., d) with the circular ones in [-period/2, period/2)."""
    if not periods:
        return differences
    # Indices of the circular components, and their periods
    places, p = _find_circular(periods)
    # The usual case: all lie within half a period.
    size = np.abs(differences.take(places, axis=-1))
    if np.count_nonzero(size < 0.5 * p) == size.size:
        return differences
    return align(differences, np.zeros(len(periods)), periods)


def circular_mean(
    members: Array, periods: Periods, weights: Array | None = None
) -> Array:
    """Return the directions of mean vectors of members (..., N, d), as (..., 1, d).

    Components that are not circular are zero. Without `weights` (..., N) all members count alike.

    >>> circular_mean(np.array([[3.0], [-3.0]]), (2 * np.pi,)).round(4)
    array([[3.1416]])
    """
    # Indices of the c circular components, and their periods p (c,)
    places, p = _find_circular(periods)
    # Each member is a unit vector exp(2πi x/p) in the complex plane; the mean vector's direction
    # is that of their sum.
    phases = np.exp(2j * np.pi / p * members[..., places])
    if weights is not None:
        phases = weights[..., None] * phases
    vectors = phases.sum(axis=-2, keepdims=True)
    result = np.zeros((*members.shape[:-2], 1, members.shape[-1]))
    result[..., places] = np.angle(vectors) * p / (2 * np.pi)
    return result


def fold(members: Array, periods: Periods, weights: Array | None = None) -> Array:
    """Bring members (..., N, d) onto the branch about their circular mean."""
    if not periods:
        return members
    return align(members, circular_mean(members, periods, weights), periods)


def fold_torn(members: Array, periods: Periods) -> Array:
    """Bring members (..., N, d) onto one branch where a cut has torn them.

    That is where they lie within about one period and their variance falls below half by it.
    Members that are spread wider than the circle stay on the line.
    """
    if not periods:
        return members
    # About the circular mean; the members themselves, if they lie on that branch already.
    folded = fold(members, periods)
    if folded is members:
        return members
    # Indices of the circular components, and their periods
    places, p = _find_circular(periods)
    is_torn = 2 * folded.var(axis=-2) < members.var(axis=-2)
    # Members that were wrapped lie within one period, a little more with noise added since.
    is_torn[..., places] &= np.ptp(members[..., places], axis=-2) < 1.25 * p
    return np.where(is_torn[..., None, :], folded, members)


def settle(members: Array, periods: Periods, weights: Array | None = None) -> Array:
    """Shift all members (..., N, d) alike, so that their mean is in [-period/2, period/2).

    With `weights` (..., N) it is their weighted mean.
    """
    if not periods:
        return members
    if weights is None:
        mean = members.mean(axis=-2, keepdims=True)
    else:
        mean = weights[..., None, :] @ members
    # Wrapped as a difference from zero, the mean lies in the interval.
    shift = wrap_differences(mean, periods) - mean
    # The shift is exactly zero where the mean already lies in the interval.
    return members + shift if shift.any() else members


def gather(
    values: Array,
    bring_near: Callable[[Array, Array], Array],
    tangent: Callable[[], Array | None],
    fallback: Callable[[], Array],
) -> Array:
    """Bring a function's values at N points, such as the members of an ensemble, onto one branch.

    A branch is a choice of the multiple of the period that is added to each angle. Where the values
    lie within half a period, one branch has them all close together: that of the first value.
    Otherwise each value needs a reference of its own, to which it is brought near. That is the
    tangent at the points' mean, if the function is linear but for wraps, as that of a compass is,
    and `fallback` if not.

    Parameters
    ----------
    values : ndarray, (..., N, m)
    bring_near : callable
        ``bring_near(values, reference)``, on the branch of the reference.
    tangent, fallback : callable
        Functions without arguments, called only if they are needed, which is rare. They return the
        references, (..., N, m) or (..., 1, m); a tangent may be None.
    """
    by_first = bring_near(values, values[..., :1, :])
    high = np.fmax.reduce(by_first, axis=-2, keepdims=True)
    low = np.fmin.reduce(by_first, axis=-2, keepdims=True)
    # Within half a period the largest value is on the branch of the smallest already, and is not
    # moved when it is brought near to it, up to rounding.
    rounding = 1e-9 * (1 + np.abs(high) + np.abs(low))
    is_wide = np.abs(bring_near(high, low) - high) > rounding
    if not is_wide.any():
        return by_first
    by_reference = bring_near(values, fallback())
    line = tangent()
    if line is not None:
        by_line = bring_near(values, line)
        # The function is linear if its values lie on the tangent, up to wraps.
        error = np.abs(by_line - line).max(axis=-2, keepdims=True)
        is_linear = error <= _LINEAR * np.ptp(line, axis=-2, keepdims=True)
        by_reference = np.where(is_linear, by_line, by_reference)
    return np.where(is_wide, by_reference, by_first)


def step_members(model: _Model, x: Array, t: float, dt: float) -> Array:
    """Move states (..., N, d) without noise; with declared periods they stay on one branch.

    >>> from distfilt.models import Model
    >>> from distfilt.sensors import wrap
    >>> turn = Model(
    ...     1,
    ...     lambda x, t, dt: wrap(x + 0.2),
    ...     lambda t, dt: np.zeros((1, 1)),
    ...     periods=(2 * np.pi,),
    ... )
    >>> step_members(turn, np.array([[2.9], [3.0]]), 0.0, 1.0)
    array([[3.1],
           [3.2]])
    """
    values = model.step(x, t, dt)
    periods = cast(Periods, model.periods)
    if not periods:
        return values
    if x.shape[-2] == 1:
        # A single member is on one branch by itself.
        check_transition(model, x[..., 0, :], t, dt)
        return values
    centre = x.mean(axis=-2)
    check_transition(model, centre, t, dt)

    def bring_near(moved: Array, reference: Array) -> Array:
        return align(moved, reference, periods)

    def tangent() -> Array:
        # f(m) + F (x_i - m)
        slope = model.jacobian(centre, t, dt)
        offsets = x - centre[..., None, :]
        moved = model.step(centre, t, dt)[..., None, :]
        return np.asarray(moved + offsets @ slope.mT)

    def fallback() -> Array:
        # Every member moves by about the mean displacement, taken as a circular mean.
        return x + circular_mean(values - x, periods)

    # Values that span more than half a period are brought near to the tangent, or, if the model is
    # not linear, to the fallback.
    return gather(values, bring_near, tangent, fallback)


def check_transition(model: _Model, x: Array, t: float, dt: float) -> None:
    """Refuse periods that do not belong to a model: states a period apart must move alike.

    The states x are (..., d), and move from t to t + dt.
    """
    if not needs_check(model, "periods"):
        return
    periods = cast(Periods, model.periods)
    # Indices of the circular components, and their periods
    places, p = _find_circular(periods)
    before = model.step(x, t, dt)
    # Each circular component in turn moves on by one period.
    for place, period in zip(places, p, strict=True):
        turned = x.copy()
        turned[..., place] += period
        after = model.step(turned, t, dt)
        change = np.abs(wrap_differences(after - before, periods))
        if (change > _SAME * (1 + np.abs(before))).any():
            raise ValueError(
                f"periods must fit transition, got a period of {period:g} for component "
                f"{name_component(model, place)}, after which the states move differently"
            )
    mark_checked(model, "periods")


def check_sensor(
    sensor: _Sensor,
    model: _Model,
    states: Array,
    previous: Array | None = None,
    observed: Array | None = None,
) -> None:
    """Refuse a sensor whose observation of a circular component lacks a period, once.

    Parameters
    ----------
    sensor, model
        The model has circular components.
    states, previous : ndarray, (..., N, d)
    observed : ndarray, (..., m), optional
        Observations, of which a sensor that is a likelihood gives the density.
    """
    # Once for each pair of a sensor and a model
    key = f"periods of model {id(model)}"
    if not needs_check(sensor, key):
        return
    # A sensor that is a likelihood can only be tested at an observation.
    evaluate = getattr(sensor, "evaluate", None)
    if evaluate is not None and (observed is None or np.isnan(observed).all()):
        return
    mark_checked(sensor, key)
    # A differential sensor compares with the state of the previous time.
    x = states.mean(axis=-2)
    args = () if previous is None else (previous.mean(axis=-2),)
    # Each circular component in turn: a whole turn must not change the prediction.
    places, p = _find_circular(cast(Periods, model.periods))
    for place, period in zip(places, p, strict=True):
        turned = x.copy()
        turned[..., place] += period
        name = name_component(model, place)
        if evaluate is not None:
            _check_likelihood(evaluate, sensor.kind, x, turned, observed, name)
            # Without moments it predicts nothing.
            if getattr(sensor, "moments", None) is None:
                continue
        before = sensor.predict(x, *args)
        change = np.abs(sensor.residual(sensor.predict(turned, *args), before))
        # NaN, where the sensor cannot see, is no change.
        if (change > _SAME * (1 + np.abs(before))).any():
            raise ValueError(
                f"sensors must have periods= where they measure circular components, got one "
                f"of kind {sensor.kind!r} that changes by {np.nanmax(change):.4g} when component "
                f"{name} turns once"
            )


def _check_likelihood(
    evaluate: Callable[..., Array],
    kind: str,
    x: Array,
    turned: Array,
    observed: Array | None,
    name: str,
) -> None:
    """Refuse a likelihood that differs for states (..., d) and those that have turned once.

    The function ``evaluate(x, y)`` is the log-likelihood of a sensor of this kind, and `observed`
    the observation y at which it is tested. The component that has turned is named in the error.
    """
    before = evaluate(x, observed)
    after = evaluate(turned, observed)
    with np.errstate(invalid="ignore"):
        # Two that are impossible, minus infinity, do not differ.
        change = np.abs(after - before)
    if (change > _SAME * (1 + np.abs(before))).any():
        raise ValueError(
            f"sensors must have the same log_likelihood for the same direction, got one of "
            f"kind {kind!r} that changes by {np.nanmax(change):.4g} when component {name} turns "
            "once: let it take differences of angles by wrap"
        )


def name_component(model: _Model, place: int) -> str:
    """Return a component's name, or its number."""
    return model.names[place] if model.names else str(place)


def warn_of_wrapping(
    model: _Model, x: Array, values: Array, t: float, dt: float
) -> None:
    """Warn once if a model without periods wraps a component that its members straddle.

    `x` and `values` (..., N, d) are members before and after the forecast.
    """
    # A cheap test first, on some sixteen members: those that were within a quarter of a turn are
    # now more than half a turn apart.
    stride = max(1, values.shape[-2] // 16)
    some = values[..., ::stride, :]
    is_torn = some.max(axis=-2) - some.min(axis=-2) > np.pi
    if is_torn.any():
        some = x[..., ::stride, :]
        is_torn &= some.max(axis=-2) - some.min(axis=-2) < 0.5 * np.pi
    if not is_torn.any() or not needs_check(model, "wrapping"):
        return
    # Then all members, from the first: members that were within a quarter of a turn are now near a
    # whole turn apart, or near zero turns, and some of them are one turn away.
    jumps = values - values[..., :1, :]
    is_narrow = np.ptp(x, axis=-2) < 0.5 * np.pi
    turns = np.round(jumps / (2 * np.pi))
    is_near_turn = (np.abs(jumps - 2 * np.pi * turns) < 0.5 * np.pi).all(axis=-2)
    is_torn = (turns != 0).any(axis=-2) & (np.abs(turns) <= 1).all(axis=-2)
    suspects = np.argwhere(is_narrow & is_near_turn & is_torn)
    if not len(suspects):
        return
    # The first ensemble (run, agent) and component that may have been wrapped
    *row, place = suspects[0].tolist()
    # A jump proves nothing by itself. The function wraps the component if it moves x and x + 2π to
    # the same state, up to rounding.
    turned = x.copy()
    turned[..., place] += 2 * np.pi
    change = np.abs(model.step(turned, t, dt) - model.step(x, t, dt))
    # The first member of that ensemble stands for all.
    if (change[tuple(row)][0] > 1e-6).any():
        return
    mark_checked(model, "wrapping")
    period = "2π"
    warnings.warn(
        f"transition wraps component {name_component(model, place)}, and the belief lies on "
        f"both sides of the cut at t = {t + dt:g} s, where its mean is wrong: declare the "
        f"circular component, Model(..., periods={{{place}: {period}}})",
        RuntimeWarning,
        stacklevel=4,
    )


def warn_of_wrapped_truth(model: _Model, mean: Array, truth: Array) -> None:
    """Warn once if estimates run on where the truth wraps, or the other way round.

    Parameters
    ----------
    model : Model
        It declares no periods, but the filter's sensors wrap.
    mean : ndarray, (T, *runs, A, d)
    truth : ndarray, (T, *runs, 1 or A, d)
    """
    if len(mean) < 2:
        return
    # A NaN is no turn: it compares as False.
    with np.errstate(invalid="ignore"):
        error = mean - truth
        jumps = np.diff(error, axis=0)
        # The error jumps by a whole turn, to a tenth of a radian or two, between two times.
        is_turn = np.abs(np.abs(jumps) - 2 * np.pi) < 0.2
        # Errors of other causes look different. Here the error is within half a radian of a whole
        # number of turns at nine times of ten, and at both times of the jump; and it is the truth
        # or the estimate that leaps, by more than half a turn.
        remainder = np.abs(error - 2 * np.pi * np.round(error / (2 * np.pi)))
        is_near = remainder < 0.5
        is_close = is_near[:-1] & is_near[1:] & (is_near.mean(axis=0) >= 0.9)
        # The larger step of the two
        steps = [np.abs(np.diff(values, axis=0)) for values in (mean, truth)]
        is_leap = np.maximum(*steps) > np.pi
    found = np.argwhere(is_turn & is_leap & is_close)
    if not len(found) or not needs_check(model, "truth"):
        return
    # The component of the first such jump
    mark_checked(model, "truth")
    place = int(found[0][-1])
    warnings.warn(
        f"truth and estimates of component {name_component(model, place)} differ by whole "
        "turns: one of them wraps and the other runs on; declare the circular component, "
        f"Model(..., periods={{{place}: 2π}})",
        RuntimeWarning,
        stacklevel=4,
    )
