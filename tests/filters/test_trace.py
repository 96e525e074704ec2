"""How much code a reader meets in one step of a filter: calls and modules, by tests/tools."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from ..tools.trace_step import (
    LIBRARY,
    Call,
    count_modules,
    trace_calls,
    trace_one_agent,
    trace_ring,
)


@pytest.fixture(scope="module")
def one_agent() -> list[Call]:
    return trace_one_agent()


@pytest.fixture(scope="module")
def ring() -> list[Call]:
    return trace_ring()


def test_a_step_of_one_agent_can_be_read(one_agent: list[Call]) -> None:
    """Without a network a step is forecast, prediction and update, and nothing else."""
    assert len(one_agent) <= 60
    assert count_modules(one_agent) <= 10


def test_a_step_of_a_ring_can_be_read(ring: list[Call]) -> None:
    """With observations and beliefs exchanged, it also passes channel, rule and ledger."""
    assert len(ring) <= 230
    assert count_modules(ring) <= 15


def test_a_step_goes_by_the_functions_of_the_page(ring: list[Call]) -> None:
    """The book's page names these functions in this order."""
    expected = [
        "Filter.step",
        "SensorFilter.read_observations",
        "EnsembleFilter.next_state",
        "exact_forecast",
        "collect_observations",
        "Channel.broadcast",
        "group_agents",
        "Received.predict",
        "enkf_exact",
        "fuse_beliefs",
        "intersect_ensembles",
        "Step.end",
    ]
    functions = [call.function for call in ring]
    first = [functions.index(name) for name in expected]
    assert first == sorted(first)


def test_calls_of_other_code_are_not_counted() -> None:
    """numpy's functions and comprehensions have no entries."""
    assert trace_calls(lambda: [abs(k) for k in range(3)]) == []


PAGE = Path(__file__).parents[2] / "book" / "how-a-step-works.md"


def test_the_page_names_functions_where_they_are() -> None:
    """Each row of its table has a step, functions or classes, and the modules that define them."""
    text = PAGE.read_text(encoding="utf-8")
    rows = re.findall(r"^\| [a-z].*\|(.*)\|(.*)\|$", text, flags=re.MULTILINE)
    assert len(rows) > 10
    for functions, modules in rows:
        source = ""
        for module in re.findall(r"`(.+?)`", modules):
            source += (LIBRARY / module).read_text(encoding="utf-8")
        for name in re.findall(r"`(.+?)`", functions):
            # A method stands for itself; a sensor's function is a field.
            last = name.split(".")[-1]
            assert re.search(rf"(def|class) {last}\b", source) or last == "h", name
