"""Options are given by name, and structures cannot be changed."""

from __future__ import annotations

import importlib
import inspect
import re
from dataclasses import fields, is_dataclass
from pathlib import Path

import pytest

import distfilt

DATA = {
    "array": {"shape"}, "covariance": {"dim"}, "flags": {"shape"}, "generator": {"name"},
    "weights": {"size"}, "distances": {"target"}, "plan": {"columns"}, "sorted_plan": {"columns"},
    "LowRank": {"lost"}, "Seen": {"wanted"}, "places": {"size"}, "MixtureState": {"mixtures"},
    "EnsembleFilter": {"graph"}, "GaussianFilter": {"graph"}, "MixtureFilter": {"graph"},
    "NewsFilter": {"graph"}, "ParticleFilter": {"graph"}, "SensorFilter": {"graph"},
    "TransportFilter": {"graph"},
    "Summary": {"covariance", "members", "weights", "numbers"}, "Shapes": {"dropped"},
    "mobility_and_diffusion": {"strength"}, "orbits": {"bodies"}, "rotating_swarm": {"reading"},
}  # fmt: skip
"""Data that a call may leave out: a filter's graph, a second set of columns, a reason."""

HERE = Path(distfilt.__file__).parent
MODULES = sorted(
    ".".join(path.relative_to(HERE.parent).with_suffix("").parts)
    for path in HERE.rglob("*.py")
    if not path.name.startswith("_")
)


@pytest.mark.parametrize("module", MODULES)
def test_options_are_given_by_name(module: str) -> None:
    found = importlib.import_module(module)
    for name in found.__all__:
        public = getattr(found, name)
        own = getattr(public, "__module__", "") == module
        if not own or not (inspect.isroutine(public) or is_dataclass(public)):
            continue
        parameters = inspect.signature(public).parameters.values()
        row = {
            p.name for p in parameters
            if p.default is not p.empty and p.kind is not p.KEYWORD_ONLY
        }  # fmt: skip
        assert row <= DATA.get(name, set()), f"{name}: {sorted(row)} can stand in a row"


CHANGING = {"Step"}
"""What a filter fills in during one step, and nobody else sees."""


@pytest.mark.parametrize("module", MODULES)
def test_structures_are_frozen_and_arrays_make_no_equality(module: str) -> None:
    """Two structures of arrays would be compared entry by entry, which is no truth value."""
    for name, made in vars(importlib.import_module(module)).items():
        if not (isinstance(made, type) and is_dataclass(made) and made.__module__ == module):
            continue
        options = made.__dataclass_params__  # type: ignore[attr-defined]
        assert options.frozen or name in CHANGING, f"{name} can be changed"
        types = " ".join(re.sub(r"Callable\[.*\]", "", str(f.type)) for f in fields(made))
        assert not (options.eq and "Array" in types), f"{name} compares arrays"
