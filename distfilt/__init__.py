"""Distributed nonlinear filtering: transport maps, mixtures, densities and their networks.

Names are imported from the subpackages, ``from distfilt.filters import EnsembleFilter``. The
subpackages are attributes here too, and are imported when they are first used, so that ``import
distfilt`` itself is fast.

Every public function checks its arguments once: a wrong one raises a ``ValueError`` that names the
argument, the values that are allowed and the value that came. A docstring's section Raises lists
further errors only, and a section Returns stands where the first line does not describe the result.
"""

from __future__ import annotations

import importlib
from types import ModuleType

__version__ = "0.3.0"

_SUBPACKAGES = (
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

__all__ = ["__version__", *_SUBPACKAGES]


def __getattr__(name: str) -> ModuleType:
    if name not in _SUBPACKAGES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return importlib.import_module(f".{name}", __name__)


def __dir__() -> list[str]:
    special = [name for name in globals() if name.startswith("__")]
    return sorted(set(__all__) | set(special))
