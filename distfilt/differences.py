"""The old place of :func:`distfilt.linalg.central`."""

from .linalg import central as _central

__all__ = ["_central"]
