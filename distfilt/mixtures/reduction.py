"""Fewer mixands: by the cheapest merger, by relevance to another's belief, by rank, by weight."""

from __future__ import annotations

import importlib.util

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import qr

from ..checks import Array, choice, count, instance, needed, number
from .divergence import gaussian_divergences
from .gaussian import GaussianMixture, symmetric, trusted
from .shapes import Shapes

__all__ = [
    "cross_relevance", "kept_by_relevance", "merge_costs", "pivoted_qr", "prune", "runnalls",
    "two_stage",
]

ENGINES = ("auto", "numba", "numpy")


def runnalls(mixture: GaussianMixture, size: int, *, engine: str = "auto") -> GaussianMixture:
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
    n = count(size, "size")
    how = choice(engine, "engine", ENGINES)
    if instance(mixture, "mixture", GaussianMixture).size <= n:
        return mixture
    if how == "auto":
        how = "numba" if importlib.util.find_spec("numba") is not None else "numpy"
    w, m, p, root = _whitened(mixture)
    alive = np.ones(w.size, dtype=bool)
    if how == "numba":
        needed("numba", "speed")
        from . import _merging

        _merging.reduce(w, m, p, alive, n)
    else:
        _reduce_by_rows(w, m, p, alive, n)
    means = mixture.moments()[0] + m[alive] @ root.T
    return trusted(w[alive] / w[alive].sum(), means, symmetric(root @ p[alive] @ root.T))


def merge_costs(mixture: GaussianMixture) -> Array:
    """Runnalls' bound for each pair of mixands, (L, L); zero on the diagonal.

    Examples
    --------
    >>> two = GaussianMixture([0.5, 0.5], [[-1.0], [1.0]], [[[1.0]], [[1.0]]])
    >>> merge_costs(two)[0, 1].round(6) == np.round(0.5 * np.log(2), 6)
    np.True_
    """
    w, m, p, _ = _whitened(instance(mixture, "mixture", GaussianMixture))
    dets = np.linalg.slogdet(p)[1]
    return np.stack([_costs(w, m, p, dets, i, np.arange(w.size)) for i in range(w.size)])


def prune(mixture: GaussianMixture, least: float) -> GaussianMixture:
    """Drop the mixands that weigh less than `least`; the heaviest always stays.

    Parameters
    ----------
    mixture : GaussianMixture
    least : float
        In [0, 1).

    Examples
    --------
    >>> two = GaussianMixture([0.999, 0.001], [[0.0], [1.0]], [[[1.0]], [[1.0]]])
    >>> prune(two, 0.01).size
    1
    """
    limit = number(least, "least", at_least=0, below=1)
    w = instance(mixture, "mixture", GaussianMixture).weights
    keep = (w >= limit) & (w > 0)
    keep[np.argmax(w)] = True
    return trusted(w[keep] / w[keep].sum(), mixture.means[keep], mixture.covs[keep])


def two_stage(mixture: GaussianMixture, size: int, *, heaviest: int = 400) -> GaussianMixture:
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
    n = count(size, "size")
    top = count(heaviest, "heaviest", at_least=n)
    if instance(mixture, "mixture", GaussianMixture).size <= top:
        return runnalls(mixture, n)
    w, m, p, _ = _whitened(mixture)
    order = np.argsort(-w, kind="stable")
    heavy, rest = order[:top], order[top:]
    dets = np.linalg.slogdet(p)[1]
    joins = np.concatenate([
        np.stack([_costs(w, m, p, dets, i, heavy) for i in block]).argmin(axis=1)
        for block in np.array_split(rest, max(1, rest.size // 256))
    ])
    labels = np.empty(w.size, dtype=np.intp)
    labels[heavy], labels[rest] = np.arange(top), joins
    return runnalls(_grouped(mixture, labels), n)


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
    _same_dim(mixture, other)
    return mixture.weights[:, None] * gaussian_divergences(
        mixture.means, mixture.covs, other.means, other.covs
    )


def kept_by_relevance(
    mixture: GaussianMixture,
    other: GaussianMixture,
    *,
    threshold: float,
    gate: float = 0.5,
    floor: float = 1e-4,
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
    _same_dim(mixture, other)
    eps = number(threshold, "threshold", above=1)
    far = number(gate, "gate", at_least=0)
    least = number(floor, "floor", at_least=0)
    nearest = gaussian_divergences(
        mixture.means, mixture.covs, other.means, other.covs
    ).min(axis=1)
    delta = mixture.weights * nearest
    out = (delta > eps * max(float(delta.min()), least)) & (nearest > far)
    out[np.argmin(delta)] = False
    if out.sum() < 2:
        return mixture
    labels = np.where(out, mixture.size, np.arange(mixture.size))
    return _grouped(mixture, np.unique(labels, return_inverse=True)[1])


def pivoted_qr(
    shapes: Shapes, *, size: int | None = None, tolerance: float | None = None,
    rest: str = "merge",
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
    instance(shapes, "shapes", Shapes)
    choice(rest, "rest", ("merge", "drop"))
    if (size is None) == (tolerance is None):
        raise ValueError("size: needs either a size or a tolerance, got both or none")
    mixture = trusted(np.full(shapes.size, 1 / shapes.size), shapes.means, shapes.covs)
    values = np.exp(mixture._components(shapes.means) - mixture.log_peaks)
    upper, order = qr(values, mode="r", pivoting=True)
    pivots = np.abs(np.diagonal(upper))
    if tolerance is not None:
        limit = number(tolerance, "tolerance", above=0, below=1)
        kept = int((pivots >= limit * pivots[0]).sum())
    else:
        kept = min(count(size, "size"), shapes.size)
        kept -= rest == "merge" and 1 < kept < shapes.size
    keep = np.sort(order[:kept])
    if rest == "drop" or kept == shapes.size:
        return shapes.select(keep)
    lost = order[kept:]
    mean, cov = trusted(
        np.full(lost.size, 1 / lost.size), shapes.means[lost], shapes.covs[lost]
    ).moments()
    first = shapes.select(keep)
    return Shapes(
        np.concatenate([first.means, mean[None]]), np.concatenate([first.covs, cov[None]]),
        np.append(first.source, shapes.source[lost[0]]), shapes.dropped,
    )


def _same_dim(mixture: GaussianMixture, other: GaussianMixture) -> None:
    instance(mixture, "mixture", GaussianMixture)
    if instance(other, "other", GaussianMixture).dim != mixture.dim:
        raise ValueError(f"other: needs dimension {mixture.dim}, got {other.dim}")


def _whitened(mixture: GaussianMixture) -> tuple[Array, Array, Array, Array]:
    """Copies in the frame of the global moments, where the costs are the same and well scaled."""
    mean, cov = mixture.moments()
    root = np.linalg.cholesky(cov)
    white = np.linalg.solve(root, np.eye(mixture.dim))
    return (
        mixture.weights.copy(),
        np.ascontiguousarray((mixture.means - mean) @ white.T),
        np.ascontiguousarray(symmetric(white @ mixture.covs @ white.T)),
        np.asarray(root),
    )


def _costs(
    w: Array, m: Array, p: Array, dets: Array, i: int, others: NDArray[np.intp]
) -> Array:
    """Runnalls' bound of mixand i with others; a pair without weight costs nothing."""
    total = w[i] + w[others]
    a = np.divide(w[i], total, out=np.full(total.shape, 0.5), where=total > 0)
    gap = m[others] - m[i]
    both = a[:, None, None] * p[i] + (1 - a)[:, None, None] * p[others]
    both += (a * (1 - a))[:, None, None] * gap[:, :, None] * gap[:, None, :]
    bound = 0.5 * (total * np.linalg.slogdet(both)[1] - w[i] * dets[i] - w[others] * dets[others])
    return np.asarray(np.where(others == i, 0.0, bound))


def _reduce_by_rows(w: Array, m: Array, p: Array, alive: NDArray[np.bool_], size: int) -> None:
    """As the compiled kernel, a row of costs at a time, in place."""
    n = w.size
    dets = np.linalg.slogdet(p)[1]
    table = np.full((n, n), np.inf)
    for i in range(n - 1):
        table[i, i + 1 :] = _costs(w, m, p, dets, i, np.arange(i + 1, n))
    for _ in range(n - size):
        lowest = table.min()
        first = np.argmax(table <= lowest + 1e-12 + 1e-9 * abs(lowest))
        i, j = (int(k) for k in np.unravel_index(first, table.shape))
        total = w[i] + w[j]
        a = w[i] / total if total > 0 else 0.5
        gap = m[i] - m[j]
        p[i] = a * p[i] + (1 - a) * p[j] + a * (1 - a) * np.outer(gap, gap)
        m[i] = a * m[i] + (1 - a) * m[j]
        w[i], w[j], alive[j] = total, 0.0, False
        table[j, :] = table[:, j] = np.inf
        dets[i] = np.linalg.slogdet(p[i])[1]
        others = np.flatnonzero(alive)
        others = others[others != i]
        row = _costs(w, m, p, dets, i, others)
        table[np.minimum(i, others), np.maximum(i, others)] = row


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
    return trusted(w, means, symmetric(covs))
