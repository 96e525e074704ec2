"""Pictures that move without a kernel: frames drawn once, and a slider that goes through them."""

from __future__ import annotations

import base64
import hashlib
import html
import io
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from matplotlib import pyplot
from PIL import Image

from .digests import of_axes

__all__ = ["Slider", "slider"]

LIMIT = 400_000
"""Characters of HTML at most: a page with three of them still opens at once.

Fewer or smaller frames, fewer colours and less fine detail make it shorter.
"""

_PAGE = """\
<div class="frames" data-frames="{key}" role="group" aria-label="{label}">
<img src="data:image/png;base64,{first}" alt="{alt}" width="{width}" height="{height}" \
style="max-width:100%;height:auto">
<div class="frames-controls" style="display:none;gap:.6em;align-items:center;max-width:{width}px">
<button type="button" aria-label="Play" style="min-width:2.4em">&#9654;</button>
<input type="range" min="0" max="{last}" step="1" value="{start}" aria-label="{label}" \
style="flex:1;min-width:6em">
<output style="min-width:7em">{said}</output>
</div>
<script type="application/json">{data}</script>
<script>
(() => {{
  const set = (root) => {{
    root.dataset.ready = "";
    const data = JSON.parse(root.querySelector("script[type='application/json']").textContent);
    const [image, input] = [root.querySelector("img"), root.querySelector("input")];
    const [button, output] = [root.querySelector("button"), root.querySelector("output")];
    root.querySelector(".frames-controls").style.display = "flex";
    const show = () => {{
      const frame = Number(input.value);
      image.src = "data:image/png;base64," + data.frames[frame];
      image.alt = data.alt + " " + data.said[frame] + ".";
      output.textContent = data.said[frame];
      input.setAttribute("aria-valuetext", data.said[frame]);
    }};
    let timer = null;
    const stop = () => {{
      clearInterval(timer);
      timer = null;
      button.textContent = "\\u25B6";
      button.setAttribute("aria-label", "Play");
    }};
    const step = () => {{
      if (!root.isConnected) return stop();
      input.value = (Number(input.value) + 1) % data.frames.length;
      show();
    }};
    input.addEventListener("input", () => {{ stop(); show(); }});
    button.addEventListener("click", () => {{
      if (timer !== null) return stop();
      timer = setInterval(step, data.milliseconds);
      button.textContent = "\\u275A\\u275A";
      button.setAttribute("aria-label", "Pause");
    }});
    show();
  }};
  const find = (left) => {{
    const roots = document.querySelectorAll("[data-frames='{key}']:not([data-ready])");
    roots.forEach(set);
    if (!roots.length && left > 0) requestAnimationFrame(() => find(left - 1));
  }};
  find(120);
}})();
</script>
</div>"""


@dataclass(frozen=True, eq=False, repr=False)
class Slider:
    """Frames and what goes through them; `slider` makes it, and a notebook shows it.

    Parameters
    ----------
    frames : tuple of bytes
        One PNG a frame.
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
    said: tuple[str, ...]
    digests: tuple[str, ...]
    label: str
    alt: str
    start: int

    def __post_init__(self) -> None:
        if len({frame[16:24] for frame in self.frames}) != 1:
            raise ValueError("draw: needs figures of one size")
        if len(self.html) > LIMIT:
            raise ValueError(f"frames: needs at most {LIMIT} characters, got {len(self.html)}")

    def __repr__(self) -> str:
        lines = [f"slider of {len(self.frames)} frames, first {self.said[self.start]}"]
        for said, text in zip(self.said, self.digests, strict=True):
            lines += [said, *(f"  {line}" for line in text.splitlines())]
        return "\n".join(lines)

    @property
    def html(self) -> str:
        """The slider as one piece of HTML that needs no kernel, no network and no other file."""
        pictures = [base64.b64encode(frame).decode() for frame in self.frames]
        data = {
            "alt": self.alt,
            "said": self.said,
            "milliseconds": 500,
            "frames": pictures,
        }
        width, height = (int.from_bytes(self.frames[0][k : k + 4]) for k in (16, 20))
        return _PAGE.format(
            # Of what the frames show, not of their bytes, which another machine may draw otherwise.
            key=hashlib.sha256(repr(self).encode()).hexdigest()[:16],
            label=html.escape(self.label),
            first=pictures[self.start],
            alt=html.escape(f"{self.alt} {self.said[self.start]}."),
            width=width,
            height=height,
            last=len(self.frames) - 1,
            start=self.start,
            said=html.escape(self.said[self.start]),
            data=json.dumps(data, separators=(",", ":")).replace("</", "<\\/"),
        )

    def _repr_mimebundle_(self, include: Any = None, exclude: Any = None) -> dict[str, str]:
        return {
            "text/plain": repr(self),
            "text/html": self.html,
            "image/png": base64.b64encode(self.frames[self.start]).decode(),
        }


def slider(
    draw: Callable[[Any], Any], values: Sequence[Any], *, label: str, alt: str,
    unit: str | None = None, form: str = "g", start: int = 0, colours: int = 32,
) -> Slider:
    """Draw a figure for each value, and go through them with a slider that needs no kernel.

    Every frame is drawn now. The HTML that comes out holds them all, with a slider, a button that
    plays them and a text for readers who do not see them. It works on the book's pages, in
    JupyterLab and in a file sent by mail; without scripts the first frame is left.

    Parameters
    ----------
    draw : callable
        ``draw(value)`` returns a matplotlib figure or axes; all figures of one size. Axes of one
        scale in all frames let a reader compare them: fix their limits.
    values : sequence
        One a frame; ten to thirty are enough.
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
    colours : int
        Colours of a frame's palette, 2 to 256. Few make a small file.

    Examples
    --------
    >>> from bookkit.plotting import axes
    >>> def draw(rate):
    ...     ax = axes(xlabel="time", ylabel="x", size=(3, 2))
    ...     ax.plot([0, 1, 2], [1, 1 - rate, (1 - rate) ** 2])
    ...     return ax
    >>> found = slider(draw, [0.0, 0.5, 1.0], label="rate", alt="A curve that falls.", start=1)
    >>> len(found.frames), found.said
    (3, ('rate 0', 'rate 0.5', 'rate 1'))
    """
    ending = "" if unit is None else f" {unit}"
    said = tuple(f"{label} {format(value, form)}{ending}" for value in values)
    frames, digests = zip(*(_frame(draw(value), colours) for value in values), strict=True)
    return Slider(frames, said, digests, label, alt, start)


def _frame(drawn: Any, colours: int) -> tuple[bytes, str]:
    """A figure as a small PNG, and its digest; the figure is closed, so that no cell shows it."""
    figure = getattr(drawn, "figure", drawn)
    whole, small = io.BytesIO(), io.BytesIO()
    text = of_axes(figure)
    figure.savefig(whole, format="png", metadata={"Software": None}, bbox_inches=None)
    pyplot.close(figure)
    picture = Image.open(whole).convert("RGB")
    picture.quantize(colours, dither=Image.Dither.NONE).save(small, format="png", optimize=True)
    return small.getvalue(), text
