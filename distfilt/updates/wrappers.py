"""Wrappers: what can be put around any update, one round another.

``inflated(gated(known_noise), factor=1.02)`` is an update like any other.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import sparse
from scipy.sparse import csgraph
from scipy.special import ndtri

from ..checks import Array, callable_, number
from .door import Update, joined, unchecked
from .missing import Rows, with_missing

__all__ = ["centred", "gated", "inflated", "serial"]

Indices = NDArray[np.intp]


def inflated(update: Update, *, factor: float) -> Update:
    """Multiply the analysis anomalies by a factor: the remedy for a spread that is too small.

    Parameters
    ----------
    update, factor
        Any update; by what its standard deviations grow each time, positive.

    Notes
    -----
    J. L. Anderson, S. L. Anderson, Monthly Weather Review 127 (1999) 2741-2758.

    Examples
    --------
    >>> from distfilt.updates import exact_draws
    >>> x = np.array([[-1.0], [0.0], [0.5], [0.5]])
    >>> wider = inflated(exact_draws, factor=2.0)
    >>> float(wider(x, x, [1.0], [[0.5]], rng=np.random.default_rng(0)).var(ddof=1).round(12))
    1.0
    """
    inner = unchecked(callable_(update, "update"))
    by = number(factor, "factor", above=0)

    def inflate(x: Array, h: Array, y: Array, r: Array, *, rng: np.random.Generator) -> Array:
        after = inner(x, h, y, r, rng=rng)
        centre = after.mean(axis=-2, keepdims=True)
        return np.asarray(centre + by * (after - centre))

    return joined(inflate, update)


def gated(update: Update, *, probability: float = 0.999) -> Update:
    r"""Leave out readings whose innovation is too large to believe; with none left, nothing moves.

    A component passes where :math:`(y^*-\bar h)^2 \le q^2(\hat C_{hh}+R)`, each judged alone, with
    q such that a consistent filter rejects a reading with probability one minus `probability`.

    Parameters
    ----------
    update, probability
        Any update; how likely a good reading passes, between 0 and 1.

    Examples
    --------
    >>> from distfilt.updates import exact_draws
    >>> x = np.array([[-1.0], [0.0], [0.5], [0.5]])
    >>> careful = gated(exact_draws)
    >>> bool((careful(x, x, [90.0], [[0.5]], rng=np.random.default_rng(0)) == x).all())
    True
    """
    callable_(update, "update")
    share = number(probability, "probability", above=0, below=1)
    width = float(ndtri(0.5 + 0.5 * share))

    def gate(x: Array, h: Array, y: Array, r: Array, *, rng: np.random.Generator) -> Array:
        variance = h.var(axis=-2, ddof=1) + np.diagonal(r, axis1=-2, axis2=-1)
        passes = (y - h.mean(axis=-2)) ** 2 <= width**2 * variance
        return with_missing(update, x, h, np.where(passes, y, np.nan), r, rng=rng)

    return joined(gate, update)


class _Centred(np.random.Generator):
    """A generator whose normal draws have mean zero over the members and keep their variance."""

    def __init__(self, source: np.random.Generator) -> None:
        super().__init__(source.bit_generator)
        self.source = source

    def stream(self, seed: list[int], where: Any) -> _Centred:
        """What the wrapped update's own wrappers draw from, centred too."""
        maker = getattr(self.source, "stream", None)
        return _Centred(Rows(seed, (), None) if maker is None else maker(seed, where))

    def standard_normal(self, size: Any = None, *args: Any, **options: Any) -> Any:
        """As the source's, centred along the last axis but one."""
        drawn = self.source.standard_normal(size, *args, **options)
        if np.ndim(drawn) < 2 or drawn.shape[-2] < 2:
            return drawn
        n = drawn.shape[-2]
        return (drawn - drawn.mean(axis=-2, keepdims=True)) * np.sqrt(n / (n - 1))


def centred(update: Update) -> Update:
    """Let an update draw its perturbations with mean zero over the members.

    The mean of the analysis is then free of the draws. :func:`~distfilt.updates.exact_draws` goes
    further and costs a factorisation.

    Parameters
    ----------
    update : callable
        An update that perturbs by ``rng.standard_normal((..., N, m))``, as all of this package do.

    Examples
    --------
    >>> from distfilt.updates import known_noise
    >>> x = np.array([[-1.0], [1.0]])
    >>> quiet = centred(known_noise)
    >>> float(quiet(x, x, [1.0], [[2.0]], rng=np.random.default_rng(0)).mean().round(12))
    0.5
    """
    inner = unchecked(callable_(update, "update"))

    def centre(x: Array, h: Array, y: Array, r: Array, *, rng: np.random.Generator) -> Array:
        return inner(x, h, y, r, rng=_Centred(rng))

    return joined(centre, update)


def serial(update: Update) -> Update:
    """Take independent readings in one after the other.

    Readings are independent where the noise covariance has a zero between them; correlated ones
    stay together. Inside a filter each group meets predictions that are made again from the members
    as they are by then; called alone, the update moves the later predictions along with the
    members, as further components of the state.

    Parameters
    ----------
    update : callable
        Any update; it never sees more readings at once than the largest group, so an agent that
        hears more than it has members can still use :func:`~distfilt.updates.sampled_noise`.

    Returns
    -------
    callable
        An update with one more option, ``predict(members) -> predicted``, which a filter gives.

    Examples
    --------
    >>> from distfilt.updates import exact_draws
    >>> x = np.array([[-1.0], [0.0], [0.5], [0.5]])
    >>> twice = serial(exact_draws)
    >>> seen = np.concatenate([x, x], axis=1)
    >>> after = twice(x, seen, [1.0, 1.0], np.eye(2), rng=np.random.default_rng(0))
    >>> float(after.mean().round(12)), float(after.var(ddof=1).round(12))
    (0.5, 0.25)
    """
    callable_(update, "update")

    def one_by_one(
        x: Array, h: Array, y: Array, r: Array, *, rng: np.random.Generator,
        predict: Callable[[Array], Array] | None = None,
    ) -> Array:
        d = x.shape[-1]
        for k, rows in enumerate(_groups(r)):
            if predict is not None:
                seen = (h if k == 0 else predict(x))[..., rows]
                x = with_missing(update, x, seen, y[..., rows], _block(r, rows), rng=rng)
            else:
                both = np.concatenate([x, h], axis=-1)
                moved = with_missing(
                    update, both, h[..., rows], y[..., rows], _block(r, rows), rng=rng
                )
                x, h = moved[..., :d], moved[..., d:]
        return x

    out = joined(one_by_one, update)
    out.repredicts = True  # type: ignore[attr-defined]
    return out


def _groups(noise: ArrayLike) -> list[Indices]:
    """Indices of readings that are correlated with each other, in the order of their first."""
    linked = (np.asarray(noise) != 0).reshape(-1, *np.shape(noise)[-2:]).any(axis=0)
    labels = csgraph.connected_components(sparse.csr_array(linked), directed=False)[1]
    return [np.flatnonzero(labels == k) for k in dict.fromkeys(labels.tolist())]


def _block(noise: Array, rows: Indices) -> Array:
    return np.asarray(noise[..., rows[:, None], rows])
