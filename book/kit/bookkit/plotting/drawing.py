"""What the book's figures draw: ellipses, bands over runs, networks."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from distfilt.checks import Array, array, increasing, nonblank, number
from distfilt.linalg import factor

from .figures import check_axes, colour, line_style

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["band", "ellipse", "graph"]


def ellipse(
    ax: Axes, mean: ArrayLike, covariance: ArrayLike, *, level: float = 0.95, index: int = 0,
    label: str | None = None,
) -> Axes:
    r"""Draw the ellipse that holds a share `level` of a plane Gaussian, and its mean.

    The squared Mahalanobis distance of the ellipse is the chi-square quantile with two degrees of
    freedom, :math:`-2\log(1-\text{level})`.

    Parameters
    ----------
    ax : matplotlib Axes
        Where to draw.
    mean : array_like, (2,)
    covariance : array_like, (2, 2)
        Positive semidefinite; a singular one gives a line.
    level : float
        Probability inside, in (0, 1). One standard deviation is 0.393.
    index, label
        Number of the colour and line style, and what the legend says.

    Examples
    --------
    >>> from bookkit.plotting import axes
    >>> ax = ellipse(axes(xlabel="x", ylabel="y"), [0.0, 0.0], [[4.0, 0.0], [0.0, 1.0]])
    >>> float(ax.lines[0].get_xdata().max().round(2))  # two standard deviations of 2.448
    4.9
    """
    found = check_axes(ax)
    centre = array(mean, "mean", (2,))
    root = factor(array(covariance, "covariance", (2, 2)))
    radius = np.sqrt(-2 * np.log1p(-number(level, "level", above=0, below=1)))
    turn = np.linspace(0, 2 * np.pi, 181)
    x, y = centre[:, None] + radius * root @ np.stack([np.cos(turn), np.sin(turn)])
    text = _legend(label)
    found.plot(x, y, color=colour(index), linestyle=line_style(index), label=text)
    found.plot(*centre, marker="+", color=colour(index), linestyle="none")
    return found


def band(
    ax: Axes, x: ArrayLike, runs: ArrayLike, *, quantiles: tuple[float, float] = (0.25, 0.75),
    index: int = 0, label: str | None = None,
) -> Axes:
    """Draw the median over runs as a line, and a band between two quantiles over runs.

    Parameters
    ----------
    ax : matplotlib Axes
        Where to draw.
    x : array_like, (T,)
        Strictly increasing, usually times.
    runs : array_like, (R, T)
        One curve a run.
    quantiles : (float, float)
        Lower and upper end of the band, in [0, 1], increasing.
    index, label
        Number of the colour and line style, and what the legend says.

    Examples
    --------
    >>> from bookkit.plotting import axes
    >>> errors = [[1.0, 5.0], [2.0, 4.0], [9.0, 3.0]]
    >>> ax = band(axes(xlabel="time", ylabel="error"), [0.0, 1.0], errors)
    >>> ax.lines[0].get_ydata()
    array([2., 4.])
    """
    found = check_axes(ax)
    t = increasing(x, "x")
    curves = array(runs, "runs", ("R", t.size))
    if curves.shape[0] < 1:
        raise ValueError(f"runs: needs at least one run, got shape {curves.shape}")
    ends = increasing(array(quantiles, "quantiles", (2,)), "quantiles")
    number(ends[0], "quantiles", at_least=0)
    number(ends[1], "quantiles", at_most=1)
    low, middle, high = np.quantile(curves, [ends[0], 0.5, ends[1]], axis=0)
    shade, text = colour(index), _legend(label)
    found.fill_between(t, low, high, color=shade, alpha=0.2, linewidth=0)
    found.plot(t, middle, color=shade, linestyle=line_style(index), label=text)
    return found


def _legend(label: str | None) -> str | None:
    return None if label is None else nonblank(label, "label")


def graph(
    ax: Axes, adjacency: ArrayLike, *, labels: tuple[str, ...] | list[str] | None = None,
    positions: ArrayLike | None = None, known: ArrayLike | None = None,
    notes: tuple[str, ...] | list[str] | None = None,
) -> Axes:
    """Draw agents as discs, the links between them as lines, and who knows how much.

    Parameters
    ----------
    ax : matplotlib Axes
        Where to draw; its frame is hidden and both axes get one scale.
    adjacency : array_like, (A, A)
        Nonzero where two agents talk; symmetric. The diagonal is not drawn.
    labels : sequence of str, optional
        Names of the agents; 1 to A by default.
    positions : array_like, (A, 2), optional
        On a circle by default, the first agent on top, then clockwise.
    known : array_like, (A,), optional
        How much each agent knows, from 0, an empty disc, to 1, a full one.
    notes : sequence of str, optional
        A text below each agent, such as what it measures; may be empty.

    Examples
    --------
    >>> from bookkit.plotting import axes
    >>> ax = graph(axes(xlabel="x", ylabel="y"), [[0, 1], [1, 0]], labels=["A", "B"])
    >>> [text.get_text() for text in ax.texts]
    ['A', 'B']
    """
    found = check_axes(ax)
    links = array(adjacency, "adjacency", ("A", "A"))
    n = links.shape[0]
    if n == 0 or links.shape != (n, n) or (links != links.T).any():
        raise ValueError(f"adjacency: needs a symmetric square matrix, got shape {links.shape}")
    given = [str(k + 1) for k in range(n)] if labels is None else labels
    names = [nonblank(label, "labels") for label in _listed(given, "labels")]
    if len(names) != n:
        raise ValueError(f"labels: needs one for each of {n} agents, got {len(names)}")
    place = _circle(n) if positions is None else array(positions, "positions", (n, 2))
    share = np.zeros(n) if known is None else array(known, "known", (n,))
    if share.min() < 0 or share.max() > 1:
        raise ValueError(f"known: needs shares from 0 to 1, got {share.min():g} to {share.max():g}")
    below = [""] * n if notes is None else _listed(notes, "notes")
    if len(below) != n or not all(isinstance(note, str) for note in below):
        raise ValueError(f"notes: needs a text for each of {n} agents, got {notes!r}")
    for i, j in zip(*np.nonzero(np.triu(links, 1)), strict=True):
        found.plot(*place[[i, j]].T, color="0.55", linewidth=1.2, zorder=1)
    _discs(found, place, share, names, below)
    found.set_aspect("equal")
    found.margins(0.2)
    found.set_axis_off()
    return found


def _listed(value: Any, name: str) -> list[Any]:
    """The entries of a list or tuple; one text is no list of its letters."""
    if isinstance(value, str) or not isinstance(value, Sequence):
        raise ValueError(f"{name}: needs a list of texts, got {type(value).__name__}")
    return list(value)


def _discs(ax: Axes, place: Array, share: Array, names: list[str], notes: list[str]) -> None:
    """One disc an agent, filled as far as it knows, with its name in it and its note below."""
    from matplotlib.colors import to_rgba

    # White shows through a disc that is not full, and hides the links behind it.
    faces = [1 - k + k * np.array(to_rgba(colour(5))) for k in share]
    x, y = place.T
    ax.scatter(x, y, s=340, c=faces, edgecolor=colour(0), linewidth=1.4, zorder=2)
    for name, note, (a, b) in zip(names, notes, place.tolist(), strict=True):
        ax.text(a, b, name, ha="center", va="center", zorder=3)
        if note:
            ax.annotate(
                note, (a, b), (0, -13), textcoords="offset points", ha="center", va="top",
                fontsize="small", zorder=3,
            )  # fmt: skip


def _circle(n: int) -> Array:
    turn = 2 * np.pi * np.arange(n) / n
    return np.stack([np.sin(turn), np.cos(turn)], axis=-1) * (n > 1)
