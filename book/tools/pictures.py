"""Pictures in stored outputs: found, taken out of texts, made lighter, and compared.

A figure's curves are compared by the digest of its axes, to four digits. What is left for the
picture itself is that it shows the same: another machine may round a pixel's shade otherwise, so
few pixels may differ, and none by much more than a line's edge.
"""

from __future__ import annotations

import startup  # noqa: F401

# isort: split
import base64
import binascii
import io
import re
from functools import reduce
from typing import Any

import nbformat
from PIL import Image, ImageChops

# A picture is told from other text by its own first bytes; a notebook escapes quotes.
_EMBEDDED = re.compile(
    r'(?<=data:image/webp;base64,)[A-Za-z0-9+/=\n]+|(?<=")(?:UklGR|iVBORw0KGgo)[A-Za-z0-9+/=]+'
)
SHADE = 0.25
"""A pixel differs if its shade does by more than this share of black to white."""
SHARE = 5e-4
"""How many of a picture's pixels may differ."""
TINT = 12
TINTED = 1e-3
"""A palette of 256 colours moves no more than this share of pixels by more than this of 255."""


def extract_pictures(text: str) -> tuple[str, list[str]]:
    """Return a text without the frames of sliders that are written in it, and these."""
    return _EMBEDDED.sub("…", text), _EMBEDDED.findall(text)


def pictures_of(output: Any) -> list[str]:
    """Return the pictures of an output, those that its HTML embeds included, as base64."""
    data = output.get("data", {})
    out = [data["image/png"]] if "image/png" in data else []
    return out + extract_pictures(_join(data.get("text/html", "")))[1]


def _join(text: Any) -> str:
    return text if isinstance(text, str) else "".join(text)


def without_pictures(outputs: list[Any]) -> list[Any]:
    """Return outputs with every picture replaced by its place."""
    out = []
    for output in outputs:
        data = dict(output.get("data", {}))
        if "image/png" in data:
            data["image/png"] = "…"
        if "text/html" in data:
            data["text/html"] = extract_pictures(_join(data["text/html"]))[0]
        out.append(nbformat.from_dict({**output, "data": data}) if data else output)
    return out


def shrink_picture(picture: str) -> str:
    """Return a PNG with a palette of 256 colours, a third of the bytes, if a reader sees the same.

    A picture of finer shades, or one that has a palette already, comes back as it is.
    """
    image = Image.open(io.BytesIO(base64.b64decode(picture)))
    if image.mode == "P" or (image.mode == "RGBA" and image.getextrema()[3][0] < 255):
        return picture
    palette = image.convert("RGB").quantize(256, kmeans=1, dither=Image.Dither.NONE)
    if _changed_share(image, palette, TINT) > TINTED:
        return picture
    out = io.BytesIO()
    palette.save(out, "png", optimize=True, dpi=image.info.get("dpi", (72, 72)))
    return base64.b64encode(out.getvalue()).decode()


def shrink_pictures(outputs: list[Any]) -> None:
    """Make the stored pictures of a cell lighter, in place."""
    for output in outputs:
        if "image/png" in output.get("data", {}):
            output["data"]["image/png"] = shrink_picture(output["data"]["image/png"])


def _changed_share(one: Image.Image, other: Image.Image, by: float) -> float:
    """The share of pixels of which a colour differs by more than `by` of 255."""
    bands = ImageChops.difference(one.convert("RGB"), other.convert("RGB")).split()
    counts = reduce(ImageChops.lighter, bands).histogram()
    return sum(counts[int(by) + 1 :]) / sum(counts)


def difference(one: str, other: str) -> str:
    """Return in words how two pictures, as base64, differ; '' if a reader sees the same."""
    if one.strip() == other.strip():
        return ""
    try:
        a, b = (Image.open(io.BytesIO(base64.b64decode(p))) for p in (one, other))
        share = _changed_share(a, b, 255 * SHADE) if a.size == b.size else 1.0
    except (OSError, ValueError, binascii.Error):
        return "is no picture"
    if a.size != b.size:
        return f"has {a.width} x {a.height} pixels, not {b.width} x {b.height}"
    return f"differs in {share:.2%} of its pixels" if share > SHARE else ""


def differences(stored: list[Any], fresh: list[Any]) -> list[str]:
    """Return how the pictures of two lists of outputs differ."""
    one = [p for output in stored for p in pictures_of(output)]
    two = [p for output in fresh for p in pictures_of(output)]
    if len(one) != len(two):
        return [f"{len(one)} pictures stored, {len(two)} drawn"]
    found = (difference(a, b) for a, b in zip(one, two, strict=True))
    return [f"picture {k} {text}" for k, text in enumerate(found, start=1) if text]
