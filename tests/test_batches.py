"""Leading axes of every public function are separate problems, whatever the others are.

Each function whose arguments are declared with leading axes, ``(..., N, d)``, gets the arguments of
its own example, and the same a little larger: once one after the other, and once in a stack.
"""

from __future__ import annotations

import inspect
import re
import warnings
from typing import Any

import numpy as np
import pytest

from tests.tools.calls import (
    Call,
    callables,
    calls,
    describe,
    public_names,
    subpackages,
)
from tests.tools.fuzz import parts

OTHER_AXES = {
    r"coupling\.(trans|correct).*": "weights of the ensemble's shape, which is not declared",
    r"kalman\.(kalman|filterpy|mekf|rts).*": "the first axis is the time",
    r"models\.AgentModels\..*": "an axis of agents",
    r"models\.(Linear)?Model\.noise_at": "one noise for all states",
    r"triangular\.separable\.fit": "the map has axes of its own before the leading ones",
    r"filters\..*": "an observation, and states that a filter makes",
}
"""Patterns of names whose leading axes are not free, and why."""
SHAPE = re.compile(r"of shape \(\.\.\.(?:, )?([^)]*)\)")


def count_axes(function: Any) -> dict[str, int]:
    """Return the number of axes behind the leading ones, by argument."""
    result = {}
    for name, constraint in describe(function).items():
        match = SHAPE.search(constraint.description) if constraint else None
        if match:
            result[name] = len([word for word in match[1].split(", ") if word])
    return result


def list_functions() -> dict[str, tuple[Any, Any]]:
    """Return public functions and methods with leading axes and without draws, by name."""
    functions = {}
    for package in subpackages():
        for name, thing in public_names(package).items():
            for method, function in callables(thing).items():
                label = f"{name}{method}"
                draws = "rng" in inspect.signature(function).parameters
                has_reason = any(re.fullmatch(p, label) for p in OTHER_AXES)
                if count_axes(function) and not draws and not has_reason:
                    functions[label] = (thing, function)
    return functions


FUNCTIONS = list_functions()


def enlarge(value: np.ndarray, constraint: Any) -> np.ndarray:
    """Return other values of the same kind; weights keep their sum."""
    is_weight = "probabilities" in constraint.description
    return value if is_weight else 1.01 * value


def evaluate(call: Call, **exchanged: Any) -> list[np.ndarray]:
    """Return all numbers of a result, as arrays."""
    with warnings.catch_warnings(action="ignore"):
        result, _ = call.run(**exchanged)
    return [np.asarray(part) for part in parts(result)]


@pytest.mark.parametrize("name", sorted(FUNCTIONS))
def test_a_stack_of_problems_is_solved_one_by_one(name: str) -> None:
    thing, function = FUNCTIONS[name]
    constraints = describe(function)
    examples = calls(thing, function)
    if not examples:
        pytest.skip("no example calls this method")
    call = examples[0]
    axes = {}
    for argument, n_axes in count_axes(function).items():
        if call.arguments.get(argument) is not None:
            axes[argument] = n_axes
    first = {argument: np.asarray(call.arguments[argument]) for argument in axes}
    second = {a: enlarge(value, constraints[a]) for a, value in first.items()}
    expected = [evaluate(call, **first)]
    try:
        expected.append(evaluate(call, **second))
    except ValueError:
        # Values that have to fit those of other arguments: both problems are the same.
        second = first
        expected.append(expected[0])
    # All arguments get as many leading axes as the one with most, and the stack before them.
    n_leading = max(first[a].ndim - n_axes for a, n_axes in axes.items())
    stacks = {}
    for argument, n_axes in axes.items():
        problems = []
        for values in (first[argument], second[argument], first[argument]):
            n_missing = n_leading - (values.ndim - n_axes)
            problems.append(values.reshape((1,) * n_missing + values.shape))
        stacks[argument] = np.stack(problems)
    together = evaluate(call, **stacks)
    for k, results in enumerate((expected[0], expected[1], expected[0])):
        assert len(together) == len(results)
        for stacked, single in zip(together, results, strict=True):
            # Words and sizes are those of all problems.
            if stacked.dtype.kind != "f":
                continue
            wanted = np.broadcast_to(single, stacked.shape[1:])
            assert np.allclose(
                stacked[k], wanted, rtol=1e-9, atol=1e-11, equal_nan=True
            )
