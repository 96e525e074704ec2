"""How far two densities are apart: by quadrature, by importance sampling."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from ..validation import (
    Array,
    Bounds,
    FrozenModel,
    Rng,
    check_array,
    validated,
)
from .gaussian import GaussianMixture

__all__ = ["Divergence", "jeffreys_by_sampling", "jeffreys_of_many"]

Several = Annotated[int, Bounds(at_least=2)]


@dataclass(frozen=True)
class Divergence(FrozenModel):
    """An estimate of Jeffreys' divergence (44) with what it rests on.

    Parameters
    ----------
    value : float
        Half the sum of the two Kullback-Leibler divergences, in nats.
    error : float
        Its standard error; 0 for a quadrature.

    Examples
    --------
    >>> print(Divergence(0.5, 0.01))
    0.5 ± 0.01
    """

    value: float
    error: float

    def __str__(self) -> str:
        return f"{self.value:.3g} ± {self.error:.1g}"


@validated
def jeffreys_of_many(
    log_p: Callable[[Array], Array],
    log_qs: Sequence[Callable[[Array], Array]],
    lower: Annotated[Array, "d"],
    upper: Annotated[Array, "d"],
    *,
    nodes: Several = 50,
) -> list[Divergence]:
    r"""Jeffreys' divergences of one density from several, by the trapezoid rule on a box.

    .. math:: d(p,q)=\tfrac12\int(p-q)(\log p-\log q)\,d\mathbf x

    with all densities normalised there. The integrand vanishes wherever both densities do, and
    constants in the logarithms cancel.

    Parameters
    ----------
    log_p : callable
        Logarithm of a density, normalised or not, of points (n, d), (n,); it is evaluated once.
    log_qs : sequence of callable
        The others.
    lower, upper : array_like, (d,)
        The box.
    nodes : int
        Along each axis; nodes^d evaluations, done in slices of the first axis.

    Examples
    --------
    >>> one, two = (GaussianMixture.gaussian([m], [[1.0]]) for m in (0.0, 1.0))
    >>> found = jeffreys_of_many(
    ...     one.log_density, [one.log_density, two.log_density], [-8], [9]
    ... )
    >>> [round(d.value, 6) for d in found]
    [0.0, 0.5]
    """
    if (upper <= lower).any():
        raise ValueError("upper must be numbers above lower, got an empty box")
    functions = (log_p, *log_qs)
    front, front_parts = _tensor_grid(lower[:1], upper[:1], nodes)
    points, parts = _tensor_grid(lower[1:], upper[1:], nodes)
    tops = np.full(len(functions), -np.inf)
    sums = np.zeros((len(functions), 1 + len(functions)))
    # One slice of the first axis at a time; each density is rescaled when a larger value comes.
    for x, part in zip(front[:, 0], front_parts, strict=True):
        at = np.concatenate([np.full((points.shape[0], 1), x), points], axis=1)
        logs = np.stack(
            [check_array(f(at), "log_p, log_qs", at.shape[:1]) for f in functions]
        )
        new = np.maximum(tops, logs.max(axis=1))
        mass = part * parts * np.exp(logs - new[:, None])
        sums *= np.exp(tops - new)[:, None]
        sums[:, 0] += mass.sum(axis=1)
        sums[:, 1:] += mass @ (logs[0] - logs).T
        tops = new
    ratios = sums[:, 1:] / sums[:, :1]
    gaps = 0.5 * (ratios[0, 1:] - np.diagonal(ratios)[1:])
    return [Divergence(float(gap), 0.0) for gap in gaps]


def _tensor_grid(low: Array, high: Array, nodes: int) -> tuple[Array, Array]:
    """Points (nodes^d, d) of the trapezoid rule on a box, and their weights."""
    index = np.indices((nodes,) * low.size).reshape(low.size, nodes**low.size).T
    step = (high - low) / (nodes - 1)
    ends = (index == 0) | (index == nodes - 1)
    return low + step * index, np.prod(np.where(ends, 0.5 * step, step), axis=1)


@validated
def jeffreys_by_sampling(
    log_p: Callable[[Array], Array],
    log_q: Callable[[Array], Array],
    proposal: GaussianMixture,
    *,
    members: Several,
    rng: Rng,
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
    >>> found = jeffreys_by_sampling(
    ...     one.log_density,
    ...     two.log_density,
    ...     one,
    ...     members=4000,
    ...     rng=np.random.default_rng(1),
    ... )
    >>> abs(found.value - 0.5) < 3 * found.error
    True
    """
    x = proposal.rvs(members, rng=rng)
    base = proposal.log_density(x)
    logs = [
        check_array(f(x), name, base.shape)
        for f, name in ((log_p, "log_p"), (log_q, "log_q"))
    ]
    ratio = logs[0] - logs[1]
    weights = [np.exp(v - base - (v - base).max()) for v in logs]
    weights = [w / w.mean() for w in weights]
    means = [float((w * ratio).mean()) for w in weights]
    influence = weights[0] * (ratio - means[0]) - weights[1] * (ratio - means[1])
    error = 0.5 * influence.std(ddof=1) / np.sqrt(base.size)
    return Divergence(0.5 * (means[0] - means[1]), float(error))
