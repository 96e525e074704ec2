"""Valid calls that no doctest makes, of maps, couplings, mixtures, densities and what is beside.

``tests/tools/fuzz.py`` runs this file after the doctests and exchanges the arguments.
"""

from __future__ import annotations

import numpy as np

from distfilt import (
    checks,
    coupling,
    gaussians,
    intervals,
    kalman,
    metrics,
    mixtures,
    progress,
    triangular,
)
from distfilt import density as densities
from distfilt.density.sharing import Seen
from distfilt.models import Swarm
from distfilt.network import Channel, graphs

Array = np.ndarray


def a_line(x: Array) -> Array:
    return np.asarray(x[..., :1] + 2.0 * x[..., 1:])


def a_drift(x: Array, t: float) -> Array:
    return np.asarray(0.1 - x)


def a_drift_in_time(x: Array, t: float) -> Array:
    return np.asarray(0.1 * np.cos(t) - x)


def the_checks() -> None:
    checks.callable_(len, "here")
    checks.nonblank("a text", "here")
    checks.weights([0.5, 0.5], "here")
    for find in (intervals.mean_interval, intervals.median_interval):
        find(np.array([2.0, 1.0, 4.0, 3.0, 7.0, 5.5, 8.0]), level=0.9)
    intervals.proportion_interval(3, 10, level=0.9)
    intervals.Interval(0.25, 0.15, 0.375, 0.06)


def the_maps() -> None:
    rng = np.random.default_rng(0)
    x = rng.standard_normal((40, 2))
    y = x[:, :1] + 0.1 * rng.standard_normal((40, 1))
    for fitted in (triangular.affine.fit(y, x), triangular.separable.fit(y, x, order=1)):
        z = fitted(y, x)
        fitted.inverse(y, z)
        fitted.inverse(y[0], z)
        fitted.log_det(y, x)
    triangular.affine.fit_convex(y, x, solver="ECOS", max_iters=100)
    triangular.separable.fit(y, x, order=(1, 2), uses=[[0], [0, 1]], regularisation=0.1)


def the_couplings() -> None:
    found = coupling.plan([[1.0, 0.0], [0.0, 1.0]], [0.5, 0.5])
    coupling.Plan(found.matrix, found.value, found.potentials, found.bound)
    for slope in (None, lambda x: np.tile([1.0, 2.0], (*x.shape[:-1], 1, 1))):
        line = coupling.Constraint(a_line, [1.0], derivative=slope)
        line.residual([[0.25, 1.5], [2.0, 0.5]])
        line.jacobian([[0.25, 1.5], [2.0, 0.5]])


def the_options() -> None:
    """Options that examples leave out."""
    x, y = np.array([[0.0], [1.0]]), np.array([[0.5], [2.0], [3.0]])
    coupling.distances(x, y, power=1.0)
    coupling.plan(coupling.distances(x, y), [0.5, 0.5], [0.25, 0.5, 0.25])
    coupling.sorted_plan([0.0, 1.0], [0.5, 2.0], [0.5, 0.5], [0.25, 0.75])
    metrics.crps(np.array([[1.0], [2.0], [4.0]]), [2.5], weights=[0.25, 0.25, 0.5])
    metrics.rmse(np.ones((3, 4, 2)), np.zeros((3, 4, 2)), axis=-1)
    metrics.rmse(np.ones((3, 4, 2)), np.zeros((3, 4, 2)), axis=(0, 1))
    covs = np.array([[[2.0]], [[1.0]], [[0.5]]])
    gaussians.intersection_weights(covs, rule="trace", here=[True, False, True])
    progress.track([1, 2], show=False, total=2)
    two = mixtures.GaussianMixture([0.5, 0.5], [[-2.0], [2.0]], [[[1.0]], [[1.0]]])
    mixtures.conditioned(two, [1.0], np.asarray, [[1.0]])
    mixtures.fuse(two, two, size=1)
    three = mixtures.Shapes([[0.0], [1e-6], [9.0]], [[[1.0]]] * 3, [0, 0, 0])
    mixtures.pivoted_qr(three, size=2)
    mixtures.stretching([[[2.0]]], [[[0.5]]], scale=[3.0])
    mixtures.conditioned(two, [2.0], np.asarray, [[1.0]], residual=np.subtract, rule="dd2")


def the_processes() -> None:
    mean, q = np.zeros(2), np.array([[0.1], [0.2]])
    dense = densities.Dense(mean, np.eye(2))
    densities.dense_step(dense, np.asarray, [1.0, 1.0], [1.0, 3.0], 1.0, process=q)
    each = densities.low_rank_start(np.eye(2), np.zeros((1, 2)))
    moved = densities.low_rank_moved(each, np.asarray, process=q, dt=1.0)
    densities.low_rank_step(moved, [[1.0, 1.0]], [1.0, 3.0], 1.0)


def the_grids() -> None:
    grid = densities.Grid((4, 6), low=[0.0, 0.0], high=[1.0, 1.5])
    values = 1.0 + np.arange(24.0) / 24
    places = np.array([[0.2, 0.3], [0.9, 1.4], [0.5, 0.75]])
    grid.norm(values)
    grid.normalised(values)
    grid.integral(values)
    grid.cells(places)
    grid.histogram(places)
    grid.at(values, places)
    grid.aggregated(values, densities.Grid((2, 3), low=[0.0, 0.0], high=[1.0, 1.5]))
    grid.wavenumbers(5)
    grid.cosines(5)


def the_flows() -> None:
    grid = densities.Grid((4, 5))
    values = np.ones(20)
    for scheme in ("split", "backward_euler", "crank_nicolson"):
        flow = densities.FokkerPlanck(Swarm(a_drift_in_time, 0.05), grid, scheme=scheme)
        flow.rates(0.5)
        flow.generator(0.5)
        flow.solver(0.5, 0.1)
        flow.step(values, 0.5, 0.1)
        flow.evolve(values, [0.5, 1.0], t0=0.25, substeps=2)
    state = densities.LowRank(np.eye(3)[:, :2], np.ones((2, 3)), np.tile(np.eye(2), (2, 1, 1)),
                             np.ones((2, 2)))  # fmt: skip
    state.covariance(1)


def the_sharing() -> None:
    grid = densities.Grid((5, 5))
    positions = np.array([[0.2, 0.3], [0.8, 0.7], [0.5, 0.5]])
    seen = Seen(positions, grid, 0.2, 0.0)
    for rule in (
        densities.Centralised(), densities.Neighbours(), densities.Flooding(),
        densities.PIConsensus(modes=4, first_std=0.3, rate=True),
        densities.DynamicAverage(modes=4),
    ):  # fmt: skip
        rule.learn(rule.begin(seen), seen, Channel(graphs.path(3)), 0.5)


def the_mixtures() -> None:
    own = mixtures.GaussianMixture(
        [0.4, 0.6], [[0.0, 1.0], [2.0, -1.0]], [[[2.0, 0.5], [0.5, 1.0]], [[1.0, 0.2], [0.2, 1.0]]]
    )
    heard = mixtures.GaussianMixture([0.5, 0.5], [[1.0], [2.0]], [[[1.0]], [[2.0]]])
    points = np.array([[0.5, 0.25], [1.5, -0.5], [0.1, 2.0]])
    own.component_log_densities(points)
    own.log_density(points)
    own.collapsed()
    own.quadratics()
    own.rvs(5, rng=np.random.default_rng(1))
    own.marginal([1])
    mixtures.GaussianMixture.unpack(own.pack())
    narrow = mixtures.GaussianMixture([0.5, 0.5], [[1.0], [2.0]], [[[0.5]], [[0.8]]])
    fusion = mixtures.PartialFusion(own, [heard, heard], omega=[0.4, 0.3, 0.3])
    fusion.log_target(points[:, :1])
    fusion.log_update(points[:, :1])
    fusion.log_value(points)
    shapes = fusion.shapes(terms="all")
    fusion.shapes(terms="all", form="literal", marginal=narrow, received=[heard, heard])
    fusion.weigh(shapes, rule="C2", at_most=3)
    fusion.weigh(shapes)
    fusion.approximation(size=3)


def the_runs() -> None:
    run = kalman.kalman_filter(
        [0.0], [[1.0]], [[2.0], [1.0]], F=[[1.0]], H=[[1.0]], Q=[[0.5]], R=[[1.0]]
    )
    kalman.GaussianRun(run.means, run.covariances, run.log_likelihood)


for calls in (
    the_checks, the_maps, the_couplings, the_options, the_processes, the_grids, the_flows,
    the_sharing, the_mixtures, the_runs,
):  # fmt: skip
    calls()
