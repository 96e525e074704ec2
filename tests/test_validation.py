"""Every public name stands behind its declared door, and refuses by name what does not fit."""

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

from distfilt.validation.annotations import Scope
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
    name: thing for room in subpackages() for name, thing in public_names(room).items()
}
WITHOUT = {
    r"linalg\..*": "for loops, which have checked before",
    r".*(Error|Collapse|Gain|Disconnected)": "an error or a warning, which a user catches",
    r"filters\.(\w*State|Summary|Filter)|network\.\w*(State|Result)|metrics\.Interval|coupling\.TransportPlan": "made by the library, or derived from by a user",
    r"ensembles\.Members|models\.Swarm": "a type",
    r"density\.(Centralised|Neighbours|ConsensusProtocol)": "a protocol, and two that have no arguments",
    r"filters\.(Step|final_state|prior_moments)|network\.fusion_rule": "for who writes a filter or a rule",
    r"updates\.(update|effective_size|with_missing)": "looks at what has no kind: a function's signature, logarithms with -inf, a step's own",
}
"""Public names without a door, as patterns, and why."""
IN_A_ROW = {
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
    "reading",
    "wanted",
    "mixtures",
    "sensor",
}
"""Data that a call may leave out, such as a filter's graph; options are given by name."""


def refuses(value: Any, call: Call, name: str) -> bool:
    """Whether the kinds themselves, asked in the door's order, refuse a value by its name."""
    arguments = call.arguments | {name: copy.deepcopy(value)}
    scope = Scope(dict(arguments))
    for other, kind in describe(call.function).items():
        try:
            if other in arguments:
                kind.check(arguments[other], other, scope)
        except ValueError as error:
            return other == name and str(error).startswith(name)
        except Exception:  # an object of which an array cannot be made
            return False
    return False


def is_doorless(thing: Any) -> bool:
    """Whether a public name takes arguments and declares nothing about them."""
    return (
        callable(thing)
        and not callables(thing)
        and not isinstance(thing, type(Iterator[int]))
    )


@pytest.mark.parametrize("name", sorted(PUBLIC))
def test_a_door_refuses_by_name(name: str) -> None:
    thing = PUBLIC[name]
    for method, function in callables(thing).items():
        found = calls(thing, function)
        assert found or method or inspect.isclass(thing), f"{name}: no example calls it"
        for call, (argument, kind) in product(found[:1], describe(function).items()):
            if argument not in call.arguments:
                continue
            bad = [
                v
                for _, v in kinds(call.arguments[argument])
                if refuses(v, call, argument)
            ]
            assert bad, f"{name}{method}({argument}): {kind.needs} refuses nothing"
            for value in bad:
                before = copy.deepcopy(call.arguments)
                with pytest.raises(ValueError) as caught:
                    call.run(**{argument: value})
                assert str(caught.value).startswith(argument), (
                    f"{name}{method}: {caught.value}"
                )
                assert exact(before, call.arguments)


@pytest.mark.parametrize("name", sorted(PUBLIC))
def test_a_valid_call_changes_none_of_its_arguments(name: str) -> None:
    """But for generators, which are there to be drawn from."""
    for function in callables(PUBLIC[name]).values():
        for call in calls(PUBLIC[name], function)[:1]:
            after = call.run()[1]
            kept = {
                k: v
                for k, v in call.arguments.items()
                if not isinstance(v, np.random.Generator)
            }
            assert exact(kept, {k: after[k] for k in kept}), function


def test_every_public_name_has_a_door_or_a_reason() -> None:
    found = [name for name, thing in PUBLIC.items() if is_doorless(thing)]
    doorless = [n for n in found if not any(re.fullmatch(p, n) for p in WITHOUT)]
    assert doorless == []


def test_options_are_given_by_name() -> None:
    for name, thing in PUBLIC.items():
        if function := callables(thing).get(""):
            parameters = inspect.signature(function).parameters.values()
            row = {
                p.name for p in parameters if p.kind < 2 and p.default is not p.empty
            }
            assert row <= IN_A_ROW, (
                f"{name}: {sorted(row - IN_A_ROW)} can stand in a row"
            )


def test_structures_are_frozen_and_arrays_make_no_equality() -> None:
    """Two structures of arrays would be compared entry by entry, which is no truth value."""
    for name, made in PUBLIC.items():
        if inspect.isclass(made) and is_dataclass(made):
            options: Any = made.__dataclass_params__  # type: ignore[attr-defined]
            assert options.frozen or name == "filters.Step", f"{name} can be changed"
            types = " ".join(
                re.sub(r"Callable\[.*\]", "", str(f.type)) for f in fields(made)
            )
            assert not (options.eq and "Array" in types), f"{name} compares arrays"
