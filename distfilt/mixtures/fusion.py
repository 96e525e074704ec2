r"""Fusing beliefs about a shared part of agents' states: only beliefs about the target travel.

An agent's state is x = [t; e]: the target t, which all agents estimate, comes first; what is its
own, e, comes last and differs from agent to agent. The fused density is

.. math:: p_f(\mathbf x)\propto p(\mathbf x)\,p(\mathbf t)^{\omega-1}
    \prod_b p_b(\mathbf t)^{\omega_b},\qquad \omega+\sum_b\omega_b=1,

equations (14)-(15) of Semeraro, LeGrand and Kulik for one other agent.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass
from functools import cached_property
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import svdvals

from ..gaussians.single import unscented_points
from ..linalg import SolverError, log_sum, symmetrise
from ..validation import (
    Array,
    Bounds,
    FrozenModel,
    Mask,
    PositiveInt,
    UnitInterval,
    check_probabilities,
    validated,
)
from .gaussian import GaussianMixture, assemble_joint, inverse, regression
from .reduction import ComponentShapes

__all__ = ["PartialFusion", "nonnegative_least_squares", "tikhonov"]

Others = GaussianMixture | Sequence[GaussianMixture]
Exponents = UnitInterval | Literal["equal"] | Annotated[Array, "K", check_probabilities]
Terms = Literal["matched", "all"]
Rule = Literal["C1", "C2", "C3", "points"]
Condition = Annotated[float, Bounds(above=1, at_most=1e150)]

# Relative density below which the rows of "points" stop gaining weight.
_FLOOR = 1e-3


@dataclass(frozen=True, eq=False)
class PartialFusion(FrozenModel):
    r"""The exact fused density, which can be evaluated but is no mixture, and its approximations.

    Parameters
    ----------
    own : GaussianMixture
        The agent's belief about [t; e].
    heard : GaussianMixture or sequence of them
        Others' beliefs about t; all of one dimension, at most that of `own`.
    omega : float, "equal" or array_like
        Exponent of the own target marginal, in [0, 1]; the others share the rest equally. "equal"
        gives all the same. Or one exponent each, own first, nonnegative with sum 1.

    Examples
    --------
    >>> own = GaussianMixture.gaussian([0.0, 0.0], [[2.0, 1.0], [1.0, 1.0]])
    >>> other = GaussianMixture.gaussian([3.0], [[1.0]])
    >>> exact = PartialFusion(own, other)
    >>> fused = exact.assign_weights(exact.component_shapes())
    >>> fused.means.round(4), fused.covs[0, 0, 0].round(4)
    (array([[2., 1.]]), np.float64(1.3333))
    """

    own: GaussianMixture
    received: Others
    _: KW_ONLY
    omega: Exponents = "equal"

    def __post_init__(self) -> None:
        super().__post_init__()
        sizes = {other.dim for other in self.others}
        if len(sizes) != 1 or max(sizes) > self.own.dim:
            raise ValueError(
                f"heard must have target beliefs, one or more, of one size, at most own's "
                f"{self.own.dim}, got {sorted(sizes)}"
            )
        if np.ndim(self.omega) and len(self.exponents) != len(self.others) + 1:
            raise ValueError(
                f"omega must be {len(self.others) + 1} exponents, got {len(self.exponents)}"
            )

    @property
    def others(self) -> tuple[GaussianMixture, ...]:
        """What is heard, one or several."""
        return (
            (self.received,)
            if isinstance(self.received, GaussianMixture)
            else tuple(self.received)
        )

    @cached_property
    def exponents(self) -> Array:
        """Exponents of the own and of the others' target marginals; their sum is 1."""
        others = len(self.others)
        if isinstance(self.omega, np.ndarray):
            return self.omega
        if isinstance(self.omega, str):
            return np.full(others + 1, 1 / (others + 1))
        return np.array([self.omega] + [(1 - self.omega) / others] * others)

    @property
    def target_dim(self) -> int:
        """Number of components of the target."""
        return self.others[0].dim

    @cached_property
    def target(self) -> GaussianMixture:
        """The own belief about the target."""
        return self.own.marginal(range(self.target_dim))

    def _with_update(self, logs: Array, t: Array, name: str) -> Array:
        """Logarithms of densities and that of the update factor g(t) of (15), added."""
        w = self.exponents
        with np.errstate(invalid="ignore"):
            if w[0] != 1:
                logs = logs + (w[0] - 1) * self.target.log_density(t)
            for weight, other in zip(w[1:], self.others, strict=True):
                if weight:
                    logs = logs + weight * other.log_density(t)
        if np.isnan(logs).any():  # one density is divided by another, and both are zero
            raise ValueError(
                f"{name} must have points whose density is a number, got one too far out"
            )
        return logs

    @validated
    def log_value(self, x: Annotated[Array, "... self.own.dim"]) -> Array:
        """Logarithm of the fused density (14), not normalised, (...).

        Parameters
        ----------
        x : array_like, (..., d)
        """
        logs = self.own.log_density(x)
        return self._with_update(logs, x[..., : self.target_dim], "x")

    @validated
    def log_target(self, t: Annotated[Array, "... self.target_dim"]) -> Array:
        """Logarithm of the fused target marginal, not normalised; it needs no ego state."""
        return self._with_update(self.target.log_density(t), t, "t")

    @validated
    def component_shapes(
        self,
        *,
        terms: Terms = "matched",
        marginal: GaussianMixture | None = None,
        received: Sequence[GaussianMixture] | None = None,
    ) -> ComponentShapes:
        """Means and covariances of the fused mixands, (22)-(28), without weights.

        By conditioning in the own mixand's whitened frame, which inverts nothing indefinite.

        Parameters
        ----------
        terms : {"matched", "all"}
            Terms in which own mixand and divided mixand are the same, L L' of them, all positive
            definite (in floating point while what is heard is less than a million times as sharp);
            or all L² L', of which some are not. Those are left out, and `dropped` counts them.
        marginal : GaussianMixture, optional
            What to divide by in place of the own target marginal (a reduced one); with
            ``terms="all"``.
        received : sequence of GaussianMixture, optional
            What to multiply by in place of `heard` (reduced ones).
        """
        if marginal is not None and terms == "matched":
            raise ValueError(
                "marginal must be terms='all', since matched terms use the own mixands"
            )
        divided = self.target if marginal is None else marginal
        sent = self.others if received is None else received
        n = self.target_dim
        if divided.dim != n:
            raise ValueError(f"marginal must have dimension {n}, got {divided.dim}")
        wanted = [n] * len(self.others)
        got = [other.dim for other in sent]
        if got != wanted:
            raise ValueError(
                f"received must have mixtures of dimensions {wanted}, got {got}"
            )
        pairs: NDArray[np.intp] = np.indices(
            (self.own.n_components, divided.n_components)
        ).reshape(2, -1)
        if terms == "matched":
            pairs = np.repeat(np.arange(self.own.n_components)[None], 2, axis=0)
        return _conditional(self.own, divided, sent, self.exponents, pairs)

    @validated
    def assign_weights(
        self, shapes: ComponentShapes, *, rule: Rule = "C3", at_most: PositiveInt = 500
    ) -> GaussianMixture:
        """The mixture of these shapes, with weights from the exact density at collocation points.

        Mixands whose weight is zero are left out.

        Parameters
        ----------
        shapes : Shapes
        rule : {"C1", "C2", "C3", "points"}
            (30), (31), (32)-(34), or C3 with the mixands' sigma points as further points.
        at_most : int
            For "C3" and "points": how many mixands may take part, the largest by C2.

        Raises
        ------
        SolverError
            If no mixand has a weight, or least squares do not end.
        """
        mixture = shapes.with_equal_weights()
        logs = self._at_means(shapes, alone=rule == "C1")
        if rule in ("C1", "C2"):
            return _weighed(mixture, logs)
        if shapes.n_components > at_most:
            best = np.argsort(mixture.log_peaks - logs, kind="stable")[:at_most]
            keep = np.isin(np.arange(shapes.n_components), best)
            shapes = shapes.select(keep)
            logs = logs[keep]
            mixture = shapes.with_equal_weights()
        points = shapes.means
        if rule == "points":
            points = unscented_points(mixture.means, mixture.factors)[0]
            points = points.reshape(-1, mixture.dim)
            logs = self.log_value(points)
        matrix = np.exp(mixture.component_log_densities(points) - mixture.log_peaks)
        right = np.exp(logs - logs.max())
        if rule == "points":
            rows = 1 / np.sqrt(right + _FLOOR)
            matrix = matrix * rows[:, None]
            right = right * rows
        found = nonnegative_least_squares(matrix, right)
        with np.errstate(divide="ignore"):
            return _weighed(mixture, np.log(found))

    def _at_means(self, shapes: ComponentShapes, *, alone: bool) -> Array:
        """Log density at the shapes' means, exact or with the mixand alone that each came from."""
        if not alone:
            return self.log_value(shapes.means)
        own = self.own
        q = shapes.source
        white = np.linalg.solve(
            own.factors[q], (shapes.means - own.means[q])[..., None]
        )[..., 0]
        logs = (own.log_weights + own.log_peaks)[q] - 0.5 * (white**2).sum(axis=-1)
        return self._with_update(logs, shapes.means[:, : self.target_dim], "shapes")


def _weighed(mixture: GaussianMixture, logs: Array) -> GaussianMixture:
    """Weights from the logarithms of EQ coefficients, by (18); what vanishes is left out."""
    mass = logs - mixture.log_peaks
    total = log_sum(mass)
    if not np.isfinite(total).all():
        raise SolverError(
            "no fused mixand has a weight: the exact density is zero at every point"
        )
    w = np.exp(mass - total)
    keep = w > 0
    w = w[keep] / w[keep].sum()
    return GaussianMixture.construct(w, mixture.means[keep], mixture.covs[keep])


def _told(
    sent: Sequence[GaussianMixture], w: Array, about: Array
) -> tuple[Array, Array]:
    """Information (Q, T, n, n) and vectors (Q, T, n) of the product of the others' powers.

    One term for each choice of a mixand from each, with vectors relative to points (Q, n).
    """
    q, n = about.shape
    information = np.zeros((q, 1, n, n))
    pull = np.zeros((q, 1, n))
    for weight, other in zip(w, sent, strict=True):
        j = weight * inverse(other.factors)
        eta = np.einsum("rij,srj->sri", j, other.means - about[:, None])
        information = (information[:, :, None] + j).reshape(q, -1, n, n)
        pull = (pull[:, :, None] + eta[:, None]).reshape(q, -1, n)
    return information, pull


def _conditional(
    own: GaussianMixture,
    divided: GaussianMixture,
    sent: Sequence[GaussianMixture],
    w: Array,
    pairs: NDArray[np.intp],
) -> ComponentShapes:
    """Update the target part by Λ and η in the own mixand's whitened frame; e follows."""
    n = divided.dim
    q, p = pairs
    # Everything about the own mixand's mean: far from the origin products would cancel.
    information, pull = _told(sent, w[1:], own.means[q, :n])
    if w[0] != 1:
        j = (w[0] - 1) * inverse(divided.factors)[p]
        gap = divided.means[p] - own.means[q, :n]
        information = information + j[:, None]
        pull = pull + (j @ gap[..., None])[:, None, :, 0]
    root = np.linalg.cholesky(own.covs[q, :n, :n])[:, None]
    # Where the own mixand is the divided one there is a factor; else it may be rounding's.
    least = np.where((q == p) & (len(divided.means) == own.n_components), 1e-13, 1e-10)[
        :, None
    ]
    lower, good = _factored(np.eye(n) + root.mT @ symmetrise(information) @ root, least)
    half = np.linalg.solve(lower, np.broadcast_to(root.mT, lower.shape))
    target = half.mT @ half
    move = (target @ pull[..., None])[..., 0]
    gain, rest = (part[q, None] for part in regression(own, n))
    shift = np.concatenate([move, (gain @ move[..., None])[..., 0]], axis=-1)
    covs = assemble_joint(target, gain, rest)
    source = np.broadcast_to(q[:, None], good.shape)
    means = own.means[q, None] + shift
    return ComponentShapes.construct(
        means[good], covs[good], source[good], int((~good).sum())
    )


def _factored(matrices: Array, least: Array) -> tuple[Array, Mask]:
    """Cholesky factors of a stack, and which of them exist; the identity where none does."""
    d = matrices.shape[-1]
    lower = np.zeros_like(matrices)
    good = np.ones(matrices.shape[:-2], dtype=bool)
    for k in range(d):
        column = (
            matrices[..., k:, k]
            - (lower[..., k:, :k] @ lower[..., k, :k, None])[..., 0]
        )
        # A pivot that has lost so many digits to cancellation is rounding.
        good &= column[..., 0] > least * np.abs(matrices[..., k, k])
        pivot = np.where(good, column[..., 0], 1.0)
        lower[..., k:, k] = (
            np.where(good[..., None], column, 0.0) / np.sqrt(pivot)[..., None]
        )
    lower[~good] = np.eye(d)
    return lower, good


@validated
def tikhonov(
    largest: Annotated[float, Bounds(at_least=0, at_most=1e150)],
    smallest: Annotated[float, Bounds(at_least=0, at_most=1e150)],
    *,
    condition: Condition = 1e10,
) -> float:
    r"""The smallest factor that brings a matrix's condition number down to `condition`, (66).

    .. math:: \alpha^2=\frac{\sigma_1^2-\kappa^2\sigma_n^2}{\kappa^2-1}

    and 0 where the matrix is well conditioned already. The printed (66) has an index i where the
    largest singular value is meant.

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
    gap = largest**2 - (condition * smallest) ** 2
    return float(np.sqrt(max(gap, 0.0) / (condition**2 - 1)))


@validated
def nonnegative_least_squares(
    matrix: Annotated[Array, "n s", Bounds(at_least=-1e150, at_most=1e150)],
    right: Annotated[Array, "n"],
    *,
    condition: Condition = 1e10,
) -> Array:
    """Nonnegative weights that solve ``matrix @ w = right`` best, regularised by (60) and (66).

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

    rows, columns = matrix.shape
    values = svdvals(matrix)
    alpha = tikhonov(values[0], values[-1] * (rows >= columns), condition=condition)
    if alpha > 0:
        matrix = np.concatenate([matrix, alpha * np.eye(columns)])
        right = np.concatenate([right, np.zeros(columns)])
    try:
        out = np.asarray(nnls(matrix, right, maxiter=20 * columns)[0], dtype=np.float64)
    except RuntimeError as error:
        raise SolverError(
            f"nonnegative least squares: {error} ({columns} unknowns)"
        ) from None
    slope = matrix.T @ (matrix @ out - right)
    limit = 1e-6 * values[0] * np.linalg.norm(right)
    if slope.min() >= -limit and slope[out > 0].max(initial=0.0) <= limit:
        return out
    # It stops short at times where columns are almost the same; the optimum's slope tells.
    other = lsq_linear(matrix, right, (0, np.inf), method="bvls").x.clip(0)
    return min(out, other, key=lambda w: float(np.linalg.norm(matrix @ w - right)))
