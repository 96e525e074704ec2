"""Valid calls of everything that has a door, as the examples of the documentation make them."""

from __future__ import annotations

import copy
import doctest
import importlib
import inspect
import io
import pkgutil
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout, suppress
from dataclasses import dataclass, field, fields, is_dataclass
from types import ModuleType
from typing import Any

import distfilt
from distfilt.validation import FrozenModel, decorators

MOST = 4
"""Recorded calls of one function."""


def describe(thing: Any) -> dict[str, Any]:
    """The kinds that a function with a door, or a class of records, declares by name."""
    if inspect.isclass(thing):
        return decorators._of_fields(thing) if issubclass(thing, FrozenModel) else {}
    return dict(thing.plan.kinds) if hasattr(thing, "plan") else {}


@dataclass
class Call:
    """A valid call: what is called, and its arguments by name, defaults included."""

    function: Callable[..., Any]
    signature: inspect.Signature
    given: dict[str, Any]

    def run(self, **exchanged: Any) -> tuple[Any, dict[str, Any]]:
        """The result, and the arguments as they are afterwards."""
        bound = self.signature.bind_partial()
        bound.arguments.update(copy.deepcopy(self.given))
        bound.arguments.update(exchanged)
        return self.function(*bound.args, **bound.kwargs), dict(bound.arguments)


@dataclass
class Recorder:
    """The first few arguments that came to each door."""

    calls: dict[Any, list[tuple[Any, Any]]] = field(default_factory=dict)

    def keep(self, key: Any, args: Any, options: Any) -> None:
        """Copies, since a call may own what it gets."""
        known = self.calls.setdefault(key, [])
        if len(known) < MOST:
            with suppress(Exception):
                known.append(copy.deepcopy((args, options)))

    @contextmanager
    def listening(self) -> Iterator[None]:
        """While it lasts, what passes a door is kept."""
        taken = decorators._Plan.validate
        made = FrozenModel.__post_init__

        def at_door(plan: Any, args: Any, options: Any) -> Any:
            out = taken(plan, args, options)
            with suppress(TypeError):  # the options of a partial come alone
                inspect.signature(plan.function).bind(*args, **options)
                self.keep(plan.function, args, options)
            return out

        def at_record(record: Any) -> None:
            given = {f.name: getattr(record, f.name) for f in fields(record)}
            made(record)
            self.keep(type(record), (), given)

        decorators._Plan.validate = at_door
        FrozenModel.__post_init__ = at_record
        try:
            with redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()):
                yield
        finally:
            decorators._Plan.validate = taken
            FrozenModel.__post_init__ = made


RECORDER = Recorder()
_RUN: set[str] = set()


def rooms() -> list[str]:
    """The rooms that the library shows; validation are tested by their kinds."""
    return sorted(set(distfilt.__all__) - {"__version__", "validation"})


def public(room: str) -> dict[str, Any]:
    """What a room's face shows, and what the modules do that it hands on, by name."""
    face = importlib.import_module(f"distfilt.{room}")
    out: dict[str, Any] = {}
    for name in getattr(face, "__all__", ()):
        thing = getattr(face, name)
        if isinstance(thing, ModuleType):
            out |= {f"{room}.{name}.{n}": getattr(thing, n) for n in thing.__all__}
        else:
            out[f"{room}.{name}"] = thing
    return out


def callables(thing: Any) -> dict[str, Callable[..., Any]]:
    """A function, or a class's constructor and public methods, if they declare what they take."""
    if not inspect.isclass(thing):
        return {"": thing} if describe(thing) else {}
    out: dict[str, Callable[..., Any]] = {"": thing} if describe(thing) else {}
    for base in reversed(thing.__mro__):
        for name, found in vars(base).items():
            function = getattr(found, "__func__", found)
            if not name.startswith("_") and describe(function):
                out[f".{name}"] = function
    return out


def _examples(module: ModuleType) -> None:
    if module.__name__ in _RUN:
        return
    _RUN.add(module.__name__)
    runner = doctest.DocTestRunner(verbose=False, optionflags=doctest.ELLIPSIS)
    finder = doctest.DocTestFinder(exclude_empty=True)
    with RECORDER.listening():
        for test in finder.find(module, globs=dict(vars(module))):
            # With their globals: functions that an example defines are called again.
            runner.run(test, out=lambda _: None, clear_globs=False)


def _modules(thing: Any) -> Iterator[ModuleType]:
    """Where a valid call may be found: its own module, its room, the whole library."""
    home = sys.modules[thing.__module__]
    yield home
    near = home.__name__.split(".")[1]
    names = [
        info.name for info in pkgutil.walk_packages(distfilt.__path__, "distfilt.")
    ]
    for name in sorted(names, key=lambda n: (n.split(".")[1] != near, n)):
        yield importlib.import_module(name)


def calls(thing: Any, function: Callable[..., Any]) -> list[Call]:
    """Recorded calls of a function, a constructor or a method of the public `thing`."""
    key = function if inspect.isclass(function) else function.plan.function  # type: ignore[attr-defined]
    for module in _modules(thing):
        _examples(module)
        if RECORDER.calls.get(key):
            break
    return [_call(function, *found) for found in RECORDER.calls.get(key, [])]


def _call(function: Any, args: Any, options: Any) -> Call:
    signature = inspect.signature(function)
    if inspect.isclass(function) and is_dataclass(function):
        made = {f.name for f in fields(function) if f.init}
        return Call(
            function, signature, {n: v for n, v in options.items() if n in made}
        )
    bound = signature.bind(*args, **options)
    bound.apply_defaults()
    return Call(function, signature, dict(bound.arguments))
