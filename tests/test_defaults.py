"""Options that are mostly left at their defaults, checked whether or not they are used."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from scipy import sparse

from distfilt import filters, models, network, sensors, updates
from distfilt.coupling import norm
from distfilt.density import Flooding, FokkerPlanck, Grid
from distfilt.mixtures import GaussianMixture

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


def flag(name: str, call: Callable[..., object]) -> Cases:
    """What is neither True nor False."""
    return [(f"{name}: needs a bool, got", lambda v=v: call(**{name: v})) for v in NO_FLAGS]


def option(name: str, call: Callable[..., object], *values: Any) -> Cases:
    return [(f"{name}: needs", lambda v=v: call(**{name: v})) for v in values]


NONE = [None, None]
TEAMS = [team(k) for k in (filters.GaussianFilter, filters.EnsembleFilter, filters.ParticleFilter,
                           filters.TransportFilter)]  # fmt: skip


def ran(**options: Any) -> object:
    return STEP.run(BEGUN, [1.0], NONE, **options)


LOGS = np.zeros((2, 3))
STEP = team(filters.GaussianFilter)
GAUSS = np.zeros(2), np.eye(2)
BEGUN = STEP.start(GAUSS)
POINTS = np.tile([[0.0], [1.0], [2.0]], (2, 1, 1))
BAD_INPUT: dict[str, Cases] = {
    "distfilt.filters.DensityFilter": [
        *flag("number_known", density),
        *option("prior_length", density, "0.1", None, 0.0, np.nan),
        *option("names", density, "abcdef", [None, *"abcde"], 3.5),
        *option("prior_std", density, "1", None, -1.0, np.nan),
        ("rng: needs a numpy", lambda: density().start(X, rng=3)),
        ("runs: needs ()", lambda: density().start(X, runs=3)),
        ("late: needs a Sequence", lambda: density().step(density().start(X), 0.1, X, late=3.5)),
    ],
    "distfilt.filters.GaussianFilter": [
        *option("names", lambda **o: team(filters.GaussianFilter, **o), "ab", ["a", 2.0]),
        *flag("share", lambda **o: team(filters.GaussianFilter, **o)),
        ("rng: needs a numpy", lambda: STEP.start(GAUSS, rng="text")),
    ],
    "distfilt.filters.Filter": [
        *[("state: needs a", lambda call=call: call(3.5)) for call in (
            lambda s: STEP.run(s, [1.0], NONE), lambda s: STEP.smooth(s, [1.0], NONE),
            lambda s: list(STEP.steps(s, [1.0], NONE)), STEP.past, mixture().past,
            *(f.summary for f in TEAMS), mixture().summary, density().summary,
        )],
        *[(f"{name}: needs", lambda name=name, v=v: ran(**{name: v}))
          for name in ("late", "scores", "progress") for v in (3.5, "text", {"a": 1}, object())],
        *option("times", lambda **o: mixture().series([None], **o), "text", [1j], 3.5),
        *option("times", lambda **o: density().series([X], **o), "text", [1j], 3.5),
        *option("times", lambda **o: STEP.series(NONE, **o), "text", [1j], 3.5),
        *option("observations", lambda **o: mixture().series(times=[1.0], **o), 3.5, {1.0: None}),
        ("run: needs", lambda: filters.final_state(3.5)),  # type: ignore[arg-type]
    ],
    "distfilt.filters.State": [
        *[("path: needs a path", lambda v=v: BEGUN.save(v)) for v in (3.5, None, b"a")],
        *[("path: needs a path", lambda v=v: filters.State.load(v)) for v in (3.5, None, b"a")],
        *[("path: needs a file", lambda v=v: BEGUN.save(v)) for v in ("", ".", "/")],
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
        ("kind: needs a type", lambda: STEP.first(3, 0.0, RNG(0))),
        ("sets: needs an integer", lambda: STEP.leading((), 0.5)),
        ("sets: needs an integer", lambda: STEP.drawn(GAUSS, 4, (), RNG(0), "1")),
        *flag("semidefinite", lambda **o: STEP.moments(GAUSS, **o)),
        *[("state: needs a State", lambda call=call: call(3.5, 1.0)) for call in (
            STEP.elapsed, lambda s, _: STEP.observed(s, NONE))],
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
        ("t: needs a finite number", lambda: network.Faults().speaking(PATH, 0, 1j)),
        ("round_: needs an integer", lambda: network.Faults().speaking(PATH, 0.5)),
        ("graph: needs a Graph", lambda: network.Faults().speaking(3)),
        ("graph: needs a Graph", lambda: network.Faults().check(3)),
    ],
    "distfilt.network.Weights": [
        ("graph: needs a Graph", lambda: network.Weights.from_matrix(3, np.eye(2))),
        *option("matrix", lambda **o: network.Weights.from_matrix(PATH, **o), "text", [[1j]],
                np.eye(2, dtype=bool), sparse.csr_array(np.eye(2) * 1j),
                sparse.csr_array(np.eye(2, dtype=bool))),
        ("weights: needs real numbers", lambda: network.Channel(PATH).combine(
            np.ones((2, 1)), sparse.csr_array(np.eye(2) * 1j))),
    ],
    "distfilt.network.Channel": flag(
        "acknowledged", lambda **o: network.Channel(PATH).carry(np.ones((2, 1)), **o)),
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
}  # fmt: skip


def test_what_a_structure_keeps_is_its_own() -> None:
    """Who made it may change the array afterwards; a list is kept as the array that it means."""
    scale, centre, value, first = np.ones(2), np.full(2, 0.5), np.ones(1), np.ones(49)
    swarm = density(first=first)
    f, late = mixture(scale=scale), filters.Late(0, 1.0, value, arrived=2.0)
    round_ = models.RotatingMixture(centre=centre)
    for given in (scale, centre, value, first):
        given[:] = 7.0
    assert f.scale.tolist() == [1.0, 1.0] and np.asarray(late.value).tolist() == [1.0]
    assert (swarm.first == 1).all()
    assert round_.centre == (0.5, 0.5)
    weights = network.Weights(PATH, [0.5, 0.25], [0.5, 0.75])  # type: ignore[arg-type]
    assert weights.matrix.toarray().tolist() == [[0.5, 0.5], [0.75, 0.25]]


def test_a_generator_that_draws_nothing_is_left_as_it_was() -> None:
    rng = RNG(0)
    assert STEP.start(GAUSS, rng=rng).rng is None
    assert rng.bit_generator.seed_seq.n_children_spawned == 0  # type: ignore[attr-defined]
    assert mixture().start([PRIOR, PRIOR], rng=rng).rng is None
    assert density().start(X, rng=rng).rng is None
