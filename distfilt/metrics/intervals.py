"""Confidence intervals of a mean, a median or a proportion."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from ..validation import ArrayInput, Bounds, PositiveInt, validated

__all__ = ["Interval", "mean_interval", "median_interval", "proportion_interval"]

Values = Annotated[ArrayInput, "n"]
# At a level near 0 both quantiles are near the median, and their difference loses its digits.
Level = Annotated[float, Bounds(at_least=1e-9, below=1)]


@dataclass(frozen=True)
class Interval:
    """An estimate with a confidence interval around it.

    Parameters
    ----------
    estimate : float
        The estimate; it lies in the interval.
    low, high : float
        The interval's ends, both included: ``0.3 in interval`` asks whether it covers 0.3.
    error : float
        The estimate's standard error, at least 0.

    Examples
    --------
    >>> proportion = Interval(0.25, 0.15, 0.375, 0.06)
    >>> print(proportion, 0.1 in proportion)
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
    from scipy import stats

    if values.size < 2:
        raise ValueError(f"values must have at least 2 values, got {values.size}")
    n = values.size
    mean = float(values.mean())
    error = float(values.std(ddof=1)) / float(np.sqrt(n))
    # scipy's `ttest_1samp` gives the same, but warns of equal values.
    half_width = float(stats.t.ppf(0.5 + level / 2, n - 1)) * error
    return Interval(mean, mean - half_width, mean + half_width, error)


@validated
def median_interval(values: Values, *, level: Level = 0.95) -> Interval:
    """Distribution-free interval for the median, between two order statistics.

    The interval from the k-th smallest to the k-th largest value misses the median with probability
    2 P(B < k), B binomial (n, 1/2). The largest k is taken for which that is at most 1 - `level`.
    The error is the half width divided by the normal quantile of `level`.

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
    from scipy import stats

    order_statistics = np.sort(values)
    n = values.size
    # P(B <= k - 1) for k = 1, 2, ...: the probability that the k-th smallest exceeds the median.
    # scipy's `quantile_test` takes a smaller k where 2 P is exactly 1 - level.
    ranks = np.arange(1, (n + 1) // 2 + 1)
    miss_probability = 2 * stats.binom.cdf(ranks - 1, n, 0.5)
    k = int((miss_probability <= 1 - level).sum())
    if k == 0:
        raise ValueError(f"values must have more values for level {level:g}, got {n}")
    low = float(order_statistics[k - 1])
    high = float(order_statistics[n - k])
    quantile = float(stats.norm.ppf(0.5 + level / 2))
    error = (high - low) / (2 * quantile)
    return Interval(float(np.median(values)), low, high, error)


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
        Number of successes, 0 to `trials`.
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
    from scipy import stats

    k = successes
    n = trials
    if k > n:
        raise ValueError(f"successes must be at most trials, {n}, got {k}")
    ends = stats.binomtest(k, n).proportion_ci(level, method="exact")
    proportion = k / n
    # The standard deviation of k / n at the estimated probability.
    error = float(np.sqrt(proportion * (1 - proportion) / n))
    # At a level near 0 the ends may pass each other; the estimate stays inside.
    low = min(float(ends.low), proportion)
    high = max(float(ends.high), proportion)
    return Interval(proportion, low, high, error)
