"""The Fokker-Planck equation of a swarm by finite volumes that keep mass and sign."""

from __future__ import annotations

from collections import namedtuple
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Annotated, Literal

import numpy as np
import scipy

from ..models.base import trajectory
from ..models.swarm import Swarm
from ..validation import (
    Array,
    FrozenModel,
    NonNegativeFloat,
    PositiveFloat,
    Times,
    validated,
)
from .grid import Grid

__all__ = ["FokkerPlanck", "bernoulli"]


@validated
def bernoulli(z: Annotated[Array, "..."]) -> Array:
    """The function z / (exp(z) - 1), 1 at 0: the weight of Scharfetter and Gummel's flux.

    Examples
    --------
    >>> bernoulli([-1.0, 0.0, 1.0]).round(6)
    array([1.581977, 1.      , 0.581977])
    """
    small = np.abs(z) < 1e-4
    safe = np.where(small, 1.0, z)
    return np.where(
        small, 1 - z / 2 + z**2 / 12, safe / np.expm1(np.clip(safe, -700.0, 700.0))
    )


_Faces = namedtuple("_Faces", "points left right axis width")
"""Inner faces of a grid: where they are, which cells they part, and along which axis."""


@dataclass(frozen=True, eq=False)
class FokkerPlanck(FrozenModel):
    r"""The density of a swarm's agents, as finite volumes with walls that nothing passes.

    Through the face between two cells goes Scharfetter and Gummel's flux, exact where drift and
    diffusion are constant between their centres. With the Péclet number :math:`z=v\Delta/D`,

    .. math:: F = \bigl[B(-z)\,D_l\,p_l - B(z)\,D_r\,p_r\bigr]/\Delta,\qquad B(z)=z/(e^z-1).

    The generator A of :math:`\dot p=\mathbf A p` then has columns that sum to zero and no negative
    entry beside its diagonal, at any Péclet number: mass stays and no density becomes negative in
    steps of backward Euler. A diffusion that varies in space is meant in the sense of Itô.

    Parameters
    ----------
    swarm : Swarm
        Drift, diffusion and box.
    grid : Grid
        Of the same box.
    scheme : {"split", "backward_euler", "crank_nicolson"}
        The step in time. Backward Euler is of order one; `split` does it for one axis after the
        other, which is of order one too, keeps mass and sign as well, and costs a tridiagonal
        solve for each axis instead of a sparse factorisation. Crank and Nicolson's step is of
        order two and does not keep signs in long steps.

    Raises
    ------
    ValueError
        If the boxes differ.

    Notes
    -----
    D. L. Scharfetter and H. K. Gummel, IEEE Transactions on Electron Devices 16 (1969) 64-77;
    equations (2) and (3) of Zheng and Lin.

    Examples
    --------
    >>> flow = FokkerPlanck(Swarm(lambda x, t: 0.1 - x, 0.01), Grid((20, 20)))
    >>> p = flow.step(np.ones(400), 0.0, 0.5)
    >>> bool(abs(flow.grid.integral(p) - 1) < 1e-13), bool(p.min() > 0)
    (True, True)
    """

    swarm: Swarm
    grid: Grid
    scheme: Literal["split", "backward_euler", "crank_nicolson"] = field(
        default="split", kw_only=True
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        boxes = [np.array([part.low, part.high]) for part in (self.grid, self.swarm)]
        if not np.array_equal(boxes[0], boxes[1]):
            raise ValueError(
                "grid must be a grid of the swarm's box, got "
                f"{self.grid.shape!r} of another"
            )

    @cached_property
    def _faces(self) -> _Faces:
        grid = self.grid
        cells = np.arange(grid.size).reshape(grid.shape)
        left = [np.delete(cells, -1, axis=k).ravel() for k in range(grid.dim)]
        right = [np.delete(cells, 0, axis=k).ravel() for k in range(grid.dim)]
        axis = np.repeat(np.arange(grid.dim), [len(cells) for cells in left])
        a = np.concatenate(left)
        b = np.concatenate(right)
        return _Faces(
            0.5 * (grid.centres[a] + grid.centres[b]), a, b, axis, grid.spacing[axis]
        )

    def _rates(self, t: float) -> tuple[Array, Array]:
        """Rates at which mass crosses each face, forwards and backwards, in 1/s."""
        f = self._faces
        pick = np.arange(f.axis.size), f.axis
        drift = self.swarm.drift_at(f.points, t)[pick]
        between = self.swarm.diffusion_at(f.points, t)[pick]
        cells = self.swarm.diffusion_at(self.grid.centres, t)
        at_left = cells[f.left, f.axis]
        at_right = cells[f.right, f.axis]
        peclet = drift * f.width / between
        # B(-z) = z + B(z): one exponential serves both directions, without cancellation.
        small = bernoulli(np.abs(peclet))
        forwards = small + np.maximum(peclet, 0.0)
        backwards = small + np.maximum(-peclet, 0.0)
        return forwards * at_left / f.width**2, backwards * at_right / f.width**2

    def _assembled(
        self, t: float, scale: float, identity: float
    ) -> scipy.sparse.csc_array:
        """identity I + scale A(t)."""
        forwards, backwards = self._rates(t)
        n = self.grid.size
        f = self._faces
        leaving = np.bincount(f.left, forwards, n) + np.bincount(f.right, backwards, n)
        data = np.concatenate(
            [identity - scale * leaving, scale * forwards, scale * backwards]
        )
        rows = np.concatenate([np.arange(n), f.right, f.left])
        columns = np.concatenate([np.arange(n), f.left, f.right])
        return scipy.sparse.csc_array((data, (rows, columns)), (n, n))

    @validated
    def generator(self, t: float) -> scipy.sparse.csc_array:
        """The matrix A(t) of dp/dt = A p, (n, n), sparse."""
        return self._assembled(t, 1.0, 0.0)

    @validated
    def step(
        self,
        values: Annotated[Array, "... self.grid.size"],
        t: float,
        dt: PositiveFloat,
    ) -> Array:
        """Densities (..., n), or any cell values, moved from `t` to `t` + `dt`."""
        return self.solver(t, dt)(values)

    @validated
    def solver(self, t: float, dt: NonNegativeFloat) -> Callable[[Array], Array]:
        """The step from `t` to `t` + `dt` as a function: one factorisation for any number."""
        if self.scheme == "split":
            return self._split(t, dt)
        from scipy.sparse.linalg import splu

        share = dt if self.scheme == "backward_euler" else 0.5 * dt
        explicit = self._assembled(t, dt - share, 1.0)
        matrix = self._assembled(t + dt, -share, 1.0)
        # The pattern is symmetric and the columns are dominated by their diagonal: no pivoting.
        factors = splu(
            matrix,
            permc_spec="MMD_AT_PLUS_A",
            diag_pivot_thresh=0.0,
            options={"SymmetricMode": True},
        )

        def move(p: Array) -> Array:
            columns = explicit @ p.reshape(-1, self.grid.size).T
            moved = factors.solve(np.asfortranarray(columns))
            return np.ascontiguousarray(moved.T).reshape(p.shape)

        return move

    def _split(self, t: float, dt: float) -> Callable[[Array], Array]:
        """Backward Euler along one axis after the other, all lines of an axis at once.

        The tridiagonal elimination has no subtraction, so it keeps signs to the last bit.
        """
        grid = self.grid
        rates = self._rates(t + dt)
        factors = [
            self._eliminated(*(dt * self._across(r, k) for r in rates))
            for k in range(grid.dim)
        ]

        def move(p: Array) -> Array:
            x = np.array(p.reshape(-1, grid.size).T, order="C").reshape(*grid.shape, -1)
            for k, (down, up, pivot) in enumerate(factors):
                lines = np.moveaxis(x, k, 0)
                for i in range(len(down)):
                    lines[i + 1] += down[i] * lines[i]
                lines[-1] *= pivot[-1]
                for i in range(len(up) - 1, -1, -1):
                    lines[i] *= pivot[i]
                    lines[i] += up[i] * lines[i + 1]
            return np.ascontiguousarray(x.reshape(grid.size, -1).T).reshape(p.shape)

        return move

    @staticmethod
    def _eliminated(forwards: Array, backwards: Array) -> tuple[Array, Array, Array]:
        """Factors of I - Δ A along one axis, the first here: down, up and one over the pivot."""
        pivot = np.ones((len(forwards) + 1, *forwards.shape[1:]))
        stays = np.ones(forwards.shape[1:])
        for i, (there, back) in enumerate(zip(forwards, backwards, strict=True)):
            pivot[i] = stays + there
            stays = 1 + back * (stays / pivot[i])
        pivot[-1] = stays
        pivot = 1 / pivot
        down = forwards * pivot[:-1]
        up = backwards * pivot[:-1]
        return down[..., None], up[..., None], pivot[..., None]

    def _across(self, rate: Array, k: int) -> Array:
        """Rates at the faces across axis k, with that axis first, (n_k - 1, ...)."""
        shape = list(self.grid.shape)
        shape[k] -= 1
        return np.moveaxis(rate[self._faces.axis == k].reshape(shape), k, 0)

    @validated
    def evolve(
        self, values: Annotated[Array, "... self.grid.size"], times: Times
    ) -> Array:
        """Densities at `times`, (T, ..., n), of one that is `values` at time 0, a step to each.

        Parameters
        ----------
        values : array_like, (..., n)
        times : array_like, (T,)
            Strictly increasing from 0, in s.
        """
        return trajectory(self.step, values, times, 0.0)
