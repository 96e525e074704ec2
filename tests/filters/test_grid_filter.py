"""Grid filters: against Kalman filters, quadrature, and one filter of all observations."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
import pytest
from scipy.stats import multivariate_normal, norm

from distfilt.density import Grid
from distfilt.filters import FilterError, GridFilter
from distfilt.mixtures import GaussianMixture
from distfilt.models import LinearModel, Model
from distfilt.network import (
    Faults,
    average_consensus,
    covariance_intersection,
    finite_time_consensus,
    graphs,
)
from distfilt.sensors import LikelihoodSensor, Sensor, bearing, component
from tests.filters.families import (
    PRIOR,
    PRIOR_COV,
    PRIOR_MEAN,
    TIMES,
    Q,
    data,
    model,
    still_model,
    team,
)

BOX = Grid((60, 60), low=-6.0, high=6.0)
LINE = Grid((400,), low=-8.0, high=8.0)
NET = graphs.path(5)
# Wider noise than the other tests have: a step of 0.1 s spreads over a cell.
WIDE = LinearModel.from_transition(
    2, model().transition_matrix, lambda t, dt: (0.1 + dt) * Q
)


def last_of(f: Any, prior: Any, seen: Any, runs: tuple[int, ...] = ()) -> Any:
    start = f.start(prior, runs=runs)
    *_, last = f.steps(start, TIMES, seen)
    return last


# Accuracy.


def test_linear_beliefs_are_those_of_kalman_filters() -> None:
    """To the accuracy of sums in place of integrals, which is far beyond the cell's width."""
    from distfilt.filters import GaussianFilter

    sensors = team()
    _, seen = data(sensors)
    # All agents have all observations, so that both are one filter of all of them.
    f = GridFilter(WIDE, sensors, NET, grid=BOX, hops="all")
    g = GaussianFilter(WIDE, sensors, NET, hops="all")
    a = f.summarize(last_of(f, PRIOR, seen))
    b = g.summarize(last_of(g, PRIOR, seen))
    assert np.allclose(a.mean, b.mean, atol=2e-5)
    assert np.allclose(a.covariance, b.covariance, atol=2e-5)


@pytest.mark.parametrize("d", [1, 3])
def test_one_and_three_dimensions(d: int) -> None:
    from distfilt.filters import GaussianFilter

    walk = still_model(d, 0.2)
    sensors = [component([0], std=0.8), component([d - 1], std=0.9)]
    grid = Grid((15,) * d, low=-3.0, high=3.2)
    prior = (0.1 * np.ones(d), 0.3 * np.eye(d))
    f = GridFilter(walk, sensors, graphs.path(2), grid=grid)
    g = GaussianFilter(walk, sensors, graphs.path(2))
    seen = [[0.5], [-0.4]]
    a = f.summarize(f.step(f.start(prior), 1.0, seen))
    b = g.summarize(g.step(g.start(prior), 1.0, seen))
    assert np.allclose(a.mean, b.mean, atol=1e-3)
    assert np.allclose(a.covariance, b.covariance, atol=1e-3)


def test_two_peaks_by_quadrature() -> None:
    x = np.linspace(-8.0, 8.0, 40001)
    posterior = norm(0.3, 1.0).pdf(x) * norm(x**2, 0.2).pdf(1.0)
    posterior /= np.trapezoid(posterior, x)
    mean = np.trapezoid(posterior * x, x)
    variance = np.trapezoid(posterior * (x - mean) ** 2, x)
    f = GridFilter(
        still_model(1),
        [Sensor(1, lambda x: x**2, [[0.04]])],
        grid=LINE,
        record_evidence=True,
    )
    start = f.start(([0.3], [[1.0]]))
    state = f.step(start, 0.0, [[1.0]])
    summary = f.summarize(state)
    assert abs(summary.mean.item() - mean) < 1e-6
    assert abs(summary.variance.item() - variance) < 1e-6
    prior = norm(0.3, 1.0).pdf(x)
    likelihood = norm(x**2, 0.2).pdf(1.0)
    evidence = np.trapezoid(prior * likelihood, x)
    assert abs(state.log_likelihood.item() - np.log(evidence)) < 1e-6


def test_a_nonlinear_transition_by_its_integral() -> None:
    """p(x) = ∫ N(x; f(z), q) p(z) dz, on a finer grid."""

    def bend(x: np.ndarray, t: float, dt: float) -> np.ndarray:
        return x + 2.0 * np.sin(x) * dt + t

    f = GridFilter(Model(1, bend, lambda t, dt: 0.1 * np.eye(1)), [None], grid=LINE)
    start = f.start(([0.3], [[1.0]]), t=0.5)
    state = f.step(start, 1.0, [None])
    z = np.linspace(-8.0, 8.0, 4001)
    # The density at the centres, times the volume of a cell
    transition = norm(bend(z, 0.5, 0.5), np.sqrt(0.1)).pdf(LINE.centres)
    p = transition * norm(0.3, 1.0).pdf(z)
    expected = np.trapezoid(p, z, axis=1) * LINE.volume
    assert np.allclose(state.masses[0], expected, atol=1e-8)


def test_correlated_noise_of_transition_and_sensor() -> None:
    """The kernel has the whole covariance, as N(x; f, Q) has."""
    from distfilt.filters import GaussianFilter

    q = np.array([[0.3, 0.2], [0.2, 0.3]])
    walk = Model(2, lambda x, t, dt: x, lambda t, dt: q)
    r = np.array([[0.5, -0.3], [-0.3, 0.4]])
    sensors = [Sensor(2, lambda x: x, r, linear=np.eye)]
    f = GridFilter(walk, sensors, grid=BOX)
    g = GaussianFilter(walk, sensors)
    a = f.summarize(f.step(f.start(PRIOR), 1.0, [[0.5, 0.2]]))
    b = g.summarize(g.step(g.start(PRIOR), 1.0, [[0.5, 0.2]]))
    assert np.allclose(a.mean, b.mean, atol=1e-5)
    assert np.allclose(a.covariance, b.covariance, atol=1e-5)


def test_priors_of_all_kinds() -> None:
    mixture = GaussianMixture([0.3, 0.7], [[-2.0, 0.0], [2.0, 0.0]], [np.eye(2)] * 2)
    law = multivariate_normal(PRIOR_MEAN, PRIOR_COV)
    f = GridFilter(model(), [None], grid=BOX)
    for prior, mean, cov in (
        (mixture, *mixture.moments()),
        (law, PRIOR_MEAN, PRIOR_COV),
        (PRIOR, PRIOR_MEAN, PRIOR_COV),
    ):
        summary = f.summarize(f.start(prior))
        assert np.allclose(summary.mean, mean, atol=1e-4)
        assert np.allclose(summary.covariance, cov, atol=1e-3)


# Exchange.


def test_averaged_likelihoods_are_all_observations() -> None:
    """With an exact average the same as flooding them, for any sensors."""
    sensors = [
        component([0], std=0.5),
        Sensor(1, lambda x: np.hypot(x[..., :1], x[..., 1:]), [[0.1]]),
        bearing([0, 1], std=0.3),
        component([1], std=0.7),
        None,
    ]
    # A distance and a bearing among them, whose likelihoods are not Gaussian.
    seen: list[Any] = [[0.8], [1.1], [0.4], [0.2], None]
    f = GridFilter(
        WIDE,
        sensors,
        NET,
        grid=BOX,
        share_observations=False,
        fused="likelihoods",
        fusion=finite_time_consensus,
    )
    g = GridFilter(WIDE, sensors, NET, grid=BOX, hops="all")
    a = f.step(f.start(PRIOR), 1.0, seen)
    b = g.step(g.start(PRIOR), 1.0, seen)
    assert np.allclose(a.masses, b.masses, atol=1e-9)
    # n numbers on each link and round
    assert (a.ledger.scalars == 3600 * a.ledger.messages).all()


def test_averaged_beliefs_are_geometric_means() -> None:
    """Of Gaussian beliefs covariance intersection with the same weights."""
    sensors = [component([0], std=0.5), component([1], std=0.5)]
    f = GridFilter(
        still_model(2),
        sensors,
        graphs.path(2),
        grid=BOX,
        share_observations=False,
        fusion=average_consensus,
    )
    from distfilt.filters import GaussianFilter

    g = GaussianFilter(
        still_model(2),
        sensors,
        graphs.path(2),
        share_observations=False,
        fusion=covariance_intersection,
    )
    seen = [[0.8], [-0.3]]
    a = f.summarize(f.step(f.start(PRIOR), 0.0, seen))
    b = g.summarize(g.step(g.start(PRIOR), 0.0, seen))
    assert np.allclose(a.mean, b.mean, atol=1e-4)
    assert np.allclose(a.covariance, b.covariance, atol=1e-4)


# All else that a filter meets.


def test_runs_gates_losses_and_files(tmp_path: Any) -> None:
    sensors = team()
    _, seen = data(sensors, (3,))
    seen[0][1, 1] += 50.0
    f = GridFilter(
        WIDE,
        sensors,
        NET,
        grid=BOX,
        gate_probability=0.999,
        faults=Faults(loss=0.3, seed=1),
    )
    state = f.start(PRIOR, runs=(3,))
    # One observation of one run is far off.
    rejected = np.zeros((3, 5))
    for k, t in enumerate(TIMES):
        observed = [None if y is None else y[k] for y in seen]
        state = f.step(state, float(t), observed)
        rejected += state.rejected
    assert (rejected[1, 0] > 0).all()
    assert rejected[[0, 2]].sum() <= 2
    state.save(tmp_path / "state.npz")
    loaded = f.state_class.load(tmp_path / "state.npz")
    assert (loaded.log_masses == state.log_masses).all()
    run = f.run(f.start(PRIOR, runs=(3,)), TIMES, seen)
    assert np.allclose(run["mean"][-1], f.summarize(state).mean)


def test_a_run_in_which_nothing_is_possible_fails_alone() -> None:
    f = GridFilter(
        still_model(1),
        [Sensor(1, lambda x: np.where(x > 0, 1.0, np.nan), [[1e-3]])],
        grid=LINE,
        on_error="keep",
    )
    # In the second run the value is beyond every cell's prediction.
    state = f.start(([0.0], [[1.0]]), runs=(2,))
    with np.errstate(over="ignore"):
        state = f.step(state, 0.0, [np.array([[1.0], [1e300]])])
    assert state.failed.tolist() == [False, True]
    # Cells that cannot see what was seen have no probability.
    assert state.masses[0, 0, :200].max() < 1e-300
    f = GridFilter(still_model(1), f.sensors, grid=LINE)
    text = "every cell has a likelihood of zero"
    with pytest.raises(FilterError, match=text), np.errstate(over="ignore"):
        f.step(f.start(([0.0], [[1.0]])), 0.0, [[1e300]])


def test_counts_as_a_likelihood() -> None:
    """A Poisson count of the rate exp(x), against the posterior by quadrature."""

    def log_density(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return np.asarray((y * x - np.exp(x))[..., 0])

    sensor = LikelihoodSensor(1, log_density)
    f = GridFilter(still_model(1), [sensor], grid=LINE)
    start = f.start(([0.0], [[1.0]]))
    state = f.step(start, 0.0, [[3.0]])
    x = LINE.centres[:, 0]
    # Poisson likelihood times the normal prior
    log_likelihood = 3 * x - np.exp(x)
    expected = np.exp(log_likelihood - 0.5 * x**2)
    assert np.allclose(state.masses[0], expected / expected.sum(), atol=1e-12)


def test_a_box_that_is_too_small_warns_once() -> None:
    f = GridFilter(still_model(1, 4.0), [None], grid=Grid((40,), low=-3.0, high=3.0))
    # Its deviation grows by two in a step, to beyond the box.
    state = f.start(([0.0], [[1.0]]))
    with pytest.warns(RuntimeWarning, match="grid must have a box in which") as caught:
        for t in (1.0, 2.0, 3.0):
            state = f.step(state, t, [None])
    assert len(caught) == 1
    assert np.allclose(state.masses.sum(), 1.0)


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"grid": LINE}, "^grid must have 2 axes, got 1"),
        ({"fused": "likelihoods"}, "^fused must be 'beliefs' unless"),
        (
            {"fusion": covariance_intersection},
            "^fusion must be a rule that fuses vectors",
        ),
    ],
)
def test_what_is_refused(change: dict[str, Any], text: str) -> None:
    options: dict[str, Any] = {"grid": BOX} | change
    with pytest.raises(ValueError, match=text):
        GridFilter(model(), [None] * 2, graphs.path(2), **options)


def test_a_grid_that_is_too_coarse_or_elsewhere() -> None:
    f = GridFilter(model(), [None], grid=BOX)
    with pytest.raises(ValueError, match="^prior must have its probability in the box"):
        f.start((PRIOR_MEAN + 50, PRIOR_COV))
    slow = Model(2, lambda x, t, dt: x, lambda t, dt: 1e-4 * np.eye(2))
    f = GridFilter(slow, [None], grid=BOX)
    with pytest.raises(
        (ValueError, FilterError), match="grid must have cells no wider"
    ):
        f.step(f.start(PRIOR), 1.0, [None])


def test_a_belief_at_the_edge_of_the_box_is_told_once() -> None:
    """A state beyond the box, as of a robot off its map (beluga issue 420)."""
    eye = component([0], std=0.5)
    still = Model(1, lambda x, t, dt: x, lambda t, dt: np.zeros((1, 1)))
    f = GridFilter(still, [eye], grid=Grid((60,), low=-6.0, high=6.0))
    state = f.start(([0.0], [[4.0]]))
    with pytest.warns(RuntimeWarning, match="is in the outermost cells") as caught:
        state = f.step(state, 1.0, [[20.0]])
        state = f.step(state, 2.0, [[20.5]])
    assert len(caught) == 1
    # Within the box nothing is said, nor on grids that have few cells.
    with warnings.catch_warnings(action="error"):
        f.step(f.start(([0.0], [[4.0]])), 1.0, [[5.0]])
        few = GridFilter(still, [eye], grid=Grid((4,), low=-6.0, high=6.0))
        few.step(few.start(([0.0], [[4.0]])), 1.0, [[5.0]])
