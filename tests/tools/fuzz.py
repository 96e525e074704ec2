"""Unusual input for every argument of everything that has a door: right, or refused by name.

    python -m tests.tools.fuzz [room …]

Each argument of a valid call, which an example of the documentation makes, is exchanged for other
values, the same ones each time. One that means the same (a list, Fortran order, read-only memory)
has to give the same result. One that means nothing (dates, complex numbers, masked arrays, text)
has to be refused by an error that names the argument. Any other is refused by an error that names
an argument, or gives a result without NaN. No call may change its arguments. What is otherwise
stands in ``ALLOWED`` with the reason.
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

from tests.tools.calls import Call, callables, calls, public, rooms

ROOT = Path(__file__).resolve().parents[2]
REFUSALS = (ValueError, RuntimeError, LookupError, ImportError, FileNotFoundError)
SECONDS = 10


@dataclass(frozen=True)
class Finding:
    """What became of one exchanged argument."""

    name: str
    argument: str
    kind: str
    result: str
    text: str = ""


# ---- what is exchanged -------------------------------------------------------------------------

SAME = {"list", "fortran", "read-only", "strided", "numpy scalar", "0-d array"}
"""Kinds that mean the same as the valid value."""
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
"""Kinds that mean nothing, and are refused everywhere."""


def numeric(value: Any) -> bool:
    """Whether a list or array is one of real numbers."""
    with suppress(Exception):
        return np.asarray(value).dtype.kind in "fiu" and np.asarray(value).size > 0
    return False


def array_kinds(value: Any) -> Iterator[tuple[str, Any]]:
    a = np.array(value)
    f = np.array(value, dtype=float)
    with np.errstate(all="ignore"):
        if a.dtype.kind == "f":
            frozen = a.copy()
            frozen.flags.writeable = False
            wide = np.repeat(a, 2, axis=-1)[..., ::2] if a.ndim else a
            yield from (("list", a.tolist()), ("fortran", np.asfortranarray(a)))
            yield from (("read-only", frozen), ("strided", wide))
        masked = np.ma.masked_array(f.copy(), np.arange(f.size).reshape(f.shape) == 0)
        yield from (("complex", f + 1j), ("dates", np.zeros(a.shape, "datetime64[s]")))
        yield from (("text", a.astype(str)), ("masked", masked), ("dict", {"a": 1.0}))
        yield from (("booleans", np.ones(a.shape, bool)), ("object", object()))
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
    """What to put in the place of a valid value: the kind and the value."""
    if value is None:
        yield from (("text", "no such"), ("object", object()))
    elif isinstance(value, bool | int | float | np.number | np.bool_):
        yield from number_kinds(value)
    elif isinstance(value, np.ndarray | list | tuple) and numeric(value):
        yield from array_kinds(value)
    else:
        yield from other_kinds(value)


# ---- what comes of it --------------------------------------------------------------------------


PLAIN = (str, bytes, bool, int, float, complex, np.generic, np.ndarray)


def parts(
    value: Any, depth: int = 0, seen: frozenset[int] = frozenset()
) -> Iterator[Any]:
    """The numbers, texts and arrays that a result holds, in order."""
    if depth > 8 or id(value) in seen:
        return
    seen |= {id(value)}
    if value is None or isinstance(value, PLAIN):
        yield value
    elif isinstance(value, Mapping):
        for key in value:
            yield from parts(value[key], depth + 1, seen)
    elif isinstance(value, list | tuple):
        for v in value:
            yield from parts(v, depth + 1, seen)
    elif hasattr(value, "data_vars"):
        yield from (value[name].to_numpy() for name in value.variables)
    elif hasattr(value, "tocoo"):
        yield value.toarray()
    elif isinstance(value, np.random.Generator):
        yield str(value.bit_generator.state)
    elif is_dataclass(value) and not inspect.isclass(value):
        for field in fields(value):
            yield from parts(getattr(value, field.name, None), depth + 1, seen)


def same(a: Any, b: Any) -> bool:
    """Whether two results are equal, to rounding."""
    xs = list(parts(a))
    ys = list(parts(b))
    return len(xs) == len(ys) and all(equal(x, y) for x, y in zip(xs, ys, strict=True))


def equal(x: Any, y: Any) -> bool:
    x = np.asarray(x)
    y = np.asarray(y)
    if x.shape != y.shape:
        return False
    if x.dtype.kind in "fc" and y.dtype.kind in "fciu":
        scale = np.nanmax(np.abs(x[np.isfinite(x)]), initial=1.0)
        return bool(np.allclose(x, y, rtol=1e-9, atol=1e-9 * scale, equal_nan=True))
    return bool((x == y).all()) if x.dtype.kind != "O" else True


def exact(a: Any, b: Any) -> bool:
    """Whether two arguments are the same to the bit."""
    pairs = (
        (np.asarray(x), np.asarray(y)) for x, y in zip(parts(a), parts(b), strict=False)
    )
    return all(x.dtype.kind == "O" or x.tobytes() == y.tobytes() for x, y in pairs)


def nans(value: Any) -> int:
    arrays = (np.asarray(v) for v in parts(value))
    return sum(int(np.isnan(a).sum()) for a in arrays if a.dtype.kind in "fc")


class TooLong(BaseException):
    pass


@contextmanager
def limited(seconds: int) -> Iterator[None]:
    def stop(*_: Any) -> None:
        raise TooLong

    before = signal.signal(signal.SIGALRM, stop)
    signal.alarm(seconds)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


def refused(error: Exception, call: Call, argument: str, kind: str) -> bool:
    """Whether an error names the argument, or for a mere value, what was computed from it."""
    text = str(error)
    if kind not in NEVER and (
        re.match(r"[\w .\[\]]+: ", text) or isinstance(error, np.linalg.LinAlgError)
    ):
        return True
    names = {argument} if kind in NEVER else {argument, *call.given}
    return any(re.search(rf"\b{re.escape(name)}\b", text) for name in names)


def tried(
    call: Call, where: tuple[str, str, str], value: Any, reference: Any
) -> Finding:
    """What the call makes of the exchanged argument."""
    _, argument, kind = where
    before = copy.deepcopy(call.given) | {argument: copy.deepcopy(value)}
    try:
        with limited(SECONDS), warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("ignore")
            out, after = call.run(**{argument: value})
    except TooLong:
        return Finding(*where, "too long")
    except MemoryError:
        return Finding(*where, "rejected", "memory")
    except Exception as error:
        result = "rejected" if refused(error, call, argument, kind) else "unnamed"
        result = "misread" if kind in SAME else result
        result = result if isinstance(error, REFUSALS) else "raw"
        return Finding(*where, result, f"{type(error).__name__}: {error}"[:200])
    for name in set(before) - {"rng", "self", "cls"}:
        if not exact(before[name], after.get(name)):
            return Finding(*where, "changed", name)
    if kind in SAME:
        return Finding(*where, "same" if same(reference, out) else "different")
    if kind in NEVER:
        return Finding(*where, "taken", type(out).__name__)
    return Finding(*where, "NaN" if nans(out) > nans(reference) else "finite")


def of(name: str, several: list[Call]) -> Iterator[Finding]:
    """Every exchange of every argument of a function's calls."""
    done: set[tuple[str, str, type]] = set()
    for call in several:
        try:
            reference, _ = call.run()
        except Exception as error:
            yield Finding(name, "", "as recorded", "fails", f"{error!r}"[:200])
            continue
        for argument, valid in call.given.items():
            parameter = call.signature.parameters[argument]
            if argument in ("self", "cls") or parameter.kind in (2, 4):
                continue
            for kind, value in kinds(valid):
                key = argument, kind, type(valid)
                if key not in done and not (
                    value is None and parameter.default is None
                ):
                    done.add(key)
                    yield tried(call, (name, argument, kind), value, reference)


GOOD = {"rejected", "same", "finite"}
ALLOWED: dict[tuple[str, str, str], str] = {
    (
        r"network\.(average|pi_step)",
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
        "None: taken",
    ): "all cells in place of coefficients",
    (
        r"models\.(Model\..*|rk4.*|RotatingMixture.*)",
        r".*",
        r".*: NaN",
    ): "a user's function that overflows",
    (
        r"sensors\.Sensor.*",
        r".*",
        r"(tiny|zero|NaN): NaN",
    ): "a direction to where the sensor is, or a reading that is missing",
    (r"sensors\.wrap|filters\.Reading", r".*", "NaN: NaN"): "a reading that is missing",
    (
        r"kalman\.filterpy_\w+|models\.pendulum_chart",
        r".*",
        r"huge: (unnamed|NaN)",
    ): "an overflow, in another package's words or an angle of nothing",
}
"""(callable, argument, kind and result) as patterns to the reason why it may be so."""


def judged(found: Finding) -> str:
    """The result, or that it is allowed."""
    names = (found.name, found.argument, f"{found.kind}: {found.result}")
    if found.result not in GOOD:
        for patterns in ALLOWED:
            if all(re.fullmatch(p, n) for p, n in zip(patterns, names, strict=True)):
                return "allowed"
    return found.result


def run(chosen: list[str]) -> list[Finding]:
    """All findings of the chosen rooms, in a folder of its own."""
    here = Path.cwd()
    out = []
    with tempfile.TemporaryDirectory(prefix="fuzz-") as scratch:
        os.chdir(scratch)
        try:
            for room in chosen:
                for name, thing in public(room).items():
                    for method, function in callables(thing).items():
                        out += of(name + method, calls(thing, function))
        finally:
            os.chdir(here)
    return out


def main(arguments: list[str]) -> int:
    """Print the faults and the counts; how many faults there are."""
    began = time.perf_counter()
    found = run(arguments or rooms())
    faults = [f for f in found if judged(f) not in {*GOOD, "allowed"}]
    for f in faults:
        print(f"{f.result:9} {f.name}({f.argument}): {f.kind}: {f.text}", flush=True)
    named = len({f.name for f in found}), len({(f.name, f.argument) for f in found})
    print(
        f"{len(found)} calls, {named[0]} callables, {named[1]} arguments: "
        f"{dict(Counter(map(judged, found)))}, {time.perf_counter() - began:.0f} s"
    )
    return len(faults)


if __name__ == "__main__":
    sys.exit(min(main(sys.argv[1:]), 1))
