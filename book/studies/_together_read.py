"""Results of chapter 11's stored studies: ratios, fronts, Holm's test, bills and operations.

Most functions take `runs`, the first run and the one after the last that count: choices
are made on one half of the runs and judged on the other.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
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
BUDGETS = (2, 5, 10, 20, 64)
"""Numbers that an agent may send in a step."""
Runs = tuple[int, int]
ALL: Runs = (0, together.STUDY["runs"])
SIMULATED: Runs = (0, ALL[1] // 2)
"""Runs on which filters are chosen."""
JUDGED: Runs = (ALL[1] // 2, ALL[1])
"""Runs on which the choices are judged."""
TO_CENTRE = "observations to a centre, estimate back"
CENTRES = {
    f"{family}_centre": replace(together.CELLS[f"{family}_flood"], exchange=TO_CENTRE)
    for family in ("ekf", "ukf", "sum9", "known", "pf", "grid")
}
"""A centre that has all observations is the filter that floods them, with another bill."""
CELLS = together.CELLS | CENTRES


@dataclass(frozen=True, eq=False)
class Result:
    """A cell's runs: squared errors and NEES per component, (n,), and numbers sent a step.

    `floats` counts the numbers link by link, `cast` by broadcast.
    """

    cell: str
    error: np.ndarray
    nees: np.ndarray
    floats: float
    cast: float

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
    # A row of the file is a trial, with a column for each of its runs.
    runs = [stored.metric(f"{name}_{score}_{r}") for r in range(together.BATCH)]
    return np.stack(runs, axis=-1).ravel()


def result(stored: Any, name: str, cell: str = "") -> Result:
    """Return a cell's result; `name` begins its columns."""
    floats, cast = (
        float(stored.metric(f"{name}_{bill}").mean()) for bill in ("floats", "cast")
    )
    error = stack_runs(stored, name, "error")
    nees = stack_runs(stored, name, "nees")
    return Result(cell or name, error, nees, floats, cast)


@cache
def results(name: str, runs: Runs = ALL) -> dict[str, Result]:
    """Return all cells of a problem, the reference first, those with a centre last."""
    if runs != ALL:
        part = slice(*runs)
        return {
            cell: replace(r, error=r.error[part], nees=r.nees[part])
            for cell, r in results(name).items()
        }
    stored = studies.stored("together", "held" if name in THREE else "every")
    prefix = f"{name}_"
    cells = cells_in(stored, prefix)
    found = {cell: result(stored, prefix + cell, cell) for cell in cells}
    floats, cast = centre_bills(together.problem(name))
    for cell in CENTRES:
        flooded = found.get(cell.replace("_centre", "_flood"))
        if flooded is not None:
            found[cell] = replace(flooded, cell=cell, floats=floats, cast=cast)
    return found


def centre_bills(p: Any) -> tuple[float, float]:
    """Return the numbers that an agent sends in a step if one of them is the centre, by both bills.

    Observations go to the root of the spanning tree, each with the number of its agent;
    the estimate, a mean and a covariance, comes back along it.
    """
    # An observation crosses as many links as its agent is away from the root.
    tree = together.spanning_tree(p.graph)
    depth = np.zeros(p.n_agents)
    for agent, parent in tree:
        depth[agent] = depth[parent] + 1
    present = np.ones((len(p.times), p.n_agents))
    if p.silent is not None:
        present = ~p.silent
    # Every link on the way costs the observation's numbers and the agent's once.
    numbers_up = (p.sensors[0].dim + 1) * float((present @ depth).mean())
    d = len(p.scored)
    estimate = d + d * (d + 1) // 2
    # By broadcast an agent reaches all its children at once.
    n_parents = len({parent for _, parent in tree})
    by_link = numbers_up + estimate * len(tree)
    by_broadcast = numbers_up + estimate * n_parents
    return by_link / p.n_agents, by_broadcast / p.n_agents


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
    # By rising cost, and by rising error where costs are equal
    for name in sorted(points, key=lambda key: points[key]):
        if not names or points[name][1] < points[names[-1]][1]:
            names.append(name)
    return names


def holm(p_values: Mapping[str, float], level: float = 0.05) -> set[str]:
    """Return the hypotheses that Holm's step-down procedure rejects at a familywise level."""
    rejected: set[str] = set()
    # The k-th smallest p-value is compared with the level over what is left.
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

FUSION_FACTORS = {
    "ci": 25,
    "trace": 2,
    "naive": 2,
    "info": 8,
    "inverted": 25,
    "ellipsoid": 25,
    "split": 50,
    "union": 250,
    "channel": 8,
}
"""Multiples of d³ for the fusion of one neighbour's belief, by rule."""
SHARING_NEIGHBOURS = (
    *("near", "ci", "trace", "pull"),
    *("diffuse", "inverted", "ellipsoid", "union"),
)
"""Rules under which agents use the observations of their neighbours."""
SIZES = {"pf": "particles", "ot": "transported"}
SUMS = {"sum4": 4, "sum9": 9, "sum16": 16}
"""Components of Gaussian sums."""


def count_operations(p: Any, cell: str, members: int | None = None) -> float:
    """Return the leading terms of the busiest agent's floating-point operations in a step."""
    family = cell.split("_")[0]
    rule = cell.split("_")[-1]
    d = p.model.dim
    near = float(p.graph.in_degree.mean())
    m = count_observed(p, rule, near)
    transition = 400 if "chaotic" in p.traits else 2 * d * d
    fusing = FUSION_FACTORS.get(rule, 0) * (1 + near) * d**3
    if family in ("ekf", "iekf", "ukf", *SUMS):
        return count_kalman_operations(p, cell, m, transition) + fusing
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
    elif rule == "hops":
        hops = np.array([p.graph.hops(k) for k in range(p.n_agents)])
        agents = float((hops <= 2).sum(axis=1).mean())
    elif rule in ("flood", "centre"):
        agents = p.n_agents
    return agents * p.sensors[0].dim


def count_kalman_operations(p: Any, cell: str, m: float, transition: float) -> float:
    """Return the operations of a Kalman filter, or of a sum of them, without fusion."""
    family = cell.split("_")[0]
    rule = cell.split("_")[-1]
    d = p.model.dim
    near = float(p.graph.in_degree.mean())
    # Covariance forecast 4 d³, update 2 m d (d + m) + m³
    update = 2 * m * d * (d + m) + m**3
    if family == "iekf":
        return 4 * d**3 + 4 * update
    if family in SUMS:
        points = (2 * d + 1) * (transition + m * d)
        return SUMS[family] * (4 * d**3 + update + points)
    points = (2 * d + 1) * (transition + m * d) if family == "ukf" else 0
    rounds = {"two": 2, "icf": 4, "hcmci": 8, "meas": p.n_agents / 2, "tree": 2}
    rounds["event"] = together.STUDY["triggered_rounds"]
    averaging = rounds.get(rule, 0) * near * d * d
    if rule in ("icf", "hcmci", "channel"):
        # Priors in the form of information and back
        averaging += 4 * d**3
    return 4 * d**3 + update + averaging + points


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


# --------------------------------------------------------------------------- the best cells


def admissible(name: str, budget: float = np.inf, runs: Runs = ALL) -> list[Result]:
    """Return the consistent cells within a budget of numbers, counted link by link."""
    return [
        r
        for cell, r in results(name, runs).items()
        if cell not in ("reference", "half") and r.consistent and r.floats <= budget
    ]


@cache
def best(name: str, budget: float = np.inf, runs: Runs = ALL) -> Result:
    """Return the consistent cell of least error within a budget; of equal ones the cheapest."""
    candidates = admissible(name, budget, runs)
    # Cells whose errors differ by rounding alone are equal.
    least = min(r.error.mean() for r in candidates)
    equal = [r for r in candidates if r.error.mean() < least * (1 + 1e-4)]
    return min(equal, key=lambda r: r.floats)


@cache
def least_work(name: str, budget: float = np.inf, runs: Runs = ALL) -> float:
    """Return the least operations of a consistent cell within ten percent of the best one."""
    p = together.problem(name)
    # Ten percent of error are 1.1² of squared error.
    limit = best(name, budget, runs).error.mean() * 1.1**2
    close = [r for r in admissible(name, budget, runs) if r.error.mean() <= limit]
    return min(count_operations(p, r.cell) for r in close)


# ------------------------------------------------------------------------- names and pictures

SHORT_EXCHANGES = {
    TO_CENTRE.rpartition(", ")[2]: "centre",
    "then means (diffusion)": "diffusion",
    "summed on a spanning tree": "tree",
}
"""Short names of rules of exchange, for the labels of pictures."""


def format_ratio(i: Interval) -> str:
    """Return a ratio with its interval as a text.

    Examples
    --------
    >>> format_ratio(Interval(0.5, 0.25, 0.75, 0.1))
    '0.500 [0.250, 0.750]'
    """
    return f"{i.estimate:.3f} [{i.low:.3f}, {i.high:.3f}]"


def short_name(cell: str) -> str:
    """Return a filter and its exchange in a few words, for pictures.

    Examples
    --------
    >>> short_name("ekf_tree")
    'extended: tree'
    """
    kind = CELLS[cell].family.rpartition(", ")[2]
    exchange = CELLS[cell].exchange.rpartition(", ")[2]
    return f"{kind}: {SHORT_EXCHANGES.get(exchange, exchange)}"


@cache
def stored_sizes() -> Any:
    """Return the stored sweep over members and agents, which is read once."""
    return studies.stored("together", "sizes")


def sweep_result(
    name: str, kind: str, number: int, cell: str
) -> tuple[Interval, Result]:
    """Return a cell of the sweep over members or agents: error over the reference's, and result.

    `kind` is "members" or "agents". All numbers of members have one reference; with more
    agents there are more observations, so that each number of agents has its own.
    """
    stored = stored_sizes()
    name_of_reference = f"{name}_{kind}_reference"
    if kind == "agents":
        name_of_reference = f"{name}_{kind}_{number}_reference"
    swept = result(stored, f"{name}_{kind}_{number}_{cell}", cell)
    return ratio(swept, result(stored, name_of_reference)), swept


def draw_sweep(
    ax: Any, x: Iterable[float], intervals: Iterable[Interval], k: int, cell: str
) -> None:
    """Draw a cell's errors over a sweep, with their intervals, cut off at six."""
    from bookkit import plotting

    intervals = list(intervals)
    low, estimate, high = (
        np.minimum([getattr(i, bound) for i in intervals], 6)
        for bound in ("low", "estimate", "high")
    )
    ax.errorbar(
        list(x),
        estimate,
        yerr=[estimate - low, high - estimate],
        marker="o",
        ms=3,
        lw=1.2,
        color=plotting.colour(k),
        ls=plotting.line_style(k),
        label=short_name(cell),
    )
