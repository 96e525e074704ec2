"""Reduction of mixtures: by the cheapest merger, by relevance to another's belief, by rank."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import qr

from ..linalg import symmetrise
from ..validation import (
    Array,
    Bounds,
    FrozenModel,
    Indices,
    MaskInput,
    NonNegativeInt,
    PositiveInt,
    check_positive_definite,
    validated,
)
from .gaussian import GaussianMixture

__all__ = [
    "ComponentShapes",
    "cross_relevance",
    "merge_costs",
    "merge_irrelevant",
    "pivoted_qr",
    "runnalls",
]

# Divergence in nats up to which a component counts as near another's, whatever its weight: that of
# two equal Gaussians one standard deviation apart.
_NEAR = 0.5
# Lower bound of the smallest relevance, in nats: components that are nearer to each other than
# about a hundredth of a standard deviation are the same.
_RELEVANCE_FLOOR = 1e-4


@dataclass(frozen=True, eq=False)
class ComponentShapes(FrozenModel):
    """Means and covariances of mixture components that have no weights yet.

    Parameters
    ----------
    means : array_like, (S, d)
    covs : array_like, (S, d, d)
        Positive definite.
    source : array_like of int, (S,)
        Index of the prior's component that each came from.
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

    if TYPE_CHECKING:
        # The fields are arrays, but the constructor takes anything array_like.
        def __init__(
            self, means: ArrayLike, covs: ArrayLike, source: ArrayLike, dropped: int = 0
        ) -> None: ...

    @property
    def n_components(self) -> int:
        """Number of components, S."""
        return int(self.means.shape[0])

    @validated
    def select(
        self, keep: Annotated[MaskInput, "self.n_components"]
    ) -> ComponentShapes:
        """Select components by a mask.

        Parameters
        ----------
        keep : array_like of bool, (S,)
            True for those that stay.

        Examples
        --------
        >>> two = ComponentShapes([[0.0], [1.0]], [[[1.0]], [[2.0]]], [0, 0])
        >>> two.select([False, True]).means
        array([[1.]])
        """
        return self.construct(
            self.means[keep], self.covs[keep], self.source[keep], self.dropped
        )

    def with_equal_weights(self) -> GaussianMixture:
        """Return a mixture of these components with equal weights."""
        weights = np.full(self.n_components, 1 / self.n_components)
        return GaussianMixture.construct(weights, self.means, self.covs)


@validated
def runnalls(
    mixture: GaussianMixture,
    n_components: PositiveInt,
    *,
    heaviest: PositiveInt | None = None,
) -> GaussianMixture:
    r"""Merge the pair of components whose merger may lose least, until `n_components` are left.

    Merging i and j keeps their weight, mean and covariance. The loss of information is at most

    .. math:: B_{ij}=\tfrac12\bigl[(w_i+w_j)\log|\mathbf P_{ij}|
        -w_i\log|\mathbf P_i|-w_j\log|\mathbf P_j|\bigr],

    A. Runnalls, IEEE Transactions on Aerospace and Electronic Systems 43 (2007) 989-999. Costs are
    stored between mergers, so that L components that become K cost about L² − K²/2 determinants,
    and the memory is 8 L² bytes: of thousands let the heaviest absorb the others first. Where numba
    is installed (the extra `speed`) it compiles the mergers: the same result, some four times as
    fast.

    Parameters
    ----------
    mixture : GaussianMixture
    n_components : int
        Number of components of the result; a mixture that has no more is returned as it is.
    heaviest : int, optional
        In a larger mixture each component first joins that of the so many heaviest with which its
        merger costs least, all at once, before pairs are merged; at least `n_components`.

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

    A merger can bring a component nearer to a third one than its nearest was:

    >>> weights = np.array([8, 9, 3, 5, 7, 6]) / 38
    >>> means = [[29.0], [-7.0], [24.0], [24.0], [37.0], [-38.0]]
    >>> std = np.array([0.1, 3.0, 1.0, 0.3, 1.0, 0.3])
    >>> six = GaussianMixture(weights, means, std[:, None, None] ** 2)
    >>> (38 * runnalls(six, 2).weights).round(6)
    array([23., 15.])
    """
    # numba takes long to import, so it is imported here, where it is used.
    from .merging import merge_pairs

    if heaviest is not None and heaviest < n_components:
        raise ValueError(
            f"heaviest must be at least n_components, {n_components}, got {heaviest}"
        )
    if heaviest is not None and heaviest < mixture.n_components:
        mixture = _absorb_into_heaviest(mixture, heaviest)
    if mixture.n_components <= n_components:
        return mixture
    # In coordinates in which all numbers are of the order of one; the costs are the same there.
    white = _whiten(mixture)
    # Merges the arrays in place; `remaining` (L,) marks the components that are left.
    remaining = merge_pairs(white.weights, white.means, white.covs, n_components)
    # Back from the whitened frame.
    root = white.root
    means = mixture.mean + white.means[remaining] @ root.T
    covs = symmetrise(root @ white.covs[remaining] @ root.T)
    weights = white.weights[remaining] / white.weights[remaining].sum()
    return GaussianMixture.construct(weights, means, covs)


@validated
def merge_costs(mixture: GaussianMixture) -> Array:
    """Runnalls' bound B_ij, as in :func:`runnalls`, for each pair of components, (L, L), in nats.

    It is zero on the diagonal.

    Examples
    --------
    >>> two = GaussianMixture([0.5, 0.5], [[-1.0], [1.0]], [[[1.0]], [[1.0]]])
    >>> merge_costs(two)[0, 1].round(6) == np.round(0.5 * np.log(2), 6)
    np.True_
    """
    # In coordinates in which all numbers are of the order of one; the bounds are the same there.
    white = _whiten(mixture)
    log_dets = np.linalg.slogdet(white.covs).logabsdet
    index = np.arange(mixture.n_components)
    # Row i: the bounds B_ij for all j.
    rows = []
    for i in range(mixture.n_components):
        costs = pair_costs(white.weights, white.means, white.covs, log_dets, i, index)
        rows.append(costs)
    return np.stack(rows)


@validated
def cross_relevance(mixture: GaussianMixture, other: GaussianMixture) -> Array:
    r"""The matrix of relevances :math:`w_q D_{KL}(\mathcal N_q\|\mathcal N_r)`, (L, L').

    Equations (38)-(39) of Semeraro et al., for components q of one mixture and r of another.
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
    return np.asarray(mixture.weights[:, None] * gaussian_divergences(mixture, other))


@validated
def merge_irrelevant(
    mixture: GaussianMixture,
    other: GaussianMixture,
    *,
    threshold: Annotated[float, Bounds(above=1)],
) -> GaussianMixture:
    r"""Merge into one the components that overlap with none of another's: the KLD rule.

    By (40)-(41) of Semeraro et al., with
    :math:`\delta_q=\min_r w_qD_{KL}(\mathcal N_q\|\mathcal N_r)`, the components with
    :math:`\delta_q>\epsilon\,\delta_{\min}` are merged. As printed, a component that both agents
    share makes :math:`\delta_{\min}` zero, or negative by rounding, and the mixture collapses.
    Three guards: :math:`\delta_{\min}` is at least 1e-4 nats; a component is only merged if its
    unweighted divergence exceeds half a nat; and the most relevant component is never merged.

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
    # Divergence of each component from the nearest one of the other mixture, (L,)
    nearest = gaussian_divergences(mixture, other).min(axis=1)
    # δ_q; a component without weight must not set the least, and is not merged.
    delta = np.where(mixture.weights > 0, mixture.weights * nearest, np.inf)
    limit = threshold * max(delta.min(), _RELEVANCE_FLOOR)
    irrelevant = np.isfinite(delta) & (delta > limit) & (nearest > _NEAR)
    irrelevant[np.argmin(delta)] = False
    # All irrelevant components get one label, the others one each; then labels 0, 1, 2, ...
    labels = np.arange(mixture.n_components)
    labels[irrelevant] = mixture.n_components
    _distinct, consecutive = np.unique(labels, return_inverse=True)
    return _merge_groups(mixture, consecutive)


@validated
def pivoted_qr(
    shapes: ComponentShapes,
    *,
    n_components: PositiveInt,
    rest: Literal["merge", "drop"] = "merge",
) -> ComponentShapes:
    r"""Select the components that a pivoted QR finds independent: (42)-(43) of Semeraro et al.

    The matrix, (33) there, has each component's density at each mean, relative to its peak.

    Parameters
    ----------
    shapes : ComponentShapes
    n_components : int
        Number of components of the result, those with the largest pivots.
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
    # Entry (i, s): component s at the mean of component i, relative to its peak.
    logs = mixture.component_log_densities(shapes.means) - mixture.log_peaks
    _upper, order = qr(np.exp(logs), mode="r", pivoting=True)
    # A merged component takes one of the places.
    n_selected = n_components - 1 if rest == "merge" else n_components
    is_selected = np.isin(np.arange(shapes.n_components), order[:n_selected])
    selected = shapes.select(is_selected)
    if rest == "drop":
        return selected
    merged = shapes.select(~is_selected).with_equal_weights()
    # The merged component takes the source of the largest pivot among those it replaces.
    return ComponentShapes.construct(
        np.concatenate([selected.means, merged.mean[None]]),
        np.concatenate([selected.covs, merged.cov[None]]),
        np.append(selected.source, shapes.source[order[n_selected]]),
        shapes.dropped,
    )


def gaussian_divergences(mixture: GaussianMixture, other: GaussianMixture) -> Array:
    r"""Kullback-Leibler divergences of each component from each of another's, (L, L'), in nats.

    .. math::
        D_{KL}&=\tfrac12\bigl[\operatorname{tr}\mathbf P_r^{-1}\mathbf P_q-d
        +\log|\mathbf P_r|-\log|\mathbf P_q|\\
        &\qquad+(\mathbf m_q-\mathbf m_r)^\top\mathbf P_r^{-1}(\mathbf m_q-\mathbf m_r)\bigr]

    never negative: values that rounding leaves below zero are zero. The first index is that of the
    mixture's components q, the second that of the other's r. Means are (d,), covariances (d, d).
    """
    d = mixture.dim
    if other.dim != d:
        raise ValueError(f"other must have dimension {d}, got {other.dim}")
    identity = np.broadcast_to(np.eye(d), other.covs.shape)
    inverse_factors = np.linalg.solve(other.factors, identity)
    # tr P_r⁻¹ P_q = |L_r⁻¹ L_q|²
    traces = ((inverse_factors @ mixture.factors[:, None]) ** 2).sum(axis=(-2, -1))
    differences = mixture.means[:, None] - other.means
    white = inverse_factors @ differences[..., None]
    squared_lengths = (white**2).sum(axis=(-2, -1))
    # The peaks are -½ log|2π P|.
    quadratic = 0.5 * (traces - d + squared_lengths)
    divergences = quadratic + mixture.log_peaks[:, None] - other.log_peaks
    return np.asarray(np.maximum(divergences, 0.0))


def _absorb_into_heaviest(mixture: GaussianMixture, n_heaviest: int) -> GaussianMixture:
    """Join every other component with that of the heaviest with which its merger costs least.

    All costs are those before any merger.
    """
    # The costs are the same in coordinates in which all numbers are of the order of one.
    white = _whiten(mixture)
    order = np.argsort(-white.weights, kind="stable")
    heavy = order[:n_heaviest]
    log_dets = np.linalg.slogdet(white.covs).logabsdet
    # A label for each group of components that become one
    labels = np.empty(order.size, dtype=np.intp)
    labels[heavy] = np.arange(n_heaviest)
    for i in order[n_heaviest:]:
        # Runnalls' bounds of a merger with each of the heaviest
        costs = pair_costs(white.weights, white.means, white.covs, log_dets, i, heavy)
        labels[i] = costs.argmin()
    return _merge_groups(mixture, labels)


class _WhitenedMixture(NamedTuple):
    """A mixture's weights (L,), means (L, d) and covariances (L, d, d) in whitened coordinates.

    `root` (d, d) leads back from them.
    """

    weights: Array
    means: Array
    covs: Array
    root: Array


def _whiten(mixture: GaussianMixture) -> _WhitenedMixture:
    """Copy a mixture to coordinates z = L⁻¹ (x - m), in which it has mean 0 and covariance I.

    m and L Lᵀ are the moments of the whole mixture; L is the root. Runnalls' bounds are the same,
    since all logarithms of determinants change by one constant; numbers are of the order of one.
    """
    root = np.linalg.cholesky(mixture.cov)
    inverse_root = np.linalg.solve(root, np.eye(mixture.dim))
    means = (mixture.means - mixture.mean) @ inverse_root.T
    covs = symmetrise(inverse_root @ mixture.covs @ inverse_root.T)
    return _WhitenedMixture(mixture.weights.copy(), means, covs, np.asarray(root))


def pair_costs(
    weights: Array, means: Array, covs: Array, log_dets: Array, i: int, others: Indices
) -> Array:
    """Runnalls' bounds B_ij, as in :func:`runnalls`, of component i with others j, (n,), in nats.

    Weights, means and covariances (L,), (L, d), (L, d, d) are those of a mixture, `log_dets` (L,)
    those of the covariances, `others` (n,) indices. A pair without weight costs nothing, nor does
    the component with itself.
    """
    total = weights[i] + weights[others]
    # The share a = w_i / (w_i + w_j); equal shares where both weights are zero.
    equal = np.full(total.shape, 0.5)
    a = np.divide(weights[i], total, out=equal, where=total > 0)
    a_column = a[:, None, None]
    # P_ij = a P_i + (1 - a) P_j + a (1 - a) (m_j - m_i)(m_j - m_i)ᵀ
    differences = means[others] - means[i]
    merged = a_column * covs[i] + (1 - a_column) * covs[others]
    spread = (a * (1 - a))[:, None, None] * differences[:, :, None]
    merged += spread * differences[:, None, :]
    # 2 B_ij = (w_i + w_j) log|P_ij| - w_i log|P_i| - w_j log|P_j|
    separate = total * np.linalg.slogdet(merged).logabsdet - weights[i] * log_dets[i]
    bound = 0.5 * (separate - weights[others] * log_dets[others])
    return np.asarray(np.where(others == i, 0.0, bound))


def _merge_groups(mixture: GaussianMixture, labels: Indices) -> GaussianMixture:
    """Merge the components of equal label, so that each group keeps its weight and moments.

    The labels (L,) are 0, ..., G - 1, which are also the places of the groups in the result.
    """
    # (G, L): which group has which component
    is_member = labels == np.arange(labels.max() + 1)[:, None]
    weights = is_member @ mixture.weights
    # Shares of a group's weight, (G, L); equal ones in a group without weight.
    equal = is_member / is_member.sum(axis=1, keepdims=True)
    has_weight = weights[:, None] > 0
    shares = np.divide(
        is_member * mixture.weights, weights[:, None], out=equal, where=has_weight
    )
    means = shares @ mixture.means
    # P_g = Σ a_l (P_l + (m_l - m_g)(m_l - m_g)ᵀ)
    differences = mixture.means - means[labels]
    squares = differences[:, :, None] * differences[:, None, :]
    covs = np.tensordot(shares, mixture.covs + squares, axes=1)
    return GaussianMixture.construct(weights, means, symmetrise(covs))
