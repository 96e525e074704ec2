"""A box divided into equal cells: integrals, histograms and cosine modes of a density on it."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from ..models.swarm import check_inside
from ..validation import (
    Array,
    ArrayInput,
    Bounds,
    FrozenModel,
    Indices,
    NonNegativeFloat,
    PositiveFloat,
    PositiveInt,
    validated,
)

__all__ = ["Grid", "zero_mean_prior"]


@dataclass(frozen=True, eq=False)
class Grid(FrozenModel):
    """A box in one to three dimensions, divided into equal cells.

    A density is a vector (..., n) of its means over the n cells, the last axis fastest; so a sum
    times the cell volume is an exact integral.

    Parameters
    ----------
    shape : tuple of int
        Number of cells along each axis, at least 2.
    low, high : array_like, (d,), or float, optional
        Corners of the box; zeros and ones by default.

    Examples
    --------
    >>> grid = Grid((2, 3))
    >>> grid.size, grid.dim, round(grid.volume, 4)
    (6, 2, 0.1667)
    >>> grid.centres[:3, 1].round(3)
    array([0.167, 0.5  , 0.833])
    """

    shape: tuple[Annotated[int, Bounds(at_least=2)], ...]
    low: float | Annotated[Array, "d"] = field(default=0.0, kw_only=True)
    high: float | Annotated[Array, "d"] = field(default=1.0, kw_only=True)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 1 <= self.dim <= 3:
            raise ValueError(
                f"shape must have one to three entries, got {self.shape!r}"
            )
        for name in ("low", "high"):
            corner = np.asarray(getattr(self, name), dtype=np.float64)
            if corner.shape not in ((), (self.dim,)):
                raise ValueError(
                    f"{name} must have {self.dim} entries, got {corner.size}"
                )
            # One number for all axes, or one for each. The dataclass is frozen, so that the field
            # cannot be assigned to.
            object.__setattr__(self, name, np.broadcast_to(corner, (self.dim,)))
        if (self.width <= 0).any():
            raise ValueError(f"high must be above low = {self.low}, got {self.high}")

    @cached_property
    def width(self) -> Array:
        """Width of the box along each axis, (d,)."""
        return np.asarray(self.high - self.low)

    @property
    def box_volume(self) -> float:
        """Volume of the box."""
        return float(np.prod(self.width))

    @property
    def side(self) -> float:
        """Side of the cube of the same volume, the length scale of default parameters."""
        return float(self.box_volume ** (1 / self.dim))

    @property
    def dim(self) -> int:
        """Number d of axes."""
        return len(self.shape)

    @property
    def size(self) -> int:
        """Number n of cells."""
        return int(np.prod(self.shape))

    @cached_property
    def spacing(self) -> Array:
        """Width of a cell along each axis, (d,)."""
        return np.asarray(self.width / np.array(self.shape))

    @cached_property
    def volume(self) -> float:
        """Volume of a cell."""
        return float(np.prod(self.spacing))

    @cached_property
    def edges(self) -> tuple[NDArray[np.float64], ...]:
        """Edges of the cells along each axis, (n_k + 1,)."""
        low = np.asarray(self.low)
        axes = zip(low, low + self.width, self.shape, strict=True)
        return tuple(np.linspace(start, end, n + 1) for start, end, n in axes)

    @cached_property
    def centres(self) -> Array:
        """Centres of all cells, (n, d)."""
        # The last axis varies fastest, like the axes of reshaped values.
        middles = [0.5 * (edges[1:] + edges[:-1]) for edges in self.edges]
        coordinates = np.meshgrid(*middles, indexing="ij")
        return np.stack([c.ravel() for c in coordinates], axis=-1)

    def _check_inside(self, positions: Array) -> None:
        """Refuse positions (..., d) outside the box."""
        check_inside(positions, np.asarray(self.low), np.asarray(self.high))

    @validated
    def integral(self, values: Annotated[ArrayInput, "... self.size"]) -> Array:
        """Integral over the box of cell values (..., n)."""
        return np.asarray(values.sum(axis=-1) * self.volume)

    @validated
    def norm(self, values: Annotated[ArrayInput, "... self.size"]) -> Array:
        """L2 norm over the box of cell values (..., n)."""
        return np.asarray(np.sqrt((values**2).sum(axis=-1) * self.volume))

    @validated
    def normalize(self, values: Annotated[ArrayInput, "... self.size"]) -> Array:
        """Divide cell values (..., n) by their integral, which has to be positive."""
        integral = values.sum(axis=-1) * self.volume
        if not (integral > 0).all():
            raise ValueError(
                f"values must have a positive integral, got {float(integral.min()):g}"
            )
        return np.asarray(values / integral[..., None])

    @validated
    def cell_index(self, positions: Annotated[ArrayInput, "... self.dim"]) -> Indices:
        """Flat index of the cell in which each of the positions (..., d) lies, (...)."""
        self._check_inside(positions)
        index = ((positions - self.low) / self.spacing).astype(np.int64)
        # The upper wall belongs to the last cell.
        index = np.minimum(index, np.array(self.shape) - 1)
        axes = tuple(np.moveaxis(index, -1, 0))
        return np.asarray(np.ravel_multi_index(axes, self.shape))

    @validated
    def histogram(self, positions: Annotated[ArrayInput, "... n self.dim"]) -> Array:
        """Histogram of N agents (..., N, d), N ≥ 1, as a density in the n cells, (..., n)."""
        agents = positions.shape[-2]
        # How many agents each cell has, for one swarm after the other.
        cells = self.cell_index(positions).reshape(-1, agents)
        rows = [np.bincount(row, minlength=self.size) for row in cells]
        counts = np.reshape(rows, (*positions.shape[:-2], self.size))
        # The mean over a cell is its share of the agents divided by its volume.
        return np.asarray(counts / (agents * self.volume))

    @validated
    def interpolate(
        self,
        values: Annotated[ArrayInput, "self.size"],
        positions: Annotated[ArrayInput, "... self.dim"],
    ) -> Array:
        """Interpolate cell values (n,) linearly at positions (..., d); constant next to walls."""
        from scipy.ndimage import map_coordinates

        self._check_inside(positions)
        # In units of cells, with the first centre as the origin.
        rows = positions.reshape(-1, self.dim)
        coordinates = ((rows - self.low) / self.spacing - 0.5).T
        # Outside the outermost centres the nearest value is used: zero slope at walls.
        image = values.reshape(self.shape)
        result = map_coordinates(image, coordinates, order=1, mode="nearest")
        return np.asarray(result.reshape(positions.shape[:-1]))

    def wavenumbers(self, rank: int) -> Indices:
        """Wavenumbers of the `rank` lowest cosine modes: half-waves along each axis, (rank, d).

        The constant mode is first. Modes are ordered by their frequency in the box, and ties by
        the wavenumbers themselves.
        """
        Bounds(at_most=self.size)(rank, "rank")
        k = np.stack([axis.ravel() for axis in np.indices(self.shape)], axis=-1)
        relative_width = self.width / self.width.max()
        squares = ((k / relative_width) ** 2).sum(axis=-1)
        # Rounded to nine digits: modes of a square box come in pairs of equal frequency, and their
        # order must not depend on rounding errors, which differ between machines and units.
        mantissa, exponent = np.frexp(squares)
        frequency = np.ldexp(mantissa.round(9), exponent)
        # The last key of lexsort is the first criterion; then k along axis 0, axis 1, ...
        order = np.lexsort((*k.T[::-1], frequency))
        return np.asarray(k[order[:rank]], dtype=np.int64)

    @validated
    def cosines(self, rank: PositiveInt) -> Array:
        r"""The `rank` lowest cosine modes at the centres, (n, rank), orthonormal over the box.

        :math:`c_k(x)\propto\prod_j\cos(\pi k_j (x_j-\text{low}_j)/w_j)`: the modes of reflecting
        walls. They are orthonormal as sums over cells, not only in the limit of small cells. The
        array is cached and read-only.

        Examples
        --------
        >>> basis = Grid((8, 8)).cosines(10)
        >>> bool(np.abs(basis.T @ basis / 64 - np.eye(10)).max() < 1e-12)
        True
        """
        if rank not in self._cosine_cache:
            x = (self.centres - self.low) / self.width
            # cos(π k_j (x_j - low_j)/w_j), multiplied over the axes
            phases = np.pi * x[:, None, :] * self.wavenumbers(rank)
            modes = np.cos(phases).prod(axis=-1)
            # Sums over cells are exact: the norm may be computed by them.
            norms = np.sqrt((modes**2).sum(axis=0) * self.volume)
            modes = np.asarray(modes / norms)
            # Read-only, since all callers share the cached array.
            modes.setflags(write=False)
            self._cosine_cache[rank] = modes
        return self._cosine_cache[rank]

    @cached_property
    def _cosine_cache(self) -> dict[int, Array]:
        """Cosine modes by rank; consensus needs them in every step."""
        return {}


@validated
def zero_mean_prior(
    grid: Grid,
    *,
    rank: PositiveInt,
    length: PositiveFloat | None = None,
    std: PositiveFloat | None = None,
    mass_std: NonNegativeFloat = 0.0,
) -> Array:
    r"""A factor S of the prior covariance P = S Sᵀ of a density: smooth, and of zero mass.

    The columns are cosine modes without the constant one, with the spectrum of a squared
    exponential of length ℓ, :math:`\lambda_k\propto\exp(-\pi^2\ell^2|k|^2/2)`, scaled so that the
    variance of all modes together, averaged over the box, is std². Every column integrates to
    zero, so that an update with a gain built from S conserves the density's mass, unless
    `mass_std` adds a constant column.

    Parameters
    ----------
    grid : Grid
    rank : int
        Number r of modes that are retained, below the number of cells.
    length : float, optional
        Correlation length ℓ, in the box's unit; by default a tenth of the box's side.
    std : float, optional
        Standard deviation of the density in a cell, of all modes together; by default the mean
        density of the box.
    mass_std : float
        Standard deviation of the total mass. If it is positive, a constant column comes first.

    Returns
    -------
    ndarray, (n, r), or (n, 1 + r) if the mass is not certain

    Examples
    --------
    >>> S = zero_mean_prior(Grid((30, 30)), rank=50)
    >>> S.shape, bool(abs(S.sum(axis=0)).max() < 1e-10)
    ((900, 50), True)
    """
    Bounds(below=grid.size)(rank, "rank")
    # A longer length leaves only the lowest mode; the bound avoids an overflow of its square.
    ell = 0.1 * grid.side if length is None else min(length, 1e6 * grid.side)
    # |k|² of the modes without the constant one
    squares = ((grid.wavenumbers(grid.size)[1:] / grid.width) ** 2).sum(axis=-1)
    # Relative to the lowest mode: it stays 1 where a long length makes all others zero.
    spectrum = np.exp(-0.5 * (np.pi * ell) ** 2 * (squares - squares[0]))
    # Each mode has the mean square 1/volume of the box.
    scale = np.sqrt(spectrum[:rank] / (spectrum.sum() / grid.box_volume))
    scale *= 1 / grid.box_volume if std is None else std
    basis = np.asarray(grid.cosines(rank + 1)[:, 1:] * scale)
    if mass_std == 0:
        return basis
    # A constant density of mass mass_std over all cells
    constant = np.full((grid.size, 1), mass_std / (grid.size * grid.volume))
    return np.concatenate([constant, basis], axis=1)
