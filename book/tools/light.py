"""Smaller pages: pictures as lossless WebP, the frames of sliders in separate files."""

from __future__ import annotations

import base64
import hashlib
import json
import os
import re
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from PIL import Image

from common import SLIDER

FRAMES = re.compile(
    rf'<div {SLIDER}.*?<script type="application/json">(?P<data>.*?)</script>.*?</script>',
    re.S,
)
"""A slider on a built page."""
INLINE = "data:image/webp;base64,"
AHEAD = """root.dataset.ready = "";
    // Frames are loaded when the pointer or the focus enters the slider.
    const ask = () => { data.frames.forEach((frame) => { new Image().src = frame; }); };
    root.addEventListener("pointerenter", ask, {once: true});
    root.addEventListener("focusin", ask, {once: true});"""


def lighten(folder: Path) -> None:
    """Make the pages of a built book smaller, without a change of any pixel."""
    images = folder / "_images"
    with ThreadPoolExecutor() as pool:
        # One thread a picture: Pillow releases the interpreter's lock while it encodes.
        converted = [
            name for name in pool.map(as_webp, sorted(images.glob("*.png"))) if name
        ]
    # Only pictures that became smaller have a new name.
    references = re.compile(rf"(_images/)({'|'.join(map(re.escape, converted))})\.png")
    for page in sorted(folder.rglob("*.html")):
        before = page.read_text(encoding="utf-8")
        text = references.sub(r"\1\2.webp", before) if converted else before
        # Links of a page are relative, so that the book can be moved.
        relative = os.path.relpath(images, page.parent)
        text = FRAMES.sub(
            lambda found, relative=relative: outside(found, images, relative), text
        )
        if text != before:
            page.write_text(text, encoding="utf-8")


def as_webp(picture: Path) -> str | None:
    """Write a PNG again as lossless WebP if that is smaller; return its name without an ending."""
    target = picture.with_suffix(".webp")
    with Image.open(picture) as image:
        # Keep the alpha channel only if some pixel is transparent.
        alpha = image.mode == "RGBA" and image.getextrema()[3][0] < 255
        plain = image.convert("RGBA" if alpha else "RGB")
    plain.save(target, lossless=True, quality=50, method=2)
    # Keep the smaller one of the two files.
    larger, smaller = sorted((picture, target), key=lambda path: -path.stat().st_size)
    larger.unlink()
    return picture.stem if smaller == target else None


def outside(found: re.Match[str], images: Path, where: str) -> str:
    """Write the frames of a slider to files, and return the slider with links to them."""
    data = json.loads(found["data"])
    names = []
    for frame in data["frames"]:
        content = base64.b64decode(frame)
        # Named by content: equal frames share a file.
        names += [f"{hashlib.sha256(content).hexdigest()[:24]}.webp"]
        (images / names[-1]).write_bytes(content)
    # The first frame is also an <img>, which gets the same file.
    links = dict(
        zip((f"{INLINE}{frame}" for frame in data["frames"]), names, strict=True)
    )
    data["frames"] = [f"{where}/{name}" for name in names]
    # "</" would end the script element that holds the data.
    text_of_data = json.dumps(data, separators=(",", ":")).replace("</", "<\\/")
    text = found[0].replace(found["data"], text_of_data).replace(f'"{INLINE}" + ', "")
    text = re.sub(
        rf'src="({INLINE}[^"]*)"', lambda src: f'src="{where}/{links[src[1]]}"', text
    )
    return text.replace('root.dataset.ready = "";', AHEAD)
