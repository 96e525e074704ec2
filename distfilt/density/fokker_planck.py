"""The Fokker-Planck equation of a swarm, by finite volumes that conserve mass and positivity."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Annotated, Literal, NamedTuple

import numpy as np
import scipy

from ..models.base import trajectory
from ..models.swarm import Swarm
from ..validation import (
    Array,
    ArrayInput,
    FrozenModel,
    Indices,
    NonNegativeFloat,
    PositiveFloat,
    Times,
    validated,
)
from .grid import Grid

__all__ = ["FokkerPlanck", "bernoulli"]


@validated
def bernoulli(z: Annotated[ArrayInput, "..."]) -> Array:
    """The function z / (exp(z) - 1), 1 at 0: the weight of Scharfetter and Gummel's flux.

    Examples
    --------
    >>> bernoulli([-1.0, 0.0, 1.0]).round(6)
    array([1.581977, 1.      , 0.581977])
    """
    # Near zero by its Taylor series, whose next term, -z⁴/720, is below rounding for |z| < 1e-4.
    # Far from it z is clipped at 700, since exp(710) overflows.
    small = np.abs(z) < 1e-4
    series = 1 - z / 2 + z**2 / 12
    nonzero = np.where(small, 1.0, z)
    ratio = nonzero / np.expm1(np.clip(nonzero, -700.0, 700.0))
    return np.asarray(np.where(small, series, ratio))


class _Faces(NamedTuple):
    """Faces between the cells of a grid, in the order of their axes."""

    points: Array
    """Centres of the faces, (f, d)."""
    lower: Indices
    """Cells below each face along its axis."""
    upper: Indices
    """Cells above it."""
    axis: Indices
    """Axis that crosses it."""
    width: Array
    """Distance of the two cells' centres."""


@dataclass(frozen=True, eq=False)
class FokkerPlanck(FrozenModel):
    r"""Evolution of the density of a swarm's agents, by finite volumes with closed walls.

    The flux through the face between two cells is Scharfetter and Gummel's, exact where drift and
    diffusion are constant between their centres. With the Péclet number :math:`z=v\Delta/D`,

    .. math:: F = \bigl[B(-z)\,D_l\,p_l - B(z)\,D_r\,p_r\bigr]/\Delta,\qquad B(z)=z/(e^z-1).

    The generator A of :math:`\dot p=\mathbf A p` then has columns that sum to zero and no negative
    off-diagonal entry, at any Péclet number: steps of backward Euler conserve mass and positivity.
    A diffusion that varies in space is meant in the sense of Itô.

    Parameters
    ----------
    swarm : Swarm
        Drift, diffusion and box.
    grid : Grid
        A grid of the swarm's box.
    scheme : {"split", "backward_euler", "crank_nicolson"}
        The step in time. Backward Euler is of order one. `split` applies it to one axis after the
        other: it is of order one too, conserves mass and positivity as well, and costs a
        tridiagonal solve for each axis instead of a sparse factorisation. The Crank-Nicolson step
        is of order two and can give negative densities in long steps.

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
    >>> equation = FokkerPlanck(Swarm(lambda x, t: 0.1 - x, 0.01), Grid((20, 20)))
    >>> p = equation.step(np.ones(400), 0.0, 0.5)
    >>> bool(abs(equation.grid.integral(p) - 1) < 1e-13), bool(p.min() > 0)
    (True, True)
    """

    swarm: Swarm
    grid: Grid
    scheme: Literal["split", "backward_euler", "crank_nicolson"] = field(
        default="split", kw_only=True
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        # Corners of the two boxes
        same_low = np.array_equal(self.grid.low, self.swarm.low)
        same_high = np.array_equal(self.grid.high, self.swarm.high)
        if not (same_low and same_high):
            raise ValueError(
                "grid must cover the swarm's box, from "
                f"{self.swarm.low.tolist()} to {self.swarm.high.tolist()}, "
                f"got {np.asarray(self.grid.low).tolist()} to "
                f"{np.asarray(self.grid.high).tolist()}"
            )

    @cached_property
    def _faces(self) -> _Faces:
        """The faces between neighbouring cells, those across the first axis first."""
        grid = self.grid
        cells = np.arange(grid.size).reshape(grid.shape)
        # A face lies between a cell and the next along its axis: all cells but the last are below
        # one, all but the first above one.
        below = [np.delete(cells, -1, axis=k).ravel() for k in range(grid.dim)]
        above = [np.delete(cells, 0, axis=k).ravel() for k in range(grid.dim)]
        axis = np.repeat(np.arange(grid.dim), [len(cells) for cells in below])
        lower = np.concatenate(below)
        upper = np.concatenate(above)
        points = 0.5 * (grid.centres[lower] + grid.centres[upper])
        return _Faces(points, lower, upper, axis, grid.spacing[axis])

    def _rates(self, t: float) -> tuple[Array, Array]:
        """Rates at which mass crosses each face, forwards and backwards, in 1/s, (f,) each.

        They are the factors of p_l and p_r in Scharfetter and Gummel's flux F, divided by Δ.
        """
        faces = self._faces
        # Only the components across each face matter.
        across = np.arange(faces.axis.size), faces.axis
        drift = self.swarm.drift_at(faces.points, t)[across]
        diffusion = self.swarm.diffusion_at(faces.points, t)[across]
        # Péclet number z = v Δ/D at the face
        peclet = drift * faces.width / diffusion
        # Rates B(-z) D/Δ² forwards and B(z) D/Δ² backwards, with B(z) = z / (exp(z) - 1).
        # Since B(-z) = z + B(z), they are B(|z|) + max(z, 0) and B(|z|) + max(-z, 0), without
        # cancellation, and one exponential serves both directions.
        weight = bernoulli(np.abs(peclet))
        forwards = weight + np.maximum(peclet, 0.0)
        backwards = weight + np.maximum(-peclet, 0.0)
        # Itô: the diffusion that multiplies the density is that of the cell which mass leaves.
        cells = self.swarm.diffusion_at(self.grid.centres, t)
        lower_diffusion = cells[faces.lower, faces.axis]
        upper_diffusion = cells[faces.upper, faces.axis]
        square = faces.width**2
        return forwards * lower_diffusion / square, backwards * upper_diffusion / square

    def _assemble(
        self, t: float, *, scale: float, identity: float
    ) -> scipy.sparse.csc_array:
        """Assemble the matrix identity I + scale A(t)."""
        forwards, backwards = self._rates(t)
        faces = self._faces
        n = self.grid.size
        # Columns of A sum to zero: a cell loses as much as its neighbours gain.
        loss = np.bincount(faces.lower, forwards, n)
        loss = loss + np.bincount(faces.upper, backwards, n)
        diagonal = identity - scale * loss
        # Mass that leaves a cell through a face enters the cell beyond it.
        data = np.concatenate([diagonal, scale * forwards, scale * backwards])
        rows = np.concatenate([np.arange(n), faces.upper, faces.lower])
        columns = np.concatenate([np.arange(n), faces.lower, faces.upper])
        return scipy.sparse.csc_array((data, (rows, columns)), (n, n))

    @validated
    def generator(self, t: float) -> scipy.sparse.csc_array:
        """The matrix A(t) of dp/dt = A p, (n, n), sparse."""
        return self._assemble(t, scale=1.0, identity=0.0)

    @validated
    def step(
        self,
        values: Annotated[ArrayInput, "... self.grid.size"],
        t: float,
        dt: PositiveFloat,
    ) -> Array:
        """Move densities (..., n), or any cell values, from `t` to `t` + `dt`."""
        return self.solver(t, dt)(values)

    @validated
    def solver(self, t: float, dt: NonNegativeFloat) -> Callable[[Array], Array]:
        """The step from `t` to `t` + `dt` as a function: one factorisation for any densities."""
        if self.scheme == "split":
            return self._split_solver(t, dt)
        return self._sparse_solver(t, dt)

    def _sparse_solver(self, t: float, dt: float) -> Callable[[Array], Array]:
        """Solve (I - θ Δ A(t + Δ)) p' = (I + (1 - θ) Δ A(t)) p by a sparse factorisation."""
        from scipy.sparse.linalg import splu

        # θ = 1 for backward Euler, θ = ½ for Crank-Nicolson
        implicit = dt if self.scheme == "backward_euler" else 0.5 * dt
        right = self._assemble(t, scale=dt - implicit, identity=1.0)
        matrix = self._assemble(t + dt, scale=-implicit, identity=1.0)
        # The pattern is symmetric and columns are diagonally dominant: no pivoting is needed.
        factors = splu(
            matrix,
            permc_spec="MMD_AT_PLUS_A",
            diag_pivot_thresh=0.0,
            options={"SymmetricMode": True},
        )

        def step(p: Array) -> Array:
            # SuperLU solves for all columns at once, stored column by column; each is one density.
            columns = right @ p.reshape(-1, self.grid.size).T
            solution = factors.solve(np.asfortranarray(columns))
            return np.ascontiguousarray(solution.T).reshape(p.shape)

        return step

    def _split_solver(self, t: float, dt: float) -> Callable[[Array], Array]:
        """Return a step of backward Euler along one axis after the other.

        All lines of cells along an axis are solved at once. The tridiagonal elimination has no
        subtraction, so that no rounding makes a density negative. The step takes densities (..., n)
        from t to t + dt.
        """
        grid = self.grid
        # Backward Euler uses the rates at the end of the step.
        forwards, backwards = self._rates(t + dt)
        factors = []
        for k in range(grid.dim):
            # Of all lines of cells along axis k, which comes first
            up = dt * self._rates_across(forwards, k)
            down = dt * self._rates_across(backwards, k)
            factors.append(_factorize_tridiagonal(up, down))

        def step(p: Array) -> Array:
            # The axes of the grid first, densities (k of them) last: each operation then runs over
            # contiguous memory. `x` is overwritten by the solution.
            columns = np.array(p.reshape(-1, grid.size).T, order="C")
            x = columns.reshape(*grid.shape, -1)
            for k, axis_factors in enumerate(factors):
                _solve_tridiagonal(np.moveaxis(x, k, 0), axis_factors)
            return np.ascontiguousarray(x.reshape(grid.size, -1).T).reshape(p.shape)

        return step

    def _rates_across(self, rates: Array, k: int) -> Array:
        """Rates at the faces across axis k, with that axis first, (n_k - 1, ...)."""
        # Along its axis a grid has one face fewer than cells.
        shape = list(self.grid.shape)
        shape[k] -= 1
        return np.moveaxis(rates[self._faces.axis == k].reshape(shape), k, 0)

    @validated
    def evolve(
        self, values: Annotated[ArrayInput, "... self.grid.size"], times: Times
    ) -> Array:
        """Densities at `times`, (T, ..., n), from `values` at time 0, by one step to each time.

        Parameters
        ----------
        values : array_like, (..., n)
        times : array_like, (T,)
            Strictly increasing from 0, in s.
        """
        # One step to each time, of any length.
        return trajectory(self.step, values, times, t0=0.0)


class _TridiagonalFactors(NamedTuple):
    """Factors of tridiagonal matrices with the pivots p_i of Gauss's elimination.

    With the rates f_i forwards and b_i backwards of :func:`_factorize_tridiagonal` they are
    f_i / p_i and b_i / p_i, (n - 1, ..., 1), and 1 / p_i, (n, ..., 1).
    """

    lower: Array
    upper: Array
    reciprocals: Array


def _factorize_tridiagonal(forwards: Array, backwards: Array) -> _TridiagonalFactors:
    """Factor the tridiagonal matrices I - Δ A of all lines of cells along the first axis.

    Column i of a matrix is (-backwards[i-1], 1 + both rates out of cell i, -forwards[i]).

    Parameters
    ----------
    forwards, backwards : ndarray, (n - 1, ...)
        Rates times the step Δ at the faces between n cells: f_i from cell i to i + 1, and b_i back.
    """
    pivots = np.ones((len(forwards) + 1, *forwards.shape[1:]))
    # The pivot without the rate forwards: d_0 = 1, d_{i+1} = 1 + b_i d_i/(d_i + f_i).
    partial = np.ones(forwards.shape[1:])
    for i, (forward, backward) in enumerate(zip(forwards, backwards, strict=True)):
        pivots[i] = partial + forward
        partial = 1 + backward * (partial / pivots[i])
    pivots[-1] = partial
    reciprocals = 1 / pivots
    lower = forwards * reciprocals[:-1]
    upper = backwards * reciprocals[:-1]
    # A last axis broadcasts over the densities.
    return _TridiagonalFactors(
        lower[..., None], upper[..., None], reciprocals[..., None]
    )


def _solve_tridiagonal(x: Array, factors: _TridiagonalFactors) -> None:
    """Solve for densities x (n, ..., k) in place along the first axis, by substitution.

    The factors are f_i / p_i, b_i / p_i and 1 / p_i, with the rates f_i and b_i between cells and
    the pivots p_i.
    """
    lower, upper, reciprocals = factors
    # Forward: y_{i+1} = x_{i+1} + (f_i / p_i) y_i.
    for i in range(len(lower)):
        x[i + 1] += lower[i] * x[i]
    # Backward: x_i = y_i / p_i + (b_i / p_i) x_{i+1}; the last cell has no neighbour above.
    x[-1] *= reciprocals[-1]
    for i in range(len(upper) - 1, -1, -1):
        x[i] *= reciprocals[i]
        x[i] += upper[i] * x[i + 1]
