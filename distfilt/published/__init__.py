"""What the papers print, the scenarios of their studies, and verdicts on our reproductions."""

from .scenarios import read_scenario, scenario
from .specs import AgentSpec, Parameter, Scenario, UnknownKey
from .tables import PAPERS, Item, Table, items, read_table, root, table
from .verdicts import (
    VERDICTS,
    Claim,
    Value,
    Verdict,
    judge_claims,
    judge_parameters,
    judge_table,
    judge_value,
)

__all__ = [
    "PAPERS",
    "VERDICTS",
    "AgentSpec",
    "Claim",
    "Item",
    "Parameter",
    "Scenario",
    "Table",
    "UnknownKey",
    "Value",
    "Verdict",
    "items",
    "judge_claims",
    "judge_parameters",
    "judge_table",
    "judge_value",
    "read_scenario",
    "read_table",
    "root",
    "scenario",
    "table",
]
