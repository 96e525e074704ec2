"""A short description of plotted data, by which a test of stored outputs sees a changed curve."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import groupby
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = ["digest", "of_axes"]

Array = NDArray[np.float64]

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
    nans = int(np.isnan(flat).sum())
    infinities = int(np.isinf(flat).sum())
    missing = (f", {nans} NaN" if nans else "") + (
        f", {infinities} infinite" if infinities else ""
    )
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
    low, high = (
        _rounded(float(v), scale, smallest=99) for v in (finite.min(), finite.max())
    )
    mean, along = (
        _rounded(v, scale, smallest=4) for v in (float(finite.mean()), projection)
    )
    return (
        f"{flat.size} values, {low}..{high}, mean {mean}, projection {along}{missing}"
    )


def digest(**arrays: ArrayLike) -> str:
    """Describe plotted data, a line an array: who compares stored outputs sees a changed curve.

    A picture is not compared, this text is: the number of values, their range, their mean and
    their inner product with one fixed unit vector, to four digits. Range digits are relative to
    the number itself, the others to the largest value; what is below 1e-9 of it prints as 0.

    Parameters
    ----------
    **arrays : array_like
        The plotted arrays by name, of any shape. NaN and infinity are allowed and counted.

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
    return "\n".join(
        f"{name}: {_summary(_plain(value))}" for name, value in arrays.items()
    )


def of_axes(drawn: Any) -> str:
    """Describe what a figure shows, read from its artists, in the form of :func:`digest`.

    What is described is what was drawn and not what should have been: a curve that is scaled, left
    out or drawn in another panel changes the text.

    Parameters
    ----------
    drawn : matplotlib.figure.Figure, matplotlib.axes.Axes or an array or sequence of Axes
        What to read. Of a figure, all its axes in order; insets follow their axes.

    Returns
    -------
    str
        One line an axes with the numbers of its artists, then one line for each coordinate of each
        visible line, patch, collection (points, filled areas, contours, arrows) and image, in the
        order in which they were added. A coordinate that the artist before it has too is left out.

    Notes
    -----
    Positions are in the units of the data, colours and texts are not read; of what is coloured by
    value, the values are.

    Examples
    --------
    >>> from matplotlib.figure import Figure
    >>> axes = Figure().subplots()
    >>> curves = axes.plot([0.0, 1.0, 2.0], [[4.0, 1.0], [2.0, 1.5], [3.0, 2.0]])
    >>> print(of_axes(axes))
    axes 1: 2 lines
    line 1 x: 3 values, 0..2, mean 1, projection 0.3765
    line 1 y: 3 values, 2..4, mean 3, projection 1.971
    line 2 y: 3 values, 1..2, mean 1.5, projection 0.4607
    """
    out: list[str] = []
    for k, axes in enumerate(_panels(drawn), start=1):
        entries = list(_entries(axes))
        counts = {kind: 0 for kind, _, _ in entries}
        lines: list[str] = []
        before: dict[str, str] = {}
        for kind, many, coordinates in entries:
            first = counts[kind] + 1
            counts[kind] = counts[kind] + many
            name = f"{kind} {first}" + (f"-{counts[kind]}" if many > 1 else "")
            now = {axis: _summary(values) for axis, values in coordinates.items()}
            lines += [
                f"{name} {axis}: {t}"
                for axis, t in now.items()
                if before.get(axis) != t
            ]
            before = now
        ends = {
            kind: ("es" if kind == "patch" else "s") * (n > 1)
            for kind, n in counts.items()
        }
        told = ", ".join(f"{n} {kind}{ends[kind]}" for kind, n in counts.items())
        out += [f"axes {k}: {told or 'empty'}", *lines]
    return (
        "\n".join(out)
        if any(": empty" not in line for line in out)
        else "an empty figure"
    )


_Entry = tuple[str, int, dict[str, Array]]
"""Kind of artist, how many of them, and their coordinates by name."""


def _panels(drawn: Any) -> Iterator[Any]:
    """All axes, each followed by its insets. matplotlib is known by what its objects can do."""
    if hasattr(drawn, "get_axes"):
        drawn = drawn.get_axes()
    elif hasattr(drawn, "transData"):
        drawn = [drawn]
    for axes in np.ravel(np.asarray(drawn, dtype=object)):
        yield axes
        yield from _panels(axes.child_axes)


def _entries(axes: Any) -> Iterator[_Entry]:
    """What is visible in one axes; neighbours of one kind of patch, such as bars, are one entry."""
    for line in _visible(axes.lines):
        yield "line", 1, _named(*np.transpose(line.get_xydata()))
    for _, group in groupby(_visible(axes.patches), key=type):
        patches = list(group)
        outlines = [
            p.get_patch_transform().transform(p.get_path().vertices) for p in patches
        ]
        yield "patch", len(patches), _named(*np.concatenate(outlines).T)
    for collection in _visible(axes.collections):
        yield "collection", 1, _collection(collection, axes.transData)
    for image in _visible(axes.images):
        values = {
            "value": _plain(image.get_array()),
            "extent": _plain(image.get_extent()),
        }
        yield "image", 1, values


def _visible(artists: Iterable[Any]) -> list[Any]:
    return [artist for artist in artists if artist.get_visible()]


def _collection(artist: Any, data: Any) -> dict[str, Array]:
    """Where its points are or, where all is drawn at one place, what its outlines are."""
    offsets = np.ma.filled(artist.get_offsets(), np.nan)
    if len(offsets) > 1 or artist.get_offset_transform() == data:
        found = _named(*offsets.T)
    else:
        outlines = [path.vertices for path in artist.get_paths()]
        found = _named(*np.concatenate([np.empty((0, 2)), *outlines]).T)
    sizes: Any = artist.get_sizes() if hasattr(artist, "get_sizes") else ()
    more = {"value": artist.get_array(), "u": getattr(artist, "U", None)}
    more |= {"v": getattr(artist, "V", None), "size": sizes if len(sizes) > 1 else None}
    return found | {
        name: _plain(values) for name, values in more.items() if values is not None
    }


def _named(*coordinates: Any) -> dict[str, Array]:
    return {
        name: _plain(values) for name, values in zip("xy", coordinates, strict=True)
    }


def _plain(values: Any) -> Array:
    """Numbers with NaN where they are masked."""
    return np.ma.filled(np.ma.asarray(values, dtype=np.float64), np.nan)
