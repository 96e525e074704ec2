"""How far two densities are apart: in closed form, by quadrature, by importance sampling."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ..checks import Array, array, callable_, count, covariance, generator, instance, number
from .gaussian import GaussianMixture

__all__ = [
    "Divergence", "gaussian_divergences", "jeffreys_by_quadrature", "jeffreys_by_sampling",
    "jeffreys_of_many", "tensor_grid",
]

LogDensity = Callable[[Array], Array]


def gaussian_divergences(
    means: ArrayLike, covs: ArrayLike, other_means: ArrayLike, other_covs: ArrayLike
) -> Array:
    r"""Kullback-Leibler divergences of each Gaussian from each of others, (L, L'), in nats.

    .. math::
        D_{KL}&=\tfrac12\bigl[\operatorname{tr}\mathbf P_r^{-1}\mathbf P_q-d
        +\log|\mathbf P_r|-\log|\mathbf P_q|\\
        &\qquad+(\mathbf m_q-\mathbf m_r)^\top\mathbf P_r^{-1}(\mathbf m_q-\mathbf m_r)\bigr]

    never negative: what rounding leaves below zero is zero.

    Parameters
    ----------
    means, covs : array_like, (L, d), (L, d, d)
    other_means, other_covs : array_like, (L', d), (L', d, d)

    Examples
    --------
    >>> gaussian_divergences([[0.0]], [[[1.0]]], [[0.0], [3.0]], [[[1.0]], [[1.0]]])
    array([[0. , 4.5]])
    """
    m = array(means, "means", ("L", "d"))
    d = m.shape[1]
    p = covariance(array(covs, "covs", (m.shape[0], d, d)), "covs")
    m2 = array(other_means, "other_means", ("L'", d))
    p2 = covariance(array(other_covs, "other_covs", (m2.shape[0], d, d)), "other_covs")
    root, root2 = np.linalg.cholesky(p), np.linalg.cholesky(p2)
    white = np.linalg.solve(root2, np.broadcast_to(np.eye(d), p2.shape))
    trace = ((white[None] @ root[:, None]) ** 2).sum(axis=(-2, -1))
    gap = ((white[None] @ (m[:, None] - m2)[..., None]) ** 2).sum(axis=(-2, -1))
    half, half2 = (
        np.log(np.diagonal(r, axis1=-2, axis2=-1)).sum(axis=-1) for r in (root, root2)
    )
    out = 0.5 * (trace - d + gap) + half2[None] - half[:, None]
    return np.asarray(np.maximum(out, 0.0))


@dataclass(frozen=True)
class Divergence:
    """An estimate of Jeffreys' divergence (44) with what it rests on.

    Parameters
    ----------
    value : float
        Half the sum of the two Kullback-Leibler divergences, in nats.
    error : float
        Its standard error; 0 for a quadrature.
    share : float
        Effective share of the sample, the smaller of the two densities'; 1 for a quadrature.

    Examples
    --------
    >>> print(Divergence(0.5, 0.01, 0.9))
    0.5 ± 0.01
    """

    value: float
    error: float
    share: float

    def __post_init__(self) -> None:
        for name in ("value", "error", "share"):
            number(getattr(self, name), name)

    def __str__(self) -> str:
        return f"{self.value:.3g} ± {self.error:.1g}"


def tensor_grid(lower: ArrayLike, upper: ArrayLike, nodes: int) -> tuple[Array, Array]:
    """Points (nodes^d, d) of the trapezoid rule on a box, and their weights.

    Examples
    --------
    >>> points, parts = tensor_grid([0.0, 0.0], [1.0, 2.0], 3)
    >>> points.shape, float(parts.sum())
    ((9, 2), 2.0)
    """
    low = array(lower, "lower", ("d",))
    high = array(upper, "upper", (low.size,))
    n = count(nodes, "nodes", at_least=2)
    if (high <= low).any():
        raise ValueError("upper: needs numbers above lower, got an empty box")
    index = np.indices((n,) * low.size).reshape(low.size, -1).T
    step = (high - low) / (n - 1)
    ends = (index == 0) | (index == n - 1)
    return low + step * index, np.prod(np.where(ends, 0.5 * step, step), axis=1)


def jeffreys_by_quadrature(
    log_p: LogDensity,
    log_q: LogDensity,
    lower: ArrayLike,
    upper: ArrayLike,
    *,
    nodes: int = 50,
) -> Divergence:
    r"""Jeffreys' divergence by the trapezoid rule on a box, both densities normalised there.

    .. math:: d(p,q)=\tfrac12\int(p-q)(\log p-\log q)\,d\mathbf x

    The integrand vanishes wherever both densities do, and constants in the logarithms cancel.

    Parameters
    ----------
    log_p, log_q : callable
        Logarithms of densities, normalised or not, of points (n, d), (n,).
    lower, upper : array_like, (d,)
        The box.
    nodes : int
        Along each axis; nodes^d evaluations, done in slices of the first axis.

    Examples
    --------
    >>> one, two = (GaussianMixture.gaussian([m], [[1.0]]) for m in (0.0, 1.0))
    >>> round(jeffreys_by_quadrature(one.log_density, two.log_density, [-8], [9]).value, 9)
    0.5
    """
    callable_(log_q, "log_q")
    return jeffreys_of_many(log_p, [log_q], lower, upper, nodes=nodes)[0]


def jeffreys_of_many(
    log_p: LogDensity,
    log_qs: Sequence[LogDensity],
    lower: ArrayLike,
    upper: ArrayLike,
    *,
    nodes: int = 50,
) -> list[Divergence]:
    """Jeffreys' divergences of one density from several, on the same nodes.

    Parameters
    ----------
    log_p : callable
        As of :func:`jeffreys_by_quadrature`; it is evaluated once.
    log_qs : sequence of callable
        The others.
    lower, upper, nodes
        As of :func:`jeffreys_by_quadrature`.

    Examples
    --------
    >>> one, two = (GaussianMixture.gaussian([m], [[1.0]]) for m in (0.0, 1.0))
    >>> found = jeffreys_of_many(one.log_density, [one.log_density, two.log_density], [-8], [9])
    >>> [round(d.value, 6) for d in found]
    [0.0, 0.5]
    """
    if not np.iterable(log_qs):
        raise ValueError(f"log_qs: needs a list of functions, got {type(log_qs).__name__}")
    functions = [callable_(log_p, "log_p"), *(callable_(f, "log_qs") for f in log_qs)]
    low = array(lower, "lower", ("d",))
    high = array(upper, "upper", low.shape)
    n = count(nodes, "nodes", at_least=2)
    front, front_parts = tensor_grid(low[:1], high[:1], n)
    points, parts = (
        tensor_grid(low[1:], high[1:], n) if low.size > 1 else (np.empty((1, 0)), np.ones(1))
    )
    tops = np.full(len(functions), -np.inf)
    sums = np.zeros((len(functions), 1 + len(functions)))
    # One slice of the first axis at a time; each density is rescaled when a larger value comes.
    for x, part in zip(front[:, 0], front_parts, strict=True):
        at = np.concatenate([np.full((points.shape[0], 1), x), points], axis=1)
        names = ["log_p"] + ["log_q"] * len(log_qs)
        logs = np.stack(
            [array(f(at), name, (at.shape[0],)) for f, name in zip(functions, names, strict=True)]
        )
        new = np.maximum(tops, logs.max(axis=1))
        mass = part * parts * np.exp(logs - new[:, None])
        sums *= np.exp(tops - new)[:, None]
        sums[:, 0] += mass.sum(axis=1)
        sums[:, 1:] += mass @ (logs[0] - logs).T
        tops = new
    ratios = sums[:, 1:] / sums[:, :1]
    gaps = 0.5 * (ratios[0, 1:] - np.diagonal(ratios)[1:])
    return [Divergence(float(gap), 0.0, 1.0) for gap in gaps]


def jeffreys_by_sampling(
    log_p: LogDensity,
    log_q: LogDensity,
    proposal: GaussianMixture,
    *,
    members: int,
    rng: np.random.Generator,
) -> Divergence:
    r"""Jeffreys' divergence by importance sampling, with its standard error.

    :math:`\tfrac12(\mathrm E_p[r]-\mathrm E_q[r])` with :math:`r=\log p-\log q`, each expectation
    with self-normalised weights; constants in the logarithms cancel. The error is that of the
    linearised ratio estimates, of both on the same points.

    Parameters
    ----------
    log_p, log_q : callable
        Logarithms of densities, normalised or not, of points (n, d), (n,).
    proposal : GaussianMixture
        Where the points are drawn; it should be wide enough for both.
    members : int
        How many points.
    rng : numpy.random.Generator

    Examples
    --------
    >>> one, two = (GaussianMixture.gaussian([m], [[1.0]]) for m in (0.0, 1.0))
    >>> found = jeffreys_by_sampling(one.log_density, two.log_density, one, members=4000,
    ...                              rng=np.random.default_rng(1))
    >>> abs(found.value - 0.5) < 3 * found.error
    True
    """
    callable_(log_p, "log_p")
    callable_(log_q, "log_q")
    instance(proposal, "proposal", GaussianMixture)
    x = proposal.sample(count(members, "members", at_least=2), rng=generator(rng))
    base = proposal.log_density(x)
    logs = [array(f(x), name, base.shape) for f, name in ((log_p, "log_p"), (log_q, "log_q"))]
    ratio = logs[0] - logs[1]
    weights = [np.exp(v - base - (v - base).max()) for v in logs]
    weights = [w / w.mean() for w in weights]
    means = [float((w * ratio).mean()) for w in weights]
    influence = weights[0] * (ratio - means[0]) - weights[1] * (ratio - means[1])
    share = min(float(1 / (w**2).mean()) for w in weights)
    error = 0.5 * influence.std(ddof=1) / np.sqrt(base.size)
    return Divergence(0.5 * (means[0] - means[1]), float(error), share)
