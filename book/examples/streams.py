"""Observations as they come: a recipe each, beside the same number computed by hand."""

from collections.abc import Callable

import numpy as np
from scipy import stats

from distfilt.filters import GaussianFilter, Observation, ParticleFilter
from distfilt.models import AgentModels, InputModel, Inputs, LinearModel, Model
from distfilt.network import graphs
from distfilt.sensors import LikelihoodSensor, Sensor, component

Comparison = tuple[np.ndarray, np.ndarray]  # by the library, and by hand

WALK = Model(1, lambda x, t, dt: x, lambda t, dt: dt * np.eye(1))
STILL = Model(2, lambda x, t, dt: x, lambda t, dt: np.zeros((2, 2)))
UNIT = component([0], std=1.0)
PRIOR = ([0.0], [[1.0]])


def delayed_observation() -> Comparison:
    """At 3 s an observation of 1.4 s arrives, a time that was never stepped to."""
    f = GaussianFilter(WALK, [UNIT], lag=3)
    late = Observation(1.4, 0, [0.5], arrival_time=3.0)
    on_time = [[[np.nan], [1.0], [np.nan]]]
    run = f.run(f.start(PRIOR), [1.0, 2.0, 3.0], on_time, delayed=[late])
    # cov(x(s), x(t)) = 1 + min(s, t), so that with A of the observed times
    # E[x(3) | y] = cov(x(3), x) (A + I)⁻¹ y
    t = np.array([1.4, 2.0])
    weights = np.linalg.solve(1 + np.minimum.outer(t, t) + np.eye(2), 1 + t)
    return run["mean"].values[-1, 0], weights @ [[0.5], [1.0]]


def first_sight() -> Comparison:
    """A landmark is first seen, 5 ahead of a robot; then the robot is located."""
    f = GaussianFilter(STILL, [UNIT])
    # The landmark has no belief before; any number will do.
    state = f.start(([3.0, 0.0], np.diag([4.0, 1.0])))
    # l = x + 5 + e, e ~ N(0, 0.1²)
    state = f.reset(state, [1], lambda x: x[..., :1] + 5.0, [[0.01]])
    state = f.step(state, 1.0, [[3.5]])
    # x = 3 + 4/(4 + 1) 0.5 with variance 4/5; the landmark moves with the robot.
    by_hand = np.array([3.4, 8.4, 0.8, 0.81])
    return np.append(state.means, state.covariances[0].diagonal()), by_hand


def restart() -> Comparison:
    """After a restart a sensor's bias is a new one, N(0, 0.5²)."""
    total = Sensor(1, lambda x: x.sum(axis=-1, keepdims=True), [[1.0]])
    f = GaussianFilter(STILL, [total])
    state = f.step(f.start(([0.0, 0.0], np.eye(2))), 1.0, [[1.0]])
    state = f.reset(state, [1], [0.0], [[0.25]])
    state = f.step(state, 2.0, [[1.0]])
    # x ~ N(1/3, 2/3) by the first; then K = (2/3) / (2/3 + 1/4 + 1).
    gain = (2 / 3) / (2 / 3 + 1.25)
    return state.means[0, :1], np.array([1 / 3 + gain * (1 - 1 / 3)])


def priors_of_agents() -> Comparison:
    """Two agents know different things before they share their observations."""
    f = GaussianFilter(WALK, [UNIT, UNIT], graphs.path(2), share_observations=True)
    state = f.start([([0.0], [[1.0]]), ([4.0], [[2.0]])])
    state = f.step(state, 0.0, [[2.0], [3.0]])
    # (m/P + y₁ + y₂) / (1/P + 2)
    return state.means[:, 0], np.array([5.0 / 3.0, 7.0 / 2.5])


def matrix_of_time() -> Comparison:
    """A rate of decay that grows with time, dx/dt = -t x, in steps of any length."""
    # Φ(t, dt) = exp(-∫ s ds) from t to t + dt
    model = LinearModel.from_transition(
        1,
        lambda t, dt: np.array([[np.exp(-t * dt - dt**2 / 2)]]),
        lambda t, dt: np.zeros((1, 1)),
    )
    f = GaussianFilter(model, [UNIT])
    y = [[[np.nan], [np.nan], [0.5]]]
    run = f.run(f.start(([1.0], [[1.0]])), [0.3, 1.0, 2.0], y)
    # Over all steps Φ = exp(-2²/2); then one observation, K = Φ² / (Φ² + 1).
    phi = np.exp(-2.0)
    by_hand = phi + phi**2 / (phi**2 + 1) * (0.5 - phi)
    return run["mean"].values[-1, 0], np.array([by_hand])


def known_constant() -> Comparison:
    """A belt moves at exactly 2 m/s: a component of variance zero."""
    belt = LinearModel.from_transition(
        2,
        lambda dt: np.array([[1.0, dt], [0.0, 1.0]]),
        lambda t, dt: np.zeros((2, 2)),
    )
    f = GaussianFilter(belt, [UNIT], linearization="unscented")
    state = f.start(([0.0, 2.0], np.diag([1.0, 0.0])))
    for t, y in ((1.0, 2.3), (2.0, 4.6)):
        state = f.step(state, t, [[y]])
    # The start is the mean of 0, 2.3 - 2 and 4.6 - 4, each of variance 1.
    by_hand = np.array([4.0 + 0.3, 2.0, 1 / 3, 0.0])
    return np.append(state.means, state.covariances[0].diagonal()), by_hand


def odometry() -> Comparison:
    """A robot drives north for two seconds; wheels and gyroscope have errors."""

    def drive(x: np.ndarray, u: np.ndarray, dt: float) -> np.ndarray:
        heading = x[..., 2] + u[..., 1] * dt / 2
        east = x[..., 0] + u[..., 0] * dt * np.cos(heading)
        north = x[..., 1] + u[..., 0] * dt * np.sin(heading)
        return np.stack([east, north, x[..., 2] + u[..., 1] * dt], axis=-1)

    # Speed 1 ± 0.2 and turn 0 ± 0.1, new errors each second.
    speed_and_turn = np.array([[1.0, 0.0], [1.0, 0.0]])
    measured = Inputs([0.0, 1.0], speed_and_turn, np.diag([0.04, 0.01]))
    f = GaussianFilter(InputModel.from_inputs(3, drive, measured), [None])
    state = f.start(([0.0, 0.0, np.pi / 2], np.zeros((3, 3))))
    state = f.step(state, 2.0, [None])
    # Across: the first turn acts for 1.5 s, the second for 0.5 s. Along: two speeds.
    by_hand = np.array([0.01 * (1.5**2 + 0.5**2), 2 * 0.04, 2 * 0.01])
    return state.covariances[0].diagonal(), by_hand


def odometry_of_each_robot() -> Comparison:
    """Two robots on a line; each measures its own speed, at times of its own."""
    logs = [
        Inputs([0.0], [[1.0]], [[0.01]]),
        Inputs([0.0, 1.0], [[2.0], [0.5]], [[0.04]]),
    ]
    robots = [
        InputModel.from_inputs(1, lambda x, u, dt: x + u * dt, inputs)
        for inputs in logs
    ]
    team = AgentModels.from_models(robots)
    f = GaussianFilter(team, [UNIT, None], share_observations=False)
    state = f.step(f.start(PRIOR), 2.0, [[2.6], None])
    # The first: x = 2 with variance 1 + 2² 0.01, then K = 1.04 / (1.04 + 1).
    # The second: x = 2 + 0.5 with variance 1 + 0.04 + 0.04, and no observation.
    gain = 1.04 / 2.04
    by_hand = np.array([2.0 + gain * 0.6, 2.5, gain, 1.08])
    return np.append(state.means[:, 0], state.covariances[:, 0, 0]), by_hand


def likelihoods() -> Comparison:
    """Counts, an outlier in Student's t noise, noise that grows with distance."""
    models: list[Callable[[np.ndarray, np.ndarray], np.ndarray]] = [
        lambda x, y: stats.poisson.logpmf(y, x)[..., 0],
        lambda x, y: stats.t.logpdf(y, 3, loc=x, scale=0.5)[..., 0],
        lambda x, y: stats.norm.logpdf(y, x, 0.2 + 0.1 * x)[..., 0],
    ]
    prior = stats.gamma(16.0, scale=0.25)
    cells = np.linspace(1e-3, 20.0, 20_000)[:, None]
    means = []
    by_hand = []
    for log_likelihood, y in zip(models, ([9.0], [12.0], [6.0]), strict=True):
        sensor = LikelihoodSensor(1, log_likelihood)
        f = ParticleFilter(WALK, [sensor], members=50_000)
        state = f.start(prior, rng=np.random.default_rng(0))
        means.append(f.summarize(f.step(state, 0.0, [y])).mean[0, 0])
        # ∫ x p(x) p(y | x) dx / ∫ p(x) p(y | x) dx
        likelihood = np.exp(log_likelihood(cells, np.array(y)))
        density = prior.pdf(cells[:, 0]) * likelihood
        by_hand.append(density @ cells[:, 0] / density.sum())
    return np.array(means), np.array(by_hand)


def evidence() -> Comparison:
    """The log-evidence of a model and the NIS of its observations."""
    f = GaussianFilter(WALK, [UNIT], record_evidence=True)
    t = np.array([1.0, 2.0, 4.0])
    y = np.array([0.2, 1.1, -0.9])
    run = f.run(f.start(PRIOR), t, [y[:, None]])
    # y ~ N(0, S), S = 1 + min(s, t) + I; the NIS adds up to yᵀ S⁻¹ y.
    cov = 1 + np.minimum.outer(t, t) + np.eye(3)
    log_density = stats.multivariate_normal(np.zeros(3), cov).logpdf(y)
    by_hand = np.array([log_density, y @ np.linalg.solve(cov, y)])
    return run[["log_likelihood", "nis"]].sum().to_array().values, by_hand


def errors_of_own_places() -> Comparison:
    """Two robots in one state judged by their own places; the truth has a gap."""
    sensors = [UNIT, component([1], std=1.0)]
    f = GaussianFilter(STILL, sensors, share_observations=False)
    truth = {1.0: [0.5, 1.0], 2.0: [np.nan, np.nan], 3.0: [0.4, 1.2]}
    y = np.array([[1.0], [1.0], [1.0]])
    run = f.run(
        f.start(([0.0, 0.0], np.eye(2))),
        list(truth),
        [y, 2 * y],
        truth=lambda t: truth[t],
        scored=[["0"], ["1"]],
        keep=["nees"],
    )
    # After k observations of y the belief is N(k y / (k + 1), 1 / (k + 1)).
    place = np.array([1.0, 2.0])
    first = 2 * (place / 2 - truth[1.0]) ** 2
    last = 4 * (3 * place / 4 - truth[3.0]) ** 2
    return run["nees"].dropna("time").values.ravel(), np.append(first, last)


EXACT = [delayed_observation, first_sight, restart, priors_of_agents]
EXACT += [matrix_of_time, known_constant, odometry, odometry_of_each_robot, evidence]
EXACT += [errors_of_own_places]
for recipe in [*EXACT, likelihoods]:
    library, by_hand = recipe()
    # Particles are draws; the others differ by rounding.
    tolerance = 1e-9 if recipe in EXACT else 0.02
    assert np.allclose(library, by_hand, rtol=0, atol=tolerance), recipe.__name__
    print(f"{recipe.__name__:23s}", *library.round(3))
