"""Grids: quadrature, histograms, interpolation and cosine modes in one to three dimensions."""

from __future__ import annotations

import numpy as np
import pytest

from distfilt.density import Grid

BOX = Grid((4, 6), low=[-1.0, 2.0], high=[1.0, 5.0])


@pytest.mark.parametrize("shape", [(7,), (4, 6), (3, 4, 5)])
def test_constants_integrate_to_the_volume(shape: tuple[int, ...]) -> None:
    low, high = np.arange(len(shape)) - 1.0, np.arange(len(shape)) + 1.5
    grid = Grid(shape, low=low, high=high)
    assert grid.integral(np.ones(grid.size)) == pytest.approx(2.5 ** len(shape), rel=1e-14)
    assert grid.norm(2 * np.ones(grid.size)) == pytest.approx(2 * 2.5 ** (len(shape) / 2))


def test_order_is_that_of_the_last_axis_and_walls_belong_to_the_outer_cells() -> None:
    assert np.allclose(BOX.centres[1] - BOX.centres[0], [0.0, 0.5])
    assert np.allclose(BOX.centres[6] - BOX.centres[0], [0.5, 0.0])
    assert np.array_equal(BOX.cells(BOX.centres), np.arange(24))
    assert np.array_equal(BOX.cells([[1.0, 5.0], [-1.0, 2.0]]), [23, 0])


def test_histogram_counts_batches() -> None:
    x = np.random.default_rng(1).random((3, 50, 2)) * [2, 3] + [-1, 2]
    h = BOX.histogram(x)
    assert h.shape == (3, 24) and np.allclose(BOX.integral(h), 1, atol=1e-14)
    other, *_ = np.histogram2d(x[1, :, 0], x[1, :, 1], bins=BOX.edges, density=True)
    assert np.allclose(h[1], other.ravel())


@pytest.mark.parametrize("shape", [(9,), (5, 7), (4, 5, 6)])
def test_interpolation_is_exact_for_products_of_lines(shape: tuple[int, ...]) -> None:
    grid = Grid(shape)
    v = (1 + grid.centres).prod(axis=-1)
    assert np.allclose(grid.at(v, grid.centres), v, atol=1e-14)
    x = 0.2 + 0.6 * np.random.default_rng(2).random((20, grid.dim))
    assert np.allclose(grid.at(v, x), (1 + x).prod(axis=-1), atol=1e-13)
    corner = np.zeros(grid.dim)
    assert grid.at(v, corner) == pytest.approx(v[0])


def test_aggregation_keeps_integrals_of_each_block() -> None:
    fine, coarse = Grid((6, 8)), Grid((3, 2))
    v = np.random.default_rng(3).random((2, 48))
    got = fine.aggregated(v, coarse)
    assert np.allclose(got[1, 0], v[1].reshape(6, 8)[:2, :4].mean())
    assert np.allclose(got[1, 5], v[1].reshape(6, 8)[4:, 4:].mean())
    assert np.allclose(fine.integral(v), coarse.integral(got))


@pytest.mark.parametrize("grid", [Grid((9,)), BOX, Grid((3, 4, 5), high=[1.0, 2.0, 3.0])])
def test_cosines_are_orthonormal_and_complete(grid: Grid) -> None:
    c = grid.cosines(grid.size)
    assert np.abs(c.T @ c * grid.volume - np.eye(grid.size)).max() < 1e-12
    assert np.abs(c[:, 1:].sum(axis=0)).max() < 1e-11


def test_modes_come_by_frequency_in_the_box() -> None:
    long = Grid((8, 8), high=[1.0, 10.0])
    assert np.array_equal(long.wavenumbers(4), [[0, 0], [0, 1], [0, 2], [0, 3]])
    assert np.array_equal(Grid((9, 9), high=[1.0, 1e6]).wavenumbers(9)[:, 1], np.arange(9))
    assert np.array_equal(Grid((8, 8)).wavenumbers(5), [[0, 0], [0, 1], [1, 0], [1, 1], [0, 2]])


@pytest.mark.parametrize("unit", [1e-3, 1e5, 1e6])
@pytest.mark.parametrize("sides", [(1.0, 1.0), (1.0, 0.7), (3.0, 1.0, 2.0)])
def test_the_lowest_modes_are_the_same_in_every_unit(unit: float, sides: tuple[float, ...]) -> None:
    shape = (12, 10, 8)[: len(sides)]
    one, other = (Grid(shape, high=u * np.array(sides)) for u in (1.0, unit))
    assert np.array_equal(one.wavenumbers(one.size), other.wavenumbers(one.size))
