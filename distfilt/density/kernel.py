"""Kernel estimates of a density on a grid: Gaussian kernels between reflecting walls."""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np

from ..validation import (
    Array,
    ArrayInput,
    Bounds,
    PositiveFloat,
    PositiveInt,
    validated,
)
from .grid import Grid

__all__ = [
    "bandwidth",
    "kernel_covariance",
    "kernel_density",
    "kernel_constant",
    "kernels",
]

Widths = PositiveFloat | Annotated[ArrayInput, "n", Bounds(above=0)]


def _axis_kernels(x: Array, grid: Grid, k: int, width: Array) -> Array:
    """Means of reflected kernels at x (...) over the cells of axis k, (..., n_k)."""
    edges = grid.edges[k]
    low = edges[0]
    span = edges[-1] - low
    scale = np.sqrt(2.0) * width[..., None]
    mass = _cell_masses(x, edges, scale)
    # Reflection at both walls adds images, at x + 2 m span and 2 low - x + 2 (m + 1) span.
    # Those more than nine widths outside the box contribute nothing.
    reach = 9 * float(np.max(width, initial=0.0)) / span
    orders = int(reach / 2 + 1)
    for m in range(-orders, orders + 1):
        if m != 0 and 2 * abs(m) - 1 < reach:
            mass = mass + _cell_masses(x + 2 * m * span, edges, scale)
        if max(2 * m, -2 * m - 2) < reach:
            mirrored = 2 * low - x + 2 * (m + 1) * span
            mass = mass + _cell_masses(mirrored, edges, scale)
    return np.asarray(mass / grid.spacing[k])


def _cell_masses(x: Array, edges: Array, scale: Array) -> Array:
    """Integrals of a Gaussian at x over the intervals between the edges."""
    from scipy.special import erf

    return np.asarray(0.5 * np.diff(erf((edges - x[..., None]) / scale), axis=-1))


def check_resolution(grid: Grid, bandwidth: float | Array) -> None:
    """Refuse bandwidths below half a cell, or far wider than the box."""
    if np.max(bandwidth) > 20 * grid.width.max():
        raise ValueError(
            f"bandwidth must be at most 20 widths of the box, got {bandwidth}"
        )
    least = float(np.min(bandwidth))
    widest = float(grid.spacing.max())
    # A tolerance of rounding, for grids that are made to fit exactly.
    if widest > 2 * least * (1 + 1e-12):
        raise ValueError(
            f"grid must have cells no wider than two bandwidths, {2 * least:g}, "
            f"got {widest:g}"
        )


def _factors(positions: Array, grid: Grid, bandwidth: float | Array) -> list[Array]:
    """Factors (..., N, n_k) of each agent's kernel, one for each axis."""
    check_resolution(grid, bandwidth)
    grid._check_inside(positions)
    # One bandwidth for all agents, or one for each.
    h = np.broadcast_to(bandwidth, positions.shape[:-1])
    return [_axis_kernels(positions[..., k], grid, k, h) for k in range(grid.dim)]


def _outer_products(product: Array, factors: list[Array]) -> Array:
    """Outer product of each agent's first factor with the others, flattened, (..., N, n)."""
    for factor in factors:
        product = product[..., :, None] * factor[..., None, :]
        product = product.reshape(*product.shape[:-2], -1)
    return product


@validated
def kernels(
    positions: Annotated[ArrayInput, "... n grid.dim"], grid: Grid, *, bandwidth: Widths
) -> Array:
    """Kernel of each agent, the z_i of equation (13) of Zheng and Lin.

    The mass beyond a wall is reflected into the box, so that each has mass 1 to rounding.

    Parameters
    ----------
    positions : array_like, (..., N, d)
        Agents inside the box.
    grid : Grid
        The kernels are given as means over its cells.
    bandwidth : float or array_like, (N,)
        Standard deviation of the Gaussian, in the positions' unit, at least half a cell.

    Returns
    -------
    ndarray, (..., N, n)

    Raises
    ------
    ValueError
        If an agent is outside or NaN, the bandwidth is not positive, or the cells are wider than
        two bandwidths.

    Examples
    --------
    >>> grid = Grid((20, 20))
    >>> z = kernels([[0.02, 0.5], [0.5, 0.5]], grid, bandwidth=0.08)
    >>> z.shape, bool(abs(grid.integral(z) - 1).max() < 1e-12)
    ((2, 400), True)
    """
    factors = _factors(positions, grid, bandwidth)
    return _outer_products(factors[0], factors[1:])


@validated
def kernel_density(
    positions: Annotated[ArrayInput, "... n grid.dim"], grid: Grid, *, bandwidth: Widths
) -> Array:
    """The kernel estimate of agents' density, equation (4) of Zheng and Lin.

    It is the mean of :func:`kernels` over the agents, whose parameters these are, without the
    N kernels in memory.

    Returns
    -------
    ndarray, (..., n)

    Examples
    --------
    >>> grid = Grid((20, 20))
    >>> p = kernel_density(np.full((1, 2), 0.5), grid, bandwidth=0.1)
    >>> round(float(p.max() * 2 * np.pi * 0.1**2), 2)
    0.92
    """
    factors = _factors(positions, grid, bandwidth)
    first = factors[0]
    ones = np.ones((*first.shape[:-1], 1))
    # The sum over agents is the product of two matrices, (n_1, N) and (N, n / n_1).
    total = first.mT @ _outer_products(ones, factors[1:])
    agents = positions.shape[-2]
    return np.asarray(total.reshape(*positions.shape[:-2], grid.size) / agents)


@validated
def kernel_constant(
    grid: Grid, *, bandwidth: PositiveFloat, agents: PositiveInt
) -> float:
    r"""The constant k̄ of Zheng and Lin: ∫K²/(N hᵈ), for which Var p_KDE ≈ k̄ p.

    For a Gaussian, :math:`\bar k = 1/\bigl(N(2\sqrt\pi h)^d\bigr)`. It gives the variance of each
    cell. The noise is not white, since neighbouring cells depend on the same agents: see
    :func:`kernel_covariance`.

    Examples
    --------
    >>> round(kernel_constant(Grid((30, 30)), bandwidth=0.08, agents=100), 4)
    0.1243
    """
    return float(1 / (agents * (2 * np.sqrt(np.pi) * bandwidth) ** grid.dim))


@validated
def kernel_covariance(
    density: Annotated[ArrayInput, "grid.size", Bounds(at_least=0)],
    grid: Grid,
    *,
    bandwidth: PositiveFloat,
    agents: PositiveInt,
) -> tuple[Array, Array]:
    r"""Mean and covariance of the kernel estimate of N independent agents, without approximation.

    .. math::
        \mathrm E\,\hat p = \mathbf G\mathbf p,\qquad
        \mathrm{Cov}\,\hat p=\tfrac1N\bigl(\mathbf G\,\mathrm{diag}(\mathbf p)\mathbf G^\top\Delta
        -\mathbf G\mathbf p(\mathbf G\mathbf p)^\top\bigr)

    with the kernel of each cell's centre, :math:`\mathbf G/\Delta`, and cells of volume Δ.

    Parameters
    ----------
    density : array_like, (n,)
        The agents' true density, of integral 1; agents are at the centres of cells.
    grid : Grid
    bandwidth : float
    agents : int
        Number N of agents.

    Returns
    -------
    mean : ndarray, (n,)
    covariance : ndarray, (n, n)

    Examples
    --------
    >>> grid = Grid((20, 20))
    >>> mean, cov = kernel_covariance(np.ones(400), grid, bandwidth=0.08, agents=100)
    >>> middle = 10 * 20 + 10
    >>> print(round(cov[middle, middle] / (1 / (400 * np.pi * 0.08**2)), 2))
    0.89
    """
    integral = float(density.sum() * grid.volume)
    if abs(integral - 1) > 1e-8:
        raise ValueError(f"density must have the integral 1, got {integral:g}")
    # Column j is the kernel of an agent in cell j, as masses of the cells.
    g = kernels(grid.centres, grid, bandwidth=bandwidth).T * grid.volume
    # E p̂ = G p
    mean = g @ density
    # Second moment of one agent's kernel; the covariance of the mean of N falls as 1/N.
    moment = (g * density) @ g.T / grid.volume
    return mean, (moment - np.outer(mean, mean)) / agents


@validated
def bandwidth(
    positions: Annotated[ArrayInput, "n grid.dim"],
    grid: Grid,
    *,
    rule: Literal["silverman", "least_squares"] = "silverman",
) -> float:
    r"""Choose a bandwidth from the agents' positions.

    Parameters
    ----------
    positions : array_like, (N, d)
        At least two agents that are not all in one place.
    grid : Grid
    rule : {"silverman", "least_squares"}
        Silverman's, :math:`\sigma\,(4/((d+2)N))^{1/(d+4)}` with the mean variance over axes, best
        for one Gaussian; or the minimum of the unbiased estimate of the integrated squared error,
        :math:`\int\hat p^2-\tfrac2N\sum_i\hat p_{-i}(\mathbf X_i)`, over twenty candidates.

    Returns
    -------
    float
        At least half a cell.

    Examples
    --------
    >>> x = np.random.default_rng(1).random((100, 2))
    >>> round(bandwidth(x, Grid((30, 30))), 3)
    0.129
    """
    grid._check_inside(positions)
    n, d = positions.shape
    spread = float(np.sqrt(positions.var(axis=0).mean()))
    if n < 2 or spread == 0:
        raise ValueError(
            f"positions must have two agents or more in different places, got {n} "
            f"with a spread of {spread:g}"
        )
    # No bandwidth may be below half a cell.
    least = 0.5 * float(grid.spacing.max())
    silverman = spread * (4 / ((d + 2) * n)) ** (1 / (d + 4))
    if rule == "silverman":
        return float(max(silverman, least))
    # From far below Silverman's bandwidth, for clusters, to above it.
    candidates = np.maximum(silverman * np.geomspace(0.15, 1.5, 20), least)
    scores = [_cross_validation_score(positions, grid, h) for h in candidates]
    return float(candidates[int(np.argmin(scores))])


def _cross_validation_score(x: Array, grid: Grid, h: float) -> float:
    """∫p̂² - (2/N) Σ p̂₋ᵢ(Xᵢ), with the leave-one-out estimates p̂₋ᵢ."""
    n = len(x)
    z = kernels(x, grid, bandwidth=h)
    mean = z.mean(axis=0)
    # Entry (i, j) is the kernel of agent i in the cell of agent j; the diagonal is left out.
    pairs = z[:, grid.cell_index(x)]
    leave_one_out = (pairs.sum() - np.trace(pairs)) / (n * (n - 1))
    return float((mean**2).sum() * grid.volume - 2 * leave_one_out)
