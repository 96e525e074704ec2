"""Triangular transport maps: fit one to samples of (y, x), then condition on an observation."""

from . import affine, separable
from .affine import AffineMap, compose
from .pooling import pool_by_admm, pool_by_moments

__all__ = [
    "AffineMap",
    "affine",
    "compose",
    "pool_by_admm",
    "pool_by_moments",
    "separable",
]
