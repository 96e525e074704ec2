"""Grids: quadrature, histograms, interpolation and cosine modes in one to three dimensions."""

from __future__ import annotations

import numpy as np
import pytest

from distfilt.density import Grid, zero_mean_prior

BOX = Grid((4, 6), low=[-1.0, 2.0], high=[1.0, 5.0])


def test_order_is_that_of_the_last_axis_and_walls_belong_to_the_outer_cells() -> None:
    assert np.allclose(BOX.centres[1] - BOX.centres[0], [0.0, 0.5])
    assert np.allclose(BOX.centres[6] - BOX.centres[0], [0.5, 0.0])
    assert np.array_equal(BOX.cell_index(BOX.centres), np.arange(24))
    assert np.array_equal(BOX.cell_index([[1.0, 5.0], [-1.0, 2.0]]), [23, 0])


def test_histogram_counts_batches() -> None:
    x = np.random.default_rng(1).random((3, 50, 2)) * [2, 3] + [-1, 2]
    h = BOX.histogram(x)
    assert h.shape == (3, 24) and np.allclose(BOX.integral(h), 1, atol=1e-14)
    assert np.allclose(BOX.norm(h) ** 2, (h**2).sum(axis=-1) * 6 / 24, atol=1e-14)
    other, *_ = np.histogram2d(x[1, :, 0], x[1, :, 1], bins=BOX.edges, density=True)
    assert np.allclose(h[1], other.ravel())


@pytest.mark.parametrize(
    "grid", [Grid((9,)), BOX, Grid((3, 4, 5), high=[1.0, 2.0, 3.0])]
)
def test_cosines_are_orthonormal_and_complete(grid: Grid) -> None:
    c = grid.cosines(grid.size)
    assert np.abs(c.T @ c * grid.volume - np.eye(grid.size)).max() < 1e-12
    assert np.abs(c[:, 1:].sum(axis=0)).max() < 1e-11


def test_modes_come_by_frequency_in_the_box() -> None:
    long = Grid((8, 8), high=[1.0, 10.0])
    assert np.array_equal(long.wavenumbers(4), [[0, 0], [0, 1], [0, 2], [0, 3]])
    assert np.array_equal(
        Grid((9, 9), high=[1.0, 1e6]).wavenumbers(9)[:, 1], np.arange(9)
    )
    assert np.array_equal(
        Grid((8, 8)).wavenumbers(5), [[0, 0], [0, 1], [1, 0], [1, 1], [0, 2]]
    )


@pytest.mark.parametrize("unit", [1e-3, 1e5, 1e6])
@pytest.mark.parametrize("sides", [(1.0, 1.0), (1.0, 0.7), (3.0, 1.0, 2.0)])
def test_the_lowest_modes_are_the_same_in_every_unit(
    unit: float, sides: tuple[float, ...]
) -> None:
    shape = (12, 10, 8)[: len(sides)]
    one, other = (Grid(shape, high=u * np.array(sides)) for u in (1.0, unit))
    assert np.array_equal(one.wavenumbers(one.size), other.wavenumbers(one.size))


@pytest.mark.parametrize("shape", [(9,), (4, 5, 6)])
def test_interpolation_is_exact_for_products_of_lines(shape: tuple[int, ...]) -> None:
    grid = Grid(shape)
    v = (1 + grid.centres).prod(axis=-1)
    x = 0.2 + 0.6 * np.random.default_rng(2).random((20, grid.dim))
    assert np.allclose(grid.interpolate(v, x), (1 + x).prod(axis=-1), atol=1e-13)
    assert grid.interpolate(v, np.zeros(grid.dim)) == pytest.approx(v[0])


def test_prior_has_the_variance_the_length_and_the_mass_that_it_says() -> None:
    grid = Grid((20, 20), high=[2.0, 1.0])
    s = zero_mean_prior(grid, rank=399, length=0.2, std=0.7)
    assert (s**2).sum() / grid.size == pytest.approx(0.49, rel=1e-10)
    assert np.abs(s.sum(axis=0)).max() < 1e-10
    correlation = (s @ s.T)[190, 190 + 40] / (s @ s.T)[
        190, 190
    ]  # two cells, 0.2, along axis 0
    assert correlation == pytest.approx(np.exp(-0.5), abs=0.1)
    assert np.array_equal(
        zero_mean_prior(grid, rank=50, length=0.2, std=0.7), s[:, :50]
    )
    loose = zero_mean_prior(grid, rank=30, mass_std=0.2)
    assert np.array_equal(loose[:, 1:], zero_mean_prior(grid, rank=30))
    assert np.ptp(loose[:, 0]) == 0 and grid.integral(loose[:, 0]) == pytest.approx(
        0.2, rel=1e-12
    )


def test_a_prior_is_a_tenth_of_the_box_long_and_as_wide_as_the_mean_density() -> None:
    grid = Grid((12, 12), high=[20.0, 5.0])
    wanted = zero_mean_prior(grid, rank=20, length=1.0, std=0.01)
    assert np.allclose(zero_mean_prior(grid, rank=20), wanted, rtol=1e-12)


def test_a_prior_far_longer_than_the_box_is_its_lowest_modes() -> None:
    """exp(-π²ℓ²|k|²/2) underflows for all modes; what counts is their ratio."""
    for width, wanted in ((1.0, [0.125, 0.125, 0, 0, 0]), (2.0, [0.25, 0, 0, 0, 0])):
        grid = Grid((9, 9), high=[width, 1.0])
        s = zero_mean_prior(grid, rank=5, length=1e12, std=0.5)
        assert np.allclose((s**2).mean(axis=0), wanted)
