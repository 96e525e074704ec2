"""Distributed nonlinear filtering: transport maps, mixtures, densities and their networks.

The rooms are packages with a face each, ``from distfilt.filters import EnsembleFilter``. All of
them are attributes here too, imported when they are first asked for, so that ``import distfilt``
itself costs next to nothing.

Every public function checks its arguments once: what does not fit raises a ``ValueError`` that
names the argument, what it needs and what it got. A section Raises is for what else can happen,
a section Returns for what the first line and the signature do not tell.
"""

from __future__ import annotations

import importlib
from types import ModuleType

__version__ = "0.3.0"

_ROOMS = (
    "coupling",
    "density",
    "validation",
    "ensembles",
    "filters",
    "gaussians",
    "kalman",
    "linalg",
    "metrics",
    "mixtures",
    "models",
    "network",
    "sensors",
    "triangular",
    "updates",
)

__all__ = ["__version__", *_ROOMS]


def __getattr__(name: str) -> ModuleType:
    if name not in _ROOMS:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return importlib.import_module(f".{name}", __name__)


def __dir__() -> list[str]:
    return sorted({*__all__, *(name for name in globals() if name.startswith("__"))})
