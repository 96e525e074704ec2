"""The evidence and the NIS of a run: what a user asks of a filter to compare and to check models.

| Project | Report | Here |
|---|---|---|
| own | log-likelihood of a series, and NIS, in the run's record | all tests |

Values are made from the joint Gaussian of all observations, from sums over particles, and by hand.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
import pytest
from scipy.stats import multivariate_normal, norm

from distfilt import filters
from distfilt.models import LinearModel, Model
from distfilt.network import Faults, graphs
from distfilt.sensors import Sensor, component
from distfilt.updates import enkf_exact, serially

MEAN = np.array([1.0, -0.5])
COV = np.array([[1.0, 0.3], [0.3, 0.8]])
NOISE = np.array([[0.5, 0.2], [0.2, 0.4]])
F = np.array([[1.0, 0.5], [-0.2, 0.9]])
Q = np.array([[0.3, 0.1], [0.1, 0.2]])
MOTION = LinearModel.from_transition(2, lambda dt: F, lambda t, dt: Q)
STILL = LinearModel.from_transition(
    2, lambda dt: np.eye(2), lambda t, dt: np.zeros((2, 2))
)
BOTH = Sensor(2, lambda x: x, NOISE, linear=lambda d: np.eye(d))
TIMES = np.arange(1.0, 6.0)
SEEN = np.random.default_rng(0).standard_normal((5, 2)) + [1.0, 0.0]
SEEN[2, 1] = np.nan
SEEN[3] = np.nan


def joint_density(seen: np.ndarray, transition: np.ndarray, q: np.ndarray) -> float:
    """Return the logarithm of the density of all observations that are there, at once."""
    n = len(seen)
    # x_k = F^k x_0 + sum of F^(k-j) w_j, block by block.
    covs = {(0, 0): COV}
    mean = [MEAN]
    for k in range(1, n + 1):
        mean.append(transition @ mean[-1])
        for j in range(k):
            covs[k, j] = transition @ covs[k - 1, j]
            covs[j, k] = covs[k, j].T
        covs[k, k] = transition @ covs[k - 1, k - 1] @ transition.T + q
    blocks = []
    for i in range(1, n + 1):
        blocks.append([covs[i, j] for j in range(1, n + 1)])
    # y_k = x_k + noise of the same covariance at all times
    cov = np.block(blocks)
    cov += np.kron(np.eye(n), NOISE)
    present = ~np.isnan(seen.ravel())
    flat = np.concatenate(mean[1:])[present]
    present_cov = cov[np.ix_(present, present)]
    law = multivariate_normal(flat, present_cov)
    return float(law.logpdf(seen.ravel()[present]))


def nis_of_kalman(seen: np.ndarray) -> list[float]:
    """Return rᵀ S⁻¹ r of each step, by a plain Kalman filter."""
    m = MEAN
    p = COV
    result = []
    for y in seen:
        m = F @ m
        p = F @ p @ F.T + Q
        # Rows of the components that are there
        present = ~np.isnan(y)
        h = np.eye(2)[present]
        if len(h):
            s = h @ (p + NOISE) @ h.T
            r = y[present] - h @ m
            result.append(float(r @ np.linalg.inv(s) @ r))
            gain = p @ h.T @ np.linalg.inv(s)
            m = m + gain @ r
            p = p - gain @ h @ p
        else:
            result.append(0.0)
    return result


@pytest.mark.parametrize("linearization", ["extended", "unscented"])
def test_the_evidence_of_a_gaussian_filter_is_the_joint_density(
    linearization: Any,
) -> None:
    f = filters.GaussianFilter(
        MOTION, [BOTH], linearization=linearization, record_evidence=True
    )
    run = f.run(f.start((MEAN, COV)), TIMES, [SEEN])
    evidence = run["log_likelihood"].values[:, 0]
    # Σ log p(y_k | y₁, …, y_{k-1}) = log p(y₁, …, y₅)
    assert np.isclose(evidence.sum(), joint_density(SEEN, F, Q), atol=1e-10)
    assert np.allclose(run["nis"].values[:, 0], nis_of_kalman(SEEN), atol=1e-10)
    assert run["n_observed"].values[:, 0].tolist() == [2, 2, 1, 0, 2]
    # Without the option nothing is recorded.
    plain = f.replace(record_evidence=False)
    assert "nis" not in plain.run(plain.start((MEAN, COV)), TIMES, [SEEN])


def test_observations_that_come_late_have_the_same_evidence_in_sum() -> None:
    """p(y₁, y₂, ...) does not depend on the order in which they are assimilated."""
    f = filters.GaussianFilter(MOTION, [BOTH], lag=3, record_evidence=True)
    late = SEEN.copy()
    late[0] = np.nan
    delayed = [filters.Observation(1.0, 0, SEEN[0], arrival_time=4.0)]
    start = f.start((MEAN, COV))
    run = f.run(start, TIMES, [late], delayed=delayed)
    evidence = run["log_likelihood"].values
    assert np.isclose(evidence.sum(), joint_density(SEEN, F, Q), atol=1e-10)
    # The first observation counts when it arrives, where the fourth is missing.
    assert evidence[0] == 0
    assert run["n_observed"].values[3, 0] == 2


@pytest.mark.parametrize("update", [enkf_exact, serially(enkf_exact)])
def test_the_evidence_of_exact_ensembles_is_the_gaussian_filters(update: Any) -> None:
    """With members of exact moments and a linear model, for each of two runs."""
    f = filters.EnsembleFilter(
        STILL, [BOTH], update=update, members=40, record_evidence=True
    )
    rng = np.random.default_rng(0)
    x = rng.standard_normal((40, 2))
    # Whitened by their own moments, then given those of the prior: z ↦ m + L S⁻¹ (z - z̄)
    x -= x.mean(axis=0)
    sample_root = np.linalg.cholesky(np.cov(x.T))
    white = np.linalg.solve(sample_root, x.T).T
    x = MEAN + white @ np.linalg.cholesky(COV).T
    start = f.start(x, rng=rng, runs=(2,))
    other = SEEN + 1.0
    run = f.run(start, TIMES, [np.stack([SEEN, other], axis=1)])
    for k, seen in enumerate((SEEN, other)):
        total = run["log_likelihood"].values[:, k].sum()
        expected = joint_density(seen, np.eye(2), np.zeros((2, 2)))
        assert np.isclose(total, expected, atol=1e-9)


def test_the_evidence_of_particles_is_the_mean_of_the_likelihoods() -> None:
    """Particles that do not move and are not resampled: log mean Π N(y; x, R), with all factors."""
    x = np.random.default_rng(0).standard_normal((50, 2))
    f = filters.ParticleFilter(
        STILL, [BOTH], members=50, ess_threshold=0.0, record_evidence=True
    )
    start = f.start(x, rng=np.random.default_rng(0))
    run = f.run(start, TIMES, [SEEN])
    density = np.ones(50)
    for y in SEEN:
        present = ~np.isnan(y)
        if present.any():
            # N(y - x; 0, R) of the components that are there
            block = NOISE[np.ix_(present, present)]
            law = multivariate_normal(np.zeros(present.sum()), block)
            density *= law.pdf(y[present] - x[:, present])
    total = run["log_likelihood"].values.sum()
    assert np.isclose(total, np.log(density.mean()), atol=1e-10)
    # The first NIS: of the equally weighted particles.
    r = SEEN[0] - x.mean(axis=0)
    s = np.cov(x.T, bias=True) + NOISE
    nis = r @ np.linalg.solve(s, r)
    assert np.isclose(run["nis"].values[0, 0], nis)


def test_agents_of_a_transport_filter_share_the_evidence_of_all_observations() -> None:
    x = np.random.default_rng(0).standard_normal((30, 2))
    f = filters.TransportFilter(
        STILL,
        [component([0], std=0.5), component([1], std=0.7)],
        graphs.path(2),
        members=30,
        record_evidence=True,
    )
    start = f.start(x, rng=np.random.default_rng(0))
    state = f.step(start, 0.0, [[0.3], [-0.2]])
    # The mean over the members of the product of both densities
    first = norm(x[:, 0], 0.5).pdf(0.3)
    second = norm(x[:, 1], 0.7).pdf(-0.2)
    density = first * second
    assert np.allclose(state.log_likelihood, np.log(density.mean()), atol=1e-10)
    assert state.n_observed.tolist() == [1, 1]


@pytest.mark.parametrize("family", ["gaussian", "ensemble", "particle"])
def test_scores_are_of_the_observations_that_an_agent_assimilates(family: str) -> None:
    """Received ones count, lost ones and those that the gate rejects do not.

    Agent 0 is silent, so that agent 1 does not receive its observation; agent 2 has none.
    """
    make = {
        "gaussian": filters.GaussianFilter,
        "ensemble": partial(filters.EnsembleFilter, members=50),
        "particle": partial(filters.ParticleFilter, members=500),
    }[family]
    f = make(
        MOTION,
        [component([0], std=0.5), component([1], std=0.5), None],
        graphs.path(3),
        gate_probability=0.999,
        faults=Faults(silent=[0]),
        record_evidence=True,
    )
    start = f.start((MEAN, COV), rng=np.random.default_rng(0))
    run = f.run(start, [1.0, 2.0], [[[1.0], [99.0]], [[0.2], [0.1]], None])
    # By time and agent: agent 0's own, agent 1's own, and agent 1's at agent 2
    assert run["n_observed"].values.tolist() == [[1, 1, 1], [0, 1, 1]]
    assert run["rejected"].values.tolist() == [[0, 0, 0], [1, 0, 0]]
    assert (run["nis"].values < 10).all()


@pytest.mark.filterwarnings("ignore::distfilt.filters.ParticleCollapse")
@pytest.mark.parametrize("family", ["gaussian", "ensemble", "particle"])
def test_consistent_filters_have_a_nis_of_the_number_of_observations(
    family: str,
) -> None:
    """Over 2 000 steps its mean is 2, with a standard error of 2 / sqrt(2000)."""
    make = {
        "gaussian": filters.GaussianFilter,
        "ensemble": partial(filters.EnsembleFilter, members=400),
        "particle": partial(filters.ParticleFilter, members=400),
    }[family]
    rng = np.random.default_rng(1)
    runs = (1000,)
    standard = rng.standard_normal((*runs, 2))
    truth = MEAN + standard @ np.linalg.cholesky(COV).T
    seen = []
    for _ in range(2):
        truth = MOTION.sample_step(truth, 0.0, 1.0, rng=rng)
        seen.append(BOTH.observe(truth, rng=rng))
    f = make(MOTION, [BOTH], record_evidence=True)
    start = f.start((MEAN, COV), rng=rng, runs=runs)
    run = f.run(start, [1.0, 2.0], [np.array(seen)])
    standard_error = 2 / np.sqrt(2000)
    assert abs(run["nis"].values.mean() - 2) < 4 * standard_error + 0.02


def test_a_run_that_fails_has_no_evidence() -> None:
    wild = Model(
        2, lambda x, t, dt: np.where(x > 50, np.nan, x), lambda t, dt: np.eye(2)
    )
    f = filters.GaussianFilter(wild, [BOTH], on_error="keep", record_evidence=True)
    start = f.start((MEAN, COV), runs=(2,))
    means = start.joint_means.copy()
    # Where the model is not a number
    means[1] = 100.0
    run = f.run(start.replace(joint_means=means), [1.0], [[[1.0, 0.0]]])
    assert np.isfinite(run["log_likelihood"].values[0, 0, 0])
    assert np.isnan(run["log_likelihood"].values[0, 1, 0])


def test_saved_states_keep_the_scores(tmp_path: Any) -> None:
    f = filters.GaussianFilter(MOTION, [BOTH], record_evidence=True)
    state = f.step(f.start((MEAN, COV)), 1.0, [SEEN[0]])
    state.save(tmp_path / "state.npz")
    loaded = filters.GaussianState.load(tmp_path / "state.npz")
    assert loaded.log_likelihood == state.log_likelihood
    assert loaded.nis == state.nis


def test_families_that_cannot_refuse_the_option_by_name() -> None:
    for cls in (filters.MixtureFilter, filters.InformationIncrementFilter):
        with pytest.raises(TypeError, match="record_evidence"):
            cls(
                MOTION,
                [BOTH] * 2,
                graphs.path(2),
                target_dim=1,
                record_evidence=True,
            )
