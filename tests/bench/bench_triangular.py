"""Triangular maps against the printed program, and against another toolbox.

The closed-form affine map against the printed program (12), component by component in
cvxpy: once with each component's program compiled before, as the library keeps it, and
once compiled in every call, as a newcomer writes it; misses where a ratio, against the
compiled program, or an agreement is missed.

Separable maps against the Triangular-Transport-Toolbox (github.com/MaxRamgraber): the
update of a bent three-dimensional ensemble with one observation, full maps on both
sides. The toolbox is one file, ``transport_map.py``, and no package: the table, which
names its commit, stays as it is where Python does not find it. Beside the times: the
error of the posterior mean against importance sampling, over several seeds.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import numpy as np
from _bench import Row, compare_times, main, measure_time, peer, table

from distfilt.triangular import affine, compose, separable

# --- against the printed program --------------------------------------------------------------

SIZES = ((1, 6, 80), (3, 13, 150), (10, 40, 500))
"""Observations m, state d, and the ratio that ECOS has to lose by."""

SAMPLES = 200
CALLS = 200


def partly_observed(m: int, d: int) -> tuple[np.ndarray, np.ndarray]:
    """Correlated members of unit scale and noisy observations of them."""
    rng = np.random.default_rng(100 * m + d)
    # A mild correlation, whatever the dimension
    mixing = np.eye(d)
    mixing += 0.3 * rng.standard_normal((d, d)) / np.sqrt(d)
    x = rng.standard_normal((SAMPLES, d)) @ mixing
    noise = 0.5 * rng.standard_normal((SAMPLES, m))
    return x[:, :m] + noise, x


@table("triangular", "numpy", "cvxpy", "ecos")
def programs() -> Iterator[Row]:
    for m, d, needed in SIZES:
        y, x = partly_observed(m, d)
        closed = measure_time(
            lambda y=y, x=x: [affine.fit(y, x) for _ in range(CALLS)][0], 5
        )
        exact_mean = compose(closed.result, y, x, y[0])
        each = closed.cpu / CALLS
        known = partial(affine.fit_convex, y, x, solver="ECOS")

        def newcomer(known: Callable[[], Any] = known) -> Any:
            # Forget the compiled programs before each call.
            affine._compile_program.cache_clear()
            return known()

        compiled_each_time = measure_time(newcomer, 3).cpu
        solved = measure_time(known, 3)
        composed = compose(solved.result, y, x, y[0])
        gap = np.abs(composed - exact_mean).max()
        yield {
            "variables": m + d,
            "closed_form_us": f"{each * 1e6:.1f}",
            "solver_ms": f"{solved.cpu * 1e3:.1f}",
            "ratio": f"{solved.cpu / each:.0f}",
            "compiled_each_time_ms": f"{compiled_each_time * 1e3:.1f}",
            "ratio_each_time": f"{compiled_each_time / each:.0f}",
            "needed": needed,
            "composed_map_gap": f"{gap:.1e}",
            "missed": gap >= 1e-8 or solved.cpu / each < needed,
        }


# --- against the toolbox ----------------------------------------------------------------------

BENT = 500
SEEDS = 12
STD = 1.0
SEEN = 1.5
FLOOR = 4.0
COMMIT = "7fe9d080e810c65201f521e805e5d66b11512a14 of 2025-07-17"


def prior(n: int, rng: np.random.Generator) -> np.ndarray:
    x = rng.standard_normal((n, 3))
    # A parabola in the first two components, and a fold in the third
    x[:, 1] += 0.5 * x[:, 0] ** 2
    x[:, 2] += 0.5 * x[:, 1] * np.sign(x[:, 0])
    return x


def exact_mean() -> np.ndarray:
    x = prior(2_000_000, np.random.default_rng(99))
    # Importance sampling from the prior with the likelihood as weights
    w = np.exp(-0.5 * ((SEEN - x[:, 0]) / STD) ** 2)
    return (w @ x) / w.sum()


def bent_samples(seed: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    x = prior(BENT, rng)
    return x[:, :1] + STD * rng.standard_normal((BENT, 1)), x


def ours(order: int, y: np.ndarray, x: np.ndarray) -> np.ndarray:
    fitted = separable.fit(y, x, order=order, regularisation=0.05)
    return compose(fitted, y, x, np.array([SEEN]))


class Toolbox:
    """The toolbox's update with a map made once, as its own filter example does it."""

    def __init__(self, module: Any, order: int) -> None:
        bent = range(1, order + 1)
        nonmonotone = [
            [
                [],
                *([v] for v in range(k)),
                *([v] * o + ["HF"] for v in range(k) for o in bent),
            ]
            for k in (1, 2, 3)
        ]
        monotone = [
            [f"LET {k}", *[f"iRBF {k}"] * (order - 1), f"RET {k}"] for k in (1, 2, 3)
        ]
        self.map = module.transport_map(
            X=np.random.default_rng(0).standard_normal((BENT, 4)),
            monotone=monotone,
            nonmonotone=nonmonotone,
            polynomial_type="hermite function",
            monotonicity="separable monotonicity",
            regularization="l2",
            regularization_lambda=0.05,
            verbose=False,
        )

    def __call__(self, y: np.ndarray, x: np.ndarray) -> np.ndarray:
        joint = np.column_stack([y, x])
        self.map.reset(joint)
        self.map.optimize()
        z = self.map.map(joint)
        return np.asarray(self.map.inverse_map(X_star=np.full((len(x), 1), SEEN), Z=z))[
            :, -3:
        ]


def error(update: Any, mean: np.ndarray) -> float:
    # Root mean square of the error of the posterior mean, over seeds and components
    gaps = []
    for seed in range(SEEDS):
        analysis = update(*bent_samples(seed))
        gaps.append(analysis.mean(axis=0) - mean)
    return float(np.sqrt(np.mean(np.square(gaps))))


@table("transport_toolbox")
def compare_with_toolbox() -> Iterator[Row]:
    module = peer("transport_map")
    for order in (2, 3) if module is not None else ():
        (y, x) = bent_samples(0)
        mean = exact_mean()
        updates = {"ours": partial(ours, order), "toolbox": Toolbox(module, order)}
        times, ratios = compare_times(
            {n: partial(f, y, x) for n, f in updates.items()}, 9
        )
        ms = {f"{name}_ms": f"{1e3 * spent:.2f}" for name, spent in times.items()}
        gaps = {f"{name}_error": f"{error(f, mean):.3f}" for name, f in updates.items()}
        yield {
            "order": order,
            "members": BENT,
            **ms,
            **gaps,
            "ratio": f"{ratios['toolbox']:.2f}",
            "origin": COMMIT,
            "floor": FLOOR,
            "missed": ratios["toolbox"] < FLOOR,
        }


if __name__ == "__main__":
    main()
