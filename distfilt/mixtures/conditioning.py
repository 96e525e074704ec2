"""Forecast and update of a whole mixture by square-root filters at points, without derivatives.

Divided differences of second order (DD2), with the step sqrt(3), which is exact for a Gaussian's
fourth moments along each axis. Square roots are built by QR: no covariance can lose definiteness.
Filters call these functions, with models and sensors that have been checked.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from ..gaussians.single import unscented_points
from ..linalg import cholesky, log_det, lower_root, quadratic_form
from ..validation import Array, call_user
from .gaussian import GaussianMixture, divide_among, factor_together

__all__ = ["propagate_mixture", "update_mixture", "within_gate"]

_LOG_2PI = float(np.log(2 * np.pi))
# Square h² of the step of the divided differences, in units of the variance.
_SQUARED_STEP = 3.0
# Components lighter than this are left out after an update: they hardly change mean or covariance.
_NEGLIGIBLE = 1e-9


def propagate_mixture(
    mixture: GaussianMixture, function: Callable[[Array], Array], noise_factor: Array
) -> GaussianMixture:
    """Propagate a mixture through a function and add noise, component by component.

    Parameters
    ----------
    mixture : GaussianMixture
    function : callable
        On arrays (..., d), returning (..., m).
    noise_factor : ndarray, (m, k)
        A square root of the noise's covariance.

    Examples
    --------
    >>> one = GaussianMixture.gaussian([1.0], [[0.25]])
    >>> after = propagate_mixture(one, lambda x: x**2, np.zeros((1, 1)))
    >>> after.means, after.covs.round(6)  # E x² = 1.25, and its variance 4 m² P + 2 P²
    (array([[1.25]]), array([[[1.125]]]))
    """
    # Values (L, 2d + 1, m) at 2d + 1 points around the mean of each of the L components; from them
    # means and divided differences.
    values = np.asarray(call_user(function, _place_points(mixture)))
    differences = _take_differences(values)
    is_finite = [np.isfinite(part).all() for part in differences]
    if not all(is_finite):
        raise ValueError(
            "function must return finite values at the points, got NaN or an overflow"
        )
    # P = C Cᵀ + Q with the columns C = [first, second].
    factors = _combine_roots(differences.first, differences.second, noise_factor)
    return _build_from_factors(mixture.weights, differences.mean, factors)


def propagate_together(
    mixtures: Sequence[GaussianMixture],
    function: Callable[[Array], Array],
    noise_factor: Array,
) -> list[GaussianMixture]:
    """Propagate several mixtures of one dimension as :func:`propagate_mixture`, in one call.

    The function leads from (..., d) to (..., m), and the noise has the root (m, k).

    >>> two = [GaussianMixture.gaussian([m], [[0.25]]) for m in (1.0, 2.0)]
    >>> after = propagate_together(two, lambda x: 2 * x, np.zeros((1, 1)))
    >>> [mixture.means.ravel() for mixture in after]
    [array([2.]), array([4.])]
    """
    # Each component moves by itself, so that those of all mixtures may be taken for one.
    after = propagate_mixture(_join(mixtures), function, noise_factor)
    # Means, covariances and their Cholesky factors, each cut into one part for every mixture.
    parts = [
        divide_among(values, mixtures)
        for values in (after.means, after.covs, after.factors)
    ]
    result = []
    for mixture, means, covs, factors in zip(mixtures, *parts, strict=True):
        result.append(
            GaussianMixture.construct(mixture.weights, means, covs, factors=factors)
        )
    return result


def update_mixture(
    mixture: GaussianMixture,
    observed: Array,
    function: Callable[[Array], Array],
    noise: Array,
    *,
    residual: Callable[[Array, Array], Array] = np.subtract,
    on_branch: bool = False,
) -> GaussianMixture:
    """Condition a mixture on an observation: each component, and the weights by its likelihood.

    A component's prediction, and its covariance with the state, follow from the values of
    `function` at the component's mean and at √3 standard deviations on both sides of it along each
    column of the covariance's Cholesky factor, 2d + 1 points (divided differences of second order).
    A component that cannot predict the observation (`function` is NaN at one of these points) is
    left out.

    Parameters
    ----------
    mixture : GaussianMixture
        Of L components.
    observed : ndarray, (m,)
        NaN marks a missing component.
    function : callable
        Predicts the observation, on arrays (..., d), returning (..., m).
    noise : ndarray, (m, m)
        Covariance of its noise.
    residual : callable
        ``residual(a, b)``, for observations that wrap.
    on_branch : bool
        Whether `function`, given the points of all components (L, 2d + 1, d), returns the angles of
        one component's points without a jump by a period between them. Then they are compared by
        plain differences, otherwise by `residual`.

    Raises
    ------
    ValueError
        If no component can predict the observation.

    Examples
    --------
    >>> two = GaussianMixture([0.5, 0.5], [[-2.0], [2.0]], [[[1.0]], [[1.0]]])
    >>> after = update_mixture(two, np.ones(1), lambda x: x, np.eye(1))
    >>> after.means.ravel().round(6), after.weights.round(3)
    (array([-0.5,  1.5]), array([0.119, 0.881]))
    """
    (updated,) = update_together(
        [mixture], observed, function, noise, residual=residual, on_branch=on_branch
    )
    return updated


def update_together(
    mixtures: Sequence[GaussianMixture],
    observed: Array,
    function: Callable[[Array], Array],
    noise: Array,
    *,
    residual: Callable[[Array, Array], Array] = np.subtract,
    on_branch: bool = False,
) -> list[GaussianMixture]:
    """Condition several mixtures of one dimension on one observation as :func:`update_mixture`.

    The observation is (m,), with NaN where missing, and its noise has the covariance (m, m). The
    options are those of :func:`update_mixture`.

    >>> two = [GaussianMixture.gaussian([m], [[1.0]]) for m in (0.0, 2.0)]
    >>> after = update_together(two, np.ones(1), lambda x: x, np.eye(1))
    >>> [mixture.means.ravel().round(6) for mixture in after]
    [array([0.5]), array([1.5])]
    """
    if np.isnan(observed).all():
        return list(mixtures)
    # Each component is updated by itself, so that those of all mixtures may be taken for one.
    mixture = _join(mixtures)
    innovation = _find_innovations(
        mixture, observed, function, noise, residual, on_branch
    )
    # The columns of a root of S = first firstᵀ + second secondᵀ + R.
    first = innovation.first
    second = innovation.second
    noise_factor = innovation.noise_factor
    root = innovation.root()
    # K = P_xy S⁻¹ by two triangular solves, with P_xy = L firstᵀ.
    cross = mixture.factors @ first.mT
    gain = np.linalg.solve(root.mT, np.linalg.solve(root, cross.mT)).mT
    # P⁺ = (L - K first)(…)ᵀ + (K second)(…)ᵀ + (K noise)(…)ᵀ, a sum of squares.
    factors = _combine_roots(
        mixture.factors - gain @ first, gain @ second, gain @ noise_factor
    )
    # Each of the four arrays is cut into one part for every mixture.
    parts = [
        divide_among(values, mixtures)
        for values in (innovation.values, root, gain, factors)
    ]
    updated = []
    # `of_mixture` holds one mixture's innovations, roots, gains and factors.
    for one, *of_mixture in zip(mixtures, *parts, strict=True):
        updated.append(_update_means_and_weights(one, *of_mixture))
    return updated


def _update_means_and_weights(
    mixture: GaussianMixture,
    innovations: Array,
    root: Array,
    gain: Array,
    factors: Array,
) -> GaussianMixture:
    """Return the mixture of updated components, with weights by N(innovation; 0, S).

    For L components and k observed numbers, innovations are (L, k); `root` (L, k, k) is a
    triangular root of the innovations' covariances S, and `gain` is (L, d, k). `factors` (L, d, d)
    are Cholesky factors of the updated covariances.
    """
    # The innovations may be a part of a larger array. A copy, with the strides of an array of this
    # mixture alone, makes the sums below run in the same order, and so be rounded alike.
    innovations = innovations.copy("K")
    means = mixture.means + (gain @ innovations[..., None])[..., 0]
    # log N(innovation; 0, S) = -½ (|root⁻¹ innovation|² + log|S| + k log 2π)
    squared_lengths = quadratic_form(root, innovations)
    size = innovations.shape[-1]
    logs = -0.5 * (squared_lengths + log_det(root) + size * _LOG_2PI)
    # A component that cannot predict the observation gets no weight.
    logs = np.where(np.isfinite(logs), mixture.log_weights + logs, -np.inf)
    if not np.isfinite(logs.max()):
        raise ValueError(
            "observed must be predicted by at least one mixture component, got none"
        )
    weights = np.exp(logs - logs.max())
    weights /= weights.sum()
    # The lightest components are left out.
    large = weights > _NEGLIGIBLE
    weights = weights[large] / weights[large].sum()
    return _build_from_factors(weights, means[large], factors[large])


def within_gate(
    mixture: GaussianMixture,
    observed: Array,
    function: Callable[[Array], Array],
    noise: Array,
    *,
    gate: float,
    residual: Callable[[Array, Array], Array] = np.subtract,
    on_branch: bool = False,
) -> Array:
    """Return the observation, or NaN in its place if it lies outside every component's gate.

    Parameters
    ----------
    mixture, observed, function, noise, residual, on_branch
        As of :func:`update_mixture`.
    gate : float
        How many standard deviations the observation may lie from the nearest component's
        prediction.

    Examples
    --------
    >>> two = GaussianMixture([0.5, 0.5], [[-9.0], [9.0]], [[[1.0]], [[1.0]]])
    >>> [
    ...     within_gate(two, np.array([y]), lambda x: x, np.eye(1), gate=3.0)
    ...     for y in (0.0, 9.5)
    ... ]
    [array([nan]), array([9.5])]
    """
    innovation = _find_innovations(
        mixture, observed, function, noise, residual, on_branch
    )
    # Squared Mahalanobis distances (L,) from the components' predictions
    squared_distances = quadratic_form(innovation.root(), innovation.values)
    squared_distances = np.where(mixture.weights > 0, squared_distances, np.nan)
    # Distances are NaN for components that predict nothing.
    predicts = np.isfinite(squared_distances).any()
    if predicts and np.nanmin(squared_distances) > gate**2:
        return np.full_like(observed, np.nan)
    return observed


class _Innovations(NamedTuple):
    """Innovations (L, k) of the k observed components, and the parts of their covariances.

    Divided differences of the predictions, (L, k, d), and the Cholesky factor (k, k) of the noise
    covariance.
    """

    values: Array
    first: Array
    second: Array
    noise_factor: Array

    def root(self) -> Array:
        """Return a triangular root of S = C Cᵀ with the columns C = [first, second, noise]."""
        return _combine_roots(self.first, self.second, self.noise_factor)


def _find_innovations(
    mixture: GaussianMixture,
    observed: Array,
    function: Callable[[Array], Array],
    noise: Array,
    residual: Callable[[Array, Array], Array],
    on_branch: bool,
) -> _Innovations:
    """Compare the observed components with their predictions by each component of the mixture.

    The arguments are those of :func:`update_mixture`. The observation is (m,), and its noise has
    the covariance (m, m).
    """
    missing = np.isnan(observed)
    # Indices of the observed components
    present = np.flatnonzero(~missing)
    # A residual may need every component; those that are missing are zeros in both.
    y = np.where(missing, 0.0, observed)
    # Predictions (L, 2d + 1, m) at the points of each component, the first of them its mean
    predicted = call_user(function, _place_points(mixture))
    predicted = np.where(missing, 0.0, predicted)
    # Relative to the prediction at the mean, so that angles do not wrap between points.
    at_mean = predicted[:, 0]
    at_means = np.broadcast_to(at_mean[:, None], predicted.shape)
    compare = np.subtract if on_branch else residual
    relative = call_user(compare, predicted, at_means)[..., present]
    # The mean, and the columns of a root of the covariance, of the predictions
    spread = _take_differences(relative)
    difference = call_user(residual, np.broadcast_to(y, at_mean.shape), at_mean)
    return _Innovations(
        difference[..., present] - spread.mean,
        spread.first,
        spread.second,
        noise_factor=cholesky(noise[np.ix_(present, present)]),
    )


def _join(mixtures: Sequence[GaussianMixture]) -> GaussianMixture:
    """Return the components of several mixtures as those of one, whose weights do not matter."""
    if len(mixtures) == 1:
        return mixtures[0]
    # Computes the Cholesky factors of all covariances in one call.
    factor_together(mixtures)
    return GaussianMixture.construct(
        np.concatenate([mixture.weights for mixture in mixtures]),
        np.concatenate([mixture.means for mixture in mixtures]),
        np.concatenate([mixture.covs for mixture in mixtures]),
        factors=np.concatenate([mixture.factors for mixture in mixtures]),
    )


def _place_points(mixture: GaussianMixture) -> Array:
    """Points (L, 2d + 1, d) at distance √3 standard deviations from the means."""
    # Unscented points lie at √(d + κ) standard deviations.
    kappa = _SQUARED_STEP - mixture.dim
    points, _weights = unscented_points(mixture.means, mixture.factors, kappa=kappa)
    return points


class _DividedDifferences(NamedTuple):
    """Mean (..., m) of a function's values, and divided differences of first and second order.

    The differences (..., m, d) are columns of a root of the values' covariance.
    """

    mean: Array
    first: Array
    second: Array


def _take_differences(values: Array) -> _DividedDifferences:
    """Return the divided differences of a function's values (..., 2d + 1, m).

    The values are those at :func:`_place_points`.
    """
    d = values.shape[-2] // 2
    centre = values[..., :1, :]
    plus = values[..., 1 : d + 1, :]
    minus = values[..., d + 1 :, :]
    # With the step h² = 3: mean = f₀ + Σ (f₊ + f₋ - 2 f₀) / (2 h²)
    even = plus + minus - 2 * centre
    mean = centre[..., 0, :] + even.sum(axis=-2) / (2 * _SQUARED_STEP)
    # first = (f₊ - f₋) / (2 h) and second = (f₊ + f₋ - 2 f₀) √(h² - 1) / (2 h²)
    first = (plus - minus).mT / (2 * np.sqrt(_SQUARED_STEP))
    second = even.mT * np.sqrt(_SQUARED_STEP - 1) / (2 * _SQUARED_STEP)
    return _DividedDifferences(mean, first, second)


def _combine_roots(first: Array, second: Array, noise: Array) -> Array:
    """Return the lower triangular L (..., m, m) with L Lᵀ = A Aᵀ, A = [first, second, noise]."""
    noise = np.broadcast_to(noise, first.shape[:-2] + noise.shape[-2:])
    return lower_root(np.concatenate([first, second, noise], axis=-1))


def _build_from_factors(
    weights: Array, means: Array, factors: Array
) -> GaussianMixture:
    """Build a mixture from Cholesky factors (L, d, d), which it keeps in its cache."""
    covs = factors @ factors.mT
    return GaussianMixture.construct(weights, means, covs, factors=factors)
