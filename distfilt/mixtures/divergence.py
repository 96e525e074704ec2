"""Jeffreys' divergence of two densities, by quadrature or by importance sampling."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from ..validation import (
    Array,
    ArrayInput,
    Bounds,
    FrozenModel,
    Rng,
    call_user,
    check_array,
    validated,
)
from .gaussian import GaussianMixture

__all__ = ["Divergence", "jeffreys_by_sampling", "jeffreys_of_many"]

AtLeastTwo = Annotated[int, Bounds(at_least=2)]


@dataclass(frozen=True)
class Divergence(FrozenModel):
    """An estimate of Jeffreys' divergence, (44) of Semeraro et al., with its standard error.

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
    lower: Annotated[ArrayInput, "d"],
    upper: Annotated[ArrayInput, "d"],
    *,
    nodes: AtLeastTwo = 50,
) -> list[Divergence]:
    r"""Jeffreys' divergences of one density from several, by the trapezoid rule on a box.

    .. math:: d(p,q)=\tfrac12\int(p-q)(\log p-\log q)\,d\mathbf x

    with all densities normalised there. The integrand vanishes wherever both densities do, and
    constants in the logarithms cancel.

    Parameters
    ----------
    log_p : callable
        Logarithm of a density, normalised or not: points (n, d) to values (n,).
    log_qs : sequence of callable
        The others.
    lower, upper : array_like, (d,)
        The box.
    nodes : int
        Along each axis; nodes^d evaluations, done in slices of the first axis.

    Examples
    --------
    >>> one, two = (GaussianMixture.gaussian([m], [[1.0]]) for m in (0.0, 1.0))
    >>> divergences = jeffreys_of_many(
    ...     one.log_density, [one.log_density, two.log_density], [-8], [9]
    ... )
    >>> [round(d.value, 6) for d in divergences]
    [0.0, 0.5]
    """
    if (upper <= lower).any():
        raise ValueError(
            f"upper must be above lower in each component, got {upper} and {lower}"
        )
    functions = [log_p]
    functions.extend(log_qs)
    n = len(functions)
    # Points and weights of the trapezoid rule, for the first axis and for the others
    first_axis, first_weights = _tensor_grid(lower[:1], upper[:1], nodes)
    points, weights = _tensor_grid(lower[1:], upper[1:], nodes)
    # Of each density f: its mass, and its integrals of log p - log q for all q.
    scales = np.full(n, -np.inf)
    masses = np.zeros(n)
    integrals = np.zeros((n, n))
    # One slice of the first axis at a time, so that the memory does not hold the whole box.
    for x, weight in zip(first_axis[:, 0], first_weights, strict=True):
        column = np.full((len(points), 1), x)
        logs = _evaluate_all(functions, np.concatenate([column, points], axis=1))
        # Sums are relative to each density's largest value, and rescaled when a larger comes.
        new_scales = np.maximum(scales, logs.max(axis=1))
        densities = weight * weights * np.exp(logs - new_scales[:, None])
        factors = np.exp(scales - new_scales)
        masses = factors * masses + densities.sum(axis=1)
        integrals = factors[:, None] * integrals + densities @ (logs[0] - logs).T
        scales = new_scales
    # d(p, q) = ½ (E_p[log p - log q] - E_q[log p - log q]). Entry (f, q) is the expectation under
    # f; density 0 is p.
    expectations = integrals / masses[:, None]
    divergences = 0.5 * (expectations[0, 1:] - np.diagonal(expectations)[1:])
    return [Divergence(float(d), error=0.0) for d in divergences]


def _evaluate_all(functions: Sequence[Callable[[Array], Array]], x: Array) -> Array:
    """Evaluate logarithms of densities at points (n, d): a row (n,) for each function."""
    rows = []
    for function in functions:
        logs = call_user(function, x)
        rows.append(check_array(logs, "log_p, log_qs", x.shape[:1]))
    return np.stack(rows)


def _tensor_grid(low: Array, high: Array, nodes: int) -> tuple[Array, Array]:
    """Points (nodes^d, d) of the trapezoid rule on a box from `low` to `high` (d,), and weights."""
    d = low.size
    # The number of each point's node along each axis, (nodes^d, d)
    index = np.indices((nodes,) * d).reshape(d, nodes**d).T
    step = (high - low) / (nodes - 1)
    # The nodes at both ends of an axis count half.
    is_end = (index == 0) | (index == nodes - 1)
    weights = np.prod(np.where(is_end, 0.5 * step, step), axis=1)
    return low + step * index, weights


@validated
def jeffreys_by_sampling(
    log_p: Callable[[Array], Array],
    log_q: Callable[[Array], Array],
    proposal: GaussianMixture,
    *,
    members: AtLeastTwo,
    rng: Rng,
) -> Divergence:
    r"""Jeffreys' divergence by importance sampling, with its standard error.

    :math:`\tfrac12(\mathrm E_p[r]-\mathrm E_q[r])` with :math:`r=\log p-\log q`, each expectation
    with self-normalised weights; constants in the logarithms cancel. The error is that of the
    linearised ratio estimates, of both on the same points.

    Parameters
    ----------
    log_p, log_q : callable
        Logarithms of densities, normalised or not: points (n, d) to values (n,).
    proposal : GaussianMixture
        Density from which the points are drawn; it should be wide enough for both.
    members : int
        Number of points.
    rng : numpy.random.Generator

    Examples
    --------
    >>> one, two = (GaussianMixture.gaussian([m], [[1.0]]) for m in (0.0, 1.0))
    >>> divergence = jeffreys_by_sampling(
    ...     one.log_density,
    ...     two.log_density,
    ...     one,
    ...     members=4000,
    ...     rng=np.random.default_rng(1),
    ... )
    >>> abs(divergence.value - 0.5) < 3 * divergence.error
    True
    """
    x = proposal.rvs(members, rng=rng)
    log_proposal = proposal.log_density(x)
    p = check_array(call_user(log_p, x), "log_p", log_proposal.shape)
    q = check_array(call_user(log_q, x), "log_q", log_proposal.shape)
    ratio = p - q
    # Weights with mean one, so that expectations are means
    p_weights = _importance_weights(p - log_proposal)
    q_weights = _importance_weights(q - log_proposal)
    p_mean = float((p_weights * ratio).mean())
    q_mean = float((q_weights * ratio).mean())
    # A ratio estimate Σ w r / Σ w is to first order the mean of w (r - E r) / E w.
    influence = p_weights * (ratio - p_mean) - q_weights * (ratio - q_mean)
    error = 0.5 * influence.std(ddof=1) / np.sqrt(ratio.size)
    return Divergence(0.5 * (p_mean - q_mean), float(error))


def _importance_weights(log_ratios: Array) -> Array:
    """Weights (n,) with mean one, from logarithms of density over proposal at n points."""
    weights = np.exp(log_ratios - log_ratios.max())
    return np.asarray(weights / weights.mean())
