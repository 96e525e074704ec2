"""Figures of the book: functions from arrays to matplotlib axes, and sliders without a kernel.

Curves differ in colour and in line style, so that a figure can be read in grey, and by readers who
do not see all colours.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import Any

import matplotlib
import numpy as np
from cycler import cycler
from matplotlib.axes import Axes
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from numpy.typing import ArrayLike

from distfilt.linalg import factor

from .checks import use_soft_assert
from .digests import digest, of_axes
from .sliders import Slider, slider

__all__ = [
    "LINE_STYLES",
    "PALETTE",
    "SIZE",
    "Slider",
    "axes",
    "band",
    "colour",
    "digest",
    "ellipse",
    "graph",
    "line_style",
    "slider",
    "use_style",
]

# Okabe and Ito: distinct for every kind of colour vision.
PALETTE = (
    "#0072B2",  # blue
    "#D55E00",  # vermilion
    "#009E73",  # bluish green
    "#CC79A7",  # reddish purple
    "#E69F00",  # orange
    "#56B4E9",  # sky blue
    "#000000",  # black
    "#F0E442",  # yellow, last: faint on white
)
"""Colours of M. Okabe and K. Ito (2008), distinct under the common kinds of colour blindness."""

LINE_STYLES: tuple[Any, ...] = ("-", "--", "-.", ":", (0, (5, 1, 1, 1, 1, 1)))
"""Five styles beside eight colours: 40 curves before a pair repeats."""

SIZE = (6.0, 3.4)
"""Width and height of a figure on a page of the book, in inches."""


def colour(index: int) -> str:
    """Return the palette's colour number `index`, counted from 0; after the last it starts again.

    >>> colour(0), colour(8)
    ('#0072B2', '#0072B2')
    """
    return PALETTE[index % len(PALETTE)]


def line_style(index: int) -> Any:
    """Return the line style that goes with colour number `index`.

    >>> line_style(0), line_style(1)
    ('-', '--')
    """
    return LINE_STYLES[index % len(LINE_STYLES)]


def use_style() -> None:
    """Set matplotlib's defaults for a chapter; call it once, before the first figure.

    Page size, resolution and fonts are fixed, so that drawing a figure twice gives the same file.
    In a notebook the text form of a figure, which is stored beside its picture, becomes the digest
    of its axes (`bookkit.digests.of_axes`): a comparison of outputs detects a changed curve.
    An assertion that fails after a reader's edit prints a message, and the notebook runs on; in the
    tests it stops (`bookkit.checks`).

    >>> with matplotlib.rc_context():  # so that this example leaves no trace
    ...     use_style()
    ...     matplotlib.rcParams["figure.dpi"]
    110.0
    """
    matplotlib.rcParams.update(
        {
            "figure.figsize": SIZE,
            "figure.dpi": 110,
            "figure.constrained_layout.use": True,
            "savefig.dpi": 110,
            "font.family": "DejaVu Sans",  # comes with matplotlib, the same on every machine
            "font.size": 9.0,
            "axes.titlesize": 9.0,
            "axes.spines.top": False,
            "axes.spines.right": False,
            "axes.prop_cycle": cycler(color=PALETTE),
            "lines.linewidth": 1.4,
            "legend.frameon": False,
        }
    )
    # Only a notebook has text forms of figures.
    if "IPython" in sys.modules:
        _print_digests()


def _print_digests() -> None:
    """In IPython, print a figure as its digest."""
    from IPython import get_ipython
    from matplotlib import get_backend, pyplot

    shell = get_ipython()
    if shell is not None:
        use_soft_assert(shell)
        # The notebook's backend resets printers when it starts with the first figure: start it now.
        pyplot.switch_backend(get_backend())
        # Twice the pixels at the same size; compressed fast, since storing compresses again.
        shell.run_line_magic("config", "InlineBackend.figure_format = 'retina'")
        options = {"bbox_inches": "tight", "pil_kwargs": {"compress_level": 1}}
        shell.run_line_magic("config", f"InlineBackend.print_figure_kwargs = {options}")
        text = shell.display_formatter.formatters["text/plain"]
        text.for_type(
            Figure, lambda figure, printer, cycle: printer.text(of_axes(figure))
        )
        # The backend shows a cell's figures; pyplot's own hook would draw each of them once more.
        pyplot.uninstall_repl_displayhook()


def axes(
    *,
    xlabel: str,
    ylabel: str,
    xunit: str | None = None,
    yunit: str | None = None,
    title: str = "",
    ax: Axes | None = None,
    xscale: str = "linear",
    yscale: str = "linear",
    size: tuple[float, float] = SIZE,
) -> Axes:
    """Return labelled axes, in a new figure of the book's size unless `ax` is given.

    Parameters
    ----------
    xlabel, ylabel : str
        Labels of the axes; required.
    xunit, yunit : str, optional
        Units, put behind the labels in parentheses.
    title : str, optional
        Needed only if the caption does not have it.
    ax : matplotlib Axes, optional
        Axes to label.
    xscale, yscale : {"linear", "log"}
        Scales.
    size : (float, float)
        Width and height of a new figure, in inches.

    Examples
    --------
    >>> axes(xlabel="time", xunit="s", ylabel="error", yunit="m").get_xlabel()
    'time (s)'
    """
    if ax is None:
        from matplotlib import pyplot

        _, ax = pyplot.subplots(figsize=size)
    x = xlabel if xunit is None else f"{xlabel} ({xunit})"
    y = ylabel if yunit is None else f"{ylabel} ({yunit})"
    ax.set(xlabel=x, ylabel=y, xscale=xscale, yscale=yscale)
    if title:
        ax.set_title(title)
    return ax


def ellipse(
    ax: Axes,
    mean: ArrayLike,
    covariance: ArrayLike,
    *,
    level: float = 0.95,
    index: int = 0,
    label: str | None = None,
) -> Axes:
    r"""Draw the mean of a plane Gaussian and the ellipse that has probability `level`.

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
        Number of the colour and line style, and text of the legend.

    Examples
    --------
    >>> ax = ellipse(axes(xlabel="x", ylabel="y"), [0.0, 0.0], [[4.0, 0.0], [0.0, 1.0]])
    >>> float(
    ...     ax.lines[0].get_xdata().max().round(2)
    ... )  # two standard deviations of 2.448
    4.9
    """
    # x = m + r L (cos a, sin a) with P = L Lᵀ and r² the chi-square quantile
    centre = np.asarray(mean, dtype=float)
    root = factor(np.asarray(covariance, dtype=float))
    radius = np.sqrt(-2 * np.log1p(-level))
    angles = np.linspace(0, 2 * np.pi, 181)
    # 181 points: two degrees apart, and the last is the first.
    x, y = centre[:, None] + radius * root @ np.stack([np.cos(angles), np.sin(angles)])
    ax.plot(x, y, color=colour(index), linestyle=line_style(index), label=label)
    ax.plot(*centre, marker="+", color=colour(index), linestyle="none")
    return ax


def band(
    ax: Axes,
    x: ArrayLike,
    runs: ArrayLike,
    *,
    quantiles: tuple[float, float] = (0.25, 0.75),
    index: int = 0,
    label: str | None = None,
) -> Axes:
    """Draw the median over runs as a line, and a band between two quantiles over runs.

    Parameters
    ----------
    ax : matplotlib Axes
        Where to draw.
    x : array_like, (T,)
        Usually times.
    runs : array_like, (R, T)
        One curve a run.
    quantiles : (float, float)
        Lower and upper end of the band.
    index, label
        Number of the colour and line style, and text of the legend.

    Examples
    --------
    >>> errors = [[1.0, 5.0], [2.0, 4.0], [9.0, 3.0]]
    >>> band(axes(xlabel="time", ylabel="error"), [0.0, 1.0], errors).lines[
    ...     0
    ... ].get_ydata()
    array([2., 4.])
    """
    # The median and the band are of each time, not of a whole run.
    low, middle, high = np.quantile(
        np.asarray(runs), [quantiles[0], 0.5, quantiles[1]], axis=0
    )
    ax.fill_between(x, low, high, color=colour(index), alpha=0.2, linewidth=0)
    ax.plot(x, middle, color=colour(index), linestyle=line_style(index), label=label)
    return ax


def graph(
    ax: Axes,
    adjacency: ArrayLike,
    *,
    labels: Sequence[str] | None = None,
    positions: ArrayLike | None = None,
    known: ArrayLike | None = None,
    notes: Sequence[str] | None = None,
) -> Axes:
    """Draw agents as discs and links as lines.

    Parameters
    ----------
    ax : matplotlib Axes
        Where to draw; its frame is hidden and both axes get one scale.
    adjacency : array_like, (A, A)
        Nonzero for a link between two agents; symmetric. The diagonal is not drawn.
    labels : sequence of str, optional
        Names of the agents; 1 to A by default.
    positions : array_like, (A, 2), optional
        On a circle by default, the first agent on top, then clockwise.
    known : array_like, (A,), optional
        Fill of each disc, from 0 (empty) to 1 (full), such as the share of the state that it knows.
    notes : sequence of str, optional
        A text below each agent, such as what it measures; may be empty.

    Examples
    --------
    >>> ax = graph(axes(xlabel="x", ylabel="y"), [[0, 1], [1, 0]], labels=["A", "B"])
    >>> [text.get_text() for text in ax.texts]
    ['A', 'B']
    """
    links = np.asarray(adjacency)
    n = len(links)
    names = [str(k + 1) for k in range(n)] if labels is None else labels
    angles = 2 * np.pi * np.arange(n) / n
    # Clockwise from the top; a single agent stands in the middle.
    circle = np.stack([np.sin(angles), np.cos(angles)], axis=-1) * (n > 1)
    places = circle if positions is None else np.asarray(positions, dtype=float)
    fill = np.zeros(n) if known is None else np.asarray(known, dtype=float)
    # The upper triangle has each symmetric link once.
    for i, j in zip(*np.nonzero(np.triu(links, 1)), strict=True):
        ax.plot(*places[[i, j]].T, color="0.55", linewidth=1.2, zorder=1)
    # Mix with white instead of transparency, which would show the links behind a disc.
    faces = [1 - k + k * np.array(to_rgba(colour(5))) for k in fill]
    x, y = places.T
    ax.scatter(x, y, s=340, c=faces, edgecolor=colour(0), linewidth=1.4, zorder=2)
    for name, note, (a, b) in zip(
        names, notes or [""] * n, places.tolist(), strict=True
    ):
        ax.text(a, b, name, ha="center", va="center", zorder=3)
        if note:
            ax.annotate(
                note,
                (a, b),
                (0, -13),
                textcoords="offset points",
                ha="center",
                va="top",
                fontsize="small",
                zorder=3,
            )
    # Discs stay round, and no axis is shown: positions mean nothing.
    ax.set_aspect("equal")
    ax.margins(0.2)
    ax.set_axis_off()
    return ax
