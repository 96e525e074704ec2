"""Assertions of chapters: strict in the tests, a printed message for a reader who edits a cell."""

from __future__ import annotations

import ast
import os
from typing import Any

__all__ = ["SoftAssert", "use_soft_assert"]


class SoftAssert(ast.NodeTransformer):
    """Turn each ``assert`` into a printed message, so that an edited notebook runs to its end.

    Examples
    --------
    >>> edited = SoftAssert().visit(
    ...     ast.parse("assert 1 > 2, 'the order of one and two'")
    ... )
    >>> exec(compile(ast.fix_missing_locations(edited), "cell", "exec"))
    no longer holds: the order of one and two
    """

    def visit_Assert(self, node: ast.Assert) -> ast.If:
        """Return ``if not test: print(message)``; the default message is the test's source."""
        # `print("no longer holds:", message)` as a syntax tree
        words = [
            ast.Constant("no longer holds:"),
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
