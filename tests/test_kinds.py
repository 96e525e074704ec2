"""Doors: what the kinds let through and refuse, how shapes are bound, records, and ways round."""

from __future__ import annotations

import pickle
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Annotated, Any, Literal

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from typing_extensions import TypeAliasType

from distfilt import validation
from distfilt.validation.annotations import Scope, kind_of
from tests.support import ASYMMETRIC, INDEFINITE, NAN, generator, spd, without_checks

MASKED = np.ma.masked_array([1.0, 2.0], [False, True])
ODD = (
    ["1.0"],
    "three",
    True,
    [True, 2.0],
    1j,
    np.array([1 + 0j]),
    np.array(["2020"], "M8[D]"),
    np.timedelta64(1, "s"),
    MASKED,
    [MASKED],
    None,
    [None, 1.0],
    {},
    object(),
    [[1.0, 2.0], [3.0]],
    [10**400],
)
KINDS: list[tuple[Any, Sequence[Any], Sequence[Any]]] = [
    (float, [1, 2.5, np.float32(0.5), np.array(2.0)], [*ODD, NAN, np.inf, [1.0]]),
    (validation.PositiveFloat, [0.5], [0, -1.0]),
    (Annotated[float, validation.Bounds(at_least=0, below=1)], [0, 0.5], [-0.1, 1.0]),
    (int, [3, np.int64(3)], [2.0, True, "2", np.timedelta64(2), np.array([2])]),
    (validation.PositiveInt, [1], [0]),
    (bool, [True], [1, "yes"]),
    (str, ["a"], ["", " ", 3]),
    (Literal["a", "b"], ["a"], ["c", None, [], np.array(["a", "b"])]),
    (validation.Rng, [generator()], [None, np.random.RandomState(0)]),
    (Callable[..., Any], [len], [3]),
    (dict, [{}], [3]),
    (float | None, [None, 1.0], ["a"]),
    (float | Literal["all"], ["all", 1], ["some"]),
    (
        validation.DistinctIndices,
        [[0, 2], np.array([1])],
        [3, [], [1, 1], [-1], [0.5], "12"],
    ),
    (tuple[int, str], [(1, "a")], [(1,), (1, 2), 3]),
    (
        Annotated[validation.Array, "2 N"],
        [[[1, 2], [3, 4]], np.zeros((2, 0))],
        [*ODD, [1.0, 2.0], [[1, NAN]]],
    ),
    (
        Annotated[TypeAliasType("Row", validation.Array), "2"],
        [[1, 2], np.ones(2)],
        [*ODD, [1.0], [1, NAN]],
    ),
    (
        Annotated[validation.Array, "m", validation.ALLOW_NAN],
        [[1.0, NAN]],
        [[np.inf], [], [[1.0]]],
    ),
    (
        Annotated[validation.Mask, "A"],
        [[True, False]],
        [[1, 0], ["True"], np.ma.masked_array([True])],
    ),
    (Annotated[validation.Times, "T"], [[0.0, 1.0], []], [[1.0, 1.0], [0.0, 2.0, 1.0]]),
    (
        validation.Probabilities,
        [[[0.25, 0.75], [1, 0]]],
        [[0.5, 0.4], [1.5, -0.5], [[0.5, 0.5], [0.5, 0.6]]],
    ),
    (
        validation.PositiveDefinite,
        [np.eye(2)],
        [INDEFINITE, ASYMMETRIC, [[1.0, 0.0]], np.zeros((2, 2))],
    ),
    (
        validation.PositiveSemidefinite,
        [np.zeros((2, 2))],
        [INDEFINITE, -np.eye(2), [[1.0, 0.1], [0.1, 0.0]]],
    ),
]


@pytest.mark.parametrize(("annotation", "good", "bad"), KINDS, ids=range(len(KINDS)))
def test_a_kind_lets_through_and_refuses(annotation: Any, good: Any, bad: Any) -> None:
    kind = kind_of(annotation)
    assert kind is not None
    for value in good:
        out = kind.check(value, "x", Scope({}))
        np.testing.assert_array_equal(out, value)
    for value in bad:
        with pytest.raises(ValueError, match="^x must .*got "):
            kind.check(value, "x", Scope({}))


def test_numbers_are_converted_and_arrays_are_not_copied() -> None:
    x = np.zeros((3, 4))
    assert validation.check_array(x, "x", (..., "N", 4)) is x
    for given_ in (
        [[1, 2]],
        np.array([[1, 2]], dtype=np.int32),
        np.array([[1, 2]], dtype=">f8"),
    ):
        out = validation.check_array(given_, "x", (1, 2))
        assert (
            type(out) is np.ndarray
            and out.dtype == np.float64
            and out.tolist() == [[1.0, 2.0]]
        )
    with pytest.raises(
        ValueError, match=r"^x must have shape \(\.\.\., N, 2\), got \(3,\)$"
    ):
        validation.check_array(np.zeros(3), "x", (..., "N", 2))


@dataclass(frozen=True, eq=False)
class Line(validation.FrozenModel):
    """A record with a shape bound by another field, an option, and a method with a door."""

    dim: validation.PositiveInt
    cov: Annotated[validation.PositiveDefinite, "dim dim"]
    parts: tuple[validation.Array, ...] = field(default=(), kw_only=True)

    @validation.validated
    def moved(
        self, x: Annotated[validation.Array, "... self.dim"], by: float = 1.0
    ) -> validation.Array:
        return x + by


def test_shapes_are_bound_by_arguments_fields_and_paths() -> None:
    @validation.validated
    def both(
        x: Annotated[validation.Array, "N d"],
        y: Annotated[validation.Array, "N"],
        line: Line,
        z: Annotated[validation.Array, "line.dim d"],
    ) -> tuple[Any, ...]:
        return x, y, z

    fits = {
        "x": np.ones((3, 4)),
        "y": np.ones(3),
        "line": Line(2, np.eye(2)),
        "z": np.ones((2, 4)),
    }
    both(**fits)
    for name, bad in (("y", np.ones(4)), ("z", np.ones((3, 4))), ("line", 3)):
        with pytest.raises(ValueError, match=f"^{name}: "):
            both(**(fits | {name: bad}))


def test_records_copy_and_freeze_and_a_way_round_does_neither() -> None:
    cov = np.eye(2)
    line = Line(2, cov, parts=[cov[0]])
    cov[0, 0] = 9.0
    assert line.cov[0, 0] == line.parts[0][0] == 1.0 and not line.cov.flags.writeable
    assert Line.construct(2, cov).cov is cov and Line.construct(2, cov).parts == ()
    assert line.replace(dim=7).dim == 7 and pickle.loads(pickle.dumps(line)).dim == 2


def test_the_way_round_a_door() -> None:
    line = Line(1, [[1.0]])
    assert without_checks(line.moved)(np.ones(2)).tolist() == [2.0, 2.0]
    assert without_checks(partial(line.moved, by=2.0))(np.ones(2)).tolist() == [
        3.0,
        3.0,
    ]


def test_a_partial_s_options_are_looked_at_where_it_is_handed_in() -> None:
    @validation.validated
    def apply(f: Callable[..., validation.Array], x: float) -> Any:
        return without_checks(f)(x)

    scaled = validation.validated(lambda x, by: x * by)
    scaled.plan.function.__annotations__ = {"by": validation.PositiveFloat}
    assert apply(partial(scaled, by=2), 3.0) == 6.0
    with pytest.raises(ValueError, match="^by must be positive"):
        apply(partial(scaled, by=-2), 3.0)


@given(st.integers(0, 10_000), st.integers(1, 6))
def test_covariances_pass_in_any_units(seed: int, d: int) -> None:
    rng = generator(seed)
    size = 10.0 ** rng.uniform(-100, 100, (3, d))
    cov = spd(rng, d, (3,)) * size[:, :, None] * size[:, None, :]
    for rule in (
        validation.check_positive_definite,
        validation.check_positive_semidefinite,
    ):
        rule(0.5 * (cov + cov.swapaxes(1, 2)), "P")


@pytest.mark.parametrize(
    "rule", [validation.check_positive_definite, validation.check_positive_semidefinite]
)
def test_each_matrix_is_judged_alone_and_each_component_in_its_units(rule: Any) -> None:
    hidden = np.diag([1e12, 1.0, 1.0])
    hidden[1, 2] = hidden[2, 1] = 1.1
    for cov, words in (
        (np.diag([1e12, -100.0]), "-100"),
        ([[1e12, 0, 0], [0, 1.0, 0.9], [0, -0.9, 1.0]], "asymmetry of 1.8"),
        ([np.diag([1e12, 1e12]), INDEFINITE], r"at \[1\]"),
        ([[1e12 * np.eye(2), np.diag([1.0, -1e-9])]], r"at \[0, 1\]"),
        (hidden, "smallest eigenvalue -0.1"),
        ([[1.0, 0.0]], r"a square matrix, got shape \(1, 2\)"),
        ([[1e12, 0, 0], [0, 1.0, 0.5], [0, 0.5 + 1e-8, 1.0]], "symmetric"),
    ):
        with pytest.raises(ValueError, match=f"^P must .*{words}"):
            rule(np.array(cov), "P")


def test_rounding_is_no_asymmetry_and_no_negative_eigenvalue() -> None:
    validation.check_positive_definite(
        np.array([[1e12, 3e5], [3e5 * (1 + 1e-11), 1.0]]), "P"
    )
    validation.check_positive_definite(1e-310 * np.eye(2), "P")
    for cov in (np.outer([1.0, 1e-6, 1e6], [1.0, 1e-6, 1e6]), np.diag([0.0, 2.0])):
        validation.check_positive_semidefinite(cov, "P")
    with pytest.raises(ValueError, match="smallest eigenvalue"):
        validation.check_positive_semidefinite(
            np.array([[1.0, 1.0 + 1e-8], [1.0 + 1e-8, 1.0]]), "P"
        )
