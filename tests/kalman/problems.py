"""Problems that the tests of this folder share."""

from __future__ import annotations

import numpy as np

from distfilt.models import LinearModel
from tests.support import spd

STEPS = 7
RUNS = 4
D = 3
M = 2


def problem(
    rng: np.random.Generator, steps: int = STEPS, varying: bool = True
) -> dict[str, np.ndarray]:
    """Matrices of a linear Gaussian model, another one in each step if `varying`."""
    lead = (steps,) if varying else ()
    return {
        "F": rng.standard_normal((*lead, D, D)) / np.sqrt(D),
        "H": rng.standard_normal((*lead, M, D)),
        "Q": spd(rng, D, lead),
        "R": spd(rng, M, lead),
    }


def walk(d: int = 1) -> LinearModel:
    return LinearModel.from_transition(
        d, lambda dt: np.eye(d), lambda t, dt: dt * np.eye(d)
    )
