"""Ratios of errors with intervals over seeds, and their picture, for the pages on orbits."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes

from bookkit import plotting
from distfilt.metrics import Interval

# Resampled sets of seeds for one interval
RESAMPLES = 4000


def resample_ratios(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return roots of ratios of sums over resampled seeds; `a` and `b` are paired, (n,).

    The resampled seeds are the same in every call with as many seeds, so that two ratios
    of such draws can be compared.

    Examples
    --------
    >>> resample_ratios(np.array([4.0, 4.0]), np.array([1.0, 1.0])).mean()
    np.float64(2.0)
    """
    picks = np.random.default_rng(0).integers(a.size, size=(RESAMPLES, a.size))
    roots: np.ndarray = np.sqrt(a[picks].sum(axis=1) / b[picks].sum(axis=1))
    return roots


def rmse_ratio(a: np.ndarray, b: np.ndarray) -> Interval:
    """Return the ratio of two RMSE with its 95% bootstrap interval over paired seeds.

    Examples
    --------
    >>> print(rmse_ratio(np.array([4.0, 4.0]), np.array([1.0, 1.0])))
    2 [2, 2]
    """
    draws = resample_ratios(a, b)
    low, high = np.quantile(draws, [0.025, 0.975])
    middle = float(np.sqrt(a.sum() / b.sum()))
    return Interval(middle, float(low), float(high), float(draws.std()))


def format_interval(v: Interval, digits: int = 3) -> str:
    """Return an interval as a text.

    Examples
    --------
    >>> format_interval(Interval(0.5, 0.25, 0.75, 0.1), 2)
    '0.50 [0.25, 0.75]'
    """
    return f"{v.estimate:.{digits}f} [{v.low:.{digits}f}, {v.high:.{digits}f}]"


def draw_intervals(
    ax: Axes,
    rows: Mapping[str, Interval],
    index: int = 0,
    shift: float = 0.0,
    label: str | None = None,
) -> None:
    """Draw estimates with their intervals, a line each from the top."""
    values = list(rows.values())
    middle = np.array([v.estimate for v in values])
    low_ends = [v.estimate - v.low for v in values]
    high_ends = [v.high - v.estimate for v in values]
    places = -np.arange(len(values))
    ax.errorbar(
        middle,
        places - shift,
        xerr=np.array([low_ends, high_ends]),
        fmt="os^D"[index % 4],
        ms=4,
        lw=1,
        capsize=2,
        color=plotting.colour(index),
        label=label,
    )
    ax.set_yticks(places, list(rows))
