"""Times of a clock where seconds since the start are meant."""

from __future__ import annotations

import warnings
from datetime import UTC, datetime

import numpy as np

from .checks import Array, format_number

__all__ = ["warn_of_clock", "warn_of_unit"]

_LONG = 1e8
"""A first step of more than three years, in s."""

_LONG_STEPS = 1e5
"""A first step that is longer than the others by more than this factor."""


_LONGEST = 1e11
"""Times beyond three thousand years, in s, are in another unit."""


def warn_of_unit(t: float, name: str) -> None:
    """Warn if a time is so large that it must be in another unit than seconds.

    Parameters
    ----------
    t : float
        The time.
    name : str
        The argument's name.

    Examples
    --------
    >>> with warnings.catch_warnings(action="error"):
    ...     warn_of_unit(1.7e18, "t")
    Traceback (most recent call last):
    RuntimeWarning: t must be in seconds, got 1.7e+18, which a Unix time in nanoseconds would be
    >>> warn_of_unit(1.7e9, "t")
    """
    size = abs(t)
    if size < _LONGEST:
        return
    # Unix times of our years are about 1.7e9 s, which is 1.7e12 ms, 1.7e15 µs and 1.7e18 ns.
    unit = "nanoseconds"
    if size < 1e14:
        unit = "milliseconds"
    elif size < 1e17:
        unit = "microseconds"
    warnings.warn(
        f"{name} must be in seconds, got {format_number(t)}, which a Unix time in {unit} would be",
        RuntimeWarning,
        stacklevel=4,
    )


def warn_of_clock(start: float, times: Array, name: str) -> None:
    """Warn if a start at 0 is followed by times of a clock, before a step of that length is made.

    Parameters
    ----------
    start : float
        The time of the prior.
    times : ndarray, (T,)
        The times that follow.
    name : str
        The argument's name.

    Examples
    --------
    >>> with warnings.catch_warnings(action="error"):
    ...     warn_of_clock(0.0, np.array([1.7e9]), "times")
    Traceback (most recent call last):
    RuntimeWarning: times must count from the time 0 of the start, got 1700000000 ...
    >>> warn_of_clock(1.7e9, np.array([1.7e9 + 1]), "times")
    """
    if start != 0 or not times.size:
        return
    first = float(times[0])
    is_long = first > _LONG
    if times.size > 2 and not is_long:
        # Seconds of a week, or of a day, are short, but not beside the other steps.
        is_long = first > _LONG_STEPS * float(np.median(np.diff(times)))
    if not is_long:
        return
    date = ""
    # Up to the year 2286 it may be a Unix time, in s; a larger number is in another unit.
    if _LONG < first < 1e10:
        day = datetime.fromtimestamp(first, UTC).date()
        date = f" ({day} if it is a Unix time)"
    warnings.warn(
        f"{name} must count from the time 0 of the start, got {format_number(first)} first"
        f"{date}: the first step would last so long that the prior is lost; give the start "
        "its time, t=...",
        RuntimeWarning,
        stacklevel=4,
    )
