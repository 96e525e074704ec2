"""What the fuzz of all arguments found open: each is refused by its name now."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from distfilt import models, sensors
from distfilt.coupling import accepted, norm, sorted_plan
from distfilt.linalg import central
from distfilt.ensembles import draw, exact_noise
from distfilt.kalman import kalman_filter
from distfilt.metrics import crps, ensemble_nees, nees_band
from distfilt.mixtures import Divergence, GaussianMixture, split
from distfilt.network import Channel, Faults, Graph, graphs, pull, weights
from distfilt.triangular import affine
from distfilt.updates import effective_size, jitter, principal_directions, update

RNG = np.random.default_rng
ONE = GaussianMixture.gaussian([0.0, 0.0], np.eye(2))
DOORS: list[tuple[str, Callable[[], object]]] = [
    ("angle", lambda: models.turned([1.0, 0, 0, 0], [1e200, 0, 0])),
    ("quaternion", lambda: models.rotation_matrix([1e200, 0, 0, 1.0])),
    ("quaternion", lambda: models.rotation_matrix([1e-200, 0, 0, 1e-200])),
    ("other", lambda: models.turn_between([1.0, 0, 0, 0], [1j, 0, 0, 0])),
    ("sigma", lambda: models.clohessy_wiltshire(rate=0.1, sigma=1e200)),
    ("states", lambda: models.pendulum_chart([1e200, 0, 0, 0])),
    ("indices", lambda: sensors.direct(3.0, std=1.0)),  # type: ignore[arg-type]
    ("std", lambda: sensors.direct([0], std=1e200)),
    ("std", lambda: sensors.direct([0], std=1e-200)),
    ("previous", lambda: sensors.direct([0], std=1.0).predict([1.0], previous=[1j])),
    ("predicted", lambda: sensors.direct([0], std=1.0).residual(np.ones((3, 1)), np.ones((2, 1)))),
    ("kind", lambda: sensors.Sensor(1, lambda x: x, [[1.0]], kind=3)),  # type: ignore[arg-type]
    ("log_weights", lambda: accepted([np.nan, 0.0], [[0.5], [0.1]], norm([0]))),
    ("source", lambda: sorted_plan([1e300, 0.0], [0.0, 1.0], [0.5, 0.5])),
    ("indices", lambda: norm(3.0)),  # type: ignore[arg-type]
    ("function", lambda: central(lambda x: None, [1.0])),  # type: ignore[arg-type,return-value]
    ("leading", lambda: draw([0.0], [[1.0]], 3, rng=RNG(0), leading=3)),  # type: ignore[arg-type]
    ("anomalies_to_avoid", lambda: exact_noise(np.ones((0, 1)), [[1.0]], rng=RNG(0))),
    ("kalman_filter", lambda: kalman_filter([1.0], [[1.0]], np.ones((4, 1)), F=[[1e300]],
                                            H=[[0.0]], Q=[[0.0]], R=[[1.0]])),
    ("fair", lambda: crps([[0.0], [1.0]], [0.0], fair="no")),  # type: ignore[arg-type]
    ("normalised", lambda: nees_band(2, 10, normalised="no")),  # type: ignore[arg-type]
    ("ensemble", lambda: ensemble_nees([[0.0], [1e300], [2.0]], [3.0])),
    ("error", lambda: Divergence(0.5, "0.1", 0.9)),  # type: ignore[arg-type]
    ("which", lambda: split(ONE, [0.0], [[1.0, 0.0]])),
    ("indices", lambda: ONE.marginal(0)),  # type: ignore[arg-type]
    ("symmetric", lambda: Faults(loss=0.1, symmetric="no")),  # type: ignore[arg-type]
    ("directed", lambda: Graph.from_edges(2, [[0, 1]], directed="no")),  # type: ignore[arg-type]
    ("include_self", lambda: pull(np.ones((2, 3, 1)), Channel(graphs.path(2)), gain=0.1,
                                  include_self="no")),  # type: ignore[arg-type]
    *(("graph", lambda f=f: f(3)) for f in (weights.metropolis, weights.push, weights.balanced)),
    ("samples", lambda: affine.gradient([0.0, 1.0], np.ones((0, 1)))),
    ("points", lambda: jitter(np.ones((0, 1)), rng=RNG(0))),
    ("log_weights", lambda: effective_size(np.ones((2, 0)))),
    ("ensemble", lambda: principal_directions([[1e300, 0.0], [-1e300, 1.0], [0.0, 2.0]], 1)),
    ("function", lambda: update(3)),  # type: ignore[arg-type]
]  # fmt: skip


@pytest.mark.filterwarnings("ignore:.*(overflow|invalid value):RuntimeWarning")
@pytest.mark.parametrize(("argument", "call"), DOORS)
def test_a_door_that_stood_open_is_shut(argument: str, call: Callable[[], object]) -> None:
    with pytest.raises((ValueError, np.linalg.LinAlgError), match=rf"\b{argument}\b"):
        call()


def test_a_message_s_round_may_be_a_numpy_integer() -> None:
    faults, graph = Faults(loss=0.5, seed=3), graphs.path(4)
    plain = faults.lost(graph, 7, 2)
    np.testing.assert_array_equal(faults.lost(graph, np.int64(7), 2), plain)  # type: ignore[arg-type]
