"""Failures of a step: which errors count as one, and how the other runs of a batch go on."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress

import numpy as np

from ..linalg import SolverError
from ..validation import Array, format_number

__all__ = [
    "RECOVERABLE",
    "FilterError",
    "Row",
    "find_nonfinite_rows",
    "is_argument_error",
    "recompute_rows",
]

RECOVERABLE = (np.linalg.LinAlgError, ArithmeticError, SolverError, ValueError)
"""Errors by which one row of a batch, or one agent, may fail although the call is right."""

Row = tuple[int, ...]
"""Index of one row of a batch: its run, and its agent if the batch has an axis of agents."""

Compute = Callable[..., tuple[Array, ...]]
"""``compute(*arrays, shared, rng) -> arrays`` for any leading axes."""


class FilterError(RuntimeError):
    """One agent's step failed: the message names run, agent, time and cause.

    Parameters
    ----------
    run : tuple of int
        Index of the independent run.
    agent : int or None
        Number of the agent; None if the step failed for all of them at once.
    t : float
        Time of the step, in s.
    why : object
        The cause.

    Examples
    --------
    >>> FilterError((3,), 1, 2.5, "singular matrix")
    FilterError('run 3, agent 1, t = 2.5 s: singular matrix')
    """

    def __init__(
        self, run: tuple[int, ...], agent: int | None, t: float, why: object
    ) -> None:
        self.run = run
        self.agent = agent
        self.t = t
        self.why = str(why)
        run_text = f"run {', '.join(map(str, run))}, " if run else ""
        agent_text = "" if agent is None else f"agent {agent}, "
        super().__init__(f"{run_text}{agent_text}t = {format_number(t)} s: {why}")

    def __reduce__(self) -> tuple[type[FilterError], tuple[object, ...]]:
        return FilterError, (self.run, self.agent, self.t, self.why)


def recompute_rows(
    compute: Compute,
    arrays: tuple[Array, ...],
    fallback: tuple[Array, ...],
    lead: int,
    *,
    shared: Array,
    rng: np.random.Generator | None,
    rng_state: Mapping[str, object] | None,
    cause: Exception,
) -> tuple[tuple[Array, ...], dict[Row, str]]:
    """Compute each row of a batch alone after the batch as a whole has failed.

    Parameters
    ----------
    compute : callable
        ``compute(*arrays, shared, rng) -> results``; it failed on the whole batch.
    arrays : tuple of ndarray, (*lead, ...)
        Its arguments.
    fallback : tuple of ndarray
        The results of rows that fail.
    lead : int
        Number of leading axes that count rows.
    shared : ndarray, (m, m) or (G, m, m)
        One argument for all rows, or one for each entry of the last leading axis.
    rng : numpy.random.Generator, optional
        Passed on to `compute`.
    rng_state : object
        The generator's state before the batch.
    cause : Exception
        The batch's error. It is raised again if it is an error of an argument and no row can do
        without it: then the call is wrong, not a row.

    Returns
    -------
    results : tuple of ndarray
    errors : dict
        The reason for each failure, by the row's index.
    """
    # The indices of all rows: of one run, or of one agent in one run
    rows = list(np.ndindex(arrays[0].shape[:lead]))
    results = tuple([values.copy() for values in fallback])
    errors: dict[Row, str] = {}
    for row in rows:
        # One matrix for each agent, or one for all
        row_shared = shared[row[-1]] if shared.ndim > 2 else shared
        try:
            row_results = compute(*[a[row] for a in arrays], row_shared, rng)
        except RECOVERABLE as error:
            errors[row] = str(error)
            continue
        for values, row_values in zip(results, row_results, strict=True):
            values[row] = row_values
    if len(errors) == len(rows) and is_argument_error(cause):
        raise cause
    if not errors or len(errors) == len(rows):
        return results, errors
    # A row's draws must not depend on whether another one fails. So the batch is computed once
    # more from the same state of the generator, with a good row in place of each failed one.
    good = next(row for row in rows if row not in errors)
    indices = tuple(np.transpose([good if row in errors else row for row in rows]))
    substituted = [a[indices].reshape(a.shape) for a in arrays]
    if rng is not None and rng_state is not None:
        rng.bit_generator.state = rng_state
    # If the batch fails all the same, the results are those of the rows computed alone.
    with suppress(*RECOVERABLE):
        results = compute(*substituted, shared, rng)
    return results, errors


def is_argument_error(error: Exception) -> bool:
    """Whether an error is about wrong arguments; numpy's LinAlgError is a ValueError too."""
    is_numerical = isinstance(error, np.linalg.LinAlgError)
    return isinstance(error, ValueError) and not is_numerical


def find_nonfinite_rows(values: Array, lead: int, name: str) -> dict[Row, str]:
    """Find the rows of values (*lead, ...) with NaN or infinity, each with its error.

    >>> find_nonfinite_rows(np.array([[1.0], [np.nan]]), 1, "forecast")
    {(1,): 'the forecast is not finite'}
    """
    is_finite = np.isfinite(values).reshape(*values.shape[:lead], -1).all(axis=-1)
    rows = np.argwhere(~is_finite).tolist()
    return {tuple(row): f"the {name} is not finite" for row in rows}
