"""What the papers print, the scenarios of their studies, and verdicts on our reproductions."""

from .parameters import judge_parameters
from .parts import Parameter, Row, UnknownKey
from .scenarios import read_scenario, scenario
from .specs import Reading, Scenario
from .tables import KINDS, PAPERS, Item, Table, accepted, items, read_table, root, table
from .verdicts import VERDICTS, Claim, Value, Verdict, judge_claims, judge_table, judge_value

__all__ = [  # fmt: skip
    "KINDS", "PAPERS", "VERDICTS", "Claim", "Item", "Parameter", "Reading", "Row", "Scenario",
    "Table", "UnknownKey", "Value", "Verdict", "accepted", "items", "judge_claims",
    "judge_parameters", "judge_table", "judge_value", "read_scenario", "read_table", "root",
    "scenario", "table",
]
