"""The door of an update, and readings that are missing.

Every update has the signature ``(ensemble, predicted, observed, noise, *, rng, …) -> ensemble``
and is told four things: the forecast members (..., N, d); what each of them would observe without
noise (..., N, m), on the branch of the observation where a reading wraps; the observation (..., m);
and the covariance of its noise, (m, m) or (..., m, m).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from inspect import signature
from typing import Annotated, Any, TypeVar, cast

import numpy as np

from ..ensembles import Ensemble
from ..linalg import cholesky, leading
from ..validation import (
    Array,
    Indices,
    PositiveDefinite,
    Rng,
    all_finite,
    validated,
)

__all__ = [
    "Update",
    "around",
    "perturb_observations",
    "has_tag",
    "update",
    "with_missing",
]

F = TypeVar("F", bound=Callable[..., Array])

Update = Callable[..., Array]
"""``update(ensemble, predicted, observed, noise, *, rng) -> ensemble``"""


_KINDS = (
    Ensemble,
    Annotated[Array, "... N m"],
    Annotated[Array, "... m"],
    Annotated[PositiveDefinite, "... m m"],
)
"""Of an update's first four arguments, whatever their own annotations say."""


def update(function: F) -> F:
    """Let a function that computes an update check what it is given.

    Parameters
    ----------
    function : callable
        ``function(ensemble, predicted, observed, noise, *, rng, …)`` for float64 arrays that fit,
        with a noise covariance for each ensemble or one for all. The annotations of its options
        are checked too, as :mod:`distfilt.validation` says. In a filter whose runs miss different
        readings normal draws are each run's own where they are asked for all members at once.

    Returns
    -------
    callable
        The same function with checks.

    Raises
    ------
    ValueError
        By the result: if a shape does not fit, a number is not finite, `noise` is not positive
        definite, `rng` is no generator or there is one member only.

    Examples
    --------
    >>> @update
    ... def halfway(ensemble, predicted, observed, noise, *, rng):
    ...     return ensemble + 0.5 * (observed[..., None, :] - predicted)
    >>> halfway(
    ...     [[0.0], [2.0]], [[0.0], [2.0]], [4.0], [[1.0]], rng=np.random.default_rng(0)
    ... )
    array([[2.],
           [3.]])
    """
    if not hasattr(function, "__annotations__"):
        raise ValueError(f"function must be a function, got {type(function).__name__}")
    names = list(signature(function).parameters)[:4]
    function.__annotations__ |= dict(zip(names, _KINDS, strict=True)) | {"rng": Rng}

    def with_leading_axes(**given: Any) -> Array:
        four = {name: given[name] for name in names if name in given}
        return function(**given | (_related(four) if len(four) == len(names) else {}))

    made: Any = validated(function, call=with_leading_axes)
    made.stacks = True
    return cast(F, made)


def _related(four: dict[str, Array]) -> dict[str, Array]:
    """What the arguments become whose leading axes have to fit the ensemble's."""
    x, h, y, r = four.values()
    lead = x.shape[:-2]
    own = (h.shape[:-2], y.shape[:-1], r.shape[:-2])
    if own[0] == own[1] == lead and own[2] in ((), lead):
        return {}
    for name, given in zip(list(four)[1:], own, strict=True):
        if leading(lead, given, name) != lead:
            raise ValueError(f"{name} must have leading axes {lead}, got {given}")
    tails = zip(list(four)[1:3], (2, 1), strict=True)
    return {n: np.broadcast_to(four[n], (*lead, *four[n].shape[-k:])) for n, k in tails}


def has_tag(update: Update, what: str) -> bool:
    """What an update says of itself: that it ``stacks``, ``repredicts``, takes gaps ``whole``.

    One that stacks can update ensembles with a noise covariance of their own each in one call, as
    every update of this package does; a plain function gets one agent's at a time.

    >>> has_tag(print, "stacks")
    False
    """
    return bool(
        getattr(update.func if isinstance(update, partial) else update, what, False)
    )


def around(inner: Update) -> Callable[[F], F]:
    """The door of a wrapper, which says of itself what the update says that it wraps.

    >>> has_tag(around(print)(lambda x, h, y, r, *, rng: x), "stacks")
    False
    """

    def made(wrapper: F) -> F:
        out: Any = update(wrapper)
        out.stacks = has_tag(inner, "stacks")
        out.whole = has_tag(inner, "whole")
        return cast(F, out)

    return made


def perturb_observations(
    predicted: Array, noise: Array, rng: Rng, *, centred: bool = False
) -> Array:
    """Predictions with a draw of the noise each, (..., N, m); with N - 1 in the denominator its
    sample covariance is the noise's on average, centred or not."""
    drawn = rng.standard_normal(predicted.shape)
    if centred:
        drawn -= drawn.mean(axis=-2, keepdims=True)
    out = drawn @ np.ascontiguousarray(cholesky(noise).mT)
    return np.asarray(np.add(out, predicted, out=out))


def with_missing(
    update: Update,
    ensemble: Array,
    predicted: Array,
    observed: Array,
    noise: Array,
    *,
    rng: Rng,
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
    >>> from distfilt.updates import enkf_exact
    >>> x = np.array([[-1.0], [0.0], [0.5], [0.5]])
    >>> seen = np.concatenate([x, x], axis=1)
    >>> after = with_missing(
    ...     enkf_exact,
    ...     x,
    ...     seen,
    ...     np.array([1.0, np.nan]),
    ...     0.5 * np.eye(2),
    ...     rng=np.random.default_rng(0),
    ... )
    >>> float(after.mean().round(12))
    0.5
    """
    inner = update
    lead = observed.shape[:-1]
    m = observed.shape[-1]
    # What is drawn for an ensemble depends on its place and on how many readings it has, not on
    # what others miss: each number of readings has a stream, which is drawn from for all places.
    # As words of 32 bits, which seeds are made of: 63 bits each, as `integers` would draw them.
    a, b = rng.bit_generator.random_raw(2).tolist()
    base = [a // 2 % 2**32, a >> 33, b // 2 % 2**32, b >> 33]
    if all_finite(observed) and all_finite(predicted):
        return inner(
            ensemble, predicted, observed, noise, rng=_stream(rng, base, m, lead)
        )
    present = ~np.isnan(observed) & ~np.isnan(predicted).any(axis=-2)
    if has_tag(update, "whole"):
        known = np.where(present, observed, np.nan)
        stream = _stream(rng, base, m, lead)
        return inner(ensemble, predicted, known, noise, rng=stream)
    flat = present.reshape(-1, m)
    aim = observed.reshape(-1, m)
    rows, seen = (a.reshape(-1, *a.shape[-2:]) for a in (ensemble, predicted))
    cov = (
        np.broadcast_to(noise, (*lead, m, m)).reshape(-1, m, m)
        if noise.ndim > 2
        else noise
    )
    out = rows.copy()
    for pattern in np.unique(flat, axis=0):
        keep = np.flatnonzero(pattern)
        if not keep.size:
            continue
        where = np.flatnonzero((flat == pattern).all(axis=1))
        part = (
            cov[np.ix_(where, keep, keep)] if cov.ndim > 2 else cov[np.ix_(keep, keep)]
        )
        stream = _stream(rng, base, keep.size, lead, where)
        given = rows[where], seen[where][..., keep], aim[where][:, keep]
        out[where] = inner(*given, part, rng=stream)
    return np.asarray(out.reshape(ensemble.shape))


def _stream(
    rng: Rng, base: list[int], m: int, lead: tuple[int, ...], where: Any = ...
) -> Rng:
    """A stream of draws for a batch, or its rows `where`; of rows of rows their places stay."""
    bits = np.random.PCG64(
        np.random.SeedSequence(np.array([*base, m], dtype=np.uint32))
    )
    if isinstance(rng, Rows):
        return Rows(bits, rng.lead, rng.where[where])
    return Rng(bits) if where is ... else Rows(bits, lead, where)


class Rows(Rng):
    """Normal draws for all ensembles of a batch (*lead), of which those in `where` are asked for.

    `where` counts them flat. So two ensembles that miss different readings draw apart:

    >>> def own(x, h, y, r, *, rng):
    ...     return x + rng.normal(size=x.shape)
    >>> gaps = np.array([[1.0, np.nan], [np.nan, 1.0]])
    >>> a, b = with_missing(
    ...     own,
    ...     np.zeros((2, 3, 1)),
    ...     np.zeros((2, 3, 2)),
    ...     gaps,
    ...     np.eye(2),
    ...     rng=np.random.default_rng(0),
    ... )
    >>> bool((a != b).all())
    True
    """

    def __init__(self, bits: Any, lead: tuple[int, ...], where: Indices) -> None:
        super().__init__(bits)
        self.lead = lead
        self.where = where
        self.some = where.size != math.prod(lead)

    def normal(self, loc: Any = 0.0, scale: Any = 1.0, size: Any = None) -> Any:
        """As numpy's, by standard normal draws."""
        return loc + scale * self.standard_normal(size)

    def standard_normal(self, size: Any = None, *args: Any, **options: Any) -> Any:
        """As numpy's, but of a batch's rows those that are asked for."""
        if not (
            self.some and np.iterable(size) and tuple(size)[:1] == self.where.shape
        ):
            return super().standard_normal(size, *args, **options)
        rest = tuple(size)[1:]
        drawn = super().standard_normal((*self.lead, *rest), *args, **options)
        return drawn.reshape(-1, *rest)[self.where]
