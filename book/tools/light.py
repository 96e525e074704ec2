"""Pages that weigh less: pictures as lossless WebP, a slider's frames in files of their own."""

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
"""A picture that moves, on a built page."""
INLINE = "data:image/webp;base64,"
AHEAD = """root.dataset.ready = "";
    // Frames are asked for when somebody comes near.
    const ask = () => { data.frames.forEach((frame) => { new Image().src = frame; }); };
    root.addEventListener("pointerenter", ask, {once: true});
    root.addEventListener("focusin", ask, {once: true});"""


def lighten(folder: Path) -> None:
    """Make the pages of a built book lighter; what they show stays the same to the last pixel."""
    images = folder / "_images"
    with ThreadPoolExecutor() as pool:
        small = [
            name for name in pool.map(as_webp, sorted(images.glob("*.png"))) if name
        ]
    named = re.compile(rf"(_images/)({'|'.join(map(re.escape, small))})\.png")
    for page in sorted(folder.rglob("*.html")):
        before = page.read_text(encoding="utf-8")
        text = named.sub(r"\1\2.webp", before) if small else before
        where = os.path.relpath(images, page.parent)
        text = FRAMES.sub(
            lambda found, where=where: outside(found, images, where), text
        )
        if text != before:
            page.write_text(text, encoding="utf-8")


def as_webp(picture: Path) -> str | None:
    """Write a PNG again as lossless WebP if that is smaller; return its name without an ending."""
    target = picture.with_suffix(".webp")
    with Image.open(picture) as image:
        alpha = image.mode == "RGBA" and image.getextrema()[3][0] < 255
        plain = image.convert("RGBA" if alpha else "RGB")
    plain.save(target, lossless=True, quality=50, method=2)
    worse, better = sorted((picture, target), key=lambda path: -path.stat().st_size)
    worse.unlink()
    return picture.stem if better == target else None


def outside(found: re.Match[str], images: Path, where: str) -> str:
    """Return a slider whose frames are files, and write them."""
    data = json.loads(found["data"])
    names = []
    for frame in data["frames"]:
        content = base64.b64decode(frame)
        names += [f"{hashlib.sha256(content).hexdigest()[:24]}.webp"]
        (images / names[-1]).write_bytes(content)
    links = dict(
        zip((f"{INLINE}{frame}" for frame in data["frames"]), names, strict=True)
    )
    data["frames"] = [f"{where}/{name}" for name in names]
    told = json.dumps(data, separators=(",", ":")).replace("</", "<\\/")
    text = found[0].replace(found["data"], told).replace(f'"{INLINE}" + ', "")
    text = re.sub(
        rf'src="({INLINE}[^"]*)"', lambda src: f'src="{where}/{links[src[1]]}"', text
    )
    return text.replace('root.dataset.ready = "";', AHEAD)
