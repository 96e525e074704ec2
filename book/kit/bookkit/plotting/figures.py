"""Style, axes and files of the book's figures.

Colours and line styles both tell curves apart, so that a figure also reads in grey and for a reader
who does not see all colours.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from distfilt.checks import array, choice, count, needed, nonblank, number

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = [  # fmt: skip
    "LINE_STYLES", "PALETTE", "SIZE", "axes", "colour", "line_style", "save", "use_style",
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

    >>> colour(0), colour(8)
    ('#0072B2', '#0072B2')
    """
    return PALETTE[count(index, "index", at_least=0) % len(PALETTE)]


def line_style(index: int) -> Any:
    """The line style that goes with colour number `index`.

    >>> line_style(0), line_style(1)
    ('-', '--')
    """
    return LINE_STYLES[count(index, "index", at_least=0) % len(LINE_STYLES)]


def use_style() -> None:
    """Set matplotlib's defaults for a chapter; call it once, before the first figure.

    Page size, resolution and fonts are fixed, and so are the ids in an SVG, so that a figure drawn
    twice is the same file. In a notebook the text form of a figure, which is stored beside its
    picture, becomes the digest of what its axes hold (:func:`bookkit.digests.of_axes`): a curve
    that changes is noticed by whoever compares stored outputs.

    >>> from matplotlib import rc_context, rcParams
    >>> with rc_context():  # so that this example leaves no trace
    ...     use_style()
    ...     rcParams["figure.dpi"]
    110.0
    """
    needed("matplotlib", "plots")
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
    _print_digests()


def _print_digests() -> None:
    """In IPython, print a figure as its digest; elsewhere there is no text beside a picture."""
    import sys

    if "IPython" not in sys.modules:
        return
    from IPython import get_ipython
    from matplotlib import get_backend, pyplot
    from matplotlib.figure import Figure

    from ..digests import of_axes

    def said(figure: Figure) -> str:
        try:
            return of_axes(figure)
        except ValueError:  # nothing is drawn in it
            return "an empty figure"

    shell = get_ipython()
    if shell is not None:
        # The notebook's backend forgets printers when it starts, with the first figure: start it.
        pyplot.switch_backend(get_backend())
        text = shell.display_formatter.formatters["text/plain"]
        text.for_type(Figure, lambda figure, printer, cycle: printer.text(said(figure)))


def _labelled(label: Any, unit: Any, axis: str) -> str:
    text = nonblank(label, f"{axis}label")
    return text if unit is None else f"{text} ({nonblank(unit, f'{axis}unit')})"


def check_axes(ax: Any) -> Axes:
    needed("matplotlib", "plots")
    from matplotlib.axes import Axes

    if not isinstance(ax, Axes):
        raise ValueError(f"ax: needs matplotlib axes, got {type(ax).__name__}")
    return ax


def axes(
    *, xlabel: str, ylabel: str, xunit: str | None = None, yunit: str | None = None,
    title: str | None = None, ax: Axes | None = None, xscale: str = "linear",
    yscale: str = "linear", size: tuple[float, float] = SIZE,
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
        needed("matplotlib", "plots")
        from matplotlib import pyplot

        _, ax = pyplot.subplots(figsize=(width, height))
    found = check_axes(ax)
    found.set(xlabel=x, ylabel=y, xscale=scales[0], yscale=scales[1])
    if title is not None:
        found.set_title(nonblank(title, "title"))
    return found


def save(figure: Figure, path: str | Path) -> Path:
    """Write a figure to a file without the date or version, so that two writes give equal bytes.

    Parameters
    ----------
    figure : matplotlib Figure
        What to write.
    path : str or Path
        Ends in .png or .svg.

    Examples
    --------
    >>> import tempfile
    >>> figure = axes(xlabel="x", ylabel="y").figure
    >>> save(figure, Path(tempfile.mkdtemp()) / "empty.png").suffix
    '.png'
    """
    needed("matplotlib", "plots")
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
