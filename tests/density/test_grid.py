"""Grids: quadrature, histograms, interpolation and cosine modes in one to three dimensions."""

from __future__ import annotations

import numpy as np
import pytest

from distfilt.density import Grid, zero_mean_prior

BOX = Grid((4, 6), low=[-1.0, 2.0], high=[1.0, 5.0])


def test_the_last_axis_is_fastest_and_walls_belong_to_their_cells() -> None:
    # Next cell, and next row of cells
    to_next_cell = BOX.centres[1] - BOX.centres[0]
    to_next_row = BOX.centres[6] - BOX.centres[0]
    assert np.allclose(to_next_cell, [0.0, 0.5])
    assert np.allclose(to_next_row, [0.5, 0.0])
    assert np.array_equal(BOX.cell_index(BOX.centres), np.arange(24))
    # The corners
    corners = [[1.0, 5.0], [-1.0, 2.0]]
    assert np.array_equal(BOX.cell_index(corners), [23, 0])


def test_a_histogram_counts_each_batch() -> None:
    uniform = np.random.default_rng(1).random((3, 50, 2))
    x = uniform * [2, 3] + [-1, 2]
    histogram = BOX.histogram(x)
    assert histogram.shape == (3, 24)
    # numpy's histogram of one batch
    expected, _, _ = np.histogram2d(
        x[1, :, 0], x[1, :, 1], bins=BOX.edges, density=True
    )
    assert np.allclose(histogram[1], expected.ravel())


def test_integral_and_norm_are_sums_times_the_cell_volume() -> None:
    """The box has a volume of 6 and 24 cells; a histogram has the integral 1."""
    uniform = np.random.default_rng(1).random((3, 50, 2))
    x = uniform * [2, 3] + [-1, 2]
    histogram = BOX.histogram(x)
    assert np.allclose(BOX.integral(histogram), 1, atol=1e-14)
    # ‖p‖² = ∫ p²
    square = (histogram**2).sum(axis=-1) * 6 / 24
    assert np.allclose(BOX.norm(histogram) ** 2, square, atol=1e-14)


@pytest.mark.parametrize(
    "grid", [Grid((9,)), BOX, Grid((3, 4, 5), high=[1.0, 2.0, 3.0])]
)
def test_cosines_are_orthonormal_and_complete(grid: Grid) -> None:
    """As many modes as cells; all but the constant one have no mass."""
    modes = grid.cosines(grid.size)
    # ∫ φ_j φ_k = δ_jk by the midpoint rule, which is exact for cosines.
    gram = modes.T @ modes * grid.volume
    assert np.abs(gram - np.eye(grid.size)).max() < 1e-12
    assert np.abs(modes[:, 1:].sum(axis=0)).max() < 1e-11


def test_modes_are_ordered_by_their_frequency_in_the_box() -> None:
    # In a square, symmetric modes are ordered by their wavenumbers.
    square = Grid((8, 8)).wavenumbers(5)
    assert np.array_equal(square, [[0, 0], [0, 1], [1, 0], [1, 1], [0, 2]])
    # In a long box the first modes vary along it.
    long = Grid((8, 8), high=[1.0, 10.0]).wavenumbers(4)
    assert np.array_equal(long, [[0, 0], [0, 1], [0, 2], [0, 3]])
    longer = Grid((9, 9), high=[1.0, 1e6]).wavenumbers(9)
    assert np.array_equal(longer[:, 1], np.arange(9))


@pytest.mark.parametrize("unit", [1e-3, 1e5, 1e6])
@pytest.mark.parametrize("sides", [(1.0, 1.0), (1.0, 0.7), (3.0, 1.0, 2.0)])
def test_the_lowest_modes_are_the_same_in_every_unit(
    unit: float, sides: tuple[float, ...]
) -> None:
    """Rounding errors do not decide between symmetric modes."""
    shape = (12, 10, 8)[: len(sides)]
    expected = Grid(shape, high=sides)
    grid = Grid(shape, high=unit * np.array(sides))
    size = grid.size
    wavenumbers = grid.wavenumbers(size)
    assert np.array_equal(wavenumbers, expected.wavenumbers(size))


@pytest.mark.parametrize("shape", [(9,), (4, 5, 6)])
def test_interpolation_is_exact_for_products_of_lines(shape: tuple[int, ...]) -> None:
    """Away from walls; at a wall it is constant."""
    grid = Grid(shape)
    # Multilinear interpolation reproduces Π (1 + x_i).
    values = (1 + grid.centres).prod(axis=-1)
    uniform = np.random.default_rng(2).random((20, grid.dim))
    x = 0.2 + 0.6 * uniform
    exact = (1 + x).prod(axis=-1)
    assert np.allclose(grid.interpolate(values, x), exact, atol=1e-13)
    corner = grid.interpolate(values, np.zeros(grid.dim))
    assert corner == pytest.approx(values[0])


def test_a_prior_has_its_variance_its_length_and_no_mass() -> None:
    grid = Grid((20, 20), high=[2.0, 1.0])
    factor = zero_mean_prior(grid, rank=399, length=0.2, std=0.7)
    # The variance is 0.7² in the mean over the cells.
    mean_variance = (factor**2).sum() / grid.size
    assert mean_variance == pytest.approx(0.49, rel=1e-10)
    assert np.abs(factor.sum(axis=0)).max() < 1e-10
    # Two cells of 0.1 along axis 0 are one correlation length apart.
    cov = factor @ factor.T
    correlation = cov[190, 230] / cov[190, 190]
    # exp(-r²/(2 ℓ²)) at r = ℓ, but for the walls
    assert correlation == pytest.approx(np.exp(-0.5), abs=0.1)
    # A lower rank truncates it.
    truncated = zero_mean_prior(grid, rank=50, length=0.2, std=0.7)
    assert np.array_equal(truncated, factor[:, :50])


def test_an_uncertain_mass_is_a_constant_column() -> None:
    """In front of the others, which are the same without it."""
    grid = Grid((20, 20), high=[2.0, 1.0])
    factor = zero_mean_prior(grid, rank=30, mass_std=0.2)
    assert np.array_equal(factor[:, 1:], zero_mean_prior(grid, rank=30))
    mass = factor[:, 0]
    assert np.ptp(mass) == 0
    # A standard deviation of the mass of 0.2
    assert grid.integral(mass) == pytest.approx(0.2, rel=1e-12)


def test_a_prior_s_defaults_scale_with_the_box() -> None:
    """A length of a tenth of its side, 10, and a deviation of its mean density, 1/100."""
    grid = Grid((12, 12), high=[20.0, 5.0])
    expected = zero_mean_prior(grid, rank=20, length=1.0, std=0.01)
    assert np.allclose(zero_mean_prior(grid, rank=20), expected, rtol=1e-12, atol=1e-16)


@pytest.mark.parametrize(
    ("width", "expected"),
    [(1.0, [0.125, 0.125, 0, 0, 0]), (2.0, [0.25, 0, 0, 0, 0])],
)
def test_a_prior_far_longer_than_the_box_is_its_lowest_modes(
    width: float, expected: list[float]
) -> None:
    """exp(-π²ℓ²|k|²/2) underflows for all modes, but only ratios matter."""
    grid = Grid((9, 9), high=[width, 1.0])
    factor = zero_mean_prior(grid, rank=5, length=1e12, std=0.5)
    # In a square two modes share the lowest frequency and the variance 0.5², in a long
    # box one is the lowest.
    assert np.allclose((factor**2).mean(axis=0), expected)


def test_interpolation_in_a_box_that_does_not_begin_at_zero() -> None:
    """A plane is interpolated exactly between the centres of cells of any size."""
    grid = Grid((4, 5), low=np.array([-2.0, 1.0]), high=np.array([2.0, 3.5]))
    plane = grid.centres @ [2.0, -3.0] + 0.5
    positions = np.array([[-1.3, 1.4], [0.2, 2.9], [1.4, 2.2]])
    expected = positions @ [2.0, -3.0] + 0.5
    assert np.allclose(grid.interpolate(plane, positions), expected, atol=1e-12)
