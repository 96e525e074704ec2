"""Valid calls of every validated callable, recorded while the docstrings' examples run."""

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

MAX_CALLS = 4
"""Calls that are recorded of one function."""


def describe(thing: Any) -> dict[str, Any]:
    """Return the kinds that a validated function or a frozen model declares, by argument."""
    if inspect.isclass(thing):
        if not issubclass(thing, FrozenModel):
            return {}
        # A constructor of its own may take some of the fields only.
        parameters = inspect.signature(thing).parameters
        constraints = decorators.field_constraints(thing)
        return {name: kind for name, kind in constraints.items() if name in parameters}
    return (
        dict(thing.signature_constraints.constraints)
        if hasattr(thing, "signature_constraints")
        else {}
    )


@dataclass
class Call:
    """A valid call: a callable and its arguments by name, defaults included."""

    function: Callable[..., Any]
    signature: inspect.Signature
    arguments: dict[str, Any]

    def run(self, **exchanged: Any) -> tuple[Any, dict[str, Any]]:
        """Call with some arguments exchanged; return the result and the arguments after it."""
        bound = self.signature.bind_partial()
        bound.arguments.update(copy.deepcopy(self.arguments))
        bound.arguments.update(exchanged)
        return self.function(*bound.args, **bound.kwargs), dict(bound.arguments)


@dataclass
class Recorder:
    """The arguments of the first few calls of each validated callable."""

    calls: dict[Any, list[tuple[Any, Any]]] = field(default_factory=dict)

    def record(self, key: Any, args: Any, options: Any) -> None:
        """Store a copy of the arguments, which the call may change."""
        recorded = self.calls.setdefault(key, [])
        if len(recorded) < MAX_CALLS:
            with suppress(Exception):
                # An argument that cannot be copied (an open file, a lock) is left out.
                recorded.append(copy.deepcopy((args, options)))

    @contextmanager
    def patch_validation(self) -> Iterator[None]:
        """Record every validated call inside the context."""
        # The originals, restored at the end
        validate = decorators.SignatureConstraints.validate
        post_init = FrozenModel.__post_init__

        def validate_and_record(plan: Any, args: Any, options: Any) -> Any:
            checked = validate(plan, args, options)
            # A partial is validated with some of its arguments only: not a complete call.
            with suppress(TypeError):
                inspect.signature(plan.function).bind(*args, **options)
                self.record(plan.function, args, options)
            return checked

        # A model's own check may change its fields: record them as they were given.
        def construct_and_record(model: Any) -> None:
            values = {f.name: getattr(model, f.name) for f in fields(model)}
            post_init(model)
            self.record(type(model), (), values)

        decorators.SignatureConstraints.validate = validate_and_record
        FrozenModel.__post_init__ = construct_and_record
        try:
            with redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()):
                yield
        finally:
            decorators.SignatureConstraints.validate = validate
            FrozenModel.__post_init__ = post_init


RECORDER = Recorder()
_RUN: set[str] = set()


def subpackages() -> list[str]:
    """Return the public subpackages; `validation` is tested by its kinds instead."""
    return sorted(set(distfilt.__all__) - {"__version__", "validation"})


def public_names(subpackage: str) -> dict[str, Any]:
    """Return a subpackage's exports, and those of the modules among them, by name."""
    package = importlib.import_module(f"distfilt.{subpackage}")
    names: dict[str, Any] = {}
    # Modules among the exports count with their own exports.
    for name in getattr(package, "__all__", ()):
        value = getattr(package, name)
        if isinstance(value, ModuleType):
            for inner_name in value.__all__:
                names[f"{subpackage}.{name}.{inner_name}"] = getattr(value, inner_name)
        else:
            names[f"{subpackage}.{name}"] = value
    return names


def callables(thing: Any) -> dict[str, Callable[..., Any]]:
    """Return a function, or a class's constructor and public methods, if they are validated."""
    members: dict[str, Callable[..., Any]] = {"": thing} if describe(thing) else {}
    if not inspect.isclass(thing):
        return members
    # From the base to the class itself, so that an overriding method wins.
    for base in reversed(thing.__mro__):
        for name, attribute in vars(base).items():
            # A class method or static method wraps its function.
            function = getattr(attribute, "__func__", attribute)
            if not name.startswith("_") and describe(function):
                members[f".{name}"] = function
    return members


def _run_examples(module: ModuleType) -> None:
    """Run a module's examples once, and record the calls that they make."""
    if module.__name__ in _RUN:
        return
    _RUN.add(module.__name__)
    runner = doctest.DocTestRunner(verbose=False, optionflags=doctest.ELLIPSIS)
    finder = doctest.DocTestFinder(exclude_empty=True)
    with RECORDER.patch_validation():
        for test in finder.find(module, globs=dict(vars(module))):
            # Keep the globals: functions that an example defines are called again later.
            runner.run(test, out=lambda _: None, clear_globs=False)


def _modules(thing: Any) -> Iterator[ModuleType]:
    """Yield the modules whose examples may call `thing`, the nearest first."""
    home = sys.modules[thing.__module__]
    yield home
    subpackage = home.__name__.split(".")[1]
    # Examples of the same subpackage most likely call it: they come first.
    packages = pkgutil.walk_packages(distfilt.__path__, "distfilt.")
    names = [info.name for info in packages]
    for name in sorted(names, key=lambda n: (n.split(".")[1] != subpackage, n)):
        yield importlib.import_module(name)


def calls(thing: Any, function: Callable[..., Any]) -> list[Call]:
    """Return recorded calls of a function, a constructor or a method of the public `thing`."""
    key = (
        function
        if inspect.isclass(function)
        else function.signature_constraints.function
    )  # type: ignore[attr-defined]
    for module in _modules(thing):
        _run_examples(module)
        # Running more examples would take time and add nothing.
        if RECORDER.calls.get(key):
            break
    recorded = RECORDER.calls.get(key, [])
    return [_bind(function, args, options) for args, options in recorded]


def _bind(function: Any, args: Any, options: Any) -> Call:
    """Return a recorded call with its arguments by name."""
    signature = inspect.signature(function)
    if inspect.isclass(function) and is_dataclass(function):
        # Fields that the constructor does not take are computed by the class.
        accepted = {f.name for f in fields(function) if f.init}
        arguments = {n: v for n, v in options.items() if n in accepted}
        return Call(function, signature, arguments)
    bound = signature.bind(*args, **options)
    # Defaults are arguments too: they are exchanged like any other.
    bound.apply_defaults()
    return Call(function, signature, dict(bound.arguments))
