"""Kernel estimates: mass, reflection, their exact noise, and bandwidths."""

from __future__ import annotations

import numpy as np
import pytest

from distfilt import density
from distfilt.density.kernel import _cross_validation_score, check_resolution

GRID = density.Grid((20, 30))
POSITIONS = np.random.default_rng(1).random((40, 2))


@pytest.mark.parametrize("shape", [(25,), (20, 30), (8, 9, 10)])
@pytest.mark.parametrize("h", [0.08, 0.9])
def test_reflection_conserves_the_mass(shape: tuple[int, ...], h: float) -> None:
    """Of kernels that are narrow, and as wide as the box; no value is negative."""
    d = len(shape)
    grid = density.Grid(shape, low=[2.0] * d, high=[3.0] * d)
    uniform = np.random.default_rng(2).random((30, d))
    x = 2 + uniform
    z = density.kernels(x, grid, bandwidth=h)
    assert np.abs(grid.integral(z) - 1).max() < 1e-12
    assert z.min() >= 0
    # The estimate is the mean of the kernels.
    mean = density.kernel_density(x, grid, bandwidth=h)
    assert np.abs(mean - z.mean(axis=0)).max() < 1e-13


def test_reflection_solves_the_heat_equation() -> None:
    """A kernel between reflecting walls is the cosine series of the heat kernel."""
    grid = density.Grid((40,))
    x = 0.13
    h = 0.2
    frequency = np.pi * np.arange(1, 60)[:, None]
    # Integrals of cos(π k s) over the cells
    antiderivative = np.sin(frequency * grid.edges[0]) / frequency
    integrals = np.diff(antiderivative, axis=1)
    # p(s) = 1 + 2 Σ exp(-½ (π k h)²) cos(π k x) cos(π k s), averaged over the cells
    decay = np.exp(-0.5 * (frequency * h) ** 2)
    terms = decay * np.cos(frequency * x) * integrals
    series = 1 + 2 * terms.sum(axis=0) / grid.volume
    kernel = density.kernels([[x]], grid, bandwidth=h)[0]
    assert np.abs(kernel - series).max() < 1e-12


def test_axes_are_not_exchanged() -> None:
    """The mean of a kernel is its agent's position."""
    kernel = density.kernels([[0.2, 0.8]], GRID, bandwidth=0.06)[0]
    mean = kernel @ GRID.centres * GRID.volume
    assert np.allclose(mean, [0.2, 0.8], atol=1e-3)


def test_batches_are_estimated_independently() -> None:
    second = 0.5 * POSITIONS
    batch = np.stack([POSITIONS, second[::-1]])
    estimates = density.kernel_density(batch, GRID, bandwidth=0.1)
    # The order of the agents does not matter.
    expected = density.kernel_density(second, GRID, bandwidth=0.1)
    assert np.allclose(estimates[1], expected)


@pytest.mark.parametrize("agent", [0, 39])
def test_each_agent_may_have_its_bandwidth(agent: int) -> None:
    h = np.linspace(0.05, 0.2, 40)
    z = density.kernels(POSITIONS, GRID, bandwidth=h)
    expected = density.kernels([POSITIONS[agent]], GRID, bandwidth=h[agent])
    assert np.allclose(z[agent], expected[0])


@pytest.mark.parametrize("shape", [(400,), (150, 150)])
def test_the_constant_is_the_integral_of_the_squared_kernel(
    shape: tuple[int, ...],
) -> None:
    """Divided by the number of agents, for an agent far from the walls."""
    grid = density.Grid(shape)
    middle = np.full((1, grid.dim), 0.5)
    kernel = density.kernels(middle, grid, bandwidth=0.05)
    squared_integral = float(grid.norm(kernel)[0] ** 2)
    expected = squared_integral / 100
    constant = density.kernel_constant(grid, bandwidth=0.05, agents=100)
    assert constant == pytest.approx(expected, rel=5e-3)


def test_covariance_is_that_of_one_agent_divided_by_their_number() -> None:
    """An agent is in cell j with probability p_j Δ, and its kernel is then that cell's."""
    grid = density.Grid((10, 10))
    x = grid.centres
    p = grid.normalize(1 + x[:, 0] + 2 * x[:, 1] ** 2)
    z = density.kernels(grid.centres, grid, bandwidth=0.12)
    # E z = Σ p_j Δ z_j, Cov z = Cov(z_j) / N for N independent agents
    mean, cov = density.kernel_covariance(p, grid, bandwidth=0.12, agents=20)
    assert np.allclose(mean, np.average(z, axis=0, weights=p))
    single = np.cov(z.T, aweights=p * grid.volume, ddof=0)
    assert np.allclose(cov, single / 20)


def test_silverman_s_rule_in_two_dimensions_and_in_one() -> None:
    """σ (4/((d + 2) N))^(1/(d + 4))"""
    x = np.random.default_rng(4).random((100, 2))
    std = np.sqrt(x.var(axis=0).mean())
    expected = std * 100 ** (-1 / 6)
    assert density.bandwidth(x, GRID) == pytest.approx(expected)
    x = np.random.default_rng(4).random((50, 1))
    expected = x.std() * (4 / 150) ** 0.2
    assert density.bandwidth(x, density.Grid((40,))) == pytest.approx(expected)


@pytest.mark.parametrize("distance", [0.04, 0.6])
def test_the_score_of_cross_validation_leaves_each_agent_out(distance: float) -> None:
    """∫p² - 2/N Σ p₋ᵢ(Xᵢ), by the estimates without each agent."""
    x = np.array([[0.2, 0.2], [0.2 + distance, 0.2], [0.25, 0.25]])
    p = density.kernel_density(x, GRID, bandwidth=0.04)
    values = []
    for i in range(3):
        others = np.delete(x, i, axis=0)
        estimate = density.kernel_density(others, GRID, bandwidth=0.04)
        values.append(estimate[GRID.cell_index(x[i])])
    square = (p**2).sum() * GRID.volume
    expected = square - 2 * np.mean(values)
    score = _cross_validation_score(x, GRID, 0.04)
    assert score == pytest.approx(expected)


def test_cross_validation_has_the_least_score() -> None:
    """On two distant clusters, for which Silverman's rule is too wide."""
    rng = np.random.default_rng(5)
    centres = np.repeat([[0.2, 0.5], [0.8, 0.5]], 50, axis=0)
    x = centres + 0.06 * rng.standard_normal((100, 2))
    h = density.bandwidth(x, GRID, rule="least_squares")
    least = _cross_validation_score(x, GRID, h)
    for factor in (0.8, 1.25, 2.0):
        score = _cross_validation_score(x, GRID, factor * h)
        assert least < score
    assert h < 0.7 * density.bandwidth(x, GRID)


def test_a_cell_is_at_most_two_bandwidths_wide() -> None:
    check_resolution(density.Grid((10, 10)), 0.05)
    with pytest.raises(
        ValueError, match="^grid must have cells no wider than two bandwidths, 0.08"
    ):
        check_resolution(density.Grid((20, 10)), np.array([0.05, 0.04]))


def test_the_constant_of_widths_by_axis_is_a_product() -> None:
    """∫k² of a Gaussian is Π 1 / (2 √π h_k)."""
    widths = np.array([[0.2, 0.5]])
    grid = density.Grid((10, 10))
    constant = density.kernel_constant(grid, bandwidth=widths, agents=3)
    assert np.isclose(constant, 1 / (3 * 4 * np.pi * 0.2 * 0.5), rtol=1e-12)
    equal = density.kernel_constant(grid, bandwidth=[[0.3, 0.3]], agents=3)
    single = density.kernel_constant(grid, bandwidth=0.3, agents=3)
    assert np.isclose(equal, single, rtol=1e-12)
