"""What the checks refuse and how they say it, what they let through unchanged."""

from __future__ import annotations

import datetime
from decimal import Decimal
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from distfilt import checks
from tests.support import ASYMMETRIC, INDEFINITE, NAN, generator, spd

MASKED = np.ma.masked_array([1.0, 2.0], [False, True])
NOT_NUMBERS = {
    "text": (["1.0", "2.0"], np.array(["1.0"]), np.array([b"1"]), [1.0, "2.0"], "three"),
    "booleans": (True, [True, False], np.array([True]), [True, 2.0]),
    "complex numbers": (1j, [1j, 2.0], np.array([1.0 + 0j]), np.array([1j, 2.0], dtype=object)),
    "dates": (np.datetime64("2020-01-01"), np.array(["2020-01-01"], dtype="M8[D]")),
    "time differences": (np.timedelta64(1, "s"), [np.timedelta64(1, "s")]),
    "a masked array": (MASKED, [MASKED, MASKED], np.ma.masked, np.ma.masked_array([1.0])),
    "records": (np.array([(1, 2.0)], dtype="i8,f8"),),
    "None": (None, [None, 1.0]),
    "date": (datetime.date(2020, 1, 1),),
    "dict": ({},),
    "list": ([[1.0, 2.0], [3.0]], [10**400], [datetime.date(2020, 1, 1)]),
    "object": (object(),),
}

_C = "distfilt.checks."
BAD_INPUT = {
    _C + "array": [
        ("x", lambda: checks.array([1.0, NAN], "x")),
        ("x", lambda: checks.array([1.0, float("inf")], "x")),
        ("x", lambda: checks.array([1.0], "x", (2,))),
        ("x", lambda: checks.array([[1.0]], "x", (1,))),
        ("x", lambda: checks.array(1.0, "x", ("N",))),
        ("x", lambda: checks.array([1.0], "x", (..., "N", 1))),
        ("x", lambda: checks.array([[1.0, 2.0], [3.0]], "x")),
    ],
    _C + "callable_": [("f", lambda: checks.callable_(1, "f"))],
    _C + "choice": [
        ("c", lambda: checks.choice("z", "c", ("a", "b"))),
        ("c", lambda: checks.choice(None, "c", ("a", "b"))),
        ("c", lambda: checks.choice(np.array(["a", "b"]), "c", ("a", "b"))),
        ("c", lambda: checks.choice([], "c", ("a", "b"))),
    ],
    _C + "count": [
        ("n", lambda: checks.count(0, "n")),
        ("n", lambda: checks.count(1, "n", at_least=2)),
        ("n", lambda: checks.count(True, "n")),
        ("n", lambda: checks.count(2.0, "n")),
        ("n", lambda: checks.count("2", "n")),
        ("n", lambda: checks.count(np.timedelta64(2), "n")),
        ("n", lambda: checks.count(np.array([2]), "n")),
    ],
    _C + "covariance": [
        ("P", lambda: checks.covariance(INDEFINITE, "P")),
        ("P", lambda: checks.covariance(ASYMMETRIC, "P")),
        ("P", lambda: checks.covariance([[1.0, 0.0]], "P")),
        ("P", lambda: checks.covariance(np.eye(2), "P", 3)),
        ("P", lambda: checks.covariance(np.zeros((2, 2)), "P")),
        ("P", lambda: checks.covariance(INDEFINITE, "P", semidefinite=True)),
        ("P", lambda: checks.covariance(-np.eye(2), "P", semidefinite=True)),
        ("P", lambda: checks.covariance([[1.0, 0.1], [0.1, 0.0]], "P", semidefinite=True)),
    ],
    _C + "flags": [
        ("here", lambda: checks.flags([1, 0], "here")),
        ("here", lambda: checks.flags(["True"], "here")),
        ("here", lambda: checks.flags([True], "here", (2,))),
        ("here", lambda: checks.flags(np.ma.masked_array([True, False]), "here")),
    ],
    _C + "generator": [
        ("rng", lambda: checks.generator(None)),
        ("rng", lambda: checks.generator(np.random.RandomState(0))),
    ],
    _C + "increasing": [
        ("times", lambda: checks.increasing([1.0, 1.0], "times")),
        ("times", lambda: checks.increasing([0.0, 2.0, 1.0], "times")),
        ("times", lambda: checks.increasing([[1.0]], "times")),
    ],
    _C + "instance": [("model", lambda: checks.instance(3, "model", dict))],
    _C + "needed": [("no_such_solver", lambda: checks.needed("no_such_solver", "maps"))],
    _C + "nonblank": [("label", lambda: checks.nonblank(" ", "label"))],
    _C + "number": [
        ("a", lambda: checks.number(NAN, "a")),
        ("a", lambda: checks.number(float("inf"), "a")),
        ("a", lambda: checks.number("0.5", "a")),
        ("a", lambda: checks.number(True, "a")),
        ("a", lambda: checks.number(np.True_, "a")),
        ("a", lambda: checks.number(1j, "a")),
        ("a", lambda: checks.number(np.timedelta64(1), "a")),
        ("a", lambda: checks.number(np.ma.masked, "a")),
        ("a", lambda: checks.number(None, "a")),
        ("a", lambda: checks.number(10**400, "a")),
        ("a", lambda: checks.number([1.0], "a")),
        ("a", lambda: checks.number(0, "a", above=0)),
        ("a", lambda: checks.number(1, "a", below=1)),
        ("a", lambda: checks.number(2, "a", at_most=1)),
        ("a", lambda: checks.number(-1, "a", at_least=0)),
    ],
    _C + "places": [
        ("a", lambda: checks.places(3, "a")),
        ("a", lambda: checks.places([], "a")),
        ("a", lambda: checks.places([1, 1], "a")),
        ("a", lambda: checks.places([0, 3], "a", 3)),
        ("a", lambda: checks.places([-1], "a")),
        ("a", lambda: checks.places([0.5], "a")),
        ("a", lambda: checks.places("12", "a")),
    ],
    _C + "same_length": [
        ("a", lambda: checks.same_length([1], [], "a", "b")),
        ("a", lambda: checks.same_length(3, [], "a", "b")),
        ("b", lambda: checks.same_length([], 3, "a", "b")),
    ],
    _C + "weights": [
        ("w", lambda: checks.weights([0.5, 0.4], "w")),
        ("w", lambda: checks.weights([[0.5, 0.5], [0.5, 0.6]], "w")),
        ("w", lambda: checks.weights([1.5, -0.5], "w")),
        ("w", lambda: checks.weights([], "w")),
        ("w", lambda: checks.weights([1.0], "w", 2)),
    ],
}
EXEMPT = {
    "distfilt.__version__": "a constant",
    _C + "Array": "a type",
    _C + "SolverError": "an exception",
}


@pytest.mark.parametrize("got", sorted(NOT_NUMBERS))
def test_what_is_not_real_numbers_is_refused_by_kind(got: str) -> None:
    for value in NOT_NUMBERS[got]:
        for finite in (True, False):
            with pytest.raises(ValueError) as caught:
                checks.array(value, "x", finite=finite)
            assert str(caught.value) == f"x: needs an array of real numbers, got {got}"
        with pytest.raises(ValueError, match="^x: needs a finite number, got "):
            checks.number(value, "x")


NUMBERS = (1, 2.5, np.float32(0.5), np.int8(3), np.array(2.0), np.uint64(7), Fraction(1, 2),
           Decimal("0.5"))  # fmt: skip


@pytest.mark.parametrize("value", NUMBERS, ids=repr)
def test_real_numbers_pass(value: object) -> None:
    found = checks.number(value, "x", above=0, at_most=9)
    assert type(found) is float and found == float(value)  # type: ignore[arg-type]
    assert checks.array([value, 1.0], "x", (2,)).tolist() == [float(value), 1.0]  # type: ignore


def test_numbers_at_their_bounds() -> None:
    assert checks.number(0, "x", at_least=0) == checks.number(-0.0, "x", at_most=0) == 0
    for bad in ({"above": 1}, {"below": 1}, {"at_least": 1.1}, {"at_most": 0.9}):
        (word,) = (key.replace("_", " ") for key in bad)
        with pytest.raises(ValueError, match=f"^x: needs a number {word} "):
            checks.number(1.0, "x", **bad)
    assert checks.count(np.int64(3), "n", at_least=3) == 3


@given(arrays(np.float64, (3, 4), elements=st.floats(-1e3, 1e3)))
def test_array_keeps_values_and_does_not_copy(values: np.ndarray) -> None:
    out = checks.array(values, "x", (..., "N", 4))
    assert np.shares_memory(out, values) and out.shape == (3, 4)


def test_array_converts_what_is_numeric() -> None:
    for given_ in ([[1, 2]], np.array([[1, 2]], dtype=np.int32), np.array([[1, 2]], dtype=">f8")):
        out = checks.array(given_, "x", (1, 2))
        assert type(out) is np.ndarray and out.dtype == np.float64 and out.tolist() == [[1.0, 2.0]]
    assert checks.array([NAN, 1.0], "x", finite=False).shape == (2,)
    assert checks.array(np.zeros((0, 3)), "x", ("N", 3)).shape == (0, 3)


def test_shapes_are_told_in_words() -> None:
    with pytest.raises(ValueError, match=r"^x: needs shape \(\.\.\., N, 2\), got \(3,\)$"):
        checks.array(np.zeros(3), "x", (..., "N", 2))
    with pytest.raises(ValueError, match=r"^x: needs shape \(T,\), got \(\)$"):
        checks.array(1.0, "x", ("T",))


# --- covariances ------------------------------------------------------------------------------


@given(st.integers(0, 10_000), st.integers(1, 6))
def test_covariances_pass_in_any_units(seed: int, d: int) -> None:
    rng = generator(seed)
    size = 10.0 ** rng.uniform(-100, 100, (3, d))
    cov = spd(rng, d, (3,)) * size[:, :, None] * size[:, None, :]
    cov = 0.5 * (cov + cov.swapaxes(1, 2))
    for semidefinite in (True, False):
        assert checks.covariance(cov, "P", d, semidefinite=semidefinite) is cov
        assert checks.covariance(cov[0], "P", semidefinite=semidefinite).shape == (d, d)


@pytest.mark.parametrize("semidefinite", [True, False])
def test_each_matrix_is_judged_alone_and_each_component_in_its_units(semidefinite: bool) -> None:
    def refused(cov: object) -> str:
        with pytest.raises(ValueError, match="^P: ") as caught:
            checks.covariance(cov, "P", semidefinite=semidefinite)  # type: ignore[arg-type]
        return str(caught.value)

    assert "-100" in refused(np.diag([1e12, -100.0]))
    skew = [[1e12, 0.0, 0.0], [0.0, 1.0, 0.9], [0.0, -0.9, 1.0]]
    assert "asymmetry of 1.8" in refused(skew)
    assert "at [1]" in refused([np.diag([1e12, 1e12]), INDEFINITE])
    assert "at [0, 1]" in refused([[1e12 * np.eye(2), np.diag([1.0, -1e-9])]])
    hidden = np.diag([1e12, 1.0, 1.0])
    hidden[1, 2] = hidden[2, 1] = 1.1
    assert "smallest eigenvalue -0.1" in refused(hidden)
    slightly = [[1e12, 0.0, 0.0], [0.0, 1.0, 0.5], [0.0, 0.5 + 1e-8, 1.0]]
    assert "symmetric" in refused(slightly)


def test_rounding_is_no_asymmetry_and_no_negative_eigenvalue() -> None:
    near = np.array([[1e12, 3e5], [3e5 * (1 + 1e-11), 1.0]])
    assert checks.covariance(near, "P") is near
    flat = np.outer([1.0, 1e-6, 1e6], [1.0, 1e-6, 1e6])
    assert checks.covariance(flat, "P", semidefinite=True) is flat
    zero = np.zeros((4, 2, 2))
    assert checks.covariance(zero, "P", semidefinite=True) is zero
    still = np.diag([0.0, 2.0])
    assert checks.covariance(still, "P", semidefinite=True) is still
    tiny = 1e-310 * np.eye(2)
    assert checks.covariance(tiny, "P") is tiny
    for shape in ((0, 0), (0, 3, 3), (2, 0, 0)):
        assert checks.covariance(np.zeros(shape), "P").shape == shape
    with pytest.raises(ValueError, match="smallest eigenvalue"):
        checks.covariance([[1.0, 1.0 + 1e-8], [1.0 + 1e-8, 1.0]], "P", semidefinite=True)


# --- the rest ---------------------------------------------------------------------------------


def test_weights_sum_over_the_last_axis() -> None:
    w = np.array([[0.25, 0.75], [1.0, 0.0]])
    assert checks.weights(w, "w", 2) is w
    with pytest.raises(ValueError, match="got 1.25"):
        checks.weights([[0.5, 0.5], [0.5, 0.75]], "w")
    with pytest.raises(ValueError, match="got 0.9"):
        checks.weights([0.5, 0.4], "w")


def test_times() -> None:
    assert checks.increasing([0.0, 1.0, 3.0], "t").tolist() == [0.0, 1.0, 3.0]
    assert checks.increasing([], "t").size == 0
    with pytest.raises(ValueError, match=r"got 2 after 3$"):
        checks.increasing([1.0, 3.0, 2.0, 2.0], "t")


def test_what_passes_comes_back() -> None:
    rng = generator()
    assert checks.generator(rng) is rng and checks.instance(rng, "r", np.random.Generator) is rng
    assert checks.callable_(len, "f") is len and checks.choice("a", "c", ("a", "b")) == "a"
    assert checks.flags([[True, False]], "h", (..., 2)).tolist() == [[True, False]]
    checks.same_length((1, 2), {3, 4}, "a", "b")


def test_a_missing_package_names_its_extra() -> None:
    import json

    assert checks.needed("json", "maps") is json
    with pytest.raises(ModuleNotFoundError, match=r"pip install 'distfilt\[plots\]'$") as caught:
        checks.needed("no_such.package", "plots")
    assert caught.value.name == "no_such.package"


def test_an_error_inside_an_installed_package_is_not_blamed_on_the_extra(
    tmp_path: object, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "half_there.py").write_text("import not_there_at_all")  # type: ignore[operator]
    monkeypatch.syspath_prepend(str(tmp_path))
    with pytest.raises(ModuleNotFoundError) as caught:
        checks.needed("half_there", "maps")
    assert caught.value.name == "not_there_at_all" and "extra" not in str(caught.value)


def test_solver_errors_are_runtime_errors() -> None:
    assert issubclass(checks.SolverError, RuntimeError)
