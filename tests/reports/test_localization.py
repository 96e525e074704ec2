"""Localisation that holds for correlated noise, lost observations and any network.

| Report | Situation |
|---|---|
| GEOS-ESM/swell 705 | noise that is correlated, if only by rounding |
| equinor/ert 6262 | observations without a value: the numbers no longer fit |
| equinor/semeio 542 | all observations of a group are absent |
| equinor/iterative_ensemble_smoother 267 | observations paired with other ones' places |
| gher-uliege/DIVAnd.jl 69 | a coordinate that returns (longitude) beside one that does not |
| CliMA/ClimaAnalysis.jl 163 | positions on both sides of the cut of the longitude |
| own | an array of places on a network that is not complete |
| own | maps, with correlated observations in different places |
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
import pytest

from distfilt import updates
from distfilt.filters import EnsembleFilter
from distfilt.network import Faults, graphs
from distfilt.sensors import component
from distfilt.updates.wrappers import gaspari_cohn
from tests.filters.families import still_model

ETKF = partial(updates.etkf, rotation="none")
"""An update that draws nothing."""
UPDATES = {
    "etkf": ETKF,
    "enkf_exact": updates.enkf_exact,
    "with_inflation": updates.with_inflation(ETKF, factor=1.0),
}


def draw(seed: int, *shape: int) -> np.ndarray:
    """Return standard normal numbers."""
    return np.random.default_rng(seed).normal(size=shape)


def gain_by_matrices(
    x: np.ndarray, places: np.ndarray, radius: float, r: np.ndarray
) -> np.ndarray:
    """Return the gain of direct observations from the sample covariance times the taper."""
    # K = (ρ ∘ P) (ρ ∘ P + R)⁻¹, as H is the identity
    distance = np.linalg.norm(places[:, None] - places, axis=-1)
    covariance = gaspari_cohn(distance / radius) * np.cov(x.T)
    return covariance @ np.linalg.inv(covariance + r)


@pytest.mark.parametrize("correlation", [0.0, 1e-16, 1e-12, 0.05, 0.5, -0.9])
@pytest.mark.parametrize("name", UPDATES)
def test_correlated_noise_does_not_switch_localisation_off(
    name: str, correlation: float
) -> None:
    """The mean moves as by the tapered covariance, which is diagonal for far components."""
    x = draw(5, 8, 2)
    places = np.array([[0.0], [100.0]])
    r = 0.25 * np.array([[1.0, correlation], [correlation, 1.0]])
    innovation = np.array([0.0, 5.0])
    local = updates.with_localization(
        UPDATES[name], places=places, observation_places=places, radius=1.0
    )
    y = x.mean(axis=0) + innovation
    analysis = local(x, x, y, r, rng=np.random.default_rng(0))
    expected = gain_by_matrices(x, places, 1.0, r) @ innovation
    assert np.allclose(analysis.mean(axis=0) - x.mean(axis=0), expected, atol=1e-10)


def test_rounding_in_the_noise_changes_nothing() -> None:
    """Also for an update that is not by a gain."""
    x = draw(5, 30, 2)
    places = [[0.0], [1.5]]
    # A transport has no gain; its predictions are made again after each observation.
    local = updates.with_localization(
        updates.etpf, places=places, observation_places=places, radius=1.0
    )
    means = []
    for correlation in (0.0, 1e-14):
        r = np.array([[1.0, correlation], [correlation, 1.0]])
        options: dict[str, Any] = {"predict": lambda e: e}
        after = local(x, x, [0.5, 0.2], r, rng=np.random.default_rng(0), **options)
        means.append(after)
    assert np.abs(means[0] - means[1]).max() < 1e-9


def test_whitened_observations_are_near_the_joint_update() -> None:
    """At random places, for strong correlations: within the error of going one by one."""
    errors = []
    for seed in range(10):
        x = draw(seed, 400, 4)
        places = 4 * np.random.default_rng(seed).random((4, 2))
        root = draw(seed + 100, 4, 4)
        r = 0.3 * root @ root.T + 0.1 * np.eye(4)
        innovation = 2 * draw(seed + 200, 4)
        local = updates.with_localization(
            ETKF, places=places, observation_places=places, radius=1.5
        )
        y = x.mean(axis=0) + innovation
        moved = local(x, x, y, r, rng=np.random.default_rng(0)) - x
        expected = gain_by_matrices(x, places, 1.5, r) @ innovation
        error = np.linalg.norm(moved.mean(axis=0) - expected)
        errors.append(error / np.linalg.norm(expected))
    assert np.mean(errors) < 0.1


def test_a_missing_one_of_correlated_observations_is_left_out() -> None:
    """The other is assimilated with its own variance; without any nothing changes."""
    x = np.broadcast_to(draw(1, 10, 2), (3, 10, 2))
    places = np.array([[0.0], [1.0]])
    r = np.array([[1.0, 0.5], [0.5, 1.0]])
    local = updates.with_localization(
        ETKF, places=places, observation_places=places, radius=1.0
    )
    y = np.array(
        [
            [1.0, 2.0],
            [np.nan, 2.0],
            [np.nan, np.nan],
        ]
    )
    # Three ensembles: with both observations, with the second one, without any
    after = updates.with_missing(local, x, x, y, r, rng=np.random.default_rng(0))
    single = updates.with_localization(
        ETKF, places=places, observation_places=places[1:], radius=1.0
    )
    expected = single(x[1], x[1, :, 1:], [2.0], [[1.0]], rng=np.random.default_rng(0))
    assert np.allclose(after[1], expected, atol=1e-12)
    assert (after[2] == x[2]).all()
    joint = local(x[0], x[0], y[0], r, rng=np.random.default_rng(0))
    assert np.allclose(after[0], joint, atol=1e-12)


@pytest.mark.parametrize("missing", [0, 1, 2])
def test_of_three_correlated_observations_one_may_be_missing(missing: int) -> None:
    """It is as if the sensor had the other two alone, with their own correlation."""
    x = draw(1, 10, 3)
    places = np.array([[0.0], [0.8], [1.5]])
    r = np.array([[1.0, 0.6, 0.3], [0.6, 1.5, 0.7], [0.3, 0.7, 2.0]])
    y = np.array([1.0, 2.0, -1.0])
    present = np.delete(np.arange(3), missing)
    y[missing] = np.nan
    local = updates.with_localization(
        ETKF, places=places, observation_places=places, radius=1.0
    )
    after = updates.with_missing(local, x, x, y, r, rng=np.random.default_rng(0))
    without = updates.with_localization(
        ETKF, places=places, observation_places=places[present], radius=1.0
    )
    block = r[np.ix_(present, present)]
    rng = np.random.default_rng(0)
    expected = without(x, x[:, present], y[present], block, rng=rng)
    assert np.allclose(after, expected, atol=1e-12)


def test_each_axis_has_its_period() -> None:
    """On a cylinder: 359 degrees are near 1 degree, the heights 0 and 359 are far apart."""
    x = draw(2, 12, 3)
    places = np.array([[359.0, 0.0], [1.0, 359.0], [180.0, 0.0]])
    local = updates.with_localization(
        ETKF,
        places=places,
        observation_places=[[1.0, 0.0]],
        radius=2.0,
        period=[360.0, np.nan],
    )
    after = local(x, x[:, :1], [1.0], [[0.5]], rng=np.random.default_rng(0))
    untapered = ETKF(x, x[:, :1], [1.0], [[0.5]], rng=np.random.default_rng(0))
    # At 2 degrees of a radius of 2 the taper is 5/24; the others are 359 and 179 away.
    rho = np.array([5 / 24, 0.0, 0.0])
    assert np.allclose(after - x, rho * (untapered - x), atol=1e-12)
    with pytest.raises(ValueError, match="^period must be positive"):
        updates.with_localization(
            ETKF,
            places=places,
            observation_places=places,
            radius=2.0,
            period=[360.0, -1.0],
        )


STILL = still_model(4)
SENSORS = [component([k], std=1.0) for k in range(4)]
PLACES = 10.0 * np.arange(4.0)[:, None]


def local_filter(places: Any, graph: Any, **options: Any) -> EnsembleFilter:
    """Return a network of four, each of which observes a component far from the others."""
    update = updates.with_localization(
        options.pop("update", ETKF),
        places=PLACES,
        observation_places=places,
        radius=1.0,
    )
    return EnsembleFilter(STILL, SENSORS, graph, update=update, members=10, **options)


BY_SENSOR = {sensor: PLACES[k] for k, sensor in enumerate(SENSORS)}


@pytest.mark.parametrize("by_function", [False, True])
def test_places_of_sensors_on_a_ring(by_function: bool) -> None:
    """Each agent's components change where it receives an observation, and as if alone."""
    places: Any = BY_SENSOR
    if by_function:
        places = lambda sensor: BY_SENSOR[sensor]  # noqa: E731
    f = local_filter(places, graphs.ring(4))
    state = f.start((np.zeros(4), np.eye(4)), rng=np.random.default_rng(0))
    after = f.step(state, 0.0, [[3.0], [np.nan], [1.0], [2.0]])
    y = np.array([3.0, 0.0, 1.0, 2.0])
    # Agent i of the ring hears i - 1 and i + 1; agent 1's observation is missing.
    receives = np.array(
        [
            [1, 0, 0, 1],
            [1, 0, 1, 0],
            [0, 0, 1, 1],
            [1, 0, 1, 1],
        ]
    )
    for agent in range(4):
        x = state.ensembles[agent]
        mean = x.mean(axis=0)
        variance = x.var(axis=0, ddof=1)
        # Far components are independent: the scalar Kalman filter for each.
        gain = variance / (variance + 1)
        expected = mean + receives[agent] * gain * (y - mean)
        assert np.allclose(after.ensembles[agent].mean(axis=0), expected, atol=1e-12)


def test_lost_observations_keep_the_places_of_the_others() -> None:
    """Over many runs with losses, a component changes just if its observation came."""
    f = local_filter(BY_SENSOR, graphs.ring(4), faults=Faults(loss=0.5))
    state = f.start((np.zeros(4), np.eye(4)), runs=(20,), rng=np.random.default_rng(0))
    after = f.step(state, 0.0, [[3.0], [2.0], [1.0], [2.0]])
    changed = (after.ensembles != state.ensembles).any(axis=-2)
    # By run, agent and component, which is the agent's that observes it
    of_itself = changed[:, range(4), range(4)]
    of_opposite = changed[:, range(4), [2, 3, 0, 1]]
    of_neighbour = changed[:, range(4), [1, 2, 3, 0]]
    assert of_itself.all()
    assert not of_opposite.any()
    # Half of 80 messages are lost on average, with a deviation of 0.056 in the share.
    assert 0.3 < of_neighbour.mean() < 0.7
    # What comes, comes to its place.
    y = np.array([3.0, 2.0, 1.0, 2.0])
    mean = state.ensembles.mean(axis=-2)
    variance = state.ensembles.var(axis=-2, ddof=1)
    gain = variance / (variance + 1)
    expected = mean + changed * gain * (y - mean)
    assert np.allclose(after.ensembles.mean(axis=-2), expected, atol=1e-12)


def test_one_array_of_places_is_refused_on_a_ring() -> None:
    """Each agent receives three observations, but not the same ones."""
    f = local_filter(PLACES[:3], graphs.ring(4))
    state = f.start((np.zeros(4), np.eye(4)), rng=np.random.default_rng(0))
    with pytest.raises(Exception, match="observation_places must be a mapping"):
        f.step(state, 0.0, [[3.0], [2.0], [1.0], [2.0]])
    # On a complete graph all receive the same.
    f = local_filter(PLACES, graphs.complete(4))
    after = f.step(state, 0.0, [[3.0], [2.0], [1.0], [2.0]])
    by_sensor = local_filter(BY_SENSOR, graphs.complete(4))
    expected = by_sensor.step(state, 0.0, [[3.0], [2.0], [1.0], [2.0]])
    assert np.allclose(after.ensembles, expected.ensembles, atol=1e-12)


def test_a_sensor_without_a_place_is_named() -> None:
    """And an update by sensors needs a filter, or places with the call."""
    f = local_filter({SENSORS[0]: [0.0]}, graphs.ring(4))
    state = f.start((np.zeros(4), np.eye(4)), rng=np.random.default_rng(0))
    with pytest.raises(Exception, match="observation_places must have a place for"):
        f.step(state, 0.0, [[3.0], [2.0], [1.0], [2.0]])
    x = draw(1, 10, 4)
    data: Any = (x, x[:, :1], [1.0], [[1.0]])
    with pytest.raises(ValueError, match="^observation_places must be given"):
        f.update(*data, rng=np.random.default_rng(0))
    after = f.update(*data, rng=np.random.default_rng(0), observation_places=[[0.0]])
    # The other components are ten radii away.
    assert (after[:, 1:] == x[:, 1:]).all()


def test_places_pass_through_other_wrappers() -> None:
    """Inflation around a localised update still gives it the places."""
    local = updates.with_localization(
        ETKF, places=PLACES, observation_places=BY_SENSOR, radius=1.0
    )
    inflated = updates.with_inflation(local, factor=1.0)
    results = []
    for update in (local, inflated):
        f = EnsembleFilter(
            STILL, SENSORS, graphs.ring(4), update=update, members=10, lag=1
        )
        state = f.start((np.zeros(4), np.eye(4)), rng=np.random.default_rng(0))
        state = f.step(state, 1.0, [[3.0], [2.0], [1.0], [2.0]])
        results.append(state.ensembles)
        # The earlier time's members are changed at the same places.
        assert np.allclose(state.history[0][1], state.ensembles, atol=1e-12)
    assert np.allclose(*results, atol=1e-12)


@pytest.mark.parametrize("correlation", [1e-9, 0.5, -0.9])
def test_maps_with_correlated_observations_in_different_places(
    correlation: float,
) -> None:
    """An affine map is the update by sample covariances with the same draws."""
    x = draw(5, 60, 3)
    places = np.array([[0.0], [1.0], [100.0]])
    r = 0.25 * np.array([[1.0, correlation], [correlation, 1.0]])
    results = []
    for update in (updates.transport_map_update, updates.enkf_sampled_covariance):
        local = updates.with_localization(
            update, places=places, observation_places=places[[0, 2]], radius=1.0
        )
        rng = np.random.default_rng(0)
        results.append(local(x, x[:, [0, 2]], [1.0, -1.0], r, rng=rng))
    assert np.allclose(*results, atol=1e-8)
