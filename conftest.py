"""Makes nbval run a cell as Jupyter does, and compare its pictures.

nbval sends ``store_history=False``; IPython then shows the value of a last line that ends in ``;``,
and the cell fails against an output that Jupyter stored without it. And it compares no picture: one
that was removed or exchanged passes.
"""

from __future__ import annotations

from typing import Any

from nbval.kernel import RunningKernel
from nbval.plugin import IPyNbCell

from pictures import differences, without_pictures


def _execute_cell_input(kernel: Any, cell_input: str, allow_stdin: bool | None = None) -> Any:
    return kernel.kc.execute(
        cell_input, store_history=True, allow_stdin=allow_stdin, stop_on_error=False
    )


_compare_texts = IPyNbCell.compare_outputs


def _compare_outputs(cell: Any, test: Any, ref: Any, skip_compare: Any = None) -> bool:
    """Texts to the letter, by nbval; pictures as a reader sees them."""
    texts = (without_pictures(test), without_pictures(ref), skip_compare)
    if not _compare_texts(cell, *texts):
        return False
    found = differences(ref, test)
    cell.comparison_traceback += found
    return not found


RunningKernel.execute_cell_input = _execute_cell_input
IPyNbCell.compare_outputs = _compare_outputs
