"""More mixands where a map bends: split along the direction that the map stretches most."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import minimize_scalar

from ..checks import Array, array, count, instance, number
from .gaussian import GaussianMixture, symmetric, trusted

__all__ = ["split", "split_library", "stretching"]


def split_library(*, std: float = 0.7) -> tuple[Array, Array]:
    r"""Weights and means of three Gaussians of deviation `std` that stand for the standard normal.

    Mean 0 and variance 1 are kept: with weights a, 1 - 2a, a at -m, 0, m that is
    :math:`s^2+2am^2=1`. Of the one freedom left, the smallest integrated squared difference from
    the standard normal density is taken.

    Parameters
    ----------
    std : float
        In (0, 1). Smaller mixands bend less, and fit the tails worse.

    Returns
    -------
    weights, means : ndarray, (3,)

    Examples
    --------
    >>> w, m = split_library(std=0.7)
    >>> round(float(w @ m**2 + 0.7**2), 12)
    1.0
    """
    w, m = _library(number(std, "std", above=0, below=1))
    return w.copy(), m.copy()


@lru_cache(maxsize=16)
def _library(std: float) -> tuple[Array, Array]:
    def parts(a: float) -> tuple[Array, Array]:
        m = np.sqrt((1 - std**2) / (2 * a))
        return np.array([a, 1 - 2 * a, a]), np.array([-m, 0.0, m])

    def overlap(gap: Array | float, variance: float) -> Array:
        return np.asarray(np.exp(-0.5 * np.square(gap) / variance) / np.sqrt(variance))

    def ise(a: float) -> float:
        w, m = parts(a)
        own = w @ overlap(m[:, None] - m, 2 * std**2) @ w
        return float(own - 2 * w @ overlap(m, 1 + std**2))

    found = minimize_scalar(ise, bounds=(0.01, 0.49), method="bounded", options={"xatol": 1e-12})
    return parts(float(found.x))


def stretching(
    factors: ArrayLike, jacobians: ArrayLike, *, scale: ArrayLike | None = None
) -> tuple[Array, Array]:
    r"""How far a linearised map takes each mixand, and from where: first-order stretching.

    The direction :math:`\mathbf u=\mathbf S\mathbf v_1` of one standard deviation, with the first
    right singular vector of :math:`\mathbf G\mathbf S`, is the one with the largest image:
    it solves :math:`\max\|\mathbf G\mathbf u\|` over
    :math:`\mathbf u^\top\mathbf P^{-1}\mathbf u=1`.

    Parameters
    ----------
    factors : array_like, (L, d, d)
        Square roots S of the mixands' covariances.
    jacobians : array_like, (L, m, d)
        Jacobians G at their means.
    scale : array_like, (m,), optional
        What each component of the image is multiplied by before lengths are compared.

    Returns
    -------
    directions : ndarray, (L, d)
        One standard deviation long.
    lengths : ndarray, (L,)
        The largest singular values.

    Examples
    --------
    >>> direction, length = stretching([np.diag([3.0, 1.0])], [np.diag([1.0, 2.0])])
    >>> np.abs(direction), length
    (array([[3., 0.]]), array([3.]))
    """
    s = array(factors, "factors", ("L", "d", "d"))
    g = array(jacobians, "jacobians", (s.shape[0], "m", s.shape[-1]))
    if s.shape[-1] != s.shape[-2]:
        raise ValueError(f"factors: needs square matrices, got shape {s.shape}")
    if scale is not None:
        g = array(scale, "scale", (g.shape[1],))[:, None] * g
    _, values, right = np.linalg.svd(g @ s)
    first = right[:, 0]
    # A singular vector's sign is arbitrary: fix it, though a split does not see it.
    sign = np.sign(first[np.arange(first.shape[0]), np.abs(first).argmax(axis=1)])
    return (s @ (sign[:, None] * first)[..., None])[..., 0], values[:, 0]


def split(
    mixture: GaussianMixture, which: ArrayLike, directions: ArrayLike, *, std: float = 0.7
) -> GaussianMixture:
    r"""Replace some mixands by three along a direction, keeping their mean and covariance.

    With :math:`\mathbf u=\mathbf S\mathbf v` for a unit vector v the pieces are
    :math:`\mathcal N(\mathbf m+m_k\mathbf u,\ \mathbf P-(1-s^2)\mathbf u\mathbf u^\top)`.

    Parameters
    ----------
    mixture : GaussianMixture
    which : array_like of int, (K,)
        Which mixands, each once; the pieces come after those that stay.
    directions : array_like, (K, d)
        One standard deviation long, :math:`\mathbf u^\top\mathbf P^{-1}\mathbf u=1`.
    std : float
        As of :func:`split_library`.

    Examples
    --------
    >>> one = GaussianMixture.gaussian([0.0, 0.0], np.eye(2))
    >>> three = split(one, [0], [[1.0, 0.0]])
    >>> three.size, three.moments()[1].round(12).tolist()
    (3, [[1.0, 0.0], [0.0, 1.0]])
    """
    instance(mixture, "mixture", GaussianMixture)
    array(which, "which")
    at = np.array(
        [count(i, "which", at_least=0) for i in np.atleast_1d(np.asarray(which)).tolist()],
        dtype=np.intp,
    )
    if at.size and (at.max() >= mixture.size or np.unique(at).size != at.size):
        raise ValueError(f"which: needs distinct indices below {mixture.size}, got {at.tolist()}")
    u = array(directions, "directions", (at.size, mixture.dim))
    length = np.linalg.solve(mixture.factors[at], u[..., None])[..., 0]
    if at.size and np.abs((length**2).sum(axis=1) - 1).max() > 1e-6:
        raise ValueError("directions: needs one standard deviation, got another length")
    w, m = _library(number(std, "std", above=0, below=1))
    d = mixture.dim
    means = mixture.means[at][:, None] + m[:, None] * u[:, None]
    less = mixture.covs[at] - (1 - std**2) * u[:, :, None] * u[:, None, :]
    stay = np.setdiff1d(np.arange(mixture.size), at)
    return trusted(
        np.concatenate([mixture.weights[stay], (mixture.weights[at][:, None] * w).ravel()]),
        np.concatenate([mixture.means[stay], means.reshape(-1, d)]),
        np.concatenate([mixture.covs[stay], np.repeat(symmetric(less), 3, axis=0)]),
    )
