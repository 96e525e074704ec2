"""Short texts that describe plotted data, so that comparing outputs detects a changed curve."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import groupby
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = ["digest", "of_axes"]

Array = NDArray[np.float64]

# k times the golden ratio, modulo 1, is spread evenly and never repeats.
_GOLDEN = (np.sqrt(5) - 1) / 2
_OFFSET = 0.03183098861837907
"""Moves the ties of rounding away from short decimals, which are frequent in plots (1/10π)."""


def _decade(value: float) -> int:
    """Return the power of ten of a positive number; its steps lie just beside 1, 10, 100."""
    return int(np.floor(np.log10(value * (1 + _OFFSET))))


def _round(value: float, scale: float, *, max_decades: int) -> str:
    """Return four digits of `value`, but none `max_decades` decades below the first of `scale`."""
    if scale == 0 or abs(value) < 1e-9 * (1 - _OFFSET) * scale:
        return "0"
    # Four digits of the value, or fewer if they would be finer than the scale allows.
    unit = 10.0 ** max(_decade(abs(value)) - 3, _decade(scale) - max_decades)
    steps = np.floor(value / unit + 0.5 + _OFFSET)
    # Adding 0.0 turns -0.0 into 0.0, which prints without a sign.
    return f"{steps * unit + 0.0:.4g}"


def _projection(values: Array) -> float:
    """Return the inner product with a fixed unit vector.

    Its signs alternate, so that a large mean does not hide a change. Its sizes lie between 1 and 2
    and differ from entry to entry, so that an exchange of two entries changes the result.
    """
    k = np.arange(values.size)
    signs = 1 - 2.0 * (k % 2)
    vector = signs * (1 + (k * _GOLDEN) % 1)
    return float(vector @ values / np.sqrt((vector**2).sum()))


def _summary(values: Array) -> str:
    """Describe an array: size, range, mean, projection, and how many entries are not finite."""
    flat = values.ravel()
    # One NaN would make every number of the summary NaN.
    is_finite = np.isfinite(flat)
    n_nan = int(np.isnan(flat).sum())
    n_infinite = int(np.isinf(flat).sum())
    missing = f", {n_nan} NaN" if n_nan else ""
    if n_infinite:
        missing += f", {n_infinite} infinite"
    if not is_finite.any():
        return f"{flat.size} values{missing}"
    finite = flat[is_finite]
    scale = float(np.abs(finite).max())
    # The digits of the range are relative to its ends: no limit by the scale.
    low = _round(float(finite.min()), scale, max_decades=99)
    high = _round(float(finite.max()), scale, max_decades=99)
    # Terms cancel in mean and projection: their rounding errors scale with the largest entry.
    mean = _round(float(finite.mean()), scale, max_decades=4)
    along = _projection(np.where(is_finite, flat, 0.0))
    projection = _round(along, scale, max_decades=4)
    text = f"{flat.size} values, {low}..{high}, mean {mean}, projection {projection}"
    return text + missing


def digest(**arrays: ArrayLike) -> str:
    """Describe plotted data in a line an array, so that a comparison of texts detects changes.

    A line has the number of values, their range, their mean and their inner product with a fixed
    unit vector, to four digits. Digits of the range are relative to the number itself, the others
    to the largest value; numbers below 1e-9 of it print as 0.

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
    lines = [f"{name}: {_summary(_plain(value))}" for name, value in arrays.items()]
    return "\n".join(lines)


def of_axes(drawn: Any) -> str:
    """Describe a figure by the data of its artists, in the form of :func:`digest`.

    The text describes the drawn figure: it changes if a curve is scaled, missing or drawn in
    another panel.

    Parameters
    ----------
    drawn : matplotlib.figure.Figure, matplotlib.axes.Axes or an array or sequence of Axes
        The axes to describe. Those of a figure come in order, each followed by its insets.

    Returns
    -------
    str
        One line an axes with the numbers of its artists, then one line for each coordinate of each
        visible line, patch, collection (points, filled areas, contours, arrows) and image, in the
        order in which they were added. A coordinate that the artist before it has too is left out.

    Notes
    -----
    Positions are in the units of the data. Colours and texts are ignored, but the values of artists
    that are coloured by value are described.

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
    texts: list[str] = []
    for k, axes in enumerate(_panels(drawn), start=1):
        # The head counts the artists of each kind: a missing curve changes it.
        entries = list(_entries(axes))
        counts: dict[str, int] = {}
        for kind, n, _ in entries:
            counts[kind] = counts.get(kind, 0) + n
        counted = ", ".join(_plural(kind, n) for kind, n in counts.items())
        texts.append(f"axes {k}: {counted or 'empty'}")
        texts += _describe_entries(entries)
    if all(": empty" in text for text in texts):
        return "an empty figure"
    return "\n".join(texts)


def _plural(kind: str, n: int) -> str:
    """Return ``1 line``, ``2 lines``, ``2 patches``."""
    ending = "es" if kind == "patch" else "s"
    return f"{n} {kind}{ending if n > 1 else ''}"


def _describe_entries(entries: list[_Entry]) -> list[str]:
    """Describe artists in order, a line a coordinate; repeated coordinates are left out."""
    lines: list[str] = []
    counts: dict[str, int] = {}
    previous: dict[str, str] = {}
    for kind, n, coordinates in entries:
        first = counts.get(kind, 0) + 1
        counts[kind] = first + n - 1
        name = f"{kind} {first}" if n <= 1 else f"{kind} {first}-{counts[kind]}"
        summaries = {axis: _summary(values) for axis, values in coordinates.items()}
        for axis, text in summaries.items():
            # Curves of one panel mostly share their x.
            if previous.get(axis) != text:
                lines.append(f"{name} {axis}: {text}")
        previous = summaries
    return lines


_Entry = tuple[str, int, dict[str, Array]]
"""Kind of artist, how many of them, and their coordinates by name."""


def _panels(drawn: Any) -> Iterator[Any]:
    """Yield all axes, each followed by its insets; matplotlib need not be imported for it."""
    # A figure has get_axes, axes have transData; an array or sequence has neither.
    if hasattr(drawn, "get_axes"):
        drawn = drawn.get_axes()
    elif hasattr(drawn, "transData"):
        drawn = [drawn]
    for axes in np.ravel(np.asarray(drawn, dtype=object)):
        yield axes
        yield from _panels(axes.child_axes)


def _entries(axes: Any) -> Iterator[_Entry]:
    """Yield the visible artists of an axes; a row of patches, such as bars, is one."""
    # Values as given to matplotlib, before any scaling of the axes
    for line in _visible(axes.lines):
        yield "line", 1, _by_axis(*np.transpose(line.get_xydata()))
    # Bars of a histogram are many patches of one kind in a row.
    for _, group in groupby(_visible(axes.patches), key=type):
        patches = list(group)
        # Outlines in the units of the data: the path of the unit shape, transformed.
        outlines = [
            p.get_patch_transform().transform(p.get_path().vertices) for p in patches
        ]
        yield "patch", len(patches), _by_axis(*np.concatenate(outlines).T)
    for collection in _visible(axes.collections):
        yield "collection", 1, _collection(collection, axes.transData)
    for image in _visible(axes.images):
        values = {
            "value": _plain(image.get_array()),
            "extent": _plain(image.get_extent()),
        }
        yield "image", 1, values


def _visible(artists: Iterable[Any]) -> list[Any]:
    """Return the artists that are drawn."""
    return [artist for artist in artists if artist.get_visible()]


def _collection(artist: Any, data: Any) -> dict[str, Array]:
    """Return the coordinates and values of a collection.

    The positions are the points' offsets. If all is drawn at one place, they are the outlines.
    """
    # Points of a scatter plot, or the places of arrows
    offsets = np.ma.filled(artist.get_offsets(), np.nan)
    if len(offsets) > 1 or artist.get_offset_transform() == data:
        positions = _by_axis(*offsets.T)
    else:
        outlines = [path.vertices for path in artist.get_paths()]
        vertices = np.concatenate([np.empty((0, 2)), *outlines])
        positions = _by_axis(*vertices.T)
    sizes: Any = artist.get_sizes() if hasattr(artist, "get_sizes") else ()
    # Values of the colours, components of arrows, and sizes of points that differ
    values = {
        "value": artist.get_array(),
        "u": getattr(artist, "U", None),
        "v": getattr(artist, "V", None),
        "size": sizes if len(sizes) > 1 else None,
    }
    for name, entry in values.items():
        if entry is not None:
            positions[name] = _plain(entry)
    return positions


def _by_axis(*coordinates: Any) -> dict[str, Array]:
    """Return coordinates under the names x and y."""
    pairs = zip("xy", coordinates, strict=True)
    return {name: _plain(values) for name, values in pairs}


def _plain(values: Any) -> Array:
    """Return an array of floats with NaN in place of masked entries."""
    return np.ma.filled(np.ma.asarray(values, dtype=np.float64), np.nan)
