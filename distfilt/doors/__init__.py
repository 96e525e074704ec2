r"""Doors: what a function's arguments must be, declared once, by its annotations.

A public function stands behind :func:`door`. Each argument whose annotation is a kind of this
module, or a plain type, is checked and converted before the function runs; what does not fit is
refused by an error that names the argument, what it needs and what it got. Nothing is repaired.
:func:`unchecked` gives the function without its door, for loops.

======================================  ==========================================================
Annotation                              What may come, and what the function gets
======================================  ==========================================================
``Annotated[Array, "... N d"]``         finite real numbers of this shape, as float64
``Annotated[Array, "m", MISSING]``      the same, where NaN stands for what is missing
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

from .declared import Record, door, unchecked
from .kinds import MISSING
from .values import (
    Array,
    Bounds,
    all_finite,
    array,
    definite,
    distinct,
    increasing,
    needed,
    semidefinite,
    summing_to_one,
)

__all__ = [  # fmt: skip
    "Array", "Bounds", "Count", "Cov", "Index", "Indices", "MISSING", "Mask", "NonNegative",
    "Places", "Positive", "Record", "Rng", "Semidefinite", "Share", "Times", "Weights",
    "all_finite", "array", "definite", "door", "increasing", "needed", "semidefinite",
    "summing_to_one", "unchecked",
]

Mask = NDArray[np.bool_]
Indices = NDArray[np.intp]
Rng = np.random.Generator
Cov = Annotated[Array, "... d d", definite]
Semidefinite = Annotated[Array, "... d d", semidefinite]
Weights = Annotated[Array, "... N", summing_to_one]
Times = Annotated[Array, "T", increasing]
Positive = Annotated[float, Bounds(above=0)]
NonNegative = Annotated[float, Bounds(at_least=0)]
Share = Annotated[float, Bounds(at_least=0, at_most=1)]
Count = Annotated[int, Bounds(at_least=1)]
Index = Annotated[int, Bounds(at_least=0)]
Places = Annotated[Sequence[Index], distinct]
