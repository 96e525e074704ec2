"""The program (12) of Grange et al. as printed, for a conic solver."""

from __future__ import annotations

import warnings
from functools import lru_cache
from threading import Lock
from typing import Any

import numpy as np

from ..checks import Array, SolverError, count, needed

__all__: list[str] = []

LIMIT = {"ECOS": "max_iters", "CLARABEL": "max_iter"}
"""The solvers, and what each calls its limit of iterations."""


def solve_component(z: Array, solver: str, max_iters: int | None) -> Array:
    """Coefficients (u_0, u_1 … u_k) that minimise (12) for the last column of `z`."""
    cp = needed("cvxpy", "maps")

    n, k = z.shape
    problem, root, u = _program(k)
    limit = {} if max_iters is None else {LIMIT[solver]: count(max_iters, "max_iters")}
    # What cvxpy would warn of, the status below tells, and it becomes an error.
    with _SOLVING, warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore")
        root.value = np.linalg.qr(np.column_stack([np.ones(n), z]) / np.sqrt(n), mode="r")
        try:
            problem.solve(solver=solver, warm_start=False, **limit)
        except cp.error.SolverError as error:
            raise SolverError(
                f"{solver}: component {k} of the map has no solution: {error}"
            ) from None
        if problem.status != cp.OPTIMAL:
            raise SolverError(f"{solver}: component {k} of the map stopped with {problem.status!r}")
        return np.asarray(u.value, dtype=np.float64).copy()


_SOLVING = Lock()
"""A compiled program holds its last data: one thread at a time."""


@lru_cache(maxsize=32)
def _program(k: int) -> tuple[Any, Any, Any]:
    """The program (12) of component k, compiled once, with the samples' triangular factor open.

    The samples enter by |u_0 + Z u|² only, which their QR factor keeps.
    """
    cp = needed("cvxpy", "maps")

    root, u = cp.Parameter((k + 1, k + 1)), cp.Variable(k + 1)
    loss = cp.sum_squares(root @ u) / 2 - cp.log(u[k])
    return cp.Problem(cp.Minimize(loss)), root, u
