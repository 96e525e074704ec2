"""Results of chapter 11's stored studies: ratios, fronts, Holm's test and a decision tree."""

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
CONSISTENT = (0.8, 1.25)
"""NEES per component of a filter that is called consistent; the text says where 0.95 to 1.05."""
BUDGETS = (3, 12, 32, 64, 400)
"""Numbers that an agent may send in a step."""
Row = tuple[str, float]
"""A problem's name and a budget."""


@dataclass(frozen=True, eq=False)
class Result:
    """A cell's runs: squared errors and NEES per component, (n,), and numbers sent a step."""

    cell: str
    error: np.ndarray
    nees: np.ndarray
    floats: float

    @property
    def failed(self) -> int:
        """Number of runs without a result."""
        return int((~np.isfinite(self.error)).sum())

    @property
    def mean_nees(self) -> float:
        """The mean NEES per component."""
        return float(self.nees.mean())

    @property
    def consistent(self) -> bool:
        """Whether the reported covariances fit the errors, and no run failed."""
        return not self.failed and CONSISTENT[0] <= self.mean_nees <= CONSISTENT[1]


def stack_runs(stored: Any, name: str, score: str) -> np.ndarray:
    """Return a score of all runs of a cell, trial after trial."""
    runs = [stored.metric(f"{name}_{score}_{r}") for r in range(together.BATCH)]
    return np.stack(runs, axis=-1).ravel()


def result(stored: Any, name: str, cell: str = "") -> Result:
    """Return a cell's result; `name` begins its columns."""
    floats = float(stored.metric(f"{name}_floats").mean())
    error = stack_runs(stored, name, "error")
    nees = stack_runs(stored, name, "nees")
    return Result(cell or name, error, nees, floats)


@cache
def results(name: str) -> dict[str, Result]:
    """Return all cells of a problem, the reference first."""
    stored = studies.stored("together", "held" if name in THREE else "every")
    prefix = f"{name}_"
    cells = cells_in(stored, prefix)
    return {cell: result(stored, prefix + cell, cell) for cell in cells}


def cells_in(stored: Any, prefix: str) -> list[str]:
    """Return the cells that a study has of a problem."""
    suffix = "_floats"
    columns = [c for c in stored.columns if c.startswith(prefix) and c.endswith(suffix)]
    return [column.removeprefix(prefix).removesuffix(suffix) for column in columns]


def ratio(one: Result, other: Result) -> Interval:
    """Return the ratio of root-mean-square errors on the same runs, with its 95% interval."""
    if one.failed:
        return Interval(np.inf, np.inf, np.inf, np.inf)
    estimate = float(np.sqrt(one.error.mean() / other.error.mean()))
    # The standard error of the logarithm, by the delta method on paired runs
    influence = one.error / one.error.mean() - other.error / other.error.mean()
    error = mean_interval(influence).error / 2
    low = estimate * np.exp(-1.96 * error)
    high = estimate * np.exp(1.96 * error)
    return Interval(estimate, low, high, estimate * error)


def front(points: Mapping[str, tuple[float, float]]) -> list[str]:
    """Return the names of (cost, error) that no other beats in both, by rising cost."""
    names: list[str] = []
    for name in sorted(points, key=lambda key: points[key]):
        if not names or points[name][1] < points[names[-1]][1]:
            names.append(name)
    return names


def holm(p_values: Mapping[str, float], level: float = 0.05) -> set[str]:
    """Return the hypotheses that Holm's step-down procedure rejects at a familywise level."""
    rejected: set[str] = set()
    for k, name in enumerate(sorted(p_values, key=lambda key: p_values[key])):
        if p_values[name] > level / (len(p_values) - k):
            break
        rejected.add(name)
    return rejected


def worse(best: Result, others: Iterable[Result]) -> set[str]:
    """Return the cells whose error differs from the best's on the same runs, by Holm."""
    from scipy.stats import ttest_rel

    def p_value(other: Result) -> float:
        if other.failed:
            return 0.0
        if np.allclose(other.error, best.error, rtol=1e-4):
            return 1.0
        return float(ttest_rel(other.error, best.error).pvalue)

    return holm({r.cell: p_value(r) for r in others if r.cell != best.cell})


# ------------------------------------------------------------------------------------ operations

FUSION_FACTORS = {"ci": 25, "trace": 2, "naive": 2, "info": 8}
"""Multiples of d³ for the fusion of one neighbour's belief, by rule."""
SHARING_NEIGHBOURS = ("near", "ci", "trace", "pull")
"""Rules under which agents use the observations of their neighbours."""
SIZES = {"pf": "particles", "ot": "transported"}


def count_operations(p: Any, cell: str, members: int | None = None) -> float:
    """Return the leading terms of an agent's floating-point operations in a step."""
    family = cell.split("_")[0]
    rule = cell.split("_")[-1]
    d = p.model.dim
    near = float(p.graph.in_degree.mean())
    m = count_observed(p, rule, near)
    transition = 400 if "chaotic" in p.traits else 2 * d * d
    fusing = FUSION_FACTORS.get(rule, 0) * (1 + near) * d**3
    # Covariance forecast 4 d³, update 2 m d (d + m) + m³
    if family in ("ekf", "ukf"):
        rounds = {"two": 2, "meas": p.n_agents / 2}.get(rule, 0)
        averaging = rounds * near * d * d
        points = (2 * d + 1) * (transition + m * d) if family == "ukf" else 0
        update = 2 * m * d * (d + m) + m**3
        return 4 * d**3 + update + fusing + averaging + points
    if family in ("news", "own"):
        return 10 * 6**3 + 4 * near * 4**3
    # Every pair of components is fused.
    if family == "gm":
        return near * together.STUDY["mixands"] ** 2 * 10 * d**3
    if family == "grid":
        return 40**2 * (100 + 10 * m)
    n = members or together.STUDY[SIZES.get(family, "members")]
    if family == "ot":
        # The network simplex
        return n**3 * np.log2(n)
    # Each particle moves, is observed, and is weighted.
    if family == "pf":
        terms = 15 if "curved" in p.traits else 10
        consensus = 2 * terms**2 if rule == "agreed" else 0
        return n * (transition + 2 * d * d + 10 * m + consensus) + fusing
    return count_ensemble_operations(family, n, d, m, transition) + fusing


def count_observed(p: Any, rule: str, near: float) -> float:
    """Return how many observed components an agent uses in a step."""
    agents = 1.0
    if rule in SHARING_NEIGHBOURS:
        agents = 1 + near
    elif rule == "flood":
        agents = p.n_agents
    return agents * p.sensors[0].dim


def count_ensemble_operations(
    family: str, n: int, d: int, m: float, transition: float
) -> float:
    """Return the operations of an ensemble's forecast and update."""
    update = n * (transition + 2 * d * d + 2 * m * (d + m)) + m**3
    if family == "exact":
        return update + 4 * n * (d + m) ** 2
    if family == "root":
        return update + 6 * n * m * min(n, m)
    if family == "maps":
        return update + 20 * d * n * (2 * (d + m)) ** 2
    return update


# --------------------------------------------------------------------------------- decision tree

QUESTIONS = ("plane", "doubted", "chaotic", "several", "curved", *BUDGETS)
"""Traits of a problem that a user knows, and budgets that an agent may exceed.

Where two questions divide the four problems alike the first one stands: the dimension
comes before the curvature.
"""


def answer(question: Any, name: str, budget: float) -> bool:
    """Return the answer to a question for a problem and a budget."""
    if question == "plane":
        return bool(together.problem(name).model.dim <= 2)
    if isinstance(question, str):
        return question in together.problem(name).traits
    return budget > question


@cache
def regret(name: str, budget: float, cell: str) -> float:
    """Return the log of a cell's error over the best consistent one's within the budget."""
    candidate = results(name).get(cell)
    if candidate is None or not candidate.consistent or candidate.floats > budget:
        return np.inf
    least = best(name, budget).error.mean()
    return float(0.5 * np.log(candidate.error.mean() / least))


def admissible(name: str, budget: float = np.inf) -> list[Result]:
    """Return the consistent cells within a budget."""
    return [
        r
        for cell, r in results(name).items()
        if cell not in ("reference", "half") and r.consistent and r.floats <= budget
    ]


@cache
def best(name: str, budget: float = np.inf) -> Result:
    """Return the consistent cell of least error within a budget; of equal ones the cheapest."""
    candidates = admissible(name, budget)
    least = min(r.error.mean() for r in candidates)
    equal = [r for r in candidates if r.error.mean() < least * (1 + 1e-4)]
    return min(equal, key=lambda r: r.floats)


def best_leaf(rows: Sequence[Row]) -> tuple[float, str]:
    """Return the least total regret on some rows, and its cell; infinite regrets count 10."""
    costs = {}
    for cell in together.CELLS:
        costs[cell] = sum(min(regret(*row, cell), 10.0) for row in rows)
    cell = min(costs, key=lambda name: (costs[name], name))
    return costs[cell], cell


def tree(rows: Sequence[Row], depth: int) -> tuple[float, Any]:
    """Return the tree of limited depth that has the least regret on the rows."""
    least: tuple[float, Any] = best_leaf(rows)
    if depth == 0 or least[0] < 1e-9:
        return least
    # Split by the question that lowers the total regret most.
    for question in QUESTIONS:
        yes = tuple(row for row in rows if answer(question, *row))
        no = tuple(row for row in rows if not answer(question, *row))
        if not yes or not no:
            continue
        cost_yes, tree_yes = tree_once(yes, depth - 1)
        cost_no, tree_no = tree_once(no, depth - 1)
        cost = cost_yes + cost_no
        # A question has to be worth a hundredth.
        if cost < least[0] - 0.01:
            least = cost, (question, tree_yes, tree_no)
    return least


@cache
def tree_once(rows: tuple[Row, ...], depth: int) -> tuple[float, Any]:
    """Return `tree`, computed once."""
    return tree(rows, depth)


def pick_cell(node: Any, name: str, budget: float) -> str:
    """Return the cell that a tree picks."""
    while isinstance(node, tuple):
        question, yes, no = node
        node = yes if answer(question, name, budget) else no
    return str(node)
