"""Copies of generators: they go on as the original does, and leave it alone."""

from __future__ import annotations

import numpy as np
import pytest

from distfilt.filters.step import bookmarked, copied

KINDS = [np.random.PCG64, np.random.PCG64DXSM, np.random.Philox, np.random.SFC64, np.random.MT19937]


@pytest.mark.parametrize("kind", KINDS)
def test_a_copy_goes_on_alike_and_alone(kind: type) -> None:
    rng = np.random.Generator(kind(np.random.SeedSequence([3, 4], spawn_key=(2,), pool_size=8)))
    rng.spawn(2)
    # Half of a draw of 64 bits is left over: it belongs to the state.
    rng.integers(10, dtype=np.int32)
    before = rng.bit_generator.state
    one, two = copied(rng), copied(rng)
    assert np.array_equal(one.standard_normal(50), two.standard_normal(50))
    assert one.spawn(1)[0].random() == two.spawn(1)[0].random()
    assert str(rng.bit_generator.state) == str(before)
    third = copied(rng)
    third.standard_normal(50)
    assert rng.spawn(1)[0].random() == third.spawn(1)[0].random()


def test_a_bookmark_is_of_then_whatever_was_drawn_since() -> None:
    rng = np.random.default_rng(5)
    again = bookmarked(rng)
    child, drawn = rng.spawn(1)[0].random(), rng.random(3)
    for _ in range(2):
        other = again()
        assert other is not None
        assert other.spawn(1)[0].random() == child
        assert np.array_equal(other.random(3), drawn)
    assert bookmarked(None)() is None


def test_a_generator_without_a_seed_sequence_is_copied_too() -> None:
    rng = np.random.Generator(np.random.RandomState(3)._bit_generator)
    one = copied(rng)
    assert np.array_equal(one.random(4), rng.random(4))


