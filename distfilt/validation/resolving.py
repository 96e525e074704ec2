"""Evaluation of annotations, with the names that a module imports for the type checker only."""

from __future__ import annotations

import ast
import inspect
import sys
from collections.abc import Mapping
from functools import cache

from .annotations import ArgumentConstraint, make_constraint

__all__ = ["make_constraints"]


def make_constraints(
    annotations: Mapping[str, object],
    module: str,
    names: Mapping[str, object],
    owner: str,
) -> dict[str, ArgumentConstraint]:
    """Return the constraints that annotations declare, those of arrays last.

    Arrays come last because their shapes may refer to other arguments.

    Parameters
    ----------
    annotations : mapping of str to annotation
        Annotations by argument, as objects or as strings.
    module : str
        Name of the module that they stand in.
    names : mapping of str to object
        Names that a string may use: the module's globals.
    owner : str
        The function's or class's name in an error.

    Raises
    ------
    NameError
        If an annotation uses a name that neither the module nor its imports under
        ``TYPE_CHECKING`` define.
    """
    constraints: dict[str, ArgumentConstraint] = {}
    for argument, annotation in annotations.items():
        if argument == "return":
            continue
        # With ``from __future__ import annotations`` all of them are strings.
        if isinstance(annotation, str):
            annotation = _evaluate(annotation, module, names, f"{argument} of {owner}")
        constraint = make_constraint(annotation)
        if constraint is not None:
            constraints[argument] = constraint
    return sort_arrays_last(constraints)


def sort_arrays_last(
    constraints: dict[str, ArgumentConstraint],
) -> dict[str, ArgumentConstraint]:
    """Return constraints in their order, but with arrays behind all others."""
    items = sorted(constraints.items(), key=lambda item: item[1].has_shape)
    return dict(items)


def _evaluate(
    annotation: str, module: str, names: Mapping[str, object], argument: str
) -> object:
    """Evaluate an annotation that is kept as a string.

    Names are those of the module in which it stands; `argument` says for the error whose annotation
    it is.
    """
    try:
        return eval(annotation, dict(names))
    except NameError:
        pass  # the name may be imported for the type checker only
    try:
        return eval(annotation, dict(names) | _type_checking_imports(module))
    except NameError as error:
        raise NameError(
            f"the annotation {annotation!r} of {argument} cannot be evaluated: {error}"
        ) from None


@cache
def _type_checking_imports(module: str) -> dict[str, object]:
    """Import the names that a module imports under ``if TYPE_CHECKING:``."""
    names = dict(vars(sys.modules.get(module, sys)))
    try:
        tree = ast.parse(inspect.getsource(sys.modules[module]))
    except (KeyError, OSError, TypeError):
        return {}  # a notebook or a shell has no source
    for node in tree.body:
        if isinstance(node, ast.If) and _is_type_checking(node.test):
            statements = [s for s in node.body if isinstance(s, _IMPORTS)]
            # Only imports are run, no other statement of the block.
            block = ast.Module(body=list(statements), type_ignores=[])
            exec(compile(block, module, "exec"), names)
    return names


_IMPORTS = (ast.Import, ast.ImportFrom)


def _is_type_checking(test: ast.expr) -> bool:
    """Whether the condition of an `if` is TYPE_CHECKING."""
    return ast.unparse(test) in ("TYPE_CHECKING", "typing.TYPE_CHECKING")
