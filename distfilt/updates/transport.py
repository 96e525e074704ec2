"""Updates by transport: maps of the joint ensemble of (y, x), and couplings of its weights."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Literal

import numpy as np

from .. import coupling
from ..ensembles import Ensemble, sample_covariance
from ..triangular import affine, compose
from ..triangular.affine import ConditionalMap
from ..validation import (
    Array,
    Bounds,
    NonNegativeFloat,
    PositiveInt,
    Rng,
    validated,
)
from .decorator import perturb_observations, update
from .particles import log_likelihood, warn_of_weights

__all__ = [
    "etpf",
    "principal_components",
    "principal_directions",
    "transport_map_update",
]

Factor = Annotated[float, Bounds(at_least=0, at_most=1e100)]
Fit = Callable[[Array, Array], ConditionalMap]
"""``fit(y, x) -> map``: an estimator of the map that takes the samples to the reference."""


def _noisy(seen: Array, noise: Array, factor: float, rng: Rng) -> Array:
    return perturb_observations(seen, factor**2 * noise, rng) if factor else seen


@update
def transport_map_update(
    ensemble: Array,
    predicted: Array,
    observed: Array,
    noise: Array,
    *,
    rng: Rng,
    fit: Fit = affine.fit,
    noise_factor: Factor = 1.0,
) -> Array:
    """Condition an ensemble with a composed map, equations (10)-(13) of Grange et al.

    With the affine map, the default, this is exactly the stochastic ensemble Kalman filter with
    sample covariances, :func:`~distfilt.updates.enkf_sampled_covariance`.

    Parameters
    ----------
    ensemble, predicted, observed, noise, rng
        As in :func:`~distfilt.updates.enkf_sampled_covariance`; a draw of the noise is added to each
        prediction.
    fit : callable
        ``fit(y, x) -> map``: an estimator of the map, such as
        :func:`distfilt.triangular.separable.fit` with its options.
    noise_factor : float
        By what the drawn noise is multiplied. Anything but one is a mistake; chapter 4 shows what
        zero and a hundredth do.

    Examples
    --------
    >>> rng = np.random.default_rng(3)
    >>> prior = rng.standard_normal((1000, 1))
    >>> posterior = transport_map_update(prior, prior, [1.0], [[1.0]], rng=rng)
    >>> posterior.mean().round(1), posterior.var().round(1)
    (np.float64(0.5), np.float64(0.5))
    """
    seen = _noisy(predicted, noise, noise_factor, rng)
    return compose(fit(seen, ensemble), seen, ensemble, observed)


@validated
def principal_directions(ensemble: Ensemble, n: PositiveInt) -> Array:
    """The `n` orthonormal directions of largest sample variance, as columns.

    Parameters
    ----------
    ensemble : array_like, (..., N, d)
        Members.
    n : int
        How many, at most d.

    Examples
    --------
    >>> principal_directions([[-3.0, 0.1], [3.0, 0.1], [0.0, -0.1]], 1).round(
    ...     2
    ... ).tolist()
    [[1.0], [0.0]]
    """
    cov = sample_covariance(ensemble)
    if not np.isfinite(cov).all():
        raise ValueError("ensemble must have members of finite variance, got infinity")
    Bounds(at_most=cov.shape[-1])(n, "n")
    _, vectors = np.linalg.eigh(cov)
    chosen = vectors[..., ::-1][..., :n]
    largest = np.take_along_axis(
        chosen, np.abs(chosen).argmax(axis=-2)[..., None, :], axis=-2
    )
    return np.asarray(chosen * np.sign(largest))


@update
def principal_components(
    ensemble: Array,
    predicted: Array,
    observed: Array,
    noise: Array,
    *,
    rng: Rng,
    n_state: PositiveInt,
    n_observed: PositiveInt,
    complement: Literal["keep", "literal"] = "keep",
    noise_factor: Factor = 1.0,
    fit: Fit = affine.fit,
) -> Array:
    r"""Condition in the leading principal directions only, Algorithm 2 of Grange et al.

    Parameters
    ----------
    ensemble, predicted, observed, noise, rng, noise_factor, fit
        As in :func:`transport`.
    n_state : int
        Directions :math:`q_x` of the state that are updated, at most d.
    n_observed : int
        Directions :math:`q_y` of the observations that are used; where there are fewer
        observations, all of them.
    complement : {"keep", "literal"}
        What happens to the state outside the leading directions. ``"keep"`` leaves it as it was.
        ``"literal"`` is line 8 as printed, which loses it, and the mean there too.

    Examples
    --------
    >>> rng = np.random.default_rng(3)
    >>> prior = rng.standard_normal((1000, 2)) * [2.0, 1.0]
    >>> sees_x = prior[:, :1]
    >>> post = principal_components(
    ...     prior, sees_x, [1.0], [[1.0]], rng=rng, n_state=1, n_observed=1
    ... )
    >>> post.var(axis=0).round(1)
    array([0.8, 1. ])
    """
    seen = _noisy(predicted, noise, noise_factor, rng)
    m = seen.shape[-1]
    d = ensemble.shape[-1]
    Bounds(at_most=d)(n_state, "n_state")
    v = principal_directions(seen, min(n_observed, m))
    w = principal_directions(ensemble, n_state)
    latent = ensemble @ w
    reduced = seen @ v
    aim = (observed[..., None, :] @ v)[..., 0, :]
    moved = compose(fit(reduced, latent), reduced, latent, aim)
    back = w.mT
    if complement == "literal":
        return np.asarray(moved @ back)
    return np.asarray(ensemble + (moved - latent) @ back)


@update
def etpf(
    ensemble: Array,
    predicted: Array,
    observed: Array,
    noise: Array,
    *,
    rng: Rng,
    correct: bool = False,
    rejuvenation: NonNegativeFloat = 0.0,
) -> Array:
    r"""Weigh the members by their likelihoods and transport the weights to equal ones, (3)-(5).

    Reich's ensemble transform particle filter: nothing is Gaussian but the noise of the reading,
    and nothing is drawn.

    Parameters
    ----------
    ensemble : array_like, (..., N, d)
        Forecast members.
    predicted : array_like, (..., N, m)
        What they would observe, without noise.
    observed : array_like, (..., m)
        The observation y*.
    noise : array_like, (m, m) or (..., m, m)
        Its covariance.
    rng : numpy.random.Generator
        Used for `rejuvenation` only.
    correct : bool
        Give the members the weighted covariance too.
    rejuvenation : float
        h of :func:`distfilt.coupling.rejuvenated`; 0 draws nothing.

    Returns
    -------
    ndarray, (..., N, d)
        The mean is the weighted mean to rounding.

    Warns
    -----
    ParticleCollapse
        If one member has nearly all the weight, so that the others become its copies, or the
        reading is far beyond the spread that is left of the members.

    Raises
    ------
    SolverError
        If a linear programme is not solved.

    Examples
    --------
    >>> rng = np.random.default_rng(3)
    >>> prior = rng.standard_normal((400, 1))
    >>> posterior = etpf(prior, prior, [1.0], [[1.0]], rng=rng)
    >>> posterior.mean().round(1), posterior.var().round(1)
    (np.float64(0.5), np.float64(0.5))
    """
    logs = log_likelihood(predicted, observed, noise)
    warn_of_weights(logs, predicted, observed, noise)
    out = coupling.transform_ensemble(ensemble, logs, correct=correct)
    if not rejuvenation:
        return out
    return coupling.rejuvenate(out, ensemble, bandwidth=rejuvenation, rng=rng)
