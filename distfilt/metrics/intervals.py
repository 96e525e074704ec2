"""Intervals around a mean, a median or a share, each with its confidence."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from ..validation import Array, Bounds, PositiveInt, validated

__all__ = ["Interval", "mean_interval", "median_interval", "proportion_interval"]

Values = Annotated[Array, "n"]
Level = Annotated[float, Bounds(at_least=1e-9, below=1)]


@dataclass(frozen=True)
class Interval:
    """An estimate with a confidence interval around it.

    Parameters
    ----------
    estimate : float
        The estimate, inside the interval.
    low, high : float
        The interval's ends, both included: ``0.3 in interval`` asks whether it covers 0.3.
    error : float
        The estimate's standard error, at least 0.

    Examples
    --------
    >>> share = Interval(0.25, 0.15, 0.375, 0.06)
    >>> print(share, 0.1 in share)
    0.25 [0.15, 0.375] False
    """

    estimate: float
    low: float
    high: float
    error: float

    def __contains__(self, value: float) -> bool:
        return bool(self.low <= value <= self.high)

    def __str__(self) -> str:
        return f"{self.estimate:.3g} [{self.low:.3g}, {self.high:.3g}]"


@validated
def mean_interval(values: Values, *, level: Level = 0.95) -> Interval:
    """Student's t interval for the mean of independent values, with the standard error s/√n.

    Parameters
    ----------
    values : array_like, (n,)
        One number a run, at least two.
    level : float
        Confidence, in (0, 1).

    Examples
    --------
    >>> print(mean_interval([1.0, 2.0, 3.0, 4.0]))
    2.5 [0.446, 4.55]
    """
    from scipy.special import stdtrit

    if values.size < 2:
        raise ValueError(f"values must have at least 2 values, got {values.size}")
    middle = float(values.mean())
    error = float(values.std(ddof=1)) / float(np.sqrt(values.size))
    half = float(stdtrit(values.size - 1, 0.5 + level / 2)) * error
    return Interval(middle, middle - half, middle + half, error)


@validated
def median_interval(values: Values, *, level: Level = 0.95) -> Interval:
    """Interval for the median that assumes nothing about the distribution.

    The k-th smallest and the k-th largest value miss the median with probability
    2 P(B < k), B binomial (n, 1/2); k is the largest with which they miss it seldom enough. The
    error is the half width divided by the normal quantile of `level`.

    Parameters
    ----------
    values : array_like, (n,)
        Independent values; enough of them for `level`: 6 for 95%.
    level : float
        Confidence that the interval has at least, in (0, 1).

    Examples
    --------
    >>> print(median_interval([5.0, 1.0, 4.0, 2.0, 9.0, 3.0, 8.0]))
    4 [1, 9]
    """
    from scipy.special import betainc, ndtri

    v = np.sort(values)
    n = values.size
    # P(B <= k - 1) for k = 1, 2, ...: the chance that the k-th smallest lies above the median.
    ranks = np.arange(1, (n + 1) // 2 + 1)
    missed = 2 * betainc(n - ranks + 1, ranks, 0.5)
    k = int((missed <= 1 - level).sum())
    if k == 0:
        raise ValueError(f"values must have more values for level {level:g}, got {n}")
    low = float(v[k - 1])
    high = float(v[n - k])
    error = (high - low) / (2 * float(ndtri(0.5 + level / 2)))
    return Interval(float(np.median(v)), low, high, error)


@validated
def proportion_interval(
    successes: Annotated[int, Bounds(at_least=0)],
    trials: PositiveInt,
    *,
    level: Level = 0.95,
) -> Interval:
    """Clopper-Pearson interval for a probability: it covers with at least `level`, for every n.

    The error is the plug-in one, √(p(1-p)/n), 0 at p = 0 and 1.

    Parameters
    ----------
    successes : int
        How often it happened, 0 to `trials`.
    trials : int
        Independent trials, at least one.
    level : float
        Confidence that the interval has at least, in (0, 1).

    Notes
    -----
    C. J. Clopper and E. S. Pearson, Biometrika 26 (1934) 404-413.

    Examples
    --------
    >>> print(proportion_interval(0, 100))
    0 [0, 0.0362]
    """
    from scipy.special import betaincinv

    k = successes
    n = trials
    tail = (1 - level) / 2
    if k > n:
        raise ValueError(
            f"successes must have at most as many as trials ({n}), got {k}"
        )
    low = 0.0 if k == 0 else float(betaincinv(k, n - k + 1, tail))
    high = 1.0 if k == n else float(betaincinv(k + 1, n - k, 1 - tail))
    share = k / n
    error = float(np.sqrt(share * (1 - share) / n))
    # A level near 0 gives ends that pass each other around the share.
    return Interval(share, min(low, share), max(high, share), error)
