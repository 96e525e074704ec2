"""Points that stand for a Gaussian: its mean, and pairs along the columns of a square root."""

from __future__ import annotations

from typing import Annotated

import numpy as np

from ..doors import Array, door

__all__ = ["unscented_points"]


@door
def unscented_points(
    mean: Annotated[Array, "... d"], root: Annotated[Array, "... d d"], *, kappa: float = 0.0
) -> tuple[Array, Array]:
    r"""The 2d + 1 unscented points of Gaussians and their weights, which sum to 1.

    The mean, then :math:`\mathbf m\pm\sqrt{d+\kappa}\,\mathbf s_i` with the columns of the square
    root, all plus first. Weighted sums over the points give the Gaussian's mean and covariance.
    With :math:`\kappa=0` the mean weighs nothing; with :math:`\kappa=3-d` fourth moments along
    each axis are a Gaussian's. Points scaled by :math:`\alpha` are those of
    :math:`\kappa'=\alpha^2(d+\kappa)-d`.

    Parameters
    ----------
    mean : array_like, (..., d)
    root : array_like, (..., d, d)
        S with :math:`\mathbf S\mathbf S^\top=\mathbf P`, such as a Cholesky factor.
    kappa : float
        Above -d.

    Returns
    -------
    points : ndarray, (..., 2d + 1, d)
    weights : ndarray, (2d + 1,)

    Examples
    --------
    >>> points, weights = unscented_points([1.0], [[2.0]], kappa=2.0)
    >>> points.round(3).ravel().tolist(), weights.round(3).tolist()
    ([1.0, 4.464, -2.464], [0.667, 0.167, 0.167])
    """
    d = mean.shape[-1]
    if d + kappa <= 0:
        raise ValueError(f"kappa: needs a number above {-d}, got {kappa:g}")
    moves = np.sqrt(d + kappa) * root.mT
    moves = np.concatenate([np.zeros_like(moves[..., :1, :]), moves, -moves], axis=-2)
    weights = np.full(2 * d + 1, 0.5 / (d + kappa))
    weights[0] = kappa / (d + kappa)
    return mean[..., None, :] + moves, weights
