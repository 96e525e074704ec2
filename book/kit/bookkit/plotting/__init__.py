"""Figures of the book: arrays in, matplotlib axes out, and pictures that move without a kernel.

No other part of the library imports this one.
"""

from ..digests import digest
from .drawing import band, ellipse, graph
from .figures import LINE_STYLES, PALETTE, SIZE, axes, colour, line_style, save, use_style
from .moving import Slider, slider

__all__ = [  # fmt: skip
    "LINE_STYLES", "PALETTE", "SIZE", "Slider", "axes", "band", "colour", "digest", "ellipse",
    "graph", "line_style", "save", "slider", "use_style",
]
