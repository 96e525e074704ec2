r"""Fusing beliefs about a shared part of agents' states: only beliefs about the target travel.

An agent's state is x = [t; e]: the target t, which all agents estimate, comes first; the agent's
ego state e comes last and differs from agent to agent. The fused density is

.. math:: p_f(\mathbf x)\propto p(\mathbf x)\,p(\mathbf t)^{\omega-1}
    \prod_b p_b(\mathbf t)^{\omega_b},\qquad \omega+\sum_b\omega_b=1,

equations (14)-(15) of Semeraro, LeGrand and Kulik for one other agent. Equation numbers in this
module are those of that paper, Semeraro et al. for short.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass
from functools import cached_property
from typing import Annotated, Literal

import numpy as np
from scipy.linalg import svdvals

from ..gaussians.single import unscented_points
from ..linalg import SolverError, log_sum_exp, symmetrise
from ..validation import (
    Array,
    ArrayInput,
    Bounds,
    FrozenModel,
    Indices,
    Mask,
    PositiveInt,
    UnitInterval,
    check_probabilities,
    validated,
)
from .gaussian import (
    GaussianMixture,
    assemble_joint,
    divide_among,
    invert_together,
    regression,
)
from .reduction import ComponentShapes

__all__ = ["PartialFusion", "nonnegative_least_squares", "tikhonov"]

Others = GaussianMixture | Sequence[GaussianMixture]
Exponents = (
    UnitInterval | Literal["equal"] | Annotated[ArrayInput, "K", check_probabilities]
)
Terms = Literal["matched", "all"]
Rule = Literal["C1", "C2", "C3", "points"]
Condition = Annotated[float, Bounds(above=1, at_most=1e150)]
"""A condition number whose square is finite."""
SingularValue = Annotated[float, Bounds(at_least=0, at_most=1e150)]
"""A singular value whose square is finite."""

# Density, relative to the largest, below which the rows of "points" stop gaining weight: farther
# out than at a thousandth (3.7 deviations of a Gaussian) no accuracy is wanted.
_DENSITY_FLOOR = 1e-3
# Smallest pivots of a term's information matrix, relative to its diagonal entry: where prior and
# divided component are the same a Cholesky factor exists, else a small pivot may be rounding.
_MATCHED_PIVOT = 1e-13
_UNMATCHED_PIVOT = 1e-10


@dataclass(frozen=True, eq=False)
class PartialFusion(FrozenModel):
    r"""The exact fused density, which can be evaluated but is no mixture, and its approximations.

    Parameters
    ----------
    prior : GaussianMixture
        The agent's belief about [t; e].
    received : GaussianMixture or sequence of them
        Others' beliefs about t; all of one dimension, at most that of `prior`.
    omega : float, "equal" or array_like
        Exponent of the prior's target marginal, in [0, 1]; the others share the remainder equally.
        "equal" gives all the same. Or one exponent each, the prior's first, nonnegative with sum 1.

    Examples
    --------
    >>> prior = GaussianMixture.gaussian([0.0, 0.0], [[2.0, 1.0], [1.0, 1.0]])
    >>> other = GaussianMixture.gaussian([3.0], [[1.0]])
    >>> exact = PartialFusion(prior, other)
    >>> fused = exact.assign_weights(exact.component_shapes())
    >>> fused.means.round(4), fused.covs[0, 0, 0].round(4)
    (array([[2., 1.]]), np.float64(1.3333))
    """

    prior: GaussianMixture
    received: Others
    _: KW_ONLY
    omega: Exponents = "equal"

    def __post_init__(self) -> None:
        super().__post_init__()
        # Beliefs about the target have as many components as the target, at most the whole state.
        dims = {other.dim for other in self.others}
        if len(dims) != 1 or max(dims) > self.prior.dim:
            raise ValueError(
                f"received must have target beliefs, one or more, of one dimension, at most "
                f"the prior's {self.prior.dim}, got {sorted(dims)}"
            )
        # One exponent for each belief, if they are given one by one.
        n_beliefs = len(self.others) + 1
        if np.ndim(self.omega) and len(self.exponents) != n_beliefs:
            raise ValueError(
                f"omega must be {n_beliefs} exponents, got {len(self.exponents)}"
            )

    @property
    def others(self) -> tuple[GaussianMixture, ...]:
        """The received beliefs, one or several."""
        if isinstance(self.received, GaussianMixture):
            return (self.received,)
        return tuple(self.received)

    @cached_property
    def exponents(self) -> Array:
        """Exponents of the prior's and of the K others' target marginals, (1 + K,), with sum 1."""
        n_others = len(self.others)
        if isinstance(self.omega, np.ndarray):
            return self.omega
        if isinstance(self.omega, str):
            return np.full(n_others + 1, 1 / (n_others + 1))
        exponents = np.full(n_others + 1, (1 - self.omega) / n_others)
        exponents[0] = self.omega
        return exponents

    @property
    def target_dim(self) -> int:
        """Number of components of the target."""
        return self.others[0].dim

    @cached_property
    def target(self) -> GaussianMixture:
        """The prior belief about the target."""
        return self.prior.marginal(range(self.target_dim))

    def _add_log_update(self, logs: Array, t: Array, name: str) -> Array:
        """Add the logarithm of the update factor g(t), (15) of Semeraro et al., to `logs` (...).

        It is a power of all beliefs about the target t (..., n) by which the prior is multiplied.
        `name` is the argument from which the targets come, for the error.
        """
        # log g(t) = (ω - 1) log p(t) + Σ ω_b log p_b(t)
        exponents = self.exponents
        # Where a belief that divides and one that multiplies are zero, infinities cancel to NaN,
        # which is refused below. An exponent of zero is left out: zero times infinity is NaN too.
        with np.errstate(invalid="ignore"):
            if exponents[0] != 1:
                logs = logs + (exponents[0] - 1) * self.target.log_density(t)
            for exponent, other in zip(exponents[1:], self.others, strict=True):
                if exponent:
                    logs = logs + exponent * other.log_density(t)
        # One density is divided by another, and both are zero.
        if np.isnan(logs).any():
            raise ValueError(
                f"{name} must have points whose density is a number, got one too far out"
            )
        return logs

    @validated
    def log_value(self, x: Annotated[ArrayInput, "... self.prior.dim"]) -> Array:
        """Logarithm of the fused density, (14) of Semeraro et al., not normalised, (...).

        Parameters
        ----------
        x : array_like, (..., d)
        """
        logs = self.prior.log_density(x)
        return self._add_log_update(logs, x[..., : self.target_dim], "x")

    @validated
    def log_target(self, t: Annotated[ArrayInput, "... self.target_dim"]) -> Array:
        """Logarithm of the fused target marginal (...) at targets (..., n), not normalised.

        It needs no ego state.
        """
        return self._add_log_update(self.target.log_density(t), t, "t")

    @validated
    def component_shapes(
        self,
        *,
        terms: Terms = "matched",
        marginal: GaussianMixture | None = None,
        received: Sequence[GaussianMixture] | None = None,
    ) -> ComponentShapes:
        """Means and covariances of the fused components, without weights.

        They are those of (22)-(28) of Semeraro et al. As a power of a mixture is no mixture, a
        product of powers of components stands for that of the mixtures: a component of the prior,
        one of its target marginal, by which it is divided, and one of each received belief. Each is
        found by conditioning in the frame that whitens the prior component, which inverts nothing
        indefinite.

        Parameters
        ----------
        terms : {"matched", "all"}
            Terms in which prior component and divided component are the same: L L' of them, for L
            in the prior and L' choices of received components, all positive definite (in floating
            point while the received beliefs are less than a million times as sharp); or all L² L',
            of which some are not. Those are left out, and `dropped` counts them.
        marginal : GaussianMixture, optional
            Divide by this (a reduced marginal) in place of the prior's target marginal; with
            ``terms="all"``.
        received : sequence of GaussianMixture, optional
            Multiply by these (reduced beliefs) in place of the received ones.
        """
        if marginal is not None and terms == "matched":
            raise ValueError(
                "marginal must come with terms='all', since matched terms divide by the "
                "prior's own components, got terms='matched'"
            )
        # The beliefs by which the prior is divided and multiplied, all about the target
        divided = self.target if marginal is None else marginal
        factors = self.others if received is None else received
        n = self.target_dim
        if divided.dim != n:
            raise ValueError(f"marginal must have dimension {n}, got {divided.dim}")
        expected = [n] * len(self.others)
        dims = [other.dim for other in factors]
        if dims != expected:
            raise ValueError(
                f"received must have mixtures of dimensions {expected}, got {dims}"
            )
        # Pairs of a prior component and a component that it is divided by: the same, or all pairs.
        index = np.arange(self.prior.n_components)
        if terms == "matched":
            pairs = (index, index)
        else:
            divided_index = np.arange(divided.n_components)
            pairs = (
                np.repeat(index, divided.n_components),
                np.tile(divided_index, self.prior.n_components),
            )
        return _fuse_components(self.prior, divided, factors, self.exponents, pairs)

    @validated
    def assign_weights(
        self, shapes: ComponentShapes, *, rule: Rule = "C3", at_most: PositiveInt = 500
    ) -> GaussianMixture:
        """Return the mixture of these shapes, weighted by the exact density at collocation points.

        Components whose weight is zero are left out.

        Parameters
        ----------
        shapes : ComponentShapes
        rule : {"C1", "C2", "C3", "points"}
            (30), (31) or (32)-(34) of Semeraro et al., or C3 with the components' sigma points as
            further points.
        at_most : int
            For "C3" and "points": how many components may take part, the largest by C2.

        Raises
        ------
        SolverError
            If no component has a weight, or least squares do not end.
        """
        if shapes.n_components == 1:
            # By every rule a single component has all the weight.
            return shapes.with_equal_weights()
        # The weight of a component is such that it has a given value at its mean. By C1 it is that
        # of the fused density with one component of the prior alone, from which it has come.
        if rule == "C1":
            logs = self._log_values_by_source(shapes)
            return _weight_by_values(shapes.with_equal_weights(), logs)
        # By C2 it is the exact density, of which these are the logarithms.
        logs = self.log_value(shapes.means)
        mixture = shapes.with_equal_weights()
        if rule == "C2":
            return _weight_by_values(mixture, logs)
        if shapes.n_components > at_most:
            # By C2 a weight is a value over the component's peak; the largest weights come first.
            order = np.argsort(mixture.log_peaks - logs, kind="stable")
            largest = np.isin(np.arange(shapes.n_components), order[:at_most])
            shapes = shapes.select(largest)
            logs = logs[largest]
            mixture = shapes.with_equal_weights()
        # Least-squares coefficients of components with the peak 1: their values at their means
        coefficients = self._collocate(mixture, logs, with_points=rule == "points")
        # A coefficient of zero has the logarithm -inf, and so the weight zero.
        with np.errstate(divide="ignore"):
            return _weight_by_values(mixture, np.log(coefficients))

    def _log_values_by_source(self, shapes: ComponentShapes) -> Array:
        """Log of the fused density at the means of S components, for C1, (30) of Semeraro et al.

        Each component has come from one component q of the prior, its source. C1 takes the weighted
        density of the source alone in place of the prior's, which is the sum over all components.
        """
        prior = self.prior
        # Index q of each component's source
        source = shapes.source
        # log w_q N_q(m) = log w_q + log peak_q - ½ |L_q⁻¹ (m - m_q)|², where N_q has the covariance
        # L_q L_qᵀ and at its mean m_q the value peak_q
        differences = shapes.means - prior.means[source]
        white = np.linalg.solve(prior.factors[source], differences[..., None])[..., 0]
        log_peaks = (prior.log_weights + prior.log_peaks)[source]
        logs = log_peaks - 0.5 * (white**2).sum(axis=-1)
        # Times g(t), by which the others' beliefs change the prior: a function of the target t
        # alone, the first components of the state.
        return self._add_log_update(logs, shapes.means[:, : self.target_dim], "shapes")

    def _collocate(
        self, mixture: GaussianMixture, logs: Array, *, with_points: bool
    ) -> Array:
        """Return nonnegative coefficients of the components that fit the density at points.

        They are the least-squares solution of (32)-(34) of Semeraro et al. The points are the
        components' means, where `logs` (S,) is the logarithm of the density, or all their sigma
        points. A coefficient (S,) belongs to a component with the peak 1.
        """
        points = mixture.means
        if with_points:
            sigma_points, _weights = unscented_points(mixture.means, mixture.factors)
            points = sigma_points.reshape(-1, mixture.dim)
            logs = self.log_value(points)
        # Entry (i, s) is component s at point i, relative to its peak.
        log_matrix = mixture.component_log_densities(points) - mixture.log_peaks
        matrix = np.exp(log_matrix)
        values = np.exp(logs - logs.max())
        if with_points:
            # Rows by the inverse root of the density, so that the tails count too.
            row_weights = 1 / np.sqrt(values + _DENSITY_FLOOR)
            matrix = matrix * row_weights[:, None]
            values = values * row_weights
        return nonnegative_least_squares(matrix, values)


def _weight_by_values(mixture: GaussianMixture, logs: Array) -> GaussianMixture:
    """Weight components so that each has a given value at its mean, (18) of Semeraro et al.

    `logs` (S,) are the logarithms of the values, up to a constant. Components whose weight vanishes
    are left out.
    """
    # w_s ∝ value_s / peak_s
    log_weights = logs - mixture.log_peaks
    # The logarithm of the sum of the weights
    total = log_sum_exp(log_weights)
    if not np.isfinite(total).all():
        raise SolverError(
            "no fused component has a weight: the exact density is zero at every point"
        )
    weights = np.exp(log_weights - total)
    positive = weights > 0
    weights = weights[positive] / weights[positive].sum()
    return GaussianMixture.construct(
        weights, mixture.means[positive], mixture.covs[positive]
    )


def _multiply_received(
    received: Sequence[GaussianMixture], exponents: Array, centres: Array
) -> tuple[Array, Array]:
    """Return the product of the received beliefs' powers: a Gaussian for each choice of components.

    With one component r from each belief b the product of the powers of exponents ω_b has the
    information Λ = Σ ω_b P_r⁻¹ and the vector η = Σ ω_b P_r⁻¹ (m_r - c) relative to a centre c.
    Returns Λ (Q, T, n, n) and η (Q, T, n) of all T choices, for each of Q centres (Q, n).
    """
    n_centres, n = centres.shape
    information = np.zeros((n_centres, 1, n, n))
    vectors = np.zeros((n_centres, 1, n))
    for exponent, other in zip(exponents, received, strict=True):
        # Each component of this belief is added to every choice so far.
        precisions = exponent * other.precisions
        differences = other.means - centres[:, None]
        # ω P_r⁻¹ (m_r - c_s) for each component r and centre s
        added = np.einsum("rij,srj->sri", precisions, differences)
        # The axes of choices so far and of the components become one.
        information = information[:, :, None] + precisions
        information = information.reshape(n_centres, -1, n, n)
        vectors = vectors[:, :, None] + added[:, None]
        vectors = vectors.reshape(n_centres, -1, n)
    return information, vectors


def _fuse_components(
    prior: GaussianMixture,
    divided: GaussianMixture,
    received: Sequence[GaussianMixture],
    exponents: Array,
    pairs: tuple[Indices, Indices],
) -> ComponentShapes:
    r"""Update prior components q, divided by components p, with all products of received ones.

    The target part is updated with the information Λ and the vector η of
    :math:`p_p^{\omega-1}\prod_b p_b^{\omega_b}` in the frame that whitens it; e follows by
    regression. `pairs` are the indices q and p, (Q,) each; with T products the result has up to Q T
    components, those whose covariance is positive definite. The exponents are the prior's ω and the
    ω_b of the received beliefs.
    """
    q, p = pairs
    # Λ (Q, T, n, n) and η (Q, T, n)
    information, vectors = _update_information(
        prior, divided, received, exponents, pairs
    )
    # A reduced marginal has fewer components: equal indices then mean nothing.
    is_matched = (q == p) & (len(divided.means) == prior.n_components)
    smallest_pivot = np.where(is_matched, _MATCHED_PIVOT, _UNMATCHED_PIVOT)
    means, covs, is_definite = _update_components(
        prior, q, information, vectors, smallest_pivot
    )
    return _select_definite(means, covs, q, is_definite)


def _update_information(
    prior: GaussianMixture,
    divided: GaussianMixture,
    received: Sequence[GaussianMixture],
    exponents: Array,
    pairs: tuple[Indices, Indices],
) -> tuple[Array, Array]:
    """Return the information Λ (Q, T, n, n) and vectors η (Q, T, n) by which components change.

    Prior components q change by the product of received components and by division by components p
    of `divided`. `pairs` are the indices q and p, (Q,) each; T is the number of choices of received
    components. The exponents are the prior's ω and those of the received beliefs.
    """
    n = divided.dim
    q, p = pairs
    # Vectors are relative to the prior component's mean: far from the origin they would cancel.
    centres = prior.means[q, :n]
    information, vectors = _multiply_received(received, exponents[1:], centres)
    if exponents[0] != 1:
        # The division: Λ += (ω - 1) P_p⁻¹ and η += (ω - 1) P_p⁻¹ (m_p - c).
        precisions = (exponents[0] - 1) * divided.precisions[p]
        differences = divided.means[p] - centres
        information = information + precisions[:, None]
        vectors = vectors + (precisions @ differences[..., None])[:, None, :, 0]
    return information, vectors


def _update_components(
    prior: GaussianMixture,
    q: Indices,
    information: Array,
    vectors: Array,
    smallest_pivot: Array,
) -> tuple[Array, Array, Mask]:
    """Return means (Q, T, d) and covariances of the updated components q, and which are definite.

    `q` (Q,) are indices of prior components. By the information Λ (Q, T, n, n) and vectors η
    (Q, T, n) the target, their first n numbers, changes in T ways. A covariance with a pivot below
    the smallest one, (Q,), is not definite: see :func:`_factor_definite`.
    """
    n = vectors.shape[-1]
    # P_tt = S (I + Sᵀ Λ S)⁻¹ Sᵀ with the prior's own P_tt = S Sᵀ. The axis None is for the T ways.
    root = np.linalg.cholesky(prior.covs[q, :n, :n])[:, None]
    relative = np.eye(n) + root.mT @ symmetrise(information) @ root
    lower, is_definite = _factor_definite(relative, smallest_pivot[:, None])
    # I + Sᵀ Λ S = C Cᵀ, so that P_tt = (C⁻¹ Sᵀ)ᵀ (C⁻¹ Sᵀ).
    half = np.linalg.solve(lower, np.broadcast_to(root.mT, lower.shape))
    target = half.mT @ half

    # The target t moves by P_tt η, and the ego state e by the gain times that. The regression of e
    # on t, its gain and the covariance of e given t, stays.
    gain, conditional = regression(prior, n)
    target_shift = (target @ vectors[..., None])[..., 0]
    ego_shift = (gain[q, None] @ target_shift[..., None])[..., 0]
    shift = np.concatenate([target_shift, ego_shift], axis=-1)
    means = prior.means[q, None] + shift
    covs = assemble_joint(target, gain[q, None], conditional[q, None])
    return means, covs, is_definite


def _select_definite(
    means: Array, covs: Array, q: Indices, is_definite: Mask
) -> ComponentShapes:
    """Return the shapes of the components that have a positive definite covariance."""
    # `q` (Q,) is the prior component of each row; means and masks are (Q, T, ...).
    source = np.broadcast_to(q[:, None], is_definite.shape)
    return ComponentShapes.construct(
        means[is_definite],
        covs[is_definite],
        source[is_definite],
        int((~is_definite).sum()),
    )


def fuse_by_receiver(
    priors: Sequence[GaussianMixture],
    targets: Sequence[GaussianMixture],
    received: Sequence[Sequence[GaussianMixture]],
) -> list[GaussianMixture]:
    """Fuse several receivers' beliefs with those that each has received, all exponents equal.

    The results are those of :func:`~distfilt.mixtures.fuse_mixtures`. The targets are the priors'
    marginals. The receivers' states have one dimension, and their messages one number of components
    each in order, so that one call updates the components of all.

    >>> pair = [GaussianMixture.gaussian([m], [[1.0]]) for m in (0.0, 3.0)]
    >>> after = fuse_by_receiver(pair, pair, [pair[1:], pair[:1]])
    >>> [fused.means.ravel() for fused in after]
    [array([1.5]), array([1.5])]
    """
    # The marginal is given, so that it is not computed again.
    fusions = [
        PartialFusion.construct(prior, tuple(others), target=target)
        for prior, target, others in zip(priors, targets, received, strict=True)
    ]
    invert_together(targets)
    # Each receiver's information Λ and vectors η, with every component divided by itself.
    changes = []
    for fusion in fusions:
        index = np.arange(fusion.prior.n_components)
        changes.append(
            _update_information(
                fusion.prior,
                fusion.target,
                fusion.others,
                fusion.exponents,
                (index, index),
            )
        )
    # All receivers' components as those of one mixture
    everyone = GaussianMixture.construct(
        np.concatenate([prior.weights for prior in priors]),
        np.concatenate([prior.means for prior in priors]),
        np.concatenate([prior.covs for prior in priors]),
    )
    n_all = everyone.n_components
    # Means, covariances, and whether these are positive definite, of each component and choice. As
    # each is divided by its own marginal, only a pivot at the level of rounding is refused.
    means, covs, is_definite = _update_components(
        everyone,
        np.arange(n_all),
        np.concatenate([information for information, _ in changes]),
        np.concatenate([vectors for _, vectors in changes]),
        np.full(n_all, _MATCHED_PIVOT),
    )
    # Back to one part for each receiver
    of_receivers = zip(
        divide_among(means, priors),
        divide_among(covs, priors),
        divide_among(is_definite, priors),
        strict=True,
    )
    # Weights by the exact density, for one receiver after the other
    fused = []
    for fusion, (own_means, own_covs, own_definite) in zip(
        fusions, of_receivers, strict=True
    ):
        index = np.arange(fusion.prior.n_components)
        shapes = _select_definite(own_means, own_covs, index, own_definite)
        fused.append(fusion.assign_weights(shapes))
    return fused


def _factor_definite(matrices: Array, smallest_pivot: Array) -> tuple[Array, Mask]:
    """Cholesky factors of matrices (..., d, d), and which of them exist (...).

    Where none does, the identity stands. `smallest_pivot` (...) is relative to the diagonal entry.
    """
    d = matrices.shape[-1]
    lower = np.zeros_like(matrices)
    is_definite = np.ones(matrices.shape[:-2], dtype=bool)
    for k in range(d):
        # Column k of the Schur complement: A[k:, k] - L[k:, :k] L[k, :k]ᵀ
        product = lower[..., k:, :k] @ lower[..., k, :k, None]
        column = matrices[..., k:, k] - product[..., 0]
        pivot = column[..., 0]
        # A pivot that has lost so many digits to cancellation is rounding.
        is_definite &= pivot > smallest_pivot * np.abs(matrices[..., k, k])
        # A matrix that has failed is carried along with harmless numbers.
        root = np.sqrt(np.where(is_definite, pivot, 1.0))
        column = np.where(is_definite[..., None], column, 0.0)
        lower[..., k:, k] = column / root[..., None]
    lower[~is_definite] = np.eye(d)
    return lower, is_definite


@validated
def tikhonov(
    largest: SingularValue,
    smallest: SingularValue,
    *,
    condition: Condition = 1e10,
) -> float:
    r"""Return the smallest α with which rows α I below a matrix give a condition number.

    That number is κ, `condition`, if by (66) of Semeraro et al.

    .. math:: \alpha^2=\frac{\sigma_1^2-\kappa^2\sigma_n^2}{\kappa^2-1}

    with the largest and the smallest singular value of the matrix; α is 0 if the matrix is well
    conditioned already. The printed (66) has an index i where the largest is meant.

    Parameters
    ----------
    largest, smallest : float
        Singular values, at least 0.
    condition : float
        Above 1.

    Examples
    --------
    >>> alpha = tikhonov(1.0, 0.0, condition=10.0)
    >>> round(float(np.sqrt(1 + alpha**2) / alpha), 9)
    10.0
    >>> tikhonov(1.0, 0.5, condition=10.0)
    0.0
    """
    excess = largest**2 - (condition * smallest) ** 2
    return float(np.sqrt(max(excess, 0.0) / (condition**2 - 1)))


@validated
def nonnegative_least_squares(
    matrix: Annotated[ArrayInput, "n s", Bounds(at_least=-1e150, at_most=1e150)],
    right: Annotated[ArrayInput, "n"],
    *,
    condition: Condition = 1e10,
) -> Array:
    r"""Nonnegative weights that solve ``matrix @ w = right`` best, regularised.

    They minimise :math:`|\mathbf M\mathbf w-\mathbf r|^2+\alpha^2|\mathbf w|^2`, (60) of Semeraro
    et al., with the α of :func:`tikhonov`.

    Parameters
    ----------
    matrix : array_like, (n, S)
    right : array_like, (n,)
    condition : float
        The largest condition number allowed.

    Returns
    -------
    ndarray, (S,)

    Raises
    ------
    SolverError
        If the iteration does not end.

    Examples
    --------
    >>> nonnegative_least_squares([[1.0, 0.0], [0.0, 1.0]], [2.0, -1.0])
    array([2., 0.])
    """
    from scipy.optimize import lsq_linear, nnls

    n_rows, n_unknowns = matrix.shape
    singular_values = svdvals(matrix)
    # With fewer rows than unknowns the smallest singular value of MᵀM is zero.
    smallest = singular_values[-1] if n_rows >= n_unknowns else 0.0
    # The smallest α that makes the problem well-conditioned; 0 if it is so already
    alpha = tikhonov(singular_values[0], smallest, condition=condition)
    if alpha > 0:
        # |M w - r|² + α² |w|² is the least-squares problem of stacked rows.
        matrix = np.concatenate([matrix, alpha * np.eye(n_unknowns)])
        right = np.concatenate([right, np.zeros(n_unknowns)])
    try:
        solution, _residual = nnls(matrix, right, maxiter=20 * n_unknowns)
    except RuntimeError as error:
        raise SolverError(
            f"nonnegative least squares: {error} ({n_unknowns} unknowns)"
        ) from None
    weights = np.asarray(solution, dtype=np.float64)
    # Karush-Kuhn-Tucker: the gradient is nonnegative, and zero where a weight is positive; up to
    # a millionth of its largest possible size, that at w = 0.
    gradient = matrix.T @ (matrix @ weights - right)
    limit = 1e-6 * singular_values[0] * np.linalg.norm(right)
    largest_slope = gradient[weights > 0].max(initial=0.0)
    if gradient.min() >= -limit and largest_slope <= limit:
        return weights
    # nnls can stop short where columns are almost the same; another method may come closer.
    other = lsq_linear(matrix, right, (0, np.inf), method="bvls").x.clip(0)
    residuals = [np.linalg.norm(matrix @ w - right) for w in (weights, other)]
    return weights if residuals[0] <= residuals[1] else np.asarray(other)
