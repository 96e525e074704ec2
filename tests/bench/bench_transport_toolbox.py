"""Separable maps against the Triangular-Transport-Toolbox (github.com/MaxRamgraber), one update.

The update by a composed map of a bent three-dimensional ensemble with one reading, orders 2 and 3,
full maps on both sides. The toolbox is one file, ``transport_map.py``, and no package: where Python
finds it, both are measured side by side; elsewhere its figures are kept, which name its commit.
Beside the times: the error of the posterior mean against importance sampling, over several seeds.
Writes data/bench/transport_toolbox.csv; fails below the floor.
"""

from __future__ import annotations

import csv
import sys
from functools import partial
from typing import Any

import numpy as np
from _bench import FOLDER, interleaved, peer, write

from distfilt.triangular import compose, separable

MEMBERS, SEEDS, STD, SEEN = 500, 12, 1.0, 1.5
FLOOR = 4.0
COMMIT = "7fe9d080e810c65201f521e805e5d66b11512a14 of 2025-07-17"


def prior(n: int, rng: np.random.Generator) -> np.ndarray:
    x = rng.standard_normal((n, 3))
    x[:, 1] += 0.5 * x[:, 0] ** 2
    x[:, 2] += 0.5 * x[:, 1] * np.sign(x[:, 0])
    return x


def exact() -> np.ndarray:
    x = prior(2_000_000, np.random.default_rng(99))
    w = np.exp(-0.5 * ((SEEN - x[:, 0]) / STD) ** 2)
    return (w @ x) / w.sum()


def samples(seed: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    x = prior(MEMBERS, rng)
    return x[:, :1] + STD * rng.standard_normal((MEMBERS, 1)), x


def ours(order: int, y: np.ndarray, x: np.ndarray) -> np.ndarray:
    fitted = separable.fit(y, x, order=order, regularisation=0.05)
    return compose(fitted, y, x, np.array([SEEN]))


class Toolbox:
    """The toolbox's update with a map made once, as its own filter example does it."""

    def __init__(self, module: Any, order: int) -> None:
        bent = range(1, order + 1)
        nonmonotone = [
            [[], *([v] for v in range(k)), *([v] * o + ["HF"] for v in range(k) for o in bent)]
            for k in (1, 2, 3)
        ]
        monotone = [
            [f"LET {k}", *[f"iRBF {k}"] * (order - 1), f"RET {k}"] for k in (1, 2, 3)
        ]
        self.map = module.transport_map(
            X=np.random.default_rng(0).standard_normal((MEMBERS, 4)), monotone=monotone,
            nonmonotone=nonmonotone, polynomial_type="hermite function",
            monotonicity="separable monotonicity", regularization="l2",
            regularization_lambda=0.05, verbose=False,
        )  # fmt: skip

    def __call__(self, y: np.ndarray, x: np.ndarray) -> np.ndarray:
        joint = np.column_stack([y, x])
        self.map.reset(joint)
        self.map.optimize()
        z = self.map.map(joint)
        return np.asarray(self.map.inverse_map(X_star=np.full((len(x), 1), SEEN), Z=z))[:, -3:]


def error(update: Any, mean: np.ndarray) -> float:
    gaps = [update(*samples(seed)).mean(axis=0) - mean for seed in range(SEEDS)]
    return float(np.sqrt(np.mean(np.square(gaps))))


def stored() -> dict[str, dict[str, str]]:
    """The toolbox's figures of an earlier run, by order."""
    path = FOLDER / "transport_toolbox.csv"
    if not path.is_file():
        return {}
    with path.open(encoding="utf-8", newline="") as lines:
        return {row["order"]: row for row in csv.DictReader(lines)}


def main() -> int:
    """Measure, write the table, and count what is missed."""
    module, kept, mean = peer("transport_map"), stored(), exact()
    rows, missed = [], 0
    for order in (2, 3):
        y, x = samples(0)
        calls = {"ours": partial(ours, order, y, x)}
        if module is not None:
            toolbox = Toolbox(module, order)
            calls["toolbox"] = partial(toolbox, y, x)
        times, ratios = interleaved(calls, 9)
        row = {"order": order, "members": MEMBERS, "ours_ms": f"{1e3 * times['ours']:.2f}"}
        row["ours_error"] = f"{error(partial(ours, order), mean):.3f}"
        if module is not None:
            row |= {"toolbox_ms": f"{1e3 * times['toolbox']:.2f}",
                    "toolbox_error": f"{error(toolbox, mean):.3f}",
                    "ratio": f"{ratios['toolbox']:.2f}", "origin": COMMIT}  # fmt: skip
        else:
            old = kept.get(str(order), {})
            row |= {n: old.get(n, "") for n in ("toolbox_ms", "toolbox_error", "ratio", "origin")}
        missed += bool(row["ratio"]) and float(row["ratio"]) < FLOOR
        rows.append(row | {"floor": FLOOR})
    write("transport_toolbox", rows)
    return missed


if __name__ == "__main__":
    sys.exit(main())
