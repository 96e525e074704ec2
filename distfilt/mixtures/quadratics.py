"""Sums of exponential quadratics: what quotients and powers of Gaussian mixtures are made of."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ..checks import Array, array, instance, number

__all__ = ["ExponentialQuadratics"]


@dataclass(frozen=True, eq=False)
class ExponentialQuadratics:
    r"""A sum :math:`\sum_\ell\exp(c_\ell+\boldsymbol\eta_\ell^\top\mathbf x
    -\tfrac12\mathbf x^\top\boldsymbol\Lambda_\ell\mathbf x)`.

    Equation (16) in information form: a precision may be indefinite or singular, so that quotients
    of Gaussians and Gaussians that cancel have a representation.

    Parameters
    ----------
    precisions : array_like, (L, d, d)
        Symmetric, of any sign.
    vectors : array_like, (L, d)
    log_coefficients : array_like, (L,)
        -inf for a term that is not there.

    Examples
    --------
    >>> one = ExponentialQuadratics([[[0.5]]], [[1.5]], [-1.0])
    >>> ratio = one.times(one.power(-1.0))
    >>> float(ratio.precisions[0, 0, 0]), float(ratio.log_value([7.0]))
    (0.0, 0.0)
    """

    precisions: Array
    vectors: Array
    log_coefficients: Array

    def __post_init__(self) -> None:
        c = array(self.log_coefficients, "log_coefficients", ("L",), finite=False)
        if not c.size or np.isnan(c).any() or (c == np.inf).any():
            raise ValueError("log_coefficients: needs numbers or -inf, at least one")
        v = array(self.vectors, "vectors", (c.size, "d"))
        p = array(self.precisions, "precisions", (c.size, v.shape[1], v.shape[1]))
        if not np.allclose(p, np.swapaxes(p, -1, -2), rtol=1e-9, atol=1e-9 * np.abs(p).max()):
            raise ValueError("precisions: needs symmetric matrices, got others")
        for name, value in (("log_coefficients", c), ("vectors", v), ("precisions", p)):
            object.__setattr__(self, name, value)

    @property
    def size(self) -> int:
        """Number of terms, L."""
        return int(self.log_coefficients.size)

    def log_value(self, x: ArrayLike) -> Array:
        """Logarithm of the sum, (...).

        Parameters
        ----------
        x : array_like, (..., d)
        """
        at = array(x, "x", (..., self.vectors.shape[1]))
        square = np.einsum("...i,lij,...j->...l", at, self.precisions, at)
        return log_sum(self.log_coefficients + at @ self.vectors.T - 0.5 * square)

    def power(self, exponent: float) -> ExponentialQuadratics:
        r"""Each term to a power: the first-order power approximation (19)-(20).

        Exact for one term. For more it is the sum of powers where the power of the sum is meant.

        Parameters
        ----------
        exponent : float
            May be negative; not zero where a term is missing.
        """
        a = number(exponent, "exponent")
        if a <= 0 and np.isinf(self.log_coefficients).any():
            raise ValueError(f"exponent: needs a positive one for terms of weight 0, got {a:g}")
        return ExponentialQuadratics(
            a * self.precisions, a * self.vectors, a * self.log_coefficients
        )

    def times(self, other: ExponentialQuadratics) -> ExponentialQuadratics:
        """The product of two sums, L L' terms, those of `other` running fastest; (22)-(24)."""
        instance(other, "other", ExponentialQuadratics)
        if other.vectors.shape[1] != self.vectors.shape[1]:
            raise ValueError(
                f"other: needs dimension {self.vectors.shape[1]}, got {other.vectors.shape[1]}"
            )
        d = self.vectors.shape[1]
        return ExponentialQuadratics(
            (self.precisions[:, None] + other.precisions).reshape(-1, d, d),
            (self.vectors[:, None] + other.vectors).reshape(-1, d),
            (self.log_coefficients[:, None] + other.log_coefficients).ravel(),
        )


def inverse(factors: Array) -> Array:
    """The inverse of L L', symmetric, for Cholesky factors (..., d, d)."""
    white = np.linalg.solve(factors, np.broadcast_to(np.eye(factors.shape[-1]), factors.shape))
    return np.asarray(np.swapaxes(white, -1, -2) @ white)


def log_sum(logs: Array) -> Array:
    """Logarithm of the sum of exponentials along the last axis; -inf where all are."""
    top = logs.max(axis=-1, keepdims=True)
    top = np.where(np.isfinite(top), top, 0.0)
    with np.errstate(divide="ignore"):
        return np.asarray(np.log(np.exp(logs - top).sum(axis=-1)) + top[..., 0])
