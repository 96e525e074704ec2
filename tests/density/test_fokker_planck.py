"""Finite volumes: the generator by hand, the schemes by their definitions, equilibria."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import quad

from distfilt.density import FokkerPlanck, Grid, bernoulli
from distfilt.models import Swarm

SCHEMES = ("split", "backward_euler", "crank_nicolson")


@given(st.floats(-500, 500))
def test_bernoulli_s_function_satisfies_its_identity(z: float) -> None:
    """B(-z) = B(z) + z, and no value is negative, at any Péclet number."""
    assert bernoulli(-z) - bernoulli(z) == pytest.approx(z, abs=1e-11)
    assert bernoulli(z) >= 0


def test_bernoulli_s_function_is_smooth_where_its_series_begins() -> None:
    """On both sides of 1e-4 it has the values of the series."""
    z = np.array([9.99e-5, 1.01e-4])
    # z / (e^z - 1) = 1 - z/2 + z²/12 + O(z⁴)
    series = 1 - z / 2 + z**2 / 12
    assert np.allclose(bernoulli(z), series, rtol=1e-12, atol=0.0)


def test_the_generator_of_four_cells_by_hand() -> None:
    """Rates D B(∓v Δ/D)/Δ² upwards and downwards between neighbours."""
    v = 0.7
    d = 0.2
    h = 0.25
    swarm = Swarm(lambda x, t: v + 0 * x, d, low=[0.0], high=[1.0])
    peclet = v * h / d
    up = float(bernoulli(-peclet)) * d / h**2
    down = float(bernoulli(peclet)) * d / h**2
    # Columns sum to zero: the walls are closed.
    diagonal = np.diag([-up, -up - down, -up - down, -down])
    upwards = np.diag([up] * 3, -1)
    downwards = np.diag([down] * 3, 1)
    expected = diagonal + upwards + downwards
    generator = FokkerPlanck(swarm, Grid((4,))).generator(0.0)
    assert np.allclose(generator.toarray(), expected, atol=1e-13)


def _split_by_axis(generator: np.ndarray, columns: int) -> list[np.ndarray]:
    """Generators of the exchange along axis 0 and along axis 1 of a grid's cells."""
    column = np.arange(len(generator)) % columns
    same_column = np.equal.outer(column, column)
    parts = [
        np.where(same_column, generator, 0.0),
        np.where(same_column, 0.0, generator),
    ]
    # Each part is a generator itself: its columns sum to zero.
    for part in parts:
        np.fill_diagonal(part, 0.0)
        np.fill_diagonal(part, -part.sum(axis=0))
    return parts


@pytest.mark.parametrize("scheme", SCHEMES)
def test_schemes_are_their_definitions(scheme: str) -> None:
    """With dense matrices, for three densities and a drift that depends on time."""

    def drift(x: np.ndarray, t: float) -> np.ndarray:
        first = np.sin(t + x[..., 1])
        second = x[..., 0]
        return np.stack([first, second], axis=-1)

    equation = FokkerPlanck(Swarm(drift, [0.1, 0.3]), Grid((4, 5)), scheme=scheme)
    p = np.random.default_rng(1).random((3, 20))
    t = 0.4
    dt = 0.2
    start = equation.generator(t).toarray()
    end = equation.generator(t + dt).toarray()
    identity = np.eye(20)
    if scheme == "backward_euler":
        # (I - Δ A') p' = p
        expected = np.linalg.solve(identity - dt * end, p.T)
    elif scheme == "crank_nicolson":
        # (I - ½ Δ A') p' = (I + ½ Δ A) p
        explicit = identity + dt / 2 * start
        implicit = identity - dt / 2 * end
        expected = np.linalg.solve(implicit, explicit @ p.T)
    else:
        # (I - Δ A₂') (I - Δ A₁') p' = p with the generators of the axes
        first, second = _split_by_axis(end, 5)
        assert np.allclose(first + second, end)
        expected = np.linalg.solve(identity - dt * first, p.T)
        expected = np.linalg.solve(identity - dt * second, expected)
    error = equation.step(p, t, dt) - expected.T
    assert np.abs(error).max() < 1e-12


def _cell_means(grid: Grid, function: Callable[[float], float]) -> np.ndarray:
    """Means of a function of one coordinate over the cells of axis 0."""
    edges = grid.edges[0]
    cells = zip(edges[:-1], edges[1:], strict=True)
    integrals = [quad(function, a, b)[0] for a, b in cells]
    return integrals / np.diff(edges)


@pytest.mark.parametrize(("n", "bound"), [(30, 0.06), (60, 0.018), (120, 0.005)])
def test_the_stationary_density_of_an_ornstein_uhlenbeck_process(
    n: int, bound: float
) -> None:
    """Of v = -(x - 1/2)/2 with D = 0.003: a Gaussian between walls, with second order in Δ."""
    d = 0.003
    k = 0.5
    grid = Grid((n, n))
    swarm = Swarm(lambda x, t: k * (0.5 - x), d)
    equation = FokkerPlanck(swarm, grid, scheme="backward_euler")

    # The density is the product of exp(-k (x - ½)²/(2 D)) along the axes.
    def profile(s: float) -> float:
        return float(np.exp(-k * (s - 0.5) ** 2 / (2 * d)))

    factor = _cell_means(grid, profile)
    exact = grid.normalize(np.outer(factor, factor).ravel())
    # Until nothing changes any more: 1e4 is many times 1 / k.
    p = equation.evolve(np.ones(grid.size), [50.0, 200.0, 1e4])[-1]
    # Second order: half the cell width nearly quarters the error.
    relative_error = grid.norm(p - exact) / grid.norm(exact)
    assert relative_error < bound


GROWING = Swarm(
    lambda x, t: 0 * x, lambda x, t: 0.1 * (1 + x[..., 0]), low=[0.0], high=[1.0]
)


def test_a_diffusion_that_varies_is_meant_in_the_sense_of_ito() -> None:
    """Without drift D p is constant at rest: p = 1/((1 + x) log 2) for D ∝ 1 + x."""
    grid = Grid((200,))
    equation = FokkerPlanck(GROWING, grid)
    p = equation.evolve(np.ones(200), [50.0, 1000.0])[-1]
    # 0 = (D p)'' between closed walls
    product = p * (1 + grid.centres[:, 0]) * np.log(2)
    assert np.abs(product - 1).max() < 1e-5


def test_times_begin_after_zero() -> None:
    equation = FokkerPlanck(GROWING, Grid((20,)))
    with pytest.raises(ValueError, match="^times must be after t0 = 0"):
        equation.evolve(np.ones(20), [0.0, 50.0])
