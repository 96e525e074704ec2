"""Widths of kernels for each axis, and for agents in one place.

| Report | Situation |
|---|---|
| scikit-learn/scikit-learn 25623 | a width that does not know the scale of the data |
| scikit-learn/scikit-learn 26658 | axes of different units |
| scikit-learn/scikit-learn 2648 | a width for each axis |
| tommyod/KDEpy 26 | a width for each agent and one for each axis |
| scipy/scipy 19250 | one width for all axes, where they have one unit |
| arviz-devs/arviz 2384 | cross-validation beside walls |
| own | rounded positions, and agents in one place |
"""

from __future__ import annotations

from typing import Literal

import numpy as np
import pytest
from scipy.stats import gaussian_kde, norm

from distfilt.density import (
    Grid,
    bandwidth,
    kernel_constant,
    kernel_covariance,
    kernel_density,
    kernels,
)
from distfilt.density.snapshot import SwarmSnapshot

BOX = Grid((40, 40), low=[0.0, 0.0], high=[1000.0, 1.0])
"""Metres by radians."""
UNIT = Grid((40, 40))
Rule = Literal["silverman", "least_squares"]
RULES: tuple[Rule, ...] = ("silverman", "least_squares")


def draw_agents(n: int) -> np.ndarray:
    """Draw agents in the unit square."""
    rng = np.random.default_rng(0)
    return np.asarray(rng.normal(0.5, 0.1, (n, 2)).clip(0, 1))


def normal_density(grid: Grid, mean: float, std: float) -> np.ndarray:
    """Return a Gaussian of independent axes at the centres of the unit box."""
    x = (grid.centres - grid.low) / grid.width
    values = norm.pdf(x, mean, std).prod(axis=-1)
    return np.asarray(values / grid.box_volume)


@pytest.mark.parametrize("rule", RULES)
def test_axes_of_different_units_have_a_width_each(rule: Rule) -> None:
    """The estimate is as good as scipy's, which scales by the covariance."""
    x = draw_agents(400) * [1000.0, 1.0]
    true = normal_density(BOX, 0.5, 0.1)
    by_scipy = gaussian_kde(x.T, "silverman")(BOX.centres.T)
    h = bandwidth(x, BOX, rule=rule)
    estimate = kernel_density(x, BOX, bandwidth=h)
    # ∫ |p̂ - p| dx, for this estimate and for scipy's
    error = np.abs(estimate - true).sum() * BOX.volume
    expected = np.abs(by_scipy - true).sum() * BOX.volume
    assert error < 1.1 * expected
    assert h.shape == (1, 2)


@pytest.mark.parametrize("rule", RULES)
def test_units_do_not_matter(rule: Rule) -> None:
    """The same positions in other units have the same widths in these units."""
    x = draw_agents(100)
    in_unit = bandwidth(x, UNIT, rule=rule, each_axis=True)
    in_box = bandwidth(x * [1000.0, 1.0], BOX, rule=rule)
    assert np.allclose(in_box, in_unit * [1000.0, 1.0], rtol=1e-9)
    # In a box of equal sides one width serves all axes, as before.
    single = bandwidth(x, UNIT, rule=rule)
    assert isinstance(single, float)


@pytest.mark.parametrize("shape", [(1, 2), (5, 2)])
def test_a_width_for_each_axis_is_a_product_of_kernels(shape: tuple[int, ...]) -> None:
    """One axis at a time, by the kernels of a line; also for one width for each agent."""
    x = draw_agents(5)
    h = np.random.default_rng(1).uniform(0.05, 0.2, shape)
    z = kernels(x, UNIT, bandwidth=h)
    widths = np.broadcast_to(h, (5, 2))
    line = Grid((40,))
    first = kernels(x[:, :1], line, bandwidth=widths[:, 0])
    second = kernels(x[:, 1:], line, bandwidth=widths[:, 1])
    expected = (first[:, :, None] * second[:, None, :]).reshape(5, -1)
    assert np.allclose(z, expected, atol=1e-12)
    # The density is the mean of the agents' kernels.
    mean = kernel_density(x, UNIT, bandwidth=h)
    assert np.allclose(mean, z.mean(axis=0), atol=1e-12)


def test_constants_of_kernels_with_a_width_for_each_axis() -> None:
    """The integral of the squared kernel, in both units; and the covariance's mean."""
    h = np.array([[40.0, 0.05]])
    z = kernels([[500.0, 0.5]], BOX, bandwidth=h)[0]
    constant = kernel_constant(BOX, bandwidth=h, agents=1)
    # Cells of half a width take three parts in a hundred off the square.
    assert constant == pytest.approx(float(BOX.norm(z)) ** 2, rel=0.04)
    small = Grid((10, 10), high=[1000.0, 1.0])
    p = np.full(100, 1 / 1000.0)
    mean, cov = kernel_covariance(p, small, bandwidth=[[100.0, 0.1]], agents=4)
    unit_mean, unit_cov = kernel_covariance(
        1000 * p, Grid((10, 10)), bandwidth=0.1, agents=4
    )
    # Densities are per 1000 units of area, and their covariance per 1000².
    assert np.allclose(1000 * mean, unit_mean)
    assert np.allclose(1e6 * cov, unit_cov)
    snapshot = SwarmSnapshot(np.array([[500.0, 0.5]]), BOX, h, 0.0)
    assert np.allclose(snapshot.kernels[0], z)


def test_one_width_that_covers_an_axis_is_warned_of() -> None:
    """Metres along the axis of the radians; what fits is not warned of."""
    x = draw_agents(10) * [1000.0, 1.0]
    with pytest.warns(RuntimeWarning, match="^bandwidth must fit every axis"):
        kernel_density(x, BOX, bandwidth=50.0)
    kernel_density(x, BOX, bandwidth=[[50.0, 0.05]])
    kernel_density(draw_agents(10), UNIT, bandwidth=2.0)
    with pytest.raises(ValueError, match="^grid must have cells no wider"):
        kernel_density(x, BOX, bandwidth=[[50.0, 0.01]])


@pytest.mark.parametrize("step", [0.01, 0.05, 0.1])
@pytest.mark.parametrize("seed", range(3))
def test_rounded_positions_have_the_width_of_exact_ones(step: float, seed: int) -> None:
    """On two clusters, in an L2 error near that of the best width of all."""
    grid = Grid((60, 60))
    rng = np.random.default_rng(seed)
    is_left = rng.random((300, 1)) < 0.5
    centre = np.where(is_left, [0.3, 0.5], [0.7, 0.5])
    x = (centre + 0.08 * rng.normal(size=(300, 2))).clip(0, 1)
    x = np.round(x / step) * step
    true = np.zeros(grid.size)
    for middle in ([0.3, 0.5], [0.7, 0.5]):
        true += 0.5 * norm.pdf(grid.centres, middle, 0.08).prod(axis=-1)

    def error(h: float) -> float:
        return float(grid.norm(kernel_density(x, grid, bandwidth=h) - true))

    h = bandwidth(x, grid, rule="least_squares")
    best = min(error(trial) for trial in np.geomspace(0.01, 0.2, 20))
    assert error(h) < 1.25 * best


def test_strongly_rounded_positions_on_a_line() -> None:
    """A step of half a deviation: the least candidate would show every tie as a peak."""
    line = Grid((200,), low=-5.0, high=5.0)
    x = np.random.default_rng(1).normal(size=(1000, 1)).clip(-5, 5)
    # The width of the positions before they are rounded to halves
    exact = bandwidth(x, line, rule="least_squares")
    true = norm.pdf(line.centres[:, 0])
    rounded = np.round(2 * x) / 2
    h = bandwidth(rounded, line, rule="least_squares")
    assert exact < h < 2 * exact
    estimate = kernel_density(rounded, line, bandwidth=h)
    assert float(line.norm(estimate - true)) < 0.05


def test_agents_in_one_place_are_left_out_together() -> None:
    """Every agent twice at exactly its place: the width of the single ones, roughly."""
    x = draw_agents(150)
    single = bandwidth(x, UNIT, rule="least_squares")
    twice = bandwidth(np.concatenate([x, x]), UNIT, rule="least_squares")
    # A width that saw the copies as a peak would be the smallest one that is tried.
    assert 0.6 * single < twice < 1.7 * single
