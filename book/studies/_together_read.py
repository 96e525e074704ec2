"""What chapter 11 makes of its stored studies: ratios, fronts, Holm's test and a decision tree."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import _together as together
import numpy as np

from bookkit import studies
from distfilt.metrics import Interval, mean_interval

FOUR = together.FOUR
THREE = together.THREE
HONEST = (0.8, 1.25)
"""NEES per component of a filter that is called honest; 0.95 to 1.05 is asked for where said."""
BUDGETS = (3, 12, 32, 64, 400)
"""Numbers that an agent may send in a step."""


@dataclass(frozen=True, eq=False)
class Result:
    """A cell's runs: squared errors and NEES per component, (n,), and numbers sent a step."""

    cell: str
    error: np.ndarray
    nees: np.ndarray
    floats: float

    @property
    def failed(self) -> int:
        """How many runs have no number."""
        return int((~np.isfinite(self.error)).sum())

    @property
    def claim(self) -> float:
        """The mean NEES per component."""
        return float(self.nees.mean())

    @property
    def honest(self) -> bool:
        """Whether it claims about what it knows, and always ends."""
        return not self.failed and HONEST[0] <= self.claim <= HONEST[1]


def columns(stored: Any, name: str, what: str) -> np.ndarray:
    """All runs of a cell, trial after trial."""
    each = [stored.metric(f"{name}_{what}_{r}") for r in range(together.BATCH)]
    return np.stack(each, axis=-1).ravel()


def result(stored: Any, name: str, cell: str = "") -> Result:
    """A cell's result; `name` is its column's."""
    floats = float(stored.metric(f"{name}_floats").mean())
    return Result(
        cell or name,
        columns(stored, name, "error"),
        columns(stored, name, "nees"),
        floats,
    )


@cache
def results(name: str) -> dict[str, Result]:
    """All cells of a problem, the reference first."""
    stored = studies.stored("together", "held" if name in THREE else "every")
    return {c: result(stored, f"{name}_{c}", c) for c in cells_in(stored, f"{name}_")}


def cells_in(stored: Any, prefix: str) -> list[str]:
    """The cells that a study has of a problem."""
    ends = "_floats"
    found = [c for c in stored.columns if c.startswith(prefix) and c.endswith(ends)]
    return [c.removeprefix(prefix).removesuffix(ends) for c in found]


def ratio(one: Result, other: Result) -> Interval:
    """Root-mean-square error over another's on the same runs, with its 95% interval."""
    if one.failed:
        return Interval(np.inf, np.inf, np.inf, np.inf)
    middle = float(np.sqrt(one.error.mean() / other.error.mean()))
    spread = one.error / one.error.mean() - other.error / other.error.mean()
    error = mean_interval(spread).error / 2
    return Interval(
        middle,
        middle * np.exp(-1.96 * error),
        middle * np.exp(1.96 * error),
        middle * error,
    )


def front(points: Mapping[str, tuple[float, float]]) -> list[str]:
    """The names of (cost, error) that nothing beats in both, by rising cost."""
    out: list[str] = []
    for name in sorted(points, key=lambda k: points[k]):
        if not out or points[name][1] < points[out[-1]][1]:
            out.append(name)
    return out


def holm(p_values: Mapping[str, float], level: float = 0.05) -> set[str]:
    """The hypotheses that Holm's step-down procedure rejects, all of them right with 1 - level."""
    out: set[str] = set()
    for k, name in enumerate(sorted(p_values, key=lambda n: p_values[n])):
        if p_values[name] > level / (len(p_values) - k):
            break
        out.add(name)
    return out


def worse(best: Result, others: Iterable[Result]) -> set[str]:
    """The cells whose error differs from the best's on the same runs, by Holm."""
    from scipy.stats import ttest_rel

    def p_value(other: Result) -> float:
        if other.failed:
            return 0.0
        if np.allclose(other.error, best.error, rtol=1e-4):
            return 1.0
        return float(ttest_rel(other.error, best.error).pvalue)

    return holm({o.cell: p_value(o) for o in others if o.cell != best.cell})


# ------------------------------------------------------------------------------------ operations


def operations(p: Any, cell: str, members: int | None = None) -> float:
    """Leading terms of an agent's floating-point operations in a step."""
    d = p.model.dim
    agents = p.agents
    m = p.sensors[0].dim
    near = float(p.graph.in_degree.mean())
    talk = cell.split("_")[-1]
    used = {
        "near": 1 + near,
        "ci": 1 + near,
        "trace": 1 + near,
        "pull": 1 + near,
        "flood": agents,
    }.get(talk, 1)
    M = used * m
    flow = 400 if "chaotic" in p.traits else 2 * d * d
    fusing = (
        {"ci": 25, "trace": 2, "naive": 2, "info": 8}.get(talk, 0) * (1 + near) * d**3
    )
    averaged = {"two": 2, "meas": agents / 2}.get(talk, 0) * near * d * d
    size = {"pf": "particles", "ot": "transported"}.get(cell.split("_")[0], "members")
    N = members or together.STUDY[size]
    kind = cell.split("_")[0]
    if kind in ("ekf", "ukf"):
        extra = (2 * d + 1) * (flow + M * d) if kind == "ukf" else 0
        return 4 * d**3 + 2 * M * d * (d + M) + M**3 + fusing + averaged + extra
    if kind in ("news", "own"):
        return 10 * 6**3 + 4 * near * 4**3
    if kind == "gm":
        return near * together.STUDY["mixands"] ** 2 * 10 * d**3
    if kind == "grid":
        return 40**2 * (100 + 10 * M)
    if kind == "ot":
        return N**3 * np.log2(N)
    if kind == "pf":
        terms = 15 if "curved" in p.traits else 10
        agreed = 2 * terms**2 if talk == "agreed" else 0
        return N * (flow + 2 * d * d + 10 * M + agreed) + fusing
    gain = N * (flow + 2 * d * d + 2 * M * (d + M)) + M**3 + fusing
    more = {"exact": 4 * N * (d + M) ** 2, "root": 6 * N * M * min(N, M)}.get(kind, 0)
    return gain + more + (20 * d * N * (2 * (d + M)) ** 2 if kind == "maps" else 0)


# ----------------------------------------------------------------------------------------- a tree

QUESTIONS = ("plane", "doubted", "chaotic", "several", "curved", *BUDGETS)
"""What a user knows of a problem, and whether an agent may send more than so much.

Where two questions divide the four problems alike the first stands: what there is room for comes
before what bends.
"""


def says(question: Any, name: str, budget: float) -> bool:
    """The answer for a problem and a budget."""
    if question == "plane":
        return bool(together.problem(name).model.dim <= 2)
    if isinstance(question, str):
        return question in together.problem(name).traits
    return budget > question


@cache
def regret(name: str, budget: float, cell: str) -> float:
    """Logarithm of a cell's error over the best honest one's that the budget allows."""
    found = results(name)
    here = found.get(cell)
    if here is None or not here.honest or here.floats > budget:
        return np.inf
    return float(0.5 * np.log(here.error.mean() / best(name, budget).error.mean()))


def allowed(name: str, budget: float = np.inf) -> list[Result]:
    """The honest cells that a budget allows."""
    return [
        r
        for c, r in results(name).items()
        if c not in ("reference", "half") and r.honest and r.floats <= budget
    ]


@cache
def best(name: str, budget: float = np.inf) -> Result:
    """The honest cell of least error that a budget allows; the cheapest of those that are alike."""
    found = allowed(name, budget)
    least = min(r.error.mean() for r in found)
    return min(
        (r for r in found if r.error.mean() < least * (1 + 1e-4)),
        key=lambda r: r.floats,
    )


def leaf(rows: Sequence[tuple[str, float]]) -> tuple[float, str]:
    """The cell of least mean regret on some rows, none above being infinite if possible."""
    costs = {c: sum(min(regret(*row, c), 10.0) for row in rows) for c in together.CELLS}
    cell = min(costs, key=lambda c: (costs[c], c))
    return costs[cell], cell


def tree(rows: Sequence[tuple[str, float]], depth: int) -> tuple[float, Any]:
    """The tree of at most so many questions deep that has the least regret on the rows."""
    found: tuple[float, Any] = leaf(rows)
    if depth == 0 or found[0] < 1e-9:
        return found
    for question in QUESTIONS:
        yes = tuple(row for row in rows if says(question, *row))
        no = tuple(row for row in rows if not says(question, *row))
        if yes and no:
            (a, one) = grown(yes, depth - 1)
            (b, two) = grown(no, depth - 1)
            # A question has to be worth a hundredth.
            if a + b < found[0] - 0.01:
                found = a + b, (question, one, two)
    return found


@cache
def grown(rows: tuple[tuple[str, float], ...], depth: int) -> tuple[float, Any]:
    """As `tree`, remembered."""
    return tree(rows, depth)


def picked(node: Any, name: str, budget: float) -> str:
    """The cell that a tree picks."""
    while isinstance(node, tuple):
        question, yes, no = node
        node = yes if says(question, name, budget) else no
    return str(node)
