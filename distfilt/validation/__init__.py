r"""Validation: an argument's type, shape and bounds are declared by its annotation.

A public function is decorated by :func:`validated`. Each argument whose annotation is in the table
below is checked and converted before the function runs. A wrong argument raises an error that names
it, the values that are allowed, and the value that came. Nothing is repaired. Nested calls are not
checked again; :func:`skip_validation` does the same for a loop of your own.

========================================  ==========================================================
Annotation                                Allowed values, and the function's value
========================================  ==========================================================
``Annotated[ArrayInput, "... N d"]``      finite real numbers of this shape, as a float64 array
``Annotated[ArrayInput, …, ALLOW_NAN]``   the same, where NaN stands for a missing number
``Annotated[ArrayInput, "d d", rule]``    the same, if ``rule(value, name)`` raises no error
``Annotated[MaskInput, "A"]``             booleans; ``IndicesInput`` for integers
``float``, ``int``, ``bool``, ``str``     a finite number, an integer, a flag, a string not blank
``PositiveFloat``, ``UnitInterval`` …     numbers in bounds; or ``Annotated[float, Bounds(…)]``
``Literal["a", "b"]``                     one of these words
``Rng``                                   a ``numpy.random.Generator``
``Callable[..., object]``                    a function
``Graph``, any other class                an instance
``Sequence[X]``, ``tuple[X, ...]``        any sequence of such values, as a tuple
``X | Y``, ``X | None``                   a value that fits one of them
``object``, ``Any``, ``ArrayLike``        any value, unchanged
========================================  ==========================================================

In a shape each word names the size of an axis. A number is exact, and so is the name of an argument
that is an integer, or a path such as ``model.dim`` or ``self.dim``; ``*channel.runs`` stands for
several axes. Any other word is free where it first occurs, and the same from there on. A leading
``...`` allows any leading axes. Sizes in lower case are numbers of components, at least 1.

**Static types.** A type checker has no word for an argument that is array_like for the caller and
an array inside. So the inputs (``ArrayInput``, ``MaskInput``, ``IndicesInput`` and the aliases made
of them) are ``Any`` for it: a list passes ``mypy --strict``. Inner functions and results are typed
by ``Array``, ``Mask`` and ``Indices``.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated, Any, TypeAlias

import numpy as np

from .annotations import ALLOW_NAN
from .batching import call_batched
from .checks import (
    Array,
    Bounds,
    Indices,
    InvalidArgumentError,
    Mask,
    all_finite,
    check_array,
    check_distinct,
    check_increasing,
    check_positive_definite,
    check_positive_semidefinite,
    check_probabilities,
    format_number,
)
from .decorators import (
    FrozenModel,
    call_user,
    check_signature,
    skip_validation,
    validated,
)
from .first_use import is_first_use
from .optional import import_optional

__all__ = [
    "ALLOW_NAN",
    "Array",
    "ArrayInput",
    "Bounds",
    "DistinctIndices",
    "FrozenModel",
    "Indices",
    "IndicesInput",
    "InvalidArgumentError",
    "Mask",
    "MaskInput",
    "NonNegativeFloat",
    "NonNegativeInt",
    "PositiveDefinite",
    "PositiveFloat",
    "PositiveInt",
    "PositiveSemidefinite",
    "Probabilities",
    "Rng",
    "Times",
    "UnitInterval",
    "all_finite",
    "call_batched",
    "call_user",
    "check_array",
    "check_distinct",
    "check_increasing",
    "check_positive_definite",
    "check_positive_semidefinite",
    "check_probabilities",
    "check_signature",
    "format_number",
    "import_optional",
    "is_first_use",
    "skip_validation",
    "validated",
]

Rng = np.random.Generator

# Arguments that may be array_like: any value for a type checker, checked when a function is called.
if TYPE_CHECKING:
    ArrayInput: TypeAlias = Any
    MaskInput: TypeAlias = Any
    IndicesInput: TypeAlias = Any
else:
    ArrayInput = Array
    MaskInput = Mask
    IndicesInput = Indices

# Arrays with rules; a shape in a further Annotated replaces the one given here.
PositiveDefinite = Annotated[ArrayInput, "... d d", check_positive_definite]
PositiveSemidefinite = Annotated[ArrayInput, "... d d", check_positive_semidefinite]
Probabilities = Annotated[ArrayInput, "... N", check_probabilities]
Times = Annotated[ArrayInput, "T", check_increasing]
# Numbers in bounds.
PositiveFloat = Annotated[float, Bounds(above=0)]
NonNegativeFloat = Annotated[float, Bounds(at_least=0)]
UnitInterval = Annotated[float, Bounds(at_least=0, at_most=1)]
PositiveInt = Annotated[int, Bounds(at_least=1)]
NonNegativeInt = Annotated[int, Bounds(at_least=0)]
DistinctIndices = Annotated[Sequence[NonNegativeInt], check_distinct]
