"""The terms of a fused density: exponents, regressions, and shapes in their two forms."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..checks import Array, choice, number, weights
from .gaussian import GaussianMixture, symmetric
from .quadratics import ExponentialQuadratics, inverse
from .shapes import Shapes

__all__: list[str] = []


def _exponents(omega: float | str | ArrayLike, others: int) -> Array:
    if isinstance(omega, str):
        choice(omega, "omega", ("equal",))
        return np.full(others + 1, 1 / (others + 1))
    if not np.iterable(omega):
        w = number(omega, "omega", at_least=0, at_most=1)
        return np.concatenate([[w], np.full(others, (1 - w) / others)])
    return weights(omega, "omega", others + 1)


def _regression(own: GaussianMixture, n: int) -> tuple[Array, Array]:
    """Gain of e on t and covariance of e given t, of each mixand."""
    cross = own.covs[:, :n, n:]
    gain = np.swapaxes(np.linalg.solve(own.covs[:, :n, :n], cross), -1, -2)
    return gain, symmetric(own.covs[:, n:, n:] - gain @ cross)


def _joined(target: Array, gain: Array, rest: Array) -> Array:
    """Covariances of [t; e] from that of t, the gain of e on t, and the covariance of e given t."""
    cross = target @ np.swapaxes(gain, -1, -2)
    below = rest + gain @ cross
    top = np.concatenate([target, cross], axis=-1)
    low = np.concatenate([np.swapaxes(cross, -1, -2), symmetric(below)], axis=-1)
    return np.concatenate([top, low], axis=-2)


def _combined(sent: Sequence[GaussianMixture], w: Array) -> ExponentialQuadratics:
    """The product of the others' powers, one term for each choice of a mixand from each."""
    total: ExponentialQuadratics | None = None
    for weight, other in zip(w, sent, strict=True):
        part = other.quadratics()
        part = ExponentialQuadratics(
            weight * part.precisions, weight * part.vectors, 0 * part.vectors[:, 0]
        )
        total = part if total is None else total.times(part)
    assert total is not None
    return total


def _conditional_shapes(
    own: GaussianMixture, divided: GaussianMixture, sent: Sequence[GaussianMixture], w: Array,
    pairs: NDArray[np.intp],
) -> Shapes:
    """Update the target part by Λ and η in the own mixand's whitened frame; e follows."""
    n = divided.dim
    q, p = pairs
    precisions = inverse(divided.factors)
    # Everything about the own mixand's mean: far from the origin products would cancel.
    spread = np.zeros((q.size, 1, n, n))
    pull = np.zeros((q.size, 1, n))
    for weight, other in zip(w[1:], sent, strict=True):
        j = weight * inverse(other.factors)
        gap = other.means - own.means[q, None, :n]
        eta = np.einsum("rij,srj->sri", j, gap)
        size = (q.size, -1)
        spread = (spread[:, :, None] + j).reshape(*size, n, n)
        pull = (pull[:, :, None] + eta[:, None]).reshape(*size, n)
    if w[0] != 1:
        j = (w[0] - 1) * precisions[p]
        gap = divided.means[p] - own.means[q, :n]
        spread = spread + j[:, None]
        pull = pull + (j @ gap[..., None])[:, None, :, 0]
    root = np.linalg.cholesky(own.covs[q, :n, :n])[:, None]
    middle = np.eye(n) + np.swapaxes(root, -1, -2) @ symmetric(spread) @ root
    lower, good = _factored(middle)
    half = np.linalg.solve(lower, np.broadcast_to(np.swapaxes(root, -1, -2), lower.shape))
    target = np.swapaxes(half, -1, -2) @ half
    move = (target @ pull[..., None])[..., 0]
    gain, rest = _regression(own, n)
    shift = np.concatenate([move, (gain[q, None] @ move[..., None])[..., 0]], axis=-1)
    means = own.means[q, None] + shift
    covs = _joined(target, np.broadcast_to(gain[q, None], (*good.shape, *gain.shape[1:])),
                   np.broadcast_to(rest[q, None], (*good.shape, *rest.shape[1:])))
    source = np.broadcast_to(q[:, None], good.shape)
    return Shapes(means[good], covs[good], source[good], int((~good).sum()))


def _literal_shapes(
    own: GaussianMixture, divided: GaussianMixture, sent: Sequence[GaussianMixture], w: Array,
    pairs: NDArray[np.intp],
) -> Shapes:
    """(22)-(27) as printed, with each inverse; for comparison."""
    n, d = divided.dim, own.dim
    q, p = pairs
    inv = np.linalg.inv
    terms = _combined(sent, w[1:])
    j = (w[0] - 1) * inv(divided.covs)
    information = (j[p, None] + terms.precisions).reshape(-1, n, n)
    vector = ((j @ divided.means[..., None])[p, None, :, 0] + terms.vectors).reshape(-1, n)
    try:
        factor_cov = inv(information)
    except np.linalg.LinAlgError:
        raise np.linalg.LinAlgError(
            "form: 'literal' inverts the information of what updates the target, got a singular "
            "one; 'conditional' does not invert it"
        ) from None
    factor_mean = (factor_cov @ vector[..., None])[..., 0]
    source = np.repeat(q, terms.size)
    full = np.zeros((source.size, d, d))
    full[:, :n, :n] = inv(factor_cov)
    lift = np.zeros((source.size, d))
    lift[:, :n] = (inv(factor_cov) @ factor_mean[..., None])[..., 0]
    prior = inv(own.covs)[source]
    covs = inv(prior + full)
    means = (covs @ ((prior @ own.means[source][..., None])[..., 0] + lift)[..., None])[..., 0]
    covs = symmetric(covs)
    _, good = _factored(covs)
    return Shapes(means[good], covs[good], source[good], int((~good).sum()))


def _factored(matrices: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Cholesky factors of a stack, and which of them exist; the identity where none does."""
    d = matrices.shape[-1]
    lower = np.zeros_like(matrices)
    good = np.ones(matrices.shape[:-2], dtype=bool)
    for k in range(d):
        column = matrices[..., k:, k] - (lower[..., k:, :k] @ lower[..., k, :k, None])[..., 0]
        # A pivot that has lost ten digits to cancellation is rounding.
        good &= column[..., 0] > 1e-10 * np.abs(matrices[..., k, k])
        pivot = np.where(good, column[..., 0], 1.0)
        lower[..., k:, k] = np.where(good[..., None], column, 0.0) / np.sqrt(pivot)[..., None]
    lower[~good] = np.eye(d)
    return lower, good
