"""Properties of every update: shapes, batches, randomness and inputs."""

from __future__ import annotations

import numpy as np
import pytest

from tests.support import without_checks

from .cases import CONSTRAINED, UPDATES, H, R, Y, members, rng

EACH_UPDATE = pytest.mark.parametrize("name", UPDATES)


@EACH_UPDATE
def test_an_update_depends_on_its_arguments_and_the_generator_only(name: str) -> None:
    """The same seed gives the same bits, another seed others, with and without checks."""
    update = UPDATES[name]
    x = members(30, 2)
    data = (x, x @ H.T, np.tile(Y, (2, 1)), R.copy())
    copies = [array.copy() for array in data]
    # Two ensembles with the same observation and noise
    analysis = update(*data, rng=rng(5))
    assert analysis.shape == x.shape
    assert np.isfinite(analysis).all()
    same_seed = update(*data, rng=rng(5))
    assert (analysis == same_seed).all()
    unchecked = without_checks(update)(*data, rng=rng(5))
    assert (analysis == unchecked).all()
    other_seed = update(*data, rng=rng(6))
    assert (analysis != other_seed).any()
    # The inputs are neither changed nor part of the result.
    assert not np.shares_memory(analysis, x)
    for array, copy in zip(data, copies, strict=True):
        assert (array == copy).all()


@EACH_UPDATE
def test_a_noise_covariance_for_each_ensemble(name: str) -> None:
    """Each ensemble of a stack is as in a stack that has its covariance throughout."""
    update = UPDATES[name]
    x = members(30, 2)
    y = np.stack([Y, Y])
    noise = np.stack([R, 40 * R])
    analysis = update(x, x @ H.T, y, noise, rng=rng())
    for k in range(2):
        uniform = update(x, x @ H.T, y, noise[k], rng=rng())
        assert np.allclose(analysis[k], uniform[k], rtol=0, atol=1e-9)
        # The other ensemble has another covariance, which matters.
        difference = analysis[1 - k] - uniform[1 - k]
        assert np.abs(difference).max() > 0.2


@EACH_UPDATE
def test_the_units_and_the_origin_of_observations_change_nothing(name: str) -> None:
    """Of z = D y + b the noise is D R D; the draws are those of y, as D is diagonal."""
    update = UPDATES[name]
    x = members(30)
    predicted = x @ H.T
    unit = np.array([1e3, 0.02])
    origin = np.array([-5.0, 8.0])
    expected = update(x, predicted, Y, R, rng=rng(5))
    noise = unit[:, None] * R * unit
    analysis = update(
        x, unit * predicted + origin, unit * Y + origin, noise, rng=rng(5)
    )
    assert np.allclose(analysis, expected, rtol=0, atol=1e-8)


@pytest.mark.parametrize("name", [n for n in UPDATES if n not in CONSTRAINED])
def test_the_unit_and_the_origin_of_states_change_nothing(name: str) -> None:
    """z = 20 x + b, with the same predictions, has the analysis 20 x⁺ + b."""
    update = UPDATES[name]
    x = members(30)
    predicted = x @ H.T
    origin = np.array([7.0, -3.0, 40.0])
    expected = update(x, predicted, Y, R, rng=rng(5))
    analysis = update(20 * x + origin, predicted, Y, R, rng=rng(5))
    assert np.allclose(analysis, 20 * expected + origin, rtol=0, atol=1e-7)
