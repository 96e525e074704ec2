"""Constraints of annotations, binding of shapes, frozen models, and how checks are skipped."""

from __future__ import annotations

import importlib
import pickle
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from typing_extensions import TypeAliasType

from distfilt import validation
from distfilt.validation import first_use
from distfilt.validation.annotations import CallContext, make_constraint
from distfilt.validation.batching import call_batched
from tests.support import ASYMMETRIC, INDEFINITE, NAN, generator, spd, without_checks

MASKED = np.ma.masked_array([1.0, 2.0], [False, True])
NOT_REAL = (
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
CONSTRAINTS: list[tuple[Any, Sequence[Any], Sequence[Any]]] = [
    (float, [1, 2.5, np.float32(0.5), np.array(2.0)], [*NOT_REAL, NAN, np.inf, [1.0]]),
    (validation.PositiveFloat, [0.5], [0, -1.0]),
    (Annotated[float, validation.Bounds(at_least=0, below=1)], [0, 0.5], [-0.1, 1.0]),
    (int, [3, np.int64(3)], [2.0, True, "2", np.timedelta64(2), np.array([2])]),
    (validation.PositiveInt, [1], [0]),
    (bool, [True, np.True_], [1, np.int64(1), "yes"]),
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
        [*NOT_REAL, [1.0, 2.0], [[1, NAN]]],
    ),
    (
        Annotated[TypeAliasType("Row", validation.Array), "2"],
        [[1, 2], np.ones(2)],
        [*NOT_REAL, [1.0], [1, NAN]],
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


@pytest.mark.parametrize(
    ("annotation", "valid", "invalid"), CONSTRAINTS, ids=range(len(CONSTRAINTS))
)
def test_a_constraint_accepts_and_refuses(
    annotation: Any, valid: Any, invalid: Any
) -> None:
    constraint = make_constraint(annotation)
    assert constraint is not None
    for value in valid:
        result = constraint.validate(value, "x", CallContext({}))
        np.testing.assert_array_equal(result, value)
    for value in invalid:
        with pytest.raises(ValueError, match="^x must .*got "):
            constraint.validate(value, "x", CallContext({}))


def test_messages_name_numpy_s_types() -> None:
    """A reader of "got bool" would search for a bool of Python's."""
    for annotation in (int, float, validation.Array):
        constraint = make_constraint(annotation)
        assert constraint is not None
        with pytest.raises(ValueError, match=r"got np\.bool$"):
            constraint.validate(np.True_, "x", CallContext({}))


def test_numbers_are_converted_and_arrays_are_not_copied() -> None:
    x = np.zeros((3, 4))
    assert validation.check_array(x, "x", (..., "N", 4)) is x
    integers = np.array([[1, 2]], dtype=np.int32)
    swapped_bytes = np.array([[1, 2]], dtype=">f8")
    for value in ([[1, 2]], integers, swapped_bytes):
        result = validation.check_array(value, "x", (1, 2))
        assert type(result) is np.ndarray
        assert result.dtype == np.float64
        assert result.tolist() == [[1.0, 2.0]]
    text = r"^x must have shape \(\.\.\., N, 2\), got \(3,\)$"
    with pytest.raises(ValueError, match=text):
        validation.check_array(np.zeros(3), "x", (..., "N", 2))


@dataclass(frozen=True, eq=False)
class Line(validation.FrozenModel):
    """A frozen model: a shape bound by another field, an option, and a validated method."""

    dim: validation.PositiveInt
    cov: Annotated[validation.PositiveDefinite, "dim dim"]
    parts: tuple[validation.Array, ...] = field(default=(), kw_only=True)

    @validation.validated
    def shift(
        self, x: Annotated[validation.Array, "... self.dim"], by: float = 1.0
    ) -> validation.Array:
        return x + by


def test_shapes_are_bound_by_arguments_fields_and_paths() -> None:
    @validation.validated
    def collect(
        x: Annotated[validation.Array, "N d"],
        y: Annotated[validation.Array, "N"],
        line: Line,
        z: Annotated[validation.Array, "line.dim d"],
    ) -> tuple[Any, ...]:
        return x, y, z

    # y takes N from x; z takes its first size from an attribute of an argument.
    fits = {
        "x": np.ones((3, 4)),
        "y": np.ones(3),
        "line": Line(2, np.eye(2)),
        "z": np.ones((2, 4)),
    }
    collect(**fits)
    for name, bad in (("y", np.ones(4)), ("z", np.ones((3, 4))), ("line", 3)):
        with pytest.raises(ValueError, match=f"^{name} must"):
            collect(**(fits | {name: bad}))


def test_frozen_models_copy_and_freeze_arrays_and_construct_does_neither() -> None:
    # The caller may change its array afterwards.
    cov = np.eye(2)
    line = Line(2, cov, parts=[cov[0]])
    cov[0, 0] = 9.0
    assert line.cov[0, 0] == 1.0
    assert line.parts[0][0] == 1.0
    assert not line.cov.flags.writeable
    constructed = Line.construct(2, cov)
    assert constructed.cov is cov
    assert constructed.parts == ()
    assert line.replace(dim=7).dim == 7
    assert pickle.loads(pickle.dumps(line)).dim == 2


def test_validation_can_be_skipped() -> None:
    line = Line(1, [[1.0]])
    assert without_checks(line.shift)(np.ones(2)).tolist() == [2.0, 2.0]
    by_two = partial(line.shift, by=2.0)
    assert without_checks(by_two)(np.ones(2)).tolist() == [3.0, 3.0]


def test_a_partial_s_options_are_checked_where_it_is_an_argument() -> None:
    @validation.validated
    def apply(f: Callable[..., validation.Array], x: float) -> Any:
        return without_checks(f)(x)

    @validation.validated
    def scale(x: Any, by: validation.PositiveFloat) -> Any:
        return x * by

    assert apply(partial(scale, by=2), 3.0) == 6.0
    with pytest.raises(ValueError, match="^by must be positive"):
        apply(partial(scale, by=-2), 3.0)


@given(st.integers(0, 10_000), st.integers(1, 6))
def test_covariances_pass_in_any_units(seed: int, d: int) -> None:
    rng = generator(seed)
    unit = 10.0 ** rng.uniform(-100, 100, (3, d))
    cov = spd(rng, d, (3,)) * unit[:, :, None] * unit[:, None, :]
    cov = 0.5 * (cov + cov.swapaxes(1, 2))
    # D P D for a diagonal D is definite if P is.
    validation.check_positive_definite(cov, "P")
    validation.check_positive_semidefinite(cov, "P")


@pytest.mark.parametrize(
    "rule", [validation.check_positive_definite, validation.check_positive_semidefinite]
)
def test_each_matrix_is_checked_in_the_units_of_its_components(rule: Any) -> None:
    # An error of a small component must not vanish beside a large one.
    hidden = np.diag([1e12, 1.0, 1.0])
    # The eigenvalues of (1, 1.1; 1.1, 1) are 2.1 and -0.1.
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


def test_rounding_counts_neither_as_asymmetry_nor_as_a_negative_eigenvalue() -> None:
    nearly_symmetric = np.array([[1e12, 3e5], [3e5 * (1 + 1e-11), 1.0]])
    validation.check_positive_definite(nearly_symmetric, "P")
    # Smaller than the smallest normal number
    validation.check_positive_definite(1e-310 * np.eye(2), "P")
    # Of rank one, with an eigenvalue of zero up to rounding
    vector = np.array([1.0, 1e-6, 1e6])
    for cov in (np.outer(vector, vector), np.diag([0.0, 2.0])):
        validation.check_positive_semidefinite(cov, "P")
    # A correlation of 1 + 1e-8 is more than rounding.
    correlation = 1.0 + 1e-8
    indefinite = np.array([[1.0, correlation], [correlation, 1.0]])
    with pytest.raises(ValueError, match="smallest eigenvalue"):
        validation.check_positive_semidefinite(indefinite, "P")


# --- annotations as strings -------------------------------------------------------------------

MODULE = """
from __future__ import annotations

from typing import TYPE_CHECKING

from distfilt.validation import PositiveFloat, validated

if TYPE_CHECKING:
    from fractions import Fraction as Ratio


@validated
def scale(ratio: Ratio, by: PositiveFloat = 1.0) -> float:
    return float(ratio * by)


@validated
def fail(ratio: Nowhere) -> None: ...
"""


def test_names_imported_for_the_type_checker_are_checked_too(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Annotations are strings there; a name that exists nowhere is an error of the first call."""
    (tmp_path / "checked_module.py").write_text(MODULE)
    monkeypatch.syspath_prepend(tmp_path)
    module = importlib.import_module("checked_module")
    assert not hasattr(module, "Ratio")
    assert module.scale(Fraction(1, 2)) == 0.5
    with pytest.raises(TypeError, match="^ratio must be a Fraction, got 0.5"):
        module.scale(0.5)
    with pytest.raises(NameError, match=r"'Nowhere' of ratio of fail\(\)"):
        module.fail(1)


# --- checks that are made once ----------------------------------------------------------------


@dataclass(frozen=True)
class Motion:
    """A user's function behind a frozen object that compares equal to its copies."""

    step: Callable[..., Any]
    dim: int = 2


def test_a_frozen_owner_stays_unchanged_by_the_checks_of_its_function() -> None:
    """The comparison of a batch with one state is made once for each object."""
    shapes = []

    def step(x: np.ndarray) -> np.ndarray:
        shapes.append(x.shape)
        return 2 * x

    motion = Motion(step)
    before = dict(vars(motion))
    states = np.array([[1.0, 2.0], [3.0, 4.0]])
    for _ in range(3):
        call_batched(motion, "step", [states])
    # The single state is moved twice: a function that draws noise gives two results.
    assert shapes == [(2, 2), (2,), (2,), (2, 2), (2, 2)]
    assert vars(motion) == before
    # An equal object is another owner, and the record of an owner goes with it.
    assert first_use.needs_check(Motion(step), "step")
    assert not first_use.needs_check(motion, "step")
    key = id(motion)
    del motion
    assert key not in first_use._CHECKED


def test_equal_states_are_compared_once() -> None:
    """Agents that share everything have equal states; different ones are compared all the same."""
    n_calls = []

    def mean_of_batch(x: np.ndarray) -> np.ndarray:
        n_calls.append(len(x))
        # Right for one state and for equal ones, wrong for others.
        return np.broadcast_to(x.reshape(-1, 2).mean(axis=0), x.shape)

    motion = Motion(mean_of_batch)
    # Equal components pass by chance, so they prove nothing.
    call_batched(motion, "step", [np.ones((3, 2))])
    for _ in range(4):
        call_batched(motion, "step", [np.tile([1.0, 2.0], (3, 1))])
    # Three calls of each comparison, one of each later call
    assert len(n_calls) == 2 * 3 + 3
    with pytest.raises(ValueError, match="step must take many states at once"):
        call_batched(motion, "step", [np.array([[1.0, 2.0], [3.0, 4.0]])])


def test_a_user_s_function_in_a_batched_call_gets_its_own_checks() -> None:
    @validation.validated
    def scale(x: validation.Array, by: validation.PositiveFloat) -> Any:
        return by * x

    wrong = Motion(lambda x: scale(x, -1.0))
    with validation.skip_validation(), pytest.raises(ValueError, match="^by must be"):
        call_batched(wrong, "step", [np.ones((3, 2))])
