"""A box cut into equal cells: what a density on it is, integrates to, and expands in."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..checks import Array, array, count

__all__ = ["Grid"]


@dataclass(frozen=True, eq=False)
class Grid:
    """A box in one to three dimensions, cut into equal cells.

    A density is a vector (..., n) of its means over the n cells, the last axis fastest; so a sum
    times the cell's volume is an exact integral.

    Parameters
    ----------
    shape : tuple of int
        Cells along each axis, at least 2 each.
    low, high : array_like, (d,), optional
        The box's corners; zeros and ones by default.

    Examples
    --------
    >>> grid = Grid((2, 3))
    >>> grid.size, grid.dim, round(grid.volume, 4)
    (6, 2, 0.1667)
    >>> grid.centres[:3, 1].round(3)
    array([0.167, 0.5  , 0.833])
    """

    shape: tuple[int, ...]
    low: ArrayLike | None = field(default=None, kw_only=True)
    high: ArrayLike | None = field(default=None, kw_only=True)

    def __post_init__(self) -> None:
        if not isinstance(self.shape, tuple) or not 1 <= len(self.shape) <= 3:
            raise ValueError(f"shape: needs a tuple of one to three sizes, got {self.shape!r}")
        for n in self.shape:
            count(n, "shape", at_least=2)
        d = len(self.shape)
        low = array(np.zeros(d) if self.low is None else self.low, "low", (d,)).copy()
        high = array(np.ones(d) if self.high is None else self.high, "high", (d,)).copy()
        if (low >= high).any():
            raise ValueError(f"high: needs corners above low = {low.tolist()}, got {high.tolist()}")
        object.__setattr__(self, "low", low)
        object.__setattr__(self, "high", high)

    @cached_property
    def corner(self) -> Array:
        """The lower corner, (d,)."""
        return np.asarray(self.low, dtype=np.float64)

    @cached_property
    def width(self) -> Array:
        """Width of the box along each axis, (d,)."""
        return np.asarray(np.asarray(self.high, dtype=np.float64) - self.corner)

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

    def axis(self, k: int) -> Array:
        """Centres of the cells along axis `k`, (n_k,)."""
        edges = self.edges(k)
        return 0.5 * (edges[1:] + edges[:-1])

    def edges(self, k: int) -> Array:
        """Edges of the cells along axis `k`, (n_k + 1,)."""
        if count(k, "k", at_least=0) >= self.dim:
            raise ValueError(f"k: needs an axis below {self.dim}, got {k}")
        low, high = self.corner[k], self.corner[k] + self.width[k]
        return np.linspace(low, high, self.shape[k] + 1)

    @cached_property
    def centres(self) -> Array:
        """Centres of all cells, (n, d)."""
        axes = np.meshgrid(*(self.axis(k) for k in range(self.dim)), indexing="ij")
        return np.stack([a.ravel() for a in axes], axis=-1)

    def check(self, values: ArrayLike, name: str = "values") -> Array:
        """Cell values (..., n) as an array."""
        return array(values, name, (..., self.size))

    def inside(self, positions: ArrayLike, name: str = "positions") -> Array:
        """Positions (..., d) as an array; those outside the box, or NaN, are refused."""
        x = array(positions, name, (..., self.dim))
        outside = ((x < self.corner) | (x > np.asarray(self.high))).any(axis=-1)
        if outside.any():
            raise ValueError(
                f"{name}: needs agents inside the grid's box, got {int(outside.sum())} outside, "
                f"one at {x[outside][0].tolist()}"
            )
        return x

    def integral(self, values: ArrayLike) -> Array:
        """Integral over the box of cell values (..., n)."""
        return np.asarray(self.check(values).sum(axis=-1) * self.volume)

    def norm(self, values: ArrayLike) -> Array:
        """L2 norm over the box of cell values (..., n)."""
        v = self.check(values)
        return np.asarray(np.sqrt((v**2).sum(axis=-1) * self.volume))

    def normalised(self, values: ArrayLike) -> Array:
        """Cell values (..., n) divided by their integral, which has to be positive."""
        v = self.check(values)
        total = self.integral(v)
        if not (total > 0).all():
            raise ValueError(f"values: needs a positive integral, got {float(total.min()):g}")
        return np.asarray(v / total[..., None])

    def mean(self, values: ArrayLike) -> Array:
        """First moment of a density (..., n), (..., d)."""
        return np.asarray(self.check(values) @ self.centres * self.volume)

    def cells(self, positions: ArrayLike) -> NDArray[np.int64]:
        """Number of the cell in which each of the positions (..., d) lies, (...)."""
        x = self.inside(positions)
        at = ((x - self.corner) / self.spacing).astype(np.int64)
        at = np.minimum(at, np.array(self.shape) - 1)
        return np.asarray(np.ravel_multi_index(tuple(np.moveaxis(at, -1, 0)), self.shape))

    def histogram(self, positions: ArrayLike) -> Array:
        """Histogram of agents (..., N, d) as a density (..., n)."""
        x = self.inside(array(positions, "positions", (..., "N", self.dim)))
        n = x.shape[-2]
        if n == 0:
            raise ValueError("positions: needs at least one agent, got none")
        cells = self.cells(x).reshape(-1, n)
        rows = [np.bincount(row, minlength=self.size) for row in cells]
        return np.asarray(np.reshape(rows, (*x.shape[:-2], self.size)) / (n * self.volume))

    def at(self, values: ArrayLike, positions: ArrayLike) -> Array:
        """Multilinear interpolation of cell values (n,) at positions (..., d); flat at walls."""
        v = array(values, "values", (self.size,)).reshape(self.shape)
        x = self.inside(positions)
        place = (x - self.corner) / self.spacing - 0.5
        top = np.array(self.shape) - 1
        first = np.clip(np.floor(place), 0, np.maximum(top - 1, 0)).astype(np.int64)
        share = np.clip(place - first, 0.0, 1.0)
        out = np.zeros(x.shape[:-1])
        for corner in np.ndindex(*(2,) * self.dim):
            step = np.array(corner)
            weight = np.where(step, share, 1 - share).prod(axis=-1)
            out += weight * v[tuple(np.moveaxis(first + step, -1, 0))]
        return out

    def aggregated(self, values: ArrayLike, coarse: Grid) -> Array:
        """Means over the cells of a coarser grid of the same box, (..., n) to (..., m)."""
        v = self.check(values)
        if not isinstance(coarse, Grid) or not self.same_box(coarse) or any(
            a % b for a, b in zip(self.shape, coarse.shape, strict=False)
        ):
            raise ValueError(
                f"coarse: needs a grid of the same box whose cells are whole numbers of cells of "
                f"{self.shape}, got {getattr(coarse, 'shape', coarse)!r}"
            )
        blocks: list[int] = []
        for a, b in zip(self.shape, coarse.shape, strict=True):
            blocks += [b, a // b]
        lead = v.shape[:-1]
        cut = v.reshape(*lead, *blocks)
        axes = tuple(len(lead) + 1 + 2 * k for k in range(self.dim))
        return np.asarray(cut.mean(axis=axes).reshape(*lead, coarse.size))

    def same_box(self, other: Any) -> bool:
        """Whether another grid, or a swarm, fills the same box."""
        if not hasattr(other, "low") or not hasattr(other, "high"):
            raise ValueError(f"other: needs a grid or a swarm, got {type(other).__name__}")
        low, high = np.asarray(other.low), np.asarray(other.high)
        return np.array_equal(low, self.corner) and np.array_equal(high, np.asarray(self.high))

    def wavenumbers(self, rank: int) -> NDArray[np.int64]:
        """The `rank` lowest cosine modes, (rank, d) half-waves along each axis, constant first.

        They are ordered by the frequency in the box, and ties by the number itself.
        """
        r = count(rank, "rank")
        if r > self.size:
            raise ValueError(f"rank: needs at most the number of cells {self.size}, got {r}")
        k = np.stack([a.ravel() for a in np.indices(self.shape)], axis=-1)
        squared = ((k / self.width) ** 2).sum(axis=-1)
        # Rounding splits ties, so that symmetric modes come in one order on every machine.
        order = np.lexsort((*k.T[::-1], squared.round(9)))
        return np.asarray(k[order[:r]], dtype=np.int64)

    def cosines(self, rank: int) -> Array:
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
        if count(rank, "rank") in self._kept:
            return self._kept[rank]
        k = self.wavenumbers(rank)
        x = (self.centres - self.corner) / self.width
        waves = np.cos(np.pi * x[:, None, :] * k).prod(axis=-1)
        out = np.asarray(waves / np.sqrt((waves**2).sum(axis=0) * self.volume))
        out.setflags(write=False)
        self._kept[rank] = out
        return out

    @cached_property
    def _kept(self) -> dict[int, Array]:
        """Bases that were asked for before; consensus asks in every step."""
        return {}
