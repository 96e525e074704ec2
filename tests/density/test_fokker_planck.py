"""Finite volumes: mass, sign, order, equilibria, and agents beside their density."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import quad

from distfilt.density import FokkerPlanck, Grid, bernoulli
from distfilt.models import Swarm

SCHEMES = ("split", "backward_euler", "crank_nicolson")


@given(st.floats(-500, 500))
def test_bernoulli_identity(z: float) -> None:
    assert bernoulli(-z) - bernoulli(z) == pytest.approx(z, abs=1e-11)
    assert bernoulli(z) >= 0


def test_bernoulli_near_zero_joins_smoothly() -> None:
    z = np.array([9.99e-5, 1.01e-4])
    assert np.allclose(bernoulli(z), 1 - z / 2 + z**2 / 12, rtol=1e-12)


def test_generator_by_hand() -> None:
    v = 0.7
    d = 0.2
    h = 0.25
    line = FokkerPlanck(
        Swarm(lambda x, t: v + 0 * x, d, low=[0.0], high=[1.0]), Grid((4,))
    )
    up, down = (float(bernoulli(s * v * h / d)) * d / h**2 for s in (-1, 1))
    wanted = (
        np.diag([-up, -up - down, -up - down, -down])
        + np.diag([up] * 3, -1)
        + np.diag([down] * 3, 1)
    )
    assert np.allclose(line.generator(0.0).toarray(), wanted, atol=1e-13)


@pytest.mark.parametrize("scheme", SCHEMES)
def test_schemes_are_their_definitions(scheme: str) -> None:
    swarm = Swarm(
        lambda x, t: np.stack([np.sin(t + x[..., 1]), x[..., 0]], axis=-1), [0.1, 0.3]
    )
    grid = Grid((4, 5))
    flow = FokkerPlanck(swarm, grid, scheme=scheme)
    p = np.random.default_rng(1).random((3, 20))
    dt = 0.2
    t = 0.4
    now = flow.generator(t).toarray()
    then = flow.generator(t + dt).toarray()
    eye = np.eye(20)
    if scheme == "backward_euler":
        wanted = np.linalg.solve(eye - dt * then, p.T).T
    elif scheme == "crank_nicolson":
        wanted = np.linalg.solve(eye - dt / 2 * then, (eye + dt / 2 * now) @ p.T).T
    else:
        # The axes' own generators: links within a column of cells, and within a row.
        rows = np.equal.outer(np.arange(20) % 5, np.arange(20) % 5)
        first = np.where(rows, then, 0.0)
        second = np.where(rows, 0.0, then)
        for part in (first, second):
            np.fill_diagonal(part, 0.0)
            np.fill_diagonal(part, -part.sum(axis=0))
        assert np.allclose(first + second, then)
        wanted = np.linalg.solve(eye - dt * first, p.T)
        wanted = np.linalg.solve(eye - dt * second, wanted).T
    assert np.abs(flow.step(p, t, dt) - wanted).max() < 1e-12


@pytest.mark.parametrize(("n", "bound"), [(30, 0.06), (60, 0.018), (120, 0.005)])
def test_ornstein_and_uhlenbeck(n: int, bound: float) -> None:
    """The stationary density of v = -(x - 1/2)/2 with D = 0.003 is a Gaussian between walls."""
    d = 0.003
    k = 0.5
    grid = Grid((n, n))
    flow = FokkerPlanck(
        Swarm(lambda x, t: k * (0.5 - x), d), grid, scheme="backward_euler"
    )
    line = [
        quad(lambda s: np.exp(-k * (s - 0.5) ** 2 / (2 * d)), a, b)[0] / (b - a)
        for a, b in zip(grid.edges[0][:-1], grid.edges[0][1:], strict=True)
    ]
    exact = grid.normalize(np.outer(line, line).ravel())
    p = flow.evolve(np.ones(grid.size), [50.0, 200.0, 1e4])[-1]
    assert grid.norm(p - exact) / grid.norm(exact) < bound


def test_diffusion_that_varies_is_meant_in_the_sense_of_ito() -> None:
    grid = Grid((200,))
    swarm = Swarm(
        lambda x, t: 0 * x, lambda x, t: 0.1 * (1 + x[..., 0]), low=[0.0], high=[1.0]
    )
    p = FokkerPlanck(swarm, grid).evolve(np.ones(200), [50.0, 1000.0])[-1]
    assert np.abs(p * (1 + grid.centres[:, 0]) * np.log(2) - 1).max() < 1e-5
    with pytest.raises(ValueError, match="^times must be after t0 = 0"):
        FokkerPlanck(swarm, grid).evolve(np.ones(200), [0.0, 50.0])
