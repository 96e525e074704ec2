"""What a run records where a filter's claim is degenerate."""

from __future__ import annotations

import numpy as np
import pytest

from distfilt.filters import ParticleFilter
from distfilt.models import Model
from distfilt.sensors import direct


@pytest.mark.filterwarnings("ignore::distfilt.filters.ParticleCollapse")
def test_nees_of_a_collapsed_cloud_is_infinite() -> None:
    # The first reading is 1e6 times sharper than the prior: one particle keeps all the weight.
    walk = Model(2, lambda x, t, dt: x, lambda t, dt: dt * np.eye(2))
    f = ParticleFilter(walk, [direct([0, 1], std=1e-6)], members=20)
    state = f.start((np.zeros(2), np.eye(2)), rng=np.random.default_rng(0), runs=(3,))
    truth = np.full((2, 3, 2), 0.3)
    seen = truth.copy()
    seen[:, 1] = np.nan  # a run without readings stays honest
    run = f.run(state, [1.0, 2.0], [seen], truth=truth)
    recorded = run["nees"].values[:, :, 0]
    assert np.isinf(recorded[:, [0, 2]]).all()
    mean, cov = run["mean"].values[0, 1, 0], run["covariance"].values[0, 1, 0]
    gap = mean - truth[0, 1]
    assert abs(recorded[0, 1] - gap @ np.linalg.solve(cov, gap)) < 1e-9
