"""What every update keeps to: shapes, batches, randomness and inputs."""

from __future__ import annotations

import numpy as np
import pytest

from tests.support import without_checks

from .cases import UPDATES, H, R, Y, members, rng

BOTH = pytest.mark.parametrize("name", UPDATES)


@BOTH
def test_members_come_back_by_the_generator_s_bits_and_no_input_changes(
    name: str,
) -> None:
    x = members(30, 2)
    update = UPDATES[name]
    four = x, x @ H.T, np.tile(Y, (2, 1)), R.copy()
    before = [a.copy() for a in four]
    out = update(*four, rng=rng(5))
    again = update(*four, rng=rng(5))
    assert (
        out.shape == x.shape and np.isfinite(out).all() and not np.shares_memory(out, x)
    )
    assert (out == again).all() and (
        out == without_checks(update)(*four, rng=rng(5))
    ).all()
    assert (out != update(*four, rng=rng(6))).any()
    assert all((a == b).all() for a, b in zip(four, before, strict=True))


@BOTH
def test_noise_of_its_own_for_each_ensemble(name: str) -> None:
    """Of a stack each ensemble is what it is in one that has its noise throughout."""
    x = members(30, 2)
    y = np.stack([Y, Y])
    noise = np.stack([R, 40 * R])
    both = UPDATES[name](x, x @ H.T, y, noise, rng=rng())
    for k in range(2):
        alike = UPDATES[name](x, x @ H.T, y, noise[k], rng=rng())
        assert np.allclose(both[k], alike[k], rtol=0, atol=1e-9)
        assert np.abs(both[1 - k] - alike[1 - k]).max() > 0.2
