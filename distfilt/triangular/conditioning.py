"""Updates by transport: from the joint ensemble of (y, x) to the conditional one of x given y*.

Every update here has the signature ``(ensemble, predicted, observed, noise, *, rng) -> ensemble``.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from ..checks import Array, array, choice, count, covariance, generator
from ..ensembles import anomalies, sample_covariance
from ..linalg import factor
from . import affine

__all__ = [
    "ConditionalMap",
    "affine_update",
    "compose",
    "pca_update",
    "principal_directions",
    "sample_update",
]


class ConditionalMap(Protocol):
    """What a map offers: z = S(y, x), its inverse in x, the derivative's log-determinant."""

    def __call__(self, y: ArrayLike, x: ArrayLike) -> Array:
        """Reference samples of members."""

    def inverse(self, y: ArrayLike, z: ArrayLike) -> Array:
        """Members of reference samples."""

    def log_det(self, y: ArrayLike, x: ArrayLike) -> Array:
        """Log-determinant at each member."""


def compose(map_: ConditionalMap, y: ArrayLike, x: ArrayLike, observed: ArrayLike) -> Array:
    r"""The composed map (10): from the joint samples to samples given the observation.

    .. math:: \mathbf T(\mathbf y,\mathbf x)
        = \mathbf S(\mathbf y^*,\cdot)^{-1}\circ\mathbf S(\mathbf y,\mathbf x)

    Parameters
    ----------
    map_ : ConditionalMap
        The x-block S of a triangular map.
    y : array_like, (..., N, m)
        Predicted observations of the members, with noise.
    x : array_like, (..., N, d)
        Members.
    observed : array_like, (..., m)
        What was observed, y*.

    Returns
    -------
    ndarray, (..., N, d)

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> x = rng.standard_normal((400, 1))
    >>> y = x + rng.standard_normal((400, 1))
    >>> compose(affine.fit(y, x), y, x, [2.0]).mean().round(1)
    np.float64(1.0)
    """
    members = array(x, "x", (..., "N", "d"))
    seen = array(y, "y", (*members.shape[:-1], "m"))
    target = array(observed, "observed", (..., seen.shape[-1]))
    return map_.inverse(target, map_(seen, members))


def _inputs(
    ensemble: ArrayLike, predicted: ArrayLike, observed: ArrayLike, noise: ArrayLike
) -> tuple[Array, Array, Array, Array]:
    members = array(ensemble, "ensemble", (..., "N", "d"))
    seen = array(predicted, "predicted", (*members.shape[:-1], "m"))
    m = seen.shape[-1]
    target = array(observed, "observed", (*members.shape[:-2], m))
    return members, seen, target, covariance(noise, "noise", m)


def affine_update(
    ensemble: ArrayLike,
    predicted: ArrayLike,
    observed: ArrayLike,
    noise: ArrayLike,
    *,
    rng: np.random.Generator,
    perturb: bool = True,
    fit: Callable[[Array, Array], ConditionalMap] = affine.fit,
) -> Array:
    """Condition an ensemble with the composed affine map, equations (10)-(13) of Grange et al.

    With the closed-form fit this is exactly the stochastic ensemble Kalman filter with sample
    covariances.

    Parameters
    ----------
    ensemble : array_like, (..., N, d)
        Forecast members.
    predicted : array_like, (..., N, m)
        What each member would observe, without noise. Readings that wrap have to lie on the
        branch of `observed`.
    observed : array_like, (..., m)
        The observation y*.
    noise : array_like, (m, m)
        Its covariance; a draw of it is added to each prediction.
    rng : numpy.random.Generator
        Source of that draw.
    perturb : bool
        False forgets the noise in the predictions. That is a mistake; chapter 4 shows what it does.
    fit : callable
        ``fit(y, x) -> map``: another estimator of the map, such as
        :func:`distfilt.triangular.affine.fit_convex`.

    Returns
    -------
    ndarray, (..., N, d)

    Raises
    ------
    ValueError
        If shapes do not fit, `noise` is not positive definite, or N ≤ m + d.

    Examples
    --------
    >>> rng = np.random.default_rng(3)
    >>> prior = rng.standard_normal((1000, 1))
    >>> posterior = affine_update(prior, prior, [1.0], [[1.0]], rng=rng)
    >>> posterior.mean().round(1), posterior.var().round(1)
    (np.float64(0.5), np.float64(0.5))
    """
    members, seen, target, cov = _inputs(ensemble, predicted, observed, noise)
    if perturb:
        seen = seen + generator(rng).standard_normal(seen.shape) @ factor(cov).T
    return compose(fit(seen, members), seen, members, target)


def sample_update(
    ensemble: ArrayLike,
    predicted: ArrayLike,
    observed: ArrayLike,
    noise: ArrayLike,
    *,
    rng: np.random.Generator,
    fit: Callable[[Array, Array], ConditionalMap] = affine.fit,
) -> Array:
    r"""Draw a new ensemble from the conditional by the inverse map alone, equation (9).

    .. math:: \mathbf x_i' = \mathbf S(\mathbf y^*,\cdot)^{-1}(\mathbf z_i),\qquad
        \mathbf z_i\sim N(\mathbf 0,\mathbf I)

    The new members forget the old ones. Where the map fits badly, so do they: the composed map
    (10) of :func:`affine_update` makes most of the map's error undo itself.

    Parameters
    ----------
    ensemble, predicted, observed, noise
        As in :func:`affine_update`.
    rng : numpy.random.Generator
        Source of the noise in the predictions and of the reference samples.
    fit : callable
        ``fit(y, x) -> map``.

    Returns
    -------
    ndarray, (..., N, d)

    Examples
    --------
    >>> rng = np.random.default_rng(3)
    >>> prior = rng.standard_normal((4000, 1))
    >>> posterior = sample_update(prior, prior, [1.0], [[1.0]], rng=rng)
    >>> posterior.mean().round(1), posterior.var().round(1)
    (np.float64(0.5), np.float64(0.5))
    """
    members, seen, target, cov = _inputs(ensemble, predicted, observed, noise)
    seen = seen + generator(rng).standard_normal(seen.shape) @ factor(cov).T
    reference = rng.standard_normal(members.shape)
    return fit(seen, members).inverse(target, reference)


def principal_directions(ensemble: ArrayLike, n: int) -> Array:
    """The `n` orthonormal directions of largest sample variance, as columns.

    Parameters
    ----------
    ensemble : array_like, (..., N, d)
        Members.
    n : int
        How many, at most d.

    Returns
    -------
    ndarray, (..., d, n)
        By descending variance. Signs are free, and cancel in every use here.

    Examples
    --------
    >>> principal_directions([[-3.0, 0.1], [3.0, 0.1], [0.0, -0.1]], 1).round(2).tolist()
    [[1.0], [0.0]]
    """
    cov = sample_covariance(ensemble)
    if count(n, "n") > cov.shape[-1]:
        raise ValueError(f"n: needs at most {cov.shape[-1]} directions, got {n}")
    _, vectors = np.linalg.eigh(cov)
    chosen = vectors[..., ::-1][..., :n]
    largest = np.take_along_axis(chosen, np.abs(chosen).argmax(axis=-2)[..., None, :], axis=-2)
    return np.asarray(chosen * np.sign(largest))


def pca_update(
    ensemble: ArrayLike,
    predicted: ArrayLike,
    observed: ArrayLike,
    noise: ArrayLike,
    *,
    rng: np.random.Generator,
    n_state: int,
    n_observed: int,
    complement: str = "keep",
    perturb: bool = True,
) -> Array:
    r"""Condition in the leading principal directions only, Algorithm 2 of Grange et al.

    Parameters
    ----------
    ensemble, predicted, observed, noise, rng, perturb
        As in :func:`affine_update`.
    n_state : int
        Directions :math:`q_x` of the state that are updated, at most d.
    n_observed : int
        Directions :math:`q_y` of the observations that are used; where there are fewer
        observations, all of them.
    complement : {"keep", "drop", "literal"}
        What happens to the state outside the leading directions. ``"keep"`` leaves it as it was.
        ``"drop"`` sets it to the mean. ``"literal"`` is line 8 as printed, which maps uncentred
        states and so also drops the mean there.

    Returns
    -------
    ndarray, (..., N, d)

    Raises
    ------
    ValueError
        As in :func:`affine_update`, or if `n_state` exceeds d.

    Examples
    --------
    >>> rng = np.random.default_rng(3)
    >>> prior = rng.standard_normal((1000, 2)) * [2.0, 1.0]
    >>> sees_x = prior[:, :1]
    >>> post = pca_update(prior, sees_x, [1.0], [[1.0]], rng=rng, n_state=1, n_observed=1)
    >>> post.var(axis=0).round(1)
    array([0.8, 1. ])
    """
    members, seen, target, cov = _inputs(ensemble, predicted, observed, noise)
    choice(complement, "complement", ("keep", "drop", "literal"))
    if perturb:
        seen = seen + generator(rng).standard_normal(seen.shape) @ factor(cov).T
    m, d = seen.shape[-1], members.shape[-1]
    if count(n_state, "n_state") > d:
        raise ValueError(f"n_state: needs at most {d} directions, got {n_state}")
    v = principal_directions(seen, min(count(n_observed, "n_observed"), m))
    w = principal_directions(members, n_state)
    latent = members @ w
    reduced = seen @ v
    aim = (target[..., None, :] @ v)[..., 0, :]
    moved = compose(affine.fit(reduced, latent), reduced, latent, aim)
    back = np.swapaxes(w, -1, -2)
    if complement == "literal":
        return np.asarray(moved @ back)
    if complement == "keep":
        return members + (moved - latent) @ back
    spread = anomalies(members)
    rest = spread - (spread @ w) @ back
    return members - rest + (moved - latent) @ back
