"""What every update keeps to: shapes, batches, randomness and inputs."""

from __future__ import annotations

import numpy as np
import pytest

from distfilt.doors import unchecked
from distfilt.updates.door import says

from .cases import UPDATES, H, R, Y, enough, members, rng

BOTH = pytest.mark.parametrize("name", UPDATES)


@BOTH
def test_members_come_back_by_the_generator_s_bits_and_no_input_changes(name: str) -> None:
    x, update = members(30, 2), UPDATES[name]
    four = x, x @ H.T, np.tile(Y, (2, 1)), R.copy()
    before = [a.copy() for a in four]
    out, again = update(*four, rng=rng(5)), update(*four, rng=rng(5))
    assert out.shape == x.shape and np.isfinite(out).all() and not np.shares_memory(out, x)
    assert (out == again).all() and (out == unchecked(update)(*four, rng=rng(5))).all()
    assert (out != update(*four, rng=rng(6))).any()
    assert all((a == b).all() for a, b in zip(four, before, strict=True))


@BOTH
def test_noise_of_its_own_for_each_ensemble(name: str) -> None:
    """A stack with two noise covariances has the moments of the two alone, in the mean."""
    assert says(UPDATES[name], "stacks")
    x = np.stack([members(enough(name)), members(enough(name))])
    noise = np.stack([R, 40 * R])
    y = np.stack([Y, Y])
    both = UPDATES[name](x, x @ H.T, y, noise, rng=rng())
    for k in range(2):
        alone = UPDATES[name](x[k], x[k] @ H.T, Y, noise[k], rng=rng(2))
        assert np.allclose(both[k].mean(axis=0), alone.mean(axis=0), atol=0.12)
        assert np.allclose(np.cov(both[k].T), np.cov(alone.T), atol=0.12)
    assert np.abs(both[0].mean(axis=0) - both[1].mean(axis=0)).max() > 0.2
