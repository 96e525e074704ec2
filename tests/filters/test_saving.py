"""States on disk: the same bits back, whole files or none, damage found."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from numpy.random import default_rng

from distfilt.filters import State
from distfilt.filters.ensemble import EnsembleState
from distfilt.network import Ledger


@dataclass(frozen=True, eq=False)
class EveryField(State):
    """A family of one's own with every kind of field."""

    size: int
    word: str
    nested: tuple[tuple[float, np.ndarray], ...]
    nothing: None
    yes: bool
    counts: np.ndarray


def make_state(rng: np.random.Generator | None) -> EveryField:
    sent = np.array([3, 4])
    lost = np.array([0.5, 0.0])
    by_link = (sent, 5 * sent, 40 * sent)
    by_broadcast = (sent - 1, 4 * sent, 32 * sent)
    ledger = Ledger(1, *by_link, lost, *by_broadcast)
    # Numbers that a text form would lose: NaN, infinity and the sign of a zero
    special = np.array([np.nan, np.inf, -0.0])
    nested = ((0.1, np.arange(3.0)), (0.2, special))
    counts = np.array([1, 2], dtype=np.int32)
    return EveryField(1.5, ledger, rng, 7, "a b", nested, None, True, counts)


@pytest.mark.parametrize("kind", ["PCG64", "PCG64DXSM", "MT19937", "Philox", "SFC64"])
def test_everything_comes_back(tmp_path: Path, kind: str) -> None:
    bit_generator = getattr(np.random, kind)
    rng = np.random.Generator(bit_generator([1, 2**40]))
    # A generator that has drawn and spawned: both counters belong to its state.
    rng.spawn(2)
    rng.random(5)
    before = make_state(rng)
    before.save(tmp_path / "a.npz")
    after = EveryField.load(tmp_path / "a.npz")
    loaded = (after.t, after.size, after.word, after.nothing, after.yes)
    assert loaded == (1.5, 7, "a b", None, True)
    assert after.counts.dtype == np.int32
    assert after.counts.tolist() == [1, 2]
    assert [t for t, _ in after.nested] == [0.1, 0.2]
    for (_, a), (_, b) in zip(before.nested, after.nested, strict=True):
        assert a.tobytes() == b.tobytes()
    for name in ("rounds", "messages", "scalars", "bytes", "lost"):
        assert np.array_equal(getattr(before.ledger, name), getattr(after.ledger, name))
    assert rng.random() == after.rng.random()
    (child,) = rng.spawn(1)
    (loaded_child,) = after.rng.spawn(1)
    assert child.random() == loaded_child.random()


def test_a_failed_save_leaves_the_earlier_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "a.npz"
    make_state(None).save(path)
    before = path.read_bytes()

    # fsync is the last call before the new file replaces the old one.
    def full(*args: object, **options: object) -> None:
        raise OSError("no space left")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match=r"no space left: .*a\.npz"):
        make_state(default_rng(0)).save(path)
    assert path.read_bytes() == before
    assert os.listdir(tmp_path) == ["a.npz"]


def test_a_twin_with_the_same_fields_is_another_kind(tmp_path: Path) -> None:
    class Twin(EnsembleState):
        pass

    path = tmp_path / "a.npz"
    for made, asked in ((Twin, EnsembleState), (EnsembleState, Twin)):
        members = np.zeros((1, 2, 1))
        state = made(0.0, Ledger.empty(1), default_rng(0), members)
        state.save(path)
        assert made.load(path).ensembles.shape == (1, 2, 1)
        # Equal fields do not make a state of another family.
        with pytest.raises(ValueError, match=f"must be a saved {asked.__name__}"):
            asked.load(path)


def test_damage_is_found_at_every_byte(tmp_path: Path) -> None:
    """Neither a flipped bit nor a cut gives a state: the file is refused by name."""
    path = tmp_path / "a.npz"
    make_state(default_rng(3)).save(path)
    content = path.read_bytes()
    rng = default_rng(0)
    for place in rng.choice(len(content), 400, replace=False):
        # Flip one bit of one byte.
        bad = bytearray(content)
        bit = int(rng.integers(8))
        bad[place] ^= 1 << bit
        path.write_bytes(bad)
        with pytest.raises(ValueError, match="path must .*a.npz: it is damaged"):
            EveryField.load(path)
    for size in (0, 10, len(content) // 2, len(content) - 1):
        path.write_bytes(content[:size])
        with pytest.raises(ValueError, match="path"):
            EveryField.load(path)
    with pytest.raises(FileNotFoundError):
        EveryField.load(tmp_path / "none.npz")
