"""Updates by transport: maps of the joint ensemble of (y, x), and couplings of weighted members."""

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
    Mask,
    NonNegativeFloat,
    PositiveInt,
    Rng,
    call_user,
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
"""A factor of noise; bounded, so that their product is finite."""
Fit = Callable[[Array, Array], ConditionalMap]
"""``fit(y, x) -> map``: an estimator of the map that takes the samples to the reference."""

_ROUNDING = 1e-6
"""The part of a component, relative to it, that others leave unexplained by rounding."""


def _perturb(predicted: Array, noise: Array, factor: float, rng: Rng) -> Array:
    """Add a draw of the noise, times a factor, to predictions (..., N, m); none if it is zero."""
    if not factor:
        return predicted
    return perturb_observations(predicted, factor**2 * noise, rng)


def _condition(fit: Fit, predicted: Array, members: Array, observed: Array) -> Array:
    """Fit a map to samples (y, x), and condition them on an observation by the composed map.

    The samples are predictions (..., N, m) and members (..., N, d); the observation is (..., m).
    The result is members (..., N, d) of the conditional distribution.
    """
    return compose(call_user(fit, predicted, members), predicted, members, observed)


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
    sample covariances, :func:`~distfilt.updates.enkf_sampled_covariance`. Components that are
    constant over the members, or combinations of others, follow from the others.

    Parameters
    ----------
    ensemble, predicted, observed, noise, rng
        As in :func:`~distfilt.updates.enkf_sampled_covariance`; a draw of the noise is added to
        each prediction.
    fit : callable
        ``fit(y, x) -> map``: an estimator of the map, such as
        :func:`distfilt.triangular.separable.fit` with its options.
    noise_factor : float
        Factor of the drawn noise. Any other than 1 is a mistake; chapter 4 shows the effect of 0
        and of 0.01.

    Examples
    --------
    >>> rng = np.random.default_rng(3)
    >>> prior = rng.standard_normal((1000, 1))
    >>> posterior = transport_map_update(prior, prior, [1.0], [[1.0]], rng=rng)
    >>> posterior.mean().round(1), posterior.var().round(1)
    (np.float64(0.5), np.float64(0.5))
    """
    # Joint samples: predictions with noise, and members.
    perturbed = _perturb(predicted, noise, noise_factor, rng)
    try:
        # The map that is fitted to the samples moves each member to the observation.
        return _condition(fit, perturbed, ensemble, observed)
    except ValueError:
        # No map can be fitted to components that are combinations of others: they are left out.
        is_free = _find_independent(ensemble)
        if is_free.all():
            raise
    return _condition_independent(fit, perturbed, ensemble, observed, is_free)


def _find_independent(ensemble: Array) -> Mask:
    """Return which components (d,) of members (..., N, d) those before them do not determine.

    A known constant is determined, and so is a linear combination, in all ensembles of the stack.

    >>> x = np.random.default_rng(0).standard_normal((20, 2))
    >>> _find_independent(np.c_[x[:, 0], 3 * x[:, 0] - 1, np.full(20, 7.0), x[:, 1]])
    array([ True, False, False,  True])
    """
    centre = ensemble.mean(axis=-2)
    anomalies = ensemble - centre[..., None, :]
    r = np.linalg.qr(anomalies, mode="r")
    # |R_kk| is the part of component k that those before it do not explain, and column k of R is as
    # long as its anomalies. The rounding of the mean, which has been subtracted, counts too.
    length = np.linalg.norm(r, axis=-2)
    part = np.abs(np.diagonal(r, axis1=-2, axis2=-1))
    # 32 units in the last place of the mean, in each of N anomalies
    mean_rounding = np.sqrt(ensemble.shape[-2]) * 32 * np.spacing(np.abs(centre))
    is_free = part > _ROUNDING * length + mean_rounding
    return np.asarray(is_free.reshape(-1, ensemble.shape[-1]).any(axis=0))


def _condition_independent(
    fit: Fit, perturbed: Array, ensemble: Array, observed: Array, is_free: Mask
) -> Array:
    """Condition the independent components of members (..., N, d); the others follow from them.

    Predictions with noise are (..., N, m), and the observation is (..., m); `is_free` (d,) marks
    the independent components.
    """
    if not is_free.any():
        return ensemble
    free = ensemble[..., is_free]
    moved = _condition(fit, perturbed, free, observed)
    # The dependent components z are an affine function of the independent x: in anomalies
    # z - m_z = ((x - m_x) / std) B, exactly, with the factors B found by least squares.
    centre = free.mean(axis=-2, keepdims=True)
    rest = ensemble[..., ~is_free]
    rest_centre = rest.mean(axis=-2, keepdims=True)
    anomalies = free - centre
    std = anomalies.std(axis=-2, keepdims=True)
    factors = np.linalg.pinv(anomalies / std) @ (rest - rest_centre)
    result = ensemble.copy()
    result[..., is_free] = moved
    result[..., ~is_free] = rest_centre + ((moved - centre) / std) @ factors
    return result


@validated
def principal_directions(ensemble: Ensemble, n: PositiveInt) -> Array:
    """Return the `n` orthonormal directions of largest sample variance, as columns.

    Parameters
    ----------
    ensemble : array_like, (..., N, d)
        Members.
    n : int
        Number of directions, at most d.

    Examples
    --------
    >>> principal_directions([[-3.0, 0.1], [3.0, 0.1], [0.0, -0.1]], 1).round(
    ...     2
    ... ).tolist()
    [[1.0], [0.0]]
    """
    covariance = sample_covariance(ensemble)
    if not np.isfinite(covariance).all():
        raise ValueError("ensemble must have members of finite variance, got infinity")
    Bounds(at_most=covariance.shape[-1])(n, "n")
    # Eigenvalues come in ascending order.
    vectors = np.linalg.eigh(covariance).eigenvectors
    directions = vectors[..., ::-1][..., :n]
    # The sign is arbitrary: the largest entry becomes positive.
    largest = np.abs(directions).argmax(axis=-2)
    signs = np.sign(np.take_along_axis(directions, largest[..., None, :], axis=-2))
    return np.asarray(directions * signs)


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
    r"""Update in the leading principal directions only, Algorithm 2 of Grange et al.

    Parameters
    ----------
    ensemble, predicted, observed, noise, rng, noise_factor, fit
        As in :func:`transport_map_update`.
    n_state : int
        Number :math:`q_x` of the state's directions that are updated, at most d.
    n_observed : int
        Number :math:`q_y` of the observations' directions that are used: the principal ones of the
        predictions with their drawn noise. All of them if there are fewer observations.
    complement : {"keep", "literal"}
        Treatment of the state outside the leading directions. ``"keep"`` leaves it unchanged.
        ``"literal"`` is line 8 as printed, which sets it to zero, with the mean.

    Examples
    --------
    >>> rng = np.random.default_rng(3)
    >>> prior = rng.standard_normal((1000, 2)) * [2.0, 1.0]
    >>> predicted = prior[:, :1]
    >>> post = principal_components(
    ...     prior, predicted, [1.0], [[1.0]], rng=rng, n_state=1, n_observed=1
    ... )
    >>> post.var(axis=0).round(1)
    array([0.8, 1. ])
    """
    # Predictions with a draw of the noise
    perturbed = _perturb(predicted, noise, noise_factor, rng)
    Bounds(at_most=ensemble.shape[-1])(n_state, "n_state")
    # An agent with few observations uses all of them.
    n_observed = min(n_observed, perturbed.shape[-1])
    observed_directions = principal_directions(perturbed, n_observed)
    directions = principal_directions(ensemble, n_state)
    # Coordinates in the leading directions.
    latent = ensemble @ directions
    latent_predicted = perturbed @ observed_directions
    latent_observed = (observed[..., None, :] @ observed_directions)[..., 0, :]
    # The map that is fitted to these samples moves each member to the observation.
    analysis = _condition(fit, latent_predicted, latent, latent_observed)
    # Back to the state: W v alone, or x_i + W (v_i' - v_i) with the directions W.
    if complement == "literal":
        return np.asarray(analysis @ directions.mT)
    return np.asarray(ensemble + (analysis - latent) @ directions.mT)


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
    cost: Literal["squared", "distance"] = "squared",
) -> Array:
    r"""Weight the members by their likelihoods and transport them to equal weights.

    Equations (3)-(5) of Das and Bhattacharya.

    Reich's ensemble transform particle filter: only the observation's noise has to be Gaussian, and
    nothing is drawn.

    Parameters
    ----------
    ensemble : array_like, (..., N, d)
        Forecast members.
    predicted : array_like, (..., N, m)
        Their predicted observations, without noise.
    observed : array_like, (..., m)
        The observation y*.
    noise : array_like, (m, m) or (..., m, m)
        Its covariance.
    rng : numpy.random.Generator
        Used for `rejuvenation` only.
    correct : bool
        Give the members the weighted covariance too.
    rejuvenation : float
        h of :func:`distfilt.coupling.rejuvenate`; 0 draws nothing.
    cost : {"squared", "distance"}
        As for :func:`distfilt.coupling.transport_plans`. Das and Bhattacharya print the distance.

    Returns
    -------
    ndarray, (..., N, d)
        The mean is the weighted mean to rounding.

    Warns
    -----
    ParticleCollapse
        If one member has nearly all the weight, so that the others become its copies, or if the
        observation is far from the predictions.

    Raises
    ------
    SolverError
        If the solver stops without a solution.

    Examples
    --------
    >>> rng = np.random.default_rng(3)
    >>> prior = rng.standard_normal((400, 1))
    >>> posterior = etpf(prior, prior, [1.0], [[1.0]], rng=rng)
    >>> posterior.mean().round(1), posterior.var().round(1)
    (np.float64(0.5), np.float64(0.5))
    """
    # w_i ∝ p(y* | x_i), then members of equal weights by the optimal coupling.
    log_weights = log_likelihood(predicted, observed, noise)
    warn_of_weights(log_weights, predicted, observed, noise)
    analysis = coupling.transform_ensemble(
        ensemble, log_weights, correct=correct, cost=cost
    )
    if not rejuvenation:
        return analysis
    return coupling.rejuvenate(analysis, ensemble, bandwidth=rejuvenation, rng=rng)


# Filters then bring predicted angles near the observation, each by itself.
vars(etpf)["weights_members"] = True
