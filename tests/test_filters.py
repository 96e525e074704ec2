"""The ensemble filter: its contract, its one door, and what it does with gaps and delays."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
import pytest

from distfilt import ensembles
from distfilt.filters import EnsembleFilter, EnsembleState, Late
from distfilt.filters.assimilation import assimilate
from distfilt.filters.gaussian import GaussianFilter, GaussianState
from distfilt.filters.observations import at_one_time, over_times
from distfilt.filters.record import as_dataset
from distfilt.models import Model, simulate
from distfilt.models.satellite import clohessy_wiltshire
from distfilt.network import Channel, Faults, Graph, Ledger
from distfilt.network.consensus import mean_pull
from distfilt.network.fusion import covariance_intersection
from distfilt.sensors import angle, differential, direct
from distfilt.triangular.conditioning import affine_update, pca_update

STAR = Graph.from_adjacency([[0, 1, 1], [1, 0, 0], [1, 0, 0]])
X0 = np.array([100.0, 0, 0, 10, 0.1, 0])
SENSORS = (direct([0, 1], noise=0.2), angle([1, 2], noise=0.2), direct([3, 4, 5], noise=0.1))
TIMES = np.round(0.1 * np.arange(1, 9), 10)
NAN = float("nan")


def _rng(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def _walk() -> Model:
    return Model(1, lambda x, t, dt: x, lambda t, dt: np.array([[dt]]))


def _satellites(**change: object) -> EnsembleFilter:
    options: dict[str, object] = {
        "model": clohessy_wiltshire(rate=0.1, sigma=0.2),
        "sensors": SENSORS,
        "graph": STAR,
        "update": affine_update,
        "consensus": partial(mean_pull, gain=0.05),
        "members": 40,
    }
    options.update(change)
    return EnsembleFilter(**options)


def _begin(f: EnsembleFilter, seed: int = 1, runs: tuple[int, ...] = (3,)) -> EnsembleState:
    prior = partial(ensembles.draw, X0 + 3, 25 * np.eye(6))
    return f.start(prior, rng=_rng(seed), runs=runs)


def _data(runs: int = 3, times: np.ndarray = TIMES) -> tuple[np.ndarray, list[np.ndarray]]:
    rng = _rng(2)
    model = clohessy_wiltshire(rate=0.1, sigma=0.2)
    truth = simulate(model, np.broadcast_to(X0, (runs, 6)), times, rng=rng)
    return truth, [s.observe(truth, rng=rng) for s in SENSORS]


LINEAR = (SENSORS[0], direct([1, 2], noise=0.2), SENSORS[2])


def _kalmans(**change: object) -> GaussianFilter:
    options: dict[str, object] = {
        "model": clohessy_wiltshire(rate=0.1, sigma=0.2), "sensors": LINEAR, "graph": STAR,
    }
    options.update(change)
    return GaussianFilter(**options)


F = _satellites()
S = _begin(F)
OBS = [o[0] for o in _data()[1]]
_E = "distfilt.filters.ensemble."
_G = "distfilt.filters.gaussian."
_O = "distfilt.filters.observations."
BAD_INPUT = {
    _E + "EnsembleFilter": [
        ("model", lambda: _satellites(model=3)),
        ("sensors", lambda: _satellites(sensors=(1, 2, 3))),
        ("graph", lambda: _satellites(graph=3)),
        ("graph", lambda: _satellites(sensors=SENSORS[:2])),
        ("graph", lambda: _satellites(graph=lambda t: STAR, sensors=SENSORS[:2]).step(
            _begin(_satellites(graph=lambda t: STAR, sensors=SENSORS[:2])), 0.1, [None] * 2)),
        ("update", lambda: _satellites(update=None)),
        ("consensus", lambda: _satellites(consensus=0.05)),
        ("members", lambda: _satellites(members=1)),
        ("faults", lambda: _satellites(faults=0.1)),
        ("faults", lambda: _satellites(faults=Faults(delay=1))),
        ("lag", lambda: _satellites(lag=-1)),
        ("prior", lambda: F.start(np.zeros((3, 6)), rng=_rng())),
        ("prior", lambda: F.start(np.full((40, 6), NAN), rng=_rng())),
        ("rng", lambda: F.start(np.zeros((40, 6)), rng=3)),
        ("runs", lambda: F.start(np.zeros((40, 6)), rng=_rng(), runs=(0,))),
        ("state", lambda: F.step(3, 0.1, OBS)),
        ("state", lambda: F.step(_begin(_satellites(members=41)), 0.1, OBS)),
        ("t", lambda: F.step(S, 0.0, OBS)),
        ("observations", lambda: F.step(S, 0.1, OBS[:2])),
        ("observations[1]", lambda: F.step(S, 0.1, [OBS[0], OBS[0], OBS[2]])),
        ("observations[0]", lambda: F.step(S, 0.1, [OBS[0][:2], None, None])),
        ("observations[0]", lambda: F.step(S, 0.1, [np.inf * OBS[0], None, None])),
        ("observations", lambda: _satellites(sensors=(None, *SENSORS[1:])).step(
            _begin(_satellites(sensors=(None, *SENSORS[1:]))), 0.1, OBS)),
        ("times", lambda: F.run(S, [0.2, 0.1], [None] * 3)),
        ("observations", lambda: F.run(S, TIMES, [np.zeros((3, 2)), None, None])),
        ("truth", lambda: F.run(S, TIMES, [None] * 3, truth=np.zeros((8, 6)))),
        ("late", lambda: F.step(S, 0.1, OBS, late=[Late(0, 0.0, [1.0, 2.0], arrived=0.1)])),
        ("late", lambda: F.run(S, TIMES, [None] * 3, late=[Late(0, 0.1, [1.0, 2.0], arrived=9.0)])),
    ],
    _E + "Late": [
        ("agent", lambda: Late(-1, 0.1, [1.0], arrived=0.2)),
        ("measured", lambda: Late(0, NAN, [1.0], arrived=0.2)),
        ("arrived", lambda: Late(0, 0.3, [1.0], arrived=0.2)),
        ("value", lambda: Late(0, 0.1, "x", arrived=0.2)),
    ],
    "distfilt.filters.state.EnsembleState": [
        ("t", lambda: EnsembleState(NAN, S.ensembles, S.rng, S.ledger)),
        ("ensembles", lambda: EnsembleState(0.0, np.zeros((2, 3)), S.rng, S.ledger)),
        ("rng", lambda: EnsembleState(0.0, S.ensembles, 1, S.ledger)),
        ("ledger", lambda: EnsembleState(0.0, S.ensembles, S.rng, Ledger.empty(2))),
        ("history", lambda: EnsembleState(
            0.0, S.ensembles, S.rng, S.ledger, ((0.0, np.zeros((1, 2, 3))),))),
        ("path", lambda: EnsembleState.load(__file__)),
    ],
    "distfilt.filters.assimilation.assimilate": [
        ("payloads", lambda: assimilate(
            [np.zeros((3, 4, 6))], 0, OBS[:2], SENSORS, affine_update, Channel(STAR), _rng())),
        ("sensors", lambda: assimilate(
            [np.zeros((3, 4, 6))], 0, [np.zeros(2), None, None], [None] * 3, affine_update,
            Channel(STAR), _rng())),
    ],
    _O + "at_one_time": [
        ("observations", lambda: at_one_time([None], SENSORS, ())),
        ("observations[1]", lambda: at_one_time([None, [1.0, 2.0], None], SENSORS, ())),
        ("observations[0]", lambda: at_one_time([[1.0, np.inf], None, None], SENSORS, ())),
        ("observations", lambda: at_one_time([[1.0]], [None], ())),
    ],
    _O + "over_times": [
        ("times", lambda: over_times([None] * 3, SENSORS, [1.0, 1.0])),
        ("observations", lambda: over_times([None], SENSORS, [1.0])),
        ("observations", lambda: over_times([[1.0], None, None], SENSORS, [1.0])),
    ],
    _G + "GaussianFilter": [
        ("model", lambda: _kalmans(model=_walk())),
        ("sensors", lambda: _kalmans(sensors=SENSORS)),
        ("graph", lambda: _kalmans(graph=Graph.from_adjacency([[0]]))),
        ("fuse", lambda: _kalmans(fuse=3)),
        ("faults", lambda: _kalmans(faults=Faults(delay=1))),
        ("mean", lambda: _kalmans().start([1.0], np.eye(6))),
        ("cov", lambda: _kalmans().start(X0, -np.eye(6))),
        ("runs", lambda: _kalmans().start(X0, np.eye(6), runs=(0,))),
        ("state", lambda: _kalmans().step(S, 0.1, [None] * 3)),
        ("t", lambda: _kalmans().step(_kalmans().start(X0, np.eye(6)), 0.0, [None] * 3)),
        ("truth", lambda: _kalmans().run(
            _kalmans().start(X0, np.eye(6)), [0.1], [None] * 3, truth=np.zeros((2, 6)))),
    ],
    _G + "GaussianState": [
        ("means", lambda: GaussianState(0.0, np.zeros(3), np.eye(3), Ledger.empty(1))),
        ("covariances", lambda: GaussianState(
            0.0, np.zeros((1, 2)), -np.eye(2)[None], Ledger.empty(1))),
        ("ledger", lambda: GaussianState(
            0.0, np.zeros((1, 2)), np.eye(2)[None], Ledger.empty(2))),
    ],
    "distfilt.filters.record.as_dataset": [
        ("states", lambda: as_dataset([S], TIMES, F.model, S)),
        ("truth", lambda: as_dataset([S], [0.1], F.model, S, np.zeros((2, 6)))),
        ("scores", lambda: as_dataset([S], [0.1], F.model, S, scores=["rmse"])),
    ],
}
EXEMPT = {
    "distfilt.filters.assimilation.Update": "a type",
    "distfilt.filters.record.SCORES": "a constant",
}


def test_stepping_a_state_twice_gives_the_same_bits() -> None:
    a, b = F.step(S, 0.1, OBS), F.step(S, 0.1, OBS)
    assert (a.ensembles == b.ensembles).all()
    assert S.t == 0.0 and S.ledger.rounds == 0


def test_a_run_is_its_steps() -> None:
    truth, obs = _data()
    run = F.run(S, TIMES, obs, truth=truth)
    states = list(F.steps(S, TIMES, obs))
    assert (run["mean"].values[-1] == ensembles.mean(states[-1].ensembles)).all()
    assert run["mean"].dims == ("time", "run", "agent", "component")
    error = ((states[3].ensembles.mean(axis=-2) - truth[3][:, None, :]) ** 2).sum(axis=-1)
    assert np.allclose(run["squared_error"].values[3], error)
    assert {"nees", "crps", "spread", "variance", "scalars"} <= set(run.data_vars)


def test_a_state_is_saved_loaded_and_resumed_to_the_same_bits(tmp_path: Path) -> None:
    _, obs = _data()
    f = _satellites(lag=2)
    whole = list(f.steps(_begin(f), TIMES, obs))
    whole[3].save(tmp_path / "half.npz")
    resumed = EnsembleState.load(tmp_path / "half.npz")
    rest = list(f.steps(resumed, TIMES[4:], [o[4:] for o in obs]))
    assert (rest[-1].ensembles == whole[-1].ensembles).all()
    assert rest[-1].ledger.scalars.tolist() == whole[-1].ledger.scalars.tolist()
    assert [t for t, _ in rest[-1].history] == [t for t, _ in whole[-1].history]


@pytest.mark.parametrize("bits", [np.random.PCG64, np.random.MT19937, np.random.Philox,
                                  np.random.SFC64])
def test_any_generator_is_saved(bits: type, tmp_path: Path) -> None:
    state = EnsembleState(0.0, S.ensembles, np.random.Generator(bits(5)), S.ledger)
    state.save(tmp_path / "state.npz")
    again = EnsembleState.load(tmp_path / "state.npz")
    assert (again.rng.random(9) == state.rng.random(9)).all()


def test_a_damaged_file_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "state.npz"
    S.save(path)
    content = path.read_bytes()
    for broken in (content[: len(content) // 2], b"", b"text"):
        path.write_bytes(broken)
        with pytest.raises(ValueError, match="path: needs a saved filter state"):
            EnsembleState.load(path)
    with pytest.raises(FileNotFoundError):
        EnsembleState.load(tmp_path / "nothing.npz")


def test_nobody_learns_anything_except_from_neighbours() -> None:
    """Perturb one agent's members and observation: in one step only those that hear it change."""
    path = np.zeros((5, 5))
    for i in range(4):
        path[i, i + 1] = path[i + 1, i] = 1
    f = EnsembleFilter(_walk(), [direct([0], noise=0.5)] * 5, Graph.from_adjacency(path),
                       affine_update, partial(mean_pull, gain=0.1), members=20)
    prior = _rng(3).standard_normal((5, 20, 1))
    obs = [[0.1 * i] for i in range(5)]
    base = f.step(f.start(prior, rng=_rng()), 1.0, obs)
    changed = prior.copy()
    changed[0] += 7.0
    other = f.step(f.start(changed, rng=_rng()), 1.0, [[5.0], *obs[1:]])
    moved = [bool((a != b).any()) for a, b in zip(base.ensembles, other.ensembles, strict=True)]
    # The observation reaches agent 1, whose mean reaches agent 2 in the same step, no further.
    assert moved == [True, True, True, False, False]
    second = [f.step(s, 2.0, obs).ensembles for s in (base, other)]
    moved = [bool((a != b).any()) for a, b in zip(*second, strict=True)]
    assert moved == [True, True, True, True, False]


def test_locality_of_each_round() -> None:
    """Without a consensus round, and without an observation, not even the neighbour changes."""
    f = _satellites(consensus=None)
    prior = _rng(3).standard_normal((3, 40, 6))
    changed = prior.copy()
    changed[1] += 1.0
    a, b = (f.step(f.start(p, rng=_rng()), 0.1, [None] * 3).ensembles for p in (prior, changed))
    assert (a[0] == b[0]).all() and (a[2] == b[2]).all() and (a[1] != b[1]).any()


def test_everything_that_is_sent_is_charged() -> None:
    after = F.step(S, 0.1, OBS)
    # Observations of 2, 1 and 3 numbers, then means of 6, on 2, 1 and 1 links.
    assert after.ledger.scalars.tolist() == [2 * (2 + 6), 1 + 6, 3 + 6]
    assert after.ledger.rounds == 2


def test_runs_are_independent() -> None:
    """The first run of a batch does not depend on the data of the others."""
    truth, obs = _data()
    other = [o.copy() for o in obs]
    for o in other:
        o[:, 1:] += 0.7
    a, b = (F.run(S, TIMES, o)["mean"].values for o in (obs, other))
    assert (a[:, 0] == b[:, 0]).all() and (a[:, 1] != b[:, 1]).any()


def test_a_missing_component_is_a_sensor_without_it() -> None:
    """NaN in one component gives the bits of a network whose sensor never had it."""
    f = EnsembleFilter(F.model, [direct([0, 1], noise=0.2)], Graph.from_adjacency([[0]]),
                       affine_update, members=40)
    g = EnsembleFilter(F.model, [direct([1], noise=0.2)], Graph.from_adjacency([[0]]),
                       affine_update, members=40)
    prior = X0 + _rng(3).standard_normal((40, 6))
    a = f.step(f.start(prior, rng=_rng()), 0.1, [[NAN, 0.3]])
    b = g.step(g.start(prior, rng=_rng()), 0.1, [[0.3]])
    assert (a.ensembles == b.ensembles).all()


def test_gaps_that_differ_by_run() -> None:
    _, obs = _data()
    obs[0][2, 0] = NAN
    obs[0][2, 1, 0] = NAN
    obs[2][2, 2] = NAN
    run = F.run(S, TIMES, obs)
    assert np.isfinite(run["mean"].values).all()
    none = F.run(S, TIMES, [None] * 3)
    assert run["spread"].values[-1].max() < none["spread"].values[-1].min()


def test_irregular_times_reach_the_same_forecast() -> None:
    """Without noise and observations the path does not matter."""
    f = _satellites(model=clohessy_wiltshire(rate=0.1, sigma=0.0), consensus=None)
    ends = [f.run(_begin(f), times, [None] * 3)["mean"].values[-1]
            for times in ([0.1, 0.2, 0.7], [0.05, 0.7])]
    assert np.allclose(*ends, atol=1e-10)


def test_a_late_observation_repairs_most_of_the_damage() -> None:
    """Exact for a linear model and an exact ensemble: a late reading is as good as a timely one."""
    f = EnsembleFilter(_walk(), [direct([0], noise=0.3)], Graph.from_adjacency([[0]]),
                       affine_update, members=20_000, lag=3)
    start = f.start(partial(ensembles.draw, [0.0], [[1.0]]), rng=_rng(5))
    times, values = np.array([1.0, 2.0, 3.0]), np.array([[2.0], [NAN], [2.5]])
    timely = list(f.steps(start, times, [values]))[-1].ensembles[0]
    held = np.array([[NAN], [NAN], [2.5]])
    late = [Late(0, 1.0, [2.0], arrived=3.0)]
    repaired = list(f.steps(start, times, [held], late=late))[-1].ensembles[0]
    ignored = list(f.steps(start, times, [held]))[-1].ensembles[0]
    error = 4 * timely.std() / np.sqrt(len(timely))
    assert abs(repaired.mean() - timely.mean()) < error
    assert abs(ignored.mean() - timely.mean()) > 2 * error
    assert abs(repaired.std() / timely.std() - 1) < 0.03


def test_history_is_as_long_as_the_lag() -> None:
    f = _satellites(lag=3)
    states = list(f.steps(_begin(f), TIMES, _data()[1]))
    assert [t for t, _ in states[-1].history] == pytest.approx(TIMES[-4:-1])
    assert _satellites().step(S, 0.1, OBS).history == ()


def test_a_differential_sensor_learns_the_speed() -> None:
    """Changes alone: the velocity is found, the position is not."""
    f = EnsembleFilter(F.model, [differential([0, 1, 2], noise=0.01)],
                       Graph.from_adjacency([[0]]), affine_update, members=200)
    times = np.round(0.1 * np.arange(1, 31), 10)
    rng = _rng(4)
    truth = simulate(F.model, X0, times, rng=rng)
    before = np.vstack([X0, truth[:-1]])
    seen = f.sensors[0].observe(truth, previous=before, rng=rng)
    run = f.run(f.start(partial(ensembles.draw, X0 + 3, 25 * np.eye(6)), rng=rng), times, [seen])
    start, end = run["variance"].values[0, 0], run["variance"].values[-1, 0]
    assert (end[3:] < 0.1 * 25).all() and (end[:3] > 0.1 * start[:3]).all()


def test_a_time_varying_graph() -> None:
    empty = Graph.from_adjacency(np.zeros((3, 3)))
    f = _satellites(graph=lambda t: STAR if t > 0.45 else empty)
    run = f.run(_begin(f), TIMES, _data()[1])
    sent = run["messages"].values.sum(axis=1)
    assert (sent[:4] == 0).all() and (np.diff(sent[3:]) > 0).all()


def test_losing_everything_is_being_alone() -> None:
    """With certain loss each agent does what it would do on a graph without links."""
    alone = Graph.from_adjacency(np.zeros((3, 3)))
    truth, obs = _data()
    lossy = _satellites(faults=Faults(loss=1.0), consensus=partial(mean_pull, gain=0.05,
                                                                   include_self=False))
    single = _satellites(graph=alone, consensus=None)
    a, b = (f.run(_begin(f), TIMES, obs)["mean"].values for f in (lossy, single))
    assert np.allclose(a, b, rtol=1e-12, atol=1e-12)


def test_losses_differ_between_runs_and_are_counted() -> None:
    f = _satellites(faults=Faults(loss=0.5, seed=3))
    run = f.run(_begin(f), TIMES, _data()[1])
    sent, lost = run["messages"].values[-1].sum(), run["lost"].values[-1].sum()
    assert 0.25 < lost / sent < 0.75
    assert np.isfinite(run["mean"].values).all()


def test_pca_and_no_consensus_run_and_dimensions_without_runs() -> None:
    f = _satellites(update=partial(pca_update, n_state=4, n_observed=3), consensus=None)
    run = f.run(_begin(f, runs=()), TIMES, [o[:, 0] for o in _data()[1]])
    assert run["mean"].dims == ("time", "agent", "component")
    assert np.isfinite(run["mean"].values).all()


def _linear_data(runs: int, steps: int) -> tuple[np.ndarray, np.ndarray, list[np.ndarray]]:
    rng, times = _rng(8), np.round(0.1 * np.arange(1, steps + 1), 10)
    truth = simulate(F.model, np.broadcast_to(X0, (runs, 6)), times, rng=rng)
    return times, truth, [s.observe(truth, rng=rng) for s in LINEAR]


def test_the_centre_of_a_network_of_kalman_filters_is_the_kalman_filter() -> None:
    """Agent A hears both others: sharing observations makes it the central filter."""
    from distfilt.kalman.linear import kalman_filter

    times, truth, obs = _linear_data(4, 12)
    obs[1][3, 1] = NAN
    obs[2][5, 0, 1] = NAN
    f = _kalmans(share=True)
    run = f.run(f.start(X0 + 3, 25 * np.eye(6), runs=(4,)), times, obs, truth=truth)
    best = kalman_filter(
        X0 + 3, 25 * np.eye(6), np.concatenate(obs, axis=-1),
        F=F.model.transition(0.1), Q=F.model.noise(0, 0.1),
        H=np.vstack([s.matrix(6) for s in LINEAR]), R=np.diag([0.04] * 4 + [0.01] * 3),
    )
    # Times are differences of rounded numbers, so transitions agree to 1e-14, not to the bit.
    assert np.allclose(run["mean"].values[:, :, 0], best.means, atol=1e-9)
    assert np.allclose(run["covariance"].values[:, :, 0], best.covariances, atol=1e-9)
    assert {"nees", "squared_error", "scalars"} <= set(run.data_vars)


def test_only_the_wanted_scores_are_recorded() -> None:
    truth, obs = _data()
    run = F.run(S, TIMES, obs, truth=truth, scores=["nees"])
    assert "nees" in run and "crps" not in run and "squared_error" not in run


def test_fused_kalman_filters_learn_from_each_other() -> None:
    times, truth, obs = _linear_data(4, 60)
    alone, fused = (
        f.run(f.start(X0 + 3, 25 * np.eye(6), runs=(4,)), times, obs, truth=truth)
        for f in (_kalmans(), _kalmans(fuse=covariance_intersection))
    )
    last = [r["squared_error"].values[-1].mean(axis=0) for r in (alone, fused)]
    assert (last[1] < last[0]).all()
    assert fused["scalars"].values[-1].tolist() == [60 * 27 * n for n in (2, 1, 1)]


@pytest.mark.slow
def test_linear_check_case_against_the_kalman_filter() -> None:
    """With a direct sensor for B the centre's affine filter comes within 12% of the optimum."""
    from distfilt.kalman.linear import kalman_filter

    runs, times = 96, np.round(0.1 * np.arange(1, 201), 10)
    linear = (SENSORS[0], direct([1, 2], noise=0.2), SENSORS[2])
    rng = _rng(11)
    truth = simulate(F.model, np.broadcast_to(X0, (runs, 6)), times, rng=rng)
    obs = [s.observe(truth, rng=rng) for s in linear]
    centre = [direct([0, 1], noise=0.2), linear[1], linear[2]]
    f = _satellites(sensors=tuple(centre), consensus=None, members=200)
    run = f.run(_begin(f, runs=(runs,)), times, obs, truth=truth)
    ours = run["squared_error"].sel(time=slice(10.05, None)).values[..., 0].mean()
    best = kalman_filter(
        X0 + 3, 25 * np.eye(6), np.concatenate(obs, axis=-1),
        F=F.model.transition(0.1), Q=F.model.noise(0, 0.1),
        H=np.vstack([s.matrix(6) for s in linear]),
        R=np.diag([0.04] * 4 + [0.01] * 3),
    )
    optimum = ((best.means[100:] - truth[100:]) ** 2).sum(axis=-1).mean()
    assert optimum <= ours <= 1.12 * optimum


@pytest.mark.slow
def test_linear_check_case_with_known_noise_and_intersection() -> None:
    """Every agent within 10% of the Kalman filter with all sensors, and honest about it."""
    from distfilt.filters.agreement import intersection_agreement
    from distfilt.kalman.linear import kalman_filter
    from distfilt.triangular.regularised import known_noise_update

    runs = 48
    times, truth, obs = _linear_data(runs, 200)
    best = kalman_filter(
        X0 + 3, 25 * np.eye(6), np.concatenate(obs, axis=-1),
        F=F.model.transition(0.1), Q=F.model.noise(0, 0.1),
        H=np.vstack([s.matrix(6) for s in LINEAR]), R=np.diag([0.04] * 4 + [0.01] * 3),
    )
    optimum = ((best.means[100:] - truth[100:]) ** 2).sum(axis=-1).mean()
    fuse = partial(intersection_agreement, weights="trace")
    for consensus, limit in ((fuse, 1.10), (None, 1.05)):
        f = _satellites(
            sensors=LINEAR, update=known_noise_update, consensus=consensus, members=200
        )
        run = f.run(_begin(f, runs=(runs,)), times, obs, truth=truth)
        late = run.sel(time=slice(10.05, None))
        error = late["squared_error"].mean(("time", "run")).values
        nees = late["nees"].mean(("time", "run")).values / 6
        # Without agreement only agent A, who hears both others, has all the data.
        checked = slice(None) if consensus is not None else slice(0, 1)
        assert (error[checked] < limit * optimum).all()
        assert ((nees[checked] > 0.85) & (nees[checked] < 1.15)).all()
