"""Any number of agents' filters in the form that their model allows: one basis, or each its own."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ..checks import Array, array, callable_, instance
from .gain import LowRank, Move, Shared, low_rank_step, shared_moved, shared_start, shared_step

__all__ = ["Separate", "filters_start", "filters_step"]


@dataclass(frozen=True, eq=False)
class Separate:
    """Filters of one density that share nothing: what :class:`Shared` is for Q = 0, for Q > 0.

    Parameters
    ----------
    filters : tuple of LowRank
        One or more, on the same grid.

    Examples
    --------
    >>> state = Separate((LowRank(np.ones(3), np.eye(3)[:, :2]),) * 5)
    >>> state.estimates.shape, state.variances[0]
    ((5, 3), array([1., 1., 0.]))
    """

    filters: tuple[LowRank, ...]

    def __post_init__(self) -> None:
        if not isinstance(self.filters, tuple | list):
            raise ValueError(f"filters: needs a tuple, got {type(self.filters).__name__}")
        sizes = {instance(f, "filters", LowRank).mean.size for f in self.filters}
        if len(sizes) != 1:
            raise ValueError(f"filters: needs one or more of one size, got sizes {sorted(sizes)}")

    @property
    def estimates(self) -> Array:
        """Every filter's density, (F, n)."""
        return np.stack([f.mean for f in self.filters])

    @property
    def variances(self) -> Array:
        """Diagonal of every filter's covariance, (F, n)."""
        return np.stack([(f.factor**2).sum(axis=-1) for f in self.filters])


def filters_start(basis: ArrayLike, base: ArrayLike, *, exact: bool) -> Shared | Separate:
    """Filters before their first step: prior means `base` (F, n), prior covariance S Sᵀ.

    Parameters
    ----------
    basis : array_like, (n, r)
        S.
    base : array_like, (F, n)
    exact : bool
        Whether the model is, so that Q = 0 and one basis serves all.

    Examples
    --------
    >>> type(filters_start(np.eye(2), np.ones((3, 2)), exact=False)).__name__
    'Separate'
    """
    if instance(exact, "exact", bool):
        return shared_start(basis, base)
    s = array(basis, "basis", ("n", "r")).copy()
    return Separate(tuple(LowRank(m, s) for m in array(base, "base", ("F", s.shape[0])).copy()))


def filters_step(
    filters: Shared | Separate, move: Move, observed: ArrayLike, noise: Move, dt: float, *,
    process: ArrayLike | None = None,
) -> Shared | Separate:
    """The filters after the model's step and one measurement each.

    Parameters
    ----------
    filters : Shared or Separate
        As :func:`filters_start` or an earlier step made them.
    move : callable
        Φ on rows (..., n), as :meth:`FokkerPlanck.solver` gives it.
    observed : array_like, (F, n)
    noise : callable
        The strength R of each filter's noise, (F, n), from the forecast densities, (F, n);
        infinite where a filter measures nothing.
    dt : float
        In s.
    process : array_like, (n, q), optional
        A factor of Q, per root second, for filters of a model that is not exact.

    Examples
    --------
    >>> filters = filters_start(np.eye(2), np.zeros((1, 2)), exact=True)
    >>> after = filters_step(filters, lambda p: p, [[1.0, 1.0]], lambda p: p + [1.0, 3.0], 1.0)
    >>> after.estimates
    array([[0.5 , 0.25]])
    """
    callable_(noise, "noise")
    if isinstance(filters, Shared):
        if process is not None:
            raise ValueError("process: needs filters of a model that is not exact, got Shared ones")
        moved = shared_moved(filters, move)
        return shared_step(moved, observed, noise(moved.estimates), dt)
    separate = instance(filters, "filters", Separate)
    before = separate.estimates
    r = array(noise(callable_(move, "move")(before)), "noise", before.shape, finite=False)
    y = array(observed, "observed", before.shape)
    return Separate(tuple(
        low_rank_step(f, move, y[i], r[i], dt, process=process)
        for i, f in enumerate(separate.filters)
    ))
