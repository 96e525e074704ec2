"""The set-ups of Tables II and III of Grange et al., for the stored studies and for chapter 4.

A trial of these studies is a batch of a few runs, because a filter steps through five
runs in hardly more time than through one. The columns of a run end in its number within
the batch.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from functools import partial
from types import ModuleType
from typing import Any, Literal

import numpy as np

from bookkit import studies
from bookkit.published import Scenario, scenario
from distfilt.filters import EnsembleFilter
from distfilt.models import Model, clohessy_wiltshire, satellite_pose, simulate
from distfilt.network import Graph, intersect_ensembles, mean_pull
from distfilt.sensors import Sensor, from_name
from distfilt.updates import (
    enkf,
    enkf_sampled_covariance,
    principal_components,
    principal_directions,
    transport_map_update,
    update,
)
from distfilt.updates.decorator import Update, wraps_update

PAPER = "grange"
SEED = 2024
EVERY = 5
"""A comparison over time is stored at every fifth step: at 0.5 s, 1 s, ..."""


@dataclass(frozen=True, eq=False)
class Setup:
    """The set-up of one table, read from its scenario when it is made."""

    scenario: Scenario
    model: Model
    still: Model
    sensors: tuple[Sensor, ...]
    graph: Graph
    names: tuple[str, ...]
    start: np.ndarray
    prior: tuple[np.ndarray, np.ndarray]
    times: np.ndarray
    settled: np.ndarray
    members: int
    runs: int
    pca: dict[str, int]
    pull: dict[str, Any]
    made: tuple[str, dict[str, Any]]

    def __reduce__(self) -> Any:
        """A worker makes the set-up again, since a model's functions cannot be pickled."""
        return partial(setup, self.made[0], **self.made[1]), ()

    @property
    def is_changed(self) -> bool:
        """Whether the scenario differs from the book's own."""
        return bool(self.scenario.changes)


def setup(name: str, **changes: Any) -> Setup:
    """The set-up of ``table-2`` or ``table-3``, with other values of some parameters."""
    # A changed parameter is recorded, so that stored numbers are not used for it.
    s = scenario(PAPER, name).replace(**changes).track_reads()
    start = np.array(s["initial_state"])
    dt = s["dt_observe"]
    if name == "table-2":
        make = partial(clohessy_wiltshire, rate=s["orbital_rate"])
        offset = s["prior_offset"] * np.ones(6)
        variance = s["prior_variance"] * np.ones(6)
    elif name == "table-3":
        make = partial(
            satellite_pose, rate=s["orbital_rate"], step=s["integration_step"]
        )
        if make(sigma=0.0).names != tuple(s["state_order"]):
            raise ValueError(
                f"state_order must be that of satellite_pose, got {s['state_order']}"
            )
        # Translation and attitude have priors of their own.
        moved = s["prior_offset_translation"]
        wide = s["prior_variance_translation"]
        turned = s["prior_offset_attitude"]
        loose = s["prior_variance_attitude"]
        offset = np.repeat([moved, turned], [6, 7])
        variance = np.repeat([wide, loose], [6, 7])
    # Observation times t_1 ... t_n, without rounding errors
    n = round((s["end_time"] - s["first_observation"]) / dt) + 1
    times = np.round(s["first_observation"] + dt * np.arange(n), 10)
    return Setup(
        s,
        make(sigma=s["process_noise"]),
        make(sigma=0.0),
        tuple(from_name(a.kind, a.dims, std=a.noise) for a in s.agents),
        Graph.from_adjacency(s.adjacency),
        tuple(a.name for a in s.agents),
        start,
        (start + offset, np.diag(variance)),
        times,
        times > s["average_from"] + dt / 2,
        s["members"],
        s["runs"],
        {"n_state": s["pca_state"], "n_observed": s["pca_observation"]},
        {
            "gain": s["gain"],
            "rounds": s["consensus_rounds"],
            "include_self": s["consensus_includes_self"],
        },
        (name, changes),
    )


def draw_data(
    s: Setup, rng: np.random.Generator, runs: tuple[int, ...], *, noisy: bool = True
) -> tuple[np.ndarray, list[np.ndarray]]:
    """The truth (T, *runs, d), with process noise or without, and each agent's observations."""
    start = np.broadcast_to(s.start, (*runs, s.start.size))
    truth = simulate(s.model if noisy else s.still, start, s.times, rng=rng)
    # Sensors of increments see the state at the previous observation too.
    before = np.concatenate([start[None], truth[:-1]])
    seen = [
        q.observe(truth, rng=rng, previous=before if q.uses_previous else None)
        for q in s.sensors
    ]
    return truth, seen


def paper_filter(
    s: Setup,
    *,
    pca: bool,
    noise_factor: float = 1.0,
    angles: Literal["each", "together"] = "each",
    **changes: Any,
) -> EnsembleFilter:
    """Algorithm 1 of the paper, in principal components (Algorithm 2) or without.

    Without them the update is `enkf_sampled_covariance`, which is the affine map in
    closed form. The paper does not say how an angle wraps. With ``angles="each"`` every
    member's prediction is brought near the observation by itself, so that each
    innovation is the shorter way round; with ``"together"`` the library brings an
    ensemble's predictions onto one branch first, and moves them as one.
    """
    # q_x and q_y of the table
    options = s.pca if pca else {}
    # Predictions with less noise than stated, for other interpretations of the text
    if noise_factor == 0:
        rule: Any = partial(noise_free_update, **options)
    elif pca:
        rule = partial(principal_components, noise_factor=noise_factor, **options)
    else:
        full = noise_factor == 1
        rule = (
            enkf_sampled_covariance
            if full
            else partial(transport_map_update, noise_factor=noise_factor)
        )
    if angles == "each":
        rule = align_each(rule)
    # The consensus step (16)
    return _make_filter(s, rule, partial(mean_pull, **(s.pull | changes)))


def align_each(rule: Update) -> Update:
    """Return an update that gets each prediction of an angle near the observation by itself."""

    @wraps_update(rule)
    def update_aligned(
        ensemble: np.ndarray,
        predicted: np.ndarray,
        observed: np.ndarray,
        noise: np.ndarray,
        *,
        rng: np.random.Generator,
    ) -> np.ndarray:
        return np.asarray(rule(ensemble, predicted, observed, noise, rng=rng))

    # The tag by which a filter aligns predictions one by one, as for likelihoods
    vars(update_aligned)["weights_members"] = True
    return update_aligned


@update
def noise_free_update(
    ensemble: np.ndarray,
    predicted: np.ndarray,
    observed: np.ndarray,
    noise: np.ndarray,
    *,
    rng: np.random.Generator,
    n_state: int | None = None,
    n_observed: int | None = None,
) -> np.ndarray:
    """The update of Algorithm 2 with predictions without noise, a mistake that is shown.

    The members then determine the predictions, and where these are singular a map does
    not exist; a pseudo-inverse gives the gain that is nearest to it.
    """
    # Members and predictions in their principal components
    d = ensemble.shape[-1]
    m = predicted.shape[-1]
    w = principal_directions(ensemble, n_state or d)
    v = principal_directions(predicted, min(n_observed or m, m))
    x = ensemble @ w
    h = predicted @ v
    dx = x - x.mean(axis=-2, keepdims=True)
    dh = h - h.mean(axis=-2, keepdims=True)
    transposed = np.swapaxes(dh, -1, -2)
    # K = (dHᵀdH)⁺ dHᵀdX, without any noise covariance
    gain = np.linalg.pinv(transposed @ dh, hermitian=True, rtol=1e-12) @ (
        transposed @ dx
    )
    # Back to the state by W, with the part outside the leading directions kept
    step = (observed[..., None, :] @ v - h) @ gain
    return np.asarray(ensemble + step @ np.swapaxes(w, -1, -2))


def better_filter(s: Setup, kind: str) -> EnsembleFilter:
    """Return a filter of the section "Better", by its update and its fusion rule."""
    # Least trace, each component in units of its prior deviation
    fuse = partial(
        intersect_ensembles, rule="trace", scale=np.sqrt(np.diag(s.prior[1]))
    )
    if kind == "exact":
        return EnsembleFilter.exact(
            s.model,
            s.sensors,
            s.graph,
            members=s.members,
            names=s.names,
            on_error="keep",
        )
    update_rule, fusion = {
        "sampled_fused": (enkf_sampled_covariance, fuse),
        "known_pulled": (enkf, partial(mean_pull, **s.pull)),
        "known_fused": (enkf, fuse),
        "known_best": (enkf, partial(intersect_ensembles, rule="min_determinant")),
    }[kind]
    return _make_filter(s, update_rule, fusion)


def _make_filter(s: Setup, update_rule: Any, fusion: Any) -> EnsembleFilter:
    return EnsembleFilter(
        s.model,
        s.sensors,
        s.graph,
        update=update_rule,
        fusion=fusion,
        members=s.members,
        names=s.names,
        on_error="keep",
    )


def run_filter(
    s: Setup,
    f: EnsembleFilter,
    seed: np.random.SeedSequence,
    truth: np.ndarray,
    seen: list[np.ndarray],
    scores: tuple[str, ...] = ("squared_error", "nees"),
) -> Any:
    """The filter on a batch of runs, as an xarray.Dataset."""
    # Agents draw their members independently from one prior.
    begin = f.start(s.prior, rng=np.random.default_rng(seed), runs=truth.shape[1:-1])
    return f.run(begin, s.times, seen, truth=truth, scores=scores)


def round_six(value: Any) -> float:
    """Round a mean over runs to six digits, so that files stay small."""
    return float(f"{float(value):.6g}")


def score_runs(
    s: Setup, name: str, result: Any, *, each_agent: bool = True
) -> dict[str, float]:
    """Return each run's settled error (of each agent), NEES/d, and distance of the means."""
    # Means over the settled times. A run that fails has NaN from then on, and no mean: by
    # default xarray skips NaN, and a sum of nothing but NaN is zero.
    late = result.isel(time=s.settled)
    error = late["total_squared_error"].mean("time", skipna=False).values
    # Squared distance of the agents' means from their common mean
    deviations = late["mean"] - late["mean"].mean("agent", skipna=False)
    squares = (deviations**2).sum("component", skipna=False)
    distances = squares.mean(("time", "agent"), skipna=False).values
    # NEES per component, 1 for a consistent filter
    nees = (
        late["nees"].mean(("time", "agent"), skipna=False).values / s.model.dim
        if "nees" in late
        else None
    )
    # One column a run of the batch
    columns: dict[str, float] = {}
    for r in range(error.shape[0]):
        if each_agent:
            columns |= {
                f"{name}_mse_{a}_{r}": float(error[r, k]) for k, a in enumerate(s.names)
            }
            columns[f"{name}_apart_{r}"] = float(distances[r])
        else:
            columns[f"{name}_mse_{r}"] = float(error[r].mean())
        if nees is not None:
            columns[f"{name}_nees_{r}"] = float(nees[r])
    return columns


def score_columns(
    s: Setup, name: str, batch: int, *, each_agent: bool = True
) -> list[str]:
    """Return the names of the columns of `score_runs` with NEES."""
    columns = []
    for r in range(batch):
        if each_agent:
            columns += [f"{name}_mse_{a}_{r}" for a in s.names] + [f"{name}_apart_{r}"]
        else:
            columns += [f"{name}_mse_{r}"]
        columns += [f"{name}_nees_{r}"]
    return columns


def time_series(name: str, error: np.ndarray, nees: np.ndarray) -> dict[str, float]:
    """Return means over the runs (T, R, ...) of a batch, of error and NEES/d, every fifth step."""
    columns = {}
    for k in range(EVERY - 1, error.shape[0], EVERY):
        columns[f"{name}_e{k:03d}"] = round_six(error[k].mean())
        columns[f"{name}_n{k:03d}"] = round_six(nees[k].mean())
    return columns


def series_steps(s: Setup) -> range:
    """Return the steps at which `time_series` stores."""
    return range(EVERY - 1, s.times.size, EVERY)


def time_columns(s: Setup, name: str) -> list[str]:
    """Return the names of the columns of `time_series`."""
    return [f"{name}_{quantity}{k:03d}" for k in series_steps(s) for quantity in "en"]


def step_series(s: Setup, name: str, result: Any) -> dict[str, float]:
    """Mean over a batch's runs of every agent's squared error, at all steps."""
    # (T, A), means over the runs; with a failed run there is none.
    error = result["total_squared_error"].mean("run", skipna=False).values
    return {
        f"{name}_{a}_t{k:03d}": round_six(error[k, i])
        for k in range(error.shape[0])
        for i, a in enumerate(s.names)
    }


def step_columns(s: Setup, name: str) -> list[str]:
    """Return the names of the columns of `step_series`."""
    return [f"{name}_{a}_t{k:03d}" for k in range(s.times.size) for a in s.names]


class StudyNumbers:
    """A study's stored numbers, or those of a changed scenario, by run and over time."""

    def __init__(self, columns: Any, batch: int) -> None:
        self.columns = columns
        self.batch = batch

    @property
    def runs(self) -> int:
        """How many runs there are."""
        return self.batch * next(iter(self.columns.values())).size

    def each(self, name: str) -> np.ndarray:
        """One number a run, in the order of the runs, (runs,)."""
        # Run r of batch b is number b R + r.
        batches = [self.columns[f"{name}_{r}"] for r in range(self.batch)]
        return np.stack(batches, axis=1).ravel()

    def agents(self, name: str, agents: Any) -> np.ndarray:
        """One number an agent and run, (agents, runs)."""
        return np.array([self.each(f"{name}_{a}") for a in agents])

    def series(self, name: str, steps: Any) -> np.ndarray:
        """Means over the runs of each batch, (batches, steps)."""
        return np.stack([self.columns[f"{name}{k:03d}"] for k in steps], axis=1)


class _Repeats(dict[str, Any]):
    """Studies that run again now; a worker that is sent this module gets none of them."""

    def __reduce__(self) -> Any:
        return _Repeats, ()


_REPEATS = _Repeats()


def repeat(*scripts: ModuleType) -> None:
    """Start first batches again on all cores, or parts; `load_numbers` waits for its own."""
    from loky import ProcessPoolExecutor, cpu_count

    # A worker whose memory has grown is replaced, at no cost; the warning is not for a reader.
    warnings.filterwarnings(
        "ignore", message="A worker (stopped|was restarted) while some"
    )
    # Chapters go on while the workers compute.
    pool = ProcessPoolExecutor(cpu_count())
    for script in scripts:
        if not script.SETUP.is_changed:
            _REPEATS[script.NAME] = pool.submit(_compare_first_batch, script.NAME)


def _compare_first_batch(name: str) -> str:
    """Compare a study's first batch with the stored one; return an error message or ''.

    Where a script has a `part`, which gives some of a trial's numbers, those are
    compared.
    """
    # A worker loads the script anew.
    script = studies.script(name)
    study = studies.stored(script.PAPER, script.NAME)
    if hasattr(script, "part"):
        values = script.part(study.seed(0))
        different = [
            c
            for c, value in values.items()
            if not np.isclose(value, study.columns[c][0], script.rtol, 0)
        ]
        return (
            f"{name}: another run does not give the stored values: {different}"
            if different
            else ""
        )
    # Without a part, the whole first batch
    names = ("rtol", "ill_conditioned")
    options = {k: getattr(script, k) for k in names if hasattr(script, k)}
    try:
        studies.check(study, script.trial, indices=[0], **options)
    except AssertionError as error:
        return str(error)
    return ""


def load_numbers(script: ModuleType) -> StudyNumbers:
    """Return a study's stored numbers, after its first batch, if started, was found equal.

    Nothing is stored of a scenario that a reader has changed: two trials of it run now.
    """
    if script.SETUP.is_changed:
        # Enough to show that the cells still run
        trials = studies.run(script.trial, script.seeds[:2], workers=2)
        return StudyNumbers(trials.metrics(script.columns), script.BATCH)
    study = studies.stored(script.PAPER, script.NAME)
    message = _REPEATS[script.NAME].result() if script.NAME in _REPEATS else ""
    assert not message, message
    return StudyNumbers({c: study.metric(c) for c in script.columns}, script.BATCH)
