"""The table of the page of recipes: each family offers what it says, and refuses the rest."""

from __future__ import annotations

import re
from functools import partial
from typing import Any

import numpy as np
import pytest

from common import ROOT
from distfilt import filters
from distfilt.density import Grid
from distfilt.filters import FilterError, Observation, PolynomialBasis
from distfilt.mixtures import target_fusion
from distfilt.models import AgentModels, InputModel, Inputs, LinearModel, Model
from distfilt.network import finite_time_consensus, graphs
from distfilt.sensors import LikelihoodSensor, component

PAGE = (ROOT / "book" / "streams.md").read_text(encoding="utf-8")
SCRIPT = (ROOT / "book" / "examples" / "streams.py").read_text(encoding="utf-8")

HEADER, *ROWS = [
    [cell.strip(" `") for cell in line.strip("|").split("|")]
    for line in re.findall(r"^\|.*\|$", PAGE, re.M)
    if "---" not in line
]


def name_family(row: list[str]) -> str:
    """Return the class of a row's family, such as "Gaussian sum"."""
    return "".join(word.capitalize() for word in row[0].split()) + "Filter"


WALK = Model(1, lambda x, t, dt: x, lambda t, dt: dt * np.eye(1))
# The second component neither moves nor gets noise.
WALK_WITH_CONSTANT = Model(2, lambda x, t, dt: x, lambda t, dt: np.diag([dt, 0.0]))
DECAY = LinearModel.from_transition(
    1,
    lambda t, dt: np.array([[np.exp(-t * dt - dt**2 / 2)]]),
    lambda t, dt: dt * np.eye(1),
)
DRIVEN = InputModel.from_inputs(
    1, lambda x, u, dt: x + u * dt, Inputs(np.zeros(1), np.ones((1, 1)), np.eye(1))
)
GAUSSIAN = LikelihoodSensor(1, lambda x, y: -((y - x)[..., 0] ** 2) / 2)
UNIT = component([0], std=1.0)
PRIOR = ([0.0], [[1.0]])

OPTIONS: dict[str, dict[str, Any]] = {
    "GridFilter": {"grid": Grid((60,), low=-10.0, high=10.0)},
    "InformationConsensusFilter": {"fusion": finite_time_consensus},
    "InformationIncrementFilter": {"target_dim": 1},
    "LikelihoodConsensusFilter": {
        "basis": PolynomialBasis([0]),
        "fusion": finite_time_consensus,
    },
    "MixtureFilter": {
        "fusion": partial(target_fusion, target_dim=1),
        "target_dim": 1,
    },
}


def run_filter(
    name: str,
    model: Model = WALK,
    sensor: Any = UNIT,
    prior: Any = PRIOR,
    delayed: tuple[Observation, ...] = (),
    **options: Any,
) -> tuple[Any, Any]:
    """Step a family of two agents to 3 s; return the filter and its state."""
    options = OPTIONS.get(name, {}) | options
    f = getattr(filters, name)(model, [sensor] * 2, graphs.path(2), **options)
    state = f.start(prior, rng=np.random.default_rng(0))
    for t in (1.0, 2.0):
        state = f.step(state, t, [[0.1], [0.2]])
    return f, f.step(state, 3.0, [[0.1], [0.2]], delayed=delayed)


def reset_state(name: str) -> None:
    """Give the first component a new belief."""
    f, state = run_filter(name)
    f.reset(state, [0], [0.0], [[1.0]])


def run_with_constant(name: str) -> None:
    """Run a model whose second component is known."""
    # A grid has an axis for each component.
    plane = {"grid": Grid((20, 20), low=-10.0, high=10.0)}
    options = plane if name == "GridFilter" else {}
    prior = ([0.0, 1.0], np.diag([1.0, 0.0]))
    run_filter(name, WALK_WITH_CONSTANT, prior=prior, **options)


CALLS = {
    "delay": partial(run_filter, delayed=(Observation(1.4, 0, [0.5]),), lag=3),
    "reset": reset_state,
    "priors": partial(run_filter, prior=[PRIOR, ([1.0], [[2.0]])]),
    "matrix": partial(run_filter, model=DECAY),
    "constant": run_with_constant,
    "input": partial(run_filter, model=DRIVEN),
    "models": partial(run_filter, model=AgentModels.from_models([DRIVEN, WALK])),
    "likelihood": partial(run_filter, sensor=GAUSSIAN),
    "evidence": partial(run_filter, record_evidence=True),
}


def test_table_has_every_family_with_sensors() -> None:
    named = {name_family(row) for row in ROWS}
    families = {name for name in filters.__all__ if name.endswith("Filter")}
    assert named == families - {"Filter", "SensorFilter", "DensityFilter"}
    assert HEADER[1:] == list(CALLS)


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("row", ROWS, ids=lambda row: row[0])
def test_family_offers_its_recipes_and_refuses_the_others(row: list[str]) -> None:
    name = name_family(row)
    # The plain filter runs, so that a refusal is that of the recipe.
    run_filter(name)
    for recipe, cell in zip(HEADER[1:], row[1:], strict=True):
        if cell == "yes":
            CALLS[recipe](name)
            continue
        with pytest.raises((ValueError, TypeError, FilterError)):
            CALLS[recipe](name)


def test_page_includes_every_recipe() -> None:
    included = re.findall(r"^:pyobject: (\w+)$", PAGE, re.M)
    assert included == re.findall(r"^def (\w+)\(\) -> Comparison", SCRIPT, re.M)
