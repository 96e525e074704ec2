r"""Updates by the Kalman gain, with four ways to treat the noise of the observation; forecasts.

With the sample covariances :math:`\hat{\mathbf C}` of members and predictions, and one draw
:math:`\zeta_i` of the noise for each member,

.. math:: \mathbf x_i' = \mathbf x_i + \mathbf K(\mathbf y^* - \mathbf h(\mathbf x_i) - \zeta_i),
    \qquad \mathbf K = \hat{\mathbf C}_{xh}(\hat{\mathbf C}_{hh} + \mathbf R)^{-1}.

The updates differ in the estimate of R in the gain and in the draws. A forecast adds the model's
noise to the members, by independent draws or exact to second order.
"""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np

from ..ensembles import Ensemble, exact_noise
from ..linalg import center_ensemble, cholesky, solve_definite
from ..models import Model
from ..periods import step_members
from ..validation import Array, NonNegativeFloat, Rng, validated
from .decorator import perturb_observations, update

__all__ = [
    "enkf",
    "enkf_exact",
    "enkf_sampled_covariance",
    "etkf",
    "exact_forecast",
    "stochastic_forecast",
]

ModelEnsemble = Annotated[Ensemble, "... n model.dim"]
"""At least two members with a model's number of components."""


def _solve_gain(
    anomalies: Array, predicted_anomalies: Array, noise: Array | float = 0.0
) -> Array:
    """Return the gain transposed, K' = (C_hh + R)⁻¹ C_hx, (..., m, d), by a solve.

    The anomalies are those of the members, (..., N, d), and of their predictions, (..., N, m); the
    noise covariance R is (..., m, m). Members are rows, so that they move by ``innovations @ K'``.
    The gain itself is K = C_xh (C_hh + R)⁻¹.
    """
    # Both covariances times N - 1, which cancels.
    scaled_noise = (anomalies.shape[-2] - 1) * noise
    innovation_covariance = predicted_anomalies.mT @ predicted_anomalies + scaled_noise
    return solve_definite(innovation_covariance, predicted_anomalies.mT @ anomalies)


@update
def enkf_sampled_covariance(
    ensemble: Array, predicted: Array, observed: Array, noise: Array, *, rng: Rng
) -> Array:
    r"""Update with the sample covariances of the perturbed predictions in the gain.

    The gain is :math:`\hat{\mathbf\Sigma}_{xy}\hat{\mathbf\Sigma}_{yy}^{-1}` of the perturbed
    predictions :math:`\mathbf y_i = \mathbf h(\mathbf x_i)+\zeta_i`: the composed affine map of
    Grange et al. gives the same result. Chance correlations of members and draws enter the gain, so
    a small ensemble loses its spread; with :func:`enkf` it does not.

    Parameters
    ----------
    ensemble : array_like, (..., N, d)
        Forecast members, more than m.
    predicted : array_like, (..., N, m)
        Each member's predicted observation, without noise. A circular component must be on the
        branch of the observation: ``observed - sensor.residual(observed, h(x_i))``.
    observed : array_like, (..., m)
        The observation y*.
    noise : array_like, (m, m) or (..., m, m)
        Covariance R of the observation's noise, positive definite.
    rng : numpy.random.Generator
        Source of the perturbations :math:`\zeta_i\sim N(0, \mathbf R)`.

    Notes
    -----
    G. Burgers, P. J. van Leeuwen, G. Evensen, Monthly Weather Review 126 (1998) 1719-1724.

    Examples
    --------
    >>> rng = np.random.default_rng(1)
    >>> prior = rng.standard_normal((2000, 1))
    >>> after = enkf_sampled_covariance(prior, prior, [2.0], [[1.0]], rng=rng)
    >>> after.mean().round(1), after.var().round(1)
    (np.float64(1.0), np.float64(0.5))
    >>> enkf_sampled_covariance(np.eye(2), np.eye(2), [0.0, 0.0], np.eye(2), rng=rng)
    Traceback (most recent call last):
    ValueError: ensemble must have at least 3 members for 2 observations, got 2
    """
    n, m = predicted.shape[-2:]
    # The sample covariance of the perturbed predictions has rank N - 1 at most.
    if n <= m:
        raise ValueError(
            f"ensemble must have at least {m + 1} members for {m} observations, got {n}"
        )
    perturbed = perturb_observations(predicted, noise, rng)
    # The gain transposed, (..., m, d), since members are rows; without R, which is in the sample
    # covariance of the perturbed predictions.
    anomalies = center_ensemble(ensemble).anomalies
    gain = _solve_gain(anomalies, center_ensemble(perturbed).anomalies)
    # x_i + K (y* - y_i), as rows.
    innovations = observed[..., None, :] - perturbed
    return np.asarray(ensemble + innovations @ gain)


@update
def enkf(
    ensemble: Array,
    predicted: Array,
    observed: Array,
    noise: Array,
    *,
    rng: Rng,
    centred: bool = False,
) -> Array:
    r"""Update with perturbed observations and with R itself in the gain.

    Chance correlations of the members with the drawn noise do not enter the gain, unlike in
    :func:`enkf_sampled_covariance`, and :math:`\hat{\mathbf C}_{hh}+\mathbf R` can be inverted for
    any number of members.

    Parameters
    ----------
    ensemble, predicted, observed, noise, rng
        As in :func:`enkf_sampled_covariance`; two members are enough.
    centred : bool
        Subtract the draws' mean, so that they do not change the ensemble's; this helps with ten or
        twenty members.

    Examples
    --------
    >>> rng = np.random.default_rng(3)
    >>> prior = rng.standard_normal((1000, 1))
    >>> posterior = enkf(prior, prior, [1.0], [[1.0]], rng=rng)
    >>> posterior.mean().round(1), posterior.var().round(1)
    (np.float64(0.5), np.float64(0.5))
    """
    perturbed = perturb_observations(predicted, noise, rng, centred=centred)
    anomalies = center_ensemble(ensemble).anomalies
    # The gain transposed, (..., m, d), since members are rows
    gain = _solve_gain(anomalies, center_ensemble(predicted).anomalies, noise)
    # x_i + K (y* - y_i) with the perturbed predictions y_i; the results overwrite arrays that were
    # made here, which saves time.
    innovations = np.subtract(observed[..., None, :], perturbed, out=perturbed)
    analysis = innovations @ gain
    return np.asarray(np.add(analysis, ensemble, out=analysis))


@update
def enkf_exact(
    ensemble: Array, predicted: Array, observed: Array, noise: Array, *, rng: Rng
) -> Array:
    r"""Update with perturbations that are exact to second order.

    The draws are centred over the members, orthogonal to the members' and the predictions'
    anomalies, and have the sample covariance R. The sampled gain then *is* the gain of
    :func:`enkf`, and :math:`\mathbf P^+=(\mathbf I-\mathbf K\mathbf H)\mathbf P` holds for
    the sample covariances themselves: no known covariance is estimated.

    Parameters
    ----------
    ensemble, predicted, observed, noise, rng
        As in :func:`enkf_sampled_covariance`; more than d + 2m members (d + m if the predictions
        are linear in the members).

    Examples
    --------
    Halfway between prior and observation, with half the variance, for any draws:

    >>> prior = np.array([[-1.0], [0.0], [0.5], [0.5]])
    >>> after = enkf_exact(prior, prior, [1.0], [[0.5]], rng=np.random.default_rng(0))
    >>> float(after.mean().round(12)), float(after.var(ddof=1).round(12))
    (0.5, 0.25)
    """
    anomalies = center_ensemble(ensemble).anomalies
    predicted_anomalies = center_ensemble(predicted).anomalies
    # Orthogonal to both, so that no sample covariance with the draws enters P⁺.
    joint_anomalies = np.concatenate([anomalies, predicted_anomalies], axis=-1)
    draws = exact_noise(joint_anomalies, cholesky(noise), rng)
    # The gain transposed, (..., m, d), since members are rows
    gain = _solve_gain(anomalies, predicted_anomalies, noise)
    # x_i + K (y* - h(x_i) - ζ_i).
    innovations = observed[..., None, :] - predicted - draws
    return np.asarray(ensemble + innovations @ gain)


@update
def etkf(
    ensemble: Array,
    predicted: Array,
    observed: Array,
    noise: Array,
    *,
    rng: Rng,
    rotation: Literal["random", "none"] = "random",
) -> Array:
    r"""Update mean and anomalies without perturbations, then rotate the members at random.

    With the whitened predictions :math:`\mathbf s_i=\mathbf R^{-1/2}(\mathbf h(\mathbf x_i)
    -\bar{\mathbf h})/\sqrt{N-1}` as the rows of S, the mean moves by the Kalman gain and the
    anomalies are multiplied by :math:`(\mathbf I+\mathbf S\mathbf S^\top)^{-1/2}`, the symmetric
    root, which leaves their mean at zero. A random rotation of the members that keeps the vector
    of ones changes neither mean nor covariance. It removes the outliers that repeated deterministic
    updates of a nonlinear model produce.

    Parameters
    ----------
    ensemble, predicted, observed, noise, rng
        As in :func:`enkf_sampled_covariance`; two members are enough.
    rotation : {"random", "none"}
        Whether the members are rotated.

    Notes
    -----
    C. H. Bishop, B. J. Etherton, S. J. Majumdar, Monthly Weather Review 129 (2001) 420-436;
    P. Sakov, P. R. Oke, Monthly Weather Review 136 (2008) 1042-1053, for the rotation.

    Examples
    --------
    >>> prior = np.array([[-1.0], [1.0]])
    >>> after = etkf(prior, prior, [2.0], [[2.0]], rng=np.random.default_rng(0))
    >>> float(after.mean().round(12)), float(after.var(ddof=1).round(12))
    (1.0, 1.0)
    """
    n = ensemble.shape[-2]
    mean, anomalies = center_ensemble(ensemble)
    predicted_mean, predicted_anomalies = center_ensemble(predicted)
    # The gain transposed, (..., m, d), since members are rows
    gain = _solve_gain(anomalies, predicted_anomalies, noise)
    # S = U D Vᵀ, so (I + S Sᵀ)^(-1/2) = I + U ((1 + D²)^(-1/2) - 1) Uᵀ.
    root = np.linalg.cholesky(noise)
    whitened = np.linalg.solve(root, predicted_anomalies.mT).mT / np.sqrt(n - 1)
    u, sizes, _vh = np.linalg.svd(whitened, full_matrices=False)
    shrinkage = 1 / np.sqrt(1 + sizes**2) - 1
    anomalies = anomalies + (u * shrinkage[..., None, :]) @ (u.mT @ anomalies)
    # Two centred members have one direction only.
    if rotation == "random" and n > 2:
        anomalies = _rotate_members(anomalies, rng)
    # x̄ + K (y* - h̄).
    shift = (observed[..., None, :] - predicted_mean) @ gain
    return np.asarray(mean + shift + anomalies)


def _rotate_members(anomalies: Array, rng: Rng) -> Array:
    """Apply a random rotation of the members (..., N, d) that keeps the vector of ones.

    Random signs and cosine transforms alternate in the space of centred members: orthogonal to
    rounding, in N log N steps instead of the N³ of a random matrix. The members are given by their
    anomalies, whose mean is zero.
    """
    from scipy.fft import dct

    n = anomalies.shape[-2]
    # The reflection I - 2 v v' takes the direction of ones, 1/√N, to the first unit vector e_1 for
    # v = (e_1 - 1/√N) / |e_1 - 1/√N|, and is its own inverse. The other coordinates are those of
    # the centred members.
    v = np.full(n, -1 / np.sqrt(n))
    v[0] += 1
    v /= np.linalg.norm(v)
    reflected = anomalies - 2 * v[:, None] * (v @ anomalies)[..., None, :]
    # The first coordinate, along the ones, stays.
    first = reflected[..., :1, :]
    rotated = reflected[..., 1:, :]
    # Three rounds mix about as well as a uniformly random rotation (A. Andoni et al., NIPS 2015).
    for _ in range(3):
        rotated = dct(_draw_signs(rotated, rng) * rotated, norm="ortho", axis=-2)
    rotated = _draw_signs(rotated, rng) * rotated
    reflected = np.concatenate([first, rotated], axis=-2)
    return np.asarray(reflected - 2 * v[:, None] * (v @ reflected)[..., None, :])


def _draw_signs(x: Array, rng: Rng) -> Array:
    """Draw a sign for each row of x (..., N, d), (..., N, 1)."""
    normal = rng.standard_normal((*x.shape[:-1], 1))
    return np.copysign(1.0, normal)


@validated
def stochastic_forecast(
    ensemble: ModelEnsemble, model: Model, t: float, dt: NonNegativeFloat, *, rng: Rng
) -> Array:
    """Forecast every member by the model, with an independent draw of its noise, (..., N, d).

    Parameters
    ----------
    ensemble : array_like, (..., N, d)
        Members at time `t`.
    model : Model
    t, dt : float
        Start and length of the forecast, in s.
    rng : numpy.random.Generator

    Examples
    --------
    >>> still = Model(1, lambda x, t, dt: x, lambda t, dt: np.zeros((1, 1)))
    >>> stochastic_forecast(
    ...     [[1.0], [2.0]], still, 0.0, 0.1, rng=np.random.default_rng(0)
    ... ).ravel()
    array([1., 2.])
    """
    if model.has_state_noise:
        # The noise of each member depends on its state.
        return model.sample_step(ensemble, t, dt, rng=rng)
    if model.periods:
        # Angles stay on one branch, so that the members have a mean.
        forecast = step_members(model, ensemble, t, dt)
    else:
        forecast = model.step(ensemble, t, dt)
    root = model.noise_sqrt(t, dt)
    # Without noise nothing is drawn.
    if not np.count_nonzero(root):
        return forecast
    # w_i = L ξ_i with Q = L Lᵀ; members are rows, so ξ multiplies Lᵀ. A contiguous copy is faster.
    normal = rng.standard_normal(forecast.shape)
    return forecast + normal @ np.ascontiguousarray(root.T)


@validated
def exact_forecast(
    ensemble: ModelEnsemble, model: Model, t: float, dt: NonNegativeFloat, *, rng: Rng
) -> Array:
    r"""Forecast the members by the model, with noise that is exact to second order.

    The draws are centred, orthogonal to the forecast members' anomalies, and have the sample
    covariance Q: for a linear model the sample covariance becomes
    :math:`\boldsymbol\Phi\mathbf P\boldsymbol\Phi^\top+\mathbf Q` to rounding.

    Parameters
    ----------
    ensemble, model, t, dt, rng
        As for :func:`stochastic_forecast`; more members than d + the rank of Q.

    Examples
    --------
    >>> walk = Model(1, lambda x, t, dt: x, lambda t, dt: np.array([[dt]]))
    >>> x = np.array([[-1.0], [0.0], [0.5], [0.5]])
    >>> forecast = exact_forecast(x, walk, 0.0, 0.5, rng=np.random.default_rng(0))
    >>> bool(abs(forecast.mean()) < 1e-12), float(forecast.var(ddof=1).round(12))
    (True, 1.0)
    """
    if model.has_state_noise:
        raise ValueError(
            "model must have a noise that does not depend on the state for an exact forecast, got "
            f"a {type(model).__name__}: use stochastic_forecast"
        )
    if model.periods:
        # Angles stay on one branch, so that the members have a mean.
        forecast = step_members(model, ensemble, t, dt)
    else:
        forecast = model.step(ensemble, t, dt)
    root = model.noise_sqrt(t, dt)
    # Without noise nothing is drawn.
    if not root.any():
        return forecast
    # An ensemble with a member that is not finite has no sample covariance. Its prior stands in for
    # it when the noise is drawn, so that the other ensembles get the noise that they would get
    # anyway; the result is NaN.
    failed = ~np.isfinite(forecast).all(axis=(-2, -1), keepdims=True)
    finite = np.where(failed, ensemble, forecast)
    noisy = finite + exact_noise(center_ensemble(finite).anomalies, root, rng)
    return np.where(failed, np.nan, noisy)
