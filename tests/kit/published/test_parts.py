"""Parameters and rows: what they take, how they are read, and that nothing changes them."""

from __future__ import annotations

import copy
import pickle

import numpy as np
import pytest

from bookkit.published import Row, UnknownKey

from .files import named, parameter, row

_REFUSED = named(
    {
        "Parameter": [
            ("name", lambda: parameter(name="A gain")),
            ("value", lambda: parameter(value=None)),
            ("value", lambda: parameter(value="")),
            ("value", lambda: parameter(value=[True, False])),
            ("value", lambda: parameter(value=[np.inf])),
            ("value", lambda: parameter(value=np.array([[np.nan]]))),
            ("unit", lambda: parameter(unit=None)),
            ("source", lambda: parameter(source="")),
            ("reason", lambda: parameter(reason=" ")),
            ("where", lambda: parameter(source="given")),
            ("note", lambda: parameter(note=3)),
        ],
        "Row": [
            ("cells", lambda: Row([("name", "A")])),
            ("name", lambda: row(name="")),
            ("name", lambda: row(name=None)),
            ("dims", lambda: row(dims=())),
            ("dims", lambda: row(dims=(-1,))),
            ("dims", lambda: row(dims=(1, 1))),
            ("dims", lambda: row(dims=3)),
            ("kind", lambda: row(kind="")),
            ("noise", lambda: row(noise=0.0)),
            ("noise", lambda: row(noise=np.nan)),
            ("std", lambda: row(std=-1.0)),
            ("neighbours", lambda: row(neighbours=("A", "A"))),
            ("neighbours", lambda: row(neighbours=(1,))),
            ("mass", lambda: row(mass=[1, "a"])),
            ("Mass", lambda: row(Mass=1.0)),
            ("unit", lambda: row(unit="")),
            ("unit", lambda: row(unit=None)),
            ("unit", lambda: row(kind="range", unit="rad")),
            ("unit", lambda: row(kind="rangefinder", unit="rad")),
            ("unit", lambda: row(kind="bearing", unit="m")),
            ("source", lambda: row(source="guessed")),
            ("where", lambda: row(where="")),
            ("reason", lambda: row(source="inferred")),
            ("reason", lambda: row(reason=3)),
            ("note", lambda: row(note=3)),
            ("key", lambda: row()["colour"]),
        ],
    }
)
_NONE = {"bookkit.published.UnknownKey": "an exception"}


@pytest.mark.parametrize("name", sorted(_REFUSED))
def test_bad_input_is_named(name):
    for argument, call in _REFUSED[name]:
        with pytest.raises(ValueError, match=rf"^{argument}: "):
            call()


def test_a_row_is_a_mapping_with_names():
    agent = row(kind="angle", unit="deg", dims=[1, 2], mass=2, note="a remark")
    assert agent.dims == agent["dims"] == (1, 2) and agent.mass == 2
    assert dict(agent)["neighbours"] == ("A",) and len(agent) == 10 and "mass" in agent
    assert agent.value_columns == ("name", "dims", "kind", "noise", "neighbours", "unit", "mass")
    assert agent.why == "Table II. a remark" and row(source="assumed", reason="so").why == "so"
    with pytest.raises(AttributeError, match="no column 'nois'; nearest: noise"):
        agent.nois  # noqa: B018
    with pytest.raises(UnknownKey, match="row 'A' has no column 'colour'"):
        agent["colour"]
    assert not hasattr(agent, "__array__")


def test_a_row_cannot_be_changed_and_travels():
    agent = row(dims=[0, 1])
    with pytest.raises(AttributeError, match="replace_row"):
        agent.noise = 1.0
    with pytest.raises(TypeError):
        agent["noise"] = 1.0
    for other in (pickle.loads(pickle.dumps(agent)), copy.deepcopy(agent), Row(dict(agent))):
        assert other == agent and hash(other) == hash(agent) and other.dims == (0, 1)
    assert agent != row(dims=[0, 2])


def test_a_parameter_keeps_plain_values():
    assert parameter(value=np.array([[1.0, 2.0]])).value == ((1.0, 2.0),)
    assert parameter(value=["a", "b"]).value == ("a", "b")
    assert parameter(value=np.float64(2.0)).value == 2.0
    assert parameter(note="and so").why == "x and so"
