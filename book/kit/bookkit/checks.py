"""Checks of chapters: strict in the tests, a shown row or message for a reader who edits a cell."""

from __future__ import annotations

import ast
import os
from typing import Any

import numpy as np
import pandas as pd

from .tables import finish_table

__all__ = ["Checks", "SoftAssert", "use_soft_assert"]


class Checks:
    """A small table of what a cell expects and what it finds.

    Each method adds a row. A row that fails raises ``AssertionError`` where ``BOOK_STRICT`` is
    set, as in the tests; elsewhere the table says "changed" in that row, so that a reader can
    edit parameters and go on.

    Parameters
    ----------
    caption : str
        What is checked, with units.

    Examples
    --------
    >>> checks = Checks("A gain by hand")
    >>> checks.equal("gain", 4 / (4 + 1), 0.8, within=1e-12)
    >>> checks.between("NEES/d", 1.03, 0.9, 1.1)
    >>> checks
    A gain by hand
    statement            expected found holds
         gain                 0.8   0.8   yes
       NEES/d between 0.9 and 1.1  1.03   yes
    """

    def __init__(self, caption: str) -> None:
        self.caption = caption
        self._rows: list[tuple[str, str, str, bool]] = []

    def _add(self, statement: str, expected: str, found: str, holds: bool) -> None:
        """Add a row; a failed one raises in the tests."""
        if not holds and "BOOK_STRICT" in os.environ:
            raise AssertionError(
                f"{statement}: {expected} was expected, and {found} was found"
            )
        self._rows.append((statement, expected, found, holds))

    def equal(
        self,
        statement: str,
        found: Any,
        expected: Any,
        *,
        within: float,
        form: str = ".4g",
    ) -> None:
        """Compare numbers or arrays; ``within`` is the largest difference allowed.

        Of arrays the table shows the bound alone: rounding errors differ between machines.
        """
        gap = np.max(np.abs(np.subtract(found, expected)))
        # NaN is not equal to anything.
        holds = bool(gap <= within)
        if np.ndim(found) or np.ndim(expected):
            shape = np.broadcast(found, expected).shape
            size = " × ".join(map(str, shape))
            texts = f"equal within {within:.0e}", f"{size} numbers"
        else:
            texts = format(float(expected), form), format(float(found), form)
        self._add(statement, *texts, holds)

    def less(
        self, statement: str, found: float, bound: float, *, form: str = ".3g"
    ) -> None:
        """Ask that a number lies below a bound."""
        found_text = format(float(found), form)
        self._add(statement, f"below {bound:{form}}", found_text, bool(found < bound))

    def greater(
        self, statement: str, found: float, bound: float, *, form: str = ".3g"
    ) -> None:
        """Ask that a number lies above a bound."""
        found_text = format(float(found), form)
        self._add(statement, f"above {bound:{form}}", found_text, bool(found > bound))

    def between(
        self,
        statement: str,
        found: float,
        low: float,
        high: float,
        *,
        form: str = ".3g",
    ) -> None:
        """Ask that a number lies in an interval."""
        expected = f"between {low:{form}} and {high:{form}}"
        holds = bool(low <= found <= high)
        self._add(statement, expected, format(float(found), form), holds)

    def holds(self, statement: str, condition: bool, found: str = "") -> None:
        """Ask for a statement that is true or false, such as an order of methods."""
        self._add(
            statement, "true", found or str(bool(condition)).lower(), bool(condition)
        )

    @property
    def frame(self) -> pd.DataFrame:
        """The rows as a table."""
        names = ["statement", "expected", "found", "holds"]
        frame = pd.DataFrame(self._rows, columns=names)
        frame["holds"] = ["yes" if holds else "changed" for holds in frame["holds"]]
        return frame

    def __repr__(self) -> str:
        return f"{self.caption}\n{self.frame.to_string(index=False)}"

    def _repr_html_(self) -> str:
        page = self.frame.to_html(index=False, border=0)
        return finish_table(str(page), self.caption)


class SoftAssert(ast.NodeTransformer):
    """Turn each ``assert`` into a printed message, so that an edited notebook runs to its end.

    Examples
    --------
    >>> edited = SoftAssert().visit(
    ...     ast.parse("assert 1 > 2, 'the order of one and two'")
    ... )
    >>> exec(compile(ast.fix_missing_locations(edited), "cell", "exec"))
    changed: the order of one and two
    """

    def visit_Assert(self, node: ast.Assert) -> ast.If:
        """Return ``if not test: print(message)``; the default message is the test's source."""
        # `print("changed:", message)` as a syntax tree
        words = [
            ast.Constant("changed:"),
            node.msg or ast.Constant(ast.unparse(node.test)),
        ]
        message = ast.Expr(ast.Call(ast.Name("print", ast.Load()), words, []))
        check = ast.If(ast.UnaryOp(ast.Not(), node.test), [message], [])
        return ast.copy_location(check, node)


def use_soft_assert(shell: Any) -> None:
    """Let failed assertions of an IPython shell print, unless ``BOOK_STRICT`` is set."""
    # Calling it twice must not install two transformers.
    installed = [type(transformer) for transformer in shell.ast_transformers]
    if "BOOK_STRICT" not in os.environ and SoftAssert not in installed:
        shell.ast_transformers.append(SoftAssert())
