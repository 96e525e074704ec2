"""Kernel estimates: mass, reflection, their exact noise, and bandwidths."""

from __future__ import annotations

import numpy as np
import pytest

from distfilt import density
from distfilt.density.kernel import _cross_validation_score, check_resolution

GRID = density.Grid((20, 30))
SOME = np.random.default_rng(1).random((40, 2))


@pytest.mark.parametrize("shape", [(25,), (20, 30), (8, 9, 10)])
@pytest.mark.parametrize("h", [0.08, 0.9])
def test_reflection_keeps_the_mass(shape: tuple[int, ...], h: float) -> None:
    grid = density.Grid(shape, low=[2.0] * len(shape), high=[3.0] * len(shape))
    x = 2 + np.random.default_rng(2).random((30, grid.dim))
    z = density.kernels(x, grid, bandwidth=h)
    assert np.abs(grid.integral(z) - 1).max() < 1e-12 and z.min() >= 0
    mean = density.kernel_density(x, grid, bandwidth=h)
    assert np.abs(mean - z.mean(axis=0)).max() < 1e-13


def test_reflection_solves_the_heat_equation() -> None:
    # A kernel between reflecting walls is the cosine series of the heat kernel.
    grid = density.Grid((40,))
    x = 0.13
    h = 0.2
    k = np.arange(1, 60)
    edges = grid.edges[0]
    modes = np.diff(np.sin(np.pi * k[:, None] * edges), axis=1) / (np.pi * k[:, None])
    decay = np.exp(-0.5 * (np.pi * k * h) ** 2) * np.cos(np.pi * k * x)
    series = 1 + 2 * (decay[:, None] * modes).sum(axis=0) / grid.volume
    assert np.abs(density.kernels([[x]], grid, bandwidth=h)[0] - series).max() < 1e-12


def test_axes_are_not_exchanged_and_batches_broadcast() -> None:
    z = density.kernels([[0.2, 0.8]], GRID, bandwidth=0.06)[0]
    assert np.allclose(z @ GRID.centres * GRID.volume, [0.2, 0.8], atol=1e-3)
    many = density.kernel_density(
        np.stack([SOME, SOME[::-1] * 0.5]), GRID, bandwidth=0.1
    )
    assert np.allclose(many[1], density.kernel_density(SOME * 0.5, GRID, bandwidth=0.1))


def test_one_bandwidth_for_each_agent() -> None:
    h = np.linspace(0.05, 0.2, 40)
    z = density.kernels(SOME, GRID, bandwidth=h)
    for i in (0, 39):
        assert np.allclose(
            z[i], density.kernels(SOME[i : i + 1], GRID, bandwidth=h[i])[0]
        )


def test_the_constant_is_the_integral_of_the_kernel_squared() -> None:
    for grid in (density.Grid((400,)), density.Grid((150, 150))):
        middle = np.full((1, grid.dim), 0.5)
        z = density.kernels(middle, grid, bandwidth=0.05)[0]
        wanted = float((z**2).sum() * grid.volume) / 100
        got = density.kernel_constant(grid, bandwidth=0.05, agents=100)
        assert got == pytest.approx(wanted, rel=5e-3)


def test_covariance_is_that_of_one_agent_over_their_number() -> None:
    """An agent is in cell j with probability p_j Δ, and its kernel is then that cell's."""
    grid = density.Grid((10, 10))
    p = grid.normalize(1 + grid.centres[:, 0] + 2 * grid.centres[:, 1] ** 2)
    z = density.kernels(grid.centres, grid, bandwidth=0.12)
    mean, cov = density.kernel_covariance(p, grid, bandwidth=0.12, agents=20)
    assert np.allclose(mean, np.average(z, axis=0, weights=p))
    assert np.allclose(cov, np.cov(z.T, aweights=p * grid.volume, ddof=0) / 20)


def test_silverman_by_its_formula() -> None:
    x = np.random.default_rng(4).random((100, 2))
    wanted = np.sqrt(x.var(axis=0).mean()) * 100 ** (-1 / 6)
    assert density.bandwidth(x, GRID) == pytest.approx(wanted)
    one = np.random.default_rng(4).random((50, 1))
    wanted = one.std() * (4 / 150) ** 0.2
    assert density.bandwidth(one, density.Grid((40,))) == pytest.approx(wanted)


@pytest.mark.parametrize("apart", [0.04, 0.6])
def test_the_score_of_cross_validation_leaves_each_agent_out(apart: float) -> None:
    """∫p² - 2/N Σ p₋ᵢ(Xᵢ), the estimate without i made anew for each i."""
    x = np.array([[0.2, 0.2], [0.2 + apart, 0.2], [0.25, 0.25]])
    p = density.kernel_density(x, GRID, bandwidth=0.04)
    left = [
        density.kernel_density(np.delete(x, i, axis=0), GRID, bandwidth=0.04)[
            GRID.cell_index(x[i])
        ]
        for i in range(3)
    ]
    wanted = (p**2).sum() * GRID.volume - 2 * np.mean(left)
    assert _cross_validation_score(x, GRID, 0.04) == pytest.approx(wanted)


def test_cross_validation_has_the_least_score() -> None:
    """On two clusters far apart, for which Silverman's rule is too wide."""
    rng = np.random.default_rng(5)
    x = np.repeat([[0.2, 0.5], [0.8, 0.5]], 50, axis=0) + 0.06 * rng.standard_normal(
        (100, 2)
    )
    h = density.bandwidth(x, GRID, rule="least_squares")
    least = _cross_validation_score(x, GRID, h)
    assert all(least < _cross_validation_score(x, GRID, c * h) for c in (0.8, 1.25, 2.0))
    assert h < 0.7 * density.bandwidth(x, GRID)


def test_a_cell_is_at_most_two_bandwidths_wide() -> None:
    check_resolution(density.Grid((10, 10)), 0.05)
    with pytest.raises(
        ValueError, match="^grid must have cells no wider than two bandwidths, 0.08"
    ):
        check_resolution(density.Grid((20, 10)), np.array([0.05, 0.04]))
