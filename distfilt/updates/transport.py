"""Updates by transport: from the joint ensemble of (y, x) to the conditional one of x given y*."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from ..checks import Array, callable_, choice, count, number
from ..ensembles import anomalies, cross_covariance, sample_covariance
from ..triangular import ConditionalMap, affine, compose
from .door import perturbed, update

__all__ = [  # fmt: skip
    "informed_directions", "principal_components", "principal_directions", "transport",
    "transport_sample",
]


Fit = Callable[[Array, Array], ConditionalMap]
"""``fit(y, x) -> map``: an estimator of the map that takes the samples to the reference."""


def _noisy(seen: Array, noise: Array, factor: float, rng: np.random.Generator) -> Array:
    share = number(factor, "noise_factor", at_least=0, at_most=1e100)
    return perturbed(seen, share**2 * noise, rng) if share else seen


@update
def transport(
    ensemble: Array, predicted: Array, observed: Array, noise: Array, *, rng: np.random.Generator,
    fit: Fit = affine.fit, noise_factor: float = 1.0,
) -> Array:
    """Condition an ensemble with a composed map, equations (10)-(13) of Grange et al.

    With the affine map, the default, this is exactly the stochastic ensemble Kalman filter with
    sample covariances, :func:`~distfilt.updates.sampled_noise`.

    Parameters
    ----------
    ensemble, predicted, observed, noise, rng
        As in :func:`~distfilt.updates.sampled_noise`; a draw of the noise is added to each
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
    >>> posterior = transport(prior, prior, [1.0], [[1.0]], rng=rng)
    >>> posterior.mean().round(1), posterior.var().round(1)
    (np.float64(0.5), np.float64(0.5))
    """
    callable_(fit, "fit")
    seen = _noisy(predicted, noise, noise_factor, rng)
    return compose(fit(seen, ensemble), seen, ensemble, observed)


@update
def transport_sample(
    ensemble: Array, predicted: Array, observed: Array, noise: Array, *, rng: np.random.Generator,
    fit: Fit = affine.fit,
) -> Array:
    r"""Draw a new ensemble from the conditional by the inverse map alone, equation (9).

    .. math:: \mathbf x_i' = \mathbf S(\mathbf y^*,\cdot)^{-1}(\mathbf z_i),\qquad
        \mathbf z_i\sim N(\mathbf 0,\mathbf I)

    The new members forget the old ones. Where the map fits badly, so do they: the composed map
    (10) of :func:`transport` makes most of the map's error undo itself.

    Parameters
    ----------
    ensemble, predicted, observed, noise, rng, fit
        As in :func:`transport`; the reference samples are drawn too.

    Examples
    --------
    >>> rng = np.random.default_rng(3)
    >>> prior = rng.standard_normal((4000, 1))
    >>> posterior = transport_sample(prior, prior, [1.0], [[1.0]], rng=rng)
    >>> posterior.mean().round(1), posterior.var().round(1)
    (np.float64(0.5), np.float64(0.5))
    """
    callable_(fit, "fit")
    seen = perturbed(predicted, noise, rng)
    reference = rng.standard_normal(ensemble.shape)
    return fit(seen, ensemble).inverse(observed, reference)


def principal_directions(ensemble: ArrayLike, n: int) -> Array:
    """The `n` orthonormal directions of largest sample variance, as columns.

    Parameters
    ----------
    ensemble : array_like, (..., N, d)
        Members.
    n : int
        How many, at most d.

    Examples
    --------
    >>> principal_directions([[-3.0, 0.1], [3.0, 0.1], [0.0, -0.1]], 1).round(2).tolist()
    [[1.0], [0.0]]
    """
    cov = sample_covariance(ensemble)
    if not np.isfinite(cov).all():
        raise ValueError("ensemble: needs members of finite variance, got infinity")
    if count(n, "n") > cov.shape[-1]:
        raise ValueError(f"n: needs at most {cov.shape[-1]} directions, got {n}")
    _, vectors = np.linalg.eigh(cov)
    chosen = vectors[..., ::-1][..., :n]
    largest = np.take_along_axis(chosen, np.abs(chosen).argmax(axis=-2)[..., None, :], axis=-2)
    return np.asarray(chosen * np.sign(largest))


@update
def principal_components(
    ensemble: Array, predicted: Array, observed: Array, noise: Array, *, rng: np.random.Generator,
    n_state: int, n_observed: int, complement: str = "keep", noise_factor: float = 1.0,
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
    complement : {"keep", "drop", "literal"}
        What happens to the state outside the leading directions. ``"keep"`` leaves it as it was.
        ``"drop"`` sets it to the mean. ``"literal"`` is line 8 as printed, which maps uncentred
        states and so also drops the mean there.

    Examples
    --------
    >>> rng = np.random.default_rng(3)
    >>> prior = rng.standard_normal((1000, 2)) * [2.0, 1.0]
    >>> sees_x = prior[:, :1]
    >>> post = principal_components(
    ...     prior, sees_x, [1.0], [[1.0]], rng=rng, n_state=1, n_observed=1)
    >>> post.var(axis=0).round(1)
    array([0.8, 1. ])
    """
    choice(complement, "complement", ("keep", "drop", "literal"))
    callable_(fit, "fit")
    seen = _noisy(predicted, noise, noise_factor, rng)
    m, d = seen.shape[-1], ensemble.shape[-1]
    if count(n_state, "n_state") > d:
        raise ValueError(f"n_state: needs at most {d} directions, got {n_state}")
    v = principal_directions(seen, min(count(n_observed, "n_observed"), m))
    w = principal_directions(ensemble, n_state)
    latent, reduced = ensemble @ w, seen @ v
    aim = (observed[..., None, :] @ v)[..., 0, :]
    moved = compose(fit(reduced, latent), reduced, latent, aim)
    back = np.swapaxes(w, -1, -2)
    if complement == "literal":
        return np.asarray(moved @ back)
    if complement == "keep":
        return np.asarray(ensemble + (moved - latent) @ back)
    spread = anomalies(ensemble)
    rest = spread - (spread @ w) @ back
    return np.asarray(ensemble - rest + (moved - latent) @ back)


@update
def informed_directions(
    ensemble: Array, predicted: Array, observed: Array, noise: Array, *, rng: np.random.Generator,
    threshold: float = 0.05,
) -> Array:
    r"""Condition only on the directions of the observation in which signal stands above noise.

    With the noise whitened, the predictions have the covariance
    :math:`\mathbf R^{-1/2}\hat{\mathbf C}_{hh}\mathbf R^{-\top/2}`. Its eigenvalues are
    signal-to-noise ratios; directions below the threshold are left out of the gain of
    :func:`~distfilt.updates.known_noise`. Unlike principal components, they do not depend on
    units.

    Parameters
    ----------
    ensemble, predicted, observed, noise, rng
        As in :func:`transport`; two members are enough.
    threshold : float
        Smallest signal-to-noise ratio τ that counts, at least 0; 0 leaves nothing out.

    Examples
    --------
    The second component is seen, but hardly varies against the noise: one direction is used.

    >>> rng = np.random.default_rng(3)
    >>> prior = rng.standard_normal((1000, 2)) * [1.0, 0.01]
    >>> after = informed_directions(prior, prior, [1.0, 1.0], np.eye(2), rng=rng)
    >>> int(np.linalg.matrix_rank(after - prior, tol=1e-9)), after[:, 0].var().round(1)
    (1, np.float64(0.5))
    """
    least = number(threshold, "threshold", at_least=0)
    drawn = perturbed(predicted, noise, rng)
    root = np.linalg.cholesky(noise)

    def whitened(v: Array) -> Array:
        return np.asarray(np.swapaxes(np.linalg.solve(root, np.swapaxes(v, -1, -2)), -1, -2))

    signal = whitened(predicted)
    values, vectors = np.linalg.eigh(sample_covariance(signal))
    kept = np.where(values >= least, 1 / (1 + np.maximum(values, 0.0)), 0.0)
    if not np.isfinite(values).all():
        raise ValueError("predicted: needs predictions of finite variance, got infinity")
    cross = cross_covariance(ensemble, signal) @ vectors
    innovation = whitened(observed[..., None, :] - drawn) @ vectors
    return np.asarray(ensemble + (innovation * kept[..., None, :]) @ np.swapaxes(cross, -1, -2))
