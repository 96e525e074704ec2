"""Linear models that the tests of this folder share."""

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
    """Matrices of a linear Gaussian model, different ones in each step if `varying`."""
    leading = (steps,) if varying else ()
    return {
        # Scaled so that states neither grow nor vanish.
        "F": rng.standard_normal((*leading, D, D)) / np.sqrt(D),
        "H": rng.standard_normal((*leading, M, D)),
        "Q": spd(rng, D, leading),
        "R": spd(rng, M, leading),
    }


def walk(d: int = 1) -> LinearModel:
    """A random walk: x(t + dt) = x(t) + noise of covariance dt I."""
    return LinearModel.from_transition(
        d, lambda dt: np.eye(d), lambda t, dt: dt * np.eye(d)
    )
