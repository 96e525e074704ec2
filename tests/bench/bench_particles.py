"""The bootstrap particle filter against the `particles` package.

A random walk in three components, of which two are seen with a full noise; 50 steps
with a thousand to a hundred thousand particles, resampled in every step by the
systematic rule, and the weighted mean of each. Beside the times: its error against the
Kalman filter, in units of the standard deviation. Misses where the package is faster.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import Any

import numpy as np
from _bench import Row, compare_times, main, peer, table

from distfilt.filters import ParticleFilter
from distfilt.kalman import kalman_filter
from distfilt.models import LinearModel, simulate
from distfilt.sensors import Sensor

STEPS = 50
SIZES = (1000, 10_000, 100_000)
FLOOR = 1.0
Q = np.array([[0.3, 0.1, 0.0], [0.1, 0.2, 0.05], [0.0, 0.05, 0.4]])
R = np.array([[0.5, 0.2], [0.2, 0.4]])
H = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 1.0]])
TIMES = np.arange(1.0, STEPS + 1)
MODEL = LinearModel.from_transition(3, lambda dt: np.eye(3), lambda t, dt: dt * Q)


def by_distfilt(n: int, seen: np.ndarray) -> np.ndarray:
    sensor = Sensor(2, lambda x: x @ H.T, R, linear=lambda d: H)
    # A threshold of 1 resamples in every step.
    f = ParticleFilter(MODEL, [sensor], members=n, ess_threshold=1.0)
    states = f.steps(
        f.start((np.zeros(3), np.eye(3)), rng=np.random.default_rng(1)), TIMES, [seen]
    )
    return np.array([state.weights[0] @ state.particles[0] for state in states])


def by_particles(package: Any, n: int, seen: np.ndarray) -> np.ndarray:
    spaces = peer("particles.state_space_models")
    laws = peer("particles.distributions")
    collectors = peer("particles.collectors")

    class Walk(spaces.StateSpaceModel):  # type: ignore[misc,name-defined]
        def PX0(self) -> Any:
            # The package observes the first state, ours begins one step before.
            return laws.MvNormal(loc=np.zeros(3), cov=np.eye(3) + Q)

        def PX(self, t: int, xp: Any) -> Any:
            return laws.MvNormal(loc=xp, cov=Q)

        def PY(self, t: int, xp: Any, x: Any) -> Any:
            return laws.MvNormal(loc=x @ H.T, cov=R)

    run = package.SMC(
        fk=spaces.Bootstrap(ssm=Walk(), data=list(seen[:, None, :])),
        N=n,
        resampling="systematic",
        ESSrmin=1.0,
        collect=[collectors.Moments(mom_func=lambda w, x: w @ x)],
    )
    run.run()
    return np.array(run.summaries.moments)


@table("particles", "numpy", "scipy", "particles", "numba")
def filters() -> Iterator[Row]:
    rng = np.random.default_rng(5)
    truth = simulate(MODEL, np.zeros(3), TIMES, rng=rng)
    noise = rng.standard_normal((STEPS, 2)) @ np.linalg.cholesky(R).T
    seen = truth @ H.T + noise
    # The model is linear: the exact means are those of the Kalman filter.
    exact = kalman_filter(np.zeros(3), np.eye(3), seen, F=np.eye(3), H=H, Q=Q, R=R)
    variance = np.diagonal(exact.covariances, axis1=-2, axis2=-1)
    package = peer("particles")
    for n in SIZES:
        calls: dict[str, Any] = {"distfilt": partial(by_distfilt, n, seen)}
        if package is not None:
            calls["particles"] = partial(by_particles, package, n, seen)
        times, ratios = compare_times(calls, 7)
        for name, call in calls.items():
            floor = FLOOR if name == "particles" else 0
            gap = np.sqrt(((call() - exact.means) ** 2 / variance).mean())
            yield {
                "particles": n,
                "steps": STEPS,
                "filter": name,
                "ms_a_step": f"{1e3 * times[name] / STEPS:.3f}",
                "distfilt_is_faster": f"{ratios[name]:.2f}",
                "floor": floor or "",
                "mean_error": f"{gap:.3f}",
                "missed": ratios[name] < floor,
            }


if __name__ == "__main__":
    main()
