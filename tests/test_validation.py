"""Every public function validates its arguments, and its errors name the wrong one."""

from __future__ import annotations

import copy
import inspect
import re
from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from itertools import product
from typing import Any

import numpy as np
import pytest

from distfilt.validation.annotations import CallContext
from tests.tools.calls import (
    Call,
    callables,
    calls,
    describe,
    public_names,
    subpackages,
)
from tests.tools.fuzz import exact, kinds

PUBLIC = {
    name: thing
    for package in subpackages()
    for name, thing in public_names(package).items()
}
NOT_VALIDATED = {
    r"linalg\..*": "for loops, whose arguments were checked before",
    r".*(Error|Collapse|Gain|Disconnected|BiasedAverage)": "an error or a warning, which a user catches",
    r"filters\.(\w*State|Summary|Filter)|network\.\w*(State|Result)|metrics\.Interval|coupling\.TransportPlan": "made by the library, or a base class",
    r"ensembles\.Members|models\.Swarm": "a type",
    r"density\.(Centralised|Neighbours|ConsensusProtocol)": "a protocol, and two that have no arguments",
    r"filters\.(Step|final_state|prior_moments)|network\.fusion_rule": "for authors of a filter or a rule",
    r"updates\.(update|effective_size)": "takes a function's signature, or logarithms with -inf",
}
"""Patterns of public names without validation, and why."""
POSITIONAL = {
    "graph",
    "covariance",
    "members",
    "weights",
    "numbers",
    "columns",
    "target",
    "lost",
    "dropped",
    "strength",
    "bodies",
    "interpretation",
    "wanted",
    "mixtures",
    "sensor",
}
"""Optional data that may be given by position; options are given by name."""


def refuses(value: Any, call: Call, name: str) -> bool:
    """Whether the constraints, in the order of a call, refuse a value by its argument's name."""
    arguments = call.arguments | {name: copy.deepcopy(value)}
    context = CallContext(dict(arguments))
    for argument, constraint in describe(call.function).items():
        if argument not in arguments:
            continue
        try:
            constraint.validate(arguments[argument], argument, context)
        except ValueError as error:
            return argument == name and str(error).startswith(name)
        except Exception:  # an object that cannot be converted to an array
            return False
    return False


def is_unvalidated(thing: Any) -> bool:
    """Whether a public name takes arguments without any constraint."""
    is_alias = isinstance(thing, type(Iterator[int]))
    return callable(thing) and not callables(thing) and not is_alias


@pytest.mark.parametrize("name", sorted(PUBLIC))
def test_errors_name_the_wrong_argument(name: str) -> None:
    """Exchange each argument of an example by wrong values; the error names it."""
    thing = PUBLIC[name]
    for method, function in callables(thing).items():
        examples = calls(thing, function)
        has_example = examples or method or inspect.isclass(thing)
        assert has_example, f"{name}: no example calls it"
        constraints = describe(function)
        for call, argument in product(examples[:1], constraints):
            if argument in call.arguments:
                label = f"{name}{method}({argument})"
                check_refusals(call, argument, label)


def check_refusals(call: Call, argument: str, label: str) -> None:
    """Every value that a constraint refuses is refused by the call, which changes nothing."""
    values = [value for _, value in kinds(call.arguments[argument])]
    wrong = [value for value in values if refuses(value, call, argument)]
    assert wrong, f"{label}: no value is refused"
    for value in wrong:
        before = copy.deepcopy(call.arguments)
        with pytest.raises(ValueError) as caught:
            call.run(**{argument: value})
        assert str(caught.value).startswith(argument), f"{label}: {caught.value}"
        # A refused call has not written to its other arguments, either.
        assert exact(before, call.arguments)


@pytest.mark.parametrize("name", sorted(PUBLIC))
def test_a_valid_call_changes_none_of_its_arguments(name: str) -> None:
    """Generators are an exception, since they are drawn from."""
    for function in callables(PUBLIC[name]).values():
        for call in calls(PUBLIC[name], function)[:1]:
            _, after = call.run()
            for argument, value in call.arguments.items():
                if not isinstance(value, np.random.Generator):
                    assert exact(value, after[argument]), function


def test_every_public_function_is_validated() -> None:
    """Or matches a pattern with a reason."""
    names = [name for name, thing in PUBLIC.items() if is_unvalidated(thing)]
    unexplained = []
    for name in names:
        if not any(re.fullmatch(pattern, name) for pattern in NOT_VALIDATED):
            unexplained.append(name)
    assert unexplained == []


def test_options_are_given_by_name() -> None:
    for name, thing in PUBLIC.items():
        if function := callables(thing).get(""):
            parameters = inspect.signature(function).parameters.values()
            optional = [p for p in parameters if p.default is not p.empty]
            positional = {p.name for p in optional if p.kind < p.VAR_POSITIONAL}
            wrong = sorted(positional - POSITIONAL)
            assert not wrong, f"{name}: {wrong} can be given by position"


def test_structures_are_frozen_and_arrays_make_no_equality() -> None:
    """Two structures of arrays would be compared entry by entry, which is no truth value."""
    for name, cls in PUBLIC.items():
        if not (inspect.isclass(cls) and is_dataclass(cls)):
            continue
        options: Any = cls.__dataclass_params__  # type: ignore[attr-defined]
        assert options.frozen or name == "filters.Step", f"{name} can be changed"
        # Functions of arrays are compared by identity.
        types = [re.sub(r"Callable\[.*\]", "", str(f.type)) for f in fields(cls)]
        has_arrays = any("Array" in text for text in types)
        assert not (options.eq and has_arrays), f"{name} compares arrays"
