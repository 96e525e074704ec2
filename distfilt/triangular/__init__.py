"""Triangular transport maps: fit one to samples of (y, x), then condition on an observation."""

from .affine import AffineMap
from .separable import SeparableMap

__all__ = ["AffineMap", "SeparableMap"]
