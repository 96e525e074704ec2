"""Unusual input for every argument of every public callable, in a process of its own."""

from __future__ import annotations

import inspect
import subprocess
import sys

import numpy as np
import pytest

from tests.tools import fuzz


@pytest.mark.slow
def test_no_argument_is_misread_and_no_input_changed() -> None:
    """Every exchange is rejected by name, right, or allowed with a reason."""
    command = [sys.executable, "-m", "tests.tools.fuzz"]
    result = subprocess.run(command, capture_output=True, text=True, cwd=fuzz.ROOT)
    print(result.stdout.splitlines()[-1] if result.stdout else result.stderr[-2000:])
    assert result.returncode == 0, result.stdout[-20000:] + result.stderr[-2000:]


def accept_anything(x: object) -> object:
    """Drop an imaginary part, and accept whatever numpy converts."""
    return np.asarray(x, dtype=complex).real * 2


def overwrite(x: object) -> float:
    """Write to an array; a list is converted to a new array, and so not changed."""
    np.asarray(x)[...] = 0.0
    return 0.0


def read_memory(x: np.ndarray) -> np.ndarray:
    """Depend on the order of an array in memory."""
    if isinstance(x, np.ndarray):
        return np.frombuffer(x.tobytes("A"))
    return np.ravel(x)


def add_up(x: object) -> float:
    """Accept finite real numbers only."""
    values = np.asarray(x, dtype=object).ravel()
    if type(x) not in (list, np.ndarray) or values.size == 0:
        raise ValueError("x must be numbers")
    if not all(isinstance(value, float) for value in values):
        raise ValueError("x must be numbers")
    if not np.isfinite(x).all():
        raise ValueError("x must have finite numbers")
    return float(np.sum(x))


def outcomes(function: object) -> dict[str, str]:
    """Return the outcome of each kind of value in the place of an array."""
    signature = inspect.signature(function)  # type: ignore[arg-type]
    arguments = {"x": np.array([[1.0, 2.0], [3.0, 4.5]])}
    call = fuzz.Call(function, signature, arguments)  # type: ignore[arg-type]
    return {f.kind: f.result for f in fuzz.fuzz_calls("f", [call])}


def test_missing_checks_are_found() -> None:
    """Functions with a known fault each: the outcome names it."""
    careless = outcomes(accept_anything)
    for kind in ("complex", "booleans", "masked"):
        assert careless[kind] == "accepted"
    assert careless["NaN"] == "NaN"
    assert careless["list"] == "same"
    assert careless["object"] == "raw"
    # Zeros stay as they are, a read-only array cannot be written.
    writing = outcomes(overwrite)
    assert writing["zero"] == "finite"
    assert writing["huge"] == "changed"
    assert writing["read-only"] == "misread"
    reading = outcomes(read_memory)
    assert reading["fortran"] == "different"
    assert reading["strided"] == "same"


def test_a_checked_function_has_no_fault() -> None:
    assert set(outcomes(add_up).values()) <= {"rejected", "same", "finite"}
