"""Unusual values for every argument of every validated callable.

    python -m tests.tools.fuzz [SUBPACKAGE …]

The valid calls come from the examples of the docstrings. Each argument is exchanged for the same
fixed list of values. An equivalent value (a list, Fortran order, read-only memory) must give the
same result. A value of a wrong type (dates, complex numbers, masked arrays, text) must be rejected
by an error that names the argument. Any other value is either rejected by an error that names an
argument, or gives a result without NaN. No call may change its arguments. Exceptions stand in
``ALLOWED`` with their reasons.
"""

from __future__ import annotations

import copy
import inspect
import os
import re
import signal
import sys
import tempfile
import time
import warnings
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tests.tools.calls import Call, callables, calls, public_names, subpackages

ROOT = Path(__file__).resolve().parents[2]
# The errors of the library; anything else is an accident, such as a KeyError inside.
REFUSALS = (ValueError, RuntimeError, LookupError, ImportError, FileNotFoundError)
# A call that takes longer counts as "too long".
SECONDS = 10


@dataclass(frozen=True)
class Finding:
    """The outcome of one exchanged argument."""

    name: str
    argument: str
    kind: str
    result: str
    text: str = ""


# ---- the values --------------------------------------------------------------------------------

SAME = {"list", "fortran", "read-only", "strided", "numpy scalar", "0-d array"}
"""Kinds that are equivalent to the valid value."""
NEVER = {
    "complex",
    "dates",
    "masked",
    "text",
    "booleans",
    "None",
    "object",
    "number",
    "dict",
}
"""Kinds that are rejected everywhere."""


def numeric(value: Any) -> bool:
    """Return whether a list or array holds real numbers."""
    with suppress(Exception):
        return np.asarray(value).dtype.kind in "fiu" and np.asarray(value).size > 0
    return False


def array_kinds(value: Any) -> Iterator[tuple[str, Any]]:
    a = np.array(value)
    f = np.array(value, dtype=float)
    with np.errstate(all="ignore"):
        # Equivalent forms of an array: its numbers are the same in each.
        if a.dtype.kind == "f":
            frozen = a.copy()
            frozen.flags.writeable = False
            # Every second entry of a wider array: memory with gaps
            wide = np.repeat(a, 2, axis=-1)[..., ::2] if a.ndim else a
            yield from (("list", a.tolist()), ("fortran", np.asfortranarray(a)))
            yield from (("read-only", frozen), ("strided", wide))
        # The first entry is masked; a function that ignored it would use a wrong
        # number.
        masked = np.ma.masked_array(f.copy(), np.arange(f.size).reshape(f.shape) == 0)
        yield from (("complex", f + 1j), ("dates", np.zeros(a.shape, "datetime64[s]")))
        yield from (("text", a.astype(str)), ("masked", masked), ("dict", {"a": 1.0}))
        yield from (("booleans", np.ones(a.shape, bool)), ("object", object()))
        # One bad entry among good ones is the hardest to see.
        for name, bad in (("NaN", np.nan), ("infinite", np.inf)):
            one = f.copy()
            one.flat[-1] = bad
            yield name, one
        yield from (
            ("huge", f * 1e300),
            ("tiny", f * 1e-300),
            ("negative", -f),
            ("zero", 0.0 * f),
        )
        yield from (("empty", np.zeros((0, *f.shape[1:]))), ("scalar", f.flat[0]))
        yield from (
            ("axis more", f[..., None]),
            ("axis before", f[None]),
            ("flat", f.ravel()),
        )
        if f.ndim:
            yield from (("empty last", f[..., :0].copy()), ("shorter", f[:-1].copy()))
            yield from (("turned", f.T.copy()), ("longer", np.concatenate([f, f[-1:]])))


def number_kinds(value: Any) -> Iterator[tuple[str, Any]]:
    yield from (
        ("text", "yes"),
        ("None", None),
        ("object", object()),
        ("dict", {"a": 1}),
    )
    # bool is an int: without this, True would be exchanged by numbers.
    if isinstance(value, bool | np.bool_):
        return
    if isinstance(value, int | np.integer):
        yield from (("numpy scalar", np.int64(value)), ("fraction", value + 0.5))
    else:
        yield from (("numpy scalar", np.float64(value)), ("0-d array", np.array(value)))
        yield from (("huge", 1e300), ("tiny", 1e-300))
    yield from (
        ("booleans", True),
        ("complex", value + 1j),
        ("dates", np.datetime64(3, "s")),
    )
    yield from (
        ("NaN", np.nan),
        ("infinite", np.inf),
        ("zero", 0),
        ("negative", -value),
    )
    yield from (
        ("axis more", [value, value]),
        ("masked", np.ma.masked_array(value, True)),
    )


def other_kinds(value: Any) -> Iterator[tuple[str, Any]]:
    yield from (("number", 3.5), ("object", object()))
    # A function is exchanged by a text, a text by another one.
    if callable(value) and not inspect.isclass(value):
        yield "text", "text"
    elif isinstance(value, str | os.PathLike):
        yield from (("None", None), ("another", "no such"), ("empty", ""))
    if isinstance(value, list | tuple) and value:
        yield from (
            ("empty", type(value)()),
            ("shorter", value[:-1]),
            ("dict", {"a": 1}),
        )
        yield from (
            ("longer", [*value, value[-1]]),
            ("with text", [*value[:-1], "text"]),
        )


def kinds(value: Any) -> Iterator[tuple[str, Any]]:
    """Yield replacements of a valid value, each with the name of its kind."""
    if value is None:
        yield from (("text", "no such"), ("object", object()))
    elif isinstance(value, bool | int | float | np.number | np.bool_):
        yield from number_kinds(value)
    elif isinstance(value, np.ndarray | list | tuple) and numeric(value):
        yield from array_kinds(value)
    else:
        yield from other_kinds(value)


# ---- the outcomes ------------------------------------------------------------------------------


PLAIN = (str, bytes, bool, int, float, complex, np.generic, np.ndarray)


def children(value: Any) -> Iterator[Any]:
    """Yield the entries of a container: a mapping, a sequence or a dataclass."""
    if isinstance(value, Mapping):
        yield from (value[key] for key in value)
    elif isinstance(value, list | tuple):
        yield from value
    elif is_dataclass(value) and not inspect.isclass(value):
        yield from (getattr(value, field.name, None) for field in fields(value))


def parts(
    value: Any, depth: int = 0, visited: frozenset[int] = frozenset()
) -> Iterator[Any]:
    """Yield the numbers, texts and arrays that a result holds, in order."""
    # Objects may refer to each other in a circle.
    if depth > 8 or id(value) in visited:
        return
    if value is None or isinstance(value, PLAIN):
        yield value
    elif hasattr(value, "data_vars"):  # an xarray.Dataset
        yield from (value[name].to_numpy() for name in value.variables)
    elif hasattr(value, "tocoo"):  # a sparse matrix
        yield value.toarray()
    elif isinstance(value, np.random.Generator):
        yield str(value.bit_generator.state)
    else:
        for child in children(value):
            yield from parts(child, depth + 1, visited | {id(value)})


def same(a: Any, b: Any) -> bool:
    """Return whether two results are equal, to rounding."""
    xs = list(parts(a))
    ys = list(parts(b))
    return len(xs) == len(ys) and all(equal(x, y) for x, y in zip(xs, ys, strict=True))


def equal(x: Any, y: Any) -> bool:
    """Return whether two arrays are equal, to rounding of the largest entry."""
    x = np.asarray(x)
    y = np.asarray(y)
    if x.shape != y.shape:
        return False
    if x.dtype.kind in "fc" and y.dtype.kind in "fciu":
        # Small entries of an array carry the rounding of the largest one.
        scale = np.nanmax(np.abs(x[np.isfinite(x)]), initial=1.0)
        return bool(np.allclose(x, y, rtol=1e-9, atol=1e-9 * scale, equal_nan=True))
    return bool((x == y).all()) if x.dtype.kind != "O" else True


def exact(a: Any, b: Any) -> bool:
    """Return whether two arguments are the same to the bit."""
    pairs = (
        (np.asarray(x), np.asarray(y)) for x, y in zip(parts(a), parts(b), strict=False)
    )
    return all(x.dtype.kind == "O" or x.tobytes() == y.tobytes() for x, y in pairs)


def nan_count(value: Any) -> int:
    """Count the NaN in all arrays of a result."""
    arrays = (np.asarray(v) for v in parts(value))
    return sum(int(np.isnan(a).sum()) for a in arrays if a.dtype.kind in "fc")


class TooLong(BaseException):
    """A call took more than its time; no `except Exception` of the library catches it."""


@contextmanager
def time_limit(seconds: int) -> Iterator[None]:
    """Raise `TooLong` after some seconds inside the context."""

    def stop(*_: Any) -> None:
        raise TooLong

    # An alarm interrupts loops of Python; no thread has to be ended.
    before = signal.signal(signal.SIGALRM, stop)
    signal.alarm(seconds)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


def names_argument(error: Exception, call: Call, argument: str, kind: str) -> bool:
    """Return whether an error names the argument.

    If only the value is unusual, the error may also name another argument, or a quantity that was
    computed from it.
    """
    text = str(error)
    names = {argument}
    if kind not in NEVER:
        # "the covariance of x: ..." names a quantity that was computed.
        computed = re.match(r"[\w .\[\]]+: ", text)
        if computed or isinstance(error, np.linalg.LinAlgError):
            return True
        names |= set(call.arguments)
    return any(re.search(rf"\b{re.escape(name)}\b", text) for name in names)


def classify_error(error: Exception, call: Call, argument: str, kind: str) -> str:
    """Return how good a rejection is: by a right class of error, and naming the argument."""
    if not isinstance(error, REFUSALS):
        return "raw"
    if kind in SAME:
        return "misread"
    return "rejected" if names_argument(error, call, argument, kind) else "unnamed"


def exchange(
    call: Call, where: tuple[str, str, str], value: Any, reference: Any
) -> Finding:
    """Run a call with one argument exchanged, and classify the outcome."""
    _, argument, kind = where
    # A copy from before the call shows whether the call changed its arguments.
    before = copy.deepcopy(call.arguments) | {argument: copy.deepcopy(value)}
    try:
        with time_limit(SECONDS), warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("ignore")
            result, after = call.run(**{argument: value})
    except TooLong:
        return Finding(*where, "too long")
    # A huge size is refused by the system.
    except MemoryError:
        return Finding(*where, "rejected", "memory")
    except Exception as error:
        outcome = classify_error(error, call, argument, kind)
        return Finding(*where, outcome, f"{type(error).__name__}: {error}"[:200])
    # A generator is meant to change.
    for name in set(before) - {"rng", "self", "cls"}:
        if not exact(before[name], after.get(name)):
            return Finding(*where, "changed", name)
    if kind in SAME:
        return Finding(*where, "same" if same(reference, result) else "different")
    if kind in NEVER:
        return Finding(*where, "accepted", type(result).__name__)
    # NaN that the valid call returns too is no fault.
    return Finding(
        *where, "NaN" if nan_count(result) > nan_count(reference) else "finite"
    )


def fuzz_calls(name: str, valid_calls: list[Call]) -> Iterator[Finding]:
    """Exchange every argument of a function's calls by every kind of value, once a type."""
    tried: set[tuple[str, str, type]] = set()
    for call in valid_calls:
        try:
            reference, _ = call.run()
        except Exception as error:
            yield Finding(name, "", "as recorded", "fails", f"{error!r}"[:200])
            continue
        for argument, valid in call.arguments.items():
            parameter = call.signature.parameters[argument]
            # Kinds 2 and 4 are *args and **kwargs.
            if argument in ("self", "cls") or parameter.kind in (2, 4):
                continue
            for kind, value in kinds(valid):
                # A second call with the same type of argument would repeat the
                # exchange.
                key = argument, kind, type(valid)
                is_default = value is None and parameter.default is None
                if key not in tried and not is_default:
                    tried.add(key)
                    yield exchange(call, (name, argument, kind), value, reference)


GOOD = {"rejected", "same", "finite"}
ALLOWED: dict[tuple[str, str, str], str] = {
    (
        r"network\.(average_consensus|pi_step)",
        "gain|dt",
        "huge: (NaN|too long)",
    ): "an iteration that diverges, with a warning before; as many substeps as are stable",
    (
        r".*",
        r"rounds|iterations|members|substeps",
        "huge: too long",
    ): "as many rounds as were asked for",
    (
        r"density\.DynamicAverage",
        "modes",
        "None: accepted",
    ): "None stands for all cells instead of coefficients",
    (
        r"models\.(Model\..*|rk4.*|RotatingMixture.*)",
        r".*",
        r".*: NaN",
    ): "a user's function that overflows",
    (
        r"sensors\.Sensor.*",
        r".*",
        r"(tiny|zero|NaN): NaN",
    ): "the direction to the sensor's own position, or a missing measurement",
    (r"sensors\.wrap|filters\.Observation", r".*", "NaN: NaN"): "a missing measurement",
    (
        r"kalman\.filterpy_\w+|models\.pendulum_chart",
        r".*",
        r"huge: (unnamed|NaN)",
    ): "an overflow, reported by another package, or the angle of a zero vector",
}
"""Patterns of (callable, argument, kind and outcome), and why that outcome is allowed."""


def judge(finding: Finding) -> str:
    """Return the outcome, or "allowed" if `ALLOWED` lists it."""
    names = (finding.name, finding.argument, f"{finding.kind}: {finding.result}")
    if finding.result not in GOOD:
        for patterns in ALLOWED:
            pairs = zip(patterns, names, strict=True)
            # All three patterns have to fit the finding.
            if all(re.fullmatch(pattern, name) for pattern, name in pairs):
                return "allowed"
    return finding.result


def run(chosen: list[str]) -> list[Finding]:
    """Return all findings of the chosen subpackages; files are written to a scratch folder."""
    folder = Path.cwd()
    findings: list[Finding] = []
    with tempfile.TemporaryDirectory(prefix="fuzz-") as scratch:
        # Functions that write files get paths such as "no such".
        os.chdir(scratch)
        try:
            for subpackage in chosen:
                for name, thing in public_names(subpackage).items():
                    for method, function in callables(thing).items():
                        findings += fuzz_calls(name + method, calls(thing, function))
        finally:
            os.chdir(folder)
    return findings


def main(arguments: list[str]) -> int:
    """Print the faults and the counts; return the number of faults."""
    started = time.perf_counter()
    findings = run(arguments or subpackages())
    faults = [f for f in findings if judge(f) not in {*GOOD, "allowed"}]
    for f in faults:
        print(f"{f.result:9} {f.name}({f.argument}): {f.kind}: {f.text}", flush=True)
    n_callables = len({f.name for f in findings})
    n_arguments = len({(f.name, f.argument) for f in findings})
    outcomes = dict(Counter(judge(f) for f in findings))
    seconds = time.perf_counter() - started
    print(f"{len(findings)} calls, {n_callables} callables, {n_arguments} arguments:")
    print(f"{outcomes}, {seconds:.0f} s")
    return len(faults)


if __name__ == "__main__":
    sys.exit(min(main(sys.argv[1:]), 1))
