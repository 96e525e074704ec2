r"""The convex program behind a component of a separable map: what is linear goes, then Newton.

For the map's component :math:`\Psi\mathbf c + \Phi\mathbf a` the objective (12) is
:math:`\tfrac1{2N}|\Psi\mathbf c+\Phi\mathbf a|^2 - \tfrac1N\sum_i\log(\Phi'\mathbf a)_i`, to be
minimised over free c and nonnegative a.
"""

from __future__ import annotations

import numpy as np

from ..checks import Array, SolverError

__all__: list[str] = []

SINGULAR = 1e-12
"""Eigenvalue, relative to the largest, below which a matrix counts as singular."""

_ITERATIONS = 100


def best_coefficients(
    features: Array, values: Array, rates: Array, linear: int, penalty: float, floor: float
) -> tuple[Array, Array]:
    """Coefficients of one component: those of the earlier variables, then the nonnegative ones.

    For given a, the best c solves a regression, c = -W a, which leaves a quadratic form in a.
    """
    n = features.shape[-2]
    on_c = penalty * (np.arange(features.shape[-1]) >= linear)
    on_a = penalty * (np.arange(values.shape[-1]) >= 1)
    across = np.swapaxes(features, -1, -2)
    normal = across @ features / n + np.diag(on_c)
    ends = np.linalg.eigvalsh(normal)
    if (ends[..., 0] < SINGULAR * ends[..., -1]).any():
        raise ValueError("regularisation: needs a positive value, for the basis functions are not "
                         f"independent on these samples, got {penalty:g}")
    regression = np.linalg.solve(normal, across @ values / n)
    left = values - features @ regression
    quadratic = (
        np.swapaxes(left, -1, -2) @ left / n
        + np.swapaxes(regression, -1, -2) @ (on_c[:, None] * regression)
        + np.diag(on_a)
    )
    lower = np.where(np.arange(values.shape[-1]) == 0, floor, 0.0)
    a = _nonnegative(quadratic, rates, lower)
    return -np.asarray((regression @ a[..., None])[..., 0]), a


def _nonnegative(quadratic: Array, rates: Array, lower: Array) -> Array:
    """Minimise a'Qa / 2 - mean(log(rates a)) over a >= lower by projected Newton steps."""
    r, n = quadratic.shape[-1], rates.shape[-2]
    a = np.broadcast_to(lower, quadratic.shape[:-1]).copy()
    a[..., 0] = np.maximum(lower[0], 1 / np.sqrt(quadratic[..., 0, 0]))
    for _ in range(_ITERATIONS):
        ratio = rates / (rates @ a[..., None])
        gradient = (quadratic @ a[..., None])[..., 0] - ratio.mean(axis=-2)
        free = (a > lower) | (gradient < 0)
        hessian = quadratic + np.swapaxes(ratio, -1, -2) @ ratio / n
        both = free[..., :, None] & free[..., None, :]
        # Held coefficients get a row of the identity, and so a step of zero.
        system = np.where(both, hessian, np.eye(r))
        step = -np.linalg.solve(system, np.where(free, gradient, 0.0)[..., None])[..., 0]
        decrement = -(np.where(free, gradient, 0.0) * step).sum(axis=-1)
        a = _shortened(quadratic, rates, lower, a, step, gradient)
        if (decrement < 1e-13).all():
            return a
    raise SolverError(
        f"separable: no minimum of (12) after {_ITERATIONS} Newton steps, "
        f"decrement {decrement.max():.3g}"
    )


def _shortened(
    quadratic: Array, rates: Array, lower: Array, a: Array, step: Array, gradient: Array
) -> Array:
    """Move along the projected step, halved in each run until the objective falls enough."""

    def loss(c: Array) -> Array:
        form = 0.5 * (c[..., None, :] @ quadratic @ c[..., None])[..., 0, 0]
        return np.asarray(form - np.log((rates @ c[..., None])[..., 0]).mean(axis=-1))

    before, t = loss(a), np.ones(a.shape[:-1])
    for _ in range(40):
        new = np.maximum(lower, a + t[..., None] * step)
        wanted = 1e-4 * (gradient * (new - a)).sum(axis=-1)
        # Near the minimum the fall is lost in rounding.
        good = loss(new) <= before + wanted + 1e-14 * (1 + np.abs(before))
        if good.all():
            break
        t = np.where(good, t, 0.5 * t)
    return np.asarray(new)
