"""Numbers and sizes just outside what an argument allows, and messages that say what came."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from distfilt import checks, density, ensembles, linalg, mixtures, models, sensors
from distfilt.coupling import ensemble_transform, sorted_plan
from distfilt.kalman import kalman_filter
from distfilt.mixtures import GaussianMixture, PartialFusion, unscented
from distfilt.models import constant_velocity, simulate
from distfilt.network import Channel, Graph, covariance_intersection, graphs, stable_substeps
from distfilt.triangular import affine, pool_by_moments, separable
from distfilt.updates import known_noise

RNG = np.random.default_rng
GRID = density.Grid((8, 8))
PATH = Channel(graphs.path(2))
TWO = GaussianMixture.gaussian([0.0, 0.0], np.eye(2))
ARC = {"angle_std": 0.3, "range_std": 0.3, "ego_std": 0.3}
DRAWN = RNG(0).standard_normal((12, 3))
STEPS = {"F": [[1.0]], "H": [[1.0]], "Q": [[0.1]], "R": [[1.0]]}
BOUNDS: list[tuple[str, Callable[[], object]]] = [
    ("sensitivity: .* -0.5", lambda: density.adaptive_bandwidths(
        [[0.5, 0.5]], GRID, bandwidth=0.2, sensitivity=-0.5)),
    ("sigma: .* -0.1", lambda: models.pendulum(sigma=(0.0, -0.1))),
    ("rate: .* -0.5", lambda: models.angular_acceleration([1.0, 0, 0, 0], [0.1, 0, 0], rate=-0.5)),
    ("dt: .* -0.5", lambda: linalg.van_loan([[0.0]], [[1.0]], -0.5)),
    ("longest: needs at least 1e-07 ", lambda: models.rk4(
        lambda x, t: -x, np.ones(1), 0.0, 1.0, longest=1e-9)),
    ("span: .* -0.5", lambda: mixtures.arc(3, [1.0, 0.0], span=-0.5, **ARC)),
    ("observer: .* -1", lambda: sensors.line_of_sight(std=0.1, observer=-1)),
    ("alpha: .* -0.5", lambda: stable_substeps(PATH, 0.1, alpha=-0.5, a=1.0, b=0.1)),
    ("order: .* -1", lambda: separable.fit(DRAWN[:, :1], DRAWN[:, 1:], order=-1)),
    ("source, target: .* 0, 1", lambda: sorted_plan([], [1.0], [])),
    ("source, target: .* 1, 0", lambda: sorted_plan([1.0], [], [1.0], [])),
    ("marginal: needs dimension 1, got 2", lambda: PartialFusion(
        TWO, TWO.marginal([0])).shapes(terms="all", marginal=TWO)),
    ("F: needs shape .* got \\(3, 1, 1\\)", lambda: kalman_filter(
        [0.0], [[1.0]], np.zeros((4, 1)), **(STEPS | {"F": np.ones((3, 1, 1))}))),
    ("F: needs shape .* got \\(2, 4, 1, 1\\)", lambda: kalman_filter(
        [0.0], [[1.0]], np.zeros((4, 1)), **(STEPS | {"F": np.ones((2, 4, 1, 1))}))),
    ("weights: .* positive own weights .* 0$", lambda: covariance_intersection(
        (np.zeros((2, 1)), np.ones((2, 1, 1))), PATH, weights=[[0.0, 1.0], [1.0, 0.0]])),
    ("x: needs more than 4 members .* 4 variables, got 4", lambda: pool_by_moments(
        DRAWN[:4, :1].reshape(2, 2, 1), DRAWN[:4].reshape(2, 2, 3), PATH)),
    ("x: needs more than 7 members .* got 7", lambda: separable.fit(
        DRAWN[:7, :0], DRAWN[:7, :2], order=2)),
    ("x: needs more than 3 members .* got 3", lambda: separable.fit(
        DRAWN[:3, :0], DRAWN[:3, :2], order=2, regularisation=0.1)),
    ("m: needs at most 2 observations, got 3", lambda: affine.from_moments(
        np.zeros((5, 2)), np.broadcast_to(np.eye(2), (5, 2, 2)), 3)),
    ("times: .* after t0 = 2, got 1", lambda: simulate(
        constant_velocity(sigma=0.1), np.zeros(4), [1.0, 5.0], rng=RNG(0), t0=2.0)),
    ("anomalies_to_avoid: needs at least 2 members, got 1", lambda: ensembles.exact_noise(
        np.ones((1, 3)), np.eye(3), rng=RNG(0))),
    ("ensemble: needs at least 2 members, got 1", lambda: ensembles.sample_covariance(
        np.ones((5, 1, 3)))),
    ("log_weights: .* got only zeros", lambda: ensemble_transform(
        np.zeros((2, 3, 1)), [[-np.inf] * 3, [0.0] * 3])),
    ("uses: .* -1", lambda: separable.fit(DRAWN[:, :1], DRAWN[:, 1:2], order=1, uses=[[-1]])),
    ("bandwidth: .* -0.5", lambda: density.kernel_covariance(
        np.ones(64), GRID, bandwidth=-0.5, agents=10)),
    (r"needs shape \(\), got \(1,\)", lambda: checks.array([1.0], "x", ())),
    ("noise: needs leading axes \\(4,\\), got \\(3,\\)", lambda: known_noise(
        np.tile(DRAWN, (4, 1, 1)), np.tile(DRAWN[:, :1], (4, 1, 1)), np.zeros((4, 1)),
        np.ones((3, 1, 1)), rng=RNG(0))),
    ("noise: needs leading axes \\(3, 2\\), got \\(4, 2\\)", lambda: known_noise(
        np.tile(DRAWN, (3, 2, 1, 1)), np.tile(DRAWN[:, :1], (3, 2, 1, 1)), np.zeros((3, 2, 1)),
        np.ones((4, 2, 1, 1)), rng=RNG(0))),
    ("noise_factor: needs 2 rows, got 1", lambda: unscented.forecast(
        [0.0, 0.0], np.eye(2), lambda x: x, np.ones((1, 3)))),
    ("agents from 0 to 1", lambda: Graph.from_edges(2, [[0, 2]])),
    ("agents from 0 to 1", lambda: Graph.from_edges(2, [[0, 0.5]])),
    ("adjacency: needs zeros and ones, got 7", lambda: Graph.from_adjacency([[0, 7], [1, 0]])),
]  # fmt: skip


@pytest.mark.parametrize(("words", "call"), BOUNDS, ids=[words for words, _ in BOUNDS])
def test_just_outside_is_refused(words: str, call: Callable[[], object]) -> None:
    with pytest.raises(ValueError, match=words):
        call()
