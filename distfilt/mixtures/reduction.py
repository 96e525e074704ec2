"""Fewer mixands: by the cheapest merger, by relevance to another's belief, by rank."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from functools import cache
from types import FunctionType
from typing import Annotated, Any, Literal, cast

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import qr

from ..doors import Array, Bounds, Count, Mask, NonNegative, door, needed, unchecked
from ..linalg import symmetrise
from .divergence import gaussian_divergences
from .gaussian import GaussianMixture
from .mixands import Shapes

__all__ = [
    "cross_relevance", "kept_by_relevance", "merge_costs", "pivoted_qr", "runnalls", "two_stage",
]  # fmt: skip

Engine = Literal["auto", "numba", "numpy"]


@door
def runnalls(mixture: GaussianMixture, size: Count, *, engine: Engine = "auto") -> GaussianMixture:
    r"""Merge, pair by pair, the mixands whose merger may lose least, until `size` are left.

    Merging i and j keeps their weight, mean and covariance. The loss of information is at most

    .. math:: B_{ij}=\tfrac12\bigl[(w_i+w_j)\log|\mathbf P_{ij}|
        -w_i\log|\mathbf P_i|-w_j\log|\mathbf P_j|\bigr],

    A. Runnalls, IEEE Transactions on Aerospace and Electronic Systems 43 (2007) 989-999. Costs are
    kept between mergers, so that L mixands cost about L²/2 determinants, and the memory is 8 L²
    bytes; use :func:`two_stage` beyond some thousands.

    Parameters
    ----------
    mixture : GaussianMixture
    size : int
        How many to keep; a mixture that is no larger is returned as it is.
    engine : {"auto", "numba", "numpy"}
        What computes; "auto" takes numba where it is installed (the extra `speed`). Same merges,
        other speed.

    Examples
    --------
    >>> three = GaussianMixture([0.25, 0.25, 0.5], [[0.0], [0.2], [9.0]], [[[1.0]]] * 3)
    >>> runnalls(three, 2).means.round(2)
    array([[0.1],
           [9. ]])
    """
    if mixture.size <= size:
        return mixture
    w, m, p, root = _whitened(mixture)
    alive = _merging(engine)(w, m, p, size)
    means = mixture.mean + m[alive] @ root.T
    covs = symmetrise(root @ p[alive] @ root.T)
    return GaussianMixture.unchecked(w[alive] / w[alive].sum(), means, covs)


@door
def merge_costs(mixture: GaussianMixture) -> Array:
    """Runnalls' bound for each pair of mixands, (L, L); zero on the diagonal.

    Examples
    --------
    >>> two = GaussianMixture([0.5, 0.5], [[-1.0], [1.0]], [[[1.0]], [[1.0]]])
    >>> merge_costs(two)[0, 1].round(6) == np.round(0.5 * np.log(2), 6)
    np.True_
    """
    w, m, p, _ = _whitened(mixture)
    dets, every = np.linalg.slogdet(p)[1], np.arange(mixture.size)
    return np.stack([_costs(w, m, p, dets, i, every) for i in range(mixture.size)])


@door
def two_stage(mixture: GaussianMixture, size: Count, *, heaviest: Count = 400) -> GaussianMixture:
    """Runnalls' reduction for thousands of mixands: the heaviest absorb the others first.

    Each other mixand joins the heavy one with which its merger costs least, all at once; then
    :func:`runnalls` goes on. Mean and covariance of the whole mixture are kept.

    Parameters
    ----------
    mixture : GaussianMixture
    size : int
        How many to keep.
    heaviest : int
        How many go into the second stage, at least `size`.

    Examples
    --------
    >>> three = GaussianMixture([0.5, 0.4, 0.1], [[0.0], [9.0], [8.0]], [[[1.0]]] * 3)
    >>> two_stage(three, 2, heaviest=2).means.round(2)
    array([[0. ],
           [8.8]])
    """
    if heaviest < size:
        raise ValueError(f"heaviest: needs an integer of at least size, {size}, got {heaviest}")
    if mixture.size <= heaviest:
        return unchecked(runnalls)(mixture, size)
    w, m, p, _ = _whitened(mixture)
    order = np.argsort(-w, kind="stable")
    heavy, rest = order[:heaviest], order[heaviest:]
    dets = np.linalg.slogdet(p)[1]
    labels = np.empty(w.size, dtype=np.intp)
    labels[heavy] = np.arange(heaviest)
    labels[rest] = [_costs(w, m, p, dets, i, heavy).argmin() for i in rest]
    return unchecked(runnalls)(_grouped(mixture, labels), size)


@door
def cross_relevance(mixture: GaussianMixture, other: GaussianMixture) -> Array:
    r"""The matrix (38)-(39): :math:`w_q D_{KL}(\mathcal N_q\|\mathcal N_r)`, (L, L').

    Divergences that rounding makes negative are zero.

    Parameters
    ----------
    mixture, other : GaussianMixture
        Of the same dimension: two agents' beliefs about the target.

    Examples
    --------
    >>> one = GaussianMixture.gaussian([0.0], [[1.0]])
    >>> cross_relevance(one, GaussianMixture.gaussian([2.0], [[1.0]]))
    array([[2.]])
    """
    return mixture.weights[:, None] * _divergences(mixture, other)


@door
def kept_by_relevance(
    mixture: GaussianMixture, other: GaussianMixture, *,
    threshold: Annotated[float, Bounds(above=1)], gate: NonNegative = 0.5,
    floor: NonNegative = 1e-4,
) -> GaussianMixture:
    r"""Merge into one the mixands that overlap with none of another's: the KLD rule (40)-(41).

    With :math:`\delta_q=\min_r w_qD_{KL}(\mathcal N_q\|\mathcal N_r)` the mixands with
    :math:`\delta_q>\epsilon\,\delta_{\min}` are merged. As printed, a mixand that both agents
    share makes :math:`\delta_{\min}` zero, or negative by rounding, and the mixture collapses.
    Three guards: :math:`\delta_{\min}` is at least `floor`; a mixand is only merged if its
    unweighted divergence exceeds `gate`; and the most relevant mixand is never merged.

    Parameters
    ----------
    mixture, other : GaussianMixture
        Of the same dimension.
    threshold : float
        The factor :math:`\epsilon`, above 1.
    gate, floor : float
        At least 0, in nats.

    Examples
    --------
    >>> mine = GaussianMixture([0.4, 0.3, 0.3], [[0.0], [8.0], [9.0]], [[[1.0]]] * 3)
    >>> theirs = GaussianMixture.gaussian([0.5], [[1.0]])
    >>> kept_by_relevance(mine, theirs, threshold=3.0).means
    array([[0. ],
           [8.5]])
    """
    nearest = _divergences(mixture, other).min(axis=1)
    delta = mixture.weights * nearest
    out = (delta > threshold * max(float(delta.min()), floor)) & (nearest > gate)
    out[np.argmin(delta)] = False
    labels = np.where(out, mixture.size, np.arange(mixture.size))
    return _grouped(mixture, np.unique(labels, return_inverse=True)[1])


@door
def pivoted_qr(
    shapes: Shapes, *, size: Count | None = None,
    tolerance: Annotated[float, Bounds(above=0, below=1)] | None = None,
    rest: Literal["merge", "drop"] = "merge",
) -> Shapes:
    r"""Keep the mixands that a pivoted QR decomposition of (33) finds independent, (42)-(43).

    Parameters
    ----------
    shapes : Shapes
    size : int, optional
        How many to have in the end.
    tolerance : float, optional
        Or :math:`\delta` in (0, 1): those whose pivot is at least :math:`\delta|U_{11}|`.
    rest : {"merge", "drop"}
        Merge the others into one, with equal weights since they have none yet; or drop them.

    Examples
    --------
    >>> three = Shapes([[0.0], [1e-6], [9.0]], [[[1.0]]] * 3, [0, 0, 0])
    >>> pivoted_qr(three, tolerance=0.1, rest="drop").means
    array([[0.],
           [9.]])
    """
    if (size is None) == (tolerance is None):
        raise ValueError("size: needs either a size or a tolerance, got both or none")
    mixture = shapes.equally_weighed()
    logs = unchecked(mixture.component_log_densities)(shapes.means) - mixture.log_peaks
    upper, order = qr(np.exp(logs), mode="r", pivoting=True)
    pivots = np.abs(np.diagonal(upper))
    kept = int((pivots >= (tolerance or 0.0) * pivots[0]).sum())
    kept = kept if size is None else min(size, shapes.size)
    if size is not None and rest == "merge" and 1 < kept < shapes.size:
        kept -= 1
    select = unchecked(shapes.select)
    first = select(np.sort(order[:kept]))
    if rest == "drop" or kept == shapes.size:
        return first
    lost = select(order[kept:])
    one = lost.equally_weighed()
    return Shapes.unchecked(
        np.concatenate([first.means, one.mean[None]]), np.concatenate([first.covs, one.cov[None]]),
        np.append(first.source, lost.source[0]), shapes.dropped,
    )  # fmt: skip


def _divergences(mixture: GaussianMixture, other: GaussianMixture) -> Array:
    if other.dim != mixture.dim:
        raise ValueError(f"other: needs dimension {mixture.dim}, got {other.dim}")
    return gaussian_divergences(mixture.means, mixture.covs, other.means, other.covs)


def _whitened(mixture: GaussianMixture) -> tuple[Array, Array, Array, Array]:
    """Copies in the frame of the global moments, where the costs are the same and well scaled."""
    root = np.linalg.cholesky(mixture.cov)
    white = np.linalg.solve(root, np.eye(mixture.dim))
    return (
        mixture.weights.copy(),
        np.ascontiguousarray((mixture.means - mixture.mean) @ white.T),
        np.ascontiguousarray(symmetrise(white @ mixture.covs @ white.T)),
        np.asarray(root),
    )


def _costs(w: Array, m: Array, p: Array, dets: Array, i: Any, others: NDArray[np.intp]) -> Array:
    """Runnalls' bound of mixand i with others; a pair without weight costs nothing."""
    total = w[i] + w[others]
    a = np.divide(w[i], total, out=np.full(total.shape, 0.5), where=total > 0)
    gap = m[others] - m[i]
    both = a[:, None, None] * p[i] + (1 - a)[:, None, None] * p[others]
    both += (a * (1 - a))[:, None, None] * gap[:, :, None] * gap[:, None, :]
    bound = 0.5 * (total * np.linalg.slogdet(both)[1] - w[i] * dets[i] - w[others] * dets[others])
    return np.asarray(np.where(others == i, 0.0, bound))


@cache
def _merging(engine: Engine) -> Callable[..., Mask]:
    """What merges; "auto" takes numba where it is installed."""
    if engine == "numpy" or (engine == "auto" and importlib.util.find_spec("numba") is None):
        return _merged
    compiled = needed("numba", "speed").njit(cache=True)
    # The same function, with the other way to compute a row: numba keeps it between processes
    # only if that is a global name.
    names = globals() | {"_costs": compiled(_costs_in_loops)}
    return cast(Callable[..., Mask], compiled(FunctionType(_merged.__code__, names)))


def _costs_in_loops(w: Any, m: Any, p: Any, dets: Any, i: Any, others: Any) -> Any:
    """As :func:`_costs`, for numba: each merged covariance is formed and factored in one pass."""
    d = m.shape[1]
    lower, out = np.empty((d, d)), np.zeros(others.size)
    for k, j in enumerate(others):
        total = w[i] + w[j]
        if total <= 0.0 or i == j:
            continue
        a, b = w[i] / total, w[j] / total
        one, other, gap = p[i], p[j], np.sqrt(a * b) * (m[i] - m[j])
        log_det = 0.0
        for r in range(d):
            for c in range(r):
                s = a * one[r, c] + b * other[r, c] + gap[r] * gap[c]
                for e in range(c):
                    s -= lower[r, e] * lower[c, e]
                lower[r, c] = s * lower[c, c]
            s = a * one[r, r] + b * other[r, r] + gap[r] ** 2
            for e in range(r):
                s -= lower[r, e] ** 2
            lower[r, r] = 1.0 / np.sqrt(s)  # the reciprocal, so that columns need no division
            log_det += np.log(s)
        out[k] = 0.5 * (total * log_det - w[i] * dets[i] - w[j] * dets[j])
    return out


def _merged(w: Any, m: Any, p: Any, size: Any) -> Any:
    """Merge the cheapest pair until `size` mixands are left, in place; which are left."""
    n = w.size
    every, alive = np.arange(n), np.full(n, True)
    dets = np.array([np.linalg.slogdet(p[i])[1] for i in range(n)])
    table, best, nearest = np.full((n, n), np.inf), np.full(n, np.inf), np.zeros(n, np.int64)
    for k in range(n - 1):
        table[k, k + 1 :] = _costs(w, m, p, dets, k, every[k + 1 :])
    searched = every[:-1]
    for _ in range(n - size):
        for k in searched:
            nearest[k] = np.argmin(table[k])
            best[k] = table[k, nearest[k]]
        # The first of the pairs that cost the same, so that rounding does not choose.
        limit = best.min() + 1e-12 + 1e-9 * abs(best.min())
        i = np.argmax(best <= limit)
        j = np.argmax(table[i] <= limit)
        total = w[i] + w[j]
        a = w[i] / total if total > 0 else 0.5
        gap = m[i] - m[j]
        p[i] = a * p[i] + (1 - a) * p[j] + a * (1 - a) * np.outer(gap, gap)
        m[i] = a * m[i] + (1 - a) * m[j]
        w[i], w[j], alive[j], best[j] = total, 0.0, False, np.inf
        table[j, :] = table[:, j] = np.inf
        dets[i] = np.linalg.slogdet(p[i])[1]
        others = every[alive & (every != i)]
        row = _costs(w, m, p, dets, i, others)
        below = others < i
        table[others[below], i] = row[below]
        table[i, others[~below]] = row[~below]
        # Only rows that lost their neighbour, and the merged one, are searched again.
        searched = np.flatnonzero(alive & ((nearest == i) | (nearest == j) | (every == i)))
        nearest = np.where(table[:, i] < best, i, nearest)
        best = np.minimum(table[:, i], best)
    return alive


def _grouped(mixture: GaussianMixture, labels: NDArray[np.intp]) -> GaussianMixture:
    """Merge the mixands of equal label, keeping each group's weight, mean and covariance."""
    groups = int(labels.max()) + 1
    w = np.asarray(np.bincount(labels, weights=mixture.weights), dtype=np.float64)
    sizes = np.bincount(labels)
    total = w[labels]
    share = np.divide(mixture.weights, total, out=1.0 / sizes[labels], where=total > 0)
    means = np.zeros((groups, mixture.dim))
    np.add.at(means, labels, share[:, None] * mixture.means)
    gap = mixture.means - means[labels]
    covs = np.zeros((groups, mixture.dim, mixture.dim))
    spread = mixture.covs + gap[:, :, None] * gap[:, None, :]
    np.add.at(covs, labels, share[:, None, None] * spread)
    return GaussianMixture.unchecked(w, means, symmetrise(covs))
