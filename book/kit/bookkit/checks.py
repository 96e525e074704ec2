"""What a chapter's checks do: strict where outputs are compared, words for a reader who edits."""

from __future__ import annotations

import ast
import os
from typing import Any

__all__ = ["SoftAssert", "use_soft_assert"]


class SoftAssert(ast.NodeTransformer):
    """Turn each ``assert`` into a remark, so that an edited notebook runs on and says what changed.

    Examples
    --------
    >>> edited = SoftAssert().visit(
    ...     ast.parse("assert 1 > 2, 'the order of one and two'")
    ... )
    >>> exec(compile(ast.fix_missing_locations(edited), "cell", "exec"))
    no longer holds: the order of one and two
    """

    def visit_Assert(self, node: ast.Assert) -> ast.If:
        """``if not test: print(...)``, with the test itself where the check has no words."""
        words = [
            ast.Constant("no longer holds:"),
            node.msg or ast.Constant(ast.unparse(node.test)),
        ]
        remark = ast.Expr(ast.Call(ast.Name("print", ast.Load()), words, []))
        told = ast.If(ast.UnaryOp(ast.Not(), node.test), [remark], [])
        return ast.copy_location(told, node)


def use_soft_assert(shell: Any) -> None:
    """Let the cells of an IPython shell tell, unless ``BOOK_STRICT`` is set, as in the tests."""
    known = [type(transformer) for transformer in shell.ast_transformers]
    if "BOOK_STRICT" not in os.environ and SoftAssert not in known:
        shell.ast_transformers.append(SoftAssert())
