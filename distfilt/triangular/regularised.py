"""Updates that ask less of the sample covariances: known noise, shrinkage, informed directions."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from ..checks import Array, array, covariance, generator, number
from ..ensembles import cross_covariance, sample_covariance
from ..linalg import cholesky_solve, factor

__all__ = ["informed_update", "known_noise_update"]


def known_noise_update(
    ensemble: ArrayLike,
    predicted: ArrayLike,
    observed: ArrayLike,
    noise: ArrayLike,
    *,
    rng: np.random.Generator,
    shrinkage: float = 0.0,
    ridge: float = 0.0,
) -> Array:
    r"""Condition with the affine map whose observation noise is known, not sampled.

    .. math:: \mathbf x_i' = \mathbf x_i + \hat{\mathbf C}_{xh}
        (\hat{\mathbf C}_{hh} + \mathbf R)^{-1}(\mathbf y^* - \mathbf h(\mathbf x_i) - \zeta_i)

    Only the predictions without noise are sampled, so the chance correlations of the members with
    the drawn noise stay out of the gain, and :math:`\hat{\mathbf C}_{hh} + \mathbf R` can always be
    inverted.

    Parameters
    ----------
    ensemble : array_like, (..., N, d)
        Forecast members, at least two.
    predicted : array_like, (..., N, m)
        What each member would observe, without noise. Readings that wrap have to lie on the
        branch of `observed`.
    observed : array_like, (..., m)
        The observation y*.
    noise : array_like, (m, m)
        Its covariance R, positive definite.
    rng : numpy.random.Generator
        Source of the perturbations :math:`\zeta_i`.
    shrinkage : float
        Between 0 and 1: every sample correlation of two different variables is multiplied by one
        minus it, which takes from the chance correlations of small ensembles.
    ridge : float
        At least 0: the diagonal of :math:`\hat{\mathbf C}_{hh}+\mathbf R` is multiplied by one plus
        it.

    Returns
    -------
    ndarray, (..., N, d)

    Raises
    ------
    ValueError
        If shapes do not fit, `noise` is not positive definite, or N is 1.

    Examples
    --------
    >>> rng = np.random.default_rng(3)
    >>> prior = rng.standard_normal((1000, 1))
    >>> posterior = known_noise_update(prior, prior, [1.0], [[1.0]], rng=rng)
    >>> posterior.mean().round(1), posterior.var().round(1)
    (np.float64(0.5), np.float64(0.5))
    """
    x, h, target, r = _inputs(ensemble, predicted, observed, noise)
    s = number(shrinkage, "shrinkage", at_least=0, at_most=1)
    extra = number(ridge, "ridge", at_least=0)
    drawn = h + generator(rng).standard_normal(h.shape) @ factor(r).T
    inner, cross = sample_covariance(h), cross_covariance(x, h)
    if s:
        # A component that is observed directly is correlated with its prediction by more than
        # chance, and shrinks all the same: the update does not know which is which.
        cross = (1 - s) * cross
        inner = (1 - s) * inner + s * _diagonal(inner)
    inner = inner + r
    inner = inner + extra * _diagonal(inner)
    gain = cholesky_solve(inner, np.swapaxes(cross, -1, -2))
    return np.asarray(x + (target[..., None, :] - drawn) @ gain)


def informed_update(
    ensemble: ArrayLike,
    predicted: ArrayLike,
    observed: ArrayLike,
    noise: ArrayLike,
    *,
    rng: np.random.Generator,
    threshold: float = 0.05,
) -> Array:
    r"""Condition only on the directions of the observation in which signal stands above noise.

    With the noise whitened, the predictions have the covariance
    :math:`\mathbf R^{-1/2}\hat{\mathbf C}_{hh}\mathbf R^{-\top/2}`. Its eigenvalues are
    signal-to-noise ratios; directions below the threshold are left out of the gain of
    :func:`known_noise_update`. Unlike principal components, they do not depend on units.

    Parameters
    ----------
    ensemble, predicted, observed, noise, rng
        As in :func:`known_noise_update`.
    threshold : float
        Smallest signal-to-noise ratio τ that counts, at least 0; 0 leaves nothing out.

    Returns
    -------
    ndarray, (..., N, d)

    Examples
    --------
    The second component is seen, but hardly varies against the noise: one direction is used.

    >>> rng = np.random.default_rng(3)
    >>> prior = rng.standard_normal((1000, 2)) * [1.0, 0.01]
    >>> after = informed_update(prior, prior, [1.0, 1.0], np.eye(2), rng=rng)
    >>> int(np.linalg.matrix_rank(after - prior, tol=1e-9)), after[:, 0].var().round(1)
    (1, np.float64(0.5))
    """
    x, h, target, r = _inputs(ensemble, predicted, observed, noise)
    least = number(threshold, "threshold", at_least=0)
    root = factor(r)
    drawn = h + generator(rng).standard_normal(h.shape) @ root.T

    def whitened(v: Array) -> Array:
        return np.asarray(np.swapaxes(np.linalg.solve(root, np.swapaxes(v, -1, -2)), -1, -2))

    signal = whitened(h)
    values, vectors = np.linalg.eigh(sample_covariance(signal))
    kept = np.where(values >= least, 1 / (1 + np.maximum(values, 0.0)), 0.0)
    cross = cross_covariance(x, signal) @ vectors
    innovation = whitened(target[..., None, :] - drawn) @ vectors
    return np.asarray(x + (innovation * kept[..., None, :]) @ np.swapaxes(cross, -1, -2))


def _diagonal(matrix: Array) -> Array:
    return np.asarray(matrix * np.eye(matrix.shape[-1]))


def _inputs(
    ensemble: ArrayLike, predicted: ArrayLike, observed: ArrayLike, noise: ArrayLike
) -> tuple[Array, Array, Array, Array]:
    x = array(ensemble, "ensemble", (..., "N", "d"))
    if x.shape[-2] < 2:
        raise ValueError(f"ensemble: needs at least 2 members, got {x.shape[-2]}")
    h = array(predicted, "predicted", (*x.shape[:-1], "m"))
    m = h.shape[-1]
    target = array(observed, "observed", (*x.shape[:-2], m))
    return x, h, target, array(covariance(noise, "noise", m), "noise", (m, m))
