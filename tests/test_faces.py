"""The faces of the rooms: whole, and with what a reader of the book calls."""

from __future__ import annotations

import importlib
import pkgutil

import pytest

import distfilt

ROOMS = sorted(
    info.name for info in pkgutil.iter_modules(distfilt.__path__)
    if info.ispkg and not info.name.startswith("_")
)
CALLED = {
    "filters": ["MixtureFilter", "MixtureState"],
    "mixtures": ["fuse", "fuse_in_turn", "fuse_moments", "runnalls", "split"],
    "models": ["occulted", "orbit", "orbits", "propagate", "rsw_frame"],
    "sensors": ["ephemeris", "line_of_sight"],
}


@pytest.mark.parametrize("room", ROOMS)
def test_a_face_is_whole(room: str) -> None:
    face = importlib.import_module(f"distfilt.{room}")
    names = list(face.__all__)
    assert len(set(names)) == len(names)
    assert all(getattr(face, name) is not None for name in names)
    assert set(CALLED.get(room, [])) <= set(names)
