"""Kernel estimates of a density on a grid: Gaussian kernels between reflecting walls.

A width is a number, or has a row for each agent and a column for each axis: (N,) for each agent,
(1, d) for each axis, (N, d) for both.
"""

from __future__ import annotations

import warnings
from typing import Annotated, Literal

import numpy as np

from ..validation import (
    Array,
    ArrayInput,
    Bounds,
    Indices,
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

AxisWidths = PositiveFloat | Annotated[ArrayInput, "1 grid.dim", Bounds(above=0)]
"""One width for all axes, or one for each."""
Widths = (
    PositiveFloat
    | Annotated[ArrayInput, "n", Bounds(above=0)]
    | Annotated[ArrayInput, "1 grid.dim", Bounds(above=0)]
    | Annotated[ArrayInput, "n grid.dim", Bounds(above=0)]
)
"""One width for all agents and axes, or one for each agent, each axis or both."""

_NO_DISTANCE = 1e-9
"""Positions that agree to this part of the box's width are the same place."""


_REACH = 9
"""Beyond so many standard deviations a Gaussian has a mass of 2e-19, less than rounding."""


def _axis_kernels(x: Array, grid: Grid, k: int, width: Array) -> Array:
    """Means of reflected kernels over the cells of axis k, (..., n_k).

    The kernels are at coordinates x (...) along this axis, with standard deviations `width` (...).
    Walls at both ends of the axis reflect them.
    """
    edges = grid.edges[k]
    low = edges[0]
    span = edges[-1] - low
    # The normal distribution function of u is (1 + erf(u / (√2 σ))) / 2.
    # The kernels' masses in the cells, (..., n_k), first without a reflection.
    scale = np.sqrt(2.0) * width[..., None]
    mass = _cell_masses(x, edges, scale)
    # Reflection at both walls adds images, at x + 2 m span and 2 low - x + 2 (m + 1) span. Measured
    # in spans, the first kind lies at least 2 |m| - 1 outside the box, and the second kind
    # 2 m above it for m >= 0, or -2 m - 2 below it. Images beyond the reach are left out.
    reach = _REACH * float(np.max(width, initial=0.0)) / span
    orders = int(reach / 2 + 1)
    for m in range(-orders, orders + 1):
        if m != 0 and 2 * abs(m) - 1 < reach:
            mass = mass + _cell_masses(x + 2 * m * span, edges, scale)
        if max(2 * m, -2 * m - 2) < reach:
            mirrored = 2 * low - x + 2 * (m + 1) * span
            mass = mass + _cell_masses(mirrored, edges, scale)
    return np.asarray(mass / grid.spacing[k])


def _cell_masses(x: Array, edges: Array, scale: Array) -> Array:
    """Integrals of Gaussians at x (...) over the intervals between edges (n + 1,), as (..., n).

    `scale` (..., 1) is √2 times the standard deviation.
    """
    from scipy.special import erf

    return np.asarray(0.5 * np.diff(erf((edges - x[..., None]) / scale), axis=-1))


_WIDEST = 20
"""A kernel wider than so many boxes is flat, and its width probably in another unit."""


def check_resolution(grid: Grid, bandwidth: float | Array) -> None:
    """Refuse bandwidths below half a cell, or far wider than the box; warn of a flat axis.

    A narrower kernel would fall into one cell, whatever its width: the cells cannot show it.

    Parameters
    ----------
    grid : Grid
    bandwidth : float or ndarray, (N,), (1, d) or (N, d)
        As in :func:`kernels`.
    """
    if np.ndim(bandwidth) == 2:
        _check_axis_widths(grid, np.asarray(bandwidth))
        return
    if np.max(bandwidth) > _WIDEST * grid.width.max():
        raise ValueError(
            f"bandwidth must be at most {_WIDEST} widths of the box, got {bandwidth}"
        )
    least = float(np.min(bandwidth))
    widest = float(grid.spacing.max())
    # A tolerance of rounding, for grids that are made to fit exactly.
    if widest > 2 * least * (1 + 1e-12):
        raise ValueError(
            f"grid must have cells no wider than two bandwidths, {2 * least:g}, "
            f"got {widest:g}"
        )
    # A width that covers one axis and not another is in the unit of the other.
    if grid.width.min() < least < grid.width.max():
        warnings.warn(
            f"bandwidth must fit every axis of the box, got {least:g} for widths of "
            f"{grid.width.min():g} to {grid.width.max():g}: the density will be flat along "
            "the short one; give a width for each axis, (1, d)",
            RuntimeWarning,
            stacklevel=5,
        )


def _check_axis_widths(grid: Grid, bandwidth: Array) -> None:
    """Do as `check_resolution` with bandwidths (1, d) or (N, d), along every axis by itself.

    The bandwidths have a column for each axis of the grid.
    """
    if (bandwidth > _WIDEST * grid.width).any():
        raise ValueError(
            f"bandwidth must be at most {_WIDEST} widths of the box along every axis, got "
            f"{bandwidth.max(axis=0).tolist()}"
        )
    least = bandwidth.min(axis=0)
    # With a tolerance of rounding, for grids that are made to fit exactly
    if (grid.spacing > 2 * least * (1 + 1e-12)).any():
        raise ValueError(
            "grid must have cells no wider than two bandwidths along every axis, "
            f"{(2 * least).tolist()}, got {grid.spacing.tolist()}"
        )


def _axis_factors(
    positions: Array, grid: Grid, bandwidth: float | Array
) -> list[Array]:
    """Factors (..., N, n_k) of each agent's kernel, one array for each axis k.

    A Gaussian with independent components is the product of its factors along the axes. Positions
    are (..., N, d), and factors are means over the cells along an axis of the grid.
    """
    check_resolution(grid, bandwidth)
    grid._check_inside(positions)
    # A width for each agent and axis, (..., N, d)
    if np.ndim(bandwidth) == 2:
        widths = np.broadcast_to(bandwidth, positions.shape)
    else:
        # One bandwidth for all agents, or one for each, along every axis.
        h = np.broadcast_to(bandwidth, positions.shape[:-1])
        widths = np.broadcast_to(h[..., None], positions.shape)
    return [
        _axis_kernels(positions[..., k], grid, k, widths[..., k])
        for k in range(grid.dim)
    ]


def _outer_products(product: Array, factors: list[Array]) -> Array:
    """Multiply each agent's factor (..., N, n_1) by those of the other axes, as (..., N, n).

    n is the number of cells of these axes together, the last axis fastest.
    """
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
    bandwidth : float or array_like, (N,), (1, d) or (N, d)
        Standard deviation of the Gaussian, in the positions' unit, at least half a cell: one for
        all, or one for each agent, each axis, or both. Axes of different units need one each.

    Returns
    -------
    ndarray, (..., N, n)

    Raises
    ------
    ValueError
        If an agent is outside or NaN, the bandwidth is not positive, or the cells are wider than
        two bandwidths.

    Warns
    -----
    RuntimeWarning
        If one bandwidth for all axes is wider than the box along one of them and not along
        another.

    Examples
    --------
    >>> grid = Grid((20, 20))
    >>> z = kernels([[0.02, 0.5], [0.5, 0.5]], grid, bandwidth=0.08)
    >>> z.shape, bool(abs(grid.integral(z) - 1).max() < 1e-12)
    ((2, 400), True)

    A position in metres beside a heading in rad:

    >>> grid = Grid((20, 20), high=[1000.0, 1.0])
    >>> z = kernels([[500.0, 0.5]], grid, bandwidth=[[80.0, 0.08]])
    >>> bool(
    ...     np.allclose(z * 1000, kernels([[0.5, 0.5]], Grid((20, 20)), bandwidth=0.08))
    ... )
    True
    """
    factors = _axis_factors(positions, grid, bandwidth)
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
    factors = _axis_factors(positions, grid, bandwidth)
    first = factors[0]
    ones = np.ones((*first.shape[:-1], 1))
    # The sum over agents is the product of two matrices, (n_1, N) and (N, n / n_1).
    total = first.mT @ _outer_products(ones, factors[1:])
    agents = positions.shape[-2]
    return np.asarray(total.reshape(*positions.shape[:-2], grid.size) / agents)


@validated
def kernel_constant(grid: Grid, *, bandwidth: AxisWidths, agents: PositiveInt) -> float:
    r"""The constant k̄ of Zheng and Lin: ∫K²/(N hᵈ), for which Var p_KDE ≈ k̄ p.

    For a Gaussian, :math:`\bar k = 1/\bigl(N(2\sqrt\pi h)^d\bigr)`, with the product of the
    bandwidths if there is one for each axis, (1, d). It gives the variance of each
    cell. The noise is not white, since neighbouring cells depend on the same agents: see
    :func:`kernel_covariance`.

    Examples
    --------
    >>> round(kernel_constant(Grid((30, 30)), bandwidth=0.08, agents=100), 4)
    0.1243
    """
    if np.ndim(bandwidth):
        volume = np.prod(2 * np.sqrt(np.pi) * np.asarray(bandwidth))
    else:
        volume = (2 * np.sqrt(np.pi) * bandwidth) ** grid.dim
    return float(1 / (agents * volume))


@validated
def kernel_covariance(
    density: Annotated[ArrayInput, "grid.size", Bounds(at_least=0)],
    grid: Grid,
    *,
    bandwidth: AxisWidths,
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
    bandwidth : float or array_like, (1, d)
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
    # More than rounding of a sum over the cells.
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
    each_axis: bool | None = None,
) -> float | Array:
    r"""Choose a bandwidth from the agents' positions.

    Parameters
    ----------
    positions : array_like, (N, d)
        At least two agents that are not all in one place.
    grid : Grid
    rule : {"silverman", "least_squares"}
        Silverman's, :math:`\sigma\,(4/((d+2)N))^{1/(d+4)}` with the mean variance over axes, best
        for one Gaussian; or the minimum of the unbiased estimate of the integrated squared error,
        :math:`\int\hat p^2-\tfrac2N\sum_i\hat p_{-i}(\mathbf X_i)`, over twenty candidates. Agents
        in one place would explain each other by the narrowest kernel. So rounded positions are
        spread over the interval that was rounded, and agents that are in one place for another
        reason are left out together.
    each_axis : bool, optional
        Whether every axis has a bandwidth of its own, in proportion to its standard deviation. By
        default that is so unless the box has equal sides: then all axes have one unit.

    Returns
    -------
    float, or ndarray (1, d) of one for each axis
        At least half a cell.

    Examples
    --------
    >>> x = np.random.default_rng(1).random((100, 2))
    >>> round(bandwidth(x, Grid((30, 30))), 3)
    0.129
    >>> bandwidth(x * [1000.0, 1.0], Grid((30, 30), high=[1000.0, 1.0])).round(3)
    array([[127.569,   0.131]])
    """
    grid._check_inside(positions)
    n, d = positions.shape
    spread = float(np.sqrt(positions.var(axis=0).mean()))
    if n < 2 or spread == 0:
        raise ValueError(
            f"positions must have two agents or more in different places, got {n} "
            f"with a spread of {spread:g}"
        )
    if each_axis is None:
        # One bandwidth for all axes suits a box whose sides are equal up to rounding.
        each_axis = bool(np.ptp(grid.width) > 1e-9 * grid.width.max())
    # No bandwidth may be below half a cell.
    least: float | Array = 0.5 * float(grid.spacing.max())
    scale: float | Array = spread
    if each_axis:
        least = 0.5 * grid.spacing[None]
        scale = positions.std(axis=0)[None]
    silverman = scale * (4 / ((d + 2) * n)) ** (1 / (d + 4))
    widest = np.maximum(silverman, least)
    if rule == "silverman":
        return widest if each_axis else float(widest)
    # A narrower kernel than half the step of rounded positions would show the rounding.
    step = _rounding_steps(positions, grid)
    floor = 0.5 * (step[None] if each_axis else step.max())
    # From far below Silverman's bandwidth, for clusters, to above it.
    factors = np.geomspace(0.15, 1.5, 20)
    least = np.maximum(least, floor)
    candidates: list[float | Array] = []
    for factor in factors:
        width = np.maximum(silverman * factor, least)
        candidates.append(width if each_axis else float(width))
    spread_out = _undo_rounding(positions, grid, step)
    # Agents that are still in one place have one number.
    places = _number_places(spread_out, grid)
    scores = [_cross_validation_score(spread_out, grid, h, places) for h in candidates]
    return candidates[int(np.argmin(scores))]


def _number_places(x: Array, grid: Grid) -> Indices | None:
    """Number the places of agents (N, d), the same for agents in one place; None without ties.

    The result is (N,). Places are told apart to a small part of the grid's width.
    """
    # Positions that agree to this length along each axis are the same place.
    unit = _NO_DISTANCE * grid.width
    cells = np.round((x - grid.low) / unit)
    places, index = np.unique(cells, axis=0, return_inverse=True)
    if len(places) == len(x):
        return None
    return np.asarray(index.reshape(-1), dtype=np.intp)


def _rounding_steps(x: Array, grid: Grid) -> Array:
    """Return for each axis the step to which positions (N, d) are rounded, or zero, as (d,)."""
    return np.array(
        [_lattice_step(x[:, k], float(grid.width[k])) for k in range(grid.dim)]
    )


def _undo_rounding(x: Array, grid: Grid, step: Array) -> Array:
    """Spread agents x (N, d) over the intervals that were rounded, evenly and without draws.

    A position that was rounded to a multiple of `step` (d,) lay within half a step of it.

    >>> line = Grid((9,), high=9.0)
    >>> x = np.array([[3.0], [3.0], [4.0], [7.0]])
    >>> _undo_rounding(x, line, np.array([1.0])).round(2).ravel()
    array([3.43, 3.05, 3.66, 7.28])
    """
    if not step.any():
        return x
    # Multiples of irrational numbers, taken modulo one, fill the unit interval evenly; agents in
    # one place are next to each other in this order. For the axes k = 1, 2, 3 the number is 1/φ
    # with φ^(k + 1) = φ + 1; the first φ is the golden ratio.
    ratios = np.array([0.6180339887, 0.7548776662, 0.8191725134])[: grid.dim]
    ranks = np.empty(len(x))
    ranks[np.lexsort(x.T)] = np.arange(len(x))
    # Offsets in [-½, ½). Every start of the sequence would do; here it is 1.5.
    offsets = ((ranks[:, None] + 1.5) * ratios) % 1 - 0.5
    moved = x + offsets * step
    # Reflected at the walls, as the kernels are.
    moved = grid.low + np.abs(moved - grid.low)
    high = grid.low + grid.width
    return np.asarray(high - np.abs(high - moved))


def _lattice_step(values: Array, width: float) -> float:
    """Return the step of the lattice on which tied coordinates lie; 0 without ties or lattice.

    `values` (N,) are coordinates along one axis of a box, and `width` is that of the box.
    """
    # In units of a distance that counts as none
    unique = np.unique(np.round(values / (_NO_DISTANCE * width)))
    # Without ties, or with all in one place, nothing shows a lattice.
    if not 1 < len(unique) < len(values):
        return 0.0
    differences = np.diff(unique)
    step = float(differences.min())
    multiples = differences / step
    # All differences are multiples of the smallest, but for rounding: to a hundredth of it.
    is_lattice = np.abs(multiples - np.round(multiples)).max() < 0.01
    return step * _NO_DISTANCE * width if is_lattice else 0.0


def _cross_validation_score(
    x: Array, grid: Grid, h: float | Array, places: Indices | None = None
) -> float:
    """∫p̂² - (2/N) Σ p̂₋ᵢ(Xᵢ), with the leave-one-out estimates p̂₋ᵢ.

    With numbers of the agents' places, all agents in the place of agent i are left out. The agents
    are at x (N, d), and h is the bandwidth.
    """
    n = len(x)
    # The kernel of each agent on the grid, (N, n), and the estimate p̂
    z = kernels(x, grid, bandwidth=h)
    mean = z.mean(axis=0)
    # Entry (i, j) is the kernel of agent i in the cell of agent j; the diagonal, an agent's kernel
    # in its own cell, is left out.
    pairs = z[:, grid.cell_index(x)]
    if places is None:
        leave_one_out = (pairs.sum() - np.trace(pairs)) / (n * (n - 1))
    else:
        is_other = places[:, None] != places
        # Each estimate is a mean over the agents that remain.
        remaining = is_other.sum(axis=0)
        leave_one_out = ((pairs * is_other).sum(axis=0) / remaining).mean()
    return float((mean**2).sum() * grid.volume - 2 * leave_one_out)
