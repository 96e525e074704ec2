"""Pictures that move without a kernel: frames drawn once, and a slider that goes through them."""

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
"""Characters of HTML at most: a page with two of them weighs less than two megabytes.

Fewer or smaller frames and less fine detail make it shorter.
"""

_PAGE = Template((Path(__file__).parent / "slider.html").read_text(encoding="utf-8"))
_SECONDS = 5.0
"""How long all frames together play; a frame stays half a second at most."""


@dataclass(frozen=True, eq=False, repr=False)
class Slider:
    """Frames and what goes through them; `slider` makes it, and a notebook shows it.

    Parameters
    ----------
    frames : tuple of bytes
        One WebP a frame, of 256 colours and twice the pixels that it takes on a page.
    size : tuple of int
        Width and height on a page, in pixels.
    said : tuple of str
        What is shown beside each frame, such as ``gain 0.1``.
    digests : tuple of str
        The digest of each frame's axes. They are the slider's text form, which is stored beside
        it: a frame that changes is noticed by whoever compares stored outputs.
    label, alt : str
        What the slider sets, and what the picture shows, for readers who do not see it.
    start : int
        The frame that is shown first.
    """

    frames: tuple[bytes, ...]
    size: tuple[int, int]
    labels: tuple[str, ...]
    digests: tuple[str, ...]
    label: str
    alt: str
    start: int

    def __post_init__(self) -> None:
        if len(self.html) > LIMIT:
            raise ValueError(
                f"frames must have at most {LIMIT} characters, got {len(self.html)}"
            )

    def __repr__(self) -> str:
        lines = [
            f"slider of {len(self.frames)} frames, first {self.labels[self.start]}"
        ]
        for said, text in zip(self.labels, self.digests, strict=True):
            lines += [said, *(f"  {line}" for line in text.splitlines())]
        return "\n".join(lines)

    @property
    def html(self) -> str:
        """The slider as one piece of HTML that needs no kernel, no network and no other file."""
        pictures = [base64.b64encode(frame).decode() for frame in self.frames]
        data = {
            "alt": self.alt,
            "said": self.labels,
            "milliseconds": round(1000 * min(0.5, _SECONDS / len(self.frames))),
            "frames": pictures,
        }
        return _PAGE.substitute(
            # Of what the frames show, not of their bytes, which another machine may draw otherwise.
            key=hashlib.sha256(repr(self).encode()).hexdigest()[:16],
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
        still = io.BytesIO()
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
    """Draw a figure for each value, and go through them with a slider that needs no kernel.

    Every frame is drawn now. The HTML that comes out holds them all, with a slider, a button that
    plays them from the beginning, and a text for readers who do not see them. It works on the
    book's pages, in JupyterLab and in a file sent by mail; without scripts the first frame is left.

    Parameters
    ----------
    draw : callable
        ``draw(value)`` returns a matplotlib figure or axes; all figures of one size. Axes of one
        scale in all frames let a reader compare them: fix their limits.
    values : sequence
        One a frame; with 24 or more what moves looks smooth.
    label : str
        What the slider sets, such as ``gain``.
    alt : str
        What the picture shows, as a sentence.
    unit : str, optional
        Unit of the values.
    form : str
        Format of the values, as of `format`; ``""`` for texts.
    start : int
        The frame that is shown first, counted from 0. Choose the one that says most: it is also
        the picture in print.

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
    said = tuple(
        f"{label} {format(value, form)} {unit or ''}".rstrip() for value in values
    )
    places: list[Any] = []
    frames, sizes, digests = zip(
        *(_frame(draw(v), places) for v in values), strict=True
    )
    if len(set(sizes)) != 1:
        raise ValueError("draw must have figures of one size")
    return Slider(frames, sizes[0], said, digests, label, alt, start)


def _frame(drawn: Any, places: list[Any]) -> tuple[bytes, tuple[int, int], str]:
    """A figure as a picture, its size and digest; it is closed, so that no cell shows it.

    The first frame's panels find their `places`, the others take them, so that no panel jumps.
    """
    figure = getattr(drawn, "figure", drawn)
    if places:
        figure.set_layout_engine("none")
    for ax, place in zip(figure.axes, places, strict=False):
        ax.set_position(place)
    small = io.BytesIO()
    text = of_axes(figure)
    pyplot.close(figure)
    canvas: Any = FigureCanvasAgg(figure)
    figure.set_dpi(2 * figure.dpi)
    canvas.draw()
    places[:] = places or [ax.get_position(original=True) for ax in figure.axes]
    # 256 colours, by an octree: half the bytes, and no shade moves by more than a sixteenth.
    picture = Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3]).quantize(
        method=2
    )
    figure.set_dpi(figure.dpi / 2)  # it may be drawn again for the next frame
    picture.save(small, "webp", lossless=True, quality=50, method=2)
    return small.getvalue(), (picture.width // 2, picture.height // 2), text
