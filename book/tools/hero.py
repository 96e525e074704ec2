"""Write the slider of the first page as a GIF, for README.md.

    python book/tools/hero.py

The frames are those of the stored first page, so run `make outputs` first.
"""

from __future__ import annotations

import base64
import io
import json
import re
import sys
from collections.abc import Iterator

from PIL import Image

from common import BOOK, SLIDER

TARGET = BOOK / "_static" / "hero.gif"
LIMIT = 1_500_000
"""Largest size, in bytes."""


def pages() -> Iterator[str]:
    """Yield the HTML of every output of the first page."""
    notebook = json.loads((BOOK / "index.ipynb").read_text(encoding="utf-8"))
    for cell in notebook["cells"]:
        for output in cell.get("outputs", ()):
            yield "".join(output.get("data", {}).get("text/html", ""))


def main() -> int:
    # The slider stores its frames as JSON beside its controls.
    html = next(page for page in pages() if SLIDER in page)
    data = re.search(r'<script type="application/json">(.*?)</script>', html, re.DOTALL)
    if data is None:
        sys.exit("book/index.ipynb: its slider has no frames; run make outputs")
    slider = json.loads(data[1])
    frames = [
        Image.open(io.BytesIO(base64.b64decode(frame))) for frame in slider["frames"]
    ]
    # Areas of one colour compress best: few colours, and no dithering.
    resized = [
        frame.convert("RGB")
        .resize((720, 720 * frame.height // frame.width))
        .quantize(64, dither=Image.Dither.NONE)
        for frame in frames
    ]
    # The last frame stands still for a moment before the loop starts again.
    times = [slider["milliseconds"]] * (len(resized) - 1) + [1500]
    resized[0].save(
        TARGET, save_all=True, append_images=resized[1:], duration=times, loop=0
    )
    if TARGET.stat().st_size > LIMIT:
        sys.exit(f"{TARGET}: {TARGET.stat().st_size} bytes, at most {LIMIT}")
    print(f"{TARGET.relative_to(BOOK.parent)}: {TARGET.stat().st_size} bytes")
    return 0


if __name__ == "__main__":
    sys.exit(main())
