"""One network, every filter: all that the studies of chapter 11 share, under one name.

A `Problem` is a model, sensors, a graph, a prior and the times at which agents are
silent (`_together_problems.py`). A `Cell` is a filter with a rule of exchange; it makes
the filter for any problem and for any value of its one tuned option
(`_together_cells.py`). Filters that the library does not have stand in
`_together_filters.py` and `_together_mixtures.py`, the one loop that runs and scores
them in `_together_scoring.py`.
"""

from __future__ import annotations

import ast
import hashlib
import inspect
from dataclasses import replace
from functools import cache

import _together_cells
import _together_filters
import _together_mixtures
import _together_problems
import _together_scoring
from _together_cells import (
    CELLS,
    Cell,
    cell_names,
    gaussian_maker,
    make_likelihood_consensus,
    square_grid,
)
from _together_filters import (
    LikelihoodConsensus,
    SplitIntersection,
    average_on_tree,
    spanning_tree,
)
from _together_mixtures import BatchedMixtures
from _together_problems import (
    BATCH,
    FOUR,
    HELD,
    STUDY,
    THREE,
    TUNED,
    TUNING,
    Problem,
    problem,
)
from _together_scoring import (
    best_value,
    draw_data,
    ill_conditioned_columns,
    make_seeds,
    measure,
    measure_cells,
    measure_references,
    references,
    run_problem,
    score_columns,
    score_filter,
    stream,
    tuned_value,
    values_that_count,
)

__all__ = [
    "BATCH",
    "CELLS",
    "FOUR",
    "HELD",
    "STUDY",
    "THREE",
    "TUNED",
    "TUNING",
    "BatchedMixtures",
    "Cell",
    "LikelihoodConsensus",
    "Problem",
    "SplitIntersection",
    "average_on_tree",
    "best_value",
    "cell_names",
    "draw_data",
    "gaussian_maker",
    "ill_conditioned_columns",
    "make_likelihood_consensus",
    "make_seeds",
    "measure",
    "measure_cells",
    "measure_references",
    "problem",
    "program_digest",
    "references",
    "replace",
    "run_problem",
    "score_columns",
    "score_filter",
    "spanning_tree",
    "square_grid",
    "stream",
    "tuned_value",
    "values_that_count",
]

MODULES = (
    _together_problems,
    _together_filters,
    _together_mixtures,
    _together_cells,
    _together_scoring,
)


@cache
def program_digest() -> str:
    """Return a digest of the source of these modules, without comments and docstrings.

    The studies store it, so that another filter, cell or problem than the stored one is
    noticed.
    """
    text = ""
    for module in MODULES:
        tree = ast.parse(inspect.getsource(module))
        for node in ast.walk(tree):
            body = vars(node).get("body", [])
            if isinstance(body, list):
                node.body = [part for part in body if not is_docstring(part)]
        text += ast.unparse(tree)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def is_docstring(node: ast.AST) -> bool:
    """Return whether a statement is a constant that stands alone."""
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
