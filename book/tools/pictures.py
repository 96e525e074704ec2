"""Pictures in stored outputs: extract, shrink and compare them.

A figure's curves are compared by the digest of its axes, to four digits. The pixels are compared
loosely, since another machine may round shades differently: few pixels may differ, and none by much
more than the edge of a line.
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

# Pictures are recognised by their first bytes, since a notebook escapes quotes.
_EMBEDDED = re.compile(
    r'(?<=data:image/webp;base64,)[A-Za-z0-9+/=\n]+|(?<=")(?:UklGR|iVBORw0KGgo)[A-Za-z0-9+/=]+'
)
SHADE = 0.25
"""A pixel differs if its shade differs by more than this fraction of black to white."""
SHARE = 5e-4
"""Largest fraction of pixels that may differ."""
TINT = 12
TINTED = 1e-3
"""With 256 colours, at most a fraction `TINTED` of pixels may change by over `TINT` of 255."""


def extract_pictures(text: str) -> tuple[str, list[str]]:
    """Return a text without the pictures that it embeds, and the pictures."""
    return _EMBEDDED.sub("…", text), _EMBEDDED.findall(text)


def pictures_of(output: Any) -> list[str]:
    """Return the pictures of an output, those that its HTML embeds included, as base64."""
    data = output.get("data", {})
    # A slider has pictures in its HTML beside the one for print.
    pictures = [data["image/png"]] if "image/png" in data else []
    return pictures + extract_pictures(_join(data.get("text/html", "")))[1]


def _join(text: Any) -> str:
    return text if isinstance(text, str) else "".join(text)


def without_pictures(outputs: list[Any]) -> list[Any]:
    """Return outputs with a mark in place of every picture."""
    texts = []
    for output in outputs:
        data = dict(output.get("data", {}))
        if "image/png" in data:
            data["image/png"] = "…"
        if "text/html" in data:
            data["text/html"] = extract_pictures(_join(data["text/html"]))[0]
        texts.append(nbformat.from_dict({**output, "data": data}) if data else output)
    return texts


def shrink_picture(picture: str) -> str:
    """Return a PNG with 256 colours, a third of the bytes, if the colours nearly stay the same.

    A picture of finer shades, or one that has a palette already, is returned unchanged.
    """
    image = Image.open(io.BytesIO(base64.b64decode(picture)))
    # A picture with a palette or transparent pixels stays as it is.
    if image.mode == "P" or (image.mode == "RGBA" and image.getextrema()[3][0] < 255):
        return picture
    # Without dithering, so that areas of one colour stay one colour.
    palette = image.convert("RGB").quantize(256, kmeans=1, dither=Image.Dither.NONE)
    # A colour map has more shades than a palette, and is kept.
    if _share_of_differences(image, palette, TINT) > TINTED:
        return picture
    file = io.BytesIO()
    palette.save(file, "png", optimize=True, dpi=image.info.get("dpi", (72, 72)))
    return base64.b64encode(file.getvalue()).decode()


def shrink_pictures(outputs: list[Any]) -> None:
    """Make the stored pictures of a cell lighter, in place."""
    for output in outputs:
        if "image/png" in output.get("data", {}):
            output["data"]["image/png"] = shrink_picture(output["data"]["image/png"])


def _share_of_differences(one: Image.Image, other: Image.Image, by: float) -> float:
    """Return the fraction of pixels with a colour that differs by more than `by` of 255."""
    # The largest difference of the three colours, for each pixel
    bands = ImageChops.difference(one.convert("RGB"), other.convert("RGB")).split()
    # histogram()[k] counts the pixels that differ by k of 255.
    counts = reduce(ImageChops.lighter, bands).histogram()
    return sum(counts[int(by) + 1 :]) / sum(counts)


def difference(one: str, other: str) -> str:
    """Describe how two pictures, as base64, differ; '' if nearly all pixels agree."""
    if one.strip() == other.strip():
        return ""
    try:
        # base64 of anything but a picture raises here.
        a, b = (Image.open(io.BytesIO(base64.b64decode(p))) for p in (one, other))
        share = _share_of_differences(a, b, 255 * SHADE) if a.size == b.size else 1.0
    except (OSError, ValueError, binascii.Error):
        return "is no picture"
    # Pictures of other sizes cannot be compared by pixels.
    if a.size != b.size:
        return f"has {a.width} x {a.height} pixels, not {b.width} x {b.height}"
    return f"differs in {share:.2%} of its pixels" if share > SHARE else ""


def differences(stored: list[Any], fresh: list[Any]) -> list[str]:
    """Return how the pictures of two lists of outputs differ."""
    stored_pictures = [p for output in stored for p in pictures_of(output)]
    fresh_pictures = [p for output in fresh for p in pictures_of(output)]
    # Without equal numbers, pairs would be compared at random.
    if len(stored_pictures) != len(fresh_pictures):
        return [f"{len(stored_pictures)} pictures stored, {len(fresh_pictures)} drawn"]
    texts = (
        difference(a, b) for a, b in zip(stored_pictures, fresh_pictures, strict=True)
    )
    return [f"picture {k} {text}" for k, text in enumerate(texts, start=1) if text]
