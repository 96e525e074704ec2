"""Bad input for every argument of every public callable, in a process of its own per run."""

from __future__ import annotations

import subprocess
import sys

import pytest

from tests.tools import fuzz


@pytest.mark.slow
def test_no_argument_is_misread_and_no_input_changed() -> None:
    """Every exchange is refused by name, or right, or allowed with a reason; prints the counts."""
    command = [sys.executable, "-m", "tests.tools.fuzz"]
    done = subprocess.run(command, capture_output=True, text=True, cwd=fuzz.ROOT)
    print(done.stdout.splitlines()[-1] if done.stdout else done.stderr[-2000:])
    assert done.returncode == 0, done.stdout[-20000:] + done.stderr[-2000:]


def test_a_door_left_open_is_found() -> None:
    """The kinds and the judgement, on functions that do what is forbidden."""
    import inspect

    import numpy as np

    def of(function: object, *args: object) -> dict[str, str]:
        signature = inspect.signature(function)  # type: ignore[arg-type]
        call = fuzz.Call(function, signature, dict(signature.bind(*args).arguments))  # type: ignore[arg-type]
        return {f.kind: f.result for f in fuzz.of("f", [call])}

    def careless(x: object) -> object:
        return np.asarray(x, dtype=complex).real * 2

    def writes(x: object) -> float:
        np.asarray(x)[...] = 0.0  # a list is copied, an array is not
        return 0.0

    def order(x: np.ndarray) -> np.ndarray:
        return (
            np.frombuffer(x.tobytes("A")) if isinstance(x, np.ndarray) else np.ravel(x)
        )

    def careful(x: object) -> float:
        if (
            type(x) not in (list, np.ndarray)
            or np.asarray(x, dtype=object).ravel()[:1].size == 0
        ):
            raise ValueError("x must be numbers")
        if not all(isinstance(v, float) for v in np.asarray(x, dtype=object).ravel()):
            raise ValueError("x must be numbers")
        if not np.isfinite(x).all():
            raise ValueError("x must have finite numbers")
        return float(np.sum(x))

    a = np.array([[1.0, 2.0], [3.0, 4.5]])
    found = of(careless, a)
    assert found["complex"] == found["booleans"] == found["masked"] == "taken"
    assert (
        found["NaN"] == "NaN" and found["list"] == "same" and found["object"] == "raw"
    )
    assert of(writes, a)["zero"] == "finite" and of(writes, a)["huge"] == "changed"
    assert of(writes, a)["read-only"] == "misread"
    assert of(order, a)["fortran"] == "different" and of(order, a)["strided"] == "same"
    assert set(of(careful, a).values()) <= {"rejected", "same", "finite"}
