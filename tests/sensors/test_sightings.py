"""The inverse of a sighting: it undoes the sensor, and its covariance is that of draws."""

from __future__ import annotations

import numpy as np
import pytest

from distfilt.sensors import locate_sighting, range_bearing, sighting_cov

OBSERVER = [1, 2, 3]


def test_it_undoes_the_sensor() -> None:
    rng = np.random.default_rng(0)
    states = rng.standard_normal((50, 6)) * [1, 5, 5, 3, 5, 5]
    sensor = range_bearing([4, 5], std=(0.1, 0.02), observer=OBSERVER)
    for state in states:
        place = locate_sighting(state, sensor.predict(state), observer=OBSERVER)
        assert np.allclose(place, state[4:])
    # A batch of states, one sighting
    places = locate_sighting(states, [2.0, 0.3], observer=OBSERVER)
    assert places.shape == (50, 2)
    assert np.allclose(np.linalg.norm(places - states[:, 1:3], axis=1), 2.0)


def test_the_covariance_is_that_of_draws() -> None:
    state = np.array([0.0, 1.0, 2.0, 0.8])
    cov = np.array([[0.04, 0.002], [0.002, 0.0009]])
    draws = np.random.default_rng(1).multivariate_normal([4.0, 0.3], cov, 40_000)
    places = np.array(
        [locate_sighting(state, y, observer=OBSERVER) for y in draws[:4000]]
    )
    expected = sighting_cov(state, [4.0, 0.3], cov, observer=OBSERVER)
    assert np.allclose(np.cov(places.T), expected, atol=0.07 * expected.max())
    batch = sighting_cov(np.tile(state, (2, 3, 1)), [4.0, 0.3], cov, observer=OBSERVER)
    assert np.allclose(batch, expected) and batch.shape == (2, 3, 2, 2)


def test_an_observer_has_a_heading() -> None:
    with pytest.raises(ValueError, match="observer must have three entries"):
        locate_sighting(np.zeros(4), [1.0, 0.0], observer=[0, 1])
