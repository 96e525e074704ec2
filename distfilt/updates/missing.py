"""Readings that are missing: the same update with their rows left out."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..checks import Array, callable_
from .door import Update, unchecked

__all__ = ["Rows", "with_missing"]


def with_missing(
    update: Update, ensemble: Array, predicted: Array, observed: Array, noise: Array, *,
    rng: np.random.Generator,
) -> Array:
    """Apply an update where NaN marks a missing component; without any reading nothing moves.

    Ensembles that miss the same components are updated together, so a batch costs one call for
    each pattern.

    Parameters
    ----------
    update : callable
        ``update(ensemble, predicted, observed, noise, *, rng)``; its checks are left out.
    ensemble : ndarray, (..., N, d)
    predicted : ndarray, (..., N, m)
        NaN for every member where a prediction does not exist; it is a missing reading too.
    observed : ndarray, (..., m)
        NaN where a component is missing.
    noise : ndarray, (m, m) or (..., m, m)
    rng : numpy.random.Generator

    Examples
    --------
    >>> from distfilt.updates import exact_draws
    >>> x = np.array([[-1.0], [0.0], [0.5], [0.5]])
    >>> seen = np.concatenate([x, x], axis=1)
    >>> after = with_missing(exact_draws, x, seen, np.array([1.0, np.nan]), 0.5 * np.eye(2),
    ...                      rng=np.random.default_rng(0))
    >>> float(after.mean().round(12))
    0.5
    """
    inner = unchecked(callable_(update, "update"))
    m = observed.shape[-1]
    lead = observed.shape[:-1]
    # What is drawn for an ensemble depends on its place and on how many readings it has, not on
    # what others miss: each number of readings has a stream, which is drawn from for all places.
    base = [int(b) for b in rng.integers(2**63, size=2)]
    present, gone = ~np.isnan(observed), np.isnan(predicted)
    if gone.any():
        present = present & ~gone.any(axis=-2)
    if present.all():
        stream = _stream(rng, [*base, m], lead, None)
        return inner(ensemble, predicted, observed, noise, rng=stream)
    flat = present.reshape(-1, m)
    rows = ensemble.reshape(-1, *ensemble.shape[-2:])
    seen = predicted.reshape(-1, *predicted.shape[-2:])
    aim = observed.reshape(-1, m)
    cov = noise
    if noise.ndim > 2:
        cov = np.broadcast_to(noise, (*lead, m, m)).reshape(-1, m, m)
    out = rows.copy()
    for pattern in np.unique(flat, axis=0):
        keep = np.flatnonzero(pattern)
        if not keep.size:
            continue
        where = np.flatnonzero((flat == pattern).all(axis=1))
        part = cov[np.ix_(where, keep, keep)] if cov.ndim > 2 else cov[np.ix_(keep, keep)]
        stream = _stream(rng, [*base, keep.size], lead, where)
        out[where] = inner(
            rows[where], seen[where][..., keep], aim[where][:, keep], part, rng=stream
        )
    return np.asarray(out.reshape(ensemble.shape))


def _stream(
    rng: np.random.Generator, seed: list[int], lead: tuple[int, ...], where: Any
) -> np.random.Generator:
    """A stream of draws for the rows `where` (all if None) of a batch."""
    maker = getattr(rng, "stream", None)
    if maker is not None:
        return maker(seed, where)  # type: ignore[no-any-return]
    return Rows(seed, lead, where)


class Rows(np.random.Generator):
    """Normal draws for all ensembles of a batch (*lead), of which those in `where` are asked for.

    `where` counts them flat; None stands for all.
    """

    def __init__(self, seed: list[int], lead: tuple[int, ...], where: Any) -> None:
        super().__init__(np.random.PCG64(np.random.SeedSequence(seed)))
        self.lead, self.where = lead, where

    def stream(self, seed: list[int], where: Any) -> Rows:
        """Another stream for these ensembles, or for some of them: their places stay."""
        if where is None:
            return Rows(seed, self.lead, self.where)
        return Rows(seed, self.lead, where if self.where is None else self.where[where])

    def standard_normal(self, size: Any = None, *args: Any, **options: Any) -> Any:
        """As numpy's, but of a batch's rows those that are asked for."""
        if self.where is None or not np.iterable(size) or tuple(size)[:1] != self.where.shape:
            return super().standard_normal(size, *args, **options)
        rest = tuple(size)[1:]
        drawn = super().standard_normal((*self.lead, *rest), *args, **options)
        return drawn.reshape(-1, *rest)[self.where]
