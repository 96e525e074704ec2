"""Options that are mostly left at their defaults, checked whether or not they are used."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from distfilt import filters, models, network, sensors, updates
from distfilt.coupling import norm
from distfilt.density import Flooding, FokkerPlanck, Grid
from distfilt.mixtures import GaussianMixture
from distfilt.published import PAPERS, Value, judge_table, read_table, root, table

Cases = list[tuple[str, Callable[[], object]]]

RNG = np.random.default_rng
PATH = network.graphs.path(2)
WALK = models.Model(2, lambda x, t, dt: x, lambda t, dt: 0.1 * dt * np.eye(2))
EYES = [sensors.direct([0], std=0.5), sensors.direct([1], std=0.5)]
PRIOR = GaussianMixture.gaussian([0.0, 0.0], np.eye(2))
SWARM = FokkerPlanck(models.rotating_swarm(), Grid((7, 7)))
X = RNG(0).random((6, 2))
SEEN = np.random.default_rng(1).standard_normal((8, 2))
NO_FLAGS = ("yes", None, 1, 2.5, {}, np.True_)


def team(kind: Any, **options: Any) -> Any:
    return kind(WALK, EYES, PATH, **options)


def density(**options: Any) -> Any:
    given = {"bandwidth": 0.2, "rank": 9} | options
    return filters.DensityFilter(SWARM, 6, 0.6, Flooding(), **given)


def mixture(kind: Any = filters.MixtureFilter, **options: Any) -> Any:
    return kind([WALK, WALK], EYES, PATH, target_dim=1, **options)


def updated(function: Any, **options: Any) -> Any:
    return function(SEEN, SEEN[:, :1], [0.5], [[1.0]], rng=RNG(0), **options)


def items(**options: Any) -> object:
    return read_table(root() / "published" / "items.csv", key=2, **options)


def flag(name: str, call: Callable[..., object]) -> Cases:
    """What is neither True nor False."""
    return [(f"{name}: needs a bool, got", lambda v=v: call(**{name: v})) for v in NO_FLAGS]


def option(name: str, call: Callable[..., object], *values: Any) -> Cases:
    return [(f"{name}: needs", lambda v=v: call(**{name: v})) for v in values]


VALUE = Value("C1", 0.0899, 0.0004, 0.0896)
LOGS = np.zeros((2, 3))
STEP = team(filters.GaussianFilter)
BEGUN = STEP.start((np.zeros(2), np.eye(2)))
POINTS = np.tile([[0.0], [1.0], [2.0]], (2, 1, 1))
BAD_INPUT: dict[str, Cases] = {
    "distfilt.filters.DensityFilter": [
        *flag("number_known", density),
        *option("prior_length", density, "0.1", None, 0.0, np.nan),
        *option("prior_std", density, "1", None, -1.0, np.nan),
        ("rng: needs a numpy", lambda: density().start(X, rng=3)),
        ("runs: needs ()", lambda: density().start(X, runs=3)),
        ("late: needs a Sequence", lambda: density().step(density().start(X), 0.1, X, late=3.5)),
    ],
    "distfilt.filters.GaussianFilter": [
        *flag("share", lambda **o: team(filters.GaussianFilter, **o)),
        ("rng: needs a numpy", lambda: STEP.start((np.zeros(2), np.eye(2)), rng="text")),
    ],
    "distfilt.filters.TransportFilter": flag(
        "correct", lambda **o: team(filters.TransportFilter, **o)),
    "distfilt.filters.MixtureFilter": [
        *option("scale", mixture, "text", [1.0], [1.0, np.nan]),
        ("rng: needs a numpy", lambda: mixture().start([PRIOR, PRIOR], rng=object())),
    ],
    "distfilt.filters.NewsFilter": option(
        "scale", lambda **o: mixture(filters.NewsFilter, **o), "text", [1.0, 2.0, 3.0]),
    "distfilt.filters.SensorFilter": [
        ("sizes: needs a tuple", lambda: STEP.begin(
            BEGUN, filters.GaussianState, 1.0, [None, None], (), "ab")),
        ("draws: needs a bool", lambda: STEP.first(
            filters.GaussianState, 0.0, RNG(0), np.zeros((2, 2)), draws="no")),
    ],
    "distfilt.filters.Step": flag("shared", lambda **o: list(
        STEP.begin(BEGUN, filters.GaussianState, 1.0, [[0.5], None], ()).heard(**o))),
    "distfilt.models.RotatingMixture": option("centre", models.RotatingMixture, 3.0, "12", [1j, 0]),
    "distfilt.models.pendulum_rate": option(
        "length", lambda **o: models.pendulum_rate([1.0, 0, 0, 0], **o), 1e-200, 1e200),
    "distfilt.models.pendulum": option("length", models.pendulum, 1e-200, 1e200),
    "distfilt.models.pendulum_angle": option("length", models.pendulum_angle, 0.0, 1e-200),
    "distfilt.network.Faults": [
        ("t: needs a finite number", lambda: network.Faults().lost(PATH, 0, 1, "now")),
    ],
    "distfilt.network.graphs.random": flag(
        "directed", lambda **o: network.graphs.random(3, 0.5, rng=RNG(0), **o)),
    "distfilt.updates.ensemble_transform": flag(
        "correct", lambda **o: updated(updates.ensemble_transform, **o)),
    "distfilt.updates.transform_by_agreement": flag("correct", lambda **o: (
        updates.transform_by_agreement(POINTS, LOGS, network.Channel(PATH), **o))),
    "distfilt.updates.projected": flag(
        "guarded", lambda **o: updates.projected(updates.known_noise, norm([0]), **o)),
    "distfilt.updates.retracted": [
        *option("motion", lambda **o: updates.retracted(updates.known_noise, norm([0]), **o),
                "text", ([0], [0]), ([0], [1, 2]), object()),
        ("motion: needs different indices below 2", lambda: updated(updates.retracted(
            updates.known_noise, norm([0]), motion=([0], [2])))),
    ],
    "distfilt.updates.known_noise": [
        *option("shrinkage", lambda **o: updated(updates.known_noise, **o), None, False, "", 1.5),
        *option("ridge", lambda **o: updated(updates.known_noise, **o), None, False, [], -0.5),
    ],
    **{f"distfilt.updates.{f.__name__}": [
        ("fit: needs a function", lambda f=f, o=o: updated(f, fit="affine", **o)),
        *([("noise_factor: needs", lambda f=f, o=o: updated(f, noise_factor=1e300, **o))]
          if f is not updates.transport_sample else []),
    ] for f, o in (
        (updates.transport, {}), (updates.transport_sample, {}),
        (updates.principal_components, {"n_state": 1, "n_observed": 1}),
    )},
    "distfilt.published.read_table": [
        *option("columns", items, "title", 3.5, [3.5], object()),
        *option("numbers", items, "title", 3.5, [3.5], {"title"}),
    ],
    "distfilt.published.table": option(
        "numbers", lambda **o: table(PAPERS[0], "table-2", **o), "noise", 3.5, [3.5]),
    "distfilt.published.judge_table": option(
        "why", lambda **o: judge_table("semeraro", "Table 1", [VALUE], **o), None, 3.5, object()),
}  # fmt: skip
