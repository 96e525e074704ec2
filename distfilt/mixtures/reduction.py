"""Fewer mixands: by the cheapest merger, by relevance to another's belief, by rank."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from types import FunctionType
from typing import Annotated, Any, Literal, cast

import numpy as np
from scipy.linalg import qr

from ..linalg import symmetrise
from ..validation import (
    Array,
    Bounds,
    FrozenModel,
    Indices,
    Mask,
    NonNegativeInt,
    PositiveInt,
    check_positive_definite,
    validated,
)
from .gaussian import GaussianMixture

__all__ = [
    "ComponentShapes",
    "cross_relevance",
    "merge_irrelevant",
    "merge_costs",
    "pivoted_qr",
    "runnalls",
]

# Divergence in nats up to which a mixand counts as near another's, whatever its weight.
_GATE = 0.5
# The least that the smallest relevance counts as, in nats.
_FLOOR = 1e-4


@dataclass(frozen=True, eq=False)
class ComponentShapes(FrozenModel):
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
    >>> ComponentShapes([[0.0]], [[[1.0]]], [0]).n_components
    1
    """

    means: Annotated[Array, "s d"]
    covs: Annotated[Array, "s d d", check_positive_definite]
    source: Annotated[Indices, "s", Bounds(at_least=0)]
    dropped: NonNegativeInt = 0

    @property
    def n_components(self) -> int:
        """Number of mixands, S."""
        return int(self.means.shape[0])

    @validated
    def select(self, keep: Annotated[Mask, "self.size"]) -> ComponentShapes:
        """Some of the mixands, by a mask.

        Parameters
        ----------
        keep : array_like of bool, (S,)
            True for those that stay.

        Examples
        --------
        >>> ComponentShapes([[0.0], [1.0]], [[[1.0]], [[2.0]]], [0, 0]).select(
        ...     [False, True]
        ... ).means
        array([[1.]])
        """
        return self.construct(
            self.means[keep], self.covs[keep], self.source[keep], self.dropped
        )

    def with_equal_weights(self) -> GaussianMixture:
        """A mixture of these mixands with equal weights."""
        return GaussianMixture.construct(
            np.full(self.n_components, 1 / self.n_components), self.means, self.covs
        )


@validated
def runnalls(
    mixture: GaussianMixture,
    n_components: PositiveInt,
    *,
    heaviest: PositiveInt | None = None,
) -> GaussianMixture:
    r"""Merge, pair by pair, the mixands whose merger may lose least, until `size` are left.

    Merging i and j keeps their weight, mean and covariance. The loss of information is at most

    .. math:: B_{ij}=\tfrac12\bigl[(w_i+w_j)\log|\mathbf P_{ij}|
        -w_i\log|\mathbf P_i|-w_j\log|\mathbf P_j|\bigr],

    A. Runnalls, IEEE Transactions on Aerospace and Electronic Systems 43 (2007) 989-999. Costs are
    kept between mergers, so that L mixands that become K cost about L² − K²/2 determinants, and the
    memory is 8 L² bytes: of thousands let the heaviest absorb the others first. Where numba is
    installed (the extra `speed`) it computes: the same merges, some four times as fast.

    Parameters
    ----------
    mixture : GaussianMixture
    size : int
        How many to keep; a mixture that is no larger is returned as it is.
    heaviest : int, optional
        Of a larger mixture each mixand joins that of the so many heaviest with which its merger
        costs least, all at once, before pairs are merged; at least `size`.

    Examples
    --------
    >>> three = GaussianMixture([0.25, 0.25, 0.5], [[0.0], [0.2], [9.0]], [[[1.0]]] * 3)
    >>> runnalls(three, 2).means.round(2)
    array([[0.1],
           [9. ]])
    >>> four = GaussianMixture(
    ...     [0.4, 0.4, 0.1, 0.1], [[0.0], [9.0], [1.0], [8.0]], [[[1.0]]] * 4
    ... )
    >>> runnalls(four, 2, heaviest=2).means.round(2)
    array([[0.2],
           [8.8]])
    """
    if heaviest is not None and heaviest < n_components:
        raise ValueError(
            f"heaviest must be at least size, {n_components}, got {heaviest}"
        )
    if heaviest is not None and heaviest < mixture.n_components:
        mixture = _absorbed(mixture, heaviest)
    if mixture.n_components <= n_components:
        return mixture
    w, m, p, root = _whitened(mixture)
    alive = _merging()(w, m, p, n_components)
    means = mixture.mean + m[alive] @ root.T
    covs = symmetrise(root @ p[alive] @ root.T)
    return GaussianMixture.construct(w[alive] / w[alive].sum(), means, covs)


@validated
def merge_costs(mixture: GaussianMixture) -> Array:
    """Runnalls' bound for each pair of mixands, (L, L); zero on the diagonal.

    Examples
    --------
    >>> two = GaussianMixture([0.5, 0.5], [[-1.0], [1.0]], [[[1.0]], [[1.0]]])
    >>> merge_costs(two)[0, 1].round(6) == np.round(0.5 * np.log(2), 6)
    np.True_
    """
    w, m, p, _ = _whitened(mixture)
    dets = np.linalg.slogdet(p)[1]
    every = np.arange(mixture.n_components)
    return np.stack(
        [_costs(w, m, p, dets, i, every) for i in range(mixture.n_components)]
    )


@validated
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
    return mixture.weights[:, None] * gaussian_divergences(mixture, other)


@validated
def merge_irrelevant(
    mixture: GaussianMixture,
    other: GaussianMixture,
    *,
    threshold: Annotated[float, Bounds(above=1)],
) -> GaussianMixture:
    r"""Merge into one the mixands that overlap with none of another's: the KLD rule (40)-(41).

    With :math:`\delta_q=\min_r w_qD_{KL}(\mathcal N_q\|\mathcal N_r)` the mixands with
    :math:`\delta_q>\epsilon\,\delta_{\min}` are merged. As printed, a mixand that both agents
    share makes :math:`\delta_{\min}` zero, or negative by rounding, and the mixture collapses.
    Three guards: :math:`\delta_{\min}` is at least 1e-4 nats; a mixand is only merged if its
    unweighted divergence exceeds half a nat; and the most relevant mixand is never merged.

    Parameters
    ----------
    mixture, other : GaussianMixture
        Of the same dimension.
    threshold : float
        The factor :math:`\epsilon`, above 1.

    Examples
    --------
    >>> mine = GaussianMixture([0.4, 0.3, 0.3], [[0.0], [8.0], [9.0]], [[[1.0]]] * 3)
    >>> theirs = GaussianMixture.gaussian([0.5], [[1.0]])
    >>> merge_irrelevant(mine, theirs, threshold=3.0).means
    array([[0. ],
           [8.5]])
    >>> shared = GaussianMixture(
    ...     [0.9, 1e-5, 0.1 - 1e-5], [[0.0], [2.0], [9.0]], [[[1.0]]] * 3
    ... )
    >>> merge_irrelevant(
    ...     shared, GaussianMixture.gaussian([0.0], [[1.0]]), threshold=3.0
    ... ).n_components
    3
    """
    nearest = gaussian_divergences(mixture, other).min(axis=1)
    delta = np.where(mixture.weights > 0, mixture.weights * nearest, np.inf)
    out = (
        np.isfinite(delta)
        & (delta > threshold * max(delta.min(), _FLOOR))
        & (nearest > _GATE)
    )
    out[np.argmin(delta)] = False
    labels = np.where(out, mixture.n_components, np.arange(mixture.n_components))
    return _grouped(mixture, np.unique(labels, return_inverse=True)[1])


@validated
def pivoted_qr(
    shapes: ComponentShapes,
    *,
    n_components: PositiveInt,
    rest: Literal["merge", "drop"] = "merge",
) -> ComponentShapes:
    r"""Keep the mixands that a pivoted QR decomposition of (33) finds independent, (42)-(43).

    Parameters
    ----------
    shapes : Shapes
    size : int
        How many to have in the end, those with the largest pivots.
    rest : {"merge", "drop"}
        Merge the others into one, with equal weights since they have none yet; or drop them.

    Examples
    --------
    >>> three = ComponentShapes([[0.0], [1e-6], [9.0]], [[[1.0]]] * 3, [0, 0, 0])
    >>> pivoted_qr(three, n_components=2, rest="drop").means
    array([[0.],
           [9.]])
    """
    if n_components >= shapes.n_components:
        return shapes
    mixture = shapes.with_equal_weights()
    logs = mixture.component_log_densities(shapes.means) - mixture.log_peaks
    order = qr(np.exp(logs), mode="r", pivoting=True)[1]
    kept = n_components - (rest == "merge")
    keep = np.isin(np.arange(shapes.n_components), order[:kept])
    first = shapes.select(keep)
    lost = shapes.select(~keep)
    if rest == "drop":
        return first
    one = lost.with_equal_weights()
    return ComponentShapes.construct(
        np.concatenate([first.means, one.mean[None]]),
        np.concatenate([first.covs, one.cov[None]]),
        np.append(first.source, shapes.source[order[kept]]),
        shapes.dropped,
    )


def gaussian_divergences(mixture: GaussianMixture, other: GaussianMixture) -> Array:
    r"""Kullback-Leibler divergences of each mixand from each of another's, (L, L'), in nats.

    .. math::
        D_{KL}&=\tfrac12\bigl[\operatorname{tr}\mathbf P_r^{-1}\mathbf P_q-d
        +\log|\mathbf P_r|-\log|\mathbf P_q|\\
        &\qquad+(\mathbf m_q-\mathbf m_r)^\top\mathbf P_r^{-1}(\mathbf m_q-\mathbf m_r)\bigr]

    never negative: what rounding leaves below zero is zero.
    """
    d = mixture.dim
    if other.dim != d:
        raise ValueError(f"other must have dimension {d}, got {other.dim}")
    white = np.linalg.solve(other.factors, np.broadcast_to(np.eye(d), other.covs.shape))
    trace = ((white @ mixture.factors[:, None]) ** 2).sum(axis=(-2, -1))
    gap = mixture.means[:, None] - other.means
    length = ((white @ gap[..., None]) ** 2).sum(axis=(-2, -1))
    out = 0.5 * (trace - d + length) + mixture.log_peaks[:, None] - other.log_peaks
    return np.asarray(np.maximum(out, 0.0))


def _absorbed(mixture: GaussianMixture, heaviest: int) -> GaussianMixture:
    """The heaviest mixands after each other one has joined the cheapest of them."""
    w, m, p, _ = _whitened(mixture)
    order = np.argsort(-w, kind="stable")
    heavy = order[:heaviest]
    rest = order[heaviest:]
    dets = np.linalg.slogdet(p)[1]
    labels = np.empty(w.size, dtype=np.intp)
    labels[heavy] = np.arange(heaviest)
    labels[rest] = [_costs(w, m, p, dets, i, heavy).argmin() for i in rest]
    return _grouped(mixture, labels)


def _whitened(mixture: GaussianMixture) -> tuple[Array, Array, Array, Array]:
    """Copies in the frame of the global moments, where the costs are the same and well scaled."""
    root = np.linalg.cholesky(mixture.cov)
    white = np.linalg.solve(root, np.eye(mixture.dim))
    means = (mixture.means - mixture.mean) @ white.T
    covs = symmetrise(white @ mixture.covs @ white.T)
    return mixture.weights.copy(), means, covs, np.asarray(root)


def _costs(w: Array, m: Array, p: Array, dets: Array, i: Any, others: Indices) -> Array:
    """Runnalls' bound of mixand i with others; a pair without weight costs nothing."""
    total = w[i] + w[others]
    a = np.divide(w[i], total, out=np.full(total.shape, 0.5), where=total > 0)
    gap = m[others] - m[i]
    both = a[:, None, None] * p[i] + (1 - a)[:, None, None] * p[others]
    both += (a * (1 - a))[:, None, None] * gap[:, :, None] * gap[:, None, :]
    bound = 0.5 * (
        total * np.linalg.slogdet(both)[1] - w[i] * dets[i] - w[others] * dets[others]
    )
    return np.asarray(np.where(others == i, 0.0, bound))


@cache
def _merging() -> Callable[..., Mask]:
    """What merges, compiled where numba is installed."""
    try:
        compiled = importlib.import_module("numba").njit(cache=True)
    except ModuleNotFoundError:
        return _merged
    # The same function, with the other way to compute a row: numba keeps it between processes
    # only if that is a global name.
    names = globals() | {"_costs": compiled(_costs_in_loops)}
    return cast(Callable[..., Mask], compiled(FunctionType(_merged.__code__, names)))


def _costs_in_loops(w: Any, m: Any, p: Any, dets: Any, i: Any, others: Any) -> Any:
    """As :func:`_costs`, for numba: each merged covariance is formed and factored in one pass."""
    d = m.shape[1]
    lower = np.empty((d, d))
    out = np.zeros(others.size)
    for k, j in enumerate(others):
        total = w[i] + w[j]
        if total <= 0.0 or i == j:
            continue
        a = w[i] / total
        b = w[j] / total
        one = p[i]
        other = p[j]
        gap = np.sqrt(a * b) * (m[i] - m[j])
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
            lower[r, r] = 1.0 / np.sqrt(
                s
            )  # the reciprocal, so that columns need no division
            log_det += np.log(s)
        out[k] = 0.5 * (total * log_det - w[i] * dets[i] - w[j] * dets[j])
    return out


def _merged(w: Any, m: Any, p: Any, size: Any) -> Any:
    """Merge the cheapest pair until `size` mixands are left, in place; which are left.

    A merger can bring a mixand nearer to a third one than its nearest was:

    >>> w, spread = (
    ...     np.array([8, 9, 3, 5, 7, 6]) / 38,
    ...     np.array([0.1, 3.0, 1.0, 0.3, 1.0, 0.3]),
    ... )
    >>> means = [[29.0], [-7.0], [24.0], [24.0], [37.0], [-38.0]]
    >>> (
    ...     38
    ...     * runnalls(GaussianMixture(w, means, spread[:, None, None] ** 2), 2).weights
    ... ).round(6)
    array([23., 15.])
    """
    n = w.size
    every = np.arange(n)
    alive = np.full(n, True)
    dets = np.array([np.linalg.slogdet(p[i])[1] for i in range(n)])
    table = np.full((n, n), np.inf)
    best = np.full(n, np.inf)
    nearest = np.zeros(n, np.int64)
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
        w[i] = total
        w[j] = 0.0
        alive[j] = False
        best[j] = np.inf
        table[j, :] = table[:, j] = np.inf
        dets[i] = np.linalg.slogdet(p[i])[1]
        others = every[alive & (every != i)]
        row = _costs(w, m, p, dets, i, others)
        below = others < i
        table[others[below], i] = row[below]
        table[i, others[~below]] = row[~below]
        # Only rows that lost their neighbour, and the merged one, are searched again.
        searched = np.flatnonzero(
            alive & ((nearest == i) | (nearest == j) | (every == i))
        )
        nearest = np.where(table[:, i] < best, i, nearest)
        best = np.minimum(table[:, i], best)
    return alive


def _grouped(mixture: GaussianMixture, labels: Indices) -> GaussianMixture:
    """Merge the mixands of equal label, keeping each group's weight, mean and covariance."""
    member = labels == np.arange(labels.max() + 1)[:, None]
    w = member @ mixture.weights
    equal = member / member.sum(axis=1, keepdims=True)
    share = np.divide(
        member * mixture.weights, w[:, None], out=equal, where=w[:, None] > 0
    )
    means = share @ mixture.means
    gap = mixture.means - means[labels]
    covs = np.tensordot(share, mixture.covs + gap[:, :, None] * gap[:, None, :], axes=1)
    return GaussianMixture.construct(w, means, symmetrise(covs))
