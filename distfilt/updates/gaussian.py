r"""Updates by the Kalman gain, with four ways to treat the noise of the observation; forecasts.

With the sample covariances :math:`\hat{\mathbf C}` of members and predictions, and one draw
:math:`\zeta_i` of the noise for each member,

.. math:: \mathbf x_i' = \mathbf x_i + \mathbf K(\mathbf y^* - \mathbf h(\mathbf x_i) - \zeta_i),
    \qquad \mathbf K = \hat{\mathbf C}_{xh}(\hat{\mathbf C}_{hh} + \mathbf R)^{-1}.

What differs is what stands for R in the gain, and how the draws are made. In a forecast the members
meet the model's noise, plainly drawn or exact to second order.
"""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np

from ..ensembles import Ensemble, center_ensemble, exact_noise
from ..linalg import cholesky, solve_definite
from ..models import Model
from ..validation import Array, NonNegativeFloat, Rng, validated
from .decorator import perturb_observations, update

__all__ = [
    "enkf_exact",
    "exact_forecast",
    "enkf",
    "stochastic_forecast",
    "enkf_sampled_covariance",
    "etkf",
]

Members = Annotated[Ensemble, "... n model.dim"]


def _gain(a: Array, b: Array, noise: Array | float = 0.0) -> Array:
    """The gain transposed, (..., m, d), of anomalies: one solve for all members."""
    return solve_definite(b.mT @ b + (a.shape[-2] - 1) * noise, b.mT @ a)


@update
def enkf_sampled_covariance(
    ensemble: Array, predicted: Array, observed: Array, noise: Array, *, rng: Rng
) -> Array:
    r"""The ensemble Kalman filter's update with both covariances sampled, perturbations included.

    The gain is :math:`\hat{\mathbf\Sigma}_{xy}\hat{\mathbf\Sigma}_{yy}^{-1}` of the perturbed
    predictions :math:`\mathbf y_i = \mathbf h(\mathbf x_i)+\zeta_i`: the composed affine map of
    Grange et al. computes the same. Chance correlations of members and draws enter the gain, so a
    small ensemble loses its spread; :func:`enkf` does not.

    Parameters
    ----------
    ensemble : array_like, (..., N, d)
        Forecast members, more than m.
    predicted : array_like, (..., N, m)
        What each member would observe, without noise. For a reading that wraps, on the branch of
        the observation: ``observed - sensor.residual(observed, h(x_i))``.
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
    ValueError: ensemble must have at least 3 members for 2 readings, got 2
    """
    members, m = predicted.shape[-2:]
    if members <= m:
        raise ValueError(
            f"ensemble must have at least {m + 1} members for {m} readings, got {members}"
        )
    drawn = perturb_observations(predicted, noise, rng)
    b = center_ensemble(drawn)[1]
    gain = _gain(center_ensemble(ensemble)[1], b)
    return np.asarray(ensemble + (observed[..., None, :] - drawn) @ gain)


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
    r"""Update with R itself in the gain, where :func:`enkf_sampled_covariance` has a sample covariance.

    The chance correlations of the members with the drawn noise stay out of the gain, and
    :math:`\hat{\mathbf C}_{hh}+\mathbf R` can be inverted for any number of members.

    Parameters
    ----------
    ensemble, predicted, observed, noise, rng
        As in :func:`enkf_sampled_covariance`; two members are enough.
    centred : bool
        Take the draws' mean off, so that they do not move the ensemble's: worth having with ten or
        twenty members.

    Examples
    --------
    >>> rng = np.random.default_rng(3)
    >>> prior = rng.standard_normal((1000, 1))
    >>> posterior = enkf(prior, prior, [1.0], [[1.0]], rng=rng)
    >>> posterior.mean().round(1), posterior.var().round(1)
    (np.float64(0.5), np.float64(0.5))
    """
    drawn = perturb_observations(predicted, noise, rng, centred=centred)
    gain = _gain(center_ensemble(ensemble)[1], center_ensemble(predicted)[1], noise)
    out = np.subtract(observed[..., None, :], drawn, out=drawn) @ gain
    return np.asarray(np.add(out, ensemble, out=out))


@update
def enkf_exact(
    ensemble: Array, predicted: Array, observed: Array, noise: Array, *, rng: Rng
) -> Array:
    r"""Update with perturbations that are exact to second order.

    The draws are centred over the members, orthogonal to the members' and the predictions'
    anomalies, and have the sample covariance R. The sampled gain then *is* the gain of
    :func:`enkf`, and :math:`\mathbf P^+=(\mathbf I-\mathbf K\mathbf H)\mathbf P` holds for
    the sample covariances themselves: what is known is not sampled.

    Parameters
    ----------
    ensemble, predicted, observed, noise, rng
        As in :func:`enkf_sampled_covariance`; more than d + 2m members (d + m where the predictions are
        linear in the members).

    Examples
    --------
    Halfway between prior and observation, with half the variance, whatever was drawn:

    >>> prior = np.array([[-1.0], [0.0], [0.5], [0.5]])
    >>> after = enkf_exact(prior, prior, [1.0], [[0.5]], rng=np.random.default_rng(0))
    >>> float(after.mean().round(12)), float(after.var(ddof=1).round(12))
    (0.5, 0.25)
    """
    a = center_ensemble(ensemble)[1]
    b = center_ensemble(predicted)[1]
    draws = exact_noise(np.concatenate([a, b], axis=-1), cholesky(noise), rng)
    gain = _gain(a, b, noise)
    return np.asarray(ensemble + (observed[..., None, :] - predicted - draws) @ gain)


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
    r"""Update mean and anomalies without perturbations, then turn the anomalies at random.

    With the whitened predictions :math:`\mathbf s_i=\mathbf R^{-1/2}(\mathbf h(\mathbf x_i)
    -\bar{\mathbf h})/\sqrt{N-1}` as the rows of S, the mean moves by the Kalman gain and the
    anomalies are multiplied by :math:`(\mathbf I+\mathbf S\mathbf S^\top)^{-1/2}`, the symmetric
    root, which leaves their mean at zero. A random rotation of the members that keeps the vector
    of ones changes neither mean nor covariance, and mixes away the outliers that repeated
    deterministic updates of a nonlinear model breed.

    Parameters
    ----------
    ensemble, predicted, observed, noise, rng
        As in :func:`enkf_sampled_covariance`; two members are enough.
    rotation : {"random", "none"}
        Whether the anomalies are turned.

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
    (centre, a) = center_ensemble(ensemble)
    (seen, b) = center_ensemble(predicted)
    gain = _gain(a, b, noise)
    root = np.linalg.cholesky(noise)
    white = np.linalg.solve(root, b.mT).mT / np.sqrt(n - 1)
    left, sizes, _ = np.linalg.svd(white, full_matrices=False)
    shrink = 1 / np.sqrt(1 + sizes**2) - 1
    spread = a + (left * shrink[..., None, :]) @ (left.mT @ a)
    if rotation == "random" and n > 2:
        spread = _turned(spread, rng)
    return np.asarray(centre + (observed[..., None, :] - seen) @ gain + spread)


def _turned(spread: Array, rng: Rng) -> Array:
    """Anomalies (..., N, d) after a random rotation of the members that keeps the vector of ones.

    Random signs and cosine transforms in turn, in the space of centred members: orthogonal to
    rounding, in N log N steps where a random matrix takes N cubed.
    """
    from scipy.fft import dct

    n = spread.shape[-2]
    # A reflection takes the direction of ones to the first unit vector, and is its own inverse.
    v = np.full(n, -1 / np.sqrt(n))
    v[0] += 1
    v /= np.linalg.norm(v)
    out = spread - 2 * v[:, None] * (v @ spread)[..., None, :]
    rest = out[..., 1:, :]
    for _ in range(3):
        signs = np.copysign(1.0, rng.standard_normal((*rest.shape[:-1], 1)))
        rest = dct(signs * rest, norm="ortho", axis=-2)
    signs = np.copysign(1.0, rng.standard_normal((*rest.shape[:-1], 1)))
    out = np.concatenate([out[..., :1, :], signs * rest], axis=-2)
    return np.asarray(out - 2 * v[:, None] * (v @ out)[..., None, :])


@validated
def stochastic_forecast(
    ensemble: Members, model: Model, t: float, dt: NonNegativeFloat, *, rng: Rng
) -> Array:
    """Move every member with the model and add an independent draw of the noise, (..., N, d).

    Parameters
    ----------
    ensemble : array_like, (..., N, d)
        Members at time `t`.
    model : Model
    t, dt : float
        From when, and how far, in s.
    rng : numpy.random.Generator

    Examples
    --------
    >>> still = Model(1, lambda x, t, dt: x, lambda t, dt: np.zeros((1, 1)))
    >>> stochastic_forecast(
    ...     [[1.0], [2.0]], still, 0.0, 0.1, rng=np.random.default_rng(0)
    ... ).ravel()
    array([1., 2.])
    """
    moved = model.step(ensemble, t, dt)
    root = model.noise_sqrt(t, dt)
    if not np.count_nonzero(root):
        return moved
    return moved + rng.standard_normal(moved.shape) @ np.ascontiguousarray(root.T)


@validated
def exact_forecast(
    ensemble: Members, model: Model, t: float, dt: NonNegativeFloat, *, rng: Rng
) -> Array:
    r"""Move the members and add noise that is exact to second order.

    The draws are centred, orthogonal to the moved members' anomalies, and have the sample
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
    >>> moved = exact_forecast(x, walk, 0.0, 0.5, rng=np.random.default_rng(0))
    >>> bool(abs(moved.mean()) < 1e-12), float(moved.var(ddof=1).round(12))
    (True, 1.0)
    """
    moved = model.step(ensemble, t, dt)
    root = model.noise_sqrt(t, dt)
    if not root.any():
        return moved
    bad = ~np.isfinite(moved).all(axis=(-2, -1), keepdims=True)
    clean = np.where(bad, ensemble, moved)
    noisy = clean + exact_noise(center_ensemble(clean)[1], root, rng)
    # Members that the model lost stay lost, and do not take the others' noise with them.
    return np.where(bad, np.nan, noisy)
