r"""Newton's method for separable maps: the convex program of a component, and its inverse.

For the map's component :math:`\Psi\mathbf c + \Phi\mathbf a` the objective (12) is
:math:`\tfrac1{2N}|\Psi\mathbf c+\Phi\mathbf a|^2 - \tfrac1N\sum_i\log(\Phi'\mathbf a)_i`, to be
minimised over free c and nonnegative a. What is linear is eliminated first.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ..doors import Array
from ..linalg import SolverError

__all__ = ["SINGULAR", "best_coefficients", "invert"]

SINGULAR = 1e-12
"""Eigenvalue, relative to the largest, below which a matrix counts as singular."""
_ITERATIONS = 100

Function = Callable[[Array], tuple[Array, Array]]
"""``function(v) -> (value, slope)``, element by element."""


def best_coefficients(
    features: Array, values: Array, rates: Array, linear: int, penalty: float, floor: float
) -> tuple[Array, Array]:
    """Coefficients of one component: those of the earlier variables, then the nonnegative ones.

    For given a, the best c solves a regression, c = -W a, which leaves a quadratic form in a.
    """
    n = features.shape[-2]
    on_c = penalty * (np.arange(features.shape[-1]) >= linear)
    on_a = penalty * (np.arange(values.shape[-1]) >= 1)
    normal = features.mT @ features / n + np.diag(on_c)
    ends = np.linalg.eigvalsh(normal)
    if (ends[..., 0] < SINGULAR * ends[..., -1]).any():
        raise ValueError("regularisation: needs a positive value, for the basis functions are not "
                         f"independent on these samples, got {penalty:g}")
    regression = np.linalg.solve(normal, features.mT @ values / n)
    left = values - features @ regression
    quadratic = left.mT @ left / n + regression.mT @ (on_c[:, None] * regression) + np.diag(on_a)
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
        hessian = quadratic + ratio.mT @ ratio / n
        # Held coefficients get a row of the identity, and so a step of zero.
        system = np.where(free[..., :, None] & free[..., None, :], hessian, np.eye(r))
        slope = np.where(free, gradient, 0.0)
        step = -np.linalg.solve(system, slope[..., None])[..., 0]
        a = _shortened(quadratic, rates, lower, a, step, gradient)
        if (-(slope * step).sum(axis=-1) < 1e-13).all():
            return a
    raise SolverError(f"separable: no minimum of (12) after {_ITERATIONS} Newton steps")


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


def invert(
    function: Function, target: Array, low: Array | None = None, high: Array | None = None
) -> Array:
    """Solve ``function(v) = target`` by Newton's method inside a shrinking bracket.

    A Newton step that would leave the bracket is replaced by a bisection, so the iteration
    converges wherever the function increases. Without ends between which the targets are reached
    they are searched for.

    Raises
    ------
    ValueError
        If a target is outside the function's range.
    SolverError
        If the iteration does not settle, as for a function with jumps.

    Examples
    --------
    >>> invert(lambda v: (np.sinh(v), np.cosh(v)), np.sinh([-2.0, 0.5])).round(9)
    array([-2. ,  0.5])
    """
    low = _end(function, target, -1.0) if low is None else low
    high = _end(function, target, 1.0) if high is None else high
    v, moved = 0.5 * (low + high), high - low
    for _ in range(2 * _ITERATIONS):
        value, slope = function(v)
        gap = value - target
        low, high = np.where(gap <= 0, v, low), np.where(gap >= 0, v, high)
        steep = slope > 0
        newton = v - gap / np.where(steep, slope, 1.0)
        step = np.abs(newton - v)
        enough = 1e-13 * (1 + np.abs(v))
        # A step that has settled may stand on an end of its bracket; any other has to be inside
        # and half as long as the last, or Newton's method could go to and fro for ever.
        good = (newton > low) & (newton < high) & (step <= 0.5 * moved)
        new = np.where(steep & (good | (step <= enough)), newton, 0.5 * (low + high))
        moved, v = np.abs(new - v), new
        if (moved <= enough).all():
            # Halving settles at a jump as well, where the value is not reached.
            if ((step <= enough) | (np.abs(gap) <= 1e-9 * (1 + np.abs(target)))).all():
                return np.asarray(v)
            break
    raise SolverError("separable: the map's inverse did not settle at all targets")


def _end(function: Function, target: Array, sign: float) -> Array:
    """Places beyond which each target is reached, to the left or to the right, up to 2^60."""
    end = np.full(target.shape, sign)
    for k in range(1, 61):
        short = sign * (function(end)[0] - target) < 0
        if not short.any():
            return end
        end = np.where(short, sign * 2.0**k, end)
    raise ValueError(
        f"z: needs targets inside the range of the map, got {int(short.sum())} of {short.size} "
        f"outside, such as {target[short][0]:.6g}"
    )
