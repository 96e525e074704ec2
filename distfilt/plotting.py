"""Figures of the book: arrays in, matplotlib axes out, and a digest that notices a changed curve.

No other module imports this one. Colours and line styles both tell curves apart, so that a figure
also reads in grey and for a reader who does not see all colours.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from .checks import Array, array, choice, count, increasing, number
from .digests import digest
from .linalg import factor

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = [
    "LINE_STYLES",
    "PALETTE",
    "SIZE",
    "axes",
    "band",
    "colour",
    "digest",
    "ellipse",
    "graph",
    "line_style",
    "save",
    "use_style",
]

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

_DPI = 110


def colour(index: int) -> str:
    """The palette's colour number `index`, counted from 0; it starts again after the last.

    Examples
    --------
    >>> colour(0), colour(8)
    ('#0072B2', '#0072B2')
    """
    return PALETTE[count(index, "index", at_least=0) % len(PALETTE)]


def line_style(index: int) -> Any:
    """The line style that goes with colour number `index`.

    Examples
    --------
    >>> line_style(0), line_style(1)
    ('-', '--')
    """
    return LINE_STYLES[count(index, "index", at_least=0) % len(LINE_STYLES)]


def use_style() -> None:
    """Set matplotlib's defaults for a chapter; call it once, before the first figure.

    Page size, resolution and fonts are fixed, and so are the ids in an SVG, so that a figure drawn
    twice is the same file.

    Examples
    --------
    >>> from matplotlib import rc_context, rcParams
    >>> with rc_context():  # so that this example leaves no trace
    ...     use_style()
    ...     rcParams["figure.dpi"]
    110.0
    """
    from cycler import cycler
    from matplotlib import rcParams

    rcParams.update(
        {
            "figure.figsize": SIZE,
            "figure.dpi": _DPI,
            "figure.constrained_layout.use": True,
            "savefig.dpi": _DPI,
            "savefig.bbox": None,
            "svg.hashsalt": "distfilt",
            "svg.fonttype": "path",
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


def _text(value: Any, name: str) -> str:
    if not isinstance(value, str) or not value.strip():
        raise ValueError(f"{name}: needs a text, got {value!r}")
    return value


def _labelled(label: Any, unit: Any, axis: str) -> str:
    text = _text(label, f"{axis}label")
    return text if unit is None else f"{text} ({_text(unit, f'{axis}unit')})"


def _check_axes(ax: Any) -> Axes:
    from matplotlib.axes import Axes

    if not isinstance(ax, Axes):
        raise ValueError(f"ax: needs matplotlib axes, got {type(ax).__name__}")
    return ax


def axes(
    *,
    xlabel: str,
    ylabel: str,
    xunit: str | None = None,
    yunit: str | None = None,
    title: str | None = None,
    ax: Axes | None = None,
    xscale: str = "linear",
    yscale: str = "linear",
    size: tuple[float, float] = SIZE,
) -> Axes:
    """Labelled axes, in a new figure of the book's size unless `ax` is given.

    Parameters
    ----------
    xlabel, ylabel : str
        What the axes show; required.
    xunit, yunit : str, optional
        Units, put behind the labels in parentheses.
    title : str, optional
        Only where the caption does not say it.
    ax : matplotlib Axes, optional
        Axes to label.
    xscale, yscale : {"linear", "log"}
        Scales.
    size : (float, float)
        Width and height of a new figure, in inches.

    Returns
    -------
    matplotlib Axes

    Examples
    --------
    >>> axes(xlabel="time", xunit="s", ylabel="error", yunit="m").get_xlabel()
    'time (s)'
    """
    x, y = _labelled(xlabel, xunit, "x"), _labelled(ylabel, yunit, "y")
    scales = (
        choice(xscale, "xscale", ("linear", "log")),
        choice(yscale, "yscale", ("linear", "log")),
    )
    width, height = array(size, "size", (2,)).tolist()
    number(min(width, height), "size", above=0)
    if ax is None:
        from matplotlib import pyplot

        _, ax = pyplot.subplots(figsize=(width, height))
    found = _check_axes(ax)
    found.set(xlabel=x, ylabel=y, xscale=scales[0], yscale=scales[1])
    if title is not None:
        found.set_title(_text(title, "title"))
    return found


def ellipse(
    ax: Axes,
    mean: ArrayLike,
    covariance: ArrayLike,
    *,
    level: float = 0.95,
    index: int = 0,
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
    index : int
        Number of the colour and line style.
    label : str, optional
        For the legend.

    Returns
    -------
    matplotlib Axes

    Examples
    --------
    >>> ax = ellipse(axes(xlabel="x", ylabel="y"), [0.0, 0.0], [[4.0, 0.0], [0.0, 1.0]])
    >>> float(ax.lines[0].get_xdata().max().round(2))  # two standard deviations of 2.448
    4.9
    """
    found = _check_axes(ax)
    centre = array(mean, "mean", (2,))
    root = factor(array(covariance, "covariance", (2, 2)), name="covariance")
    radius = np.sqrt(-2 * np.log1p(-number(level, "level", above=0, below=1)))
    turn = np.linspace(0, 2 * np.pi, 181)
    x, y = centre[:, None] + radius * root @ np.stack([np.cos(turn), np.sin(turn)])
    found.plot(x, y, color=colour(index), linestyle=line_style(index), label=label)
    found.plot(*centre, marker="+", color=colour(index), linestyle="none")
    return found


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
        Strictly increasing, usually times.
    runs : array_like, (R, T)
        One curve a run.
    quantiles : (float, float)
        Lower and upper end of the band, in [0, 1], increasing.
    index : int
        Number of the colour and line style.
    label : str, optional
        For the legend.

    Returns
    -------
    matplotlib Axes

    Examples
    --------
    >>> errors = [[1.0, 5.0], [2.0, 4.0], [9.0, 3.0]]
    >>> ax = band(axes(xlabel="time", ylabel="error"), [0.0, 1.0], errors)
    >>> ax.lines[0].get_ydata()
    array([2., 4.])
    """
    found = _check_axes(ax)
    t = increasing(x, "x")
    curves = array(runs, "runs", ("R", t.size))
    if curves.shape[0] < 1:
        raise ValueError(f"runs: needs at least one run, got shape {curves.shape}")
    ends = increasing(array(quantiles, "quantiles", (2,)), "quantiles")
    number(ends[0], "quantiles", at_least=0)
    number(ends[1], "quantiles", at_most=1)
    low, middle, high = np.quantile(curves, [ends[0], 0.5, ends[1]], axis=0)
    shade = colour(index)
    found.fill_between(t, low, high, color=shade, alpha=0.2, linewidth=0)
    found.plot(t, middle, color=shade, linestyle=line_style(index), label=label)
    return found


def graph(
    ax: Axes,
    adjacency: ArrayLike,
    *,
    labels: tuple[str, ...] | list[str] | None = None,
    positions: ArrayLike | None = None,
) -> Axes:
    """Draw agents as discs and the links between them as lines.

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

    Returns
    -------
    matplotlib Axes

    Examples
    --------
    >>> ax = graph(axes(xlabel="x", ylabel="y"), [[0, 1], [1, 0]], labels=["A", "B"])
    >>> [text.get_text() for text in ax.texts]
    ['A', 'B']
    """
    found = _check_axes(ax)
    links = array(adjacency, "adjacency", ("A", "A"))
    n = links.shape[0]
    if n == 0 or links.shape != (n, n) or (links != links.T).any():
        raise ValueError(f"adjacency: needs a symmetric square matrix, got shape {links.shape}")
    names = (
        [str(k + 1) for k in range(n)] if labels is None else [_text(s, "labels") for s in labels]
    )
    if len(names) != n:
        raise ValueError(f"labels: needs one for each of {n} agents, got {len(names)}")
    place = _circle(n) if positions is None else array(positions, "positions", (n, 2))
    for i, j in zip(*np.nonzero(np.triu(links, 1)), strict=True):
        found.plot(*place[[i, j]].T, color="0.55", linewidth=1.2, zorder=1)
    found.scatter(
        place[:, 0], place[:, 1], s=340, color="white", edgecolor=colour(0), linewidth=1.4, zorder=2
    )
    for name, (x, y) in zip(names, place.tolist(), strict=True):
        found.text(x, y, name, ha="center", va="center", zorder=3)
    found.set_aspect("equal")
    found.margins(0.2)
    found.set_axis_off()
    return found


def _circle(n: int) -> Array:
    turn = 2 * np.pi * np.arange(n) / n
    return np.stack([np.sin(turn), np.cos(turn)], axis=-1) * (n > 1)


def save(figure: Figure, path: str | Path) -> Path:
    """Write a figure to a file without the date or version, so that two writes give equal bytes.

    Parameters
    ----------
    figure : matplotlib Figure
        What to write.
    path : str or Path
        Ends in .png or .svg.

    Returns
    -------
    Path

    Examples
    --------
    >>> import tempfile
    >>> figure = axes(xlabel="x", ylabel="y").figure
    >>> save(figure, Path(tempfile.mkdtemp()) / "empty.png").suffix
    '.png'
    """
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    if not isinstance(figure, Figure):
        raise ValueError(f"figure: needs a matplotlib Figure, got {type(figure).__name__}")
    if not isinstance(path, str | Path):
        raise ValueError(f"path: needs a path, got {type(path).__name__}")
    target = Path(path)
    kind = choice(target.suffix, "path", (".png", ".svg"))
    metadata: dict[str, Any] = {"Software": None} if kind == ".png" else {"Date": None}
    with rc_context({"svg.hashsalt": "distfilt"}):
        figure.savefig(target, dpi=_DPI, metadata=metadata)
    return target
