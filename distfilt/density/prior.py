"""What is believed of a density before anything is seen: smooth fields that hold no mass."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..checks import Array, count, instance, number
from .grid import Grid

__all__ = ["zero_mean_prior"]


def zero_mean_prior(
    grid: Grid, *, rank: int, length: float = 0.1, std: float = 1.0, mass_std: float = 0.0
) -> Array:
    r"""A factor S of the prior covariance P = S Sᵀ of a density: smooth, and of zero mass.

    Cosine modes without the constant one, with the spectrum of a squared exponential of length ℓ,
    :math:`\lambda_k\propto\exp(-\pi^2\ell^2|k|^2/2)`, scaled so that all modes together have the
    variance std² in the mean over the box. Every column integrates to zero, so no gain built from
    S can change a density's mass, unless `mass_std` adds a column that lets it.

    Parameters
    ----------
    grid : Grid
    rank : int
        Number r of modes that are kept, below the number of cells.
    length : float
        Correlation length ℓ, in the box's unit, positive.
    std : float
        Standard deviation of the density in a cell, of all modes together.
    mass_std : float
        Standard deviation of the total mass. Above 0, a constant column of that mass comes first.

    Returns
    -------
    ndarray, (n, r), or (n, 1 + r) if the mass is not certain

    Examples
    --------
    >>> S = zero_mean_prior(Grid((30, 30)), rank=50)
    >>> S.shape, bool(abs(S.sum(axis=0)).max() < 1e-10)
    ((900, 50), True)
    """
    instance(grid, "grid", Grid)
    mass = number(mass_std, "mass_std", at_least=0)
    ell, sigma = number(length, "length", above=0, at_most=1e100), number(std, "std", above=0)
    if count(rank, "rank") >= grid.size:
        raise ValueError(f"rank: needs at most {grid.size - 1} modes besides the constant, "
                         f"got {rank}")
    k = grid.wavenumbers(rank + 1)

    def spectrum(modes: NDArray[np.int64]) -> Array:
        return np.asarray(
            np.exp(-0.5 * (np.pi * ell) ** 2 * ((modes / grid.width) ** 2).sum(axis=-1))
        )

    every = np.stack([a.ravel() for a in np.indices(grid.shape)], axis=-1)[1:]
    total = spectrum(every).sum() / np.prod(grid.width)
    basis = grid.cosines(rank + 1)[:, 1:] * sigma * np.sqrt(spectrum(k[1:]) / total)
    even = np.full((grid.size, 1), mass / (grid.size * grid.volume))
    return np.concatenate([even, basis], axis=1) if mass > 0 else np.asarray(basis)
