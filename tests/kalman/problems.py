"""Problems that the tests of this folder share."""

from __future__ import annotations

import numpy as np

from distfilt.models import LinearModel

STEPS, RUNS, D, M = 7, 4, 3, 2


def spd(rng: np.random.Generator, n: int, leading: tuple[int, ...] = ()) -> np.ndarray:
    """Random symmetric positive definite matrices with eigenvalues of order one."""
    a = rng.standard_normal((*leading, n, n))
    return a @ np.swapaxes(a, -1, -2) / n + 0.3 * np.eye(n)


def problem(
    rng: np.random.Generator, steps: int = STEPS, d: int = D, m: int = M, varying: bool = True
) -> dict[str, np.ndarray]:
    """Matrices of a linear Gaussian model, another one in each step if `varying`."""
    lead = (steps,) if varying else ()
    return {
        "F": rng.standard_normal((*lead, d, d)) / np.sqrt(d),
        "H": rng.standard_normal((*lead, m, d)),
        "Q": spd(rng, d, lead),
        "R": spd(rng, m, lead),
    }


def walk(d: int = 1) -> LinearModel:
    return LinearModel.from_transition(d, lambda dt: np.eye(d), lambda t, dt: dt * np.eye(d))


def posterior(
    mean: np.ndarray, cov: np.ndarray, y: np.ndarray, p: dict[str, np.ndarray]
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """All states given all observations, by conditioning their joint Gaussian, without recursion.

    Returns the states' means (T, d) and covariance (T d, T d), and the mean, covariance and values
    of the observations that are there.
    """
    steps, d = p["F"].shape[:2]
    now = np.zeros((d, d * (steps + 1)))
    now[:, :d] = np.eye(d)
    rows, noise = [], [cov, *p["Q"]]
    for k in range(steps):
        now = p["F"][k] @ now
        now[:, d * (k + 1) : d * (k + 2)] += np.eye(d)
        rows.append(now)
    states = np.concatenate(rows)
    root = np.zeros((d * (steps + 1),) * 2)
    for k, block in enumerate(noise):
        root[d * k : d * (k + 1), d * k : d * (k + 1)] = block
    seen = np.concatenate([p["H"][k] @ rows[k] for k in range(steps)])
    m = p["H"].shape[1]
    yy = seen @ root @ seen.T
    for k in range(steps):
        yy[k * m : (k + 1) * m, k * m : (k + 1) * m] += p["R"][k]
    start = np.concatenate([mean, np.zeros(d * steps)])
    here = ~np.isnan(y).ravel()
    yy, seen, values = yy[np.ix_(here, here)], seen[here], y.ravel()[here]
    cross = states @ root @ seen.T
    gain = np.linalg.solve(yy, cross.T).T
    means = states @ start + gain @ (values - seen @ start)
    covs = states @ root @ states.T - gain @ cross.T
    return means.reshape(steps, d), covs, seen @ start, yy, values
