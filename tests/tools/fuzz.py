"""Bad input for every argument of every public callable: refused by name, or right.

    python tests/tools/fuzz.py [--dry] [room …]

The valid calls are those of the doctests and of ``fuzz_calls_*.py`` beside this file: they run once
with every public function, class and method recorded, and their defaults filled in. Then each
argument of each recorded call is exchanged, one at a time, for values of other types, shapes and
sizes, the same ones each time. A value that means the same (a list, Fortran order, read-only
memory) has to give the same result. One that means nothing (dates, complex numbers, masked arrays,
text) has to be refused by an error that names the argument. Any other is refused by an error that
names an argument or what was computed from it, or gives a result without NaN. No call may change
its arguments. What is otherwise stands in ``ALLOWED`` with the reason.

Writes ``data/bench/fuzz.csv``, a line a room with the counts, unless ``--dry``.
"""

from __future__ import annotations

import copy
import csv
import doctest
import functools
import importlib
import inspect
import io
import os
import pkgutil
import re
import runpy
import signal
import sys
import tempfile
import time
import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, redirect_stderr, redirect_stdout, suppress
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from types import GeneratorType, ModuleType
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
TABLE = ROOT / "data" / "bench" / "fuzz.csv"
REFUSALS = (ValueError, RuntimeError, LookupError, ImportError, FileNotFoundError)
SECONDS = 10
MOST_CALLS = 4
"""Recorded calls of one callable, those with other arguments first."""


@dataclass
class Call:
    """A valid call: the callable's name, the callable, its arguments by name."""

    name: str
    function: Callable[..., Any]
    bound: inspect.BoundArguments

    def run(self, **exchanged: Any) -> tuple[Any, dict[str, Any]]:
        """The result, and the arguments as they are afterwards."""
        bound = copy.deepcopy(self.bound)
        bound.arguments.update(exchanged)
        out = self.function(*bound.args, **bound.kwargs)
        if isinstance(out, GeneratorType):
            out = [value for _, value in zip(range(50), out, strict=False)]
        return out, dict(bound.arguments)


@dataclass(frozen=True)
class Finding:
    """What became of one exchanged argument."""

    name: str
    argument: str
    kind: str
    result: str
    text: str = ""


# ---- the valid calls ---------------------------------------------------------------------------


def rooms() -> list[str]:
    """The library's rooms: its packages and its modules that lie beside them."""
    import distfilt

    return sorted(
        info.name for info in pkgutil.iter_modules(distfilt.__path__) if info.name[0] != "_"
    )


def public(room: str) -> dict[str, Any]:
    """Functions and classes of a room's face, and of the modules that it hands on, by name."""
    face = importlib.import_module(f"distfilt.{room}")
    out: dict[str, Any] = {}
    for name in getattr(face, "__all__", ()):
        thing = getattr(face, name)
        if isinstance(thing, ModuleType):
            out |= {f"{room}.{name}.{n}": getattr(thing, n) for n in thing.__all__}
        else:
            out[f"{room}.{name}"] = thing
    return {
        name: thing for name, thing in out.items()
        if str(getattr(thing, "__module__", "")).startswith("distfilt")
        and (inspect.isfunction(thing) or inspect.isclass(thing))
    }  # fmt: skip


def complete(bound: inspect.BoundArguments) -> inspect.BoundArguments:
    """The arguments with those that the call left at their defaults, but for made defaults."""
    for name, parameter in bound.signature.parameters.items():
        made = type(parameter.default).__module__ == "dataclasses"
        if parameter.default is not parameter.empty and not made:
            bound.arguments.setdefault(name, parameter.default)
    return bound


class Recorder:
    """Keeps a copy of the arguments of every call that an example makes itself."""

    def __init__(self) -> None:
        self.inside = 1
        self.calls: dict[str, list[Call]] = {}
        self.replaced: dict[int, Any] = {}

    def wrapped(self, name: str, function: Any, target: Callable[..., Any] | None = None) -> Any:
        """The function, recorded; a constructor is called by its class, the `target`."""

        @functools.wraps(function)
        def inner(*args: Any, **options: Any) -> Any:
            if self.inside:
                return function(*args, **options)
            self.inside += 1
            try:
                with suppress(Exception):
                    given = args[1:] if target is not None else args
                    kept = copy.deepcopy((given, options))
                out = function(*args, **options)
                with suppress(Exception):
                    called = target or inner
                    bound = complete(inspect.signature(called).bind(*kept[0], **kept[1]))
                    self.calls.setdefault(name, []).append(Call(name, called, bound))
                return out
            finally:
                self.inside -= 1

        return inner

    def patch(self, room: str) -> None:
        """Put the recorded twins in the place of a room's functions and methods."""
        for name, thing in public(room).items():
            if inspect.isfunction(thing):
                self.replaced[id(thing)] = (thing, self.wrapped(name, thing))
            elif not issubclass(thing, BaseException):
                self.patch_class(name, thing)

    def patch_class(self, name: str, kind: Any) -> None:
        for method, found in list(vars(kind).items()):
            kept = type(found) if isinstance(found, classmethod | staticmethod) else None
            function = found.__func__ if kept else found
            if method == "__init__":
                twin = self.wrapped(name, function, kind)
            elif inspect.isfunction(function) and (method[0] != "_" or method == "__call__"):
                twin = self.wrapped(f"{name}.{method}", function)
            else:
                continue
            with suppress(AttributeError, TypeError):
                setattr(kind, method, kept(twin) if kept else twin)

    def replace(self) -> None:
        """In every module that has one of the functions by name."""
        for module in [m for n, m in sys.modules.items() if n.startswith("distfilt")]:
            for name, thing in list(vars(module).items()):
                found = self.replaced.get(id(thing))
                if found is not None and found[0] is thing:
                    setattr(module, name, found[1])


def recorded(chosen: list[str]) -> dict[str, list[Call]]:
    """The calls of all examples, of callables of the chosen rooms."""
    import distfilt

    names = [i.name for i in pkgutil.walk_packages(distfilt.__path__, "distfilt.")]
    modules = [importlib.import_module(name) for name in names]
    recorder = Recorder()
    # All rooms, whatever is chosen: else the calls that one makes of another count as examples'.
    for room in rooms():
        recorder.patch(room)
    recorder.replace()
    runner = doctest.DocTestRunner(verbose=False, optionflags=doctest.ELLIPSIS)
    finder = doctest.DocTestFinder(exclude_empty=True)
    for module in modules:
        for test in finder.find(module, globs=dict(vars(module))):
            if test.examples:
                recorder.inside = 0
                with redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()):
                    # With their globals: functions that an example defines are called again.
                    runner.run(test, out=lambda _: None, clear_globs=False)
                recorder.inside = 1
    recorder.inside = 0
    with quiet():
        for extra in sorted(Path(__file__).parent.glob("fuzz_calls_*.py")):
            runpy.run_path(str(extra))  # valid calls that no doctest makes
    recorder.inside = 1
    return {
        name: varied(calls) for name, calls in sorted(recorder.calls.items())
        if name.partition(".")[0] in chosen
    }  # fmt: skip


def varied(calls: list[Call]) -> list[Call]:
    """Few calls with all the arguments that occur."""
    out: list[Call] = []
    seen: set[tuple[str, str, bool]] = set()
    for call in calls:
        given = call.bound.arguments.items()
        new = {(n, type(v).__name__, isinstance(v, list | tuple | str) and not v) for n, v in given}
        if new - seen and len(out) < MOST_CALLS:
            out.append(call)
            seen |= new
    return out


# ---- what is exchanged -------------------------------------------------------------------------

SAME = {"list", "fortran", "read-only", "strided", "numpy scalar", "same integer", "0-d array"}
"""Kinds that mean the same as the valid value."""
NEVER = {
    "complex", "dates", "durations", "masked", "text", "booleans", "with None", "None", "object",
    "number", "dict",
}  # fmt: skip
"""Kinds that mean nothing, and are refused everywhere."""


def numeric(value: Any) -> bool:
    """Whether a list or array is one of real numbers."""
    with suppress(Exception):
        return np.asarray(value).dtype.kind in "fiu" and np.asarray(value).size > 0
    return False


def array_kinds(value: Any) -> Iterator[tuple[str, Any]]:
    with np.errstate(all="ignore"):
        for kind, exchanged in exchanged_arrays(np.array(value), np.array(value, dtype=float)):
            yield kind, exchanged if isinstance(exchanged, list) else copied(exchanged)


def copied(value: Any) -> Any:
    """A value of its own, laid out as it was, so that no call can change the next one's."""
    if type(value) is not np.ndarray or not value.flags.writeable or value.base is None:
        return value
    return value if not value.flags.c_contiguous else value.copy()


def exchanged_arrays(a: Any, f: Any) -> Iterator[tuple[str, Any]]:
    if a.dtype.kind == "f":
        frozen = a.copy()
        frozen.flags.writeable = False
        wide = np.repeat(a, 2, axis=-1)[..., ::2] if a.ndim else a
        yield from (("list", a.tolist()), ("fortran", np.asfortranarray(a)))
        yield from (("read-only", frozen), ("strided", wide))
    yield from (("complex", f + 1j), ("dates", np.zeros(a.shape, "datetime64[s]")))
    yield from (("durations", np.ones(a.shape, "timedelta64[s]")), ("text", a.astype(str)))
    yield "masked", np.ma.masked_array(f.copy(), np.arange(f.size).reshape(f.shape) == 0)
    yield from (("booleans", np.ones(a.shape, bool)), ("dict", {"a": 1.0}), ("object", object()))
    nothing = a.astype(object)
    nothing.flat[0] = None
    yield "with None", nothing
    for name, bad in (("NaN", np.nan), ("infinite", np.inf), ("minus infinite", -np.inf)):
        one = f.copy()
        one.flat[-1] = bad
        yield name, one
    yield from (("all NaN", np.full(f.shape, np.nan)), ("huge", f * 1e300), ("tiny", f * 1e-300))
    yield from (("negative", -f), ("zero", 0.0 * f), ("empty", np.zeros((0, *f.shape[1:]))))
    yield from (("empty last", np.zeros((*f.shape[:-1], 0))), ("scalar", f.flat[0]))
    yield from (("axis more", f[..., None]), ("axis before", f[None]), ("flat", f.ravel()))
    if f.ndim:
        yield from (("shorter", f[:-1]), ("shorter last", f[..., :-1]), ("turned", f.T))
        yield from (("longer", np.concatenate([f, f[-1:]])), ("ragged", [[1.0, 2.0], [1.0]]))


def number_kinds(value: Any) -> Iterator[tuple[str, Any]]:
    if isinstance(value, bool | np.bool_):
        yield from (("text", "yes"), ("None", None), ("number", 2.5), ("dict", {}))
        yield "object", object()
        return
    if isinstance(value, int | np.integer):
        yield from (("numpy scalar", np.int64(value)), ("huge", 10**13), ("fraction", value + 0.5))
    else:
        yield from (("numpy scalar", np.float64(value)), ("0-d array", np.array(value)))
        yield from (("huge", 1e300), ("tiny", 1e-300))
        if float(value).is_integer():
            yield "same integer", int(value)
    yield from (("text", str(value)), ("booleans", True), ("None", None), ("complex", value + 1j))
    yield from (("NaN", np.nan), ("infinite", np.inf), ("minus infinite", -np.inf), ("zero", 0))
    yield from (("negative", -value), ("axis more", [value, value]))
    yield "dates", np.datetime64(3, "s")
    yield from (("durations", np.timedelta64(1, "s")), ("object", object()), ("dict", {"a": 1}))
    yield "masked", np.ma.masked_array(value, True)


def other_kinds(value: Any) -> Iterator[tuple[str, Any]]:
    if callable(value) and not inspect.isclass(value):
        yield from (("number", 3), ("text", "text"), ("object", object()), ("dict", {}))
        yield "returns None", lambda *_, **__: None
        yield "returns text", lambda *_, **__: "text"
        yield "returns shape", lambda *_, **__: np.zeros((7, 5, 3))
        yield "returns NaN", lambda *_, **__: np.full(np.shape(value(*_, **__)), np.nan)
        yield "returns complex", lambda *_, **__: np.asarray(value(*_, **__)) + 1j
    elif isinstance(value, str | os.PathLike):
        yield from (("number", 3.5), ("None", None), ("object", object()), ("another", "no such"))
        yield from (("bytes", b"no such"), ("empty", ""))
    else:
        yield from (("number", 3.5), ("text", "text"), ("object", object()))
        yield "NaN", np.nan
    if isinstance(value, list | tuple) and value:
        yield from (("empty", type(value)()), ("shorter", value[:-1]), ("dict", {"a": 1}))
        yield from (("longer", [*value, value[-1]]), ("with None", [None, *value[1:]]))
        yield "with text", [*value[:-1], "text"]
        yield "with number", [*value[:-1], 7.5]


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


def parts(value: Any, depth: int = 0, seen: frozenset[int] = frozenset()) -> Iterator[Any]:
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
    elif hasattr(value, "to_dict") and hasattr(value, "data_vars"):
        for name in value.variables:
            yield value[name].to_numpy()
    elif hasattr(value, "tocoo"):
        yield value.toarray()
    elif isinstance(value, np.random.Generator):
        yield str(value.bit_generator.state)
    elif is_dataclass(value) and not inspect.isclass(value):
        for field in fields(value):
            if field.name != "seconds":  # of a study: it takes another time each time
                yield from parts(getattr(value, field.name, None), depth + 1, seen)


def same(a: Any, b: Any) -> bool:
    """Whether two results are equal, to rounding."""
    xs, ys = list(parts(a)), list(parts(b))
    return len(xs) == len(ys) and all(equal(x, y) for x, y in zip(xs, ys, strict=True))


def equal(x: Any, y: Any) -> bool:
    x, y = np.asarray(x), np.asarray(y)
    if x.shape != y.shape:
        return False
    if x.dtype.kind in "fc" and y.dtype.kind in "fciu":
        scale = np.nanmax(np.abs(x[np.isfinite(x)]), initial=1.0)
        return bool(np.allclose(x, y, rtol=1e-9, atol=1e-9 * scale, equal_nan=True))
    return bool((x == y).all()) if x.dtype.kind != "O" else True


def exact(a: Any, b: Any) -> bool:
    """Whether two arguments are the same to the bit."""
    for x, y in zip(parts(a), parts(b), strict=False):
        if np.asarray(x).dtype.kind == "O":
            continue
        if np.asarray(x).tobytes() != np.asarray(y).tobytes():
            return False
    return True


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


@contextmanager
def quiet() -> Iterator[None]:
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore")
        with redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()):
            yield


def refused(error: Exception, call: Call, argument: str, kind: str) -> bool:
    """Whether an error names the argument, or for a mere value, what was computed from it."""
    text = str(error)
    names = {argument, *(str(v) for n, v in call.bound.arguments.items() if n == "name")}
    if kind not in NEVER:
        names |= set(call.bound.signature.parameters)
        if re.match(r"[\w .\[\]]+: ", text) or isinstance(error, np.linalg.LinAlgError):
            return True
    return any(re.search(rf"\b{re.escape(name)}\b", text) for name in names)


def tried(call: Call, argument: str, kind: str, value: Any, reference: Any) -> Finding:
    """What the call makes of the exchanged argument."""
    before = copy.deepcopy(dict(call.bound.arguments)) | {argument: copy.deepcopy(value)}
    try:
        with limited(SECONDS), quiet():
            out, after = call.run(**{argument: value})
    except TooLong:
        return Finding(call.name, argument, kind, "too long")
    except MemoryError:
        return Finding(call.name, argument, kind, "refused", "memory")
    except REFUSALS as error:
        result = "refused" if refused(error, call, argument, kind) else "unnamed"
        result = "misread" if kind in SAME else result
        return Finding(call.name, argument, kind, result, f"{type(error).__name__}: {error}"[:200])
    except Exception as error:
        return Finding(call.name, argument, kind, "raw", f"{type(error).__name__}: {error}"[:200])
    for name in set(before) - {"rng", "self"}:
        if not exact(before[name], after.get(name)):
            return Finding(call.name, argument, kind, "changed", name)
    if kind in SAME:
        return Finding(call.name, argument, kind, "same" if same(reference, out) else "different")
    if kind in NEVER:
        return Finding(call.name, argument, kind, "taken", type(out).__name__)
    result = "NaN" if nans(out) > nans(reference) else "finite"
    return Finding(call.name, argument, kind, result)


def findings(calls: dict[str, list[Call]]) -> Iterator[Finding]:
    """Every exchange of every argument of every call."""
    done: set[tuple[str, str, str, str]] = set()
    for name, several in calls.items():
        for call in several:
            try:
                with limited(SECONDS), quiet():
                    reference, _ = call.run()
            except (Exception, TooLong) as error:
                yield Finding(name, "", "as recorded", "fails", f"{error!r}"[:200])
                continue
            for argument, valid in call.bound.arguments.items():
                parameter = call.bound.signature.parameters[argument]
                if argument in ("self", "cls", "name") or parameter.kind in (2, 4):
                    continue
                for kind, value in kinds(valid):
                    if value is None and parameter.default is None:
                        continue
                    key = (name, argument, kind, type(valid).__name__)
                    if key not in done:
                        done.add(key)
                        yield tried(call, argument, kind, value, reference)


GOOD = {"refused", "same", "finite"}
RECORDS = (
    r"filters\.Summary|network\.(Ledger|PIState|AdmmRun)"
)
ALLOWED: dict[tuple[str, str, str], str] = {
    (r"checks\..*", r".*", r".*"): "the words of the check itself, which the library writes",
    (rf"({RECORDS})(\.\w+)?|filters\.\w*State",
     r".*", r".*"):
        "made by the library, looked at by who takes it",
    (r"models\.Swarm\..*_at|updates\.with_missing", r".*", r".*"):
        "called in every step by the filter that has checked its arguments",
    (r"coupling\.Plan|kalman\.GaussianRun", r".*", r".*"):
        "a result; rts_smoother, which takes a run, looks at it",
    (r"density\.DynamicAverage|triangular\.pool_by_admm|network\.admm", r"modes|check",
     "None: taken"):
        "means what its docstring says: all cells, no check",
    (r"density\.PIConsensus\.learn", "dt", "huge: too long"): "as many substeps as are stable",
    (r"filters\.\w+Filter\.step", "observations", "with None: taken"): "an agent without reading",
    (r"progress\.track", "items", r".*"): "hands on, unlooked at, whatever can be iterated over",
    (r"filters\.\w+Filter(\.exact)?", "sensors", "with None: taken"): "an agent without a sensor",
    (r".*", r".*", r"returns (NaN|complex|shape|text|None): (NaN|unnamed|raw|finite)"):
        "what a user's function returns is looked at where states are made, not in each door",
    (r"models\.(Model\..*|rk4.*|RotatingMixture.*)|differences\.central|kalman\.\w+_predict",
     r".*", r".*: NaN"):
        "a user's function that overflows",
    (r"sensors\.Sensor\.predict", "x", r"(tiny|zero): NaN"): "a direction to where the sensor is",
    (r"network\.pi_step", "dt", "huge: too long"): "as many substeps as are stable",
    (r"sensors\.Sensor.*|coupling\.augmented_readings|filters\.(Late|\w+\.gather|\w+\.series)",
     r".*", r"(all )?NaN: NaN"):
        "a reading that is missing",
    (r"network\.average", "gain", "huge: NaN"): "an iteration that diverges, with a warning before",
    (r".*", r"rounds|iterations|members|substeps", "huge: too long"):
        "as many rounds as were asked for",
    (r"kalman\.filterpy_\w+|coupling\..*|network\..*|triangular\..*|updates\..*", r".*",
     r"(huge|empty last|shorter last|ragged): unnamed"):
        "states without components, or an overflow, refused in another package's words",
    (r"filters\.(Step\.(?!heard)\w+|SensorState\.shown)", r".*", r".*"):
        "called in every step by a family of filters, which made the arguments",
    (r"filters\.(Filter\.series|SensorFilter\.observed|\w+Filter\.step)", "observations",
     "with None: taken"):
        "looked at by the step that takes it, or nothing observed",
    (r"sensors\.Sensor\.matrix", "dim", "huge: unnamed"): "numpy refuses such a size itself",
    (r"network\.Channel\.\w+", "payloads", "with None: taken"): "an agent that is silent",
}
"""(callable, argument, kind and result) as patterns to the reason why it may be so."""


def allowed(found: Finding) -> str:
    """The reason why a finding is no fault, or nothing."""
    for patterns, reason in ALLOWED.items():
        names = (found.name, found.argument, f"{found.kind}: {found.result}")
        if all(re.fullmatch(p, n) for p, n in zip(patterns, names, strict=True)):
            return reason
    return ""


def judged(found: Finding) -> str:
    return "allowed" if found.result not in GOOD and allowed(found) else found.result


def run(chosen: list[str]) -> list[Finding]:
    """All findings of the chosen rooms, in a folder of its own."""
    here = Path.cwd()
    with tempfile.TemporaryDirectory(prefix="fuzz-") as scratch:
        os.chdir(scratch)
        try:
            return list(findings(recorded(chosen)))
        finally:
            os.chdir(here)


def main(arguments: list[str] | None = None) -> int:
    given = list(arguments if arguments is not None else sys.argv[1:])
    chosen = [a for a in given if a != "--dry"] or rooms()
    began = time.perf_counter()
    found = run(chosen)
    faults = [f for f in found if judged(f) not in {*GOOD, "allowed"}]
    for f in faults:
        print(f"{f.result:9} {f.name}({f.argument}): {f.kind}: {f.text}", flush=True)
    counts = Counter(judged(f) for f in found)
    callables, named = len({f.name for f in found}), len({(f.name, f.argument) for f in found})
    print(f"{len(found)} calls, {callables} callables, {named} arguments: {dict(counts)}, "
          f"{time.perf_counter() - began:.0f} s")  # fmt: skip
    if "--dry" not in given and set(chosen) == set(rooms()):
        write(found)
    return len(faults)


def write(found: list[Finding]) -> None:
    """The counts, a line a room and result."""
    results = sorted({*GOOD, *(judged(f) for f in found)} - {"allowed"})
    with TABLE.open("w", encoding="utf-8", newline="") as lines:
        writer = csv.writer(lines, lineterminator="\n")
        writer.writerow(["room", "callables", "arguments", "calls", *results, "allowed"])
        for room in rooms():
            mine = [f for f in found if f.name.partition(".")[0] == room]
            names = len({f.name for f in mine}), len({(f.name, f.argument) for f in mine})
            counts = Counter(judged(f) for f in mine)
            row = [*(counts[r] for r in results), counts["allowed"]]
            writer.writerow([room, *names, len(mine), *row])


if __name__ == "__main__":
    sys.exit(min(main(), 1))
