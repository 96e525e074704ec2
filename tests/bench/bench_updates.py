"""The EnKF's analysis against DAPPER's and against six lines of numpy, and whole cycles.

The analyses have a hundred members, a full noise covariance and half of the components
observed; DAPPER also centres its draws. A cycle is one Runge-Kutta step, an observation
of all components and the analysis, of Lorenz-63 and of Lorenz-96 with 40 components.
Ours is `run`, which leaves a record, and `steps`, which keeps all states; DAPPER's is
the loop of its `EnKF` without the statistics. Misses below the floors.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import numpy as np
from _bench import Row, compare_times, main, peer, table

from distfilt.filters import EnsembleFilter
from distfilt.models import Model, lorenz63, rk4, simulate
from distfilt.sensors import component
from distfilt.updates import enkf

MEMBERS = 100
DIMS = (6, 13, 40)
CYCLES = 1000
DT = 0.05
PROBLEMS = {"Lorenz63.sakov2012": (3, 2.0), "Lorenz96.sakov2008": (40, 1.0)}
"""DAPPER's, with the components and the variance of the noise."""
FLOORS = {"DAPPER, analysis": 1.3, "six lines of numpy": 0.85, "DAPPER, cycle": 1.0}


def analysis_case(d: int) -> tuple[np.ndarray, ...]:
    """Members, predictions, observation, noise."""
    rng = np.random.default_rng(d)
    m = d // 2
    a = rng.standard_normal((d, d)) / np.sqrt(d)
    b = rng.standard_normal((m, m)) / np.sqrt(m)
    x = rng.standard_normal((MEMBERS, d)) @ (np.eye(d) + a)
    # The first half of the components is observed.
    predicted = x[:, :m].copy()
    noise = b @ b.T + 0.5 * np.eye(m)
    return x, predicted, rng.standard_normal(m), noise


def six_lines(
    x: np.ndarray, h: np.ndarray, y: np.ndarray, r: np.ndarray, rng: Any
) -> np.ndarray:
    a = x - x.mean(axis=0)
    b = h - h.mean(axis=0)
    n = len(x) - 1
    cov = b.T @ b / n + r
    drawn = h + rng.standard_normal(h.shape) @ np.linalg.cholesky(r).T
    # K = (BᵀB / (N - 1) + R)⁻¹ BᵀA / (N - 1)
    gain = np.linalg.solve(cov, b.T @ a / n)
    return x + (y - drawn) @ gain


def dapper(
    x: np.ndarray, h: np.ndarray, y: np.ndarray, r: np.ndarray
) -> Callable[[], Any] | None:
    methods = peer("dapper.da_methods.ensemble")
    randoms = peer("dapper.tools.randvars")
    if methods is None or randoms is None:
        return None
    noise = randoms.GaussRV(mu=np.zeros(len(r)), C=r)
    return lambda: methods.EnKF_analysis(x, h, noise, y, "PertObs")


def dapper_s_loop(
    problem: str, x: np.ndarray, y: np.ndarray
) -> Callable[[], None] | None:
    methods = peer("dapper.da_methods.ensemble")
    setup = peer(f"dapper.mods.{problem}")

    def loop() -> None:
        hmm = setup.HMM
        # Forecast, noise, analysis and inflation by 1, as in DAPPER's own loop
        e = x.copy()
        for k, seen in enumerate(y):
            e = methods.add_noise(hmm.Dyn(e, k * DT, DT), DT, hmm.Dyn.noise, "Stoch")
            e = methods.EnKF_analysis(
                e, hmm.Obs(k)(e), hmm.Obs(k).noise, seen, "PertObs"
            )
            e = methods.post_process(e, 1.0, False)

    return None if methods is None or setup is None else loop


def ring(x: np.ndarray, t: float) -> np.ndarray:
    """Lorenz's model of 1996: advection, damping and forcing on a circle."""
    advection = (np.roll(x, -1, -1) - np.roll(x, 2, -1)) * np.roll(x, 1, -1)
    return advection - x + 8.0


def compare_calls(
    d: int, calls: dict[str, Any], rounds: int, each: int = 1
) -> Iterator[Row]:
    """Yield a row for each available call; `each` is the number of cycles in a call."""
    calls = {name: call for name, call in calls.items() if call is not None}
    times, ratios = compare_times(calls, rounds)
    for name in calls:
        floor = FLOORS.get(name, 0)
        yield {
            "components": d,
            "members": MEMBERS,
            "what": name,
            "floor": floor or "",
            "us": f"{1e6 * times[name] / each:.1f}",
            "first_is_faster": f"{ratios[name]:.2f}",
            "missed": ratios[name] < floor,
        }


@table("updates", "numpy", "scipy", "dapper")
def analyses_and_cycles() -> Iterator[Row]:
    for d in DIMS:
        arguments = analysis_case(d)
        rng = np.random.default_rng(0)
        yield from compare_calls(
            d,
            {
                "enkf": partial(enkf, *arguments, rng=rng),
                "DAPPER, analysis": dapper(*arguments),
                "six lines of numpy": partial(six_lines, *arguments, rng),
            },
            31,
        )
    other = Model(40, partial(rk4, ring, longest=DT), lambda t, dt: np.zeros((40, 40)))
    for problem, (d, variance) in PROBLEMS.items():
        model = lorenz63(step=DT) if d == 3 else other
        sensor = component(range(d), std=variance**0.5)
        rng = np.random.default_rng(d)
        times = DT * np.arange(1, CYCLES + 1)
        # After a hundred units of time the state is on the attractor.
        x0 = model.step(rng.standard_normal(d), 0.0, 100.0)
        y = sensor.observe(simulate(model, x0, times, rng=rng), rng=rng)
        f = EnsembleFilter(model, [sensor], members=MEMBERS)
        start = f.start((x0, variance * np.eye(d)), rng=rng)
        yield from compare_calls(
            d,
            {
                "run": partial(f.run, start, times, [y]),
                "steps": lambda f=f, arguments=(start, times, [y]): [
                    *f.steps(*arguments)
                ],
                "DAPPER, cycle": dapper_s_loop(problem, start.ensembles[0], y),
            },
            15,
            CYCLES,
        )


if __name__ == "__main__":
    main()
