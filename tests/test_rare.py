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

U, V = np.array([[1.0, 1.0], [1.0, -1.0]]) / np.sqrt(2)
SHARP = 1e4 * np.outer(U, U) + 1e-8 * np.outer(V, V)
STILL, PLANE = (
    models.Model(d, lambda x, t, dt: x, lambda t, dt, d=d: np.zeros((d, d)))
    for d in (1, 2)
)


def test_a_received_belief_may_be_a_million_times_sharper() -> None:
    prior = GaussianMixture(
        [0.99, 0.01], np.zeros((2, 2)), [1e4 * np.eye(2), np.eye(2)]
    )
    received = GaussianMixture.gaussian([0.0, 0.0], SHARP)
    assert PartialFusion(prior, received).component_shapes().dropped == 0
    fused = fuse_mixtures(
        GaussianMixture.gaussian([0.0, 0.0], 1e4 * np.eye(2)), received
    ).cov
    assert np.allclose([U @ fused @ U, V @ fused @ V], [1e4, 2e-8], rtol=1e-3)


def test_a_first_source_without_weight_has_no_influence() -> None:
    # The first source defines the coordinates of the solution, even with weight zero.
    far = np.full(2, 7e6)
    wide = SHARP + 3e-8 * np.outer(V, V)
    means = [far, far + 10 * U, far - 10 * U]
    covs = [np.full((2, 2), np.nan), SHARP, wide]
    mean, cov = intersect_gaussians(means, covs, [0.0, 0.5, 0.5])
    other = intersect_gaussians(means[::-1], covs[::-1], [0.5, 0.5, 0.0])
    assert np.abs(mean - far).max() < 1e-3 and np.allclose(cov, other[1], rtol=1e-6)


def test_mixture_components_and_weights_at_their_limits() -> None:
    ghost = GaussianMixture(
        [0.5, 0.3, 0.2, 0.0], [[0.0], [8.0], [9.0], [100.0]], [[[1.0]]] * 4
    )
    merged = merge_irrelevant(
        ghost, GaussianMixture.gaussian([1.2], [[1.0]]), threshold=3.0
    )
    assert np.allclose(sorted(merged.means[merged.weights > 0][:, 0]), [0.0, 8.4])
    gated = partial(within_gate, function=lambda x: x, noise=np.eye(1), gate=3.0)
    assert np.isnan(gated(ghost, np.array([100.0])))
    assert (
        fuse_mixtures(
            ghost, ghost.marginal([0]), omega=1.0, n_components=2
        ).n_components
        == 2
    )
    with pytest.raises(ValueError, match=r"must sum to 1, got 1\.00000"):
        GaussianMixture(
            np.full(7, 1 / 7, np.float32), np.zeros((7, 1)), np.ones((7, 1, 1))
        )
    parts = np.ones(1), np.zeros((1, 1)), np.ones((1, 1))
    assert (
        GaussianMixture.unpack(parts).weights is not parts[0]
        and parts[1].flags.writeable
    )


def test_news_wait_while_the_radio_is_off_or_there_is_too_little_to_say() -> None:
    off = Faults(silent=[0], during=[(0.5, 1.5)])
    make = partial(
        InformationIncrementFilter, STILL, graph=graphs.path(2), target_dim=1
    )
    f = make([component([0], std=1.0)] * 2, faults=off)
    state = f.start(([0.0], [[1.0]]))
    for t in (1.0, 2.0):
        state = f.step(state, t, [[3.0] if t == 1 else None, None])
    assert np.allclose([m.mean[0] for m in state.mixtures], 1.5)
    f = make([component([0], std=1005.0)] * 2)
    state = f.start(([0.0], [[1.0]]))
    for t in range(1, 9):
        state = f.step(state, float(t), [[0.0], None])
    assert abs(state.mixtures[1].cov[0, 0] - 1 / (1 + 8 / 1005**2)) < 1.1e-6


def test_maps_of_many_ensembles_tell_members_from_observations() -> None:
    y, x = np.random.default_rng(0).standard_normal((2, 4, 50, 1))
    s = affine.fit(y, x)
    one = affine.fit(y[0], x[0])
    aim = np.arange(4.0)[:, None]
    each = np.stack([affine.fit(y[k], x[k])(y[0, :4], x[0, :4]) for k in range(4)])
    assert np.allclose(s(y[0, :4], x[0, :4]), each, atol=1e-12)
    composed = compose(one, y[:, :4], x[:, :4], aim)
    assert np.allclose(
        composed[2], compose(one, y[2, :4], x[2, :4], aim[2]), atol=1e-12
    )
    solved = affine.fit_convex(1e-9 * y[0], 1e-9 * x[0], solver="CLARABEL")
    assert np.allclose(solved.gain, one.gain, atol=1e-4)


def test_derivatives_far_from_the_origin_and_of_small_things() -> None:
    for size, far in ((1.0, [4e6, 3e6]), (1e-6, [0.0, 0.0])):
        position = np.array(far) + size * np.array([6.0, 8.0])
        see = Sensor(
            1, lambda x, p=far: np.linalg.norm(x - p, axis=-1, keepdims=True), [[1.0]]
        )
        want = distance([0, 1], std=1.0, origin=far).jacobian(position)
        assert np.abs(see.jacobian(position) - want).max() < 1e-4
    wrong = Sensor(1, lambda x: x[..., :1], [[1.0]], linear=lambda d: np.eye(d)[1:2])
    with pytest.raises(ValueError, match="linear must return the matrix of h"):
        wrong.H(2)


def test_networks_that_are_uneven_silent_or_without_a_link() -> None:
    # A hub with 20 links: the eigenvalues lie too close for the product of gains.
    hub = [(0, i) for i in range(1, 21)] + [(i, i + 1) for i in range(1, 20)]
    with pytest.raises(ValueError, match="rounding"):
        network.finite_time_consensus(
            np.zeros((21, 1)), Channel(Graph.from_edges(21, hub))
        )
    x = np.array([[0.0], [3.0], [6.0]])
    box = Channel(graphs.path(3)).broadcast(list(x))
    x += 1
    assert box[1][0] == 0.0
    nested = Faults(seed=2, others=(Faults(seed=1) | Faults(silent=[0]),))
    assert nested.active_links(graphs.path(3)).sum() == 2
    none = Channel(Graph.from_edges(3, np.zeros((0, 2))))
    assert network.stable_substeps(none, 0.1, alpha=0.0, a=0.4, b=0.04) == 1


def test_swarms_and_particles_that_begin_oddly() -> None:
    x = np.random.default_rng(0).random((4, 2))
    start = np.where(np.arange(4)[:, None] == 2, np.nan, x)
    box = density.Grid((9, 9))
    flow = density.FokkerPlanck(models.rotating_swarm(), box)
    f = filters.DensityFilter(
        flow,
        4,
        2.0,
        fusion=density.Flooding(),
        bandwidth=0.15,
        rank=9,
        initial_density="observed",
    )
    assert np.allclose(box.integral(f.start(start).estimates), 1.0)
    assert np.allclose(density.bernoulli([-1000.0, -5000.0]), [1000.0, 5000.0])
    assert distinct_fraction(np.stack([np.zeros(9), np.arange(9)], axis=-1)) == 1.0


def test_readings_in_turn_meet_new_predictions_within_a_wrapper() -> None:
    serial = updates.serially(partial(updates.etkf, rotation="none"))
    eyes = [
        distance([0, 1], std=0.1, origin=o)
        for o in ([0.0, 0.0], [3.0, 0.0], [0.0, 3.0])
    ]
    after = []
    for update in (serial, updates.with_inflation(serial, factor=1.0), partial(serial)):
        f = filters.EnsembleFilter(PLANE, [stack(eyes)], update=update, members=50)
        state = f.start((np.zeros(2), np.eye(2)), rng=np.random.default_rng(0))
        after.append(f.step(state, 1.0, [[1.4, 2.2, 2.2]]).ensembles)
    assert np.allclose(after[1], after[0]) and np.array_equal(after[2], after[0])
