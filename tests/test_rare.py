"""Rare cases: far from the origin, very sharp, without weight, silent, too many."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest

from distfilt import density, filters, models, network, updates
from distfilt.filters import InformationIncrementFilter
from distfilt.gaussians import intersect_gaussians
from distfilt.mixtures import GaussianMixture, PartialFusion, fuse_mixtures
from distfilt.mixtures.conditioning import within_gate
from distfilt.mixtures.reduction import merge_irrelevant
from distfilt.network import Channel, Faults, Graph, graphs
from distfilt.sensors import Sensor, component, distance, stack
from distfilt.triangular import affine, compose
from distfilt.updates.particles import distinct_fraction
from tests.filters.families import still_model

# Orthogonal directions: SHARP has the standard deviations 100 and 1e-4 along them.
U, V = np.array([[1.0, 1.0], [1.0, -1.0]]) / np.sqrt(2)
SHARP = 1e4 * np.outer(U, U) + 1e-8 * np.outer(V, V)


def test_a_received_belief_may_be_a_million_times_sharper() -> None:
    covs = [1e4 * np.eye(2), np.eye(2)]
    prior = GaussianMixture([0.99, 0.01], np.zeros((2, 2)), covs)
    received = GaussianMixture.gaussian([0.0, 0.0], SHARP)
    shapes = PartialFusion(prior, received).component_shapes()
    assert shapes.dropped == 0
    wide = GaussianMixture.gaussian([0.0, 0.0], 1e4 * np.eye(2))
    fused = fuse_mixtures(wide, received).cov
    # Exponents of ½: P⁻¹ = ½ (1e-4 + 1e-4) along U, and ½ · 1e8 along V.
    variances = [U @ fused @ U, V @ fused @ V]
    assert np.allclose(variances, [1e4, 2e-8], rtol=1e-3)


def test_a_first_source_without_weight_has_no_influence() -> None:
    # The first source defines the coordinates of the solution, even with weight zero.
    far = np.full(2, 7e6)
    wide = SHARP + 3e-8 * np.outer(V, V)
    means = [far, far + 10 * U, far - 10 * U]
    covs = [np.full((2, 2), np.nan), SHARP, wide]
    mean, cov = intersect_gaussians(means, covs, [0.0, 0.5, 0.5])
    other = intersect_gaussians(means[::-1], covs[::-1], [0.5, 0.5, 0.0])
    assert np.abs(mean - far).max() < 1e-3
    assert np.allclose(cov, other[1], rtol=1e-6)


def test_mixture_components_and_weights_at_their_limits() -> None:
    # The component at 100 has no weight.
    means = [[0.0], [8.0], [9.0], [100.0]]
    mixture = GaussianMixture([0.5, 0.3, 0.2, 0.0], means, [[[1.0]]] * 4)
    other = GaussianMixture.gaussian([1.2], [[1.0]])
    merged = merge_irrelevant(mixture, other, threshold=3.0)
    # (0.3 · 8 + 0.2 · 9) / 0.5 = 8.4
    weighted_means = merged.means[merged.weights > 0]
    assert np.allclose(sorted(weighted_means[:, 0]), [0.0, 8.4])
    # It opens no gate, either.
    gated = partial(within_gate, function=lambda x: x, noise=np.eye(1), gate=3.0)
    assert np.isnan(gated(mixture, np.array([100.0])))
    # The number of components is limited even where ω = 1 leaves nothing to fuse.
    fused = fuse_mixtures(mixture, mixture.marginal([0]), omega=1.0, n_components=2)
    assert fused.n_components == 2
    # 7 · float32(1 / 7) is not 1 to the accuracy of float64.
    weights = np.full(7, 1 / 7, np.float32)
    with pytest.raises(ValueError, match="must sum to 1 up to 1e-9, .* 4.5e-08 off"):
        GaussianMixture(weights, np.zeros((7, 1)), np.ones((7, 1, 1)))
    # A received payload is copied, and stays writeable.
    parts = np.ones(1), np.zeros((1, 1)), np.ones((1, 1))
    assert GaussianMixture.unpack(parts).weights is not parts[0]
    assert parts[1].flags.writeable


def test_increments_wait_while_an_agent_is_silent_or_they_are_tiny() -> None:
    silence = Faults(silent=[0], during=[(0.5, 1.5)])
    make = partial(
        InformationIncrementFilter,
        still_model(1),
        graph=graphs.path(2),
        target_dim=1,
    )
    # An observation of 3 while its agent is silent is sent in the next step.
    f = make([component([0], std=1.0)] * 2, faults=silence)
    state = f.start(([0.0], [[1.0]]))
    state = f.step(state, 1.0, [[3.0], None])
    state = f.step(state, 2.0, [None, None])
    means = [m.mean[0] for m in state.mixtures]
    assert np.allclose(means, 1.5)
    # Increments of 1e-6 each add up to P = 1 / (1 + 8 / σ²) but for the last one.
    f = make([component([0], std=1005.0)] * 2)
    state = f.start(([0.0], [[1.0]]))
    for t in range(1, 9):
        state = f.step(state, float(t), [[0.0], None])
    expected = 1 / (1 + 8 / 1005**2)
    assert abs(state.mixtures[1].cov[0, 0] - expected) < 1.1e-6


def test_maps_of_many_ensembles_tell_members_from_observations() -> None:
    y, x = np.random.default_rng(0).standard_normal((2, 4, 50, 1))
    s = affine.fit(y, x)
    one = affine.fit(y[0], x[0])
    observed = np.arange(4.0)[:, None]
    # Four maps at the same four points: as many points as maps
    points = (y[0, :4], x[0, :4])
    singles = [affine.fit(y[k], x[k]) for k in range(4)]
    values = np.stack([single(*points) for single in singles])
    assert np.allclose(s(*points), values, atol=1e-12)
    # One map, and as many observations as members
    composed = compose(one, y[:, :4], x[:, :4], observed)
    expected = compose(one, y[2, :4], x[2, :4], observed[2])
    assert np.allclose(composed[2], expected, atol=1e-12)
    # The gain of samples of size 1e-9 is the same.
    solved = affine.fit_convex(1e-9 * y[0], 1e-9 * x[0], solver="CLARABEL")
    assert np.allclose(solved.gain, one.gain, atol=1e-4)


def test_derivatives_far_from_the_origin_and_of_small_things() -> None:
    for size, far in ((1.0, [4e6, 3e6]), (1e-6, [0.0, 0.0])):
        position = np.array(far) + size * np.array([6.0, 8.0])

        def length(x: np.ndarray, origin: list[float] = far) -> np.ndarray:
            return np.linalg.norm(x - origin, axis=-1, keepdims=True)

        # Differences of a distance of 10 at 5e6, and of one of 1e-5
        sensor = Sensor(1, length, [[1.0]])
        expected = distance([0, 1], std=1.0, origin=far).jacobian(position)
        error = sensor.jacobian(position) - expected
        assert np.abs(error).max() < 1e-4
    wrong = Sensor(1, lambda x: x[..., :1], [[1.0]], linear=lambda d: np.eye(d)[1:2])
    with pytest.raises(ValueError, match="linear must return the matrix of h"):
        wrong.H(2)


def test_networks_that_are_uneven_silent_or_without_a_link() -> None:
    # A hub with 20 links: the eigenvalues lie too close for the product of gains.
    spokes = [(0, i) for i in range(1, 21)]
    rim = [(i, i + 1) for i in range(1, 20)]
    channel = Channel(Graph.from_edges(21, spokes + rim))
    with pytest.raises(ValueError, match="rounding"):
        network.finite_time_consensus(np.zeros((21, 1)), channel)
    # A message does not change with the sender's array.
    x = np.array([[0.0], [3.0], [6.0]])
    inboxes = Channel(graphs.path(3)).broadcast(list(x))
    x += 1
    assert inboxes[1][0] == 0.0
    # Agent 0 is silent, which leaves the link between 1 and 2, there and back.
    nested = Faults(seed=2, others=(Faults(seed=1) | Faults(silent=[0]),))
    assert nested.active_links(graphs.path(3)).sum() == 2
    # Without links and without α nothing limits the step.
    unlinked = Channel(Graph.from_edges(3, np.zeros((0, 2))))
    substeps = network.stable_substeps(unlinked, 0.1, alpha=0.0, a=0.4, b=0.04)
    assert substeps == 1


def test_swarms_and_particles_that_begin_oddly() -> None:
    x = np.random.default_rng(0).random((4, 2))
    start = np.where(np.arange(4)[:, None] == 2, np.nan, x)
    # Agent 2 is absent.
    grid = density.Grid((9, 9))
    equation = density.FokkerPlanck(models.rotating_swarm(), grid)
    f = filters.DensityFilter(
        equation,
        4,
        2.0,
        fusion=density.Flooding(),
        bandwidth=0.15,
        rank=9,
        initial_density="observed",
    )
    estimates = f.start(start).estimates
    assert np.allclose(grid.integral(estimates), 1.0)
    # B(z) = z / (e^z - 1) tends to -z, where e^z underflows.
    assert np.allclose(density.bernoulli([-1000.0, -5000.0]), [1000.0, 5000.0])
    # Members that differ in one component only are distinct.
    members = np.stack([np.zeros(9), np.arange(9)], axis=-1)
    assert distinct_fraction(members) == 1.0


def test_serial_observations_meet_new_predictions_within_a_wrapper() -> None:
    serial = updates.serially(partial(updates.etkf, rotation="none"))
    origins = ([0.0, 0.0], [3.0, 0.0], [0.0, 3.0])
    sensors = [distance([0, 1], std=0.1, origin=origin) for origin in origins]
    model = still_model(2)
    # An inflation by 1 and a partial without options change nothing.
    inflated = updates.with_inflation(serial, factor=1.0)
    results = []
    for update in (serial, inflated, partial(serial)):
        f = filters.EnsembleFilter(model, [stack(sensors)], update=update, members=50)
        state = f.start((np.zeros(2), np.eye(2)), rng=np.random.default_rng(0))
        state = f.step(state, 1.0, [[1.4, 2.2, 2.2]])
        results.append(state.ensembles)
    assert np.allclose(results[1], results[0])
    assert np.array_equal(results[2], results[0])
