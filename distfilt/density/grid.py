"""A box cut into equal cells: what a density on it is, integrates to, and expands in."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from ..models.swarm import inside
from ..validation import (
    Array,
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
    """A box in one to three dimensions, cut into equal cells.

    A density is a vector (..., n) of its means over the n cells, the last axis fastest; so a sum
    times the cell's volume is an exact integral.

    Parameters
    ----------
    shape : tuple of int
        Cells along each axis, at least 2 each.
    low, high : array_like, (d,), or float, optional
        The box's corners; zeros and ones by default.

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
            raise ValueError(f"shape must be one to three sizes, got {self.shape!r}")
        for name in ("low", "high"):
            corner = np.asarray(getattr(self, name), dtype=np.float64)
            if corner.shape not in ((), (self.dim,)):
                raise ValueError(
                    f"{name} must be {self.dim} numbers, got {corner.size}"
                )
            object.__setattr__(self, name, np.broadcast_to(corner, (self.dim,)))
        if (self.width <= 0).any():
            raise ValueError(
                f"high must have corners above low = {self.low}, got {self.high}"
            )

    @cached_property
    def width(self) -> Array:
        """Width of the box along each axis, (d,)."""
        return np.asarray(self.high - self.low)

    @property
    def box(self) -> float:
        """Volume of the box."""
        return float(np.prod(self.width))

    @property
    def side(self) -> float:
        """Side of the cube of this volume: the length with which others compare."""
        return float(self.box ** (1 / self.dim))

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
        ends = zip(low, low + self.width, self.shape, strict=True)
        return tuple(np.linspace(low, high, n + 1) for low, high, n in ends)

    @cached_property
    def centres(self) -> Array:
        """Centres of all cells, (n, d)."""
        axes = np.meshgrid(*(0.5 * (e[1:] + e[:-1]) for e in self.edges), indexing="ij")
        return np.stack([a.ravel() for a in axes], axis=-1)

    def _inside(self, positions: Array) -> Array:
        """Positions (..., d); those outside the box are refused."""
        return inside(positions, np.asarray(self.low), np.asarray(self.high))

    @validated
    def integral(self, values: Annotated[Array, "... self.size"]) -> Array:
        """Integral over the box of cell values (..., n)."""
        return np.asarray(values.sum(axis=-1) * self.volume)

    @validated
    def norm(self, values: Annotated[Array, "... self.size"]) -> Array:
        """L2 norm over the box of cell values (..., n)."""
        return np.asarray(np.sqrt((values**2).sum(axis=-1) * self.volume))

    @validated
    def normalize(self, values: Annotated[Array, "... self.size"]) -> Array:
        """Cell values (..., n) divided by their integral, which has to be positive."""
        total = values.sum(axis=-1) * self.volume
        if not (total > 0).all():
            raise ValueError(
                f"values must be a positive integral, got {float(total.min()):g}"
            )
        return np.asarray(values / total[..., None])

    @validated
    def cell_index(self, positions: Annotated[Array, "... self.dim"]) -> Indices:
        """Number of the cell in which each of the positions (..., d) lies, (...)."""
        at = ((self._inside(positions) - self.low) / self.spacing).astype(np.int64)
        at = np.minimum(at, np.array(self.shape) - 1)
        return np.asarray(
            np.ravel_multi_index(tuple(np.moveaxis(at, -1, 0)), self.shape)
        )

    @validated
    def histogram(self, positions: Annotated[Array, "... n self.dim"]) -> Array:
        """Histogram of agents (..., N, d), one or more, as a density (..., n)."""
        lead = positions.shape[:-2]
        n = positions.shape[-2]
        cells = self.cell_index(positions).reshape(-1, n)
        rows = [np.bincount(row, minlength=self.size) for row in cells]
        return np.asarray(np.reshape(rows, (*lead, self.size)) / (n * self.volume))

    @validated
    def interpolate(
        self,
        values: Annotated[Array, "self.size"],
        positions: Annotated[Array, "... self.dim"],
    ) -> Array:
        """Multilinear interpolation of cell values (n,) at positions (..., d); flat at walls."""
        from scipy.ndimage import map_coordinates

        flat = self._inside(positions).reshape(-1, self.dim)
        place = ((flat - self.low) / self.spacing - 0.5).T
        v = values.reshape(self.shape)
        found = map_coordinates(v, place, order=1, mode="nearest")
        return np.asarray(found.reshape(positions.shape[:-1]))

    def wavenumbers(self, rank: int) -> Indices:
        """The `rank` lowest cosine modes, (rank, d) half-waves along each axis, constant first.

        They are ordered by the frequency in the box, and ties by the number itself.
        """
        Bounds(at_most=self.size)(rank, "rank")
        k = np.stack([a.ravel() for a in np.indices(self.shape)], axis=-1)
        squared = ((k / (self.width / self.width.max())) ** 2).sum(axis=-1)
        # Nine digits of each, whatever its size: rounding splits ties, and symmetric modes are to
        # come in one order on every machine and in every unit.
        mantissa, exponent = np.frexp(squared)
        order = np.lexsort((*k.T[::-1], np.ldexp(mantissa.round(9), exponent)))
        return np.asarray(k[order[:rank]], dtype=np.int64)

    @validated
    def cosines(self, rank: PositiveInt) -> Array:
        r"""The `rank` lowest cosine modes at the centres, (n, rank), orthonormal over the box.

        :math:`c_k(x)\propto\prod_j\cos(\pi k_j (x_j-\text{low}_j)/w_j)`: the modes of reflecting
        walls. Their sums over cells are orthonormal exactly, not only in the limit. The array is
        kept, and read-only.

        Examples
        --------
        >>> basis = Grid((8, 8)).cosines(10)
        >>> bool(np.abs(basis.T @ basis / 64 - np.eye(10)).max() < 1e-12)
        True
        """
        if rank not in self._kept:
            x = (self.centres - self.low) / self.width
            waves = np.cos(np.pi * x[:, None, :] * self.wavenumbers(rank)).prod(axis=-1)
            self._kept[rank] = np.asarray(
                waves / np.sqrt((waves**2).sum(axis=0) * self.volume)
            )
            self._kept[rank].setflags(write=False)
        return self._kept[rank]

    @cached_property
    def _kept(self) -> dict[int, Array]:
        """Bases that were asked for before; consensus asks in every step."""
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

    Cosine modes without the constant one, with the spectrum of a squared exponential of length ℓ,
    :math:`\lambda_k\propto\exp(-\pi^2\ell^2|k|^2/2)`, scaled so that all modes together have the
    variance std² in the mean over the box. Every column integrates to zero, so no gain built from
    S can change a density's mass, unless `mass_std` adds a column that lets it.

    Parameters
    ----------
    grid : Grid
    rank : int
        Number r of modes that are kept, below the number of cells.
    length : float, optional
        Correlation length ℓ, in the box's unit; by default a tenth of the box's side.
    std : float, optional
        Standard deviation of the density in a cell, of all modes together; by default the mean
        density of the box.
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
    Bounds(below=grid.size)(rank, "rank")
    ell = 0.1 * grid.side if length is None else min(length, 1e6 * grid.side)
    squared = ((grid.wavenumbers(grid.size)[1:] / grid.width) ** 2).sum(axis=-1)
    # About the lowest mode: a length beyond the box leaves that alone, and no zero in its place.
    spectrum = np.exp(-0.5 * (np.pi * ell) ** 2 * (squared - squared[0]))
    scale = np.sqrt(spectrum[:rank] / (spectrum.sum() / grid.box))
    scale *= 1 / grid.box if std is None else std
    basis = np.asarray(grid.cosines(rank + 1)[:, 1:] * scale)
    even = np.full((grid.size, 1), mass_std / (grid.size * grid.volume))
    return np.concatenate([even, basis], axis=1) if mass_std > 0 else basis
