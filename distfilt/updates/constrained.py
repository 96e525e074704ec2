"""Constraints as wrappers: each goes round any update, one round another.

``projected(augmented(ensemble_transform, g, std=0.1), g)`` is Das and Bhattacharya's OTNLeqMA;
``retracted(known_noise, g)`` an ensemble Kalman filter on the manifold.
"""

from __future__ import annotations

import numpy as np

from ..checks import Array, callable_, choice, count, instance, number
from ..coupling import READINGS, Constraint
from ..coupling.constraints import Motion, _motion, _project, _retract
from ..coupling.rules import _augmented, clip
from .door import Update, joined, unchecked

__all__ = ["augmented", "clipped", "projected", "retracted"]


def augmented(update: Update, constraint: Constraint, *, std: float) -> Update:
    r"""Observe the constraint too, as a reading that is nearly perfect, equation (13).

    Parameters
    ----------
    update : callable
        Any update.
    constraint : Constraint
        :math:`\mathbf g(\mathbf x)=\mathbf d`.
    std : float
        Standard deviation of the pretended noise, in the units of g, positive.

    Returns
    -------
    callable
        An update; round :func:`ensemble_transform` it is OTMA.

    Examples
    --------
    >>> from distfilt.coupling import norm
    >>> from distfilt.updates import square_root
    >>> x = 1.3 * np.array([[0.9, 0.2], [1.2, -0.2], [1.1, 0.3], [1.0, -0.1], [0.8, 0.1]])
    >>> knows = augmented(square_root, norm([0, 1]), std=0.01)
    >>> after = knows(x, x[:, 1:], [0.0], [[1.0]], rng=np.random.default_rng(0))
    >>> bool(abs((after**2).sum(axis=1) - 1).mean() < abs((x**2).sum(axis=1) - 1).mean() / 5)
    True
    """
    inner = unchecked(callable_(update, "update"))
    g = instance(constraint, "constraint", Constraint)
    size = number(std, "std", above=0)

    def augment(x: Array, h: Array, y: Array, r: Array, *, rng: np.random.Generator) -> Array:
        return np.asarray(inner(x, *_augmented(x, h, y, r, g, size), rng=rng))

    return joined(augment, update)


def projected(
    update: Update,
    constraint: Constraint,
    *,
    reading: str = "shift",
    regularisation: float = 1e-6,
    guarded: bool = True,
) -> Update:
    """Project the analysis members by regression, equations (6)-(12), and go on from them.

    Parameters
    ----------
    update : callable
        Any update.
    constraint, reading, regularisation, guarded
        As for :func:`distfilt.coupling.project`.

    Returns
    -------
    callable
        An update; round :func:`ensemble_transform` it is OTNLeq. OTProj projects what is reported
        only: call :func:`distfilt.coupling.project` on recorded members.

    Examples
    --------
    >>> from distfilt.coupling import norm
    >>> from distfilt.updates import square_root
    >>> x = 1.3 * np.array([[0.9, 0.2], [1.2, -0.2], [1.1, 0.3], [1.0, -0.1], [0.8, 0.1]])
    >>> on = projected(square_root, norm([0, 1]))
    >>> after = on(x, x[:, 1:], [0.0], [[1.0]], rng=np.random.default_rng(0))
    >>> bool(abs((after**2).sum(axis=1).mean() - 1) < abs((x**2).sum(axis=1).mean() - 1) / 3)
    True
    """
    inner = unchecked(callable_(update, "update"))
    g = instance(constraint, "constraint", Constraint)
    choice(reading, "reading", READINGS)
    eps = number(regularisation, "regularisation", at_least=0)
    careful = instance(guarded, "guarded", bool)

    def follow(x: Array, h: Array, y: Array, r: Array, *, rng: np.random.Generator) -> Array:
        return _project(inner(x, h, y, r, rng=rng), g, reading, eps, careful)

    return joined(follow, update)


def retracted(
    update: Update,
    constraint: Constraint,
    *,
    motion: Motion | None = None,
    tolerance: float = 1e-15,
    iterations: int = 50,
) -> Update:
    """Put every analysis member on the constraint by itself.

    Parameters
    ----------
    update : callable
        Any update.
    constraint, motion, tolerance, iterations
        As for :func:`distfilt.coupling.retract`; with `motion` the velocities become tangent.

    Returns
    -------
    callable
        An update whose members obey the constraint to rounding. Their mean does not: a point
        estimate has to be retracted too.

    Examples
    --------
    >>> from distfilt.coupling import norm
    >>> from distfilt.updates import square_root
    >>> x = 1.3 * np.array([[0.9, 0.2], [1.2, -0.2], [1.1, 0.3], [1.0, -0.1], [0.8, 0.1]])
    >>> on = retracted(square_root, norm([0, 1]))
    >>> after = on(x, x[:, 1:], [0.0], [[1.0]], rng=np.random.default_rng(0))
    >>> bool(abs((after**2).sum(axis=1) - 1).max() < 1e-14)
    True
    """
    inner = unchecked(callable_(update, "update"))
    g = instance(constraint, "constraint", Constraint)
    least = number(tolerance, "tolerance", above=0)
    most = count(iterations, "iterations")
    if motion is not None:
        _motion(motion)

    def follow(x: Array, h: Array, y: Array, r: Array, *, rng: np.random.Generator) -> Array:
        pair = None if motion is None else _motion(motion, x.shape[-1])
        return _retract(inner(x, h, y, r, rng=rng), g, pair, least, most)

    return joined(follow, update)


def clipped(update: Update, constraint: Constraint) -> Update:
    r"""Put analysis members that violate :math:`\mathbf g(\mathbf x)\le\mathbf d` on the boundary.

    Parameters
    ----------
    update : callable
        Any update.
    constraint : Constraint
        One inequality.

    Returns
    -------
    callable
        An update. The spread does not know that the boundary was met.

    Examples
    --------
    >>> from distfilt.coupling import norm
    >>> from distfilt.updates import square_root
    >>> x = 1.3 * np.array([[0.9, 0.2], [1.2, -0.2], [1.1, 0.3], [1.0, -0.1], [0.8, 0.1]])
    >>> within = clipped(square_root, norm([0, 1]))
    >>> after = within(x, x[:, 1:], [0.0], [[1.0]], rng=np.random.default_rng(0))
    >>> bool((after**2).sum(axis=1).max() <= 1 + 1e-14)
    True
    """
    inner = unchecked(callable_(update, "update"))
    g = instance(constraint, "constraint", Constraint)
    if g.value.size != 1:
        raise ValueError(f"constraint: needs one inequality, got {g.value.size}")

    def follow(x: Array, h: Array, y: Array, r: Array, *, rng: np.random.Generator) -> Array:
        return clip(inner(x, h, y, r, rng=rng), g)

    return joined(follow, update)
