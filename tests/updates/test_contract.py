"""What every update keeps to: shapes, batches, randomness, inputs, and the exact answer in sum."""

from __future__ import annotations

import numpy as np
import pytest

from distfilt.doors import unchecked
from distfilt.updates.door import stackable

from .cases import (
    CONSISTENT,
    CONSTRAINED,
    COV,
    MEAN,
    UPDATES,
    H,
    R,
    Y,
    enough,
    kalman,
    members,
    moments,
)

BOTH = pytest.mark.parametrize("name", UPDATES)


def rng(seed: int = 1) -> np.random.Generator:
    return np.random.default_rng(seed)


@BOTH
def test_returns_members_and_changes_no_input(name: str) -> None:
    x = members(30, 2)
    h, y, r = x @ H.T, np.tile(Y, (2, 1)), R.copy()
    before = [a.copy() for a in (x, h, y, r)]
    out = UPDATES[name](x, h, y, r, rng=rng())
    assert out.shape == x.shape and np.isfinite(out).all()
    assert not np.shares_memory(out, x)
    for a, b in zip((x, h, y, r), before, strict=True):
        assert (a == b).all()


@BOTH
def test_same_generator_same_bits(name: str) -> None:
    x = members(30)
    first = UPDATES[name](x, x @ H.T, Y, R, rng=rng(5))
    again = UPDATES[name](x, x @ H.T, Y, R, rng=rng(5))
    other = UPDATES[name](x, x @ H.T, Y, R, rng=rng(6))
    assert (first == again).all() and (first != other).any()


@BOTH
def test_unchecked_is_the_same_update(name: str) -> None:
    x = members(30)
    open_ = unchecked(UPDATES[name])(x, x @ H.T, Y, R, rng=rng())
    assert (open_ == UPDATES[name](x, x @ H.T, Y, R, rng=rng())).all()


@BOTH
def test_noise_of_its_own_for_each_ensemble(name: str) -> None:
    """A stack with two noise covariances has the moments of the two alone, in the mean."""
    assert stackable(UPDATES[name])
    x = np.stack([members(enough(name)), members(enough(name))])
    noise = np.stack([R, 40 * R])
    y = np.stack([Y, Y])
    both = UPDATES[name](x, x @ H.T, y, noise, rng=rng())
    for k in range(2):
        alone = UPDATES[name](x[k], x[k] @ H.T, Y, noise[k], rng=rng(2))
        assert np.allclose(both[k].mean(axis=0), alone.mean(axis=0), atol=0.12)
        assert np.allclose(np.cov(both[k].T), np.cov(alone.T), atol=0.12)
    assert np.abs(both[0].mean(axis=0) - both[1].mean(axis=0)).max() > 0.2


@pytest.mark.parametrize("name", CONSISTENT)
def test_tends_to_the_kalman_filter(name: str) -> None:
    x = members(20_000)
    mean, cov = kalman(*moments(x), H, R, Y)
    out = UPDATES[name](x, x @ H.T, Y, R, rng=rng())
    # Four standard errors of sample moments of 20 000 members.
    assert np.allclose(out.mean(axis=0), mean, atol=4 * np.sqrt(cov.max() / 2e4))
    assert np.allclose(np.cov(out.T), cov, atol=4 * 2 * cov.max() / np.sqrt(2e4))


@pytest.mark.parametrize("name", ["exact_draws", "square_root"])
def test_mean_and_covariance_are_exact(name: str) -> None:
    x = members(12)
    mean, cov = kalman(*moments(x), H, R, Y)
    out = UPDATES[name](x, x @ H.T, Y, R, rng=rng())
    assert np.allclose(out.mean(axis=0), mean, atol=1e-13)
    assert np.allclose(np.cov(out.T), cov, atol=1e-13)


@pytest.mark.parametrize("name", ["known_noise", "square_root"])
def test_two_members_are_enough(name: str) -> None:
    x = members(2)
    assert np.isfinite(UPDATES[name](x, x @ H.T, Y, R, rng=rng())).all()


@BOTH
def test_one_component_one_reading(name: str) -> None:
    if "principal" in name or name in [*CONSTRAINED, "localised"]:
        return
    x = members(200)[:, :1]
    out = UPDATES[name](x, x, [1.0], [[0.5]], rng=rng())
    p = COV[0, 0]
    assert out.shape == (200, 1)
    assert abs(out.mean() - (MEAN[0] + p / (p + 0.5) * (1.0 - MEAN[0]))) < 0.3
