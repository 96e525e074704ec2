"""A short description of plotted data, by which a test of stored outputs sees a changed curve."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from .checks import Array, array

__all__ = ["digest"]

_GOLDEN = (np.sqrt(5) - 1) / 2
_OFFSET = 0.03183098861837907
"""Moves the ties of a rounding away from short decimals, which plotted data often are (1/10π)."""


def _decade(value: float) -> int:
    """Power of ten of a positive number; the edge lies beside 1, 10, 100, not on them."""
    return int(np.floor(np.log10(value * (1 + _OFFSET))))


def _rounded(value: float, scale: float, *, smallest: int) -> str:
    """Four digits of `value`, but no digit `smallest` decades or more below that of `scale`."""
    if scale == 0 or abs(value) < 1e-9 * (1 - _OFFSET) * scale:
        return "0"
    unit = 10.0 ** max(_decade(abs(value)) - 3, _decade(scale) - smallest)
    steps = np.floor(value / unit + 0.5 + _OFFSET)
    return f"{steps * unit + 0.0:.4g}"


def _summary(values: Array) -> str:
    flat = values.ravel()
    good = np.isfinite(flat)
    nans, infinities = int(np.isnan(flat).sum()), int(np.isinf(flat).sum())
    missing = (f", {nans} NaN" if nans else "") + (f", {infinities} infinite" if infinities else "")
    if not good.any():
        return f"{flat.size} values{missing}"
    kept = np.where(good, flat, 0.0)
    # Signs alternate, so that a large mean does not drown a change; sizes differ from entry to
    # entry, between 1 and 2, so that an exchange of two entries shows and none is overlooked.
    k = np.arange(flat.size)
    weights = (1 - 2.0 * (k % 2)) * (1 + (k * _GOLDEN) % 1)
    projection = float(weights @ kept / np.sqrt((weights**2).sum()))
    finite = flat[good]
    scale = float(np.abs(finite).max())
    # Mean and projection cancel: their noise is that of the largest entry, not their own.
    low, high = (_rounded(float(v), scale, smallest=99) for v in (finite.min(), finite.max()))
    mean, along = (_rounded(v, scale, smallest=4) for v in (float(finite.mean()), projection))
    return f"{flat.size} values, {low}..{high}, mean {mean}, projection {along}{missing}"


def digest(**arrays: ArrayLike) -> str:
    """Describe plotted data in a line each, so that a test of stored outputs sees a changed curve.

    A picture is not compared, this text is: the number of values, their range, their mean and
    their inner product with one fixed unit vector, to four digits. Range digits are relative to
    the number itself, the others to the largest value; what is below 1e-9 of it prints as 0.

    Parameters
    ----------
    **arrays : array_like
        The plotted arrays by name, of any shape. NaN and infinity are allowed and counted.

    Returns
    -------
    str
        One line an array, in the order given.

    Notes
    -----
    One entry out of n that moves by δ moves the projection by at least δ/√(4n), so it shows when δ
    is above √(4n) times the unit of the projection's last digit. A relative change of 1e-9, more
    than another processor makes, moves a printed digit only if the number lies that close to a
    tie of the rounding; no short decimal lies there.

    Examples
    --------
    >>> print(digest(time=[0.0, 0.1, 0.2], error=[4.0, 2.0, np.nan]))
    time: 3 values, 0..0.2, mean 0.1, projection 0.03765
    error: 3 values, 2..4, mean 3, projection 0.3368, 1 NaN
    """
    if not arrays:
        raise ValueError("arrays: needs at least one named array, got none")
    return "\n".join(
        f"{name}: {_summary(array(value, name, finite=False))}" for name, value in arrays.items()
    )
