"""Sliders without a kernel: frames that are drawn once, and HTML that steps through them."""

from __future__ import annotations

import base64
import hashlib
import html
import io
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from string import Template
from typing import Any

import numpy as np
from matplotlib import pyplot
from matplotlib.backends.backend_agg import FigureCanvasAgg
from PIL import Image

from .digests import of_axes

__all__ = ["Slider", "slider"]

LIMIT = 800_000
"""Largest number of characters of HTML, so that a page with two sliders stays below two megabytes.

Use fewer or smaller frames, or less detail, to make it shorter.
"""

_PAGE = Template((Path(__file__).parent / "slider.html").read_text(encoding="utf-8"))
_SECONDS = 5.0
"""Duration of all frames together; a frame is shown for at most half a second."""


@dataclass(frozen=True, eq=False, repr=False)
class Slider:
    """Frames with a slider that steps through them; made by `slider`, shown by a notebook.

    Parameters
    ----------
    frames : tuple of bytes
        One WebP image a frame, with 256 colours and twice the pixels of its size on a page.
    size : tuple of int
        Width and height on a page, in pixels.
    labels : tuple of str
        Text beside each frame, such as ``gain 0.1``.
    digests : tuple of str
        The digest of each frame's axes. They are the slider's text form, so that a comparison of
        stored outputs detects a changed frame.
    label, alt : str
        Name of the slider's value, and description of the picture for readers who do not see it.
    start : int
        Index of the frame that is shown first.
    """

    frames: tuple[bytes, ...]
    size: tuple[int, int]
    labels: tuple[str, ...]
    digests: tuple[str, ...]
    label: str
    alt: str
    start: int

    def __post_init__(self) -> None:
        # A page must stay light, also on a phone.
        if len(self.html) > LIMIT:
            raise ValueError(
                f"frames must have at most {LIMIT} characters of HTML, got {len(self.html)}"
            )

    def __repr__(self) -> str:
        lines = [
            f"slider of {len(self.frames)} frames, first {self.labels[self.start]}"
        ]
        for value_label, text in zip(self.labels, self.digests, strict=True):
            lines += [value_label, *(f"  {line}" for line in text.splitlines())]
        return "\n".join(lines)

    @property
    def html(self) -> str:
        """The slider as HTML that needs no kernel, no network and no other file."""
        pictures = [base64.b64encode(frame).decode() for frame in self.frames]
        data = {
            "alt": self.alt,
            "said": self.labels,
            "milliseconds": round(1000 * min(0.5, _SECONDS / len(self.frames))),
            "frames": pictures,
        }
        return _PAGE.substitute(
            # A hash of the digests: the frames' bytes may differ between machines.
            key=hashlib.sha256(repr(self).encode()).hexdigest()[:16],
            # Texts of the author must not end an attribute or an element.
            label=html.escape(self.label),
            first=pictures[self.start],
            alt=html.escape(f"{self.alt} {self.labels[self.start]}."),
            width=self.size[0],
            height=self.size[1],
            last=len(self.frames) - 1,
            start=self.start,
            said=html.escape(self.labels[self.start]),
            data=json.dumps(data, separators=(",", ":")).replace("</", "<\\/"),
        )

    def _repr_mimebundle_(
        self, include: Any = None, exclude: Any = None
    ) -> dict[str, str]:
        # Print and notebooks without scripts show the first frame as a PNG.
        still = io.BytesIO()
        # Fast compression: the stored notebook is compressed again.
        Image.open(io.BytesIO(self.frames[self.start])).save(
            still, "png", compress_level=1
        )
        return {
            "text/plain": repr(self),
            "text/html": self.html,
            "image/png": base64.b64encode(still.getvalue()).decode(),
        }


def slider(
    draw: Callable[[Any], Any],
    values: Sequence[Any],
    *,
    label: str,
    alt: str,
    unit: str | None = None,
    form: str = "g",
    start: int = 0,
) -> Slider:
    """Draw a figure for each value, and return a slider through them that needs no kernel.

    All frames are drawn at once. The HTML contains them with a slider, a button that plays them
    from the start, and a text for readers who do not see them. It works on the book's pages, in
    JupyterLab and in a file sent by mail. Without scripts the first frame is shown.

    Parameters
    ----------
    draw : callable
        ``draw(value)`` returns a matplotlib figure or axes; all figures have one size. Fix the
        limits of the axes, so that a reader can compare frames.
    values : sequence
        One value a frame; 24 or more look smooth.
    label : str
        Name of the value, such as ``gain``.
    alt : str
        Description of the picture, as a sentence.
    unit : str, optional
        Unit of the values.
    form : str
        Format specification of the values; ``""`` for texts.
    start : int
        Index of the frame that is shown first; it is also the picture in print.

    Examples
    --------
    >>> from bookkit.plotting import axes
    >>> def draw(rate):
    ...     ax = axes(xlabel="time", ylabel="x", size=(3, 2))
    ...     ax.plot([0, 1, 2], [1, 1 - rate, (1 - rate) ** 2])
    ...     return ax
    >>> found = slider(
    ...     draw, [0.0, 0.5, 1.0], label="rate", alt="A curve that falls.", start=1
    ... )
    >>> len(found.frames), found.labels
    (3, ('rate 0', 'rate 0.5', 'rate 1'))
    """
    labels = tuple(
        f"{label} {format(value, form)} {unit or ''}".rstrip() for value in values
    )
    positions: list[Any] = []
    # The first call fills `positions`, the later ones use them.
    frames, sizes, digests = zip(
        *(_frame(draw(v), positions) for v in values), strict=True
    )
    # One <img> of fixed size shows all frames.
    if len(set(sizes)) != 1:
        raise ValueError("draw must return figures of one size")
    return Slider(frames, sizes[0], labels, digests, label, alt, start)


def _frame(drawing: Any, positions: list[Any]) -> tuple[bytes, tuple[int, int], str]:
    """Return a figure as an image, its size and its digest, and close the figure.

    The layout of the first frame is stored in `positions` and used for the others, so that panels
    do not move between frames.
    """
    figure = getattr(drawing, "figure", drawing)
    # The layout engine would place panels differently for each frame.
    if positions:
        figure.set_layout_engine("none")
    for ax, position in zip(figure.axes, positions, strict=False):
        ax.set_position(position)
    file = io.BytesIO()
    text = of_axes(figure)
    pyplot.close(figure)
    canvas: Any = FigureCanvasAgg(figure)
    # Twice the pixels of the page, for screens of high resolution
    figure.set_dpi(2 * figure.dpi)
    canvas.draw()
    positions[:] = positions or [ax.get_position(original=True) for ax in figure.axes]
    # 256 colours by an octree (method 2): half the bytes, and no shade changes by over 1/16.
    picture = Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3]).quantize(
        method=2
    )
    # The same figure may be drawn again for the next frame.
    figure.set_dpi(figure.dpi / 2)
    picture.save(file, "webp", lossless=True, quality=50, method=2)
    return file.getvalue(), (picture.width // 2, picture.height // 2), text
