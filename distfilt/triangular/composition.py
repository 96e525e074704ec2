"""Conditioning by a triangular map: there with what was predicted, back with what was observed."""

from __future__ import annotations

from typing import Protocol

from numpy.typing import ArrayLike

from ..checks import Array, array

__all__ = ["ConditionalMap", "compose"]


class ConditionalMap(Protocol):
    """What a map offers: z = S(y, x), its inverse in x, the derivative's log-determinant.

    Whatever has these three methods is one:

    >>> class Shift:
    ...     def __call__(self, y, x): return x - y
    ...     def inverse(self, y, z): return z + y
    ...     def log_det(self, y, x): return 0 * x[..., 0]
    >>> import numpy as np
    >>> compose(Shift(), np.array([[1.0], [2.0]]), [[3.0], [5.0]], [10.0])
    array([[12.],
           [13.]])
    """

    def __call__(self, y: ArrayLike, x: ArrayLike) -> Array:
        """Reference samples of members."""

    def inverse(self, y: ArrayLike, z: ArrayLike) -> Array:
        """Members of reference samples."""

    def log_det(self, y: ArrayLike, x: ArrayLike) -> Array:
        """Log-determinant at each member."""


def compose(map_: ConditionalMap, y: ArrayLike, x: ArrayLike, observed: ArrayLike) -> Array:
    r"""The composed map (10) of Grange et al.: from joint samples to samples given the observation.

    .. math:: \mathbf T(\mathbf y,\mathbf x)
        = \mathbf S(\mathbf y^*,\cdot)^{-1}\circ\mathbf S(\mathbf y,\mathbf x)

    Parameters
    ----------
    map_ : ConditionalMap
        The x-block S of a triangular map.
    y, x : array_like, (..., N, m) and (..., N, d)
        Predicted observations, with noise, and members.
    observed : array_like, (..., m)
        What was observed, y*.

    Examples
    --------
    >>> import numpy as np
    >>> from distfilt.triangular import affine
    >>> rng = np.random.default_rng(0)
    >>> x = rng.standard_normal((400, 1))
    >>> y = x + rng.standard_normal((400, 1))
    >>> compose(affine.fit(y, x), y, x, [2.0]).mean().round(1)
    np.float64(1.0)
    """
    if not callable(map_) or not callable(getattr(map_, "inverse", None)):
        raise ValueError(f"map_: needs a map with an inverse, got {type(map_).__name__}")
    members = array(x, "x", (..., "N", "d"))
    seen = array(y, "y", (*members.shape[:-1], "m"))
    target = array(observed, "observed", (..., seen.shape[-1]))
    return map_.inverse(target, map_(seen, members))
