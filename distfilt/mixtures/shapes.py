"""Means and covariances of mixands that have no weights yet."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..checks import Array, array, count, covariance

__all__ = ["Shapes"]


@dataclass(frozen=True, eq=False)
class Shapes:
    """Mixands before they are weighed.

    Parameters
    ----------
    means : array_like, (S, d)
    covs : array_like, (S, d, d)
        Positive definite.
    source : array_like of int, (S,)
        The own mixand that each came from.
    dropped : int
        How many others were left out because they had no positive definite covariance.

    Examples
    --------
    >>> Shapes([[0.0]], [[[1.0]]], [0]).size
    1
    """

    means: Array
    covs: Array
    source: NDArray[np.intp]
    dropped: int = 0

    def __post_init__(self) -> None:
        m = array(self.means, "means", ("S", "d"))
        if not m.size:
            raise ValueError("means: needs at least one mixand, got none")
        p = covariance(array(self.covs, "covs", (*m.shape, m.shape[1])), "covs")
        at = _indices(self.source, "source")
        if at.shape != m.shape[:1] or at.dtype.kind == "b" or at.min() < 0:
            raise ValueError(f"source: needs {m.shape[0]} indices, got {self.source!r}")
        count(self.dropped, "dropped", at_least=0)
        for name, value in (("means", m), ("covs", p), ("source", at.astype(np.intp))):
            object.__setattr__(self, name, value)

    @property
    def size(self) -> int:
        """Number of mixands, S."""
        return int(self.means.shape[0])

    def select(self, keep: ArrayLike) -> Shapes:
        """Some of the mixands, by a mask or by indices.

        Examples
        --------
        >>> Shapes([[0.0], [1.0]], [[[1.0]], [[2.0]]], [0, 0]).select([1]).means
        array([[1.]])
        """
        at, n = _indices(keep, "keep"), self.size
        mask = at.dtype.kind == "b"
        if at.shape != (n,) if mask else at.size and not -n <= at.min() <= at.max() < n:
            raise ValueError(f"keep: needs a mask of {n}, or indices of {n}, got {keep!r}")
        return Shapes(self.means[at], self.covs[at], self.source[at], self.dropped)


def _indices(value: ArrayLike, name: str) -> NDArray[Any]:
    """A mask or integers, as a vector."""
    try:
        out = np.asarray(value)
    except ValueError:  # lists of different lengths
        raise ValueError(f"{name}: needs a mask or indices, got {value!r}") from None
    if out.dtype.kind not in "biu" or out.ndim != 1 or isinstance(value, np.ma.MaskedArray):
        raise ValueError(f"{name}: needs a mask or indices, got {type(value).__name__} {out.dtype}")
    return out
