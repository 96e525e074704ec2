r"""Doors: what a function's arguments must be, declared once, by its annotations.

A public function stands behind :func:`validated`. Each argument whose annotation is a kind of this
module, or a plain type, is checked and converted before the function runs; what does not fit is
refused by an error that names the argument, what it needs and what it got. Nothing is repaired.
Nested calls are not checked again; :func:`skip_validation` does the same for a loop of one's own.

======================================  ==========================================================
Annotation                              What may come, and what the function gets
======================================  ==========================================================
``Annotated[Array, "... N d"]``         finite real numbers of this shape, as float64
``Annotated[Array, "m", ALLOW_NAN]``      the same, where NaN stands for what is missing
``Annotated[Array, "d d", definite]``   the same, if ``definite(value, name)`` lets it pass
``Annotated[Mask, "A"]``                booleans; ``Indices`` for integers
``float``, ``int``, ``bool``, ``str``   one finite number, one integer, one flag, a text not blank
``Positive``, ``Count``, ``Share``      numbers in bounds; others by ``Annotated[float, Bounds(…)]``
``Literal["a", "b"]``                   one of these words
``Rng``                                 a ``numpy.random.Generator``
``Callable[..., Any]``                  a function
``Graph``, any other class              an instance
``Sequence[X]``, ``tuple[X, ...]``      any sequence of such things, as a tuple
``X | Y``, ``X | None``                 what fits one of them
``Any``, ``ArrayLike``                  anything, as it came
======================================  ==========================================================

In a shape each word is the size of an axis. A number is exact, and so is the name of an argument
that is an integer, or a path such as ``model.dim`` or ``self.dim``; ``*channel.runs`` stands for
several axes. Any other word is free where it first occurs, and the same from there on. A leading
``...`` allows any leading axes. Sizes in lower case are numbers of components, at least 1.
"""

from collections.abc import Sequence
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from .annotations import ALLOW_NAN
from .checks import (
    Array,
    Bounds,
    InvalidArgumentError,
    all_finite,
    check_array,
    check_distinct,
    check_increasing,
    check_positive_definite,
    check_positive_semidefinite,
    check_probabilities,
    import_optional,
)
from .decorators import FrozenModel, call_user, skip_validation, validated

__all__ = [
    "Array",
    "Bounds",
    "PositiveInt",
    "PositiveDefinite",
    "NonNegativeInt",
    "Indices",
    "InvalidArgumentError",
    "ALLOW_NAN",
    "Mask",
    "NonNegativeFloat",
    "DistinctIndices",
    "PositiveFloat",
    "FrozenModel",
    "Rng",
    "PositiveSemidefinite",
    "UnitInterval",
    "Times",
    "Probabilities",
    "all_finite",
    "check_array",
    "check_positive_definite",
    "validated",
    "check_increasing",
    "import_optional",
    "check_positive_semidefinite",
    "check_probabilities",
    "call_user",
    "skip_validation",
]

Mask = NDArray[np.bool_]
Indices = NDArray[np.intp]
Rng = np.random.Generator
PositiveDefinite = Annotated[Array, "... d d", check_positive_definite]
PositiveSemidefinite = Annotated[Array, "... d d", check_positive_semidefinite]
Probabilities = Annotated[Array, "... N", check_probabilities]
Times = Annotated[Array, "T", check_increasing]
PositiveFloat = Annotated[float, Bounds(above=0)]
NonNegativeFloat = Annotated[float, Bounds(at_least=0)]
UnitInterval = Annotated[float, Bounds(at_least=0, at_most=1)]
PositiveInt = Annotated[int, Bounds(at_least=1)]
NonNegativeInt = Annotated[int, Bounds(at_least=0)]
DistinctIndices = Annotated[Sequence[NonNegativeInt], check_distinct]
